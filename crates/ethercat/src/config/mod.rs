//! `protocol = "ethercat"`: the segment and its drives.

mod device;
mod outline;
mod telegrams;
mod tools;
mod values;

pub use self::tools::TOOLS;

use fieldbeat_keys::Protocol;

use std::ops::RangeInclusive;

use device::device;
use values::{identity, layout, layout_form, mailbox, object, start, start_up, start_up_form};

use super::PROTOCOL;
use super::mode::Mode;
use super::object::Family;
use super::plan::{EthercatPlan, KollmorgenDrive, Mapping, Owner, Scaling, SlavePlan, Watchdog};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::bus::BusPlan;
use fieldbeat_core::time::{MS, S, US};
use fieldbeat_keys::bus::{accepts_no_watchdog, drive_tables, drive_tables_if_any, interface};
use fieldbeat_keys::drive::{Counts, axis};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::machine::Machine;
use fieldbeat_keys::table::{POSITIVE, Table, integer, set};

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "Kollmorgen S300 ... S700",
    read: bus,
    reference: include_str!("../../files/configuration-ethercat.md"),
    specimen: SPECIMEN,
    outline: outline::OUTLINE,
    telegrams: telegrams::TELEGRAMS,
};

/// The last place of a slave.
const LAST_PLACE: u16 = 255;
/// The longest that register 0420h counts, ns.
const WATCHDOG_MAX_NS: u64 = u16::MAX as u64 * 100 * US;

/// What a slave may take to answer an SDO, ns.
const SDO_TIMEOUTS: RangeInclusive<u64> = 10 * MS..=60 * S;
/// The range of `state_timeout`.
const STATE_TIMEOUTS: RangeInclusive<u64> = 100 * MS..=60 * S;

/// What its interface is, where it is missing and where it is wrong.
const INTERFACE: [&str; 2] = [
    "the network interface of the segment, like \"eth1\", or \"local:NAME\" for simulated slaves on this \
     computer",
    "the name of a network interface, like \"eth1\"",
];

/// With each table that may be missing.
pub const SPECIMEN: &str = "interface = \"local:x\"\n[[bus.drive]]\nname = \"x\"\nmailbox = {}\n\
     [[bus.device]]\nname = \"y\"\n\
     outputs = {}\ninputs = {}\nmailbox = {}\nsimulate = { behind = {}, outputs = {}, inputs = {} }\n\
     [[bus.device]]\nname = \"z\"\noutputs = [{}]\ninputs = [{}]\n";

/// What no two drives have in common.
const OWN: &[&str] = &["name", "position", "serial", "alias", "identification"];

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let interface = interface(table, machine, "interface", INTERFACE).unwrap_or_default();
    let is_known = !interface.is_empty();
    // Terminals alone are a segment, too.
    let of_drives = if table.gives("device") { drive_tables_if_any } else { drive_tables };
    let (mut drives, mut devices) = (of_drives(table, OWN), table.tables("device"));
    let mut plan = EthercatPlan { name, ..EthercatPlan::new(interface, Vec::new()) };
    let ahead = "the time between the departure of a frame and SYNC0";
    plan.ahead_of_sync_ns = table.time("sync_ahead", US..=S, ahead);
    set(&mut plan.lrw, table.flag("lrw"));
    plan.drives = drives.iter_mut().map(|table| drive(table, machine)).collect();
    plan.devices = devices.iter_mut().map(|table| device(table, machine)).collect();
    table.later("simulate");
    place(&mut plan, &mut drives, &mut devices);
    for (owner, fault) in plan.findings(machine.period_ns) {
        match owner {
            Some(Owner::Drive(index)) => drives[index].fault(fault.key, fault.message),
            Some(Owner::Device(index)) => devices[index].fault(fault.key, fault.message),
            None if fault.key == "period" => machine.periods.push(fault.message),
            None if fault.key == "interface" && !is_known => {} // Missing, or already reported.
            None => table.fault(fault.key, fault.message),
        }
    }
    drives.into_iter().chain(devices).for_each(Table::finish);
    Box::new(plan)
}

