//! The facts of this host: files below a root directory, so that a test can use one of its own, and the few things that
//! are not in files. Reads only.

use std::ffi::CString;
use std::fs;
use std::io;
use std::net::Ipv4Addr;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::ifaddrs::{InterfaceAddress, getifaddrs};

use super::Subject;
use super::ethtool::Nic;
use super::tty::{self, Untried};
use super::way::Port;
use fieldbeat_core::net::local;
use fieldbeat_core::net::tty::Tried;
use fieldbeat_core::rt::host::cores_of;
use fieldbeat_core::rt::{Denied, Memory, MonotonicClock, RealtimeError, Regions, confine, memory, thread};

/// All that the checks look at.
#[derive(Debug)]
pub(super) struct Facts {
    /// `/proc`, `/sys` and `/dev`.
    pub root: Root,
    /// The facts that are no file.
    pub probes: Probes,
}

impl Facts {
    /// Those of this host.
    pub fn of_this_host(subject: &Subject) -> Facts {
        let root = Root(PathBuf::from("/"));
        Facts { probes: Probes::try_out(&root, subject), root }
    }
}

/// The directory that paths like `proc/version` start from.
#[derive(Debug)]
pub(super) struct Root(pub PathBuf);

impl Root {
    /// A file's text without surrounding white space.
    pub fn text(&self, path: &str) -> io::Result<String> {
        fs::read_to_string(self.0.join(path)).map(|text| text.trim().to_owned())
    }

    /// The same, where it does not matter why there is none.
    pub fn get(&self, path: &str) -> Option<String> {
        self.text(path).ok()
    }

    /// The first four bytes of a file as an integer of this machine.
    pub fn word(&self, path: &str) -> io::Result<i32> {
        let mut bytes = [0; 4];
        io::Read::read_exact(&mut fs::File::open(self.0.join(path))?, &mut bytes)?;
        Ok(i32::from_ne_bytes(bytes))
    }

    /// A file that holds a list of cores.
    pub fn cores(&self, path: &str) -> Option<Vec<usize>> {
        cores_of(&self.get(path)?)
    }

    /// The names in a directory, numbers in their order; none if there is no such directory.
    pub fn names(&self, path: &str) -> Vec<String> {
        let entries = fs::read_dir(self.0.join(path)).into_iter().flatten().flatten();
        let mut names: Vec<String> =
            entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
        names.sort_by_key(|name| (name.parse::<u64>().ok(), name.clone()));
        names
    }

    /// The directory that a link leads to, by its last name.
    pub fn link(&self, path: &str) -> Option<String> {
        Some(fs::read_link(self.0.join(path)).ok()?.file_name()?.to_str()?.to_owned())
    }

    pub fn has(&self, path: &str) -> bool {
        self.0.join(path).exists()
    }

    /// The value of a parameter of the kernel command line; the last one counts.
    pub fn boot(&self, parameter: &str) -> Option<String> {
        let line = self.get("proc/cmdline")?;
        let mut words = line.split_whitespace().filter_map(|word| word.split_once('='));
        words.rfind(|(key, _)| *key == parameter).map(|(_, value)| value.to_owned())
    }

    /// Whether this user sees all processes, the kernel's own too: not in a container, nor where /proc hides them.
    pub fn shows_everybody(&self) -> bool {
        self.get("proc/2/stat").is_some_and(|stat| stat.contains("(kthreadd)"))
    }

    /// Threads with a real-time policy, and those of interrupts whatever their policy.
    pub fn threads(&self) -> Vec<Thread> {
        let processes = self.names("proc").into_iter().filter_map(|name| name.parse::<u32>().ok());
        let of = |pid: u32| {
            let tasks = self.names(&format!("proc/{pid}/task")).into_iter();
            tasks.filter_map(move |tid| Some((pid, tid.parse::<u32>().ok()?)))
        };
        let read = |(pid, tid): (u32, u32)| {
            let task = format!("proc/{pid}/task/{tid}");
            let thread = Thread::of(tid, &self.get(&format!("{task}/stat"))?)?;
            if !thread.is_real_time() && thread.interrupt().is_none() {
                return None;
            }
            let status = self.get(&format!("{task}/status"))?;
            let allowed = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"));
            Some(Thread { cores: cores_of(allowed?.trim())?, ..thread })
        };
        processes.flat_map(of).filter_map(read).collect()
    }
}

