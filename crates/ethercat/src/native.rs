//! Native process data, unscaled and complete, for the application: those of a drive, and those of a device that is
//! not a drive.

use std::sync::Arc;

use rtrb::{Consumer, Producer};

use super::object::pdo::Layout;
use super::object::{Object, Type};
use fieldbeat_core::axis::Emergency;
use fieldbeat_core::axis::cell::{self, Packed, Reader, Writer};
use fieldbeat_core::bus::native::NativeBytes;
use fieldbeat_core::inputs::{Inlet, InputLog};
use fieldbeat_core::packed::{Part, put_bytes, take_bytes};
use fieldbeat_core::rt::{self, Regions};
use fieldbeat_core::time::Time;

/// The largest PDO of a drive, bytes.
pub const PDO_MAX: usize = 64;
/// The most bytes of inputs, and of outputs, of a device.
pub const TERMINAL_MAX: usize = 256;
/// How many outputs the application may queue.
const OUTPUTS: usize = 16;
/// How many emergencies of a device are kept for the application.
const EMERGENCIES: usize = 16;
/// Bytes of a word of a cell.
const WORD: usize = size_of::<u64>();

/// The application's end of a drive: [`Axis::native`](fieldbeat_core::axis::Axis::native) with this type.
#[derive(Debug)]
pub struct Native {
    inputs: Reader<Image<{ FRONT + PDO_MAX / WORD }>>,
    outputs: Producer<NativeOutput>,
    layouts: Arc<[Layout; 2]>,
}

/// The last inputs of the drive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NativeInputs<'a> {
    /// When it was taken in.
    pub at: Time,
    /// Native mode ran when the outputs of this exchange were built: outputs written from now on go out.
    pub running: bool,
    layout: &'a Layout,
    bytes: [u8; PDO_MAX],
    length: usize,
}

impl NativeInputs<'_> {
    /// The input PDO as it came; empty before the first one.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }

    /// The value of an object in it; `None`: it is not mapped, or nothing came yet.
    pub fn get(&self, object: Object) -> Option<i64> {
        value(self.layout, object, self.bytes())
    }
}

/// An output PDO, whole: it stays until the next one. With `NativeOwner::Master` its control word is ignored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NativeOutput {
    bytes: [u8; PDO_MAX],
    length: u8,
}

impl NativeOutput {
    /// An output of these bytes; `None`: more than a PDO has.
    pub fn new(bytes: &[u8]) -> Option<NativeOutput> {
        let mut output = NativeOutput { bytes: [0; PDO_MAX], length: u8::try_from(bytes.len()).ok()? };
        output.bytes.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(output)
    }

    /// Its bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..usize::from(self.length).min(PDO_MAX)]
    }
}

impl Native {
    /// The newest inputs.
    pub fn inputs(&self) -> NativeInputs<'_> {
        let image = self.inputs.read();
        NativeInputs {
            at: image.at(),
            running: image.flag(),
            layout: &self.layouts[1],
            bytes: image.bytes(),
            length: image.length().min(PDO_MAX),
        }
    }

    /// An output PDO with these values; objects that are not named are 0. `None`: an object is not mapped, or its
    /// value does not fit.
    pub fn output(&self, values: &[(Object, i64)]) -> Option<NativeOutput> {
        let layout = &self.layouts[0];
        let mut output = NativeOutput::new(&[0; PDO_MAX][..layout.size().min(PDO_MAX)])?;
        for (object, value) in values {
            let (at, entry) = layout.places().find(|(_, entry)| entry.object == *object)?;
            let (low, high) = entry.kind.range();
            let place = output.bytes.get_mut(at..at + entry.kind.bytes())?;
            if !(low..=high).contains(value) {
                return None;
            }
            place.copy_from_slice(&entry.kind.raw(*value).to_le_bytes()[..entry.kind.bytes()]);
        }
        Some(output)
    }

    /// Queues an output for the axis in native mode; returns it if the queue is full. An output written before the
    /// mode runs ([`NativeInputs::running`]) is dropped when the mode begins.
    pub fn write(&mut self, output: NativeOutput) -> Result<(), NativeOutput> {
        self.outputs.push(output).map_err(|rtrb::PushError::Full(output)| output)
    }
}

fn value(layout: &Layout, object: Object, bytes: &[u8]) -> Option<i64> {
    let (at, entry) = layout.places().find(|(_, entry)| entry.object == object)?;
    number(entry.kind, at, bytes)
}

/// The number of this type that begins at a byte.
pub(super) fn number(kind: Type, at: usize, bytes: &[u8]) -> Option<i64> {
    let mut raw = [0; WORD];
    raw[..kind.bytes()].copy_from_slice(bytes.get(at..at + kind.bytes())?);
    Some(kind.number(u64::from_le_bytes(raw)))
}

