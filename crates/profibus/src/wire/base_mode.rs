//! Path C: parameters in the record 47 of DP-V1, several in one request (sheet, 3; EMF2133IB manual, pages 98 to 105,
//! FPBA-01 manual).
//!
//! A request is written to the record: its head, the address of each parameter, and to write, the values of each. The
//! response is read from it, and is refused as [`STATE`](super::msac1::Refusal::STATE) until it is ready.

use std::fmt;

use super::errors::ErrorNumber;
use super::job::Kind;
use super::{Reader, Writer};

/// The index of the record.
pub const RECORD: u8 = 47;

const READ: u8 = 1;
const WRITE: u8 = 2;
/// Set in the id of a response in which a parameter has failed.
const FAILED: u8 = 0x80;
/// The attribute of a parameter that is its value.
const VALUE: u8 = 0x10;

/// The common head of all parameters of a request; mirrored in the response.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Head {
    /// A number of the master's own, not 0.
    pub reference: u8,
    /// Parameters are written, not read.
    pub write: bool,
    /// The axis, 0 or 1.
    pub axis: u8,
    /// How many parameters there are, 1 at least.
    pub count: u8,
}

impl Head {
    /// Writes it.
    pub fn put(&self, out: &mut Writer<'_>) {
        out.bytes(&[self.reference, if self.write { WRITE } else { READ }, self.axis, self.count]);
    }
}

/// The value of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Address {
    /// How many elements; of a scalar 0 or 1.
    pub count: u8,
    /// The index: 24575 - code on the 8400 and 9400; assumed on the EMF2133IB.
    pub index: u16,
    /// The first subindex.
    pub subindex: u16,
}

impl Address {
    /// Writes it.
    pub fn put(&self, out: &mut Writer<'_>) {
        out.bytes(&[VALUE, self.count]);
        out.word(self.index);
        out.word(self.subindex);
    }
}

/// How a value stands in a request or response: the number of a [`Kind`], or another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Format(pub u8);

impl Format {
    /// Nothing: of a parameter that was written without an error.
    pub const ZERO: Format = Format(0x40);
    /// The parameter has failed.
    pub const ERROR: Format = Format(0x44);

    /// Bytes of one value; `None` if the format is unknown.
    pub const fn size(self) -> Option<usize> {
        Some(match self.0 {
            0x40 => 0,
            // 8 bits, characters, octets, 8 bits of any meaning.
            0x02 | 0x05 | 0x09 | 0x0A | 0x41 => 1,
            // 16 bits, the same of any meaning, the number of an error.
            0x03 | 0x06 | 0x42 | 0x44 => 2,
            // 32 bits, the same of any meaning.
            0x04 | 0x07 | 0x43 => 4,
            _ => return None,
        })
    }

    /// The values have a sign.
    const fn is_signed(self) -> bool {
        matches!(self.0, 0x02..=0x04)
    }

    /// A value of so many bits, of which nothing else is known; `None`: there is none.
    pub const fn of_bits(bits: u32) -> Option<Format> {
        Some(Format(match bits {
            8 => 0x41,
            16 => 0x42,
            32 => 0x43,
            _ => return None,
        }))
    }

    /// The kind of a value. Bits of any meaning are a number, `signed` or not. `None`: the format is unknown, or has no
    /// value.
    pub const fn kind(self, signed: bool) -> Option<Kind> {
        Some(match (self.0, signed) {
            (0x02, _) | (0x41, true) => Kind::I8,
            (0x03, _) | (0x42, true) => Kind::I16,
            (0x04, _) | (0x43, true) => Kind::I32,
            (0x05, _) | (0x41, false) => Kind::U8,
            (0x06, _) | (0x42, false) => Kind::U16,
            (0x07, _) | (0x43, false) => Kind::U32,
            (0x09 | 0x0A, _) => Kind::Text,
            _ => return None,
        })
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = match self.0 {
            0x41 => "a byte",
            0x42 => "a word of 16 bits",
            0x43 => "a double word of 32 bits",
            _ => self.kind(true).map_or("no value", Kind::name),
        };
        write!(f, "{name} (format {:02X}h)", self.0)
    }
}

