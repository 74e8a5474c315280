//! What the machine works with: what never changes of its axis, and what it sees of its drive now.

use crate::axis::{AxisPlan, DriveStatus, Failure, Row, State as Cia402};
use crate::bus::Slot;
use crate::bus::desired::{Capabilities, Evidence, Generator, ModeIs, Quantity};
use crate::time::Time;

/// The constants of the machine.
#[derive(Debug)]
pub(super) struct Rules {
    pub can: Capabilities,
    /// The quantity of the setpoints that the master makes; `None`: the drive makes them.
    pub quantity: Option<Quantity>,
    pub axis: AxisPlan,
    pub interval_ns: u64,
}

impl Rules {
    pub fn new(axis: &AxisPlan, can: Capabilities, period_ns: u64) -> Rules {
        let quantity = match can.generator {
            Generator::Master(quantity) => Some(quantity),
            Generator::Drive { .. } => None,
        };
        let interval_ns = period_ns.saturating_mul(axis.divisor.into());
        Rules { can, quantity, axis: axis.clone(), interval_ns }
    }
}

/// The setpoint that the loop has chosen for the command to follow with its next send.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct Input {
    /// Of a jog or a cyclic velocity, user units/s; of a cyclic torque, per cent of the rated torque: above 0 it
    /// accelerates towards higher user positions, whichever way the drive counts.
    pub level: f64,
    /// The row of a stream.
    pub row: Option<NumberedRow>,
}

/// A row and its number: the same number is the same row, not to be run twice.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NumberedRow {
    /// Grows by one a row.
    pub number: u64,
    /// The row.
    pub row: Row,
}

/// The inputs of the machine.
#[derive(Clone, Copy)]
pub(super) struct View<'a> {
    pub rules: &'a Rules,
    /// The slot of the grid: of the next send, or of the one whose answer came.
    pub now: Time,
    pub status: &'a DriveStatus,
    /// It is new.
    pub fresh: bool,
    pub evidence: &'a Evidence,
    pub input: &'a Input,
}

impl<'a> View<'a> {
    pub fn of(rules: &'a Rules, input: &'a Input, now: Time, slot: &'a Slot) -> View<'a> {
        View { rules, now, status: &slot.status, fresh: slot.notices.fresh, evidence: &slot.evidence, input }
    }

    pub fn drive_makes_setpoints(&self) -> bool {
        self.rules.quantity.is_none()
    }

    /// It reports that it is in operation, and what is written counts there.
    pub fn operates(&self) -> bool {
        self.evidence.outputs_count && self.status.state == Cia402::OperationEnabled
    }

    /// Not in the mode of its setpoint; a report that may be an older one does not show that.
    pub fn is_in_another_mode(&self) -> bool {
        self.evidence.mode != ModeIs::Own && !self.status.suspect
    }

    /// How far the actual position is from `target`, and whether that is near enough.
    pub fn off(&self, target: f64) -> (f64, bool) {
        let AxisPlan { units, in_position, .. } = &self.rules.axis;
        let way = self.evidence.position - target;
        // Demand and actual position of an axis that turns without end may begin on the two sides of a wrap-around.
        let distance = if units.modulo.is_some() { units.unwrapped(way) } else { way };
        (distance, in_position.window.is_none_or(|window| distance.abs() <= window))
    }

    pub fn failed(&self) -> Failure {
        Failure::DriveFault(self.status.fault)
    }
}
