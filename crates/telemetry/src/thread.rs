//! The thread that empties the loop's ring: into histograms, the time line, the search for causes, the black box, and
//! the queues of further readers.

use std::collections::VecDeque;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread::JoinHandle;
use std::time::Duration;

use super::causes::Causes;
use super::histograms::Histograms;
use super::motion::Motion;
use super::sink::{Feed, PendingRequest, Recorded, SinkThread};
use super::tap::Taps;
use super::timeline::Timeline;
use crate::parts::Parts;
use fieldbeat_core::axis::cell::Reader;
use fieldbeat_core::axis::{Emergency, EventKind, StopCause, Units};
use fieldbeat_core::cycle::record::{DriveRecord, Record};
use fieldbeat_core::cycle::ring::RecordReader;
use fieldbeat_core::cycle::status::{Numbers, Status};
use fieldbeat_core::cycle::{CyclePlan, Plan};
use fieldbeat_core::rt::Granted;
use fieldbeat_core::rt::watch::ThreadWatch;
use fieldbeat_core::time::{MS, S};

/// How often the ring is emptied, and the times of the loop's thread are read: each wake-up has its price.
const EMPTY_EVERY: Duration = Duration::from_millis(20);

/// The same for [`CLOSELY_NS`] after a late cycle. One more is likely to follow, and what the thread usually runs in a
/// cycle is learned between them only.
const EMPTY_CLOSELY_EVERY: Duration = Duration::from_millis(10);
const CLOSELY_NS: u64 = 250 * MS;

/// How often what the kernel counted against the loop's thread is read: it takes some hundred microseconds.
const COUNT_EVERY_NS: u64 = 100 * MS;

/// The room of the ring: the thread is a normal one, and on a busy host it waits for its turn far longer than it
/// sleeps. With room for 100 ms, 5 923 records of 4 s were lost next to a compiler on every core.
const RING_NS: u64 = S;

/// And so many records at least, some seconds of a small machine: next to three test programs and a compiler on two
/// cores the thread once did not run for 1.4 s.
const LEAST_RECORDS: usize = 1 << 13;

/// The most records in all. Their memory is locked; the loop counts what does not fit.
const MOST_RECORDS: usize = 1 << 18;

/// The results of a run's records.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Measured {
    /// Every quantity.
    pub histograms: Histograms,
    /// The largest values over time.
    pub timeline: Timeline,
    /// How the axes moved.
    pub motion: Motion,
    /// The histograms, part by part.
    #[doc(hidden)]
    pub parts: Parts,
    /// Why cycles were late.
    pub causes: Causes,
    /// The newest emergencies of the drives, in their order.
    pub emergencies: VecDeque<DriveEmergency>,
    /// The files that the black box was written to, or could not be.
    pub black_boxes: Vec<Written>,
    /// The recordings, once the run has ended.
    pub recordings: Vec<Recorded>,
    /// The failures of the program itself, each once.
    pub failures: Vec<Failure>,
    /// How many that were, those that made room for newer ones included.
    files: usize,
    period_ns: u64,
}

/// The number of records that are entered without a pause for readers.
const PIECE: usize = 1024;

/// The number of files and emergencies that are kept for the application.
const MOST_KEPT: usize = 64;

/// A part of the program failed: a panic, or a thread that ended too early.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Failure {
    /// The failure, and what follows from it.
    pub what: String,
    /// The run has failed by it: axes were stopped, or data was lost.
    pub fails_run: bool,
}

impl Failure {
    /// One by which the run has failed.
    #[doc(hidden)]
    pub fn of_run(what: impl Into<String>) -> Failure {
        Failure { what: what.into(), fails_run: true }
    }
}

/// An emergency of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DriveEmergency {
    /// Which of the run's it is, from 1.
    pub number: u64,
    /// The cycle in which it was noticed.
    pub cycle: u64,
    /// The axis, in the order of the plan.
    pub axis: usize,
    /// The emergency message.
    pub emergency: Emergency,
}

impl Measured {
    /// Nothing yet, of axes with these units in this cycle, with an in-loop task or none.
    #[doc(hidden)]
    pub fn new(units: &[Units], cycle: &CyclePlan, task: bool) -> Measured {
        Measured {
            histograms: Histograms::new(units.len()),
            timeline: Timeline::default(),
            motion: Motion::new(units),
            parts: Parts::default(),
            causes: Causes::new(cycle, task),
            emergencies: VecDeque::new(),
            black_boxes: Vec::new(),
            recordings: Vec::new(),
            failures: Vec::new(),
            files: 0,
            period_ns: cycle.period_ns,
        }
    }

