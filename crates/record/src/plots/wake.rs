//! How many cycles began how late: a histogram with both axes logarithmic, as OSADL publishes latencies, so that the
//! usual latency of a guarded loop (well below 1 us), the late limit and the period stand on the same plot. Earlier
//! runs lie over it as outlines.

use super::chart::{COLOURS, Chart};
use super::scale::Scale;
use crate::archive::Archive;
use crate::plots::percentiles::numbers;
use fieldbeat_core::time::Ns;
use fieldbeat_telemetry::bins::Bins;
use fieldbeat_telemetry::histograms::HIGHEST_NS;
use fieldbeat_telemetry::signals::TIME;

/// Bins of a decade: wider than those of the histogram, which keeps three digits.
const BINS: f64 = 25.0;

/// The plot, with the earlier runs by their names.
pub fn plot(run: &Archive, earlier: &[(String, Archive)]) -> String {
    let ours = bins(&run.wake.bins);
    let theirs: Vec<Vec<(i32, u64)>> = earlier.iter().map(|(_, run)| bins(&run.wake.bins)).collect();
    let all = || std::iter::once(&ours).chain(&theirs).flatten();
    let most = all().map(|(_, count)| *count).max().unwrap_or(0).max(1);
    // From below 1, so that a bin of a single sample is seen.
    let mut counts = Scale::logarithmic([1.0, most as f64].into_iter(), 1.0, "cycles (log scale)");
    counts.low = -0.3;
    counts.ticks.retain(|tick| tick.at >= 0.0);
    let limits = [("late limit", run.late_ns), ("period", run.period_ns)];
    let max = (run.wake.bins.count() > 0 || run.wake.max_ns > 0).then_some(run.wake.max_ns);
    let ends = all().flat_map(|(bin, _)| [*bin, *bin + 1]).map(|bin| 10_f64.powf(from(bin)));
    let marks = limits.iter().map(|(_, ns)| *ns).chain(max).map(|ns| ns.max(1) as f64);
    let mut latencies = Scale::times(ends.chain(marks), "latency");
    latencies.title = format!("latency ({TIME}, log scale)");
    let bottom = counts.low;
    let mut chart = Chart::new(latencies, counts, 340);
    let spans = |bins: &[(i32, u64)]| {
        let spans = bins.iter().map(|(bin, count)| (from(*bin), from(*bin + 1), (*count as f64).log10()));
        spans.collect::<Vec<_>>()
    };
    chart.bars("c0", spans(&ours).into_iter());
    for (place, bins) in theirs.iter().enumerate() {
        // Down to the bottom at both sides of each gap.
        let mut outline: Vec<(f64, f64, f64)> = Vec::new();
        for (begin, end, value) in spans(bins) {
            let last = outline.last().map(|(_, end, _)| *end);
            if last.is_none_or(|last| begin - last > 1e-9) {
                outline.extend(last.map(|last| (last, last, bottom)));
                outline.push((begin, begin, bottom));
            }
            outline.push((begin, end, value));
        }
        outline.extend(outline.last().map(|(_, end, _)| (*end, *end, bottom)));
        chart.steps(&colour(place), outline.into_iter());
    }
    for (line, (name, ns)) in limits.into_iter().enumerate() {
        chart.limit_x("quiet", (ns.max(1) as f64).log10(), line as u32, &format!("{name} {}", Ns(ns)));
    }
    if let Some(max) = max {
        let words = match run.wake.bins.beyond() {
            0 => format!("max {} in cycle {}", Ns(max), run.wake.max_cycle),
            beyond => format!("{beyond} of {} or more, max {}", Ns(HIGHEST_NS), Ns(max)),
        };
        chart.limit_x("alarm", (max.max(1) as f64).log10(), 2, &words);
    }
    chart.explain("c0", &format!("this run: {}", numbers(&run.wake.quantiles())));
    for (place, (name, run)) in earlier.iter().enumerate() {
        chart.explain(&colour(place), &format!("{name}: {}", numbers(&run.wake.quantiles())));
    }
    chart.explain("", &format!("Skipped slots are counted as late wake-ups: {}.", run.counts.skipped));
    chart.finish("latency", "Wake-up latency: begin of each cycle after its grid point")
}

/// That of an earlier run.
fn colour(place: usize) -> String {
    format!("c{}", 1 + place % (COLOURS - 1))
}

/// The logarithm of the lower end of a bin, ns.
fn from(bin: i32) -> f64 {
    f64::from(bin) / BINS
}

/// The bins that are not empty, in their order, each with its number of samples. What is longer than the histogram
/// reaches is in the last one.
fn bins(histogram: &Bins) -> Vec<(i32, u64)> {
    let mut bins: Vec<(i32, u64)> = Vec::new();
    for (value, count) in histogram.list() {
        let bin = ((*value).max(1) as f64).log10() * BINS;
        match bins.last_mut() {
            Some((last, counted)) if *last == bin.floor() as i32 => *counted += count,
            _ => bins.push((bin.floor() as i32, *count)),
        }
    }
    bins
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sample_is_in_the_bin_of_its_latency() {
        let values = [(1, 2), (100, 1), (1_000, 1), (1_050, 1), (1_099, 1), (59_000_000, 1)];
        // A bin ends at 1.096 times its begin.
        let expected = vec![(0, 2), (50, 1), (75, 2), (76, 1), (194, 1)];
        assert_eq!(bins(&Bins::from_list(values)), expected);
    }
}
