//! Findings as text of 100 columns, and as the object that `--json` prints.

use std::fmt::{self, Write as _};

use anstyle::{AnsiColor, Style};
use serde::Serialize;

use super::measure::{Carries, Factor, Measured, percent, word};
use super::{Area, Finding, Subject, Verdict, load};
use fieldbeat_core::rt::host;
use fieldbeat_core::time::Ns;
use fieldbeat_record::style::{BAD, paint};
use fieldbeat_record::summary::plural;

/// The style of findings that could be better.
const POOR: Style = AnsiColor::Yellow.on_default();

/// The style of good findings.
const GOOD: Style = AnsiColor::Green.on_default();

/// The result of the doctor. Serialised, its keys are stable; values are in ns unless the key says otherwise; null
/// means not known.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// No finding is bad.
    pub ready: bool,
    /// The plan that the host is to run.
    pub subject: Carried,
    /// How many findings there are of each verdict.
    pub counts: Counts,
    /// All that was looked at, and what follows from what was measured.
    pub findings: Vec<Finding>,
    /// The numbers behind it; null if nothing was measured.
    pub measured: Option<Measured>,
    /// The machine.
    pub host: Host,
}

/// The plan, as far as it concerns the host.
#[derive(Clone, Debug, Serialize)]
pub struct Carried {
    /// The configuration; null for the default plan.
    pub config: Option<String>,
    /// Period of the loop.
    pub period_ns: u64,
    /// The late limit: a cycle is late that begins more than this after its grid point.
    pub late_ns: u64,
    /// Core of the loop.
    pub core: usize,
    /// SCHED_FIFO priority.
    pub priority: u8,
}

/// Findings by verdict.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Counts {
    /// As they should be.
    pub good: usize,
    /// Advice.
    pub poor: usize,
    /// The plan is refused or certain to fail.
    pub bad: usize,
    /// Not known.
    pub unknown: usize,
}

/// The machine.
#[derive(Clone, Debug, Serialize)]
pub struct Host {
    /// Kernel release.
    pub kernel: Option<String>,
    /// Processor.
    pub cpu: Option<String>,
}

impl Report {
    /// The report on `subject`: what was found, and what was measured.
    pub fn new(subject: &Subject, mut findings: Vec<Finding>, measured: Option<Measured>) -> Report {
        if let (Some(measured), Some(demand)) = (&measured, &subject.demand) {
            // By what was just measured, and no longer by what was known before.
            findings.retain(|finding| finding.area != Area::Load);
            findings.push(load::check(demand, &measured.costs.costs));
        }
        findings.extend(measured.iter().flat_map(|measured| measured.findings(subject)));
        let count = |verdict| findings.iter().filter(|finding| finding.verdict == verdict).count();
        let [good, poor, bad, unknown] =
            [Verdict::Good, Verdict::Poor, Verdict::Bad, Verdict::Unknown].map(count);
        let counts = Counts { good, poor, bad, unknown };
        Report {
            ready: counts.bad == 0,
            subject: Carried {
                config: subject.source.as_ref().map(|path| path.display().to_string()),
                period_ns: subject.cycle.period_ns,
                late_ns: subject.cycle.late_ns(),
                core: subject.core,
                priority: subject.cycle.priority,
            },
            counts,
            findings,
            measured,
            host: Host { kernel: host::kernel(), cpu: host::cpu() },
        }
    }

    /// One line: ready or not, and what is left to be done.
    pub fn verdict(&self) -> String {
        let Counts { poor, bad, unknown, .. } = self.counts;
        let mut line = match bad {
            0 => "ready".to_owned(),
            bad => format!("not ready: {}", plural(bad as u64, "problem")),
        };
        if bad > 0 {
            let names = self.findings.iter().filter(|finding| finding.verdict == Verdict::Bad);
            let names: Vec<&str> = names.map(|finding| finding.name.as_str()).collect();
            let _ = write!(line, " ({})", names.join(", "));
        }
        if poor > 0 {
            let _ = write!(line, "; {}", plural(poor as u64, "possible improvement"));
        }
        if unknown > 0 {
            let _ = write!(line, "; {unknown} not known");
        }
        line
    }
}

/// Columns of the output.
const WIDTH: usize = 100;

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Carried { config, period_ns, late_ns, core, priority } = &self.subject;
        let source = config.as_deref().unwrap_or("the default plan");
        writeln!(
            f,
            "{source}: a cycle every {} on core {core} at SCHED_FIFO {priority}, late limit {}",
            Ns(*period_ns),
            Ns(*late_ns)
        )?;
        let known = [&self.host.kernel, &self.host.cpu].into_iter().flatten().map(String::as_str);
        writeln!(f, "this host: {}", known.collect::<Vec<_>>().join(", "))?;
        let width = self.findings.iter().map(|finding| finding.name.chars().count()).max().unwrap_or(0);
        let mut area = None;
        for finding in &self.findings {
            if area.replace(finding.area) != Some(finding.area) {
                writeln!(f, "\n{}", format!("{:?}", finding.area).to_lowercase())?;
            }
            self::finding(f, finding, width)?;
        }
        if let Some(measured) = &self.measured {
            self::measured(f, measured)?;
        }
        let style = if self.ready { GOOD } else { BAD };
        write!(f, "\n{}", paint(&self.verdict(), style, f.alternate()))
    }
}

