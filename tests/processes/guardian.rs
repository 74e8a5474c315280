//! The guardian of a program with LinMots: it stops them when the program is killed, crashes or does not run, and does
//! nothing else. What became of the axes is what the drives themselves show.

use std::net::{SocketAddrV4, UdpSocket};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::exit;
use std::thread::sleep;
use std::time::{Duration, Instant};

use fieldbeat::Master;
use fieldbeat::axis::{Axis, AxisError, Command as AxisCommand, Move, Profile, Row, StopCause, Target};
use fieldbeat::telemetry::Summary;
use libc::{SIGABRT, SIGBUS, SIGCONT, SIGHUP, SIGINT, SIGKILL, SIGQUIT, SIGSEGV, SIGSTOP, SIGTERM};
use nix::sys::socket::{getsockopt, sockopt::PeerCredentials};
use serde_json::Value;

use super::support::controller::VELOCITY;
use super::support::hold::{Hold, thread};
use super::support::onlooker::{Onlooker, Sight};
use super::support::{LONG, Machine, PROGRAM, Program, again, drive, memory_of, role, run, until};
use super::{
    MS, ask, asking, assert_silent, await_status, finish, limit, master, online, serve, simulation, socket,
};

/// The test that plays the hosts of all others.
const HOST: &str = "guardian::drives_of_programs_killed_at_any_moment_stand_and_are_off";

/// What a host says once its drives are online, and once its axes are on their way.
const ONLINE: &str = "drives are online";
const UNDER_WAY: &str = "under way";

/// Where moves and streams end, mm: out, and back.
const FAR: [f64; 2] = [1_900.0, 100.0];

const KILLED: &str = "its guardian stopped the drives once the process had ended:";
const TAKEN: &str = "its guardian took the wires";
const NONE: &str = "if this process is killed, a LinMot moves on to its target and stays powered";

/// What a host is, and what kills it. The last two end in order, and one of them is killed in the midst of that.
const WAYS: [(&str, i32); 6] = [
    ("mixed", SIGKILL),
    ("mixed", SIGSEGV),
    ("mixed", SIGBUS),
    ("mixed", SIGABRT),
    ("caught", SIGKILL),
    ("caught", SIGABRT),
];

/// Where an axis from here goes.
fn far(from: f64) -> f64 {
    FAR[usize::from(from > 1_000.0)]
}

/// A configuration whose axes have a long way; eight of them are on two buses.
fn config(machine: &Machine, file: &str, drives: usize, cycle: &str) -> PathBuf {
    config_of(machine, file, drives, cycle, "")
}

fn config_of(machine: &Machine, file: &str, drives: usize, cycle: &str, more: &str) -> PathBuf {
    let defaults = "limits = { position = [-50, 2000] }\nno_drive_watchdog = \"accept\"\nleash = 20\n\
                    jog_deadman = \"30s\"\nunderrun = \"hold\"\nstop.timeout = \"10s\"\nsimulate = { start = 10 }";
    let path = machine.config(file, drives, cycle, &format!("{defaults}\n{more}"));
    if drives == 8 {
        let text = std::fs::read_to_string(&path).unwrap();
        let (before, drive) = text.split_once("[[bus.drive]]").unwrap();
        let bus = &before[before.find("[[bus]]").unwrap()..];
        let second = bus.replace(&machine.ip(1).to_string(), &machine.ip(2).to_string());
        let second = second.replace("[[bus]]", "[[bus]]\nname = \"second\"");
        let of_second = "[[bus.drive]]\nname = \"d4\"";
        assert!(drive.contains(of_second));
        machine.write(file, text.replace(of_second, &format!("{second}{of_second}")));
    }
    path
}

/// A host program as a child. Its black box is in `boxes`, next to its configuration.
fn host(what: &str, config: &Path) -> Program {
    let mut command = again(HOST, &format!("{what} {}", config.display()));
    command.process_group(0);
    // A dump of its memory would take time.
    Program::spawn(limit(&mut command, libc::RLIMIT_CORE, 0)).leaving_memory()
}

fn boxes(config: &Path) -> PathBuf {
    config.with_file_name("boxes")
}

/// The guardians of this process.
fn guardians(process: u32) -> Vec<u32> {
    let is_one = |pid: &u32| {
        let read = |file: &str| std::fs::read_to_string(format!("/proc/{pid}/{file}")).unwrap_or_default();
        let of = |arguments: &str| arguments.split('\0').nth(2)?.split(',').nth(7)?.parse().ok();
        read("comm").trim() == "fb-guardian" && of(&read("cmdline")) == Some(process)
    };
    let entries = std::fs::read_dir("/proc").unwrap().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).filter(is_one).collect()
}

