//! What is desired of a LinMot drive as the blocks of the next request, and what its replies prove.
//!
//! The drive makes its own setpoints: a motion is a motion command with a new count, which is proved by its echo. The
//! control word stays as the last request left it.
//!
//! Sources: SG5 manual 4.3.4, state machine and motion command interface (sheet, 3.5 and 4.1).

use std::mem::offset_of;

use super::channel::MotionChannel;
use super::motion::{
    Acceleration, MotionCommand, Position, SignedAcceleration, SignedVelocity, StreamCommand, Velocity,
};
use super::native::NativePort;
use super::plan::LinUdpDrive;
use super::wire::{ControlWord, MainState, MotionBlock, RtcBlock, StateVar, StatusWord};
use fieldbeat_core::axis::Lacks;
use fieldbeat_core::axis::command::NativeOwner;
use fieldbeat_core::axis::units::Units;
use fieldbeat_core::bus::Prepared;
use fieldbeat_core::bus::desired::{
    Capabilities, Desired, Evidence, FaultIs, Generator, Homing, Motion, Power, Ranges, Refused, Resettable,
    Setpoint, Velocities,
};
use fieldbeat_core::bus::last::PowerSent;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{Time, nanos};

/// Powered and holding, out of operation.
const HELD: ControlWord = ControlWord(ControlWord::ON.0 & !ControlWord::ENABLE_OPERATION);
/// Halting: never /Freeze (it would run on) and never OFF3 (it ends in power off, and the load drops).
const HALTED: ControlWord = ControlWord(ControlWord::ON.0 & !ControlWord::NO_ABORT);
/// 1 um/s and 1e-5 m/s²: ten and a hundred times coarser than a count of 0.1 um.
const VELOCITY: f64 = 0.1;
const ACCELERATION: f64 = 0.01;
/// The demand ends exactly at its target; a micrometre is left to its rounding, counts.
const ARRIVAL: f64 = 10.0;

/// The last report of the drive, as far as its profile needs it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Inputs {
    /// There was a reply at all.
    pub seen: bool,
    /// The count is none that this master has used lately.
    pub foreign: bool,
    /// Status word and state var are 0: booting, or the motion software is stopped.
    pub booting: bool,
    /// The code of its error is known.
    pub named: bool,
    pub status: StatusWord,
    pub state: StateVar,
    /// Unwrapped, 0.1 um.
    pub demand: i64,
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

/// The serials that a request carries.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Serials {
    power: u64,
    motion: u64,
    row: u64,
}

impl Serials {
    #[inline]
    fn of(desired: &Desired) -> Serials {
        Serials { power: desired.power.serial, motion: desired.motion.serial, row: desired.setpoint.row }
    }
}

/// The contents of a request that is answered after newer ones have left.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Carried {
    serials: Serials,
    /// The count of its motion command.
    count: Option<u8>,
    /// The control word, and that of the request before.
    control: Option<ControlWord>,
    control_before: Option<ControlWord>,
}

/// The state after the requests that left.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct State {
    /// The serials of the last one.
    serials: Serials,
    /// The control word, and that of the one before.
    control: Option<ControlWord>,
    control_before: Option<ControlWord>,
    channel: MotionChannel,
    /// The motion is a command of the channel: its echo proves it.
    is_command: bool,
    is_native: bool,
    /// None of the counts was taken, or the drive must not have this command.
    refused: Option<Refused>,
    /// The control word of the application, in native mode.
    native_control: Option<ControlWord>,
    /// The block of a native output, in the last request only.
    native_config: Option<RtcBlock>,
    /// The number of native outputs carried.
    native_taken: u32,
}

/// The profile of one drive. What each exchange touches is the end of the state and what follows it: the last
/// [`TOUCHED`](Self::TOUCHED) bytes.
#[derive(Debug)]
#[repr(C)]
pub(super) struct Profile {
    /// For the last resort.
    power_sent: PowerSent,
    rules: Rules,
    voltage: Voltage,
    state: Prepared<State>,
    /// The control word of the prepared request, which has no other block; no row follows it, and no native output.
    control: Option<ControlWord>,
    only_control: bool,
}

