//! How people write objects and their values, the calls made from them, and their lists.

use super::catalogue::{self, Drives, ObjectInfo};
use super::{MAILBOX, Object, Target, Type, long, own_reason};
use crate::wire::mailbox::MailboxError;
use crate::wire::sdo::AbortCode;
use fieldbeat_core::axis::acyclic::{
    Counts, ListError, Listed, Listing, Notation, NotationError, Place, Quantity, Values, Wanted,
};

const FORM: &str = "0x6041:0, index and subindex, 0x1C12:ca for all subindices, or a name; .u16 behind it \
     for a type (i8, u8, i16, u16, i32, u32, text, octets)";

/// Addresses and values of drives with objects.
#[derive(Clone, Copy, Debug, Default)]
pub struct Objects;

impl Notation for Objects {
    fn protocol(&self) -> &'static str {
        crate::PROTOCOL
    }

    fn place(&self, address: &str) -> Result<Place, NotationError> {
        let target = Target::parse(address).ok_or(NotationError::Address { form: FORM })?;
        let known = target.object.known();
        let values = match target.kind {
            None if target.complete => Values::Octets,
            None => {
                Values::Unknown { form: format!("the type of the object behind its address, {address}.u16") }
            }
            Some(Type::Text) => Values::Text,
            Some(Type::Octets) => Values::Octets,
            Some(kind) => Values::Counts(Counts {
                range: match known {
                    Some(known) if known.kind == kind => (known.min, known.max),
                    _ => kind.range(),
                },
                quantity: known.and_then(|known| Quantity::decimals(0, known.unit)),
                by_bits: true,
                ..Counts::all(kind.integer())
            }),
        };
        let place = Place::of(target, values);
        let instead = match known {
            _ if target.complete => "each subindex by itself",
            Some(ObjectInfo { access: catalogue::Access::ReadOnly, .. }) => {
                "an object that is no actual value"
            }
            _ => return Ok(place),
        };
        Ok(Place { write: Err(NotationError::ReadOnly { instead }), ..place })
    }

    fn reason(&self, status: u32) -> String {
        let refused = status.checked_sub(MAILBOX).and_then(|code| u16::try_from(code).ok());
        match (own_reason(status), refused.map(MailboxError)) {
            (Some(reason), _) => reason.to_owned(),
            (None, Some(error)) => format!("the slave cannot use the mailbox message: {error}"),
            (None, None) => AbortCode(status).to_string(),
        }
    }

    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        if wanted.modified || wanted.part.is_some() {
            return Err(wanted.refused("lists its objects; leave --modified and the menu out"));
        }
        let from = wanted.from.unwrap_or("0x1000");
        let Some(first) = Object::parse(from) else {
            return Err(ListError::Wanted(format!("--from {from}: not an object; write 0x6041:0")));
        };
        let key = |object: Object| (object.index, object.sub);
        let all = catalogue::all().filter(|known| key(known.object) >= key(first));
        Ok(Listing::of(all.map(row).collect(), wanted.values))
    }
}

/// The bytes of a string: printable characters, or octets; `None`: it is none, or too long.
pub fn string(kind: Type, text: &str) -> Option<Vec<u8>> {
    if kind == Type::Octets { long::parse_octets(text) } else { long::parse_text(text) }
}

fn row(known: &'static ObjectInfo) -> Listed {
    let (address, usage) = (known.object.to_string(), Some(usage(known)));
    Listed { address, name: Some(known.name), usage, raw: None }
}

/// Type, access, and which drives have it if not all.
fn usage(known: &ObjectInfo) -> String {
    let drives = match known.drives {
        Drives::All => "",
        Drives::S700 => ", not AKD",
        Drives::Akd => ", AKD only",
    };
    format!("{} {}{drives}", known.kind, known.access)
}
