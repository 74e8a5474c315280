//! What an order does to a Unidrive, step by step: the control word and the speed reference.
//!
//! In operation RUN is on, with a direction, and the drive follows the reference, at zero too: it holds its motor
//! there. The reference follows the requested ramp; the drive's own ramps (02.011, 02.021) act below it. RUN is
//! switched on only after the drive has acknowledged the reference that it begins with. Nothing is written before
//! the first order.
//!
//! Sources: SI-PROFIBUS guide, control word 06.042 and status word 10.040.

use super::native::NativePort;
use super::plan::UnidriveDrive;
use super::trips::Trip;
use super::words::{ControlWord, StatusWord};
use crate::axis::command::NativeOwner;
use crate::axis::{Command, Failure, State};
use crate::bus::{Progress, Slot};
use crate::time::{MS, Time, nanos};

/// A drive that was commanded to run, and has acknowledged it, is active within this time, ns, or its hardware
/// enable is missing.
const ACTIVE_WITHIN_NS: u64 = 300 * MS;
/// A drive that runs again after a quick stop stands still for so long, ns, before the stop is done.
const STANDS_NS: u64 = 10 * MS;
/// The longest step of a ramp, in intervals between two requests: a pause is not made up for.
const MOST_STEP: u64 = 4;
/// A trip is watched for so long, ns, after the reset: a drive that trips again at once looks like a failed reset.
const RESET_WITHIN_NS: u64 = 500 * MS;

/// The drive's last report, and the values that it has acknowledged.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Inputs {
    /// There was a status at all.
    pub seen: bool,
    /// The status is new since the last request was built.
    pub fresh: bool,
    pub status: StatusWord,
    /// User units/s.
    pub velocity: f64,
    /// The last trip; 0: not known.
    pub trip: u16,
    /// Its number is known, as far as it will ever be.
    pub named: bool,
    /// It is commanded to run, and its power stage stays off, or has switched off.
    pub dark: bool,
    /// The drive tripped at this instant.
    pub tripped_at: Option<Time>,
    /// The control word that the drive has accepted; `None`: not known.
    pub control: Option<ControlWord>,
    /// Since when.
    pub control_since: Time,
    /// The reference that the drive has accepted.
    pub reference: Option<i32>,
}

/// The values for the drive; `None`: nothing is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Outputs {
    pub control: ControlWord,
    /// Not negative: the direction is in the control word.
    pub reference: i32,
}

/// Why a drive that does not follow the control word cannot be commanded.
const NOT_OBEYING: Failure = Failure::Unsupported(
    "it does not follow the control word: Pr 06.043 has to be 1, 01.014 and 01.015 0; set them, or let the master \
    (set_up)",
);

/// Why a drive that nothing would stop is not enabled.
const NOT_WATCHED: Failure = Failure::Unsupported(
    "its watchdog is not set, nothing would stop it if the master dies: look at Pr S.15.009 and watchdog, or \
    no_drive_watchdog = \"accept\"",
);

/// The orders of one drive.
#[derive(Debug)]
pub(super) struct Orders {
    /// Raw reference for one user unit/s; negative if the axis is inverted.
    raw_per_velocity: f64,
    most_velocity: f64,
    /// The longest time for which a ramp goes on in one request, ns.
    most_step_ns: u64,
    profile_deceleration: f64,
    enable_timeout_ns: u64,
    /// Something stops the drive if the master dies, or nothing needs to.
    watched: bool,
    /// A time-out can be set in it for that.
    watchable: bool,
    /// The drive follows the control word; if not, it may be set so.
    obeys: bool,
    settable: bool,
    /// The control word was sent since the step began.
    told: bool,
    /// The bits of the control word while the drive is to be on.
    on: u16,
    serial: u64,
    /// Nothing of this order was sent yet.
    new: bool,
    step: Step,
    since: Time,
    mode: Mode,
    /// The velocity that the reference stands for, user units/s; the one of the last request that went out, and when.
    /// RUN stays off, since with it the drive turned at a reference of zero.
    halted: bool,
    velocity: f64,
    velocity_sent: f64,
    sent_at: Option<Time>,
    /// The native control word and reference, and whether each went out.
    native: Option<Outputs>,
    native_gone: (bool, bool),
    end: Option<Result<(), Failure>>,
    /// `Slot::progress` reports it.
    progress_told: bool,
    /// Something is written.
    writes: bool,
    /// The last commanded direction; it is kept at zero.
    reverse: bool,
}