impl From<Kind> for Format {
    fn from(kind: Kind) -> Format {
        Format(kind as u8)
    }
}

/// The values of a parameter: bytes as on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Values<'a> {
    /// Of each value.
    pub format: Format,
    /// All of them, one after the other.
    pub bytes: &'a [u8],
}

impl Values<'_> {
    /// The first one, extended by the sign that its format has; `None`: there is none.
    pub fn first(&self) -> Option<i64> {
        let bytes = self.bytes.get(..self.format.size()?)?;
        let (first, _) = bytes.split_first()?;
        let sign = if self.format.is_signed() && first & 0x80 != 0 { -1 } else { 0 };
        Some(bytes.iter().fold(sign, |value, byte| value << 8 | i64::from(*byte)))
    }

    /// Writes them. Bytes that are not those of whole values of a format, or of more than 255, are no request.
    pub fn put(&self, out: &mut Writer<'_>) {
        let whole = self.format.size().filter(|size| self.bytes.len().checked_rem(*size) == Some(0));
        match whole.map(|size| u8::try_from(self.bytes.len() / size)) {
            Some(Ok(count)) => out.bytes(&[self.format.0, count]),
            _ => out.fail(),
        }
        out.bytes(self.bytes);
        out.bytes(if self.bytes.len().is_multiple_of(2) { &[] } else { &[0] });
    }
}

/// The outcome of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome<'a> {
    /// It was written.
    Written,
    /// The values read.
    Read(Values<'a>),
    /// It failed.
    Failed(ErrorNumber),
}

/// The response to a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Response<'a> {
    /// As in the request.
    pub head: Head,
    /// A parameter has failed, at least.
    pub failed: bool,
    body: Reader<'a>,
}

impl<'a> Response<'a> {
    /// Reads the record; `None`: it is none to reading or writing, a parameter is cut off or has an unknown format, or
    /// there is more than the parameters. Whether it belongs to the request is not checked.
    pub fn parse(record: &'a [u8]) -> Option<Response<'a>> {
        let mut body = Reader(record);
        let [reference, id, axis, count] = body.array()?;
        let write = match id & !FAILED {
            READ => false,
            WRITE => true,
            _ => return None,
        };
        let head = Head { reference, write, axis, count };
        let response = Response { head, failed: id & FAILED != 0, body };
        let mut outcomes = response.outcomes();
        let whole = outcomes.by_ref().count() == usize::from(count);
        (whole && outcomes.body.0.is_empty()).then_some(response)
    }

    /// The outcome of each parameter, in the order of the request.
    pub fn outcomes(&self) -> Outcomes<'a> {
        // A write without an error has nothing behind its head.
        let brief = self.head.write && !self.failed && self.body.0.is_empty();
        Outcomes { write: self.head.write, brief, left: self.head.count, body: self.body }
    }
}

/// The parameters of a response. One that passes the end ends them.
#[derive(Debug)]
pub struct Outcomes<'a> {
    write: bool,
    brief: bool,
    left: u8,
    body: Reader<'a>,
}

impl<'a> Iterator for Outcomes<'a> {
    type Item = Outcome<'a>;

    fn next(&mut self) -> Option<Outcome<'a>> {
        self.left = self.left.checked_sub(1)?;
        if self.brief {
            return Some(Outcome::Written);
        }
        let [format, count] = self.body.array()?;
        let format = Format(format);
        let bytes = self.body.bytes(usize::from(count) * format.size()?)?;
        if format == Format::ERROR {
            return Some(Outcome::Failed(ErrorNumber(Reader(bytes).word_be()?)));
        }
        // A byte completes the last word. No format is 0: a drive that leaves the byte out is understood.
        if bytes.len() % 2 == 1 && self.body.0.first() == Some(&0) {
            self.body.byte();
        }
        match format {
            Format::ZERO if self.write => Some(Outcome::Written),
            _ => Some(Outcome::Read(Values { format, bytes })),
        }
    }
}
