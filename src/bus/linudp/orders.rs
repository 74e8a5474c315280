//! What an order does to a LinMot drive, step by step: edges, counts, hold times.
//!
//! Every step waits for the drive's report in a reply to a request that was sent after the step began, never for a
//! time. The control word stays as the last step left it. Nothing is written before the first order.
//!
//! Sources: SG5 manual 4.3.4, state machine and motion command interface (sheet, 3.5 and 4.1).

use super::channel::MotionChannel;
use super::motion::{Acceleration, MotionCommand, Position, SignedAcceleration, SignedVelocity, Velocity};
use super::native::{NativeOutput, NativePort};
use super::plan::{LinUdpDrive, StreamCommand};
use super::wire::{ControlWord, ErrorCode, MainState, MotionBlock, RtcBlock, StateVar, StatusWord};
use crate::axis::command::NativeOwner;
use crate::axis::limits::check_position;
use crate::axis::units::{to_i32, to_u32};
use crate::axis::{Command, Failure, Limits, Move, Profile, RangeError, Row, State, Target, Units};
use crate::bus::{Progress, Slot};
use crate::time::{MS, Time, nanos};

/// A stream ends with at least so many rows at standstill that the drive has accepted: its output runs 1.5 of its
/// periods behind, and a position that it has not reached when it leaves streaming is never reached ...
const LAST_ROWS: u32 = 3;
/// ... and with at most so many, if its demand is never reported to have arrived.
const MOST_LAST_ROWS: u32 = 50;

/// A drive that is still in state 8 after so many answers ...
const ABORT_WITHIN: u32 = 5;
/// ... and so long, ns, does not obey /Abort. Its status may be some ms old (sheet, 3.5).
const ABORT_WITHIN_NS: u64 = 20 * MS;

/// Powered and holding, out of operation.
const HELD: ControlWord = ControlWord(ControlWord::ON.0 & !ControlWord::ENABLE_OPERATION);

/// What the drive reported last, as far as orders need it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Inputs {
    /// There was a reply at all.
    pub seen: bool,
    /// New since the last request was built.
    pub fresh: bool,
    /// Not suspect.
    pub clean: bool,
    /// Its count is none that this master has used lately.
    pub foreign: bool,
    /// Status word and state var are 0: booting, or the motion software is stopped.
    pub booting: bool,
    /// When it came in.
    pub at: Time,
    pub status: StatusWord,
    pub state: StateVar,
    /// Unwrapped, 0.1 um.
    pub demand: i64,
    /// Velocity of the demand, user units/s.
    pub velocity: f64,
    pub fault: ErrorCode,
}

impl Inputs {
    /// In error, or in the quick stop that an error began.
    fn failed(&self) -> bool {
        self.settled_error() || (self.state.main() == MainState::QUICK_STOP && self.status.error())
    }

    /// In error and no longer braking: the only states in which an error can be acknowledged.
    fn settled_error(&self) -> bool {
        matches!(self.state.main(), MainState::ERROR | MainState::SETUP_ERROR)
    }

    /// The setpoint generator runs. In state 8 the sub state is sampled together with the count echo; elsewhere the
    /// status word has to be used.
    pub(super) fn moving(&self) -> bool {
        self.state.motion_active().unwrap_or(self.status.motion_active())
    }
}

/// The blocks of the next request.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Outputs {
    pub control: Option<ControlWord>,
    pub motion: Option<MotionBlock>,
    pub config: Option<RtcBlock>,
}

/// The orders of one drive.
#[derive(Debug)]
pub(super) struct Orders {
    units: Units,
    limits: Limits,
    profile: Profile,
    stream: Option<StreamCommand>,
    leash: Option<f64>,
    enable_timeout_ns: u64,
    home_timeout_ns: u64,
    inhibit_after_ns: u64,
    voltage: Voltage,
    serial: u64,
    step: Step,
    since: Time,
    /// Clean replies since the step began whose request was sent in it.
    answers: u32,
    /// Requests sent since the step began.
    sent: u32,
    /// What the last of those replies said of the drive: main state, and whether its motion runs.
    said: Option<(MainState, bool)>,
    /// The last two of them say the same. A single reply that comes again, many cycles late, may look like the newest;
    /// it is no reason to report that an order is done.
    confirmed: bool,
    control: Option<ControlWord>,
    /// The control words of the last request that went out, and of the one before.
    control_sent: Option<ControlWord>,
    control_before: Option<ControlWord>,
    /// What the running enable falls back to: off, or powered and out of operation, as the drive was found.
    rest: ControlWord,
    channel: MotionChannel,
    /// The native output of the next request. It stays until that has gone out: a request may be built more than
    /// once for one send, and a send may fail.
    native: Option<NativeOutput>,
    end: Option<Result<(), Failure>>,
}

