//! The keys that a drive of every protocol has: an [`AxisPlan`].

use std::time::Duration;

use super::form::{Form, Range};
use super::machine::Machine;
use super::table::{POSITIVE, Table, integer, number as number_of, time as time_of};
use super::value::{SHORT_NAME, plain_name};
use fieldbeat_core::axis::{
    AxisPlan, FollowingError, FoundRunning, Health, HeldBy, InPosition, Limits, Load, OwnerLost, Profile,
    StopHow, StopPlan, StopThen, StopTimeout, Underrun, Unit, Units,
};
use fieldbeat_core::time::{MS, S};

/// `stop.how`.
pub const HOWS: [(&str, StopHow); 3] =
    [("ramp", StopHow::Ramp), ("quick", StopHow::Quick), ("coast", StopHow::Coast)];
/// `stop.then`.
pub const THENS: [(&str, StopThen); 2] = [("hold", StopThen::Hold), ("disable", StopThen::Disable)];
/// `stop.on_timeout`.
pub const TIMEOUTS: [(&str, StopTimeout); 2] =
    [("hold", StopTimeout::Hold), ("disable", StopTimeout::Disable)];
/// `stop.holds_by`.
pub const HOLDERS: [(&str, HeldBy); 2] = [("brake", HeldBy::Brake), ("drive", HeldBy::Drive)];

/// What the drives of a protocol count.
#[derive(Clone, Copy, Debug)]
pub struct Counts {
    /// In words.
    pub what: &'static str,
    /// The unit that nobody needs to name.
    pub unit: Unit,
    /// How many of them are one.
    pub per_unit: f64,
    /// What the drive itself counts in one of them.
    pub wire: f64,
}

/// Reads the common keys of a drive that counts `counts`.
pub fn axis(table: &mut Table<'_>, machine: &mut Machine, counts: Counts) -> AxisPlan {
    let name = name(table, machine, "drive", "every drive needs a name for programs and messages");
    let units = units(table, counts);
    let default = AxisPlan::new(name, units);
    let limits = limits(table, &units);
    let profile = profile(table, &default.profile, &limits);
    let load = load(table);
    let stop = stop(table, machine, &default.stop, load, &profile);
    let divisor = table.integer("divisor", 1..=1000, "1 is an exchange every cycle").unwrap_or(1);
    let phase = table
        .integer("phase", 0..=999, "the one of its divisor cycles in which the drive has its exchange")
        .unwrap_or(0);
    let queue = |table: &mut Table<'_>, key, least, default| {
        table.integer(key, least..=1_000_000, "room in entries").unwrap_or(default)
    };
    let exchange_ns = machine.period_ns.saturating_mul(u64::from(divisor));
    let plan = AxisPlan {
        limits,
        profile,
        divisor,
        phase,
        health: health(table, exchange_ns),
        in_position: in_position(table, &InPosition::new(&units, stop.standstill), exchange_ns),
        stop,
        underrun: underrun(table).unwrap_or(default.underrun),
        on_found_running: table
            .word("on_found_running", &[("stop", FoundRunning::Stop), ("refuse", FoundRunning::Refuse)])
            .unwrap_or(default.on_found_running),
        on_owner_lost: table
            .word("on_owner_lost", &[("stop", OwnerLost::Stop), ("finish", OwnerLost::Finish)])
            .unwrap_or(default.on_owner_lost),
        load,
        setpoint_age: table
            .integer("setpoint_age", 1..=1_000_000, "the cycles for which a velocity setpoint is valid")
            .unwrap_or(default.setpoint_age),
        jog_deadman: jog_deadman(table).unwrap_or(default.jog_deadman),
        enable_timeout: time(
            table,
            "enable_timeout",
            600,
            "the longest time until power is on",
            default.enable_timeout,
        ),
        home_timeout: time(table, "home_timeout", 3600, "the longest time for homing", default.home_timeout),
        command_queue: queue(table, "command_queue", 1, default.command_queue),
        stream_queue: queue(table, "stream_queue", 1, default.stream_queue),
        event_queue: queue(table, "event_queue", 1, default.event_queue),
        sample_queue: queue(table, "sample_queue", 0, default.sample_queue),
        parameter_queue: queue(table, "parameter_queue", 1, default.parameter_queue),
        ..default
    };
    for fault in plan.faults() {
        table.fault(fault.key, fault.message);
    }
    plan
}