/// What the control word allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    Off,
    /// ENABLE without RUN: the drive ramps down by itself.
    Stopping,
    Running,
    /// Off with the reset bit.
    Resetting,
}

/// How the drive comes to standstill.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Way {
    Ramp(f64),
    Quick,
}

/// The step of an order. The tag is a plain byte: it is read several times a cycle.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(u8)]
enum Step {
    Idle,
    /// Off and reference zero, until the drive has accepted both.
    EnableLow,
    /// RUN at zero until the drive is active.
    EnableHigh,
    /// Running on at the speed at which it was found, until the drive follows the control word.
    TakingOver(Way),
    /// RUN is off until the drive stands still.
    DisablingRun,
    /// Off until the drive is not active.
    Disabling,
    /// The reference follows a velocity.
    Turning {
        acceleration: f64,
    },
    /// The reference ramps down to zero, until the drive stands still there.
    Stopping {
        deceleration: f64,
    },
    /// RUN is off until the drive stands still ...
    QuickStopping,
    /// ... and on again at zero ...
    QuickStopped,
    /// ... at which it has to stay.
    StandingStill,
    /// RUN stays off.
    Halted,
    /// A trip that cannot be reset yet.
    ResetWaiting,
    /// Off, so that the reset has an edge.
    ResetLow,
    Resetting,
    ResetDone,
    Native(NativeOwner),
}

impl Orders {
    pub(super) fn new(drive: &UnidriveDrive, interval_ns: u64) -> Orders {
        let axis = &drive.axis;
        Orders {
            raw_per_velocity: drive.map.reference.raw(drive.rpm(1.0)),
            most_velocity: axis.limits.velocity.unwrap_or(f64::INFINITY),
            most_step_ns: interval_ns.saturating_mul(MOST_STEP),
            profile_deceleration: axis.profile.deceleration,
            enable_timeout_ns: nanos(axis.enable_timeout),
            watched: false,
            watchable: drive.watchdog.timeout_ns.is_some(),
            obeys: false,
            settable: false,
            told: false,
            on: ControlWord::ENABLE | if drive.watchdog.keypad { ControlWord::KEYPAD_WATCHDOG } else { 0 },
            serial: 0,
            new: false,
            step: Step::Idle,
            since: Time(0),
            mode: Mode::Off,
            halted: false,
            velocity: 0.0,
            velocity_sent: 0.0,
            sent_at: None,
            native: None,
            native_gone: (true, true),
            end: None,
            progress_told: true,
            writes: false,
            reverse: false,
        }
    }

    /// The reference went out with the request of this slot of the grid.
    pub(super) fn reference_sent(&mut self, grid: Time) {
        self.velocity_sent = self.velocity;
        self.sent_at = Some(grid);
        self.native_gone.1 = true;
    }

    /// Works on the order in `slot`, and returns the values for the request of `grid`.
    pub(super) fn advance(
        &mut self,
        grid: Time,
        inputs: &Inputs,
        slot: &mut Slot,
        native: &mut NativePort,
    ) -> Option<Outputs> {
        if slot.order.serial != self.serial {
            self.serial = slot.order.serial;
            (self.end, self.progress_told) = (None, false);
            self.withdraw();
            self.new = true;
            if self.is_native() {
                // The state that the application left the drive in is the present state.
                self.claim(inputs);
            }
            (self.native, self.native_gone) = (None, (true, true));
            native.flush();
            self.begin(grid, inputs, slot);
        } else if self.end.is_none() {
            self.go_on(grid, inputs, slot);
        }
        if !self.progress_told {
            (slot.progress, self.progress_told) = (Progress { serial: self.serial, end: self.end }, true);
        }
        self.lead(grid, slot);
        if let Step::Native(owner) = self.step {
            self.take_native(owner, native);
        }
        self.writes.then(|| self.native.unwrap_or_else(|| self.outputs()))
    }

