//! `fieldbeat soak`: the master of a configuration for hours or days, with moves, checkpoints and a verdict.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use clap::Args;
use fieldbeat_config::soak::SoakPlan;
use fieldbeat_config::{Configuration, Loaded, load_machine};
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::rt::thread::file_thread;
use fieldbeat_core::time::{S, nanos};
use fieldbeat_master::Master;
use fieldbeat_record::Summary;
use fieldbeat_record::archive::Archive;
use fieldbeat_record::compare::{compare, differences};
use fieldbeat_record::report::earlier_run;
use fieldbeat_record::summary::Carried;
use fieldbeat_soak::Soak;
use fieldbeat_soak::criteria::{Judged, judge};
use fieldbeat_soak::directory::{Directory, Writer, page, ran};
use fieldbeat_soak::progress::Progress;
use serde_json::{Value, json};

use super::handler::Handler;
use super::interrupt::{Interrupt, LOOK_EVERY};
use super::output::{both, name_held_loads, texts};
use super::run::start;
use super::serving::Serving;
use super::{Stop, complain, print, span};

/// The axes are given so long to stop and to be powered off, ns, before the master does what is left.
const END_WITHIN_NS: u64 = 45 * S;

/// Arguments of `soak`.
#[derive(Debug, Args)]
pub struct SoakTest {
    /// The configuration; its table [soak] says how the axes move and what is good.
    config: PathBuf,
    /// How long, in all.
    #[arg(long = "for", value_name = "TIME", value_parser = span, required_unless_present = "resume")]
    duration: Option<Duration>,
    /// The directory of the test: checkpoints and report. Without it a new one here, named after the configuration and
    /// the time.
    #[arg(long, value_name = "DIR")]
    directory: Option<PathBuf>,
    /// Go on with the test of this directory, from its last checkpoint.
    #[arg(long, value_name = "DIR", conflicts_with = "directory")]
    resume: Option<PathBuf>,
    /// Compare it with an earlier run, by the run.json of its directory; may be given several times.
    #[arg(long, value_name = "FILE")]
    compare: Vec<PathBuf>,
    /// End at once when a criterion fails.
    #[arg(long)]
    fail_fast: bool,
    /// Time between two checkpoints.
    #[arg(long, value_name = "TIME", value_parser = span, default_value = "60s")]
    checkpoint: Duration,
    /// Print the verdict as one JSON object.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    serving: Serving,
}

impl SoakTest {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let Loaded { configuration, text, .. } = load_machine(&self.config).map_err(Stop::usage)?;
        let Configuration { plan, soak, .. } = configuration;
        let earlier = self.compare.iter().map(|file| earlier_run(file));
        let earlier = earlier.collect::<Result<Vec<_>, _>>().map_err(Stop::usage)?;
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        let serving = self.serving.prepare()?;
        let is_new = self.resume.is_none();
        let (directory, mut progress) = match self.resume {
            Some(path) => resume(&path, &text, self.duration)?,
            None => begin(self.directory.unwrap_or_else(|| named_after(&self.config)), text, self.duration)?,
        };
        if progress.left_ns() == 0 {
            return Err(Stop::usage(format!(
                "{}: {} have passed: a longer --for goes on",
                directory.path().display(),
                ran(&progress)
            )));
        }
        let texts = texts(&plan);
        announce(&soak, &plan, &progress, &directory);
        // Without a master there is no test, and the directory is free for the next one.
        let not_begun = |stop: Stop| {
            if is_new {
                directory.withdraw();
            }
            stop
        };
        let master = start(serving.setup(plan), &interrupt).map_err(not_begun)?;
        let _server = serving.serve(&master).map_err(not_begun)?;
        progress.begin();
        let core = master.granted().core;
        let writer = Writer::start(directory.clone(), move || file_thread(core));
        let writer = writer.map_err(Stop::failed).map_err(not_begun)?;
        let handler = Handler::new(&master, &interrupt);
        let every_ns = nanos(self.checkpoint).max(S / 10);
        let mut test = Test { master, handler, soak, progress, is_resumed: !is_new, writer, every_ns };
        let moved = test.run(self.fail_fast, &interrupt)?;
        let cycle = test.soak.cycle.clone();
        let Ended { progress, judged, summary, writer } = test.finish(&moved);
        let carried = progress.run.as_ref().map(|run| Carried::of_archive(&cycle, run));
        let page = page(&progress, &judged, &earlier, &texts, carried.as_ref());
        let written = writer.finish(progress.clone(), page).map_err(Stop::failed);
        let report = written.is_ok().then(|| directory.page());
        let printed = if self.json {
            print(object(&progress, &judged, &earlier, (directory.path(), report), &summary, &carried))
        } else {
            print(lines(&progress, &judged, &earlier, report, &carried))
        };
        let failed: Vec<String> = judged.iter().filter(|one| !one.passed).map(Judged::line).collect();
        let failed: Vec<String> = failed.into_iter().chain(carried.and_then(|of| of.failure())).collect();
        let verdict = if failed.is_empty() { Ok(()) } else { Err(Stop::failed(failed.join("\n"))) };
        both(both(printed, written), verdict)
    }
}

