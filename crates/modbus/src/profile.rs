//! What is desired of a Unidrive as control word and speed reference, and what it reports as accepted.
//!
//! In operation RUN is on, with a direction, and the drive follows the reference, at zero too: it holds its motor
//! there. The drive's own ramps (02.011, 02.021) act below it. Nothing is written before something is desired.
//!
//! Sources: SI-PROFIBUS guide, control word 06.042 and status word 10.040.

use std::num::NonZeroU64;

use super::echo::Echo;
use super::native::{NativeOutput, NativePort};
use super::plan::UnidriveDrive;
use super::trips::Trip;
use super::words::{ControlWord, StatusWord};
use fieldbeat_core::axis::Lacks;
use fieldbeat_core::axis::State as State402;
use fieldbeat_core::axis::command::NativeOwner;
use fieldbeat_core::bus::Prepared;
use fieldbeat_core::bus::desired::{
    Capabilities, Desired, Evidence, FaultIs, Follows, Generator, Motion, Power, Quantity, Refused,
    Resettable,
};
use fieldbeat_core::time::{MS, Time};

/// A drive that was commanded to run, and has acknowledged it, is active within this time, ns, or its hardware
/// enable is missing.
const ACTIVE_WITHIN_NS: u64 = 300 * MS;
/// A drive that runs again after a halt stands still for so long, ns, before the stop is done.
const STANDS_NS: u64 = 10 * MS;

const NO_POSITION: &str = "it takes speeds, not positions: jog, or give it velocities";
const NO_TORQUE: &str = "it takes speeds, not torques: jog, or give it velocities";
/// Why a drive that does not follow the control word cannot be commanded.
const NOT_OBEYING: &str = "it does not follow the control word: Pr 06.043 has to be 1, 01.014 and 01.015 0; \
     set them, or let the master (set_up)";
/// Why a drive that nothing would stop is not enabled.
const NOT_WATCHED: &str = "its watchdog is not set, nothing would stop it if the master dies: look at Pr \
     S.15.009 and watchdog, or no_drive_watchdog = \"accept\"";

/// The drive's last report, and the values that it has acknowledged.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Inputs {
    /// The echo of the written control word, and of the reference.
    pub control: Echo,
    pub reference: Echo,
    pub status: StatusWord,
    /// The last trip; 0: not known.
    pub trip: u16,
    /// There was a status at all.
    pub seen: bool,
    /// The number is known, as far as it will ever be.
    pub named: bool,
    /// It is commanded to run, and its power stage stays off, or has switched off.
    pub dark: bool,
}

impl Inputs {
    /// The control word that the drive has accepted; `None`: not known.
    #[inline]
    pub(super) fn control(&self) -> Option<ControlWord> {
        self.control.taken().map(|count| ControlWord(count as u16))
    }

    /// The drive has accepted these values.
    #[inline]
    pub(super) fn have(&self, outputs: Outputs) -> bool {
        self.have_control(outputs) && self.reference.has_taken(outputs.reference)
    }

    /// The drive has accepted this control word.
    #[inline]
    pub(super) fn have_control(&self, outputs: Outputs) -> bool {
        self.control.has_taken(outputs.control.0.into())
    }

    /// It has accepted the command to run.
    pub(super) fn runs(&self) -> bool {
        self.control().is_some_and(|word| word.has_any(ControlWord::ANY_RUN))
    }
}

/// The values for the drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Outputs {
    pub control: ControlWord,
    /// Not negative: the direction is in the control word.
    pub reference: i32,
}

/// The source of commands of a drive in operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    /// The setpoints of the master.
    Setpoints,
    /// Nothing: it is halted.
    Halt,
    /// The native process data of the application.
    Native(NativeOwner),
}

impl From<Motion> for Source {
    fn from(motion: Motion) -> Source {
        match motion {
            Motion::Halt => Source::Halt,
            Motion::Native(owner) => Source::Native(owner),
            _ => Source::Setpoints,
        }
    }
}

