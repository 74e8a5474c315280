//! Type 1 messages: buffered commands by their opcodes.
//!
//! Facts: sheet, 5.7.

use super::motion::{Entry, Io, Move};
use super::parameters::{self, Name};
use super::search::Sensor;

/// What the four bytes of an operand are.
#[derive(Clone, Copy, Debug)]
pub(super) struct Operand(pub [u8; 4]);

impl Operand {
    fn word(self) -> u16 {
        u16::from_be_bytes([self.0[2], self.0[3]])
    }

    fn long(self) -> i32 {
        i32::from_be_bytes(self.0)
    }

    /// Condition and input.
    fn io(self) -> Option<Io> {
        Io::new(u16::from_be_bytes([self.0[2], self.0[3]]))
    }
}

/// What a buffered command is, or what is wrong with it.
pub(super) fn entry(opcode: u8, register: u8, operand: Operand) -> Option<Entry> {
    let sensor = |kind| Some(Entry::Move(Move::Sensor(kind, operand.io()?), None));
    let plain = |kind| Some(Entry::Move(kind, None));
    if let Some((name, is_long)) = written(opcode) {
        let value = match is_long {
            true => operand.long(),
            false => parameters::from_word(&name, operand.word()),
        };
        return Some(Entry::Write((name, 0), value));
    }
    match opcode {
        0x66 => plain(Move::Relative),
        0x67 => plain(Move::Absolute),
        0x6D => plain(Move::Change),
        0x68 => Some(Entry::Move(Move::Output(operand.io()?), None)),
        0x6B => sensor(Sensor::Stop),
        0x6A => sensor(Sensor::Mask),
        0x6C => sensor(Sensor::Safety),
        0x6E => sensor(Sensor::Home),
        0x69 => {
            let second = Io::new(u16::from_be_bytes([operand.0[0], operand.0[1]]))?;
            Some(Entry::Move(Move::Double(operand.io()?, second), None))
        }
        0x96 => plain(Move::Jog),
        0x9E | 0x9F => Some(Entry::Enable(opcode == 0x9F)),
        0xBA => Some(Entry::Reset),
        0xA5 => Some(Entry::Position(operand.long())),
        0x98 => Some(Entry::Encoder(operand.long())),
        0x8B => Some(Entry::Output(operand.io()?)),
        0xAE => Some(Entry::Register(register, operand.long())),
        0xB5 => match operand.0[3] {
            b'D' => Some(Entry::Stop(true)),
            b'M' => Some(Entry::Stop(false)),
            _ => None,
        },
        0x78 => (1..=12).contains(&operand.0[3]).then_some(Entry::Segment(operand.0[3])),
        // These exist, and do nothing that can be seen from here.
        0xCC | 0xEF | 0xAB | 0x64 | 0x65 | 0x63 | 0x43 | 0xA3 | 0xA2 | 0xA1 | 0xC0 | 0xD3 | 0xA4 | 0xA8
        | 0xAC | 0xBF => Some(Entry::Nothing),
        _ => None,
    }
}

/// The parameter that an opcode writes, and whether it has 32 bits.
fn written(opcode: u8) -> Option<(Name, bool)> {
    let word = |name: &Name| Some((*name, false));
    let long = |name: &Name| Some((*name, true));
    match opcode {
        0x1E => word(b"AC"),
        0x16 => word(b"AM"),
        0xB7 => long(b"DC"),
        0x1F => word(b"DE"),
        0xB6 => long(b"DI"),
        0x1B => word(b"JA"),
        0x1C => word(b"JL"),
        0x1A => word(b"JS"),
        0xEA => long(b"LM"),
        0xE9 => long(b"LP"),
        0x71 => word(b"PD"),
        0x72 => word(b"PE"),
        0x4A => word(b"VC"),
        0x1D => word(b"VE"),
        0x26 => word(b"EG"),
        0x2A => word(b"EN"),
        0x2B => word(b"EU"),
        0x46 => word(b"AI"),
        0x47 => word(b"AO"),
        0xD2 => word(b"AD"),
        0x4C => word(b"AF"),
        0x3B => word(b"AG"),
        0x5F => word(b"AN"),
        0x4B => word(b"AP"),
        0xD1 => word(b"AS"),
        0x4D => word(b"AT"),
        0x3C => word(b"AV"),
        0x40 => word(b"BD"),
        0x41 => word(b"BE"),
        0x48 => word(b"BO"),
        0x4F => word(b"CD"),
        0x10 => word(b"CM"),
        0x42 => word(b"DL"),
        0xD6 => word(b"EF"),
        0x20 => word(b"ER"),
        0x04 => word(b"HG"),
        0x05 => word(b"HP"),
        0x49 => word(b"MO"),
        0x21 => word(b"PF"),
        0x44 => word(b"PM"),
        0x06 => word(b"SF"),
        0x45 => word(b"SI"),
        0x61 => word(b"CA"),
        0x18 => word(b"CC"),
        0x19 => word(b"CI"),
        _ => None,
    }
}
