//! The records of all cycles of a running master, as they are made, for another process: a display.
//!
//! The question `watch` is answered with what the records are of. The question `records` after it begins a stream, one
//! way and up to the end of either side: frames of a kind, a length in four bytes, and so many bytes. The records have
//! the bytes that they have in memory. Whoever reads too slowly loses records, and gets their number; the telemetry
//! thread waits for nobody.

use std::io::{self, Read};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant, SystemTime};

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::protocol::{Exchange, LOOK_EVERY};
use super::server::{PATIENCE_OF_STREAM, Sender};
use super::{AskError, Conversation};
use fieldbeat_core::axis::{BegunBy, EventKind, FaultNames};
use fieldbeat_core::cycle::record::{CommandStep, Record};
use fieldbeat_core::cycle::stored::{LAYOUT, RECORD};
use fieldbeat_core::rt::MonotonicClock;
use fieldbeat_core::rt::thread::helper_thread;
use fieldbeat_core::time::nanos;
use fieldbeat_record::blackbox::file::Header;
use fieldbeat_record::blackbox::header;
use fieldbeat_record::summary::Found;
use fieldbeat_telemetry::Monitor;
use fieldbeat_telemetry::causes::Tally;
use fieldbeat_telemetry::tap::{NoBatch, Tap};

/// Watchers of one master at a time: each costs its telemetry thread a queue.
pub(super) const MOST_WATCHERS: usize = 4;

/// Batches that wait for a watcher: more than a second of them.
const ROOM: usize = 64;

/// News come at least so often: whoever gets none knows that the master hangs.
pub const NEWS_EVERY: Duration = Duration::from_millis(200);

/// A longer frame is no frame of ours: the ring of the loop has some 19 MB.
const LONGEST_FRAME: usize = 32 << 20;

const KIND_RECORDS: u8 = b'R';
const KIND_NEWS: u8 = b'N';

/// Bytes before those of a frame: its kind and its length.
const BEFORE: usize = 5;

/// A master that lives answers sooner.
const PATIENCE: Duration = Duration::from_secs(5);

/// The description of the records.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct About {
    /// The process.
    pub pid: u32,
    /// The layout of the records.
    layout: u32,
    /// The date at the zero of the clock of the records, ns since 1970.
    pub epoch_ns: u64,
    /// The machine.
    pub header: Header,
}

/// The news besides the records.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct News {
    /// Records that this watcher has lost so far, since it read too slowly.
    pub lost: u64,
    /// Records that the ring of the loop had no room for so far: everybody has lost them.
    pub dropped: u64,
    /// Late cycles so far.
    pub late_count: u64,
    /// Faults that occur in the records from here on: the axis, the code, and its name.
    pub faults: Vec<(usize, u32, String)>,
    /// The events of the axes, up to the records that come next.
    pub events: Vec<Happened>,
    /// Late cycles whose cause was found.
    pub late: Vec<Late>,
}

/// An event of an axis, or the begin of one of its commands.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Happened {
    /// The cycle.
    pub cycle: u64,
    /// The axis, in the order of the plan.
    pub axis: usize,
    /// The event in words.
    pub text: String,
    /// A fault, or a stop of the master.
    pub fault: bool,
}

/// A late cycle.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Late {
    /// Which.
    pub cycle: u64,
    /// How long its delay was, ns; 0 for a drive.
    pub delay_ns: u64,
    /// The cause, in words.
    pub cause: String,
}

/// The master's side of one conversation.
#[derive(Debug)]
pub struct Watch {
    monitor: Monitor,
    /// The same in each conversation: it distinguishes one master from the next.
    epoch_ns: u64,
    watchers: Arc<AtomicUsize>,
    subscription: Option<Subscription>,
}

/// One of the watchers, and its records.
#[derive(Debug)]
struct Subscription {
    tap: Tap,
    watchers: Arc<AtomicUsize>,
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.watchers.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Clone for Watch {
    /// For another conversation with the same master.
    fn clone(&self) -> Watch {
        let (monitor, watchers) = (self.monitor.clone(), Arc::clone(&self.watchers));
        Watch { monitor, epoch_ns: self.epoch_ns, watchers, subscription: None }
    }
}

impl Watch {
    /// Of the machine behind `monitor`.
    pub fn new(monitor: &Monitor) -> Watch {
        let date = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, nanos);
        let epoch_ns = date.saturating_sub(MonotonicClock::read().0);
        Watch { monitor: monitor.clone(), epoch_ns, watchers: Arc::default(), subscription: None }
    }

