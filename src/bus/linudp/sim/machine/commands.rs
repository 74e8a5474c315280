//! The effect of each motion command: which state accepts it, its meaning in SI units, and its destination.
//!
//! Knows no bytes. Commands for which the drive has no hardware, no software key or no known meaning are error
//! 0081h, or nothing if the plan says so: encoder cams, indexing, winding, force control, analog positions, streams
//! with time stamps.

use super::super::motion::{METRE, METRE_PER_S, METRE_PER_S2, Order};
use super::super::time_curve::TimeCurve;
use super::super::upids;
use super::{Demand, Machine, Mode, NEWTON_PER_AMPERE, RunMode, Task};
use crate::bus::linudp::motion::{CurveStart, Decoded, Move, Origin, Shape, Vad, When, Written};
use crate::bus::linudp::plan::UnknownCommands;
use crate::bus::linudp::wire::{ControlWord, ErrorCode, MotionBlock};
use crate::time::Time;

/// 0089h: a scale of a curve that is out of its range.
pub(in super::super) const CURVE_SCALE: ErrorCode = ErrorCode(0x0089);

/// The result of a motion command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) enum Taken {
    /// Run, refused or ignored.
    Done,
    /// The firmware restarts.
    Restart,
}

/// The quantity that the controller holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Effort {
    /// The position.
    Position,
    /// The position, with at most this force, N.
    Pressing(f64),
    /// The current, for this force, N.
    Current(f64),
}

impl Machine {
    /// Takes in a motion command block.
    pub(in super::super) fn command(&mut self, block: &MotionBlock, now: Time) -> Taken {
        let count = (block.header & 0xF) as u8;
        if count == self.count || self.stopped {
            return Taken::Done;
        }
        // Stored even if the command is refused below.
        self.count = count;
        let command = Decoded::of(block);
        match command {
            Decoded::NoOperation => return Taken::Done,
            Decoded::ResetFirmware => return Taken::Restart,
            Decoded::ControlWord(word) => {
                self.set_control(ControlWord(word), now);
                return Taken::Done;
            }
            _ => {}
        }
        match self.mode {
            Mode::NotReady | Mode::SwitchOnDisabled | Mode::ReadyToSwitchOn | Mode::Error => {}
            Mode::Operating(Task::Commands) if self.settings.run_mode != RunMode::Other => {
                self.shuttle = None;
                if self.effort_of(&command).is_some() {
                    self.sequence = None;
                }
                if let Err(code) = self.execute(&command, now) {
                    self.fail(code);
                }
            }
            _ => self.fail(ErrorCode::WRONG_STATE),
        }
        Taken::Done
    }

    /// Runs a command in state 8, from the bus or from the command table.
    pub(super) fn execute(&mut self, command: &Decoded, now: Time) -> Result<(), ErrorCode> {
        if needs_home(command) && !self.homed {
            return Err(ErrorCode::NOT_HOMED);
        }
        let effort = self.effort_of(command);
        if matches!((self.effort, effort), (Effort::Current(_), Some(Effort::Position | Effort::Pressing(_))))
        {
            // Position control takes over in mid-motion.
            self.setpoints.stop(None);
        }
        match self.dispatch(command, now) {
            Ok(()) => self.effort = effort.unwrap_or(self.effort),
            Err(ErrorCode::UNKNOWN_COMMAND) if self.plan.unknown_commands == UnknownCommands::Ignore => {}
            Err(code) => return Err(code),
        }
        Ok(())
    }

