//! The watch over one axis by the reports of its drive: which of them it can have reached, and what it does that it
//! must not. Of every report that counts, and can be no older one, one sample is kept.
//!
//! - **Reach**: a place that lies farther from the last one than any motion of the axis leads proves nothing by itself.
//!   On a wire without sequence numbers such a report is an old one that came once more; on any other a damaged one, or
//!   that of an encoder which has started again. Two reports in a row that agree with each other are no damage: then
//!   the axis is there, whatever has put it there, and everything that was counted from its reference is void. The
//!   speed that is allowed is far above what the limits allow: an axis that is too fast is stopped by its limits, and
//!   its reports must not be missing there.
//! - **Limits** of the drive's demand while the axis is enabled, whatever commands it: the drive's own programs, its
//!   panel, or an application that writes the native process data. Moves, jogs and rows are checked before they are
//!   sent, so this finds nothing wrong with them. A drive that reports no demand is watched by its actual speed, one
//!   under torque by its actual speed and position. How much speed such a drive gains until a stop reaches it is not
//!   known; the way it makes is longer by as much.
//! - **Following**: in a motion the axis must also follow its demand. What its actual position is compared with is the
//!   demand of that time: the demand of the report, less the way at its velocity in the age of the position.
//! - **Rest**: while the axis has power, nothing moves it that nobody commands, be it idle, holding, or latched. A late
//!   duplicate of an old request, a parameter write, another master or the drive's own program can move a drive whose
//!   commands have all ended. What is left of an ended motion only decays: a speed that rises again, or that lasts, is
//!   a motion of its own.

use std::mem::offset_of;

use crate::axis::units::way;
use crate::axis::{AxisPlan, DriveStatus, Unit, Units};
use crate::bus::Slot;
use crate::bus::desired::Evidence;
use crate::time::{MS, Time, nanos};

/// The number of reports in a row that are proof: one that a disturbance has made leads there and back again.
const REPORTS: u32 = 3;

/// A speed just at its limit is not refused for the rounding of positions and instants.
const SPEED_MARGIN: f64 = 1.05;

/// A motor overshoots its setpoint: where only its actual speed is known, the margin is larger.
const ACTUAL_SPEED_MARGIN: f64 = 1.2;

/// How many counts of the drive may be due to rounding.
const COUNTS: f64 = 2.0;

/// An axis with a velocity limit is at most so many times as fast: it overshoots, or something pushes it ...
const OVER_LIMIT: f64 = 2.0;
/// ... and a slow one may be pushed as fast as this, user units/s: what a hand or a collision makes of a motor.
const PUSHED_MM: f64 = 1_000.0;
const PUSHED_REV: f64 = 10.0;
/// Nothing is faster, user units/s: the fastest linear motors reach 15 m/s, the fastest spindles 30 000 rpm. This is
/// the only bound of an axis without a velocity limit, and of one without power or that this master has not enabled.
const FASTEST_MM: f64 = 20_000.0;
const FASTEST_REV: f64 = 500.0;
/// A drive may have taken one of two positions by so much earlier than the other, ns, or by an exchange if that is
/// longer: its status may be some ms old (LinUDP sheet, 3.5).
const SHIFT_NS: u64 = 2 * MS;
/// The number of reports in a row that agree neither with the last one that counted nor with each other and are no
/// damage.
const MOST_HELD: u8 = 4;

/// An axis whose command is done stands still within this time, ns, or within `standstill_for` exchanges if that is
/// longer: its motor may lag its setpoint.
const SETTLED_WITHIN_NS: u64 = 50 * MS;
/// A stopped motor overshoots by no more than the speed that its stop takes away in this time, s.
const OVERSHOOT_SECONDS: f64 = 0.01;

/// One report of the drive.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub(super) struct Sample {
    /// When its request left.
    pub sent_at: Time,
    /// When it was taken in.
    pub at: Time,
    /// Actual and demand position, user units, not folded into one turn, and the velocity of the demand.
    pub position: f64,
    pub demand: f64,
    pub demand_velocity: f64,
    /// The value that shows how the axis is led: the demand, or the actual position of a drive that is not led by it,
    /// user units within one turn; NaN if the drive reports none, or if this is no report.
    pub shown: f64,
    /// Actual velocity, user units/s.
    pub velocity: f64,
    /// Positions are counted from the reference.
    pub homed: bool,
    /// The demand leads the drive; under torque no position does.
    pub led: bool,
}

