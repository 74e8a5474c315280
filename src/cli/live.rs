//! The live line of a running master: on a terminal it rewrites itself, elsewhere it comes once in ten seconds.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

use fieldbeat::axis::Observer;
use fieldbeat::master::Master;
use fieldbeat::telemetry::Quantiles;
use fieldbeat::time::US;

/// Writes to standard error, so that standard output stays what was asked for.
#[derive(Debug)]
pub struct Live {
    terminal: bool,
    every: Duration,
    last: Option<Instant>,
    /// The line on the terminal has to be ended before anything else is written.
    open: bool,
}

impl Live {
    /// A live line for this standard error.
    pub fn new() -> Live {
        let terminal = std::io::stderr().is_terminal();
        let every = if terminal { Duration::from_millis(250) } else { Duration::from_secs(10) };
        Live { terminal, every, last: None, open: false }
    }

    /// Writes the line if it is time.
    pub fn show(&mut self, master: &Master, what: &str) {
        if self.last.is_some_and(|last| last.elapsed() < self.every) {
            return;
        }
        // Not at once: a run shorter than the interval needs no line.
        if self.last.replace(Instant::now()).is_none() && !self.terminal {
            return;
        }
        let status = master.status();
        let wake = master.measured(|measured| Quantiles::of(&measured.wake, Some(status.wake_max_ns)));
        let wake = wake.unwrap_or_default();
        let drives = master.observers().len();
        // Fits into 80 columns for a day at 1 kHz.
        let us = |ns: Option<u64>| ns.map_or(String::from("-"), |ns| format!("{:.1}", ns as f64 / US as f64));
        let line = format!(
            "{what} {}  wake p50 {} p99 {} max {} us  axes {}/{drives}  missed {}  skipped {}",
            status.planned,
            us(wake.p50),
            us(wake.p99),
            us(wake.max),
            status.operational,
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

/// Reports each change of a drive's link once.
#[derive(Debug)]
pub struct LinkWatch {
    links: Vec<fieldbeat::axis::Link>,
    /// All of them were online once.
    complete: bool,
}

impl LinkWatch {
    /// A watch over `observers`, none of them seen yet.
    pub fn new(observers: &[(String, Observer)]) -> LinkWatch {
        LinkWatch { links: vec![Default::default(); observers.len()], complete: false }
    }

    /// Says which drives came and went.
    pub fn look(&mut self, master: &Master, live: &mut Live) {
        use fieldbeat::axis::Link;
        for ((name, observer), known) in master.observers().iter().zip(&mut self.links) {
            let link = observer.feedback().link;
            if link == *known {
                continue;
            }
            match link {
                Link::Online if *known != Link::Unseen => live.say(&format!("drive {name}: back online")),
                Link::Lost => live.say(&format!("drive {name}: lost, it no longer answers")),
                Link::Online | Link::Unseen | Link::Qualifying => {}
            }
            if link != Link::Qualifying {
                *known = link;
            }
        }
        if !self.complete && self.links.iter().all(|link| *link == Link::Online) {
            self.complete = true;
            live.say(&format!("all drives online: {}", self.links.len()));
        }
    }
}
