//! An axis without its electronics: a setpoint generator and the mass that follows it.
//!
//! Knows no protocol, no clock and no wire unit: positions are f64 in any consistent units, time comes as steps in
//! nanoseconds.

use fieldbeat_core::drive::planner::{Point, Trajectory};
use fieldbeat_core::time::S;

/// Limits outside this span are clamped into it, so that no wire value makes a division by zero or an infinity.
const LIMIT_SPAN: (f64, f64) = (1e-9, 1e12);

/// A position or velocity that the generator can work with: a number, and small enough to be squared.
fn usable(value: f64) -> bool {
    value.abs() <= LIMIT_SPAN.1
}

/// The magnitude of a limit; NaN counts as the smallest.
fn limit(value: f64) -> f64 {
    value.abs().max(LIMIT_SPAN.0).min(LIMIT_SPAN.1)
}

/// A setpoint generator: follows a motion of the planner, or holds a demand that is given from outside. The demand
/// does not depend on how the time of a motion is cut into steps.
///
/// Limits are magnitudes (the sign is ignored), clamped into 1e-9 ... 1e12. A call with a position or a signed
/// velocity that is no number, or beyond 1e12, is ignored.
#[derive(Clone, Debug, Default)]
pub struct Generator {
    /// `None`: the demand stays as it is.
    motion: Option<Trajectory>,
    /// Since the motion was planned: whole nanoseconds, so that steps add up without rounding.
    elapsed_ns: u64,
    /// It does not end by itself: a motion that ends with a velocity, or a given demand.
    endless: bool,
    demand: Point,
    acceleration: f64,
}

impl Generator {
    /// Stands at `position`.
    pub fn at(position: f64) -> Generator {
        let mut generator = Generator::default();
        generator.set(position, 0.0, 0.0);
        generator.halt();
        generator
    }

    /// Demand position.
    pub fn position(&self) -> f64 {
        self.demand.position
    }

    /// Demand velocity, units/s.
    pub fn velocity(&self) -> f64 {
        self.demand.velocity
    }

    /// Demand acceleration, units/s^2.
    pub fn acceleration(&self) -> f64 {
        self.acceleration
    }

    /// A motion is under way: before the end of a planned one, always in an endless one and under a given demand.
    pub fn is_moving(&self) -> bool {
        self.endless || self.motion.is_some_and(|motion| !motion.is_over(self.elapsed_ns))
    }

    /// Moves to `target` with at most `velocity` (units/s), `acceleration` and `deceleration` (units/s^2), from the
    /// present demand position and velocity. If the deceleration cannot reach the target in time, the motion passes
    /// it and comes back.
    pub fn go_to(&mut self, target: f64, velocity: f64, acceleration: f64, deceleration: f64) {
        if usable(target) {
            let (velocity, up, down) = (limit(velocity), limit(acceleration), limit(deceleration));
            self.begin(Trajectory::go_to(self.demand, target, velocity, up, down));
        }
    }

    /// Runs on at `velocity` (units/s, signed), reached with `acceleration` (units/s^2), without an end.
    pub fn run(&mut self, velocity: f64, acceleration: f64) {
        if usable(velocity) {
            self.begin(Trajectory::run(self.demand, velocity, limit(acceleration)));
        }
    }

    /// Slows down to standstill with `deceleration`, units/s^2.
    pub fn brake(&mut self, deceleration: f64) {
        self.run(0.0, deceleration);
    }

    /// Takes a demand given from outside. It stays as it is, and counts as moving, until the next call that is not
    /// [`advance`](Self::advance).
    pub fn set(&mut self, position: f64, velocity: f64, acceleration: f64) {
        if usable(position) && usable(velocity) && usable(acceleration) {
            (self.demand, self.acceleration) = (Point { position, velocity }, acceleration);
            (self.motion, self.endless) = (None, true);
        }
    }

    /// Stands still at once at the present demand position.
    pub fn halt(&mut self) {
        (self.demand.velocity, self.acceleration) = (0.0, 0.0);
        (self.motion, self.endless) = (None, false);
    }

    /// Lets `dt_ns` nanoseconds pass.
    pub fn advance(&mut self, dt_ns: u64) {
        if let Some(motion) = &self.motion {
            self.elapsed_ns = self.elapsed_ns.saturating_add(dt_ns);
            self.demand = motion.at(self.elapsed_ns);
            self.acceleration = motion.acceleration(self.elapsed_ns);
        }
    }

    fn begin(&mut self, motion: Trajectory) {
        (self.motion, self.elapsed_ns, self.endless) = (Some(motion), 0, motion.last_velocity() != 0.0);
        self.advance(0);
    }
}

/// A mass on a position controller. SI units: m, kg, N; for a rotary axis rad, kg m^2, N m.
#[derive(Clone, Debug, PartialEq)]
pub struct PlantPlan {
    /// Moving mass, kg, over 0. Default 1.
    pub mass_kg: f64,
    /// Mechanical range between the hard stops, m, in rising order. Default -1 ... 1.
    pub range: (f64, f64),
    /// Bandwidth of the position controller, Hz: the stiffness is `mass * (2 pi bandwidth)^2`. Default 30.
    pub bandwidth_hz: f64,
    /// Damping ratio of the position controller. Default 0.7.
    pub damping: f64,
    /// How much of the demand acceleration is fed forward, 0 ... 1; the rest becomes following error. Default 0.9.
    pub feed_forward: f64,
    /// Largest force of the motor, N. Default 200.
    pub peak_force_n: f64,
    /// Dry friction, N, which ends the run-out without power. With power the controller compensates it. Default 5.
    pub friction_n: f64,
}

