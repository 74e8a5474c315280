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
use fieldbeat_keys::keys;
use fieldbeat_keys::table::Table;

keys! {
    RUNNING "running" = "none": "starts jogging at this velocity, as if another master had died";
    DRIFT_PPM "drift_ppm" = "0": "how much too slow the drive's clock is, -100000 ... 100000";
    JITTER "jitter" = "0s": "each of its packets leaves up to so much late, at most half its interval";
    MODEL "model" = "STF": "`\"SSDC\"` reports \"in position\", and takes the commands of step-servo drives";
    VENDOR "vendor" = "(as of the drive, else `60`)": "vendor number that it reports";
    PRODUCT "product" = "(as of the drive, else `1`)": "product code that it reports";
    SERIAL "serial" = "(as of the drive, else made of the address)": "serial number that it reports";
    INACTIVITY "inactivity" = "120s": "a silent TCP connection ends after so many seconds; `\"0s\"`: never";
    SESSIONS "sessions" = "6": "largest number of sessions, 1 ... 8";
    CONFIGURATION "configuration" = "accepted": "data of the configuration assembly in an open: "
        "`\"accepted\"`, `\"required\"` (the two bytes) or `\"refused\"`";
    HEARTBEAT "heartbeat" = "2": "connection size that it wants of a connection without outputs, 0 ... 6";
    LEAST_RPI "least_rpi" = "1ms": "shortest interval that it can do";
    SHORT_RPI "short_rpi" = "raised": "a shorter one is `\"raised\"` to it, or `\"refused\"`";
    TICK "tick" = "1us": "intervals are rounded up to whole ticks";
    OWNERSHIP "ownership" = "released": "after a time-out everybody may open; `\"kept\"`: only the "
        "originator of before, until the drive is restarted";
    MESSAGES_TIME_OUT "messages_time_out" = "true": "class 3 connections time out; `false`: they stay "
        "until they are closed";
    ZS "zs" = "500ms": "after so long without traffic it stops by itself, up to 10 s; `\"0s\"`: never";
    ZA "za" = "13": "what it then does, as the drive's ZA: 1 ... 12 that segment, 13 and 14 stop, 15 and "
        "16 stop and switch off";
    EDGES "edges" = "stops": "command words that change without a 0 between: only stops act, none "
        "(`\"strict\"`), or `\"any\"`";
    IDLE "idle" = "ignored": "packets of an idle owner are ignored, or the motor `\"stops\"`";
    HEARTBEATS_FEED "heartbeats_feed" = "false": "packets without outputs feed ZS, too";
    LOST_OWNER_STOPS "lost_owner_stops" = "false": "the motor stops when the connection of its owner times "
        "out, not only by ZS";
    MOVING_WHILE_JOGGING "moving_while_jogging" = "false": "the status while jogging has \"moving\", too";
    HOMING_ZEROES "homing_zeroes" = "false": "homing ends with position 0";
    BUFFER "buffer" = "15": "moves that wait behind a running one, up to 255; a further one is not taken";
    ALARM "alarm" = "0": "bits of an alarm whose cause does not go away";
    IGNORES_STOPS "ignores_stops" = "false": "once enabled, it takes neither a stop nor \"disable\" of its "
        "master: a faulty firmware";
    RANGE "range" = "none": "between the limit switches, user units: `[-1, 50]`";
    HOME "home" = "(half way along `homing.distance`)": "where the home switch acts, user units: `[10, "
        "10.1]`";
    START "start" = "0": "where the motor stands at first, user units";
    INERTIA "inertia" = "0.0002": "inertia of all rotating parts, kg m²";
    FRICTION "friction" = "0.1": "friction without power, N m";
}

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
    let running = table.number(RUNNING, ..).map(|velocity| velocity * per_unit);
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
    settings.clock.drift_ppm = table.integer(DRIFT_PPM, -100_000..=100_000).unwrap_or(0);
    settings.clock.jitter_ns = table.time(JITTER, ..=interval_ns / 2).unwrap_or(0);
    settings.clock.seed = settings.faults.seed;
    settings
}

fn identity(table: &mut Table<'_>, default: IdentitySettings) -> IdentitySettings {
    let kind = table.word(MODEL, &[("STF", Kind::Stepper), ("SSDC", Kind::StepServo)]);
    let name = if kind == Some(Kind::StepServo) { "SSDC10-IP".into() } else { default.name };
    IdentitySettings {
        vendor: table.integer(VENDOR, 0..=0xFFFF).unwrap_or(default.vendor),
        product: table.integer(PRODUCT, 0..=0xFFFF).unwrap_or(default.product),
        serial: table.integer(SERIAL, 0..=0xFFFF_FFFF).or(default.serial),
        kind: kind.unwrap_or(default.kind),
        name,
        ..default
    }
}

