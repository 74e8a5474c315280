//! What the whole-system tests share: configurations in a directory of their own, the period that this host carries,
//! and the built program as a child that never outlives its test.
#![allow(dead_code, reason = "every test program uses its own part")]

pub mod adventures;
pub mod controller;
pub mod counting;
pub mod forward;
pub mod hold;
pub mod onlooker;

use std::collections::BTreeSet;
use std::io::{self, Read};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, OnceLock};
use std::thread::{JoinHandle, sleep};
use std::time::{Duration, Instant};

use fieldbeat::bus::BusPlan;
use fieldbeat::config::Configuration;
use fieldbeat::doctor::glance;
use fieldbeat::sim::Simulated;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::time::MS;
use fieldbeat::{CyclePlan, Overrun, Plan, Realtime};

/// Nothing takes this long, however busy the machine; whatever does is killed, and its test fails.
pub const LONG: Duration = Duration::from_secs(60);

/// Periods of tests on real sockets, ns: LinMots take streams up to 10 ms, Kollmorgens whole ms above 3 ms.
const PERIODS_NS: [u64; 3] = [2 * MS, 4 * MS, 8 * MS];

/// The largest share of disturbed cycles that these tests allow.
const MOST_DISTURBED: f64 = 0.2;

/// The shortest of these that this host carries, ns: measured once in this process, with ordinary threads.
pub fn carried() -> u64 {
    static CARRIED: OnceLock<u64> = OnceLock::new();
    *CARRIED.get_or_init(|| {
        let cycle = CyclePlan { realtime: Realtime::Off, ..CyclePlan::default() };
        glance(&cycle).expect("the core of the loop is there").shortest(&PERIODS_NS, MOST_DISTURBED)
    })
}

/// The same as a configuration has it.
pub fn period() -> String {
    format!("{}ms", carried() / MS)
}

/// A machine of this bus whose loop skips whatever a busy host takes from it; of the cycle it takes what is not said
/// here.
pub fn skipping(bus: impl BusPlan + 'static, cycle: CyclePlan) -> Plan {
    let cycle = CyclePlan { overrun: Overrun::Skip { max_skip: u64::MAX }, max_skip_rate: 1.0, ..cycle };
    Plan { source: None, cycle, buses: vec![Box::new(bus)], groups: Vec::new() }
}

/// 500 cycles a second of an ordinary thread, in which replies have their time.
pub fn ordinary_cycle() -> CyclePlan {
    CyclePlan { period_ns: 2 * MS, receive_deadline: 0.8, realtime: Realtime::Off, ..CyclePlan::default() }
}

/// Lines of `[cycle]`: however much of the cycles this host takes, the run is not judged by it.
pub const UNJUDGED: &str = "max_late_share = 1.0\nmax_skipped_share = 1.0\nmax_unanswered_share = 1.0\n";

/// The program as a user has it.
pub const PROGRAM: &str = env!("CARGO_BIN_EXE_fieldbeat");

/// `nobody` on every distribution.
pub const NOBODY: u32 = 65534;

/// A file of the checkout.
pub fn checkout(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(file)
}

pub fn is_root() -> bool {
    nix::unistd::geteuid().is_root()
}

/// Set in a child of [`again`].
const ROLE: &str = "FIELDBEAT_TEST_ROLE";

/// This test program once more, for its one test `name` and to play `role` in it: what must not happen to the process
/// that runs all the other tests.
pub fn again(name: &str, role: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().unwrap());
    // With one thread its harness would write the name of the test before our first line.
    command.args([name, "--exact", "--include-ignored", "--nocapture", "--test-threads=2"]).env(ROLE, role);
    gets_signals(&mut command);
    command
}

/// Whoever runs the tests may ignore SIGHUP (nohup), or SIGINT and SIGQUIT (a job in the background): the command gets
/// them all the same.
fn gets_signals(command: &mut Command) {
    // SAFETY: between fork and exec only signal(2) is called, which is async-signal-safe.
    unsafe {
        command.pre_exec(|| {
            for signal in [libc::SIGHUP, libc::SIGINT, libc::SIGQUIT] {
                libc::signal(signal, libc::SIG_DFL);
            }
            Ok(())
        });
    }
}

/// What this process shall play, if [`again`] started it.
pub fn role() -> Option<String> {
    std::env::var(ROLE).ok()
}

