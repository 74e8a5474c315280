//! Curves and command table entries, block by block, and their copies in flash.

use super::*;

const WRONG_SIZE: u8 = Refusal::WrongSize as u8;
const ADD: [u8; 3] = [C::ADD_CURVE, C::ADD_CURVE_INFO, C::ADD_CURVE_DATA];
const MODIFY: [u8; 3] = [C::MODIFY_CURVE, C::MODIFY_CURVE_INFO, C::MODIFY_CURVE_DATA];

/// A curve in bytes.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Curve {
    id: u16,
    info: Vec<u8>,
    data: Vec<u8>,
}

/// A time curve of one second through these setpoints.
pub(super) fn curve(id: u16, setpoints: &[i32]) -> Curve {
    let mut info = Vec::new();
    // Offset of the data, time curve, setpoints, bytes of each.
    [70, 0x0003, setpoints.len() as u16, 4].iter().for_each(|word| info.extend(word.to_le_bytes()));
    info.extend(b"test\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0");
    info.extend(id.to_le_bytes());
    info.extend(100_000_u32.to_le_bytes());
    // Time, position; the wizard.
    [26_u16, 5, 3].iter().for_each(|word| info.extend(word.to_le_bytes()));
    (1..=7_u32).for_each(|parameter| info.extend(parameter.to_le_bytes()));
    Curve { id, info, data: setpoints.iter().flat_map(|setpoint| setpoint.to_le_bytes()).collect() }
}

/// A command table entry in bytes.
pub(super) fn entry(command: Motion, next: Option<u16>) -> [u8; 64] {
    let mut bytes = [0; 64];
    let words = [0xA701, next.unwrap_or(0xFFFF), command.header].map(u16::to_le_bytes);
    bytes[..6].copy_from_slice(words.as_flattened());
    bytes[6..36].copy_from_slice(&command.parameters);
    bytes[38..42].copy_from_slice(b"test");
    bytes
}

impl Bench {
    /// Sends blocks of four bytes; each is echoed, with 04h while more are to come. Returns the status of the last one.
    fn send(&mut self, code: u8, index: u16, bytes: &[u8]) -> u8 {
        let mut last = channel::BLOCK_NOT_FINISHED;
        for (n, chunk) in bytes.chunks(4).enumerate() {
            let byte = |at| u16::from(chunk.get(at).copied().unwrap_or_default());
            let words = [index, byte(0) | byte(1) << 8, byte(2) | byte(3) << 8];
            assert_eq!(last, channel::BLOCK_NOT_FINISHED, "block {n} of {code:02X}h");
            let (status, echo) = self.rtc(code, words);
            if status >= 0xC0 {
                return status;
            }
            assert_eq!(echo, words);
            last = status;
        }
        last
    }

    /// Takes `size` bytes in blocks.
    fn fetch(&mut self, code: u8, index: u16, size: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        while bytes.len() < size {
            let (status, [echo, low, high]) = self.rtc(code, [index, 0, 0]);
            bytes.extend([low.to_le_bytes(), high.to_le_bytes()].concat());
            let expected = if bytes.len() < size { channel::BLOCK_NOT_FINISHED } else { DONE };
            assert_eq!((status, echo), (expected, index), "{code:02X}h");
        }
        bytes.truncate(size);
        bytes
    }

    fn transfer(&mut self, [begin, info, data]: [u8; 3], curve: &Curve) -> u8 {
        let sizes = [curve.id, 70, curve.data.len() as u16];
        let (status, echo) = self.rtc(begin, sizes);
        if status != DONE {
            return status;
        }
        assert_eq!(echo, sizes);
        assert_eq!(self.send(info, curve.id, &curve.info), DONE);
        self.send(data, curve.id, &curve.data)
    }

    pub(super) fn add_curve(&mut self, curve: &Curve) -> u8 {
        self.transfer(ADD, curve)
    }

    fn get_curve(&mut self, id: u16) -> Option<Curve> {
        let (status, [echo, info, data]) = self.rtc(C::GET_CURVE, [id, 0, 0]);
        if status == Refusal::CurveDefinition as u8 {
            return None;
        }
        assert_eq!((status, echo, info), (DONE, id, 70));
        let info = self.fetch(C::GET_CURVE_INFO, id, 70);
        Some(Curve { id, info, data: self.fetch(C::GET_CURVE_DATA, id, data.into()) })
    }

    pub(super) fn put_entry(&mut self, id: u16, entry: &[u8; 64]) -> u8 {
        let (status, _) = self.rtc(C::WRITE_ENTRY, [id, 64, 0]);
        if status == DONE { self.send(C::WRITE_ENTRY_DATA, id, entry) } else { status }
    }

    fn get_entry(&mut self, id: u16) -> Option<Vec<u8>> {
        let (status, [_, size, _]) = self.rtc(C::GET_ENTRY, [id, 0, 0]);
        (status == DONE).then(|| self.fetch(C::GET_ENTRY_DATA, id, size.into()))
    }
}

