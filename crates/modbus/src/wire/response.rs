//! A response, server to client.

use std::fmt;

use thiserror::Error;

use super::{Fill, HEADER, Header, Registers, body, field, function, pair, sized};

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

    /// Bytes of the whole message. Over `ADU_MAX` it has too many registers for one message.
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

    /// Reads a message that `frame` has found. It is as strict as the standard: every length in it has to agree
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
    /// It is not a message that `frame` finds.
    #[error("{bytes} bytes are not one message with a header")]
    Frame {
        /// The length, bytes.
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
        "function {function}: the lengths in it contradict each other: not a Modbus server, or bytes were \
         lost"
    )]
    Length {
        /// The header of the message.
        header: Header,
        /// The function.
        function: u8,
    },
}
fieldbeat_core::debug_as_display!(ResponseError);

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

    /// The request is to be repeated: 05 and 06.
    pub const fn is_busy(self) -> bool {
        matches!(self, Self::ACKNOWLEDGE | Self::BUSY)
    }

    /// The meaning, if known.
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
