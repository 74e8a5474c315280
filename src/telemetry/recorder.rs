//! The thread that empties the loop's ring: into histograms, the time line, the search for causes, and the black box.

use std::collections::VecDeque;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rtrb::Consumer;

use super::causes::Causes;
use super::histograms::Histograms;
use super::timeline::Timeline;
use crate::axis::{Emergency, StopCause};
use crate::cycle::record::Record;
use crate::cycle::status::Numbers;
use crate::cycle::{CyclePlan, Plan};
use crate::rt::Granted;
use crate::rt::watch::ThreadWatch;
use crate::time::{MS, S};

/// How often the ring is emptied, and the times of the loop's thread are read: each wake-up has its price.
const EMPTY_EVERY: Duration = Duration::from_millis(20);

/// The same for [`CLOSELY_NS`] after a late cycle. One more is likely to follow, and what the thread usually runs in a
/// cycle is learned between them only.
const EMPTY_CLOSELY_EVERY: Duration = Duration::from_millis(10);
const CLOSELY_NS: u64 = 250 * MS;

/// How often what the kernel counted against the loop's thread is read: it takes some hundred microseconds.
const COUNT_EVERY_NS: u64 = 100 * MS;

/// What the ring holds: the thread is a normal one, and on a busy host it waits for its turn far longer than it sleeps.
/// With room for 100 ms, 5 923 records of 4 s were lost next to a compiler on every core.
const RING_NS: u64 = S;

/// The most records in all. Their memory is locked; the loop counts what does not fit.
const MOST_RECORDS: usize = 1 << 18;

/// What the records of a run came to.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Measured {
    /// Every quantity.
    pub histograms: Histograms,
    /// The largest values over time.
    pub timeline: Timeline,
    /// Why cycles were late.
    pub causes: Causes,
    /// The newest emergencies of the drives, in their order.
    pub emergencies: VecDeque<DriveEmergency>,
    /// The files that the black box was written to, or could not be.
    pub black_boxes: Vec<Written>,
    /// What failed of the program itself, each once.
    pub failures: Vec<Failure>,
    /// How many that were, those that made room for newer ones included.
    files: usize,
    period_ns: u64,
}

/// So many files and emergencies are kept for the application.
const MOST_KEPT: usize = 64;

/// A part of the program failed: a panic, or a thread that ended too early.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "summary", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Failure {
    /// What failed, and what follows from it.
    pub what: String,
    /// The run has failed by it: axes were stopped, or data was lost.
    pub fails_run: bool,
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
    /// What it said.
    pub emergency: Emergency,
}

impl Measured {
    /// Nothing yet, of so many axes in this cycle, with an in-loop task or none.
    #[doc(hidden)]
    pub fn new(axes: usize, cycle: &CyclePlan, task: bool) -> Measured {
        Measured {
            histograms: Histograms::new(axes),
            timeline: Timeline::default(),
            causes: Causes::new(cycle, task),
            emergencies: VecDeque::new(),
            black_boxes: Vec::new(),
            failures: Vec::new(),
            files: 0,
            period_ns: cycle.period_ns,
        }
    }

