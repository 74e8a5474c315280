//! The mailbox client against simulated slaves, a slot a millisecond, with frames lost on either way.

mod calls;
mod late;
mod others;
mod server;

use std::sync::Arc;
use std::time::Duration;

use self::server::{Server, coe, message};
use crate::{foreign, only};
use fieldbeat_core::axis::Link;
use fieldbeat_core::axis::acyclic::{Acyclic, Call, CallError, CallTicket, Commanding, Port};
use fieldbeat_core::bus::Counters;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{MS, S, Time};
use fieldbeat_ethercat::counters::Own;
use fieldbeat_ethercat::object::long::Target as _;
use fieldbeat_ethercat::object::number::{DEVICE_NAME as NAME, DEVICE_TYPE, MODE, STATUS_WORD};
use fieldbeat_ethercat::object::{self, READ, Target, WRITE, long};
use fieldbeat_ethercat::plan::{Area, SlavePlan};
use fieldbeat_ethercat::service::active::ATTEMPTS;
use fieldbeat_ethercat::service::sdo::{Failure, KEPT};
use fieldbeat_ethercat::service::*;
use fieldbeat_ethercat::slot;
use fieldbeat_ethercat::slot::{Answers, Ask};
use fieldbeat_ethercat::wire::frame::{BROADCAST, Builder, Command, FRAME_MAX, datagrams, position};
use fieldbeat_ethercat::wire::mailbox::Emergency;
use fieldbeat_ethercat::wire::registers::{SyncManager, address};
use fieldbeat_ethercat::wire::sdo::{AbortCode, Object};
use fieldbeat_sim::ethercat::sii::{Contents, Mailboxes};
use fieldbeat_sim::ethercat::{Application, Dialect, Drive, DriveSettings, Esc, Segment, Settings};

const STATION: u16 = 0x1001;
const LIMIT: Duration = Duration::from_secs(1);

/// The fate of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    Returns,
    /// Lost before the slave.
    NeverArrives,
    /// Lost behind it.
    NeverReturns,
}

struct Bench {
    line: Segment,
    service: Service,
    acyclic: Acyclic,
    counters: Counters,
    now: Time,
    link: Link,
    guarded: bool,
    /// Of the next frames that carry something.
    fates: Vec<Fate>,
    /// The requests, frame by frame.
    frames: Vec<Vec<Command>>,
    repeat: Repeat,
    /// The last repeat request that it acknowledged and did not carry out.
    toggle: u8,
}

/// The reaction of a slave to repeat requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Repeat {
    /// It sends the message again.
    Supported,
    /// They can be written, and nothing comes of it.
    Ignored,
    /// It acknowledges them and sends nothing.
    Acknowledged,
}

/// The slave may take so long for an answer.
const ANSWER_NS: u64 = 700 * MS;

fn plan(length: u16) -> SlavePlan {
    let areas = [0x1800, 0x1C00].map(|start| Area { start, length });
    SlavePlan { mailbox: Some(areas), sdo_timeout_ns: ANSWER_NS, ..SlavePlan::new(0) }
}

/// A queue that nobody posts to.
fn no_calls() -> Port {
    Acyclic::alone(1, Commanding::none(), Arc::new(object::Objects)).1
}

impl Bench {
    /// One slave with mailboxes of this length, in PREOP.
    fn new(length: u16, application: Box<dyn Application>) -> Bench {
        let mailboxes = Mailboxes { out: (0x1800, length), input: (0x1C00, length), protocols: 4 };
        let sii = Contents { mailboxes: Some(mailboxes), ..Contents::default() }.image();
        let (acyclic, port) = Acyclic::alone(32, object::commanding([]), Arc::new(object::Objects));
        let mut bench = Bench {
            line: Segment::new(vec![Esc::new(Settings { sii, ..Settings::default() }, application)]),
            service: Service::new(&plan(length), port, 0),
            acyclic,
            counters: Counters::default(),
            now: Time(S),
            link: Link::Online,
            guarded: false,
            fates: Vec::new(),
            frames: Vec::new(),
            repeat: Repeat::Supported,
            toggle: 0,
        };
        bench.write(Command::Apwr(position(0), address::STATION), &STATION.to_le_bytes());
        for (n, start, control) in
            [(0, 0x1800, SyncManager::MAILBOX_OUT), (1, 0x1C00, SyncManager::MAILBOX_IN)]
        {
            let manager = SyncManager { start, length, control, activate: 1 };
            bench.write(Command::Fpwr(STATION, address::sync_manager(n)), &manager.to_bytes());
        }
        bench.write(Command::Fpwr(STATION, address::AL_CONTROL), &[2, 0]);
        bench.service.open(true);
        bench
    }

    fn drive(change: impl FnOnce(&mut DriveSettings)) -> Bench {
        let mut settings = DriveSettings::new(fieldbeat_ethercat::object::Family::S700);
        change(&mut settings);
        Bench::new(16, Box::new(Drive::new(settings)))
    }

