//! The keys of `simulate` of a drive with `protocol = "modbus-tcp"`.

use super::{Interface, MotorSettings, ReadWrite, Start, UnidriveSettings, Unidrives};
use crate::Carrier;
use crate::keys::faults;
use fieldbeat_keys::bus;
use fieldbeat_keys::form::Form;
use fieldbeat_keys::keys;
use fieldbeat_keys::table::Table;
use fieldbeat_modbus::parameter::Addressing;
use fieldbeat_modbus::{ModbusPlan, UnidriveDrive};

keys! {
    MENU_0 "menu_0" = "true": "Pr 22.001 and following set what menu 0 shows";
    CONNECTIONS "connections" = "4": "largest number of simultaneous connections";
    RUNNING "running" = "none": "starts enabled at this velocity, up to the rated speed, as if another "
        "master had died";
    SERIAL "serial" = "(as of the drive, else `0`)": "its serial number, in Pr 11.052 and 11.053";
    FC23 "fc23" = "true": "the drive supports FC23, a write and a read in one request; `false` refuses it, "
        "`\"ignored\"` does not answer, `\"closes\"` ends the connection";
    RATED_SPEED "rated_speed" = "3000": "rated speed of the motor, rpm";
    RATED_TORQUE "rated_torque" = "5": "rated torque of the motor, N m";
    INERTIA "inertia" = "0.005": "inertia of all rotating parts, kg m²";
    LOAD "load" = "1.5": "load torque at rated speed, N m; it grows with the speed";
    FRICTION "friction" = "0.1": "load torque at any speed, N m";
}

impl Unidrives {
    /// A drive with default settings for each of the bus.
    pub fn of(plan: &ModbusPlan) -> Unidrives {
        Unidrives(plan.drives.iter().map(UnidriveSettings::of).collect())
    }
}

impl UnidriveSettings {
    /// A drive with default settings at the address of `drive`, with its serial number, addressing and slot.
    pub fn of(drive: &UnidriveDrive) -> UnidriveSettings {
        let mut settings = UnidriveSettings::new(drive.address);
        settings.serial = drive.serial.unwrap_or_default();
        settings.interface.modified = drive.addressing == Addressing::Modified;
        settings.interface.slot = drive.slot;
        settings
    }
}

/// Reads the simulated drives of a `[[bus]]` that is read otherwise.
pub fn read(table: &mut Table<'_>, plan: &ModbusPlan, period_ns: u64) -> Unidrives {
    Unidrives(bus::simulated(table, &plan.drives, |table, drive, index| {
        settings(table, drive, period_ns, index)
    }))
}

fn settings(table: &mut Table<'_>, drive: &UnidriveDrive, period_ns: u64, index: usize) -> UnidriveSettings {
    let period_ns = period_ns.saturating_mul(u64::from(drive.axis.divisor));
    let default = UnidriveSettings::of(drive);
    let interface = Interface {
        read_write: fc23(table).unwrap_or(default.interface.read_write),
        menu_zero: table.flag(MENU_0).unwrap_or(default.interface.menu_zero),
        connections: table.integer(CONNECTIONS, 1..=64).unwrap_or(default.interface.connections),
        drive_units: drive.unit.map_or(default.interface.drive_units, |unit| vec![unit]),
        ..default.interface
    };
    let motor = motor(table, default.motor);
    let most = drive.velocity(motor.rated_rpm).abs();
    let running = table.number(RUNNING, -most..=most);
    UnidriveSettings {
        serial: table.integer(SERIAL, 0..=UnidriveDrive::SERIAL_MAX.into()).unwrap_or(default.serial),
        faults: faults(table, Carrier::Stream, period_ns, index),
        interface,
        motor,
        start: running.map_or(default.start, |velocity| Start::Running(drive.rpm(velocity))),
        ..default
    }
}

/// Whether the simulated drive has FC23, or what it does instead.
fn fc23(table: &mut Table<'_>) -> Option<ReadWrite> {
    table.read(FC23, Form::Flag.or(Form::words(["ignored", "closes"])), |value| {
        match (value.as_bool(), value.as_str()) {
            (Some(true), _) => Ok(ReadWrite::Served),
            (Some(false), _) => Ok(ReadWrite::Refused),
            (_, Some("ignored")) => Ok(ReadWrite::Ignored),
            (_, Some("closes")) => Ok(ReadWrite::Closes),
            _ => Err("must be true, false, \"ignored\" or \"closes\"".into()),
        }
    })
}

fn motor(table: &mut Table<'_>, default: MotorSettings) -> MotorSettings {
    let mut value =
        |key, range: std::ops::RangeInclusive<f64>, default| table.number(key, range).unwrap_or(default);
    MotorSettings {
        rated_rpm: value(RATED_SPEED, 1.0..=50_000.0, default.rated_rpm),
        rated_nm: value(RATED_TORQUE, 0.001..=100_000.0, default.rated_nm),
        inertia_kgm2: value(INERTIA, 1e-9..=1e6, default.inertia_kgm2),
        load_nm: value(LOAD, 0.0..=100_000.0, default.load_nm),
        friction_nm: value(FRICTION, 0.0..=100_000.0, default.friction_nm),
    }
}