    fn dispatch(&mut self, command: &Decoded, now: Time) -> Result<(), ErrorCode> {
        let actual = self.actual();
        match *command {
            Decoded::NoOperation => {}
            Decoded::ControlWord(word) => self.set_control(ControlWord(word), now),
            Decoded::LiveParameter { upid, value } => self.write_unheard(upid, value),
            Decoded::ControllerSet(set) => self.write_unheard(upids::CONTROLLER_SET, set.into()),
            // They have no target.
            Decoded::Outputs { .. } => {}
            Decoded::ClearEvents => self.setpoints.clear_events(),
            Decoded::MasterHoming(position) => {
                let position = f64::from(position) * METRE;
                self.reference(position, position - self.plant.position());
            }

            Decoded::Move(motion)
            | Decoded::Press { motion, .. }
            // There is no integrator to reset.
            | Decoded::ResetIntegratorAndMove(motion) => {
                let mut order = self.order(&motion)?;
                if order.origin == Origin::Zero {
                    order.value = self.place(order.value);
                }
                let from_rest = matches!(motion.shape, Shape::Sine | Shape::Bestehorn(_));
                self.setpoints.take_move(order, motion.when, from_rest, actual);
            }
            Decoded::StartTriggered { rising } => {
                let order = if rising { self.settings.on_rise } else { self.settings.on_fall };
                self.setpoints.take_move(order, When::Now, false, actual);
            }
            Decoded::Stop(deceleration) => self.setpoints.stop(deceleration),
            Decoded::StopScaled(deceleration) => {
                self.setpoints.stop(Some(u32::from(deceleration).saturating_mul(self.settings.scale.3)));
            }
            Decoded::Run { positive, velocity, acceleration } => {
                let Vad { velocity: v, acceleration: a, .. } = self.settings.predefined;
                let v = f64::from(velocity.unwrap_or(v)) * METRE_PER_S;
                let a = f64::from(acceleration.unwrap_or(a)) * METRE_PER_S2;
                self.setpoints.run(if positive { v } else { -v }, a);
            }
            Decoded::ChangeProfile { positive, position, profile, scaled } => {
                let (step, v, a, d) = self.scale(scaled);
                let position = f64::from(position) * f64::from(step) * METRE;
                let profile = Vad {
                    velocity: profile.velocity.saturating_mul(v),
                    acceleration: profile.acceleration.saturating_mul(a),
                    deceleration: profile.deceleration.saturating_mul(d),
                };
                self.setpoints.change_profile(positive, position, profile);
            }

            Decoded::Stream { command, position, velocity, acceleration } => {
                let setpoint = Demand {
                    position: self.place(f64::from(position) * METRE),
                    velocity: f64::from(velocity) * METRE_PER_S,
                    acceleration: f64::from(acceleration) * METRE_PER_S2,
                };
                self.setpoints.take_setpoint(command, now, setpoint, self.settings.stream_period_ns)?;
            }
            Decoded::EndStream => self.setpoints.end_stream(),

            Decoded::Curve(start) => self.start_curve(&start)?,
            Decoded::ModifyCurve { curve, info, offset, values } => {
                let (bytes, size) = bytes(values);
                self.memory.curves.modify(curve, info, offset.into(), &bytes[..size])?;
            }
            Decoded::TableEntry { entry, when: When::Trigger { .. } } => {
                self.memory.table.get(entry).ok_or(ErrorCode::ENTRY_MISSING)?;
                self.setpoints.arm_trigger();
            }
            Decoded::TableEntry { entry, .. } => self.start_table(entry)?,
            Decoded::ModifyEntry { entry, offset, value } => {
                let (bytes, size) = bytes(value);
                self.memory.table.modify(entry, offset.into(), &bytes[..size])?;
            }

            Decoded::CurrentMode(_) => self.setpoints.follow(actual),
            Decoded::PositionMode => self.setpoints.stop(None),

            // Effective in the command table only, which takes these before they come here.
            Decoded::Wait(_)
            | Decoded::If { .. }
            | Decoded::Variable { .. }
            | Decoded::VariableToUpid { .. }
            | Decoded::UpidToVariable { .. }
            | Decoded::UpidToRom(_)
            // A table that restarts the firmware would never end.
            | Decoded::ResetFirmware
            | Decoded::Indexing { .. }
            | Decoded::StreamStamped { .. }
            | Decoded::CurveAddress { .. }
            | Decoded::DelayedCam { .. }
            | Decoded::EnableCams(_)
            | Decoded::GoToSync
            | Decoded::EncoderCounts(_)
            | Decoded::Cam { .. }
            | Decoded::EnableCam { .. }
            | Decoded::ScaleCam { .. }
            | Decoded::Winding { .. }
            | Decoded::Force { .. }
            | Decoded::ForceTarget(_)
            | Decoded::Unknown => return Err(ErrorCode::UNKNOWN_COMMAND),
        }
        Ok(())
    }