#[track_caller]
fn guardian(process: u32) -> u32 {
    let [guardian] = guardians(process)[..] else { panic!("{:?}", guardians(process)) };
    guardian
}

#[track_caller]
fn await_end_of_guardians(process: u32) {
    assert!(until(LONG, || guardians(process).is_empty()), "{:?}", guardians(process));
}

/// The process that has the lock of this drive.
fn holder(drive: SocketAddrV4) -> u32 {
    let address = SocketAddr::from_abstract_name(format!("fieldbeat-drive/{drive}")).unwrap();
    let stream = UnixStream::connect_addr(&address).unwrap();
    getsockopt(&stream, PeerCredentials).unwrap().pid().cast_unsigned()
}

/// A field of /proc/PID/status.
fn status_of(process: u32, field: &str) -> String {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':'));
    line.unwrap().trim().to_owned()
}

fn play(role: &str) -> ! {
    let (what, config) = role.split_once(' ').unwrap();
    let setup = || Master::from_file(config).unwrap().with_black_box(boxes(config.as_ref()));
    if let Some(program) = what.strip_prefix("by=") {
        let master = setup().with_guardian(program).start().unwrap();
        master.wait_online(LONG).unwrap();
        println!("{}", master.no_guardian().unwrap());
        assert!(master.is_running() && master.finish().end.panic.is_none());
        exit(0)
    }
    let setup = || setup().with_guardian(PROGRAM);
    if what == "five" {
        five(setup)
    }
    let setup = if what == "caught" { setup().stop_on_signals() } else { setup() };
    // Nobody is to inherit it by accident.
    // SAFETY: a file without O_CLOEXEC.
    assert!(unsafe { libc::open(c"/proc/self/maps".as_ptr(), libc::O_RDONLY) } >= 0);
    let master = setup.start().unwrap();
    assert!(master.no_guardian().is_none(), "{:?}", master.no_guardian());
    // A host may wait for whatever children it has.
    // SAFETY: a null status is allowed.
    assert_eq!(unsafe { libc::waitpid(-1, std::ptr::null_mut(), libc::__WALL | libc::WNOHANG) }, -1);
    master.wait_online(LONG).unwrap();
    for (name, observer) in master.observers() {
        let feedback = observer.feedback();
        assert!(feedback.stopped.is_none() && !feedback.status.state.is_powered(), "{name}: {feedback:?}");
    }
    println!("{ONLINE}");
    if what == "near" {
        near(&master)
    }
    if let Some(seconds) = what.strip_prefix("swing=") {
        swing(master, Duration::from_secs(seconds.parse().unwrap()))
    }
    let mut axes: Vec<Axis> = master.observers().iter().map(|(name, _)| master.axis(name).unwrap()).collect();
    bring_up(&mut axes);
    let begins: Vec<f64> = axes.iter().map(|axis| axis.feedback().status.position).collect();
    let period_s = master.plan().cycle.period_ns as f64 * 1e-9;
    let mut streams: Vec<(usize, u32)> = Vec::new();
    for (index, axis) in axes.iter_mut().enumerate() {
        let target = far(begins[index]);
        let profile = Profile { velocity: VELOCITY, ..axis.profile() };
        match (index + usize::from(what == "streams") * 2) % 3 {
            0 => drop(
                axis.post(AxisCommand::Move(Move { target: Target::Absolute(target), profile })).unwrap(),
            ),
            1 => drop(axis.jog(VELOCITY * (target - begins[index]).signum()).unwrap()),
            _ => streams.push((index, 0)),
        }
    }
    let mut feed = |axes: &mut [Axis]| {
        for (index, rows) in &mut streams {
            let begins_now = *rows == 0;
            while axes[*index].stream_room() > 0 {
                let row = row(begins[*index], f64::from(*rows) * period_s);
                axes[*index].push_row(row).unwrap();
                *rows += 1;
            }
            if begins_now {
                axes[*index].follow().unwrap();
            }
        }
    };
    feed(&mut axes);
    // A LinMot that gets no row for some milliseconds, on a host that has none to spare, faults and stops by itself.
    let has_moved = |(axis, begin): (&Axis, &f64)| {
        let feedback = axis.feedback();
        (feedback.status.position - begin).abs() > 5.0 || feedback.stopped == Some(StopCause::DriveFault)
    };
    let mut is_under_way = || {
        feed(&mut axes);
        axes.iter().zip(&begins).all(has_moved)
    };
    let begun = until(LONG / 2, &mut is_under_way);
    assert!(begun, "{begins:?}: {:?}", axes.iter().map(Axis::feedback).collect::<Vec<_>>());
    println!("{UNDER_WAY}");
    if what == "exec" {
        panic!("{}", std::process::Command::new("sleep").arg("1000").exec());
    }
    while master.is_running() {
        feed(&mut axes);
        sleep(5 * MS);
    }
    let summary = Summary::from(&master.finish());
    println!("{}", serde_json::to_string(&summary).unwrap());
    exit(i32::from(summary.has_failed()))
}

