//! A drive with three sockets and a clock of its own, its session and its packets.

use super::*;
use crate::testing::Producer;
use fieldbeat_core::net::{Handshake, HandshakeState};

const MASTER: Ipv4Addr = Ipv4Addr::new(10, 0, 3, 1);
const DRIVE: Ipv4Addr = Ipv4Addr::new(10, 0, 3, 7);
const GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 192, 1, 64), 2_222);

/// What happened to a session, and what it is to do.
#[derive(Debug, Default)]
struct Log {
    opened: usize,
    closed: Vec<String>,
    got: Vec<u8>,
    say: VecDeque<u8>,
}

#[derive(Debug, Default, Clone)]
struct Requests(Arc<Mutex<Log>>);

impl Requests {
    fn with<R>(&self, f: impl FnOnce(&mut Log) -> R) -> R {
        f(&mut self.0.lock().unwrap())
    }
}

impl Handshake for Requests {
    fn begin(&mut self, now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.with(|log| log.opened += 1);
        self.run(now, out)
    }

    fn take(&mut self, _now: Time, bytes: &[u8], _out: &mut Vec<u8>) -> HandshakeState {
        self.with(|log| log.got.extend_from_slice(bytes));
        HandshakeState::Kept
    }

    fn run(&mut self, _now: Time, out: &mut Vec<u8>) -> HandshakeState {
        match self.with(|log| log.say.pop_front()) {
            Some(b'.') => HandshakeState::Failed("that is all".into()),
            request => {
                out.extend(request);
                HandshakeState::Kept
            }
        }
    }

    fn closed(&mut self, _now: Time, why: &str) {
        self.with(|log| log.closed.push(why.into()));
    }
}

struct Rig {
    world: World,
    net: Box<dyn Datagrams>,
    outbox: Outbox,
    session: Requests,
    sessions: Box<dyn Streams>,
}

impl Rig {
    fn new(drive: Producer) -> Rig {
        let drives: Vec<Box<dyn SimDrive>> = vec![Box::new(drive)];
        let world = World::new(drives, WorldOptions { read_ns: 0, ..WorldOptions::default() }).unwrap();
        let options = UdpOptions { peers: 1, waiting: 0, room: 16, dscp: 0, groups: 1 };
        let net = world.datagrams(Producer::packets(MASTER), &options).unwrap();
        let session = Requests::default();
        let peer = StreamPeer {
            bind: Some(MASTER),
            most_pause_ns: 100 * MS,
            ..StreamPeer::new(Producer::stream(DRIVE), Box::new(session.clone()))
        };
        let sessions = world.streams(vec![peer]).unwrap();
        let outbox = Outbox::new(&[Producer::stream(DRIVE)], 16);
        world.advance(200 * MS);
        assert_eq!(session.with(|log| log.opened), 1);
        Rig { world, net, outbox, session, sessions }
    }

    /// Posts a request to the session.
    fn post(&self, byte: u8) {
        self.session.with(|log| log.say.push_back(byte));
        self.sessions.waker().unwrap().wake();
    }

    fn feed(&mut self) {
        self.outbox.set_peer(0, Producer::packets(DRIVE));
        self.outbox.set_length(0, 1);
        self.outbox.post(0, true);
        self.net.send(&mut self.outbox);
    }

    fn take(&mut self) -> Vec<(SocketAddrV4, u8)> {
        let mut got = Vec::new();
        self.net.receive(&mut |received| got.push((received.from, received.bytes[0]))).unwrap();
        got
    }
}

#[test]
fn packets_to_a_group_come_to_those_who_joined_it() {
    let mut rig = Rig::new(Producer::new(DRIVE).to(GROUP));
    let groups = rig.net.groups().unwrap();
    rig.post(b'O');
    rig.world.advance(10 * MS);
    assert_eq!(rig.take(), []);
    groups.join(GROUP).unwrap();
    rig.world.advance(10 * MS);
    assert_eq!(rig.take().len(), 10);
    assert!(groups.join(SocketAddrV4::new(Ipv4Addr::new(239, 192, 1, 96), 2_222)).is_err());
    groups.leave(GROUP);
    rig.world.advance(10 * MS);
    assert_eq!(rig.take(), []);
}

#[test]
fn thousands_of_requests_and_ends_leave_neither_alarm_nor_hang() {
    let mut rig = Rig::new(Producer::new(DRIVE));
    for round in 0..4_000_u64 {
        match round % 8 {
            0 | 1 => rig.post(b'O'),
            2 => rig.post(b'.'),
            3 => rig.post(b'C'),
            4 if round % 3 == 0 => drop(rig.world.restart(Producer::stream(DRIVE))),
            5 if round % 5 == 0 => drop(rig.world.unplug(Producer::stream(DRIVE))),
            6 => drop(rig.world.plug(Producer::stream(DRIVE))),
            _ => rig.feed(),
        }
        rig.world.advance(round % 13 * 7 * MS);
        rig.take();
    }
    rig.world.plug(Producer::stream(DRIVE));
    rig.world.advance(10 * S);
    let (opened, closed) = rig.session.with(|log| (log.opened, log.closed.len()));
    assert!(opened == closed + 1 && opened > 500, "{opened} {closed}");
    let Rig { world, sessions, session, .. } = rig;
    let waker = sessions.waker().unwrap();
    drop(sessions);
    waker.wake();
    world.advance(S);
    assert_eq!(world.lock().next_due(), None);
    assert_eq!(session.with(|log| log.opened), opened);
}
