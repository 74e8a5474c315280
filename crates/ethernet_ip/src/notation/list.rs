//! Lists of what a drive has: parameters, registers, commands.

use super::{Address, NAMED, Named, names};
use crate::target::Target;
use crate::wire::opcodes::{self, Operand};
use fieldbeat_core::axis::acyclic::{ListError, Listed, Listing, Wanted};

/// How what is `wanted` is listed.
pub(super) fn list(wanted: &Wanted<'_>) -> Result<Listing, ListError> {
    let drive = wanted.drive;
    if wanted.modified || wanted.from.is_some() {
        return Err(
            wanted.refused("lists parameters, registers or commands; leave --modified and --from out")
        );
    }
    let rows = match wanted.part {
        None => parameters().chain(registers()).chain(commands()).chain(others()).collect(),
        Some("parameters") => parameters().collect(),
        Some("registers") => registers().collect(),
        Some("commands") => commands().chain(others()).collect(),
        Some(part) => {
            return Err(ListError::Wanted(format!(
                "{part}: drive {drive} has parameters, registers and commands; name one of them, or none for \
                 all"
            )));
        }
    };
    Ok(Listing::of(rows, wanted.values))
}

fn row(address: String, name: Option<&'static str>) -> Listed {
    let usage = Address::parse(&address).map(|address| usage(&address));
    Listed { address, name, usage, raw: None }
}

/// Bits and access.
fn usage(address: &Address) -> String {
    let access = match (address.target.can_be_read(), address.target.can_be_written()) {
        (true, true) => "read write",
        (true, false) => "read",
        _ => "write",
    };
    match address.target {
        Target::Parameter { .. } | Target::Register(_) => {
            format!("{} {access}", address.values.integer().bits)
        }
        _ => access.to_owned(),
    }
}

fn parameters() -> impl Iterator<Item = Listed> {
    opcodes::PARAMETERS.into_iter().map(|known| row(names::hyphened(known.name), names::meaning(known.name)))
}

fn registers() -> impl Iterator<Item = Listed> {
    let of_the_user = (b'0'..=b'9').map(|register| (register, "of the user"));
    let all = of_the_user.chain(opcodes::REGISTERS);
    all.map(|(register, name)| row(format!("R:{}", char::from(register)), Some(name)))
}

fn commands() -> impl Iterator<Item = Listed> {
    opcodes::OPCODES.into_iter().map(|known| {
        let field = match known.operand {
            Operand::Register | Operand::RegisterLong => "/0",
            _ => "",
        };
        row(format!("SCL:{}{field}", known.name), names::meaning(known.name))
    })
}

fn others() -> impl Iterator<Item = Listed> {
    let (read, sent) = NAMED.split_at(3);
    let output = ("output:1", "an output at once: 1 is closed");
    let named = |of: &'static [Named]| of.iter().map(|(name, .., meaning)| (*name, *meaning));
    let all = named(read).chain([output]).chain(named(sent));
    all.map(|(address, name)| row(address.to_owned(), Some(name)))
}
