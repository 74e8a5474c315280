//! The native process data of a Unidrive: unscaled and complete, for the application.

use std::sync::Arc;
use std::sync::atomic::{AtomicI32, Ordering};

use rtrb::Producer;

use super::fields::COUNT;
use super::mapping::{Image, ROLES, Role};
use super::words::{ControlWord, StatusWord};
use fieldbeat_core::axis::cell::{self, Packed, Reader, Words, Writer};
use fieldbeat_core::bus::native::NativeBytes;
use fieldbeat_core::inputs::{Inlet, InputLog};
use fieldbeat_core::rt::{self, Regions};
use fieldbeat_core::time::Time;
use fieldbeat_core::{parts, word};

/// How many outputs the application may queue.
const OUTPUTS: usize = 16;

/// The application's end: [`Axis::native`](fieldbeat_core::axis::Axis::native) with this type.
#[derive(Debug)]
pub struct Native {
    inputs: Reader<NativeInputs>,
    also: Arc<[AtomicI32]>,
    outputs: Producer<NativeOutput>,
}

/// The last values of the drive, as counts on the wire; `None`: not read yet on this connection. The number of a
/// trip stays when the trip is over: the status says whether there is one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NativeInputs {
    /// When the newest value was taken in.
    pub at: Time,
    /// Native mode ran when the request of this reply was built: outputs written from now on go out.
    pub running: bool,
    image: Image,
}

impl NativeInputs {
    /// The status word.
    pub fn status(&self) -> Option<StatusWord> {
        self.get(Role::Status).map(|raw| StatusWord(raw as u16))
    }

    /// The control word as it was read back.
    pub fn control(&self) -> Option<ControlWord> {
        self.get(Role::Control).map(|raw| ControlWord(raw as u16))
    }

    /// The count of this role.
    pub fn get(&self, role: Role) -> Option<i32> {
        self.image.of(role)
    }
}

/// An output of the application in native mode, in order; it stays until the next one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NativeOutput {
    /// The control word; used only with `NativeOwner::Application`.
    pub control: ControlWord,
    /// The speed reference as sent on the wire.
    pub reference: i32,
}

/// The station's end.
#[derive(Debug)]
pub(super) struct NativePort {
    inputs: Writer<NativeInputs>,
    also: Arc<[AtomicI32]>,
    outputs: Inlet<NativeOutput>,
    regions: Regions,
}

/// Both ends, with so many additional parameters.
pub(super) fn native(also: usize) -> (Native, NativePort) {
    let (writer, reader) = cell::cell(NativeInputs::default());
    let mut regions = Regions::new();
    let (producer, consumer) = rt::ring(OUTPUTS, &mut regions);
    let also: Arc<[AtomicI32]> = (0..also).map(|_| AtomicI32::new(0)).collect();
    let native = Native { inputs: reader, also: Arc::clone(&also), outputs: producer };
    (native, NativePort { inputs: writer, also, outputs: Inlet::new(consumer), regions })
}

impl Native {
    /// The newest inputs.
    pub fn inputs(&self) -> NativeInputs {
        self.inputs.read()
    }

    /// The newest count of additional parameter `index`, in the order of the plan; 0 before the first one. Each is
    /// independent: two of them may be of two replies.
    pub fn also(&self, index: usize) -> Option<i32> {
        self.also.get(index).map(|count| count.load(Ordering::Relaxed))
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
        regions.add(&*self.also);
        regions.extend(&self.regions);
    }

    #[inline]
    pub(super) fn publish(&mut self, at: Time, running: bool, image: &Image) {
        let (seen, pairs) = image.parts();
        self.inputs.write_with(|places| {
            places.push(at.0);
            places.push(u64::from(running) << 63 | u64::from(seen));
            pairs.iter().for_each(|pair| places.push(*pair));
        });
    }

    /// Appends the newest counts, if the newest of them was taken in after `since`: which roles were read, a bit each;
    /// the count of each role up to the last one that was read; those of the additional parameters. Returns when it
    /// was.
    pub(super) fn inputs(&self, since: Time, out: &mut NativeBytes) -> Option<Time> {
        let mut words = self.inputs.words();
        let at = words.next().map(Time).filter(|at| *at > since)?;
        let seen = words.next().unwrap_or(0) as u16;
        let roles = match self.also.len() {
            0 => (u16::BITS - seen.leading_zeros()) as usize,
            // The places of the additional ones are fixed.
            _ => ROLES,
        };
        out.put(&seen.to_le_bytes());
        out.put_words(words, COUNT * roles);
        self.also.iter().for_each(|count| out.put(&count.load(Ordering::Relaxed).to_le_bytes()));
        Some(at)
    }

    #[inline]
    pub(super) fn publish_also(&mut self, index: u8, count: i32) {
        if let Some(place) = self.also.get(usize::from(index)) {
            place.store(count, Ordering::Relaxed);
        }
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

word! {
    ControlWord: |control: ControlWord| control.0.into(), |word| ControlWord(word as u16);
}

parts! {
    NativeOutput { control, reference }
}

impl Packed for NativeInputs {
    type Words = [u64; 2 + Image::PAIRS];

    #[inline]
    fn pack(&self) -> Self::Words {
        let mut words = Self::Words::ZERO;
        let (seen, pairs) = self.image.parts();
        words[0] = self.at.0;
        words[1] = u64::from(self.running) << 63 | u64::from(seen);
        words[2..].copy_from_slice(pairs);
        words
    }

    fn unpack(words: &Self::Words) -> NativeInputs {
        let [at, flags, pairs @ ..] = *words;
        NativeInputs { at: Time(at), running: flags >> 63 != 0, image: Image::new(flags as u32, pairs) }
    }
}
