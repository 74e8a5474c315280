//! A loop whose cycle does not end: a task that never returns or comes back late, a thread that the host does not run.
//! The watch stops the drives; the application, the program and the next master see why.

use std::path::{Path, PathBuf};
use std::process::exit;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use fieldbeat::axis::{
    Axis, AxisError, CallError, Command, Link, Move, ParameterError, Profile, StopCause, Target,
};
use fieldbeat::telemetry::Summary;
use fieldbeat::{Master, MasterError};

use super::support::controller::{TARGET, VELOCITY, set_out};
use super::support::hold::{Hold, thread as thread_of};
use super::support::onlooker::Onlooker;
use super::support::{LONG, Machine, Program, again, drive, role, until};
use super::{online, simulation};

/// The test that plays the programs of all others.
const PROGRAM: &str = "stuck::a_task_that_never_returns_ends_in_a_stop_of_its_drives_and_of_the_program";

const WHY: &str = "the loop is stuck: its cycle has not ended within watch_after";

/// When its axes move.
const UNDER_WAY: &str = "under way";

/// A machine whose loop is soon stuck, and whose drives go off two seconds after a stop at the latest.
fn config(machine: &Machine, defaults: &str) -> PathBuf {
    let defaults = format!(
        "limits = {{ position = [0, 2000] }}\nno_drive_watchdog = \"accept\"\nleash = 20\njog_deadman = \
         \"30s\"\nstop.timeout = \"2s\"\n{defaults}"
    );
    machine.config("m.toml", 2, "watch_after = \"300ms\"", &defaults)
}

const START: &str = "simulate = { start = 10 }";

/// A host program with an in-loop task that, once its axes move, does not return: `never`, or until they stand for
/// `late`. It ends by `finish` or by `drop`.
fn program(ways: &str, config: &Path) -> Program {
    let mut program = Program::spawn(&mut again(PROGRAM, &format!("{ways} {}", config.display())));
    program.await_text(UNDER_WAY);
    program
}

fn play(role: &str) -> ! {
    let [returns, ends, config] = role.splitn(3, ' ').collect::<Vec<_>>().try_into().unwrap();
    let hangs = Arc::new(AtomicBool::new(false));
    let setup = Master::from_file(config).unwrap();
    let hang = Arc::clone(&hangs);
    let setup = setup.with_task(move |_, _| {
        while hang.load(Ordering::Relaxed) {
            std::hint::spin_loop();
        }
    });
    let master = setup.start().unwrap();
    master.wait_online(LONG).unwrap();
    let [mut moves, mut jogs] = ["d0", "d1"].map(|name| master.axis(name).unwrap());
    for axis in [&mut moves, &mut jogs] {
        axis.enable().unwrap();
        axis.home().unwrap();
    }
    let profile = Profile { velocity: VELOCITY, ..moves.profile() };
    let command = Command::Move(Move { target: Target::Absolute(TARGET), profile });
    let id = moves.post(command).unwrap();
    set_out(&mut jogs, true).unwrap();
    let moved = |axis: &Axis| axis.feedback().status.position > 5.0;
    assert!(until(LONG, || moved(&moves) && moved(&jogs)));
    println!("{UNDER_WAY}");
    let parameter = master.parameter("d1").unwrap();
    let reads = thread::spawn(move || {
        // Some succeed before the loop hangs.
        until(LONG, || match parameter.read::<u32>("1B8Dh") {
            Err(ParameterError::Failed { why, .. }) => {
                assert_eq!(why, CallError::Stuck);
                true
            }
            _ => false,
        })
    });
    hangs.store(true, Ordering::Relaxed);

    // Who waits gets the cause, and so does who comes now.
    let why = moves.wait(id, command.name(), LONG).unwrap_err();
    assert!(matches!(why, AxisError::Stuck { .. }), "{why}");
    println!("{why}");
    assert!(matches!(jogs.stop(), Err(AxisError::Stuck { .. })));
    assert!(matches!(jogs.set_velocity(1.0), Err(AxisError::Stuck { .. })));
    assert!(matches!(master.wait_online(LONG), Err(MasterError::Stuck)));
    assert!(!master.is_running());
    assert!(reads.join().unwrap(), "no read has ended with the cause");
    let feedback = moves.feedback();
    assert_eq!((feedback.stopped, feedback.link), (Some(StopCause::LoopStuck), Link::Lost));
    assert!(until(LONG, || moves.feedback().age > feedback.age && feedback.age > 10), "it does not age");
    if returns == "late" {
        hangs.store(false, Ordering::Relaxed);
    }
    if ends == "drop" {
        drop(master);
        println!("dropped");
        exit(1)
    }
    let run = master.finish();
    let summary = Summary::from(&run);
    println!("{}", serde_json::to_string(&summary).unwrap());
    exit(if summary.has_failed() { 1 } else { 0 })
}

