//! The native process data between a drive's station and the application: the same on each wire but for what its inputs
//! and outputs are.

use std::marker::PhantomData;

use rtrb::Producer;

use super::image::{self, DRIVE, Image};
use super::{Inputs, NativeBytes};
use crate::axis::cell::{self, Reader, Writer};
use crate::inputs::{Inlet, InputLog};
use crate::packed::Part;
use crate::rt::{self, Regions};
use crate::time::Time;

/// How many outputs the application may queue.
pub const OUTPUTS: usize = 16;

/// The application's end: [`Axis::native`](crate::axis::Axis::native) with the type of the axis's protocol.
#[derive(Debug)]
pub struct Native<In, Out, const N: usize = DRIVE> {
    image: Reader<Image<N>>,
    outputs: Producer<Out>,
    inputs: PhantomData<fn() -> In>,
}

/// The station's end.
#[derive(Debug)]
#[repr(C)] // Its writer is used with each report.
pub struct NativePort<Out, const N: usize = DRIVE> {
    image: Writer<Image<N>>,
    running: bool,
    /// The outputs of the application, in order.
    pub outputs: Inlet<Out>,
    /// The memory of the queue.
    regions: Regions,
}

/// Both ends, for inputs of [so many](image::words) words.
pub fn native<In, Out: Part, const N: usize>() -> (Native<In, Out, N>, NativePort<Out, N>) {
    let (writer, reader) = cell::cell(Image::EMPTY);
    let mut regions = Regions::new();
    let (producer, consumer) = rt::ring(OUTPUTS, &mut regions);
    let port = NativePort { image: writer, running: false, outputs: Inlet::new(consumer), regions };
    (Native { image: reader, outputs: producer, inputs: PhantomData }, port)
}

impl<In: From<Image<N>>, Out, const N: usize> Native<In, Out, N> {
    /// The newest inputs.
    pub fn inputs(&self) -> In {
        self.image.read().into()
    }

    /// Queues an output for the axis in native mode; returns it if the queue is full. An output written before the
    /// mode runs (`running` of its inputs) is dropped when the mode begins.
    pub fn write(&mut self, output: Out) -> Result<(), Out> {
        self.outputs.push(output).map_err(|rtrb::PushError::Full(output)| output)
    }
}

impl<Out: Part, const N: usize> NativePort<Out, N> {
    /// The same with this log.
    pub fn logged(mut self, log: &InputLog) -> NativePort<Out, N> {
        self.outputs = self.outputs.logged(log);
        self
    }

    /// Adds what both directions touch, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.image.memory(regions);
        regions.extend(&self.regions);
    }

    /// Sets whether native mode runs, for everything published from here on.
    #[inline]
    pub fn runs(&mut self, running: bool) {
        self.running = running;
    }

    /// The next output, which stays until the telegram with it has [left](Self::left).
    #[inline]
    pub fn peek(&mut self) -> Option<Out> {
        self.outputs.peek().copied()
    }

    /// A telegram has left: with the next output, if it was `taken`; and another motion begins with it, which is native
    /// mode or not. What the application has written before it is dropped then.
    pub fn left(&mut self, taken: bool, begins: Option<bool>) {
        if taken {
            let _ = self.outputs.pop();
        }
        if let Some(running) = begins {
            self.flush();
            self.runs(running);
        }
    }

    /// Publishes inputs that were taken in then, as many bytes as there is room for, with some bits of the wire's own,
    /// 48 at most.
    #[inline(never)] // Inlined, it costs more: its loop needs the registers of its caller.
    pub fn publish(&mut self, at: Time, added: u64, inputs: &[u8]) {
        Image::write(&mut self.image, at, self.running, added, inputs);
    }

    /// The same of a number of bytes that the compiler knows.
    #[inline]
    pub fn publish_array<const L: usize>(&mut self, at: Time, added: u64, inputs: &[u8; L]) {
        Image::write(&mut self.image, at, self.running, added, inputs);
    }

    /// The same of whole words, the lowest byte first.
    #[inline]
    pub fn publish_words(&mut self, at: Time, added: u64, words: &[u64]) {
        Image::write_words(&mut self.image, at, self.running, added, words);
    }

    /// When the newest inputs were taken in, their flags, of which the lowest bits are those that the wire has added,
    /// and their words; `None`: that was not after `since`.
    #[inline]
    pub fn newest(&self, since: Time) -> Option<(Time, u64, impl Iterator<Item = u64> + '_)> {
        let mut words = self.image.words();
        let at = words.next().map(Time).filter(|at| *at > since)?;
        Some((at, words.next().unwrap_or(0), words))
    }

    /// Drops the outputs that are there; not those that the application writes meanwhile, which would have no end.
    pub fn flush(&mut self) {
        for _ in 0..self.outputs.slots().min(OUTPUTS) {
            let _ = self.outputs.pop();
        }
    }
}

impl<Out: Part, const N: usize> Inputs for NativePort<Out, N> {
    fn put(&self, since: Time, out: &mut NativeBytes) -> Option<Time> {
        let (at, flags, words) = self.newest(since)?;
        out.put_words(words, image::length(flags));
        Some(at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn both() -> (Native<Image, u32>, NativePort<u32>) {
        native()
    }

    #[test]
    fn the_queue_is_locked_with_the_rest() {
        let (mut native, port) = both();
        let mut regions = Regions::new();
        port.memory(&mut regions);
        let mut chunk = native.outputs.write_chunk_uninit(OUTPUTS).unwrap();
        assert!(regions.covers(chunk.as_mut_slices().0));
    }

    #[test]
    fn each_output_comes_once_in_order_and_none_of_those_that_were_dropped() {
        let (mut native, mut port) = both();
        (0..OUTPUTS as u32).for_each(|output| native.write(output).unwrap());
        assert_eq!(native.write(7), Err(7));
        for output in 0..2 {
            assert_eq!((port.peek(), port.peek()), (Some(output), Some(output)), "it has not left");
            port.left(true, None);
        }
        port.left(false, Some(true));
        assert_eq!(port.peek(), None);
    }

    #[test]
    fn a_recording_has_what_was_taken_in_since_the_last_look() {
        let (native, mut port) = both();
        port.left(false, Some(true));
        port.publish(Time(5), 3, &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10]);
        let image = native.inputs();
        assert_eq!((image.at(), image.flag(), image.added()), (Time(5), true, 3));
        let mut bytes = NativeBytes::default();
        assert_eq!((port.put(Time(5), &mut bytes), bytes.length()), (None, 0));
        assert_eq!((port.put(Time(4), &mut bytes), bytes.length()), (Some(Time(5)), 10));
        assert_eq!(bytes.part(0), Some(&[1, 2, 3, 4, 5, 6, 7, 8, 9, 10]));
    }
}
