//! What the threads of a running master may still do: no capability that they do not need, none to be gained, and on
//! those that serve others no system call that they do not make.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;

use super::metrics::{endpoint, scrape};
use super::support::{
    CABLE_NET, Cable, LONG, Machine, NOBODY, PROGRAM, Program, command, drive, served, simulated, until,
};
use super::wires::kollmorgens;
use super::{assert_sums, await_online, finish, master, serve, with_drives};

/// What the kernel says of a thread.
#[derive(Debug)]
struct Thread {
    /// Of its permitted, effective, inheritable and ambient set.
    capabilities: u64,
    gains_none: bool,
    /// Filters of system calls; a container may have put one around all of them.
    filters: u32,
}

/// The threads of a process, with their names; the one that was started first has that of the program.
fn threads(pid: u32) -> Vec<(String, Thread)> {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let texts = tasks.filter_map(|task| fs::read_to_string(task.unwrap().path().join("status")).ok());
    let threads = texts.map(|text| {
        let fields: BTreeMap<&str, &str> = text.lines().filter_map(|line| line.split_once(":\t")).collect();
        let set = |name| u64::from_str_radix(fields[name], 16).unwrap();
        let capabilities = ["CapPrm", "CapEff", "CapInh", "CapAmb"].map(set);
        let thread = Thread {
            capabilities: capabilities.into_iter().fold(0, |all, set| all | set),
            gains_none: fields["NoNewPrivs"] == "1",
            filters: fields["Seccomp_filters"].parse().unwrap(),
        };
        (fields["Name"].to_owned(), thread)
    });
    threads.collect()
}

/// Those that open files or serial ports after the start: root's right to those of others (CAP_DAC_OVERRIDE).
const OPENS_FILES: [&str; 4] = ["fieldbeat", "fb-link", "fb-telemetry", "fb-blackbox"];

/// Those that read what others send.
const SERVES: [&str; 3] = ["fb-metrics", "fb-control", "fb-session"];

/// The threads that have more rights than they need, and those of these names that are missing. `around`: so many
/// filters are around this process, and so around its children.
fn excess(pid: u32, expected: &[&str], around: u32) -> Vec<String> {
    let (override_files, lock_memory) = (1 << 1, 1 << 14);
    let threads = threads(pid);
    let has_too_much = |(name, thread): &&(String, Thread)| {
        let files = if OPENS_FILES.contains(&&**name) { override_files } else { 0 };
        let filters = around + u32::from(SERVES.contains(&&**name));
        thread.capabilities & !(files | lock_memory) != 0 || !thread.gains_none || thread.filters != filters
    };
    let missing = expected.iter().filter(|name| threads.iter().all(|(known, _)| known != *name));
    let found = threads.iter().filter(has_too_much).map(|(name, thread)| format!("{name}: {thread:?}"));
    found.chain(missing.map(|name| format!("no thread {name}"))).collect()
}

/// The threads of this master have given up what they do not need, or are just about to.
#[track_caller]
fn assert_least(pid: u32, expected: &[&str]) {
    let around = threads(std::process::id()).first().map_or(0, |(_, thread)| thread.filters);
    let mut found = Vec::new();
    let are_least = until(LONG, || {
        found = excess(pid, expected, around);
        found.is_empty()
    });
    assert!(are_least, "{found:#?}");
}

#[test]
fn every_thread_of_a_running_master_has_the_least_rights_and_still_serves() {
    let (_machine, config, _sim) = with_drives(12, 1);
    let mut master = master(&config, &["--metrics", "0", "--json"]);
    let address = endpoint(&mut master);
    master.await_text("all drives online");
    let all =
        ["fieldbeat", "fb-loop", "fb-watchdog", "fb-telemetry", "fb-signals", "fb-metrics", "fb-control"];
    assert_least(master.pid(), &all);
    // Behind their filters, in conversations too.
    assert!(scrape(address).contains("fieldbeat_host_info{"));
    await_online(&config);
    let config = config.to_str().unwrap();
    Program::start(["param", "get", config, "d0", "0x20A8"]).end().expect(0);
    assert_least(master.pid(), &all);
    master.signal(libc::SIGUSR1);
    master.await_text("black box: ");
    finish(master);
}

