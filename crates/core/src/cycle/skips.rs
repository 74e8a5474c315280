//! How many of the last slots were skipped: a loop that executes now and then a slot is out of control, too.

/// The number of slots that are counted.
pub const SLOTS: u32 = 100;

/// The last slots.
#[derive(Clone, Copy, Debug)]
pub struct Skips {
    /// A bit for each of the last [`SLOTS`], the newest lowest: 1 = skipped.
    recent: u128,
    most: u32,
}

impl Skips {
    /// At most this share of the last slots may be skipped.
    pub fn new(most: f64) -> Skips {
        Skips { recent: 0, most: (most * f64::from(SLOTS)).round() as u32 }
    }

    /// A slot was executed.
    pub fn executed(&mut self) {
        self.recent = (self.recent << 1) & LAST;
    }

    /// Enters `count` skipped slots. True if too many of the last ones were skipped.
    pub fn skipped(&mut self, count: u64) -> bool {
        let count = count.min(SLOTS.into()) as u32;
        self.recent = ((self.recent << count) | ((1 << count) - 1)) & LAST;
        self.recent.count_ones() > self.most
    }
}

const LAST: u128 = (1 << SLOTS) - 1;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_of_the_last_hundred_counts_however_it_is_spread() {
        let mut skips = Skips::new(0.2);
        // Every fifth: 20 of 100 for ever.
        for _ in 0..1_000 {
            (0..4).for_each(|_| skips.executed());
            assert!(!skips.skipped(1));
        }
        // Nine of ten: the limit is passed in the first turns.
        let turns = (1..).find(|_| {
            skips.executed();
            skips.skipped(9)
        });
        assert_eq!(turns, Some(1));
        let mut skips = Skips::new(0.2);
        let turns = (1..).find(|_| {
            skips.executed();
            skips.skipped(9)
        });
        assert_eq!(turns, Some(3), "21 of the first 30");
        (0..100).for_each(|_| skips.executed());
        assert!(!skips.skipped(20) && skips.skipped(1), "what is older than 100 slots is forgotten");
        assert!(!Skips::new(1.0).skipped(u64::MAX), "all of them may be");
    }
}
