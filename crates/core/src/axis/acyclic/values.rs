//! What is at an address: the calls for it, and what its values are, as people write and read them.

use super::long::{self, MOST, Target};
use super::notation::NotationError;
use super::quantity::{Quantity, shown};
use super::{Call, Integer, hexadecimal};

/// A place at an address of a drive.
#[derive(Clone, Debug)]
pub struct Place {
    /// The call that reads it, or why there is none.
    pub read: Result<Call, NotationError>,
    /// The call that writes it, without its value, or why there is none. By a [`Store`](long::Service::Store) its value
    /// goes in parts, and never by this call alone.
    pub write: Result<Call, NotationError>,
    /// The kind of its values.
    pub values: Values,
}

impl Place {
    /// One that is read and written by a call.
    pub fn of(target: impl Target, values: Values) -> Place {
        Place { read: Ok(target.read()), write: Ok(target.write(0)), values }
    }
}

/// The kind of values.
#[derive(Clone, Debug)]
pub enum Values {
    /// Whole numbers.
    Counts(Counts),
    /// A text.
    Text,
    /// A text behind a byte with its length.
    ShortText,
    /// Bytes.
    Octets,
    /// Nobody knows here: they can be read.
    Unknown {
        /// The form in which they have to be written to be known.
        form: String,
    },
}

crate::named! {
    /// How a parameter is accessed.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub enum Rights {
        /// To read.
        ReadOnly = 0: "read",
        /// To read and to write.
        ReadWrite = 1: "read write",
        /// To read, and to write in PREOP.
        PreOp = 2: "read, write in PREOP",
    }
}

/// Whole numbers, as on the wire.
#[derive(Clone, Copy, Debug)]
pub struct Counts {
    /// Their type.
    pub of: Integer,
    /// The lowest and the highest one that people may write.
    pub range: (i64, i64),
    /// The measured quantity.
    pub quantity: Option<Quantity>,
    /// How they are written besides.
    pub words: Option<&'static Words>,
    /// All bits of the type may be written by a program, and people write them without a sign above them. Else both are
    /// taken by the range, with the sign above the bits or without.
    pub by_bits: bool,
}

/// Words for counts.
#[derive(Debug)]
pub struct Words {
    /// The count that a word means.
    pub parse: fn(&str) -> Option<i64>,
    /// The word for a count.
    pub show: fn(i64) -> Option<String>,
    /// The correct form of a value within this range.
    pub form: fn(i64, i64) -> String,
}

impl Counts {
    /// All of a type.
    pub const fn all(of: Integer) -> Counts {
        Counts { of, range: of.range(), quantity: None, words: None, by_bits: false }
    }

    /// The count that `text` means: a number, its bits, or a word.
    fn parse(&self, text: &str) -> Result<i64, NotationError> {
        let number = match (text, text.strip_prefix("0x")) {
            ("true", _) => Some(1),
            ("false", _) => Some(0),
            (_, Some(digits)) => hexadecimal(digits).map(|raw| self.of_bits(raw).unwrap_or(i64::MAX)),
            _ => self.words.and_then(|words| (words.parse)(text)).or_else(|| text.parse().ok()),
        };
        let (low, high) = self.range;
        match number {
            Some(number) if (low..=high).contains(&number) => Ok(number),
            Some(_) => Err(NotationError::Range { value: text.to_owned(), low, high }),
            None => Err(NotationError::Value { value: text.to_owned(), form: self.form() }),
        }
    }

    fn of_bits(&self, raw: u64) -> Option<i64> {
        match self.by_bits {
            true => (self.of.raw(raw as i64) == raw).then(|| self.of.number(raw)),
            false => self.of.number_within(raw, self.range),
        }
    }

    /// The raw value that a program writes.
    fn written(&self, raw: u64) -> Result<u64, NotationError> {
        let range = if self.by_bits { self.of.range() } else { self.range };
        let number = self.of.number_within(raw, range).ok_or_else(|| NotationError::Value {
            value: raw.to_string(),
            form: if self.by_bits { format!("a number of {} bits", self.of.bits) } else { self.form() },
        })?;
        Ok(self.of.raw(number))
    }

