//! A run in numbers: the object that `--json` prints, and the same as text.

use std::fmt::{self, Write as _};

use serde::{Serialize, Serializer};

use super::causes::{Cause, Judged, Tally};
use super::histograms::{Quantiles, Quantity};
use super::monitor::Monitor;
use super::recorder::{Measured, Run, Written};
use crate::axis::{Fault, Link, MonitorChannel, StopCause, Units};
use crate::bus::BusClock;
use crate::bus::{Counters, OwnCounter};
use crate::cycle::Plan;
use crate::cycle::record::Stage;
use crate::cycle::status::{DeviceEnd, Extent, Numbers, ReferenceStatus};
use crate::master::Master;
use crate::rt::{Granted, host};
use crate::time::{Ns, S, US};

impl Run {
    /// The summary of the run.
    pub fn summary(&self) -> Summary {
        Summary::of(&self.plan, &self.end, &self.measured, &self.granted, self.steal_ms)
    }
}

impl Monitor {
    /// The run so far.
    pub fn summary(&self) -> Summary {
        let (numbers, steal_ms) = (self.numbers(), self.steal_ms());
        self.measured(|measured| Summary::of(self.plan(), &numbers, measured, self.granted(), steal_ms))
    }
}

impl Master {
    /// See [`Monitor::summary`].
    pub fn summary(&self) -> Summary {
        self.monitor().summary()
    }
}

/// The whole run. Keys are stable; values are in ns unless the key says otherwise; what is not known is null.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The cycle.
    pub cycle: CycleNumbers,
    /// Begin of the cycles after their grid points; skipped slots are in it as late ones.
    pub wake_ns: Quantiles,
    /// Differences between the distance of two successive begins and that of their grid points.
    pub jitter_ns: Quantiles,
    /// Time of each stage.
    pub stages_ns: Stages,
    /// Late cycles, and why they were.
    pub late: Late,
    /// The drives, in the order of the plan.
    pub drives: Vec<Drive>,
    /// What takes part without being a drive, in the order of the plan.
    pub devices: Vec<Device>,
    /// The buses: what arrived and belongs to no drive, and their clocks.
    pub buses: Vec<Bus>,
    /// How real-time the run was.
    pub realtime: RealtimeNumbers,
    /// The machine.
    pub host: Host,
    /// What the black box wrote.
    pub black_boxes: Vec<Written>,
    /// The histogram of the wake-ups, drawn by the text form only.
    #[serde(skip)]
    wake_bars: Vec<(u64, u64)>,
    /// User units of the axes, for the text form only.
    #[serde(skip)]
    units: Vec<Units>,
}

/// Counts of the loop. `planned = executed + skipped`, each counted on its own.
#[derive(Clone, Debug, Serialize)]
pub struct CycleNumbers {
    /// The period.
    pub period_ns: u64,
    /// Slots that the grid laid out.
    pub planned: u64,
    /// Cycles executed.
    pub executed: u64,
    /// Slots passed over.
    pub skipped: u64,
    /// Times that a cycle was too late for the next slot.
    pub overruns: u64,
    /// The clock that leads the grid; null: it is ours.
    pub reference: Option<ReferenceNumbers>,
}

/// How the grid follows the clock of a bus. The counts and maxima are exact.
#[derive(Clone, Debug, Serialize)]
pub struct ReferenceNumbers {
    /// The bus.
    pub bus: String,
    /// The grid is locked.
    pub locked: bool,
    /// Times that the lock was lost.
    pub losses: u64,
    /// Executed cycles in which the clock was seen.
    pub samples: u64,
    /// Executed cycles in which it was not; they steer nothing.
    pub silent: u64,
    /// Distances of the slots from where the clock wants them, late or early, from the first lock on.
    pub error_ns: Quantiles,
    /// The largest step of the grid.
    pub step_max_ns: u64,
}

