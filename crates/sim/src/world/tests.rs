//! Time in a world, and datagrams.

pub(crate) use super::streams::tests::Line;
use super::*;
use crate::SimDrive;
use fieldbeat_core::time::{MS, S, US};
use std::net::Ipv4Addr;

const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 41136);
const UNKNOWN: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 9, 9), 5);

fn drive(n: u8) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 1, n), 49360)
}

/// Answers with what it got and how often it has answered since its start.
pub(crate) struct Echo {
    pub(crate) address: SocketAddrV4,
    pub(crate) faults: FaultPlan,
    pub(crate) answered: u8,
}

impl SimDrive for Echo {
    fn address(&self) -> SocketAddrV4 {
        self.address
    }

    fn faults(&self) -> FaultPlan {
        self.faults.clone()
    }

    fn receive(
        &mut self,
        _now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.answered = self.answered.wrapping_add(1);
        reply.extend_from_slice(bytes);
        reply.push(self.answered);
        Some(from)
    }

    fn open_sto(&mut self, _until: Time) {}

    fn restart(&mut self, _now: Time) {
        self.answered = 0;
    }
}

fn world(count: u8, faults: FaultPlan, options: WorldOptions) -> World {
    let drives = (0..count).map(|n| {
        let faults = FaultPlan { seed: faults.seed + u64::from(n), ..faults.clone() };
        Box::new(Echo { address: drive(n), faults, answered: 0 }) as Box<dyn SimDrive>
    });
    World::new(drives.collect::<Vec<_>>(), options).unwrap()
}

/// One carrier and a message to each of `count` drives.
struct Master {
    carrier: Box<dyn Datagrams>,
    outbox: Outbox,
}

impl Master {
    fn new(world: &World, count: u8) -> Master {
        let options = UdpOptions { peers: usize::from(count), waiting: 0, room: 16, dscp: 0, groups: 0 };
        let carrier = world.datagrams(MASTER, &options).unwrap();
        let outbox = Outbox::new(&(0..count).map(drive).collect::<Vec<_>>(), 16);
        Master { carrier, outbox }
    }

    fn send(&mut self) {
        for index in 0..self.outbox.len() {
            self.outbox.room(index)[0] = index as u8;
            self.outbox.set_length(index, 1);
            self.outbox.post(index, true);
        }
        self.carrier.send(&mut self.outbox);
    }

    fn receive(&mut self) -> Vec<(Time, SocketAddrV4, Vec<u8>, bool)> {
        let mut got = Vec::new();
        while self.carrier.receive(&mut |r| got.push((r.at, r.from, r.bytes.to_vec(), r.truncated))).unwrap()
            == self.carrier.batch()
        {}
        got
    }
}

#[test]
fn reading_the_clock_takes_time_and_lets_things_happen() {
    let world = world(1, FaultPlan::default(), WorldOptions::default());
    let mut clock = world.clock();
    let begin = clock.now();
    assert_eq!(clock.now(), begin + 50);
    let mut master = Master::new(&world, 1);
    master.send();
    // Polled without a wait in between: the reply comes all the same.
    while master.receive().is_empty() {}
    assert_eq!(world.now(), begin + 50 + 50 + 40 * US);
}

#[test]
fn all_messages_of_a_batch_have_the_stamp_of_its_begin() {
    let world = world(3, FaultPlan::default(), WorldOptions::default());
    let mut master = Master::new(&world, 3);
    let t = world.now();
    master.send();
    assert_eq!([0, 1, 2].map(|k| master.outbox.sent(k)), [Sent::At(t + 50); 3]);
}

#[test]
fn wake_ups_are_late_but_never_early() {
    let options = WorldOptions { seed: 9, wake_ns: 10 * US, ..WorldOptions::default() };
    let world = world(0, FaultPlan::default(), options);
    let mut clock = world.clock();
    let late: Vec<u64> = (1..=1_000)
        .map(|k| {
            let at = Time(1_000 * fieldbeat_core::time::S) + k * MS;
            clock.sleep_until(at);
            assert!(world.now() >= at);
            world.now().since(at)
        })
        .collect();
    assert!(late.iter().all(|ns| *ns <= 10 * US) && late.iter().any(|ns| *ns > 9 * US));
}

#[test]
fn a_foreign_datagram_comes_at_its_instant() {
    let world = world(1, FaultPlan::default(), WorldOptions { read_ns: 0, ..WorldOptions::default() });
    let mut master = Master::new(&world, 0);
    let begin = world.now();
    world.inject(MASTER, UNKNOWN, &[9; 17], begin + MS);
    world.inject(drive(0), UNKNOWN, &[1], begin);
    assert!(world.clock().wait(&mut PollSet::default(), begin + S));
    assert_eq!(master.receive(), [(begin + MS, UNKNOWN, vec![9; 16], true)]);
    assert_eq!(world.delivered(), 2);
}

#[test]
fn what_finds_no_room_at_a_carrier_is_lost_and_counted() {
    let world = world(0, FaultPlan::default(), WorldOptions::default());
    let mut master = Master::new(&world, 0);
    (0..INBOX + 7).for_each(|_| world.inject(MASTER, UNKNOWN, &[9], world.now()));
    world.advance(1);
    assert_eq!(master.carrier.dropped(), 7);
    assert_eq!(master.receive().len(), INBOX);
    world.inject(MASTER, UNKNOWN, &[9], world.now());
    world.advance(1);
    assert_eq!((master.receive().len(), master.carrier.dropped()), (1, 7));
}

#[test]
fn an_address_has_one_owner_until_it_is_dropped() {
    let world = world(1, FaultPlan::default(), WorldOptions::default());
    let options = UdpOptions { peers: 1, waiting: 0, room: 16, dscp: 0, groups: 0 };
    let refused = |at| world.datagrams(at, &options).map(|_| ()).unwrap_err().kind();
    let first = world.datagrams(MASTER, &options).unwrap();
    assert_eq!(refused(MASTER), io::ErrorKind::AddrInUse);
    assert_eq!(refused(drive(0)), io::ErrorKind::AddrInUse);
    drop(first);
    assert!(world.datagrams(MASTER, &options).is_ok());
}

mod producers;
