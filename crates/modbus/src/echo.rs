//! Whether the drive has accepted the written values.
//!
//! A reply to FC23 says nothing of what was written, and a drive refuses a value without an error code (Commander
//! SE guide): an accepted value reads back. Whether a drive writes before it reads is not documented, so a
//! difference counts only if the value was written by an earlier request, and only if it differs twice.

/// The number of differing reads in a row that are a refusal.
const DIFFERENT: u8 = 2;

/// No value. One whole word: the value is read as it was written a moment ago, which a processor can do without a wait.
const NONE: i64 = i64::MIN;

/// The result of a read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Shown {
    /// The written value.
    Same,
    /// Another one, which proves nothing.
    Other,
    /// By now the drive has refused the written value.
    Refused,
    /// The drive had the written value, and has another one now.
    Changed,
}

/// One written parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Echo {
    /// The value of the last answered request, and whether an earlier one had it, too.
    written: i64,
    settled: bool,
    /// Reads in a row that differed.
    different: u8,
    /// It was read as written since it was first written.
    stood: bool,
    /// The drive has certainly accepted it.
    taken: bool,
}

impl Default for Echo {
    fn default() -> Echo {
        Echo { written: NONE, settled: false, different: 0, stood: false, taken: false }
    }
}

impl Echo {
    /// The value that the drive has certainly accepted; `None`: not known.
    #[inline]
    pub(super) fn taken(&self) -> Option<i32> {
        self.taken.then_some(self.written as i32)
    }

    /// The drive has certainly accepted `value`.
    #[inline]
    pub(super) fn has_taken(&self, value: i32) -> bool {
        self.taken && self.written == i64::from(value)
    }

    /// A request that writes `value` goes out: whether it is answered or not, it may change what the drive has.
    #[inline]
    pub(super) fn sent(&mut self, value: i32) {
        self.stood &= self.written == i64::from(value);
    }

    /// A request that wrote `value` was answered.
    #[inline]
    pub(super) fn replied(&mut self, value: i32) {
        self.settled = self.written == i64::from(value);
        if !self.settled {
            (self.written, self.different, self.stood, self.taken) = (value.into(), 0, false, false);
        }
    }

    /// The answer has confirmed the write.
    #[inline]
    pub(super) fn confirm(&mut self, value: i32) {
        self.replied(value);
        self.taken = true;
    }

    /// A request that wrote `value` was answered, and it reads as that.
    #[inline]
    pub(super) fn reads_back(&mut self, value: i32) {
        let value = value.into();
        self.settled = self.written == value;
        (self.written, self.different, self.stood, self.taken) = (value, 0, true, true);
    }

    /// It reads as `value`.
    #[inline]
    pub(super) fn read(&mut self, value: i32) -> Shown {
        if self.written == i64::from(value) {
            (self.different, self.stood, self.taken) = (0, true, true);
            return Shown::Same;
        }
        if self.stood {
            self.taken = false;
            return Shown::Changed;
        }
        if !self.settled {
            return Shown::Other;
        }
        self.taken = false;
        self.different = self.different.saturating_add(1);
        if self.different == DIFFERENT { Shown::Refused } else { Shown::Other }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_taken_when_it_reads_back() {
        let mut echo = Echo::default();
        assert!([1, 2, 3].into_iter().all(|value| echo.read(value) == Shown::Other), "nobody wrote these");
        echo.replied(5);
        assert_eq!(echo.taken(), None);
        // A drive that reads before it writes.
        assert_eq!(echo.read(0), Shown::Other);
        echo.replied(5);
        assert_eq!(echo.read(5), Shown::Same);
        assert_eq!(echo.taken(), Some(5));
        echo.replied(6);
        assert_eq!(echo.taken(), None, "another value is another matter");
    }

    #[test]
    fn a_read_back_value_counts_as_echo() {
        let mut random = fastrand::Rng::with_seed(3);
        let mut echo = Echo::default();
        for _ in 0..10_000 {
            let value = random.i32(0..3);
            let (mut one, mut other) = (echo, echo);
            one.replied(value);
            assert_eq!(one.read(value), Shown::Same);
            other.reads_back(value);
            assert_eq!(one, other);
            match random.u8(0..4) {
                0 => echo = one,
                1 => echo.sent(random.i32(0..3)),
                2 => drop(echo.read(random.i32(0..3))),
                _ => echo.replied(random.i32(0..3)),
            }
        }
    }

    #[test]
    fn two_differing_reads_are_a_refusal_reported_once() {
        let mut echo = Echo::default();
        echo.replied(5);
        assert_eq!(echo.read(1), Shown::Other, "it may have been read first");
        echo.replied(5);
        assert_eq!(echo.read(1), Shown::Other, "once may be a slow drive");
        echo.replied(5);
        assert_eq!(echo.read(1), Shown::Refused);
        echo.replied(5);
        assert_eq!(echo.read(1), Shown::Other, "reported once");
        assert_eq!(echo.taken(), None);
        echo.replied(7);
        assert_eq!(echo.read(7), Shown::Same);
        assert_eq!(echo.taken(), Some(7));
    }

    #[test]
    fn an_echo_in_the_answer_needs_no_reading_and_a_different_later_value_is_not_taken() {
        let mut echo = Echo::default();
        echo.confirm(5);
        assert_eq!(echo.taken(), Some(5));
        echo.confirm(5);
        assert_eq!(echo.read(4), Shown::Other);
        assert_eq!(echo.taken(), None);
    }

    #[test]
    fn a_changed_read_back_value_is_a_sign_of_another_master() {
        let mut echo = Echo::default();
        echo.replied(5);
        assert_eq!((echo.read(5), echo.read(6), echo.taken()), (Shown::Same, Shown::Changed, None));
        echo.replied(5);
        assert_eq!((echo.read(5), echo.taken()), (Shown::Same, Some(5)));
        echo.replied(6);
        assert_eq!(echo.read(5), Shown::Other, "another value has not stood yet");
        assert_eq!(echo.read(6), Shown::Same);
        echo.sent(7);
        assert_eq!(echo.read(7), Shown::Other, "our own, although its answer was lost");
    }
}
