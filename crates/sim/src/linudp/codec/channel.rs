//! The real-time-config channel: its block, commands and status, and the access to parameters.

/// The block, in both directions: the code is the command, or the status of the answer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ConfigBlock {
    /// 0 ... 15; the other four bits of its byte are reserved.
    pub count: u8,
    pub code: u8,
    /// Words 2, 3 and 4.
    pub words: [u16; 3],
}

impl ConfigBlock {
    pub fn parse([count, code, a, b, c, d, e, f]: [u8; 8]) -> ConfigBlock {
        let words = [[a, b], [c, d], [e, f]].map(u16::from_le_bytes);
        ConfigBlock { count: count & 0xF, code, words }
    }

    pub fn bytes(&self) -> [u8; 8] {
        let [[a, b], [c, d], [e, f]] = self.words.map(u16::to_le_bytes);
        [self.count, self.code, a, b, c, d, e, f]
    }

    /// Words 3 and 4, the low one first.
    pub fn value(&self) -> u32 {
        u32::from(self.words[2]) << 16 | u32::from(self.words[1])
    }
}

/// Command ids.
pub mod command {
    pub const NO_OPERATION: u8 = 0x00;
    pub const READ_ROM: u8 = 0x10;
    pub const READ_RAM: u8 = 0x11;
    pub const WRITE_ROM: u8 = 0x12;
    pub const WRITE_RAM: u8 = 0x13;
    pub const WRITE_BOTH: u8 = 0x14;
    pub const READ_MINIMUM: u8 = 0x15;
    pub const READ_MAXIMUM: u8 = 0x16;
    pub const READ_DEFAULT: u8 = 0x17;
    pub const START_LIST: u8 = 0x20;
    pub const NEXT_ITEM: u8 = 0x21;
    pub const START_MODIFIED_LIST: u8 = 0x22;
    pub const NEXT_MODIFIED_ITEM: u8 = 0x23;
    pub const RESTART: u8 = 0x30;
    pub const DEFAULT_OS: u8 = 0x31;
    pub const DEFAULT_MC: u8 = 0x32;
    pub const DEFAULT_INTERFACE: u8 = 0x33;
    pub const DEFAULT_APPLICATION: u8 = 0x34;
    pub const STOP_SOFTWARE: u8 = 0x35;
    pub const START_SOFTWARE: u8 = 0x36;
    pub const SAVE_CURVES: u8 = 0x40;
    pub const DELETE_CURVES: u8 = 0x41;
    pub const ADD_CURVE: u8 = 0x50;
    pub const ADD_CURVE_INFO: u8 = 0x51;
    pub const ADD_CURVE_DATA: u8 = 0x52;
    pub const MODIFY_CURVE: u8 = 0x53;
    pub const MODIFY_CURVE_INFO: u8 = 0x54;
    pub const MODIFY_CURVE_DATA: u8 = 0x55;
    pub const GET_CURVE: u8 = 0x60;
    pub const GET_CURVE_INFO: u8 = 0x61;
    pub const GET_CURVE_DATA: u8 = 0x62;
    pub const ERROR_COUNTERS: u8 = 0x70;
    pub const ERROR_CODE: u8 = 0x71;
    pub const ERROR_TIME_LOW: u8 = 0x72;
    pub const ERROR_TIME_HIGH: u8 = 0x73;
    pub const ERROR_TEXT: u8 = 0x74;
    pub const SAVE_TABLE: u8 = 0x80;
    pub const DELETE_TABLE: u8 = 0x81;
    pub const DELETE_ENTRY: u8 = 0x82;
    pub const WRITE_ENTRY: u8 = 0x83;
    pub const WRITE_ENTRY_DATA: u8 = 0x84;
    pub const GET_ENTRY: u8 = 0x85;
    pub const GET_ENTRY_DATA: u8 = 0x86;
    /// Of entries 0 ... 31; seven more follow, each of the next 32.
    pub const PRESENCE: u8 = 0x87;
    pub const LAST_PRESENCE: u8 = 0x8E;
}

/// Status of an answer.
pub mod status {
    pub const DONE: u8 = 0x00;
    pub const RUNNING: u8 = 0x02;
    pub const BLOCK_NOT_FINISHED: u8 = 0x04;
    pub const BUSY: u8 = 0x05;
}

/// A command that is refused: the status of its answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Refusal {
    NoSuchUpid = 0xC0,
    WrongType = 0xC1,
    OutOfRange = 0xC2,
    AddressUsage = 0xC3,
    ListNotStarted = 0xC5,
    EndOfList = 0xC6,
    OddAddress = 0xD0,
    WrongSize = 0xD1,
    /// A curve that exists already, or does not exist.
    CurveDefinition = 0xD4,
    /// From the serial interface of the same drives.
    SoftwareRuns = 0xD7,
}

/// Address usage of a UPID, as command 21h reports it.
pub mod usage {
    pub const RAM_READ: u16 = 1 << 0;
    pub const RAM_WRITE: u16 = 1 << 1;
    pub const ROM_READ: u16 = 1 << 2;
    pub const ROM_WRITE: u16 = 1 << 3;
    pub const LIVE: u16 = 1 << 8;
    pub const NOT_HASHED: u16 = 1 << 12;
}

/// The type of a parameter. Its value is in the low bits of 32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Type {
    Bool,
    U8,
    U16,
    S16,
    U32,
    S32,
    /// Four characters of a text.
    Stringlet,
}

impl Type {
    /// The smallest and the largest value.
    pub const fn range(self) -> (i64, i64) {
        match self {
            Type::Bool => (0, 1),
            Type::U8 => (0, 0xFF),
            Type::U16 => (0, 0xFFFF),
            Type::S16 => (-0x8000, 0x7FFF),
            Type::U32 | Type::Stringlet => (0, 0xFFFF_FFFF),
            Type::S32 => (-0x8000_0000, 0x7FFF_FFFF),
        }
    }

    /// A value on the wire; `extend`: a narrow one carries its sign in the bits above.
    pub fn to_wire(self, value: i64, extend: bool) -> u32 {
        if self == Type::S16 && !extend { (value as u16).into() } else { value as u32 }
    }

    /// A value from the wire; `None` if it is none of this type.
    pub fn from_wire(self, raw: u32) -> Option<i64> {
        let (low, high) = self.range();
        let value = if low < 0 { (raw as i32).into() } else { raw.into() };
        (low..=high).contains(&value).then_some(value)
    }
}
