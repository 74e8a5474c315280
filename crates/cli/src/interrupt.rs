//! Signals. Each one that would end the process by default requests the orderly end instead: the first stops the axes
//! and powers them off, a second one shortens the waits. Neither skips the stop. SIGUSR1 requests the black box. A
//! running master refuses to be suspended from the terminal.
//!
//! Left alone are the signals of a crash (SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGTRAP, SIGSYS): the instruction that
//! raised one would be repeated. SIGKILL and SIGSTOP cannot be caught.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fieldbeat_core::rt::confine::{Keep, give_up_rights};
use fieldbeat_master::{ENDING, StopHandle, action_of};
use libc::c_int;
use nix::sys::signal::{SigSet, SigmaskHow};
use signal_hook::consts::{SIGTSTP, SIGTTIN, SIGTTOU, SIGUSR1, SIGXFSZ};

use super::complain;

/// Set by the signals' handlers, which do nothing else.
#[derive(Clone, Debug)]
pub struct Interrupt {
    /// Since the last look.
    fresh: Arc<AtomicBool>,
    /// Ever.
    ever: Arc<AtomicBool>,
    /// SIGUSR1: somebody wants the black box.
    black_box: Arc<AtomicBool>,
}

impl Interrupt {
    /// Catches the signals from here on. There is no other thread yet.
    pub fn catch() -> std::io::Result<Interrupt> {
        // One that came between the system call and the entry of its flags would be lost: it waits for both.
        let before = SigSet::all().thread_swap_mask(SigmaskHow::SIG_BLOCK)?;
        let interrupt = Interrupt::register();
        before.thread_set_mask()?;
        interrupt
    }

    fn register() -> std::io::Result<Interrupt> {
        let interrupt = Interrupt { fresh: Arc::default(), ever: Arc::default(), black_box: Arc::default() };
        let real_time = libc::SIGRTMIN()..=libc::SIGRTMAX();
        for signal in ENDING.into_iter().chain([libc::SIGABRT]).chain(real_time) {
            // Under nohup the program shall outlive its terminal. The others are caught even if they were ignored: a
            // shell does so with SIGINT and SIGQUIT of what it puts into the background.
            if [libc::SIGHUP, libc::SIGPIPE].contains(&signal) && action_of(signal) == libc::SIG_IGN {
                continue;
            }
            signal_hook::flag::register(signal, Arc::clone(&interrupt.ever))?;
            signal_hook::flag::register(signal, Arc::clone(&interrupt.fresh))?;
        }
        signal_hook::flag::register(SIGUSR1, Arc::clone(&interrupt.black_box))?;
        // A limit of file sizes (ulimit -f) would end the process in mid-motion; caught, it only fails that write.
        signal_hook::flag::register(SIGXFSZ, Arc::new(AtomicBool::new(false)))?;
        Ok(interrupt)
    }

    /// Whether SIGUSR1 came since the last call.
    pub fn wants_black_box(&self) -> bool {
        self.black_box.swap(false, Ordering::Relaxed)
    }

    /// Whether a signal has come.
    pub fn is_set(&self) -> bool {
        self.ever.load(Ordering::Relaxed)
    }

    /// Passes every signal on to a master, for as long as the process lives. From here on it is not suspended from the
    /// terminal: the drives would be left without a master in mid-motion.
    pub fn stops(&self, handle: StopHandle) -> std::io::Result<()> {
        let (fresh, suspend) = (Arc::clone(&self.fresh), Arc::new(AtomicBool::new(false)));
        signal_hook::flag::register(SIGTSTP, Arc::clone(&suspend))?;
        // Ignored, not caught: the write or read that caused one would be repeated for ever. So the write is made, and
        // the read fails.
        ignore(SIGTTIN)?;
        ignore(SIGTTOU)?;
        std::thread::Builder::new()
            .name("fb-signals".into())
            .spawn(move || {
                give_up_rights(Keep::Nothing);
                loop {
                    if fresh.swap(false, Ordering::Relaxed) {
                        handle.stop();
                    }
                    if suspend.swap(false, Ordering::Relaxed) {
                        // By a thread of its own: standard error that nobody reads must not hold up a stop.
                        let line = || complain("not suspended: the drives would have no master; use Ctrl-C");
                        let _ = std::thread::Builder::new().spawn(line);
                    }
                    std::thread::sleep(LOOK_EVERY);
                }
            })
            .map(drop)
    }
}

fn ignore(signal: c_int) -> std::io::Result<()> {
    // SAFETY: takes two numbers; ignoring runs no code.
    match unsafe { libc::signal(signal, libc::SIG_IGN) } {
        libc::SIG_ERR => Err(std::io::Error::last_os_error()),
        _ => Ok(()),
    }
}

/// How often signals are looked for.
pub const LOOK_EVERY: Duration = Duration::from_millis(20);
