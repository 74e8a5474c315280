//! The native process data of a Unidrive: unscaled and complete, for the application.

use std::sync::Arc;
use std::sync::atomic::{AtomicI32, Ordering};

use super::fields::COUNT;
use super::mapping::{Image, ROLES, Role};
use super::words::{ControlWord, StatusWord};
use fieldbeat_core::bus::native::{self, NativeBytes};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;
use fieldbeat_core::{parts, word};

/// The application's end: [`Axis::native`](fieldbeat_core::axis::Axis::native) with this type.
#[derive(Debug)]
pub struct Native {
    end: native::Native<NativeInputs, NativeOutput>,
    also: Also,
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
pub(super) type NativePort = native::NativePort<NativeOutput>;

/// The newest counts of the additional parameters, for both ends.
#[derive(Clone, Debug)]
pub(super) struct Also(Arc<[AtomicI32]>);

/// Both ends, with so many additional parameters.
pub(super) fn native(also: usize) -> (Native, NativePort, Also) {
    let (end, port) = native::native();
    let also = Also((0..also).map(|_| AtomicI32::new(0)).collect());
    (Native { end, also: also.clone() }, port, also)
}

impl Native {
    /// The newest inputs.
    pub fn inputs(&self) -> NativeInputs {
        self.end.inputs()
    }

    /// The newest count of additional parameter `index`, in the order of the plan; 0 before the first one. Each is
    /// independent: two of them may be of two replies.
    pub fn also(&self, index: usize) -> Option<i32> {
        self.also.0.get(index).map(|count| count.load(Ordering::Relaxed))
    }

    /// Queues an output for the axis in native mode; returns it if the queue is full. An output written before the
    /// mode runs ([`NativeInputs::running`]) is dropped when the mode begins.
    pub fn write(&mut self, output: NativeOutput) -> Result<(), NativeOutput> {
        self.end.write(output)
    }
}

/// Publishes the newest counts.
#[inline]
pub(super) fn publish(port: &mut NativePort, at: Time, image: &Image) {
    let (seen, pairs) = image.parts();
    port.publish_words(at, seen.into(), pairs);
}

impl Also {
    /// Adds its memory, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.0);
    }

    #[inline]
    pub(super) fn publish(&self, index: u8, count: i32) {
        if let Some(place) = self.0.get(usize::from(index)) {
            place.store(count, Ordering::Relaxed);
        }
    }

    /// Appends the newest counts, if the newest of them was taken in after `since`: which roles were read, a bit each;
    /// the count of each role up to the last one that was read; those of the additional parameters. Returns when it
    /// was.
    pub(super) fn inputs(&self, port: &NativePort, since: Time, out: &mut NativeBytes) -> Option<Time> {
        let (at, seen, words) = port.newest(since)?;
        let seen = seen as u16;
        let roles = match self.0.len() {
            0 => (u16::BITS - seen.leading_zeros()) as usize,
            // The places of the additional ones are fixed.
            _ => ROLES,
        };
        out.put(&seen.to_le_bytes());
        out.put_words(words, COUNT * roles);
        self.0.iter().for_each(|count| out.put(&count.load(Ordering::Relaxed).to_le_bytes()));
        Some(at)
    }
}

word! {
    ControlWord: |control: ControlWord| control.0.into(), |word| ControlWord(word as u16);
}

parts! {
    NativeOutput { control, reference }
}

impl From<native::Image> for NativeInputs {
    fn from(image: native::Image) -> NativeInputs {
        let pairs = image.words().first_chunk().copied().unwrap_or_default();
        let values = Image::new(image.added() as u32, pairs);
        NativeInputs { at: image.at(), running: image.flag(), image: values }
    }
}

const _: () = assert!(8 * Image::PAIRS <= native::MOST_INPUTS, "all values are published");