    /// The answer to `watch`; `None` to any other question.
    pub fn answer(&mut self, question: &Value) -> Option<Result<Value, String>> {
        (question["ask"] == "watch").then(|| self.begin().map(|about| json!(about)))
    }

    fn begin(&mut self) -> Result<About, String> {
        self.subscription = None;
        let one_more = |watchers: usize| (watchers < MOST_WATCHERS).then_some(watchers + 1);
        if self.watchers.fetch_update(Ordering::Relaxed, Ordering::Relaxed, one_more).is_err() {
            return Err(format!("{MOST_WATCHERS} others watch this master already; end one of them"));
        }
        let watchers = Arc::clone(&self.watchers);
        self.subscription = Some(Subscription { tap: self.monitor.tap(ROOM), watchers });
        let header = header(self.monitor.plan());
        Ok(About { pid: std::process::id(), layout: LAYOUT, epoch_ns: self.epoch_ns, header })
    }

    /// The stream that `records` begins; `None`: the question is another one, or nothing was announced.
    pub fn stream(&mut self, question: &Value, send: &mut Sender<'_>) -> Option<io::Result<()>> {
        let is_records = question["ask"] == "records";
        self.subscription
            .take()
            .filter(|_| is_records)
            .map(|subscription| Stream::new(&self.monitor, subscription).run(send))
    }

    /// The same without a socket file, for a display in the master's own process.
    pub fn local(mut self) -> Result<(About, Watched), String> {
        let about = self.begin()?;
        let (ours, theirs) = UnixStream::pair().map_err(|error| error.to_string())?;
        let (core, axes) = (self.monitor.granted().core, about.header.axes.len());
        let run = move || {
            // Already so on a thread of a server, whose filter refuses it.
            helper_thread(core);
            let mut send = |bytes: &[u8]| Exchange::new(&ours, PATIENCE_OF_STREAM, &|| true)?.send(bytes);
            // It ends when nobody reads any more.
            let _ = self.stream(&json!({ "ask": "records" }), &mut send);
        };
        let thread = std::thread::Builder::new().name("fb-watch".into()).spawn(run);
        thread.map_err(|error| error.to_string())?;
        Ok((about, Watched::new(theirs, axes).map_err(|error| error.to_string())?))
    }
}

/// A stream under way, at the master's side.
struct Stream<'a> {
    monitor: &'a Monitor,
    subscription: Subscription,
    names: Vec<FaultNames>,
    /// The faults that were named: axis and code.
    named: Vec<(u16, u32)>,
    bytes: Vec<u8>,
}

