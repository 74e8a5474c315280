//! Quantiles over the percentile, on an axis that gives every further nine the same room. A curve ends at the last
//! quantile that its sample supports; the maximum stands by itself at the right.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use super::PlotError;
use super::sheet::{Area, Axis, GREY, PALETTE, Sheet, anchored, chart, label_us, text, within};
use crate::cycle::status::Peak;
use crate::telemetry::Quantiles;
use crate::telemetry::histograms::{Quantity, SAMPLES_BEYOND, supports};
use crate::telemetry::summary::Drive;
use crate::telemetry::{Run, Summary};
use crate::time::Ns;

/// Where the curves begin, in nines: what is below the median worries nobody.
const MEDIAN: f64 = std::f64::consts::LOG10_2;

/// Points of a curve for each nine.
const POINTS_PER_NINE: f64 = 25.0;

/// So many drives have a colour and a line in the legend each; of more only [`WORST`] of them.
const NAMED: usize = PALETTE.len();

/// Of many drives these are the ones to look at.
const WORST: usize = 5;

/// One curve.
struct Curve {
    color: RGBColor,
    width: u32,
    /// Nines of the percentile, and ns.
    points: Vec<(f64, f64)>,
    max: Option<u64>,
}

impl Curve {
    fn of(histogram: &Quantity, peak: Peak, color: RGBColor, width: u32) -> Curve {
        let end = (histogram.len() as f64 / SAMPLES_BEYOND).log10();
        let steps = ((end - MEDIAN) * POINTS_PER_NINE).floor();
        let steps = (0..=steps as u32).map(|step| MEDIAN + f64::from(step) / POINTS_PER_NINE);
        let nines = steps.chain([end]).filter(|nines| (MEDIAN..=end).contains(nines));
        let points = nines.filter_map(|nines| {
            let value = histogram.bins().value_at_quantile(1.0 - 10_f64.powf(-nines));
            (!histogram.is_cut_off(value)).then_some((nines, value.min(peak.ns).max(1) as f64))
        });
        let points = points.collect();
        Curve { color, width, points, max: (peak != Peak::default()).then_some(peak.ns) }
    }
}

/// The loop, and what its drives come to.
pub fn of_the_run(run: &Run, summary: &Summary) -> Result<String, PlotError> {
    let (status, histograms) = (&run.end.status, &run.measured.histograms);
    let mut sheet = Sheet::new(run, summary, "Percentiles of the cycle and of the drives' round trips");
    let wake = Curve::of(&histograms.wake, status.wake_max, PALETTE[0], 3);
    sheet.explain_quantiles(PALETTE[0], "wake-up latency", &summary.wake_ns);
    let jitter = Curve::of(&histograms.jitter, status.jitter_max, PALETTE[2], 2);
    sheet.explain_quantiles(PALETTE[2], "cycle jitter", &summary.jitter_ns);
    let mut curves = vec![wake, jitter];
    let ranking = Ranking::of(&summary.drives);
    if let Some(worst) = ranking.order.first() {
        let drive = &summary.drives[*worst];
        let what = match ranking.compared {
            0 | 1 => format!("round trip of {}", drive.name),
            all => format!("round trip of {}, the worst of {all} by {}", drive.name, ranking.by()),
        };
        curves.push(of_drive(run, *worst, PALETTE[3], 2));
        sheet.explain_quantiles(PALETTE[3], &what, &drive.rtt_ns);
    }
    let deadline = run.plan.cycle.deadline_ns();
    sheet.draw(|area| draw(area, &curves, &[("receive deadline", deadline)], "latency (us)"))
}

/// The round trips of each drive.
pub fn of_the_drives(run: &Run, summary: &Summary) -> Result<String, PlotError> {
    let mut sheet = Sheet::new(run, summary, "Percentiles of each drive's round trip");
    let ranking = Ranking::of(&summary.drives);
    let ranked = &ranking.order;
    let named = if ranked.len() <= NAMED { NAMED } else { WORST };
    let (worst, others) = ranked.split_at(ranked.len().min(named));
    for (place, color) in worst.iter().zip(PALETTE) {
        let drive = &summary.drives[*place];
        sheet.explain_quantiles(color, &drive.name, &drive.rtt_ns);
    }
    // The worst last, so that it lies above all others.
    let others_curves = others.iter().map(|place| of_drive(run, *place, GREY, 1));
    let named = worst.iter().zip(PALETTE).rev().map(|(place, color)| of_drive(run, *place, color, 2));
    let curves: Vec<Curve> = others_curves.chain(named).collect();
    if !others.is_empty() {
        sheet.explain(Some(GREY), format!("the other {} drives, none of them worse", others.len()));
    }
    if ranking.compared > 1 {
        let by = ranking.by();
        let why = ranking.quantile.map_or("", |_| ", the highest quantile that each of them supports");
        sheet.explain(None, format!("Worst first: {} drives compared by {by}{why}.", ranking.compared));
    }
    let deadline = run.plan.cycle.deadline_ns();
    sheet.draw(|area| draw(area, &curves, &[("receive deadline", deadline)], "round trip (us)"))
}

