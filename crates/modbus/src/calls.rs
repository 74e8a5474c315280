//! Acyclic calls on the connection of the cyclic exchange: each takes the place of one exchange now and then; the
//! other exchanges continue.

use super::notation::{NOT_TAKEN, Service, Target, UNREACHABLE};
use super::parameter::{Addressing, Parameter, Width};
use super::wire::{REGISTERS_MAX, Registers, RegistersBuffer, Request, Response};
use fieldbeat_core::axis::Link;
use fieldbeat_core::axis::acyclic::long::{self, Target as _};
use fieldbeat_core::axis::acyclic::{Answer, Call, CallError, Commanding, Port, Posted};
use fieldbeat_core::bus;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// One exchange of so many may be a call, while the drive is on ...
const EVERY_ON: u8 = 4;
/// ... and while it is off.
const EVERY_OFF: u8 = 2;

/// Bytes of all parameters that one request reads or writes.
const BLOCK: usize = 2 * REGISTERS_MAX as usize;
/// The most calls that end in one cycle because they need no request: all those of one block.
const MOST_PARTS: usize = BLOCK / size_of::<u64>();

/// The calls that command a drive whose cyclic outputs are `mapped`.
pub(super) fn commanding(mapped: impl IntoIterator<Item = Parameter>) -> Commanding {
    let key = |parameter| Target { parameter, width: Width::Word }.pack();
    Commanding::new(refusal, mapped.into_iter().map(key))
}

