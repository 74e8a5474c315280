//! What becomes of the axes when a program with a master of its own ends, in whichever way, by the reports of the
//! drives. One test for each row of the manual's table.

use std::process::exit;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::thread::{sleep, spawn};

use fieldbeat::axis::{Axis, Observer, StopCause};
use fieldbeat::{Group, Master};
use libc::{SIGABRT, SIGHUP, SIGINT, SIGKILL, SIGTERM};

use super::support::controller::{RAMP, TARGET, config, set_out};
use super::support::onlooker::{Onlooker, Sight};
use super::support::{Ended, LONG, Machine, Program, again, role, until};
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
    let mut setup = Master::from_file(config).unwrap().with_task(move |_, _| {
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
    master.wait_online(LONG).unwrap();
    let mut axes: Vec<_> = master.observers().iter().map(|(name, _)| master.axis(name).unwrap()).collect();
    for axis in &mut axes {
        axis.enable().unwrap();
        axis.home().unwrap();
    }
    axes.iter_mut().for_each(|axis| set_out(axis, false).unwrap());
    assert!(until(LONG, || axes.iter().all(|axis| axis.feedback().status.position > 10.0)));
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
    fn start(machine: Machine, what: &str) -> Hosted {
        let config = config(&machine, "m.toml", 2, "", "stop.group = \"all\"");
        let sim = simulation(&config);
        let onlooker = Onlooker::new(&machine);
        let mut host = Program::spawn(&mut again(HOST, &format!("{what} {}", config.display())));
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

    /// It ends with its axes at rest, down their ramps from where they were at least.
    #[track_caller]
    fn ends_in_order(self, code: Option<i32>, signal: Option<i32>) -> Ended {
        let (ended, after) = self.end();
        assert_eq!((ended.code, ended.signal), (code, signal), "{ended:?}");
        for sight in after {
            assert!(!sight.moving && !sight.powered, "{sight:?}");
            assert!(sight.position > 10.0 + 0.9 * RAMP && sight.position < TARGET, "{sight:?}");
        }
        ended
    }

    /// It ends, and its drives go on to the end of their move: nobody is left to stop them.
    #[track_caller]
    fn ends_at_once(self, code: Option<i32>, signal: Option<i32>) {
        let (ended, after) = self.end();
        assert_eq!((ended.code, ended.signal), (code, signal), "{ended:?}");
        assert!(after.iter().all(|sight| sight.moving && sight.operating), "{after:?}");
    }
}

#[test]
fn a_host_that_returns_ends_its_static_master_in_order() {
    if let Some(role) = role() {
        return play(&role);
    }
    Hosted::start(Machine::new(134), "return").ends_in_order(Some(0), None);
}

#[test]
fn a_host_that_calls_exit_ends_its_master_in_order() {
    Hosted::start(Machine::new(135), "exit").ends_in_order(Some(3), None);
}

#[test]
fn an_exit_during_a_blocking_call_ends_the_master_in_order() {
    Hosted::start(Machine::new(136), "exit-in-call").ends_in_order(Some(3), None);
}

#[test]
fn two_exits_at_once_end_the_master_in_order() {
    Hosted::start(Machine::new(137), "exit-twice").ends_in_order(Some(3), None);
}

#[test]
fn an_exit_in_a_panic_hook_ends_the_master_in_order() {
    Hosted::start(Machine::new(138), "exit-in-hook").ends_in_order(Some(4), None);
}

#[test]
fn an_exit_on_the_loop_itself_ends_the_process_and_nothing_else() {
    Hosted::start(Machine::new(139), "exit-in-task").ends_at_once(Some(5), None);
}

#[test]
fn an_exit_after_the_end_of_the_master_finds_nothing_to_do() {
    Hosted::start(Machine::new(145), "exit-after").ends_in_order(Some(3), None);
}

#[test]
fn the_exit_of_a_forked_child_stops_nothing() {
    let ended = Hosted::start(Machine::new(146), "fork").ends_in_order(Some(0), None);
    assert!(ended.out.contains("[None, None]"), "{ended:?}");
}

#[test]
fn a_panic_that_unwinds_ends_the_master_in_order() {
    Hosted::start(Machine::new(147), "panic").ends_in_order(Some(101), None);
}

#[test]
fn a_dropped_master_ends_in_order() {
    Hosted::start(Machine::new(148), "drop-master").ends_in_order(Some(0), None);
}

#[test]
fn dropped_axes_and_groups_come_to_rest_while_their_host_goes_on() {
    for (machine, what) in [(Machine::new(149), "drop-axes"), (Machine::new(217), "drop-group")] {
        let mut hosted = Hosted::start(machine, what);
        hosted.host.await_text("at rest");
        let rests = hosted.look();
        for sight in rests {
            assert!(!sight.moving && !sight.powered, "{sight:?}");
            assert!(sight.position > 10.0 + 0.9 * RAMP && sight.position < TARGET, "{sight:?}");
        }
        hosted.host.signal(SIGKILL);
        hosted.end();
    }
}

#[test]
fn caught_signals_end_the_master_in_order_and_then_the_process_as_ever() {
    for (machine, signal) in
        [(Machine::new(218), SIGINT), (Machine::new(219), SIGTERM), (Machine::new(177), SIGHUP)]
    {
        let hosted = Hosted::start(machine, "caught-wait");
        hosted.host.signal(signal);
        hosted.ends_in_order(None, Some(signal));
    }
}

#[test]
fn a_second_signal_shortens_the_stop() {
    let hosted = Hosted::start(Machine::new(178), "caught-wait");
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

#[test]
fn a_signal_that_the_host_handles_is_left_to_it() {
    let hosted = Hosted::start(Machine::new(220), "caught-own");
    hosted.host.signal(SIGTERM);
    let ended = hosted.ends_in_order(Some(0), None);
    assert!(ended.out.contains("[None, None]"), "{ended:?}");
}

#[test]
fn a_signal_that_is_not_caught_ends_the_process_at_once() {
    let hosted = Hosted::start(Machine::new(221), "wait");
    hosted.host.signal(SIGTERM);
    hosted.ends_at_once(None, Some(SIGTERM));
}

#[test]
fn a_killed_host_stops_nothing() {
    let hosted = Hosted::start(Machine::new(186), "caught-wait");
    hosted.host.signal(SIGKILL);
    hosted.ends_at_once(None, Some(SIGKILL));
}

#[test]
fn an_abort_stops_the_axes_only_where_signals_are_caught() {
    Hosted::start(Machine::new(187), "abort").ends_at_once(None, Some(SIGABRT));
    Hosted::start(Machine::new(188), "caught-abort").ends_in_order(None, Some(SIGABRT));
}
