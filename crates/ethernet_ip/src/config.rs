//! `protocol = "ethernet-ip"`.

mod outline;
mod scan;
mod telegrams;
mod tools;

pub use self::tools::TOOLS;

use fieldbeat_keys::Protocol;
use std::net::{Ipv4Addr, SocketAddrV4};

use super::PROTOCOL;
use super::check::{CONFIGURATION_MAX, INPUT_MAX, OWN_ADDRESS, STEPS_MAX};
use super::plan::{
    Access, Delivery, EnableInput, EthernetIpPlan, Expected, Explicit, Homing, HomingMethod, IO_PORT, Layout,
    MoonsDrive, Originator, PORT, RPI_RANGE_NS, Version, WATCHDOG_MAX_NS,
};
use super::wire::assembly::IoCode;
use fieldbeat_core::bus::BusPlan;
use fieldbeat_core::time::{MS, S};
use fieldbeat_keys::bus::{NOWHERE, accepts_no_watchdog, address, bind, drives};
use fieldbeat_keys::drive::{Counts, axis};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::machine::{Claim, Machine};
use fieldbeat_keys::table::{POSITIVE, Table, integer, number, set};

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "MOONS' STF and SSDC",
    read: bus,
    reference: include_str!("../files/configuration-ethernet-ip.md"),
    specimen: SPECIMEN,
    outline: outline::OUTLINE,
    telegrams: telegrams::TELEGRAMS,
};

/// With each table that may be missing.
pub const SPECIMEN: &str = "bind = \"127.0.0.1\"\n[[bus.drive]]\nname = \"x\"\naddress = \
     \"127.0.0.2\"\nhoming = {}\nenable_input = {}\n";

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let bind = bind(table, machine, IO_PORT, Some("drives compare it"));
    let ip = bind.map_or(Ipv4Addr::UNSPECIFIED, |bind| *bind.ip());
    let originator = originator(table, ip);
    let dscp = "the mark of packets for switches; 47 is scheduled traffic, 0 is no mark";
    let dscp = table.integer("dscp", 0..=63, dscp).unwrap_or(EthernetIpPlan::DSCP);
    let drives = drives(table, |table, _| drive(table, machine, bind));
    Box::new(EthernetIpPlan { name, bind: bind.unwrap_or(NOWHERE), originator, dscp, drives })
}

fn originator(table: &mut Table<'_>, bind: Ipv4Addr) -> Originator {
    let mut originator = Originator::at(bind);
    table.table("originator", |table| {
        let vendor = "the vendor id of this master; leave it out for 251";
        set(&mut originator.vendor, table.integer("vendor", 0..=0xFFFF, vendor));
        let serial = "unique among the masters on the network; leave it out for one made of bind";
        set(&mut originator.serial, table.integer("serial", 0..=0xFFFF_FFFF, serial));
        originator
    })
}

