//! The command table in RAM and in flash, and the transfer of its entries over the real-time-config channel.
//!
//! Knows the 64 bytes of an entry, and nothing of running it.
//!
//! Chosen where the manuals are silent: an existing entry has to be deleted before it is written again, and a
//! missing one cannot be read (D1h both); deleting a missing one is no mistake. An entry exists once its last block
//! has come; another entry in between, or a block out of turn, ends the transfer (D1h), and so do bytes that are
//! not a valid entry.

use super::blocks::{Incoming, Outgoing};
use fieldbeat_linudp::motion::EntryId;
use fieldbeat_linudp::table::{ENTRY_SIZE, Entry, Table};
use fieldbeat_linudp::wire::{ErrorCode, Refusal};

/// The command table in RAM and in flash.
#[derive(Debug, Default)]
pub(super) struct Tables {
    ram: Table,
    rom: Table,
    incoming: Option<Incoming>,
    outgoing: Option<Outgoing>,
}

fn id(entry: u16) -> Result<EntryId, Refusal> {
    EntryId::new(entry).map_err(|_| Refusal::WrongSize)
}

impl Tables {
    /// Begins to write an entry.
    pub(super) fn begin(&mut self, entry: u16, size: u16) -> Result<(), Refusal> {
        self.incoming = None;
        let id = id(entry)?;
        if size % 2 == 1 {
            return Err(Refusal::OddAddress);
        }
        if usize::from(size) != ENTRY_SIZE || self.ram.contains_key(&id) {
            return Err(Refusal::WrongSize);
        }
        self.incoming = Some(Incoming::new(entry, ENTRY_SIZE));
        Ok(())
    }

    /// The next four bytes of it; whether they are the last ones.
    pub(super) fn put(&mut self, entry: u16, block: [u8; 4]) -> Result<bool, Refusal> {
        let incoming = self.incoming.take().filter(|incoming| incoming.id == entry);
        let mut incoming = incoming.ok_or(Refusal::WrongSize)?;
        let Some(bytes) = incoming.put(block) else {
            self.incoming = Some(incoming);
            return Ok(false);
        };
        self.ram.insert(id(entry)?, Entry::decode(bytes).map_err(|_| Refusal::WrongSize)?);
        Ok(true)
    }

    /// Begins to read an entry: its bytes.
    pub(super) fn open(&mut self, entry: u16) -> Result<u16, Refusal> {
        self.outgoing = None;
        let found = self.ram.get(&id(entry)?).ok_or(Refusal::WrongSize)?;
        self.outgoing = Some(Outgoing::new(entry, found.encode().into()));
        Ok(ENTRY_SIZE as u16)
    }

    /// The next four bytes of it, and whether they are the last ones.
    pub(super) fn next(&mut self, entry: u16) -> Result<([u8; 4], bool), Refusal> {
        let outgoing = self.outgoing.as_mut().filter(|outgoing| outgoing.id == entry);
        outgoing.and_then(Outgoing::take).ok_or(Refusal::WrongSize)
    }

    /// Deletes an entry.
    pub(super) fn delete(&mut self, entry: u16) -> Result<(), Refusal> {
        self.ram.remove(&id(entry)?);
        Ok(())
    }

    /// Deletes all of them.
    pub(super) fn delete_all(&mut self) {
        self.ram = Table::new();
        self.incoming = None;
    }

    /// Which of the 32 entries from `32 * group` on exist, one bit each.
    pub(super) fn used(&self, group: u16) -> u32 {
        (0..32).filter(|n| self.get(group * 32 + n).is_some()).fold(0, |bits, n| bits | 1 << n)
    }

    /// An entry that may run.
    pub(super) fn get(&self, entry: u16) -> Option<&Entry> {
        self.ram.get(&EntryId::new(entry).ok()?)
    }

    /// Motion commands 208x, 209x: writes into an entry. A write outside of it, or one that would make it invalid,
    /// is refused as an unknown command (chosen).
    pub(super) fn modify(&mut self, entry: u16, offset: usize, bytes: &[u8]) -> Result<(), ErrorCode> {
        let id = EntryId::new(entry).map_err(|_| ErrorCode::ENTRY_MISSING)?;
        let mut image = self.ram.get(&id).ok_or(ErrorCode::ENTRY_MISSING)?.encode();
        let place = image.get_mut(offset..).and_then(|place| place.get_mut(..bytes.len()));
        place.ok_or(ErrorCode::UNKNOWN_COMMAND)?.copy_from_slice(bytes);
        self.ram.insert(id, Entry::decode(&image).map_err(|_| ErrorCode::UNKNOWN_COMMAND)?);
        Ok(())
    }

    /// Writes RAM into flash.
    pub(super) fn save(&mut self) {
        self.rom.clone_from(&self.ram);
    }

    /// Flash is empty.
    pub(super) fn erase(&mut self) {
        self.rom = Table::new();
    }

    /// The drive restarts: flash is copied to RAM; no transfer is under way any more.
    pub(super) fn load(&mut self) {
        self.ram.clone_from(&self.rom);
        (self.incoming, self.outgoing) = (None, None);
    }
}