    fn server(length: u16, objects: &[(Object, &[u8])]) -> (Bench, Server) {
        let server = Server::new(length.into());
        server.shared().objects = objects.iter().map(|(object, data)| (*object, data.to_vec())).collect();
        (Bench::new(length, Box::new(server.clone())), server)
    }

    fn write(&mut self, command: Command, data: &[u8]) {
        let frame = foreign(self.now, command, data, |now, frame| self.line.pass(now, frame));
        assert_eq!(only(&frame).1, 1);
    }

    /// One slot.
    fn step(&mut self) {
        self.now = self.now + MS;
        self.service.advance(self.now, self.link, self.guarded);
        let (mut ask, mut again) = (Ask::default(), Ask::default());
        self.service.request(self.now, &mut ask);
        self.service.request(self.now, &mut again);
        let of = |ask: &Ask| -> Vec<_> { ask.datagrams().map(|(c, data)| (c, data.to_vec())).collect() };
        assert_eq!(of(&ask), of(&again), "called again, it requests the same");
        self.line.advance(self.now);
        if ask.is_empty() {
            return;
        }
        self.frames.push(ask.datagrams().map(|(command, _)| command).collect());
        let fate = if self.fates.is_empty() { Fate::Returns } else { self.fates.remove(0) };
        let mut frame = [0; FRAME_MAX];
        let mut builder = Builder::new(&mut frame, BROADCAST, [0x10; 6]).unwrap();
        for (command, data) in ask.datagrams() {
            builder.push_with(command, 7, data).unwrap();
        }
        let length = builder.finish();
        let toggle = ask.datagrams().find(|(command, _)| *command == Command::Fpwr(STATION, 0x080E));
        let is_ignored = toggle.is_some() && self.repeat != Repeat::Supported;
        if let Some((_, &[activate])) = toggle.filter(|_| fate != Fate::NeverArrives) {
            self.toggle = activate & 2;
        }
        if fate != Fate::NeverArrives && !is_ignored {
            self.line.pass(self.now, &mut frame[..length]);
        }
        let first = datagrams(&frame[..length]).unwrap().next().unwrap().unwrap();
        let is_status = first.command() == Some(Command::Fprd(STATION, 0x080D));
        if is_status && self.repeat == Repeat::Acknowledged {
            let at = first.place.data().start;
            frame[at + 1..at + 3].fill(1 | self.toggle);
        }
        let mut answers: Answers<'_> = [None; slot::DATAGRAMS];
        if fate == Fate::Returns {
            for (answer, datagram) in answers.iter_mut().zip(datagrams(&frame[..length]).unwrap()) {
                let datagram = datagram.unwrap();
                let working_counter = datagram.working_counter + u16::from(is_ignored);
                *answer = Some(slot::Answer { working_counter, data: datagram.data });
            }
        }
        self.service.receive(self.now, &answers, &mut self.counters);
    }

    fn steps(&mut self, count: usize) {
        (0..count).for_each(|_| self.step());
    }

    /// A transfer of the master, to its end.
    fn transfer(&mut self, begin: impl FnOnce(&mut Service)) -> Result<u32, Failure> {
        assert!(self.service.is_free());
        begin(&mut self.service);
        for _ in 0..3_000 {
            if let Some(end) = self.service.take_end() {
                return end;
            }
            assert!(!self.service.is_free());
            self.step();
        }
        panic!("it never ends");
    }

    fn read(&mut self, object: Object) -> Result<u32, Failure> {
        self.transfer(|service| service.read(object))
    }

    fn set(&mut self, object: Object, byte: u8) -> Result<u32, Failure> {
        self.transfer(|service| service.write(object, &[byte]))
    }

    fn post(&self, service: u32, address: &str, value: u64) -> CallTicket {
        let address = Target::parse(address).unwrap().pack();
        self.acyclic.post(Call { service, address, value }, LIMIT).unwrap()
    }

    fn wait(&mut self, mut ticket: CallTicket) -> Result<u64, CallError> {
        for _ in 0..2_000 {
            if let Some(end) = ticket.poll() {
                return end.map(|answer| answer.value);
            }
            self.step();
        }
        panic!("it never ends");
    }

    fn call(&mut self, service: u32, address: &str, value: u64) -> Result<u64, CallError> {
        let ticket = self.post(service, address, value);
        self.wait(ticket)
    }

    fn own(&self, own: Own) -> u64 {
        self.counters.own[own as usize]
    }
}

