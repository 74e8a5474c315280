//! Who may use the wires: one word that the loop reads before each batch, and that the watch takes from a loop whose
//! cycle does not end.
//!
//! The word can be taken while the loop is between its check and its send: no order of memory closes that window, and
//! nothing can call a request back. So the thread that takes it sends its stop again and again, until the loop has
//! [given way](Wires::give_way): what the loop sent before that is followed by a stop, and it sends nothing after that.
//!
//! Knows nothing of protocols and cycles.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use crossbeam::utils::CachePadded;

use super::Regions;
use crate::sync::AtomicU64;

/// The loop owns the wires.
const LOOP: u64 = 0;
/// They were taken from it.
const TAKEN: u64 = 1;
/// It has found that, and sends nothing more.
const GAVE_WAY: u64 = 2;
/// It has ended by itself.
const ENDED: u64 = 3;

/// The word, the loop's sign of life, and what the watch makes of it. Clones are the same; each machine has its own.
#[derive(Clone, Debug)]
pub struct Wires(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    /// Written by the loop in every cycle, read by the watch now and then.
    turns: CachePadded<AtomicU64>,
    /// Read by the loop and by all readers of feedback, written when something is wrong.
    verdict: CachePadded<Verdict>,
}

#[derive(Debug)]
struct Verdict {
    owner: AtomicU64,
    /// For how many cycles the loop has given no sign of life.
    silent: AtomicU64,
    /// 1: whoever waits for the end of the loop need not wait any longer.
    over: AtomicU64,
}

impl Default for Wires {
    fn default() -> Wires {
        let verdict =
            Verdict { owner: AtomicU64::new(LOOP), silent: AtomicU64::new(0), over: AtomicU64::new(0) };
        Wires(Arc::new(Shared {
            turns: CachePadded::new(AtomicU64::new(0)),
            verdict: CachePadded::new(verdict),
        }))
    }
}

/// The loop's side.
impl Wires {
    /// Adds the memory that it touches, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.0);
    }

    /// A sign of life: one of its turns begins.
    #[inline]
    pub fn turn(&self) {
        let turns = &self.0.turns;
        // The only writer.
        turns.store(turns.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
    }

    /// Whether they were taken from the loop. The acquire keeps a send behind its check.
    #[inline]
    pub fn are_taken(&self) -> bool {
        self.0.verdict.owner.load(Ordering::Acquire) != LOOP
    }

    /// The loop has found them taken and sends nothing more. The release orders its last send before that.
    pub fn give_way(&self) {
        self.0.verdict.owner.store(GAVE_WAY, Ordering::Release);
    }

    /// The loop has ended. False if the wires were taken meanwhile.
    pub fn end(&self) -> bool {
        self.exchange(ENDED)
    }
}

/// The watch's side.
impl Wires {
    /// The loop's turns so far; 0: it has not begun.
    pub fn turns(&self) -> u64 {
        self.0.turns.load(Ordering::Relaxed)
    }

    /// Takes them from the loop. False if it has ended.
    pub fn take(&self) -> bool {
        self.exchange(TAKEN)
    }

    fn exchange(&self, to: u64) -> bool {
        self.0.verdict.owner.compare_exchange(LOOP, to, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Whether the loop has given way. The acquire orders what is sent after that behind the loop's last send.
    pub fn gave_way(&self) -> bool {
        self.0.verdict.owner.load(Ordering::Acquire) == GAVE_WAY
    }

    /// Whether the loop has ended by itself.
    pub fn have_ended(&self) -> bool {
        self.0.verdict.owner.load(Ordering::Acquire) == ENDED
    }

    /// Publishes for how many cycles the loop has given no sign of life.
    pub fn publish_silence(&self, cycles: u64) {
        let silent = &self.0.verdict.silent;
        // Readers share its cache line: it is written when it changes only.
        if silent.load(Ordering::Relaxed) != cycles {
            silent.store(cycles, Ordering::Relaxed);
        }
    }

    /// Whoever waits for the end of the loop need not wait any longer: all that can be done without it was done.
    pub fn set_over(&self) {
        self.0.verdict.over.store(1, Ordering::Release);
    }
}

/// What everybody may read.
impl Wires {
    /// For how many cycles the loop has given no sign of life, as far as the watch has noticed.
    #[inline]
    pub fn silence(&self) -> u64 {
        self.0.verdict.silent.load(Ordering::Relaxed)
    }

    /// Whether the loop is stuck, or was: the wires were taken from it.
    pub fn is_stuck(&self) -> bool {
        matches!(self.0.verdict.owner.load(Ordering::Acquire), TAKEN | GAVE_WAY)
    }

    /// Whether nobody need wait for the end of the loop any longer.
    pub fn is_over(&self) -> bool {
        self.0.verdict.over.load(Ordering::Acquire) == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn they_are_taken_once_and_never_from_a_loop_that_has_ended() {
        let wires = Wires::default();
        assert!(!wires.are_taken() && !wires.is_stuck());
        assert!(wires.take() && !wires.take());
        assert!(wires.are_taken() && wires.is_stuck() && !wires.gave_way() && !wires.end());
        wires.give_way();
        assert!(wires.are_taken() && wires.is_stuck() && wires.gave_way() && !wires.have_ended());

        let ended = Wires::default();
        assert!(ended.end() && !ended.take());
        assert!(ended.have_ended() && !ended.is_stuck());
    }
}