/// Why a call of the application is refused while the power of its drive is on: it writes a parameter that is
/// exchanged, or none that is known to be harmless. Of a block none is written then.
fn refusal(call: &Call, mapped: &[u32]) -> Option<CallError> {
    let (target, written, several) = match Service::of(call)? {
        Service::Write(target, _) => (target, 1, false),
        Service::Store(target, bytes) => (target, bytes.div_ceil(target.width.bytes() as u64), true),
        _ => return None,
    };
    let commands = |place: &u64| {
        let parameter = u8::try_from(*place).ok().and_then(|place| target.parameter.offset(place));
        let is_mapped = |parameter| mapped.contains(&Target { parameter, width: Width::Word }.pack());
        parameter.is_none_or(|parameter| is_mapped(parameter) || !is_harmless(parameter))
    };
    // The first one that commands is soon found: few that do not follow one another.
    let place = (0..written).find(commands)?;
    Some(if several { CallError::CommandsAt(place as u32) } else { CallError::Commands })
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

/// The calls to one drive. What each preparation touches comes first: it lies on one line of the cache.
#[derive(Debug)]
#[repr(C)]
pub(super) struct Calls {
    /// Calls that command the drive are refused at present.
    guarded: bool,
    /// None is under way, nor may one that commands the drive still be carried out.
    is_idle: bool,
    addressing: Addressing,
    calls: bus::Calls<BLOCK>,
    active: Option<Active>,
}

#[derive(Clone, Copy, Debug)]
struct Active {
    posted: Posted,
    service: Service,
    target: Target,
    address: u16,
    /// Of all its parameters.
    registers: u16,
    begun: Time,
    sent: bool,
}

impl Calls {
    pub(super) fn new(port: Port, addressing: Addressing) -> Calls {
        let calls = bus::Calls::new(port, UNREACHABLE, UNREACHABLE);
        Calls { guarded: false, is_idle: true, addressing, calls, active: None }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.calls.memory(regions);
    }

    /// Starts the next call, and ends the finished one. Whether the next exchange may be the call's, with so many
    /// `since` the last call's, and whether one that commands the drive is under way. Those that command a `guarded`
    /// drive are refused.
    #[inline]
    pub(super) fn advance(
        &mut self,
        now: Time,
        link: Link,
        on: impl FnOnce() -> bool,
        since: u8,
        guarded: bool,
    ) -> (bool, bool) {
        if guarded != self.guarded {
            self.guarded = guarded;
            self.calls.guard(guarded);
        }
        // Usually there is none.
        if self.is_idle && self.calls.is_empty() {
            return (false, false);
        }
        let may_leave = self.go_on(now, link, since, on());
        self.note();
        (may_leave, self.commands())
    }

    /// Something has changed of the calls that are under way.
    fn note(&mut self) {
        self.is_idle = self.active.is_none() && !self.calls.is_unsettled();
    }

    #[inline(never)]
    fn go_on(&mut self, now: Time, link: Link, since: u8, on: bool) -> bool {
        let online = !matches!(link, Link::Unseen | Link::Lost);
        if !online {
            self.calls.refuse_all(CallError::NotOnline);
        }
        if let Some(Active { posted, begun, sent, .. }) = &self.active
            && let Some(why) = self.calls.over(posted, *begun, now, *sent, online)
        {
            if *sent && self.calls.commands(posted) {
                self.calls.doubt();
            }
            self.end(Err(why));
        }
        if self.active.is_none()
            && let Some(posted) = self.calls.next(MOST_PARTS)
        {
            self.active = self.begin(now, posted);
            if self.active.is_none() {
                self.calls.end(&posted, Err(CallError::Refused(UNREACHABLE)));
            }
        }
        let every = if on { EVERY_ON } else { EVERY_OFF };
        self.active.is_some_and(|active| !active.sent) && since >= every - 1
    }

    /// A call that needs a request; `None`: it has none.
    fn begin(&self, now: Time, posted: Posted) -> Option<Active> {
        let service = Service::of(&posted.call)?;
        let (target, parameters) = match service {
            Service::Read(target) | Service::Write(target, _) => (target, 1),
            Service::ReadSeveral(target, count) => (target, count),
            Service::Store(target, _) => {
                let (bytes, each) = (self.calls.loaded(&posted)?.len(), target.width.bytes());
                if !bytes.is_multiple_of(each) {
                    return None;
                }
                (target, (bytes / each) as u64)
            }
            _ => return None,
        };
        let each = target.width.registers();
        let registers = u16::try_from(parameters).ok()?.checked_mul(each);
        let registers = registers.filter(|registers| (1..=REGISTERS_MAX).contains(registers))?;
        // The last parameter of the block is one of the same menu.
        let last = target.parameter.offset((registers / each - 1) as u8)?;
        last.address(self.addressing, target.width)?;
        let address = target.parameter.address(self.addressing, target.width)?;
        Some(Active { posted, service, target, address, registers, begun: now, sent: false })
    }

    /// The request of the active call, and the unit id for it in a drive that is `drive` itself.
    pub(super) fn request<'a>(&self, drive: u8, data: &'a mut RegistersBuffer) -> Option<(u8, Request<'a>)> {
        let Active { posted, service, target, address, registers, .. } = self.active?;
        let unit = target.parameter.unit(drive);
        match service {
            Service::Write(_, raw) => data.push_raw(target.width, raw as u32),
            Service::Store(..) => data.push_all(self.calls.loaded(&posted).and_then(Registers::new)?),
            _ => return Some((unit, Request::Read { address, count: registers })),
        };
        Some((unit, Request::Write { address, data: data.registers() }))
    }

    /// The exchange of the active call went out.
    pub(super) fn sent(&mut self) {
        if let Some(active) = &mut self.active {
            active.sent = true;
        }
    }

    /// A call of the application that commands the drive is under way, or may still be carried out.
    fn commands(&self) -> bool {
        self.calls.is_unsettled()
            || self.active.as_ref().is_some_and(|active| self.calls.commands(&active.posted))
    }

    /// Whether this response can be that of the call that was sent.
    pub(super) fn fits(&self, response: &Response<'_>) -> bool {
        let Some(active) = self.active.filter(|active| active.sent) else { return true };
        let writes = active.service.writes();
        match *response {
            Response::Exception { .. } => true,
            Response::Read { data } => !writes && data.len() == usize::from(active.registers),
            Response::Written { address, count } => {
                writes && address == active.address && count <= active.registers
            }
            _ => false,
        }
    }

    /// The response to the call that was sent. It may have ended before.
    pub(super) fn answer(&mut self, response: &Response<'_>) {
        self.settle();
        let Some(active) = self.active.filter(|active| active.sent) else { return };
        let address = active.posted.call.address;
        let done = |value: u64| Ok(Answer { status: 0, address, value });
        let result = match (*response, active.service) {
            (Response::Exception { code, .. }, _) => Err(CallError::Refused(code.0.into())),
            (Response::Read { data }, Service::ReadSeveral(..)) => {
                self.calls.keep(&active.posted, data.bytes().len(), data.bytes());
                done(long::raw(data.bytes()))
            }
            // It has taken those in front of the first one that it refuses.
            (Response::Written { count, .. }, Service::Store(..)) => {
                let status = if count < active.registers { NOT_TAKEN } else { 0 };
                Ok(Answer { status, address, value: 2 * u64::from(count) })
            }
            (Response::Read { data }, _) => done(data.raw(active.target.width, 0).unwrap_or_default().into()),
            (Response::Written { count, .. }, _) if count < active.registers => {
                Err(CallError::Refused(NOT_TAKEN))
            }
            _ => done(active.posted.call.value),
        };
        self.end(result);
    }

    /// The connection is gone: a sent request may have been carried out, or not. It is over before an enable on the
    /// next connection, whose handshake comes behind it (assumed: the drive answers in the order of arrival).
    pub(super) fn lost(&mut self) {
        self.settle();
        if self.active.is_some_and(|active| active.sent) {
            self.end(Err(CallError::TimedOut));
        }
    }

    /// None that has ended is carried out any more.
    fn settle(&mut self) {
        self.calls.settle();
        self.note();
    }

    fn end(&mut self, result: Result<Answer, CallError>) {
        if let Some(active) = self.active.take() {
            self.calls.end(&active.posted, result);
        }
        self.note();
    }
}
