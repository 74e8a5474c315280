//! The cyclic requests of a drive: their blocks as the wire has them, compiled at bring-up. The next request is made of
//! two of them, and the reply to it is known from them.

use std::num::NonZeroU64;

use crate::mapping::{Block, Image, Mapping, Places, Role};
use crate::native::Also;
use crate::parameter::Width;
use crate::profile::Outputs;
use crate::wire::{ADU_MAX, HEADER, Header, Registers, function};
use fieldbeat_core::rt::Regions;

/// A block to write, in one word, the lowest byte first: its address and its numbers of registers and of bytes as in a
/// request; the places of control word and reference behind them, 0 if it does not have it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Write(NonZeroU64);

/// A block to read, in one word, the lowest byte first: its address and its number of registers as in a request; its
/// roles that have an index in an [`Image`]; the place of its value there, [`FRONT`] or [`SORTED`]; and its index among
/// the blocks to read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Read(NonZeroU64);

/// The place of a value: its width, and an offset in a request or an index in an [`Image`].
const WORD: u8 = 0x40;
const LONG: u8 = 0x80;
const AT: u8 = WORD - 1;
/// In place of one: the values of a block are those of an image from its index 0 on, or go where their roles say.
const FRONT: u8 = 0;
const SORTED: u8 = 1;

/// A cyclic request: FC23, or with one of its blocks only FC16 or FC03.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Cyclic {
    pub write: Option<Write>,
    pub read: Option<Read>,
    /// The block to read is out of turn.
    pub confirms: bool,
}

/// All blocks of a mapping.
#[derive(Debug)]
#[repr(C)] // What is used in each exchange comes last.
pub(super) struct Turns {
    mapping: Mapping,
    /// The reads, turn by turn.
    pub reads: Box<[Read]>,
    /// The writes; twice the same if all is in one block.
    pub writes: [Option<Write>; 2],
}

/// Byte `index` of a word.
#[inline]
fn byte(word: NonZeroU64, index: u32) -> u8 {
    (word.get() >> (8 * index)) as u8
}

/// The place of a value of this width.
fn place(width: Width, at: usize) -> u8 {
    let width = if width == Width::Long { LONG } else { WORD };
    width | at as u8 & AT
}

impl Write {
    fn new(block: &Block) -> Option<Write> {
        let [high, low] = block.address.to_be_bytes();
        let registers = u8::try_from(block.registers).ok()?;
        let [control, reference] = [Role::Control, Role::Reference].map(|role| {
            let index = block.roles.iter().position(|other| *other == role);
            index.map_or(0, |index| place(block.width, index * block.width.bytes()))
        });
        let word = [high, low, 0, registers, registers.checked_mul(2)?, control, reference, 0];
        NonZeroU64::new(u64::from_le_bytes(word)).map(Write)
    }

    /// It has the control word.
    #[inline]
    pub(super) fn has_control(self) -> bool {
        byte(self.0, 5) != 0
    }

    /// It has the reference.
    #[inline]
    pub(super) fn has_reference(self) -> bool {
        byte(self.0, 6) != 0
    }

    /// The number of registers.
    #[inline]
    pub(super) fn registers(self) -> u16 {
        byte(self.0, 3).into()
    }

    /// Writes it behind the first `begin` bytes of a request, and returns the length of that.
    #[inline]
    fn emit(self, begin: u8, outputs: Outputs, out: &mut [u8; ADU_MAX]) -> u8 {
        let at = usize::from(begin);
        out[at..at + 4].copy_from_slice(&(self.0.get() as u32).to_le_bytes());
        out[at + 4] = byte(self.0, 4);
        let mut put = |place: u8, count: i32| {
            let at = usize::from(begin + 5 + (place & AT));
            match place {
                LONG.. => out[at..at + 4].copy_from_slice(&count.to_be_bytes()),
                WORD.. => out[at..at + 2].copy_from_slice(&(count as u16).to_be_bytes()),
                _ => {}
            }
        };
        put(byte(self.0, 5), outputs.control.0.into());
        put(byte(self.0, 6), outputs.reference);
        begin + 5 + byte(self.0, 4)
    }
}

impl Read {
    /// Block `index` of these.
    fn new(blocks: &[Block], index: usize) -> Option<Read> {
        let block = blocks.get(index)?;
        let [high, low] = block.address.to_be_bytes();
        let registers = u8::try_from(block.registers).ok()?;
        let values = match (&*block.roles, block.in_order) {
            (_, true) => FRONT,
            ([role], _) => role.index().map_or(SORTED, |at| place(block.width, at)),
            _ => SORTED,
        };
        let [first, last] = block.places.0.to_le_bytes();
        let word = [high, low, 0, registers, first, last, values, u8::try_from(index).ok()?];
        NonZeroU64::new(u64::from_le_bytes(word)).map(Read)
    }

    /// The roles that have an index in an [`Image`].
    #[inline]
    pub(super) fn places(self) -> Places {
        Places((self.0.get() >> 32) as u16)
    }

    /// The number of registers.
    #[inline]
    pub(super) fn registers(self) -> u16 {
        byte(self.0, 3).into()
    }

    /// The bytes of a reply before its values: header, function, number of bytes.
    pub(super) const FRONT: usize = HEADER + 2;

