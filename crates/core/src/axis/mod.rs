//! The application's interface: axes, commands, feedback, events, units.
//!
//! | file | what |
//! |---|---|
//! | `plan` | one axis as configured: units, limits, schedule, health, stop behaviour |
//! | `units` | user units <-> wire counts, with rounding and range checks |
//! | `command` | commands, their ids and how they end |
//! | `feedback` | what a drive reported last, in user units; states of CiA 402 |
//! | `event` | what happened, each event once |
//! | `cell` | the newest value for any number of readers, without a lock |
//! | `newest` | the newest setpoint from the application to the loop |
//! | `doorbell` | which axes have something to be taken by the loop |
//! | `limits` | what is refused on submission |
//! | `streams` | which stream a row belongs to |
//! | `acyclic` | calls outside the cycle: parameters, and other services of a protocol |
//! | `pulse` | the application's sign of life |
//! | `observer` | a reader of the newest feedback |
//! | `handle` | `Axis`: the application's end of one axis, with the blocking calls |
//! | `group` | `Group`: several axes with one queue, synchronised |
//!
//! Nothing here knows a protocol, a socket or the loop.

pub mod acyclic;
pub mod cell;
pub mod command;
pub mod doorbell;
pub mod event;
pub mod feedback;
pub mod group;
pub mod handle;
pub mod limits;
pub mod newest;
pub mod observer;
mod parts;
pub mod plan;
mod pulse;
mod streams;
pub mod units;

pub use acyclic::{
    Acyclic, Answer, Call, CallError, CallTicket, Listed, NotationError, ParameterAccess, ParameterError,
    ParameterTicket, Parameters, PostError, Scalar, Series,
};
pub use command::{
    Abort, Command, CommandId, Failure, GroupCall, Jog, Move, NativeOwner, Outcome, Profile, QueuedCommand,
    Row, Setpoint, StreamRow, Target,
};
pub use event::{Emergency, Event, EventKind};
pub use feedback::{
    BegunBy, DriveStatus, Fault, FaultNames, Feedback, Link, MONITOR_CHANNELS, Shown, SilenceFaults, State,
    StopCause,
};
pub use group::{Group, GroupCommand, GroupError, GroupRefused};
pub use handle::{Axis, AxisEnds, AxisError, Samples};
pub use limits::{Cannot, Lacks};
pub use observer::Observer;
pub use plan::{
    AxisPlan, Faults, FollowingError, FoundRunning, Health, HeldBy, InPosition, Limits, Load, MonitorChannel,
    OwnerLost, PlanFault, StopHow, StopPlan, StopThen, StopTimeout, Underrun, is_plain_name,
};
pub use pulse::Pulse;
pub use units::{RangeError, Unit, Units};
