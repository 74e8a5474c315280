//! Files as they are written, and as others find them.

mod log;
mod signals;

use std::fs::{File, OpenOptions};
use std::num::NonZeroU32;
use std::path::Path;

use tempfile::{NamedTempFile, TempPath};

use super::csv::{PerTopic, Wide};
use super::machine::{AxisAbout, Machine, of_axis, of_cycle};
use super::reading::{Reading, Wrong};
use super::whole::Whole;
use super::window::Window;
use super::writer::Writer;
use crate::failures::Failures;
use fieldbeat_core::axis::{
    self, Command, CommandId, EventKind, GroupCall, Link, Move, Outcome, Profile, QueuedCommand, State,
    StopCause, Target,
};
use fieldbeat_core::bus::native::{NativeField, NativeLayout};
use fieldbeat_core::cycle::record::{
    CommandRecord, CommandStep, CycleRecord, DriveRecord, EventRecord, Lateness, MonitorRecord, NativeRecord,
    Record, ReferenceRecord, Reply, SkippedRecord,
};
use fieldbeat_core::time::{MS, S, Time};
use fieldbeat_telemetry::causes::{Cause, Judged};
use fieldbeat_telemetry::sink::Sink;

/// The clock of the loop is so much behind UTC.
const UTC_NS: i64 = 1_000 * S as i64;
const BEGIN: Time = Time(5 * S);

fn machine() -> Machine {
    let axis =
        |name: &str| AxisAbout { name: name.into(), about: of_axis("mm", "linudp"), ..AxisAbout::default() };
    let monitor =
        [Some(("demand-current".into(), "A".into())), None, Some(("0x1E10".into(), "".into())), None];
    let axes = vec![axis("x"), AxisAbout { monitor, ..axis("y") }];
    Machine { about: of_cycle("9", MS, MS / 2, MS / 10), axes, period_ns: MS }
}

fn drive(index: u64, axis: u16) -> Record {
    Record::Drive(DriveRecord {
        index,
        axis,
        reply: Reply::Answered,
        link: Link::Online,
        state: State::OperationEnabled,
        stopped: (axis == 1).then_some(StopCause::GroupFailed),
        command: 4,
        rtt_ns: NonZeroU32::new(300),
        current: -1.5,
        velocity: 2.5,
        position: index as f64,
        demand: index as f64 + 0.25,
        ..DriveRecord::default()
    })
}

fn cycle(index: u64) -> Record {
    let stages_ns = [10, 20, 30, 40, 50, 60];
    Record::Cycle(CycleRecord {
        index,
        grid: BEGIN + index * MS,
        wake_ns: 7,
        stages_ns,
        ..CycleRecord::default()
    })
}

/// Records of `cycles` cycles of two axes; a command of the first one begins in cycle 2 and fails in cycle 4.
fn records(cycles: u64) -> Vec<Record> {
    let id = CommandId(3);
    let profile = Profile { velocity: 10.0, acceleration: 20.0, deceleration: 30.0 };
    let command = Command::Move(Move { target: Target::Relative(-4.0), profile });
    let call = Some(GroupCall { parts: 2, together: 2, lead: 0, id });
    let queued = QueuedCommand { id, member: 0, command, stream: 0, call };
    let step = |index, step| {
        let mut record = CommandRecord::new(step, &queued);
        record.index = index;
        Record::Command(record)
    };
    let failure = axis::Failure::Limit { what: "position", value: 9.0, low: 0.0, high: 8.0 };
    let ended = EventKind::Ended { id, command: "move", outcome: Outcome::Failed(failure) };
    let mut records = Vec::new();
    for index in 0..cycles {
        records.push(drive(index, 0));
        records.push(drive(index, 1));
        match index {
            1 => {
                let shown = [Some(0.5), None, None, None].into();
                records.push(Record::Monitor(MonitorRecord { index, axis: 1, shown }));
            }
            2 => records.extend([step(index, CommandStep::Taken), step(index, CommandStep::Begun)]),
            4 => records.push(Record::Event(EventRecord::new(index, 0, ended, None))),
            _ => {}
        }
        records.push(cycle(index));
    }
    records
}