    /// Enters one record.
    #[doc(hidden)]
    pub fn enter(&mut self, record: &Record) {
        if let Record::Drive(drive) = record {
            return self.drive(drive);
        }
        self.histograms.enter(record, self.period_ns);
        self.timeline.enter(record);
        self.causes.record(record);
        match record {
            Record::Cycle(cycle) => self.parts.look(cycle.index, &self.histograms),
            Record::Event(event) => {
                if let Some(EventKind::Emergency(emergency)) = event.kind() {
                    self.note(event.index, event.axis.into(), emergency);
                }
            }
            _ => {}
        }
    }

    /// Enters that of a drive: of all records, nearly each one is.
    fn drive(&mut self, drive: &DriveRecord) {
        self.histograms.drive(drive);
        self.timeline.drive(drive);
        self.causes.drive(drive);
        self.motion.enter(drive);
        if drive.stopped == Some(StopCause::LinkThread) {
            self.failed(
                "internal error: the thread that opens connections has ended; the axes of its buses were \
                 stopped; restart the program",
                true,
            );
        }
    }

    /// Notes that a part of the program failed, once.
    fn failed(&mut self, what: &str, fails_run: bool) {
        if self.failures.len() < MOST_KEPT && self.failures.iter().all(|failure| failure.what != what) {
            self.failures.push(Failure { what: what.to_owned(), fails_run });
        }
    }

    fn note(&mut self, cycle: u64, axis: usize, emergency: Emergency) {
        let number = self.emergencies.back().map_or(1, |newest| newest.number + 1);
        if self.emergencies.len() == MOST_KEPT {
            self.emergencies.pop_front();
        }
        self.emergencies.push_back(DriveEmergency { number, cycle, axis, emergency });
    }

    fn wrote(&mut self, mut written: Written) {
        self.files += 1;
        written.number = self.files;
        self.black_boxes.retain(|one| written.replaced.as_ref() != Some(&one.path));
        self.black_boxes.push(written);
        // The first ones show where it began.
        if self.black_boxes.len() > MOST_KEPT {
            self.black_boxes.remove(MOST_KEPT / 2);
        }
    }
}

/// The end of a run: the loop's exact counts, what the telemetry measured, and how it was run.
#[derive(Debug)]
#[non_exhaustive]
pub struct Run {
    /// Exact counts and maxima.
    pub end: Numbers,
    /// Histograms, causes, the course of the run.
    pub measured: Measured,
    /// The grants of the operating system.
    pub granted: Granted,
    /// The machine as planned.
    pub plan: Arc<Plan>,
    /// Time that the hypervisor took from all cores meanwhile, ms.
    pub steal_ms: Option<u64>,
}

impl Run {
    /// A run that has ended.
    #[doc(hidden)]
    pub fn new(
        plan: Arc<Plan>,
        granted: Granted,
        end: Numbers,
        measured: Measured,
        steal_ms: Option<u64>,
    ) -> Run {
        Run { end, measured, granted, plan, steal_ms }
    }
}

/// The writer of the last records to a file when something fails. It runs on the telemetry thread.
#[doc(hidden)]
pub trait Keep: fmt::Debug + Send {
    /// The description of the records for a reader of their memory after the program has ended.
    fn about(&self) -> Vec<u8>;

    /// Makes files of what earlier programs have left that were killed. Comes first.
    fn recover(&mut self);

    /// Notices what fails. `record` is the newest one that `ring` keeps.
    fn enter(&mut self, record: &Record, ring: &RecordReader);

    /// A file is requested, though nothing failed.
    fn request(&mut self);

    /// The run ends, since the program itself failed. Writes a file about it, unless there is one about an earlier
    /// failure.
    fn conclude(&mut self, why: &str);

    /// Writes a file if it is time; `last` waits for nothing more, and not for ever for a disk. Returns the files that
    /// were finished meanwhile.
    fn write(&mut self, last: bool, ring: &RecordReader) -> Vec<Written>;
}

/// A file that was written, or was to be.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Written {
    /// Why.
    pub why: String,
    /// In which cycle that was.
    pub cycle: u64,
    /// Where.
    pub path: PathBuf,
    /// Why it could not be written.
    pub error: Option<String>,
    /// Which of the run's it is, from 1.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub number: usize,
    /// The file that made room for it.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub replaced: Option<PathBuf>,
    /// The disk did not answer in time, or its writer panicked: the run has failed.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub fails_run: bool,
}

