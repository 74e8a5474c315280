//! Damage that the checksums of the chunks do not find: around them, or of whole chunks.

use mcap::MAGIC;
use mcap::records::op;

use super::{cycle, drive, messages, written};
use crate::cycle::record::Record;
use crate::telemetry::recording::reading::Wrong;

/// The opcode of a record and its content.
type Raw = (u8, Vec<u8>);

/// Some messages in three chunks, of a second each.
fn recording() -> Vec<u8> {
    let records = (0..28).map(|place| 100 * place).flat_map(|index| [drive(index, 0), cycle(index)]);
    written(&records.collect::<Vec<Record>>())
}

/// The records of a whole file.
fn split(bytes: &[u8]) -> Vec<Raw> {
    let mut rest = bytes.strip_prefix(MAGIC).unwrap().strip_suffix(MAGIC).unwrap();
    let mut all = Vec::new();
    while let Some((&[opcode, ref length @ ..], behind)) = rest.split_first_chunk::<9>() {
        let (content, next) = behind.split_at(u64::from_le_bytes(*length) as usize);
        all.push((opcode, content.to_vec()));
        rest = next;
    }
    all
}

fn joined(records: &[Raw]) -> Vec<u8> {
    let records = records.iter().map(|(opcode, content)| {
        [&[*opcode][..], &(content.len() as u64).to_le_bytes(), &content[..]].concat()
    });
    [MAGIC.to_vec(), records.collect::<Vec<_>>().concat(), MAGIC.to_vec()].concat()
}

/// As other tools write it: a checksum of 0 is none.
fn without_checksums(all: &mut [Raw]) {
    all.iter_mut().filter(|(opcode, _)| *opcode == op::DATA_END).for_each(|(_, content)| content.fill(0));
    all.last_mut().unwrap().1[16..].fill(0);
}

/// What is changed, and the file. It has some chunks.
fn mutations(bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
    let whole = split(bytes);
    assert_eq!(joined(&whole), bytes);
    let places = |of: u8| -> Vec<usize> {
        let all = whole.iter().enumerate();
        all.filter(|(_, (opcode, _))| *opcode == of).map(|(place, _)| place).collect()
    };
    let chunks = places(op::CHUNK);
    let [end, statistics] = [op::DATA_END, op::STATISTICS].map(|of| places(of)[0]);
    let mut all = Vec::new();
    let mut add = |what: String, change: &dyn Fn(&mut Vec<Raw>)| {
        let mut records = whole.clone();
        change(&mut records);
        all.push((what, joined(&records)));
    };
    for (number, &chunk) in chunks.iter().enumerate() {
        for bit in 0..8 {
            add(format!("bit {bit} of the opcode of chunk {number}"), &|all| all[chunk].0 ^= 1 << bit);
        }
        add(format!("chunk {number} is missing"), &|all| drop(all.remove(chunk)));
        add(format!("chunk {number} is there twice"), &|all| all.insert(chunk, all[chunk].clone()));
        for (opcode, length) in [(op::DATA_END, 4), (op::FOOTER, 20)] {
            add(format!("{opcode} before chunk {number}"), &|all| {
                all.insert(chunk, (opcode, vec![0; length]))
            });
        }
        // Begin and end of its messages: no checksum of its own has them.
        add(format!("a time of chunk {number}"), &|all| all[chunk].1[0] ^= 1);
        let unknown = (0x80, b"of somebody else".to_vec());
        add(format!("one more record before chunk {number}"), &|all| all.insert(chunk, unknown.clone()));
    }
    for pair in chunks.windows(2) {
        add(format!("chunks {pair:?} are swapped"), &|all| all.swap(pair[0], pair[1]));
    }
    add("the checksum of the data".into(), &|all| all[end].1[0] ^= 1);
    add("no end of the data".into(), &|all| drop(all.remove(end)));
    add("two ends of the data".into(), &|all| all.insert(end, all[end].clone()));
    add("the count of messages".into(), &|all| all[statistics].1[0] ^= 1);
    add("the count of messages, without checksums".into(), &|all| {
        all[statistics].1[0] ^= 1;
        without_checksums(all);
    });
    for missing in chunks {
        add(format!("chunk {missing} is missing, without checksums"), &|all| {
            without_checksums(all);
            all.remove(missing);
        });
    }
    let mut bytes = bytes.to_vec();
    *bytes.last_mut().unwrap() ^= 1;
    all.push(("the mark at the end".into(), bytes.clone()));
    *bytes.last_mut().unwrap() ^= 1;
    bytes.extend(MAGIC);
    all.push(("bytes behind the end".into(), bytes));
    all
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

/// The record of a failure in the field, changed.
#[cfg(feature = "replay")]
#[test]
fn whatever_is_changed_in_a_file_its_replay_says_so() {
    use crate::replay::{LogEnd, Replay};

    let record = std::fs::read("tests/records/lost.mcap").unwrap();
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