/// What the load does when nothing holds it; a vertical one names what does.
fn load(table: &mut Table<'_>) -> Load {
    let vertical = table.word("load", &[("level", false), ("vertical", true)]).unwrap_or(false);
    let held_by = table.word("held_by", &HOLDERS);
    match held_by {
        Some(held_by) if vertical => Load::Vertical(held_by),
        _ => {
            if vertical && !table.gives("held_by") {
                table.fault(
                    "held_by",
                    "missing; a vertical load drops when nothing holds it: \"brake\", or \"drive\" if the \
                     drive always stays powered",
                );
            } else if held_by.is_some() && !table.gives("load") {
                table.fault("held_by", "needs load = \"vertical\"; add that, or leave held_by out");
            }
            Load::Level
        }
    }
}

/// A time, or "off": the jog then runs until something replaces it.
fn jog_deadman(table: &mut Table<'_>) -> Option<Option<Duration>> {
    let hint = "a jog that is not renewed within this time is stopped; or \"off\"";
    table.read("jog_deadman", Form::Time.or(Form::word("off")), |value| match value.as_str() {
        Some("off") => Ok(None),
        _ => time_of(value, &(MS..=60 * S), hint).map(|ns| Some(Duration::from_nanos(ns))),
    })
}

/// A number above 0, or "off".
fn or_off(table: &mut Table<'_>, key: &'static str, hint: &str) -> Option<Option<f64>> {
    let form = Form::Number(Range::of(&POSITIVE, |bound| bound)).or(Form::word("off"));
    table.read(key, form, |value| match (value.as_str(), number_of(value)) {
        (Some("off"), _) => Ok(None),
        (_, Some(number)) if number > 0.0 => Ok(Some(number)),
        _ => Err(format!("must be a number above 0, or \"off\"; {hint}")),
    })
}

/// When a move of a drive with an exchange every `exchange_ns` has arrived.
fn in_position(table: &mut Table<'_>, default: &InPosition, exchange_ns: u64) -> InPosition {
    table.table("in_position", |table| InPosition {
        window: or_off(table, "window", "units between a target and the actual position")
            .unwrap_or(default.window),
        reports: table
            .count("for", 1..=60_000, exchange_ns, "the good exchanges in a row inside the window")
            .unwrap_or(default.reports),
        timeout: time(table, "timeout", 600, "the longest time from the end of the demand", default.timeout),
    })
}

fn time(table: &mut Table<'_>, key: &'static str, most_s: u64, hint: &str, default: Duration) -> Duration {
    table.time(key, MS..=most_s * S, hint).map_or(default, Duration::from_nanos)
}

/// The name of a `kind`, a drive or a device.
pub fn name(table: &mut Table<'_>, machine: &mut Machine, kind: &'static str, why: &str) -> String {
    table.require("name", why);
    let name =
        table.text("name", SHORT_NAME, "1 to 32 letters, digits, - _ or .", plain_name).unwrap_or_default();
    machine.claim_name(table, kind, &name);
    name
}

fn units(table: &mut Table<'_>, counts: Counts) -> Units {
    let unit =
        table.word("units", &[("mm", Unit::Millimetre), ("rev", Unit::Revolution)]).unwrap_or(counts.unit);
    let hint = format!("{} in one unit; invert = true reverses the direction", counts.what);
    let given = table.number("scale", 1e-6..=1e12, &hint);
    if unit != counts.unit && !table.gives("scale") {
        table.fault("scale", format!("missing; give the number of {} in one {unit}", counts.what));
    }
    // Where it is missing, something usual stands in: one mistake, one message.
    let scale = given.unwrap_or(counts.per_unit) * counts.wire;
    let inverted = table.flag("invert").unwrap_or(false);
    Units {
        unit,
        counts_per_unit: if inverted { -scale } else { scale },
        offset: table.number("offset", .., "the position of the drive's count zero").unwrap_or(0.0),
        modulo: table.number("modulo", POSITIVE, "the length of one turn"),
    }
}

fn limits(table: &mut Table<'_>, units: &Units) -> Limits {
    let limits = table.table("limits", |table| Limits {
        position: table.interval("position", "in user units"),
        velocity: table.number("velocity", POSITIVE, "units/s; leave it out for the drive's own limit"),
        acceleration: table.number(
            "acceleration",
            POSITIVE,
            "units/s²; leave it out for the drive's own limit",
        ),
        step: table.number("step", POSITIVE, "units between two streamed rows; leave it out for no limit"),
        torque: table.number(
            "torque",
            POSITIVE,
            "per cent of the rated torque; leave it out for the drive's own limit",
        ),
        homing: table.number("homing", POSITIVE, "units/s while it homes; leave it out for that of velocity"),
        following_error: match or_off(table, "following_error", "units between demand and actual position") {
            None => FollowingError::Derived,
            Some(None) => FollowingError::Off,
            Some(Some(most)) => FollowingError::Most(most),
        },
    });
    if let Some((low, high)) = limits.position {
        let counts = |end: i32| f64::from(end) / units.counts_per_unit + units.offset;
        let ends = (counts(i32::MIN), counts(i32::MAX));
        let reach = (ends.0.min(ends.1), ends.0.max(ends.1));
        if low < reach.0 || high > reach.1 {
            table.fault(
                "limits.position",
                format!(
                    "exceeds the range of the drive's 32-bit counts, {} ... {} {}; narrow it or check scale \
                     and offset",
                    reach.0, reach.1, units.unit
                ),
            );
        }
    }
    limits
}

