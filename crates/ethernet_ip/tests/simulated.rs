//! Drives in the whole loop, in virtual time.

use fieldbeat_core::axis::{Command, Jog, Link, Move, Outcome, Profile, Target};
use fieldbeat_core::cycle::{CyclePlan, Plan};
use fieldbeat_ethernet_ip::{EthernetIpPlan, Homing, HomingMethod, MoonsDrive};
use fieldbeat_master::Master;
use fieldbeat_master::simulation::Simulation;
use fieldbeat_sim::WorldOptions;

const PROFILE: Profile = Profile { velocity: 5.0, acceleration: 50.0, deceleration: 50.0 };

fn machine(change: impl Fn(&mut MoonsDrive)) -> Simulation {
    let mut drive = MoonsDrive::new("x", [10, 0, 0, 2].into());
    drive.axis.profile = PROFILE;
    drive.axis.divisor = 4;
    drive.homing = Some(Homing {
        method: HomingMethod::Seek,
        input: 0x4CB2,
        velocity: 1.0,
        acceleration: 20.0,
        distance: -3.0,
    });
    change(&mut drive);
    let bus = EthernetIpPlan::new([10, 0, 0, 1].into(), vec![drive]);
    let plan =
        Plan { source: None, cycle: CyclePlan::default(), buses: vec![Box::new(bus)], groups: Vec::new() };
    Master::from_plan(plan).simulate(WorldOptions::default()).unwrap()
}

fn go(position: f64) -> Command {
    Command::Move(Move { target: Target::Absolute(position), profile: PROFILE })
}

#[test]
fn it_comes_online_and_does_what_it_is_commanded() {
    let mut machine = machine(|_| ());
    let online = machine.run_until(5_000, |machine| machine.feedback(0).link == Link::Online);
    assert!(online, "{:?}", machine.feedback(0));
    let mut done = |command| {
        let end = machine.execute(0, command, 10_000).unwrap();
        assert_eq!(end, Some(Outcome::Done), "{command:?}: {:?}", machine.feedback(0));
        machine.feedback(0).status
    };
    done(Command::Enable);
    let there = done(go(3.0));
    assert!((there.position - 3.0).abs() < 0.01, "{there:?}");
    let there = done(go(-1.0));
    assert!((there.position + 1.0).abs() < 0.01, "{there:?}");
    let homed = done(Command::Home);
    assert!(homed.homed && homed.position.abs() < 0.01, "{homed:?}");
    done(Command::Disable);
}

#[test]
fn a_jog_takes_other_velocities_and_stops() {
    let mut machine = machine(|_| ());
    machine.run_until(5_000, |machine| machine.feedback(0).link == Link::Online);
    assert_eq!(machine.execute(0, Command::Enable, 5_000).unwrap(), Some(Outcome::Done));
    for velocity in [2.0, 4.0, -3.0] {
        machine.execute(0, Command::Jog(Jog { velocity, acceleration: 50.0 }), 400).unwrap();
        let status = machine.feedback(0).status;
        assert!((status.velocity - velocity).abs() < 0.1, "{velocity}: {status:?}");
    }
    let end = machine.execute(0, Command::Stop { deceleration: None }, 2_000).unwrap();
    assert_eq!(end, Some(Outcome::Done), "{:?}", machine.feedback(0));
    assert!(machine.feedback(0).status.velocity.abs() < 0.01);
}

#[test]
fn a_homing_that_takes_too_long_is_stopped() {
    let mut machine = machine(|drive| {
        // Three turns at a turn a second.
        drive.axis.home_timeout = std::time::Duration::from_millis(300);
    });
    machine.run_until(5_000, |machine| machine.feedback(0).link == Link::Online);
    assert_eq!(machine.execute(0, Command::Enable, 5_000).unwrap(), Some(Outcome::Done));
    let end = machine.execute(0, Command::Home, 5_000).unwrap();
    assert!(matches!(end, Some(Outcome::Failed(_))), "{end:?}");
    machine.run(300);
    let before = machine.feedback(0).status;
    machine.run(300);
    let after = machine.feedback(0).status;
    assert!(!after.moving && after.position == before.position && !after.homed, "{before:?} {after:?}");
}
