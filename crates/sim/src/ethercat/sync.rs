//! Whether the cyclic interrupts of the bus are regular enough.
//!
//! Knows no state and no fault: it receives interrupts, and reports when they make the drive synchronous and when
//! no longer.
//!
//! Each interrupt is expected a cycle after the previous one. The expectation follows the bus slowly, by at most
//! 1000 ppm of a cycle, the mean deviation that the drive allows. One interrupt outside of the window is tolerated,
//! the second in a row is not (EtherCAT manual). How fast the expectation follows, and how many interrupts make the
//! drive synchronous, is assumed.

use fieldbeat_core::time::{MS, Time, US};

/// Cycles are multiples of this.
pub(super) const QUANTUM_NS: u64 = 250 * US;
/// The most of them in a cycle: PTBASE (EtherCAT manual).
pub(super) const QUANTA_MAX: u64 = 127;
/// The window either way, of cycles of 1 ms and more, and of shorter ones.
const WINDOW_NS: (u64, u64) = (320 * US, 70 * US);
/// Outside of the window in a row: no longer synchronous.
const OUTSIDE_MAX: u32 = 2;
/// The part of a deviation that the expectation follows.
const FOLLOWS: i64 = 8;
/// Most that it follows: this part of a cycle.
const DRIFT: i64 = 1_000;

/// The synchronisation of one drive.
#[derive(Debug, Default)]
pub(super) struct Sync {
    needed: u32,
    /// `None`: there is no valid cycle time, or no interrupts are wanted.
    pub(super) cycle_ns: Option<u64>,
    /// The cycle is found by the interrupts themselves: when the last one came.
    measures: Option<Time>,
    /// When the next interrupt is due.
    expected: Option<Time>,
    inside: u32,
    outside: u32,
    /// The one before the expected one has not come yet.
    owed: bool,
    pub(super) synchronous: bool,
}

impl Sync {
    /// Without a cycle.
    pub(super) fn new(needed: u32) -> Sync {
        Sync { needed, ..Sync::default() }
    }

    /// Interrupts come from now on, so many ns apart; `None`: none, or none that could be followed.
    pub(super) fn start(&mut self, cycle_ns: Option<u64>) {
        *self = Sync { cycle_ns, ..Sync::new(self.needed) };
    }

    /// Interrupts come from now on; the first two give the cycle, which no object has set.
    pub(super) fn measure(&mut self) {
        *self = Sync { measures: Some(Time(0)), ..Sync::new(self.needed) };
    }

    fn window_ns(cycle_ns: u64) -> u64 {
        if cycle_ns >= MS { WINDOW_NS.0 } else { WINDOW_NS.1 }
    }

    /// Counts interrupts that were due by `now` as missing. True if the drive is no longer synchronous.
    #[must_use]
    pub(super) fn pass(&mut self, now: Time) -> bool {
        let Some(cycle_ns) = self.cycle_ns else { return false };
        while let Some(expected) = self.expected
            && now > expected + Sync::window_ns(cycle_ns)
        {
            self.expected = Some(expected + cycle_ns);
            self.owed = true;
            if self.miss() {
                return true;
            }
        }
        false
    }

    /// An interrupt comes. True if the drive is no longer synchronous.
    #[must_use]
    pub(super) fn interrupt(&mut self, now: Time) -> bool {
        if self.cycle_ns.is_none()
            && let Some(last) = self.measures
        {
            self.measures = Some(now);
            let quanta = (now.since(last) + QUANTUM_NS / 2) / QUANTUM_NS;
            self.cycle_ns = (1..=QUANTA_MAX).contains(&quanta).then_some(quanta * QUANTUM_NS);
        }
        let Some(cycle_ns) = self.cycle_ns else { return false };
        if self.pass(now) {
            return true;
        }
        let cycle = cycle_ns as i64;
        let Some(expected) = self.expected else {
            (self.expected, self.inside) = (Some(now + cycle_ns), 1);
            return false;
        };
        let late = (now.0 as i64).wrapping_sub(expected.0 as i64);
        let shift = |by: i64| Time((expected.0 as i64).saturating_add(by) as u64);
        if late.unsigned_abs() <= Sync::window_ns(cycle_ns) {
            let most = cycle / DRIFT;
            self.expected = Some(shift(cycle + (late / FOLLOWS).clamp(-most, most)));
            (self.outside, self.owed) = (0, false);
            self.inside = self.inside.saturating_add(1);
            self.synchronous |= self.inside >= self.needed;
            return false;
        }
        // Too early, since late ones were passed above. It may be the one that was passed.
        if std::mem::take(&mut self.owed) {
            return false;
        }
        if late >= -cycle / 2 {
            self.expected = Some(shift(cycle));
        }
        self.miss()
    }

