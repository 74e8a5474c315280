//! A new command: what it requests of the drive as it is now.

use super::view::View;
use super::{End, Reset, State, Step};
use crate::axis::command::NativeOwner;
use crate::axis::{Command, Failure, State as Cia402};
use crate::bus::desired::{Follows, Mode, ModeIs, Motion, Power, Quantity};
use crate::drive::planner::Point;
use crate::drive::power::as_found;
use crate::time::Time;

pub(super) const OTHER_MODE: Failure = Failure::Unsupported(
    "it is not in the mode of its setpoint: look at 6061h, or wait for the end of a homing",
);

/// The power that a drive falls back to that does not come into operation, or does not stay in it.
pub(super) fn fallen_back(rest: Power) -> Power {
    if rest == Power::EnableOperation { Power::Off } else { rest }
}

impl State {
    /// Takes the drive over as it is, at its present velocity.
    pub(super) fn claim(&mut self, view: &View) {
        let stays = view.evidence.outputs_count && view.evidence.stays_on;
        let power = if stays { as_found(view.status.state) } else { Power::Off };
        self.set(power);
        if power == Power::EnableOperation {
            self.run_from(self.found(view));
            if view.evidence.mode == ModeIs::Other {
                // It moves in that mode, which is unchanged until standstill.
                self.want_mode(Mode::AsIs);
            }
        }
    }

    /// The begin of the setpoint for a drive that moves by itself.
    pub(super) fn found(&self, view: &View) -> Point {
        let turns = view.status.velocity.abs() > view.rules.axis.stop.standstill;
        let velocity = if turns { view.status.velocity } else { 0.0 };
        // Its report is one exchange old.
        let position = view.evidence.position + velocity * view.rules.interval_ns as f64 * 1e-9;
        // Its present torque is not the master's.
        let torque = view.rules.quantity == Some(Quantity::Torque);
        Point { position, velocity: if torque { 0.0 } else { velocity } }
    }

    /// Power off was the last request. Reports may be from before that.
    pub(super) fn was_switched_off(&self) -> bool {
        self.writes() && self.power.value.is_off()
    }

    /// The drive is commanded to be in operation, and reports that it is.
    pub(super) fn runs(&self, view: &View) -> bool {
        view.operates() && self.power.value == Power::EnableOperation
    }

    /// Ends a command that cannot be carried out, and stops a running drive: nothing commands it any more.
    pub(super) fn refuse(&mut self, failure: Failure, view: &View) -> End {
        self.quit(view);
        Some(Err(failure))
    }

    /// Ends what is under way. A halt goes on to its end, where the drive is released.
    pub(super) fn quit(&mut self, view: &View) {
        if matches!(self.step, Step::Native(_)) {
            self.claim(view);
        }
        self.wind_down(view);
        let halts = matches!(self.step, Step::Halting | Step::Released | Step::Halted);
        if !(halts && self.motion.value == Motion::Halt) {
            self.enter(Step::Idle);
        }
    }

    pub(super) fn begin_enable(&mut self, since: Time, view: &View) -> End {
        let (evidence, state) = (view.evidence, view.status.state);
        if evidence.fault.active && evidence.fault.named {
            return self.fail(view.failed());
        }
        if let Some(obstacle) = evidence.obstacle {
            return self.fail(Failure::Unsupported(obstacle));
        }
        let on = evidence.outputs_count && !self.was_switched_off();
        let can = &view.rules.can;
        let rest = match state {
            // What runs already is not switched off first.
            Cia402::OperationEnabled if on && evidence.is_set_up => {
                self.operate(view);
                // Its reports are from before this command.
                self.power.serial = self.next_serial();
                Power::EnableOperation
            }
            Cia402::QuickStopActive
                if on && !can.leaves_quick_stop && self.power.value != Power::QuickStop =>
            {
                return self.fail(Failure::WrongState(state));
            }
            Cia402::QuickStopActive if on => Power::Off,
            Cia402::SwitchedOn if on => {
                match can.switches_on_at_once {
                    true => self.hold(evidence.position),
                    false => self.set(Power::SwitchOn),
                }
                Power::SwitchOn
            }
            _ => {
                self.set(Power::Shutdown);
                Power::Off
            }
        };
        self.begin_step(since, Step::Enabling { rest })
    }

    /// In operation, without a motion.
    pub(super) fn operate(&mut self, view: &View) {
        // A ramp that brakes what was refused before goes on.
        let brakes = matches!(self.motion.value, Motion::Ramp { .. });
        if self.power.value != Power::EnableOperation || !(self.course.leads() || brakes) {
            self.hold(view.evidence.position);
        }
    }

    pub(super) fn begin_home(&mut self, since: Time, view: &View) -> End {
        self.wind_down(view);
        if view.drive_makes_setpoints() {
            self.want_motion(Motion::Home);
            self.begin_step(since, Step::Homing)
        } else {
            self.begin_step(since, Step::HomeWaiting)
        }
    }

