//! SDOs and emergencies of one slave: its mailbox, one transfer at a time.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the master's transfers, the application's calls behind them, emergencies |
//! | `active` | the transfer under way: its owner, its time, its end |
//! | `emergencies` | those that wait to be taken |
//! | `mailbox` | how a message gets into the slave, and out of it |
//! | `counts` | the counts of messages: which answer may belong to which request |
//! | `sdo` | one transfer, message by message |
//!
//! An SDO from a slave is an answer only if one was requested, and if the count (where the slave returns it), the
//! object and the command are those of the request: drives differ in everything else (EtherCAT manual, "Mail
//! Input"). Every other SDO is a stray. An emergency may come in place of an answer, and at any time: the mailbox
//! is read every 50 ms.
//!
//! An answer that is lost, or does not come within the slave's time, costs a repetition of the SDO, never more. After
//! that a slave may answer twice, and counts are no proof: one that counts its own messages may be in step by chance.
//! So an SDO of no effect is sent before the next one, and repeated once: what comes before its answer belongs to the
//! past.
//!
//! It runs on the real-time thread: bounded, without allocation.

pub mod active;
mod counts;
pub mod emergencies;
pub mod mailbox;
pub mod sdo;

pub(super) use self::active::ATTEMPTS;
use self::active::{Active, By, bits, farewell};
use self::emergencies::Emergencies;
use self::mailbox::{Mailbox, Post, Received};
pub use self::sdo::Failure;
use self::sdo::{End, Sdo, unusable};
use super::counters::Own;
use super::object::long::Target as _;
use super::object::number::DEVICE_TYPE;
use super::object::{self, Target, long};
use super::plan::SlavePlan;
use super::slot::{Answers, Ask};
use super::wire::mailbox::{Emergency, Message, counter, is_answer, parse};
use super::wire::sdo::{AbortCode, Object, Request};
use fieldbeat_core::axis::Link;
use fieldbeat_core::axis::acyclic::{Answer, Call, CallError, Port};
use fieldbeat_core::bus::{Calls, Counters};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// The slave's time for an answer is so many turns at least.
const ANSWER_TURNS: u64 = 12;

/// The mailbox of one slave.
#[derive(Debug)]
pub struct Service {
    /// The conversation; `None`: the slave has no mailbox.
    pub mailbox: Option<Mailbox>,
    calls: Calls,
    open: bool,
    /// A transfer of the master that was not started yet, and how the last one ended.
    waiting: Option<Sdo>,
    end: Option<Result<u32, Failure>>,
    active: Option<Active>,
    emergencies: Emergencies,
    /// An answer to an earlier request may come that the next one could be taken to have.
    suspect: bool,
    /// Transfers that were not answered, and repeated ones, not counted yet.
    silent: u64,
    repeated: u64,
    /// Dropped emergencies, not counted yet.
    lost: u64,
    /// The time that the slave may take for an answer, ns.
    answer_ns: u64,
}

