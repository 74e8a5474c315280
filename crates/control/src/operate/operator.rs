//! The client's side: operates the axes of a master in another process, or of one in this process.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Deserialize;
use serde_json::json;
use thiserror::Error;

use super::request::{Act, AxisFacts, OperationState, Order, Reply, Request};
use super::station::{Envelope, OperatorSession, Return, Station};
use crate::client::{AskError, Conversation};

/// A master answers sooner, or counts its operator as gone.
const PATIENCE: Duration = Duration::from_secs(2);

/// How often a jog has to be held, at least: three times in [`HOLD_LIMIT`](super::HOLD_LIMIT).
pub const HOLD_EVERY: Duration = Duration::from_millis(60);

/// Why an operator does not get what it requested. The message ends with the remedy.
#[derive(Error)]
pub enum OperateError {
    /// The master refuses it.
    #[error("{0}")]
    Refused(String),
    /// The master has ended.
    #[error("the master has ended: its axes are stopped as its end has left them; start it again")]
    Gone,
    /// No connection, or it broke.
    #[error(transparent)]
    Ask(#[from] AskError),
}
fieldbeat_core::debug_as_display!(OperateError);

/// Operates the axes of a master. When it is dropped, they are stopped and powered off, unless it has
/// [left](Operator::leave) before.
#[derive(Debug)]
pub struct Operator {
    way: Way,
    beat: u64,
}

#[derive(Debug)]
enum Way {
    Remote { conversation: Conversation, path: PathBuf },
    Local(OperatorSession),
}

impl Operator {
    /// A client of the master that answers at `path`. It operates nothing before [`take`](Operator::take).
    pub fn remote(path: &Path) -> Result<Operator, AskError> {
        let conversation = Conversation::open(path)?;
        Ok(Operator { way: Way::Remote { conversation, path: path.to_owned() }, beat: 0 })
    }

    /// A client of a master in this process.
    pub fn local(station: &Station) -> Operator {
        Operator { way: Way::Local(station.session()), beat: 0 }
    }

    /// Becomes the operator, the only one, under this name.
    pub fn take(&mut self, name: &str) -> Result<(), OperateError> {
        self.ask(Request::Take { name: name.to_owned() }).map(drop)
    }

    /// The facts of the axes.
    pub fn axes(&mut self) -> Result<Vec<AxisFacts>, OperateError> {
        match self.ask(Request::Axes)? {
            Reply::Axes(axes) => Ok(axes),
            _ => Err(self.foreign()),
        }
    }

    /// How the axes are, and the notices after number `since`.
    pub fn state(&mut self, since: u64) -> Result<OperationState, OperateError> {
        match self.ask(Request::State { since })? {
            Reply::State(state) => Ok(*state),
            _ => Err(self.foreign()),
        }
    }

    /// Gives axis `axis` a command; returns its id, whose end is a notice.
    pub fn command(&mut self, axis: usize, command: Order) -> Result<u64, OperateError> {
        match self.ask(Request::Act(Act::Command { axis, command }))? {
            Reply::Commanded(id) => Ok(id),
            _ => Err(self.foreign()),
        }
    }

    /// Begins to jog axis `axis`; returns the number of the jog, which has to be held every [`HOLD_EVERY`].
    pub fn jog(&mut self, axis: usize, velocity: f64) -> Result<u64, OperateError> {
        match self.ask(Request::Act(Act::Jog { axis, velocity }))? {
            Reply::Jogs(number) => Ok(number),
            _ => Err(self.foreign()),
        }
    }

    /// Goes on with a jog. Refused if it has ended.
    pub fn hold(&mut self, jog: u64) -> Result<(), OperateError> {
        self.ask(Request::Act(Act::Hold { jog })).map(drop)
    }

    /// Ends a jog: its axis ramps down and stays enabled.
    pub fn release(&mut self, jog: u64) -> Result<(), OperateError> {
        self.ask(Request::Act(Act::Release { jog })).map(drop)
    }

    /// Stops all axes, whoever operates them. They stay enabled.
    pub fn stop(&mut self) -> Result<(), OperateError> {
        self.ask(Request::Stop).map(drop)
    }

    /// Stops axis `axis`, whoever operates it. It stays enabled. Returns the id of the stop, whose end is a notice;
    /// `None`: there is nothing to stop.
    pub fn stop_axis(&mut self, axis: usize) -> Result<Option<u64>, OperateError> {
        match self.ask(Request::StopAxis(axis))? {
            Reply::Commanded(id) => Ok(Some(id)),
            Reply::Done => Ok(None),
            _ => Err(self.foreign()),
        }
    }

    /// Whether an axis does that, and within its limits, whatever state it is in.
    pub fn check(&mut self, act: Act) -> Result<(), OperateError> {
        self.ask(Request::Check(act)).map(drop)
    }

    /// Operates no more, and leaves the axes as they are. Refused while anything is under way.
    pub fn leave(&mut self) -> Result<(), OperateError> {
        self.ask(Request::Leave).map(drop)
    }

    /// The answer to any request.
    pub fn ask(&mut self, request: Request) -> Result<Reply, OperateError> {
        let Return { beat, reply } = match &self.way {
            Way::Local(session) => {
                let (beat, reply) = session.request(self.beat, &request);
                Return { beat, reply }
            }
            Way::Remote { conversation, path } => {
                let question = json!(Envelope { ask: "operate".to_owned(), beat: self.beat, request });
                let answer = conversation.ask(&question, PATIENCE).map_err(|error| why(path, error))?;
                Return::deserialize(&answer).map_err(|_| AskError::Foreign(path.clone()))?
            }
        };
        self.beat = beat;
        reply.map_err(OperateError::Refused)
    }

    fn foreign(&self) -> OperateError {
        match &self.way {
            Way::Remote { path, .. } => AskError::Foreign(path.clone()).into(),
            Way::Local(_) => OperateError::Gone,
        }
    }
}

/// A master that ends breaks its conversations off first.
fn why(path: &Path, error: AskError) -> OperateError {
    match (&error, Conversation::open(path)) {
        (AskError::Refused(_), _) => error.into(),
        (_, Err(AskError::Nobody(_) | AskError::Dead(_))) => OperateError::Gone,
        _ => error.into(),
    }
}
