//! The native process data of a drive: unscaled and complete, for the application.

use rtrb::Producer;

use super::plan::DATA_MAX;
use fieldbeat_core::axis::cell::{self, Packed, Reader, Words, Writer};
use fieldbeat_core::bus::native::NativeBytes;
use fieldbeat_core::inputs::{Inlet, InputLog};
use fieldbeat_core::parts;
use fieldbeat_core::rt::{self, Regions};
use fieldbeat_core::time::Time;

/// How many outputs the application may queue.
const OUTPUTS: usize = 16;
/// The most words of process data that a drive is read and written with natively, behind its parameter channel.
pub const NATIVE_WORDS: usize = 16;

/// The application's end: [`Axis::native`](fieldbeat_core::axis::Axis::native) with this type.
#[derive(Debug)]
pub struct Native {
    inputs: Reader<NativeInputs>,
    outputs: Producer<NativeOutput>,
}

/// The process data of one reply, behind the parameter channel: the status word is the first one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NativeInputs {
    /// When they were taken in.
    pub at: Time,
    /// Native mode ran when the request of this reply was built: outputs written from now on go out.
    pub running: bool,
    /// So many of the words are the drive's.
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

/// The station's end.
#[derive(Debug)]
pub(super) struct NativePort {
    inputs: Writer<NativeInputs>,
    outputs: Inlet<NativeOutput>,
    regions: Regions,
}

/// Both ends.
pub(super) fn native() -> (Native, NativePort) {
    let (writer, reader) = cell::cell(NativeInputs::default());
    let mut regions = Regions::new();
    let (producer, consumer) = rt::ring(OUTPUTS, &mut regions);
    let native = Native { inputs: reader, outputs: producer };
    (native, NativePort { inputs: writer, outputs: Inlet::new(consumer), regions })
}

impl Native {
    /// The newest inputs.
    pub fn inputs(&self) -> NativeInputs {
        self.inputs.read()
    }

    /// Queues outputs for the axis in native mode; returns them if the queue is full. Outputs written before the mode
    /// runs ([`NativeInputs::running`]) are dropped when the mode begins.
    pub fn write(&mut self, output: NativeOutput) -> Result<(), NativeOutput> {
        self.outputs.push(output).map_err(|rtrb::PushError::Full(output)| output)
    }
}

parts! {
    NativeOutput { mask, words }
}

impl NativePort {
    /// The same with this log.
    pub(super) fn logged(mut self, log: &InputLog) -> NativePort {
        self.outputs = self.outputs.logged(log);
        self
    }

    /// Adds what both directions touch, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.inputs.memory(regions);
        regions.extend(&self.regions);
    }

    /// Publishes the inputs behind the parameter channel.
    #[inline]
    pub(super) fn publish(&mut self, at: Time, running: bool, inputs: &[u8]) {
        let inputs = inputs.get(..2 * NATIVE_WORDS).unwrap_or(inputs);
        self.inputs.write_with(|places| {
            places.push(at.0);
            let count = inputs.len() as u64 / 2;
            places.push(u64::from(running) << 63 | count);
            let (fours, rest) = inputs.as_chunks::<8>();
            fours.iter().for_each(|four| places.push(u64::from_le_bytes(*four)));
            if !rest.is_empty() {
                places.push(rest.iter().rev().fold(0, |packed, byte| packed << 8 | u64::from(*byte)));
            }
        });
    }

    /// Appends the newest inputs behind the parameter channel, if they were taken in after `since`. Returns when they
    /// were.
    pub(super) fn inputs(&self, since: Time, out: &mut NativeBytes) -> Option<Time> {
        let mut words = self.inputs.words();
        let at = words.next().map(Time).filter(|at| *at > since)?;
        let count = words.next().unwrap_or(0) as u8;
        out.put_words(words, 2 * usize::from(count));
        Some(at)
    }

    /// The next output, which stays until it is [taken](Self::pop).
    pub(super) fn peek(&mut self) -> Option<NativeOutput> {
        self.outputs.peek().copied()
    }

    /// The next output has left.
    pub(super) fn pop(&mut self) {
        let _ = self.outputs.pop();
    }

    /// Drops the outputs of a native mode that has ended; not those that the application writes meanwhile, which would
    /// have no end.
    pub(super) fn flush(&mut self) {
        for _ in 0..self.outputs.slots().min(OUTPUTS) {
            let _ = self.outputs.pop();
        }
    }
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

impl Packed for NativeInputs {
    type Words = [u64; 2 + NATIVE_WORDS / 4];

    #[inline]
    fn pack(&self) -> Self::Words {
        let mut words = Self::Words::ZERO;
        words[0] = self.at.0;
        words[1] = u64::from(self.running) << 63 | u64::from(self.count);
        for (place, four) in words[2..].iter_mut().zip(self.words.chunks(4)) {
            *place = four.iter().rev().fold(0, |packed, word| packed << 16 | u64::from(word.swap_bytes()));
        }
        words
    }

    fn unpack(words: &Self::Words) -> NativeInputs {
        let [at, flags, fours @ ..] = *words;
        // As on the wire: the high byte comes first.
        let word = |n: usize| ((fours[n / 4] >> (16 * (n % 4))) as u16).swap_bytes();
        let count = (flags as u8).min(NATIVE_WORDS as u8);
        NativeInputs { at: Time(at), running: flags >> 63 != 0, count, words: std::array::from_fn(word) }
    }
}

const _: () = assert!(2 * NATIVE_WORDS <= DATA_MAX, "there is a place for each word");
