//! A Modbus bus on a connection that brings whatever it likes.
//!
//! The rig does what the loop does: it prepares, sends, takes in, judges. Behind the connection is a simulated drive;
//! the bytes choose commands, how much of each request the wire takes, what becomes of the replies, and when the
//! connection ends. What has to hold stands in the checks behind each step; they know the messages and what is desired,
//! and nothing of how the station keeps its books.

use std::collections::VecDeque;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard};

use fieldbeat::Cycle;
use fieldbeat::axis::{Link, NativeOwner};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::modbus::{ControlWord, ModbusPlan, UnidriveDrive, Via};
use fieldbeat::sim::SimDrive;
use fieldbeat::time::{MS, Time, US};
use fieldbeat_core::bus::desired::{Desired, Motion, Power};
use fieldbeat_core::bus::{Bus, Ends, Exchange, Opened, Slot};
use fieldbeat_core::net::{
    Broken, Carriers, Datagrams, HandshakeState, LinkNotes, StreamPeer, Streams, UdpOptions,
};
use fieldbeat_core::rt::Regions;
use fieldbeat_modbus::counters::Own;
use fieldbeat_modbus::wire::function::READ_WRITE;
use fieldbeat_modbus::wire::{REGISTERS_MAX, Request, frame};
use fieldbeat_sim::modbus::{ReadWrite, UnidriveSettings, UnidriveSim};

use super::commanded::Commanded;
use super::commands::command;
use super::input::Input;

const PERIOD_NS: u64 = MS;
const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 50_000);

pub fn modbus(data: &[u8]) {
    let mut input = Input(data);
    let mut rig = Rig::new(&mut input);
    while !input.is_over() {
        rig.step(&mut input);
        rig.check();
    }
}

/// The connection, both ends.
struct Pipe {
    drive: Box<dyn SimDrive>,
    peer: Option<StreamPeer>,
    now: Time,
    open: bool,
    /// Opened, and not taken over yet.
    news: bool,
    broken: Option<Broken>,
    /// The wire takes so many bytes of a send.
    takes: usize,
    /// What the master has sent and is no whole message yet.
    half: Vec<u8>,
    /// On the way to the master.
    inbox: VecDeque<u8>,
    /// Whole requests since the connection was opened, and how many of them were checked.
    requests: Vec<Vec<u8>>,
    checked: usize,
    /// Answers of the drive, not delivered yet.
    replies: VecDeque<Vec<u8>>,
    /// Whole messages that the master has taken in, if nothing but such was delivered.
    delivered: u64,
    /// Nothing but true answers was delivered so far.
    clean: bool,
}

impl Pipe {
    /// Greets the drive, and hands the connection over if it can be used.
    fn open(&mut self) {
        self.drive.disconnected(self.now, MASTER);
        self.drive.connect(self.now, MASTER);
        self.half.clear();
        self.inbox.clear();
        (self.requests, self.checked) = (Vec::new(), 0);
        self.replies.clear();
        let Some(mut peer) = self.peer.take() else { return };
        let mut out = Vec::new();
        let mut state = peer.handshake.begin(self.now, &mut out);
        // Bounded: a handshake has so many steps at most.
        for _ in 0..100 {
            if state != HandshakeState::More {
                break;
            }
            let mut reply = Vec::new();
            self.drive.receive(self.now, MASTER, &std::mem::take(&mut out), &mut reply);
            state = peer.handshake.take(self.now, &reply, &mut out);
        }
        self.peer = Some(peer);
        self.open = state == HandshakeState::Done;
        (self.news, self.broken) = (self.open, None);
    }

    /// What the drive makes of the request that is whole now.
    fn ask(&mut self) {
        while let Ok(Some(size)) = frame(&self.half) {
            let request: Vec<u8> = self.half.drain(..size).collect();
            let mut reply = Vec::new();
            self.drive.receive(self.now, MASTER, &request, &mut reply);
            self.requests.push(request);
            if !reply.is_empty() {
                self.replies.push_back(reply);
            }
        }
    }
}

#[derive(Clone)]
struct Shared(Arc<Mutex<Pipe>>);

impl Shared {
    fn get(&self) -> MutexGuard<'_, Pipe> {
        self.0.lock().unwrap()
    }
}

impl Carriers for Shared {
    fn datagrams(&self, _: SocketAddrV4, _: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Err(io::ErrorKind::Unsupported.into())
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        self.get().peer = peers.into_iter().next();
        Ok(Box::new(Wire { pipe: self.clone(), looked: false }))
    }
}

struct Wire {
    pipe: Shared,
    looked: bool,
}

