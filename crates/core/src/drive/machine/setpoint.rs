//! The setpoint of the next send, where the master makes it: a position, a velocity on its ramp, or a torque on its
//! slope.
//!
//! A motion is planned from the last setpoint that was sent. While the drive does not follow setpoints they are
//! neutral: no velocity, no torque, the actual position.
//!
//! No ramp of velocities brakes a drive that follows torques. A stop removes the torque along its slope, within 100 ms
//! at most, and then halts the drive until standstill; a quick stop, and a command that is refused, halt it at once.
//! Then it is free: without a torque, as after it was enabled. A drive that the halt does not brake coasts, until the
//! axis' stop reaches its time-out.

use super::view::{Input, Rules, View};
use super::{End, State, Step, near};
use crate::axis::{Failure, Profile, Row};
use crate::bus::Slot;
use crate::bus::desired::{ModeIs, Quantity, Setpoint};
use crate::drive::planner::{Point, Trajectory};
use crate::time::Time;

/// The most that a setpoint catches up, in intervals between two exchanges: a position must not jump.
const MOST_STEP: u64 = 2;
/// The longest time in which a torque is removed, s, however flat its slope: meanwhile nothing brakes.
const RELEASE_S: f64 = 0.1;
/// A position limit is checked so many intervals ahead of the braking distance.
const AHEAD: f64 = 3.0;

/// The setpoint over time. What each send touches is its first cache line.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C)]
pub(super) struct Course {
    /// The setpoint follows `motion`; otherwise it is neutral.
    leads: bool,
    /// The drive is, or was, in another mode than that of its setpoint.
    away: bool,
    /// A standstill, a velocity or a torque that the motion has come to, and keeps: the next setpoint is the last one.
    pub(super) is_constant: bool,
    /// How much of the motion was sent, and the point there.
    passed_ns: u64,
    demand: Point,
    /// The same with the next send.
    next_ns: u64,
    next: Point,
    /// The slot of the last send, or [`NEVER`](Self::NEVER).
    sent_at: Time,
    /// The requested level when it became constant, before it was limited.
    level: f64,
    motion: Trajectory,
}

impl Default for Course {
    fn default() -> Course {
        let (demand, next) = (Point::default(), Point::default());
        Course {
            leads: false,
            away: false,
            is_constant: false,
            passed_ns: 0,
            demand,
            next_ns: 0,
            next,
            sent_at: Course::NEVER,
            level: 0.0,
            motion: Trajectory::default(),
        }
    }
}

/// At a velocity or a torque.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Turning {
    /// Of the velocity; the slope of a torque.
    acceleration: f64,
    /// The planned velocity or torque; NaN: none yet.
    velocity: f64,
    /// The position limit in its direction.
    limit: Option<f64>,
}

impl Course {
    /// Nothing was sent.
    const NEVER: Time = Time(u64::MAX);

    pub(super) fn leads(&self) -> bool {
        self.leads
    }

    /// The setpoint ends in a standstill that was sent; so does one that leads nothing.
    pub(super) fn stands(&self) -> bool {
        !self.leads || self.motion.is_over(self.passed_ns) && self.motion.last_velocity() == 0.0
    }

    /// The last setpoint that was sent.
    pub(super) fn demand_position(&self) -> f64 {
        self.demand.position
    }

    pub(super) fn end(&mut self) {
        (self.leads, self.away, self.is_constant) = (false, false, false);
    }

    /// From this point on at its velocity.
    fn begin_at(&mut self, point: Point) {
        (self.leads, self.demand) = (true, point);
        self.plan(Trajectory::on(point));
    }

    #[inline]
    pub(super) fn sent(&mut self, grid: Time) {
        (self.passed_ns, self.demand, self.sent_at) = (self.next_ns, self.next, grid);
    }

    /// Starts a motion after the setpoints that were sent.
    fn plan(&mut self, motion: Trajectory) {
        (self.motion, self.passed_ns, self.is_constant) = (motion, 0, false);
    }

    /// Starts a motion to this velocity, then constant.
    fn run(&mut self, velocity: f64, acceleration: f64) {
        self.motion.become_run(self.demand, velocity, acceleration);
        (self.passed_ns, self.is_constant) = (0, false);
    }

    pub(super) fn go_to(&mut self, target: f64, profile: &Profile, view: &View) {
        let down = self.braking(profile.deceleration, view);
        self.plan(Trajectory::go_to(self.demand, target, profile.velocity, profile.acceleration, down));
    }

    /// Leads the setpoint while the drive halts.
    pub(super) fn halt(&mut self, most: f64, view: &View) {
        let own = view.evidence.mode == ModeIs::Own;
        match view.rules.quantity {
            // In another mode its setpoint has no effect.
            Some(Quantity::Position) if own => self.run(0.0, self.braking(most, view)),
            // The drive's own ramp acts below it.
            _ => self.plan(Trajectory::on(Point { velocity: 0.0, ..self.demand })),
        }
    }

