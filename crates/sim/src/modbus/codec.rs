//! Modbus TCP on the wire, from the drive's end: messages, addresses of parameters, bits and trips.
//!
//! Written from the facts of the manuals and independent of the master's codec: a field that one of them misreads
//! cannot agree with itself. A test outside of both crates compares them. All fields are big-endian.

#![expect(missing_docs, reason = "fields, bits and trips are named as in the manuals")]

/// The longest message.
pub const ADU_MAX: usize = 260;
/// The most registers of a request in one direction.
pub const REGISTERS_MAX: u16 = 120;
/// The unit id of the drive, and that of the Ethernet interface.
pub const DRIVE_UNIT: u8 = 255;
pub const INTERFACE_UNIT: u8 = 254;

/// Function codes.
pub mod function {
    pub const READ: u8 = 3;
    pub const WRITE_ONE: u8 = 6;
    pub const WRITE: u8 = 16;
    pub const READ_WRITE: u8 = 23;
}

/// Exception codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Exception {
    Function = 1,
    Address = 2,
}

/// Bits of the control word, 06.042.
pub mod control {
    pub const ENABLE: u16 = 1 << 0;
    pub const RUN_FORWARD: u16 = 1 << 1;
    pub const JOG_FORWARD: u16 = 1 << 2;
    pub const RUN_REVERSE: u16 = 1 << 3;
    pub const REVERSE: u16 = 1 << 4;
    pub const RUN: u16 = 1 << 5;
    pub const NOT_STOP: u16 = 1 << 6;
    pub const AUTO: u16 = 1 << 7;
    pub const REMOTE: u16 = 1 << 8;
    pub const JOG_REVERSE: u16 = 1 << 9;
    pub const TRIP: u16 = 1 << 12;
    pub const RESET: u16 = 1 << 13;
    pub const KEYPAD_WATCHDOG: u16 = 1 << 14;
    /// Switched off; enabled without a run bit; running forward and backward.
    pub const IDLE: u16 = 0x0180;
    pub const ENABLED: u16 = 0x0181;
    pub const FORWARD: u16 = 0x0183;
    pub const BACKWARD: u16 = 0x0189;
}

/// Bits of the status word, 10.040.
pub mod status {
    pub const HEALTHY: u16 = 1 << 0;
    pub const ACTIVE: u16 = 1 << 1;
    pub const ZERO_SPEED: u16 = 1 << 2;
    pub const AT_MINIMUM: u16 = 1 << 3;
    pub const BELOW_SPEED: u16 = 1 << 4;
    pub const AT_SPEED: u16 = 1 << 5;
    pub const ABOVE_SPEED: u16 = 1 << 6;
    pub const LOAD_REACHED: u16 = 1 << 7;
    pub const CURRENT_LIMIT: u16 = 1 << 8;
    pub const REGENERATING: u16 = 1 << 9;
    pub const REVERSE_COMMANDED: u16 = 1 << 12;
    pub const REVERSE_RUNNING: u16 = 1 << 13;
}

/// Numbers of trips, and of the two user trips (10.038) that are none.
pub mod trip {
    pub const NONE: u16 = 0;
    pub const OVER_CURRENT: u16 = 3;
    pub const WATCHDOG: u16 = 30;
    pub const CONTROL_WORD: u16 = 35;
    pub const USER_RESET: u16 = 100;
    pub const USER_CLEAR: u16 = 255;

    /// "Slot error" of the slot that an interface is in (assumed).
    pub const fn slot_error(slot: u8) -> u16 {
        match slot {
            1 => 202,
            2 => 207,
            3 => 212,
            _ => 252,
        }
    }
}

/// Bytes that are not Modbus: the connection has to end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NoModbus;

/// The size of the message at the front; `None`: it is not complete.
pub fn message(bytes: &[u8]) -> Result<Option<usize>, NoModbus> {
    if bytes.iter().skip(2).take(2).any(|protocol| *protocol != 0) {
        return Err(NoModbus);
    }
    let &[_, _, _, _, high, low, ..] = bytes else { return Ok(None) };
    let length = usize::from(u16::from_be_bytes([high, low]));
    if !(2..=ADU_MAX - 6).contains(&length) {
        return Err(NoModbus);
    }
    Ok(Some(6 + length).filter(|size| *size <= bytes.len()))
}

