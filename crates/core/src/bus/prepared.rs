//! What is built and has not left: it has no effect.
//!
//! A telegram is built from the state that all telegrams before it have led to, and its leaving is what changes that
//! state. One that is built again, for this send or a later one, begins from the same state; so what was replaced, or
//! refused by the operating system, leaves nothing behind. Reports of the drive change the state at once: what was
//! built before does not hold any more, and is built again before it leaves.

/// The state that the telegrams which left have led to, and the one behind the telegram that is built.
///
/// A telegram has two revisions: that of what is desired, and that of this state. As long as both are the same, the
/// telegram that was built last holds, but for what is patched in place: setpoint, stamp and count.
///
/// A usual cycle reads only whether it holds: that stands last, on one cache line with what follows in a profile.
#[derive(Clone, Debug)]
#[repr(C)]
pub struct Prepared<T> {
    left: T,
    proposed: T,
    /// Advances with each change of the state.
    revision: u64,
    /// The revisions that the telegram was built for, or [`NONE`].
    built_for: (u64, u64),
    /// The leaving may change the state.
    is_proposed: bool,
    /// The state has changed since it was built.
    is_void: bool,
}

/// No telegram is built: no revision comes to this.
const NONE: (u64, u64) = (u64::MAX, u64::MAX);

impl<T: Clone + PartialEq> Prepared<T> {
    /// Nothing has left.
    pub fn new(state: T) -> Prepared<T> {
        let proposed = state.clone();
        Prepared { revision: 0, built_for: NONE, is_proposed: false, is_void: false, left: state, proposed }
    }

    /// The state that what has left has led to.
    #[inline]
    pub fn left(&self) -> &T {
        &self.left
    }

    /// The same, to be changed by what the telegram that is built does not depend on.
    #[inline]
    pub fn left_mut(&mut self) -> &mut T {
        &mut self.left
    }

    /// The state behind the telegram that is built: what it carries. Once that has left, the same as
    /// [`left`](Self::left).
    #[inline]
    pub fn proposed(&self) -> &T {
        if self.is_proposed { &self.proposed } else { &self.left }
    }

    /// The same, to be worked on further.
    #[inline]
    pub fn proposed_mut(&mut self) -> &mut T {
        if self.is_proposed { &mut self.proposed } else { &mut self.left }
    }

    /// Something was proposed, and has not left.
    #[inline]
    pub fn is_proposed(&self) -> bool {
        self.is_proposed
    }

    /// The revision of the state.
    #[inline]
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// The telegram that was built last has left, and holds for this revision of what is desired. One that has not left
    /// is built again: time has passed.
    #[inline]
    pub fn holds(&self, desired: u64) -> bool {
        !self.is_proposed && self.built_for == (desired, self.revision)
    }

    /// A telegram was built, and the state has changed since: it is to be built again before it leaves.
    #[inline]
    pub fn is_void(&self) -> bool {
        self.is_void
    }

    /// Builds a telegram for this revision of what is desired: the state to be changed is the one behind it.
    pub fn propose(&mut self, desired: u64) -> &mut T {
        self.built_for = (desired, self.revision);
        (self.is_proposed, self.is_void) = (true, false);
        self.proposed.clone_from(&self.left);
        &mut self.proposed
    }

    /// Of a telegram that carries only a part of what was proposed: what its leaving changes in addition, or not.
    #[inline]
    pub fn amend(&mut self, change: impl FnOnce(&mut T)) {
        if self.is_proposed {
            change(&mut self.proposed);
        }
    }

    /// The telegram carries nothing of what was proposed: its leaving changes nothing.
    #[inline]
    pub fn withdraw(&mut self) {
        if std::mem::take(&mut self.is_proposed) && self.proposed != self.left {
            self.built_for = NONE;
        }
    }

    /// The telegram has left. Returns the states before and behind it, if they differ.
    #[inline]
    pub fn leave(&mut self) -> Option<(&T, &T)> {
        let is_new = self.is_proposed && self.proposed != self.left;
        self.is_proposed = false;
        is_new.then(|| self.take_over())
    }

    /// The same of a telegram that is known to be another one.
    #[inline(never)]
    pub fn take_over(&mut self) -> (&T, &T) {
        (self.is_proposed, self.revision) = (false, self.revision + 1);
        std::mem::swap(&mut self.left, &mut self.proposed);
        (&self.proposed, &self.left)
    }

    /// Changes the state by what is no telegram: a report of the drive, a new connection. A telegram that was built is
    /// void.
    pub fn change<R>(&mut self, change: impl FnOnce(&mut T) -> R) -> R {
        self.revision += 1;
        self.is_void |= std::mem::replace(&mut self.built_for, NONE) != NONE;
        self.is_proposed = false;
        change(&mut self.left)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The state after a sequence of telegrams is that of those that left, whatever was built in between.
    #[test]
    fn only_what_left_counts() {
        for seed in 0..1_000 {
            let mut random = fastrand::Rng::with_seed(seed);
            let (mut prepared, mut model) = (Prepared::new(0_u64), 0_u64);
            for desired in 0..200 {
                for _ in 0..random.u8(..4) {
                    let of = desired + random.u64(1_000..2_000);
                    *prepared.propose(of) += random.u64(..3);
                    if random.u8(..4) == 0 {
                        // A report between building and leaving.
                        for _ in 0..random.u8(1..3) {
                            prepared.change(|state| *state ^= 8);
                            model ^= 8;
                            assert!(prepared.is_void() && !prepared.holds(of));
                        }
                    }
                }
                if random.bool() {
                    let more = random.u64(..3);
                    *prepared.propose(desired) += more;
                    assert!(!prepared.holds(desired) && *prepared.proposed() == model + more);
                    let (before, revision) = (model, prepared.revision());
                    model += more;
                    assert_eq!(prepared.leave(), (model != before).then_some((&before, &model)));
                    assert_eq!(prepared.revision() != revision, model != before);
                    assert_eq!(prepared.leave(), None, "it leaves once");
                    assert_eq!(prepared.holds(desired), model == before);
                }
                if random.u8(..4) == 0 {
                    prepared.change(|state| *state += 1);
                    model += 1;
                }
                assert_eq!(*prepared.left(), model);
            }
        }
    }
}
