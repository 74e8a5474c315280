//! Acyclic access to one drive, as its station sees it: what rides on the drive's own turns, and nothing else does.
//!
//! A turn of a drive is one telegram. With a parameter channel (paths A and B) a call is 8 bytes of the outputs of
//! Data_Exchange, and its answer 8 bytes of the inputs, as often as it takes. With MSAC1 (path C) a call takes a turn
//! in place of Data_Exchange now and then: its data unit goes to the service access point of MSAC1, and what the drive
//! answers in that turn comes back here; never twice in a row, and never before a stop.
//!
//! The station calls, in each turn of its drive:
//!
//! 1. [`advance`](Acyclic::advance) with each build of the next telegram, maybe more than once for the same turn: takes
//!    the next call, ends those that are over. Built again, it is the same: what a telegram changes is changed by
//!    [`sent`](Acyclic::sent).
//! 2. [`channel`](Acyclic::channel), the bytes for the outputs, and [`data_unit`](Acyclic::data_unit), the data of an
//!    MSAC1 request if the turn is to be one.
//! 3. `sent` when the telegram has left: with Data_Exchange, or with the MSAC1 request. A telegram that is repeated is
//!    the same, and is not sent again here.
//! 4. One of [`channel_answered`](Acyclic::channel_answered), [`answered`](Acyclic::answered) and
//!    [`lost`](Acyclic::lost) when the telegram is closed.
//!
//! [`ended`](Acyclic::ended) follows when the drive has left Data_Exchange: its channel and its MSAC1 begin anew.
//!
//! One request is under way at a time. A write of which the drive may have received something is never sent again: if
//! its end cannot be found out, it times out. A call that has ended for the application leaves its request to be
//! finished here, so that no answer of it meets the next one.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the calls of one drive, and whose turn is theirs |
//! | `channel` | a job in the parameter channel: paths A and B |
//! | `transfer` | a record by MSAC1 |
//! | `request` | parameters by path C: a request in a record, and its response |
//! | `ends` | how what is under way goes on, and ends |

mod channel;
mod ends;
mod request;
#[cfg(test)]
mod tests;
mod transfer;

use self::channel::Channel;
use self::request::{BATCH, Requests};
use self::transfer::Transfer;

use super::line::Answer;
use super::plan::{CHANNEL, LenzeDrive, ParameterPath};
use super::target::{
    BROKEN, Kind, NO_CALL, NO_DPV1, NO_PATH, NO_TEXT, NOT_LOADED, NOT_READ, Parameter, Service, Target,
    UNREACHABLE,
};
use super::wire::base_mode::Format;
use super::wire::job::{Job, Raw};
use super::wire::msac1::Record;
use super::wire::{drivecom, pkw};
use fieldbeat_core::axis::Link;
use fieldbeat_core::axis::acyclic::{CallError, Integer, Port, Posted};
use fieldbeat_core::bus::Calls;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{S, Time};

/// One turn of so many may be an MSAC1 request, while the power of the drive is on or coming on ...
const EVERY_ON: u32 = 4;
/// ... and while it is off.
const EVERY_OFF: u32 = 2;
/// A request whose calls have ended is given up after so long, ns.
const LEFT_NS: u64 = 2 * S;
/// The most calls about the value of a series that end in one turn.
const MOST_PARTS: usize = 32;

/// The use of a turn of the drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Turn {
    /// Data_Exchange, with the channel in it.
    DataExchange,
    /// An MSAC1 request.
    Msac1,
}

/// The value that a call has read, and its kind as the drive says: [`Kind::Own`] if it says nothing.
type Read = (u64, Kind);

/// The acyclic access to one drive.
#[derive(Debug)]
#[repr(C, align(64))] // What each exchange looks at is on one cache line.
pub(super) struct Acyclic {
    /// A request is under way, a call waits, or the channel has to be sent.
    is_busy: bool,
    /// Calls that command the drive are refused.
    guarded: bool,
    calls: Calls,
    channel: Channel,
    work: Box<Work>,
}

/// The state that is touched only while there is a call.
#[derive(Debug)]
struct Work {
    path: ParameterPath,
    has_dpv1: bool,
    /// Turns since the last one of MSAC1.
    since: u32,
    /// The next turn may be one.
    is_open: bool,
    active: Option<Active>,
    transfer: Transfer,
    requests: Requests,
}

/// The kind of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    /// A job in the channel.
    Channel(Job),
    /// A record is read, or written.
    Record(Record),
    /// A parameter request, or the reading of its response.
    Request { response: bool },
    /// The drive takes no request: a response to an earlier one, which nobody has read, is read first.
    Unread,
}

/// The request under way.
#[derive(Debug)]
struct Active {
    way: Way,
    writes: bool,
    commands: bool,
    /// A job of the channel has left.
    is_out: bool,
    begun: Time,
    /// The last of its calls has ended.
    left: Option<Time>,
    /// The calls, in their order; the place of one that has ended is empty.
    calls: [Option<Posted>; BATCH],
}

