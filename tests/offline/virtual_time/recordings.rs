//! A recording in virtual time has what the application saw.

use std::path::Path;

use fieldbeat::axis::{Command, Move, Profile, Target};
use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::recording::{RecordError, Recorder};
use fieldbeat::time::MS;
use fieldbeat::{CyclePlan, Master, Plan, Simulation};
use fieldbeat_record::recording::reading::{Entry, Reading};

const AXES: usize = 2;

fn plan() -> Plan {
    let drives =
        (0..AXES).map(|index| LinUdpDrive::new(format!("d{index}"), [10, 0, 0, 10 + index as u8].into()));
    let bus = LinUdpPlan::new([10, 0, 0, 1].into(), drives.collect());
    Plan { cycle: CyclePlan::default(), buses: vec![Box::new(bus)], ..Plan::default() }
}

fn machine(recorder: Recorder) -> Simulation {
    Master::from_plan(plan()).with_recorder(recorder).simulate(WorldOptions::default()).unwrap()
}

fn read(path: &Path) -> Vec<Entry> {
    Reading::open(path).unwrap().map(Result::unwrap).collect()
}

fn of<'a>(entries: &'a [Entry], topic: &str) -> Vec<&'a Entry> {
    entries.iter().filter(|entry| entry.topic.name == topic).collect()
}

#[test]
fn every_cycle_of_every_axis_is_in_the_file_as_the_application_saw_it() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("run.mcap");
    let mut m = machine(Recorder::create(&path).unwrap());
    let mut seen = vec![Vec::new(); AXES];
    let mut posted = 0;
    for turn in 0..8_000 {
        match turn {
            500 => posted = m.axis(0).post(Command::Enable).unwrap().0,
            900 => drop(m.axis(0).post(Command::Home).unwrap()),
            6_000 => {
                let profile = Profile { velocity: 50.0, acceleration: 500.0, deceleration: 500.0 };
                let target = Target::Relative(4.0);
                m.axis(0).post(Command::Move(Move { target, profile })).unwrap();
            }
            _ => {}
        }
        m.step();
        for (index, seen) in seen.iter_mut().enumerate() {
            let feedback = m.feedback(index);
            seen.push((feedback.cycle, feedback.status));
        }
    }
    let [recorded] = &m.finish_recording()[..] else { panic!("one file") };
    assert!(recorded.error.is_none() && recorded.lost == 0, "{recorded}");
    assert!(m.finish_recording().is_empty(), "once");
    let entries = read(&path);
    assert_eq!(entries.len() as u64, recorded.messages);
    assert_eq!(std::fs::metadata(&path).unwrap().len(), recorded.bytes);
    for (index, seen) in seen.iter().enumerate() {
        let axis = of(&entries, &format!("/axes/d{index}"));
        assert_eq!(axis.len(), seen.len());
        for (entry, (cycle, status)) in axis.iter().zip(seen) {
            let texts =
                ["cycle", "position", "demand", "velocity", "state_name"].map(|field| entry.text(field));
            let velocity = status.velocity as f32;
            let expected = [
                cycle.to_string(),
                status.position.to_string(),
                status.demand.to_string(),
                velocity.to_string(),
                status.state.to_string(),
            ];
            assert_eq!(texts, expected);
        }
        assert_eq!(axis[1].utc_ns - axis[0].utc_ns, MS);
    }
    let begun: Vec<_> = of(&entries, "/commands").iter().map(|entry| entry.text("command_name")).collect();
    assert_eq!(begun, ["enable", "enable", "home", "home", "move", "move"]);
    let ends = of(&entries, "/events").into_iter().filter(|entry| entry.text("kind") == "ended");
    let ends: Vec<_> = ends.map(|entry| (entry.number("id"), entry.text("text"))).collect();
    assert_eq!(ends, [0, 1, 2].map(|later| (posted + later, "done".to_owned())));
}

