//! What needs root: real-time scheduling as the kernel sees it from outside, and networks with more than a loopback.
//!
//!     cargo test --test realtime -- --ignored --test-threads 1

mod support;

use std::collections::BTreeMap;
use std::process::Command;
use std::thread::sleep;
use std::time::Duration;

use support::{CABLE_NET, Cable, DemoLock, Machine, PROGRAM, Program, assert_sums, drive};

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

#[test]
#[ignore = "needs root: SCHED_FIFO and locked memory"]
fn the_loop_is_real_time_and_does_not_fault_in_a_hundred_thousand_cycles() {
    for memory in ["process", "own"] {
        let machine = Machine::new(1);
        let cycle =
            format!("period = \"250us\"\nrealtime = \"require\"\nmemory = \"{memory}\"\nmax_skip = 40000");
        let config = machine.config("m.toml", 4, &cycle, "health = { bucket = 4000 }");
        let mut sim = start("sim", &config, &[]);
        sim.await_text("listening");
        let mut master = start("run", &config, &["--for", "26s", "--json"]);
        master.await_text("all drives online");
        let (threads, locked) = (threads(master.pid()), locked_kib(master.pid()));
        let ended = master.end();
        ended.expect(0);
        let summary = ended.json();
        assert_sums(&summary);
        assert!(summary["cycle"]["planned"].as_u64().unwrap() >= 100_000, "{summary}");
        assert!(summary["cycle"]["executed"].as_u64().unwrap() >= 50_000, "{summary}");

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
        for name in ["fb-telemetry", "fb-signals", "fieldbeat"] {
            let thread = &threads[name];
            assert_eq!((thread.policy, thread.priority), (libc::SCHED_OTHER, 0), "{name}: {threads:?}");
            let others = list(std::fs::read_to_string("/sys/devices/system/cpu/online").unwrap().trim());
            assert!(others.len() == 1 || !thread.cores.contains(&core), "{name}: {threads:?}");
        }
        assert_eq!(threads.len(), 4, "a thread that this test does not know: {threads:?}");
    }
}

#[test]
#[ignore = "needs root: SCHED_FIFO and locked memory"]
fn homing_streams_and_moves_do_not_fault_either() {
    let _lock = DemoLock::take();
    let ended = Program::start(["demo", "--for", "20s", "--drives", "4", "--json"]).end();
    let summary = ended.json();
    assert_sums(&summary);
    let real = &summary["realtime"];
    assert_eq!((&real["policy"], &real["memory_locked"]), (&"SCHED_FIFO".into(), &true.into()), "{real}");
    assert_eq!(real["page_faults"], 0, "{real}");
}

/// A drive that is switched off on a real network: the kernel queues what is sent to it, while it asks for its hardware
/// address in vain, and the queue takes its room from the socket that all drives share.
#[test]
#[ignore = "needs root: network namespaces (iproute2)"]
fn a_neighbour_that_is_dead_starves_nobody() {
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
    assert_eq!(ended.err, "fieldbeat: never answered: d3; look at their power, cables and addresses\n");
    let summary = ended.json();
    assert_sums(&summary);
    let cycles = summary["cycle"]["planned"].as_u64().unwrap();
    for name in ["d0", "d1", "d2"] {
        let drive = drive(&summary, name);
        let count = |key: &str| drive[key].as_u64().unwrap();
        assert_eq!((&drive["link"], count("losses"), count("unsent")), (&"online".into(), 0, 0), "{drive}");
        assert!(count("missed") * 10 <= count("sent"), "{drive}");
    }
    let dead = drive(&summary, "d3");
    let asked = dead["sent"].as_u64().unwrap() + dead["unsent"].as_u64().unwrap();
    // A probe every 100 ms, of cycles of 2 ms.
    assert!((1..=cycles / 50 + 1).contains(&asked), "{cycles} cycles: {dead}");
}

#[test]
#[ignore = "needs root: network namespaces (iproute2)"]
fn a_cable_that_was_pulled_and_put_back_brings_all_drives_back() {
    let machine = Machine::new(3).on(CABLE_NET);
    let cable = Cable::new(3, &[11, 12]);
    let config = machine.config("m.toml", 2, "", "health = { bucket = 50 }");
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
    master.signal(libc::SIGINT);
    let ended = master.end();
    ended.expect(1);
    let summary = ended.json();
    assert_sums(&summary);
    assert_eq!(drive(&summary, "d0")["losses"], 1, "{summary}");
}
