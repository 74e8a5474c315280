//! SDOs and emergencies of one slave: its mailbox, one transfer at a time.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the master's transfers, the application's calls behind them, emergencies |
//! | `emergencies` | those that wait to be taken |
//! | `mailbox` | how a message gets into the slave, and out of it |
//! | `sdo` | one transfer, message by message |
//!
//! An SDO from a slave is an answer only if one was requested, and if the count (where the slave returns it), the
//! object and the command are those of the request: drives differ in everything else (EtherCAT manual, "Mail
//! Input"). Every other SDO is a stray. An emergency may come in place of an answer, and at any time: the mailbox
//! is read every 50 ms.
//!
//! It runs on the real-time thread: bounded, without allocation.

mod emergencies;
mod mailbox;
mod sdo;

use self::emergencies::Emergencies;
use self::mailbox::{Mailbox, Received};
use self::sdo::{Failure, KEPT, Sdo, Step};
use super::counters::Own;
use super::object::number::DEVICE_TYPE;
use super::object::{self, Target, Type, long};
use super::plan::SlavePlan;
use super::slot::{Answers, Ask};
use super::wire::mailbox::{Emergency, Message, parse};
use super::wire::sdo::{AbortCode, Object, Request};
use crate::axis::Link;
use crate::axis::acyclic::{Answer, Call, CallError, Port, Posted};
use crate::bus::Counters;
use crate::rt::Regions;
use crate::time::{MS, Time};

/// The time limit of a transfer of the master.
const LIMIT_NS: u64 = 700 * MS;
const LIMIT_TURNS: u64 = 12;

/// An SDO of the master itself, of eight bytes at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transfer {
    /// Reads an object: its bits, of a longer one the first four bytes.
    Read(Object),
    /// Writes the lowest `bytes` bytes of `raw`.
    Write {
        /// The object.
        object: Object,
        /// Its value.
        raw: u64,
        /// Its size.
        bytes: u8,
    },
}

/// Why an SDO failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SdoFailure {
    /// The slave refused.
    Abort(AbortCode),
    /// It did not answer, or nothing usable, or the mailbox was closed.
    Silent,
}

/// The mailbox of one slave.
#[derive(Debug)]
pub struct Service {
    mailbox: Option<Mailbox>,
    port: Option<Port>,
    open: bool,
    /// A transfer of the master that was not started yet, and how the last one ended.
    waiting: Option<Transfer>,
    end: Option<Result<u32, SdoFailure>>,
    active: Option<Active>,
    kept: Kept,
    emergencies: Emergencies,
    /// A call that commands the drive ended without the drive's answer: the drive may still carry it out, until it has
    /// answered a later request.
    unsettled: bool,
    /// Transfers that were not answered, not counted yet.
    silent: u64,
    /// Dropped emergencies, not counted yet.
    lost: u64,
    /// The longest time until its mailbox has the slot again, ns.
    turn_ns: u64,
}

/// The transfer under way.
#[derive(Clone, Copy, Debug)]
struct Active {
    by: By,
    sdo: Sdo,
    since: Time,
    limit_ns: u64,
    /// A frame with its first request was built.
    gone_out: bool,
}

/// Its owner.
#[derive(Clone, Copy, Debug)]
enum By {
    Master,
    Call(Posted, Option<Type>),
    /// Nobody waits for it: its answer shows that the drive has carried out all requests before it.
    Nobody,
}

/// How a transfer ends.
#[derive(Clone, Copy, Debug)]
enum End {
    Done,
    Failed(Failure),
    GivenUp(CallError),
}

/// The data of the last read call, for the later calls of its series.
#[derive(Clone, Copy, Debug)]
struct Kept {
    series: u64,
    address: u32,
    size: usize,
    data: [u8; KEPT],
}

