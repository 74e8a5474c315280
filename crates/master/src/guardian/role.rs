//! What a guardian does, in a process of its own.
//!
//! It polls the master's sign of life, and waits for the end of its process. If the loop gives none for too long, or
//! the process has ended without an orderly end, it takes the wires and stops the drives, as the watch of a stuck loop
//! does. It ends once nothing is left to be done: with the orderly end of its master, or when the drives are stopped
//! and the master can send nothing more. The locks of the drives are free then, not before.
//!
//! Once it has started it opens nothing and starts nothing: a filter leaves it the calls that it needs.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, Write as _};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::sync::atomic::Ordering;
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::signal::SigSet;
use nix::sys::socket::{Backlog, listen};
use nix::sys::time::TimeSpec;

use super::{HAS_ROLE, Numbers, READY, ROLE};
use crate::watch::LATEST_NS;
use fieldbeat_core::bus::LastResort;
use fieldbeat_core::bus::last::ROUND_NS;
use fieldbeat_core::cycle::ring;
use fieldbeat_core::cycle::watch::{Verdict, Watch};
use fieldbeat_core::drive::last::{LastStop, describe};
use fieldbeat_core::rt::confine::{OF_EVERY_THREAD, allow_only};
use fieldbeat_core::rt::{self, Held, MonotonicClock, Taker, Wires, child};
use fieldbeat_core::time::{MS, Time};

/// The calls that a guardian makes, next to those of every thread.
const CALLS: [libc::c_long; 9] = [
    // The telegrams and their replies.
    libc::SYS_sendto,
    libc::SYS_recvfrom,
    // Waits for the end of the master.
    libc::SYS_ppoll,
    // The locks are its own now.
    libc::SYS_listen,
    // Writes what it has done; musl's `pwrite` is made of the others.
    libc::SYS_pwrite64,
    libc::SYS_pwritev2,
    libc::SYS_fcntl,
    libc::SYS_close,
    // The stack of the thread, when it has used it up.
    libc::SYS_prlimit64,
];

/// Room for what it has done, in words.
const REPORT: usize = 2048;

/// Makes this program able to guard its own masters: to be called first in `main`, before a thread is started or a file
/// is opened.
///
/// It returns at once in the program that was started by somebody. A master that has LinMot drives starts the same
/// program once more, and there this function never returns: that process is the guardian of the master
/// ([`Setup`](crate::Setup)). It stops the drives when the master's process was killed, has crashed or does not run.
pub fn guardian_main() {
    HAS_ROLE.store(true, Ordering::Relaxed);
    let mut arguments = std::env::args_os().skip(1);
    if arguments.next().is_none_or(|role| role != ROLE) {
        return;
    }
    let numbers = arguments.next().and_then(|numbers| Numbers::from_argument(numbers.to_str()?));
    let Some(numbers) = numbers else {
        eprintln!("fieldbeat: {ROLE} is for a master of this version, which starts its guardian by itself");
        std::process::exit(2);
    };
    let _ = guard(numbers);
    // SAFETY: ends the process without the handlers of a program that has not begun.
    unsafe { libc::_exit(0) }
}

fn guard(numbers: Numbers) -> io::Result<()> {
    let mut descriptors = child::received(numbers.first, numbers.count)?.into_iter();
    let mut next = || descriptors.next().ok_or(io::ErrorKind::InvalidInput);
    let (words, process, link) = (next()?, next()?, next()?);
    let mut link = UnixStream::from(link);
    let begun = (|| {
        child::detach(child::GUARDIAN)?;
        let wires = Wires::of(Held::received(words)?);
        let records = numbers.has_records.then(&mut next).transpose()?.map(File::from);
        let mut stops = Vec::new();
        for _ in 0..numbers.resorts {
            let (socket, drives) = (next()?.into(), Held::received(next()?)?);
            stops.push(LastStop::new(LastResort { socket, drives, locks: Vec::new() }));
        }
        let report = String::with_capacity(REPORT);
        Ok::<_, io::Error>(Guard { numbers, wires, process, records, stops, locks: Vec::new(), report })
    })();
    let begun = begun.map(|mut guard| {
        guard.locks = descriptors.collect();
        // Where the right is there.
        let _ = rt::memory::lock_process();
        rt::thread::watch_thread(numbers.core, (numbers.priority > 0).then_some(numbers.priority));
        // Without filters in the kernel it guards all the same.
        let _ = allow_only(&[OF_EVERY_THREAD, &CALLS].concat(), &[]);
        guard
    });
    match begun {
        Ok(mut guard) => {
            link.write_all(READY)?;
            guard.run(link);
            Ok(())
        }
        Err(error) => link.write_all(error.to_string().as_bytes()),
    }
}

/// A guardian at work.
struct Guard {
    numbers: Numbers,
    wires: Wires,
    /// Readable once the master's process has ended.
    process: OwnedFd,
    /// The records that outlive it.
    records: Option<File>,
    stops: Vec<LastStop>,
    locks: Vec<OwnedFd>,
    report: String,
}

/// Why it takes the wires.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Why {
    Ended,
    /// Without a sign of life for so long, ns.
    Silent(u64),
}

