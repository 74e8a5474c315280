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
use fieldbeat_keys::keys;
use fieldbeat_keys::machine::{Claim, Machine};
use fieldbeat_keys::table::{POSITIVE, Table, integer, number, set};

keys! {
    BIND "bind" = "-": "address of the network adapter of the drives: `\"192.168.1.1\"`, or with another "
        "UDP port than 2222. Sessions leave from it, too. `0.0.0.0` is refused: drives compare the two";
    DSCP "dscp" = "47": "mark of the packets for switches, 0 ... 63: 47 is scheduled traffic, 0 no mark";
    VENDOR "vendor" = "251": "vendor id of this master, 0 ... 65535";
    SERIAL "serial" = "(made of `bind`)": "serial number of this master, 0 ... 4294967295; unique on the "
        "network and the same after a restart, since a drive lets only the originator of before open again "
        "at once";
    STEPS_PER_REV "steps_per_rev" = "20000": "motor steps of a revolution, 1 ... 131070, as the drive's EG "
        "is set (EG counts half of them)";
    ADDRESS "address" = "-": "address of the drive: `\"192.168.1.40\"`, or with another port for explicit "
        "messages than 44818. One drive per IP address";
    CONNECTION "connection" = "owner": "`\"owner\"` commands the drive. `\"input-only\"` has no outputs: "
        "values are shown, calls are taken, motion is refused. `\"listen-only\"` is the same with the "
        "packets of another connection, and ends with it";
    VERSION "version" = "(as its firmware says)": "`\"v2\"` has the assemblies 0x65 and 0x70 (Ethernet "
        "board from 251.0 on), `\"v1\"` only the inputs 0x64: such a drive needs `\"input-only\"`";
    LAYOUT "layout" = "manual": "order of the elements of 0x65: that of the `\"manual\"` (Host Command "
        "Reference), with the position error, or of the vendor's `\"page\"`, without it";
    INPUT_RPI "input_rpi" = "(period × `divisor`)": "interval of the drive's packets, 1 ms ... 10 s";
    FRESH_WITHIN "fresh_within" = "(two of these intervals)": "the time for which a packet of the drive "
        "counts, at least one interval; a drive that answers the opening with a longer interval of its own "
        "is refused";
    FIRST_WITHIN "first_within" = "(`\"1s\"`, at least two intervals)":
        "longest time from the opening of a connection to the drive's first packet, up to 60 s";
    CONFIGURATION "configuration" = "(none, then two zeros)": "up to 256 bytes of the configuration "
        "assembly 0x66: `[0, 0]`";
    EXPLICIT "explicit" = "unconnected": "how explicit messages go: `\"unconnected\"`, or `\"connected\"` "
        "on a class 3 connection";
    HOLD "hold" = "2": "packets for which a command word is held at least, and idle behind it, 1 ... 100";
    EFFECT_WITHIN "effect_within" = "(`\"200ms\"`, at least twice both intervals)":
        "a command whose effect is not seen within this time was not taken, up to 10 s; an absolute move "
        "and a jog are sent again, up to three times";
    WATCHDOG "watchdog" = "500ms": "what the drive's ZS is set to at most: the silence after which it "
        "stops by itself; up to 10 s, at least two of the master's intervals. `\"off\"`: ZS is 0. No "
        "message of the manual reads ZS and ZA: they are taken on trust";
    NO_DRIVE_WATCHDOG "no_drive_watchdog" = "refuse": "a drive that would not stop by itself (`watchdog = "
        "\"off\"`) is refused by `check`, or taken with `\"accept\"`";
    HOMED_REGISTER "homed_register" = "none": "register of the drive, `\"0\"` ... `\"9\"`, that is not 0 "
        "while the drive has its reference. Without it only what this master saw counts, and an axis has "
        "to be homed after each loss of its link";
    DEVICE_VENDOR "vendor" = "60": "required vendor number: 60 is Applied Motion Products, which MOONS' "
        "drives are inferred to report; another number, 1 ... 65535, or `\"any\"`. See "
        "[below](#which-device-it-is)";
    PRODUCT "product" = "any": "required product code, 1 ... 65535";
    DEVICE_SERIAL "serial" = "any": "required serial number, 0 ... 4294967295";
    DELIVERY "delivery" = "(`\"point-to-point\"`; `\"multicast\"` for `\"listen-only\"`)":
        "how the drive's packets come: to this master, or to a group that the drive chooses. A group needs "
        "port 2222 in `bind`";
    TIMEOUT_MULTIPLIER "timeout_multiplier" = "(the least for 100 ms)":
        "a connection ends after so many intervals without a packet: 4, 8, 16, 32, 64, 128, 256 or 512, in "
        "both directions. The default is also longer than the time from a loss to the stop request; a "
        "shorter one is refused";
    HEARTBEAT "heartbeat" = "(2, then what the drive wants)": "connection size of a connection without "
        "outputs: 2, 6 or 0";
    ENCODER "encoder" = "false": "`true`: the position is the encoder's, which counts as many as the motor "
        "steps; a number: the counts of a revolution. `false`: the position is that of the commanded steps";
    INPUT "input" = "-": "number of the input that is wired as hardware enable, 1 ... 12";
    CLOSED "closed" = "true": "the drive is enabled while that input is closed; `false`: while it is open";
    HOMING_METHOD "method" = "-": "`\"seek\"`: SH, to an input, where the master then sets the drive's "
        "position to 0; `\"find\"`: FH. The position of home is `offset`. Without `homing` the axis "
        "refuses to home; with it all five keys are required";
    HOMING_INPUT "input" = "-": "the input with its condition: `\"2L\"` is input 2, low; 0 (index of the "
        "encoder) ... 12, then H, L, R or F";
    HOMING_VELOCITY "velocity" = "-": "velocity of the homing, units/s";
    HOMING_ACCELERATION "acceleration" = "-": "acceleration of the homing, units/s²";
    HOMING_DISTANCE "distance" = "-": "longest way of the homing, units; its sign is the direction";
    JOG "jog" = "true": "takes jogs and velocities; `false` refuses them";
}

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "MOONS' STF and SSDC",
    read: bus,
    outline: outline::OUTLINE,
    telegrams: telegrams::TELEGRAMS,
};

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let bind = bind(table, machine, (BIND, IO_PORT), Some("drives compare it"));
    let ip = bind.map_or(Ipv4Addr::UNSPECIFIED, |bind| *bind.ip());
    let originator = originator(table, ip);
    let dscp = table.integer(DSCP, 0..=63).unwrap_or(EthernetIpPlan::DSCP);
    let drives = drives(table, |table, _| drive(table, machine, bind));
    Box::new(EthernetIpPlan { name, bind: bind.unwrap_or(NOWHERE), originator, dscp, drives })
}

