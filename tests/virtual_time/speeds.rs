//! Drives that tell their speed and no position: what holds for them all the same, and how they are told of.

use std::sync::atomic::Ordering;

use fieldbeat::axis::{Command, Failure, Group, Link, Move, Outcome, StopCause, Target};
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::cycle::engine::Control;
use fieldbeat::cycle::{CyclePlan, Plan};
use fieldbeat::master::{Assembly, Master, assemble};
use fieldbeat::rt::Granted;
use fieldbeat::sim::world::{World, WorldOptions};
use fieldbeat::simulation::Simulation;
use fieldbeat::telemetry::{Measured, Summary};
use serde_json::{Value, json};

use super::speed_drives::Speeds;
use super::support::{assert_near, by, drive, jog, row, to};

/// As many drives as said, each with this limit of its speed, mm/s.
fn speeds(count: usize, limit: f64) -> Speeds {
    let drives = (0..count).map(|index| {
        let mut drive = drive(index);
        (drive.axis.limits.position, drive.axis.limits.velocity) = (None, Some(limit));
        drive.axis.profile.velocity = 50.0;
        drive.axis.stop.group = Some(0);
        drive
    });
    Speeds::new(LinUdpPlan::new([127, 0, 0, 1].into(), drives.collect()))
}

fn plan(speeds: &Speeds) -> Plan {
    let buses: Vec<Box<dyn fieldbeat::bus::BusPlan>> = vec![Box::new(speeds.clone())];
    Plan { source: None, cycle: CyclePlan::default(), buses, groups: Vec::new() }
}

/// In operation.
fn machine(speeds: &Speeds) -> Simulation {
    let mut machine = Master::from_plan(plan(speeds)).simulate(WorldOptions::default()).unwrap();
    let count = speeds.plan.drives.len();
    let online = |machine: &Simulation| (0..count).all(|index| machine.feedback(index).link == Link::Online);
    assert!(machine.run_until(1_000, online));
    for index in 0..count {
        for verb in [Command::Enable, Command::Home] {
            assert_eq!(machine.run_verb(index, verb, 30_000), Ok(Some(Outcome::Done)));
        }
    }
    machine
}

#[test]
fn velocities_are_taken_and_positions_are_refused_by_name() {
    let mut machine = machine(&speeds(1, 1_000.0));
    let refused =
        Outcome::Failed(Failure::Unsupported("it reports no position, so it takes neither moves nor rows"));
    machine.axis(0).push_row(row(0.0)).unwrap();
    for verb in [to(10.0), by(1.0), Command::Follow] {
        assert_eq!(machine.run_verb(0, verb, 100), Ok(Some(refused)), "{verb:?}");
    }
    let jogging = machine.axis(0).post(jog(80.0)).unwrap();
    machine.run(200);
    let feedback = machine.feedback(0);
    assert_near(feedback.status.velocity, 80.0, 1.0);
    assert!(
        [feedback.status.position, feedback.status.demand, feedback.status.current]
            .into_iter()
            .all(f64::is_nan)
    );
    assert_eq!(feedback.stopped, None);
    // A move that is refused leaves the jog alone.
    assert_eq!(machine.run_verb(0, to(10.0), 100), Ok(Some(refused)));
    assert_near(machine.feedback(0).status.velocity, 80.0, 1.0);
    assert_eq!(machine.run_command(0, jogging, 10), None);
    assert_eq!(machine.run_verb(0, Command::Stop { deceleration: None }, 1_000), Ok(Some(Outcome::Done)));
    machine.run(200);
    assert_near(machine.feedback(0).status.velocity, 0.0, 0.1);
}

#[test]
fn a_group_refuses_positions_to_all_its_members() {
    let mut machine = machine(&speeds(2, 1_000.0));
    let members = vec![machine.take_axis(0), machine.take_axis(1)];
    let mut group = Group::new(members).unwrap();
    let profile = speeds(1, 1.0).plan.drives[0].axis.profile;
    let go = |target| Command::Move(Move { target, profile });
    let command = group.post(&[go(Target::Absolute(5.0)), go(Target::Relative(5.0))]).unwrap();
    machine.run(20);
    for (place, id) in command.ids().iter().enumerate() {
        let ended = std::iter::from_fn(|| group.event(place)).find_map(|event| match event.kind {
            fieldbeat::axis::EventKind::Ended { id: ended, outcome, .. } => (ended == *id).then_some(outcome),
            _ => None,
        });
        assert!(matches!(ended, Some(Outcome::Failed(Failure::Unsupported(_)))), "{place}: {ended:?}");
    }
}

