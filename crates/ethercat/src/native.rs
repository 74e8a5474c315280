//! Native process data, unscaled and complete, for the application: those of a drive, and those of a device that is
//! not a drive.

use std::sync::Arc;

use rtrb::{Consumer, Producer};

use super::object::pdo::Layout;
use super::object::{Object, Type};
use fieldbeat_core::axis::Emergency;
use fieldbeat_core::bus::native::{self, Image, MOST_INPUTS, OUTPUTS};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::packed::Bytes;
use fieldbeat_core::parts;
use fieldbeat_core::rt::{self, Regions};
use fieldbeat_core::time::Time;

/// The largest PDO of a drive, bytes.
pub const PDO_MAX: usize = MOST_INPUTS;
/// The most bytes of inputs, and of outputs, of a device.
pub const TERMINAL_MAX: usize = 256;
/// How many emergencies of a device are kept for the application.
const EMERGENCIES: usize = 16;
/// Words of the inputs of a device.
const TERMINAL: usize = native::words(TERMINAL_MAX);

/// The application's end of a drive: [`Axis::native`](fieldbeat_core::axis::Axis::native) with this type.
#[derive(Debug)]
pub struct Native {
    end: native::Native<Image, NativeOutput>,
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
    bytes: Bytes<PDO_MAX>,
    length: u8,
}

impl NativeOutput {
    /// An output of these bytes; `None`: more than a PDO has.
    pub fn new(bytes: &[u8]) -> Option<NativeOutput> {
        let mut output = NativeOutput { bytes: Bytes([0; PDO_MAX]), length: u8::try_from(bytes.len()).ok()? };
        output.bytes.0.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(output)
    }

    /// The bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes.0[..usize::from(self.length).min(PDO_MAX)]
    }
}

impl Native {
    /// The newest inputs.
    pub fn inputs(&self) -> NativeInputs<'_> {
        let image = self.end.inputs();
        let (bytes, length) = image.bytes();
        NativeInputs { at: image.at(), running: image.flag(), layout: &self.layouts[1], bytes, length }
    }

    /// An output PDO with these values; objects that are not named are 0. `None`: an object is not mapped, or its
    /// value does not fit.
    pub fn output(&self, values: &[(Object, i64)]) -> Option<NativeOutput> {
        let layout = &self.layouts[0];
        let mut output = NativeOutput::new(&[0; PDO_MAX][..layout.size().min(PDO_MAX)])?;
        for (object, value) in values {
            let (at, entry) = layout.places().find(|(_, entry)| entry.object == *object)?;
            let (low, high) = entry.kind.range();
            let place = output.bytes.0.get_mut(at..at + entry.kind.bytes())?;
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
        self.end.write(output)
    }
}

fn value(layout: &Layout, object: Object, bytes: &[u8]) -> Option<i64> {
    let (at, entry) = layout.places().find(|(_, entry)| entry.object == object)?;
    number(entry.kind, at, bytes)
}

/// The number of this type that begins at a byte.
pub(super) fn number(kind: Type, at: usize, bytes: &[u8]) -> Option<i64> {
    let mut raw = [0; size_of::<u64>()];
    raw[..kind.bytes()].copy_from_slice(bytes.get(at..at + kind.bytes())?);
    Some(kind.number(u64::from_le_bytes(raw)))
}

/// The station's end.
pub type NativePort = native::NativePort<NativeOutput>;

/// Both ends, for PDOs of these layouts: outputs, inputs.
pub fn native(outputs: &Layout, inputs: &Layout) -> (Native, NativePort) {
    let (end, port) = native::native();
    (Native { end, layouts: Arc::new([outputs.clone(), inputs.clone()]) }, port)
}

/// The application's end of a device that is not a drive.
#[derive(Debug)]
pub struct Terminals {
    end: native::Native<Image<TERMINAL>, TerminalOutputs, TERMINAL>,
    emergencies: Consumer<Emergency>,
    sizes: (usize, usize),
}

/// The last inputs of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TerminalInputs {
    /// When it was taken in.
    pub at: Time,
    /// The inputs are current, and outputs reach it: it is in OP.
    pub operational: bool,
    bytes: [u8; TERMINAL_MAX],
    length: usize,
}

impl TerminalInputs {
    /// The inputs, as they came; all 0 before the first ones.
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
        let image = self.end.inputs();
        let (bytes, _) = image.bytes();
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
        self.end.write(Bytes(image)).map_err(|_| TerminalError::Full)
    }
}

/// All outputs of a device.
type TerminalOutputs = Bytes<TERMINAL_MAX>;

parts! {
    NativeOutput { length, bytes }
}

/// The segment's end of a device.
#[derive(Debug)]
pub struct TerminalPort {
    port: native::NativePort<TerminalOutputs, TERMINAL>,
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
    let (end, port) = native::native();
    let mut regions = Regions::new();
    let (reported, emergencies) = rt::ring(EMERGENCIES, &mut regions);
    let sizes = (outputs.min(TERMINAL_MAX), inputs.min(TERMINAL_MAX));
    let (log, newest) = (InputLog::default(), [0; TERMINAL_MAX]);
    let port =
        TerminalPort { port, log, emergencies: reported, newest, taken: false, size: sizes.0, regions };
    (Terminals { end, emergencies, sizes }, port)
}

impl TerminalPort {
    /// The same with this log.
    pub fn logged(mut self, log: &InputLog) -> TerminalPort {
        (self.port, self.log) = (self.port.logged(log), log.source());
        self
    }

    /// Adds what both directions touch, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.port.memory(regions);
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
        let outputs = &mut self.port.outputs;
        let waiting = outputs.slots().min(OUTPUTS);
        if waiting == 0 {
            return;
        }
        outputs.skip(waiting - 1);
        if let Some(Bytes(image)) = outputs.peek() {
            self.newest[..self.size].copy_from_slice(&image[..self.size]);
        }
        outputs.skip(1);
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
        self.port.flush();
        (self.newest, self.taken) = ([0; TERMINAL_MAX], false);
    }

    /// New inputs were received.
    pub fn publish(&mut self, at: Time, operational: bool, inputs: &[u8]) {
        self.port.runs(operational);
        self.port.publish(at, 0, inputs);
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
    fn reported_values_are_found_by_object() {
        let (native, mut port) = native(&layout(0x1702), &layout(0x1B03));
        assert_eq!(native.inputs().get(Object::new(0x6041, 0)), None, "nothing yet");
        // The inputs of the sheet's example.
        port.runs(true);
        port.publish(Time(7), 0, &[0x40, 0xE2, 0x01, 0, 0x06, 0xFF, 0x37, 0x06]);
        let inputs = native.inputs();
        assert_eq!((inputs.at, inputs.running, inputs.bytes().len()), (Time(7), true, 8));
        let values = [0x6064, 0x6077, 0x6041, 0x606C].map(|index| inputs.get(Object::new(index, 0)));
        assert_eq!(values, [Some(123_456), Some(-250), Some(0x0637), None]);
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
        assert_eq!(port.outputs.pop(), Some(output));
        port.flush();
        assert_eq!(port.outputs.pop(), None);
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
