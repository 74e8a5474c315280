//! The handshake on a new connection before the loop gets it: it reads what the drive is and does. On a normal
//! thread, one request after the other.
//!
//! It reads the unit id, the serial number if that is configured, every cyclic parameter, and the drive's control
//! source and watchdog, all by FC03. Whether the drive has FC23 is shown by the first exchange that writes: a server
//! may ignore a request that is only made to find out, or close on it. It writes only the set-up of menu 0, and that
//! only to a drive that does not run.
//! The settings that make the drive follow the control word are written by the station, with the first command that
//! needs them.
//!
//! It is as patient as the exchange: a drive that is busy (exceptions 05 and 06) gets the same request again, and a
//! second reply to an earlier request is dropped. Both are counted.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::diagnosis::{BAD_VALUE, FAILED, MISFIT, NO_FUNCTION, REFUSED, SLOW, UNREACHED, WRONG_ID};
use super::mapping::{Block, Image, Mapping, Role};
use super::parameter::{DRIVE_UNIT, Parameter, Width};
use super::plan::UnidriveDrive;
use super::setup::{Purpose, Setting, settings};
use super::wire::{ADU_MAX, ExceptionCode, Header, RegistersBuffer, Request, Response, frame};
use super::words::{ControlWord, StatusWord};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::net::{Handshake, HandshakeState};
use fieldbeat_core::time::{MS, S, Time};

/// Ids of the handshake begin far from those of the exchange behind it: a second reply to the one is none to the other.
const FIRST_ID: u16 = 0x8000;
/// A drive that is busy gets its request again after so long, ns ...
const AGAIN_NS: u64 = 20 * MS;
/// ... for so many reply times.
pub(super) const BUSY_WITHIN: u64 = 4;

/// The findings of the handshake, for the station.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Finding {
    /// The unit id of the drive's answers.
    pub unit: u8,
    /// It shows the cyclic parameters in menu 0.
    pub menu_0: bool,
    /// It follows control word and reference.
    pub obeys: bool,
    /// The time-out is set.
    pub watched: bool,
    /// The control word that it had.
    pub control: ControlWord,
    /// The status word that it had.
    pub status: StatusWord,
    /// Replies to requests that had theirs already, since the connection before.
    pub duplicates: u16,
    /// Requests that it was too busy for, since then.
    pub busy: u16,
}

/// The findings of the last handshake: written before the connection is handed over, and read after that.
#[derive(Debug, Default)]
pub struct Found {
    /// Unit id, flags, control word and counts; status word.
    words: [AtomicU64; 2],
}

impl Found {
    /// The last finding.
    pub fn get(&self, log: &InputLog) -> Finding {
        let [bits, state] = &self.words;
        let bits = log.value(0, bits.load(Ordering::Acquire));
        let state = log.value(0, state.load(Ordering::Acquire));
        let flag = |bit: u32| bits >> bit & 1 != 0;
        Finding {
            unit: bits as u8,
            menu_0: flag(8),
            obeys: flag(9),
            watched: flag(10),
            control: ControlWord((bits >> 16) as u16),
            status: StatusWord(state as u16),
            duplicates: (bits >> 32) as u16,
            busy: (bits >> 48) as u16,
        }
    }

    /// For the handshake.
    pub fn set(&self, finding: Finding) {
        let Finding { unit, menu_0, obeys, watched, control, status, duplicates, busy } = finding;
        let flags = [menu_0, obeys, watched];
        let flags = flags.iter().enumerate().map(|(bit, flag)| u64::from(*flag) << (8 + bit)).sum::<u64>();
        let [bits, state] = &self.words;
        let counts = u64::from(duplicates) << 32 | u64::from(busy) << 48;
        bits.store(u64::from(unit) | flags | u64::from(control.0) << 16 | counts, Ordering::Release);
        state.store(status.0.into(), Ordering::Release);
    }
}

/// One step of the handshake: a request and the use of its answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    /// Which unit id answers.
    Unit,
    /// This part of its serial number.
    Serial(usize),
    /// Whether this block exists, and its values.
    Look(usize),
    /// The value of this setting.
    Find(usize),
    /// This setting of menu 0 is written ...
    Set(usize),
    /// ... and read back.
    Verify(usize),
    /// Menu 0 shows the configured parameters.
    Menu0,
}

