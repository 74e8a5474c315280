//! Scans of simulated segments.

use std::cell::Cell;
use std::collections::VecDeque;

use crate::{foreign, only};
use fieldbeat_core::net::Frames;
use fieldbeat_core::net::frames::Unsent;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{MS, Time, US};
use fieldbeat_ethercat::object::Family;
use fieldbeat_ethercat::plan::Area;
use fieldbeat_ethercat::scan::information::Unread;
use fieldbeat_ethercat::scan::*;
use fieldbeat_ethercat::wire::frame::{Command, Mac, datagrams, position};
use fieldbeat_ethercat::wire::registers::{AlCode, AlState, AlStatus, Fmmu, address};
use fieldbeat_ethercat::wire::sii::Identity;
use fieldbeat_sim::ethercat::codec::registers::SyncManager;
use fieldbeat_sim::ethercat::coupler::Terminals;
use fieldbeat_sim::ethercat::sii::{Contents, Mailboxes};
use fieldbeat_sim::ethercat::{
    self as sim, Application, Coupler, Drive, DriveSettings, Esc, Segment, Settings, SiiSettings,
};

const S700: Identity = Identity { vendor: 0x6A, product: 0x0300_0600, revision: 3 };
const IO: Identity = Identity { vendor: 2, product: 0x044C_2C52, revision: 0x11 };

type Event = fn(&mut Wire);

/// An interface with a segment behind it, in virtual time.
struct Wire {
    line: Segment,
    now: Time,
    waiting: VecDeque<Vec<u8>>,
    /// The sent frames, as they were sent.
    sent: Vec<Vec<u8>>,
    /// Happens with the frame of this number.
    event: Option<(usize, Event)>,
    /// Frames with these numbers are lost.
    lost: Vec<usize>,
    down: bool,
}

impl Wire {
    fn new(slaves: Vec<Esc>) -> Wire {
        Wire {
            line: Segment::new(slaves),
            now: Time(5),
            waiting: VecDeque::new(),
            sent: Vec::new(),
            event: None,
            lost: Vec::new(),
            down: false,
        }
    }

    /// Another master does this.
    fn master(&mut self, command: Command, data: &[u8]) -> (Vec<u8>, u16) {
        only(&self.pass(command, data))
    }

    fn pass(&mut self, command: Command, data: &[u8]) -> Vec<u8> {
        self.now = self.now + 10 * US;
        foreign(self.now, command, data, |now, frame| self.line.pass(now, frame))
    }

    fn go(&mut self, place: u16, state: AlState) {
        let control = AlStatus::request(state).0.to_le_bytes();
        assert_eq!(self.master(Command::Apwr(position(place), address::AL_CONTROL), &control).1, 1);
        self.now = self.now + MS;
        self.line.advance(self.now);
        assert_eq!(self.line.slave(place.into()).unwrap().state() as u8, state as u8);
    }

    fn scan(&mut self, options: Options) -> Result<Vec<Slave>, ScanError> {
        scan(self, options, &|| true)
    }
}

impl Frames for Wire {
    fn fd(&self) -> Option<i32> {
        None
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        if self.down {
            return Err(Unsent::Down);
        }
        let number = self.sent.len();
        self.sent.push(frame.to_vec());
        if let Some((_, event)) = self.event.take_if(|(at, _)| *at == number) {
            event(self);
        }
        let mut frame = frame.to_vec();
        self.line.pass(self.now, &mut frame);
        if !self.lost.contains(&number) {
            self.waiting.push_back(frame);
        }
        Ok(self.now)
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        self.now = self.now + 20 * US;
        let frame = self.waiting.pop_front()?;
        room[..frame.len()].copy_from_slice(&frame);
        Some((self.now, frame.len()))
    }

    fn now(&mut self) -> Time {
        self.now
    }

    fn mac(&self) -> Mac {
        [0x10; 6]
    }

    fn memory(&self, _: &mut Regions) {}
}

/// The same on the side of the slave.
const fn own(Identity { vendor, product, revision }: Identity) -> sim::Identity {
    sim::Identity { vendor, product, revision }
}

