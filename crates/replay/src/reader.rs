//! Reads the log of a recorded run from its file, piece by piece.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use mcap::records::Record;

use super::machine::{Replay, TaskOf};
use fieldbeat_config as config;
use fieldbeat_core::bus::{Cycle, OpenError};
use fieldbeat_core::cycle::task::Axes;
use fieldbeat_core::cycle::{Plan, PlanErrors, REVISION};
use fieldbeat_core::inputs::replaying::{Entries, Source};
use fieldbeat_record::log::layout::{BEGIN, Begin, CUT_AT, END, LAYOUT, TOPIC, words};
use fieldbeat_record::log::records::Records;
use fieldbeat_telemetry::log::MachineOf;

/// Why a recorded run cannot be repeated.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum ReplayError {
    /// The file cannot be read.
    #[error("cannot read {path}: {why}; name a recording of a run with --record-wire")]
    Read {
        /// The file.
        path: String,
        /// The reason.
        why: std::io::Error,
    },
    /// The file has no log of the loop.
    #[error("{path} has no wire to repeat{why}; record the run with --record FILE --record-wire")]
    NoWire {
        /// The file.
        path: String,
        /// Why not.
        why: String,
    },
    /// The file has the end of the log only.
    #[error(
        "{path} has the wire of the last seconds of a run, and a replay begins at its start: record the run with \
         --record FILE --record-wire; `fieldbeat export --pcapng` shows what is there"
    )]
    Window {
        /// The file.
        path: String,
    },
    /// A program with another loop has written it.
    #[error(
        "{path} was recorded by version {version}, whose loop has revision {revision} (layout {layout}): \
         repeat it with that one, this is version {} with revision {REVISION} (layout {LAYOUT})",
        env!("CARGO_PKG_VERSION")
    )]
    Revision {
        /// The file.
        path: String,
        /// The version that wrote it.
        version: String,
        /// The revision of its loop.
        revision: u32,
        /// The layout of its log.
        layout: String,
    },
    /// The configuration is none for this version.
    #[error("{path}: the configuration in it is not one of this version: {why}")]
    Configuration {
        /// The file.
        path: String,
        /// The first mistake in it.
        why: String,
    },
    /// The machine was built by a program of its own.
    #[error(
        "{path} is of a machine that was built in code: repeat it in a test of that program, with its plan"
    )]
    Code {
        /// The file.
        path: String,
    },
    /// The plan contradicts itself.
    #[error(transparent)]
    Plan(#[from] PlanErrors),
    /// A bus cannot be built.
    #[error(transparent)]
    Open(#[from] OpenError),
}
fieldbeat_core::debug_as_display!(ReplayError);

/// How the log of a file ends.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum LogEnd {
    /// It is still being read.
    #[default]
    Unknown,
    /// In order.
    Whole,
    /// There was no room for this cycle and those behind it.
    CutAt(u64),
    /// The file ends before the log does, or is broken: what is before that can be repeated.
    Broken(String),
}

/// A recorded run, from its file.
///
/// [`Replay::open`] is the short way for a test.
pub struct Recorded {
    path: String,
    log: Log,
    begin: Begin,
    plan: Option<Plan>,
    task: Option<fieldbeat_core::cycle::task::Task>,
    end: SharedEnd,
}

impl std::fmt::Debug for Recorded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recorded")
            .field("path", &self.path)
            .field("begin", &self.begin)
            .finish_non_exhaustive()
    }
}

/// How the log ends, as far as it was read.
#[derive(Clone, Debug, Default)]
pub(super) struct SharedEnd(Arc<Mutex<LogEnd>>);

impl SharedEnd {
    pub(super) fn get(&self) -> LogEnd {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set(&self, end: LogEnd) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = end;
    }
}

impl Recorded {
    /// Opens the file at `path`.
    pub fn open(path: impl AsRef<Path>) -> Result<Recorded, ReplayError> {
        let (path, name) = (path.as_ref(), path.as_ref().display().to_string());
        let file = File::open(path).and_then(|file| match file.metadata()?.is_dir() {
            true => Err(std::io::ErrorKind::IsADirectory.into()),
            false => Ok(file),
        });
        let file = file.map_err(|why| ReplayError::Read { path: name.clone(), why })?;
        let mut log = Log::new(file);
        let begin = loop {
            match log.next() {
                Ok(Some(Piece::Begin(begin))) => break begin,
                Ok(Some(Piece::Words(_) | Piece::End(_))) => {}
                Ok(Some(Piece::Others) | None) => {
                    return Err(ReplayError::NoWire { path: name, why: String::new() });
                }
                Err(why) => return Err(ReplayError::NoWire { path: name, why: format!(": {why}") }),
            }
        };
        Ok(Recorded { path: name, log, begin, plan: None, task: None, end: SharedEnd::default() })
    }

