//! What is reported of a course of records, and how it reads.

use super::*;
use crate::blackbox::file::Channel;
use fieldbeat_core::axis::{Emergency, State, StopCause};
use fieldbeat_core::cycle::record::{EventRecord, MonitorRecord};
use fieldbeat_core::time::MS;

fn machine() -> (Header, Vec<Record>) {
    let axis = |name: &str| Axis { name: name.into(), unit: "mm".into(), ..Axis::default() };
    let header = Header {
        why: "drive x: link lost".into(),
        cycle: 103,
        period_ns: MS,
        deadline_ns: MS / 2,
        late_ns: MS / 10,
        axes: vec![axis("x"), axis("long")],
        ..Header::default()
    };
    let mut records = Vec::new();
    for index in 96..106 {
        for axis in 0..2 {
            let mut drive = DriveRecord {
                index,
                axis,
                reply: Reply::Answered,
                link: Link::Online,
                state: State::OperationEnabled,
                command: 7,
                ..DriveRecord::default()
            };
            if axis == 0 && index > 99 {
                drive.reply = Reply::Missed;
                if index >= 103 {
                    (drive.link, drive.stopped, drive.command) = (Link::Lost, Some(StopCause::LinkLost), 0);
                }
            }
            records.push(Record::Drive(drive));
        }
        let wake_ns = if index == 99 { 412_000 } else { 5_000 };
        records.push(Record::Cycle(CycleRecord { index, wake_ns, ..CycleRecord::default() }));
    }
    (header, records)
}

#[test]
fn the_grid_reference_is_reported_on_change_and_its_silence_once() {
    let (mut header, _) = machine();
    header.reference = Some("line".into());
    let mut records = Vec::new();
    for index in 90..106 {
        let (error_ns, locked) = match index {
            0..=91 => (Some(-20_000), false),
            95..=97 => (None, true),
            103.. => (Some(250_000), false),
            _ => (Some(300), true),
        };
        let step_ns = if index == 104 { -10_000 } else { 0 };
        records.push(Record::Reference(ReferenceRecord { index, error_ns, step_ns, locked, counts: true }));
        records.push(Record::Cycle(CycleRecord { index, wake_ns: 412_000, ..CycleRecord::default() }));
    }
    let events = events(&header, &records);
    let of_line = events.iter().filter(|one| one.what.contains("line"));
    let found: Vec<_> = of_line.map(|one| (one.cycle, one.times, one.what.as_str())).collect();
    let expected = [
        (90, 1, "grid not locked to line"),
        (92, 1, "lock to line found: 300 ns late"),
        (95, 3, "no phase from line"),
        (103, 1, "lock to line lost: 250 us late"),
    ];
    assert_eq!(found, expected);
    // The late wake-ups are counted between the changes of the lock.
    let woke = events.iter().filter(|one| one.what.starts_with("woke"));
    let counted: Vec<_> = woke.map(|one| (one.cycle, one.times, one.until)).collect();
    assert_eq!(counted, [(90, 2, 91), (92, 11, 102), (103, 3, 105)]);
    let text = text(&header, &records, 8);
    assert!(text.lines().any(|line| line.ends_with("phase      step")), "{text}");
    assert!(
        text.lines().any(|line| line.trim_start().starts_with("104 ") && line.ends_with("250.0     -10.0"))
    );
}

#[test]
fn the_way_to_a_lost_link_is_reported_in_its_order() {
    let (header, records) = machine();
    let found: Vec<String> = events(&header, &records)
        .into_iter()
        .map(|one| {
            format!("{} {} {} x{}", one.cycle, one.drive.as_deref().unwrap_or("loop"), one.what, one.times)
        })
        .collect();
    assert_eq!(
        found,
        [
            "96 x online, OperationEnabled, follow x1",
            "96 long online, OperationEnabled, follow x1",
            "99 loop woke 412 us late x1",
            "100 x no reply x4",
            "103 x follow ended x1",
            "103 x link online -> lost x1",
            "103 x stopped: link lost x1",
        ]
    );
}

#[test]
fn the_tables_show_the_drive_it_happened_to() {
    let (header, records) = machine();
    let text = text(&header, &records, 4);
    assert!(text.contains("drive x, mm") && !text.contains("drive long, mm"), "{text}");
    assert!(text.contains("   -0.0040 s  cycle 99         loop  woke 412 us late"), "{text}");
    assert!(text.contains("no reply ... 4 times until cycle 103\n"), "{text}");
}

