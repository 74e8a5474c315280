//! What all plots share: a page with its title, the facts without which a latency says little, the legend below, and
//! logarithmic axes.

use std::ops::Range;
use std::time::SystemTime;

use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, DefaultFormatting, KeyPointHint, ValueFormatter};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::PlotError;
use crate::telemetry::Quantiles;
use crate::telemetry::summary::plural;
use crate::telemetry::{Run, Summary};
use crate::time::{MS, Ns, S, US, three_digits};

/// Where a plot is drawn.
pub type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Width of a page, px: that of a text column, at a size that can still be read there.
pub const WIDTH: u32 = 1000;

/// Height of the plot with its axes, px.
const PLOT_HEIGHT: u32 = 420;

/// Distance of two lines of text, px.
const LINE: u32 = 20;

/// Empty paper at the left, px.
pub const MARGIN: u32 = 16;

/// Where plots begin: room for the labels of the y axis, px.
pub const LEFT: u32 = 80;

/// Room right of the plot, px.
pub const RIGHT: u32 = 24;

/// Colours that differ for any kind of colour vision: Okabe and Ito, Color Universal Design (2008), their
/// yellow darkened for white paper.
pub const PALETTE: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
    RGBColor(160, 150, 0),
];

/// What stands out: a maximum, a warning.
pub const ALARM: RGBColor = PALETTE[1];

/// What stands back.
pub const GREY: RGBColor = RGBColor(120, 120, 120);

const TEXT: RGBColor = RGBColor(40, 40, 40);

/// A text of this size, px, at the left of its place.
pub fn text(size: u32, color: RGBColor) -> TextStyle<'static> {
    // The back end takes a size of 1.24 times that of the letters.
    ("sans-serif", f64::from(size) * 1.24).into_font().color(&color)
}

/// The same with another anchor.
pub fn anchored(style: TextStyle<'static>, horizontal: HPos, vertical: VPos) -> TextStyle<'static> {
    style.pos(Pos::new(horizontal, vertical))
}

/// A place of the whole page as one of `area`.
pub fn within(area: &Area<'_>, (x, y): (i32, i32)) -> (i32, i32) {
    let (left, top) = area.get_base_pixel();
    (x - left, y - top)
}

/// An axis of a chart: its range, what is written at its grid, and its title.
pub type Scale<'a, R> = (R, &'a dyn Fn(&f64) -> String, &'a str);

/// A chart whose values are logarithms.
pub type Chart<'a, 'b, X> = ChartContext<'b, SVGBackend<'a>, Cartesian2d<X, Axis>>;

/// A chart on `area`, with its axes and its grid, and so much room above it.
pub fn chart<'a, 'b, X>(
    area: &'b Area<'a>,
    top: i32,
    (x, x_label, x_title): Scale<'_, X>,
    (y, y_label, y_title): Scale<'_, Axis>,
) -> Result<Chart<'a, 'b, X::CoordDescType>, PlotError>
where
    X: AsRangedCoord<Value = f64>,
    X::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    let mut chart = ChartBuilder::on(area)
        .x_label_area_size(44)
        .margin_left(MARGIN)
        .y_label_area_size(LEFT - MARGIN)
        .margin_right(RIGHT)
        .margin_top(top)
        .build_cartesian_2d(x, y)?;
    chart
        .configure_mesh()
        .x_labels(12)
        .x_label_formatter(&x_label)
        .y_label_formatter(&y_label)
        .x_desc(x_title)
        .y_desc(y_title)
        .label_style(text(12, BLACK))
        .axis_desc_style(text(13, BLACK))
        .bold_line_style(BLACK.mix(0.15))
        .light_line_style(BLACK.mix(0.05))
        .draw()?;
    Ok(chart)
}

/// A page.
#[derive(Debug)]
pub struct Sheet<'a> {
    run: &'a Run,
    summary: &'a Summary,
    title: &'static str,
    legend: Vec<(Option<RGBColor>, String)>,
}

