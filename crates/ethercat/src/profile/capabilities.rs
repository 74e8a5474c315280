//! What a drive can do, by its plan.

use super::{SETTLED, reports_position};
use crate::object::number::CONTROL_WORD;
use crate::plan::{KollmorgenDrive, Setpoint};
use fieldbeat_core::axis::Lacks;
use fieldbeat_core::bus::desired::{Capabilities, Generator, Quantity};

const NO_CONTROL: &str = "its outputs have no control word: map 6040h";
const BLIND: &str = "its setpoint is a position, and its inputs have none: map 6064h or 6063h";
const NO_POSITION: &str = "its setpoint is no position: take outputs with one (PDO 1701h), or jog";
const NO_VELOCITY: &str =
    "its setpoint is neither a position nor a velocity: take outputs with one (PDO 1702h)";
const NO_TORQUE: &str = "its setpoint is no torque: take outputs with one (PDO 1703h)";
const NOT_WATCHED: &str = "its SyncManager watchdog is not set, nothing may stop it if the master dies: set \
     watchdog, or no_drive_watchdog = \"accept\"";

/// The setpoint of a frame is reached at the end of the exchange that begins with it; the position in the frame was
/// taken before that, at the last synchronisation.
const BEHIND: u64 = 2;

/// The setpoint's quantity, and the raw setpoint of one user unit/s, or of one per cent of the rated torque.
pub(super) fn quantity(drive: &KollmorgenDrive) -> (Quantity, f64) {
    let axis = &drive.axis;
    let turns = axis.units.counts_per_unit / drive.scaling.increments();
    match drive.setpoint() {
        Some(Setpoint::Position(_)) => (Quantity::Position, axis.units.counts_per_unit),
        Some(Setpoint::Velocity(_)) => (Quantity::Velocity, turns * 60.0 / drive.scaling.rpm_per_count),
        Some(Setpoint::Torque(_)) => {
            let permille = 10.0_f64.copysign(axis.units.counts_per_unit);
            (Quantity::Torque, permille / drive.scaling.permille_per_count)
        }
        None => (Quantity::Unknown, 0.0),
    }
}

/// The capabilities of a drive.
pub fn capabilities(drive: &KollmorgenDrive, period_ns: u64) -> Capabilities {
    let (quantity, _) = quantity(drive);
    let is_controlled = drive.outputs.entries.iter().any(|entry| entry.object == CONTROL_WORD);
    let is_blind = quantity == Quantity::Position && !reports_position(drive);
    // A position is held, even if the master dies.
    let unwatched =
        quantity != Quantity::Position && !drive.accept_no_watchdog && drive.slave.watchdog.ns().is_none();
    let positions = (quantity != Quantity::Position).then_some(NO_POSITION);
    let unwatched = unwatched.then_some(NOT_WATCHED);
    let speeds = matches!(quantity, Quantity::Torque | Quantity::Unknown).then_some(NO_VELOCITY);
    let torques = (quantity != Quantity::Torque).then_some(NO_TORQUE);
    Capabilities {
        lacks: Lacks {
            control: (!is_controlled).then_some(NO_CONTROL),
            enable: is_blind.then_some(BLIND),
            moves: positions,
            rows: positions,
            velocities: speeds.or(unwatched),
            torques: torques.or(unwatched),
            homing: None,
        },
        switches_on_at_once: false,
        // Inputs count by the index and the working counter of the frame that has just gone out.
        power_reports: 1,
        still_reports: SETTLED,
        behind_ns: period_ns.saturating_mul(u64::from(drive.axis.divisor)).saturating_mul(BEHIND),
        ..Capabilities::of(Generator::Master(quantity))
    }
}