/// Whether the drive lets its power stage come on, as the requests allow it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Voltage {
    /// Not allowed, or not reported yet.
    Unknown,
    Present,
    /// Since this reply; `lost` = it was present before.
    Missing {
        since: Time,
        lost: bool,
    },
}

/// The step of an order.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Step {
    Idle,
    /// Control word low until the drive is ready to switch on.
    EnableLow,
    /// Control word on until the drive is in operation.
    EnableHigh,
    Disabling,
    /// The home bit is held until the drive reports finished.
    Homing,
    /// The home bit is released until the drive is back in operation.
    HomeDone,
    /// A motion command is under way; the setpoint generator of the drive runs it then, to this position if it has one.
    Moving(Option<Position>),
    /// A velocity as a target that rolls ahead.
    Rolling(Rolling),
    /// The first row has not come yet.
    FollowWaiting,
    Following {
        row: u64,
    },
    /// The last row has been sent, and rows at standstill follow it; so many of all these were accepted.
    FollowEnding {
        taken: u32,
        last: Row,
    },
    /// /Abort is low until the drive stands still.
    Aborting,
    /// /Abort is high again until the drive is back in operation.
    AbortDone,
    /// The drive brakes by itself with the control word as found: bit 0 low would let the axis coast.
    AcknowledgeWaiting,
    /// Control word low, so that the acknowledge has an edge and the drive cannot switch on with it.
    AcknowledgeLow,
    Acknowledging,
    AcknowledgeDone,
    Native(NativeOwner),
}

/// A velocity as a target that rolls ahead of the axis.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Rolling {
    /// Signed, user units/s; 0 = braking, or at standstill.
    velocity: f64,
    acceleration: f64,
    leash: f64,
    /// The last target sent, user units.
    target: f64,
    /// The target is the position limit: it rolls no further.
    at_limit: bool,
}

impl Orders {
    pub(super) fn new(drive: &LinUdpDrive) -> Orders {
        Orders {
            units: drive.axis.units,
            limits: drive.axis.limits,
            profile: drive.axis.profile,
            stream: drive.stream,
            leash: drive.leash,
            enable_timeout_ns: nanos(drive.axis.enable_timeout),
            home_timeout_ns: nanos(drive.axis.home_timeout),
            inhibit_after_ns: nanos(drive.inhibit_after),
            voltage: Voltage::Unknown,
            serial: 0,
            step: Step::Idle,
            since: Time(0),
            answers: 0,
            sent: 0,
            said: None,
            confirmed: false,
            control: None,
            control_sent: None,
            control_before: None,
            rest: ControlWord::BASE,
            channel: MotionChannel::default(),
            native: None,
            end: None,
        }
    }

    /// The last built request has gone out.
    pub(super) fn sent(&mut self) {
        self.sent = self.sent.saturating_add(1);
        self.control_before = std::mem::replace(&mut self.control_sent, self.control);
        self.native = None;
        self.channel.sent();
    }

    /// The drive reports that its power stage may not come on although the last requests allowed it: an input of
    /// its own, such as the hardware enable (STO), prevents it. According to the sheet the bit is that of the
    /// control word as the drive sees it, its own inputs included; that a missing STO shows in it was not seen on
    /// hardware.
    ///
    /// The status may be older than the control word (sheet, 3.5): a bit that was not there before has time to come.
    /// One that was there and goes is no such lag, since the control word has not changed.
    pub(super) fn inhibited(&mut self, at: Time, status: StatusWord, booting: bool) -> bool {
        let allowed =
            |word: Option<ControlWord>| word.is_some_and(|word| word.has(ControlWord::VOLTAGE_ENABLE));
        self.voltage = match self.voltage {
            _ if booting || !allowed(self.control_sent) || !allowed(self.control_before) => Voltage::Unknown,
            _ if status.has(StatusWord::VOLTAGE_ENABLE) => Voltage::Present,
            Voltage::Unknown => Voltage::Missing { since: at, lost: false },
            Voltage::Present => Voltage::Missing { since: at, lost: true },
            missing @ Voltage::Missing { .. } => missing,
        };
        matches!(self.voltage, Voltage::Missing { lost: true, .. }) || self.lacks_voltage(at)
    }