/// The handshake of one drive.
#[derive(Debug)]
pub(super) struct UnidriveHandshake {
    drive: UnidriveDrive,
    /// The parameters at their own addresses: one that is missing there does not exist.
    direct: Mapping,
    /// The blocks of menu 0, if they are to be used.
    menu_0: Option<Mapping>,
    found: Arc<Found>,
    finding: Finding,
    /// Unit ids to try, and the present one.
    units: Vec<u8>,
    unit: usize,
    step: Step,
    /// The id of the last request; whether it has no reply yet, and a second one to an earlier request came in its
    /// place; and how many there were on this connection.
    transaction: u16,
    is_open: bool,
    is_mistaken: bool,
    requests: u16,
    /// There was a connection before.
    begun: bool,
    /// Since when the drive is busy, and when it gets its request again.
    busy_since: Option<Time>,
    again_at: Option<Time>,
    /// The lower part of its serial number.
    serial: u64,
    image: Image,
    settings: Vec<Setting>,
    /// The drive's value of each setting.
    has: Vec<Option<i32>>,
    inbox: Vec<u8>,
}

impl UnidriveHandshake {
    pub(super) fn new(
        drive: &UnidriveDrive,
        direct: Mapping,
        menu_0: Option<Mapping>,
        found: Arc<Found>,
    ) -> UnidriveHandshake {
        UnidriveHandshake {
            units: drive.unit.map_or(vec![DRIVE_UNIT, 0], |unit| vec![unit]),
            unit: 0,
            settings: settings(drive, menu_0.as_ref()),
            has: Vec::new(),
            drive: drive.clone(),
            direct,
            menu_0,
            found,
            finding: Finding::default(),
            step: Step::Unit,
            transaction: FIRST_ID,
            is_open: false,
            is_mistaken: false,
            requests: 0,
            begun: false,
            busy_since: None,
            again_at: None,
            serial: 0,
            image: Image::default(),
            inbox: Vec::with_capacity(ADU_MAX),
        }
    }

    /// The longest duration, ns: a request for each block and each setting, three for those of menu 0, each with
    /// the time limit of a reply; and the time that the drive may be busy.
    pub(super) fn longest_ns(&self) -> u64 {
        let menu_0 = self.settings.iter().filter(|setting| setting.purpose == Purpose::Menu0).count();
        let requests = 5 + self.direct.reads().len() + self.settings.len() + 2 * menu_0;
        S + (requests as u64 + BUSY_WITHIN) * self.drive.reply_within_ns
    }

    fn value(&self, role: Role) -> i32 {
        self.image.of(role).unwrap_or(0)
    }

    /// The request of the present step.
    fn request(&mut self, out: &mut Vec<u8>) -> HandshakeState {
        self.transaction = self.transaction.wrapping_add(1);
        (self.is_open, self.is_mistaken) = (true, false);
        self.requests = self.requests.saturating_add(1);
        let mut data = RegistersBuffer::new();
        let read = |parameter: Parameter, width: Width| {
            let address = parameter.address(self.drive.addressing, width)?;
            Some((parameter, Request::Read { address, count: width.registers() }))
        };
        let drive_unit = self.units[self.unit.min(self.units.len() - 1)];
        let request = match self.step {
            Step::Unit => read(self.drive.map.status.parameter, self.drive.map.status.width),
            Step::Serial(part) => {
                self.drive.serial_from.get(part).and_then(|parameter| read(*parameter, Width::Long))
            }
            Step::Look(index) => self.direct.reads().get(index).map(|block| (block.first, look(block))),
            Step::Menu0 => self
                .menu_0
                .as_ref()
                .and_then(|menu_0| menu_0.reads().first())
                .map(|block| (block.first, look(block))),
            Step::Find(index) | Step::Verify(index) => {
                self.settings.get(index).and_then(|setting| read(setting.parameter, setting.width))
            }
            Step::Set(index) => self
                .settings
                .get(index)
                .map(|setting| (setting.parameter, setting.write(setting.value, &mut data))),
        };
        let Some((parameter, request)) = request else {
            return HandshakeState::Failed("a parameter of its configuration has no address".into());
        };
        let header = Header { transaction: self.transaction, unit: parameter.unit(drive_unit) };
        let begin = out.len();
        out.resize(begin + request.size(), 0);
        request.emit(header, &mut out[begin..]);
        HandshakeState::More
    }

    /// The drive is busy: the same request follows later.
    fn is_busy(&mut self, now: Time, code: ExceptionCode) -> HandshakeState {
        self.finding.busy = self.finding.busy.saturating_add(1);
        let since = *self.busy_since.get_or_insert(now);
        if now.since(since) > BUSY_WITHIN * self.drive.reply_within_ns {
            return HandshakeState::Failed(format!("the drive is busy all the time: {code}"));
        }
        self.again_at = Some(now + AGAIN_NS);
        HandshakeState::More
    }

