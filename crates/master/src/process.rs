//! The end of the process ends its running masters in order: `exit`, a return from `main` with a master that is never
//! dropped, and, on request, signals.
//!
//! All masters of the process stand in one list that only grows, and whose places are used again. It has no lock, and
//! walking along it neither allocates nor frees: an exit may come from anywhere, even from a signal's handler that
//! interrupted a thread in the middle of `malloc`. Of the rest of the process nothing is needed but the loops' threads,
//! which run on until the last handler of `exit` has returned.

use std::ffi::c_int;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicU32, AtomicU64, Ordering};
use std::sync::{LazyLock, OnceLock};
use std::thread;
use std::time::{Duration, Instant};

use fieldbeat_core::cycle::engine::Control;
use fieldbeat_core::rt::{self, mapping};
use fieldbeat_core::time::nanos;

/// An end that is longer is hurried.
const LONGEST: Duration = Duration::from_secs(30);

/// A master is waited for by so much longer than the longest `stop.timeout` of its axes.
const MARGIN: Duration = Duration::from_secs(1);

/// How long a hurried end is waited for.
const HURRIED: Duration = Duration::from_secs(3);

const LOOK_EVERY: Duration = Duration::from_millis(1);

/// A running master, for as long as its loop's thread holds this.
#[derive(Debug)]
pub(super) struct Running(&'static Place);

/// One place of the list.
#[derive(Debug, Default)]
struct Place {
    control: Control,
    taken: AtomicBool,
    /// Of a child that was forked the loops have stayed behind.
    process: AtomicU32,
    /// The loop's thread.
    thread: AtomicI32,
    /// How long its end may take before it is hurried.
    longest_ns: AtomicU64,
    next: OnceLock<Box<Place>>,
}

static FIRST: OnceLock<Box<Place>> = OnceLock::new();

/// 0 if the handler of `exit` is registered.
static REGISTERED: LazyLock<c_int> = LazyLock::new(|| {
    // SAFETY: the function lives as long as the library, and does not unwind.
    unsafe { libc::atexit(at_exit) }
});

impl Running {
    /// A master whose axes have these stop time-outs. From here on, the end of the process is the end of it.
    pub(super) fn begin(timeouts: impl Iterator<Item = Duration>) -> io::Result<Running> {
        if *REGISTERED != 0 {
            return Err(io::ErrorKind::OutOfMemory.into());
        }
        let longest = timeouts.max().unwrap_or_default().saturating_add(MARGIN).min(LONGEST);
        let mut at = &FIRST;
        loop {
            let place = at.get_or_init(Box::default);
            if place.take() {
                place.process.store(std::process::id(), Ordering::Relaxed);
                place.longest_ns.store(nanos(longest), Ordering::Relaxed);
                return Ok(Running(place));
            }
            at = &place.next;
        }
    }

    /// The requests to its loop.
    pub(super) fn control(&self) -> Control {
        self.0.control.clone()
    }

    /// The calling thread is that of its loop.
    pub(super) fn is_on_this_thread(&self) {
        self.0.thread.store(nix::unistd::gettid().as_raw(), Ordering::Relaxed);
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.0.thread.store(0, Ordering::Relaxed);
        self.0.taken.store(false, Ordering::Release);
    }
}

impl Place {
    /// Takes it, if it is free and nobody holds a handle of the master that had it before.
    fn take(&self) -> bool {
        if self.taken.compare_exchange(false, true, Ordering::Acquire, Ordering::Relaxed).is_err() {
            return false;
        }
        let free = self.control.renew();
        if !free {
            self.taken.store(false, Ordering::Release);
        }
        free
    }

    /// The loop runs, in this process and on another thread than the calling one.
    fn runs(&self) -> bool {
        self.taken.load(Ordering::Acquire)
            && self.process.load(Ordering::Relaxed) == std::process::id()
            && self.thread.load(Ordering::Relaxed) != nix::unistd::gettid().as_raw()
    }
}

/// All masters that run.
fn running() -> impl Iterator<Item = &'static Place> {
    let places = std::iter::successors(FIRST.get(), |place| place.next.get());
    places.map(|place| &**place).filter(|place| place.runs())
}