impl Streams for Wire {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn opened(&mut self) -> Option<usize> {
        std::mem::take(&mut self.pipe.get().news).then_some(0)
    }

    fn look(&mut self) {
        let pipe = self.pipe.get();
        self.looked = pipe.open && !pipe.news && (!pipe.inbox.is_empty() || pipe.broken.is_some());
    }

    fn ready(&mut self) -> Option<usize> {
        std::mem::take(&mut self.looked).then_some(0)
    }

    fn receive(&mut self, _index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let mut pipe = self.pipe.get();
        if !pipe.open {
            return Err(Broken::Absent);
        }
        let count = room.len().min(pipe.inbox.len());
        if count == 0 {
            return pipe.broken.map_or(Ok(None), Err);
        }
        for byte in room.iter_mut().take(count) {
            *byte = pipe.inbox.pop_front().unwrap();
        }
        Ok(Some((pipe.now, count)))
    }

    fn send(&mut self, _index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let mut pipe = self.pipe.get();
        if !pipe.open {
            return Err(Broken::Absent);
        }
        let count = bytes.len().min(pipe.takes);
        assert!(count > 0 || pipe.takes == 0 || bytes.is_empty(), "nothing is sent for nothing");
        // But behind one by FC23 that it takes for ignored.
        let function = |request: &[u8]| request.get(7).copied();
        let ignored = pipe.requests.last().is_some_and(|request| function(request) == Some(READ_WRITE))
            && function(bytes) != Some(READ_WRITE);
        assert!(
            !pipe.clean || !pipe.half.is_empty() || pipe.replies.is_empty() || ignored,
            "a second request while the first is not answered"
        );
        pipe.half.extend_from_slice(&bytes[..count]);
        let now = pipe.now;
        pipe.ask();
        Ok((now, count))
    }

    fn abandon(&mut self, _index: usize, why: &'static str) {
        assert!(why.len() > 10);
        let mut pipe = self.pipe.get();
        (pipe.open, pipe.news) = (false, false);
    }

    fn notes(&self) -> LinkNotes {
        LinkNotes::new(1)
    }

    fn memory(&self, _: &mut Regions) {}
}

struct Rig {
    pipe: Shared,
    bus: Box<dyn Bus>,
    _ends: Ends,
    machine: Commanded,
    slots: [Slot; 1],
    before: Slot,
    /// What was desired when the first byte of the last request left.
    requested: Desired,
    /// The last control word that the drive has.
    control: ControlWord,
    index: u64,
    /// The addresses that the cyclic exchange may write.
    writable: Vec<u16>,
}

impl Rig {
    fn new(input: &mut Input<'_>) -> Rig {
        let features = input.byte();
        let has = |bit: u8| features >> bit & 1 == 1;
        let mut drive = UnidriveDrive::new("u", Ipv4Addr::LOCALHOST);
        drive.via = if has(0) { Via::Menu0 { first: 1 } } else { Via::Direct };
        let read_write = if has(1) {
            input.of(&[ReadWrite::Refused, ReadWrite::Ignored, ReadWrite::Closes, ReadWrite::UpTo(6)])
        } else {
            ReadWrite::Served
        };
        drive.reply_within_ns = if has(2) { 300 * US } else { 5 * MS };
        drive.watchdog.keypad = has(3);
        drive.axis.units.counts_per_unit = if has(4) { -0.5 } else { 1.0 };
        drive.axis.limits.velocity = has(5).then_some(20.0);
        drive.set_up = !has(6);
        let mut settings = UnidriveSettings::of(&drive);
        settings.interface.read_write = read_write;
        let plan = ModbusPlan::new(vec![drive]);
        assert_eq!(plan.faults(PERIOD_NS), []);
        let pipe = Shared(Arc::new(Mutex::new(Pipe {
            drive: Box::new(UnidriveSim::new(settings)),
            peer: None,
            now: Time(1_000 * PERIOD_NS),
            open: false,
            news: false,
            broken: None,
            takes: usize::MAX,
            half: Vec::new(),
            inbox: VecDeque::new(),
            requests: Vec::new(),
            checked: 0,
            replies: VecDeque::new(),
            delivered: 0,
            clean: true,
        })));
        let Opened { bus, ends: _ends, .. } = plan.open(PERIOD_NS, &pipe).unwrap();
        pipe.get().open();
        let slot = Slot { due: true, link: Link::Online, ..Slot::default() };
        // Reference, control word, both in menu 0; what makes the drive follow them, and its time-out.
        let writable = [0x4078, 0x0281, 0x4000, 0x0282, 0x0071, 0x0072, 0x05E4].into();
        Rig {
            pipe,
            bus,
            _ends,
            machine: Commanded::new(&plan, 0, PERIOD_NS),
            before: slot.clone(),
            slots: [slot],
            requested: Desired::default(),
            control: ControlWord::default(),
            index: 1_001,
            writable,
        }
    }

