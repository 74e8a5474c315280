//! One step of the drive: demand, motor, supervision, states, table.

use super::super::codec::errors;
use super::super::demand::METRE;
use super::command::Effort;
use super::{Machine, counts};
use crate::power::Aim;
use fieldbeat_core::time::Time;

impl Machine {
    /// Advances to `now`.
    pub(in super::super) fn advance(&mut self, now: Time) {
        while let Some(dt_ns) = self.power.advance(now) {
            self.step(dt_ns);
        }
    }

    /// Lets `dt_ns` pass; then one transition.
    fn step(&mut self, dt_ns: u64) {
        let now = self.power.now();
        self.memory.advance(now);
        self.report_control(now);
        let actual = self.actual();
        if self.powered()
            && let Err(code) = self.setpoints.advance(now, dt_ns, actual)
        {
            self.fail(code);
        }
        self.move_plant(dt_ns);
        if self.powered() {
            self.watch();
        } else {
            // A powerless controller has no demand of its own.
            self.setpoints.stand_at(self.actual().position);
        }
        if !self.stopped {
            self.transition(now);
            self.run_table(now);
            self.go_on();
        }
    }

    /// The motor follows the demand or the current.
    fn move_plant(&mut self, dt_ns: u64) {
        if let (Effort::Current(force), true) = (self.effort, self.powered()) {
            self.power.step(Aim::Torque(force), dt_ns);
            let actual = self.actual();
            self.setpoints.follow(actual);
            return;
        }
        self.power.limit_torque(match self.effort {
            Effort::Pressing(force) => Some(force),
            Effort::Position | Effort::Current(_) => None,
        });
        let demand = self.setpoints.demand();
        let aim = match self.powered() {
            true => Aim::Follow {
                place: demand.position + self.power.zero,
                speed: demand.velocity,
                acceleration: demand.acceleration,
            },
            false => Aim::Off,
        };
        self.power.step(aim, dt_ns);
    }

    /// Range and following error.
    fn watch(&mut self) {
        let demand = counts(self.setpoints.demand().position, METRE);
        let settings = &self.settings;
        let bounded = self.power.homed && !self.plan.is_endless();
        // A motor that presses against something is meant to lag behind.
        let lag = if self.effort == Effort::Position { self.lag() } else { 0.0 };
        if bounded && demand < settings.range.0 {
            self.fail(errors::MIN_POSITION);
        } else if bounded && demand > settings.range.1 {
            self.fail(errors::MAX_POSITION);
        } else if lag > settings.lag_moving {
            self.fail(errors::POSITION_LAG);
        } else if lag > settings.lag_standing && !self.setpoints.is_moving() {
            self.fail(errors::POSITION_LAG_STANDING);
        }
    }
}