/// Row of a stream from there, after so many seconds: half a second to its velocity.
fn row(from: f64, after_s: f64) -> Row {
    const RAMP_S: f64 = 0.5;
    let sign = (far(from) - from).signum();
    let (ramped, level) = (after_s.min(RAMP_S), (after_s - RAMP_S).max(0.0));
    let way = VELOCITY * (ramped * ramped / (2.0 * RAMP_S) + level);
    let velocity = sign * VELOCITY * ramped / RAMP_S;
    Row { position: from + sign * way, velocity, acceleration: 0.0, last: false }
}

/// Enables all axes, and homes those that are not homed.
fn bring_up(axes: &mut [Axis]) {
    for command in [AxisCommand::ResetFault, AxisCommand::Enable, AxisCommand::Home] {
        let posted: Vec<_> = axes
            .iter_mut()
            .map(|axis| {
                let status = axis.feedback().status;
                let is_done = match command {
                    // Of a stream whose master was killed.
                    AxisCommand::ResetFault => status.fault == 0,
                    AxisCommand::Home => status.homed,
                    _ => false,
                };
                (!is_done).then(|| axis.post(command).unwrap())
            })
            .collect();
        for (axis, id) in axes.iter_mut().zip(posted) {
            id.iter().for_each(|id| axis.wait(*id, command.name(), LONG).unwrap());
        }
    }
}

/// Moves its first axis for some seconds, to the end.
fn near(master: &Master) -> ! {
    let mut axes = vec![master.axis("d0").unwrap()];
    bring_up(&mut axes);
    let axis = &mut axes[0];
    let profile = Profile { velocity: VELOCITY, ..axis.profile() };
    let target = Target::Absolute(axis.feedback().status.position + 2.0 * VELOCITY);
    let id = axis.post(AxisCommand::Move(Move { target, profile })).unwrap();
    println!("{UNDER_WAY}");
    axis.wait(id, "move", LONG).unwrap();
    println!("done at {:?}", axis.feedback().status);
    assert!(axis.feedback().stopped.is_none() && axis.feedback().status.state.is_powered());
    exit(0)
}

/// Moves its axes to and fro for so long. What else stops them on a poor host is ended by a reset.
fn swing(master: Master, time: Duration) -> ! {
    let begun = Instant::now();
    let mut axes: Vec<Axis> = master.observers().iter().map(|(name, _)| master.axis(name).unwrap()).collect();
    let (mut moves, mut others) = (0, 0);
    bring_up(&mut axes);
    while begun.elapsed() < time {
        let target = Target::Absolute(if moves % 2 == 0 { 60.0 } else { 10.0 });
        let posted = axes.iter_mut().map(|axis| {
            let profile = Profile { velocity: VELOCITY, ..axis.profile() };
            axis.post(AxisCommand::Move(Move { target, profile }))
        });
        let posted: Vec<_> = posted.collect();
        let ends = axes.iter_mut().zip(posted).map(|(axis, id)| axis.wait(id?, "move", LONG));
        let ends: Vec<Result<(), AxisError>> = ends.collect();
        moves += 1;
        for (axis, error) in
            axes.iter_mut().zip(&ends).filter_map(|(axis, end)| Some((axis, end.as_ref().err()?)))
        {
            assert!(!matches!(error, AxisError::Stuck { .. }), "after {moves} moves: {error}");
            println!("{error}");
            others += 1;
            let _ = axis.run(AxisCommand::Reset, LONG);
        }
        if ends.iter().any(Result::is_err) {
            bring_up(&mut axes);
        }
    }
    assert!(master.no_guardian().is_none() && moves > 0);
    let run = master.finish();
    let failures: Vec<_> = run.measured.failures.iter().map(|failure| &failure.what).collect();
    assert!(failures.iter().all(|failure| !failure.contains("took the wires")), "{failures:?}");
    println!("{moves} moves, {others} other stops: nothing was taken");
    exit(0)
}

