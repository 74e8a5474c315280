//! One axis as configured, already checked. `config/` builds it from TOML, an embedder by hand.

use std::fmt::Display;
use std::time::Duration;

use super::command::Profile;
use super::units::{Unit, Units};
use crate::time::{Ns, S, nanos};

/// Names stand in messages, file names and arguments, so they are kept plain.
pub fn is_plain_name(name: &str) -> bool {
    let plain = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_' | '.');
    (1..=32).contains(&name.chars().count()) && name.chars().all(plain)
}

/// The settings of one axis for the loop and the application. Settings that only its protocol needs are in the
/// protocol's own drive plan.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisPlan {
    /// The name, unique in the machine.
    pub name: String,
    /// User units.
    pub units: Units,
    /// Limits in user units.
    pub limits: Limits,
    /// The profile of moves that name none.
    pub profile: Profile,
    /// An exchange every so many cycles, at least 1.
    pub divisor: u32,
    /// The cycle of these in which it exchanges, `0 .. divisor`.
    pub phase: u32,
    /// When a link counts as up and as lost.
    pub health: Health,
    /// How the axis stops when the master stops it.
    pub stop: StopPlan,
    /// When a move has arrived.
    pub in_position: InPosition,
    /// The reaction to a stream that runs empty.
    pub underrun: Underrun,
    /// The treatment of a drive that is found enabled or moving.
    pub on_found_running: FoundRunning,
    /// The reaction when the application drops its [`Axis`](super::Axis).
    pub on_owner_lost: OwnerLost,
    /// The behaviour of the load when nothing holds it.
    pub load: Load,
    /// A cyclic velocity or torque setpoint older than so many cycles stops the axis.
    pub setpoint_age: u32,
    /// A jog that is not renewed within this time stops the axis; `None`: it runs until another command replaces
    /// it.
    pub jog_deadman: Option<Duration>,
    /// Longest time for Enable, Disable and ResetFault.
    pub enable_timeout: Duration,
    /// Longest time for Home.
    pub home_timeout: Duration,
    /// Room in the command queue.
    pub command_queue: usize,
    /// Room in the stream, rows.
    pub stream_queue: usize,
    /// Room in the event queue.
    pub event_queue: usize,
    /// Room for the feedback of every cycle; 0 = only the newest is kept.
    pub sample_queue: usize,
    /// Room in the queue of acyclic calls.
    pub parameter_queue: usize,
}

/// A variable that a drive reports in addition to its process data.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MonitorChannel {
    /// The name.
    pub name: String,
    /// The unit of its values; empty for a plain number.
    pub unit: &'static str,
}

impl MonitorChannel {
    /// The names of those that are there, in a row; `None`: none is.
    #[doc(hidden)]
    pub fn names(shown: impl IntoIterator<Item = Option<MonitorChannel>>) -> Option<String> {
        let names: Vec<String> = shown.into_iter().flatten().map(|channel| channel.name).collect();
        (!names.is_empty()).then(|| names.join(", "))
    }
}

impl AxisPlan {
    /// An axis of this name and unit, with the defaults of the configuration for everything else.
    pub fn new(name: impl Into<String>, units: Units) -> AxisPlan {
        // Usual values of the unit: speed, acceleration, and the speed that counts as standstill.
        let (velocity, acceleration, standstill) = match units.unit {
            Unit::Millimetre => (100.0, 1000.0, 5.0),
            Unit::Revolution => (1.0, 10.0, 0.05),
        };
        AxisPlan {
            name: name.into(),
            in_position: InPosition::new(&units, standstill),
            units,
            limits: Limits::default(),
            profile: Profile { velocity, acceleration, deceleration: acceleration },
            divisor: 1,
            phase: 0,
            health: Health::default(),
            stop: StopPlan {
                how: StopHow::Ramp,
                deceleration: acceleration,
                then: StopThen::Disable,
                timeout: Duration::from_secs(3),
                on_timeout: StopTimeout::Disable,
                standstill,
                standstill_for: 20,
                group: None,
            },
            underrun: Underrun::Stop,
            on_found_running: FoundRunning::Stop,
            on_owner_lost: OwnerLost::Stop,
            load: Load::Level,
            setpoint_age: 10,
            jog_deadman: Some(Duration::from_millis(500)),
            enable_timeout: Duration::from_secs(5),
            home_timeout: Duration::from_secs(60),
            command_queue: 64,
            stream_queue: 1024,
            event_queue: 256,
            sample_queue: 0,
            parameter_queue: 64,
        }
    }
}