/// A thread, as /proc/PID/task/TID/stat has it (proc_pid_stat(5)).
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Thread {
    pub tid: u32,
    /// At most 15 letters.
    pub name: String,
    /// One of the kernel's own (PF_KTHREAD).
    pub kernel: bool,
    /// The number of its scheduling policy (sched.h).
    pub policy: i32,
    /// 1 ... 99 under SCHED_FIFO and SCHED_RR.
    pub priority: u8,
    /// Where it may run.
    pub cores: Vec<usize>,
}

impl Thread {
    fn of(tid: u32, stat: &str) -> Option<Thread> {
        const PF_KTHREAD: u32 = 0x0020_0000;
        // The name may hold anything, closing brackets too.
        let (head, rest) = stat.rsplit_once(')')?;
        let name = head.split_once('(')?.1.to_owned();
        // The first one is field 3 of the manual.
        let field = |number: usize| rest.split_whitespace().nth(number - 3);
        let flags: u32 = field(9)?.parse().ok()?;
        let (priority, policy) = (field(40)?.parse().ok()?, field(41)?.parse().ok()?);
        Some(Thread { tid, name, kernel: flags & PF_KTHREAD != 0, policy, priority, cores: Vec::new() })
    }

    pub fn is_real_time(&self) -> bool {
        [libc::SCHED_FIFO, libc::SCHED_RR, libc::SCHED_DEADLINE].contains(&self.policy)
    }

    pub fn policy(&self) -> &'static str {
        if self.is_real_time() { thread::policy_name(self.policy) } else { "no real-time policy" }
    }

    /// The number of the interrupt that it handles (`irq/31-eth0`).
    pub fn interrupt(&self) -> Option<u32> {
        self.name.strip_prefix("irq/")?.split('-').next()?.parse().ok()
    }
}

/// Facts that are in no file and have to be tried.
#[derive(Debug)]
pub(super) struct Probes {
    /// A thread on the core of the loop.
    pub core: Result<(), RealtimeError>,
    /// A thread at the loop's priority.
    pub fifo: Result<(), Denied>,
    /// The memory lock of the plan.
    pub memory: Result<(), Denied>,
    /// One read of the clock, ns.
    pub clock_read_ns: f64,
    /// The addresses of this computer, with their interfaces.
    pub addresses: Vec<(Ipv4Addr, String)>,
    /// Settings of the interfaces that the buses use, by name.
    pub nics: Vec<(String, Nic)>,
    /// The settings of the serial ports as their drivers have them, by path.
    pub ports: Vec<(String, Result<Tried, Untried>)>,
    /// The file of this program.
    pub program: Program,
    /// Whether a thread can give up system calls.
    pub filters: io::Result<()>,
}

/// Who gets which rights by the file of a program.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Program {
    /// It has capabilities (setcap(8)).
    pub is_capable: bool,
    /// Every user may execute it.
    pub is_for_all: bool,
}

impl Program {
    /// Of the file at `path`.
    pub fn of(path: &Path) -> Program {
        let mode = |path: &Path| fs::metadata(path).map_or(0, |about| about.mode());
        let is_for_all = path.ancestors().all(|part| mode(part) & 0o001 != 0);
        let name = CString::new(path.as_os_str().as_bytes()).unwrap_or_default();
        let attribute = c"security.capability".as_ptr();
        // SAFETY: two strings; nothing is written into a room of no bytes, only the length is returned.
        let length = unsafe { libc::getxattr(name.as_ptr(), attribute, std::ptr::null_mut(), 0) };
        Program { is_capable: length > 0, is_for_all }
    }
}

