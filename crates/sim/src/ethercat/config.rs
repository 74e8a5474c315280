//! The keys of `simulate` of a bus with `protocol = "ethercat"`, of its drives and of its devices.

mod slave;

use self::slave::{Names, slave};
use super::coupler::Terminals;
use super::{
    Coupler, Dialect, DriveSettings, EthercatSegment, MotorSettings, SegmentSettings, SlaveSettings,
};
use crate::keys::faults;
use crate::{Carrier, SimBus};
use fieldbeat_core::time::{MS, US};
use fieldbeat_ethercat::{EthercatPlan, KollmorgenDrive};
use fieldbeat_keys::bus;
use fieldbeat_keys::form::Form;
use fieldbeat_keys::table::{Table, number};
use fieldbeat_keys::value::SOMETHING;

/// The most objects that one of its lists names.
const INDICES_MAX: usize = 32;
/// What `home_turns` must be.
const HOME: &str = "must be turns of the motor from its position at power-on, -1000 ... 1000, or \"none\"";

/// Reads the simulated segment of a `[[bus]]` that is read otherwise.
pub fn read(table: &mut Table<'_>, plan: &EthercatPlan, period_ns: u64) -> EthercatSegment {
    let mut drives = bus::drive_tables_if_any(table, &["name", "position"]);
    let mut devices = table.tables("device");
    let names = Names::of(plan);
    let mut settings = table.table("simulate", |table| segment(table, period_ns));
    let mut add = |place: u16, own: SlaveSettings| settings.slaves.insert(place, own);
    let simulated = EthercatSegment {
        drives: (drives.iter_mut().zip(&plan.drives))
            .map(|(table, drive)| {
                table.table("simulate", |table| {
                    let simulated = self::drive(table, drive);
                    add(drive.slave.place, slave(table, drive.slave.place, &names, false));
                    simulated
                })
            })
            .collect(),
        devices: (devices.iter_mut().zip(&plan.devices))
            .map(|(table, device)| {
                let Coupler { outputs, inputs } = Coupler::of(device);
                table.table("simulate", |table| {
                    add(device.slave.place, slave(table, device.slave.place, &names, true));
                    Coupler {
                        outputs: terminals(table, "outputs", outputs),
                        inputs: terminals(table, "inputs", inputs),
                    }
                })
            })
            .collect(),
        settings,
        plan: plan.clone(),
    };
    for (device, fault) in simulated.faults() {
        let of = |name: &String| Some(name) == device.as_ref();
        let place = plan.devices.iter().position(|known| of(&known.name));
        let drive = plan.drives.iter().position(|known| of(&known.axis.name));
        match (place, drive) {
            (Some(index), _) => devices[index].fault(fault.key, fault.message),
            (None, Some(index)) => drives[index].fault(fault.key, fault.message),
            (None, None) => table.fault(fault.key, fault.message),
        }
    }
    simulated
}

/// The segment as a whole.
fn segment(table: &mut Table<'_>, period_ns: u64) -> SegmentSettings {
    let default = SegmentSettings::default();
    let ppm = || Form::number(-1_000.0..=1_000.0);
    SegmentSettings {
        interface: table.text("interface", SOMETHING, "a network interface, like \"eth2\"", |text| {
            (!text.is_empty()).then(|| text.to_owned())
        }),
        drift_ppm: table
            .read("drift_ppm", ppm().or(ppm().any_list()), |value| {
                let one = |value| number(value).filter(|ppm| ppm.abs() <= 1_000.0);
                let several = || value.as_array()?.iter().map(|value| one(value.get_ref())).collect();
                one(value)
                    .map(|ppm| vec![ppm])
                    .or_else(several)
                    .ok_or("must be a number, or a list of numbers by place, -1000 ... 1000".into())
            })
            .unwrap_or(default.drift_ppm),
        delay_ns: table
            .time("line_delay", 0..=100 * US, "the time of a frame from one slave to the next")
            .unwrap_or(default.delay_ns),
        short_clocks: table.flag("short_clocks").unwrap_or(default.short_clocks),
        settling: table
            .integer("settling", 4..=10_000, "frames in which a clock removes most of a difference")
            .unwrap_or(default.settling),
        faults: faults(table, Carrier::Datagrams, period_ns.min(10 * MS), 0),
        ..default
    }
}

fn drive(table: &mut Table<'_>, drive: &KollmorgenDrive) -> DriveSettings {
    let default = DriveSettings::new(drive.family);
    let units = &drive.axis.units;
    let reach = |end: i32| f64::from(end) / units.counts_per_unit + units.offset;
    let (low, high) = (reach(i32::MIN), reach(i32::MAX));
    let start = table.number("start", low.min(high)..=low.max(high), "the position at power-on, units");
    let start = start.map(|start| ((start - units.offset) * units.counts_per_unit).round() as i32);
    DriveSettings {
        // It is the drive that this file wants.
        prbase: drive.scaling.prbase,
        rpm_per_count: drive.scaling.rpm_per_count,
        permille_per_count: drive.scaling.permille_per_count,
        dialect: table
            .word("dialect", &[("standard", Dialect::Standard), ("manual", Dialect::Manual)])
            .unwrap_or(default.dialect),
        serial: table
            .integer("serial", 0..=u32::MAX.into(), "the serial number")
            .or(drive.slave.identity.serial)
            .unwrap_or(default.serial),
        position: start.unwrap_or(default.position),
        home_turns: table
            .read("home", Form::number(-1_000.0..=1_000.0).or(Form::word("none")), |value| {
                let turns = || number(value).filter(|turns| turns.abs() <= 1_000.0);
                match value.as_str() {
                    Some("none") => Ok(None),
                    _ => turns().map(Some).ok_or_else(|| HOME.into()),
                }
            })
            .unwrap_or(default.home_turns),
        without: indices(table, "without"),
        read_only: indices(table, "read_only"),
        interrupts_to_sync: table
            .integer("sync_after", 1..=1_000_000, "cycles inside of the window until it is synchronous")
            .unwrap_or(default.interrupts_to_sync),
        hardware_enable: table.flag("hardware_enable").unwrap_or(default.hardware_enable),
        motor: motor(table, default.motor.clone()),
        ..default
    }
}

/// Objects by their index.
fn indices(table: &mut Table<'_>, key: &'static str) -> Vec<u16> {
    table.integers(key, INDICES_MAX, u16::MAX)
}

fn motor(table: &mut Table<'_>, mut motor: MotorSettings) -> MotorSettings {
    let MotorSettings { rated_nm, peak_permille, max_rpm, inertia_kgm2, friction_nm, .. } = &mut motor;
    for (key, range, hint, value) in [
        ("rated_torque", 0.001..=100_000.0, "rated torque of the motor, N m", rated_nm),
        (
            "peak_torque",
            1.0..=10_000.0,
            "the peak torque of the motor, per mille of the rated torque",
            peak_permille,
        ),
        ("max_speed", 1.0..=100_000.0, "the highest speed of the motor, rpm", max_rpm),
        ("inertia", 1e-9..=1e6, "the inertia of all rotating parts, kg m²", inertia_kgm2),
        ("friction", 0.0..=100_000.0, "the friction torque of the machine at any speed, N m", friction_nm),
    ] {
        *value = table.number(key, range, hint).unwrap_or(*value);
    }
    motor
}

/// How many terminals its simulation has; digital ones, as far as they go, if the file says nothing.
fn terminals(table: &mut Table<'_>, key: &'static str, usual: Terminals) -> Terminals {
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
