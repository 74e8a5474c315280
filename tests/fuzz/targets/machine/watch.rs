//! The rules of one axis, whatever its drive reports and whatever the application commands.
//!
//! It sees what anybody could see: requests on the wire, datagrams that came, events, feedback. It keeps no books of
//! how the loop works.

use std::collections::{BTreeMap, BTreeSet};

use fieldbeat::axis::{
    Abort, Command, Event, EventKind, Feedback, FoundRunning, NativeOwner, Outcome, StopCause,
};
use fieldbeat::bus::linudp::{ControlWord, LinUdpDrive, MotionBlock, ReplyTag, StatusWord, StreamCommand};
use fieldbeat::telemetry::DriveEnd;
use fieldbeat::time::Time;
use fieldbeat_linudp::motion::CommandInfo;
use fieldbeat_linudp::wire::{Request, Response, RtcBlock};

use super::hostile::{Came, Requested};

#[derive(Debug)]
pub struct Watch {
    drive: LinUdpDrive,
    /// Commands that were accepted and have not ended.
    alive: BTreeMap<u64, Command>,
    pub accepted: u64,
    pub ended: u64,
    /// Stopped, and not reset since.
    latched: Option<StopCause>,
    /// So many cycles had been executed when it was stopped last, and when it was reset last.
    stopped_at: u64,
    reset_at: u64,
    /// Enabled, and neither stopped nor disabled since.
    armed: bool,
    /// The last requests that went out, the newest one last: as many as may be answered, before it or with it.
    requested: Vec<(Time, Request)>,
    /// The last control word that went out.
    word: Option<ControlWord>,
    /// The control word may be the application's own.
    wild: bool,
    /// The end of the master has overtaken the reset of a fault, which it lets the drive go through.
    acknowledging: bool,
    /// Before this step.
    feedback: Feedback,
    /// The reply that the feedback is from.
    reply: Option<Response>,
    /// The codes of errors that came from its address.
    errors: BTreeSet<u32>,
    /// Its position has jumped, and it has not homed since.
    unreferenced: bool,
    event: Option<Event>,
    sent: u64,
    datagrams: u64,
    /// Events were lost: their contents are not known.
    deaf: bool,
}

impl Watch {
    pub fn new(drive: LinUdpDrive) -> Watch {
        Watch {
            drive,
            alive: BTreeMap::new(),
            accepted: 0,
            ended: 0,
            latched: None,
            stopped_at: 0,
            reset_at: 0,
            armed: false,
            requested: Vec::new(),
            word: None,
            wild: false,
            acknowledging: false,
            feedback: Feedback::default(),
            reply: None,
            errors: BTreeSet::new(),
            unreferenced: false,
            event: None,
            sent: 0,
            datagrams: 0,
            deaf: false,
        }
    }

    pub fn accepted(&mut self, id: u64, command: Command) {
        assert_eq!(self.alive.insert(id, command), None, "the id {id} was given twice");
        self.accepted += 1;
    }

    pub fn lost_events(&mut self) {
        self.deaf = true;
    }

    fn runs(&self, chosen: impl Fn(&Command) -> bool) -> bool {
        self.alive.values().any(chosen)
    }

    /// A request went out. It was built from what was known before this step.
    pub fn requested(&mut self, requested: &Requested) {
        self.sent += 1;
        let request = Request::parse(&requested.bytes).expect("what the master sends is a request");
        let said = self.word;
        self.requested.push((requested.at, request));
        if self.requested.len() > self.within() + 1 {
            self.requested.remove(0);
        }
        self.word = request.control.or(said);
        let on = |word: Option<ControlWord>| word.is_some_and(|word| word.has(ControlWord::SWITCH_ON));
        if self.deaf {
            return;
        }
        let native = self.runs(|command| matches!(command, Command::Native(_)));
        self.wild |= self.runs(|command| *command == Command::Native(NativeOwner::Application));
        if on(self.word) && !on(said) && !self.wild {
            self.check_switch_on(requested.at, said);
        }
        let only_read = self.accepted == 0 && self.drive.axis.on_found_running == FoundRunning::Refuse;
        assert!(!only_read || request.control.is_none(), "nothing was requested: {request:?}");
        if let Some(word) = request.control {
            self.check_control(word, native);
        }
        if let Some(motion) = &request.motion {
            self.check_motion(motion, native);
        }
    }

    /// Only an Enable switches a drive on. One that never got a request may be left on as it was found.
    fn check_switch_on(&self, at: Time, said: Option<ControlWord>) {
        let status = self.reply.and_then(|reply| reply.status).unwrap_or_default();
        let as_found = said.is_none() && status.has(StatusWord::SWITCH_ON_ACTIVE);
        // An Enable of a drive that says that it is in operation is done before the next request.
        let enabling =
            self.armed || self.latched.is_none() && self.runs(|command| *command == Command::Enable);
        let (latched, feedback) = (self.latched, &self.feedback);
        assert!(
            enabling || as_found,
            "switched on at {at} without an Enable: stopped {latched:?}, {feedback:?}"
        );
    }