#[test]
fn a_task_that_never_returns_ends_in_a_stop_of_its_drives_and_of_the_program() {
    if let Some(role) = role() {
        play(&role);
    }
    let machine = Machine::new(230);
    let config = config(&machine, START);
    let _sim = simulation(&config);
    let onlooker = Onlooker::new(&machine);
    for ways in ["never finish", "late finish"] {
        let program = program(ways, &config);
        for index in [0, 1] {
            // Halted and held first, and then off as the stop plan says.
            let stands = onlooker.await_sight(machine.drive(index), |sight| !sight.moving);
            assert!(stands.position < TARGET, "{ways}: {stands:?}");
            let off = onlooker.await_sight(machine.drive(index), |sight| !sight.powered);
            assert!((off.position - stands.position).abs() < 1.0, "{ways}: {stands:?} {off:?}");
        }
        let ended = program.end();
        assert!(ended.expect(1).out.contains(WHY), "{ended:?}");
        let line = ended.out.lines().find(|line| line.starts_with('{')).unwrap();
        let summary: serde_json::Value = serde_json::from_str(line).unwrap();
        assert!(summary["failures"][0]["what"].as_str().unwrap().contains("stuck"), "{summary}");
        // A loop that comes back latches its axes itself.
        let stopped = if ways.starts_with("late") { "loop stuck" } else { "" };
        for name in ["d0", "d1"] {
            let cause = drive(&summary, name)["stopped"].as_str().unwrap_or("").to_owned();
            assert!(cause.contains(stopped), "{ways}: {summary}");
        }
    }
}

/// A drive that obeys its first master only takes the last stop as well: it leaves from the socket of the loop. The
/// next master is let in by its address.
#[test]
fn the_stop_of_the_watch_comes_from_the_master_that_a_drive_knows() {
    let machine = Machine::new(213);
    let config = config(&machine, "simulate = { start = 10, filter = \"single\" }");
    let _sim = simulation(&config);
    let ended = program("never drop", &config).end();
    assert!(ended.expect(1).out.contains(WHY) && ended.out.contains("dropped"), "{ended:?}");
    let next = Master::from_file(&config).unwrap().start().unwrap();
    next.wait_online(LONG).unwrap();
    for (_, observer) in next.observers() {
        let feedback = observer.feedback();
        assert!(!feedback.status.state.is_powered() && !feedback.status.moving, "{feedback:?}");
        assert!(feedback.status.position < TARGET, "{feedback:?}");
        assert_eq!(feedback.stopped, None, "nothing was found running");
    }
}

/// A loop that the host does not run, wherever it stands: its whole process goes on.
#[test]
fn a_program_whose_loop_is_held_up_for_good_ends_as_failed() {
    let machine = Machine::new(214);
    let config = config(&machine, START);
    let _sim = simulation(&config);
    let master = online(&config, &["--json"]);
    let hold = Hold::seize(thread_of(master.pid(), "fb-loop"));
    hold.stop();
    let held = thread::spawn(move || hold.await_end());
    let ended = master.end();
    held.join().unwrap();
    ended.expect(1);
    assert!(ended.err.contains("the loop is stuck"), "{ended:?}");
    let summary = ended.json();
    assert_eq!(summary["failures"][0]["fails_run"], true, "{summary}");
}