/// A mistake in a plan: the key as the configuration calls it, and what would be right.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlanFault {
    /// The key below the axis, like `stop.then`.
    pub key: &'static str,
    /// The mistake, and the remedy.
    pub message: String,
}

impl PlanFault {
    /// `key` is wrong for this reason.
    pub fn new(key: &'static str, message: impl Into<String>) -> PlanFault {
        PlanFault { key, message: message.into() }
    }
}

/// The mistakes of a plan, as they are found.
pub trait Faults {
    /// `key` is wrong for this reason.
    fn wrong(&mut self, key: &'static str, message: impl Display);

    /// `key` is wrong for this reason, if it `is`.
    fn wrong_if(&mut self, is: bool, key: &'static str, message: impl Display) {
        if is {
            self.wrong(key, message);
        }
    }
}

impl Faults for Vec<PlanFault> {
    fn wrong(&mut self, key: &'static str, message: impl Display) {
        self.push(PlanFault::new(key, message.to_string()));
    }
}

impl AxisPlan {
    /// The contradictions in this plan, and settings that would not work: the same checks for a file and for a plan
    /// built in code.
    pub fn faults(&self) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        self.check_numbers(&mut faults);
        self.check_schedule(&mut faults);
        self.check_stop(&mut faults);
        self.check_load(&mut faults);
        faults
    }

    fn check_numbers(&self, faults: &mut Vec<PlanFault>) {
        let positive = |value: f64| value.is_finite() && value > 0.0;
        let (units, limits) = (&self.units, &self.limits);
        let finite = positive(units.counts_per_unit.abs()) && units.offset.is_finite();
        faults.wrong_if(!finite, "scale", "must be a finite number other than 0, and offset must be finite");
        let wrong = units.modulo.is_some_and(|turn| !positive(turn));
        faults.wrong_if(wrong, "modulo", "must be above 0: the length of one turn");
        if let Some((low, high)) = limits.position {
            // NaN is not a limit either.
            let rises = low.partial_cmp(&high) == Some(std::cmp::Ordering::Less);
            faults.wrong_if(!rises, "limits.position", "must rise: [lowest, highest]");
            let why = "a modulo axis turns without end; leave out one of the two";
            faults.wrong_if(units.modulo.is_some(), "limits.position", why);
        }
        for (key, limit) in [
            ("limits.velocity", limits.velocity),
            ("limits.acceleration", limits.acceleration),
            ("limits.step", limits.step),
            ("limits.torque", limits.torque),
            ("limits.homing", limits.homing),
        ] {
            let wrong = limit.is_some_and(|limit| !positive(limit));
            faults.wrong_if(wrong, key, "must be above 0; leave it out for no limit");
        }
        let count = (1.0 / units.counts_per_unit).abs();
        let most = match limits.following_error {
            FollowingError::Most(most) => Some(most),
            FollowingError::Derived | FollowingError::Off => None,
        };
        for (key, window) in
            [("in_position.window", self.in_position.window), ("limits.following_error", most)]
        {
            // Written so that no number is not wide enough.
            let narrow = window.is_some_and(|window| !(window.is_finite() && window >= count));
            let unit = units.unit;
            let why = format!("must be a count of the drive at least, {count} {unit}; or \"off\"");
            faults.wrong_if(narrow, key, why);
        }
        for (key, value, limit, most) in [
            ("profile.velocity", self.profile.velocity, "velocity", limits.velocity),
            ("profile.acceleration", self.profile.acceleration, "acceleration", limits.acceleration),
            ("profile.deceleration", self.profile.deceleration, "acceleration", limits.acceleration),
        ] {
            match most {
                _ if !positive(value) => faults.wrong(key, "must be above 0"),
                Some(most) if value > most => {
                    let why = format!("exceeds limits.{limit} = {most}; lower it or raise the limit");
                    faults.wrong(key, why);
                }
                _ => {}
            }
        }
    }

