//! Modbus TCP, both directions: bytes <-> values.
//!
//! Knows no state, clock, socket or allocation, and does not interpret a message: the station decides which
//! response belongs to which request, and the drive what it does with a request.
//!
//! A message (ADU) is the MBAP header and a PDU, everything big-endian (Modbus TCP Implementation Guide v1.0b, 3.1.3):
//!
//! | bytes | field | |
//! |---|---|---|
//! | 0-1 | transaction | chosen by the client, echoed |
//! | 2-3 | protocol | 0 |
//! | 4-5 | length | of the following bytes: the unit and the PDU, 2 ... 254 |
//! | 6 | unit | which part of the drive |
//! | 7 | function | the first byte of the PDU |
//!
//! and the PDU of the four functions that a Unidrive has (SI-Ethernet guide; Modbus Application Protocol v1.1b3, 6):
//!
//! | function | request | response |
//! |---|---|---|
//! | 3 | address, count | bytes, registers |
//! | 6 | address, value | the same |
//! | 16 | address, count, bytes, registers | address, count *that was written* |
//! | 23 | read address, count, write address, count, bytes, registers | bytes, registers |
//! | + 80h | - | exception code |
//!
//! TCP splits and merges messages as it likes: [`frame`] finds the end of the one in front, then [`Request::parse`] or
//! [`Response::parse`] reads it.

mod registers;
mod request;
mod response;

use thiserror::Error;

pub use registers::{Registers, RegistersBuffer};
pub use request::{Request, RequestError, RequestFault};
pub use response::{ExceptionCode, Response, ResponseError};

/// Offsets in a message.
mod field {
    use std::ops::Range;

    pub const TRANSACTION: Range<usize> = 0..2;
    pub const PROTOCOL: Range<usize> = 2..4;
    pub const LENGTH: Range<usize> = 4..6;
    pub const UNIT: usize = 6;
    pub const FUNCTION: usize = 7;

    /// Bytes that the length does not count: everything up to its own end.
    pub const BEFORE_UNIT: usize = 6;
    /// A unit and a function without anything after them.
    pub const LENGTH_MIN: u16 = 2;
    /// A unit and the longest PDU (Modbus Application Protocol v1.1b3, 4.1).
    pub const LENGTH_MAX: u16 = 254;
}

/// The longest message, bytes.
pub const ADU_MAX: usize = 260;
/// The header in front of the PDU, bytes.
pub const HEADER: usize = 7;
/// The most registers that a Unidrive reads or writes at once (SI-Ethernet guide). Every limit of the standard is
/// higher.
pub const REGISTERS_MAX: u16 = 120;

/// The functions, as on the wire.
pub mod function {
    /// Read holding registers.
    pub const READ: u8 = 3;
    /// Write a single register.
    pub const WRITE_ONE: u8 = 6;
    /// Write multiple registers.
    pub const WRITE: u8 = 16;
    /// Read/write multiple registers.
    pub const READ_WRITE: u8 = 23;
    /// Set in the response that is an exception.
    pub const EXCEPTION: u8 = 0x80;
}

/// Why a stream is not Modbus. No mark shows where the next message begins: the connection has to be closed.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum FrameError {
    /// The protocol identifier is not 0.
    #[error("protocol {0:#06x} in the header where Modbus has 0: not a Modbus TCP peer, or bytes were lost")]
    Protocol(u16),
    /// No message has such a length.
    #[error(
        "length {0} in the header where 2 ... 254 is possible: not a Modbus TCP peer, or bytes were lost"
    )]
    Length(u16),
}
fieldbeat_core::debug_as_display!(FrameError);

/// The length of the whole message at the front of a stream, 8 ... [`ADU_MAX`]; `None` while it is incomplete. A
/// fault is reported as soon as its field has arrived.
#[inline]
pub fn frame(bytes: &[u8]) -> Result<Option<usize>, FrameError> {
    let Some(protocol) = word(bytes, field::PROTOCOL.start) else { return Ok(None) };
    if protocol != 0 {
        return Err(FrameError::Protocol(protocol));
    }
    let Some(length) = word(bytes, field::LENGTH.start) else { return Ok(None) };
    if !(field::LENGTH_MIN..=field::LENGTH_MAX).contains(&length) {
        return Err(FrameError::Length(length));
    }
    let size = field::BEFORE_UNIT + usize::from(length);
    Ok((bytes.len() >= size).then_some(size))
}

/// The header without the length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Header {
    /// Chosen by the client, echoed by the server.
    pub transaction: u16,
    /// Which part of the drive: see `parameter`.
    pub unit: u8,
}

impl Header {
    /// The header of a message; `None` if the message is shorter than a header.
    #[inline]
    pub fn parse(adu: &[u8]) -> Option<Header> {
        Some(Header { transaction: word(adu, field::TRANSACTION.start)?, unit: *adu.get(field::UNIT)? })
    }
}

/// Fills a message from its front. Its size was checked before; excess bytes are left out.
struct Fill<'a>(&'a mut [u8]);

impl<'a> Fill<'a> {
    /// The `size` bytes of a message, filled up to the end of its function; `None`, and nothing is written, if the
    /// size is impossible or there is no room.
    #[inline]
    fn message(out: &'a mut [u8], size: usize, header: Header, function: u8) -> Option<Fill<'a>> {
        if size > ADU_MAX {
            return None;
        }
        let mut fill = Fill(out.get_mut(..size)?);
        let [high, low] = header.transaction.to_be_bytes();
        // At most 254: the upper byte of the length is 0.
        fill.put([high, low, 0, 0, 0, (size - field::BEFORE_UNIT) as u8, header.unit, function]);
        Some(fill)
    }

    #[inline]
    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        if let Some((head, rest)) = std::mem::take(&mut self.0).split_first_chunk_mut() {
            *head = bytes;
            self.0 = rest;
        }
    }

    #[inline]
    fn byte(&mut self, byte: u8) {
        self.put([byte]);
    }

    #[inline]
    fn word(&mut self, word: u16) {
        self.put(word.to_be_bytes());
    }

    /// The number of bytes, and the registers. If the message is not too long the number fits.
    #[inline]
    fn data(&mut self, data: Registers<'_>) {
        self.byte(data.bytes().len() as u8);
        if let Some(room) = self.0.get_mut(..data.bytes().len()) {
            room.copy_from_slice(data.bytes());
        }
    }

    /// The number of registers, then as [`data`](Self::data).
    #[inline]
    fn block(&mut self, data: Registers<'_>) {
        self.word(data.len() as u16);
        self.data(data);
    }
}

/// The bytes after the function; `None` if these bytes are not exactly one message.
#[inline]
fn body(adu: &[u8]) -> Option<&[u8]> {
    match frame(adu) {
        Ok(Some(size)) if size == adu.len() => adu.get(field::FUNCTION + 1..),
        _ => None,
    }
}

#[inline]
fn word(bytes: &[u8], at: usize) -> Option<u16> {
    bytes.get(at..)?.first_chunk().map(|word| u16::from_be_bytes(*word))
}

/// Exactly two words.
#[inline]
fn pair(body: &[u8]) -> Option<[u16; 2]> {
    let &[a, b, c, d] = body else { return None };
    Some([u16::from_be_bytes([a, b]), u16::from_be_bytes([c, d])])
}

/// A number of bytes, and exactly as many registers.
#[inline]
fn sized(body: &[u8]) -> Option<Registers<'_>> {
    let (bytes, data) = body.split_first()?;
    if usize::from(*bytes) != data.len() {
        return None;
    }
    Registers::new(data)
}

#[cfg(test)]
mod tests;
