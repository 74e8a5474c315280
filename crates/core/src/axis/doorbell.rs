//! Which axes have something to be taken: a bit for each of them, in words that the loop takes once a cycle in place of
//! looking into every queue.
//!
//! Whoever has put something into a queue of an axis rings its bell. The loop takes all bells of a word at once, and
//! then looks into the queues of those that have rung.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use crossbeam::utils::CachePadded;

use crate::inputs::InputLog;
use crate::rt::Regions;
use crate::sync::AtomicU64;

/// Bells in one word.
const IN_WORD: usize = u64::BITS as usize;

type Words = Arc<[CachePadded<AtomicU64>]>;

/// The application's end for one axis.
#[derive(Clone, Debug)]
pub struct Bell {
    words: Words,
    word: usize,
    bit: u64,
}

/// The loop's end for all of them.
#[derive(Debug)]
pub struct Bells {
    words: Words,
    /// Those that have rung and whose queues are not known to be empty since then.
    rung: Box<[u64]>,
    /// A bell has rung since the last [`take_rung`](Self::take_rung).
    any_rung: bool,
    log: InputLog,
}

impl Bell {
    /// Something was put into a queue of the axis. Wait-free.
    ///
    /// The release orders it behind that. It is one read-modify-write, so it also passes on what the bells that rang
    /// before in the same word have released.
    pub fn ring(&self) {
        self.words[self.word].fetch_or(self.bit, Ordering::Release);
    }
}

impl Bells {
    /// The bells of so many axes.
    pub fn new(axes: usize) -> Bells {
        let count = axes.div_ceil(IN_WORD);
        let words = (0..count).map(|_| CachePadded::new(AtomicU64::new(0))).collect();
        Bells { words, rung: vec![0; count].into(), any_rung: false, log: InputLog::default() }
    }

    /// The log that records taken bells.
    pub fn logged(mut self, log: &InputLog) -> Bells {
        self.log = log.source();
        self
    }

    /// The application's end for `axis`, one of them.
    pub fn bell(&self, axis: usize) -> Bell {
        Bell { words: Arc::clone(&self.words), word: axis / IN_WORD, bit: 1 << (axis % IN_WORD) }
    }

    /// Adds the memory that taking touches, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.words);
        regions.add(&*self.rung);
    }

    /// Takes what has rung since the last time, and returns whether any bell rings or was kept.
    ///
    /// The bit goes before the queue is looked into, and the acquire keeps that order: what is put there after that
    /// rings again, and what was put there before is seen. So nothing is lost, and at worst a queue is found empty.
    #[inline]
    pub fn take(&mut self) -> bool {
        let mut any = 0;
        for (rung, word) in self.rung.iter_mut().zip(&*self.words) {
            // A bell that is missed by this look rings until the next one.
            let rings = word.load(Ordering::Relaxed) != 0;
            let taken = if rings { word.swap(0, Ordering::Acquire) } else { 0 };
            let taken = self.log.value(0, taken);
            self.any_rung |= taken != 0;
            *rung |= taken;
            any |= *rung;
        }
        any != 0
    }

    /// Whether any bell has rung since the last call, be it taken by that look or by another one before.
    #[inline]
    pub fn take_rung(&mut self) -> bool {
        std::mem::take(&mut self.any_rung)
    }

    /// No bell has rung that was not silenced.
    #[inline]
    pub fn are_silent(&self) -> bool {
        self.rung.iter().all(|bits| *bits == 0)
    }

    /// The axes whose bells have rung and were not silenced, in their order.
    pub fn rung(&self) -> impl Iterator<Item = usize> {
        let words = self.rung.iter().enumerate();
        words.flat_map(|(word, bits)| {
            let bits = *bits;
            (0..IN_WORD).filter(move |bit| bits >> bit & 1 != 0).map(move |bit| word * IN_WORD + bit)
        })
    }

    /// Silences the bells of all axes but those that still hold something.
    pub fn silence(&mut self, mut holds: impl FnMut(usize) -> bool) {
        for (word, bits) in self.rung.iter_mut().enumerate() {
            for bit in 0..IN_WORD {
                if *bits >> bit & 1 != 0 && !holds(word * IN_WORD + bit) {
                    *bits &= !(1 << bit);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_bell_is_that_of_its_axis_and_rings_until_it_is_silenced() {
        let mut bells = Bells::new(130);
        let ends: Vec<Bell> = (0..130).map(|axis| bells.bell(axis)).collect();
        assert!(!bells.take());
        for axis in [0, 63, 64, 129] {
            ends[axis].ring();
            assert!(bells.take() && bells.take(), "{axis}");
            assert_eq!((bells.rung().collect::<Vec<_>>(), bells.are_silent()), (vec![axis], false));
            bells.silence(|_| false);
            assert!(bells.are_silent());
            assert!(!bells.take(), "{axis}");
        }
        for axis in [129, 64, 65] {
            ends[axis].ring();
        }
        assert!(bells.take());
        bells.silence(|axis| axis != 65);
        assert!(bells.take(), "two are kept");
        assert_eq!(bells.rung().collect::<Vec<_>>(), [64, 129]);
    }
}