    /// A write that is not allowed is dropped without notice: such a command has no answer.
    pub(super) fn write_unheard(&mut self, upid: u16, value: u32) {
        let _ = self.write(upid, value);
    }

    /// What the controller holds from now on, if the command starts another motion at once.
    fn effort_of(&self, command: &Decoded) -> Option<Effort> {
        let force = |milliamperes: f64| milliamperes / 1e3 * NEWTON_PER_AMPERE;
        Some(match *command {
            Decoded::Press { current, .. } => Effort::Pressing(force(current.into())),
            Decoded::CurrentMode(current) => Effort::Current(force(current.into())),
            Decoded::Move(Move { when: When::Now, .. })
            | Decoded::Curve(CurveStart { when: When::Now, .. })
            | Decoded::ResetIntegratorAndMove(_)
            | Decoded::StartTriggered { .. }
            | Decoded::Stop(_)
            | Decoded::StopScaled(_)
            | Decoded::Run { .. }
            | Decoded::Stream { .. }
            | Decoded::PositionMode
            | Decoded::MasterHoming(_) => Effort::Position,
            _ => return None,
        })
    }

    /// A move in the drive's own terms.
    fn order(&self, motion: &Move) -> Result<Order, ErrorCode> {
        let (value, origin) = match motion.origin {
            Origin::Analog => return Err(ErrorCode::UNKNOWN_COMMAND),
            Origin::Variable(variable) => (self.variable(variable), Origin::Zero),
            // Nothing has ever been captured: the captured position is 0.
            Origin::Captured => (motion.value, Origin::Zero),
            origin => (motion.value, origin),
        };
        let (step, v, a, d) = self.scale(motion.scaled);
        let own = self.settings.predefined;
        let limits = Vad {
            velocity: motion.velocity.map_or(own.velocity, |velocity| velocity.saturating_mul(v)),
            acceleration: motion.acceleration.map_or(own.acceleration, |given| given.saturating_mul(a)),
            deceleration: motion.deceleration.map_or(own.deceleration, |given| given.saturating_mul(d)),
        };
        let value = f64::from(value) * f64::from(step) * METRE;
        Ok(Order { value, origin, start: motion.start, limits })
    }

    /// What a step of position, velocity, acceleration and deceleration is in wire counts.
    fn scale(&self, scaled: bool) -> (u32, u32, u32, u32) {
        if scaled { self.settings.scale } else { (1, 1, 1, 1) }
    }

    fn start_curve(&mut self, start: &CurveStart) -> Result<(), ErrorCode> {
        let curve = self.memory.curves.time_curve(start.curve).ok_or(ErrorCode::CURVE_NOT_DEFINED)?;
        let from = if start.from_actual { self.actual() } else { self.setpoints.demand() };
        let course = TimeCurve::new(curve, start, from.position)?;
        match start.when {
            When::Trigger { .. } => self.setpoints.arm_trigger(),
            When::Now | When::AfterActual => self.setpoints.play(course),
        }
        Ok(())
    }
}

/// Positions mean nothing before homing.
fn needs_home(command: &Decoded) -> bool {
    matches!(
        command,
        Decoded::Move(_)
            | Decoded::Press { .. }
            | Decoded::ResetIntegratorAndMove(_)
            | Decoded::StartTriggered { .. }
            | Decoded::Run { .. }
            | Decoded::Stream { .. }
            | Decoded::Curve(_)
    )
}

/// The data written into a curve or an entry, and their length in bytes.
fn bytes(written: Written) -> ([u8; 12], usize) {
    let mut bytes = [0; 12];
    let mut size = 0;
    let mut put = |value: &[u8]| {
        bytes[size..size + value.len()].copy_from_slice(value);
        size += value.len();
    };
    match written {
        Written::Short(value) => put(&value.to_le_bytes()),
        Written::One(value) => put(&value.to_le_bytes()),
        Written::Two(values) => values.iter().for_each(|value| put(&value.to_le_bytes())),
        Written::Three(values) => values.iter().for_each(|value| put(&value.to_le_bytes())),
    }
    (bytes, size)
}