fn drive(table: &mut Table<'_>, machine: &mut Machine, bind: Option<SocketAddrV4>) -> MoonsDrive {
    let steps = "the steps of a motor revolution, as EG sets them";
    let steps = table.number("steps_per_rev", 1.0..=STEPS_MAX, steps);
    let steps = steps.unwrap_or(MoonsDrive::STEPS_PER_REVOLUTION);
    let axis = axis(table, machine, Counts::revolutions(steps));
    let ip = bind.map(|bind| *bind.ip());
    let address = address(table, machine, ip, ("192.168.1.40", PORT), Claim::Host);
    if ip == Some(*address.ip()) {
        table.fault("address", OWN_ADDRESS);
    }
    let rpi_ns = machine.period_ns.saturating_mul(u64::from(axis.divisor));
    let (least_ns, most_ns) = RPI_RANGE_NS;
    let usual = MoonsDrive::new("", *address.ip());
    let mut drive = MoonsDrive { axis, steps_per_revolution: steps, address, ..usual.clone() };
    set(&mut drive.connection, table.word("connection", &Access::WORDS));
    let counts = encoder(table);
    drive.encoder = counts.is_some();
    set(&mut drive.encoder_counts_per_step, counts.map(|counts| counts.map_or(1.0, |counts| counts / steps)));
    expected(table, &mut drive.expected);
    drive.version = table.word("version", &[("v1", Version::V1), ("v2", Version::V2)]);
    set(&mut drive.layout, table.word("layout", &[("manual", Layout::Manual), ("page", Layout::Page)]));
    drive.delivery = delivery(table, drive.connection);
    let interval = "the interval of the drive's packets; leave it out for that of the master's";
    drive.input_rpi_ns = table.time("input_rpi", least_ns..=most_ns, interval);
    drive.multiplier = multiplier(table);
    let fresh = "the time for which a packet of the drive counts; leave it out for two of its intervals";
    drive.fresh_within_ns = table.time("fresh_within", ..=most_ns, fresh);
    let first = "the time within which the first packet has to come";
    let first_within_ns = table.time("first_within", MS..=60 * S, first);
    drive.configuration = table.byte_list("configuration", CONFIGURATION_MAX);
    drive.heartbeat = heartbeat(table);
    let words = [("unconnected", Explicit::Unconnected), ("connected", Explicit::Connected)];
    set(&mut drive.explicit, table.word("explicit", &words));
    let hold = "the packets with a command, and those behind it without one";
    set(&mut drive.hold, table.integer("hold", 1..=100, hold));
    let effect = "the time within which the effect of a command is seen";
    let effect_within_ns = table.time("effect_within", MS..=10 * S, effect);
    let watchdog = "what ZS of the drive is set to at most, 500ms as delivered; or \"off\"";
    let watchdog_ns = table.time_or_off("watchdog", MS..=WATCHDOG_MAX_NS, watchdog);
    set(&mut drive.watchdog.within_ns, watchdog_ns);
    set(&mut drive.watchdog.accept_none, accepts_no_watchdog(table));
    drive.enable_input = enable_input(table);
    drive.homing = homing(table);
    let register = "a register of the user, \"0\" ... \"9\"";
    drive.homed_register = table.text("homed_register", "^[0-9]$", register, |text| match text.as_bytes() {
        [register @ b'0'..=b'9'] => Some(*register),
        _ => None,
    });
    set(&mut drive.jog, jog(table, drive.connection));
    table.later("simulate");
    let least_ns = drive.least_effect_ns(machine.period_ns);
    drive.effect_within_ns = effect_within_ns.unwrap_or(usual.effect_within_ns.max(least_ns));
    let two_ns = drive.input_rpi_ns(machine.period_ns).saturating_mul(2);
    drive.first_within_ns = first_within_ns.unwrap_or(usual.first_within_ns.max(two_ns));
    table.faults(drive.faults(rpi_ns));
    table.faults(bind.and_then(|bind| drive.delivery_fault(bind)));
    drive
}

fn expected(table: &mut Table<'_>, expected: &mut Expected) {
    let device = "a number that fieldbeat ethernet-ip scan shows; or \"any\" for whatever answers there";
    set(&mut expected.vendor, table.integer_or_any("vendor", 1..=0xFFFF, device));
    set(&mut expected.product, table.integer_or_any("product", 1..=0xFFFF, device));
    set(&mut expected.serial, table.integer_or_any("serial", 0..=0xFFFF_FFFF, device));
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

fn heartbeat(table: &mut Table<'_>) -> Option<u8> {
    let wrong = "must be 2, 6 or 0, the connection size; leave it out for the one that is taken";
    table.read("heartbeat", Form::numbers([0, 2, 6]), |value| match integer(value) {
        Some(size @ (0 | 2 | 6)) => Ok(size as u8),
        _ => Err(wrong.into()),
    })
}

/// Encoder counts of a motor revolution, if there is an encoder; `Some(None)`: they are its steps.
fn encoder(table: &mut Table<'_>) -> Option<Option<f64>> {
    const FORMS: &str = "must be true, false, or the counts of the encoder in a revolution";
    let given = table.read("encoder", Form::Flag.or(Form::number(POSITIVE)), |value| {
        match (value.as_bool(), number(value)) {
            (Some(flag), _) => Ok(flag.then_some(None)),
            (None, Some(counts)) if counts > 0.0 && counts.is_finite() => Ok(Some(Some(counts))),
            _ => Err(FORMS.into()),
        }
    });
    given.flatten()
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
