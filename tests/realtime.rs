//! What needs root: real-time scheduling as the kernel sees it from outside, and networks with more than a loopback.
//!
//!     cargo test --test realtime -- --ignored --test-threads 1

mod support;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::sleep;
use std::time::Duration;

use fieldbeat::sim::server::ServerOptions;
use fieldbeat::{Master, Memory, Realtime};
use fieldbeat_core::rt::thread::{spare_core, stand_aside};
use support::adventures::{Adventures, VICTIM, drives_and_errors};
use support::controller::{self, RAMP, TARGET, Way};
use support::counting::{Counting, count, watch};
use support::onlooker::Onlooker;
use support::{
    CABLE_NET, Cable, LONG, Machine, PROGRAM, Program, again, assert_sums, drive, most_probes, plan, role,
    until,
};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// One thread of another process.
#[derive(Debug)]
struct Thread {
    policy: i32,
    reset_on_fork: bool,
    priority: i32,
    cores: Vec<usize>,
}

/// The threads of a process by name. Those of one name must be alike, so that any of them will do.
fn threads(pid: u32) -> BTreeMap<String, Thread> {
    let mut threads = BTreeMap::new();
    for task in std::fs::read_dir(format!("/proc/{pid}/task")).unwrap() {
        let path = task.unwrap().path();
        let read = |file: &str| std::fs::read_to_string(path.join(file)).unwrap();
        let id: i32 = path.file_name().unwrap().to_str().unwrap().parse().unwrap();
        // SAFETY: takes a number.
        let policy = unsafe { libc::sched_getscheduler(id) };
        // proc_pid_stat(5): rt_priority is field 40; the second, the name, may contain blanks.
        let stat = read("stat");
        let priority =
            stat.rsplit(')').next().unwrap().split_whitespace().nth(40 - 3).unwrap().parse().unwrap();
        let status = read("status");
        let cores = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:")).unwrap();
        let thread = Thread {
            policy: policy & !libc::SCHED_RESET_ON_FORK,
            reset_on_fork: policy & libc::SCHED_RESET_ON_FORK != 0,
            priority,
            cores: list(cores.trim()),
        };
        threads.insert(read("comm").trim().to_owned(), thread);
    }
    threads
}

/// `0-2,5` as the kernel writes sets of cores.
fn list(text: &str) -> Vec<usize> {
    let ends = |part: &str| {
        let mut ends = part.split('-').map(|end| end.parse::<usize>().unwrap());
        let first = ends.next().unwrap();
        first..=ends.next().unwrap_or(first)
    };
    text.split(',').flat_map(ends).collect()
}

fn locked_kib(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmLck:")).unwrap();
    line.split_whitespace().next().unwrap().parse().unwrap()
}

fn start(command: &str, config: &std::path::Path, arguments: &[&str]) -> Program {
    Program::spawn(Command::new(PROGRAM).arg(command).arg(config).args(arguments))
}

/// The loop has the shortest of these at which its drives come online: a simulated drive lives through its silence
/// before it answers a probe, and how long that takes depends on the host.
const PERIODS: [&str; 4] = ["250us", "500us", "1ms", "2ms"];

/// Four drives and a master that has found all of them; `None`, and its summary printed, if it does not.
fn online_at(machine: &Machine, period: &str, memory: &str) -> Option<(PathBuf, Program, Program)> {
    let cycle =
        format!("period = \"{period}\"\nrealtime = \"require\"\nmemory = \"{memory}\"\nmax_skip = \"30s\"");
    // As long as a link may be judged (10 000 exchanges) at the shortest period.
    let health = "health = { bucket = \"2500ms\", leak = 1, gate = 3, probe_interval = \"10ms\" }";
    let config = machine.config("m.toml", 4, &cycle, health);
    let mut sim = start("sim", &config, &[]);
    sim.await_text("listening");
    let master = start("run", &config, &["--json"]);
    if until(LONG / 4, || master.err().contains("all drives online")) {
        return Some((config, sim, master));
    }
    let ended = master.end_by(libc::SIGINT);
    println!("not online at {period}: {}{}", ended.err, ended.out);
    None
}

