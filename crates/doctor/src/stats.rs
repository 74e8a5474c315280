//! Quantiles of samples taken in slices, and their ratios, each with a bootstrap interval.
//!
//! Values of one slice are not independent of each other: whatever disturbed the machine disturbed many of them. So
//! whole slices are resampled, and those of two rivals that ran in the same round together.
//!
//! A ratio is the median of the rounds' ratios: the load of a shared machine changes from second to second, and within
//! one round both rivals had the same. Pooled medians would compare the loads instead.

use std::fmt;

use serde::Serialize;

/// How often slices are drawn anew.
const RESAMPLES: usize = 1_000;

/// A quantile needs so many values beyond it; with fewer it would be the rank of a few outliers.
const BEYOND: f64 = 10.0;

/// An estimate with its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// Of all slices.
    pub value: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl Interval {
    /// For JSON.
    pub fn ends(&self) -> [f64; 2] {
        [self.low, self.high]
    }
}

impl fmt::Display for Interval {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = match self.value {
            100.0.. => 0,
            10.0.. => 1,
            0.1.. => 2,
            _ => 4,
        };
        write!(f, "{:.digits$} [{:.digits$}, {:.digits$}]", self.value, self.low, self.high)
    }
}

/// Values of one contender, slice by slice, each slice in order of size.
#[derive(Clone, Debug, Default)]
pub struct Sample(Vec<Vec<u64>>);

impl Sample {
    /// No slice yet.
    pub const fn new() -> Sample {
        Sample(Vec::new())
    }

    /// Appends a slice.
    pub fn push(&mut self, mut slice: Vec<u64>) {
        slice.sort_unstable();
        self.0.push(slice);
    }

    /// How many values there are.
    pub fn count(&self) -> usize {
        self.0.iter().map(Vec::len).sum()
    }

    /// The largest value.
    pub fn max(&self) -> Option<u64> {
        self.0.iter().filter_map(|slice| slice.last().copied()).max()
    }

    /// How many values of each slice are larger than `limit`, of how many.
    pub fn beyond(&self, limit: u64) -> Vec<(usize, usize)> {
        let of =
            |slice: &Vec<u64>| (slice.len() - slice.partition_point(|value| *value <= limit), slice.len());
        self.0.iter().map(of).collect()
    }

    /// The quantile `q` of all values.
    pub fn quantile(&self, q: f64) -> Option<Interval> {
        let pool = Pool::new(self);
        let value = pool.quantile(q, &vec![1; self.0.len()])?;
        let mut random = fastrand::Rng::with_seed(1);
        interval(value, || pool.quantile(q, &draw(&mut random, self.0.len())))
    }

    /// The quantile `q` of these values as a share of that of `rival`: the median of the rounds' ratios, or, where one
    /// slice alone does not support the quantile, that of all slices together. `None` if it is not supported at all, or
    /// the two did not run in the same rounds.
    pub fn ratio(&self, rival: &Sample, q: f64) -> Option<Interval> {
        if self.0.len() != rival.0.len() || self.0.is_empty() {
            return None;
        }
        let each: Option<Vec<f64>> = (self.0.iter().zip(&rival.0))
            .map(|(ours, theirs)| Some(quantile(ours, q)? / quantile(theirs, q)?))
            .collect();
        if let Some(ratios) = each {
            return Some(over_rounds(ratios.len(), |rounds| {
                median(&rounds.iter().map(|round| ratios[*round]).collect::<Vec<_>>())
            }));
        }
        let (ours, theirs) = (Pool::new(self), Pool::new(rival));
        let ratio = |weights: &[u32]| Some(ours.quantile(q, weights)? / theirs.quantile(q, weights)?);
        let value = ratio(&vec![1; self.0.len()])?;
        let mut random = fastrand::Rng::with_seed(2);
        interval(value, || ratio(&draw(&mut random, self.0.len())))
    }
}

/// The quantile `q` of values in order of size.
fn quantile(sorted: &[u64], q: f64) -> Option<f64> {
    let count = sorted.len() as f64;
    if count * (1.0 - q) < BEYOND {
        return None;
    }
    Some(sorted[((count * q).ceil() as usize).clamp(1, sorted.len()) - 1] as f64)
}

/// All values of a sample in order of size, each with its slice.
struct Pool(Vec<(u64, usize)>);

impl Pool {
    fn new(sample: &Sample) -> Pool {
        let values = |(slice, values): (usize, &Vec<u64>)| {
            values.iter().map(|value| (*value, slice)).collect::<Vec<_>>()
        };
        let mut all: Vec<_> = sample.0.iter().enumerate().flat_map(values).collect();
        all.sort_unstable();
        Pool(all)
    }