impl ReferenceNumbers {
    fn of(plan: &Plan, status: &ReferenceStatus, error: &Quantity) -> ReferenceNumbers {
        ReferenceNumbers {
            bus: plan.cycle.reference.clone().unwrap_or_default(),
            locked: status.locked,
            losses: status.losses,
            samples: status.samples,
            silent: status.silent,
            error_ns: Quantiles::of(error, status.error_max),
            step_max_ns: status.step_max.ns,
        }
    }
}

impl fmt::Display for ReferenceNumbers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ReferenceNumbers { bus, locked, losses, samples, silent, error_ns, step_max_ns } = self;
        let [p50, p99, max] = [error_ns.p50, error_ns.p99, error_ns.max].map(Or);
        write!(f, "grid led by {bus}: {}", if *locked { "locked" } else { "NOT LOCKED" })?;
        write!(f, ", error p50 {p50}  p99 {p99}  max {max}; largest step {}", Ns(*step_max_ns))?;
        if *silent > 0 {
            write!(f, "; not seen in {silent} of {} cycles", samples + silent)?;
        }
        if *losses > 0 {
            write!(f, "; lost {}", plural(*losses, "time"))?;
        }
        Ok(())
    }
}

/// Times of the stages of a cycle.
#[derive(Clone, Debug, Serialize)]
pub struct Stages {
    /// Draining the sockets and handing the requests to the kernel.
    pub send: Quantiles,
    /// Taking in replies.
    pub receive: Quantiles,
    /// Link health, limits, stop ladders.
    pub judge: Quantiles,
    /// Command queues and the in-loop task.
    pub exchange: Quantiles,
    /// Building the next requests.
    pub prepare: Quantiles,
    /// Feedback, events, records.
    pub publish: Quantiles,
}

/// Late cycles.
#[derive(Clone, Debug, Serialize)]
pub struct Late {
    /// A cycle is late that began, or spent in a stage, more than this.
    pub threshold_ns: u64,
    /// Cycles that were; exact.
    pub count: u64,
    /// Why, the most frequent first. While the loop runs the newest are not judged yet.
    pub causes: Vec<Found>,
    /// The newest of them one by one.
    pub newest: Vec<LateCycle>,
}

/// One late cycle.
#[derive(Clone, Debug, Serialize)]
pub struct LateCycle {
    /// Which.
    pub cycle: u64,
    /// How long its delay was, ns; null for a drive.
    pub delay_ns: Option<u64>,
    /// As of the causes.
    pub cause: &'static str,
    /// As of the causes.
    pub stage: Option<&'static str>,
    /// As of the causes.
    pub drive: Option<String>,
}

/// So many late cycles are told one by one.
const NEWEST: usize = 20;

/// A cause of late cycles.
#[derive(Clone, Debug, Serialize)]
pub struct Found {
    /// `host`, `preempted`, `page_fault`, `work`, `drive`, `drives`, `timer` or `unknown`.
    pub cause: &'static str,
    /// The stage, of the loop's own work.
    pub stage: Option<&'static str>,
    /// The drive that had not answered.
    pub drive: Option<String>,
    /// Cycles.
    pub count: u64,
    /// The longest delay, ns; null for a drive.
    pub worst_ns: Option<u64>,
    /// The cycle of that.
    pub worst_cycle: u64,
}

impl Found {
    pub(super) fn of(tally: &Tally, plan: &Plan) -> Found {
        let Tally { cause, count, worst_ns, worst_cycle } = *tally;
        let (cause, stage, drive) = named(cause, plan);
        let worst_ns = (worst_ns > 0).then_some(worst_ns);
        Found { cause, stage, drive, count, worst_ns, worst_cycle }
    }
}

impl LateCycle {
    fn of(judged: &Judged, plan: &Plan) -> LateCycle {
        let (cause, stage, drive) = named(judged.cause, plan);
        let delay_ns = Some(judged.lateness.ns()).filter(|ns| *ns > 0);
        LateCycle { cycle: judged.index, delay_ns, cause, stage, drive }
    }
}

