//! The black box: the last cycles, always in memory, written to a file when something fails.
//!
//! | file | what |
//! |---|---|
//! | `mod` | what is kept, and when it is written |
//! | `file` | what a file says, read |
//! | `list` | the files of a directory |
//! | `left` | what a program that was killed has left in memory |
//! | `events` | what led up to it, in words |
//!
//! The records stay in the memory in which the loop has written them, which outlives the program; the loop pays nothing
//! for that. A file is written by a thread of its own: a slow disk holds up nobody.

pub mod events;
pub mod file;
pub mod left;
pub mod list;

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crossbeam_channel::Receiver;

pub use self::file::header;
use self::left::{About, Orphan};
use crate::failures::Failures;
use crate::file::save;
use crate::recording::machine::{Machine, WRITTEN};
use crate::recording::newest::{AFTERMATH_NS, Due, Newest, encode};
use crate::recording::recent::RecentWire;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::cycle::ring::RecordReader;
use fieldbeat_core::rt::host;
use fieldbeat_core::time::nanos;
use fieldbeat_telemetry::log::LogBegin;
use fieldbeat_telemetry::thread::Keep;
pub use fieldbeat_telemetry::thread::Written;

/// A machine that fails again and again does not fill the disk: of the files that nobody requested the first ones stay,
/// where it began, and the newest.
const FIRST_FILES: usize = 8;
const NEWEST_FILES: usize = 8;

/// At the end a disk has so long for all files together.
const PATIENCE: Duration = Duration::from_secs(5);

/// How often it is looked whether they are written.
const LOOK_EVERY: Duration = Duration::from_millis(2);

/// The kept records.
#[derive(Debug)]
pub struct BlackBox {
    directory: PathBuf,
    newest: Newest,
    /// The bytes that passed the wires, if they are wanted.
    wire: Option<RecentWire>,
    /// Cycles that it holds.
    cycles: u64,
    /// Until when the newest file reaches.
    written_to: Option<u64>,
    files: usize,
    failures: usize,
    /// Files of failures that make room for newer ones.
    newest_files: VecDeque<PathBuf>,
    writing: Vec<Writing>,
    patience: Duration,
}

/// A file under way.
#[derive(Debug)]
struct Writing {
    written: Written,
    thread: JoinHandle<Option<String>>,
}

impl Writing {
    /// The result; a writer that has not ended by now is left to its disk.
    fn end(self, patience: Duration) -> Written {
        let Writing { mut written, thread } = self;
        written.error = match thread.is_finished().then(|| thread.join()) {
            Some(Ok(error)) => return Written { error, ..written },
            Some(Err(_)) => Some("its writer panicked; please report it".to_owned()),
            None => {
                let (path, seconds) = (written.path.display(), patience.as_secs_f64());
                Some(format!("{path}: its disk does not answer for {seconds} s"))
            }
        };
        written.fails_run = true;
        written
    }
}

impl BlackBox {
    /// A black box of `plan` whose files go to `directory`; `None` if the plan wants none.
    pub fn new(plan: &Plan, directory: &Path) -> Option<BlackBox> {
        if plan.black_box_records() == 0 {
            return None;
        }
        let (kept_ns, period_ns) = (plan.cycle.black_box_ns, plan.cycle.period_ns.max(1));
        let aftermath = AFTERMATH_NS.min(kept_ns / 2) / period_ns;
        let machine = Machine::of(plan, env!("CARGO_PKG_VERSION"));
        Some(BlackBox {
            directory: directory.to_owned(),
            newest: Newest::new(machine, Failures::of(plan), aftermath),
            wire: None,
            cycles: kept_ns / period_ns,
            written_to: None,
            files: 0,
            failures: 0,
            newest_files: VecDeque::with_capacity(NEWEST_FILES + 1),
            writing: Vec::new(),
            patience: PATIENCE,
        })
    }

    /// The files also have what has passed the wires, as far as it is in the log that comes from there.
    #[doc(hidden)]
    pub fn with_wire(self, log: Receiver<LogBegin>) -> BlackBox {
        let kept_ns = self.cycles * self.newest.machine.period_ns;
        BlackBox { wire: Some(RecentWire::new(log, kept_ns)), ..self }
    }