/// The plan of the drive.
#[derive(Debug)]
struct Rules {
    units: Units,
    stream: Option<StreamCommand>,
    sto_after_ns: u64,
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

/// The capabilities of a drive, and of its wire.
pub(super) fn capabilities(drive: &LinUdpDrive) -> Capabilities {
    let scale = drive.axis.units.counts_per_unit.abs();
    let ends = [i32::MIN, i32::MAX].map(|count| f64::from(count) / drive.axis.units.counts_per_unit);
    let least = |count: f64| (1.0 / (scale * count), f64::from(u32::MAX) / (scale * count));
    Capabilities {
        generator: Generator::Drive { velocities: drive.leash.map(Velocities::Leash) },
        lacks: Lacks {
            rows: drive.stream.is_none().then_some("no streaming command fits its cycle (stream = \"off\")"),
            velocities: drive.leash.is_none().then_some(
                "a LinUDP drive has no watchdog; allow jogs and velocities with no_drive_watchdog = \
                 \"accept\" and a leash",
            ),
            torques: Some("it takes positions and velocities, no torques"),
            ..Lacks::default()
        },
        switches_on_at_once: true,
        leaves_quick_stop: false,
        // A single reply that comes again, many cycles late, may look like the newest: it has no number.
        power_reports: 2,
        still_reports: 2,
        stands_ns: 0,
        arrival: ARRIVAL / scale,
        // A reply has both of one instant.
        behind_ns: 0,
        ranges: Ranges {
            position: (ends[0].min(ends[1]), ends[0].max(ends[1])),
            velocity: least(VELOCITY),
            acceleration: least(ACCELERATION),
        },
    }
}

impl Profile {
    /// The revisions at the end of the state, 32 bytes, and what follows them.
    pub(super) const TOUCHED: usize = 32 + size_of::<Profile>() - offset_of!(Profile, control);

