//! The clock of a recorded run, and that of a repeated one.

use crate::inputs::entry::Kind;
use crate::inputs::recording::Mark;
use crate::inputs::{InputLog, Recording};
use crate::rt::{Clock, PollSet, Usage};
use crate::time::Time;

/// A clock whose readings are in the log.
#[derive(Debug)]
pub struct LoggedClock<C> {
    clock: C,
    log: InputLog,
    suspended_ns: u64,
    /// Of a spinning wait: before and behind its last turn.
    turn: Option<(Mark, Mark)>,
}

impl<C> LoggedClock<C> {
    /// `clock` with this log.
    pub fn new(clock: C, log: &InputLog) -> LoggedClock<C> {
        LoggedClock { clock, log: log.source(), suspended_ns: 0, turn: None }
    }

    /// The clock itself.
    pub fn inner(&mut self) -> &mut C {
        &mut self.clock
    }
}

#[inline]
fn read(recording: &Recording, at: Time) {
    recording.entry_at(Kind::Clock, at, &[], &[]);
}

impl<C: Clock> Clock for LoggedClock<C> {
    #[inline]
    fn now(&mut self) -> Time {
        let now = self.clock.now();
        if let Some(recording) = self.log.as_recording() {
            read(recording, now);
        }
        now
    }

    fn sleep_until(&mut self, at: Time) {
        self.clock.sleep_until(at);
    }

    fn wait(&mut self, set: &mut PollSet, until: Time) -> bool {
        let ready = self.clock.wait(set, until);
        if let Some(recording) = self.log.as_recording() {
            for first in (0..set.places()).step_by(64) {
                let places = first..set.places().min(first + 64);
                let idle = |place: &usize| !set.is_readable(*place);
                let bits = places.filter(idle).fold(0_u64, |bits, place| bits | 1 << (place - first));
                match bits {
                    0 => recording.nothing(),
                    bits => recording.entry(Kind::Wait, &[bits], &[]),
                }
            }
        }
        ready
    }

    fn spin(&mut self) {
        self.clock.spin();
    }

    /// A turn before it that found nothing is not in the log: the repeated run has one turn for all of them.
    #[inline]
    fn turn(&mut self) -> Time {
        let now = self.clock.now();
        if let Some(recording) = self.log.as_recording() {
            if let Some((before, behind)) = self.turn
                && recording.is_at(behind)
            {
                recording.go_back(before);
            }
            let before = recording.mark();
            read(recording, now);
            self.turn = Some((before, recording.mark()));
        }
        now
    }

    fn spin_until(&mut self, at: Time) -> Time {
        let now = self.clock.spin_until(at);
        if let Some(recording) = self.log.as_recording() {
            read(recording, now);
        }
        now
    }

    fn suspended_ns(&mut self) -> u64 {
        let before = self.suspended_ns;
        self.suspended_ns = self.log.value(before, self.clock.suspended_ns());
        self.suspended_ns
    }

    fn usage(&mut self) -> Usage {
        self.clock.usage()
    }
}

/// The times of a log. Nothing waits.
#[derive(Debug)]
pub struct ReplayClock {
    log: InputLog,
    suspended_ns: u64,
}

impl ReplayClock {
    /// The times of `log`, which is one that is read.
    pub fn new(log: &InputLog) -> ReplayClock {
        ReplayClock { log: log.source(), suspended_ns: 0 }
    }
}

impl Clock for ReplayClock {
    fn now(&mut self) -> Time {
        self.log.as_replaying().map_or(Time(0), |replaying| replaying.clock())
    }

    fn sleep_until(&mut self, _at: Time) {}

    fn wait(&mut self, set: &mut PollSet, _until: Time) -> bool {
        let Some(replaying) = self.log.as_replaying() else { return false };
        let mut ready = false;
        for first in (0..set.places()).step_by(64) {
            let idle = replaying.look(&[Kind::Wait], |_| true).map_or(0, |entry| entry.word(0));
            for place in first..set.places().min(first + 64) {
                let is_readable = idle >> (place - first) & 1 == 0;
                set.set_readable(place, is_readable);
                ready |= is_readable;
            }
        }
        ready
    }

    fn spin(&mut self) {}

    fn spin_until(&mut self, _at: Time) -> Time {
        self.now()
    }

    fn suspended_ns(&mut self) -> u64 {
        self.suspended_ns = self.log.value(self.suspended_ns, 0);
        self.suspended_ns
    }
}
