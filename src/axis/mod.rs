//! What an application holds and speaks: axes, commands, feedback, events, units.
//!
//! | file | what |
//! |---|---|
//! | `plan` | one axis as configured: units, limits, schedule, health, stop behaviour |
//! | `units` | user units <-> wire counts, with rounding and range checks |
//! | `command` | verbs, their ids and how they end |
//! | `feedback` | what a drive last said, in user units; states of CiA 402 |
//! | `event` | what happened, once each |
//! | `cell` | the newest value for any number of readers, without a lock |
//! | `limits` | what is refused at the door |
//! | `streams` | which stream a row belongs to |
//! | `handle` | `Axis`: the application's end of one axis, with the blocking conveniences |
//!
//! Nothing here knows a protocol, a socket or the loop.

pub mod cell;
pub mod command;
pub mod event;
pub mod feedback;
pub mod handle;
pub mod limits;
pub mod plan;
mod streams;
pub mod units;

pub use command::{
    Abort, Command, CommandId, Failure, Jog, Move, NativeOwner, Outcome, Profile, Row, StreamRow, Target,
    Verb,
};
pub use event::{Event, EventKind};
pub use feedback::{Feedback, Link, State, StopCause};
pub use handle::{Axis, AxisEnds, AxisError, Observer};
pub use plan::{AxisPlan, FoundRunning, Health, Limits, StopHow, StopPlan, StopThen, StopTimeout, Underrun};
pub use units::{RangeError, Unit, Units};