    pub(super) fn new(drive: &LinUdpDrive) -> Profile {
        let LinUdpDrive { axis, stream, sto_after, .. } = drive;
        Profile {
            state: Prepared::new(State::default()),
            control: None,
            only_control: false,
            voltage: Voltage::Unknown,
            rules: Rules { units: axis.units, stream: *stream, sto_after_ns: nanos(*sto_after) },
            power_sent: PowerSent::default(),
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.power_sent.memory(regions);
    }

    /// From now on it notes here what its requests that left say of the drive's power.
    pub(super) fn note_power_in(&mut self, power_sent: PowerSent) {
        self.power_sent = power_sent;
    }

    /// The revision of what its requests and the replies have led to.
    #[inline]
    pub(super) fn revision(&self) -> u64 {
        self.state.revision()
    }

    /// Behind a clean reply: another one that says the same proves the same, as long as the revision is the same.
    pub(super) fn is_settled(&self) -> bool {
        let State { control, control_before, channel, .. } = self.state.left();
        control == control_before && channel.is_settled() && !matches!(self.voltage, Voltage::Missing { .. })
    }

    /// The next request has the blocks of the last one that was built: a control word, or none.
    #[inline]
    pub(super) fn holds(&self, desired: &Desired) -> bool {
        self.state.holds(desired.revision()) && self.only_control
    }

    /// The control word of the prepared request.
    #[inline]
    pub(super) fn control(&self) -> Option<ControlWord> {
        self.control
    }

    /// A reply has changed what the next request was built from.
    #[inline]
    pub(super) fn is_void(&self) -> bool {
        self.state.is_void()
    }

    /// The blocks of the next request.
    pub(super) fn encode(&mut self, desired: &Desired, inputs: &Inputs, native: &mut NativePort) -> Outputs {
        let Desired { power, motion, setpoint, .. } = desired;
        let (serials, rules) = (Serials::of(desired), &self.rules);
        let state = self.state.propose(desired.revision());
        let before = std::mem::replace(&mut state.serials, serials);
        let begins = motion.serial != before.motion;
        state.native_config = None;
        if begins {
            state.begin(rules, motion.value, inputs);
        }
        // The row of a stream that was replaced before it left is none of this motion.
        state.serials.row = before.row;
        if motion.value == Motion::Follow
            && setpoint.row > before.row
            && let Some(command) = rules.row(setpoint, inputs)
        {
            state.serials.row = setpoint.row;
            state.channel.stream(command);
        }
        state.channel.avoid_clash();
        // What the application has written before the mode begins is dropped.
        if let Motion::Native(owner) = motion.value
            && !begins
        {
            state.take_native(owner, inputs, native);
        }
        state.control_before = state.control;
        state.control = state.native_control.or_else(|| control(power.value, motion.value));
        let outputs =
            Outputs { control: state.control, motion: state.channel.block(), config: state.native_config };
        state.channel.sent();
        let goes_on = matches!(motion.value, Motion::Follow | Motion::Native(_));
        (self.control, self.only_control) = (outputs.control, outputs.motion.is_none() && !goes_on);
        outputs
    }

    /// The last built request has gone out.
    #[inline]
    pub(super) fn sent(&mut self, native: &mut NativePort) {
        if self.state.is_proposed() {
            self.sent_new(native);
        }
    }

    #[inline(never)]
    fn sent_new(&mut self, native: &mut NativePort) {
        if let Some((before, state)) = self.state.leave() {
            if let Some(control) = state.control.filter(|_| state.control != before.control) {
                self.power_sent.note(control.has(ControlWord::SWITCH_ON));
            }
            let begins = state.serials.motion != before.serials.motion;
            native.left(state.native_taken != before.native_taken, begins.then_some(state.is_native));
        }
    }

    /// The contents of the last request that went out.
    pub(super) fn carried(&self) -> Carried {
        let State { serials, control, control_before, channel, .. } = *self.state.left();
        Carried { serials, count: channel.sent_count(), control, control_before }
    }

    /// The drive came back from a restart: earlier commands are lost. Its count starts anew, and is reported before the
    /// next command is sent.
    pub(super) fn drive_restarted(&mut self) {
        self.state.change(|state| {
            state.channel.clear();
            state.native_control = state.native_control.map(|_| ControlWord::BASE);
        });
    }

    /// Takes the evidence of a reply; `clean`: it can be no older one.
    pub(super) fn take(&mut self, inputs: &Inputs, clean: bool, evidence: &mut Evidence) {
        self.state.change(|state| state.take(inputs, clean, evidence));
        self.report(inputs, evidence);
    }

    /// The same of a reply to a request that carried this: newer ones have left, or the next one is built.
    pub(super) fn take_earlier(
        &mut self,
        inputs: &Inputs,
        carried: &Carried,
        clean: bool,
        evidence: &mut Evidence,
    ) {
        self.state.change(|state| state.take_earlier(inputs, carried, clean, evidence));
        self.report(inputs, evidence);
    }

    /// Takes the reported states.
    fn report(&self, inputs: &Inputs, evidence: &mut Evidence) {
        evidence.refused = self.state.left().refused;
        evidence.stays_on = inputs.status.has(StatusWord::SWITCH_ON_ACTIVE);
        let operates = inputs.state.main() == MainState::OPERATION_ENABLED;
        (evidence.ready, evidence.homing) = (true, Homing::Open);
        evidence.fault = FaultIs { active: false, named: true, resettable: Resettable::Now };
        if !operates {
            Self::prove_state(inputs, evidence);
        }
    }

    /// In any other state than operation.
    #[cold]
    fn prove_state(inputs: &Inputs, evidence: &mut Evidence) {
        evidence.ready = !matches!(inputs.state.main(), MainState(9..=20));
        if inputs.state.main() == MainState::HOMING && inputs.state.finished() {
            evidence.homing = Homing::Attained;
        }
        evidence.fault.active = inputs.failed();
        evidence.fault.named = inputs.named;
        evidence.fault.resettable = match () {
            () if !inputs.settled_error() => Resettable::At(Time(u64::MAX)),
            () if inputs.status.fatal() => Resettable::Never(None),
            () => Resettable::Now,
        };
    }

    /// The drive reports that its power stage may not come on although the last requests allowed it: an input of
    /// its own, such as the hardware enable (STO), prevents it. According to the sheet the bit is that of the
    /// control word as the drive sees it, its own inputs included; that a missing STO shows in it was not seen on
    /// hardware.
    ///
    /// The status may be older than the control word (sheet, 3.5): a bit that was not there before has time to come.
    /// One that was there and goes is no such lag, since the control word has not changed.
    ///
    /// The reply is that to the last request, or to one that `carried` this.
    pub(super) fn sto_open(&mut self, at: Time, inputs: &Inputs, carried: Option<Carried>) -> bool {
        let Carried { control, control_before, .. } = carried.unwrap_or_else(|| self.carried());
        let allowed =
            |word: Option<ControlWord>| word.is_some_and(|word| word.has(ControlWord::VOLTAGE_ENABLE));
        self.voltage = match self.voltage {
            _ if inputs.booting || !allowed(control) || !allowed(control_before) => Voltage::Unknown,
            _ if inputs.status.has(StatusWord::VOLTAGE_ENABLE) => Voltage::Present,
            Voltage::Unknown => Voltage::Missing { since: at, lost: false },
            Voltage::Present => Voltage::Missing { since: at, lost: true },
            missing @ Voltage::Missing { .. } => missing,
        };
        let Voltage::Missing { since, lost } = self.voltage else { return false };
        // Time alone may make it true.
        lost || at.since(since) >= self.rules.sto_after_ns
    }
}

impl State {
    /// Another motion is desired.
    fn begin(&mut self, rules: &Rules, motion: Motion, inputs: &Inputs) {
        self.channel.clear();
        (self.native_control, self.refused) = (None, None);
        let command = match motion {
            Motion::Move { position, profile } => Some(MotionCommand::vai_go_to(
                rules.position(position, inputs),
                Velocity(rules.unsigned(profile.velocity, VELOCITY)),
                rules.acceleration(profile.acceleration),
                rules.acceleration(profile.deceleration),
            )),
            Motion::Ramp { deceleration } => Some(MotionCommand::vai_stop(rules.acceleration(deceleration))),
            Motion::EndStream => Some(MotionCommand::stream_end()),
            // Its velocities are moves.
            Motion::Velocity { .. } => None,
            Motion::Hold | Motion::Follow | Motion::Halt | Motion::Home | Motion::Native(_) => None,
        };
        (self.is_command, self.is_native) = (command.is_some(), matches!(motion, Motion::Native(_)));
        if let Some(command) = command {
            self.channel.send(command);
        }
    }