    fn check_control(&mut self, word: ControlWord, native: bool) {
        use ControlWord as C;
        let abort = |word: C| C(word.0 & !C::NO_ABORT);
        // Powered, and kept out of operation.
        let held = C(C::ON.0 & !C::ENABLE_OPERATION);
        let usual = [C::BASE, C::ON, C::HOME, C::ACKNOWLEDGE, abort(C::ON), abort(C::BASE), held];
        if !usual.contains(&word) {
            assert!(self.wild, "a master does not write {word:?}");
            return;
        }
        self.wild &= native;
        if !self.wild {
            let homes = self.latched.is_none() && self.runs(|command| *command == Command::Home);
            assert!(homes || word != C::HOME, "homing without a request: {:?}", self.alive);
            let resets = self.acknowledging || self.runs(|command| *command == Command::ResetFault);
            assert!(resets || word != C::ACKNOWLEDGE, "an acknowledge without a request: {:?}", self.alive);
        }
    }

    fn check_motion(&self, block: &MotionBlock, native: bool) {
        let id = block.header >> 4;
        let values = CommandInfo::of(id).map_or([0; 5], |info| info.values(&block.parameters));
        match (id, values) {
            (0x000, _) => return,
            (0x017, [deceleration, ..]) if deceleration > 0 => return,
            _ => assert_eq!(self.latched, None, "{block:?} to a stopped axis"),
        }
        if native {
            return;
        }
        assert!(self.armed, "{block:?} to an axis that is not enabled");
        let position = self.drive.axis.units.position(values[0]);
        let check_inside = || {
            if let Some((low, high)) = self.drive.axis.limits.position {
                // Rounded to a count.
                assert!(
                    (low - 1e-4..=high + 1e-4).contains(&position),
                    "{position} is not in {low} ... {high}"
                );
            }
        };
        let follows = self.runs(|command| *command == Command::Follow);
        match id {
            0x010 => {
                // From outside the range a jog leads back in.
                let jogs = self.runs(|command| matches!(command, Command::Jog(_) | Command::Velocity { .. }));
                let moves = self.runs(|command| matches!(command, Command::Move(_)));
                assert!(moves || jogs, "{block:?} belongs to none of {:?}", self.alive);
                if !jogs {
                    check_inside();
                }
            }
            0x03F => assert!(follows, "{block:?} belongs to none of {:?}", self.alive),
            _ if StreamCommand::from_id(id).is_some() => {
                assert!(follows, "{block:?} belongs to none of {:?}", self.alive);
                check_inside();
            }
            _ => panic!("a master does not send {block:?}"),
        }
    }

    /// An event, reported in the turn after which so many cycles were executed.
    pub fn event(&mut self, event: Event, executed: u64) {
        if let Some(before) = self.event.replace(event) {
            assert!(before.cycle <= event.cycle && before.at <= event.at, "{before} before {event}");
        }
        match event.kind {
            EventKind::Ended { id, command, outcome } => {
                let ended = self.alive.remove(&id.0);
                assert_eq!(
                    ended.map(|command| command.name()),
                    Some(command),
                    "{event}: not accepted, or ended before"
                );
                self.ended += 1;
                match (ended, outcome) {
                    (Some(Command::Reset), Outcome::Done) => (self.latched, self.reset_at) = (None, executed),
                    (Some(Command::Enable), Outcome::Done) => {
                        assert_eq!(self.latched, None, "{event} of a stopped axis");
                        self.armed = true;
                    }
                    (Some(Command::Home), Outcome::Done) => self.unreferenced = false,
                    // One that was replaced may never have begun.
                    (Some(Command::Disable), Outcome::Done) => self.armed = false,
                    (Some(Command::ResetFault), Outcome::Aborted(Abort::Stopped(StopCause::Shutdown))) => {
                        self.acknowledging = true;
                    }
                    _ => {}
                }
            }
            EventKind::Stopped(cause) => {
                // An axis that moves all the same, or that the application's stop has not stopped in time, is stopped
                // again; its first cause stays.
                let again = matches!(
                    cause,
                    StopCause::Uncommanded
                        | StopCause::Limit
                        | StopCause::PositionJump
                        | StopCause::StopTimeout
                );
                assert!(
                    self.latched.is_none() || again || self.deaf,
                    "{event}: stopped twice, {:?} before",
                    self.latched
                );
                let first = self.latched.filter(|_| again && !self.deaf);
                (self.latched, self.armed, self.stopped_at) = (first.or(Some(cause)), false, executed);
            }
            EventKind::PositionJump(_) => self.unreferenced = true,
            _ => {}
        }
    }

    /// What stops this axis stops its group, in the next cycle at the latest.
    pub fn check_group(&self, other: &Watch, executed: u64) {
        let group = self.drive.axis.stop.group;
        let together = group.is_some() && group == other.drive.axis.stop.group && !self.deaf && !other.deaf;
        if together && self.latched.is_some() && self.stopped_at < executed {
            let stopped = other.latched.is_some() || other.reset_at >= self.stopped_at;
            assert!(stopped, "{:?} stopped {} alone", self.latched, self.drive.axis.name);
        }
    }

