//! Samples in binary, as the page reads them. Little-endian, in pieces of eight bytes:
//!
//! | bytes | what |
//! |---|---|
//! | 1 | 2: the version of this layout |
//! | 1 | the cycles of a sample: of several, each value is a pair of their least and greatest |
//! | 2 | number of signals |
//! | 4 | number of samples |
//! | 4 each | the numbers of the signals, filled up to eight bytes |
//! | 8 each | the instants of the samples, s, of an envelope that of its first cycle |
//! | 8 each | their cycles |
//! | 8 each | signal by signal its values; of an envelope all least ones, then all greatest ones |

use std::collections::BTreeSet;

use super::samples::Block;
use super::signals::axis_of;

/// The number of axes that are shown cycle by cycle; of more, envelopes.
const MOST_WHOLE_AXES: usize = 4;

/// The samples of an envelope in a second.
const ENVELOPES_A_SECOND: f64 = 100.0;

/// The signals that a browser shows.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Shown {
    signals: Vec<usize>,
    axes: usize,
}

impl Shown {
    /// These signals, each once.
    pub fn new(mut signals: Vec<usize>) -> Shown {
        signals.sort_unstable();
        signals.dedup();
        let axes: BTreeSet<usize> = signals.iter().filter_map(|signal| axis_of(*signal)).collect();
        Shown { signals, axes: axes.len() }
    }

    /// Cycles that are one sample.
    fn thinning(&self, period_s: f64) -> u8 {
        match self.axes > MOST_WHOLE_AXES {
            true => ((1.0 / ENVELOPES_A_SECOND / period_s) as u8).max(1),
            false => 1,
        }
    }

    /// The frame of a block; `None` if nothing of it is shown.
    pub fn frame(&self, block: &Block, period_s: f64) -> Option<Vec<u8>> {
        let known: Vec<(usize, &[f64])> = (self.signals.iter())
            .filter_map(|signal| Some((*signal, block.columns.get(*signal)?.as_slice())))
            .collect();
        let each = self.thinning(period_s);
        let (is_envelope, thinning) = (each > 1, usize::from(each));
        let samples = block.times.len().div_ceil(thinning);
        if known.is_empty() || samples == 0 {
            return None;
        }
        let mut bytes = Vec::with_capacity(16 + 4 * known.len() + 16 * samples * (known.len() + 1));
        bytes.extend([2, each]);
        bytes.extend((known.len() as u16).to_le_bytes());
        bytes.extend((samples as u32).to_le_bytes());
        known.iter().for_each(|(signal, _)| bytes.extend((*signal as u32).to_le_bytes()));
        bytes.resize(bytes.len().next_multiple_of(8), 0);
        let mut put = |value: f64| bytes.extend(value.to_le_bytes());
        for firsts in [&block.times, &block.cycles] {
            firsts.iter().step_by(thinning).for_each(|value| put(*value));
        }
        for (_, values) in known {
            if !is_envelope {
                values.iter().for_each(|value| put(*value));
                continue;
            }
            // NaN is neither: of nothing but NaN both are NaN.
            for extreme in [f64::min, f64::max] {
                let of = |values: &[f64]| values.iter().copied().fold(f64::NAN, extreme);
                values.chunks(thinning).for_each(|values| put(of(values)));
            }
        }
        Some(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::super::signals::count;
    use super::*;

    const MS: f64 = 1e-3;

    fn block(cycles: usize, axes: usize) -> Block {
        let times: Vec<f64> = (0..cycles).map(|cycle| cycle as f64 * MS).collect();
        let columns =
            (0..count(axes)).map(|of| (0..cycles).map(|cycle| (of * 1000 + cycle) as f64).collect());
        Block { cycles: times.iter().map(|time| time / MS).collect(), columns: columns.collect(), times }
    }

    /// The numbers behind the head, and the head.
    fn parsed(bytes: &[u8]) -> (u8, usize, Vec<u32>, Vec<f64>) {
        assert_eq!((bytes[0], bytes.len() % 8), (2, 0));
        let signals = usize::from(u16::from_le_bytes([bytes[2], bytes[3]]));
        let samples = u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize;
        let ids = bytes[8..].chunks_exact(4).take(signals);
        let ids = ids.map(|id| u32::from_le_bytes(id.try_into().unwrap())).collect();
        let numbers = bytes[8 + (4 * signals).next_multiple_of(8)..].chunks_exact(8);
        (bytes[1], samples, ids, numbers.map(|n| f64::from_le_bytes(n.try_into().unwrap())).collect())
    }

    #[test]
    fn up_to_four_axes_are_whole_and_more_are_envelopes() {
        let (block, of) = (block(25, 5), |axis: usize| count(axis));
        let whole = Shown::new((0..4).map(of).collect()).frame(&block, MS).unwrap();
        let (each, samples, ids, numbers) = parsed(&whole);
        assert_eq!((each, samples, ids.len(), numbers.len()), (1, 25, 4, 25 * 6));
        assert_eq!(numbers[2 * 25..2 * 25 + 3], block.columns[of(0)][..3]);
        let thin = Shown::new((0..5).map(of).collect()).frame(&block, MS).unwrap();
        let (each, samples, ids, numbers) = parsed(&thin);
        // The last one is of five cycles.
        assert_eq!((each, samples, ids[4] as usize, numbers.len()), (10, 3, of(4), 3 * (2 + 2 * 5)));
        assert_eq!(numbers[..6], [0.0, 10.0 * MS, 20.0 * MS, 0.0, 10.0, 20.0]);
        let base = of(0) as f64 * 1000.0;
        assert_eq!(
            numbers[6..12].iter().map(|n| n - base).collect::<Vec<_>>(),
            [0.0, 10.0, 20.0, 9.0, 19.0, 24.0]
        );
    }

    #[test]
    fn signals_that_a_machine_does_not_have_are_left_out() {
        let block = block(2, 1);
        assert_eq!(Shown::new(vec![count(1), usize::MAX]).frame(&block, MS), None);
        let (_, _, ids, _) = parsed(&Shown::new(vec![count(1), 0]).frame(&block, MS).unwrap());
        assert_eq!(ids, [0]);
        assert_eq!(Shown::new(vec![0]).frame(&Block::default(), MS), None);
    }

    #[test]
    fn an_envelope_is_of_whole_cycles_and_a_slow_cycle_is_never_thinned() {
        let shown = Shown::new((0..8).map(count).collect());
        for (period_ms, each) in [(0.05, 200), (0.25, 40), (4.0, 2), (8.0, 1), (10.0, 1)] {
            assert_eq!(parsed(&shown.frame(&block(3, 8), period_ms * MS).unwrap()).0, each, "{period_ms} ms");
        }
    }
}
