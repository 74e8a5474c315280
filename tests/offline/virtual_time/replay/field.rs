//! A failure in the field as a test: its record lies in `tests/records`.

use fieldbeat::Master;
use fieldbeat::axis::{Command, Link, Move, Outcome, Profile, StopCause, Target};
use fieldbeat::replay::{LogEnd, Recorded, Replay, ReplayError};
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::recording::Recorder;
use fieldbeat_record::recording::reading::{Entry, Reading};

/// From the directory in which cargo runs tests: the path of the configuration stands in the record.
const RECORD: &str = "../records/lost.mcap";
const CONFIGURATION: &str = "../records/lost.toml";

fn plan() -> fieldbeat::Plan {
    fieldbeat::config::load(CONFIGURATION).unwrap().plan
}

/// The cable of a drive in motion was unplugged: its axis was stopped, and stays so when the drive is back.
#[test]
fn an_axis_whose_drive_is_lost_in_motion_is_stopped_and_stays_so() {
    let mut replay = Replay::open(RECORD).unwrap();
    assert!(replay.run_until(|machine| machine.feedback(0).link == Link::Lost));
    assert_eq!(replay.feedback(0).stopped, Some(StopCause::LinkLost));
    assert!(replay.run_until(|machine| machine.feedback(0).link == Link::Online));
    assert_eq!(replay.feedback(0).stopped, Some(StopCause::LinkLost));
    assert!(replay.run().is_equal());
}

/// Run it where a new version of the loop looks for its inputs in another order, or has another layout.
#[test]
#[ignore = "writes the record into the repository"]
fn the_record_is_made_anew() {
    std::fs::remove_file(RECORD).unwrap();
    let recorder = Recorder::create(RECORD).and_then(Recorder::with_wire).unwrap();
    let setup = Master::from_file(CONFIGURATION).unwrap().with_recorder(recorder);
    let drive = setup.plan().facts()[0].addresses()[0];
    let mut sim = setup.simulate(WorldOptions { wake_ns: 50_000, ..WorldOptions::default() }).unwrap();
    assert!(sim.run_until(100, |sim| sim.feedback(0).link == Link::Online));
    assert_eq!(sim.execute(0, Command::Enable, 100), Ok(Some(Outcome::Done)));
    assert_eq!(sim.execute(0, Command::Home, 300), Ok(Some(Outcome::Done)));
    let profile = Profile { velocity: 100.0, acceleration: 1_000.0, deceleration: 1_000.0 };
    sim.axis(0).post(Command::Move(Move { target: Target::Absolute(80.0), profile })).unwrap();
    sim.run(40);
    assert!(sim.world().unplug(drive));
    assert!(sim.run_until(100, |sim| sim.feedback(0).link == Link::Lost));
    sim.run(10);
    assert!(sim.world().plug(drive));
    assert!(sim.run_until(500, |sim| sim.feedback(0).link == Link::Online));
    let [recorded] = &sim.finish_recording()[..] else { panic!("one file") };
    assert_eq!((&recorded.error, recorded.wire.unwrap().cut_at), (&None, None));
}

/// A machine in virtual time records itself, too; one that was built in code gives its plan again. Its recording is the
/// one that others read.
#[test]
fn a_machine_that_was_built_in_code_is_repeated_with_its_plan() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    let recorder = Recorder::create(&path).and_then(Recorder::with_wire).unwrap();
    let setup = Master::from_plan(plan()).with_task(|_, _| {}).with_recorder(recorder);
    let mut sim = setup.simulate(WorldOptions::default()).unwrap();
    sim.run(5_000);
    let [recorded] = &sim.finish_recording()[..] else { panic!("one file") };
    let wire = recorded.wire.unwrap();
    assert!(recorded.error.is_none() && wire.cut_at.is_none() && wire.bytes > 100_000, "{recorded:?}");
    let entries: Vec<Entry> = Reading::open(&path).unwrap().map(Result::unwrap).collect();
    assert_eq!(entries.len() as u64, recorded.messages);
    let of = |topic: &str| entries.iter().filter(|entry| entry.topic.name == topic).count();
    assert_eq!((of("/cycle"), of("/wire")), (5_000, 0));

    let open = || Recorded::open(&path).unwrap();
    assert!(matches!(open().replay(), Err(ReplayError::Code { .. })));
    let mut replay = open().with_plan(plan()).replay().unwrap();
    let verdict = replay.run();
    assert!(verdict.is_equal(), "{verdict:?}");
    assert_eq!((verdict.last, replay.log_end()), (Some(4_999), LogEnd::Whole));
    assert!(open().with_plan(plan()).with_task(|_, _| {}).replay().unwrap().run().is_equal());
    assert_eq!(open().version(), env!("CARGO_PKG_VERSION"));
}

#[test]
fn a_simulation_that_is_only_dropped_has_its_whole_wire_in_the_file() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    let recorder = Recorder::create(&path).and_then(Recorder::with_wire).unwrap();
    let setup = Master::from_file(CONFIGURATION).unwrap().with_recorder(recorder);
    let mut sim = setup.simulate(WorldOptions::default()).unwrap();
    sim.run(30);
    drop(sim);
    let mut replay = Recorded::open(&path).unwrap().with_plan(plan()).replay().unwrap();
    assert_eq!((replay.run().last, replay.log_end()), (Some(29), LogEnd::Whole));
}

#[test]
fn a_recording_without_the_wire_is_none_to_repeat() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    let setup = Master::from_plan(plan()).with_recorder(Recorder::create(&path).unwrap());
    let mut sim = setup.simulate(WorldOptions::default()).unwrap();
    sim.run(10);
    let [recorded] = &sim.finish_recording()[..] else { panic!("one file") };
    assert_eq!(recorded.wire, None);
    let refused = Recorded::open(&path).unwrap_err();
    assert!(matches!(refused, ReplayError::NoWire { .. }), "{refused}");
    assert!(
        refused
            .to_string()
            .contains("has no wire to repeat; record the run with --record FILE --record-wire")
    );
}

/// There a thread takes the log out.
#[test]
fn a_master_in_virtual_time_is_repeated_to_its_last_cycle() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    let recorder = Recorder::create(&path).and_then(Recorder::with_wire).unwrap();
    let setup = Master::from_file(CONFIGURATION).unwrap().with_recorder(recorder);
    let master = setup.simulate(WorldOptions::default()).unwrap().into_master(5.0).unwrap();
    master.wait_online(std::time::Duration::from_secs(60)).unwrap();
    let run = master.finish();
    let [recorded] = &run.measured.recordings[..] else { panic!("one file") };
    assert!(recorded.error.is_none() && recorded.wire.unwrap().cut_at.is_none(), "{recorded:?}");
    let mut replay = Replay::open(&path).unwrap();
    let verdict = replay.run();
    assert!(verdict.is_equal(), "{verdict:?}");
    assert_eq!((verdict.last, replay.log_end()), (run.end.status.planned.checked_sub(1), LogEnd::Whole));
}
