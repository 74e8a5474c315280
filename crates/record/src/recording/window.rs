//! A recording of what is newest: in memory, and written when something fails, on request, and at the end.

use std::collections::VecDeque;
use std::path::PathBuf;

use super::machine::Machine;
use super::newest::{AFTERMATH_NS, Due, Encoded, Newest, encode};
use crate::failures::Failures;
use crate::file::save;
use fieldbeat_core::cycle::record::Record;
use fieldbeat_telemetry::causes::Judged;
use fieldbeat_telemetry::sink::{Recorded, Sink};

/// It is written for so many failures; then only on request and at the end.
const MOST_FAILURES: usize = 8;

/// About the size of a message in a file.
const BYTES_OF_MESSAGE: u64 = 100;

/// The newest records of a machine.
#[derive(Debug)]
pub struct Window {
    path: PathBuf,
    newest: Newest,
    records: VecDeque<Record>,
    /// The length.
    cycles: u64,
    judged: VecDeque<Judged>,
    utc_ns: i64,
    files_of_failures: usize,
    /// Records lost so far, and how many of them were lost since which cycle, as far as they would be in it.
    lost: u64,
    gaps: VecDeque<(u64, u64)>,
    written: Vec<Recorded>,
    /// The failure that was not returned yet.
    failure: Option<String>,
}

impl Window {
    /// The newest `cycles` of `machine`, and as many as follow upon a failure, written to `path` at the end.
    pub fn new(path: PathBuf, machine: Machine, failures: Failures, cycles: u64) -> Window {
        let aftermath = AFTERMATH_NS / machine.period_ns.max(1);
        Window {
            path,
            newest: Newest::new(machine, failures, aftermath),
            records: VecDeque::new(),
            // A file of a failure is written after it, and has what led up to it all the same.
            cycles: cycles.saturating_add(aftermath),
            judged: VecDeque::new(),
            utc_ns: 0,
            files_of_failures: 0,
            lost: 0,
            gaps: VecDeque::new(),
            written: Vec::new(),
            failure: None,
        }
    }

    fn write(&mut self, path: PathBuf, due: &Due) {
        let mut recorded = Recorded::begin(path, due.why.clone());
        recorded.lost = self.gaps.iter().map(|(_, lost)| lost).sum();
        let (machine, records) = (due.described(self.newest.machine.clone()), self.records.iter());
        let encoded = encode(machine, self.utc_ns, records, self.judged.iter(), None, recorded.lost);
        let written = encoded.and_then(|Encoded { bytes, messages, lost }| {
            (recorded.messages, recorded.lost) = (messages, lost);
            save(&recorded.path, &bytes)?;
            recorded.bytes = bytes.len() as u64;
            Ok(())
        });
        if let Err(error) = written {
            recorded.error = Some(format!("{error}; free that disk, or name a file on another one"));
            self.failure = recorded.failure();
        }
        self.written.push(recorded);
    }

    /// Writes what is due by now, or what is due at all, next to the file of the end.
    fn write_due(&mut self, last: bool) {
        let Some(due) = self.newest.take_due(last) else { return };
        self.files_of_failures += usize::from(due.failed);
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy();
        let path = self.path.with_file_name(due.file_name(&stem));
        self.write(path, &due);
    }
}

impl Sink for Window {
    fn begin(&mut self, utc_ns: i64) {
        self.utc_ns = utc_ns;
    }

    fn enter(&mut self, record: &Record) {
        self.records.push_back(*record);
        self.newest.look(record, (self.files_of_failures < MOST_FAILURES).then_some(0));
        if matches!(record, Record::Cycle(_) | Record::Skipped(_)) {
            let oldest = self.newest.oldest(self.cycles);
            while self.records.front().is_some_and(|record| record.index() < oldest) {
                self.records.pop_front();
            }
            while self.judged.front().is_some_and(|judged| judged.index < oldest) {
                self.judged.pop_front();
            }
            while self.gaps.front().is_some_and(|(cycle, _)| *cycle < oldest) {
                self.gaps.pop_front();
            }
            self.write_due(false);
        }
    }

    fn late(&mut self, judged: &Judged) {
        self.judged.push_back(*judged);
    }

    fn request(&mut self) {
        self.newest.request(0);
        self.write_due(false);
    }

    fn look(&mut self, lost: u64) -> Option<String> {
        if let more @ 1.. = lost.saturating_sub(self.lost) {
            self.gaps.push_back((self.newest.cycle, more));
            self.lost = lost;
        }
        self.failure.take()
    }

    /// In two files, if a failure was the last thing to happen.
    fn holds(&self) -> u64 {
        self.records.len() as u64 * BYTES_OF_MESSAGE * if self.newest.has_due() { 2 } else { 1 }
    }

    fn finish(&mut self) -> Vec<Recorded> {
        self.write_due(true);
        let cycle = self.newest.cycle;
        let end = Due { why: "end of the run".to_owned(), cycle, from: cycle, failed: false };
        self.write(self.path.clone(), &end);
        std::mem::take(&mut self.written)
    }
}
