//! `protocol = "ethernet-ip"`.

mod outline;
mod scan;
mod tools;

pub use self::tools::TOOLS;

use fieldbeat_keys::Protocol;
use std::net::{Ipv4Addr, SocketAddrV4};

use super::PROTOCOL;
use super::check::{CONFIGURATION_MAX, INPUT_MAX, STEPS_MAX};
use super::plan::{
    Access, Delivery, EnableInput, EthernetIpPlan, Expected, Explicit, Homing, HomingMethod, IO_PORT, Layout,
    MoonsDrive, Originator, PORT, RPI_RANGE_NS, Version, WATCHDOG_MAX_NS, Watchdog,
};
use super::wire::assembly::IoCode;
use fieldbeat_core::axis::Unit;
use fieldbeat_core::bus::BusPlan;
use fieldbeat_core::net::SendMode;
use fieldbeat_core::time::{MS, S};
use fieldbeat_keys::bus::{NOWHERE, drives, reachable};
use fieldbeat_keys::drive::{Counts, axis};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::machine::{Claim, Machine};
use fieldbeat_keys::table::{POSITIVE, Table, integer, number, time};
use fieldbeat_keys::value::{ENDPOINT, station};

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "MOONS' STF and SSDC",
    read: bus,
    reference: include_str!("../files/configuration-ethernet-ip.md"),
    specimen: SPECIMEN,
    outline: outline::OUTLINE,
};

/// With each table that may be missing.
pub const SPECIMEN: &str = "bind = \"127.0.0.1\"\n[[bus.drive]]\nname = \"x\"\naddress = \
     \"127.0.0.2\"\nhoming = {}\nenable_input = {}\n";

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let bind = bind(table, machine);
    let ip = bind.map_or(Ipv4Addr::UNSPECIFIED, |bind| *bind.ip());
    let originator = originator(table, ip);
    let dscp = table
        .integer("dscp", 0..=63, "the mark of packets for switches; 47 is scheduled traffic, 0 is no mark")
        .unwrap_or(EthernetIpPlan::DSCP);
    let send =
        table.word("send", &[("batch", SendMode::Batch), ("each", SendMode::Each)]).unwrap_or_default();
    let drives = drives(table, |table, _| drive(table, machine, bind));
    Box::new(EthernetIpPlan { name, bind: bind.unwrap_or(NOWHERE), originator, dscp, send, drives })
}

fn bind(table: &mut Table<'_>, machine: &mut Machine) -> Option<SocketAddrV4> {
    table.require("bind", "the address of the network adapter of the drives, like \"192.168.1.1\"");
    let hint = "the IPv4 address of an adapter, like \"192.168.1.1\", or with a port other than 2222; never \
         0.0.0.0, since drives compare it";
    let own = |ip: &Ipv4Addr| !ip.is_unspecified() && !ip.is_multicast() && !ip.is_broadcast();
    let bind =
        table.text("bind", ENDPOINT, hint, |text| station(text, IO_PORT).filter(|bind| own(bind.ip())))?;
    machine.claim_bind(table, bind);
    Some(bind)
}

fn originator(table: &mut Table<'_>, bind: Ipv4Addr) -> Originator {
    let default = Originator::at(bind);
    table.table("originator", |table| Originator {
        vendor: table
            .integer("vendor", 0..=0xFFFF, "the vendor id of this master; leave it out for 251")
            .unwrap_or(default.vendor),
        serial: table
            .integer(
                "serial",
                0..=0xFFFF_FFFF,
                "unique among the masters on the network; leave it out for one made of bind",
            )
            .unwrap_or(default.serial),
    })
}

fn address(table: &mut Table<'_>, machine: &mut Machine, bind: Option<SocketAddrV4>) -> Option<SocketAddrV4> {
    table.require("address", "the address of the drive, like \"192.168.1.40\"");
    let hint = "the IPv4 address of a drive, like \"192.168.1.40\", or with a port other than 44818";
    let address = table.text("address", ENDPOINT, hint, |text| {
        station(text, PORT).filter(|address| !address.ip().is_unspecified())
    })?;
    machine.claim_address(table, address, Claim::Host);
    if bind.is_some_and(|bind| bind.ip() == address.ip()) {
        table.fault("address", "is the master's own address, bind; give that of the drive");
    }
    reachable(table, bind.map(|bind| *bind.ip()), address);
    Some(address)
}

