//! A run in numbers: the object that `--json` prints, and the same as text.

use std::fmt;

use serde::{Serialize, Serializer};

use super::causes::{Cause, Judged, Tally};
use super::histograms::{Quantiles, Quantity};
use super::monitor::Monitor;
use super::recorder::{Failure, Measured, Run, Written};
use super::table::{Cell, Table};
use crate::axis::{Fault, Link, MonitorChannel, StopCause, Units};
use crate::bus::BusClock;
use crate::bus::{Counters, OwnCounter};
use crate::cycle::Plan;
use crate::cycle::record::Stage;
use crate::cycle::status::{DeviceEnd, Extent, Numbers, ReferenceStatus, Status};
use crate::rt::{Granted, host};
use crate::style::{BAD, paint};
use crate::time::{MS, Ns, S, US, three_digits};

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

/// The whole run. Keys are stable; values are in ns unless the key says otherwise; what is not known is null.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The cycle.
    pub cycle: CycleNumbers,
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
    /// What the black box wrote.
    pub black_boxes: Vec<Written>,
    /// What failed of the program itself.
    pub failures: Vec<Failure>,
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
    /// Slots of the grid.
    pub planned: u64,
    /// Cycles executed.
    pub executed: u64,
    /// Slots skipped.
    pub skipped: u64,
    /// Times that a cycle was too late for the next slot.
    pub overruns: u64,
    /// The reference clock of the grid; null: that of this computer.
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
        let ReferenceNumbers { bus, locked, losses, samples, silent, step_max_ns, .. } = self;
        write!(f, "grid synchronised to bus {bus}: {}", if *locked { "locked" } else { "NOT LOCKED" })?;
        write!(f, ", largest step {}", Ns(three_digits(*step_max_ns)))?;
        if *silent > 0 {
            write!(f, "; its clock was not seen in {silent} of {} cycles", samples + silent)?;
        }
        if *losses > 0 {
            write!(f, "; lock lost {}", plural(*losses, "time"))?;
        }
        Ok(())
    }
}

/// Times of the stages of a cycle, in the order of [`Stage::ALL`]; serialised by their names.
#[derive(Clone, Debug)]
pub struct Stages(pub [Quantiles; 6]);

impl Serialize for Stages {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(Stage::ALL.iter().map(|stage| stage.name()).zip(&self.0))
    }
}

/// Late cycles.
#[derive(Clone, Debug, Serialize)]
pub struct Late {
    /// A cycle is late that began, or spent in a stage, more than this.
    pub threshold_ns: u64,
    /// Cycles that were late; exact.
    pub count: u64,
    /// Their causes, the most frequent first. While the loop runs the newest are not explained yet.
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

/// So many late cycles are listed one by one.
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
            ("host", ..) => f.write_str("the host took the core (hypervisor or firmware)"),
            ("preempted", ..) => f.write_str("preempted or throttled: another thread ran on the core"),
            ("page_fault", ..) => f.write_str("page fault"),
            ("work", _, Some(stage)) => write!(f, "own work or an interrupt in stage {stage}"),
            (_, Some(drive), _) => write!(f, "no reply of drive {drive} by the receive deadline"),
            ("drives", ..) => f.write_str("no reply of several drives by the receive deadline"),
            ("timer", ..) => {
                f.write_str("the timer fired late: idle state, interrupts off, firmware or hypervisor")
            }
            _ => f.write_str("unknown: no evidence"),
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
    /// Actual position at the end, user units; null if the drive reports none, or was never seen.
    pub position: Option<f64>,
    /// The drive's hardware enable (STO) is missing.
    pub inhibited: bool,
    /// Why the axis stands stopped.
    pub stopped: Option<String>,
    /// Fault code, null = none.
    pub fault: Option<u32>,
    /// What its protocol calls that; null if it has no name for it.
    pub fault_name: Option<&'static str>,
    /// Its monitored variables, as planned.
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

/// A monitored variable of a drive: not part of its process data. Its numbers are exact, and null until it was seen.
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
        let of = |number: fn(&Extent) -> f64| extent.as_ref().map(number).and_then(reported);
        let (value, min, max) = (of(|extent| extent.value), of(|extent| extent.min), of(|extent| extent.max));
        Variable { name, unit, value, min, max }
    }
}

impl fmt::Display for Variable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Variable { name, unit, .. } = self;
        let (Some(value), Some(min), Some(max)) = (self.value, self.min, self.max) else {
            return write!(f, "{name:18} not received yet");
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
    /// Datagrams from unknown senders: addresses that are no drive's.
    pub unmatched: u64,
    /// Datagrams that the kernel dropped because the socket's buffer was full.
    pub dropped: u64,
    /// Errors of the receiving socket.
    pub receive_errors: u64,
    /// Its clock and the grid; null: it has no clock.
    pub clock: Option<ClockNumbers>,
}

