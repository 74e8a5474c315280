//! The largest values over the time of the run, and when exchanges were missed and slots skipped.

use super::chart::Chart;
use super::scale::Scale;
use crate::archive::Archive;
use crate::summary::plural;
use fieldbeat_core::time::Ns;
use fieldbeat_telemetry::signals::{ROUND_TRIP, WAKE};
use fieldbeat_telemetry::timeline::Stretch;

/// A quantity: its place in a stretch, its name, of what it is, and its colour.
type Quantity = (fn(&Stretch) -> u64, &'static str, &'static str, &'static str);

const QUANTITIES: [Quantity; 3] = [
    (|stretch| stretch.busy_ns, "execution time", " of a cycle", "c2"),
    (|stretch| stretch.rtt_ns, ROUND_TRIP.name, " of any drive", "c3"),
    (|stretch| stretch.wake_ns, WAKE.name, "", "c0"),
];

/// The plot.
pub fn plot(run: &Archive) -> String {
    let stretches = run.timeline.stretches();
    let width_ns = run.timeline.width().saturating_mul(run.period_ns);
    let (time, unit_ns) = Scale::run(width_ns.saturating_mul(stretches.len().max(1) as u64));
    let step = width_ns as f64 / unit_ns;
    let values = stretches.iter().flat_map(|stretch| QUANTITIES.map(|(of, ..)| of(stretch)));
    let values = values.filter(|ns| *ns > 0).chain([run.period_ns]).map(|ns| ns as f64);
    let mut chart = Chart::new(time, Scale::times(values, "largest"), 300);
    for (place, Stretch { missed, skipped, .. }) in stretches.iter().enumerate() {
        let what = match (missed, skipped) {
            (0, 0) => continue,
            (missed, 0) => format!("{missed} missed"),
            (0, skipped) => format!("{skipped} skipped"),
            (missed, skipped) => format!("{missed} missed, {skipped} skipped"),
        };
        let class = if *skipped > 0 { "alarm" } else { "c4" };
        chart.event(class, step * (place as f64 + 0.5), &what);
    }
    chart.limit_y("quiet", (run.period_ns as f64).log10(), &format!("period {}", Ns(run.period_ns)));
    for (of, name, whose, class) in QUANTITIES {
        let seen = stretches.iter().map(of).enumerate().filter(|(_, ns)| *ns > 0);
        let steps =
            seen.map(|(place, ns)| (step * place as f64, step * (place + 1) as f64, (ns as f64).log10()));
        chart.steps(class, steps);
        let max = stretches.iter().map(of).max().filter(|max| *max > 0);
        chart.explain(
            class,
            &format!("{name}{whose}: max {}", max.map_or("-".to_owned(), |ns| Ns(ns).to_string())),
        );
    }
    chart.explain("c4 tall", &format!("missed: {}", plural(run.counts.missed, "exchange")));
    chart.explain("alarm tall", &format!("skipped: {}", plural(run.counts.skipped, "slot")));
    let width = plural(run.timeline.width(), "cycle");
    chart.explain("", &format!("One step is {} ({width}).", Ns(width_ns)));
    chart.finish("course", "Course of the run: the largest value in each step of time")
}
