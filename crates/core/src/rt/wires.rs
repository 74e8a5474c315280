//! Who may use the wires: one word that the loop reads before each batch, and that is taken from a loop whose cycle
//! does not end: by the watch, a thread of its process, or by the guardian, another process.
//!
//! The word can be taken while the loop is between its check and its send: no order of memory closes that window, and
//! nothing can call a request back. So whoever takes it sends the stop again and again, until the loop has
//! [given way](Wires::give_way): what the loop sent before that is followed by a stop, and it sends nothing after that.
//! The guardian takes it from the watch, too, if that gives no sign of life either.
//!
//! Knows nothing of protocols and cycles.

use std::sync::atomic::Ordering;

use crossbeam::utils::CachePadded;

use super::{Held, Regions};
use crate::sync::AtomicU64;

/// Who owns them, in the lowest bits of the word. 0: the loop.
const OWNER: u64 = 0b11;
/// The loop has found them taken, and sends nothing more.
const GAVE_WAY: u64 = 1 << 2;
/// Nothing is left to be done: the loop has ended by itself, or the stop in its place has.
const ENDED: u64 = 1 << 3;

/// Who takes the wires from the loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Taker {
    /// The watch.
    Watch = 1,
    /// The guardian.
    Guardian = 2,
}

/// The word, the signs of life, and what the watch makes of them. Clones are the same; each machine has its own.
#[derive(Clone, Debug, Default)]
pub struct Wires(Held<Words>);

/// The state that the threads of a machine share, and its guardian with them.
#[derive(Debug, Default)]
#[repr(C)]
pub struct Words {
    /// Written by the loop in every cycle, read by the watch and the guardian now and then.
    turns: CachePadded<AtomicU64>,
    /// Read by the loop and by all readers of feedback, written when something is wrong.
    verdict: CachePadded<Verdict>,
}

#[derive(Debug, Default)]
#[repr(C)]
struct Verdict {
    owner: AtomicU64,
    /// For how many cycles the loop has given no sign of life.
    silent: AtomicU64,
    /// 1: whoever waits for the end of the loop need not wait any longer.
    over: AtomicU64,
    /// Signs of life of a watch that stops the drives.
    rounds: AtomicU64,
}

impl Wires {
    /// Those of this memory.
    pub fn of(words: Held<Words>) -> Wires {
        Wires(words)
    }

    /// Their memory.
    pub fn words(&self) -> &Held<Words> {
        &self.0
    }

    fn verdict(&self) -> &Verdict {
        &self.0.first().verdict
    }
}

/// The loop's side.
impl Wires {
    /// Adds the memory that it touches, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(self.0.first());
    }

    /// A sign of life: one of its turns begins.
    #[inline]
    pub fn turn(&self) {
        add_one(&self.0.first().turns);
    }

    /// Whether they were taken from the loop. The acquire keeps a send behind its check.
    #[inline]
    pub fn are_taken(&self) -> bool {
        self.verdict().owner.load(Ordering::Acquire) != 0
    }

    /// The loop has found them taken and sends nothing more. The release orders its last send before that.
    pub fn give_way(&self) {
        self.verdict().owner.fetch_or(GAVE_WAY, Ordering::Release);
    }

    /// The loop has ended. False if the wires were taken meanwhile.
    pub fn end(&self) -> bool {
        self.exchange(0, ENDED)
    }
}

