//! The motor, its load, and the setpoint generator in front of it.
//!
//! Knows no object and no state: angles are rad, speeds rad/s, torques N m.

use std::f64::consts::TAU;
use std::mem::discriminant;

use super::settings::MotorSettings;
use crate::sim::physics::{Generator, Plant, PlantPlan};
use crate::time::S;

/// rad/s of 1 rpm.
pub(super) const RPM: f64 = TAU / 60.0;
/// Bandwidth of the position controller, Hz.
const BANDWIDTH_HZ: f64 = 60.0;

/// The demand of the drive to its motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Aim {
    /// No power: it coasts.
    Off,
    /// Towards this speed, rad/s, up and down with so many rad/s^2.
    Velocity { speed: f64, up: f64, down: f64 },
    /// At this position at this speed, now.
    Follow { place: f64, speed: f64 },
    /// Moves there and stops.
    GoTo { place: f64, speed: f64, up: f64, down: f64 },
    /// Torque control, N m.
    Torque(f64),
}

/// A motor on its drive.
#[derive(Debug)]
pub(super) struct Motor {
    plant: Plant,
    generator: Generator,
    aim: Aim,
    peak_nm: f64,
    max_speed: f64,
}

impl Motor {
    /// Stands at 0, without power.
    pub(super) fn new(settings: &MotorSettings) -> Motor {
        let peak_nm = settings.peak_permille / 1e3 * settings.rated_nm;
        let plant = Plant::new(PlantPlan {
            mass_kg: settings.inertia_kgm2,
            range: (f64::NEG_INFINITY, f64::INFINITY),
            bandwidth_hz: BANDWIDTH_HZ,
            damping: 1.0,
            feed_forward: 1.0,
            peak_force_n: peak_nm,
            friction_n: settings.friction_nm,
        });
        Motor {
            plant,
            generator: Generator::at(0.0),
            aim: Aim::Off,
            peak_nm,
            max_speed: settings.max_rpm * RPM,
        }
    }

    /// Lets `dt_ns` pass.
    pub(super) fn step(&mut self, aim: Aim, dt_ns: u64) {
        if aim != self.aim {
            // A motor that is switched on while it turns, or gets another demand, begins at its present motion.
            if discriminant(&aim) != discriminant(&self.aim) {
                self.generator.set(self.plant.position(), self.plant.velocity(), 0.0);
            }
            self.plan(aim);
            self.aim = aim;
        }
        match aim {
            Aim::Off => self.plant.advance(0.0, 0.0, 0.0, dt_ns, false),
            Aim::Torque(torque) => self.push(torque, dt_ns),
            Aim::Velocity { .. } | Aim::Follow { .. } | Aim::GoTo { .. } => self.control(dt_ns),
        }
    }

    /// The motor follows the setpoint generator.
    fn control(&mut self, dt_ns: u64) {
        self.generator.advance(dt_ns);
        let demand = &self.generator;
        let place = match self.aim {
            // A missed position is not caught up with.
            Aim::Velocity { .. } => self.plant.position() + demand.velocity() * dt_ns as f64 / S as f64,
            _ => demand.position(),
        };
        self.plant.advance(place, demand.velocity(), demand.acceleration(), dt_ns, true);
    }

    fn plan(&mut self, aim: Aim) {
        let most = self.max_speed;
        let within = |speed: f64| speed.max(-most).min(most);
        match aim {
            Aim::Velocity { speed, up, down } => {
                let (now, speed) = (self.generator.velocity(), within(speed));
                let slower = now * speed < 0.0 || speed.abs() < now.abs();
                self.generator.run(speed, if slower { down } else { up });
            }
            Aim::Follow { place, speed } => self.generator.set(place, speed, 0.0),
            Aim::GoTo { place, speed, up, down } => self.generator.go_to(place, within(speed), up, down),
            Aim::Off | Aim::Torque(_) => {}
        }
    }

    /// Torque control, within the speed limit of the motor.
    fn push(&mut self, torque: f64, dt_ns: u64) {
        let speed = self.plant.velocity();
        let fast = speed.abs() >= self.max_speed && speed * torque > 0.0;
        let torque = if fast { 0.0 } else { torque.max(-self.peak_nm).min(self.peak_nm) };
        self.plant.advance_with_force(torque, dt_ns);
    }

