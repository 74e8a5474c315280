//! Drives that follow torques: how old one may be, what is refused, and that a runaway ends.

use fieldbeat::axis::{
    Abort, Command, EventKind, Failure, Group, HeldBy, Link, Load, Outcome, StopCause, StopThen, StopTimeout,
};
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::cycle::{CyclePlan, Plan};
use fieldbeat::master::{Master, Setup};
use fieldbeat::sim::world::WorldOptions;
use fieldbeat::simulation::Simulation;

use super::speed_drives::{ACCELERATION, Speeds};
use super::support::{RANGE, Rig, assert_near, drive, jog, slowly_to};

/// Per cent of the rated torque a second.
const SLOPE: f64 = 200.0;
const TORQUE: Command = Command::Torque { slope: SLOPE };
const STOP: Command = Command::Stop { deceleration: None };

/// As many drives as said, of 200 mm/s and 150 % at most, that tell their positions and have no limits of them.
fn torques(count: usize) -> Speeds {
    let drives = (0..count).map(|index| {
        let mut drive = drive(index);
        let limits = &mut drive.axis.limits;
        (limits.position, limits.velocity, limits.torque) = (None, Some(200.0), Some(150.0));
        drive.axis.stop.group = Some(0);
        drive.simulate.range = (-100_000_000, 100_000_000);
        drive
    });
    let plan = LinUdpPlan::new([127, 0, 0, 1].into(), drives.collect());
    Speeds { positions: true, ..Speeds::new(plan) }
}

fn setup(speeds: &Speeds) -> Setup {
    let buses: Vec<Box<dyn fieldbeat::bus::BusPlan>> = vec![Box::new(speeds.clone())];
    Master::from_plan(Plan { source: None, cycle: CyclePlan::default(), buses, groups: Vec::new() })
}

/// In operation.
fn ready(setup: Setup, count: usize) -> Simulation {
    let mut machine = setup.simulate(WorldOptions::default()).unwrap();
    let online = |machine: &Simulation| (0..count).all(|index| machine.feedback(index).link == Link::Online);
    assert!(machine.run_until(1_000, online));
    for index in 0..count {
        for verb in [Command::Enable, Command::Home] {
            assert_eq!(machine.run_verb(index, verb, 30_000), Ok(Some(Outcome::Done)));
        }
    }
    machine
}

fn machine(speeds: &Speeds) -> Simulation {
    ready(setup(speeds), speeds.plan.drives.len())
}

/// Gives this torque anew in each of so many cycles.
fn hold(machine: &mut Simulation, torque: f64, cycles: u64) {
    for _ in 0..cycles {
        machine.axis(0).set_torque(torque).unwrap();
        machine.step();
    }
}

/// Why it was refused at the door, in words.
fn refused(machine: &mut Simulation, verb: Command) -> String {
    machine.axis(0).post(verb).expect_err("refused").to_string()
}

#[test]
fn torques_are_followed_along_their_slope_in_both_directions() {
    let mut machine = machine(&torques(1));
    let id = machine.axis(0).post(TORQUE).unwrap();
    let (mut expected, mut torque) = (0.0, 0.0);
    for (asked, cycles) in [(20.0, 600), (-15.0, 1_200), (0.0, 300)] {
        hold(&mut machine, asked, cycles);
        for _ in 0..cycles {
            torque += f64::clamp(asked - torque, -SLOPE * 1e-3, SLOPE * 1e-3);
            expected += torque * ACCELERATION * 1e-3;
        }
        // A few cycles late.
        assert_near(machine.feedback(0).status.velocity, expected, 3.0);
    }
    assert!(expected < -20.0, "it has turned round: {expected}");
    assert_eq!((machine.run_command(0, id, 1), machine.feedback(0).stopped), (None, None));
    assert_eq!(machine.run_verb(0, STOP, 1_000), Ok(Some(Outcome::Done)));
    machine.run(100);
    assert_near(machine.feedback(0).status.velocity, 0.0, 0.5);
    assert_eq!(machine.feedback(0).stopped, None);
}

