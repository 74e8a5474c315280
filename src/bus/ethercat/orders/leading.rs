//! The setpoint: the outputs of the next exchange.

use super::{Inputs, Kind, ModeIs, Orders, Outputs, Step};
use crate::bus::Slot;
use crate::bus::ethercat::cia402::{ControlCommand, ControlWord};
use crate::drive::planner::{Point, Trajectory};

/// The most that a setpoint catches up, in intervals between two exchanges.
const MOST_STEP: u64 = 2;
/// The longest time in which a torque is removed, s, however flat its slope: meanwhile nothing brakes.
const RELEASE_S: f64 = 0.1;

impl Orders {
    pub(super) fn outputs(&self) -> Outputs {
        let mode = if self.start { ControlWord::START } else { 0 };
        let halt = if self.halt { ControlWord::HALT } else { 0 };
        let operates = self.control.has(ControlCommand::EnableOperation.word().0);
        // The start of a homing needs an edge of the same bit.
        let homes = self.is_homing() || matches!(self.step, Step::HomeMode);
        let own = if operates && !homes { self.mode_bits } else { 0 };
        let setpoint = match self.kind {
            Kind::Position => self.wire_position(self.next.position),
            Kind::Velocity(scale) | Kind::Torque(scale) => rounded(self.next.velocity * scale) as i32,
            Kind::Zero => 0,
        };
        Outputs { control: self.control.with(mode | halt | own), setpoint }
    }

    /// The lowest 32 bits of a count: the drive's own count wraps around as well.
    #[inline]
    fn wire_position(&self, position: f64) -> i32 {
        rounded((position - self.units.offset) * self.units.counts_per_unit) as i64 as i32
    }

    /// Advances the setpoint by the time since the last exchange.
    #[inline]
    pub(super) fn lead(&mut self, inputs: &Inputs, slot: &Slot) {
        if self.leads {
            self.watch_mode(inputs);
        }
        if !self.leads || self.away {
            (self.next, self.next_ns) = (Point { position: inputs.position, velocity: 0.0 }, 0);
            return;
        }
        match self.step {
            Step::Turning(_) => self.turn_on(inputs, slot),
            Step::Following { point, .. } => {
                (self.next, self.next_ns) = (point, 0);
                return;
            }
            _ => {}
        }
        let waited = self.sent_at.map_or(self.interval_ns, |sent_at| self.grid.since(sent_at));
        // Nothing delays the stop of a velocity or torque; a position setpoint must not jump.
        let most = match self.kind {
            Kind::Velocity(_) | Kind::Torque(_)
                if matches!(self.step, Step::Stopping | Step::Limited { .. }) =>
            {
                u64::MAX
            }
            _ => self.interval_ns.saturating_mul(MOST_STEP),
        };
        self.next_ns = self.passed_ns.saturating_add(waited.min(most));
        self.next = self.motion.at(self.next_ns);
    }

    /// In another mode no setpoint counts: it is neutral there, and so is the first one after it.
    #[inline]
    fn watch_mode(&mut self, inputs: &Inputs) {
        if inputs.mode != ModeIs::Own {
            self.away = true;
        } else if self.away {
            self.away = false;
            self.demand = Point { position: inputs.position, velocity: 0.0 };
            self.plan(Trajectory::on(self.demand));
        }
    }

    /// Starts a motion after the setpoints that were sent.
    pub(super) fn plan(&mut self, motion: Trajectory) {
        (self.motion, self.passed_ns) = (motion, 0);
    }

    /// Starts a motion to this velocity, then constant.
    #[inline]
    pub(super) fn plan_run(&mut self, velocity: f64, acceleration: f64) {
        self.motion.become_run(self.demand, velocity, acceleration);
        self.passed_ns = 0;
    }

    /// The point of a row, one interval after the last sent one.
    pub(super) fn point_of_row(&self, position: f64) -> Point {
        let way = position - self.demand.position;
        Point { position, velocity: way * self.per_second }
    }

    /// The setpoint ends in a standstill that was sent.
    pub(super) fn stands(&self) -> bool {
        self.motion.is_over(self.passed_ns) && self.motion.last_velocity() == 0.0
    }

    /// Setpoints count, and it stays where it is.
    pub(super) fn hold(&mut self, position: f64) {
        self.run_from(Point { position, velocity: 0.0 });
    }

    pub(super) fn run_from(&mut self, point: Point) {
        self.writes = true;
        (self.control, self.leads, self.halt) = (ControlCommand::EnableOperation.word(), true, false);
        self.demand = point;
        self.plan(Trajectory::on(point));
    }

    /// Along a ramp to a standstill, or to no torque.
    pub(super) fn brake(&mut self, deceleration: f64) {
        let deceleration = match self.kind {
            Kind::Torque(_) => {
                let slope = match self.step {
                    Step::Turning(turning) => turning.acceleration,
                    _ => f64::INFINITY,
                };
                slope.max(self.demand.velocity.abs() / RELEASE_S)
            }
            _ => self.braking(deceleration),
        };
        self.plan_run(0.0, deceleration);
    }

    /// The requested deceleration, or the one needed to stop within the limits: the deceleration of a motion that
    /// replaces a fast one may be too weak for the remaining way. Never more than the limit of acceleration, or
    /// than the axis' own profile if there is no limit.
    pub(super) fn braking(&self, asked: f64) -> f64 {
        let (Some((low, high)), Kind::Position) = (self.limits.position, self.kind) else { return asked };
        let Point { position, velocity } = self.demand;
        if velocity == 0.0 {
            return asked;
        }
        let room = if velocity > 0.0 { high - position } else { position - low };
        let most = self.limits.acceleration.unwrap_or(self.deceleration);
        let needed = if room > 0.0 { velocity * velocity / (2.0 * room) } else { most };
        asked.max(needed.min(most))
    }
}

/// So that the cast that follows rounds to nearest. By hand: without SSE4.1 `round` is a call.
#[inline]
fn rounded(value: f64) -> f64 {
    value + 0.5_f64.copysign(value)
}
