//! What the loop's thread does to itself before its first cycle: a core, SCHED_FIFO, locked and present memory; and how
//! the other threads get out of its way.
//!
//! A thread of simulated drives takes of it what it needs. Knows nothing of cycles. All of it happens once, on the
//! thread that it is about, and may allocate and read files.

use std::ffi::c_int;
use std::io;

use core_affinity::CoreId;
use nix::sched::{CpuSet, sched_setaffinity};
use nix::sys::signal::{SigSet, Signal};
use nix::unistd::Pid;

use super::confine::{Keep, give_up_rights};
use super::memory::{self, Regions};
use super::rights::{Capability, Denied, holds, rtprio_limit};
use super::{Memory, Realtime};

/// The plan of the loop's thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RealtimePlan {
    /// Whether real-time scheduling is required.
    pub realtime: Realtime,
    /// Which memory is locked.
    pub memory: Memory,
    /// SCHED_FIFO priority, 1 ... 99. Above 50 it precedes the threads of interrupts on PREEMPT_RT, also that of its
    /// own network card; 99 is the kernel's own.
    pub priority: u8,
    /// The core; `None` = the [`default_core`].
    pub core: Option<usize>,
}

impl RealtimePlan {
    /// The core that [`enter`] will pin the loop's thread to, for threads that start before it: the same one if the
    /// calling thread may use the same cores.
    pub fn core_to_be(&self) -> Option<usize> {
        match self.realtime {
            Realtime::Off => self.core,
            _ => self.core.or_else(default_core),
        }
    }
}

/// The properties of the loop's thread, as the kernel reports them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Granted {
    /// The scheduling policy: `SCHED_FIFO`, or what the thread was started with, usually `SCHED_OTHER`.
    pub policy: &'static str,
    /// The priority, 0 for `SCHED_OTHER`.
    pub priority: u8,
    /// The core it is pinned to.
    pub core: Option<usize>,
    /// True if the memory that [`RealtimePlan::memory`] requests is locked.
    pub memory_locked: bool,
    /// The unavailable properties, one line each with its remedy. Not empty: the numbers are not real-time.
    pub missing: Vec<String>,
}

impl Granted {
    /// The priority, if it runs in real time.
    #[doc(hidden)]
    pub fn fifo(&self) -> Option<u8> {
        (self.policy == "SCHED_FIFO").then_some(self.priority)
    }
}

/// Why the loop's thread cannot become what the plan requests.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum RealtimeError {
    /// The core does not exist or is not available to this process.
    #[error(
        "core {core} is not one that this process may run on: set `core` to one of {allowed}, or leave it \
         out for the last one"
    )]
    Core {
        /// The requested core.
        core: usize,
        /// The available cores, as a list.
        allowed: String,
    },
    /// Not a priority of SCHED_FIFO.
    #[error("priority {0} is not one of SCHED_FIFO: set `priority` to 1 ... 99, usually 80")]
    Priority(u8),
    /// `Realtime::Require`, and a right is missing.
    #[error("{0}, or set realtime = \"prefer\" for numbers that are not real-time")]
    Denied(#[from] Denied),
}
crate::debug_as_display!(RealtimeError);

/// Turns the calling thread into the loop's: pinned, SCHED_FIFO, memory locked and the stack present, in that order, so
/// that memory is made present from the core that will use it, and a refused thread leaves nothing locked behind. Then
/// it gives up its rights.
///
/// `own` is what [`Memory::Own`] locks; [`Memory::Process`] does not use it. [`Realtime::Off`] does no more than
/// pin the thread to a core that was named by number.
///
/// Children and new threads do not inherit SCHED_FIFO (SCHED_RESET_ON_FORK, sched(7)); new threads do inherit the core,
/// see [`helper_thread`].
///
/// # Errors
///
/// A core or priority that does not exist, in every mode that uses it; a missing right with [`Realtime::Require`] only.
pub fn enter(plan: &RealtimePlan, own: &Regions) -> Result<Granted, RealtimeError> {
    if plan.realtime != Realtime::Off && !(1..=99).contains(&plan.priority) {
        return Err(RealtimeError::Priority(plan.priority));
    }
    deaf();
    let core = plan.core_to_be();
    if let Some(core) = core {
        pin(core)?;
    }
    let mut missing = Vec::new();
    let mut memory_locked = false;
    if plan.realtime != Realtime::Off {
        let mut settle = |result: Result<(), Denied>| match result {
            Ok(()) => Ok(true),
            Err(denied) if plan.realtime == Realtime::Require => Err(denied),
            Err(denied) => {
                missing.push(denied.to_string());
                Ok(false)
            }
        };
        if !settle(fifo(plan.priority))? {
            second_best();
        }
        // Present first, and then locked: the pages of a main thread's stack exist only once touched.
        memory::prefault_stack();
        memory_locked = settle(match plan.memory {
            Memory::Process => memory::lock_process(),
            Memory::Own => own.lock(),
        })?;
    }
    let (policy, priority) = scheduling();
    give_up_rights(Keep::Nothing);
    Ok(Granted { policy, priority, core, memory_locked, missing })
}

