//! The histograms of a run, part by part: how far they differ between parts says how far two runs may differ by chance,
//! and whether a run drifts. A whole run has 16 to 32 parts of equal length, however long it is.

use super::bins::Bins;
use crate::histograms::Histograms;

/// The most parts. When there are so many, each two become one.
const MOST: usize = 32;

/// The first length of a part, cycles.
const SHORTEST: u64 = 512;

/// One part.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Part {
    /// Slots of the grid.
    pub cycles: u64,
    /// Wake-up latencies, skipped slots included.
    pub wake: Bins,
    /// Round trips of each drive.
    pub rtt: Vec<Bins>,
}

impl Part {
    fn merge(&mut self, other: &Part) {
        self.cycles += other.cycles;
        self.wake.add(&other.wake);
        self.rtt.resize(self.rtt.len().max(other.rtt.len()), Bins::default());
        self.rtt.iter_mut().zip(&other.rtt).for_each(|(one, other)| one.add(other));
    }

    /// All that was measured so far.
    fn whole(histograms: &Histograms, cycles: u64) -> Part {
        let rtt = histograms.drives.iter().map(|drive| Bins::of(&drive.rtt)).collect();
        Part { cycles, wake: Bins::of(&histograms.wake), rtt }
    }

    fn since(&self, earlier: &Part) -> Part {
        let none = Bins::default();
        let before = earlier.rtt.iter().chain(std::iter::repeat(&none));
        Part {
            cycles: self.cycles - earlier.cycles,
            wake: self.wake.since(&earlier.wake),
            rtt: self.rtt.iter().zip(before).map(|(now, before)| now.since(before)).collect(),
        }
    }
}

/// Puts parts together until there are few enough, and none is shorter than half of the longest: where parts are drawn
/// or counted, each stands for about as many cycles as any other. Those of two runs may be of any length.
pub fn bound(parts: &mut Vec<Part>) {
    while parts.len() > MOST {
        halve(parts);
    }
    let is_short = |parts: &[Part]| {
        let longest = parts.iter().map(|part| part.cycles).max()?;
        parts.iter().position(|part| 2 * part.cycles < longest)
    };
    while let Some(short) = is_short(parts) {
        let part = parts.remove(short);
        // The shorter one of its neighbours takes it; there is one, since another part is longer.
        let before = short.checked_sub(1);
        let cycles = |place: &usize| parts.get(*place).map_or(u64::MAX, |part| part.cycles);
        let place = before.into_iter().chain([short]).min_by_key(cycles).unwrap_or(short);
        if let Some(neighbour) = parts.get_mut(place) {
            neighbour.merge(&part);
        }
    }
}

/// Each two become one.
fn halve(parts: &mut Vec<Part>) {
    *parts = parts.chunks(2).map(together).collect();
}

/// Several parts as one.
pub fn together<'a>(parts: impl IntoIterator<Item = &'a Part>) -> Part {
    let mut all = Part::default();
    parts.into_iter().for_each(|part| all.merge(part));
    all
}

/// The parts of a run that goes on.
#[derive(Clone, Debug)]
pub struct Parts {
    /// Those that are complete.
    parts: Vec<Part>,
    width: u64,
    /// The begin of the one under way, and all that was measured up to there.
    begin: u64,
    before: Part,
}

impl Default for Parts {
    fn default() -> Parts {
        Parts { parts: Vec::new(), width: SHORTEST, begin: 0, before: Part::default() }
    }
}

impl Parts {
    /// Cycle `index` was entered into `histograms` last.
    pub fn look(&mut self, index: u64, histograms: &Histograms) {
        if index < self.begin + self.width {
            return;
        }
        let whole = Part::whole(histograms, index);
        self.parts.push(whole.since(&self.before));
        (self.begin, self.before) = (index, whole);
        if self.parts.len() == MOST {
            halve(&mut self.parts);
            self.width *= 2;
        }
    }

    /// All parts, that under way included: with the last one, unless it is as long as half a part.
    pub fn list(&self, planned: u64, histograms: &Histograms) -> Vec<Part> {
        let mut parts = self.parts.clone();
        let rest = Part::whole(histograms, planned.max(self.begin)).since(&self.before);
        match parts.last_mut() {
            Some(last) if rest.cycles < self.width / 2 => last.merge(&rest),
            _ if rest.cycles > 0 => parts.push(rest),
            _ => {}
        }
        bound(&mut parts);
        parts
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::cycle::record::{CycleRecord, Record};
    use fieldbeat_core::time::MS;

    #[test]
    fn parts_of_two_runs_weigh_alike_however_long_each_run_was() {
        let run = |parts: u64, cycles: u64| {
            (0..parts).map(move |_| Part {
                cycles,
                wake: Bins::from_list([(1_000, cycles)]),
                rtt: Vec::new(),
            })
        };
        // A day and some minutes, minutes and a day, a short time between two long ones, and what is even already.
        let cases: [(Vec<Part>, usize); 5] = [
            (run(20, 1_000).chain(run(8, 10)).collect(), 20),
            (run(20, 10).chain(run(8, 1_000)).collect(), 8),
            (run(8, 1_000).chain(run(1, 10)).chain(run(8, 1_000)).collect(), 16),
            (run(20, 1_000).chain(run(8, 600)).collect(), 28),
            (run(1, 10).collect(), 1),
        ];
        for (mut parts, count) in cases {
            let whole = together(&parts);
            bound(&mut parts);
            assert_eq!((parts.len(), together(&parts)), (count, whole));
            let lengths = parts.iter().map(|part| part.cycles);
            assert!(2 * lengths.clone().min().unwrap() >= lengths.max().unwrap());
        }
    }

    #[test]
    fn parts_are_few_of_equal_length_and_nothing_is_lost() {
        for cycles in [100, 5_000, 1_000_000] {
            let (mut histograms, mut parts) = (Histograms::new(2), Parts::default());
            for index in 0..cycles {
                let wake_ns = 1_000 + (index / 1_000) as u32;
                histograms
                    .enter(&Record::Cycle(CycleRecord { index, wake_ns, ..CycleRecord::default() }), MS);
                parts.look(index, &histograms);
            }
            let list = parts.list(cycles, &histograms);
            assert!(list.len() <= MOST && (cycles < 20_000 || list.len() >= MOST / 2), "{}", list.len());
            assert_eq!(together(&list).cycles, cycles);
            assert_eq!(together(&list).wake, Bins::of(&histograms.wake));
            let lengths = list.iter().rev().skip(1).map(|part| part.cycles);
            assert_eq!(lengths.clone().min(), lengths.max());
            assert!(list.iter().all(|part| part.rtt.len() == 2));
            if cycles == 1_000_000 {
                let medians: Vec<_> = list.iter().filter_map(|part| part.wake.quantile(0.5)).collect();
                assert!(medians.is_sorted() && medians[0] < medians[medians.len() - 1], "{medians:?}");
            }
        }
    }
}
