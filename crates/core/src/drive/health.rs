//! Link health of one drive: a leaky bucket over its exchanges, and the schedule of its requests.

use crate::axis::{Health, Link};
use crate::time::nanos;

/// When the requests leave to a drive that does not answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Probes {
    /// One an interval. More of them to a dead address would fill the shared socket's send buffer, and starve the
    /// other drives.
    Spaced,
    /// In each of its own slots: the frame that serves its bus leaves anyway.
    Carried,
    /// In each of its own slots and in no other one: it has agreed to that rate, sends by its own clock, and its
    /// watchdog needs them.
    AtOwnRate,
}

/// The link to one drive as the loop evaluates it: one cache line.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct LinkHealth {
    link: Link,
    /// Each slot is one of its own.
    each_slot: bool,
    probes: Probes,
    /// Good exchanges since the last miss or leak.
    good: u32,
    /// The slot of the last good one.
    good_at: u64,
    /// As in [`Health`].
    leak: u32,
    gate: u32,
    bucket: u32,
    /// Misses in the bucket.
    level: u32,
    divisor: u32,
    phase: u32,
    next_probe: u64,
    /// Cycles between two probes of a drive that does not answer.
    probe_every: u64,
    /// The most slots since the last good one, executed or not.
    silence: u64,
}

impl LinkHealth {
    /// A drive not seen yet. Its first probe goes out in slot `first_probe`. `silence` slots without a good exchange
    /// are a loss, however many of them were executed.
    pub fn new(
        rules: Health,
        divisor: u32,
        phase: u32,
        period_ns: u64,
        first_probe: u64,
        silence: u64,
        probes: Probes,
    ) -> LinkHealth {
        let probe_every = nanos(rules.probe_interval).div_ceil(period_ns).max(1);
        LinkHealth {
            link: Link::Unseen,
            each_slot: divisor <= 1 && phase == 0,
            probes,
            good: 0,
            good_at: 0,
            leak: rules.leak,
            gate: rules.gate,
            bucket: rules.bucket,
            level: 0,
            divisor: divisor.max(1),
            phase,
            next_probe: first_probe,
            probe_every,
            silence,
        }
    }

    /// The link now.
    pub fn link(&self) -> Link {
        self.link
    }

    /// Whether an exchange is due in slot `index`: every own slot while the drive answers, and its probes while it does
    /// not.
    #[inline]
    pub fn is_due(&self, index: u64) -> bool {
        match self.link {
            Link::Unseen | Link::Lost => index >= self.next_probe,
            Link::Qualifying | Link::Online => {
                self.each_slot || index % u64::from(self.divisor) == u64::from(self.phase)
            }
        }
    }

    /// Notes that an exchange was sent in slot `index`, or that the attempt failed.
    #[inline]
    pub fn requested(&mut self, index: u64, sent: bool) {
        if matches!(self.link, Link::Unseen | Link::Lost) {
            self.next_probe = if sent { self.again(index) } else { index + self.probe_every };
        }
    }

    /// When a drive that does not answer has its turn again, after slot `index`.
    fn again(&self, index: u64) -> u64 {
        match self.probes {
            Probes::Spaced => index + self.probe_every,
            Probes::Carried | Probes::AtOwnRate => self.next_own(index),
        }
    }

    /// Its next own slot after `index`.
    fn next_own(&self, index: u64) -> u64 {
        let (next, divisor) = (index + 1, u64::from(self.divisor));
        next + (u64::from(self.phase) + divisor - next % divisor) % divisor
    }

    /// It can be reached from slot `index` on, without waiting for a probe interval.
    pub fn reachable(&mut self, index: u64) {
        self.next_probe = index;
    }

    /// An exchange was answered in slot `index`.
    #[inline]
    pub fn answered(&mut self, index: u64) {
        self.good_at = index;
        self.good += 1;
        // Usually it is up, and nothing leaks yet.
        if self.link != Link::Online || self.good >= self.leak {
            self.improve();
        }
    }

