//! What is desired of a Kollmorgen drive as control word and setpoint, and what its answers prove.
//!
//! Inputs that come with a frame are from before its outputs: an output is answered by the exchange after it.
//!
//! Assumed, because the manuals are silent: halt, bit 8, holds in every mode and keeps power on; a drive that is
//! commanded to switch on and stays off without a fault has no hardware enable.

use super::cia402::{ControlCommand, ControlWord, Mode, StatusWord};
use super::native::{NativeOutput, NativePort};
use super::plan::{KollmorgenDrive, Setpoint};
use crate::axis::Lacks;
use crate::axis::command::NativeOwner;
use crate::axis::{State, Units};
use crate::bus::desired::{
    self, Capabilities, Desired, Evidence, FaultIs, Generator, Homing, ModeIs, Motion, Power, Quantity,
    Resettable,
};
use crate::time::{MS, S, Time};

/// The answer to an output comes with so many exchanges.
const ANSWERS: u32 = 2;
/// Exchanges that a drive may take from its order to home until bit 12 refers to this homing (assumed).
const HOME_ANSWERS: u32 = 3;
/// A drive that is commanded to switch on does so within this time, ns, or its hardware enable is missing
/// (assumed).
const ON_WITHIN_NS: u64 = 500 * MS;
/// A missing hardware enable is reported for so long, ns, after the drive was last commanded to switch on: only the
/// next such command shows whether it is back.
const DARK_NS: u64 = S;
/// A motion is over with so many answers at standstill in a row: between two directions of an overshoot the motor
/// stands for a moment.
const SETTLED: u8 = 3;

const NO_CONTROL: &str = "its outputs have no control word: map 6040h";
const BLIND: &str = "its setpoint is a position, and its inputs have none: map 6064h or 6063h";
const NO_POSITION: &str = "its setpoint is no position: take outputs with one (PDO 1701h), or jog";
const NO_VELOCITY: &str =
    "its setpoint is neither a position nor a velocity: take outputs with one (PDO 1702h)";
const NO_TORQUE: &str = "its setpoint is no torque: take outputs with one (PDO 1703h)";
const NOT_WATCHED: &str = "its SyncManager watchdog is off, nothing would stop it if the master dies: set watchdog, or \
    no_drive_watchdog = \"accept\"";
const FOUND_UNWATCHED: &str = "it was found in operation with another watchdog than configured: disable it first, \
    so that it can be set up again";
const MODE_REFUSED: &str =
    "the drive refuses the homing mode or its method: look at 6060h and 6098h, and at home_method";
const COLD_START: &str =
    "its fault needs a cold start: remove its cause, then switch the drive's auxiliary power off and on";

/// The drive's last report.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Inputs {
    /// There was a report at all.
    pub seen: bool,
    /// It is in OP: outputs count.
    pub operational: bool,
    pub status: StatusWord,
    /// By the status word.
    pub state: State,
    /// Actual position, user units, not folded into one turn.
    pub position: f64,
    /// User units/s.
    pub velocity: f64,
    /// Its fault; 0: not known.
    pub fault: u16,
    /// Its fault is known, as far as it will ever be.
    pub named: bool,
    /// Only switching it off and on ends its fault.
    pub cold: bool,
}

impl Inputs {
    fn faulted(&self) -> bool {
        matches!(self.state, State::Fault | State::FaultReactionActive)
    }
}

/// The outputs for the drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Outputs {
    pub control: ControlWord,
    pub setpoint: i32,
}

/// A serial, and the exchanges that were answered since one with it was sent.
#[derive(Clone, Copy, Debug, Default)]
struct Carried {
    serial: u64,
    answers: u32,
}

impl Carried {
    fn sent(&mut self, serial: u64) {
        if serial != self.serial {
            *self = Carried { serial, answers: 0 };
        }
    }

    fn answered(&mut self) {
        self.answers = self.answers.saturating_add(1);
    }

    /// Delivered: an exchange after the one that carried it was answered.
    fn accepted(self, so_far: u64) -> u64 {
        if self.answers >= ANSWERS { self.serial } else { so_far }
    }
}

