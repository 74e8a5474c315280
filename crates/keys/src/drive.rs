//! The keys that a drive of every protocol has: an [`AxisPlan`].

use std::time::Duration;

use super::form::Form;
use super::key::Key;
use super::machine::Machine;
use super::table::{POSITIVE, Table, integer, number as number_of, set};
use super::value::{SHORT_NAME, plain_name};
use fieldbeat_core::axis::{
    AxisPlan, FollowingError, FoundRunning, Health, HeldBy, InPosition, Limits, Load, OwnerLost, Profile,
    StopHow, StopPlan, StopThen, StopTimeout, Underrun, Unit, Units,
};
use fieldbeat_core::time::{MS, S};

use crate::keys;

keys! {
    DIVISOR "divisor" = "1": "an exchange every so many cycles, 1 ... 1000";
    PHASE "phase" = "0": "in which of `divisor` cycles the exchange is, 0 ... `divisor` - 1";
    ON_FOUND_RUNNING "on_found_running" = "stop": "a drive that is enabled when the master starts, or "
        "begins to move before it is enabled: `\"stop\"` takes it over and stops it, `\"refuse\"` only "
        "reads it";
    ON_OWNER_LOST "on_owner_lost" = "stop": "a program that drops the axis, or the group that has it, "
        "while the axis moves: `\"stop\"` stops it, `\"finish\"` lets it go on to the end of what was "
        "commanded";
    SETPOINT_AGE "setpoint_age" = "10": "cycles for which a velocity or torque setpoint is valid; an older "
        "one stops the axis";
    JOG_DEADMAN "jog_deadman" = "500ms": "a jog that is not renewed within this time stops, or `\"off\"`: "
        "it runs until something replaces it";
    ENABLE_TIMEOUT "enable_timeout" = "5s": "longest time for Enable, Disable and ResetFault; and for "
        "which an Enable waits for the write of a [parameter that may command the "
        "drive](parameters.md#while-power-is-on)";
    HOME_TIMEOUT "home_timeout" = "60s": "longest time for Home";
    COMMAND_QUEUE "command_queue" = "64": "entries of the command queue";
    STREAM_QUEUE "stream_queue" = "1024": "entries of the queue of streamed rows";
    EVENT_QUEUE "event_queue" = "256": "entries of the event queue";
    SAMPLE_QUEUE "sample_queue" = "0": "entries of the queue with the feedback of every cycle; 0 keeps "
        "only the newest";
    PARAMETER_QUEUE "parameter_queue" = "64": "entries of the queue of parameter calls";
    LOAD "load" = "level": "`\"vertical\"`: the load drops when nothing holds it; needs `held_by`";
    HELD_BY "held_by" = "(required by a vertical load)": "what holds a vertical load: the drive's "
        "`\"brake\"`, or the powered `\"drive\"`, which the master then never powers off";
    WINDOW "window" = "(the way at `stop.standstill` in 100 ms, 4 counts at least: `0.5` mm, `0.005` rev)":
        "largest distance, units, between the target of a move, or a stream, and the actual position for the "
        "move to be done, or `\"off\"`: done when the demand is there";
    FOR "for" = "10": "good exchanges in a row within `in_position.window` and at standstill: then the "
        "move is done; a number, or a time such as `\"50ms\"`";
    TIMEOUT "timeout" = "1s": "longest time from the end of the demand until the axis is in position; "
        "later the move has failed";
    NAME "name" = "-": "name of the drive or device in programs and messages: 1 to 32 letters, digits, "
        "`-`, `_` or `.`; unique in the machine";
    UNITS "units" = "(`\"mm\"` for LinUDP, else `\"rev\"`)": "unit of length: `\"mm\"` or `\"rev\"`";
    SCALE "scale" = "(`10000` for LinUDP in mm, `1` for the others in rev)":
        "drive counts in one unit for LinUDP, revolutions of the motor in one unit for the others. "
        "Required with another unit; `invert` reverses the direction";
    INVERT "invert" = "false": "reverses the direction";
    OFFSET "offset" = "0": "position at the drive's count zero";
    MODULO "modulo" = "none": "length of one turn of a rotary axis, or of any length after which the "
        "position of an axis that runs on without end begins at 0 again. Without it the positions end with "
        "the 32-bit counts of the drive, and a move behind that end is refused";
    POSITION "position" = "none": "allowed range, units: `[lowest, highest]`";
    VELOCITY "velocity" = "none": "largest velocity, units/s; without it the drive's own limit holds";
    ACCELERATION "acceleration" = "none": "largest acceleration, units/s²; without it the drive's own "
        "limit holds";
    STEP "step" = "none": "largest distance between two streamed rows, units; without it there is no limit";
    TORQUE "torque" = "none": "largest torque setpoint, % of the rated torque; without it the drive's own "
        "limit holds";
    HOMING "homing" = "(that of velocity)": "largest speed while it homes, units/s";
    FOLLOWING_ERROR "following_error" = "([what follows from `limits.velocity`](stops.md#following-error) "
        "where the demand is the master's)":
        "largest distance between demand and actual position in a motion, units, or `\"off\"`: more in three "
        "fresh reports in a row stops the axis";
    PROFILE_VELOCITY "velocity" = "(`100` mm/s, `1` rev/s)": "velocity of a move without a profile, "
        "units/s; at most the limit";
    PROFILE_ACCELERATION "acceleration" = "(`1000` mm/s², `10` rev/s²)":
        "acceleration of such a move, units/s²; at most the limit";
    PROFILE_DECELERATION "deceleration" = "(`profile.acceleration`)": "deceleration of such a move, "
        "units/s²";
    BUCKET "bucket" = "5": "[misses that fill the bucket](stops.md#when-a-link-is-lost): then the link is "
        "lost; a number, or a time such as `\"50ms\"`";
    LEAK "leak" = "1": "good exchanges in a row that take one miss out of the bucket";
    GATE "gate" = "10": "good exchanges in a row that bring a link up";
    PROBE_INTERVAL "probe_interval" = "100ms": "how often a request goes to an absent drive; on EtherCAT, "
        "whose frame leaves in each cycle anyway, a drive takes part in all its cycles";
    HOW "how" = "ramp": "how the master stops the axis: along a ramp, by the drive's own `\"quick\"` stop, "
        "or `\"coast\"` (power off at once)";
    DECELERATION "deceleration" = "(`profile.deceleration`)": "deceleration of the ramp, units/s²; may "
        "exceed `limits.acceleration`";
    THEN "then" = "disable": "at standstill: power off, or `\"hold\"` (default where `held_by = \"drive\"`)";
    STOP_TIMEOUT "timeout" = "3s": "longest time to standstill";
    ON_TIMEOUT "on_timeout" = "disable": "without standstill by then: power off, or `\"hold\"` (default "
        "where `held_by = \"drive\"`)";
    STANDSTILL "standstill" = "(`5` mm/s, `0.05` rev/s)": "standstill is a velocity below this; keep it "
        "above the noise of the encoder";
    STANDSTILL_FOR "standstill_for" = "20": "good exchanges in a row below `stop.standstill`: then the "
        "axis is at standstill";
    GROUP "group" = "none": "drives with the same group name stop together";
    UNDERRUN "underrun" = "stop": "what an empty stream does: `\"stop\"`, `\"hold\"` (last position), or "
        "`{ extrapolate = 3 }` exchanges, then stop";
}

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
    let name = name(table, machine, "drive");
    let units = units(table, counts);
    let default = AxisPlan::new(name, units);
    let limits = limits(table, &units);
    let profile = profile(table, &default.profile, &limits);
    let load = load(table);
    let stop = stop(table, machine, default.stop, load, &profile);
    let divisor = table.integer(DIVISOR, 1..=1000).unwrap_or(1);
    let phase = table.integer(PHASE, 0..=999).unwrap_or(0);
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
    set(&mut plan.on_found_running, table.word(ON_FOUND_RUNNING, &words));
    let words = [("stop", OwnerLost::Stop), ("finish", OwnerLost::Finish)];
    set(&mut plan.on_owner_lost, table.word(ON_OWNER_LOST, &words));
    set(&mut plan.setpoint_age, table.integer(SETPOINT_AGE, 1..=1_000_000));
    let deadman_ns = table.time_or_off(JOG_DEADMAN, MS..=60 * S);
    set(&mut plan.jog_deadman, deadman_ns.map(|ns| ns.map(Duration::from_nanos)));
    time(table, &mut plan.enable_timeout, ENABLE_TIMEOUT, 600);
    time(table, &mut plan.home_timeout, HOME_TIMEOUT, 3600);
    let mut queue = |place: &mut usize, key, least: i128| {
        set(place, table.integer(key, least..=1_000_000));
    };
    queue(&mut plan.command_queue, COMMAND_QUEUE, 1);
    queue(&mut plan.stream_queue, STREAM_QUEUE, 1);
    queue(&mut plan.event_queue, EVENT_QUEUE, 1);
    queue(&mut plan.sample_queue, SAMPLE_QUEUE, 0);
    queue(&mut plan.parameter_queue, PARAMETER_QUEUE, 1);
    table.faults(plan.faults());
    plan
}

