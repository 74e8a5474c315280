//! The largest values over the time of the run, and above them when exchanges were missed and slots skipped.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use super::PlotError;
use super::sheet::{
    ALARM, Axis, GREY, LEFT, PALETTE, Sheet, anchored, chart, label_us, text, time_unit, within,
};
use crate::telemetry::summary::plural;
use crate::telemetry::timeline::Stretch;
use crate::telemetry::{Run, Summary};
use crate::time::{Ns, S};

/// A quantity: its place in a stretch, its name and colour.
type Quantity = (fn(&Stretch) -> u64, &'static str, RGBColor);

const QUANTITIES: [Quantity; 3] = [
    (|stretch| stretch.busy_ns, "execution time of a cycle", PALETTE[2]),
    (|stretch| stretch.rtt_ns, "round trip of any drive", PALETTE[3]),
    (|stretch| stretch.wake_ns, "wake-up latency", PALETTE[0]),
];

/// What goes wrong: its count in a stretch, and its name.
type Mishap = (fn(&Stretch) -> u64, &'static str);

const MISHAPS: [Mishap; 2] = [(|stretch| stretch.missed, "missed"), (|stretch| stretch.skipped, "skipped")];

/// Height of the row of a mishap, px.
const ROW: i32 = 18;

pub fn plot(run: &Run, summary: &Summary) -> Result<String, PlotError> {
    let (timeline, period_ns) = (&run.measured.timeline, summary.cycle.period_ns);
    let stretches = timeline.stretches();
    let width_ns = timeline.width().saturating_mul(period_ns);
    let (unit_s, unit) = time_unit(summary.cycle.planned.saturating_mul(period_ns));
    // Stretch by stretch, in that unit.
    let step = width_ns as f64 / S as f64 / unit_s;
    let end = step * stretches.len().max(1) as f64;

    let mut sheet = Sheet::new(run, summary, "Course of the run: the largest value in each step of time");
    for (of, name, color) in QUANTITIES {
        let max = stretches.iter().map(of).max().filter(|max| *max > 0);
        let max = max.map_or(String::from("-"), |ns| Ns(ns).to_string());
        sheet.explain(Some(color), format!("{name}: max {max}"));
    }
    sheet.explain(
        None,
        format!(
            "One step is {} ({}). In all: {} missed, {} skipped.",
            Ns(width_ns),
            plural(timeline.width(), "cycle"),
            plural(run.end.status.missed, "exchange"),
            plural(summary.cycle.skipped, "slot")
        ),
    );
    sheet.draw(|area| {
        let values = stretches.iter().flat_map(|stretch| QUANTITIES.map(|(of, ..)| of(stretch)));
        let values = values.filter(|ns| *ns > 0).chain([period_ns]).map(|ns| ns as f64);
        let values = Axis::logarithmic(values);
        let time = |time: &f64| format!("{}", (time * 1e6).round() / 1e6);
        let mut chart = chart(
            area,
            18 + ROW * MISHAPS.len() as i32,
            (0.0..end, &time, &format!("time ({unit})")),
            (values, &label_us, "largest (us)"),
        )?;
        let period = (period_ns as f64).log10();
        chart.draw_series(DashedLineSeries::new(
            [(0.0, period), (end, period)],
            6,
            4,
            GREY.stroke_width(1),
        ))?;
        let (x, y) = within(area, chart.plotting_area().map_coordinate(&(0.0, period)));
        let style = anchored(text(12, GREY), HPos::Left, VPos::Bottom);
        area.draw_text(&format!("period {}", Ns(period_ns)), &style, (x + 6, y - 3))?;
        for (of, _, color) in QUANTITIES {
            for (first, values) in unbroken(stretches, of) {
                // A step each, so that a lonely one is seen too.
                let steps = values.iter().enumerate().flat_map(|(place, ns)| {
                    let begin = step * (first + place) as f64;
                    let log = (*ns as f64).log10();
                    [(begin, log), (begin + step, log)]
                });
                chart.draw_series(LineSeries::new(steps, color.stroke_width(1)))?;
            }
        }
        for (row, (of, name)) in MISHAPS.into_iter().enumerate() {
            let y = 8 + ROW * row as i32;
            let style = anchored(text(12, BLACK), HPos::Right, VPos::Center);
            area.draw_text(name, &style, (LEFT as i32 - 8, y + ROW / 2))?;
            let x = |time: f64| within(area, chart.plotting_area().map_coordinate(&(time, period))).0;
            area.draw(&Rectangle::new([(x(0.0), y + 2), (x(end), y + ROW - 2)], BLACK.mix(0.06).filled()))?;
            for (place, _) in stretches.iter().enumerate().filter(|(_, stretch)| of(stretch) > 0) {
                let begin = x(step * place as f64);
                // At least two pixels: one is easily overlooked.
                let end = x(step * (place + 1) as f64).max(begin + 2);
                area.draw(&Rectangle::new([(begin, y + 2), (end, y + ROW - 2)], ALARM.filled()))?;
            }
        }
        Ok(())
    })
}

/// Rows of stretches in which the quantity was seen: the place of the first, and the values.
fn unbroken(stretches: &[Stretch], of: fn(&Stretch) -> u64) -> Vec<(usize, Vec<u64>)> {
    let mut rows: Vec<(usize, Vec<u64>)> = Vec::new();
    for (place, stretch) in stretches.iter().enumerate() {
        match (of(stretch), rows.last_mut()) {
            (0, _) => {}
            (ns, Some((first, row))) if *first + row.len() == place => row.push(ns),
            (ns, _) => rows.push((place, vec![ns])),
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_is_not_bridged() {
        let stretch = |wake_ns| Stretch { wake_ns, ..Stretch::default() };
        let stretches = [0, 3, 4, 0, 0, 5].map(stretch);
        assert_eq!(unbroken(&stretches, |stretch| stretch.wake_ns), [(1, vec![3, 4]), (5, vec![5])]);
        assert_eq!(unbroken(&stretches, |stretch| stretch.rtt_ns), []);
    }
}
