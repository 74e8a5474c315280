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
//! | `segments` | segments, and their frames |
//! | `wires` | serial wires, and their bytes |

mod clock;
mod datagrams;
mod segments;
mod streams;
#[cfg(test)]
pub(crate) mod tests;
mod wires;

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

pub use self::clock::WorldClock;

use self::datagrams::{Port, Socket};
use self::segments::Segments;
use self::streams::Links;
use self::wires::Wires;
use super::drives::Drives;
use super::fault::{Datagram, DriveFault, Injected, Parcel, Queue};
use super::{Carrier, FaultPlan, Simulated};
use fieldbeat_core::net::{
    Carriers, Datagrams, Frames, Groups, Outbox, Received, Sent, Serial, SerialLine, StreamPeer, Streams,
    UdpOptions,
};
use fieldbeat_core::rt::{Clock, PollSet, Regions};
use fieldbeat_core::time::Time;

/// The most datagrams under way at once; more are lost, as in a switch.
const UNDER_WAY: usize = 16_384;
/// The most datagrams that wait at one carrier; more are lost, as in a socket buffer.
const INBOX: usize = 4_096;
/// The most datagrams of one `receive`, as on real sockets.
const BATCH: usize = 64;
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
            start: Time(1_000 * fieldbeat_core::time::S),
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
    /// Two drives with one address, two segments on one interface, or two serial wires at one port.
    pub fn new(simulated: impl Into<Simulated>, options: WorldOptions) -> io::Result<World> {
        let Simulated { drives, segments, wires } = simulated.into();
        Ok(World(Arc::new(Mutex::new(Inner {
            now: options.start,
            random: fastrand::Rng::with_seed(options.seed),
            hold_up_ns: 0,
            suspended_ns: 0,
            options,
            drives: Drives::new(drives, |address, _| taken(address))?,
            ports: Vec::new(),
            links: Links::default(),
            segments: Segments::new(segments)?,
            wires: Wires::new(wires)?,
            under_way: Queue::new(UNDER_WAY),
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
        let mut inner = self.lock();
        let drive = inner.drives.at(address);
        drive.map(|drive| inner.drives.units[drive].plugged = false).is_some()
    }

    /// Plugs the network cable in again. False if there is no such drive.
    pub fn plug(&self, address: SocketAddrV4) -> bool {
        let mut inner = self.lock();
        let drive = inner.drives.at(address);
        drive.map(|drive| inner.plug(drive)).is_some()
    }

    /// Switches the drive at `address` off and on again; its connections are reset. False if there is no such
    /// drive.
    pub fn restart(&self, address: SocketAddrV4) -> bool {
        let mut inner = self.lock();
        let drive = inner.drives.at(address);
        drive.map(|drive| inner.inject(drive, Some(DriveFault::Restart))).is_some()
    }

    /// Opens the hardware enable (STO) of the drive at `address` for `ns`. False if there is no such drive.
    pub fn open_sto(&self, address: SocketAddrV4, ns: u64) -> bool {
        let mut inner = self.lock();
        let (until, drive) = (inner.now + ns, inner.drives.at(address));
        drive.map(|drive| inner.inject(drive, Some(DriveFault::OpenSto(until)))).is_some()
    }

    /// What passes the drive's socket at `address` has the faults of `plan` from now on; its counters restart. False if
    /// there is no such socket.
    pub fn set_faults(&self, address: SocketAddrV4, plan: FaultPlan) -> bool {
        let mut inner = self.lock();
        let station = inner.drives.station_at(address);
        station.map(|station| station.injector.change(plan)).is_some()
    }

    /// The faults of the drive's socket at `address` so far.
    pub fn injected(&self, address: SocketAddrV4) -> Option<Injected> {
        self.lock().drives.station_at(address).map(|station| station.injector.injected())
    }

    /// A hash over everything delivered so far, datagrams and frames: instants, addresses and bytes, in order.
    pub fn digest(&self) -> u64 {
        self.lock().digest
    }

    /// How many datagrams and frames were delivered so far, to drives, segments and carriers.
    pub fn delivered(&self) -> u64 {
        self.lock().delivered
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // A test that panicked elsewhere shall fail there, not here.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Carriers for World {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        let mut inner = self.lock();
        if inner.drives.at(bind).is_some() || inner.ports.iter().any(|port| port.address == bind) {
            return Err(taken(bind));
        }
        let port = Port::new(bind, options.groups);
        let groups = port.groups();
        inner.ports.push(port);
        drop(inner);
        Ok(Box::new(Socket {
            world: self.clone(),
            address: bind,
            options: *options,
            groups,
            taken: Vec::with_capacity(BATCH),
        }))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        Ok(Box::new(self.open_streams(peers)))
    }

    fn serial(&self, port: &str, line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        Ok(Box::new(self.open_serial(port, line)?))
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
    drives: Drives,
    ports: Vec<Port>,
    links: Links,
    segments: Segments,
    wires: Wires,
    under_way: Queue,
    digest: u64,
    delivered: u64,
}

impl std::fmt::Debug for Inner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Inner")
            .field("now", &self.now)
            .field("drives", &self.drives.units.len())
            .field("delivered", &self.delivered)
            .field("digest", &self.digest)
            .finish_non_exhaustive()
    }
}

impl Inner {
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
    /// first, then frames, then the bytes of serial wires, then the drives' own clocks.
    fn run(&mut self, at: Time) {
        while let Some(due) = self.next_due().filter(|due| *due <= at) {
            self.now = self.now.max(due);
            if let Some((_, parcel)) = self.under_way.pop(due) {
                self.deliver(parcel);
            } else if !self.deliver_frame(due) && !self.pass_wires(due) && !self.run_drive() {
                self.ring();
            }
        }
        self.now = self.now.max(at);
    }

    /// When the next thing happens.
    fn next_due(&self) -> Option<Time> {
        let moving = [self.under_way.next_due(), self.segments.next_due(), self.wires.next_due()];
        moving.into_iter().chain([self.drives.next_due(), self.links.alarm()]).flatten().min()
    }

    fn deliver(&mut self, parcel: Parcel) {
        let port = if parcel.carrier == Carrier::Datagrams { self.port(parcel.to) } else { None };
        let used_up = if let Some(index) = port {
            self.take_in_datagram(index, parcel)
        } else if parcel.to.ip().is_multicast() {
            self.take_in_group(parcel)
        } else if let Some(index) = self.drives.station(parcel.carrier, parcel.to) {
            self.receive(index, parcel)
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