/// The state after the requests that left.
#[derive(Clone, Copy, Debug, PartialEq)]
struct State {
    /// The intents of which something was written: power, motion.
    serials: (u64, u64),
    power: Power,
    source: Source,
    /// The request with them was refused: they have to go out again.
    is_refused: bool,
    /// The last commanded direction; it is kept at zero.
    reverse: bool,
    /// The direction of the reference that was sent last, unless that is zero.
    turning: Option<bool>,
    /// RUN goes off before ENABLE does.
    releasing: bool,
    /// RUN was off for a halt, and the power stage has not come back since.
    halted: bool,
    /// It has not taken a written value.
    not_taken: bool,
    /// The control word that was written last has RUN.
    ran: bool,
    /// The native values, whether each went out, and how many of them were taken.
    native: Option<Outputs>,
    native_gone: (bool, bool),
    native_taken: u8,
}

impl State {
    /// The drive is commanded to be on.
    fn is_on(&self) -> bool {
        matches!(self.power, Power::EnableOperation | Power::QuickStop)
    }

    fn is_halted(&self) -> bool {
        self.power == Power::QuickStop || self.source == Source::Halt
    }

    /// RUN is on.
    fn runs(&self) -> bool {
        self.power == Power::EnableOperation && !self.is_halted()
    }

    fn is_native(&self) -> bool {
        matches!(self.source, Source::Native(_))
    }

    /// It runs by the setpoints of the master.
    fn follows(&self) -> bool {
        self.power == Power::EnableOperation && self.source == Source::Setpoints
    }
}

/// A revision of the state, counted from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Proved(NonZeroU64);

/// Whether the drive follows the control word, and something stops it if the master dies, or nothing needs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SetUp {
    /// Both.
    Done,
    /// Not yet: the settings that are missing can be written.
    Due { obeys: bool },
    /// One of them, or none, and nothing can be written.
    Lacking { obeys: bool },
}

/// The profile of one drive. What each exchange touches comes last, with the revisions at the end of `state`.
#[derive(Debug)]
#[repr(C)]
pub(super) struct Profile {
    /// The intents of the last request that had left when the newest status was read: a speed may come later.
    at_status: (u64, u64),
    state: Prepared<State>,
    /// Raw reference for one user unit/s; negative if the axis is inverted.
    raw_per_velocity: f64,
    /// The values of the prepared request.
    outputs: Outputs,
    /// The direction that a drive which goes on following setpoints turns in, as the request was built last; `None`: it
    /// follows none.
    goes_on: Option<Option<bool>>,
    /// It has accepted all that has left.
    taken: bool,
    /// Something stops the drive if the master dies once it is set up, or nothing needs to.
    watchable: bool,
    set_up: SetUp,
    /// The bits of the control word while the drive is to be on.
    on: u16,
}

/// The capabilities of a drive.
pub(super) fn capabilities(_drive: &UnidriveDrive) -> Capabilities {
    Capabilities {
        lacks: Lacks {
            moves: Some(NO_POSITION),
            rows: Some(NO_POSITION),
            homing: Some(NO_POSITION),
            torques: Some(NO_TORQUE),
            ..Lacks::default()
        },
        // Replies come in their order on one connection, each with the transaction id of its request.
        power_reports: 1,
        stands_ns: STANDS_NS,
        ..Capabilities::of(Generator::Master(Quantity::Velocity))
    }
}

impl Profile {
    pub(super) fn new(drive: &UnidriveDrive) -> Profile {
        let state = State {
            serials: (0, 0),
            power: Power::Untouched,
            source: Source::Setpoints,
            is_refused: false,
            reverse: false,
            turning: None,
            releasing: false,
            halted: false,
            not_taken: false,
            ran: false,
            native: None,
            native_gone: (true, true),
            native_taken: 0,
        };
        Profile {
            raw_per_velocity: drive.map.reference.raw(drive.rpm(1.0)),
            on: ControlWord::ENABLE | if drive.watchdog.keypad { ControlWord::KEYPAD_WATCHDOG } else { 0 },
            set_up: SetUp::Lacking { obeys: false },
            watchable: drive.watchdog.within_ns().is_some() || drive.watchdog.accept_none,
            state: Prepared::new(state),
            outputs: Outputs::default(),
            goes_on: None,
            at_status: (0, 0),
            taken: false,
        }
    }

