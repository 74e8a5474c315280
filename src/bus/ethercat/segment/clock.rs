//! The time of the segment: that of its reference, the first slave with a clock, and the distance of the grid from
//! it.
//! SYNC0 comes at whole periods of that time, and a slot of the grid shall be a fixed time before it. So the master
//! knows what the reference should show whenever a frame passes it: `slot * T + target + (sent - g_k)`. The time
//! shown instead, less that, is the phase error: our own wake-up jitter is not part of it. Clocks of 32 bits wrap
//! context every 4.3 s; since the error is small against that, it is the difference of the lower halves.

use crate::bus::{BusClock, Cycle};
use crate::time::{MS, Time, US};

/// A drive tolerates cycles that are off by so much, at a period of 1 ms and above, and below (EtherCAT manual).
const WINDOW_NS: i64 = 320 * US as i64;
const WINDOW_SHORT_NS: i64 = 70 * US as i64;
/// A clock is adjusted by this part of the time at most: half of what a drive tolerates for a cycle that is off all
/// the time (EtherCAT manual).
const SLEW: u64 = 2_000;
/// Approximate begin of the segment's time: above any error of a clock of 32 bits.
const ORIGIN_NS: u64 = 1 << 36;
/// Times that differ by at most this part of the window are the same.
const SAME: i64 = 4;
/// So many samples in a row inside of half of the window are a lock: the other half is for the jitter of the
/// frames.
const SAMPLES: u32 = 64;

/// The relation of the grid and the segment's time.
#[derive(Clone, Copy, Debug, Default)]
pub struct SegmentClock {
    /// The period, ns.
    pub period_ns: u64,
    /// Its intended value at slot 0 of the grid.
    origin_ns: u64,
    /// The offset of SYNC0 in the periods of the segment's time.
    pub phase_ns: u64,
    window_ns: i64,
    error_ns: i64,
    /// The newest error was not returned yet.
    new: bool,
    /// A sample was taken since the reference was found.
    pub seen: bool,
    /// The part of the reference's distance from the grid that it has not been adjusted by yet.
    slew_ns: i64,
    good: u32,
    /// It was locked once, and the largest error since.
    was_locked: bool,
    error_max_ns: u64,
}

/// The deviation that a drive's cycles may have, ns.
pub const fn window_ns(period_ns: u64) -> i64 {
    if period_ns >= MS { WINDOW_NS } else { WINDOW_SHORT_NS }
}

impl SegmentClock {
    /// A grid of this period, whose slots shall be so long before SYNC0.
    pub fn new(period_ns: u64, ahead_ns: u64) -> SegmentClock {
        let target = period_ns - ahead_ns % period_ns;
        SegmentClock {
            period_ns,
            // Far from zero: a clock that is found running may be anywhere context it.
            origin_ns: ORIGIN_NS.next_multiple_of(period_ns) + target,
            window_ns: window_ns(period_ns),
            ..SegmentClock::default()
        }
    }

    /// The intended segment time at `at`, seen from the slot of `cycle`.
    pub fn time(&self, cycle: &Cycle, at: Time) -> u64 {
        let slot = cycle.index.wrapping_mul(self.period_ns).wrapping_add(self.origin_ns);
        slot.wrapping_add(at.0).wrapping_sub(cycle.grid.0)
    }

    /// The reference's time at `at`, as far as is known: the intended one, and the newest error.
    pub fn shows(&self, cycle: &Cycle, at: Time) -> u64 {
        self.time(cycle, at).wrapping_add(self.error_ns as u64)
    }

    /// A slave that showed `time` when a frame sent at `at` passed it runs on this time.
    pub fn is_time_of(&self, cycle: &Cycle, at: Time, time: u32) -> bool {
        let off = time.wrapping_sub(self.shows(cycle, at) as u32) as i32;
        i64::from(off).abs() <= self.window_ns / SAME
    }

    /// A running slave showed `time`: the segment's time is its time from now on, with SYNC0 where that slave has
    /// it, if that is known.
    pub fn take_over(&mut self, cycle: &Cycle, at: Time, time: u32, phase_ns: Option<u64>) {
        if let Some(phase_ns) = phase_ns {
            self.origin_ns = self.origin_ns.wrapping_sub(self.phase_ns).wrapping_add(phase_ns);
            self.phase_ns = phase_ns;
        }
        let (off, error) = self.off(cycle, at, time);
        self.take_whole(off, error);
        self.error_ns = error;
    }

