//! Golden telegrams, each with its source.
//!
//! Unless said otherwise they are the sheet's, made by pyprofibus's encoder or seen on a wire: slave 7, master 2.

use super::telegram::{Buffer, Frame, Head, MAX, Next, Telegram};

mod records;
mod services;
mod telegrams;

const MASTER: u8 = 2;
const SLAVE: u8 = 7;

/// Bytes as they are printed.
fn hex(text: &str) -> Vec<u8> {
    text.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).expect(byte)).collect()
}

/// The bytes that `emit` writes.
fn emitted(emit: impl FnOnce(&mut Buffer) -> Option<usize>) -> Vec<u8> {
    // Nothing depends on what is in the buffer before.
    let mut out = [0xEE; MAX];
    let size = emit(&mut out).expect("fits");
    assert!(out[size..].iter().skip(3).all(|byte| *byte == 0xEE), "nothing is written far behind the end");
    out[..size].to_vec()
}

/// The only telegram in `bytes`.
fn frame(bytes: &[u8]) -> Frame<'_> {
    match Next::parse(bytes) {
        Next::Telegram { telegram: Telegram::Data(frame), size } if size == bytes.len() => frame,
        other => panic!("{other:?}"),
    }
}

/// The bytes are this telegram, both ways.
fn golden(text: &str, head: Head, data: &[u8]) {
    let bytes = hex(text);
    assert_eq!(emitted(|out| head.emit(data, out)), bytes);
    assert_eq!(frame(&bytes), Frame { head, data });
}
