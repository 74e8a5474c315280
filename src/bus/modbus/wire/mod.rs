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

use std::fmt;

use thiserror::Error;

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
crate::errors::debug_as_display!(FrameError);

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

/// A request, as client and server see it. The registers stay where they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request<'a> {
    /// Function 3.
    Read {
        /// The first register.
        address: u16,
        /// The number of registers. Any number: the server decides which is too large.
        count: u16,
    },
    /// Function 6.
    WriteOne {
        /// The register.
        address: u16,
        /// The value.
        value: u16,
    },
    /// Function 16.
    Write {
        /// The first register.
        address: u16,
        /// The values.
        data: Registers<'a>,
    },
    /// Function 23: writes, then reads (Modbus Application Protocol v1.1b3, 6.17).
    ReadWrite {
        /// The first register to read.
        read: u16,
        /// The number of registers to read.
        count: u16,
        /// The first register to write.
        write: u16,
        /// The values.
        data: Registers<'a>,
    },
}

impl<'a> Request<'a> {
    /// Its function.
    #[inline]
    pub const fn function(&self) -> u8 {
        match self {
            Request::Read { .. } => function::READ,
            Request::WriteOne { .. } => function::WRITE_ONE,
            Request::Write { .. } => function::WRITE,
            Request::ReadWrite { .. } => function::READ_WRITE,
        }
    }

    /// Bytes of the whole message. Over [`ADU_MAX`] it has too many registers for one message.
    #[inline]
    pub const fn size(&self) -> usize {
        HEADER
            + match self {
                Request::Read { .. } | Request::WriteOne { .. } => 5,
                Request::Write { data, .. } => 6 + data.bytes().len(),
                Request::ReadWrite { data, .. } => 10 + data.bytes().len(),
            }
    }

    /// Writes the whole message in place and returns its size; 0, and nothing written, if `out` is too short or the
    /// registers are more than a message holds (123 with function 16, 121 with function 23).
    #[inline]
    pub fn emit(&self, header: Header, out: &mut [u8]) -> usize {
        let size = self.size();
        let Some(mut out) = Fill::message(out, size, header, self.function()) else { return 0 };
        match *self {
            Request::Read { address, count } => {
                out.word(address);
                out.word(count);
            }
            Request::WriteOne { address, value } => {
                out.word(address);
                out.word(value);
            }
            Request::Write { address, data } => {
                out.word(address);
                out.block(data);
            }
            Request::ReadWrite { read, count, write, data } => {
                out.word(read);
                out.word(count);
                out.word(write);
                out.block(data);
            }
        }
        size
    }

    /// Reads a message that [`frame`] has found. It is as strict as the standard: every length in it has to agree with
    /// every other.
    #[inline]
    pub fn parse(adu: &'a [u8]) -> Result<(Header, Request<'a>), RequestError> {
        let header = Header::parse(adu).unwrap_or_default();
        let function = adu.get(field::FUNCTION).copied().unwrap_or_default();
        let error = |fault| RequestError { header, function, fault };
        let body = body(adu).ok_or(error(RequestFault::Malformed))?;
        let request = match function {
            function::READ => pair(body).map(|[address, count]| Request::Read { address, count }),
            function::WRITE_ONE => pair(body).map(|[address, value]| Request::WriteOne { address, value }),
            function::WRITE => Request::write(body),
            function::READ_WRITE => Request::read_write(body),
            _ => return Err(error(RequestFault::Unsupported)),
        };
        request.map(|request| (header, request)).ok_or(error(RequestFault::Malformed))
    }

    #[inline]
    fn write(body: &'a [u8]) -> Option<Request<'a>> {
        let (address, block) = body.split_first_chunk()?;
        Some(Request::Write { address: u16::from_be_bytes(*address), data: counted(block)? })
    }

    #[inline]
    fn read_write(body: &'a [u8]) -> Option<Request<'a>> {
        let (head, block) = body.split_first_chunk::<6>()?;
        let [read, count, write] =
            [[head[0], head[1]], [head[2], head[3]], [head[4], head[5]]].map(u16::from_be_bytes);
        Some(Request::ReadWrite { read, count, write, data: counted(block)? })
    }
}

/// Why a message is not a request, and what an exception needs to answer it.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
#[error("function {function}: {fault}")]
pub struct RequestError {
    /// The header of the message.
    pub header: Header,
    /// Its function.
    pub function: u8,
    /// The fault.
    pub fault: RequestFault,
}
crate::errors::debug_as_display!(RequestError);

/// A fault of a request.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum RequestFault {
    /// Not one of the four functions.
    #[error("not one of a Unidrive: 3, 6, 16 and 23 are")]
    Unsupported,
    /// The lengths in it contradict each other.
    #[error("its lengths contradict each other: not a Modbus client, or bytes were lost")]
    Malformed,
}
crate::errors::debug_as_display!(RequestFault);

/// A response, as client and server see it. The registers stay where they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Response<'a> {
    /// Function 3.
    Read {
        /// The registers.
        data: Registers<'a>,
    },
    /// Function 6.
    WriteOne {
        /// The register.
        address: u16,
        /// The written value.
        value: u16,
    },
    /// Function 16.
    Written {
        /// The first register.
        address: u16,
        /// How many were written: fewer than were sent if a value was refused on the way (Commander SE guide).
        count: u16,
    },
    /// Function 23. It says nothing of what was written.
    ReadWritten {
        /// The registers.
        data: Registers<'a>,
    },
    /// It was not done.
    Exception {
        /// The function of the request, 0 ... 7Fh. Not reliable: a pymodbus server returns 0 if it could not read
        /// the request.
        function: u8,
        /// The reason.
        code: ExceptionCode,
    },
}

