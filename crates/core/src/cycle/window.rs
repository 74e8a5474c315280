//! The receive window: takes replies in until no exchange is waited for any more, and no bus wants to be polled, or the
//! deadline has passed.
//!
//! Waiting by poll costs two system calls a look. With 64 drives a look for every reply would be far too many, so
//! after the first replies came in, the window sleeps once for as long as the rest usually takes, and then looks
//! again.

use super::plan::Wait;
use super::status::BusInfo;
use crate::axis::cell::Writer;
use crate::bus::{Bus, BusNumbers, Cycle, Slot, Waits};
use crate::inputs::InputLog;
use crate::rt::{Clock, PollSet, Regions, Wires};
use crate::time::{Time, US};

/// The shortest nap, ns; a shorter one is not worth its system call.
const SHORTEST_NAP_NS: u64 = 5 * US;
/// While no reply is missing the idle time of a half-duplex wire is spun, up to so long, ns: 33 bits at 1.5 Mbit/s take
/// 22 us, which is less than a sleep takes to end.
const LONGEST_SPIN_NS: u64 = 30 * US;

/// How this loop waits for replies.
#[derive(Debug)]
pub struct Window {
    wait: Wait,
    /// One of the buses wants to be polled.
    polls: bool,
    poll_set: PollSet,
    /// The replies that each bus waits for, as of the last call of it.
    waits: Box<[Waits]>,
    /// The learned time from the first look that found replies to the last reply, ns: a sufficient nap makes it a
    /// sixteenth shorter, one that was too short a quarter longer.
    nap_ns: u64,
}

/// An open bus, its slots, and the outlets of its numbers.
pub struct OpenBus {
    /// The bus.
    pub bus: Box<dyn Bus>,
    /// The constants of the bus.
    pub info: BusInfo,
    /// The first slot.
    pub first: usize,
    /// One past its last slot.
    pub end: usize,
    /// A call of it is under way, or has panicked.
    pub is_at_work: bool,
    /// The numbers.
    pub numbers: Writer<BusNumbers>,
    /// It is on a half-duplex wire, and wants to be polled.
    pub is_polled: bool,
    /// One frame serves all its drives.
    pub is_one_frame: bool,
    /// Whether the wires are still those of the loop.
    pub gate: Gate,
}

/// Whether the wires are still those of the loop, as it looks before each batch.
#[derive(Clone, Debug, Default)]
pub struct Gate {
    wires: Wires,
    log: InputLog,
}

impl Gate {
    /// That of a loop with this log.
    pub fn new(wires: Wires, log: InputLog) -> Gate {
        Gate { wires, log }
    }

    /// The wires.
    pub fn wires(&self) -> &Wires {
        &self.wires
    }

    /// The wires were taken from the loop: nothing more may be sent, and nothing is received.
    #[inline]
    pub fn is_closed(&self) -> bool {
        self.log.flag(false, self.wires.are_taken())
    }

    /// The loop has ended by itself. False if the wires were taken before.
    pub fn end(&self) -> bool {
        !self.log.flag(false, !self.wires.end())
    }
}

impl OpenBus {
    /// Lets the bus do some work on its own of all `slots`.
    pub fn work<R>(&mut self, slots: &mut [Slot], work: impl FnOnce(&mut dyn Bus, &mut [Slot]) -> R) -> R {
        self.is_at_work = true;
        let done = work(&mut *self.bus, &mut slots[self.first..self.end]);
        self.is_at_work = false;
        done
    }

    /// The same of work that hands bytes to the kernel or takes some from it. `None`: the wires are no longer the
    /// loop's.
    #[inline]
    pub fn exchange<R>(
        &mut self,
        slots: &mut [Slot],
        work: impl FnOnce(&mut dyn Bus, &mut [Slot]) -> R,
    ) -> Option<R> {
        if self.gate.is_closed() {
            return None;
        }
        Some(self.work(slots, work))
    }

