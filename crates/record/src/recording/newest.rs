//! When the newest records of a machine are to be written: when something fails, or on request.

use std::io;

use super::machine::{CYCLE, Machine, WHY};
use super::recent::WireEnd;
use super::writer::Writer;
use crate::failures::Failures;
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::time::MS;
use fieldbeat_telemetry::causes::Judged;

/// The time after a failure that is in its file: how the stop went.
pub const AFTERMATH_NS: u64 = 200 * MS;

/// The newest records of a machine.
#[derive(Debug)]
pub struct Newest {
    /// The newest cycle, executed or skipped.
    pub cycle: u64,
    /// The newest one that was executed.
    executed: Option<u64>,
    /// The machine.
    pub machine: Machine,
    /// Cycles that follow upon a failure.
    pub aftermath: u64,
    failures: Failures,
    due: Option<Due>,
}

/// Why and when they are to be written.
#[derive(Clone, Debug)]
pub struct Due {
    /// Why.
    pub why: String,
    /// The cycle in which that happened.
    pub cycle: u64,
    /// Once this cycle has come.
    pub from: u64,
    /// Something failed; otherwise the file was requested.
    pub failed: bool,
}

/// A file as it is to be written.
#[derive(Debug)]
pub struct Encoded {
    /// All of it.
    pub bytes: Vec<u8>,
    /// The messages.
    pub messages: u64,
    /// Records that are missing in it.
    pub lost: u64,
}

impl Newest {
    /// Of `machine`, with so many cycles of what follows upon one of its `failures`; none yet.
    pub fn new(machine: Machine, failures: Failures, aftermath: u64) -> Newest {
        Newest { cycle: 0, executed: None, machine, failures, aftermath, due: None }
    }

    /// Looks at a record. A failure in it is written with what follows, not before cycle `earliest`; `None`: no more.
    pub fn look(&mut self, record: &Record, earliest: Option<u64>) {
        match record {
            Record::Drive(drive) => {
                if let (Some(why), Some(earliest)) = (self.failures.see(drive), earliest) {
                    let (cycle, from) = (drive.index, (drive.index + self.aftermath).max(earliest));
                    self.is_due(Due { why, cycle, from, failed: true });
                }
            }
            Record::Cycle(of) => (self.cycle, self.executed) = (of.index, Some(of.index)),
            Record::Skipped(of) => self.cycle = of.first,
            Record::Monitor(_) | Record::Reference(_) | Record::Command(_) => {}
            Record::Event(_) | Record::Native(_) => {}
        }
    }

    /// A file is requested, though nothing failed, with so many cycles of what follows.
    pub fn request(&mut self, cycles: u64) {
        let (cycle, from) = (self.cycle, self.cycle + cycles);
        self.is_due(Due { why: "requested".to_owned(), cycle, from, failed: false });
    }

    /// The first failure is the reason that is written; a request does not delay it.
    pub fn is_due(&mut self, due: Due) {
        if self.due.as_ref().is_none_or(|known| due.failed && !known.failed) {
            self.due = Some(due);
        }
    }

    /// The records to be written by now; all of them, if there is nothing more to wait for. A file without an executed
    /// cycle says nothing: one that is due before the first of them waits for that.
    pub fn take_due(&mut self, last: bool) -> Option<Due> {
        let executed = self.executed.is_some();
        self.due.take_if(|due| last || executed && self.cycle >= due.from)
    }

    /// The first of the newest so many cycles, among which an executed one is.
    pub fn oldest(&self, cycles: u64) -> u64 {
        self.cycle.saturating_sub(cycles).min(self.executed.unwrap_or(0))
    }

    /// Whether something is to be written, now or later.
    pub fn has_due(&self) -> bool {
        self.due.is_some()
    }
}

impl Due {
    /// The machine as its file describes it.
    pub fn described(&self, mut machine: Machine) -> Machine {
        let why = [(WHY, self.why.clone()), (CYCLE, self.cycle.to_string())];
        machine.about.extend(why.map(|(key, value)| (key.to_owned(), value)));
        machine
    }

    /// The name of its file, which begins with `stem`.
    pub fn file_name(&self, stem: &str) -> String {
        format!("{stem}-cycle-{}.mcap", self.cycle)
    }
}

/// The file of a machine whose clock is so much earlier than UTC, with what passed its wires, if that is known. Records
/// that are `lost` are missing in it.
pub fn encode<'a>(
    mut machine: Machine,
    utc_ns: i64,
    mut records: impl Iterator<Item = &'a Record> + Clone,
    mut judged: impl Iterator<Item = &'a Judged>,
    wire: Option<&WireEnd>,
    lost: u64,
) -> io::Result<Encoded> {
    records.clone().for_each(|record| machine.name_fault(record));
    let mut writer = Writer::new(Vec::new(), machine, utc_ns)?;
    wire.map_or(Ok(()), |wire| writer.put_wire(wire))?;
    records.try_for_each(|record| writer.enter(record))?;
    judged.try_for_each(|judged| writer.late(judged))?;
    let lost = lost + wire.map_or(0, |wire| wire.lost);
    let (messages, lost) = (writer.written().messages, lost + writer.dropped());
    Ok(Encoded { bytes: writer.finish(lost)?, messages, lost })
}