    /// Native mode runs.
    pub(super) fn is_native(&self) -> bool {
        matches!(self.step, Step::Native(_))
    }

    /// Whether something stops the drive if the master dies, whether it follows the control word, and whether it
    /// can be configured to.
    pub(super) fn found(&mut self, watched: bool, obeys: bool, settable: bool) {
        (self.watched, self.obeys, self.settable) = (watched, obeys, settable);
        if !settable && matches!(self.step, Step::EnableLow | Step::TakingOver(_)) {
            match (obeys, watched) {
                (false, _) => self.finish(Err(NOT_OBEYING)),
                (true, false) if self.step == Step::EnableLow => self.finish(Err(NOT_WATCHED)),
                (true, _) => {}
            }
        }
    }

    /// The drive has to be configured to follow the control word, or to be watched: once it has accepted the
    /// present values.
    pub(super) fn wants_set_up(&self, inputs: &Inputs) -> bool {
        let enabling = self.step == Step::EnableLow && !(self.obeys && self.watched);
        let obeying = match self.step {
            Step::TakingOver(_) => !self.obeys,
            Step::Disabling => !self.obeys && inputs.status.active(),
            _ => false,
        };
        self.settable && (enabling || obeying) && self.has_taken(inputs)
    }

    /// Something is written, since the first order.
    pub(super) fn writes(&self) -> bool {
        self.writes
    }

    /// Written values are waited for, to be read back.
    pub(super) fn waits(&self) -> bool {
        !matches!(self.step, Step::Idle | Step::Turning { .. } | Step::Native(_))
    }

    /// The next request has to carry this order: nothing of it was sent yet.
    pub(super) fn is_new(&self) -> bool {
        self.new && self.writes
    }

    /// Something was written.
    pub(super) fn sent(&mut self) {
        self.new = false;
    }

    /// The drive refused the request as a whole: what it wrote has to go out again.
    pub(super) fn refused(&mut self, control: bool, reference: bool) {
        self.new = true;
        self.told &= !control;
        if self.native.is_some() {
            self.native_gone.0 &= !control;
            self.native_gone.1 &= !reference;
        }
    }

    /// The control word went out.
    pub(super) fn control_sent(&mut self) {
        self.told = true;
        self.native_gone.0 = true;
    }

    /// The drive is commanded to be on.
    pub(super) fn is_on(&self) -> bool {
        matches!(self.mode, Mode::Running | Mode::Stopping)
    }

    /// RUN is on.
    pub(super) fn runs(&self) -> bool {
        self.mode == Mode::Running
    }

    /// Maps the drive's state onto those of CiA 402.
    pub(super) fn state(&self, status: StatusWord, inhibited: bool) -> State {
        match (status.healthy(), status.active(), self.mode) {
            (false, ..) => State::Fault,
            // It follows no setpoint.
            (true, true, Mode::Stopping) if self.step == Step::QuickStopping || self.halted => {
                State::QuickStopActive
            }
            (true, true, _) => State::OperationEnabled,
            (true, false, _) if inhibited => State::SwitchOnDisabled,
            // Its power stage comes and goes with RUN.
            (true, false, _) if matches!(self.step, Step::QuickStopping | Step::QuickStopped) => {
                State::QuickStopActive
            }
            (true, false, Mode::Running | Mode::Stopping) => State::SwitchedOn,
            (true, false, Mode::Off | Mode::Resetting) => State::ReadyToSwitchOn,
        }
    }

