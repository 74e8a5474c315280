//! What becomes of the axes when a program with a master of its own ends, in whichever way, by the reports of the
//! drives. One test for each row of the manual's table.

use std::path::Path;
use std::process::exit;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::thread::{sleep, spawn};

use fieldbeat::axis::{Axis, Observer, StopCause};
use fieldbeat::{Group, Master};
use libc::{SIGABRT, SIGHUP, SIGINT, SIGKILL, SIGTERM};

use super::support::controller::{RAMP, TARGET, config, set_all_out};
use super::support::onlooker::{Onlooker, Sight};
use super::support::{Ended, LONG, Machine, Program, again, memory_of, role, until};
use super::{MS, simulation};

/// The test that plays the hosts of all others.
const HOST: &str = "hosts::a_host_that_returns_ends_its_static_master_in_order";

const UNDER_WAY: &str = "under way";

/// A master that is never dropped, with its axes.
static MASTER: OnceLock<(Master, Mutex<Vec<Axis>>)> = OnceLock::new();

/// A program with a master of its own, which sends its axes on a long way and then does `what`.
fn play(role: &str) {
    let (what, config) = role.split_once(' ').unwrap();
    let now = Arc::new(AtomicBool::new(false));
    let of_task = Arc::clone(&now);
    let in_task = what.to_owned();
    let boxes = Path::new(config).with_file_name("boxes");
    let mut setup = Master::from_file(config).unwrap().with_black_box(boxes).with_task(move |_, _| {
        if of_task.load(Ordering::Relaxed) && in_task == "exit-in-task" {
            exit(5);
        }
    });
    if what.starts_with("caught") {
        setup = setup.stop_on_signals();
    }
    let own = Arc::new(AtomicBool::new(false));
    if what == "caught-own" {
        signal_hook::flag::register(SIGTERM, Arc::clone(&own)).unwrap();
    }
    let master = setup.start().unwrap();
    let mut axes = set_all_out(&master, false);
    println!("{UNDER_WAY}");
    let observers: Vec<_> = axes.iter().map(Axis::observer).collect();
    match what {
        "return" => assert!(MASTER.set((master, Mutex::new(axes))).is_ok()),
        "exit" => exit(3),
        "exit-in-call" => {
            spawn(|| {
                sleep(100 * MS);
                exit(3);
            });
            let profile = axes[0].profile();
            let ended = axes[0].move_to(TARGET, profile);
            unreachable!("it ended first: {ended:?}");
        }
        "exit-twice" => {
            spawn(|| exit(3));
            exit(3);
        }
        "exit-in-hook" => {
            std::panic::set_hook(Box::new(|_| exit(4)));
            panic!("for its hook");
        }
        "exit-in-task" => {
            now.store(true, Ordering::Relaxed);
            sleep(LONG);
        }
        "exit-after" => {
            let run = master.finish();
            assert!(run.end.panic.is_none());
            exit(3);
        }
        "fork" => {
            // SAFETY: the child does nothing but to exit.
            let child = unsafe { libc::fork() };
            if child == 0 {
                exit(0);
            }
            let mut status = 0;
            // SAFETY: `status` has room for it.
            assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
            assert_eq!(status, 0);
            sleep(200 * MS);
            println!("{:?}", observers.iter().map(|axis| axis.feedback().stopped).collect::<Vec<_>>());
            assert!(MASTER.set((master, Mutex::new(axes))).is_ok());
        }
        "panic" => panic!("with all that is dropped by it"),
        "drop-master" => {
            drop(master);
            assert_eq!(axes.len(), 2);
        }
        "drop-axes" => {
            drop(axes);
            report_rest(&master, &observers);
        }
        "drop-group" => {
            let group = Group::new(axes).unwrap();
            drop(group);
            report_rest(&master, &observers);
        }
        "abort" | "caught-abort" => std::process::abort(),
        "caught-own" => {
            assert!(until(LONG, || own.load(Ordering::Relaxed)));
            sleep(200 * MS);
            println!("{:?}", observers.iter().map(|axis| axis.feedback().stopped).collect::<Vec<_>>());
            assert!(MASTER.set((master, Mutex::new(axes))).is_ok());
        }
        "wait" | "caught-wait" => sleep(LONG),
        other => unreachable!("{other}"),
    }
}

/// The axes have stopped while their program goes on; that is no failure of its run.
fn report_rest(master: &Master, observers: &[Observer]) {
    assert!(until(LONG, || observers.iter().all(|axis| !axis.feedback().status.state.is_powered())));
    for axis in observers {
        let stopped = axis.feedback().stopped;
        assert!(matches!(stopped, Some(StopCause::OwnerLost | StopCause::Group)), "{stopped:?}");
    }
    assert!(master.is_running());
    println!("at rest");
    // Until it is killed: nothing else is to stop them.
    sleep(LONG);
}

/// A host under way, with its two drives.
struct Hosted {
    machine: Machine,
    _sim: Program,
    onlooker: Onlooker,
    host: Program,
}

impl Hosted {
    fn start(test: u8, what: &str) -> Hosted {
        let machine = Machine::new(test);
        let config = config(&machine, "m.toml", 2, "", "stop.group = \"all\"");
        let sim = simulation(&config);
        let onlooker = Onlooker::new(&machine);
        let host = Program::spawn(&mut again(HOST, &format!("{what} {}", config.display())));
        let mut host = host.leaving_memory();
        host.await_text(UNDER_WAY);
        Hosted { machine, _sim: sim, onlooker, host }
    }