impl<'a> Response<'a> {
    /// The function as on the wire.
    #[inline]
    pub const fn function(&self) -> u8 {
        match self {
            Response::Read { .. } => function::READ,
            Response::WriteOne { .. } => function::WRITE_ONE,
            Response::Written { .. } => function::WRITE,
            Response::ReadWritten { .. } => function::READ_WRITE,
            Response::Exception { function, .. } => *function | function::EXCEPTION,
        }
    }

    /// Bytes of the whole message. Over [`ADU_MAX`] it has too many registers for one message.
    #[inline]
    pub const fn size(&self) -> usize {
        HEADER
            + match self {
                Response::Read { data } | Response::ReadWritten { data } => 2 + data.bytes().len(),
                Response::WriteOne { .. } | Response::Written { .. } => 5,
                Response::Exception { .. } => 2,
            }
    }

    /// Writes the whole message in place and returns its size; 0, and nothing written, if `out` is too short or the
    /// registers are more than a message holds (125).
    #[inline]
    pub fn emit(&self, header: Header, out: &mut [u8]) -> usize {
        let size = self.size();
        let Some(mut out) = Fill::message(out, size, header, self.function()) else { return 0 };
        match *self {
            Response::Read { data } | Response::ReadWritten { data } => out.data(data),
            Response::WriteOne { address, value } => {
                out.word(address);
                out.word(value);
            }
            Response::Written { address, count } => {
                out.word(address);
                out.word(count);
            }
            Response::Exception { code, .. } => out.byte(code.0),
        }
        size
    }

    /// Reads a message that [`frame`] has found. It is as strict as the standard: every length in it has to agree
    /// with every other. Whether it fits the request is not checked.
    #[inline]
    pub fn parse(adu: &'a [u8]) -> Result<(Header, Response<'a>), ResponseError> {
        let wrong = ResponseError::Frame { bytes: adu.len() };
        let header = Header::parse(adu).ok_or(wrong)?;
        let body = body(adu).ok_or(wrong)?;
        let function = *adu.get(field::FUNCTION).ok_or(wrong)?;
        let response = match function {
            function::READ => sized(body).map(|data| Response::Read { data }),
            function::WRITE_ONE => pair(body).map(|[address, value]| Response::WriteOne { address, value }),
            function::WRITE => pair(body).map(|[address, count]| Response::Written { address, count }),
            function::READ_WRITE => sized(body).map(|data| Response::ReadWritten { data }),
            function::EXCEPTION.. => match *body {
                [code] => Some(Response::Exception {
                    function: function & !function::EXCEPTION,
                    code: ExceptionCode(code),
                }),
                _ => None,
            },
            _ => return Err(ResponseError::Function { header, function }),
        };
        response.map(|response| (header, response)).ok_or(ResponseError::Length { header, function })
    }
}

/// Why a message is not a response.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum ResponseError {
    /// It is not a message that [`frame`] finds.
    #[error("{bytes} bytes are not one message with a header")]
    Frame {
        /// Its length, bytes.
        bytes: usize,
    },
    /// A function that this master never requests.
    #[error("function {function} was never requested: not a Unidrive, or another client's answer")]
    Function {
        /// The header of the message.
        header: Header,
        /// The function.
        function: u8,
    },
    /// The content of the PDU contradicts its length.
    #[error(
        "function {function}: the lengths in it contradict each other: not a Modbus server, or bytes were lost"
    )]
    Length {
        /// The header of the message.
        header: Header,
        /// Its function.
        function: u8,
    },
}
crate::errors::debug_as_display!(ResponseError);

/// Why a server did not carry out a request (Modbus Application Protocol v1.1b3, 7). A Unidrive has 1 and 2 only
/// (SI-Ethernet guide); gateways and other servers the rest.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct ExceptionCode(pub u8);

impl ExceptionCode {
    /// 01: the function is not supported.
    pub const FUNCTION: ExceptionCode = ExceptionCode(0x01);
    /// 02: no such register; a Unidrive uses it for too many registers as well.
    pub const ADDRESS: ExceptionCode = ExceptionCode(0x02);
    /// 03: an invalid value in the request.
    pub const VALUE: ExceptionCode = ExceptionCode(0x03);
    /// 04: the server failed.
    pub const DEVICE_FAILURE: ExceptionCode = ExceptionCode(0x04);
    /// 05: accepted, it takes long.
    pub const ACKNOWLEDGE: ExceptionCode = ExceptionCode(0x05);
    /// 06: busy with something long.
    pub const BUSY: ExceptionCode = ExceptionCode(0x06);
    /// 0A: a gateway has no path.
    pub const NO_PATH: ExceptionCode = ExceptionCode(0x0A);
    /// 0B: no answer behind a gateway.
    pub const NO_RESPONSE: ExceptionCode = ExceptionCode(0x0B);

