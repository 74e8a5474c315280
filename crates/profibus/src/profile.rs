//! What is desired of a drive as control word and set point, and what its inputs prove.
//!
//! An output is *delivered* when a new telegram after the one with it was answered: a drive that received the first of
//! two equal telegrams answers the second from its memory, and ignores what is in it. The states of power are *seen* in
//! the status word.
//!
//! Assumed, because the sheet is silent: bits of the ramp generator that are 0 stop the drive along its own ramp with
//! its power on. PROFIdrive has the bits of DRIVECOM, and bit 10 in addition; without it the drive ignores the
//! telegram.

use super::native::{NativeOutput, NativePort};
use super::plan::{DriveProfile, LenzeDrive, StatusBit};
use super::wire::words::{DrivecomControl as Control, DrivecomStatus, ProfidriveStatus};
use fieldbeat_core::axis::command::NativeOwner;
use fieldbeat_core::axis::{Lacks, State as Cia402};
use fieldbeat_core::bus::Prepared;
use fieldbeat_core::bus::desired::{
    Capabilities, Delivery, Desired, Evidence, FaultIs, Generator, Motion, Power, Quantity, Resettable,
};
use fieldbeat_core::time::Time;

/// Bits that let the ramp generator follow the set point.
const RAMP: u16 = Control::RAMP_ENABLE | Control::RAMP_RUN | Control::SETPOINT;
/// A drive stands with so many reports of that in a row.
const STILL: u8 = 3;

const NO_POSITION: &str = "it takes speeds, not positions: jog, or give it velocities";
const NO_TORQUE: &str = "it takes speeds, not torques: jog, or give it velocities";
const NO_WATCHDOG: &str = "it has no watchdog, nothing stops it if the master dies: set watchdog, or \
    no_drive_watchdog = \"accept\"";
/// Why a drive that nothing would stop is not enabled.
const NOT_WATCHED: &str = "its diagnosis does not report its watchdog as on, nothing would stop it if the \
     master dies: look at the watchdog of the module, or set watchdog = \"off\" and no_drive_watchdog = \
     \"accept\"";

/// The state that the inputs show.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Inputs {
    pub status: u16,
    pub state: Cia402,
    pub sto_open: bool,
    /// The code of its fault; 0: it has none, or it is not known.
    pub fault: u16,
    /// The code is known, as far as it will ever be.
    pub named: bool,
}

impl Inputs {
    pub(super) fn faulted(&self) -> bool {
        matches!(self.state, Cia402::Fault | Cia402::FaultReactionActive)
    }
}

/// The state after the telegrams that left.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct State {
    /// The serials of power and motion.
    serials: (u64, u64),
    /// Who owns the control word in native mode; `None`: that does not run.
    native_owner: Option<NativeOwner>,
    /// The outputs of the application in this native mode, and those that stay of the ones before.
    output: NativeOutput,
    kept: NativeOutput,
    native_taken: u32,
}

impl State {
    /// Keeps the words written by the application, but for the control word and the set point.
    fn leave_native(&mut self) {
        let output = std::mem::take(&mut self.output);
        self.kept.put_over(&output);
    }
}

/// The profile of one drive.
#[derive(Debug)]
#[repr(C, align(64))] // What each exchange looks at is on one cache line, with the revisions at the end of `state`.
pub(super) struct Profile {
    state: Prepared<State>,
    /// Of the telegram that is built: the velocity of its set point, the control word, the set point, and whether the
    /// drive follows it.
    velocity: f64,
    control: u16,
    setpoint: i16,
    runs: bool,
    /// The desired state was sent, and is proved.
    is_steady: bool,
    /// The set point that was sent last.
    turning: i16,
    /// Counts of one user unit/s, and user units/s of one count; negative if the axis is inverted.
    scale: f64,
    velocity_per_count: f64,
    /// New telegrams that were answered while something was not proved.
    answers: u64,
    power: Delivery,
    motion: Delivery,
    watch: Watch,
    profile: DriveProfile,
    ramp_bits: u16,
    enable_bit: Option<StatusBit>,
}

/// The knowledge of the drive's watchdog.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Watch {
    /// Nothing needs one.
    Needless,
    /// It was not seen on.
    Missing,
    /// It was seen on.
    On,
}

/// The contents of the next telegram that the one built before it has not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    Nothing,
    /// The set point.
    Setpoint,
    /// All of its outputs.
    Outputs,
}

