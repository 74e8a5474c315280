//! A recording that was changed: its replay says so.

use fieldbeat_replay::{LogEnd, Replay};
use fieldbeat_testing::runs::damage::mutations;

/// The record of a failure in the field, changed.
#[test]
fn any_change_of_a_file_is_reported_by_its_replay() {
    let record = std::fs::read("../../tests/records/lost.mcap").unwrap();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    let repeated = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        let mut replay = Replay::open(&path).unwrap();
        let verdict = replay.run();
        // Without a cycle the loop finds nothing that it looks for.
        assert!(verdict.is_equal() || verdict.last.is_none(), "{verdict:?}");
        (verdict.last, replay.log_end())
    };
    let (last, end) = repeated(&record);
    assert_eq!(end, LogEnd::Whole);
    for (what, bytes) in mutations(&record) {
        let (before, end) = repeated(&bytes);
        assert!(matches!(end, LogEnd::Broken(_)) && before <= last, "{what}: {before:?}, {end:?}");
    }
}