fn of_drive(run: &Run, place: usize, color: RGBColor, width: u32) -> Curve {
    let histogram = &run.measured.histograms.drives[place].rtt;
    Curve::of(histogram, run.end.drives[place].peaks.rtt, color, width)
}

/// A quantile: its name, its share, and its value.
type Level = (&'static str, f64, fn(&Quantiles) -> Option<u64>);

/// The quantiles by which drives are compared, the highest first.
const LEVELS: [Level; 5] = [
    ("p99.99", 0.9999, |of| of.p99_99),
    ("p99.9", 0.999, |of| of.p99_9),
    ("p99", 0.99, |of| of.p99),
    ("p90", 0.9, |of| of.p90),
    ("p50", 0.5, |of| of.p50),
];

/// The drives by their round trips. All are compared by the same quantile: the p99 of a fast drive may be above the p50
/// of a slow one that has few samples.
struct Ranking {
    /// The highest quantile that all compared drives support; `None`: none supports any, so by their maxima.
    quantile: Option<Level>,
    /// The places of the drives, the worst first. Behind them those that are not compared: they have too few samples.
    order: Vec<usize>,
    compared: usize,
}

impl Ranking {
    fn of(drives: &[Drive]) -> Ranking {
        let (_, lowest, _) = LEVELS[LEVELS.len() - 1];
        let supported = |drive: &&Drive| supports(drive.rtt_ns.count, lowest);
        let fewest = drives.iter().filter(supported).map(|drive| drive.rtt_ns.count).min();
        let quantile =
            fewest.and_then(|count| LEVELS.into_iter().find(|(_, share, _)| supports(count, *share)));
        // A quantile that is supported and not known lies where the histogram ends: it is above all others.
        let tail = |place: &usize| {
            let rtt = &drives[*place].rtt_ns;
            let value =
                quantile.map(
                    |(_, share, value)| {
                        if supports(rtt.count, share) { value(rtt).unwrap_or(u64::MAX) } else { 0 }
                    },
                );
            (value, rtt.max)
        };
        let mut order: Vec<usize> = (0..drives.len()).collect();
        order.sort_by_key(|place| std::cmp::Reverse(tail(place)));
        let compared = match quantile {
            Some(_) => drives.iter().filter(supported).count(),
            None => drives.iter().filter(|drive| drive.rtt_ns.max.is_some()).count(),
        };
        Ranking { quantile, order, compared }
    }

    fn by(&self) -> &'static str {
        self.quantile.map_or("maximum", |(name, ..)| name)
    }
}

fn draw(area: &Area<'_>, curves: &[Curve], limits: &[(&str, u64)], unit: &str) -> Result<(), PlotError> {
    let values = curves
        .iter()
        .flat_map(|curve| curve.points.iter().map(|(_, ns)| *ns).chain(curve.max.map(|ns| ns.max(1) as f64)));
    let values = Axis::logarithmic(values.chain(limits.iter().map(|(_, ns)| *ns as f64)));
    // The labels of the axis: as many nines as there are curves for, then the maxima.
    let last = curves.iter().filter_map(|curve| curve.points.last()).fold(1.0_f64, |end, (x, _)| end.max(*x));
    let maxima = last + last.max(2.0) * 0.08;
    let end = maxima + last.max(2.0) * 0.06;
    let mut nines = vec![MEDIAN];
    nines.extend((1..=last.floor() as u32).map(f64::from));
    nines.push(maxima);
    let x = Axis { low: MEDIAN, high: end, bold: nines, light: Vec::new() };
    let label = |nines: &f64| if *nines == maxima { String::from("max") } else { percent(*nines) };
    let mut chart = chart(area, 10, (x, &label, "percentile (log scale)"), (values, &label_us, unit))?;
    for (name, ns) in limits {
        let log = (*ns as f64).log10();
        chart.draw_series(DashedLineSeries::new([(MEDIAN, log), (end, log)], 6, 4, GREY.stroke_width(1)))?;
        let (x, y) = within(area, chart.plotting_area().map_coordinate(&(MEDIAN, log)));
        let style = anchored(text(12, GREY), HPos::Left, VPos::Bottom);
        area.draw_text(&format!("{name} {}", Ns(*ns)), &style, (x + 6, y - 3))?;
    }
    for Curve { color, width, points, max } in curves {
        let points = points.iter().map(|(x, ns)| (*x, ns.log10()));
        chart.draw_series(LineSeries::new(points, color.stroke_width(*width)))?;
        let max = max.map(|ns| (maxima, (ns.max(1) as f64).log10()));
        chart.draw_series(max.map(|place| TriangleMarker::new(place, 5, color.filled())))?;
    }
    Ok(())
}

