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
    pub(crate) carrier: Carrier,
    pub(crate) faults: FaultPlan,
    pub(crate) most: usize,
    pub(crate) padding: usize,
    pub(crate) answered: u8,
    pub(crate) lost: bool,
    pub(crate) peers: Peers,
}

impl Line {
    pub(crate) fn new(address: SocketAddrV4, faults: FaultPlan) -> Line {
        let (carrier, peers) = (Carrier::Stream, Peers::default());
        Line { address, carrier, faults, most: 2, padding: 0, answered: 0, lost: false, peers }
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
        self.carrier
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

    fn inhibit(&mut self, _until: Time) {}

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

fn lines(count: u8, faults: &FaultPlan) -> Vec<Line> {
    let seeded = |n| FaultPlan { seed: faults.seed + u64::from(n), ..faults.clone() };
    (0..count).map(|n| Line::new(drive(n), seeded(n))).collect()
}

impl Rig {
    fn new(count: u8, faults: FaultPlan) -> Rig {
        Rig::of(lines(count, &faults), WorldOptions { read_ns: 0, ..WorldOptions::default() })
    }

    fn of(lines: Vec<Line>, options: WorldOptions) -> Rig {
        let peers: Vec<_> = lines.iter().map(|line| line.peers.clone()).collect();
        let addresses: Vec<_> = lines.iter().map(|line| line.address).collect();
        let drives = lines.into_iter().map(|line| Box::new(line) as Box<dyn SimDrive>).collect::<Vec<_>>();
        let world = World::new(drives, options).unwrap();
        let ask = |address: &SocketAddrV4| StreamPeer::new(*address, Box::new(Ask(Vec::new())));
        let carrier = world.streams(addresses.iter().map(ask).collect()).unwrap();
        let count = peers.len();
        let (received, open) = (vec![Vec::new(); count], vec![false; count]);
        Rig { world, carrier, peers, received, open, broken: Vec::new() }
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
    let faults = FaultPlan { answer_ns: 100 * US, ..FaultPlan::default() };
    let mut rig = Rig::new(1, faults);
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
fn who_refuses_and_who_is_not_there_are_distinguished_and_tried_again() {
    let mut lines = lines(4, &FaultPlan::default());
    lines[0].most = 0;
    lines[1].carrier = Carrier::Datagrams;
    let mut rig = Rig::of(lines, WorldOptions::default());
    assert!(rig.world.unplug(drive(2)));
    let nobody = StreamPeer::new(drive(99), Box::new(Ask(Vec::new())));
    let other = rig.world.streams(vec![nobody]).unwrap();
    rig.pass(3 * S);
    assert_eq!(rig.open, [false, false, false, true]);
    let note = |index| rig.carrier.notes().get(index).unwrap();
    assert!(note(0).contains("refused") && note(1).contains("refused"), "{} {}", note(0), note(1));
    assert!(note(2).contains("no answer"), "{}", note(2));
    assert!(other.notes().get(0).unwrap().contains("no answer"));
    assert!(rig.world.plug(drive(2)));
    rig.opened(2);
    assert_eq!(rig.carrier.notes().get(2), None);
}

#[test]
fn what_speaks_another_language_is_not_handed_over() {
    let mut rig = Rig::new(1, FaultPlan { wrong_id: 1.0, ..FaultPlan::default() });
    rig.pass(S);
    assert!(!rig.open[0]);
    let note = rig.carrier.notes().get(0).unwrap();
    assert!(note.contains("this is no line"), "{note}");
    assert_eq!(rig.connected(0), 0);
    assert!(rig.world.set_faults(drive(0), FaultPlan::default()));
    rig.opened(0);
}

#[test]
fn a_cut_ends_the_connection_in_the_middle_of_a_reply_and_a_drive_that_hangs_up_behind_it() {
    let mut rig = Rig::new(1, FaultPlan::default());
    rig.opened(0);
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
    let mut rig = Rig::new(2, FaultPlan::default());
    rig.opened(0);
    rig.opened(1);
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
fn what_is_under_way_to_an_old_connection_is_nobodys() {
    let mut rig = Rig::new(1, FaultPlan::default());
    rig.opened(0);
    let plan = FaultPlan { answer_ns: 150 * MS, ..FaultPlan::default() };
    assert!(rig.world.set_faults(drive(0), plan));
    let mine = |rig: &Rig| rig.peers[0].first();
    let first = mine(&rig);
    rig.request(0, 1).unwrap();
    rig.pass(MS);
    rig.carrier.abandon(0, "too slow");
    rig.open[0] = false;
    assert_eq!(
        (rig.request(0, 1), rig.carrier.receive(0, &mut [0; 8])),
        (Err(Broken::Absent), Err(Broken::Absent))
    );
    // The pause ends before the late answer comes, and the handshake follows it.
    rig.opened(0);
    assert_ne!(mine(&rig), first);
    rig.pass(S);
    assert!(rig.received[0].is_empty() && rig.broken.is_empty(), "{:?}", rig.received);
}

#[test]
fn a_carrier_that_is_dropped_leaves_no_connection_and_no_alarm() {
    let mut rig = Rig::new(2, FaultPlan::default());
    rig.opened(0);
    rig.opened(1);
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

#[test]
fn unknown_senders_reach_no_connection() {
    let mut rig = Rig::new(1, FaultPlan::default());
    rig.opened(0);
    let (unknown, peer) = (SocketAddrV4::new(Ipv4Addr::new(10, 9, 9, 9), 5), rig.peers[0].first().unwrap());
    rig.world.inject(drive(0), unknown, &[1, !1], rig.world.now());
    rig.world.inject(SocketAddrV4::new(*peer.ip(), 1), drive(0), &[1], rig.world.now());
    rig.request(0, 4).unwrap();
    rig.pass(MS);
    assert_eq!((&rig.received[0][..], rig.connected(0)), (&[4, 2][..], 1));
}

#[test]
fn the_same_seed_makes_the_same_connections() {
    let stormy = FaultPlan {
        seed: 3,
        drop: 0.01,
        duplicate: 0.01,
        corrupt: 0.01,
        delay: 0.05,
        delay_ns: MS,
        reorder: 0.01,
        stall: 0.01,
        stall_ns: 3 * MS,
        restart: 0.01,
        wrong_id: 0.01,
        split: 0.1,
        cut: 0.01,
        segment_loss: 0.002,
        answer_ns: 30 * US,
        ..FaultPlan::default()
    };
    let run = |faults: &FaultPlan, seed| {
        let options = WorldOptions { seed, wake_ns: 20 * US, ..WorldOptions::default() };
        let mut rig = Rig::of(lines(5, faults), options);
        for round in 0..3_000_u32 {
            for index in 0..5 {
                if rig.open[index]
                    && let Err(why) = rig.request(index, round as u8)
                {
                    rig.lose(index, why);
                }
            }
            rig.pass(MS);
            // Now and then the cable is unplugged.
            match round % 1_000 {
                400 => drop(rig.world.unplug(drive((round / 1_000) as u8))),
                900 => drop(rig.world.plug(drive((round / 1_000) as u8))),
                _ => {}
            }
        }
        let injected: Vec<_> = (0..5).map(|n| rig.world.injected(drive(n))).collect();
        (rig.world.digest(), rig.world.delivered(), rig.broken, injected)
    };
    let first = run(&stormy, 1);
    assert_eq!(first, run(&stormy, 1));
    let count = |of: fn(&crate::fault::Injected) -> u64| first.3.iter().flatten().map(of).sum::<u64>();
    assert!(count(|i| i.cut) > 5 && count(|i| i.restarts) > 5 && count(|i| i.split) > 50, "{first:?}");
    assert!(first.2.len() > 15, "{first:?}");
    assert_ne!(first.0, run(&stormy, 2).0);
    assert_ne!(first.0, run(&FaultPlan { seed: 4, ..stormy }, 1).0);
}
