//! What is desired of a Unidrive as control word and speed reference, and what it reports as accepted.
//!
//! In operation RUN is on, with a direction, and the drive follows the reference, at zero too: it holds its motor
//! there. The drive's own ramps (02.011, 02.021) act below it. Nothing is written before something is desired.
//!
//! Sources: SI-PROFIBUS guide, control word 06.042 and status word 10.040.

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
    /// There was a status at all.
    pub seen: bool,
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

/// The values for the drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Outputs {
    pub control: ControlWord,
    /// Not negative: the direction is in the control word.
    pub reference: i32,
}

/// What the requests that left have led to.
#[derive(Clone, Copy, Debug, PartialEq)]
struct State {
    /// The intents of which something was written: power, motion.
    serials: (u64, u64),
    power: Power,
    motion: Motion,
    /// It runs by the setpoints of the master.
    follows: bool,
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
    refused: Option<Refused>,
    /// The control word that was written last has RUN.
    ran: bool,
    /// The native values, whether each went out, and how many of them were taken.
    native: Option<Outputs>,
    native_gone: (bool, bool),
    native_taken: u32,
}

impl State {
    /// The drive is commanded to be on.
    fn is_on(&self) -> bool {
        matches!(self.power, Power::EnableOperation | Power::QuickStop)
    }

    fn is_halted(&self) -> bool {
        self.power == Power::QuickStop || self.motion == Motion::Halt
    }

    /// RUN is on.
    fn runs(&self) -> bool {
        self.power == Power::EnableOperation && !self.is_halted()
    }

    fn is_native(&self) -> bool {
        matches!(self.motion, Motion::Native(_))
    }
}

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

/// The profile of one drive.
#[derive(Debug)]
pub(super) struct Profile {
    /// Raw reference for one user unit/s; negative if the axis is inverted.
    raw_per_velocity: f64,
    /// The bits of the control word while the drive is to be on.
    on: u16,
    set_up: SetUp,
    /// Something stops the drive if the master dies once it is set up, or nothing needs to.
    watchable: bool,
    state: Prepared<State>,
    /// The values of the prepared request, and the velocity that was desired with them.
    outputs: Outputs,
    velocity: f64,
    /// The intents of the last request that had left when the newest status was read: a speed may come later.
    at_status: (u64, u64),
    /// It has accepted all that has left.
    taken: bool,
    /// The next report proves the same, if it reads back what was written with the same control word and status, as
    /// long as this is the revision of the state.
    steady: Option<u64>,
}

/// What a drive can do.
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
            motion: Motion::Hold,
            follows: false,
            is_refused: false,
            reverse: false,
            turning: None,
            releasing: false,
            halted: false,
            refused: None,
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
            velocity: 0.0,
            at_status: (0, 0),
            taken: false,
            steady: None,
        }
    }

    /// The values of the next request; `None`: nothing is written.
    #[inline]
    pub(super) fn encode(
        &mut self,
        desired: &Desired,
        inputs: &Inputs,
        native: &mut NativePort,
    ) -> Option<Outputs> {
        if desired.power.value == Power::Untouched {
            return None;
        }
        self.velocity = desired.setpoint.velocity;
        let raw = self.velocity * self.raw_per_velocity;
        let state = self.state.left();
        // Of a drive that goes on turning in its direction only the speed is new.
        if self.state.holds(desired.revision())
            && state.follows
            && raw != 0.0
            && state.turning == Some(raw < 0.0)
        {
            self.outputs.reference = rounded(raw.abs());
            return Some(self.outputs);
        }
        self.build(desired, raw, inputs, native);
        Some(self.outputs)
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
        if (power.serial, motion.serial) != state.serials {
            state.refused = None;
        }
        state.serials = (power.serial, motion.serial);
        (state.power, state.motion, state.is_refused) = (power.value, motion.value, false);
        state.follows = state.runs() && !state.is_native();
        // A drive at standstill holds its motor until RUN is off, and drops it with ENABLE.
        state.releasing = state.power == Power::Off
            && inputs.status.active()
            && (state.releasing || inputs.status.zero_speed() && state.ran);
        state.halted |= state.is_halted();
        self.outputs = state.built(raw, self.on);
        // What the application has written before the mode begins is dropped.
        if let Motion::Native(owner) = state.motion {
            if !begins {
                state.take_native(owner, self.outputs.control, native);
            }
            self.outputs = state.native.unwrap_or(self.outputs);
        }
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
        self.steady = None;
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
        is_wanted && self.has_taken(inputs)
    }

    /// Something was written to it.
    pub(super) fn writes(&self) -> bool {
        self.state.left().serials.0 > 0
    }

    /// Written values are waited for, to be read back.
    pub(super) fn waits(&self) -> bool {
        self.velocity == 0.0 && !self.state.proposed().is_native() && (self.is_new() || !self.taken)
    }

    /// The next request has to carry this: nothing of it was sent yet.
    pub(super) fn is_new(&self) -> bool {
        let (proposed, left) = (self.state.proposed(), self.state.left());
        proposed.serials != left.serials || left.is_refused
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

    /// The next report proves the same, if it reads back what was written with the same control word and status.
    #[inline]
    pub(super) fn is_steady(&self) -> bool {
        self.steady == Some(self.state.revision())
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

    /// The drive was commanded to run and has accepted it, for as long as it needs.
    pub(super) fn should_be_active(&self, now: Time, inputs: &Inputs) -> bool {
        self.runs()
            && inputs.control.is_some_and(|word| word.has_any(ControlWord::ANY_RUN))
            && now.since(inputs.control_since) > ACTIVE_WITHIN_NS
    }

    /// The drive has lost its commands: no earlier value is written again.
    pub(super) fn drive_restarted(&mut self) {
        self.state.change(|state| {
            (state.native, state.native_gone, state.turning) = (None, (true, true), None);
            (state.halted, state.releasing) = (false, false);
        });
        self.steady = None;
    }

    /// A status was read in an exchange that was sent after what was sent last.
    pub(super) fn status_read(&mut self) {
        self.at_status = self.state.left().serials;
    }

    /// The drive did not accept a written value, as its read-back shows.
    pub(super) fn not_taken(&mut self) {
        self.state.change(|state| state.refused = Some(Refused::NotTaken));
        self.steady = None;
    }

    /// The drive has accepted the written values.
    fn has_taken(&self, inputs: &Inputs) -> bool {
        inputs.control == Some(self.outputs.control) && inputs.reference == Some(self.outputs.reference)
    }

    /// What a report proves.
    pub(super) fn prove(&mut self, inputs: &Inputs, evidence: &mut Evidence) {
        let State { serials: (power, motion), is_refused, refused, .. } = *self.state.left();
        let taken = !self.is_new() && self.at_status == (power, motion) && self.has_taken(inputs);
        self.taken = taken;
        self.steady = (taken && !self.is_native()).then(|| self.state.revision());
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
        evidence.refused = refused;
        let reset_at = |at| Resettable::At(at + Trip(inputs.trip).reset_after_ns());
        evidence.fault = FaultIs {
            active: inputs.seen && !inputs.status.healthy(),
            named: inputs.named,
            resettable: inputs.tripped_at.map_or(Resettable::Now, reset_at),
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

/// By hand: without SSE4.1 `round` is a call. A plan whose velocities do not fit is refused; the rest saturates.
fn rounded(reference: f64) -> i32 {
    (reference + 0.5) as i32
}
