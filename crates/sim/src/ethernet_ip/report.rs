//! What the drive reports of itself: status code, positions, inputs.
//!
//! Facts: sheet, 5.2 and 5.6.

use super::assembly::Report;
use super::drive::{Drive, alarm};
use super::motion::Motion;
use super::settings::Kind;
use crate::Truth;
use crate::power::{RPM, set_bits};

impl Drive {
    /// The input word of the main board.
    pub(super) fn inputs(&self) -> u16 {
        self.wiring.main(self.power.place() / self.step_rad(), self.power.is_enabled())
    }

    /// The status code.
    pub(super) fn status(&self) -> u16 {
        let homing = match self.motion {
            Motion::Going { homing, .. } => homing,
            Motion::Searching(search) => search.is_homing(),
            Motion::Stopping { back, .. } => back.is_some(),
            _ => false,
        };
        let stopping = matches!(self.motion, Motion::Stopping { .. });
        let jogging = matches!(self.motion, Motion::Jogging | Motion::Stopping { jogging: true, .. });
        let moving = self.motion != Motion::Idle && !jogging;
        let there = self.enabled && self.motion == Motion::Idle && self.kind == Kind::StepServo;
        set_bits([
            (self.enabled, 0x0001),
            (self.alarms & alarm::FAULTS != 0, 0x0004),
            (there, 0x0008),
            (moving || jogging && self.firmware.moving_while_jogging, 0x0010),
            (jogging, 0x0020),
            (stopping, 0x0040),
            (self.saving_ns.is_some(), 0x0100),
            (self.alarms != 0, 0x0200),
            (homing, 0x0400),
            (self.program_ns.is_some(), 0x4000),
        ])
    }

    /// Position error, encoder counts; 0 without an encoder.
    pub(super) fn error(&self) -> i32 {
        let error = (self.power.demand() - self.power.place()) / self.step_rad();
        self.motor.encoder.map_or(0, |ratio| (error * ratio).round() as i32)
    }

    /// The commanded position, steps.
    pub(super) fn absolute(&self) -> i32 {
        wrapped((self.power.demand() - self.power.zero) / self.step_rad())
    }

    /// What it reports.
    pub(super) fn report(&self) -> Report {
        let ratio = self.motor.encoder;
        let turns = self.motion != Motion::Idle;
        let current = match (self.enabled, turns) {
            (false, _) => 0,
            (true, false) => self.motor.current_ma / 2,
            (true, true) => self.motor.current_ma,
        };
        let counts = (self.power.place() - self.encoder_zero) / self.step_rad();
        Report {
            status: self.status(),
            alarm: self.alarms,
            voltage: self.motor.voltage.saturating_sub(if turns { 2 } else { 0 }),
            current: current.min(i16::MAX as u16) as i16,
            temperature: self.motor.temperature.saturating_add(self.warmth.round() as i16),
            encoder: ratio.map_or(0, |ratio| wrapped(counts * ratio)),
            absolute: self.absolute(),
            error: self.error(),
            velocity: ratio.map_or(0, |_| (self.power.speed() / RPM * 4.0).round() as i32),
            extended: 0,
            main: self.inputs(),
            outputs: self.wiring.outputs(),
            analog: self.motor.analog,
        }
    }

    /// What the motor really does, in steps.
    pub(super) fn truth(&self) -> Truth {
        self.power.truth(self.enabled, self.step_rad())
    }
}

/// A count of 32 bits that goes round.
fn wrapped(count: f64) -> i32 {
    count.round() as i64 as i32
}
