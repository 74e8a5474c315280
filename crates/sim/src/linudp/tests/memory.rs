//! Curves and command table entries, block by block, and what of them is in flash.

use super::*;
use fieldbeat_linudp::curve::{Curve, CurveKind, Dimension};
use fieldbeat_linudp::motion::EntryId;
use fieldbeat_linudp::table::Entry;

const MORE: RtcStatus = RtcStatus::BlockNotFinished;

/// A time curve of one second through these setpoints.
pub(super) fn curve(id: u16, setpoints: &[i32]) -> Curve {
    Curve {
        id,
        kind: CurveKind::Time,
        name: Curve::name_bytes("test").unwrap(),
        x_length: 100_000,
        x_dimension: Dimension::TIME,
        y_dimension: Dimension::POSITION,
        wizard: 3,
        wizard_parameters: [1, 2, 3, 4, 5, 6, 7],
        setpoints: setpoints.to_vec(),
    }
}

pub(super) fn entry(command: MotionCommand, next: Option<u16>) -> Entry {
    Entry::new("test", command, next.map(|id| EntryId::new(id).unwrap())).unwrap()
}

/// In blocks of four, the last one padded with zeros.
fn blocks(bytes: &[u8]) -> Vec<[u8; 4]> {
    let block = |chunk: &[u8]| std::array::from_fn(|at| chunk.get(at).copied().unwrap_or_default());
    bytes.chunks(4).map(block).collect()
}

impl Bench {
    /// Sends blocks; each is echoed, and 04h says that more are to come. The status of the last one.
    fn send(&mut self, command: C, index: u16, bytes: &[u8]) -> RtcStatus {
        let blocks = blocks(bytes);
        for (n, [a, b, c, d]) in blocks.iter().enumerate() {
            let words = [index, u16::from_le_bytes([*a, *b]), u16::from_le_bytes([*c, *d])];
            let (status, echo) = self.rtc(command, words);
            if n + 1 == blocks.len() || matches!(status, RtcStatus::Refused(_)) {
                return status;
            }
            assert_eq!((status, echo), (MORE, words), "block {n} of {command}");
        }
        unreachable!("no blocks")
    }

    /// Takes `size` bytes in blocks.
    fn fetch(&mut self, command: C, index: u16, size: usize) -> Vec<u8> {
        let count = size.div_ceil(4);
        let mut bytes = Vec::new();
        for n in 1..=count {
            let (status, [echo, low, high]) = self.rtc(command, [index, 0, 0]);
            let expected = if n < count { MORE } else { DONE };
            assert_eq!((status, echo), (expected, index), "block {n} of {command}");
            bytes.extend([low.to_le_bytes(), high.to_le_bytes()].concat());
        }
        bytes.truncate(size);
        bytes
    }

    fn transfer(&mut self, commands: [C; 3], curve: &Curve) -> RtcStatus {
        let (info, data) = curve.encode().unwrap();
        let sizes = [curve.id, 70, data.len() as u16];
        let (status, echo) = self.rtc(commands[0], sizes);
        if status != DONE {
            return status;
        }
        assert_eq!(echo, sizes);
        assert_eq!(self.send(commands[1], curve.id, &info), DONE);
        self.send(commands[2], curve.id, &data)
    }

    pub(super) fn add_curve(&mut self, curve: &Curve) -> RtcStatus {
        self.transfer([C::ADD_CURVE, C::ADD_CURVE_INFO, C::ADD_CURVE_DATA], curve)
    }

    fn modify_curve(&mut self, curve: &Curve) -> RtcStatus {
        self.transfer([C::MODIFY_CURVE, C::MODIFY_CURVE_INFO, C::MODIFY_CURVE_DATA], curve)
    }

    fn get_curve(&mut self, id: u16) -> Option<Curve> {
        let (status, [echo, info, data]) = self.rtc(C::GET_CURVE, [id, 0, 0]);
        if status == refused(Refusal::CurveDefinition) {
            return None;
        }
        assert_eq!((status, echo, info), (DONE, id, 70));
        let info = self.fetch(C::GET_CURVE_INFO, id, info.into());
        let data = self.fetch(C::GET_CURVE_DATA, id, data.into());
        Some(Curve::decode(&info, &data).unwrap())
    }

