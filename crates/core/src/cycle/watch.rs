//! Whether the loop's cycle ends: what a watch on another thread makes of the loop's sign of life.
//!
//! Time and signs go in, a verdict comes out. The thread that polls lives where the loop's thread is started.

use crate::time::{MS, Time};

/// The number of polls without a sign of life, each of them on time, before the verdict: a host that holds up
/// everything, or a stopped process that continues, delays the watch like the loop.
const ON_TIME: u32 = 3;

/// Polls in the time after which the loop is stuck, and the bounds of the time between two of them, ns.
const POLLS: u64 = 10;
const SHORTEST_NS: u64 = MS;
const LONGEST_NS: u64 = 50 * MS;

/// The watch over a loop.
#[derive(Debug)]
pub struct Watch {
    after_ns: u64,
    every_ns: u64,
    polled_at: Option<Time>,
    turns: u64,
    /// Since the last sign of life, without what the watch itself was late.
    silent_ns: u64,
    /// Polls on time since then, without a late one after them.
    on_time: u32,
}

/// The result of one poll.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// There was a sign of life since the last poll, or the loop has not begun.
    Alive,
    /// There was none for so long, ns.
    Silent(u64),
    /// The cycle does not end: it was silent for so long, ns.
    Stuck(u64),
}

impl Watch {
    /// A loop is stuck after so long without a sign of life.
    pub fn new(after_ns: u64) -> Watch {
        let every_ns = (after_ns / POLLS).clamp(SHORTEST_NS, LONGEST_NS);
        Watch { after_ns, every_ns, polled_at: None, turns: 0, silent_ns: 0, on_time: 0 }
    }

    /// A watch that is on time itself finds a loop stuck within this time of its last sign of life, ns.
    pub fn latest_ns(after_ns: u64) -> u64 {
        // The sign came behind a poll.
        after_ns + (u64::from(ON_TIME) + 1) * Watch::new(after_ns).every_ns
    }

    /// The time from one poll to the next, ns.
    pub fn every_ns(&self) -> u64 {
        self.every_ns
    }

    /// One poll, which found the loop in this turn.
    pub fn poll(&mut self, now: Time, turns: u64) -> Verdict {
        let passed_ns = self.polled_at.replace(now).map_or(0, |before| now.since(before));
        if turns == 0 || turns != std::mem::replace(&mut self.turns, turns) {
            (self.silent_ns, self.on_time) = (0, 0);
            return Verdict::Alive;
        }
        // Half of the time between two polls may be the host's usual lateness.
        let on_time = passed_ns <= self.every_ns + self.every_ns / 2;
        self.silent_ns += passed_ns.min(self.every_ns);
        self.on_time = if on_time { self.on_time + 1 } else { 0 };
        match self.silent_ns >= self.after_ns && self.on_time >= ON_TIME {
            true => Verdict::Stuck(self.silent_ns),
            false => Verdict::Silent(self.silent_ns),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::S;

    /// Polls on time from `from` on, until the verdict; returns how long after `from` it came.
    fn verdict(watch: &mut Watch, from: Time, turns: u64) -> u64 {
        for poll in 1..1_000 {
            let now = from + poll * watch.every_ns();
            if let Verdict::Stuck(_) = watch.poll(now, turns) {
                return now.since(from);
            }
        }
        panic!("no verdict");
    }

    #[test]
    fn a_loop_is_stuck_after_its_time_without_a_sign_of_life_and_not_before() {
        for after_ns in [20 * MS, 500 * MS, 3 * S] {
            let mut watch = Watch::new(after_ns);
            assert_eq!(watch.poll(Time(S), 7), Verdict::Alive);
            assert_eq!(verdict(&mut watch, Time(S), 7), after_ns);
        }
        // A time that is no multiple of that between polls ends with the next one.
        let mut watch = Watch::new(75 * MS);
        watch.poll(Time(S), 7);
        assert_eq!(verdict(&mut watch, Time(S), 7), 75 * MS);
        let mut watch = Watch::new(15 * MS + 5);
        watch.poll(Time(S), 7);
        assert_eq!(watch.every_ns(), 1_500_000);
        assert_eq!(verdict(&mut watch, Time(S), 7), 11 * 1_500_000);
    }

    #[test]
    fn a_loop_that_has_not_begun_is_not_stuck_and_one_that_turns_slowly_neither() {
        let mut watch = Watch::new(100 * MS);
        for poll in 0..1_000 {
            assert_eq!(watch.poll(Time(poll * 10 * MS), 0), Verdict::Alive);
        }
        // A turn in every ninth poll.
        for poll in 1_000..2_000 {
            assert!(!matches!(watch.poll(Time(poll * 10 * MS), poll / 9), Verdict::Stuck(_)), "{poll}");
        }
    }

    #[test]
    fn delays_of_the_watch_thread_are_not_charged_to_the_loop() {
        // Stopped for an hour, with the loop, and then both go on.
        let mut watch = Watch::new(100 * MS);
        watch.poll(Time(0), 7);
        let woke = Time(3_600 * S);
        assert_eq!(watch.poll(woke, 7), Verdict::Silent(10 * MS));
        assert_eq!(watch.poll(woke + 10 * MS, 8), Verdict::Alive);

        // A watch that is late each time gives no verdict, however long that goes on.
        let mut watch = Watch::new(100 * MS);
        watch.poll(Time(0), 7);
        for poll in 1..1_000 {
            assert!(matches!(watch.poll(Time(poll * 16 * MS), 7), Verdict::Silent(_)), "{poll}");
        }
        // It comes with the third one in a row that is on time.
        let late = Time(1_000 * 16 * MS);
        assert!(matches!(watch.poll(late, 7), Verdict::Silent(_)));
        let polls = [1, 2, 3].map(|poll| watch.poll(late + poll * 10 * MS, 7));
        assert!(matches!(polls, [Verdict::Silent(_), Verdict::Silent(_), Verdict::Stuck(_)]), "{polls:?}");
    }
}