impl Written {
    /// A file that is to be at `path`, for this reason.
    #[doc(hidden)]
    pub fn begin(why: &str, cycle: u64, path: PathBuf) -> Written {
        Written { why: why.to_owned(), cycle, path, error: None, number: 0, replaced: None, fails_run: false }
    }
}

impl fmt::Display for Written {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Written { why, cycle, path, error, .. } = self;
        match error {
            None => write!(f, "black box: {} ({why}, cycle {cycle})", path.display()),
            Some(error) => write!(f, "black box not written: {error} ({why}, cycle {cycle})"),
        }
    }
}

/// The results that the thread fills, for any number of readers.
#[derive(Debug)]
pub struct Gathered {
    measured: Mutex<Measured>,
    taps: Taps,
    end: AtomicBool,
    black_box: PendingRequest,
    /// A recording of what is newest is to be written.
    record: PendingRequest,
    /// Records that found no room in the ring, once the run has ended.
    lost: AtomicU64,
    /// Why the run ended, if the program itself failed.
    conclusion: Mutex<Option<String>>,
}

impl Gathered {
    /// The measurements so far. The telemetry waits meanwhile, the loop does not.
    pub fn read(&self) -> MutexGuard<'_, Measured> {
        // A poisoned lock only means that a reader panicked; the numbers are whole.
        self.measured.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The same without a wait; `None`: the telemetry is at work on it.
    pub fn try_read(&self) -> Option<MutexGuard<'_, Measured>> {
        match self.measured.try_lock() {
            Ok(measured) => Some(measured),
            Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => None,
        }
    }

    /// Further readers of the records.
    pub fn taps(&self) -> &Taps {
        &self.taps
    }

    /// Notes that a part of the program failed; `fails_run`: axes were stopped by it, or data was lost.
    pub fn failed(&self, what: &str, fails_run: bool) {
        self.read().failed(what, fails_run);
    }

    /// Requests that the black box is written, and what a recording holds in memory.
    pub fn write_black_box(&self) {
        self.black_box.make();
        self.record.make();
    }

    /// Records that found no room in the ring, once the run has ended.
    pub(super) fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// The same of the recording, once.
    pub(super) fn take_record_request(&self) -> bool {
        self.record.take()
    }
}

/// The thread.
#[derive(Debug)]
pub struct TelemetryThread {
    gathered: Arc<Gathered>,
    thread: Option<JoinHandle<()>>,
    sink: Option<SinkThread>,
}

impl TelemetryThread {
    /// Starts to empty `ring` for all `taps`: one that is added later misses the first records. `prepare` runs first on
    /// the new thread (to keep it off the loop's core).
    pub fn start(
        mut ring: RecordReader,
        measured: Measured,
        taps: Taps,
        mut watch: Option<ThreadWatch>,
        mut black_box: Option<Box<dyn Keep>>,
        prepare: impl FnOnce() + Send + 'static,
    ) -> std::io::Result<TelemetryThread> {
        let gathered = Arc::new(Gathered {
            measured: Mutex::new(measured),
            taps,
            end: AtomicBool::new(false),
            black_box: PendingRequest::default(),
            record: PendingRequest::default(),
            lost: AtomicU64::new(0),
            conclusion: Mutex::default(),
        });
        let shared = Arc::clone(&gathered);
        let thread = std::thread::Builder::new().name("fb-telemetry".into()).spawn(move || {
            prepare();
            let gathered = Arc::clone(&shared);
            let work = move || {
                black_box.iter_mut().for_each(|black_box| black_box.recover());
                let mut late_at = None;
                let mut look = || {
                    let Some(sample) = watch.as_mut().and_then(|watch| watch.sample(COUNT_EVERY_NS)) else {
                        return EMPTY_EVERY;
                    };
                    let causes = &mut shared.read().causes;
                    if causes.is_late() {
                        late_at = Some(sample.at);
                    }
                    causes.sample(sample);
                    let closely = late_at.is_some_and(|at| sample.at.since(at) < CLOSELY_NS);
                    if closely { EMPTY_CLOSELY_EVERY } else { EMPTY_EVERY }
                };
                look();
                let hand_late = || shared.taps.hand_late(&shared.read().causes);
                hand_late();
                loop {
                    // Looked at before the ring is emptied, so that the last records are taken too.
                    let last = shared.end.load(Ordering::Acquire);
                    let mut batch = (!shared.taps.is_empty()).then(Vec::new);
                    while !ring.is_empty() {
                        let mut measured = shared.read();
                        for record in std::iter::from_fn(|| ring.next()).take(PIECE) {
                            measured.enter(record);
                            if let Some(black_box) = &mut black_box {
                                black_box.enter(record, &ring);
                            }
                            if let Some(batch) = &mut batch {
                                batch.push(*record);
                            }
                        }
                        drop(measured);
                        ring.release();
                        // Who looks at it without a wait finds it free now and then, however much there is to do.
                        std::thread::yield_now();
                    }
                    shared.taps.hand(batch.unwrap_or_default());
                    let wait = look();
                    hand_late();
                    if let Some(black_box) = &mut black_box {
                        if shared.black_box.take() {
                            black_box.request();
                        }
                        if let Some(why) =
                            shared.conclusion.lock().unwrap_or_else(PoisonError::into_inner).take()
                        {
                            black_box.conclude(&why);
                        }
                        for written in black_box.write(last, &ring) {
                            if written.fails_run {
                                shared.failed(&written.to_string(), true);
                            }
                            shared.read().wrote(written);
                        }
                    }
                    if last {
                        break;
                    }
                    // Until then, or until the end is requested.
                    std::thread::park_timeout(wait);
                }
            };
            let ended = catch_unwind(AssertUnwindSafe(work));
            if ended.is_err() {
                gathered.taps.end();
                gathered.failed(
                    "internal error: the telemetry panicked; histograms, causes of late cycles, black box \
                     and recording end there; please report it",
                    true,
                );
            }
        })?;
        Ok(TelemetryThread { gathered, thread: Some(thread), sink: None })
    }

