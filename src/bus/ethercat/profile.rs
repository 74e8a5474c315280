//! What is desired of a Kollmorgen drive as control word and setpoint, and what its answers prove.
//!
//! Inputs that come with a frame are from before its outputs: an output is answered by the exchange after it.
//!
//! Assumed, because the manuals are silent: halt, bit 8, holds in every mode and keeps power on; a drive that is
//! commanded to switch on and stays off without a fault has no hardware enable.

use super::cia402::{ControlCommand, ControlWord, Mode, StatusWord};
use super::native::{NativeOutput, NativePort, PDO_MAX};
use super::object::number::{
    CONTROL_WORD, ERROR_CODE, INCREMENTS, MAXIMUM_TORQUE, POSITION, STATUS_WORD, TORQUE, VELOCITY,
};
use super::object::pdo::{Entry, Layout};
use super::plan::{KollmorgenDrive, Setpoint};
use crate::axis::Lacks;
use crate::axis::command::NativeOwner;
use crate::axis::{State, Units};
use crate::bus::desired::{
    self, Capabilities, Desired, Evidence, FaultIs, Generator, Homing, ModeIs, Motion, Power, Quantity,
    Resettable,
};
use crate::rt::Regions;
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
    offsets: Offsets,
    native: NativePort,
    units: Units,
    quantity: Quantity,
    /// Raw setpoint of one user unit/s, or of one per cent of the rated torque; negative if the axis is inverted.
    scale: f64,
    /// Bits that the mode of the setpoint needs while the drive is in operation.
    mode_bits: u16,
    /// Its watchdog is to be set.
    watched: bool,
    /// It was found with another watchdog than configured.
    pub found_otherwise: bool,
    mode_refused: bool,
    /// The slot of the grid that the prepared exchange is built for, and what is desired in it.
    pub grid: Time,
    wanted: Desired,
    control: ControlWord,
    setpoint: i32,
    /// It homes, or has not left the mode of that.
    homes: bool,
    /// The next native output of the application; `is_sent`: it went out.
    output: Option<NativeOutput>,
    is_sent: bool,
    sent: Sent,
    power: Carried,
    motion: Carried,
    row: Carried,
    switching: Switching,
    /// When it was last seen without its hardware enable.
    dark_at: Option<Time>,
}

/// What went out.
#[derive(Clone, Copy, Debug, Default)]
struct Sent {
    /// The last exchange had a drive follow setpoints, or home.
    follows: bool,
    homes: bool,
    /// The setpoints of the last exchange, and of the one before.
    setpoints: (i32, i32),
    /// The control words of the last exchange, and of the one before.
    control: Option<ControlWord>,
    before: Option<ControlWord>,
    /// Both command it to be on.
    is_on: bool,
}

