//! The effect of each motion command: which state accepts it, its meaning in SI units, and its destination.
//!
//! Commands for which the drive has no hardware, no software key or no known meaning are error 0081h, or nothing if the
//! plan says so: encoder cams, indexing, winding, force control, analog positions, streams with time stamps.

use super::super::codec::Motion;
use super::super::codec::commands::StreamKind;
use super::super::codec::errors;
use super::super::codec::stored::{ENTRY_SIZE, INFO_SIZE};
use super::super::demand::{Demand, METRE, METRE_PER_S, METRE_PER_S2, Move, Origin, Start, Vad, When};
use super::super::settings::UnknownCommands;
use super::super::store::INFO_BLOCKS;
use super::super::time_curve::TimeCurve;
use super::super::upids;
use super::command::{Command, Effort, Taken};
use super::settings::RunMode;
use super::{Machine, Mode, Task};
use fieldbeat_core::time::Time;

impl Machine {
    /// Takes in a motion command block.
    pub(in super::super) fn command(&mut self, block: &Motion, now: Time) -> Taken {
        if block.count() == self.count || self.stopped {
            return Taken::Done;
        }
        // Stored even if the command is refused below.
        self.count = block.count();
        let command = Command::of(*block);
        match (command.family, command.sub) {
            (0x00, 0x0) => return Taken::Done,
            (0x00, 0xF) => return Taken::Restart,
            (0x00, 0x1) => {
                self.set_control(command.values()[0] as u16, now);
                return Taken::Done;
            }
            _ => {}
        }
        match self.mode {
            Mode::NotReady | Mode::SwitchOnDisabled | Mode::ReadyToSwitchOn | Mode::Error => {}
            Mode::Operating(Task::Commands) if self.settings.run_mode != RunMode::Other => {
                self.shuttle = None;
                if command.effort().is_some() {
                    self.sequence = None;
                }
                if let Err(code) = self.execute(&command, now) {
                    self.fail(code);
                }
            }
            _ => self.fail(errors::WRONG_STATE),
        }
        Taken::Done
    }

    /// Runs a command in state 8, from the bus or from the command table.
    pub(super) fn execute(&mut self, command: &Command, now: Time) -> Result<(), u16> {
        if command.moves().is_some() && !self.power.homed {
            return Err(errors::NOT_HOMED);
        }
        let effort = command.effort();
        if matches!((self.effort, effort), (Effort::Current(_), Some(Effort::Position | Effort::Pressing(_))))
        {
            // Position control takes over in mid-motion.
            self.setpoints.stop(None);
        }
        match self.dispatch(command, now) {
            Ok(()) => self.effort = effort.unwrap_or(self.effort),
            Err(errors::UNKNOWN_COMMAND) if self.plan.unknown_commands == UnknownCommands::Ignore => {}
            Err(code) => return Err(code),
        }
        Ok(())
    }

