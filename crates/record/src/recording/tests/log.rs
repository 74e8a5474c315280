//! The log of the loop in a recording: cut, and on a disk that is full.

use std::fs::{File, OpenOptions};
use std::path::Path;

use tempfile::{NamedTempFile, TempPath};

use super::{UTC_NS, machine, messages, records};
use crate::log::layout::{CUT_AT, END};
use crate::recording::whole::Whole;
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::inputs::entry::Kind;
use fieldbeat_core::inputs::recording::{Recording, log};
use fieldbeat_core::logged::LinkTap;
use fieldbeat_core::rt::Regions;
use fieldbeat_telemetry::log::{LogBegin, MachineOf};
use fieldbeat_telemetry::sink::{Sink, WireSummary};

/// A recording to the file at `path`, with a log that has room for 16 words.
fn with_log(path: &Path, file: File) -> (Whole, Recording) {
    let (recording, reader) = log(16, &mut Regions::default());
    let (sender, receiver) = crossbeam_channel::bounded(1);
    sender
        .send(LogBegin {
            reader,
            link: LinkTap::default(),
            machine: MachineOf::Code,
            plan: String::new(),
            has_task: false,
        })
        .unwrap();
    let file = NamedTempFile::from_parts(file, TempPath::try_from_path(path).unwrap());
    (Whole::new(file, path.to_owned(), machine(), Some(receiver)), recording)
}

/// Logs a cycle, which takes 9 words.
fn log_cycle(recording: &Recording, index: u64) {
    recording.cycle(index);
    recording.entry(Kind::Value, &[index; 6], &[]);
    recording.publish();
}

#[test]
fn a_log_for_which_there_was_no_room_is_cut_and_the_recording_goes_on() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    let (mut whole, recording) = with_log(&path, File::create_new(&path).unwrap());
    whole.begin(UTC_NS);
    records(5).iter().for_each(|record| whole.enter(record));
    log_cycle(&recording, 0);
    assert_eq!(whole.look(0), None);
    log_cycle(&recording, 1);
    // Nobody has looked meanwhile.
    log_cycle(&recording, 2);
    let reported = whole.look(0).unwrap();
    assert!(
        reported.contains("a replay ends before cycle 2, since ") && reported.contains("another disk"),
        "{reported}"
    );
    log_cycle(&recording, 3);
    records(8).iter().skip(16).for_each(|record| whole.enter(record));
    assert_eq!(whole.look(0), None, "once");
    let [recorded] = &whole.finish()[..] else { panic!("one file") };
    let wire = recorded.wire.unwrap();
    assert_eq!((wire.cut_at, wire.bytes), (Some(2), 2 * 9 * 8));
    assert_eq!(recorded.failure().unwrap(), reported);
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(bytes.len() as u64, recorded.bytes);
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let end = summary.metadata_indexes.iter().find(|index| index.name == END).unwrap();
    let end = mcap::read::metadata(&bytes, end).unwrap();
    assert_eq!(end.metadata[CUT_AT], "2");
    let (read, wrong) = messages(bytes);
    assert!(wrong.is_none() && read.len() as u64 == recorded.messages, "{wrong:?}");
}

#[test]
fn a_full_disk_ends_the_log_too_and_is_reported_once() {
    let file = OpenOptions::new().write(true).open("/dev/full").unwrap();
    // Were it removed, nothing would be.
    let (mut whole, recording) = with_log(Path::new("/dev/none/x"), file);
    whole.begin(UTC_NS);
    let reported: Vec<String> = (records(2_500).iter())
        .filter_map(|record| {
            whole.enter(record);
            if let Record::Cycle(cycle) = record {
                log_cycle(&recording, cycle.index);
            }
            whole.look(0)
        })
        .collect();
    let [reported] = &reported[..] else { panic!("{reported:?}") };
    assert!(
        reported.contains("No space left on device") && reported.contains("free that disk"),
        "{reported}"
    );
    let [recorded] = &whole.finish()[..] else { panic!("one file") };
    assert_eq!(recorded.wire.unwrap(), WireSummary::default());
    assert_eq!((recorded.messages, recorded.failure().as_ref()), (0, Some(reported)));
}
