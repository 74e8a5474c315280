//! The list of the known codes.

use super::super::catalogue::{CODES, Known};
use fieldbeat_core::axis::acyclic::{ListError, Listed, Listing, Wanted, read_listed};

/// How what is `wanted` is listed.
pub(super) fn list(wanted: &Wanted<'_>) -> Result<Listing, ListError> {
    let drive = wanted.drive;
    if wanted.modified || wanted.from.is_some() || wanted.part.is_some() {
        return Err(ListError::Wanted(format!(
            "drive {drive} does not list its codes: those known here are listed, with --values or without; \
             leave a part, --modified and --from out"
        )));
    }
    let rows: Vec<Listed> = CODES.iter().flat_map(rows).collect();
    Ok(match wanted.values {
        false => Listing::Known(rows),
        true => Listing::Read(Box::new(move |access, watch| read_listed(access, watch, rows))),
    })
}

/// A code, or each of its subcodes.
fn rows(known: &Known) -> impl Iterator<Item = Listed> {
    let subcodes = if known.subcodes == 0 { 0..=0 } else { 1..=known.subcodes };
    subcodes.map(|sub| Listed {
        address: match sub {
            0 => format!("C{:04}", known.code),
            _ => format!("C{:04}/{sub}", known.code),
        },
        name: Some(known.name),
        usage: Some(format!("{} {}", known.kind, if known.read_only { "read" } else { "read write" })),
        raw: None,
    })
}
