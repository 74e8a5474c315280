//! Objects that are longer than the value of a call: texts, and all subindices of an object together.

use std::time::Duration;

use super::{LOAD, PART, READ, SIZE, STORE, Target};
use crate::axis::acyclic::{Answer, Call, CallError, Carrier};

/// The most bytes of an object that are read or written.
pub const MOST: usize = 128;
/// Bytes per call.
const STEP: usize = 8;

/// Reads an object of up to [`MOST`] bytes, of a longer one the first of them; less if the queue of the drive has
/// less room than for ten calls. `limit` is the time limit of each call.
pub fn read(carrier: &dyn Carrier, target: Target, limit: Duration) -> Result<Vec<u8>, CallError> {
    let address = target.pack();
    let first = [(READ, 0), (SIZE, 0)].into_iter();
    let parts = (1..MOST / STEP).map(|part| (PART, (part * STEP) as u64));
    let calls: Vec<Call> = first
        .chain(parts)
        .map(|(service, value)| Call { service, address, value })
        .take(carrier.capacity().max(1))
        .collect();
    // After its end the object has no parts: that ends the series.
    let series = carrier.run(&calls, limit);
    let Some((first, rest)) = series.answers.split_first() else {
        return Err(series.failed.unwrap_or(CallError::Gone));
    };
    let size = rest.first().map_or(STEP, |size| usize::try_from(size.value).unwrap_or(MOST));
    let bytes = |answer: &Answer| answer.value.to_le_bytes();
    let parts = rest.get(1..).unwrap_or_default();
    let all = std::iter::once(first).chain(parts).flat_map(bytes);
    Ok(all.take(size).collect())
}

/// The calls that write these bytes, at most [`MOST`]: they are handed over in pieces, and written by the last call.
pub fn write(target: Target, bytes: &[u8]) -> Vec<Call> {
    let address = target.pack();
    let pieces = bytes.chunks(STEP).map(|piece| (LOAD, raw(piece)));
    let all = pieces.chain([(STORE, bytes.len() as u64)]);
    all.map(|(service, value)| Call { service, address, value }).collect()
}

/// The first eight bytes as the raw value of a call, the first one the lowest.
pub fn raw(bytes: &[u8]) -> u64 {
    bytes.iter().take(STEP).rev().fold(0, |raw, byte| raw << 8 | u64::from(*byte))
}

/// The characters of a text, up to its end.
pub fn text(bytes: &[u8]) -> String {
    let shown = bytes.iter().take_while(|byte| **byte != 0);
    shown.flat_map(|byte| byte.escape_ascii()).map(char::from).collect()
}

/// Bytes from two digits each, with blanks between them or without; `None`: these are none.
pub fn parse_octets(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<u8> =
        text.chars().filter(|c| *c != ' ').map(|c| c.to_digit(16).map(|d| d as u8)).collect::<Option<_>>()?;
    let (pairs, rest) = digits.as_chunks::<2>();
    rest.is_empty().then(|| pairs.iter().map(|[high, low]| high << 4 | low).collect())
}

/// Bytes as two digits each.
pub fn octets(bytes: &[u8]) -> String {
    let shown: Vec<String> = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
    shown.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_shown_as_what_they_are() {
        assert_eq!(text(b"S700\x07 x\0old"), "S700\\x07 x");
        assert_eq!(octets(&[1, 0, 4, 0x17]), "01 00 04 17");
        assert_eq!((octets(&[]), text(&[])), (String::new(), String::new()));
        assert_eq!(parse_octets("01 A0fF"), Some(vec![1, 0xA0, 0xFF]));
        assert_eq!((parse_octets("01 A"), parse_octets("0g")), (None, None));
        assert_eq!((raw(&[0x37, 6]), raw(&[0xFF; 9])), (0x637, u64::MAX));
    }
}
