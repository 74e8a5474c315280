//! A chart: SVG that is stretched to the place it gets, with lines that keep their width, and HTML labels on it.

use std::fmt::Write;

use super::scale::Scale;

/// The drawing's own units; the page stretches them.
const WIDTH: f64 = 2000.0;
const HEIGHT: f64 = 1000.0;

/// The number of colours of the page: `c0` to `c7`.
pub const COLOURS: usize = 8;

/// Text as it stands in HTML and XML.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            // What XML does not allow anywhere.
            character if character.is_control() && character != '\n' && character != '\t' => {
                escaped.push(' ')
            }
            character => escaped.push(character),
        }
    }
    escaped
}

/// One chart under construction. Writing into its strings cannot fail.
#[derive(Debug)]
pub struct Chart {
    x: Scale,
    y: Scale,
    height: u32,
    drawing: String,
    labels: String,
    legend: String,
}

impl Chart {
    /// An empty one, so many px high.
    pub fn new(x: Scale, y: Scale, height: u32) -> Chart {
        let mut chart =
            Chart { x, y, height, drawing: String::new(), labels: String::new(), legend: String::new() };
        chart.grid();
        chart
    }

    fn grid(&mut self) {
        let (x, y) = (self.x.clone(), self.y.clone());
        let mut path = [String::new(), String::new()];
        for tick in &x.ticks {
            let at = x.place(tick.at);
            let _ = write!(path[usize::from(tick.label.is_none())], "M{:.0} 0v{HEIGHT}", at * WIDTH);
        }
        for tick in &y.ticks {
            let at = 1.0 - y.place(tick.at);
            let _ = write!(path[usize::from(tick.label.is_none())], "M0 {:.0}h{WIDTH}", at * HEIGHT);
        }
        let _ = write!(
            self.drawing,
            "<path class=\"grid\" d=\"{}\"/><path class=\"fine\" d=\"{}\"/>",
            path[0], path[1]
        );
        // Of many labels every second one has no room on a narrow page.
        let many = labelled(&x).count() > 7;
        for (place, (at, label)) in labelled(&x).enumerate() {
            let narrow = if many && place % 2 == 1 { " odd" } else { "" };
            let _ = write!(
                self.labels,
                "<span class=\"x{narrow}\" style=\"left:{:.2}%\">{label}</span>",
                at * 100.0
            );
        }
        for (at, label) in labelled(&y) {
            let top = (1.0 - at) * 100.0;
            let _ = write!(self.labels, "<span class=\"y\" style=\"top:{top:.2}%\">{label}</span>");
        }
    }

    fn at(&self, (x, y): (f64, f64)) -> (i64, i64) {
        let x = (self.x.place(x) * WIDTH).clamp(-WIDTH, 2.0 * WIDTH);
        let y = ((1.0 - self.y.place(y)) * HEIGHT).clamp(-HEIGHT, 2.0 * HEIGHT);
        (x.round() as i64, y.round() as i64)
    }

    /// Points as a path, each relative to the one before: that takes the fewest letters.
    fn path(&self, points: impl Iterator<Item = (f64, f64)>) -> String {
        let mut path = String::new();
        let mut last = None;
        for point in points {
            let (x, y) = self.at(point);
            let _ = match last {
                None => write!(path, "M{x} {y}l"),
                Some((from_x, from_y)) => write!(path, "{} {} ", x - from_x, y - from_y),
            };
            last = Some((x, y));
        }
        path.trim_end_matches(['l', ' ']).to_owned()
    }

    fn draw(&mut self, class: &str, path: &str) {
        if !path.is_empty() {
            let _ = write!(self.drawing, "<path class=\"{class}\" d=\"{path}\"/>");
        }
    }

    /// A curve through points.
    pub fn line(&mut self, class: &str, points: impl Iterator<Item = (f64, f64)>) {
        let path = self.path(points);
        self.draw(&format!("line {class}"), &path);
    }

    /// Steps: begin, end and value of each. A gap between two of them stays one.
    pub fn steps(&mut self, class: &str, steps: impl Iterator<Item = (f64, f64, f64)>) {
        let mut path = String::new();
        let mut row: Vec<(f64, f64)> = Vec::new();
        for (begin, end, value) in steps {
            if row.last().is_some_and(|(last, _)| (begin - last).abs() > 1e-9 * last.abs().max(1.0)) {
                path += &self.path(row.drain(..));
            }
            row.extend([(begin, value), (end, value)]);
        }
        path += &self.path(row.into_iter());
        self.draw(&format!("line {class}"), &path);
    }

    /// An area between two curves: place, smallest and largest value.
    pub fn band(&mut self, class: &str, points: &[(f64, f64, f64)]) {
        let there = points.iter().map(|(x, _, high)| (*x, *high));
        let back = points.iter().rev().map(|(x, low, _)| (*x, *low));
        let path = self.path(there.chain(back));
        self.draw(&format!("band {class}"), &path);
    }

    /// Bars from the bottom: begin, end and value of each.
    pub fn bars(&mut self, class: &str, bars: impl Iterator<Item = (f64, f64, f64)>) {
        let mut path = String::new();
        for (begin, end, value) in bars {
            let ((left, top), (right, bottom)) = (self.at((begin, value)), self.at((end, self.y.low)));
            let _ = write!(path, "M{left} {bottom}V{top}H{right}V{bottom}z");
        }
        self.draw(&format!("bar {class}"), &path);
    }

