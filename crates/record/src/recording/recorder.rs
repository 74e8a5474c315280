//! What records a machine, and where to.

use std::fs::OpenOptions;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crossbeam_channel::Receiver;
use tempfile::{NamedTempFile, TempPath};
use thiserror::Error;

use super::machine::Machine;
use super::whole::Whole;
use super::window::Window;
use crate::failures::Failures;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::time::nanos;
use fieldbeat_telemetry::log::LogBegin;
use fieldbeat_telemetry::sink::Sink;

/// The version of this library.
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// A recording of a machine: `Setup::with_recorder`.
#[derive(Debug)]
pub struct Recorder {
    path: PathBuf,
    /// Of a recording of the whole run; removed again if that does not start.
    file: Option<NamedTempFile>,
    window: Option<Duration>,
    /// With the log of the loop.
    wire: bool,
    /// The drives whose native process data it has.
    native: Vec<String>,
    /// The version of the program.
    version: String,
}

/// Why nothing can be recorded there. The message ends with the remedy.
#[derive(Error)]
#[non_exhaustive]
pub enum RecordError {
    /// The file is there already.
    #[error("{0} exists already: name another file for the recording, or remove this one")]
    Exists(PathBuf),
    /// The operating system refuses.
    #[error("cannot record to {path}: {why}; name a file in a directory that this user may write to")]
    Refused {
        /// The file.
        path: PathBuf,
        /// The reason.
        why: io::Error,
    },
    /// A replay begins at the start of a run.
    #[error(
        "a window of the run has no wire, since a replay begins at its start: leave out --record-window, or \
         --record-wire"
    )]
    WireOfWindow,
}
fieldbeat_core::debug_as_display!(RecordError);

impl RecordError {
    fn new(path: &Path, why: io::Error) -> RecordError {
        match why.kind() {
            io::ErrorKind::AlreadyExists => RecordError::Exists(path.to_owned()),
            _ => RecordError::Refused { path: path.to_owned(), why },
        }
    }
}

impl Recorder {
    /// A recording of the whole run. The file is made now, must not be there yet, and is removed again if the run does
    /// not start.
    pub fn create(path: impl Into<PathBuf>) -> Result<Recorder, RecordError> {
        let path = path.into();
        let file = OpenOptions::new().write(true).create_new(true).open(&path);
        let file = file.and_then(|file| Ok(NamedTempFile::from_parts(file, TempPath::try_from_path(&path)?)));
        let file = file.map_err(|why| RecordError::new(&path, why))?;
        Ok(Recorder {
            path,
            file: Some(file),
            window: None,
            wire: false,
            native: Vec::new(),
            version: VERSION.to_owned(),
        })
    }

    /// A recording of what is newest, in memory: as long as `window` before the end of the run, before a failure
    /// (as of the black box: a lost drive, a fault, a stop), or before a
    /// [request](fieldbeat_telemetry::Monitor::write_black_box). The 200 ms that follow upon a failure are kept
    /// besides. Files of failures have the cycle in their name, and there are at most 8 of them. Each record takes 72
    /// bytes.
    pub fn window(path: impl Into<PathBuf>, window: Duration) -> Result<Recorder, RecordError> {
        let path = path.into();
        // What fails at the end would be lost: this is tried now.
        let made = OpenOptions::new().write(true).create_new(true).open(&path);
        made.and_then(|_| std::fs::remove_file(&path)).map_err(|why| RecordError::new(&path, why))?;
        Ok(Recorder {
            path,
            file: None,
            window: Some(window),
            wire: false,
            native: Vec::new(),
            version: VERSION.to_owned(),
        })
    }

    /// Records the wire, too: all that the loop takes from outside and all that it sends, so that
    /// `Replay` can repeat the run. [`Recorded::wire`](fieldbeat_telemetry::Recorded::wire) says
    /// what became of it.
    pub fn with_wire(mut self) -> Result<Recorder, RecordError> {
        if self.window.is_some() {
            return Err(RecordError::WireOfWindow);
        }
        self.wire = true;
        Ok(self)
    }

    /// Also the native process data of these drives, by name, as they were received and sent: in topics of their own.
    /// `"all"` stands for each drive. A name that is none of a drive is an error of the start.
    pub fn with_native(mut self, drives: impl IntoIterator<Item = impl Into<String>>) -> Recorder {
        self.native.extend(drives.into_iter().map(Into::into));
        self
    }

    /// The version of the program that records, as the recording names it; without it, that of this library.
    pub fn with_version(mut self, version: impl Into<String>) -> Recorder {
        self.version = version.into();
        self
    }

    /// Where it records to.
    #[doc(hidden)]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The drives whose native process data it has, by name.
    #[doc(hidden)]
    pub fn native(&self) -> &[String] {
        &self.native
    }

    /// Whether it needs the log of the loop.
    #[doc(hidden)]
    pub fn has_wire(&self) -> bool {
        self.wire
    }

    /// The recorder of the machine of `plan`, and of its log as it comes from `log`.
    #[doc(hidden)]
    pub fn sink(self, plan: &Plan, log: Option<Receiver<LogBegin>>) -> Box<dyn Sink> {
        let machine = Machine::of(plan, &self.version);
        match (self.file, self.window) {
            (Some(file), _) => Box::new(Whole::new(file, self.path, machine, log)),
            (None, window) => {
                let cycles = nanos(window.unwrap_or_default()) / plan.cycle.period_ns.max(1);
                Box::new(Window::new(self.path, machine, Failures::of(plan), cycles))
            }
        }
    }
}
