//! Whether a key is held, as far as a terminal reports it.
//!
//! A terminal with the keyboard protocol of kitty reports that a key goes down, repeats and goes up. Any other reports
//! only that it was pressed: one that is held shows itself by presses that follow each other as fast as the keyboard
//! repeats. There the key counts as held from its second repeat on, which has to come faster than fingers press, and as
//! let go when the next repeat does not come.
//!
//! Some terminals, and programs between them and the panel, say that they have the protocol, and never report that a
//! key goes up. So a terminal is believed from the first such report on, up to a press that neither repeats nor goes
//! up.
//!
//! Whatever ended a hold, the key has to be let go before it can be held again: repeats that go on, or arrive in a
//! burst after the connection to the terminal has hung, hold nothing.

use std::time::Duration;

/// A key that does not repeat for so long was let go. The slowest usual keyboards repeat every 92 ms.
pub const GAP: Duration = Duration::from_millis(200);

/// The second repeat of a key follows the first one within this time. Fingers are slower.
const REPEAT: Duration = Duration::from_millis(110);

/// The first repeat of a key comes within these times of its press: keyboards wait for 0.25 s to 1 s.
const FIRST: std::ops::RangeInclusive<Duration> = Duration::from_millis(200)..=Duration::from_millis(1_200);

/// A key that was let go does not come for so long.
const PAUSE: Duration = Duration::from_millis(300);

/// Forward or back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// Towards higher positions.
    Forward,
    /// Towards lower positions.
    Back,
}

/// The terminal's reports of a run key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stroke {
    /// It went down; or it repeats, where the terminal does not report that.
    Down,
    /// It repeats.
    Repeat,
    /// It went up.
    Up,
}

/// The run keys.
#[derive(Debug)]
pub struct Hold {
    /// The terminal says that it reports repeats and releases.
    announced: bool,
    /// It has done so.
    shown: bool,
    phase: Phase,
}

/// Times count from any begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// No key is down.
    Up,
    /// One was pressed.
    Pressed { way: Way, at: Duration },
    /// It has repeated once.
    Repeated { way: Way, at: Duration },
    /// It is held, up to this time unless it repeats.
    Held { way: Way, until: Duration },
    /// It has to be let go first; the last report of it.
    Spent { at: Duration },
}

impl Hold {
    /// No key is down. The terminal says that it reports releases, or does not.
    pub fn new(announced: bool) -> Hold {
        Hold { announced, shown: false, phase: Phase::Up }
    }

    /// Whether the terminal reports releases, as far as it has shown.
    pub fn has_releases(&self) -> bool {
        self.announced && self.shown
    }

    /// The terminal reports that a key has gone up, whichever it is.
    pub fn release(&mut self) {
        self.shown = true;
    }

    /// The terminal reports this of a run key.
    pub fn stroke(&mut self, now: Duration, way: Way, stroke: Stroke) {
        self.held(now);
        if stroke == Stroke::Up {
            self.release();
        }
        self.phase = match stroke {
            Stroke::Down | Stroke::Repeat if !self.has_releases() => self.by_repeats(now, way, stroke),
            _ => self.exactly(now, way, stroke),
        };
    }

    fn exactly(&self, now: Duration, way: Way, stroke: Stroke) -> Phase {
        match (stroke, self.phase) {
            (Stroke::Up, Phase::Held { way: held, .. }) if held != way => Phase::Spent { at: now },
            (Stroke::Up, _) => Phase::Up,
            // The other key as well.
            (Stroke::Down, Phase::Held { .. }) => Phase::Spent { at: now },
            (Stroke::Down, _) => Phase::Held { way, until: now + *FIRST.end() },
            (Stroke::Repeat, Phase::Held { way: held, .. }) if held == way => {
                Phase::Held { way, until: now + GAP }
            }
            (Stroke::Repeat, _) => Phase::Spent { at: now },
        }
    }