    /// The [values](Self::outputs) of the next request; false: nothing is written.
    #[inline]
    pub(super) fn encode(&mut self, desired: &Desired, inputs: &Inputs, native: &mut NativePort) -> bool {
        if desired.power.value == Power::Untouched {
            return false;
        }
        let raw = desired.setpoint.velocity * self.raw_per_velocity;
        // Of a drive that goes on turning in its direction, or standing, only the speed is new.
        if self.state.holds(desired.revision()) && self.goes_on == Some(turning(raw)) {
            self.outputs.reference = rounded(raw.abs());
        } else {
            self.build(desired, raw, inputs, native);
        }
        true
    }

    /// Builds the values of a request that differs from the last one by more than its speed.
    #[inline(never)]
    fn build(&mut self, desired: &Desired, raw: f64, inputs: &Inputs, native: &mut NativePort) {
        let Desired { power, motion, .. } = desired;
        let state = self.state.propose(desired.revision());
        let begins = motion.serial != state.serials.1;
        if begins {
            (state.native, state.native_gone) = (None, (true, true));
        }
        state.not_taken &= (power.serial, motion.serial) == state.serials;
        state.serials = (power.serial, motion.serial);
        (state.power, state.source, state.is_refused) = (power.value, motion.value.into(), false);
        // A drive at standstill holds its motor until RUN is off, and drops it with ENABLE.
        state.releasing = state.power == Power::Off
            && inputs.status.active()
            && (state.releasing || inputs.status.zero_speed() && state.ran);
        state.halted |= state.is_halted();
        self.outputs = state.built(raw, self.on);
        // What the application has written before the mode begins is dropped.
        if let Source::Native(owner) = state.source {
            if !begins {
                state.take_native(owner, self.outputs.control, native);
            }
            self.outputs = state.native.unwrap_or(self.outputs);
        }
        // A request that changes the direction does not hold once it has left.
        self.goes_on = state.follows().then_some(state.turning);
    }

    /// The values of the request that was built last.
    #[inline]
    pub(super) fn outputs(&self) -> Outputs {
        self.outputs
    }

    /// A reply has changed what the next request was built from.
    #[inline]
    pub(super) fn is_void(&self) -> bool {
        self.state.is_void()
    }

    /// The request that is built writes the control word, the reference: their leaving is an effect.
    #[inline]
    pub(super) fn carries(&mut self, control: bool, reference: bool) {
        let outputs = self.outputs;
        self.state.amend(|state| {
            if control {
                (state.native_gone.0, state.releasing) = (true, false);
                state.ran = outputs.control.has_any(ControlWord::ANY_RUN);
            }
            if reference {
                state.native_gone.1 = true;
                state.turning = (outputs.reference != 0).then_some(state.reverse);
            }
        });
    }

    /// It has nothing of what is desired.
    pub(super) fn carries_nothing(&mut self) {
        self.state.withdraw();
    }

    /// The request that was built has gone out.
    #[inline]
    pub(super) fn sent(&mut self, native: &mut NativePort) {
        if self.state.is_proposed() {
            self.sent_new(native);
        }
    }

    #[inline(never)]
    fn sent_new(&mut self, native: &mut NativePort) {
        if let Some((before, state)) = self.state.leave() {
            // It has to be accepted again.
            self.taken &= state.serials == before.serials;
            let begins = state.serials.1 != before.serials.1;
            native.left(state.native_taken != before.native_taken, begins.then(|| state.is_native()));
        }
    }

    /// Native mode runs.
    pub(super) fn is_native(&self) -> bool {
        self.state.left().is_native()
    }

    /// Whether something stops the drive if the master dies, whether it follows the control word, and whether it
    /// can be configured to.
    pub(super) fn found(&mut self, watched: bool, obeys: bool, settable: bool) {
        self.set_up = match settable {
            _ if watched && obeys => SetUp::Done,
            true => SetUp::Due { obeys },
            false => SetUp::Lacking { obeys },
        };
    }

