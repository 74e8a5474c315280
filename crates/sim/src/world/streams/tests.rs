use super::*;
use crate::fault::{Datagram, Injector, Queue, RETRANSMISSION_NS};
use crate::testing::Peers;
use crate::world::WorldOptions;
use crate::{FaultPlan, SimDrive};
use fieldbeat_core::net::{Carriers, Handshake, HandshakeState};
use fieldbeat_core::rt::{Clock, PollSet};
use fieldbeat_core::time::{MS, S, US};

mod losses;

/// One direction.
const LATENCY: u64 = 20 * US;

fn drive(n: u8) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 2, n), 1502)
}

/// Answers each request of two bytes, a number and its complement, with the number, the count of requests since its
/// start, and `padding` bytes; ends the connection behind the answer to anything else.
pub(crate) struct Line {
    pub(crate) address: SocketAddrV4,
    pub(crate) faults: FaultPlan,
    pub(crate) most: usize,
    pub(crate) padding: usize,
    pub(crate) answered: u8,
    pub(crate) lost: bool,
    pub(crate) peers: Peers,
}

impl Line {
    pub(crate) fn new(address: SocketAddrV4, faults: FaultPlan) -> Line {
        Line { address, faults, most: 2, padding: 0, answered: 0, lost: false, peers: Peers::default() }
    }
}

impl SimDrive for Line {
    fn address(&self) -> SocketAddrV4 {
        self.address
    }

    fn faults(&self) -> FaultPlan {
        self.faults.clone()
    }

    fn carrier(&self) -> Carrier {
        Carrier::Stream
    }

    fn receive(
        &mut self,
        _now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        for [number, complement] in self.peers.requests(from, bytes) {
            self.lost |= number != !complement;
            self.answered = self.answered.wrapping_add(1);
            reply.extend([number, self.answered]);
            reply.resize(reply.len() + self.padding, 0);
        }
        (!reply.is_empty()).then_some(from)
    }

    fn connect(&mut self, _now: Time, from: SocketAddrV4) -> bool {
        self.peers.connect(from, self.most)
    }

    fn hangs_up(&mut self, _from: SocketAddrV4) -> bool {
        std::mem::take(&mut self.lost)
    }

    fn disconnected(&mut self, _now: Time, from: SocketAddrV4) {
        self.peers.disconnected(from);
    }

    fn mislabel(&self, reply: &mut [u8]) {
        reply[0] ^= 0x80;
    }

    fn open_sto(&mut self, _until: Time) {}

    fn restart(&mut self, _now: Time) {
        assert_eq!(self.peers.count(), 0, "a restart ends all connections");
        self.answered = 0;
    }
}

/// Sends one request, 77.
#[derive(Debug)]
struct Ask(Vec<u8>);

impl Handshake for Ask {
    fn begin(&mut self, _now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.0.clear();
        out.extend([77, !77]);
        HandshakeState::More
    }

    fn take(&mut self, _now: Time, bytes: &[u8], _out: &mut Vec<u8>) -> HandshakeState {
        self.0.extend_from_slice(bytes);
        match self.0[..] {
            [77, _] => HandshakeState::Done,
            [_, _, ..] => HandshakeState::Failed("this is no line".into()),
            _ => HandshakeState::More,
        }
    }
}

/// A world with a master in it: a carrier with a connection to each of its drives.
struct Rig {
    world: World,
    carrier: Box<dyn fieldbeat_core::net::Streams>,
    /// The peers of each drive.
    peers: Vec<Peers>,
    /// The received bytes.
    received: Vec<Vec<u8>>,
    open: Vec<bool>,
    broken: Vec<(usize, Broken)>,
}

impl Rig {
    fn new(count: u8, faults: &FaultPlan) -> Rig {
        let seeded = |n| FaultPlan { seed: faults.seed + u64::from(n), ..faults.clone() };
        let lines: Vec<_> = (0..count).map(|n| Line::new(drive(n), seeded(n))).collect();
        let peers: Vec<_> = lines.iter().map(|line| line.peers.clone()).collect();
        let addresses: Vec<_> = lines.iter().map(|line| line.address).collect();
        let drives = lines.into_iter().map(|line| Box::new(line) as Box<dyn SimDrive>).collect::<Vec<_>>();
        let world = World::new(drives, WorldOptions { read_ns: 0, ..WorldOptions::default() }).unwrap();
        let ask = |address: &SocketAddrV4| StreamPeer::new(*address, Box::new(Ask(Vec::new())));
        let carrier = world.streams(addresses.iter().map(ask).collect()).unwrap();
        let count = peers.len();
        let (received, open) = (vec![Vec::new(); count], vec![false; count]);
        Rig { world, carrier, peers, received, open, broken: Vec::new() }
    }

    /// With all connections open.
    fn open(count: u8) -> Rig {
        let mut rig = Rig::new(count, &FaultPlan::default());
        (0..count.into()).for_each(|index| _ = rig.opened(index));
        rig
    }

    /// Takes in what has arrived, as a bus does.
    fn take(&mut self) {
        while let Some(index) = self.carrier.opened() {
            assert!(!std::mem::replace(&mut self.open[index], true));
            self.received[index].clear();
        }
        self.carrier.look();
        while let Some(index) = self.carrier.ready() {
            let mut room = [0; 3];
            match self.carrier.receive(index, &mut room) {
                Ok(got) => self.received[index].extend(&room[..got.map_or(0, |(_, count)| count)]),
                Err(why) => self.lose(index, why),
            }
        }
    }

