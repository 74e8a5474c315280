//! A command that is under way: what each report of the drive means for it.

use super::begin::{OTHER_MODE, fallen_back};
use super::view::{Input, View};
use super::{End, Reset, State, Step};
use crate::axis::command::NativeOwner;
use crate::axis::{Command, Failure, State as Cia402};
use crate::bus::Slot;
use crate::bus::desired::{Follows, Homing, Mode, ModeIs, Motion, Power, Quantity, Reference, Resettable};
use crate::drive::power::towards_operation;
use crate::time::{MS, Time, nanos};

/// A drive that fails again so soon after a reset, ns, looks like one whose reset has failed.
const RESET_WITHIN_NS: u64 = 500 * MS;
/// A drive that is still in operation, in motion, after so many sends of a halt ...
const HALT_WITHIN: u32 = 5;
/// ... and so long, ns, does not obey it. Its status may be some ms old (LinUDP sheet, 3.5).
const HALT_WITHIN_NS: u64 = 20 * MS;

const HOME_FAILED: Failure = Failure::Unsupported(
    "it reports a homing error: look at its method 6098h, its switches, and its homing velocities 6099h",
);

impl State {
    /// Goes on with the command by the present report; how it has ended.
    pub(super) fn go_on(&mut self, view: &View) -> End {
        let waits = matches!(self.step, Step::Idle | Step::Falling | Step::Resetting(Reset::Waiting));
        if view.fresh && !view.evidence.outputs_count && !waits {
            // It came to this step by an output.
            return self.give_up(Failure::Dropped(view.status.state), view);
        }
        match self.step {
            Step::Idle => {
                let fell = self.power.value == Power::EnableOperation && !self.is_in_operation(view);
                if fell && self.has_power(view) {
                    // It fell out of operation: it does not return by itself.
                    self.let_go(view);
                } else if matches!(self.motion.value, Motion::Ramp { .. }) && self.is_accepted(view) {
                    // It outlives its command until the drive has it. What moves then is no motion of this master.
                    self.want_motion(Motion::Hold);
                }
                None
            }
            // Where the application owns the control word, the drive's state is the application's concern.
            Step::Native(NativeOwner::Application) => None,
            Step::Enabling { rest } => self.enabling(rest, view),
            Step::Falling => self.falling(view),
            Step::Resetting(reset) => self.resetting(reset, view),
            Step::TakingOver(command) => self.taking_over(command, view),
            // The others need the drive in operation.
            _ => self.falls(view).unwrap_or_else(|| match self.step {
                Step::Halting | Step::Released | Step::Halted => self.halting(view),
                Step::HomeWaiting => self.homing(view),
                _ if self.is_homing() => self.homing(view),
                _ => self.moving(view),
            }),
        }
    }

    /// Nothing has come to its end, and the drive is in operation as it is commanded: nothing is to be done. It depends
    /// on each report, so it has no revision. It saves 137 instructions a drive and cycle of a LinMot that jogs, and 79
    /// at a velocity of the master.
    #[inline(always)] // Once for each axis and cycle.
    pub(super) fn is_undisturbed(&self, input: &Input, slot: &Slot) -> bool {
        let Slot { status, evidence, .. } = slot;
        let goes_on = match &self.step {
            Step::Idle => !matches!(self.motion.value, Motion::Ramp { .. }),
            Step::Turning(_) | Step::FollowWaiting | Step::Following => true,
            Step::Moving(_) => status.moving && !(self.has_course && self.course.stands()),
            Step::Rolling(rolling) => {
                rolling.goes_on(input.level, evidence.demand) && (status.moving || !rolling.is_its_own())
            }
            _ => false,
        };
        goes_on
            && status.state == Cia402::OperationEnabled
            && evidence.outputs_count
            && evidence.mode == ModeIs::Own
            && evidence.refused.is_none()
    }

