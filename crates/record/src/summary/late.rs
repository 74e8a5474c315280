//! Late cycles and their causes.

use std::fmt;

use serde::Serialize;

use fieldbeat_core::cycle::Plan;
use fieldbeat_telemetry::causes::{Cause, Judged, Tally};

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
    /// The findings of a tally.
    #[doc(hidden)]
    pub fn of(tally: &Tally, plan: &Plan) -> Found {
        let Tally { cause, count, worst_ns, worst_cycle } = *tally;
        let (cause, stage, drive) = named(cause, in_plan(plan));
        let worst_ns = (worst_ns > 0).then_some(worst_ns);
        Found { cause, stage, drive, count, worst_ns, worst_cycle }
    }
}

impl LateCycle {
    pub(super) fn of(judged: &Judged, plan: &Plan) -> LateCycle {
        let (cause, stage, drive) = named(judged.cause, in_plan(plan));
        let delay_ns = Some(judged.lateness.ns()).filter(|ns| *ns > 0);
        LateCycle { cycle: judged.index, delay_ns, cause, stage, drive }
    }
}

fn in_plan(plan: &Plan) -> impl Fn(usize) -> Option<String> {
    |axis| plan.axes().get(axis).map(|axis| axis.name.clone())
}

/// The words of the `--json` object for `cause`, and the stage or drive that it names; `axis` names the drives.
pub fn named(
    cause: Cause,
    axis: impl Fn(usize) -> Option<String>,
) -> (&'static str, Option<&'static str>, Option<String>) {
    match cause {
        Cause::Host => ("host", None, None),
        Cause::Preempted => ("preempted", None, None),
        Cause::PageFault => ("page_fault", None, None),
        Cause::Work(stage) => ("work", Some(stage.name()), None),
        Cause::Drive(index) => ("drive", None, axis(index.into())),
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
