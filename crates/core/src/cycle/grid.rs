//! The time grid: `g_k = g_(k-1) + T + c_k`, computed and never re-based on "now". `c_k` is 0 unless another clock
//! leads the grid.

use crate::time::Time;

/// The slot that is next to be executed, and its instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    period_ns: u64,
    origin: Time,
    at: Time,
    index: u64,
    /// The step of the next slot, ns.
    step_ns: i64,
    /// All steps so far, ns.
    steered_ns: i64,
}

impl Grid {
    /// A grid whose slot 0 is at `origin`.
    pub fn new(origin: Time, period_ns: u64) -> Grid {
        Grid { period_ns: period_ns.max(1), origin, at: origin, index: 0, step_ns: 0, steered_ns: 0 }
    }

    /// The current slot.
    pub fn index(&self) -> u64 {
        self.index
    }

    /// The instant of the current slot.
    pub fn at(&self) -> Time {
        self.at
    }

    /// Sets the next slot to a period and `step_ns` after the current one; all later ones follow.
    pub fn steer(&mut self, step_ns: i64) {
        self.step_ns = step_ns;
    }

    /// The instant of the next slot.
    pub fn next_at(&self) -> Time {
        shifted(self.at + self.period_ns, self.step_ns)
    }

    /// Goes `slots` further, at least one.
    pub fn advance(&mut self, slots: u64) {
        self.index += slots;
        let step_ns = std::mem::take(&mut self.step_ns);
        self.at = shifted(self.at + slots * self.period_ns, step_ns);
        self.steered_ns += step_ns;
    }

    /// How many slots, from the current one on, can no longer be executed at `now` if a slot may begin up to
    /// `tolerance_ns` late.
    pub fn passed(&self, now: Time, tolerance_ns: u64) -> u64 {
        match now.since(self.at + tolerance_ns) {
            // Without a division in the usual cycle.
            0 => 0,
            late_ns => late_ns.div_ceil(self.period_ns),
        }
    }

    /// How many slots the grid has laid out before the current one: from the instants and the steps, not from a
    /// count.
    pub fn planned(&self) -> u64 {
        shifted(self.at, -self.steered_ns).since(self.origin) / self.period_ns
    }
}

fn shifted(at: Time, by_ns: i64) -> Time {
    Time(at.0.saturating_add_signed(by_ns))
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
    fn a_step_moves_the_next_slot_and_all_behind_it_and_no_count() {
        let mut grid = Grid::new(Time(1_000), 100);
        let (mut at, mut slots) = (1_000, 0);
        for (step, skipped) in [(0, 0), (1, 0), (-1, 3), (-1, 0), (1, 1), (-1, 40), (-1, 0)] {
            grid.steer(step);
            let next = grid.next_at();
            grid.advance(1);
            assert_eq!(grid.at(), next);
            // Slots that are passed over have no step of their own.
            grid.advance(skipped);
            (at, slots) = (at + (1 + skipped as i64) * 100 + step, slots + 1 + skipped);
            assert_eq!((grid.at(), grid.index(), grid.planned()), (Time(at as u64), slots, slots));
        }
        assert_eq!(at, 1_000 + 51 * 100 - 2, "the steps are included");
    }
}
