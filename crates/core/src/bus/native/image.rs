//! The newest inputs of a drive as the words of a cell: as its station took them in. Who reads them decodes them.

use crate::axis::cell::{Packed, Places, Writer};
use crate::packed::{Bytes, Part};
use crate::time::Time;

/// Bytes of a word.
const WORD: usize = size_of::<u64>();
/// Words in front of those of the inputs: the instant; flag, length and what the wire adds.
const FRONT: usize = 2;
/// The most bytes of inputs of a drive.
pub const MOST_INPUTS: usize = 64;
/// Words of the image of a drive.
pub const DRIVE: usize = words(MOST_INPUTS);

/// The place of the length among the flags; what the wire adds is below, the flag is the highest bit.
const LENGTH: u32 = 48;

/// The inputs of a drive with their instant, a flag and some bits of its wire, in [so many](words) words.
#[doc(hidden)]
#[derive(Clone, Copy, Debug)]
pub struct Image<const N: usize = DRIVE>([u64; N]);

/// The words of an image for so many bytes of inputs.
pub const fn words(most: usize) -> usize {
    FRONT + most.div_ceil(WORD)
}

impl<const N: usize> Image<N> {
    /// Of the time 0, without inputs.
    pub const EMPTY: Image<N> = Image([0; N]);
    /// The most bytes of inputs.
    const ROOM: usize = WORD * (N - FRONT);

    /// When the inputs were taken in.
    pub fn at(&self) -> Time {
        Time(self.0[0])
    }

    /// The flag: native mode ran when what they answer was built.
    pub fn flag(&self) -> bool {
        self.0[1] >> 63 != 0
    }

    /// The count that the wire has added.
    pub fn added(&self) -> u64 {
        self.0[1] & ((1 << LENGTH) - 1)
    }

    /// The inputs as words.
    pub fn words(&self) -> &[u64] {
        &self.0[FRONT..]
    }

    /// The inputs, as many as there is room for, and their number; the bytes behind them are 0.
    pub fn bytes<const BYTES: usize>(&self) -> ([u8; BYTES], usize) {
        let (Bytes(mut bytes), length) =
            (Bytes::take(self.words()), length(self.0[1]).min(BYTES).min(Self::ROOM));
        bytes[length..].fill(0);
        (bytes, length)
    }

    /// Publishes these inputs, the first ones if there are more than it has room for. `added`: 48 bits at most.
    /// Words behind them keep their values, and nobody reads them.
    #[inline(always)] // Where the number of inputs is known, it is no loop.
    pub fn write(writer: &mut Writer<Self>, at: Time, flag: bool, added: u64, inputs: &[u8]) {
        let inputs = inputs.get(..Self::ROOM).unwrap_or(inputs);
        writer.write_with(|places| {
            begin(places, at, flag, added, inputs.len());
            let Some(last) = inputs.last_chunk() else { return places.push(short_word(inputs)) };
            let (words, rest) = inputs.as_chunks();
            words.iter().for_each(|word| places.push(u64::from_le_bytes(*word)));
            if !rest.is_empty() {
                // A load that overlaps the word before it: a loop over bytes costs several times as much.
                places.push(u64::from_le_bytes(*last) >> (8 * (WORD - rest.len())));
            }
        });
    }

    /// The same of whole words.
    #[inline]
    pub fn write_words(writer: &mut Writer<Self>, at: Time, flag: bool, added: u64, words: &[u64]) {
        writer.write_with(|places| {
            begin(places, at, flag, added, WORD * words.len());
            words.iter().for_each(|word| places.push(*word));
        });
    }
}

#[inline]
fn begin(places: &mut Places<'_>, at: Time, flag: bool, added: u64, length: usize) {
    places.push(at.0);
    places.push(u64::from(flag) << 63 | (length as u64) << LENGTH | added);
}

/// The length among the flags.
#[inline]
pub fn length(flags: u64) -> usize {
    (flags << 1 >> 1 >> LENGTH) as usize
}

/// Fewer bytes than a word has; the missing ones are 0. Of four and more by two loads that overlap.
#[inline]
fn short_word(bytes: &[u8]) -> u64 {
    if let (Some(first), Some(last)) = (bytes.first_chunk::<4>(), bytes.last_chunk::<4>()) {
        let ahead = 8 * (bytes.len() - 4);
        return u64::from(u32::from_le_bytes(*first)) | u64::from(u32::from_le_bytes(*last)) << ahead;
    }
    bytes.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte))
}

impl<const N: usize> Packed for Image<N> {
    type Words = [u64; N];

    fn pack(&self) -> [u64; N] {
        self.0
    }

    fn unpack(words: &[u64; N]) -> Image<N> {
        Image(*words)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::cell;

    #[test]
    fn inputs_of_each_length_come_back_whole_behind_longer_ones() {
        let (mut writer, reader) = cell::cell(Image::<4>::EMPTY);
        let bytes: [u8; 20] = std::array::from_fn(|n| 0xF1 ^ n as u8);
        let most = (1 << LENGTH) - 1;
        for length in 0..=bytes.len() {
            Image::write(&mut writer, Time(1), true, most, &[0xFF; 16]);
            let (at, flag, added) = (Time(u64::MAX), length % 2 != 0, most - 3);
            Image::write(&mut writer, at, flag, added, &bytes[..length]);
            let image = reader.read();
            assert_eq!((image.at(), image.flag(), image.added()), (at, flag, added));
            let (read, of) = image.bytes::<16>();
            assert_eq!(&read[..of], &bytes[..length.min(16)]);
            assert!(read[of..].iter().all(|byte| *byte == 0), "what is behind them was another's");
            assert_eq!(image.bytes::<3>().1, length.min(3));
        }
        Image::write_words(&mut writer, Time(2), false, 5, &[7, 8]);
        let image = reader.read();
        assert_eq!((image.words(), image.added(), image.bytes::<16>().1), (&[7, 8][..], 5, 16));
    }
}