    /// Takes the next native output, once the motion of the previous one was echoed.
    fn take_native(&mut self, owner: NativeOwner, inputs: &Inputs, native: &mut NativePort) {
        if self.refused.is_some() {
            return;
        }
        let free = self.channel.is_settled() || inputs.state.count().is_none();
        let Some(output) = native.peek().filter(|output| free || output.motion.is_none()) else { return };
        self.native_taken = self.native_taken.wrapping_add(1);
        if output.motion.is_some_and(|command| command.id == MotionCommand::reset_firmware().id) {
            // With any count but 0 the drive restarts again and again (sheet, 4.3), and with 0 it does nothing if that
            // is what it has stored.
            let why = "00Fx needs a count that this master does not send; restart the drive by its parameter \
                 channel";
            self.refused = Some(Refused::Because(why));
            return;
        }
        if owner == NativeOwner::Application && output.control.is_some() {
            self.native_control = output.control;
        }
        if let Some(command) = output.motion {
            self.channel.send(command);
        }
        self.native_config = output.config;
    }

    fn take(&mut self, inputs: &Inputs, clean: bool, evidence: &mut Evidence) {
        let serials = self.serials;
        if let Some(echo) = inputs.state.count() {
            if clean && serials.row != 0 && self.channel.count == Some(echo) {
                evidence.accepted.row = serials.row;
            }
            if self.channel.take(echo, clean, inputs.foreign).is_err() {
                self.refused = Some(Refused::NotTaken);
            }
        }
        if clean {
            evidence.accepted.power = serials.power;
            if !self.is_command || self.channel.is_accepted() {
                evidence.accepted.motion = serials.motion;
            }
        }
        if self.is_command && !self.channel.is_accepted() {
            // Somebody else's command has run since.
            evidence.accepted.motion = evidence.accepted.motion.min(serials.motion.saturating_sub(1));
        }
    }

