//! One bus, and its clock.

use std::fmt;

use serde::Serialize;

use fieldbeat_core::bus::{BusClock, BusFacts};
use fieldbeat_core::cycle::status::Numbers;
use fieldbeat_core::time::{Ns, three_digits};

/// One bus.
#[derive(Clone, Debug, Serialize)]
pub struct Bus {
    /// The name.
    pub name: String,
    /// Datagrams from unknown senders: addresses that are no drive's.
    pub unmatched: u64,
    /// Datagrams that the kernel dropped because the socket's buffer was full.
    pub dropped: u64,
    /// Errors of the receiving socket.
    pub receive_errors: u64,
    /// The bus load, percent: the time that the telegrams of its drives took there, of all slots so far; null:
    /// it is no half-duplex wire, or no slot has passed.
    pub load_percent: Option<f64>,
    /// The clock and the grid; null: it has no clock.
    pub clock: Option<ClockNumbers>,
}

/// The load of each bus, percent.
pub fn loads(facts: &[BusFacts], period_ns: u64, numbers: &Numbers) -> Vec<Option<f64>> {
    let slots_us = (numbers.status.planned * period_ns) as f64 / 1e3;
    let mut drives = numbers.drives.as_slice();
    let load = |bus: &BusFacts| {
        let own;
        (own, drives) = drives.split_at(bus.drives.len().min(drives.len()));
        let wire_us = bus.wire_us.filter(|_| slots_us > 0.0)?;
        let all_us: u64 = own.iter().map(|drive| drive.counters.own[wire_us]).sum();
        Some(100.0 * all_us as f64 / slots_us)
    };
    facts.iter().map(load).collect()
}

/// The clock of a bus relative to the grid.
#[derive(Clone, Debug, Serialize)]
pub struct ClockNumbers {
    /// The grid follows it; else it follows the grid.
    pub leads: bool,
    /// It has been where its drives want it for a while.
    pub locked: bool,
    /// How far the newest slot was from where it wants it: positive is late; null: it was not seen.
    pub error_ns: Option<i64>,
    /// The largest distance, late or early, from the first lock on.
    pub error_max_ns: u64,
    /// The largest distance that its drives tolerate.
    pub window_ns: u64,
}

impl ClockNumbers {
    pub(super) fn of(clock: BusClock, leads: bool) -> ClockNumbers {
        let BusClock { error_ns, locked, error_max_ns, window_ns } = clock;
        ClockNumbers { leads, locked, error_ns, error_max_ns, window_ns }
    }
}

impl fmt::Display for ClockNumbers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ClockNumbers { leads, locked, error_ns, error_max_ns, window_ns } = *self;
        let way = if leads { "leads the grid" } else { "follows the grid" };
        write!(f, "{way}, {}, error ", if locked { "locked" } else { "NOT LOCKED" })?;
        match error_ns {
            Some(ns) => {
                write!(f, "{}{}", if ns < 0 { "-" } else { "" }, Ns(three_digits(ns.unsigned_abs())))?
            }
            None => f.write_str("not known")?,
        }
        write!(
            f,
            ", at most {} since its lock; its drives tolerate {}",
            Ns(three_digits(error_max_ns)),
            Ns(window_ns)
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_follows_is_one_line() {
        let clock =
            BusClock { error_ns: Some(-1_250), locked: true, error_max_ns: 4_000, window_ns: 320_000 };
        let line_of = |clock| ClockNumbers::of(clock, false).to_string();
        let line = "follows the grid, locked, error -1.25 us, at most 4 us since its lock; its drives \
             tolerate 320 us";
        assert_eq!(line_of(clock), line);
        let line = "follows the grid, NOT LOCKED, error not known, at most 4 us since its lock; its drives \
             tolerate 320 us";
        assert_eq!(line_of(BusClock { error_ns: None, locked: false, ..clock }), line);
    }
}
