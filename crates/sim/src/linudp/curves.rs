//! The curves in RAM and in flash, and their transfer over the real-time-config channel.
//!
//! Knows the blocks of a transfer and when a curve is whole, and nothing of running it.
//!
//! Chosen where the manuals are silent: the info block comes before the data, in both directions; a curve exists,
//! or is modified, once its last block has come, and the old one runs until then; another curve in between, or a
//! block out of turn, ends the transfer (D1h). A curve whose info block contradicts the announced sizes, or that is
//! invalid, is refused with its last block (D1h). There is room for 128 KiB.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;

use super::blocks::{Incoming, Outgoing};
use fieldbeat_linudp::curve::{Curve, CurveKind, INFO_SIZE, SETPOINT_SIZE};
use fieldbeat_linudp::wire::{ErrorCode, Refusal};

/// Bytes of the blocks that carry the info block: 18.
const INFO_BLOCKS: usize = INFO_SIZE.next_multiple_of(4);

/// Bytes of all curves together.
const STORAGE: usize = 128 * 1024;

/// Ids of curves (Motion Control SW manual).
const IDS: RangeInclusive<u16> = 1..=100;

/// A curve in its transferred form and in its running form.
#[derive(Clone, Debug)]
struct Stored {
    /// Its info block, padded to whole blocks, and its setpoints.
    image: Arc<[u8]>,
    curve: Arc<Curve>,
}

impl Stored {
    fn of(id: u16, image: &[u8]) -> Option<Stored> {
        let (info, data) = image.split_at_checked(INFO_BLOCKS)?;
        let curve = Curve::decode(info, data).ok().filter(|curve| curve.id == id)?;
        Some(Stored { image: image.into(), curve: Arc::new(curve) })
    }
}

/// A curve under way to the drive.
#[derive(Debug)]
struct Arriving {
    blocks: Incoming,
    modify: bool,
}

/// All curves by their ids.
#[derive(Debug, Default)]
pub(super) struct Curves {
    ram: BTreeMap<u16, Stored>,
    rom: BTreeMap<u16, Stored>,
    incoming: Option<Arriving>,
    outgoing: Option<Outgoing>,
}

impl Curves {
    /// Begins to add or to modify a curve.
    pub(super) fn begin(&mut self, id: u16, info: u16, data: u16, modify: bool) -> Result<(), Refusal> {
        self.incoming = None;
        if !IDS.contains(&id) {
            return Err(Refusal::OutOfRange);
        }
        if info % 2 == 1 || data % 2 == 1 {
            return Err(Refusal::OddAddress);
        }
        let (info, data) = (usize::from(info), usize::from(data));
        if info != INFO_SIZE || data % SETPOINT_SIZE != 0 || data < 2 * SETPOINT_SIZE {
            return Err(Refusal::WrongSize);
        }
        if self.ram.contains_key(&id) != modify {
            return Err(Refusal::CurveDefinition);
        }
        let size = INFO_BLOCKS + data;
        let others = self.ram.iter().filter(|(other, _)| **other != id);
        let others: usize = others.map(|(_, stored)| stored.image.len()).sum();
        if others + size > STORAGE {
            return Err(Refusal::WrongSize);
        }
        self.incoming = Some(Arriving { blocks: Incoming::new(id, size), modify });
        Ok(())
    }

    /// The next four bytes of the info block; whether they are the last ones.
    pub(super) fn put_info(&mut self, id: u16, block: [u8; 4], modify: bool) -> Result<bool, Refusal> {
        let mut arriving = self.arriving(id, modify, false)?;
        arriving.blocks.put(block);
        let last = arriving.blocks.received() == INFO_BLOCKS;
        self.incoming = Some(arriving);
        Ok(last)
    }

