//! A run as one HTML file that needs nothing else: its verdict, plots, numbers, configuration and host, for light and
//! dark screens of any width.

use std::fmt::Write;

use super::archive::{Archive, Drive};
use super::compare::{Verdict, compare, differences, percent, significant};
use super::plots::chart::escape;
use super::plots::{motion, percentiles, timeline, wake};
use super::summary::{Carried, plural};
use fieldbeat_core::time::{MS, Ns, three_digits};
use fieldbeat_telemetry::Quantiles;
use fieldbeat_telemetry::motion::Mark;
use fieldbeat_telemetry::signals::{FOLLOWING_ERROR, kept_of_loop};

/// The axes of so many drives are shown at once; those of more are opened one by one.
const OPEN: usize = 8;

/// The column whose words have the colour of their row.
pub const VERDICT: &str = " verdict";

/// A table of the page.
#[derive(Clone, Debug, Default)]
pub struct Table {
    /// The title, under which it is found.
    pub title: String,
    /// The description.
    pub about: String,
    /// The columns; those whose name begins with a blank hold words, not numbers.
    pub columns: Vec<&'static str>,
    /// The rows.
    pub rows: Vec<Row>,
}

/// A row of a table.
#[derive(Clone, Debug)]
pub struct Row {
    /// Whether it stands out: not so, as good, or as bad.
    pub good: Option<bool>,
    /// The cells.
    pub cells: Vec<String>,
}

impl From<Vec<String>> for Row {
    fn from(cells: Vec<String>) -> Row {
        Row { good: None, cells }
    }
}

/// The contents of the page.
#[derive(Debug)]
pub struct Page<'a> {
    /// The run.
    pub run: &'a Archive,
    /// Whether it passed, and why.
    pub passed: bool,
    /// The verdict in words.
    pub verdict: String,
    /// Earlier runs, by their names.
    pub earlier: &'a [(String, Archive)],
    /// Whether its period was carried.
    pub carried: Option<&'a Carried>,
    /// The tables before the plots.
    pub tables: Vec<Table>,
    /// Texts at the end: titles, and lines.
    pub texts: &'a [(String, String)],
}

