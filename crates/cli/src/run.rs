//! `fieldbeat run`: the master of a configuration.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use fieldbeat_config::{Loaded, load_machine};
use fieldbeat_control::Station;
use fieldbeat_core::axis::Axis;
use fieldbeat_core::bus::diagnosis::NOT_YET;
use fieldbeat_core::rt::confine::can_filter;
use fieldbeat_core::rt::thread::stand_aside;
use fieldbeat_core::time::MS;
use fieldbeat_master::{Master, Setup};
use fieldbeat_record::summary::{Drive, Summary};
use fieldbeat_telemetry::log::MachineOf;

use super::handler::Handler;
use super::interrupt::{Interrupt, LOOK_EVERY};
use super::output::{Output, both};
use super::{Stop, complain, span};

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct Run {
    /// The configuration.
    config: PathBuf,
    /// End after this time; without it, at Ctrl-C.
    #[arg(long = "for", value_name = "TIME", value_parser = span)]
    duration: Option<Duration>,
    /// Let other processes of this user operate the axes, one at a time: `fieldbeat jog CONFIG`.
    #[arg(long)]
    allow_control: bool,
    #[command(flatten)]
    output: Output,
}

impl Run {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let Loaded { configuration, file, text } = load_machine(&self.config).map_err(Stop::usage)?;
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        let mut output = self.output.prepare()?;
        let master =
            start(output.setup(configuration.plan, MachineOf::Configuration { file, text }), &interrupt)?;
        let output = output.serve(&master)?;
        let axes = all_axes(&master)?;
        let mut handler = if self.allow_control {
            let station = Station::start(axes, master.monitor()).map_err(Stop::failed)?;
            Handler::operated(&master, &interrupt, station)
        } else {
            // Nobody else takes their events: untaken, they would count as lost.
            Handler::new(&master, &interrupt).taking(axes)
        };
        let begun = Instant::now();
        while master.is_running() && self.duration.is_none_or(|duration| begun.elapsed() < duration) {
            handler.look(&master, "run");
            std::thread::sleep(LOOK_EVERY);
        }
        handler.end(&master);
        let (summary, printed) = output.finish(master);
        // Requested to end before the drives were there, it is not the run that failed.
        let whole = summary.is_whole() || (interrupt.is_set() && !summary.has_failed());
        let verdict = if whole { Ok(()) } else { Err(not_whole(&summary)) };
        both(printed, both(verdict, summary.carried.failure().map_or(Ok(()), |why| Err(Stop::failed(why)))))
    }
}

/// All axes of the machine, in their order.
pub fn all_axes(master: &Master) -> Result<Vec<Axis>, Stop> {
    let axes = master.observers().iter().map(|(name, _)| master.axis(name));
    axes.collect::<Result<_, _>>().map_err(Stop::failed)
}

/// Starts the machine; a signal from here on stops it in order.
pub fn start(setup: Setup, interrupt: &Interrupt) -> Result<Master, Stop> {
    let master = setup.confine().start().map_err(Stop::usage)?;
    // This thread, and those it starts from here on, wake often enough to be felt on the loop's core.
    stand_aside(master.granted().core);
    interrupt.stops(master.stop_handle()).map_err(Stop::failed)?;
    for line in &master.granted().missing {
        complain(&format!("not real-time: {line}"));
    }
    if let Err(error) = can_filter() {
        let what = "metrics, scope and control socket run without filters of system calls";
        complain(&format!("{what}: {error}; `fieldbeat doctor` says what to do"));
    }
    if let Some(why) = master.no_guardian() {
        complain(&why.to_string());
    }
    Ok(master)
}

/// Drives by name, each with the reason why it is or was not online; one that several share is given once.
fn with_reasons(drives: &[&Drive]) -> String {
    let mut groups: Vec<(Option<&str>, Vec<&str>)> = Vec::new();
    for drive in drives {
        let why = drive.diagnosis.as_deref().or((drive.losses == 0).then_some(NOT_YET));
        match groups.iter_mut().find(|(known, _)| *known == why) {
            Some((_, names)) => names.push(&drive.name),
            None => groups.push((why, vec![&drive.name])),
        }
    }
    let named = groups.into_iter().map(|(why, names)| match why {
        Some(why) => format!("{} ({why})", names.join(", ")),
        None => names.join(", "),
    });
    named.collect::<Vec<_>>().join(", ")
}

/// One line that names the drives which made the run a failure, and what to do.
pub fn not_whole(summary: &Summary) -> Stop {
    let chosen = |what: &str, chosen: &dyn Fn(&Drive) -> bool| {
        let drives: Vec<&Drive> = summary.drives.iter().filter(|drive| chosen(drive)).collect();
        (!drives.is_empty()).then(|| (what.to_owned(), drives))
    };
    let of_link = |(what, drives): (String, Vec<&Drive>)| format!("{what}: {}", with_reasons(&drives));
    let overrun = chosen("stopped by an overrun", &Drive::was_overrun).map(|(what, drives)| {
        let names: Vec<&str> = drives.iter().map(|drive| drive.name.as_str()).collect();
        format!(
            "{what}: {}; this computer was too late for more slots than max_skip or max_skip_rate allow: \
             give the loop its rights and a core of its own",
            names.join(", ")
        )
    });
    let lines: Vec<String> = [
        chosen("not online", &|drive| drive.losses == 0 && !drive.is_online()).map(of_link),
        chosen("lost on the way", &|drive| drive.losses > 0).map(of_link),
        overrun,
    ]
    .into_iter()
    .flatten()
    .chain(stopped(summary))
    .chain(host_took(summary))
    .collect();
    let failures = summary.failures.iter().filter(|failure| failure.fails_run);
    let lines: Vec<String> = failures.map(|failure| failure.what.clone()).chain(lines).collect();
    Stop::failed(lines.join("; "))
}

/// The axes that were stopped by what no other line names, each with its cause.
fn stopped(summary: &Summary) -> Option<String> {
    let mut failed = summary.drives.iter().filter(|drive| drive.failed_by().is_some());
    let remedy = match failed.all(Drive::was_starved) {
        true => {
            "what feeds them came too late: give its thread processor time, or let it queue further ahead"
        }
        false => "the black box says what led to it",
    };
    let axes = summary.stopped_axes()?;
    Some(format!("stopped: {axes}; {remedy}, and `reset` ends it"))
}

/// The time that the host took from the loop, if that may have cost a drive: a hundredth of the run, or more.
pub fn host_took(summary: &Summary) -> Option<String> {
    let run_ms = summary.cycle.planned * summary.cycle.period_ns / MS;
    let (others_ms, steal_ms) = (summary.host.taken_ms, summary.host.steal_ms.unwrap_or(0));
    (100 * (others_ms + steal_ms) >= run_ms && run_ms > 0).then(|| {
        format!(
            "this host took from a run of {run_ms} ms: other threads {others_ms} ms of the loop's core, the \
             hypervisor {steal_ms} ms of all cores"
        )
    })
}
