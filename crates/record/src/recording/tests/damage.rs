//! Damage that the checksums of the chunks do not find: around them, or of whole chunks.

use fieldbeat_testing::runs::damage::{joined, mutations, split, without_checksums};
use mcap::records::op;

use super::{cycle, drive, messages, written};
use crate::recording::reading::Wrong;
use fieldbeat_core::cycle::record::Record;

/// Some messages in three chunks, of a second each.
fn recording() -> Vec<u8> {
    let records = (0..28).map(|place| 100 * place).flat_map(|index| [drive(index, 0), cycle(index)]);
    written(&records.collect::<Vec<Record>>())
}

#[test]
fn whatever_is_changed_in_a_file_its_export_says_so_and_has_no_other_messages() {
    let bytes = recording();
    let (whole, wrong) = messages(bytes.clone());
    assert!(wrong.is_none() && whole.len() == 2 * 28 + 1, "{wrong:?}");
    for (what, bytes) in mutations(&bytes) {
        let (read, wrong) = messages(bytes);
        match wrong {
            Some(Wrong::Damaged(_) | Wrong::Cut) => assert_eq!(read[..], whole[..read.len()], "{what}"),
            // A chunk may be missing before others.
            Some(Wrong::Somewhere(_)) => assert!(read.iter().all(|one| whole.contains(one)), "{what}"),
            wrong => panic!("{what}: {wrong:?}"),
        }
    }
}

#[test]
fn the_checksum_of_a_whole_file_finds_a_change_after_all_that_can_be_read_was_read() {
    let bytes = recording();
    let (whole, _) = messages(bytes.clone());
    let mut raw = split(&bytes);
    let last = raw.iter().rposition(|(opcode, _)| *opcode == op::CHUNK).unwrap();
    raw[last].0 ^= 0x80;
    let (read, wrong) = messages(joined(&raw));
    let Some(Wrong::Somewhere(why)) = wrong else { panic!("{wrong:?}") };
    // Two of three chunks.
    assert!(why.contains("CRC") && (40..45).contains(&read.len()), "{why}: {}", read.len());
    assert_eq!(read[..], whole[..read.len()]);
}

#[test]
fn files_without_checksums_or_a_summary_are_whole() {
    let bytes = recording();
    let (whole, _) = messages(bytes.clone());
    let mut raw = split(&bytes);
    without_checksums(&mut raw);
    for with_summary in [true, false] {
        if !with_summary {
            let end = raw.iter().position(|(opcode, _)| *opcode == op::DATA_END).unwrap();
            raw.truncate(end + 1);
            raw.push((op::FOOTER, vec![0; 20]));
        }
        let (read, wrong) = messages(joined(&raw));
        assert!(wrong.is_none() && read == whole, "{wrong:?}");
    }
}
