//! What a run measured, as histograms, and the quantiles that a sample supports.

use std::num::NonZeroU32;

use hdrhistogram::Histogram;

use fieldbeat_core::cycle::record::{
    CycleRecord, DriveRecord, Record, ReferenceRecord, Reply, SkippedRecord, Stage,
};
use fieldbeat_core::cycle::status::Peak;
use fieldbeat_core::time::MS;

/// The longest recorded time; a longer one is recorded as this, and its true maximum is kept by the loop.
pub const HIGHEST_NS: u64 = 60 * MS;

/// Significant digits of the loop's own quantities: bins of 1 us up to 2 ms.
const LOOP_DIGITS: u8 = 3;

/// Significant digits of the drives' quantities: 1 % is finer than any run repeats, and keeps the three histograms of a
/// drive at 64 kB.
const DRIVE_DIGITS: u8 = 2;

/// A quantile needs so many samples beyond it: with fewer it would be the rank of a few outliers.
pub const SAMPLES_BEYOND: f64 = 10.0;

/// The values of one quantity, ns, in bins of equal relative width.
///
/// 32 bits a bin would be full after 50 days at 1 kHz, and quantiles wrong from then on.
#[derive(Clone, Debug)]
pub struct Quantity(Histogram<u64>);

impl Quantity {
    fn new(digits: u8) -> Quantity {
        Quantity(Histogram::new_with_bounds(1, HIGHEST_NS, digits).expect("constant bounds are valid"))
    }

    fn enter(&mut self, ns: u64) {
        self.0.saturating_record(ns.max(1));
    }

    /// A time of a record, at least 1 ns, if it has one.
    #[inline]
    fn enter_measured(&mut self, ns: Option<NonZeroU32>) {
        if let Some(ns) = ns {
            self.0.saturating_record(ns.get().into());
        }
    }

    /// The number of values.
    pub fn len(&self) -> u64 {
        self.0.len()
    }

    /// Nothing was measured.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The upper end of the highest bin with a value, ns.
    pub fn max(&self) -> u64 {
        self.0.max()
    }

    /// The upper end of the bin in which this quantile (0 ..= 1) lies, ns. `None`: the sample is too small for it, or
    /// it lies beyond the histogram, at 60 ms.
    pub fn quantile(&self, quantile: f64) -> Option<u64> {
        let value = self.0.value_at_quantile(quantile);
        (supports(self.len(), quantile) && !self.is_cut_off(value)).then_some(value)
    }

    /// The number of values from `low` to `high`, ns, as exactly as the bins are.
    pub fn count_between(&self, low: u64, high: u64) -> u64 {
        if self.is_empty() { 0 } else { self.0.count_between(low, high) }
    }

    /// Whether `value` stands for all that are longer than the histogram reaches.
    #[doc(hidden)]
    pub fn is_cut_off(&self, value: u64) -> bool {
        self.0.equivalent(value, HIGHEST_NS)
    }

    /// The bins.
    #[doc(hidden)]
    pub fn bins(&self) -> &Histogram<u64> {
        &self.0
    }

    /// The same, to be filled by a test.
    #[doc(hidden)]
    pub fn bins_mut(&mut self) -> &mut Histogram<u64> {
        &mut self.0
    }
}

/// The measurements of a run, ns.
#[derive(Clone, Debug)]
pub struct Histograms {
    /// Begin of each cycle after its grid point; skipped slots count as late ones.
    pub wake: Quantity,
    /// Differences between the distance of two successive begins and that of their grid points.
    pub jitter: Quantity,
    /// Time of each [`Stage`].
    pub stages: [Quantity; 6],
    /// Distances of the slots from where the clock that leads the grid wants them, late or early, from the first lock
    /// on.
    pub reference: Quantity,
    /// The drives, in the order of the plan.
    pub drives: Vec<DriveHistograms>,
}