    /// The feedback behind an executed cycle, all datagrams that came in it from this drive's address, and whether all
    /// that happened in this turn is in the feedback.
    pub fn feedback(&mut self, feedback: Feedback, came: &[Came], whole: bool) {
        let codes = came.iter().filter_map(|came| Response::parse(&came.bytes).ok()?.error);
        self.errors.extend(codes.map(|error| u32::from(error.0)));
        let before = std::mem::replace(&mut self.feedback, feedback);
        if self.deaf {
            self.latched = feedback.stopped;
        }
        assert!(feedback.stopped == self.latched || !whole, "events tell {:?}, {feedback:?}", self.latched);
        assert!(feedback.cycle > before.cycle || before.cycle == 0);
        if feedback.status.at == before.status.at {
            let values = |f: &Feedback| {
                let s = &f.status;
                let numbers = [s.position, s.demand, s.velocity, s.current].map(f64::to_bits);
                (numbers, s.state, s.homed, s.moving, s.in_target, s.warning, s.fault)
            };
            assert_eq!(values(&feedback), values(&before), "no reply, no news");
            let cycles = feedback.cycle - before.cycle;
            assert_eq!(u64::from(feedback.age - before.age), cycles, "{feedback:?} after {before:?}");
            return;
        }
        let said = |came: &Came| {
            let reply = Response::parse(&came.bytes).ok()?;
            let requested = self.requested.iter().rev().filter(|(at, _)| *at <= came.at).take(self.within());
            let is_echo =
                requested.map(|(_, requested)| requested).any(|requested| self.is_echo(requested, &reply));
            (came.at == feedback.status.at && !came.truncated && is_echo).then_some(reply)
        };
        let replies: Vec<Response> = came.iter().filter_map(said).collect();
        self.reply = replies.iter().find(|reply| self.is_told(&feedback, reply)).copied();
        assert!(
            self.reply.is_some(),
            "{feedback:?} is in none of {replies:?}, the replies to {:?}",
            self.requested
        );
        assert!(
            [feedback.status.position, feedback.status.demand, feedback.status.velocity]
                .iter()
                .all(|value| value.is_finite())
        );
    }

    pub fn datagrams(&mut self, came: usize) {
        self.datagrams += came as u64;
    }

    fn within(&self) -> usize {
        self.drive.replies_within() as usize
    }

    fn is_echo(&self, requested: &Request, reply: &Response) -> bool {
        let counted = self.drive.reply_tag == ReplyTag::Count;
        let tag = |config: Option<RtcBlock>| config.filter(|_| counted).map(|block| block.count());
        (requested.definition(), requested.response_def, tag(requested.config))
            == (reply.request_def, reply.response_def, tag(reply.config))
    }

    fn is_told(&self, feedback: &Feedback, reply: &Response) -> bool {
        let units = &self.drive.axis.units;
        let position = |count: Option<i32>, value: f64| match units.modulo {
            None => value == units.position(count.unwrap_or_default().into()),
            Some(turn) => (0.0..=turn).contains(&value),
        };
        let (status, state) = (reply.status.unwrap_or_default(), reply.state.unwrap_or_default());
        let moving = state.motion_active().unwrap_or(status.motion_active());
        // Not every reply has the code of the error: then it is one that the drive has reported before, or not known
        // yet.
        let shown = feedback.status.fault;
        let fault = match reply.error {
            _ if !status.error() => shown == 0,
            Some(error) => shown == u32::from(error.0),
            None => shown == 0 || self.errors.contains(&shown),
        };
        position(reply.actual, feedback.status.position)
            && position(reply.demand, feedback.status.demand)
            && reply.current.is_none_or(|raw| feedback.status.current == f64::from(raw) * 1e-3)
            && reply.warn.is_none_or(|raw| feedback.status.warning == u32::from(raw.0))
            && fault
            && (feedback.status.homed == status.homed() || self.unreferenced && !feedback.status.homed)
            && (feedback.status.moving, feedback.status.in_target) == (moving, status.in_target())
            && feedback.status.state.is_powered() == matches!(state.main().0, 3 | 5..)
    }

    /// The machine has ended.
    pub fn end(&self, end: &DriveEnd, refused: u64) {
        let c = end.counters;
        assert_eq!((c.sent, c.unsent), (self.sent, refused), "{c:?}");
        assert_eq!(c.sent, c.answered + c.missed, "{c:?}");
        assert_eq!(self.datagrams, c.answered + c.late + c.duplicate + c.malformed + c.foreign, "{c:?}");
        assert!(c.suspect <= c.answered && c.late <= c.missed + c.suspect, "{c:?}");
        assert!(self.deaf || self.alive.is_empty(), "without an end: {:?}", self.alive);
        assert!(self.latched.is_some(), "an axis is stopped at the end");
    }

    /// Whether the last word to the drive has left it switched on, although it could get a request since `since`.
    pub fn is_left_on(&self, since: Time) -> bool {
        let on = self.word.is_some_and(|word| word.has(ControlWord::SWITCH_ON));
        on && !self.wild && self.requested.last().is_some_and(|(at, _)| *at >= since)
    }
}