/// What the load does when nothing holds it; a vertical one names what does.
fn load(table: &mut Table<'_>) -> Load {
    let vertical = table.word(LOAD, &[("level", false), ("vertical", true)]).unwrap_or(false);
    let held_by = table.word(HELD_BY, &HOLDERS);
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
fn or_off(table: &mut Table<'_>, key: Key) -> Option<Option<f64>> {
    table.read_or(key, Form::number(POSITIVE), "off", |value| {
        let number = number_of(value).filter(|number| *number > 0.0);
        number.ok_or("must be a number above 0".into())
    })
}

/// When a move of a drive with an exchange every `exchange_ns` has arrived.
fn in_position(table: &mut Table<'_>, mut of: InPosition, exchange_ns: u64) -> InPosition {
    table.table("in_position", |table| {
        set(&mut of.window, or_off(table, WINDOW));
        set(&mut of.reports, table.count(FOR, 1..=60_000, exchange_ns));
        time(table, &mut of.timeout, TIMEOUT, 600);
        of
    })
}

fn time(table: &mut Table<'_>, place: &mut Duration, key: Key, most_s: u64) {
    set(place, table.time(key, MS..=most_s * S).map(Duration::from_nanos));
}

/// The name of a `kind`, a drive or a device.
pub fn name(table: &mut Table<'_>, machine: &mut Machine, kind: &'static str) -> String {
    let name =
        table.text(NAME, SHORT_NAME, "1 to 32 letters, digits, - _ or .", plain_name).unwrap_or_default();
    machine.claim_name(table, kind, &name);
    name
}

fn units(table: &mut Table<'_>, counts: Counts) -> Units {
    let unit =
        table.word(UNITS, &[("mm", Unit::Millimetre), ("rev", Unit::Revolution)]).unwrap_or(counts.unit);
    let given = table.number(SCALE, 1e-6..=1e12);
    if unit != counts.unit && !table.gives("scale") {
        table.fault("scale", format!("missing; give the number of {} in one {unit}", counts.what));
    }
    // Where it is missing, something usual stands in: one mistake, one message.
    let scale = given.unwrap_or(counts.per_unit) * counts.wire;
    let inverted = table.flag(INVERT).unwrap_or(false);
    Units {
        unit,
        counts_per_unit: if inverted { -scale } else { scale },
        offset: table.number(OFFSET, ..).unwrap_or(0.0),
        modulo: table.number(MODULO, POSITIVE),
    }
}

fn limits(table: &mut Table<'_>, units: &Units) -> Limits {
    let limits = table.table("limits", |table| {
        let position = table.interval(POSITION);
        let mut most = |key| table.number(key, POSITIVE);
        Limits {
            position,
            velocity: most(VELOCITY),
            acceleration: most(ACCELERATION),
            step: most(STEP),
            torque: most(TORQUE),
            homing: most(HOMING),
            following_error: match or_off(table, FOLLOWING_ERROR) {
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
        [PROFILE_VELOCITY, PROFILE_ACCELERATION, PROFILE_DECELERATION].map(|key| table.number(key, POSITIVE))
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
        set(&mut health.bucket, table.count(BUCKET, 1..=10_000, exchange_ns));
        set(&mut health.leak, table.integer(LEAK, 1..=1_000_000));
        set(&mut health.gate, table.integer(GATE, 1..=1_000_000));
        // Faster, and the requests to an absent drive can fill the send buffer of the living.
        let probe_ns = table.time(PROBE_INTERVAL, 10 * MS..=10 * S);
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
        set(&mut stop.how, table.word(HOW, &HOWS));
        let deceleration = table.number(DECELERATION, POSITIVE);
        stop.deceleration = deceleration.unwrap_or(profile.deceleration);
        set(&mut stop.then, table.word(THEN, &THENS));
        time(table, &mut stop.timeout, STOP_TIMEOUT, 600);
        set(&mut stop.on_timeout, table.word(ON_TIMEOUT, &TIMEOUTS));
        set(&mut stop.standstill, table.number(STANDSTILL, POSITIVE));
        set(&mut stop.standstill_for, table.integer(STANDSTILL_FOR, 1..=100_000));
        let group = "a name of 1 to 32 letters, digits, - _ or .; leave it out to stop alone";
        let group = table.text(GROUP, SHORT_NAME, group, plain_name);
        stop.group = group.map(|group| machine.group(table, group));
        stop
    })
}

fn underrun(table: &mut Table<'_>) -> Option<Underrun> {
    const FORMS: &str = "must be \"stop\", \"hold\" or { extrapolate = 3 } (exchanges)";
    let extrapolate = Form::Fields(vec![("extrapolate", Form::integer(1..=1000), true)]);
    table.read(UNDERRUN, Form::words(["stop", "hold"]).or(extrapolate), |value| match value.as_str() {
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
