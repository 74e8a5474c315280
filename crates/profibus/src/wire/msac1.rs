//! Acyclic access by MSAC1: records of a slave are read and written by slot and index (sheet, 3).
//!
//! A request is a telegram to [`sap::MSAC1`](super::sap::MSAC1). If it is only acknowledged, telegrams without data to
//! the same service access points poll for the answer.

use std::fmt;

use super::{Reader, Writer};

/// Set in the function number of a refusal.
const NEGATIVE: u8 = 0x80;

/// The most bytes of a record: what a telegram has room for, behind two service access points and four bytes.
pub const RECORD_MAX: usize = 240;

/// The use of a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Function {
    /// It is read.
    Read = 0x5E,
    /// It is written.
    Write = 0x5F,
}

/// A record, as slave and master address it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Record {
    /// The slot.
    pub slot: u8,
    /// The index.
    pub index: u8,
}

impl Record {
    /// Writes the request to read at most `length` bytes of it.
    pub fn put_read(self, length: u8, out: &mut Writer<'_>) {
        out.bytes(&[Function::Read as u8, self.slot, self.index, length]);
    }

    /// Writes the request to write it, with the data that `fill` writes. More than [`RECORD_MAX`] bytes are no request.
    pub fn put_write(self, out: &mut Writer<'_>, fill: impl FnOnce(&mut Writer<'_>)) {
        out.bytes(&[Function::Write as u8, self.slot, self.index]);
        out.counted(fill);
    }
}

/// The answer to a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Answer<'a> {
    /// The function that was requested.
    pub function: Function,
    /// The record, and its bytes if it was read; or why it was not done, without the record.
    pub result: Result<(Record, &'a [u8]), Refusal>,
}

impl<'a> Answer<'a> {
    /// Reads the data of a telegram; `None`: they are an answer to neither, or the length in them contradicts their
    /// own. Whether they belong to the request is not checked.
    pub fn parse(data: &'a [u8]) -> Option<Answer<'a>> {
        let mut reader = Reader(data);
        let [number, second, third, fourth] = reader.array()?;
        let function =
            [Function::Read, Function::Write].into_iter().find(|of| *of as u8 == number & !NEGATIVE)?;
        let rest = reader.0;
        let is_refused = number & NEGATIVE != 0;
        let length = if is_refused || function == Function::Write { 0 } else { usize::from(fourth) };
        let result = if is_refused {
            Err(Refusal { decode: second, code_1: third, code_2: fourth })
        } else {
            Ok((Record { slot: second, index: third }, rest))
        };
        (rest.len() == length).then_some(Answer { function, result })
    }
}

/// Why a slave did not read or write a record (FPBA-01 manual, FC310x).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Refusal {
    /// Error_Decode: 80h is DP-V1, and says what the codes are.
    pub decode: u8,
    /// Error_Code_1: the class in bits 7 ... 4, and the code.
    pub code_1: u8,
    /// Error_Code_2: the slave's own.
    pub code_2: u8,
}

impl Refusal {
    /// Error_Decode of DP-V1.
    pub const DPV1: u8 = 0x80;
    /// Error_Code_1: not in this state. Of the record of parameters: the response is not ready, read again.
    pub const STATE: u8 = 0xB5;
    /// Error_Code_1: busy, try again.
    pub const BUSY: u8 = 0xC2;

    /// The same request may succeed later.
    pub const fn is_temporary(self) -> bool {
        self.decode == Refusal::DPV1 && matches!(self.code_1, Refusal::STATE | Refusal::BUSY)
    }

    /// The meaning of Error_Code_1, if known.
    pub const fn name(self) -> Option<&'static str> {
        if self.decode != Refusal::DPV1 {
            return None;
        }
        Some(match self.code_1 {
            0xA0 => "read error",
            0xA1 => "write error",
            0xA2 => "module failure",
            0xA8 => "version conflict",
            0xA9 => "not supported",
            0xB0 => "no such index",
            0xB1 => "wrong length of a write",
            0xB2 => "no such slot",
            0xB3 => "type conflict",
            0xB4 => "no such area",
            0xB5 => "state conflict",
            0xB6 => "access denied",
            0xB7 => "out of range",
            0xB8 => "wrong parameter",
            0xB9 => "wrong type",
            0xC0 => "conflict with another read",
            0xC1 => "conflict with another write",
            0xC2 => "busy",
            0xC3 => "not available",
            _ => return None,
        })
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Refusal { decode, code_1, code_2 } = *self;
        write!(f, "{} ({decode:02X} {code_1:02X} {code_2:02X})", self.name().unwrap_or("unknown error"))
    }
}
