//! A new order.

use super::{ANSWERS, Before, Inputs, Kind, ModeIs, Orders, Step, Turning};
use crate::axis::command::NativeOwner;
use crate::axis::limits::check_position;
use crate::axis::{Command, Failure, Move, State, Target};
use crate::bus::Slot;
use crate::bus::ethercat::cia402::{ControlCommand, ControlWord};
use crate::bus::ethercat::native::NativePort;
use crate::drive::planner::{Point, Trajectory};
use crate::time::Time;

const NO_CONTROL: Failure = Failure::Unsupported("its outputs have no control word: map 6040h");
const BLIND: Failure =
    Failure::Unsupported("its setpoint is a position, and its inputs have none: map 6064h or 6063h");
const NO_POSITION: Failure =
    Failure::Unsupported("its setpoint is no position: take outputs with one (PDO 1701h), or jog");
const NO_VELOCITY: Failure = Failure::Unsupported(
    "its setpoint is neither a position nor a velocity: take outputs with one (PDO 1702h)",
);
const NO_TORQUE: Failure =
    Failure::Unsupported("its setpoint is no torque: take outputs with one (PDO 1703h)");
const FOUND_UNWATCHED: Failure = Failure::Unsupported(
    "it was found in operation with another watchdog than configured: disable it first, so that it can be set up again",
);
const NOT_WATCHED: Failure = Failure::Unsupported(
    "its SyncManager watchdog is off, nothing would stop it if the master dies: set watchdog, or no_drive_watchdog \
    = \"accept\"",
);
pub(super) const OTHER_MODE: Failure = Failure::Unsupported(
    "it is not in the mode of its setpoint: look at 6061h, or wait for the end of a homing",
);

impl Orders {
    /// Another order is present.
    #[cold]
    pub(super) fn replace(&mut self, now: Time, inputs: &Inputs, slot: &Slot, native: &mut NativePort) {
        self.serial = slot.order.serial;
        (self.end, self.progress_told) = (None, false);
        if self.new {
            // An order that was never sent leaves nothing behind.
            self.restore();
        } else {
            self.keep();
        }
        (self.new, self.reclaims) = (true, false);
        if self.is_native() {
            // The state that the application left the drive in is the present state.
            self.claim(inputs);
        }
        if let Step::Following { .. } = self.step {
            self.plan(Trajectory::on(self.demand));
        }
        self.native = None;
        self.native_gone = true;
        native.flush();
        self.begun = false;
        self.since = now;
        match self.cannot(slot.order.verb) {
            Some(failure) => {
                self.begun = true;
                self.refuse(failure);
            }
            None => self.begin_late(now, inputs, slot),
        }
    }

    fn keep(&mut self) {
        self.before = Before {
            writes: self.writes,
            step: self.step,
            control: self.control,
            start: self.start,
            halt: self.halt,
            leads: self.leads,
            foreign: self.foreign,
            away: self.away,
            motion: self.motion,
            passed_ns: self.passed_ns,
            demand: self.demand,
        };
    }

    fn restore(&mut self) {
        let Before { writes, step, control, start, halt, leads, foreign, away, motion, passed_ns, demand } =
            self.before;
        (self.writes, self.step, self.control, self.start) = (writes, step, control, start);
        (self.halt, self.leads, self.foreign, self.away) = (halt, leads, foreign, away);
        (self.motion, self.passed_ns, self.demand) = (motion, passed_ns, demand);
    }

    /// Begins once the drive was seen: before, the state to be taken over is unknown.
    pub(super) fn begin_late(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        if inputs.seen {
            self.begun = true;
            if std::mem::take(&mut self.reclaims) {
                return self.begin_again(now, inputs, slot);
            }
            if !self.writes {
                self.claim(inputs);
            }
            self.begin(now, inputs, slot);
        } else if now.since(self.since) > self.enable_timeout_ns {
            self.begun = true;
            self.finish(Err(Failure::TimedOut(slot.status.state)));
        }
    }