/// Masters of one process, one after the other: each has a guardian of its own, and finds everything free.
fn five(setup: impl Fn() -> fieldbeat::Setup) -> ! {
    let mut all = Vec::new();
    for _ in 0..5 {
        let master = setup().start().unwrap();
        master.wait_online(LONG).unwrap();
        let guardian = guardian(std::process::id());
        assert!(!all.contains(&guardian), "{guardian}: {all:?}");
        all.push(guardian);
        master.finish();
    }
    await_end_of_guardians(std::process::id());
    exit(0)
}

/// Simulated drives with somebody who looks on.
struct Bench {
    machine: Machine,
    drives: usize,
    config: PathBuf,
    _sim: Program,
    onlooker: Onlooker,
}

impl Bench {
    fn new(test: u8, drives: usize, cycle: &str) -> Bench {
        Bench::of(test, drives, cycle, "")
    }

    fn of(test: u8, drives: usize, cycle: &str, more: &str) -> Bench {
        let machine = Machine::new(test);
        let config = config_of(&machine, "m.toml", drives, cycle, more);
        let sim = simulation(&config);
        let onlooker = Onlooker::new(&machine);
        Bench { machine, drives, config, _sim: sim, onlooker }
    }

    fn look(&self) -> Vec<Sight> {
        (0..self.drives).map(|index| self.onlooker.look(self.machine.drive(index))).collect()
    }

    /// Waits until each drive stands, and is off then, where it stood. Where they were before is `begins`.
    #[track_caller]
    fn await_stop(&self, begins: &[Sight]) -> Vec<Sight> {
        let stop = |index: usize| {
            let drive = self.machine.drive(index);
            let stands = self.onlooker.await_sight(drive, |sight| !sight.moving);
            let off = self.onlooker.await_sight(drive, |sight| !sight.powered);
            assert!(
                !off.moving && (off.position - stands.position).abs() < 1.0,
                "d{index}: {stands:?} {off:?}"
            );
            // Homed ones begin a little before.
            let (from, target) = (begins[index].position, far(begins[index].position));
            let way = (from.min(target) - 15.0)..(from.max(target) + 15.0);
            let is_before = way.contains(&off.position) && (off.position - target).abs() > 20.0;
            assert!(is_before, "d{index}: {from} to {target}: {off:?}");
            off
        };
        (0..self.drives).map(stop).collect()
    }

    /// Nothing has moved since then, and all are off.
    #[track_caller]
    fn assert_at_rest(&self, since: &[Sight], most: f64) {
        for (index, (now, since)) in self.look().into_iter().zip(since).enumerate() {
            let stays = !now.moving && !now.powered && (now.position - since.position).abs() < most;
            assert!(stays, "d{index}: {since:?} {now:?}");
        }
    }

    /// What the recovered black box of a killed process says.
    #[track_caller]
    fn recovered(&self, process: u32) -> String {
        let boxes = boxes(&self.config);
        let of_it = format!("process {process} ");
        let list = run(["blackbox", "--list", "--json", "--black-box", boxes.to_str().unwrap()]);
        let files = list.expect(0).json()["files"].as_array().unwrap().clone();
        let why =
            |file: &Value| file["why"].as_str().filter(|why| why.starts_with(&of_it)).map(str::to_owned);
        files.iter().find_map(why).unwrap_or_else(|| panic!("{of_it}: {list:?}"))
    }

    /// One program that is killed in one of the [`WAYS`], at a random moment.
    fn kill(&self, seed: u64, way: usize) {
        let mut random = fastrand::Rng::with_seed(seed);
        let (what, signal) = WAYS[way % WAYS.len()];
        let ends_for = random.u32(0..150);
        let (moment, after) = random.choice([(ONLINE, 600), (UNDER_WAY, 1_500), (UNDER_WAY, 1_500)]).unwrap();
        let after = random.u32(0..after);
        println!(
            "{} drives, seed {seed}: signal {signal} ({what}), {after} ms after \"{moment}\"",
            self.drives
        );
        let mut host = host(what, &self.config);
        host.await_text(ONLINE);
        let begins = self.look();
        host.await_text(moment);
        sleep(after * MS);
        let process = host.pid();
        if (what, signal) == ("caught", SIGKILL) {
            host.signal(SIGTERM);
            sleep(ends_for * MS);
        }
        // The runtime takes the first signal of a fault for one of its own stacks, and lets the second one through.
        assert!(until(LONG, || {
            let runs = host.is_running();
            runs.then(|| host.signal(signal));
            !runs
        }));
        let ended = host.end();
        let mut is_in_order = what == "caught" && (signal == SIGABRT || ended.signal == Some(SIGTERM));
        assert!(ended.signal == Some(signal) || is_in_order, "{ended:?}");
        let stopped = self.await_stop(&begins);
        await_end_of_guardians(process);
        self.assert_at_rest(&stopped, 0.05);
        // Its loop had come to its end before the second signal.
        is_in_order |= what == "caught" && memory_of(process).is_none();
        if is_in_order {
            memory_of(process).map(std::fs::remove_file);
            return;
        }
        let why = self.recovered(process);
        let (_, stops) = why.split_once(KILLED).unwrap_or_else(|| panic!("{why}"));
        let is_missing = ["did not answer", "was not seen"].iter().any(|failure| stops.contains(failure));
        assert!(!is_missing, "{why}");
        if moment == UNDER_WAY && what == "mixed" {
            // The drive of a stream that ends has switched itself off, by a fault.
            let is_named = |index: usize| {
                let says = |what: &str| stops.contains(&format!(" d{index} {what} after "));
                says("stood") || (index % 3 == 2 && says("off"))
            };
            let named = (0..self.drives.min(16)).all(is_named);
            let more = self.drives.saturating_sub(16);
            let rest = if more > 0 { format!(", and {more} more") } else { String::new() };
            assert!(named && stops.ends_with(&rest) && !stops.contains("none"), "{why}");
        }
    }
}

