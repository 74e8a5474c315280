//! The thread that empties the loop's ring into histograms.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use hdrhistogram::Histogram;
use rtrb::Consumer;
use serde::Serialize;

use crate::cycle::record::Record;
use crate::time::{MS, S};

/// Round trips and wake-ups beyond this are recorded as this; their true maximum is kept by the loop.
const HIGHEST_NS: u64 = 60 * MS;

/// Two significant digits: 1 % is finer than any run repeats, and keeps a histogram at a few kilobytes.
const DIGITS: u8 = 2;

/// How often the ring is emptied.
const EMPTY_EVERY: Duration = Duration::from_millis(5);

/// What the ring holds: the thread is a normal one, and on a busy host it waits for its turn far longer than it sleeps. With
/// room for 100 ms, 5 923 records of 4 s were lost beside a compiler on every core.
const RING_NS: u64 = S;

/// The most records in all. Their memory is locked; the loop counts what does not fit.
const MOST_RECORDS: usize = 1 << 18;

/// What a run measured.
#[derive(Clone, Debug)]
pub struct Histograms {
    /// Begin of each cycle after its grid point, ns; skipped slots count as late ones.
    pub wake: Histogram<u32>,
    /// Round trips of each axis, ns.
    pub round_trip: Vec<Histogram<u32>>,
    /// Time of the send stage, ns.
    pub send: Histogram<u32>,
    /// Time of the receive stage, ns.
    pub receive: Histogram<u32>,
    /// Time of judging, exchanging, preparing, ns.
    pub work: Histogram<u32>,
}

/// Quantiles of a histogram, each only if the sample is large enough to support it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Quantiles {
    /// Size of the sample.
    pub count: u64,
    /// Median, ns.
    pub p50: Option<u64>,
    /// 90th percentile, ns.
    pub p90: Option<u64>,
    /// 99th percentile, ns.
    pub p99: Option<u64>,
    /// 99.9th percentile, ns.
    pub p99_9: Option<u64>,
    /// The exact maximum, ns.
    pub max: Option<u64>,
}

impl Quantiles {
    /// Quantiles of `histogram`, with the exact maximum that the loop kept.
    ///
    /// A quantile needs ten samples beyond it: with fewer it would be the rank of a few outliers.
    pub fn of(histogram: &Histogram<u32>, max: Option<u64>) -> Quantiles {
        let count = histogram.len();
        let at = |quantile: f64| {
            let beyond = count as f64 * (1.0 - quantile);
            (beyond >= 10.0 - 1e-9).then(|| histogram.value_at_quantile(quantile))
        };
        Quantiles {
            count,
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            p99_9: at(0.999),
            max: max.filter(|_| count > 0),
        }
    }
}

impl Histograms {
    /// Empty histograms for so many axes.
    pub fn new(axes: usize) -> Histograms {
        let empty = || Histogram::new_with_bounds(1, HIGHEST_NS, DIGITS).expect("constant bounds are valid");
        Histograms {
            wake: empty(),
            round_trip: (0..axes).map(|_| empty()).collect(),
            send: empty(),
            receive: empty(),
            work: empty(),
        }
    }

    /// Enters one record.
    pub fn enter(&mut self, record: Record, period_ns: u64) {
        let enter = |histogram: &mut Histogram<u32>, ns: u64| histogram.saturating_record(ns.max(1));
        match record {
            Record::Cycle { wake_ns, send_ns, receive_ns, work_ns, .. } => {
                enter(&mut self.wake, u64::from(wake_ns));
                enter(&mut self.send, u64::from(send_ns));
                enter(&mut self.receive, u64::from(receive_ns));
                enter(&mut self.work, u64::from(work_ns));
            }
            Record::Skipped { count, late_ns, .. } => {
                // Slot by slot while they differ, then all that are beyond the histogram at once.
                for slot in 0..count {
                    let late = late_ns.saturating_sub(slot * period_ns);
                    if late >= HIGHEST_NS {
                        let beyond = ((late - HIGHEST_NS) / period_ns + 1).min(count - slot);
                        let _ = self.wake.record_n(HIGHEST_NS, u32::try_from(beyond).unwrap_or(u32::MAX));
                        let rest = Record::Skipped {
                            first: 0,
                            count: count - slot - beyond,
                            late_ns: late.saturating_sub(beyond * period_ns),
                        };
                        return self.enter(rest, period_ns);
                    }
                    enter(&mut self.wake, late);
                }
            }
            Record::RoundTrip { axis, rtt_ns, .. } => {
                if let Some(histogram) = self.round_trip.get_mut(axis as usize) {
                    enter(histogram, u64::from(rtt_ns));
                }
            }
        }
    }
}

