//! Link health of one drive: a leaky bucket over its exchanges, and the schedule of its requests.

use std::mem::offset_of;

use crate::axis::{Health, Link};
use crate::time::nanos;

/// When the requests leave to a drive that does not answer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Probes {
    /// One an interval. More of them to a dead address would fill the shared socket's send buffer, and starve the
    /// other drives.
    #[default]
    Spaced,
    /// In each of its own slots: the frame that serves its bus leaves anyway.
    Carried,
    /// In each of its own slots and in no other one: it has agreed to that rate, sends by its own clock, and its
    /// watchdog needs them.
    AtOwnRate,
}

/// The link to one drive as the loop evaluates it. What an answered exchange touches stands first.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct LinkHealth {
    link: Link,
    /// Each slot is one of its own.
    each_slot: bool,
    /// It was up before.
    was_up: bool,
    probes: Probes,
    /// Good exchanges since the last miss or leak.
    good: u32,
    /// The slot of the last good one.
    good_at: u64,
    /// Misses in the bucket.
    level: u32,
    /// As in [`Health`].
    leak: u32,
    gate: u32,
    bucket: u32,
    divisor: u32,
    phase: u32,
    next_probe: u64,
    /// Cycles between two probes of a drive that does not answer.
    probe_every: u32,
    /// The slot in which it was lost: its lower half.
    lost_at: u32,
    /// The most slots since the last good one, executed or not.
    silence: u64,
}