#[test]
fn repetitions_are_one_line_with_their_number_their_end_and_the_worst_of_them() {
    let (header, _) = machine();
    let mut records = Vec::new();
    // Every other reply of x is missing, long warns now and then, and the loop wakes later and later.
    for index in 60..100 {
        let reply = if index % 2 == 0 { Reply::Missed } else { Reply::Answered };
        let warning = u32::from(index % 4 == 3);
        let link = Link::Online;
        let x = DriveRecord { index, link, reply, ..DriveRecord::default() };
        let long = DriveRecord { index, link, axis: 1, warning, ..DriveRecord::default() };
        let cycle = CycleRecord { index, wake_ns: 1_000 * index as u32, ..CycleRecord::default() };
        records.extend([Record::Drive(x), Record::Drive(long)]);
        if index > 80 {
            records.push(Record::Cycle(CycleRecord { wake_ns: 4 * cycle.wake_ns, ..cycle }));
        }
    }
    let text = text(&header, &records, 0);
    for line in [
        "cycle 62         x     no reply ... 19 times until cycle 98\n",
        "cycle 63         long  warning 0x0000 -> 0x0001 ... 10 times until cycle 99\n",
        "cycle 81         loop  woke 324 us late ... 19 times until cycle 99, at most 396 us\n",
    ] {
        assert!(text.contains(line), "no {line}{text}");
    }
}

#[test]
fn unreported_values_are_a_dash_in_text_and_null_in_json() {
    let (header, mut records) = machine();
    for record in &mut records {
        let Record::Drive(drive) = record else { continue };
        (drive.position, drive.demand, drive.velocity, drive.current) = (f64::NAN, f64::NAN, 2.5, f32::NAN);
    }
    let text = text(&header, &records, 4);
    let row = text.lines().rfind(|line| line.contains("missed")).unwrap();
    let columns: Vec<&str> = row.split_whitespace().rev().take(4).collect();
    assert_eq!((columns, text.contains("NaN")), (vec!["-", "2.50", "-", "-"], false), "{text}");
    let json = serde_json::to_value(courses(&header, &records, &[], 4)).unwrap();
    let row = &json[0]["rows"][0];
    let [position, demand, current] = ["position", "demand", "current"].map(|key| row[key].is_null());
    assert!(position && demand && current && row["velocity"] == 2.5, "{row}");
}

#[test]
fn an_emergency_is_reported_by_its_name_when_it_came() {
    let (mut header, mut records) = machine();
    header.axes[0].faults.insert(0x4310, "motor temperature".into());
    for (index, code) in [(98, 0x4310), (100, 0)] {
        let came = EventKind::Emergency(Emergency { code, register: 8 });
        let place = records.iter().position(|record| record.index() > index).unwrap();
        records.insert(place, Record::Event(EventRecord::new(index, 0, came, None)));
    }
    let found: Vec<_> = events(&header, &records)
        .into_iter()
        .filter(|one| one.what.starts_with("emergency"))
        .map(|one| (one.cycle, one.what))
        .collect();
    let words = [
        "emergency 0x4310 (17168, motor temperature), register 0x08",
        "emergency: error over, register 0x08",
    ];
    assert_eq!(found, [(98, words[0].to_owned()), (100, words[1].to_owned())]);
}

#[test]
fn an_empty_one_says_so() {
    let (header, _) = machine();
    assert!(text(&header, &[], 4).contains("it holds no cycle"));
}

#[test]
fn any_number_and_any_name_can_be_shown() {
    let (mut header, mut records) = machine();
    let name = "\x1b[2J".repeat(20_000);
    header.axes[0].monitor[2] = Some(Channel { name: name.clone(), unit: "\x07".into() });
    header.axes[1].name = name;
    let shown = [Some(f64::MAX), Some(f64::NAN), Some(f64::MIN), None].into();
    records.insert(1, Record::Monitor(MonitorRecord { index: 96, axis: 0, shown }));
    for cycle in [0, 103, u64::MAX] {
        header.cycle = cycle;
        for record in &mut records {
            match record {
                Record::Drive(DriveRecord { index, .. }) | Record::Monitor(MonitorRecord { index, .. }) => {
                    *index = (*index).max(cycle);
                }
                _ => {}
            }
        }
        for cycles in [0, 4, u64::MAX] {
            let text = text(&header, &records, cycles);
            assert!(text.contains("drive x, mm") && !text.contains('\x1b') && !text.contains("NaN"));
        }
    }
}
