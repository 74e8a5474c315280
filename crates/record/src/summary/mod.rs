//! A run in numbers: the object that `--json` prints, and the same as text.

mod bus;
mod carried;
mod cycle;
mod drive;
mod late;
pub mod numbers;
mod text;

use serde::{Deserialize, Serialize};

pub(super) use self::bus::loads;
pub use self::bus::{Bus, ClockNumbers};
pub use self::carried::{Carried, Share};
use self::carried::{Course, bins, is_realtime};
pub use self::cycle::{CycleNumbers, ReferenceNumbers, Stages};
pub use self::drive::{BegunBy, Drive, Variable};
pub use self::late::named;
pub use self::late::{Found, Late, LateCycle};
pub(super) use self::numbers::plain;
pub use self::numbers::plural;
pub(super) use self::numbers::{decimals, reported};
use fieldbeat_core::axis::{Fault, Link, StopCause, Units};
pub use fieldbeat_core::bus::counters::ProtocolCounters;
use fieldbeat_core::bus::facts::of_drives;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::record::Stage;
use fieldbeat_core::cycle::status::{DeviceEnd, Numbers, Status};
use fieldbeat_core::rt::{Granted, host};
use fieldbeat_core::time::MS;
use fieldbeat_telemetry::histograms::Quantiles;
use fieldbeat_telemetry::monitor::Monitor;
use fieldbeat_telemetry::sink::Recorded;
use fieldbeat_telemetry::thread::{Failure, Measured, Run, Written};

impl From<&Run> for Summary {
    /// That of a run.
    fn from(run: &Run) -> Summary {
        Summary::of(&run.plan, &run.end, &run.measured, &run.granted, run.steal_ms)
    }
}

impl From<&Monitor> for Summary {
    /// That of a run so far.
    fn from(monitor: &Monitor) -> Summary {
        let (numbers, steal_ms) = (monitor.numbers(), monitor.steal_ms());
        monitor
            .measured(|measured| Summary::of(monitor.plan(), &numbers, measured, monitor.granted(), steal_ms))
    }
}

/// The whole run. Keys are stable; values are in ns unless the key says otherwise; what is not known is null.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The cycle.
    pub cycle: CycleNumbers,
    /// Whether the host carried its period.
    pub carried: Carried,
    /// Wake-up latency: start of the cycles after their grid points; skipped slots count as late ones.
    pub wake_ns: Quantiles,
    /// Differences between the distance of two successive begins and that of their grid points.
    pub jitter_ns: Quantiles,
    /// Time of each stage.
    pub stages_ns: Stages,
    /// Late cycles and their causes.
    pub late: Late,
    /// The drives, in the order of the plan.
    pub drives: Vec<Drive>,
    /// Devices that are not drives, in the order of the plan.
    pub devices: Vec<DeviceEnd>,
    /// The buses: datagrams that belong to no drive, and their clocks.
    pub buses: Vec<Bus>,
    /// How real-time the run was.
    pub realtime: RealtimeNumbers,
    /// The machine.
    pub host: Host,
    /// The files of the black box.
    pub black_boxes: Vec<Written>,
    /// The recordings.
    pub recordings: Vec<Recorded>,
    /// The failures of the program itself, and at the end each drive that is not known to be off.
    pub failures: Vec<Failure>,
    /// The histogram of the wake-ups, drawn by the text form only.
    #[serde(skip)]
    wake_bars: Vec<(u64, u64)>,
    /// User units of the axes, for the text form only.
    #[serde(skip)]
    units: Vec<Units>,
}

/// The number of late cycles that are listed one by one.
const NEWEST: usize = 20;

/// How real-time the run was.
#[derive(Clone, Debug, Serialize)]
pub struct RealtimeNumbers {
    /// Scheduling policy of the loop.
    pub policy: &'static str,
    /// The priority.
    pub priority: u8,
    /// The core.
    pub core: Option<usize>,
    /// Memory was locked.
    pub memory_locked: bool,
    /// Page faults of the loop's thread while it ran.
    pub page_faults: Option<u64>,
    /// Times that the loop's thread was preempted while it ran.
    pub involuntary_switches: Option<u64>,
    /// Records lost before the histograms; counts and maxima are exact.
    pub telemetry_lost: u64,
    /// Events and samples for which the application's queues had no room.
    pub events_lost: u64,
    /// The requests that the operating system did not grant, one line each, with its remedy.
    pub missing: Vec<String>,
}