    /// The same for long enough.
    fn lacks_voltage(&self, at: Time) -> bool {
        matches!(self.voltage, Voltage::Missing { since, .. } if at.since(since) >= self.inhibit_after_ns)
    }

    /// The drive came back from a restart: earlier commands are lost. Its count starts anew, and is reported before the
    /// next command is sent.
    pub(super) fn drive_restarted(&mut self) {
        self.channel.clear();
        if self.control.is_some() {
            self.control = Some(ControlWord::BASE);
        }
        if matches!(self.step, Step::EnableLow | Step::EnableHigh) {
            self.finish(Err(Failure::Dropped(State::NotReadyToSwitchOn)));
        }
    }

    /// Works on the order in `slot` with the drive's last report, and returns the blocks of the next request.
    pub(super) fn advance(
        &mut self,
        now: Time,
        inputs: &Inputs,
        slot: &mut Slot,
        native: &mut NativePort,
    ) -> Outputs {
        let fresh = inputs.seen && inputs.fresh;
        if fresh {
            if inputs.clean && self.sent > 0 {
                // A step may last for ever: at 1 kHz the count is full after 50 days.
                self.answers = self.answers.saturating_add(1);
                let said = Some((inputs.state.main(), inputs.moving()));
                self.confirmed = std::mem::replace(&mut self.said, said) == said;
            }
            if let Some(echo) = inputs.state.count()
                && let Err(failure) = self.channel.take(echo, inputs.clean, inputs.foreign)
            {
                self.finish(Err(failure));
            }
            if self.channel.is_accepted() && !matches!(self.step, Step::Moving(_) | Step::Rolling(_)) {
                self.channel.clear();
            }
        }
        if slot.order.serial != self.serial {
            self.serial = slot.order.serial;
            self.end = None;
            self.begin(now, inputs, slot, native);
        } else if self.end.is_none() || matches!(self.step, Step::Aborting | Step::AbortDone) {
            self.go_on(now, fresh, inputs, slot);
        }
        if self.serial != 0 {
            slot.progress = Progress { serial: self.serial, end: self.end };
        }
        native.runs(matches!(self.step, Step::Native(_)));
        if let Step::Native(owner) = self.step {
            self.take_native(now, owner, inputs, native);
        }
        Outputs {
            control: self.control,
            motion: self.channel.block(),
            config: self.native.and_then(|output| output.config),
        }
    }

    /// Takes the next native output once the previous one has gone out, and its motion was echoed.
    fn take_native(&mut self, now: Time, owner: NativeOwner, inputs: &Inputs, native: &mut NativePort) {
        if self.native.is_some() {
            return;
        }
        let free = self.channel.is_free() || inputs.state.count().is_none();
        let Some(output) = native.next(free) else { return };
        if output.motion.is_some_and(|command| command.id == MotionCommand::reset_firmware().id) {
            // With any count but 0 the drive restarts again and again (sheet, 4.3), and with 0 it does nothing if that
            // is what it has stored.
            let why = "00Fx needs a count that this master does not send; restart the drive by its parameter channel";
            return self.refuse(now, Failure::Unsupported(why), inputs);
        }
        if owner == NativeOwner::Application && output.control.is_some() {
            self.control = output.control;
        }
        if let Some(command) = output.motion {
            self.channel.send(command);
        }
        self.native = Some(output);
    }

    fn enter(&mut self, now: Time, step: Step) {
        (self.step, self.since, self.answers, self.sent) = (step, now, 0, 0);
        (self.said, self.confirmed) = (None, false);
    }

    fn finish(&mut self, end: Result<(), Failure>) {
        // A motion that has failed for the application must not run once the drive can accept it.
        self.channel.clear();
        self.native = None;
        self.end = Some(end);
        self.step = Step::Idle;
    }

