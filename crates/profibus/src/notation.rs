//! How people write what is in a Lenze drive, and the calls made from it.
//!
//! | address | access |
//! |---|---|
//! | `C0061`, `C0039/2` | a code, and one with a subcode; zeros in front may be left out: as the drive reports it |
//! | `C0150.u16` | the same with the kind of its value: u8, i8, u16, i16, u32, i32 |
//! | `C0200.text` | a text, by DP-V1 |
//! | `1/3` | slot and index of a record of the module, by DP-V1, as bytes |
//!
//! | value | means |
//! |---|---|
//! | `43`, `43.0`, `43 °C` | in the unit of the code: 430000 of C0061. A code that is not in the `catalogue` is taken for one of 32 bits with four decimals, one with a kind behind it has none |
//! | `430000` | a count, as sent on the wire: of a code without decimals, and of any one by `--raw` |
//! | `0x68FB0` | the bits of a count |
//! | `true`, `false` | 1, 0 |
//! | `"01 A0"` | bytes of a record |
//! | `"axis 1"` | the characters of a text |
//!
//! What a call does is in [`target`](super::target).

mod list;

use super::catalogue::{CodeInfo, DECIMALS};
use super::target::{Kind, Parameter, Service, Target, reason};
use super::wire::msac1::Record;
use fieldbeat_core::axis::acyclic::long::Target as _;
use fieldbeat_core::axis::acyclic::{
    Answer, Counts, Integer, ListError, Listed, Listing, Notation, NotationError, Place, Quantity, Values,
    Wanted, decimal, in_unit,
};

const FORM: &str = "C0061 (a code), C0039/2 (with a subcode), C0150.u16 (with a kind: u8, i8, u16, i16, u32, \
     i32, text), or 1/3 (slot and index of a record)";
const READ_ONLY: &str = "another one: the drive only reports this";

/// Addresses and values of these drives.
#[derive(Clone, Copy, Debug, Default)]
pub struct Codes;

impl Target {
    /// From text.
    pub fn parse(text: &str) -> Option<Target> {
        let Some(code) = text.strip_prefix(['C', 'c']) else {
            let (slot, index) = text.split_once('/')?;
            return Some(Target::Record(Record { slot: decimal(slot)?, index: decimal(index)? }));
        };
        let (code, kind) = match code.split_once('.') {
            Some((code, name)) => {
                (code, Kind::ALL.into_iter().find(|kind| kind.name() == name && *kind != Kind::Own)?)
            }
            None => (code, Kind::Own),
        };
        let (code, sub) = match code.split_once('/') {
            Some((code, sub)) => (code, decimal(sub)?),
            None => (code, 0),
        };
        Some(Target::Parameter(Parameter { code: decimal(code)?, sub, kind }))
    }

    /// The type of a value that is a number.
    pub(super) fn integer(self) -> Option<Integer> {
        self.parameter()?.kind().integer()
    }

    /// The quantity of its numbers.
    fn quantity(self) -> Option<Quantity> {
        self.parameter()?.quantity()
    }

    /// The kind of its values; `quantity` is what they measure if they are numbers.
    fn values(self, quantity: Option<Quantity>) -> Values {
        match (self, self.integer()) {
            (_, Some(of)) => Values::Counts(Counts { quantity, ..Counts::all(of) }),
            (Target::Parameter(_), None) => Values::Text,
            (Target::Record(_), None) => Values::Octets,
        }
    }

    /// The type and its decimals are those of most codes.
    fn is_assumed(self) -> bool {
        self.parameter().is_some_and(|parameter| parameter.kind == Kind::Own) && self.known().is_none()
    }

    fn known(self) -> Option<&'static CodeInfo> {
        self.parameter()?.known()
    }
}

impl Notation for Codes {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn place(&self, address: &str) -> Result<Place, NotationError> {
        let target = Target::parse(address).ok_or(NotationError::Address { form: FORM })?;
        let write = match target.known() {
            Some(known) if known.read_only => Err(NotationError::ReadOnly { instead: READ_ONLY }),
            _ if target.integer().is_none() => Ok(Service::Store(target, 0).into()),
            _ => Ok(target.write(0)),
        };
        Ok(Place { write, ..Place::of(target, target.values(target.quantity())) })
    }

    /// The drive has said what it is: in 32 bits it is scaled as by this address.
    fn show_answer(&self, address: &str, answer: &Answer) -> String {
        let Some(target) = Target::parse(address) else { return self.show(address, answer.value) };
        let read = Target::unpack(answer.address).unwrap_or(target);
        let in_32 = read.integer().is_some_and(|integer| integer.bits == 32);
        read.values(if in_32 { target.quantity() } else { read.quantity() }).show(answer.value)
    }

    fn in_unit(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        let is_assumed = Target::parse(address).is_some_and(Target::is_assumed);
        if is_assumed && text.parse::<i64>().is_ok() {
            // The drive may have it in 16 bits, and without decimals.
            let form = format!(
                "its kind behind the code ({address}.u16), {text}.0 for 32 bits with {DECIMALS} decimals, or a \
                 count with --raw: this code is not known here"
            );
            return Err(NotationError::Value { value: text.to_owned(), form });
        }
        in_unit(self, address, text)
    }

    fn reason(&self, status: u32) -> String {
        reason(status).into_owned()
    }

    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        list::list(wanted)
    }

    fn listed(&self, row: Listed, answer: &Answer) -> Listed {
        list::listed(row, answer)
    }
}

#[cfg(test)]
mod tests;