/// The clock of a bus relative to the grid.
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
    /// The largest distance that its drives tolerate.
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
            Some(ns) => {
                write!(f, "{}{}", if ns < 0 { "-" } else { "" }, Ns(three_digits(ns.unsigned_abs())))?
            }
            None => f.write_str("not known")?,
        }
        write!(
            f,
            ", at most {} since its lock; its drives tolerate {}",
            Ns(three_digits(error_max_ns)),
            Ns(window_ns)
        )
    }
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
    /// Records lost before the histograms; counts and maxima are exact.
    pub telemetry_lost: u64,
    /// Events and samples for which the application's queues had no room.
    pub events_lost: u64,
    /// What the operating system did not grant, one line each, with its remedy.
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
    /// Time that other threads had the core while the loop could have run, ms.
    pub taken_ms: u64,
}

/// A bus that does not come to its end is left as it is.
fn cut_off(status: &Status) -> Option<Failure> {
    let what = "the orderly end of a bus did not complete in 10 s: look at its drives before the next start";
    status.cut_off.then(|| Failure { what: what.into(), fails_run: true })
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
                    state: feedback.status.state.to_string(),
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
                    position: reported(feedback.status.position).filter(|_| feedback.link != Link::Unseen),
                    inhibited: feedback.status.inhibited,
                    stopped: feedback.stopped.map(|cause| cause.to_string()),
                    fault: (feedback.status.fault != 0).then_some(feedback.status.fault),
                    fault_name: fault_names(feedback.status.fault).filter(|_| feedback.status.fault != 0),
                    monitor: (monitored.into_iter().zip(drive.monitor)).filter_map(variable).collect(),
                }
            })
            .collect();
        let leads = |bus: &str| plan.cycle.reference.as_deref() == Some(bus);
        let clocks = numbers.clocks.iter().copied().chain(std::iter::repeat(None));
        let buses = (numbers.buses.iter().zip(clocks))
            .map(|((name, unmatched), clock)| Bus {
                name: name.clone(),
                unmatched: unmatched.datagrams,
                dropped: unmatched.dropped,
                receive_errors: unmatched.errors,
                clock: clock.map(|clock| ClockNumbers::of(clock, leads(name))),
            })
            .collect();
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
            failures: measured.failures.iter().cloned().chain(cut_off(status)).collect(),
            wake_bars: bars(&histograms.wake),
            units: plan.axes().iter().map(|axis| axis.units).collect(),
        }
    }

    /// Whether a drive was lost, the loop came too late, or the program itself failed: a failure however the run was
    /// ended.
    pub fn has_failed(&self) -> bool {
        self.drives.iter().any(|drive| drive.losses > 0 || drive.was_overrun())
            || self.failures.iter().any(|failure| failure.fails_run)
    }

    /// Whether every drive answered, none was lost on the way, none was stopped because the loop came too late, and
    /// the program itself did not fail.
    pub fn is_whole(&self) -> bool {
        !self.has_failed() && self.drives.iter().all(Drive::is_online)
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

    /// Why it was stopped, other than by the end of the run.
    fn stopped_by(&self) -> Option<&String> {
        self.stopped.as_ref().filter(|cause| **cause != StopCause::Shutdown.to_string())
    }

    /// What is wrong with it, a line each.
    fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        if let Some(code) = self.fault {
            notes.push(format!("fault {}", Fault { code, name: self.fault_name }));
        }
        notes.extend(self.stopped_by().map(|cause| format!("stopped: {cause}")));
        if self.inhibited {
            notes.push("hardware enable (STO) missing".to_owned());
        }
        notes.extend(self.not_connected.as_ref().map(|why| format!("not connected: {why}")));
        notes
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

/// A count and its noun, singular or plural.
pub fn plural(count: u64, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// To the finest step of a drive's own variables, without the digits that are only binary, and with one zero only.
pub(super) fn plain(value: f64) -> f64 {
    (value * 1e4).round() / 1e4 + 0.0
}

/// A value that a drive reports; NaN is none.
pub(super) fn reported(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

/// A value with so many decimals; a dash if there is none.
pub(super) fn decimals(value: Option<f64>, decimals: usize) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.decimals$}"))
}

/// A span in us with three significant digits, or a dash.
fn us(ns: Option<u64>) -> String {
    let Some(ns) = ns.map(three_digits) else { return String::from("-") };
    let digits = match ns {
        0 | 100_000.. => 0,
        10_000.. => 1,
        1_000.. => 2,
        _ => 3,
    };
    format!("{:.digits$}", ns as f64 / US as f64)
}

/// As text; the alternate form shows in colour what went wrong. Drives come first: where a terminal has few lines, they
/// are what it shows.
impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let CycleNumbers { period_ns, planned, executed, skipped, overruns, .. } = self.cycle;
        writeln!(
            f,
            "{} of {}: planned {planned} = executed {executed} + skipped {skipped}, {}",
            plural(executed, "cycle"),
            Ns(period_ns),
            plural(overruns, "overrun")
        )?;
        self.drive_table(f)?;
        self.bus_lines(f)?;
        writeln!(f)?;
        self.loop_table(f)?;
        self.late_lines(f)?;
        writeln!(f)?;
        self.realtime_lines(f)
    }
}

