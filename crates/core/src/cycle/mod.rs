//! The loop: one thread, one absolute time grid, all buses.
//!
//! | file | what |
//! |---|---|
//! | `plan` | the machine as configured |
//! | `engine` | one cycle after the other: send, receive, evaluate, commands, prepare, publish |
//! | `grid` | slots and their instants |
//! | `skips` | the share of the slots that were skipped |
//! | `bound` | from the loss of a drive to its stop request |
//! | `cost` | what the cycles of a plan cost on a host |
//! | `window` | waiting for replies until the deadline |
//! | `reference`, `phase_lock` | a bus clock that leads the grid |
//! | `heartbeat` | watches the application's sign of life |
//! | `watch` | whether the loop's cycle ends |
//! | `task` | the application's code inside the cycle |
//! | `status`, `record` | what the loop counts, and its records for the telemetry |
//! | `ring`, `stored` | the memory of these records, which outlives the process, and how it is read then |
//!
//! The loop knows the [`Bus`](crate::bus::Bus) contract and the drive machine ([`drive`](crate::drive)); no protocol,
//! and no motion.

/// The revision of the loop: another number where it sends something else for the same inputs, or looks for others.
/// A recording with the wire holds it. Whoever raises it makes the records of the repository anew, in a commit of its
/// own, after both programs were compared on the same inputs.
pub const REVISION: u32 = 5;

pub mod bound;
pub mod cost;
pub mod engine;
mod grid;
mod heartbeat;
mod phase_lock;
pub mod plan;
pub mod record;
mod reference;
pub mod ring;
pub mod skips;
pub mod status;
pub mod stored;
pub mod task;
pub mod watch;
pub mod window;

pub use plan::{
    CyclePlan, GroupPlan, Guard, OnCost, Overrun, Plan, PlanErrors, Shares, Wait, WatchAfter, starvation,
};