    /// The values of the reply by `function`, if `bytes` are all of it and nothing else.
    #[inline]
    pub(super) fn values(self, header: Header, function: u8, bytes: &[u8]) -> Option<Registers<'_>> {
        let count = 2 * byte(self.0, 3);
        let (front, values) = bytes.split_first_chunk::<{ Self::FRONT }>()?;
        let [high, low] = header.transaction.to_be_bytes();
        // Unit, function and number of bytes are counted, too.
        let expected = u64::from_ne_bytes([high, low, 0, 0, 0, count + 3, header.unit, function]);
        let [header @ .., bytes] = *front;
        let is_all = values.len() == usize::from(count) && bytes == count;
        if is_all && u64::from_ne_bytes(header) == expected { Registers::new(values) } else { None }
    }
}

impl Cyclic {
    /// It writes and reads: FC23.
    #[inline]
    pub(super) fn is_both(&self) -> bool {
        self.write.is_some() && self.read.is_some()
    }

    /// The registers, of both blocks together.
    #[inline]
    pub(super) fn registers(&self) -> u16 {
        self.write.map_or(0, Write::registers) + self.read.map_or(0, Read::registers)
    }

    /// The roles that it writes: the control word, the reference.
    #[inline]
    pub(super) fn writes(&self) -> (bool, bool) {
        self.write.map_or((false, false), |write| (write.has_control(), write.has_reference()))
    }

    /// Writes the request with these values in place, and returns its length.
    #[inline]
    pub(super) fn emit(&self, header: Header, outputs: Outputs, out: &mut [u8; ADU_MAX]) -> u8 {
        let mut length = (HEADER + 1) as u8;
        let mut function = function::WRITE;
        if let Some(read) = self.read {
            let at = usize::from(length);
            out[at..at + 4].copy_from_slice(&(read.0.get() as u32).to_le_bytes());
            length += 4;
            function = if self.write.is_some() { function::READ_WRITE } else { function::READ };
        }
        if let Some(write) = self.write {
            length = write.emit(length, outputs, out);
        }
        let [high, low] = header.transaction.to_be_bytes();
        // The length counts what follows it.
        out[..=HEADER].copy_from_slice(&[high, low, 0, 0, 0, length - 6, header.unit, function]);
        length
    }

    /// Writes another id and other values over those of a request that [is the only one](Turns::is_only), and returns
    /// its length.
    #[inline]
    pub(super) fn refill(transaction: u16, outputs: Outputs, out: &mut [u8; ADU_MAX]) -> u8 {
        const VALUES: usize = HEADER + 10;
        out[..2].copy_from_slice(&transaction.to_be_bytes());
        let values = u64::from(outputs.control.0) << 32 | u64::from(outputs.reference.cast_unsigned());
        out[VALUES..VALUES + 8].copy_from_slice(&values.to_be_bytes());
        VALUES as u8 + 8
    }
}

impl Turns {
    /// Those of this mapping.
    pub(super) fn new(mapping: Mapping) -> Turns {
        let writes = [mapping.writes().first(), mapping.writes().last()];
        let writes = writes.map(|block| block.and_then(Write::new));
        let reads = (0..mapping.turns()).filter_map(|turn| Read::new(mapping.reads(), mapping.read_in(turn)));
        Turns { reads: reads.collect(), writes, mapping }
    }

    /// This request writes and reads all there is, with 32 bits of the control word in front of the reference.
    #[inline]
    pub(super) fn is_only(&self, cyclic: &Cyclic) -> bool {
        let is_pair = |write: Write| (byte(write.0, 5), byte(write.0, 6)) == (LONG, LONG | 4);
        self.reads.len() == 1 && cyclic.read.is_some() && cyclic.write.is_some_and(is_pair)
    }

    /// The block to read in this turn.
    #[inline]
    pub(super) fn read(&self, turn: u16) -> Option<Read> {
        self.reads.get(usize::from(turn)).copied()
    }

    /// The block to read that has `role`.
    pub(super) fn read_with(&self, role: Role) -> Option<Read> {
        self.reads.iter().find(|read| read.places().has(role)).copied()
    }

    /// The values of a block that was read: into the image, and those of additional parameters to the application.
    #[inline(always)] // For each reply; the other place takes in what is not usual.
    pub(super) fn take(&self, read: Read, data: Registers<'_>, image: &mut Image, also: &Also) {
        let (place, at) = (byte(read.0, 6), usize::from(byte(read.0, 6) & AT));
        match place {
            FRONT => image.set_front(data),
            LONG.. => image.set(at, data.long(0).unwrap_or(0)),
            WORD.. => image.set(at, (data.word(0).unwrap_or(0) as i16).into()),
            _ => self.sort(read, data, image, also),
        }
    }

    #[inline(never)]
    fn sort(&self, read: Read, data: Registers<'_>, image: &mut Image, also: &Also) {
        let Some(block) = self.mapping.reads().get(usize::from(byte(read.0, 7))) else { return };
        let mut take = |role: &Role, count: i32| match (role.index(), role) {
            (Some(place), _) => image.set(place, count),
            (None, Role::Also(index)) => also.publish(*index, count),
            (None, _) => {}
        };
        let roles = block.roles.iter();
        match block.width {
            Width::Word => roles.zip(data.words()).for_each(|(role, word)| take(role, (word as i16).into())),
            Width::Long => roles.zip(data.longs()).for_each(|(role, long)| take(role, long)),
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.reads);
        self.mapping.memory(regions);
    }
}
