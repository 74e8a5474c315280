//! A run as a file: its counts, histograms, course and motion. The page of a report is drawn from it, a later run is
//! compared with it, and a soak test that was killed goes on from it.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::summary::Summary;
use fieldbeat_core::axis::{Fault, FaultNames};
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::record::Stage;
use fieldbeat_core::cycle::status::{Numbers, Peak};
use fieldbeat_telemetry::Measured;
use fieldbeat_telemetry::bins::Bins;
use fieldbeat_telemetry::histograms::{Quantiles, Quantity};
use fieldbeat_telemetry::motion::{AxisMotion, Happened};
use fieldbeat_telemetry::parts::{self, Part};
use fieldbeat_telemetry::timeline::Timeline;

/// The form of the file. Another one is refused.
const FORMAT: u32 = 1;

/// A run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Archive {
    format: u32,
    /// The version of the program.
    pub program: String,
    /// The name of the configuration's file.
    pub machine: Option<String>,
    /// When it was made, in UTC.
    pub at: String,
    /// The host, and what it granted.
    pub host: Host,
    /// The period, ns.
    pub period_ns: u64,
    /// A cycle is late that began, or spent in a stage, more than this, ns.
    pub late_ns: u64,
    /// Replies are taken in until then, ns after the grid point.
    pub deadline_ns: u64,
    /// The counts of the loop.
    pub counts: Counts,
    /// Begins of the cycles after their grid points.
    pub wake: Sampled,
    /// Differences between the distance of two begins and that of their grid points.
    pub jitter: Sampled,
    /// The stages, in the order of [`Stage::ALL`].
    pub stages: Vec<Sampled>,
    /// Causes of late cycles, the most frequent first.
    pub causes: Vec<CauseCount>,
    /// The drives, in the order of the plan.
    pub drives: Vec<Drive>,
    /// The failures of the program itself.
    pub failures: Vec<String>,
    /// The largest values over time.
    pub timeline: Timeline,
    /// The histograms, part by part.
    pub parts: Vec<Part>,
}

/// The host of a run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Host {
    /// The computer, and what it took from the loop.
    #[serde(flatten)]
    pub computer: super::summary::Host,
    /// Scheduling policy of the loop, and its priority.
    pub policy: String,
    /// The core.
    pub core: Option<usize>,
    /// The requests that the operating system did not grant.
    pub missing: Vec<String>,
}

/// Counts of the loop.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Counts {
    /// Slots of the grid.
    pub planned: u64,
    /// Cycles executed.
    pub executed: u64,
    /// Slots skipped.
    pub skipped: u64,
    /// Times that a cycle was too late for the next slot.
    pub overruns: u64,
    /// Late cycles.
    pub late: u64,
    /// Exchanges missed by all drives.
    pub missed: u64,
    /// Telemetry records lost.
    pub lost_records: u64,
    /// Events and samples of the application lost.
    pub lost_events: u64,
}

/// The values of a quantity, and its exact maximum.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Sampled {
    /// The values.
    pub bins: Bins,
    /// The largest, ns.
    pub max_ns: u64,
    /// The cycle of that.
    pub max_cycle: u64,
}

impl Sampled {
    fn of(quantity: &Quantity, peak: Peak) -> Sampled {
        Sampled { bins: Bins::of(quantity), max_ns: peak.ns, max_cycle: peak.index }
    }

    /// The largest value.
    pub fn peak(&self) -> Peak {
        Peak { ns: self.max_ns, index: self.max_cycle }
    }

    /// The quantiles.
    pub fn quantiles(&self) -> Quantiles {
        self.bins.quantiles(self.peak())
    }

    fn append(&mut self, begin: u64, later: &Sampled) {
        self.bins.add(&later.bins);
        if later.max_ns > self.max_ns {
            (self.max_ns, self.max_cycle) = (later.max_ns, begin + later.max_cycle);
        }
    }
}

/// A cause of late cycles.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct CauseCount {
    /// In words.
    pub what: String,
    /// Cycles.
    pub count: u64,
    /// The longest delay, ns.
    pub worst_ns: Option<u64>,
}

