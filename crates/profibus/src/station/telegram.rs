//! Data_Exchange as it is sent next.

use crate::line::Expected;
use crate::wire::sap::Service;
use crate::wire::telegram::MAX;

/// The function code without its count: SRD high.
const SRD_HIGH: u8 = 0x4D;
/// The function code, and its outputs.
const AT_FC: usize = 6;
const AT_DATA: usize = 7;
/// The longest telegram that is copied as one of this length.
const SHORT: usize = 32;

/// The telegram, but for its function code and its check byte.
#[derive(Debug)]
#[repr(C, align(64))] // A usual one is on one cache line.
pub(super) struct Telegram {
    expected: Expected,
    length: u8,
    /// The sum of all that the check byte covers, but for the function code.
    sum: u8,
    bytes: [u8; MAX],
}

impl Telegram {
    /// To the drive at `address` from the master at `own`, with so many bytes of outputs, which are 0, and of inputs.
    pub(super) fn new(address: u8, own: u8, outputs: usize, inputs: usize) -> Option<Telegram> {
        let mut bytes = [0; MAX];
        let head = Service::DataExchange.head(address, own, false, false);
        let length = head.emit_with(&mut bytes, |data| data.bytes(&[0; MAX][..outputs.min(MAX)]))?;
        let expected = Expected::exchange(address, own, u8::try_from(inputs).ok()?);
        Some(Telegram { expected, length: u8::try_from(length).ok()?, sum: address.wrapping_add(own), bytes })
    }

    /// Writes a word of the outputs.
    #[inline]
    pub(super) fn put(&mut self, at: u8, word: u16) {
        let at = AT_DATA + usize::from(at);
        if let Some(place) = self.bytes.get_mut(at..).and_then(<[u8]>::first_chunk_mut) {
            let [[high, low], [old_high, old_low]] =
                [word.to_be_bytes(), std::mem::replace(place, word.to_be_bytes())];
            self.sum =
                self.sum.wrapping_add(high).wrapping_add(low).wrapping_sub(old_high).wrapping_sub(old_low);
        }
    }

    /// The outputs from this byte on.
    pub(super) fn outputs(&self, at: u8) -> &[u8] {
        self.bytes.get(AT_DATA + usize::from(at)..usize::from(self.length) - 2).unwrap_or_default()
    }

    /// Changes the outputs from this byte on.
    pub(super) fn change(&mut self, at: u8, change: impl FnOnce(&mut [u8])) {
        let end = usize::from(self.length) - 2;
        let Some(outputs) = self.bytes.get_mut(AT_DATA + usize::from(at)..end) else { return };
        let sum = |bytes: &[u8]| bytes.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte));
        let before = sum(outputs);
        change(outputs);
        self.sum = self.sum.wrapping_sub(before).wrapping_add(sum(outputs));
    }

    /// Writes it with these count bits; returns its length, and what answers it.
    #[inline]
    pub(super) fn emit(&self, count: u8, out: &mut [u8; MAX]) -> Option<(usize, Expected)> {
        let length = usize::from(self.length);
        match length <= SHORT {
            true => out[..SHORT].copy_from_slice(&self.bytes[..SHORT]),
            false => *out = self.bytes,
        }
        let fc = SRD_HIGH | count;
        out[AT_FC] = fc;
        *out.get_mut(length - 2)? = self.sum.wrapping_add(fc);
        Some((length, self.expected))
    }
}