    /// It follows its motion, or its own quick stop.
    fn is_in_operation(&self, view: &View) -> bool {
        view.evidence.outputs_count
            && matches!(view.status.state, Cia402::OperationEnabled | Cia402::QuickStopActive)
    }

    fn is_late(&self, view: &View, limit_ns: u64) -> bool {
        view.now.since(self.since) > limit_ns
    }

    /// Ends the command as failed, and releases the drive.
    fn give_up(&mut self, failure: Failure, view: &View) -> End {
        self.let_go(view);
        self.fail(failure)
    }

    fn enabling(&mut self, rest: Power, view: &View) -> End {
        let (state, evidence, rest) = (view.status.state, view.evidence, fallen_back(rest));
        if self.has_power(view) && evidence.outputs_count {
            if evidence.fault.active {
                // A report that does not count is not fresh: what it says of a fault is not certain yet.
                let is_certain = evidence.fault.named && view.fresh;
                return if is_certain { self.give_up(view.failed(), view) } else { None };
            }
            if view.status.sto_open {
                self.set(rest);
                return self.fail(Failure::StoOpen);
            }
            let obstacle = evidence.obstacle.map(Failure::Unsupported);
            if let Some(failure) = obstacle.or(evidence.refused.map(Failure::from)) {
                self.set(rest);
                return self.fail(failure);
            }
            let own = evidence.mode == ModeIs::Own && evidence.ready && evidence.is_set_up;
            // A ramp that brakes what was refused before has to arrive: with the end of this it is desired no longer.
            let there = own
                && state == Cia402::OperationEnabled
                && self.power.value == Power::EnableOperation
                && self.is_accepted(view);
            if self.agrees(there, view.rules.can.power_reports, view) {
                return self.done();
            }
            // No power in a mode that somebody else has left.
            match towards_operation(state, self.power.value, &view.rules.can).filter(|_| own) {
                // From its quick stop it comes back at standstill only.
                Some(Power::EnableOperation)
                    if state == Cia402::QuickStopActive
                        && view.status.velocity.abs() > view.rules.axis.stop.standstill => {}
                Some(Power::EnableOperation) => self.hold(evidence.position),
                Some(next) => self.set(next),
                None => {}
            }
        }
        if self.is_late(view, nanos(view.rules.axis.enable_timeout)) {
            self.set(rest);
            return self.fail(Failure::TimedOut(state));
        }
        None
    }

    fn falling(&mut self, view: &View) -> End {
        let state = view.status.state;
        let there = match self.power.value {
            Power::SwitchOn => !state.is_powered() || state == Cia402::SwitchedOn,
            Power::QuickStop => !view.status.moving,
            _ => !state.is_powered(),
        };
        if self.has_power(view) && self.agrees(there, view.rules.can.power_reports, view) {
            return self.done();
        }
        if self.is_late(view, nanos(view.rules.axis.enable_timeout)) {
            return self.fail(Failure::TimedOut(state));
        }
        None
    }

    /// The drive leaves operation during a motion: the command ends with the reason, once that is known.
    #[inline]
    fn falls(&mut self, view: &View) -> Option<End> {
        if !self.has_power(view) || self.is_in_operation(view) {
            return None;
        }
        let fault = view.evidence.fault;
        Some(match fault.active {
            true if !fault.named => None,
            true => self.give_up(view.failed(), view),
            false => self.give_up(Failure::Dropped(view.status.state), view),
        })
    }

