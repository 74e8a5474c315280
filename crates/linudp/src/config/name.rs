//! Names in the files of curves and command tables: as a text, or else byte for byte.

use std::fmt::Write;

use fieldbeat_keys::keys;
use fieldbeat_keys::table::Table;

keys! {
    NAME "name" = "none": "name in the drive";
    NAME_BYTES "name_bytes" = "none": "the bytes of a `name` that is no such text";
}

/// What `name` or `name_bytes` says; `encoded`: the bytes of a text, if it is a name.
pub(super) fn read<const N: usize>(
    table: &mut Table<'_>,
    hint: &str,
    encoded: impl Fn(&str) -> Option<[u8; N]>,
) -> [u8; N] {
    let name = table.text(NAME, None, hint, encoded);
    let name_bytes = table.bytes(NAME_BYTES);
    if table.gives("name") && table.gives("name_bytes") {
        table.fault("name_bytes", "cannot be used together with name; keep one");
    }
    name.or(name_bytes).unwrap_or([0; N])
}

/// The line of a name that [`read`] makes the same of, with this in front of it.
pub(super) fn write(text: &mut String, before: &str, name: Option<&str>, bytes: &[u8]) {
    let _ = match name {
        Some("") => Ok(()),
        // Printable ASCII needs no other escapes than a TOML string has.
        Some(name) => writeln!(text, "{before}name = {name:?}"),
        None => writeln!(text, "{before}name_bytes = {bytes:?}"),
    };
}