/// Gives each slave its place: its own one, or the one behind the slave before it in the file.
fn place<'a>(plan: &mut EthercatPlan, drives: &mut [Table<'a>], devices: &mut [Table<'a>]) {
    let of_drives = plan.drives.iter_mut().map(|drive| &mut drive.slave).zip(drives);
    let of_devices = plan.devices.iter_mut().map(|device| &mut device.slave).zip(devices);
    let mut slaves: Vec<(&mut SlavePlan, &mut Table<'a>)> = of_drives.chain(of_devices).collect();
    slaves.sort_by_key(|(_, table)| table.line());
    let mut next = 0;
    for (slave, table) in slaves {
        let hint = "its place in the segment: 0 is next to the master";
        slave.place = table.integer("position", 0..=LAST_PLACE.into(), hint).unwrap_or(next);
        next = slave.place.saturating_add(1);
    }
}

fn drive(table: &mut Table<'_>, machine: &mut Machine) -> KollmorgenDrive {
    let types = ["s300", "s400", "s600", "s700"].map(|name| (name, Family::S700));
    let types: Vec<(&str, Family)> = types.into_iter().chain([("akd", Family::Akd)]).collect();
    let family = table.word("type", &types).unwrap_or_default();
    let mut drive = KollmorgenDrive::new("", 0, family);
    scaling(table, &mut drive.scaling);
    set(&mut drive.check_prbase, table.flag("check_prbase"));
    drive.axis = axis(table, machine, Counts::revolutions(drive.scaling.increments()));
    slave(table, &mut drive.slave);
    pdos(table, &mut drive);
    drive.mode = mode(table);
    set(&mut drive.native, table.word("setpoints", &[("master", false), ("native", true)]));
    set(&mut drive.accept_no_watchdog, accepts_no_watchdog(table));
    let method = "the method of homing of object 6098h; leave it out for the drive's own";
    drive.home_method = table.integer("home_method", -128..=127, method);
    set(&mut drive.absolute, table.flag("absolute"));
    let wrong = format!("must be false, or up to {MONITOR_CHANNELS} objects like [\"torque\", \"0x6061:0\"]");
    set(&mut drive.show, table.some_of("monitor", Form::Text(None), &wrong, object));
    table.later("simulate");
    drive
}

/// What every slave with a mailbox has, drive or not.
pub(super) fn slave(table: &mut Table<'_>, slave: &mut SlavePlan) {
    identity(table, &mut slave.identity);
    slave.mailbox = mailbox(table, slave.mailbox);
    set(&mut slave.sync, table.flag("sync"));
    set(&mut slave.check_sii, table.flag("check_sii"));
    let hint = "the time that the slave may take to answer an SDO, from its description (ESI)";
    set(&mut slave.sdo_timeout_ns, table.time("sdo_timeout", SDO_TIMEOUTS, hint));
    let hint = "the time that the slave may take to enter a state, from its description (ESI)";
    set(&mut slave.state_timeout_ns, table.time("state_timeout", STATE_TIMEOUTS, hint));
    set(&mut slave.start_up, table.read("start_up", start_up_form(), start_up));
    let hint = "the slave stops by itself after this time without outputs; or \"off\"";
    let watchdog = table.time_or_off("watchdog", 100 * US..=WATCHDOG_MAX_NS, hint);
    set(&mut slave.watchdog, watchdog.map(|ns| ns.map_or(Watchdog::Off, Watchdog::After)));
}

fn pdos(table: &mut Table<'_>, drive: &mut KollmorgenDrive) {
    let family = drive.family;
    table.table("pdo", |table| {
        for (key, free, place) in
            [("outputs", 0x1600, &mut drive.outputs), ("inputs", 0x1A00, &mut drive.inputs)]
        {
            set(place, table.read(key, layout_form(), |value| layout(value, family, free)));
        }
    });
    drive.fit();
    // Fixed ones are 17xxh and 1Bxxh.
    let is_free = [&drive.outputs, &drive.inputs].iter().all(|layout| layout.pdo & 0x0100 == 0);
    let usual = if is_free { Mapping::Free } else { Mapping::Fixed };
    let words = [("fixed", Mapping::Fixed), ("free", Mapping::Free), ("as-is", Mapping::AsIs)];
    drive.mapping = table.word("mapping", &words).unwrap_or(usual);
    table.table("buffers", |table| {
        let slave = &mut drive.slave;
        for (key, area) in [("outputs", &mut slave.outputs), ("inputs", &mut slave.inputs)] {
            let start = start(table, key);
            if let Some((area, start)) = area.first_mut().zip(start) {
                area.start = start;
            }
        }
    });
}

/// The modes that have a name.
const MODES: [Mode; 9] = [
    Mode::PROFILE_POSITION,
    Mode::PROFILE_VELOCITY,
    Mode::TORQUE,
    Mode::INTERPOLATED,
    Mode::CYCLIC_POSITION,
    Mode::DIGITAL_VELOCITY,
    Mode::DIGITAL_CURRENT,
    Mode::TRAJECTORY,
    Mode::MOTION_TASK,
];

/// A number, as a drive shows it or as its bits, or the name with dashes.
fn mode(table: &mut Table<'_>) -> Option<Mode> {
    let names = MODES.map(|mode| mode.name().unwrap_or_default().replace(' ', "-"));
    let form = Form::integer(-128..=255).or(Form::words(names.iter().map(String::as_str)));
    table.read("mode", form, |value| {
        let bits =
            |number: i128| i8::try_from(number).or_else(|_| u8::try_from(number).map(|bits| bits as i8));
        let named = |text: &str| names.iter().zip(MODES).find(|(name, _)| *name == text);
        let mode = match integer(value) {
            Some(number) => bits(number).ok().map(Mode),
            None => value.as_str().and_then(named).map(|(_, mode)| mode),
        };
        mode.ok_or_else(|| format!("must be the number of a mode like 0x85, or one of {}", names.join(", ")))
    })
}

fn scaling(table: &mut Table<'_>, scaling: &mut Scaling) {
    let prbase = "the increments per turn as a power of two, PRBASE of the drive";
    set(&mut scaling.prbase, table.integer("prbase", 1..=31, prbase));
    let rpm = table.number("velocity_rpm_per_count", POSITIVE, "rpm of a count of the velocity setpoint");
    set(&mut scaling.rpm_per_count, rpm);
    let torque = "per mille of the rated torque or current";
    let permille = table.number("torque_permille_per_count", POSITIVE, torque);
    set(&mut scaling.permille_per_count, permille);
    scaling.rated_current = table.number("rated_current", POSITIVE, "of the motor, A");
}
