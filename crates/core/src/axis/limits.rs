//! What an axis does not do, and its limits: a command, setpoint or row that breaks one is refused, on submission where
//! that can be checked there.

use super::command::{Command, Failure, Jog, Level, Move, Row, Target};
use super::plan::{AxisPlan, Limits, Load};

/// Why a drive does not do something, with the remedy; `None`: it does.
pub type Cannot = Option<&'static str>;

/// The capabilities that a drive lacks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lacks {
    /// Be commanded at all.
    pub control: Cannot,
    /// Be enabled.
    pub enable: Cannot,
    /// Moves.
    pub moves: Cannot,
    /// Rows of a stream.
    pub rows: Cannot,
    /// Velocities and jogs.
    pub velocities: Cannot,
    /// Torques.
    pub torques: Cannot,
    /// Homing.
    pub homing: Cannot,
}

impl Lacks {
    /// Why this drive cannot do that, in any state.
    pub fn refuses(&self, command: &Command) -> Option<Failure> {
        let why = match command {
            Command::Reset => None,
            _ if self.control.is_some() => self.control,
            Command::Enable => self.enable,
            Command::Move(_) => self.moves,
            Command::Follow => self.rows,
            Command::Jog(_) | Command::Velocity { .. } => self.velocities,
            Command::Torque { .. } => self.torques,
            Command::Home => self.homing,
            _ => None,
        };
        why.map(Failure::Unsupported)
    }
}

/// `Ok` if the drive can do `command`, and the command keeps to what the plan allows, as far as it can be checked
/// without the position of the axis.
pub fn check_command(plan: &AxisPlan, lacks: &Lacks, command: &Command) -> Result<(), Failure> {
    if let Some(failure) = lacks.refuses(command) {
        return Err(failure);
    }
    match command {
        Command::Move(Move { target, profile }) => {
            positive("velocity", profile.velocity, plan.limits.velocity)?;
            positive("acceleration", profile.acceleration, plan.limits.acceleration)?;
            positive("deceleration", profile.deceleration, plan.limits.acceleration)?;
            match *target {
                Target::Absolute(position) => check_position(&plan.limits, position),
                Target::Relative(distance) => finite(distance),
            }
        }
        Command::Jog(Jog { velocity, acceleration }) => {
            check_velocity(plan, *velocity)?;
            positive("acceleration", *acceleration, plan.limits.acceleration)
        }
        Command::Velocity { acceleration } => {
            positive("acceleration", *acceleration, plan.limits.acceleration)
        }
        Command::Torque { .. } if plan.limits.velocity.is_none() => Err(Failure::Unsupported(
            "only a velocity limit ends a runaway under torque: set limits.velocity",
        )),
        Command::Torque { .. } if plan.load != Load::Level => Err(Failure::Unsupported(
            "a vertical load drops if the torque does not hold it: command velocities or positions",
        )),
        Command::Torque { slope } => positive("torque slope", *slope, None),
        Command::Stop { deceleration: Some(deceleration) } => positive("deceleration", *deceleration, None),
        Command::Enable
        | Command::Disable
        | Command::Home
        | Command::Follow
        | Command::Stop { deceleration: None }
        | Command::QuickStop
        | Command::ResetFault
        | Command::Reset
        | Command::Native(_) => Ok(()),
    }
}

/// `Ok` if `velocity` is finite and within its limit, in either direction.
pub fn check_velocity(plan: &AxisPlan, velocity: f64) -> Result<(), Failure> {
    either_way("velocity", velocity, plan.limits.velocity)
}

/// `Ok` if `acceleration` is finite and within its limit, in either direction.
pub fn check_acceleration(plan: &AxisPlan, acceleration: f64) -> Result<(), Failure> {
    either_way("acceleration", acceleration, plan.limits.acceleration)
}

/// `Ok` if a setpoint is finite and within its limit, in either direction.
pub fn check_level(plan: &AxisPlan, level: Level, value: f64) -> Result<(), Failure> {
    let Limits { velocity, torque, .. } = plan.limits;
    either_way(level.name(), value, if level == Level::Velocity { velocity } else { torque })
}

/// `Ok` if `row` is finite, inside the position and velocity limits, and at most a step away from `from`, the row
/// before.
pub fn check_row(plan: &AxisPlan, row: &Row, from: Option<f64>) -> Result<(), Failure> {
    check_velocity(plan, row.velocity)?;
    check_position(&plan.limits, row.position)?;
    check_acceleration(plan, row.acceleration)?;
    match (from, plan.limits.step) {
        (Some(from), Some(step)) => check_way(plan, "step", from, row.position, step),
        _ => Ok(()),
    }
}

/// A step of exactly the largest size is not refused for its last binary digit.
const EXACT: f64 = 1.0 + 1e-9;

/// `Ok` if the axis may go from one position to the next when it gets `reach` far.
pub fn check_reach(plan: &AxisPlan, from: f64, to: f64, reach: f64) -> Result<(), Failure> {
    check_way(plan, "speed between rows", from, to, reach)
}

/// No position is near an unknown one.
fn check_way(plan: &AxisPlan, what: &'static str, from: f64, to: f64, most: f64) -> Result<(), Failure> {
    match plan.units.way(from, to).abs() <= most * EXACT {
        true => Ok(()),
        false => Err(Failure::Limit { what, value: to, low: from - most, high: from + most }),
    }
}

/// `Ok` if an axis that goes from one position to the next in `seconds` could still stop inside its range if it
/// began to brake at the first of them.
pub fn check_braking(plan: &AxisPlan, from: f64, to: f64, seconds: f64) -> Result<(), Failure> {
    let Some((low, high)) = plan.limits.position else { return Ok(()) };
    let velocity = (to - from) / seconds;
    let end = from + velocity * velocity.abs() / (2.0 * plan.stop.deceleration);
    match (low.min(from)..=high.max(from)).contains(&end) {
        true => Ok(()),
        false => Err(Failure::Limit { what: "braking distance", value: end, low, high }),
    }
}