impl Service {
    /// The mailbox of a slave, and the application's calls for it.
    pub fn new(slave: &SlavePlan, port: Port, turn_ns: u64) -> Service {
        let answer_ns = slave.sdo_timeout_ns.max(ANSWER_TURNS * turn_ns);
        let mailbox = |areas| Mailbox::new(areas, slave.station(), answer_ns, turn_ns);
        Service {
            mailbox: slave.mailbox.and_then(mailbox),
            calls: Calls::new(port, object::NOT_READ, object::NOT_LOADED),
            open: false,
            waiting: None,
            end: None,
            active: None,
            emergencies: Emergencies::default(),
            suspect: false,
            silent: 0,
            repeated: 0,
            lost: 0,
            answer_ns,
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        if let Some(mailbox) = &self.mailbox {
            mailbox.memory(regions);
        }
        self.calls.memory(regions);
    }

    /// The mailbox works from now on (PREOP and above), or not any more: the transfer under way ends.
    pub fn open(&mut self, open: bool) {
        if std::mem::replace(&mut self.open, open) == open {
            return;
        }
        if open {
            // An end of meanwhile belongs to no user any more.
            (self.end, self.waiting) = (None, None);
            // Nor do earlier emergencies: it may be another slave.
            self.lost += self.emergencies.count as u64;
            self.emergencies = Emergencies::default();
        } else {
            self.finish(Err(Failure::GivenUp(CallError::Restarted)));
            if self.waiting.take().is_some() {
                self.end = Some(Err(Failure::GivenUp(CallError::Restarted)));
            }
        }
        if let Some(mailbox) = &mut self.mailbox {
            mailbox.reset();
        }
        self.suspect = false;
    }

    /// No transfer of the master is under way, and the end of the last one was taken: one may begin.
    pub fn is_free(&self) -> bool {
        let is_active = matches!(self.active, Some(Active { by: By::Master, .. }));
        self.end.is_none() && self.waiting.is_none() && !is_active
    }

    /// Begins to read an object for the master, which precedes the application. Of a value the first four bytes count.
    pub fn read(&mut self, object: Object) {
        self.wait(Sdo::read(object, false));
    }

    /// The same: writes a value of 1 ... 128 bytes.
    pub fn write(&mut self, object: Object, value: &[u8]) {
        self.wait(Sdo::write(object, value));
    }

    fn wait(&mut self, sdo: Sdo) {
        match &self.mailbox {
            Some(mailbox) if self.open && !mailbox.takes(&sdo) => {
                self.end = Some(Err(Failure::Unusable(object::EXPEDITED)));
            }
            Some(_) if self.open => self.waiting = Some(sdo),
            _ => self.end = Some(Err(Failure::GivenUp(CallError::NotOnline))),
        }
    }

    /// How the transfer of the master ended, once. Of a write `Ok` returns the written value, its first four bytes.
    pub fn take_end(&mut self) -> Option<Result<u32, Failure>> {
        self.end.take()
    }

    /// The next emergency that the slave has reported.
    pub fn take_emergency(&mut self) -> Option<Emergency> {
        self.emergencies.pop()
    }

    /// Starts the next call of the application, and ends finished ones. Calls that command a `guarded` drive are
    /// refused.
    #[inline]
    pub fn advance(&mut self, now: Time, link: Link, guarded: bool) {
        self.calls.guard(guarded);
        // Usually there is nothing.
        let is_called = !self.calls.is_empty() || self.calls.is_unsettled();
        if is_called || self.active.is_some() || self.waiting.is_some() {
            self.go_on(now, link);
        }
    }

    /// A call of the application that commands the drive is under way, or may still be carried out.
    pub fn commands(&self) -> bool {
        let is_commanding = |active: &Active| active.call().is_some_and(|posted| self.calls.commands(posted));
        self.calls.is_unsettled() || self.active.as_ref().is_some_and(is_commanding)
    }

    #[inline(never)]
    fn go_on(&mut self, now: Time, link: Link) {
        let is_down = !self.open || matches!(link, Link::Unseen | Link::Lost);
        match &self.mailbox {
            None => self.calls.refuse_all(CallError::Refused(object::NO_MAILBOX)),
            Some(_) if is_down => self.calls.refuse_all(CallError::NotOnline),
            Some(_) => {}
        }
        if let Some(active) = &self.active {
            let is_late = active.is_late(now, self.answer_ns);
            let why = match active.call() {
                Some(posted) => self
                    .calls
                    .over(posted, active.begun, now, active.gone_out, !is_down)
                    .or(is_down.then_some(CallError::NotOnline)),
                None => active.is_over(now).then_some(CallError::TimedOut),
            };
            if let Some(why) = why {
                self.silent += u64::from(why == CallError::TimedOut);
                self.finish(Err(Failure::GivenUp(why)));
            } else if is_late {
                self.repeat(now);
            }
        }
        let is_ready = self.open && self.active.is_none();
        if is_ready && self.mailbox.as_ref().is_some_and(Mailbox::is_free) {
            self.take_up(now);
        }
    }

    /// The next transfer: the master's first.
    fn take_up(&mut self, now: Time) {
        if self.suspect && (self.waiting.is_some() || !self.calls.is_empty()) {
            return self.start(now, By::Nobody, Sdo::read(DEVICE_TYPE, false));
        }
        if let Some(sdo) = self.waiting.take() {
            return self.start(now, By::Master, sdo);
        }
        if self.calls.is_unsettled() {
            return self.start(now, By::Nobody, Sdo::read(DEVICE_TYPE, false));
        }
        let Some(posted) = self.calls.next(1) else { return };
        let call = posted.call;
        let sdo = match (call.service, Target::unpack(call.address)) {
            (object::READ, Some(Target { object, kind, complete })) => (Sdo::read(object, complete), kind),
            (object::WRITE, Some(Target { object, kind: Some(kind), complete: false })) => {
                // Of a text there is what is not 0.
                let text = (71 - call.value.leading_zeros() as usize) / 8;
                let bytes = if kind.is_string() { text } else { kind.bytes() };
                let value = call.value.to_le_bytes();
                (Sdo::write(object, value.get(..bytes).unwrap_or(&value)), Some(kind))
            }
            (object::STORE, Some(Target { object, kind: Some(kind), complete: false }))
                if kind.is_string() =>
            {
                match self.calls.loaded(&posted) {
                    Some(value) => (Sdo::write(object, value), Some(kind)),
                    None => return self.calls.end(&posted, Err(CallError::Refused(object::NOT_LOADED))),
                }
            }
            _ => return self.calls.end(&posted, Err(CallError::Refused(object::NO_CALL))),
        };
        if self.mailbox.as_ref().is_some_and(|mailbox| !mailbox.takes(&sdo.0)) {
            return self.calls.end(&posted, Err(CallError::Refused(object::EXPEDITED)));
        }
        self.start(now, By::Call(posted, sdo.1), sdo.0);
    }

    fn start(&mut self, now: Time, by: By, sdo: Sdo) {
        self.active = Some(Active::new(now, by, sdo, self.answer_ns));
        self.post(Post::First);
    }

    /// Hands the next request of the transfer to the mailbox. There is room: a mailbox has 16 bytes at least.
    fn post(&mut self, post: Post) {
        if let (Some(active), Some(mailbox)) = (&mut self.active, &mut self.mailbox) {
            let request = active.sdo.request(mailbox.room());
            mailbox.post(&request, post);
        }
    }

    /// The answer was lost, and does not come again. What the application writes is not written twice without its
    /// knowledge: the same value may do something each time.
    fn answer_lost(&mut self, now: Time) {
        let awaits = self.mailbox.as_ref().is_some_and(Mailbox::awaits);
        let is_write = matches!(&self.active, Some(Active { by: By::Call(..), sdo, .. }) if sdo.writes());
        if awaits && is_write {
            self.finish(Err(Failure::GivenUp(CallError::Refused(object::UNCERTAIN))));
        } else {
            self.repeat(now);
        }
    }

    /// The answer was lost, or is late: the transfer is repeated, as often as it may.
    fn repeat(&mut self, now: Time) {
        // Its power may have come on meanwhile.
        let call = self.active.as_ref().and_then(Active::call);
        let is_refused = call.is_some_and(|posted| self.calls.refusal(posted).is_some());
        let (Some(active), Some(mailbox)) = (&mut self.active, &mut self.mailbox) else { return };
        if mailbox.awaits() && active.attempts < ATTEMPTS && !is_refused {
            let post = if active.sdo.is_begun() { Post::First } else { Post::Again };
            active.repeat(now);
            mailbox.abandon();
            self.repeated += 1;
            self.post(post);
        }
    }

    /// Writes its request for the next frame into `ask`; nothing, if there is nothing to do. Called again without
    /// an answer, the frame was not sent, and the request is the same.
    #[inline]
    pub fn request(&mut self, now: Time, ask: &mut Ask) {
        if let Some(mailbox) = self.mailbox.as_mut().filter(|_| self.open) {
            mailbox.request(now, ask);
            if let Some(active) = &mut self.active {
                active.gone_out |= mailbox.writes();
            }
        }
    }

    /// Takes the answer to its request.
    pub fn receive(&mut self, now: Time, answers: &Answers<'_>, counters: &mut Counters) {
        counters.own[Own::MailboxSilent as usize] += std::mem::take(&mut self.silent);
        counters.own[Own::MailboxRepeats as usize] += std::mem::take(&mut self.repeated);
        counters.own[Own::EmergenciesLost as usize] += std::mem::take(&mut self.lost);
        let received = self.mailbox.as_mut().map(|mailbox| mailbox.receive(now, answers, counters));
        match received {
            None | Some(Received::Nothing) => {}
            Some(Received::Full) => {
                counters.own[Own::MailboxSilent as usize] += u64::from(self.active.is_some());
                self.finish(Err(Failure::Unusable(object::FULL)));
            }
            Some(Received::Gone) => self.answer_lost(now),
            Some(Received::Message) => self.take(now, counters),
        }
    }

    /// A message has come.
    fn take(&mut self, now: Time, counters: &mut Counters) {
        let Some(mailbox) = &mut self.mailbox else { return };
        let active = self.active.as_mut().filter(|_| mailbox.awaits());
        let (message, counts) = mailbox.received();
        let end = match (parse(message), active) {
            (Some(Message::Emergency(emergency)), _) => {
                Own::Emergencies.count(counters);
                if !self.emergencies.push(emergency) {
                    Own::EmergenciesLost.count(counters);
                }
                return;
            }
            (Some(Message::Sdo { counter, response }), Some(active))
                if active.sdo.is_answered_by(&response) && counts.may_answer(counter) =>
            {
                active.sdo.take(&response)
            }
            (Some(Message::Refused(error)), Some(active))
                if !active.is_nobodys() && counts.may_answer(counter(message)) =>
            {
                unusable(object::MAILBOX + u32::from(error.0))
            }
            (Some(_), _) => return Own::MailboxStrays.count(counters),
            (None, active) => {
                Own::MailboxBroken.count(counters);
                // Whatever else cannot be read is not its answer.
                let is_its = active.is_some_and(|active| !active.is_nobodys()) && is_answer(message);
                if !is_its || !counts.may_answer(counter(message)) {
                    return;
                }
                unusable(object::BROKEN)
            }
        };
        let Some(end) = end else {
            mailbox.answered();
            if let Some(active) = &mut self.active {
                active.since = now;
            }
            return self.post(Post::First);
        };
        if matches!(end, Err(Failure::Abort(_))) {
            Own::Aborts.count(counters);
        }
        self.finish(end);
    }

    /// Ends the transfer that is under way.
    fn finish(&mut self, end: End) {
        const TIMED_OUT: Failure = Failure::GivenUp(CallError::TimedOut);
        let Some(active) = self.active.take() else { return };
        let is_answered = matches!(end, Ok(()) | Err(Failure::Abort(_)));
        // It answers in the order of its requests.
        if is_answered {
            self.calls.settle();
        } else if active.gone_out && active.call().is_some_and(|posted| self.calls.commands(posted)) {
            self.calls.doubt();
        }
        if let Some(mailbox) = &mut self.mailbox {
            self.suspect = match active.by {
                // After its answer nothing of before comes.
                By::Nobody => self.suspect && !is_answered,
                _ if is_answered => mailbox.is_twice(),
                _ => active.gone_out,
            };
            match end {
                Err(Failure::GivenUp(_)) => mailbox.abandon(),
                _ => mailbox.answered(),
            }
            if let Some(code) = farewell(&active.sdo, end) {
                let object = active.sdo.object();
                mailbox.post(&Request::Abort { object, code }, Post::Unanswered);
            }
        }
        let (size, data) = active.sdo.value();
        match active.by {
            By::Master => self.end = Some(end.map(|()| long::raw(data) as u32)),
            By::Call(posted, kind) => {
                let Call { service, address, value } = posted.call;
                let reads = service == object::READ;
                if reads && end.is_ok() {
                    self.calls.keep(&posted, size, data);
                }
                let value = if reads { bits(kind, size, data) } else { value };
                let result = end.map(|()| Answer { status: 0, address, value });
                self.calls.end(
                    &posted,
                    result.map_err(|failure| match failure {
                        Failure::Abort(AbortCode(status)) | Failure::Unusable(status) => {
                            CallError::Refused(status)
                        }
                        Failure::GivenUp(why) => why,
                    }),
                );
            }
            // A slave that has not answered this one would not answer the next one.
            By::Nobody if matches!(end, Err(TIMED_OUT | Failure::Unusable(_))) => {
                if self.waiting.take().is_some() {
                    self.end = Some(Err(TIMED_OUT));
                } else if let Some(posted) = self.calls.take() {
                    self.calls.end(&posted, Err(CallError::TimedOut));
                }
            }
            By::Nobody => {}
        }
    }
}
