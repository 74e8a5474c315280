//! The mapping of FMMUs: logical addresses to memory, bit by bit (ET1100 data sheet, section I, FMMU).

use super::access::Span;
use super::*;

/// The only memory that is written bit by bit: the outputs of a digital terminal.
const DIGITAL: Range<usize> = 0x0F00..0x0F04;

impl Chip {
    /// Reads what the FMMUs map into these logical addresses. Whether anything could be read.
    pub(in super::super) fn read_logical(&mut self, at: u32, data: &mut [u8]) -> bool {
        self.each_fmmu(Fmmu::READ, |chip, fmmu, is_first| {
            let mut span = Span::default();
            for piece in pieces(fmmu).filter(|piece| is_first(piece.logical)) {
                let Some(byte) = piece.place(at).and_then(|place| data.get_mut(place)) else { continue };
                if chip.may_read(piece.physical) {
                    let bits = chip.memory[piece.physical] >> piece.bits.1 << piece.bits.0;
                    *byte = *byte & !piece.mask(piece.bits.0) | bits & piece.mask(piece.bits.0);
                    span.add(piece.physical);
                }
            }
            chip.has_read(span)
        })
    }

    /// Writes what the FMMUs map from these logical addresses. Whether anything could be written.
    pub(in super::super) fn write_logical(&mut self, at: u32, data: &[u8]) -> bool {
        self.each_fmmu(Fmmu::WRITE, |chip, fmmu, is_first| {
            let (mut span, mut last) = (Span::default(), None);
            for piece in pieces(fmmu).filter(|piece| is_first(piece.logical)) {
                let Some(byte) = piece.place(at).and_then(|place| data.get(place)) else { continue };
                if chip.may_write(piece.physical) {
                    let bits = byte >> piece.bits.0 << piece.bits.1;
                    let own = &mut chip.memory[piece.physical];
                    // The other bits stay in the outputs of a digital terminal; elsewhere they are undefined.
                    if last.replace(piece.physical) != Some(piece.physical)
                        && !DIGITAL.contains(&piece.physical)
                    {
                        *own = !*own;
                    }
                    *own = *own & !piece.mask(piece.bits.1) | bits & piece.mask(piece.bits.1);
                    span.add(piece.physical);
                }
            }
            chip.has_written(span)
        })
    }

    /// Whether `access` was successful with any of the FMMUs of this direction. It is passed whether a logical byte is
    /// its own: where several map one byte, the first counts and the others do not.
    fn each_fmmu(
        &mut self,
        kind: u8,
        mut access: impl FnMut(&mut Chip, Fmmu, &dyn Fn(u64) -> bool) -> bool,
    ) -> bool {
        let (mut any, mut mapped) = (false, Vec::<Range<u64>>::new());
        for n in 0..self.fmmus.len() {
            let fmmu = self.fmmus[n];
            if fmmu.active && fmmu.kind == kind {
                any |= access(self, fmmu, &|logical| !mapped.iter().any(|range| range.contains(&logical)));
                let begin = u64::from(fmmu.logical);
                mapped.push(begin..begin + u64::from(fmmu.length));
            }
        }
        any
    }
}

/// Bits of one byte that an FMMU maps to bits of one byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Piece {
    logical: u64,
    physical: usize,
    /// The first bit in the logical byte, and in the physical one.
    bits: (u32, u32),
    count: u32,
}

impl Piece {
    /// The offset of its byte in data that begins at a logical address.
    fn place(&self, at: u32) -> Option<usize> {
        usize::try_from(self.logical.checked_sub(at.into())?).ok()
    }

    fn mask(&self, first: u32) -> u8 {
        (((1_u16 << self.count) - 1) << first) as u8
    }
}

/// The mapping of an FMMU: the bits from the first to the last one, in a row on both sides.
fn pieces(fmmu: Fmmu) -> impl Iterator<Item = Piece> {
    let (first, last) = (u32::from(fmmu.bits.0), u32::from(fmmu.bits.1));
    let (physical, physical_bit) = (usize::from(fmmu.physical.0), u32::from(fmmu.physical.1));
    let end = (u32::from(fmmu.length) * 8).saturating_sub(7 - last);
    let mut next = first;
    std::iter::from_fn(move || {
        let left = end.checked_sub(next).filter(|left| *left > 0)?;
        let behind = next - first + physical_bit;
        let bits = (next % 8, behind % 8);
        let count = left.min(8 - bits.0).min(8 - bits.1);
        let piece = Piece {
            logical: u64::from(fmmu.logical) + u64::from(next / 8),
            physical: physical + (behind / 8) as usize,
            bits,
            count,
        };
        next += count;
        Some(piece)
    })
}