/// The directory of a test that begins, and the test.
fn begin(path: PathBuf, text: String, length: Option<Duration>) -> Result<(Directory, Progress), Stop> {
    let length_ns = length.map_or(0, nanos);
    if length_ns == 0 {
        return Err(Stop::usage("--for 0s leaves no time for a test: give it some, for example 24h"));
    }
    let progress = Progress::new(text, length_ns);
    Ok((Directory::create(&path, &progress).map_err(Stop::usage)?, progress))
}

/// The directory of a test that goes on, and how far it is.
fn resume(path: &Path, text: &str, length: Option<Duration>) -> Result<(Directory, Progress), Stop> {
    let (directory, mut progress) = Directory::resume(path, text).map_err(Stop::usage)?;
    progress.length_ns = length.map_or(progress.length_ns, nanos);
    Ok((directory, progress))
}

/// A new directory here.
fn named_after(config: &Path) -> PathBuf {
    let now = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
    let stem = config.file_stem().filter(|stem| *stem != "-").unwrap_or("stdin".as_ref()).to_string_lossy();
    PathBuf::from(format!("soak-{stem}-{}", now.replace([':', '-'], "")))
}

/// Says what is about to move, and where the test is kept.
fn announce(soak: &SoakPlan, plan: &Plan, progress: &Progress, directory: &Directory) {
    for (axis, plan) in soak.axes.iter().zip(plan.axes()) {
        complain(&format!("axis {}: {}", axis.name, axis.pattern.describe(plan.units.unit)));
    }
    let so_far =
        if progress.processes.is_empty() { String::new() } else { format!(", {} so far", ran(progress)) };
    complain(&format!("checkpoints and report in {}{so_far}", directory.path().display()));
}

/// A test under way.
struct Test {
    master: Master,
    handler: Handler,
    soak: SoakPlan,
    progress: Progress,
    is_resumed: bool,
    writer: Writer,
    every_ns: u64,
}

/// A test at its end.
struct Ended {
    progress: Progress,
    judged: Vec<Judged>,
    summary: Summary,
    writer: Writer,
}

impl Test {
    /// Machine time of this process, ns.
    fn now(&self) -> u64 {
        self.master.status().planned * self.master.plan().cycle.period_ns
    }

    /// Runs it up to its end, or to what ends it before.
    fn run(&mut self, fail_fast: bool, interrupt: &Interrupt) -> Result<Soak, Stop> {
        let axes = self.master.observers().iter().map(|(name, _)| self.master.axis(name));
        let axes = axes.collect::<Result<Vec<_>, _>>().map_err(Stop::failed)?;
        let plan = self.master.plan();
        let mut axes = Soak::new(&self.soak, axes, plan.cycle.period_ns);
        if self.is_resumed {
            axes = axes.after_pause(&self.progress, plan.silence_faults());
        }
        let left_ns = self.progress.left_ns();
        let (mut next_ns, mut troubles, mut given_up) = (self.every_ns, 0, 0);
        let mut ends_ns = None;
        while self.master.is_running() && !(ends_ns.is_some() && axes.has_ended()) {
            let now = self.now();
            if ends_ns.is_none() && (now >= left_ns || interrupt.is_set()) {
                axes.end();
                ends_ns = Some(now + END_WITHIN_NS);
            }
            if ends_ns.is_some_and(|end| now > end) {
                break;
            }
            axes.step(now).iter().for_each(|line| complain(line));
            self.writer.look().iter().for_each(|line| complain(line));
            let trouble = self.troubles(&axes);
            let is_due = now >= next_ns || axes.given_up() > given_up || (fail_fast && trouble > troubles);
            if ends_ns.is_none()
                && is_due
                && let Some(judged) = self.checkpoint(&axes)
            {
                (next_ns, troubles, given_up) = (now + self.every_ns, trouble, axes.given_up());
                if let Some(failed) = judged.iter().find(|one| !one.passed).filter(|_| fail_fast) {
                    complain(&format!("ends at once: {}", failed.line()));
                    axes.end();
                    ends_ns = Some(now + END_WITHIN_NS);
                }
            }
            self.handler.look(&self.master, "soak");
            std::thread::sleep(LOOK_EVERY);
        }
        Ok(axes)
    }