/// The measurements of one drive, ns.
#[derive(Clone, Debug)]
pub struct DriveHistograms {
    /// Round trips.
    pub rtt: Quantity,
    /// Differences between the distance of two successive requests and that of their grid points.
    pub send_jitter: Quantity,
    /// Age of its values whenever a window closed, while its link was up.
    pub age: Quantity,
    /// Exchanges that were missed or not sent while it was online.
    pub unanswered: u64,
}

impl DriveHistograms {
    fn new() -> DriveHistograms {
        let empty = || Quantity::new(DRIVE_DIGITS);
        DriveHistograms { rtt: empty(), send_jitter: empty(), age: empty(), unanswered: 0 }
    }
}

impl Histograms {
    /// Empty histograms for so many axes.
    #[doc(hidden)]
    pub fn new(axes: usize) -> Histograms {
        let empty = || Quantity::new(LOOP_DIGITS);
        Histograms {
            wake: empty(),
            jitter: empty(),
            stages: std::array::from_fn(|_| empty()),
            reference: empty(),
            drives: (0..axes).map(|_| DriveHistograms::new()).collect(),
        }
    }

    /// That of a stage.
    pub fn stage(&self, stage: Stage) -> &Quantity {
        &self.stages[stage as usize]
    }

    /// Enters one record.
    #[doc(hidden)]
    pub fn enter(&mut self, record: &Record, period_ns: u64) {
        match record {
            Record::Drive(drive) => self.drive(drive),
            Record::Monitor(_) | Record::Command(_) | Record::Event(_) | Record::Native(_) => {}
            Record::Reference(ReferenceRecord { error_ns, counts, .. }) => {
                if let Some(error_ns) = error_ns.filter(|_| *counts) {
                    self.reference.enter(error_ns.unsigned_abs().into());
                }
            }
            Record::Cycle(CycleRecord { wake_ns, jitter_ns, stages_ns, .. }) => {
                self.wake.enter((*wake_ns).into());
                self.jitter.enter((*jitter_ns).into());
                for (histogram, ns) in self.stages.iter_mut().zip(stages_ns) {
                    histogram.enter((*ns).into());
                }
            }
            Record::Skipped(record) => self.enter_skipped(record, period_ns),
        }
    }

    /// Enters that of a drive.
    #[inline]
    pub(crate) fn drive(&mut self, of: &DriveRecord) {
        let Some(drive) = self.drives.get_mut(usize::from(of.axis)) else { return };
        let is_unanswered = matches!(of.reply, Reply::Missed | Reply::Unsent);
        drive.unanswered += u64::from(is_unanswered && of.was_online());
        drive.rtt.enter_measured(of.rtt_ns);
        drive.send_jitter.enter_measured(of.jitter_ns);
        drive.age.enter_measured(of.age_ns);
    }

    /// Slot by slot while they differ, and all that are beyond the histogram at once.
    fn enter_skipped(&mut self, record: &SkippedRecord, period_ns: u64) {
        let mut slot = 0;
        while slot < record.count {
            let late = record.late_ns.saturating_sub(slot * period_ns);
            let alike = match late.checked_sub(HIGHEST_NS) {
                Some(beyond) => (beyond / period_ns + 1).min(record.count - slot),
                None => 1,
            };
            // Within the bounds, so that it cannot fail.
            let _ = self.wake.0.record_n(late.clamp(1, HIGHEST_NS), alike);
            slot += alike;
        }
    }
}

/// Quantiles of a histogram, each only if the sample is large enough to support it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Quantiles {
    /// Size of the sample.
    pub count: u64,
    /// Median, ns.
    pub p50: Option<u64>,
    /// 90th percentile, ns.
    pub p90: Option<u64>,
    /// 99th percentile, ns.
    pub p99: Option<u64>,
    /// 99.9th percentile, ns.
    pub p99_9: Option<u64>,
    /// 99.99th percentile, ns.
    pub p99_99: Option<u64>,
    /// The exact maximum, ns.
    pub max: Option<u64>,
    /// The cycle it is from.
    pub max_cycle: Option<u64>,
}

