//! The drive behind the messages: parameters, sequencer and motor together.
//!
//! Knows no bytes and no connections. Time comes in steps.

use std::f64::consts::TAU;

use super::codec::{control, status as W};
use super::database::Database;
use super::motor::{Demand, Motor};
use super::sequencer::{self, Sequencer};
use super::settings::{Start, UnidriveSettings};
use super::table::{self, Variable};
use crate::Truth;
use crate::power::set_bits;
use fieldbeat_core::time::{MS, Time};

/// Steps in which a drive that is found running has reached its speed: 60 s.
const RUN_UP: (u32, u64) = (600, 100 * MS);

/// A drive with its motor.
#[derive(Debug)]
pub(super) struct Drive {
    pub parameters: Database,
    pub sequencer: Sequencer,
    motor: Motor,
}

impl Drive {
    pub(super) fn new(settings: &UnidriveSettings) -> Drive {
        let mut motor = Motor::new(settings);
        let sequencer = Sequencer::new(settings, &mut motor.power);
        let mut drive = Drive { parameters: Database::new(settings), sequencer, motor };
        match settings.start {
            Start::Idle => {}
            Start::Tripped(trip) => drive.trip(trip),
            Start::Running(speed) => drive.run_up(speed),
        }
        drive
    }

    /// As another master has left it.
    fn run_up(&mut self, speed: f64) {
        let word = match speed {
            0.0 => control::ENABLED,
            ..0.0 => control::BACKWARD,
            _ => control::FORWARD,
        };
        self.parameters.set(table::CONTROL_WORD_ENABLE, 1);
        self.write(table::PRESET, (speed.abs() * 10.0).round() as i32);
        self.write(table::CONTROL_WORD, word.into());
        (0..RUN_UP.0).for_each(|_| self.step(RUN_UP.1));
    }

    /// Power came back: everything volatile is lost, the motor goes on turning as it did.
    pub(super) fn restart(&mut self) {
        self.parameters.restart();
        self.sequencer.restart(&mut self.motor.power);
    }

    /// The real state of the motor, in revolutions.
    pub(super) fn truth(&self) -> Truth {
        self.motor.power.truth(self.sequencer.is_active(), TAU)
    }

    /// Trips the drive.
    pub(super) fn trip(&mut self, trip: u16) {
        self.sequencer.trip(&mut self.motor.power, trip);
    }

    /// Opens the hardware enable until then.
    pub(super) fn open_sto(&mut self, until: Time) {
        self.motor.power.open_sto(until);
    }

    /// Advances to `now`, in whole scans.
    pub(super) fn advance(&mut self, now: Time) {
        while let Some(dt_ns) = self.motor.power.advance(now) {
            self.step(dt_ns);
        }
    }

    fn step(&mut self, dt_ns: u64) {
        let standing = self.is_standing();
        self.sequencer.step(dt_ns, &self.parameters, &mut self.motor.power, standing);
        let demand = self.sequencer.is_active().then(|| self.demand());
        self.motor.step(demand, dt_ns);
    }

    /// The demand of the motor.
    fn demand(&self) -> Demand {
        let number = |place| f64::from(self.parameters.get(place));
        // A rate of 0 is no ramp, and so is a ramp that is switched off. Rates are ms to 1000 rpm.
        let rate = |place| match self.parameters.is_on(table::RAMP_ENABLE) {
            true => 1e6 / number(place),
            false => f64::INFINITY,
        };
        let is_hard = self.sequencer.is_running() && self.parameters.is_on(table::HARD_SELECT);
        Demand {
            speed: f64::from(self.sequencer.pre_ramp(&self.parameters)) / 10.0,
            hard: if is_hard { number(table::HARD_REFERENCE) / 10.0 } else { 0.0 },
            acceleration: rate(table::ACCELERATION),
            deceleration: rate(table::DECELERATION),
            limit: number(table::TORQUE_LIMIT) / 10.0,
        }
    }

    /// Within the zero speed threshold.
    fn is_standing(&self) -> bool {
        self.motor.speed().abs() <= f64::from(self.parameters.get(table::ZERO_SPEED))
    }