fn drive(table: &mut Table<'_>, machine: &mut Machine, bind: Option<SocketAddrV4>) -> MoonsDrive {
    let steps = table
        .number("steps_per_rev", 1.0..=STEPS_MAX, "the steps of a motor revolution, as EG sets them")
        .unwrap_or(MoonsDrive::STEPS_PER_REVOLUTION);
    let counts =
        Counts { what: "revolutions of the motor", unit: Unit::Revolution, per_unit: 1.0, wire: steps };
    let axis = axis(table, machine, counts);
    let address = address(table, machine, bind).unwrap_or(NOWHERE);
    let rpi_ns = machine.period_ns.saturating_mul(u64::from(axis.divisor));
    let default = MoonsDrive::new("", *address.ip());
    let connection = table.word("connection", &Access::WORDS).unwrap_or(default.connection);
    let (least_ns, most_ns) = RPI_RANGE_NS;
    let encoder = encoder(table, steps);
    let mut drive = MoonsDrive {
        axis,
        steps_per_revolution: steps,
        address,
        expected: expected(table, default.expected),
        connection,
        cyclic: default.cyclic,
        version: table.word("version", &[("v1", Version::V1), ("v2", Version::V2)]),
        layout: table
            .word("layout", &[("manual", Layout::Manual), ("page", Layout::Page)])
            .unwrap_or(default.layout),
        delivery: delivery(table, connection),
        input_rpi_ns: table.time(
            "input_rpi",
            least_ns..=most_ns,
            "the interval of the drive's packets; leave it out for that of the master's",
        ),
        multiplier: multiplier(table),
        fresh_within_ns: table.time(
            "fresh_within",
            ..=most_ns,
            "the time for which a packet of the drive counts; leave it out for two of its intervals",
        ),
        first_within_ns: table
            .time("first_within", MS..=60 * S, "the time within which the first packet has to come")
            .unwrap_or(default.first_within_ns),
        configuration: configuration(table),
        heartbeat: table.read("heartbeat", Form::numbers([0, 2, 6]), |value| match integer(value) {
            Some(0) => Ok(0),
            Some(2) => Ok(2),
            Some(6) => Ok(6),
            _ => Err("must be 2, 6 or 0, the connection size; leave it out for the one that is taken".into()),
        }),
        explicit: table
            .word("explicit", &[("unconnected", Explicit::Unconnected), ("connected", Explicit::Connected)])
            .unwrap_or(default.explicit),
        hold: table
            .integer("hold", 1..=100, "the packets with a command, and those behind it without one")
            .unwrap_or(default.hold),
        effect_within_ns: table
            .time("effect_within", MS..=10 * S, "the time within which the effect of a command is seen")
            .unwrap_or(default.effect_within_ns),
        watchdog: watchdog(table, default.watchdog),
        enable_input: enable_input(table),
        homing: homing(table),
        homed_register: table.text(
            "homed_register",
            "^[0-9]$",
            "a register of the user, \"0\" ... \"9\"",
            |text| {
                let &[register @ b'0'..=b'9'] = text.as_bytes() else { return None };
                Some(register)
            },
        ),
        encoder: encoder.is_some(),
        encoder_counts_per_step: encoder.unwrap_or(default.encoder_counts_per_step),
        jog: jog(table, connection).unwrap_or(default.jog),
    };
    table.later("simulate");
    if !table.gives("effect_within") {
        drive.effect_within_ns = default.effect_within_ns.max(drive.least_effect_ns(machine.period_ns));
    }
    if !table.gives("first_within") {
        let two_ns = drive.input_rpi_ns(machine.period_ns).saturating_mul(2);
        drive.first_within_ns = default.first_within_ns.max(two_ns);
    }
    for fault in drive.faults(rpi_ns) {
        table.fault(fault.key, fault.message);
    }
    if let Some(fault) = bind.and_then(|bind| drive.delivery_fault(bind)) {
        table.fault(fault.key, fault.message);
    }
    drive
}

/// What the file leaves out is as in `default`.
fn expected(table: &mut Table<'_>, default: Expected) -> Expected {
    let device = "a number that fieldbeat ethernet-ip scan shows; or \"any\" for whatever answers there";
    Expected {
        vendor: table.integer_or_any("vendor", 1..=0xFFFF, device).unwrap_or(default.vendor),
        product: table.integer_or_any("product", 1..=0xFFFF, device).unwrap_or(default.product),
        serial: table.integer_or_any("serial", 0..=0xFFFF_FFFF, device).unwrap_or(default.serial),
    }
}

/// Who listens only gets packets of a group.
fn delivery(table: &mut Table<'_>, connection: Access) -> Delivery {
    let words = [("point-to-point", Delivery::PointToPoint), ("multicast", Delivery::Multicast)];
    table.word("delivery", &words).unwrap_or(match connection {
        Access::ListenOnly => Delivery::Multicast,
        Access::Owner | Access::InputOnly => Delivery::PointToPoint,
    })
}

