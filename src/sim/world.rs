//! Virtual time, and a network in memory with simulated drives on it.
//!
//! The world is a clock and a carrier at once: time passes only when the code under test reads the clock, sleeps or
//! waits, and whatever is due by then happens on the way, in order. The same seed and the same calls give the same
//! bytes at the same instants; [`World::digest`] says so in one number. Nothing here is specific to a protocol.
//!
//! Connections are in `streams`.

mod streams;

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use self::streams::Links;
use super::fault::{Blow, Datagram, Injected, Injector, Parcel, Queue, Signal, Way};
use super::{Carrier, FaultPlan, SimDrive};
use crate::net::{Carriers, Datagrams, Outbox, Received, SendMode, Sent, StreamPeer, Streams, UdpOptions};
use crate::rt::{Clock, PollSet, Regions};
use crate::time::Time;

/// The most datagrams under way at once; more are lost, as in a switch.
const UNDER_WAY: usize = 16_384;
/// The most datagrams that wait at one carrier; more are lost, as in a socket buffer.
const INBOX: usize = 4_096;
/// The most datagrams of one `receive`, as on real sockets.
const BATCH: usize = 64;
/// Connections of a drive without a further allocation.
const PEERS: usize = 16;
/// What one turn of a spinning wait takes, ns.
const SPIN_NS: u64 = 50;

/// How a world behaves.
#[derive(Clone, Debug, PartialEq)]
pub struct WorldOptions {
    /// Seed of the wake-up latencies. The drives' faults have their own seeds.
    pub seed: u64,
    /// When the world begins. Default: 1000 s, since no machine's clock stands at zero.
    pub start: Time,
    /// What one reading of the clock takes, ns. Default 50.
    pub read_ns: u64,
    /// Time of a datagram from one end of the wire to the other, ns. Default 20 000.
    pub latency_ns: u64,
    /// The most that a sleep or a wait wakes up late, ns; evenly spread from 0. Default 0.
    pub wake_ns: u64,
}

impl Default for WorldOptions {
    fn default() -> WorldOptions {
        WorldOptions {
            seed: 0,
            start: Time(1_000 * crate::time::S),
            read_ns: 50,
            latency_ns: 20_000,
            wake_ns: 0,
        }
    }
}

/// A handle to a virtual world; clones are the same world.
#[derive(Clone, Debug)]
pub struct World(Arc<Mutex<Inner>>);

impl World {
    /// A world of these drives.
    ///
    /// # Errors
    ///
    /// Two drives with one address.
    pub fn new(drives: Vec<Box<dyn SimDrive>>, options: WorldOptions) -> io::Result<World> {
        let mut stations: Vec<_> = drives.into_iter().map(Station::new).collect();
        stations.sort_by_key(|station| station.address);
        if let Some(pair) = stations.windows(2).find(|pair| pair[0].address == pair[1].address) {
            return Err(taken(pair[0].address));
        }
        Ok(World(Arc::new(Mutex::new(Inner {
            now: options.start,
            random: fastrand::Rng::with_seed(options.seed),
            hold_up_ns: 0,
            options,
            stations,
            next_station: 0,
            ports: Vec::new(),
            links: Links::default(),
            under_way: Queue::new(UNDER_WAY),
            reply: Vec::new(),
            digest: 0,
            delivered: 0,
        }))))
    }

    /// The clock of this world.
    pub fn clock(&self) -> WorldClock {
        WorldClock(self.clone())
    }

    /// The present instant. Reading it here takes no time.
    pub fn now(&self) -> Time {
        self.lock().now
    }

    /// Lets `ns` pass, as work that takes so long.
    pub fn advance(&self, ns: u64) {
        let mut inner = self.lock();
        let at = inner.now + ns;
        inner.run(at);
    }

    /// Holds up the next sleep that ends: it wakes up `ns` later than it would have, as if the machine had been busy.
    pub fn delay_next_wake(&self, ns: u64) {
        self.lock().hold_up_ns = ns;
    }

