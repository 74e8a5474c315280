//! How people write what is in a drive, and the calls made from it.
//!
//! | address | access |
//! |---|---|
//! | `AC` | a parameter by its mnemonic; a blank in a name of the manual is a hyphen: `IV-actual` |
//! | `AC.flash` | the same, written into the flash memory, too |
//! | `R:3`, `R:A` | a register of 32 bits |
//! | `SCL:VE`, `SCL:RX/3`, `SCL:MO/1` | a command for the drive's buffer, with the register or output that it needs; only written |
//! | `encoder`, `absolute`, `alarm-history` | both positions and the history of alarms; only read |
//! | `output:1` | an output as the drive counts them, 1 = closed; only written |
//! | `stop`, `kill`, `alarm-reset`, `load-program`, `save-segment` | ST, SK, AR, QL, QS at once; only written |
//! | `0x01/1/7` | class, instance and attribute of a CIP object, as bytes |
//! | `0x01/1/1.u16` | the same as a number (u8, i8, u16, i16, u32, i32, u64, i64), as text or as octets |
//!
//! | value | means |
//! |---|---|
//! | `100`, `100.0`, `100 rev/s²` | in the unit of the parameter, where that is known here, and rounded to a count; 600 of AC, which is in 1/6 rev/s² |
//! | `600` | a count, as sent on the wire: of a parameter without a unit, and of any one by `--raw` |
//! | `0x258` | the bits of a count |
//! | `true`, `false` | 1, 0 |
//! | `2L`, `2L/3R` | an input and its condition; two of them for FD |
//!
//! What a call does is in [`target`](super::target).

mod list;
mod names;

use super::target::{Service, Target, reason};
use super::wire::assembly::IoCode;
use super::wire::opcodes::{self, Opcode, Operand};
use fieldbeat_core::axis::acyclic::long::Target as _;
use fieldbeat_core::axis::acyclic::{
    Counts, Integer, ListError, Listing, Notation, NotationError, Place, Values, Wanted, Words, decimal,
    hexadecimal,
};

const FORM: &str = "AC (a parameter), AC.flash, R:3 (a register), SCL:VE (a command for the buffer), \
     encoder, absolute, alarm-history, output:1, stop, kill, alarm-reset, load-program, save-segment, or \
     0x01/1/7 (class, instance and attribute), with .u16 behind it for a type (u8, i8, u16, i16, u32, i32, \
     u64, i64, text, octets)";
const ONLY_WRITTEN: &str = "an address that can be read: commands and outputs are only written";
const READ_ONLY: &str = "another one: the drive only reports this";

/// Addresses and values of these drives.
#[derive(Clone, Copy, Debug, Default)]
pub struct Addresses;

/// An address and what its values are.
#[derive(Clone, Debug)]
struct Address {
    target: Target,
    values: Values,
}

/// All numbers of so many bits.
const fn number(bits: u32, signed: bool) -> Counts {
    Counts::all(Integer { bits, signed })
}

/// Those of this range.
const fn within(bits: u32, low: i64, high: i64) -> Counts {
    Counts { range: (low, high), ..number(bits, low < 0) }
}

/// An input and its condition.
static IO: Words = Words {
    parse: |text| text.parse::<IoCode>().ok().map(|io| io.code().into()),
    show: |code| IoCode::from_code(code as u16).map(|io| io.to_string()),
    form: |_, _| "an input and its condition, like 2L: 0 ... 12, then H, L, R or F".to_owned(),
};

/// Two of them, the first one in the lower half.
static TWO_IOS: Words = Words {
    parse: |text| {
        let (first, second) = text.split_once('/')?;
        Some((IO.parse)(second)? << 16 | (IO.parse)(first)?)
    },
    show: |codes| Some(format!("{}/{}", (IO.show)(codes)?, (IO.show)(codes >> 16)?)),
    form: |_, _| "two inputs and their conditions, like 2L/3R".to_owned(),
};

/// The values of an attribute, from its suffix.
fn named(suffix: &str) -> Option<Values> {
    Some(match suffix {
        "text" => Values::ShortText,
        "octets" => Values::Octets,
        number => Values::Counts(Counts::all(Integer::named(number)?)),
    })
}

/// The name of something, its target, its values, and what it is.
type Named = (&'static str, Target, Counts, &'static str);

/// The targets with a name of their own.
#[rustfmt::skip]
static NAMED: [Named; 8] = [
    ("encoder", Target::Encoder, number(32, true), "encoder position"),
    ("absolute", Target::Absolute, number(32, true), "absolute position"),
    ("alarm-history", Target::AlarmHistory, number(32, false), "history of alarms"),
    ("stop", Target::Stop, within(8, 0, 1), "ST at once: 0 with AM, 1 with DE or JL"),
    ("kill", Target::Kill, within(8, 0, 1), "SK at once: 0 with AM, 1 with DE or JL; the buffer is emptied"),
    ("alarm-reset", Target::AlarmReset, within(8, 0, 0), "AR at once; the motor stays off"),
    ("load-program", Target::LoadProgram, within(8, 0, 0), "QL"),
    ("save-segment", Target::SaveSegment, within(8, 1, 12), "QS: segment 1 ... 12"),
];

impl Address {
    fn of(target: Target, counts: Counts) -> Address {
        Address { target, values: Values::Counts(counts) }
    }

