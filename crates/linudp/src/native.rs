//! The native process data of a LinUDP drive: unscaled and complete, for the application.

use rtrb::Producer;

use super::motion::MotionCommand;
use super::wire::{ControlWord, RESPONSE_MAX, Response, RtcBlock};
use fieldbeat_core::axis::cell::{self, Packed, Reader, Writer};
use fieldbeat_core::bus::native::NativeBytes;
use fieldbeat_core::inputs::{Inlet, InputLog};
use fieldbeat_core::packed::{Part, put_bytes, take_bytes};
use fieldbeat_core::rt::{self, Regions};
use fieldbeat_core::time::Time;

/// How many outputs the application may queue.
const OUTPUTS: usize = 16;

/// The application's end: [`Axis::native`](fieldbeat_core::axis::Axis::native) with this type.
#[derive(Debug)]
pub struct Native {
    inputs: Reader<Telegram>,
    outputs: Producer<NativeOutput>,
}

/// Everything that the drive's last accepted reply carried.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NativeInputs {
    /// When it was taken in.
    pub at: Time,
    /// Native mode ran when the request of this reply was built: outputs written from now on go out.
    pub running: bool,
    /// The telegram. Blocks that were not requested are `None`; with [`ReplyTag::Definition`](super::plan::ReplyTag)
    /// error code, warn word and monitoring channels come in turn.
    pub response: Response,
}

/// An output of the application in native mode: at most one per exchange, in order. Each one goes out: if an
/// exchange is passed over or the system refuses to send it, the output goes with the next one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NativeOutput {
    /// The control word, from here on; used only with `NativeOwner::Application`.
    pub control: Option<ControlWord>,
    /// A motion command. It is sent with the next count and repeated until its echo comes, with another count if
    /// the echo does not come; after 4 counts native mode fails. The next output with a motion waits until then,
    /// and so do later ones. Outside of operation a drive echoes nothing: there the next motion replaces it. The
    /// command that resets the firmware (00Fx) fails native mode: with these counts the drive would restart again
    /// and again.
    pub motion: Option<MotionCommand>,
    /// A real-time-config block, count included, sent in one exchange only.
    pub config: Option<RtcBlock>,
}

/// The station's end.
#[derive(Debug)]
pub(super) struct NativePort {
    inputs: Writer<Telegram>,
    outputs: Inlet<NativeOutput>,
    /// Native mode runs.
    running: bool,
    /// The memory of the queue.
    regions: Regions,
}

/// Both ends.
pub(super) fn native() -> (Native, NativePort) {
    let (writer, reader) = cell::cell(Telegram { at: Time(0), running: false, length: 0, bytes: [0; ROOM] });
    let mut regions = Regions::new();
    let (producer, consumer) = rt::ring(OUTPUTS, &mut regions);
    let port = NativePort { inputs: writer, outputs: Inlet::new(consumer), running: false, regions };
    (Native { inputs: reader, outputs: producer }, port)
}

impl Native {
    /// The newest inputs.
    pub fn inputs(&self) -> NativeInputs {
        let Telegram { at, running, length, bytes } = self.inputs.read();
        // Only accepted telegrams are published, so this fails before the first reply only.
        let response = Response::parse(&bytes[..length.min(ROOM)]).unwrap_or_default();
        NativeInputs { at, running, response }
    }

    /// Queues an output for the axis in native mode; returns it if the queue is full. An output written before the
    /// mode runs ([`NativeInputs::running`]) is dropped when the mode begins.
    pub fn write(&mut self, output: NativeOutput) -> Result<(), NativeOutput> {
        self.outputs.push(output).map_err(|rtrb::PushError::Full(output)| output)
    }
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

    /// Sets whether native mode runs, for everything published from here on.
    pub(super) fn runs(&mut self, running: bool) {
        self.running = running;
    }

    #[inline]
    pub(super) fn publish(&mut self, at: Time, telegram: &[u8]) {
        self.inputs.write_with(|places| pack(at, self.running, telegram, |word| places.push(word)));
    }

    /// Appends the newest telegram, if it was taken in after `since`. Returns when it was.
    pub(super) fn inputs(&self, since: Time, out: &mut NativeBytes) -> Option<Time> {
        let mut words = self.inputs.words();
        let at = words.next().map(Time).filter(|at| *at > since)?;
        let length = ((words.next().unwrap_or(0) << 1 >> 1) as usize).min(ROOM);
        out.put_words(words, length);
        // Its last bytes are the word behind its whole ones.
        out.end_with(self.inputs.word(FRONT + length / WORD));
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

    /// Drops the outputs of a native mode that has ended; not those that the application writes meanwhile, which
    /// would have no end.
    pub(super) fn flush(&mut self) {
        for _ in 0..self.outputs.slots().min(OUTPUTS) {
            let _ = self.outputs.pop();
        }
    }
}

/// Whole, for the log of the loop: its optional parts with a word each that says whether they are there.
impl Part for NativeOutput {
    const WORDS: usize = 2 + 6 + 6;