    /// Puts a foreign datagram on the wire, to arrive at `to` at the instant `at`, or now if that has passed.
    pub fn inject(&self, to: SocketAddrV4, from: SocketAddrV4, bytes: &[u8], at: Time) {
        let mut inner = self.lock();
        let due = at.max(inner.now);
        let parcel = inner.under_way.parcel(Datagram { from, to, bytes });
        inner.under_way.push(due, parcel);
    }

    /// Pulls the network plug of the drive at `address`; it goes on by itself. Datagrams are lost; what is sent on a connection
    /// waits, until the plug is back or the connection is given up. False if there is no such drive.
    pub fn unplug(&self, address: SocketAddrV4) -> bool {
        self.with(address, |station, _| station.plugged = false).is_some()
    }

    /// Puts the network plug back. False if there is no such drive.
    pub fn plug(&self, address: SocketAddrV4) -> bool {
        let mut inner = self.lock();
        let index = inner.station(address);
        index.map(|index| inner.plug(index)).is_some()
    }

    /// Switches the drive at `address` off and on again; its connections are broken off. False if there is no such drive.
    pub fn restart(&self, address: SocketAddrV4) -> bool {
        let mut inner = self.lock();
        let index = inner.station(address);
        index.map(|index| inner.strike(index, Some(Blow::Restart))).is_some()
    }

    /// Opens the hardware enable (STO) of the drive at `address` for `ns`. False if there is no such drive.
    pub fn inhibit(&self, address: SocketAddrV4, ns: u64) -> bool {
        self.with(address, |station, now| station.drive.inhibit(now + ns)).is_some()
    }

    /// From now on the wire of the drive at `address` has the faults of `plan`; its counters begin anew. False if there
    /// is no such drive.
    pub fn set_faults(&self, address: SocketAddrV4, plan: FaultPlan) -> bool {
        self.with(address, |station, _| station.injector.change(plan)).is_some()
    }

    /// What the wire of the drive at `address` has done to its datagrams.
    pub fn injected(&self, address: SocketAddrV4) -> Option<Injected> {
        self.with(address, |station, _| station.injector.injected())
    }

    /// A hash over all that was delivered so far: instants, addresses and bytes, in order.
    pub fn digest(&self) -> u64 {
        self.lock().digest
    }

    /// How many datagrams were delivered so far, to drives and carriers.
    pub fn delivered(&self) -> u64 {
        self.lock().delivered
    }

    fn with<R>(&self, address: SocketAddrV4, f: impl FnOnce(&mut Station, Time) -> R) -> Option<R> {
        let mut inner = self.lock();
        let now = inner.now;
        let index = inner.station(address)?;
        Some(f(&mut inner.stations[index], now))
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // A test that panicked elsewhere shall fail there, not here.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Carriers for World {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        let mut inner = self.lock();
        if inner.station(bind).is_some() || inner.ports.iter().any(|port| port.address == bind) {
            return Err(taken(bind));
        }
        inner.ports.push(Port { address: bind, inbox: VecDeque::new(), dropped: 0 });
        drop(inner);
        Ok(Box::new(Socket {
            world: self.clone(),
            address: bind,
            options: *options,
            taken: Vec::with_capacity(BATCH),
        }))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        Ok(Box::new(self.open_streams(peers)))
    }
}

fn taken(address: SocketAddrV4) -> io::Error {
    io::Error::new(io::ErrorKind::AddrInUse, format!("{address} is taken in this world"))
}

/// The clock of a [`World`].
#[derive(Clone, Debug)]
pub struct WorldClock(World);

impl Clock for WorldClock {
    fn now(&mut self) -> Time {
        self.0.lock().read()
    }

    fn sleep_until(&mut self, at: Time) {
        let mut inner = self.0.lock();
        let late = std::mem::take(&mut inner.hold_up_ns) + if at > inner.now { inner.wake_late() } else { 0 };
        let at = at.max(inner.now) + late;
        inner.run(at);
    }