/// Leaves all signals to the other threads: a handler would interrupt the loop's sleep and run in its time. Signals
/// that report a fault of the thread itself cannot be blocked.
fn deaf() {
    let mut signals = SigSet::all();
    for own in
        [Signal::SIGSEGV, Signal::SIGBUS, Signal::SIGFPE, Signal::SIGILL, Signal::SIGTRAP, Signal::SIGSYS]
    {
        signals.remove(own);
    }
    // Fails only on an operation that does not exist.
    let _ = signals.thread_block();
}

/// Keeps the calling normal thread out of the loop's way, and takes its rights from it: it neither writes files of its
/// user nor opens what needs one.
///
/// To be called on threads started by a normal thread: one started by the pinned loop knows no other core.
pub fn helper_thread(core_of_loop: Option<usize>) {
    stand_aside(core_of_loop);
    give_up_rights(Keep::Nothing);
}

/// The same for a thread that opens files after the start.
pub fn file_thread(core_of_loop: Option<usize>) {
    stand_aside(core_of_loop);
    give_up_rights(Keep::Files);
}

/// Keeps the calling normal thread out of the loop's way: SCHED_OTHER, and every core that it may use but the loop's.
/// Where there is no other core, or none is known, it stays where it is. It keeps its rights, as a thread of the host
/// program has to.
pub fn stand_aside(core_of_loop: Option<usize>) {
    // Lowering oneself needs no right, so that this cannot fail.
    let _ = set_scheduler(libc::SCHED_OTHER, 0);
    // Refused if no core is left, and then the old ones stay.
    confine(cores().into_iter().filter(|core| Some(*core) != core_of_loop));
}

/// Lets the calling thread watch a loop on this core: off it, where there is another one, and before the loop
/// (SCHED_FIFO, one priority above) if that runs in real time with this priority. A watch before a loop that is an
/// ordinary thread would take the waits of that one for its end.
///
/// To be called on threads started by a normal thread, as [`helper_thread`].
pub fn watch_thread(core_of_loop: Option<usize>, priority_of_loop: Option<u8>) {
    stand_aside(core_of_loop);
    let above = |priority: u8| priority.saturating_add(1).min(99);
    if priority_of_loop.is_none_or(|loops| fifo(above(loops)).is_err() && fifo(loops).is_err()) {
        prompt();
    }
    give_up_rights(Keep::Nothing);
}

/// A core for work that must not disturb the loop but has its own deadlines, such as simulated drives: the first
/// one that the calling thread may use and that is not the loop's.
pub fn spare_core(core_of_loop: Option<usize>) -> Option<usize> {
    cores().into_iter().find(|core| Some(*core) != core_of_loop)
}

/// The core of a loop that names none: the last one that the calling thread may use. Interrupts and boot work gather on
/// the first ones. Cores of `isolcpus=` are never among them: those have to be named.
pub fn default_core() -> Option<usize> {
    cores().last().copied()
}

/// The cores that the calling thread may use, in order.
fn cores() -> Vec<usize> {
    core_affinity::get_core_ids().unwrap_or_default().into_iter().map(|core| core.id).collect()
}