/// Kills programs of so many drives, `each` of each size.
fn kill_all(first_seed: u64, each: usize) {
    for (size, (test, drives)) in [(97, 1), (98, 8), (99, 64)].into_iter().enumerate() {
        let bench = Bench::new(test, drives, "");
        (size * each..(size + 1) * each).for_each(|index| bench.kill(first_seed + index as u64, index));
        // Nobody helps the next master either; it finds nothing running.
        let mut next = host("mixed", &bench.config);
        next.await_text(UNDER_WAY);
        let process = next.pid();
        next.kill();
        memory_of(process).map(std::fs::remove_file);
        await_end_of_guardians(process);
    }
}

#[test]
fn drives_of_programs_killed_at_any_moment_stand_and_are_off() {
    if let Some(role) = role() {
        play(&role);
    }
    kill_all(1, 2);
}

#[test]
#[ignore = "long: kills two hundred programs"]
fn two_hundred_programs_that_are_killed_leave_no_drive_in_motion() {
    let seed = std::env::var("GUARDIAN_SEED").map_or(1, |seed| seed.parse().unwrap());
    kill_all(seed, 67);
}

/// The lock names who holds it, and that is neither the frozen process nor free. Then the process goes on.
#[test]
fn a_frozen_program_loses_its_drives_and_says_so_when_it_goes_on() {
    for (test, cycle) in [(100, ""), (101, "watch_after = \"off\"\nguardian_after = \"500ms\"")] {
        let bench = Bench::new(test, 1, cycle);
        let boxes = boxes(&bench.config);
        let run = ["--allow-control", "--json", "--black-box", boxes.to_str().unwrap()];
        let program = online(&bench.config, &run);
        let begins = bench.look();
        let mover = asking("axis", &bench.config, "d0 move-to 1900 --velocity 50 --enable --home");
        bench.onlooker.await_sight(bench.machine.drive(0), |sight| sight.moving && sight.position > 15.0);
        let guardian = guardian(program.pid());
        program.hold();
        let stopped = bench.await_stop(&begins);
        assert_eq!(holder(bench.machine.drive(0)), guardian);
        let by = format!("is kept by the guardian (process {guardian}) ");
        ask("run", &bench.config, "").refused(&[&by]);
        program.signal(SIGCONT);
        let ended = program.end();
        ended.expect(1);
        assert!(ended.err.contains(TAKEN), "{ended:?}");
        let summary = ended.json();
        assert_eq!(drive(&summary, "d0")["stopped"], "loop stuck", "{summary}");
        let failures = summary["failures"].as_array().unwrap();
        let is_named = |failure: &Value| failure["what"].as_str().is_some_and(|what| what.contains(TAKEN));
        assert!(
            failures.iter().any(|failure| is_named(failure) && failure["fails_run"] == true),
            "{summary}"
        );
        assert!(summary.to_string().contains("d0 stood after "), "{summary}");
        mover.end().expect(1);
        bench.assert_at_rest(&stopped, 0.05);
        let summary = finish(online(&bench.config, &["--json"]));
        assert_eq!(drive(&summary, "d0")["stopped"], "shutdown", "{summary}");
    }
}

