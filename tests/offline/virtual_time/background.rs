//! A machine in virtual time that a thread steps: programs for real drives, with their blocking calls.

use std::time::Duration;

use fieldbeat::axis::{Abort, AxisError, Command, Link, Move, Outcome, Profile, StopCause, Target};
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::Summary;
use fieldbeat::{Master, Setup, config};

fn setup() -> Setup {
    let config::Configuration { plan, simulation, .. } =
        fieldbeat_config::demo::demo_plan(2, 1_000_000, 0).unwrap();
    Master::from_plan(plan).with_simulation(simulation)
}

#[test]
fn a_program_with_blocking_calls_runs_and_its_end_stops_the_drives() {
    // As fast as this computer can.
    let master = setup().simulate(WorldOptions::default()).unwrap().into_master(f64::INFINITY).unwrap();
    master.wait_online(Duration::from_secs(60)).unwrap();
    let mut axis = master.axis("a1").unwrap();
    axis.enable().unwrap();
    axis.home().unwrap();
    axis.move_to(100.0, axis.profile()).unwrap();
    let feedback = axis.feedback();
    assert!((feedback.status.position - 100.0).abs() < 0.1, "{feedback:?}");
    let run = master.finish();
    let status = run.end.status;
    assert_eq!((status.planned, status.skipped, status.lost_records), (status.executed, 0, 0));
    assert!(run.end.drives.iter().all(|drive| !drive.feedback.status.state.is_powered()));
    // What the thread of the telemetry has taken in is what the loop has counted.
    assert_eq!(run.measured.histograms.wake.len(), status.executed);
    assert!(!run.granted.missing.is_empty(), "nobody takes it for numbers of this host");
}

/// The axis that is stopped with its group names the one that began it, and why.
#[test]
fn a_call_that_ends_with_the_stop_group_names_the_axis_that_began_it() {
    let config::Configuration { mut plan, simulation, .. } =
        fieldbeat_config::demo::demo_plan(2, 1_000_000, 0).unwrap();
    let bus = &mut *plan.buses[0] as &mut dyn std::any::Any;
    bus.downcast_mut::<LinUdpPlan>()
        .unwrap()
        .drives
        .iter_mut()
        .for_each(|drive| drive.axis.stop.group = Some(1));
    let setup = Master::from_plan(plan).with_simulation(simulation);
    let machine = setup.simulate(WorldOptions::default()).unwrap();
    let world = machine.world().clone();
    let master = machine.into_master(10.0).unwrap();
    master.wait_online(Duration::from_secs(60)).unwrap();
    let mut axis = master.axis("a1").unwrap();
    axis.enable().unwrap();
    axis.home().unwrap();
    let slowly = Profile { velocity: 5.0, ..axis.profile() };
    let id = axis.post(Command::Move(Move { target: Target::Absolute(190.0), profile: slowly })).unwrap();
    assert!(world.unplug(master.plan().facts()[0].addresses()[1]));
    let error = axis.wait(id, "move", Duration::from_secs(60)).unwrap_err();
    assert_eq!(error.to_string(), "axis a1: move aborted: stop group, begun by a2: link lost");
    let by = axis.feedback().begun_by.unwrap();
    assert_eq!((axis.name_of(by.axis), by.cause), (Some("a2"), StopCause::LinkLost));
    // The text, and each of its parts for a program.
    let summary = Summary::from(&*master);
    let drive = &serde_json::to_value(&summary).unwrap()["drives"][0];
    assert_eq!(drive["stopped"], "stop group");
    assert_eq!(drive["begun_by"], serde_json::json!({ "axis": "a2", "cause": "link lost" }));
    let named = summary.to_string();
    assert!(named.contains("stopped: stop group, begun by a2: link lost"), "{named}");
    // Nothing is left of it once it is reset.
    let reset = axis.reset();
    assert!(reset.is_ok() && axis.feedback().begun_by.is_none(), "{reset:?}");
}

/// The task of the loop is between the events of a lost link and the feedback of their cycle, and takes its time here.
#[test]
fn feedback_has_the_reason_when_a_blocking_call_returns() {
    let setup = setup().with_task(|_, _| std::thread::sleep(Duration::from_millis(2)));
    let machine = setup.simulate(WorldOptions::default()).unwrap();
    let world = machine.world().clone();
    let master = machine.into_master(f64::INFINITY).unwrap();
    master.wait_online(Duration::from_secs(60)).unwrap();
    for (index, name) in ["a1", "a2"].into_iter().enumerate() {
        let mut axis = master.axis(name).unwrap();
        axis.enable().unwrap();
        let id = axis.post(Command::Home).unwrap();
        assert!(world.unplug(master.plan().facts()[0].addresses()[index]));
        let ended = axis.wait(id, "home", Duration::from_secs(60)).unwrap_err();
        let AxisError::Ended { outcome, .. } = ended else { panic!("{ended}") };
        assert_eq!(outcome, Outcome::Aborted(Abort::Stopped(StopCause::LinkLost)));
        let feedback = axis.feedback();
        assert_eq!((feedback.link, feedback.stopped), (Link::Lost, Some(StopCause::LinkLost)), "{name}");
    }
}
