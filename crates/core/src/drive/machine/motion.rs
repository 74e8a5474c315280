//! Drives that make their own setpoints: moves, a velocity as a target that rolls ahead, and rows that are streamed.

use super::view::View;
use super::{End, State, Step, near};
use crate::axis::{Failure, Profile, RangeError, Row};
use crate::bus::desired::{Generator, Motion, Ranges, Setpoint, Velocities};
use crate::drive::planner::Point;

/// A stream ends once the drive has accepted more than so many rows at standstill while its demand stood at the last
/// one: its output runs 1.5 of its periods behind, or a whole buffer where rows were held up on their way to it, and a
/// position that it has not reached when it leaves streaming is never reached ...
const LAST_ROWS: u16 = 3;
/// ... or so many while its demand stood elsewhere.
const MOST_LAST_ROWS: u16 = 50;
/// ... or so many in all: no drive's buffer, and no socket's, is as deep, and what moves on is not the stream.
const MOST_BEHIND: u16 = 5_000;
/// The next target of a velocity is sent when so much of its leash is left.
const LEASH_LEFT: f64 = 0.75;

/// A velocity that the drive makes: as a target that rolls ahead of the axis on a leash, or by itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rolling {
    /// Signed, user units/s; 0 = braking, or at standstill.
    velocity: f64,
    acceleration: f64,
    leash: Option<f64>,
    /// The last target sent, user units.
    target: f64,
    /// That is the position limit: it rolls no further. Without a target: a position limit may be ahead.
    watched: bool,
}

impl Rolling {
    /// Nothing is to be done: no other velocity is `wanted`, no limit is to be watched, and at `demand` the target is
    /// still far enough ahead.
    pub(super) fn goes_on(&self, wanted: f64, demand: f64) -> bool {
        let far = self.leash.is_none_or(|leash| (self.target - demand).abs() > leash * LEASH_LEFT);
        far && wanted == self.velocity && !self.watched && self.velocity != 0.0
    }

    /// The drive makes it by itself.
    pub(super) fn is_its_own(&self) -> bool {
        self.leash.is_none()
    }
}

impl State {
    pub(super) fn move_by_drive(&mut self, position: f64, profile: &Profile, step: Step, view: &View) -> End {
        let deceleration = self.braking_by_drive(profile.deceleration, view);
        let profile = Profile { deceleration, ..*profile };
        if let Err(range) = view.rules.can.ranges.check(position - self.origin(view), &profile) {
            return self.refuse(range.into(), view);
        }
        self.want_motion(Motion::Move { position, profile });
        self.begin_step(view.now, step)
    }

    /// Positions on the wire are counted from here: the count of a rotary axis wraps around, in the drive as in the
    /// master, so that a target is at most half of its range away from the demand.
    fn origin(&self, view: &View) -> f64 {
        if view.rules.axis.units.modulo.is_some() {
            view.evidence.demand
        } else {
            view.rules.axis.units.offset
        }
    }

    pub(super) fn brake_by_drive(&mut self, deceleration: f64, view: &View) {
        let least = view.rules.can.ranges.acceleration.0;
        let deceleration = self.braking_by_drive(deceleration, view).max(least);
        self.want_motion(Motion::Ramp {
            deceleration: deceleration.min(view.rules.can.ranges.acceleration.1),
        });
    }

    /// The deceleration that is requested, or needed from where the axis will be at the next send.
    fn braking_by_drive(&self, requested: f64, view: &View) -> f64 {
        // Before homing positions mean nothing.
        if !view.status.homed {
            return requested;
        }
        let from = Point { position: view.evidence.demand, velocity: view.evidence.demand_velocity };
        // Twice the way until then: the telegram may have to be repeated.
        let lost = 2.0 * from.velocity.abs() * view.now.since(view.status.at) as f64 * 1e-9;
        view.rules.braking(requested, from, lost)
    }

