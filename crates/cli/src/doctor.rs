//! `fieldbeat doctor`: how well this host suits real time, and how to fix it.

use std::io::{IsTerminal, Write};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use fieldbeat_core::cycle::CyclePlan;
use fieldbeat_core::cycle::cost::Costs;
use fieldbeat_core::time::{S, US, nanos};
use fieldbeat_doctor::{Effort, Measured, Progress, Report, Subject, examine, measure};

use super::{Stop, complain, load, print, show, span};
use fieldbeat_record::file::save;

/// Arguments of `doctor`.
#[derive(Debug, Args)]
pub struct Doctor {
    /// The configuration of the machine; without it, only a cycle is examined.
    config: Option<PathBuf>,
    /// Period of the cycle.
    #[arg(long, value_name = "TIME", value_parser = period, conflicts_with = "config", default_value = "1ms")]
    period: Duration,
    /// Core of the loop; without it, the last one.
    #[arg(short = 'a', long, conflicts_with = "config", value_parser = clap::value_parser!(u16).range(..1024))]
    core: Option<u16>,
    /// SCHED_FIFO priority of the loop.
    #[arg(short, long, conflicts_with = "config", default_value = "80")]
    #[arg(value_parser = clap::value_parser!(u8).range(1..=99))]
    priority: u8,
    /// Measure as well, and judge the period by the result.
    #[arg(long)]
    measure: bool,
    /// Duration of the measurement, approximately.
    #[arg(long = "for", value_name = "TIME", value_parser = effort, requires = "measure", default_value = "50s")]
    duration: Duration,
    /// The share of late cycles that the machine tolerates; one minute cannot show less than a few in ten thousand.
    #[arg(long, value_name = "SHARE", value_parser = miss_rate, requires = "measure", default_value = "0.001")]
    miss_rate: f64,
    /// Print the report as one JSON object.
    #[arg(long)]
    json: bool,
}

impl Doctor {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let subject = match &self.config {
            Some(path) => Subject::of(&load(path)?),
            None => Subject::cycle(CyclePlan {
                period_ns: nanos(self.period),
                core: self.core.map(usize::from),
                priority: self.priority,
                ..CyclePlan::default()
            }),
        };
        let findings = examine(&subject);
        let measured = if self.measure { self.measured(&subject) } else { None };
        let report = Report::new(&subject, findings, measured);
        if let Some(measured) = &report.measured {
            keep(&report, &measured.costs.costs);
        }
        if self.json {
            print(serde_json::to_string(&report).map_err(Stop::failed)?)?;
        } else {
            show(&report)?;
        }
        match report.ready {
            true => Ok(()),
            // The text ends with its verdict.
            false => Err(Stop::failed(if self.json { report.verdict() } else { String::new() })),
        }
    }

    /// The measurement; `None`, with the reason on standard error, if the core cannot be had.
    fn measured(&self, subject: &Subject) -> Option<Measured> {
        let effort = Effort { span_ns: nanos(self.duration), miss_rate: self.miss_rate };
        let mut shown = Shown::new(self.duration);
        let measured = measure(subject, &effort, &mut |progress| shown.tell(&progress));
        shown.end();
        measured.map_err(|error| complain(&format!("not measured: {error}"))).ok()
    }
}

/// Keeps what was measured: its costs for `check` and the start of a master, and the report next to them.
fn keep(report: &Report, costs: &Costs) {
    let file = Costs::file();
    let json = serde_json::to_string(report).map_err(std::io::Error::from);
    let made = file.parent().map_or(Ok(()), std::fs::create_dir_all);
    let written = made.and_then(|()| save(&file.with_file_name("doctor.json"), json?.as_bytes()));
    match written.and_then(|()| save(&file, costs.to_text().as_bytes())) {
        Ok(()) => complain(&format!("kept in {}: check and run use these costs", file.display())),
        Err(error) => complain(&format!(
            "not kept in {}: {error}; check and run go on with the stated costs: set HOME to a directory that this \
             user may write to",
            file.display()
        )),
    }
}

/// Progress on standard error: a line that rewrites itself on a terminal, elsewhere one line a stage.
struct Shown {
    terminal: bool,
    span: Duration,
    stage: String,
}

impl Shown {
    fn new(span: Duration) -> Shown {
        Shown { terminal: std::io::stderr().is_terminal(), span, stage: String::new() }
    }

    fn tell(&mut self, progress: &Progress<'_>) {
        let Progress { what, done } = *progress;
        let mut out = std::io::stderr().lock();
        // Nobody is hurt if it cannot be written.
        if self.terminal {
            let left = self.span.mul_f64(1.0 - done).as_secs();
            let _ = write!(out, "\r\x1b[Kmeasuring: {:3.0} %, about {left} s left: {what}", done * 100.0);
            let _ = out.flush();
        } else if self.stage != what {
            let _ = writeln!(out, "measuring: {:3.0} %: {what}", done * 100.0);
        }
        self.stage.clear();
        self.stage.push_str(what);
    }

    /// Takes the line away.
    fn end(&self) {
        if self.terminal {
            let _ = write!(std::io::stderr().lock(), "\r\x1b[K");
        }
    }
}

/// How long a measurement may take: shorter ones say nothing, longer ones are a soak test.
fn effort(text: &str) -> Result<Duration, String> {
    within(text, S..=600 * S, "a measurement takes 1s ... 10min")
}

/// A period that the loop takes.
fn period(text: &str) -> Result<Duration, String> {
    within(text, 50 * US..=S, "a period is 50us ... 1s")
}

fn within(text: &str, range_ns: RangeInclusive<u64>, wanted: &str) -> Result<Duration, String> {
    span(text).and_then(|span| range_ns.contains(&nanos(span)).then_some(span).ok_or(wanted.to_owned()))
}

/// A share of cycles.
fn miss_rate(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(share) if (1e-9..1.0).contains(&share) => Ok(share),
        _ => Err("a share of all cycles above 0 and below 1, for example 0.001".to_owned()),
    }
}
