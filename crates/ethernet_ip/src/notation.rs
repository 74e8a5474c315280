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
use fieldbeat_core::axis::acyclic::{
    Call, CallError, Carrier, Integer, ListError, Listing, Notation, NotationError, Quantity, Wanted, long,
    shown, within,
};

const FORM: &str = "AC (a parameter), AC.flash, R:3 (a register), SCL:VE (a command for the buffer), \
     encoder, absolute, alarm-history, output:1, stop, kill, alarm-reset, load-program, save-segment, or \
     0x01/1/7 (class, instance and attribute), with .u16 behind it for a type (u8, i8, u16, i16, u32, i32, \
     u64, i64, text, octets)";
const ONLY_WRITTEN: &str = "an address that can be read: commands and outputs are only written";
const READ_ONLY: &str = "another one: the drive only reports this";

/// The most characters of a text: its length is a byte.
const TEXT_MAX: usize = long::MOST - 1;

/// Addresses and values of these drives.
#[derive(Clone, Copy, Debug, Default)]
pub struct Addresses;

/// An address and what its values are.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Address {
    target: Target,
    shape: Shape,
}

/// What values are.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Shape {
    /// Numbers of so many bits.
    Number { of: Integer, low: i64, high: i64, quantity: Option<Quantity> },
    /// An input and its condition.
    Io,
    /// Two of them, the first one in the lower half.
    TwoIos,
    /// A text behind a byte with its length.
    Text,
    /// Bytes.
    Octets,
}

impl Shape {
    /// All numbers of so many bits.
    const fn number(bits: u32, signed: bool) -> Shape {
        let of = Integer { bits, signed };
        let (low, high) = of.range();
        Shape::Number { of, low, high, quantity: None }
    }

    /// Those of this range.
    const fn within(bits: u32, low: i64, high: i64) -> Shape {
        Shape::Number { of: Integer { bits, signed: low < 0 }, low, high, quantity: None }
    }

    /// From the suffix of an attribute.
    fn named(name: &str) -> Option<Shape> {
        SUFFIXES.into_iter().find(|(known, _)| *known == name).map(|(_, shape)| shape)
    }

    /// The type of a number; of what is longer, that of a value of a call.
    fn integer(self) -> Integer {
        let bits = match self {
            Shape::Number { of, .. } => return of,
            Shape::Io => 16,
            Shape::TwoIos => 32,
            Shape::Text | Shape::Octets => 64,
        };
        Integer { bits, signed: false }
    }

    fn raw(self, number: i64) -> u64 {
        self.integer().raw(number)
    }

    fn value(self, raw: u64) -> i64 {
        self.integer().number(raw)
    }

    fn range(self) -> (i64, i64) {
        match self {
            Shape::Number { low, high, .. } => (low, high),
            _ => self.integer().range(),
        }
    }
}

/// The types of an attribute.
#[rustfmt::skip]
const SUFFIXES: [(&str, Shape); 10] = [
    ("text", Shape::Text), ("octets", Shape::Octets),
    ("u8", Shape::number(8, false)), ("u16", Shape::number(16, false)), ("u32", Shape::number(32, false)),
    ("u64", Shape::number(64, false)), ("i8", Shape::number(8, true)), ("i16", Shape::number(16, true)),
    ("i32", Shape::number(32, true)), ("i64", Shape::number(64, true)),
];

/// The name of something, its target, its values, and what it is.
type Named = (&'static str, Target, Shape, &'static str);

/// What has a name of its own here.
#[rustfmt::skip]
static NAMED: [Named; 8] = [
    ("encoder", Target::Encoder, Shape::number(32, true), "encoder position"),
    ("absolute", Target::Absolute, Shape::number(32, true), "absolute position"),
    ("alarm-history", Target::AlarmHistory, Shape::number(32, false), "history of alarms"),
    ("stop", Target::Stop, Shape::within(8, 0, 1), "ST at once: 0 with AM, 1 with DE or JL"),
    ("kill", Target::Kill, Shape::within(8, 0, 1), "SK at once: 0 with AM, 1 with DE or JL; the buffer is emptied"),
    ("alarm-reset", Target::AlarmReset, Shape::within(8, 0, 0), "AR at once; the motor stays off"),
    ("load-program", Target::LoadProgram, Shape::within(8, 0, 0), "QL"),
    ("save-segment", Target::SaveSegment, Shape::within(8, 1, 12), "QS: segment 1 ... 12"),
];

