//! How long before a grid point the loop wakes to spin up to it: a fixed time, or one learned from how late this
//! machine's sleeps really end.
//!
//! Knows no period but the number that it is given and no clock but the one passed to it, so it is tested in
//! virtual time.

use super::Clock;
use crate::time::MS;

/// The share of wake-ups that may come later than the guard. One in a thousand: the spin is paid for in every cycle,
/// and the last thousandth costs more than all the others together.
const LATE_SHARE: f64 = 0.001;

/// The factor by which one late wake-up raises the guard. A shift of the latencies to the double is followed after
/// ln 2 / ln 1.05 = 15 late wake-ups; a single outlier, however large, moves the guard by one twentieth.
const STEP: f64 = 0.05;

/// The shortest learned guard, ns. About the shortest wake-up of any machine; it also keeps the steps, which are
/// shares of the guard, from vanishing at zero.
const FLOOR_NS: f64 = 1_000.0;

/// The longest that calibration may take, ns.
const CALIBRATION_NS: u64 = 100 * MS;

/// The guard, and what it learns from.
///
/// Constant time and memory: each wake-up later than the guard raises it by a twentieth, each other one lowers it by
/// the 999th part of that, so that it rests where one in a thousand comes later (a stochastic approximation of the 99.9
/// % quantile, with steps in proportion as latencies span decades).
#[derive(Clone, Debug)]
pub struct GuardTuner {
    guard_ns: f64,
    /// The longest learned guard; `None` = a fixed one.
    limit_ns: Option<f64>,
}

impl GuardTuner {
    /// A guard of `ns` nanoseconds, for good; 0 = no spin.
    pub fn fixed(ns: u64) -> GuardTuner {
        GuardTuner { guard_ns: ns as f64, limit_ns: None }
    }

    /// A learned guard for cycles of `period_ns`, at most a quarter of it: larger latencies have to be fixed in the
    /// host, not spun away.
    pub fn auto(period_ns: u64) -> GuardTuner {
        let limit_ns = (period_ns / 4) as f64;
        GuardTuner { guard_ns: FLOOR_NS.min(limit_ns), limit_ns: Some(limit_ns) }
    }

    /// The guard, ns.
    pub fn guard_ns(&self) -> u64 {
        self.guard_ns as u64
    }

    /// A first guess from up to `sleeps` short sleeps, within 100 ms and the last sleep; 200 sleeps are plenty. To be
    /// called on the loop's thread once it has its core and priority. A fixed guard is left alone.
    ///
    /// The guess is the second longest wake-up latency, so that one outlier at the start does not make it. It tends to
    /// be short: a core that sleeps only half a millisecond does not reach its deepest idle state.
    /// [`observe`](Self::observe) makes up for that.
    pub fn calibrate(&mut self, clock: &mut dyn Clock, sleeps: u32) {
        if self.limit_ns.is_none() || sleeps == 0 {
            return;
        }
        let interval_ns = CALIBRATION_NS / u64::from(sleeps);
        let begin = clock.now();
        let (mut longest, mut second) = (0, 0);
        for _ in 0..sleeps {
            let at = clock.now() + interval_ns;
            clock.sleep_until(at);
            let now = clock.now();
            let latency = now.since(at);
            second = second.max(latency.min(longest));
            longest = longest.max(latency);
            // Sleeps that end late must not add up.
            if now.since(begin) >= CALIBRATION_NS {
                break;
            }
        }
        self.set(second as f64);
    }

    /// Learns from one more sleep of the loop: how much later than requested it ended, ns. Constant time, no system
    /// call.
    #[inline]
    pub fn observe(&mut self, wake_latency_ns: u64) {
        if self.limit_ns.is_none() {
            return;
        }
        let factor = if wake_latency_ns as f64 > self.guard_ns {
            1.0 + STEP
        } else {
            1.0 - STEP * LATE_SHARE / (1.0 - LATE_SHARE)
        };
        self.set(self.guard_ns * factor);
    }

