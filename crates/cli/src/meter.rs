//! How far a transfer is, for whoever waits for it; and the way to break it off.

use std::io::{IsTerminal, Write};
use std::ops::ControlFlow;
use std::time::{Duration, Instant};

use fieldbeat_core::axis::acyclic::Progress;

use super::complain;
use super::interrupt::Interrupt;

/// Shows how far a transfer is, on standard error: on a terminal in one line, elsewhere a line every few seconds.
#[derive(Debug)]
pub struct Meter<'a> {
    interrupt: &'a Interrupt,
    terminal: bool,
    shown: Instant,
    open: bool,
}

impl<'a> Meter<'a> {
    /// Nothing is done yet.
    pub fn new(interrupt: &'a Interrupt) -> Meter<'a> {
        Meter { interrupt, terminal: std::io::stderr().is_terminal(), shown: Instant::now(), open: false }
    }

    /// Whoever does it reports to this, and breaks off at a signal.
    pub fn watch(mut self) -> impl FnMut(Progress) -> ControlFlow<()> + 'a {
        move |progress| {
            self.show(progress);
            if self.interrupt.is_set() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        }
    }

    fn show(&mut self, Progress { what, done, of }: Progress) {
        let every = if self.terminal { Duration::from_millis(100) } else { Duration::from_secs(5) };
        if self.shown.elapsed() < every {
            return;
        }
        self.shown = Instant::now();
        let percent = done * 100 / of.max(1);
        let line = format!("{what} {done} of {of} ({percent} %)");
        match self.terminal {
            true => {
                let _ = write!(std::io::stderr().lock(), "\r{line}\x1b[K");
                self.open = true;
            }
            false => complain(&line),
        }
    }
}

impl Drop for Meter<'_> {
    fn drop(&mut self) {
        if self.open {
            let _ = write!(std::io::stderr().lock(), "\r\x1b[K");
        }
    }
}