    /// The drive exchanges, but outputs do not reach it yet: the state that an order has taken over is old by the
    /// next exchange.
    pub(in crate::bus::ethercat) fn held(&mut self) {
        if self.new && self.begun && self.writes && !self.before.writes {
            (self.begun, self.reclaims) = (false, true);
        }
    }

    /// The same order, for the present state of the drive.
    fn begin_again(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        // The native output of the application was taken out of its queue already.
        let (since, native) = (self.since, self.native.take());
        self.restore();
        self.claim(inputs);
        if self.end.is_none() {
            self.begin(now, inputs, slot);
            // It has waited already.
            self.since = since;
            if self.is_native() {
                self.native = native;
            }
        } else if matches!(self.end, Some(Err(_))) {
            // It was refused: a motion that the drive was found in ends all the same.
            self.halt |= self.is_free() && !self.stands();
            self.wind_down();
        }
    }

    /// Something stops the drive if the master dies, or nothing needs to.
    fn is_watched(&self) -> bool {
        !self.needs_watch || self.watched && !self.found_otherwise
    }

    /// Why this drive cannot do that, in any state.
    fn cannot(&self, verb: Option<Command>) -> Option<Failure> {
        match verb? {
            Command::Reset => None,
            _ if !self.controlled => Some(NO_CONTROL),
            Command::Enable if self.found_otherwise && self.watched => Some(FOUND_UNWATCHED),
            Command::Enable if self.blind => Some(BLIND),
            Command::Move(_) | Command::Follow if self.kind != Kind::Position => Some(NO_POSITION),
            Command::Jog(_) | Command::Velocity { .. }
                if matches!(self.kind, Kind::Torque(_) | Kind::Zero) =>
            {
                Some(NO_VELOCITY)
            }
            Command::Torque { .. } if !matches!(self.kind, Kind::Torque(_)) => Some(NO_TORQUE),
            Command::Jog(_) | Command::Velocity { .. } | Command::Torque { .. } if !self.is_watched() => {
                Some(NOT_WATCHED)
            }
            _ => None,
        }
    }

    /// Takes the drive over as it is: with the control bits as found, at its present velocity.
    fn claim(&mut self, inputs: &Inputs) {
        let word = match inputs.state {
            _ if !inputs.operational => ControlWord(0),
            State::OperationEnabled => {
                self.run_from(self.found(inputs));
                self.foreign = inputs.mode == ModeIs::Other;
                return;
            }
            State::SwitchedOn => ControlCommand::SwitchOn.word(),
            State::ReadyToSwitchOn => ControlCommand::Shutdown.word(),
            State::QuickStopActive => ControlCommand::QuickStop.word(),
            _ => ControlWord(0),
        };
        self.set(word);
    }

    /// The begin of the setpoint for a drive that moves by itself.
    fn found(&self, inputs: &Inputs) -> Point {
        let turns = inputs.velocity.abs() > self.standstill;
        let velocity = if turns { inputs.velocity } else { 0.0 };
        // Its report is one exchange old.
        let position = inputs.position + velocity * self.interval_ns as f64 * 1e-9;
        // Its present torque is not the master's.
        Point { position, velocity: if matches!(self.kind, Kind::Torque(_)) { 0.0 } else { velocity } }
    }

    /// The new motion replaces a halt.
    pub(super) fn end_halt(&mut self, inputs: &Inputs) {
        if std::mem::take(&mut self.halt) {
            self.demand = self.found(inputs);
            self.plan(Trajectory::on(self.demand));
        }
    }

    /// The last word that was sent, or the one as found, has it in operation, and it reports that it is.
    fn runs(&self, inputs: &Inputs) -> bool {
        let on = ControlCommand::EnableOperation.word().0;
        self.leads && inputs.operating() && self.control_sent.is_none_or(|word| word.has(on))
    }

