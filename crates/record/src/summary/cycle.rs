//! The cycle, the times of its stages, and how it follows a reference clock.

use std::fmt;

use serde::{Serialize, Serializer};

use super::plural;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::record::Stage;
use fieldbeat_core::cycle::status::ReferenceStatus;
use fieldbeat_core::time::{Ns, three_digits};
use fieldbeat_telemetry::histograms::{Quantiles, Quantity};

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
    pub(super) fn of(plan: &Plan, status: &ReferenceStatus, error: &Quantity) -> ReferenceNumbers {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grid_reference_is_one_line() {
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
            "grid synchronised to bus line: NOT LOCKED, largest step 10 us; its clock was not seen in 10 of \
             1000 cycles; lock lost 1 time"
        );
    }
}