impl Address {
    fn parse(text: &str) -> Option<Address> {
        if let Some(register) = text.strip_prefix("R:") {
            return Address::register(register);
        }
        if let Some(command) = text.strip_prefix("SCL:") {
            return Address::command(command);
        }
        if let Some(output) = text.strip_prefix("output:") {
            let number = digits(output, 10)?.checked_sub(1)?;
            let index = u8::try_from(number).ok().filter(|index| *index < 128)?;
            return Some(Address { target: Target::Output(index), shape: Shape::within(8, 0, 1) });
        }
        match NAMED.into_iter().find(|(name, ..)| *name == text) {
            Some((_, target, shape, _)) => Some(Address { target, shape }),
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
        let shape = names::scaled(parameter.name, Shape::number(16, signed));
        Some(Address { target: Target::Parameter { index: parameter.index, flash }, shape })
    }

    fn register(text: &str) -> Option<Address> {
        let &[register] = text.as_bytes() else { return None };
        let known = opcodes::REGISTERS.iter().any(|(known, _)| *known == register);
        let shape = names::scaled_register(register, Shape::number(32, true));
        (known || register.is_ascii_digit()).then_some(Address { target: Target::Register(register), shape })
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
                let number = digits(field, 10).and_then(|number| u8::try_from(number).ok())?;
                // The lower half of a code is the number of its input or output.
                IoCode::new(number, super::wire::assembly::Condition::Low)?.code().to_be_bytes()[1]
            }
            (Operand::Register | Operand::RegisterLong, None) | (_, Some(_)) => return None,
            (_, None) => 0,
        };
        Some(Address { target: Target::Command { code: opcode.code, field }, shape: operand(opcode) })
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
        let shape = kind.map_or(Some(Shape::Octets), Shape::named)?;
        Some(Address { target, shape })
    }

    fn is_attribute(&self) -> bool {
        matches!(self.target, Target::Attribute { .. })
    }

    /// The number that is meant by a raw value that may have its sign above its bits.
    fn number_of(&self, raw: u64) -> Option<i64> {
        self.shape.integer().number_within(raw, self.shape.range())
    }

    /// What `text` says as a number.
    fn number(&self, text: &str) -> Result<i64, NotationError> {
        let number = match text.strip_prefix("0x") {
            Some(bits) => digits(bits, 16).map(|raw| self.number_of(raw).unwrap_or(i64::MAX)),
            None => self.count(text),
        };
        within(number, self.shape.range(), text, || self.form())
    }

    /// A decimal number, or a word.
    fn count(&self, text: &str) -> Option<i64> {
        match (text, self.shape) {
            ("true", _) => return Some(1),
            ("false", _) => return Some(0),
            (_, Shape::Io) => {
                if let Ok(io) = text.parse::<IoCode>() {
                    return Some(io.code().into());
                }
            }
            (_, Shape::TwoIos) => {
                if let Some((first, second)) = text.split_once('/') {
                    let code = |text: &str| text.parse::<IoCode>().ok().map(|io| i64::from(io.code()));
                    return Some(code(second)? << 16 | code(first)?);
                }
            }
            _ => {}
        }
        text.parse().ok()
    }

    /// The correct form of a value.
    fn form(&self) -> String {
        let (low, high) = self.shape.range();
        match self.shape {
            Shape::Io => "an input and its condition, like 2L: 0 ... 12, then H, L, R or F".to_owned(),
            Shape::TwoIos => "two inputs and their conditions, like 2L/3R".to_owned(),
            Shape::Text => format!("up to {TEXT_MAX} characters of ASCII"),
            Shape::Octets => format!("1 to {} bytes of two digits each, like \"01 A0\"", long::MOST),
            Shape::Number { .. } => format!("a whole number, {low} ... {high}, or its bits as 0x..."),
        }
    }

    /// What a value that is longer than a number has on the wire; `None`: it is none.
    fn bytes(&self, text: &str) -> Option<Vec<u8>> {
        let bytes = match self.shape {
            Shape::Text => {
                let is_text = text.bytes().all(|byte| byte.is_ascii_graphic() || byte == b' ');
                let length = u8::try_from(text.len()).ok().filter(|_| is_text && text.len() <= TEXT_MAX)?;
                [&[length], text.as_bytes()].concat()
            }
            Shape::Octets => long::parse_octets(text)?,
            _ => {
                let number = self.number(text).ok()?;
                let size = self.shape.integer().bits as usize / 8;
                self.shape.raw(number).to_le_bytes().get(..size)?.to_vec()
            }
        };
        (bytes.len() <= long::MOST).then_some(bytes)
    }
}

/// What follows a command.
fn operand(opcode: Opcode) -> Shape {
    let shape = match opcode.operand {
        Operand::None | Operand::Register => Shape::within(64, 0, 0),
        Operand::Byte if opcode.name == "QX" => Shape::within(64, 1, 12),
        Operand::Byte => Shape::within(64, 0, 0xFF),
        Operand::Word | Operand::FieldWord => Shape::within(64, i16::MIN.into(), u16::MAX.into()),
        Operand::Long | Operand::RegisterLong => Shape::within(64, i32::MIN.into(), i32::MAX.into()),
        Operand::Io => Shape::Io,
        Operand::TwoIos => Shape::TwoIos,
    };
    names::scaled(opcode.name, shape)
}