    /// One message, while `open` is the id of the last request that can have left.
    fn message(&mut self, now: Time, adu: &[u8], open: u16, out: &mut Vec<u8>) -> HandshakeState {
        let Ok((header, response)) = Response::parse(adu) else { return surprised() };
        let before = self.transaction.wrapping_sub(header.transaction);
        if before == 0 && self.is_open && header.transaction == open {
            self.is_open = false;
            return match response {
                Response::Exception { code, .. } if code.is_busy() => self.is_busy(now, code),
                _ => {
                    self.busy_since = None;
                    self.answer(response, out)
                }
            };
        }
        // Those of this connection have their replies, but for the open one.
        if before < self.requests && (before > 0 || !self.is_open) {
            self.finding.duplicates = self.finding.duplicates.saturating_add(1);
            self.is_mistaken = self.is_open;
            return HandshakeState::More;
        }
        // Without the numbers, so that it is the same line each time.
        HandshakeState::Failed(WRONG_ID.to_string())
    }

    /// Takes the answer of the present step, and continues with the next one.
    fn answer(&mut self, response: Response<'_>, out: &mut Vec<u8>) -> HandshakeState {
        let (values, refused) = match response {
            Response::Read { data } => (Some(data), None),
            Response::Exception { code, .. } => (None, Some(code)),
            _ => (None, None),
        };
        let next = match (self.step, refused) {
            (Step::Unit, Some(_)) if self.unit + 1 < self.units.len() => {
                self.unit += 1;
                Some(Step::Unit)
            }
            (Step::Unit, Some(code)) => {
                let row = match code {
                    ExceptionCode::NO_PATH | ExceptionCode::NO_RESPONSE => UNREACHED,
                    ExceptionCode::FUNCTION => NO_FUNCTION,
                    ExceptionCode::VALUE => BAD_VALUE,
                    ExceptionCode::DEVICE_FAILURE => FAILED,
                    _ => REFUSED,
                };
                return HandshakeState::Failed(row.with(&code));
            }
            (Step::Unit, None) => {
                self.finding.unit = self.units[self.unit];
                Some(if self.drive.serial.is_some() { Step::Serial(0) } else { Step::Look(0) })
            }
            (Step::Serial(part), _) => {
                let value = values.and_then(|data| data.long(0)).and_then(|value| u64::try_from(value).ok());
                let Some(value) = value else { return self.no_serial(part, refused) };
                if part == 0 {
                    self.serial = value;
                    Some(Step::Serial(1))
                } else if let Some(why) = self.is_another(self.serial + value * UnidriveDrive::SERIAL_PART) {
                    return HandshakeState::Failed(why);
                } else {
                    Some(Step::Look(0))
                }
            }
            (Step::Look(index), Some(code)) => {
                let block = &self.direct.reads()[index];
                let remedy = match code {
                    ExceptionCode::VALUE => "look at the bits in map, monitor and also_read",
                    ExceptionCode::DEVICE_FAILURE => "restart the drive and its option modules",
                    _ => "look at map, monitor and also_read, and at the addressing",
                };
                return HandshakeState::Failed(format!(
                    "the drive does not give {} ({} registers from it on): {code}; {remedy}",
                    block.first, block.registers
                ));
            }
            (Step::Look(index), None) => {
                let block = &self.direct.reads()[index];
                let Some(data) = values else { return surprised() };
                for (place, role) in block.roles.iter().enumerate() {
                    let Some(raw) = data.raw(block.width, place) else { return surprised() };
                    if let Some(index) = role.index() {
                        self.image.set(index, block.width.number(raw, true) as i32);
                    }
                }
                if index + 1 < self.direct.reads().len() {
                    Some(Step::Look(index + 1))
                } else {
                    Some(Step::Find(0))
                }
            }
            (Step::Find(index), refused) => {
                let value = values.and_then(|data| self.settings[index].read(data));
                if refused.is_none() && value.is_none() {
                    return surprised();
                }
                self.has.push(value);
                if index + 1 < self.settings.len() {
                    Some(Step::Find(index + 1))
                } else {
                    self.finding.control = ControlWord(self.value(Role::Control) as u16);
                    self.finding.status = StatusWord(self.value(Role::Status) as u16);
                    self.next_setting(0)
                }
            }
            (Step::Set(index), _) => Some(Step::Verify(index)),
            (Step::Verify(index), _) => {
                self.has[index] = values.and_then(|data| self.settings[index].read(data));
                self.next_setting(index + 1)
            }
            (Step::Menu0, Some(code)) => {
                return HandshakeState::Failed(format!(
                    "the drive does not give its menu 0 as it was set up: {code}; use via = \"direct\""
                ));
            }
            (Step::Menu0, None) => {
                self.finding.menu_0 = true;
                None
            }
        };
        match next {
            Some(step) => {
                self.step = step;
                self.request(out)
            }
            None => self.end(),
        }
    }

    /// It does not say which one it is.
    fn no_serial(&self, part: usize, refused: Option<ExceptionCode>) -> HandshakeState {
        let parameter = self.drive.serial_from[part.min(1)];
        let why = refused.map_or("no number".into(), |code| code.to_string());
        HandshakeState::Failed(format!(
            "the drive does not give Pr {parameter}, a part of its serial number: {why}; correct serial_from, \
             or leave serial out"
        ))
    }