impl Active {
    /// The drive may have received what matters of it.
    fn is_sent(&self, transfer: &Transfer) -> bool {
        match self.way {
            Way::Channel(_) => self.is_out,
            Way::Request { response: true } => true,
            Way::Unread => false,
            Way::Record(_) | Way::Request { response: false } => transfer.is_sent,
        }
    }
}

impl Acyclic {
    /// That of `drive`.
    pub(super) fn new(drive: &LenzeDrive, port: Port) -> Acyclic {
        // Without a channel in the process data there is no path in it.
        let is_missing = drive.parameters.is_channel() && !drive.channel;
        let path = if is_missing { ParameterPath::None } else { drive.parameters };
        let work = Work {
            path,
            has_dpv1: drive.has_dpv1(),
            since: 0,
            is_open: false,
            active: None,
            transfer: Transfer::new(),
            requests: Requests::new(path),
        };
        let calls = Calls::new(port, NOT_READ, NOT_LOADED);
        Acyclic { is_busy: true, guarded: false, calls, channel: Channel::new(path), work: Box::new(work) }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.calls.memory(regions);
        regions.add(&*self.work);
    }

    /// Nothing is to be done: no call runs, and none is posted. Checked in each turn, so that nothing else is.
    #[inline]
    pub(super) fn is_idle(&self) -> bool {
        !self.is_busy && self.calls.is_empty()
    }

    /// A call runs, or the channel has to be sent.
    #[inline]
    pub(super) fn is_busy(&self) -> bool {
        self.is_busy
    }

    /// Nothing is to be done either for calls that command the drive: they are refused, or not, as it knows.
    #[inline]
    pub(super) fn is_idle_as(&self, guarded: bool) -> bool {
        self.guarded == guarded && self.is_idle()
    }

    /// Takes the next call, and ends those that are over. `guarded`: calls that command the drive are refused.
    /// `exchanges`: the drive is in Data_Exchange.
    pub(super) fn advance(&mut self, now: Time, link: Link, exchanges: bool, guarded: bool) {
        self.guarded = guarded;
        self.calls.guard(guarded);
        let online = exchanges && !matches!(link, Link::Unseen | Link::Lost);
        if !online {
            self.calls.refuse_all(CallError::NotOnline);
        }
        self.look(now, online);
        if self.work.active.is_none()
            && let Some(posted) = self.calls.next(MOST_PARTS)
        {
            match self.way(&posted) {
                Ok(way) => self.begin(now, way, posted),
                Err(status) => self.calls.end(&posted, Err(CallError::Refused(status))),
            }
        }
        let Work { active, transfer, since, is_open, .. } = &mut *self.work;
        if let Some(Active { way: Way::Channel(job), .. }) = active {
            self.channel.begin(*job);
        }
        let every = if guarded { EVERY_ON } else { EVERY_OFF };
        *is_open = since.saturating_add(1) >= every && now >= transfer.not_before;
        self.is_busy = active.is_some() || !self.channel.is_free();
    }

    /// Ends the calls under way that are over.
    fn look(&mut self, now: Time, online: bool) {
        let Work { active, transfer, requests, .. } = &mut *self.work;
        let Some(of) = active else { return };
        let is_sent = of.is_sent(transfer);
        let mut changed = false;
        for place in &mut of.calls {
            let Some(posted) = place else { continue };
            // A read changes nothing, whatever the drive has received of it.
            let is_lost = !online && !of.writes;
            let over = self.calls.over(posted, of.begun, now, is_sent, online);
            if let Some(why) = over.or(is_lost.then_some(CallError::NotOnline)) {
                self.calls.end(posted, Err(why));
                (*place, changed) = (None, true);
            }
        }
        let nobody_waits = of.calls.iter().all(Option::is_none);
        if nobody_waits {
            let left = *of.left.get_or_insert(now);
            if !is_sent || now.since(left) > LEFT_NS {
                match of.way {
                    Way::Channel(_) => self.channel.clear(None),
                    Way::Record(_) | Way::Request { .. } | Way::Unread => transfer.abandoned(),
                }
                *active = None;
            }
        } else if changed && !is_sent && matches!(of.way, Way::Request { .. }) {
            // Nothing of those that have ended is sent.
            requests.build(&of.calls, of.writes, &self.calls, transfer);
            of.commands = of.calls.iter().flatten().any(|posted| self.calls.commands(posted));
        }
    }

