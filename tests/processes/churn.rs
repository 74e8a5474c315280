//! Drives of every protocol that die and come back again and again, for long: what the master holds for them stays the
//! same.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::thread::sleep;
use std::time::{Duration, Instant};

use libc::SIGTERM;

use super::support::{Machine, Program, assert_sums};
use super::{ask, await_status, master, patient_cycle, simulation};

/// How long, s, unless `CHURN_SECONDS` says otherwise.
const SECONDS: u64 = 20 * 60;
/// Rounds whose largest values are compared: the first ones fill what is kept for ever, such as histograms.
const ROUNDS: usize = 10;
/// Of each of two connections the old socket and the new one may be open, and the one that reads the status.
const SLACK_DESCRIPTORS: usize = 5;
/// The thread that answers the status may not have ended yet, and may have in all of the first rounds.
const SLACK_THREADS: usize = 1;
/// What the memory may differ by, KiB: an allocator keeps pages back.
const SLACK_KIB: u64 = 2_048;

/// Two LinMots, two Unidrives and a line of two Kollmorgens, each lost soon.
fn config(machine: &Machine) -> PathBuf {
    let line = format!("local:churn-{}", std::process::id());
    let (bind, [a, b, c, d]) = (machine.ip(1), [11, 12, 21, 22].map(|host| machine.ip(host)));
    let health = "health = { bucket = \"200ms\", leak = 1, probe_interval = \"20ms\" }";
    machine.write(
        "churn.toml",
        format!(
            "{}[[bus]]\nprotocol = \"linudp-v2\"\nbind = \"{bind}\"\n[bus.defaults]\n{health}\n\
             [[bus.drive]]\nname = \"a\"\naddress = \"{a}\"\n[[bus.drive]]\nname = \"b\"\naddress = \"{b}\"\n\
             [[bus]]\nprotocol = \"modbus-tcp\"\n[bus.defaults]\ndivisor = 4\n{health}\n\
             [[bus.drive]]\nname = \"c\"\naddress = \"{c}:1502\"\nphase = 1\n\
             [[bus.drive]]\nname = \"d\"\naddress = \"{d}:1502\"\nphase = 3\n\
             [[bus]]\nprotocol = \"ethercat\"\ninterface = \"{line}\"\n[bus.defaults]\n{health}\n\
             [[bus.drive]]\nname = \"e\"\n[[bus.drive]]\nname = \"f\"\n",
            patient_cycle()
        ),
    )
}

/// What a process holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Held {
    descriptors: usize,
    memory_kib: u64,
    threads: usize,
}

impl Held {
    fn of(pid: u32) -> Held {
        let entries = |what: &str| std::fs::read_dir(format!("/proc/{pid}/{what}")).unwrap().count();
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        let memory_kib = line.split_whitespace().next().unwrap().parse().unwrap();
        Held { descriptors: entries("fd"), memory_kib, threads: entries("task") }
    }

    fn most(all: &VecDeque<Held>) -> Held {
        all.iter().fold(Held::default(), |most, held| Held {
            descriptors: most.descriptors.max(held.descriptors),
            memory_kib: most.memory_kib.max(held.memory_kib),
            threads: most.threads.max(held.threads),
        })
    }
}

/// The drives live for half a second, with a `status` meanwhile, and are dead for as long.
fn round(config: &std::path::Path, master: &Program) -> Held {
    let drives = simulation(config);
    sleep(Duration::from_millis(500));
    ask("status", config, "--json").expect(0);
    let held = Held::of(master.pid());
    drives.kill();
    // Long enough for each of them to be lost.
    sleep(Duration::from_millis(400));
    held
}

fn await_datagrams_and_connections(config: &std::path::Path) {
    await_status(config, |summary| {
        let mut drives = summary["drives"].as_array().into_iter().flatten();
        drives.all(|drive| drive["protocol"] == "ethercat" || drive["link"] == "online")
    });
}

#[test]
#[ignore = "twenty minutes: drives that are killed and restarted each second"]
fn drives_that_die_each_second_cost_the_master_neither_memory_nor_descriptors() {
    let machine = Machine::new(190);
    let config = config(&machine);
    let drives = simulation(&config);
    let mut master = master(&config, &["--json"]);
    await_datagrams_and_connections(&config);
    drives.kill();
    let limit = std::env::var("CHURN_SECONDS").ok().map_or(SECONDS, |text| text.parse().expect("seconds"));
    let begun = Instant::now();
    let (mut first, mut last) = (None, VecDeque::new());
    let mut rounds = 0_u64;
    while begun.elapsed() < Duration::from_secs(limit) || rounds < 3 * ROUNDS as u64 {
        last.push_back(round(&config, &master));
        rounds += 1;
        // The first rounds are those after as many that nobody counts.
        if rounds == 2 * ROUNDS as u64 {
            first = Some(Held::most(&last));
        }
        if last.len() == ROUNDS {
            last.pop_front();
        }
        assert!(master.is_running(), "{}", master.err());
    }
    let (first, last) = (first.expect("there were so many rounds"), Held::most(&last));
    println!("{rounds} rounds in {:.0?}: at first {first:?}, at last {last:?}", begun.elapsed());
    assert!(
        last.descriptors <= first.descriptors + SLACK_DESCRIPTORS,
        "{first:?} became {last:?} in {rounds} rounds"
    );
    assert!(last.threads <= first.threads + SLACK_THREADS, "{first:?} became {last:?} in {rounds} rounds");
    assert!(last.memory_kib <= first.memory_kib + SLACK_KIB, "{first:?} became {last:?} in {rounds} rounds");
    // They come back, for good. A line needs a loop that is never late for that, which not every host has.
    let _drives = simulation(&config);
    await_datagrams_and_connections(&config);
    let ended = master.end_by(SIGTERM);
    let summary = ended.json();
    assert_sums(&summary);
    let drives = summary["drives"].as_array().unwrap();
    println!("losses: {:?}", drives.iter().map(|drive| &drive["losses"]).collect::<Vec<_>>());
    for drive in drives {
        // A connection takes longer than a drive lives, now and then, and a line on a busy host always.
        let least = match drive["protocol"].as_str().unwrap() {
            "linudp-v2" => rounds / 2,
            "modbus-tcp" => 1,
            _ => 0,
        };
        assert!(drive["losses"].as_u64().unwrap() >= least, "{rounds} rounds: {drive}");
    }
}
