//! A recording of what is newest: in memory, and written when something fails, on request, and at the end.

use std::collections::VecDeque;
use std::path::PathBuf;

use super::machine::Machine;
use super::writer::Writer;
use crate::failures::Failures;
use crate::file::save;
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::time::MS;
use fieldbeat_telemetry::causes::Judged;
use fieldbeat_telemetry::sink::{Recorded, Sink};

/// It is written for so many failures; then only on request and at the end.
const MOST_FAILURES: usize = 8;

/// So much of what follows upon a failure is in its file: how the stop went.
const AFTERMATH_NS: u64 = 200 * MS;

/// About the size of a message in a file.
const BYTES_OF_MESSAGE: u64 = 100;

/// The newest records of a machine.
#[derive(Debug)]
pub struct Window {
    path: PathBuf,
    machine: Machine,
    failures: Failures,
    /// Its length.
    cycles: u64,
    records: VecDeque<Record>,
    judged: VecDeque<Judged>,
    utc_ns: i64,
    /// The newest cycle.
    newest: u64,
    /// Why and in which cycle it is to be written, and once which cycle has come.
    due: Option<(String, u64, u64)>,
    files_of_failures: usize,
    /// Records lost so far, and how many of them were lost since which cycle, as far as they would be in it.
    lost: u64,
    gaps: VecDeque<(u64, u64)>,
    written: Vec<Recorded>,
    /// What was not returned yet.
    failure: Option<String>,
}

impl Window {
    /// The newest `cycles` of `machine`, and as many as follow upon a failure, written to `path` at the end.
    pub fn new(path: PathBuf, machine: Machine, failures: Failures, cycles: u64) -> Window {
        // A file of a failure is written after it, and has what led up to it all the same.
        let cycles = cycles.saturating_add(AFTERMATH_NS / machine.period_ns.max(1));
        Window {
            path,
            machine,
            failures,
            cycles,
            records: VecDeque::new(),
            judged: VecDeque::new(),
            utc_ns: 0,
            newest: 0,
            due: None,
            files_of_failures: 0,
            lost: 0,
            gaps: VecDeque::new(),
            written: Vec::new(),
            failure: None,
        }
    }

    /// The file of a cycle, next to that of the end.
    fn path_of(&self, cycle: u64) -> PathBuf {
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy();
        self.path.with_file_name(format!("{stem}-cycle-{cycle}.mcap"))
    }

    fn write(&mut self, path: PathBuf, why: String) {
        let lost = self.gaps.iter().map(|(_, lost)| lost).sum();
        let mut recorded = Recorded::begin(path, why);
        recorded.lost = lost;
        let bytes = Writer::new(Vec::new(), self.machine.clone(), self.utc_ns).and_then(|mut writer| {
            self.records.iter().try_for_each(|record| writer.enter(record))?;
            self.judged.iter().try_for_each(|judged| writer.late(judged))?;
            recorded.messages = writer.written().messages;
            recorded.lost += writer.dropped();
            writer.finish(recorded.lost)
        });
        match bytes.and_then(|bytes| save(&recorded.path, &bytes).map(|()| bytes.len())) {
            Ok(bytes) => recorded.bytes = bytes as u64,
            Err(error) => {
                recorded.error = Some(format!("{error}; free that disk, or name a file on another one"));
                self.failure = recorded.failure();
            }
        }
        self.written.push(recorded);
    }

    fn write_if_due(&mut self) {
        let Some((why, cycle, _)) = self.due.take_if(|(.., from)| self.newest >= *from) else { return };
        let path = self.path_of(cycle);
        self.write(path, why);
    }
}

impl Sink for Window {
    fn begin(&mut self, utc_ns: i64) {
        self.utc_ns = utc_ns;
    }

    fn enter(&mut self, record: &Record) {
        if let Record::Drive(drive) = record
            && let Some(why) = self.failures.see(drive)
            && self.due.is_none()
            && self.files_of_failures < MOST_FAILURES
        {
            self.files_of_failures += 1;
            let aftermath = AFTERMATH_NS / self.machine.period_ns.max(1);
            self.due = Some((why, drive.index, drive.index + aftermath));
        }
        self.records.push_back(*record);
        if matches!(record, Record::Cycle(_) | Record::Skipped(_)) {
            self.newest = record.index();
            let oldest = self.newest.saturating_sub(self.cycles);
            while self.records.front().is_some_and(|record| record.index() < oldest) {
                self.records.pop_front();
            }
            while self.judged.front().is_some_and(|judged| judged.index < oldest) {
                self.judged.pop_front();
            }
            while self.gaps.front().is_some_and(|(cycle, _)| *cycle < oldest) {
                self.gaps.pop_front();
            }
            self.write_if_due();
        }
    }

    fn late(&mut self, judged: &Judged) {
        self.judged.push_back(*judged);
    }

    fn request(&mut self) {
        self.due.get_or_insert(("requested".to_owned(), self.newest, self.newest));
        self.write_if_due();
    }

    fn look(&mut self, lost: u64) -> Option<String> {
        if let more @ 1.. = lost.saturating_sub(self.lost) {
            self.gaps.push_back((self.newest, more));
            self.lost = lost;
        }
        self.failure.take()
    }

    /// In two files, if a failure was the last thing to happen.
    fn holds(&self) -> u64 {
        self.records.len() as u64 * BYTES_OF_MESSAGE * if self.due.is_some() { 2 } else { 1 }
    }

    fn finish(&mut self) -> Vec<Recorded> {
        if let Some((why, cycle, _)) = self.due.take() {
            let path = self.path_of(cycle);
            self.write(path, why);
        }
        self.write(self.path.clone(), "end of the run".to_owned());
        std::mem::take(&mut self.written)
    }
}