impl Sample {
    /// The report in the slot, to a request that left at `sent_at`.
    #[inline]
    pub fn of(sent_at: Time, led: bool, slot: &Slot) -> Sample {
        let DriveStatus { at, homed, velocity, .. } = slot.status;
        let Evidence { position, demand, demand_velocity, .. } = slot.evidence;
        let shown = if led { slot.status.demand } else { slot.status.position };
        Sample { sent_at, at, position, demand, demand_velocity, shown, velocity, homed, led }
    }

    /// Makes its places those of another report.
    pub fn write_places(&self, evidence: &mut Evidence) {
        let Sample { position, demand, demand_velocity, .. } = *self;
        (evidence.position, evidence.demand, evidence.demand_velocity) = (position, demand, demand_velocity);
    }

    /// Whether it shows the demand velocity.
    #[inline]
    fn tells_demand(&self) -> bool {
        self.led && !self.shown.is_nan()
    }
}

/// The reported losses: power or the hardware enable, and the reference.
pub(super) type Losses = (bool, bool);

/// The treatment of a report that is not a usual one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Weight {
    /// It counts.
    Counts,
    /// It does not count.
    Held,
    /// It counts, and the axis has jumped by so much, user units.
    Jumped(f64),
}

/// How far the axis may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Bound {
    /// The origin may change: anywhere.
    None,
    /// As far as the fastest axis.
    Fastest,
    /// As far as its plan lets it.
    Plan,
}

/// Which limits hold for an axis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Watched {
    /// It homes: its positions change their origin, and it has a speed limit of its own.
    pub homing: bool,
    /// It must also be able to stop inside its range.
    pub braking: bool,
}

/// The permitted motion of an axis with power.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) enum Phase {
    /// Move: something commands it.
    #[default]
    Commanded,
    /// Brake: its command has failed ...
    Failed,
    /// ... since then, and the lowest speed since then, user units/s.
    Braking { since: Time, slowest: f64 },
    /// Brake: its stop sequence runs, and ends at standstill.
    Stopping,
    /// Come to rest, with the overshoot that belongs to it. Since when, and the highest speed of that, user units/s.
    Settling { since: Time, fastest: f64 },
    /// Nothing. One without power, too: what comes with power that no command has switched on is a motion of its own.
    Resting,
}

/// Reports in a row that show the same, in one direction.
#[derive(Clone, Copy, Debug, Default)]
struct InARow {
    count: u32,
    forward: bool,
}

impl InARow {
    /// One more report, of a motion at this velocity. Whether it shows it, and so do enough before it.
    #[inline]
    fn prove(&mut self, shown: bool, velocity: f64) -> bool {
        let forward = velocity >= 0.0;
        let before = if forward == self.forward { self.count } else { 0 };
        *self = InARow { count: if shown { before.saturating_add(1) } else { 0 }, forward };
        self.count >= REPORTS
    }
}

/// The watch over one axis. What each report touches stands last, from [`USUAL`](Watch::USUAL) on; what one of an axis
/// that nothing commands touches besides is one cache line before it.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct Watch {
    /// The last report that did not count.
    held: Sample,
    /// The origin of the positions may change until then.
    pub settles_until: Time,
    rules: Rules,
    rest: Rest,
    /// The last report that counted.
    last: Sample,
    /// The number of reports in a row that say a loss ...
    pub losses: u8,
    /// ... of as many that prove it; the newest of them says these.
    pub proof: u8,
    pub said: Losses,
    /// The position has jumped: what the drive says of its reference does not count until it homes or restarts.
    pub unreferenced: bool,
    /// The number of reports in a row that did not count.
    held_for: u8,
    /// The last report is new since the limits were looked at.
    fresh: bool,
    /// Something has commanded the axis since [`moves`](Self::moves) was called last.
    commanded: bool,
    /// Those that were too far from their demand.
    strayed: InARow,
    /// Those that were out of bounds.
    broken: InARow,
    /// Velocity of the demand between the last two of them, or the actual one, user units/s.
    velocity: f64,
    bounds: Bounds,
}