    fn put(&self, words: &mut [u64]) {
        let NativeOutput { control, motion, config } = *self;
        control.map(|control| control.0).put(words);
        (words[2], words[8]) = (motion.is_some().into(), config.is_some().into());
        if let Some(MotionCommand { id, parameters }) = motion {
            id.put(&mut words[3..]);
            put_bytes(&parameters, &mut words[4..8]);
        }
        if let Some(RtcBlock { tag, code, words: block }) = config {
            [tag, code].put(&mut words[9..]);
            block.put(&mut words[11..]);
        }
    }

    fn take(words: &[u64]) -> NativeOutput {
        let motion = || MotionCommand { id: u16::take(&words[3..]), parameters: take_bytes(&words[4..8]) };
        let [tag, code] = Part::take(&words[9..]);
        NativeOutput {
            control: <Option<u16> as Part>::take(words).map(ControlWord),
            motion: (words[2] != 0).then(motion),
            config: (words[8] != 0).then(|| RtcBlock { tag, code, words: Part::take(&words[11..]) }),
        }
    }
}

/// A reply as it came: the station publishes it whole, and its reader decodes it.
#[derive(Clone, Copy, Debug)]
struct Telegram {
    at: Time,
    running: bool,
    length: usize,
    bytes: [u8; ROOM],
}

/// Words before those of the telegram.
const FRONT: usize = 2;
/// Room for the longest telegram, in whole words. Bytes after its blocks are never read.
const ROOM: usize = RESPONSE_MAX.next_multiple_of(WORD);
const WORD: usize = size_of::<u64>();

/// Time, flag and length; its whole words; its last bytes as a word, which overlaps the one before it: no telegram is
/// shorter. Words behind them keep their values, and nobody reads them.
#[inline]
fn pack(at: Time, running: bool, telegram: &[u8], mut push: impl FnMut(u64)) {
    let telegram = &telegram[..telegram.len().min(ROOM)];
    push(at.0);
    push(u64::from(running) << 63 | telegram.len() as u64);
    telegram.as_chunks().0.iter().for_each(|bytes| push(u64::from_le_bytes(*bytes)));
    push(u64::from_le_bytes(telegram.last_chunk().copied().unwrap_or_default()));
}

impl Packed for Telegram {
    type Words = [u64; FRONT + ROOM / WORD + 1];

    fn pack(&self) -> Self::Words {
        let mut words = Self::Words::default();
        let mut places = words.iter_mut();
        pack(self.at, self.running, &self.bytes[..self.length.min(ROOM)], |word| {
            if let Some(place) = places.next() {
                *place = word;
            }
        });
        words
    }

    fn unpack(words: &Self::Words) -> Telegram {
        let [at, flags, words @ ..] = words;
        let length = ((flags << 1 >> 1) as usize).min(ROOM);
        let (mut bytes, whole) = ([0; ROOM], length / WORD);
        for (bytes, word) in bytes.as_chunks_mut().0[..whole].iter_mut().zip(words) {
            *bytes = word.to_le_bytes();
        }
        if let Some(last) = bytes[..length].last_chunk_mut() {
            *last = words[whole].to_le_bytes();
        }
        Telegram { at: Time(*at), running: flags >> 63 != 0, length, bytes }
    }
}

#[cfg(test)]
mod tests {

    use super::*;

    #[test]
    fn the_queue_is_locked_with_the_rest() {
        let (mut native, port) = native();
        let mut regions = Regions::new();
        port.memory(&mut regions);
        let mut chunk = native.outputs.write_chunk_uninit(OUTPUTS).unwrap();
        assert!(regions.covers(chunk.as_mut_slices().0));
    }

    #[test]
    fn whatever_was_received_can_be_read() {
        let mut random = fastrand::Rng::with_seed(7);
        let (native, mut port) = native();
        assert_eq!(native.inputs(), NativeInputs::default());
        for definition in 0..0x200_u32 {
            let mut bytes = [0; 64];
            random.fill(&mut bytes);
            bytes[..4].copy_from_slice(&(definition >> 6 & 7).to_le_bytes());
            bytes[4..8].copy_from_slice(&definition.to_le_bytes());
            let response = Response::parse(&bytes).unwrap();
            let running = definition & 1 != 0;
            port.runs(running);
            port.publish(Time(5), &bytes[..response.size()]);
            assert_eq!(native.inputs(), NativeInputs { at: Time(5), running, response });
        }
    }
}
