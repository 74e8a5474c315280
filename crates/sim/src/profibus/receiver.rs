//! What a station makes of the bytes on the wire: telegrams, each with the silence before it.
//!
//! Knows no address. Facts: sheet, 5: no gaps inside a telegram, 33 bits of silence (Tsyn) before a request.

use super::telegram::{self, Damage};
use fieldbeat_core::net::SerialLine;
use fieldbeat_core::time::{MS, Time};

/// The silence before a request, bits.
const SYNC_BITS: u64 = 33;
/// On a real port bytes come when the host delivers them: after so much silence a telegram is given up, ns.
const PATIENCE_NS: u64 = 20 * MS;

/// Telegrams that it did not take, by the reason. Noise and collisions do that, too.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Broken {
    /// Bytes that begin no telegram.
    pub start: u64,
    /// A length that is none, or not the same twice.
    pub length: u64,
    /// A wrong check sum.
    pub sum: u64,
    /// A wrong end byte.
    pub end: u64,
    /// A service access point that is announced and missing.
    pub extension: u64,
    /// More than one character of silence inside.
    pub gap: u64,
    /// Directly behind something broken: nobody knows where it begins.
    pub unsynchronised: u64,
}

/// The silence before a telegram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Before {
    /// Enough for a request.
    Silence,
    /// Too little, behind something whole.
    Busy,
    /// Too little, behind something broken.
    Debris,
}

/// The receiving side of a station.
#[derive(Debug)]
pub(super) struct Receiver {
    line: SerialLine,
    /// Behind a real port: silence says nothing.
    untimed: bool,
    /// The bytes of an unfinished telegram.
    pending: Vec<u8>,
    /// The silence before that.
    before: Before,
    /// The end of the last byte on the wire.
    quiet_since: Option<Time>,
    /// What was last on the wire was broken.
    debris: bool,
    pub broken: Broken,
}

impl Receiver {
    pub(super) fn new(line: SerialLine) -> Receiver {
        Receiver {
            line,
            untimed: false,
            pending: Vec::new(),
            before: Before::Silence,
            quiet_since: None,
            debris: false,
            broken: Broken::default(),
        }
    }

    /// Behind a real port from now on.
    pub(super) fn untimed(&mut self) {
        self.untimed = true;
    }

    /// Power was lost.
    pub(super) fn restart(&mut self) {
        self.pending.clear();
        (self.quiet_since, self.debris) = (None, false);
    }

    /// The station itself sends until then.
    pub(super) fn sent(&mut self, end: Time) {
        self.quiet_since = Some(self.quiet_since.map_or(end, |before| before.max(end)));
        self.debris = false;
    }

    /// Bytes in a row, the last one of which ends at `now`: hands each whole telegram on, with its end, and whether
    /// there was enough silence for a request.
    pub(super) fn take(&mut self, now: Time, bytes: &[u8], mut telegram: impl FnMut(Time, bool, &[u8])) {
        let begin = now - self.line.span_ns(bytes.len());
        let silence = self.quiet_since.map_or(u64::MAX, |end| begin.since(end));
        self.quiet_since = Some(now);
        let gap_ns = if self.untimed { PATIENCE_NS } else { self.line.span_ns(1) };
        if silence > gap_ns && !self.pending.is_empty() {
            self.broken.gap += 1;
            self.pending.clear();
            self.debris = true;
        }
        if self.pending.is_empty() {
            self.before = self.silence(silence);
        }
        for (k, byte) in bytes.iter().enumerate() {
            self.pending.push(*byte);
            let whole = match telegram::length(&self.pending) {
                Ok(length) => length == Some(self.pending.len()),
                Err(damage) => return self.give_up(damage),
            };
            if whole {
                let pending = std::mem::take(&mut self.pending);
                match telegram::parse(&pending) {
                    Ok(_) if self.before == Before::Debris => self.broken.unsynchronised += 1,
                    Ok(_) => {
                        let end = begin + self.line.span_ns(k + 1);
                        telegram(end, self.before == Before::Silence, &pending);
                    }
                    Err(damage) => return self.give_up(damage),
                }
                (self.pending, self.before, self.debris) = (pending, self.silence(0), false);
                self.pending.clear();
            }
        }
    }

    /// The bytes so far are no telegram: what follows without silence is not looked at.
    fn give_up(&mut self, damage: Damage) {
        self.pending.clear();
        let broken = &mut self.broken;
        *match damage {
            _ if self.before == Before::Debris => &mut broken.unsynchronised,
            Damage::Start => &mut broken.start,
            Damage::Length => &mut broken.length,
            Damage::Sum => &mut broken.sum,
            Damage::End => &mut broken.end,
            Damage::Extension => &mut broken.extension,
        } += 1;
        self.debris = true;
    }

    fn silence(&self, ns: u64) -> Before {
        // Both ends of a span are rounded to ns.
        match ns.saturating_add(1) >= self.line.bits_ns(SYNC_BITS) {
            _ if self.untimed => Before::Silence,
            true => Before::Silence,
            false if self.debris => Before::Debris,
            false => Before::Busy,
        }
    }
}