fn written(records: &[Record]) -> Vec<u8> {
    let mut writer = Writer::new(Vec::new(), machine(), UTC_NS).unwrap();
    records.iter().for_each(|record| writer.enter(record).unwrap());
    let (from, to) = (BEGIN + 3 * MS, BEGIN + 4 * MS);
    let judged = Judged { index: 3, lateness: Lateness::Wake(500), from, to, cause: Cause::Drive(1) };
    writer.late(&judged).unwrap();
    writer.finish(11).unwrap()
}

/// A message: its topic, its time and its texts.
type Read = (String, u64, Vec<String>);

/// All messages, by topic and text.
fn messages(bytes: Vec<u8>) -> (Vec<Read>, Option<Wrong>) {
    let mut wrong = None;
    let entries = Reading::of(bytes).map_while(|entry| entry.map_err(|why| wrong = Some(why)).ok());
    let all =
        entries.map(|entry| (entry.topic.name.clone(), entry.utc_ns, entry.texts().collect())).collect();
    (all, wrong)
}

#[test]
fn every_record_is_a_message_at_the_instant_of_its_cycle() {
    let records = records(6);
    let (messages, wrong) = messages(written(&records));
    assert!(wrong.is_none(), "{wrong:?}");
    assert_eq!(messages.len(), records.len() + 1);
    let of = |topic: &str| -> Vec<(u64, Vec<&str>)> {
        let of_topic = messages.iter().filter(|(name, ..)| name == topic);
        of_topic.map(|(_, at, texts)| (*at, texts.iter().map(String::as_str).collect())).collect()
    };
    let instant = |index: u64| 1_000 * S + 5 * S + index * MS;
    let (x, y) = (of("/axes/x"), of("/axes/y"));
    assert_eq!((x.len(), y.len()), (6, 6));
    for (index, (at, texts)) in (0..).zip(&y) {
        assert_eq!(*at, instant(index));
        let own = (5 * S + index * MS).to_string();
        let [index, demand] = [index as f64, index as f64 + 0.25].map(|value| value.to_string());
        let begin =
            [&*index, &own, &index, &demand, "0.25", "2.5", "-1.5", "5", "OperationEnabled", "2", "online"];
        assert_eq!(texts[..11], begin);
        assert_eq!(texts[11..15], ["16", "command_of_its_group_failed", "4", "move"]);
        assert_eq!(texts[19..], ["2", "answered", "0", "0", "300", "0"]);
    }
    assert_eq!(x[0].1[11..13], ["0", "not_stopped"]);
    assert_eq!(of("/axes/y/monitors"), [(instant(1), vec!["1", "5001000000", "0.5", ""])]);
    let command = ["2", "5002000000", "0", "x", "3"];
    let [(at, taken), (_, begun)] = &of("/commands")[..] else { panic!("{messages:?}") };
    assert_eq!((*at, &taken[..5], &begun[..5]), (instant(2), &command[..], &command[..]));
    assert_eq!((&taken[5..7], &begun[5..7]), (&["0", "taken"][..], &["1", "begun"][..]));
    assert_eq!(begun[7..], ["4", "move", "1", "0", "-4", "1", "10", "20", "30", ""]);
    let [(at, ended)] = &of("/events")[..] else { panic!("{messages:?}") };
    assert_eq!((*at, &ended[2..5]), (instant(4), &["0", "x", "ended"][..]));
    assert!(ended[5].starts_with("failed: position 9 is outside its limit (0 ... 8)"), "{ended:?}");
    assert_eq!(ended[6..], ["0", "3", "move", "failed", "", "0"]);
    let late = ["3", "5003000000", "wake", "500", "drive", "", "y"];
    assert_eq!(of("/late"), [(instant(3), late.to_vec())]);
    let stages = ["10", "20", "30", "40", "50", "60"];
    assert_eq!(of("/cycle")[5].1[4..10], stages);
}

