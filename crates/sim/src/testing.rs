//! Common parts of the tests of this folder.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::{Arc, Mutex};

use super::{Carrier, FaultPlan, SimDrive, SimSegment, SimSerial};
use fieldbeat_core::net::{Parity, Rs485, SerialLine};
use fieldbeat_core::time::{MS, S, Time};

/// The bytes of hexadecimal digits; all else is left out.
pub fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text.bytes().filter(u8::is_ascii_hexdigit).collect();
    assert!(digits.len().is_multiple_of(2), "{text}");
    let byte = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
    digits.chunks(2).map(byte).collect()
}

/// The peers connected to the drive of a test, each with the begin of a request. It never waits for a peer.
#[derive(Clone, Default)]
pub struct Peers(Arc<Mutex<Vec<Peer>>>);

struct Peer {
    address: SocketAddrV4,
    come: Vec<u8>,
}

impl Peers {
    /// How many peers there are.
    pub fn count(&self) -> usize {
        self.0.lock().unwrap().len()
    }

    /// One more, if there are fewer than `most`.
    pub fn connect(&self, from: SocketAddrV4, most: usize) -> bool {
        let mut peers = self.0.lock().unwrap();
        let room = peers.len() < most;
        if room {
            peers.push(Peer { address: from, come: Vec::new() });
        }
        room
    }

    /// The whole requests, of two bytes each, that these bytes complete.
    pub fn requests(&self, from: SocketAddrV4, bytes: &[u8]) -> Vec<[u8; 2]> {
        let mut peers = self.0.lock().unwrap();
        let peer = peers.iter_mut().find(|peer| peer.address == from).expect("nobody unknown speaks");
        peer.come.extend_from_slice(bytes);
        let (whole, rest) = peer.come.as_chunks();
        let (whole, rest) = (whole.to_vec(), rest.to_vec());
        peer.come = rest;
        whole
    }

    /// One fewer.
    pub fn disconnected(&self, from: SocketAddrV4) {
        let mut peers = self.0.lock().unwrap();
        let before = peers.len();
        peers.retain(|peer| peer.address != from);
        assert_eq!(peers.len() + 1, before, "a connection ends once");
    }
}

/// Two slaves; each one that is reached and receives adds 1 to the second byte of a frame, and both report the
/// faults injected.
#[derive(Default)]
pub struct Tally {
    faults: FaultPlan,
    name: String,
    own: Option<String>,
    cut: Option<usize>,
    deaf: [bool; 2],
    pub passed: usize,
    pub lived: Time,
    pub restarts: [usize; 2],
    pub sto_open: [Time; 2],
}

impl Tally {
    pub const TYPE: u16 = 0x88A4;

    pub fn new(name: impl Into<String>, faults: FaultPlan) -> Tally {
        Tally { name: name.into(), faults, ..Tally::default() }
    }

    /// At this interface.
    pub fn at(self, own: &str) -> Tally {
        Tally { own: Some(own.into()), ..self }
    }
}

impl SimSegment for Tally {
    fn interface(&self) -> &str {
        &self.name
    }

    fn own_interface(&self) -> Option<&str> {
        self.own.as_deref()
    }

    fn ethertype(&self) -> u16 {
        Self::TYPE
    }

    fn faults(&self) -> FaultPlan {
        self.faults.clone()
    }

    fn slaves(&self) -> usize {
        2
    }

    fn delay_ns(&self) -> u64 {
        700
    }

    fn pass(&mut self, now: Time, frame: &mut [u8]) -> bool {
        self.advance(now);
        self.passed += 1;
        let reached = self.cut.unwrap_or(2);
        frame[1] += self.deaf[..reached].iter().filter(|deaf| !**deaf).count() as u8;
        reached > 0
    }

    fn mislabel(&self, frame: &mut [u8]) {
        frame[0] ^= 0x80;
    }

    fn advance(&mut self, now: Time) {
        self.lived = now;
    }

    fn cut(&mut self, place: Option<usize>) {
        self.cut = place;
    }

    fn deafen(&mut self, place: usize, deaf: bool) {
        self.deaf[place] = deaf;
    }

    fn restart(&mut self, _now: Time, place: usize) {
        self.restarts[place] += 1;
    }

    fn open_sto(&mut self, place: usize, until: Time) {
        self.sto_open[place] = until;
    }
}

/// A drive with three sockets that speaks by itself. `O` on its connection starts a packet every millisecond, from its
/// datagram socket to the peer's host or to a group, as long as that host feeds it; anything else stops that. At its
/// identity socket, which has the address of its stream, it answers with what it got.
pub struct Producer {
    ip: Ipv4Addr,
    group: Option<SocketAddrV4>,
    watchdog_ns: u64,
    faults: FaultPlan,
    owner: Option<SocketAddrV4>,
    next: Time,
    dies: Time,
    count: u8,
    hang: Option<SocketAddrV4>,
}

impl Producer {
    /// Without a packet of its owner for so long it stops, and ends the connection, unless it is patient, ns.
    pub const WATCHDOG_NS: u64 = 50 * MS;
    /// Between two packets, ns.
    pub const EVERY_NS: u64 = MS;