/// `command` where seccomp(2) is refused, as some containers do: by the simplest of all filters.
fn without_filters(command: &mut Command) -> &mut Command {
    let step = |code: u32, jf, k| libc::sock_filter { code: code as u16, jt: 0, jf, k };
    let mut program = [
        step(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0),
        step(libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K, 1, libc::SYS_seccomp as u32),
        step(libc::BPF_RET | libc::BPF_K, 0, libc::SECCOMP_RET_ERRNO | libc::EPERM as u32),
        step(libc::BPF_RET | libc::BPF_K, 0, libc::SECCOMP_RET_ALLOW),
    ];
    // SAFETY: between fork and exec, system calls only; the kernel reads the program, which the closure owns.
    unsafe {
        command.pre_exec(move || {
            let program = libc::sock_fprog { len: program.len() as u16, filter: program.as_mut_ptr() };
            let mode = libc::c_ulong::from(libc::SECCOMP_MODE_FILTER);
            let refused = libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0
                || libc::prctl(libc::PR_SET_SECCOMP, mode, &raw const program) != 0;
            if refused { Err(io::Error::last_os_error()) } else { Ok(()) }
        })
    }
}

#[test]
fn refused_system_call_filters_are_reported_once_and_the_master_serves() {
    let (_machine, config, _sim) = with_drives(23, 1);
    let mut command = Command::new(PROGRAM);
    command.arg("run").arg(&config).args(["--metrics", "0", "--json"]);
    let mut master = Program::spawn(without_filters(&mut command));
    let address = endpoint(&mut master);
    master.await_text("all drives online");
    assert!(scrape(address).contains("fieldbeat_host_info{"));
    await_online(&config);
    let said = master.err();
    let said: Vec<&str> = said.lines().filter(|line| line.contains("filters")).collect();
    let [line] = said[..] else { panic!("{said:?}") };
    let begin = "fieldbeat: metrics, scope and control socket run without filters of system calls: ";
    assert!(line.starts_with(begin) && line.ends_with("; `fieldbeat doctor` says what to do"), "{line}");
    finish(master);
}

/// The frames' socket is bound for as long as the machine runs: nothing has to be opened again.
#[test]
#[ignore = "needs root: SCHED_FIFO, raw frames and network namespaces (iproute2)"]
fn a_segment_whose_cable_is_pulled_after_the_rights_are_gone_comes_back() {
    let machine = Machine::new(14).on(CABLE_NET);
    let cable = Cable::new(14, &[]);
    // Without the bit that the first slave sets, as the address of a network card.
    command(&["ip", "-n", &cable.master, "link", "set", "wire", "address", "10:10:10:10:10:10"]);
    let text = kollmorgens("wire").replace("realtime = \"off\"", "realtime = \"require\"");
    let config = machine.write("segment.toml", text);
    // Either end of this cable has that name; a configuration has both ends.
    let text = kollmorgens("master's").replace("drift_ppm", "interface = \"wire\", drift_ppm");
    let drives = machine.write("drives.toml", text);
    let _sim = cable.among_drives(|| served(|| simulated(&drives)));
    let mut program = Cable::command(&cable.master, PROGRAM);
    let mut master = Program::spawn(program.arg("run").arg(&config).arg("--json"));
    master.await_text("all drives online");
    assert_least(master.pid(), &["fieldbeat", "fb-loop", "fb-watchdog", "fb-telemetry", "fb-control"]);
    for (state, said) in [("down", "lost"), ("up", "back online")] {
        cable.plug(state);
        for name in ["turns", "moves"] {
            master.await_text(&format!("drive {name}: {said}"));
        }
    }
    let ended = master.end_by(libc::SIGINT);
    let summary = ended.expect(1).json();
    assert_sums(&summary);
    assert_eq!(summary["realtime"]["policy"], "SCHED_FIFO", "{summary}");
    for name in ["turns", "moves"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["losses"], &drive["link"]), (&1.into(), &"online".into()), "{summary}");
        // It stays so until somebody resets it.
        assert_eq!(drive["stopped"], "link lost", "{summary}");
    }
}

#[test]
#[ignore = "needs root: a directory of another user"]
fn root_still_writes_to_the_requested_place() {
    let machine = Machine::new(17);
    let config = machine.plain(1);
    let _sim = serve(&config);
    let [report, black_box] = ["report", "black-box"].map(|name| machine.path(name));
    for directory in [&report, &black_box] {
        fs::create_dir(directory).unwrap();
        std::os::unix::fs::chown(directory, Some(NOBODY), None).unwrap();
    }
    let [into, boxes] = [&report, &black_box].map(|directory| directory.to_str().unwrap());
    let mut master = master(&config, &["--json", "--report", into, "--black-box", boxes]);
    master.await_text("all drives online");
    master.signal(libc::SIGUSR1);
    master.await_text("black box: ");
    finish(master);
    assert!(report.join("index.html").exists());
    assert!(fs::read_dir(&black_box).unwrap().count() > 0);
}