    /// Largest torque, N m.
    pub(super) fn limit_torque(&mut self, torque: f64) {
        self.plant.limit_force(Some(torque));
    }

    /// Where it is, rad.
    pub(super) fn place(&self) -> f64 {
        self.plant.position()
    }

    /// Its speed, rad/s.
    pub(super) fn speed(&self) -> f64 {
        self.plant.velocity()
    }

    /// Its torque, N m.
    pub(super) fn torque(&self) -> f64 {
        self.plant.force()
    }

    /// Its demand position, rad: the actual one, if only its speed or its torque is controlled.
    pub(super) fn demand(&self) -> f64 {
        match self.aim {
            Aim::Follow { .. } | Aim::GoTo { .. } => self.generator.position(),
            Aim::Off | Aim::Velocity { .. } | Aim::Torque(_) => self.plant.position(),
        }
    }

    /// The setpoint generator is under way.
    pub(super) fn is_moving(&self) -> bool {
        self.generator.is_moving()
    }

    /// It turns slower than 1 rpm.
    pub(super) fn is_standing(&self) -> bool {
        self.speed().abs() < RPM
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::MS;

    fn motor() -> Motor {
        Motor::new(&MotorSettings::default())
    }

    /// Lets so many milliseconds pass.
    fn run(motor: &mut Motor, aim: Aim, ms: u64) {
        (0..ms).for_each(|_| motor.step(aim, MS));
    }

    #[test]
    fn it_comes_up_to_speed_with_its_ramp_and_down_with_the_other() {
        let mut motor = motor();
        let up = Aim::Velocity { speed: 100.0, up: 1_000.0, down: 500.0 };
        run(&mut motor, up, 50);
        assert!((motor.speed() - 50.0).abs() < 2.0, "{}", motor.speed());
        run(&mut motor, up, 200);
        assert!((motor.speed() - 100.0).abs() < 0.1);
        run(&mut motor, Aim::Velocity { speed: 0.0, up: 1_000.0, down: 500.0 }, 100);
        assert!((motor.speed() - 50.0).abs() < 2.0, "{}", motor.speed());
        run(&mut motor, Aim::Velocity { speed: 0.0, up: 1_000.0, down: 500.0 }, 300);
        assert!(motor.is_standing());
    }

    #[test]
    fn torque_divided_by_inertia_is_its_acceleration() {
        let mut motor = motor();
        run(&mut motor, Aim::Torque(1.1), 100);
        // 1.1 N m less 0.1 of friction, on 0.002 kg m^2, for 0.1 s.
        assert!((motor.speed() - 50.0).abs() < 0.5, "{}", motor.speed());
        run(&mut motor, Aim::Torque(1e9), 10_000);
        assert!(motor.speed() < 6_200.0 * RPM, "{}", motor.speed() / RPM);
    }

    #[test]
    fn without_power_it_runs_out_and_is_caught_at_its_speed() {
        let mut motor = motor();
        run(&mut motor, Aim::Velocity { speed: 100.0, up: 1e4, down: 1e4 }, 200);
        run(&mut motor, Aim::Off, 500);
        let coasting = motor.speed();
        assert!((70.0..80.0).contains(&coasting), "{coasting}");
        motor.step(Aim::Velocity { speed: coasting, up: 1.0, down: 1.0 }, MS);
        assert!(motor.torque().abs() < 0.5, "{}", motor.torque());
    }

    #[test]
    fn it_follows_places_and_goes_to_one() {
        let mut motor = motor();
        run(&mut motor, Aim::GoTo { place: 10.0, speed: 100.0, up: 1_000.0, down: 1_000.0 }, 1_000);
        assert!((motor.place() - 10.0).abs() < 1e-3 && !motor.is_moving());
        let place = |ms: u64| 10.0 + ms as f64 * 0.01;
        for ms in 0..1_000 {
            motor.step(Aim::Follow { place: place(ms), speed: 10.0 }, MS);
        }
        assert!((motor.place() - place(999)).abs() < 0.01, "{}", motor.place());
    }
}