#[test]
fn a_torque_that_is_too_old_stops_the_axis_in_the_cycle_that_was_said() {
    for age in [1, 10, 50] {
        let mut speeds = torques(1);
        speeds.plan.drives[0].axis.setpoint_age = age;
        let mut machine = machine(&speeds);
        let id = machine.axis(0).post(TORQUE).unwrap();
        hold(&mut machine, 20.0, 100);
        machine.run(u64::from(age));
        assert_eq!(machine.feedback(0).stopped, None, "age {age}");
        machine.run(1);
        assert_eq!(machine.feedback(0).stopped, Some(StopCause::StaleSetpoint), "age {age}");
        let ended = Some(Outcome::Aborted(Abort::Stopped(StopCause::StaleSetpoint)));
        assert_eq!(machine.run_command(0, id, 10), ended);
        machine.run(300);
        assert!(!machine.feedback(0).status.state.is_powered());
        // Latched, like after any other stop.
        let latched = Outcome::Failed(Failure::Latched(StopCause::StaleSetpoint));
        assert_eq!(machine.run_verb(0, TORQUE, 100), Ok(Some(latched)));
        for verb in [Command::Reset, Command::Enable] {
            assert_eq!(machine.run_verb(0, verb, 5_000), Ok(Some(Outcome::Done)));
        }
        machine.axis(0).post(TORQUE).unwrap();
        hold(&mut machine, 20.0, 100);
        assert!(machine.feedback(0).status.velocity > 5.0);
    }
}

/// The torque begins in the exchange in which the homing ends.
#[test]
fn a_torque_that_was_queued_behind_a_homing_is_watched_like_any_other() {
    let mut speeds = torques(1);
    let axis = &mut speeds.plan.drives[0].axis;
    (axis.limits.velocity, axis.limits.homing, axis.profile.velocity) = (Some(5.0), Some(200.0), 5.0);
    let mut machine = machine(&speeds);
    machine.axis(0).post(Command::Home).unwrap();
    machine.axis(0).post(TORQUE).unwrap();
    let mut fastest: f64 = 0.0;
    let stopped = (0..30_000).any(|_| {
        machine.axis(0).set_torque(100.0).unwrap();
        machine.step();
        fastest = fastest.max(machine.feedback(0).status.velocity.abs());
        machine.feedback(0).stopped == Some(StopCause::Limit)
    });
    assert!(stopped && fastest < 20.0, "{fastest} mm/s");
}

#[test]
fn a_torque_mode_without_a_first_setpoint_gives_none_and_is_stopped() {
    let mut machine = machine(&torques(1));
    // One that was left from long before is none, and neither is a velocity.
    machine.axis(0).set_torque(100.0).unwrap();
    machine.axis(0).post(TORQUE).unwrap();
    for _ in 0..11 {
        machine.axis(0).set_velocity(100.0).unwrap();
        machine.step();
        assert_near(machine.feedback(0).status.velocity, 0.0, 0.5);
        assert_eq!(machine.feedback(0).stopped, None);
    }
    machine.axis(0).set_velocity(100.0).unwrap();
    machine.run(2);
    assert_eq!(machine.feedback(0).stopped, Some(StopCause::StaleSetpoint));
}

#[test]
fn a_jog_is_deaf_to_torques() {
    let mut speeds = torques(1);
    speeds.plan.drives[0].axis.jog_deadman = Some(std::time::Duration::from_millis(100));
    let mut machine = machine(&speeds);
    machine.axis(0).post(jog(50.0)).unwrap();
    hold(&mut machine, 100.0, 90);
    assert_near(machine.feedback(0).status.velocity, 50.0, 1.0);
    hold(&mut machine, 100.0, 20);
    assert_eq!(machine.feedback(0).stopped, Some(StopCause::DeadMan), "a torque does not hold the button");
}