#[test]
fn the_limit_of_the_velocity_holds_by_the_speed_that_the_drive_tells() {
    for (percent, stops) in [(100, false), (140, false), (160, true)] {
        let speeds = speeds(1, 100.0);
        let mut machine = machine(&speeds);
        machine.axis(0).post(jog(85.0)).unwrap();
        machine.run(300);
        assert_eq!(machine.feedback(0).stopped, None);
        // It does not as it is told: 85, 119 and 136 mm/s where 100 are allowed, and 120 pass.
        speeds.percent.store(percent, Ordering::Relaxed);
        machine.run(2);
        assert_eq!(machine.feedback(0).stopped, None, "one report or two make no speed");
        machine.run(100);
        assert_eq!(machine.feedback(0).stopped, stops.then_some(StopCause::Limit), "{percent} %");
    }
}

#[test]
fn what_a_protocol_counts_of_its_own_is_exact_without_any_telemetry() {
    let speeds = speeds(3, 1_000.0);
    let plan = plan(&speeds);
    let world = World::new(plan.simulate(), WorldOptions { seed: 3, ..WorldOptions::default() }).unwrap();
    let Assembly { mut engine, gauges, .. } =
        assemble(&plan, world.clock(), &world, None, Control::default()).unwrap();
    engine.begin();
    // Nobody takes the records: the ring is full after a second.
    while engine.status().planned < 3_000 {
        engine.step();
    }
    assert!(engine.status().lost_records > 5_000);
    let replies = speeds.replies.lock().unwrap().clone();
    for (gauge, replies) in gauges.axes.iter().zip(&replies) {
        let read = gauge.numbers.read().counters.own;
        assert!(read[0] <= *replies && read[0] + 64 >= *replies && read[2] == u64::MAX, "{read:?} {replies}");
    }
    let end = engine.finish();
    for (drive, replies) in end.drives.iter().zip(&replies) {
        assert!(*replies > 2_900, "{replies}");
        assert_eq!(drive.counters.own[..4], [*replies, 0, u64::MAX, 0]);
    }
}

#[test]
fn the_summary_tells_what_there_is_and_makes_nothing_of_what_there_is_not() {
    let speeds = speeds(2, 1_000.0);
    let mut machine = machine(&speeds);
    machine.run(100);
    speeds.notes.set(1, Some("refused: nobody listens at 10.0.1.2:502".to_owned()));
    let replies = speeds.replies.lock().unwrap().clone();
    let plan = plan(&speeds);
    let mut end = machine.finish();
    end.drives[0].feedback.status.fault = 0x0B;
    end.drives[1].feedback.status.fault = 0xABC;
    let granted =
        Granted { policy: "SCHED_OTHER", priority: 0, core: None, memory_locked: false, missing: Vec::new() };
    let summary = Summary::of(&plan, &end, &Measured::new(2, &plan.cycle, false), &granted, None);
    let object = serde_json::to_value(&summary).unwrap();
    let of = |key: &str| [0, 1].map(|index: usize| object["drives"][index][key].clone());
    assert_eq!(of("position"), [Value::Null, Value::Null]);
    let own = replies.iter().map(|replies| json!({ "replies": replies, "none": 0, "most": u64::MAX }));
    assert_eq!(of("protocol_counters").to_vec(), own.collect::<Vec<_>>());
    assert_eq!(of("not_connected"), [Value::Null, json!("refused: nobody listens at 10.0.1.2:502")]);
    assert_eq!(of("fault"), [json!(11), json!(2748)]);
    assert_eq!(of("fault_name"), [json!("position lag"), Value::Null]);
    let text = summary.to_string();
    let counted = |replies| format!("replies without a position: {replies}; the most: {}\n", u64::MAX);
    for part in [
        &format!("\nx0    {}", counted(replies[0])),
        &format!("\nx1    {}", counted(replies[1])),
        "  fault 0x000b (11, position lag)\n",
        "\n  fault 0x0abc (2748)\n  not connected: refused: nobody listens at 10.0.1.2:502\n",
    ] {
        assert!(text.contains(part), "no {part:?}: {text}");
    }
    assert!(!text.contains("NaN") && !object.to_string().contains("NaN"), "{text}");
}