    /// A mark at one place, with a text that shows when it is pointed at.
    pub fn dot(&mut self, class: &str, point: (f64, f64), what: &str) {
        let (x, y) = self.at(point);
        let what = escape(what);
        let _ =
            write!(self.drawing, "<path class=\"dot {class}\" d=\"M{x} {y}h0\"><title>{what}</title></path>");
    }

    /// A vertical line over the whole chart, with a text that shows when it is pointed at.
    pub fn event(&mut self, class: &str, x: f64, what: &str) {
        let (x, what) = (self.at((x, self.y.low)).0, escape(what));
        let _ = write!(
            self.drawing,
            "<path class=\"event {class}\" d=\"M{x} 0v{HEIGHT}\"><title>{what}</title></path>"
        );
    }

    /// A vertical limit with its name; `line` keeps names that are near each other apart.
    pub fn limit_x(&mut self, class: &str, x: f64, line: u32, what: &str) {
        let at = self.x.place(x);
        if !(0.0..=1.0).contains(&at) {
            return;
        }
        let _ = write!(self.drawing, "<path class=\"limit {class}\" d=\"M{:.0} 0v{HEIGHT}\"/>", at * WIDTH);
        // Towards the side that has room.
        let (side, from) = if at < 0.5 { ("left", at) } else { ("right", 1.0 - at) };
        let (from, top, what) = (from * 100.0, 2 + 16 * line, escape(what));
        let _ = write!(
            self.labels,
            "<span class=\"note {class}\" style=\"{side}:{from:.2}%;top:{top}px\">{what}</span>"
        );
    }

    /// A horizontal limit with its name.
    pub fn limit_y(&mut self, class: &str, y: f64, what: &str) {
        let at = 1.0 - self.y.place(y);
        let what = escape(what);
        let _ = write!(self.drawing, "<path class=\"limit {class}\" d=\"M0 {:.0}h{WIDTH}\"/>", at * HEIGHT);
        let _ = write!(
            self.labels,
            "<span class=\"note above {class}\" style=\"left:0;top:{:.2}%\">{what}</span>",
            at * 100.0
        );
    }

    /// A line of the legend; an empty class has no swatch.
    pub fn explain(&mut self, class: &str, what: &str) {
        let swatch =
            if class.is_empty() { String::new() } else { format!("<i class=\"swatch {class}\"></i>") };
        let _ = write!(self.legend, "<li>{swatch}{}</li>", escape(what));
    }

    /// The chart as a figure of a page. `id` names it for links.
    pub fn finish(self, id: &str, title: &str) -> String {
        let Chart { x, y, height, drawing, labels, legend } = self;
        let (title, id) = (escape(title), escape(id));
        let head = if title.is_empty() { String::new() } else { format!("<figcaption>{title}</figcaption>") };
        let legend = if legend.is_empty() { legend } else { format!("<ul class=\"legend\">{legend}</ul>") };
        format!(
            "<figure id=\"{id}\">{head}<div class=\"unit\">{}</div><div class=\"plot\" \
             style=\"height:{height}px\"><svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} \
             {HEIGHT}\" preserveAspectRatio=\"none\" role=\"img\" \
             aria-label=\"{title}\">{drawing}</svg>{labels}</div><div \
             class=\"under\">{}</div>{legend}</figure>\n",
            escape(&y.title),
            escape(&x.title)
        )
    }
}

/// The labelled ticks: place and label.
fn labelled(scale: &Scale) -> impl Iterator<Item = (f64, String)> {
    scale.ticks.iter().filter_map(|tick| Some((scale.place(tick.at), escape(tick.label.as_ref()?))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> Chart {
        Chart::new(Scale::linear(0.0, 10.0, 5, "x"), Scale::linear(0.0, 1.0, 5, "y"), 200)
    }

    fn paths(chart: Chart, class: &str) -> Vec<String> {
        let html = chart.finish("id", "title");
        let document = roxmltree::Document::parse(&html).unwrap();
        let of_class = |node: &roxmltree::Node<'_, '_>| node.attribute("class") == Some(class);
        document
            .descendants()
            .filter(of_class)
            .map(|node| node.attribute("d").unwrap_or("").to_owned())
            .collect()
    }

    #[test]
    fn a_gap_between_steps_is_not_bridged() {
        let mut chart = chart();
        chart.steps("c0", [(1.0, 2.0, 0.5), (2.0, 3.0, 0.25), (5.0, 6.0, 0.5)].into_iter());
        assert_eq!(paths(chart, "line c0"), ["M200 500l200 0 0 250 200 0M1000 500l200 0"]);
    }

    #[test]
    fn a_band_goes_there_and_back() {
        let mut chart = chart();
        chart.band("c1", &[(0.0, 0.0, 0.5), (10.0, 0.25, 1.0)]);
        chart.band("c1", &[]);
        assert_eq!(paths(chart, "band c1"), ["M0 500l2000 -500 0 750 -2000 250"]);
    }

    #[test]
    fn names_cannot_break_the_page() {
        let mut chart = chart();
        chart.explain("c0", "<script>\"&\u{1}");
        chart.dot("c0", (1.0, 1.0), "a < b");
        let html = chart.finish("a\"b", "t");
        let document = roxmltree::Document::parse(&html).unwrap();
        assert!(document.descendants().any(|node| node.text() == Some("<script>\"& ")), "{html}");
        assert!(!html.contains("<script>"));
    }
}