    pub(super) fn begin_stop(&mut self, command: Command, view: &View) -> End {
        let now = view.now;
        if view.operates()
            && view.evidence.follows == Follows::NotYet
            && self.power.value == Power::EnableOperation
        {
            return self.begin_step(now, Step::TakingOver(command));
        }
        match self.step {
            // Powering up: it does not go on by itself. One that was in operation before is stopped like any other.
            Step::Enabling { rest } if rest != Power::EnableOperation || !self.runs(view) => {
                self.set(fallen_back(rest));
                return self.begin_step(now, Step::Falling);
            }
            // A stop that is under way is not made softer.
            Step::Halting | Step::Released if self.motion.value == Motion::Halt => {
                return self.halt(view);
            }
            // It may go on reporting that it is in operation for as long as its replies are lost.
            _ if self.was_switched_off() => return self.begin_step(now, Step::Falling),
            _ if self.power.value != Power::EnableOperation || !self.can_brake(view) => {
                // There is nothing to brake with: power stays as it is, and does not come on any more.
                let on = self.power.value == Power::EnableOperation;
                self.set(if on { as_found(view.status.state) } else { self.power.value });
                return self.begin_step(now, Step::Falling);
            }
            // Only while it is halted does it stand.
            Step::Idle | Step::Halted if self.motion.value == Motion::Halt => {
                return self.begin_step(now, Step::Halted);
            }
            _ => {
                if let Command::Stop { deceleration } = command
                    && view.evidence.mode == ModeIs::Own
                    && view.evidence.ready
                    && !self.is_homing()
                    && self.motion.value != Motion::Halt
                {
                    self.brake(deceleration.unwrap_or(view.rules.axis.profile.deceleration), view);
                    return self.begin_step(now, Step::Stopping);
                }
            }
        }
        self.halt(view)
    }

    /// The drive may be in motion with its power on: a report that may be an older one does not deny it.
    fn can_brake(&self, view: &View) -> bool {
        view.status.state == Cia402::OperationEnabled || view.status.suspect || !view.evidence.outputs_count
    }

    /// As fast as the drive is configured for it, with its power on.
    pub(super) fn halt(&mut self, view: &View) -> End {
        let limits = &view.rules.axis.limits;
        let own = view.rules.axis.profile.deceleration;
        let most = limits.acceleration.unwrap_or(own).max(own);
        self.want_motion(Motion::Halt);
        self.course.halt(most, view);
        self.begin_step(view.now, Step::Halting)
    }

    pub(super) fn begin_reset(&mut self, since: Time, view: &View) -> End {
        // A drive that reacts to its fault brakes with its power on.
        if view.status.state == Cia402::Fault {
            self.set(Power::Off);
        }
        self.begin_step(since, Step::Resetting(Reset::Waiting))
    }

    pub(super) fn begin_native(&mut self, owner: NativeOwner, view: &View) -> End {
        // It stands still, or has no torque, until the application gives a setpoint.
        self.end_halt(view);
        self.wind_down(view);
        self.want_motion(Motion::Native(owner));
        if owner == NativeOwner::Application {
            self.want_mode(Mode::AsIs);
        }
        self.begin_step(view.now, Step::Native(owner))
    }

    /// The new motion replaces a halt.
    pub(super) fn end_halt(&mut self, view: &View) {
        if self.motion.value == Motion::Halt {
            let point = self.found(view);
            self.want_motion(Motion::Hold);
            self.lead_from(point);
        }
    }

    /// Rows lead it: its course is not theirs, and does not show how they move.
    pub(super) fn has_rows(&self) -> bool {
        matches!(self.step, Step::Following | Step::FollowEnding { .. })
    }

    pub(super) fn begin_follow(&mut self, view: &View) -> End {
        self.end_halt(view);
        self.begin_step(view.now, Step::FollowWaiting);
        if !view.drive_makes_setpoints() {
            // The running motion ends here.
            self.brake(view.rules.axis.profile.deceleration, view);
        }
        self.want_motion(Motion::Follow);
        // The first row may have come with the command.
        self.follow(view)
    }

    /// It homes, or is on its way there or back.
    pub(super) fn is_homing(&self) -> bool {
        matches!(self.step, Step::HomeMode | Step::Homing | Step::HomeStopping(_) | Step::HomeLeaving(_))
    }

    /// Brings a running motion to its end. A halt that is under way is not made softer.
    pub(super) fn wind_down(&mut self, view: &View) {
        if self.motion.value == Motion::Halt {
            return;
        }
        let deceleration = view.rules.axis.profile.deceleration;
        if view.drive_makes_setpoints() {
            // What has only just left may begin after this report.
            let runs = matches!(
                self.motion.value,
                Motion::Move { .. }
                    | Motion::Velocity { .. }
                    | Motion::Follow
                    | Motion::EndStream
                    | Motion::Home
            );
            if self.runs(view) && (runs || view.status.moving) {
                self.brake(deceleration, view);
            } else if self.motion.value != Motion::Hold {
                self.want_motion(Motion::Hold);
            }
        } else if self.is_free(view) && (view.status.moving || !self.course.stands()) {
            self.halt(view);
        } else if self.course.leads() && (self.has_rows() || !self.course.stands()) {
            self.brake(deceleration, view);
        }
    }
}
