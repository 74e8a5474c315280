//! Now, absolute sleep, and waiting for descriptors: the seam between the machine's clock and virtual time.

use std::os::fd::RawFd;

use super::{Regions, Usage};
use crate::time::{S, Time};

/// The descriptors that a window waits on.
#[derive(Debug, Default)]
pub struct PollSet {
    /// In the kernel's own form, so that waiting copies nothing.
    fds: Vec<libc::pollfd>,
}

impl PollSet {
    /// With room for so many: no more are ever filled in without a new allocation.
    pub fn with_room(descriptors: usize) -> PollSet {
        // Written once, so that its pages are there; a descriptor below 0 is none.
        PollSet { fds: vec![libc::pollfd { fd: -1, events: 0, revents: 0 }; descriptors] }
    }

    /// Adds its room, to be locked; before it is first filled.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.fds);
    }

    /// Waits on these for reading, and on none of before. The place of one that is not there is kept.
    pub fn fill(&mut self, descriptors: impl IntoIterator<Item = Option<RawFd>>) {
        let poll =
            |fd: Option<RawFd>| libc::pollfd { fd: fd.unwrap_or(-1), events: libc::POLLIN, revents: 0 };
        self.fds.clear();
        self.fds.extend(descriptors.into_iter().map(poll));
    }

    /// How many places it has.
    pub fn places(&self) -> usize {
        self.fds.len()
    }

    /// Sets what [`is_readable`](Self::is_readable) says of a place.
    pub fn set_readable(&mut self, place: usize, is_readable: bool) {
        if let Some(poll) = self.fds.get_mut(place) {
            (poll.fd, poll.revents) = (0, if is_readable { libc::POLLIN } else { 0 });
        }
    }

    /// Whether the last wait found the descriptor at this place readable, or broken; true without a descriptor, of
    /// which it says nothing.
    pub fn is_readable(&self, place: usize) -> bool {
        self.fds.get(place).is_none_or(|poll| poll.fd < 0 || poll.revents != 0)
    }
}

/// The clock of the loop.
pub trait Clock: Send {
    /// The current instant.
    fn now(&mut self) -> Time;

    /// Sleeps until `at`, returns at once if it has passed. May return late, never early.
    fn sleep_until(&mut self, at: Time);

    /// Waits until a descriptor of `set` is readable (true) or `until` has passed (false).
    fn wait(&mut self, set: &mut PollSet, until: Time) -> bool;

    /// One turn of a spinning wait: keeps the processor, lets no other thread run.
    fn spin(&mut self);

    /// The current instant at the begin of another turn of a spinning wait, in which nothing has come since the turn
    /// before.
    fn turn(&mut self) -> Time {
        self.now()
    }

    /// Spins until `at`; returns when that was noticed.
    fn spin_until(&mut self, at: Time) -> Time {
        loop {
            let now = self.now();
            if now >= at {
                return now;
            }
            self.spin();
        }
    }

    /// For how long the computer was suspended since it was started, ns: at most that, and a little less when this
    /// thread is interrupted in between.
    fn suspended_ns(&mut self) -> u64 {
        0
    }

    /// The kernel's counts against the calling thread; none in virtual time.
    fn usage(&mut self) -> Usage {
        Usage::default()
    }
}

/// CLOCK_MONOTONIC of this machine.
#[derive(Clone, Copy, Debug, Default)]
pub struct MonotonicClock;

impl MonotonicClock {
    /// The current instant, for callers without a `&mut Clock`.
    pub fn read() -> Time {
        read(libc::CLOCK_MONOTONIC)
    }
}

fn read(clock: libc::clockid_t) -> Time {
    let mut ts = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `ts` is a valid timespec; the callers name clocks that exist on every Linux (CLOCK_BOOTTIME since
    // 2.6.39), so the call cannot fail.
    unsafe { libc::clock_gettime(clock, &mut ts) };
    Time(ts.tv_sec as u64 * S + ts.tv_nsec as u64)
}

impl Clock for MonotonicClock {
    fn now(&mut self) -> Time {
        MonotonicClock::read()
    }

    fn sleep_until(&mut self, at: Time) {
        let ts = libc::timespec { tv_sec: (at.0 / S) as _, tv_nsec: (at.0 % S) as libc::c_long };
        // An absolute sleep may be repeated as it stands when a signal interrupts it.
        // SAFETY: `ts` is a valid timespec and the remainder is not requested.
        while unsafe {
            libc::clock_nanosleep(libc::CLOCK_MONOTONIC, libc::TIMER_ABSTIME, &ts, std::ptr::null_mut())
        } == libc::EINTR
        {}
    }

    fn wait(&mut self, set: &mut PollSet, until: Time) -> bool {
        let left = until.since(self.now());
        let ts = libc::timespec { tv_sec: (left / S) as _, tv_nsec: (left % S) as libc::c_long };
        // ppoll and not a socket time-out: those have the resolution of a scheduler tick.
        // SAFETY: `fds` is a live slice of pollfd and `ts` a valid timespec; no signal mask is given.
        let ready = unsafe {
            libc::ppoll(set.fds.as_mut_ptr(), set.fds.len() as libc::nfds_t, &ts, std::ptr::null())
        };
        ready > 0
    }

    fn spin(&mut self) {
        std::hint::spin_loop();
    }

    /// CLOCK_BOOTTIME goes on in a suspended computer, CLOCK_MONOTONIC stands still.
    fn suspended_ns(&mut self) -> u64 {
        let boot = read(libc::CLOCK_BOOTTIME);
        // Read second: an interruption in between makes the difference smaller, never larger.
        boot.since(MonotonicClock::read())
    }

    fn usage(&mut self) -> Usage {
        Usage::of_thread()
    }
}
