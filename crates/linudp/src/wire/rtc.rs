//! The real-time-config channel's block, its commands, and the drive's answers to them.
//!
//! Facts: LinUDP V2 manual 0185-1108-E 1V9, chapter 7. Its detail page calls the saving of the command table 75h; the
//! list of commands, which is right, says 80h.

use std::fmt;

use thiserror::Error;

/// The real-time-config block, both directions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RtcBlock {
    /// Bits 0-3: command count, echoed by the drive. Bits 4-7 are reserved and kept as they come.
    pub tag: u8,
    /// To the drive: the [`RtcCommand`]. From the drive: the parameter status, not the command.
    pub code: u8,
    /// Words 2, 3 and 4: most commands take and give an index, then a value, low word first.
    pub words: [u16; 3],
}

impl RtcBlock {
    /// Bytes on the wire.
    pub const SIZE: usize = 8;

    /// A command without parameters.
    pub const fn command(count: u8, command: RtcCommand) -> RtcBlock {
        RtcBlock { tag: count & 0xF, code: command.0, words: [0; 3] }
    }

    /// A command with an index and a value.
    pub const fn call(count: u8, command: RtcCommand, index: u16, value: u32) -> RtcBlock {
        RtcBlock { words: [index, value as u16, (value >> 16) as u16], ..RtcBlock::command(count, command) }
    }

    /// A drive's answer with this status code and nothing else.
    pub const fn answer(count: u8, code: u8) -> RtcBlock {
        RtcBlock { tag: count & 0xF, code, words: [0; 3] }
    }

    /// The command count or its echo, 0 ... 15.
    pub const fn count(&self) -> u8 {
        self.tag & 0xF
    }

    /// Word 2.
    pub const fn index(&self) -> u16 {
        self.words[0]
    }

    /// Words 3 and 4 as one value.
    pub const fn value(&self) -> u32 {
        (self.words[2] as u32) << 16 | self.words[1] as u32
    }

    /// The drive's status, if the block comes from a drive.
    pub fn status(&self) -> RtcStatus {
        RtcStatus::of(self.code)
    }

    pub(super) fn from_bytes(bytes: [u8; RtcBlock::SIZE]) -> RtcBlock {
        let [tag, code, a, b, c, d, e, f] = bytes;
        let word = |low, high| u16::from_le_bytes([low, high]);
        RtcBlock { tag, code, words: [word(a, b), word(c, d), word(e, f)] }
    }

    pub(super) fn to_bytes(self) -> [u8; RtcBlock::SIZE] {
        let [[a, b], [c, d], [e, f]] = self.words.map(u16::to_le_bytes);
        [self.tag, self.code, a, b, c, d, e, f]
    }
}

/// A command on the real-time-config channel.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct RtcCommand(pub u8);

