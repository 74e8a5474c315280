//! Who operates the axes, and for how long: the rules, without a clock and without a socket.
//!
//! Whoever wants metal to move has to show, again and again, that somebody is there and sees what it does:
//!
//! - One operator at a time. Each answer to it carries a new number, the beat, and its next request has to name it. So
//!   a request can only be sent by who has read the answer to the one before: requests that piled up somewhere prove
//!   nothing, and the second of them ends the motion.
//! - An operator from whom nothing comes for [`OPERATOR_LIMIT`] has left.
//! - A jog is named by a number that is never used again, and ends if it is not held for [`HOLD_LIMIT`]. What comes
//!   for it later is refused.
//! - A refused request of the operator stops all axes.
//! - Whoever goes away, for whatever reason, leaves axes that are stopped and, unless their stop sequence holds them,
//!   powered off. Only who says so while nothing is under way leaves them as they are: they stand, and the master goes
//!   on to watch those that have power.
//!
//! Below these rules the loop has its own: the dead-man time of each axis.

use std::collections::VecDeque;

use super::operated::Operated;
use super::request::{Act, CommandEnd, Notice, OperationState, Reply, Request};
use fieldbeat_core::axis::CommandId;
use fieldbeat_core::time::{MS, Time};

/// A jog that was not held for so long ends, ns. A client holds it twice in this time, and once more.
pub const HOLD_LIMIT: u64 = 200 * MS;

/// An operator from whom no request came for so long has left, ns.
pub const OPERATOR_LIMIT: u64 = 1_000 * MS;

/// The most notices that are kept for later requests.
const MOST_NOTICES: usize = 256;

/// Characters of the name of an operator.
const LONGEST_NAME: usize = 64;

/// The axes, and who operates them.
#[derive(Debug)]
pub struct Operation {
    axes: Vec<Operated>,
    operator: Option<Operator>,
    jog: Option<Jog>,
    /// The last beat, of whichever operator.
    beats: u64,
    /// The number of the last jog.
    jogs: u64,
    notices: VecDeque<Notice>,
    /// The number of the last notice.
    noticed: u64,
}

/// Who may command the axes.
#[derive(Debug)]
struct Operator {
    session: u64,
    name: String,
    /// The number that its next request names.
    beat: u64,
    /// When its last request came.
    received: Time,
}

/// A velocity for as long as it is held.
#[derive(Debug)]
struct Jog {
    number: u64,
    axis: usize,
    command: CommandId,
    velocity: f64,
    held: Time,
}

impl Operation {
    /// Of these axes, which nobody operates yet.
    pub fn new(axes: Vec<Operated>) -> Operation {
        let (operator, jog, notices) = (None, None, VecDeque::new());
        Operation { axes, operator, jog, beats: 0, jogs: 0, notices, noticed: 0 }
    }

    /// Whether somebody operates them, or has left something that has not ended.
    pub fn is_active(&self) -> bool {
        self.operator.is_some() || self.axes.iter().any(Operated::is_under_way)
    }

    /// Carries out a request of session `session`, which names this beat. Returns the next beat, and the answer.
    pub fn request(
        &mut self,
        now: Time,
        session: u64,
        beat: u64,
        request: &Request,
    ) -> (u64, Result<Reply, String>) {
        self.look(now);
        let operates = self.operates(session);
        let result = match &mut self.operator {
            Some(operator) if operates && operator.beat != beat => {
                Err("out of turn: a request follows the answer to the one before".to_owned())
            }
            Some(operator) if operates => {
                self.beats += 1;
                (operator.beat, operator.received) = (self.beats, now);
                self.answer(now, session, request)
            }
            _ => self.answer(now, session, request),
        };
        if operates && result.is_err() {
            self.stop();
        }
        (
            self.operator.as_ref().filter(|operator| operator.session == session).map_or(0, |own| own.beat),
            result,
        )
    }

    fn operates(&self, session: u64) -> bool {
        self.operator.as_ref().is_some_and(|operator| operator.session == session)
    }

    fn answer(&mut self, now: Time, session: u64, request: &Request) -> Result<Reply, String> {
        match request {
            Request::Axes => Ok(Reply::Axes(self.axes.iter().map(|axis| axis.facts().clone()).collect())),
            Request::State { since } => Ok(Reply::State(Box::new(self.state(*since)))),
            Request::Take { name } => self.take(now, session, name),
            Request::Stop => {
                self.stop();
                Ok(Reply::Done)
            }
            Request::StopAxis(index) => {
                let stop = self.axis(*index)?.stop();
                self.jog.take_if(|jog| jog.axis == *index);
                Ok(stop.map_or(Reply::Done, |id| Reply::Commanded(id.0)))
            }
            Request::Check(act) => {
                match *act {
                    Act::Command { axis, command } => self.axis(axis)?.check(command),
                    Act::Jog { axis, velocity } => self.axis(axis)?.check_jog(velocity),
                    Act::Hold { .. } | Act::Release { .. } => Ok(()),
                }?;
                Ok(Reply::Done)
            }
            Request::Leave => self.hand_back(session),
            Request::Act(_) if !self.operates(session) => Err(self.not_the_operator()),
            Request::Act(act) => self.act(now, act),
        }
    }