    /// One is outside of the window. True if the drive is no longer synchronous.
    fn miss(&mut self) -> bool {
        self.inside = 0;
        self.outside += 1;
        if self.synchronous && self.outside < OUTSIDE_MAX {
            return false;
        }
        let was = self.synchronous;
        (self.synchronous, self.expected, self.outside, self.owed) = (false, None, 0, false);
        self.cycle_ns = self.cycle_ns.filter(|_| self.measures.is_none());
        was
    }
}

#[cfg(test)]
mod tests {

    use super::*;

    const NEEDED: u32 = 20;

    /// Interrupts at these instants; whether it ended synchronous, and how often that was lost.
    fn run(cycle_ns: u64, instants: impl IntoIterator<Item = u64>) -> (bool, u32) {
        let mut sync = Sync::new(NEEDED);
        sync.start(Some(cycle_ns));
        let lost = instants.into_iter().filter(|at| sync.interrupt(Time(*at))).count();
        (sync.synchronous, lost as u32)
    }

    /// So many instants of a regular cycle, each moved by `jitter(index)` ns.
    fn cycle(cycle_ns: u64, count: u64, jitter: impl Fn(u64) -> i64) -> Vec<u64> {
        (0..count).map(|index| (1_000 * MS + index * cycle_ns).saturating_add_signed(jitter(index))).collect()
    }

    #[test]
    fn enough_regular_interrupts_of_its_cycle_make_it_synchronous_and_1000_ppm_off_keep_it_so() {
        let count = u64::from(NEEDED);
        let drift = |ppm: i64| move |index: u64| index as i64 * ppm;
        assert_eq!(run(MS, cycle(MS, count - 1, |_| 0)), (false, 0));
        assert_eq!(run(MS, cycle(MS, count, |_| 0)), (true, 0));
        assert_eq!(run(MS, cycle(2 * MS, 200, |_| 0)), (false, 0));
        assert_eq!(run(2 * MS, cycle(MS, 200, |_| 0)), (false, 0));
        assert_eq!(run(MS, cycle(MS, 5_000, drift(900))), (true, 0));
        assert_eq!(run(MS, cycle(MS, 5_000, drift(-900))), (true, 0));
        assert!(run(MS, cycle(MS, 5_000, drift(2_000))).1 > 0);
        let mut sync = Sync::new(NEEDED);
        assert!(!sync.interrupt(Time(0)) && !sync.synchronous, "without a cycle time there is none");
    }

    #[test]
    fn one_outside_the_window_of_the_sheet_is_forgiven_and_two_in_a_row_are_not() {
        for (cycle_ns, inside, outside) in [(MS, 300, 330), (4 * MS, 300, 330), (750 * US, 65, 80)] {
            for (count, by, synchronous, lost) in [
                (2, inside, true, 0),
                (2, outside, false, 1),
                (2, -outside, false, 1),
                (1, outside, true, 0),
                (1, -outside, true, 0),
                (1, (cycle_ns / US * 6 / 10) as i64, true, 0),
            ] {
                let late = |index| if (50..50 + count).contains(&index) { by * US as i64 } else { 0 };
                let run = run(cycle_ns, cycle(cycle_ns, 60, late));
                assert_eq!(run.1, lost, "{cycle_ns}: {count} by {by} us");
                assert!(!synchronous || run.0, "{cycle_ns}: {count} by {by} us");
            }
            // Whether they come outside, or not at all.
            for count in [1, 2] {
                let instants = cycle(cycle_ns, 60, |_| 0).into_iter().enumerate();
                let missing = instants.filter(|(index, _)| !(50..50 + count).contains(index));
                assert_eq!(run(cycle_ns, missing.map(|(_, at)| at)).1, u32::from(count == 2));
            }
        }
    }

    #[test]
    fn a_cycle_that_ends_is_noticed_without_an_interrupt() {
        let mut sync = Sync::new(NEEDED);
        sync.start(Some(MS));
        let instants = cycle(MS, 30, |_| 0);
        assert!(instants.iter().all(|at| !sync.interrupt(Time(*at))));
        let last = Time(instants[29]);
        assert!(!sync.pass(last + MS + 320 * US), "the window of the first is still open");
        assert!(!sync.pass(last + 2 * MS + 320 * US));
        assert!(sync.pass(last + 2 * MS + 321 * US));
        assert!(!sync.synchronous);
        assert!(!sync.pass(last + 10 * MS), "it is lost once");
    }
}