    /// The next four bytes of the data; whether they are the last ones.
    pub(super) fn put_data(&mut self, id: u16, block: [u8; 4], modify: bool) -> Result<bool, Refusal> {
        let mut arriving = self.arriving(id, modify, true)?;
        let Some(image) = arriving.blocks.put(block) else {
            self.incoming = Some(arriving);
            return Ok(false);
        };
        self.ram.insert(id, Stored::of(id, image).ok_or(Refusal::WrongSize)?);
        Ok(true)
    }

    /// Takes out the transfer that a block belongs to. Out of turn, it ends the transfer.
    fn arriving(&mut self, id: u16, modify: bool, data: bool) -> Result<Arriving, Refusal> {
        let arriving = self.incoming.take().ok_or(Refusal::WrongSize)?;
        let due = arriving.blocks.id == id
            && arriving.modify == modify
            && (arriving.blocks.received() >= INFO_BLOCKS) == data;
        if due { Ok(arriving) } else { Err(Refusal::WrongSize) }
    }

    /// Begins to read a curve: the bytes of its info block and of its data.
    pub(super) fn open(&mut self, id: u16) -> Result<(u16, u16), Refusal> {
        self.outgoing = None;
        let image = &self.ram.get(&id).ok_or(Refusal::CurveDefinition)?.image;
        self.outgoing = Some(Outgoing::new(id, Arc::clone(image)));
        // As announced when it was added, in 16 bits.
        Ok((INFO_SIZE as u16, (image.len() - INFO_BLOCKS) as u16))
    }

    /// The next four bytes of its info block, and whether they are the last ones.
    pub(super) fn next_info(&mut self, id: u16) -> Result<([u8; 4], bool), Refusal> {
        let outgoing = self.leaving(id).filter(|outgoing| outgoing.sent() < INFO_BLOCKS);
        let outgoing = outgoing.ok_or(Refusal::WrongSize)?;
        let (block, _) = outgoing.take().ok_or(Refusal::WrongSize)?;
        Ok((block, outgoing.sent() == INFO_BLOCKS))
    }

    /// The next four bytes of its data, and whether they are the last ones.
    pub(super) fn next_data(&mut self, id: u16) -> Result<([u8; 4], bool), Refusal> {
        let outgoing = self.leaving(id).filter(|outgoing| outgoing.sent() >= INFO_BLOCKS);
        outgoing.and_then(Outgoing::take).ok_or(Refusal::WrongSize)
    }

    fn leaving(&mut self, id: u16) -> Option<&mut Outgoing> {
        self.outgoing.as_mut().filter(|outgoing| outgoing.id == id)
    }

    /// The time curve of this id, if there is one.
    pub(super) fn time_curve(&self, id: u16) -> Option<Arc<Curve>> {
        let stored = self.ram.get(&id).filter(|stored| stored.curve.kind == CurveKind::Time)?;
        Some(Arc::clone(&stored.curve))
    }

    /// Motion commands 05x: writes into the info block or into the setpoints of a curve. A running one continues
    /// unchanged. A write outside of it, or one that would make it invalid, is refused as an unknown command
    /// (chosen).
    pub(super) fn modify(
        &mut self,
        id: u16,
        info: bool,
        offset: usize,
        bytes: &[u8],
    ) -> Result<(), ErrorCode> {
        let stored = self.ram.get_mut(&id).ok_or(ErrorCode::CURVE_NOT_DEFINED)?;
        let mut image = stored.image.to_vec();
        let (head, data) = image.split_at_mut(INFO_BLOCKS);
        let part = if info { &mut head[..INFO_SIZE] } else { data };
        let place = part.get_mut(offset..).and_then(|place| place.get_mut(..bytes.len()));
        place.ok_or(ErrorCode::UNKNOWN_COMMAND)?.copy_from_slice(bytes);
        *stored = Stored::of(id, &image).ok_or(ErrorCode::UNKNOWN_COMMAND)?;
        Ok(())
    }

    /// Deletes all of them from RAM.
    pub(super) fn delete_all(&mut self) {
        self.ram.clear();
        self.incoming = None;
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
