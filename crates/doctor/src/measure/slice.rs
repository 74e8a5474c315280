//! One slice of a measurement: a thread of its own, set up in one way, that waits for its grid as the loop does; and
//! one that only reads the clock.

use std::fs::File;
use std::io::Write;

use super::super::facts::on_a_thread;
use super::Noise;
use super::setting::Setting;
use fieldbeat_core::rt::{Clock, GuardTuner, MonotonicClock, RealtimeError, memory, thread};
use fieldbeat_core::time::{MS, Time, US};

/// Wake-ups of the first slice that the guard learns from, before the grid begins.
const CALIBRATION_SLEEPS: u32 = 200;

/// Latencies of `cycles` slots or more, ns after each grid point. `first`: calibrates the guard before.
pub(super) fn wake_ups(
    setting: &Setting,
    period_ns: u64,
    cycles: u64,
    guard: &mut GuardTuner,
    first: bool,
) -> Result<Vec<u64>, RealtimeError> {
    within(setting, || {
        let mut clock = MonotonicClock;
        if first {
            guard.calibrate(&mut clock, CALIBRATION_SLEEPS);
        }
        pace(&mut clock, period_ns, cycles, guard)
    })
}

/// Runs `body` on a thread as `setting` has it. What it takes away from the process is given back afterwards.
pub(super) fn within<T: Send>(
    setting: &Setting,
    body: impl FnOnce() -> T + Send,
) -> Result<T, RealtimeError> {
    // Given back when it is closed (Documentation/power/pm_qos_interface.rst).
    let _awake = if setting.awake { Some(hold_awake().map_err(call("open"))?) } else { None };
    if setting.locked {
        memory::lock_process()?;
    }
    let result = on_a_thread(|| {
        thread::pin(setting.core)?;
        match setting.fifo {
            Some(priority) => thread::fifo(priority)?,
            None => thread::prompt(),
        }
        memory::prefault_stack();
        Ok(body())
    });
    if setting.locked {
        memory::unlock_process();
    }
    result
}

fn call(call: &'static str) -> impl Fn(std::io::Error) -> fieldbeat_core::rt::Denied {
    move |error| fieldbeat_core::rt::Denied::Call { call, error }
}

/// Keeps all cores out of idle states until the file is dropped: the latency in us as a 32-bit number.
pub(super) fn hold_awake() -> std::io::Result<File> {
    let mut file = File::options().write(true).open("/dev/cpu_dma_latency")?;
    file.write_all(&0_i32.to_ne_bytes())?;
    Ok(file)
}

/// Waits for a grid as `Engine::step` does, and does nothing else. A slot that passed before its turn came is late by
/// what the one before it was late, less a period: nothing is left out.
fn pace(clock: &mut dyn Clock, period_ns: u64, cycles: u64, guard: &mut GuardTuner) -> Vec<u64> {
    let mut latencies = Vec::with_capacity(cycles as usize + 64);
    let mut at = clock.now() + 2 * period_ns;
    while (latencies.len() as u64) < cycles {
        let guard_ns = guard.guard_ns();
        clock.sleep_until(at - guard_ns);
        let mut now = clock.now();
        guard.observe(now.since(at - guard_ns));
        while now < at {
            clock.spin();
            now = clock.now();
        }
        loop {
            let latency = now.since(at);
            latencies.push(latency);
            at = at + period_ns;
            if latency < period_ns {
                break;
            }
        }
    }
    latencies
}

/// A look at the clock that took longer than this was an interruption.
pub(super) const GAP_NS: u64 = 10 * US;

/// Looks at the clock without pause for so long, then pauses as long: half of the core stays with everybody else, far
/// from RT throttling and from the fair server.
const LOOK_NS: u64 = 25 * MS;

/// Looks for `span_ns` in all, pauses included.
pub(super) fn gaps(setting: &Setting, span_ns: u64) -> Result<Noise, RealtimeError> {
    within(setting, || look(&mut MonotonicClock, span_ns))
}

fn look(clock: &mut dyn Clock, span_ns: u64) -> Noise {
    let mut noise = Noise { gap_ns: GAP_NS, ..Noise::default() };
    let end = clock.now() + span_ns;
    loop {
        let begin = clock.now();
        let until: Time = begin + LOOK_NS;
        let mut last = begin;
        while last < until {
            let now = clock.now();
            let gap = now.since(last);
            if gap > GAP_NS {
                noise.gaps += 1;
                noise.longest_ns = noise.longest_ns.max(gap);
                noise.taken_ns += gap;
            }
            last = now;
        }
        noise.looked_ns += last.since(begin);
        if last + LOOK_NS >= end {
            return noise;
        }
        clock.sleep_until(last + LOOK_NS);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::rt::PollSet;

    /// A clock whose sleeps end late, and whose looks take time, by what closures say.
    struct Scripted<L, R> {
        now: Time,
        late: L,
        read: R,
    }

    impl<L: FnMut() -> u64 + Send, R: FnMut() -> u64 + Send> Clock for Scripted<L, R> {
        fn now(&mut self) -> Time {
            self.now = self.now + (self.read)();
            self.now
        }
        fn sleep_until(&mut self, at: Time) {
            self.now = self.now.max(at + (self.late)());
        }
        fn wait(&mut self, _: &mut PollSet, until: Time) -> bool {
            self.sleep_until(until);
            false
        }
        fn spin(&mut self) {}
    }

    #[test]
    fn a_slot_that_passed_is_a_late_one() {
        let mut late = [5, 2_300, 7, 8].into_iter().map(|us| us * US);
        let mut clock = Scripted { now: Time(0), late: || late.next().unwrap_or(0), read: || 0 };
        let latencies = pace(&mut clock, MS, 5, &mut GuardTuner::fixed(0));
        assert_eq!(latencies, [5, 2_300, 1_300, 300, 7].map(|us| us * US));
    }

    #[test]
    fn a_guard_takes_its_time_out_of_the_latency() {
        let mut clock = Scripted { now: Time(0), late: || 30 * US, read: || 20 };
        let latencies = pace(&mut clock, MS, 10, &mut GuardTuner::fixed(50 * US));
        assert!(latencies.iter().all(|latency| *latency < 40), "{latencies:?}");
        let mut clock = Scripted { now: Time(0), late: || 30 * US, read: || 20 };
        let latencies = pace(&mut clock, MS, 10, &mut GuardTuner::fixed(10 * US));
        assert!(latencies.iter().all(|latency| (20 * US..21 * US).contains(latency)), "{latencies:?}");
    }

    #[test]
    fn gaps_are_counted_and_half_of_the_time_is_left_to_others() {
        let mut looks = 0_u64;
        let read = || {
            looks += 1;
            if looks == 500 { 300 * US } else { US }
        };
        let mut clock = Scripted { now: Time(0), late: || 0, read };
        let gaps = look(&mut clock, 200 * MS);
        assert_eq!((gaps.gaps, gaps.longest_ns, gaps.taken_ns), (1, 300 * US, 300 * US));
        assert!((95 * MS..=105 * MS).contains(&gaps.looked_ns), "{gaps:?}");
        assert!(clock.now <= Time(201 * MS), "{}", clock.now);
    }

    #[test]
    fn a_thread_on_a_core_that_is_not_there_is_refused() {
        let setting = Setting { core: 5_000, fifo: None, guarded: false, locked: false, awake: false };
        assert!(matches!(gaps(&setting, 0), Err(RealtimeError::Core { core: 5_000, .. })));
    }
}
