//! The time grid: `g_k = g_0 + k T`, computed and never re-based on "now".

use crate::time::Time;

/// The slot that is next to be executed, and its instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    period_ns: u64,
    origin: Time,
    at: Time,
    index: u64,
}

impl Grid {
    /// A grid whose slot 0 is at `origin`.
    pub fn new(origin: Time, period_ns: u64) -> Grid {
        Grid { period_ns: period_ns.max(1), origin, at: origin, index: 0 }
    }

    /// The current slot.
    pub fn index(&self) -> u64 {
        self.index
    }

    /// The instant of the current slot.
    pub fn at(&self) -> Time {
        self.at
    }

    /// Goes `slots` further.
    pub fn advance(&mut self, slots: u64) {
        self.index += slots;
        self.at = self.at + slots * self.period_ns;
    }

    /// How many slots, from the current one on, can no longer be executed at `now` when a slot may begin up to
    /// `tolerance_ns` late.
    pub fn passed(&self, now: Time, tolerance_ns: u64) -> u64 {
        now.since(self.at + tolerance_ns).div_ceil(self.period_ns)
    }

    /// How many slots the grid has laid out before the current one: from the instants, not from a count.
    pub fn planned(&self) -> u64 {
        self.at.since(self.origin) / self.period_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_pass_only_beyond_the_tolerance() {
        let mut grid = Grid::new(Time(1_000), 100);
        assert_eq!(grid.passed(Time(900), 0), 0);
        assert_eq!(grid.passed(Time(1_000), 0), 0);
        assert_eq!(grid.passed(Time(1_001), 0), 1);
        assert_eq!(grid.passed(Time(1_050), 50), 0);
        assert_eq!(grid.passed(Time(1_051), 50), 1);
        assert_eq!(grid.passed(Time(1_150), 50), 1);
        assert_eq!(grid.passed(Time(1_151), 50), 2);
        grid.advance(3);
        assert_eq!((grid.index(), grid.at(), grid.planned()), (3, Time(1_300), 3));
    }

    #[test]
    fn after_the_passed_slots_the_next_one_is_within_tolerance() {
        for now in (0..5_000).step_by(7) {
            for tolerance in [0, 30, 50] {
                let mut grid = Grid::new(Time(1_000), 100);
                let passed = grid.passed(Time(now), tolerance);
                grid.advance(passed);
                assert!(Time(now) <= grid.at() + tolerance);
                assert!(passed == 0 || Time(now) > grid.at() - 100 + tolerance);
            }
        }
    }
}