/// The station's end.
#[derive(Debug)]
#[repr(C)] // Its writer is used with each report.
pub struct NativePort {
    inputs: Writer<Image<{ FRONT + PDO_MAX / WORD }>>,
    outputs: Inlet<NativeOutput>,
    regions: Regions,
}

/// Both ends, for PDOs of these layouts: outputs, inputs.
pub fn native(outputs: &Layout, inputs: &Layout) -> (Native, NativePort) {
    let (writer, reader) = cell::cell(Image::EMPTY);
    let mut regions = Regions::new();
    let (producer, consumer) = rt::ring(OUTPUTS, &mut regions);
    let layouts = Arc::new([outputs.clone(), inputs.clone()]);
    let native = Native { inputs: reader, outputs: producer, layouts };
    (native, NativePort { inputs: writer, outputs: Inlet::new(consumer), regions })
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

    #[inline]
    pub(super) fn publish(&mut self, at: Time, running: bool, inputs: &[u8]) {
        let inputs = &inputs[..inputs.len().min(PDO_MAX)];
        self.inputs.write_with(|places| pack(at, running, inputs, |word| places.push(word)));
    }

    /// Appends the newest inputs, if they were taken in after `since`. Returns when they were.
    pub(super) fn inputs(&self, since: Time, out: &mut NativeBytes) -> Option<Time> {
        let mut words = self.inputs.words();
        let at = words.next().map(Time).filter(|at| *at > since)?;
        let length = words.next().unwrap_or(0) as u16;
        out.put_words(words, length.into());
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

/// The application's end of a device that is not a drive.
#[derive(Debug)]
pub struct Terminals {
    inputs: Reader<Image<{ FRONT + TERMINAL_MAX / WORD }>>,
    outputs: Producer<TerminalOutputs>,
    emergencies: Consumer<Emergency>,
    sizes: (usize, usize),
}

/// The last inputs of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TerminalInputs {
    /// When it was taken in.
    pub at: Time,
    /// Its inputs are current, and outputs reach it: it is in OP.
    pub operational: bool,
    bytes: [u8; TERMINAL_MAX],
    length: usize,
}

impl TerminalInputs {
    /// Its inputs, as they came; all 0 before the first ones.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }
}

/// Why outputs were not accepted.
#[derive(Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TerminalError {
    /// The image is of another size.
    #[error("the device has {has} bytes of outputs, not {given}: write all of them at once")]
    Size {
        /// The device's size.
        has: usize,
        /// The given size.
        given: usize,
    },
    /// The loop has not taken the previous ones yet.
    #[error("the previous outputs have not gone out yet: write at most once per cycle")]
    Full,
}
fieldbeat_core::debug_as_display!(TerminalError);

impl Terminals {
    /// The newest inputs.
    pub fn inputs(&self) -> TerminalInputs {
        let image = self.inputs.read();
        let mut bytes: [u8; TERMINAL_MAX] = image.bytes();
        bytes[image.length().min(TERMINAL_MAX)..].fill(0);
        TerminalInputs { at: image.at(), operational: image.flag(), bytes, length: self.sizes.1 }
    }

    /// The next emergency that it reported by its mailbox. If the application takes none, the oldest ones are kept.
    pub fn emergency(&mut self) -> Option<Emergency> {
        self.emergencies.pop().ok()
    }

    /// Bytes of its outputs and inputs.
    pub fn sizes(&self) -> (usize, usize) {
        self.sizes
    }

    /// Writes all outputs at once: they go out with the next frame, unless newer ones are written by then, and stay
    /// until the next ones, or until the device leaves OP: then they are zeros until they are written again.
    pub fn write(&mut self, outputs: &[u8]) -> Result<(), TerminalError> {
        let mut image = [0; TERMINAL_MAX];
        match image.get_mut(..self.sizes.0) {
            Some(place) if place.len() == outputs.len() => place.copy_from_slice(outputs),
            _ => return Err(TerminalError::Size { has: self.sizes.0, given: outputs.len() }),
        }
        self.outputs.push(TerminalOutputs(image)).map_err(|_| TerminalError::Full)
    }
}

/// All outputs of a device.
#[derive(Clone, Copy, Debug)]
pub struct TerminalOutputs([u8; TERMINAL_MAX]);

impl Part for TerminalOutputs {
    const WORDS: usize = TERMINAL_MAX / WORD;

    fn put(&self, words: &mut [u64]) {
        put_bytes(&self.0, words);
    }

    fn take(words: &[u64]) -> TerminalOutputs {
        TerminalOutputs(take_bytes(words))
    }
}

impl Part for NativeOutput {
    const WORDS: usize = 1 + PDO_MAX / WORD;