#[test]
#[ignore = "needs root: SCHED_FIFO and locked memory"]
fn the_loop_is_real_time_and_does_not_fault_in_a_hundred_thousand_cycles() {
    for memory in ["process", "own"] {
        let machine = Machine::new(1);
        let online = PERIODS.iter().find_map(|period| online_at(&machine, period, memory));
        let (config, _sim, master) = online.expect("drives that answer within one of the periods");
        let (threads, locked) = (threads(master.pid()), locked_kib(master.pid()));
        // However long it takes this host.
        let executed = || {
            let ended = start("status", &config, &["--json"]).end();
            ended.expect(0).json()["summary"]["cycle"]["executed"].as_u64().unwrap()
        };
        assert!(until(10 * LONG, || {
            sleep(Duration::from_millis(250));
            executed() >= 100_000
        }));
        let ended = master.end_by(libc::SIGINT);
        ended.expect(0);
        let summary = ended.json();
        assert_sums(&summary);

        let real = &summary["realtime"];
        assert_eq!(real["page_faults"], 0, "memory = {memory}: {real}");
        assert_eq!((&real["policy"], &real["priority"]), (&"SCHED_FIFO".into(), &80.into()));
        assert_eq!((&real["memory_locked"], real["missing"].as_array().unwrap().len()), (&true.into(), 0));
        assert!(locked > 500, "memory = {memory}: {locked} KiB");

        let core = real["core"].as_u64().unwrap() as usize;
        let of_loop = &threads["fb-loop"];
        assert_eq!((of_loop.policy, of_loop.priority), (libc::SCHED_FIFO, 80), "{threads:?}");
        assert!(of_loop.reset_on_fork, "whatever it starts would be real-time too");
        assert_eq!(of_loop.cores, [core]);
        // The program's main thread has its name.
        for name in ["fb-telemetry", "fb-signals", "fb-control", "fieldbeat"] {
            let thread = &threads[name];
            assert_eq!((thread.policy, thread.priority), (libc::SCHED_OTHER, 0), "{name}: {threads:?}");
            let others = list(std::fs::read_to_string("/sys/devices/system/cpu/online").unwrap().trim());
            assert!(others.len() == 1 || !thread.cores.contains(&core), "{name}: {threads:?}");
        }
        // The watch precedes the loop, from another core.
        let watchdog = &threads["fb-watchdog"];
        assert_eq!((watchdog.policy, watchdog.priority), (libc::SCHED_FIFO, 81), "{threads:?}");
        assert!(watchdog.reset_on_fork && (!watchdog.cores.contains(&core) || watchdog.cores.len() == 1));
        assert_eq!(threads.len(), 6, "a thread that this test does not know: {threads:?}");
    }
}

#[test]
#[ignore = "needs root: SCHED_FIFO and locked memory"]
fn homing_streams_and_moves_do_not_fault_either() {
    let ended = Program::start(["demo", "--for", "20s", "--drives", "4", "--json"]).end();
    let summary = ended.expect(0).json();
    assert_sums(&summary);
    let real = &summary["realtime"];
    assert_eq!((&real["policy"], &real["memory_locked"]), (&"SCHED_FIFO".into(), &true.into()), "{real}");
    assert_eq!(real["page_faults"], 0, "{real}");
}

