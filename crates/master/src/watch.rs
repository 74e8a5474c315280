//! The watch over the loop: a thread that takes the wires from a loop whose cycle does not end, and stops the drives
//! of the wires that know no watchdog.

use std::io;
use std::thread::{JoinHandle, park_timeout};
use std::time::Duration;

use fieldbeat_core::bus::last::{LastDrive, ROUND_NS};
use fieldbeat_core::cycle::watch::{Verdict, Watch};
use fieldbeat_core::drive::last::{LastStop, describe};
use fieldbeat_core::rt::{self, Granted, Held, MonotonicClock, Taker, Wires};
use fieldbeat_core::time::{MS, S, Time};

/// For so long the stop is repeated after the loop has given way, ns: its last request may wait in the host, in a
/// switch or in the drive.
pub(super) const LATEST_NS: u64 = 250 * MS;
/// A guardian that stops the drives gives a sign of life in each round. Without one for so long, ns, it has died.
const GUARDIAN_NS: u64 = 500 * MS;
/// A loop that comes back ends within this time, ns; nobody waits longer where there is nothing to be stopped.
const RETURN_NS: u64 = S;

/// The report of [`finish`](super::Master::finish) on a loop from which the watch has taken the wires ...
const STUCK: &str = "the loop is stuck: its cycle has not ended within watch_after; look at what holds its \
     thread up (the in-loop task, a driver of the host); the watch took the wires";
/// ... or the guardian ...
const HUNG: &str = "the process gave no sign of life within guardian_after; look at what held it up \
     (SIGSTOP, a debugger, a host without processor time); its guardian took the wires";
/// ... and of its drives.
const STOPPED: &str = ", any other drive acts by its own watchdog if that is on; of the LinMots";

/// The watch of a running machine.
#[derive(Debug)]
pub(crate) struct LoopWatch {
    wires: Wires,
    /// Those that it stops, and the guardian.
    drives: Vec<Held<LastDrive>>,
    thread: Option<JoinHandle<()>>,
}

impl LoopWatch {
    /// Nobody watches: a loop in virtual time, or `watch_after = "off"`.
    pub(crate) fn none(wires: Wires, drives: Vec<Held<LastDrive>>) -> LoopWatch {
        LoopWatch { wires, drives, thread: None }
    }

    /// Starts to watch a loop that was granted this.
    pub(super) fn start(
        wires: Wires,
        after_ns: u64,
        period_ns: u64,
        of_loop: Granted,
        last_stops: Vec<LastStop>,
    ) -> io::Result<LoopWatch> {
        let (shared, drives) = (wires.clone(), last_stops.iter().map(LastStop::shared).collect());
        let thread = std::thread::Builder::new().name("fb-watchdog".into()).spawn(move || {
            rt::thread::watch_thread(of_loop.core, of_loop.fifo());
            if let Some(taken) = await_verdict(&shared, after_ns, period_ns) {
                stop(&shared, period_ns, taken, last_stops);
            }
        })?;
        Ok(LoopWatch { wires, drives, thread: Some(thread) })
    }

    /// Whether the loop is stuck, or was.
    pub(super) fn is_stuck(&self) -> bool {
        self.wires.is_stuck()
    }

    /// The meaning of a stuck loop, and how the drives were stopped; `panicked`: that is reported already.
    pub(super) fn stuck(&self, panicked: bool) -> Option<String> {
        let who = match self.wires.taker()? {
            _ if panicked => "the watch took the wires",
            Taker::Watch => STUCK,
            Taker::Guardian => HUNG,
        };
        let mut text = who.to_owned();
        if !self.drives.is_empty() {
            text += STOPPED;
            describe(&mut text, self.drives.iter().flat_map(Held::all));
        }
        Some(text)
    }

    /// Whether nobody need wait for the loop any longer.
    pub(super) fn is_over(&self) -> bool {
        self.wires.is_over()
    }

    /// Ends it, after the loop's thread has ended: at once, or once the stop was repeated for long enough. A loop that
    /// has `died` outside of its cycle has stopped no drive.
    pub(super) fn end(&mut self, died: bool) {
        let Some(thread) = self.thread.take() else {
            // The guardian finds a loop that is silent.
            if died {
                self.wires.give_way();
            }
            return;
        };
        // One whose thread has ended in order has said so already. They may have been taken before.
        let _ = if died { self.wires.take(Taker::Watch) } else { self.wires.end() };
        if self.wires.is_stuck() {
            self.wires.give_way();
        }
        thread.thread().unpark();
        let _ = thread.join();
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
        match watch.poll(now, wires.signs()) {
            Verdict::Alive => wires.publish_silence(0),
            Verdict::Silent(ns) => wires.publish_silence(ns / period_ns),
            Verdict::Stuck(silent_ns) => {
                return wires.take(Taker::Watch).then_some(Taken { at: now, silent_ns });
            }
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
/// never does has a stop behind whatever it may still send, until the process ends. If the guardian takes the wires, it
/// sends the stop in place of this.
fn stop(wires: &Wires, period_ns: u64, taken: Taken, mut last_stops: Vec<LastStop>) {
    let (mut gave_way_at, mut seen) = (None, (wires.signs(), taken.at));
    loop {
        let now = MonotonicClock::read();
        let since_ns = now.since(taken.at);
        // Looked at first: what is sent below comes after the loop's last request.
        if gave_way_at.is_none() && wires.gave_way() {
            gave_way_at = Some(now);
        }
        let signs = wires.signs();
        if signs != seen.0 {
            seen = (signs, now);
        }
        // Or that of a guardian which has died meanwhile.
        let is_ours = wires.taker() == Some(Taker::Watch) || now.since(seen.1) >= GUARDIAN_NS;
        if is_ours {
            wires.round();
            last_stops.iter_mut().for_each(|last| last.round(now, taken.at));
        }
        wires.publish_silence((taken.silent_ns + since_ns) / period_ns);
        let is_latest = gave_way_at.is_some_and(|at| now.since(at) >= LATEST_NS);
        let is_done = match is_ours {
            true => last_stops.iter().all(LastStop::is_done),
            false => wires.have_ended(),
        };
        if is_done && (since_ns >= RETURN_NS || is_latest) {
            wires.set_over();
            if is_latest {
                let _ = wires.set_ended(Taker::Watch);
                return;
            }
        }
        sleep_until(now + ROUND_NS);
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
    fn the_stop_after_a_dead_loop_is_bounded_whichever_thread_takes_its_wires() {
        for by_the_watch in [false, true] {
            let wires = Wires::default();
            if by_the_watch {
                assert!(wires.take(Taker::Watch));
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
