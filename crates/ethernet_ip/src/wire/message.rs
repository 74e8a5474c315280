//! These drives' own messages: service 0x3C of class 0x64, eight bytes each way, big-endian (Applied Motion, Host
//! Command Reference 920-0002 W, EtherNet/IP explicit messages).

use super::assembly::Version;
use super::cip::{Segment, class};
use super::opcodes::{Opcode, Operand};

/// Where messages go, with `service::VENDOR`.
pub const PATH: [Segment<'static>; 3] =
    [Segment::Class(class::VENDOR), Segment::Instance(1), Segment::Attribute(1)];
/// Where the profile code is, with `service::GET_ATTRIBUTE_SINGLE`.
pub const PROFILE_PATH: [Segment<'static>; 3] =
    [Segment::Class(class::VENDOR), Segment::Instance(0), Segment::Attribute(1)];

/// A message, or its answer.
pub type Payload = [u8; 8];

/// Type 1: a command that is buffered behind the others.
const BUFFERED: u8 = 1;
/// Type 2: a command that is executed at once.
const IMMEDIATE: u8 = 2;

/// The commands that are executed at once, as on the wire.
pub mod immediate {
    /// Writes a parameter of `opcodes::PARAMETERS`. With bit 7 of its index also into the flash memory.
    pub const WRITE_PARAMETER: u8 = 0x83;
    /// Reads a parameter.
    pub const READ_PARAMETER: u8 = 0x84;
    /// Reads the history of alarms, whose meaning the manual does not say.
    pub const READ_ALARM_HISTORY: u8 = 0x87;
    /// Reads the position of the encoder (0), or the absolute one (1).
    pub const READ_POSITION: u8 = 0x88;
    /// Sets an output, counted from 0, up to 127: closed (low) with bit 7, else open.
    pub const SET_OUTPUT: u8 = 0x8B;
    /// AR: clears the fault. The motor stays without current.
    pub const RESET_ALARM: u8 = 0x8E;
    /// SK: stops as by [`STOP`], and discards what is buffered.
    pub const KILL: u8 = 0x98;
    /// Writes a register of `opcodes::REGISTERS`. The drive does not check the value.
    pub const WRITE_REGISTER: u8 = 0x9E;
    /// Reads a register.
    pub const READ_REGISTER: u8 = 0x9F;
    /// QL: loads the Q program.
    pub const LOAD_PROGRAM: u8 = 0xA1;
    /// QS: saves a segment of it, 1 ... 12.
    pub const SAVE_SEGMENT: u8 = 0xA2;
    /// ST: stops with the largest deceleration (0: AM), or that of the move (1: DE) or jog (JL).
    pub const STOP: u8 = 0xA3;
}

/// A command that is executed at once. A parameter has the upper half of `value`.
pub const fn immediate(opcode: u8, operand: u8, value: u32) -> Payload {
    let [a, b, c, d] = value.to_be_bytes();
    [0, IMMEDIATE, opcode, operand, a, b, c, d]
}

/// A command for the buffer; `None` if it has no such operand. `field`: the register or I/O code next to the operand, 0
/// for most. Two I/O codes have the first one in the lower half.
///
/// A negative operand of 16 bits is not extended: the manual does not say it.
pub fn buffered(opcode: Opcode, field: u8, value: i64) -> Option<Payload> {
    let word = (i16::MIN.into(), u16::MAX.into());
    let long = (i32::MIN.into(), i32::MAX.into());
    let ((low, high), with_field) = match opcode.operand {
        Operand::None => ((0, 0), false),
        Operand::Byte => ((0, 0xFF), false),
        Operand::Word => (word, false),
        Operand::Long => (long, false),
        Operand::Io => ((0, u16::MAX.into()), false),
        Operand::TwoIos => ((0, u32::MAX.into()), false),
        Operand::FieldWord => (word, true),
        Operand::Register => ((0, 0), true),
        Operand::RegisterLong => (long, true),
    };
    if !(low..=high).contains(&value) || !with_field && field != 0 {
        return None;
    }
    let wide = matches!(opcode.operand, Operand::Long | Operand::TwoIos | Operand::RegisterLong);
    let [a, b, c, d] = (value as u32 & if wide { u32::MAX } else { 0xFFFF }).to_be_bytes();
    Some([0, BUFFERED, field, opcode.code, a, b, c, d])
}

/// The drive's answer to a request: a register, a position or the history of alarms, 32 bits; a parameter, 16
/// bits; to everything else its status word, see `assembly::status`. `None`: the answer is to another message.
pub fn answer(request: &[u8], answer: &[u8]) -> Option<u32> {
    let &[_, due, opcode, operand, ..] = request else { return None };
    let &[zero, kind, first, second, a, b, c, d]: &Payload = answer.try_into().ok()?;
    // That to a command of the buffer need not repeat the field.
    if [zero, kind, second] != [0, due, operand] || kind != BUFFERED && first != opcode {
        return None;
    }
    Some(match first {
        immediate::READ_ALARM_HISTORY | immediate::READ_POSITION | immediate::READ_REGISTER
            if kind == IMMEDIATE =>
        {
            u32::from_be_bytes([a, b, c, d])
        }
        _ => u16::from_be_bytes([a, b]).into(),
    })
}

/// Which assemblies a drive has, by its profile code: the firmware of its Ethernet board (major and minor, two bytes
/// each), the letter of the profile, model, sub-model, and the drive's own firmware (major, minor, letter). `None`: it
/// is shorter.
pub fn version(profile_code: &[u8]) -> Option<Version> {
    /// The first firmware of the board that has the assemblies 0x65 and 0x70: 251.0.
    const SECOND: [u8; 4] = [0, 251, 0, 0];
    let code: &[u8; 10] = profile_code.first_chunk()?;
    Some(if code[..4] >= SECOND[..] { Version::V2 } else { Version::V1 })
}