    /// The distance of `time` from its intended value; and the same without whole periods, the phase error.
    fn off(&self, cycle: &Cycle, at: Time, time: u32) -> (i64, i64) {
        let period = self.period_ns as i64;
        let off = i64::from(time.wrapping_sub(self.time(cycle, at) as u32) as i32);
        (off, (off + period / 2).rem_euclid(period) - period / 2)
    }

    /// Whole periods of a time that another master has set are no error.
    fn take_whole(&mut self, off: i64, error: i64) {
        self.origin_ns = self.origin_ns.wrapping_add((off - error) as u64);
    }

    /// The time sent at `at` to a reference that follows: the segment's time, once the reference has been adjusted
    /// to it. A clock from which drives make SYNC0 must not be adjusted faster than they tolerate.
    pub fn sent_time(&self, cycle: &Cycle, at: Time) -> u64 {
        self.time(cycle, at).wrapping_add(self.slew_ns as u64)
    }

    /// A slot has passed: the reference is adjusted further.
    pub fn lead_on(&mut self) {
        let most = (self.period_ns / SLEW) as i64;
        self.slew_ns -= self.slew_ns.clamp(-most, most);
    }

    /// The first SYNC0 that is not before `ns`, by the segment's time.
    pub fn sync_from(&self, ns: u64) -> u64 {
        let since = ns.wrapping_sub(self.phase_ns);
        since.div_ceil(self.period_ns).wrapping_mul(self.period_ns).wrapping_add(self.phase_ns)
    }

    /// A reference was found, or lost.
    pub fn forget(&mut self) {
        (self.seen, self.good, self.new, self.was_locked) = (false, 0, false, false);
    }

    /// The reference showed `time` as the frame of `cycle`, sent at `sent_at`, passed it.
    pub fn sample(&mut self, cycle: &Cycle, sent_at: Time, time: u32) {
        let (off, error) = self.off(cycle, sent_at, time);
        if !std::mem::replace(&mut self.seen, true) {
            self.take_whole(off, error);
            self.slew_ns = error;
        }
        (self.error_ns, self.new) = (error, true);
        self.good = if error.abs() <= self.window_ns / 2 { self.good.saturating_add(1) } else { 0 };
        self.was_locked |= self.is_locked();
        if self.was_locked {
            self.error_max_ns = self.error_max_ns.max(error.unsigned_abs());
        }
    }

    /// Distance of the newest slot from where the drives want it, ns: positive is late; `None`: the reference was
    /// not seen.
    pub fn error_ns(&self) -> Option<i64> {
        self.seen.then_some(self.error_ns)
    }

    /// The relation of it and the grid.
    pub fn status(&self) -> BusClock {
        BusClock {
            error_ns: self.error_ns(),
            locked: self.is_locked(),
            error_max_ns: self.error_max_ns,
            window_ns: self.window_ns.unsigned_abs(),
        }
    }

    /// An error that was not returned by now is old.
    pub fn pass(&mut self) {
        self.new = false;
    }

    /// The newest error, once: positive is late.
    pub fn take_error(&mut self) -> Option<i64> {
        std::mem::take(&mut self.new).then_some(self.error_ns)
    }

    /// The grid is where the drives want it.
    pub fn is_locked(&self) -> bool {
        self.good >= SAMPLES
    }
}

