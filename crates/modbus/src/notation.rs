//! How people write parameters of a Unidrive and their values, and the calls made from them.
//!
//! | address | access |
//! |---|---|
//! | `06.042`, or a name of the [`catalogue`] | in its own size if it is known here, else 32 bits |
//! | `4.15.009`, `4.modbus-timeout` | the same in the module of slot 4 |
//! | `06.042.word`, `06.042.long` | 16 bits, 32 bits |
//!
//! | value | means |
//! |---|---|
//! | `1500`, `1500.0`, `1500 rpm` | in the unit of the parameter, if that is known here; 15000 of 01.021 |
//! | `15000` | a count, as sent on the wire: of a parameter without a unit, and of any one by `--raw` |
//! | `0x3A98` | the bits of a count |
//! | `true`, `false` | 1, 0 |
//!
//! Parameters of one menu that follow one another are read or written in one request: a [`Block`], with the services of
//! `long`, and their values as in a message.
//!
//! A call is a [`Service`]. The status of its answer is 0, the drive's exception code, or one of [`NOT_TAKEN`] and
//! [`UNREACHABLE`].

mod list;

use super::parameter::{Parameter, SLOT_MAX, Width, catalogue};
use super::wire::{ExceptionCode, REGISTERS_MAX};
use fieldbeat_core::axis::acyclic::long::{self, Target as _};
use fieldbeat_core::axis::acyclic::{
    Block, Counts, Integer, ListError, Listing, Notation, NotationError, Place, Quantity, Values, Wanted,
    Words,
};

/// A status above those of the drive: it wrote fewer registers than it received, its silent refusal (Commander SE
/// guide).
pub const NOT_TAKEN: u32 = 0x100;
/// A status above those of the drive: the parameter has no address in the addressing mode of this drive. Nothing was
/// sent.
pub const UNREACHABLE: u32 = 0x101;

/// The parameter that a call reads or writes, or the first of several.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Target {
    /// The parameter.
    pub parameter: Parameter,
    /// The size of the access.
    pub width: Width,
}

/// Packed: width (0 = 16 bits, 1 = 32), slot, menu, number, a byte each.
impl long::Target for Target {
    fn pack(self) -> u32 {
        let Parameter { slot, menu, number } = self.parameter;
        let width = match self.width {
            Width::Word => 0,
            Width::Long => 1,
        };
        u32::from_be_bytes([width, slot, menu, number])
    }

    fn unpack(address: u32) -> Option<Target> {
        let [width, slot, menu, number] = address.to_be_bytes();
        let width = match width {
            0 => Width::Word,
            1 => Width::Long,
            _ => return None,
        };
        if slot > SLOT_MAX {
            return None;
        }
        Some(Target { parameter: Parameter { slot, menu, number }, width })
    }
}

impl Target {
    /// As people write it.
    pub fn parse(text: &str) -> Option<Target> {
        let (parameter, width) = Target::parts(text)?;
        Some(Target { parameter, width: width.unwrap_or_else(|| own_width(parameter)) })
    }

    /// The parameter that is written so, and the width that stands behind it.
    fn parts(text: &str) -> Option<(Parameter, Option<Width>)> {
        let (text, width) = match text.rsplit_once('.') {
            Some((text, "word")) => (text, Some(Width::Word)),
            Some((text, "long")) => (text, Some(Width::Long)),
            _ => (text, None),
        };
        let parameter = text.parse().ok().or_else(|| named(text))?;
        Some((parameter, width))
    }

    /// The type of its values. Those of unknown parameters have a sign, as most have.
    fn integer(self) -> Integer {
        self.width.integer(self.parameter.known().is_none_or(|known| known.signed))
    }
}

/// The service of a call.
pub type Service = long::Service<Target>;

/// The width of a parameter, if it is known here; else 32 bits.
fn own_width(parameter: Parameter) -> Width {
    parameter.known().map_or(Width::Long, |known| known.width)
}

/// A name of the drive's parameters, or after `slot.` one of an Ethernet interface's.
fn named(text: &str) -> Option<Parameter> {
    let Some((slot, name)) = text.split_once('.') else {
        return catalogue::named(text, false).map(|known| known.parameter);
    };
    let &[digit @ b'1'..=b'4'] = slot.as_bytes() else { return None };
    catalogue::named(name, true).map(|known| known.parameter.in_slot(digit - b'0'))
}

const FORM: &str = "06.042, with three digits behind the point, slot.06.042 or a name; .word or .long behind \
     it for access with 16 or 32 bits";

/// Addresses and values of Unidrives.
#[derive(Clone, Copy, Debug, Default)]
pub struct Parameters;

/// Counts have no words of their own; their form names those that all counts have.
static COUNTS: Words = Words {
    parse: |_| None,
    show: |_| None,
    form: |low, high| format!("a whole number, {low} ... {high}, its bits as 0x..., true or false"),
};

impl Notation for Parameters {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn place(&self, address: &str) -> Result<Place, NotationError> {
        let target = Target::parse(address).ok_or(NotationError::Address { form: FORM })?;
        let (of, known) = (target.integer(), target.parameter.known());
        let counts = Counts {
            range: match known {
                Some(_) => of.range(),
                // Of whatever sign: the bits are the same.
                None => (target.width.range(true).0, target.width.range(false).1),
            },
            quantity: known.and_then(|known| Quantity::decimals(known.decimals, known.unit)),
            words: Some(&COUNTS),
            by_bits: true,
            ..Counts::all(of)
        };
        Ok(Place::of(target, Values::Counts(counts)))
    }

    fn reason(&self, status: u32) -> String {
        match (status, u8::try_from(status)) {
            (NOT_TAKEN, _) => {
                "the drive did not take it and gave no error code: read-only, protected, or out of range"
                    .to_owned()
            }
            (UNREACHABLE, _) => {
                "it has no address in the addressing mode of this drive: look at `addressing`".to_owned()
            }
            (_, Ok(code)) => ExceptionCode(code).to_string(),
            _ => format!("status {status:#x}"),
        }
    }

    /// In 16 bits if all of them are known to have so many and nothing else is written, else in 32.
    fn block(&self, address: &str, count: usize) -> Result<Block, NotationError> {
        let (first, given) = Target::parts(address).ok_or(NotationError::Address { form: FORM })?;
        let wrong = |form: String| NotationError::Value { value: count.to_string(), form };
        let next = |place: usize| u8::try_from(place).ok().and_then(|place| first.offset(place));
        let all: Option<Vec<Parameter>> = (0..count.clamp(1, usize::from(u8::MAX))).map(next).collect();
        let all = all.filter(|all| all.iter().all(|parameter| parameter.is_reached()));
        let all = all.ok_or_else(|| wrong("parameters of one menu".to_owned()))?;
        let is_word = |parameter: &Parameter| own_width(*parameter) == Width::Word;
        let own = if all.iter().all(is_word) { Width::Word } else { Width::Long };
        let width = given.unwrap_or(own);
        let most = usize::from(REGISTERS_MAX / width.registers());
        if !(1..=most).contains(&count) {
            return Err(wrong(format!("1 to {most} parameters of {} bits at once", width.bits())));
        }
        let suffix = |parameter: &Parameter| match width {
            _ if own_width(*parameter) == width => "",
            Width::Word => ".word",
            Width::Long => ".long",
        };
        Ok(Block {
            addresses: all.iter().map(|parameter| format!("{parameter}{}", suffix(parameter))).collect(),
            address: Target { parameter: first, width }.pack(),
            bytes: width.bytes(),
        })
    }

    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        list::list(wanted)
    }
}

#[cfg(test)]
mod tests;