    fn dispatch(&mut self, command: &Command, now: Time) -> Result<(), u16> {
        let actual = self.actual();
        let [a, b, c, ..] = command.values();
        match (command.family, command.sub) {
            // The outputs of 003x and 004x have no target.
            (0x00, 0x0 | 0x3 | 0x4) => {}
            (0x00, 0x1) => self.set_control(a as u16, now),
            (0x00, 0x2) => self.write_unanswered(a as u16, b as u32),
            (0x00, 0x5) => self.write_unanswered(upids::CONTROLLER_SET, a as u32),
            (0x00, 0x8) => self.setpoints.clear_events(),
            (0x00, 0x9) => {
                let position = a as f64 * METRE;
                self.reference(position, self.power.place() - position);
            }

            (0x01, 0x7) => self.setpoints.stop(Some(a as u32)),
            (0x02 | 0x0A, 0x7) => self.setpoints.stop(None),
            (0x09, 0x7) => self.setpoints.stop(Some((a as u32).saturating_mul(self.settings.scale.3))),
            (0x01 | 0x09, 0xE | 0xF) => {
                let (step, limits) = self.profile(command);
                self.setpoints.change_profile(command.sub == 0xE, a as f64 * step, limits);
            }
            (0x02 | 0x0C, 0xE | 0xF) => {
                let (_, Vad { velocity, acceleration, .. }) = self.profile(command);
                let v = f64::from(velocity) * METRE_PER_S;
                let v = if command.sub == 0xE { v } else { -v };
                self.setpoints.run(v, f64::from(acceleration) * METRE_PER_S2);
            }
            (0x0D, 0xE | 0xF) => {
                let motion = if command.sub == 0xE { self.settings.on_rise } else { self.settings.on_fall };
                self.setpoints.take_move(motion, When::Now, false, actual);
            }
            (0x01 | 0x02 | 0x09..=0x0F | 0x3A, _) => {
                let motion = self.motion(command)?;
                // Sine and Bestehorn moves.
                let from_rest = matches!(command.family, 0x0E | 0x0F);
                self.setpoints.take_move(motion, command.moves().unwrap_or(When::Now), from_rest, actual);
            }

            (0x03, 0xF) => self.setpoints.end_stream(),
            (0x03, _) => {
                let stream = StreamKind::of(command.sub).ok_or(errors::UNKNOWN_COMMAND)?;
                let setpoint = Demand {
                    position: self.place(a as f64 * METRE),
                    velocity: b as f64 * METRE_PER_S,
                    acceleration: c as f64 * METRE_PER_S2,
                };
                self.setpoints.take_setpoint(stream, now, setpoint, self.settings.stream_period_ns)?;
            }

            (0x04, _) => self.start_curve(command)?,
            (0x05, _) => {
                let part = if command.sub < 4 { 0..INFO_SIZE } else { INFO_BLOCKS..usize::MAX };
                let missing = errors::CURVE_NOT_DEFINED;
                self.memory.curves.modify(a as u16, part, b as usize, command.written(), missing)?;
            }
            (0x20, 0x0) => self.start_table(a as u16)?,
            (0x20, 0x1 | 0x2) => {
                self.memory.table.entry(a as u16)?;
                self.setpoints.arm_trigger();
            }
            (0x20, _) => {
                let (part, missing) = (0..ENTRY_SIZE, errors::ENTRY_MISSING);
                self.memory.table.modify(a as u16, part, b as usize, command.written(), missing)?;
            }
            (0x39, 0x0) => self.setpoints.follow(actual),
            (0x39, _) => self.setpoints.stop(None),

            // Waits, branches and variables have an effect in the command table only, which takes them before they
            // come here; and a table that restarts the firmware would never end.
            _ => return Err(errors::UNKNOWN_COMMAND),
        }
        Ok(())
    }

    /// A write that is not allowed is dropped without notice: such a command has no answer.
    pub(super) fn write_unanswered(&mut self, upid: u16, value: u32) {
        let _ = self.write(upid, value);
    }

    /// A move in the drive's own terms.
    fn motion(&self, command: &Command) -> Result<Move, u16> {
        let (origin, start) = match (command.family, command.sub) {
            // Pressing. Captured positions, which are 0 since nothing has ever been captured, and variables.
            (0x0C, 0x5) | (0x0D, 0x0..=0x5) => (Origin::Zero, Start::Demand),
            (0x0C, 0x6) | (0x0D, 0x6 | 0x7) => (Origin::Zero, Start::Actual),
            (0x0C, 0x7) => (Origin::Zero, Start::Standstill),
            (0x0D, _) => (Origin::Actual, Start::Actual),
            // It has no analog input.
            (_, 0x9) => return Err(errors::UNKNOWN_COMMAND),
            (_, 0x1) | (0x0E | 0x0F, 0xB | 0xD) => (Origin::Demand, Start::Demand),
            (_, 0x2 | 0xB | 0xD) => (Origin::Target, Start::Demand),
            (_, 0x3) => (Origin::Zero, Start::Actual),
            (_, 0x4) => (Origin::Zero, Start::Standstill),
            (_, 0x5) => (Origin::Actual, Start::Actual),
            (_, 0x6) => (Origin::Actual, Start::Standstill),
            _ => (Origin::Zero, Start::Demand),
        };
        let value = match (command.family, command.sub) {
            (0x0D, 0x4..=0x7) => self.variable(1 + command.sub % 2).into(),
            _ => command.fields(['P', 'p']).next().unwrap_or(0),
        };
        let (step, limits) = self.profile(command);
        let value = value as f64 * step;
        let value = if origin == Origin::Zero { self.place(value) } else { value };
        Ok(Move { value, origin, start, limits })
    }

    /// A step of the position, m, and the limits of a command. It may have a velocity, and none, one or two
    /// accelerations; a single one is the deceleration too. The others are the drive's own.
    fn profile(&self, command: &Command) -> (f64, Vad) {
        let is_scaled = command.fields(['p', 'a']).next().is_some();
        let (step, v, a, d) = if is_scaled { self.settings.scale } else { (1, 1, 1, 1) };
        let own = self.settings.predefined;
        let given = |value: Option<i64>, scale: u32, own: u32| {
            value.map_or(own, |value| (value as u32).saturating_mul(scale))
        };
        let velocity = command.fields(['V', 'v']).next();
        let mut ramps = command.fields(['A', 'a']);
        let acceleration = ramps.next();
        let limits = Vad {
            velocity: given(velocity, v, own.velocity),
            acceleration: given(acceleration, a, own.acceleration),
            deceleration: given(ramps.next().or(acceleration), d, own.deceleration),
        };
        (f64::from(step) * METRE, limits)
    }