    fn check_schedule(&self, faults: &mut Vec<PlanFault>) {
        let divisor = self.divisor;
        let why = format!("must be below divisor = {divisor}; 0 is the first of its cycles");
        faults.wrong_if(self.phase >= divisor, "phase", why);
        for (key, value) in [
            ("health.bucket", self.health.bucket),
            ("health.leak", self.health.leak),
            ("health.gate", self.health.gate),
            ("stop.standstill_for", self.stop.standstill_for),
            ("in_position.for", self.in_position.reports.into()),
            ("setpoint_age", self.setpoint_age),
        ] {
            faults.wrong_if(value == 0, key, "must be at least 1");
        }
        for (key, room) in [
            ("command_queue", self.command_queue),
            ("stream_queue", self.stream_queue),
            ("event_queue", self.event_queue),
        ] {
            faults.wrong_if(room == 0, key, "must have room for at least one entry");
        }
    }

    /// A ramp that cannot end in time would always end by `on_timeout`.
    fn check_stop(&self, faults: &mut Vec<PlanFault>) {
        let (stop, unit) = (&self.stop, self.units.unit);
        if !(stop.deceleration > 0.0 && stop.deceleration.is_finite()) {
            return faults.wrong("stop.deceleration", "must be above 0");
        }
        let positive = stop.standstill > 0.0 && stop.standstill.is_finite();
        faults.wrong_if(!positive, "stop.standstill", "must be above 0");
        let velocity = self.limits.velocity.unwrap_or(self.profile.velocity);
        let needed = velocity / stop.deceleration;
        if stop.how == StopHow::Ramp && needed > stop.timeout.as_secs_f64() {
            let (needed, allowed) = (Ns((needed.min(1e9) * S as f64) as u64), Ns(nanos(stop.timeout)));
            let ramp = format!("the ramp from {velocity} {unit}/s at {} {unit}/s²", stop.deceleration);
            let remedy = "allow more, or raise stop.deceleration";
            faults.wrong(
                "stop.timeout",
                format_args!("{ramp} takes {needed}, longer than {allowed}; {remedy}"),
            );
        }
    }

    /// Checks the settings that would let a vertical load drop.
    fn check_load(&self, faults: &mut Vec<PlanFault>) {
        let Load::Vertical(held_by) = self.load else { return };
        let why = "would let a vertical load drop; use \"ramp\" or \"quick\"";
        faults.wrong_if(self.stop.how == StopHow::Coast, "stop.how", why);
        if held_by == HeldBy::Drive {
            let why = "would drop a load that only the drive holds; use \"hold\", or name a brake: \
                 held_by = \"brake\"";
            faults.wrong_if(self.stop.then == StopThen::Disable, "stop.then", why);
            faults.wrong_if(self.stop.on_timeout == StopTimeout::Disable, "stop.on_timeout", why);
        }
    }

    /// Of a drive that only takes speeds: what only one with a position could do.
    #[doc(hidden)]
    pub fn position_faults(&self) -> Vec<PlanFault> {
        let (limits, units, mut faults) = (&self.limits, &self.units, Vec::new());
        for (key, given) in [
            ("limits.position", limits.position.is_some()),
            ("limits.step", limits.step.is_some()),
            ("limits.following_error", matches!(limits.following_error, FollowingError::Most(_))),
            ("modulo", units.modulo.is_some()),
            ("offset", units.offset != 0.0),
        ] {
            let why = "concerns positions, and this protocol has speeds only; leave it out";
            faults.wrong_if(given, key, why);
        }
        faults
    }

    /// Of a drive without torque setpoints, as `what` says.
    #[doc(hidden)]
    pub fn torque_fault(&self, what: &str) -> Option<PlanFault> {
        let why = || format!("has no effect: {what}; leave it out");
        self.limits.torque.map(|_| PlanFault::new("limits.torque", why()))
    }

    /// Of a drive that does not always hold its load, as `what` says.
    #[doc(hidden)]
    pub fn dropped_fault(&self, what: &str) -> Option<PlanFault> {
        let why = || format!("{what}, and the load drops; name a brake: held_by = \"brake\"");
        (self.load == Load::Vertical(HeldBy::Drive)).then(|| PlanFault::new("held_by", why()))
    }