/// The values that each report is compared with.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
struct Bounds {
    /// The speed that is in reach, user units per ns.
    speed: f64,
    /// Of positions, user units.
    rounding: f64,
    shift_ns: u64,
    /// The largest following error; infinite = not watched.
    following: f64,
    /// The age of an actual position against the demand of its report, s.
    behind_s: f64,
    /// A demand that is no faster, and lies between these, breaks no limit. `low` is above `high`: there are no limits
    /// of positions.
    velocity: f64,
    low: f64,
    high: f64,
    /// The length of one turn; 0 = it is no rotary axis.
    turn: f64,
}

/// The expected motion of an axis that nothing commands.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
struct Rest {
    phase: Phase,
    /// Reports of a motion of its own.
    moved: InARow,
    standstill: f64,
    settles_ns: u64,
    deceleration: f64,
    /// From the first report of a motion that breaks a limit until a stop reaches the drive, s.
    reaction_s: f64,
}

/// The other limits of the plan.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
struct Rules {
    velocity: Option<f64>,
    position: Option<(f64, f64)>,
    /// Whole wrap-arounds of the drive's 32-bit counts are no way, nor are whole turns of a rotary axis.
    units: Units,
    homing: Option<f64>,
    /// The largest speed of all, user units per ns.
    fastest: f64,
    stop_timeout_ns: u64,
}

impl Watch {
    /// From here on it is touched by each report.
    pub const USUAL: usize = offset_of!(Watch, last);

    /// The watch over the axis of `plan`, whose exchanges are `interval_ns` apart, whose actual positions are so many
    /// ns behind the demand of their reports, and of which `proof` reports in a row prove a loss.
    pub fn new(plan: &AxisPlan, interval_ns: u64, behind_ns: u64, proof: u8) -> Watch {
        let (pushed, fastest) = match plan.units.unit {
            Unit::Millimetre => (PUSHED_MM, FASTEST_MM),
            Unit::Revolution => (PUSHED_REV, FASTEST_REV),
        };
        let limits = &plan.limits;
        let fastest = limits.velocity.map_or(fastest, |limit| fastest.max(OVER_LIMIT * limit));
        let speed = limits.velocity.map_or(fastest, |limit| (OVER_LIMIT * limit).max(pushed));
        let rounding = COUNTS / plan.units.counts_per_unit.abs();
        let (low, high) = limits.position.unwrap_or((f64::INFINITY, f64::NEG_INFINITY));
        Watch {
            held: Sample::default(),
            settles_until: Time(0),
            rules: Rules {
                velocity: limits.velocity,
                position: limits.position,
                units: plan.units,
                homing: limits.homing_velocity(),
                fastest: fastest * 1e-9,
                stop_timeout_ns: nanos(plan.stop.timeout),
            },
            rest: Rest {
                phase: Phase::default(),
                moved: InARow::default(),
                standstill: plan.stop.standstill,
                settles_ns: SETTLED_WITHIN_NS
                    .max(interval_ns.saturating_mul(plan.stop.standstill_for.into())),
                deceleration: plan.stop.deceleration,
                reaction_s: f64::from(REPORTS + 2) * interval_ns as f64 * 1e-9,
            },
            last: Sample { shown: f64::NAN, ..Sample::default() },
            losses: 0,
            proof,
            said: Losses::default(),
            unreferenced: false,
            held_for: 0,
            fresh: false,
            commanded: false,
            strayed: InARow::default(),
            broken: InARow::default(),
            velocity: 0.0,
            bounds: Bounds {
                speed: speed * 1e-9,
                rounding,
                shift_ns: SHIFT_NS.max(interval_ns),
                following: plan.most_following_error(behind_ns).unwrap_or(f64::INFINITY),
                behind_s: behind_ns as f64 * 1e-9,
                velocity: limits.velocity.map_or(f64::MAX, |limit| limit * SPEED_MARGIN),
                low: low - rounding,
                high: high + rounding,
                turn: plan.units.modulo.unwrap_or(0.0),
            },
        }
    }

    /// Forgets earlier reports for the speed and the following error.
    pub fn forget(&mut self) {
        (self.last.shown, self.velocity, self.fresh) = (f64::NAN, 0.0, false);
        (self.broken, self.strayed) = (InARow::default(), InARow::default());
    }

    /// The next report is no usual one: the one before did not count, or the drive's reference does not.
    #[inline]
    pub fn doubts(&self) -> bool {
        self.losses > 0 || self.unreferenced || self.held_for > 0
    }