    /// The drive was commanded to run and has accepted it, for as long as it needs.
    pub(super) fn should_be_active(&self, now: Time, inputs: &Inputs) -> bool {
        self.mode == Mode::Running
            && inputs
                .control
                .is_some_and(|word| word.has_any(ControlWord::RUN_FORWARD | ControlWord::RUN_REVERSE))
            && now.since(inputs.control_since) > ACTIVE_WITHIN_NS
    }

    /// The drive has lost its commands: no earlier value is written again.
    pub(super) fn drive_restarted(&mut self) {
        (self.native, self.native_gone) = (None, (true, true));
        self.velocity = 0.0;
        self.velocity_sent = 0.0;
        self.mode = Mode::Off;
        if self.is_native() {
            self.step = Step::Idle;
        } else if self.end.is_none() && !matches!(self.step, Step::Idle | Step::Disabling) {
            self.finish(Err(Failure::Dropped(State::SwitchOnDisabled)));
        }
    }

    /// The drive did not accept a written value, as its read-back shows.
    pub(super) fn not_taken(&mut self, now: Time) {
        match self.step {
            // It has no commander any more.
            Step::Turning { .. } => self.refuse(now, Failure::NotTaken),
            Step::EnableLow | Step::EnableHigh => self.give_up(Failure::NotTaken),
            _ => {}
        }
    }

    fn outputs(&self) -> Outputs {
        let raw = self.velocity * self.raw_per_velocity;
        let run = if self.reverse { ControlWord::RUN_REVERSE } else { ControlWord::RUN_FORWARD };
        let control = ControlWord::IDLE
            .with(if self.is_on() { self.on } else { 0 })
            .with(if self.runs() { run } else { 0 })
            .with(if self.mode == Mode::Resetting { ControlWord::RESET } else { 0 });
        // Rounded by hand: without SSE4.1 `round` is a call. A plan whose velocities do not fit is refused; the rest
        // saturates.
        Outputs { control, reference: (raw.abs() + 0.5) as i32 }
    }

    /// Moves the velocity towards its target by the time since the last request.
    fn lead(&mut self, grid: Time, slot: &Slot) {
        let (target, rate, most_ns) = match self.step {
            Step::Turning { acceleration } => {
                let target = slot.velocity.clamp(-self.most_velocity, self.most_velocity);
                (target, acceleration, self.most_step_ns)
            }
            // Nothing delays a stop: on a lost link requests are far apart.
            Step::Stopping { deceleration } => (0.0, deceleration, u64::MAX),
            _ => return,
        };
        if self.velocity == target && self.velocity_sent == target {
            return;
        }
        let waited = self.sent_at.map_or(0, |sent_at| grid.since(sent_at)).min(most_ns);
        // Signed, since that is one instruction; the longest wait is far below the sign.
        let step = rate * (waited as i64 as f64 * 1e-9);
        let way = target - self.velocity_sent;
        self.velocity = if way.abs() <= step { target } else { on_the_way(self.velocity_sent, way, step) };
        if self.velocity * self.velocity_sent < 0.0 {
            // Direction and speed may go out one after the other: it changes at zero.
            self.velocity = 0.0;
        }
        if self.velocity != 0.0 {
            self.reverse = self.velocity * self.raw_per_velocity < 0.0;
        }
    }

    #[inline(never)]
    fn take_native(&mut self, owner: NativeOwner, native: &mut NativePort) {
        // Each one is sent, even if a request fails.
        if self.native_gone != (true, true) {
            return;
        }
        if let Some(output) = native.next() {
            let own = self.outputs();
            self.native = Some(match owner {
                NativeOwner::Application => output,
                // The master keeps the drive running, in its own direction.
                NativeOwner::Master => Outputs { control: own.control, ..output },
            });
            self.native_gone = (false, false);
        }
    }

    /// Removes an order that was never sent.
    fn withdraw(&mut self) {
        if self.new && matches!(self.step, Step::Turning { .. }) {
            self.step = Step::Idle;
            self.velocity = self.velocity_sent;
        }
    }

    fn enter(&mut self, now: Time, step: Step) {
        (self.step, self.since, self.told) = (step, now, false);
    }