impl Page<'_> {
    /// The page as HTML, which is well-formed XML too.
    pub fn html(&self) -> String {
        let run = self.run;
        let name = run.machine.as_deref().unwrap_or("a machine built in code");
        let mut html = format!(
            "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"/><meta name=\"viewport\" \
             content=\"width=device-width,initial-scale=1\"/><title>{0}: \
             fieldbeat</title><style>{1}</style></head><body>\n<header><h1>{0}</h1>\n",
            escape(name),
            include_str!("page.css")
        );
        // Writing into a string cannot fail.
        let _ =
            writeln!(html, "<p class=\"facts\">{}<br/>{}</p>", escape(&self.facts()), escape(&self.host()));
        let (class, word) = if self.passed { ("", "passed") } else { (" bad", "failed") };
        let _ = writeln!(html, "<p class=\"verdict{class}\"><b>{word}</b>{}</p>", escape(&self.verdict));
        if let Some(carried) = self.carried {
            let class = if carried.carried { "facts" } else { "warning" };
            let _ = writeln!(html, "<p class=\"{class}\">{}</p>", escape(&carried.to_string()));
        }
        for warning in self.warnings() {
            let _ = writeln!(html, "<p class=\"warning\">{}</p>", escape(&warning));
        }
        html += &self.tiles();
        html += "<nav><a href=\"#latency\">Latency</a><a href=\"#round-trips\">Round trips</a><a \
             href=\"#course\">Course</a><a href=\"#motion\">Motion</a><a \
             href=\"#numbers\">Numbers</a></nav></header>\n";
        self.tables.iter().for_each(|table| html += &section(table));
        for (name, earlier) in self.earlier {
            html += &section(&comparison(name, run, earlier));
        }
        html += "<h2>Timing</h2>\n";
        html += &wake::plot(run, self.earlier);
        html += &percentiles::of_the_run(run);
        html += &percentiles::of_the_drives(run);
        html += &timeline::plot(run);
        html += &self.motion();
        html += "<h2 id=\"numbers\">Numbers</h2>\n";
        [drives(run), loop_times(run), late(run), events(run)].iter().for_each(|table| html += &part(table));
        for (title, text) in self.texts {
            let (title, text) = (escape(title), escape(text));
            let _ = writeln!(html, "<details><summary>{title}</summary><pre>{text}</pre></details>");
        }
        html + "</body></html>\n"
    }

    fn facts(&self) -> String {
        let Archive { program, at, period_ns, drives, .. } = self.run;
        let drives = plural(drives.len() as u64, "drive");
        format!("fieldbeat {program}, {at}; {drives}, a cycle of {}", Ns(*period_ns))
    }

    fn host(&self) -> String {
        let host = &self.run.host;
        let computer = &host.computer;
        let or = |text: &Option<String>| text.clone().unwrap_or_else(|| String::from("?"));
        let core = host.core.map_or(String::from("any core"), |core| format!("core {core}"));
        let steal = computer.steal_ms.map_or(String::from("?"), |ms| Ns(ms * MS).to_string());
        let (name, kernel, preemption, cpu) =
            (or(&computer.name), or(&computer.kernel), or(&computer.preemption), or(&computer.cpu));
        let policy = &host.policy;
        format!("host {name}: kernel {kernel}, {preemption}; {cpu}; {policy} on {core}; steal {steal}")
    }

    /// The limits of the meaning of these numbers.
    fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if !self.run.host.missing.is_empty() {
            let missing = self.run.host.missing.join("; ");
            warnings.push(format!("These numbers are not real-time: {missing}"));
        }
        if self.run.counts.lost_records > 0 {
            warnings.push(format!(
                "{} lost: not in these curves. Maxima and counts are exact.",
                plural(self.run.counts.lost_records, "telemetry record")
            ));
        }
        warnings.extend(self.run.failures.iter().cloned());
        warnings
    }

    fn tiles(&self) -> String {
        let (run, counts) = (self.run, &self.run.counts);
        let share = |count: u64| percent(count as f64 / counts.planned.max(1) as f64);
        let wake = run.wake.quantiles();
        let sum = |of: fn(&Drive) -> u64| run.drives.iter().map(of).sum::<u64>().to_string();
        let tiles = [
            (whole(run.length_ns()), "run time"),
            (counts.executed.to_string(), "cycles executed"),
            (counts.skipped.to_string(), "slots skipped"),
            (share(counts.late), "late cycles"),
            (time(wake.p99), "wake-up p99"),
            (time(wake.max), "wake-up max"),
            (counts.missed.to_string(), "exchanges missed"),
            (sum(|drive| drive.losses), "links lost"),
            (sum(|drive| drive.motion.marks.faults()), "faults"),
        ];
        let tiles = tiles.map(|(value, what)| format!("<li><b>{value}</b><span>{what}</span></li>"));
        format!("<ul class=\"tiles\">{}</ul>\n", tiles.concat())
    }

    fn motion(&self) -> String {
        let mut html = String::from(
            "<h2 id=\"motion\">Motion</h2>\n<p class=\"about\">Each curve is the smallest and the largest \
             value of every step of time. Vertical lines are changes of state; faults, stops and lost links \
             stand out. Point at one to read it.</p>\n",
        );
        for (place, drive) in self.run.drives.iter().enumerate() {
            let (name, open) = (escape(&drive.name), if place < OPEN { " open=\"open\"" } else { "" });
            let facts = escape(&motion::facts(drive, self.run.period_ns));
            let plots = motion::plot(self.run, drive);
            let _ = writeln!(
                html,
                "<details{open}><summary>{name}</summary><p class=\"about\">{}; {facts}</p>{plots}</details>",
                escape(&drive.protocol)
            );
        }
        html
    }
}

/// A table under its own heading.
fn section(table: &Table) -> String {
    format!("<h2>{}</h2>\n{}", escape(&table.title), body(table))
}

/// A table under a smaller one; nothing if it is empty.
fn part(table: &Table) -> String {
    if table.rows.is_empty() {
        return String::new();
    }
    format!("<h3>{}</h3>\n{}", escape(&table.title), body(table))
}

