//! `[[bus.device]]` of `protocol = "ethercat"`: a slave that is no drive.

use super::slave;
use super::values::start;
use crate::bus::ethercat::{Area, Device, SlavePlan, TERMINAL_MAX};
use crate::keys::drive::name;
use crate::keys::machine::Machine;
use crate::keys::table::Table;
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
    table.later("simulate");
    Device { name, slave: plan }
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