impl Stream<'_> {
    fn new(monitor: &Monitor, subscription: Subscription) -> Stream<'_> {
        let names = monitor.plan().fault_names();
        Stream { monitor, subscription, names, named: Vec::new(), bytes: Vec::new() }
    }

    fn run(mut self, send: &mut Sender<'_>) -> io::Result<()> {
        let mut news_at = None;
        loop {
            let batch = match self.subscription.tap.next(LOOK_EVERY) {
                Ok(batch) => Some(batch),
                Err(NoBatch::Yet) => None,
                Err(NoBatch::AnyMore) => return Ok(()),
            };
            let records = batch.as_deref().unwrap_or_default();
            let (faults, events) = (self.new_faults(records), self.events(records));
            if !faults.is_empty()
                || !events.is_empty()
                || news_at.is_none_or(|at: Instant| at.elapsed() >= NEWS_EVERY)
            {
                news_at = Some(Instant::now());
                let news = self.news(faults, events);
                // Numbers and strings can always be written.
                self.frame(KIND_NEWS, |bytes| bytes.extend(serde_json::to_vec(&news).unwrap_or_default()));
                send(&self.bytes)?;
            }
            if !records.is_empty() {
                let kept = records.iter().filter(|record| {
                    !matches!(record, Record::Command(_) | Record::Event(_) | Record::Native(_))
                });
                self.frame(KIND_RECORDS, |bytes| kept.for_each(|record| bytes.extend(record.store())));
                send(&self.bytes)?;
            }
        }
    }

    fn frame(&mut self, kind: u8, fill: impl FnOnce(&mut Vec<u8>)) {
        self.bytes.clear();
        self.bytes.extend([kind, 0, 0, 0, 0]);
        fill(&mut self.bytes);
        let length = (self.bytes.len() - BEFORE) as u32;
        self.bytes[1..BEFORE].copy_from_slice(&length.to_le_bytes());
    }

    /// The names of faults that occur for the first time.
    fn new_faults(&mut self, records: &[Record]) -> Vec<(usize, u32, String)> {
        let mut faults = Vec::new();
        for record in records {
            let Record::Drive(drive) = record else { continue };
            let axis = usize::from(drive.axis);
            let code = drive.fault;
            if code != 0 && !self.named.contains(&(drive.axis, code)) {
                self.named.push((drive.axis, code));
                let name = self.names.get(axis).and_then(|names| names(code));
                faults.extend(name.map(|name| (axis, code, name.to_owned())));
            }
        }
        faults
    }

    /// The events in words: the codes of faults mean something here only.
    fn events(&self, records: &[Record]) -> Vec<Happened> {
        let happened = records.iter().filter_map(|record| match record {
            Record::Command(begun) if begun.step() == CommandStep::Begun => {
                let text = format!("{} (command {}) begins", begun.command().name(), begun.id.0);
                Some(Happened { cycle: begun.index, axis: begun.axis().into(), text, fault: false })
            }
            Record::Event(event) => {
                let (axis, kind) = (usize::from(event.axis), event.kind()?);
                let name = kind.fault().and_then(|code| self.names.get(axis).and_then(|names| names(code)));
                let fault = matches!(kind, EventKind::Fault(1..) | EventKind::Stopped(_));
                let begun_by = event.begun_by();
                let axes = self.monitor.plan().axes();
                let of = begun_by.and_then(|by| axes.get(usize::from(by.axis)));
                let text = BegunBy::after(kind.described(name), begun_by, of.map(|axis| axis.name.as_str()));
                Some(Happened { cycle: event.index, axis, text, fault })
            }
            _ => None,
        });
        happened.collect()
    }

    fn news(&self, faults: Vec<(usize, u32, String)>, events: Vec<Happened>) -> News {
        let (late, status) = (self.new_late(), self.monitor.status());
        let (lost, dropped, late_count) = (self.subscription.tap.lost(), status.lost_records, status.late);
        News { lost, dropped, late_count, faults, events, late }
    }

    fn new_late(&self) -> Vec<Late> {
        let plan = self.monitor.plan();
        let late = self.subscription.tap.late().map(|judged| {
            let (cause, delay_ns) = (judged.cause, judged.lateness.ns());
            let tally = Tally { cause, count: 1, worst_ns: delay_ns, worst_cycle: judged.index };
            Late { cycle: judged.index, delay_ns, cause: Found::of(&tally, plan).to_string() }
        });
        late.collect()
    }
}

/// A part of the stream.
#[derive(Debug)]
pub enum Part {
    /// Records, in their order.
    Records(Vec<Record>),
    /// The news besides them.
    News(News),
}

/// The reader's side.
#[derive(Debug)]
pub struct Watched {
    stream: UnixStream,
    axes: usize,
    bytes: Vec<u8>,
}

impl Watched {
    /// Watches the master at `path`.
    pub fn open(path: &Path) -> Result<(About, Watched), AskError> {
        let foreign = || AskError::Foreign(path.to_owned());
        let conversation = Conversation::open(path)?;
        let about = conversation.ask(&json!({ "ask": "watch" }), PATIENCE)?;
        let about = serde_json::from_value(about).ok().filter(|about: &About| about.layout == LAYOUT);
        let about = about.ok_or_else(foreign)?;
        let stream = conversation.into_stream(&json!({ "ask": "records" }))?;
        let failed = |error| AskError::Io { path: path.to_owned(), error };
        let watched = Watched::new(stream, about.header.axes.len()).map_err(failed)?;
        Ok((about, watched))
    }

