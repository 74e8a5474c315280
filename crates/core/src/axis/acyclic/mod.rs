//! Acyclic access to a drive, common to all protocols: calls, tickets, parameters.
//!
//! | file | what |
//! |---|---|
//! | `mod` | a call, its answer, why it has none |
//! | `port` | the executor's end: the loop, one slice per cycle, or a thread outside the loop |
//! | `queue` | the application's end: a bounded queue, tickets, series of calls |
//! | `notation` | what a protocol adds: how its drives write addresses and values, and lists of their parameters |
//! | `parameter` | typed values at addresses in the drive's own notation |
//! | `integer` | whole numbers of so many bits |
//! | `values` | what is at an address: the calls for it, and what its values are |
//! | `long` | typed calls; values that are longer than the value of a call |
//!
//! The meaning of a call's numbers is the protocol's own; its [`Notation`] turns what people write into calls.

mod integer;
pub mod long;
mod notation;
mod parameter;
mod port;
mod quantity;
mod queue;
mod values;

use std::any::Any;
use std::time::Duration;

use thiserror::Error;

pub use integer::{Integer, decimal, hexadecimal};
#[cfg(test)]
pub(crate) use notation::Numbers;
pub use notation::{
    Access, Block, ListError, Listed, Listing, Notation, NotationError, ParameterAccess, ParameterError,
    Progress, ReadList, Wanted, Watcher, go_on, in_unit,
};
pub use parameter::{ParameterTicket, Parameters, Scalar};
pub use port::{Commanding, Port, Posted};
pub use quantity::{Quantity, Scale, shown};
pub use queue::{Acyclic, AcyclicEnds, CallTicket, queue};
pub use values::{Counts, Place, Rights, Values, Words};

use super::feedback::{Link, State};

/// One call to a drive. The meaning of its numbers is the protocol's own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Call {
    /// The service.
    pub service: u32,
    /// The address: a parameter, an entry, a curve.
    pub address: u32,
    /// The argument.
    pub value: u64,
}

/// The answer of a drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Answer {
    /// The drive's status; 0 = done.
    pub status: u32,
    /// The address that it answers.
    pub address: u32,
    /// The result of the service.
    pub value: u64,
}

/// Why a call was not carried out.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub enum CallError {
    /// The drive refused, with its own status.
    #[error("the drive refused it with status {0:#04x}")]
    Refused(u32),
    /// The link is not up.
    #[error("the drive is not online: `fieldbeat status` and Master::wait_online say why")]
    NotOnline,
    /// It did not end within its time; the drive may have carried it out.
    #[error(
        "the drive did not finish it in time: check whether it is busy (flash, another tool), or allow more time"
    )]
    TimedOut,
    /// The drive restarted, or lost the state of a running call.
    #[error("the drive restarted meanwhile: repeat it")]
    Restarted,
    /// The application cancelled it. If it was already sent, the drive may have carried it out.
    #[error("it was cancelled")]
    Cancelled,
    /// An earlier call of its series had failed.
    #[error("an earlier call of the same series had failed")]
    Skipped,
    /// There was no room for it during its whole time: it was never sent.
    #[error(
        "other calls kept the drive's queue full, so it was never sent: try again, or raise parameter_queue"
    )]
    Full,
    /// The application uses the channel natively.
    #[error("the application uses the drive's parameter channel natively: end that first")]
    Native,
    /// The drive's power stage is on.
    #[error("the drive is switched on: disable it first")]
    Powered,
    /// It may command the drive, whose power is on or coming on. Nothing was sent.
    #[error(
        "it may command the drive, whose power is on or coming on: disable the axis first, or use native mode"
    )]
    Commands,
    /// Of several parameters that are written at once, the one at this place, counted from 0, may command the drive,
    /// whose power is on or coming on. Nothing was sent.
    #[error(
        "parameter {} of them may command the drive, whose power is on or coming on: disable the axis first, or \
         use native mode", .0 + 1
    )]
    CommandsAt(u32),
    /// Another list or block transfer is under way on this drive, which has one of each.
    #[error("another list or transfer is under way on this drive: wait for its end")]
    Claimed,
    /// The master has ended.
    #[error("the master has ended: start it again")]
    Gone,
    /// The loop's cycle does not end.
    #[error(
        "the loop is stuck, its cycle does not end: look at what holds it up, and start the program again"
    )]
    Stuck,
    /// The connection to the master broke. The last request may have been carried out.
    #[error("the connection to the master was lost: check that it runs, and try again")]
    Lost,
}
crate::debug_as_display!(CallError);