named! {
    RtcCommand

    /// Does nothing. Its count is echoed all the same.
    NO_OPERATION = 0x00, "no operation";
    /// Word 2 UPID; gives the value in flash, which holds after the next start.
    READ_ROM = 0x10, "read ROM value";
    /// Word 2 UPID; gives the value in use.
    READ_RAM = 0x11, "read RAM value";
    /// Word 2 UPID, then the value.
    WRITE_ROM = 0x12, "write ROM value";
    /// Word 2 UPID, then the value.
    WRITE_RAM = 0x13, "write RAM value";
    /// Word 2 UPID, then the value.
    WRITE_BOTH = 0x14, "write RAM and ROM value";
    /// Word 2 UPID.
    READ_MINIMUM = 0x15, "read minimum";
    /// Word 2 UPID.
    READ_MAXIMUM = 0x16, "read maximum";
    /// Word 2 UPID.
    READ_DEFAULT = 0x17, "read default";
    /// Word 2: the UPID to begin at.
    START_LIST = 0x20, "start UPID list";
    /// Gives a UPID and in word 3 its address usage; ends with [`Refusal::EndOfList`].
    NEXT_ITEM = 0x21, "next UPID";
    /// Word 2: the UPID to begin at.
    START_MODIFIED_LIST = 0x22, "start list of modified UPIDs";
    /// Gives a UPID and its value; ends with [`Refusal::EndOfList`].
    NEXT_MODIFIED_ITEM = 0x23, "next modified UPID";
    /// The link drops.
    RESTART = 0x30, "restart the drive";
    /// Takes effect at the next start.
    DEFAULT_OS = 0x31, "operating system parameters to default";
    /// Takes effect at the next start.
    DEFAULT_MC = 0x32, "motion control parameters to default";
    /// Takes effect at the next start.
    DEFAULT_INTERFACE = 0x33, "interface parameters to default";
    /// Takes effect at the next start.
    DEFAULT_APPLICATION = 0x34, "application parameters to default";
    /// Status word and state variable are 0 from then on.
    STOP_SOFTWARE = 0x35, "stop motion control and application software";
    /// The drive has to be homed again.
    START_SOFTWARE = 0x36, "start motion control and application software";
    /// Needs the software to be stopped; silent for up to minutes.
    SAVE_CURVES = 0x40, "save curves to flash";
    /// In RAM only.
    DELETE_CURVES = 0x41, "delete all curves";
    /// Word 2 curve, word 3 bytes of the info block, word 4 bytes of data.
    ADD_CURVE = 0x50, "add curve";
    /// Word 2 curve, then 4 bytes.
    ADD_CURVE_INFO = 0x51, "add curve info";
    /// Word 2 curve, then 4 bytes.
    ADD_CURVE_DATA = 0x52, "add curve data";
    /// As [`ADD_CURVE`](Self::ADD_CURVE), of one that exists.
    MODIFY_CURVE = 0x53, "modify curve";
    /// Word 2 curve, then 4 bytes.
    MODIFY_CURVE_INFO = 0x54, "modify curve info";
    /// Word 2 curve, then 4 bytes.
    MODIFY_CURVE_DATA = 0x55, "modify curve data";
    /// Word 2 curve; gives the sizes, bytes.
    GET_CURVE = 0x60, "get curve";
    /// Word 2 curve; gives 4 bytes.
    GET_CURVE_INFO = 0x61, "get curve info";
    /// Word 2 curve; gives 4 bytes.
    GET_CURVE_DATA = 0x62, "get curve data";
    /// Gives in words 3 and 4 the entries logged and the errors occurred.
    ERROR_COUNTERS = 0x70, "error log counters";
    /// Word 2 entry 0 ... 20; gives the code in word 3.
    ERROR_CODE = 0x71, "error log code";
    /// Word 2 entry; gives the low half of the time: ms.
    ERROR_TIME_LOW = 0x72, "error log time, low";
    /// Word 2 entry; gives the high half of the time: hours.
    ERROR_TIME_HIGH = 0x73, "error log time, high";
    /// Word 2 error code, word 3 which 4 bytes of the text, 0 ... 7.
    ERROR_TEXT = 0x74, "error text";
    /// Needs the software to be stopped; silent for up to minutes.
    SAVE_TABLE = 0x80, "save command table to flash";
    /// In RAM only.
    DELETE_TABLE = 0x81, "delete command table";
    /// Word 2 entry.
    DELETE_ENTRY = 0x82, "delete command table entry";
    /// Word 2 entry, word 3 its bytes, an even number.
    WRITE_ENTRY = 0x83, "write command table entry";
    /// Word 2 entry, then 4 bytes.
    WRITE_ENTRY_DATA = 0x84, "write command table entry data";
    /// Word 2 entry; gives its bytes in word 3.
    GET_ENTRY = 0x85, "get command table entry";
    /// Word 2 entry; gives 4 bytes.
    GET_ENTRY_DATA = 0x86, "get command table entry data";
    /// Gives the presence of entries 0 ... 31: a bit that is **0** is an entry that is used. 88h ... 8Eh follow.
    PRESENCE_0 = 0x87, "command table presence 0-31";
    /// Entries 32 ... 63.
    PRESENCE_1 = 0x88, "command table presence 32-63";
    /// Entries 64 ... 95.
    PRESENCE_2 = 0x89, "command table presence 64-95";
    /// Entries 96 ... 127.
    PRESENCE_3 = 0x8A, "command table presence 96-127";
    /// Entries 128 ... 159.
    PRESENCE_4 = 0x8B, "command table presence 128-159";
    /// Entries 160 ... 191.
    PRESENCE_5 = 0x8C, "command table presence 160-191";
    /// Entries 192 ... 223.
    PRESENCE_6 = 0x8D, "command table presence 192-223";
    /// Entries 224 ... 255.
    PRESENCE_7 = 0x8E, "command table presence 224-255";
}

impl fmt::Debug for RtcCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "RtcCommand({:#04x})", self.0)
    }
}

impl fmt::Display for RtcCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.name() {
            Some(name) => write!(f, "{name} ({:02X}h)", self.0),
            None => write!(f, "{:02X}h", self.0),
        }
    }
}

/// The drive's answer to a command: the parameter status.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum RtcStatus {
    /// 00h: done.
    Done,
    /// 02h: the command runs.
    Running,
    /// 04h: done, and the block that it belongs to is not finished.
    BlockNotFinished,
    /// 05h: busy.
    Busy,
    /// C0h and above: not done.
    Refused(Refusal),
    /// Below C0h and not in the manual: finished, as far as is known.
    Other(u8),
}

