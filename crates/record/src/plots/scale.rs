//! From values to places on an axis, and what is labelled there.

use fieldbeat_core::time::S;
use fieldbeat_telemetry::signals::{TIME, TIME_NS};

/// Where something is labelled.
#[derive(Clone, Debug, PartialEq)]
pub struct Tick {
    /// The value.
    pub at: f64,
    /// The label; `None`: only a line.
    pub label: Option<String>,
}

/// An axis. A logarithmic one is a linear one of logarithms.
#[derive(Clone, Debug, PartialEq)]
pub struct Scale {
    /// The begin.
    pub low: f64,
    /// The end.
    pub high: f64,
    /// The grid, rising.
    pub ticks: Vec<Tick>,
    /// The title.
    pub title: String,
}

impl Scale {
    /// The place of a value, 0 at the begin and 1 at the end.
    pub fn place(&self, value: f64) -> f64 {
        (value - self.low) / (self.high - self.low)
    }

    /// A linear axis from one value to another, with about so many labels.
    pub fn linear(low: f64, high: f64, labels: usize, title: impl Into<String>) -> Scale {
        let span = if high > low { high - low } else { 1.0 };
        let step = round(span / labels as f64);
        let first = (low / step).ceil() as i64;
        let ticks =
            (first..).map(|tick| tick as f64 * step).take_while(|at| *at <= low + span * (1.0 + 1e-9));
        let ticks = ticks.map(|at| Tick { at, label: Some(decimal(at, step)) }).collect();
        Scale { low, high: low + span, ticks, title: title.into() }
    }

    /// The same with room at both ends, so that no curve runs along the frame.
    pub fn around(values: impl Iterator<Item = f64>, labels: usize, title: impl Into<String>) -> Scale {
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        let (low, high) = if low <= high { (low, high) } else { (0.0, 1.0) };
        let room = ((high - low) * 0.06).max(high.abs().max(low.abs()) * 1e-4).max(1e-3);
        Scale::linear(low - room, high + room, labels, title)
    }

    /// A logarithmic axis that holds `values`, all positive, and begins and ends at 1, 2 or 5 times a power of ten. Its
    /// labels are in `unit`s.
    pub fn logarithmic(values: impl Iterator<Item = f64>, unit: f64, title: impl Into<String>) -> Scale {
        let (least, most) = values.fold((f64::MAX, 0.0_f64), |(least, most), v| (least.min(v), most.max(v)));
        let (least, most) = if most > 0.0 { (least, most) } else { (1.0, 10.0) };
        let decades = (least.log10().floor() as i32 - 1)..=(most.log10().ceil() as i32);
        let grid: Vec<(f64, i32)> = decades
            .flat_map(|decade| (1..10).map(move |digit| (f64::from(digit) * 10_f64.powi(decade), digit)))
            .collect();
        let round = |digit: i32| matches!(digit, 1 | 2 | 5);
        let low = grid.iter().rfind(|(value, digit)| round(*digit) && *value < least * 0.95);
        let high = grid.iter().find(|(value, digit)| round(*digit) && *value > most * 1.05);
        let (low, high) = (low.map_or(least, |grid| grid.0), high.map_or(most, |grid| grid.0));
        let wide = high / low > 1e3 * 1.001;
        let ticks = grid.iter().filter(|(value, _)| (low * 0.999..=high * 1.001).contains(value));
        let ticks = ticks.map(|(value, digit)| {
            let labelled = *digit == 1 || (!wide && round(*digit));
            Tick { at: value.log10(), label: labelled.then(|| short(value / unit)) }
        });
        Scale { low: low.log10(), high: high.log10(), ticks: ticks.collect(), title: title.into() }
    }

    /// A logarithmic axis of times in ns, labelled in the unit of times.
    pub fn times(values: impl Iterator<Item = f64>, what: &str) -> Scale {
        Scale::logarithmic(values, TIME_NS, format!("{what} ({TIME})"))
    }