/// One drive.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Drive {
    /// The name.
    pub name: String,
    /// The protocol.
    pub protocol: String,
    /// The unit of its axis.
    pub unit: String,
    /// Link at the end.
    pub link: String,
    /// State at the end.
    pub state: String,
    /// Why its axis stands stopped.
    pub stopped: Option<String>,
    /// The fault.
    pub fault: Option<String>,
    /// The names of the faults that it had, by their codes.
    pub fault_names: BTreeMap<u32, String>,
    /// Times that the link was lost.
    pub losses: u64,
    /// The exchanges: name and count.
    pub exchanges: Exchanges,
    /// The round trips.
    pub rtt: Sampled,
    /// How it moved.
    pub motion: AxisMotion,
}

/// The exchanges of a drive.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Exchanges {
    /// Requests sent.
    pub sent: u64,
    /// Answered in time.
    pub answered: u64,
    /// Not answered in time.
    pub missed: u64,
    /// Replies after their window.
    pub late: u64,
    /// Second replies.
    pub duplicate: u64,
    /// Malformed and foreign datagrams.
    pub rejected: u64,
    /// Refused by the operating system.
    pub unsent: u64,
    /// Missed or not sent while it was online.
    #[serde(default)]
    pub unanswered_online: u64,
}

/// Why a file is no run to compare with. The message ends with the remedy.
#[derive(Error)]
pub enum ArchiveError {
    /// It cannot be read.
    #[error(
        "cannot read {}: {error}; name the run.json that an earlier report or soak test wrote",
        .file.display()
    )]
    Unread {
        /// The file.
        file: PathBuf,
        /// The error of the operating system.
        error: io::Error,
    },
    /// It is something else, or broken.
    #[error(
        "{file} is no run.json of a report, or is damaged: {why}; name the one that an earlier run wrote"
    )]
    NotOne {
        /// The file.
        file: PathBuf,
        /// The part that does not fit.
        why: String,
    },
    /// Another version wrote it.
    #[error(
        "{file} is of form {found}, not {FORMAT}: another version of this program wrote it; use that version"
    )]
    Form {
        /// The file.
        file: PathBuf,
        /// The form.
        found: u64,
    },
}
fieldbeat_core::debug_as_display!(ArchiveError);

impl Archive {
    /// The run so far: its plan and numbers, what was measured, and its summary.
    pub fn of(plan: &Plan, numbers: &Numbers, measured: &Measured, summary: &Summary) -> Archive {
        let (status, histograms) = (&numbers.status, &measured.histograms);
        let machine = plan.source.as_ref().and_then(|path| path.file_name());
        let drives = (numbers.drives.iter().zip(&summary.drives))
            .zip(histograms.drives.iter().zip(measured.motion.axes()))
            .zip(plan.units().into_iter().zip(plan.fault_names()));
        Archive {
            format: FORMAT,
            program: env!("CARGO_PKG_VERSION").to_owned(),
            machine: machine.map(|name| name.to_string_lossy().into_owned()),
            at: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
            host: Host::of(summary),
            period_ns: plan.cycle.period_ns,
            late_ns: plan.cycle.late_ns(),
            deadline_ns: plan.cycle.deadline_ns(),
            counts: Counts {
                planned: status.planned,
                executed: status.executed,
                skipped: status.skipped,
                overruns: status.overruns,
                late: status.late,
                missed: status.missed,
                lost_records: status.lost_records,
                lost_events: status.lost_events,
            },
            wake: Sampled::of(&histograms.wake, status.wake_max),
            jitter: Sampled::of(&histograms.jitter, status.jitter_max),
            stages: (Stage::ALL.into_iter())
                .map(|stage| Sampled::of(histograms.stage(stage), status.stage_max[stage as usize]))
                .collect(),
            causes: (summary.late.causes.iter())
                .map(|found| CauseCount {
                    what: found.to_string(),
                    count: found.count,
                    worst_ns: found.worst_ns,
                })
                .collect(),
            drives: drives
                .map(|(((end, drive), (measured, motion)), (units, names))| Drive {
                    name: drive.name.clone(),
                    protocol: drive.protocol.to_owned(),
                    unit: units.unit.to_string(),
                    link: drive.link.clone(),
                    state: drive.state.clone(),
                    stopped: drive.stopped_by().or_else(|| drive.stopped.clone()),
                    fault: drive.fault.map(|code| Fault { code, name: drive.fault_name }.to_string()),
                    fault_names: fault_names(motion, names),
                    losses: drive.losses,
                    exchanges: Exchanges {
                        sent: drive.sent,
                        answered: drive.answered,
                        missed: drive.missed,
                        late: drive.late,
                        duplicate: drive.duplicate,
                        rejected: drive.rejected,
                        unsent: drive.unsent,
                        unanswered_online: measured.unanswered,
                    },
                    rtt: Sampled::of(&measured.rtt, end.peaks.rtt),
                    motion: motion.clone(),
                })
                .collect(),
            failures: summary.failures.iter().map(|failure| failure.what.clone()).collect(),
            timeline: measured.timeline.clone(),
            parts: measured.parts.list(status.planned, histograms),
        }
    }

