//! These drives' own messages: service 0x3C of class 0x64, eight bytes each way, big-endian (Applied Motion, Host
//! Command Reference 920-0002 W, EtherNet/IP explicit messages).

use thiserror::Error;

use super::Reader;
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

/// Added to the index of a parameter: also into the flash memory.
const FLASH: u8 = 0x80;

/// A buffered command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Buffered {
    /// Which one.
    pub opcode: Opcode,
    /// The register or I/O code beside the operand; 0 for most.
    pub field: u8,
    /// The operand; two I/O codes have the first one in the lower half.
    pub value: i64,
}

impl Buffered {
    /// The message; `None` if the command has no such operand.
    ///
    /// A negative operand of 16 bits is not extended: the manual does not say it.
    pub fn encode(&self) -> Option<Payload> {
        let Buffered { opcode, field, value } = *self;
        let (low, high, with_field) = match opcode.operand {
            Operand::None => (0, 0, false),
            Operand::Byte => (0, 0xFF, false),
            Operand::Word => (i16::MIN.into(), u16::MAX.into(), false),
            Operand::Long => (i32::MIN.into(), i32::MAX.into(), false),
            Operand::Io => (0, u16::MAX.into(), false),
            Operand::TwoIos => (0, u32::MAX.into(), false),
            Operand::FieldWord => (i16::MIN.into(), u16::MAX.into(), true),
            Operand::Register => (0, 0, true),
            Operand::RegisterLong => (i32::MIN.into(), i32::MAX.into(), true),
        };
        if !(low..=high).contains(&value) || !with_field && field != 0 {
            return None;
        }
        let wide = matches!(opcode.operand, Operand::Long | Operand::TwoIos | Operand::RegisterLong);
        let [a, b, c, d] = (value as u32 & if wide { u32::MAX } else { 0xFFFF }).to_be_bytes();
        Some([0, BUFFERED, field, opcode.code, a, b, c, d])
    }

    /// The status word in the answer.
    pub fn answer(&self, payload: &[u8]) -> Result<u16, AnswerError> {
        let &[zero, kind, _, code, high, low, ..] = whole(payload)?;
        if [zero, kind, code] != [0, BUFFERED, self.opcode.code] {
            return Err(AnswerError::Other);
        }
        Ok(u16::from_be_bytes([high, low]))
    }
}

/// Which deceleration a stop has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Deceleration {
    /// The largest (AM).
    Largest,
    /// That of the move (DE) or jog (JL).
    Set,
}

/// A command that is executed at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Immediate {
    /// Writes a parameter of `opcodes::PARAMETERS`.
    WriteParameter {
        /// Its index.
        index: u8,
        /// Its value.
        value: u16,
        /// Also into the flash memory.
        flash: bool,
    },
    /// Reads a parameter: [`Answer::Word`].
    ReadParameter(u8),
    /// Reads the history of alarms: [`Answer::Long`], whose meaning the manual does not say.
    ReadAlarmHistory,
    /// Reads the position of the encoder: [`Answer::Long`].
    ReadEncoder,
    /// Reads the absolute position: [`Answer::Long`].
    ReadAbsolute,
    /// Sets an output.
    SetOutput {
        /// Counted from 0, up to 127.
        index: u8,
        /// Closed (low), or open.
        closed: bool,
    },
    /// AR: clears the fault. The motor stays without current.
    ResetAlarm,
    /// SK: stops, and discards what is buffered.
    Kill(Deceleration),
    /// ST: stops.
    Stop(Deceleration),
    /// Writes a register of `opcodes::REGISTERS`. The drive does not check the value.
    WriteRegister {
        /// Its character.
        register: u8,
        /// Its value.
        value: i32,
    },
    /// Reads a register: [`Answer::Long`].
    ReadRegister(u8),
    /// QL: loads the Q program.
    LoadProgram,
    /// QS: saves a segment of it, 1 ... 12.
    SaveSegment(u8),
}

