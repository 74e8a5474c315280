//! Kollmorgen drives that follow torques: what is refused, what is watched, and where they end.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fieldbeat::axis::{Command, Failure, State, StopCause};

use fieldbeat::bus::ethercat::{EthercatPlan, KollmorgenDrive};
use fieldbeat::sim::WorldOptions;
use fieldbeat::{Master, Plan};

use super::kollmorgen::drives::{press, torque};
use super::kollmorgen::{LINE, Machine, STOP, jog, plan};
use super::support::assert_near;

/// Per cent of the rated torque a second.
const SLOPE: f64 = 40.0;
const TORQUE: Command = Command::Torque { slope: SLOPE };
/// As good as at once.
const STEEP: Command = Command::Torque { slope: 10_000.0 };

fn machine(change: impl Fn(&mut KollmorgenDrive)) -> Machine {
    let mut drive = torque(0);
    change(&mut drive);
    Machine::enabled(EthercatPlan::new(LINE, vec![drive]))
}

fn speed(machine: &Machine) -> f64 {
    machine.feedback(0).status.velocity
}

#[test]
fn torques_are_followed_along_their_slope_in_both_directions() {
    // 0.1 A for a per cent.
    let mut machine = machine(|drive| drive.scaling.rated_current = Some(10.0));
    let id = machine.sim.axis(0).post(TORQUE).unwrap();
    let mut before = 0.0;
    for wanted in [6.0, -8.0, 0.0] {
        let from: f64 = before;
        let takes = ((wanted - from).abs() / SLOPE * 1e3) as u64;
        for cycle in 0..takes + 100 {
            press(&mut machine, 0, wanted, 1);
            let torque = machine.feedback(0).status.current * 10.0;
            // Counts of a per mille.
            assert!((torque - before).abs() < SLOPE * 1e-3 + 0.11, "{before} -> {torque} %");
            let is_there = (torque - wanted).abs() < 0.11;
            assert!(is_there || cycle < takes + 5, "{torque} % in cycle {cycle} on the way to {wanted}");
            assert!(!is_there || cycle + 5 > takes, "{torque} % in cycle {cycle} is too soon");
            before = torque;
        }
        if wanted != 0.0 {
            assert!(speed(&machine) * wanted > 0.0, "it has turned round: {}", speed(&machine));
        }
        before = wanted;
    }
    assert_eq!((machine.sim.run_command(0, id, 1), machine.feedback(0).stopped), (None, None));
    // A stop takes the torque away, and keeps the power.
    press(&mut machine, 0, 6.0, 300);
    machine.done(0, STOP);
    let status = machine.feedback(0).status;
    assert!(!status.moving && status.velocity.abs() < 0.05, "{status:?}");
    assert_eq!((status.state, machine.feedback(0).stopped), (State::OperationEnabled, None));
}

#[test]
fn a_torque_mode_without_a_first_setpoint_gives_none_and_is_stopped() {
    let mut machine = machine(|_| ());
    // One that was left from long before is none, and neither is a velocity.
    machine.sim.axis(0).set_torque(100.0).unwrap();
    machine.post(0, STEEP);
    for _ in 0..11 {
        machine.sim.axis(0).set_velocity(10.0).unwrap();
        machine.run(1);
        assert_near(speed(&machine), 0.0, 0.01);
        assert_eq!(machine.feedback(0).stopped, None);
    }
    machine.sim.axis(0).set_velocity(10.0).unwrap();
    machine.run(2);
    assert_eq!(machine.feedback(0).stopped, Some(StopCause::StaleSetpoint));
}

#[test]
fn a_jog_does_not_take_torques() {
    let mut plan = plan(1);
    plan.drives[0].axis.jog_deadman = Some(Duration::from_millis(100));
    let mut machine = Machine::enabled(plan);
    machine.post(0, jog(5.0));
    press(&mut machine, 0, 100.0, 90);
    assert_near(speed(&machine), 5.0, 0.1);
    press(&mut machine, 0, 100.0, 20);
    assert_eq!(machine.feedback(0).stopped, Some(StopCause::DeadMan), "a torque does not hold the button");
}

#[test]
fn under_torque_an_axis_stops_inside_its_position_limits() {
    for torque in [40.0, -40.0, 3.0] {
        let mut machine = machine(|drive| drive.axis.limits.position = Some((-5.0, 5.0)));
        machine.done(0, Command::Home);
        machine.post(0, STEEP);
        let mut furthest: f64 = 0.0;
        for _ in 0..3_000 {
            if machine.feedback(0).stopped.is_none() {
                machine.sim.axis(0).set_torque(torque).unwrap();
            }
            machine.run(1);
            furthest = furthest.max(machine.feedback(0).status.position.abs());
        }
        assert_eq!(machine.feedback(0).stopped, Some(StopCause::Limit), "{torque}");
        // But for the speed that it gains until the stop reaches it; and not before there was need.
        assert!((3.0..5.1).contains(&furthest), "{torque}: {furthest}");
    }
}

#[test]
fn the_task_may_set_torques_and_is_watched_like_anybody() {
    let sets = Arc::new(AtomicBool::new(true));
    let task_sets = sets.clone();
    let plan = Plan { buses: vec![Box::new(EthercatPlan::new(LINE, vec![torque(0)]))], ..Plan::default() };
    let setup = Master::from_plan(plan).with_task(move |cycle, axes| {
        if task_sets.load(Ordering::Relaxed) {
            assert_eq!(axes.set_torque(0, 4.0), Ok(()));
        }
        // The torque stays a torque.
        assert_eq!(axes.set_velocity(0, 15.0), Ok(()));
        assert!(axes.set_torque(7, 1.0).is_err());
        if cycle.index == 1 {
            assert!(matches!(axes.set_torque(0, 150.1), Err(Failure::Limit { .. })));
        }
    });
    let mut machine = Machine { sim: setup.simulate(WorldOptions::default()).unwrap(), count: 1 };
    machine.online();
    machine.done(0, Command::Enable);
    machine.post(0, STEEP);
    machine.run(500);
    // 4 % of 5 N m less 0.1 N m of friction, on 0.002 kg m².
    assert_near(speed(&machine), 8.0 * 0.5, 0.2);
    assert_eq!(machine.feedback(0).stopped, None);
    sets.store(false, Ordering::Relaxed);
    machine.run(20);
    assert_eq!(machine.feedback(0).stopped, Some(StopCause::StaleSetpoint));
}