/// The profile of one drive.
#[derive(Debug)]
pub(super) struct Profile {
    units: Units,
    quantity: Quantity,
    /// Raw setpoint of one user unit/s, or of one per cent of the rated torque; negative if the axis is inverted.
    scale: f64,
    /// Bits that the mode of the setpoint needs while the drive is in operation.
    mode_bits: u16,
    /// Its watchdog is to be set, and it was found with another one.
    watched: bool,
    found_otherwise: bool,
    mode_refused: bool,
    /// What the prepared exchange is built for: serials of power, mode and motion, and what follows from them.
    serials: (u64, u64, u64),
    power_wanted: Power,
    mode_wanted: desired::Mode,
    is_native: bool,
    native_owner: Option<NativeOwner>,
    starts_home: bool,
    control: ControlWord,
    row_built: u64,
    /// The last exchange that went out had a drive follow setpoints, or home.
    follows: bool,
    home_sent: bool,
    power: Carried,
    motion: Carried,
    row: Carried,
    built: Outputs,
    /// The setpoints of the last exchange that went out, and of the one before.
    setpoints: (i32, i32),
    /// The control words of the last exchange that went out, and of the one before.
    control_sent: Option<ControlWord>,
    control_before: Option<ControlWord>,
    /// Both command it to be on.
    is_told_on: bool,
    /// It homes, or has not left the mode of that.
    homes: bool,
    native: Option<NativeOutput>,
    native_gone: bool,
    /// It was powered while it was commanded to be; commanded since; off although it was commanded on.
    was_powered: bool,
    on_since: Option<Time>,
    dark: bool,
    dark_at: Option<Time>,
    grid: Time,
}

fn quantity(drive: &KollmorgenDrive) -> (Quantity, f64) {
    let axis = &drive.axis;
    let turns = axis.units.counts_per_unit / drive.scaling.increments();
    match drive.setpoint() {
        Some(Setpoint::Position(_)) => (Quantity::Position, axis.units.counts_per_unit),
        Some(Setpoint::Velocity(_)) => (Quantity::Velocity, turns * 60.0 / drive.scaling.rpm_per_count),
        Some(Setpoint::Torque(_)) => {
            let permille = 10.0_f64.copysign(axis.units.counts_per_unit);
            (Quantity::Torque, permille / drive.scaling.permille_per_count)
        }
        None => (Quantity::Unknown, 0.0),
    }
}

/// What a drive can do.
pub(super) fn capabilities(drive: &KollmorgenDrive) -> Capabilities {
    let (quantity, _) = quantity(drive);
    let is_controlled =
        drive.outputs.entries.iter().any(|entry| entry.object == super::station::CONTROL_WORD);
    let is_blind = quantity == Quantity::Position && !super::station::tells_position(drive);
    // A position is held, even if the master dies.
    let unwatched =
        quantity != Quantity::Position && !drive.accept_no_watchdog && drive.slave.watchdog_ns.is_none();
    let positions = (quantity != Quantity::Position).then_some(NO_POSITION);
    let unwatched = unwatched.then_some(NOT_WATCHED);
    let speeds = matches!(quantity, Quantity::Torque | Quantity::Unknown).then_some(NO_VELOCITY);
    let torques = (quantity != Quantity::Torque).then_some(NO_TORQUE);
    Capabilities {
        lacks: Lacks {
            control: (!is_controlled).then_some(NO_CONTROL),
            enable: is_blind.then_some(BLIND),
            moves: positions,
            rows: positions,
            velocities: speeds.or(unwatched),
            torques: torques.or(unwatched),
            homing: None,
        },
        switches_on_at_once: false,
        still_reports: SETTLED,
        ..Capabilities::of(Generator::Master(quantity))
    }
}

impl Profile {
    pub(super) fn new(drive: &KollmorgenDrive) -> Profile {
        let (quantity, scale) = quantity(drive);
        let mode = drive.mode.or(drive.setpoint().map(|setpoint| setpoint.mode(drive.family)));
        Profile {
            units: drive.axis.units,
            quantity,
            scale,
            mode_bits: if mode == Some(Mode::INTERPOLATED) { ControlWord::START } else { 0 },
            watched: drive.slave.watchdog_ns.is_some(),
            found_otherwise: false,
            mode_refused: false,
            serials: (0, 0, 0),
            power_wanted: Power::Untouched,
            mode_wanted: desired::Mode::AsIs,
            is_native: false,
            native_owner: None,
            starts_home: false,
            control: ControlWord(0),
            row_built: 0,
            follows: false,
            home_sent: false,
            power: Carried::default(),
            motion: Carried::default(),
            row: Carried::default(),
            built: Outputs::default(),
            setpoints: (0, 0),
            control_sent: None,
            control_before: None,
            is_told_on: false,
            homes: false,
            native: None,
            native_gone: true,
            was_powered: false,
            on_since: None,
            dark: false,
            dark_at: None,
            grid: Time(0),
        }
    }

