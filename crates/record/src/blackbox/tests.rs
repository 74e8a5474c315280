use super::file::Channel;
use super::*;
use fieldbeat_core::axis::{EventKind, Link, StopCause};
use fieldbeat_core::cycle::CyclePlan;
use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord, EventRecord, MonitorRecord};
use fieldbeat_core::cycle::ring::{self, Kept, RecordWriter};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::MS;
use fieldbeat_linudp::upid::Upid;
use fieldbeat_linudp::{LinUdpDrive, LinUdpPlan, MonitorPlan};

fn plan(black_box_ns: u64) -> Plan {
    let drives = ["x", "y"].map(|name| LinUdpDrive::new(name, [127, 0, 0, 2].into()));
    Plan {
        source: None,
        cycle: CyclePlan { black_box_ns, ..CyclePlan::default() },
        buses: vec![Box::new(LinUdpPlan::new([127, 0, 0, 1].into(), drives.into()))],
        groups: Vec::new(),
    }
}

/// A black box and the ring that it looks at.
struct Fed {
    black_box: BlackBox,
    loops: RecordWriter,
    ring: RecordReader,
}

impl Fed {
    fn new(plan: &Plan, directory: &Path) -> Fed {
        let black_box = BlackBox::new(plan, directory).unwrap();
        let kept = Kept { records: plan.black_box_records(), about: None };
        let (loops, ring, _) = ring::records(1, kept, &mut Regions::new());
        Fed { black_box, loops, ring }
    }

    fn enter(&mut self, record: Record) {
        assert!(self.loops.push(record));
        self.black_box.enter(self.ring.next().unwrap(), &self.ring);
        self.ring.release();
    }

    fn write(&mut self, last: bool) -> Vec<Written> {
        self.black_box.write(last, &self.ring)
    }

    fn cycle(&mut self, index: u64, change: impl Fn(&mut DriveRecord)) {
        for axis in 0..2 {
            let mut drive = DriveRecord { index, axis, link: Link::Online, ..DriveRecord::default() };
            change(&mut drive);
            self.enter(Record::Drive(drive));
        }
        self.enter(Record::Cycle(CycleRecord { index, ..CycleRecord::default() }));
    }
}

#[test]
fn a_failure_is_written_once_with_its_aftermath() {
    let directory = tempfile::tempdir().unwrap();
    let mut black_box = Fed::new(&plan(100 * MS), directory.path());
    (0..500).for_each(|index| black_box.cycle(index, |_| {}));
    let fail = |drive: &mut DriveRecord| {
        if drive.axis == 1 {
            (drive.fault, drive.stopped) = (0x0B, Some(StopCause::DriveFault));
        }
    };
    let event = EventRecord::new(500, 1, EventKind::Fault(0x0B), None);
    for index in 500..550 {
        if index == 501 {
            black_box.enter(Record::Event(event));
        }
        black_box.cycle(index, fail);
        assert_eq!(black_box.write(false), []);
    }
    // The telemetry is late and takes many cycles at once: what the file is about has not left it.
    (550..700).for_each(|index| black_box.cycle(index, fail));
    assert_eq!(black_box.write(true).len(), 1);
    let files: Vec<_> = std::fs::read_dir(directory.path()).unwrap().collect();
    let path = files[0].as_ref().unwrap().path();
    assert_eq!(files.len(), 1);
    let (header, records) = file::load(&path).unwrap();
    assert_eq!((header.why.as_str(), header.cycle), ("drive y: fault 0x000b (11, position lag)", 500));
    let lag = [(0x0B, "position lag".to_owned())];
    assert_eq!((header.axes[0].faults.len(), &header.axes[1].faults), (0, &lag.into()));
    assert!(events::text(&header, &records, 3).contains("fault none -> 0x000b (11, position lag)"));
    assert_eq!(records.len(), 297, "99 cycles of 2 drives and a cycle record each, besides an event");
    let after = records.iter().filter(|record| matches!(record, Record::Cycle(c) if c.index >= 500));
    assert_eq!(after.count(), 51);
}

