//! What the loop asks of the kernel: a filter on its thread kills the process at any system call that is not listed
//! here, and at one that could wait where it must not. What it asks of the allocator, over the same cycles: nothing.
//!
//! Needs no privilege: whoever has given up the right to gain any (PR_SET_NO_NEW_PRIVS) may filter itself. Since the
//! process dies, it is a child.
#![cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]

mod support;

use std::mem::offset_of;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use fieldbeat::axis::{Axis, Link};
use fieldbeat::bus::Cycle;
use fieldbeat::cycle::engine::{Control, Engine, Flow};
use fieldbeat::cycle::status::{Gauges, Numbers};
use fieldbeat::cycle::task::{Axes, Task};
use fieldbeat::master::{Assembly, assemble};
use fieldbeat::net::Os;
use fieldbeat::rt::MonotonicClock;
use fieldbeat::sim::server::ServerOptions;
use fieldbeat::telemetry::{Measured, Recorder};
use libc::{c_int, c_long, sock_filter};
use support::adventures::{Adventures, VICTIM, drives_and_errors};
use support::counting::{Counting, count, watch};
use support::{Ended, LONG, Machine, Program, again, plan, role, until};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// A call that the loop may make.
struct Allowed {
    call: c_long,
    /// An argument, by its place, and a bit that it must have.
    with: Option<(usize, c_int)>,
}

/// All that the loop may ask of the kernel.
const ALLOWED: [Allowed; 8] = [
    // The sleep until the next grid point, and the nap for the rest of the replies: absolute, so that nothing drifts.
    Allowed { call: libc::SYS_clock_nanosleep, with: Some((1, libc::TIMER_ABSTIME)) },
    // The wait for the first reply, until the deadline at the latest: in nanoseconds, unlike the time-out of a socket.
    Allowed { call: libc::SYS_ppoll, with: None },
    // All requests of a bus; one that does not fit fails at once.
    Allowed { call: libc::SYS_sendmmsg, with: Some((3, libc::MSG_DONTWAIT)) },
    // One request of a bus with `send = "each"`, on a socket that never waits (O_NONBLOCK).
    Allowed { call: libc::SYS_sendto, with: None },
    // All replies that are there; none is no reason to wait.
    Allowed { call: libc::SYS_recvmmsg, with: Some((3, libc::MSG_DONTWAIT)) },
    // After a late cycle, once: what the kernel has counted against this thread.
    Allowed { call: libc::SYS_getrusage, with: None },
    // The clock is read in user space (vdso(7)), but for a machine whose clock source the vDSO cannot read (Xen, some
    // virtual machines without a stable TSC).
    Allowed { call: libc::SYS_clock_gettime, with: None },
    // Not the loop's: how a thread leaves that must not do anything else.
    Allowed { call: libc::SYS_exit, with: None },
];

#[cfg(target_arch = "x86_64")]
const MACHINE: u32 = libc::EM_X86_64 as u32;
#[cfg(target_arch = "aarch64")]
const MACHINE: u32 = libc::EM_AARCH64 as u32;

/// AUDIT_ARCH_*: the machine, 64 bits, little-endian (linux/audit.h). Numbers of calls mean nothing without it; those
/// of the x32 ABI, which has the same, have a bit more and match none.
const ARCH: u32 = MACHINE | 1 << 31 | 1 << 30;

/// The filter as the kernel runs it at every call (seccomp(2)): it loads words of `seccomp_data` and compares.
fn filter() -> Vec<sock_filter> {
    let kill = || instruction(libc::BPF_RET | libc::BPF_K, libc::SECCOMP_RET_KILL_PROCESS, 0, 0);
    let allow = || instruction(libc::BPF_RET | libc::BPF_K, libc::SECCOMP_RET_ALLOW, 0, 0);
    let load = |at: usize| instruction(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, at as u32, 0, 0);
    let jump = |test, value, yes, no| instruction(libc::BPF_JMP | test | libc::BPF_K, value, yes, no);

    let mut program =
        vec![load(offset_of!(libc::seccomp_data, arch)), jump(libc::BPF_JEQ, ARCH, 1, 0), kill()];
    program.push(load(offset_of!(libc::seccomp_data, nr)));
    for Allowed { call, with } in ALLOWED {
        match with {
            None => program.extend([jump(libc::BPF_JEQ, call as u32, 0, 1), allow()]),
            // The half of the argument that comes first is the low one on both machines.
            Some((place, bit)) => program.extend([
                jump(libc::BPF_JEQ, call as u32, 0, 4),
                load(offset_of!(libc::seccomp_data, args) + 8 * place),
                jump(libc::BPF_JSET, bit as u32, 0, 1),
                allow(),
                kill(),
            ]),
        }
    }
    program.push(kill());
    program
}