/// The words of the `--json` object for `cause`, and the stage or drive that it names.
fn named(cause: Cause, plan: &Plan) -> (&'static str, Option<&'static str>, Option<String>) {
    match cause {
        Cause::Host => ("host", None, None),
        Cause::Preempted => ("preempted", None, None),
        Cause::PageFault => ("page_fault", None, None),
        Cause::Work(stage) => ("work", Some(stage.name()), None),
        Cause::Drive(axis) => {
            let name = plan.axes().get(usize::from(axis)).map(|axis| axis.name.clone());
            ("drive", None, name)
        }
        Cause::Drives => ("drives", None, None),
        Cause::Timer => ("timer", None, None),
        Cause::Unknown => ("unknown", None, None),
    }
}

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.cause, &self.drive, self.stage) {
            ("host", ..) => f.write_str("the host took the core"),
            ("preempted", ..) => f.write_str("preempted or throttled: another thread had the core"),
            ("page_fault", ..) => f.write_str("page fault"),
            ("work", _, Some(stage)) => write!(f, "own work, or an interrupt within it, in stage {stage}"),
            (_, Some(drive), _) => write!(f, "drive {drive} had not answered at the deadline"),
            ("drives", ..) => f.write_str("several drives had not answered at the deadline"),
            ("timer", ..) => {
                f.write_str("its timer came late: idle state, interrupts off, firmware, or hypervisor")
            }
            _ => f.write_str("unknown: nothing was seen"),
        }
    }
}

/// One drive.
#[derive(Clone, Debug, Serialize)]
pub struct Drive {
    /// Its name.
    pub name: String,
    /// Its protocol.
    pub protocol: &'static str,
    /// Link at the end.
    pub link: String,
    /// Why it had no connection at the end; null: it had one, needs none, or its first opening was under way.
    pub not_connected: Option<String>,
    /// State at the end.
    pub state: String,
    /// Times that the link was lost.
    pub losses: u64,
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
    /// Malformed and foreign datagrams from its address.
    pub rejected: u64,
    /// Answered, but possibly by the reply to an earlier request.
    pub suspect: u64,
    /// Refused by the operating system.
    pub unsent: u64,
    /// Round trips.
    pub rtt_ns: Quantiles,
    /// Differences between the distance of two successive requests and that of their grid points.
    pub send_jitter_ns: Quantiles,
    /// Age of its values whenever a window closed, while its link was up.
    pub age_ns: Quantiles,
    /// Cycles since the last values at the end.
    pub age_cycles: u32,
    /// What only its protocol counts, by its key; empty if that counts nothing of its own.
    pub protocol_counters: ProtocolCounters,
    /// Actual position at the end, user units; null if the drive tells none.
    pub position: Option<f64>,
    /// The drive's hardware enable (STO) is missing.
    pub inhibited: bool,
    /// Why the axis stands stopped.
    pub stopped: Option<String>,
    /// Fault code, null = none.
    pub fault: Option<u32>,
    /// What its protocol calls that; null if it has no name for it.
    pub fault_name: Option<&'static str>,
    /// What it shows besides its process data, as planned.
    pub monitor: Vec<Variable>,
}

/// What only one protocol counts of a drive, exactly.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProtocolCounters(pub Vec<(OwnCounter, u64)>);

impl ProtocolCounters {
    pub(super) fn of(own: &[OwnCounter], counters: &Counters) -> ProtocolCounters {
        ProtocolCounters(own.iter().copied().zip(counters.own).collect())
    }

    fn are_any(&self) -> bool {
        self.0.iter().any(|(_, count)| *count > 0)
    }
}

impl Serialize for ProtocolCounters {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(counter, count)| (counter.key, count)))
    }
}

/// Those above 0, in words.
impl fmt::Display for ProtocolCounters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counted = self.0.iter().filter(|(_, count)| *count > 0);
        for (place, (OwnCounter { what, .. }, count)) in counted.enumerate() {
            let between = if place == 0 { "" } else { "; " };
            write!(f, "{between}{what}: {count}")?;
        }
        Ok(())
    }
}