    fn begin(&mut self, now: Time, inputs: &Inputs, slot: &Slot, native: &mut NativePort) {
        self.channel.clear();
        self.native = None;
        native.flush();
        let state = inputs.state.main();
        let operating = state == MainState::OPERATION_ENABLED;
        let failed = inputs.failed();
        match slot.order.verb {
            None => {
                self.control = Some(self.as_found(inputs));
                self.finish(Ok(()));
            }
            Some(Command::Enable) if failed => {
                self.finish(Err(Failure::DriveFault(u32::from(inputs.fault.0))))
            }
            Some(Command::Enable) if operating && !self.told_off() => {
                self.control = Some(ControlWord::ON);
                self.finish(Ok(()));
            }
            Some(Command::Enable) if state == MainState::QUICK_STOP => {
                self.finish(Err(Failure::WrongState(slot.status.state)));
            }
            Some(Command::Enable) => {
                // A drive that is switched on already, but not in operation, is not switched off first.
                let on = state >= MainState::HW_TESTS && !self.told_off();
                self.control = Some(if on { ControlWord::ON } else { ControlWord::BASE });
                self.rest = if on && state > MainState::HW_TESTS { HELD } else { ControlWord::BASE };
                self.enter(now, if on { Step::EnableHigh } else { Step::EnableLow });
            }
            Some(Command::Disable) => {
                self.control = Some(ControlWord::BASE);
                self.enter(now, Step::Disabling);
            }
            Some(Command::Home) => {
                self.control = Some(ControlWord::HOME);
                self.enter(now, Step::Homing);
            }
            Some(Command::Move(motion)) => match self.motion(now, &motion, inputs) {
                Ok((command, target)) => self.command(now, command, Step::Moving(Some(target))),
                Err(failure) => self.refuse(now, failure, inputs),
            },
            Some(Command::Jog(jog)) => self.begin_rolling(now, jog.velocity, jog.acceleration, inputs),
            Some(Command::Velocity { acceleration }) => {
                self.begin_rolling(now, slot.velocity, acceleration, inputs);
            }
            Some(Command::Torque { .. }) => {
                let why = "it takes positions and velocities, no torques";
                self.refuse(now, Failure::Unsupported(why), inputs);
            }
            Some(Command::Follow) if self.stream.is_none() => {
                let why = "no streaming command fits its cycle (stream = \"off\")";
                self.refuse(now, Failure::Unsupported(why), inputs);
            }
            Some(Command::Follow) => {
                self.enter(now, Step::FollowWaiting);
                // The first row may have come with the order.
                self.follow(now, inputs, slot);
            }
            // It may go on reporting that it is in operation for as long as its replies are lost.
            Some(Command::Stop { .. } | Command::QuickStop) if self.told_off() => {
                self.control = Some(ControlWord::BASE);
                self.enter(now, Step::Disabling);
            }
            Some(Command::Stop { deceleration }) => self.begin_stop(now, deceleration, inputs),
            Some(Command::QuickStop) => self.begin_abort(now, inputs),
            Some(Command::ResetFault) if !failed => self.finish(Ok(())),
            Some(Command::ResetFault) if inputs.settled_error() => self.begin_acknowledge(now, inputs),
            Some(Command::ResetFault) => {
                self.control = Some(self.as_found(inputs));
                self.enter(now, Step::AcknowledgeWaiting);
            }
            Some(Command::Native(owner)) => {
                if owner == NativeOwner::Application {
                    self.control = Some(self.as_found(inputs));
                }
                self.enter(now, Step::Native(owner));
            }
            Some(Command::Reset) => self.finish(Ok(())),
        }
    }

    fn begin_acknowledge(&mut self, now: Time, inputs: &Inputs) {
        self.control = Some(ControlWord::BASE);
        if inputs.status.fatal() {
            self.finish(Err(Failure::DriveFault(u32::from(inputs.fault.0))));
        } else {
            self.enter(now, Step::AcknowledgeLow);
        }
    }