impl LinkHealth {
    /// Up to here it is touched by an answered exchange.
    pub const USUAL: usize = offset_of!(LinkHealth, gate);

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
        let probe_every = u32::try_from(probe_every).unwrap_or(u32::MAX);
        LinkHealth {
            each_slot: divisor <= 1 && phase == 0,
            probes,
            leak: rules.leak,
            gate: rules.gate,
            bucket: rules.bucket,
            divisor: divisor.max(1),
            phase,
            next_probe: first_probe,
            probe_every,
            silence,
            lost_at: u32::MAX,
            ..LinkHealth::default()
        }
    }

    /// The link now.
    pub fn link(&self) -> Link {
        self.link
    }

    /// It is up, and no miss is in its bucket.
    #[inline]
    pub fn is_clean(&self) -> bool {
        self.link == Link::Online && self.level == 0
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
            self.next_probe = if sent { self.again(index) } else { index + u64::from(self.probe_every) };
        }
    }

    /// When a drive that does not answer has its turn again, after slot `index`.
    fn again(&self, index: u64) -> u64 {
        match self.probes {
            Probes::Spaced => index + u64::from(self.probe_every),
            Probes::Carried | Probes::AtOwnRate => self.next_own(index),
        }
    }

    /// The next own slot after `index`.
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
        // With an empty bucket it may begin again at 0.
        self.good = self.good.wrapping_add(1);
        // Usually it is up, and there is nothing that leaks.
        if self.link != Link::Online || self.level > 0 && self.good >= self.leak {
            self.improve(index);
        }
    }

    /// The reply of slot `index` may be that of an earlier request: it takes no miss out of the bucket.
    pub fn answered_in_doubt(&mut self, index: u64) {
        match self.link {
            Link::Online => self.good_at = index,
            _ => self.answered(index),
        }
    }

    #[inline(never)]
    fn improve(&mut self, index: u64) {
        match self.link {
            // One that was answered in the cycle of the loss does not hold up its stop.
            Link::Lost if self.lost_at == index as u32 => return,
            Link::Unseen | Link::Lost => {
                self.link = Link::Qualifying;
                self.good = 1;
            }
            Link::Qualifying | Link::Online => {}
        }
        if self.link == Link::Qualifying && self.good >= self.gate {
            (self.link, self.was_up) = (Link::Online, true);
            self.level = 0;
            self.good = 0;
        } else if self.link == Link::Online && self.good >= self.leak {
            self.level = self.level.saturating_sub(1);
            self.good = 0;
        }
    }

    /// An exchange was missed in slot `index`.
    pub fn missed(&mut self, index: u64) {
        self.good = 0;
        match self.link {
            Link::Unseen | Link::Lost => {}
            Link::Qualifying => {
                self.link = if self.was_up { Link::Lost } else { Link::Unseen };
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
        (self.link, self.lost_at) = (Link::Lost, index as u32);
        // The stop request leaves with the very next slot, as the first probe; at an agreed rate with the next own one.
        self.next_probe = match self.probes {
            Probes::Spaced | Probes::Carried => index + 1,
            Probes::AtOwnRate => self.next_own(index),
        };
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use super::*;
    use crate::time::MS;

    /// At 1 kHz, not seen yet: one slot of `divisor`, at `phase`.
    fn unseen(divisor: u32, phase: u32, first_probe: u64, probes: Probes) -> LinkHealth {
        LinkHealth::new(Health::default(), divisor, phase, MS, first_probe, 20 * u64::from(divisor), probes)
    }

    fn online() -> LinkHealth {
        let mut health = unseen(1, 0, 0, Probes::Spaced);
        health.good(10, 0);
        assert_eq!(health.link(), Link::Online);
        health
    }

    impl LinkHealth {
        /// Enters `count` answers in a slot, or misses.
        fn good(&mut self, count: u32, index: u64) {
            (0..count).for_each(|_| self.answered(index));
        }

        fn bad(&mut self, count: u32, index: u64) {
            (0..count).for_each(|_| self.missed(index));
        }

        /// The slots in which an exchange is due; each of them leaves, or none does.
        fn due(&mut self, slots: Range<u64>, sent: bool) -> Vec<u64> {
            let mut all = Vec::new();
            for index in slots {
                if self.is_due(index) {
                    all.push(index);
                    self.requested(index, sent);
                }
            }
            all
        }
    }

    /// A link of these rules that has just come up.
    fn up(bucket: u32, leak: u32) -> LinkHealth {
        let rules = Health { bucket, leak, gate: 1, ..Health::default() };
        let mut health = LinkHealth::new(rules, 1, 0, MS, 0, u64::MAX, Probes::Spaced);
        health.answered(0);
        assert_eq!(health.link(), Link::Online);
        health
    }

    #[test]
    fn the_bucket_fills_by_misses_and_leaks_by_good_exchanges_in_a_row() {
        let mut health = online();
        health.bad(4, 3);
        assert_eq!(health.link(), Link::Online);
        health.good(Health::default().leak, 0);
        health.bad(1, 30);
        assert_eq!(health.link(), Link::Online, "one miss has leaked away");
        health.bad(1, 31);
        assert_eq!(health.link(), Link::Lost);
        // What was answered in the same slot does not hold up the stop.
        health.answered(31);
        assert_eq!(
            (health.link(), health.due(32..140, true)),
            (Link::Lost, vec![32, 132]),
            "the stop, with the next slot"
        );
        // One that comes back has an empty bucket.
        health.good(10, 0);
        health.bad(4, 0);
        assert_eq!(health.link(), Link::Online);
        // As it was by default: only 20 good ones in a row take a miss out.
        let mut health = up(5, 20);
        for misses in 1..=5 {
            health.good(19, 0);
            health.bad(1, 0);
            assert_eq!(health.link() == Link::Lost, misses == 5, "{misses}");
        }
    }

    /// In how many exchanges a link that has just come up is lost, as `missed` says of each of them; `None`: not in so
    /// `many`.
    fn lost_in(bucket: u32, leak: u32, many: u64, mut missed: impl FnMut(u64) -> bool) -> Option<u64> {
        let mut health = up(bucket, leak);
        (1..=many).find(|exchange| {
            match missed(*exchange) {
                true => health.missed(0),
                false => health.answered(0),
            }
            health.link() == Link::Lost
        })
    }

    #[test]
    fn a_link_is_lost_by_the_misses_that_its_rules_state_and_by_no_fewer() {
        let random = &mut fastrand::Rng::with_seed(1);
        for _ in 0..200 {
            let (bucket, leak) = (random.u32(1..20), random.u32(1..40));
            let rules = Health { bucket, leak, ..Health::default() };
            let one_in = rules.tolerates_one_in();
            let lost = |many, missed: &dyn Fn(u64) -> bool| lost_in(bucket, leak, many, missed);
            assert_eq!(lost(10_000, &|_| true), Some(bucket.into()), "{rules:?}");
            // A bucket of one has no room for any.
            let evenly = lost(10_000, &|exchange| exchange % one_in == 0);
            assert_eq!(evenly, Some(one_in).filter(|_| bucket == 1), "{rules:?}");
            let twice = lost(10_000, &|exchange| exchange == 1 || 2 * exchange % one_in < 2);
            assert!(twice.is_some_and(|twice| twice <= rules.lost_at_twice_that()), "{rules:?}: {twice:?}");
            // However the misses are spread: with as many good ones behind each of them it is never lost.
            let mut good = 0;
            let spread = lost_in(bucket, leak, 10_000, |_| {
                let missed = good >= leak && random.u8(..4) == 0;
                good = if missed { 0 } else { good + 1 };
                missed
            });
            assert!(spread.is_none() || bucket == 1, "{rules:?}: {spread:?}");
        }
    }

    #[test]
    fn a_link_lasts_as_long_as_its_rules_say_where_exchanges_are_missed_at_random() {
        let random = &mut fastrand::Rng::with_seed(2);
        for (bucket, leak, share) in [
            (5, 1, 0.3),
            (5, 1, 0.2),
            (5, 2, 0.2),
            (5, 20, 0.03),
            (5, 20, 0.01),
            (1, 7, 0.05),
            (3, 4, 0.1),
            (12, 3, 0.3),
        ] {
            const LINKS: u64 = 1_000;
            let lasted = |_| lost_in(bucket, leak, u64::MAX, |_| random.f64() < share).unwrap_or_default();
            let mean = (0..LINKS).map(lasted).sum::<u64>() as f64 / LINKS as f64;
            let stated = Health { bucket, leak, ..Health::default() }.exchanges_to_loss(share);
            // About as far from each other as the mean: four deviations of the mean of so many.
            assert!(
                (mean / stated - 1.0).abs() < 0.13,
                "{bucket} {leak} {share}: {mean} instead of {stated}"
            );
        }
    }

    #[test]
    fn by_default_a_random_loss_of_a_hundredth_of_all_datagrams_stops_nothing_in_a_hundred_million_exchanges()
    {
        let rules = Health::default();
        // Of the requests, and of the replies.
        for share in [0.01, 0.02] {
            assert!(rules.exchanges_to_loss(share) > 1e8, "{share}: {}", rules.exchanges_to_loss(share));
        }
        assert_eq!(rules.bucket, 5, "a dead drive is lost no later");
        let before = Health { leak: 20, ..rules }.exchanges_to_loss(0.01);
        assert!((10_000.0..100_000.0).contains(&before), "{before}");
        // And so it goes: 10^8 exchanges, of which only those count that change something.
        let (mut health, random, mut exchanges) =
            (up(rules.bucket, rules.leak), &mut fastrand::Rng::with_seed(3), 0);
        while exchanges < 100_000_000 {
            let good = (random.f64().ln() / 0.99_f64.ln()) as u64;
            health.good(good.min(u64::from(rules.bucket * rules.leak)) as u32, 0);
            health.bad(1, 0);
            assert_eq!(health.link(), Link::Online, "after {exchanges} exchanges");
            exchanges += good + 1;
        }
    }

    #[test]
    fn too_many_slots_without_a_good_exchange_are_a_loss_however_few_were_executed() {
        let mut health = online();
        health.answered(100);
        for index in [110, 120] {
            health.watch_silence(index);
            assert_eq!(health.link(), Link::Online, "{index}");
        }
        health.missed(121);
        health.watch_silence(121);
        assert_eq!(health.link(), Link::Lost);
        assert!(health.is_due(122), "the stop request leaves with the next slot");
        // It passes its gate again.
        let mut health = online();
        health.good(15, 100);
        health.watch_silence(121);
        health.good(9, 130);
        assert_eq!(health.link(), Link::Qualifying);
        health.answered(130);
        assert_eq!(health.link(), Link::Online);
    }

    #[test]
    fn a_ready_drive_is_requested_at_once_and_divisor_and_phase_choose_its_slots() {
        let mut health = unseen(4, 3, 0, Probes::Spaced);
        assert_eq!(health.due(0..11, true), [0]);
        health.reachable(10);
        assert_eq!(health.due(10..111, true), [10, 110]);
        health.good(10, 0);
        assert_eq!(health.due(0..12, true), [3, 7, 11]);
    }

    #[test]
    fn a_drive_whose_frame_leaves_anyway_takes_part_in_all_its_slots_whatever_its_link() {
        let mut health = unseen(2, 1, 0, Probes::Carried);
        assert_eq!(health.due(0..8, true), [0, 1, 3, 5, 7], "never seen");
        health.good(10, 8);
        health.bad(5, 9);
        assert_eq!(health.link(), Link::Lost);
        assert_eq!(health.due(10..16, true), [10, 11, 13, 15], "the stop leaves with the very next slot");
        health.answered(15);
        health.missed(17);
        assert_eq!((health.link(), health.due(18..24, true)), (Link::Lost, vec![19, 21, 23]), "lost again");
        // What does not leave is tried once an interval.
        health.requested(23, false);
        assert_eq!(health.due(24..126, true), [123, 125]);
    }
}