/// A variable that a drive shows besides its process data. Its numbers are exact, and null until it was seen.
#[derive(Clone, Debug, Serialize)]
pub struct Variable {
    /// Its name.
    pub name: String,
    /// Of its values; empty for a plain number.
    pub unit: &'static str,
    /// The newest value.
    pub value: Option<f64>,
    /// The smallest one.
    pub min: Option<f64>,
    /// The largest one.
    pub max: Option<f64>,
}

impl Variable {
    fn of(MonitorChannel { name, unit }: MonitorChannel, extent: Option<Extent>) -> Variable {
        Variable {
            name,
            unit,
            value: extent.and_then(|extent| told(extent.value)),
            min: extent.and_then(|extent| told(extent.min)),
            max: extent.and_then(|extent| told(extent.max)),
        }
    }
}

impl fmt::Display for Variable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Variable { name, unit, .. } = self;
        let (Some(value), Some(min), Some(max)) = (self.value, self.min, self.max) else {
            return write!(f, "{name:18} not seen yet");
        };
        let [value, min, max] = [value, min, max].map(plain);
        write!(f, "{name:18} {}, from {min} to {max}", format!("{value} {unit}").trim_end())
    }
}

/// One bus.
#[derive(Clone, Debug, Serialize)]
pub struct Bus {
    /// Its name.
    pub name: String,
    /// Datagrams from addresses that are no drive's.
    pub strangers: u64,
    /// Datagrams that the kernel dropped because the socket's buffer was full.
    pub dropped: u64,
    /// Errors of the receiving socket.
    pub receive_errors: u64,
    /// Its clock and the grid; null: it has no clock.
    pub clock: Option<ClockNumbers>,
}

/// How the clock of a bus and the grid stand to each other.
#[derive(Clone, Debug, Serialize)]
pub struct ClockNumbers {
    /// The grid follows it; else it follows the grid.
    pub leads: bool,
    /// It has been where its drives want it for a while.
    pub locked: bool,
    /// How far the newest slot was from where it wants it: positive is late; null: it was not seen.
    pub error_ns: Option<i64>,
    /// The largest distance, late or early, from the first lock on.
    pub error_max_ns: u64,
    /// How far off its drives bear it.
    pub window_ns: u64,
}

impl ClockNumbers {
    fn of(clock: BusClock, leads: bool) -> ClockNumbers {
        let BusClock { error_ns, locked, error_max_ns, window_ns } = clock;
        ClockNumbers { leads, locked, error_ns, error_max_ns, window_ns }
    }
}

impl fmt::Display for ClockNumbers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ClockNumbers { leads, locked, error_ns, error_max_ns, window_ns } = *self;
        let way = if leads { "leads the grid" } else { "follows the grid" };
        write!(f, "{way}, {}, error ", if locked { "locked" } else { "NOT LOCKED" })?;
        match error_ns {
            Some(ns) => write!(f, "{}{}", if ns < 0 { "-" } else { "" }, Ns(ns.unsigned_abs()))?,
            None => f.write_str("not seen")?,
        }
        write!(f, ", at most {} since its lock; its drives bear {}", Ns(error_max_ns), Ns(window_ns))
    }
}

/// What takes part without being a drive.
#[derive(Clone, Debug, Serialize)]
pub struct Device {
    /// Its name.
    pub name: String,
    /// Why it is not in operation; null: it is, or was until the orderly end.
    pub not_operational: Option<String>,
}

/// How real-time the run was.
#[derive(Clone, Debug, Serialize)]
pub struct RealtimeNumbers {
    /// Scheduling policy of the loop.
    pub policy: &'static str,
    /// Its priority.
    pub priority: u8,
    /// Its core.
    pub core: Option<usize>,
    /// Memory was locked.
    pub memory_locked: bool,
    /// Page faults of the loop's thread while it ran.
    pub page_faults: Option<u64>,
    /// Times that the loop's thread was preempted while it ran.
    pub involuntary_switches: Option<u64>,
    /// Records lost on the way to the histograms; counts and maxima are exact all the same.
    pub telemetry_lost: u64,
    /// Events and samples for which the application's queues had no room.
    pub events_lost: u64,
    /// What could not be had, one line each, with its remedy.
    pub missing: Vec<String>,
}

