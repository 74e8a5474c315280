//! A histogram as text, as HdrHistogram's `outputPercentileDistribution` writes it and its tools read it (`.hgrm`).

use std::fmt::Write;

use fieldbeat_core::cycle::status::Peak;
use fieldbeat_telemetry::histograms::Quantity;
use fieldbeat_telemetry::signals::shown;

/// Lines for each halving of the distance to 100 %: what the tools of HdrHistogram take if nothing else is said.
const TICKS_PER_HALF_DISTANCE: u32 = 5;

/// The percentile distribution of `histogram`, in us.
///
/// Two numbers are better than a histogram has them: no value is beyond the exact maximum that the loop kept, as the
/// upper end of a bin may be, and the last one, of 100 %, is that maximum, even if it was beyond the histogram or its
/// record got lost. What lies where the histogram ends has no line but that last one.
pub fn distribution(histogram: &Quantity, peak: Peak) -> String {
    let mut text =
        format!("{:>12} {:>14} {:>10} {:>14}\n\n", "Value", "Percentile", "TotalCount", "1/(1-Percentile)");
    let mut total = 0;
    for step in histogram.bins().iter_quantiles(TICKS_PER_HALF_DISTANCE) {
        total += step.count_since_last_iteration();
        let quantile = step.quantile_iterated_to();
        if quantile < 1.0 && histogram.is_cut_off(step.value_iterated_to()) {
            continue;
        }
        // Writing into a string cannot fail.
        let _ = if quantile < 1.0 {
            let value = shown(step.value_iterated_to().min(peak.ns.max(1)) as f64);
            writeln!(text, "{value:12.3} {quantile:.12} {total:10} {:14.2}", 1.0 / (1.0 - quantile))
        } else {
            writeln!(text, "{:12.3} {quantile:.12} {total:10}", shown(peak.ns as f64))
        };
    }
    let (mean, deviation) = (shown(histogram.bins().mean()), shown(histogram.bins().stdev()));
    let sub_buckets = (2 * 10_u32.pow(u32::from(histogram.bins().sigfig()))).next_power_of_two();
    let _ = write!(
        text,
        "#[Mean    = {mean:12.3}, StdDeviation   = {deviation:12.3}]\n\
         #[Max     = {:12.3}, Total count    = {total:12}]\n\
         #[Buckets = {:12}, SubBuckets     = {sub_buckets:12}]\n",
        shown(peak.ns as f64),
        histogram.bins().buckets(),
    );
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::cycle::record::{CycleRecord, Record};
    use fieldbeat_core::time::MS;
    use fieldbeat_telemetry::Histograms;

    /// As hdr-histogram-js 3.0.1 writes these samples, of the same bounds and digits.
    #[test]
    fn is_what_the_tools_write() {
        let golden = "       Value     Percentile TotalCount 1/(1-Percentile)

       1.000 0.000000000000          1           1.00
       1.000 0.100000000000          1           1.11
       1.500 0.200000000000          2           1.25
       1.800 0.300000000000          3           1.43
       1.800 0.400000000000          3           1.67
       2.000 0.500000000000          5           2.00
       2.000 0.550000000000          5           2.22
       2.000 0.600000000000          5           2.50
       2.000 0.650000000000          5           2.86
       2.000 0.700000000000          5           3.33
       2.047 0.750000000000          6           4.00
       2.047 0.775000000000          6           4.44
       2.047 0.800000000000          6           5.00
       2.047 0.825000000000          6           5.71
       2.047 0.850000000000          6           6.67
      65.535 0.875000000000          7           8.00
      65.535 1.000000000000          7
#[Mean    =       10.838, StdDeviation   =       22.326]
#[Max     =       65.535, Total count    =            7]
#[Buckets =           16, SubBuckets     =         2048]
";
        let mut histograms = Histograms::new(0);
        for (index, wake_ns) in [1_000, 1_500, 2_000, 2_000, 2_047, 1_800, 65_535].into_iter().enumerate() {
            let cycle = CycleRecord { index: index as u64, wake_ns, ..CycleRecord::default() };
            histograms.enter(&Record::Cycle(cycle), MS);
        }
        assert_eq!(distribution(&histograms.wake, Peak { ns: 65_535, index: 6 }), golden);
    }

    #[test]
    fn an_empty_histogram_has_no_lines() {
        let text = distribution(&Histograms::new(0).wake, Peak::default());
        assert_eq!(text.lines().filter(|line| !line.starts_with('#')).count(), 2, "{text}");
        assert!(text.contains("Total count    =            0]"), "{text}");
    }
}
