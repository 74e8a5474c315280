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

pub(crate) mod events;
pub(crate) mod file;
pub(crate) mod list;

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use nix::unistd::User;

use self::file::{Axis, Channel, Header};
use crate::axis::{Fault, FaultNames, Link, MonitorChannel, StopCause};
use crate::cycle::Plan;
use crate::cycle::record::{DriveRecord, Record};
use crate::master::Setup;
use crate::rt::host;
use crate::telemetry::file::save;
use crate::telemetry::recorder::Keep;
pub use crate::telemetry::recorder::Written;
use crate::time::MS;

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
    axes: Vec<Known>,
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

/// How an axis was when last seen.
#[derive(Clone, Copy, Debug, Default)]
struct Known {
    link: Link,
    fault: u32,
    stopped: Option<StopCause>,
}

impl From<MonitorChannel> for Channel {
    fn from(MonitorChannel { name, unit }: MonitorChannel) -> Channel {
        Channel { name, unit: unit.to_owned() }
    }
}

impl BlackBox {
    /// A black box of `plan` whose files go to `directory`; `None` if the plan wants none.
    pub fn new(plan: &Plan, directory: &Path) -> Option<BlackBox> {
        let cycle = &plan.cycle;
        let axes = plan.axes();
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
            header: Header {
                program: env!("CARGO_PKG_VERSION").to_owned(),
                machine: plan.source.as_ref().map(|path| path.display().to_string()),
                period_ns: cycle.period_ns,
                deadline_ns: cycle.deadline_ns(),
                late_ns: cycle.late_ns(),
                reference: cycle.reference.clone(),
                axes: (axes.iter().zip(plan.monitored()))
                    .map(|(axis, monitored)| Axis {
                        name: axis.name.clone(),
                        unit: axis.units.unit.to_string(),
                        monitor: monitored.map(|channel| channel.map(Channel::from)),
                        faults: BTreeMap::new(),
                    })
                    .collect(),
                kernel: host::kernel(),
                preemption: host::preemption(),
                cpu: host::cpu(),
                ..Header::default()
            },
            axes: vec![Known::default(); axes.len()],
            fault_names: plan.fault_names(),
        })
    }

    fn look(&mut self, drive: &DriveRecord) {
        let axis = usize::from(drive.axis);
        let (Some(known), Some(names)) = (self.axes.get_mut(axis), self.fault_names.get(axis)) else {
            return;
        };
        let (link, fault, stopped) = (drive.link, drive.fault, drive.stopped);
        let before = std::mem::replace(known, Known { link, fault, stopped });
        let what = if link == Link::Lost && before.link != Link::Lost {
            "link lost".to_owned()
        } else if fault != 0 && before.fault == 0 {
            format!("fault {}", Fault::new(fault, *names))
        } else if let Some(cause) =
            stopped.filter(|cause| before.stopped.is_none() && *cause != StopCause::Shutdown)
        {
            format!("stopped: {cause}")
        } else {
            return;
        };
        let name = &self.header.axes[axis].name;
        let due = Due {
            why: format!("drive {name}: {what}"),
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
            let reported = drive.emergency().map_or(0, |emergency| emergency.code.into());
            for code in [drive.fault, reported].into_iter().filter(|code| *code != 0) {
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
        if self.records.len() == self.room {
            self.records.pop_front();
        }
        self.records.push_back(*record);
        match record {
            Record::Drive(drive) => self.look(drive),
            Record::Monitor(_) | Record::Reference(_) => {}
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

impl Setup {
    /// Where the black box writes its files. Without it there is none.
    pub fn with_black_box(mut self, directory: impl Into<PathBuf>) -> Setup {
        let black_box = BlackBox::new(self.plan(), &directory.into());
        self.black_box = black_box.map(|black_box| Box::new(black_box) as Box<dyn Keep>);
        self
    }
}

/// Where the files go if nobody says otherwise: the state directory of the service, or that of the user.
pub fn default_directory() -> PathBuf {
    let of = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    of("STATE_DIRECTORY").or_else(|| Some(of("XDG_STATE_HOME")?.join("fieldbeat"))).unwrap_or_else(|| {
        // Never a directory that others may write to.
        let home = User::from_uid(nix::unistd::geteuid()).ok().flatten().map(|user| user.dir);
        of("HOME").or(home).unwrap_or_default().join(".local/state/fieldbeat")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::linudp::upid::Upid;
    use crate::bus::linudp::{LinUdpDrive, LinUdpPlan, MonitorPlan};
    use crate::cycle::CyclePlan;
    use crate::cycle::record::{CycleRecord, MonitorRecord};

    fn plan(black_box_ns: u64) -> Plan {
        let drives = ["x", "y"].map(|name| LinUdpDrive::new(name, [127, 0, 0, 2].into()));
        Plan {
            source: None,
            cycle: CyclePlan { black_box_ns, ..CyclePlan::default() },
            buses: vec![Box::new(LinUdpPlan::new([127, 0, 0, 1].into(), drives.into()))],
            groups: Vec::new(),
        }
    }

    fn cycle(black_box: &mut BlackBox, index: u64, change: impl Fn(&mut DriveRecord)) {
        for axis in 0..2 {
            let mut drive = DriveRecord { index, axis, link: Link::Online, ..DriveRecord::default() };
            change(&mut drive);
            black_box.enter(&Record::Drive(drive));
        }
        black_box.enter(&Record::Cycle(CycleRecord { index, ..CycleRecord::default() }));
    }

    #[test]
    fn a_failure_is_written_once_with_its_aftermath() {
        let directory = tempfile::tempdir().unwrap();
        let mut black_box = BlackBox::new(&plan(100 * MS), directory.path()).unwrap();
        (0..500).for_each(|index| cycle(&mut black_box, index, |_| {}));
        let fail = |drive: &mut DriveRecord| {
            if drive.axis == 1 {
                (drive.fault, drive.stopped) = (0x0B, Some(StopCause::DriveFault));
            }
        };
        for index in 500..550 {
            cycle(&mut black_box, index, fail);
            assert_eq!(black_box.write(false), []);
        }
        // The telemetry is late and takes many cycles at once: what the file is about has not left it.
        (550..700).for_each(|index| cycle(&mut black_box, index, fail));
        assert_eq!(black_box.write(true).len(), 1);
        let files: Vec<_> = std::fs::read_dir(directory.path()).unwrap().collect();
        let path = files[0].as_ref().unwrap().path();
        assert_eq!(files.len(), 1);
        let (header, records) = file::load(&path).unwrap();
        assert_eq!((header.why.as_str(), header.cycle), ("drive y: fault 0x000b (11, position lag)", 500));
        let lag = [(0x0B, "position lag".to_owned())];
        assert_eq!((header.axes[0].faults.len(), &header.axes[1].faults), (0, &lag.into()));
        assert!(events::text(&header, &records, 3).contains("fault none -> 0x000b (11, position lag)"));
        assert_eq!(records.len(), 300, "100 cycles of 2 drives and a cycle record each");
        let after = records.iter().filter(|record| matches!(record, Record::Cycle(c) if c.index >= 500));
        assert_eq!(after.count(), 51);
    }

    #[test]
    fn what_a_drive_shows_besides_comes_back_from_the_file() {
        let directory = tempfile::tempdir().unwrap();
        let mut showing = LinUdpDrive::new("z", [127, 0, 0, 3].into());
        showing.monitor = MonitorPlan::Sources([None, Some(Upid(0x1BCD)), Some(Upid(0x1E0F)), None]);
        let mut plan = plan(100 * MS);
        plan.buses.insert(0, Box::new(LinUdpPlan::new([127, 0, 1, 1].into(), vec![showing])));
        let mut black_box = BlackBox::new(&plan, directory.path()).unwrap();
        for index in 0..300 {
            for axis in 0..3 {
                black_box.enter(&Record::Drive(DriveRecord { index, axis, ..DriveRecord::default() }));
                if axis == 0 && index % 2 == 0 {
                    let shown = [None, Some(40.5), Some(index as f64 - 250.0), None].into();
                    black_box.enter(&Record::Monitor(MonitorRecord { index, axis, shown }));
                }
            }
            black_box.enter(&Record::Cycle(CycleRecord { index, ..CycleRecord::default() }));
        }
        black_box.request();
        let [written] = &black_box.write(true)[..] else { panic!() };
        let (header, records) = file::load(&written.path).unwrap();
        let channel = |name: &str, unit: &str| Some(Channel { name: name.into(), unit: unit.into() });
        let monitor = [None, channel("core-temperature", "C"), channel("demand-velocity", "mm/s"), None];
        assert_eq!((header.axes[0].name.as_str(), &header.axes[0].monitor), ("z", &monitor));
        assert!(header.axes[1..].iter().all(|axis| axis.monitor.iter().all(Option::is_none)));
        // Room for one more record a cycle than it needs in every second one.
        assert_eq!(records.len(), 500);

        let courses = events::courses(&header, &records, &[], 3);
        assert_eq!(courses.iter().map(|course| course.monitor.len()).collect::<Vec<_>>(), [2, 0, 0]);
        let rows: Vec<_> = courses[0].rows.iter().map(|row| (row.cycle, &row.monitor[..])).collect();
        let at = |value: f64| [Some(40.5), Some(value)];
        let none = [None, None];
        assert_eq!(rows, [(296, &at(46.0)[..]), (297, &none), (298, &at(48.0)), (299, &none)]);
        let text = events::text(&header, &records, 3);
        let (_, table) = text.split_once("drive z, mm\n").unwrap();
        let lines: Vec<&str> = table.lines().take(3).collect();
        assert!(lines[0].ends_with(" current A core-temperature C demand-velocity mm/s"), "{text}");
        assert!(lines[1].ends_with("      0.00               40.5                   46"), "{text}");
        assert!(lines[2].ends_with("      0.00                  -                    -"), "{text}");
        assert_eq!(text.matches("core-temperature").count(), 1, "{text}");
    }

    #[test]
    fn a_failure_comes_before_a_request() {
        let directory = tempfile::tempdir().unwrap();
        let mut black_box = BlackBox::new(&plan(100 * MS), directory.path()).unwrap();
        (0..10).for_each(|index| cycle(&mut black_box, index, |_| {}));
        black_box.request();
        (10..200).for_each(|index| cycle(&mut black_box, index, |drive| drive.fault = 5));
        let [written] = &black_box.write(true)[..] else { panic!() };
        assert_eq!(
            (written.why.as_str(), written.cycle),
            ("drive x: fault 0x0005 (5, regeneration resistor not connected)", 10)
        );
    }

    #[test]
    fn a_machine_that_fails_for_weeks_keeps_its_first_and_its_newest_files() {
        let directory = tempfile::tempdir().unwrap();
        let mut black_box = BlackBox::new(&plan(100 * MS), directory.path()).unwrap();
        let mut written = Vec::new();
        // A fault every ten cycles, at last none; then a request.
        for index in 0..4_400 {
            cycle(&mut black_box, index, |drive| drive.fault = u32::from(index % 10 == 9 && index < 4_000));
            if index == 4_200 {
                black_box.request();
            }
            // To the end of each, so that the order of the files is that of the failures.
            while !black_box.writing.is_empty() {
                written.extend(black_box.write(false));
            }
        }
        let requested = written.pop().unwrap();
        assert_eq!(
            (requested.why.as_str(), requested.cycle, requested.path.exists()),
            ("requested", 4_200, true)
        );
        let all: Vec<u64> = written.iter().map(|one| one.cycle).collect();
        // Each begins where the one before it ends.
        assert!(all.len() > 30 && all[1..].windows(2).all(|pair| pair[1] - pair[0] == 100), "{all:?}");
        let kept: Vec<u64> = written.iter().filter(|one| one.path.exists()).map(|one| one.cycle).collect();
        assert_eq!(kept, [&all[..FIRST_FILES], &all[all.len() - NEWEST_FILES..]].concat());
    }

    #[test]
    fn a_writer_that_hangs_or_panics_holds_up_no_end_and_is_a_failure() {
        let directory = tempfile::tempdir().unwrap();
        let mut black_box = BlackBox::new(&plan(100 * MS), directory.path()).unwrap();
        black_box.patience = Duration::from_millis(20);
        let (release, hangs) = std::sync::mpsc::channel::<()>();
        let written = |number| Written {
            why: "requested".into(),
            cycle: 1,
            path: "/frozen/a.blackbox".into(),
            error: None,
            number,
            replaced: None,
            fails_run: false,
        };
        let frozen = std::thread::spawn(move || hangs.recv().err().map(|error| error.to_string()));
        let panics = std::thread::spawn(|| std::panic::resume_unwind(Box::new("on purpose")));
        black_box.writing = vec![
            Writing { written: written(1), thread: frozen },
            Writing { written: written(2), thread: panics },
        ];
        let [frozen, panicked] = &black_box.write(true)[..] else { panic!() };
        assert!(frozen.fails_run && panicked.fails_run);
        let line = "black box not written: /frozen/a.blackbox: its disk does not answer for 0.02 s (requested, cycle \
                    1)";
        assert_eq!(frozen.to_string(), line);
        assert!(panicked.to_string().contains("its writer panicked"), "{panicked}");
        drop(release);
    }

    #[test]
    fn a_run_that_the_program_itself_ended_has_a_file_and_no_second_one() {
        for failed_before in [false, true] {
            let directory = tempfile::tempdir().unwrap();
            let mut black_box = BlackBox::new(&plan(100 * MS), directory.path()).unwrap();
            (0..10).for_each(|index| {
                cycle(&mut black_box, index, |drive| drive.fault = u32::from(failed_before))
            });
            black_box.conclude("the loop panicked");
            let [written] = &black_box.write(true)[..] else { panic!() };
            assert_eq!(written.why == "the loop panicked", !failed_before, "{written:?}");
        }
    }

    #[test]
    fn a_missing_directory_is_made_and_an_impossible_one_is_reported() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("file");
        std::fs::write(&file, "").unwrap();
        for (place, possible) in [(directory.path().join("a/b"), true), (file.join("a"), false)] {
            let mut black_box = BlackBox::new(&plan(100 * MS), &place).unwrap();
            cycle(&mut black_box, 3, |_| {});
            black_box.request();
            let [written] = &black_box.write(true)[..] else { panic!() };
            assert_eq!((written.why.as_str(), written.cycle), ("requested", 3));
            assert_eq!(written.error.is_none(), possible, "{written:?}");
        }
    }

    #[test]
    fn none_is_wanted() {
        assert!(BlackBox::new(&plan(0), Path::new("/")).is_none());
    }
}