    fn go_on(&mut self, now: Time, fresh: bool, inputs: &Inputs, slot: &mut Slot) {
        let state = inputs.state.main();
        let answered = fresh && inputs.clean && self.answers > 0;
        let confirmed = answered && self.confirmed;
        let operating = state == MainState::OPERATION_ENABLED;
        let failed = inputs.failed();
        let drive_fault = Failure::DriveFault(u32::from(inputs.fault.0));
        let timed_out = |limit_ns: u64| now.since(self.since) > limit_ns;
        match self.step {
            Step::Idle => {}
            Step::EnableLow | Step::EnableHigh if answered && failed => self.finish(Err(drive_fault)),
            Step::EnableLow | Step::EnableHigh if answered && self.lacks_voltage(inputs.at) => {
                self.control = Some(ControlWord::BASE);
                self.finish(Err(Failure::Inhibited));
            }
            Step::EnableLow if answered && state == MainState::READY_TO_SWITCH_ON => {
                self.control = Some(ControlWord::ON);
                let begun = self.since;
                self.enter(now, Step::EnableHigh);
                self.since = begun;
            }
            Step::EnableHigh if confirmed && operating => self.finish(Ok(())),
            Step::EnableLow | Step::EnableHigh if timed_out(self.enable_timeout_ns) => {
                self.control = Some(self.rest);
                self.finish(Err(Failure::TimedOut(slot.status.state)));
            }
            Step::EnableLow | Step::EnableHigh => {}

            Step::Disabling if confirmed && !slot.status.state.is_powered() => self.finish(Ok(())),
            Step::Disabling if timed_out(self.enable_timeout_ns) => {
                self.finish(Err(Failure::TimedOut(slot.status.state)));
            }
            Step::Disabling => {}

            Step::Homing if answered && state == MainState::HOMING && inputs.state.finished() => {
                self.control = Some(ControlWord::ON);
                self.enter(now, Step::HomeDone);
            }
            Step::HomeDone if confirmed && operating => self.finish(Ok(())),
            Step::Homing | Step::HomeDone if answered && failed => self.finish(Err(drive_fault)),
            Step::Homing | Step::HomeDone if answered && !slot.status.state.is_powered() => {
                self.finish(Err(Failure::Dropped(slot.status.state)));
            }
            Step::Homing | Step::HomeDone if timed_out(self.home_timeout_ns) => {
                self.control = Some(ControlWord::ON);
                self.finish(Err(Failure::TimedOut(slot.status.state)));
            }
            Step::Homing | Step::HomeDone => {}

            // The drive does not quick stop: its parameters force this bit of the control word, as they often do
            // (sheet, 3.1). The ramp is a motion command, which needs none.
            Step::Aborting if answered && operating => {
                if self.answers > ABORT_WITHIN && timed_out(ABORT_WITHIN_NS) {
                    let most = self.limits.acceleration.unwrap_or(self.profile.deceleration);
                    self.begin_stop(now, Some(most), inputs);
                }
            }
            Step::Aborting => {
                if confirmed && (!inputs.moving() || !slot.status.state.is_powered()) {
                    self.control = Some(self.as_found(inputs));
                    self.enter(now, Step::AbortDone);
                }
            }
            Step::AbortDone if confirmed && operating && inputs.moving() => {
                self.begin_stop(now, None, inputs);
            }
            Step::AbortDone if confirmed && (operating || !slot.status.state.is_powered()) => {
                self.control = Some(self.as_found(inputs));
                self.finish(Ok(()));
            }
            Step::AbortDone => {}

            Step::AcknowledgeWaiting if answered && inputs.settled_error() => {
                let begun = self.since;
                self.begin_acknowledge(now, inputs);
                self.since = begun;
            }
            Step::AcknowledgeWaiting if confirmed && !failed => self.finish(Ok(())),
            Step::AcknowledgeWaiting if timed_out(self.enable_timeout_ns) => self.finish(Err(drive_fault)),
            Step::AcknowledgeWaiting => {}
            Step::AcknowledgeLow if answered => {
                self.control = Some(ControlWord::ACKNOWLEDGE);
                let begun = self.since;
                self.enter(now, Step::Acknowledging);
                self.since = begun;
            }
            Step::Acknowledging if answered && !failed => {
                self.control = Some(ControlWord::BASE);
                self.enter(now, Step::AcknowledgeDone);
            }
            Step::AcknowledgeDone if confirmed && !failed => self.finish(Ok(())),
            Step::AcknowledgeLow | Step::Acknowledging | Step::AcknowledgeDone
                if timed_out(self.enable_timeout_ns) =>
            {
                self.control = Some(ControlWord::BASE);
                self.finish(Err(drive_fault));
            }
            Step::AcknowledgeLow | Step::Acknowledging | Step::AcknowledgeDone => {}

            // All that follows needs the drive in operation.
            _ if answered && failed => self.finish(Err(drive_fault)),
            Step::Native(NativeOwner::Application) => {}
            _ if answered && !operating => self.finish(Err(Failure::Dropped(slot.status.state))),

            Step::Moving(target) if answered && self.channel.is_over(inputs.state) => {
                let arrived = target.is_none_or(|target| is_near(target, inputs.demand));
                self.finish(if arrived { Ok(()) } else { Err(Failure::NotArrived) });
            }
            Step::Moving(_) => {}
            Step::Rolling(rolling) => self.roll(now, answered, rolling, inputs, slot),
            Step::FollowWaiting | Step::Following { .. } => self.follow(now, inputs, slot),
            Step::FollowEnding { taken, last } => self.end_stream(now, taken, last, fresh, inputs),
            Step::Native(NativeOwner::Master) => {}
        }
    }

