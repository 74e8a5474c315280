//! Whose turn is next.

/// Each of them may have its turn.
pub(super) const ALL: u128 = u128::MAX;

/// Drives that wait for their turn, a bit each: round and round, in the order of the plan.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Queue {
    waiting: u128,
    /// Those behind the last one that had its turn.
    behind: u128,
}

impl Queue {
    #[inline]
    pub(super) fn is_empty(&self) -> bool {
        self.waiting == 0
    }

    /// The drive of this bit waits.
    #[inline]
    pub(super) fn push(&mut self, bit: u128) {
        self.waiting |= bit;
    }

    /// The drives that wait.
    pub(super) fn waiting(&self) -> u128 {
        self.waiting
    }

    /// The next one of those that `may` have its turn.
    #[inline]
    pub(super) fn pop(&mut self, may: u128) -> Option<u8> {
        let waiting = self.waiting & may;
        let behind = waiting & self.behind;
        let of = if behind == 0 { waiting } else { behind };
        if of == 0 {
            return None;
        }
        // All bits up to its own.
        let done = of ^ (of - 1);
        self.waiting ^= of & done;
        self.behind = !done;
        Some(of.trailing_zeros() as u8)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_have_their_turn_before_one_has_it_again() {
        let mut queue = Queue::default();
        assert_eq!((queue.pop(ALL), queue.is_empty()), (None, true));
        [125, 0, 7].into_iter().for_each(|index| queue.push(1 << index));
        assert_eq!((queue.pop(1 << 3), queue.pop(ALL)), (None, Some(0)));
        // Behind the last one, and before it.
        [3, 0].into_iter().for_each(|index| queue.push(1 << index));
        // One that may not yet is passed over, and comes with the next round.
        assert_eq!(queue.pop(!(1 << 3)), Some(7));
        assert_eq!(std::array::from_fn(|_| queue.pop(ALL)), [Some(125), Some(0), Some(3), None]);
    }
}
