//! Acyclic calls on the connection of the cyclic exchange: each takes the place of one exchange now and then; the
//! other exchanges continue.

use super::notation::{NOT_TAKEN, READ, Target, UNREACHABLE, WRITE};
use super::parameter::{Addressing, Parameter, Width};
use super::wire::{RegistersBuffer, Request, Response};
use fieldbeat_core::axis::Link;
use fieldbeat_core::axis::acyclic::{Answer, Call, CallError, Commanding, Port, Posted};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// One exchange of so many may be a call, while the drive is on ...
const EVERY_ON: u32 = 4;
/// ... and while it is off.
const EVERY_OFF: u32 = 2;

/// The calls that command a drive whose cyclic outputs are `mapped`.
pub(super) fn commanding(mapped: impl IntoIterator<Item = Parameter>) -> Commanding {
    let key = |parameter| Target { parameter, width: Width::Word }.pack();
    Commanding::new(refusal, mapped.into_iter().map(key))
}

/// Why a call of the application is refused while the power of its drive is on: it writes a parameter that is
/// exchanged, or none that is known to be harmless.
fn refusal(call: &Call, mapped: &[u32]) -> Option<CallError> {
    let target = Target::unpack(call.address).filter(|_| call.service == WRITE)?;
    let is_mapped = mapped.contains(&Target { width: Width::Word, ..target }.pack());
    (is_mapped || !is_harmless(target.parameter)).then_some(CallError::Commands)
}

/// Written while power is on, it moves nothing, and changes no state: rates of ramps, thresholds, gains and limits. All
/// others may: the control word and the bits of menu 6, references and their selectors in menus 1, 3 and 4, trips and
/// resets of menu 10, xx.000, what menu 0 shows and its set-up in menu 22, the watchdog of an Ethernet interface. A
/// user program may take menus 18 to 20 for references, and of most parameters no public source says what they do:
/// those count as commanding, too.
const fn is_harmless(parameter: Parameter) -> bool {
    let Parameter { slot, menu, number } = parameter;
    slot == 0
        && matches!(
            (menu, number),
            // 01.006 is the maximum reference; 01.007, the minimum, would turn a motor.
            (1, 6) | (2, 11 | 21) | (3, 5..=8 | 10..=12) | (4, 5..=7)
        )
}

/// The calls to one drive.
#[derive(Debug)]
pub(super) struct Calls {
    port: Port,
    addressing: Addressing,
    active: Option<Active>,
    /// Exchanges since the last call.
    since: u32,
    /// A call that commands the drive was sent, and is not answered. Its ticket may be gone.
    owed: bool,
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
        Calls { port, addressing, active: None, since: 0, owed: false }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.port.memory(regions);
    }

    /// Starts the next call, and ends the finished one. True if the next exchange may be the call's. Calls that command
    /// a `guarded` drive are refused.
    #[inline]
    pub(super) fn advance(&mut self, now: Time, link: Link, on: bool, guarded: bool) -> bool {
        self.port.guard(guarded);
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
                false => self.port.refusal(&active.posted),
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
            self.owed = self.port.commands(&active.posted);
        }
    }

    /// A call of the application that commands the drive is under way.
    #[inline]
    pub(super) fn commands(&self) -> bool {
        self.owed || self.active.is_some_and(|active| self.port.commands(&active.posted))
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
        self.owed = false;
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

    /// The connection is gone: a sent request may have been carried out, or not. It is over before an enable on the
    /// next connection, whose handshake comes behind it (assumed: the drive answers in the order of arrival).
    pub(super) fn lost(&mut self) {
        self.owed = false;
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