    pub(super) fn put_entry(&mut self, id: u16, entry: &Entry) -> RtcStatus {
        let (status, _) = self.rtc(C::WRITE_ENTRY, [id, 64, 0]);
        if status == DONE { self.send(C::WRITE_ENTRY_DATA, id, &entry.encode()) } else { status }
    }

    fn get_entry(&mut self, id: u16) -> Option<Entry> {
        let (status, [_, size, _]) = self.rtc(C::GET_ENTRY, [id, 0, 0]);
        if status != DONE {
            return None;
        }
        assert_eq!(size, 64);
        Some(Entry::decode(&self.fetch(C::GET_ENTRY_DATA, id, 64)).unwrap())
    }
}

#[test]
fn a_curve_goes_there_and_comes_back_to_the_byte() {
    let mut bench = Bench::new(|_| {});
    for (id, count) in [(1, 2), (100, 1_000)] {
        let setpoints: Vec<i32> = (0..count).map(|n| n * 12_345 - 7).collect();
        let curve = curve(id, &setpoints);
        assert_eq!(bench.get_curve(id), None);
        assert_eq!(bench.add_curve(&curve), DONE);
        assert_eq!(bench.get_curve(id), Some(curve));
    }
    // Modified, also in its size; the other one stays.
    let other = curve(1, &[5, 6, 7]);
    assert_eq!(bench.modify_curve(&other), DONE);
    assert_eq!(bench.get_curve(1), Some(other));
    assert!(bench.get_curve(100).is_some());
    bench.rtc(C::DELETE_CURVES, [0; 3]);
    assert_eq!((bench.get_curve(1), bench.get_curve(100)), (None, None));
    // Bytes that no master would send come back, too: the drive does not read names.
    let (mut info, data) = curve(7, &[1, 2]).encode().unwrap();
    info[20] = 0xA5;
    bench.rtc(C::ADD_CURVE, [7, 70, 8]);
    bench.send(C::ADD_CURVE_INFO, 7, &info);
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 7, &data), DONE);
    bench.rtc(C::GET_CURVE, [7, 0, 0]);
    assert_eq!(bench.fetch(C::GET_CURVE_INFO, 7, 70), info);
}

#[test]
fn curves_are_refused_for_id_size_and_presence() {
    let mut bench = Bench::new(|_| {});
    bench.add_curve(&curve(5, &[1, 2]));
    for (command, words, refusal) in [
        (C::ADD_CURVE, [0, 70, 8], Refusal::OutOfRange),
        (C::ADD_CURVE, [101, 70, 8], Refusal::OutOfRange),
        (C::ADD_CURVE, [1, 71, 8], Refusal::OddAddress),
        (C::ADD_CURVE, [1, 70, 9], Refusal::OddAddress),
        (C::ADD_CURVE, [1, 72, 8], Refusal::WrongSize),
        (C::ADD_CURVE, [1, 70, 10], Refusal::WrongSize),
        (C::ADD_CURVE, [1, 70, 4], Refusal::WrongSize),
        (C::ADD_CURVE, [5, 70, 8], Refusal::CurveDefinition),
        (C::MODIFY_CURVE, [1, 70, 8], Refusal::CurveDefinition),
        (C::GET_CURVE, [1, 0, 0], Refusal::CurveDefinition),
    ] {
        assert_eq!(bench.rtc(command, words), (refused(refusal), [words[0], 0, 0]), "{command} {words:?}");
    }
    // Two of 64 kB fit into the storage with what is there only if they are a little smaller.
    let large = vec![0; 16_383];
    assert_eq!(bench.add_curve(&curve(1, &large)), DONE);
    assert_eq!(bench.add_curve(&curve(2, &large)), refused(Refusal::WrongSize));
    assert_eq!(bench.add_curve(&curve(2, &large[..16_000])), DONE);
    // Another one in the place of the same size does fit.
    assert_eq!(bench.modify_curve(&curve(1, &large)), DONE);
}

