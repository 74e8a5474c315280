//! Lists of the parameters of a Unidrive: those of a menu that it gives, with their values.

use super::UNREACHABLE;
use crate::parameter::{Addressing, Parameter};
use crate::wire::ExceptionCode;
use fieldbeat_core::axis::acyclic::{
    Access, ListError, Listed, Listing, ParameterError, Wanted, Watcher, go_on,
};

/// The highest number of a parameter, whatever the addressing of the drive.
const MOST: u8 = Addressing::Modified.number_max();

/// How the parameters that are `wanted` are listed.
pub(super) fn list(wanted: &Wanted<'_>) -> Result<Listing, ListError> {
    if wanted.modified || wanted.values || wanted.from.is_some() {
        return Err(wanted.refused("lists by menu, with values; leave --modified, --values and --from out"));
    }
    let Some(menu) = wanted.part else {
        return Err(wanted.refused("lists by menu; name one, like 06, or 4.15 of the module in slot 4"));
    };
    let Ok(first) = format!("{menu}.001").parse::<Parameter>() else {
        let why = format!("{menu}: not a menu; write 06, or 4.15 of the module in slot 4");
        return Err(ListError::Wanted(why));
    };
    let menu = menu.to_owned();
    Ok(Listing::Read(Box::new(move |access, watch| {
        let rows = read(access, watch, first)?;
        match rows.is_empty() {
            true => Err(ListError::Failed(format!("drive {}: menu {menu} has no parameters", access.drive))),
            false => Ok(rows),
        }
    })))
}

/// Those of the menu of `first` that the drive gives.
fn read(access: Access<'_>, watch: Watcher<'_>, first: Parameter) -> Result<Vec<Listed>, ListError> {
    let mut rows = Vec::new();
    for number in 0..=MOST {
        go_on(access, watch, number.into(), MOST.into())?;
        let parameter = Parameter { number, ..first };
        let address = parameter.to_string();
        match access.read(&address) {
            Ok(raw) => rows.push(Listed {
                address,
                name: parameter.known().map(|known| known.name),
                usage: usage(parameter),
                raw: Some(raw),
            }),
            Err(ParameterError::Refused { status, .. }) if status == u32::from(ExceptionCode::ADDRESS.0) => {}
            // 00.000 is nowhere, and behind the last one that has an address none has.
            Err(ParameterError::Refused { status: UNREACHABLE, .. }) if number == 0 => {}
            Err(ParameterError::Refused { status: UNREACHABLE, .. } | ParameterError::Notation { .. }) => {
                break;
            }
            Err(error) => return Err(error.into()),
        }
    }
    Ok(rows)
}

/// Bits and access, as far as known.
fn usage(parameter: Parameter) -> Option<String> {
    let known = parameter.known()?;
    Some(format!("{} {}", known.width.bits(), known.access))
}