/// 0 %, 50 %, 90 %, 99 %, 99.9 % ...
fn percent(nines: f64) -> String {
    let digits = (nines - 2.0).max(0.0).round() as usize;
    format!("{:.digits$} %", 100.0 * (1.0 - 10_f64.powf(-nines)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::Histograms;

    #[test]
    fn a_curve_ends_where_its_sample_ends() {
        let mut histogram = Histograms::new(0).wake;
        let peak = Peak { ns: 70_000, index: 1 };
        assert_eq!(Curve::of(&histogram, Peak::default(), BLACK, 1).max, None);
        for count in 1..=10_000_u64 {
            assert!(histogram.bins_mut().record(7 * count).is_ok());
            let curve = Curve::of(&histogram, peak, BLACK, 1);
            match count {
                19 => assert_eq!(curve.points, []),
                // The median of 20, and nothing beyond it.
                20 => assert_eq!(curve.points.last(), Some(&(2_f64.log10(), 70.0))),
                10_000 => {
                    let (nines, ns) = *curve.points.last().unwrap();
                    assert!(nines == 3.0 && (69_900.0..=70_000.0).contains(&ns), "{nines} {ns}");
                    assert!(curve.points.is_sorted_by(|a, b| a.0 <= b.0 && a.1 <= b.1));
                }
                _ => {}
            }
        }
    }

    #[test]
    fn percentiles_read_naturally() {
        let labels = [0.0, 2_f64.log10(), 1.0, 2.0, 3.0, 5.0].map(percent);
        assert_eq!(labels, ["0 %", "50 %", "90 %", "99 %", "99.9 %", "99.999 %"]);
    }

    #[test]
    fn drives_are_compared_by_the_highest_quantile_that_all_of_them_support() {
        let drive = super::super::tests::run("x", 0).summary().drives.remove(0);
        let (mut drives, us) = (Vec::new(), |us: u64| us * 1_000);
        // Each with so many round trips, of which one in twenty takes the longer time.
        let cases = [
            ("many", 20_000, 100, 900),
            ("few", 200, 300, 400),
            ("silent", 0, 0, 0),
            ("five", 5, 2_000, 2_000),
        ];
        for (name, count, usual, longer) in cases {
            let mut histogram = Histograms::new(1).drives.remove(0).rtt;
            for index in 0..count {
                histogram.bins_mut().record(us(if index % 20 == 0 { longer } else { usual })).unwrap();
            }
            let peak = Peak { ns: us(longer), index: u64::from(count > 0) };
            drives.push(Drive {
                name: name.into(),
                rtt_ns: Quantiles::of(&histogram, peak),
                ..drive.clone()
            });
        }
        let ranking = Ranking::of(&drives);
        let names = |ranking: &Ranking| {
            ranking.order.iter().map(|place| drives[*place].name.clone()).collect::<Vec<_>>()
        };
        // The p99 of "many" (900 us) is above the p90 of "few" (300 us); by p90 it is 100 us.
        assert_eq!((ranking.by(), ranking.compared), ("p90", 2));
        assert_eq!(names(&ranking), ["few", "many", "five", "silent"]);
        let few = [drives[2].clone(), drives[3].clone()];
        let ranking = Ranking::of(&few);
        assert_eq!((ranking.by(), ranking.compared, ranking.order), ("maximum", 1, vec![1, 0]));
    }
}
