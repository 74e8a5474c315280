//! The acyclic calls to a drive: what is sent for each, and what its answer says.
//!
//! One call at a time. A call that commands the drive is checked against the loop's guard right before its frame is
//! built, and counts as under way until its end is known: its answer, or the answer to a later request. A drive answers
//! in the order of arrival (assumed).

use crate::exchange::SessionEnd;
use crate::target::{
    BROKEN, LOAD, NO_CALL, NOT_LOADED, NOT_READ, PART, READ, SIZE, STORE, Target, VALUE, WRITE, refusal,
};
use crate::wire::cip::{self, Reply, Segment, service};
use crate::wire::message::{self, Buffered, Deceleration, Immediate};
use crate::wire::opcodes;
use fieldbeat_core::axis::acyclic::long::{self, Kept};
use fieldbeat_core::axis::acyclic::{Answer, Call, CallError, Port, Posted};
use fieldbeat_core::time::Time;

/// The calls to one drive.
#[derive(Debug)]
pub(super) struct Calls {
    port: Port,
    active: Option<Active>,
    /// What the last call of a series has read ...
    read: Kept,
    /// ... and what its calls have handed over to be written.
    loaded: Kept,
    /// A call that commands the drive was sent, and nothing shows that it is over. Its ticket has ended.
    owed: bool,
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

/// What is sent for a call.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Message {
    Immediate(Immediate),
    Buffered(Buffered),
    Get([Segment<'static>; 3]),
    Set([Segment<'static>; 3], Vec<u8>),
}

impl Message {
    /// That of a call; an error is its status. `loaded`: the value that was handed over for it.
    fn of(call: &Call, loaded: Option<&[u8]>) -> Result<Message, u32> {
        let target = Target::unpack(call.address).ok_or(NO_CALL)?;
        let attribute = |class, instance, attribute| {
            [Segment::Class(class), Segment::Instance(instance), Segment::Attribute(attribute)]
        };
        match (call.service, target) {
            (READ, Target::Attribute { class, instance, attribute: number }) => {
                Ok(Message::Get(attribute(class, instance, number)))
            }
            (WRITE, Target::Attribute { class, instance, attribute: number }) => {
                Ok(Message::Set(attribute(class, instance, number), call.value.to_le_bytes().into()))
            }
            (STORE, Target::Attribute { class, instance, attribute: number }) => {
                let bytes = loaded.ok_or(NOT_LOADED)?;
                Ok(Message::Set(attribute(class, instance, number), bytes.into()))
            }
            (READ, target) => read(target).map(Message::Immediate).ok_or(NO_CALL),
            (WRITE, Target::Command { code, field }) => {
                let opcode =
                    opcodes::OPCODES.into_iter().find(|opcode| opcode.code == code).ok_or(NO_CALL)?;
                let buffered = Buffered { opcode, field, value: call.value as i64 };
                buffered.encode().map(|_| Message::Buffered(buffered)).ok_or(VALUE)
            }
            (WRITE, target) => write(target, call.value).map(Message::Immediate),
            _ => Err(NO_CALL),
        }
    }

    fn service(&self) -> u8 {
        match self {
            Message::Immediate(_) | Message::Buffered(_) => service::VENDOR,
            Message::Get(_) => service::GET_ATTRIBUTE_SINGLE,
            Message::Set(..) => service::SET_ATTRIBUTE_SINGLE,
        }
    }

    fn emit(&self, out: &mut Vec<u8>) {
        match self {
            Message::Immediate(immediate) => {
                cip::request(out, self.service(), &message::PATH, &immediate.encode());
            }
            // It was encoded when the call was taken up.
            Message::Buffered(buffered) => {
                cip::request(out, self.service(), &message::PATH, &buffered.encode().unwrap_or_default());
            }
            Message::Get(path) => cip::request(out, self.service(), path, &[]),
            Message::Set(path, data) => cip::request(out, self.service(), path, data),
        }
    }

    /// The value of an answer that is no refusal; `None`: it is none to this message.
    fn value(&self, data: &[u8]) -> Option<u64> {
        Some(match self {
            Message::Immediate(immediate) => match immediate.answer(data).ok()? {
                message::Answer::Status(word) | message::Answer::Word(word) => word.into(),
                message::Answer::Long(long) => (long as u32).into(),
            },
            Message::Buffered(buffered) => buffered.answer(data).ok()?.into(),
            Message::Get(_) => long::raw(data),
            Message::Set(_, data) => long::raw(data),
        })
    }
}

fn read(target: Target) -> Option<Immediate> {
    Some(match target {
        Target::Parameter { index, flash: false } => Immediate::ReadParameter(index),
        Target::Register(register) => Immediate::ReadRegister(register),
        Target::Encoder => Immediate::ReadEncoder,
        Target::Absolute => Immediate::ReadAbsolute,
        Target::AlarmHistory => Immediate::ReadAlarmHistory,
        _ => return None,
    })
}

/// An error is the status of the call.
fn write(target: Target, value: u64) -> Result<Immediate, u32> {
    let below = |most: u64| if value <= most { Ok(value) } else { Err(VALUE) };
    let deceleration =
        || below(1).map(|set| if set == 0 { Deceleration::Largest } else { Deceleration::Set });
    Ok(match target {
        Target::Parameter { index, flash } => match target.parameter() {
            // Bit 7 of such an index would be the flash memory of another parameter.
            Some(parameter) if !parameter.read_only => {
                Immediate::WriteParameter { index, value: below(u16::MAX.into())? as u16, flash }
            }
            _ => return Err(NO_CALL),
        },
        Target::Register(register) => {
            Immediate::WriteRegister { register, value: below(u32::MAX.into())? as u32 as i32 }
        }
        Target::Output(index) => Immediate::SetOutput { index, closed: below(1)? == 1 },
        Target::Stop => Immediate::Stop(deceleration()?),
        Target::Kill => Immediate::Kill(deceleration()?),
        Target::AlarmReset => Immediate::ResetAlarm,
        Target::LoadProgram => Immediate::LoadProgram,
        Target::SaveSegment if value >= 1 => Immediate::SaveSegment(below(12)? as u8),
        Target::SaveSegment => return Err(VALUE),
        _ => return Err(NO_CALL),
    })
}

impl Calls {
    pub(super) fn new(port: Port) -> Calls {
        Calls { port, active: None, read: Kept::default(), loaded: Kept::default(), owed: false }
    }

    /// From now on the calls that command the drive are refused on submission, or not.
    pub(super) fn guard(&mut self, on: bool) {
        self.port.guard(on);
    }

    /// Ends the call under way if it was cancelled.
    pub(super) fn look(&mut self) {
        if let Some(active) = &mut self.active
            && let Some(posted) = active.posted.take_if(|posted| self.port.is_cancelled(posted))
        {
            self.port.end(&posted, Err(CallError::Cancelled));
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
            let Some(posted) = self.port.take() else { break };
            self.take_up(now, posted);
        }
        self.active.as_ref().is_some_and(|active| !active.sent)
    }

    fn take_up(&mut self, now: Time, posted: Posted) {
        let call = posted.call;
        let here = match call.service {
            SIZE | PART => self.read.answer(&posted).ok_or(NOT_READ),
            LOAD => self.loaded.load(&posted).ok_or(NOT_LOADED),
            _ => match Message::of(&call, self.loaded.whole(&posted)) {
                Ok(message) => {
                    let (until, commands) = (now + posted.limit_ns, self.port.commands(&posted));
                    let posted = Some(posted);
                    self.active =
                        Some(Active { posted, message, until, sent: false, commands, is_off: false });
                    return;
                }
                Err(status) => Err(status),
            },
        };
        self.port.end(&posted, here.map_err(CallError::Refused));
    }

    /// The call that is to be sent commands the drive, and whether that is without power is still open.
    pub(super) fn waits_for_power(&self) -> bool {
        self.active.as_ref().is_some_and(|active| !active.sent && active.commands && !active.is_off)
    }

    /// What the drive says of that; an error is its refusal.
    pub(super) fn power(&mut self, is_on: Result<bool, u32>) {
        match is_on {
            Ok(false) => self.active.iter_mut().for_each(|active| active.is_off = true),
            Ok(true) => self.end(Err(CallError::Commands)),
            Err(status) => self.end(Err(CallError::Refused(status))),
        }
    }

    /// Appends the message of the call that is to be sent, and returns when its answer is due at the latest. `None`: it
    /// was refused.
    pub(super) fn send(&mut self, end: &SessionEnd, out: &mut Vec<u8>) -> Option<Time> {
        let active = self.active.as_mut()?;
        if active.commands && !end.begin_commanding() {
            self.end(Err(CallError::Commands));
            return None;
        }
        active.sent = true;
        active.message.emit(out);
        Some(active.until)
    }

    /// Whether this can be the answer to the call that was sent.
    pub(super) fn fits(&self, reply: &Reply<'_>) -> bool {
        self.active.as_ref().is_some_and(|active| active.message.service() == reply.service)
    }

    /// The answer to the call that was sent.
    pub(super) fn answer(&mut self, end: &SessionEnd, reply: &Reply<'_>) {
        let Some(active) = &self.active else { return };
        let value = match active.message.value(reply.data) {
            _ if !reply.status.is_ok() => Err(refusal(reply.status)),
            Some(value) => Ok(value),
            None => Err(BROKEN),
        };
        if let (Message::Get(_), Some(posted), Ok(_)) = (&active.message, &active.posted, value) {
            self.read = Kept::of_read(posted, reply.data.len(), reply.data);
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
        self.owed |= self.active.as_ref().is_some_and(|active| active.sent && active.commands);
        self.end(Err(CallError::TimedOut));
    }

    /// A call that commands the drive may still be carried out, although nobody waits for it.
    pub(super) fn owes(&self) -> bool {
        self.owed
    }

    /// The drive has answered a later request.
    pub(super) fn settle(&mut self, end: &SessionEnd) {
        if self.owed {
            self.owed = false;
            end.end_commanding();
        }
    }

    /// There is no session, and none is being opened.
    pub(super) fn refuse_all(&mut self, why: CallError) {
        match &self.active {
            Some(active) if active.sent => self.silent(),
            _ => self.end(Err(why)),
        }
        self.port.refuse_all(why);
    }

    /// Ends the call under way before it was sent.
    pub(super) fn end(&mut self, result: Result<u64, CallError>) {
        if let Some(Active { posted: Some(posted), .. }) = self.active.take() {
            let Call { address, .. } = posted.call;
            self.port.end(&posted, result.map(|value| Answer { status: 0, address, value }));
        }
    }
}