/// In a process of its own, since all its memory is locked. The task counts for whole cycles: it runs on the loop's
/// thread. Meanwhile the kernel gets request after request to write back all that is to be on a disk: the records that
/// outlive the program are in no such memory.
#[test]
#[ignore = "needs root: SCHED_FIFO and locked memory"]
fn a_million_cycles_with_random_events_neither_fault_nor_allocate() {
    let name = "a_million_cycles_with_random_events_neither_fault_nor_allocate";
    if role().is_none() {
        let ended = Program::spawn(&mut again(name, "million")).end_within(10 * LONG);
        ended.expect(0);
        return print!("{}", ended.out);
    }
    let machine = Machine::new(4);
    let config = drives_and_errors(&machine, "100us", 10_000, 2_000);
    let mut plan = plan(&config);
    (plan.cycle.realtime, plan.cycle.memory) = (Realtime::Require, Memory::Process);
    let setup = Master::from_plan(plan).with_black_box(machine.path("boxes")).with_task(|_, _| {
        watch(true);
    });
    let master = setup.start().unwrap();
    let syncs = Arc::new(AtomicU64::new(0));
    let counted = Arc::downgrade(&syncs);
    let syncing = std::thread::spawn(move || {
        while let Some(syncs) = counted.upgrade() {
            nix::unistd::sync();
            syncs.fetch_add(1, Ordering::Relaxed);
            drop(syncs);
            sleep(Duration::from_millis(5));
        }
    });
    // The drives are threads of this process: out of the way of the loop, and not in that of anybody else.
    let core = master.granted().core;
    stand_aside(core);
    let options = ServerOptions { core: spare_core(core), priority: Some(70) };
    let axes = master.plan().axes().into_iter().map(|axis| master.axis(&axis.name).unwrap()).collect();
    let mut adventures = Adventures::begin(&machine, &config, axes, options);
    let goal = master.status().executed + 1_000_000;
    while master.status().executed < goal || !adventures.have_done(5) {
        adventures.round();
    }
    let synced = syncs.load(Ordering::Relaxed);
    drop(syncs);
    syncing.join().unwrap();
    adventures.set_out();
    master.stop_handle().stop();
    let moving = || adventures.axes()[1].feedback();
    assert!(until(LONG, || moving().stopped.is_some() && moving().status.velocity.abs() < 250.0));
    let (allocations, granted) = (count(), master.granted().clone());
    assert!(master.is_running() && locked_kib(std::process::id()) > 10_000);
    let end = master.finish().end;
    let (status, victim) = (end.status, &end.drives[VICTIM]);
    assert_eq!((granted.policy, granted.memory_locked), ("SCHED_FIFO", true));
    assert_eq!((end.page_faults, allocations), (Some(0), 0), "in {} cycles", status.executed);
    assert_eq!(status.planned, status.executed + status.skipped);
    assert!(victim.losses > 0 && synced > 100, "{victim:?}, {synced}");
    // Whoever takes the processor from SCHED_FIFO: the kernel's own threads, or its throttling.
    let taken = end.involuntary_switches.unwrap();
    println!(
        "{} cycles executed, {} skipped, {} losses, {taken} involuntary switches",
        status.executed, status.skipped, victim.losses
    );
}

/// A drive that is switched off on a real network: the kernel queues what is sent to it, while it looks for its
/// hardware address in vain, and the queue takes its room from the socket that all drives share.
#[test]
#[ignore = "needs root: network namespaces (iproute2)"]
fn a_dead_drive_delays_no_other_drive() {
    let machine = Machine::new(2).on(CABLE_NET);
    let cable = Cable::new(2, &[11, 12, 13]);
    let config = machine.plain(4);
    let living = machine.config("living.toml", 3, "", "");
    let mut sim = Program::spawn(Cable::command(&cable.drives, PROGRAM).arg("sim").arg(&living));
    sim.await_text("listening");
    let master = Program::spawn(
        Cable::command(&cable.master, PROGRAM).arg("run").arg(&config).args(["--for", "8s", "--json"]),
    );
    let ended = master.end();
    ended.expect(1);
    // On a host that holds it up the run takes longer, and has live lines; nothing else stands there.
    let is_live = |line: &&str| line.contains(" operational  cycle ");
    let complaints: Vec<_> = ended.err_but_host().lines().filter(|line| !is_live(line)).collect();
    let why = "nothing has ever come from it: look at its power, cable and address, at a firewall, and \
               whether it has locked onto another master";
    let [first, last] =
        [format!("drive d3: not connected: {why}"), format!("fieldbeat: not online: d3 ({why})")];
    assert_eq!(complaints, [first, last]);
    let summary = ended.json();
    assert_sums(&summary);
    for name in ["d0", "d1", "d2"] {
        let drive = drive(&summary, name);
        let count = |key: &str| drive[key].as_u64().unwrap();
        assert_eq!((&drive["link"], count("losses"), count("unsent")), (&"online".into(), 0, 0), "{drive}");
        // The period is one in which this host disturbs a fifth of the cycles at most.
        assert!(count("missed") * 2 <= count("sent"), "{drive}");
    }
    let dead = drive(&summary, "d3");
    let requested = dead["sent"].as_u64().unwrap() + dead["unsent"].as_u64().unwrap();
    assert!((1..=most_probes(&summary)).contains(&requested), "{summary}");
}

