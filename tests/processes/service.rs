//! The unit of a service: what it takes from the program, and that it takes nothing that the program needs.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::process::CommandExt;
use std::process::Command;

use fieldbeat_core::rt::confine::allow_only;
use serde_json::Value;

use super::metrics::{endpoint, scrape};
use super::support::{Ended, Machine, PROGRAM, Program, again, checkout, role};
use super::{await_online, serve};

const UNIT: &str = "rt-config/host/fieldbeat.service";

/// The value of each line of the unit with this key.
fn lines(key: &str) -> Vec<String> {
    let unit = fs::read_to_string(checkout(UNIT)).unwrap();
    let of_key = |line: &str| line.strip_prefix(key)?.strip_prefix('=').map(str::to_owned);
    unit.lines().filter_map(of_key).collect()
}

/// What `systemd-analyze WORDS` prints; `None`, and the reason is said, where there is none.
fn systemd_analyze(words: &[&str]) -> Option<(bool, String)> {
    match Command::new("systemd-analyze").args(words).output() {
        Ok(output) => Some((output.status.success(), String::from_utf8(output.stdout).unwrap())),
        Err(error) => {
            println!("skipped: systemd-analyze: {error}");
            None
        }
    }
}

#[test]
fn the_unit_leaves_little_to_a_program_that_was_taken_over() {
    let unit = checkout(UNIT);
    // 2.0 of 10; older versions of systemd cannot judge a file.
    let words = ["security", "--offline=true", "--threshold=20", "--no-pager", unit.to_str().unwrap()];
    let Some((passes, text)) = systemd_analyze(&words) else { return };
    if text.is_empty() {
        return println!("skipped: this systemd-analyze does not judge a file");
    }
    assert!(passes, "{text}");
    // What would end real time, hide what outlives a killed run, or hide what the summary reads.
    for (key, value) in [("RestrictRealtime", "no"), ("RemoveIPC", "no"), ("LimitMEMLOCK", "infinity")] {
        assert_eq!(lines(key), [value]);
    }
    for key in ["DynamicUser", "ProcSubset", "TemporaryFileSystem", "PrivateNetwork", "PrivateUsers"] {
        assert!(lines(key).is_empty(), "{key}");
    }
}

/// The system calls of the unit's filter, by name.
fn allowed() -> Option<BTreeSet<String>> {
    let (_, text) = systemd_analyze(&["syscall-filter", "--no-pager"])?;
    let mut groups: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    let mut group = "";
    for line in text.lines().filter(|line| !line.trim_start().starts_with('#')) {
        match line.strip_prefix("    ") {
            None => group = line.trim(),
            Some(call) => groups.entry(group).or_default().push(call),
        }
    }
    fn add<'a>(groups: &BTreeMap<&str, Vec<&'a str>>, name: &'a str, calls: &mut BTreeSet<String>) {
        match groups.get(name) {
            Some(members) => members.iter().for_each(|member| add(groups, member, calls)),
            None => drop(calls.insert(name.to_owned())),
        }
    }
    // Always allowed (systemd.exec(5)).
    let mut allowed = BTreeSet::new();
    add(&groups, "@default", &mut allowed);
    for line in lines("SystemCallFilter") {
        let (denies, names) = line.strip_prefix('~').map_or((false, &*line), |names| (true, names));
        for name in names.split_whitespace() {
            let mut calls = BTreeSet::new();
            add(&groups, name, &mut calls);
            match denies {
                true => allowed.retain(|call| !calls.contains(call)),
                false => allowed.extend(calls),
            }
        }
    }
    Some(allowed)
}

/// Their numbers on this architecture; those of others have none.
fn numbers(names: &BTreeSet<String>) -> Vec<libc::c_long> {
    let words = ["-E", "-dM", "-include", "sys/syscall.h", "-x", "c", "/dev/null"];
    let output = Command::new("cc").args(words).output().expect("a C compiler is there, as rustc's linker");
    let text = String::from_utf8(output.stdout).unwrap();
    let known: BTreeMap<&str, libc::c_long> = (text.lines())
        .filter_map(|line| line.strip_prefix("#define __NR_")?.split_once(' '))
        .filter_map(|(name, number)| Some((name, number.parse().ok()?)))
        .collect();
    names.iter().filter_map(|name| known.get(&**name).copied()).collect()
}

