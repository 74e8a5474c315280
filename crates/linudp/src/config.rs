//! `protocol = "linudp-v2"`.

pub mod curve;
mod name;
mod outline;
pub mod table;
mod telegrams;
mod tools;

pub use self::tools::TOOLS;

use fieldbeat_keys::Protocol;
use std::net::SocketAddrV4;
use std::time::Duration;

use super::PROTOCOL;
use super::motion::StreamCommand;
use super::plan::{
    COUNTS_PER_MM, DRIVE_PORT, LinUdpDrive, LinUdpPlan, MASTER_PORT, MonitorPlan, ReplyTag, Serial,
};
use super::upid::{KNOWN, Upid};
use fieldbeat_core::axis::Unit;
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::bus::{BusPlan, MOST_EARLIER};
use fieldbeat_core::time::S;
use fieldbeat_keys::bus::{NOWHERE, accepts_no_watchdog, address, bind, drives};
use fieldbeat_keys::drive::{Counts, axis};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::machine::{Claim, Machine};
use fieldbeat_keys::table::{POSITIVE, Table, integer, up_to};
use fieldbeat_keys::value::unknown;

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "LinMot LinUDP V2",
    read: bus,
    reference: include_str!("../files/configuration-linudp.md"),
    specimen: SPECIMEN,
    outline: outline::OUTLINE,
    telegrams: telegrams::TELEGRAMS,
};

/// With each table that may be missing.
pub const SPECIMEN: &str = "bind = \"127.0.0.1\"\n[[bus.drive]]\nname = \"x\"\naddress = \"127.0.0.2\"\n";

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let bind = bind(table, machine, MASTER_PORT, None);
    let drives = drives(table, |table, _| drive(table, machine, bind));
    Box::new(LinUdpPlan { name, bind: bind.unwrap_or(NOWHERE), drives })
}

const COUNTS: Counts =
    Counts { what: "drive counts", unit: Unit::Millimetre, per_unit: COUNTS_PER_MM, wire: 1.0 };

fn drive(table: &mut Table<'_>, machine: &mut Machine, bind: Option<SocketAddrV4>) -> LinUdpDrive {
    let axis = axis(table, machine, COUNTS);
    let bind = bind.map(|bind| *bind.ip());
    let address = address(table, machine, bind, ("192.168.1.10", DRIVE_PORT), Claim::Host);
    let period_ns = machine.period_ns.saturating_mul(u64::from(axis.divisor));
    let drive = LinUdpDrive {
        address,
        serial: serial(table),
        stream: stream(table, period_ns),
        monitor: monitor(table).unwrap_or_default(),
        reply_tag: table.word("reply_tag", &ReplyTag::WORDS).unwrap_or_default(),
        reply_within: reply_within(table, machine.period_ns),
        sto_after: table
            .time("sto_after", ..=60 * S, "how long the hardware enable (STO) has to be missing")
            .map_or(LinUdpDrive::STO_AFTER, Duration::from_nanos),
        leash: leash(table),
        axis,
    };
    // What says the same as a file without it is no other plan.
    let usual = LinUdpDrive { reply_within: None, ..drive.clone() }.replies_within();
    let drive = LinUdpDrive { reply_within: drive.reply_within.filter(|within| *within != usual), ..drive };
    table.later("simulate");
    table.faults(drive.faults(period_ns));
    drive
}

/// A number by which the drive is known, and the parameter that has it. With the parameter alone nothing is compared:
/// `pin` reads it.
fn serial(table: &mut Table<'_>) -> Option<Serial> {
    let number = table.integer("serial", 0..=u32::MAX.into(), "the number in the parameter serial_from");
    let from = table.read("serial_from", upid_form(), |value| {
        let wrong = "must be the UPID of a parameter of 32 bits with the serial number, like \"0x1234\"";
        upid(integer(value), value.as_str()).ok_or(wrong.into())
    });
    if number.is_some() && !table.gives("serial_from") {
        table.fault(
            "serial_from",
            "missing; serial needs the UPID of the parameter that has it, as LinMot-Talk shows it",
        );
    }
    Some(Serial { from: from?, number })
}

fn upid_form() -> Form {
    Form::integer(0..=u16::MAX.into()).or(Form::Text(None))
}

/// The parameter of a number, or of a text.
fn upid(number: Option<i128>, text: Option<&str>) -> Option<Upid> {
    let by_number = number.and_then(|number| u16::try_from(number).ok()).map(Upid);
    by_number.or_else(|| text.and_then(Upid::parse))
}

/// Which streaming command Follow uses. One that is named must fit the drive's period; where none is named it is the
/// richest one with the drive's own time base, if that fits, else none, and Follow is refused.
fn stream(table: &mut Table<'_>, period_ns: u64) -> Option<StreamCommand> {
    let mut words: Vec<(&str, Option<StreamCommand>)> =
        StreamCommand::ALL.iter().map(|command| (command.name(), Some(*command))).collect();
    words.push(("off", None));
    let usual = Some(StreamCommand::Pva).filter(|command| command.takes(period_ns));
    table.word("stream", &words).unwrap_or(usual)
}

/// `true`, `false`, or up to four variables by name or number.
fn monitor(table: &mut Table<'_>) -> Option<MonitorPlan> {
    const FORMS: &str = "must be true, false, or up to four variables like [\"demand-velocity\", \"0x1E10\"] \
        or UPIDs as numbers";
    let form = Form::Flag.or(upid_form().list(1, MONITOR_CHANNELS));
    table.read("monitor", form, |value| {
        if let Some(flag) = value.as_bool() {
            return Ok(if flag { MonitorPlan::AsSet } else { MonitorPlan::Off });
        }
        let names = || KNOWN.iter().map(|known| known.name);
        let sources = up_to(value, FORMS, |value| {
            let text = value.as_str();
            upid(integer(value), text)
                .ok_or_else(|| unknown("variable", text.unwrap_or_default(), names(), FORMS))
        });
        sources.map(MonitorPlan::Sources)
    })
}

/// For how many cycles a reply counts; `None`: as usual with this tag.
fn reply_within(table: &mut Table<'_>, period_ns: u64) -> Option<u32> {
    let hint = "for how many cycles a reply counts, 2 is that of its request and the next one";
    table.count("reply_within", 1..=MOST_EARLIER as i128 + 1, period_ns, hint)
}

fn leash(table: &mut Table<'_>) -> Option<f64> {
    let accepted = accepts_no_watchdog(table);
    let leash = table.number("leash", POSITIVE, "how far a jog or cyclic velocity runs ahead, in user units");
    let message = match (accepted, table.gives("leash")) {
        (Some(true), false) => {
            "missing; \"accept\" needs the distance that a jog may run on if the master dies"
        }
        (None, _) if leash.is_some() => "needs no_drive_watchdog = \"accept\"; add that, or leave leash out",
        // Refused for one drive against the defaults of its bus: no mistake.
        _ => return leash.filter(|_| accepted == Some(true)),
    };
    table.fault("leash", message);
    None
}
