//! Whether the replies of a drive usually come inside the window of their request.
//!
//! A Unidrive answers from a background task, often cycles later. A window that stays open for such a drive delays the
//! data of all others. So it stays open only for a drive whose replies usually come inside it, two of three at least;
//! the reply of a slow drive is taken when it comes. A reply that nobody waits for is noticed with the next cycle, so
//! that its own time is not known: a drive whose replies are always there by then is waited for again, as an attempt.

use fieldbeat_core::bus::Cycle;
use fieldbeat_core::time::Time;

/// The level of a drive that answers inside its window. From there eight late replies in a row end the waiting.
const MOST: u16 = 16;
/// A late reply outweighs so many that come inside the window.
const LATE: u16 = 2;
/// The level of an attempt: one late reply ends it.
const ATTEMPT: u16 = LATE;
/// An attempt follows so many replies in a row that are there with the next cycle. Attempts that fail in a row double
/// it ...
const LEAST_BETWEEN: u16 = 8;
/// ... up to this.
const MOST_BETWEEN: u16 = 1_024;

/// When a reply was taken in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Arrival {
    /// Inside the window of its request.
    Inside,
    /// After it, by the end of the next one.
    Soon,
    /// Later, or never.
    Late,
}

/// The estimate for one drive.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pace {
    awaited: bool,
    /// While it is awaited, a balance of its replies; else those in a row that were there with the next cycle.
    level: u16,
    between: u16,
    /// The end of the window of the open request, and of the next one.
    window_end: Time,
    next_end: Time,
}

impl Pace {
    /// The first exchange is an attempt.
    pub(super) fn new() -> Pace {
        Pace { awaited: true, level: ATTEMPT, between: LEAST_BETWEEN, window_end: Time(0), next_end: Time(0) }
    }

    /// The window of the next request stays open for its reply.
    #[inline]
    pub(super) fn awaited(&self) -> bool {
        self.awaited
    }

    /// A request was sent in this cycle.
    #[inline]
    pub(super) fn sent(&mut self, cycle: &Cycle) {
        self.window_end = cycle.deadline;
        self.next_end = cycle.deadline + cycle.period_ns;
    }

    /// The reply to it was taken in.
    #[inline]
    pub(super) fn answered(&mut self, at: Time) {
        self.ended(match at {
            _ if at <= self.window_end => Arrival::Inside,
            _ if at <= self.next_end => Arrival::Soon,
            _ => Arrival::Late,
        });
    }

    /// There will be none.
    pub(super) fn unanswered(&mut self) {
        self.ended(Arrival::Late);
    }

    #[inline]
    fn ended(&mut self, arrival: Arrival) {
        // Usually there is nothing to change.
        if arrival != Arrival::Inside || self.level != MOST || !self.awaited {
            self.learn(arrival);
        }
    }

    #[inline(never)]
    fn learn(&mut self, arrival: Arrival) {
        match (self.awaited, arrival) {
            (true, Arrival::Inside) => {
                self.level += 1;
                if self.level == MOST {
                    self.between = LEAST_BETWEEN;
                }
            }
            (true, _) => {
                self.level = self.level.saturating_sub(LATE);
                if self.level == 0 {
                    self.awaited = false;
                    self.between = (2 * self.between).min(MOST_BETWEEN);
                }
            }
            (false, Arrival::Late) => self.level = 0,
            (false, _) => {
                self.level += 1;
                if self.level >= self.between {
                    (self.awaited, self.level) = (true, ATTEMPT);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// For how many of the exchanges that end so the window stayed open.
    fn windows(pace: &mut Pace, exchanges: impl IntoIterator<Item = Arrival>) -> usize {
        let open = |arrival| {
            let awaited = pace.awaited();
            pace.ended(arrival);
            awaited
        };
        exchanges.into_iter().map(open).filter(|awaited| *awaited).count()
    }

    fn times(arrival: Arrival, count: usize) -> impl Iterator<Item = Arrival> {
        std::iter::repeat_n(arrival, count)
    }

    #[test]
    fn a_few_late_replies_change_nothing_and_many_end_it() {
        let mut pace = Pace::new();
        windows(&mut pace, times(Arrival::Inside, 20));
        for _ in 0..100 {
            // Every fourth is late.
            let round = times(Arrival::Late, 1).chain(times(Arrival::Inside, 3));
            assert_eq!(windows(&mut pace, round), 4);
        }
        windows(&mut pace, times(Arrival::Inside, 20));
        assert_eq!(windows(&mut pace, times(Arrival::Late, 100)), (MOST / LATE) as usize);
        // One of two inside the window is not usual.
        let mut pace = Pace::new();
        windows(&mut pace, times(Arrival::Inside, 20));
        let half = (0..1_000).map(|n| if n % 2 == 0 { Arrival::Late } else { Arrival::Inside });
        let open = windows(&mut pace, half);
        assert!((16..200).contains(&open), "{open}");
    }

    #[test]
    fn a_drive_that_becomes_fast_is_awaited_again_and_one_that_just_misses_its_window_rarely() {
        let mut pace = Pace::new();
        windows(&mut pace, times(Arrival::Late, 100));
        windows(&mut pace, times(Arrival::Soon, 2 * LEAST_BETWEEN as usize));
        assert_eq!(windows(&mut pace, times(Arrival::Inside, 100)), 100);
        // One that comes between two windows: an attempt now and then, at last one in a thousand.
        let mut pace = Pace::new();
        let open = windows(&mut pace, times(Arrival::Soon, 100_000));
        assert!((90..110).contains(&open), "{open}");
    }
}