/// The machine.
#[derive(Clone, Debug, Serialize)]
pub struct Host {
    /// Its name.
    pub name: Option<String>,
    /// Kernel release.
    pub kernel: Option<String>,
    /// Preemption model.
    pub preemption: Option<String>,
    /// Processor.
    pub cpu: Option<String>,
    /// Time that the hypervisor took from this machine during the run, ms.
    pub steal_ms: Option<u64>,
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
        let of_protocol = plan.own_counters().into_iter().zip(plan.fault_names());
        let drives = (numbers.drives.iter().zip(&histograms.drives).zip(plan.monitored()).zip(of_protocol))
            .map(|(((drive, measured), monitored), (own, fault_names))| {
                let variable = |(channel, extent): (Option<_>, _)| Some(Variable::of(channel?, extent));
                let (counters, feedback, peaks) = (&drive.counters, &drive.feedback, &drive.peaks);
                Drive {
                    name: drive.name.clone(),
                    protocol: drive.protocol,
                    link: feedback.link.to_string(),
                    not_connected: drive.not_connected.clone(),
                    state: feedback.state.to_string(),
                    losses: drive.losses,
                    sent: counters.sent,
                    answered: counters.answered,
                    missed: counters.missed,
                    late: counters.late,
                    duplicate: counters.duplicate,
                    rejected: counters.malformed + counters.foreign,
                    suspect: counters.suspect,
                    unsent: counters.unsent,
                    rtt_ns: Quantiles::of(&measured.rtt, peaks.rtt),
                    send_jitter_ns: Quantiles::of(&measured.send_jitter, peaks.send_jitter),
                    age_ns: Quantiles::of(&measured.age, peaks.age),
                    age_cycles: feedback.age,
                    protocol_counters: ProtocolCounters::of(own, counters),
                    position: told(feedback.position),
                    inhibited: feedback.inhibited,
                    stopped: feedback.stopped.map(|cause| cause.to_string()),
                    fault: (feedback.fault != 0).then_some(feedback.fault),
                    fault_name: fault_names(feedback.fault).filter(|_| feedback.fault != 0),
                    monitor: (monitored.into_iter().zip(drive.monitor)).filter_map(variable).collect(),
                }
            })
            .collect();
        let leads = |bus: &str| plan.cycle.reference.as_deref() == Some(bus);
        let clocks = numbers.clocks.iter().copied().chain(std::iter::repeat(None));
        let devices = (numbers.devices.iter().cloned())
            .map(|DeviceEnd { name, not_operational }| Device { name, not_operational })
            .collect();
        let buses = (numbers.buses.iter().zip(clocks))
            .map(|((name, strangers), clock)| Bus {
                name: name.clone(),
                strangers: strangers.datagrams,
                dropped: strangers.dropped,
                receive_errors: strangers.errors,
                clock: clock.map(|clock| ClockNumbers::of(clock, leads(name))),
            })
            .collect();
        let stage = |stage: Stage| Quantiles::of(histograms.stage(stage), status.stage_max[stage as usize]);
        Summary {
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
            stages_ns: Stages {
                send: stage(Stage::Send),
                receive: stage(Stage::Receive),
                judge: stage(Stage::Judge),
                exchange: stage(Stage::Exchange),
                prepare: stage(Stage::Prepare),
                publish: stage(Stage::Publish),
            },
            late: Late {
                threshold_ns: plan.cycle.late_ns(),
                count: status.late,
                causes: measured.causes.ranked().iter().map(|tally| Found::of(tally, plan)).collect(),
                newest: (measured.causes.newest(NEWEST)).map(|late| LateCycle::of(late, plan)).collect(),
            },
            drives,
            devices,
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
            },
            black_boxes: measured.black_boxes.clone(),
            wake_bars: bars(&histograms.wake),
            units: plan.axes().iter().map(|axis| axis.units).collect(),
        }
    }

    /// Whether a drive was lost, or the loop came too late: a failure however the run was ended.
    pub fn has_failed(&self) -> bool {
        self.drives.iter().any(|drive| drive.losses > 0 || drive.was_overrun())
    }

    /// Whether every drive answered, none was lost on the way, and none was stopped because the loop came too late.
    pub fn is_whole(&self) -> bool {
        self.drives.iter().all(|drive| drive.losses == 0 && drive.is_online() && !drive.was_overrun())
    }
}