    fn start(&mut self, due: Due, ring: &RecordReader) {
        let now = SystemTime::now();
        let (path, written) = place(&self.directory, now, &due, None);
        let mut machine = due.described(self.newest.machine.clone());
        machine.about.insert(WRITTEN.to_owned(), written);
        self.files += 1;
        let mut written = Written { number: self.files, ..Written::begin(&due.why, due.cycle, path) };
        if due.failed {
            self.written_to = Some(self.newest.cycle);
            self.failures += 1;
            if self.failures > FIRST_FILES {
                self.newest_files.push_back(written.path.clone());
            }
            if self.newest_files.len() > NEWEST_FILES {
                written.replaced = self.newest_files.pop_front();
            }
        }
        let wire = self.wire.as_mut().and_then(|wire| {
            wire.take();
            wire.end()
        });
        let records = written_of(ring.kept().copied().collect(), ring.is_cut());
        let (path, replaced) = (written.path.clone(), written.replaced.clone());
        let write = move || {
            if let Some(spare) = &replaced {
                // Gone already is as good.
                let _ = std::fs::remove_file(spare);
            }
            let encoded =
                encode(machine, utc_ns(now, &records), records.iter(), std::iter::empty(), wire.as_ref(), 0);
            encoded.and_then(|file| save(&path, &file.bytes)).err().map(|error| error.to_string())
        };
        // Without a thread there is no file; the next failure tries again.
        self.files -= usize::from(!self.write_aside(written, write));
    }

    /// Writes a file on a thread of its own; `false`: there is none.
    fn write_aside(
        &mut self,
        written: Written,
        write: impl FnOnce() -> Option<String> + Send + 'static,
    ) -> bool {
        let thread = std::thread::Builder::new().name("fb-blackbox".into()).spawn(write).ok();
        let is_begun = thread.is_some();
        self.writing.extend(thread.map(|thread| Writing { written, thread }));
        is_begun
    }
}

/// Where the file of `due` goes that is written at this time, and the time as it stands in it.
fn place(directory: &Path, now: SystemTime, due: &Due, process: Option<u32>) -> (PathBuf, String) {
    let stamp = humantime::format_rfc3339_seconds(now).to_string();
    let process = process.map_or(String::new(), |process| format!("{}{process}", left::PROCESS));
    let name = due.file_name(&format!("fieldbeat-{}{process}", stamp.replace([':', '-'], "")));
    (directory.join(name), stamp)
}

/// Those of a black box that are written. Where they are cut, a whole cycle is the first.
fn written_of(mut records: Vec<Record>, is_cut: bool) -> Vec<Record> {
    if let Some(oldest) = records.first().map(Record::index).filter(|_| is_cut) {
        records.drain(..records.iter().take_while(|record| record.index() == oldest).count());
    }
    records.retain(|record| !matches!(record, Record::Native(_)));
    records
}

/// How much earlier than UTC the clock of the records is, which were taken down until now.
fn utc_ns(now: SystemTime, records: &[Record]) -> i64 {
    let newest = records.iter().rev().find_map(|record| match record {
        Record::Cycle(cycle) => Some(cycle.grid.0),
        _ => None,
    });
    let now = now.duration_since(UNIX_EPOCH).map_or(0, nanos);
    (now as i64).wrapping_sub(newest.unwrap_or(0) as i64)
}

impl Keep for BlackBox {
    fn about(&self) -> Vec<u8> {
        About::new(&self.directory, &self.newest.machine).to_bytes()
    }

    fn recover(&mut self) {
        for orphan in Orphan::all(&self.directory) {
            let written = Written::begin(&orphan.due().why, orphan.due().cycle, orphan.path());
            self.write_aside(written, || orphan.save().err().map(|error| error.to_string()));
        }
    }

    fn enter(&mut self, record: &Record, ring: &RecordReader) {
        // Not before the newest file's end has left it: what follows closely upon a failure is in one file with it.
        self.newest.look(record, Some(self.written_to.map_or(0, |to| to + self.cycles)));
        // At once: when the telemetry is late, the failure itself would leave the ring before it is written.
        if let Some(due) = self.newest.take_due(false) {
            self.start(due, ring);
        }
    }

    fn request(&mut self) {
        self.newest.request(self.newest.aftermath);
    }

    fn conclude(&mut self, why: &str) {
        if self.failures == 0 {
            let cycle = self.newest.cycle;
            self.newest.is_due(Due { why: why.to_owned(), cycle, from: cycle, failed: true });
        }
    }

    fn write(&mut self, last: bool, ring: &RecordReader) -> Vec<Written> {
        self.wire.iter_mut().for_each(RecentWire::take);
        if last && let Some(due) = self.newest.take_due(true) {
            self.start(due, ring);
        }
        let begun = Instant::now();
        let is_under_way = |writing: &Writing| !writing.thread.is_finished();
        while last && begun.elapsed() < self.patience && self.writing.iter().any(is_under_way) {
            std::thread::sleep(LOOK_EVERY);
        }
        let (done, writing) = std::mem::take(&mut self.writing)
            .into_iter()
            .partition(|writing| last || writing.thread.is_finished());
        self.writing = writing;
        let done: Vec<Writing> = done;
        done.into_iter().map(|writing| writing.end(self.patience)).collect()
    }
}

/// Where the files go if nobody says otherwise: the state directory of the service, or that of the user.
pub fn default_directory() -> PathBuf {
    host::state_directory()
}

#[cfg(test)]
mod tests;
