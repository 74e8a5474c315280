//! The time of the segment: that of its reference, the first slave with a clock, and the distance of the grid from
//! it.
//! SYNC0 comes at whole periods of that time, and a slot of the grid shall be a fixed time before it. So the master
//! knows what the reference should show whenever a frame passes it: `slot * T + target + (sent - g_k)`. The time
//! shown instead, less that, is the phase error: our own wake-up jitter is not part of it. Clocks of 32 bits wrap
//! around every 4.3 s; since the error is small against that, it is the difference of the lower halves.
//!
//! On a busy host frames leave late after they were stamped, several in a row, and show a time that is late by as
//! much. So no single sample decides: the segment's time is the median of the first ones, and the lock is that of the
//! majority. While it is locked, a sample far off steers nothing, and no time is sent until the next one is in
//! place: late frames come in bursts, and a clock that is sent late times follows their mean.

use fieldbeat_core::bus::{BusClock, Cycle};
use fieldbeat_core::time::{MS, Time, US};

/// A drive tolerates cycles that are off by so much, at a period of 1 ms and above, and below (EtherCAT manual).
const WINDOW_NS: i64 = 320 * US as i64;
const WINDOW_SHORT_NS: i64 = 70 * US as i64;
/// A clock is adjusted by this part of the time at most: half of what a drive tolerates for a cycle that is off all
/// the time (EtherCAT manual).
const SLEW: u64 = 2_000;
/// The least begin of the segment's time, which is the date (ns since 2000-01-01): above any error of 32-bit clocks.
const ORIGIN_NS: u64 = 1 << 36;
/// Times that differ by at most this part of the window are the same.
const SAME: i64 = 4;
/// The excess of samples inside of half of the window over those outside that is a lock, which is lost when as many
/// more were outside: the other half is for the jitter of the frames.
const SAMPLES: u8 = 64;
/// The samples whose median is the first one.
const FIRST: usize = 15;