impl Kept {
    /// The answer to a call for a part of it.
    fn answer(&self, posted: &Posted) -> Result<Answer, CallError> {
        let Call { service, address, value } = posted.call;
        let done = |value| Ok(Answer { status: 0, address, value });
        let at = usize::try_from(value).unwrap_or(usize::MAX);
        let is_that = posted.series != 0 && (self.series, self.address) == (posted.series, address);
        match service {
            object::SIZE if is_that => done(self.size as u64),
            object::PART if is_that && at < self.size.min(KEPT) => {
                let part = self.data.get(at..).unwrap_or_default();
                done(long::raw(part))
            }
            _ => Err(CallError::Refused(object::NOT_READ)),
        }
    }
}

/// A value of `size` bytes as the bits of its type, which may be longer.
fn bits(kind: Option<Type>, size: usize, data: &[u8]) -> u64 {
    let raw = long::raw(data.get(..size).unwrap_or(data));
    match kind {
        Some(kind) if kind.is_signed() && (1..kind.bytes()).contains(&size) => {
            let above = 64 - 8 * size as u32;
            kind.raw((raw << above) as i64 >> above)
        }
        _ => raw,
    }
}

impl Service {
    /// The mailbox of a slave, and the application's calls for it.
    pub fn new(slave: &SlavePlan, port: Option<Port>, turn_ns: u64) -> Service {
        Service {
            mailbox: slave.mailbox.and_then(|areas| Mailbox::new(areas, slave.station(), turn_ns)),
            port,
            open: false,
            waiting: None,
            end: None,
            active: None,
            kept: Kept { series: 0, address: 0, size: 0, data: [0; KEPT] },
            emergencies: Emergencies::default(),
            unsettled: false,
            silent: 0,
            lost: 0,
            turn_ns,
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        if let Some(mailbox) = &self.mailbox {
            mailbox.memory(regions);
        }
        if let Some(port) = &self.port {
            port.memory(regions);
        }
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
            self.finish(Time::default(), End::GivenUp(CallError::Restarted));
            if self.waiting.take().is_some() {
                self.end = Some(Err(SdoFailure::Silent));
            }
        }
        if let Some(mailbox) = &mut self.mailbox {
            mailbox.reset();
        }
    }

    /// No transfer of the master is under way, and the end of the last one was taken: one may begin.
    pub fn is_free(&self) -> bool {
        let is_active = matches!(self.active, Some(Active { by: By::Master, .. }));
        self.end.is_none() && self.waiting.is_none() && !is_active
    }

    /// Begins a transfer of the master; it precedes those of the application.
    pub fn begin(&mut self, transfer: Transfer) {
        match self.open && self.mailbox.is_some() {
            true => self.waiting = Some(transfer),
            false => self.end = Some(Err(SdoFailure::Silent)),
        }
    }

    /// How the transfer of the master ended, once. Of a write `Ok` returns the written value, its first four bytes.
    pub fn take_end(&mut self) -> Option<Result<u32, SdoFailure>> {
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
        let mut is_called = false;
        if let Some(port) = &mut self.port {
            port.guard(guarded);
            is_called = !port.is_empty();
        }
        // Usually there is nothing.
        if is_called || self.active.is_some() || self.waiting.is_some() || self.unsettled {
            self.go_on(now, link);
        }
    }

    /// A call of the application that commands the drive is under way, or may still be carried out.
    pub fn commands(&self) -> bool {
        self.unsettled || self.active.as_ref().is_some_and(|active| self.is_commanding(active))
    }

    fn is_commanding(&self, active: &Active) -> bool {
        match (&active.by, &self.port) {
            (By::Call(posted, _), Some(port)) => port.commands(posted),
            _ => false,
        }
    }

