//! How many cycles began how late: a histogram of bins of 1 us with a logarithmic count, as OSADL's Realtime QA Farm
//! plots it for its machines.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use super::PlotError;
use super::sheet::{
    ALARM, Axis, LEFT, MARGIN, PALETTE, RIGHT, Sheet, anchored, label_count, numbers, text, within,
};
use crate::telemetry::{Quantiles, histograms::Quantity};
use crate::telemetry::{Run, Summary};
use crate::time::{Ns, US};

/// The most bins: each needs a pixel of its own.
const MOST_BINS: u64 = 800;

/// The fewest: a narrower histogram would look like noise.
const FEWEST_BINS: u64 = 20;

pub fn picture(run: &Run, summary: &Summary) -> Result<String, PlotError> {
    let (histogram, quantiles) = (&run.measured.histograms.wake, &summary.wake_ns);
    let end = end(quantiles);
    let (bins, beyond) = bins(histogram, end);
    let mut sheet = Sheet::new(run, summary, "Wake-up latency: begin of each cycle after its grid point");
    sheet.explain(Some(PALETTE[0]), numbers(quantiles));
    sheet.explain(None, format!("Skipped slots are in it as late ones: {}.", summary.cycle.skipped));
    sheet.draw(|area| {
        let most = bins.iter().copied().max().unwrap_or(0).max(beyond).max(1);
        // From below 1, so that a bin of a single sample is seen.
        let mut counts = Axis::logarithmic([1.0, most as f64].into_iter());
        counts.low = -0.3;
        counts.bold.retain(|log| *log >= 0.0);
        counts.light.retain(|log| *log >= 0.0);
        let mut chart = ChartBuilder::on(area)
            .x_label_area_size(44)
            .margin_left(MARGIN)
            .y_label_area_size(LEFT - MARGIN)
            .margin_right(RIGHT)
            .margin_top(22)
            .build_cartesian_2d(0.0..end as f64, counts.clone())?;
        chart
            .configure_mesh()
            .x_labels(12)
            .x_max_light_lines(4)
            .x_label_formatter(&|us| format!("{us}"))
            .y_label_formatter(&label_count)
            .x_desc("latency (us), bins of 1 us")
            .y_desc("cycles")
            .label_style(text(12, BLACK))
            .axis_desc_style(text(13, BLACK))
            .bold_line_style(BLACK.mix(0.15))
            .light_line_style(BLACK.mix(0.05))
            .draw()?;
        let filled = bins.iter().enumerate().filter(|(_, count)| **count > 0);
        chart.draw_series(filled.map(|(us, count)| {
            let corners = [(us as f64, counts.low), (us as f64 + 1.0, (*count as f64).log10())];
            Rectangle::new(corners, PALETTE[0].filled())
        }))?;
        let Some(max) = quantiles.max else { return Ok(()) };
        let at = (max as f64 / US as f64).min(end as f64);
        let line = [(at, counts.low), (at, counts.high)];
        chart.draw_series([PathElement::new(line, ALARM.stroke_width(1))])?;
        // Towards the side that has room.
        let side = if at < end as f64 / 2.0 { HPos::Left } else { HPos::Right };
        let cycle = quantiles.max_cycle.map_or(String::new(), |cycle| format!(" in cycle {cycle}"));
        let mark = match beyond {
            0 => format!("max {}{cycle}", Ns(max)),
            beyond => format!("{beyond} beyond {end} us, max {}{cycle}", Ns(max)),
        };
        let (x, y) = within(area, chart.plotting_area().map_coordinate(&line[1]));
        area.draw_text(&mark, &anchored(text(12, ALARM), side, VPos::Bottom), (x, y - 4))?;
        Ok(())
    })
}

/// Where the plot ends, us: behind the maximum; if that is too far away, behind the bulk.
fn end(quantiles: &Quantiles) -> u64 {
    let highest = quantiles.p99_9.or(quantiles.p99).or(quantiles.p90).or(quantiles.p50);
    let us = |ns: Option<u64>| ns.unwrap_or(0) / US + 1;
    let most = us(quantiles.max);
    let least = if most <= MOST_BINS { most } else { 2 * us(highest) };
    // Up to the next of 20, 25, 30, 40, 50, 60, 80, 100 ...
    let steps = [FEWEST_BINS, 25, 30, 40, 50, 60, 80, 100, 150, 200, 250, 300, 400, 500, 600];
    steps.into_iter().find(|step| least <= *step).unwrap_or(MOST_BINS)
}

/// The samples of each bin, and of all beyond the last.
fn bins(histogram: &Quantity, end: u64) -> (Vec<u64>, u64) {
    let mut bins = vec![0; end as usize];
    let mut beyond = 0;
    for step in histogram.iter_recorded() {
        match bins.get_mut((step.value_iterated_to() / US) as usize) {
            Some(bin) => *bin += step.count_at_value(),
            None => beyond += step.count_at_value(),
        }
    }
    (bins, beyond)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cycle::record::{CycleRecord, Record};
    use crate::telemetry::Histograms;
    use crate::time::MS;

    #[test]
    fn every_sample_is_in_a_bin_or_beyond() {
        let mut histograms = Histograms::new(0);
        for wake_ns in [0, 999, 1_000, 1_001, 19_999, 20_001, 5_000_000] {
            histograms.enter(&Record::Cycle(CycleRecord { wake_ns, ..CycleRecord::default() }), MS);
        }
        let (bins, beyond) = bins(&histograms.wake, 20);
        assert_eq!((bins[0], bins[1], bins[19], beyond), (2, 2, 1, 2));
        assert_eq!(bins.iter().sum::<u64>() + beyond, 7);
    }

    #[test]
    fn it_ends_behind_the_maximum_or_behind_the_bulk() {
        let of = |p99: u64, max: u64| {
            end(&Quantiles { p99: Some(p99 * US), max: Some(max * US), ..Quantiles::default() })
        };
        assert_eq!(
            [of(3, 5), of(3, 131), of(3, 799), of(3, 20_000), of(900, 20_000)],
            [20, 150, 800, 20, 800]
        );
        assert_eq!(of(60, 900), 150);
        assert_eq!(end(&Quantiles::default()), 20);
    }
}
