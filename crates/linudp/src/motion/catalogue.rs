//! What is known of each motion command, as data: its name, where it may be used, and the fields after its header.
//!
//! Knows the layout of the catalogue, not its contents: those are in `commands`, with what looks them up.
//!
//! The fields of a command follow each other without a gap, the first one after the header, so that their order is
//! their layout. No command has more than [`FIELDS`].

use super::command::MotionCommand;
use super::values::Kind;
use fieldbeat_core::axis::RangeError;
use fieldbeat_core::axis::acyclic::Integer;

/// The most fields that a command has.
pub const FIELDS: usize = 5;

/// Bytes of the header, where the first field begins.
const HEADER: usize = 2;

/// A motion command of the catalogue.
#[derive(Debug)]
pub struct CommandInfo {
    /// Master id (bits 11-4) and sub id (3-0).
    pub id: u16,
    /// The name in files: `vai-go-to`.
    pub name: &'static str,
    /// The remarks to know before it is sent.
    pub marks: &'static [Mark],
    /// The fields, in the order of the wire.
    pub fields: &'static [Field],
}

/// The remarks on a command to know before it is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// It has an effect inside the command table only.
    TableOnly,
    /// The drive needs a software key for it.
    SoftwareKey,
    /// It is not in the manual of 2014: older firmware does not have it.
    Newer,
    /// The layout, or which of two like commands it is, is not certain.
    Assumed,
}

/// A value after a header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field {
    /// The name in files: `velocity`.
    pub name: &'static str,
    /// The first byte, counted from the header as in the manual; at least 2.
    pub at: usize,
    /// Type, unit, range.
    pub kind: Kind,
}

impl CommandInfo {
    /// It has this mark.
    pub fn is(&self, mark: Mark) -> bool {
        self.marks.contains(&mark)
    }

    /// Bytes of its fields after the header.
    pub fn size(&self) -> usize {
        self.fields.last().map_or(0, |field| field.at + field.kind.size() - HEADER)
    }

    /// The wire integers of its fields in `parameters`, the bytes after a header; 0 where it has no field. Some may
    /// be out of their range, since a drive stores what it was given.
    pub fn values(&self, parameters: &[u8]) -> [i64; FIELDS] {
        std::array::from_fn(|index| self.fields.get(index).map_or(0, |field| field.read(parameters)))
    }

    /// The command with these wire integers in its fields, missing ones 0; refused with the field that is out of
    /// its range.
    pub fn command(&self, values: &[i64]) -> Result<MotionCommand, (Field, RangeError)> {
        let mut command = MotionCommand::new(self.id);
        for (index, field) in self.fields.iter().enumerate() {
            let value = values.get(index).copied().unwrap_or(0);
            field.kind.check(value).map_err(|error| (*field, error))?;
            field.write(&mut command.parameters, value);
        }
        Ok(command)
    }
}

impl Field {
    /// The wire integer in `parameters`, the bytes after a header; missing bytes are 0.
    pub fn read(&self, parameters: &[u8]) -> i64 {
        let place = parameters.iter().skip(self.at - HEADER).take(self.kind.size());
        let value = place.rev().fold(0_u32, |value, byte| value << 8 | u32::from(*byte));
        let integer = Integer { bits: 8 * self.kind.size() as u32, signed: self.kind.is_signed() };
        integer.number(value.into())
    }

    /// Writes a wire integer into `parameters`, the bytes after a header. The caller checks its range; excess bits
    /// are cut off.
    pub fn write(&self, parameters: &mut [u8], value: i64) {
        let place = parameters.get_mut(self.at - HEADER..).unwrap_or_default();
        for (byte, written) in place.iter_mut().zip(value.to_le_bytes()).take(self.kind.size()) {
            *byte = written;
        }
    }
}

/// The fields of these names and kinds, one after the other.
pub(super) const fn lay_out<const N: usize>(fields: [(&'static str, Kind); N]) -> [Field; N] {
    assert!(N <= FIELDS);
    let mut laid = [Field { name: "", at: HEADER, kind: Kind::Bits }; N];
    let (mut index, mut at) = (0, HEADER);
    while index < N {
        let (name, kind) = fields[index];
        laid[index] = Field { name, at, kind };
        at += kind.size();
        index += 1;
    }
    laid
}

/// `vai_go_to` to `vai-go-to`.
pub(super) const fn kebab<const N: usize>(name: &str) -> [u8; N] {
    let mut kebab = [0; N];
    let mut index = 0;
    while index < N {
        let byte = name.as_bytes()[index];
        kebab[index] = if byte == b'_' { b'-' } else { byte };
        index += 1;
    }
    kebab
}