    /// Why a drive with this serial number is not the one.
    fn is_another(&self, found: u64) -> Option<String> {
        let expected = self.drive.serial.filter(|expected| *expected != found)?;
        Some(format!(
            "its serial number is {found}, not {expected}: drives or cables are exchanged: put them back, or \
             correct serial for another drive"
        ))
    }

    /// Whether the drive may be set up now: menu 0 of a drive that runs is left alone.
    fn may_set(&self) -> bool {
        self.drive.set_up && !self.finding.status.active()
    }

    /// The step once the settings of menu 0 before this one stand; `None`: nothing.
    fn next_setting(&self, from: usize) -> Option<Step> {
        if let Some(index) = self.unmet(Purpose::Menu0, from).filter(|_| self.may_set()) {
            return Some(Step::Set(index));
        }
        (self.menu_0.is_some() && self.unmet(Purpose::Menu0, 0).is_none()).then_some(Step::Menu0)
    }

    /// The first setting for this purpose, from this one on, that the drive does not have.
    fn unmet(&self, purpose: Purpose, from: usize) -> Option<usize> {
        let differs = |index: &usize| {
            let setting = &self.settings[*index];
            setting.purpose == purpose && self.has.get(*index).copied().flatten() != Some(setting.value)
        };
        (from..self.settings.len()).find(differs)
    }

    fn end(&mut self) -> HandshakeState {
        if let Some(index) = self.unmet(Purpose::Menu0, 0).filter(|_| self.may_set()) {
            let setting = &self.settings[index];
            return HandshakeState::Failed(format!(
                "Pr {} does not take {}, so that menu 0 cannot show the cyclic parameters; use via = \
                 \"direct\"",
                setting.parameter, setting.value
            ));
        }
        self.finding.obeys = self.unmet(Purpose::Obey, 0).is_none();
        // Where nothing is to be set, nothing watches.
        self.finding.watched =
            self.drive.watchdog.timeout_ns.is_some() && self.unmet(Purpose::Watch, 0).is_none();
        HandshakeState::Done
    }

    /// The connection is the loop's.
    fn hand_over(&mut self) {
        self.found.set(self.finding);
        (self.finding.duplicates, self.finding.busy) = (0, 0);
    }
}

fn look(block: &Block) -> Request<'static> {
    Request::Read { address: block.address, count: block.registers }
}

fn surprised() -> HandshakeState {
    HandshakeState::Failed(MISFIT.to_string())
}

impl Handshake for UnidriveHandshake {
    fn begin(&mut self, _now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.inbox.clear();
        let Finding { duplicates, busy, .. } = self.finding;
        self.finding = Finding { duplicates, busy, ..Finding::default() };
        self.image = Image::default();
        self.has.clear();
        (self.requests, self.busy_since, self.again_at) = (0, None, None);
        if self.step == Step::Unit && std::mem::replace(&mut self.begun, true) {
            // No answer at all the last time: it may use another unit id.
            self.unit = (self.unit + 1) % self.units.len();
        }
        self.step = Step::Unit;
        self.request(out)
    }

    fn take(&mut self, now: Time, bytes: &[u8], out: &mut Vec<u8>) -> HandshakeState {
        let mut inbox = std::mem::take(&mut self.inbox);
        inbox.extend_from_slice(bytes);
        let (mut rest, mut is_done, open) = (&inbox[..], false, self.transaction);
        let state = loop {
            match frame(rest) {
                Ok(None) if is_done && !rest.is_empty() => break surprised(),
                Ok(None) if is_done => break HandshakeState::Done,
                Ok(None) => break HandshakeState::More,
                Ok(Some(size)) => {
                    let (adu, behind) = rest.split_at(size);
                    rest = behind;
                    match self.message(now, adu, open, out) {
                        HandshakeState::More => {}
                        HandshakeState::Done => is_done = true,
                        other => break other,
                    }
                }
                Err(error) => break HandshakeState::Failed(error.to_string()),
            }
        };
        let taken = inbox.len() - rest.len();
        inbox.drain(..taken);
        self.inbox = inbox;
        if state == HandshakeState::Done {
            self.hand_over();
        }
        state
    }

    fn next_due(&self) -> Option<Time> {
        self.again_at
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) -> HandshakeState {
        match self.again_at.take_if(|at| *at <= now) {
            Some(_) => self.request(out),
            None => HandshakeState::More,
        }
    }

    fn closed(&mut self, _now: Time, _why: &str) {
        self.again_at = None;
    }

    fn overdue(&self) -> Option<String> {
        let row = if self.is_mistaken { WRONG_ID } else { SLOW };
        (self.step != Step::Unit).then(|| row.to_string())
    }
}

#[cfg(test)]
mod tests;
