//! The acyclic calls to a drive: what is sent for each, and what its answer says.
//!
//! One call at a time. A call that commands the drive is checked against the loop's guard right before its frame is
//! built, and counts as under way until its end is known: its answer, or the answer to a later request. A drive answers
//! in the order of arrival (assumed).

use crate::exchange::SessionEnd;
use crate::target::{BROKEN, NO_CALL, NOT_LOADED, NOT_READ, Service, Target, VALUE, refusal};
use crate::wire::cip::{self, Reply, Segment, service};
use crate::wire::message::{self, Payload, immediate};
use crate::wire::opcodes;
use fieldbeat_core::axis::acyclic::{Answer, CallError, Port, Posted, long};
use fieldbeat_core::bus;
use fieldbeat_core::time::Time;

/// The calls to one drive.
#[derive(Debug)]
pub(super) struct Calls {
    calls: bus::Calls,
    active: Option<Active>,
}

/// The call under way.
#[derive(Debug)]
struct Active {
    /// `None`: it was cancelled after it was sent.
    posted: Option<Posted>,
    message: Message,
    until: Time,
    sent: bool,
    commands: bool,
    /// The drive was found without power, where the loop does not see that.
    is_off: bool,
}

/// The message of a call.
#[derive(Debug)]
struct Message {
    service: u8,
    path: [Segment<'static>; 3],
    data: Vec<u8>,
}

impl Message {
    /// That of a call; an error is its status. `loaded`: the value that was handed over for it.
    fn of(service: Option<Service>, loaded: Option<&[u8]>) -> Result<Message, u32> {
        let service = service.ok_or(NO_CALL)?;
        let (Service::Read(Target::Attribute { class, instance, attribute })
        | Service::Write(Target::Attribute { class, instance, attribute }, _)
        | Service::Store(Target::Attribute { class, instance, attribute }, _)) = service
        else {
            let data = own(service)?.into();
            return Ok(Message { service: service::VENDOR, path: message::PATH, data });
        };
        let path = [Segment::Class(class), Segment::Instance(instance), Segment::Attribute(attribute)];
        let (service, data) = match service {
            Service::Write(_, value) => (service::SET_ATTRIBUTE_SINGLE, value.to_le_bytes().into()),
            Service::Store(..) => (service::SET_ATTRIBUTE_SINGLE, loaded.ok_or(NOT_LOADED)?.into()),
            _ => (service::GET_ATTRIBUTE_SINGLE, Vec::new()),
        };
        Ok(Message { service, path, data })
    }

    /// The value of an answer that is no refusal; `None`: it is none to this message.
    fn value(&self, data: &[u8]) -> Option<u64> {
        match self.service {
            service::VENDOR => message::answer(&self.data, data).map(u64::from),
            service::GET_ATTRIBUTE_SINGLE => Some(long::raw(data)),
            _ => Some(long::raw(&self.data)),
        }
    }
}

/// The message of the drive's own for a call; an error is the status of the call.
fn own(service: Service) -> Result<Payload, u32> {
    let (opcode, operand, data) = match service {
        Service::Read(target) => match target {
            Target::Parameter { index, flash: false } => (immediate::READ_PARAMETER, index, 0),
            Target::Register(register) => (immediate::READ_REGISTER, register, 0),
            Target::Encoder => (immediate::READ_POSITION, 0, 0),
            Target::Absolute => (immediate::READ_POSITION, 1, 0),
            Target::AlarmHistory => (immediate::READ_ALARM_HISTORY, 0, 0),
            _ => return Err(NO_CALL),
        },
        Service::Write(target, value) => {
            let within = |least: u8, most: u8| {
                u8::try_from(value).ok().filter(|value| (least..=most).contains(value)).ok_or(VALUE)
            };
            match target {
                Target::Parameter { index, flash } if target.can_be_written() => {
                    let value = u16::try_from(value).map_err(|_| VALUE)?;
                    let index = index | u8::from(flash) << 7;
                    (immediate::WRITE_PARAMETER, index, u32::from(value) << 16)
                }
                Target::Register(register) => {
                    (immediate::WRITE_REGISTER, register, u32::try_from(value).map_err(|_| VALUE)?)
                }
                Target::Output(index) => (immediate::SET_OUTPUT, within(0, 1)? << 7 | index, 0),
                Target::Stop => (immediate::STOP, within(0, 1)?, 0),
                Target::Kill => (immediate::KILL, within(0, 1)?, 0),
                Target::AlarmReset => (immediate::RESET_ALARM, 0, 0),
                Target::LoadProgram => (immediate::LOAD_PROGRAM, 0, 0),
                Target::SaveSegment => (immediate::SAVE_SEGMENT, within(1, 12)?, 0),
                Target::Command { code, field } => {
                    let opcode = opcodes::OPCODES.into_iter().find(|opcode| opcode.code == code);
                    return message::buffered(opcode.ok_or(NO_CALL)?, field, value as i64).ok_or(VALUE);
                }
                _ => return Err(NO_CALL),
            }
        }
        _ => return Err(NO_CALL),
    };
    Ok(message::immediate(opcode, operand, data))
}

impl Calls {
    pub(super) fn new(port: Port) -> Calls {
        Calls { calls: bus::Calls::new(port, NOT_READ, NOT_LOADED), active: None }
    }