    fn begin(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        let Some(verb) = slot.order.verb else { return self.finish(Ok(())) };
        let fault = Failure::DriveFault(inputs.fault.into());
        match verb {
            Command::Reset => self.finish(Ok(())),
            Command::Enable if inputs.faulted() && inputs.named => self.finish(Err(fault)),
            Command::Enable if self.runs(inputs) && inputs.mode == ModeIs::Own => self.finish(Ok(())),
            Command::Enable => self.begin_enable(now, inputs),
            Command::Disable => {
                self.set(ControlWord(0));
                self.enter(now, Step::Disabling);
            }
            Command::Home => {
                self.wind_down();
                self.enter(now, Step::HomeWaiting);
            }
            Command::Stop { .. } | Command::QuickStop => self.begin_stop(now, verb, inputs),
            Command::ResetFault if !inputs.faulted() => self.finish(Ok(())),
            Command::ResetFault => {
                self.set(ControlWord(0));
                self.enter(now, Step::ResetWaiting);
            }
            Command::Native(owner) => self.begin_native(now, owner, inputs),
            _ if !self.runs(inputs) => self.finish(Err(Failure::WrongState(slot.status.state))),
            _ if inputs.mode != ModeIs::Own => self.refuse(OTHER_MODE),
            _ => self.begin_motion(now, verb, inputs, slot),
        }
    }

    /// An order that needs a drive that follows setpoints, in their mode.
    fn begin_motion(&mut self, now: Time, verb: Command, inputs: &Inputs, slot: &Slot) {
        self.end_halt(inputs);
        match verb {
            Command::Move(motion) => self.begin_move(now, &motion),
            Command::Jog(jog) => self.begin_turning(now, jog.acceleration, inputs, slot),
            Command::Velocity { acceleration } => self.begin_turning(now, acceleration, inputs, slot),
            Command::Torque { slope } => self.begin_turning(now, slope, inputs, slot),
            _ => {
                self.enter(now, Step::FollowWaiting);
                // The running motion ends here, and the first row may have come with the order.
                self.brake(self.deceleration);
                self.follow(slot);
            }
        }
    }

    fn begin_native(&mut self, now: Time, owner: NativeOwner, inputs: &Inputs) {
        self.end_halt(inputs);
        // It stands still, or has no torque, until the application gives a setpoint.
        self.wind_down();
        self.enter(now, Step::Native(owner));
    }

    fn begin_enable(&mut self, now: Time, inputs: &Inputs) {
        let off = self.control_sent.is_some_and(|word| !word.has(ControlWord::SWITCH_ON));
        let held = inputs.operational && !off && inputs.state == State::SwitchedOn;
        self.rest = if held { ControlCommand::SwitchOn.word() } else { ControlWord(0) };
        match inputs.state {
            State::OperationEnabled | State::QuickStopActive if inputs.operational && !off => {
                self.hold(inputs.position);
            }
            _ if held => self.set(ControlCommand::SwitchOn.word()),
            _ => self.set(ControlCommand::Shutdown.word()),
        }
        self.enter(now, Step::Enabling);
    }

    fn begin_move(&mut self, now: Time, motion: &Move) {
        let from = self.demand.position;
        let target = match motion.target {
            Target::Absolute(position) => self.near(position),
            Target::Relative(distance) => from + distance,
        };
        if let Err(failure) = check_position(&self.limits, target) {
            return self.refuse(failure);
        }
        let profile = &motion.profile;
        let down = self.braking(profile.deceleration);
        self.plan(Trajectory::go_to(self.demand, target, profile.velocity, profile.acceleration, down));
        self.enter(now, Step::Moving);
    }

    /// On a rotary axis, the position equal to `position` that is nearest to the demand.
    pub(super) fn near(&self, position: f64) -> f64 {
        match self.units.modulo {
            Some(_) => self.demand.position + self.units.way(self.demand.position, position),
            None => position,
        }
    }

    fn begin_turning(&mut self, now: Time, acceleration: f64, inputs: &Inputs, slot: &Slot) {
        // NaN equals no velocity or torque: the motion is planned with the setpoint.
        self.enter(now, Step::Turning(Turning { acceleration, velocity: f64::NAN, limit: None }));
        self.turn_on(inputs, slot);
    }