    /// Adds the memory that the loop touches for it, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.bus.memory(regions);
        self.numbers.memory(regions);
        self.gate.wires.memory(regions);
    }

    /// The replies that the window waits for on the bus.
    #[inline]
    pub fn waits(&self, cycle: &Cycle, slots: &[Slot]) -> Waits {
        self.bus.waits(cycle, &slots[self.first..self.end])
    }

    /// Publishes the numbers of the bus.
    pub fn publish(&mut self) {
        self.numbers.write(&self.bus.numbers());
    }
}

impl std::fmt::Debug for OpenBus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("OpenBus").field("first", &self.first).field("end", &self.end).finish_non_exhaustive()
    }
}

impl Window {
    /// A window over these buses.
    pub fn new(wait: Wait, buses: &[OpenBus]) -> Window {
        Window {
            wait,
            polls: buses.iter().any(|open| open.is_polled),
            poll_set: PollSet::with_room(buses.len()),
            waits: vec![Waits::for_replies(0); buses.len()].into(),
            nap_ns: 4 * SHORTEST_NAP_NS,
        }
    }

    /// Adds the memory that it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.poll_set.memory(regions);
        regions.add(&*self.waits);
    }

    /// Runs the window of `cycle`, which begins `now`. False: the wires were found taken in it.
    #[inline]
    pub fn run<C: Clock>(
        &mut self,
        clock: &mut C,
        cycle: &Cycle,
        now: Time,
        buses: &mut [OpenBus],
        slots: &mut [Slot],
    ) -> bool {
        match self.polls {
            false => self.turns::<C, false>(clock, cycle, now, buses, slots),
            true => self.turns::<C, true>(clock, cycle, now, buses, slots),
        }
    }

    /// The same, with or without buses that want to be polled.
    #[inline]
    fn turns<C: Clock, const POLLS: bool>(
        &mut self,
        clock: &mut C,
        cycle: &Cycle,
        begin: Time,
        buses: &mut [OpenBus],
        slots: &mut [Slot],
    ) -> bool {
        let mut begin = Some(begin);
        for (place, open) in buses.iter().enumerate() {
            self.note(place, open, cycle, slots);
        }
        let (mut left, mut poll_at) = self.all::<POLLS>();
        let owed = left;
        let mut napped = false;
        // The turn before has polled a bus: it was none in which nothing came.
        let mut polled = false;
        // Bounded by the deadline: each turn waits towards it.
        while left > 0 || poll_at < cycle.deadline {
            let mut now = begin.take().unwrap_or_else(|| match self.wait {
                Wait::Spin if !(POLLS && polled) => clock.turn(),
                _ => clock.now(),
            });
            polled = false;
            let spin_ns = if left == 0 { LONGEST_SPIN_NS } else { SHORTEST_NAP_NS };
            if POLLS && self.wait == Wait::Poll && now < poll_at && poll_at.since(now) <= spin_ns {
                now = clock.spin_until(poll_at.min(cycle.deadline));
            }
            let over = now >= cycle.deadline;
            if POLLS && !over && poll_at <= now {
                for (place, open) in buses.iter_mut().enumerate() {
                    if self.waits[place].poll_at <= now {
                        if open.exchange(slots, |bus, slots| bus.poll(cycle, now, slots)).is_none() {
                            return false;
                        }
                        self.note(place, open, cycle, slots);
                    }
                }
                (left, poll_at) = self.all::<POLLS>();
                polled = true;
                continue;
            }
            // One nap a window, once the first replies are in and more than one is missing. It would hold up a wire on
            // which each reply lets the next request leave.
            let nap = !over
                && self.wait == Wait::Poll
                && !napped
                && left < owed
                && left > 1
                && poll_at == Waits::NEVER;
            match self.wait {
                _ if over => {}
                Wait::Spin => clock.spin(),
                Wait::Poll if nap => {
                    napped = true;
                    clock.sleep_until((now + self.nap_ns).min(cycle.deadline));
                }
                Wait::Poll => {
                    self.poll_set.fill(buses.iter().map(|open| open.bus.fd()));
                    clock.wait(&mut self.poll_set, poll_at.min(cycle.deadline));
                }
            }
            // Replies that are in the sockets at the deadline still count. No bus is read that has nothing: the wait
            // says which have, and after a nap and at the deadline only missing replies are looked for.
            let waited = !over && !nap;
            for (place, open) in buses.iter_mut().enumerate() {
                let reads = match self.wait {
                    Wait::Poll if waited => self.poll_set.is_readable(place),
                    Wait::Poll => self.waits[place].replies > 0 || open.is_polled,
                    Wait::Spin => true,
                };
                if reads {
                    if open.exchange(slots, |bus, slots| bus.receive(cycle, slots)).is_none() {
                        return false;
                    }
                    self.note(place, open, cycle, slots);
                }
            }
            (left, poll_at) = self.all::<POLLS>();
            if nap {
                self.learn(left == 0, cycle);
            }
            if over {
                break;
            }
        }
        true
    }

    /// Notes what the bus waits for.
    #[inline]
    fn note(&mut self, place: usize, open: &OpenBus, cycle: &Cycle, slots: &[Slot]) {
        self.waits[place] = open.waits(cycle, slots);
    }

    /// The replies that all of them wait for.
    #[inline]
    fn all<const POLLS: bool>(&self) -> (usize, Time) {
        let left = self.waits.iter().map(|waits| waits.replies).sum();
        let poll_at = match POLLS {
            true => self.waits.iter().map(|waits| waits.poll_at).min().unwrap_or(Waits::NEVER),
            false => Waits::NEVER,
        };
        (left, poll_at)
    }

    fn learn(&mut self, enough: bool, cycle: &Cycle) {
        let longest = (cycle.deadline.since(cycle.grid) / 4).max(SHORTEST_NAP_NS);
        let nap = if enough { self.nap_ns - self.nap_ns / 16 } else { self.nap_ns + self.nap_ns / 4 };
        self.nap_ns = nap.clamp(SHORTEST_NAP_NS, longest);
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;
    use std::os::fd::{AsRawFd, RawFd};
    use std::os::unix::net::UnixDatagram;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;
    use crate::axis::cell::cell;
    use crate::bus::Exchange;
    use crate::rt::MonotonicClock;
    use crate::time::{MS, S};

    /// A clock on which only sleeps and waits take time. Something arrives at `arrives`.
    struct Steps {
        steps: Vec<(&'static str, Time)>,
        arrives: Time,
        /// The number of readings at the start of a turn that found nothing.
        turns: usize,
    }

    impl Steps {
        fn go(&mut self, what: &'static str, at: Time) {
            let at = at.max(self.now());
            self.steps.push((what, at));
        }
    }

    impl Clock for Steps {
        fn now(&mut self) -> Time {
            self.steps.last().map_or(Time(0), |(_, at)| *at)
        }

        fn sleep_until(&mut self, at: Time) {
            self.go("nap", at);
        }

        fn wait(&mut self, _: &mut PollSet, until: Time) -> bool {
            let arrives = self.now() < self.arrives && self.arrives < until;
            self.go("wait", if arrives { self.arrives } else { until });
            arrives
        }

        fn spin(&mut self) {
            let at = self.now() + 10 * US;
            self.go("spin", at);
        }

        fn turn(&mut self) -> Time {
            self.turns += 1;
            self.now()
        }
    }

    /// The first of its replies is there, or comes as one byte on its socket if it has one. It may want to be polled
    /// again and again.
    #[derive(Default)]
    struct Turns {
        poll_at: Option<Time>,
        socket: Option<UnixDatagram>,
        /// How often it was read.
        reads: Arc<AtomicU64>,
    }

    impl Bus for Turns {
        fn memory(&self, _: &mut Regions) {}

        fn fd(&self) -> Option<RawFd> {
            self.socket.as_ref().map(UnixDatagram::as_raw_fd)
        }

        fn send(&mut self, _: &Cycle, _: &mut [Slot]) {}

        fn receive(&mut self, _: &Cycle, slots: &mut [Slot]) {
            self.reads.fetch_add(1, Ordering::Relaxed);
            if self.socket.as_ref().is_none_or(|socket| socket.recv(&mut [0]).is_ok()) {
                slots[0].exchange = Exchange::Idle;
            }
        }

        fn prepare(&mut self, _: &Cycle, _: &mut [Slot]) {}

        fn waits(&self, cycle: &Cycle, slots: &[Slot]) -> Waits {
            let replies = slots.iter().filter(|slot| slot.exchange.is_waited_for(cycle)).count();
            Waits { replies, poll_at: self.poll_at.unwrap_or(Waits::NEVER) }
        }

        fn poll(&mut self, cycle: &Cycle, now: Time, _: &mut [Slot]) {
            assert!(self.poll_at.is_some_and(|at| at <= now) && now < cycle.deadline);
            self.poll_at = Some(now + 200 * US);
        }

        fn shut_down(&mut self, _: &Cycle, _: &mut [Slot]) -> bool {
            true
        }

        fn numbers(&self) -> BusNumbers {
            BusNumbers::default()
        }
    }

    /// An open bus of these slots.
    fn open_bus(bus: Turns, slots: Range<usize>) -> OpenBus {
        OpenBus {
            is_polled: bus.poll_at.is_some(),
            bus: Box::new(bus),
            info: BusInfo { name: String::new(), devices: Vec::new(), own_counters: &[], notes: None },
            first: slots.start,
            end: slots.end,
            is_at_work: false,
            is_one_frame: false,
            gate: Gate::default(),
            numbers: cell(BusNumbers::default()).0,
        }
    }

    /// What a window until 500 us does, until when in us, with so many replies owed, the first of which comes at
    /// `arrives_us`.
    fn steps(wait: Wait, owed: usize, arrives_us: u64, poll_at_us: Option<u64>) -> Vec<(&'static str, u64)> {
        let clock = window(wait, owed, arrives_us, poll_at_us);
        clock.steps.into_iter().map(|(what, at)| (what, at.0 / US)).collect()
    }

    /// The clock of that window after it.
    fn window(wait: Wait, owed: usize, arrives_us: u64, poll_at_us: Option<u64>) -> Steps {
        let cycle = Cycle { index: 0, grid: Time(0), period_ns: MS, deadline: Time(500 * US) };
        let bus = Turns { poll_at: poll_at_us.map(|us| Time(us * US)), ..Turns::default() };
        let exchange = Exchange::Owed { sent_at: Time(0), reply_by: cycle.deadline, awaited: false };
        let mut slots = vec![Slot { exchange, ..Slot::default() }; owed];
        let mut clock = Steps { steps: Vec::new(), arrives: Time(arrives_us * US), turns: 0 };
        slots.resize(owed.max(1), Slot::default());
        let mut buses = [open_bus(bus, 0..slots.len())];
        let begin = clock.now();
        Window::new(wait, &buses).run(&mut clock, &cycle, begin, &mut buses, &mut slots);
        clock
    }

    #[test]
    fn a_window_wakes_when_a_bus_wants_to_be_polled_and_is_open_for_that_until_its_deadline() {
        for (what, owed, arrives_us, poll_at_us, expected) in [
            ("nothing to wait for", 0, 0, None, &[][..]),
            ("until the deadline", 1, 0, None, &[("wait", 500)]),
            ("or until a reply", 1, 50, None, &[("wait", 50)]),
            ("to be polled", 1, 50, Some(100), &[("wait", 50), ("wait", 100), ("wait", 300)]),
            ("without any reply that is owed", 0, 0, Some(100), &[("wait", 100), ("wait", 300)]),
            ("at once", 0, 0, Some(0), &[("wait", 200), ("wait", 400)]),
            ("that is for the next window", 0, 0, Some(500), &[]),
            ("a short time", 0, 0, Some(20), &[("spin", 10), ("spin", 20), ("wait", 220), ("wait", 420)]),
        ] {
            assert_eq!(steps(Wait::Poll, owed, arrives_us, poll_at_us), expected, "{what}");
        }
        // A shorter one is spun also while a reply is missing.
        assert_eq!(steps(Wait::Poll, 1, 0, Some(20))[0], ("wait", 20));
        assert_eq!(steps(Wait::Poll, 1, 0, Some(5))[0], ("spin", 10));
        assert_eq!(steps(Wait::Spin, 0, 0, Some(490)).last(), Some(&("spin", 490)));
        // No nap holds up a bus that wants to be polled.
        let naps = |poll_at| steps(Wait::Poll, 3, 50, poll_at).iter().any(|(what, _)| *what == "nap");
        assert!(naps(None) && !naps(Some(100)));
    }

    #[test]
    fn a_window_ends_at_once_when_the_wires_were_taken() {
        // A reply is owed, or the bus wants to be polled at once: neither is waited for by a loop that may not look.
        for (owed, poll_at) in [(1, None), (0, Some(Time(0))), (1, Some(Time(0)))] {
            let cycle = Cycle { index: 0, grid: Time(0), period_ns: MS, deadline: Time(500 * US) };
            let exchange = Exchange::Owed { sent_at: Time(0), reply_by: cycle.deadline, awaited: false };
            let mut slots = [Slot { exchange, ..Slot::default() }];
            let open = open_bus(Turns { poll_at, ..Turns::default() }, 0..owed);
            assert!(open.gate.wires().take(crate::rt::Taker::Watch));
            let mut clock = Steps { steps: Vec::new(), arrives: Time(50 * US), turns: 0 };
            let mut buses = [open];
            let mut window = Window::new(Wait::Poll, &buses);
            assert!(!window.run(&mut clock, &cycle, Time(0), &mut buses, &mut slots));
            assert_eq!(slots[0].exchange, exchange, "it was received");
        }
    }

    #[test]
    fn a_turn_after_a_poll_is_none_in_which_nothing_came() {
        // Spins of 10 us up to the poll at 300 us, after which none follows in time. Each begins with a turn, but the
        // first one and that after the poll at 100 us; so does each poll.
        let clock = window(Wait::Spin, 0, 0, Some(100));
        assert_eq!((clock.steps.len(), clock.turns), (30, 30));
    }

    #[test]
    fn a_bus_without_anything_to_read_is_not_read() {
        // The first misses a reply, which is there; the second owes nothing; on the third there is something although
        // nothing is missing.
        let reads: [_; 3] = std::array::from_fn(|_| Arc::new(AtomicU64::new(0)));
        let begin = MonotonicClock::read();
        let cycle = Cycle { index: 0, grid: begin, period_ns: 40 * S, deadline: begin + 20 * S };
        let owed = Exchange::Owed { sent_at: begin, reply_by: cycle.deadline, awaited: false };
        let mut slots = vec![Slot::default(); 3];
        slots[0].exchange = owed;
        let mut far_ends = Vec::new();
        let mut open = |place: usize| {
            let (socket, far_end) = UnixDatagram::pair().unwrap();
            socket.set_nonblocking(true).unwrap();
            if place != 1 {
                far_end.send(&[7]).unwrap();
            }
            far_ends.push(far_end);
            let bus = Turns { poll_at: None, socket: Some(socket), reads: Arc::clone(&reads[place]) };
            open_bus(bus, place..place + 1)
        };
        let mut buses = [open(0), open(1), open(2)];
        Window::new(Wait::Poll, &buses).run(&mut MonotonicClock, &cycle, cycle.grid, &mut buses, &mut slots);
        assert_eq!(slots[0].exchange, Exchange::Idle);
        assert_eq!(reads.map(|reads| reads.load(Ordering::Relaxed)), [1, 0, 1]);
    }

    #[test]
    fn a_nap_gets_a_sixteenth_shorter_or_a_quarter_longer_within_its_bounds() {
        let mut window = Window::new(Wait::Poll, &[]);
        let cycle = Cycle { index: 9, grid: Time(MS), period_ns: MS, deadline: Time(MS + 400 * US) };
        let mut naps = |enough, times| {
            (0..times).for_each(|_| window.learn(enough, &cycle));
            window.nap_ns
        };
        assert_eq!([naps(true, 1), naps(false, 1)], [18_750, 23_437]);
        assert_eq!([naps(false, 99), naps(true, 999)], [100 * US, 5 * US]);
    }
}