    /// From now on the calls that command the drive are refused on submission, or not.
    pub(super) fn guard(&mut self, on: bool) {
        self.calls.guard(on);
    }

    /// Ends the call under way if it was cancelled.
    pub(super) fn look(&mut self) {
        if let Some(active) = &mut self.active
            && let Some(posted) = active.posted.take_if(|posted| self.calls.is_cancelled(posted))
        {
            self.calls.end(&posted, Err(CallError::Cancelled));
        }
        // What was sent stays until its answer: nothing else is mistaken for that.
        self.active.take_if(|active| !active.sent && active.posted.is_none());
    }

    /// Takes up the next call. True if there is one to be sent.
    pub(super) fn advance(&mut self, now: Time) -> bool {
        if self.active.as_ref().is_some_and(|active| !active.sent && active.until <= now) {
            self.end(Err(CallError::TimedOut));
        }
        while self.active.is_none() {
            let Some(posted) = self.calls.next(usize::MAX) else { break };
            match Message::of(Service::of(&posted.call), self.calls.loaded(&posted)) {
                Ok(message) => {
                    let (until, commands) = (now + posted.limit_ns, self.calls.commands(&posted));
                    let posted = Some(posted);
                    self.active =
                        Some(Active { posted, message, until, sent: false, commands, is_off: false });
                }
                Err(status) => self.calls.end(&posted, Err(CallError::Refused(status))),
            }
        }
        self.active.as_ref().is_some_and(|active| !active.sent)
    }

    /// The call that is to be sent commands the drive, and whether that is without power is still open.
    pub(super) fn waits_for_power(&self) -> bool {
        self.active.as_ref().is_some_and(|active| !active.sent && active.commands && !active.is_off)
    }

    /// Takes the drive's answer to that; an error is its refusal.
    pub(super) fn power(&mut self, is_on: Result<bool, u32>) {
        match is_on {
            Ok(false) => self.active.iter_mut().for_each(|active| active.is_off = true),
            Ok(true) => self.end(Err(CallError::Commands)),
            Err(status) => self.end(Err(CallError::Refused(status))),
        }
    }

    /// The message of the call that is to be sent, and when its answer is due at the latest. `None`: it was refused.
    pub(super) fn send(&mut self, end: &SessionEnd) -> Option<(Time, Vec<u8>)> {
        let active = self.active.as_mut()?;
        if active.commands && !end.begin_commanding() {
            self.end(Err(CallError::Commands));
            return None;
        }
        active.sent = true;
        let Message { service, path, data } = &active.message;
        Some((active.until, cip::request(*service, path, data)))
    }

    /// Whether this can be the answer to the call that was sent.
    pub(super) fn fits(&self, reply: &Reply<'_>) -> bool {
        self.active.as_ref().is_some_and(|active| active.message.service == reply.service)
    }

    /// The answer to the call that was sent.
    pub(super) fn answer(&mut self, end: &SessionEnd, reply: &Reply<'_>) {
        let Some(active) = &self.active else { return };
        let value = match active.message.value(reply.data) {
            _ if !reply.status.is_ok() => Err(refusal(reply.status)),
            Some(value) => Ok(value),
            None => Err(BROKEN),
        };
        if let (service::GET_ATTRIBUTE_SINGLE, Some(posted), Ok(_)) =
            (active.message.service, &active.posted, value)
        {
            self.calls.keep(posted, reply.data.len(), reply.data);
        }
        self.over(end, value.map_err(CallError::Refused));
    }

    /// The call that was sent has ended with the drive.
    pub(super) fn over(&mut self, end: &SessionEnd, result: Result<u64, CallError>) {
        if self.active.as_ref().is_some_and(|active| active.sent && active.commands) {
            end.end_commanding();
        }
        self.end(result);
    }

    /// The call was not answered, and will not be: the drive may have carried it out, or still do so.
    pub(super) fn silent(&mut self) {
        if self.active.as_ref().is_some_and(|active| active.sent && active.commands) {
            self.calls.doubt();
        }
        self.end(Err(CallError::TimedOut));
    }

    /// A call that commands the drive may still be carried out, although nobody waits for it.
    pub(super) fn owes(&self) -> bool {
        self.calls.is_unsettled()
    }

    /// The drive has answered a later request.
    pub(super) fn settle(&mut self, end: &SessionEnd) {
        if self.calls.is_unsettled() {
            self.calls.settle();
            end.end_commanding();
        }
    }

    /// There is no session, and none is being opened.
    pub(super) fn refuse_all(&mut self, why: CallError) {
        match &self.active {
            Some(active) if active.sent => self.silent(),
            _ => self.end(Err(why)),
        }
        self.calls.refuse_all(why);
    }

    /// Ends the call under way before it was sent.
    pub(super) fn end(&mut self, result: Result<u64, CallError>) {
        if let Some(Active { posted: Some(posted), .. }) = self.active.take() {
            let address = posted.call.address;
            self.calls.end(&posted, result.map(|value| Answer { status: 0, address, value }));
        }
    }
}