/// The identity of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    pub transaction: u16,
    pub unit: u8,
    pub function: u8,
}

/// The content of a request. Data are whole registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request<'a> {
    Read {
        address: u16,
        count: u16,
    },
    WriteOne {
        address: u16,
        value: [u8; 2],
    },
    Write {
        address: u16,
        data: &'a [u8],
    },
    ReadWrite {
        read: u16,
        count: u16,
        write: u16,
        data: &'a [u8],
    },
    /// Another function.
    Unsupported,
}

/// Reads a whole message. One whose lengths contradict each other is not Modbus.
pub fn request(message: &[u8]) -> Result<(Header, Request<'_>), NoModbus> {
    let &[high, low, _, _, _, _, unit, function, ref body @ ..] = message else { return Err(NoModbus) };
    let header = Header { transaction: u16::from_be_bytes([high, low]), unit, function };
    let words = |at: usize| {
        let bytes = body.get(2 * at..).and_then(<[u8]>::first_chunk);
        bytes.map(|bytes| u16::from_be_bytes(*bytes)).ok_or(NoModbus)
    };
    // Behind so many words: the registers that the last of them announces, with their size in bytes in front.
    let data = |at: usize| {
        let size = 2 * usize::from(words(at - 1)?);
        let [bytes, data @ ..] = body.get(2 * at..).unwrap_or_default() else { return Err(NoModbus) };
        if usize::from(*bytes) == size && data.len() == size { Ok(data) } else { Err(NoModbus) }
    };
    let content = match function {
        function::READ | function::WRITE_ONE if body.len() != 4 => return Err(NoModbus),
        function::READ => Request::Read { address: words(0)?, count: words(1)? },
        function::WRITE_ONE => Request::WriteOne { address: words(0)?, value: words(1)?.to_be_bytes() },
        function::WRITE => Request::Write { address: words(0)?, data: data(2)? },
        function::READ_WRITE => {
            Request::ReadWrite { read: words(0)?, count: words(1)?, write: words(2)?, data: data(4)? }
        }
        _ => Request::Unsupported,
    };
    Ok((header, content))
}

/// The content of a response.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Response<'a> {
    /// Registers that were read.
    Data(&'a [u8]),
    /// The address of what was written; behind it the value (function 6), or the number of registers (16), fewer than
    /// in the request if one was refused.
    Written {
        address: u16,
        what: u16,
    },
    Exception(Exception),
}

/// Appends a response to the request with this header.
pub fn respond(header: Header, response: Response<'_>, to: &mut Vec<u8>) {
    let Header { transaction, unit, mut function } = header;
    let (front, data) = match response {
        Response::Data(data) => (vec![data.len() as u8], data),
        Response::Written { address, what } => ([address, what].map(u16::to_be_bytes).concat(), &[][..]),
        Response::Exception(exception) => {
            function |= 0x80;
            (vec![exception as u8], &[][..])
        }
    };
    let length = (2 + front.len() + data.len()) as u16;
    [transaction, 0, length].iter().for_each(|word| to.extend(word.to_be_bytes()));
    to.extend([unit, function]);
    to.extend(front);
    to.extend(data);
}

/// A parameter and the width of its access, as an address names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    pub menu: u8,
    pub number: u8,
    /// 32 bits; else 16.
    pub long: bool,
}

/// The parameter at an address: with `modified` addressing 256 a menu, else 100.
pub fn place(address: u16, modified: bool) -> Option<Place> {
    let each = if modified { 256 } else { 100 };
    let last = if modified { 63 } else { 162 };
    let index = (address & 0x3FFF) + 1;
    let (menu, number) = (index / each, index % each);
    let is_valid = address & 0x8000 == 0 && menu <= last;
    is_valid.then_some(Place { menu: menu as u8, number: number as u8, long: address & 0x4000 != 0 })
}
