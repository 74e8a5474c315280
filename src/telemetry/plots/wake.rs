//! How many cycles began how late: a histogram with both axes logarithmic, so that the usual latency of a guarded loop
//! (well below 1 us), the late limit and the period (often 1 ms) stand on the same plot.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use super::PlotError;
use super::sheet::{
    ALARM, Area, Axis, GREY, PALETTE, Sheet, anchored, chart, label_count, label_us, numbers, text, within,
};
use crate::telemetry::histograms::{HIGHEST_NS, Quantity};
use crate::telemetry::{Run, Summary};
use crate::time::Ns;

/// Bins of a decade. A bin is at least 4 px wide on the longest axis, and wider than those of the histogram, which
/// keeps three digits.
const BINS: f64 = 25.0;

pub fn plot(run: &Run, summary: &Summary) -> Result<String, PlotError> {
    let (histogram, quantiles) = (&run.measured.histograms.wake, &summary.wake_ns);
    let (bins, beyond) = bins(histogram);
    let limits = [("late limit", summary.late.threshold_ns), ("period", summary.cycle.period_ns)];
    let mut sheet = Sheet::new(run, summary, "Wake-up latency: start of each cycle after its grid point");
    sheet.explain(Some(PALETTE[0]), numbers(quantiles));
    sheet.explain(None, format!("Skipped slots are counted as late wake-ups: {}.", summary.cycle.skipped));
    sheet.draw(|area| {
        let most = bins.iter().map(|(_, count)| *count).max().unwrap_or(0).max(1);
        // From below 1, so that a bin of a single sample is seen.
        let mut counts = Axis::logarithmic([1.0, most as f64].into_iter());
        counts.low = -0.3;
        counts.bold.retain(|log| *log >= 0.0);
        counts.light.retain(|log| *log >= 0.0);
        let ends = bins.first().into_iter().chain(bins.last()).flat_map(|(bin, _)| [*bin, *bin + 1]);
        let ends = ends.map(|bin| 10_f64.powf(from(bin)));
        let marks = limits.iter().map(|(_, ns)| *ns).chain(quantiles.max).map(|ns| ns.max(1) as f64);
        let latencies = Axis::logarithmic(ends.chain(marks));
        let mut chart = chart(
            area,
            22,
            (latencies.clone(), &label_us, "latency (us, log scale)"),
            (counts.clone(), &label_count, "cycles (log scale)"),
        )?;
        chart.draw_series(bins.iter().map(|(bin, count)| {
            let corners = [(from(*bin), counts.low), (from(*bin + 1), (*count as f64).log10())];
            Rectangle::new(corners, PALETTE[0].filled())
        }))?;
        let label = |log: f64, line: i32, color, words: &str| {
            // Towards the side that has room.
            let near = log < (latencies.low + latencies.high) / 2.0;
            let (side, gap) = if near { (HPos::Left, 4) } else { (HPos::Right, -4) };
            let (x, y) = within(area, chart.plotting_area().map_coordinate(&(log, counts.high)));
            mark(area, (x + gap, y + line), anchored(text(12, color), side, VPos::Bottom), words)
        };
        for (place, (name, ns)) in limits.into_iter().enumerate() {
            let log = (ns.max(1) as f64).log10();
            // Below each other: with a late limit near the period their labels would meet.
            label(log, 18 + 18 * place as i32, GREY, &format!("{name} {}", Ns(ns)))?;
        }
        if let Some(max) = quantiles.max {
            let cycle = quantiles.max_cycle.map_or(String::new(), |cycle| format!(" in cycle {cycle}"));
            let words = match beyond {
                0 => format!("max {}{cycle}", Ns(max)),
                beyond => format!("{beyond} of {} or more, max {}{cycle}", Ns(HIGHEST_NS), Ns(max)),
            };
            label((max.max(1) as f64).log10(), -4, ALARM, &words)?;
        }
        for (_, ns) in limits {
            let log = (ns.max(1) as f64).log10();
            let line = [(log, counts.low), (log, counts.high)];
            chart.draw_series(DashedLineSeries::new(line, 6, 4, GREY.stroke_width(1)))?;
        }
        if let Some(max) = quantiles.max {
            let log = (max.max(1) as f64).log10();
            let line = [(log, counts.low), (log, counts.high)];
            chart.draw_series([PathElement::new(line, ALARM.stroke_width(1))])?;
        }
        Ok(())
    })
}

fn mark(area: &Area<'_>, place: (i32, i32), style: TextStyle<'_>, words: &str) -> Result<(), PlotError> {
    Ok(area.draw_text(words, &style, place)?)
}

/// The logarithm of the lower end of a bin, ns.
fn from(bin: i32) -> f64 {
    f64::from(bin) / BINS
}

/// The bins that are not empty, in their order, each with its number of samples; and how many samples were longer than
/// the histogram reaches. These are in the last bin.
fn bins(histogram: &Quantity) -> (Vec<(i32, u64)>, u64) {
    let mut bins: Vec<(i32, u64)> = Vec::new();
    let mut beyond = 0;
    for step in histogram.bins().iter_recorded() {
        let (value, count) = (step.value_iterated_to(), step.count_at_value());
        if histogram.is_cut_off(value) {
            beyond += count;
        }
        // The middle of its own bin stands for a sample: the upper end may be in the next one here.
        let bin = (histogram.bins().median_equivalent(value).max(1) as f64).log10() * BINS;
        match bins.last_mut() {
            Some((last, counted)) if *last == bin.floor() as i32 => *counted += count,
            _ => bins.push((bin.floor() as i32, count)),
        }
    }
    (bins, beyond)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cycle::record::{CycleRecord, Record, SkippedRecord};
    use crate::telemetry::Histograms;
    use crate::time::MS;

    #[test]
    fn every_sample_is_in_the_bin_of_its_latency() {
        let mut histograms = Histograms::new(0);
        for wake_ns in [1, 1, 100, 1_000, 1_050, 1_099, 59_000_000] {
            histograms.enter(&Record::Cycle(CycleRecord { wake_ns, ..CycleRecord::default() }), MS);
        }
        // Ten bins of a quarter of a decade each would be 1.26 apart; here a bin ends at 1.096 times its begin.
        let expected = vec![(0, 2), (50, 1), (75, 2), (76, 1), (194, 1)];
        assert_eq!(bins(&histograms.wake), (expected, 0));
    }

    #[test]
    fn samples_beyond_the_histogram_are_counted() {
        let mut histograms = Histograms::new(0);
        let skipped = SkippedRecord { count: 5, late_ns: 62 * MS, ..SkippedRecord::default() };
        histograms.enter(&Record::Skipped(skipped), MS);
        let (bins, beyond) = bins(&histograms.wake);
        // 62, 61 and 60 ms, and two below.
        assert_eq!((bins.iter().map(|(_, count)| count).sum::<u64>(), beyond), (5, 3), "{bins:?}");
    }
}
