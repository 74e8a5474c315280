//! One simulated power drive, on which the drives of every protocol stand: a motor with its setpoint generator, the
//! hardware enable, the standing fault, and its time.
//!
//! Knows no protocol: states, their words and the commands are those of the drive on top. SI units: m, m/s, N; for a
//! rotary axis rad, rad/s, N m. Positions are those of the motor; the drive's own are counted from `zero`.

use std::f64::consts::TAU;
use std::mem::discriminant;

use super::Truth;
use super::physics::{Generator, Plant, PlantPlan};
use fieldbeat_core::time::{S, Time, US};

/// rad/s of 1 rpm.
pub(super) const RPM: f64 = TAU / 60.0;

/// One step of motor and states, unless the plan has another one; also the drive's reaction time.
const STEP_NS: u64 = 500 * US;
/// After a silence the drive advances through so much of it in such steps ...
const FINE_NS: u64 = S;
/// ... and through the rest in at most so many longer ones. By then every watchdog has expired and every stop has
/// ended, and profiles do not depend on the step.
const COARSE_STEPS: u64 = 1_000;

/// The demand of a drive to its motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Aim {
    /// No power: it coasts.
    Off,
    /// Towards this speed, up and down with these accelerations.
    Velocity { speed: f64, up: f64, down: f64 },
    /// At this position with this speed and acceleration, now.
    Follow { place: f64, speed: f64, acceleration: f64 },
    /// Moves there and stops.
    GoTo { place: f64, speed: f64, up: f64, down: f64 },
    /// Torque or force control.
    Torque(f64),
}

/// When a fault can be reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Reset {
    /// Whenever the drive lets it be.
    Always,
    /// So many ns after it occurred.
    After(u64),
    /// Not before power comes back.
    Never,
}

/// The properties of a power drive.
#[derive(Clone, Debug)]
pub(super) struct PowerPlan {
    pub plant: PlantPlan,
    /// The speed that its setpoints and its torque control keep within.
    pub max_speed: f64,
    /// The hardware enable (STO) is wired and closed.
    pub hardware_enable: bool,
    /// The scan time of a drive that advances in whole scans only, ns.
    pub scan_ns: Option<u64>,
}

/// A power drive, with faults of the type `F`.
#[derive(Debug)]
pub(super) struct PowerDrive<F> {
    plan: PowerPlan,
    plant: Plant,
    generator: Generator,
    aim: Aim,
    /// The load on the motor, against positive torque. Counts without power and in torque control; a position
    /// controller compensates it.
    pub load: f64,
    /// The motor's position where the drive counts 0.
    pub zero: f64,
    /// It has its reference.
    pub homed: bool,
    /// The hardware enable is open until then, whatever happens to the drive.
    open_until: Time,
    /// The first fault that occurred, how it can be reset, and when it occurred.
    fault: Option<(F, Reset, Time)>,
    /// The instants up to which it has advanced, of its first moment, and at which power came back.
    now: Option<Time>,
    begun: Option<Time>,
    restarted: Option<Time>,
    /// While it advances: the end of the fine steps, and the length of the others.
    pace: Option<(Time, u64)>,
}

impl<F: Copy> PowerDrive<F> {
    /// Stands at 0, or at the end of its range next to it, without power. Its time begins with the first
    /// [`advance`](Self::advance).
    pub(super) fn new(plan: PowerPlan) -> PowerDrive<F> {
        let plant = Plant::new(plan.plant.clone());
        PowerDrive {
            generator: Generator::at(plant.position()),
            plant,
            plan,
            aim: Aim::Off,
            load: 0.0,
            zero: 0.0,
            homed: false,
            open_until: Time(0),
            fault: None,
            now: None,
            begun: None,
            restarted: None,
            pace: None,
        }
    }

    /// The next step towards `now`: its length, ns. The drive on top then follows it with a [`step`](Self::step).
    pub(super) fn advance(&mut self, now: Time) -> Option<u64> {
        let at = *self.now.get_or_insert(now);
        self.begun.get_or_insert(now);
        let step_ns = self.plan.scan_ns.unwrap_or(STEP_NS);
        let (fine_end, coarse_ns) = *self.pace.get_or_insert_with(|| {
            let fine_end = at + FINE_NS;
            (fine_end, (now.since(fine_end) / COARSE_STEPS).max(step_ns))
        });
        let dt_ns = if at < fine_end { step_ns } else { coarse_ns };
        let left_ns = now.since(at);
        let dt_ns = if self.plan.scan_ns.is_some() { dt_ns } else { dt_ns.min(left_ns) };
        if left_ns == 0 || left_ns < dt_ns {
            self.pace = None;
            return None;
        }
        self.now = Some(at + dt_ns);
        Some(dt_ns)
    }

    /// The instant up to which it has advanced.
    pub(super) fn now(&self) -> Time {
        self.now.unwrap_or_default()
    }

    /// Since its first moment, ns.
    pub(super) fn age_ns(&self) -> u64 {
        self.now().since(self.begun.unwrap_or_default())
    }

    /// Since power came on, ns.
    pub(super) fn on_ns(&self) -> u64 {
        self.now().since(self.restarted.or(self.begun).unwrap_or_default())
    }