/// Waits until `done` holds. False if it does not within `limit`.
pub fn until(limit: Duration, mut done: impl FnMut() -> bool) -> bool {
    let begun = Instant::now();
    while !done() {
        if begun.elapsed() > limit {
            return false;
        }
        sleep(Duration::from_millis(5));
    }
    true
}

/// Opens what has an address, and waits for an address that an earlier socket of this process still has: a child that
/// another test has just forked holds it until it is executed, which takes long on a busy host.
#[track_caller]
pub fn bound<T>(open: impl Fn() -> io::Result<T>) -> T {
    let mut opened = None;
    let is_open = until(LONG, || match open() {
        Ok(what) => {
            opened = Some(what);
            true
        }
        Err(error) if error.kind() == io::ErrorKind::AddrInUse => false,
        Err(error) => panic!("{error}"),
    });
    assert!(is_open, "the address stays in use");
    opened.unwrap()
}

/// Serves `simulated` on real sockets.
#[track_caller]
pub fn served(simulated: impl Fn() -> Simulated) -> SimServer {
    bound(|| SimServer::start(simulated(), ServerOptions::default()))
}

/// The numbers of the machines of this test program.
static TAKEN: Mutex<BTreeSet<u8>> = Mutex::new(BTreeSet::new());

/// A network of its own on loopback, and a directory for its configurations that goes with it.
///
/// The second byte of its addresses comes from the process, so that two runs of the tests on one computer do not meet.
pub struct Machine {
    test: u8,
    directory: PathBuf,
    net: [u8; 3],
}

impl Machine {
    /// `test` is unique in its test program: the addresses are 127.p.`test`.0/24.
    pub fn new(test: u8) -> Machine {
        // Under nohup this process ignores it, and so would every program that it starts.
        // SAFETY: the default action replaces no handler of this process.
        unsafe { libc::signal(libc::SIGHUP, libc::SIG_DFL) };
        assert!(TAKEN.lock().unwrap().insert(test), "two machines have the number {test}");
        let id = std::process::id();
        let directory = std::env::temp_dir().join(format!("fieldbeat-{id}-{test}"));
        std::fs::create_dir_all(&directory).unwrap();
        std::fs::set_permissions(&directory, PermissionsExt::from_mode(0o755)).unwrap();
        Machine { test, directory, net: [127, 100 + (id % 128) as u8, test] }
    }

    /// The same in another network, for a namespace of its own.
    pub fn on(mut self, net: [u8; 3]) -> Machine {
        self.net = net;
        self
    }

    pub fn ip(&self, host: u8) -> Ipv4Addr {
        let [a, b, c] = self.net;
        Ipv4Addr::new(a, b, c, host)
    }

    /// Where the master listens.
    pub fn master(&self) -> SocketAddrV4 {
        SocketAddrV4::new(self.ip(1), 41136)
    }

    /// Where drive `index` listens.
    pub fn drive(&self, index: usize) -> SocketAddrV4 {
        SocketAddrV4::new(self.ip(11 + index as u8), 49360)
    }

    pub fn path(&self, file: &str) -> PathBuf {
        self.directory.join(file)
    }

    /// A configuration of drives `d0`, `d1` ...; `cycle` and `defaults` are lines of `[cycle]` and `[bus.defaults]`.
    ///
    /// It is made for any host: a period that it carries, and tolerances in seconds. A link is lost after ten of them
    /// in which more replies are missed than come; a test that needs a loss has a shorter one ([`Machine::LOST_SOON`]).
    pub fn config(&self, file: &str, drives: usize, cycle: &str, defaults: &str) -> PathBuf {
        let period = format!("\"{}\"", period());
        let cycles = [
            ("period", &*period),
            ("receive_deadline", "0.8"),
            ("max_skip", "\"30s\""),
            ("max_skip_rate", "1.0"),
            ("realtime", "\"off\""),
        ];
        let unjudged = UNJUDGED.lines().filter_map(|line| line.split_once(" = "));
        let cycles: Vec<(&str, &str)> = cycles.into_iter().chain(unjudged).collect();
        let axes = [
            ("limits", "{ position = [0, 400], velocity = 2000, acceleration = 20000 }"),
            ("health", "{ bucket = \"10s\", leak = 1 }"),
        ];
        // Ours where the test gives no other value.
        let section = |lines: &str, usual: &[(&str, &str)]| {
            let is = |line: &str, key: &str| {
                line.trim_start().strip_prefix(key).is_some_and(|rest| rest.starts_with([' ', '=', '.']))
            };
            let missing = usual.iter().filter(|(key, _)| !lines.lines().any(|line| is(line, key)));
            missing.map(|(key, value)| format!("{key} = {value}\n")).collect::<String>() + lines + "\n"
        };
        let mut text = format!(
            "[cycle]\n{}[[bus]]\nprotocol = \"linudp-v2\"\nbind = \"{}\"\n[bus.defaults]\n{}",
            section(cycle, &cycles),
            self.ip(1),
            section(defaults, &axes)
        );
        for index in 0..drives {
            text +=
                &format!("[[bus.drive]]\nname = \"d{index}\"\naddress = \"{}\"\n", self.drive(index).ip());
        }
        self.write(file, &text)
    }

