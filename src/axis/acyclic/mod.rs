//! Acyclic access to a drive, common to all protocols: calls, tickets, parameters.
//!
//! | file | what |
//! |---|---|
//! | `mod` | a call, its answer, why it has none |
//! | `port` | the end of whoever carries calls out: the loop, a slice a cycle, or a thread beside it |
//! | `queue` | the application's end: a bounded queue, tickets, series of calls |
//! | `parameter` | typed values at addresses in the drive's own notation |
//!
//! What the numbers of a call mean is the protocol's own; its [`Notation`] turns what people write into calls.

mod parameter;
mod port;
mod queue;

use std::any::Any;
use std::time::Duration;

use thiserror::Error;

pub use parameter::{Access, Notation, NotationError, ParameterError, ParameterTicket, Parameters, Scalar};
pub use port::{Port, Posted};
#[cfg(test)]
pub(crate) use queue::tests::both;
pub use queue::{Acyclic, AcyclicEnds, CallTicket, PostError, queue};

use super::feedback::{Link, State};

/// One call to a drive. What its numbers mean is the protocol's own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "summary", derive(serde::Serialize, serde::Deserialize))]
pub struct Call {
    /// What to do.
    pub service: u32,
    /// With what: a parameter, an entry, a curve.
    pub address: u32,
    /// What the service takes along.
    pub value: u64,
}

/// What a drive answered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "summary", derive(serde::Serialize, serde::Deserialize))]
pub struct Answer {
    /// How it went; 0 = done.
    pub status: u32,
    /// Of what.
    pub address: u32,
    /// What the service gives.
    pub value: u64,
}

/// Why a call was not carried out.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
#[cfg_attr(feature = "summary", derive(serde::Serialize, serde::Deserialize))]
pub enum CallError {
    /// The drive said no, with its own status.
    #[error("the drive refused it with status {0:#04x}")]
    Refused(u32),
    /// The link is not up.
    #[error("the drive is not online: look at its power, cable and address")]
    NotOnline,
    /// No end of it within its time.
    #[error(
        "the drive did not finish it in time, and may have done it: check whether it is busy (flash, another \
         tool), or allow more time"
    )]
    TimedOut,
    /// The drive restarted, or lost what it was in the middle of.
    #[error("the drive restarted meanwhile: begin again")]
    Restarted,
    /// The application did not want it any more. If it had gone out, the drive may have done it.
    #[error("it was cancelled")]
    Cancelled,
    /// A call before it in its series had failed.
    #[error("a call before it in the same series had failed")]
    Skipped,
    /// There was no room for it all the time: it was never sent.
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
    /// Another list or block transfer is under way on this drive, which has one of each.
    #[error("another list or transfer is under way on this drive: wait for its end")]
    Claimed,
    /// The master has ended.
    #[error("the master has ended: start it again")]
    Gone,
    /// The conversation with the master broke off. What was asked last may have been done.
    #[error("the connection to the master was lost: check that it runs, and try again")]
    Lost,
}
crate::errors::debug_as_display!(CallError);

/// What came of a series of calls: the answers up to the first that failed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "summary", derive(serde::Serialize, serde::Deserialize))]
pub struct Series {
    /// In the order of the calls.
    pub answers: Vec<Answer>,
    /// Why it ended before its end.
    pub failed: Option<CallError>,
}

/// How a drive is, as far as those who call it need to know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "summary", derive(serde::Serialize, serde::Deserialize))]
pub struct Condition {
    /// The link is up.
    pub online: bool,
    /// Its power stage may be on.
    pub powered: bool,
    /// It boots, or its motion software is stopped.
    #[cfg_attr(feature = "summary", serde(default))]
    pub not_ready: bool,
}

impl Condition {
    /// Of a drive with this link and state.
    pub fn of(link: Link, state: State) -> Condition {
        Condition {
            online: link == Link::Online,
            powered: state.is_powered(),
            not_ready: state == State::NotReadyToSwitchOn,
        }
    }
}

/// Between two attempts at a call that must not be left undone.
const AGAIN: Duration = Duration::from_millis(200);

/// Whoever carries calls to one drive: the queue of a master in this process, or that of another process through its
/// control socket. Blocking; for normal threads.
pub trait Carrier {
    /// Carries out `calls` one after the other, each within `limit`. The first that fails ends the series: none behind
    /// it is carried out.
    fn run(&self, calls: &[Call], limit: Duration) -> Series;

    /// How the drive is.
    fn condition(&self) -> Result<Condition, CallError>;

    /// Claims what the drive has one of, its lists and block transfers, until the guard is dropped.
    fn claim(&self) -> Result<Box<dyn Any + Send>, CallError>;

    /// The longest series that is carried out without a pause.
    fn capacity(&self) -> usize;

    /// Lets so much time pass.
    fn pause(&self, time: Duration);

    /// From now on `calls` are carried out should whoever holds this go away without a word; none: nothing any more. A
    /// process that is the master itself takes the carrier along when it goes: there is nothing to do then.
    fn bequeath(&self, calls: &[Call]) -> Result<(), CallError> {
        let _ = calls;
        Ok(())
    }

    /// Has a call carried out that must not be left undone, attempt after attempt for `patience`: the drive may be
    /// busy, silent or on its way back. A refusal ends it, and so does that nobody carries calls any more.
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
                CallError::Refused(_) | CallError::Cancelled | CallError::Gone | CallError::Lost
            );
            if is_final || waited >= patience {
                return Err(error);
            }
            self.pause(AGAIN);
            waited += if error == CallError::TimedOut { limit } else { AGAIN };
        }
    }
}