impl Drive {
    /// Whether the link was up at the end.
    pub fn is_online(&self) -> bool {
        self.link == Link::Online.to_string()
    }

    /// Whether most of what was missed came after all, only after its window.
    pub fn is_late(&self) -> bool {
        self.missed > 0 && 2 * self.late > self.missed
    }

    /// Whether the axis was stopped by an overrun of the loop.
    pub fn was_overrun(&self) -> bool {
        self.stopped.as_ref().is_some_and(|cause| *cause == StopCause::Overrun.to_string())
    }
}

/// The wake-ups in bins that double: each bin's upper end, ns, and its count.
fn bars(wake: &Quantity) -> Vec<(u64, u64)> {
    let mut bars = Vec::new();
    let (mut low, mut high) = (0, US / 4);
    while low <= wake.max() && low < S {
        let count = if wake.is_empty() { 0 } else { wake.count_between(low, high - 1) };
        bars.push((high, count));
        (low, high) = (high, high * 2);
    }
    while bars.first().is_some_and(|(_, count)| *count == 0) {
        bars.remove(0);
    }
    bars
}

fn plural(count: u64, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// To the finest step of a drive's own variables, without the digits that are only binary, and with one zero only.
pub(super) fn plain(value: f64) -> f64 {
    (value * 1e4).round() / 1e4 + 0.0
}

/// A value that a drive tells; NaN is none.
pub(super) fn told(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

/// A value with so many decimals; a dash if there is none.
pub(super) fn decimals(value: Option<f64>, decimals: usize) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.decimals$}"))
}

/// `None` as a dash.
struct Or(Option<u64>);

