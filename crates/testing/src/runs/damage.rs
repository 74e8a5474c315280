//! Damage of recordings that the checksums of their chunks do not find: around them, or of whole chunks.

use mcap::MAGIC;
use mcap::records::op;

/// The opcode of a record and its content.
pub type Raw = (u8, Vec<u8>);

/// The records of a whole file.
pub fn split(bytes: &[u8]) -> Vec<Raw> {
    let mut rest = bytes.strip_prefix(MAGIC).unwrap().strip_suffix(MAGIC).unwrap();
    let mut all = Vec::new();
    while let Some((&[opcode, ref length @ ..], behind)) = rest.split_first_chunk::<9>() {
        let (content, next) = behind.split_at(u64::from_le_bytes(*length) as usize);
        all.push((opcode, content.to_vec()));
        rest = next;
    }
    all
}

/// The file of these records.
pub fn joined(records: &[Raw]) -> Vec<u8> {
    let records = records.iter().map(|(opcode, content)| {
        [&[*opcode][..], &(content.len() as u64).to_le_bytes(), &content[..]].concat()
    });
    [MAGIC.to_vec(), records.collect::<Vec<_>>().concat(), MAGIC.to_vec()].concat()
}

/// As other tools write it: a checksum of 0 is none.
pub fn without_checksums(all: &mut [Raw]) {
    all.iter_mut().filter(|(opcode, _)| *opcode == op::DATA_END).for_each(|(_, content)| content.fill(0));
    all.last_mut().unwrap().1[16..].fill(0);
}

/// The changes, and the changed file. It has some chunks.
pub fn mutations(bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
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