/// A count with one writer.
#[inline]
fn add_one(count: &AtomicU64) {
    count.store(count.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
}

/// The side of the watch and of the guardian.
impl Wires {
    /// Signs of life so far; 0: the loop has not begun.
    pub fn signs(&self) -> u64 {
        let turns = self.0.first().turns.load(Ordering::Relaxed);
        turns.wrapping_add(self.verdict().rounds.load(Ordering::Relaxed))
    }

    /// Takes them from the loop; the guardian takes them from the watch, too. False if there is nothing to be taken: it
    /// has ended, or somebody else was first.
    pub fn take(&self, taker: Taker) -> bool {
        let found = self.verdict().owner.load(Ordering::Acquire);
        let is_free = match taker {
            Taker::Watch => found == 0,
            Taker::Guardian => found & ENDED == 0 && found & OWNER != Taker::Guardian as u64,
        };
        is_free && (self.exchange(found, found & GAVE_WAY | taker as u64) || self.take(taker))
    }

    fn exchange(&self, from: u64, to: u64) -> bool {
        self.verdict().owner.compare_exchange(from, to, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Who has taken them.
    pub fn taker(&self) -> Option<Taker> {
        let owner = self.verdict().owner.load(Ordering::Acquire) & OWNER;
        [Taker::Watch, Taker::Guardian].into_iter().find(|taker| *taker as u64 == owner)
    }

    /// Whether the loop has given way. The acquire orders what is sent after that behind the loop's last send.
    pub fn gave_way(&self) -> bool {
        self.verdict().owner.load(Ordering::Acquire) & GAVE_WAY != 0
    }

    /// Whether nothing is left to be done.
    pub fn have_ended(&self) -> bool {
        self.verdict().owner.load(Ordering::Acquire) & ENDED != 0
    }

    /// The stop by `taker` is complete, and the loop has given way. False: somebody else has taken them.
    pub fn set_ended(&self, taker: Taker) -> bool {
        let taken = GAVE_WAY | taker as u64;
        self.exchange(taken, taken | ENDED)
    }

    /// A sign of life of the watch while it stops the drives.
    pub fn round(&self) {
        add_one(&self.verdict().rounds);
    }

    /// Publishes for how many cycles the loop has given no sign of life.
    pub fn publish_silence(&self, cycles: u64) {
        let silent = &self.verdict().silent;
        // Readers share its cache line: it is written when it changes only.
        if silent.load(Ordering::Relaxed) != cycles {
            silent.store(cycles, Ordering::Relaxed);
        }
    }

    /// Whoever waits for the end of the loop need not wait any longer: all that can be done without it was done.
    pub fn set_over(&self) {
        self.verdict().over.store(1, Ordering::Release);
    }
}

/// The values that every thread may read.
impl Wires {
    /// For how many cycles the loop has given no sign of life, as far as the watch has noticed.
    #[inline]
    pub fn silence(&self) -> u64 {
        self.verdict().silent.load(Ordering::Relaxed)
    }

    /// Whether the loop is stuck, or was: the wires were taken from it.
    pub fn is_stuck(&self) -> bool {
        self.taker().is_some()
    }

    /// Whether nobody need wait for the end of the loop any longer.
    pub fn is_over(&self) -> bool {
        self.verdict().over.load(Ordering::Acquire) == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Taker::{Guardian, Watch};

    #[test]
    fn they_are_taken_once_by_each_and_never_from_a_loop_that_has_ended() {
        for (first, second) in [(Watch, Some(Guardian)), (Guardian, None)] {
            let wires = Wires::default();
            assert!(!wires.are_taken() && !wires.is_stuck() && wires.taker().is_none());
            assert!(wires.take(first) && !wires.take(first) && !wires.take(Watch));
            assert_eq!(wires.taker(), Some(first));
            assert!(wires.are_taken() && wires.is_stuck() && !wires.gave_way() && !wires.end());
            assert!(!wires.set_ended(first), "the loop has not given way");
            wires.give_way();
            assert!(wires.gave_way() && !wires.have_ended() && wires.taker() == Some(first));
            // The loop has given way to whoever takes them from the watch.
            if let Some(second) = second {
                assert!(wires.take(second) && wires.taker() == Some(second) && wires.gave_way());
                assert!(!wires.set_ended(first));
            }
            assert!(wires.set_ended(second.unwrap_or(first)));
            assert!(wires.have_ended() && wires.is_stuck() && !wires.take(Guardian));
        }
        let ended = Wires::default();
        assert!(ended.end() && !ended.take(Watch) && !ended.take(Guardian));
        assert!(ended.have_ended() && !ended.is_stuck() && ended.are_taken());
    }

    #[test]
    fn a_watch_that_stops_the_drives_gives_signs_of_life_in_place_of_the_loop() {
        let wires = Wires::default();
        assert_eq!(wires.signs(), 0);
        wires.turn();
        wires.round();
        assert_eq!(wires.signs(), 2);
    }
}
