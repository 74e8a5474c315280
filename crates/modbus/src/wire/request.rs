//! A request, client to server.

use thiserror::Error;

use super::{Fill, HEADER, Header, Registers, body, field, function, pair, sized};

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
    /// The function.
    #[inline]
    pub const fn function(&self) -> u8 {
        match self {
            Request::Read { .. } => function::READ,
            Request::WriteOne { .. } => function::WRITE_ONE,
            Request::Write { .. } => function::WRITE,
            Request::ReadWrite { .. } => function::READ_WRITE,
        }
    }

    /// Bytes of the whole message. Over `ADU_MAX` it has too many registers for one message.
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

    /// Reads a message that `frame` has found. It is as strict as the standard: every length in it has to agree with
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
    /// The function.
    pub function: u8,
    /// The fault.
    pub fault: RequestFault,
}
fieldbeat_core::debug_as_display!(RequestError);

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
fieldbeat_core::debug_as_display!(RequestFault);

/// A number of registers, then as [`sized`].
#[inline]
fn counted(block: &[u8]) -> Option<Registers<'_>> {
    let (count, rest) = block.split_first_chunk()?;
    sized(rest).filter(|data| data.len() == usize::from(u16::from_be_bytes(*count)))
}
