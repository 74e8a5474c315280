//! Carriers without a network: every drive answers at once, from memory.

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::{Mutex, PoisonError};

use fieldbeat::bus::linudp::{ControlWord, MainState, StateVar, StatusWord};
use fieldbeat::sim::SimDrive;
use fieldbeat::time::Time;
use fieldbeat_core::net::{
    Broken, Carriers, Datagrams, HandshakeState, LinkNotes, Outbox, Received, Sent, StreamPeer, Streams,
    UdpOptions,
};
use fieldbeat_core::rt::{MonotonicClock, Regions};
use fieldbeat_ethernet_ip::{IO_PORT, PORT};
use fieldbeat_linudp::wire::{RESPONSE_MAX, Request, RequestDef, Response, ResponseDef, RtcBlock};
use fieldbeat_sim::modbus::UnidriveSim;

use super::callgrind::resumed;
use super::moons;
use super::rig::{self, Scene};
use super::unidrive::{self, Canned, Direct};

/// Carriers of a network in memory where every drive answers at once.
pub struct NullNet;

impl Carriers for NullNet {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        if bind.port() == IO_PORT {
            return Ok(Box::new(NullPackets::new(options.peers)));
        }
        Ok(Box::new(NullCarrier::new(options.peers)))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        let count = peers.len();
        if peers.iter().all(|peer| peer.address.port() == PORT) {
            let from = |peer: &StreamPeer| SocketAddrV4::new(*peer.address.ip(), IO_PORT);
            let drive = |peer| Ok((from(&peer), moons::Canned::new(moons::open(peer)?)));
            *OPENED.lock().unwrap_or_else(PoisonError::into_inner) =
                peers.into_iter().map(drive).collect::<io::Result<_>>()?;
            return Ok(Box::new(NullStreams::new(0)));
        }
        peers.into_iter().try_for_each(greet)?;
        Ok(Box::new(NullStreams::new(count)))
    }
}