    fn finish(&mut self, end: Result<(), Failure>) {
        (self.end, self.progress_told) = (Some(end), false);
        if end.is_err() || !matches!(self.step, Step::Turning { .. }) {
            self.step = Step::Idle;
        }
    }

    fn set(&mut self, mode: Mode) {
        self.writes = true;
        (self.mode, self.halted) = (mode, false);
        if matches!(mode, Mode::Off | Mode::Resetting) {
            (self.velocity, self.velocity_sent) = (0.0, 0.0);
        }
    }

    /// Takes the drive over as it is: running on at its present speed, without RUN, or off.
    fn claim(&mut self, inputs: &Inputs) {
        let runs = !self.obeys || inputs.control.is_none_or(|word| word.has_any(ControlWord::ANY_RUN));
        if inputs.status.active() && !runs {
            self.set(Mode::Stopping);
            self.halted = true;
        } else if inputs.status.active() {
            self.set(Mode::Running);
            (self.velocity, self.velocity_sent) = (inputs.velocity, inputs.velocity);
            self.reverse = inputs.velocity * self.raw_per_velocity < 0.0;
        } else {
            self.set(Mode::Off);
        }
    }

    #[cold]
    fn begin(&mut self, now: Time, inputs: &Inputs, slot: &Slot) {
        let status = inputs.status;
        let tripped = inputs.seen && !status.healthy();
        let running = status.active() && self.mode == Mode::Running;
        if !self.writes {
            self.claim(inputs);
        }
        match slot.order.verb {
            None | Some(Command::Reset) => self.finish(Ok(())),
            Some(Command::Enable) if tripped => self.finish(Err(Failure::DriveFault(inputs.trip.into()))),
            Some(Command::Enable) if !self.obeys && !self.settable => self.finish(Err(NOT_OBEYING)),
            Some(Command::Enable) if !(self.watched || self.settable && self.watchable) => {
                self.finish(Err(NOT_WATCHED));
            }
            Some(Command::Enable)
                if status.active() && self.mode == Mode::Running && self.obeys && self.watched =>
            {
                // A report of before may be old.
                self.enter(now, Step::EnableHigh);
            }
            Some(Command::Enable) => {
                self.set(Mode::Off);
                self.enter(now, Step::EnableLow);
            }
            // By its terminals, or by another source that takes precedence over the control word.
            Some(Command::Disable | Command::Stop { .. } | Command::QuickStop)
                if status.active() && !self.obeys && !self.settable =>
            {
                self.finish(Err(NOT_OBEYING));
            }
            Some(Command::Stop { deceleration }) if status.active() && !self.obeys => {
                self.claim(inputs);
                self.enter(
                    now,
                    Step::TakingOver(Way::Ramp(deceleration.unwrap_or(self.profile_deceleration))),
                );
            }
            Some(Command::QuickStop) if status.active() && !self.obeys => {
                self.claim(inputs);
                self.enter(now, Step::TakingOver(Way::Quick));
            }
            Some(Command::Disable) if status.zero_speed() && self.is_on() => {
                self.set(Mode::Stopping);
                self.enter(now, Step::DisablingRun);
            }
            Some(Command::Disable) => {
                self.set(Mode::Off);
                self.enter(now, Step::Disabling);
            }
            Some(Command::Home | Command::Move(_) | Command::Follow) => {
                self.refuse(
                    now,
                    Failure::Unsupported("it takes speeds, not positions: jog, or give it velocities"),
                );
            }
            Some(Command::Torque { .. }) => {
                self.refuse(
                    now,
                    Failure::Unsupported("it takes speeds, not torques: jog, or give it velocities"),
                );
            }
            Some(Command::Jog(jog)) => self.turn(now, jog.acceleration, running, slot),
            Some(Command::Velocity { acceleration }) => self.turn(now, acceleration, running, slot),
            Some(Command::Stop { .. } | Command::QuickStop) if !self.is_on() => {
                // It may go on reporting that it is active for as long as its replies are lost.
                self.set(Mode::Off);
                self.enter(now, Step::Disabling);
            }
            Some(Command::Stop { .. } | Command::QuickStop) if !status.active() => {
                // Powering up: it does not continue by itself.
                self.set(Mode::Off);
                self.enter(now, Step::Disabling);
            }
            // Only without RUN does it stand.
            Some(Command::Stop { .. } | Command::QuickStop) if self.halted => self.enter(now, Step::Halted),
            // A stop that is under way is not made softer.
            Some(Command::Stop { .. })
                if matches!(self.step, Step::QuickStopping | Step::QuickStopped | Step::StandingStill) =>
            {
                self.quick_stop(now);
            }
            Some(Command::Stop { deceleration }) => {
                self.brake(now, deceleration.unwrap_or(self.profile_deceleration));
            }
            Some(Command::QuickStop) => self.quick_stop(now),
            Some(Command::ResetFault) if !tripped => self.finish(Ok(())),
            Some(Command::ResetFault) => {
                self.set(Mode::Off);
                self.enter(now, Step::ResetWaiting);
            }
            Some(Command::Native(owner)) => self.enter(now, Step::Native(owner)),
        }
    }