    fn by_repeats(&self, now: Duration, way: Way, stroke: Stroke) -> Phase {
        let since = |at: Duration| now.saturating_sub(at);
        match self.phase {
            // Of a press that is not known, or has ended.
            Phase::Up | Phase::Spent { .. } if stroke == Stroke::Repeat => Phase::Spent { at: now },
            Phase::Up => Phase::Pressed { way, at: now },
            Phase::Pressed { way: before, at } if before == way && FIRST.contains(&since(at)) => {
                Phase::Repeated { way, at: now }
            }
            // Sooner than any keyboard repeats: one that does so already, or a burst.
            Phase::Pressed { at, .. } if since(at) < *FIRST.start() => Phase::Spent { at: now },
            Phase::Pressed { .. } => Phase::Pressed { way, at: now },
            Phase::Repeated { way: before, at } if before == way && since(at) <= REPEAT && now > at => {
                Phase::Held { way, until: now + GAP }
            }
            // A press like the first one.
            Phase::Repeated { way: before, at } if before == way && since(at) > REPEAT => {
                Phase::Repeated { way, at: now }
            }
            Phase::Held { way: before, .. } if before == way => Phase::Held { way, until: now + GAP },
            Phase::Spent { at } if since(at) > PAUSE => Phase::Pressed { way, at: now },
            Phase::Repeated { .. } | Phase::Held { .. } | Phase::Spent { .. } => Phase::Spent { at: now },
        }
    }

    /// Whatever is held does not count any more, before it was let go.
    pub fn end(&mut self, now: Duration) {
        if self.phase != Phase::Up {
            self.phase = Phase::Spent { at: now };
        }
    }