    fn go_on(&mut self, now: Time, link: Link) {
        let is_down = !self.open || matches!(link, Link::Unseen | Link::Lost);
        if let Some(port) = &mut self.port {
            match &self.mailbox {
                None => port.refuse_all(CallError::Refused(object::NO_MAILBOX)),
                Some(_) if is_down => port.refuse_all(CallError::NotOnline),
                Some(_) => {}
            }
        }
        if let Some(active) = &self.active {
            let is_over = now.since(active.since) > active.limit_ns;
            let refusal = match (&active.by, &self.port) {
                (By::Call(posted, _), Some(port)) if !active.gone_out => port.refusal(posted),
                _ => None,
            };
            let why = match &active.by {
                _ if refusal.is_some() => refusal,
                By::Call(posted, _) if self.port.as_ref().is_some_and(|port| port.is_cancelled(posted)) => {
                    Some(CallError::Cancelled)
                }
                By::Call(..) if is_down => Some(CallError::NotOnline),
                _ if is_over => Some(CallError::TimedOut),
                _ => None,
            };
            if let Some(why) = why {
                self.silent += u64::from(why == CallError::TimedOut);
                self.finish(now, End::GivenUp(why));
            }
        }
        let is_ready = self.open && self.active.is_none();
        if is_ready && self.mailbox.as_ref().is_some_and(Mailbox::is_free) {
            self.take_up(now);
        }
    }

    /// The next transfer: the master's first.
    fn take_up(&mut self, now: Time) {
        let limit_ns = LIMIT_NS.max(LIMIT_TURNS * self.turn_ns);
        if let Some(transfer) = self.waiting.take() {
            let sdo = match transfer {
                Transfer::Read(object) => Sdo::read(object, false),
                Transfer::Write { object, raw, bytes } => Sdo::write(object, raw, bytes.into()),
            };
            return self.start(now, Active { by: By::Master, sdo, since: now, limit_ns, gone_out: false });
        }
        if self.unsettled {
            let (by, sdo) = (By::Nobody, Sdo::read(DEVICE_TYPE, false));
            return self.start(now, Active { by, sdo, since: now, limit_ns, gone_out: false });
        }
        let Some(posted) = self.port.as_mut().and_then(Port::take) else { return };
        let call = posted.call;
        let sdo = match (call.service, Target::unpack(call.address)) {
            (object::READ, Some(Target { object, kind, complete })) => (Sdo::read(object, complete), kind),
            (object::WRITE, Some(Target { object, kind: Some(kind), complete: false })) => {
                // Of a text there is what is not 0.
                let text = (71 - call.value.leading_zeros() as usize) / 8;
                let bytes = if kind == Type::Text { text } else { kind.bytes() };
                (Sdo::write(object, call.value, bytes), Some(kind))
            }
            (object::SIZE | object::PART, _) => return self.end_call(&posted, self.kept.answer(&posted)),
            _ => return self.end_call(&posted, Err(CallError::Refused(object::NO_CALL))),
        };
        let (by, limit_ns) = (By::Call(posted, sdo.1), posted.limit_ns);
        self.start(now, Active { by, sdo: sdo.0, since: now, limit_ns, gone_out: false });
    }

    fn start(&mut self, now: Time, active: Active) {
        self.active = Some(active);
        self.post(now);
    }