    /// Lost links, faults, stops and axes given up so far, as far as they can be seen in passing.
    fn troubles(&self, axes: &Soak) -> u64 {
        let of = |feedback: fieldbeat_core::axis::Feedback| {
            u64::from(feedback.stopped.is_some()) + u64::from(feedback.status.fault != 0)
        };
        axes.given_up() as u64
            + self.master.observers().iter().map(|(_, observer)| of(observer.feedback())).sum::<u64>()
    }

    /// Has a checkpoint written; what it comes to so far. `None`: the telemetry is at work, to be tried again.
    fn checkpoint(&mut self, axes: &Soak) -> Option<Vec<Judged>> {
        let (master, numbers) = (&self.master, self.master.numbers());
        let run = master.try_measured(|measured| {
            let summary = Summary::of(master.plan(), &numbers, measured, master.granted(), master.steal_ms());
            Archive::of(master.plan(), &numbers, measured, &summary)
        })?;
        self.progress.sample(self.now());
        self.progress.files_lost += self.writer.take_lost();
        let progress = self.progress.with(&run, axes);
        let judged = judge(&self.soak, &progress, false);
        self.writer.checkpoint(progress).iter().for_each(|line| complain(line));
        Some(judged)
    }

    /// Ends the master in order, and judges.
    fn finish(mut self, axes: &Soak) -> Ended {
        self.progress.sample(self.now());
        self.handler.end(&self.master);
        let run = self.master.finish();
        let summary = Summary::from(&run);
        name_held_loads(&summary);
        let archive = Archive::of(&run.plan, &run.end, &run.measured, &summary);
        self.writer.look().iter().for_each(|line| complain(line));
        self.progress.files_lost += self.writer.take_lost();
        let progress = self.progress.with(&archive, axes);
        let judged = judge(&self.soak, &progress, true);
        Ended { progress, judged, summary, writer: self.writer }
    }
}

/// The verdict as text: each criterion a line, the failed ones first.
fn lines(
    progress: &Progress,
    judged: &[Judged],
    earlier: &[(String, Archive)],
    report: Option<PathBuf>,
    carried: &Option<Carried>,
) -> String {
    let failed = judged.iter().filter(|one| !one.passed).count();
    let mut text = match failed {
        0 => format!("passed: all {} criteria are kept, over {}\n", judged.len(), ran(progress)),
        _ => format!("FAILED: {failed} of {} criteria, over {}\n", judged.len(), ran(progress)),
    };
    for one in judged.iter().filter(|one| !one.passed).chain(judged.iter().filter(|one| one.passed)) {
        text += &format!("  {:6}  {}\n", one.word(), one.line());
    }
    for (name, run) in earlier {
        let compared = progress.run.as_ref().map(|this| compare(this, run)).unwrap_or_default();
        if compared.is_empty() {
            text += &format!("compared with {name}: one of the two is too short\n");
        }
        let other = progress.run.as_ref().map(|this| differences(this, run)).unwrap_or_default();
        if !other.is_empty() {
            text += &format!("compared with {name}: the runs differ otherwise, too: {}\n", other.join("; "));
        }
        for one in compared {
            let word = one.verdict.word();
            let (this, that) = (one.this.text(one.share), one.earlier.text(one.share));
            text += &format!("compared with {name}: {}: {word}: {this}, was {that}\n", one.what);
        }
    }
    if let Some(report) = report {
        text += &format!("report: {}\n", report.display());
    }
    if let Some(carried) = carried {
        text += &format!("{carried}\n");
    }
    text.trim_end().to_owned()
}

/// The same as one object.
fn object(
    progress: &Progress,
    judged: &[Judged],
    earlier: &[(String, Archive)],
    (directory, report): (&Path, Option<PathBuf>),
    summary: &Summary,
    carried: &Option<Carried>,
) -> Value {
    let compared: Vec<Value> = (earlier.iter())
        .map(|(name, run)| {
            let this = progress.run.as_ref();
            json!({
                "with": name,
                "differences": this.map(|this| differences(this, run)).unwrap_or_default(),
                "quantities": this.map(|this| compare(this, run)).unwrap_or_default(),
            })
        })
        .collect();
    json!({
        "passed": judged.iter().all(|one| one.passed),
        "ran_ns": progress.ran_ns(),
        "length_ns": progress.length_ns,
        "gaps_s": progress.gaps_s(),
        "processes": progress.processes,
        "axes": progress.axes,
        "criteria": judged,
        "carried": carried,
        "compared": compared,
        "directory": directory,
        "report": report,
        "summary": summary,
    })
}