fn profile(table: &mut Table<'_>, default: &Profile, limits: &Limits) -> Profile {
    let [most_speed, most_ramp] =
        [limits.velocity, limits.acceleration].map(|limit| limit.unwrap_or(f64::INFINITY));
    let given = table.table("profile", |table| {
        [("velocity", "units/s"), ("acceleration", "units/s²"), ("deceleration", "units/s²")]
            .map(|(key, unit)| table.number(key, POSITIVE, unit))
    });
    let [velocity, acceleration, deceleration] = given;
    let acceleration = acceleration.unwrap_or(default.acceleration.min(most_ramp));
    Profile {
        velocity: velocity.unwrap_or(default.velocity.min(most_speed)),
        acceleration,
        deceleration: deceleration.unwrap_or(acceleration),
    }
}

/// Link health of a drive with an exchange every `exchange_ns`.
fn health(table: &mut Table<'_>, exchange_ns: u64) -> Health {
    let default = Health::default();
    table.table("health", |table| Health {
        bucket: table
            .count(
                "bucket",
                1..=10_000,
                exchange_ns,
                "the misses that fill the bucket: then the link is lost",
            )
            .unwrap_or(default.bucket),
        leak: table
            .integer(
                "leak",
                1..=1_000_000,
                "the good exchanges in a row that take one miss out of the bucket",
            )
            .unwrap_or(default.leak),
        gate: table
            .integer("gate", 1..=1_000_000, "the good exchanges in a row after which the link is up")
            .unwrap_or(default.gate),
        // Faster, and the requests to an absent drive can fill the send buffer of the living.
        probe_interval: table
            .time("probe_interval", 10 * MS..=10 * S, "the time between two requests to an absent drive")
            .map_or(default.probe_interval, Duration::from_nanos),
    })
}

fn stop(
    table: &mut Table<'_>,
    machine: &mut Machine,
    default: &StopPlan,
    load: Load,
    profile: &Profile,
) -> StopPlan {
    // Where only the drive holds the load, it stays on unless the file says otherwise; `check` says what that means.
    let (then, on_timeout) = match load {
        Load::Vertical(HeldBy::Drive) => (StopThen::Hold, StopTimeout::Hold),
        Load::Level | Load::Vertical(HeldBy::Brake) => (default.then, default.on_timeout),
    };
    table.table("stop", |table| StopPlan {
        how: table.word("how", &HOWS).unwrap_or(default.how),
        deceleration: table
            .number("deceleration", POSITIVE, "units/s²; leave it out for profile.deceleration")
            .unwrap_or(profile.deceleration),
        then: table.word("then", &THENS).unwrap_or(then),
        timeout: time(table, "timeout", 600, "the longest time to standstill", default.timeout),
        on_timeout: table.word("on_timeout", &TIMEOUTS).unwrap_or(on_timeout),
        standstill: table
            .number("standstill", POSITIVE, "units/s; a lower speed is standstill")
            .unwrap_or(default.standstill),
        standstill_for: table
            .integer("standstill_for", 1..=100_000, "good exchanges in a row below the standstill speed")
            .unwrap_or(default.standstill_for),
        group: table
            .text(
                "group",
                SHORT_NAME,
                "a name of 1 to 32 letters, digits, - _ or .; leave it out to stop alone",
                plain_name,
            )
            .map(|group| machine.group(table, group)),
    })
}

fn underrun(table: &mut Table<'_>) -> Option<Underrun> {
    const FORMS: &str = "must be \"stop\", \"hold\" or { extrapolate = 3 } (exchanges)";
    let extrapolate = Form::Fields(vec![("extrapolate", Form::integer(1..=1000), true)]);
    table.read("underrun", Form::words(["stop", "hold"]).or(extrapolate), |value| match value.as_str() {
        Some("stop") => Ok(Underrun::Stop),
        Some("hold") => Ok(Underrun::Hold),
        Some(_) => Err(FORMS.into()),
        None => {
            let count = value
                .as_table()
                .filter(|table| table.len() == 1)
                .and_then(|table| table.get("extrapolate"))
                .and_then(|count| integer(count.get_ref()))
                .filter(|count| (1..=1000).contains(count))
                .and_then(|count| u32::try_from(count).ok());
            count.map(Underrun::Extrapolate).ok_or(FORMS.into())
        }
    })
}