    /// Room that the ring needs for cycles of so many records.
    pub fn ring_size(records_a_cycle: usize, period_ns: u64) -> usize {
        let cycles = usize::try_from(RING_NS.div_ceil(period_ns.max(1))).unwrap_or(MOST_RECORDS).max(16);
        cycles.saturating_mul(records_a_cycle).clamp(LEAST_RECORDS, MOST_RECORDS)
    }

    /// It feeds a sink, which has begun. `status` says how many records the loop has lost so far.
    pub fn feed(
        mut self,
        feed: Option<Feed>,
        status: Reader<Status>,
        prepare: impl FnOnce() + Send + 'static,
    ) -> std::io::Result<TelemetryThread> {
        if let Some(feed) = feed {
            self.sink = Some(SinkThread::start(feed, status, Arc::clone(&self.gathered), prepare)?);
        }
        Ok(self)
    }

    /// The results that it fills.
    pub fn gathered(&self) -> &Arc<Gathered> {
        &self.gathered
    }

    /// Takes the last records and ends the thread. `status` has the loop's own counts, `failed` why the loop ended if
    /// it failed itself.
    pub fn finish(&mut self, status: &Status, failed: Option<String>) -> Measured {
        if let Some(why) = &failed {
            self.gathered.failed(why, true);
        }
        *self.gathered.conclusion.lock().unwrap_or_else(PoisonError::into_inner) = failed;
        self.end();
        {
            let causes = &mut self.gathered.read().causes;
            causes.finish(status.late);
            self.gathered.taps.hand_late(causes);
        }
        self.gathered.lost.store(status.lost_records, Ordering::Relaxed);
        // Its last records, and the causes that became known only now, are written before the numbers are taken.
        self.gathered.taps.end();
        let recorded = self.sink.take().map(SinkThread::finish).unwrap_or_default();
        recorded.iter().filter_map(Recorded::failure).for_each(|what| self.gathered.failed(&what, true));
        let mut measured = self.gathered.read();
        measured.recordings = recorded;
        measured.clone()
    }

