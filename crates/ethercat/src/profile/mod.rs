//! What is desired of a Kollmorgen drive as control word and setpoint, and what its answers prove.
//!
//! | file | what |
//! |---|---|
//! | `mod` | what is desired, as outputs; what is proved |
//! | `capabilities` | what a drive can do, by its plan |
//! | `offsets` | where the values are in the PDOs |
//!
//! Inputs that come with a frame are from before its outputs: an output is answered by the exchange after it.
//!
//! Assumed, because the manuals are silent: halt, bit 8, holds in every mode and keeps power on; a drive that is
//! commanded to switch on and stays off without a fault has no hardware enable.

pub mod capabilities;
mod offsets;

pub use self::capabilities::capabilities;
use self::capabilities::quantity;
use self::offsets::Offsets;
pub use self::offsets::reports_position;
use super::mode::Mode;
use super::native::{NativeOutput, NativePort};
use super::plan::{KollmorgenDrive, Start, Watchdog};
use fieldbeat_core::axis::State as Cia402;
use fieldbeat_core::axis::command::NativeOwner;
use fieldbeat_core::bus::Prepared;
use fieldbeat_core::bus::cia402::{ControlCommand, ControlWord, StatusWord};
use fieldbeat_core::bus::desired::{
    self, Delivery, Desired, Evidence, FaultIs, Homing, Intent, ModeIs, Motion, Power, Quantity, Resettable,
};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{MS, S, Time};

/// Exchanges that a drive may take from its order to home until bit 12 refers to this homing (assumed).
const HOME_ANSWERS: u64 = 3;
/// A drive that is commanded to switch on does so within this time, ns, or its hardware enable is missing
/// (assumed).
const ON_WITHIN_NS: u64 = 500 * MS;
/// A missing hardware enable is reported for so long, ns, after the drive was last commanded to switch on: only the
/// next such command shows whether it is back.
const DARK_NS: u64 = S;
/// A motion is over with so many answers at standstill in a row: between two directions of an overshoot the motor
/// stands for a moment.
const SETTLED: u8 = 3;

const FOUND_UNWATCHED: &str = "it was found in operation with another watchdog than configured: disable it \
     first, so that it can be set up again";
const MODE_REFUSED: &str =
    "the drive refuses the homing mode or its method: look at 6060h and 6098h, and at home_method";
const COLD_START: &str =
    "its fault needs a cold start: remove its cause, then switch the drive's auxiliary power off and on";

/// The drive's last report.
#[derive(Clone, Copy, Debug, Default)]
pub struct Inputs {
    /// It is in OP: outputs count.
    pub operational: bool,
    /// The status word.
    pub status: StatusWord,
    /// By the status word.
    pub state: Cia402,
    /// It has power, as it is reported: below OP it follows no setpoint.
    pub is_powered: bool,
    /// Actual position, user units, not folded into one turn.
    pub position: f64,
    /// User units/s.
    pub velocity: f64,
    /// The fault; 0: not known.
    pub fault: u16,
    /// The fault is known, as far as it will ever be.
    pub named: bool,
    /// Only switching it off and on ends its fault.
    pub cold: bool,
}

impl Inputs {
    fn faulted(&self) -> bool {
        matches!(self.state, Cia402::Fault | Cia402::FaultReactionActive)
    }
}

/// The state after the outputs that left.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct State {
    power: Intent<Power>,
    mode: Intent<desired::Mode>,
    motion: Intent<Motion>,
    control: ControlWord,
    /// It homes, or has not left the mode of that.
    homes: bool,
    /// The mode of homing was wanted, and the drive was not seen in its own one since: there the bits of its own mode
    /// start a homing.
    is_away: bool,
    /// Where the drive holds itself by a target that its mode follows and that is not the setpoint.
    held: Option<i32>,
    /// The native output of the application, and how many of them have left.
    output: Option<NativeOutput>,
    native_taken: u32,
}

impl State {
    fn is_native(&self) -> bool {
        matches!(self.motion.value, Motion::Native(_))
    }