/// Pins the calling thread to `core`: any that is online and in its control group's cpuset, whether or not the
/// thread may use it now. A core of `isolcpus=` is in no thread's set of cores at the start
/// (kernel-parameters.txt), and is exactly the one wanted.
pub fn pin(core: usize) -> Result<(), RealtimeError> {
    // A core beyond the size of the set would not be refused but panic.
    if core < CpuSet::count() && core_affinity::set_for_current(CoreId { id: core }) {
        return Ok(());
    }
    Err(no_core(core, &permitted_cores()))
}

/// Whether [`pin`] would accept `core`.
///
/// # Errors
///
/// It would not.
pub fn may_use(core: usize) -> Result<(), RealtimeError> {
    let permitted = permitted_cores();
    if permitted.contains(&core) { Ok(()) } else { Err(no_core(core, &permitted)) }
}

fn no_core(core: usize, permitted: &[usize]) -> RealtimeError {
    let allowed = permitted.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
    RealtimeError::Core { core, allowed }
}

/// The cores that [`pin`] accepts: the kernel reduces a request for all of them to what it grants
/// (sched_setaffinity(2)).
pub fn permitted_cores() -> Vec<usize> {
    let now = cores();
    confine(0..CpuSet::count());
    let permitted = cores();
    confine(now.into_iter());
    permitted
}

/// Lets the calling thread use `cores` only. The kernel leaves out those that do not exist, and refuses, without a
/// change, a set of which nothing remains.
fn confine(cores: impl Iterator<Item = usize>) {
    let mut set = CpuSet::new();
    for core in cores {
        // A core beyond the size of the set cannot be named, nor did the kernel name it.
        let _ = set.set(core);
    }
    let _ = sched_setaffinity(Pid::from_raw(0), &set);
}

/// SCHED_FIFO for the calling thread, but for none that it starts.
pub fn fifo(priority: u8) -> Result<(), Denied> {
    set_scheduler(libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, priority).map_err(|error| {
        match error.raw_os_error() {
            Some(libc::EPERM) if holds(Capability::SysNice) => Denied::FifoGroup { priority },
            Some(libc::EPERM) => Denied::Fifo { priority, limit: rtprio_limit() },
            _ => Denied::Call { call: "sched_setscheduler", error },
        }
    })
}

/// The best without the right to the requested priority: SCHED_FIFO at the highest one allowed, otherwise a prompt
/// thread.
fn second_best() {
    // The limit may hold any number; a useless one is refused like none at all.
    let limit = u8::try_from(rtprio_limit()).unwrap_or(0);
    if limit == 0 || fifo(limit).is_err() {
        prompt();
    }
}

/// Lets the calling thread, one without SCHED_FIFO, run when it should: its sleeps end exactly, where a normal thread's
/// may end 50 us late to save wake-ups (PR_SET_TIMERSLACK, prctl(2)), and it requests a short slice.
pub fn prompt() {
    // Cannot fail: every slack above 0 is accepted.
    let _ = nix::sys::prctl::set_timerslack(1);
    // Without it the thread only waits longer.
    let _ = short_slice();
}

/// The shortest slice that a normal thread may request (sched_setattr(2), `sched_runtime`; Linux 6.12).
const SLICE_NS: u64 = 100_000;