/// Ends all running masters and waits for that: in order at first, then hurried, and not for ever. Those that end
/// already are only waited for. A master on whose loop this is called cannot go on meanwhile, and is left out.
fn end_all() {
    running().filter(|place| !place.control.is_stopping()).for_each(|place| place.control.stop());
    let longest_ns = running().map(|place| place.longest_ns.load(Ordering::Relaxed)).max();
    if !await_end(Duration::from_nanos(longest_ns.unwrap_or(0))) {
        running().for_each(|place| place.control.stop());
        await_end(HURRIED);
    }
}

/// Waits until no master runs. False: it took too long.
fn await_end(limit: Duration) -> bool {
    let begun = Instant::now();
    while running().next().is_some() {
        if begun.elapsed() > limit {
            return false;
        }
        thread::sleep(LOOK_EVERY);
    }
    true
}

extern "C" fn at_exit() {
    end_all();
}

/// The signals that end a process by default (signal(7)), without those of a crash, SIGABRT and the real-time signals.
pub const ENDING: [c_int; 13] = [
    libc::SIGINT,
    libc::SIGTERM,
    libc::SIGHUP,
    libc::SIGQUIT,
    libc::SIGALRM,
    libc::SIGVTALRM,
    libc::SIGPROF,
    libc::SIGUSR2,
    libc::SIGIO,
    libc::SIGPWR,
    libc::SIGSTKFLT,
    // The limit of processor time (ulimit -t): the kernel repeats it each second, up to SIGKILL at the hard limit.
    libc::SIGXCPU,
    // Ignored from the start of every Rust program, and left so.
    libc::SIGPIPE,
];

/// The present action of `signal`: a handler, SIG_DFL or SIG_IGN.
pub fn action_of(signal: c_int) -> libc::sighandler_t {
    let mut action = std::mem::MaybeUninit::<libc::sigaction>::zeroed();
    // SAFETY: a null action changes nothing, and `action` has room for the present one; all zero is a valid one.
    unsafe {
        libc::sigaction(signal, std::ptr::null(), action.as_mut_ptr());
        action.assume_init().sa_sigaction
    }
}

/// The signal that ends the process: the first one that came.
static CAUGHT: AtomicI32 = AtomicI32::new(0);

/// The descriptor that wakes the thread that waits for it.
static BELL: AtomicI32 = AtomicI32::new(-1);

/// The process that catches them.
static CATCHES: AtomicU32 = AtomicU32::new(0);

/// From here on the signals that would end the process end its running masters first, and then the process in the same
/// way. Those that the program handles or ignores by itself are left to it.
pub(super) fn catch_signals(core_of_loop: Option<usize>) -> io::Result<()> {
    let process = std::process::id();
    if CATCHES.swap(process, Ordering::AcqRel) == process {
        return Ok(());
    }
    let caught = catch_all(core_of_loop);
    if caught.is_err() {
        CATCHES.store(0, Ordering::Release);
    }
    caught
}

fn catch_all(core_of_loop: Option<usize>) -> io::Result<()> {
    // SAFETY: takes two numbers.
    let bell = unsafe { libc::eventfd(0, libc::EFD_CLOEXEC) };
    if bell < 0 {
        return Err(io::Error::last_os_error());
    }
    BELL.store(bell, Ordering::Release);
    thread::Builder::new().name("fb-signals".into()).spawn(move || {
        rt::thread::helper_thread(core_of_loop);
        await_signal(bell);
    })?;
    for signal in ENDING {
        catch(signal, on_signal)?;
    }
    catch(libc::SIGABRT, on_abort)
}

