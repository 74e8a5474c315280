//! The newest value from one thread to another: a triple buffer over atomic words, without `unsafe`.
//!
//! Both ends are wait-free. Unlike in a queue nothing is ever full: a value that the reader has not taken is replaced
//! by the next one.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};

use crossbeam::utils::CachePadded;

use super::command::{CommandId, Setpoint};
use crate::rt::Regions;

/// The value in the shared slot was not taken yet.
const FRESH: u8 = 4;
const INDEX: u8 = 3;

#[derive(Debug, Default)]
struct Shared {
    /// Three setpoints: one belongs to the writer, one to the reader, one is shared.
    slots: [[AtomicU64; 2]; 3],
    /// The index of the shared one, with [`FRESH`].
    state: AtomicU8,
}

/// The writing end.
#[derive(Debug)]
pub struct NewestIn {
    shared: Arc<CachePadded<Shared>>,
    own: u8,
}

/// The reading end.
#[derive(Debug)]
pub struct NewestOut {
    shared: Arc<CachePadded<Shared>>,
    own: u8,
}

/// Both ends; there is no value yet.
pub fn newest() -> (NewestIn, NewestOut) {
    let shared = Arc::new(CachePadded::new(Shared::default()));
    // The shared slot is 0.
    (NewestIn { shared: Arc::clone(&shared), own: 1 }, NewestOut { shared, own: 2 })
}

impl NewestIn {
    /// Replaces the value.
    pub fn write(&mut self, setpoint: Setpoint) {
        let [of, value] = &self.shared.slots[usize::from(self.own)];
        of.store(setpoint.of.0, Ordering::Relaxed);
        value.store(setpoint.value.to_bits(), Ordering::Relaxed);
        // Releases the words, and acquires those that the reader has read from the other slot.
        self.own = self.shared.state.swap(self.own | FRESH, Ordering::AcqRel) & INDEX;
    }
}

impl NewestOut {
    /// Adds what both ends share, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&**self.shared);
    }

    /// The newest value, once.
    pub fn take(&mut self) -> Option<Setpoint> {
        if self.shared.state.load(Ordering::Relaxed) & FRESH == 0 {
            return None;
        }
        self.own = self.shared.state.swap(self.own, Ordering::AcqRel) & INDEX;
        let [of, value] = &self.shared.slots[usize::from(self.own)];
        let value = f64::from_bits(value.load(Ordering::Relaxed));
        Some(Setpoint { of: CommandId(of.load(Ordering::Relaxed)), value })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn setpoint(n: u64) -> Setpoint {
        Setpoint { of: CommandId(n), value: n as f64 }
    }

    #[test]
    fn only_the_newest_is_taken_and_once() {
        let (mut input, mut output) = newest();
        assert_eq!(output.take(), None);
        for last in [1, 2, 3, 7, 100] {
            (0..=last).for_each(|n| input.write(setpoint(n)));
            assert_eq!([output.take(), output.take()], [Some(setpoint(last)), None]);
        }
    }

    #[test]
    fn a_reader_meets_whole_values_in_rising_order_and_the_last_one() {
        let (mut input, mut output) = newest();
        const LAST: u64 = 200_000;
        let writer = std::thread::spawn(move || (1..=LAST).for_each(|n| input.write(setpoint(n))));
        let mut before = 0;
        while before < LAST {
            if let Some(Setpoint { of, value }) = output.take() {
                assert!(of.0 > before && value == of.0 as f64, "{of:?} {value} after {before}");
                before = of.0;
            } else {
                std::thread::yield_now();
            }
        }
        writer.join().unwrap();
        assert_eq!(output.take(), None);
    }
}