    fn put(&self, words: &mut [u64]) {
        self.length.put(words);
        put_bytes(&self.bytes, &mut words[1..]);
    }

    fn take(words: &[u64]) -> NativeOutput {
        NativeOutput { length: u8::take(words), bytes: take_bytes(&words[1..]) }
    }
}

/// The segment's end of a device.
#[derive(Debug)]
pub struct TerminalPort {
    inputs: Writer<Image<{ FRONT + TERMINAL_MAX / WORD }>>,
    outputs: Inlet<TerminalOutputs>,
    log: InputLog,
    emergencies: Producer<Emergency>,
    newest: [u8; TERMINAL_MAX],
    /// The outputs of the next frame were taken: built again, it has the same.
    taken: bool,
    size: usize,
    regions: Regions,
}

/// Both ends of a device with so many bytes of outputs and inputs; bytes beyond [`TERMINAL_MAX`] are cut off.
pub fn terminals(outputs: usize, inputs: usize) -> (Terminals, TerminalPort) {
    let (writer, reader) = cell::cell(Image::EMPTY);
    let mut regions = Regions::new();
    let (producer, consumer) = rt::ring(OUTPUTS, &mut regions);
    let (reported, emergencies) = rt::ring(EMERGENCIES, &mut regions);
    let sizes = (outputs.min(TERMINAL_MAX), inputs.min(TERMINAL_MAX));
    let newest = [0; TERMINAL_MAX];
    let terminals = Terminals { inputs: reader, outputs: producer, emergencies, sizes };
    (
        terminals,
        TerminalPort {
            inputs: writer,
            outputs: Inlet::new(consumer),
            emergencies: reported,
            log: InputLog::default(),
            newest,
            taken: false,
            size: sizes.0,
            regions,
        },
    )
}

impl TerminalPort {
    /// The same with this log.
    pub fn logged(mut self, log: &InputLog) -> TerminalPort {
        (self.outputs, self.log) = (self.outputs.logged(log), log.source());
        self
    }

    /// Adds what both directions touch, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.inputs.memory(regions);
        regions.extend(&self.regions);
    }

    /// The outputs of the next frame: the newest; all 0 until the application wrote some.
    #[inline]
    pub fn outputs(&mut self) -> &[u8] {
        if !std::mem::replace(&mut self.taken, true) {
            self.take_newest();
        }
        &self.newest[..self.size]
    }

    /// Takes the newest outputs out of the queue; of an image only the bytes that the device has are copied.
    #[inline]
    fn take_newest(&mut self) {
        let waiting = self.outputs.slots().min(OUTPUTS);
        if waiting == 0 {
            return;
        }
        self.outputs.skip(waiting - 1);
        if let Some(TerminalOutputs(image)) = self.outputs.peek() {
            self.newest[..self.size].copy_from_slice(&image[..self.size]);
        }
        self.outputs.skip(1);
    }

    /// The application has room for an emergency.
    pub fn may_report(&self) -> bool {
        self.log.flag(true, !self.emergencies.is_full())
    }

    /// Queues an emergency that it reported; dropped if there is no room.
    pub fn report(&mut self, emergency: Emergency) {
        let _ = self.emergencies.push(emergency);
    }

    /// The frame with these outputs went out.
    pub fn sent(&mut self) {
        self.taken = false;
    }

    /// The device was lost: earlier outputs for it are no longer valid.
    pub fn forget(&mut self) {
        for _ in 0..self.outputs.slots().min(OUTPUTS) {
            let _ = self.outputs.pop();
        }
        (self.newest, self.taken) = ([0; TERMINAL_MAX], false);
    }

    /// Its inputs came in.
    pub fn publish(&mut self, at: Time, operational: bool, inputs: &[u8]) {
        let inputs = &inputs[..inputs.len().min(TERMINAL_MAX)];
        self.inputs.write_with(|places| pack(at, operational, inputs, |word| places.push(word)));
    }
}

/// Bytes with their instant, and a flag, as the words of a cell: the instant, flag and length, the bytes.
#[derive(Clone, Copy, Debug)]
struct Image<const N: usize>([u64; N]);

/// Words before the bytes.
const FRONT: usize = 2;

impl<const N: usize> Image<N> {
    const EMPTY: Image<N> = Image([0; N]);

    fn at(&self) -> Time {
        Time(self.0[0])
    }

    fn flag(&self) -> bool {
        self.0[1] >> 63 != 0
    }

    fn length(&self) -> usize {
        usize::from(self.0[1] as u16)
    }

    /// The bytes; after those that count there are older ones.
    fn bytes<const BYTES: usize>(&self) -> [u8; BYTES] {
        let mut bytes = [0; BYTES];
        for (place, word) in bytes.chunks_mut(WORD).zip(&self.0[FRONT..]) {
            place.copy_from_slice(&word.to_le_bytes()[..place.len()]);
        }
        bytes
    }
}

