//! How people write objects and their values, the calls made from them, and their lists.

use super::catalogue::{self, Drives, Known};
use super::long::MOST;
use super::{MAILBOX, Object, Target, Type, long, own_reason};
use crate::wire::mailbox::MailboxError;
use crate::wire::sdo::AbortCode;
use fieldbeat_core::axis::acyclic::{
    Access, Call, CallError, Carrier, ListError, Listed, Listing, Notation, NotationError, ParameterError,
    Quantity, Wanted, Watcher, bits, go_on, shown, within,
};

const FORM: &str = "0x6041:0, index and subindex, 0x1C12:ca for all subindices, or a name; .u16 behind it \
     for a type (i8, u8, i16, u16, i32, u32, text, octets)";

/// Addresses and values of drives with objects.
#[derive(Clone, Copy, Debug, Default)]
pub struct Objects;

impl Objects {
    fn find(text: &str) -> Result<Target, NotationError> {
        Target::parse(text).ok_or(NotationError::Address { form: FORM })
    }

    /// With a type: nothing can be written without.
    fn typed(text: &str, value: &str) -> Result<(Target, Type), NotationError> {
        let target = Objects::find(text)?;
        if target.complete {
            return Err(NotationError::ReadOnly { instead: "each subindex by itself" });
        }
        let Some(kind) = target.kind else {
            let form = format!("the type of the object behind its address, {text}.u16");
            return Err(NotationError::Value { value: value.to_owned(), form });
        };
        match target.object.known() {
            Some(known) if known.access == catalogue::Access::ReadOnly => {
                Err(NotationError::ReadOnly { instead: "an object that is no actual value" })
            }
            _ => Ok((target, kind)),
        }
    }
}

