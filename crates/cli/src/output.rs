//! The output of a run: its summary and, on request, a report, and its numbers meanwhile.

use std::path::PathBuf;
use std::sync::mpsc;
use std::time::Duration;

use clap::Args;
use fieldbeat_config::describe::describe;
use fieldbeat_core::cycle::Plan;
use fieldbeat_doctor as doctor;
use fieldbeat_doctor::{Subject, examine};
use fieldbeat_master::{Master, Setup};
use fieldbeat_record::Summary;
use fieldbeat_record::recording::{RecordError, Recorder};
use fieldbeat_record::report::Report;
use fieldbeat_telemetry::Run;
use fieldbeat_telemetry::log::MachineOf;

use super::serving::{Served, Servers, Serving};
use super::{Stop, VERSION, complain, print, show, span};

/// A disk that does not take the report within this time does not hold up the end.
const PATIENCE: Duration = Duration::from_secs(30);

/// Arguments of every command that runs a master.
#[derive(Debug, Args)]
pub struct Output {
    /// Print the summary as one JSON object.
    #[arg(long)]
    json: bool,
    /// Write a page with plots (index.html), summary and histograms (.hgrm) to this directory at the end.
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Compare the report with that of an earlier run, by its run.json; may be given several times.
    #[arg(long, value_name = "FILE", requires = "report")]
    compare: Vec<PathBuf>,
    #[command(flatten)]
    serving: Serving,
    /// Record every cycle of every axis, commands and events to this file (MCAP: Foxglove, PlotJuggler, Rerun).
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Record only so much of what is newest, in memory: written at the end, at a failure, and on SIGUSR1.
    #[arg(long, value_name = "TIME", value_parser = span, requires = "record")]
    record_window: Option<Duration>,
    /// Record all that the loop takes from outside to the same file, from which `fieldbeat replay` repeats the run.
    #[arg(long, requires = "record")]
    record_wire: bool,
    /// Record also the native process data of these drives, as received and sent; `all` stands for each of them. May
    /// be given several times.
    #[arg(long, value_name = "NAME", value_delimiter = ',', requires = "record")]
    record_native: Vec<String>,
}

/// All of it can be had, as far as is known before the run.
#[derive(Debug)]
pub struct Prepared {
    json: bool,
    report: Option<Report>,
    served: Served,
    recorder: Option<Recorder>,
}

/// The machine runs.
#[derive(Debug)]
pub struct Running {
    json: bool,
    report: Option<Report>,
    /// Answers as long as it is held.
    _server: Servers,
}

impl Output {
    /// Finds out whether it can be had, before anything is sent.
    pub fn prepare(self) -> Result<Prepared, Stop> {
        if self.record_wire && self.record_window.is_some() {
            return Err(Stop::usage(RecordError::WireOfWindow));
        }
        let mut report = self.report.map(Report::create).transpose().map_err(Stop::usage)?;
        for file in &self.compare {
            report = report.map(|report| report.compare(file)).transpose().map_err(Stop::usage)?;
        }
        let served = self.serving.prepare()?;
        let record = |path| match self.record_window {
            Some(window) => Recorder::window(path, window),
            None => Recorder::create(path),
        };
        let mut recorder = self.record.map(record).transpose().map_err(Stop::usage)?;
        if self.record_wire {
            recorder = recorder.map(Recorder::with_wire).transpose().map_err(Stop::usage)?;
        }
        let recorder =
            recorder.map(|recorder| recorder.with_native(self.record_native).with_version(VERSION));
        Ok(Prepared { json: self.json, report, served, recorder })
    }
}

impl Prepared {
    /// The machine of `plan`, which is from `machine`, with its black box and its recording.
    pub fn setup(&mut self, plan: Plan, machine: MachineOf) -> Setup {
        if let Some(report) = &mut self.report {
            texts(&plan).into_iter().for_each(|(title, text)| report.add_text(title, text));
        }
        let setup = self.served.setup(plan).of_machine(machine);
        match self.recorder.take() {
            Some(recorder) => setup.with_recorder(recorder),
            None => setup,
        }
    }

    /// Answers with the numbers of `master` from here on.
    pub fn serve(self, master: &Master) -> Result<Running, Stop> {
        let server = self.served.serve(master)?;
        Ok(Running { json: self.json, report: self.report, _server: server })
    }
}

impl Running {
    /// Standard output is one JSON object.
    pub fn is_json(&self) -> bool {
        self.json
    }

    /// Ends the machine, prints its summary and writes its report. If either fails, the other is there all the same.
    pub fn finish(self, master: Master) -> (Summary, Result<(), Stop>) {
        let run = master.finish();
        let summary = Summary::from(&run);
        name_held_loads(&summary);
        let printed = if self.json {
            serde_json::to_string(&summary).map_err(Stop::failed).and_then(print)
        } else {
            show(&summary)
        };
        let written = match self.report {
            Some(report) => {
                let (directory, summary) = (report.directory().display().to_string(), summary.clone());
                let written = within(PATIENCE, move || report.write(&run, &summary).map_err(Stop::failed));
                written.unwrap_or_else(|| {
                    let seconds = PATIENCE.as_secs();
                    Err(Stop::failed(format!(
                        "report {directory} is not written: its disk does not answer for {seconds} s; look \
                         at that disk"
                    )))
                })
            }
            None => Ok(()),
        };
        (summary, both(printed, written))
    }
}

/// The configuration and the host, as they stand at the end of a page. To be called before the loop runs: it tries what
/// the loop will take.
pub fn texts(plan: &Plan) -> Vec<(String, String)> {
    let subject = Subject::of(plan);
    let host = doctor::Report::new(&subject, examine(&subject), None).to_string();
    vec![("Configuration".into(), describe(plan).join("\n")), ("Host".into(), host)]
}

/// Says which drives stay powered as planned.
pub fn name_held_loads(summary: &Summary) {
    for drive in &summary.drives {
        if let Some(held) = drive.held() {
            complain(&format!("drive {} {held}", drive.name));
        }
    }
}

/// How the drives of a master were left that has no summary: what is held as planned is said, and the rest is an error.
pub fn judge_end(run: &Run) -> Result<(), Stop> {
    let summary = Summary::from(run);
    name_held_loads(&summary);
    match summary.left_on() {
        Some(drives) => Err(Stop::failed(drives)),
        None => Ok(()),
    }
}

/// The result of `work`, if it returns within `limit`; it is left to itself otherwise, up to the end of the process.
fn within<R: Send + 'static>(limit: Duration, work: impl FnOnce() -> R + Send + 'static) -> Option<R> {
    let (done, result) = mpsc::channel();
    let thread = std::thread::Builder::new().name("fb-report".into()).spawn(move || {
        // Too late, nobody takes it.
        let _ = done.send(work());
    });
    thread.ok().and_then(|_| result.recv_timeout(limit).ok())
}

/// The messages of both.
pub fn both(one: Result<(), Stop>, other: Result<(), Stop>) -> Result<(), Stop> {
    match (one, other) {
        (Err(one), Err(other)) => {
            Err(Stop { code: one.code, message: format!("{}\n{}", one.message, other.message) })
        }
        (one, other) => one.and(other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hanging_output_is_waited_for_up_to_a_limit() {
        let (release, hangs) = mpsc::channel::<()>();
        assert_eq!(within(Duration::from_millis(20), move || hangs.recv().is_ok()), None);
        drop(release);
        assert_eq!(within(Duration::from_secs(60), || 7), Some(7));
    }
}