/// The words of an image with these bytes; missing bytes of its last word are 0.
#[inline]
fn pack(at: Time, flag: bool, bytes: &[u8], mut push: impl FnMut(u64)) {
    push(at.0);
    push(u64::from(flag) << 63 | bytes.len() as u64);
    if let Ok(word) = bytes.try_into() {
        // The PDO that most drives have.
        return push(u64::from_le_bytes(word));
    }
    let (words, rest) = bytes.as_chunks();
    for word in words {
        push(u64::from_le_bytes(*word));
    }
    if !rest.is_empty() {
        push(short_word(rest));
    }
}

/// Fewer bytes than a word has; the missing ones are 0. Of four and more by two loads that overlap: a loop over bytes
/// costs several times as much.
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
    use crate::object::{Family, pdo};

    fn layout(number: u16) -> Layout {
        pdo::fixed(Family::S700).into_iter().find(|layout| layout.pdo == number).unwrap()
    }

    #[test]
    fn what_the_drive_reported_is_found_by_object() {
        let (native, mut port) = native(&layout(0x1702), &layout(0x1B03));
        assert_eq!(native.inputs().get(Object::new(0x6041, 0)), None, "nothing yet");
        // The inputs of the sheet's example.
        port.publish(Time(7), true, &[0x40, 0xE2, 0x01, 0, 0x06, 0xFF, 0x37, 0x06]);
        let inputs = native.inputs();
        assert_eq!((inputs.at, inputs.running, inputs.bytes().len()), (Time(7), true, 8));
        let values = [0x6064, 0x6077, 0x6041, 0x606C].map(|index| inputs.get(Object::new(index, 0)));
        assert_eq!(values, [Some(123_456), Some(-250), Some(0x0637), None]);
    }

    #[test]
    fn bytes_of_less_than_a_word_are_its_lowest() {
        let bytes = [0xF1, 2, 3, 4, 5, 6, 0x87];
        for length in 0..=bytes.len() {
            let mut word = [0; WORD];
            word[..length].copy_from_slice(&bytes[..length]);
            assert_eq!(short_word(&bytes[..length]), u64::from_le_bytes(word), "{length}");
        }
    }

    #[test]
    fn outputs_are_made_by_object_and_queued_in_order() {
        let (mut native, mut port) = native(&layout(0x1702), &layout(0x1B03));
        let (velocity, control) = (Object::new(0x606B, 0), Object::new(0x6040, 0));
        let output = native.output(&[(velocity, -2), (control, 0x0F)]).unwrap();
        assert_eq!(output.bytes(), [0xFE, 0xFF, 0xFF, 0xFF, 0x0F, 0]);
        assert_eq!(native.output(&[(control, 0x1_0000)]), None, "it does not fit");
        assert_eq!(native.output(&[(Object::new(0x607A, 0), 0)]), None, "it is not mapped");
        assert_eq!(NativeOutput::new(&[0; PDO_MAX + 1]), None);
        for _ in 0..OUTPUTS {
            native.write(output).unwrap();
        }
        assert_eq!(native.write(output), Err(output));
        assert_eq!(port.peek(), Some(output));
        port.pop();
        port.flush();
        assert_eq!(port.peek(), None);
    }

    #[test]
    fn the_newest_outputs_of_a_device_are_the_ones_that_go_out() {
        let (mut terminals, mut port) = terminals(3, 10);
        assert_eq!(port.outputs(), [0; 3]);
        port.sent();
        let size = TerminalError::Size { has: 3, given: 2 };
        assert_eq!(terminals.write(&[1, 2]), Err(size));
        terminals.write(&[1, 2, 3]).unwrap();
        terminals.write(&[4, 5, 6]).unwrap();
        assert_eq!(port.outputs(), [4, 5, 6]);
        terminals.write(&[7, 8, 9]).unwrap();
        assert_eq!(port.outputs(), [4, 5, 6], "built again for the same frame");
        port.sent();
        assert_eq!(port.outputs(), [7, 8, 9]);
        port.sent();
        assert_eq!(port.outputs(), [7, 8, 9], "they stay");
        terminals.write(&[1, 1, 1]).unwrap();
        port.forget();
        assert_eq!(port.outputs(), [0; 3], "not even what was under way comes back by itself");
        terminals.write(&[2, 2, 2]).unwrap();
        port.sent();
        assert_eq!(port.outputs(), [2, 2, 2]);
        port.publish(Time(5), true, &[9; 10]);
        let inputs = terminals.inputs();
        assert_eq!((inputs.at, inputs.operational, inputs.bytes()), (Time(5), true, &[9; 10][..]));
    }
}