    pub(super) fn begin_rolling(&mut self, acceleration: f64, leash: Option<f64>, view: &View) -> End {
        let velocity = view.input.level;
        self.roll_on(Rolling { velocity, acceleration, leash, target: 0.0, watched: false }, view)
    }

    /// With each report: the newest velocity or target once the one before was accepted, and no limit is passed.
    pub(super) fn roll(&mut self, rolling: Rolling, settled: bool, view: &View) -> End {
        let Rolling { velocity, acceleration, .. } = rolling;
        if rolling.is_its_own() && velocity != 0.0 {
            let demand = view.evidence.demand_velocity;
            // What counts is its present direction, whatever is wanted.
            let present = if demand == 0.0 { velocity } else { demand };
            if self.is_limit_near(present, acceleration, view) {
                let (low, high) = view.rules.axis.limits.position.unwrap_or_default();
                self.brake_by_drive(acceleration, view);
                return self.begin_step(view.now, Step::Limited(if present > 0.0 { high } else { low }));
            }
        }
        if !self.is_accepted(view) {
            return None;
        }
        if view.input.level != velocity {
            return self.roll_on(Rolling { velocity: view.input.level, ..rolling }, view);
        }
        match rolling.is_its_own() {
            // Nothing of the master has ended it: a limit of the drive's own, or something else that commands it.
            true if settled && velocity != 0.0 => self.refuse(Failure::NotArrived, view),
            false if rolling.watched && settled => self.fail(view.rules.out_of_limits(rolling.target)),
            false
                if !rolling.watched
                    && velocity != 0.0
                    && !rolling.goes_on(view.input.level, view.evidence.demand) =>
            {
                self.roll_on(rolling, view)
            }
            _ => None,
        }
    }

    /// Another velocity, or the next target, a leash ahead of the demand; for velocity 0 a ramp.
    fn roll_on(&mut self, mut rolling: Rolling, view: &View) -> End {
        let Rolling { velocity, acceleration, .. } = rolling;
        let limits = view.rules.axis.limits.position;
        rolling.watched = rolling.is_its_own() && limits.is_some();
        if velocity == 0.0 {
            self.brake_by_drive(acceleration, view);
            return self.begin_step(view.now, Step::Rolling(rolling));
        }
        let demand = view.evidence.demand;
        let Some(leash) = rolling.leash else {
            if let Err(range) = view.rules.can.ranges.check_velocity(velocity.abs(), acceleration) {
                return self.refuse(range.into(), view);
            }
            if self.is_limit_near(velocity, acceleration, view) {
                return self.refuse(view.rules.out_of_limits(demand), view);
            }
            self.want_motion(Motion::Velocity { velocity, acceleration });
            return self.begin_step(view.now, Step::Rolling(rolling));
        };
        // Half of the leash is always ahead; the axis must be able to brake within it, or it would never reach that
        // speed.
        let most = (acceleration * leash).sqrt();
        if velocity.abs() > most {
            let what = "velocity within the leash";
            return self.refuse(Failure::Limit { what, value: velocity, low: -most, high: most }, view);
        }
        rolling.target = demand + leash.copysign(velocity);
        if let Some((low, high)) = limits {
            // Only the limit ahead ends the motion: from outside the range it leads back in.
            let forward = velocity > 0.0;
            let (ahead, beyond) =
                if forward { (high, rolling.target > high) } else { (low, rolling.target < low) };
            if beyond && (ahead - demand) * velocity <= 0.0 {
                return self.refuse(view.rules.out_of_limits(rolling.target), view);
            }
            rolling.watched = beyond;
            rolling.target = if beyond { ahead } else { rolling.target };
        }
        let profile = Profile { velocity: velocity.abs(), acceleration, deceleration: acceleration };
        self.move_by_drive(rolling.target, &profile, Step::Rolling(rolling), view)
    }