fn contents() -> Contents {
    Contents {
        name: "S700",
        identity: own(S700),
        serial: 0x1234_5678,
        alias: 7,
        mailboxes: Some(Mailboxes { out: (0x1800, 16), input: (0x1C00, 16), protocols: 4 }),
        fmmus: vec![1, 2, 3],
        managers: vec![
            SyncManager::on(0x1800, 16, SyncManager::MAILBOX_OUT),
            SyncManager::on(0x1C00, 16, SyncManager::MAILBOX_IN),
            SyncManager::on(0x1100, 6, SyncManager::OUTPUTS),
            SyncManager::on(0x1140, 8, SyncManager::INPUTS),
        ],
        ..Contents::default()
    }
}

fn drive(settings: Settings) -> Esc {
    let settings = Settings { sii: contents().image(), ..settings };
    Esc::new(settings, Box::new(Drive::new(DriveSettings::new(Family::S700))))
}

fn coupler() -> Esc {
    let terminals = |digital, analogue| Terminals { digital, analogue };
    let coupler = Coupler { outputs: terminals(8, 1), inputs: terminals(16, 0) };
    coupler.slave("EK1100", own(IO), Settings { features: 0x0180, ..Settings::default() })
}

fn line() -> Wire {
    let long = Settings { features: 0x018C, ..Settings::default() };
    Wire::new(vec![coupler(), drive(Settings::default()), drive(long)])
}

#[test]
fn every_step_of_a_segment_is_reported() {
    let slaves = line().scan(Options::default()).unwrap();
    let [coupler, drive, last] = &slaves[..] else { panic!("{slaves:?}") };
    assert_eq!([coupler, drive, last].map(|slave| slave.place), [0, 1, 2]);
    assert_eq!((drive.station, drive.alias, drive.status, drive.code), (0, 7, AlStatus(1), AlCode::NONE));
    assert_eq!((drive.fmmus.len(), drive.managers.len()), (8, 8));
    assert_eq!(drive.process_data(), (0, 0));
    let links = |slave: &Slave| [0, 1, 2, 3].map(|port| slave.links.link(port));
    assert_eq!(links(drive), [true, true, false, false]);
    assert_eq!(links(last), [true, false, false, false]);
    let clock = |slave: &Slave| (slave.features.has_clock(), slave.features.has_long_clock());
    assert_eq!([clock(coupler), clock(drive), clock(last)], [(false, false), (true, false), (true, true)]);
    let sii = drive.sii.as_ref().unwrap();
    let areas = [0x1800, 0x1C00].map(|start| Area { start, length: 16 });
    assert_eq!((sii.identity, sii.serial, sii.name.as_str()), (S700, 0x1234_5678, "S700"));
    assert_eq!((sii.mailbox, sii.protocols.coe(), sii.sound), (Some(areas), true, true));
    assert_eq!(sii.process_data(), (6, 8));
    let sii = coupler.sii.as_ref().unwrap();
    assert_eq!((sii.identity, sii.name.as_str(), sii.mailbox), (IO, "EK1100", None));
    assert_eq!(sii.process_data(), (3, 2));
}

/// A drive whose master has brought it to SAFEOP.
fn running() -> Wire {
    let mut wire = line();
    let apwr = |register| Command::Apwr(position(1), register);
    for (n, manager) in contents().managers.iter().enumerate() {
        let at = address::sync_manager(n as u16);
        assert_eq!(wire.master(apwr(at), &manager.to_bytes()).1, 1);
    }
    wire.go(1, AlState::PreOp);
    wire.master(apwr(address::STATION), &[1, 0x10]);
    wire.master(apwr(address::fmmu(0)), &Fmmu::bytes(0x1_0000, 6, 0x1100, true).to_bytes());
    wire.master(apwr(address::DC_CYCLE), &(2 * MS as u32).to_le_bytes());
    let start = 1000 * MS;
    wire.master(apwr(address::DC_START), &start.to_le_bytes());
    wire.master(apwr(address::DC_CONTROL), &[0, 3]);
    wire.go(1, AlState::SafeOp);
    wire
}