    fn end(&mut self) {
        self.gathered.end.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}

impl Drop for TelemetryThread {
    fn drop(&mut self) {
        self.end();
        self.gathered.taps.end();
        self.sink.take().map(SinkThread::finish);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;
    use fieldbeat_core::cycle::record::EventRecord;
    use fieldbeat_core::cycle::ring::{self, Kept, RecordWriter};
    use fieldbeat_core::rt::Regions;

    fn ring() -> (RecordWriter, RecordReader) {
        let (writer, reader, _) = ring::records(4, Kept::default(), &mut Regions::new());
        (writer, reader)
    }

    #[test]
    fn the_newest_emergencies_are_kept_and_all_are_numbered() {
        let mut measured = Measured::new(&[Units::millimetres(1.0); 2], &CyclePlan::default(), false);
        for index in 0..100 {
            let one = Emergency { code: index as u16, register: 1 };
            let kind = if index % 10 == 9 { EventKind::Restarted } else { EventKind::Emergency(one) };
            measured.enter(&Record::Event(EventRecord::new(index, 1, kind, None)));
        }
        let [first, .., last] = measured.emergencies.make_contiguous() else { panic!("none") };
        assert_eq!((first.number, first.cycle, first.axis), (27, 28, 1));
        assert_eq!((last.number, last.cycle, last.emergency.code), (90, 98, 98));
        assert_eq!(measured.emergencies.len(), MOST_KEPT);
    }

    /// A black box with an error of ours.
    #[derive(Debug)]
    struct Panics;

    impl Keep for Panics {
        fn about(&self) -> Vec<u8> {
            Vec::new()
        }

        fn recover(&mut self) {}

        fn enter(&mut self, _record: &Record, _ring: &RecordReader) {
            std::panic::resume_unwind(Box::new("on purpose"));
        }

        fn request(&mut self) {}

        fn conclude(&mut self, _why: &str) {}

        fn write(&mut self, _last: bool, _ring: &RecordReader) -> Vec<Written> {
            Vec::new()
        }
    }

    #[test]
    fn a_telemetry_thread_that_panics_is_a_failure_of_the_run_and_holds_up_no_end() {
        let (mut records, ring) = ring();
        let measured = Measured::new(&[Units::millimetres(1.0); 1], &CyclePlan::default(), false);
        let mut telemetry =
            TelemetryThread::start(ring, measured, Taps::default(), None, Some(Box::new(Panics)), || {})
                .unwrap();
        assert!(records.push(Record::Drive(DriveRecord::default())));
        let measured = telemetry.finish(&Status::default(), Some("the loop panicked".to_owned()));
        let [first, second] = &measured.failures[..] else { panic!("{:?}", measured.failures) };
        let mut both = [first, second].map(|failure| (failure.fails_run, &*failure.what));
        both.sort();
        assert!(both[0].1.starts_with("internal error: the telemetry panicked; "), "{both:?}");
        assert_eq!((both[0].0, both[1]), (true, (true, "the loop panicked")));
    }

    /// A black box that holds up its thread at each record until it may go on.
    #[derive(Debug)]
    struct Held {
        at_work: mpsc::Sender<()>,
        goes_on: mpsc::Receiver<()>,
    }

    impl Keep for Held {
        fn about(&self) -> Vec<u8> {
            Vec::new()
        }

        fn recover(&mut self) {}

        fn enter(&mut self, _record: &Record, _ring: &RecordReader) {
            self.at_work.send(()).unwrap();
            self.goes_on.recv().unwrap();
        }

        fn request(&mut self) {}

        fn conclude(&mut self, _why: &str) {}

        fn write(&mut self, _last: bool, _ring: &RecordReader) -> Vec<Written> {
            Vec::new()
        }
    }

    #[test]
    fn a_sign_of_life_does_not_wait_for_a_busy_telemetry_thread() {
        let (mut records, ring) = ring();
        let measured = Measured::new(&[Units::millimetres(1.0); 1], &CyclePlan::default(), false);
        let ((at_work, held), (go_on, goes_on)) = (mpsc::channel(), mpsc::channel());
        let keep = Box::new(Held { at_work, goes_on });
        let mut telemetry =
            TelemetryThread::start(ring, measured, Taps::default(), None, Some(keep), || {}).unwrap();
        assert!(records.push(Record::Drive(DriveRecord::default())));
        held.recv().unwrap();
        assert!(telemetry.gathered().try_read().is_none());
        go_on.send(()).unwrap();
        assert!(telemetry.finish(&Status::default(), None).failures.is_empty());
        assert!(telemetry.gathered().try_read().is_some());
    }

    #[test]
    fn the_end_of_the_link_thread_is_reported_once() {
        let mut measured = Measured::new(&[Units::millimetres(1.0); 1], &CyclePlan::default(), false);
        for index in 0..3 {
            let stopped = Some(StopCause::LinkThread);
            measured.enter(&Record::Drive(DriveRecord { index, stopped, ..DriveRecord::default() }));
        }
        assert!(matches!(&measured.failures[..], [Failure { fails_run: true, .. }]), "{measured:?}");
    }

    #[test]
    fn the_ring_holds_a_second_within_bounded_memory() {
        assert_eq!(TelemetryThread::ring_size(9, MS), 9_000);
        assert_eq!(TelemetryThread::ring_size(4, 250_000), 16_000);
        assert_eq!(TelemetryThread::ring_size(2, 10 * S), 1 << 13);
        assert_eq!(TelemetryThread::ring_size(1_000, 100_000), 1 << 18);
        assert_eq!(TelemetryThread::ring_size(usize::MAX, 0), 1 << 18);
    }
}