#[test]
fn a_block_out_of_turn_ends_the_transfer() {
    let (info, data) = curve(5, &[1, 2]).encode().unwrap();
    let started = || {
        let mut bench = Bench::new(|_| {});
        bench.rtc(C::ADD_CURVE, [5, 70, 8]);
        bench
    };
    let wrong = refused(Refusal::WrongSize);
    // Data before the info block.
    let mut bench = started();
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, &data), wrong);
    assert_eq!(bench.send(C::ADD_CURVE_INFO, 5, &info), wrong);
    // More of the info block than there is; the commands of a modification; another curve.
    for (command, index) in [(C::ADD_CURVE_INFO, 5), (C::MODIFY_CURVE_DATA, 5), (C::ADD_CURVE_DATA, 6)] {
        let mut bench = started();
        assert_eq!(bench.send(C::ADD_CURVE_INFO, 5, &info), DONE);
        assert_eq!(bench.send(command, index, &data), wrong, "{command}");
        assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, &data), wrong);
        assert_eq!(bench.get_curve(5), None);
    }
    // Another curve begun in between.
    let mut bench = started();
    bench.send(C::ADD_CURVE_INFO, 5, &info);
    assert_eq!(bench.add_curve(&curve(6, &[3, 4])), DONE);
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, &data), wrong);
    // Other commands in between do no harm; the last block twice is one too many.
    let mut bench = started();
    bench.send(C::ADD_CURVE_INFO, 5, &info);
    assert_eq!(bench.value(C::READ_RAM, 0x20A8), 0x1E0F);
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, &data), DONE);
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, &data), wrong);
    assert_eq!(bench.get_curve(5), Some(curve(5, &[1, 2])));
    // An info block that says something else than was announced: id, setpoints.
    for (at, value) in [(30, 6), (4, 3), (0, 71)] {
        let mut bench = started();
        let mut info = info;
        info[at] = value;
        assert_eq!(bench.send(C::ADD_CURVE_INFO, 5, &info), DONE);
        assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, &data), wrong);
        assert_eq!(bench.get_curve(5), None);
    }
    // A restart in between, and reading out of turn.
    let mut bench = started();
    bench.send(C::ADD_CURVE_INFO, 5, &info);
    bench.sim.restart(bench.now);
    bench.config_count = 0;
    assert_eq!(bench.send(C::ADD_CURVE_DATA, 5, &data), wrong);
    bench.add_curve(&curve(5, &[1, 2]));
    bench.rtc(C::GET_CURVE, [5, 0, 0]);
    assert_eq!(bench.rtc(C::GET_CURVE_DATA, [5, 0, 0]).0, wrong);
    bench.fetch(C::GET_CURVE_INFO, 5, 70);
    assert_eq!(bench.rtc(C::GET_CURVE_INFO, [5, 0, 0]).0, wrong);
    assert_eq!(bench.rtc(C::GET_CURVE_DATA, [6, 0, 0]).0, wrong);
    bench.fetch(C::GET_CURVE_DATA, 5, 8);
    assert_eq!(bench.rtc(C::GET_CURVE_DATA, [5, 0, 0]).0, wrong);
}