    fn show(&self, raw: u64) -> String {
        let number = self.of.number(raw);
        let word = self.words.and_then(|words| (words.show)(number));
        let means = word.or_else(|| self.quantity.map(|quantity| quantity.show(number)));
        shown(means, number, self.of.raw(number))
    }

    fn form(&self) -> String {
        let (low, high) = self.range;
        match self.words {
            Some(words) => (words.form)(low, high),
            None => format!("a whole number, {low} ... {high}, or its bits as 0x..."),
        }
    }
}

impl Values {
    /// The type of a number; of anything else, that of the value of a call.
    pub fn integer(&self) -> Integer {
        match self {
            Values::Counts(counts) => counts.of,
            _ => Integer { bits: u64::BITS, signed: false },
        }
    }

    /// The quantity that the counts measure.
    pub fn quantity(&self) -> Option<Quantity> {
        let Values::Counts(counts) = self else { return None };
        counts.quantity
    }

    /// They may be longer than the value of a call.
    pub(super) fn are_bytes(&self) -> bool {
        matches!(self, Values::Text | Values::ShortText | Values::Octets)
    }

    /// The raw value of `text`: a count as on the wire, its bits, or a word; of what is longer, the first eight bytes.
    pub fn raw(&self, text: &str) -> Result<u64, NotationError> {
        match self {
            Values::Counts(counts) => counts.parse(text).map(|number| counts.of.raw(number)),
            _ => {
                let wrong = || NotationError::Value { value: text.to_owned(), form: self.form() };
                self.bytes(text).map(|bytes| long::raw(&bytes)).ok_or_else(wrong)
            }
        }
    }

    /// All bytes of `text`.
    pub(super) fn bytes(&self, text: &str) -> Option<Vec<u8>> {
        match self {
            Values::Counts(counts) => {
                let raw = counts.of.raw(counts.parse(text).ok()?).to_le_bytes();
                raw.get(..counts.of.bits as usize / 8).map(<[u8]>::to_vec)
            }
            Values::Text => long::parse_text(text),
            Values::ShortText => {
                let text = if text.is_empty() { Vec::new() } else { long::parse_text(text)? };
                let bytes = [&[u8::try_from(text.len()).ok()?], &*text].concat();
                (bytes.len() <= MOST).then_some(bytes)
            }
            Values::Octets => long::parse_octets(text),
            Values::Unknown { .. } => None,
        }
    }

    /// The raw value that a program writes.
    pub(super) fn written(&self, raw: u64) -> Result<u64, NotationError> {
        match self {
            Values::Counts(counts) => counts.written(raw),
            Values::Unknown { form } => {
                Err(NotationError::Value { value: raw.to_string(), form: form.clone() })
            }
            _ => Ok(raw),
        }
    }

    /// The number of a raw value; unsigned where no type is known.
    pub fn number(&self, raw: u64) -> i64 {
        match self {
            Values::Unknown { .. } => i64::try_from(raw).unwrap_or(i64::MAX),
            _ => self.integer().number(raw),
        }
    }

    /// A raw value as people read it.
    pub fn show(&self, raw: u64) -> String {
        match self {
            Values::Counts(counts) => counts.show(raw),
            Values::Unknown { .. } => format!("{raw} (0x{raw:X})"),
            _ => self.text(&raw.to_le_bytes()),
        }
    }

    /// These bytes as people read them.
    pub(super) fn text(&self, bytes: &[u8]) -> String {
        match (self, bytes) {
            (Values::Text, _) => long::text(bytes),
            (Values::ShortText, []) => String::new(),
            (Values::ShortText, [length, rest @ ..]) => {
                long::text(rest.get(..usize::from(*length)).unwrap_or(rest))
            }
            _ => long::octets(bytes),
        }
    }

    /// The correct form of a value.
    fn form(&self) -> String {
        match self {
            Values::Counts(counts) => counts.form(),
            Values::Text => format!("1 to {MOST} characters of ASCII"),
            Values::ShortText => format!("up to {} characters of ASCII", MOST - 1),
            Values::Octets => format!("1 to {MOST} bytes of two digits each, like \"01 A0\""),
            Values::Unknown { form } => form.clone(),
        }
    }
}