#[test]
fn a_working_drive_is_reported_as_set_and_left_alone() {
    let mut wire = running();
    let before = wire.sent.len();
    let slaves = wire.scan(Options::default()).unwrap();
    let drive = &slaves[1];
    assert_eq!((drive.station, drive.status.state()), (0x1001, Some(AlState::SafeOp)));
    assert_eq!(drive.process_data(), (6, 8));
    assert_eq!(drive.sync0_ns, Some(2_000_000));
    assert_eq!(drive.fmmus[0], Fmmu::bytes(0x1_0000, 6, 0x1100, true));
    assert_eq!(drive.sii, Err(Unread::InUse));
    // Its neighbours are in INIT: their SII is read.
    assert!(slaves[0].sii.is_ok() && slaves[2].sii.is_ok());
    for frame in &wire.sent[before..] {
        for datagram in datagrams(frame).unwrap().map(Result::unwrap) {
            match datagram.command().unwrap() {
                Command::Nop | Command::Aprd(..) | Command::Brd(_) => {}
                Command::Apwr(place, register) => {
                    assert!(place != position(1) && register == address::SII_CONTROL, "{datagram:?}");
                }
                other => panic!("{other:?}"),
            }
        }
    }
    assert_eq!(wire.line.slave(1).unwrap().state(), sim::AlState::SafeOp);
    // Of one that has refused a state its error and the code.
    let control = AlStatus::request(AlState::Op).0.to_le_bytes();
    wire.master(Command::Apwr(position(2), address::AL_CONTROL), &control);
    wire.master(Command::Brd(address::TYPE), &[0; 2]);
    let refused = &wire.scan(Options::default()).unwrap()[2];
    assert_eq!((refused.status, refused.code), (AlStatus(0x11), AlCode::INVALID_REQUEST));
}

#[test]
fn the_sii_is_read_on_request_and_its_access_given_back() {
    let mut wire = running();
    let slaves = wire.scan(Options { sii: true }).unwrap();
    assert_eq!(slaves[1].sii.as_ref().unwrap().identity, S700);
    assert_eq!(wire.line.slave(1).unwrap().state(), sim::AlState::SafeOp);
    // In INIT, and given to the slave's processor, as a master leaves it: that of all others stays the master's.
    let mut wire = line();
    let owner = Command::Apwr(position(2), address::SII_OWNER);
    wire.master(owner, &[1]);
    for sii in [false, true] {
        assert_eq!(wire.scan(Options { sii }).unwrap()[2].sii.as_ref().unwrap().identity, S700);
        for (place, owner) in [(1, 0), (2, 1)] {
            let read = Command::Aprd(position(place), address::SII_OWNER);
            assert_eq!(wire.master(read, &[0]), (vec![owner], 1));
        }
    }
}

#[test]
fn an_eeprom_may_take_its_time_or_be_of_no_use() {
    let answer = |settings: Settings, application: Box<dyn Application>| {
        let mut wire = Wire::new(vec![Esc::new(settings, application), coupler()]);
        let mut slaves = wire.scan(Options::default()).unwrap();
        assert!(slaves[1].sii.is_ok());
        slaves.swap_remove(0).sii
    };
    let usual = SiiSettings::default;
    let with = |sii_access| {
        let settings = Settings { sii_access, sii: contents().image(), ..Settings::default() };
        answer(settings, Box::new(Drive::new(DriveSettings::new(Family::S700))))
    };
    for access in [
        SiiSettings { eight: true, busy_ns: 2 * MS, ..usual() },
        SiiSettings { emulated: true, busy_ns: 2 * MS, ..usual() },
    ] {
        let sii = with(access).unwrap();
        assert_eq!(
            (sii.identity, sii.name.as_str(), sii.process_data()),
            (S700, "S700", (6, 8)),
            "{access:?}"
        );
    }
    assert_eq!(with(SiiSettings { busy_ns: u64::MAX / 2, ..usual() }), Err(Unread::Busy));
    // Zeros: categories without an end. Nothing at all: erased.
    for (sii, vendor) in [(vec![0; 0x400], 0), (Vec::new(), u32::MAX)] {
        let settings = Settings { sii, ..Settings::default() };
        let sii = answer(settings, Box::<Coupler>::default()).unwrap();
        assert_eq!((sii.sound, sii.identity.vendor, sii.name.as_str()), (false, vendor, ""));
        assert_eq!((sii.mailbox, sii.managers.len()), (None, 0));
    }
}