fn body(Table { about, columns, rows, .. }: &Table) -> String {
    let class = |place: usize| if columns[place].starts_with(' ') { " class=\"words\"" } else { "" };
    let mut html = String::new();
    if !about.is_empty() {
        let _ = writeln!(html, "<p class=\"about\">{}</p>", escape(about));
    }
    if rows.is_empty() {
        return html;
    }
    html += "<div class=\"scroll\"><table><tr>";
    for (place, column) in columns.iter().enumerate() {
        let _ = write!(html, "<th{}>{}</th>", class(place), escape(column.trim()));
    }
    html += "</tr>\n";
    for Row { good, cells } in rows {
        let emphasis = match good {
            None => "",
            Some(true) => " class=\"good\"",
            Some(false) => " class=\"bad\"",
        };
        let _ = write!(html, "<tr{emphasis}>");
        for (place, cell) in cells.iter().enumerate() {
            let class = if columns[place] == VERDICT { " class=\"mark words\"" } else { class(place) };
            let _ = write!(html, "<td{class}>{}</td>", escape(cell));
        }
        html += "</tr>\n";
    }
    html + "</table></div>\n"
}

/// A time with three digits, or a dash.
pub fn time(ns: Option<u64>) -> String {
    ns.map_or(String::from("-"), |ns| Ns(three_digits(ns)).to_string())
}

/// The length of a run: its two largest units, whatever its size.
pub fn whole(ns: u64) -> String {
    let seconds = ns / 1_000_000_000;
    let (days, hours, minutes) = (seconds / 86_400, seconds / 3_600 % 24, seconds / 60 % 60);
    match (days, hours, minutes) {
        (0, 0, 0) => format!("{:.1} s", ns as f64 / 1e9),
        (0, 0, minutes) => format!("{minutes} min {} s", seconds % 60),
        (0, hours, minutes) => format!("{hours} h {minutes} min"),
        (days, hours, _) => format!("{days} d {hours} h"),
    }
}

fn comparison(name: &str, run: &Archive, earlier: &Archive) -> Table {
    let compared = compare(run, earlier);
    let count = |verdict| compared.iter().filter(|one| one.verdict == verdict).count();
    let about = match &*compared {
        [] => String::from("One of the two is too short to be compared: it has too few parts."),
        compared => format!(
            "Of {}: {} worse, {} better, {} not different. Intervals of 95 % over the parts of each run; two \
             runs differ where their intervals are apart.",
            plural(compared.len() as u64, "quantity").replace("quantitys", "quantities"),
            count(Verdict::Worse),
            count(Verdict::Better),
            count(Verdict::Same)
        ),
    };
    let rows = compared.iter().map(|one| {
        let good = match one.verdict {
            Verdict::Better => Some(true),
            Verdict::Same => None,
            Verdict::Worse => Some(false),
        };
        let cells = vec![
            one.what.clone(),
            one.verdict.word().to_owned(),
            one.this.text(one.share),
            one.earlier.text(one.share),
        ];
        Row { good, cells }
    });
    let differences = differences(run, earlier);
    let other = match &*differences {
        [] => String::new(),
        lines => format!(" The runs differ otherwise, too: {}.", lines.join("; ")),
    };
    Table {
        title: format!("Compared with {name}"),
        about: format!("{} of {}. {about}{other}", whole(earlier.length_ns()), earlier.at),
        columns: vec![" quantity", VERDICT, "this run", "earlier run"],
        rows: rows.collect(),
    }
}

/// Cells of quantiles.
fn quantiles(quantiles: &Quantiles) -> impl Iterator<Item = String> {
    [quantiles.p50, quantiles.p99, quantiles.p99_9]
        .map(time)
        .into_iter()
        .chain([quantiles.max.map_or(String::from("-"), |ns| Ns(ns).to_string())])
}