    fn parse(text: &str) -> Option<Address> {
        if let Some(register) = text.strip_prefix("R:") {
            return Address::register(register);
        }
        if let Some(command) = text.strip_prefix("SCL:") {
            return Address::command(command);
        }
        if let Some(output) = text.strip_prefix("output:") {
            let index = decimal::<u8>(output)?.checked_sub(1).filter(|index| *index < 128)?;
            return Some(Address::of(Target::Output(index), within(8, 0, 1)));
        }
        match NAMED.into_iter().find(|(name, ..)| *name == text) {
            Some((_, target, counts, _)) => Some(Address::of(target, counts)),
            None => Address::attribute(text).or_else(|| Address::parameter(text)),
        }
    }

    fn parameter(text: &str) -> Option<Address> {
        let (name, flash) = text.strip_suffix(".flash").map_or((text, false), |name| (name, true));
        let parameter = opcodes::PARAMETERS.into_iter().find(|known| names::hyphened(known.name) == name)?;
        if flash && parameter.read_only {
            return None;
        }
        let signed = names::SIGNED.contains(&parameter.name);
        let counts = names::scaled(parameter.name, number(16, signed));
        Some(Address::of(Target::Parameter { index: parameter.index, flash }, counts))
    }

    fn register(text: &str) -> Option<Address> {
        let &[register] = text.as_bytes() else { return None };
        let known = opcodes::REGISTERS.iter().any(|(known, _)| *known == register);
        let counts = names::scaled_register(register, number(32, true));
        let is_one = known || register.is_ascii_digit();
        is_one.then(|| Address::of(Target::Register(register), counts))
    }

    fn command(text: &str) -> Option<Address> {
        let (name, field) = text.split_once('/').map_or((text, None), |(name, field)| (name, Some(field)));
        let opcode = opcodes::opcode(name)?;
        let field = match (opcode.operand, field) {
            (Operand::Register | Operand::RegisterLong, Some(field)) => {
                let &[register] = field.as_bytes() else { return None };
                register.is_ascii_alphanumeric().then_some(register)?
            }
            (Operand::FieldWord, Some(field)) => {
                // The lower half of a code is the number of its input or output.
                IoCode::new(decimal(field)?, super::wire::assembly::Condition::Low)?.code().to_be_bytes()[1]
            }
            (Operand::Register | Operand::RegisterLong, None) | (_, Some(_)) => return None,
            (_, None) => 0,
        };
        Some(Address::of(Target::Command { code: opcode.code, field }, operand(opcode)))
    }

    fn attribute(text: &str) -> Option<Address> {
        let mut parts = text.split('/');
        let (class, instance, last) = (parts.next()?, parts.next()?, parts.next()?);
        if parts.next().is_some() {
            return None;
        }
        let (attribute, kind) =
            last.split_once('.').map_or((last, None), |(attribute, kind)| (attribute, Some(kind)));
        let target = Target::attribute(part(class)?, part(instance)?, part(attribute)?)?;
        Some(Address { target, values: kind.map_or(Some(Values::Octets), named)? })
    }
}

/// The operand of a command.
fn operand(opcode: Opcode) -> Counts {
    let counts = match opcode.operand {
        Operand::None | Operand::Register => within(64, 0, 0),
        Operand::Byte if opcode.name == "QX" => within(64, 1, 12),
        Operand::Byte => within(64, 0, 0xFF),
        Operand::Word | Operand::FieldWord => within(64, i16::MIN.into(), u16::MAX.into()),
        Operand::Long | Operand::RegisterLong => within(64, i32::MIN.into(), i32::MAX.into()),
        Operand::Io => Counts { words: Some(&IO), ..number(16, false) },
        Operand::TwoIos => Counts { words: Some(&TWO_IOS), ..number(32, false) },
    };
    names::scaled(opcode.name, counts)
}

/// A number of a path: decimal, or hexadecimal behind 0x.
fn part(text: &str) -> Option<u16> {
    match text.strip_prefix("0x") {
        Some(digits) => u16::try_from(hexadecimal(digits)?).ok(),
        None => decimal(text),
    }
}

impl Notation for Addresses {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn place(&self, address: &str) -> Result<Place, NotationError> {
        let Address { target, values } =
            Address::parse(address).ok_or(NotationError::Address { form: FORM })?;
        let read = match target.can_be_read() {
            true => Ok(target.read()),
            false => Err(NotationError::Address { form: ONLY_WRITTEN }),
        };
        let write = match target {
            _ if !target.can_be_written() => Err(NotationError::ReadOnly { instead: READ_ONLY }),
            // A call has eight bytes, and an attribute its own size.
            Target::Attribute { .. }
                if !matches!(values, Values::Counts(_)) || values.integer().bits < 64 =>
            {
                Ok(Service::Store(target, 0).into())
            }
            _ => Ok(target.write(0)),
        };
        Ok(Place { read, write, values })
    }

    fn reason(&self, status: u32) -> String {
        reason(status).into_owned()
    }

    fn read_back(&self, address: &str) -> Vec<String> {
        // The drive answers a command with its status, and not with what it was given.
        match Address::parse(address) {
            Some(Address { target: Target::Parameter { flash: true, .. }, .. }) => {
                vec![address.trim_end_matches(".flash").to_owned()]
            }
            Some(found) if found.target.can_be_read() => vec![address.to_owned()],
            _ => Vec::new(),
        }
    }

    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        list::list(wanted)
    }
}

#[cfg(test)]
mod tests;