    /// Every carrier of the world counts as in `set`: none of them has a descriptor.
    fn wait(&mut self, _set: &mut PollSet, until: Time) -> bool {
        let mut inner = self.0.lock();
        let begin = inner.now;
        let arrived = loop {
            if inner.ports.iter().any(|port| !port.inbox.is_empty()) || inner.links.readable() {
                break true;
            }
            match inner.next_due() {
                Some(due) if due <= until.max(inner.now) => inner.run(due),
                _ => break false,
            }
        };
        let end = if arrived { inner.now } else { inner.now.max(until) };
        let late = if end > begin { inner.wake_late() } else { 0 };
        inner.run(end + late);
        arrived
    }

    fn spin(&mut self) {
        let mut inner = self.0.lock();
        let at = inner.now + SPIN_NS;
        inner.run(at);
    }
}

struct Inner {
    now: Time,
    random: fastrand::Rng,
    /// Of the next sleep.
    hold_up_ns: u64,
    options: WorldOptions,
    /// By address.
    stations: Vec<Station>,
    /// The one behind the one that was found last.
    next_station: usize,
    ports: Vec<Port>,
    links: Links,
    under_way: Queue,
    reply: Vec<u8>,
    digest: u64,
    delivered: u64,
}

impl std::fmt::Debug for Inner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Inner")
            .field("now", &self.now)
            .field("drives", &self.stations.len())
            .field("delivered", &self.delivered)
            .field("digest", &self.digest)
            .finish_non_exhaustive()
    }
}

struct Station {
    address: SocketAddrV4,
    drive: Box<dyn SimDrive>,
    injector: Injector,
    plugged: bool,
    carrier: Carrier,
    /// Who has a connection with it.
    peers: Vec<SocketAddrV4>,
}

impl Station {
    fn new(drive: Box<dyn SimDrive>) -> Station {
        let (address, carrier) = (drive.address(), drive.carrier());
        let injector = Injector::new(drive.faults(), carrier);
        Station { address, drive, injector, plugged: true, carrier, peers: Vec::with_capacity(PEERS) }
    }

    /// Sends a request to it on its way, to arrive at `due` if nothing befalls it.
    fn pass_request(
        &mut self,
        now: Time,
        due: Time,
        request: Datagram<'_>,
        queue: &mut Queue,
    ) -> Option<Blow> {
        self.injector.pass(Way::Request, now, due, request, &*self.drive, queue)
    }
}

/// One carrier's end of the wire.
struct Port {
    address: SocketAddrV4,
    inbox: VecDeque<Parcel>,
    /// What found no room there.
    dropped: u64,
}

impl Inner {
    /// A master asks its drives in order, so that it mostly is the next one.
    fn station(&mut self, address: SocketAddrV4) -> Option<usize> {
        let index = match self.stations.get(self.next_station) {
            Some(station) if station.address == address => self.next_station,
            _ => self.stations.binary_search_by_key(&address, |station| station.address).ok()?,
        };
        self.next_station = index + 1;
        Some(index)
    }

    fn port(&self, address: SocketAddrV4) -> Option<usize> {
        self.ports.iter().position(|port| port.address == address)
    }

    /// One reading of the clock.
    fn read(&mut self) -> Time {
        let at = self.now + self.options.read_ns;
        self.run(at);
        at
    }

    fn wake_late(&mut self) -> u64 {
        match self.options.wake_ns {
            0 => 0,
            most => self.random.u64(0..=most),
        }
    }