fn network(table: &mut Table<'_>, default: NetworkSettings) -> NetworkSettings {
    let inactivity = table.time(INACTIVITY, ..=3_600 * S);
    NetworkSettings {
        sessions: table.integer(SESSIONS, 1..=8).unwrap_or(default.sessions),
        inactivity_s: inactivity.map_or(default.inactivity_s, |ns| (ns / S) as u16),
        configuration: table
            .word(
                CONFIGURATION,
                &[
                    ("accepted", Configuration::Accepted),
                    ("required", Configuration::Required),
                    ("refused", Configuration::Refused),
                ],
            )
            .unwrap_or_default(),
        heartbeat: table.integer(HEARTBEAT, 0..=6).unwrap_or(default.heartbeat),
        least_rpi_ns: table.time(LEAST_RPI, US..=10 * S).unwrap_or(default.least_rpi_ns),
        short_rpi: table
            .word(SHORT_RPI, &[("raised", ShortRpi::Raised), ("refused", ShortRpi::Refused)])
            .unwrap_or_default(),
        tick_ns: table.time(TICK, US..=S).unwrap_or(default.tick_ns),
        ownership: table
            .word(OWNERSHIP, &[("released", Ownership::Released), ("kept", Ownership::Kept)])
            .unwrap_or_default(),
        messages_time_out: table.flag(MESSAGES_TIME_OUT).unwrap_or(default.messages_time_out),
        ..default
    }
}

fn firmware(table: &mut Table<'_>, default: FirmwareSettings) -> FirmwareSettings {
    let zs = table.time(ZS, ..=10 * S);
    FirmwareSettings {
        zs_ms: zs.map_or(default.zs_ms, |ns| (ns / MS) as u16),
        za: table.integer(ZA, 1..=16).unwrap_or(default.za),
        edges: table
            .word(EDGES, &[("stops", Edges::Stops), ("strict", Edges::Strict), ("any", Edges::Any)])
            .unwrap_or_default(),
        idle: table.word(IDLE, &[("ignored", Idle::Ignored), ("stops", Idle::Stops)]).unwrap_or_default(),
        heartbeats_feed: table.flag(HEARTBEATS_FEED).unwrap_or(default.heartbeats_feed),
        lost_owner_stops: table.flag(LOST_OWNER_STOPS).unwrap_or(default.lost_owner_stops),
        moving_while_jogging: table.flag(MOVING_WHILE_JOGGING).unwrap_or(default.moving_while_jogging),
        homing_zeroes: table.flag(HOMING_ZEROES).unwrap_or(default.homing_zeroes),
        buffer: table.integer(BUFFER, 0..=255).unwrap_or(default.buffer),
        persistent_alarm: table.integer(ALARM, 0..=0xFFFF).unwrap_or(default.persistent_alarm),
        ignores_stops: table.flag(IGNORES_STOPS).unwrap_or(default.ignores_stops),
        ..default
    }
}

fn motor(table: &mut Table<'_>, drive: &MoonsDrive, default: MoonsMotorSettings) -> MoonsMotorSettings {
    let units = &drive.axis.units;
    let steps = |position: f64| {
        let steps = ((position - units.offset) * units.counts_per_unit).round();
        steps.clamp(f64::from(i32::MIN), f64::from(i32::MAX)) as i32
    };
    let limits = table.interval(RANGE).map(|(low, high)| {
        let (low, high) = (steps(low), steps(high));
        (low.min(high), low.max(high))
    });
    let home = table.interval(HOME);
    MoonsMotorSettings {
        start: table.number(START, ..).map_or(default.start, steps),
        limits: limits.or(default.limits),
        home: match (home, default.home) {
            (Some((low, high)), found) => {
                let at = found.map_or(Wired { input: 1, closed: true }, |home| home.at);
                Some(HomeSwitch { at, range: (steps(low), steps(high)) })
            }
            (None, found) => found,
        },
        inertia_kgm2: table.number(INERTIA, 1e-9..=1e6).unwrap_or(default.inertia_kgm2),
        friction_nm: table.number(FRICTION, 0.0..=100_000.0).unwrap_or(default.friction_nm),
        ..default
    }
}
