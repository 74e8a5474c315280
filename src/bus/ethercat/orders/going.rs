//! An order that is under way.

use super::begin::OTHER_MODE;
use super::{ANSWERS, Inputs, Kind, ModeIs, Orders, Reference, Step, Turning};
use crate::axis::command::NativeOwner;
use crate::axis::{Command, Failure, State};
use crate::bus::Slot;
use crate::bus::ethercat::cia402::{ControlCommand, ControlWord, StatusWord};
use crate::drive::planner::{Point, Trajectory};
use crate::time::{MS, Time};

/// A fault is watched for so long, ns, after the reset: a drive that fails again at once looks like a failed reset.
const RESET_WITHIN_NS: u64 = 500 * MS;
/// Exchanges that a drive may take from its order to home until bit 12 refers to this homing (assumed).
const HOME_ANSWERS: u32 = 3;
/// A motion is over with so many answers at standstill in a row.
const SETTLED: u32 = 3;
/// A position limit is checked so many intervals ahead of the braking distance.
const AHEAD: f64 = 3.0;

const COLD_START: Failure = Failure::Unsupported(
    "its fault needs a cold start: remove its cause, then switch the drive's auxiliary power off and on",
);
const HOME_FAILED: Failure = Failure::Unsupported(
    "it reports a homing error: look at its method 6098h, its switches, and its homing velocities 6099h",
);

impl Orders {
    #[inline]
    pub(super) fn go_on(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        match self.step {
            Step::Idle => {}
            // Where the application owns the control word, the drive's state is the application's concern.
            Step::Native(NativeOwner::Application) => {}
            Step::Enabling => self.enabling(now, inputs, slot),
            Step::Disabling => self.disabling(now, inputs, slot),
            Step::HomeWaiting
            | Step::HomeMode
            | Step::Homing
            | Step::HomeStopping(_)
            | Step::HomeLeaving(_) => self.homing(now, inputs, slot),
            Step::ResetWaiting | Step::ResetLow | Step::Resetting => self.resetting(now, inputs, slot),
            _ => self.moving(inputs, slot),
        }
    }

    /// The drive leaves operation during a motion: the order ends with the reason.
    fn falls(&mut self, inputs: &Inputs, slot: &Slot) -> bool {
        if !inputs.fresh || inputs.operating() {
            return false;
        }
        if inputs.faulted() {
            // Its name comes by another way, and may come later.
            if inputs.named {
                self.give_up(Failure::DriveFault(inputs.fault.into()));
            }
        } else {
            self.give_up(Failure::Dropped(slot.status.state));
        }
        true
    }

    /// A step that needs the drive in operation.
    #[inline]
    fn moving(&mut self, inputs: &Inputs, slot: &Slot) {
        if self.leads && self.falls(inputs, slot) {
            return;
        }
        let turns = matches!(self.step, Step::Turning(_));
        // No setpoint has led it since the mode changed under it, and the end of that is not the end of its motion.
        if inputs.mode != ModeIs::Own
            && (turns || matches!(self.step, Step::Moving | Step::FollowWaiting | Step::Following { .. }))
        {
            return self.refuse(OTHER_MODE);
        }
        if turns {
            return;
        }
        // Between two directions of an overshoot the motor stands for a moment.
        if inputs.fresh {
            self.still = if self.stands() && !slot.status.moving { self.still.saturating_add(1) } else { 0 };
        }
        let settled = inputs.fresh && self.still >= SETTLED;
        match self.step {
            Step::Moving if settled && self.sent > 0 => self.finish(Ok(())),
            Step::Following { last: true, .. } if self.is_answered(inputs) && !slot.status.moving => {
                self.plan(Trajectory::on(self.demand));
                self.finish(Ok(()));
            }
            Step::FollowWaiting | Step::Following { .. } => self.follow(slot),
            Step::Stopping if !self.leads && self.is_answered(inputs) && !slot.status.moving => {
                self.finish(Ok(()));
            }
            Step::Stopping if self.is_free() && self.stands() => self.halt(self.grid, inputs),
            Step::Stopping if self.is_free() => {}
            Step::Stopping if settled && self.answers >= ANSWERS => self.finish(Ok(())),
            Step::Limited { limit } if settled && self.answers >= ANSWERS => {
                let (low, high) = self.limits.position.unwrap_or((limit, limit));
                self.finish(Err(Failure::Limit { what: "position", value: limit, low, high }));
            }
            // In the mode in which it was found it would go on without the halt.
            Step::Halting if settled && self.answers >= ANSWERS && inputs.mode != ModeIs::Own => {
                self.foreign = false;
            }
            Step::Halting if settled && self.answers >= ANSWERS => {
                // It stays at standstill here, without the halt.
                self.hold(inputs.position);
                if self.is_free() {
                    self.finish(Ok(()));
                } else {
                    self.enter(self.grid, Step::Stopping);
                }
            }
            _ => {}
        }
    }