    /// At this velocity it could not be stopped any more before its position limit, with the time that a ramp takes to
    /// begin. Before homing positions mean nothing.
    fn is_limit_near(&self, velocity: f64, acceleration: f64, view: &View) -> bool {
        let Some((low, high)) = view.rules.axis.limits.position.filter(|_| view.status.homed) else {
            return false;
        };
        let Generator::Drive { velocities: Some(Velocities::Own { reaction_ns }) } = view.rules.can.generator
        else {
            return false;
        };
        let room = if velocity > 0.0 { high - view.evidence.demand } else { view.evidence.demand - low };
        let left = room - velocity.abs() * reaction_ns as f64 * 1e-9;
        left <= 0.0 || velocity * velocity >= 2.0 * acceleration * left
    }

    /// One row a send. A row that came before, in a slot that was passed over, is not counted twice.
    pub(super) fn follow_by_drive(&mut self, view: &View) -> End {
        let next = view.input.row?;
        if next.number == self.row {
            return None;
        }
        let row = Row {
            position: near(&view.rules.axis.units, view.evidence.demand, next.row.position),
            ..next.row
        };
        if let Err(range) = view.rules.can.ranges.check_row(row.position - self.origin(view), &row) {
            return self.refuse(range.into(), view);
        }
        self.stream(row);
        self.take_row(next.number, row, self.setpoint.row - 1, view.evidence.demand)
    }

    /// The next send carries the application's row of this number. If it is the last one: the drive has accepted
    /// `newest`, and its demand is at `stood_at`.
    pub(super) fn take_row(&mut self, number: u64, row: Row, newest: u64, stood_at: f64) -> End {
        self.row = number;
        self.enter(match row.last {
            true => Step::FollowEnding { taken: 0, all: 0, newest, stood_at, last: row },
            false => Step::Following,
        })
    }

    fn stream(&mut self, row: Row) {
        let Row { position, velocity, acceleration, .. } = row;
        self.setpoint = Setpoint { position, velocity, acceleration, torque: 0.0, row: self.next_serial() };
    }

    /// The rows of the next send: those of the application, and at the end ones at standstill.
    pub(super) fn lead_rows(&mut self, view: &View) -> End {
        match self.step {
            Step::FollowWaiting | Step::Following => self.follow_by_drive(view),
            ending @ Step::FollowEnding { taken, all, last, .. } if self.sent > 0 => {
                let arrived = (view.evidence.demand - last.position).abs() <= view.rules.can.arrival;
                if taken > LAST_ROWS && arrived || taken > MOST_LAST_ROWS || all > MOST_BEHIND {
                    self.want_motion(Motion::EndStream);
                    return self.begin_step(view.now, Step::Moving(last.position));
                }
                // The last row was in range, so is this one.
                self.stream(Row { velocity: 0.0, acceleration: 0.0, ..last });
                self.enter(ending)
            }
            _ => None,
        }
    }
}

impl Ranges {
    fn check(&self, position: f64, profile: &Profile) -> Result<(), RangeError> {
        within(position, self.position, "units")?;
        within(profile.velocity, self.velocity, "units/s")?;
        within(profile.acceleration, self.acceleration, "units/s2")?;
        within(profile.deceleration, self.acceleration, "units/s2")
    }

    fn check_velocity(&self, velocity: f64, acceleration: f64) -> Result<(), RangeError> {
        within(velocity, self.velocity, "units/s")?;
        within(acceleration, self.acceleration, "units/s2")
    }

    fn check_row(&self, position: f64, row: &Row) -> Result<(), RangeError> {
        within(position, self.position, "units")?;
        within(row.velocity.abs(), (0.0, self.velocity.1), "units/s")?;
        within(row.acceleration.abs(), (0.0, self.acceleration.1), "units/s2")
    }
}

/// Written so that no number is not inside.
fn within(value: f64, (low, high): (f64, f64), unit: &'static str) -> Result<(), RangeError> {
    if value >= low && value <= high { Ok(()) } else { Err(RangeError { value, unit, low, high }) }
}