    /// The configuration that most tests want.
    pub fn plain(&self, drives: usize) -> PathBuf {
        self.config("plain.toml", drives, "", "")
    }

    /// Lines of `[bus.defaults]`: a drive is lost after a second of silence, which no host makes.
    pub const LOST_SOON: &str = "health = { bucket = \"1s\", leak = 1 }";

    /// Of its two drives the second shows variables besides its process data; the last one is none that it has.
    pub fn showing(&self) -> PathBuf {
        let text = std::fs::read_to_string(self.config("plain.toml", 2, "", Machine::LOST_SOON)).unwrap();
        let monitor = "monitor = [\"core-temperature\", \"drive-timer\", \"0x9999\"]\n";
        self.write("showing.toml", text + monitor)
    }

    pub fn write(&self, file: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(file);
        std::fs::write(&path, bytes).unwrap();
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o644)).unwrap();
        path
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.directory);
        // The next test with this number fails if this one has.
        if let Ok(mut taken) = TAKEN.lock() {
            taken.remove(&self.test);
        }
    }
}

/// A configuration.
fn configuration(path: &Path) -> Configuration {
    fieldbeat::config::load(path).unwrap_or_else(|errors| panic!("{errors}"))
}

/// The plan of a configuration.
pub fn plan(path: &Path) -> Plan {
    configuration(path).plan
}

/// The simulated drives of a configuration.
pub fn simulated(path: &Path) -> Simulated {
    configuration(path).simulation.build()
}

/// A child whose output is collected while it runs. Dropped = killed.
pub struct Program {
    child: Child,
    out: Text,
    err: Text,
    readers: Vec<JoinHandle<()>>,
    leaves_memory: bool,
}

type Text = Arc<Mutex<String>>;

/// How a child ended.
#[derive(Debug)]
pub struct Ended {
    pub code: Option<i32>,
    pub signal: Option<i32>,
    pub out: String,
    pub err: String,
}