    fn look(&self) -> [Sight; 2] {
        [0, 1].map(|index| self.onlooker.look(self.machine.drive(index)))
    }

    /// The end of the host, and its drives after it.
    fn end(self) -> (Ended, [Sight; 2]) {
        let Hosted { machine, onlooker, host, _sim } = self;
        let ended = host.end();
        let after = [0, 1].map(|index| onlooker.look(machine.drive(index)));
        (ended, after)
    }
}

/// Down its ramp from where it was at least, and off.
fn rests(sight: &Sight) -> bool {
    let way = 10.0 + 0.9 * RAMP..TARGET;
    !sight.moving && !sight.powered && way.contains(&sight.position)
}

/// How a process ends.
#[derive(Clone, Copy, Debug, PartialEq)]
enum End {
    Code(i32),
    Signal(i32),
}

/// Each row: what a host does, a signal to it, how it ends, and whether its axes are at rest then, or go on to the end
/// of their move, since nobody is left to stop them. Three at a time.
fn end_so(first: u8, rows: &[(&str, Option<i32>, End, bool)]) {
    for (chunk, rows) in rows.chunks(3).enumerate() {
        std::thread::scope(|scope| {
            for (index, (what, signal, end, stops)) in rows.iter().enumerate() {
                let test = first + (3 * chunk + index) as u8;
                scope.spawn(move || {
                    let hosted = Hosted::start(test, what);
                    signal.iter().for_each(|signal| hosted.host.signal(*signal));
                    let process = hosted.host.pid();
                    let (ended, after) = hosted.end();
                    // What is no orderly end leaves the last records.
                    let memory = memory_of(process);
                    assert_eq!(memory.is_some(), !stops || *end == End::Signal(SIGABRT), "{what} {signal:?}");
                    memory.map(std::fs::remove_file);
                    let by = ended.signal.map(End::Signal).or(ended.code.map(End::Code));
                    assert_eq!(by, Some(*end), "{what} {signal:?}: {ended:?}");
                    let goes_on = |sight: &Sight| sight.moving && sight.operating;
                    let is_right = |sight: &Sight| if *stops { rests(sight) } else { goes_on(sight) };
                    assert!(after.iter().all(is_right), "{what} {signal:?}: {after:?}");
                    let is_left_alone = what.starts_with("fork") || *what == "caught-own";
                    assert!(!is_left_alone || ended.out.contains("[None, None]"), "{what}: {ended:?}");
                });
            }
        });
    }
}

#[test]
fn a_host_that_returns_ends_its_static_master_in_order() {
    if let Some(role) = role() {
        return play(&role);
    }
    end_so(134, &[("return", None, End::Code(0), true), ("drop-master", None, End::Code(0), true)]);
}

#[test]
fn an_exit_wherever_it_comes_from_ends_the_master_in_order_but_on_its_loop() {
    end_so(
        52,
        &[
            ("exit", None, End::Code(3), true),
            ("exit-in-call", None, End::Code(3), true),
            ("exit-twice", None, End::Code(3), true),
            ("exit-in-hook", None, End::Code(4), true),
            ("exit-in-task", None, End::Code(5), false),
            // It finds nothing to do, and that of a forked child stops nothing.
            ("exit-after", None, End::Code(3), true),
            ("fork", None, End::Code(0), true),
            ("panic", None, End::Code(101), true),
        ],
    );
}

/// Caught ones end the master in order, and then the process as ever; one that the host handles is left to it.
#[test]
fn a_signal_or_an_abort_stops_the_axes_only_where_signals_are_caught() {
    end_so(
        205,
        &[
            ("caught-wait", Some(SIGINT), End::Signal(SIGINT), true),
            ("caught-wait", Some(SIGTERM), End::Signal(SIGTERM), true),
            ("caught-wait", Some(SIGHUP), End::Signal(SIGHUP), true),
            ("caught-own", Some(SIGTERM), End::Code(0), true),
            ("caught-abort", None, End::Signal(SIGABRT), true),
            ("caught-wait", Some(SIGKILL), End::Signal(SIGKILL), false),
            ("wait", Some(SIGTERM), End::Signal(SIGTERM), false),
            ("abort", None, End::Signal(SIGABRT), false),
        ],
    );
}

#[test]
fn dropped_axes_and_groups_come_to_rest_while_their_host_goes_on() {
    for (test, what) in [(148, "drop-axes"), (149, "drop-group")] {
        let mut hosted = Hosted::start(test, what);
        hosted.host.await_text("at rest");
        let sights = hosted.look();
        assert!(sights.iter().all(rests), "{what}: {sights:?}");
        let process = hosted.host.pid();
        drop(hosted);
        assert!(memory_of(process).map(std::fs::remove_file).is_some(), "it was killed");
    }
}

#[test]
fn a_second_signal_shortens_the_stop() {
    let hosted = Hosted::start(178, "caught-wait");
    hosted.host.signal(SIGTERM);
    sleep(100 * MS);
    let before = hosted.look();
    hosted.host.signal(SIGINT);
    let (ended, after) = hosted.end();
    assert_eq!(ended.signal, Some(SIGTERM), "by the first one: {ended:?}");
    for (before, after) in before.into_iter().zip(after) {
        assert!(before.operating && !after.moving && !after.powered, "{before:?} {after:?}");
        assert!(after.position - before.position < 0.8 * RAMP, "{before:?} {after:?}");
    }
}
