//! `[[bus.device]]` of `protocol = "ethercat"`: a slave that is no drive.

use toml::de::DeValue;

use super::slave;
use super::values::start;
use crate::{Area, Device, SlavePlan, TERMINAL_MAX};
use fieldbeat_keys::drive::name;
use fieldbeat_keys::form::Form;
use fieldbeat_keys::key::Key;
use fieldbeat_keys::keys;
use fieldbeat_keys::machine::Machine;
use fieldbeat_keys::table::{Table, elements};

keys! {
    OUTPUTS "outputs" = "none": "where the outputs are, from `0x0F00` on, or a list of several "
        "SyncManagers: `[{ start = 0x0F00, length = 1 }, { start = 0x0F01, length = 1 }]`, at most 4; the "
        "application's bytes are those of all areas, in this order";
    INPUTS "inputs" = "none": "where the inputs are, likewise";
    START "start" = "-": "start address of the process data, like `0x1000`";
    LENGTH "length" = "-": "bytes of the process data";
}

/// The most bytes of process data, each way.
const MOST_BYTES: i128 = TERMINAL_MAX as i128;

/// Reads one; its place comes later.
pub(super) fn device(table: &mut Table<'_>, machine: &mut Machine) -> Device {
    let name = name(table, machine, "device");
    let outputs = areas(table, OUTPUTS);
    let inputs = areas(table, INPUTS);
    let mut plan = SlavePlan { outputs, inputs, ..SlavePlan::new(0) };
    slave(table, &mut plan);
    table.later("simulate");
    Device { name, slave: plan }
}

/// Where its process data of one direction are: a table, or a list of them; none if the key is absent.
fn areas(table: &mut Table<'_>, key: Key) -> Vec<Area> {
    let is_list = table.read(key, Form::Table.or(Form::Tables), |value| {
        let is_list = elements(value, 1..).is_some_and(|mut all| all.all(DeValue::is_table));
        let is_known = is_list || value.is_table();
        is_known.then_some(is_list).ok_or("must be { start = 0x1000, length = 1 }, or a list of them".into())
    });
    let read = |mut table: Table<'_>| {
        let area = area(&mut table);
        table.finish();
        area
    };
    match is_list {
        Some(true) => table.tables(key).into_iter().map(read).collect(),
        Some(false) => vec![table.table(key, area)],
        None if table.is_recorded() => vec![table.table(key, area)],
        None => Vec::new(),
    }
}

fn area(table: &mut Table<'_>) -> Area {
    Area {
        start: start(table, START).unwrap_or(0x1000),
        length: table.integer(LENGTH, 1..=MOST_BYTES).unwrap_or(1),
    }
}