#[test]
#[ignore = "needs root: network namespaces (iproute2)"]
fn a_cable_that_was_pulled_and_put_back_brings_all_drives_back() {
    let machine = Machine::new(3).on(CABLE_NET);
    let cable = Cable::new(3, &[11, 12]);
    let config = machine.config("m.toml", 2, "", Machine::LOST_SOON);
    let mut sim = Program::spawn(Cable::command(&cable.drives, PROGRAM).arg("sim").arg(&config));
    sim.await_text("listening");
    let mut master =
        Program::spawn(Cable::command(&cable.master, PROGRAM).arg("run").arg(&config).arg("--json"));
    master.await_text("all drives online");
    cable.plug("down");
    master.await_text("drive d0: lost");
    master.await_text("drive d1: lost");
    sleep(Duration::from_secs(1));
    cable.plug("up");
    master.await_text("drive d0: back online");
    master.await_text("drive d1: back online");
    let ended = master.end_by(libc::SIGINT);
    ended.expect(1);
    let summary = ended.json();
    assert_sums(&summary);
    assert_eq!(drive(&summary, "d0")["losses"], 1, "{summary}");
}

/// The kernel of the master looks for its hardware address and gets no answer, as if its plug was pulled; the drive
/// itself runs on.
#[test]
#[ignore = "needs root: network namespaces (iproute2)"]
fn a_drive_lost_in_mid_motion_stops_its_own_group_only() {
    let name = "a_drive_lost_in_mid_motion_stops_its_own_group_only";
    if let Some(role) = role() {
        return controller::play(&role);
    }
    let machine = Machine::new(5).on(CABLE_NET);
    let cable = Cable::new(5, &[11, 12, 13, 250]);
    let config = controller::config(&machine, "m.toml", 3, "", Machine::LOST_SOON);
    let mut text = std::fs::read_to_string(config).unwrap();
    for drive in ["d0", "d1"] {
        let name = format!("name = \"{drive}\"");
        text = text.replace(&name, &format!("{name}\nstop.group = \"pair\""));
    }
    let config = machine.write("m.toml", text);
    let mut sim = Program::spawn(Cable::command(&cable.drives, PROGRAM).arg("sim").arg(&config));
    sim.await_text("listening");
    let onlooker = cable.among_drives(|| Onlooker::new(&machine));
    let child = controller::child(name, Way::Move, &config);
    let mut controller = controller::start(&mut Cable::enter(&cable.master, &child));

    let before = onlooker.look(machine.drive(1));
    cable.address("del", &machine, 12);
    controller.await_text("axis d1: enable failed: the axis is stopped (link lost)");
    controller.await_text("axis d0: enable failed: the axis is stopped (stop group)");
    let partner = onlooker.await_sight(machine.drive(0), |sight| !sight.powered);
    assert!(!partner.moving && partner.position < TARGET, "{partner:?}");
    let other = onlooker.look(machine.drive(2));
    assert!(other.operating && other.moving && other.position > partner.position, "{other:?}");
    // Requests reach it now.
    cable.address("add", &machine, 12);
    let dead = onlooker.await_sight(machine.drive(1), |sight| !sight.powered);
    assert!(!dead.moving && dead.position < TARGET, "{dead:?}");
    assert!(dead.position > before.position + 0.9 * RAMP, "{before:?} {dead:?}");
    assert!(onlooker.look(machine.drive(2)).moving);
    controller.signal(libc::SIGTERM);
    let summary = controller::summary(&controller.end());
    assert_sums(&summary);
    for (index, (stopped, losses)) in
        [("stop group", 0), ("link lost", 1), ("shutdown", 0)].into_iter().enumerate()
    {
        let drive = drive(&summary, &format!("d{index}"));
        assert_eq!((&drive["stopped"], &drive["losses"]), (&stopped.into(), &losses.into()), "{drive}");
        assert!(drive["unsent"] == 0 || index == 1, "{drive}");
        assert!(!onlooker.look(machine.drive(index)).powered);
    }
}
