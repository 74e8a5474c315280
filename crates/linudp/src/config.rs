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
use fieldbeat_keys::keys;
use fieldbeat_keys::machine::{Claim, Machine};
use fieldbeat_keys::table::{POSITIVE, Table, integer, up_to};
use fieldbeat_keys::value::unknown;

keys! {
    BIND "bind" = "-": "address of the network adapter that the drives are on: `\"192.168.1.1\"`, or with "
        "another port than 41136. Drives ignore requests from a port that they are not parameterised for";
    ADDRESS "address" = "-": "address of the drive: `\"192.168.1.10\"`, or with another port than 49360. "
        "One drive per IP address";
    REPLY_TAG "reply_tag" = "definition": "what distinguishes a late or repeated reply from the newest "
        "one. `\"definition\"`: each request names other blocks than the one before it, so that eight "
        "consecutive replies differ (four, if monitoring channels are shown). `\"count\"`: each request "
        "carries a new count on the parameter channel, 8 bytes more in both directions. `\"off\"`: "
        "nothing, the reply after a missed exchange is not trusted";
    STO_AFTER "sto_after" = "10ms": "how long the drive reports no voltage enable, although the master "
        "allows it, until its hardware enable (STO) counts as missing; its status may be some milliseconds "
        "old. Below `enable_timeout`. A hardware enable that was there and goes is reported by the second "
        "reply in a row that says so";
    SERIAL "serial" = "none": "required number in the parameter `serial_from`, 0 ... 4294967295: it is "
        "read by the probes before anything is written, and after each loss of the link. A drive with "
        "another one stays not connected, and one line has both. Without it whatever drive answers at the "
        "address is taken";
    SERIAL_FROM "serial_from" = "none": "UPID of the parameter of 32 bits with that number, `\"0x1234\"`, "
        "as LinMot-Talk shows it: no public document names one. With it alone nothing is compared, and "
        "`fieldbeat pin` shows the number";
    STREAM "stream" = "(`\"pva\"` if the period fits, else `\"off\"`)":
        "command of streamed motion: `\"p\"`, `\"pv\"`, `\"pva\"`, `\"p-configured\"`, "
        "`\"pv-configured\"`, `\"pva-configured\"`, or `\"off\"`";
    MONITOR "monitor" = "false": "up to four monitoring variables by name or UPID, such as "
        "`[\"demand-velocity\", \"0x1E10\"]`: the master sets the drive's channels to them, in RAM, "
        "whenever it comes online. `true` shows what is set in the drive";
    REPLY_WITHIN "reply_within" = "(`2`, without a tag `1`)": "for how many cycles a reply counts, that of "
        "its request included; a number, or a time such as `\"2ms\"`. Requests go on meanwhile. A reply of "
        "a later cycle answers the request that its tag names, and is feedback with that age. At most 7, "
        "with `monitor` 3 (unless `reply_tag = \"count\"`), without a tag 1. Each cycle more is one more "
        "until a dead drive is lost";
    NO_DRIVE_WATCHDOG "no_drive_watchdog" = "refuse": "a LinUDP drive has no watchdog: jogs and cyclic "
        "velocities are refused, or allowed by `\"accept\"` with a `leash`";
    LEASH "leash" = "(required by `\"accept\"`)": "distance, units, that the target of a jog or velocity "
        "runs ahead of the axis, and that the axis runs on if the master dies; at most the range";
}

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "LinMot LinUDP V2",
    read: bus,
    outline: outline::OUTLINE,
    telegrams: telegrams::TELEGRAMS,
};

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let bind = bind(table, machine, (BIND, MASTER_PORT), None);
    let drives = drives(table, |table, _| drive(table, machine, bind));
    Box::new(LinUdpPlan { name, bind: bind.unwrap_or(NOWHERE), drives })
}

const COUNTS: Counts =
    Counts { what: "drive counts", unit: Unit::Millimetre, per_unit: COUNTS_PER_MM, wire: 1.0 };

fn drive(table: &mut Table<'_>, machine: &mut Machine, bind: Option<SocketAddrV4>) -> LinUdpDrive {
    let axis = axis(table, machine, COUNTS);
    let bind = bind.map(|bind| *bind.ip());
    let address = address(table, machine, bind, ADDRESS, ("192.168.1.10", DRIVE_PORT), Claim::Host);
    let period_ns = machine.period_ns.saturating_mul(u64::from(axis.divisor));
    let drive = LinUdpDrive {
        address,
        serial: serial(table),
        stream: stream(table, period_ns),
        monitor: monitor(table).unwrap_or_default(),
        reply_tag: table.word(REPLY_TAG, &ReplyTag::WORDS).unwrap_or_default(),
        reply_within: reply_within(table, machine.period_ns),
        sto_after: table.time(STO_AFTER, ..=60 * S).map_or(LinUdpDrive::STO_AFTER, Duration::from_nanos),
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
    let number = table.integer(SERIAL, 0..=u32::MAX.into());
    let from = table.read(SERIAL_FROM, upid_form(), |value| {
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
    table.word(STREAM, &words).unwrap_or(usual)
}

/// `true`, `false`, or up to four variables by name or number.
fn monitor(table: &mut Table<'_>) -> Option<MonitorPlan> {
    const FORMS: &str = "must be true, false, or up to four variables like [\"demand-velocity\", \"0x1E10\"] \
        or UPIDs as numbers";
    let form = Form::Flag.or(upid_form().list(1, MONITOR_CHANNELS));
    table.read(MONITOR, form, |value| {
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
    table.count(REPLY_WITHIN, 1..=MOST_EARLIER as i128 + 1, period_ns)
}

fn leash(table: &mut Table<'_>) -> Option<f64> {
    let accepted = accepts_no_watchdog(table, NO_DRIVE_WATCHDOG);
    let leash = table.number(LEASH, POSITIVE);
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