impl Probes {
    fn try_out(root: &Root, subject: &Subject) -> Probes {
        let (core, priority) = (subject.core, subject.cycle.priority);
        let addresses = addresses();
        let used = |(ip, _): &&(Ipv4Addr, String)| subject.wires.iter().any(|wire| wire.local.ip() == ip);
        let of_lines = subject.lines.iter().map(|line| line.interface.clone());
        let mut names: Vec<String> = addresses.iter().filter(used).map(|(_, name)| name.clone()).collect();
        names.dedup();
        names.extend(of_lines);
        let try_port = |port: &Port| (port.path.clone(), tty::try_out(root, &port.path, &port.line));
        let real = subject.ports.iter().filter(|port| local::name(&port.path).is_none());
        Probes {
            core: on_a_thread(move || thread::pin(core)),
            fifo: on_a_thread(move || thread::fifo(priority)),
            memory: try_memory(subject.cycle.memory),
            clock_read_ns: clock_read_ns(),
            ports: real.map(try_port).collect(),
            nics: names.into_iter().map(|name| (name.clone(), Nic::ask(&name))).collect(),
            addresses,
            program: std::env::current_exe().map_or(Program::default(), |path| Program::of(&path)),
            filters: confine::can_filter(),
        }
    }

    /// The settings of the interface `name`, if a bus uses it.
    pub fn nic(&self, name: &str) -> Option<&Nic> {
        self.nics.iter().find(|(known, _)| known == name).map(|(_, nic)| nic)
    }

    /// The settings of port `path` as its driver has them, if a bus uses it.
    pub fn port(&self, path: &str) -> Option<&Result<Tried, Untried>> {
        self.ports.iter().find(|(known, _)| known == path).map(|(_, tried)| tried)
    }

    /// The interface that has `address`.
    pub fn interface(&self, address: Ipv4Addr) -> Option<&str> {
        self.addresses.iter().find(|(own, _)| *own == address).map(|(_, name)| name.as_str())
    }
}

/// Runs `body` on a thread of its own: policy and core end with it.
pub(super) fn on_a_thread<T: Send>(body: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| scope.spawn(body).join())
        .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// Locks what the plan would lock, and lets it go again.
fn try_memory(memory: Memory) -> Result<(), Denied> {
    match memory {
        Memory::Process => memory::lock_process(),
        // What every loop locks in addition to its own structures: its stack, the program and its libraries.
        Memory::Own => on_a_thread(|| Regions::new().lock()),
    }?;
    memory::unlock_process();
    Ok(())
}

/// Reads of the clock in one go, and how often.
const READS: u32 = 1_000;
const READ_ROUNDS: u32 = 20;

/// One read of the clock: the fastest of some rounds, as whatever disturbs only makes them slower.
fn clock_read_ns() -> f64 {
    let round = |_| {
        let begin = MonotonicClock::read();
        (0..READS).for_each(|_| {
            std::hint::black_box(MonotonicClock::read());
        });
        MonotonicClock::read().since(begin) as f64 / f64::from(READS)
    };
    (0..READ_ROUNDS).map(round).fold(f64::INFINITY, f64::min)
}

fn addresses() -> Vec<(Ipv4Addr, String)> {
    // An address may have a label, `eth0:1`.
    let name = |label: &str| label.split(':').next().unwrap_or(label).to_owned();
    let address = |of: InterfaceAddress| Some((of.address?.as_sockaddr_in()?.ip(), name(&of.interface_name)));
    let mut addresses: Vec<_> = getifaddrs().into_iter().flatten().filter_map(address).collect();
    addresses.sort_by(|a, b| a.1.cmp(&b.1));
    addresses
}

/// The path as a user knows it.
pub(super) fn shown(path: &str) -> String {
    Path::new("/").join(path).display().to_string()
}

#[cfg(test)]
pub(super) mod testing {
    use super::*;
    use fieldbeat_core::cycle::CyclePlan;
    use std::sync::atomic::{AtomicU32, Ordering};

    /// A made-up host: files in a directory of its own, which goes with it, and probes that all went well.
    #[derive(Debug)]
    pub struct Host(pub Facts);

