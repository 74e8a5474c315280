//! One drive, its own counters and its monitored variables.

use std::fmt;

use serde::Serialize;

use super::ProtocolCounters;
use super::numbers::{plain, reported};
use fieldbeat_core::axis::{Fault, Link, MonitorChannel, StopCause};
use fieldbeat_core::cycle::status::{AtEnd, Extent};
use fieldbeat_telemetry::histograms::Quantiles;

/// One drive.
#[derive(Clone, Debug, Serialize)]
pub struct Drive {
    /// The name.
    pub name: String,
    /// The protocol.
    pub protocol: &'static str,
    /// Link at the end.
    pub link: String,
    /// Why it was not online at the end, and what to do; null: it was, or nothing was known yet.
    pub not_connected: Option<String>,
    /// The same, and also of a drive that was lost and came back: why it was.
    pub diagnosis: Option<String>,
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
    /// Reports that were not taken: of a place that the axis cannot have reached, or of a loss that was not confirmed.
    pub implausible: u64,
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
    /// The counts that only its protocol has, by their keys; empty if it has none.
    pub protocol_counters: ProtocolCounters,
    /// Actual position at the end, user units; null if the drive reports none, or was never seen.
    pub position: Option<f64>,
    /// The drive's hardware enable (STO) is missing.
    pub sto_open: bool,
    /// Why the axis stands stopped.
    pub stopped: Option<String>,
    /// Which axis began that stop, and why, if this one was stopped with its stop group.
    pub begun_by: Option<BegunBy>,
    /// Fault code, null = none.
    pub fault: Option<u32>,
    /// The protocol's name of that; null if it has none.
    pub fault_name: Option<&'static str>,
    /// Why it stands stopped is no failure: it was found running, or a drive of its stop group was.
    #[serde(skip)]
    pub(super) found_running: bool,
    /// The monitored variables, as planned.
    pub monitor: Vec<Variable>,
    /// How it was left at the end; null while the run goes on, and of a drive that has never reported its state and of
    /// which nothing was requested.
    pub at_end: Option<AtEnd>,
    /// That in words; nothing of a drive that is off.
    #[serde(skip)]
    pub(super) left: Option<String>,
}

/// The axis that began the stop of a stop group.
#[derive(Clone, Debug, Serialize)]
pub struct BegunBy {
    /// The name.
    pub axis: String,
    /// Why it was stopped.
    pub cause: String,
}

/// A monitored variable of a drive: not part of its process data. Its numbers are exact, and null until it was seen.
#[derive(Clone, Debug, Serialize)]
pub struct Variable {
    /// The name.
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
    pub(super) fn of(MonitorChannel { name, unit }: MonitorChannel, extent: Option<Extent>) -> Variable {
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

impl Drive {
    /// Whether the link was up at the end.
    pub fn is_online(&self) -> bool {
        self.link == Link::Online.to_string()
    }

    /// Why it was stopped, other than by the end of the run, with the axis that began it.
    pub fn stopped_by(&self) -> Option<String> {
        let cause = self.stopped.as_ref().filter(|cause| **cause != StopCause::Shutdown.to_string())?;
        Some(match &self.begun_by {
            Some(BegunBy { axis, cause: of }) => format!("{cause}, begun by {axis}: {of}"),
            None => cause.clone(),
        })
    }

    /// That it stays powered as planned, in words.
    pub fn held(&self) -> Option<&str> {
        self.left.as_deref().filter(|_| self.at_end.as_ref().is_some_and(AtEnd::is_safe))
    }

    /// How it was left, what was tried and what to do, if it is not known to be off, nor held as planned.
    pub fn left_on(&self) -> Option<String> {
        let left = self.left.as_ref().filter(|_| self.held().is_none())?;
        Some(format!("drive {} {left}", self.name))
    }

    /// The mistakes of the drive, a line each.
    pub(super) fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        if let Some(code) = self.fault {
            notes.push(format!("fault {}", Fault { code, name: self.fault_name }));
        }
        notes.extend(self.stopped_by().map(|cause| format!("stopped: {cause}")));
        if self.sto_open {
            notes.push("hardware enable (STO) missing".to_owned());
        }
        notes.extend(self.held().map(str::to_owned));
        notes.extend(match (&self.not_connected, &self.diagnosis) {
            (Some(why), _) => Some(format!("not connected: {why}")),
            (None, why) => why.as_ref().map(|why| format!("was lost: {why}")),
        });
        notes
    }

    /// Why the master had stopped it, and nobody had reset it, when the run ended: `None` also if it was only found
    /// running, which its configuration allows, or stopped with its stop group by that.
    pub fn failed_by(&self) -> Option<String> {
        self.stopped_by().filter(|_| !self.found_running)
    }

    /// Whether the axis was stopped by an overrun of the loop.
    pub fn was_overrun(&self) -> bool {
        self.was_stopped_by(&[StopCause::Overrun])
    }

    /// Whether the axis was stopped because the application fed it too late.
    pub fn was_starved(&self) -> bool {
        self.was_stopped_by(&[
            StopCause::Underrun,
            StopCause::StaleSetpoint,
            StopCause::DeadMan,
            StopCause::Heartbeat,
        ])
    }

    fn was_stopped_by(&self, causes: &[StopCause]) -> bool {
        self.stopped.as_ref().is_some_and(|stopped| causes.iter().any(|cause| cause.to_string() == *stopped))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
