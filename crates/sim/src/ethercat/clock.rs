//! The distributed clock of a slave (ETG.1000.4, 6.5).
//!
//! The local time runs with the drift of the quartz, adjusted by the compensation; the system time is the local time
//! plus the offset.

use super::codec::registers::difference;
use fieldbeat_core::time::Time;

/// The most that the compensation does, either way.
const SPEED_MAX_PPM: f64 = 1_000.0;
/// With fewer comparisons than this the compensation is not stable.
const QUICKEST: u16 = 4;
/// A comparison after a longer gap adjusts for so long, ns: it does not make up for the gap at once.
const GAP_NS: i64 = 10_000_000;
/// So many passed SYNC0 are caught up, and older ones are not.
const CATCH_UP: u64 = 1_000;

/// SYNC0 as it runs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sync {
    /// When the next one is, in the segment's time.
    next: u64,
    /// The time until then; not positive: it is due.
    left_ns: i128,
    /// 0: there is only one.
    cycle_ns: u64,
}

/// The clock.
#[derive(Debug, Default)]
pub(super) struct Clock {
    mask: u64,
    drift_ppm: f64,
    trim_ppm: f64,
    /// The local time, and the fraction of a nanosecond beyond it.
    own: u64,
    part: f64,
    lived: Option<Time>,
    offset: u64,
    pub(super) delay: u32,
    /// When it was last compared, by its own time.
    compared: Option<u64>,
    /// Comparisons: the difference is averaged over so many, and is removed in so many.
    over: f64,
    within: f64,
    /// The average.
    difference_ns: f64,
    pub(super) sync: Option<Sync>,
}

impl Clock {
    /// Shows `start_ns` at its start. The compensation is critically damped, and takes `settling` comparisons for
    /// most of a difference.
    pub(super) fn new(long: bool, start_ns: u64, drift_ppm: f64, settling: u16) -> Clock {
        Clock {
            mask: if long { u64::MAX } else { u32::MAX.into() },
            drift_ppm,
            own: start_ns,
            over: 1.0,
            within: f64::from(settling.max(QUICKEST)),
            ..Clock::default()
        }
    }

    /// Sets the depth of the average of differences, a power of two of comparisons (0934h).
    pub(super) fn average(&mut self, depth: u8) {
        self.over = f64::from(1_u16 << (depth & 0x0F));
    }

    /// Advances to `now`.
    pub(super) fn advance(&mut self, now: Time) {
        let dt_ns = now.since(*self.lived.get_or_insert(now));
        self.lived = self.lived.max(Some(now));
        self.add(dt_ns.cast_signed());
        self.shift(dt_ns as f64 * (self.drift_ppm + self.trim_ppm) * 1e-6);
    }

    fn shift(&mut self, ns: f64) {
        self.part += ns;
        let whole = self.part.floor();
        self.part -= whole;
        self.add(whole as i64);
    }

    fn add(&mut self, ns: i64) {
        self.own = self.own.wrapping_add_signed(ns);
        if let Some(sync) = &mut self.sync {
            sync.left_ns -= i128::from(ns);
        }
    }

    /// The local time, ns.
    pub(super) fn own(&self) -> u64 {
        self.own & self.mask
    }

    /// The segment's time, ns.
    pub(super) fn system_time(&self) -> u64 {
        self.own.wrapping_add(self.offset) & self.mask
    }

    /// The segment's time less its own.
    pub(super) fn set_offset(&mut self, offset: u64) {
        self.offset = offset;
        let system_time = self.system_time();
        if let Some(sync) = &mut self.sync {
            sync.left_ns = (sync.next.wrapping_sub(system_time) & self.mask).into();
        }
    }

    /// Compares with the time of the reference clock, of which so many bits came, and adjusts to it.
    pub(super) fn compare(&mut self, reference: u64, bits: usize) {
        let at = reference.wrapping_add(self.delay.into());
        let ahead = self.system_time().wrapping_sub(at);
        let whole = self.mask == u64::MAX && bits >= 64;
        let error = if whole { ahead.cast_signed() } else { (ahead as u32).cast_signed().into() } as f64;
        let last = self.compared.replace(self.own);
        let part = if last.is_some() { 1.0 / self.over } else { 1.0 };
        self.difference_ns += (error - self.difference_ns) * part;
        // The adjustment itself may have set it back.
        let since = last.map_or(0, |last| self.own.wrapping_sub(last).cast_signed());
        if since <= 0 {
            return;
        }
        let since = since.min(GAP_NS) as f64;
        let most = since * SPEED_MAX_PPM * 1e-6;
        let trim = self.trim_ppm - error / (self.within * self.within) / since * 1e6;
        self.trim_ppm = trim.clamp(-SPEED_MAX_PPM, SPEED_MAX_PPM);
        self.shift(-(error * 2.0 / self.within).clamp(-most, most));
    }

    /// Resets the filter of the compensation.
    pub(super) fn reset_filter(&mut self) {
        (self.trim_ppm, self.compared, self.difference_ns) = (0.0, None, 0.0);
    }

    /// The last difference as the register has it: a magnitude, and bit 31 if it is ahead, or level.
    pub(super) fn difference(&self) -> u32 {
        difference(self.difference_ns.round())
    }

    /// SYNC0 begins at `start`, and repeats every `cycle_ns`, if that is not 0.
    pub(super) fn start(&mut self, start: u64, cycle_ns: u32) {
        let next = start & self.mask;
        let left_ns = (next.wrapping_sub(self.system_time()) & self.mask).into();
        self.sync = Some(Sync { next, left_ns, cycle_ns: cycle_ns.into() });
    }