    impl Host {
        pub fn new(files: &[(&str, &str)]) -> Host {
            static COUNT: AtomicU32 = AtomicU32::new(0);
            let number = COUNT.fetch_add(1, Ordering::Relaxed);
            let name = format!("fieldbeat-doctor-{}-{number}", std::process::id());
            let directory = std::env::temp_dir().join(name);
            fs::create_dir_all(&directory).unwrap();
            let probes = Probes {
                core: Ok(()),
                fifo: Ok(()),
                memory: Ok(()),
                clock_read_ns: 25.0,
                addresses: vec![
                    (Ipv4Addr::LOCALHOST, "lo".into()),
                    (Ipv4Addr::new(192, 168, 1, 1), "eth0".into()),
                ],
                nics: Vec::new(),
                ports: Vec::new(),
                program: Program::default(),
                filters: Ok(()),
            };
            let host = Host(Facts { root: Root(directory), probes });
            host.with(files)
        }

        /// More files, or others in their place.
        pub fn with(self, files: &[(&str, &str)]) -> Host {
            for (path, text) in files {
                let path = self.0.root.0.join(path);
                fs::create_dir_all(path.parent().unwrap()).unwrap();
                fs::write(path, text).unwrap();
            }
            self
        }

        /// A link.
        pub fn linked(self, path: &str, to: &str) -> Host {
            let root = &self.0.root.0;
            fs::create_dir_all(root.join(path).parent().unwrap()).unwrap();
            std::os::unix::fs::symlink(root.join(to), root.join(path)).unwrap();
            self
        }

        /// One thread more, one of the kernel's own if `kernel`.
        pub fn thread(
            self,
            tid: u32,
            name: &str,
            kernel: bool,
            policy: i32,
            priority: u8,
            cores: &str,
        ) -> Host {
            let flags = if kernel { 0x0020_8040 } else { 0x0040_0000 };
            let stat = format!(
                "{tid} ({name}) S 2 0 0 0 -1 {flags} 0 0 0 0 0 0 0 0 -51 0 1 0 80 0 0 0 0 0 0 0 0 0 0 0 0 0 \
                 0 0 0 1 {priority} {policy} 0 0 0"
            );
            let task = format!("proc/{tid}/task/{tid}");
            let status = format!("Name:\t{name}\nCpus_allowed:\t3\nCpus_allowed_list:\t{cores}\n");
            self.with(&[(&format!("{task}/stat"), &stat), (&format!("{task}/status"), &status)])
        }
    }

    impl Drop for Host {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0.root.0);
        }
    }

    /// The file by which a process sees that it sees all others.
    pub const KTHREADD: (&str, &str) = ("proc/2/stat", "2 (kthreadd) S 0 0 0");

    /// The default plan on core 3.
    pub fn subject() -> Subject {
        let cycle = CyclePlan { core: Some(3), ..CyclePlan::default() };
        Subject { core: 3, ..Subject::cycle(cycle) }
    }
}

#[cfg(test)]
mod tests {
    use super::testing::Host;

    #[test]
    fn reads_threads_whatever_their_names() {
        let host = Host::new(&[])
            .thread(7, "a) b (c", false, libc::SCHED_RR, 42, "0-1")
            .thread(8, "irq/31-eth0", true, libc::SCHED_OTHER, 0, "2")
            .thread(9, "sh", false, libc::SCHED_OTHER, 0, "0-3");
        let threads = host.0.root.threads();
        let [first, second] = threads.as_slice() else { panic!("{threads:?}") };
        assert_eq!((first.tid, first.name.as_str(), first.kernel), (7, "a) b (c", false));
        assert_eq!((first.policy(), first.priority, &first.cores[..]), ("SCHED_RR", 42, &[0, 1][..]));
        assert_eq!((second.interrupt(), second.kernel, &second.cores[..]), (Some(31), true, &[2][..]));
    }

    #[test]
    fn the_last_word_of_the_command_line_counts() {
        let host = Host::new(&[("proc/cmdline", "quiet preempt=none rcu_nocbs=2 preempt=full\n")]);
        assert_eq!(host.0.root.boot("preempt").as_deref(), Some("full"));
        assert_eq!(host.0.root.boot("quiet"), None);
    }
}
