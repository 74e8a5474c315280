//! The output of a run: its summary and, on request, a report, and its numbers meanwhile.

use std::path::PathBuf;
use std::sync::mpsc;
use std::time::Duration;

use clap::Args;
use fieldbeat::axis::{HeldBy, Load};
use fieldbeat::telemetry::Summary;
use fieldbeat::telemetry::blackbox::default_directory;
use fieldbeat::telemetry::metrics::{self, Endpoint, MetricsError, Server};
use fieldbeat::telemetry::report::Report;
use fieldbeat::{Master, Plan, Setup};

use super::{Stop, complain, print, show};

/// A disk that does not take the report within this time does not hold up the end.
const PATIENCE: Duration = Duration::from_secs(30);

/// Arguments of every command that runs a master.
#[derive(Debug, Args)]
pub struct Output {
    /// Print the summary as one JSON object.
    #[arg(long)]
    json: bool,
    /// Write summary, histograms (.hgrm) and plots (.svg) to this directory at the end.
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Meanwhile answer at http://ADDR/metrics for Prometheus; a port alone is for this computer only, NAME:PORT
    /// for clients that use another name of this computer.
    #[arg(long, value_name = "ADDR", value_parser = metrics::address)]
    metrics: Option<metrics::Address>,
    /// Where the black box writes its files; without it the state directory of the service, or of the user.
    #[arg(long, value_name = "DIR")]
    black_box: Option<PathBuf>,
}

/// All of it can be had, as far as is known before the run.
#[derive(Debug)]
pub struct Prepared {
    json: bool,
    report: Option<Report>,
    endpoint: Option<Endpoint>,
    black_box: PathBuf,
}

/// The machine runs.
#[derive(Debug)]
pub struct Running {
    json: bool,
    report: Option<Report>,
    /// Answers as long as it is held.
    _server: Option<Server>,
}

impl Output {
    /// Finds out whether it can be had, before anything is sent.
    pub fn prepare(self) -> Result<Prepared, Stop> {
        let report = self.report.map(Report::create).transpose().map_err(Stop::usage)?;
        let bind = |metrics::Address { socket, name }| {
            let endpoint = Endpoint::bind(socket)?;
            Ok(name.into_iter().fold(endpoint, Endpoint::named))
        };
        let endpoint =
            self.metrics.map(bind).transpose().map_err(|error: MetricsError| Stop::usage(error))?;
        let black_box = self.black_box.unwrap_or_else(default_directory);
        Ok(Prepared { json: self.json, report, endpoint, black_box })
    }
}

impl Prepared {
    /// The machine of `plan`, with its black box.
    pub fn setup(&self, plan: Plan) -> Setup {
        Master::from_plan(plan).with_black_box(&self.black_box)
    }

    /// Answers with the numbers of `master` from here on.
    pub fn serve(self, master: &Master) -> Result<Running, Stop> {
        let serve = |endpoint: Endpoint| {
            let address = endpoint.address();
            complain(&format!("metrics at http://{address}/metrics"));
            if !address.ip().is_loopback() {
                complain(
                    "anyone on that network can read the metrics; --metrics with a port alone keeps them here",
                );
            }
            endpoint.serve(master.monitor()).map_err(Stop::failed)
        };
        let server = self.endpoint.map(serve).transpose()?;
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
        let summary = run.summary();
        let loads = run.plan.axes().into_iter().zip(&run.end.drives);
        for (axis, drive) in loads {
            if axis.load == Load::Vertical(HeldBy::Drive) && drive.feedback.status.state.is_powered() {
                complain(&format!(
                    "drive {} stays powered: only the drive holds its vertical load",
                    axis.name
                ));
            }
        }
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
                        "report {directory} is not written: its disk does not answer for {seconds} s; look at that \
                         disk"
                    )))
                })
            }
            None => Ok(()),
        };
        (summary, both(printed, written))
    }
}

/// What `work` returns, if it does within `limit`; it is left to itself otherwise, up to the end of the process.
fn within<R: Send + 'static>(limit: Duration, work: impl FnOnce() -> R + Send + 'static) -> Option<R> {
    let (done, result) = mpsc::channel();
    let thread = std::thread::Builder::new().name("fb-report".into()).spawn(move || {
        // Too late, nobody takes it.
        let _ = done.send(work());
    });
    thread.ok().and_then(|_| result.recv_timeout(limit).ok())
}

/// What both have to say.
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
    fn what_hangs_is_waited_for_only_so_long() {
        let (release, hangs) = mpsc::channel::<()>();
        assert_eq!(within(Duration::from_millis(20), move || hangs.recv().is_ok()), None);
        drop(release);
        assert_eq!(within(Duration::from_secs(60), || 7), Some(7));
    }
}
