//! The keys of `simulate` of a drive with `protocol = "linudp-v2"`.

use super::{FlashMode, LinMotSettings, LinMots, MasterFilter, UnknownCommands};
use crate::Carrier;
use crate::keys::faults;
use fieldbeat_core::axis::Units;
use fieldbeat_core::time::S;
use fieldbeat_keys::bus;
use fieldbeat_keys::form::Form;
use fieldbeat_keys::table::{Table, integer};
use fieldbeat_linudp::{LinUdpDrive, LinUdpPlan};

/// Reads the simulated drives of a `[[bus]]` that is read otherwise.
pub fn read(table: &mut Table<'_>, plan: &LinUdpPlan, period_ns: u64) -> LinMots {
    LinMots(bus::simulated(table, &plan.drives, |table, drive, index| {
        settings(table, drive, period_ns, index)
    }))
}

fn settings(table: &mut Table<'_>, drive: &LinUdpDrive, period_ns: u64, index: usize) -> LinMotSettings {
    let axis = &drive.axis;
    let period_ns = period_ns.saturating_mul(u64::from(axis.divisor));
    let counts = |position: f64| counts(&axis.units, position);
    let range = table.interval("range", "mechanical, in user units");
    let endless = range.is_none() && axis.units.modulo.is_some();
    let (low, high) = range.unwrap_or({
        match axis.limits.position {
            Some((low, high)) => (low - 5.0, high + 5.0),
            None => (-1000.0, 1000.0),
        }
    });
    let inside = |table: &mut Table<'_>, key| {
        table.number(key, low..=high, "inside the range of the simulated axis, in user units")
    };
    let home = inside(table, "home").unwrap_or(if low <= 0.0 && high >= 0.0 { 0.0 } else { low });
    let start = inside(table, "start").unwrap_or((low + high) / 2.0);
    let ends = if endless { LinMotSettings::ENDLESS } else { (counts(low), counts(high)) };
    let default = LinMotSettings::of(drive);
    let serial = table.integer("serial", 0..=u32::MAX.into(), "the number in its parameter serial_from");
    LinMotSettings {
        address: drive.address,
        serial: drive.serial.map(|own| (own.from.0, serial.or(own.number).unwrap_or_default())),
        faults: faults(table, Carrier::Datagrams, period_ns, index),
        padding: table
            .read("padding", Form::numbers([0, 14, 64]), |value| {
                let padding = integer(value).and_then(|padding| usize::try_from(padding).ok());
                padding
                    .filter(|padding| [0, 14, 64].contains(padding))
                    .ok_or("must be 0, 14 or 64 bytes".into())
            })
            .unwrap_or(default.padding),
        filter: filter(table).unwrap_or_default(),
        start_position: counts(start),
        range: (ends.0.min(ends.1), ends.0.max(ends.1)),
        mass_kg: table.number("mass", 0.001..=10_000.0, "moving mass in kg").unwrap_or(default.mass_kg),
        home_position: counts(home),
        stream_period_ns: table
            .time("stream_period", 100_000..=S, "the period set in the drive for the configured commands")
            .unwrap_or(period_ns),
        stream_patience: table
            .number("stream_patience", 1.0..=1_000.0, "periods without a setpoint before error 0083h")
            .unwrap_or(default.stream_patience),
        stream_depth: table
            .integer("stream_depth", 1..=10_000, "setpoints that a stream holds ahead of its output")
            .unwrap_or(default.stream_depth),
        status_lag_ns: table
            .time("status_lag", ..=S, "how old the control word is that the status word reports")
            .unwrap_or(default.status_lag_ns),
        force_enable_bits: table.flag("force_enable_bits").unwrap_or(false),
        start_running: table.flag("running").unwrap_or(false),
        config_time_ns: table
            .time("config_time", ..=60 * S, "how long a command on the parameter channel takes")
            .unwrap_or(default.config_time_ns),
        flash_time_ns: table
            .time("flash_time", ..=600 * S, "how long a save into flash takes; real drives took 39s ... 75s")
            .unwrap_or(default.flash_time_ns),
        flash: table
            .word(
                "flash",
                &[("silent", FlashMode::Silent), ("mute", FlashMode::Mute), ("busy", FlashMode::Busy)],
            )
            .unwrap_or_default(),
        unknown_commands: table
            .word(
                "unknown_commands",
                &[("refuse", UnknownCommands::Refuse), ("ignore", UnknownCommands::Ignore)],
            )
            .unwrap_or_default(),
        extend_sign: table.flag("extend_sign").unwrap_or(false),
    }
}

/// A simulated position in counts, at the end of the wire's range where it does not fit.
fn counts(units: &Units, position: f64) -> i32 {
    let counts = ((position - units.offset) * units.counts_per_unit).round();
    counts.clamp(f64::from(i32::MIN), f64::from(i32::MAX)) as i32
}

fn filter(table: &mut Table<'_>) -> Option<MasterFilter> {
    table.text(
        "filter",
        None,
        "\"none\", \"single\" or the one master's address, like \"192.168.1.1\"",
        |text| match text {
            "none" => Some(MasterFilter::None),
            "single" => Some(MasterFilter::Single),
            _ => text.parse().ok().map(MasterFilter::Fixed),
        },
    )
}