impl<'a> Sheet<'a> {
    /// An empty page.
    pub fn new(run: &'a Run, summary: &'a Summary, title: &'static str) -> Sheet<'a> {
        Sheet { run, summary, title, legend: Vec::new() }
    }

    /// Adds a line to the legend; without a colour it is a remark.
    pub fn explain(&mut self, color: Option<RGBColor>, line: String) {
        self.legend.push((color, line));
    }

    /// Adds a line for a quantity.
    pub fn explain_quantiles(&mut self, color: RGBColor, what: &str, quantiles: &Quantiles) {
        self.explain(Some(color), format!("{what}: {}", numbers(quantiles)));
    }

    /// Draws it, with `plot` in the middle.
    pub fn draw(self, plot: impl FnOnce(&Area<'_>) -> Result<(), PlotError>) -> Result<String, PlotError> {
        let mut svg = String::new();
        let warnings = self.warnings();
        let top = 68 + LINE * warnings.len() as u32;
        let height = top + PLOT_HEIGHT + LINE * self.legend.len() as u32 + 16;
        {
            let root = SVGBackend::with_string(&mut svg, (WIDTH, height)).into_drawing_area();
            root.fill(&WHITE)?;
            let left = MARGIN as i32;
            root.draw_text(self.title, &anchored(text(18, TEXT), HPos::Left, VPos::Top), (left, 8))?;
            let stamp = humantime::format_rfc3339_seconds(SystemTime::now());
            let stamp = format!("fieldbeat {}, {stamp}", env!("CARGO_PKG_VERSION"));
            let right = anchored(text(12, GREY), HPos::Right, VPos::Top);
            root.draw_text(&stamp, &right, ((WIDTH - RIGHT) as i32, 10))?;
            let facts = [(self.facts(), TEXT), (self.host(), TEXT)].into_iter();
            let lines = facts.chain(warnings.into_iter().map(|line| (line, ALARM)));
            for (line, (words, color)) in lines.enumerate() {
                let place = (left, 32 + (LINE * line as u32) as i32 - 2 * line as i32);
                root.draw_text(&words, &anchored(text(13, color), HPos::Left, VPos::Top), place)?;
            }
            let (_, rest) = root.split_vertically(top);
            let (middle, _) = rest.split_vertically(PLOT_HEIGHT);
            plot(&middle)?;
            for (line, (color, words)) in self.legend.iter().enumerate() {
                let y = (top + PLOT_HEIGHT + LINE * line as u32) as i32 + 8;
                if let Some(color) = color {
                    let swatch = [(left, y + 6), (left + 24, y + 6)];
                    root.draw(&PathElement::new(swatch, color.stroke_width(3)))?;
                }
                let style = anchored(text(12, TEXT), HPos::Left, VPos::Top);
                root.draw_text(words, &style, (left + 32, y))?;
            }
            root.present()?;
        }
        Ok(svg)
    }

    /// What ran, how, and for how long.
    fn facts(&self) -> String {
        let Summary { cycle, realtime, drives, .. } = self.summary;
        let machine = self.run.plan.source.as_ref().and_then(|path| path.file_name());
        let machine = machine.map_or(String::new(), |name| format!("{}: ", name.to_string_lossy()));
        let core = realtime.core.map_or(String::from("any core"), |core| format!("core {core}"));
        let priority = if realtime.priority > 0 { format!(" {}", realtime.priority) } else { String::new() };
        format!(
            "{machine}{} of {} in {}, {}; {}{priority} on {core}",
            plural(cycle.executed, "cycle"),
            Ns(cycle.period_ns),
            Ns(cycle.planned.saturating_mul(cycle.period_ns)),
            plural(drives.len() as u64, "drive"),
            realtime.policy,
        )
    }

    fn host(&self) -> String {
        let host = &self.summary.host;
        let or = |text: &Option<String>| text.clone().unwrap_or_else(|| String::from("?"));
        let steal = host.steal_ms.map_or(String::from("?"), |ms| Ns(ms * MS).to_string());
        let (name, kernel, preemption, cpu) =
            (or(&host.name), or(&host.kernel), or(&host.preemption), or(&host.cpu));
        format!("host {name}: kernel {kernel}, {preemption}; {cpu}; steal {steal}")
    }

    /// What limits the meaning of these numbers.
    fn warnings(&self) -> Vec<String> {
        let real = &self.summary.realtime;
        let mut warnings = Vec::new();
        if !real.missing.is_empty() {
            warnings.push(String::from("These numbers are not real-time; the summary says why."));
        }
        if real.telemetry_lost > 0 {
            warnings.push(format!(
                "{} lost: not in these curves. Maxima and counts are exact.",
                plural(real.telemetry_lost, "telemetry record")
            ));
        }
        warnings
    }
}

/// A quantity in numbers; the maximum is exact, the others are not known better than this.
pub fn numbers(quantiles: &Quantiles) -> String {
    let or = |ns: Option<u64>| ns.map_or(String::from("-"), |ns| Ns(three_digits(ns)).to_string());
    let max = quantiles.max.map_or(String::from("-"), |ns| Ns(ns).to_string());
    let cycle = quantiles.max_cycle.map_or(String::new(), |cycle| format!(" (cycle {cycle})"));
    format!(
        "p50 {}, p99 {}, p99.9 {}, max {max}{cycle}; n = {}",
        or(quantiles.p50),
        or(quantiles.p99),
        or(quantiles.p99_9),
        quantiles.count
    )
}

/// An axis whose grid is said. A logarithmic one is a linear one of logarithms.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// Its begin.
    pub low: f64,
    /// Its end.
    pub high: f64,
    /// What is labelled.
    pub bold: Vec<f64>,
    /// The rest of the grid.
    pub light: Vec<f64>,
}

impl Axis {
    /// A logarithmic axis that holds `values`, all positive, and begins and ends at 1, 2 or 5 times a power of ten.
    pub fn logarithmic(values: impl Iterator<Item = f64>) -> Axis {
        let (least, most) = values.fold((f64::MAX, 0.0_f64), |(least, most), v| (least.min(v), most.max(v)));
        let (least, most) = if most > 0.0 { (least, most) } else { (1.0, 10.0) };
        let grid: Vec<(f64, bool)> = ((least.log10().floor() as i32 - 1)..=(most.log10().ceil() as i32))
            .flat_map(|decade| (1..10).map(move |digit| (f64::from(digit) * 10_f64.powi(decade), digit)))
            .map(|(value, digit)| (value, matches!(digit, 1 | 2 | 5)))
            .collect();
        // A little beyond, so that no curve runs along the frame.
        let low = grid.iter().rfind(|(value, round)| *round && *value < least * 0.95).map_or(least, |g| g.0);
        let high = grid.iter().find(|(value, round)| *round && *value > most * 1.05).map_or(most, |g| g.0);
        let wide = high / low > 1e3 * 1.001;
        let is_bold = |value: f64, round: bool| {
            if wide { (value.log10() - value.log10().round()).abs() < 1e-9 } else { round }
        };
        let within = grid.iter().filter(|(value, _)| (low * 0.999..=high * 1.001).contains(value));
        let (bold, light): (Vec<_>, Vec<_>) = within.partition(|(value, round)| is_bold(*value, *round));
        let log = |points: Vec<&(f64, bool)>| points.iter().map(|(value, _)| value.log10()).collect();
        Axis { low: low.log10(), high: high.log10(), bold: log(bold), light: log(light) }
    }
}

impl Ranged for Axis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, pixels: (i32, i32)) -> i32 {
        RangedCoordf64::from(self.range()).map(value, pixels)
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        if hint.weight().allow_light_points() { self.light.clone() } else { self.bold.clone() }
    }

    fn range(&self) -> Range<f64> {
        self.low..self.high
    }
}