#[test]
fn a_bus_clock_that_leads_is_a_topic_of_its_own() {
    let silent = ReferenceRecord { index: 0, step_ns: 7, ..ReferenceRecord::default() };
    let locked = ReferenceRecord { index: 1, error_ns: Some(-250), step_ns: -3, locked: true, counts: true };
    let records = [Record::Reference(silent), cycle(0), Record::Reference(locked), cycle(1)];
    let (messages, wrong) = messages(written(&records));
    assert!(wrong.is_none(), "{wrong:?}");
    let of = messages.into_iter().filter(|(topic, ..)| topic == "/reference");
    let found: Vec<(u64, Vec<String>)> = of.map(|(_, at, texts)| (at, texts)).collect();
    let expected = [
        (1_005 * S, ["0", "5000000000", "0", "0", "7", "0"].map(str::to_owned).to_vec()),
        (1_005 * S + MS, ["1", "5001000000", "1", "-250", "-3", "1"].map(str::to_owned).to_vec()),
    ];
    assert_eq!(found, expected);
}

#[test]
fn a_recording_of_another_format_is_refused_and_one_of_none_is_read() {
    let of = |format: Option<&str>| {
        let mut machine = machine();
        machine.about.remove("format");
        machine.about.extend(format.map(|format| ("format".to_owned(), format.to_owned())));
        let mut writer = Writer::new(Vec::new(), machine, UTC_NS).unwrap();
        records(3).iter().for_each(|record| writer.enter(record).unwrap());
        messages(writer.finish(0).unwrap())
    };
    let (read, wrong) = of(Some("2\x1b"));
    let wrong = wrong.unwrap();
    assert!(read.is_empty() && wrong.is_all(), "{wrong}");
    let expected = "it was recorded by version 9 (format 2\\u{1b}): read it with that one, this is ";
    assert!(wrong.to_string().starts_with(expected), "{wrong}");
    assert_eq!(of(None).0, of(Some("1")).0);
    assert!(of(None).1.is_none());
}

#[test]
fn others_find_metadata_statistics_and_an_index_of_every_chunk() {
    let bytes = written(&records(2_500));
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let statistics = summary.stats.unwrap();
    assert_eq!(statistics.message_count, 3 * 2_500 + 5);
    // One each 50 ms; the cause of a late cycle came behind the last one.
    assert_eq!((statistics.chunk_count, summary.chunk_indexes.len()), (51, 51));
    let mut about = Vec::new();
    for index in &summary.metadata_indexes {
        about.push(mcap::read::metadata(&bytes, index).unwrap());
    }
    let [machine, end] = &about[..] else { panic!("{about:?}") };
    assert_eq!((&*machine.name, &*machine.metadata["period_ns"]), ("fieldbeat", "1000000"));
    assert_eq!((&*end.name, &*end.metadata["lost_records"]), ("fieldbeat end", "11"));
    let units = |topic: &str| {
        let channel = summary.channels.values().find(|channel| channel.topic == topic).unwrap();
        channel.metadata.clone()
    };
    assert_eq!(units("/axes/x")["unit_velocity"], "mm/s");
    assert_eq!(units("/axes/y/monitors")["demand-current"], "A");
}

/// Where each chunk begins, and where it ends with its index.
fn chunks(bytes: &[u8]) -> Vec<std::ops::Range<usize>> {
    let summary = mcap::Summary::read(bytes).unwrap().unwrap();
    let begin = |index: &mcap::records::ChunkIndex| index.chunk_start_offset as usize;
    let end = |index: &mcap::records::ChunkIndex| begin(index) + index.chunk_length as usize;
    summary.chunk_indexes.iter().map(|index| begin(index)..end(index)).collect()
}

/// The length of the records of all chunks, and when their messages begin and end.
fn spans(bytes: &[u8]) -> Vec<(u64, std::ops::RangeInclusive<u64>)> {
    let indexes = mcap::Summary::read(bytes).unwrap().unwrap().chunk_indexes;
    let span = |index: mcap::records::ChunkIndex| index.message_start_time..=index.message_end_time;
    indexes.into_iter().map(|index| (index.uncompressed_size, span(index))).collect()
}

