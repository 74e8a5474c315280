//! Registers: those of a message, and room to build some.

use super::REGISTERS_MAX;
use crate::parameter::Width;

/// Big-endian registers in wire order. Those of 32-bit access come in pairs, high word first (SI-Ethernet guide).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Registers<'a>(&'a [u8]);

impl<'a> Registers<'a> {
    /// Of these bytes; `None` if their number is odd.
    #[inline]
    pub const fn new(bytes: &'a [u8]) -> Option<Registers<'a>> {
        if bytes.len().is_multiple_of(2) { Some(Registers(bytes)) } else { None }
    }

    /// `count` registers, all 0, at most [`REGISTERS_MAX`].
    pub fn zeros(count: u16) -> Registers<'static> {
        const ZEROS: [u8; RegistersBuffer::BYTES] = [0; RegistersBuffer::BYTES];
        Registers(ZEROS.get(..2 * usize::from(count)).unwrap_or_default())
    }

    /// The number of registers.
    #[inline]
    pub const fn len(self) -> usize {
        self.0.len() / 2
    }

    /// There are none.
    #[inline]
    pub const fn is_empty(self) -> bool {
        self.0.is_empty()
    }

    /// Register `index`.
    #[inline]
    pub fn word(self, index: usize) -> Option<u16> {
        let at = index.checked_mul(2)?;
        self.0.get(at..)?.first_chunk().map(|word| u16::from_be_bytes(*word))
    }

    /// Registers `2 * index` and `2 * index + 1` as one value of 32-bit access.
    #[inline]
    pub fn long(self, index: usize) -> Option<i32> {
        let at = index.checked_mul(4)?;
        self.0.get(at..)?.first_chunk().map(|long| i32::from_be_bytes(*long))
    }

    /// The raw bits of value `index`, if all have this width.
    #[inline]
    pub fn raw(self, width: Width, index: usize) -> Option<u32> {
        match width {
            Width::Word => self.word(index).map(u32::from),
            Width::Long => self.long(index).map(i32::cast_unsigned),
        }
    }

    /// All of them.
    #[inline]
    pub fn words(self) -> impl Iterator<Item = u16> + 'a {
        self.0.as_chunks().0.iter().map(|word| u16::from_be_bytes(*word))
    }

    /// All of them in pairs, as values of 32-bit access; a single last one is left out.
    #[inline]
    pub fn longs(self) -> impl Iterator<Item = i32> + 'a {
        self.0.as_chunks().0.iter().map(|long| i32::from_be_bytes(*long))
    }

    /// The bytes in wire order.
    #[inline]
    pub const fn bytes(self) -> &'a [u8] {
        self.0
    }
}

/// Room for as many registers as a Unidrive accepts or returns at once.
#[derive(Clone, Copy, Debug)]
pub struct RegistersBuffer {
    bytes: [u8; RegistersBuffer::BYTES],
    length: usize,
}

impl RegistersBuffer {
    const BYTES: usize = 2 * REGISTERS_MAX as usize;

    /// Empty.
    pub const fn new() -> RegistersBuffer {
        RegistersBuffer { bytes: [0; RegistersBuffer::BYTES], length: 0 }
    }

    /// Removes its content.
    #[inline]
    pub fn clear(&mut self) {
        self.length = 0;
    }

    /// Appends one register; false, and nothing is changed, if there is no room.
    #[inline]
    pub fn push_word(&mut self, word: u16) -> bool {
        self.push(word.to_be_bytes())
    }

    /// Appends a value of 32-bit access; false, and nothing is changed, if there is no room.
    #[inline]
    pub fn push_long(&mut self, long: i32) -> bool {
        self.push(long.to_be_bytes())
    }

    /// Appends the raw bits of a value of this width; false, and nothing is changed, if there is no room.
    #[inline]
    pub fn push_raw(&mut self, width: Width, raw: u32) -> bool {
        match width {
            Width::Word => self.push_word(raw as u16),
            Width::Long => self.push_long(raw.cast_signed()),
        }
    }

    #[inline]
    fn push<const N: usize>(&mut self, bytes: [u8; N]) -> bool {
        let room = self.bytes.get_mut(self.length..).and_then(|free| free.first_chunk_mut());
        let Some(room) = room else { return false };
        *room = bytes;
        self.length += N;
        true
    }

    /// Appends registers in wire order; false, and nothing is changed, if there is no room.
    pub fn push_all(&mut self, registers: Registers<'_>) -> bool {
        let bytes = registers.bytes();
        let room = self.bytes.get_mut(self.length..).and_then(|free| free.get_mut(..bytes.len()));
        let Some(room) = room else { return false };
        room.copy_from_slice(bytes);
        self.length += bytes.len();
        true
    }

    /// The content.
    #[inline]
    pub fn registers(&self) -> Registers<'_> {
        Registers(self.bytes.get(..self.length).unwrap_or_default())
    }
}

impl Default for RegistersBuffer {
    fn default() -> RegistersBuffer {
        RegistersBuffer::new()
    }
}