#[test]
fn entries_go_there_and_come_back_and_the_presence_list_shows_them() {
    let mut bench = Bench::new(|_| {});
    let first = entry(go_to(CM, VAD), Some(255));
    let mut last = entry(MotionCommand::no_operation(), None);
    last.reserved = [0xA5; 10];
    assert_eq!((bench.put_entry(1, &first), bench.put_entry(255, &last)), (DONE, DONE));
    assert_eq!((bench.get_entry(1), bench.get_entry(255)), (Some(first), Some(last)));
    assert_eq!(bench.get_entry(2), None);
    // A bit that is 0 is an entry that is used.
    for (group, bits) in [(0, !2), (1, u32::MAX), (6, u32::MAX), (7, u32::MAX >> 1)] {
        let (status, [offset, low, high]) = bench.rtc(C(0x87 + group), [0; 3]);
        assert_eq!((status, offset), (DONE, u16::from(group) * 4));
        assert_eq!(u32::from(high) << 16 | u32::from(low), bits, "group {group}");
    }
    // To be written again it has to be deleted; deleting what is not there is no mistake.
    assert_eq!(bench.put_entry(1, &last), refused(Refusal::WrongSize));
    for _ in 0..2 {
        assert_eq!(bench.rtc(C::DELETE_ENTRY, [1, 0, 0]), (DONE, [1, 0, 0]));
    }
    assert_eq!(bench.put_entry(1, &last), DONE);
    bench.rtc(C::DELETE_TABLE, [0; 3]);
    assert_eq!((bench.get_entry(1), bench.get_entry(255)), (None, None));
}

#[test]
fn entries_are_refused_for_id_size_and_order() {
    let mut bench = Bench::new(|_| {});
    let bytes = entry(go_to(CM, VAD), None).encode();
    for (words, refusal) in [
        ([0, 64, 0], Refusal::WrongSize),
        ([256, 64, 0], Refusal::WrongSize),
        ([1, 63, 0], Refusal::OddAddress),
        ([1, 62, 0], Refusal::WrongSize),
    ] {
        assert_eq!(bench.rtc(C::WRITE_ENTRY, words).0, refused(refusal), "{words:?}");
    }
    let wrong = refused(Refusal::WrongSize);
    assert_eq!(bench.rtc(C::DELETE_ENTRY, [0, 0, 0]).0, wrong);
    // Another entry in between; one block too many; another version.
    bench.rtc(C::WRITE_ENTRY, [1, 64, 0]);
    assert_eq!(bench.send(C::WRITE_ENTRY_DATA, 2, &bytes), wrong);
    assert_eq!(bench.send(C::WRITE_ENTRY_DATA, 1, &bytes), wrong);
    bench.rtc(C::WRITE_ENTRY, [1, 64, 0]);
    assert_eq!(bench.send(C::WRITE_ENTRY_DATA, 1, &bytes), DONE);
    assert_eq!(bench.send(C::WRITE_ENTRY_DATA, 1, &bytes), wrong);
    bench.rtc(C::WRITE_ENTRY, [2, 64, 0]);
    assert_eq!(bench.send(C::WRITE_ENTRY_DATA, 2, &[0; 64]), wrong);
    assert_eq!(bench.get_entry(2), None);
    bench.rtc(C::GET_ENTRY, [1, 0, 0]);
    assert_eq!(bench.rtc(C::GET_ENTRY_DATA, [2, 0, 0]).0, wrong);
    assert_eq!(bench.fetch(C::GET_ENTRY_DATA, 1, 64), bytes);
    assert_eq!(bench.rtc(C::GET_ENTRY_DATA, [1, 0, 0]).0, wrong);
}

#[test]
fn a_restart_in_a_save_leaves_nothing() {
    for save in [C::SAVE_CURVES, C::SAVE_TABLE] {
        let mut bench = Bench::new(|_| {});
        bench.add_curve(&curve(5, &[1, 2]));
        bench.put_entry(9, &entry(go_to(CM, VAD), None));
        assert_eq!(bench.rtc(C::STOP_SOFTWARE, [0; 3]).0, DONE);
        for command in [C::SAVE_CURVES, C::SAVE_TABLE] {
            assert_eq!(bench.write(command, 0, 0), DONE);
        }
        bench.rtc(save, [0; 3]);
        bench.now = bench.now + 499 * MS;
        bench.restart();
        let left = (bench.get_curve(5).is_some(), bench.get_entry(9).is_some());
        assert_eq!(left, (save != C::SAVE_CURVES, save != C::SAVE_TABLE));
        // Lost for good.
        bench.restart();
        assert_eq!((bench.get_curve(5).is_some(), bench.get_entry(9).is_some()), left);
    }
}