#[test]
fn a_chunk_has_the_messages_of_50_ms_at_most() {
    let of_period = |period_ns: u64, slots: &mut dyn Iterator<Item = u64>| {
        let mut writer = Writer::new(Vec::new(), Machine { period_ns, ..machine() }, UTC_NS).unwrap();
        let mut slots = slots.peekable();
        while let Some(index) = slots.next() {
            let grid = BEGIN + index * period_ns;
            let record = CycleRecord { index, grid, ..CycleRecord::default() };
            [drive(index, 0), Record::Cycle(record)].iter().for_each(|record| writer.enter(record).unwrap());
            if let Some(count) = slots.peek().map(|next| next - index - 1).filter(|count| *count > 0) {
                let (first, grid) = (index + 1, grid + period_ns);
                let skipped = SkippedRecord { first, grid, count, ..SkippedRecord::default() };
                writer.enter(&Record::Skipped(skipped)).unwrap();
            }
        }
        spans(&writer.finish(0).unwrap())
    };
    for (period_ns, of_a_chunk) in [(MS / 4, 200), (MS, 50), (15 * MS, 4), (50 * MS, 1), (S, 1)] {
        let spans = of_period(period_ns, &mut (0..5 * of_a_chunk));
        assert_eq!(spans.len(), 5, "{period_ns}");
        for (chunk, (_, span)) in (0..).zip(spans) {
            let begin = 1_005 * S + chunk * of_a_chunk * period_ns;
            assert_eq!(span, begin..=begin + (of_a_chunk - 1) * period_ns);
        }
    }
    // Slots that are passed over.
    let spans = of_period(MS, &mut (0..2_000).filter(|index| index % 170 < 30));
    assert!(spans.iter().all(|(_, span)| span.end() - span.start() < 50 * MS), "{spans:?}");
}

#[test]
fn a_file_that_was_cut_anywhere_has_all_chunks_before_that_and_it_is_said() {
    let bytes = written(&records(260));
    let chunks = chunks(&bytes);
    let (whole, _) = messages(bytes.clone());
    let edges = chunks.iter().flat_map(|chunk| [chunk.start, chunk.start + 1, chunk.end - 1, chunk.end]);
    let anywhere = (0..bytes.len()).step_by(bytes.len() / 31);
    for length in edges.chain(anywhere).chain(chunks[1].clone().step_by(23)) {
        let (read, wrong) = messages(bytes[..length].to_vec());
        assert!(matches!(wrong, Some(Wrong::Cut | Wrong::Foreign)), "{length}: {wrong:?}");
        // A cycle of two axes: three messages. Command and events stand in the first chunk. The last 4 bytes of a
        // chunk say that its LZ4 ends, and may be missing.
        let of = |chunks: usize| if chunks > 0 { (150 * chunks + 4).min(whole.len()) } else { 0 };
        let [least, most] =
            [0, 4].map(|mark| of(chunks.iter().filter(|chunk| chunk.end - mark <= length).count()));
        assert!((least..=most).contains(&read.len()), "{length}: {} of {least} to {most}", read.len());
        assert_eq!(read[..], whole[..read.len()]);
    }
}

#[test]
fn a_changed_byte_is_damage_and_the_files_of_others_are_foreign() {
    let bytes = written(&records(175));
    let (whole, _) = messages(bytes.clone());
    let chunk = chunks(&bytes)[2].clone();
    // Behind the head of its LZ4, up to the mark of its end: the checksum of the chunk has the rest.
    for place in (chunk.start + 60..chunk.end - 4).step_by(19) {
        let mut bytes = bytes.clone();
        bytes[place] ^= 1;
        let (read, wrong) = messages(bytes);
        match wrong {
            // Nothing of the chunk.
            Some(Wrong::Damaged(why)) if why.contains("CRC") || why.contains("decompression") => {
                assert_eq!(read[..], whole[..304], "{place}");
            }
            // The same bytes stand in another place, too.
            Some(Wrong::Somewhere(_)) => assert_eq!(read, whole, "{place}"),
            other => panic!("{place}: {other:?}"),
        }
    }
    for foreign in [&b""[..], b"PNG", &[0; 1_000]] {
        let (read, wrong) = messages(foreign.to_vec());
        assert!(read.is_empty() && wrong.is_some_and(|why| why.is_all() || matches!(why, Wrong::Cut)));
    }
    let mut others = mcap::Writer::new(std::io::Cursor::new(Vec::new())).unwrap();
    let channel = others.add_channel(0, "/chat", "json", &Default::default()).unwrap();
    let header =
        mcap::records::MessageHeader { channel_id: channel, sequence: 0, log_time: 0, publish_time: 0 };
    others.write_to_known_channel(&header, b"{}").unwrap();
    others.finish().unwrap();
    let (read, wrong) = messages(others.into_inner().into_inner());
    assert!(read.is_empty() && matches!(wrong, Some(Wrong::Foreign)), "{wrong:?}");
}

