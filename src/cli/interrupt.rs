//! Ctrl-C, SIGTERM, and SIGHUP of a terminal that goes away: the first asks for the orderly end, the second shortens
//! its waits. Neither skips the stop. SIGUSR1 asks for the black box.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fieldbeat::master::StopHandle;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGUSR1, SIGXFSZ};

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
    /// Catches the signals from here on.
    pub fn catch() -> std::io::Result<Interrupt> {
        let interrupt = Interrupt { fresh: Arc::default(), ever: Arc::default(), black_box: Arc::default() };
        for signal in [SIGINT, SIGTERM, SIGHUP] {
            // Under nohup the program shall outlive its terminal.
            if signal == SIGHUP && is_ignored(signal) {
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

    /// Whether SIGUSR1 came since this was asked last.
    pub fn wants_black_box(&self) -> bool {
        self.black_box.swap(false, Ordering::Relaxed)
    }

    /// Whether a signal has come.
    pub fn is_set(&self) -> bool {
        self.ever.load(Ordering::Relaxed)
    }

    /// Passes every signal on to a master, for as long as the process lives.
    pub fn stops(&self, handle: StopHandle) -> std::io::Result<()> {
        let fresh = Arc::clone(&self.fresh);
        std::thread::Builder::new()
            .name("fb-signals".into())
            .spawn(move || {
                loop {
                    if fresh.swap(false, Ordering::Relaxed) {
                        handle.stop();
                    }
                    std::thread::sleep(LOOK_EVERY);
                }
            })
            .map(drop)
    }
}

/// Whether whoever started the program had it ignore `signal`.
fn is_ignored(signal: libc::c_int) -> bool {
    let mut action = std::mem::MaybeUninit::<libc::sigaction>::zeroed();
    // SAFETY: a null action changes nothing, and `action` has room for the present one; all zero is a valid one.
    unsafe {
        libc::sigaction(signal, std::ptr::null(), action.as_mut_ptr());
        action.assume_init().sa_sigaction == libc::SIG_IGN
    }
}

/// How often signals are looked for.
pub const LOOK_EVERY: Duration = Duration::from_millis(20);
