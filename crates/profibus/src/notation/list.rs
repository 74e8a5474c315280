//! The list of the known codes.

use super::super::catalogue::{CODES, CodeInfo};
use super::super::target::{Kind, Parameter, Target};
use fieldbeat_core::axis::acyclic::long::Target as _;
use fieldbeat_core::axis::acyclic::{Answer, ListError, Listed, Listing, Wanted};

/// How what is `wanted` is listed.
pub(super) fn list(wanted: &Wanted<'_>) -> Result<Listing, ListError> {
    if wanted.modified || wanted.from.is_some() || wanted.part.is_some() {
        return Err(wanted.refused(
            "does not list its codes: those known here are listed, with --values or without; leave a part, \
             --modified and --from out",
        ));
    }
    Ok(Listing::of(CODES.iter().flat_map(rows).collect(), wanted.values))
}

/// A code with its value, and as what the drive says that it is.
pub(super) fn listed(row: Listed, answer: &Answer) -> Listed {
    let mut row = Listed { raw: Some(answer.value), ..row };
    if let Some(read @ Parameter { kind, .. }) = Target::unpack(answer.address).and_then(Target::parameter)
        && kind != Kind::Own
    {
        row.usage = read.known().map(|known| usage(kind, known));
        row.address = format!("{}.{kind}", row.address);
    }
    row
}

fn usage(kind: Kind, known: &CodeInfo) -> String {
    format!("{kind} {}", if known.read_only { "read" } else { "read write" })
}

/// A code, or each of its subcodes.
fn rows(known: &CodeInfo) -> impl Iterator<Item = Listed> {
    let subcodes = if known.subcodes == 0 { 0..=0 } else { 1..=known.subcodes };
    subcodes.map(|sub| Listed {
        address: match sub {
            0 => format!("C{:04}", known.code),
            _ => format!("C{:04}/{sub}", known.code),
        },
        name: Some(known.name),
        usage: Some(usage(known.kind, known)),
        raw: None,
    })
}