    fn start_curve(&mut self, command: &Command) -> Result<(), u16> {
        let [id, settings @ ..] = command.values();
        let curve = self.memory.curves.time_curve(id as u16)?;
        let from = if command.sub == 0x1 { self.actual() } else { self.setpoints.demand() };
        let course = TimeCurve::new(curve, command.sub, settings, from.position)?;
        match command.moves() {
            Some(When::Trigger) => self.setpoints.arm_trigger(),
            _ => self.setpoints.play(course),
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linudp::LinMotSettings;

    #[test]
    fn the_families_of_moves_differ_as_the_manual_says() {
        use {Origin as O, Start as S, When as W};
        let machine =
            Machine::new(&LinMotSettings::new(std::net::SocketAddrV4::new(std::net::Ipv4Addr::LOCALHOST, 1)));
        let mut parameters = [0; 30];
        for (at, value) in [(0, 5_i32), (4, 1_000), (8, 2_000), (12, 3_000)] {
            parameters[at..at + 4].copy_from_slice(&value.to_le_bytes());
        }
        let (own, given) = (machine.settings.predefined, (1_000, 2_000, 3_000));
        let own = (own.velocity, own.acceleration, own.deceleration);
        for (id, origin, start, when, limits) in [
            (0x010, O::Zero, S::Demand, W::Now, given),
            (0x011, O::Demand, S::Demand, W::Now, given),
            (0x012, O::Target, S::Demand, W::Now, given),
            (0x013, O::Zero, S::Actual, W::Now, given),
            (0x014, O::Zero, S::Standstill, W::Now, given),
            (0x015, O::Actual, S::Actual, W::Now, given),
            (0x016, O::Actual, S::Standstill, W::Now, given),
            (0x018, O::Zero, S::Demand, W::AfterActual, given),
            (0x01C, O::Zero, S::Demand, W::Trigger, given),
            (0x01D, O::Target, S::Demand, W::Trigger, given),
            (0x020, O::Zero, S::Demand, W::Now, own),
            (0x0B0, O::Zero, S::Demand, W::Now, (1_000, own.1, own.2)),
            (0x0C0, O::Zero, S::Demand, W::Now, (1_000, 2_000, 2_000)),
            (0x0C5, O::Zero, S::Demand, W::Now, (1_000, 2_000, 2_000)),
            (0x0C6, O::Zero, S::Actual, W::Now, (1_000, 2_000, 2_000)),
            (0x0C7, O::Zero, S::Standstill, W::Now, (1_000, 2_000, 2_000)),
            (0x0D0, O::Zero, S::Demand, W::Now, given),
            (0x0D9, O::Actual, S::Actual, W::Now, given),
            (0x0E6, O::Actual, S::Standstill, W::Now, (1_000, 2_000, 2_000)),
            (0x0EB, O::Demand, S::Demand, W::Trigger, (1_000, 2_000, 2_000)),
            (0x0F0, O::Zero, S::Demand, W::Now, (1_000, 2_000, 2_000)),
            (0x3A1, O::Demand, S::Demand, W::Now, given),
        ] {
            let command = Command::of(Motion { header: id << 4, parameters });
            let motion = machine.motion(&command).unwrap();
            let Vad { velocity, acceleration, deceleration } = motion.limits;
            assert_eq!(
                (motion.origin, motion.start, command.moves()),
                (origin, start, Some(when)),
                "{id:03X}"
            );
            assert_eq!((velocity, acceleration, deceleration), limits, "{id:03X}");
            assert!((motion.value - 5.0 * METRE).abs() < 1e-12, "{id:03X}");
        }
        for analog in [0x019, 0x0E9, 0x0F9] {
            let command = Command::of(Motion { header: analog << 4, parameters });
            assert_eq!(machine.motion(&command).err(), Some(errors::UNKNOWN_COMMAND));
        }
        for other in [0x017, 0x01E, 0x03F, 0x07E, 0x390, 0x025, 0xFFF] {
            assert_eq!(Command::of(Motion { header: other << 4, parameters }).moves(), None, "{other:03X}");
        }
    }
}