    /// The quantile with each slice counted as often as `weights` says.
    fn quantile(&self, q: f64, weights: &[u32]) -> Option<f64> {
        let total: u64 = self.0.iter().map(|(_, slice)| u64::from(weights[*slice])).sum();
        if (total as f64) * (1.0 - q) < BEYOND {
            return None;
        }
        let rank = (total as f64 * q).ceil() as u64;
        let mut passed = 0;
        for (value, slice) in &self.0 {
            passed += u64::from(weights[*slice]);
            if passed >= rank {
                return Some(*value as f64);
            }
        }
        None
    }
}

/// The median of a few values.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    match sorted.len() {
        0 => f64::NAN,
        odd if odd % 2 == 1 => sorted[middle],
        _ => (sorted[middle - 1] + sorted[middle]) / 2.0,
    }
}

/// The estimate `value` with the interval that `of` gives over drawn rounds: each call gets the rounds to use.
pub fn over_rounds(rounds: usize, of: impl Fn(&[usize]) -> f64) -> Interval {
    let all: Vec<usize> = (0..rounds).collect();
    let mut random = fastrand::Rng::with_seed(3);
    let drawn = || {
        let chosen: Vec<usize> = (0..rounds).map(|_| random.usize(..rounds)).collect();
        Some(of(&chosen))
    };
    let value = of(&all);
    interval(value, drawn).unwrap_or(Interval { value, low: value, high: value })
}

/// How often each of `slices` was drawn.
fn draw(random: &mut fastrand::Rng, slices: usize) -> Vec<u32> {
    let mut weights = vec![0; slices];
    for _ in 0..slices {
        weights[random.usize(..slices)] += 1;
    }
    weights
}

/// Percentile interval. `None` if a draw gave nothing.
fn interval(value: f64, mut draw: impl FnMut() -> Option<f64>) -> Option<Interval> {
    let mut drawn = (0..RESAMPLES).map(|_| draw()).collect::<Option<Vec<f64>>>()?;
    drawn.sort_by(f64::total_cmp);
    let at = |share: f64| drawn[((RESAMPLES - 1) as f64 * share).round() as usize];
    Some(Interval { value, low: at(0.025), high: at(0.975) })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(slices: usize, value: impl Fn(usize) -> u64) -> Sample {
        let mut sample = Sample::new();
        (0..slices).for_each(|slice| sample.push((0..100).map(|at| value(slice * 100 + at)).collect()));
        sample
    }

    #[test]
    fn a_quantile_needs_values_beyond_it() {
        let steps = sample(10, |at| at as u64);
        let median = steps.quantile(0.5).unwrap();
        assert_eq!(median.value, 499.0);
        assert!(median.low < 499.0 && median.high > 499.0, "{median}");
        assert_eq!(steps.quantile(0.99).unwrap().value, 989.0);
        assert_eq!(steps.quantile(0.995), None);
        assert_eq!(Sample::new().quantile(0.5), None);
    }

    #[test]
    fn a_ratio_is_that_of_the_rounds_and_not_of_their_moods() {
        // Each round is twice as slow as the one before, for both.
        let mood = |at: usize| 1_000_u64 << (at / 100);
        let (ours, theirs) = (sample(8, |at| mood(at) * 3), sample(8, |at| mood(at) * 2));
        assert_eq!(ours.ratio(&theirs, 0.5), Some(Interval { value: 1.5, low: 1.5, high: 1.5 }));
        assert_eq!(ours.ratio(&sample(7, mood), 0.5), None);
        // No slice supports it alone, all of them do.
        assert_eq!(ours.ratio(&theirs, 0.98).map(|ratio| ratio.value), Some(1.5));
    }

    #[test]
    fn counts_what_lies_beyond_slice_by_slice() {
        let steps = sample(2, |at| at as u64);
        assert_eq!((steps.count(), steps.max()), (200, Some(199)));
        assert_eq!(steps.beyond(98), [(1, 100), (100, 100)]);
        assert_eq!(steps.beyond(199), [(0, 100), (0, 100)]);
    }

    #[test]
    fn an_estimate_shows_as_many_digits_as_it_has() {
        let interval = |value| Interval { value, low: value, high: value }.to_string();
        assert_eq!(interval(1234.5), "1234 [1234, 1234]");
        assert_eq!(interval(1.234), "1.23 [1.23, 1.23]");
        assert_eq!(interval(0.01234), "0.0123 [0.0123, 0.0123]");
    }
}
