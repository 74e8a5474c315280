//! The drive's reports: status words and actual values.

use super::*;

/// In the error register: there is a fault.
const GENERIC: u8 = 1 << 0;

impl Drive {
    pub(super) fn status(&self) -> u16 {
        use cia402::status as bit;
        let powered = self.state.is_powered();
        let runs = self.state == State::OperationEnabled;
        let started = self.control.is_some_and(|word| word & control::START != 0);
        let (bit_12, bit_13) = match self.mode() {
            mode::PROFILE_POSITION => (self.acknowledged, false),
            mode::HOMING => (self.homing == Homing::Done, self.homing == Homing::Failed),
            mode::INTERPOLATED => (started, false),
            _ => (false, false),
        };
        let bits = set_bits([
            (powered, bit::VOLTAGE),
            (!self.sync.synchronous, bit::WARNING),
            (self.is_reached(), bit::TARGET_REACHED),
            (runs && bit_12, bit::MODE_12),
            (runs && bit_13, bit::MODE_13),
        ]);
        cia402::status_of(self.state) | bit::REMOTE | bits
    }

    fn manufacturer_status(&self) -> u32 {
        use crate::ethercat::codec::objects::manufacturer as M;
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
            (ERROR_REGISTER, fault.map_or(0, |code| i64::from(error_register(code) | GENERIC))),
            (ERROR_CODE, fault.map_or(0, i64::from)),
            (MANUFACTURER_STATUS, self.manufacturer_status().into()),
            (MODE_DISPLAY, self.mode().into()),
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
            self.objects.set(STATUS_WORD, self.status().into());
        }
    }
}
