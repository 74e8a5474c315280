//! Curves and command table entries in RAM and in flash, and their transfer over the real-time-config channel.
//!
//! Knows when an object is whole, and nothing of running it.
//!
//! Chosen where the manuals are silent: the info block of a curve comes before its data, in both directions; an object
//! exists, or is modified, once its last block has come, and the old one runs until then; another object in between, or
//! a block out of turn, ends the transfer (D1h). A curve whose info block contradicts the announced sizes, and any
//! object that is invalid, is refused with its last block (D1h). There is room for 128 KiB of curves. An existing entry
//! has to be deleted before it is written again, and a missing one cannot be read (D1h both).

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use super::codec::channel::Refusal;
use super::codec::errors;
use super::codec::stored::{Curve, ENTRY_SIZE, Entry, INFO_SIZE, SETPOINT_SIZE};

/// Bytes of the blocks that carry the info block of a curve: 18.
pub(super) const INFO_BLOCKS: usize = INFO_SIZE.next_multiple_of(4);
/// Bytes of all curves together.
const STORAGE: usize = 128 * 1024;

/// Images of objects by their ids.
type Images = BTreeMap<u16, Arc<[u8]>>;

/// Objects of one kind.
#[derive(Debug)]
pub(super) struct Store {
    ram: Images,
    rom: Images,
    /// Bytes in front of the data that are transferred by commands of their own.
    head: usize,
    is_valid: fn(u16, &[u8]) -> bool,
    incoming: Option<Transfer>,
    outgoing: Option<Transfer>,
}

/// An object under way.
#[derive(Debug)]
struct Transfer {
    id: u16,
    /// Of an object that exists already.
    modify: bool,
    bytes: Box<[u8]>,
    at: usize,
}

impl Transfer {
    fn new(id: u16, modify: bool, bytes: Box<[u8]>) -> Transfer {
        Transfer { id, modify, bytes, at: 0 }
    }

    /// The next block, of the head or of the data, and whether it is the last one there.
    fn next(
        &mut self,
        id: u16,
        modify: bool,
        data: bool,
        head: usize,
    ) -> Result<(&mut [u8; 4], bool), Refusal> {
        let is_due = (self.id, self.modify, self.at >= head) == (id, modify, data);
        let rest = if is_due { &mut self.bytes[self.at..] } else { &mut [] };
        let size = rest.len();
        let block = rest.first_chunk_mut().ok_or(Refusal::WrongSize)?;
        self.at += 4;
        Ok((block, self.at == head || size == 4))
    }
}

impl Store {
    fn new(head: usize, is_valid: fn(u16, &[u8]) -> bool) -> Store {
        Store { ram: Images::new(), rom: Images::new(), head, is_valid, incoming: None, outgoing: None }
    }

    pub(super) fn curves() -> Store {
        Store::new(INFO_BLOCKS, |id, image| curve(image).is_some_and(|curve| curve.id == id))
    }

    pub(super) fn table() -> Store {
        Store::new(0, |_, image| entry(image).is_some())
    }

    /// Begins to add or to modify a curve with these sizes of info block and data.
    pub(super) fn begin_curve(&mut self, id: u16, info: u16, data: u16, modify: bool) -> Result<(), Refusal> {
        self.incoming = None;
        let (info, data) = (usize::from(info), usize::from(data));
        let others = self.ram.iter().filter(|(other, _)| **other != id);
        let size = INFO_BLOCKS + data;
        let total = size + others.map(|(_, image)| image.len()).sum::<usize>();
        if !(1..=100).contains(&id) {
            return Err(Refusal::OutOfRange);
        } else if info % 2 == 1 || data % 2 == 1 {
            return Err(Refusal::OddAddress);
        } else if info != INFO_SIZE || data % SETPOINT_SIZE != 0 || data < 2 * SETPOINT_SIZE {
            return Err(Refusal::WrongSize);
        } else if self.ram.contains_key(&id) != modify {
            return Err(Refusal::CurveDefinition);
        } else if total > STORAGE {
            return Err(Refusal::WrongSize);
        }
        self.incoming = Some(Transfer::new(id, modify, vec![0; size].into()));
        Ok(())
    }

    /// Begins to write an entry of so many bytes.
    pub(super) fn begin_entry(&mut self, id: u16, size: u16) -> Result<(), Refusal> {
        self.incoming = None;
        if is_entry(id) && size % 2 == 1 {
            return Err(Refusal::OddAddress);
        } else if !is_entry(id) || usize::from(size) != ENTRY_SIZE || self.ram.contains_key(&id) {
            return Err(Refusal::WrongSize);
        }
        self.incoming = Some(Transfer::new(id, false, [0; ENTRY_SIZE].into()));
        Ok(())
    }

