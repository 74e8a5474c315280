//! A recording of the whole run.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

use crossbeam_channel::Receiver;
use tempfile::NamedTempFile;

use super::machine::Machine;
use super::writer::{Writer, Written};
use fieldbeat_core::cycle::record::Record;
use fieldbeat_telemetry::causes::Judged;
use fieldbeat_telemetry::log::LogBegin;
use fieldbeat_telemetry::sink::{Recorded, Sink, WireSummary};

/// The file and how far it is.
#[derive(Debug)]
pub struct Whole {
    /// Until it is begun.
    begin: Option<Begin>,
    /// Until it has failed.
    writer: Option<Writer<BufWriter<Counted>>>,
    recorded: Recorded,
    /// Records and causes since the last messages that are in the file for sure.
    unsure: u64,
    /// Those that are not in the file: they were on the way when it failed, or came after that.
    late: u64,
    /// The failure that was not returned yet.
    failure: Option<String>,
}

/// The requirements to begin.
#[derive(Debug)]
struct Begin {
    /// Removed again if the run does not start.
    file: NamedTempFile,
    machine: Machine,
    /// The log of the loop comes from here, if it is recorded, too.
    log: Option<Receiver<LogBegin>>,
}

/// A file, and how many bytes were written to it.
#[derive(Debug)]
struct Counted {
    file: File,
    bytes: u64,
}

impl Write for Counted {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write(bytes)?;
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Whole {
    /// A recording of `machine` in `file`, which is at `path`; with the log of its loop, if that comes from `log`.
    pub fn new(
        file: NamedTempFile,
        path: PathBuf,
        machine: Machine,
        log: Option<Receiver<LogBegin>>,
    ) -> Whole {
        let mut recorded = Recorded::begin(path, "whole run".to_owned());
        recorded.wire = log.is_some().then(WireSummary::default);
        Whole {
            begin: Some(Begin { file, machine, log }),
            writer: None,
            recorded,
            unsure: 0,
            late: 0,
            failure: None,
        }
    }

    /// Writes, unless it has failed before.
    fn with(&mut self, write: impl FnOnce(&mut Writer<BufWriter<Counted>>) -> io::Result<()>) {
        let Some(writer) = &mut self.writer else { return };
        let before = writer.flushed();
        match write(writer) {
            Ok(()) => {
                let (written, flushed) = (writer.written(), writer.flushed());
                if flushed != before {
                    self.unsure = 0;
                }
                self.holds(written);
            }
            Err(error) => {
                self.holds(before);
                self.fail(&error);
            }
        }
    }

    /// The file has so much.
    fn holds(&mut self, written: Written) {
        self.recorded.messages = written.messages;
        if let Some(wire) = &mut self.recorded.wire {
            wire.bytes = written.wire_bytes;
        }
    }

    fn fail(&mut self, error: &io::Error) {
        self.writer = None;
        self.late += std::mem::take(&mut self.unsure);
        self.is_incomplete(format!("{error}; free that disk, or name a file on another one"));
    }

    fn is_incomplete(&mut self, why: String) {
        self.recorded.error = Some(why);
        self.failure = self.recorded.failure();
    }

    /// The log of the loop may have ended before the run.
    fn find_cut(&mut self) {
        let cut_at = self.writer.as_ref().and_then(Writer::cut_at);
        if let (Some(wire), Some(cycle)) = (&mut self.recorded.wire, cut_at)
            && wire.cut_at.is_none()
        {
            wire.cut_at = cut_at;
            self.is_incomplete(format!(
                "a replay ends before cycle {cycle}, since its disk or this host was too slow for the wire; \
                 record to another disk, or with a longer period"
            ));
        }
    }
}

impl Sink for Whole {
    fn begin(&mut self, utc_ns: i64) {
        let Some(Begin { file, machine, log }) = self.begin.take() else { return };
        let log = log.and_then(|log| log.try_recv().ok());
        let writer = file.keep().map_err(io::Error::from).and_then(|(file, _)| {
            Writer::with_log(BufWriter::new(Counted { file, bytes: 0 }), machine, utc_ns, log)
        });
        match writer {
            Ok(writer) => self.writer = Some(writer),
            Err(error) => self.fail(&error),
        }
    }

    fn enter(&mut self, record: &Record) {
        match self.writer {
            Some(_) => self.unsure += 1,
            None => self.late += 1,
        }
        self.with(|writer| writer.enter(record));
    }

    fn late(&mut self, judged: &Judged) {
        self.unsure += u64::from(self.writer.is_some());
        self.with(|writer| writer.late(judged));
    }

    /// It is written all the time.
    fn request(&mut self) {}

    fn look(&mut self, lost: u64) -> Option<String> {
        if std::mem::replace(&mut self.recorded.lost, lost) == 0 && lost > 0 {
            self.failure = self.recorded.failure();
        }
        self.with(Writer::take_log);
        self.find_cut();
        self.failure.take()
    }

    /// The end of the file: all else is written all the time.
    fn holds(&self) -> u64 {
        self.writer.as_ref().map_or(0, Writer::summary)
    }

    fn finish(&mut self) -> Vec<Recorded> {
        self.with(Writer::end_log);
        if let Some(writer) = self.writer.take() {
            let flushed = writer.flushed();
            self.recorded.lost += writer.dropped();
            let out = writer.finish(self.recorded.lost);
            match out.and_then(|out| out.into_inner().map_err(io::IntoInnerError::into_error)) {
                Ok(counted) => {
                    self.recorded.bytes = counted.bytes;
                    if counted.file.metadata().is_ok_and(|facts| facts.nlink() == 0) {
                        self.is_incomplete(
                            "somebody removed it while it was written; record again".to_owned(),
                        );
                    }
                }
                Err(error) => {
                    self.holds(flushed);
                    self.fail(&error);
                }
            }
        }
        self.recorded.lost += self.late;
        if self.recorded.error.is_some() {
            self.recorded.bytes = std::fs::metadata(&self.recorded.path).map_or(0, |facts| facts.len());
        }
        vec![self.recorded.clone()]
    }
}

/// A simulation that is dropped has recorded all the same.
impl Drop for Whole {
    fn drop(&mut self) {
        if self.writer.is_some() {
            self.finish();
        }
    }
}