    /// Reads the file that an earlier run wrote.
    pub fn read(file: &Path) -> Result<Archive, ArchiveError> {
        let text = fs::read_to_string(file)
            .map_err(|error| ArchiveError::Unread { file: file.to_owned(), error })?;
        Archive::parse(&text, file)
    }

    /// The same of its text.
    pub fn parse(text: &str, file: &Path) -> Result<Archive, ArchiveError> {
        let not_one =
            |error: serde_json::Error| ArchiveError::NotOne { file: file.to_owned(), why: error.to_string() };
        /// The fields that every form has.
        #[derive(Deserialize)]
        struct Form {
            format: u64,
        }
        match serde_json::from_str(text).map_err(not_one)? {
            Form { format } if format != u64::from(FORMAT) => {
                Err(ArchiveError::Form { file: file.to_owned(), found: format })
            }
            Form { .. } => serde_json::from_str(text).map_err(not_one),
        }
    }

    /// The run as text of the file.
    pub fn to_json(&self) -> String {
        // Numbers and texts only: there is nothing that cannot be written.
        serde_json::to_string(self).unwrap_or_default() + "\n"
    }

    /// Machine time, ns.
    pub fn length_ns(&self) -> u64 {
        self.counts.planned.saturating_mul(self.period_ns)
    }

    /// Appends a later run of the same machine: counts add up, and what stood at its end is what stands now.
    pub fn append(&mut self, later: &Archive) {
        let begin = self.counts.planned;
        self.at.clone_from(&later.at);
        let before = std::mem::replace(&mut self.host, later.host.clone()).computer;
        let computer = &mut self.host.computer;
        computer.steal_ms = computer.steal_ms.map(|ms| ms + before.steal_ms.unwrap_or(0)).or(before.steal_ms);
        computer.taken_ms += before.taken_ms;
        self.counts.append(&later.counts);
        self.wake.append(begin, &later.wake);
        self.jitter.append(begin, &later.jitter);
        self.stages.iter_mut().zip(&later.stages).for_each(|(one, other)| one.append(begin, other));
        for cause in &later.causes {
            match self.causes.iter_mut().find(|known| known.what == cause.what) {
                Some(known) => {
                    known.count += cause.count;
                    known.worst_ns = known.worst_ns.max(cause.worst_ns);
                }
                None => self.causes.push(cause.clone()),
            }
        }
        self.causes.sort_by_key(|cause| std::cmp::Reverse(cause.count));
        self.drives.iter_mut().zip(&later.drives).for_each(|(one, other)| one.append(begin, other));
        let new = later.failures.iter().filter(|failure| !self.failures.contains(failure));
        let new: Vec<String> = new.cloned().collect();
        self.failures.extend(new);
        self.timeline.append(begin, &later.timeline);
        self.parts.extend(later.parts.iter().cloned());
        parts::bound(&mut self.parts);
    }
}