    fn cycle(&self) -> Cycle {
        let grid = Time(self.index * PERIOD_NS);
        Cycle { index: self.index, grid, period_ns: PERIOD_NS, deadline: grid + PERIOD_NS / 2 }
    }

    fn step(&mut self, input: &mut Input<'_>) {
        self.before = self.slots[0].clone();
        match input.byte() % 16 {
            0..=4 => self.turn(|_| {}),
            // The wire takes less, or nothing.
            5 => {
                self.pipe.get().takes = input.below(40);
                self.turn(|_| {});
                self.pipe.get().takes = usize::MAX;
            }
            // The drive says nothing in time.
            6 => {
                let held: Vec<_> = self.pipe.get().replies.drain(..).collect();
                self.turn(|pipe| pipe.replies.clear());
                self.pipe.get().replies.extend(held);
            }
            // In pieces.
            7 => {
                let count = input.below(30);
                self.turn(|pipe| {
                    let bytes: Vec<u8> = pipe.replies.drain(..).flatten().collect();
                    let (now, later) = bytes.split_at(count.min(bytes.len()));
                    pipe.inbox.extend(now);
                    if !later.is_empty() {
                        pipe.replies.push_front(later.to_vec());
                    }
                    // What is whole is counted by nobody here.
                    pipe.clean = false;
                });
            }
            8 => self.turn(|pipe| {
                let twice = pipe.replies.iter().flatten().copied().collect::<Vec<_>>();
                let count = pipe.replies.len() as u64;
                pipe.inbox.extend(twice);
                pipe.delivered += count;
            }),
            // One changed byte.
            9 => {
                let (place, value) = (input.below(40), input.byte());
                let answered = self.slots[0].counters.answered;
                let mut another = false;
                self.turn(|pipe| {
                    pipe.clean = false;
                    if let Some(reply) = pipe.replies.front_mut() {
                        let place = place % reply.len();
                        another = place < 7 && reply[place] != value;
                        reply[place] = value;
                    }
                });
                assert!(
                    !another || self.slots[0].counters.answered == answered,
                    "with another id, protocol, length or unit it is another's: {:?}",
                    self.slots[0].counters
                );
            }
            10 => {
                let count = input.below(24);
                let bytes = input.bytes(count).to_vec();
                self.turn(|pipe| {
                    pipe.clean = false;
                    pipe.inbox.extend(bytes);
                });
            }
            11 => {
                let broken = input.of(&[Broken::Closed, Broken::Failed(104)]);
                self.turn(|pipe| pipe.broken = Some(broken));
            }
            12 => {
                let mut pipe = self.pipe.get();
                if !pipe.open {
                    pipe.open();
                }
            }
            13 => {
                let at = self.pipe.get().now;
                match input.below(3) {
                    0 => self.pipe.get().drive.restart(at),
                    1 => self.pipe.get().drive.open_sto(at + 20 * MS),
                    _ => self.index += u64::from(input.byte()),
                }
            }
            14 => self.machine.velocity(input.number()),
            _ => {
                let command = (input.below(8) != 0).then(|| command(input));
                self.machine.start(self.cycle().grid, command);
            }
        }
    }

    /// One cycle. `meddle` meets the replies before they are delivered.
    fn turn(&mut self, meddle: impl FnOnce(&mut Pipe)) {
        let cycle = self.cycle();
        self.pipe.get().now = cycle.grid;
        self.slots[0].due = true;
        self.machine.propose(cycle.grid, &mut self.slots[0]);
        self.bus.prepare(&cycle, &mut self.slots);
        self.bus.prepare(&cycle, &mut self.slots);
        let sent = self.slots[0].counters.sent;
        self.bus.send(&cycle, &mut self.slots);
        if self.slots[0].counters.sent > sent {
            self.requested = self.slots[0].desired;
        }
        self.machine.commit(&mut self.slots[0]);
        {
            let mut pipe = self.pipe.get();
            meddle(&mut pipe);
            let replies: Vec<Vec<u8>> = pipe.replies.drain(..).collect();
            if pipe.open {
                pipe.delivered += replies.len() as u64;
                pipe.inbox.extend(replies.into_iter().flatten());
            }
            pipe.now = cycle.grid + 50 * US;
        }
        let sent = self.slots[0].counters.sent;
        for _ in 0..3 {
            self.bus.receive(&cycle, &mut self.slots);
        }
        assert_eq!(self.slots[0].counters.sent, sent, "nothing is sent while receiving");
        let slot = &mut self.slots[0];
        match slot.exchange {
            Exchange::Owed { reply_by, .. } if reply_by > cycle.deadline => {}
            Exchange::Owed { .. } => {
                slot.counters.missed += 1;
                slot.exchange = Exchange::Missed;
            }
            _ => slot.exchange = Exchange::Idle,
        }
        self.machine.observe(cycle.grid, slot);
        self.index += 1;
    }

