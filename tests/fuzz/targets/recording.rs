//! A recording with its log, damaged where no checksum shows it: no reader panics or goes on without end, and one that
//! is whole is repeated as it was.

use std::io::sink;
use std::path::Path;

use fieldbeat::replay::Replay;
use fieldbeat_record::blackbox::{events, file};
use fieldbeat_record::recording::csv::Wide;
use fieldbeat_record::recording::reading::Reading;

use super::input::Input;

/// Of a drive that was lost.
const RECORD: &[u8] = include_bytes!("../../records/lost.mcap");

/// Cycles that no log of its length has.
const MOST_CYCLES: u32 = 1_000_000;

pub fn recording(data: &[u8]) {
    let mut bytes = RECORD.to_vec();
    leave_unchecked(&mut bytes);
    let mut input = Input(data);
    while !input.is_over() && !bytes.is_empty() {
        damage(&mut bytes, &mut input);
    }
    export(&bytes);
    repeat(&bytes, data.is_empty());
}

/// Takes the checksums of the chunks away, which would show all damage in them.
fn leave_unchecked(bytes: &mut [u8]) {
    /// Of a file's begin, and of a record: its opcode and its length.
    const MAGIC: usize = 8;
    const HEAD: usize = 9;
    /// The opcode of a chunk, and where its checksum is behind that head.
    const CHUNK: u8 = 6;
    const CRC: std::ops::Range<usize> = 24..28;
    let mut at = MAGIC;
    while let Some(&[opcode, ref length @ ..]) = bytes.get(at..at + HEAD) {
        let length = u64::from_le_bytes(length.try_into().unwrap()) as usize;
        at += HEAD;
        if opcode == CHUNK {
            bytes[at..][CRC].fill(0);
        }
        at += length;
    }
}

fn damage(bytes: &mut Vec<u8>, input: &mut Input<'_>) {
    let what = input.byte();
    let at = input.long() as usize % bytes.len();
    match what % 8 {
        0 => bytes.truncate(at),
        1 | 2 => bytes[at] ^= input.byte(),
        3 => {
            let edge = input.of(&[0, 1, u64::MAX, i64::MAX as u64, 1 << 32, u64::from(u32::MAX)]);
            let place = bytes[at..].iter_mut().zip(edge.to_le_bytes());
            place.for_each(|(place, byte)| *place = byte);
        }
        4 => {
            // Mostly words are words of the log.
            let (at, from) = (at & !7, (input.long() as usize % bytes.len()) & !7);
            let length = (8 * input.below(16)).min(bytes.len() - at.max(from));
            bytes.copy_within(from..from + length, at);
        }
        5 => drop(bytes.drain(at..(at + input.below(64)).min(bytes.len()))),
        _ => {
            let piece = input.bytes(usize::from(what >> 3)).to_vec();
            bytes.splice(at..(at + piece.len()).min(bytes.len()), piece);
        }
    }
}

fn export(bytes: &[u8]) {
    let entries = Reading::of(bytes.to_vec()).map_while(Result::ok);
    let mut table = Wide::new(sink());
    entries.for_each(|entry| table.enter(&entry).unwrap());
    table.finish().unwrap();
    for wrong in Reading::of(bytes.to_vec()).filter_map(Result::err) {
        assert!(!wrong.to_string().is_empty());
    }
}

fn repeat(bytes: &[u8], is_whole: bool) {
    let name = format!("fieldbeat-fuzz-{}-{:?}.mcap", std::process::id(), std::thread::current().id());
    let path = std::env::temp_dir().join(name);
    std::fs::write(&path, bytes).unwrap();
    tell(&path, bytes);
    let opened = Replay::open(&path);
    let ended = opened.map(|mut replay| {
        let steps = (0..MOST_CYCLES).take_while(|_| replay.step()).count();
        assert!(steps < MOST_CYCLES as usize, "it goes on without end");
        (replay.run(), replay.log_end())
    });
    std::fs::remove_file(&path).unwrap();
    match ended {
        Ok((verdict, end)) => assert!(!is_whole || verdict.is_equal(), "{verdict:?}, {end:?}"),
        Err(error) => assert!(!is_whole && !error.to_string().is_empty(), "{error}"),
    }
}

/// What led up to the end of a recording, which is at `path`.
fn tell(path: &Path, bytes: &[u8]) {
    let entries = Reading::of(bytes.to_vec()).take_while(Result::is_ok);
    match file::load_header(path).and_then(|header| file::read(header, entries)) {
        Ok((header, records)) => assert!(!events::text(&header, &records, 20).is_empty()),
        Err(wrong) => assert!(!wrong.to_string().is_empty()),
    }
}