    /// A step of a motion.
    fn moving(&mut self, view: &View) -> End {
        let follows = matches!(
            self.step,
            Step::Turning(_)
                | Step::Moving(_)
                | Step::Arriving { .. }
                | Step::FollowWaiting
                | Step::Following
                | Step::FollowEnding { .. }
        );
        // No setpoint has led it since the mode changed under it, and the end of that is not the end of its motion.
        if follows && view.is_in_another_mode() {
            return self.refuse(OTHER_MODE, view);
        }
        if !view.fresh || view.status.suspect {
            return None;
        }
        if let Some(refused) = view.evidence.refused {
            return self.refuse(refused.into(), view);
        }
        // They have no end of their own.
        if matches!(self.step, Step::Turning(_) | Step::FollowWaiting | Step::Following) {
            return None;
        }
        let has_it = match self.step {
            // Its rows are its course.
            Step::FollowEnding { .. } => self.sent > 0 && view.evidence.accepted.row >= self.setpoint.row,
            _ => self.is_accepted(view) && self.course.stands(),
        };
        match self.step {
            // The time to arrive begins with the end of the demand; the drive may move on for longer.
            Step::Moving(target) if has_it && !(demand_goes_on(target, view) && view.status.moving) => {
                self.begin_step(view.now, Step::Arriving { target, stood: 0 });
                return self.arrive(target, 0, has_it, view);
            }
            Step::Moving(_) => return None,
            Step::Arriving { target, stood } => return self.arrive(target, stood, has_it, view),
            Step::FollowEnding { .. } if view.drive_makes_setpoints() => {
                self.count_last_rows(view);
                return None;
            }
            Step::FollowEnding { last, .. } if has_it => {
                self.hold(self.course.demand_position());
                return self.begin_step(view.now, Step::Arriving { target: last.position, stood: 0 });
            }
            _ => {}
        }
        // Each report counts once.
        let settled = self.agrees(has_it && !view.status.moving, view.rules.can.still_reports, view);
        match self.step {
            Step::Stopping if self.is_free(view) && self.course.stands() => self.halt(view),
            Step::Stopping if settled => self.done(),
            Step::Limited(limit) if settled => self.fail(view.rules.out_of_limits(limit)),
            Step::Rolling(rolling) => self.roll(rolling, settled, view),
            _ => None,
        }
    }

    /// The demand has come to its end: the move is over when the actual position has, too. The setpoint of the master
    /// proves neither.
    fn arrive(&mut self, target: f64, stood: u8, has_it: bool, view: &View) -> End {
        let stands = has_it && !view.status.moving;
        if !stands && demand_goes_on(target, view) {
            return self.enter(Step::Moving(target));
        }
        let (can, wanted) = (&view.rules.can, &view.rules.axis.in_position);
        let stood = if stands { stood.saturating_add(1) } else { 0 };
        self.step = Step::Arriving { target, stood };
        if stood >= can.still_reports && is_elsewhere(target, view) {
            return self.fail(Failure::NotArrived);
        }
        let (distance, near) = view.off(target);
        let reports = if wanted.window.is_some() { wanted.reports } else { 1 };
        let here = stands && near;
        if self.agrees(here, reports.max(can.still_reports.into()), view) {
            return self.done();
        }
        match wanted.window {
            // Slow exchanges may need longer to count their reports.
            Some(window) if !here && self.is_late(view, nanos(wanted.timeout)) => {
                self.fail(Failure::OutOfPosition { distance, window })
            }
            _ => None,
        }
    }

    /// The last row has gone out. Rows at standstill follow, until the drive has taken enough of them while its demand
    /// stood, or more than any buffer holds.
    fn count_last_rows(&mut self, view: &View) {
        let (accepted, demand) = (view.evidence.accepted.row, view.evidence.demand);
        if let Step::FollowEnding { taken, all, newest, stood_at, .. } = &mut self.step
            && accepted > *newest
        {
            *all += 1;
            let stands = (demand - *stood_at).abs() <= view.rules.can.arrival;
            (*taken, *newest) = (if stands { *taken + 1 } else { 0 }, accepted);
            if !stands {
                *stood_at = demand;
            }
        }
    }

    /// It follows torques: without one nothing brakes it.
    pub(super) fn is_free(&self, view: &View) -> bool {
        view.rules.quantity == Some(Quantity::Torque) && self.course.leads()
    }

