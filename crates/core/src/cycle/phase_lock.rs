//! Steers the grid after a bus clock: a PI controller whose output is a small step of the next slot.
//! The error is what the bus reports of a slot: where its clock saw the slot, less where the slot shall be. It is
//! free of our wake-up jitter, since the bus subtracts how late its request left. A slot without an error steers
//! nothing.

/// The share of the error that one slot corrects.
const PROPORTIONAL: f64 = 0.05;
/// The share of the sum of all errors: a quarter of the square of the other, so that it settles without
/// oscillation.
const INTEGRAL: f64 = PROPORTIONAL * PROPORTIONAL / 4.0;
/// A step is at most this part of the period.
const MOST: u64 = 100;

/// Locks a grid to a reference clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct PhaseLock {
    most_ns: f64,
    /// The step per slot that compensates the drift of the two clocks, ns.
    drift_ns: f64,
    /// The rounding rest of the last step: a step is a whole number, and a drift need not be.
    owed_ns: f64,
}

impl PhaseLock {
    /// For a grid of this period.
    pub fn new(period_ns: u64) -> PhaseLock {
        PhaseLock { most_ns: (period_ns / MOST) as f64, ..PhaseLock::default() }
    }

    /// A slot came `error_ns` too late; returns the step of the next one, ns: positive steps make it later.
    pub fn step(&mut self, error_ns: i64) -> i64 {
        let (error, most) = (error_ns as f64, self.most_ns);
        let wanted = self.owed_ns - (PROPORTIONAL * error + self.drift_ns);
        let step = wanted.round().clamp(-most, most);
        if wanted.abs() < most {
            self.owed_ns = wanted - step;
            self.drift_ns = (self.drift_ns + INTEGRAL * error).clamp(-most, most);
        } else {
            // What exceeds the bound is neither summed up nor carried over.
            self.owed_ns = 0.0;
        }
        step as i64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::{MS, S, US};

    const PERIODS: [u64; 4] = [250 * US, 500 * US, MS, 4 * MS];

    /// A clock that runs next to a grid, as its bus sees it.
    #[derive(Clone, Copy)]
    struct Drifting {
        period_ns: u64,
        /// How much quicker it is than ours.
        ppm: f64,
        /// How far ahead it begins.
        phase_ns: u64,
    }

    /// A grid that follows it.
    struct Grid(PhaseLock, i64);

    impl Drifting {
        /// The error of a slot at `grid`, between half a period early and half a period late.
        fn error(self, grid: i64) -> i64 {
            let shown = grid as f64 * (1.0 + self.ppm * 1e-6) + self.phase_ns as f64;
            let period = self.period_ns as i64;
            let late = (shown.round() as i64).rem_euclid(period);
            if late > period / 2 { late - period } else { late }
        }

        /// Error and step of each slot that has a sample: what is seen of its error, `None` for nothing.
        fn lead(
            self,
            grid: &mut Grid,
            slots: u64,
            sample: impl Fn(u64, i64) -> Option<i64>,
        ) -> Vec<Option<(i64, i64)>> {
            let mut slot = |slot| {
                let error = self.error(grid.1);
                let led = sample(slot, error).map(|seen| (error, grid.0.step(seen)));
                grid.1 += self.period_ns as i64 + led.map_or(0, |(_, step)| step);
                led
            };
            (0..slots).map(&mut slot).collect()
        }

        fn run(self, slots: u64, sample: impl Fn(u64, i64) -> Option<i64>) -> Vec<Option<(i64, i64)>> {
            self.lead(&mut Grid(PhaseLock::new(self.period_ns), 0), slots, sample)
        }
    }

    fn worst(run: &[Option<(i64, i64)>]) -> u64 {
        run.iter().flatten().map(|(error, _)| error.unsigned_abs()).max().unwrap()
    }

    #[test]
    fn a_clock_that_drifts_is_followed_in_small_steps_from_any_phase() {
        for period_ns in PERIODS {
            for ppm in [-1_000.0, -100.0, -0.3, 0.0, 0.3, 100.0, 1_000.0] {
                for part in 0..20 {
                    let drifting = Drifting { period_ns, ppm, phase_ns: part * period_ns / 20 };
                    let locked = 2 * S / period_ns;
                    let run = drifting.run(2 * locked, |_, error| Some(error));
                    assert!(run.iter().flatten().all(|(_, step)| step.unsigned_abs() <= period_ns / 100));
                    let off = worst(&run[locked as usize..]);
                    assert!(off < 1_000, "{period_ns} ns, {ppm} ppm, {part}/20: {off} ns");
                }
            }
            // Slots without a sample steer nothing, and the rest still locks.
            for every in [2, 3, 17] {
                let drifting = Drifting { period_ns, ppm: 100.0, phase_ns: period_ns / 3 };
                let locked = 4 * S / period_ns;
                let run = drifting.run(2 * locked, |slot, error| (slot % every != 0).then_some(error));
                let off = worst(&run[locked as usize..]);
                assert!(off < 1_000, "{period_ns} ns, one of {every} lost: {off} ns");
            }
        }
    }

    #[test]
    fn a_drift_of_less_than_a_nanosecond_a_slot_is_followed_without_an_error() {
        // 0.3 ppm of 250 us are 0.075 ns.
        for (period_ns, ppm) in [(250 * US, 0.3), (MS, 0.1), (MS, -0.77)] {
            let run = Drifting { period_ns, ppm, phase_ns: 0 }.run(40_000, |_, error| Some(error));
            assert!(worst(&run) <= 40, "{}", worst(&run));
            let tail = &run[20_000..];
            assert!(worst(tail) <= 2, "{}", worst(tail));
            let steps: i64 = tail.iter().flatten().map(|(_, step)| step).sum();
            let expected = -ppm * 1e-6 * period_ns as f64 * tail.len() as f64;
            assert!((steps as f64 - expected).abs() < 5.0, "{steps} of {expected}");
        }
    }

    #[test]
    fn errors_out_of_reach_for_long_leave_no_correction() {
        // Far beyond what steps of a hundredth of the period can follow: the error wraps around again and again.
        // That is right.
        let mut grid = Grid(PhaseLock::new(MS), 0);
        let wild = Drifting { period_ns: MS, ppm: 50_000.0, phase_ns: 0 };
        wild.lead(&mut grid, 20_000, |_, error| Some(error));
        let run = Drifting { ppm: 100.0, ..wild }.lead(&mut grid, 4_000, |_, error| Some(error));
        assert!(worst(&run[2_000..]) < 1_000);
    }

    #[test]
    fn a_single_wrong_sample_moves_the_grid_by_no_more_than_one_step() {
        let drifting = Drifting { period_ns: MS, ppm: 20.0, phase_ns: 0 };
        for wrong in [500_000, -499_999, i64::MAX, i64::MIN] {
            let run = drifting.run(6_000, |slot, error| Some(if slot == 3_000 { wrong } else { error }));
            assert!(worst(&run[2_001..]) <= 10_100, "{wrong}: {} ns", worst(&run[2_001..]));
            assert!(worst(&run[5_999..]) < 100);
        }
    }
}
