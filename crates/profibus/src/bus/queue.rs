//! Whose turn is next.

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

    /// This drive waits.
    #[inline]
    pub(super) fn push(&mut self, index: u8) {
        self.waiting |= 1 << (index & 0x7F);
    }

    /// The next one has its turn.
    #[inline]
    pub(super) fn pop(&mut self) -> Option<u8> {
        let behind = self.waiting & self.behind;
        let of = if behind == 0 { self.waiting } else { behind };
        let bit = of & of.wrapping_neg();
        self.waiting ^= bit;
        self.behind = !(bit | bit.wrapping_sub(1));
        (bit != 0).then_some(of.trailing_zeros() as u8)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_have_their_turn_before_one_has_it_again() {
        let mut queue = Queue::default();
        assert_eq!((queue.pop(), queue.is_empty()), (None, true));
        [125, 0, 7].into_iter().for_each(|index| queue.push(index));
        assert_eq!(queue.pop(), Some(0));
        // Behind the last one, and before it.
        [3, 0].into_iter().for_each(|index| queue.push(index));
        assert_eq!(std::array::from_fn(|_| queue.pop()), [Some(3), Some(7), Some(125), Some(0), None]);
    }
}
