//! The keys of `simulate` of a drive with `protocol = "linudp-v2"`.

use super::{FlashMode, LinMotSettings, LinMots, MasterFilter, UnknownCommands};
use crate::Carrier;
use crate::keys::faults;
use fieldbeat_core::axis::Units;
use fieldbeat_core::time::S;
use fieldbeat_keys::bus;
use fieldbeat_keys::form::Form;
use fieldbeat_keys::keys;
use fieldbeat_keys::table::{Table, integer};
use fieldbeat_linudp::{LinUdpDrive, LinUdpPlan};

keys! {
    RANGE "range" = "(`limits.position` and 5 units more, else 1000 units both ways; a `modulo` axis turns "
        "without end, and its 32-bit position count wraps around)":
        "mechanical range `[lowest, highest]`";
    HOME "home" = "(`0`, or the low end of the range)": "position of the home switch, inside the range";
    START "start" = "(the middle of the range)": "position at power-on, inside the range";
    SERIAL "serial" = "(as of the drive, else `0`)": "the number in its parameter `serial_from`";
    PADDING "padding" = "14": "shortest payload in bytes: `0`, `14` or `64`";
    MASS "mass" = "1": "moving mass, kg";
    STREAM_PERIOD "stream_period" = "(one period of the drive)": "the period that is set in the drive for "
        "the configured streaming commands";
    STREAM_PATIENCE "stream_patience" = "2.5": "periods without a setpoint before a stream ends in error "
        "0083h";
    STREAM_DEPTH "stream_depth" = "8": "setpoints that a stream holds; one more ends it in error 0082h";
    STATUS_LAG "status_lag" = "0us": "age of the control word that the status word reports";
    FORCE_ENABLE_BITS "force_enable_bits" = "false": "bits 1-5 of the control word are forced to 1";
    RUNNING "running" = "false": "starts enabled and moving, as if another master had died";
    CONFIG_TIME "config_time" = "0us": "time for a command on the parameter channel; the drive answers "
        "\"busy\" meanwhile";
    FLASH_TIME "flash_time" = "500ms": "time for a save to flash, a single parameter takes a 500th of it; "
        "real drives took 39 ... 75 s";
    FLASH "flash" = "silent": "what the drive does during a save: `\"silent\"` answers nothing, `\"mute\"` "
        "does not report the result afterwards either, `\"busy\"` answers that it is busy";
    UNKNOWN_COMMANDS "unknown_commands" = "refuse": "a motion command that the simulation does not "
        "support: error 0081h, or `\"ignore\"`";
    EXTEND_SIGN "extend_sign" = "false": "values of less than 32 bits carry their sign in the bits above";
    FILTER "filter" = "\"none\"": "which masters the drive answers: all (`\"none\"`), a `\"single\"` one, "
        "or the one with this address";
}

impl LinMots {
    /// A drive with default settings for each of the bus.
    pub fn of(plan: &LinUdpPlan) -> LinMots {
        LinMots(plan.drives.iter().map(LinMotSettings::of).collect())
    }
}

impl LinMotSettings {
    /// A drive with default settings at the address of `drive`, with its serial number.
    fn of(drive: &LinUdpDrive) -> LinMotSettings {
        let serial = drive.serial.map(|serial| (serial.from.0, serial.number.unwrap_or_default()));
        LinMotSettings { serial, ..LinMotSettings::new(drive.address) }
    }
}

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
    let range = table.interval(RANGE);
    let endless = range.is_none() && axis.units.modulo.is_some();
    let (low, high) = range.unwrap_or({
        match axis.limits.position {
            Some((low, high)) => (low - 5.0, high + 5.0),
            None => (-1000.0, 1000.0),
        }
    });
    let inside = |table: &mut Table<'_>, key| table.number(key, low..=high);
    let home = inside(table, HOME).unwrap_or(if low <= 0.0 && high >= 0.0 { 0.0 } else { low });
    let start = inside(table, START).unwrap_or((low + high) / 2.0);
    let ends = if endless { LinMotSettings::ENDLESS } else { (counts(low), counts(high)) };
    let default = LinMotSettings::of(drive);
    let serial = table.integer(SERIAL, 0..=u32::MAX.into());
    LinMotSettings {
        address: drive.address,
        serial: drive.serial.map(|own| (own.from.0, serial.or(own.number).unwrap_or_default())),
        faults: faults(table, Carrier::Datagrams, period_ns, index),
        padding: table
            .read(PADDING, Form::numbers([0, 14, 64]), |value| {
                let padding = integer(value).and_then(|padding| usize::try_from(padding).ok());
                padding
                    .filter(|padding| [0, 14, 64].contains(padding))
                    .ok_or("must be 0, 14 or 64 bytes".into())
            })
            .unwrap_or(default.padding),
        filter: filter(table).unwrap_or_default(),
        start_position: counts(start),
        range: (ends.0.min(ends.1), ends.0.max(ends.1)),
        mass_kg: table.number(MASS, 0.001..=10_000.0).unwrap_or(default.mass_kg),
        home_position: counts(home),
        stream_period_ns: table.time(STREAM_PERIOD, 100_000..=S).unwrap_or(period_ns),
        stream_patience: table.number(STREAM_PATIENCE, 1.0..=1_000.0).unwrap_or(default.stream_patience),
        stream_depth: table.integer(STREAM_DEPTH, 1..=10_000).unwrap_or(default.stream_depth),
        status_lag_ns: table.time(STATUS_LAG, ..=S).unwrap_or(default.status_lag_ns),
        force_enable_bits: table.flag(FORCE_ENABLE_BITS).unwrap_or(false),
        start_running: table.flag(RUNNING).unwrap_or(false),
        config_time_ns: table.time(CONFIG_TIME, ..=60 * S).unwrap_or(default.config_time_ns),
        flash_time_ns: table.time(FLASH_TIME, ..=600 * S).unwrap_or(default.flash_time_ns),
        flash: table
            .word(
                FLASH,
                &[("silent", FlashMode::Silent), ("mute", FlashMode::Mute), ("busy", FlashMode::Busy)],
            )
            .unwrap_or_default(),
        unknown_commands: table
            .word(
                UNKNOWN_COMMANDS,
                &[("refuse", UnknownCommands::Refuse), ("ignore", UnknownCommands::Ignore)],
            )
            .unwrap_or_default(),
        extend_sign: table.flag(EXTEND_SIGN).unwrap_or(false),
    }
}

/// A simulated position in counts, at the end of the wire's range where it does not fit.
fn counts(units: &Units, position: f64) -> i32 {
    let counts = ((position - units.offset) * units.counts_per_unit).round();
    counts.clamp(f64::from(i32::MIN), f64::from(i32::MAX)) as i32
}

fn filter(table: &mut Table<'_>) -> Option<MasterFilter> {
    table.text(
        FILTER,
        None,
        "\"none\", \"single\" or the one master's address, like \"192.168.1.1\"",
        |text| match text {
            "none" => Some(MasterFilter::None),
            "single" => Some(MasterFilter::Single),
            _ => text.parse().ok().map(MasterFilter::Fixed),
        },
    )
}