/// A drive that is commanded to switch on: it was powered since; or commanded for the first time then.
#[derive(Clone, Copy, Debug, Default)]
struct Switching {
    was_powered: bool,
    since: Option<Time>,
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
    let is_controlled = drive.outputs.entries.iter().any(|entry| entry.object == CONTROL_WORD);
    let is_blind = quantity == Quantity::Position && !tells_position(drive);
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
    pub(super) fn new(drive: &KollmorgenDrive, native: NativePort) -> Profile {
        let (quantity, scale) = quantity(drive);
        let mode = drive.mode.or(drive.setpoint().map(|setpoint| setpoint.mode(drive.family)));
        Profile {
            offsets: Offsets::new(drive),
            native,
            units: drive.axis.units,
            quantity,
            scale,
            mode_bits: if mode == Some(Mode::INTERPOLATED) { ControlWord::START } else { 0 },
            watched: drive.slave.watchdog_ns.is_some(),
            found_otherwise: false,
            mode_refused: false,
            grid: Time(0),
            wanted: Desired::default(),
            control: ControlWord(0),
            setpoint: 0,
            homes: false,
            output: None,
            is_sent: true,
            sent: Sent::default(),
            power: Carried::default(),
            motion: Carried::default(),
            row: Carried::default(),
            switching: Switching::default(),
            dark_at: None,
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.native.memory(regions);
    }

    /// Writes the output PDO of the exchange in slot `grid`, whole. Built again for the same send, it is the same:
    /// state that changes with every exchange changes in [`sent`](Self::sent).
    #[inline]
    pub(super) fn encode(&mut self, grid: Time, desired: &Desired, outputs: &mut [u8]) {
        self.grid = grid;
        let Desired { power, mode, motion, setpoint } = desired;
        let Desired { power: last_power, mode: last_mode, motion: last_motion, .. } = &self.wanted;
        if (power.serial, mode.serial, motion.serial)
            != (last_power.serial, last_mode.serial, last_motion.serial)
        {
            self.change(desired);
        }
        self.wanted.setpoint.row = setpoint.row;
        self.setpoint = match self.quantity {
            Quantity::Position => {
                // The lowest 32 bits of a count: the drive's own count wraps context as well.
                rounded((setpoint.position - self.units.offset) * self.units.counts_per_unit) as i64 as i32
            }
            Quantity::Velocity => rounded(setpoint.velocity * self.scale) as i32,
            Quantity::Torque => rounded(setpoint.torque * self.scale) as i32,
            Quantity::Unknown => 0,
        };
        self.offsets.write(self.control.0, self.setpoint, outputs);
        if let Some(owner) = self.native_owner() {
            self.encode_native(owner, outputs);
        }
    }

    /// Writes the native outputs of the application over those of the master.
    fn encode_native(&mut self, owner: NativeOwner, outputs: &mut [u8]) {
        if self.is_sent
            && let Some(output) = self.native.next()
        {
            // Each one is sent, even if a request fails.
            (self.output, self.is_sent) = (Some(output), false);
        }
        let Some(output) = &self.output else { return };
        let size = output.bytes().len().min(outputs.len());
        outputs[..size].copy_from_slice(&output.bytes()[..size]);
        if owner == NativeOwner::Master {
            put(outputs, self.offsets.control, self.control.0.to_le_bytes());
        }
    }

    /// Publishes the inputs to the application.
    #[inline]
    pub(super) fn publish(&mut self, at: Time, inputs: &[u8]) {
        self.native.publish(at, self.is_native(), inputs);
    }

    /// Reads the input PDO; `None`: it has no status word.
    #[inline]
    pub(super) fn read(&self, inputs: &[u8]) -> Option<Counts> {
        self.offsets.read(inputs)
    }

    /// Something else is desired.
    #[cold]
    fn change(&mut self, desired: &Desired) {
        let Desired { power, mode, motion, .. } = *desired;
        if motion.serial != self.wanted.motion.serial {
            (self.output, self.is_sent) = (None, true);
            self.native.flush();
        }
        self.wanted = *desired;
        self.homes |= motion.value == Motion::Home;
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

    /// Who owns the control word in native mode; `None`: it does not run.
    #[inline]
    fn native_owner(&self) -> Option<NativeOwner> {
        if let Motion::Native(owner) = self.wanted.motion.value { Some(owner) } else { None }
    }

    /// Native mode runs.
    #[inline]
    pub(super) fn is_native(&self) -> bool {
        self.native_owner().is_some()
    }

    /// Something is desired of it: the drive is commanded from now on. Before, it is only read, and a drive found in
    /// OP continues as it was.
    pub(super) fn writes(&self) -> bool {
        self.wanted.power.serial > 0
    }

    /// The mode of operation that the drive shall have.
    pub(super) fn mode_wanted(&self) -> desired::Mode {
        self.wanted.mode.value
    }

    /// The drive refuses the mode of homing, or its homing cannot be configured.
    pub(super) fn mode_refused(&mut self) {
        self.mode_refused = self.mode_wanted() == desired::Mode::Homing;
    }

    /// The last built exchange was sent, and its outputs count.
    #[inline]
    pub(super) fn sent(&mut self) {
        let Desired { power, motion, setpoint, .. } = &self.wanted;
        self.power.sent(power.serial);
        self.motion.sent(motion.serial);
        self.row.sent(setpoint.row);
        let sent = &mut self.sent;
        sent.follows = power.value == Power::EnableOperation;
        sent.homes = motion.value == Motion::Home;
        sent.setpoints = (self.setpoint, sent.setpoints.0);
        self.is_sent = true;
        if sent.control != Some(self.control) || sent.before != Some(self.control) {
            sent.before = sent.control.replace(self.control);
            let on = ControlWord::ENABLE_VOLTAGE | ControlWord::NO_QUICK_STOP;
            let is_on = |word: Option<ControlWord>| word.is_some_and(|word| word.has(on));
            sent.is_on = is_on(sent.control) && is_on(sent.before);
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
        self.switching = Switching::default();
        // What is sent from now on is proved anew.
        (self.power.answers, self.motion.answers, self.row.answers) = (0, 0, 0);
    }

    /// The drive has lost its commands.
    pub(super) fn drive_restarted(&mut self) {
        self.dropped();
        (self.sent.control, self.sent.before, self.sent.is_on) = (None, None, false);
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
        self.homes
    }

    /// Its reference may change any time.
    #[inline]
    pub(super) fn is_finding_home(&self) -> bool {
        self.homes && self.mode_wanted() == desired::Mode::Homing
    }

    /// Its hardware enable was missing when it was last commanded to switch on, not long ago.
    #[inline]
    pub(super) fn is_inhibited(&self) -> bool {
        self.dark_at.is_some_and(|dark_at| self.grid.since(dark_at) < DARK_NS)
    }

    /// Checks its report: whether it stays off although it is commanded to switch on.
    #[inline]
    pub(super) fn look(&mut self, inputs: &Inputs) {
        if !(inputs.operational && self.sent.is_on) {
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

    /// What a report proves, of a drive in this mode.
    #[inline]
    pub(super) fn prove(&mut self, inputs: &Inputs, mode: ModeIs, evidence: &mut Evidence) {
        if self.mode_wanted() != desired::Mode::Homing {
            self.mode_refused = false;
            if self.homes && mode == ModeIs::Own {
                self.homes = false;
                // The bits of its mode are back.
                self.wanted.mode.serial = 0;
            }
        }
        let accepted = &mut evidence.accepted;
        accepted.power = self.power.accepted(accepted.power);
        accepted.motion = self.motion.accepted(accepted.motion);
        accepted.row = self.row.accepted(accepted.row);
        evidence.outputs_count = inputs.operational;
        evidence.mode = mode;
        let refers = self.sent.homes && self.motion.answers > HOME_ANSWERS;
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

/// Its inputs have an actual position.
pub(super) fn tells_position(drive: &KollmorgenDrive) -> bool {
    let is_one =
        |object| drive.inputs.entries.iter().any(|entry| entry.object == object && entry.kind.bytes() == 4);
    is_one(POSITION) || is_one(INCREMENTS)
}

/// The largest torque of a drive: 0 would be none. If the plan does not set it, it is this, per mille (assumed: the
/// drive's own limit acts below it).
const MOST_PERMILLE: u64 = 3_000;

/// The offset of a value that is not there: past the end.
const NOWHERE: usize = PDO_MAX;

/// The offsets of the values in the outputs and inputs.
#[derive(Clone, Debug)]
struct Offsets {
    /// The outputs without control word and setpoint.
    rest: [u8; PDO_MAX],
    size: usize,
    control: usize,
    setpoint: usize,
    /// The setpoint has 16 bits.
    is_short: bool,
    status: usize,
    position: usize,
    velocity: usize,
    torque: usize,
    fault: usize,
}

/// The drive's report, as counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Counts {
    pub status: u16,
    pub position: Option<i32>,
    pub velocity: Option<i32>,
    pub torque: Option<i16>,
    pub fault: Option<u16>,
}

impl Offsets {
    fn new(drive: &KollmorgenDrive) -> Offsets {
        let (outputs, inputs) = (&drive.outputs, &drive.inputs);
        let sized = |layout: &Layout, object, bytes| {
            let is_it = |(_, entry): &(usize, Entry)| entry.object == object && entry.kind.bytes() == bytes;
            layout.places().find(is_it).map_or(NOWHERE, |(at, _)| at.min(PDO_MAX))
        };
        let setpoint = drive.setpoint().map(|setpoint| setpoint.shape().0);
        let setpoint = setpoint
            .and_then(|object| outputs.places().find(|(_, entry)| entry.object == object))
            .map(|(at, entry)| (at.min(PDO_MAX), entry.kind.bytes() == 2));
        let (setpoint, is_short) = setpoint.unwrap_or((NOWHERE, false));
        let position = match sized(inputs, POSITION, 4) {
            NOWHERE => sized(inputs, INCREMENTS, 4),
            position => position,
        };
        Offsets {
            rest: rest(drive),
            size: outputs.size().min(PDO_MAX),
            control: sized(outputs, CONTROL_WORD, 2),
            setpoint,
            is_short,
            status: sized(inputs, STATUS_WORD, 2),
            position,
            velocity: sized(inputs, VELOCITY, 4),
            torque: sized(inputs, TORQUE, 2),
            fault: sized(inputs, ERROR_CODE, 2),
        }
    }

    /// Writes the output PDO, whole.
    #[inline]
    fn write(&self, control: u16, setpoint: i32, outputs: &mut [u8]) {
        let size = self.size.min(outputs.len());
        outputs[..size].copy_from_slice(&self.rest[..size]);
        if self.is_short {
            let most = i32::from(i16::MAX);
            put(outputs, self.setpoint, (setpoint.clamp(-most, most) as i16).to_le_bytes());
        } else {
            put(outputs, self.setpoint, setpoint.to_le_bytes());
        }
        self.write_control(control, outputs);
    }

    /// Writes the control word over the present one.
    #[inline]
    fn write_control(&self, control: u16, outputs: &mut [u8]) {
        put(outputs, self.control, control.to_le_bytes());
    }

    /// Reads the input PDO; `None`: it has no status word.
    #[inline]
    fn read(&self, inputs: &[u8]) -> Option<Counts> {
        Some(Counts {
            status: u16::from_le_bytes(get(inputs, self.status)?),
            position: get(inputs, self.position).map(i32::from_le_bytes),
            velocity: get(inputs, self.velocity).map(i32::from_le_bytes),
            torque: get(inputs, self.torque).map(i16::from_le_bytes),
            fault: get(inputs, self.fault).map(u16::from_le_bytes),
        })
    }
}

#[inline]
fn put<const N: usize>(outputs: &mut [u8], at: usize, value: [u8; N]) {
    if let Some(place) = outputs.get_mut(at..).and_then(<[u8]>::first_chunk_mut) {
        *place = value;
    }
}

#[inline]
fn get<const N: usize>(inputs: &[u8], at: usize) -> Option<[u8; N]> {
    inputs.get(at..)?.first_chunk().copied()
}

/// The other outputs: as the plan writes the objects at the start, otherwise 0.
fn rest(drive: &KollmorgenDrive) -> [u8; PDO_MAX] {
    let mut rest = [0; PDO_MAX];
    for (at, entry) in drive.outputs.places() {
        let planned = drive.slave.start_up.iter().rev().find(|start| start.object == entry.object);
        let raw = match (planned, entry.object) {
            (Some(start), _) => start.raw,
            (None, MAXIMUM_TORQUE) => MOST_PERMILLE,
            (None, _) => 0,
        };
        let bytes = entry.kind.bytes();
        if let Some(place) = rest.get_mut(at..at + bytes) {
            place.copy_from_slice(&raw.to_le_bytes()[..bytes]);
        }
    }
    rest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::ethercat::object::{Family, Object, pdo};
    use crate::bus::ethercat::plan::Start;

    fn drive(family: Family, outputs: u16, inputs: u16) -> KollmorgenDrive {
        let mut drive = KollmorgenDrive::new("x", 0, family);
        for layout in pdo::fixed(family) {
            match layout.pdo {
                number if number == outputs => drive.outputs = layout,
                number if number == inputs => drive.inputs = layout,
                _ => {}
            }
        }
        drive
    }

    #[test]
    fn outputs_and_inputs_are_those_of_the_sheet() {
        let offsets = Offsets::new(&drive(Family::S700, 0x1702, 0x1B03));
        let mut outputs = [0xEE; 6];
        offsets.write(0x0F, 100_000, &mut outputs);
        assert_eq!(outputs, [0xA0, 0x86, 0x01, 0, 0x0F, 0]);
        let said = offsets.read(&[0x40, 0xE2, 0x01, 0, 0x06, 0xFF, 0x37, 0x06]).unwrap();
        assert_eq!((said.status, said.position, said.torque), (0x0637, Some(123_456), Some(-250)));
        assert_eq!((said.velocity, said.fault), (None, None));
    }

    #[test]
    fn what_else_is_mapped_is_as_planned_and_no_torque_is_taken_away() {
        let mut akd = drive(Family::Akd, 0x1725, 0x1B26);
        let outputs = Object::new(0x60FE, 1);
        akd.slave.start_up.push(Start {
            object: outputs,
            kind: crate::bus::ethercat::object::Type::U32,
            raw: 3,
        });
        let offsets = Offsets::new(&akd);
        let mut out = vec![0xEE; akd.outputs.size()];
        offsets.write(6, -1, &mut out);
        assert_eq!(out, [6, 0, 0xFF, 0xFF, 0xFF, 0xFF, 3, 0, 0, 0, 0, 0, 0, 0, 0xB8, 0x0B]);
    }

    #[test]
    fn areas_that_are_too_short_are_neither_read_nor_written_beyond() {
        let offsets = Offsets::new(&drive(Family::S700, 0x1702, 0x1B03));
        for length in 0..6 {
            let mut outputs = vec![0; length];
            offsets.write(0x0F, -1, &mut outputs);
        }
        assert!((0..8).all(|length| offsets.read(&vec![0; length]).is_none()));
    }
}