#[test]
fn records_without_that_of_their_cycle_are_written_by_the_one_before() {
    let lost: Vec<Record> = (0..40_000).map(|index| drive(index / 2, (index % 2) as u16)).collect();
    let all: Vec<Record> = [cycle(0)].into_iter().chain(lost).collect();
    let (read, wrong) = messages(written(&all));
    assert!(wrong.is_none() && read.len() == all.len() + 1, "{}", read.len());
    let skipped = SkippedRecord { first: 9, grid: BEGIN + 9 * MS, count: 2, ..SkippedRecord::default() };
    let (read, _) = messages(written(&[drive(8, 0), Record::Skipped(skipped)]));
    assert_eq!(read[0].1, 1_000 * S + 5 * S + 8 * MS, "a period before the one that is known");
}

#[test]
fn tables_have_their_units_and_a_row_a_message() {
    let bytes = written(&records(6));
    let directory = tempfile::tempdir().unwrap();
    let mut tables = PerTopic::new(directory.path()).unwrap();
    let mut out = Vec::new();
    let mut wide = Wide::new(&mut out);
    for entry in Reading::of(bytes) {
        let entry = entry.unwrap();
        tables.enter(&entry).unwrap();
        wide.enter(&entry).unwrap();
    }
    wide.finish().unwrap();
    assert_eq!(tables.finish().unwrap(), 7);
    let table = std::fs::read_to_string(directory.path().join("axes_y_monitors.csv")).unwrap();
    assert_eq!(
        table,
        "time [s],cycle,monotonic_ns,demand_current [A],v0x1E10\n0.001000000,1,5001000000,0.5,\n"
    );
    let table = std::fs::read_to_string(directory.path().join("cycle.csv")).unwrap();
    assert_eq!(table.lines().count(), 7);
    let text = String::from_utf8(out).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 7);
    assert!(lines[0].starts_with("time [s],cycle,x.position [mm],x.demand [mm],x.following_error [mm],"));
    assert_eq!(
        lines[6],
        "0.005000000,5,5,5.25,0.25,2.5,-1.5,OperationEnabled,0,5,5.25,0.25,2.5,-1.5,OperationEnabled,0"
    );
}

#[test]
fn topics_of_axes_with_unlucky_names_have_tables_of_their_own() {
    let mut machine = machine();
    machine.axes[0].name = "y_monitors".to_owned();
    let mut writer = Writer::new(Vec::new(), machine, UTC_NS).unwrap();
    records(6).iter().for_each(|record| writer.enter(record).unwrap());
    let directory = tempfile::tempdir().unwrap();
    let mut tables = PerTopic::new(directory.path()).unwrap();
    for entry in Reading::of(writer.finish(0).unwrap()) {
        tables.enter(&entry.unwrap()).unwrap();
    }
    assert_eq!(tables.finish().unwrap(), 6);
    let lines = |name: &str| std::fs::read_to_string(directory.path().join(name)).unwrap().lines().count();
    assert_eq!([lines("axes_y_monitors.csv"), lines("axes_y_monitors.2.csv")], [7, 2]);
}

