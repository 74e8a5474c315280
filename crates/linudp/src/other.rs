//! Another master of a LinMot drive, by the counts of its motion commands.
//!
//! The drive answers each sender by itself: frames of another master are never seen here. In operation it reports the
//! count of the last motion command that it has stored. A count that no request of this master has carried for a long
//! time, and that the drive did not have when it came into operation, was stored for somebody else. Reported in several
//! clean replies in a row it is proof: a late reply, or a late copy of a request, shows a count that this master has
//! used lately.
//!
//! The effective bits of the control word in the status word are no evidence: the drive's inputs and the control panel
//! of its commissioning software change them too. Nor is silence: a drive whose single-master filter has locked onto
//! another master looks as if it were absent.

/// Counts of motion commands.
const COUNTS: usize = 16;
/// A count that a request of this master has carried within so many exchanges is its own: no copy of a request arrives
/// later.
const OWN: u64 = 250;
/// The number of clean replies in a row with an unexplained count that are proof ...
const REPLIES: u8 = 3;
/// ... and so many that differ from one to the next, before any count was reported twice.
const CHANGES: u8 = 5;

/// The watch for another master's commands.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct OtherMaster {
    /// For each count the number of the exchange from which on it is not this master's own any more.
    own_until: [u64; COUNTS],
    /// The count of the newest motion command that was prepared.
    prepared: u8,
    /// The count of the newest reply, and the one that is explained; `None`: the drive is not in operation, or has
    /// just come there.
    newest: Option<u8>,
    stored: Option<u8>,
    /// Replies in a row with a count that is not explained.
    strange: u8,
}

impl OtherMaster {
    /// The next request carries a motion command with this count.
    pub(super) fn prepare(&mut self, count: u8) {
        self.prepared = count;
    }

    /// The prepared request, which carries a motion command, has gone out: it opens the exchange of this number.
    #[inline(never)] // Most requests carry none.
    pub(super) fn sent(&mut self, exchange: u64) {
        if let Some(until) = self.own_until.get_mut(usize::from(self.prepared)) {
            *until = exchange + OWN;
        }
    }

    /// The count of the newest reply is not explained.
    pub(super) fn is_in_doubt(&self) -> bool {
        self.strange > 0
    }

    /// Another clean reply with the count of the newest one changes nothing.
    pub(super) fn is_settled(&self) -> bool {
        self.strange == 0 && (self.newest.is_none() || self.newest == self.stored)
    }

    /// A clean reply with this count, when the newest exchange has this number; `None`: the drive is not in operation.
    /// True if it proves another master.
    #[inline]
    pub(super) fn take(&mut self, count: Option<u8>, exchange: u64) -> bool {
        let before = std::mem::replace(&mut self.newest, count);
        let Some(count) = count else {
            (self.stored, self.strange) = (None, 0);
            return false;
        };
        let own = self.own_until.get(usize::from(count)).is_none_or(|until| exchange < *until);
        // Coming into operation, the drive has any count; a damaged reply does not show it twice.
        let met = self.stored.is_none() && before == Some(count);
        if own || met || self.stored == Some(count) {
            (self.stored, self.strange) = (Some(count), 0);
            return false;
        }
        self.strange += 1;
        let proof = if self.stored.is_some() { REPLIES } else { CHANGES };
        let proved = self.strange >= proof;
        if proved {
            (self.stored, self.strange) = (Some(count), 0);
        }
        proved
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The watch, and the number of the newest exchange.
    type Watch = (OtherMaster, u64);

    /// A watch of a drive in operation with this count for a long time, and nothing under way.
    fn idle(count: u8) -> Watch {
        let mut other = Watch::default();
        assert!((0..300).all(|_| !step(&mut other, None, Some(count))));
        other
    }

    /// An exchange: the count of the request, and that of the reply.
    fn step((other, exchange): &mut Watch, sent: Option<u8>, count: Option<u8>) -> bool {
        *exchange += 1;
        if let Some(sent) = sent {
            other.prepare(sent);
            other.sent(*exchange);
        }
        other.take(count, *exchange)
    }

    fn first(other: &mut Watch, counts: impl IntoIterator<Item = u8>) -> Option<usize> {
        counts.into_iter().position(|count| step(other, None, Some(count)))
    }

    #[test]
    fn the_third_reply_with_a_foreign_count_proves_another_master_once() {
        let mut other = idle(5);
        assert_eq!(first(&mut other, [6; 20]), Some(2));
        assert_eq!(first(&mut other, [6; 20]), None, "the same command proves nothing more");
        assert_eq!(first(&mut other, [7, 8, 9]), Some(2), "rows of a stream");
    }

    #[test]
    fn counts_of_this_master_prove_nothing_however_late_they_come() {
        let mut other = idle(5);
        for count in 6..12 {
            assert!(!step(&mut other, Some(count), Some(5)), "the drive takes it with the next cycle");
            assert!((0..20).all(|_| !step(&mut other, Some(count), Some(count))));
        }
        // Copies of requests that were under way.
        assert_eq!(first(&mut other, [9; 50]), None);
        assert_eq!(first(&mut other, [11; 300]), None);
        assert_eq!(first(&mut other, [9; 5]), Some(2), "not after so long");
    }

    #[test]
    fn a_damaged_reply_now_and_then_proves_nothing() {
        let mut other = idle(5);
        let damaged = (0..999_u16).map(|n| if n % 3 < 2 { (n % 11) as u8 } else { 5 });
        assert_eq!(first(&mut other, damaged), None);
        // Nor as the drive comes into operation.
        for garbage in [[9, 4, 4, 4, 4], [4, 9, 4, 4, 4], [4, 4, 9, 4, 4]] {
            assert!(!step(&mut other, None, None));
            assert_eq!(first(&mut other, garbage), None, "{garbage:?}");
        }
    }

    #[test]
    fn a_drive_that_comes_into_operation_has_any_count() {
        let mut other = idle(5);
        for count in [0, 9, 3] {
            assert!(!step(&mut other, None, None));
            assert_eq!(first(&mut other, [count; 300]), None);
        }
    }

    #[test]
    fn a_master_that_streams_is_seen_before_anything_is_written() {
        let mut other = Watch::default();
        assert_eq!(first(&mut other, (0..20).map(|n| n % 16)), Some(4));
        // A dead one has left its last count.
        let mut other = Watch::default();
        assert_eq!(first(&mut other, [7; 300]), None);
    }
}