/// `Ok` if `position` is finite and inside the position limits.
pub fn check_position(limits: &Limits, position: f64) -> Result<(), Failure> {
    finite(position)?;
    match limits.position {
        Some((low, high)) => within("position", position, low, Some(high)),
        None => Ok(()),
    }
}

fn finite(value: f64) -> Result<(), Failure> {
    if value.is_finite() { Ok(()) } else { Err(Failure::NotFinite) }
}

fn either_way(what: &'static str, value: f64, most: Option<f64>) -> Result<(), Failure> {
    finite(value)?;
    within(what, value.abs(), 0.0, most)
}

fn positive(what: &'static str, value: f64, most: Option<f64>) -> Result<(), Failure> {
    finite(value)?;
    if value > 0.0 { within(what, value, 0.0, most) } else { Err(Failure::NotPositive { what, value }) }
}

fn within(what: &'static str, value: f64, low: f64, high: Option<f64>) -> Result<(), Failure> {
    match high {
        Some(high) if !(low..=high).contains(&value) => Err(Failure::Limit { what, value, low, high }),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::command::tests::all;
    use crate::axis::{HeldBy, Limits, Units};

    #[test]
    fn a_missing_capability_refuses_its_own_commands_only() {
        let why = Some("it has none");
        let none = Lacks::default();
        for (lacks, refused) in [
            (none, &[][..]),
            (Lacks { enable: why, ..none }, &["enable"]),
            (Lacks { moves: why, ..none }, &["move"]),
            (Lacks { rows: why, ..none }, &["follow"]),
            (Lacks { velocities: why, ..none }, &["jog", "velocity"]),
            (Lacks { torques: why, ..none }, &["torque"]),
            (Lacks { homing: why, ..none }, &["home"]),
        ] {
            for (command, name) in all() {
                let failure = refused.contains(&name).then_some(Failure::Unsupported("it has none"));
                assert_eq!(lacks.refuses(&command), failure, "{lacks:?} {name}");
                // The latch of the axis is the master's own.
                let refuses = Lacks { control: why, ..lacks }.refuses(&command).is_some();
                assert_eq!(refuses, command != Command::Reset, "{name}");
            }
        }
    }

    #[test]
    fn a_torque_needs_a_limit_of_the_velocity_and_a_load_that_does_not_drop() {
        let mut plan = AxisPlan::new("x", Units::millimetres(1_000.0));
        let check =
            |plan: &AxisPlan, slope| check_command(plan, &Lacks::default(), &Command::Torque { slope });
        assert!(matches!(check(&plan, 100.0), Err(Failure::Unsupported(why)) if why.contains("velocity")));
        plan.limits.velocity = Some(10.0);
        assert_eq!(check(&plan, 100.0), Ok(()));
        for (slope, refused) in [
            (0.0, Failure::NotPositive { what: "torque slope", value: 0.0 }),
            (-1.0, Failure::NotPositive { what: "torque slope", value: -1.0 }),
            (f64::INFINITY, Failure::NotFinite),
        ] {
            assert_eq!(check(&plan, slope), Err(refused));
        }
        for held_by in [HeldBy::Brake, HeldBy::Drive] {
            plan.load = Load::Vertical(held_by);
            assert!(matches!(check(&plan, 100.0), Err(Failure::Unsupported(why)) if why.contains("drops")));
        }
    }

    #[test]
    fn a_torque_keeps_to_its_limit_in_both_directions() {
        let mut plan = AxisPlan::new("x", Units::millimetres(1_000.0));
        assert_eq!(check_level(&plan, Level::Torque, 1e6), Ok(()), "the drive's own limit only");
        assert_eq!(check_level(&plan, Level::Torque, f64::NAN), Err(Failure::NotFinite));
        plan.limits.torque = Some(120.0);
        for (torque, taken) in [(0.0, true), (120.0, true), (-120.0, true), (120.1, false), (-120.1, false)] {
            assert_eq!(check_level(&plan, Level::Torque, torque).is_ok(), taken, "{torque}");
        }
    }

    #[test]
    fn a_row_too_far_away_is_refused_with_the_range_and_none_is_near_a_position_that_the_drive_does_not_tell()
    {
        let mut plan = AxisPlan::new("x", Units::millimetres(1_000.0));
        plan.limits.step = Some(5.0);
        let row = Row { position: 60.0, ..Row::default() };
        let refused = Failure::Limit { what: "step", value: 60.0, low: 45.0, high: 55.0 };
        assert_eq!(check_row(&plan, &row, Some(50.0)), Err(refused));
        assert_eq!(check_row(&plan, &row, None), Ok(()));
        let limits = Limits { position: Some((0.0, 100.0)), velocity: Some(10.0), ..Limits::default() };
        plan.limits = Limits { step: Some(5.0), ..limits };
        let (row, unknown) = (Row { position: 50.0, ..Row::default() }, f64::NAN);
        assert_eq!(check_row(&plan, &row, Some(49.0)), Ok(()));
        for refused in [
            check_row(&plan, &row, Some(unknown)),
            check_reach(&plan, unknown, 50.0, f64::INFINITY),
            check_braking(&plan, unknown, 50.0, 0.001),
        ] {
            assert!(matches!(refused, Err(Failure::Limit { .. })), "{refused:?}");
        }
        assert_eq!(check_position(&plan.limits, unknown), Err(Failure::NotFinite));
    }
}
