//! A look of half a second at what a host carries: a loop and the drives that answer it, each on a core of its own, and
//! how long they are held up at the same time.
//!
//! It is for whoever has to choose a period without minutes to measure: the demo, and tests on real sockets.

use std::thread;

use super::setting::Setting;
use super::slice::wake_ups;
use crate::facts::on_a_thread;
use fieldbeat_core::cycle::CyclePlan;
use fieldbeat_core::rt::thread::{default_core, fifo, spare_core};
use fieldbeat_core::rt::{GuardTuner, Realtime, RealtimeError};
use fieldbeat_core::time::{MS, US};

/// Time between two samples.
const STEP_NS: u64 = 500 * US;

/// How many samples: half a second.
const SAMPLES: u64 = 1_000;

/// A cycle is disturbed if the loop and its drives together are held up for more than this share of it: what remains is
/// for their own work, and for the receive window.
const TOLERATED: f64 = 0.5;

/// How long threads of this host were held up.
#[derive(Clone, Debug)]
pub struct Glance {
    /// The times that the loop and its drives, each due to run at the same instant, waited in all, ns.
    waits_ns: Vec<u64>,
    fifo: bool,
}

/// Looks at this host: two threads as `cycle` has them, the loop and its simulated drives, sleep and wake for half a
/// second. Without the right to SCHED_FIFO they are ordinary threads, as the loop would be.
///
/// # Errors
///
/// The core of the loop cannot be had.
pub fn glance(cycle: &CyclePlan) -> Result<Glance, RealtimeError> {
    let core = cycle.core.or_else(default_core).unwrap_or(0);
    let wanted = cycle.realtime != Realtime::Off;
    let priority = cycle.priority;
    let may_fifo = wanted && on_a_thread(|| fifo(priority)).is_ok();
    let setting = |core, priority| Setting {
        core,
        fifo: may_fifo.then_some(priority),
        guarded: false,
        locked: false,
        awake: false,
    };
    let answering = setting(spare_core(Some(core)).unwrap_or(core), priority.saturating_sub(10).max(1));
    let sample = |setting: Setting| wake_ups(&setting, STEP_NS, SAMPLES, &mut GuardTuner::fixed(0), false);
    let (cycles, answers) = thread::scope(|scope| {
        let answers = scope.spawn(|| sample(answering));
        let cycles = sample(setting(core, priority));
        (cycles, answers.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    });
    let waits_ns = cycles?.into_iter().zip(answers?).map(|(one, other)| one.saturating_add(other)).collect();
    Ok(Glance { waits_ns, fifo: may_fifo })
}

impl Glance {
    /// The share of cycles of this period that the host would disturb, 0 ... 1.
    pub fn disturbed(&self, period_ns: u64) -> f64 {
        let most_ns = period_ns as f64 * TOLERATED;
        let disturbed = self.waits_ns.iter().filter(|wait| **wait as f64 > most_ns).count();
        disturbed as f64 / self.waits_ns.len().max(1) as f64
    }

    /// The longest wait, ns.
    pub fn longest_ns(&self) -> u64 {
        self.waits_ns.iter().copied().max().unwrap_or(0)
    }

    /// Whether the threads had SCHED_FIFO.
    pub fn fifo(&self) -> bool {
        self.fifo
    }

    /// The first of `periods_ns`, shortest first, that this host carries: at most this share of its cycles is
    /// disturbed. The last one if it carries none of them.
    pub fn shortest(&self, periods_ns: &[u64], most_disturbed: f64) -> u64 {
        let carried = periods_ns.iter().find(|period| self.disturbed(**period) <= most_disturbed);
        carried.or(periods_ns.last()).copied().unwrap_or(MS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIODS: [u64; 4] = [MS, 2 * MS, 4 * MS, 8 * MS];

    fn waiting(waits_ns: impl IntoIterator<Item = u64>) -> Glance {
        Glance { waits_ns: waits_ns.into_iter().collect(), fifo: false }
    }

    #[test]
    fn the_period_grows_until_few_cycles_are_disturbed() {
        let quiet = waiting([40 * US; 1_000]);
        assert_eq!(
            (quiet.shortest(&PERIODS, 0.2), quiet.disturbed(MS), quiet.longest_ns()),
            (MS, 0.0, 40 * US)
        );
        // A third of the time waits of 1.5 ms, a tenth of it waits of 20 ms.
        let waits = (0..1_000_u64).map(|n| match n % 30 {
            0..10 => 1_500 * US,
            10..13 => 20 * MS,
            _ => 0,
        });
        let busy = waiting(waits);
        assert!((0.42..0.45).contains(&busy.disturbed(2 * MS)), "{}", busy.disturbed(2 * MS));
        assert_eq!((busy.shortest(&PERIODS, 0.2), busy.longest_ns()), (4 * MS, 20 * MS));
        // One that carries nothing is given the longest one.
        assert_eq!((busy.shortest(&PERIODS, 0.5), busy.shortest(&PERIODS, 0.01)), (MS, 8 * MS));
        assert_eq!(waiting([100 * MS; 10]).shortest(&PERIODS, 0.2), 8 * MS);
    }

    #[test]
    fn this_host_is_looked_at_on_both_cores() {
        let seen = glance(&CyclePlan { realtime: Realtime::Off, ..CyclePlan::default() }).unwrap();
        assert!(seen.waits_ns.len() as u64 >= SAMPLES && !seen.fifo());
        assert!(seen.disturbed(u64::MAX) == 0.0 && seen.disturbed(0) > 0.0);
    }
}