    fn turn(&mut self, now: Time, acceleration: f64, running: bool, slot: &Slot) {
        if running {
            self.enter(now, Step::Turning { acceleration });
        } else {
            self.finish(Err(Failure::WrongState(slot.status.state)));
        }
    }

    /// Ends an order that cannot be carried out, and stops a running drive: it has no commander any more.
    fn refuse(&mut self, now: Time, failure: Failure) {
        self.finish(Err(failure));
        if self.mode == Mode::Running && self.velocity != 0.0 {
            self.brake(now, self.profile_deceleration);
        }
    }

    fn brake(&mut self, now: Time, deceleration: f64) {
        // It stands still with power on, whatever was under way.
        self.set(Mode::Running);
        self.enter(now, Step::Stopping { deceleration });
    }

    fn quick_stop(&mut self, now: Time) {
        self.set(Mode::Stopping);
        (self.velocity, self.velocity_sent) = (0.0, 0.0);
        self.enter(now, Step::QuickStopping);
    }

    fn go_on(&mut self, now: Time, inputs: &Inputs, slot: &mut Slot) {
        let status = inputs.status;
        let tripped = inputs.fresh && !status.healthy() && inputs.named;
        let timed_out = now.since(self.since) > self.enable_timeout_ns;
        let state = slot.status.state;
        match self.step {
            Step::Idle | Step::Native(_) => {}
            Step::EnableLow | Step::EnableHigh if tripped => {
                self.give_up(Failure::DriveFault(inputs.trip.into()))
            }
            Step::EnableLow if self.answered(inputs) && self.obeys && self.watched => {
                self.set(Mode::Running);
                let begun = self.since;
                self.enter(now, Step::EnableHigh);
                self.since = begun;
            }
            Step::EnableHigh if self.told && self.answered(inputs) && status.active() => self.finish(Ok(())),
            Step::EnableHigh if self.answered(inputs) && inputs.dark => self.give_up(Failure::Inhibited),
            Step::EnableLow | Step::EnableHigh if timed_out => self.give_up(Failure::TimedOut(state)),
            Step::EnableLow | Step::EnableHigh => {}

            Step::TakingOver(_) if tripped || inputs.fresh && !status.active() => {
                self.set(Mode::Off);
                self.enter(now, Step::Disabling);
            }
            Step::TakingOver(Way::Ramp(deceleration)) if self.obeys => self.brake(now, deceleration),
            Step::TakingOver(Way::Quick) if self.obeys => self.quick_stop(now),
            Step::TakingOver(_) => {}

            Step::DisablingRun if self.told => {
                self.set(Mode::Off);
                self.enter(now, Step::Disabling);
            }
            Step::DisablingRun => {}
            Step::Disabling if self.answered(inputs) && !status.active() => self.finish(Ok(())),
            Step::Disabling if timed_out => self.finish(Err(Failure::TimedOut(state))),
            Step::Disabling => {}

            Step::Turning { .. }
            | Step::Stopping { .. }
            | Step::QuickStopping
            | Step::QuickStopped
            | Step::StandingStill
                if tripped =>
            {
                self.give_up(Failure::DriveFault(inputs.trip.into()));
            }
            Step::Turning { .. } | Step::Stopping { .. } | Step::StandingStill
                if inputs.fresh && status.healthy() && !status.active() =>
            {
                self.give_up(Failure::Dropped(state));
            }
            Step::Turning { .. } => {}
            Step::Stopping { .. } if self.answered(inputs) && self.velocity == 0.0 && status.zero_speed() => {
                self.finish(Ok(()))
            }
            Step::Stopping { .. } => {}
            Step::QuickStopping if self.answered(inputs) && status.zero_speed() => {
                self.set(Mode::Running);
                self.enter(now, Step::QuickStopped);
            }
            Step::QuickStopping => {}
            Step::QuickStopped if self.answered(inputs) && status.active() => {
                self.enter(now, Step::StandingStill);
            }
            Step::QuickStopped if self.answered(inputs) && inputs.dark => self.give_up(Failure::Inhibited),
            Step::QuickStopped => {}
            // A reference of its own turns it again: it stands only without RUN.
            Step::StandingStill if self.answered(inputs) && !status.zero_speed() => {
                self.set(Mode::Stopping);
                self.halted = true;
                self.finish(Err(Failure::StillMoves));
            }
            Step::Halted if self.answered(inputs) && (status.zero_speed() || !status.active()) => {
                self.finish(Ok(()));
            }
            Step::Halted => {}
            Step::StandingStill if self.answered(inputs) && now.since(self.since) >= STANDS_NS => {
                self.finish(Ok(()));
            }
            Step::StandingStill => {}

            Step::ResetWaiting => {
                let wait_ns = Trip(inputs.trip).reset_after_ns();
                if inputs.tripped_at.is_none_or(|at| now.since(at) >= wait_ns) {
                    self.enter(now, Step::ResetLow);
                }
            }
            Step::ResetLow if self.answered(inputs) => {
                self.set(Mode::Resetting);
                self.enter(now, Step::Resetting);
            }
            Step::Resetting if self.answered(inputs) && status.healthy() => {
                self.set(Mode::Off);
                self.enter(now, Step::ResetDone);
            }
            Step::Resetting if self.answered(inputs) && now.since(self.since) > RESET_WITHIN_NS => {
                self.give_up(Failure::DriveFault(inputs.trip.into()));
            }
            Step::ResetDone if tripped && now.since(self.since) > 0 => {
                self.give_up(Failure::DriveFault(inputs.trip.into()))
            }
            Step::ResetDone if self.answered(inputs) && !status.active() => self.finish(Ok(())),
            Step::ResetLow | Step::Resetting | Step::ResetDone if timed_out => {
                self.give_up(Failure::TimedOut(state))
            }
            Step::ResetLow | Step::Resetting | Step::ResetDone => {}
        }
    }

    /// The drive has a new report, and has accepted the written values.
    fn answered(&self, inputs: &Inputs) -> bool {
        inputs.fresh && self.has_taken(inputs)
    }

    /// The drive has accepted the written values.
    fn has_taken(&self, inputs: &Inputs) -> bool {
        let outputs = self.outputs();
        inputs.control == Some(outputs.control) && inputs.reference == Some(outputs.reference)
    }

    /// Ends the order as failed, with the drive off.
    fn give_up(&mut self, failure: Failure) {
        self.set(Mode::Off);
        self.finish(Err(failure));
    }
}

/// A step on the way from a velocity. Kept out of line: inlined it becomes a conditional move, and when no step
/// remains the rest of the cycle would wait for this one.
#[inline(never)]
fn on_the_way(from: f64, way: f64, step: f64) -> f64 {
    from + step.copysign(way)
}