/// The program under the filter and the bounding set of the unit, without a systemd that runs. Its limits are replaced
/// by the capabilities that have the same effect: root in a container may not raise limits.
fn in_service(name: &str, arguments: &[&str]) -> Command {
    let [bounding] = &lines("CapabilityBoundingSet")[..] else { panic!("one bounding set") };
    let kept = bounding.to_lowercase().replace("cap_", "+").replace(' ', ",");
    let inner = again(name, &arguments.join("\n"));
    let mut command = Command::new("setpriv");
    command.arg(format!("--bounding-set=-all,{kept},+sys_nice,+ipc_lock")).arg("--no-new-privs");
    command.arg("--inh-caps=-all").arg(inner.get_program()).args(inner.get_args());
    command.envs(inner.get_envs().filter_map(|(key, value)| Some((key, value?))));
    command
}

/// The object of `--json`, behind what the test program says that has become it.
fn summary(ended: &Ended) -> Value {
    serde_json::from_str(ended.out.lines().last().unwrap_or_default()).unwrap()
}

#[test]
#[ignore = "needs root: SCHED_FIFO, a bounding set (setpriv) and raw frames"]
fn the_program_runs_in_real_time_under_the_filter_and_the_bounding_set_of_the_unit() {
    let name = "service::the_program_runs_in_real_time_under_the_filter_and_the_bounding_set_of_the_unit";
    let Some(allowed) = allowed() else { return };
    if let Some(arguments) = role() {
        allow_only(&numbers(&allowed), &[]).unwrap();
        panic!("{}", Command::new(PROGRAM).args(arguments.split('\n')).exec());
    }
    // What its threads give up their rights by, and what a process needs that it starts.
    let rights = ["capset", "prctl", "seccomp", "sched_setscheduler", "mlockall"];
    let processes = [
        "clone",
        "clone3",
        "execve",
        "fork",
        "listen",
        "memfd_create",
        "pidfd_open",
        "pipe2",
        "vfork",
        "waitid",
    ];
    for call in rights.iter().chain(&processes) {
        assert!(allowed.contains(*call), "{call}");
    }
    for call in ["ptrace", "mount", "bpf", "setuid", "init_module", "keyctl", "io_uring_setup"] {
        assert!(!allowed.contains(call), "{call}");
    }
    let machine = Machine::new(22);
    let config = machine.config("m.toml", 1, "realtime = \"require\"", "");
    let _sim = serve(&config);
    let report = machine.path("report");
    let run = ["run", config.to_str().unwrap(), "--json", "--metrics", "0", "--report"];
    let arguments = [&run[..], &[report.to_str().unwrap()]].concat();
    let mut master = Program::spawn(&mut in_service(name, &arguments));
    let address = endpoint(&mut master);
    master.await_text("all drives online");
    assert!(scrape(address).contains("fieldbeat_host_info{"));
    await_online(&config);
    master.signal(libc::SIGUSR1);
    master.await_text("black box: ");
    let of_run = summary(master.end_by(libc::SIGTERM).expect(0));
    assert_eq!(of_run["realtime"]["policy"], "SCHED_FIFO", "{of_run}");
    assert_eq!(of_run["realtime"]["memory_locked"], true, "{of_run}");
    assert!(report.join("index.html").exists());

    let demo = Program::spawn(&mut in_service(name, &["demo", "--for", "1s", "--json"])).end();
    assert!(demo.signal.is_none() && summary(&demo)["cycle"]["executed"].as_u64() > Some(0), "{}", demo.err);
    // Nothing answers on the loopback, but its frames may be sent.
    let scan = Program::spawn(&mut in_service(name, &["ethercat", "scan", "lo"])).end();
    assert!(scan.code == Some(1) && !scan.err.contains("right"), "{scan:?}");
}
