//! The live line of a running master: on a terminal it rewrites itself, elsewhere it comes once in ten seconds.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

use fieldbeat_core::time::US;
use fieldbeat_master::Master;
use fieldbeat_telemetry::{Measured, Quantiles, ReferenceStatus};

/// Which drives the line counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Count {
    /// Those whose link is up: while they are waited for.
    Online,
    /// Those in OperationEnabled.
    Operational,
}

/// Writes to standard error, so that standard output stays what was requested.
#[derive(Debug)]
pub struct Live {
    terminal: bool,
    every: Duration,
    last: Option<Instant>,
    /// The line on the terminal has to be ended before anything else is written.
    open: bool,
    /// The wake-ups of the loop, as they were read last.
    wake: Quantiles,
}

impl Live {
    /// A live line for this standard error.
    pub fn new() -> Live {
        let terminal = std::io::stderr().is_terminal();
        let every = if terminal { Duration::from_millis(250) } else { Duration::from_secs(10) };
        Live { terminal, every, last: None, open: false, wake: Quantiles::default() }
    }

    /// Writes the line if it is time. `what` is going on, `count` of the drives have come so far.
    pub fn show(&mut self, master: &Master, what: &str, count: Count) {
        if self.last.is_some_and(|last| last.elapsed() < self.every) {
            return;
        }
        // Not at once: a run shorter than the interval needs no line.
        if self.last.replace(Instant::now()).is_none() && !self.terminal {
            return;
        }
        let status = master.status();
        let wake = |measured: &Measured| Quantiles::of(&measured.histograms.wake, status.wake_max);
        self.wake = master.try_measured(wake).unwrap_or(self.wake);
        let wake = self.wake;
        let drives = master.observers().len();
        // Fits into 80 columns for a day at 1 kHz.
        let us = |ns: Option<u64>| ns.map_or(String::from("-"), |ns| format!("{:.1}", ns as f64 / US as f64));
        let lock = match status.reference {
            None => String::new(),
            Some(ReferenceStatus { locked: false, .. }) => "  NOT LOCKED".to_owned(),
            Some(ReferenceStatus { error_ns, .. }) => {
                format!("  phase {:+.1} us", error_ns as f64 / US as f64)
            }
        };
        let count = match count {
            Count::Online => format!("{}/{drives} online", status.online),
            Count::Operational => format!("{}/{drives} operational", status.operational),
        };
        let line = format!(
            "{what}: {count}  cycle {}  wake p50 {} p99 {} max {} us  missed {}  skipped {}{lock}",
            status.planned,
            us(wake.p50),
            us(wake.p99),
            us(wake.max),
            status.missed,
            status.skipped,
        );
        let mut out = std::io::stderr().lock();
        let _ = if self.terminal { write!(out, "\r\x1b[K{line}") } else { writeln!(out, "{line}") };
        let _ = out.flush();
        self.open = self.terminal;
    }

    /// Ends the line.
    pub fn end(&mut self) {
        if std::mem::take(&mut self.open) {
            let _ = writeln!(std::io::stderr().lock());
        }
    }

    /// A line of its own, between the live ones.
    pub fn say(&mut self, text: &str) {
        self.end();
        let _ = writeln!(std::io::stderr().lock(), "{text}");
    }
}