    /// Power came back: fault and reference are lost, the motor goes on turning as it did.
    pub(super) fn restart(&mut self) {
        (self.restarted, self.fault, self.homed) = (self.now, None, false);
    }

    /// Opens the hardware enable until then.
    pub(super) fn open_sto(&mut self, until: Time) {
        self.open_until = until;
    }

    /// The hardware enable is closed.
    pub(super) fn is_enabled(&self) -> bool {
        self.plan.hardware_enable && self.now() >= self.open_until
    }

    /// A fault occurs; false: one stands already, and stays.
    pub(super) fn fail(&mut self, fault: F, reset: Reset) -> bool {
        let is_first = self.fault.is_none();
        if is_first {
            self.fault = Some((fault, reset, self.now()));
        }
        is_first
    }

    /// The standing fault.
    pub(super) fn fault(&self) -> Option<F> {
        self.fault.map(|(fault, ..)| fault)
    }

    /// Resets the fault; false: there is none, or it cannot be reset now.
    pub(super) fn reset(&mut self) -> bool {
        let now = self.now();
        let ends = |(_, reset, since): &mut (F, Reset, Time)| match *reset {
            Reset::Always => true,
            Reset::After(ns) => now.since(*since) >= ns,
            Reset::Never => false,
        };
        self.fault.take_if(ends).is_some()
    }

    /// Lets `dt_ns` pass.
    pub(super) fn step(&mut self, aim: Aim, dt_ns: u64) {
        if aim != self.aim {
            // A motor that is switched on while it turns, or gets another kind of demand, begins at its present motion.
            if discriminant(&aim) != discriminant(&self.aim) {
                self.generator.set(self.plant.position(), self.plant.velocity(), 0.0);
            }
            self.set(aim);
            self.aim = aim;
        }
        match aim {
            Aim::Off => self.plant.advance_with_force(-self.load, dt_ns),
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
        self.plant.advance(place, demand.velocity(), demand.acceleration(), dt_ns);
    }

    fn set(&mut self, aim: Aim) {
        let most = self.plan.max_speed;
        let within = |speed: f64| speed.max(-most).min(most);
        match aim {
            Aim::Velocity { speed, up, down } => {
                let (now, speed) = (self.generator.velocity(), within(speed));
                let slower = now * speed < 0.0 || speed.abs() < now.abs();
                self.generator.run(speed, if slower { down } else { up });
            }
            Aim::Follow { place, speed, acceleration } => self.generator.set(place, speed, acceleration),
            Aim::GoTo { place, speed, up, down } => self.generator.go_to(place, within(speed), up, down),
            Aim::Off | Aim::Torque(_) => {}
        }
    }

    /// Torque control, within the speed limit of the motor.
    fn push(&mut self, torque: f64, dt_ns: u64) {
        let (speed, peak) = (self.plant.velocity(), self.plan.plant.peak_force_n);
        let fast = speed.abs() >= self.plan.max_speed && speed * torque > 0.0;
        let torque = if fast { 0.0 } else { torque.max(-peak).min(peak) };
        self.plant.advance_with_force(torque - self.load, dt_ns);
    }

    /// The largest torque from now on, for all but torque control; `None`: that of the plan.
    pub(super) fn limit_torque(&mut self, torque: Option<f64>) {
        self.plant.limit_force(torque);
    }

    /// Puts the motor there, standing.
    pub(super) fn put(&mut self, place: f64) {
        self.plant.set_position(place);
    }

    /// The position of the motor.
    pub(super) fn place(&self) -> f64 {
        self.plant.position()
    }

    /// The position as the drive counts it.
    pub(super) fn position(&self) -> f64 {
        self.place() - self.zero
    }

    /// Its speed.
    pub(super) fn speed(&self) -> f64 {
        self.plant.velocity()
    }

    /// Its torque.
    pub(super) fn torque(&self) -> f64 {
        self.plant.force()
    }

    /// Its demand position: the actual one, if only its speed or its torque is controlled.
    pub(super) fn demand(&self) -> f64 {
        match self.aim {
            Aim::Follow { .. } | Aim::GoTo { .. } => self.generator.position(),
            Aim::Off | Aim::Velocity { .. } | Aim::Torque(_) => self.place(),
        }
    }

    /// The setpoint generator is under way.
    pub(super) fn is_moving(&self) -> bool {
        self.generator.is_moving()
    }

    /// A rotary motor turns slower than 1 rpm.
    pub(super) fn is_standing(&self) -> bool {
        self.speed().abs() < RPM
    }

    /// Its true state in counts of this length.
    pub(super) fn truth(&self, powered: bool, count: f64) -> Truth {
        Truth {
            powered,
            homed: self.homed,
            position: self.position() / count,
            velocity: self.speed() / count,
        }
    }
}

/// The word of those bits that are set.
pub(super) fn set_bits<T: Default + std::ops::BitOr<Output = T>>(
    bits: impl IntoIterator<Item = (bool, T)>,
) -> T {
    bits.into_iter().filter(|(set, _)| *set).fold(T::default(), |word, (_, bit)| word | bit)
}

#[cfg(test)]
mod tests;
