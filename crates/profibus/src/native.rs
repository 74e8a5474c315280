//! The native process data of a drive: unscaled and complete, for the application.

use super::plan::DATA_MAX;
use fieldbeat_core::bus::native::{self, Image};
use fieldbeat_core::parts;
use fieldbeat_core::time::Time;

/// The most words of process data that a drive is read and written with natively, behind its parameter channel.
pub const NATIVE_WORDS: usize = 16;

/// The application's end: [`Axis::native`](fieldbeat_core::axis::Axis::native) with this type. `inputs` are the newest
/// [`NativeInputs`]; `write` queues a [`NativeOutput`], or returns it if the queue is full.
pub type Native = native::Native<NativeInputs, NativeOutput>;

/// The station's end.
pub(super) type NativePort = native::NativePort<NativeOutput>;

/// The process data of one reply, behind the parameter channel: the status word is the first one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NativeInputs {
    /// When they were taken in.
    pub at: Time,
    /// Native mode ran when the request of this reply was built: outputs written from now on go out.
    pub running: bool,
    /// The number of words that are the drive's.
    pub count: u8,
    /// The words.
    pub words: [u16; NATIVE_WORDS],
}

/// Outputs of the application in native mode, in order; each goes out once, and stays until the next one. Words that
/// the drive does not have are left out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NativeOutput {
    /// Which of the words are written, a bit each. The control word, the first one, is written only with
    /// `NativeOwner::Application`.
    pub mask: u16,
    /// The words.
    pub words: [u16; NATIVE_WORDS],
}

parts! {
    NativeOutput { mask, words }
}

/// The bytes of the words that an application sees, of so many bytes behind the parameter channel.
pub(super) fn seen(bytes: usize) -> usize {
    bytes.min(2 * NATIVE_WORDS) / 2 * 2
}

impl NativeOutput {
    /// Takes the words of a later one.
    pub(super) fn put_over(&mut self, later: &NativeOutput) {
        self.mask |= later.mask;
        for (n, (place, word)) in self.words.iter_mut().zip(later.words).enumerate() {
            if later.mask >> n & 1 != 0 {
                *place = word;
            }
        }
    }

    /// Writes its words over the outputs behind the parameter channel; the first one too if it is `whole`.
    pub(super) fn put(&self, whole: bool, outputs: &mut [u8]) {
        let (places, _) = outputs.as_chunks_mut::<2>();
        for (n, (place, word)) in places.iter_mut().zip(self.words).enumerate() {
            if self.mask >> n & 1 != 0 && (whole || n > 0) {
                *place = word.to_be_bytes();
            }
        }
    }
}

impl From<Image> for NativeInputs {
    fn from(image: Image) -> NativeInputs {
        let (bytes, length) = image.bytes::<{ 2 * NATIVE_WORDS }>();
        let (mut words, count) = ([0; NATIVE_WORDS], length / 2);
        for (word, bytes) in words.iter_mut().zip(bytes.as_chunks().0) {
            *word = u16::from_be_bytes(*bytes);
        }
        NativeInputs { at: image.at(), running: image.flag(), count: count as u8, words }
    }
}

const _: () = assert!(2 * NATIVE_WORDS <= DATA_MAX, "there is a place for each word");