    fn check(&mut self) {
        let slot = &self.slots[0];
        let (c, before) = (&slot.counters, &self.before.counters);
        let owed = u64::from(matches!(slot.exchange, Exchange::Owed { .. }));
        assert_eq!(c.sent, c.answered + c.missed + owed, "{c:?}");
        let own = |counter: Own| c.own[counter as usize];
        let named = own(Own::WrongUnit) + own(Own::WrongFunction) + own(Own::WrongLength) + own(Own::Garbage);
        assert_eq!(c.malformed, named, "each has its own name: {c:?}");
        assert!(own(Own::Exceptions) <= c.answered + c.late, "{c:?}");
        assert!(c.own.iter().zip(before.own).all(|(after, before)| *after >= before));
        let taken = c.answered + c.late + c.duplicate + c.foreign + c.malformed;
        let requests: Vec<Vec<u8>> = {
            let mut pipe = self.pipe.get();
            assert!(!pipe.clean || taken <= pipe.delivered, "{taken} of {} messages: {c:?}", pipe.delivered);
            let whole = pipe.requests.len();
            let checked = std::mem::replace(&mut pipe.checked, whole);
            pipe.requests[checked..].to_vec()
        };
        assert!(requests.len() <= 1, "one request a step");
        for request in &requests {
            let (_, request) = Request::parse(request).expect("what the master says is whole and right");
            match request {
                Request::Read { count, .. } => assert!((1..=REGISTERS_MAX).contains(&count)),
                Request::Write { address, data } => self.check_write(address, data.bytes()),
                Request::ReadWrite { count, write, data, .. } => {
                    assert!((1..=REGISTERS_MAX).contains(&count));
                    self.check_write(write, data.bytes());
                }
                Request::WriteOne { .. } => panic!("single writes are not used"),
            }
        }
        let slot = &self.slots[0];
        let (state, report) = (slot.status.state, &slot.status);
        assert!(report.velocity.is_finite(), "{state:?}: {report:?}");
    }

    fn check_write(&mut self, address: u16, data: &[u8]) {
        let Desired { power, motion, setpoint, .. } = self.requested;
        assert!(power.serial != 0, "nothing is written before something is desired");
        assert!(self.writable.contains(&address) && data.len() <= 8, "{address:#06x}, {data:?}");
        let word = |at: usize| u16::from_be_bytes([data[at], data[at + 1]]);
        let long = |at: usize| i32::from(word(at)) << 16 | i32::from(word(at + 2));
        let (control, reference) = match address {
            // Menu 0: both, or the control word first.
            0x4000 => (Some(word(2)), (data.len() == 8).then(|| long(4))),
            0x0281 => (Some(word(0)), None),
            0x4078 => (None, Some(long(0))),
            _ => return,
        };
        if motion.value == Motion::Native(NativeOwner::Application) {
            self.control = control.map_or(self.control, ControlWord);
            return;
        }
        let runs = power.value == Power::EnableOperation && motion.value != Motion::Halt;
        if let Some(control) = control.map(ControlWord) {
            let before = std::mem::replace(&mut self.control, control);
            assert!(runs || !control.has_any(ControlWord::ANY_RUN), "{control:?} for {:?}", self.requested);
            // RUN goes off before ENABLE does.
            let releases = power.value == Power::Off && before.has(ControlWord::ENABLE);
            let on = matches!(power.value, Power::EnableOperation | Power::QuickStop) || releases;
            assert!(
                on || !control.has(ControlWord::ENABLE),
                "{control:?} after {before:?} for {:?}",
                self.requested
            );
            let resets = power.value == Power::FaultReset;
            assert_eq!(control.has(ControlWord::RESET), resets, "{control:?} for {:?}", self.requested);
        }
        if reference.is_some_and(|reference| reference != 0) {
            let native = matches!(motion.value, Motion::Native(_));
            assert!(native || runs && setpoint.velocity != 0.0, "{reference:?} for {:?}", self.requested);
        }
    }
}
