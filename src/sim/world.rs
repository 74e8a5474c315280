//! Virtual time, and a network in memory with simulated drives on it.
//!
//! The world is a clock and a carrier at once: time passes only when the code under test reads the clock, sleeps or
//! waits, and everything due by then happens on the way, in order. The same seed and the same calls give the same
//! bytes at the same instants; [`World::digest`] expresses this in one number. Nothing here is specific to a
//! protocol.
//!
//! | file | what |
//! |---|---|
//! | `clock` | its clock |
//! | `datagrams` | datagrams from carrier to drive and back |
//! | `streams` | connections |
//! | `lines` | segments, and their frames |

mod clock;
mod datagrams;
mod lines;
mod streams;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

pub use self::clock::WorldClock;

use self::datagrams::{Port, Socket};
use self::lines::Wires;
use self::streams::Links;
use super::fault::{Blow, Datagram, Injected, Injector, Parcel, Queue, Signal, Way};
use super::{Carrier, FaultPlan, SimDrive, Simulated};
use crate::net::{
    Carriers, Datagrams, Frames, Outbox, Received, SendMode, Sent, StreamPeer, Streams, UdpOptions,
};
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
/// The time of one turn of a spinning wait, ns.
const SPIN_NS: u64 = 50;

/// How a world behaves.
#[derive(Clone, Debug, PartialEq)]
pub struct WorldOptions {
    /// Seed of the wake-up latencies. The drives' faults have their own seeds.
    pub seed: u64,
    /// When the world begins. Default: 1000 s, since no machine's clock stands at zero.
    pub start: Time,
    /// The time of one reading of the clock, ns. Default 50.
    pub read_ns: u64,
    /// Time of a datagram from one end of the wire to the other, ns. Default 20 000.
    pub latency_ns: u64,
    /// The most that a sleep or a wait wakes up late, ns; uniformly distributed from 0. Default 0.
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
    /// Two drives with one address, or two segments on one interface.
    pub fn new(simulated: impl Into<Simulated>, options: WorldOptions) -> io::Result<World> {
        let Simulated { drives, lines } = simulated.into();
        let mut stations: Vec<_> = drives.into_iter().map(Station::new).collect();
        stations.sort_by_key(|station| station.address);
        if let Some(pair) = stations.windows(2).find(|pair| pair[0].address == pair[1].address) {
            return Err(taken(pair[0].address));
        }
        Ok(World(Arc::new(Mutex::new(Inner {
            now: options.start,
            random: fastrand::Rng::with_seed(options.seed),
            hold_up_ns: 0,
            suspended_ns: 0,
            options,
            stations,
            next_station: 0,
            ports: Vec::new(),
            links: Links::default(),
            wires: Wires::new(lines)?,
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

    /// The present instant. This reading takes no time.
    pub fn now(&self) -> Time {
        self.lock().now
    }

    /// Lets `ns` pass, as work of that length.
    pub fn advance(&self, ns: u64) {
        let mut inner = self.lock();
        let at = inner.now + ns;
        inner.run(at);
    }

    /// Delays the next sleep that ends: it wakes up `ns` later than it would have, as if the machine had been busy.
    pub fn delay_next_wake(&self, ns: u64) {
        self.lock().hold_up_ns = ns;
    }

    /// Suspends the computer of the master for `ns`, which its clock does not count. The drives stand still meanwhile,
    /// too.
    pub fn suspend(&self, ns: u64) {
        self.lock().suspended_ns += ns;
    }

    /// Puts a foreign datagram on the wire, to arrive at `to` at the instant `at`, or now if that has passed.
    pub fn inject(&self, to: SocketAddrV4, from: SocketAddrV4, bytes: &[u8], at: Time) {
        let mut inner = self.lock();
        let due = at.max(inner.now);
        let parcel = inner.under_way.parcel(Datagram { from, to, bytes });
        inner.under_way.push(due, parcel);
    }

    /// Unplugs the network cable of the drive at `address`; the drive goes on by itself. Datagrams are lost; bytes
    /// sent on a connection wait until the cable is back or the connection is given up. False if there is no such
    /// drive.
    pub fn unplug(&self, address: SocketAddrV4) -> bool {
        self.with(address, |station, _| station.plugged = false).is_some()
    }

    /// Plugs the network cable in again. False if there is no such drive.
    pub fn plug(&self, address: SocketAddrV4) -> bool {
        let mut inner = self.lock();
        let index = inner.station(address);
        index.map(|index| inner.plug(index)).is_some()
    }

    /// Switches the drive at `address` off and on again; its connections are reset. False if there is no such
    /// drive.
    pub fn restart(&self, address: SocketAddrV4) -> bool {
        let mut inner = self.lock();
        let index = inner.station(address);
        index.map(|index| inner.strike(index, Some(Blow::Restart))).is_some()
    }

    /// Opens the hardware enable (STO) of the drive at `address` for `ns`. False if there is no such drive.
    pub fn inhibit(&self, address: SocketAddrV4, ns: u64) -> bool {
        self.with(address, |station, now| station.drive.inhibit(now + ns)).is_some()
    }

    /// The wire of the drive at `address` has the faults of `plan` from now on; its counters restart. False if
    /// there is no such drive.
    pub fn set_faults(&self, address: SocketAddrV4, plan: FaultPlan) -> bool {
        self.with(address, |station, _| station.injector.change(plan)).is_some()
    }

    /// The faults of the wire of the drive at `address` so far.
    pub fn injected(&self, address: SocketAddrV4) -> Option<Injected> {
        self.with(address, |station, _| station.injector.injected())
    }

    /// A hash over everything delivered so far, datagrams and frames: instants, addresses and bytes, in order.
    pub fn digest(&self) -> u64 {
        self.lock().digest
    }

    /// How many datagrams and frames were delivered so far, to drives, segments and carriers.
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

    fn frames(&self, interface: &str, ethertype: u16) -> io::Result<Box<dyn Frames>> {
        Ok(Box::new(self.open_frames(interface, ethertype)?))
    }
}

fn taken(address: impl std::fmt::Display) -> io::Error {
    io::Error::new(io::ErrorKind::AddrInUse, format!("{address} is taken in this world"))
}

struct Inner {
    now: Time,
    random: fastrand::Rng,
    /// Delay of the next sleep.
    hold_up_ns: u64,
    suspended_ns: u64,
    options: WorldOptions,
    /// By address.
    stations: Vec<Station>,
    /// The index after the one found last.
    next_station: usize,
    ports: Vec<Port>,
    links: Links,
    wires: Wires,
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
    /// The peers that have a connection with it.
    peers: Vec<SocketAddrV4>,
}

impl Station {
    fn new(drive: Box<dyn SimDrive>) -> Station {
        let (address, carrier) = (drive.address(), drive.carrier());
        let injector = Injector::new(drive.faults(), carrier);
        Station { address, drive, injector, plugged: true, carrier, peers: Vec::with_capacity(PEERS) }
    }

    /// Puts a request to it under way, to arrive at `due` without a fault.
    fn pass_request(
        &mut self,
        now: Time,
        due: Time,
        request: Datagram<'_>,
        queue: &mut Queue,
    ) -> Option<Blow> {
        self.injector.pass(Way::Request, now, due, request, |bytes| self.drive.mislabel(bytes), queue)
    }
}

impl Inner {
    /// A master addresses its drives in order, so that the next one is the usual match.
    fn station(&mut self, address: SocketAddrV4) -> Option<usize> {
        let index = match self.stations.get(self.next_station) {
            Some(station) if station.address == address => self.next_station,
            _ => self.stations.binary_search_by_key(&address, |station| station.address).ok()?,
        };
        self.next_station = index + 1;
        Some(index)
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

    /// Lets everything happen that is due by `at`; then it is `at`. Of what is due at one instant datagrams come
    /// first, then frames.
    fn run(&mut self, at: Time) {
        while let Some(due) = self.next_due().filter(|due| *due <= at) {
            self.now = self.now.max(due);
            if let Some((_, parcel)) = self.under_way.pop(due) {
                self.deliver(parcel);
            } else if !self.deliver_frame(due) {
                self.ring();
            }
        }
        self.now = self.now.max(at);
    }

    /// When the next thing happens.
    fn next_due(&self) -> Option<Time> {
        [self.under_way.next_due(), self.wires.next_due(), self.links.alarm()].into_iter().flatten().min()
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