/// One line for what is good; with its reason and the ways there and back for what is not.
fn finding(f: &mut fmt::Formatter<'_>, finding: &Finding, width: usize) -> fmt::Result {
    let (word, style) = match finding.verdict {
        Verdict::Good => ("good", GOOD),
        Verdict::Poor => ("poor", POOR),
        Verdict::Bad => ("BAD ", BAD),
        Verdict::Unknown => ("?   ", POOR),
    };
    let lines = paragraph(&format!("  {word}  {:width$}  ", finding.name), &finding.found);
    // Not before the lines are broken: escape sequences have no width.
    f.write_str(&lines.replacen(word, &paint(word, style, f.alternate()), 1))?;
    if !matches!(finding.verdict, Verdict::Poor | Verdict::Bad) {
        return Ok(());
    }
    f.write_str(&paragraph("        wanted  ", &finding.wanted))?;
    f.write_str(&paragraph("        why     ", &finding.why))?;
    // Commands stay whole, to be copied.
    for (label, commands) in [("fix", &finding.fix), ("undo", &finding.undo)] {
        let mut label = label;
        for line in commands.iter().flat_map(|commands| commands.lines()) {
            writeln!(f, "        {label:8}{line}")?;
            label = "";
        }
    }
    Ok(())
}

/// The numbers: what each thing is worth, and how each period was carried.
fn measured(f: &mut fmt::Formatter<'_>, measured: &Measured) -> fmt::Result {
    let period = Ns(measured.period_ns);
    writeln!(
        f,
        "\neffect of each setting here: wake-up latency every {period}, in turns; ratios with their 95 % \
         intervals"
    )?;
    writeln!(f, "  {:26}{:>17}{:>14}   with / without", "", "without", "with")?;
    for Factor { name, without, with, p50_ratio, p99_ratio, fix } in &measured.factors {
        let mut name = name.as_str();
        let lines = [
            ("p50", whole(without.p50_ns), whole(with.p50_ns), *p50_ratio),
            ("p99", whole(without.p99_ns), whole(with.p99_ns), *p99_ratio),
            ("max", without.max_ns, with.max_ns, None),
        ];
        for (label, without, with, ratio) in lines {
            // Too few values for a quantile still have a longest one.
            let (Some(without), Some(with)) = (without, with) else { continue };
            let ratio = ratio.map_or(String::new(), |ratio| format!("   {ratio}  {}", word(&ratio)));
            let [without, with] = [without, with].map(|ns| Ns(ns).to_string());
            writeln!(f, "  {name:26}{label:>4}{without:>13}{with:>14}{ratio}")?;
            name = "";
        }
        if let Some(fix) = fix {
            writeln!(f, "        fix     {fix}")?;
        }
    }
    for untried in &measured.untried {
        f.write_str(&paragraph(&format!("  not tried: {}: ", untried.name), &untried.why))?;
    }
    writeln!(f, "\nperiods, the late limit is the same share of each; at most: with 95 % confidence")?;
    writeln!(
        f,
        "  {:>12}{:>14}{:>10}{:>8}{:>12}{:>12}",
        "period", "late limit", "cycles", "late", "share", "at most"
    )?;
    for Carries { period_ns, late_ns, cycles, late, share, at_most } in &measured.periods {
        let [period, from] = [*period_ns, *late_ns].map(|ns| Ns(ns).to_string());
        let [share, at_most] = [*share, *at_most].map(percent);
        writeln!(f, "  {period:>12}{from:>14}{cycles:>10}{late:>8}{share:>12}{at_most:>12}")?;
    }
    match measured.steal_ms {
        Some(steal_ms) => writeln!(f, "stolen time: {steal_ms} ms"),
        None => Ok(()),
    }
}

/// A quantile in whole nanoseconds: it is that of one value, or between two.
fn whole(ns: Option<f64>) -> Option<u64> {
    ns.map(|ns| ns.round() as u64)
}

/// `text` behind `lead`, broken between words, further lines below its beginning.
fn paragraph(lead: &str, text: &str) -> String {
    let indent = lead.chars().count();
    let mut lines = String::new();
    let mut line = lead.to_owned();
    let mut begun = false;
    for word in text.split_whitespace() {
        if begun && line.chars().count() + 1 + word.chars().count() > WIDTH {
            lines = lines + line.trim_end() + "\n";
            line = " ".repeat(indent);
            begun = false;
        }
        if begun {
            line.push(' ');
        }
        line += word;
        begun = true;
    }
    lines + line.trim_end() + "\n"
}

#[cfg(test)]
mod tests {
    use super::super::facts::testing::subject;
    use super::super::finding::Area;
    use super::*;

    fn findings() -> Vec<Finding> {
        let about = |name: &str| Finding::about(Area::Kernel, name, "this", "because ".repeat(30));
        vec![
            about("a").good("so"),
            about("longer").poor("other").fix("do it\nor else", "do it not"),
            about("b").unknown("silence"),
        ]
    }

    #[test]
    fn good_is_one_line_and_poor_has_all_of_it() {
        let report = Report::new(&subject(), findings(), None);
        let text = report.to_string();
        assert!(text.starts_with(
            "the default plan: a cycle every 1 ms on core 3 at SCHED_FIFO 80, late limit 100 us\n"
        ));
        assert!(
            text.contains("\n  good  a       so\n  poor  longer  other\n        wanted  this\n"),
            "{text}"
        );
        assert!(
            text.contains("\n        fix     do it\n                or else\n        undo    do it not\n"),
            "{text}"
        );
        assert!(text.contains("\n  ?     b       not known: silence\n"), "{text}");
        assert!(text.lines().all(|line| line.chars().count() <= WIDTH && line.trim_end() == line), "{text}");
        assert!(text.ends_with("\nready; 1 possible improvement; 1 not known"), "{text}");
    }

    #[test]
    fn one_bad_finding_is_not_ready() {
        let mut all = findings();
        all.push(Finding::about(Area::Rights, "clock", "", "").bad("broken"));
        let report = Report::new(&subject(), all, None);
        assert!(!report.ready);
        assert!(report.verdict().starts_with("not ready: 1 problem (clock); 1 possible improvement"));
    }
}