    /// It runs on at the speed at which it was found, until it follows.
    fn taking_over(&mut self, command: Command, view: &View) -> End {
        match view.evidence.follows {
            _ if !view.fresh => None,
            _ if !view.operates() || view.evidence.fault.active => {
                self.set(Power::Off);
                self.begin_step(view.now, Step::Falling)
            }
            Follows::Yes => self.begin_stop(command, view),
            Follows::NotYet => None,
            Follows::Never(why) => self.fail(Failure::Unsupported(why)),
        }
    }

    fn halting(&mut self, view: &View) -> End {
        if !self.is_accepted(view) {
            return None;
        }
        let (report, can) = (view.status, &view.rules.can);
        let still = !report.moving && self.course.stands();
        let settled = self.agrees(still, can.still_reports, view);
        match self.step {
            Step::Halting if !settled => self.disobeys(view),
            // In the mode in which it was found it would go on without the halt.
            Step::Halting if view.evidence.mode != ModeIs::Own => {
                self.want_mode(Mode::Own);
                None
            }
            Step::Halting => {
                let free = self.is_free(view);
                // It stays at standstill here, without the halt.
                self.hold(view.evidence.position);
                if free {
                    return self.done();
                }
                self.begin_step(view.now, Step::Released)
            }
            Step::Released if report.sto_open => self.give_up(Failure::StoOpen, view),
            Step::Released if report.state != Cia402::OperationEnabled => None,
            Step::Released if report.moving && can.stands_ns > 0 => {
                // A reference of its own moves it: it stands only while it is halted.
                self.want_motion(Motion::Halt);
                self.enter(Step::Idle);
                Some(Err(Failure::StillMoves))
            }
            Step::Released if report.moving && view.drive_makes_setpoints() && view.evidence.ready => {
                self.brake(view.rules.axis.profile.deceleration, view);
                self.begin_step(view.now, Step::Stopping)
            }
            Step::Released if settled && !self.stands_too_short(view) => self.done(),
            Step::Halted if still || !report.state.is_powered() => {
                // It stands only while it is halted.
                self.enter(Step::Idle);
                Some(Ok(()))
            }
            _ => None,
        }
    }

    fn stands_too_short(&self, view: &View) -> bool {
        view.now.since(self.since) < view.rules.can.stands_ns
    }

    /// A drive that makes its own setpoints and does not halt: its settings keep it from that. The ramp is a motion,
    /// and needs no such bit.
    fn disobeys(&mut self, view: &View) -> End {
        let there = view.drive_makes_setpoints() && view.operates() && view.evidence.ready;
        if there && self.sent > HALT_WITHIN && self.is_late(view, HALT_WITHIN_NS) {
            let own = view.rules.axis.profile.deceleration;
            self.want_motion(Motion::Hold);
            self.brake(view.rules.axis.limits.acceleration.unwrap_or(own), view);
            self.begin_step(view.now, Step::Stopping);
        }
        None
    }

    fn homing(&mut self, view: &View) -> End {
        let (accepted, evidence) = (self.is_accepted(view), view.evidence);
        match self.step {
            Step::HomeWaiting if accepted && !self.course.leads() => {
                return self.fail(Failure::WrongState(view.status.state));
            }
            Step::HomeWaiting if accepted && self.course.stands() => {
                if !view.status.moving {
                    self.end_halt(view);
                    self.want_mode(Mode::Homing);
                    self.enter(Step::HomeMode);
                } else if self.is_free(view) && self.motion.value != Motion::Halt {
                    self.want_motion(Motion::Halt);
                }
            }
            Step::HomeMode => {
                if let Some(obstacle) = evidence.obstacle {
                    self.want_mode(Mode::Own);
                    return self.fail(Failure::Unsupported(obstacle));
                }
                if evidence.mode == ModeIs::Homing {
                    self.want_motion(Motion::Home);
                    self.enter(Step::Homing);
                }
            }
            Step::Homing if accepted => match evidence.homing {
                Homing::Open => {}
                Homing::Attained => self.leave_home(Ok(()), view),
                Homing::Failed => self.leave_home(Err(HOME_FAILED), view),
            },
            Step::HomeStopping(end) if accepted && !view.status.moving => {
                self.want_mode(Mode::Own);
                self.enter(Step::HomeLeaving(end));
            }
            Step::HomeLeaving(end) => {
                let own = evidence.mode == ModeIs::Own && evidence.ready && !view.status.moving;
                let there = accepted && own && view.operates();
                if self.agrees(there, view.rules.can.power_reports, view)
                    && let Some(reference) = evidence.reference
                {
                    self.hold(evidence.position);
                    self.enter(Step::Idle);
                    // Attained, but begun anew before it was left.
                    return Some(if reference == Reference::Lost { end.and(Err(HOME_FAILED)) } else { end });
                }
            }
            _ => {}
        }
        if self.is_late(view, nanos(view.rules.axis.home_timeout)) {
            self.want_mode(Mode::Own);
            self.hold(evidence.position);
            return self.fail(Failure::TimedOut(view.status.state));
        }
        None
    }

