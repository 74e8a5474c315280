//! The keys of `simulate` of a drive with `protocol = "modbus-tcp"`.

use super::{Interface, MotorSettings, ReadWrite, Start, UnidriveSettings, Unidrives};
use crate::Carrier;
use crate::keys::faults;
use fieldbeat_keys::bus;
use fieldbeat_keys::form::Form;
use fieldbeat_keys::table::Table;
use fieldbeat_modbus::{ModbusPlan, UnidriveDrive};

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
        menu_zero: table.flag("menu_0").unwrap_or(default.interface.menu_zero),
        connections: table
            .integer("connections", 1..=64, "the largest number of masters at a time")
            .unwrap_or(default.interface.connections),
        drive_units: drive.unit.map_or(default.interface.drive_units, |unit| vec![unit]),
        ..default.interface
    };
    let motor = motor(table, default.motor);
    let most = drive.velocity(motor.rated_rpm).abs();
    let running = table.number("running", -most..=most, "a velocity up to the rated speed, units/s");
    UnidriveSettings {
        serial: table
            .integer("serial", 0..=UnidriveDrive::SERIAL_MAX.into(), "its serial number")
            .unwrap_or(default.serial),
        faults: faults(table, Carrier::Stream, period_ns, index),
        interface,
        motor,
        start: running.map_or(default.start, |velocity| Start::Running(drive.rpm(velocity))),
        ..default
    }
}

/// Whether the simulated drive has FC23, or what it does instead.
fn fc23(table: &mut Table<'_>) -> Option<ReadWrite> {
    table.read("fc23", Form::Flag.or(Form::words(["ignored", "closes"])), |value| {
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
    let mut value = |key, range: std::ops::RangeInclusive<f64>, hint, default| {
        table.number(key, range, hint).unwrap_or(default)
    };
    MotorSettings {
        rated_rpm: value("rated_speed", 1.0..=50_000.0, "rated speed of the motor, rpm", default.rated_rpm),
        rated_nm: value(
            "rated_torque",
            0.001..=100_000.0,
            "rated torque of the motor, N m",
            default.rated_nm,
        ),
        inertia_kgm2: value(
            "inertia",
            1e-9..=1e6,
            "the inertia of all rotating parts, kg m²",
            default.inertia_kgm2,
        ),
        load_nm: value(
            "load",
            0.0..=100_000.0,
            "the load torque of the machine at rated speed, N m",
            default.load_nm,
        ),
        friction_nm: value(
            "friction",
            0.0..=100_000.0,
            "the friction torque of the machine at any speed, N m",
            default.friction_nm,
        ),
        ..default
    }
}