/// A logarithm of ns as us.
pub fn label_us(log_ns: &f64) -> String {
    label(10_f64.powf(*log_ns) / US as f64)
}

/// A logarithm of a count.
pub fn label_count(log: &f64) -> String {
    label(10_f64.powf(*log))
}

/// A round number without the noise of its logarithm.
fn label(value: f64) -> String {
    let digits = (2.0 - value.log10().floor()).clamp(0.0, 6.0) as usize;
    let text = format!("{value:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// A time of the run, in the unit that suits its length: the factor from s, and its name.
pub fn time_unit(length_ns: u64) -> (f64, &'static str) {
    match length_ns / S {
        0..=300 => (1.0, "s"),
        301..=18_000 => (60.0, "min"),
        _ => (3600.0, "h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_axis_holds_its_values_and_labels_few() {
        let labels = |values: &[f64]| {
            let axis = Axis::logarithmic(values.iter().copied());
            let inside = |v: &f64| axis.low < v.log10() && v.log10() < axis.high;
            assert!(values.iter().all(inside), "{axis:?}");
            axis.bold.iter().map(label_count).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(labels(&[3.0, 40.0]), "2 5 10 20 50");
        assert_eq!(labels(&[10.0]), "5 10 20");
        assert_eq!(labels(&[0.3, 70_000.0]), "1 10 100 1000 10000 100000");
        assert_eq!(labels(&[0.03]), "0.02 0.05");
        assert_eq!(Axis::logarithmic(std::iter::empty()), Axis::logarithmic([1.0, 10.0].into_iter()));
    }

    #[test]
    fn microseconds_are_plain_numbers() {
        let us = |ns: f64| label_us(&ns.log10());
        assert_eq!([us(50.0), us(1e3), us(2e4), us(5e6)], ["0.05", "1", "20", "5000"]);
    }
}