#[test]
fn a_program_that_is_frozen_for_a_moment_goes_on_to_its_target() {
    let bench = Bench::new(102, 1, "guardian_after = \"20s\"");
    let mut program = host("near", &bench.config);
    program.await_text(UNDER_WAY);
    let begins = bench.look();
    program.hold();
    sleep(1_000 * MS);
    program.signal(SIGCONT);
    let process = program.pid();
    let ended = program.end();
    assert!(ended.expect(0).out.contains("done at "), "{ended:?}");
    let after = bench.look();
    let way = after[0].position - begins[0].position;
    assert!(way > 0.5 * VELOCITY && way < 2.0 * VELOCITY + 1.0, "{begins:?} {after:?}");
    // Until the exit of the program, nobody has taken anything from it.
    await_end_of_guardians(process);
    memory_of(process).map(std::fs::remove_file);
}

/// A drive that the master has only read may be anybody's: it is sent nothing in the master's place.
#[test]
fn the_guardian_sends_nothing_to_drives_that_were_not_commanded() {
    let machine = Machine::new(103);
    let one = config(&machine, "one.toml", 1, "");
    let two = config(&machine, "two.toml", 2, "watch_after = \"off\"\nguardian_after = \"500ms\"");
    let sim = serve(&one);
    // It never answers.
    let silent = socket(machine.drive(1));
    let boxes = boxes(&two);
    let arguments = ["--black-box", boxes.to_str().unwrap()];
    let program = master(&two, &arguments).leaving_memory();
    await_status(&two, |summary| drive(summary, "d0")["link"] == "online");
    let guardian = guardian(program.pid());
    program.hold();
    // What was under way is there.
    sleep(50 * MS);
    let received = sim.stats()[0].received;
    drain(&silent);
    assert!(until(LONG, || holder(machine.drive(0)) == guardian));
    // Rounds of the guardian.
    sleep(200 * MS);
    assert_eq!(sim.stats()[0].received, received);
    assert_silent(&silent);
    let process = program.pid();
    assert_eq!(program.end_by(SIGKILL).signal, Some(SIGKILL));
    await_end_of_guardians(process);
    assert_eq!(sim.stats()[0].received, received);
    assert_silent(&silent);
    let list = run(["blackbox", "--list", "--json", "--black-box", boxes.to_str().unwrap()]);
    assert!(list.expect(0).out.contains("without a sign of life: none was commanded"), "{list:?}");
}

fn drain(socket: &UdpSocket) {
    socket.set_nonblocking(true).unwrap();
    while socket.recv(&mut [0; 64]).is_ok() {}
}

/// The word that owns the wires is read before the send: a thread that is held up between the two sends its batch
/// whenever it goes on. The guardian is there until then, and behind it.
#[test]
fn a_batch_that_leaves_long_after_the_stop_moves_nothing() {
    // The last ones switch their drives on, or home.
    let ways = [(UNDER_WAY, 0, false), (UNDER_WAY, 0, true), (ONLINE, 5, false), (ONLINE, 80, true)];
    let bench = Bench::new(105, 3, "");
    for (moment, after, is_frozen) in ways {
        let mut program = host("mixed", &bench.config);
        program.await_text(ONLINE);
        let begins = bench.look();
        program.await_text(moment);
        sleep(after * MS);
        let process = program.pid();
        let watch = Hold::seize(thread(process, "fb-watchdog"));
        let of_loop = Hold::seize(thread(process, "fb-loop"));
        watch.stop();
        of_loop.stop_before(libc::SYS_sendmmsg);
        if is_frozen {
            program.signal(SIGSTOP);
        }
        let guardian = guardian(process);
        assert!(until(LONG, || holder(bench.machine.drive(0)) == guardian), "it took nothing");
        let stopped = bench.await_stop(&begins);
        of_loop.release();
        watch.release();
        if is_frozen {
            // The batch leaves now; its thread stops after that, and has not given way.
            bench.await_rest(&stopped);
            program.signal(SIGCONT);
        }
        let ended = program.end();
        // One that was not under way has unwrapped what a command ended in: that it was taken, or not begun any more.
        let said = format!("{}{}", ended.out, ended.err);
        let is_told = |texts: &[&str]| texts.iter().any(|text| said.contains(text));
        let is_right = match moment {
            UNDER_WAY => ended.code == Some(1) && is_told(&[TAKEN]),
            _ => ended.code != Some(0) && is_told(&[TAKEN, "guardian_after", "loop stuck"]),
        };
        assert!(is_right, "{ended:?}");
        await_end_of_guardians(process);
        bench.assert_at_rest(&stopped, 2.0);
        memory_of(process).map(std::fs::remove_file);
    }
}

