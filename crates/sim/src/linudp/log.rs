//! The error log: all errors since the drive was made. It is in flash and outlives every restart.
//!
//! Knows no wire block. Entry 0 is the newest (chosen: the manuals count the entries and do not say from which end).

use std::collections::VecDeque;

use super::codec::errors;
use fieldbeat_core::time::{MS, S};

/// Entries that there is room for (LinUDP V2 manual, 71h: 0 ... 20).
const ROOM: usize = 21;

/// Characters of a text (LinUDP V2 manual, 74h: 8 stringlets).
const TEXT: usize = 32;

const HOUR_NS: u64 = 3_600 * S;

/// One error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Entry {
    pub code: u16,
    /// Full hours since the first power-on ...
    pub hours: u32,
    /// ... and milliseconds since then.
    pub ms: u32,
}

/// The last errors.
#[derive(Debug, Default)]
pub(super) struct ErrorLog {
    /// The newest one first.
    entries: VecDeque<Entry>,
    occurred: u16,
}

impl ErrorLog {
    /// Records an error, so long after the first power-on.
    pub(super) fn record(&mut self, code: u16, operating_ns: u64) {
        self.entries.truncate(ROOM - 1);
        let (hours, ms) = hours_and_ms(operating_ns);
        self.entries.push_front(Entry { code, hours, ms });
        self.occurred = self.occurred.saturating_add(1);
    }

    /// Entries that are kept, and errors that occurred; the latter saturates at 65535.
    pub(super) fn counters(&self) -> (u16, u16) {
        (self.entries.len() as u16, self.occurred)
    }

    /// An entry, 0 being the newest.
    pub(super) fn entry(&self, index: u16) -> Option<Entry> {
        self.entries.get(usize::from(index)).copied()
    }
}

/// A span as the drive counts its hours: full ones, and the milliseconds above them.
pub(super) fn hours_and_ms(ns: u64) -> (u32, u32) {
    // 2^64 ns are 5.1 million hours.
    ((ns / HOUR_NS) as u32, (ns % HOUR_NS / MS) as u32)
}

/// Four characters of the text of an error, 0-padded; text beyond 32 characters is cut. `None`: no such error, or
/// no such part.
pub(super) fn text(code: u16, part: u16) -> Option<[u8; 4]> {
    let at = usize::from(part) * 4;
    let text = errors::text(code).filter(|_| at < TEXT)?.as_bytes();
    Some([0, 1, 2, 3].map(|n| text.get(at + n).copied().unwrap_or(0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_21_errors_are_kept_and_all_are_counted() {
        let mut log = ErrorLog::default();
        assert_eq!((log.counters(), log.entry(0)), ((0, 0), None));
        for n in 0..30 {
            log.record(n, HOUR_NS * 5 / 2 + u64::from(n) * MS);
        }
        assert_eq!(log.counters(), (21, 30));
        assert_eq!(log.entry(0), Some(Entry { code: 29, hours: 2, ms: 1_800_029 }));
        assert_eq!(log.entry(20).map(|entry| entry.code), Some(9));
        assert_eq!(log.entry(21), None);
        (0..70_000).for_each(|_| log.record(1, 0));
        assert_eq!(log.counters(), (21, u16::MAX));
    }
}