    fn leave_home(&mut self, end: Result<(), Failure>, view: &View) {
        self.want_motion(Motion::Hold);
        self.enter(if view.drive_makes_setpoints() {
            Step::HomeLeaving(end)
        } else {
            Step::HomeStopping(end)
        });
    }

    fn resetting(&mut self, reset: Reset, view: &View) -> End {
        let fault = view.evidence.fault;
        if self.has_power(view) {
            match (reset, fault.active) {
                (Reset::Waiting, false) if self.agrees(true, view.rules.can.power_reports, view) => {
                    self.set(Power::Off);
                    return self.done();
                }
                (Reset::Waiting, true) => {
                    self.agree = 0;
                    match fault.resettable {
                        _ if !fault.named => {}
                        Resettable::Never(why) => {
                            return self.fail(why.map_or(view.failed(), Failure::Unsupported));
                        }
                        Resettable::At(Time(u64::MAX)) => {}
                        // The drive takes none before, however long that is.
                        Resettable::At(at) if view.now < at => self.since = view.now,
                        Resettable::Now | Resettable::At(_) => {
                            self.set(Power::Off);
                            self.enter(Step::Resetting(Reset::Low));
                        }
                    }
                }
                (Reset::Low, _) => {
                    self.want_power(Power::FaultReset);
                    self.begin_step(view.now, Step::Resetting(Reset::High));
                }
                // However long it took to get there: its report is the first one behind the edge.
                (Reset::High, true) => {
                    self.begin_step(view.now, Step::Resetting(Reset::Sent));
                }
                (Reset::High | Reset::Sent, false) => {
                    self.set(Power::Off);
                    self.enter(Step::Resetting(Reset::Done));
                }
                (Reset::Sent, true) if self.is_late(view, RESET_WITHIN_NS) => {
                    self.set(Power::Off);
                    return self.fail(view.failed());
                }
                (Reset::Done, true) if fault.named => return self.fail(view.failed()),
                (Reset::Done, false) => {
                    let off = !view.status.state.is_powered();
                    if self.agrees(off, view.rules.can.power_reports, view) {
                        return self.done();
                    }
                }
                _ => {}
            }
        }
        if self.is_late(view, nanos(view.rules.axis.enable_timeout)) {
            self.set(Power::Off);
            let end = if fault.active && fault.named {
                view.failed()
            } else {
                Failure::TimedOut(view.status.state)
            };
            return self.fail(end);
        }
        None
    }
}

/// The setpoints of the drive go on. One that is said to move and whose demand is at the target has none left: the time
/// to arrive has begun.
fn demand_goes_on(target: f64, view: &View) -> bool {
    view.drive_makes_setpoints() && is_elsewhere(target, view)
}

fn is_elsewhere(target: f64, view: &View) -> bool {
    (target - view.evidence.demand).abs() > view.rules.can.arrival
}