    fn set(&mut self, guard_ns: f64) {
        if let Some(limit_ns) = self.limit_ns {
            self.guard_ns = guard_ns.max(FLOOR_NS).min(limit_ns);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rt::PollSet;
    use crate::time::{Time, US};

    /// A clock whose sleeps end late by what a closure says.
    struct LateClock<F> {
        now: Time,
        late: F,
    }

    impl<F: FnMut() -> u64 + Send> Clock for LateClock<F> {
        fn now(&mut self) -> Time {
            self.now
        }
        fn sleep_until(&mut self, at: Time) {
            self.now = self.now.max(at + (self.late)());
        }
        fn wait(&mut self, _: &mut PollSet, until: Time) -> bool {
            self.sleep_until(until);
            false
        }
        fn spin(&mut self) {
            self.now = self.now + 1;
        }
    }

    /// Latencies of an exponential tail: its quantile p is `mean * -ln(1 - p)`.
    fn exponential(rng: &mut fastrand::Rng, mean_ns: f64) -> u64 {
        (-mean_ns * (1.0 - rng.f64()).ln()) as u64
    }

    fn late_share(tuner: &mut GuardTuner, rng: &mut fastrand::Rng, mean_ns: f64, cycles: u32) -> f64 {
        let mut late = 0;
        for _ in 0..cycles {
            let latency = exponential(rng, mean_ns);
            late += u32::from(latency > tuner.guard_ns());
            tuner.observe(latency);
        }
        f64::from(late) / f64::from(cycles)
    }

    #[test]
    fn fixed_is_fixed() {
        assert_eq!(GuardTuner::fixed(0).guard_ns(), 0);
        let mut tuner = GuardTuner::fixed(50 * US);
        tuner.calibrate(&mut LateClock { now: Time(0), late: || MS }, 200);
        tuner.observe(MS);
        assert_eq!(tuner.guard_ns(), 50 * US);
    }

    #[test]
    fn rests_where_one_in_a_thousand_is_late() {
        let mut rng = fastrand::Rng::with_seed(1);
        let mut tuner = GuardTuner::auto(MS);
        late_share(&mut tuner, &mut rng, 5_000.0, 100_000);
        let share = late_share(&mut tuner, &mut rng, 5_000.0, 1_000_000);
        assert!((0.0008..0.0013).contains(&share), "{share}");
        // The 99.9 % quantile of the tail is 6.9 times its mean.
        assert!((25 * US..50 * US).contains(&tuner.guard_ns()), "{}", tuner.guard_ns());
    }

    #[test]
    fn follows_a_shift_fast_upwards_and_slowly_downwards() {
        let mut rng = fastrand::Rng::with_seed(2);
        let mut tuner = GuardTuner::auto(4 * MS);
        late_share(&mut tuner, &mut rng, 2_000.0, 100_000);
        let quiet = tuner.guard_ns();
        // The host got ten times worse: with most wake-ups late at first, two seconds at 1 kHz bring it most of the
        // way.
        late_share(&mut tuner, &mut rng, 20_000.0, 2_000);
        assert!(tuner.guard_ns() > 4 * quiet, "{quiet} -> {}", tuner.guard_ns());
        late_share(&mut tuner, &mut rng, 2_000.0, 1_000);
        assert!(tuner.guard_ns() > 3 * quiet, "forgot the storm within a second");
        late_share(&mut tuner, &mut rng, 2_000.0, 100_000);
        assert!(tuner.guard_ns() < 2 * quiet, "{quiet} -> {}", tuner.guard_ns());
    }

    #[test]
    fn never_leaves_its_bounds() {
        let mut tuner = GuardTuner::auto(MS);
        for _ in 0..1_000 {
            tuner.observe(u64::MAX);
            assert!(tuner.guard_ns() <= 250 * US);
        }
        assert_eq!(tuner.guard_ns(), 250 * US);
        for _ in 0..1_000_000 {
            tuner.observe(0);
        }
        assert_eq!(tuner.guard_ns(), FLOOR_NS as u64);
        // A period so short that the limit lies below the floor: the limit holds.
        let mut tuner = GuardTuner::auto(2_000);
        tuner.observe(US);
        assert!(tuner.guard_ns() <= 500);
    }

    #[test]
    fn calibrates_on_the_second_longest_and_in_bounded_time_and_one_outlier_moves_it_by_a_twentieth() {
        let mut tuner = GuardTuner::auto(MS);
        tuner.calibrate(&mut LateClock { now: Time(0), late: || 20 * US }, 200);
        tuner.observe(10 * MS);
        assert!(tuner.guard_ns() <= 21 * US, "{}", tuner.guard_ns());
        let mut latencies = [9, 80, 7, 3_000, 8].into_iter().cycle();
        let mut clock = LateClock { now: Time(0), late: || latencies.next().unwrap_or(0) * US };
        let mut tuner = GuardTuner::auto(MS);
        tuner.calibrate(&mut clock, 5);
        assert_eq!(tuner.guard_ns(), 80 * US);

        // Every sleep ends 7 ms late: it gives up after 100 ms and the sleep that passes them.
        let mut clock = LateClock { now: Time(0), late: || 7 * MS };
        tuner.calibrate(&mut clock, 200);
        assert!(clock.now <= Time(CALIBRATION_NS + 8 * MS), "{}", clock.now);
        assert_eq!(tuner.guard_ns(), 250 * US);
    }
}