/// `yes` and `no`: so many instructions are skipped.
fn instruction(code: u32, k: u32, yes: u8, no: u8) -> sock_filter {
    sock_filter { code: code as u16, jt: yes, jf: no, k }
}

/// Puts the calling thread under the filter, for good.
fn confine() {
    let mut program = filter();
    let program = libc::sock_fprog { len: program.len() as u16, filter: program.as_mut_ptr() };
    // SAFETY: prctl takes numbers; seccomp reads `len` instructions behind the pointer, which outlive the call. Without
    // a flag it is about this thread only.
    let refused = unsafe {
        libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0
            || libc::syscall(libc::SYS_seccomp, libc::SECCOMP_SET_MODE_FILTER, 0, &raw const program) != 0
    };
    assert!(!refused, "no seccomp: {}", std::io::Error::last_os_error());
}

/// A loop that runs under the filter, on a thread of its own.
struct Confined {
    /// Locked by that thread until the loop has ended.
    engine: Arc<Mutex<Option<Engine<MonotonicClock>>>>,
    control: Control,
    gauges: Gauges,
    _recorder: Recorder,
}

impl Confined {
    fn start(config: &Path, task: Task) -> (Confined, Vec<Axis>) {
        let (plan, control) = (plan(config), Control::default());
        let Assembly { engine, axes, gauges, records, .. } =
            assemble(&plan, MonotonicClock, &Os, Some(task), control.clone()).unwrap();
        let measured = Measured::new(axes.len(), &plan.cycle, true);
        let recorder = Recorder::start(records, measured, None, None, || {}).unwrap();
        let engine = Arc::new(Mutex::new(Some(engine)));
        let of_thread = Arc::clone(&engine);
        // Not to be waited for: it leaves without telling its handle.
        drop(std::thread::spawn(move || {
            let mut engine = of_thread.lock().unwrap();
            let of_loop = engine.as_mut().unwrap();
            confine();
            watch(true);
            of_loop.begin();
            while of_loop.step() == Flow::Continue {}
            watch(false);
            // Nobody sleeps at this lock, so that giving it back takes no call.
            drop(engine);
            // SAFETY: ends this thread only, and what stands on its stack is needed by nobody and never freed.
            unsafe { libc::syscall(libc::SYS_exit, 0) };
        }));
        (Confined { engine, control, gauges, _recorder: recorder }, axes)
    }

    fn executed(&self) -> u64 {
        self.gauges.status.read().executed
    }

    /// Waits for the end of the loop.
    fn end(self) -> Numbers {
        let mut end = None;
        assert!(until(LONG, || {
            end = self.engine.try_lock().ok().and_then(|mut engine| engine.take());
            end.is_some()
        }));
        end.map(Engine::finish).unwrap()
    }
}

/// The cycles that the loop has to execute.
const CYCLES: u64 = 100_000;

/// What the child says in the end, before the number of executed cycles.
const LIVED: &str = "lived under the filter: ";