    fn act(&mut self, now: Time, act: &Act) -> Result<Reply, String> {
        match (act, &mut self.jog) {
            (Act::Hold { jog }, Some(running)) if running.number == *jog => {
                running.held = now;
                Ok(Reply::Done)
            }
            (Act::Release { jog }, Some(running)) if running.number == *jog => {
                self.stop();
                Ok(Reply::Done)
            }
            // It ended by itself meanwhile, which is what was wanted.
            (Act::Release { .. }, None) => Ok(Reply::Done),
            (Act::Hold { jog } | Act::Release { jog }, _) => {
                Err(format!("jog {jog} has ended: let go, and begin another one"))
            }
            (Act::Command { .. } | Act::Jog { .. }, Some(running)) => {
                let name = &self.axes[running.axis].facts().name;
                Err(format!("axis {name} jogs: end that first"))
            }
            (Act::Command { axis, command }, None) => {
                Ok(Reply::Commanded(self.axis(*axis)?.command(*command)?.0))
            }
            (Act::Jog { axis, velocity }, None) => {
                let (axis, velocity) = (*axis, *velocity);
                let command = self.axis(axis)?.jog(velocity)?;
                self.jogs += 1;
                self.jog = Some(Jog { number: self.jogs, axis, command, velocity, held: now });
                Ok(Reply::Jogs(self.jogs))
            }
        }
    }

    fn axis(&mut self, index: usize) -> Result<&mut Operated, String> {
        let count = self.axes.len();
        self.axes.get_mut(index).ok_or_else(|| format!("there is no axis {index}: this master has {count}"))
    }

    fn take(&mut self, now: Time, session: u64, name: &str) -> Result<Reply, String> {
        match &self.operator {
            Some(operator) if operator.session != session => {
                return Err(format!("{} operates this master: end that first", operator.name));
            }
            Some(_) => return Ok(Reply::Done),
            None => {}
        }
        if self.axes.iter().any(Operated::is_under_way) {
            return Err("the axes are still being stopped after their last operator: try again".to_owned());
        }
        let name: String = name.chars().filter(|c| !c.is_control()).take(LONGEST_NAME).collect();
        self.notice(None, format!("{name} operates"), None);
        self.beats += 1;
        self.operator = Some(Operator { session, name, beat: self.beats, received: now });
        Ok(Reply::Done)
    }

    /// The operator has ended what it did, and says so.
    fn hand_back(&mut self, session: u64) -> Result<Reply, String> {
        if !self.operates(session) {
            return Err(self.not_the_operator());
        }
        if let Some(axis) = self.axes.iter().find(|axis| axis.is_under_way()) {
            let name = &axis.facts().name;
            return Err(format!("axis {name} has not ended what it does: wait for that, or stop it"));
        }
        self.jog = None;
        if let Some(operator) = self.operator.take() {
            self.notice(None, format!("{} has left: power stays as it is", operator.name), None);
        }
        Ok(Reply::Done)
    }

    fn not_the_operator(&self) -> String {
        match &self.operator {
            Some(operator) => format!("{} operates this master: end that first", operator.name),
            None => "its operator was silent for too long, and has left: start again".to_owned(),
        }
    }

    /// Session `session` has ended.
    pub fn leave(&mut self, session: u64) {
        if self.operates(session) {
            self.retire("has left");
        }
    }

    /// Looks at what happened, ends what is too old, and renews what is held. To be called often.
    pub fn tick(&mut self, now: Time) {
        self.look(now);
        if let Some(Jog { axis, velocity, .. }) = self.jog
            && self.axes[axis].renew(velocity).is_err()
        {
            // The master has ended, and stops it.
            self.jog = None;
        }
    }

    /// The same, but that nothing is renewed.
    fn look(&mut self, now: Time) {
        for index in 0..self.axes.len() {
            while let Some((text, end)) = self.axes[index].next_event() {
                if let (Some(jog), Some(end)) = (&self.jog, &end)
                    && (jog.axis, jog.command.0) == (index, end.command)
                {
                    self.jog = None;
                }
                self.notice(Some(index), text, end);
            }
        }
        if self.operator.as_ref().is_some_and(|operator| now.since(operator.received) > OPERATOR_LIMIT) {
            self.retire("was silent for too long, and has left");
        }
        if let Some(jog) = self.jog.as_ref().filter(|jog| now.since(jog.held) > HOLD_LIMIT) {
            self.notice(Some(jog.axis), "jog not held: it ends".to_owned(), None);
            self.stop();
        }
    }

    fn retire(&mut self, why: &str) {
        self.jog = None;
        self.axes.iter_mut().for_each(Operated::retire);
        if let Some(operator) = self.operator.take() {
            self.notice(None, format!("{} {why}", operator.name), None);
        }
    }

    fn stop(&mut self) {
        self.jog = None;
        for axis in &mut self.axes {
            axis.stop();
        }
    }

    fn notice(&mut self, axis: Option<usize>, text: String, end: Option<CommandEnd>) {
        self.noticed += 1;
        if self.notices.len() == MOST_NOTICES {
            self.notices.pop_front();
        }
        self.notices.push_back(Notice { number: self.noticed, axis, text, end });
    }

    fn state(&self, since: u64) -> OperationState {
        OperationState {
            axes: self.axes.iter().map(Operated::state).collect(),
            operator: self.operator.as_ref().map(|operator| operator.name.clone()),
            jog: self.jog.as_ref().map(|jog| (jog.number, jog.axis)),
            notices: self.notices.iter().filter(|notice| notice.number > since).cloned().collect(),
        }
    }
}