impl RtcStatus {
    /// 00h.
    pub const DONE: u8 = 0x00;
    /// 02h.
    pub const RUNNING: u8 = 0x02;
    /// 04h.
    pub const BLOCK_NOT_FINISHED: u8 = 0x04;
    /// 05h.
    pub const BUSY: u8 = 0x05;

    /// The meaning of `code`.
    pub fn of(code: u8) -> RtcStatus {
        match code {
            RtcStatus::DONE => RtcStatus::Done,
            RtcStatus::RUNNING => RtcStatus::Running,
            RtcStatus::BLOCK_NOT_FINISHED => RtcStatus::BlockNotFinished,
            RtcStatus::BUSY => RtcStatus::Busy,
            0xC0.. => RtcStatus::Refused(Refusal::of(code)),
            _ => RtcStatus::Other(code),
        }
    }
}

/// Why a drive did not execute a command, in the manual's meaning.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Error)]
pub enum Refusal {
    /// C0h.
    #[error("the drive has no such UPID (C0h)")]
    NoSuchUpid,
    /// C1h.
    #[error("the parameter has another type (C1h)")]
    WrongType,
    /// C2h.
    #[error("the value is out of the parameter's range (C2h)")]
    OutOfRange,
    /// C3h.
    #[error("the parameter cannot be used that way: read-only, write-only, or not in that memory (C3h)")]
    AddressUsage,
    /// C5h.
    #[error("the next item of a list that was not started (C5h)")]
    ListNotStarted,
    /// C6h.
    #[error("the end of the UPID list (C6h)")]
    EndOfList,
    /// D0h.
    #[error("an odd address or size (D0h)")]
    OddAddress,
    /// D1h.
    #[error("a wrong size, or a block that was not started (D1h)")]
    WrongSize,
    /// D4h.
    #[error("the curve is defined already, or there is none (D4h)")]
    CurveDefinition,
    /// D7h, known from the LinRS interface.
    #[error("the motion control software has to be stopped first (D7h)")]
    SoftwareRuns,
    /// Any other code from C0h.
    #[error("the drive's status {0:02X}h, which the manual does not list")]
    Unlisted(u8),
}
fieldbeat_core::debug_as_display!(Refusal);

impl Refusal {
    const CODES: [(u8, Refusal); 10] = [
        (0xC0, Refusal::NoSuchUpid),
        (0xC1, Refusal::WrongType),
        (0xC2, Refusal::OutOfRange),
        (0xC3, Refusal::AddressUsage),
        (0xC5, Refusal::ListNotStarted),
        (0xC6, Refusal::EndOfList),
        (0xD0, Refusal::OddAddress),
        (0xD1, Refusal::WrongSize),
        (0xD4, Refusal::CurveDefinition),
        (0xD7, Refusal::SoftwareRuns),
    ];

    /// The meaning of `code`, C0h or above.
    pub fn of(code: u8) -> Refusal {
        let known = Refusal::CODES.iter().find(|(known, _)| *known == code);
        known.map_or(Refusal::Unlisted(code), |(_, refusal)| *refusal)
    }

    /// The code.
    pub fn code(self) -> u8 {
        match self {
            Refusal::Unlisted(code) => code,
            known => {
                Refusal::CODES.iter().find(|(_, refusal)| *refusal == known).map_or(0, |(code, _)| *code)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_of_the_manual_has_its_own_name_and_code() {
        let all = RtcCommand::ALL;
        assert_eq!(all.len(), 51);
        assert!(all.windows(2).all(|pair| pair[0].0 < pair[1].0), "in the order of their codes");
        assert!(all.iter().all(|command| command.name().is_some()));
        assert_eq!(RtcCommand(0x75).name(), None);
    }

    #[test]
    fn a_status_is_read_as_the_manual_says() {
        for code in 0..=u8::MAX {
            match RtcStatus::of(code) {
                RtcStatus::Refused(refusal) => {
                    assert!(code >= 0xC0);
                    assert_eq!(refusal.code(), code);
                    let listed = !matches!(refusal, Refusal::Unlisted(_));
                    assert_eq!(Refusal::CODES.contains(&(code, refusal)), listed);
                    assert!(refusal.to_string().contains(&format!("{code:02X}h")), "{refusal}");
                }
                RtcStatus::Other(other) => assert!(other == code && code < 0xC0),
                _ => assert!([0, 2, 4, 5].contains(&code)),
            }
        }
    }
}
