//! Path C: parameters in the record 47 of DP-V1, several in one request (sheet, 3; EMF2133IB manual, pages 98 to 105,
//! FPBA-01 manual).
//!
//! A request is written to the record. The response is read from it, and is refused as
//! [`STATE`](super::msac1::Refusal::STATE) until it is ready.

use std::fmt;

use thiserror::Error;

use super::errors::ErrorNumber;
use super::{Reader, Writer};

/// The index of the record.
pub const RECORD: u8 = 47;

const READ: u8 = 1;
const WRITE: u8 = 2;
/// Set in the id of a response in which a parameter has failed.
const FAILED: u8 = 0x80;

/// What is common to all parameters of a request; mirrored in the response.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Head {
    /// A number of the master's own, not 0.
    pub reference: u8,
    /// Parameters are written, not read.
    pub write: bool,
    /// The axis, 0 or 1.
    pub axis: u8,
}

/// Which part of a parameter is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Attribute {
    /// Its value.
    Value = 0x10,
    /// Its description (FPBA-01 manual).
    Description = 0x20,
    /// Its text (FPBA-01 manual).
    Text = 0x30,
}

/// A parameter, or a part of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Address {
    /// Which part.
    pub attribute: Attribute,
    /// How many elements; of a scalar 0 or 1.
    pub count: u8,
    /// The index: 24575 - code on the 8400 and 9400; assumed on the EMF2133IB.
    pub index: u16,
    /// The first subindex.
    pub subindex: u16,
}

impl Address {
    fn put(&self, out: &mut Writer<'_>) {
        out.bytes(&[self.attribute as u8, self.count]);
        out.word(self.index);
        out.word(self.subindex);
    }
}

/// How a value stands in a request or response.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Format(pub u8);

impl Format {
    /// 8 bits with a sign.
    pub const I8: Format = Format(0x02);
    /// 16 bits with a sign.
    pub const I16: Format = Format(0x03);
    /// 32 bits with a sign.
    pub const I32: Format = Format(0x04);
    /// 8 bits.
    pub const U8: Format = Format(0x05);
    /// 16 bits.
    pub const U16: Format = Format(0x06);
    /// 32 bits.
    pub const U32: Format = Format(0x07);
    /// Characters.
    pub const VISIBLE_STRING: Format = Format(0x09);
    /// Bytes.
    pub const OCTET_STRING: Format = Format(0x0A);
    /// Nothing: of a parameter that was written without an error.
    pub const ZERO: Format = Format(0x40);
    /// 8 bits of any meaning.
    pub const BYTE: Format = Format(0x41);
    /// 16 bits of any meaning.
    pub const WORD: Format = Format(0x42);
    /// 32 bits of any meaning.
    pub const DOUBLE: Format = Format(0x43);
    /// The parameter has failed.
    pub const ERROR: Format = Format(0x44);

    /// Bytes of one value; `None` if the format is unknown.
    pub const fn size(self) -> Option<usize> {
        Some(match self {
            Format::ZERO => 0,
            Format::I8 | Format::U8 | Format::BYTE | Format::VISIBLE_STRING | Format::OCTET_STRING => 1,
            Format::I16 | Format::U16 | Format::WORD | Format::ERROR => 2,
            Format::I32 | Format::U32 | Format::DOUBLE => 4,
            _ => return None,
        })
    }

    /// The values have a sign.
    pub const fn is_signed(self) -> bool {
        matches!(self, Format::I8 | Format::I16 | Format::I32)
    }
}

