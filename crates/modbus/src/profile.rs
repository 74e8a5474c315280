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
use fieldbeat_core::axis::State;
use fieldbeat_core::axis::command::NativeOwner;
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

/// The profile of one drive.
#[derive(Debug)]
pub(super) struct Profile {
    /// Raw reference for one user unit/s; negative if the axis is inverted.
    raw_per_velocity: f64,
    /// Something stops the drive if the master dies, or nothing needs to.
    watched: bool,
    /// A time-out can be set in it for that.
    watchable: bool,
    /// The drive follows the control word; if not, it may be set so.
    obeys: bool,
    settable: bool,
    /// The bits of the control word while the drive is to be on.
    on: u16,
    /// What the prepared request is built for, and what something was last sent of.
    serials: (u64, u64),
    power: Power,
    motion: Motion,
    /// What they come to: the drive is to be on, it is halted, it runs.
    is_on: bool,
    is_halted: bool,
    runs: bool,
    velocity: f64,
    sent: (u64, u64),
    /// The same when the newest status was read: a speed may come later.
    at_status: (u64, u64),
    outputs: Outputs,
    /// The last commanded direction; it is kept at zero.
    reverse: bool,
    /// The reference and direction that were sent last.
    turning: Option<bool>,
    /// RUN goes off before ENABLE does.
    releasing: bool,
    /// RUN was off for a halt, and the power stage has not come back since.
    halted: bool,
    refused: Option<Refused>,
    /// It has accepted all that is desired.
    taken: bool,
    /// The next report proves the same, if it reads back what was written with the same control word and status.
    steady: bool,
    /// The native values, and whether each went out.
    native: Option<Outputs>,
    native_gone: (bool, bool),
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
        Profile {
            raw_per_velocity: drive.map.reference.raw(drive.rpm(1.0)),
            watched: false,
            watchable: drive.watchdog.timeout_ns.is_some(),
            obeys: false,
            settable: false,
            on: ControlWord::ENABLE | if drive.watchdog.keypad { ControlWord::KEYPAD_WATCHDOG } else { 0 },
            serials: (0, 0),
            power: Power::Untouched,
            motion: Motion::Hold,
            is_on: false,
            is_halted: false,
            runs: false,
            velocity: 0.0,
            sent: (0, 0),
            at_status: (0, 0),
            outputs: Outputs::default(),
            reverse: false,
            turning: None,
            releasing: false,
            halted: false,
            refused: None,
            taken: false,
            steady: false,
            native: None,
            native_gone: (true, true),
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
        let Desired { power, motion, setpoint, .. } = desired;
        let changed = (power.serial, motion.serial) != self.serials;
        if changed {
            self.change(desired, native);
        }
        if self.power == Power::Untouched {
            return None;
        }
        // Of a drive that keeps its speed nothing is computed anew.
        let keeps =
            !changed && self.runs && self.velocity == setpoint.velocity && self.turning == Some(self.reverse);
        if keeps && self.native.is_none() && !self.is_native() && !self.releasing {
            return Some(self.outputs);
        }
        self.velocity = setpoint.velocity;
        // A drive at standstill holds its motor until RUN is off, and drops it with ENABLE.
        let off = self.power == Power::Off;
        self.releasing = off
            && inputs.status.active()
            && (self.releasing
                || inputs.status.zero_speed() && self.outputs.control.has_any(ControlWord::ANY_RUN));
        self.halted |= self.is_halted;
        self.outputs = self.built();
        if let Motion::Native(owner) = self.motion {
            self.take_native(owner, native);
        }
        Some(self.values())
    }

    /// Something else is desired.
    #[cold]
    fn change(&mut self, desired: &Desired, native: &mut NativePort) {
        let Desired { power, motion, .. } = desired;
        if motion.serial != self.serials.1 {
            (self.native, self.native_gone) = (None, (true, true));
            native.flush();
        }
        self.serials = (power.serial, motion.serial);
        (self.power, self.motion) = (power.value, motion.value);
        self.is_on = matches!(self.power, Power::EnableOperation | Power::QuickStop);
        self.is_halted = self.power == Power::QuickStop || self.motion == Motion::Halt;
        self.runs = self.power == Power::EnableOperation && !self.is_halted;
        (self.refused, self.taken, self.steady) = (None, false, false);
    }

    fn values(&self) -> Outputs {
        self.native.unwrap_or(self.outputs)
    }

    fn built(&mut self) -> Outputs {
        let runs = self.runs();
        let raw = if runs { self.velocity * self.raw_per_velocity } else { 0.0 };
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
            .with(if self.is_on() || self.releasing { self.on } else { 0 })
            .with(if runs { run } else { 0 })
            .with(if self.power == Power::FaultReset { ControlWord::RESET } else { 0 });
        // Rounded by hand: without SSE4.1 `round` is a call. A plan whose velocities do not fit is refused; the rest
        // saturates.
        Outputs { control, reference: (reference + 0.5) as i32 }
    }

    #[inline(never)]
    fn take_native(&mut self, owner: NativeOwner, native: &mut NativePort) {
        // Each one is sent, even if a request fails.
        if self.native_gone != (true, true) {
            return;
        }
        if let Some(NativeOutput { control, reference }) = native.next() {
            let control = match owner {
                NativeOwner::Application => control,
                // The master keeps the drive running, in its own direction.
                NativeOwner::Master => self.outputs.control,
            };
            self.native = Some(Outputs { control, reference });
            self.native_gone = (false, false);
        }
    }

