//! Typed calls: what is done to what. And values that are longer than the value of a call: read and written by several
//! calls of one series.
//!
//! Such a value is read by [`READ`], followed by [`SIZE`] and [`PART`]s of the data read: [`read`] does it. It is
//! written by [`LOAD`]s, followed by a [`STORE`]: [`write()`]. Several values that are read at once begin with
//! [`READ_SEVERAL`]: [`read_several`].

use std::time::Duration;

use super::{Answer, Call, CallError, Carrier, Posted};

/// The service of a call that reads.
pub const READ: u32 = 1;
/// The service of a call that writes.
pub const WRITE: u32 = 2;
/// The service of a call that returns how many bytes the preceding [`READ`] of the same target in its series has
/// read.
pub const SIZE: u32 = 3;
/// The service of a call that returns eight of those bytes, of the first 128, starting at `value`.
pub const PART: u32 = 4;
/// The service of a call that hands over the next eight bytes of a value, to be written later in its series. Nothing is
/// sent.
pub const LOAD: u32 = 5;
/// The service of a call that writes the first `value` bytes handed over before it in its series. Where they are
/// several values, its answer says how many of the bytes were written, with a status if those are not all.
pub const STORE: u32 = 6;
/// The service of a call that reads `value` values at once.
pub const READ_SEVERAL: u32 = 7;

/// The target of reads and writes: their address.
pub trait Target: Copy {
    /// As the address of a call.
    fn pack(self) -> u32;

    /// From the address of a call; `None`: it is invalid.
    fn unpack(address: u32) -> Option<Self>;

    /// The call that reads it.
    fn read(self) -> Call {
        Service::Read(self).into()
    }

    /// The call that writes this raw value to it.
    fn write(self, raw: u64) -> Call {
        Service::Write(self, raw).into()
    }
}

/// A call: what is done to what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Service<T> {
    /// Reads it: [`READ`].
    Read(T),
    /// Writes this raw value to it: [`WRITE`].
    Write(T, u64),
    /// Returns how many bytes were read of it before: [`SIZE`].
    Size(T),
    /// Returns eight of those bytes, from this one on: [`PART`].
    Part(T, u64),
    /// Hands over the next eight bytes for it: [`LOAD`].
    Load(T, u64),
    /// Writes so many of the bytes that were handed over to it: [`STORE`].
    Store(T, u64),
    /// Reads so many values from it on: [`READ_SEVERAL`].
    ReadSeveral(T, u64),
}

impl<T> Service<T> {
    /// The number, its target and its value.
    fn parts(self) -> (u32, T, u64) {
        match self {
            Service::Read(target) => (READ, target, 0),
            Service::Write(target, raw) => (WRITE, target, raw),
            Service::Size(target) => (SIZE, target, 0),
            Service::Part(target, at) => (PART, target, at),
            Service::Load(target, bytes) => (LOAD, target, bytes),
            Service::Store(target, length) => (STORE, target, length),
            Service::ReadSeveral(target, count) => (READ_SEVERAL, target, count),
        }
    }

    /// The target of the service.
    pub fn target(self) -> T {
        self.parts().1
    }

    /// It writes.
    pub const fn writes(&self) -> bool {
        matches!(self, Service::Write(..) | Service::Store(..))
    }
}

impl<T: Target> Service<T> {
    /// That of a call; `None`: there is no such call.
    pub fn of(&Call { service, address, value }: &Call) -> Option<Service<T>> {
        let target = T::unpack(address)?;
        Some(match service {
            READ => Service::Read(target),
            WRITE => Service::Write(target, value),
            SIZE => Service::Size(target),
            PART => Service::Part(target, value),
            LOAD => Service::Load(target, value),
            STORE => Service::Store(target, value),
            READ_SEVERAL => Service::ReadSeveral(target, value),
            _ => return None,
        })
    }

    /// The target that a call writes; `None`: it does not write.
    pub fn written(call: &Call) -> Option<T> {
        Service::of(call).filter(Service::writes).map(Service::target)
    }
}

impl<T: Target> From<Service<T>> for Call {
    fn from(service: Service<T>) -> Call {
        let (service, target, value) = service.parts();
        Call { service, address: target.pack(), value }
    }
}

/// The most bytes of a value that are read or written.
pub const MOST: usize = 128;
/// Bytes per call.
const STEP: usize = size_of::<u64>();

