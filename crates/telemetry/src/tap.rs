//! Further readers of the loop's records: a recording, a display. Each has its own bounded queue, which the telemetry
//! thread fills and never waits for.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};

use super::causes::{Causes, Judged, MOST_JUDGED};
use fieldbeat_core::cycle::record::Record;

/// The records of some cycles, in their order, shared by all readers.
pub type Batch = Arc<[Record]>;

/// The readers of one machine.
#[derive(Clone, Debug, Default)]
pub struct Taps(Arc<Mutex<Outlets>>);

#[derive(Debug, Default)]
struct Outlets {
    list: Vec<Outlet>,
    has_ended: bool,
}

/// The telemetry thread's end of one reader.
#[derive(Debug)]
struct Outlet {
    batches: Sender<Batch>,
    lost: Arc<AtomicU64>,
    late: Sender<Judged>,
    /// Judgements that it got, or that were made before it came.
    judged: Option<u64>,
}

/// One reader's end. It gets each record from its begin on; dropping it ends that.
#[derive(Debug)]
pub struct Tap {
    batches: Receiver<Batch>,
    lost: Arc<AtomicU64>,
    late: Receiver<Judged>,
}

impl Taps {
    /// One more reader, with room for so many batches; the telemetry thread makes one each 20 ms or sooner. After the
    /// end it gets nothing, and learns that at once.
    pub fn add(&self, room: usize) -> Tap {
        let (sender, batches) = bounded(room);
        let (judge, late) = bounded(MOST_JUDGED);
        let lost = Arc::new(AtomicU64::new(0));
        let mut outlets = self.outlets();
        if !outlets.has_ended {
            let lost = Arc::clone(&lost);
            outlets.list.push(Outlet { batches: sender, lost, late: judge, judged: None });
        }
        Tap { batches, lost, late }
    }

    /// Whether nobody reads.
    pub fn is_empty(&self) -> bool {
        self.outlets().list.is_empty()
    }

    /// Hands these records to every reader. One without room loses them all, and knows how many.
    pub fn hand(&self, records: Vec<Record>) {
        if records.is_empty() {
            return;
        }
        let batch: Batch = records.into();
        self.outlets().list.retain(|outlet| match outlet.batches.try_send(Arc::clone(&batch)) {
            Ok(()) => true,
            Err(TrySendError::Full(_)) => {
                outlet.lost.fetch_add(batch.len() as u64, Ordering::Relaxed);
                true
            }
            Err(TrySendError::Disconnected(_)) => false,
        });
    }

    /// Hands the late cycles whose cause was found since the last call to every reader. One without room loses them,
    /// and knows how many.
    pub fn hand_late(&self, causes: &Causes) {
        for outlet in self.outlets().list.iter_mut() {
            let judged = outlet.judged.get_or_insert_with(|| causes.judgements());
            causes.judged_after(judged).for_each(|late| {
                let is_lost = outlet.late.try_send(*late).is_err();
                outlet.lost.fetch_add(is_lost.into(), Ordering::Relaxed);
            });
        }
    }

    /// There are no more records: the end of its queue shows it to each reader.
    pub fn end(&self) {
        *self.outlets() = Outlets { list: Vec::new(), has_ended: true };
    }

    fn outlets(&self) -> std::sync::MutexGuard<'_, Outlets> {
        // A poisoned lock only means that somebody panicked between two whole steps.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Why there is no batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NoBatch {
    /// None came within the time.
    Yet,
    /// The machine has ended, and all were taken.
    AnyMore,
}

impl Tap {
    /// The next records, waiting at most `limit` for them.
    pub fn next(&self, limit: Duration) -> Result<Batch, NoBatch> {
        self.batches.recv_timeout(limit).map_err(|error| match error {
            RecvTimeoutError::Timeout => NoBatch::Yet,
            RecvTimeoutError::Disconnected => NoBatch::AnyMore,
        })
    }

    /// Late cycles whose cause was found, and that were not taken yet.
    pub fn late(&self) -> impl Iterator<Item = Judged> {
        self.late.try_iter()
    }

    /// How many records and late cycles were lost so far, since this reader was too slow.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::cycle::CyclePlan;
    use fieldbeat_core::cycle::record::CycleRecord;

    fn record(index: u64) -> Record {
        Record::Cycle(CycleRecord { index, ..CycleRecord::default() })
    }

    fn indices(batch: &[Record]) -> Vec<u64> {
        batch.iter().map(Record::index).collect()
    }

    #[test]
    fn every_reader_gets_all_records_in_order_and_a_slow_one_counts_what_it_lost() {
        let taps = Taps::default();
        assert!(taps.is_empty());
        let (quick, slow) = (taps.add(8), taps.add(1));
        assert!(!taps.is_empty());
        for first in [1, 3, 5] {
            taps.hand(vec![record(first), record(first + 1)]);
        }
        taps.hand(Vec::new());
        let taken: Vec<_> = (0..3).flat_map(|_| indices(&quick.next(Duration::ZERO).unwrap())).collect();
        assert_eq!(taken, [1, 2, 3, 4, 5, 6]);
        assert_eq!((quick.lost(), quick.next(Duration::ZERO).unwrap_err()), (0, NoBatch::Yet));
        assert_eq!((indices(&slow.next(Duration::ZERO).unwrap()), slow.lost()), (vec![1, 2], 4));
        drop(slow);
        taps.hand(vec![record(7)]);
        taps.end();
        assert_eq!(indices(&quick.next(Duration::ZERO).unwrap()), [7]);
        assert_eq!(quick.next(Duration::ZERO).unwrap_err(), NoBatch::AnyMore);
        assert!(taps.is_empty());
        assert_eq!(taps.add(1).next(Duration::ZERO).unwrap_err(), NoBatch::AnyMore);
    }

    #[test]
    fn a_reader_gets_the_late_cycles_that_are_judged_from_its_begin_on() {
        let (taps, mut causes) = (Taps::default(), Causes::new(&CyclePlan::default(), false));
        let mut late = |index| {
            let wake_ns = 500_000;
            causes.record(&Record::Cycle(CycleRecord { index, wake_ns, ..CycleRecord::default() }));
            taps.hand_late(&causes);
        };
        late(1);
        let tap = taps.add(1);
        late(2);
        late(3);
        late(4);
        let taken = || tap.late().map(|judged| judged.index).collect::<Vec<u64>>();
        assert_eq!(taken(), [3, 4]);
        assert!(taken().is_empty());
        (0..2 * MOST_JUDGED as u64).for_each(&mut late);
        // What had no room is left out, and counted.
        assert_eq!(taken(), (0..MOST_JUDGED as u64).collect::<Vec<u64>>());
        assert_eq!(tap.lost(), MOST_JUDGED as u64);
    }
}