    /// The drive has to be configured to follow the control word, or to be watched: once it has accepted the
    /// present values.
    pub(super) fn wants_set_up(&self, inputs: &Inputs) -> bool {
        let SetUp::Due { obeys } = self.set_up else { return false };
        let is_wanted = match self.state.proposed().power {
            Power::Untouched => false,
            Power::Shutdown => true,
            _ => !obeys && inputs.status.active(),
        };
        is_wanted && inputs.have(self.outputs)
    }

    /// Something was written to it.
    pub(super) fn writes(&self) -> bool {
        self.state.left().serials.0 > 0
    }

    /// Written values are waited for, to be read back, if the drive is to stand.
    pub(super) fn waits(&self, stands: bool) -> bool {
        stands && !self.state.proposed().is_native() && (self.is_new() || !self.taken)
    }

    /// The next request has to carry this: nothing of it was sent yet.
    #[inline]
    pub(super) fn is_new(&self) -> bool {
        self.state.left().is_refused || self.is_ahead()
    }

    /// Something of what is desired was built, and nothing of it was sent yet.
    #[inline]
    fn is_ahead(&self) -> bool {
        self.state.is_proposed() && self.state.proposed().serials != self.state.left().serials
    }

    /// The drive refused the request as a whole: what it wrote has to go out again.
    pub(super) fn refused(&mut self, control: bool, reference: bool) {
        self.state.change(|state| {
            state.is_refused = true;
            if state.native.is_some() {
                state.native_gone.0 &= !control;
                state.native_gone.1 &= !reference;
            }
        });
    }

    /// The drive is commanded to be on, or is to be.
    pub(super) fn is_on(&self) -> bool {
        self.state.proposed().is_on()
    }

    /// As long as this is the revision of its state, a report proves the same as the last one, if the drive has
    /// accepted all that was written, and has the same status. `None`: the last one did not prove it.
    #[inline]
    pub(super) fn proved(&self) -> Option<Proved> {
        if self.taken && !self.is_native() { self.revision() } else { None }
    }

    #[inline]
    fn revision(&self) -> Option<Proved> {
        NonZeroU64::new(self.state.revision() + 1).map(Proved)
    }

    /// A report proves the same as the one that has proved this revision, which no refused request has.
    #[inline]
    pub(super) fn proves_again(&self, proved: Option<Proved>, inputs: &Inputs) -> bool {
        self.is_revision(proved) && !self.is_ahead() && inputs.have(self.outputs)
    }

    /// This is the revision of its state.
    #[inline]
    pub(super) fn is_revision(&self, proved: Option<Proved>) -> bool {
        proved == self.revision()
    }

    /// RUN was written.
    pub(super) fn runs(&self) -> bool {
        self.state.left().runs()
    }

    /// Maps the drive's state onto those of CiA 402.
    #[inline]
    pub(super) fn state(&mut self, status: StatusWord, sto_open: bool) -> State402 {
        if status.active() && self.runs() && self.state.left().halted {
            self.state.change(|state| state.halted = false);
        }
        let state = self.state.left();
        match (status.healthy(), status.active()) {
            (false, _) => State402::Fault,
            // It follows no setpoint.
            (true, true) if state.is_on() && state.is_halted() => State402::QuickStopActive,
            (true, true) => State402::OperationEnabled,
            (true, false) if sto_open => State402::SwitchOnDisabled,
            // Its power stage comes and goes with RUN.
            (true, false) if state.is_on() && state.halted => State402::QuickStopActive,
            (true, false) if state.is_on() => State402::SwitchedOn,
            (true, false) => State402::ReadyToSwitchOn,
        }
    }

    /// The drive was commanded to run, and has had the control word that it has accepted since `control_since`: for as
    /// long as it needs.
    pub(super) fn should_be_active(&self, now: Time, inputs: &Inputs, control_since: Time) -> bool {
        self.runs() && inputs.runs() && now.since(control_since) > ACTIVE_WITHIN_NS
    }

    /// The drive has lost its commands: no earlier value is written again.
    pub(super) fn drive_restarted(&mut self) {
        self.state.change(|state| {
            (state.native, state.native_gone, state.turning) = (None, (true, true), None);
            (state.halted, state.releasing) = (false, false);
        });
    }