    fn command(&mut self, now: Time, command: MotionCommand, step: Step) {
        self.channel.send(command);
        self.enter(now, step);
    }

    /// A motion that cannot continue. The one before it has ended for the application, so nothing shall move
    /// unobserved.
    fn refuse(&mut self, now: Time, failure: Failure, inputs: &Inputs) {
        self.finish(Err(failure));
        if inputs.state.motion_active() == Some(true)
            && let Ok(deceleration) = self.acceleration(self.braking(now, self.profile.deceleration, inputs))
        {
            self.channel.send(MotionCommand::vai_stop(deceleration));
        }
    }

    /// The demand position, not folded into one turn.
    fn demand(&self, inputs: &Inputs) -> f64 {
        self.units.distance(inputs.demand as f64) + self.units.offset
    }

    /// A move as "VAI go to position". A relative one is made absolute here: if its reply were lost and the command
    /// repeated, an increment would run twice.
    fn motion(
        &self,
        now: Time,
        motion: &Move,
        inputs: &Inputs,
    ) -> Result<(MotionCommand, Position), Failure> {
        let position = match motion.target {
            Target::Absolute(position) => self.near(position, inputs),
            Target::Relative(distance) => self.demand(inputs) + distance,
        };
        check_position(&self.limits, position)?;
        let command = self.go_to(now, position, &motion.profile, inputs)?;
        Ok((command, self.position(position, inputs)?))
    }

    /// On a rotary axis, the place of `position` that is nearest to the demand.
    fn near(&self, position: f64, inputs: &Inputs) -> f64 {
        match self.units.modulo {
            Some(_) => self.demand(inputs) + self.units.way(self.demand(inputs), position),
            None => position,
        }
    }

    fn go_to(
        &self,
        now: Time,
        position: f64,
        profile: &Profile,
        inputs: &Inputs,
    ) -> Result<MotionCommand, RangeError> {
        Ok(MotionCommand::vai_go_to(
            self.position(position, inputs)?,
            self.velocity(profile.velocity)?,
            self.acceleration(profile.acceleration)?,
            self.acceleration(self.braking(now, profile.deceleration, inputs))?,
        ))
    }

    /// The requested deceleration, or the one needed to brake within the limits from where the axis will be at the
    /// next send: the deceleration of a motion that replaces a fast one may be too weak for the remaining way.
    /// Never more than the limit of acceleration, or than the axis' own profile if there is no limit.
    fn braking(&self, now: Time, asked: f64, inputs: &Inputs) -> f64 {
        let velocity = inputs.velocity;
        let Some((low, high)) = self.limits.position else { return asked };
        // Standstill at the very end is no reason to brake, and before homing positions mean nothing.
        if velocity == 0.0 || !inputs.status.homed() {
            return asked;
        }
        let demand = self.demand(inputs);
        let room = if velocity > 0.0 { high - demand } else { demand - low };
        // Twice the way until then: the telegram may have to be repeated.
        let left = room - 2.0 * velocity.abs() * now.since(inputs.at) as f64 * 1e-9;
        let most = self.limits.acceleration.unwrap_or(self.profile.deceleration);
        let needed = if left > 0.0 { velocity * velocity / (2.0 * left) } else { most };
        asked.max(needed.min(most))
    }

    /// The count of a rotary axis wraps around, in the drive as here: a target is at most half of its range away from
    /// the demand, and the shorter way leads there.
    fn position(&self, position: f64, inputs: &Inputs) -> Result<Position, RangeError> {
        let from = if self.units.modulo.is_some() { inputs.demand } else { 0 };
        let way = self.units.counts(position) - from as f64;
        let way = to_i32(way, self.units.counts_per_unit, "units")?;
        Ok(Position((from + i64::from(way)) as i32))
    }

    /// 1 um/s: ten times coarser than a count of 0.1 um.
    fn velocity(&self, velocity: f64) -> Result<Velocity, RangeError> {
        let scale = self.units.counts_per_unit.abs() * 0.1;
        at_least_one(velocity, to_u32(velocity * scale, scale, "units/s")?, scale, "units/s").map(Velocity)
    }

    /// 1e-5 m/s2: a hundred times coarser than a count of 0.1 um.
    fn acceleration(&self, acceleration: f64) -> Result<Acceleration, RangeError> {
        let scale = self.units.counts_per_unit.abs() * 0.01;
        at_least_one(acceleration, to_u32(acceleration * scale, scale, "units/s2")?, scale, "units/s2")
            .map(Acceleration)
    }