    /// The deceleration that is requested, or needed from the last setpoint.
    fn braking(&self, requested: f64, view: &View) -> f64 {
        match view.rules.quantity {
            Some(Quantity::Position) => view.rules.braking(requested, self.demand, 0.0),
            _ => requested,
        }
    }

    /// In another mode no setpoint counts: it is neutral there, and so is the first one after it.
    pub(super) fn watch_mode(&mut self, view: &View) {
        if !self.leads {
            return;
        }
        if view.is_in_another_mode() {
            self.away = true;
        } else if self.away {
            self.away = false;
            self.begin_at(Point { position: view.evidence.position, velocity: 0.0 });
        }
    }
}

impl Rules {
    /// A velocity or torque within its limit.
    fn within_limit(&self, level: f64) -> f64 {
        let torque = self.quantity == Some(Quantity::Torque);
        let most =
            if torque { self.axis.limits.torque } else { self.axis.limits.velocity }.unwrap_or(f64::INFINITY);
        level.clamp(-most, most)
    }
}

impl State {
    /// From this point on at its velocity, where the master makes the setpoints.
    pub(super) fn lead_from(&mut self, point: Point) {
        if self.has_course {
            self.course.begin_at(point);
        }
    }

    /// Where the setpoint is.
    pub(super) fn demand(&self, view: &View) -> f64 {
        if view.drive_makes_setpoints() { view.evidence.demand } else { self.course.demand.position }
    }

    /// The setpoint in the slot is that of the next send, too. No revision says so: setpoints have none. It saves 202
    /// instructions a drive and cycle at a constant velocity of the master, 221 where it holds a position, and 67 where
    /// the drive makes its setpoints.
    #[inline]
    pub(super) fn keeps_setpoint(&self, input: &Input, slot: &Slot) -> bool {
        if self.is_new {
            return false;
        }
        let keeps = match self.step {
            Step::FollowWaiting | Step::Following | Step::FollowEnding { .. } => false,
            // Only rows are setpoints of a drive that makes its own.
            _ if !self.has_course => return true,
            Step::Turning(_) => input.level == self.course.level,
            _ => self.course.demand.velocity == 0.0,
        };
        keeps && self.course.is_constant && slot.evidence.mode == ModeIs::Own
    }

    /// Chooses the setpoint of the next send.
    #[inline]
    pub(super) fn lead(&mut self, view: &View) -> End {
        let Some(quantity) = view.rules.quantity else { return self.lead_rows(view) };
        let end = self.advance(view);
        let Point { position, velocity } = self.course.next;
        let torque = quantity == Quantity::Torque;
        self.setpoint = Setpoint {
            position,
            velocity: if torque { 0.0 } else { velocity },
            torque: if torque { velocity } else { 0.0 },
            ..self.setpoint
        };
        end
    }

    /// Advances the setpoint by the time since the last send.
    #[inline]
    fn advance(&mut self, view: &View) -> End {
        self.course.watch_mode(view);
        if !self.course.leads || self.course.away {
            self.course.next = Point { position: view.evidence.position, velocity: 0.0 };
            (self.course.next_ns, self.course.is_constant) = (0, false);
            return None;
        }
        let end = match self.step {
            Step::Turning(turning) => self.turn_on(turning, view),
            Step::FollowWaiting | Step::Following | Step::FollowEnding { .. } => self.follow(view),
            _ => None,
        };
        if self.has_rows() {
            return end;
        }
        let course = &mut self.course;
        let waited = match course.sent_at {
            Course::NEVER => view.rules.interval_ns,
            sent_at => view.now.since(sent_at),
        };
        // Nothing delays the stop of a velocity or torque; a position must not jump.
        let stops = matches!(self.step, Step::Stopping | Step::Limited(_));
        let most = match view.rules.quantity {
            Some(Quantity::Velocity | Quantity::Torque) if stops => u64::MAX,
            _ => view.rules.interval_ns.saturating_mul(MOST_STEP),
        };
        course.next_ns = course.passed_ns.saturating_add(waited.min(most));
        course.next = course.motion.at(course.next_ns);
        // A place goes on, and a limit of it may come near.
        let is_place =
            view.rules.quantity == Some(Quantity::Position) || view.rules.axis.limits.position.is_some();
        let keeps = match self.step {
            Step::Turning(_) => !is_place,
            _ => course.motion.last_velocity() == 0.0,
        };
        course.is_constant = keeps && course.motion.is_over(course.next_ns);
        course.level = view.input.level;
        end
    }