    pub fn new(ip: Ipv4Addr) -> Producer {
        Producer {
            ip,
            group: None,
            watchdog_ns: Self::WATCHDOG_NS,
            faults: FaultPlan::default(),
            owner: None,
            next: Time::default(),
            dies: Time::default(),
            count: 0,
            hang: None,
        }
    }

    /// It waits for as long as no busy host takes to feed it.
    pub fn patient(self) -> Producer {
        Producer { watchdog_ns: 60 * S, ..self }
    }

    /// Its packets go to a group.
    pub fn to(self, group: SocketAddrV4) -> Producer {
        Producer { group: Some(group), ..self }
    }

    /// Where packets go to and come from.
    pub fn packets(ip: Ipv4Addr) -> SocketAddrV4 {
        SocketAddrV4::new(ip, 2_222)
    }

    /// Where it listens.
    pub fn stream(ip: Ipv4Addr) -> SocketAddrV4 {
        SocketAddrV4::new(ip, 44_818)
    }
}

impl SimDrive for Producer {
    fn address(&self) -> SocketAddrV4 {
        Self::stream(self.ip)
    }

    fn faults(&self) -> FaultPlan {
        self.faults.clone()
    }

    fn carrier(&self) -> Carrier {
        Carrier::Stream
    }

    fn more_sockets(&self) -> Vec<(Carrier, SocketAddrV4)> {
        vec![(Carrier::Datagrams, Self::packets(self.ip)), (Carrier::Datagrams, Self::stream(self.ip))]
    }

    fn receive_at(
        &mut self,
        socket: usize,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        match socket {
            0 => return self.receive(now, from, bytes, reply),
            1 if self.owner.is_some_and(|owner| owner.ip() == from.ip()) => {
                self.dies = now + self.watchdog_ns;
            }
            2 => {
                reply.extend_from_slice(bytes);
                return Some(from);
            }
            _ => {}
        }
        None
    }

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        match bytes {
            b"O" => {
                (self.owner, self.next, self.dies, self.count) = (Some(from), now, now + self.watchdog_ns, 0);
            }
            _ => self.owner = None,
        }
        reply.push(bytes[0].to_ascii_lowercase());
        Some(from)
    }

    fn next_due(&self) -> Option<Time> {
        self.owner.map(|_| self.next.min(self.dies))
    }

    fn run(&mut self, now: Time, send: &mut dyn FnMut(usize, SocketAddrV4, &[u8])) {
        let Some(owner) = self.owner else { return };
        if self.dies <= now {
            self.hang = self.owner.take();
        } else if self.next <= now {
            self.count = self.count.wrapping_add(1);
            send(1, self.group.unwrap_or(Self::packets(*owner.ip())), &[self.count]);
            // From a socket that it does not have, and on a connection that nobody has.
            send(7, owner, &[0]);
            send(0, Self::packets(*owner.ip()), &[0]);
            self.next = self.next + Self::EVERY_NS;
        }
    }

    fn hangs_up(&mut self, from: SocketAddrV4) -> bool {
        self.hang.take_if(|peer| *peer == from).is_some()
    }

    fn restart(&mut self, _now: Time) {
        self.owner = None;
    }

    fn open_sto(&mut self, _until: Time) {}
}

/// A drive on a serial wire. It answers the telegram `[its number, value, !value]` after 11 bits with `[its number +
/// 128, value, its count of answers]`, and keeps everything that it received.
pub struct Slave {
    pub number: u8,
    pub received: Vec<u8>,
    pub restarts: usize,
    pub sto_open: Time,
    answers: u8,
    due: Option<Time>,
    value: u8,
}

impl Slave {
    pub const LINE: SerialLine = SerialLine { rate: 500_000, parity: Parity::Even, rs485: Rs485::Adapter };

    pub fn new(number: u8) -> Slave {
        Slave {
            number,
            received: Vec::new(),
            restarts: 0,
            sto_open: Time::default(),
            answers: 0,
            due: None,
            value: 0,
        }
    }

    /// A request to drive `number`.
    pub fn request(number: u8, value: u8) -> [u8; 3] {
        [number, value, !value]
    }
}

impl SimSerial for Slave {
    fn receive(&mut self, now: Time, bytes: &[u8]) {
        self.received.extend_from_slice(bytes);
        if let [number, value, complement] = bytes
            && (*number, *value) == (self.number, !complement)
        {
            (self.due, self.value) = (Some(now + Self::LINE.bits_ns(11)), *value);
        }
    }

    fn next_due(&self) -> Option<Time> {
        self.due
    }

    fn run(&mut self, _now: Time, out: &mut Vec<u8>) {
        self.due = None;
        self.answers = self.answers.wrapping_add(1);
        out.extend([self.number + 128, self.value, self.answers]);
    }

    fn mislabel(&self, telegram: &mut [u8]) {
        telegram[0] ^= 0x40;
    }

    fn restart(&mut self, _now: Time) {
        (self.answers, self.due) = (0, None);
        self.restarts += 1;
    }

    fn open_sto(&mut self, until: Time) {
        self.sto_open = until;
    }
}