    /// Lets everything happen that is due by `at`, then it is `at`.
    fn run(&mut self, at: Time) {
        loop {
            let next = self.under_way.next_due();
            let alarm =
                self.links.alarm().filter(|alarm| *alarm <= at && next.is_none_or(|due| *alarm < due));
            if let Some(alarm) = alarm {
                self.now = self.now.max(alarm);
                self.ring();
            } else if let Some((due, parcel)) = self.under_way.pop(at) {
                self.now = self.now.max(due);
                self.deliver(parcel);
            } else {
                break;
            }
        }
        self.now = self.now.max(at);
    }

    /// When the next thing happens.
    fn next_due(&self) -> Option<Time> {
        [self.under_way.next_due(), self.links.alarm()].into_iter().flatten().min()
    }

    fn deliver(&mut self, parcel: Parcel) {
        let used_up = if let Some(index) = self.port(parcel.to) {
            self.take_in_datagram(index, parcel)
        } else if let Some(index) = self.station(parcel.to) {
            if self.stations[index].carrier == Carrier::Datagrams && parcel.signal == Signal::Bytes {
                self.serve(index, &parcel);
                Some(parcel)
            } else {
                self.hear(index, parcel)
            }
        } else {
            self.arrive(parcel)
        };
        if let Some(parcel) = used_up {
            self.under_way.recycle(parcel);
        }
    }

    fn take_in_datagram(&mut self, port: usize, parcel: Parcel) -> Option<Parcel> {
        if self.ports[port].inbox.len() >= INBOX {
            self.ports[port].dropped += 1;
            return Some(parcel);
        }
        record(&mut self.digest, self.now, &parcel);
        self.delivered += 1;
        self.ports[port].inbox.push_back(parcel);
        None
    }

    /// A datagram comes to a drive.
    fn serve(&mut self, index: usize, parcel: &Parcel) {
        let now = self.now;
        let station = &mut self.stations[index];
        if !station.plugged {
            return;
        }
        record(&mut self.digest, now, parcel);
        self.delivered += 1;
        self.reply.clear();
        let to = station.drive.receive(now, parcel.from, &parcel.bytes, &mut self.reply);
        // No drive answers a drive: with a forged source two of them would go on for ever.
        if let Some(to) = to.filter(|to| self.port(*to).is_some() || self.station(*to).is_none()) {
            let station = &mut self.stations[index];
            let reply = Datagram { from: station.address, to, bytes: &self.reply };
            let due = now + self.options.latency_ns;
            station.injector.pass(Way::Reply, now, due, reply, &*station.drive, &mut self.under_way);
        }
    }

    /// A carrier's datagram leaves now.
    fn depart(&mut self, datagram: Datagram<'_>) {
        if let Some(index) = self.station(datagram.to) {
            if self.stations[index].plugged {
                self.depart_to(index, datagram);
            }
        } else {
            let parcel = self.under_way.parcel(datagram);
            self.under_way.push(self.now + self.options.latency_ns, parcel);
        }
    }

    /// A request leaves for drive `index` now.
    fn depart_to(&mut self, index: usize, request: Datagram<'_>) {
        let due = self.now + self.options.latency_ns;
        let blow = self.stations[index].pass_request(self.now, due, request, &mut self.under_way);
        self.strike(index, blow);
    }
}

/// Adds one delivery to the digest: a multiplicative hash by words, since this runs for every datagram.
fn record(digest: &mut u64, at: Time, parcel: &Parcel) {
    let mut add = |word: u64| *digest = (digest.rotate_left(5) ^ word).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    add(at.0);
    for address in [parcel.from, parcel.to] {
        add(u64::from(address.ip().to_bits()) << 16 | u64::from(address.port()));
    }
    add((parcel.signal as u64) << 32 | parcel.bytes.len() as u64);
    for chunk in parcel.bytes.chunks(8) {
        let mut word = [0; 8];
        word[..chunk.len()].copy_from_slice(chunk);
        add(u64::from_le_bytes(word));
    }
}

/// A carrier of datagrams in a world.
#[derive(Debug)]
struct Socket {
    world: World,
    address: SocketAddrV4,
    options: UdpOptions,
    /// Those of the present `receive`.
    taken: Vec<Parcel>,
}

