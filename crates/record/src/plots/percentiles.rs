//! Quantiles over the percentile, on an axis that gives every further nine the same room. A curve ends at the last
//! quantile that its sample supports; the maximum stands by itself at the right.

use super::chart::{COLOURS, Chart};
use super::scale::{Scale, Tick};
use crate::archive::{Archive, Drive, Sampled};
use crate::page::time;
use fieldbeat_core::time::Ns;
use fieldbeat_telemetry::Quantiles;
use fieldbeat_telemetry::bins::Bins;
use fieldbeat_telemetry::histograms::{SAMPLES_BEYOND, supports};
use fieldbeat_telemetry::signals::{JITTER, ROUND_TRIP, WAKE};

/// Where the curves begin, in nines: what is below the median worries nobody.
const MEDIAN: f64 = std::f64::consts::LOG10_2;

/// Points of a curve for each nine.
const POINTS_PER_NINE: f64 = 25.0;

/// The number of drives that have a colour and a line in the legend each; of more only [`WORST`] of them.
const NAMED: usize = COLOURS;

/// Of many drives these are the ones to look at.
const WORST: usize = 5;

/// A quantity in numbers; the maximum is exact, the others are not known better than this.
pub fn numbers(quantiles: &Quantiles) -> String {
    let max = quantiles.max.map_or(String::from("-"), |ns| Ns(ns).to_string());
    let cycle = quantiles.max_cycle.map_or(String::new(), |cycle| format!(" (cycle {cycle})"));
    format!(
        "p50 {}, p99 {}, p99.9 {}, max {max}{cycle}; n = {}",
        time(quantiles.p50),
        time(quantiles.p99),
        time(quantiles.p99_9),
        quantiles.count
    )
}

/// One curve.
struct Curve {
    class: String,
    /// Nines of the percentile, and ns.
    points: Vec<(f64, f64)>,
    max: Option<u64>,
}

impl Curve {
    fn of(sampled: &Sampled, class: impl Into<String>) -> Curve {
        let end = (sampled.bins.count() as f64 / SAMPLES_BEYOND).log10();
        let steps = ((end - MEDIAN) * POINTS_PER_NINE).floor();
        let steps = (0..=steps as u32).map(|step| MEDIAN + f64::from(step) / POINTS_PER_NINE);
        let nines = steps.chain([end]).filter(|nines| (MEDIAN..=end).contains(nines));
        let points = nines.filter_map(|nines| {
            let value = sampled.bins.rank(1.0 - 10_f64.powf(-nines))?;
            (!Bins::is_cut_off(value)).then_some((nines, value.min(sampled.max_ns).max(1) as f64))
        });
        let points = points.collect();
        Curve { class: class.into(), points, max: (sampled.max_ns > 0).then_some(sampled.max_ns) }
    }
}

/// The loop, and what its drives come to.
pub fn of_the_run(run: &Archive) -> String {
    let mut legend = vec![
        ("c0", format!("{}: {}", WAKE.name, numbers(&run.wake.quantiles()))),
        ("c2", format!("{}: {}", JITTER.name, numbers(&run.jitter.quantiles()))),
    ];
    let mut curves = vec![Curve::of(&run.wake, "c0 thick"), Curve::of(&run.jitter, "c2")];
    let ranking = Ranking::of(&run.drives);
    if let Some(worst) = ranking.order.first() {
        let drive = &run.drives[*worst];
        let rank = match ranking.compared {
            0 | 1 => String::new(),
            all => format!(", the worst of {all} by {}", ranking.by()),
        };
        curves.push(Curve::of(&drive.rtt, "c3"));
        legend.push((
            "c3",
            format!("{} of {}{rank}: {}", ROUND_TRIP.name, drive.name, numbers(&drive.rtt.quantiles())),
        ));
    }
    let mut chart = draw(&curves, run.deadline_ns, "latency");
    legend.iter().for_each(|(class, words)| chart.explain(class, words));
    chart.finish("percentiles", "Percentiles of the cycle and of the drives' round trips")
}

