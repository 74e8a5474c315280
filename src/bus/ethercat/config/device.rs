//! `[[bus.device]]` of `protocol = "ethercat"`: a slave that is no drive.

use super::slave;
use super::values::start;
use crate::bus::ethercat::{Area, Device, SlavePlan, TERMINAL_MAX};
use crate::keys::drive::name;
use crate::keys::machine::Machine;
use crate::keys::table::Table;
use crate::sim::ethercat::coupler::{Coupler, Terminals};
use crate::time::MS;

/// The most bytes of process data, each way.
const MOST_BYTES: i128 = TERMINAL_MAX as i128;
/// A device with outputs lets them go by itself after so long: the SyncManager watchdog as it is at power-on.
const WATCHDOG_NS: u64 = 100 * MS;

/// Reads one; its place comes later.
pub(super) fn device(table: &mut Table<'_>, machine: &mut Machine) -> Device {
    let name = name(table, machine, "device", "every device needs a name for programs and messages");
    let outputs = area(table, "outputs");
    let inputs = area(table, "inputs");
    let watchdog_ns = (outputs.length > 0).then_some(WATCHDOG_NS);
    let mut plan = SlavePlan { outputs, inputs, watchdog_ns, ..SlavePlan::new(0) };
    slave(table, &mut plan);
    let simulate = table.table("simulate", |table| Coupler {
        outputs: terminals(table, "outputs", outputs.length),
        inputs: terminals(table, "inputs", inputs.length),
    });
    Device { name, slave: plan, simulate }
}

/// Where its process data of one direction are; none if the key is absent.
fn area(table: &mut Table<'_>, key: &'static str) -> Area {
    let given = table.gives(key);
    table.table(key, |table| {
        if given {
            table.require("start", "their start address, like 0x1000");
            table.require("length", "their number of bytes");
        }
        Area {
            start: start(table, "start").unwrap_or(0x1000),
            length: table.integer("length", 1..=MOST_BYTES, "their number of bytes").unwrap_or(0),
        }
    })
}

/// How many terminals its simulation has; digital ones, as far as they go, if the file says nothing.
fn terminals(table: &mut Table<'_>, key: &'static str, bytes: u16) -> Terminals {
    let usual = terminals_of(bytes);
    if !table.gives(key) {
        table.sub_table(key).finish();
        return usual;
    }
    let count = "how many terminals";
    table.table(key, |table| Terminals {
        digital: table.integer("digital", 0..=255, count).unwrap_or(0),
        analogue: table.integer("analogue", 0..=255, count).unwrap_or(0),
    })
}

/// Up to 31 bytes all digital; more are analogue words, and one digital byte where they are odd.
fn terminals_of(bytes: u16) -> Terminals {
    match u8::try_from(bytes).ok().filter(|bytes| *bytes <= 31) {
        Some(bytes) => Terminals { digital: bytes * 8, analogue: 0 },
        None => Terminals {
            digital: if bytes.is_multiple_of(2) { 0 } else { 8 },
            analogue: u8::try_from(bytes / 2).unwrap_or(u8::MAX),
        },
    }
}