/// The process lives on as another program: its loop is gone, without an end.
#[test]
fn drives_of_a_program_that_calls_exec_in_mid_motion_are_stopped() {
    let bench = Bench::new(107, 2, "");
    let mut program = host("exec", &bench.config);
    program.await_text(ONLINE);
    let begins = bench.look();
    program.await_text(UNDER_WAY);
    let stopped = bench.await_stop(&begins);
    assert!(program.is_running());
    let process = program.pid();
    program.kill();
    await_end_of_guardians(process);
    bench.assert_at_rest(&stopped, 0.05);
    let why = bench.recovered(process);
    assert!(why.contains("without a sign of life: d0 stood after "), "{why}");
}

/// The guardian goes by the stop plan of each axis.
#[test]
fn a_load_held_after_a_stop_is_held_after_a_stop_of_the_guardian() {
    let bench = Bench::of(115, 2, "", "stop.then = \"hold\"");
    let mut program = host("mixed", &bench.config);
    program.await_text(UNDER_WAY);
    let process = program.pid();
    assert_eq!(program.end_by(SIGKILL).signal, Some(SIGKILL));
    await_end_of_guardians(process);
    let held = bench.look();
    let after = bench.look();
    for (held, after) in held.iter().zip(&after) {
        let is_held = held.powered && !held.moving && (after.position - held.position).abs() < 0.05;
        assert!(is_held && held.position < FAR[0] - 20.0, "{held:?} {after:?}");
    }
    let why = bench.recovered(process);
    assert!(why.contains(": d0 stood after ") && !why.contains("off after"), "{why}");
}

impl Bench {
    /// Waits for rounds of the guardian after a late batch, and until they have done their work.
    #[track_caller]
    fn await_rest(&self, stopped: &[Sight]) {
        sleep(200 * MS);
        for index in 0..self.drives {
            self.onlooker.await_sight(self.machine.drive(index), |sight| !sight.moving && !sight.powered);
        }
        self.assert_at_rest(stopped, 2.0);
    }
}

#[test]
fn a_guardian_is_detached_has_its_descriptors_and_outlives_the_process_group_of_its_master() {
    let bench = Bench::new(108, 2, "");
    let mut program = host("mixed", &bench.config);
    program.await_text(ONLINE);
    let begins = bench.look();
    program.await_text(UNDER_WAY);
    let process = program.pid();
    let guardian = guardian(process);
    assert_ne!(status_of(guardian, "PPid"), process.to_string());
    assert_eq!(status_of(guardian, "Seccomp"), "2");
    assert_eq!(status_of(guardian, "Threads"), "1");
    let files = std::fs::read_dir(format!("/proc/{guardian}/fd")).unwrap();
    let files = files.map(|file| std::fs::read_link(file.unwrap().path()).unwrap());
    let files: Vec<String> = files.map(|file| file.to_string_lossy().into_owned()).collect();
    let count = |what: &str| files.iter().filter(|file| file.contains(what)).count();
    // The wires, the drives of the bus; the loop's socket, the link and a lock of each drive; the last records.
    let counts = ["/dev/null", "/memfd:", "socket:[", "[pidfd]", "/dev/shm/"].map(count);
    assert_eq!((counts, files.len()), ([3, 2, 4, 1, 1], 11), "{files:?}");
    for signal in [SIGTERM, SIGINT, SIGHUP, SIGQUIT] {
        // SAFETY: takes two numbers.
        assert_eq!(unsafe { libc::kill(guardian as i32, signal) }, 0);
    }
    // SAFETY: as above: the group of the master, which has its own.
    assert_eq!(unsafe { libc::kill(-(process as i32), SIGKILL) }, 0);
    assert_eq!(program.end().signal, Some(SIGKILL));
    let stopped = bench.await_stop(&begins);
    await_end_of_guardians(process);
    bench.assert_at_rest(&stopped, 0.05);
    assert!(bench.recovered(process).contains(KILLED));
}

#[test]
fn the_end_of_a_master_is_the_end_of_its_guardian_and_everything_is_free_at_once() {
    let machine = Machine::new(109);
    let config = config(&machine, "m.toml", 2, "");
    let _sim = simulation(&config);
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        let program = online(&config, &[]);
        let process = program.pid();
        guardian(process);
        let ended = program.end_by(signal);
        ended.expect(0);
        assert!(!ended.err.contains("guardian"), "{ended:?}");
        await_end_of_guardians(process);
    }
    let process = host("five", &config).end();
    process.expect(0);
}