    fn enabling(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        let fresh = inputs.fresh && inputs.operational && self.answers > 0;
        let on = ControlCommand::EnableOperation.word();
        let told = |word: Option<ControlWord>| word.is_some_and(|word| word.has(on.0));
        match inputs.state {
            State::Fault | State::FaultReactionActive if fresh && inputs.named => {
                return self.give_up(Failure::DriveFault(inputs.fault.into()));
            }
            _ if fresh && self.dark => {
                let rest = self.rest;
                self.set(rest);
                return self.finish(Err(Failure::Inhibited));
            }
            // No power in a mode that somebody else has left.
            State::ReadyToSwitchOn if fresh && inputs.mode == ModeIs::Own => {
                self.set(ControlCommand::SwitchOn.word());
            }
            State::SwitchedOn
                if fresh && !self.leads && self.answers >= ANSWERS && inputs.mode == ModeIs::Own =>
            {
                self.hold(inputs.position);
            }
            // It stays there, if it is configured so.
            State::QuickStopActive
                if fresh
                    && !self.leads
                    && self.answers >= ANSWERS
                    && inputs.velocity.abs() <= self.standstill
                    && inputs.mode == ModeIs::Own =>
            {
                self.hold(inputs.position);
            }
            State::OperationEnabled
                if fresh
                    && told(self.control_sent)
                    && told(self.control_before)
                    && inputs.mode == ModeIs::Own =>
            {
                return self.finish(Ok(()));
            }
            _ => {}
        }
        if now.since(self.since) > self.enable_timeout_ns {
            let rest = self.rest;
            self.set(rest);
            self.finish(Err(Failure::TimedOut(slot.status.state)));
        }
    }

    fn disabling(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        let holds = self.control.has(ControlWord::SWITCH_ON) && inputs.state == State::SwitchedOn;
        if self.is_answered(inputs) && (!inputs.state.is_powered() || holds) {
            self.finish(Ok(()));
        } else if now.since(self.since) > self.enable_timeout_ns {
            self.finish(Err(Failure::TimedOut(slot.status.state)));
        }
    }

    fn homing(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        let since = self.since;
        let answered = self.is_answered(inputs);
        if answered && self.falls(inputs, slot) {
            return;
        }
        match self.step {
            Step::HomeWaiting if answered && !self.leads => {
                return self.finish(Err(Failure::WrongState(slot.status.state)));
            }
            Step::HomeWaiting if answered && self.stands() => {
                if slot.status.moving {
                    self.halt |= self.is_free();
                } else {
                    self.end_halt(inputs);
                    self.enter(now, Step::HomeMode);
                }
            }
            Step::HomeMode if inputs.mode == ModeIs::Homing => {
                self.start = true;
                self.enter(now, Step::Homing);
            }
            Step::Homing if answered && self.answers > HOME_ANSWERS => {
                if inputs.status.has(StatusWord::MODE_13) {
                    self.leave_home(now, Err(HOME_FAILED));
                } else if inputs.status.has(StatusWord::MODE_12) {
                    self.leave_home(now, Ok(()));
                }
            }
            Step::HomeStopping(end) if answered && !slot.status.moving => {
                self.enter(now, Step::HomeLeaving(end));
            }
            Step::HomeLeaving(end) if answered && inputs.mode == ModeIs::Own && !slot.status.moving => {
                if let Some(reference) = inputs.reference {
                    self.hold(inputs.position);
                    // Attained, but begun anew before it was left.
                    let lost = reference == Reference::Lost && slot.order.verb == Some(Command::Home);
                    return self.finish(if lost { end.and(Err(HOME_FAILED)) } else { end });
                }
            }
            _ => {}
        }
        // One order, one start.
        self.since = since;
        if now.since(since) > self.home_timeout_ns {
            self.start = false;
            self.hold(inputs.position);
            self.finish(Err(Failure::TimedOut(slot.status.state)));
        }
    }

    fn leave_home(&mut self, now: Time, end: Result<(), Failure>) {
        self.start = false;
        self.enter(now, Step::HomeStopping(end));
    }

