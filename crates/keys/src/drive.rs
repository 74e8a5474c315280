//! The keys that a drive of every protocol has: an [`AxisPlan`].

use std::time::Duration;

use super::form::Form;
use super::machine::Machine;
use super::table::{POSITIVE, Table, integer, number as number_of, set};
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

impl Counts {
    /// Revolutions of the motor, of which the drive counts so many in one.
    pub const fn revolutions(wire: f64) -> Counts {
        Counts { what: "revolutions of the motor", unit: Unit::Revolution, per_unit: 1.0, wire }
    }
}

/// Reads the common keys of a drive that counts `counts`.
pub fn axis(table: &mut Table<'_>, machine: &mut Machine, counts: Counts) -> AxisPlan {
    let name = name(table, machine, "drive", "every drive needs a name for programs and messages");
    let units = units(table, counts);
    let default = AxisPlan::new(name, units);
    let limits = limits(table, &units);
    let profile = profile(table, &default.profile, &limits);
    let load = load(table);
    let stop = stop(table, machine, default.stop, load, &profile);
    let divisor = table.integer("divisor", 1..=1000, "1 is an exchange every cycle").unwrap_or(1);
    let phase = table
        .integer("phase", 0..=999, "the one of its divisor cycles in which the drive has its exchange")
        .unwrap_or(0);
    let exchange_ns = machine.period_ns.saturating_mul(u64::from(divisor));
    let mut plan = AxisPlan {
        limits,
        profile,
        divisor,
        phase,
        health: health(table, exchange_ns),
        in_position: in_position(table, InPosition::new(&units, stop.standstill), exchange_ns),
        stop,
        load,
        ..default
    };
    set(&mut plan.underrun, underrun(table));
    let words = [("stop", FoundRunning::Stop), ("refuse", FoundRunning::Refuse)];
    set(&mut plan.on_found_running, table.word("on_found_running", &words));
    let words = [("stop", OwnerLost::Stop), ("finish", OwnerLost::Finish)];
    set(&mut plan.on_owner_lost, table.word("on_owner_lost", &words));
    let age = "the cycles for which a velocity setpoint is valid";
    set(&mut plan.setpoint_age, table.integer("setpoint_age", 1..=1_000_000, age));
    let deadman = "a jog that is not renewed within this time is stopped; or \"off\"";
    let deadman_ns = table.time_or_off("jog_deadman", MS..=60 * S, deadman);
    set(&mut plan.jog_deadman, deadman_ns.map(|ns| ns.map(Duration::from_nanos)));
    time(table, &mut plan.enable_timeout, "enable_timeout", 600, "the longest time until power is on");
    time(table, &mut plan.home_timeout, "home_timeout", 3600, "the longest time for homing");
    let mut queue = |place: &mut usize, key, least: i128| {
        set(place, table.integer(key, least..=1_000_000, "room in entries"));
    };
    queue(&mut plan.command_queue, "command_queue", 1);
    queue(&mut plan.stream_queue, "stream_queue", 1);
    queue(&mut plan.event_queue, "event_queue", 1);
    queue(&mut plan.sample_queue, "sample_queue", 0);
    queue(&mut plan.parameter_queue, "parameter_queue", 1);
    table.faults(plan.faults());
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

/// A number above 0, or "off".
fn or_off(table: &mut Table<'_>, key: &'static str, hint: &str) -> Option<Option<f64>> {
    table.read_or(key, Form::number(POSITIVE), "off", |value| {
        let number = number_of(value).filter(|number| *number > 0.0);
        number.ok_or_else(|| format!("must be a number above 0, or \"off\"; {hint}"))
    })
}

/// When a move of a drive with an exchange every `exchange_ns` has arrived.
fn in_position(table: &mut Table<'_>, mut of: InPosition, exchange_ns: u64) -> InPosition {
    table.table("in_position", |table| {
        set(&mut of.window, or_off(table, "window", "units between a target and the actual position"));
        let reports = "the good exchanges in a row inside the window";
        set(&mut of.reports, table.count("for", 1..=60_000, exchange_ns, reports));
        time(table, &mut of.timeout, "timeout", 600, "the longest time from the end of the demand");
        of
    })
}

fn time(table: &mut Table<'_>, place: &mut Duration, key: &'static str, most_s: u64, hint: &str) {
    set(place, table.time(key, MS..=most_s * S, hint).map(Duration::from_nanos));
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
    let limits = table.table("limits", |table| {
        let position = table.interval("position", "in user units");
        let mut most = |key, hint| table.number(key, POSITIVE, hint);
        let error = "units between demand and actual position";
        Limits {
            position,
            velocity: most("velocity", "units/s; leave it out for the drive's own limit"),
            acceleration: most("acceleration", "units/s²; leave it out for the drive's own limit"),
            step: most("step", "units between two streamed rows; leave it out for no limit"),
            torque: most("torque", "per cent of the rated torque; leave it out for the drive's own limit"),
            homing: most("homing", "units/s while it homes; leave it out for that of velocity"),
            following_error: match or_off(table, "following_error", error) {
                None => FollowingError::Derived,
                Some(None) => FollowingError::Off,
                Some(Some(most)) => FollowingError::Most(most),
            },
        }
    });
    if let Some((low, high)) = limits.position {
        let counts = |end: i32| f64::from(end) / units.counts_per_unit + units.offset;
        let ends = (counts(i32::MIN), counts(i32::MAX));
        let reach = (ends.0.min(ends.1), ends.0.max(ends.1));
        if low < reach.0 || high > reach.1 {
            let (low, high, unit) = (reach.0, reach.1, units.unit);
            let why = format!(
                "exceeds the range of the drive's 32-bit counts, {low} ... {high} {unit}; narrow it or check scale \
                 and offset"
            );
            table.fault("limits.position", why);
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
    let mut health = Health::default();
    table.table("health", |table| {
        let bucket = "the misses that fill the bucket: then the link is lost";
        set(&mut health.bucket, table.count("bucket", 1..=10_000, exchange_ns, bucket));
        let leak = "the good exchanges in a row that take one miss out of the bucket";
        set(&mut health.leak, table.integer("leak", 1..=1_000_000, leak));
        let gate = "the good exchanges in a row after which the link is up";
        set(&mut health.gate, table.integer("gate", 1..=1_000_000, gate));
        // Faster, and the requests to an absent drive can fill the send buffer of the living.
        let probe = "the time between two requests to an absent drive";
        let probe_ns = table.time("probe_interval", 10 * MS..=10 * S, probe);
        set(&mut health.probe_interval, probe_ns.map(Duration::from_nanos));
        health
    })
}

fn stop(
    table: &mut Table<'_>,
    machine: &mut Machine,
    mut stop: StopPlan,
    load: Load,
    profile: &Profile,
) -> StopPlan {
    // Where only the drive holds the load, it stays on unless the file says otherwise; `check` says what that means.
    if load == Load::Vertical(HeldBy::Drive) {
        (stop.then, stop.on_timeout) = (StopThen::Hold, StopTimeout::Hold);
    }
    table.table("stop", |table| {
        set(&mut stop.how, table.word("how", &HOWS));
        let deceleration = "units/s²; leave it out for profile.deceleration";
        let deceleration = table.number("deceleration", POSITIVE, deceleration);
        stop.deceleration = deceleration.unwrap_or(profile.deceleration);
        set(&mut stop.then, table.word("then", &THENS));
        time(table, &mut stop.timeout, "timeout", 600, "the longest time to standstill");
        set(&mut stop.on_timeout, table.word("on_timeout", &TIMEOUTS));
        let standstill = "units/s; a lower speed is standstill";
        set(&mut stop.standstill, table.number("standstill", POSITIVE, standstill));
        let reports = "good exchanges in a row below the standstill speed";
        set(&mut stop.standstill_for, table.integer("standstill_for", 1..=100_000, reports));
        let group = "a name of 1 to 32 letters, digits, - _ or .; leave it out to stop alone";
        let group = table.text("group", SHORT_NAME, group, plain_name);
        stop.group = group.map(|group| machine.group(table, group));
        stop
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
            let only = value.as_table().filter(|table| table.len() == 1);
            let count = only.and_then(|table| integer(table.get("extrapolate")?.get_ref()));
            let count = count.filter(|count| (1..=1000).contains(count)).map(|count| count as u32);
            count.map(Underrun::Extrapolate).ok_or(FORMS.into())
        }
    })
}
