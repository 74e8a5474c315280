//! Values over the time of a run in bounded memory: one of each stretch of cycles. When the stretches grow too many,
//! each two become one.

use std::num::NonZeroU64;

/// The most stretches: more than a plot is wide. Even, so that two always become one.
pub const MOST: usize = 1024;

/// The operations that two stretches have in common.
pub trait Merge: Copy + Default {
    /// Takes in what the other one has.
    fn merge(&mut self, other: Self);
}

/// A value of each stretch of cycles, from cycle 0 on.
#[derive(Clone, Debug)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Stretches<T> {
    /// No file has a width of 0 that is taken for one.
    width: NonZeroU64,
    list: Vec<T>,
}

impl<T: Merge> Default for Stretches<T> {
    fn default() -> Stretches<T> {
        Stretches { width: NonZeroU64::MIN, list: Vec::with_capacity(MOST) }
    }
}

impl<T: Merge> Stretches<T> {
    /// How many cycles a stretch is long.
    pub fn width(&self) -> u64 {
        self.width.get()
    }

    /// The stretches, in their order.
    pub fn list(&self) -> &[T] {
        &self.list
    }

    /// The stretch of cycle `index`.
    #[inline]
    pub fn at(&mut self, index: u64) -> &mut T {
        let place = self.place(index);
        let place = if place < self.list.len() as u64 { place } else { self.reach(index) };
        &mut self.list[place as usize]
    }

    /// The place of the stretch of cycle `index`.
    #[inline]
    fn place(&self, index: u64) -> u64 {
        // Without a division unless a file says otherwise.
        let width = self.width.get();
        if width.is_power_of_two() { index >> width.trailing_zeros() } else { index / width }
    }

    /// The same, once there is one.
    #[inline(never)]
    fn reach(&mut self, index: u64) -> u64 {
        while self.place(index) >= MOST as u64 {
            self.halve();
        }
        let place = self.place(index);
        self.list.resize(self.list.len().max(place as usize + 1), T::default());
        place
    }

    /// Each two become one.
    fn halve(&mut self) {
        self.width = self.width.saturating_add(self.width.get());
        for pair in 0..self.list.len().div_ceil(2) {
            let mut both = self.list[2 * pair];
            both.merge(self.list.get(2 * pair + 1).copied().unwrap_or_default());
            self.list[pair] = both;
        }
        self.list.truncate(self.list.len().div_ceil(2));
    }

    /// Appends the stretches of a later run, whose cycle 0 was at `begin`. Each of them goes to the stretch in which it
    /// began.
    pub fn append(&mut self, begin: u64, later: &Stretches<T>) {
        for (place, stretch) in later.list.iter().enumerate() {
            self.at(begin + place as u64 * later.width()).merge(*stretch);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Merge for u64 {
        fn merge(&mut self, other: u64) {
            *self += other;
        }
    }

    #[test]
    fn merged_stretches_keep_every_count() {
        let mut all = Stretches::default();
        for index in (0..5_000_000_000).step_by(1_000_003) {
            *all.at(index) += 1;
            assert!(all.list().len() <= MOST);
        }
        assert_eq!(all.list().iter().sum::<u64>(), 5_000);
        assert!(all.width() * MOST as u64 >= 5_000_000_000 && all.width().is_power_of_two());
    }

    #[test]
    fn a_later_run_is_appended_at_its_begin() {
        let (mut all, mut later) = (Stretches::default(), Stretches::default());
        *all.at(0) = 1;
        *later.at(0) = 2;
        *later.at(700) = 4;
        all.append(1_000, &later);
        assert_eq!((all.width(), all.list()[0], all.list()[500], all.list()[850]), (2, 1, 2, 4));
        let damaged = r#"{ "width": 0, "list": [] }"#;
        assert!(serde_json::from_str::<Stretches<u64>>(damaged).is_err());
    }
}