    /// Takes the next block from the master; whether it is the last one.
    pub(super) fn put(&mut self, id: u16, modify: bool, data: bool, block: [u8; 4]) -> Result<bool, Refusal> {
        let mut transfer = self.incoming.take().ok_or(Refusal::WrongSize)?;
        let (place, is_last) = transfer.next(id, modify, data, self.head)?;
        *place = block;
        if transfer.at < transfer.bytes.len() {
            self.incoming = Some(transfer);
        } else if (self.is_valid)(id, &transfer.bytes) {
            self.ram.insert(id, transfer.bytes.into());
        } else {
            return Err(Refusal::WrongSize);
        }
        Ok(is_last)
    }

    /// Begins to read an object: its size without the head; `None`: it does not exist.
    pub(super) fn open(&mut self, id: u16) -> Option<u16> {
        let image = self.ram.get(&id).map(|image| Box::from(&**image));
        self.outgoing = image.map(|image| Transfer::new(id, false, image));
        // As announced when it was written, in 16 bits.
        self.outgoing.as_ref().map(|transfer| (transfer.bytes.len() - self.head) as u16)
    }

    /// The next block for the master, and whether it is the last one.
    pub(super) fn take(&mut self, id: u16, data: bool) -> Result<([u8; 4], bool), Refusal> {
        let mut transfer = self.outgoing.take().ok_or(Refusal::WrongSize)?;
        let block = transfer.next(id, false, data, self.head).map(|(block, is_last)| (*block, is_last));
        self.outgoing = Some(transfer);
        block
    }

    pub(super) fn delete_entry(&mut self, id: u16) -> Result<(), Refusal> {
        self.ram.remove(&id);
        if is_entry(id) { Ok(()) } else { Err(Refusal::WrongSize) }
    }

    /// Deletes all of them from RAM.
    pub(super) fn delete_all(&mut self) {
        self.ram.clear();
        self.incoming = None;
    }

    /// Which of the 32 entries from `32 * group` on exist, one bit each.
    pub(super) fn used(&self, group: u16) -> u32 {
        (0..32).filter(|n| self.ram.contains_key(&(group * 32 + n))).fold(0, |bits, n| bits | 1 << n)
    }

    /// The time curve of this id.
    pub(super) fn time_curve(&self, id: u16) -> Result<Curve, u16> {
        let curve = self.ram.get(&id).and_then(|image| curve(image));
        curve.filter(|curve| curve.is_time).ok_or(errors::CURVE_NOT_DEFINED)
    }

    /// The entry of this id.
    pub(super) fn entry(&self, id: u16) -> Result<Entry, u16> {
        self.ram.get(&id).and_then(|image| entry(image)).ok_or(errors::ENTRY_MISSING)
    }

    /// Motion commands 05x, 208x and 209x: writes into this part of an object; `missing` is the error if there is none.
    /// A running curve continues unchanged. A write outside of it, or one that would make it invalid, is refused as
    /// an unknown command (chosen).
    pub(super) fn modify(
        &mut self,
        id: u16,
        part: Range<usize>,
        offset: usize,
        bytes: &[u8],
        missing: u16,
    ) -> Result<(), u16> {
        let stored = self.ram.get_mut(&id).ok_or(missing)?;
        let mut image = Box::<[u8]>::from(&**stored);
        let part = &mut image[part.start..part.end.min(stored.len())];
        let place = part.get_mut(offset..).and_then(|place| place.get_mut(..bytes.len()));
        place.ok_or(errors::UNKNOWN_COMMAND)?.copy_from_slice(bytes);
        if !(self.is_valid)(id, &image) {
            return Err(errors::UNKNOWN_COMMAND);
        }
        *stored = image.into();
        Ok(())
    }

    /// Writes RAM into flash.
    pub(super) fn save(&mut self) {
        self.rom.clone_from(&self.ram);
    }

    /// Flash is empty.
    pub(super) fn erase(&mut self) {
        self.rom.clear();
    }

    /// The drive restarts: flash is copied to RAM; no transfer is under way any more.
    pub(super) fn load(&mut self) {
        self.ram.clone_from(&self.rom);
        (self.incoming, self.outgoing) = (None, None);
    }
}

fn curve(image: &[u8]) -> Option<Curve> {
    let (info, data) = image.split_at_checked(INFO_BLOCKS)?;
    Curve::parse(info, data)
}

fn entry(image: &[u8]) -> Option<Entry> {
    Entry::parse(image.try_into().ok()?)
}

fn is_entry(id: u16) -> bool {
    (1..=255).contains(&id)
}