/// The factor, as its code.
fn multiplier(table: &mut Table<'_>) -> Option<u8> {
    let factors = (0..=7).map(|code| 4 << code);
    table.read("timeout_multiplier", Form::numbers(factors), |value| {
        let factor = integer(value).and_then(|factor| u32::try_from(factor).ok());
        let code = factor.and_then(|factor| (0_u8..=7).find(|code| 4_u32 << code == factor));
        code.ok_or("must be 4, 8, 16, 32, 64, 128, 256 or 512 packets; leave it out for the usual one".into())
    })
}

/// The bytes of assembly 0x66.
fn configuration(table: &mut Table<'_>) -> Option<Vec<u8>> {
    let bytes = table.integers("configuration", CONFIGURATION_MAX, u16::from(u8::MAX));
    table.gives("configuration").then(|| bytes.into_iter().map(|byte| byte as u8).collect())
}

/// Encoder counts of a motor step, if there is an encoder.
fn encoder(table: &mut Table<'_>, steps: f64) -> Option<f64> {
    const FORMS: &str = "must be true, false, or the counts of the encoder in a revolution";
    let given = table.read("encoder", Form::Flag.or(Form::number(POSITIVE)), |value| {
        match (value.as_bool(), number(value)) {
            (Some(true), _) => Ok(Some(1.0)),
            (Some(false), _) => Ok(None),
            (None, Some(counts)) if counts > 0.0 && counts.is_finite() => Ok(Some(counts / steps)),
            _ => Err(FORMS.into()),
        }
    });
    given.flatten()
}

fn watchdog(table: &mut Table<'_>, default: Watchdog) -> Watchdog {
    let hint = "what ZS of the drive is set to at most, 500ms as delivered; or \"off\"";
    let within_ns = table.read("watchdog", Form::Time.or(Form::word("off")), |value| match value.as_str() {
        Some("off") => Ok(None),
        _ => time(value, &(MS..=WATCHDOG_MAX_NS), hint).map(Some),
    });
    let accept = table.word("no_drive_watchdog", &[("accept", true), ("refuse", false)]);
    Watchdog {
        within_ns: within_ns.unwrap_or(default.within_ns),
        accept_none: accept.unwrap_or(default.accept_none),
    }
}

/// What `read` makes of a sub-table; nothing if it is absent.
fn optional<'a, T>(
    table: &mut Table<'a>,
    key: &'static str,
    read: impl FnOnce(&mut Table<'a>) -> Option<T>,
) -> Option<T> {
    match table.read(key, Form::Table, |value| Ok(value.as_table().is_some()))? {
        true => table.table(key, read),
        // It has no keys that could be missing.
        false => table.table(key, |_| None),
    }
}

fn enable_input(table: &mut Table<'_>) -> Option<EnableInput> {
    optional(table, "enable_input", |table| {
        table.require("input", "the number of the input, 1 ... 12");
        let number = table.integer("input", 1..=i128::from(INPUT_MAX), "the number of the input");
        let closed = table.flag("closed").unwrap_or(true);
        number.map(|number| EnableInput { number, closed })
    })
}

fn homing(table: &mut Table<'_>) -> Option<Homing> {
    optional(table, "homing", |table| {
        for (key, why) in [
            ("method", "\"seek\" for SH, or \"find\" for FH"),
            ("input", "the input with its condition, like \"2L\""),
            ("velocity", "in user units/s"),
            ("acceleration", "in user units/s²"),
            ("distance", "in user units; its sign is the direction"),
        ] {
            table.require(key, why);
        }
        let method = table.word("method", &[("seek", HomingMethod::Seek), ("find", HomingMethod::Find)]);
        let hint = "an input with its condition, like \"2L\": 0 ... 12 and H, L, R or F";
        let input = table.text("input", None, hint, |text| text.parse::<IoCode>().ok());
        let velocity = table.number("velocity", POSITIVE, "units/s");
        let acceleration = table.number("acceleration", POSITIVE, "units/s²");
        let distance = table.number("distance", .., "user units; the sign is the direction");
        Some(Homing {
            method: method?,
            input: input?.code(),
            velocity: velocity?,
            acceleration: acceleration?,
            distance: distance?,
        })
    })
}

fn jog(table: &mut Table<'_>, connection: Access) -> Option<bool> {
    let jog = table.flag("jog");
    if jog == Some(true) && connection != Access::Owner {
        table.fault("jog", "needs outputs: connection = \"owner\"; leave it out");
    }
    jog
}