#[test]
fn torques_beyond_their_limit_are_refused_at_the_door() {
    let mut machine = machine(&torques(1));
    for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 150.1, -150.1] {
        let told = machine.axis(0).set_torque(value).unwrap_err().to_string();
        assert!(told.contains("torque refused"), "{told}");
    }
    for (slope, why) in [(0.0, "above 0"), (-5.0, "above 0"), (f64::NAN, "finite")] {
        assert!(refused(&mut machine, Command::Torque { slope }).contains(why), "{slope}");
    }
    machine.axis(0).set_torque(-150.0).unwrap();
    // The newest always has its place.
    assert!((0..1_000).all(|_| machine.axis(0).set_torque(1.0).is_ok()));
}

#[test]
fn without_a_limit_of_the_velocity_and_on_a_vertical_load_torque_is_refused_by_name() {
    let mut speeds = torques(1);
    speeds.plan.drives[0].axis.limits.velocity = None;
    let mut machine_without = machine(&speeds);
    let told = refused(&mut machine_without, TORQUE);
    assert!(told.contains("set limits.velocity"), "{told}");

    let mut speeds = torques(1);
    let axis = &mut speeds.plan.drives[0].axis;
    axis.load = Load::Vertical(HeldBy::Drive);
    (axis.stop.then, axis.stop.on_timeout) = (StopThen::Hold, StopTimeout::Hold);
    let told = refused(&mut machine(&speeds), TORQUE);
    assert!(told.contains("vertical load drops"), "{told}");
}

#[test]
fn a_runaway_under_torque_is_stopped_by_the_limit_of_the_velocity() {
    // Its demand position says nothing: it stands where it was, or is not told.
    for positions in [true, false] {
        for torque in [50.0, -50.0] {
            let mut machine = machine(&Speeds { positions, ..torques(1) });
            let id = machine.axis(0).post(TORQUE).unwrap();
            let mut fastest = 0.0_f64;
            for _ in 0..1_000 {
                if machine.feedback(0).stopped.is_none() {
                    assert!(
                        machine.feedback(0).status.velocity.abs() < 245.0,
                        "200 and a fifth, and the reports"
                    );
                    machine.axis(0).set_torque(torque).unwrap();
                }
                machine.step();
                fastest = fastest.max(machine.feedback(0).status.velocity.abs());
            }
            assert!(fastest > 235.0, "it was let go up to the limit: {fastest}");
            assert_eq!(machine.feedback(0).stopped, Some(StopCause::Limit));
            let ended = Some(Outcome::Aborted(Abort::Stopped(StopCause::Limit)));
            assert_eq!(machine.run_command(0, id, 1), ended);
            assert!(
                machine.feedback(0).status.velocity.abs() < 1.0
                    && !machine.feedback(0).status.state.is_powered()
            );
        }
    }
}

#[test]
fn under_torque_an_axis_stops_inside_its_position_limits() {
    for (torque, slow) in [(40.0, 0), (-40.0, 0), (8.0, 400)] {
        let mut speeds = torques(1);
        let axis = &mut speeds.plan.drives[0].axis;
        axis.limits.position = Some(RANGE);
        axis.stop.deceleration = 1_000.0;
        let mut machine = machine(&speeds);
        let profile = machine.axis(0).profile();
        let middle = fieldbeat::axis::Target::Absolute(100.0);
        let middle = Command::Move(fieldbeat::axis::Move { target: middle, profile });
        assert_eq!(machine.run_verb(0, middle, 5_000), Ok(Some(Outcome::Done)));
        machine.axis(0).post(TORQUE).unwrap();
        let (mut low, mut high) = RANGE;
        (low, high) = (high, low);
        for _ in 0..3_000 + slow {
            if machine.feedback(0).stopped.is_none() {
                machine.axis(0).set_torque(torque).unwrap();
            }
            machine.step();
            let position = machine.feedback(0).status.position;
            (low, high) = (low.min(position), high.max(position));
        }
        assert_eq!(machine.feedback(0).stopped, Some(StopCause::Limit), "{torque}");
        // But for the speed that it gains until the stop reaches it.
        assert!(low >= RANGE.0 - 0.5 && high <= RANGE.1 + 0.5, "{torque}: {low} ... {high}");
        // Not before there was need.
        assert!(high - low > 70.0, "{torque}: {low} ... {high}");
    }
}