/// Requests a short slice: the scheduler lets a thread that wakes with one run before threads that compute, whose
/// slices are some milliseconds. It takes nothing from their share, and needs no right. Kernels before 6.12 ignore it.
fn short_slice() -> io::Result<()> {
    const SIZE: u32 = size_of::<libc::sched_attr>() as u32;
    // SAFETY: all bytes zero are a valid value of this structure of integers.
    let mut attributes: libc::sched_attr = unsafe { std::mem::zeroed() };
    // SAFETY: 0 is the calling thread, and the kernel writes at most SIZE bytes behind the pointer.
    if unsafe { libc::syscall(libc::SYS_sched_getattr, 0, &raw mut attributes, SIZE, 0) } != 0 {
        return Err(io::Error::last_os_error());
    }
    if attributes.sched_policy != libc::SCHED_OTHER as u32 {
        return Ok(());
    }
    (attributes.size, attributes.sched_runtime) = (SIZE, SLICE_NS);
    // SAFETY: 0 is the calling thread, and the kernel reads SIZE bytes behind the pointer.
    match unsafe { libc::syscall(libc::SYS_sched_setattr, 0, &raw const attributes, 0) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// sched_setscheduler(2) on the calling thread. The bare system call, since musl's wrapper refuses always: POSIX wants
/// it to act on a process, Linux on a thread.
fn set_scheduler(policy: c_int, priority: u8) -> io::Result<()> {
    // The kernel's `struct sched_param` is this one int.
    let priority = c_int::from(priority);
    // SAFETY: 0 is the calling thread, and the kernel reads one int behind the pointer.
    match unsafe { libc::syscall(libc::SYS_sched_setscheduler, 0, policy, &raw const priority) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Policy and priority of the calling thread as the kernel has them.
fn scheduling() -> (&'static str, u8) {
    let mut priority: c_int = 0;
    // SAFETY: 0 is the calling thread, which exists; the kernel writes one int behind the pointer.
    let policy = unsafe {
        libc::syscall(libc::SYS_sched_getparam, 0, &raw mut priority);
        libc::syscall(libc::SYS_sched_getscheduler, 0)
    };
    let policy = policy_name(policy as c_int & !libc::SCHED_RESET_ON_FORK);
    (policy, u8::try_from(priority).unwrap_or(0))
}

/// The name of a scheduling policy (sched.h).
pub fn policy_name(policy: c_int) -> &'static str {
    match policy {
        libc::SCHED_FIFO => "SCHED_FIFO",
        libc::SCHED_RR => "SCHED_RR",
        libc::SCHED_BATCH => "SCHED_BATCH",
        libc::SCHED_IDLE => "SCHED_IDLE",
        libc::SCHED_DEADLINE => "SCHED_DEADLINE",
        _ => "SCHED_OTHER",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rt::Usage;
    use crate::rt::testing::{become_ordinary, in_own_process, limit_memlock, limit_rtprio, locked_kib};

    fn plan(realtime: Realtime) -> RealtimePlan {
        RealtimePlan { realtime, memory: Memory::Process, priority: 80, core: None }
    }

    /// Runs `body` on a thread of its own: affinity and policy end with it.
    fn on_a_thread<T: Send + 'static>(body: impl FnOnce() -> T + Send + 'static) -> T {
        std::thread::spawn(body).join().unwrap()
    }

    #[test]
    fn off_touches_nothing_but_pins_to_a_core_that_was_named() {
        on_a_thread(|| {
            let before = cores();
            let granted = enter(&plan(Realtime::Off), &Regions::new()).unwrap();
            assert_eq!((granted.core, granted.memory_locked), (None, false));
            assert!(granted.missing.is_empty());
            assert_eq!(cores(), before);
            let named = RealtimePlan { core: Some(before[0]), ..plan(Realtime::Off) };
            assert_eq!(enter(&named, &Regions::new()).unwrap().core, Some(before[0]));
            assert_eq!(cores(), before[..1]);
        });
    }

    #[test]
    fn a_core_that_is_not_there_is_refused_by_every_mode_and_so_is_a_priority_that_is_none() {
        for priority in [0, 100] {
            let plan = RealtimePlan { priority, ..plan(Realtime::Prefer) };
            let refused = enter(&plan, &Regions::new());
            assert!(matches!(refused, Err(RealtimeError::Priority(p)) if p == priority));
        }
        for realtime in [Realtime::Off, Realtime::Prefer, Realtime::Require] {
            // Within the set of the kernel's interface, and beyond it.
            for core in [CpuSet::count() - 1, 5_000] {
                on_a_thread(move || {
                    let before = cores();
                    let plan = RealtimePlan { core: Some(core), ..plan(realtime) };
                    let text = enter(&plan, &Regions::new()).unwrap_err().to_string();
                    let one = before[0].to_string();
                    assert!(text.starts_with(&format!("core {core} ")) && text.contains(&one), "{text}");
                    assert_eq!(cores(), before);
                });
            }
        }
    }

    #[test]
    fn an_ordinary_user_is_refused_or_shown_what_is_missing() {
        in_own_process("rt::thread::tests::an_ordinary_user_is_refused_or_shown_what_is_missing", || {
            assert!(limit_rtprio(0) && limit_memlock(64 << 10));
            become_ordinary();
            let refused = on_a_thread(|| enter(&plan(Realtime::Require), &Regions::new()));
            let (text, program) = (refused.unwrap_err().to_string(), std::env::current_exe().unwrap());
            let remedy = ["RLIMIT_RTPRIO is 0", "setcap cap_sys_nice,cap_ipc_lock+ep", "\"prefer\""];
            for part in remedy.into_iter().chain([&*program.to_string_lossy()]) {
                assert!(text.contains(part), "no {part}: {text}");
            }
            assert_eq!(locked_kib(), 0);
            let to_be = plan(Realtime::Prefer).core_to_be();
            let granted = enter(&plan(Realtime::Prefer), &Regions::new()).unwrap();
            assert_eq!((granted.policy, granted.priority, granted.memory_locked), ("SCHED_OTHER", 0, false));
            assert_eq!(cores(), [granted.core.unwrap()]);
            assert_eq!(granted.core, to_be);
            let [priority, memory] = &granted.missing[..] else { panic!("{:?}", granted.missing) };
            assert!(priority.contains("SCHED_FIFO 80 (RLIMIT_RTPRIO is 0)"), "{priority}");
            assert!(memory.contains("RLIMIT_MEMLOCK is 64 KiB"), "{memory}");
            // PR_GET_TIMERSLACK returns the slack as its result.
            assert_eq!(nix::sys::prctl::get_timerslack(), Ok(1));
        });
    }

    #[test]
    #[ignore = "needs root: SCHED_FIFO"]
    fn root_gets_all_of_it_and_the_loop_does_not_fault() {
        in_own_process("rt::thread::tests::root_gets_all_of_it_and_the_loop_does_not_fault", || {
            memory::prepare_heap();
            on_a_thread(|| {
                let mut regions = Regions::new();
                let (mut producer, mut consumer) = memory::ring::<[u64; 16]>(1 << 12, &mut regions);
                let granted = enter(&plan(Realtime::Require), &regions).unwrap();
                assert_eq!((granted.policy, granted.priority), ("SCHED_FIFO", 80));
                assert!(granted.memory_locked && granted.missing.is_empty());
                assert!(locked_kib() > 1_000);
                // Threads that it starts are ordinary again.
                assert_eq!(on_a_thread(scheduling), ("SCHED_OTHER", 0));
                let before = Usage::of_thread();
                for round in 0..1_000_u64 {
                    while producer.push([round; 16]).is_ok() {}
                    while consumer.pop().is_ok() {}
                }
                assert_eq!(Usage::of_thread().since(before).page_faults(), 0);
                helper_thread(None);
                assert_eq!(scheduling(), ("SCHED_OTHER", 0));
            });
        });
    }

    #[test]
    #[ignore = "needs root: SCHED_FIFO"]
    fn root_locks_only_what_is_its_own() {
        in_own_process("rt::thread::tests::root_locks_only_what_is_its_own", || {
            let host = vec![1_u8; 256 << 20];
            on_a_thread(|| {
                let plan = RealtimePlan { memory: Memory::Own, ..plan(Realtime::Require) };
                assert!(enter(&plan, &Regions::new()).unwrap().memory_locked);
            });
            let locked = locked_kib();
            assert!(locked > 1_000 && locked < 128 << 10, "{locked} KiB");
            drop(host);
        });
    }

    #[test]
    #[ignore = "needs root: raises RLIMIT_RTPRIO before it becomes an ordinary user"]
    fn a_lower_limit_gives_a_lower_priority() {
        in_own_process("rt::thread::tests::a_lower_limit_gives_a_lower_priority", || {
            if !limit_rtprio(20) {
                return println!("skipped: no CAP_SYS_RESOURCE to raise a limit with");
            }
            become_ordinary();
            on_a_thread(|| {
                let granted = enter(&plan(Realtime::Prefer), &Regions::new()).unwrap();
                assert_eq!((granted.policy, granted.priority), ("SCHED_FIFO", 20));
                assert!(granted.missing[0].contains("RLIMIT_RTPRIO is 20"), "{:?}", granted.missing);
            });
        });
    }
}