impl fmt::Display for Or {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(ns) => f.pad(&Ns(ns).to_string()),
            None => f.pad("-"),
        }
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let cycle = &self.cycle;
        writeln!(
            f,
            "{} cycles of {}: planned {} = executed {} + skipped {}, {} overruns",
            cycle.executed,
            Ns(cycle.period_ns),
            cycle.planned,
            cycle.executed,
            cycle.skipped,
            cycle.overruns
        )?;
        let quantiles = |q: &Quantiles| {
            format!("p50 {}  p99 {}  p99.9 {}  max {}", Or(q.p50), Or(q.p99), Or(q.p99_9), Or(q.max))
        };
        writeln!(f, "wake-up latency  {}", quantiles(&self.wake_ns))?;
        let most = self.wake_bars.iter().map(|(_, count)| *count).max().unwrap_or(0);
        for (end, count) in &self.wake_bars {
            // Logarithmic: the rare late ones are what a reader looks for.
            let width = if *count == 0 {
                0
            } else {
                (40.0 * (*count as f64).ln_1p() / (most as f64).ln_1p()).ceil() as usize
            };
            let bin = format!("< {}", Ns(*end));
            writeln!(f, "{}", format!("  {bin:>11} {count:>9} {}", "#".repeat(width)).trim_end())?;
        }
        writeln!(f, "cycle jitter     {}", quantiles(&self.jitter_ns))?;
        if let Some(reference) = &cycle.reference {
            writeln!(f, "{reference}")?;
        }
        let stages = &self.stages_ns;
        for (name, stage) in [
            ("send", &stages.send),
            ("receive", &stages.receive),
            ("judge", &stages.judge),
            ("exchange", &stages.exchange),
            ("prepare", &stages.prepare),
            ("publish", &stages.publish),
        ] {
            writeln!(f, "stage {name:10} {}", quantiles(stage))?;
        }
        let late = &self.late;
        writeln!(f, "{} late by more than {}", plural(late.count, "cycle"), Ns(late.threshold_ns))?;
        for found in &late.causes {
            let worst = found.worst_ns.map_or(String::new(), |ns| format!(", at most {}", Ns(ns)));
            writeln!(f, "  {:>9}  {found}{worst} (cycle {})", found.count, found.worst_cycle)?;
        }
        writeln!(f)?;
        let wide = self.drives.iter().map(|drive| drive.name.len()).max().unwrap_or(0).max(5);
        writeln!(
            f,
            "{:wide$} {:18} {:>8} {:>8} {:>6} {:>5} {:>5} {:>6} {:>10} {:>10} {:>10} {:>12}",
            "drive",
            "state",
            "sent",
            "answered",
            "missed",
            "late",
            "dupl.",
            "reject",
            "RTT p50",
            "RTT p99",
            "RTT max",
            "position"
        )?;
        for (drive, units) in self.drives.iter().zip(&self.units) {
            let state = if drive.is_online() { &drive.state } else { &drive.link };
            let mut notes = String::new();
            if let Some(cause) = drive.stopped.as_ref().filter(|cause| *cause != "shutdown") {
                let _ = write!(notes, "  stopped: {cause}");
            }
            if drive.inhibited {
                notes.push_str("  hardware enable (STO) missing");
            }
            if let Some(code) = drive.fault {
                let _ = write!(notes, "  fault {}", Fault { code, name: drive.fault_name });
            }
            if drive.unsent > 0 {
                let _ = write!(notes, "  {} unsent", drive.unsent);
            }
            if let Some(why) = &drive.not_connected {
                let _ = write!(notes, "  not connected: {why}");
            }
            writeln!(
                f,
                "{:wide$} {state:18} {:>8} {:>8} {:>6} {:>5} {:>5} {:>6} {:>10} {:>10} {:>10} {:>9} {:<2}{notes}",
                drive.name,
                drive.sent,
                drive.answered,
                drive.missed,
                drive.late,
                drive.duplicate,
                drive.rejected,
                Or(drive.rtt_ns.p50).to_string(),
                Or(drive.rtt_ns.p99).to_string(),
                Or(drive.rtt_ns.max).to_string(),
                decimals(drive.position, 3),
                units.unit,
            )?;
        }
        for drive in self.drives.iter().filter(|drive| drive.protocol_counters.are_any()) {
            writeln!(f, "{:wide$} {}", drive.name, drive.protocol_counters)?;
        }
        for drive in &self.drives {
            for variable in &drive.monitor {
                writeln!(f, "{:wide$} {variable}", drive.name)?;
            }
        }
        for bus in self.buses.iter().filter(|bus| bus.strangers + bus.dropped + bus.receive_errors > 0) {
            writeln!(
                f,
                "bus {}: {} datagrams from strangers, {} datagrams dropped by the kernel (its buffer was full), \
                 {} receive errors",
                bus.name, bus.strangers, bus.dropped, bus.receive_errors
            )?;
        }
        // What leads the grid has its line above.
        for bus in &self.buses {
            if let Some(clock) = bus.clock.as_ref().filter(|clock| !clock.leads) {
                writeln!(f, "bus {}: its clock {clock}", bus.name)?;
            }
        }
        for Device { name, not_operational } in &self.devices {
            match not_operational {
                Some(why) => writeln!(f, "device {name}: not in operation: {why}")?,
                None => writeln!(f, "device {name}: in operation")?,
            }
        }
        writeln!(f)?;
        let real = &self.realtime;
        let core = real.core.map_or(String::from("any core"), |core| format!("core {core}"));
        let priority = if real.priority > 0 { format!(" {}", real.priority) } else { String::new() };
        let locked = if real.memory_locked { "memory locked" } else { "memory not locked" };
        let faults = real.page_faults.map_or(String::from("-"), |faults| faults.to_string());
        let switches = real.involuntary_switches.map_or(String::from("-"), |switches| switches.to_string());
        writeln!(
            f,
            "loop: {}{priority} on {core}, {locked}; {faults} page faults, {switches} involuntary switches, {} telemetry records lost, {} events lost",
            real.policy, real.telemetry_lost, real.events_lost
        )?;
        let host = &self.host;
        let or = |text: &Option<String>| text.clone().unwrap_or_else(|| String::from("?"));
        let steal = host.steal_ms.map_or(String::from("?"), |steal| steal.to_string());
        writeln!(
            f,
            "host: {}, {}, {}; steal {steal} ms",
            or(&host.kernel),
            or(&host.preemption),
            or(&host.cpu)
        )?;
        for written in &self.black_boxes {
            writeln!(f, "{written}")?;
        }
        if !real.missing.is_empty() {
            writeln!(f, "These numbers are not real-time:")?;
            for line in &real.missing {
                writeln!(f, "  {line}")?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_counters_are_told_in_words_above_zero_and_all_by_their_keys() {
        let own = ["exceptions", "opened", "closed"].map(|key| OwnCounter { key, what: key });
        let mut counters = Counters::default();
        (counters.own[0], counters.own[2]) = (3, u64::MAX);
        let told = ProtocolCounters::of(&own, &counters);
        assert_eq!(told.to_string(), format!("exceptions: 3; closed: {}", u64::MAX));
        let json = format!(r#"{{"exceptions":3,"opened":0,"closed":{}}}"#, u64::MAX);
        assert_eq!(serde_json::to_string(&told).unwrap(), json);
        let none = ProtocolCounters::of(&[], &counters);
        assert_eq!((none.are_any(), serde_json::to_string(&none).unwrap()), (false, "{}".to_owned()));
    }

    #[test]
    fn what_leads_the_grid_is_one_line() {
        let mut reference = ReferenceNumbers {
            bus: "line".into(),
            locked: true,
            losses: 0,
            samples: 990,
            silent: 0,
            error_ns: Quantiles { p50: Some(120), p99: Some(900), max: Some(1_500), ..Quantiles::default() },
            step_max_ns: 10_000,
        };
        let line = "grid led by line: locked, error p50 120 ns  p99 900 ns  max 1.5 us; largest step 10 us";
        assert_eq!(reference.to_string(), line);
        reference = ReferenceNumbers { locked: false, losses: 1, silent: 10, ..reference };
        reference.error_ns = Quantiles::default();
        assert_eq!(
            reference.to_string(),
            "grid led by line: NOT LOCKED, error p50 -  p99 -  max -; largest step 10 us; not seen in 10 of 1000 \
             cycles; lost 1 time"
        );
    }

    #[test]
    fn a_clock_that_follows_is_one_line() {
        let clock =
            BusClock { error_ns: Some(-1_250), locked: true, error_max_ns: 4_000, window_ns: 320_000 };
        let told = |clock| ClockNumbers::of(clock, false).to_string();
        let line =
            "follows the grid, locked, error -1.25 us, at most 4 us since its lock; its drives bear 320 us";
        assert_eq!(told(clock), line);
        let line = "follows the grid, NOT LOCKED, error not seen, at most 4 us since its lock; its drives bear 320 us";
        assert_eq!(told(BusClock { error_ns: None, locked: false, ..clock }), line);
    }

    #[test]
    fn what_is_not_told_is_a_dash() {
        let text = |value| decimals(told(value), 3);
        assert_eq!([1.0, -0.25, f64::NAN, f64::INFINITY].map(text), ["1.000", "-0.250", "-", "-"]);
    }

    #[test]
    fn a_variable_reads_naturally() {
        let text = |unit, extent| {
            Variable::of(MonitorChannel { name: "demand-velocity".into(), unit }, extent).to_string()
        };
        let extent = |value, min, max| Some(Extent { value, min, max });
        let told = [
            ("mm/s", extent(0.1 + 0.2, -1e-9, 200.0), "0.3 mm/s, from 0 to 200"),
            ("", extent(4294967295.0, -12.5, 4294967295.0), "4294967295, from -12.5 to 4294967295"),
            ("C", None, "not seen yet"),
        ];
        for (unit, extent, expected) in told {
            assert_eq!(text(unit, extent), format!("demand-velocity    {expected}"));
        }
    }
}
