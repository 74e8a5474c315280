//! The list of the known codes.

use super::super::catalogue::{CODES, Known};
use super::super::target::{Kind, Parameter, Target};
use fieldbeat_core::axis::acyclic::{
    Access, ListError, Listed, Listing, ParameterError, Wanted, Watcher, go_on,
};

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
        true => Listing::Read(Box::new(move |access, watch| read(access, watch, rows))),
    })
}

/// Those of `rows` that the drive has, with their values, and each as what the drive says that it is.
fn read(access: Access<'_>, watch: Watcher<'_>, rows: Vec<Listed>) -> Result<Vec<Listed>, ListError> {
    let all = rows.len();
    let mut found = Vec::with_capacity(all);
    for (done, row) in rows.into_iter().enumerate() {
        go_on(access, watch, done, all)?;
        let answer = match access.answer(&row.address) {
            Ok(answer) => answer,
            // Another model has it, or another firmware.
            Err(ParameterError::Refused { .. }) => continue,
            Err(error) => return Err(error.into()),
        };
        let mut row = Listed { raw: Some(answer.value), ..row };
        if let Some(read @ Parameter { kind, .. }) =
            Target::unpack(answer.address).and_then(Target::parameter)
            && kind != Kind::Own
        {
            row.usage = read.known().map(|known| usage(kind, known));
            row.address = format!("{}.{kind}", row.address);
        }
        found.push(row);
    }
    Ok(found)
}

fn usage(kind: Kind, known: &Known) -> String {
    format!("{kind} {}", if known.read_only { "read" } else { "read write" })
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
        usage: Some(usage(known.kind, known)),
        raw: None,
    })
}