impl Notation for Objects {
    fn protocol(&self) -> &'static str {
        crate::PROTOCOL
    }

    fn read(&self, address: &str) -> Result<Call, NotationError> {
        Objects::find(address).map(Target::read)
    }

    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
        let (target, kind) = Objects::typed(address, &value.to_string())?;
        let raw = kind.raw(value as i64);
        // A number may come with its sign above its bits.
        let is_number = !kind.is_string() && kind.is_signed() && kind.number(value) == value as i64;
        // Or with the sign of a number of 32 bits.
        let is_word = u32::try_from(value).is_ok_and(|word| kind.number(raw) == i64::from(word as i32));
        match raw == value || is_number || is_word {
            true => Ok(target.write(raw)),
            false => {
                let form = format!("a number of {} bits", 8 * kind.bytes());
                Err(NotationError::Value { value: value.to_string(), form })
            }
        }
    }

    fn value(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        let (target, kind) = Objects::typed(address, text)?;
        if kind.is_string() {
            let form = match kind {
                Type::Octets => format!("1 to {MOST} bytes of two digits each, like \"01 A0\""),
                _ => format!("1 to {MOST} characters of ASCII"),
            };
            let wrong = NotationError::Value { value: text.to_owned(), form };
            return string(kind, text).map(|bytes| long::raw(&bytes)).ok_or(wrong);
        }
        let (low, high) = match target.object.known() {
            Some(known) if known.kind == kind => (known.min, known.max),
            _ => kind.range(),
        };
        let number = match text.strip_prefix("0x") {
            Some(digits) => bits(digits).map(|raw| match kind.raw(raw as i64) == raw {
                true => kind.number(raw),
                false => i64::MAX,
            }),
            None => text.parse().ok(),
        };
        let form = || format!("a whole number, {low} ... {high}, or its bits as 0x...");
        within(number, (low, high), text, form).map(|number| kind.raw(number))
    }

    fn number(&self, address: &str, raw: u64) -> i64 {
        Target::parse(address).map_or(raw as i64, |target| target.number(raw))
    }

    fn show(&self, address: &str, raw: u64) -> String {
        let target = Target::parse(address);
        if let Some(target) = target.filter(Target::is_bytes) {
            return target.shown(&raw.to_le_bytes());
        }
        let Some(kind) = target.and_then(|target| target.kind) else {
            return format!("{raw} (0x{raw:X})");
        };
        let raw = kind.raw(raw as i64);
        let number = kind.number(raw);
        shown(self.quantity(address).map(|quantity| quantity.show(number)), number, raw)
    }

    fn quantity(&self, address: &str) -> Option<Quantity> {
        let target = Target::parse(address).filter(|target| !target.complete)?;
        target.kind.filter(|kind| !kind.is_string())?;
        Quantity::decimals(0, target.object.known()?.unit)
    }

    fn reason(&self, status: u32) -> String {
        let refused = status.checked_sub(MAILBOX).and_then(|code| u16::try_from(code).ok());
        match (own_reason(status), refused.map(MailboxError)) {
            (Some(reason), _) => reason.to_owned(),
            (None, Some(error)) => format!("the slave cannot use the mailbox message: {error}"),
            (None, None) => AbortCode(status).to_string(),
        }
    }

    fn read_long(&self, carrier: &dyn Carrier, address: &str) -> Option<Result<(u64, String), CallError>> {
        let target = Target::parse(address).filter(Target::is_bytes)?;
        let read = long::read(carrier, target.pack(), self.limit(&target.read()));
        Some(read.map(|bytes| (long::raw(&bytes), target.shown(&bytes))))
    }

    fn write_long(&self, address: &str, text: &str) -> Option<Vec<Call>> {
        let target = Target::parse(address)?;
        let bytes = string(target.kind.filter(|kind| kind.is_string())?, text)?;
        Some(long::write(target.pack(), &bytes))
    }

    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        if wanted.modified || wanted.part.is_some() {
            let why = "lists its objects; leave --modified and the menu out";
            return Err(ListError::Wanted(format!("drive {} {why}", wanted.drive)));
        }
        let from = wanted.from.unwrap_or("0x1000");
        let Some(first) = Object::parse(from) else {
            return Err(ListError::Wanted(format!("--from {from}: not an object; write 0x6041:0")));
        };
        let key = |object: Object| (object.index, object.sub);
        let all = catalogue::all().filter(move |known| key(known.object) >= key(first));
        let all: Vec<&'static Known> = all.collect();
        Ok(match wanted.values {
            false => Listing::Known(all.into_iter().map(|known| listed(known, None)).collect()),
            true => Listing::Read(Box::new(move |access, watch| values(access, watch, &all))),
        })
    }
}

/// The bytes of a string: printable characters, or octets; `None`: it is none, or too long.
pub fn string(kind: Type, text: &str) -> Option<Vec<u8>> {
    if kind == Type::Octets { long::parse_octets(text) } else { long::parse_text(text) }
}

/// Those that the drive has, with their values.
fn values(access: Access<'_>, watch: Watcher<'_>, all: &[&'static Known]) -> Result<Vec<Listed>, ListError> {
    let mut rows = Vec::with_capacity(all.len());
    for (done, known) in all.iter().enumerate() {
        go_on(access, watch, done, all.len())?;
        match access.read(&known.object.to_string()) {
            Ok(raw) => rows.push(listed(known, Some(raw))),
            // Another family has it, or another firmware.
            Err(ParameterError::Refused { .. }) => {}
            Err(error) => return Err(error.into()),
        }
    }
    Ok(rows)
}

fn listed(known: &'static Known, raw: Option<u64>) -> Listed {
    let (address, usage) = (known.object.to_string(), Some(usage(known)));
    Listed { address, name: Some(known.name), usage, raw }
}

/// Type, access, and which drives have it if not all.
fn usage(known: &Known) -> String {
    let access = match known.access {
        catalogue::Access::ReadOnly => "read",
        catalogue::Access::ReadWrite => "read write",
        catalogue::Access::PreOp => "read, write in PREOP",
    };
    let drives = match known.drives {
        Drives::All => "",
        Drives::S700 => ", not AKD",
        Drives::Akd => ", AKD only",
    };
    format!("{} {access}{drives}", known.kind.name())
}