#[test]
fn a_window_holds_what_is_newest_and_is_written_when_something_fails() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("newest.mcap");
    let mut m = machine(Recorder::window(&path, std::time::Duration::from_millis(500)).unwrap());
    m.run(2_000);
    let address = "10.0.0.11:49360".parse().unwrap();
    assert!(m.world().unplug(address));
    m.run(2_000);
    let recorded = m.finish_recording();
    let [failed, end] = &recorded[..] else { panic!("{recorded:?}") };
    assert_eq!((&*failed.why, &*end.why), ("drive d1: link lost", "end of the run"));
    let cycles = |path: &Path| -> Vec<u64> {
        of(&read(path), "/cycle").iter().map(|entry| entry.number("cycle")).collect()
    };
    let newest = cycles(&path);
    // The 200 ms that follow upon a failure are kept besides.
    assert_eq!((newest[0], newest.len()), (3_999 - 700, 701));
    // What led up to it, and how it went on.
    let around = cycles(&failed.path);
    let name = failed.path.file_stem().unwrap().to_str().unwrap();
    let cycle: u64 = name.strip_prefix("newest-cycle-").unwrap().parse().unwrap();
    assert!(cycle > 2_000 && around.len() == 701, "{cycle} {}", around.len());
    assert_eq!((around[0], *around.last().unwrap()), (cycle - 500, cycle + 200));
    let lost =
        of(&read(&failed.path), "/axes/d1").iter().map(|entry| entry.text("link_name")).collect::<Vec<_>>();
    assert_eq!((&*lost[0], &**lost.last().unwrap()), ("online", "lost"));
}

#[test]
fn an_unrecordable_machine_is_refused_before_the_run() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("there.mcap");
    std::fs::write(&path, "mine").unwrap();
    let nowhere = directory.path().join("none/x.mcap");
    let window = std::time::Duration::from_secs(1);
    for open in [Recorder::create, |path| Recorder::window(path, std::time::Duration::from_secs(1))] {
        assert!(matches!(open(path.clone()), Err(RecordError::Exists(_))));
        let text = open(nowhere.clone()).unwrap_err().to_string();
        assert!(text.contains("No such file or directory") && !text.contains('\n'), "{text}");
    }
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "mine");
    let fresh = directory.path().join("fresh.mcap");
    drop(Recorder::window(&fresh, window).unwrap());
    assert!(!fresh.exists());
    let refused = Recorder::window(&fresh, window).and_then(Recorder::with_wire).unwrap_err();
    assert!(matches!(refused, RecordError::WireOfWindow) && !refused.to_string().contains('\n'), "{refused}");
    assert!(!fresh.exists());
}

#[test]
fn a_run_that_does_not_start_leaves_no_file() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    for wire in [false, true] {
        let recorder = Recorder::create(&path).unwrap();
        assert!(path.exists());
        let recorder = if wire { recorder.with_wire().unwrap() } else { recorder };
        let cycle = CyclePlan { period_ns: 0, ..CyclePlan::default() };
        let setup = Master::from_plan(Plan { cycle, ..Plan::default() }).with_recorder(recorder);
        assert!(setup.simulate(WorldOptions::default()).is_err());
        assert!(!path.exists());
    }
    // Nor does a recording of no run.
    drop(Recorder::create(&path).unwrap());
    assert!(!path.exists());
}

#[test]
fn native_process_data_of_a_drive_that_is_not_there_are_refused_and_no_file_is_left() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    let setup = |names: &[&str]| {
        let recorder = Recorder::create(&path).unwrap().with_native(names.iter().copied());
        Master::from_plan(plan()).with_recorder(recorder)
    };
    let refused = setup(&["d1", "d2"]).simulate(WorldOptions::default()).unwrap_err().to_string();
    assert_eq!(
        refused,
        "there is no drive \"d2\" whose native process data could be recorded; name all, or some of: d0, d1"
    );
    assert_eq!(setup(&["d1", "d2"]).start().unwrap_err().to_string(), refused);
    assert!(!path.exists(), "the next start may use its name");
    let mut m = setup(&["all"]).simulate(WorldOptions::default()).unwrap();
    m.run(100);
    m.finish_recording();
    let entries = read(&path);
    for name in ["d0", "d1"] {
        assert_eq!(of(&entries, &format!("/axes/{name}/native")).len(), 100, "{name}");
    }
}
