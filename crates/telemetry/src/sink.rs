//! What takes all records of a machine down, besides what the telemetry makes of them. It has a thread of its own
//! behind a tap, since it may wait for a disk; in virtual time it is fed directly, so that it loses nothing.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::causes::Judged;
use super::tap::{NoBatch, Tap, Taps};
use super::thread::Gathered;
use fieldbeat_core::axis::cell::Reader;
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::cycle::status::Status;

/// The number of batches that may wait: those of some five seconds in which a disk does not take them.
const ROOM: usize = 256;

/// How often it is looked at without records.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// At the end a disk has so long, and in addition the time for what is in memory at this rate, bytes/s.
const PATIENCE: Duration = Duration::from_secs(5);
const SLOWEST: u64 = 1_000_000;

/// The writer of the records.
pub trait Sink: fmt::Debug + Send {
    /// The clock of the records is so much earlier than UTC. Comes before all else.
    fn begin(&mut self, utc_ns: i64);

    /// Takes a record in.
    fn enter(&mut self, record: &Record);

    /// The cause of a late cycle is known.
    fn late(&mut self, judged: &Judged);

    /// Requests that the held records are written, though nothing failed.
    fn request(&mut self);

    /// Reports the number of records lost on the way to it so far; comes after each batch, and now and then without
    /// one. The log of the loop is taken now. Returns what failed meanwhile.
    fn look(&mut self, lost: u64) -> Option<String>;

    /// About how many bytes it holds in memory and writes at its end.
    fn holds(&self) -> u64;

    /// There are no more records. Returns what it has written.
    fn finish(&mut self) -> Vec<Recorded>;
}

/// A file of a recording, or what was to be one.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Recorded {
    /// Where.
    pub path: PathBuf,
    /// Why it ends where it does.
    pub why: String,
    /// The messages.
    pub messages: u64,
    /// The size, bytes.
    pub bytes: u64,
    /// Records that are missing in it, since its disk was too slow or has failed.
    pub lost: u64,
    /// The parts of it for a replay; `None`: it was recorded without the wire.
    pub wire: Option<WireSummary>,
    /// Why it could not be written to its end.
    pub error: Option<String>,
}

impl Recorded {
    /// A file that is to be at `path`, with nothing in it yet.
    #[doc(hidden)]
    pub fn begin(path: PathBuf, why: String) -> Recorded {
        Recorded { path, why, ..Recorded::default() }
    }
}

/// The parts of a recording for `Replay`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct WireSummary {
    /// Bytes of the log.
    pub bytes: u64,
    /// The first cycle that is not in it, since there was no room for it between the loop and the file; `None`: all
    /// are there.
    pub cut_at: Option<u64>,
}

/// A sink and where its records come from.
#[derive(Debug)]
pub struct Feed {
    /// The file to which it writes.
    pub path: PathBuf,
    /// The sink.
    pub sink: Box<dyn Sink>,
    /// Holds what came since it was added, until the thread of the sink takes it.
    pub tap: Tap,
}

impl Feed {
    /// Adds the tap of `sink`, which writes to `path`.
    pub fn new(path: PathBuf, sink: Box<dyn Sink>, taps: &Taps) -> Feed {
        Feed { path, sink, tap: taps.add(ROOM) }
    }
}

/// The thread of a sink.
#[derive(Debug)]
pub struct SinkThread {
    thread: JoinHandle<Vec<Recorded>>,
    path: PathBuf,
    /// See [`Sink::holds`].
    holds: Arc<AtomicU64>,
}

impl SinkThread {
    /// Feeds a sink. `prepare` runs first on the new thread.
    pub fn start(
        feed: Feed,
        status: Reader<Status>,
        gathered: Arc<Gathered>,
        prepare: impl FnOnce() + Send + 'static,
    ) -> std::io::Result<SinkThread> {
        let Feed { path, mut sink, tap } = feed;
        let holds = Arc::<AtomicU64>::default();
        let known = Arc::clone(&holds);
        let work = move || {
            prepare();
            loop {
                let batch = match tap.next(LOOK_EVERY) {
                    Ok(batch) => Some(batch),
                    Err(NoBatch::Yet) => None,
                    Err(NoBatch::AnyMore) => break,
                };
                batch.iter().flat_map(|batch| batch.iter()).for_each(|record| sink.enter(record));
                tap.late().for_each(|judged| sink.late(&judged));
                if gathered.take_record_request() {
                    sink.request();
                }
                if let Some(what) = sink.look(tap.lost() + status.read().lost_records) {
                    gathered.failed(&what, true);
                }
                known.store(sink.holds(), Ordering::Relaxed);
            }
            tap.late().for_each(|judged| sink.late(&judged));
            let last = sink.look(tap.lost() + gathered.lost().max(status.read().lost_records));
            let recorded = sink.finish();
            let failed = recorded.iter().filter_map(Recorded::failure).next();
            if let Some(what) = last.or(failed) {
                gathered.failed(&what, true);
            }
            recorded
        };
        let thread = std::thread::Builder::new().name("fb-record".into()).spawn(work)?;
        Ok(SinkThread { thread, path, holds })
    }

    /// Waits for the end of the file, though not for ever: its tap has ended.
    pub fn finish(self) -> Vec<Recorded> {
        let begun = Instant::now();
        let patience = PATIENCE + Duration::from_secs(self.holds.load(Ordering::Relaxed) / SLOWEST);
        while !self.thread.is_finished() && begun.elapsed() < patience {
            std::thread::sleep(Duration::from_millis(2));
        }
        let error = match self.thread.is_finished().then(|| self.thread.join()) {
            Some(Ok(recorded)) => return recorded,
            Some(Err(_)) => "its writer panicked; please report it".to_owned(),
            None => format!("its disk does not answer for {} s; look at that disk", patience.as_secs()),
        };
        vec![Recorded { path: self.path, error: Some(error), ..Recorded::default() }]
    }
}

impl Recorded {
    /// The failure, in one line; `None` if there is none. The number of missing records is not in it: the line stays
    /// the same while there are more of them.
    pub fn failure(&self) -> Option<String> {
        let missing = "records are missing, since its disk or this host was too slow; record to another \
             disk, or with a longer period";
        let error = self.error.as_deref().or((self.lost > 0).then_some(missing))?;
        Some(format!("recording {} is not complete: {error}", self.path.display()))
    }
}

impl fmt::Display for Recorded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Recorded { path, why, messages, bytes, lost, wire, error } = self;
        write!(f, "recording: {} ({why}), {messages} messages, {bytes} bytes", path.display())?;
        if let Some(wire) = wire {
            write!(f, ", {} of them for `fieldbeat replay`", wire.bytes)?;
        }
        if *lost > 0 {
            write!(f, ", {lost} records are missing")?;
        }
        error.as_ref().map_or(Ok(()), |error| write!(f, "; not complete: {error}"))
    }
}

/// A request that anyone may make and the thread takes once.
#[derive(Debug, Default)]
pub struct PendingRequest(AtomicBool);

impl PendingRequest {
    /// Makes it.
    pub fn make(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Takes it, if it was made.
    pub fn take(&self) -> bool {
        self.0.swap(false, Ordering::AcqRel)
    }
}
