//! The drive's command table: motion commands that it runs by itself, one after the other. Byte for byte.
//!
//! Knows no file and no channel. Up to 255 entries of [`ENTRY_SIZE`] bytes, each with a motion command and the
//! entry that follows it. An entry is kept exactly as the drive holds it, valid or not.
//!
//! Facts: "Drive Configuration over Fieldbus Interfaces" manual, command table entry; confirmed by an independent
//! master on real drives.

use std::collections::BTreeMap;

use thiserror::Error;

use super::motion::{CommandInfo, EntryId, Kind, MotionCommand};
use super::name;
use super::wire::{Fill, Take};

/// Bytes of an entry.
pub const ENTRY_SIZE: usize = 64;
/// Bytes of a name and the zero that ends it.
pub const NAME_SIZE: usize = 16;
/// Bytes of the parameters: two more than a motion command has.
pub const PARAMETERS_SIZE: usize = 32;
/// Bytes without a known meaning.
pub const RESERVED_SIZE: usize = 10;

/// The only version of the layout that is known.
const VERSION: u16 = 0xA701;
/// Value of the next entry for "none".
const NO_ENTRY: u16 = 0xFFFF;

/// An entry, as the drive holds it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    /// The entry that follows it; `None`: the sequence ends here.
    pub next: Option<u16>,
    /// `id << 4` of its motion command; the count, bits 3-0, is 0.
    pub header: u16,
    /// The parameters of its motion command.
    pub parameters: [u8; PARAMETERS_SIZE],
    /// ASCII, ended by a zero.
    pub name: [u8; NAME_SIZE],
    /// Kept as they come.
    pub reserved: [u8; RESERVED_SIZE],
}

/// Why bytes are not an entry, or a name is invalid.
#[derive(Clone, PartialEq, Eq, Error)]
pub enum EntryError {
    /// The length.
    #[error("an entry of {0} bytes; it has 64: transfer it again")]
    Size(usize),
    /// The version.
    #[error("an entry of version {0:04X}h; only A701h is known: leave it to the vendor's tool")]
    Version(u16),
    /// The name.
    #[error("the name {0:?}; use at most 15 printable ASCII characters")]
    Name(String),
}
fieldbeat_core::debug_as_display!(EntryError);

impl Entry {
    /// An entry that runs `command` and continues with `next`.
    pub fn new(name: &str, command: MotionCommand, next: Option<EntryId>) -> Result<Entry, EntryError> {
        let mut entry = Entry {
            next: next.map(EntryId::wire),
            header: command.header(0),
            parameters: [0; PARAMETERS_SIZE],
            name: Entry::name_bytes(name)?,
            reserved: [0; RESERVED_SIZE],
        };
        entry.parameters[..command.parameters.len()].copy_from_slice(&command.parameters);
        Ok(entry)
    }

    /// The bytes of a name, at most 15 printable ASCII characters.
    pub fn name_bytes(name: &str) -> Result<[u8; NAME_SIZE], EntryError> {
        name::bytes(name, NAME_SIZE - 1).ok_or_else(|| EntryError::Name(name.to_owned()))
    }

    /// The name; `None` if its bytes are anything else than printable ASCII followed by zeros.
    pub fn name(&self) -> Option<&str> {
        name::text(&self.name, NAME_SIZE - 1)
    }

    /// The motion command, without two parameter bytes that no command uses.
    pub fn command(&self) -> MotionCommand {
        let mut command = MotionCommand::new(self.header >> 4);
        command.parameters.copy_from_slice(&self.parameters[..30]);
        command
    }

    /// The entries that it leads to: `next`, and the fields of its command that are entries, with their names.
    pub fn leads_to(&self) -> impl Iterator<Item = (&'static str, i64)> {
        let fields = CommandInfo::of(self.header >> 4).map_or(&[][..], |info| info.fields);
        let entries = fields.iter().filter(|field| field.kind == Kind::EntryId);
        let next = self.next.map(|next| ("next", i64::from(next)));
        next.into_iter().chain(entries.map(|field| (field.name, field.read(&self.parameters))))
    }