/// The round trips of each drive.
pub fn of_the_drives(run: &Archive) -> String {
    let ranking = Ranking::of(&run.drives);
    let ranked = &ranking.order;
    let named = if ranked.len() <= NAMED { NAMED } else { WORST };
    let (worst, others) = ranked.split_at(ranked.len().min(named));
    let curve = |place: usize, class: String| Curve::of(&run.drives[place].rtt, class);
    // The worst last, so that it lies above all others.
    let others_curves = others.iter().map(|place| curve(*place, "quiet".to_owned()));
    let named = worst.iter().enumerate().rev().map(|(colour, place)| curve(*place, format!("c{colour}")));
    let curves: Vec<Curve> = others_curves.chain(named).collect();
    let mut chart = draw(&curves, run.deadline_ns, ROUND_TRIP.name);
    for (colour, place) in worst.iter().enumerate() {
        let drive = &run.drives[*place];
        chart.explain(&format!("c{colour}"), &format!("{}: {}", drive.name, numbers(&drive.rtt.quantiles())));
    }
    if !others.is_empty() {
        chart.explain("quiet", &format!("the other {} drives, none of them worse", others.len()));
    }
    if ranking.compared > 1 {
        let why = ranking.quantile.map_or("", |_| ", the highest quantile that each of them supports");
        chart.explain(
            "",
            &format!("Worst first: {} drives compared by {}{why}.", ranking.compared, ranking.by()),
        );
    }
    chart.finish("round-trips", "Percentiles of each drive's round trip")
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
        let drives: Vec<Quantiles> = drives.iter().map(|drive| drive.rtt.quantiles()).collect();
        let (_, lowest, _) = LEVELS[LEVELS.len() - 1];
        let supported = |rtt: &&Quantiles| supports(rtt.count, lowest);
        let fewest = drives.iter().filter(supported).map(|rtt| rtt.count).min();
        let quantile =
            fewest.and_then(|count| LEVELS.into_iter().find(|(_, share, _)| supports(count, *share)));
        // A quantile that is supported and not known lies where the histogram ends: it is above all others.
        let tail = |place: &usize| {
            let rtt = &drives[*place];
            let value = quantile.map(|(_, share, value)| match supports(rtt.count, share) {
                true => value(rtt).unwrap_or(u64::MAX),
                false => 0,
            });
            (value, rtt.max)
        };
        let mut order: Vec<usize> = (0..drives.len()).collect();
        order.sort_by_key(|place| std::cmp::Reverse(tail(place)));
        let compared = match quantile {
            Some(_) => drives.iter().filter(supported).count(),
            None => drives.iter().filter(|rtt| rtt.max.is_some()).count(),
        };
        Ranking { quantile, order, compared }
    }

    fn by(&self) -> &'static str {
        self.quantile.map_or("maximum", |(name, ..)| name)
    }
}

fn draw(curves: &[Curve], deadline_ns: u64, what: &str) -> Chart {
    let values = curves
        .iter()
        .flat_map(|curve| curve.points.iter().map(|(_, ns)| *ns).chain(curve.max.map(|ns| ns.max(1) as f64)));
    let y = Scale::times(values.chain([deadline_ns as f64]), what);
    // The labels of the axis: as many nines as there are curves for, then the maxima.
    let last = curves.iter().filter_map(|curve| curve.points.last()).fold(1.0_f64, |end, (x, _)| end.max(*x));
    let maxima = last + last.max(2.0) * 0.08;
    let high = maxima + last.max(2.0) * 0.06;
    let nines = [MEDIAN].into_iter().chain((1..=last.floor() as u32).map(f64::from));
    let mut ticks: Vec<Tick> = nines.map(|at| Tick { at, label: Some(percent(at)) }).collect();
    ticks.push(Tick { at: maxima, label: Some(String::from("max")) });
    let x = Scale { low: MEDIAN, high, ticks, title: String::from("percentile (log scale)") };
    let mut chart = Chart::new(x, y, 340);
    chart.limit_y("quiet", (deadline_ns as f64).log10(), &format!("receive deadline {}", Ns(deadline_ns)));
    for Curve { class, points, max } in curves {
        chart.line(class, points.iter().map(|(x, ns)| (*x, ns.log10())));
        if let Some(max) = max {
            chart.dot(class, (maxima, ((*max).max(1) as f64).log10()), &format!("max {}", Ns(*max)));
        }
    }
    chart
}

/// 0 %, 50 %, 90 %, 99 %, 99.9 % ...
fn percent(nines: f64) -> String {
    let digits = (nines - 2.0).max(0.0).round() as usize;
    format!("{:.digits$} %", 100.0 * (1.0 - 10_f64.powf(-nines)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_ends_where_its_sample_ends() {
        let mut sampled = Sampled::default();
        assert_eq!(Curve::of(&sampled, "").max, None);
        for count in 1..=10_000_u64 {
            sampled.bins.add(&Bins::from_list([(7 * count, 1)]));
            if ![19, 20, 10_000].contains(&count) {
                continue;
            }
            sampled.max_ns = 70_000;
            let curve = Curve::of(&sampled, "");
            match count {
                19 => assert_eq!(curve.points, []),
                // The median of 20, and nothing beyond it.
                20 => assert_eq!(curve.points.last(), Some(&(2_f64.log10(), 70.0))),
                _ => {
                    let (nines, ns) = *curve.points.last().unwrap();
                    assert!(nines == 3.0 && (69_900.0..=70_000.0).contains(&ns), "{nines} {ns}");
                    assert!(curve.points.is_sorted_by(|a, b| a.0 <= b.0 && a.1 <= b.1));
                }
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
        let run = fieldbeat_testing::runs::run("x", 0);
        let drive = crate::archive::tests::archive(&run).drives.remove(0);
        let us = |us: u64| us * 1_000;
        // Each with so many round trips, of which one in twenty takes the longer time.
        let cases = [
            ("many", 20_000, 100, 900),
            ("few", 200, 300, 400),
            ("silent", 0, 0, 0),
            ("five", 5, 2_000, 2_000),
        ];
        let drives = cases.map(|(name, count, usual, longer): (&str, u64, u64, u64)| {
            let mut bins = Bins::from_list([(us(usual), count - count / 20)]);
            bins.add(&Bins::from_list([(us(longer), count / 20)]));
            let rtt = Sampled { bins, max_ns: us(longer), max_cycle: u64::from(count > 0) };
            Drive { name: name.into(), rtt, ..drive.clone() }
        });
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