fn drives(run: &Archive) -> Table {
    let rows = run.drives.iter().map(|drive| {
        let (sums, rtt) = (&drive.exchanges, drive.rtt.quantiles());
        let counts =
            [sums.sent, sums.answered, sums.missed, sums.late, sums.rejected + sums.duplicate, sums.unsent];
        let mut cells = vec![drive.name.clone(), drive.link.clone(), drive.state.clone()];
        cells.extend(counts.map(|count| count.to_string()));
        cells.push(drive.losses.to_string());
        cells.extend(quantiles(&rtt));
        let error = |max: fieldbeat_telemetry::Largest| format!("{} {}", significant(max.value), drive.unit);
        cells.push(drive.motion.error_max.map_or(String::from("-"), error));
        let troubled = drive.losses > 0 || drive.fault.is_some() || drive.link != "online";
        let note = drive.fault.clone().or(drive.stopped.clone()).unwrap_or_default();
        cells.push(note);
        Row { good: troubled.then_some(false), cells }
    });
    Table {
        title: String::from("Drives"),
        columns: vec![
            " drive",
            " link",
            " state",
            "sent",
            "answered",
            "missed",
            "late",
            "rejected",
            "unsent",
            "lost",
            "RTT p50",
            "p99",
            "p99.9",
            "max",
            FOLLOWING_ERROR.name,
            " at the end",
        ],
        rows: rows.collect(),
        ..Table::default()
    }
}

fn loop_times(run: &Archive) -> Table {
    let rows = kept_of_loop([&run.wake, &run.jitter], None, &run.stages).map(|(kept, stage, sampled)| {
        let of = sampled.quantiles();
        let cells: Vec<String> = [kept.title(stage)].into_iter().chain(quantiles(&of)).collect();
        Row::from([cells, vec![of.count.to_string()]].concat())
    });
    Table {
        title: String::from("Loop"),
        about: format!(
            "{} slots planned = {} executed + {} skipped; {}; late limit {}",
            run.counts.planned,
            run.counts.executed,
            run.counts.skipped,
            plural(run.counts.overruns, "overrun"),
            Ns(run.late_ns)
        ),
        columns: vec![" time", "p50", "p99", "p99.9", "max", "samples"],
        rows: rows.collect(),
    }
}

fn late(run: &Archive) -> Table {
    let rows = run.causes.iter().map(|cause| {
        let worst = cause.worst_ns.map_or(String::from("-"), |ns| Ns(ns).to_string());
        Row::from(vec![cause.what.clone(), cause.count.to_string(), worst])
    });
    Table {
        title: format!("Late cycles: {}", run.counts.late),
        columns: vec![" cause", "cycles", "longest delay"],
        rows: rows.collect(),
        ..Table::default()
    }
}