    /// Something else is desired.
    fn desire(&mut self, desired: &Desired, mode_bits: u16) {
        let Desired { power, mode, motion, .. } = *desired;
        if motion.serial != self.motion.serial {
            self.output = None;
        }
        (self.power, self.mode, self.motion) = (power, mode, motion);
        self.homes |= motion.value == Motion::Home;
        self.is_away |= self.homes || mode.value == desired::Mode::Homing;
        let word = match power.value {
            Power::Untouched | Power::Off => ControlWord(0),
            Power::Shutdown => ControlCommand::Shutdown.word(),
            Power::SwitchOn => ControlCommand::SwitchOn.word(),
            Power::EnableOperation => ControlCommand::EnableOperation.word(),
            Power::QuickStop => ControlCommand::QuickStop.word(),
            Power::FaultReset => ControlWord(ControlWord::FAULT_RESET),
        };
        let bits = match motion.value {
            _ if power.value != Power::EnableOperation => 0,
            Motion::Home => ControlWord::START,
            // The start of a homing needs an edge of the same bit.
            _ if self.is_away => 0,
            _ => mode_bits,
        };
        let halt = if motion.value == Motion::Halt { ControlWord::HALT } else { 0 };
        self.control = word.with(bits | halt);
    }

    /// Where a position target is that is not the setpoint. One that the mode follows, in native mode, stays as it was
    /// when the drive came into operation, or when the application's motion ended: with a target that follows the motor
    /// the position loop has no error to work against, and the axis sinks under its load.
    fn hold(&mut self, (actual, is_enabled): (i32, bool)) {
        let is_led = self.output.is_some() || self.motion.value == Motion::Halt || self.is_away;
        let holds = is_enabled && self.power.value == Power::EnableOperation && !is_led;
        self.held = holds.then_some(self.held.unwrap_or(actual));
    }
}

/// The profile of one drive.
///
/// An exchange touches two cache lines: from the revisions at the end of `state` up to `builds_each`, and
/// from `answers` up to the front of `offsets`. Reports need the second one alone.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Profile {
    power: Delivery,
    motion: Delivery,
    /// When it was last seen without its hardware enable.
    dark_at: Option<Time>,
    state: Prepared<State>,
    /// The slot of the grid that the prepared exchange is built for, and the row desired in it.
    pub grid: Time,
    wanted_row: u64,
    /// Raw setpoint of one user unit, of one user unit/s, or of one per cent of the rated torque; negative if the
    /// axis is inverted.
    scale: f64,
    /// Of the prepared exchange: the setpoint, and the control word.
    setpoint: i32,
    control: ControlWord,
    /// Each exchange is rebuilt: the application writes some outputs, or a target follows the actual position.
    builds_each: bool,
    /// The exchanges that were answered.
    answers: u64,
    row: Delivery,
    /// The position that is 0 on the wire.
    pub(super) origin: f64,
    pub(super) sent: Sent,
    quantity: Quantity,
    /// The outputs have all but control word and setpoint.
    is_filled: bool,
    /// The offsets of its process data.
    pub offsets: Offsets,
    controls: Controls,
    switching: Switching,
    /// Bits that the mode of the setpoint needs while the drive is in operation.
    mode_bits: u16,
    /// It may have a watchdog: the configuration does not switch it off.
    watched: bool,
    /// It was found with another watchdog than configured.
    pub found_otherwise: bool,
    mode_refused: bool,
}

/// The outputs that left.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)] // As in the profile.
pub(super) struct Sent {
    /// The setpoints of the last exchange, and of the one before.
    setpoints: (i32, i32),
    /// The last exchange had a drive follow setpoints, or home.
    follows: bool,
    homes: bool,
    /// The outputs reach the drive.
    pub(super) reached: bool,
    /// The setpoints are the demand of the drive, and reach it.
    pub(super) led: bool,
}

/// The control words of the last exchange, and of the one before.
#[derive(Clone, Copy, Debug, Default)]
struct Controls {
    last: Option<ControlWord>,
    before: Option<ControlWord>,
    /// Both command it to be on.
    are_on: bool,
}

/// A drive that is commanded to switch on: it was powered since; or commanded for the first time then.
#[derive(Clone, Copy, Debug, Default)]
struct Switching {
    was_powered: bool,
    since: Option<Time>,
}