    /// Native mode runs.
    pub(super) fn is_native(&self) -> bool {
        matches!(self.motion, Motion::Native(_))
    }

    /// Whether something stops the drive if the master dies, whether it follows the control word, and whether it
    /// can be configured to.
    pub(super) fn found(&mut self, watched: bool, obeys: bool, settable: bool) {
        (self.watched, self.obeys, self.settable, self.steady) = (watched, obeys, settable, false);
    }

    /// The drive has to be configured to follow the control word, or to be watched: once it has accepted the
    /// present values.
    pub(super) fn wants_set_up(&self, inputs: &Inputs) -> bool {
        let power = self.power;
        let enabling = power == Power::Shutdown && !(self.obeys && self.watched);
        let obeying = power != Power::Untouched && !self.obeys && inputs.status.active();
        self.settable && (enabling || obeying) && self.has_taken(inputs)
    }

    /// Something is desired of it.
    pub(super) fn writes(&self) -> bool {
        self.serials.0 > 0
    }

    /// Written values are waited for, to be read back.
    pub(super) fn waits(&self) -> bool {
        self.velocity == 0.0 && !self.is_native() && !self.taken
    }

    /// The next request has to carry this: nothing of it was sent yet.
    pub(super) fn is_new(&self) -> bool {
        self.writes() && self.sent != self.serials
    }

    /// Something was written.
    pub(super) fn sent(&mut self) {
        self.sent = self.serials;
    }

    /// The control word went out.
    pub(super) fn control_sent(&mut self) {
        self.native_gone.0 = true;
        self.releasing = false;
    }

    /// The reference went out.
    pub(super) fn reference_sent(&mut self) {
        self.native_gone.1 = true;
        self.turning = (self.outputs.reference != 0).then_some(self.reverse);
    }

    /// The drive refused the request as a whole: what it wrote has to go out again.
    pub(super) fn refused(&mut self, control: bool, reference: bool) {
        (self.sent, self.steady) = ((0, 0), false);
        if self.native.is_some() {
            self.native_gone.0 &= !control;
            self.native_gone.1 &= !reference;
        }
    }

    /// The drive is commanded to be on.
    pub(super) fn is_on(&self) -> bool {
        self.is_on
    }

    /// The next report proves the same, if it reads back what was written with the same control word and status.
    #[inline]
    pub(super) fn is_steady(&self) -> bool {
        self.steady
    }

    /// RUN is on.
    pub(super) fn runs(&self) -> bool {
        self.runs
    }

    /// Maps the drive's state onto those of CiA 402.
    #[inline]
    pub(super) fn state(&mut self, status: StatusWord, sto_open: bool) -> State {
        if status.active() && self.runs() {
            self.halted = false;
        }
        match (status.healthy(), status.active()) {
            (false, _) => State::Fault,
            // It follows no setpoint.
            (true, true) if self.is_on() && self.is_halted => State::QuickStopActive,
            (true, true) => State::OperationEnabled,
            (true, false) if sto_open => State::SwitchOnDisabled,
            // Its power stage comes and goes with RUN.
            (true, false) if self.is_on() && self.halted => State::QuickStopActive,
            (true, false) if self.is_on() => State::SwitchedOn,
            (true, false) => State::ReadyToSwitchOn,
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
        (self.native, self.native_gone, self.turning) = (None, (true, true), None);
        (self.halted, self.releasing, self.steady) = (false, false, false);
    }

    /// A status was read in an exchange that was sent after what was sent last.
    pub(super) fn status_read(&mut self) {
        self.at_status = self.sent;
    }

    /// The drive did not accept a written value, as its read-back shows.
    pub(super) fn not_taken(&mut self) {
        (self.refused, self.steady) = (Some(Refused::NotTaken), false);
    }

    /// The drive has accepted the written values.
    fn has_taken(&self, inputs: &Inputs) -> bool {
        let values = self.values();
        inputs.control == Some(values.control) && inputs.reference == Some(values.reference)
    }

    /// What a report proves.
    pub(super) fn prove(&mut self, inputs: &Inputs, evidence: &mut Evidence) {
        let (power, motion) = self.sent;
        self.taken = !self.is_new() && self.at_status == self.sent && self.has_taken(inputs);
        let taken = self.taken;
        self.steady = taken && !self.is_native();
        let since = |serial: u64| if taken { serial } else { serial.saturating_sub(1) };
        (evidence.accepted.power, evidence.accepted.motion) = (since(power), since(motion));
        evidence.is_set_up = self.obeys && self.watched;
        (evidence.follows, evidence.obstacle) = (Follows::Yes, None);
        if !evidence.is_set_up {
            self.prove_set_up(evidence);
        }
        evidence.refused = self.refused;
        let reset_at = |at| Resettable::At(at + Trip(inputs.trip).reset_after_ns());
        evidence.fault = FaultIs {
            active: inputs.seen && !inputs.status.healthy(),
            named: inputs.named,
            resettable: inputs.tripped_at.map_or(Resettable::Now, reset_at),
        };
    }

    #[cold]
    fn prove_set_up(&self, evidence: &mut Evidence) {
        evidence.follows = match (self.obeys, self.settable) {
            (true, _) => Follows::Yes,
            (false, true) => Follows::NotYet,
            (false, false) => Follows::Never(NOT_OBEYING),
        };
        evidence.obstacle = match () {
            () if !self.obeys && !self.settable => Some(NOT_OBEYING),
            () if self.watched || self.settable && self.watchable => None,
            () => Some(NOT_WATCHED),
        };
    }
}