/// A number of a path: decimal, or hexadecimal behind 0x.
fn part(text: &str) -> Option<u16> {
    let number = match text.strip_prefix("0x") {
        Some(hex) => digits(hex, 16),
        None => digits(text, 10),
    };
    number.and_then(|number| u16::try_from(number).ok())
}

/// Digits and nothing else.
fn digits(text: &str, radix: u32) -> Option<u64> {
    u64::from_str_radix(text, radix).ok().filter(|_| !text.starts_with('+'))
}

impl Addresses {
    fn find(text: &str) -> Result<Address, NotationError> {
        Address::parse(text).ok_or(NotationError::Address { form: FORM })
    }

    fn writable(text: &str) -> Result<Address, NotationError> {
        let address = Addresses::find(text)?;
        if address.target.can_be_written() {
            Ok(address)
        } else {
            Err(NotationError::ReadOnly { instead: READ_ONLY })
        }
    }
}

impl Notation for Addresses {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn read(&self, address: &str) -> Result<Call, NotationError> {
        let address = Addresses::find(address)?;
        match address.target.can_be_read() {
            true => Ok(address.target.read()),
            false => Err(NotationError::Address { form: ONLY_WRITTEN }),
        }
    }

    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
        let address = Addresses::writable(address)?;
        if address.is_attribute()
            && !matches!(address.shape, Shape::Number { of: Integer { bits: 64, .. }, .. })
        {
            // A call has eight bytes, and an attribute its own size: it goes in parts, and never by this one alone.
            return Ok(Service::Store(address.target, 0).into());
        }
        match address.number_of(value) {
            Some(number) => Ok(address.target.write(address.shape.raw(number))),
            None => Err(NotationError::Value { value: value.to_string(), form: address.form() }),
        }
    }

    fn value(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        let address = Addresses::writable(address)?;
        if matches!(address.shape, Shape::Text | Shape::Octets) {
            let wrong = || NotationError::Value { value: text.to_owned(), form: address.form() };
            return address.bytes(text).map(|bytes| long::raw(&bytes)).ok_or_else(wrong);
        }
        address.number(text).map(|number| address.shape.raw(number))
    }

    fn number(&self, address: &str, raw: u64) -> i64 {
        Address::parse(address).map_or(raw as i64, |address| address.shape.value(raw))
    }

    fn show(&self, address: &str, raw: u64) -> String {
        let Some(Address { shape, .. }) = Address::parse(address) else {
            return format!("{raw} (0x{raw:X})");
        };
        let (number, bits) = (shape.value(raw), shape.raw(raw as i64));
        let io = |code: i64| IoCode::from_code(code as u16).map(|io| io.to_string());
        let means = match shape {
            Shape::Number { quantity, .. } => quantity.map(|quantity| quantity.show(number)),
            Shape::Io => io(number),
            Shape::TwoIos => {
                io(number).zip(io(number >> 16)).map(|(first, second)| format!("{first}/{second}"))
            }
            Shape::Text => return text(&raw.to_le_bytes()),
            Shape::Octets => return long::octets(&raw.to_le_bytes()),
        };
        shown(means, number, bits)
    }

    fn quantity(&self, address: &str) -> Option<Quantity> {
        let Shape::Number { quantity, .. } = Address::parse(address)?.shape else { return None };
        quantity
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

    fn read_long(&self, carrier: &dyn Carrier, address: &str) -> Option<Result<(u64, String), CallError>> {
        let is_long = |address: &Address| matches!(address.shape, Shape::Text | Shape::Octets);
        let address = Address::parse(address).filter(is_long)?;
        let read = long::read(carrier, address.target.pack(), self.limit(&address.target.read()));
        Some(read.map(|bytes| {
            let shown = if address.shape == Shape::Text { text(&bytes) } else { long::octets(&bytes) };
            (long::raw(&bytes), shown)
        }))
    }

    fn write_long(&self, address: &str, text: &str) -> Option<Vec<Call>> {
        let address = Address::parse(address).filter(Address::is_attribute)?;
        Some(long::write(address.target.pack(), &address.bytes(text)?))
    }

    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        list::list(wanted)
    }
}

/// The characters behind the byte with their number.
fn text(bytes: &[u8]) -> String {
    let Some((length, rest)) = bytes.split_first() else { return String::new() };
    long::text(rest.get(..usize::from(*length)).unwrap_or(rest))
}

#[cfg(test)]
mod tests;
