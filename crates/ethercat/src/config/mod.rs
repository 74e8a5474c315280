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
use fieldbeat_keys::bus::{accepts_no_watchdog, devices, drive_tables, drive_tables_if_any, interface};
use fieldbeat_keys::drive::{Counts, axis};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::keys;
use fieldbeat_keys::machine::Machine;
use fieldbeat_keys::table::{POSITIVE, Table, integer, set};

keys! {
    INTERFACE "interface" = "-": "network interface of the segment, `\"eth1\"`; `\"local:NAME\"` is a "
        "segment of simulated drives on this computer";
    SYNC_AHEAD "sync_ahead" = "(half of the period)": "how long before SYNC0 a frame leaves the master";
    LRW "lrw" = "true": "outputs and inputs share one LRW datagram, which all slaves have to support; "
        "`false`: LWR and LRD";
    POSITION "position" = "(one more than the slave before it in the file)":
        "position in the segment; 0 is next to the master";
    TYPE "type" = "s700": "`\"s300\"`, `\"s400\"`, `\"s600\"` and `\"s700\"` have the same defaults; or "
        "`\"akd\"`";
    CHECK_PRBASE "check_prbase" = "true": "compares 608Fh:1 / 608Fh:2 of the drive with `prbase`";
    SETPOINTS "setpoints" = "master": "`\"native\"`: all targets are the application's, by native outputs; "
        "the master drives none";
    NO_DRIVE_WATCHDOG "no_drive_watchdog" = "refuse": "without a time in `watchdog`: velocities and "
        "torques are refused, or allowed by `\"accept\"`";
    HOME_METHOD "home_method" = "(as set in the drive)": "homing method (6098h), -128 ... 127";
    ABSOLUTE "absolute" = "false": "its encoder is absolute: it is homed from the start. See "
        "[below](#when-a-drive-is-homed)";
    MONITOR "monitor" = "false": "up to four objects that are shown with the feedback, read by the mailbox "
        "in turns";
    SYNC "sync" = "(`true` of a drive, `false` of a device)": "the slave works by SYNC0 of its distributed "
        "clock; `false`: by the arrival of the frame. Its cycle time, 60C2h, is written with `true` only, "
        "and is optional even then: a drive without it, or that only lets it be read, is named once, and "
        "has to find its cycle by SYNC0 or by a parameter of its own";
    CHECK_SII "check_sii" = "true": "compares mailboxes and process data in the SII with the "
        "configuration: start addresses, the lengths of mailboxes, and those of process data of a device "
        "unless `start_up` selects or maps PDOs (`0x1600` ... `0x1BFF`, `0x1C10` ... `0x1C2F`)";
    SDO_TIMEOUT "sdo_timeout" = "2s": "how long the slave may take for one SDO answer, `\"10ms\"` ... "
        "`\"60s\"`: the `ResponseTimeout` of its description (ESI). A lost or late answer is requested "
        "again, up to three times in all";
    STATE_TIMEOUT "state_timeout" = "5s": "how long the slave may take for one change of state, and twice "
        "that into OP, `\"100ms\"` ... `\"60s\"`: the state machine time-outs of its description (ESI)";
    START_UP "start_up" = "[]": "objects written in PREOP: `[{ object = \"0x35D5:1\", value = 4 }]`; up to "
        "4 bytes each; with a mailbox of more than 16 bytes also strings of up to 128: `{ object = "
        "\"0x8005:0.text\", value = \"left axis\" }`, `{ object = \"0x8005:1.octets\", value = \"01 A0 "
        "FF\" }`";
    WATCHDOG "watchdog" = "(as its SII has it)": "SyncManager watchdog: without outputs for so long, "
        "`\"100us\"` ... `\"6553.5ms\"`, the slave falls back by itself; or `\"off\"`. Most digital output "
        "terminals have one of 100 ms. See [below](#the-watchdog-of-a-slave)";
    OUTPUTS "outputs" = "\"0x1702\"": "process data to the drive: a known fixed PDO (`\"0x1701\"` "
        "position, `\"0x1702\"` velocity, `\"0x1703\"` torque), a list of objects to map, or `{ pdo = "
        "\"0x1704\", objects = [...] }`";
    INPUTS "inputs" = "(`\"0x1B03\"`; AKD `\"0x1B24\"`)": "process data from the drive";
    MAPPING "mapping" = "(by the PDOs)": "`\"fixed\"`: PDOs are selected; `\"free\"`: the master maps the "
        "objects; `\"as-is\"`: nothing is written";
    BUFFERS_OUTPUTS "outputs" = "0x1100": "start address of the process data to the drive";
    BUFFERS_INPUTS "inputs" = "0x1140": "start address of the process data from the drive";
    MODE "mode" = "(by the first target in `pdo.outputs`)": "mode of operation (6060h), a number or a "
        "name: it decides which target is driven. See [below](#what-is-in-the-outputs-of-a-drive)";
    PRBASE "prbase" = "20": "increments of one turn as a power of two (PRBASE of the drive)";
    VELOCITY_RPM_PER_COUNT "velocity_rpm_per_count" = "(2^20 increments a turn per 250 us; AKD `0.001`)":
        "rpm of one count of the velocity setpoint";
    TORQUE_PERMILLE_PER_COUNT "torque_permille_per_count" = "1": "per mille of the rated torque or current "
        "of one count of the torque setpoint";
    RATED_CURRENT "rated_current" = "none": "rated current of the motor, A; needed to report the current";
}

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "Kollmorgen S300 ... S700",
    read: bus,
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

