//! The drive's reports: status words and actual values.

use super::*;

/// Bits of the manufacturer's status, 1002h (CAN manual).
mod manufacturer {
    pub const MOTION: u32 = 1 << 0;
    pub const REFERENCE: u32 = 1 << 1;
    pub const IN_POSITION: u32 = 1 << 3;
    pub const POWER: u32 = 1 << 14;
    pub const ERROR: u32 = 1 << 15;
    pub const EMERGENCY_STOP: u32 = 1 << 19;
}

impl Drive {
    pub(super) fn status(&self) -> StatusWord {
        use StatusWord as W;
        let powered = self.state.is_powered();
        let runs = self.state == State::OperationEnabled;
        let started = self.control.is_some_and(|word| word.has(ControlWord::START));
        let (bit_12, bit_13) = match self.mode() {
            Mode::PROFILE_POSITION => (self.acknowledged, false),
            Mode::HOMING => (self.homing == Homing::Done, self.homing == Homing::Failed),
            Mode::INTERPOLATED => (started, false),
            _ => (false, false),
        };
        let bits = set_bits([
            (powered, W::VOLTAGE),
            (!self.sync.is_synchronous(), W::WARNING),
            (self.is_reached(), W::TARGET_REACHED),
            (runs && bit_12, W::MODE_12),
            (runs && bit_13, W::MODE_13),
        ]);
        W::of(self.state).with(W::REMOTE | bits)
    }

    fn manufacturer_status(&self) -> u32 {
        use manufacturer as M;
        set_bits([
            (!self.power.is_standing(), M::MOTION),
            (self.power.homed, M::REFERENCE),
            (self.is_reached(), M::IN_POSITION),
            (self.state.is_powered(), M::POWER),
            (self.power.fault().is_some(), M::ERROR),
            (self.state == State::QuickStopActive, M::EMERGENCY_STOP),
        ])
    }

    /// Actual values. The status word is constant outside of SAFEOP and OP (EtherCAT manual).
    pub(super) fn refresh(&mut self) {
        let angle = self.power.position();
        let increments = counts(angle, self.settings.increments().into());
        let behind = counts(self.power.demand() - self.power.place(), self.per_turn());
        let rpm = self.rpm();
        let torque = self.power.torque() / self.settings.motor.rated_nm * 1e3;
        let fault = self.power.fault();
        for (object, value) in [
            (ERROR_REGISTER, fault.map_or(0, |fault| fault.error_register().into())),
            (ERROR_CODE, fault.map_or(0, |fault| fault.code.into())),
            (MANUFACTURER_STATUS, self.manufacturer_status().into()),
            (MODE_DISPLAY, self.mode().0.into()),
            (INCREMENTS, increments),
            (POSITION_2, increments),
            (POSITION, self.position()),
            (VELOCITY, (rpm / self.settings.rpm_per_count).round() as i64),
            (INCREMENTAL_SPEED, (rpm / INCREMENTAL_RPM).round() as i64),
            (TORQUE, torque.round() as i64),
            (FOLLOWING_ERROR, behind),
            (OUTPUT_CYCLE, self.cycle_ns.unwrap_or_default() as i64),
            (INPUT_CYCLE, self.cycle_ns.unwrap_or_default() as i64),
        ] {
            self.objects.set(object, value);
        }
        if self.is_cyclic() {
            self.objects.set(STATUS_WORD, self.status().0.into());
        }
    }
}