/// Whether a sample of this size supports the quantile.
pub fn supports(count: u64, quantile: f64) -> bool {
    count as f64 * (1.0 - quantile) >= SAMPLES_BEYOND - 1e-9
}

impl Quantiles {
    /// Quantiles of `histogram`, with the exact maximum that the loop kept.
    ///
    /// A quantile needs [`SAMPLES_BEYOND`] it. None is beyond the maximum, as the upper end of a bin may be. One
    /// that lies where the histogram ends is not known.
    pub fn of(histogram: &Quantity, peak: Peak) -> Quantiles {
        let count = histogram.len();
        let at = |quantile: f64| Some(histogram.quantile(quantile)?.min(peak.ns.max(1)));
        let any = peak != Peak::default() || count > 0;
        Quantiles {
            count,
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            p99_9: at(0.999),
            p99_99: at(0.9999),
            max: any.then_some(peak.ns),
            max_cycle: any.then_some(peak.index),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::cycle::record::measured;

    #[test]
    fn a_quantile_without_enough_samples_is_none() {
        let mut histograms = Histograms::new(1);
        for index in 0..99 {
            let record = DriveRecord { index, rtt_ns: measured(10_000), ..DriveRecord::default() };
            histograms.enter(&Record::Drive(record), MS);
        }
        let quantiles = Quantiles::of(&histograms.drives[0].rtt, Peak { ns: 10_000, index: 7 });
        assert_eq!((quantiles.count, quantiles.p90, quantiles.p99), (99, None, None));
        assert!(quantiles.p50.is_some_and(|p50| (9_900..=10_000).contains(&p50)));
        assert_eq!((quantiles.max, quantiles.max_cycle), (Some(10_000), Some(7)));
        assert_eq!(Quantiles::of(&histograms.wake, Peak::default()), Quantiles::default());
    }

    #[test]
    fn each_skipped_slot_is_a_late_wake_up_of_its_own() {
        let mut histograms = Histograms::new(0);
        let skipped = SkippedRecord { first: 5, count: 3, late_ns: 3_500_000, ..SkippedRecord::default() };
        histograms.enter(&Record::Skipped(skipped), MS);
        let values: Vec<u64> =
            histograms.wake.bins().iter_recorded().map(|v| v.value_iterated_to() / 100_000).collect();
        assert_eq!(histograms.wake.len(), 3);
        assert_eq!(values, [15, 25, 35]);
    }

    #[test]
    fn a_suspended_machine_is_entered_in_bounded_time() {
        let mut histograms = Histograms::new(0);
        let (count, late_ns) = (3_600_000, 3_600_000 * MS);
        let skipped = SkippedRecord { count, late_ns, ..SkippedRecord::default() };
        histograms.enter(&Record::Skipped(skipped), MS);
        assert_eq!(histograms.wake.len(), count);
    }

    #[test]
    fn errors_late_and_early_count_from_the_first_lock_on() {
        let mut histograms = Histograms::new(0);
        let errors = [(Some(-9_000), false), (Some(-700), true), (None, true), (Some(300), true)];
        for (error_ns, counts) in errors {
            let record = ReferenceRecord { error_ns, counts, ..ReferenceRecord::default() };
            histograms.enter(&Record::Reference(record), MS);
        }
        let reference = &histograms.reference;
        assert_eq!((reference.len(), reference.bins().min(), reference.max()), (2, 300, 700));
    }

    #[test]
    fn every_stage_goes_into_its_own_histogram() {
        let mut histograms = Histograms::new(0);
        let stages_ns = [10, 20, 30, 40, 50, 60];
        let cycle = CycleRecord { wake_ns: 5, jitter_ns: 7, stages_ns, ..CycleRecord::default() };
        histograms.enter(&Record::Cycle(cycle), MS);
        for (stage, ns) in Stage::ALL.into_iter().zip(stages_ns) {
            assert_eq!(histograms.stage(stage).max(), u64::from(ns), "{stage:?}");
        }
        assert_eq!((histograms.wake.max(), histograms.jitter.max()), (5, 7));
    }
}