#[test]
fn not_homed_there_is_no_torque_within_position_limits() {
    let mut speeds = torques(1);
    speeds.plan.drives[0].axis.limits.position = Some(RANGE);
    let mut machine = setup(&speeds).simulate(WorldOptions::default()).unwrap();
    assert!(machine.run_until(1_000, |machine| machine.feedback(0).link == Link::Online));
    let not_enabled = machine.run_verb(0, TORQUE, 100).unwrap();
    assert!(matches!(not_enabled, Some(Outcome::Failed(Failure::WrongState(_)))), "{not_enabled:?}");
    assert_eq!(machine.run_verb(0, Command::Enable, 5_000), Ok(Some(Outcome::Done)));
    assert_eq!(machine.run_verb(0, TORQUE, 100), Ok(Some(Outcome::Failed(Failure::NotHomed))));
}

#[test]
fn the_task_may_set_torques_and_is_watched_like_anybody() {
    let setup = setup(&torques(1)).with_task(|cycle, axes| {
        let set = if cycle.index < 9_000 { axes.set_torque(0, 5.0) } else { Ok(()) };
        assert_eq!(set, Ok(()));
        // The torque stays a torque.
        assert_eq!(axes.set_velocity(0, 150.0), Ok(()));
        assert!(axes.set_torque(7, 1.0).is_err());
        if cycle.index == 1 {
            assert!(matches!(axes.set_torque(0, 150.1), Err(Failure::Limit { .. })));
        }
    });
    let mut machine = ready(setup, 1);
    assert!(machine.run_until(9_000, |machine| machine.status().planned >= 8_000));
    machine.axis(0).post(TORQUE).unwrap();
    machine.run(900);
    assert_near(machine.feedback(0).status.velocity, 5.0 * ACCELERATION * 0.9, 3.0);
    machine.run(200);
    assert_eq!(machine.feedback(0).stopped, Some(StopCause::StaleSetpoint));
}

#[test]
fn torques_of_all_members_are_set_together_and_refused_together() {
    let mut machine = machine(&torques(2));
    let mut group = Group::new(vec![machine.take_axis(0), machine.take_axis(1)]).unwrap();
    let command = group.post_all(TORQUE).unwrap();
    for _ in 0..300 {
        group.set_torques(&[10.0, -20.0]).unwrap();
        machine.step();
    }
    let [a, b] = [0, 1].map(|index| machine.feedback(index).status.velocity);
    assert!(a > 20.0 && b < -40.0, "{a} {b}");
    assert!(group.set_torques(&[1.0, 151.0]).is_err());
    assert!(group.set_torques(&[1.0]).is_err());
    machine.run(15);
    assert!((0..2).all(|index| machine.feedback(index).stopped.is_some()), "nobody sets them any more");
    let ended = std::iter::from_fn(|| group.event(0)).find_map(|event| match event.kind {
        EventKind::Ended { id, outcome, verb } => (id == command.ids()[0]).then_some((verb, outcome)),
        _ => None,
    });
    assert!(matches!(ended, Some(("torque", Outcome::Aborted(_)))), "{ended:?}");
}

#[test]
fn a_drive_that_takes_no_torques_refuses_them_by_name_and_does_not_run_on() {
    let mut b = Rig::new(1).start();
    b.ready();
    let moving = b.post(0, slowly_to(100.0));
    b.run(100);
    let told = b.failed(0, TORQUE);
    assert!(matches!(told, Failure::Unsupported(why) if why.contains("torque")), "{told}");
    assert!(matches!(b.outcome(0, moving), Some(Outcome::Aborted(Abort::Replaced(_)))));
    b.until("standstill", 100, |b| !b.feedback(0).status.moving);
    assert_eq!(b.feedback(0).stopped, None);
}