impl Program {
    /// The built program with `arguments`.
    pub fn start<S: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = S>) -> Program {
        let mut command = Command::new(PROGRAM);
        command.args(arguments);
        gets_signals(&mut command);
        Program::spawn(&mut command)
    }

    pub fn spawn(command: &mut Command) -> Program {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        // Its files and sockets are not to lie among those of whoever runs the tests.
        directories_of(command, nix::unistd::geteuid().as_raw());
        let mut child = loop {
            match command.spawn() {
                Ok(child) => break child,
                // A thread that forked just now still holds the freshly written file, until it executes its own.
                Err(error) if error.kind() == std::io::ErrorKind::ExecutableFileBusy => {
                    sleep(Duration::from_millis(10));
                }
                Err(error) => panic!("cannot start {command:?}: {error}"),
            }
        };
        let (out, err) = (Text::default(), Text::default());
        let readers = vec![
            collect(child.stdout.take().unwrap(), Arc::clone(&out)),
            collect(child.stderr.take().unwrap(), Arc::clone(&err)),
        ];
        Program { child, out, err, readers, leaves_memory: false }
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// What it has written to standard output so far.
    pub fn out(&self) -> String {
        self.out.lock().unwrap().clone()
    }

    /// What it has written to standard error so far.
    pub fn err(&self) -> String {
        self.err.lock().unwrap().clone()
    }

    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    pub fn signal(&self, signal: i32) {
        // SAFETY: takes two numbers; the child has not been waited for, so that its id is its own.
        assert_eq!(unsafe { libc::kill(self.pid() as i32, signal) }, 0, "signal {signal}");
    }

    /// Stops it as Ctrl-Z does, and waits until it stands.
    pub fn hold(&self) {
        self.signal(libc::SIGSTOP);
        // The state comes behind the name (proc_pid_stat(5)); of each thread, since they stop one by one.
        let stands = |task: std::io::Result<std::fs::DirEntry>| {
            let stat = std::fs::read_to_string(task.unwrap().path().join("stat")).unwrap_or_default();
            stat.rsplit(") ").next().is_some_and(|rest| rest.starts_with('T'))
        };
        let tasks = || std::fs::read_dir(format!("/proc/{}/task", self.pid())).unwrap();
        assert!(until(LONG, || tasks().all(stands)), "it does not stop");
    }

    /// Waits until a signal of this kind is caught and no longer the end of the process.
    pub fn await_handler(&self, signal: i32) {
        let caught = || {
            let status = std::fs::read_to_string(format!("/proc/{}/status", self.pid())).unwrap_or_default();
            let mask = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).map(str::trim);
            let mask = mask.and_then(|mask| u64::from_str_radix(mask, 16).ok()).unwrap_or(0);
            mask & 1 << (signal - 1) != 0
        };
        assert!(until(LONG, caught), "signal {signal} is not caught: {}", self.err());
    }

    /// Waits until `text` stands in its standard output or error.
    pub fn await_text(&mut self, text: &str) {
        let begun = Instant::now();
        loop {
            // In this order: what it wrote before it ended is still looked at.
            let running = self.is_running();
            let found = self.out().contains(text) || self.err().contains(text);
            if found {
                return;
            }
            assert!(
                running && begun.elapsed() < LONG,
                "no \"{text}\" from the program (running: {running}):\n{}{}",
                self.out(),
                self.err()
            );
            sleep(Duration::from_millis(5));
        }
    }

    /// Waits for its end; kills it and fails after `limit`.
    pub fn end_within(mut self, limit: Duration) -> Ended {
        let begun = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            if begun.elapsed() > limit {
                let _ = self.child.kill();
                panic!("still running after {limit:?}:\n{}{}", self.out(), self.err());
            }
            sleep(Duration::from_millis(2));
        };
        for reader in self.readers.drain(..) {
            reader.join().unwrap();
        }
        self.tidy();
        Ended { code: status.code(), signal: status.signal(), out: self.out(), err: self.err() }
    }

    pub fn end(self) -> Ended {
        self.end_within(LONG)
    }

    /// Its end, by this signal.
    pub fn end_by(self, signal: i32) -> Ended {
        self.signal(signal);
        self.end()
    }

    /// kill -9, and waits until it is gone. What it leaves in memory goes with it.
    pub fn kill(self) {
        drop(self);
    }

    /// What it leaves in memory when it is killed stays; else the next program of the same black box would tell of it.
    pub fn leaving_memory(mut self) -> Program {
        self.leaves_memory = true;
        self
    }

    fn tidy(&self) {
        if !self.leaves_memory {
            let _ = self.memory().map(std::fs::remove_file);
        }
    }

    /// The memory of its records, once it has one.
    pub fn memory(&self) -> Option<PathBuf> {
        memory_of(self.pid())
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        if let Ok(Some(_)) = self.child.try_wait() {
            return;
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.tidy();
    }
}

fn collect(mut from: impl Read + Send + 'static, into: Text) -> JoinHandle<()> {
    std::thread::spawn(move || {
        let mut bytes = [0; 4096];
        while let Ok(count @ 1..) = from.read(&mut bytes) {
            into.lock().unwrap().push_str(&String::from_utf8_lossy(&bytes[..count]));
        }
    })
}

/// The memory of a process' records, if there is one.
pub fn memory_of(process: u32) -> Option<PathBuf> {
    let name = format!("fieldbeat-{process}-");
    let mut entries = std::fs::read_dir("/dev/shm").ok()?.flatten();
    entries.find(|entry| entry.file_name().to_string_lossy().starts_with(&name)).map(|entry| entry.path())
}

