//! A histogram as a short list: the bins that are not empty. Files keep it, parts of a run have one each, and plots are
//! drawn from it.

use crate::Quantiles;
use crate::histograms::{HIGHEST_NS, Quantity, supports};
use fieldbeat_core::cycle::status::Peak;

/// The bins that are not empty, rising: the upper end of each, ns, and its count.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(transparent))]
pub struct Bins(Vec<(u64, u64)>);

/// From here on a bin stands for all that is longer: the last bin of the coarser histograms begins below their end.
const CUT_OFF_NS: u64 = HIGHEST_NS - HIGHEST_NS / 100;

impl Bins {
    /// Those of a histogram.
    pub fn of(quantity: &Quantity) -> Bins {
        let steps = quantity.bins().iter_recorded();
        Bins(steps.map(|step| (step.value_iterated_to(), step.count_at_value())).collect())
    }

    /// Those with these rising upper ends and counts.
    pub fn from_list(list: impl IntoIterator<Item = (u64, u64)>) -> Bins {
        Bins(list.into_iter().filter(|(_, count)| *count > 0).collect())
    }

    /// The number of values above `ns`, as exactly as the bins are.
    pub fn above(&self, ns: u64) -> u64 {
        self.0.iter().filter(|(value, _)| *value > ns).map(|(_, count)| count).sum()
    }

    /// Upper ends, and counts.
    pub fn list(&self) -> &[(u64, u64)] {
        &self.0
    }

    /// The number of values.
    pub fn count(&self) -> u64 {
        self.0.iter().map(|(_, count)| count).sum()
    }

    /// Whether `value` stands for all that are longer than the histogram reaches.
    pub fn is_cut_off(value: u64) -> bool {
        value >= CUT_OFF_NS
    }

    /// The number of values that are cut off.
    pub fn beyond(&self) -> u64 {
        self.0.iter().filter(|(value, _)| Bins::is_cut_off(*value)).map(|(_, count)| count).sum()
    }

    /// The upper end of the bin in which this quantile lies, whatever the size of the sample; `None`: it is empty.
    pub fn rank(&self, quantile: f64) -> Option<u64> {
        let rank = (quantile * self.count() as f64).ceil().max(1.0) as u64;
        let mut passed = 0;
        self.0.iter().find_map(|(value, count)| {
            passed += count;
            (passed >= rank).then_some(*value)
        })
    }

    /// The same if the sample supports it and the histogram reaches so far.
    pub fn quantile(&self, quantile: f64) -> Option<u64> {
        let value = self.rank(quantile).filter(|value| !Bins::is_cut_off(*value))?;
        supports(self.count(), quantile).then_some(value)
    }

    /// Quantiles, with the exact maximum that was kept apart.
    pub fn quantiles(&self, peak: Peak) -> Quantiles {
        let at = |quantile| Some(self.quantile(quantile)?.min(peak.ns.max(1)));
        let any = peak != Peak::default() || !self.0.is_empty();
        Quantiles {
            count: self.count(),
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            p99_9: at(0.999),
            p99_99: at(0.9999),
            max: any.then_some(peak.ns),
            max_cycle: any.then_some(peak.index),
        }
    }

    /// Adds the counts of other bins.
    pub fn add(&mut self, other: &Bins) {
        self.combine(other, |one, other| one + other);
    }

    /// The values since an earlier state of the same bins.
    pub fn since(&self, earlier: &Bins) -> Bins {
        let mut since = self.clone();
        since.combine(earlier, u64::saturating_sub);
        since.0.retain(|(_, count)| *count > 0);
        since
    }

    fn combine(&mut self, other: &Bins, counts: fn(u64, u64) -> u64) {
        let mut both = Vec::with_capacity(self.0.len().max(other.0.len()));
        let (mut ours, mut theirs) = (self.0.iter().copied().peekable(), other.0.iter().copied().peekable());
        loop {
            let value = match (ours.peek(), theirs.peek()) {
                (None, None) => break,
                (Some((value, _)), None) | (None, Some((value, _))) => *value,
                (Some((one, _)), Some((other, _))) => *one.min(other),
            };
            let [one, other] = [&mut ours, &mut theirs].map(|list| list.next_if(|(next, _)| *next == value));
            both.push((
                value,
                counts(one.map_or(0, |(_, count)| count), other.map_or(0, |(_, count)| count)),
            ));
        }
        self.0 = both;
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Bins with these values, each once.
    pub fn bins(values: impl IntoIterator<Item = u64>) -> Bins {
        let mut all = Bins::default();
        values.into_iter().for_each(|value| all.add(&Bins(vec![(value, 1)])));
        all
    }

    #[test]
    fn added_bins_are_those_since_the_last_time() {
        let (one, other) = (bins([3, 5, 5, 9]), bins([1, 5, 12]));
        let mut both = one.clone();
        both.add(&other);
        assert_eq!(both.list(), [(1, 1), (3, 1), (5, 3), (9, 1), (12, 1)]);
        assert_eq!((both.since(&one), both.since(&both)), (other, Bins::default()));
    }

    #[test]
    fn quantiles_are_those_of_the_histogram() {
        let mut histograms = crate::Histograms::new(0);
        let mut peak = Peak::default();
        for index in 0..20_000_u64 {
            let ns = 1_000 + index * index % 700_001;
            histograms.wake.bins_mut().record(ns).unwrap();
            peak.see(ns, index);
        }
        let bins = Bins::of(&histograms.wake);
        assert_eq!(bins.quantiles(peak), Quantiles::of(&histograms.wake, peak));
        assert_eq!(Bins::default().quantiles(Peak::default()), Quantiles::default());
        assert_eq!(bins.beyond(), 0);
        histograms.wake.bins_mut().record_n(HIGHEST_NS, 20_000).unwrap();
        let bins = Bins::of(&histograms.wake);
        assert_eq!((bins.beyond(), bins.quantile(0.9)), (20_000, None), "it lies where the histogram ends");
    }
}