#[test]
fn a_drive_is_read_and_written_in_both_dialects() {
    for dialect in [Dialect::Standard, Dialect::Manual] {
        let mut bench = Bench::drive(|settings| settings.dialect = dialect);
        for _ in 0..20 {
            assert_eq!(bench.read(Object::new(0x1018, 1)), Ok(0x6A), "{dialect:?}");
        }
        assert_eq!(bench.set(MODE, 7), Ok(7));
        assert_eq!((bench.read(MODE), bench.call(READ, "0x6060:0", 0)), (Ok(7), Ok(7)));
        assert_eq!(bench.call(WRITE, "0x6060:0", 3), Ok(3));
        assert_eq!(bench.read(MODE), Ok(3));
        let faults = [Own::MailboxStrays, Own::MailboxBroken, Own::MailboxSilent, Own::MailboxRepeats];
        assert_eq!(faults.map(|own| bench.own(own)), [0; 4], "{dialect:?}");
        // A refusal names its code.
        let code = AbortCode::NO_OBJECT;
        assert_eq!(bench.read(Object::new(0x5FFF, 1)), Err(Failure::Abort(code)));
        assert_eq!(bench.call(READ, "0x5FFF:1", 0), Err(CallError::Refused(code.0)));
        assert_eq!(bench.own(Own::Aborts), 2);
        let not_complete = Err(CallError::Refused(AbortCode::NOT_COMPLETE.0));
        assert_eq!(bench.call(READ, "0x1C12:ca", 0), not_complete);
    }
}

#[test]
fn an_sdo_takes_three_slots_and_a_longer_mailbox_is_closed_by_its_last_byte_in_the_same_one() {
    use Command::{Fprd, Fpwr};
    for (length, expected) in [
        (16, [&[Fpwr(STATION, 0x1800)][..], &[Fprd(STATION, 0x080D)], &[Fprd(STATION, 0x1C00)]]),
        (
            1_024,
            [
                &[Fpwr(STATION, 0x1800), Fpwr(STATION, 0x1BFF)],
                &[Fprd(STATION, 0x080D), Fprd(STATION, 0x1C00)],
                &[Fprd(STATION, 0x1FFF)],
            ],
        ),
    ] {
        let (mut bench, _server) = Bench::server(length, &[(MODE, &[7])]);
        bench.read(MODE).unwrap();
        bench.frames.clear();
        assert_eq!(bench.read(MODE), Ok(7));
        assert_eq!(bench.frames, expected);
    }
}

/// Each of the first frames of a transfer returns, or is lost on either way, in all combinations.
#[test]
fn no_lost_frame_changes_what_comes_of_a_transfer() {
    let fates = [Fate::Returns, Fate::NeverArrives, Fate::NeverReturns];
    for (length, places) in [(16, 5), (1_024, 5), (32, 4)] {
        for code in 0..3_usize.pow(places) {
            let lost = (0..places).map(|place| fates[code / 3_usize.pow(place) % 3]).collect();
            let (mut bench, server) = Bench::server(length, &[(MODE, &[7]), (STATUS_WORD, &[0x37, 6])]);
            bench.read(MODE).unwrap();
            bench.fates = lost;
            assert_eq!(bench.set(MODE, 0x85), Ok(0x85), "{length} {code}");
            bench.steps(10);
            let shared = server.shared();
            let mut counts: Vec<u8> = shared.requests.iter().map(|request| request[5] >> 4).collect();
            counts.dedup();
            assert_eq!(counts, [1, 2], "a repetition has the count of the first, {length} {code}");
            drop(shared);
            assert_eq!((bench.read(STATUS_WORD), bench.read(MODE)), (Ok(0x637), Ok(0x85)), "{length} {code}");
            assert_eq!(bench.own(Own::MailboxSilent), 0);
        }
    }
}

#[test]
fn an_answer_whose_frame_was_lost_is_requested_again() {
    let mut bench = Bench::drive(|_| {});
    bench.read(MODE).unwrap();
    // The second time the toggle goes back.
    for repeats in 1..3 {
        bench.frames.clear();
        bench.fates = vec![Fate::Returns, Fate::Returns, Fate::NeverReturns];
        assert_eq!(bench.read(Object::new(0x1018, 1)), Ok(0x6A));
        assert!(bench.frames.contains(&vec![Command::Fpwr(STATION, 0x080E)]), "{:?}", bench.frames);
        assert_eq!((bench.own(Own::MailboxRepeats), bench.own(Own::MailboxStrays)), (repeats, 0));
    }
}

#[test]
fn all_memory_is_reported() {
    let service = Service::new(&plan(1_024), no_calls(), 0);
    let mut regions = Regions::new();
    service.memory(&mut regions);
    let mut mailbox = service.mailbox;
    assert!(regions.covers(mailbox.as_mut().unwrap().received().0));
}

#[test]
fn a_first_request_that_has_the_last_count_of_another_master_is_answered_all_the_same() {
    // Of two requests the second one may be answered late: the next one keeps them apart.
    for (last, requests) in [(0, 1), (1, 3), (2, 1), (7, 1)] {
        let (mut bench, server) = Bench::server(32, &[(MODE, &[8])]);
        server.shared().last = last;
        for round in 0..3 {
            bench.service.read(MODE);
            let end = (0..690).find_map(|_| {
                bench.step();
                bench.service.take_end()
            });
            assert_eq!(end, Some(Ok(8)), "after count {last}, round {round}");
        }
        assert_eq!(server.shared().requests.len(), requests + 2, "after count {last}");
        assert_eq!(bench.counters.own[Own::MailboxStrays as usize], 0);
    }
}
