//! Scripted drives at the other end of one drive's acyclic access.

use std::time::Duration;

use super::super::plan::Numbers;
use super::super::target::{BROKEN, Kind, commanding};
use super::*;
use std::sync::Arc;

use fieldbeat_core::axis::acyclic::long::{LOAD, PART, READ, SIZE, STORE, Target as _, WRITE};
use fieldbeat_core::axis::acyclic::{Acyclic as Application, Call, CallTicket};
use fieldbeat_core::time::MS;

mod channels;
mod records;

const LIMIT: Duration = Duration::from_secs(5);
pub(super) const PKW: ParameterPath = ParameterPath::Pkw { pause: true };
pub(super) const MSAC1: ParameterPath =
    ParameterPath::Msac1 { slot: 0, index: 47, axis: 0, numbers: Numbers::FromTop };

/// A code as the address of a call.
pub(super) fn code(code: u16, sub: u8, kind: Kind) -> u32 {
    Target::Parameter(Parameter { code, sub, kind }).pack()
}

pub(super) const C0061: u32 = 61 << 8;
pub(super) const C0039_2: u32 = 39 << 8 | 2;

/// The telegram that left in a turn.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Sent {
    Exchange([u8; CHANNEL]),
    Msac1(Vec<u8>),
}

/// The access to a drive, and its application.
pub(super) struct Side {
    pub access: Acyclic,
    pub application: Application,
    pub now: Time,
    pub guarded: bool,
    last: Turn,
}

impl Side {
    pub fn new(path: ParameterPath) -> Side {
        let mut drive = LenzeDrive::new("l", 3);
        drive.parameters = path;
        Side::of(&drive)
    }

    pub fn of(drive: &LenzeDrive) -> Side {
        let (application, port) = Application::alone(64, commanding(), Arc::new(crate::notation::Codes));
        let access = Acyclic::new(drive, port);
        Side { access, application, now: Time(0), guarded: false, last: Turn::DataExchange }
    }

    pub fn post(&self, service: u32, address: u32, value: u64) -> CallTicket {
        self.application.post(Call { service, address, value }, LIMIT).expect("there is room")
    }

    pub fn read(&self, address: u32) -> CallTicket {
        self.post(READ, address, 0)
    }

    pub fn write(&self, address: u32, value: u64) -> CallTicket {
        self.post(WRITE, address, value)
    }

    pub fn series(&self, calls: &[(u32, u32, u64)]) -> Vec<CallTicket> {
        let call = |&(service, address, value): &_| Call { service, address, value };
        let calls: Vec<Call> = calls.iter().map(call).collect();
        self.application.post_series(&calls, LIMIT).expect("there is room")
    }

    /// The next telegram, a millisecond later, as a station sends it.
    pub fn turn(&mut self) -> Sent {
        self.now = self.now + MS;
        for _ in 0..2 {
            self.access.advance(self.now, Link::Online, true, self.guarded);
        }
        let msac1 = self.access.data_unit().filter(|_| self.last == Turn::DataExchange).map(<[u8]>::to_vec);
        self.last = if msac1.is_some() { Turn::Msac1 } else { Turn::DataExchange };
        let channel = *self.access.channel();
        self.access.sent(self.last);
        msac1.map_or(Sent::Exchange(channel), Sent::Msac1)
    }

    /// Turns of a drive, until the call has ended. `drive` answers what it gets; `None`: that is lost.
    pub fn until(
        &mut self,
        ticket: &mut CallTicket,
        mut channel: impl FnMut([u8; CHANNEL]) -> Option<[u8; CHANNEL]>,
        mut msac1: impl FnMut(&[u8]) -> Option<Reply>,
    ) -> Result<u64, CallError> {
        for _ in 0..20_000 {
            match self.turn() {
                Sent::Exchange(out) => match channel(out) {
                    Some(inputs) => self.access.channel_answered(&inputs),
                    None => self.access.lost(Turn::DataExchange),
                },
                Sent::Msac1(data) => match msac1(&data) {
                    Some(reply) => self.access.answered(self.now, reply.answer()),
                    None => self.access.lost(Turn::Msac1),
                },
            }
            if let Some(end) = ticket.poll() {
                return end.map(|answer| answer.value);
            }
        }
        panic!("a call without an end");
    }

    /// The same on the channel alone.
    pub fn by_channel(
        &mut self,
        ticket: &mut CallTicket,
        channel: impl FnMut([u8; CHANNEL]) -> Option<[u8; CHANNEL]>,
    ) -> Result<u64, CallError> {
        self.until(ticket, channel, |data| panic!("MSAC1 {data:02X?}"))
    }

    /// The same by MSAC1 alone.
    pub fn by_msac1(
        &mut self,
        ticket: &mut CallTicket,
        msac1: impl FnMut(&[u8]) -> Option<Reply>,
    ) -> Result<u64, CallError> {
        self.until(ticket, |out| (out == [0; CHANNEL]).then_some(out), msac1)
    }

    /// Turns without a call, answered with this.
    pub fn rest(&mut self, turns: usize, inputs: [u8; CHANNEL]) {
        for _ in 0..turns {
            match self.turn() {
                Sent::Exchange(_) => self.access.channel_answered(&inputs),
                Sent::Msac1(_) => self.access.answered(self.now, Answer::Acknowledged),
            }
        }
    }
}

/// The answer of a scripted drive to MSAC1.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Reply {
    Ack,
    Refused(u8),
    Data(Vec<u8>),
}

impl Reply {
    pub fn answer(&self) -> Answer<'_> {
        match self {
            Reply::Ack => Answer::Acknowledged,
            Reply::Refused(function) => Answer::Refused(*function),
            Reply::Data(data) => Answer::Data { high: false, data },
        }
    }
}

#[test]
fn without_a_path_a_call_is_refused_and_says_why() {
    let mut side = Side::new(ParameterPath::None);
    let mut ticket = side.read(C0061);
    let end = side.by_channel(&mut ticket, Some);
    assert_eq!(end, Err(CallError::Refused(NO_PATH)));
    let mut drive = LenzeDrive::new("l", 3);
    (drive.parameters, drive.user_prm) = (MSAC1, vec![0; 3]);
    let mut side = Side::of(&drive);
    for address in [C0061, Target::Record(Record { slot: 0, index: 1 }).pack()] {
        let mut ticket = side.read(address);
        assert_eq!(side.by_channel(&mut ticket, Some), Err(CallError::Refused(NO_DPV1)));
    }
    // And what is no call at all.
    let mut side = Side::new(PKW);
    for (service, address) in [(9, C0061), (READ, 0x0800_0000), (STORE, C0061), (PART, C0061)] {
        let mut ticket = side.post(service, address, 0);
        assert!(matches!(side.by_channel(&mut ticket, Some), Err(CallError::Refused(_))));
    }
    side.rest(2, [0; CHANNEL]);
    assert!(side.access.is_idle());
    // A drive that is not there gets no call.
    for path in [PKW, ParameterPath::Drivecom, MSAC1] {
        let mut side = Side::new(path);
        for (link, exchanges) in [(Link::Lost, true), (Link::Unseen, true), (Link::Online, false)] {
            let mut tickets = [side.read(C0061), side.write(C0039_2, 1)];
            side.access.advance(side.now, link, exchanges, false);
            for ticket in &mut tickets {
                assert_eq!(ticket.poll(), Some(Err(CallError::NotOnline)), "{path:?} {link:?}");
            }
        }
    }
}