impl Datagrams for Socket {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let mut inner = self.world.lock();
        let mut stamp = inner.read();
        for index in 0..outbox.len() {
            if outbox.sent(index) == Sent::Posted {
                if self.options.send == SendMode::Each {
                    stamp = inner.read();
                }
                let (to, bytes) = (outbox.peer(index), outbox.bytes(index));
                inner.depart(Datagram { from: self.address, to, bytes });
                outbox.note(index, Sent::At(stamp));
            }
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let mut inner = self.world.lock();
        let at = inner.read();
        if let Some(port) = inner.ports.iter_mut().find(|port| port.address == self.address) {
            let count = port.inbox.len().min(BATCH);
            self.taken.extend(port.inbox.drain(..count));
        }
        // `take` may look at the world.
        drop(inner);
        for parcel in &self.taken {
            take(Received {
                from: parcel.from,
                at,
                bytes: &parcel.bytes[..parcel.bytes.len().min(self.options.room)],
                truncated: parcel.bytes.len() > self.options.room,
            });
        }
        let count = self.taken.len();
        if count > 0 {
            let mut inner = self.world.lock();
            self.taken.drain(..).for_each(|parcel| inner.under_way.recycle(parcel));
        }
        Ok(count)
    }

    fn batch(&self) -> usize {
        BATCH
    }

    fn dropped(&self) -> u64 {
        let inner = self.world.lock();
        inner.port(self.address).map_or(0, |port| inner.ports[port].dropped)
    }

    /// Virtual time is never real time: nothing to lock.
    fn memory(&self, _regions: &mut Regions) {}
}