impl Guard {
    fn run(&mut self, link: UnixStream) {
        if let Some(why) = self.await_need(&link)
            && self.wires.take(Taker::Guardian)
        {
            self.stop(why, &link);
        }
    }

    /// Waits until its master needs it; `None`: the master has come to an orderly end.
    fn await_need(&self, link: &UnixStream) -> Option<Why> {
        let mut watch = Watch::new(self.numbers.after_ns);
        // Its other end is closed at the end of the master, or by a program that closes whatever it has.
        let mut is_linked = true;
        loop {
            let now = MonotonicClock::read();
            if self.wires.have_ended() {
                return None;
            }
            if is_over(&self.process) {
                return Some(Why::Ended);
            }
            // A loop whose thread has died, and whom nobody watches.
            if self.wires.gave_way() && self.wires.taker().is_none() {
                return Some(Why::Silent(0));
            }
            if let Verdict::Stuck(silent_ns) = watch.poll(now, self.wires.signs()) {
                return Some(Why::Silent(silent_ns));
            }
            let until = now + watch.every_ns();
            match is_linked {
                true => {
                    wait(until, [self.process.as_fd(), link.as_fd()]);
                    is_linked = !is_over(link);
                }
                false => wait(until, [self.process.as_fd()]),
            }
        }
    }

    /// Stops the drives, until they are stopped and the master can send nothing more: it has ended, given way, or
    /// become another program, which has no socket of it.
    fn stop(&mut self, why: Why, link: &UnixStream) {
        // Whoever finds a drive in use finds this process.
        for lock in &self.locks {
            let _ = listen(lock, Backlog::MAXCONN);
        }
        let taken = MonotonicClock::read();
        let mut quiet_at = None;
        let mut is_reported = false;
        loop {
            let now = MonotonicClock::read();
            // Looked at first: what is sent below comes after the loop's last request.
            let is_quiet = || is_over(&self.process) || self.wires.gave_way() || is_over(link);
            if quiet_at.is_none() && is_quiet() {
                quiet_at = Some(now);
            }
            self.wires.round();
            self.stops.iter_mut().for_each(|stop| stop.round(now, taken));
            let is_done = self.stops.iter().all(LastStop::is_done);
            if is_done && !is_reported {
                is_reported = true;
                self.write_report(why);
            }
            if is_done && quiet_at.is_some_and(|at| now.since(at) >= LATEST_NS) {
                let _ = self.wires.set_ended(Taker::Guardian);
                return;
            }
            // For that time alone: what has ended stays readable.
            wait(now + ROUND_NS, []);
        }
    }

    /// Writes what it has done to where the master's last records are.
    fn write_report(&mut self, why: Why) {
        let Some(records) = &self.records else { return };
        // A string takes whatever is written to it.
        let _ = match why {
            Why::Ended => write!(self.report, "its guardian stopped the drives once the process had ended:"),
            Why::Silent(ns) => {
                let ms = ns / MS;
                write!(self.report, "its guardian stopped the drives after {ms} ms without a sign of life:")
            }
        };
        describe(&mut self.report, self.stops.iter().flat_map(LastStop::drives));
        let _ = ring::say(records, &self.report);
    }
}

/// Waits until then, or until one of these is readable.
fn wait<const N: usize>(until: Time, readable: [BorrowedFd<'_>; N]) {
    let mut waits = readable.map(|readable| PollFd::new(readable, PollFlags::POLLIN));
    let left = Duration::from_nanos(until.since(MonotonicClock::read()));
    // A signal ends it too early; none is let in.
    let _ = ppoll(&mut waits, Some(TimeSpec::from_duration(left)), None::<SigSet>);
}

/// Whether a process has ended, or the other end of a link, on which nothing is ever sent.
fn is_over(readable: &impl AsFd) -> bool {
    let mut waits = [PollFd::new(readable.as_fd(), PollFlags::POLLIN)];
    let at_once = TimeSpec::from_duration(Duration::ZERO);
    let ready = PollFlags::POLLIN | PollFlags::POLLHUP;
    ppoll(&mut waits, Some(at_once), None::<SigSet>).is_ok()
        && waits[0].revents().is_some_and(|events| events.intersects(ready))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_numbers_of_a_guardian_are_those_of_its_master_and_of_the_same_layout() {
        let numbers = Numbers {
            first: 7,
            count: 9,
            resorts: 2,
            has_records: true,
            after_ns: 750 * MS,
            priority: 80,
            core: None,
            process: 4711,
        };
        for numbers in [numbers, Numbers { core: Some(3), has_records: false, ..numbers }] {
            assert_eq!(Numbers::from_argument(&numbers.to_argument()), Some(numbers));
        }
        let argument = numbers.to_argument();
        let (rest, sizes) = argument.rsplit_once(',').unwrap();
        let other = sizes.parse::<i64>().unwrap() + 1;
        for wrong in
            ["", "7", rest, &format!("{rest},{other}"), &format!("{argument},0"), "a,b,c,d,e,f,g,h,i"]
        {
            assert_eq!(Numbers::from_argument(wrong), None, "{wrong}");
        }
    }
}