    /// The value of the parameter at this index.
    pub(super) fn read(&self, place: usize) -> i32 {
        let row = self.parameters.row(place);
        match row.variable {
            None => self.parameters.get(place),
            Some(variable) => row.clamp(self.value(variable)),
        }
    }

    /// Writes a value; false if it cannot be written.
    pub(super) fn write(&mut self, place: usize, value: i32) -> bool {
        if !self.parameters.row(place).takes(value) {
            return false;
        }
        let before = self.parameters.get(place);
        self.parameters.set(place, value);
        let resets = match place {
            table::CONTROL_WORD => self.control(before, value),
            table::RESET => before == 0 && value == 1,
            table::USER_TRIP => {
                self.parameters.set(place, 0);
                self.sequencer.user_trip(&mut self.motor.power, value as u16)
            }
            _ => false,
        };
        if resets {
            self.motor.power.reset();
            self.parameters.reset();
        }
        true
    }

    /// The control word was written; whether it resets the drive.
    fn control(&mut self, before: i32, word: i32) -> bool {
        if let Some(word) = sequencer::obeyed(&self.parameters) {
            self.parameters.set(table::REMOTE, (word & control::REMOTE != 0).into());
        }
        self.parameters.is_on(table::CONTROL_WORD_ENABLE)
            && self.sequencer.control(&mut self.motor.power, before as u16, word as u16)
    }

    fn value(&self, variable: Variable) -> i32 {
        let motor = &self.motor;
        let tenths = |value: f64| (value * 10.0).round() as i32;
        match variable {
            Variable::Selected => sequencer::selected(&self.parameters),
            Variable::PreRamp => self.sequencer.pre_ramp(&self.parameters),
            Variable::PostRamp => tenths(motor.ramp()),
            Variable::FinalSpeed => tenths(motor.reference()),
            Variable::Speed => tenths(self.motor.speed()),
            Variable::SpeedError => tenths(motor.reference() - self.motor.speed()),
            Variable::Current => (motor.current() * 1e3).round() as i32,
            Variable::Load => tenths(motor.load_percent()),
            Variable::Frequency => tenths(motor.frequency()),
            Variable::DcBus => motor.dc_bus().round() as i32,
            Variable::HardwareEnable => self.motor.power.is_enabled().into(),
            Variable::Status => self.status().into(),
            Variable::StatusBit(bit) => (self.status() >> bit & 1).into(),
            Variable::Trip(index) => self.sequencer.logged(index).into(),
        }
    }

    /// The status word. Braking transistor, its resistor and the mains are always in order.
    fn status(&self) -> u16 {
        let number = |place| f64::from(self.parameters.get(place));
        let active = self.sequencer.is_active();
        let running = active && self.sequencer.is_running();
        let speed = self.motor.speed();
        let set = f64::from(self.sequencer.pre_ramp(&self.parameters)) / 10.0;
        let below = speed.abs() < set.abs() - number(table::AT_SPEED_BELOW);
        let above = speed.abs() > set.abs() + number(table::AT_SPEED_ABOVE);
        let minimum = (number(table::MINIMUM_REFERENCE) / 10.0).max(0.0) + number(table::ZERO_SPEED);
        let load = self.motor.load_percent();
        set_bits([
            (self.motor.power.fault().is_none(), W::HEALTHY),
            (active, W::ACTIVE),
            (self.is_standing(), W::ZERO_SPEED),
            (speed.abs() <= minimum, W::AT_MINIMUM),
            (running && below, W::BELOW_SPEED),
            (running && !below && !above, W::AT_SPEED),
            (running && above, W::ABOVE_SPEED),
            (active && load.abs() >= 100.0, W::LOAD_REACHED),
            (self.motor.limited(), W::CURRENT_LIMIT),
            (active && !self.is_standing() && load < 0.0, W::REGENERATING),
            (self.sequencer.is_reversed(), W::REVERSE_COMMANDED),
            (speed < 0.0 && !self.is_standing(), W::REVERSE_RUNNING),
        ])
    }
}