    /// The way of the key that is held now.
    pub fn held(&mut self, now: Duration) -> Option<Way> {
        match self.phase {
            Phase::Held { way, until } if now <= until => Some(way),
            Phase::Held { until, .. } => {
                // It has not reported that the key has gone up, either.
                self.shown = false;
                self.phase = Phase::Spent { at: until.saturating_sub(GAP) };
                None
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    /// The keys of a terminal that has reported that a key has gone up, or reports no such thing.
    fn shown(has_releases: bool) -> Hold {
        let mut hold = Hold::new(has_releases);
        if has_releases {
            hold.release();
        }
        hold
    }

    /// The key that counts as held right after each of these presses, of a terminal that reports nothing else.
    fn presses(at: &[u64]) -> Vec<bool> {
        let mut hold = Hold::new(false);
        let press = |at: &u64| {
            hold.stroke(ms(*at), Way::Forward, Stroke::Down);
            hold.held(ms(*at)).is_some()
        };
        at.iter().map(press).collect()
    }

    #[test]
    fn a_key_is_held_from_its_second_repeat_on() {
        assert_eq!(presses(&[0, 500, 533, 566]), [false, false, true, true]);
        assert_eq!(presses(&[0, 250, 342, 434]), [false, false, true, true]);
        // Let go, and pressed again.
        assert_eq!(presses(&[0, 500, 533, 1_000, 1_500, 1_533]), [false, false, true, false, false, true]);
    }

    #[test]
    fn single_presses_and_bursts_hold_nothing() {
        for at in [
            &[0, 300, 600, 900, 1_200, 1_500][..],
            &[0, 2_000, 4_000, 6_000],
            // Fingers in haste.
            &[0, 120, 240, 360, 480, 600],
            &[0, 150, 300, 450, 600, 750],
            &[0, 210, 330, 450, 570, 690],
            &[0, 0, 0, 0, 0, 0],
            &[0, 5, 10, 15, 20, 25],
            // After a key that was held, and a connection that hung for a second.
            &[0, 33, 66, 1_000, 1_001, 1_002, 1_003],
        ] {
            assert!(!presses(at).contains(&true), "{at:?}");
        }
        // Repeats that hang for longer than the gap end it, although they go on.
        let held = presses(&[0, 500, 533, 800, 833, 866, 899, 932]);
        assert_eq!(held, [false, false, true, false, false, false, false, false]);
    }

    #[test]
    fn a_key_that_ended_a_hold_has_to_be_released_and_the_other_key_ends_it_too() {
        for (has_releases, by_other_key) in [(false, false), (false, true), (true, false), (true, true)] {
            let mut hold = shown(has_releases);
            let repeat = if has_releases { Stroke::Repeat } else { Stroke::Down };
            hold.stroke(ms(0), Way::Back, Stroke::Down);
            assert_eq!(hold.held(ms(0)).is_some(), has_releases);
            for at in [500, 530, 560] {
                hold.stroke(ms(at), Way::Back, repeat);
            }
            assert_eq!(hold.held(ms(560)), Some(Way::Back));
            if by_other_key {
                hold.stroke(ms(570), Way::Forward, Stroke::Down);
                assert_eq!(hold.held(ms(570)), None);
            } else {
                hold.end(ms(600));
            }
            for at in (610..3_000).step_by(30) {
                if by_other_key {
                    hold.stroke(ms(at - 10), Way::Forward, repeat);
                }
                hold.stroke(ms(at), Way::Back, repeat);
                assert_eq!(hold.held(ms(at)), None, "{has_releases} {by_other_key} {at}");
            }
        }
    }

    #[test]
    fn with_releases_it_begins_at_once_and_a_lost_release_ends_it_too() {
        let mut hold = shown(true);
        hold.stroke(ms(0), Way::Forward, Stroke::Down);
        assert_eq!(hold.held(ms(1_200)), Some(Way::Forward));
        assert_eq!(hold.held(ms(1_201)), None, "it never repeats");
        hold.stroke(ms(1_300), Way::Forward, Stroke::Repeat);
        assert_eq!(hold.held(ms(1_300)), None);
        hold.stroke(ms(1_400), Way::Forward, Stroke::Up);
        hold.stroke(ms(1_500), Way::Forward, Stroke::Down);
        hold.stroke(ms(2_000), Way::Forward, Stroke::Repeat);
        assert_eq!(hold.held(ms(2_200)), Some(Way::Forward));
        assert_eq!(hold.held(ms(2_201)), None, "it repeats no more");
        hold.stroke(ms(2_300), Way::Forward, Stroke::Up);
        hold.stroke(ms(2_400), Way::Forward, Stroke::Down);
        hold.stroke(ms(2_420), Way::Forward, Stroke::Up);
        assert_eq!(hold.held(ms(2_420)), None);
    }

    #[test]
    fn a_terminal_that_has_shown_no_release_runs_by_repeats_alone() {
        for kind in [Stroke::Down, Stroke::Repeat] {
            let mut hold = Hold::new(true);
            // A tap, and taps, of which no release is reported.
            for at in (0..26_000).step_by(1_300) {
                hold.stroke(ms(at), Way::Forward, Stroke::Down);
                assert!((at..at + 1_300).all(|at| hold.held(ms(at)).is_none()), "{at}");
            }
            let run = |hold: &mut Hold, begin: u64| {
                hold.stroke(ms(begin), Way::Forward, Stroke::Down);
                assert_eq!(hold.held(ms(begin + 500)), None);
                for at in [500, 533, 566] {
                    hold.stroke(ms(begin + at), Way::Forward, kind);
                }
                assert_eq!(hold.held(ms(begin + 600)), Some(Way::Forward));
            };
            run(&mut hold, 30_000);
            // Its end is reported: from then on it runs at once.
            hold.stroke(ms(30_600), Way::Forward, Stroke::Up);
            assert_eq!(hold.held(ms(30_600)), None);
            hold.stroke(ms(31_000), Way::Forward, Stroke::Down);
            assert_eq!(hold.held(ms(31_000)), Some(Way::Forward));
            // Up to a press of which nothing more is reported.
            assert_eq!(hold.held(ms(32_300)), None);
            hold.stroke(ms(33_000), Way::Forward, Stroke::Down);
            assert_eq!(hold.held(ms(33_000)), None);
            hold.stroke(ms(33_100), Way::Forward, Stroke::Up);
            // Any key shows it, but not to a terminal that does not know what it reports.
            hold.stroke(ms(34_000), Way::Back, Stroke::Down);
            assert_eq!(hold.held(ms(34_000)), Some(Way::Back));
        }
        let mut hold = Hold::new(false);
        hold.release();
        hold.stroke(ms(0), Way::Forward, Stroke::Down);
        assert_eq!(hold.held(ms(0)), None);
    }

    #[test]
    fn repeats_that_hang_after_the_end_of_a_hold_begin_none() {
        let mut hold = shown(false);
        for at in [0, 500, 530, 560] {
            hold.stroke(ms(at), Way::Forward, Stroke::Down);
        }
        assert!(hold.held(ms(560)).is_some());
        hold.end(ms(600));
        // As a press and its first repeats would come.
        for at in [850, 1_100, 1_150, 1_200] {
            hold.stroke(ms(at), Way::Forward, Stroke::Down);
            assert_eq!(hold.held(ms(at)), None, "{at}");
        }
        // Nor do they where releases are reported: a pause as long as that before a first repeat, and the repeats.
        let mut hold = Hold::new(true);
        hold.stroke(ms(0), Way::Forward, Stroke::Down);
        hold.end(ms(100));
        for at in [600, 1_100, 1_133, 1_166, 1_199] {
            hold.stroke(ms(at), Way::Forward, Stroke::Repeat);
            assert_eq!(hold.held(ms(at)), None, "{at}");
        }
    }
}