impl Summary {
    /// The drives in at most 80 columns, if their names are short. Counts that are 0 for all of them have no column.
    fn drive_table(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        type Count = (&'static str, fn(&Drive) -> u64);
        const RARE: [Count; 4] = [
            ("late", |drive| drive.late),
            ("dupl.", |drive| drive.duplicate),
            ("reject", |drive| drive.rejected),
            ("unsent", |drive| drive.unsent),
        ];
        let seen = RARE.into_iter().filter(|(_, count)| self.drives.iter().any(|drive| count(drive) > 0));
        let seen: Vec<Count> = seen.collect();
        let mut titles = vec!["drive", "state", "sent", "answered", "missed"];
        titles.extend(seen.iter().map(|(title, _)| title));
        titles.extend(["RTT p50", "p99", "max", "position"]);
        let mut table = Table::new(&titles, 2..titles.len(), " ");
        for (drive, units) in self.drives.iter().zip(&self.units) {
            let state = if drive.is_online() { &drive.state } else { &drive.link };
            let is_bad = drive.fault.is_some() || drive.losses > 0 || drive.stopped_by().is_some();
            let mut row = vec![
                Cell::plain(&drive.name),
                Cell::new(state, is_bad),
                Cell::plain(drive.sent),
                Cell::plain(drive.answered),
                Cell::new(drive.missed, drive.missed > 0),
            ];
            row.extend(seen.iter().map(|(_, count)| count(drive)).map(|count| Cell::new(count, count > 0)));
            row.extend([drive.rtt_ns.p50, drive.rtt_ns.p99, drive.rtt_ns.max].map(|ns| Cell::plain(us(ns))));
            let unit = drive.position.map_or(String::new(), |_| format!(" {}", units.unit));
            row.push(Cell::plain(decimals(drive.position, 3) + &unit));
            table.row(row);
        }
        writeln!(f, "\ndrives; round trip times (RTT) in us")?;
        let mut lines = table.lines(f.alternate()).into_iter();
        writeln!(f, "{}", lines.next().unwrap_or_default())?;
        for (line, drive) in lines.zip(&self.drives) {
            writeln!(f, "{line}")?;
            for note in drive.notes() {
                writeln!(f, "  {}", paint(&note, BAD, f.alternate()))?;
            }
        }
        let wide = self.drives.iter().map(|drive| drive.name.len()).max().unwrap_or(0).max(5);
        for drive in self.drives.iter().filter(|drive| drive.protocol_counters.are_any()) {
            writeln!(f, "{:wide$} {}", drive.name, drive.protocol_counters)?;
        }
        for drive in &self.drives {
            for variable in &drive.monitor {
                writeln!(f, "{:wide$} {variable}", drive.name)?;
            }
        }
        Ok(())
    }

    fn bus_lines(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Bus { name, unmatched, dropped, receive_errors, .. } in &self.buses {
            if unmatched + dropped + receive_errors > 0 {
                writeln!(
                    f,
                    "bus {name}: {} from unknown senders, {} dropped by the kernel (receive buffer full), {}",
                    plural(*unmatched, "datagram"),
                    plural(*dropped, "datagram"),
                    plural(*receive_errors, "receive error")
                )?;
            }
        }
        // The clock that leads the grid is with the loop.
        for bus in &self.buses {
            if let Some(clock) = bus.clock.as_ref().filter(|clock| !clock.leads) {
                writeln!(f, "bus {}: its clock {clock}", bus.name)?;
            }
        }
        for DeviceEnd { name, not_operational } in &self.devices {
            match not_operational {
                Some(why) => {
                    let line = format!("device {name}: not in operation: {why}");
                    writeln!(f, "{}", paint(&line, BAD, f.alternate()))?;
                }
                None => writeln!(f, "device {name}: in operation")?,
            }
        }
        Ok(())
    }

    /// Wake-up latency, jitter and stages in one unit.
    fn loop_table(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut table = Table::new(&["loop, times in us", "p50", "p99", "p99.9", "max"], 1..5, "  ");
        let mut quantities =
            vec![("wake-up latency".to_owned(), &self.wake_ns), ("cycle jitter".to_owned(), &self.jitter_ns)];
        quantities.extend(self.cycle.reference.as_ref().map(|led| ("phase error".to_owned(), &led.error_ns)));
        let stages = Stage::ALL.iter().map(|stage| format!("stage {}", stage.name()));
        quantities.extend(stages.zip(&self.stages_ns.0));
        for (name, of) in quantities {
            let mut row = vec![Cell::plain(name)];
            row.extend([of.p50, of.p99, of.p99_9, of.max].map(|ns| Cell::plain(us(ns))));
            table.row(row);
        }
        for line in table.lines(f.alternate()) {
            writeln!(f, "{line}")?;
        }
        if let Some(reference) = &self.cycle.reference {
            writeln!(f, "{reference}")?;
        }
        let most = self.wake_bars.iter().map(|(_, count)| *count).max().unwrap_or(0);
        if most > 0 {
            writeln!(f, "\nwake-up latency in us, cycles (bars: log scale)")?;
        }
        for (end, count) in &self.wake_bars {
            // Logarithmic: the rare late ones are what a reader looks for.
            let width = (40.0 * (*count as f64).ln_1p() / (most as f64).ln_1p()).ceil() as usize;
            let bin = format!("< {}", *end as f64 / US as f64);
            writeln!(f, "{}", format!("  {bin:>9} {count:>9} {}", "#".repeat(width)).trim_end())?;
        }
        Ok(())
    }

    fn late_lines(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let late = &self.late;
        writeln!(f, "\n{} late by more than {}", plural(late.count, "cycle"), Ns(late.threshold_ns))?;
        for found in &late.causes {
            let worst =
                found.worst_ns.map_or(String::new(), |ns| format!(", at most {}", Ns(three_digits(ns))));
            writeln!(f, "  {:>9}  {found}{worst} (cycle {})", found.count, found.worst_cycle)?;
        }
        Ok(())
    }

    fn realtime_lines(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let real = &self.realtime;
        let core = real.core.map_or(String::from("any core"), |core| format!("core {core}"));
        let priority = if real.priority > 0 { format!(" {}", real.priority) } else { String::new() };
        let locked = if real.memory_locked { "memory locked" } else { "memory not locked" };
        let counted = |count: Option<u64>, what| {
            count.map_or_else(|| format!("{what}s not known"), |count| plural(count, what))
        };
        writeln!(
            f,
            "loop: {}{priority} on {core}, {locked}; {}, {}; {} and {} lost",
            real.policy,
            counted(real.page_faults, "page fault"),
            counted(real.involuntary_switches, "preemption"),
            plural(real.telemetry_lost, "telemetry record"),
            plural(real.events_lost, "event")
        )?;
        let host = &self.host;
        let [kernel, preemption, cpu] =
            [&host.kernel, &host.preemption, &host.cpu].map(|fact| fact.as_deref().unwrap_or("?"));
        let steal = host.steal_ms.map_or(String::from("?"), |steal| steal.to_string());
        write!(f, "host: {kernel}, {preemption}, {cpu}; steal {steal} ms; ")?;
        writeln!(f, "other threads had the loop's core for {} ms", host.taken_ms)?;
        for written in &self.black_boxes {
            writeln!(f, "{written}")?;
        }
        for failure in &self.failures {
            writeln!(f, "{}", paint(&failure.what, BAD, f.alternate()))?;
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
    fn own_counters_above_zero_are_printed_and_all_are_in_the_object() {
        let own = ["exceptions", "opened", "closed"].map(|key| OwnCounter { key, what: key });
        let mut counters = Counters::default();
        (counters.own[0], counters.own[2]) = (3, u64::MAX);
        let shown = ProtocolCounters::of(&own, &counters);
        assert_eq!(shown.to_string(), format!("exceptions: 3; closed: {}", u64::MAX));
        let json = format!(r#"{{"exceptions":3,"opened":0,"closed":{}}}"#, u64::MAX);
        assert_eq!(serde_json::to_string(&shown).unwrap(), json);
        let none = ProtocolCounters::of(&[], &counters);
        assert_eq!((none.are_any(), serde_json::to_string(&none).unwrap()), (false, "{}".to_owned()));
    }

    #[test]
    fn the_drives_come_first_and_fit_80_columns() {
        let mut summary = crate::telemetry::plots::tests::run("axis-1", 2_000).summary();
        let drive = summary.drives[0].clone();
        let (state, sent) = (String::from("OperationEnabled"), 9_999_999);
        let usual = Drive {
            link: Link::Online.to_string(),
            state,
            sent,
            answered: sent,
            position: Some(-1234.5),
            ..drive.clone()
        };
        let lost = Drive { missed: 1, losses: 1, link: Link::Lost.to_string(), position: None, ..drive };
        let fault = Drive { fault: Some(5), ..usual.clone() };
        summary.units = vec![summary.units[0]; 3];
        summary.drives = vec![usual, lost, fault];
        let text = summary.to_string();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "2000 cycles of 1 ms: planned 2000 = executed 2000 + skipped 0, 0 overruns");
        let titles: Vec<&str> = lines[3].split_whitespace().collect();
        let expected = "drive state sent answered missed RTT p50 p99 max position";
        assert_eq!(titles.join(" "), expected, "{text}");
        assert!(lines[4].starts_with("axis-1 OperationEnabled 9999999  9999999      0 "), "{text}");
        assert!(lines[4].ends_with(" -1234.500 mm") && lines[5].ends_with(" -"), "{text}");
        assert_eq!(lines[7], "  fault 0x0005 (5)");
        assert!(lines[..20].iter().all(|line| line.chars().count() <= 80), "{text}");
        // A count that is 0 for all of them has no column.
        assert!(!text.contains("dupl."), "{text}");
        summary.drives[0].duplicate = 1;
        assert!(summary.to_string().contains(" missed dupl. RTT p50 "), "{summary}");
        // Colours in the alternate form only.
        assert!(!text.contains('\x1b'), "{text:?}");
        let styled = format!("{summary:#}");
        assert!(styled.contains("\x1b[31mlost\x1b[0m"), "{styled}");
        assert!(styled.contains("  \x1b[1m\x1b[31mfault 0x0005 (5)\x1b[0m\n"), "{styled:?}");
    }

    #[test]
    fn times_have_one_unit_and_three_digits() {
        let ns = [0, 51, 847, 1_000, 9_996, 28_911, 99_950, 129_419, 12_345_678];
        let expected = ["0", "0.051", "0.847", "1.00", "10.0", "28.9", "100", "129", "12300"];
        assert_eq!(ns.map(|ns| us(Some(ns))), expected);
        assert_eq!(
            (us(None), plural(1, "cycle"), plural(0, "cycle")),
            ("-".into(), "1 cycle".into(), "0 cycles".into())
        );
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
        assert_eq!(reference.to_string(), "grid synchronised to bus line: locked, largest step 10 us");
        reference = ReferenceNumbers { locked: false, losses: 1, silent: 10, ..reference };
        assert_eq!(
            reference.to_string(),
            "grid synchronised to bus line: NOT LOCKED, largest step 10 us; its clock was not seen in 10 of 1000 \
             cycles; lock lost 1 time"
        );
    }

    #[test]
    fn a_clock_that_follows_is_one_line() {
        let clock =
            BusClock { error_ns: Some(-1_250), locked: true, error_max_ns: 4_000, window_ns: 320_000 };
        let line_of = |clock| ClockNumbers::of(clock, false).to_string();
        let line = "follows the grid, locked, error -1.25 us, at most 4 us since its lock; its drives tolerate 320 us";
        assert_eq!(line_of(clock), line);
        let line = "follows the grid, NOT LOCKED, error not known, at most 4 us since its lock; its drives tolerate \
                    320 us";
        assert_eq!(line_of(BusClock { error_ns: None, locked: false, ..clock }), line);
    }

    #[test]
    fn an_unknown_value_is_a_dash() {
        let text = |value| decimals(reported(value), 3);
        assert_eq!([1.0, -0.25, f64::NAN, f64::INFINITY].map(text), ["1.000", "-0.250", "-", "-"]);
    }

    #[test]
    fn a_variable_reads_naturally() {
        let text = |unit, extent| {
            Variable::of(MonitorChannel { name: "demand-velocity".into(), unit }, extent).to_string()
        };
        let extent = |value, min, max| Some(Extent { value, min, max });
        let shown = [
            ("mm/s", extent(0.1 + 0.2, -1e-9, 200.0), "0.3 mm/s, from 0 to 200"),
            ("", extent(4294967295.0, -12.5, 4294967295.0), "4294967295, from -12.5 to 4294967295"),
            ("C", None, "not received yet"),
        ];
        for (unit, extent, expected) in shown {
            assert_eq!(text(unit, extent), format!("demand-velocity    {expected}"));
        }
    }
}