    fn resetting(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        let since = self.since;
        let answered = self.is_answered(inputs);
        match self.step {
            _ if answered && !inputs.faulted() => {
                self.set(ControlWord(0));
                return self.finish(Ok(()));
            }
            Step::ResetWaiting if answered && inputs.named && inputs.cold => {
                return self.finish(Err(COLD_START));
            }
            Step::ResetWaiting if answered && inputs.named && inputs.state == State::Fault => {
                self.enter(now, Step::ResetLow);
            }
            Step::ResetLow if answered => {
                self.set(ControlWord(ControlWord::FAULT_RESET));
                self.enter(now, Step::Resetting);
                return;
            }
            Step::Resetting if answered && now.since(since) > RESET_WITHIN_NS => {
                self.set(ControlWord(0));
                return self.finish(Err(Failure::DriveFault(inputs.fault.into())));
            }
            _ => {}
        }
        self.since = since;
        if now.since(since) > self.enable_timeout_ns {
            self.set(ControlWord(0));
            self.finish(Err(Failure::TimedOut(slot.status.state)));
        }
    }

    /// One row per exchange. A row that came before, in a slot that was passed over, is not counted twice.
    pub(super) fn follow(&mut self, slot: &Slot) {
        let Some(next) = slot.row else { return };
        if matches!(self.step, Step::Following { row, .. } if row == next.number) {
            if self.sent > 0
                && let Step::Following { point, .. } = &mut self.step
            {
                point.velocity = 0.0;
            }
            return;
        }
        let position = self.near(next.row.position);
        if !position.is_finite() {
            return self.refuse(Failure::NotFinite);
        }
        let point = self.point_of_row(position);
        (self.sent, self.answers) = (0, 0);
        self.step = Step::Following { row: next.number, last: next.row.last, point };
    }

    /// Plans the requested velocity or torque, if it changed, up to a position limit.
    #[inline]
    pub(super) fn turn_on(&mut self, inputs: &Inputs, slot: &Slot) {
        let Step::Turning(Turning { acceleration: up, velocity: planned, limit }) = self.step else { return };
        let (asked, most) = match self.kind {
            Kind::Torque(_) => (slot.torque, self.limits.torque),
            _ => (slot.velocity, self.limits.velocity),
        };
        let most = most.unwrap_or(f64::INFINITY);
        let velocity = asked.clamp(-most, most);
        if velocity == planned {
            return self.watch_limit(up, velocity, limit, inputs, slot);
        }
        if !velocity.is_finite() {
            return self.refuse(Failure::NotFinite);
        }
        let braking = self.braking(up);
        let (Kind::Position, Some((low, high))) = (self.kind, self.limits.position) else {
            self.plan_run(velocity, braking);
            self.turns(velocity, None);
            return self.watch_limit(up, velocity, None, inputs, slot);
        };
        let limit = if velocity > 0.0 { high } else { low };
        if velocity == 0.0 {
            self.plan_run(velocity, braking);
            self.turns(velocity, None);
        } else if (limit - self.demand.position) * velocity <= 0.0 {
            self.refuse(Failure::Limit { what: "position", value: self.demand.position, low, high });
        } else {
            self.plan(Trajectory::go_to(self.demand, limit, velocity.abs(), up, braking));
            self.turns(velocity, Some(limit));
        }
    }

    /// Plans for this value. In place: writing the whole step takes longer than making the plan.
    #[inline]
    fn turns(&mut self, planned: f64, leads_to: Option<f64>) {
        if let Step::Turning(Turning { velocity, limit, .. }) = &mut self.step {
            (*velocity, *limit) = (planned, leads_to);
        }
    }

    /// A jog that comes to its limit ends there.
    #[inline]
    fn watch_limit(
        &mut self,
        acceleration: f64,
        velocity: f64,
        limit: Option<f64>,
        inputs: &Inputs,
        slot: &Slot,
    ) {
        match (self.kind, limit) {
            (Kind::Position, Some(limit)) if self.stands() => self.enter(self.grid, Step::Limited { limit }),
            (Kind::Velocity(_), _) => self.watch_velocity(acceleration, velocity, inputs, slot),
            _ => {}
        }
    }

    /// The same where only velocities are commanded: by the position of the axis, once it is known.
    #[inline]
    fn watch_velocity(&mut self, acceleration: f64, asked: f64, inputs: &Inputs, slot: &Slot) {
        let Some((low, high)) = self.limits.position.filter(|_| slot.status.homed) else { return };
        let velocity = if self.demand.velocity == 0.0 { asked } else { self.demand.velocity };
        if velocity == 0.0 {
            return;
        }
        let limit = if velocity > 0.0 { high } else { low };
        let reaction = AHEAD * self.interval_ns as f64 * 1e-9;
        let room = (limit - inputs.position) * velocity.signum() - velocity.abs() * reaction;
        if room > 0.0 && 2.0 * acceleration * room > velocity * velocity {
            return;
        }
        if self.demand.velocity == 0.0 {
            return self.refuse(Failure::Limit { what: "position", value: inputs.position, low, high });
        }
        let from = Point { position: inputs.position, ..self.demand };
        self.plan(Trajectory::run(from, 0.0, acceleration));
        self.enter(self.grid, Step::Limited { limit });
    }
}