/// The thread.
#[derive(Debug)]
pub struct Recorder {
    histograms: Arc<Mutex<Histograms>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Recorder {
    /// Starts to empty `ring`. `prepare` runs first on the new thread (to keep it off the loop's core).
    pub fn start(
        mut ring: Consumer<Record>,
        axes: usize,
        period_ns: u64,
        prepare: impl FnOnce() + Send + 'static,
    ) -> std::io::Result<Recorder> {
        let histograms = Arc::new(Mutex::new(Histograms::new(axes)));
        let stop = Arc::new(AtomicBool::new(false));
        let (shared, ending) = (Arc::clone(&histograms), Arc::clone(&stop));
        let thread = std::thread::Builder::new().name("fb-telemetry".into()).spawn(move || {
            prepare();
            loop {
                // Looked at before the ring is emptied, so that the last records are taken too.
                let last = ending.load(Ordering::Acquire);
                if ring.slots() > 0 {
                    let mut histograms = lock(&shared);
                    while let Ok(record) = ring.pop() {
                        histograms.enter(record, period_ns);
                    }
                }
                if last {
                    break;
                }
                std::thread::sleep(EMPTY_EVERY);
            }
        })?;
        Ok(Recorder { histograms, stop, thread: Some(thread) })
    }

    /// Room that the ring needs for cycles of so many axes, in records.
    pub fn ring_size(axes: usize, period_ns: u64) -> usize {
        let cycles = usize::try_from(RING_NS.div_ceil(period_ns.max(1))).unwrap_or(MOST_RECORDS).max(16);
        cycles.saturating_mul(axes.saturating_add(1)).min(MOST_RECORDS)
    }

    /// What was measured so far.
    pub fn read(&self) -> MutexGuard<'_, Histograms> {
        lock(&self.histograms)
    }

    /// Takes the last records and ends the thread.
    pub fn finish(mut self) -> Histograms {
        self.end();
        lock(&self.histograms).clone()
    }

    fn end(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.end();
    }
}

/// A poisoned lock only means that a reader panicked; the numbers are whole.
fn lock(histograms: &Mutex<Histograms>) -> MutexGuard<'_, Histograms> {
    histograms.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quantile_without_enough_samples_is_none() {
        let mut histograms = Histograms::new(1);
        for index in 0..99 {
            histograms.enter(Record::RoundTrip { index, axis: 0, rtt_ns: 10_000 }, MS);
        }
        let quantiles = Quantiles::of(&histograms.round_trip[0], Some(10_000));
        assert_eq!((quantiles.count, quantiles.p90, quantiles.p99), (99, None, None));
        assert!(quantiles.p50.is_some_and(|p50| (9_900..=10_100).contains(&p50)));
        assert_eq!(Quantiles::of(&histograms.wake, Some(3)), Quantiles::default());
    }

    #[test]
    fn each_skipped_slot_is_a_late_wake_up_of_its_own() {
        let mut histograms = Histograms::new(0);
        histograms.enter(Record::Skipped { first: 5, count: 3, late_ns: 3_500_000 }, MS);
        let values: Vec<u64> =
            histograms.wake.iter_recorded().map(|v| v.value_iterated_to() / 100_000).collect();
        assert_eq!(histograms.wake.len(), 3);
        assert_eq!(values, [15, 25, 35]);
    }

    #[test]
    fn the_ring_holds_a_second_within_bounded_memory() {
        assert_eq!(Recorder::ring_size(8, MS), 9_000);
        assert_eq!(Recorder::ring_size(3, 250_000), 16_000);
        assert_eq!(Recorder::ring_size(1, 10 * S), 32);
        assert_eq!(Recorder::ring_size(1_000, 100_000), 1 << 18);
        assert_eq!(Recorder::ring_size(usize::MAX, 0), 1 << 18);
    }

    #[test]
    fn a_suspended_machine_is_entered_in_bounded_time() {
        let mut histograms = Histograms::new(0);
        let (count, late_ns) = (3_600_000, 3_600_000 * MS);
        histograms.enter(Record::Skipped { first: 0, count, late_ns }, MS);
        assert_eq!(histograms.wake.len(), count);
    }
}