#[test]
fn a_curve_goes_there_and_comes_back_to_the_byte() {
    let mut bench = Bench::new(|_| {});
    for (id, count) in [(1, 2), (100, 1_000)] {
        let curve = curve(id, &Vec::from_iter((0..count).map(|n| n * 12_345 - 7)));
        assert_eq!((bench.get_curve(id), bench.add_curve(&curve)), (None, DONE));
        assert_eq!(bench.get_curve(id), Some(curve));
    }
    // Modified, also in its size; the other one stays.
    let other = curve(1, &[5, 6, 7]);
    assert_eq!(bench.transfer(MODIFY, &other), DONE);
    assert_eq!(bench.get_curve(1), Some(other));
    assert!(bench.get_curve(100).is_some());
    bench.rtc(C::DELETE_CURVES, [0; 3]);
    assert_eq!((bench.get_curve(1), bench.get_curve(100)), (None, None));
    // Bytes that no master would send come back, too: the drive does not read names.
    let mut odd = curve(7, &[1, 2]);
    odd.info[20] = 0xA5;
    assert_eq!(bench.add_curve(&odd), DONE);
    assert_eq!(bench.get_curve(7), Some(odd));
}

#[test]
fn curves_and_entries_are_refused_for_id_size_and_presence() {
    use Refusal::{CurveDefinition, OddAddress, OutOfRange, WrongSize};
    let mut bench = Bench::new(|_| {});
    bench.add_curve(&curve(5, &[1, 2]));
    for (code, words, refusal) in [
        (C::ADD_CURVE, [0, 70, 8], OutOfRange),
        (C::ADD_CURVE, [101, 70, 8], OutOfRange),
        (C::ADD_CURVE, [1, 71, 8], OddAddress),
        (C::ADD_CURVE, [1, 70, 9], OddAddress),
        (C::ADD_CURVE, [1, 72, 8], WrongSize),
        (C::ADD_CURVE, [1, 70, 10], WrongSize),
        (C::ADD_CURVE, [1, 70, 4], WrongSize),
        (C::ADD_CURVE, [5, 70, 8], CurveDefinition),
        (C::MODIFY_CURVE, [1, 70, 8], CurveDefinition),
        (C::GET_CURVE, [1, 0, 0], CurveDefinition),
        (C::WRITE_ENTRY, [0, 64, 0], WrongSize),
        (C::WRITE_ENTRY, [256, 64, 0], WrongSize),
        (C::WRITE_ENTRY, [1, 63, 0], OddAddress),
        (C::WRITE_ENTRY, [1, 62, 0], WrongSize),
        (C::DELETE_ENTRY, [0, 0, 0], WrongSize),
    ] {
        assert_eq!(bench.rtc(code, words), (refusal as u8, [words[0], 0, 0]), "{code:02X}h {words:?}");
    }
    // Two of 64 kB fit into the storage with what is there only if they are a little smaller.
    let large = vec![0; 16_383];
    assert_eq!(bench.add_curve(&curve(1, &large)), DONE);
    assert_eq!(bench.add_curve(&curve(2, &large)), WRONG_SIZE);
    assert_eq!(bench.add_curve(&curve(2, &large[..16_000])), DONE);
    // Another one in the place of the same size does fit.
    assert_eq!(bench.transfer(MODIFY, &curve(1, &large)), DONE);
}

#[test]
fn a_block_out_of_turn_ends_the_transfer() {
    let Curve { info, data, .. } = &curve(5, &[1, 2]);
    let started = |with: &[u8]| {
        let mut bench = Bench::new(|_| {});
        bench.rtc(C::ADD_CURVE, [5, 70, 8]);
        assert!(with.is_empty() || bench.send(C::ADD_CURVE_INFO, 5, with) == DONE);
        bench
    };
    // Data before the info block.
    let mut bench = started(&[]);
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, data), WRONG_SIZE);
    assert_eq!(bench.send(C::ADD_CURVE_INFO, 5, info), WRONG_SIZE);
    // More of the info block than there is; the commands of a modification; another curve.
    for (code, index) in [(C::ADD_CURVE_INFO, 5), (C::MODIFY_CURVE_DATA, 5), (C::ADD_CURVE_DATA, 6)] {
        let mut bench = started(info);
        assert_eq!(bench.send(code, index, data), WRONG_SIZE, "{code:02X}h");
        assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, data), WRONG_SIZE);
        assert_eq!(bench.get_curve(5), None);
    }
    // Another curve begun in between.
    let mut bench = started(info);
    assert_eq!(bench.add_curve(&curve(6, &[3, 4])), DONE);
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, data), WRONG_SIZE);
    // Other commands in between do no harm; the last block twice is one too many.
    let mut bench = started(info);
    assert_eq!(bench.value(C::READ_RAM, 0x20A8), 0x1E0F);
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, data), DONE);
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, data), WRONG_SIZE);
    assert_eq!(bench.get_curve(5), Some(curve(5, &[1, 2])));
    // An info block that contradicts the sizes or the id, or is none: size, type, setpoints, their size, id.
    for (at, value) in [(0, 71), (2, 4), (4, 3), (6, 2), (30, 6)] {
        let mut info = info.clone();
        info[at] = value;
        let mut bench = started(&info);
        assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, data), WRONG_SIZE, "{at}");
        assert_eq!(bench.get_curve(5), None);
    }
    // A restart in between, and reading out of turn.
    let mut bench = started(info);
    bench.restart();
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, data), WRONG_SIZE);
    bench.add_curve(&curve(5, &[1, 2]));
    bench.rtc(C::GET_CURVE, [5, 0, 0]);
    assert_eq!(bench.rtc(C::GET_CURVE_DATA, [5, 0, 0]).0, WRONG_SIZE);
    bench.fetch(C::GET_CURVE_INFO, 5, 70);
    assert_eq!(bench.rtc(C::GET_CURVE_INFO, [5, 0, 0]).0, WRONG_SIZE);
    assert_eq!(bench.rtc(C::GET_CURVE_DATA, [6, 0, 0]).0, WRONG_SIZE);
    bench.fetch(C::GET_CURVE_DATA, 5, 8);
    assert_eq!(bench.rtc(C::GET_CURVE_DATA, [5, 0, 0]).0, WRONG_SIZE);
}