/// The address is free again, as when a socket is closed.
impl Drop for Socket {
    fn drop(&mut self) {
        self.world.lock().ports.retain(|port| port.address != self.address);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::{MS, S, US};
    use std::net::Ipv4Addr;

    const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 41136);
    const STRANGER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 9, 9), 5);

    fn drive(n: u8) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::new(10, 0, 1, n), 49360)
    }

    /// Answers with what it got and how often it was asked since its start.
    struct Echo {
        address: SocketAddrV4,
        faults: FaultPlan,
        asked: u8,
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
            self.asked = self.asked.wrapping_add(1);
            reply.extend_from_slice(bytes);
            reply.push(self.asked);
            Some(from)
        }

        fn inhibit(&mut self, _until: Time) {}

        fn restart(&mut self, _now: Time) {
            self.asked = 0;
        }
    }

    fn world(count: u8, faults: FaultPlan, options: WorldOptions) -> World {
        let drives = (0..count).map(|n| {
            let faults = FaultPlan { seed: faults.seed + u64::from(n), ..faults.clone() };
            Box::new(Echo { address: drive(n), faults, asked: 0 }) as Box<dyn SimDrive>
        });
        World::new(drives.collect(), options).unwrap()
    }

    /// One carrier and a message to each of `count` drives.
    struct Master {
        world: World,
        carrier: Box<dyn Datagrams>,
        outbox: Outbox,
    }

    impl Master {
        fn new(world: &World, count: u8, send: SendMode) -> Master {
            let options = UdpOptions { peers: usize::from(count), waiting: 0, room: 16, send };
            let carrier = world.datagrams(MASTER, &options).unwrap();
            let outbox = Outbox::new(&(0..count).map(drive).collect::<Vec<_>>(), 16);
            Master { world: world.clone(), carrier, outbox }
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
            while self
                .carrier
                .receive(&mut |r| got.push((r.at, r.from, r.bytes.to_vec(), r.truncated)))
                .unwrap()
                == self.carrier.batch()
            {}
            got
        }

        /// A cycle of 1 ms with a window of half of it; what arrived in the window.
        fn cycle(&mut self) -> usize {
            let mut clock = self.world.clock();
            let grid = clock.now();
            self.send();
            let (mut got, mut set) = (0, PollSet::default());
            while clock.wait(&mut set, grid + MS / 2) {
                got += self.receive().len();
            }
            clock.sleep_until(grid + MS);
            got
        }
    }

    #[test]
    fn a_round_trip_takes_two_latencies_and_the_answer_time() {
        let faults = FaultPlan { answer_ns: 100 * US, ..FaultPlan::default() };
        let world = world(1, faults, WorldOptions { read_ns: 0, ..WorldOptions::default() });
        let mut master = Master::new(&world, 1, SendMode::Batch);
        let begin = world.now();
        master.send();
        assert_eq!(master.outbox.sent(0), Sent::At(begin));
        assert!(master.receive().is_empty());
        assert!(!world.clock().wait(&mut PollSet::default(), begin + 139 * US));
        assert_eq!(world.now(), begin + 139 * US);
        assert!(world.clock().wait(&mut PollSet::default(), begin + MS));
        assert_eq!(master.receive(), [(begin + 140 * US, drive(0), vec![0, 1], false)]);
    }

    #[test]
    fn reading_the_clock_takes_time_and_lets_things_happen() {
        let world = world(1, FaultPlan::default(), WorldOptions::default());
        let mut clock = world.clock();
        let begin = clock.now();
        assert_eq!(clock.now(), begin + 50);
        let mut master = Master::new(&world, 1, SendMode::Batch);
        master.send();
        // Polled without a wait in between: the reply comes all the same.
        while master.receive().is_empty() {}
        assert_eq!(world.now(), begin + 50 + 50 + 40 * US);
    }

    #[test]
    fn each_message_has_its_own_stamp_in_that_mode() {
        let world = world(3, FaultPlan::default(), WorldOptions::default());
        let mut master = Master::new(&world, 3, SendMode::Each);
        let t = world.now();
        master.send();
        let sent: Vec<_> = (0..3).map(|k| master.outbox.sent(k)).collect();
        assert_eq!(sent, [Sent::At(t + 100), Sent::At(t + 150), Sent::At(t + 200)]);
    }

    #[test]
    fn the_same_seed_makes_the_same_world() {
        let stormy = FaultPlan {
            seed: 3,
            drop: 0.05,
            duplicate: 0.05,
            corrupt: 0.05,
            delay: 0.05,
            delay_ns: MS,
            reorder: 0.05,
            stall: 0.01,
            stall_ns: 3 * MS,
            restart: 0.01,
            inhibit: 0.01,
            inhibit_ns: 1_000_000,
            wrong_id: 0.05,
            split: 0.0,
            cut: 0.0,
            answer_ns: 30 * US,
        };
        let run = |faults: &FaultPlan, seed| {
            let options = WorldOptions { seed, wake_ns: 20 * US, ..WorldOptions::default() };
            let world = world(5, faults.clone(), options);
            let mut master = Master::new(&world, 5, SendMode::Batch);
            let got: usize = (0..2_000).map(|_| master.cycle()).sum();
            (world.digest(), world.now(), got, (0..5).map(|n| world.injected(drive(n))).collect::<Vec<_>>())
        };
        let first = run(&stormy, 1);
        assert_eq!(first, run(&stormy, 1));
        assert_ne!(first.0, run(&stormy, 2).0);
        assert_ne!(first.0, run(&FaultPlan { seed: 4, ..stormy }, 1).0);
    }

    #[test]
    fn a_hold_up_delays_one_wake_and_loses_nothing() {
        let world = world(1, FaultPlan::default(), WorldOptions::default());
        let mut master = Master::new(&world, 1, SendMode::Batch);
        let mut clock = world.clock();
        let begin = world.now();
        master.send();
        world.delay_next_wake(3 * MS);
        clock.sleep_until(begin + MS);
        assert_eq!(world.now(), begin + 4 * MS);
        assert_eq!(master.receive().len(), 1);
        clock.sleep_until(begin + 5 * MS);
        assert_eq!(world.now(), begin + 5 * MS);
        clock.sleep_until(begin);
        assert_eq!(world.now(), begin + 5 * MS);
    }

    #[test]
    fn wake_ups_are_late_but_never_early() {
        let options = WorldOptions { seed: 9, wake_ns: 10 * US, ..WorldOptions::default() };
        let world = world(0, FaultPlan::default(), options);
        let mut clock = world.clock();
        let late: Vec<u64> = (1..=1_000)
            .map(|k| {
                let at = Time(1_000 * crate::time::S) + k * MS;
                clock.sleep_until(at);
                assert!(world.now() >= at);
                world.now().since(at)
            })
            .collect();
        assert!(late.iter().all(|ns| *ns <= 10 * US) && late.iter().any(|ns| *ns > 9 * US));
    }

    #[test]
    fn a_stranger_is_heard_at_its_instant() {
        let world = world(1, FaultPlan::default(), WorldOptions { read_ns: 0, ..WorldOptions::default() });
        let mut master = Master::new(&world, 0, SendMode::Batch);
        let begin = world.now();
        world.inject(MASTER, STRANGER, &[9; 17], begin + MS);
        world.inject(drive(0), STRANGER, &[1], begin);
        assert!(world.clock().wait(&mut PollSet::default(), begin + S));
        assert_eq!(master.receive(), [(begin + MS, STRANGER, vec![9; 16], true)]);
        assert_eq!(world.delivered(), 2);
    }

    #[test]
    fn what_finds_no_room_at_a_carrier_is_lost_and_counted() {
        let world = world(0, FaultPlan::default(), WorldOptions::default());
        let mut master = Master::new(&world, 0, SendMode::Batch);
        (0..INBOX + 7).for_each(|_| world.inject(MASTER, STRANGER, &[9], world.now()));
        world.advance(1);
        assert_eq!(master.carrier.dropped(), 7);
        assert_eq!(master.receive().len(), INBOX);
        world.inject(MASTER, STRANGER, &[9], world.now());
        world.advance(1);
        assert_eq!((master.receive().len(), master.carrier.dropped()), (1, 7));
    }

    #[test]
    fn the_plug_the_switch_and_the_faults_can_be_pulled_in_between() {
        let world = world(2, FaultPlan::default(), WorldOptions::default());
        let mut master = Master::new(&world, 2, SendMode::Batch);
        assert_eq!((master.cycle(), master.cycle()), (2, 2));
        assert!(world.unplug(drive(0)) && !world.unplug(drive(7)));
        assert_eq!((master.cycle(), master.cycle()), (1, 1));
        assert!(world.plug(drive(0)) && world.restart(drive(1)));
        master.send();
        world.advance(MS);
        let counts: Vec<_> = master.receive().into_iter().map(|got| got.2[1]).collect();
        assert_eq!(counts, [3, 1]);
        assert!(world.set_faults(drive(1), FaultPlan { drop: 1.0, ..FaultPlan::default() }));
        assert_eq!(master.cycle(), 1);
        assert_eq!(world.injected(drive(1)), Some(Injected { dropped: 1, ..Injected::default() }));
        assert_eq!(world.injected(drive(7)), None);
    }

    #[test]
    fn an_address_has_one_owner_until_it_is_dropped() {
        let world = world(1, FaultPlan::default(), WorldOptions::default());
        let options = UdpOptions { peers: 1, waiting: 0, room: 16, send: SendMode::Batch };
        let refused = |at| world.datagrams(at, &options).map(|_| ()).unwrap_err().kind();
        let first = world.datagrams(MASTER, &options).unwrap();
        assert_eq!(refused(MASTER), io::ErrorKind::AddrInUse);
        assert_eq!(refused(drive(0)), io::ErrorKind::AddrInUse);
        drop(first);
        assert!(world.datagrams(MASTER, &options).is_ok());
    }
}