impl Default for PlantPlan {
    fn default() -> PlantPlan {
        PlantPlan {
            mass_kg: 1.0,
            range: (-1.0, 1.0),
            bandwidth_hz: 30.0,
            damping: 0.7,
            feed_forward: 0.9,
            peak_force_n: 200.0,
            friction_n: 5.0,
        }
    }
}

/// The longest substep: a fiftieth of the default controller's period.
const SUBSTEP_NS: u64 = 500_000;
/// The most substeps of one step. A longer step takes coarser ones; they stay stable.
const SUBSTEPS: u64 = 64;

/// The moving mass between its hard stops.
#[derive(Clone, Debug)]
pub struct Plant {
    plan: PlantPlan,
    position: f64,
    velocity: f64,
    force: f64,
    /// The present force limit of the motor, N.
    limit_n: f64,
}

impl Plant {
    /// Stands at 0, or at the end of the range next to it.
    pub fn new(plan: PlantPlan) -> Plant {
        let mut plant = Plant { limit_n: plan.peak_force_n, plan, position: 0.0, velocity: 0.0, force: 0.0 };
        plant.set_position(0.0);
        plant
    }

    /// Actual position, m.
    pub fn position(&self) -> f64 {
        self.position
    }

    /// Actual velocity, m/s.
    pub fn velocity(&self) -> f64 {
        self.velocity
    }

    /// The force of the motor, N, signed.
    pub fn force(&self) -> f64 {
        self.force
    }

    /// Stands against a hard stop.
    pub fn at_stop(&self) -> bool {
        self.position <= self.plan.range.0 || self.position >= self.plan.range.1
    }

    /// Puts the mass to `position`, standing; clamped into the range.
    pub fn set_position(&mut self, position: f64) {
        (self.velocity, self.force) = (0.0, 0.0);
        self.position = position;
        self.stops();
    }

    /// Limits the force of the motor, N, without sign, from now on; `None`: to the limit of the plan.
    pub fn limit_force(&mut self, force_n: Option<f64>) {
        self.limit_n =
            force_n.map_or(self.plan.peak_force_n, |force| force.abs().min(self.plan.peak_force_n));
    }

    /// Lets `dt_ns` nanoseconds pass while the motor pushes with this force, N, without position control. The force
    /// has to overcome the dry friction first.
    pub fn advance_with_force(&mut self, force_n: f64, dt_ns: u64) {
        let count = dt_ns.div_ceil(SUBSTEP_NS).clamp(1, SUBSTEPS);
        let h = dt_ns as f64 / count as f64 / S as f64;
        let peak = self.plan.peak_force_n;
        let force = if force_n.is_finite() { force_n.clamp(-peak, peak) } else { 0.0 };
        for _ in 0..count {
            self.velocity += force / self.plan.mass_kg * h;
            self.run_out(h);
            self.force = force;
            self.position += self.velocity * h;
            self.stops();
        }
    }

    /// Lets `dt_ns` nanoseconds pass, at whose end the demand is the given one (m, m/s, m/s^2).
    /// Meant for steps of up to 10 ms; longer ones stay stable and cost no more than 64 substeps, but are coarse.
    pub fn advance(
        &mut self,
        demand_position: f64,
        demand_velocity: f64,
        demand_acceleration: f64,
        dt_ns: u64,
    ) {
        let count = dt_ns.div_ceil(SUBSTEP_NS).clamp(1, SUBSTEPS);
        let h = dt_ns as f64 / count as f64 / S as f64;
        if h == 0.0 {
            return;
        }
        for left in (0..count).rev() {
            // The demand at the end of this substep, calculated back from that at the end of the step.
            let back = left as f64 * h;
            let velocity = demand_velocity - demand_acceleration * back;
            let position = demand_position - (demand_velocity + velocity) / 2.0 * back;
            self.push(position, velocity, demand_acceleration, h);
            self.position += self.velocity * h;
            self.stops();
        }
    }

    /// One implicit Euler step of the controlled mass: stable at any `h`.
    fn push(&mut self, position: f64, velocity: f64, acceleration: f64, h: f64) {
        let plan = &self.plan;
        let omega = 2.0 * std::f64::consts::PI * plan.bandwidth_hz;
        let (stiffness, damping) = (omega * omega, 2.0 * plan.damping * omega);
        // Per mass: a = ff + damping (v_d - v') + stiffness (x_d - x - h v'), v' = v + h a, solved for a.
        let a = (plan.feed_forward * acceleration
            + damping * (velocity - self.velocity)
            + stiffness * (position - self.position - h * self.velocity))
            / (1.0 + damping * h + stiffness * h * h);
        self.force = (a * plan.mass_kg).clamp(-self.limit_n, self.limit_n);
        self.velocity += self.force / plan.mass_kg * h;
    }

    fn run_out(&mut self, h: f64) {
        self.force = 0.0;
        let slower = self.plan.friction_n / self.plan.mass_kg * h;
        self.velocity -= self.velocity.clamp(-slower, slower);
    }

    /// The hard stops absorb all speed towards them.
    fn stops(&mut self) {
        let (low, high) = self.plan.range;
        if self.position <= low {
            (self.position, self.velocity) = (low, self.velocity.max(0.0));
        } else if self.position >= high {
            (self.position, self.velocity) = (high, self.velocity.min(0.0));
        }
    }
}

#[cfg(test)]
mod tests;
