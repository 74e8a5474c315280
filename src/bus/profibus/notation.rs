//! How people write what is in a Lenze drive, and the calls made from it.
//!
//! | address | access |
//! |---|---|
//! | `C0061`, `C0039/2` | a code, and one with a subcode; zeros in front may be left out |
//! | `C0150.u16` | the same with the kind of its value: u8, i8, u16, i16, u32, i32 |
//! | `C0200.text` | a text, by DP-V1; only read |
//! | `1/3` | slot and index of a record of the module, by DP-V1, as bytes |
//!
//! | value | means |
//! |---|---|
//! | `430000` | a count, as sent on the wire |
//! | `43.0` | with a point: scaled; 430000 of C0061. A code that is not in the [`catalogue`] is taken for one of 32 bits with four decimals, one with a kind behind it has none |
//! | `0x68FB0` | the bits of a count |
//! | `true`, `false` | 1, 0 |
//! | `"01 A0"` | bytes of a record |
//!
//! What a call does is in [`target`](super::target).

mod list;

use super::catalogue;
use super::target::{Kind, Parameter, Target, reason};
use super::wire::msac1::Record;
use crate::axis::acyclic::long::{self, READ, STORE, WRITE};
use crate::axis::acyclic::{
    Call, CallError, Carrier, ListError, Listing, Notation, NotationError, Wanted, bits, count,
};

const FORM: &str = "C0061 (a code), C0039/2 (with a subcode), C0150.u16 (with a kind: u8, i8, u16, i16, u32, i32, \
    text), or 1/3 (slot and index of a record)";
const READ_ONLY: &str = "another one: texts, and what the drive only reports, cannot be written";

/// Addresses and values of these drives.
#[derive(Clone, Copy, Debug, Default)]
pub struct Codes;

/// A number and nothing else.
fn digits<T: std::str::FromStr>(text: &str) -> Option<T> {
    text.bytes().all(|byte| byte.is_ascii_digit()).then(|| text.parse().ok())?
}

impl Target {
    /// From text.
    pub fn parse(text: &str) -> Option<Target> {
        let Some(code) = text.strip_prefix(['C', 'c']) else {
            let (slot, index) = text.split_once('/')?;
            return Some(Target::Record(Record { slot: digits(slot)?, index: digits(index)? }));
        };
        let (code, kind) = match code.split_once('.') {
            Some((code, name)) => {
                (code, Kind::ALL.into_iter().find(|kind| kind.name() == name && *kind != Kind::Own)?)
            }
            None => (code, Kind::Own),
        };
        let (code, sub) = match code.split_once('/') {
            Some((code, sub)) => (code, digits(sub)?),
            None => (code, 0),
        };
        Some(Target::Parameter(Parameter { code: digits(code)?, sub, kind }))
    }

    fn is_long(self) -> bool {
        self.number_kind().is_none()
    }

    /// The kind of a value that is a number.
    fn number_kind(self) -> Option<Kind> {
        match self {
            Target::Parameter(parameter) => Some(parameter.kind()).filter(|kind| kind.size().is_some()),
            Target::Record(_) => None,
        }
    }

    fn decimals(self) -> u32 {
        match self {
            Target::Parameter(parameter) => parameter.decimals(),
            Target::Record(_) => 0,
        }
    }

    fn can_be_written(self) -> bool {
        match self {
            Target::Parameter(parameter) => {
                parameter.kind() != Kind::Text && !parameter.known().is_some_and(|known| known.read_only)
            }
            Target::Record(_) => true,
        }
    }
}

impl Kind {
    fn mask(self) -> u64 {
        u64::MAX >> (u64::BITS - self.bits())
    }

    fn range(self) -> (i64, i64) {
        match (self.bits(), self.is_signed()) {
            (u64::BITS.., _) => (i64::MIN, i64::MAX),
            (bits, true) => (-1 << (bits - 1), (1 << (bits - 1)) - 1),
            (bits, false) => (0, (1 << bits) - 1),
        }
    }

    fn number(self, raw: u64) -> i64 {
        let above = u64::BITS - self.bits();
        let raw = (raw & self.mask()) << above;
        if self.is_signed() { raw as i64 >> above } else { (raw >> above) as i64 }
    }

    /// The number that a raw value means, which may have its sign above its bits.
    fn number_of(self, raw: u64) -> Option<i64> {
        let (low, high) = self.range();
        let own = (raw & self.mask() == raw).then(|| self.number(raw));
        let extended = [Some(raw as i64), u32::try_from(raw).ok().map(|raw| i64::from(raw as i32))];
        own.into_iter().chain(extended.into_iter().flatten()).find(|number| (low..=high).contains(number))
    }
}