impl fmt::Debug for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Format({:#04x})", self.0)
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

impl<'a> Values<'a> {
    /// How many there are; `None` if the bytes are not that of whole values of a format, or over 255.
    pub fn count(&self) -> Option<u8> {
        let size = self.format.size()?;
        let count = self.bytes.len().checked_div(size).unwrap_or(0);
        if count * size == self.bytes.len() { u8::try_from(count).ok() } else { None }
    }

    /// Value `index`, extended by the sign that its format has.
    pub fn get(&self, index: usize) -> Option<i64> {
        let size = self.format.size()?;
        let bytes = self.bytes.get(index.checked_mul(size)?..)?.get(..size)?;
        let (first, _) = bytes.split_first()?;
        let sign = if self.format.is_signed() && first & 0x80 != 0 { -1 } else { 0 };
        Some(bytes.iter().fold(sign, |value, byte| value << 8 | i64::from(*byte)))
    }

    fn put(&self, out: &mut Writer<'_>) {
        match self.count() {
            Some(count) => out.bytes(&[self.format.0, count]),
            None => out.fail(),
        }
        out.bytes(self.bytes);
        out.bytes(if self.bytes.len().is_multiple_of(2) { &[] } else { &[0] });
    }
}

/// Writes the request to read parameters. None, or more than a byte counts, are no request.
pub fn put_read(reference: u8, axis: u8, addresses: &[Address], out: &mut Writer<'_>) {
    put_head(Head { reference, write: false, axis }, addresses.len(), out);
    addresses.iter().for_each(|address| address.put(out));
}

/// Writes the request to write parameters. None, or values that are none, are no request.
pub fn put_write(reference: u8, axis: u8, parameters: &[(Address, Values<'_>)], out: &mut Writer<'_>) {
    put_head(Head { reference, write: true, axis }, parameters.len(), out);
    parameters.iter().for_each(|(address, _)| address.put(out));
    parameters.iter().for_each(|(_, values)| values.put(out));
}

fn put_head(head: Head, count: usize, out: &mut Writer<'_>) {
    let Head { reference, write, axis } = head;
    match u8::try_from(count) {
        Ok(count @ 1..) => out.bytes(&[reference, if write { WRITE } else { READ }, axis, count]),
        _ => out.fail(),
    }
}

/// The response to a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Response<'a> {
    /// As in the request.
    pub head: Head,
    /// A parameter has failed, at least.
    pub failed: bool,
    /// How many parameters it is of: as many as the request has.
    pub count: u8,
    body: Reader<'a>,
}

/// What became of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome<'a> {
    /// It was written.
    Written,
    /// What was read.
    Read(Values<'a>),
    /// It failed.
    Failed {
        /// Why.
        error: ErrorNumber,
        /// More of it.
        info: Option<u16>,
    },
}

impl<'a> Response<'a> {
    /// Reads the record. Every length in it was checked; whether it belongs to the request was not.
    pub fn parse(record: &'a [u8]) -> Result<Response<'a>, ResponseError> {
        let mut body = Reader(record);
        let [reference, id, axis, count] =
            body.array().ok_or(ResponseError::Cut { bytes: record.len(), parameter: 0 })?;
        let write = match id & !FAILED {
            READ => false,
            WRITE => true,
            _ => return Err(ResponseError::Id { id }),
        };
        let head = Head { reference, write, axis };
        let response = Response { head, failed: id & FAILED != 0, count, body };
        let mut outcomes = response.scan();
        for (parameter, outcome) in (0..count).zip(&mut outcomes) {
            outcome.ok_or(ResponseError::Cut { bytes: record.len(), parameter })?;
        }
        match outcomes.body.0.len() {
            0 => Ok(response),
            bytes => Err(ResponseError::Rest { bytes }),
        }
    }

    /// What became of each parameter, in the order of the request.
    pub fn outcomes(&self) -> impl Iterator<Item = Outcome<'a>> {
        self.scan().map_while(|outcome| outcome)
    }

    fn scan(&self) -> Scan<'a> {
        // A write without an error has nothing behind its head.
        let brief = self.head.write && !self.failed && self.body.0.is_empty();
        Scan { write: self.head.write, brief, left: self.count, body: self.body }
    }
}

/// The parameters of a response; a `None` among them is one that passes the end.
#[derive(Debug)]
struct Scan<'a> {
    write: bool,
    brief: bool,
    left: u8,
    body: Reader<'a>,
}

impl<'a> Scan<'a> {
    fn one(&mut self) -> Option<Outcome<'a>> {
        if self.brief {
            return Some(Outcome::Written);
        }
        let [format, count] = self.body.array()?;
        let format = Format(format);
        let bytes = self.body.bytes(usize::from(count) * format.size()?)?;
        if format == Format::ERROR {
            let mut words = Reader(bytes);
            return Some(Outcome::Failed { error: ErrorNumber(words.word()?), info: words.word() });
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

impl<'a> Iterator for Scan<'a> {
    type Item = Option<Outcome<'a>>;

    fn next(&mut self) -> Option<Option<Outcome<'a>>> {
        self.left = self.left.checked_sub(1)?;
        Some(self.one())
    }
}

/// Why a record is no response.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum ResponseError {
    /// A parameter is not complete, or its format is unknown.
    #[error("parameter {parameter} of a response of {bytes} bytes is cut off, or has an unknown format")]
    Cut {
        /// The bytes of the record.
        bytes: usize,
        /// Which one, from 0.
        parameter: u8,
    },
    /// It is no response to reading or writing.
    #[error("{id:#04x} is no id of a response")]
    Id {
        /// Its id.
        id: u8,
    },
    /// More than the parameters.
    #[error("{bytes} bytes follow the last parameter of a response")]
    Rest {
        /// How many.
        bytes: usize,
    },
}
crate::errors::debug_as_display!(ResponseError);