/// The machine.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Host {
    /// The name.
    pub name: Option<String>,
    /// Kernel release.
    pub kernel: Option<String>,
    /// Preemption model.
    pub preemption: Option<String>,
    /// Processor.
    pub cpu: Option<String>,
    /// Time that the hypervisor took from this machine during the run, ms.
    pub steal_ms: Option<u64>,
    /// Time that other threads had the core while the loop could have run, ms.
    pub taken_ms: u64,
}

/// A bus that does not come to its end is left as it is.
fn cut_off(status: &Status) -> Option<Failure> {
    let what = "the orderly end of a bus did not complete in 10 s: look at its drives before the next start";
    status.cut_off.then(|| Failure::of_run(what))
}

/// Which drives stand stopped because they were found running, or because that stopped their group: no drive of it was
/// stopped by anything else.
fn found_running(plan: &Plan, numbers: &Numbers) -> Vec<bool> {
    let groups = plan.axes().into_iter().map(|axis| axis.stop.group);
    let stopped: Vec<_> = groups.zip(numbers.drives.iter().map(|drive| drive.feedback.stopped)).collect();
    let took_along = |group: Option<u16>| {
        let mut causes = stopped.iter().filter(|(other, _)| *other == group).filter_map(|(_, cause)| *cause);
        let all = [StopCause::FoundRunning, StopCause::Group, StopCause::Shutdown];
        causes.clone().all(|cause| all.contains(&cause))
            && causes.any(|cause| cause == StopCause::FoundRunning)
    };
    let is_found = |(group, cause): &(Option<u16>, Option<StopCause>)| match cause {
        Some(StopCause::FoundRunning) => true,
        Some(StopCause::Group) => took_along(*group),
        _ => false,
    };
    stopped.iter().map(is_found).collect()
}

impl Summary {
    /// A run in numbers, ended or not.
    pub fn of(
        plan: &Plan,
        numbers: &Numbers,
        measured: &Measured,
        granted: &Granted,
        steal_ms: Option<u64>,
    ) -> Summary {
        let (status, histograms) = (&numbers.status, &measured.histograms);
        let facts = plan.facts();
        let found = found_running(plan, numbers);
        let drives: Vec<Drive> = (numbers.drives.iter().zip(&histograms.drives))
            .zip(of_drives(&facts))
            .zip(found)
            .zip(plan.units())
            .map(|((((drive, measured), (bus, of)), found_running), Units { unit, .. })| {
                let (own, fault_names, monitored) = (bus.own_counters, bus.fault_names, of.monitored.clone());
                let variable = |(channel, extent): (Option<_>, _)| Some(Variable::of(channel?, extent));
                let (counters, feedback, peaks) = (&drive.counters, &drive.feedback, &drive.peaks);
                Drive {
                    name: drive.name.clone(),
                    protocol: drive.protocol,
                    link: feedback.link.to_string(),
                    not_connected: drive.not_connected.clone(),
                    diagnosis: drive.diagnosis.clone(),
                    state: feedback.status.state.to_string(),
                    losses: drive.losses,
                    sent: counters.sent,
                    answered: counters.answered,
                    missed: counters.missed,
                    late: counters.late,
                    duplicate: counters.duplicate,
                    rejected: counters.malformed + counters.foreign,
                    suspect: counters.suspect,
                    implausible: counters.implausible,
                    unsent: counters.unsent,
                    rtt_ns: Quantiles::of(&measured.rtt, peaks.rtt),
                    send_jitter_ns: Quantiles::of(&measured.send_jitter, peaks.send_jitter),
                    age_ns: Quantiles::of(&measured.age, peaks.age),
                    age_cycles: feedback.age,
                    protocol_counters: ProtocolCounters::of(own, counters.own),
                    position: reported(feedback.status.position).filter(|_| feedback.link != Link::Unseen),
                    sto_open: feedback.status.sto_open,
                    stopped: feedback.stopped.map(|cause| cause.to_string()),
                    begun_by: feedback.begun_by.map(|by| BegunBy {
                        axis: numbers
                            .drives
                            .get(usize::from(by.axis))
                            .map_or_else(String::new, |of| of.name.clone()),
                        cause: by.cause.to_string(),
                    }),
                    fault: (feedback.status.fault != 0).then_some(feedback.status.fault),
                    fault_name: fault_names(feedback.status.fault).filter(|_| feedback.status.fault != 0),
                    found_running,
                    monitor: (monitored.into_iter().zip(drive.monitor)).filter_map(variable).collect(),
                    at_end: drive.at_end.clone(),
                    left: drive.left(unit),
                }
            })
            .collect();
        let left_on = drives.iter().filter_map(Drive::left_on).map(Failure::of_run);
        let left_on: Vec<Failure> = left_on.collect();
        let leads = |bus: &str| plan.cycle.reference.as_deref() == Some(bus);
        let clocks = numbers.clocks.iter().copied().chain(std::iter::repeat(None));
        let buses = (numbers.buses.iter().zip(clocks).zip(loads(&facts, plan.cycle.period_ns, numbers)))
            .map(|(((name, unmatched), clock), load_percent)| Bus {
                name: name.clone(),
                unmatched: unmatched.datagrams,
                dropped: unmatched.dropped,
                receive_errors: unmatched.errors,
                load_percent,
                clock: clock.map(|clock| ClockNumbers::of(clock, leads(name))),
            })
            .collect();
        let (wake, stages) = bins(histograms);
        let exchanges = numbers
            .drives
            .iter()
            .zip(&histograms.drives)
            .map(|(drive, measured)| (drive.name.as_str(), drive.counters.answered, measured.unanswered));
        let course = Course {
            planned: status.planned,
            executed: status.executed,
            skipped: status.skipped,
            drives: exchanges.collect(),
            wake,
            stages,
            realtime: is_realtime(granted.policy, &granted.missing),
        };
        Summary {
            carried: Carried::of(&plan.cycle, &course),
            cycle: CycleNumbers {
                period_ns: plan.cycle.period_ns,
                planned: status.planned,
                executed: status.executed,
                skipped: status.skipped,
                overruns: status.overruns,
                reference: (status.reference.as_ref())
                    .map(|reference| ReferenceNumbers::of(plan, reference, &histograms.reference)),
            },
            wake_ns: Quantiles::of(&histograms.wake, status.wake_max),
            jitter_ns: Quantiles::of(&histograms.jitter, status.jitter_max),
            stages_ns: Stages(
                Stage::ALL
                    .map(|stage| Quantiles::of(histograms.stage(stage), status.stage_max[stage as usize])),
            ),
            late: Late {
                threshold_ns: plan.cycle.late_ns(),
                count: status.late,
                causes: measured.causes.ranked().iter().map(|tally| Found::of(tally, plan)).collect(),
                newest: (measured.causes.newest(NEWEST)).map(|late| LateCycle::of(late, plan)).collect(),
            },
            drives,
            devices: numbers.devices.clone(),
            buses,
            realtime: RealtimeNumbers {
                policy: granted.policy,
                priority: granted.priority,
                core: granted.core,
                memory_locked: granted.memory_locked,
                page_faults: numbers.page_faults,
                involuntary_switches: numbers.involuntary_switches,
                telemetry_lost: status.lost_records,
                events_lost: status.lost_events,
                missing: granted.missing.clone(),
            },
            host: Host {
                name: host::name(),
                kernel: host::kernel(),
                preemption: host::preemption(),
                cpu: host::cpu(),
                steal_ms,
                taken_ms: measured.causes.taken_ns() / MS,
            },
            black_boxes: measured.black_boxes.clone(),
            recordings: measured.recordings.clone(),
            failures: (measured.failures.iter().cloned()).chain(cut_off(status)).chain(left_on).collect(),
            wake_bars: text::bars(&histograms.wake),
            units: plan.units(),
        }
    }