impl Profile {
    pub(super) fn new(drive: &KollmorgenDrive) -> Profile {
        let (quantity, scale) = quantity(drive);
        let mode = drive.mode();
        Profile {
            offsets: Offsets::new(drive),
            quantity,
            scale,
            origin: drive.axis.units.offset,
            mode_bits: if mode == Some(Mode::INTERPOLATED) { ControlWord::START } else { 0 },
            watched: drive.slave.watchdog != Watchdog::Off,
            found_otherwise: false,
            mode_refused: false,
            grid: Time(0),
            wanted_row: 0,
            setpoint: 0,
            control: ControlWord(0),
            builds_each: false,
            is_filled: false,
            state: Prepared::new(State::default()),
            sent: Sent::default(),
            controls: Controls::default(),
            answers: 0,
            power: Delivery::default(),
            motion: Delivery::default(),
            row: Delivery::default(),
            switching: Switching::default(),
            dark_at: None,
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.offsets.memory(regions);
    }

    /// Writes the output PDO of the exchange in slot `grid` over the one before; `actual`: the newest count of its
    /// position, and whether it was in operation there, for targets that are not the setpoint; `native`: the outputs of
    /// the application. Built again for the same send, it is the same.
    #[inline]
    pub(super) fn encode(
        &mut self,
        grid: Time,
        desired: &Desired,
        actual: impl Fn() -> (i32, bool),
        native: &mut NativePort,
        outputs: &mut [u8],
    ) {
        let setpoint = &desired.setpoint;
        self.grid = grid;
        self.wanted_row = setpoint.row;
        self.setpoint = if self.quantity == Quantity::Position {
            // The lowest 32 bits of a count: the drive's own count wraps as well.
            rounded((setpoint.position - self.origin) * self.scale) as i64 as i32
        } else {
            let is_velocity = self.quantity == Quantity::Velocity;
            // Without a setpoint its scale is 0.
            rounded(if is_velocity { setpoint.velocity } else { setpoint.torque } * self.scale) as i32
        };
        if self.builds_each || !self.state.holds(desired.revision()) {
            self.build(desired, actual(), native);
        }
        if !std::mem::replace(&mut self.is_filled, true) {
            self.offsets.fill(outputs);
        }
        self.offsets.write(self.control.0, self.setpoint, outputs);
        if self.builds_each {
            self.encode_more(actual().0, outputs);
        }
    }

    /// Builds all that is not in the setpoint alone.
    #[inline(never)]
    fn build(&mut self, desired: &Desired, actual: (i32, bool), native: &mut NativePort) {
        let state = self.state.propose(desired.revision());
        // What the application has written before the mode begins is dropped.
        let goes_on = state.motion.serial == desired.motion.serial;
        state.desire(desired, self.mode_bits);
        if state.is_native()
            && goes_on
            && let Some(output) = native.peek()
        {
            (state.output, state.native_taken) = (Some(output), state.native_taken.wrapping_add(1));
        }
        if self.offsets.follows {
            state.hold(actual);
        }
        (self.control, self.builds_each) = (state.control, state.is_native() || self.offsets.follows);
    }

    /// The outputs are not the ones that were written last.
    pub(super) fn outputs_replaced(&mut self) {
        self.is_filled = false;
    }

    /// These are the drive's own values of objects in the outputs.
    pub(super) fn own_values(&mut self, values: &[Start]) {
        values.iter().for_each(|value| self.offsets.own_value(value));
        self.is_filled = false;
    }

    /// The outputs carry this mode of operation from now on, if they carry one.
    pub(super) fn carry_mode(&mut self, mode: Mode) {
        self.is_filled &= !self.offsets.carry_mode(mode);
    }

    /// Writes a position target that is not the setpoint, and the native outputs of the application over those of the
    /// master.
    #[inline(never)]
    fn encode_more(&mut self, actual: i32, outputs: &mut [u8]) {
        let State { output, motion, held, .. } = self.state.proposed();
        if self.offsets.follows {
            self.offsets.follow(actual, held.unwrap_or(actual), outputs);
        }
        let Some(output) = output else { return };
        self.is_filled = false;
        let size = output.bytes().len().min(outputs.len());
        outputs[..size].copy_from_slice(&output.bytes()[..size]);
        if motion.value == Motion::Native(NativeOwner::Master) {
            self.offsets.write_control(self.control.0, outputs);
        }
    }

    /// Native mode runs.
    #[inline]
    pub(super) fn is_native(&self) -> bool {
        self.state.left().is_native()
    }

    /// Something is desired of it: the drive is commanded from now on. Before, it is only read, and a drive found in
    /// OP continues as it was.
    pub fn writes(&self) -> bool {
        self.state.proposed().power.serial > 0
    }

    /// The mode of operation that the drive shall have.
    pub(super) fn mode_wanted(&self) -> desired::Mode {
        self.state.left().mode.value
    }

    /// The drive refuses the mode of homing, or its homing cannot be configured.
    pub(super) fn mode_refused(&mut self) {
        self.mode_refused = self.mode_wanted() == desired::Mode::Homing;
    }

    /// The last built exchange was sent, and its outputs count. Returns whether there was something new in it, but for
    /// the setpoint and its row.
    #[inline(always)] // As `Station::sent`.
    pub(super) fn sent(&mut self, native: &mut NativePort) -> bool {
        self.row.sent(self.wanted_row, self.answers);
        self.sent.setpoints = (self.setpoint, self.sent.setpoints.0);
        self.state.is_proposed() && self.sent_new(native)
    }

    #[inline(never)]
    fn sent_new(&mut self, native: &mut NativePort) -> bool {
        let Some((before, state)) = self.state.leave() else { return false };
        let begins = state.motion.serial != before.motion.serial;
        native.left(state.native_taken != before.native_taken, begins.then(|| state.is_native()));
        true
    }

    /// More may have changed in the exchange that was [`sent`](Self::sent).
    #[inline(never)]
    pub(super) fn sent_anew(&mut self) {
        let State { power, motion, control, .. } = *self.state.left();
        self.power.sent(power.serial, self.answers);
        self.motion.sent(motion.serial, self.answers);
        self.sent.follows = power.value == Power::EnableOperation;
        self.sent.homes = motion.value == Motion::Home;
        let controls = &mut self.controls;
        if controls.last != Some(control) || controls.before != Some(control) {
            controls.before = controls.last.replace(control);
            let on = ControlWord::ENABLE_VOLTAGE | ControlWord::NO_QUICK_STOP;
            let is_on = |word: Option<ControlWord>| word.is_some_and(|word| word.has(on));
            controls.are_on = is_on(controls.last) && is_on(controls.before);
        }
    }

    /// An exchange was answered by a drive that outputs reach.
    #[inline]
    pub(super) fn answered(&mut self) {
        self.answers += 1;
    }

    /// Outputs no longer reach the drive.
    pub(super) fn dropped(&mut self) {
        self.switching = Switching::default();
        // What is sent from now on is proved anew.
        (self.power.since, self.motion.since, self.row.since) = (self.answers, self.answers, self.answers);
    }

    /// The drive has lost its commands.
    pub(super) fn drive_restarted(&mut self) {
        self.dropped();
        self.controls = Controls::default();
    }

    /// The setpoint of the last sent exchange, if it is one.
    #[inline]
    pub(super) fn setpoint_sent(&self) -> i32 {
        self.sent.setpoints.0
    }

    /// Something moves the drive: the setpoint of the last sent exchange.
    #[inline]
    pub(super) fn is_moving(&self) -> bool {
        let Sent { follows, homes, setpoints: (last, before), .. } = self.sent;
        homes
            || match self.quantity {
                Quantity::Position => follows && last != before,
                Quantity::Velocity | Quantity::Torque => last != 0,
                Quantity::Unknown => false,
            }
    }

    /// The drive homes: its positions are about to change their origin.
    #[inline]
    pub(super) fn is_homing(&self) -> bool {
        self.state.left().homes
    }

    /// The reference may change any time.
    #[inline]
    pub(super) fn is_finding_home(&self) -> bool {
        self.is_homing() && self.mode_wanted() == desired::Mode::Homing
    }

    /// How far the homing is that was sent; `None`: none was sent last.
    #[inline]
    pub(super) fn homing_sent(&self, homing: Homing) -> Option<Homing> {
        self.sent.homes.then_some(homing)
    }

    /// The hardware enable was missing when it was last commanded to switch on, not long ago.
    #[inline]
    pub(super) fn is_sto_open(&self) -> bool {
        self.dark_at.is_some_and(|dark_at| self.grid.since(dark_at) < DARK_NS)
    }

    /// Checks its report: whether it stays off although it is commanded to switch on.
    #[inline]
    pub(super) fn look(&mut self, inputs: &Inputs) {
        if !(inputs.operational && self.controls.are_on) {
            self.switching = Switching::default();
        } else if inputs.state.is_powered() {
            self.switching = Switching { was_powered: true, since: None };
        } else if !inputs.faulted() {
            let since = *self.switching.since.get_or_insert(self.grid);
            if self.switching.was_powered || self.grid.since(since) > ON_WITHIN_NS {
                self.dark_at = Some(self.grid);
            }
        }
    }

    /// Takes the evidence of a report, of a drive in this mode.
    #[inline]
    pub(super) fn prove(&mut self, inputs: &Inputs, mode: ModeIs, evidence: &mut Evidence) {
        if self.mode_wanted() != desired::Mode::Homing {
            self.mode_refused = false;
            if self.state.left().is_away && mode == ModeIs::Own {
                // The bits of its mode come back.
                self.state.change(|state| (state.homes, state.is_away) = (false, false));
            }
        }
        let accepted = &mut evidence.accepted;
        accepted.power = self.power.accepted(self.answers, accepted.power);
        accepted.motion = self.motion.accepted(self.answers, accepted.motion);
        evidence.outputs_count = inputs.operational;
        evidence.mode = mode;
        let refers = self.sent.homes && self.answers - self.motion.since > HOME_ANSWERS;
        evidence.homing = if refers { homing(inputs.status) } else { Homing::Open };
        let faulted = inputs.faulted();
        let resettable = if faulted { resettable(inputs) } else { Resettable::Now };
        evidence.fault = FaultIs { active: faulted, named: inputs.named, resettable };
        evidence.obstacle = None;
        if self.mode_refused {
            evidence.obstacle = Some(MODE_REFUSED);
        } else if self.found_otherwise && self.watched {
            evidence.obstacle = Some(FOUND_UNWATCHED);
        }
        self.prove_values(inputs, evidence);
    }

    /// The same, if nothing has changed but the row and the values.
    #[inline]
    pub(super) fn prove_values(&self, inputs: &Inputs, evidence: &mut Evidence) {
        evidence.accepted.row = self.row.accepted(self.answers, evidence.accepted.row);
        evidence.position = inputs.position;
    }

    /// True if the desired state was sent and proved; the rest of outputs and evidence stays the same while the status
    /// does.
    pub(super) fn is_steady(&self, inputs: &Inputs) -> bool {
        let State { power, mode, motion, control, is_away, .. } = *self.state.left();
        let is_delivered =
            |carried: Delivery, serial| carried.serial == serial && carried.is_delivered(self.answers);
        let is_proved = is_delivered(self.power, power.serial) && is_delivered(self.motion, motion.serial);
        let is_written = self.controls.last == Some(control) && self.controls.before == Some(control);
        let homes = is_away || self.sent.homes || mode.value == desired::Mode::Homing;
        // A missing hardware enable shows in the course of time.
        let is_dark = !inputs.state.is_powered() && (self.controls.are_on || self.dark_at.is_some());
        is_proved && is_written && !homes && !self.is_native() && !is_dark
    }
}

fn homing(status: StatusWord) -> Homing {
    match () {
        () if status.has(StatusWord::MODE_13) => Homing::Failed,
        () if status.has(StatusWord::MODE_12) => Homing::Attained,
        () => Homing::Open,
    }
}

#[cold]
fn resettable(inputs: &Inputs) -> Resettable {
    match () {
        () if inputs.cold => Resettable::Never(Some(COLD_START)),
        () if inputs.state == Cia402::FaultReactionActive => Resettable::At(Time(u64::MAX)),
        () => Resettable::Now,
    }
}

/// So that the cast that follows rounds to nearest. By hand: without SSE4.1 `round` is a call.
#[inline]
fn rounded(value: f64) -> f64 {
    value + 0.5_f64.copysign(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// If another field of `state` moves them, one of the rare ones in front of it moves behind `offsets`, or back.
    #[test]
    fn an_exchange_touches_two_cache_lines() {
        use std::mem::offset_of;
        let (grid, answers) = (offset_of!(Profile, grid), offset_of!(Profile, answers));
        assert_eq!((offset_of!(Profile, state) + size_of::<Prepared<State>>(), grid % 64), (grid, 32));
        assert_eq!(answers, grid + 32);
        assert!(offset_of!(Profile, offsets) <= answers + 48);
    }
}