    /// The time of a run that is so long, in the unit that suits it; values are in that unit.
    pub fn run(length_ns: u64) -> (Scale, f64) {
        let (unit_s, unit) = match length_ns / S {
            0..=300 => (1.0, "s"),
            301..=18_000 => (60.0, "min"),
            18_001..=864_000 => (3600.0, "h"),
            _ => (86_400.0, "d"),
        };
        let unit_ns = unit_s * S as f64;
        (Scale::linear(0.0, (length_ns as f64 / unit_ns).max(1e-6), 10, format!("time ({unit})")), unit_ns)
    }
}

/// The next of 1, 2 or 5 times a power of ten.
fn round(step: f64) -> f64 {
    let decade = 10_f64.powf(step.log10().floor());
    let digit = [1.0, 2.0, 5.0].into_iter().find(|digit| digit * decade >= step * (1.0 - 1e-9));
    digit.unwrap_or(10.0) * decade
}

/// A value with the digits that a step has.
fn decimal(value: f64, step: f64) -> String {
    let digits = (-step.log10().floor()).clamp(0.0, 9.0) as usize;
    // Without the sign of a zero.
    format!("{:.digits$}", value + 0.0)
}

/// A round number without the noise of its logarithm; large ones with their decade.
pub fn short(value: f64) -> String {
    let digits = (2.0 - value.log10().floor()).clamp(0.0, 6.0) as usize;
    let text = format!("{value:.digits$}");
    let text =
        if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text };
    for (zeros, suffix) in [("000000000", "G"), ("000000", "M"), ("000", "k")] {
        if let Some(number) = text.strip_suffix(zeros).filter(|number| !number.is_empty()) {
            return format!("{number}{suffix}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(scale: &Scale) -> String {
        scale.ticks.iter().filter_map(|tick| tick.label.clone()).collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn a_logarithmic_axis_holds_its_values_and_labels_few() {
        let text = |values: &[f64], unit: f64| {
            let scale = Scale::logarithmic(values.iter().copied(), unit, "");
            let inside = |v: &f64| scale.low < v.log10() && v.log10() < scale.high;
            assert!(values.iter().all(inside), "{scale:?}");
            labels(&scale)
        };
        assert_eq!(text(&[3.0, 40.0], 1.0), "2 5 10 20 50");
        assert_eq!(text(&[10.0], 1.0), "5 10 20");
        assert_eq!(text(&[0.3, 70_000.0], 1.0), "1 10 100 1k 10k 100k");
        assert_eq!(text(&[50.0, 5e6], 1e3), "0.1 1 10 100 1k 10k");
        assert_eq!(
            Scale::logarithmic(std::iter::empty(), 1.0, ""),
            Scale::logarithmic([1.0, 10.0].into_iter(), 1.0, "")
        );
    }

    #[test]
    fn a_linear_axis_has_round_labels() {
        assert_eq!(labels(&Scale::linear(0.0, 9.7, 10, "")), "0 1 2 3 4 5 6 7 8 9");
        assert_eq!(labels(&Scale::linear(-0.3, 0.31, 4, "")), "-0.2 0.0 0.2");
        assert_eq!(labels(&Scale::linear(160.2, 239.9, 4, "")), "180 200 220");
        let flat = Scale::around([5.0; 3].into_iter(), 4, "");
        assert!(flat.low < 5.0 && 5.0 < flat.high, "{flat:?}");
        assert!(!Scale::around(std::iter::empty(), 4, "").ticks.is_empty());
    }

    #[test]
    fn the_time_of_a_run_has_the_unit_that_suits_it() {
        let titles = [10 * S, 3_000 * S, 86_400 * S, 2_000_000 * S].map(|ns| Scale::run(ns).0.title);
        assert_eq!(titles, ["time (s)", "time (min)", "time (h)", "time (d)"]);
        assert_eq!(Scale::run(86_400 * S).1, 3_600e9);
    }
}
