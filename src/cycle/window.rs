//! The receive window: takes replies in until no exchange is waited for any more, and no bus wants to be polled, or the
//! deadline has passed.
//!
//! Waiting by poll costs two system calls a look. With 64 drives a look for every reply would be far too many, so
//! after the first replies came in, the window sleeps once for as long as the rest usually takes, and then looks
//! again.

use super::plan::Wait;
use crate::bus::{Bus, Cycle, Slot};
use crate::rt::{Clock, PollSet, Regions};
use crate::time::{Time, US};

/// The shortest nap, ns; a shorter one is not worth its system call.
const SHORTEST_NAP_NS: u64 = 5 * US;

/// How this loop waits for replies.
#[derive(Debug)]
pub struct Window {
    wait: Wait,
    poll_set: PollSet,
    /// The learned time from the first look that found replies to the last reply, ns: a sufficient nap makes it a
    /// sixteenth shorter, one that was too short a quarter longer.
    nap_ns: u64,
}

/// One bus and its slots.
pub struct OpenBus {
    /// The bus.
    pub bus: Box<dyn Bus>,
    /// Its first slot.
    pub first: usize,
    /// One past its last slot.
    pub end: usize,
    /// A call of it is under way, or has panicked.
    pub is_at_work: bool,
}

impl OpenBus {
    /// Lets the bus do some work on its own of all `slots`.
    pub fn work<R>(&mut self, slots: &mut [Slot], work: impl FnOnce(&mut dyn Bus, &mut [Slot]) -> R) -> R {
        self.is_at_work = true;
        let done = work(&mut *self.bus, &mut slots[self.first..self.end]);
        self.is_at_work = false;
        done
    }

    /// Why its drives have no connection, one entry each; for the end, not for the cycle.
    pub fn not_connected(&self) -> Vec<Option<String>> {
        let notes = self.bus.notes();
        let note = |index| notes.as_ref().and_then(|notes| notes.get(index));
        (0..self.end - self.first).map(note).collect()
    }
}

impl std::fmt::Debug for OpenBus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("OpenBus").field("first", &self.first).field("end", &self.end).finish_non_exhaustive()
    }
}

impl Window {
    /// A window over so many buses.
    pub fn new(wait: Wait, buses: usize) -> Window {
        Window { wait, poll_set: PollSet::with_room(buses), nap_ns: 4 * SHORTEST_NAP_NS }
    }

    /// Adds the memory that it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.poll_set.memory(regions);
    }

    /// Runs the window of `cycle`.
    pub fn run<C: Clock>(&mut self, clock: &mut C, cycle: &Cycle, buses: &mut [OpenBus], slots: &mut [Slot]) {
        let owed = missing(cycle, slots);
        let (mut left, mut poll_at) = (owed, poll_at(cycle, buses));
        let mut napped = false;
        // Bounded by the deadline: each turn waits towards it.
        while left > 0 || poll_at.is_some() {
            let now = clock.now();
            let over = now >= cycle.deadline;
            if !over && poll_at.is_some_and(|at| at <= now) {
                for open in buses.iter_mut().filter(|open| open.bus.poll_at().is_some_and(|at| at <= now)) {
                    open.work(slots, |bus, slots| bus.poll(cycle, now, slots));
                }
                (left, poll_at) = (missing(cycle, slots), self::poll_at(cycle, buses));
                continue;
            }
            // One nap a window, once the first replies are in and more than one is missing. It would hold up a wire on
            // which each reply lets the next request leave.
            let nap =
                !over && self.wait == Wait::Poll && !napped && left < owed && left > 1 && poll_at.is_none();
            match self.wait {
                _ if over => {}
                Wait::Spin => clock.spin(),
                Wait::Poll if nap => {
                    napped = true;
                    clock.sleep_until((now + self.nap_ns).min(cycle.deadline));
                }
                Wait::Poll => {
                    self.poll_set.fill(buses.iter().filter_map(|open| open.bus.fd()));
                    clock.wait(&mut self.poll_set, poll_at.unwrap_or(cycle.deadline));
                }
            }
            // Replies that are in the sockets at the deadline still count.
            for open in buses.iter_mut() {
                open.work(slots, |bus, slots| bus.receive(cycle, slots));
            }
            (left, poll_at) = (missing(cycle, slots), self::poll_at(cycle, buses));
            if nap {
                self.learn(left == 0, cycle);
            }
            if over {
                return;
            }
        }
    }

    fn learn(&mut self, enough: bool, cycle: &Cycle) {
        let longest = (cycle.deadline.since(cycle.grid) / 4).max(SHORTEST_NAP_NS);
        let nap = if enough { self.nap_ns - self.nap_ns / 16 } else { self.nap_ns + self.nap_ns / 4 };
        self.nap_ns = nap.clamp(SHORTEST_NAP_NS, longest);
    }
}

/// How many exchanges this window still waits for.
fn missing(cycle: &Cycle, slots: &[Slot]) -> usize {
    slots.iter().filter(|slot| slot.exchange.is_waited_for(cycle)).count()
}

/// When the first of the buses wants to be polled, if that is inside this window.
fn poll_at(cycle: &Cycle, buses: &[OpenBus]) -> Option<Time> {
    buses.iter().filter_map(|open| open.bus.poll_at()).filter(|at| *at < cycle.deadline).min()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::MS;

    #[test]
    fn a_nap_gets_a_sixteenth_shorter_or_a_quarter_longer_within_its_bounds() {
        let mut window = Window::new(Wait::Poll, 1);
        let cycle = Cycle { index: 9, grid: Time(MS), period_ns: MS, deadline: Time(MS + 400 * US) };
        let mut naps = |enough, times| {
            (0..times).for_each(|_| window.learn(enough, &cycle));
            window.nap_ns
        };
        assert_eq!([naps(true, 1), naps(false, 1)], [18_750, 23_437]);
        assert_eq!([naps(false, 99), naps(true, 999)], [100 * US, 5 * US]);
    }
}