    fn new(stream: UnixStream, axes: usize) -> io::Result<Watched> {
        stream.set_read_timeout(Some(LOOK_EVERY))?;
        Ok(Watched { stream, axes, bytes: Vec::new() })
    }

    /// The next part; `None` if there is none yet. An error is the end.
    pub fn part(&mut self) -> io::Result<Option<Part>> {
        let mut piece = [0; 64 << 10];
        loop {
            if let Some(part) = self.take()? {
                return Ok(Some(part));
            }
            match self.stream.read(&mut piece) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(count) => self.bytes.extend_from_slice(&piece[..count]),
                Err(error)
                    if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) =>
                {
                    return Ok(None);
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// The first whole frame of what was read.
    fn take(&mut self) -> io::Result<Option<Part>> {
        let foreign = || io::Error::other("it does not send what this program reads: is it another version?");
        let Some(&[kind, a, b, c, d]) = self.bytes.first_chunk::<BEFORE>() else { return Ok(None) };
        let length = u32::from_le_bytes([a, b, c, d]) as usize;
        if length > LONGEST_FRAME {
            return Err(foreign());
        }
        let Some(frame) = self.bytes.get(BEFORE..BEFORE + length) else { return Ok(None) };
        let part = match kind {
            KIND_RECORDS if length.is_multiple_of(RECORD) => {
                let records = frame.chunks_exact(RECORD).map(|bytes| {
                    Record::load(bytes).filter(|record| record.axis().is_none_or(|axis| axis < self.axes))
                });
                records.collect::<Option<_>>().map(Part::Records)
            }
            KIND_NEWS => serde_json::from_slice(frame).ok().map(Part::News),
            _ => None,
        };
        self.bytes.drain(..BEFORE + length);
        part.map(Some).ok_or_else(foreign)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;
    use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord};

    fn frame(kind: u8, bytes: &[u8]) -> Vec<u8> {
        [&[kind][..], &(bytes.len() as u32).to_le_bytes(), bytes].concat()
    }

    fn watched() -> (UnixStream, Watched) {
        let (master, scope) = UnixStream::pair().unwrap();
        (master, Watched::new(scope, 2).unwrap())
    }

    fn records(records: &[Record]) -> Vec<u8> {
        records.iter().flat_map(Record::store).collect()
    }

    #[test]
    fn a_stream_is_read_however_it_is_cut_into_pieces() {
        let (mut master, mut scope) = watched();
        let sent = [
            Record::Drive(DriveRecord { index: 7, axis: 1, position: 2.5, ..DriveRecord::default() }),
            Record::Cycle(CycleRecord { index: 7, ..CycleRecord::default() }),
        ];
        let happened = Happened { cycle: 7, axis: 1, text: "state Fault".into(), fault: true };
        let news = News { lost: 3, events: vec![happened], ..News::default() };
        let whole =
            [frame(KIND_RECORDS, &records(&sent)), frame(KIND_NEWS, &serde_json::to_vec(&news).unwrap())]
                .concat();
        let mut parts = Vec::new();
        for piece in whole.chunks(50) {
            master.write_all(piece).unwrap();
            parts.extend(scope.part().unwrap());
        }
        let [Part::Records(taken), Part::News(read)] = &parts[..] else { panic!("{parts:?}") };
        assert_eq!((&taken[..], read), (&sent[..], &news));
        drop(master);
        assert_eq!(scope.part().unwrap_err().kind(), io::ErrorKind::UnexpectedEof);
    }

    #[test]
    fn a_stream_of_another_version_is_reported() {
        let of_third_axis = Record::Drive(DriveRecord { axis: 2, ..DriveRecord::default() });
        for bytes in [
            frame(b'x', b""),
            frame(KIND_RECORDS, &[1; RECORD - 1]),
            frame(KIND_RECORDS, &[0xff; RECORD]),
            frame(KIND_RECORDS, &records(&[of_third_axis])),
            frame(KIND_NEWS, b"{"),
            vec![KIND_RECORDS, 0xff, 0xff, 0xff, 0xff],
        ] {
            let (mut master, mut scope) = watched();
            master.write_all(&bytes).unwrap();
            let error = scope.part().unwrap_err().to_string();
            assert!(error.contains("another version"), "{error}: {bytes:?}");
        }
    }
}
