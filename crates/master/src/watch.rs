//! The watch over the loop: a thread that takes the wires from a loop whose cycle does not end, and stops the drives
//! of the wires that know no watchdog.

use std::io;
use std::thread::{JoinHandle, park_timeout};
use std::time::Duration;

use fieldbeat_core::bus::LastResort;
use fieldbeat_core::cycle::watch::{Verdict, Watch};
use fieldbeat_core::rt::{self, Granted, MonotonicClock, Wires};
use fieldbeat_core::time::{MS, S, Time};

/// The stop is repeated so often, ns: so long may a request move an axis that the loop still sends.
const REPEAT_NS: u64 = 10 * MS;
/// For so long it is repeated after the loop has given way, ns: its last request may wait in the host, in a switch or
/// in the drive.
const LATEST_NS: u64 = 250 * MS;
/// A loop that comes back ends within this time, ns; nobody waits longer where there is nothing to be stopped.
const RETURN_NS: u64 = S;

/// What [`finish`](super::Master::finish) says of such a loop.
pub(super) const STUCK: &str = "the loop is stuck: its cycle has not ended within watch_after; the watch \
     took the wires and sent the stop to the LinMot drives, any other drive acts by its own watchdog if that \
     is on; look at the drives and at what holds the loop's thread up (the in-loop task, a driver of the \
     host)";

/// The watch of a running machine.
#[derive(Debug)]
pub(crate) struct LoopWatch {
    wires: Wires,
    thread: Option<JoinHandle<()>>,
}

impl LoopWatch {
    /// Nobody watches: a loop in virtual time, or `watch_after = "off"`.
    pub(crate) fn none(wires: Wires) -> LoopWatch {
        LoopWatch { wires, thread: None }
    }

    /// Starts to watch a loop that was granted this.
    pub(super) fn start(
        wires: Wires,
        after_ns: u64,
        period_ns: u64,
        of_loop: Granted,
        last_resorts: Vec<Box<dyn LastResort>>,
    ) -> io::Result<LoopWatch> {
        let shared = wires.clone();
        let thread = std::thread::Builder::new().name("fb-watchdog".into()).spawn(move || {
            rt::thread::watch_thread(&of_loop);
            if let Some(taken) = await_verdict(&shared, after_ns, period_ns) {
                stop(&shared, period_ns, taken, last_resorts);
            }
        })?;
        Ok(LoopWatch { wires, thread: Some(thread) })
    }

    /// Whether the loop is stuck, or was.
    pub(super) fn is_stuck(&self) -> bool {
        self.wires.is_stuck()
    }

    /// Whether nobody need wait for the loop any longer.
    pub(super) fn is_over(&self) -> bool {
        self.wires.is_over()
    }

    /// Ends it, after the loop's thread has ended: at once, or once the stop was repeated for long enough. A loop that
    /// has `died` outside of its cycle has stopped no drive.
    pub(super) fn end(&mut self, died: bool) {
        if let Some(thread) = self.thread.take() {
            // One whose thread has ended in order has said so already. The watch may have taken them before.
            let _ = if died { self.wires.take() } else { self.wires.end() };
            if self.wires.is_stuck() {
                self.wires.give_way();
            }
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}

/// Watches until the loop has ended, or until its wires were taken: when that was, and for how long it was silent then.
fn await_verdict(wires: &Wires, after_ns: u64, period_ns: u64) -> Option<Taken> {
    let mut watch = Watch::new(after_ns);
    loop {
        let now = MonotonicClock::read();
        if wires.have_ended() {
            wires.publish_silence(0);
            return None;
        }
        // Of a loop whose thread has died.
        if wires.is_stuck() {
            return Some(Taken { at: now, silent_ns: 0 });
        }
        match watch.poll(now, wires.turns()) {
            Verdict::Alive => wires.publish_silence(0),
            Verdict::Silent(ns) => wires.publish_silence(ns / period_ns),
            Verdict::Stuck(silent_ns) => return wires.take().then_some(Taken { at: now, silent_ns }),
        }
        sleep_until(now + watch.every_ns());
    }
}

/// When the wires were taken.
#[derive(Clone, Copy, Debug)]
struct Taken {
    at: Time,
    silent_ns: u64,
}

/// Sends the stop until the loop has given way, and then for as long as its last request may be under way. A loop that
/// never does has a stop behind whatever it may still send, until the process ends.
fn stop(wires: &Wires, period_ns: u64, taken: Taken, mut last_resorts: Vec<Box<dyn LastResort>>) {
    let over_ns = last_resorts.iter().map(|last| last.over_after_ns()).fold(RETURN_NS, u64::max);
    let mut gave_way_at = None;
    loop {
        let now = MonotonicClock::read();
        let since_ns = now.since(taken.at);
        // Looked at first: what is sent below comes after the loop's last request.
        if gave_way_at.is_none() && wires.gave_way() {
            gave_way_at = Some(now);
        }
        last_resorts.iter_mut().for_each(|last| last.send(since_ns));
        wires.publish_silence((taken.silent_ns + since_ns) / period_ns);
        let is_latest = gave_way_at.is_some_and(|at| now.since(at) >= LATEST_NS);
        if since_ns >= over_ns || (is_latest && last_resorts.is_empty()) {
            wires.set_over();
            if is_latest {
                return;
            }
        }
        sleep_until(now + REPEAT_NS);
    }
}

/// Sleeps until then, or until it is woken.
fn sleep_until(at: Time) {
    let left_ns = at.since(MonotonicClock::read());
    if left_ns > 0 {
        park_timeout(Duration::from_nanos(left_ns));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_end_of_a_loop_that_has_died_is_bounded_whoever_takes_its_wires() {
        for by_the_watch in [false, true] {
            let wires = Wires::default();
            if by_the_watch {
                assert!(wires.take());
            }
            let granted = Granted {
                policy: "SCHED_OTHER",
                priority: 0,
                core: None,
                memory_locked: false,
                missing: vec![],
            };
            let mut watch = LoopWatch::start(wires, S, MS, granted, Vec::new()).unwrap();
            let (done, ended) = std::sync::mpsc::channel();
            std::thread::spawn(move || {
                watch.end(true);
                done.send(watch.is_stuck())
            });
            assert_eq!(ended.recv_timeout(Duration::from_secs(60)), Ok(true), "by the watch: {by_the_watch}");
        }
    }
}