    /// A report came in. True if the axis can be where it says; then it counts from now on. An axis of which nothing is
    /// known can be anywhere.
    #[inline]
    pub fn takes(&mut self, sample: Sample) -> bool {
        // An unknown position is not far away.
        let is_far = (sample.position - self.last.position).abs()
            > self.bounds.way(self.bounds.speed, &self.last, sample.at);
        if !is_far {
            self.keep(sample);
        }
        !is_far
    }

    /// This report counts from now on.
    #[inline]
    fn keep(&mut self, sample: Sample) {
        let last = &self.last;
        self.velocity = if !sample.tells_demand() {
            sample.velocity
        } else if last.homed == sample.homed && last.tells_demand() {
            // Which of the two telegrams was delayed is not known: the longer time is the safe one.
            let ns = sample.at.since(last.at).max(sample.sent_at.since(last.sent_at)).max(1);
            let way = way(self.bounds.modulo(), last.shown, sample.shown);
            (way.abs() - self.bounds.rounding).max(0.0).copysign(way) * 1e9 / ns as i64 as f64
        } else {
            // Homing gave the positions another origin, or there was none before: that was no motion.
            0.0
        };
        (self.last, self.fresh) = (sample, true);
    }

    /// Whether a report counts that [`takes`](Self::takes) has not taken, or that follows one that did not count. Its
    /// velocities that were made from a report that did not count are replaced.
    #[cold]
    pub fn weigh(&self, sample: &mut Sample, bound: Bound) -> Weight {
        let speed = match bound {
            Bound::None => return Weight::Counts,
            Bound::Fastest => self.rules.fastest,
            Bound::Plan => self.bounds.speed,
        };
        let new = *sample;
        let near = |place: &Sample| {
            let way = self.rules.units.unwrapped(new.position - place.position);
            let is_far = way.abs() > self.bounds.way(speed, place, new.at);
            !is_far
        };
        let (from, weight) = if near(&self.last) {
            (&self.last, Weight::Counts)
        } else if self.held_for > 0 && near(&self.held) || self.held_for >= MOST_HELD - 1 {
            (&self.held, Weight::Jumped(new.position - self.last.position))
        } else {
            return Weight::Held;
        };
        let passed_ns = new.sent_at.since(from.sent_at) as f64;
        let plausible = |reported: f64, way: f64| {
            let own = if passed_ns > 0.0 { way / passed_ns } else { 0.0 };
            match reported.abs() > speed * 1e9 {
                false => reported,
                true => {
                    if own.abs() <= speed {
                        own * 1e9
                    } else {
                        0.0
                    }
                }
            }
        };
        sample.velocity = plausible(new.velocity, new.position - from.position);
        sample.demand_velocity = plausible(new.demand_velocity, new.demand - from.demand);
        weight
    }

    /// Takes a report in that was weighed.
    pub fn take(&mut self, sample: Sample, weight: Weight) {
        if weight == Weight::Held {
            (self.held, self.held_for) = (sample, self.held_for + 1);
        } else {
            self.held_for = 0;
            self.keep(sample);
        }
    }

    /// The last report that counted.
    pub fn last(&self) -> &Sample {
        &self.last
    }

    /// The speed in the last report, user units/s; NaN if it is not known.
    pub fn speed(&self) -> f64 {
        self.velocity.abs()
    }

    /// Whether the axis does not follow its demand, by a report that was not evaluated yet.
    #[inline]
    pub fn strays(&mut self) -> bool {
        // An unknown position is not a distance.
        if self.following_error().abs() > self.bounds.following {
            return self.strays_on();
        }
        self.strayed.count = 0;
        false
    }

    /// The same where it is too far away, if not by whole wrap-arounds.
    #[cold]
    fn strays_on(&mut self) -> bool {
        let error = self.rules.units.unwrapped(self.following_error());
        self.fresh && self.strayed.prove(error.abs() > self.bounds.following, 0.0)
    }

    #[inline]
    fn following_error(&self) -> f64 {
        self.last.demand - self.last.position - self.velocity * self.bounds.behind_s
    }

    /// Whether the drive does what the plan forbids. Where it must also be able to stop inside its range: from where it
    /// will be when a stop reaches it, after [`REPORTS`] and two exchanges.
    #[inline]
    pub fn is_broken(&mut self, watched: Watched) -> bool {
        if !std::mem::take(&mut self.fresh) {
            return false;
        }
        let forbidden = !self.is_allowed(watched) && self.is_forbidden(watched);
        self.broken.prove(forbidden, self.velocity)
    }