    /// Of these values, each by its key, with its range and what it is per: those outside of the range of the drive,
    /// with the remedy. Its ends are shown as `shown` makes them.
    #[doc(hidden)]
    pub fn range_faults(
        &self,
        values: impl IntoIterator<Item = (&'static str, f64, [f64; 2], &'static str)>,
        shown: impl Fn([f64; 2]) -> [f64; 2],
        remedy: &str,
    ) -> Vec<PlanFault> {
        let (unit, mut faults, mut reported) = (self.units.unit, Vec::new(), None);
        for (key, value, [least, most], per) in values {
            // One acceleration may stand in for several of them.
            if (least..=most).contains(&value) || reported == Some((value, per)) {
                continue;
            }
            let [least, most] = shown([least, most]);
            let what = format!("{value} is outside the range of the drive");
            faults.wrong(key, format_args!("{what}, {least} ... {most} {unit}/{per}; {remedy}"));
            reported = Some((value, per));
        }
        faults
    }

    /// The velocities that are fixed, by their keys: that of moves, and the limit if there is one.
    #[doc(hidden)]
    pub fn velocities(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let limit = self.limits.velocity.map(|most| ("limits.velocity", most));
        [("profile.velocity", self.profile.velocity)].into_iter().chain(limit)
    }
}

/// The behaviour of the load of an axis when nothing holds it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Load {
    /// It stays where it is.
    #[default]
    Level,
    /// It drops.
    Vertical(HeldBy),
}

/// The holder of a vertical load while the axis stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeldBy {
    /// A brake that the drive is configured to close before it powers off. Power goes off at standstill, or by the
    /// stop's time-out.
    Brake,
    /// The powered drive alone. The master never powers it off by itself, not even at its own end.
    Drive,
}

/// Limits of an axis in user units; `None` = the drive's own limit only.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Limits {
    /// Smallest and largest position.
    pub position: Option<(f64, f64)>,
    /// Largest speed, units/s.
    pub velocity: Option<f64>,
    /// Largest acceleration and deceleration, units/s².
    pub acceleration: Option<f64>,
    /// Largest distance between two streamed rows, units.
    pub step: Option<f64>,
    /// Largest torque in either direction, per cent of the motor's rated torque.
    pub torque: Option<f64>,
    /// Largest speed while it homes, units/s; `None` = as `velocity`.
    pub homing: Option<f64>,
    /// Largest distance between the demand and the actual position in a motion.
    pub following_error: FollowingError,
}

/// A motor lags behind its demand by no more than the way in this time, s: a position controller without a feed-forward
/// of the velocity has a gain of 20 1/s at least.
const LAG_S: f64 = 0.05;

impl AxisPlan {
    /// The largest following error where the actual position of a report is that of `behind_ns` before its demand;
    /// `None` = it is not watched.
    #[doc(hidden)]
    pub fn most_following_error(&self, behind_ns: u64) -> Option<f64> {
        match self.limits.following_error {
            FollowingError::Off => None,
            FollowingError::Most(most) => Some(most),
            FollowingError::Derived => {
                let lag_s = behind_ns as f64 * 1e-9 + LAG_S;
                let counts = (InPosition::COUNTS / self.units.counts_per_unit).abs();
                let margin = self.in_position.window.unwrap_or(0.0).max(counts);
                self.limits.velocity.map(|velocity| velocity * lag_s + margin)
            }
        }
    }
}

/// The largest following error of an axis.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum FollowingError {
    /// Where the demand is the master's and the velocity has a limit: the way at that limit in the age of the feedback
    /// and 50 ms, and the window of [`InPosition`].
    #[default]
    Derived,
    /// Not watched.
    Off,
    /// A fixed number of units, whatever makes the demand.
    Most(f64),
}

impl Limits {
    /// Largest speed while it homes, units/s.
    pub fn homing_velocity(&self) -> Option<f64> {
        self.homing.or(self.velocity)
    }
}

/// Link health: a leaky bucket over exchanges. A miss puts one in, `leak` good exchanges in a row take one out, and a
/// full bucket is a lost link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Health {
    /// The number of misses that fill the bucket; then the link is lost.
    pub bucket: u32,
    /// The number of good exchanges in a row that let one miss leak away.
    pub leak: u32,
    /// The number of good exchanges in a row that bring a link up.
    pub gate: u32,
    /// Interval of the requests to a drive that was never seen, or is lost.
    pub probe_interval: Duration,
}

impl Default for Health {
    /// Lost when 5 misses more than good exchanges came, up after 10 good ones in a row, probed every 100 ms: where 1 %
    /// of all datagrams are lost in either direction, that is less than one loss in 10^8 exchanges.
    fn default() -> Health {
        Health { bucket: 5, leak: 1, gate: 10, probe_interval: Duration::from_millis(100) }
    }
}