#[test]
fn a_run_without_its_guardian_says_what_that_means_and_goes_on() {
    let machine = Machine::new(110);
    let config = config(&machine, "m.toml", 1, "");
    let off = super::guardian::config(&machine, "off.toml", 1, "guardian_after = \"off\"");
    let _sim = simulation(&config);
    // Killed itself.
    let mut program = online(&config, &["--json"]);
    let guardian = guardian(program.pid());
    // SAFETY: takes two numbers.
    assert_eq!(unsafe { libc::kill(guardian as i32, SIGKILL) }, 0);
    program.await_text("the guardian has ended before its master: ");
    await_status(&config, |summary| drive(summary, "d0")["link"] == "online");
    let ended = program.end_by(SIGINT);
    ended.expect(0);
    assert_eq!(ended.err.matches("the guardian has ended").count(), 1, "{ended:?}");
    assert!(ended.err.contains(NONE), "{ended:?}");

    let not_wanted = "fieldbeat: no guardian (guardian_after = \"off\"): ";
    for (config, arguments) in [(&config, &["--no-guardian"][..]), (&off, &[])] {
        let program = online(config, arguments);
        assert!(guardians(program.pid()).is_empty());
        let ended = program.end_by(SIGINT);
        assert_eq!(ended.expect(0).err.matches(not_wanted).count(), 1, "{ended:?}");
        assert!(ended.err.contains(NONE), "{ended:?}");
    }

    // A host that does nothing for it: this one.
    let master = Master::from_file(&config).unwrap().start().unwrap();
    master.wait_online(LONG).unwrap();
    let why = master.no_guardian().unwrap().to_string();
    assert!(why.contains(NONE) && why.contains("with_guardian") && why.contains("guardian_main()"), "{why}");
    drop(master);
}

/// One that ends, one that is none, one that never starts, and one that never ends.
#[test]
fn an_unusable_guardian_is_named_and_its_master_runs() {
    let machine = Machine::new(111);
    let config = config(&machine, "m.toml", 1, "");
    let _sim = simulation(&config);
    let hangs = machine.write("hangs", "#!/bin/sh\nexec sleep 1000\n");
    let other = machine.write("other", "no program\n");
    for program in [&hangs, &other] {
        use std::os::unix::fs::PermissionsExt;
        std::fs::set_permissions(program, PermissionsExt::from_mode(0o755)).unwrap();
    }
    let missing = machine.path("missing");
    for program in [Path::new("/bin/true"), &missing, &other, &hangs] {
        let ended = host(&format!("by={}", program.display()), &config).end();
        let why = format!("no guardian: {NONE}; {} cannot be one: ", program.display());
        assert!(ended.expect(0).out.contains(&why), "{ended:?}");
    }
}

/// A loop that cannot begin sends nothing, and so nobody has to stop anything in its place.
#[test]
fn a_start_that_fails_leaves_no_guardian_behind() {
    let machine = Machine::new(114);
    let [bad, good] = [("bad.toml", "core = 1000"), ("good.toml", "")]
        .map(|(file, cycle)| super::guardian::config(&machine, file, 1, cycle));
    let _sim = simulation(&good);
    let start = |config: &Path| Master::from_file(config).unwrap().with_guardian(PROGRAM).start();
    let refused = start(&bad).unwrap_err().to_string();
    assert!(refused.contains("1000"), "{refused}");
    let master = start(&good).unwrap();
    master.wait_online(LONG).unwrap();
    guardian(std::process::id());
    drop(master);
}

/// The kernel kills all of a PID namespace with its first process, as a container's first one is.
#[test]
#[ignore = "needs root: a PID namespace"]
fn a_master_that_takes_its_guardian_with_it_says_so() {
    let machine = Machine::new(117);
    let config = config(&machine, "m.toml", 1, "");
    let _sim = simulation(&config);
    let mut command = std::process::Command::new("unshare");
    let first = command.args(["--pid", "--fork", "--mount-proc", "--kill-child=SIGINT", PROGRAM, "run"]);
    let mut program = Program::spawn(first.arg(&config).args(["--for", "2s"]));
    program.await_text("the guardian ends with this process, the first one of its PID namespace");
    let ended = program.end();
    assert!(ended.expect(0).err.contains(NONE), "{ended:?}");
}

/// However little the host gives a program, it is not stopped as long as that runs.
#[test]
#[ignore = "long: GUARDIAN_SECONDS of motion, on a host that takes a quarter of every core"]
fn no_program_that_runs_is_stopped_by_its_guardian() {
    let seconds: u64 = std::env::var("GUARDIAN_SECONDS").map_or(60, |seconds| seconds.parse().unwrap());
    let bench = Bench::new(112, 2, "");
    let program = host(&format!("swing={seconds}"), &bench.config);
    let process = program.pid();
    let ended = program.end_within(LONG + Duration::from_secs(2 * seconds));
    memory_of(process).map(std::fs::remove_file);
    println!("{}{}", ended.out, ended.err);
    assert!(ended.expect(0).out.contains("nothing was taken"), "{ended:?}");
}