    /// By what a usual report is compared with alone, it is certainly not forbidden.
    #[inline]
    fn is_allowed(&self, watched: Watched) -> bool {
        let Watch { bounds, velocity, last, .. } = self;
        // An unknown value is not inside, nor is it certainly outside.
        let inside = bounds.low > bounds.high
            || *velocity == 0.0
            || !watched.braking && last.shown >= bounds.low && last.shown <= bounds.high;
        velocity.abs() <= bounds.velocity && inside && !watched.homing
    }

    /// Whether it is forbidden, in any motion.
    #[inline(never)]
    fn is_forbidden(&self, Watched { homing, braking }: Watched) -> bool {
        let (Watch { rules, rest, velocity, .. }, sample) = (self, &self.last);
        // Written so that an unknown value is not inside.
        let margin = if sample.tells_demand() { SPEED_MARGIN } else { ACTUAL_SPEED_MARGIN };
        let most = if homing { rules.homing } else { rules.velocity };
        let slow = most.is_none_or(|most| velocity.abs() <= most * margin);
        let inside = rules.position.filter(|_| sample.homed && !homing).is_none_or(|(low, high)| {
            let braking_s = velocity.abs() / (2.0 * rest.deceleration) + rest.reaction_s;
            let end = sample.shown + velocity * if braking { braking_s } else { 0.0 };
            // From outside, a motion may lead back in.
            *velocity == 0.0
                || *velocity > 0.0 && end <= high + self.bounds.rounding
                || *velocity < 0.0 && end >= low - self.bounds.rounding
        });
        !(slow && inside)
    }

    /// Sets the permitted motion of the axis from now on.
    #[inline]
    pub fn expect(&mut self, phase: Phase) {
        self.commanded = phase == Phase::Commanded;
        if !self.commanded {
            (self.rest.phase, self.rest.moved) = (phase, InARow::default());
        }
    }

    /// A clean report of an axis with power that nothing commands. True if it moves by itself.
    pub fn moves(&mut self, now: Time, report: &DriveStatus) -> bool {
        if std::mem::take(&mut self.commanded) {
            (self.rest.phase, self.rest.moved) = (Phase::Commanded, InARow::default());
        }
        let (rest, velocity) = (&self.rest, report.velocity);
        // Without a velocity only the protocol knows.
        let speed = if velocity.is_nan() { 0.0 } else { velocity.abs() };
        let stands = !report.moving && speed <= rest.standstill;
        let settling = |fastest| Phase::Settling { since: now, fastest };
        let (phase, own) = match rest.phase {
            Phase::Stopping => {
                let overshoot = rest.standstill.max(rest.deceleration * OVERSHOOT_SECONDS);
                (settling(rest.standstill + overshoot), false)
            }
            Phase::Commanded => (settling(f64::INFINITY), false),
            Phase::Failed | Phase::Braking { .. } if stands => (settling(f64::INFINITY), false),
            Phase::Failed => (Phase::Braking { since: now, slowest: speed }, false),
            Phase::Braking { since, .. } if now.since(since) > self.rules.stop_timeout_ns => return true,
            Phase::Braking { since, slowest } => {
                (Phase::Braking { since, slowest: slowest.min(speed) }, speed > slowest + rest.standstill)
            }
            Phase::Settling { since, fastest } => {
                let rests = now.since(since) >= rest.settles_ns;
                (if rests { Phase::Resting } else { rest.phase }, speed > fastest)
            }
            Phase::Resting => (Phase::Resting, !stands),
        };
        self.rest.phase = phase;
        self.rest.moved.prove(own, velocity)
    }
}

impl Bounds {
    /// How far the axis can go at this speed from the `place` to where it is reported at `at`: the drive took the first
    /// position after its request had left, and the second one before its reply came in.
    #[inline]
    fn way(&self, speed: f64, place: &Sample, at: Time) -> f64 {
        speed * (at.since(place.sent_at) + self.shift_ns) as i64 as f64 + self.rounding
    }

    /// Of a rotary axis.
    #[inline]
    fn modulo(&self) -> Option<f64> {
        (self.turn > 0.0).then_some(self.turn)
    }
}

#[cfg(test)]
mod tests;