#[test]
fn monitored_values_are_read_back_from_the_file() {
    let directory = tempfile::tempdir().unwrap();
    let mut showing = LinUdpDrive::new("z", [127, 0, 0, 3].into());
    showing.monitor = MonitorPlan::Sources([None, Some(Upid(0x1BCD)), Some(Upid(0x1E0F)), None]);
    let mut plan = plan(100 * MS);
    plan.buses.insert(0, Box::new(LinUdpPlan::new([127, 0, 1, 1].into(), vec![showing])));
    let mut black_box = Fed::new(&plan, directory.path());
    for index in 0..300 {
        for axis in 0..3 {
            let drive = DriveRecord { index, axis, link: Link::Online, ..DriveRecord::default() };
            black_box.enter(Record::Drive(drive));
            if axis == 0 && index % 2 == 0 {
                let shown = [None, Some(40.5), Some(index as f64 - 250.0), None].into();
                black_box.enter(Record::Monitor(MonitorRecord { index, axis, shown }));
            }
        }
        black_box.enter(Record::Cycle(CycleRecord { index, ..CycleRecord::default() }));
    }
    black_box.black_box.request();
    let [written] = &black_box.write(true)[..] else { panic!() };
    let (header, records) = file::load(&written.path).unwrap();
    let channel = |name: &str, unit: &str| Some(Channel { name: name.into(), unit: unit.into() });
    let monitor = [channel("core-temperature", "C"), channel("demand-velocity", "mm/s"), None, None];
    assert_eq!((header.axes[0].name.as_str(), &header.axes[0].monitor), ("z", &monitor));
    assert!(header.axes[1..].iter().all(|axis| axis.monitor.iter().all(Option::is_none)));
    // Room for one more record a cycle than it needs in every second one, for whole cycles.
    assert_eq!((records.len(), records[0].index()), (499, 189));

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
    let mut black_box = Fed::new(&plan(100 * MS), directory.path());
    (0..10).for_each(|index| black_box.cycle(index, |_| {}));
    black_box.black_box.request();
    (10..200).for_each(|index| black_box.cycle(index, |drive| drive.fault = 5));
    let [written] = &black_box.write(true)[..] else { panic!() };
    assert_eq!(
        (written.why.as_str(), written.cycle),
        ("drive x: fault 0x0005 (5, regeneration resistor not connected)", 10)
    );
}

#[test]
fn a_machine_that_fails_for_weeks_keeps_its_first_and_its_newest_files() {
    let directory = tempfile::tempdir().unwrap();
    let mut black_box = Fed::new(&plan(100 * MS), directory.path());
    let mut written = Vec::new();
    // A fault every ten cycles, at last none; then a request.
    for index in 0..4_400 {
        black_box.cycle(index, |drive| drive.fault = u32::from(index % 10 == 9 && index < 4_000));
        if index == 4_200 {
            black_box.black_box.request();
        }
        // To the end of each, so that the order of the files is that of the failures.
        while !black_box.black_box.writing.is_empty() {
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
    let mut black_box = Fed::new(&plan(100 * MS), directory.path());
    black_box.black_box.patience = Duration::from_millis(20);
    let (release, hangs) = std::sync::mpsc::channel::<()>();
    let written = |number| Written {
        why: "requested".into(),
        cycle: 1,
        path: "/frozen/a.mcap".into(),
        error: None,
        number,
        replaced: None,
        fails_run: false,
    };
    let frozen = std::thread::spawn(move || hangs.recv().err().map(|error| error.to_string()));
    let panics = std::thread::spawn(|| std::panic::resume_unwind(Box::new("on purpose")));
    black_box.black_box.writing = vec![
        Writing { written: written(1), thread: frozen },
        Writing { written: written(2), thread: panics },
    ];
    let [frozen, panicked] = &black_box.write(true)[..] else { panic!() };
    assert!(frozen.fails_run && panicked.fails_run);
    let line = "black box not written: /frozen/a.mcap: its disk does not answer for 0.02 s (requested, \
         cycle 1)";
    assert_eq!(frozen.to_string(), line);
    assert!(panicked.to_string().contains("its writer panicked"), "{panicked}");
    drop(release);
}

#[test]
fn a_run_that_the_program_itself_ended_has_a_file_and_no_second_one() {
    for failed_before in [false, true] {
        let directory = tempfile::tempdir().unwrap();
        let mut black_box = Fed::new(&plan(100 * MS), directory.path());
        (0..10).for_each(|index| black_box.cycle(index, |drive| drive.fault = u32::from(failed_before)));
        black_box.black_box.conclude("the loop panicked");
        let [written] = &black_box.write(true)[..] else { panic!() };
        assert_eq!(written.why == "the loop panicked", !failed_before, "{written:?}");
    }
}