/// `handler` is called at `signal`, if that ended the process until now.
fn catch(signal: c_int, handler: extern "C" fn(c_int)) -> io::Result<()> {
    if action_of(signal) != libc::SIG_DFL {
        return Ok(());
    }
    // SAFETY: all zero is a valid action; the handlers do nothing that a handler may not do (signal-safety(7)): atomic
    // operations, write, sigaction and raise, and that of SIGABRT waits by clock_gettime and nanosleep.
    let result = unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        action.sa_sigaction = handler as *const () as libc::sighandler_t;
        // The host's calls go on, on its threads with small stacks, too.
        action.sa_flags = libc::SA_RESTART | libc::SA_ONSTACK;
        libc::sigaction(signal, &action, std::ptr::null_mut())
    };
    if result == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

/// The loops learn it here, so that a second signal shortens their waits although the first one is being waited for.
extern "C" fn on_signal(signal: c_int) {
    // SAFETY: the address is that of the calling thread, whose code expects to find its error unchanged.
    let (errno, before) = unsafe { (libc::__errno_location(), *libc::__errno_location()) };
    if CATCHES.load(Ordering::Relaxed) == std::process::id() {
        running().for_each(|place| place.control.stop());
        let _ = CAUGHT.compare_exchange(0, signal, Ordering::Release, Ordering::Relaxed);
        let one = 1_u64;
        // SAFETY: eight bytes of a value that lives until it returns.
        unsafe { libc::write(BELL.load(Ordering::Acquire), (&raw const one).cast(), size_of::<u64>()) };
    } else {
        // A child that was forked has no such thread.
        end_by(signal);
    }
    // SAFETY: as above.
    unsafe { *errno = before };
}

/// `abort` ends the process as soon as this returns; so it waits, on the thread that aborts.
extern "C" fn on_abort(signal: c_int) {
    mapping::crashes();
    end_all();
    end_by(signal);
}

/// The process ends by `signal`, at the latest when the handler of it returns.
fn end_by(signal: c_int) {
    // SAFETY: takes numbers; the default action runs no code.
    unsafe {
        libc::signal(signal, libc::SIG_DFL);
        libc::raise(signal);
    }
}

/// Waits for a signal, then for the end of all masters.
fn await_signal(bell: c_int) {
    while CAUGHT.load(Ordering::Acquire) == 0 {
        let mut rung = 0_u64;
        // SAFETY: `rung` has room for the eight bytes.
        unsafe { libc::read(bell, (&raw mut rung).cast(), size_of::<u64>()) };
    }
    end_all();
    let signal = CAUGHT.load(Ordering::Acquire);
    // Those that a thread is started with may block it.
    let mut signals = nix::sys::signal::SigSet::empty();
    if let Ok(signal) = nix::sys::signal::Signal::try_from(signal) {
        signals.add(signal);
    }
    let _ = signals.thread_unblock();
    end_by(signal);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_reused_only_once_all_handles_of_the_old_master_are_dropped() {
        let first = Running::begin([Duration::from_secs(2), Duration::from_secs(5)].into_iter()).unwrap();
        let (place, handle) = (first.0, first.control());
        assert_eq!(place.longest_ns.load(Ordering::Relaxed), 6_000_000_000);
        handle.stop();
        drop(first);
        let others: Vec<_> = (0..8).map(|_| Running::begin([Duration::MAX].into_iter()).unwrap()).collect();
        for other in &others {
            assert!(!std::ptr::eq(other.0, place) && !other.control().is_stopping());
            assert_eq!(other.0.longest_ns.load(Ordering::Relaxed), 30_000_000_000);
        }
        drop(handle);
        let free = place.take();
        // Another test of this process may have been faster.
        assert!(!free || !place.control.is_stopping());
        drop(free.then(|| Running(place)));
    }

    #[test]
    fn a_master_is_waited_for_by_all_threads_but_that_of_its_loop() {
        let running = Running::begin(std::iter::empty()).unwrap();
        assert!(running.0.runs());
        running.is_on_this_thread();
        assert!(!running.0.runs());
        let place = running.0;
        assert!(thread::spawn(|| place.runs()).join().unwrap());
        place.process.store(0, Ordering::Relaxed);
        assert!(!thread::spawn(|| place.runs()).join().unwrap(), "of a process that has forked this one");
    }
}