    /// The version of the program that recorded it.
    pub fn version(&self) -> &str {
        &self.begin.version
    }

    /// The revision of the loop that recorded it.
    pub fn revision(&self) -> u32 {
        self.begin.revision
    }

    /// Refuses a record of another revision of the loop, which does something else.
    pub fn require_revision(self) -> Result<Recorded, ReplayError> {
        match self.begin.revision == REVISION {
            true => Ok(self),
            false => Err(self.of_another_revision()),
        }
    }

    fn of_another_revision(&self) -> ReplayError {
        let Begin { version, revision, layout, .. } = self.begin.clone();
        ReplayError::Revision { path: self.path.clone(), version, revision, layout }
    }

    /// The plan of the machine, in place of its configuration: for a machine that was built in code.
    pub fn with_plan(mut self, plan: Plan) -> Recorded {
        self.plan = Some(plan);
        self
    }

    /// Runs the code of the in-loop task, whose calls are compared. Without it the recorded calls are made again.
    pub fn with_task(mut self, task: impl FnMut(&Cycle, &mut Axes<'_>) + Send + 'static) -> Recorded {
        self.task = Some(Box::new(task));
        self
    }

    /// The plan of the machine, once.
    fn plan(&mut self) -> Result<Plan, ReplayError> {
        if self.begin.layout != LAYOUT {
            return Err(self.of_another_revision());
        }
        let path = || self.path.clone();
        let plan = match (self.plan.take(), &self.begin.machine) {
            (Some(plan), _) => plan,
            (None, MachineOf::Code) => return Err(ReplayError::Code { path: path() }),
            (None, machine) => {
                let read = match machine {
                    MachineOf::Demo { drives, period_ns, place } => {
                        config::demo::demo_plan(*drives, *period_ns, *place)
                    }
                    MachineOf::Configuration { file, text } => config::parse(text, file),
                    MachineOf::Code => return Err(ReplayError::Code { path: path() }),
                };
                let first = |text: String| text.lines().next().unwrap_or_default().to_owned();
                match read {
                    Ok(read) => read.plan,
                    Err(why) => {
                        return Err(ReplayError::Configuration { path: path(), why: first(why.to_string()) });
                    }
                }
            }
        };
        plan.check()?;
        Ok(plan)
    }

    /// The machine that repeats it.
    pub fn replay(mut self) -> Result<Replay, ReplayError> {
        if !self.begin.is_whole {
            return Err(ReplayError::Window { path: self.path });
        }
        let plan = self.plan()?;
        let Recorded { log, begin, task, end, .. } = self;
        let other_plan = begin.plan.and_then(|recorded| other(&recorded, &plan.resolved()));
        let task = match (task, begin.has_task) {
            (Some(task), _) => TaskOf::Code(task),
            (None, true) => TaskOf::Log,
            (None, false) => TaskOf::Nobody,
        };
        Ok(Replay::over(plan, log.source(end.clone()), task)?.of_file(end, other_plan))
    }

    /// The plan of the machine and what was logged, without a repetition; and how the log ends, once all of it was
    /// read.
    #[doc(hidden)]
    pub fn entries(mut self) -> Result<(Plan, Entries, impl Fn() -> LogEnd), ReplayError> {
        let plan = self.plan()?;
        let Recorded { log, end, .. } = self;
        Ok((plan, Entries::new(log.source(end.clone())), move || end.get()))
    }
}

/// The first value in which two resolved plans differ, with what it is inside of and the one that is recorded.
fn other(recorded: &str, here: &str) -> Option<String> {
    let (mut old, mut new) = (recorded.lines(), here.lines());
    // Each with its indentation, and named as soon as that is known.
    let mut inside: Vec<(usize, String)> = Vec::new();
    loop {
        let (old, new) = match (old.next(), new.next()) {
            (None, None) => return None,
            (old, new) => (old.unwrap_or("nothing more"), new.unwrap_or("nothing more")),
        };
        let indent = old.len() - old.trim_start().len();
        inside.retain(|(outer, _)| *outer < indent);
        let value = old.trim().trim_end_matches(',');
        if old != new {
            let [old, new] =
                [value, new.trim().trim_end_matches(',')].map(|value| value.escape_debug().to_string());
            let names = inside.iter().map(|(_, name)| name.as_str()).filter(|name| !name.is_empty());
            let place = names.collect::<Vec<_>>().join(", ");
            return Some(
                format!("{place}: recorded `{old}`, here `{new}`").trim_start_matches(": ").to_owned(),
            );
        }
        if let Some(name) = value.strip_prefix("name: ") {
            // A drive has the name of its axis.
            inside.iter_mut().rev().filter(|(_, of)| !of.is_empty()).take(2).for_each(|(_, of)| {
                if !of.contains('"') {
                    *of = format!("{of} {name}");
                }
            });
        }
        inside
            .push((indent, value.trim_end_matches(['{', '[', '(']).trim_end_matches([' ', ':']).to_owned()));
    }
}

/// The parts of the log in the file.
enum Piece {
    Begin(Begin),
    Words(Vec<u64>),
    End(LogEnd),
    /// Messages of others, of a file without a log.
    Others,
}

/// The log of a file, piece by piece.
struct Log {
    records: Records<BufReader<File>>,
    has_begun: bool,
    channel: Option<u16>,
    /// The number of its newest message: they count from 1.
    sequence: u32,
}

impl Log {
    fn new(file: File) -> Log {
        let records = Records::new(BufReader::new(file));
        Log { records, has_begun: false, channel: None, sequence: 0 }
    }