    #[inline(never)]
    fn improve(&mut self) {
        match self.link {
            Link::Unseen | Link::Lost => {
                self.link = Link::Qualifying;
                self.good = 1;
            }
            Link::Qualifying | Link::Online => {}
        }
        if self.link == Link::Qualifying && self.good >= self.gate {
            self.link = Link::Online;
            self.level = 0;
            self.good = 0;
        } else if self.link == Link::Online && self.good >= self.leak {
            self.level = self.level.saturating_sub(1);
            self.good = 0;
        }
    }

    /// An exchange was missed in slot `index`.
    pub fn missed(&mut self, index: u64, seen_before: bool) {
        self.good = 0;
        match self.link {
            Link::Unseen | Link::Lost => {}
            Link::Qualifying => {
                self.link = if seen_before { Link::Lost } else { Link::Unseen };
                self.next_probe = self.again(index);
            }
            Link::Online => {
                self.level += 1;
                if self.level >= self.bucket {
                    self.lose(index);
                }
            }
        }
    }

    /// After the exchange of slot `index`, if there was one: most slots may have been skipped since the last good one.
    pub fn watch_silence(&mut self, index: u64) {
        if self.link == Link::Online && index.saturating_sub(self.good_at) > self.silence {
            self.lose(index);
        }
    }