    /// The bytes of the transfer.
    pub fn encode(&self) -> [u8; ENTRY_SIZE] {
        let mut bytes = [0; ENTRY_SIZE];
        let mut out = Fill(&mut bytes);
        let words = [VERSION, self.next.unwrap_or(NO_ENTRY), self.header];
        words.iter().for_each(|word| out.put(word.to_le_bytes()));
        out.put(self.parameters);
        out.put(self.name);
        out.put(self.reserved);
        bytes
    }

    /// The entry of these bytes.
    pub fn decode(bytes: &[u8]) -> Result<Entry, EntryError> {
        if bytes.len() != ENTRY_SIZE {
            return Err(EntryError::Size(bytes.len()));
        }
        let mut bytes = Take(bytes);
        match bytes.word() {
            // In the order of the wire.
            VERSION => Ok(Entry {
                next: Some(bytes.word()).filter(|next| *next != NO_ENTRY),
                header: bytes.word(),
                parameters: bytes.bytes(),
                name: bytes.bytes(),
                reserved: bytes.bytes(),
            }),
            other => Err(EntryError::Version(other)),
        }
    }
}

/// The entries by their ids, 1 ... 255.
pub type Table = BTreeMap<EntryId, Entry>;

/// An entry leads to one that does not exist: the drive would end in error 008Ah.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
#[error("{by} of entry {} leads to entry {to}, which does not exist; add it or change the reference", .entry.wire())]
pub struct DeadEnd {
    /// The entry with the link.
    pub entry: EntryId,
    /// `next`, or the name of a field of its command.
    pub by: &'static str,
    /// The missing entry.
    pub to: i64,
}
fieldbeat_core::debug_as_display!(DeadEnd);

/// Every link to a missing entry, those of raw commands included.
pub fn dead_ends(table: &Table) -> Vec<DeadEnd> {
    let leads =
        table.iter().flat_map(|(id, entry)| entry.leads_to().map(|(by, to)| DeadEnd { entry: *id, by, to }));
    leads.filter(|lead| !table.keys().any(|id| i64::from(id.wire()) == lead.to)).collect()
}

#[cfg(test)]
mod tests {

    use super::*;
    use crate::motion::{Position, WaitTime};

    fn id(id: u16) -> EntryId {
        EntryId::new(id).unwrap()
    }

    /// Drive Configuration manual, command table entry; offsets of the branch as in the motion control manual:
    /// condition 6, true 10, false 12.
    #[test]
    fn golden_entry() {
        let command = MotionCommand::if_demand_position_less(Position(100_000), id(2), id(255));
        let entry = Entry::new("low enough?", command, Some(id(9))).unwrap();
        let mut golden = vec![0x01, 0xA7, 9, 0, 0x80, 0x25, 0xA0, 0x86, 0x01, 0x00, 2, 0, 255, 0];
        golden.extend([0; 24]);
        golden.extend(*b"low enough?\0\0\0\0\0");
        golden.extend([0; 10]);
        assert_eq!(entry.encode().to_vec(), golden);
        assert_eq!(Entry::decode(&golden), Ok(entry));
        assert_eq!((entry.command(), entry.name()), (command, Some("low enough?")));
        let last = Entry::new("", MotionCommand::wait_time(WaitTime(10)), None).unwrap();
        assert_eq!(last.encode()[..8], [0x01, 0xA7, 0xFF, 0xFF, 0x00, 0x21, 10, 0]);
    }

    #[test]
    fn a_malformed_entry_is_refused_with_its_value() {
        assert_eq!(Entry::decode(&[0; 63]), Err(EntryError::Size(63)));
        assert_eq!(Entry::decode(&[0x11; 64]), Err(EntryError::Version(0x1111)));
        for name in ["sixteen letters!", "a\tb", "H\u{f6}he", "zero\0"] {
            assert_eq!(Entry::name_bytes(name), Err(EntryError::Name(name.into())));
        }
        assert!(Entry::name_bytes("fifteen letters").is_ok());
        let full = Entry::new("", MotionCommand::no_operation(), None).unwrap();
        assert_eq!(Entry { name: [b'x'; 16], ..full }.name(), None, "no zero ends it");
    }
}
