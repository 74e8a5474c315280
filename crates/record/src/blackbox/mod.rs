//! The black box: the last cycles, always in memory, written to a file when something fails.
//!
//! | file | what |
//! |---|---|
//! | `mod` | what is kept, and when it is written |
//! | `file` | the file's bytes, both ways |
//! | `list` | the files of a directory |
//! | `events` | what led up to it, in words |
//!
//! It is fed by the telemetry thread, so that the loop pays nothing for it. A file is written by a thread of its own: a
//! slow disk holds up nobody.

pub mod events;
pub mod file;
pub mod list;

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use self::file::{Axis, Channel, Header};
use crate::failures::Failures;
use crate::file::save;
use fieldbeat_core::axis::{FaultNames, MonitorChannel};
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::record::{DriveRecord, Record};
use fieldbeat_core::rt::host;
use fieldbeat_core::time::MS;
use fieldbeat_telemetry::thread::Keep;
pub use fieldbeat_telemetry::thread::Written;

/// So much of what follows is kept too: how the stop went.
const AFTERMATH_NS: u64 = 200 * MS;

/// A machine that fails again and again does not fill the disk: of the files that nobody requested the first ones stay,
/// where it began, and the newest.
const FIRST_FILES: usize = 8;
const NEWEST_FILES: usize = 8;

/// At the end a disk has so long for all files together.
const PATIENCE: Duration = Duration::from_secs(5);

/// How often it is looked whether they are written.
const LOOK_EVERY: Duration = Duration::from_millis(2);

/// What is kept.
#[derive(Debug)]
pub struct BlackBox {
    directory: PathBuf,
    header: Header,
    records: VecDeque<Record>,
    room: usize,
    failing: Failures,
    fault_names: Vec<FaultNames>,
    newest: u64,
    aftermath: u64,
    /// Cycles that it holds.
    cycles: u64,
    /// It is to be written.
    due: Option<Due>,
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
    /// What became of it; a writer that has not ended by now is left to its disk.
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

/// Why and when it is to be written.
#[derive(Debug)]
struct Due {
    why: String,
    cycle: u64,
    /// Once this cycle has come.
    from: u64,
    /// Something failed; otherwise the file was requested.
    failed: bool,
}

impl From<MonitorChannel> for Channel {
    fn from(MonitorChannel { name, unit }: MonitorChannel) -> Channel {
        Channel { name, unit: unit.to_owned() }
    }
}

/// What the records of a run of `plan` are of; no fault has occurred yet.
pub fn header(plan: &Plan) -> Header {
    let cycle = &plan.cycle;
    Header {
        program: env!("CARGO_PKG_VERSION").to_owned(),
        machine: plan.source.as_ref().map(|path| path.display().to_string()),
        period_ns: cycle.period_ns,
        deadline_ns: cycle.deadline_ns(),
        late_ns: cycle.late_ns(),
        reference: cycle.reference.clone(),
        axes: (plan.axes().iter().zip(plan.monitored()))
            .map(|(axis, monitored)| Axis {
                name: axis.name.clone(),
                unit: axis.units.unit.to_string(),
                modulo: axis.units.modulo,
                monitor: monitored.map(|channel| channel.map(Channel::from)),
                faults: BTreeMap::new(),
            })
            .collect(),
        kernel: host::kernel(),
        preemption: host::preemption(),
        cpu: host::cpu(),
        ..Header::default()
    }
}

/// The codes in a record that its protocol may have names for.
pub fn fault_codes(drive: &DriveRecord) -> impl Iterator<Item = u32> {
    let reported = drive.emergency().map_or(0, |emergency| emergency.code.into());
    [drive.fault, reported].into_iter().filter(|code| *code != 0)
}

impl BlackBox {
    /// A black box of `plan` whose files go to `directory`; `None` if the plan wants none.
    pub fn new(plan: &Plan, directory: &Path) -> Option<BlackBox> {
        let cycle = &plan.cycle;
        let room = plan.black_box_records();
        (room > 0).then(|| BlackBox {
            directory: directory.to_owned(),
            room,
            records: VecDeque::with_capacity(room),
            newest: 0,
            aftermath: AFTERMATH_NS.min(cycle.black_box_ns / 2) / cycle.period_ns,
            cycles: cycle.black_box_ns / cycle.period_ns,
            due: None,
            written_to: None,
            files: 0,
            failures: 0,
            newest_files: VecDeque::with_capacity(NEWEST_FILES + 1),
            writing: Vec::new(),
            patience: PATIENCE,
            header: header(plan),
            failing: Failures::of(plan),
            fault_names: plan.fault_names(),
        })
    }