impl Immediate {
    /// The opcode and its operand.
    fn head(&self) -> [u8; 2] {
        use Immediate::{
            Kill, LoadProgram, ReadAbsolute, ReadAlarmHistory, ReadEncoder, ReadParameter, ReadRegister,
            ResetAlarm, SaveSegment, SetOutput, Stop, WriteParameter, WriteRegister,
        };
        match *self {
            WriteParameter { index, flash, .. } => [0x83, index | if flash { FLASH } else { 0 }],
            ReadParameter(index) => [0x84, index],
            ReadAlarmHistory => [0x87, 0],
            ReadEncoder => [0x88, 0],
            ReadAbsolute => [0x88, 1],
            SetOutput { index, closed } => [0x8B, u8::from(closed) << 7 | index & 0x7F],
            ResetAlarm => [0x8E, 0],
            Kill(deceleration) => [0x98, deceleration as u8],
            WriteRegister { register, .. } => [0x9E, register],
            ReadRegister(register) => [0x9F, register],
            LoadProgram => [0xA1, 0],
            SaveSegment(segment) => [0xA2, segment],
            Stop(deceleration) => [0xA3, deceleration as u8],
        }
    }

    /// The message.
    pub fn encode(&self) -> Payload {
        let [opcode, operand] = self.head();
        let [a, b, c, d] = match *self {
            Immediate::WriteParameter { value, .. } => {
                let [high, low] = value.to_be_bytes();
                [high, low, 0, 0]
            }
            Immediate::WriteRegister { value, .. } => value.to_be_bytes(),
            _ => [0; 4],
        };
        [0, IMMEDIATE, opcode, operand, a, b, c, d]
    }

    /// What the drive answered.
    pub fn answer(&self, payload: &[u8]) -> Result<Answer, AnswerError> {
        let &[zero, kind, opcode, operand, a, b, c, d] = whole(payload)?;
        let head = self.head();
        if [zero, kind] != [0, IMMEDIATE] || [opcode, operand] != head {
            return Err(AnswerError::Other);
        }
        let word = u16::from_be_bytes([a, b]);
        Ok(match self {
            Immediate::ReadParameter(_) => Answer::Word(word),
            Immediate::ReadEncoder
            | Immediate::ReadAbsolute
            | Immediate::ReadRegister(_)
            | Immediate::ReadAlarmHistory => Answer::Long(i32::from_be_bytes([a, b, c, d])),
            _ => Answer::Status(word),
        })
    }
}

/// What an immediate command is answered with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// The status word, see `assembly::status`.
    Status(u16),
    /// A parameter; whether it has a sign is the parameter's matter.
    Word(u16),
    /// A register or a position.
    Long(i32),
}

/// Why bytes are no answer to a message.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum AnswerError {
    /// Answers have eight bytes.
    #[error("{0} bytes in the answer where 8 are due")]
    Length(usize),
    /// Its first bytes are not those of the message.
    #[error("the answer belongs to another message")]
    Other,
}
fieldbeat_core::debug_as_display!(AnswerError);

fn whole(payload: &[u8]) -> Result<&Payload, AnswerError> {
    payload.try_into().map_err(|_| AnswerError::Length(payload.len()))
}

/// What a drive says of its hardware and firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProfileCode {
    /// The firmware of the Ethernet board, major and minor.
    pub board: (u16, u16),
    /// The letter of the profile: 'A'.
    pub profile: u8,
    /// The model: 0xB0 is an STF.
    pub model: u8,
    /// The sub-model.
    pub sub_model: u8,
    /// The firmware of the drive: major, minor, letter.
    pub firmware: (u8, u8, u8),
}

impl ProfileCode {
    /// The first firmware of the board that has the assemblies 0x65 and 0x70.
    const SECOND_VERSION: (u16, u16) = (251, 0);

    /// The attribute; `None` if it is shorter.
    pub fn parse(data: &[u8]) -> Option<ProfileCode> {
        let mut reader = Reader(data);
        Some(ProfileCode {
            board: (u16::from_be_bytes(reader.array()?), u16::from_be_bytes(reader.array()?)),
            profile: reader.byte()?,
            model: reader.byte()?,
            sub_model: reader.byte()?,
            firmware: (reader.byte()?, reader.byte()?, reader.byte()?),
        })
    }

    /// Which assemblies it has.
    pub fn version(&self) -> Version {
        if self.board >= ProfileCode::SECOND_VERSION { Version::V2 } else { Version::V1 }
    }
}