    /// How a call is carried out; an error is its status.
    fn way(&mut self, posted: &Posted) -> Result<Way, u32> {
        let Work { path, has_dpv1, transfer, requests, .. } = &mut *self.work;
        let several = |service: &Service| matches!(service, Service::ReadSeveral(..));
        let service = Service::of(&posted.call).filter(|service| !several(service)).ok_or(NO_CALL)?;
        let msac1 = || if *has_dpv1 { Ok(()) } else { Err(NO_DPV1) };
        let parameter = match (service, service.target()) {
            (_, Target::Parameter(parameter)) => parameter,
            (Service::Read(_), Target::Record(record)) => {
                msac1()?;
                transfer.read(record);
                return Ok(Way::Record(record));
            }
            (Service::Store(..), Target::Record(record)) => {
                msac1()?;
                let bytes = self.calls.loaded(posted).ok_or(NOT_LOADED)?;
                let fits = transfer.write(record, |out| out.bytes(bytes));
                return if fits { Ok(Way::Record(record)) } else { Err(NOT_LOADED) };
            }
            (_, Target::Record(_)) => return Err(NO_CALL),
        };
        let Parameter { code, sub, .. } = parameter;
        match (*path, parameter.kind().integer(), service) {
            (ParameterPath::None, ..) => Err(NO_PATH),
            // Numbers are written by a call, texts by a series.
            (_, Some(_), Service::Store(..)) | (_, None, Service::Write(..)) => Err(NO_CALL),
            (ParameterPath::Msac1 { .. }, ..) => {
                msac1()?;
                match service {
                    _ if !requests.reaches(parameter) => Err(UNREACHABLE),
                    Service::Store(..) if self.calls.loaded(posted).is_none() => Err(NOT_LOADED),
                    _ => Ok(Way::Request { response: false }),
                }
            }
            (_, None, _) => Err(NO_TEXT),
            (ParameterPath::Pkw { .. }, ..) if code > pkw::CODE_MAX => Err(UNREACHABLE),
            (ParameterPath::Drivecom, ..) if drivecom::index_of(code).is_none() => Err(UNREACHABLE),
            (_, Some(Integer { bits, .. }), service) => {
                let write = if let Service::Write(_, raw) = service { Some(raw as u32) } else { None };
                Ok(Way::Channel(Job { code, sub, bits, write }))
            }
        }
    }

    fn begin(&mut self, now: Time, way: Way, posted: Posted) {
        let mut of = Active {
            way,
            writes: Service::written(&posted.call).is_some(),
            commands: self.calls.commands(&posted),
            is_out: false,
            begun: now,
            left: None,
            calls: [None; BATCH],
        };
        of.calls[0] = Some(posted);
        if matches!(way, Way::Request { .. }) {
            let Acyclic { calls, work, .. } = self;
            let Work { transfer, requests, .. } = &mut **work;
            for place in of.calls.iter_mut().skip(1) {
                *place = calls.take_if(|other| requests.joins(&posted, other));
                let Some(posted) = place else { break };
                of.commands |= calls.commands(posted);
            }
            requests.begin(&posted);
            requests.build(&of.calls, of.writes, calls, transfer);
        }
        self.work.active = Some(of);
    }

    /// A call of the application that commands the drive is under way.
    #[inline]
    pub(super) fn commands(&self) -> bool {
        self.work.active.as_ref().is_some_and(|of| of.commands)
    }

    /// The parameter channel in the outputs.
    #[inline]
    pub(super) fn channel(&self) -> &[u8; CHANNEL] {
        self.channel.out()
    }

    /// The data of an MSAC1 request, in place of the next Data_Exchange; `None`: there is none to send. Empty: a poll
    /// for the answer.
    #[inline]
    pub(super) fn data_unit(&self) -> Option<&[u8]> {
        // Usually there is none.
        if !self.is_busy || !self.work.is_open {
            return None;
        }
        let way = self.work.active.as_ref()?.way;
        (!matches!(way, Way::Channel(_))).then(|| self.work.transfer.data())
    }

    /// The telegram of this turn has left.
    #[inline]
    pub(super) fn sent(&mut self, turn: Turn) {
        match turn {
            Turn::DataExchange => {
                self.work.since = self.work.since.saturating_add(1);
                let has_job = self.channel.sent();
                if let Some(of) = &mut self.work.active {
                    of.is_out |= has_job;
                }
            }
            Turn::Msac1 => {
                (self.work.since, self.work.is_open) = (0, false);
                self.work.transfer.sent();
            }
        }
    }

    /// Data_Exchange was answered, with this channel in its inputs.
    #[inline]
    pub(super) fn channel_answered(&mut self, channel: &[u8; CHANNEL]) {
        let Some(ended) = self.channel.answered(channel) else { return };
        // The reply to a write says nothing of its value.
        let reading = self.work.active.as_ref().filter(|of| !of.writes);
        let read = reading.and_then(|of| request::parameter(of.calls.first()?.as_ref()?));
        self.finish_all(ended.and_then(|Raw { bits, raw }| match read {
            Some(read) => {
                let (raw, kind) = read.reported(Format::of_bits(bits).ok_or(BROKEN)?, raw.into())?;
                Ok((raw.into(), kind))
            }
            None => Ok((raw.into(), Kind::Own)),
        }));
    }

    /// The telegram of this turn was not answered, with all its repetitions: the drive may have received it. A job in
    /// the channel stays where it is.
    pub(super) fn lost(&mut self, turn: Turn) {
        if turn == Turn::Msac1 {
            self.work.transfer.lost();
        }
    }

    /// The drive has left Data_Exchange, or is set up anew.
    pub(super) fn ended(&mut self) {
        self.channel.reset();
        self.is_busy = true;
        let Work { active, transfer, .. } = &mut *self.work;
        let Some(of) = active else { return };
        if of.is_sent(transfer) {
            let why = if of.writes { CallError::TimedOut } else { CallError::Restarted };
            self.finish(|_, _| Err(why));
        } else {
            transfer.anew();
        }
    }
}