/// What no two drives have in common.
const OWN: &[&str] = &["name", "position", "serial", "alias", "identification"];

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let interface = interface(
        table,
        machine,
        INTERFACE,
        "the name of a network interface, like \"eth1\", or \"local:NAME\"",
    )
    .unwrap_or_default();
    let is_known = !interface.is_empty();
    // Terminals alone are a segment, too.
    let of_drives = if table.gives("device") { drive_tables_if_any } else { drive_tables };
    let (mut drives, mut devices) = (of_drives(table, OWN), devices(table));
    let mut plan = EthercatPlan { name, ..EthercatPlan::new(interface, Vec::new()) };
    plan.ahead_of_sync_ns = table.time(SYNC_AHEAD, US..=S);
    set(&mut plan.lrw, table.flag(LRW));
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
        slave.place = table.integer(POSITION, 0..=LAST_PLACE.into()).unwrap_or(next);
        next = slave.place.saturating_add(1);
    }
}

fn drive(table: &mut Table<'_>, machine: &mut Machine) -> KollmorgenDrive {
    let types = ["s300", "s400", "s600", "s700"].map(|name| (name, Family::S700));
    let types: Vec<(&str, Family)> = types.into_iter().chain([("akd", Family::Akd)]).collect();
    let family = table.word(TYPE, &types).unwrap_or_default();
    let mut drive = KollmorgenDrive::new("", 0, family);
    scaling(table, &mut drive.scaling);
    set(&mut drive.check_prbase, table.flag(CHECK_PRBASE));
    drive.axis = axis(table, machine, Counts::revolutions(drive.scaling.increments()));
    slave(table, &mut drive.slave);
    pdos(table, &mut drive);
    drive.mode = mode(table);
    set(&mut drive.native, table.word(SETPOINTS, &[("master", false), ("native", true)]));
    set(&mut drive.accept_no_watchdog, accepts_no_watchdog(table, NO_DRIVE_WATCHDOG));
    drive.home_method = table.integer(HOME_METHOD, -128..=127);
    set(&mut drive.absolute, table.flag(ABSOLUTE));
    let wrong = format!("must be false, or up to {MONITOR_CHANNELS} objects like [\"torque\", \"0x6061:0\"]");
    set(&mut drive.show, table.some_of(MONITOR, Form::Text(None), &wrong, object));
    table.later("simulate");
    drive
}

/// What every slave with a mailbox has, drive or not.
pub(super) fn slave(table: &mut Table<'_>, slave: &mut SlavePlan) {
    identity(table, &mut slave.identity);
    slave.mailbox = mailbox(table, slave.mailbox);
    set(&mut slave.sync, table.flag(SYNC));
    set(&mut slave.check_sii, table.flag(CHECK_SII));
    set(&mut slave.sdo_timeout_ns, table.time(SDO_TIMEOUT, SDO_TIMEOUTS));
    set(&mut slave.state_timeout_ns, table.time(STATE_TIMEOUT, STATE_TIMEOUTS));
    set(&mut slave.start_up, table.read(START_UP, start_up_form(), start_up));
    let watchdog = table.time_or_off(WATCHDOG, 100 * US..=WATCHDOG_MAX_NS);
    set(&mut slave.watchdog, watchdog.map(|ns| ns.map_or(Watchdog::Off, Watchdog::After)));
}

fn pdos(table: &mut Table<'_>, drive: &mut KollmorgenDrive) {
    let family = drive.family;
    table.table("pdo", |table| {
        for (key, free, place) in [(OUTPUTS, 0x1600, &mut drive.outputs), (INPUTS, 0x1A00, &mut drive.inputs)]
        {
            set(place, table.read(key, layout_form(), |value| layout(value, family, free)));
        }
    });
    drive.fit();
    // Fixed ones are 17xxh and 1Bxxh.
    let is_free = [&drive.outputs, &drive.inputs].iter().all(|layout| layout.pdo & 0x0100 == 0);
    let usual = if is_free { Mapping::Free } else { Mapping::Fixed };
    let words = [("fixed", Mapping::Fixed), ("free", Mapping::Free), ("as-is", Mapping::AsIs)];
    drive.mapping = table.word(MAPPING, &words).unwrap_or(usual);
    table.table("buffers", |table| {
        let slave = &mut drive.slave;
        for (key, area) in [(BUFFERS_OUTPUTS, &mut slave.outputs), (BUFFERS_INPUTS, &mut slave.inputs)] {
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
    table.read(MODE, form, |value| {
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
    set(&mut scaling.prbase, table.integer(PRBASE, 1..=31));
    let rpm = table.number(VELOCITY_RPM_PER_COUNT, POSITIVE);
    set(&mut scaling.rpm_per_count, rpm);
    let permille = table.number(TORQUE_PERMILLE_PER_COUNT, POSITIVE);
    set(&mut scaling.permille_per_count, permille);
    scaling.rated_current = table.number(RATED_CURRENT, POSITIVE);
}
