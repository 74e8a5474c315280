//! Acyclic calls on the connection of the cyclic exchange: each takes the place of one exchange now and then; the
//! other exchanges continue.

use super::notation::{NOT_TAKEN, READ, Target, UNREACHABLE, WRITE};
use super::parameter::{Addressing, Width};
use super::wire::{RegistersBuffer, Request, Response};
use crate::axis::Link;
use crate::axis::acyclic::{Answer, CallError, Port, Posted};
use crate::rt::Regions;
use crate::time::Time;

/// One exchange of so many may be a call, while the drive is on ...
const EVERY_ON: u32 = 4;
/// ... and while it is off.
const EVERY_OFF: u32 = 2;

/// The calls to one drive.
#[derive(Debug)]
pub(super) struct Calls {
    port: Port,
    addressing: Addressing,
    active: Option<Active>,
    /// Exchanges since the last call.
    since: u32,
}

#[derive(Clone, Copy, Debug)]
struct Active {
    posted: Posted,
    target: Target,
    address: u16,
    writes: bool,
    begun: Time,
    sent: bool,
}

impl Calls {
    pub(super) fn new(port: Port, addressing: Addressing) -> Calls {
        Calls { port, addressing, active: None, since: 0 }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.port.memory(regions);
    }

    /// Starts the next call, and ends the finished one. True if the next exchange may be the call's.
    #[inline]
    pub(super) fn advance(&mut self, now: Time, link: Link, on: bool) -> bool {
        // Usually there is none.
        (self.active.is_some() || !self.port.is_empty()) && self.go_on(now, link, on)
    }

    fn go_on(&mut self, now: Time, link: Link, on: bool) -> bool {
        if matches!(link, Link::Unseen | Link::Lost) {
            self.port.refuse_all(CallError::NotOnline);
        }
        if let Some(active) = &self.active {
            let over = match active.sent {
                _ if now.since(active.begun) > active.posted.limit_ns => Some(CallError::TimedOut),
                _ if self.port.is_cancelled(&active.posted) => Some(CallError::Cancelled),
                false if matches!(link, Link::Unseen | Link::Lost) => Some(CallError::NotOnline),
                _ => None,
            };
            if let Some(why) = over {
                self.end(Err(why));
            }
        }
        if self.active.is_none()
            && let Some(posted) = self.port.take()
        {
            self.take_up(now, posted);
        }
        let every = if on { EVERY_ON } else { EVERY_OFF };
        self.active.is_some_and(|active| !active.sent) && self.since + 1 >= every
    }

    fn take_up(&mut self, now: Time, posted: Posted) {
        let call = posted.call;
        let target = Target::unpack(call.address);
        let address = target.and_then(|target| target.parameter.address(self.addressing, target.width));
        match (target, address) {
            (Some(target), Some(address)) if matches!(call.service, READ | WRITE) => {
                let writes = call.service == WRITE;
                self.active = Some(Active { posted, target, address, writes, begun: now, sent: false });
            }
            _ => self.port.end(&posted, Err(CallError::Refused(UNREACHABLE))),
        }
    }

    /// The request of the active call, and the unit id for it in a drive that is `drive` itself.
    pub(super) fn request<'a>(&self, drive: u8, data: &'a mut RegistersBuffer) -> Option<(u8, Request<'a>)> {
        let Active { posted, target, address, writes, .. } = self.active?;
        let unit = target.parameter.unit(drive);
        if !writes {
            return Some((unit, Request::Read { address, count: target.width.registers() }));
        }
        let raw = posted.call.value as u32;
        match target.width {
            Width::Word => data.push_word(raw as u16),
            Width::Long => data.push_long(raw as i32),
        };
        Some((unit, Request::Write { address, data: data.registers() }))
    }

    /// An exchange went out; the active call's, or a cyclic one.
    pub(super) fn sent(&mut self, call: bool) {
        self.since = if call { 0 } else { self.since.saturating_add(1) };
        if let Some(active) = self.active.as_mut().filter(|_| call) {
            active.sent = true;
        }
    }

    /// Whether this response can be that of the call that was sent.
    pub(super) fn fits(&self, response: &Response<'_>) -> bool {
        let Some(active) = self.active.filter(|active| active.sent) else { return true };
        match *response {
            Response::Exception { .. } => true,
            Response::Read { data } => {
                !active.writes && data.len() == usize::from(active.target.width.registers())
            }
            Response::Written { address, count } => {
                active.writes && address == active.address && count <= active.target.width.registers()
            }
            _ => false,
        }
    }

    /// The response to the call that was sent. It may have ended before.
    pub(super) fn answer(&mut self, response: &Response<'_>) {
        let Some(active) = self.active.filter(|active| active.sent) else { return };
        let address = active.posted.call.address;
        let done = |value: u64| Ok(Answer { status: 0, address, value });
        self.end(match *response {
            Response::Exception { code, .. } => Err(CallError::Refused(code.0.into())),
            Response::Read { data } => match active.target.width {
                Width::Word => done(u64::from(data.word(0).unwrap_or_default())),
                Width::Long => done(u64::from(data.long(0).unwrap_or_default() as u32)),
            },
            Response::Written { count, .. } if count < active.target.width.registers() => {
                Err(CallError::Refused(NOT_TAKEN))
            }
            _ => done(active.posted.call.value),
        });
    }

    /// The connection is gone: a sent request may have been carried out, or not.
    pub(super) fn lost(&mut self) {
        if self.active.is_some_and(|active| active.sent) {
            self.end(Err(CallError::TimedOut));
        }
    }

    fn end(&mut self, result: Result<Answer, CallError>) {
        if let Some(active) = self.active.take() {
            self.port.end(&active.posted, result);
        }
    }
}
