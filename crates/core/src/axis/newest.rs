//! The newest setpoints from one thread to another: a triple buffer over atomic words, without `unsafe`.
//!
//! Both ends are wait-free. Unlike in a queue nothing is ever full: a set that the reader has not taken is replaced by
//! the next one. A set is the setpoint of one axis, or those of all members of a group: the reader gets all parts of
//! one set, or none.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use crossbeam::utils::CachePadded;

use super::command::Setpoint;
use crate::packed::Part as _;
use crate::rt::Regions;
use crate::sync::AtomicU64;

/// The set in the shared slot was not taken yet.
const FRESH: u64 = 4;
const INDEX: u64 = 3;

/// A part, as words.
type Part = [AtomicU64; Setpoint::WORDS];

#[derive(Debug)]
struct Shared {
    /// Three sets: one belongs to the writer, one to the reader, one is shared.
    sets: [Box<[Part]>; 3],
    /// The index of the shared one, with [`FRESH`].
    state: AtomicU64,
}

/// The writing end.
#[derive(Debug)]
pub struct NewestIn {
    shared: Arc<CachePadded<Shared>>,
    own: u64,
}

/// The reading end.
#[derive(Debug)]
pub struct NewestOut {
    shared: Arc<CachePadded<Shared>>,
    own: u64,
}

/// Both ends of sets of at most so many parts; there is none yet.
pub fn newest(most: usize) -> (NewestIn, NewestOut) {
    let part = |_| std::array::from_fn(|_| AtomicU64::new(0));
    let sets = std::array::from_fn(|_| (0..most).map(part).collect());
    // The shared set is 0.
    let shared = Arc::new(CachePadded::new(Shared { sets, state: AtomicU64::new(0) }));
    (NewestIn { shared: Arc::clone(&shared), own: 1 }, NewestOut { shared, own: 2 })
}

impl NewestIn {
    /// Replaces the set by these parts of one, which all name their number.
    pub fn write(&mut self, parts: &[Setpoint]) {
        for (words, part) in self.shared.sets[self.own as usize].iter().zip(parts) {
            let mut values = [0; Setpoint::WORDS];
            part.put(&mut values);
            for (word, value) in words.iter().zip(values) {
                word.store(value, Ordering::Relaxed);
            }
        }
        // Releases the words, and acquires those that the reader has read from the other slot.
        self.own = self.shared.state.swap(self.own | FRESH, Ordering::AcqRel) & INDEX;
    }
}

impl NewestOut {
    /// Adds what both ends share, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&**self.shared);
        self.shared.sets.iter().for_each(|set| regions.add(&**set));
    }

    /// Takes the newest set, once. Returns whether there is one.
    pub fn take(&mut self) -> bool {
        if self.shared.state.load(Ordering::Relaxed) & FRESH == 0 {
            return false;
        }
        self.own = self.shared.state.swap(self.own, Ordering::AcqRel) & INDEX;
        true
    }

    /// A part of the set that was taken last; `None` beyond the most that there can be.
    pub fn part(&self, place: usize) -> Option<Setpoint> {
        let words = self.shared.sets[self.own as usize].get(place)?;
        Some(Setpoint::take(&words.each_ref().map(|word| word.load(Ordering::Relaxed))))
    }
}