    fn begin_rolling(&mut self, now: Time, velocity: f64, acceleration: f64, inputs: &Inputs) {
        let Some(leash) = self.leash else {
            let why = "a LinUDP drive has no watchdog; allow jogs and velocities with no_drive_watchdog = \
                \"accept\" and a leash";
            return self.refuse(now, Failure::Unsupported(why), inputs);
        };
        self.roll_on(now, Rolling { velocity, acceleration, leash, target: 0.0, at_limit: false }, inputs);
    }

    fn roll(&mut self, now: Time, answered: bool, rolling: Rolling, inputs: &Inputs, slot: &Slot) {
        if !self.channel.is_accepted() || !answered {
            return;
        }
        let left = (rolling.target - self.demand(inputs)).abs();
        if slot.velocity != rolling.velocity {
            self.roll_on(now, Rolling { velocity: slot.velocity, ..rolling }, inputs);
        } else if rolling.at_limit {
            if self.channel.is_over(inputs.state) {
                let (low, high) = self.limits.position.unwrap_or((rolling.target, rolling.target));
                self.finish(Err(Failure::Limit { what: "position", value: rolling.target, low, high }));
            }
        } else if rolling.velocity != 0.0 && left <= rolling.leash * 0.75 {
            self.roll_on(now, rolling, inputs);
        }
    }

    /// Sends the next target, a leash ahead of the demand; for velocity 0 a ramp.
    fn roll_on(&mut self, now: Time, mut rolling: Rolling, inputs: &Inputs) {
        rolling.at_limit = false;
        if rolling.velocity == 0.0 {
            return match self.acceleration(self.braking(now, rolling.acceleration, inputs)) {
                Ok(ramp) => self.command(
                    now,
                    MotionCommand::vai_stop(ramp.max(Acceleration(1))),
                    Step::Rolling(rolling),
                ),
                Err(range) => self.refuse(now, range.into(), inputs),
            };
        }
        // Half of the leash is always ahead; the axis must be able to brake within it, or it would never reach that
        // speed.
        let most = (rolling.acceleration * rolling.leash).sqrt();
        if rolling.velocity.abs() > most {
            let (what, value) = ("velocity within the leash", rolling.velocity);
            return self.refuse(now, Failure::Limit { what, value, low: -most, high: most }, inputs);
        }
        let demand = self.demand(inputs);
        rolling.target = demand + rolling.leash.copysign(rolling.velocity);
        if let Some((low, high)) = self.limits.position {
            // Only the limit ahead ends the motion: from outside the range it leads back in.
            let (ahead, beyond) = match rolling.velocity > 0.0 {
                true => (high, rolling.target > high),
                false => (low, rolling.target < low),
            };
            if beyond && (ahead - demand) * rolling.velocity <= 0.0 {
                return self.refuse(
                    now,
                    Failure::Limit { what: "position", value: rolling.target, low, high },
                    inputs,
                );
            }
            rolling.at_limit = beyond;
            rolling.target = if beyond { ahead } else { rolling.target };
        }
        let profile = Profile {
            velocity: rolling.velocity.abs(),
            acceleration: rolling.acceleration,
            deceleration: rolling.acceleration,
        };
        match self.go_to(now, rolling.target, &profile, inputs) {
            Ok(command) => self.command(now, command, Step::Rolling(rolling)),
            Err(range) => self.refuse(now, range.into(), inputs),
        }
    }

    /// One row per exchange. A row that came before (its slot was passed over) is not counted twice.
    fn follow(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        let Some(next) = slot.row else { return };
        if matches!(self.step, Step::Following { row, .. } if row == next.number) {
            return;
        }
        let row = Row { position: self.near(next.row.position, inputs), ..next.row };
        if let Err(range) = self.stream_row(&row, inputs) {
            return self.refuse(now, range.into(), inputs);
        }
        self.step = if next.row.last {
            Step::FollowEnding { taken: 0, last: row }
        } else {
            Step::Following { row: next.number }
        };
        (self.since, self.sent) = (now, 0);
    }

    fn stream_row(&mut self, row: &Row, inputs: &Inputs) -> Result<(), RangeError> {
        let Some(command) = self.stream else { return Ok(()) };
        let scale = self.units.counts_per_unit;
        let position = self.position(row.position, inputs)?;
        let velocity = SignedVelocity(to_i32(row.velocity * scale * 0.1, scale * 0.1, "units/s")?);
        let acceleration =
            SignedAcceleration(to_i32(row.acceleration * scale * 0.01, scale * 0.01, "units/s2")?);
        self.channel.stream(MotionCommand::stream(command, position, velocity, acceleration));
        Ok(())
    }