#[test]
fn entries_go_there_and_come_back_and_the_presence_list_shows_them() {
    let mut bench = Bench::new(|_| {});
    let first = entry(go_to(CM, VAD), Some(255));
    let mut last = entry(motion(0x000, &[]), None);
    last[54..].fill(0xA5);
    assert_eq!((bench.put_entry(1, &first), bench.put_entry(255, &last)), (DONE, DONE));
    assert_eq!((bench.get_entry(1), bench.get_entry(255)), (Some(first.to_vec()), Some(last.to_vec())));
    assert_eq!(bench.get_entry(2), None);
    // A bit that is 0 is an entry that is used.
    for (group, bits) in [(0, !2), (1, u32::MAX), (6, u32::MAX), (7, u32::MAX >> 1)] {
        let (status, words) = bench.rtc(C::PRESENCE + group, [0; 3]);
        assert_eq!((status, words[0]), (DONE, u16::from(group) * 4));
        assert_eq!(block(0, 0, words).value(), bits, "group {group}");
    }
    // To be written again it has to be deleted; deleting what is not there is no mistake.
    assert_eq!(bench.put_entry(1, &last), WRONG_SIZE);
    for _ in 0..2 {
        assert_eq!(bench.rtc(C::DELETE_ENTRY, [1, 0, 0]), (DONE, [1, 0, 0]));
    }
    assert_eq!(bench.put_entry(1, &last), DONE);
    bench.rtc(C::DELETE_TABLE, [0; 3]);
    assert_eq!((bench.get_entry(1), bench.get_entry(255)), (None, None));
}

#[test]
fn the_blocks_of_an_entry_come_in_order_and_make_a_valid_one() {
    let mut bench = Bench::new(|_| {});
    let bytes = entry(go_to(CM, VAD), None);
    // Another entry in between; one block too many; another version.
    for (id, bytes, answers) in [
        (1, bytes, &[(2, WRONG_SIZE), (1, WRONG_SIZE)][..]),
        (1, bytes, &[(1, DONE), (1, WRONG_SIZE)]),
        (2, [0; 64], &[(2, WRONG_SIZE)]),
    ] {
        bench.rtc(C::WRITE_ENTRY, [id, 64, 0]);
        for (sent, answer) in answers {
            assert_eq!(bench.send(C::WRITE_ENTRY_DATA, *sent, &bytes), *answer);
        }
    }
    assert_eq!(bench.get_entry(2), None);
    bench.rtc(C::GET_ENTRY, [1, 0, 0]);
    assert_eq!(bench.rtc(C::GET_ENTRY_DATA, [2, 0, 0]).0, WRONG_SIZE);
    assert_eq!(bench.fetch(C::GET_ENTRY_DATA, 1, 64), bytes);
    assert_eq!(bench.rtc(C::GET_ENTRY_DATA, [1, 0, 0]).0, WRONG_SIZE);
}

#[test]
fn a_restart_in_a_save_leaves_nothing() {
    for save in [C::SAVE_CURVES, C::SAVE_TABLE] {
        let mut bench = Bench::new(|_| {});
        bench.add_curve(&curve(5, &[1, 2]));
        bench.put_entry(9, &entry(go_to(CM, VAD), None));
        assert_eq!(bench.rtc(C::STOP_SOFTWARE, [0; 3]).0, DONE);
        for code in [C::SAVE_CURVES, C::SAVE_TABLE] {
            assert_eq!(bench.write(code, 0, 0), DONE);
        }
        bench.rtc(save, [0; 3]);
        bench.wait(499 * MS);
        // Lost for good.
        for _ in 0..2 {
            bench.restart();
            let left = (bench.get_curve(5).is_some(), bench.get_entry(9).is_some());
            assert_eq!(left, (save != C::SAVE_CURVES, save != C::SAVE_TABLE));
        }
    }
}