fn events(run: &Archive) -> Table {
    let mut all: Vec<(u64, &Drive, &Mark)> = (run.drives.iter())
        .flat_map(|drive| drive.motion.marks.iter().map(move |mark| (mark.cycle, drive, mark)))
        .filter(|(.., mark)| mark.what.is_trouble())
        .collect();
    all.sort_by_key(|(cycle, ..)| *cycle);
    let dropped: u64 = run.drives.iter().map(|drive| drive.motion.marks.dropped()).sum();
    let rows = all.into_iter().map(|(cycle, drive, mark)| {
        Row::from(vec![
            whole(cycle * run.period_ns),
            cycle.to_string(),
            drive.name.clone(),
            motion::happened(drive, &mark.what),
        ])
    });
    Table {
        title: String::from("Faults, stops and lost links"),
        about: if dropped > 0 {
            format!("{} between the first and the newest are not listed.", plural(dropped, "event"))
        } else {
            String::new()
        },
        columns: vec![" after", "cycle", " drive", " what"],
        rows: rows.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::tests::archive;
    use fieldbeat_testing::runs::run;

    fn page(run: &Archive, earlier: &[(String, Archive)]) -> String {
        let texts = [("Configuration".to_owned(), "a < b".to_owned())];
        let verdict = "all \"well\"".to_owned();
        Page { run, passed: true, verdict, earlier, carried: None, tables: Vec::new(), texts: &texts }.html()
    }

    /// Every text of a page.
    fn texts(html: &str) -> String {
        let options = roxmltree::ParsingOptions { allow_dtd: true, ..Default::default() };
        let document = roxmltree::Document::parse_with_options(html, options).unwrap();
        let texts = document.descendants().filter(|node| node.is_text());
        texts.map(|node| node.text().unwrap_or_default().trim().to_owned() + "\n").collect()
    }

    #[test]
    fn a_page_is_whole_and_needs_nothing_from_elsewhere() {
        let run = archive(&run("x", 2_000));
        let html = page(&run, &[]);
        let texts = texts(&html);
        for text in
            ["passed", "all \"well\"", "a < b", "position (mm)", "following error (mm)", "velocity (mm/s)"]
        {
            assert!(texts.contains(text), "{text}: {texts}");
        }
        let max = format!("max {} in cycle {}", Ns(run.wake.max_ns), run.wake.max_cycle);
        assert!(texts.contains(&max), "{max}: {texts}");
        for from_elsewhere in ["http://", "https://", "src=", "@import", "url(", "<script"] {
            let html = html.replace("http://www.w3.org/2000/svg", "");
            assert!(!html.contains(from_elsewhere), "{from_elsewhere}");
        }
        // The page defines every colour that a plot uses.
        for class in ["c0", "c1", "c2", "c3", "c4", "alarm", "quiet"] {
            assert!(html.contains(&format!(".{class}{{color:")), "{class}");
        }
    }

    #[test]
    fn the_page_states_how_far_its_numbers_hold() {
        let mut run = run("x", 2_000);
        let lines = ["These numbers are not real-time: no right", "3 telemetry records lost"];
        let shown = |run: &fieldbeat_telemetry::Run| texts(&page(&archive(run), &[]));
        assert!(lines.iter().all(|line| !shown(&run).contains(line)));
        run.granted.missing = vec![String::from("no right for SCHED_FIFO")];
        run.end.status.lost_records = 3;
        assert!(lines.iter().all(|line| shown(&run).contains(line)), "{}", shown(&run));
    }

    #[test]
    fn earlier_runs_lie_over_the_latencies_and_are_compared() {
        let runs = ["x", "x"].map(|name| archive(&run(name, 20_000)));
        let texts = texts(&page(&runs[0], &[("yesterday".to_owned(), runs[1].clone())]));
        for text in ["Compared with yesterday", "0 worse, 0 better, 6 not different", "yesterday: p50 "] {
            assert!(texts.contains(text), "{text}: {texts}");
        }
    }

    /// A day of 64 axes: what is written stays small however long a run is.
    #[test]
    fn a_page_of_days_is_bounded() {
        use fieldbeat_core::axis::{Link, State, Units};
        use fieldbeat_core::drive::record::DriveRecord;
        let mut random = fastrand::Rng::with_seed(1);
        let mut run = archive(&run("x", 20_000));
        let mut motion = fieldbeat_telemetry::Motion::new(&[Units::millimetres(1.0)]);
        for index in (0..400_000_000).step_by(1_000) {
            let position = random.f64() * 400.0;
            let (link, state, velocity) = (Link::Online, State::OperationEnabled, random.f32() * 100.0);
            let record = DriveRecord {
                index,
                link,
                state,
                position,
                demand: position + 0.1,
                velocity,
                ..DriveRecord::default()
            };
            motion.enter(&record);
        }
        run.drives[0].motion = motion.axes().next().unwrap().clone();
        run.counts.planned = 400_000_000;
        let one = page(&run, &[]).len();
        run.drives = vec![run.drives[0].clone(); 64];
        let axis = (page(&run, &[]).len() - one) / 63;
        assert!(axis < 60_000 && one < 200_000, "{axis} bytes an axis, {one} with one");
        assert!(run.to_json().len() < 64 * 120_000, "{}", run.to_json().len());
    }

    #[test]
    fn the_length_of_a_run_reads_naturally() {
        let lengths = [1_500_000_000, 61_000_000_000, 7_260_000_000_000, 180_000_000_000_000].map(whole);
        assert_eq!(lengths, ["1.5 s", "1 min 1 s", "2 h 1 min", "2 d 2 h"]);
    }
}