/// Lets the master greet the drive that it would find there, so that it knows what it would know of it.
fn greet(mut peer: StreamPeer) -> io::Result<()> {
    let mut drive = UnidriveSim::new(unidrive::simulated(&unidrive::drive(*peer.address.ip())));
    let (mut out, mut reply, now) = (Vec::new(), Vec::new(), MonotonicClock::read());
    drive.connect(now, peer.address);
    let mut said = peer.handshake.begin(now, &mut out);
    while said == HandshakeState::More {
        reply.clear();
        if drive.receive(now, peer.address, &out, &mut reply).is_none() {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        out.clear();
        said = peer.handshake.take(now, &reply, &mut out);
    }
    match said {
        HandshakeState::Failed(why) => Err(io::Error::other(why)),
        _ => Ok(()),
    }
}

/// The MOONS' drives whose connections were opened last, and where their packets come from. A bench has one loop at a
/// time.
static OPENED: Mutex<Vec<(SocketAddrV4, moons::Canned)>> = Mutex::new(Vec::new());

/// MOONS' drives that send a packet for each that they get.
pub struct NullPackets {
    /// Taken from those that were opened, with the first packet.
    drives: Vec<(SocketAddrV4, moons::Canned)>,
    /// Those that have a packet to be taken, and the next one of them.
    sending: Vec<usize>,
    next: usize,
    batch: usize,
}

impl NullPackets {
    pub fn new(peers: usize) -> NullPackets {
        // As real ones have it.
        let batch = (peers * 2).clamp(8, 128);
        NullPackets { drives: Vec::new(), sending: Vec::with_capacity(peers), next: 0, batch }
    }

    /// Drives at these addresses, without sessions.
    pub fn of(addresses: &[SocketAddrV4]) -> NullPackets {
        let drive = |address: &SocketAddrV4| (*address, moons::Canned::new(moons::first(0)));
        NullPackets { drives: addresses.iter().map(drive).collect(), ..NullPackets::new(addresses.len()) }
    }
}

impl Datagrams for NullPackets {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let at = rig::now();
        if self.drives.is_empty() {
            self.drives = std::mem::take(&mut *OPENED.lock().unwrap_or_else(PoisonError::into_inner));
        }
        self.sending.clear();
        self.next = 0;
        for index in 0..outbox.len() {
            if outbox.sent(index) == Sent::Posted {
                outbox.note(index, Sent::At(at));
                self.drives[index].1.hear(outbox.bytes(index));
                if !rig::is_scene(Scene::Silent) {
                    self.sending.push(index);
                }
            }
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let at = rig::now();
        let end = self.sending.len().min(self.next + self.batch);
        let count = end - self.next;
        for index in &self.sending[self.next..end] {
            let (from, drive) = &mut self.drives[*index];
            let received = Received { from: *from, at, bytes: drive.say(), truncated: false };
            resumed(|| take(received));
        }
        self.next = end;
        Ok(count)
    }

    fn batch(&self) -> usize {
        self.batch
    }

    fn memory(&self, _: &mut Regions) {}
}

/// How a Unidrive in memory shows its parameters.
enum Shows {
    Menu0(Box<Canned>),
    Direct(Box<Direct>),
}

impl Shows {
    fn hear(&mut self, request: &[u8]) -> bool {
        match self {
            Shows::Menu0(drive) => drive.hear(request),
            Shows::Direct(drive) => drive.hear(request),
        }
    }

    fn answer(&mut self, room: &mut [u8]) -> usize {
        match self {
            Shows::Menu0(drive) => drive.answer(room),
            Shows::Direct(drive) => drive.answer(room),
        }
    }
}

/// Connections whose drives answer at once, from memory.
pub struct NullStreams {
    drives: Vec<Shows>,
    opened: usize,
    /// Those that have an answer to be taken, and the next one of them.
    requested: Vec<usize>,
    next: usize,
}

impl NullStreams {
    pub fn new(peers: usize) -> NullStreams {
        let drive = || match unidrive::is_direct() {
            true => Shows::Direct(Box::new(Direct::new())),
            false => Shows::Menu0(Box::new(Canned::new())),
        };
        NullStreams {
            drives: (0..peers).map(|_| drive()).collect(),
            opened: 0,
            requested: Vec::with_capacity(peers),
            next: 0,
        }
    }
}

impl Streams for NullStreams {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn opened(&mut self) -> Option<usize> {
        let next = self.opened;
        (next < self.drives.len()).then(|| {
            self.opened += 1;
            next
        })
    }

    fn look(&mut self) {
        self.requested.drain(..self.next);
        self.next = 0;
    }

    fn ready(&mut self) -> Option<usize> {
        let index = *self.requested.get(self.next)?;
        self.next += 1;
        Some(index)
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let length = self.drives[index].answer(room);
        Ok(Some((rig::now(), length)))
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let at = rig::now();
        if self.drives[index].hear(bytes) && !rig::is_scene(Scene::Silent) {
            self.requested.push(index);
        }
        Ok((at, bytes.len()))
    }

    fn abandon(&mut self, _: usize, why: &'static str) {
        if !rig::is_scene(Scene::Silent) {
            rig::give_up(format!("a drive in memory was given up: {why}"));
        }
    }

    fn notes(&self) -> LinkNotes {
        LinkNotes::new(self.drives.len())
    }

    fn memory(&self, _: &mut Regions) {}
}

/// Answers each request from memory: ready to switch on, and in operation once it is switched on; always moving.
pub struct NullCarrier {
    /// Requests not yet answered.
    requested: Vec<Requested>,
    /// The count of the last motion command of each drive.
    counts: Vec<u8>,
    next: usize,
    batch: usize,
    /// Ready, in motion, faulted and at rest, each with and without the blocks that come in turn; and their lengths.
    replies: [[([u8; RESPONSE_MAX], usize); 1 << IN_TURN.len()]; 4],
    position: i32,
}

/// The contents of a request.
struct Requested {
    from: SocketAddrV4,
    definitions: [u8; 8],
    /// It is switched on.
    on: bool,
    /// The count of its last motion command.
    count: u8,
    /// A read of a parameter.
    read: Option<RtcBlock>,
}

/// The blocks that are not in each reply.
const IN_TURN: [ResponseDef; 3] = [ResponseDef::ERROR, ResponseDef::WARN, ResponseDef::MONITOR];

/// Which of the replies has the requested blocks: a bit for each.
fn variant(requested: ResponseDef) -> usize {
    let has = |(bit, block): (usize, &ResponseDef)| usize::from(requested.contains(*block)) << bit;
    IN_TURN.iter().enumerate().map(has).sum()
}

impl NullCarrier {
    /// Where the actual position is in a cyclic reply: behind definitions, status and state.
    const POSITION: std::ops::Range<usize> = 12..16;
    /// The high byte of the status.
    const STATUS: usize = 9;
    /// And the low byte of the state, with the count of the motion command.
    const COUNT: usize = 10;

    pub fn new(peers: usize) -> NullCarrier {
        let least = IN_TURN.iter().fold(ResponseDef::CYCLIC.0, |all, block| all & !block.0);
        let with = |variant: usize| {
            let blocks = IN_TURN.iter().enumerate().filter(|(bit, _)| variant >> bit & 1 == 1);
            blocks.fold(ResponseDef(least), |all, (_, block)| all.with(*block))
        };
        let reply = |status: u16, state: StateVar| {
            std::array::from_fn(|variant| {
                let response_def = with(variant);
                let response = Response {
                    request_def: RequestDef::NONE,
                    response_def,
                    status: Some(StatusWord(status)),
                    state: Some(state),
                    current: Some(250),
                    ..Response::default()
                };
                let mut bytes = [0; RESPONSE_MAX];
                let length = response.emit(&mut bytes);
                (bytes, length)
            })
        };
        let homed = StatusWord::HOMED | StatusWord::VOLTAGE_ENABLE | StatusWord::NO_QUICK_STOP;
        let ready = reply(homed, StateVar::new(MainState::READY_TO_SWITCH_ON, 0));
        let on = homed | StatusWord::OPERATION_ENABLED | StatusWord::SWITCH_ON_ACTIVE;
        let moving = StateVar::new(MainState::OPERATION_ENABLED, StateVar::MOTION_ACTIVE | StateVar::HOMED);
        let faulted = reply(homed | StatusWord::ERROR, StateVar::new(MainState::ERROR, 0));
        let standing = reply(on, StateVar::new(MainState::OPERATION_ENABLED, StateVar::HOMED));
        let replies = [ready, reply(on | StatusWord::MOTION_ACTIVE, moving), faulted, standing];
        // As real ones have it, so that as many calls of `receive` are made.
        let batch = (peers * 2).clamp(8, 128);
        let (requested, counts) = (Vec::with_capacity(peers), vec![0; peers]);
        NullCarrier { requested, counts, next: 0, batch, replies, position: 0 }
    }
}

impl Datagrams for NullCarrier {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let at = rig::now();
        self.requested.clear();
        self.next = 0;
        for index in 0..outbox.len() {
            if outbox.sent(index) == Sent::Posted {
                outbox.note(index, Sent::At(at));
                if rig::is_scene(Scene::Silent) {
                    continue;
                }
                let bytes = outbox.bytes(index);
                if let Some((definitions, blocks)) = bytes.split_first_chunk() {
                    let on = blocks.first().is_some_and(|low| u16::from(*low) & ControlWord::SWITCH_ON != 0);
                    let rare = (RequestDef::CONFIG.0 | RequestDef::MOTION.0) as u8;
                    let request = match definitions[0] & rare {
                        0 => None,
                        _ => Request::parse(bytes).ok(),
                    };
                    if let Some(motion) = request.and_then(|request| request.motion) {
                        self.counts[index] = motion.header as u8 & 0xF;
                    }
                    let read = request.and_then(|request| request.config);
                    let (from, count) = (outbox.peer(index), self.counts[index]);
                    self.requested.push(Requested { from, definitions: *definitions, on, count, read });
                }
            }
        }
        if !rig::is_scene(Scene::Standing) {
            self.position = self.position.wrapping_add(100);
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let at = rig::now();
        let end = self.requested.len().min(self.next + self.batch);
        let count = end - self.next;
        for Requested { from, definitions, on, count, read } in &self.requested[self.next..end] {
            let [.., low, middle, high, highest] = *definitions;
            let requested = ResponseDef(u32::from_le_bytes([low, middle, high, highest]));
            let state = match () {
                () if rig::is_scene(Scene::Faulted) => 2,
                () if rig::is_scene(Scene::Standing) && *on => 3,
                () => usize::from(*on),
            };
            let (reply, length) = &mut self.replies[state][variant(requested)];
            reply[..8].copy_from_slice(definitions);
            reply[Self::POSITION].copy_from_slice(&self.position.to_le_bytes());
            if rig::is_scene(Scene::Unsteady) {
                reply[Self::STATUS] ^= (StatusWord::IN_TARGET >> 8) as u8;
            }
            reply[Self::COUNT] = reply[Self::COUNT] & 0xF0 | if *on { *count } else { 0 };
            let mut length = *length;
            if let Some(read) = read {
                // Done: its count, status 0, the index, and a value.
                reply[length..length + 4].copy_from_slice(&[
                    read.tag,
                    0,
                    read.words[0] as u8,
                    (read.words[0] >> 8) as u8,
                ]);
                length += RtcBlock::SIZE;
            }
            let received = Received { from: *from, at, bytes: &reply[..length], truncated: false };
            resumed(|| take(received));
        }
        self.next = end;
        Ok(count)
    }

    fn batch(&self) -> usize {
        self.batch
    }

    fn memory(&self, _: &mut Regions) {}
}