    fn lose(&mut self, index: usize, why: Broken) {
        self.broken.push((index, why));
        self.carrier.abandon(index, "it broke");
        self.open[index] = false;
    }

    fn request(&mut self, index: usize, number: u8) -> Result<(Time, usize), Broken> {
        self.carrier.send(index, &[number, !number])
    }

    /// Lets `ns` pass while reading.
    fn pass(&mut self, ns: u64) {
        let (mut clock, until) = (self.world.clock(), self.world.now() + ns);
        while clock.wait(&mut PollSet::default(), until) {
            self.take();
        }
        self.take();
    }

    /// Lets time pass until connection `index` is open; the instant.
    fn opened(&mut self, index: usize) -> Time {
        for _ in 0..50_000 {
            if self.open[index] {
                return self.world.now();
            }
            self.pass(100 * US);
        }
        panic!("{:?}", self.carrier.notes().get(index));
    }

    fn connected(&self, index: usize) -> usize {
        self.peers[index].count()
    }
}

#[test]
fn a_connection_is_opened_with_its_handshake_and_handed_over_and_takes_its_latencies() {
    let mut rig = Rig::new(1, &FaultPlan { answer_ns: 100 * US, ..FaultPlan::default() });
    assert_eq!(rig.request(0, 1), Err(Broken::Absent));
    let knock = rig.world.lock().next_due().unwrap();
    rig.world.advance(knock.since(rig.world.now()) + 4 * LATENCY + 100 * US - 1);
    rig.take();
    assert!(!rig.open[0]);
    rig.world.advance(1);
    rig.take();
    assert!(rig.open[0] && rig.carrier.notes().get(0).is_none());

    let begin = rig.world.now();
    assert_eq!(rig.request(0, 5), Ok((begin, 2)));
    let mut set = PollSet::default();
    assert!(!rig.world.clock().wait(&mut set, begin + 140 * US - 1));
    assert!(rig.world.clock().wait(&mut set, begin + MS));
    assert_eq!(rig.world.now(), begin + 140 * US);
    rig.take();
    // The first request was the handshake.
    assert_eq!(rig.received[0], [5, 2]);
    assert!(!rig.world.clock().wait(&mut set, begin + MS));
}

#[test]
fn a_cut_ends_the_connection_in_the_middle_of_a_reply_and_a_drive_that_hangs_up_behind_it() {
    let mut rig = Rig::open(1);
    assert!(rig.world.set_faults(drive(0), FaultPlan { cut: 1.0, ..FaultPlan::default() }));
    rig.request(0, 9).unwrap();
    rig.pass(MS);
    assert_eq!((&rig.received[0][..], &rig.broken[..]), (&[9][..], &[(0, Broken::Closed)][..]));
    assert_eq!((rig.connected(0), rig.world.injected(drive(0)).unwrap().cut), (0, 1));
    let note = rig.carrier.notes().get(0).unwrap();
    assert!(note.contains("it broke"), "{note}");
    assert!(rig.world.set_faults(drive(0), FaultPlan::default()));
    rig.opened(0);
    rig.request(0, 3).unwrap();
    rig.pass(MS);
    assert_eq!(rig.received[0], [3, 4]);
    // A drive that hangs up is noticed as well.
    rig.carrier.send(0, &[1, 1]).unwrap();
    rig.pass(MS);
    assert_eq!((&rig.broken[1..], rig.connected(0)), (&[(0, Broken::Closed)][..], 0));
}

#[test]
fn a_restart_breaks_connections_off_and_they_come_back() {
    let mut rig = Rig::open(2);
    rig.request(0, 1).unwrap();
    assert!(rig.world.restart(drive(0)));
    rig.pass(MS);
    assert_eq!(rig.broken, [(0, Broken::Failed(libc::ECONNRESET))]);
    // The requests to the old one reached nobody.
    assert_eq!((&rig.received[0][..], rig.open[1]), (&[][..], true));
    rig.opened(0);
    rig.request(0, 2).unwrap();
    rig.request(1, 3).unwrap();
    rig.pass(MS);
    assert_eq!((&rig.received[0][..], &rig.received[1][..]), (&[2, 2][..], &[3, 2][..]));
    let restarts = FaultPlan { restart: 1.0, ..FaultPlan::default() };
    assert!(rig.world.set_faults(drive(1), restarts));
    rig.request(1, 4).unwrap();
    rig.pass(MS);
    assert_eq!(rig.broken[1..], [(1, Broken::Failed(libc::ECONNRESET))]);
}

#[test]
fn a_carrier_that_is_dropped_leaves_no_connection_and_no_alarm() {
    let mut rig = Rig::open(2);
    let ask = StreamPeer::new(drive(0), Box::new(Ask(Vec::new())));
    let second = rig.world.streams(vec![ask]).unwrap();
    rig.pass(S);
    assert_eq!((rig.connected(0), rig.connected(1)), (2, 1));
    rig.carrier = second;
    rig.open.fill(false);
    rig.pass(MS);
    assert_eq!((rig.connected(0), rig.connected(1)), (1, 0));
    rig.request(0, 8).unwrap();
    rig.pass(MS);
    assert_eq!(rig.received[0][0], 8);
    assert_eq!(rig.world.lock().next_due(), None);
}