#[test]
fn lost_frames_are_sent_again_and_failures_are_reported_by_name() {
    let none = Options::default();
    let with = |change: fn(&mut Wire)| {
        let mut wire = line();
        change(&mut wire);
        (wire.scan(none).map(|slaves| slaves.len()), wire.sent.len())
    };
    assert_eq!(with(|wire| wire.lost = (0..200).filter(|n| n % 3 != 0).collect()).0, Ok(3));
    assert_eq!(with(|wire| wire.lost = (0..9).collect()), (Err(ScanError::Silent), 3));
    assert_eq!(with(|wire| wire.down = true).0, Err(ScanError::Unsent(Unsent::Down)));
    let cut = with(|wire| wire.event = Some((20, |wire| wire.line.cut(Some(1))))).0;
    assert_eq!(cut, Err(ScanError::Lost { place: 1, count: 3 }));
    assert_eq!(Wire::new(Vec::new()).scan(none), Err(ScanError::Loop));
    // Behind the last question to the second slave.
    let mut wire = Wire::new(vec![coupler(), coupler()]);
    wire.line.cut(Some(1));
    wire.event = Some((5, |wire| wire.line.cut(None)));
    assert_eq!(wire.scan(none), Err(ScanError::Changed { before: 1, after: 2 }));
    // Its caller may end it.
    let left = Cell::new(30);
    let go_on = || left.replace(left.get() - 1) > 0;
    assert_eq!(scan(&mut line(), none, &go_on), Err(ScanError::Interrupted));
}

#[test]
fn another_master_ends_it_even_before_its_first_frame() {
    let foreign = Err(ScanError::Foreign([0x30; 6]));
    let mut wire = line();
    let frame = wire.pass(Command::Brd(address::AL_STATUS), &[0; 2]);
    wire.waiting.push_back(frame);
    assert_eq!(wire.scan(Options::default()), foreign);
    assert!(wire.sent.is_empty());
    wire.event = Some((7, |wire| {
        let frame = wire.pass(Command::Brd(address::AL_STATUS), &[0; 2]);
        wire.waiting.push_back(frame);
    }));
    assert_eq!(wire.scan(Options::default()), foreign);
    assert_eq!(wire.sent.len(), 8);
}

#[test]
fn error_counters_stand_where_the_standard_has_them() {
    let mut bytes = [0; ERRORS];
    for (n, byte) in (0..).zip(&mut bytes) {
        *byte = n;
    }
    let errors = Errors {
        invalid: [0, 2, 4, 6],
        physical: [1, 3, 5, 7],
        forwarded: [8, 9, 10, 11],
        processing: 12,
        processor: 13,
        lost_links: [16, 17, 18, 19],
    };
    assert_eq!(Errors::new(&bytes), errors);
}

#[test]
fn an_acknowledgement_that_a_slave_without_a_processor_mirrors_is_no_error() {
    let settings = Settings { features: 0x0180, emulated: true, ..Settings::default() };
    let mut wire = Wire::new(vec![Coupler::default().slave("EK1100", own(IO), settings)]);
    // As other masters request INIT, and PREOP.
    for control in [0x11, 0x12] {
        wire.master(Command::Apwr(0, address::AL_CONTROL), &[control, 0]);
        let slaves = wire.scan(Options::default()).unwrap();
        assert_eq!(
            (slaves[0].status.error(), slaves[0].emulated, slaves[0].has_error()),
            (true, true, false)
        );
        let sii = slaves[0].sii.as_ref().unwrap();
        assert_eq!((sii.name.as_str(), sii.identity), ("EK1100", IO));
        assert_eq!(wire.master(Command::Aprd(0, address::AL_CONTROL), &[0]).0, [control]);
    }
}