    fn look(&mut self, drive: &DriveRecord) {
        let Some(why) = self.failing.see(drive) else { return };
        let due = Due {
            why,
            cycle: drive.index,
            // Not before the newest file's end has left it: what follows closely upon a failure is in one file with it.
            from: (drive.index + self.aftermath).max(self.written_to.map_or(0, |to| to + self.cycles)),
            failed: true,
        };
        // The first failure is the reason that is written; a request does not delay it.
        if self.due.as_ref().is_none_or(|due| !due.failed) {
            self.due = Some(due);
        }
    }

    /// Names the faults that occur in the records: whoever reads the file may know nothing of the protocol.
    fn name_faults(&self, header: &mut Header) {
        for record in &self.records {
            let Record::Drive(drive) = record else { continue };
            let axis = usize::from(drive.axis);
            let (Some(of), Some(names)) = (header.axes.get_mut(axis), self.fault_names.get(axis)) else {
                continue;
            };
            for code in fault_codes(drive) {
                if let Some(name) = names(code) {
                    of.faults.entry(code).or_insert_with(|| name.to_owned());
                }
            }
        }
    }

    fn start(&mut self, due: Due) {
        let Due { why, cycle, failed, .. } = due;
        let now = SystemTime::now();
        let stamp = humantime::format_rfc3339_seconds(now).to_string();
        let name = format!("fieldbeat-{}-cycle-{cycle}.blackbox", stamp.replace([':', '-'], ""));
        let path = self.directory.join(name);
        self.files += 1;
        let mut written = Written {
            why: why.clone(),
            cycle,
            path,
            error: None,
            number: self.files,
            replaced: None,
            fails_run: false,
        };
        if failed {
            self.written_to = Some(self.newest);
            self.failures += 1;
            if self.failures > FIRST_FILES {
                self.newest_files.push_back(written.path.clone());
            }
            if self.newest_files.len() > NEWEST_FILES {
                written.replaced = self.newest_files.pop_front();
            }
        }
        let mut header = Header { why, cycle, written: stamp, ..self.header.clone() };
        self.name_faults(&mut header);
        let bytes = file::encode(&header, self.records.iter());
        let (path, replaced) = (written.path.clone(), written.replaced.clone());
        let write = move || {
            if let Some(spare) = &replaced {
                // Gone already is as good.
                let _ = std::fs::remove_file(spare);
            }
            save(&path, &bytes).err().map(|error| error.to_string())
        };
        match std::thread::Builder::new().name("fb-blackbox".into()).spawn(write) {
            Ok(thread) => self.writing.push(Writing { written, thread }),
            // Without a thread there is no file; the next failure tries again.
            Err(_) => self.files -= 1,
        }
    }
}

impl Keep for BlackBox {
    fn enter(&mut self, record: &Record) {
        // What commands and events lead to stands in the records of the drives, and their words do not fit into its
        // file; native process data would shorten the time that it has room for.
        if matches!(record, Record::Command(_) | Record::Event(_) | Record::Native(_)) {
            return;
        }
        if self.records.len() == self.room {
            self.records.pop_front();
        }
        self.records.push_back(*record);
        match record {
            Record::Drive(drive) => self.look(drive),
            Record::Monitor(_)
            | Record::Reference(_)
            | Record::Command(_)
            | Record::Event(_)
            | Record::Native(_) => {}
            Record::Cycle(_) | Record::Skipped(_) => self.newest = record.index(),
        }
        // At once: when the telemetry is late, the failure itself would leave the ring before it is written.
        if let Some(due) = self.due.take_if(|due| self.newest >= due.from) {
            self.start(due);
        }
    }

    fn request(&mut self) {
        let (cycle, from) = (self.newest, self.newest + self.aftermath);
        self.due.get_or_insert(Due { why: "requested".to_owned(), cycle, from, failed: false });
    }

    fn conclude(&mut self, why: &str) {
        if self.failures == 0 && self.due.as_ref().is_none_or(|due| !due.failed) {
            self.due = Some(Due { why: why.to_owned(), cycle: self.newest, from: self.newest, failed: true });
        }
    }

    fn write(&mut self, last: bool) -> Vec<Written> {
        if last && let Some(due) = self.due.take() {
            self.start(due);
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