#[test]
fn bytes_written_to_a_full_disk_are_lost() {
    for cycles in [5, 1_500] {
        let file = OpenOptions::new().write(true).open("/dev/full").unwrap();
        // Were it removed, nothing would be.
        let file = NamedTempFile::from_parts(file, TempPath::try_from_path("/dev/none/x").unwrap());
        let mut whole = Whole::new(file, "/dev/full".into(), machine(), None);
        whole.begin(UTC_NS);
        let records = records(cycles);
        records.iter().for_each(|record| whole.enter(record));
        whole.look(3);
        let [recorded] = &whole.finish()[..] else { panic!() };
        assert!(recorded.error.is_some(), "{recorded:?}");
        assert_eq!((recorded.messages, recorded.lost), (0, 3 + records.len() as u64));
    }
}

/// A loop that wakes too late for its first slots, twice, has records before its first executed cycle.
#[test]
fn a_requested_file_has_an_executed_cycle_however_many_were_skipped() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    let mut window = Window::new(path, machine(), Failures::of_names(&["x", "y"]), 50);
    let skipped = |first| Record::Skipped(SkippedRecord { first, count: 5, ..SkippedRecord::default() });
    let executed = |index| Record::Cycle(CycleRecord { index, ..CycleRecord::default() });
    let files = || std::fs::read_dir(directory.path()).unwrap().count();
    window.begin(0);
    window.request();
    for record in [skipped(0), skipped(5)] {
        window.enter(&record);
    }
    assert_eq!(files(), 0);
    window.enter(&executed(10));
    assert_eq!(files(), 1);
    // Of a loop that was held up for longer than the window, it is the last one before that.
    for record in [skipped(11), skipped(10_000)] {
        window.enter(&record);
    }
    window.request();
    let written = window.finish();
    let all: Vec<_> = written.iter().map(|one| (one.why.as_str(), one.messages)).collect();
    assert_eq!(all, [("requested", 3), ("requested", 3), ("end of the run", 3)]);
}

#[test]
fn a_short_window_has_the_failure_itself_in_its_file() {
    let directory = tempfile::tempdir().unwrap();
    let mut window =
        Window::new(directory.path().join("x.mcap"), machine(), Failures::of_names(&["x", "y"]), 50);
    window.begin(UTC_NS);
    // The second axis is stopped from cycle 0 on. Some records of that cycle are lost.
    assert_eq!(window.look(7), None);
    records(400).iter().for_each(|record| window.enter(record));
    assert_eq!(window.look(7), None);
    let written = window.finish();
    assert_eq!([written[0].lost, written[1].lost], [7, 0], "the file of the end begins later");
    assert_eq!(written[0].path, directory.path().join("x-cycle-0.mcap"));
    let (read, wrong) = messages(std::fs::read(&written[0].path).unwrap());
    assert!(wrong.is_none(), "{wrong:?}");
    assert_eq!(read[0].2[0], "0", "the first cycle");
}

/// A machine whose second axis has native process data: the first byte of the inputs, and the fourth of the outputs.
fn native_machine() -> Machine {
    let mut machine = machine();
    let byte = |name: &str, place: usize| {
        NativeField::new(name, move |bytes: &[u8]| Some((*bytes.get(place)?).into()))
    };
    let (inputs, outputs) = (vec![byte("status-word", 0)], vec![byte("6040", 3)]);
    machine.axes[1].native = Some(NativeLayout { inputs, outputs, most: 255 });
    machine
}

/// Records of so many bytes of inputs, and of outputs, in a cycle, in as many parts as they take.
fn native(index: u64, inputs: u16, outputs: u16) -> Vec<Record> {
    let total = inputs + outputs;
    let all: Vec<u8> = (1..=total).map(|byte| byte as u8).collect();
    let part = |(place, part): (usize, &[u8])| {
        let mut bytes = [0; NativeRecord::PART];
        bytes[..part.len()].copy_from_slice(part);
        let offset = (place * NativeRecord::PART) as u16;
        Record::Native(NativeRecord { index, received_ns: 600, axis: 1, total, inputs, offset, bytes })
    };
    all.chunks(NativeRecord::PART).enumerate().map(part).collect()
}

