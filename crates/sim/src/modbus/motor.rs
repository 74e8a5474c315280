//! The ramp and the motor behind it.
//!
//! Knows no parameter and no control word: speeds are rpm, ramps are rpm/s. The speed controller is ideal: the motor
//! follows the ramp as long as the torque limit lets it.

use super::settings::{MotorSettings, UnidriveSettings};
use crate::physics::PlantPlan;
use crate::power::{Aim, PowerDrive, PowerPlan, RPM};
use fieldbeat_core::time::{MS, S};

/// One scan of sequencer and motor; also the drive's reaction time.
const SCAN_NS: u64 = MS;

/// The current of the motor at its rated torque, A, and its pole pairs.
const RATED_CURRENT: f64 = 3.0;
const POLE_PAIRS: f64 = 3.0;

/// The DC bus of a drive on 400 V mains, V.
const DC_BUS: f64 = 565.0;

/// The demand of an active drive to its motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Demand {
    /// The target of the ramp, rpm.
    pub speed: f64,
    /// An offset added after the ramp, rpm.
    pub hard: f64,
    /// rpm/s, over 0.
    pub acceleration: f64,
    /// rpm/s, over 0.
    pub deceleration: f64,
    /// Largest torque, % of the rated one.
    pub limit: f64,
}

/// A motor on its drive.
#[derive(Debug)]
pub(super) struct Motor {
    settings: MotorSettings,
    pub(super) power: PowerDrive<u16>,
    /// Post-ramp reference, rpm.
    ramp: f64,
    /// The same with the added offset.
    reference: f64,
    /// The torque of the motor, N m.
    torque: f64,
    /// The torque limit holds the motor back.
    limited: bool,
}

impl Motor {
    /// Stands still, without power.
    pub(super) fn new(drive: &UnidriveSettings) -> Motor {
        let settings = drive.motor.clone();
        let plant = PlantPlan {
            mass_kg: settings.inertia_kgm2,
            range: (f64::NEG_INFINITY, f64::INFINITY),
            peak_force_n: f64::INFINITY,
            friction_n: settings.friction_nm,
            ..PlantPlan::default()
        };
        let power = PowerDrive::new(PowerPlan {
            plant,
            max_speed: f64::INFINITY,
            hardware_enable: drive.hardware_enable,
            scan_ns: Some(SCAN_NS),
        });
        Motor { settings, power, ramp: 0.0, reference: 0.0, torque: 0.0, limited: false }
    }

    /// Lets `dt_ns` pass; `None`: without power.
    pub(super) fn step(&mut self, demand: Option<Demand>, dt_ns: u64) {
        let dt = dt_ns as f64 / S as f64;
        match demand {
            Some(demand) => {
                self.ramp = ramped(self.ramp, &demand, dt);
                self.reference = self.ramp + demand.hard;
                self.push(demand.limit, dt);
            }
            None => (self.torque, self.limited) = (0.0, false),
        }
        self.power.load = self.load(dt);
        let aim = demand.map_or(Aim::Off, |_| Aim::Torque(self.torque));
        self.power.step(aim, dt_ns);
        if demand.is_none() {
            // A motor that is switched on while it turns is caught at its speed.
            self.ramp = self.speed();
            self.reference = self.ramp;
        }
    }

    /// The torque that brings the motor to its reference within this step, as far as the limit allows.
    fn push(&mut self, limit: f64, dt: f64) {
        let reference = self.reference * RPM;
        let missing = reference - self.power.speed();
        let turning = if self.power.speed() == 0.0 { missing } else { self.power.speed() };
        let wanted =
            missing * self.settings.inertia_kgm2 / dt + self.drag() * reference + self.friction(turning);
        let most = limit / 100.0 * self.settings.rated_nm;
        self.torque = wanted.max(-most).min(most);
        self.limited = wanted.abs() > most;
    }

    /// The load torque at the speed that this step leads to, N m: an implicit Euler step, stable at any length.
    fn load(&self, dt: f64) -> f64 {
        let speed = self.power.speed();
        let gain = (self.torque - self.friction(speed)) * dt / self.settings.inertia_kgm2;
        self.drag() * (speed + gain) / (1.0 + self.drag() * dt / self.settings.inertia_kgm2)
    }

    /// The load, N m per rad/s.
    fn drag(&self) -> f64 {
        self.settings.load_nm / (self.settings.rated_rpm * RPM)
    }

    /// The dry friction against turning in this direction, N m.
    fn friction(&self, turning: f64) -> f64 {
        if turning == 0.0 { 0.0 } else { self.settings.friction_nm.copysign(turning) }
    }

    /// Speed of the motor, rpm.
    pub(super) fn speed(&self) -> f64 {
        self.power.speed() / RPM
    }

    /// Post-ramp reference, rpm.
    pub(super) fn ramp(&self) -> f64 {
        self.ramp
    }

    /// Final speed reference, rpm.
    pub(super) fn reference(&self) -> f64 {
        self.reference
    }

    /// Torque, % of the rated one; against the direction of turning it is negative.
    pub(super) fn load_percent(&self) -> f64 {
        let percent = self.torque / self.settings.rated_nm * 100.0;
        if self.speed() < 0.0 { -percent } else { percent }
    }

    /// Current, A.
    pub(super) fn current(&self) -> f64 {
        (self.torque / self.settings.rated_nm).abs() * RATED_CURRENT
    }

    /// Output frequency, Hz.
    pub(super) fn frequency(&self) -> f64 {
        self.speed() / 60.0 * POLE_PAIRS
    }

    /// DC bus voltage, V.
    pub(super) fn dc_bus(&self) -> f64 {
        DC_BUS
    }

    /// The torque limit holds it back.
    pub(super) fn limited(&self) -> bool {
        self.limited
    }
}

/// The ramp `dt` seconds later: towards zero with the deceleration, away from it with the acceleration.
fn ramped(from: f64, demand: &Demand, dt: f64) -> f64 {
    let Demand { speed, acceleration, deceleration, .. } = *demand;
    if from * speed < 0.0 || speed.abs() < from.abs() {
        // Down to the new speed, or to zero and up on the other side in the remaining time.
        let end = if from * speed < 0.0 { 0.0 } else { speed };
        let needed = (from - end).abs() / deceleration;
        if dt < needed {
            return from - (deceleration * dt).copysign(from);
        }
        return if end == speed { speed } else { ramped(end, demand, dt - needed) };
    }
    let way = speed - from;
    if way.abs() <= acceleration * dt { speed } else { from + (acceleration * dt).copysign(way) }
}