impl Health {
    /// One miss in so many exchanges, evenly spread, never loses the link.
    #[doc(hidden)]
    pub fn tolerates_one_in(&self) -> u64 {
        u64::from(self.leak) + 1
    }

    /// Twice as many misses, evenly spread, lose the link in so many exchanges.
    #[doc(hidden)]
    pub fn lost_at_twice_that(&self) -> u64 {
        let misses = u64::from(self.bucket.saturating_sub(1));
        misses.saturating_mul(self.tolerates_one_in()).div_ceil(2).saturating_add(1)
    }

    /// The average number of exchanges until a link is lost that has just come up, where each exchange is missed
    /// with the probability `share`, whatever became of the one before.
    #[doc(hidden)]
    pub fn exchanges_to_loss(&self, share: f64) -> f64 {
        // From one level to the next there is a run of exchanges that ends with a miss, or with a leak back to the
        // level before.
        let leaks = (1.0 - share).powf(self.leak.into());
        let (run, fills) = ((1.0 - leaks) / share, 1.0 - leaks);
        let (mut all, mut one) = (0.0, 0.0);
        for level in 0..self.bucket {
            one = if level == 0 { 1.0 / share } else { (run + leaks * one) / fills };
            all += one;
        }
        all
    }
}

/// When a move has arrived: its drive has it, its demand is at the target, and the actual position is near it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InPosition {
    /// So near, units; `None` = the end of the demand is the end of the move.
    pub window: Option<f64>,
    /// In so many good exchanges in a row, at least 1.
    pub reports: u16,
    /// The longest time from the end of the demand until then; later the move fails.
    pub timeout: Duration,
}

impl InPosition {
    /// The default window is the way at the speed of standstill in a tenth of a second.
    const PER_SECOND: f64 = 10.0;
    /// A position controller comes to rest some counts away.
    const COUNTS: f64 = 4.0;

    /// The default of an axis that stands still below `standstill`, units/s.
    pub fn new(units: &Units, standstill: f64) -> InPosition {
        let counts = (InPosition::COUNTS / units.counts_per_unit).abs();
        InPosition {
            window: Some((standstill / InPosition::PER_SECOND).max(counts)),
            reports: 10,
            timeout: Duration::from_secs(1),
        }
    }
}

/// How the master stops an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StopPlan {
    /// How the axis is brought to standstill.
    pub how: StopHow,
    /// Deceleration of the ramp, units/s².
    pub deceleration: f64,
    /// The reaction after standstill.
    pub then: StopThen,
    /// Longest time to standstill.
    pub timeout: Duration,
    /// The reaction when standstill does not come in time.
    pub on_timeout: StopTimeout,
    /// Standstill: speed below this, units/s ...
    pub standstill: f64,
    /// ... for so many good exchanges in a row.
    pub standstill_for: u32,
    /// Axes of one group stop together; `None` = alone.
    pub group: Option<u16>,
}

/// How an axis is brought to standstill.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopHow {
    /// Along the stop plan's deceleration.
    Ramp,
    /// The drive's own quick stop.
    Quick,
    /// Power off at once.
    Coast,
}

/// The reaction after standstill.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopThen {
    /// Stay powered and in position.
    Hold,
    /// Power off.
    Disable,
}

/// The reaction when standstill does not come in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopTimeout {
    /// Stay powered.
    Hold,
    /// Power off.
    Disable,
}

/// The reaction to an empty stream. It is an event in every case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Underrun {
    /// Repeat the last position with velocity 0 until rows come again.
    Hold,
    /// Go on with the last velocity for so many exchanges, then stop.
    Extrapolate(u32),
    /// Stop the axis.
    Stop,
}

/// The treatment of a drive that is found enabled or moving at start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FoundRunning {
    /// Take over the control bits as found, then stop it as the stop plan says.
    Stop,
    /// Only read it; write nothing until the application commands the axis.
    Refuse,
}

/// The reaction when the application drops its [`Axis`](super::Axis), or the [`Group`](super::Group) that has it.
/// An axis that stands still, or runs a command of the in-loop task, goes on in either case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OwnerLost {
    /// Running and waiting commands are aborted, and the axis is stopped by the stop plan. A stop or power off that was
    /// requested before goes on.
    Stop,
    /// Running and waiting commands go on to their end.
    Finish,
}