/// Why a call was not accepted.
#[derive(Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum PostError {
    /// The queue has no room.
    #[error("axis {axis}: its queue of {capacity} acyclic calls is full: wait for earlier ones to end")]
    Full {
        /// The axis.
        axis: String,
        /// Room of the queue.
        capacity: usize,
    },
    /// The master has ended.
    #[error("axis {axis}: the master has ended: start it again")]
    Gone {
        /// The axis.
        axis: String,
    },
    /// It must not be carried out at present.
    #[error("axis {axis}: {why}")]
    Refused {
        /// The axis.
        axis: String,
        /// The reason.
        why: CallError,
    },
}
crate::debug_as_display!(PostError);

impl From<PostError> for CallError {
    fn from(error: PostError) -> CallError {
        match error {
            PostError::Full { .. } => CallError::Full,
            PostError::Gone { .. } => CallError::Gone,
            PostError::Refused { why, .. } => why,
        }
    }
}

/// The result of a series of calls: the answers up to the first failure.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Series {
    /// In the order of the calls.
    pub answers: Vec<Answer>,
    /// Why the series ended early.
    pub failed: Option<CallError>,
}

/// The state of a drive, as far as callers need to know it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Condition {
    /// The link is up.
    pub online: bool,
    /// The power stage may be on.
    pub powered: bool,
    /// It boots, or its motion software is stopped.
    #[cfg_attr(feature = "serde", serde(default))]
    pub not_ready: bool,
}

impl Condition {
    /// The condition of a drive with this link and state.
    pub fn of(link: Link, state: State) -> Condition {
        Condition {
            online: link == Link::Online,
            powered: state.is_powered(),
            not_ready: state == State::NotReadyToSwitchOn,
        }
    }
}

/// Pause between two attempts at a call that must not be left undone.
const AGAIN: Duration = Duration::from_millis(200);

/// The way for calls to one drive: the queue of a master in this process, or that of another process through its
/// control socket. Blocking; for normal threads.
#[doc(hidden)]
pub trait Carrier {
    /// Carries out `calls` one after the other, each within `limit`. The first that fails ends the series: later
    /// calls are not carried out.
    fn run(&self, calls: &[Call], limit: Duration) -> Series;

    /// The drive's condition.
    fn condition(&self) -> Result<Condition, CallError>;

    /// Claims the drive's lists and block transfers, of which it has one of each, until the guard is dropped.
    fn claim(&self) -> Result<Box<dyn Any + Send>, CallError>;

    /// The longest series that is carried out without a pause.
    fn capacity(&self) -> usize;

    /// Lets so much time pass.
    fn pause(&self, time: Duration);

    /// From now on `calls` are carried out if the holder of this carrier disappears without notice; an empty slice
    /// cancels this. In the master's own process the carrier ends with its holder: there is nothing to do then.
    fn bequeath(&self, calls: &[Call]) -> Result<(), CallError> {
        let _ = calls;
        Ok(())
    }

    /// Carries out a call that must not be left undone, attempt after attempt for `patience`: the drive may be
    /// busy, silent or restarting. A refusal ends it, and so does the end of the master or of its connection.
    fn insist(&self, call: Call, limit: Duration, patience: Duration) -> Result<Answer, CallError> {
        let mut waited = Duration::ZERO;
        loop {
            let Series { answers, failed } = self.run(&[call], limit);
            if let Some(answer) = answers.first() {
                return Ok(*answer);
            }
            let error = failed.unwrap_or(CallError::Gone);
            let is_final = matches!(
                error,
                CallError::Refused(_)
                    | CallError::Cancelled
                    | CallError::Gone
                    | CallError::Stuck
                    | CallError::Lost
            );
            if is_final || waited >= patience {
                return Err(error);
            }
            self.pause(AGAIN);
            waited += if error == CallError::TimedOut { limit } else { AGAIN };
        }
    }
}
