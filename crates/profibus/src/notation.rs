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

use super::catalogue::{DECIMALS, Known};
use super::target::{Kind, Parameter, Service, Target, reason};
use super::wire::msac1::Record;
use fieldbeat_core::axis::acyclic::{
    Call, CallError, Carrier, Integer, ListError, Listing, Notation, NotationError, Quantity, Series, Wanted,
    bits, count, in_unit, long, shown, within,
};

const FORM: &str = "C0061 (a code), C0039/2 (with a subcode), C0150.u16 (with a kind: u8, i8, u16, i16, u32, \
     i32, text), or 1/3 (slot and index of a record)";
const READ_ONLY: &str = "another one: the drive only reports this";

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

    /// The type of a value that is a number.
    pub(super) fn integer(self) -> Option<Integer> {
        self.parameter()?.kind().integer()
    }

    /// Decimals and unit.
    fn scale(self) -> (u32, &'static str) {
        self.parameter().map_or((0, ""), Parameter::scale)
    }

    /// A number as people read it, with these decimals and this unit.
    fn shown(self, raw: u64, (decimals, unit): (u32, &'static str)) -> String {
        let Some(integer) = self.integer() else { return self.text(&raw.to_le_bytes()) };
        let number = integer.number(raw);
        let means = Quantity::decimals(decimals, unit).map(|quantity| quantity.show(number));
        shown(means, number, integer.raw(number))
    }

    /// The same of a value that the drive has said to be of `read`: in 32 bits it is scaled as by this address.
    fn shown_as(self, read: Target, raw: u64) -> String {
        let in_32 = read.integer().is_some_and(|integer| integer.bits == 32);
        read.shown(raw, if in_32 { self.scale() } else { read.scale() })
    }

    /// Its type and its decimals are those of most codes.
    fn is_assumed(self) -> bool {
        self.parameter().is_some_and(|parameter| parameter.kind == Kind::Own) && self.known().is_none()
    }

    fn known(self) -> Option<&'static Known> {
        self.parameter()?.known()
    }

    /// What is no number, from text.
    fn bytes(self, text: &str) -> Option<Vec<u8>> {
        match self {
            Target::Parameter(_) => long::parse_text(text),
            Target::Record(_) => long::parse_octets(text),
        }
    }

    /// What is no number, as text.
    fn text(self, bytes: &[u8]) -> String {
        match self {
            Target::Parameter(_) => long::text(bytes),
            Target::Record(_) => long::octets(bytes),
        }
    }
}

/// The correct form of a value.
fn form(target: Target) -> String {
    let Some(integer) = target.integer() else {
        return match target {
            Target::Parameter(_) => format!("1 to {} characters of ASCII", long::MOST),
            Target::Record(_) => format!("1 to {} bytes of two digits each, like \"01 A0\"", long::MOST),
        };
    };
    let (low, high) = integer.range();
    format!("a whole number, {low} ... {high}, or its bits as 0x...")
}

fn find(text: &str) -> Result<Target, NotationError> {
    Target::parse(text).ok_or(NotationError::Address { form: FORM })
}

fn writable(text: &str) -> Result<Target, NotationError> {
    let target = find(text)?;
    match target.known() {
        Some(known) if known.read_only => Err(NotationError::ReadOnly { instead: READ_ONLY }),
        _ => Ok(target),
    }
}

impl Notation for Codes {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn read(&self, address: &str) -> Result<Call, NotationError> {
        Ok(Service::Read(find(address)?).into())
    }

    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
        let target = writable(address)?;
        let Some(integer) = target.integer() else {
            // It has its own size: it goes in parts, and never by this call alone.
            return Ok(Service::Store(target, 0).into());
        };
        match integer.number_within(value, integer.range()) {
            Some(number) => Ok(Service::Write(target, integer.raw(number) as u32).into()),
            None => Err(NotationError::Value { value: value.to_string(), form: form(target) }),
        }
    }

    fn value(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        let target = writable(address)?;
        let Some(integer) = target.integer() else {
            let wrong = || NotationError::Value { value: text.to_owned(), form: form(target) };
            return target.bytes(text).map(|bytes| long::raw(&bytes)).ok_or_else(wrong);
        };
        let range = integer.range();
        let number = match text.strip_prefix("0x") {
            Some(digits) => bits(digits).map(|raw| integer.number_within(raw, range).unwrap_or(i64::MAX)),
            None => count(text),
        };
        within(number, range, text, || form(target)).map(|number| integer.raw(number))
    }

    fn number(&self, address: &str, raw: u64) -> i64 {
        let integer = Target::parse(address).and_then(Target::integer);
        integer.map_or(raw as i64, |integer| integer.number(raw))
    }

    fn show(&self, address: &str, raw: u64) -> String {
        let Some(target) = Target::parse(address) else { return format!("{raw} (0x{raw:X})") };
        target.shown(raw, target.scale())
    }

    fn quantity(&self, address: &str) -> Option<Quantity> {
        let target = Target::parse(address)?;
        target.integer()?;
        let (decimals, unit) = target.scale();
        Quantity::decimals(decimals, unit)
    }

    fn in_unit(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        let target = writable(address)?;
        let is_plain = count(text).is_some() && !matches!(text, "true" | "false");
        if is_plain && target.is_assumed() {
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

    fn read_long(&self, carrier: &dyn Carrier, address: &str) -> Option<Result<(u64, String), CallError>> {
        let target = Target::parse(address)?;
        let call = Service::Read(target).into();
        if target.integer().is_some() {
            let Series { answers, failed } = carrier.run(&[call], self.limit(&call));
            let Some(answer) = answers.first() else { return Some(Err(failed.unwrap_or(CallError::Gone))) };
            let read = Target::unpack(answer.address).unwrap_or(target);
            return Some(Ok((answer.value, target.shown_as(read, answer.value))));
        }
        let read = long::read(carrier, call.address, self.limit(&call));
        Some(read.map(|bytes| (long::raw(&bytes), target.text(&bytes))))
    }

    fn write_long(&self, address: &str, text: &str) -> Option<Vec<Call>> {
        let target = writable(address).ok().filter(|target| target.integer().is_none())?;
        Some(long::write(target.pack(), &target.bytes(text)?))
    }

    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        list::list(wanted)
    }
}

#[cfg(test)]
mod tests;
