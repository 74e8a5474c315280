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
use fieldbeat_keys::key::Key;
use fieldbeat_keys::keys;
use fieldbeat_keys::table::{Table, number};
use fieldbeat_keys::value::SOMETHING;

keys! {
    INTERFACE "interface" = "(required on a real interface)": "network interface at the drives' end of the "
        "cable";
    DRIFT_PPM "drift_ppm" = "[]": "how much faster the slaves' clocks run than this computer's, by "
        "position; the last value holds for all slaves behind it";
    LINE_DELAY "line_delay" = "500ns": "propagation time from one slave to the next";
    SHORT_CLOCKS "short_clocks" = "false": "the clocks have 32 bits instead of 64";
    SETTLING "settling" = "32": "frames in which a clock removes most of a difference to the reference, 4 "
        "... 10000; a real one takes about 1000, and some thousand until it has settled";
    START "start" = "0": "position at power-on, units";
    DIALECT "dialect" = "standard": "format of SDO replies: as in the standard, or as the drive's "
        "`\"manual\"` prints it";
    SERIAL "serial" = "(as `serial` of the drive, else `0`)": "serial number";
    HOME "home" = "0.5": "position of the home switch, turns of the motor from the position at power-on; "
        "or `\"none\"`";
    WITHOUT "without" = "[]": "objects that it does not have, by their index: `[0x60C2, 0x1002]`; up to 32";
    READ_ONLY "read_only" = "[]": "objects that it only lets be read";
    SYNC_AFTER "sync_after" = "100": "cycles inside the window until the drive is synchronous";
    HARDWARE_ENABLE "hardware_enable" = "true": "STO is closed";
    RATED_TORQUE "rated_torque" = "5": "rated torque of the motor, N m";
    PEAK_TORQUE "peak_torque" = "3000": "largest torque of the motor, per mille of the rated torque";
    MAX_SPEED "max_speed" = "6000": "largest speed of the motor, rpm";
    INERTIA "inertia" = "0.002": "inertia of all rotating parts, kg m²";
    FRICTION "friction" = "0.1": "load torque at any speed, N m";
    DIGITAL "digital" = "0": "number of its digital terminals, a bit each; without this table they are as "
        "many as fit";
    ANALOGUE "analogue" = "0": "number of its analogue terminals, a word of 16 bits each";
}

/// The most objects that one of its lists names.
const INDICES_MAX: usize = 32;