/// What the child does: `crime` is committed on the loop's thread, should there be one.
fn live(crime: Option<fn()>) {
    // A process that is to be killed shall not leave its memory behind as a file.
    // SAFETY: takes numbers.
    unsafe { libc::prctl(libc::PR_SET_DUMPABLE, 0, 0, 0, 0) };
    let machine = Machine::new(1);
    let config = drives_and_errors(&machine, "250us", 10_000, 700);
    let lost = Arc::new(AtomicU64::new(0));
    let seen = Arc::clone(&lost);
    let task = move |cycle: &Cycle, axes: &mut Axes<'_>| {
        let link = axes.feedback(VICTIM).map(|feedback| feedback.link);
        seen.fetch_add(u64::from(link == Some(Link::Lost)), Ordering::Relaxed);
        if cycle.index > 1_000
            && let Some(crime) = crime
        {
            crime();
        }
    };
    let (confined, axes) = Confined::start(&config, Box::new(task));
    let mut adventures = Adventures::begin(&machine, &config, axes, ServerOptions::default());
    let goal = confined.executed() + CYCLES;
    while confined.executed() < goal {
        adventures.round();
    }
    // All the way down: a ramp, cut short half way by somebody who is in a hurry.
    adventures.set_out();
    confined.control.stop();
    let moving = || adventures.axes()[1].feedback();
    assert!(until(LONG, || moving().stopped.is_some() && moving().velocity.abs() < 250.0));
    confined.control.stop();
    let end = confined.end();

    let status = end.status;
    assert_eq!(count(), 0, "allocations in {} cycles", status.executed);
    assert_eq!(status.planned, status.executed + status.skipped);
    assert!(lost.load(Ordering::Relaxed) > 0);
    let drive = |name: &str| end.drives.iter().find(|drive| drive.name == name).unwrap();
    for (axis, ends) in adventures.axes().iter().zip(&adventures.ends) {
        let drive = drive(axis.name());
        assert!(ends.done >= 10 && !drive.feedback.state.is_powered(), "{ends:?} {drive:?}");
    }
    let losses = end.drives[VICTIM].losses;
    assert!(losses > 0 && adventures.ends[VICTIM].aborted > 0, "{:?}", end.drives[VICTIM]);
    let (dead, refused) = (drive("dead").counters, drive("refused").counters);
    assert!(dead.sent > 0 && dead.answered + dead.unsent == 0, "{dead:?}");
    assert!(refused.unsent > 0 && refused.sent == 0, "{refused:?}");
    assert!(end.buses.iter().any(|(_, strangers)| strangers.datagrams > 0), "{:?}", end.buses);
    println!("{LIVED}{} cycles, {losses} losses", status.executed);
}

/// The test `name` once more in a process of its own, to play `role`. Whoever is killed leaves its files behind: they
/// go with `shelter`.
fn child(name: &str, role: &str, shelter: &Machine) -> Ended {
    Program::spawn(again(name, role).env("TMPDIR", shelter.path(""))).end_within(10 * LONG)
}

#[test]
fn a_hundred_thousand_cycles_need_no_other_system_call_than_those_listed() {
    if role().is_some() {
        return live(None);
    }
    let name = "a_hundred_thousand_cycles_need_no_other_system_call_than_those_listed";
    let ended = child(name, "innocent", &Machine::new(2));
    assert_ne!(
        ended.signal,
        Some(libc::SIGSYS),
        "a call that is not listed; strace -f shows which: {ended:?}"
    );
    ended.expect(0);
    let lived = ended.out.lines().find_map(|line| line.strip_prefix(LIVED)).unwrap();
    assert!(lived.split(' ').next().unwrap().parse::<u64>().unwrap() >= CYCLES, "{ended:?}");
    println!("{LIVED}{lived}");
}

/// What the loop's thread must not do, each called often if it were let.
const CRIMES: [(&str, fn()); 3] = [
    ("a call that is not listed", || {
        // SAFETY: takes nothing and cannot fail.
        unsafe { libc::syscall(libc::SYS_getppid) };
    }),
    ("a receive that waits", || {
        // SAFETY: there is no descriptor -1, and nothing is written.
        unsafe { libc::recvmmsg(-1, std::ptr::null_mut(), 0, 0, std::ptr::null_mut()) };
    }),
    ("a sleep that is not absolute", || {
        let nanosecond = libc::timespec { tv_sec: 0, tv_nsec: 1 };
        // SAFETY: a valid timespec, and the remainder is not asked for.
        unsafe { libc::clock_nanosleep(libc::CLOCK_MONOTONIC, 0, &nanosecond, std::ptr::null_mut()) };
    }),
];

#[test]
fn any_other_system_call_of_the_loop_would_be_its_end() {
    if let Some(role) = role() {
        return live(CRIMES.iter().find(|(name, _)| *name == role).map(|(_, crime)| *crime));
    }
    for (crime, _) in CRIMES {
        let name = "any_other_system_call_of_the_loop_would_be_its_end";
        let ended = child(name, crime, &Machine::new(3));
        assert_eq!((ended.signal, ended.code), (Some(libc::SIGSYS), None), "{crime}: {ended:?}");
        assert!(!ended.out.contains(LIVED), "{crime}: {ended:?}");
    }
}