    fn end_stream(&mut self, now: Time, taken: u32, last: Row, fresh: bool, inputs: &Inputs) {
        if self.sent == 0 {
            return;
        }
        self.sent = 0;
        let echoed = fresh && inputs.clean && inputs.state.count() == self.channel.count;
        let taken = taken + u32::from(echoed);
        let arrived = self.position(last.position, inputs) == Ok(Position(inputs.demand as i32));
        if taken > LAST_ROWS && arrived || taken > MOST_LAST_ROWS {
            return self.command(now, MotionCommand::stream_end(), Step::Moving(None));
        }
        // The last row was in range, so is this one.
        let standing = Row { velocity: 0.0, acceleration: 0.0, ..last };
        if self.stream_row(&standing, inputs).is_ok() {
            self.step = Step::FollowEnding { taken, last };
        }
    }

    /// A ramp. Where the drive takes no motion commands (homing, jogging by bits ...), /Abort stops it.
    fn begin_stop(&mut self, now: Time, deceleration: Option<f64>, inputs: &Inputs) {
        if inputs.seen && inputs.state.main() != MainState::OPERATION_ENABLED {
            return self.begin_abort(now, inputs);
        }
        self.control = Some(self.as_found(inputs));
        let deceleration = deceleration.unwrap_or(self.profile.deceleration);
        match self.acceleration(self.braking(now, deceleration, inputs)) {
            Ok(deceleration) => self.command(
                now,
                MotionCommand::vai_stop(deceleration.max(Acceleration(1))),
                Step::Moving(None),
            ),
            Err(_) => self.begin_abort(now, inputs),
        }
    }

    /// The drive's quick stop that stays controlled: /Abort low, never /Freeze (it would run on) and never OFF3 (it
    /// ends in power off, and the load drops).
    fn begin_abort(&mut self, now: Time, inputs: &Inputs) {
        let state = inputs.state.main();
        if inputs.seen && (state < MainState::OPERATION_ENABLED || state == MainState::BRAKE_DELAY) {
            // A drive that is powering up does not complete it by itself: neither an enable that is stopped
            // half-way, nor a drive that was switched off elsewhere and that the present word switches on again.
            // One that already holds its load goes on holding it, out of operation.
            let holds = state > MainState::HW_TESTS && self.as_found(inputs).has(ControlWord::SWITCH_ON);
            let rising = matches!(self.step, Step::EnableLow | Step::EnableHigh);
            self.control = Some(match rising {
                true => self.rest,
                false if holds => HELD,
                false => ControlWord::BASE,
            });
            return self.finish(Ok(()));
        }
        self.control = Some(ControlWord(self.as_found(inputs).0 & !ControlWord::NO_ABORT));
        self.enter(now, Step::Aborting);
    }

    /// Power off was the last request to the drive. Its reports may be from before that.
    fn told_off(&self) -> bool {
        self.control_sent.is_some_and(|word| !word.has(ControlWord::SWITCH_ON))
    }

    /// The control word that changes nothing of a drive: on if it reports that it is switched on and powered,
    /// otherwise off.
    ///
    /// It never switches on a drive that dropped out, nor one that was switched off, whatever that has reported
    /// since: the report may be from before it received the request. A drive in its own quick stop (state 14) keeps
    /// its power until standstill; the way back into operation leads over a control word with bit 0 low all the
    /// same.
    fn as_found(&self, inputs: &Inputs) -> ControlWord {
        let on =
            inputs.status.has(StatusWord::SWITCH_ON_ACTIVE) && inputs.state.main() >= MainState::HW_TESTS;
        if on && !self.told_off() { ControlWord::ON } else { ControlWord::BASE }
    }
}

/// Whether the demand has arrived there: the drive's generator ends exactly at its target, and a micrometre is left to
/// its rounding.
fn is_near(target: Position, demand: i64) -> bool {
    target.0.wrapping_sub(demand as i32).unsigned_abs() <= 10
}

/// Not zero: with a zero the drive would never arrive.
fn at_least_one(value: f64, rounded: u32, scale: f64, unit: &'static str) -> Result<u32, RangeError> {
    if rounded > 0 {
        return Ok(rounded);
    }
    Err(RangeError { value, unit, low: 1.0 / scale, high: f64::from(u32::MAX) / scale })
}

#[cfg(test)]
mod tests;