/// The capabilities of a drive.
pub(super) fn capabilities(drive: &LenzeDrive) -> Capabilities {
    let unwatched = drive.watchdog.timeout_ns.is_none() && !drive.watchdog.accept_none;
    Capabilities {
        lacks: Lacks {
            moves: Some(NO_POSITION),
            rows: Some(NO_POSITION),
            homing: Some(NO_POSITION),
            torques: Some(NO_TORQUE),
            velocities: unwatched.then_some(NO_WATCHDOG),
            ..Lacks::default()
        },
        switches_on_at_once: false,
        leaves_quick_stop: false,
        // One telegram at a time has the wire: nothing that was sent comes later than its slot time.
        power_reports: 1,
        still_reports: STILL,
        ..Capabilities::of(Generator::Master(Quantity::Velocity))
    }
}

impl Profile {
    pub(super) fn new(drive: &LenzeDrive) -> Profile {
        Profile {
            state: Prepared::new(State::default()),
            velocity: 0.0,
            control: 0,
            setpoint: 0,
            runs: false,
            is_steady: false,
            turning: 0,
            scale: drive.counts_per_velocity(),
            velocity_per_count: 1.0 / drive.counts_per_velocity(),
            answers: 0,
            power: Delivery::default(),
            motion: Delivery::default(),
            watch: if drive.watchdog.timeout_ns.is_some() { Watch::Missing } else { Watch::Needless },
            profile: drive.profile,
            ramp_bits: if drive.ramp_bits { RAMP } else { 0 },
            enable_bit: drive.enable_bit,
        }
    }

    /// Builds what is desired with the next telegram; `rebuilds`: whatever the last one was, since the application may
    /// write some of it.
    #[inline]
    pub(super) fn encode(&mut self, desired: &Desired, native: &mut NativePort, rebuilds: bool) -> Change {
        let change = if rebuilds || !self.state.holds(desired.revision()) {
            self.build(desired, native);
            Change::Outputs
        } else if desired.setpoint.velocity == self.velocity {
            return Change::Nothing;
        } else {
            Change::Setpoint
        };
        self.velocity = desired.setpoint.velocity;
        // Rounded by hand: without SSE4.1 `round` is a call. A plan whose velocities do not fit is refused; the rest
        // saturates.
        let raw = if self.runs { self.velocity * self.scale } else { 0.0 };
        self.setpoint = (raw + 0.5_f64.copysign(raw)) as i16;
        change
    }

    /// Something else is desired, or written by the application.
    #[inline(never)]
    fn build(&mut self, desired: &Desired, native: &mut NativePort) {
        let Desired { power, motion, .. } = desired;
        let state = self.state.propose(desired.revision());
        let begins = motion.serial != state.serials.1;
        if begins {
            state.leave_native();
        }
        state.serials = (power.serial, motion.serial);
        state.native_owner = if let Motion::Native(owner) = motion.value { Some(owner) } else { None };
        // What the application has written before the mode begins is dropped.
        if state.native_owner.is_some()
            && !begins
            && let Some(output) = native.peek()
        {
            state.output.put_over(&output);
            state.native_taken = state.native_taken.wrapping_add(1);
        }
        let halted = motion.value == Motion::Halt;
        self.runs = power.value == Power::EnableOperation && !halted;
        let word = match power.value {
            Power::Untouched | Power::Off => Control::INHIBIT,
            Power::Shutdown => Control::SHUTDOWN,
            Power::SwitchOn => Control::SWITCHED_ON,
            Power::EnableOperation if halted => Control::ENABLED.with(self.ramp_bits & !Control::SETPOINT),
            Power::EnableOperation => Control::ENABLED.with(self.ramp_bits),
            Power::QuickStop => Control::QUICK_STOP,
            Power::FaultReset => Control(Control::FAULT_RESET),
        };
        self.control = match self.profile {
            DriveProfile::Profidrive if power.value != Power::Untouched => word.0 | Control::BY_PLC,
            _ => word.0,
        };
    }

    /// The words written by the application in native modes that are over.
    pub(super) fn kept(&self) -> &NativeOutput {
        &self.state.proposed().kept
    }

    /// The words written in the one that runs, and whether it owns the control word.
    pub(super) fn native(&self) -> Option<(&NativeOutput, bool)> {
        let State { native_owner, output, .. } = self.state.proposed();
        native_owner.map(|owner| (output, owner == NativeOwner::Application))
    }