/// Runs the program to its end.
pub fn run<S: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = S>) -> Ended {
    Program::start(arguments).end()
}

impl Ended {
    /// Standard output as the one JSON object that `--json` promises.
    pub fn json(&self) -> serde_json::Value {
        assert_eq!(self.out.lines().count(), 1, "one object, one line: {self:?}");
        serde_json::from_str(&self.out).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }

    #[track_caller]
    pub fn expect(&self, code: i32) -> &Ended {
        assert_eq!((self.code, self.signal), (Some(code), None), "{}{}", self.out, self.err);
        self
    }

    /// Exit code 2 and one line on standard error that says `parts`; nothing on standard output.
    #[track_caller]
    pub fn refused(&self, parts: &[&str]) {
        self.one_line(2, parts);
    }

    /// The same with exit code 1. A host that takes its time is shown how far it is before that.
    #[track_caller]
    pub fn failed(&self, parts: &[&str]) {
        self.one_line(1, parts);
    }

    #[track_caller]
    fn one_line(&self, code: i32, parts: &[&str]) {
        self.expect(code);
        let lines: Vec<&str> = self.err.lines().filter(|line| code != 1 || !line.ends_with(" %)")).collect();
        let [line] = lines[..] else { panic!("{}", self.err) };
        assert!(line.starts_with("fieldbeat: ") && self.err.ends_with('\n'), "{}", self.err);
        for part in parts {
            assert!(line.contains(part), "no \"{part}\": {}", self.err);
        }
        assert_eq!(self.out, "");
    }

    /// Standard error without what the host took meanwhile: a failed run may say so at its end.
    pub fn err_but_host(&self) -> &str {
        self.err.split("; this host took ").next().unwrap_or_default().trim_end()
    }
}

/// The copy of the program that an ordinary user may execute: the build may lie where only its owner looks.
pub fn public_program(machine: &Machine) -> PathBuf {
    let copy = machine.path("fieldbeat");
    if !copy.exists() {
        std::fs::copy(PROGRAM, &copy).unwrap();
        std::fs::set_permissions(&copy, PermissionsExt::from_mode(0o755)).unwrap();
    }
    copy
}

/// The program as a user without any right to real time has it.
pub fn as_ordinary_user(machine: &Machine) -> Command {
    let root = is_root();
    let mut command = Command::new(if root { public_program(machine) } else { PathBuf::from(PROGRAM) });
    if root {
        directories_of(&mut command, NOBODY);
    }
    // SAFETY: between fork and exec, system calls only.
    unsafe {
        command.pre_exec(move || {
            let no_priority = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
            let little = libc::rlimit { rlim_cur: 64 << 10, rlim_max: 64 << 10 };
            let mut refused = libc::setrlimit(libc::RLIMIT_RTPRIO, &no_priority)
                | libc::setrlimit(libc::RLIMIT_MEMLOCK, &little);
            if root {
                refused |= libc::setgroups(0, std::ptr::null()) | libc::setgid(NOBODY) | libc::setuid(NOBODY);
            }
            if refused == 0 { Ok(()) } else { Err(std::io::Error::last_os_error()) }
        });
    }
    command
}

/// Sets the directories for the program's sockets and files.
pub fn directories_of(command: &mut Command, user: u32) {
    let directory = std::env::temp_dir().join(format!("fieldbeat-tests-{user}"));
    for name in ["XDG_RUNTIME_DIR", "XDG_STATE_HOME"] {
        if command.get_envs().all(|(set, _)| set != name) {
            command.env(name, &directory);
        }
    }
}

/// `planned = executed + skipped`, each counted on its own, and `sent = answered + missed` of each drive.
#[track_caller]
pub fn assert_sums(summary: &serde_json::Value) {
    let cycle = |key: &str| summary["cycle"][key].as_u64().unwrap();
    assert_eq!(cycle("planned"), cycle("executed") + cycle("skipped"), "{summary}");
    for drive in summary["drives"].as_array().unwrap() {
        let count = |key: &str| drive[key].as_u64().unwrap();
        assert_eq!(count("sent"), count("answered") + count("missed"), "{drive}");
    }
}

/// How many probes at most a drive was sent that never answered: one in 100 ms (`health.probe_interval`).
pub fn most_probes(summary: &serde_json::Value) -> u64 {
    let cycle = |key: &str| summary["cycle"][key].as_u64().unwrap();
    cycle("planned") * cycle("period_ns") / (100 * MS) + 1
}