    fn take_earlier(&mut self, inputs: &Inputs, carried: &Carried, clean: bool, evidence: &mut Evidence) {
        let Carried { serials, count, .. } = *carried;
        if let Some(echo) = inputs.state.count() {
            if clean && serials.row != 0 && count == Some(echo) {
                evidence.accepted.row = evidence.accepted.row.max(serials.row);
            }
            if self.channel.take_earlier(echo, count, clean, inputs.foreign).is_err() {
                self.refused = Some(Refused::NotTaken);
            }
        }
        if clean {
            evidence.accepted.power = evidence.accepted.power.max(serials.power);
        }
        if clean && serials.motion == self.serials.motion {
            evidence.accepted.motion = match !self.is_command || self.channel.is_accepted() {
                true => serials.motion,
                false => evidence.accepted.motion.min(serials.motion.saturating_sub(1)),
            };
        }
    }
}

impl Rules {
    /// The command of a row.
    fn row(&self, setpoint: &Setpoint, inputs: &Inputs) -> Option<MotionCommand> {
        let position = self.position(setpoint.position, inputs);
        let signed = |value: f64, scale: f64| (value * self.units.counts_per_unit * scale).round() as i32;
        let velocity = SignedVelocity(signed(setpoint.velocity, VELOCITY));
        let acceleration = SignedAcceleration(signed(setpoint.acceleration, ACCELERATION));
        Some(MotionCommand::stream(self.stream?, position, velocity, acceleration))
    }

    /// The count of a rotary axis wraps around, in the drive as here.
    fn position(&self, position: f64, inputs: &Inputs) -> Position {
        let from = if self.units.modulo.is_some() { inputs.demand } else { 0 };
        let counts = ((position - self.units.offset) * self.units.counts_per_unit).round();
        let way = (counts - from as f64) as i32;
        Position((from + i64::from(way)) as i32)
    }

    fn acceleration(&self, acceleration: f64) -> Acceleration {
        Acceleration(self.unsigned(acceleration, ACCELERATION))
    }

    /// Not zero: with a zero the drive would never arrive. What the wire cannot carry was refused before.
    fn unsigned(&self, value: f64, scale: f64) -> u32 {
        ((value * self.units.counts_per_unit.abs() * scale).round() as u32).max(1)
    }
}

/// The control word of a power and a motion.
fn control(power: Power, motion: Motion) -> Option<ControlWord> {
    Some(match power {
        Power::Untouched => return None,
        Power::Off | Power::Shutdown => ControlWord::BASE,
        Power::SwitchOn => HELD,
        Power::FaultReset => ControlWord::ACKNOWLEDGE,
        Power::QuickStop => HALTED,
        Power::EnableOperation => match motion {
            Motion::Home => ControlWord::HOME,
            Motion::Halt => HALTED,
            _ => ControlWord::ON,
        },
    })
}