    /// The control word and the set point of the telegram that is built.
    pub(super) fn values(&self) -> (u16, u16) {
        (self.control, self.setpoint as u16)
    }

    /// A report has changed what the next telegram was built from.
    #[inline]
    pub(super) fn is_void(&self) -> bool {
        self.state.is_void()
    }

    /// The next telegram has to be Data_Exchange: nothing of what is desired was sent yet.
    #[inline]
    pub(super) fn is_new(&self) -> bool {
        self.state.proposed().serials != self.state.left().serials
    }

    /// The telegram with the outputs that were built last has left; of one that is repeated, once. Whether native mode
    /// runs, if that may be new.
    #[inline]
    pub(super) fn sent(&mut self, native: &mut NativePort) -> Option<bool> {
        self.turning = self.setpoint;
        if self.state.is_proposed() { self.sent_new(native) } else { None }
    }

    #[inline(never)]
    fn sent_new(&mut self, native: &mut NativePort) -> Option<bool> {
        let (before, state) = self.state.leave()?;
        self.is_steady = false;
        let State { serials, native_taken, native_owner, .. } = state;
        self.power.sent(serials.0, self.answers);
        self.motion.sent(serials.1, self.answers);
        let begins = serials.1 != before.serials.1;
        native.left(*native_taken != before.native_taken, begins.then_some(native_owner.is_some()));
        Some(native_owner.is_some())
    }

    /// A new telegram was answered.
    #[inline]
    pub(super) fn answered(&mut self) {
        if !self.is_steady {
            self.answers += 1;
        }
    }

    /// The drive has left Data_Exchange: what is sent from now on is proved anew. `watched`: its watchdog is on, as far
    /// as that is known.
    pub(super) fn dropped(&mut self) {
        (self.power.since, self.motion.since, self.is_steady) = (self.answers, self.answers, false);
        self.state.change(|state| {
            let NativeOutput { mask, words: [control, ..] } = state.output;
            state.leave_native();
            // The control word stays its owner's.
            if state.native_owner == Some(NativeOwner::Application) {
                (state.output.mask, state.output.words[0]) = (mask & 1, control);
            }
        });
    }

    /// The diagnosis reports its watchdog as on, or off.
    pub(super) fn watchdog_is(&mut self, on: bool) {
        self.is_steady = false;
        if self.watch != Watch::Needless {
            self.watch = if on { Watch::On } else { Watch::Missing };
        }
    }

    /// The state by the status word.
    #[inline]
    pub(super) fn state(&self, status: u16) -> Cia402 {
        match self.profile {
            DriveProfile::Drivecom => DrivecomStatus(status).state(),
            DriveProfile::Profidrive => ProfidriveStatus(status).state(),
        }
    }

    /// The hardware enable is missing.
    #[inline]
    pub(super) fn is_sto_open(&self, status: u16) -> bool {
        self.enable_bit.is_some_and(|StatusBit { bit, set }| (status >> (bit & 0xF) & 1 != 0) != set)
    }

    /// The velocity of an actual value.
    #[inline]
    pub(super) fn velocity(&self, actual: i16) -> f64 {
        f64::from(actual) * self.velocity_per_count
    }

    /// A set point other than 0 is on its way.
    #[inline]
    pub(super) fn is_turning(&self) -> bool {
        self.turning != 0
    }

    /// The next report proves the same, if its status is the same.
    #[inline]
    pub(super) fn is_steady(&self) -> bool {
        self.is_steady
    }

    /// Takes the evidence of a report.
    pub(super) fn prove(&mut self, inputs: &Inputs, evidence: &mut Evidence) {
        let accepted = &mut evidence.accepted;
        accepted.power = self.power.accepted(self.answers, accepted.power);
        accepted.motion = self.motion.accepted(self.answers, accepted.motion);
        evidence.outputs_count = true;
        evidence.is_set_up = self.watch != Watch::Missing;
        evidence.obstacle = (self.watch == Watch::Missing).then_some(NOT_WATCHED);
        let faulted = inputs.faulted();
        let resettable = match inputs.state {
            Cia402::FaultReactionActive => Resettable::At(Time(u64::MAX)),
            _ => Resettable::Now,
        };
        evidence.fault = FaultIs { active: faulted, named: !faulted || inputs.named, resettable };
        self.is_steady = self.state.left().native_owner.is_none()
            && self.power.is_delivered(self.answers)
            && self.motion.is_delivered(self.answers)
            && (!faulted || inputs.named);
    }
}

#[cfg(test)]
mod tests;
