//! The native process data of a drive: for the application ([`Native`]), and for a recording ([`NativeBytes`]), with
//! what is known of their layout.

mod ends;
mod image;

use std::fmt;
use std::sync::Arc;

pub use self::ends::{Native, NativePort, OUTPUTS, native};
pub use self::image::{DRIVE, Image, MOST_INPUTS, words};

use crate::time::Time;

/// Bytes of the inputs and outputs of one exchange, one after the other.
#[derive(Clone, Debug)]
pub struct NativeBytes {
    bytes: [u8; NativeBytes::MOST + NativeBytes::BEHIND],
    /// Bytes of the inputs, and of both.
    inputs: usize,
    length: usize,
}

/// When outputs are of interest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WantedOutputs {
    /// Not at all: none were sent, or they are known.
    Never,
    /// If there are new inputs.
    WithInputs,
    /// With new inputs or without.
    Always,
}

/// The newest native inputs of a drive.
pub trait Inputs {
    /// Appends them as they were received, if they were taken in after `since`. Returns when they were.
    fn put(&self, since: Time, out: &mut NativeBytes) -> Option<Time>;
}

impl WantedOutputs {
    /// They are, with inputs that were taken in then, if there are new ones.
    #[inline]
    pub fn is_now(self, received_at: Option<Time>) -> bool {
        match self {
            WantedOutputs::Never => false,
            WantedOutputs::WithInputs => received_at.is_some(),
            WantedOutputs::Always => true,
        }
    }
}

impl NativeBytes {
    /// The most bytes of both directions together.
    pub const MOST: usize = 1024;
    /// Room behind them, so that words and parts are copied whole.
    const BEHIND: usize = 128;

    /// Removes all of them.
    #[inline]
    pub fn clear(&mut self) {
        (self.inputs, self.length) = (0, 0);
    }

    /// How many there are of the inputs.
    #[inline]
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// How many there are.
    #[inline]
    pub fn length(&self) -> usize {
        self.length
    }

    /// The part that begins there; `None`: there is none. What follows the end of the last one means nothing.
    #[inline]
    pub fn part<const SIZE: usize>(&self, begin: usize) -> Option<&[u8; SIZE]> {
        self.bytes.get(begin..)?.first_chunk()
    }

    /// Appends bytes, if there is room for all of them.
    #[inline]
    pub fn put(&mut self, bytes: &[u8]) {
        let room = self.bytes[..Self::MOST].get_mut(self.length..);
        if let Some(room) = room.and_then(|room| room.get_mut(..bytes.len())) {
            room.copy_from_slice(bytes);
            self.length += bytes.len();
        }
    }

    /// Appends `length` bytes that `words` hold, 16 at most, the lowest byte first. All words are copied, however many
    /// of their bytes count: the compiler knows their number, and makes it no loop.
    #[inline]
    pub fn put_words(&mut self, words: impl Iterator<Item = u64>, length: usize) {
        let room = self.bytes.get_mut(self.length..).and_then(<[u8]>::first_chunk_mut::<{ Self::BEHIND }>);
        if let Some(room) = room {
            let (places, _) = room.as_chunks_mut();
            places.iter_mut().zip(words).for_each(|(place, word)| *place = word.to_le_bytes());
            self.length = (self.length + length.min(Self::BEHIND)).min(Self::MOST);
        }
    }

    /// Takes the newest inputs, if these were taken in after `since`. Returns when they were.
    #[inline]
    pub fn take(&mut self, inputs: &dyn Inputs, since: Time) -> Option<Time> {
        let received_at = inputs.put(since, self);
        self.inputs = self.length;
        received_at
    }
}

impl Default for NativeBytes {
    /// None.
    fn default() -> NativeBytes {
        NativeBytes { bytes: [0; NativeBytes::MOST + NativeBytes::BEHIND], inputs: 0, length: 0 }
    }
}

/// The description of the native process data of a drive.
#[doc(hidden)]
#[derive(Clone, Debug, Default)]
pub struct NativeLayout {
    /// The values in the inputs.
    pub inputs: Vec<NativeField>,
    /// The values in the outputs.
    pub outputs: Vec<NativeField>,
    /// The most bytes of both directions together.
    pub most: usize,
}

/// A value in the native process data.
#[doc(hidden)]
#[derive(Clone)]
pub struct NativeField {
    /// The name in the protocol.
    pub name: String,
    value: Arc<Value>,
}

type Value = dyn Fn(&[u8]) -> Option<i64> + Send + Sync;

impl fmt::Debug for NativeField {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("NativeField").field("name", &self.name).finish_non_exhaustive()
    }
}

impl NativeField {
    /// A value of this name, as `value` takes it out of the bytes.
    pub fn new(
        name: impl Into<String>,
        value: impl Fn(&[u8]) -> Option<i64> + Send + Sync + 'static,
    ) -> NativeField {
        NativeField { name: name.into(), value: Arc::new(value) }
    }

    /// The value in the bytes of its direction; `None`: these do not have it.
    pub fn value(&self, bytes: &[u8]) -> Option<i64> {
        (self.value)(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_and_bytes_stand_one_after_the_other_and_no_room_is_exceeded() {
        let mut all = NativeBytes::default();
        all.put(&[1, 2, 3]);
        all.put_words([0x0B0A_0908_0706_0504, 0xFFFF_FFFF_FFFF_0D0C, 1].into_iter(), 10);
        all.put(&[14]);
        let bytes: &[u8; 14] = all.part(0).unwrap();
        assert_eq!(bytes, &*(1..=14).collect::<Vec<u8>>());
        all.put(&[0; NativeBytes::MOST]);
        assert_eq!(all.length(), 14, "all of them, or none");
        all.put(&[7; NativeBytes::MOST - 14 - 16]);
        all.put_words([u64::MAX; 16].into_iter(), 128);
        assert_eq!(all.length(), NativeBytes::MOST);
        all.put(&[1]);
        all.put_words([1; 16].into_iter(), 128);
        assert_eq!(all.length(), NativeBytes::MOST);
        assert_eq!(all.part(NativeBytes::MOST - 17), Some(&[7, 255]), "what is there stays");
        assert!(all.part::<44>(NativeBytes::MOST - 1).is_some(), "a part is whole");
        assert_eq!(all.part::<1>(2 * NativeBytes::MOST), None);
        all.clear();
        assert_eq!((all.inputs(), all.length()), (0, 0));
    }

    /// Inputs of the first instant.
    struct Two;

    impl Inputs for Two {
        fn put(&self, since: Time, out: &mut NativeBytes) -> Option<Time> {
            let at = Some(Time(1)).filter(|at| *at > since)?;
            out.put(&[1, 2]);
            Some(at)
        }
    }

    #[test]
    fn outputs_come_behind_the_inputs_where_they_are_wanted() {
        let mut all = NativeBytes::default();
        for (wanted, since, expected) in [
            (WantedOutputs::Never, Time(0), (2, vec![1, 2])),
            (WantedOutputs::WithInputs, Time(1), (0, vec![])),
            (WantedOutputs::WithInputs, Time(0), (2, vec![1, 2, 3, 4, 5])),
            (WantedOutputs::Always, Time(1), (0, vec![3, 4, 5])),
        ] {
            all.clear();
            let received_at = all.take(&Two, since);
            assert_eq!(received_at.is_some(), since < Time(1));
            if wanted.is_now(received_at) {
                all.put(&[3, 4, 5]);
            }
            let bytes = all.part::<8>(0).unwrap()[..all.length()].to_vec();
            assert_eq!((all.inputs(), bytes), expected, "{wanted:?}");
        }
    }
}