/// Reads the simulated segment of a `[[bus]]` that is read otherwise.
pub fn read(table: &mut Table<'_>, plan: &EthercatPlan, period_ns: u64) -> EthercatSegment {
    let mut drives = bus::drive_tables_if_any(table, &["name", "position"]);
    let mut devices = bus::devices(table);
    let names = Names::of(plan);
    let mut settings = bus::simulated_wire(table, |table| segment(table, period_ns));
    let mut add = |place: u16, own: SlaveSettings| settings.slaves.insert(place, own);
    let simulated = EthercatSegment {
        drives: (drives.iter_mut().zip(&plan.drives))
            .map(|(table, drive)| {
                bus::simulated_slave(table, |table| {
                    let simulated = self::drive(table, drive);
                    add(drive.slave.place, slave(table, drive.slave.place, &names, false));
                    simulated
                })
            })
            .collect(),
        devices: (devices.iter_mut().zip(&plan.devices))
            .map(|(table, device)| {
                let Coupler { outputs, inputs } = Coupler::of(device);
                bus::simulated_slave(table, |table| {
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
        interface: table.text(INTERFACE, SOMETHING, "a network interface, like \"eth2\"", |text| {
            (!text.is_empty()).then(|| text.to_owned())
        }),
        drift_ppm: table
            .read(DRIFT_PPM, ppm().or(ppm().any_list()), |value| {
                let one = |value| number(value).filter(|ppm| ppm.abs() <= 1_000.0);
                let several = || value.as_array()?.iter().map(|value| one(value.get_ref())).collect();
                one(value)
                    .map(|ppm| vec![ppm])
                    .or_else(several)
                    .ok_or("must be a number, or a list of numbers by place, -1000 ... 1000".into())
            })
            .unwrap_or(default.drift_ppm),
        delay_ns: table.time(LINE_DELAY, 0..=100 * US).unwrap_or(default.delay_ns),
        short_clocks: table.flag(SHORT_CLOCKS).unwrap_or(default.short_clocks),
        settling: table.integer(SETTLING, 4..=10_000).unwrap_or(default.settling),
        faults: faults(table, Carrier::Datagrams, period_ns.min(10 * MS), 0),
        ..default
    }
}

fn drive(table: &mut Table<'_>, drive: &KollmorgenDrive) -> DriveSettings {
    let default = DriveSettings::new(drive.family);
    let units = &drive.axis.units;
    let reach = |end: i32| f64::from(end) / units.counts_per_unit + units.offset;
    let (low, high) = (reach(i32::MIN), reach(i32::MAX));
    let start = table.number(START, low.min(high)..=low.max(high));
    let start = start.map(|start| ((start - units.offset) * units.counts_per_unit).round() as i32);
    DriveSettings {
        // It is the drive that this file wants.
        prbase: drive.scaling.prbase,
        rpm_per_count: drive.scaling.rpm_per_count,
        permille_per_count: drive.scaling.permille_per_count,
        dialect: table
            .word(DIALECT, &[("standard", Dialect::Standard), ("manual", Dialect::Manual)])
            .unwrap_or(default.dialect),
        serial: table
            .integer(SERIAL, 0..=u32::MAX.into())
            .or(drive.slave.identity.serial)
            .unwrap_or(default.serial),
        position: start.unwrap_or(default.position),
        home_turns: table
            .read(HOME, Form::number(-1_000.0..=1_000.0).or(Form::word("none")), |value| {
                let turns = || number(value).filter(|turns| turns.abs() <= 1_000.0);
                match value.as_str() {
                    Some("none") => Ok(None),
                    _ => turns()
                        .map(Some)
                        .ok_or("must be -1000 ... 1000 turns of the motor, or \"none\"".into()),
                }
            })
            .unwrap_or(default.home_turns),
        without: indices(table, WITHOUT),
        read_only: indices(table, READ_ONLY),
        interrupts_to_sync: table.integer(SYNC_AFTER, 1..=1_000_000).unwrap_or(default.interrupts_to_sync),
        hardware_enable: table.flag(HARDWARE_ENABLE).unwrap_or(default.hardware_enable),
        motor: motor(table, default.motor.clone()),
        ..default
    }
}

/// Objects by their index.
fn indices(table: &mut Table<'_>, key: Key) -> Vec<u16> {
    table.integers(key, INDICES_MAX, u16::MAX)
}

fn motor(table: &mut Table<'_>, mut motor: MotorSettings) -> MotorSettings {
    let MotorSettings { rated_nm, peak_permille, max_rpm, inertia_kgm2, friction_nm, .. } = &mut motor;
    for (key, range, value) in [
        (RATED_TORQUE, 0.001..=100_000.0, rated_nm),
        (PEAK_TORQUE, 1.0..=10_000.0, peak_permille),
        (MAX_SPEED, 1.0..=100_000.0, max_rpm),
        (INERTIA, 1e-9..=1e6, inertia_kgm2),
        (FRICTION, 0.0..=100_000.0, friction_nm),
    ] {
        *value = table.number(key, range).unwrap_or(*value);
    }
    motor
}

/// How many terminals its simulation has; digital ones, as far as they go, if the file says nothing.
fn terminals(table: &mut Table<'_>, key: &'static str, usual: Terminals) -> Terminals {
    let given = table.optional(key, |table| {
        Some(Terminals {
            digital: table.integer(DIGITAL, 0..=255).unwrap_or(0),
            analogue: table.integer(ANALOGUE, 0..=255).unwrap_or(0),
        })
    });
    given.unwrap_or(usual)
}