    /// Enters one record.
    #[doc(hidden)]
    pub fn enter(&mut self, record: &Record) {
        self.histograms.enter(record, self.period_ns);
        self.timeline.enter(record);
        self.causes.record(record);
        let Record::Drive(drive) = record else { return };
        if let Some(emergency) = drive.emergency() {
            self.note(drive.index, drive.axis.into(), emergency);
        }
        if drive.stopped == Some(StopCause::LinkThread) {
            self.failed(
                "internal error: the thread that opens connections has ended; the axes of its buses were stopped; \
                 restart the program",
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
    /// What the operating system granted.
    pub granted: Granted,
    /// The machine as planned.
    pub plan: Arc<Plan>,
    /// Time that the hypervisor took from all cores meanwhile, ms.
    pub steal_ms: Option<u64>,
}

/// What keeps the last records and writes them to a file when something fails. It runs on the telemetry thread. The
/// feature `black-box` has the one there is; without it there is none.
pub trait Keep: fmt::Debug + Send {
    /// Takes a record in, and notices what fails.
    fn enter(&mut self, record: &Record);

    /// A file is requested, though nothing failed.
    fn request(&mut self);

    /// The run ends, since the program itself failed. Writes a file about it, unless there is one about an earlier
    /// failure.
    fn conclude(&mut self, why: &str);

    /// Writes a file if it is time; `last` waits for nothing more, and not for ever for a disk. Returns the files that
    /// were finished meanwhile.
    fn write(&mut self, last: bool) -> Vec<Written>;
}

/// A file that was written, or was to be.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "summary", derive(serde::Serialize))]
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
    #[cfg_attr(feature = "summary", serde(skip))]
    pub number: usize,
    /// The file that made room for it.
    #[cfg_attr(feature = "summary", serde(skip))]
    pub replaced: Option<PathBuf>,
    /// Its disk did not answer in time, or its writer panicked: the run has failed.
    #[cfg_attr(feature = "summary", serde(skip))]
    pub fails_run: bool,
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

/// What the thread fills, for any number of readers.
#[derive(Debug)]
pub struct Recording {
    measured: Mutex<Measured>,
    end: AtomicBool,
    black_box: AtomicBool,
    /// Why the run ended, if the program itself failed.
    conclusion: Mutex<Option<String>>,
}

impl Recording {
    /// What was measured so far. The telemetry waits meanwhile, the loop does not.
    pub fn read(&self) -> MutexGuard<'_, Measured> {
        // A poisoned lock only means that a reader panicked; the numbers are whole.
        self.measured.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that a part of the program failed; `fails_run`: axes were stopped by it, or data was lost.
    pub fn failed(&self, what: &str, fails_run: bool) {
        self.read().failed(what, fails_run);
    }

    /// Asks for the black box to be written.
    pub fn write_black_box(&self) {
        self.black_box.store(true, Ordering::Release);
    }
}

/// The thread.
#[derive(Debug)]
pub struct Recorder {
    recording: Arc<Recording>,
    thread: Option<JoinHandle<()>>,
}

impl Recorder {
    /// Starts to empty `ring`. `prepare` runs first on the new thread (to keep it off the loop's core).
    pub fn start(
        mut ring: Consumer<Record>,
        measured: Measured,
        mut watch: Option<ThreadWatch>,
        mut black_box: Option<Box<dyn Keep>>,
        prepare: impl FnOnce() + Send + 'static,
    ) -> std::io::Result<Recorder> {
        let recording = Arc::new(Recording {
            measured: Mutex::new(measured),
            end: AtomicBool::new(false),
            black_box: AtomicBool::new(false),
            conclusion: Mutex::default(),
        });
        let shared = Arc::clone(&recording);
        let thread = std::thread::Builder::new().name("fb-telemetry".into()).spawn(move || {
            prepare();
            let recording = Arc::clone(&shared);
            let work = move || {
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
            loop {
                // Looked at before the ring is emptied, so that the last records are taken too.
                let last = shared.end.load(Ordering::Acquire);
                {
                    let mut measured = shared.read();
                    while let Ok(record) = ring.pop() {
                        measured.enter(&record);
                        if let Some(black_box) = &mut black_box {
                            black_box.enter(&record);
                        }
                    }
                }
                let wait = look();
                if let Some(black_box) = &mut black_box {
                    if shared.black_box.swap(false, Ordering::AcqRel) {
                        black_box.request();
                    }
                    if let Some(why) = shared.conclusion.lock().unwrap_or_else(PoisonError::into_inner).take() {
                        black_box.conclude(&why);
                    }
                    for written in black_box.write(last) {
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
            if catch_unwind(AssertUnwindSafe(work)).is_err() {
                recording.failed(
                    "internal error: the telemetry panicked; histograms, causes of late cycles and black box end \
                     there; please report it",
                    true,
                );
            }
        })?;
        Ok(Recorder { recording, thread: Some(thread) })
    }

    /// Room that the ring needs for cycles of so many records.
    pub fn ring_size(records_a_cycle: usize, period_ns: u64) -> usize {
        let cycles = usize::try_from(RING_NS.div_ceil(period_ns.max(1))).unwrap_or(MOST_RECORDS).max(16);
        cycles.saturating_mul(records_a_cycle).min(MOST_RECORDS)
    }

    /// What it fills.
    pub fn recording(&self) -> &Arc<Recording> {
        &self.recording
    }

    /// Takes the last records and ends the thread. `late` is the loop's own count of late cycles, `failed` why the loop
    /// ended if it failed itself.
    pub fn finish(&mut self, late: u64, failed: Option<String>) -> Measured {
        if let Some(why) = &failed {
            self.recording.failed(why, true);
        }
        *self.recording.conclusion.lock().unwrap_or_else(PoisonError::into_inner) = failed;
        self.end();
        let mut measured = self.recording.read();
        measured.causes.finish(late);
        measured.clone()
    }

    fn end(&mut self) {
        self.recording.end.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.end();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cycle::record::DriveRecord;

    #[test]
    fn the_newest_emergencies_are_kept_and_all_are_numbered() {
        let mut measured = Measured::new(2, &CyclePlan::default(), false);
        for index in 0..100 {
            let one = Emergency { code: index as u16, register: 1 };
            let emergency = (index % 10 != 9).then_some(one.into());
            measured.enter(&Record::Drive(DriveRecord {
                index,
                axis: 1,
                emergency,
                ..DriveRecord::default()
            }));
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
        fn enter(&mut self, _record: &Record) {
            std::panic::resume_unwind(Box::new("on purpose"));
        }

        fn request(&mut self) {}

        fn conclude(&mut self, _why: &str) {}

        fn write(&mut self, _last: bool) -> Vec<Written> {
            Vec::new()
        }
    }

    #[test]
    fn a_telemetry_thread_that_panics_is_a_failure_of_the_run_and_holds_up_no_end() {
        let (mut records, ring) = rtrb::RingBuffer::new(4);
        let measured = Measured::new(1, &CyclePlan::default(), false);
        let mut recorder = Recorder::start(ring, measured, None, Some(Box::new(Panics)), || {}).unwrap();
        records.push(Record::Drive(DriveRecord::default())).unwrap();
        let measured = recorder.finish(0, Some("the loop panicked".to_owned()));
        let [first, second] = &measured.failures[..] else { panic!("{:?}", measured.failures) };
        let mut both = [first, second].map(|failure| (failure.fails_run, &*failure.what));
        both.sort();
        assert!(both[0].1.starts_with("internal error: the telemetry panicked; "), "{both:?}");
        assert_eq!((both[0].0, both[1]), (true, (true, "the loop panicked")));
    }

    #[test]
    fn the_end_of_the_link_thread_is_reported_once() {
        let mut measured = Measured::new(1, &CyclePlan::default(), false);
        for index in 0..3 {
            let stopped = Some(StopCause::LinkThread);
            measured.enter(&Record::Drive(DriveRecord { index, stopped, ..DriveRecord::default() }));
        }
        assert!(matches!(&measured.failures[..], [Failure { fails_run: true, .. }]), "{measured:?}");
    }

    #[test]
    fn the_ring_holds_a_second_within_bounded_memory() {
        assert_eq!(Recorder::ring_size(9, MS), 9_000);
        assert_eq!(Recorder::ring_size(4, 250_000), 16_000);
        assert_eq!(Recorder::ring_size(2, 10 * S), 32);
        assert_eq!(Recorder::ring_size(1_000, 100_000), 1 << 18);
        assert_eq!(Recorder::ring_size(usize::MAX, 0), 1 << 18);
    }
}