    /// The words. How it ends is in `end` afterwards.
    fn source(mut self, end: SharedEnd) -> Source {
        Box::new(move || {
            loop {
                match self.next() {
                    Ok(Some(Piece::Words(words))) => return Some(words),
                    Ok(Some(Piece::End(found))) => end.set(found),
                    Ok(Some(Piece::Begin(_) | Piece::Others)) => {}
                    Ok(None) => return None,
                    Err(why) => {
                        end.set(LogEnd::Broken(why));
                        return None;
                    }
                }
            }
        })
    }

    /// The next piece; `None` at the end of the file. After an error there is nothing more.
    fn next(&mut self) -> Result<Option<Piece>, String> {
        let missing = || "a part of its log is missing".to_owned();
        self.records.find(|record| match record {
            Record::Metadata(metadata) if metadata.name == BEGIN => {
                self.has_begun = true;
                let begin = Begin::of_map(&metadata.metadata);
                begin.map(|begin| Some(Piece::Begin(begin))).ok_or("its description is broken".into())
            }
            Record::Metadata(metadata) if metadata.name == END => {
                let cut = metadata.metadata.get(CUT_AT).map(|cycle| cycle.parse().unwrap_or(0));
                Ok(Some(Piece::End(cut.map_or(LogEnd::Whole, LogEnd::CutAt))))
            }
            Record::Channel(channel) if channel.topic == TOPIC => {
                self.channel = Some(channel.id);
                Ok(None)
            }
            Record::Message { header, data } if Some(header.channel_id) == self.channel => {
                self.sequence = self.sequence.wrapping_add(1);
                if header.sequence != self.sequence {
                    return Err(missing());
                }
                let words = words(&data).ok_or("a piece of its log is broken")?;
                Ok(Some(Piece::Words(words)))
            }
            // A log begins before all messages.
            Record::Message { .. } if self.channel.is_none() => match self.has_begun {
                true => Err(missing()),
                false => Ok(Some(Piece::Others)),
            },
            _ => Ok(None),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::other;

    /// As `Debug` writes one.
    const PLAN: &str = r#"Cycle {
    priority: 80,
}
[
    Bus {
        name: "b",
        drives: [
            Drive {
                axis: Axis {
                    name: "x",
                    divisor: 1,
                },
                tag: 7,
            },
        ],
    },
]
"#;

    #[test]
    fn the_first_value_that_differs_is_named_with_its_place() {
        assert_eq!(other(PLAN, PLAN), None);
        let differs = |from: &str, to: &str| other(PLAN, &PLAN.replace(from, to)).unwrap();
        assert_eq!(differs("80", "81"), "Cycle: recorded `priority: 80`, here `priority: 81`");
        let of_axis = differs("divisor: 1", "divisor: 2");
        assert!(of_axis.starts_with("Bus \"b\", drives"), "{of_axis}");
        assert!(of_axis.ends_with("axis: Axis \"x\": recorded `divisor: 1`, here `divisor: 2`"), "{of_axis}");
        let of_drive = differs("tag: 7", "tag: 8");
        assert!(of_drive.ends_with("Drive \"x\": recorded `tag: 7`, here `tag: 8`"), "{of_drive}");
        assert_eq!(other("a\n", "a\nb\n").unwrap(), "recorded `nothing more`, here `b`");
    }
}
