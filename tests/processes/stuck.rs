//! A loop whose cycle does not end: a task that never returns or comes back late, a thread that the host does not run,
//! a send that hangs. The watch stops the drives; the application, the program and the next master see why.

use std::net::{SocketAddrV4, UdpSocket};
use std::os::fd::RawFd;
use std::path::{Path, PathBuf};
use std::process::exit;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::sleep;
use std::{io, thread};

use fieldbeat::axis::{
    Axis, AxisError, CallError, Command, Link, Move, ParameterError, Profile, StopCause, Target,
};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::telemetry::Summary;
use fieldbeat::{Master, MasterError, OpenError};
use fieldbeat_core::bus::Bus;
use fieldbeat_core::net::{Carriers, Datagrams, Outbox, Received, Sent, UdpOptions};
use fieldbeat_core::rt::Regions;
use fieldbeat_linudp::wire::Request;

use super::support::controller::{TARGET, VELOCITY, set_out};
use super::support::hold::{Hold, thread as thread_of};
use super::support::onlooker::Onlooker;
use super::support::{LONG, Machine, Program, again, drive, plan, role, until};
use super::{MS, linudp, online, serve, simulation};

/// The test that plays the programs of all others.
const PROGRAM: &str = "stuck::a_task_that_never_returns_ends_in_a_stop_of_its_drives_and_of_the_program";

/// When its axes move.
const UNDER_WAY: &str = "under way";

/// A machine whose loop is soon stuck, and whose drives go off two seconds after a stop at the latest.
fn config(machine: &Machine, cycle: &str, defaults: &str) -> PathBuf {
    let defaults = format!(
        "limits = {{ position = [0, 2000] }}\nno_drive_watchdog = \"accept\"\nleash = 20\njog_deadman = \"30s\"\n\
         stop.timeout = \"2s\"\n{defaults}"
    );
    machine.config("m.toml", 2, &format!("watch_after = \"300ms\"\n{cycle}"), &defaults)
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
    let config = config(&machine, "", START);
    let _sim = simulation(&config);
    let onlooker = Onlooker::new(&machine);
    for ways in ["never finish", "never drop", "late finish"] {
        let program = program(ways, &config);
        for index in [0, 1] {
            // Halted and held first, and then off as the stop plan says.
            let stands = onlooker.await_sight(machine.drive(index), |sight| !sight.moving);
            assert!(stands.position < TARGET, "{ways}: {stands:?}");
            let off = onlooker.await_sight(machine.drive(index), |sight| !sight.powered);
            assert!((off.position - stands.position).abs() < 1.0, "{ways}: {stands:?} {off:?}");
        }
        let ended = program.end();
        ended.expect(1);
        assert!(
            ended.out.contains("the loop is stuck: its cycle has not ended within watch_after"),
            "{ended:?}"
        );
        match ways.ends_with("drop") {
            true => assert!(ended.out.contains("dropped"), "{ended:?}"),
            false => {
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
    }
}

/// A drive that obeys its first master only takes the last stop as well: it leaves from the socket of the loop. The
/// next master is let in by its address.
#[test]
fn the_stop_of_the_watch_comes_from_the_master_that_a_drive_knows() {
    let machine = Machine::new(213);
    let config = config(&machine, "", "simulate = { start = 10, filter = \"single\" }");
    let _sim = simulation(&config);
    program("never drop", &config).end().expect(1);
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
    let config = config(&machine, "", START);
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

/// A LinUDP bus whose socket hangs in the send of a motion command, once: between the loop's check and the wire.
#[derive(Clone, Debug)]
struct Freezing {
    plan: LinUdpPlan,
    freeze: Arc<Freeze>,
}

#[derive(Debug, Default)]
struct Freeze {
    armed: AtomicBool,
    frozen: AtomicBool,
    released: AtomicBool,
    /// Calls of the socket by the loop since it was released, but for the one that had begun.
    later: AtomicU64,
}

impl BusPlan for Freezing {
    crate::forward_bus_plan!(plan);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        self.plan.open(period_ns, &FreezingCarriers { carriers, freeze: &self.freeze })
    }
}

struct FreezingCarriers<'a> {
    carriers: &'a dyn Carriers,
    freeze: &'a Arc<Freeze>,
}

impl Carriers for FreezingCarriers<'_> {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        let net = self.carriers.datagrams(bind, options)?;
        Ok(Box::new(FreezingSocket { net, freeze: Arc::clone(self.freeze) }))
    }
}

struct FreezingSocket {
    net: Box<dyn Datagrams>,
    freeze: Arc<Freeze>,
}

impl Datagrams for FreezingSocket {
    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let freeze = &self.freeze;
        freeze.later.fetch_add(freeze.released.load(Ordering::Relaxed).into(), Ordering::Relaxed);
        let commands = |index| {
            outbox.sent(index) == Sent::Posted
                && Request::parse(outbox.bytes(index)).is_ok_and(|request| request.motion.is_some())
        };
        if freeze.armed.load(Ordering::Relaxed) && (0..outbox.len()).any(commands) {
            freeze.armed.store(false, Ordering::Relaxed);
            freeze.frozen.store(true, Ordering::Relaxed);
            while !freeze.released.load(Ordering::Relaxed) {
                sleep(MS);
            }
        }
        self.net.send(outbox);
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let freeze = &self.freeze;
        freeze.later.fetch_add(freeze.released.load(Ordering::Relaxed).into(), Ordering::Relaxed);
        self.net.receive(take)
    }

    fn batch(&self) -> usize {
        self.net.batch()
    }

    fn twin(&self) -> io::Result<Option<UdpSocket>> {
        self.net.twin()
    }

    fn memory(&self, regions: &mut Regions) {
        self.net.memory(regions);
    }
}

#[test]
fn a_request_that_a_frozen_loop_still_sends_is_followed_by_a_stop_and_by_nothing_else_of_it() {
    let machine = Machine::new(216);
    let config = config(&machine, "", START);
    let _sim = serve(&config);
    let onlooker = Onlooker::new(&machine);
    let mut plan = plan(&config);
    let freeze = Arc::<Freeze>::default();
    let freezing = Freezing { plan: linudp(&mut plan), freeze: Arc::clone(&freeze) };
    plan.buses.push(Box::new(freezing));
    let master = Master::from_plan(plan).start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axis = master.axis("d0").unwrap();
    axis.enable().unwrap();
    axis.home().unwrap();
    let before = onlooker.look(machine.drive(0));

    freeze.armed.store(true, Ordering::Relaxed);
    set_out(&mut axis, false).unwrap();
    assert!(until(LONG, || freeze.frozen.load(Ordering::Relaxed)));
    assert!(until(LONG, || !master.is_running()));
    let halted = onlooker.look(machine.drive(0));
    assert!(halted.powered && (halted.position - before.position).abs() < 0.5, "{before:?} {halted:?}");

    // Its motion command goes out now: the drive sets out, and is stopped by the next turn of the watch.
    freeze.released.store(true, Ordering::Relaxed);
    let run = master.finish();
    let stands = onlooker.await_sight(machine.drive(0), |sight| !sight.moving && !sight.powered);
    assert!(stands.position < before.position + VELOCITY, "{before:?} {stands:?}");
    assert_eq!(freeze.later.load(Ordering::Relaxed), 0, "the loop has used its socket");
    assert_eq!(run.end.drives[0].feedback.stopped, Some(StopCause::LoopStuck));
    assert!(run.measured.failures.iter().any(|failure| failure.what.contains("stuck") && failure.fails_run));
}