/// The correct form of a value.
fn form(target: Target) -> String {
    let Some(kind) = target.number_kind() else {
        return format!("1 to {} bytes of two digits each, like \"01 A0\"", long::MOST);
    };
    let (low, high) = kind.range();
    let whole = format!("a whole number, {low} ... {high}, or its bits as 0x...");
    match target.decimals() {
        0 => whole,
        decimals => format!("{whole}, or a scaled one with a point and up to {decimals} decimals"),
    }
}

fn find(text: &str) -> Result<Target, NotationError> {
    Target::parse(text).ok_or(NotationError::Address { form: FORM })
}

fn writable(text: &str) -> Result<Target, NotationError> {
    let target = find(text)?;
    if target.can_be_written() { Ok(target) } else { Err(NotationError::ReadOnly { instead: READ_ONLY }) }
}

/// The bytes of a record.
fn octets(text: &str) -> Option<Vec<u8>> {
    long::parse_octets(text).filter(|bytes| (1..=long::MOST).contains(&bytes.len()))
}

impl Notation for Codes {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn read(&self, address: &str) -> Result<Call, NotationError> {
        Ok(Call { service: READ, address: find(address)?.pack(), value: 0 })
    }

    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
        let target = writable(address)?;
        let Some(kind) = target.number_kind() else {
            // A record has its own size: it goes in parts, and never by this call alone.
            return Ok(Call { service: STORE, address: target.pack(), value: 0 });
        };
        match kind.number_of(value) {
            Some(number) => {
                Ok(Call { service: WRITE, address: target.pack(), value: number as u64 & kind.mask() })
            }
            None => Err(NotationError::Value { value: value.to_string(), form: form(target) }),
        }
    }

    fn value(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        let target = writable(address)?;
        let wrong = || NotationError::Value { value: text.to_owned(), form: form(target) };
        let Some(kind) = target.number_kind() else {
            return octets(text).map(|bytes| long::raw(&bytes)).ok_or_else(wrong);
        };
        let number = match text.strip_prefix("0x") {
            Some(digits) => bits(digits).map(|raw| kind.number_of(raw).unwrap_or(i64::MAX)),
            None => count(text, target.decimals()),
        };
        let (low, high) = kind.range();
        match number {
            Some(number) if (low..=high).contains(&number) => Ok(number as u64 & kind.mask()),
            Some(_) => Err(NotationError::Range { value: text.to_owned(), low, high }),
            None => Err(wrong()),
        }
    }

    fn number(&self, address: &str, raw: u64) -> i64 {
        let kind = Target::parse(address).and_then(Target::number_kind);
        kind.map_or(raw as i64, |kind| kind.number(raw))
    }

    fn show(&self, address: &str, raw: u64) -> String {
        let Some(target) = Target::parse(address) else { return format!("{raw} (0x{raw:X})") };
        let Some(kind) = target.number_kind() else {
            let bytes = raw.to_le_bytes();
            return if matches!(target, Target::Record(_)) {
                long::octets(&bytes)
            } else {
                long::text(&bytes)
            };
        };
        let (number, decimals) = (kind.number(raw), target.decimals());
        let plain = format!("{number} (0x{:X})", raw & kind.mask());
        if decimals == 0 {
            return plain;
        }
        let unit = match target {
            Target::Parameter(parameter) => parameter.known().map_or("", |known| known.unit),
            Target::Record(_) => "",
        };
        let value = number as f64 / 10_f64.powi(decimals as i32);
        format!("{plain} = {value:.*} {unit}", decimals as usize).trim_end().to_owned()
    }

    fn reason(&self, status: u32) -> String {
        reason(status).into_owned()
    }

    fn read_long(&self, carrier: &dyn Carrier, address: &str) -> Option<Result<(u64, String), CallError>> {
        let target = Target::parse(address).filter(|target| target.is_long())?;
        let call = Call { service: READ, address: target.pack(), value: 0 };
        Some(long::read(carrier, call.address, self.limit(&call)).map(|bytes| {
            let is_record = matches!(target, Target::Record(_));
            (long::raw(&bytes), if is_record { long::octets(&bytes) } else { long::text(&bytes) })
        }))
    }

    fn write_long(&self, address: &str, text: &str) -> Option<Vec<Call>> {
        let target = Target::parse(address).filter(|target| target.is_long() && target.can_be_written())?;
        Some(long::write(target.pack(), &octets(text)?))
    }

    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        list::list(wanted)
    }
}

#[cfg(test)]
mod tests;