    fn begin_stop(&mut self, now: Time, verb: Command, inputs: &Inputs) {
        match (self.step, verb) {
            (Step::HomeMode | Step::Homing | Step::HomeStopping(_) | Step::HomeLeaving(_), _) => {
                self.start = false;
                self.halt = verb == Command::QuickStop;
                self.enter(now, Step::HomeStopping(Ok(())));
            }
            // Powering up: it does not continue by itself.
            (Step::Enabling, _) => {
                let rest = self.rest;
                self.set(rest);
                self.enter(now, Step::Disabling);
            }
            _ if !self.leads => self.begin_stop_without_setpoint(now, inputs),
            // A stop that is under way is not made softer.
            _ if inputs.mode != ModeIs::Own || self.halt => self.halt(now, inputs),
            (_, Command::Stop { deceleration }) => {
                self.brake(deceleration.unwrap_or(self.deceleration));
                self.enter(now, Step::Stopping);
            }
            _ => self.halt(now, inputs),
        }
    }

    /// There is no setpoint: the last word stays, and if that was power off, its effect is waited for.
    fn begin_stop_without_setpoint(&mut self, now: Time, inputs: &Inputs) {
        if self.control.has(ControlWord::SWITCH_ON) || inputs.state == State::QuickStopActive {
            self.enter(now, Step::Stopping);
        } else {
            self.enter(now, Step::Disabling);
        }
    }

    /// As fast as the drive is configured for it, with its power on.
    pub(super) fn halt(&mut self, now: Time, inputs: &Inputs) {
        let most = self.limits.acceleration.unwrap_or(self.deceleration).max(self.deceleration);
        self.halt = true;
        self.plan(match self.kind {
            // In another mode its setpoint has no effect.
            Kind::Position if inputs.mode == ModeIs::Own => {
                Trajectory::run(self.demand, 0.0, self.braking(most))
            }
            // The drive's own ramp acts below it.
            _ => Trajectory::on(Point { velocity: 0.0, ..self.demand }),
        });
        self.enter(now, Step::Halting);
    }

    /// So many answers came to the word of this step.
    pub(super) fn is_answered(&self, inputs: &Inputs) -> bool {
        inputs.fresh && self.answers >= ANSWERS
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::ethercat::native::native;
    use crate::bus::ethercat::object::{Family, pdo};
    use crate::bus::ethercat::plan::KollmorgenDrive;
    use crate::time::{MS, S};

    /// A drive at 10 rev/s, after so many ms.
    fn moving(n: u64) -> Inputs {
        let position = n as f64 * 0.01;
        let state = State::OperationEnabled;
        Inputs {
            seen: true,
            fresh: true,
            operational: true,
            state,
            position,
            velocity: 10.0,
            ..Inputs::default()
        }
    }

    #[test]
    fn what_is_taken_over_is_the_drive_as_it_is_when_outputs_first_reach_it() {
        let mut drive = KollmorgenDrive::new("x", 0, Family::S700);
        drive.outputs = pdo::fixed(Family::S700).into_iter().find(|layout| layout.pdo == 0x1701).unwrap();
        drive.fit();
        let mut orders = Orders::new(&drive, MS);
        let (_application, mut native) = native(&drive.outputs, &drive.inputs);
        let mut slot = Slot::default();
        (slot.order.serial, slot.order.verb) = (1, Some(Command::Stop { deceleration: Some(10.0) }));
        let mut advance = |orders: &mut Orders, n: u64| {
            let out = orders.advance(Time(S + n * MS), &moving(n), &mut slot, &mut native);
            assert!(orders.writes() && out.control == ControlCommand::EnableOperation.word());
            f64::from(out.setpoint) / f64::from(1 << 20)
        };
        for n in 0..20 {
            let ahead = advance(&mut orders, n) - moving(n).position;
            assert!((0.015..0.025).contains(&ahead), "{ahead} ahead of the drive in cycle {n}");
            orders.held();
        }
        // From then on its setpoints advance by themselves.
        let mut last = advance(&mut orders, 20);
        orders.sent();
        for n in 21..1_021 {
            orders.held();
            let now = advance(&mut orders, n);
            assert!((-1e-6..0.010_001).contains(&(now - last)), "{now} behind {last}");
            last = now;
            orders.sent();
        }
        // 10 rev/s with 10 rev/s^2 take 5 rev.
        assert!((last - 5.2).abs() < 0.03, "{last}");
    }
}