/// How much later than the reference a slave receives: half of the difference of the times that a frame is under
/// way behind each of them. `loop_ns`: from the first port to the last one, 0 of the last slave; forwarding through
/// a slave counts as cable.
pub fn delay_ns(reference_loop_ns: u32, loop_ns: u32) -> u32 {
    reference_loop_ns.saturating_sub(loop_ns) / 2
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cycle(index: u64) -> Cycle {
        let grid = Time(7_777_777 + index * MS);
        Cycle { index, grid, period_ns: MS, deadline: grid + MS / 2 }
    }

    #[test]
    fn a_slot_stands_so_long_before_sync0_whatever_the_jitter() {
        let mut clock = SegmentClock::new(MS, 400 * US);
        for (index, late, off) in [(0, 0, 0), (1, 90_000, 0), (2, 3_000, 5_000), (3, 0, -70_000)] {
            let cycle = cycle(index);
            let sent_at = cycle.grid + late;
            let shown = clock.time(&cycle, sent_at) as i64 + off;
            let ahead = clock.sync_from(shown as u64 - late) as i64 - (shown - late as i64);
            assert_eq!(ahead, 400_000 - off);
            clock.sample(&cycle, sent_at, shown as u32);
            assert_eq!((clock.take_error(), clock.take_error()), (Some(off), None));
        }
    }

    #[test]
    fn a_clock_of_32_bits_goes_round_without_a_leap() {
        let mut clock = SegmentClock::new(MS, 500 * US);
        for index in (0..20_000).step_by(7) {
            let cycle = cycle(index);
            clock.sample(&cycle, cycle.grid, (clock.time(&cycle, cycle.grid) + 1_234) as u32);
            assert_eq!(clock.take_error(), Some(1_234));
        }
    }

    #[test]
    fn whole_periods_of_a_clock_that_others_have_set_are_no_error() {
        let mut clock = SegmentClock::new(MS, 500 * US);
        let wanted = clock.time(&cycle(0), cycle(0).grid);
        clock.sample(&cycle(0), cycle(0).grid, (wanted + 123 * MS + 20 * US) as u32);
        assert_eq!(clock.take_error(), Some(20_000));
        assert_eq!(clock.time(&cycle(0), cycle(0).grid), wanted + 123 * MS);
    }

    #[test]
    fn a_time_that_is_lent_is_the_lines_and_no_other_one_is() {
        let mut clock = SegmentClock::new(MS, 500 * US);
        let own = clock.time(&cycle(0), cycle(0).grid);
        for (time, phase) in [(7_u32, None), (3_999_999_999, Some(250 * US)), (123, Some(0))] {
            clock.take_over(&cycle(5), cycle(5).grid, time, phase);
            let shows = clock.shows(&cycle(6), cycle(6).grid);
            assert_eq!(shows as u32, time.wrapping_add(MS as u32));
            assert!(shows.abs_diff(own) < 1 << 33, "far from zero");
            let same = |off: u32| clock.is_time_of(&cycle(5), cycle(5).grid, time.wrapping_add(off));
            assert!(same(0) && same(80_000) && same(80_000_u32.wrapping_neg()));
            assert!(!same(81_000) && !same(MS as u32) && !same(u32::MAX / 2));
            assert_eq!(clock.phase_ns, phase.unwrap_or(0));
        }
        assert!(!clock.seen && clock.take_error().is_none(), "that is not the reference's");
    }

    #[test]
    fn it_is_locked_after_so_many_good_samples_and_a_bad_one_starts_over() {
        let mut clock = SegmentClock::new(250 * US, 100 * US);
        let mut feed = |off: u64, count: u64| {
            for index in 0..count {
                let cycle = Cycle { period_ns: 250 * US, ..cycle(index) };
                clock.sample(&cycle, cycle.grid, (clock.time(&cycle, cycle.grid) + off) as u32);
            }
            clock.is_locked()
        };
        assert!(!feed(0, 63) && feed(34_000, 1));
        assert!(!feed(36_000, 1) && !feed(0, 63) && feed(0, 1));
    }

    #[test]
    fn the_largest_error_counts_from_the_first_lock_on() {
        let mut clock = SegmentClock::new(MS, 500 * US);
        let mut index = 0;
        let mut feed = |clock: &mut SegmentClock, off: i64, count: u64| {
            for _ in 0..count {
                index += 1;
                let cycle = cycle(index);
                let shown = clock.time(&cycle, cycle.grid).wrapping_add_signed(off);
                clock.sample(&cycle, cycle.grid, shown as u32);
            }
            clock.status()
        };
        let status = BusClock { error_ns: None, locked: false, error_max_ns: 0, window_ns: 320_000 };
        assert_eq!(clock.status(), status);
        assert_eq!(feed(&mut clock, 300_000, 1), BusClock { error_ns: Some(300_000), ..status });
        let locked = BusClock { error_ns: Some(-7_000), locked: true, error_max_ns: 7_000, ..status };
        assert_eq!(feed(&mut clock, -7_000, 64), locked);
        let lost = BusClock { error_ns: Some(-200_000), locked: false, error_max_ns: 200_000, ..status };
        assert_eq!(feed(&mut clock, -200_000, 1), lost);
        clock.forget();
        assert_eq!(clock.status(), BusClock { error_ns: None, ..lost });
    }

    #[test]
    fn delays_add_up_along_the_line() {
        assert_eq!([3_000, 2_000, 1_000, 0].map(|own| delay_ns(3_000, own)), [0, 500, 1_000, 1_500]);
        assert_eq!(delay_ns(0, 40), 0, "no slave is behind the reference");
    }
}