/// The drive of that name.
pub fn drive<'a>(summary: &'a serde_json::Value, name: &str) -> &'a serde_json::Value {
    let drives = summary["drives"].as_array().unwrap();
    drives.iter().find(|drive| drive["name"] == name).unwrap_or_else(|| panic!("no drive {name}: {summary}"))
}

/// Two network namespaces with one cable between them; removed with this. Needs root and iproute2.
///
/// The addresses are those of TEST-NET-2 (RFC 5737), which lead nowhere else.
pub struct Cable {
    pub master: String,
    pub drives: String,
}

/// The network of a [`Cable`].
pub const CABLE_NET: [u8; 3] = [198, 51, 100];

impl Cable {
    /// The master's end has host number 1, the other end those of `hosts`.
    pub fn new(test: u8, hosts: &[u8]) -> Cable {
        let id = std::process::id();
        let cable = Cable { master: format!("fb{id}-{test}-m"), drives: format!("fb{id}-{test}-d") };
        let [a, b, c] = CABLE_NET;
        for name in [&cable.master, &cable.drives] {
            ip(&format!("netns add {name}"));
            ip(&format!("-n {name} link set lo up"));
        }
        let Cable { master, drives } = &cable;
        ip(&format!("-n {master} link add wire type veth peer name wire netns {drives}"));
        ip(&format!("-n {master} address add {a}.{b}.{c}.1/24 dev wire"));
        for host in hosts {
            ip(&format!("-n {drives} address add {a}.{b}.{c}.{host}/24 dev wire"));
        }
        cable.plug("up");
        ip(&format!("-n {master} link set wire up"));
        cable
    }

    /// `up` or `down`: the drives' end of the cable.
    pub fn plug(&self, state: &str) {
        ip(&format!("-n {} link set wire {state}", self.drives));
    }

    /// `add` or `del`: the address of the drive with this host number, at the drives' end. A master that knew it has to
    /// ask for it anew.
    pub fn address(&self, action: &str, machine: &Machine, host: u8) {
        let address = machine.ip(host);
        ip(&format!("-n {} address {action} {address}/24 dev wire", self.drives));
        ip(&format!("-n {} neighbour flush to {address} dev wire", self.master));
    }

    /// What `open` opens at the drives' end.
    pub fn among_drives<T: Send>(&self, open: impl FnOnce() -> T + Send) -> T {
        Cable::inside(&self.drives, open)
    }

    /// The same at the master's end.
    pub fn at_master<T: Send>(&self, open: impl FnOnce() -> T + Send) -> T {
        Cable::inside(&self.master, open)
    }

    /// A thread may live in another namespace, and its sockets stay there.
    fn inside<T: Send>(namespace: &str, open: impl FnOnce() -> T + Send) -> T {
        let namespace = std::fs::File::open(Path::new("/run/netns").join(namespace)).unwrap();
        std::thread::scope(|scope| {
            let inside = scope.spawn(|| {
                nix::sched::setns(namespace, nix::sched::CloneFlags::CLONE_NEWNET).unwrap();
                open()
            });
            inside.join().unwrap()
        })
    }

    /// `child` inside one of the namespaces.
    pub fn enter(namespace: &str, child: &Command) -> Command {
        let mut command = Cable::command(namespace, &child.get_program().to_string_lossy());
        command.args(child.get_args());
        command.envs(child.get_envs().filter_map(|(key, value)| Some((key, value?))));
        command
    }

    /// `program` inside one of the namespaces.
    pub fn command(namespace: &str, program: &str) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", namespace, program]);
        command
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        for name in [&self.master, &self.drives] {
            let _ = Command::new("ip").args(["netns", "delete", name]).stderr(Stdio::null()).status();
        }
    }
}

/// `ip WORDS`.
fn ip(words: &str) {
    command(&[&["ip"], &words.split(' ').collect::<Vec<_>>()[..]].concat());
}

/// Runs a tool that has to succeed.
pub fn command(words: &[&str]) {
    let output = Command::new(words[0]).args(&words[1..]).output();
    let output = output.unwrap_or_else(|error| panic!("{} is missing: {error}", words[0]));
    assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
}