    fn lose(&mut self, index: u64) {
        self.link = Link::Lost;
        // The stop request leaves with the very next slot, as the first probe; at an agreed rate with the next own one.
        self.next_probe = match self.probes {
            Probes::Spaced | Probes::Carried => index + 1,
            Probes::AtOwnRate => self.next_own(index),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::MS;

    fn online() -> LinkHealth {
        let mut health = LinkHealth::new(Health::default(), 1, 0, MS, 0, 20, Probes::Spaced);
        for _ in 0..10 {
            health.answered(0);
        }
        assert_eq!(health.link(), Link::Online);
        health
    }

    #[test]
    fn ten_good_exchanges_bring_it_up_and_one_miss_starts_over() {
        let mut health = LinkHealth::new(Health::default(), 1, 0, MS, 3, 20, Probes::Spaced);
        assert!(!health.is_due(2) && health.is_due(3));
        health.requested(3, true);
        assert!(!health.is_due(4) && !health.is_due(102) && health.is_due(103));
        for _ in 0..9 {
            health.answered(0);
        }
        assert_eq!(health.link(), Link::Qualifying);
        health.missed(120, false);
        assert_eq!(health.link(), Link::Unseen);
        assert!(!health.is_due(219) && health.is_due(220));
    }

    #[test]
    fn the_bucket_fills_by_misses_and_leaks_by_good_exchanges() {
        let mut health = online();
        for index in 0..4 {
            health.missed(index, true);
        }
        assert_eq!(health.link(), Link::Online);
        (0..20).for_each(|_| health.answered(0));
        health.missed(30, true);
        assert_eq!(health.link(), Link::Online, "one miss has leaked away");
        health.missed(31, true);
        assert_eq!(health.link(), Link::Lost);
        assert!(health.is_due(32), "the stop request leaves with the next slot");
        health.requested(32, true);
        assert!(!health.is_due(33) && health.is_due(132));
    }

    #[test]
    fn too_many_slots_without_a_good_exchange_are_a_loss_however_few_were_executed() {
        let mut health = online();
        health.answered(100);
        for index in [110, 120] {
            health.watch_silence(index);
            assert_eq!(health.link(), Link::Online, "{index}");
        }
        health.missed(121, true);
        health.watch_silence(121);
        assert_eq!(health.link(), Link::Lost);
        assert!(health.is_due(122), "the stop request leaves with the next slot");
    }

    #[test]
    fn a_drive_that_can_be_asked_again_is_asked_at_once() {
        let mut health = LinkHealth::new(Health::default(), 4, 3, MS, 0, 40, Probes::Spaced);
        health.requested(0, true);
        assert!(!health.is_due(10));
        health.reachable(10);
        assert!(health.is_due(10));
        health.requested(10, true);
        assert!(!health.is_due(11) && health.is_due(110));
    }

    #[test]
    fn a_drive_with_its_own_clock_is_sent_its_requests_in_all_its_slots_as_long_as_they_leave() {
        let mut health = LinkHealth::new(Health::default(), 4, 3, MS, 1, 40, Probes::AtOwnRate);
        let mut due = |slots: std::ops::Range<u64>, sent: bool| {
            let mut all = Vec::new();
            for index in slots {
                if health.is_due(index) {
                    all.push(index);
                    health.requested(index, sent);
                }
            }
            all
        };
        // The first at once, and none of them is a probe.
        assert_eq!(due(0..20, true), [1, 3, 7, 11, 15, 19]);
        // Without a connection nothing leaves: then one attempt an interval.
        assert_eq!(due(20..230, false), [23, 123, 223]);
        health.reachable(230);
        (0..10).for_each(|_| health.answered(230));
        assert_eq!(health.link(), Link::Online);
        (0..5).for_each(|_| health.missed(232, true));
        assert_eq!(health.link(), Link::Lost);
        // The stop goes at the agreed rate, too.
        let due: Vec<u64> = (233..244).filter(|index| health.is_due(*index)).collect();
        assert_eq!(
            due,
            (235..244).collect::<Vec<_>>(),
            "in its own slot, or the first one behind it that is executed"
        );
        health.requested(235, true);
        assert!(!health.is_due(238) && health.is_due(239));
    }

    #[test]
    fn a_drive_whose_frame_leaves_anyway_takes_part_in_all_its_slots_whatever_its_link() {
        let mut health = LinkHealth::new(Health::default(), 2, 1, MS, 0, 40, Probes::Carried);
        let due = |health: &mut LinkHealth, slots: std::ops::Range<u64>| {
            let mut all = Vec::new();
            for index in slots {
                if health.is_due(index) {
                    all.push(index);
                    health.requested(index, true);
                }
            }
            all
        };
        assert_eq!(due(&mut health, 0..8), [0, 1, 3, 5, 7], "never seen");
        (0..10).for_each(|_| health.answered(8));
        (0..5).for_each(|_| health.missed(9, true));
        assert_eq!(health.link(), Link::Lost);
        assert_eq!(due(&mut health, 10..16), [10, 11, 13, 15], "the stop leaves with the very next slot");
        health.answered(15);
        health.missed(17, true);
        assert_eq!((health.link(), due(&mut health, 18..24)), (Link::Lost, vec![19, 21, 23]), "lost again");
        // What does not leave is tried once an interval.
        health.requested(23, false);
        assert_eq!(due(&mut health, 24..126), [123, 125]);
    }

    #[test]
    fn divisor_and_phase_choose_the_slots() {
        let mut health = LinkHealth::new(Health::default(), 4, 3, MS, 0, 40, Probes::Spaced);
        (0..10).for_each(|_| health.answered(0));
        let due: Vec<u64> = (0..12).filter(|index| health.is_due(*index)).collect();
        assert_eq!(due, [3, 7, 11]);
    }

    #[test]
    fn a_link_that_comes_back_has_an_empty_bucket() {
        let mut health = online();
        (0..5).for_each(|_| health.missed(0, true));
        assert_eq!(health.link(), Link::Lost);
        (0..10).for_each(|_| health.answered(0));
        (0..4).for_each(|_| health.missed(0, true));
        assert_eq!(health.link(), Link::Online);
    }

    #[test]
    fn a_link_that_was_lost_by_silence_passes_its_gate_again() {
        let mut health = online();
        (0..15).for_each(|_| health.answered(100));
        health.watch_silence(121);
        assert_eq!(health.link(), Link::Lost);
        (0..9).for_each(|_| health.answered(130));
        assert_eq!(health.link(), Link::Qualifying);
        health.answered(130);
        assert_eq!(health.link(), Link::Online);
    }

    #[test]
    fn only_good_exchanges_in_a_row_take_a_miss_out_of_the_bucket() {
        let mut health = online();
        let leak = Health::default().leak;
        for misses in 1..=5 {
            // One too few to be forgotten.
            (1..leak).for_each(|_| health.answered(0));
            health.missed(0, true);
            assert_eq!(health.link() == Link::Lost, misses == 5, "{misses}");
        }
    }
}