/// The names of the faults in the marks of an axis.
fn fault_names(motion: &AxisMotion, names: FaultNames) -> BTreeMap<u32, String> {
    let codes = motion.marks.iter().filter_map(|mark| match mark.what {
        Happened::Fault(code) => Some(code),
        _ => None,
    });
    codes.filter_map(|code| Some((code, names(code)?.to_owned()))).collect()
}

impl Counts {
    fn append(&mut self, later: &Counts) {
        self.planned += later.planned;
        self.executed += later.executed;
        self.skipped += later.skipped;
        self.overruns += later.overruns;
        self.late += later.late;
        self.missed += later.missed;
        self.lost_records += later.lost_records;
        self.lost_events += later.lost_events;
    }
}

impl Host {
    fn of(summary: &Summary) -> Host {
        let real = &summary.realtime;
        let priority = if real.priority > 0 { format!(" {}", real.priority) } else { String::new() };
        Host {
            computer: summary.host.clone(),
            policy: format!("{}{priority}", real.policy),
            core: real.core,
            missing: real.missing.clone(),
        }
    }
}

impl Drive {
    fn append(&mut self, begin: u64, later: &Drive) {
        self.link.clone_from(&later.link);
        self.state.clone_from(&later.state);
        self.stopped.clone_from(&later.stopped);
        self.fault.clone_from(&later.fault);
        self.fault_names.extend(later.fault_names.clone());
        self.losses += later.losses;
        let (one, other) = (&mut self.exchanges, &later.exchanges);
        one.sent += other.sent;
        one.answered += other.answered;
        one.missed += other.missed;
        one.late += other.late;
        one.duplicate += other.duplicate;
        one.rejected += other.rejected;
        one.unsent += other.unsent;
        one.unanswered_online += other.unanswered_online;
        self.rtt.append(begin, &later.rtt);
        self.motion.append(begin, &later.motion);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use fieldbeat_telemetry::Run;

    /// The archive of a run.
    pub fn archive(run: &Run) -> Archive {
        Archive::of(&run.plan, &run.end, &run.measured, &Summary::from(run))
    }

    #[test]
    fn a_written_archive_reads_back_equal() {
        let run = fieldbeat_testing::runs::run("x", 3_000);
        let archive = archive(&run);
        let read = Archive::parse(&archive.to_json(), Path::new("run.json")).unwrap();
        assert!(read.parts == archive.parts && !read.parts.is_empty());
        assert_eq!(read.timeline.stretches(), archive.timeline.stretches());
        assert_eq!(read.drives[0].motion.stretches(), archive.drives[0].motion.stretches());
        assert!(read.drives[0].motion.marks.iter().eq(archive.drives[0].motion.marks.iter()));
        assert_eq!(read.wake.quantiles(), Summary::from(&run).wake_ns);
        assert_eq!(read.drives[0].rtt.quantiles(), Summary::from(&run).drives[0].rtt_ns);
    }

    #[test]
    fn a_run_and_its_continuation_are_one_run() {
        let [one, other] = [3_000, 5_000].map(|cycles| fieldbeat_testing::runs::run("x", cycles));
        let mut both = archive(&one);
        both.append(&archive(&other));
        assert_eq!((both.counts.planned, both.wake.bins.count()), (8_000, 8_000));
        assert_eq!(parts::together(&both.parts).cycles, 8_000);
        let (max, later) = (one.end.status.wake_max, other.end.status.wake_max);
        let expected = if later.ns > max.ns { 3_000 + later.index } else { max.index };
        assert_eq!((both.wake.max_ns, both.wake.max_cycle), (max.ns.max(later.ns), expected));
        assert_eq!(both.drives[0].exchanges.sent, 0);
        assert_eq!(both.drives[0].rtt.bins.count(), 8_000);
        let missed: u64 = both.timeline.stretches().iter().map(|stretch| stretch.missed).sum();
        assert_eq!(missed, 8);
    }
}