/// The relation of the grid and the segment's time.
#[derive(Clone, Copy, Debug, Default)]
pub struct SegmentClock {
    /// The period, ns.
    pub period_ns: u64,
    /// The intended value at slot 0 of the grid.
    origin_ns: u64,
    /// The offset of SYNC0 in the periods of the segment's time.
    pub phase_ns: u64,
    window_ns: i64,
    error_ns: i64,
    /// The newest error was not returned yet.
    new: bool,
    /// The first samples since the reference was found, and how many there are.
    first: [i32; FIRST],
    firsts: u8,
    /// The newest sample was far off, or missing.
    held: bool,
    /// The part of the reference's distance from the grid that it has not been adjusted by yet.
    slew_ns: i64,
    /// How many more samples were inside of half of the window than outside, from 0 on, up to a lock.
    good: u8,
    locked: bool,
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
            // Far from zero: a clock that is found running may be anywhere around it.
            origin_ns: ORIGIN_NS.next_multiple_of(period_ns) + target,
            window_ns: window_ns(period_ns),
            ..SegmentClock::default()
        }
    }

    /// The value at slot 0 is about `today_ns`, the date, unless the date is not known to the computer.
    pub fn begin(&mut self, today_ns: u64) {
        let target = self.origin_ns % self.period_ns;
        self.origin_ns = today_ns.max(ORIGIN_NS).next_multiple_of(self.period_ns) + target;
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

    /// A running slave showed `time`: the segment's time is its time from now on. Its clock is not adjusted, since that
    /// would take up to a thousand cycles: SYNC0 of all others comes where the grid wants it.
    pub fn take_over(&mut self, cycle: &Cycle, at: Time, time: u32) {
        let (off, _) = self.off(cycle, at, time);
        self.origin_ns = self.origin_ns.wrapping_add_signed(off);
        self.phase_ns =
            self.phase_ns.wrapping_add_signed(off.rem_euclid(self.period_ns as i64)) % self.period_ns;
        self.error_ns = 0;
    }

    /// The distance of `time` from its intended value; and the same without whole periods, the phase error.
    fn off(&self, cycle: &Cycle, at: Time, time: u32) -> (i64, i64) {
        let off = i64::from(time.wrapping_sub(self.time(cycle, at) as u32) as i32);
        (off, self.phase(off))
    }

    #[inline]
    fn phase(&self, off: i64) -> i64 {
        let period = self.period_ns as i64;
        let ahead = off + period / 2;
        // Usually there is no whole one.
        if (0..period).contains(&ahead) { off } else { ahead.rem_euclid(period) - period / 2 }
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
        (self.firsts, self.good, self.new, self.held) = (0, 0, false, false);
        (self.locked, self.was_locked) = (false, false);
    }

    /// Enough samples were taken since the reference was found.
    fn is_seen(&self) -> bool {
        usize::from(self.firsts) == FIRST
    }

    /// The time is sent to a reference that follows.
    pub fn is_sent(&self) -> bool {
        self.is_seen() && !self.held
    }

    /// A frame did not come back in its time.
    pub fn miss(&mut self) {
        self.held = true;
    }

    /// The reference showed `time` as the frame of `cycle`, sent at `sent_at`, passed it.
    pub fn sample(&mut self, cycle: &Cycle, sent_at: Time, time: u32) {
        let (off, error) = self.off(cycle, sent_at, time);
        if !self.is_seen() {
            return self.sample_first(off);
        }
        let near = error.abs() <= self.window_ns / 2;
        self.good = if near { SAMPLES.min(self.good + 1) } else { self.good.saturating_sub(1) };
        self.locked = if self.locked { self.good > 0 } else { self.good == SAMPLES };
        (self.error_ns, self.new, self.held) = (error, true, self.locked && !near);
        self.was_locked |= self.locked;
        if self.was_locked {
            self.error_max_ns = self.error_max_ns.max(error.unsigned_abs());
        }
    }

    /// One of the first samples: of frames that were late some may be whole periods off.
    fn sample_first(&mut self, off: i64) {
        self.first[usize::from(self.firsts)] = off as i32;
        self.firsts += 1;
        if self.is_seen() {
            self.first.sort_unstable();
            let off = i64::from(self.first[FIRST / 2]);
            self.slew_ns = self.phase(off);
            // Whole periods of a time that another master has set are no error.
            self.origin_ns = self.origin_ns.wrapping_add_signed(off - self.slew_ns);
            (self.error_ns, self.new) = (self.slew_ns, true);
        }
    }

    /// Distance of the newest slot from where the drives want it, ns: positive is late; `None`: the reference was
    /// not seen.
    pub fn error_ns(&self) -> Option<i64> {
        self.is_seen().then_some(self.error_ns)
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

    /// The newest error, once: positive is late. Without one that is far off while it is locked.
    pub fn take_error(&mut self) -> Option<i64> {
        (std::mem::take(&mut self.new) && !self.held).then_some(self.error_ns)
    }

    /// The grid is where the drives want it.
    pub fn is_locked(&self) -> bool {
        self.locked
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cycle(index: u64) -> Cycle {
        let grid = Time(7_777_777 + index * MS);
        Cycle { index, grid, period_ns: MS, deadline: grid + MS / 2 }
    }

    /// One that has its first samples, all with this error.
    fn seen(period_ns: u64, ahead_ns: u64, off: i64) -> SegmentClock {
        let mut clock = SegmentClock::new(period_ns, ahead_ns);
        for index in 0..FIRST as u64 {
            let cycle = cycle(index);
            assert_eq!((clock.take_error(), clock.is_sent()), (None, false));
            let shown = clock.time(&cycle, cycle.grid).wrapping_add_signed(off);
            clock.sample(&cycle, cycle.grid, shown as u32);
        }
        clock
    }

    #[test]
    fn a_slot_keeps_its_distance_to_sync0_under_any_jitter() {
        let mut clock = seen(MS, 400 * US, 0);
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
    fn dc_time_begins_at_the_date_and_sync0_keeps_its_phase() {
        for (today, least) in [(757_382_400_123_456_789, 757_382_400_123_456_789), (5, ORIGIN_NS)] {
            let mut clock = SegmentClock::new(MS, 400 * US);
            let cycle = cycle(0);
            let before = clock.time(&cycle, cycle.grid);
            clock.begin(today);
            let time = clock.time(&cycle, cycle.grid);
            assert_eq!((time % MS, time - least < 2 * MS), (before % MS, true), "{time}");
        }
    }

    #[test]
    fn whole_periods_of_a_clock_set_by_others_are_no_error() {
        let mut clock = SegmentClock::new(MS, 500 * US);
        let wanted = clock.time(&cycle(0), cycle(0).grid);
        for late in [0, 3, 0, 700, 0, 0, 9_000, 9_000, 9_000, 0, 40, 0, 0, 0, 5_000] {
            let shown = wanted + 123 * MS + 20 * US + late * US;
            clock.sample(&cycle(0), cycle(0).grid, shown as u32);
        }
        assert_eq!((clock.take_error(), clock.is_sent()), (Some(20_000), true), "the late ones are fewer");
        assert_eq!(clock.time(&cycle(0), cycle(0).grid), wanted + 123 * MS);
    }

    #[test]
    fn the_time_of_a_running_slave_is_the_segments_and_no_other_one_is() {
        let mut clock = SegmentClock::new(MS, 500 * US);
        let own = clock.time(&cycle(0), cycle(0).grid);
        for time in [7_u32, 3_999_999_999, 123] {
            clock.take_over(&cycle(5), cycle(5).grid, time);
            let shows = clock.shows(&cycle(6), cycle(6).grid);
            assert_eq!(shows as u32, time.wrapping_add(MS as u32));
            assert!(shows.abs_diff(own) < 1 << 33, "far from zero");
            let same = |off: u32| clock.is_time_of(&cycle(5), cycle(5).grid, time.wrapping_add(off));
            assert!(same(0) && same(80_000) && same(80_000_u32.wrapping_neg()));
            assert!(!same(81_000) && !same(MS as u32) && !same(u32::MAX / 2));
            assert_eq!(clock.sync_from(shows) - shows, 500 * US, "the grid is where SYNC0 wants it");
            let off = clock.off(&cycle(6), cycle(6).grid, shows as u32);
            assert_eq!(off, (0, 0), "nothing has to be adjusted");
        }
        assert!(!clock.is_seen() && clock.take_error().is_none(), "that is not the reference's");
    }

    /// Feeds it errors, ns, each one in so many cycles.
    fn feed(clock: &mut SegmentClock, offs: impl IntoIterator<Item = i64>) {
        for (index, off) in (FIRST as u64..).zip(offs) {
            let cycle = Cycle { period_ns: clock.period_ns, ..cycle(index) };
            let shown = clock.time(&cycle, cycle.grid).wrapping_add_signed(off);
            clock.sample(&cycle, cycle.grid, shown as u32);
        }
    }

    #[test]
    fn clock_locks_by_enough_good_samples_and_is_lost_by_as_many_bad_ones() {
        let mut clock = seen(250 * US, 100 * US, 0);
        let mut locked = |off, count| {
            feed(&mut clock, std::iter::repeat_n(off, count));
            clock.is_locked()
        };
        assert!(!locked(36_000, 100) && !locked(0, 63) && locked(34_000, 1));
        assert!(locked(36_000, 63) && !locked(-36_000, 1) && !locked(0, 63) && locked(0, 1));
    }

    #[test]
    fn a_lock_of_the_majority_stands_late_frames_and_no_one_follows_them() {
        let mut clock = seen(MS, 500 * US, 0);
        // Three of seven are late.
        for turn in 0..1_000_i64 {
            let late = turn % 7 >= 4;
            feed(&mut clock, [if late { 200_000 + turn * 7_919 % 300_000 } else { 20_000 }]);
            assert_eq!(clock.is_locked(), turn >= 423, "{turn}");
            if clock.is_locked() {
                assert_eq!(clock.take_error(), (!late).then_some(20_000));
                assert_eq!(clock.is_sent(), !late);
            }
        }
        clock.miss();
        assert!(!clock.is_sent() && clock.is_locked());
        feed(&mut clock, [0]);
        assert!(clock.is_sent());
    }

    #[test]
    fn the_largest_error_counts_from_the_first_lock_on() {
        let status = BusClock { error_ns: None, locked: false, error_max_ns: 0, window_ns: 320_000 };
        assert_eq!(SegmentClock::new(MS, 500 * US).status(), status);
        let mut clock = seen(MS, 500 * US, 300_000);
        assert_eq!(clock.status(), BusClock { error_ns: Some(300_000), ..status });
        let mut feed = |off, count| {
            feed(&mut clock, std::iter::repeat_n(off, count));
            clock.status()
        };
        let locked = BusClock { error_ns: Some(-7_000), locked: true, error_max_ns: 7_000, ..status };
        assert_eq!(feed(-7_000, 64), locked);
        let far = BusClock { error_ns: Some(-200_000), error_max_ns: 200_000, ..locked };
        assert_eq!(feed(-200_000, 1), far);
        let lost = BusClock { locked: false, ..far };
        assert_eq!(feed(-200_000, 63), lost);
        clock.forget();
        assert_eq!(clock.status(), BusClock { error_ns: None, ..lost });
    }
}