/// Reads a value of up to [`MOST`] bytes, of a longer one the first of them; less if the queue of the drive has less
/// room than for ten calls. `limit` is the time limit of each call.
pub fn read(carrier: &dyn Carrier, address: u32, limit: Duration) -> Result<Vec<u8>, CallError> {
    let first = [(READ, 0), (SIZE, 0)].into_iter();
    let parts = (1..MOST / STEP).map(|part| (PART, (part * STEP) as u64));
    let calls: Vec<Call> = first
        .chain(parts)
        .map(|(service, value)| Call { service, address, value })
        .take(carrier.capacity().max(1))
        .collect();
    // After its end the value has no parts: that ends the series.
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
pub fn write(address: u32, bytes: &[u8]) -> Vec<Call> {
    let pieces = bytes.chunks(STEP).map(|piece| (LOAD, raw(piece)));
    let all = pieces.chain([(STORE, bytes.len() as u64)]);
    all.map(|(service, value)| Call { service, address, value }).collect()
}

/// The calls that read so many values at once, `bytes` bytes in all; and the bytes in what they have answered.
pub fn read_several(address: u32, count: usize, bytes: usize) -> Vec<Call> {
    let first = Call { service: READ_SEVERAL, address, value: count as u64 };
    let part = |at: usize| Call { service: PART, address, value: at as u64 };
    std::iter::once(first).chain((STEP..bytes).step_by(STEP).map(part)).collect()
}

/// The bytes in the answers to [`read_several`].
pub fn read_bytes(answers: &[Answer]) -> Vec<u8> {
    answers.iter().flat_map(|answer| answer.value.to_le_bytes()).collect()
}

/// The data of a series of calls, for their executor: what its last one has read, or what it has handed over to be
/// written. It has room for so many bytes.
#[derive(Clone, Copy, Debug)]
pub struct Kept<const ROOM: usize = MOST> {
    series: u64,
    address: u32,
    size: usize,
    data: [u8; ROOM],
}

impl<const ROOM: usize> Default for Kept<ROOM> {
    fn default() -> Kept<ROOM> {
        Kept { series: 0, address: 0, size: 0, data: [0; ROOM] }
    }
}

impl<const ROOM: usize> Kept<ROOM> {
    /// The value of `size` bytes that this call has read, and the first of them.
    pub fn of_read(posted: &Posted, size: usize, bytes: &[u8]) -> Kept<ROOM> {
        let mut data = [0; ROOM];
        data.iter_mut().zip(bytes).for_each(|(place, byte)| *place = *byte);
        Kept { series: posted.series, address: posted.call.address, size, data }
    }

    fn is_of(&self, posted: &Posted) -> bool {
        posted.series != 0 && (self.series, self.address) == (posted.series, posted.call.address)
    }

    /// Takes the next eight bytes; `None`: there is no room for them.
    pub fn load(&mut self, posted: &Posted) -> Option<Answer> {
        let Call { address, value, .. } = posted.call;
        if !self.is_of(posted) {
            *self = Kept { series: posted.series, address, ..Kept::<ROOM>::default() };
        }
        let end = self.size + STEP;
        self.data.get_mut(self.size..end)?.copy_from_slice(&value.to_le_bytes());
        self.size = end;
        Some(Answer { status: 0, address, value })
    }

    /// The bytes handed over, as many as the call says; `None`: they are not there.
    pub fn whole(&self, posted: &Posted) -> Option<&[u8]> {
        let length = usize::try_from(posted.call.value).ok()?;
        // Any value may be in a call: what is longer has no place.
        let data = self.data.get(..length)?;
        (self.is_of(posted) && length > 0 && length.next_multiple_of(STEP) == self.size).then_some(data)
    }

    /// The answer to a call for a part of it; `None`: there is no such part.
    pub fn answer(&self, posted: &Posted) -> Option<Answer> {
        let Call { service, address, value } = posted.call;
        let at = usize::try_from(value).unwrap_or(usize::MAX);
        let is_that = self.is_of(posted);
        let value = match service {
            SIZE if is_that => self.size as u64,
            PART if is_that && at < self.size.min(ROOM) => raw(self.data.get(at..).unwrap_or_default()),
            _ => return None,
        };
        Some(Answer { status: 0, address, value })
    }
}

/// The first eight bytes as the raw value of a call, the first one the lowest.
pub fn raw(bytes: &[u8]) -> u64 {
    bytes.iter().take(STEP).rev().fold(0, |raw, byte| raw << 8 | u64::from(*byte))
}

/// The characters of a text, up to its end: what cannot be printed is escaped.
pub fn text(bytes: &[u8]) -> String {
    let shown = characters(bytes).into_iter().take_while(|c| *c != '\0');
    let escaped = |c: char| match u8::try_from(c) {
        Ok(byte) if byte < 0xA0 => byte.escape_ascii().to_string(),
        _ => c.escape_debug().to_string(),
    };
    shown.map(escaped).collect()
}

/// The characters of a text as devices write it: ISO 8859-1 (visible strings of CoE, short strings of CIP), or UTF-8.
pub fn characters(bytes: &[u8]) -> Vec<char> {
    match std::str::from_utf8(bytes) {
        Ok(text) => text.chars().collect(),
        Err(_) => bytes.iter().map(|byte| char::from(*byte)).collect(),
    }
}

/// Bytes from two digits each, with blanks between them or without; `None`: these are none, or more than [`MOST`].
pub fn parse_octets(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<u8> =
        text.chars().filter(|c| *c != ' ').map(|c| c.to_digit(16).map(|d| d as u8)).collect::<Option<_>>()?;
    let (pairs, rest) = digits.as_chunks::<2>();
    let fits = rest.is_empty() && (1..=MOST).contains(&pairs.len());
    fits.then(|| pairs.iter().map(|[high, low]| high << 4 | low).collect())
}

/// The characters of a text; `None`: some of them cannot be printed, or there is none, or more than [`MOST`].
pub fn parse_text(text: &str) -> Option<Vec<u8>> {
    let is_printable = |byte: u8| byte.is_ascii_graphic() || byte == b' ';
    let fits = text.bytes().all(is_printable) && (1..=MOST).contains(&text.len());
    fits.then(|| text.as_bytes().to_vec())
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
    fn a_value_is_whole_if_all_of_it_was_handed_over_in_its_series() {
        let posted = |series, service, value| {
            let call = Call { service, address: 7, value };
            Posted { series, call, ..Posted::default() }
        };
        let mut kept = Kept::<MOST>::default();
        for piece in [0x0807_0605_0403_0201, 9] {
            assert!(kept.load(&posted(1, LOAD, piece)).is_some());
        }
        let whole =
            |kept: &Kept, series, length| kept.whole(&posted(series, STORE, length)).map(<[u8]>::to_vec);
        assert_eq!(whole(&kept, 1, 9), Some((1..10).collect()));
        for (series, length) in [(1, 0), (1, 8), (1, 17), (1, MOST as u64 + 1), (1, u64::MAX), (2, 9), (0, 9)]
        {
            assert_eq!(whole(&kept, series, length), None, "{series} {length}");
        }
        // There is room for so many and no more.
        let loaded = (2..).take_while(|_| kept.load(&posted(1, LOAD, 0)).is_some()).count();
        assert_eq!(2 + loaded, MOST / STEP);
    }

    #[test]
    fn bytes_are_shown_as_what_they_are() {
        assert_eq!(text(b"S700\x07 x\0old"), "S700\\x07 x");
        assert_eq!([text(b"1\xB5s\x9B"), text("1\u{b5}s".as_bytes())], ["1\u{b5}s\\x9b", "1\u{b5}s"]);
        assert_eq!(octets(&[1, 0, 4, 0x17]), "01 00 04 17");
        assert_eq!((octets(&[]), text(&[])), (String::new(), String::new()));
        assert_eq!(parse_octets("01 A0fF"), Some(vec![1, 0xA0, 0xFF]));
        assert_eq!((parse_octets("01 A"), parse_octets("0g"), parse_octets("")), (None, None, None));
        assert_eq!(parse_text("S7 x"), Some(b"S7 x".to_vec()));
        assert_eq!((parse_text("\u{b5}"), parse_text("a\n"), parse_text("")), (None, None, None));
        let long = "0".repeat(2 * MOST + 2);
        assert_eq!((parse_octets(&long), parse_text(&long[..=MOST])), (None, None));
        assert_eq!((raw(&[0x37, 6]), raw(&[0xFF; 9])), (0x637, u64::MAX));
    }
}