    /// A status was read in an exchange that was sent after what was sent last.
    pub(super) fn status_read(&mut self) {
        self.at_status = self.state.left().serials;
    }

    /// The drive did not accept a written value, as its read-back shows.
    pub(super) fn not_taken(&mut self) {
        self.state.change(|state| state.not_taken = true);
    }

    /// Takes the evidence of a report of a drive that has tripped at `tripped_at`.
    pub(super) fn prove(&mut self, inputs: &Inputs, tripped_at: Option<Time>, evidence: &mut Evidence) {
        let State { serials: (power, motion), is_refused, not_taken, .. } = *self.state.left();
        let taken = !self.is_new() && self.at_status == (power, motion) && inputs.have(self.outputs);
        self.taken = taken;
        let since = |serial: u64| match (taken, is_refused) {
            (true, _) => serial,
            (false, true) => 0,
            (false, false) => serial.saturating_sub(1),
        };
        (evidence.accepted.power, evidence.accepted.motion) = (since(power), since(motion));
        evidence.is_set_up = self.set_up == SetUp::Done;
        let unwatched = (!self.watchable).then_some(NOT_WATCHED);
        (evidence.follows, evidence.obstacle) = match self.set_up {
            SetUp::Done => (Follows::Yes, None),
            SetUp::Due { obeys: true } => (Follows::Yes, unwatched),
            SetUp::Due { obeys: false } => (Follows::NotYet, unwatched),
            SetUp::Lacking { obeys: true } => (Follows::Yes, Some(NOT_WATCHED)),
            SetUp::Lacking { obeys: false } => (Follows::Never(NOT_OBEYING), Some(NOT_OBEYING)),
        };
        evidence.refused = not_taken.then_some(Refused::NotTaken);
        let reset_at = |at| Resettable::At(at + Trip(inputs.trip).reset_after_ns());
        evidence.fault = FaultIs {
            active: inputs.seen && !inputs.status.healthy(),
            named: inputs.named,
            resettable: tripped_at.map_or(Resettable::Now, reset_at),
        };
    }
}

impl State {
    /// The values for a speed, with the bits `on` of a drive that is to be on.
    fn built(&mut self, raw: f64, on: u16) -> Outputs {
        let runs = self.runs();
        let raw = if runs { raw } else { 0.0 };
        let mut reference = raw.abs();
        let reverse = if raw == 0.0 { self.reverse } else { raw < 0.0 };
        if self.turning == Some(!reverse) {
            // Direction and speed may go out one after the other: it changes at zero.
            reference = 0.0;
        } else {
            self.reverse = reverse;
        }
        let run = if self.reverse { ControlWord::RUN_REVERSE } else { ControlWord::RUN_FORWARD };
        let control = ControlWord::IDLE
            .with(if self.is_on() || self.releasing { on } else { 0 })
            .with(if runs { run } else { 0 })
            .with(if self.power == Power::FaultReset { ControlWord::RESET } else { 0 });
        Outputs { control, reference: rounded(reference) }
    }

    /// Takes the next native output once the last one has gone out: each one is sent, even if a request fails.
    fn take_native(&mut self, owner: NativeOwner, own: ControlWord, native: &mut NativePort) {
        if self.native_gone != (true, true) {
            return;
        }
        if let Some(NativeOutput { control, reference }) = native.peek() {
            let control = match owner {
                NativeOwner::Application => control,
                // The master keeps the drive running, in its own direction.
                NativeOwner::Master => own,
            };
            self.native = Some(Outputs { control, reference });
            (self.native_gone, self.native_taken) = ((false, false), self.native_taken.wrapping_add(1));
        }
    }
}

/// The direction of a reference; `None`: it is zero.
#[inline]
fn turning(raw: f64) -> Option<bool> {
    (raw != 0.0).then_some(raw < 0.0)
}

/// By hand: without SSE4.1 `round` is a call. A plan whose velocities do not fit is refused; the rest saturates.
fn rounded(reference: f64) -> i32 {
    (reference + 0.5) as i32
}