    /// Hands the next request of the transfer to the mailbox. There is room: a mailbox has 16 bytes at least.
    fn post(&mut self, now: Time) {
        if let (Some(active), Some(mailbox)) = (&mut self.active, &mut self.mailbox) {
            let request = active.sdo.request(mailbox.room());
            mailbox.post(now, &request, true);
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
        counters.own[Own::EmergenciesLost as usize] += std::mem::take(&mut self.lost);
        let received = self.mailbox.as_mut().map(|mailbox| mailbox.receive(now, answers, counters));
        match received {
            None | Some(Received::Nothing) => {}
            Some(Received::Full) => {
                counters.own[Own::MailboxSilent as usize] += u64::from(self.active.is_some());
                self.finish(now, End::Failed(Failure::Unusable(object::FULL)));
            }
            Some(Received::Message) => self.take(now, counters),
        }
    }

    /// A message has come.
    fn take(&mut self, now: Time, counters: &mut Counters) {
        let Some(mailbox) = &self.mailbox else { return };
        let active = self.active.as_mut().filter(|_| mailbox.awaits());
        let is_awaited = active.is_some();
        let failed = |status| Step::Failed(Failure::Unusable(status));
        let step = match (parse(mailbox.message()), active) {
            (Some(Message::Emergency(emergency)), _) => {
                Own::Emergencies.count(counters);
                if !self.emergencies.push(emergency) {
                    Own::EmergenciesLost.count(counters);
                }
                return;
            }
            (Some(Message::Sdo { counter, response }), Some(active))
                if counter == 0 || counter == mailbox.count() =>
            {
                active.sdo.take(&response)
            }
            (Some(Message::Refused(error)), Some(_)) => failed(object::MAILBOX + u32::from(error.0)),
            (Some(_), _) => Step::Stray,
            (None, _) => {
                Own::MailboxBroken.count(counters);
                if !is_awaited {
                    return;
                }
                failed(object::BROKEN)
            }
        };
        match step {
            Step::Stray => Own::MailboxStrays.count(counters),
            Step::Next => {
                if let Some(mailbox) = &mut self.mailbox {
                    mailbox.answered();
                }
                self.post(now);
            }
            Step::Done => self.finish(now, End::Done),
            Step::Failed(failure) => {
                if matches!(failure, Failure::Abort(_)) {
                    Own::Aborts.count(counters);
                }
                self.finish(now, End::Failed(failure));
            }
        }
    }

    /// Ends the transfer that is under way.
    fn finish(&mut self, now: Time, end: End) {
        let Some(active) = self.active.take() else { return };
        self.unsettled = match end {
            // It answers in the order of its requests.
            End::Done | End::Failed(Failure::Abort(_)) => false,
            End::Failed(Failure::Unusable(_)) | End::GivenUp(_) => {
                self.unsettled || active.gone_out && self.is_commanding(&active)
            }
        };
        if let Some(mailbox) = &mut self.mailbox {
            match end {
                End::GivenUp(_) => mailbox.abandon(),
                End::Done | End::Failed(_) => mailbox.answered(),
            }
            if let Some(code) = farewell(&active.sdo, end) {
                let object = active.sdo.object();
                mailbox.post(now, &Request::Abort { object, code }, false);
            }
        }
        let (size, data) = active.sdo.value();
        match active.by {
            By::Master => {
                self.end = Some(match end {
                    End::Done => Ok(long::raw(data) as u32),
                    End::Failed(Failure::Abort(code)) => Err(SdoFailure::Abort(code)),
                    End::Failed(Failure::Unusable(_)) | End::GivenUp(_) => Err(SdoFailure::Silent),
                });
            }
            By::Call(posted, kind) => {
                let Call { service, address, value } = posted.call;
                let reads = service == object::READ;
                if reads && matches!(end, End::Done) {
                    self.kept = Kept { series: posted.series, address, size, data: *data };
                }
                let value = if reads { bits(kind, size, data) } else { value };
                self.end_call(
                    &posted,
                    match end {
                        End::Done => Ok(Answer { status: 0, address, value }),
                        End::Failed(Failure::Abort(AbortCode(status)) | Failure::Unusable(status)) => {
                            Err(CallError::Refused(status))
                        }
                        End::GivenUp(why) => Err(why),
                    },
                );
            }
            By::Nobody => {}
        }
    }

    fn end_call(&mut self, posted: &Posted, result: Result<Answer, CallError>) {
        if let Some(port) = &mut self.port {
            port.end(posted, result);
        }
    }
}

/// The abort to a slave in the middle of a transfer that ends: it would wait for the next segment.
fn farewell(sdo: &Sdo, end: End) -> Option<AbortCode> {
    let code = match end {
        End::Failed(Failure::Unusable(object::TOGGLE)) => AbortCode::TOGGLE,
        End::Failed(Failure::Unusable(_)) => AbortCode::GENERAL,
        End::GivenUp(_) => AbortCode::TIMED_OUT,
        End::Done | End::Failed(Failure::Abort(_)) => return None,
    };
    sdo.is_begun().then_some(code)
}

#[cfg(test)]
mod tests;