fn originator(table: &mut Table<'_>, bind: Ipv4Addr) -> Originator {
    let mut originator = Originator::at(bind);
    table.table("originator", |table| {
        set(&mut originator.vendor, table.integer(VENDOR, 0..=0xFFFF));
        set(&mut originator.serial, table.integer(SERIAL, 0..=0xFFFF_FFFF));
        originator
    })
}

fn drive(table: &mut Table<'_>, machine: &mut Machine, bind: Option<SocketAddrV4>) -> MoonsDrive {
    let steps = table.number(STEPS_PER_REV, 1.0..=STEPS_MAX);
    let steps = steps.unwrap_or(MoonsDrive::STEPS_PER_REVOLUTION);
    let axis = axis(table, machine, Counts::revolutions(steps));
    let ip = bind.map(|bind| *bind.ip());
    let address = address(table, machine, ip, ADDRESS, ("192.168.1.40", PORT), Claim::Host);
    if ip == Some(*address.ip()) {
        table.fault("address", OWN_ADDRESS);
    }
    let rpi_ns = machine.period_ns.saturating_mul(u64::from(axis.divisor));
    let (least_ns, most_ns) = RPI_RANGE_NS;
    let usual = MoonsDrive::new("", *address.ip());
    let mut drive = MoonsDrive { axis, steps_per_revolution: steps, address, ..usual.clone() };
    set(&mut drive.connection, table.word(CONNECTION, &Access::WORDS));
    let counts = encoder(table);
    drive.encoder = counts.is_some();
    set(&mut drive.encoder_counts_per_step, counts.map(|counts| counts.map_or(1.0, |counts| counts / steps)));
    expected(table, &mut drive.expected);
    drive.version = table.word(VERSION, &[("v1", Version::V1), ("v2", Version::V2)]);
    set(&mut drive.layout, table.word(LAYOUT, &[("manual", Layout::Manual), ("page", Layout::Page)]));
    drive.delivery = delivery(table, drive.connection);
    drive.input_rpi_ns = table.time(INPUT_RPI, least_ns..=most_ns);
    drive.multiplier = multiplier(table);
    drive.fresh_within_ns = table.time(FRESH_WITHIN, ..=most_ns);
    let first_within_ns = table.time(FIRST_WITHIN, MS..=60 * S);
    drive.configuration = table.byte_list(CONFIGURATION, CONFIGURATION_MAX);
    drive.heartbeat = heartbeat(table);
    let words = [("unconnected", Explicit::Unconnected), ("connected", Explicit::Connected)];
    set(&mut drive.explicit, table.word(EXPLICIT, &words));
    set(&mut drive.hold, table.integer(HOLD, 1..=100));
    let effect_within_ns = table.time(EFFECT_WITHIN, MS..=10 * S);
    let watchdog_ns = table.time_or_off(WATCHDOG, MS..=WATCHDOG_MAX_NS);
    set(&mut drive.watchdog.within_ns, watchdog_ns);
    set(&mut drive.watchdog.accept_none, accepts_no_watchdog(table, NO_DRIVE_WATCHDOG));
    drive.enable_input = enable_input(table);
    drive.homing = homing(table);
    drive.homed_register =
        table.text(HOMED_REGISTER, "^[0-9]$", "a register of the user, \"0\" ... \"9\"", |text| {
            match text.as_bytes() {
                [register @ b'0'..=b'9'] => Some(*register),
                _ => None,
            }
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
    set(&mut expected.vendor, table.integer_or_any(DEVICE_VENDOR, 1..=0xFFFF));
    set(&mut expected.product, table.integer_or_any(PRODUCT, 1..=0xFFFF));
    set(&mut expected.serial, table.integer_or_any(DEVICE_SERIAL, 0..=0xFFFF_FFFF));
}

/// Who listens only gets packets of a group.
fn delivery(table: &mut Table<'_>, connection: Access) -> Delivery {
    let words = [("point-to-point", Delivery::PointToPoint), ("multicast", Delivery::Multicast)];
    table.word(DELIVERY, &words).unwrap_or(match connection {
        Access::ListenOnly => Delivery::Multicast,
        Access::Owner | Access::InputOnly => Delivery::PointToPoint,
    })
}

/// The factor, as its code.
fn multiplier(table: &mut Table<'_>) -> Option<u8> {
    let factors = (0..=7).map(|code| 4 << code);
    table.read(TIMEOUT_MULTIPLIER, Form::numbers(factors), |value| {
        let factor = integer(value).and_then(|factor| u32::try_from(factor).ok());
        let code = factor.and_then(|factor| (0_u8..=7).find(|code| 4_u32 << code == factor));
        code.ok_or("must be 4, 8, 16, 32, 64, 128, 256 or 512 packets; leave it out for the usual one".into())
    })
}

fn heartbeat(table: &mut Table<'_>) -> Option<u8> {
    let wrong = "must be 2, 6 or 0, the connection size; leave it out for the one that is taken";
    table.read(HEARTBEAT, Form::numbers([0, 2, 6]), |value| match integer(value) {
        Some(size @ (0 | 2 | 6)) => Ok(size as u8),
        _ => Err(wrong.into()),
    })
}

/// Encoder counts of a motor revolution, if there is an encoder; `Some(None)`: they are its steps.
fn encoder(table: &mut Table<'_>) -> Option<Option<f64>> {
    const FORMS: &str = "must be true, false, or the counts of the encoder in a revolution";
    let given = table.read(ENCODER, Form::Flag.or(Form::number(POSITIVE)), |value| {
        match (value.as_bool(), number(value)) {
            (Some(flag), _) => Ok(flag.then_some(None)),
            (None, Some(counts)) if counts > 0.0 && counts.is_finite() => Ok(Some(Some(counts))),
            _ => Err(FORMS.into()),
        }
    });
    given.flatten()
}

fn enable_input(table: &mut Table<'_>) -> Option<EnableInput> {
    table.optional("enable_input", |table| {
        let number = table.integer(INPUT, 1..=i128::from(INPUT_MAX));
        let closed = table.flag(CLOSED).unwrap_or(true);
        number.map(|number| EnableInput { number, closed })
    })
}

fn homing(table: &mut Table<'_>) -> Option<Homing> {
    table.optional("homing", |table| {
        let method = table.word(HOMING_METHOD, &[("seek", HomingMethod::Seek), ("find", HomingMethod::Find)]);
        let hint = "an input with its condition, like \"2L\": 0 ... 12 and H, L, R or F";
        let input = table.text(HOMING_INPUT, None, hint, |text| text.parse::<IoCode>().ok());
        let velocity = table.number(HOMING_VELOCITY, POSITIVE);
        let acceleration = table.number(HOMING_ACCELERATION, POSITIVE);
        let distance = table.number(HOMING_DISTANCE, ..);
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
    let jog = table.flag(JOG);
    if jog == Some(true) && connection != Access::Owner {
        table.fault("jog", "needs outputs: connection = \"owner\"; leave it out");
    }
    jog
}