    /// Its meaning, if known.
    pub const fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            0x01 => "function not supported",
            0x02 => "no such parameter, or too many registers at once",
            0x03 => "an invalid value in the request",
            0x04 => "the drive failed to do it",
            0x05 => "accepted, but it takes long: repeat the request",
            0x06 => "busy: repeat the request",
            0x0A => "the gateway has no path to it",
            0x0B => "it does not answer the gateway",
            _ => return None,
        })
    }
}

impl fmt::Debug for ExceptionCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "ExceptionCode({:#04x})", self.0)
    }
}

impl fmt::Display for ExceptionCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "exception {:02X}h {}", self.0, self.name().unwrap_or("(not in the standard)"))
    }
}

/// Big-endian registers in wire order. Those of 32-bit access come in pairs, high word first (SI-Ethernet guide).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Registers<'a>(&'a [u8]);

impl<'a> Registers<'a> {
    /// Of these bytes; `None` if their number is odd.
    #[inline]
    pub const fn new(bytes: &'a [u8]) -> Option<Registers<'a>> {
        if bytes.len().is_multiple_of(2) { Some(Registers(bytes)) } else { None }
    }

    /// So many, all 0, at most [`REGISTERS_MAX`].
    pub(super) fn zeros(count: u16) -> Registers<'static> {
        const ZEROS: [u8; RegistersBuffer::BYTES] = [0; RegistersBuffer::BYTES];
        Registers(ZEROS.get(..2 * usize::from(count)).unwrap_or_default())
    }

    /// The number of registers.
    #[inline]
    pub const fn len(self) -> usize {
        self.0.len() / 2
    }

    /// There are none.
    #[inline]
    pub const fn is_empty(self) -> bool {
        self.0.is_empty()
    }

    /// Register `index`.
    #[inline]
    pub fn word(self, index: usize) -> Option<u16> {
        let at = index.checked_mul(2)?;
        self.0.get(at..)?.first_chunk().map(|word| u16::from_be_bytes(*word))
    }

    /// Registers `2 * index` and `2 * index + 1` as one value of 32-bit access.
    #[inline]
    pub fn long(self, index: usize) -> Option<i32> {
        let at = index.checked_mul(4)?;
        self.0.get(at..)?.first_chunk().map(|long| i32::from_be_bytes(*long))
    }

    /// All of them.
    #[inline]
    pub fn words(self) -> impl Iterator<Item = u16> + 'a {
        self.0.as_chunks().0.iter().map(|word| u16::from_be_bytes(*word))
    }

    /// All of them in pairs, as values of 32-bit access; a single last one is left out.
    #[inline]
    pub fn longs(self) -> impl Iterator<Item = i32> + 'a {
        self.0.as_chunks().0.iter().map(|long| i32::from_be_bytes(*long))
    }

    /// The bytes in wire order.
    #[inline]
    pub const fn bytes(self) -> &'a [u8] {
        self.0
    }
}

/// Room for as many registers as a Unidrive accepts or returns at once.
#[derive(Clone, Copy, Debug)]
pub struct RegistersBuffer {
    bytes: [u8; RegistersBuffer::BYTES],
    length: usize,
}

impl RegistersBuffer {
    const BYTES: usize = 2 * REGISTERS_MAX as usize;

    /// Empty.
    pub const fn new() -> RegistersBuffer {
        RegistersBuffer { bytes: [0; RegistersBuffer::BYTES], length: 0 }
    }

    /// Removes its content.
    #[inline]
    pub fn clear(&mut self) {
        self.length = 0;
    }

    /// Appends one register; false, and nothing is changed, if there is no room.
    #[inline]
    pub fn push_word(&mut self, word: u16) -> bool {
        self.push(word.to_be_bytes())
    }

    /// Appends a value of 32-bit access; false, and nothing is changed, if there is no room.
    #[inline]
    pub fn push_long(&mut self, long: i32) -> bool {
        self.push(long.to_be_bytes())
    }

    #[inline]
    fn push<const N: usize>(&mut self, bytes: [u8; N]) -> bool {
        let room = self.bytes.get_mut(self.length..).and_then(|free| free.first_chunk_mut());
        let Some(room) = room else { return false };
        *room = bytes;
        self.length += N;
        true
    }

    /// Its content.
    #[inline]
    pub fn registers(&self) -> Registers<'_> {
        Registers(self.bytes.get(..self.length).unwrap_or_default())
    }
}

impl Default for RegistersBuffer {
    fn default() -> RegistersBuffer {
        RegistersBuffer::new()
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

/// A number of registers, then as [`sized`].
#[inline]
fn counted(block: &[u8]) -> Option<Registers<'_>> {
    let (count, rest) = block.split_first_chunk()?;
    sized(rest).filter(|data| data.len() == usize::from(u16::from_be_bytes(*count)))
}

#[cfg(test)]
mod tests;
