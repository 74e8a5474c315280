//! The objects in the PDOs of a drive, as a recording shows them.

use super::native::number;
use super::object::pdo::{Entry, Layout};
use super::plan::KollmorgenDrive;
use fieldbeat_core::bus::native::{NativeField, NativeLayout};

/// The objects of `drive`, each with its index, subindex, and its name if it has one here.
pub(super) fn layout(drive: &KollmorgenDrive) -> NativeLayout {
    NativeLayout {
        inputs: fields(&drive.inputs),
        outputs: fields(&drive.outputs),
        most: drive.inputs.size() + drive.outputs.size(),
    }
}

fn fields(layout: &Layout) -> Vec<NativeField> {
    let numbers = layout.places().filter(|(_, entry)| !entry.kind.is_string());
    let field = |(at, Entry { object, kind }): (usize, Entry)| {
        let name = object.known().map_or("", |known| known.name);
        let name = format!("{:04x}_{}_{name}", object.index, object.sub);
        NativeField::new(name, move |pdo| number(kind, at, pdo))
    };
    numbers.map(field).collect()
}