    /// Whether a drive was lost or is not known to be off at the end, an axis had been stopped at the end by anything
    /// but that end, or the program itself failed: a failure however the run was ended.
    pub fn has_failed(&self) -> bool {
        self.drives.iter().any(|drive| drive.losses > 0 || drive.failed_by().is_some())
            || self.failures.iter().any(|failure| failure.fails_run)
    }

    /// The drives that are not known to be off at the end, nor held as planned: how each was left, what was tried, and
    /// what to do.
    pub fn left_on(&self) -> Option<String> {
        let drives: Vec<String> = self.drives.iter().filter_map(Drive::left_on).collect();
        (!drives.is_empty()).then(|| drives.join("; "))
    }

    /// The axes that had been stopped at the end, each with its cause, but for lost drives and overruns.
    pub fn stopped_axes(&self) -> Option<String> {
        let named = self.drives.iter().filter(|drive| drive.losses == 0 && !drive.was_overrun());
        let axes = named.filter_map(|drive| {
            let fault = drive.fault.map(|code| format!(", fault {}", Fault { code, name: drive.fault_name }));
            Some(format!("{} ({}{})", drive.name, drive.failed_by()?, fault.unwrap_or_default()))
        });
        let axes: Vec<String> = axes.collect();
        (!axes.is_empty()).then(|| axes.join(", "))
    }

    /// Whether every drive answered, none was lost on the way or stopped, and the program itself did not fail. Whether
    /// the host [carried](Self::carried) the period is another question.
    pub fn is_whole(&self) -> bool {
        !self.has_failed() && self.drives.iter().all(Drive::is_online)
    }
}