    /// The quantity of its setpoint.
    pub(super) fn quantity(&self) -> Quantity {
        self.quantity
    }

    /// The outputs of the exchange in slot `grid`.
    #[inline]
    pub(super) fn encode(&mut self, grid: Time, desired: &Desired, native: &mut NativePort) -> Outputs {
        self.grid = grid;
        let Desired { power, mode, motion, setpoint } = desired;
        if (power.serial, mode.serial, motion.serial) != self.serials {
            self.change(desired, native);
        }
        if self.is_native
            && self.native_gone
            && let Some(output) = native.next()
        {
            // Each one is sent, even if a request fails.
            (self.native, self.native_gone) = (Some(output), false);
        }
        self.row_built = setpoint.row;
        let raw = match self.quantity {
            Quantity::Position => {
                // The lowest 32 bits of a count: the drive's own count wraps around as well.
                rounded((setpoint.position - self.units.offset) * self.units.counts_per_unit) as i64 as i32
            }
            Quantity::Velocity => rounded(setpoint.velocity * self.scale) as i32,
            Quantity::Torque => rounded(setpoint.torque * self.scale) as i32,
            Quantity::Unknown => 0,
        };
        self.built = Outputs { control: self.control, setpoint: raw };
        self.built
    }

    /// Something else is desired.
    #[cold]
    fn change(&mut self, desired: &Desired, native: &mut NativePort) {
        let Desired { power, mode, motion, .. } = *desired;
        if motion.serial != self.serials.2 {
            (self.native, self.native_gone) = (None, true);
            native.flush();
        }
        self.serials = (power.serial, mode.serial, motion.serial);
        (self.power_wanted, self.mode_wanted) = (power.value, mode.value);
        self.is_native = matches!(motion.value, Motion::Native(_));
        self.native_owner = if let Motion::Native(owner) = motion.value { Some(owner) } else { None };
        self.starts_home = motion.value == Motion::Home;
        self.homes |= self.starts_home;
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
            _ if mode.value == desired::Mode::Homing || self.homes => 0,
            _ => self.mode_bits,
        };
        let halt = if motion.value == Motion::Halt { ControlWord::HALT } else { 0 };
        self.control = word.with(bits | halt);
    }

    /// The native output of the application, if that is sent, and who owns the control word.
    #[inline]
    pub(super) fn native(&self) -> Option<(&NativeOutput, NativeOwner)> {
        Some((self.native.as_ref()?, self.native_owner?))
    }

    /// Native mode runs.
    pub(super) fn is_native(&self) -> bool {
        self.is_native
    }

    /// Its watchdog is set as configured, or was found otherwise.
    pub(super) fn watched(&mut self, as_configured: bool) {
        self.found_otherwise = !as_configured;
    }

    /// Something is desired of it.
    pub(super) fn writes(&self) -> bool {
        self.serials.0 > 0
    }

    /// The mode of operation that the drive shall have.
    pub(super) fn mode_wanted(&self) -> desired::Mode {
        self.mode_wanted
    }

    /// The drive refuses the mode of homing, or its homing cannot be configured.
    pub(super) fn mode_refused(&mut self) {
        self.mode_refused = self.mode_wanted == desired::Mode::Homing;
    }

    /// The last built exchange was sent, and its outputs count.
    #[inline]
    pub(super) fn sent(&mut self) {
        self.power.sent(self.serials.0);
        self.motion.sent(self.serials.2);
        self.row.sent(self.row_built);
        (self.follows, self.home_sent) = (self.power_wanted == Power::EnableOperation, self.starts_home);
        self.setpoints = (self.built.setpoint, self.setpoints.0);
        self.native_gone = true;
        let control = self.built.control;
        if self.control_sent != Some(control) || self.control_before != Some(control) {
            self.control_before = self.control_sent.replace(control);
            let on = ControlWord::ENABLE_VOLTAGE | ControlWord::NO_QUICK_STOP;
            let is_on = |word: Option<ControlWord>| word.is_some_and(|word| word.has(on));
            self.is_told_on = is_on(self.control_sent) && is_on(self.control_before);
        }
    }

    /// An exchange was answered by a drive that outputs reach.
    #[inline]
    pub(super) fn answered(&mut self) {
        self.power.answered();
        self.motion.answered();
        self.row.answered();
    }

    /// Outputs no longer reach the drive.
    pub(super) fn dropped(&mut self) {
        (self.was_powered, self.on_since, self.dark) = (false, None, false);
        // What is sent from now on is proved anew.
        (self.power.answers, self.motion.answers, self.row.answers) = (0, 0, 0);
    }

    /// The drive has lost its commands.
    pub(super) fn drive_restarted(&mut self) {
        self.dropped();
        (self.control_sent, self.control_before, self.is_told_on) = (None, None, false);
    }

    /// The setpoint of the last sent exchange, if it is one.
    #[inline]
    pub(super) fn setpoint_sent(&self) -> i32 {
        self.setpoints.0
    }

    /// Something moves the drive: the setpoint of the last sent exchange.
    #[inline]
    pub(super) fn is_moving(&self) -> bool {
        self.home_sent
            || match self.quantity {
                Quantity::Position => self.follows && self.setpoints.0 != self.setpoints.1,
                Quantity::Velocity | Quantity::Torque => self.setpoints.0 != 0,
                Quantity::Unknown => false,
            }
    }

    /// The drive homes: its positions are about to change their origin.
    #[inline]
    pub(super) fn is_homing(&self) -> bool {
        self.homes
    }

    /// Its reference may change any time.
    #[inline]
    pub(super) fn is_finding_home(&self) -> bool {
        self.homes && self.mode_wanted == desired::Mode::Homing
    }

    /// Its hardware enable was missing when it was last commanded to switch on, not long ago.
    #[inline]
    pub(super) fn is_inhibited(&self, now: Time) -> bool {
        self.dark_at.is_some_and(|dark_at| now.since(dark_at) < DARK_NS)
    }

    /// Checks its report: whether it stays off although it is commanded to switch on.
    #[inline]
    pub(super) fn look(&mut self, inputs: &Inputs) {
        if !(inputs.operational && self.is_told_on) {
            (self.was_powered, self.on_since, self.dark) = (false, None, false);
            return;
        }
        if inputs.state.is_powered() {
            (self.was_powered, self.on_since, self.dark) = (true, None, false);
        } else if !inputs.faulted() {
            let since = *self.on_since.get_or_insert(self.grid);
            self.dark = self.was_powered || self.grid.since(since) > ON_WITHIN_NS;
            if self.dark {
                self.dark_at = Some(self.grid);
            }
        }
    }

    /// What a report proves, of a drive in this mode.
    #[inline]
    pub(super) fn prove(&mut self, inputs: &Inputs, mode: ModeIs, evidence: &mut Evidence) {
        if self.homes && mode == ModeIs::Own && self.mode_wanted != desired::Mode::Homing {
            self.homes = false;
            // The bits of its mode are back.
            self.serials.1 = 0;
        }
        if self.mode_wanted != desired::Mode::Homing {
            self.mode_refused = false;
        }
        let accepted = &mut evidence.accepted;
        accepted.power = self.power.accepted(accepted.power);
        accepted.motion = self.motion.accepted(accepted.motion);
        accepted.row = self.row.accepted(accepted.row);
        evidence.outputs_count = inputs.operational;
        evidence.mode = mode;
        let refers = self.home_sent && self.motion.answers > HOME_ANSWERS;
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
        evidence.position = inputs.position;
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
        () if inputs.state == State::FaultReactionActive => Resettable::At(Time(u64::MAX)),
        () => Resettable::Now,
    }
}

/// So that the cast that follows rounds to nearest. By hand: without SSE4.1 `round` is a call.
#[inline]
fn rounded(value: f64) -> f64 {
    value + 0.5_f64.copysign(value)
}