    /// Along a ramp to a standstill, or to no torque.
    pub(super) fn brake(&mut self, deceleration: f64, view: &View) {
        if view.drive_makes_setpoints() {
            return self.brake_by_drive(deceleration, view);
        }
        let deceleration = match view.rules.quantity {
            Some(Quantity::Torque) => {
                let slope = match self.step {
                    Step::Turning(turning) => turning.acceleration,
                    _ => f64::INFINITY,
                };
                slope.max(self.course.demand.velocity.abs() / RELEASE_S)
            }
            _ => self.course.braking(deceleration, view),
        };
        self.follow_course();
        self.course.run(0.0, deceleration);
    }

    pub(super) fn begin_turning(&mut self, acceleration: f64, view: &View) -> End {
        let turning = Turning { acceleration, velocity: f64::NAN, limit: None };
        self.follow_course();
        self.begin_step(view.now, Step::Turning(turning));
        self.turn_on(turning, view)
    }

    /// Plans the requested velocity or torque, if it changed, up to a position limit.
    #[inline]
    fn turn_on(&mut self, turning: Turning, view: &View) -> End {
        let quantity = view.rules.quantity;
        let velocity = view.rules.within_limit(view.input.level);
        if velocity == turning.velocity {
            return self.watch_limit(turning, view);
        }
        if !velocity.is_finite() {
            return self.refuse(Failure::NotFinite, view);
        }
        let up = turning.acceleration;
        let braking = self.course.braking(up, view);
        let range = view
            .rules
            .axis
            .limits
            .position
            .filter(|_| quantity == Some(Quantity::Position) && velocity != 0.0);
        let Some((low, high)) = range else {
            self.course.run(velocity, braking);
            let turning = Turning { velocity, limit: None, ..turning };
            self.step = Step::Turning(turning);
            return self.watch_limit(turning, view);
        };
        let limit = if velocity > 0.0 { high } else { low };
        let position = self.course.demand.position;
        if (limit - position) * velocity <= 0.0 {
            return self.refuse(view.rules.out_of_limits(position), view);
        }
        self.course.plan(Trajectory::go_to(self.course.demand, limit, velocity.abs(), up, braking));
        self.step = Step::Turning(Turning { velocity, limit: Some(limit), ..turning });
        None
    }

    /// A jog that comes to its limit ends there.
    #[inline]
    fn watch_limit(&mut self, turning: Turning, view: &View) -> End {
        match (view.rules.quantity, turning.limit) {
            (Some(Quantity::Position), Some(limit)) if self.course.stands() => {
                self.enter(Step::Limited(limit))
            }
            (Some(Quantity::Velocity), _) => self.watch_velocity(turning, view),
            _ => None,
        }
    }

    /// The same where only velocities are commanded: by the position of the axis, once it is known.
    fn watch_velocity(&mut self, turning: Turning, view: &View) -> End {
        let (low, high) = view.rules.axis.limits.position.filter(|_| view.status.homed)?;
        let from = self.course.demand;
        let velocity = if from.velocity == 0.0 { turning.velocity } else { from.velocity };
        if velocity == 0.0 {
            return None;
        }
        let limit = if velocity > 0.0 { high } else { low };
        let reaction = AHEAD * view.rules.interval_ns as f64 * 1e-9;
        let position = view.evidence.position;
        let room = (limit - position) * velocity.signum() - velocity.abs() * reaction;
        if room > 0.0 && 2.0 * turning.acceleration * room > velocity * velocity {
            return None;
        }
        if from.velocity == 0.0 {
            return self.refuse(view.rules.out_of_limits(position), view);
        }
        self.course.plan(Trajectory::run(Point { position, ..from }, 0.0, turning.acceleration));
        self.enter(Step::Limited(limit))
    }

    /// One row a send. A row that came before, in a slot that was passed over, is not counted twice.
    pub(super) fn follow(&mut self, view: &View) -> End {
        if view.drive_makes_setpoints() {
            return self.follow_by_drive(view);
        }
        let next = view.input.row?;
        if next.number == self.row {
            // It was sent; the drive stays there until the next one comes.
            if self.course.next.position == self.course.demand.position {
                self.course.next.velocity = 0.0;
            }
            return None;
        }
        let from = self.course.demand.position;
        let position = near(&view.rules.axis.units, from, next.row.position);
        if !position.is_finite() {
            return self.refuse(Failure::NotFinite, view);
        }
        let velocity = (position - from) * 1e9 / view.rules.interval_ns.max(1) as f64;
        (self.course.next, self.course.next_ns) = (Point { position, velocity }, 0);
        self.setpoint.row = self.next_serial();
        self.take_row(next.number, Row { position, ..next.row }, 0, position)
    }
}