    /// When the next SYNC0 is; `None`: there is none.
    pub(super) fn next_sync(&self) -> Option<u64> {
        self.sync.map(|sync| sync.next)
    }

    /// The time until then, ns.
    pub(super) fn left_to_sync(&self) -> Option<u64> {
        self.sync.map(|sync| u64::try_from(sync.left_ns).unwrap_or_default())
    }

    /// Takes the next SYNC0 that has come; returns how long ago, ns.
    pub(super) fn take_sync(&mut self) -> Option<u64> {
        let sync = self.sync.as_mut().filter(|sync| sync.left_ns <= 0)?;
        let late_ns = u64::try_from(-sync.left_ns).unwrap_or(u64::MAX);
        if sync.cycle_ns == 0 {
            self.sync = None;
            return Some(late_ns);
        }
        let forgotten = (late_ns / sync.cycle_ns).saturating_sub(CATCH_UP);
        let ahead = sync.cycle_ns.saturating_mul(forgotten);
        sync.next = sync.next.wrapping_add(ahead).wrapping_add(sync.cycle_ns) & self.mask;
        sync.left_ns += i128::from(ahead) + i128::from(sync.cycle_ns);
        Some(late_ns - ahead)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::time::{MS, S};

    const QUICK: u16 = 32;

    /// The difference in its register, ns.
    fn shown(clock: &Clock) -> i64 {
        let (difference, sign) = (clock.difference() & !(1 << 31), clock.difference() >> 31);
        i64::from(difference) * if sign == 1 { 1 } else { -1 }
    }

    fn started(long: bool, start_ns: u64, drift_ppm: f64) -> Clock {
        settling(long, start_ns, drift_ppm, QUICK)
    }

    fn settling(long: bool, start_ns: u64, drift_ppm: f64, settling: u16) -> Clock {
        let mut clock = Clock::new(long, start_ns, drift_ppm, settling);
        clock.advance(Time(S));
        clock
    }

    #[test]
    fn differences_are_taken_over_the_wrap_of_a_short_clock() {
        let mut clock = started(false, 100, 0.0);
        clock.compare(u64::from(u32::MAX) - 99, 64);
        assert_eq!(shown(&clock), 200);
        clock.delay = 300;
        clock.compare(u64::from(u32::MAX) - 99, 32);
        assert_eq!(shown(&clock), -100);
        // All of a long one count only if all came.
        let mut long = started(true, 5 << 32, 0.0);
        long.compare(7, 32);
        assert_eq!(shown(&long), -7);
        long.compare((5 << 32) - 7, 64);
        assert_eq!(shown(&long), 7);
    }

    /// Comparisons until a clock that is 60 ppm off stays within 1 us.
    fn settled(settles: u16) -> usize {
        let mut reference = started(true, 5 * S, 0.0);
        let mut clock = settling(true, 5 * S, 60.0, settles);
        let off = |n: u64| {
            let now = Time(S + n * MS);
            reference.advance(now);
            clock.advance(now);
            clock.compare(reference.system_time(), 64);
            shown(&clock).abs() > 1_000
        };
        let off: Vec<bool> = (1..40_000).map(off).collect();
        off.iter().rposition(|off| *off).unwrap_or(0)
    }

    #[test]
    fn it_settles_in_some_hundred_comparisons_or_like_a_real_one_in_some_thousand() {
        assert!(settled(QUICK) < 300, "{}", settled(QUICK));
        assert!((4_000..15_000).contains(&settled(1_024)), "{}", settled(1_024));
    }

    #[test]
    fn the_difference_is_an_average_as_deep_as_its_filter() {
        let mut clock = started(true, 0, 0.0);
        clock.average(4);
        clock.compare(0, 64);
        // Of each difference a sixteenth counts.
        for (n, average) in (1..).zip([1_000, 2_936]) {
            clock.advance(Time(S + n * 16_000));
            clock.compare(0, 64);
            let ns = shown(&clock);
            assert!((ns - average).abs() <= 2, "{ns} ns");
        }
    }

    #[test]
    fn a_reset_forgets_the_speed() {
        let mut clock = started(true, 0, 0.0);
        for ms in 1..50 {
            clock.advance(Time(S + ms * MS));
            clock.compare(S, 64);
        }
        clock.reset_filter();
        let before = clock.own();
        clock.advance(Time(2 * S));
        assert_eq!(clock.own() - before, 951 * MS);
    }

    #[test]
    fn a_pulse_moves_with_the_offset_and_after_a_silence_only_the_newest_are_made_up_for() {
        let mut clock = started(true, 0, 0.0);
        clock.start(10_000, 1_000);
        clock.set_offset(4_000);
        clock.advance(Time(S + 5_999));
        assert_eq!(clock.take_sync(), None);
        clock.advance(Time(S + 6_000));
        assert_eq!(clock.take_sync(), Some(0));
        // Beyond the next one: that is missed, like a start that has passed.
        clock.set_offset(20_000);
        clock.advance(Time(2 * S));
        assert_eq!(clock.take_sync(), None);
        let mut clock = started(true, 0, 0.0);
        clock.start(MS, 1);
        clock.advance(Time(60 * S));
        let taken: Vec<u64> = std::iter::from_fn(|| clock.take_sync()).collect();
        assert_eq!((taken.len() as u64, taken.last()), (CATCH_UP + 1, Some(&0)));
        let mut single = started(true, 0, 0.0);
        single.start(MS, 0);
        single.advance(Time(2 * S));
        assert_eq!([single.take_sync(), single.take_sync()], [Some(S - MS), None]);
    }
}