/// The messages with native process data in these records, as texts, and how many records were dropped.
fn natives(records: &[Record]) -> (Vec<Vec<String>>, u64) {
    let mut writer = Writer::new(Vec::new(), native_machine(), UTC_NS).unwrap();
    records.iter().for_each(|record| writer.enter(record).unwrap());
    let dropped = writer.dropped();
    let (read, wrong) = messages(writer.finish(dropped).unwrap());
    assert!(wrong.is_none(), "{wrong:?}");
    let native = read.into_iter().filter(|(topic, ..)| topic == "/axes/y/native");
    (native.map(|(.., texts)| texts).collect(), dropped)
}

fn hex(bytes: std::ops::RangeInclusive<u8>) -> String {
    bytes.map(|byte| format!("{byte:02x}")).collect()
}

#[test]
fn native_process_data_stand_in_the_file_whole_in_however_many_parts_they_came() {
    let at = |ns: u64| (BEGIN.0 + ns).to_string();
    for (inputs, outputs) in [(4, 4), (40, 4), (44, 4), (44, 44), (100, 60)] {
        let mut records = native(7, inputs, outputs);
        assert_eq!(records.len(), usize::from(inputs + outputs).div_ceil(NativeRecord::PART));
        records.push(cycle(7));
        let all = inputs as u8..=(inputs + outputs) as u8;
        let expected = [
            "7".to_owned(),
            at(7 * MS),
            at(7 * MS + 600),
            hex(1..=*all.start()),
            hex(all.start() + 1..=*all.end()),
            "1".to_owned(),
            (all.start() + 4).to_string(),
        ];
        assert_eq!(natives(&records), (vec![expected.to_vec()], 0), "{inputs} {outputs}");
    }
    // Only outputs, only inputs: what was not received has no time, and what is not there no number.
    let mut records = native(7, 0, 4);
    records.extend(native(7, 2, 0));
    records.push(cycle(7));
    let (read, dropped) = natives(&records);
    let texts: Vec<&[String]> = read.iter().map(|texts| &texts[2..]).collect();
    assert_eq!(texts[0], ["0", "", &hex(1..=4), "", "4"]);
    assert_eq!(
        (texts[1], dropped),
        (&[at(7 * MS + 600), hex(1..=2), "".into(), "1".into(), "".into()][..], 0)
    );
}

#[test]
fn native_process_data_of_which_a_part_is_lost_are_dropped_and_counted() {
    let whole = native(7, 100, 60);
    for lost in 0..whole.len() {
        let mut records = whole.clone();
        records.remove(lost);
        records.extend([vec![cycle(7)], native(8, 100, 60), vec![cycle(8)]].concat());
        let (read, dropped) = natives(&records);
        // The next ones are whole again.
        assert_eq!((read.len(), read[0][0].as_str(), dropped), (1, "8", whole.len() as u64 - 1), "{lost}");
    }
    // Of two cycles, or of two replies in one, parts that would fit together by their place.
    let mut later = whole.clone();
    for record in &mut later {
        let Record::Native(part) = record else { panic!() };
        part.received_ns += 1;
    }
    for others in [native(8, 100, 60), later] {
        let records: Vec<Record> = [&whole[..2], &others[2..], &[cycle(8)]].concat();
        assert_eq!(natives(&records), (Vec::new(), 4));
    }
}

/// A file at `path`, as of a recorder.
fn new_file(path: &Path) -> NamedTempFile {
    NamedTempFile::from_parts(File::create_new(path).unwrap(), TempPath::try_from_path(path).unwrap())
}

#[test]
fn a_recording_says_how_many_records_were_dropped() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    let mut whole = Whole::new(new_file(&path), path, native_machine(), None);
    whole.begin(UTC_NS);
    let records: Vec<Record> = [&native(7, 100, 60)[1..], &[cycle(7)]].concat();
    records.iter().for_each(|record| whole.enter(record));
    let reported = whole.look(1).unwrap();
    assert!(reported.contains("records are missing, since its disk or this host was too slow"), "{reported}");
    assert_eq!(whole.look(2), None, "once");
    let [recorded] = &whole.finish()[..] else { panic!() };
    assert_eq!((recorded.lost, &recorded.error, recorded.failure()), (2 + 3, &None, Some(reported)));
}
