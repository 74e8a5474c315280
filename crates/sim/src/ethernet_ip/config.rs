//! The keys of `simulate` of a drive with `protocol = "ethernet-ip"`.

use super::{
    Configuration, Edges, FirmwareSettings, HomeSwitch, IdentitySettings, Idle, Kind, MoonsDrives,
    MoonsMotorSettings, MoonsSettings, NetworkSettings, Ownership, ShortRpi, Wired,
};
use crate::Carrier;
use crate::keys::faults;
use fieldbeat_core::time::{MS, S, US};
use fieldbeat_ethernet_ip::plan::{EthernetIpPlan, MoonsDrive};
use fieldbeat_keys::bus;
use fieldbeat_keys::table::Table;

/// Reads the simulated drives of a `[[bus]]` that is read otherwise.
pub fn read(table: &mut Table<'_>, plan: &EthernetIpPlan, period_ns: u64) -> MoonsDrives {
    MoonsDrives(bus::simulated(table, &plan.drives, |table, drive, index| {
        settings(table, drive, period_ns, index)
    }))
}

fn settings(table: &mut Table<'_>, drive: &MoonsDrive, period_ns: u64, index: usize) -> MoonsSettings {
    let default = MoonsSettings::of(drive);
    let rpi_ns = drive.rpi_ns(period_ns);
    let per_unit = drive.axis.units.counts_per_unit;
    let running = table.number("running", .., "a velocity, units/s").map(|velocity| velocity * per_unit);
    let mut settings = MoonsSettings {
        // Its stream and its datagrams have the same ones.
        faults: faults(table, Carrier::Stream, rpi_ns, index),
        identity: identity(table, default.identity),
        network: network(table, default.network),
        firmware: firmware(table, default.firmware),
        motor: motor(table, drive, default.motor),
        running,
        ..default
    };
    let interval_ns = drive.input_rpi_ns(period_ns);
    settings.clock.drift_ppm = table
        .integer("drift_ppm", -100_000..=100_000, "how much too slow the drive's clock is, ppm")
        .unwrap_or(0);
    settings.clock.jitter_ns = table
        .time(
            "jitter",
            ..=interval_ns / 2,
            "how late a packet of the drive is at most, up to half its interval",
        )
        .unwrap_or(0);
    settings.clock.seed = settings.faults.seed;
    settings
}

fn identity(table: &mut Table<'_>, default: IdentitySettings) -> IdentitySettings {
    let kind = table.word("model", &[("STF", Kind::Stepper), ("SSDC", Kind::StepServo)]);
    let name = if kind == Some(Kind::StepServo) { "SSDC10-IP".into() } else { default.name };
    IdentitySettings {
        vendor: table.integer("vendor", 0..=0xFFFF, "the number of its vendor").unwrap_or(default.vendor),
        product: table.integer("product", 0..=0xFFFF, "its product code").unwrap_or(default.product),
        serial: table.integer("serial", 0..=0xFFFF_FFFF, "its serial number").or(default.serial),
        kind: kind.unwrap_or(default.kind),
        name,
        ..default
    }
}

fn network(table: &mut Table<'_>, default: NetworkSettings) -> NetworkSettings {
    let inactivity = table.time("inactivity", ..=3_600 * S, "after how long a silent TCP connection ends");
    NetworkSettings {
        sessions: table
            .integer("sessions", 1..=8, "the largest number of sessions at a time")
            .unwrap_or(default.sessions),
        inactivity_s: inactivity.map_or(default.inactivity_s, |ns| (ns / S) as u16),
        configuration: table
            .word(
                "configuration",
                &[
                    ("accepted", Configuration::Accepted),
                    ("required", Configuration::Required),
                    ("refused", Configuration::Refused),
                ],
            )
            .unwrap_or_default(),
        heartbeat: table
            .integer("heartbeat", 0..=6, "the connection size of heartbeats")
            .unwrap_or(default.heartbeat),
        least_rpi_ns: table
            .time("least_rpi", US..=10 * S, "the shortest interval of packets")
            .unwrap_or(default.least_rpi_ns),
        short_rpi: table
            .word("short_rpi", &[("raised", ShortRpi::Raised), ("refused", ShortRpi::Refused)])
            .unwrap_or_default(),
        tick_ns: table
            .time("tick", US..=S, "intervals are rounded up to whole ticks")
            .unwrap_or(default.tick_ns),
        ownership: table
            .word("ownership", &[("released", Ownership::Released), ("kept", Ownership::Kept)])
            .unwrap_or_default(),
        messages_time_out: table.flag("messages_time_out").unwrap_or(default.messages_time_out),
        ..default
    }
}

fn firmware(table: &mut Table<'_>, default: FirmwareSettings) -> FirmwareSettings {
    let zs = table.time("zs", ..=10 * S, "after how long without traffic the drive stops, 0 s = never");
    FirmwareSettings {
        zs_ms: zs.map_or(default.zs_ms, |ns| (ns / MS) as u16),
        za: table.integer("za", 1..=16, "what the drive does then").unwrap_or(default.za),
        edges: table
            .word("edges", &[("stops", Edges::Stops), ("strict", Edges::Strict), ("any", Edges::Any)])
            .unwrap_or_default(),
        idle: table.word("idle", &[("ignored", Idle::Ignored), ("stops", Idle::Stops)]).unwrap_or_default(),
        heartbeats_feed: table.flag("heartbeats_feed").unwrap_or(default.heartbeats_feed),
        lost_owner_stops: table.flag("lost_owner_stops").unwrap_or(default.lost_owner_stops),
        moving_while_jogging: table.flag("moving_while_jogging").unwrap_or(default.moving_while_jogging),
        homing_zeroes: table.flag("homing_zeroes").unwrap_or(default.homing_zeroes),
        buffer: table
            .integer("buffer", 0..=255, "the moves that wait behind a running one")
            .unwrap_or(default.buffer),
        persistent_alarm: table
            .integer("alarm", 0..=0xFFFF, "the bits of an alarm that cannot be reset")
            .unwrap_or(default.persistent_alarm),
        ignores_stops: table.flag("ignores_stops").unwrap_or(default.ignores_stops),
        ..default
    }
}

fn motor(table: &mut Table<'_>, drive: &MoonsDrive, default: MoonsMotorSettings) -> MoonsMotorSettings {
    let units = &drive.axis.units;
    let steps = |position: f64| {
        let steps = ((position - units.offset) * units.counts_per_unit).round();
        steps.clamp(f64::from(i32::MIN), f64::from(i32::MAX)) as i32
    };
    let limits = table.interval("range", "between the limit switches, in user units").map(|(low, high)| {
        let (low, high) = (steps(low), steps(high));
        (low.min(high), low.max(high))
    });
    let home = table.interval("home", "where the home switch acts, in user units");
    MoonsMotorSettings {
        start: table
            .number("start", .., "where the motor stands at first, in user units")
            .map_or(default.start, steps),
        limits: limits.or(default.limits),
        home: match (home, default.home) {
            (Some((low, high)), found) => {
                let at = found.map_or(Wired { input: 1, closed: true }, |home| home.at);
                Some(HomeSwitch { at, range: (steps(low), steps(high)) })
            }
            (None, found) => found,
        },
        inertia_kgm2: table
            .number("inertia", 1e-9..=1e6, "the inertia of all rotating parts, kg m²")
            .unwrap_or(default.inertia_kgm2),
        friction_nm: table
            .number("friction", 0.0..=100_000.0, "the friction without power, N m")
            .unwrap_or(default.friction_nm),
        ..default
    }
}
