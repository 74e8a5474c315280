//! Simulated drives on real sockets: one thread that waits for the requests of all of them.
//!
//! Each drive has a socket bound to its own address, so that the master meets it where it would meet the real one: for
//! datagrams, or one that listens, and its connections. Nothing here knows a protocol.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::os::fd::AsFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::{self, JoinHandle};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::eventfd::{EfdFlags, EventFd};
use nix::sys::socket::{setsockopt, sockopt};
use nix::sys::time::TimeSpec;

use super::fault::{Blow, Datagram, Injected, Injector, Parcel, Queue, Signal, Way, wrong_port};
use super::{Carrier, SimDrive};
use crate::rt::{self, MonotonicClock};
use crate::time::{S, Time};

/// Datagrams under way a drive; more are lost and counted.
const UNDER_WAY: usize = 64;
/// Longer than any UDP datagram.
const ROOM: usize = 65_536;
/// The most that is taken from a connection at once, bytes: many requests. The rest waits in its socket.
const CHUNK: usize = 4_096;
/// The most that the peer of a connection leaves unread beyond what the kernel holds, bytes; then the connection ends.
const UNREAD: usize = 65_536;
/// Connections of a drive; more are refused, whatever the drive says. Sixty drives then fit into the usual 1024 descriptors.
const CONNECTIONS: usize = 16;
/// Connections that may wait at a socket that listens: those of [`TcpListener`].
const BACKLOG: usize = 128;
/// A peer that is silent for so long is asked for a sign of life, s, ...
const KEEP_IDLE: u32 = 10;
/// ... so often, in pauses of so many seconds; then its connection ends, as it does with real drives.
const KEEP_PROBES: u32 = 3;
/// The event that is no socket's.
const STOP: u64 = u64::MAX;

/// How the thread of a [`SimServer`] runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ServerOptions {
    /// The core it is pinned to; not the loop's. Default: any.
    pub core: Option<usize>,
    /// Its SCHED_FIFO priority, 1 ... 99; below the loop's. Default: an ordinary thread.
    pub priority: Option<u8>,
}

/// Exact counts of one drive on a real socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DriveStats {
    /// The drive.
    pub address: SocketAddrV4,
    /// Datagrams that came to its socket, before any fault; on connections, what came at once.
    pub received: u64,
    /// Replies handed to the kernel, after all faults; each byte of one that is split.
    pub answered: u64,
    /// Replies that the kernel refused, or whose connection had ended.
    pub unsent: u64,
    /// Its connections; none for a drive on datagrams.
    pub connections: ConnectionStats,
    /// The faults that were injected.
    pub injected: Injected,
}

/// Exact counts of the connections of one drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ConnectionStats {
    /// Those that were accepted.
    pub accepted: u64,
    /// Those that were refused.
    pub refused: u64,
    /// Those that are open now.
    pub open: u64,
}

/// Simulated drives, served until this is stopped or dropped.
#[derive(Debug)]
pub struct SimServer {
    stats: Arc<[Mutex<DriveStats>]>,
    stop: Arc<EventFd>,
    thread: Option<JoinHandle<()>>,
    realtime: bool,
}

impl SimServer {
    /// Binds a socket for each drive and serves them on one thread. Start a second server for a second thread.
    ///
    /// A core or priority that cannot be had is no error: see [`realtime`](Self::realtime).
    ///
    /// # Errors
    ///
    /// A socket that cannot be bound, with its address in the message; no descriptors or threads left.
    pub fn start(drives: Vec<Box<dyn SimDrive>>, options: ServerOptions) -> io::Result<SimServer> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        let stop = Arc::new(EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?);
        epoll.add(&*stop, EpollEvent::new(EpollFlags::EPOLLIN, STOP))?;

        let mut stations = drives.into_iter().map(Station::open).collect::<io::Result<Vec<_>>>()?;
        stations.sort_by_key(|station| station.address);
        if let Some(pair) = stations.windows(2).find(|pair| pair[0].address == pair[1].address) {
            let (error, carrier) = (io::ErrorKind::AddrInUse.into(), pair[0].drive.carrier());
            return Err(unbound(pair[0].address, carrier, error));
        }
        for (index, station) in stations.iter().enumerate() {
            station.door.watch(&epoll, token(index, DOOR))?;
        }
        let stats: Arc<[_]> = stations.iter().map(|station| Mutex::new(station.stats())).collect();
        let queue = Queue::new(UNDER_WAY * stations.len());
        let mut service =
            Service { epoll, stations, queue, reply: Vec::with_capacity(ROOM), stats: Arc::clone(&stats) };

        let (granted, answer) = mpsc::channel();
        let thread = thread::Builder::new().name("fieldbeat-sim".into()).spawn(move || {
            // Nobody waits for the answer any more only if the start itself was given up.
            let _ = granted.send(schedule(options));
            service.run();
        })?;
        let realtime = answer.recv().unwrap_or(false);
        Ok(SimServer { stats, stop, thread: Some(thread), realtime })
    }

    /// Whether the thread runs under SCHED_FIFO on the core, as asked. False too if no priority was asked for.
    pub fn realtime(&self) -> bool {
        self.realtime
    }

    /// The counts of each drive so far, by rising address.
    pub fn stats(&self) -> Vec<DriveStats> {
        self.stats.iter().map(|stats| *lock(stats)).collect()
    }

    /// Ends the thread, waits for it and closes the sockets. Returns the final counts.
    pub fn stop(mut self) -> Vec<DriveStats> {
        self.end();
        self.stats()
    }

    fn end(&mut self) {
        if let Some(thread) = self.thread.take() {
            // An eventfd refuses a 1 only when it is about to overflow, and then the thread wakes up all the same.
            let _ = self.stop.write(1);
            // A panic of a simulated drive has been printed by its thread.
            let _ = thread.join();
        }
    }
}

impl Drop for SimServer {
    fn drop(&mut self) {
        self.end();
    }
}

fn lock(stats: &Mutex<DriveStats>) -> MutexGuard<'_, DriveStats> {
    // Counts are whole at any instant, also after a panic.
    stats.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Gives the calling thread its core and priority; true if it now runs in real time as asked.
fn schedule(options: ServerOptions) -> bool {
    // An ordinary thread's late sleeps would blur every answer time.
    rt::thread::exact_sleeps();
    let pinned = options.core.is_none_or(|core| rt::thread::pin(core).is_ok());
    options.priority.is_some_and(|priority| rt::thread::fifo(priority).is_ok()) && pinned
}

/// One drive and its sockets.
struct Station {
    address: SocketAddrV4,
    drive: Box<dyn SimDrive>,
    injector: Injector,
    door: Door,
}

/// Where a drive is spoken to.
enum Door {
    Datagrams {
        socket: UdpSocket,
        /// Where replies with a wrong identity come from, if there are any.
        wrong: Option<UdpSocket>,
    },
    Stream {
        listener: TcpListener,
        connections: Vec<Connection>,
        /// The number of the newest connection.
        newest: u32,
    },
}

/// One connection to a drive.
struct Connection {
    number: u32,
    peer: SocketAddrV4,
    socket: TcpStream,
    /// What the peer left unread.
    unsent: Vec<u8>,
}

/// The number that is no connection's: where new ones come from.
const DOOR: u32 = 0;

/// What an event of connection `number` of station `index` is known by.
fn token(index: usize, number: u32) -> u64 {
    u64::from(number) << 32 | index as u64
}

impl Door {
    fn open(address: SocketAddrV4, carrier: Carrier, wrong: bool) -> io::Result<Door> {
        match carrier {
            Carrier::Datagrams => Ok(Door::Datagrams {
                wrong: if wrong { Some(bind(wrong_port(address))?) } else { None },
                socket: bind(address)?,
            }),
            Carrier::Stream => {
                Ok(Door::Stream { listener: listen(address)?, connections: Vec::new(), newest: DOOR })
            }
        }
    }

    fn watch(&self, epoll: &Epoll, token: u64) -> nix::Result<()> {
        match self {
            Door::Datagrams { socket, .. } => epoll.add(socket, EpollEvent::new(EpollFlags::EPOLLIN, token)),
            // By edges: a connection that cannot be taken for want of descriptors would wake up the thread for ever.
            Door::Stream { listener, .. } => {
                epoll.add(listener, EpollEvent::new(EpollFlags::EPOLLIN | EpollFlags::EPOLLET, token))
            }
        }
    }

    /// How many descriptors it has at most.
    fn descriptors(&self) -> usize {
        match self {
            Door::Datagrams { .. } => 1,
            Door::Stream { .. } => 1 + CONNECTIONS,
        }
    }

    fn connections(&mut self) -> &mut [Connection] {
        match self {
            Door::Datagrams { .. } => &mut [],
            Door::Stream { connections, .. } => connections,
        }
    }

    fn by_number(&mut self, number: u32) -> Option<&mut Connection> {
        self.connections().iter_mut().find(|connection| connection.number == number)
    }

    fn by_peer(&mut self, peer: SocketAddrV4) -> Option<&mut Connection> {
        self.connections().iter_mut().find(|connection| connection.peer == peer)
    }

    fn take(&mut self, number: u32) -> Option<Connection> {
        let Door::Stream { connections, .. } = self else { return None };
        let place = connections.iter().position(|connection| connection.number == number)?;
        Some(connections.swap_remove(place))
    }
}

/// How a connection ends.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Farewell {
    /// Behind all that was sent.
    Close,
    /// At once; nothing more arrives.
    Reset,
}

impl Connection {
    /// Hands `bytes` to the kernel, and keeps what it does not take.
    fn send(&mut self, epoll: &Epoll, index: usize, bytes: &[u8]) -> io::Result<()> {
        let taken = if self.unsent.is_empty() { taken(self.socket.write(bytes))? } else { 0 };
        let rest = &bytes[taken..];
        if rest.is_empty() {
            return Ok(());
        }
        if self.unsent.len() + rest.len() > UNREAD {
            return Err(io::ErrorKind::OutOfMemory.into());
        }
        if self.unsent.is_empty() {
            self.watch(epoll, index, EpollFlags::EPOLLIN | EpollFlags::EPOLLOUT)?;
        }
        self.unsent.extend_from_slice(rest);
        Ok(())
    }

    /// Hands over what was kept.
    fn go_on(&mut self, epoll: &Epoll, index: usize) -> io::Result<()> {
        let taken = taken(self.socket.write(&self.unsent))?;
        self.unsent.drain(..taken);
        if self.unsent.is_empty() {
            self.watch(epoll, index, EpollFlags::EPOLLIN)?;
        }
        Ok(())
    }

    fn watch(&self, epoll: &Epoll, index: usize, flags: EpollFlags) -> nix::Result<()> {
        epoll.modify(&self.socket, &mut EpollEvent::new(flags, token(index, self.number)))
    }

    fn end(self, farewell: Farewell) {
        if farewell == Farewell::Reset {
            reset(self.socket);
        }
    }
}

/// How much of it the kernel took.
fn taken(result: io::Result<usize>) -> io::Result<usize> {
    match result {
        Err(error) if not_now(&error) => Ok(0),
        other => other,
    }
}

fn not_now(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted)
}

/// Closes `socket` so that its peer knows at once.
fn reset(socket: TcpStream) {
    // Where it fails, the peer is told in the ordinary way.
    let _ = setsockopt(&socket, sockopt::Linger, &libc::linger { l_onoff: 1, l_linger: 0 });
}

/// Makes an accepted socket one of ours.
fn prepare(socket: &TcpStream) -> io::Result<()> {
    socket.set_nonblocking(true)?;
    socket.set_nodelay(true)?;
    setsockopt(socket, sockopt::KeepAlive, &true)?;
    setsockopt(socket, sockopt::TcpKeepIdle, &KEEP_IDLE)?;
    setsockopt(socket, sockopt::TcpKeepInterval, &KEEP_IDLE)?;
    setsockopt(socket, sockopt::TcpKeepCount, &KEEP_PROBES)?;
    Ok(())
}

impl Station {
    fn open(drive: Box<dyn SimDrive>) -> io::Result<Station> {
        let (address, carrier, faults) = (drive.address(), drive.carrier(), drive.faults());
        let door = Door::open(address, carrier, faults.wrong_id > 0.0)?;
        Ok(Station { address, injector: Injector::new(faults, carrier), door, drive })
    }

    fn stats(&self) -> DriveStats {
        DriveStats {
            address: self.address,
            received: 0,
            answered: 0,
            unsent: 0,
            connections: ConnectionStats::default(),
            injected: self.injector.injected(),
        }
    }

    /// Whether what comes from `peer` reaches the drive: a connection may have ended meanwhile.
    fn hears(&mut self, peer: SocketAddrV4) -> bool {
        matches!(self.door, Door::Datagrams { .. }) || self.door.by_peer(peer).is_some()
    }

    fn end(&mut self, number: u32, farewell: Farewell) {
        if let Some(connection) = self.door.take(number) {
            let peer = connection.peer;
            connection.end(farewell);
            self.drive.disconnected(MonotonicClock::read(), peer);
        }
    }

    /// What befalls the drive; a restart ends its connections.
    fn strike(&mut self, now: Time, blow: Blow) {
        if blow == Blow::Restart {
            while let Some(number) = self.door.connections().first().map(|connection| connection.number) {
                self.end(number, Farewell::Reset);
            }
        }
        blow.strike(now, &mut *self.drive);
    }

    /// Accepts one connection, if the drive wants it.
    fn welcome(&mut self, index: usize, epoll: &Epoll, socket: TcpStream, peer: SocketAddrV4) -> bool {
        // The kernel has forgotten it, the news has not come yet.
        while let Some(number) = self.door.by_peer(peer).map(|old| old.number) {
            self.end(number, Farewell::Close);
        }
        let Door::Stream { connections, newest, .. } = &mut self.door else { return false };
        let number = newest.wrapping_add(1).max(1);
        let event = EpollEvent::new(EpollFlags::EPOLLIN, token(index, number));
        let welcome = connections.len() < CONNECTIONS
            && prepare(&socket).is_ok()
            && epoll.add(&socket, event).is_ok()
            && self.drive.connect(MonotonicClock::read(), peer);
        if welcome {
            *newest = number;
            connections.push(Connection { number, peer, socket, unsent: Vec::new() });
        } else {
            reset(socket);
        }
        welcome
    }
}

fn bind(address: SocketAddrV4) -> io::Result<UdpSocket> {
    UdpSocket::bind(address)
        .and_then(|socket| socket.set_nonblocking(true).map(|()| socket))
        .map_err(|error| unbound(address, Carrier::Datagrams, error))
}

fn listen(address: SocketAddrV4) -> io::Result<TcpListener> {
    TcpListener::bind(address)
        .and_then(|socket| socket.set_nonblocking(true).map(|()| socket))
        .map_err(|error| unbound(address, Carrier::Stream, error))
}

/// Why a drive has no socket, and what to do.
fn unbound(address: SocketAddrV4, carrier: Carrier, error: io::Error) -> io::Error {
    let remedy = match (error.kind(), carrier) {
        (io::ErrorKind::AddrInUse, Carrier::Datagrams) => {
            "another simulation serves this drive: end it (ss -ulpn shows which), or give the drive another address"
        }
        (io::ErrorKind::AddrInUse, Carrier::Stream) => {
            "another simulation serves this drive: end it (ss -tlpn shows which), or give the drive another address"
        }
        (io::ErrorKind::AddrNotAvailable, _) => {
            "a simulated drive lives on this computer: give it an address like 127.0.0.11, and its bus one to bind to"
        }
        (io::ErrorKind::PermissionDenied, _) if address.port() < 1024 => {
            "ports below 1024 need rights: run as root or give the drive a port like 1502"
        }
        _ => "look at its address",
    };
    io::Error::new(error.kind(), format!("cannot bind {address}: {error}; {remedy}"))
}

/// What the thread owns.
struct Service {
    epoll: Epoll,
    /// By address.
    stations: Vec<Station>,
    queue: Queue,
    reply: Vec<u8>,
    stats: Arc<[Mutex<DriveStats>]>,
}

impl Service {
    fn run(&mut self) {
        // Room for every descriptor at once, so that none, the stop's included, waits behind busier ones.
        let room: usize = self.stations.iter().map(|station| station.door.descriptors()).sum();
        let mut events = vec![EpollEvent::empty(); room + 1];
        let mut bytes = vec![0; ROOM];
        loop {
            let count = match self.wait(&mut events) {
                Ok(count) => count,
                Err(Errno::EINTR) => 0,
                // The descriptor and the buffer are our own, so that no other error can be.
                Err(_) => return,
            };
            for event in &events[..count] {
                if event.data() == STOP {
                    return;
                }
                self.attend(event, &mut bytes);
                // At once and not after the last socket: the first drive's answer does not wait for the others.
                self.run_due();
            }
            self.run_due();
        }
    }

    /// Waits for sockets, but not beyond the next due instant.
    fn wait(&self, events: &mut [EpollEvent]) -> nix::Result<usize> {
        let Some(due) = self.queue.next_due() else {
            return self.epoll.wait(events, EpollTimeout::NONE);
        };
        // epoll_wait counts in milliseconds; ppoll waits for the same set in nanoseconds.
        let left = due.since(MonotonicClock::read());
        if left > 0 {
            let timeout = TimeSpec::new((left / S) as libc::time_t, (left % S) as libc::c_long);
            ppoll(&mut [PollFd::new(self.epoll.0.as_fd(), PollFlags::POLLIN)], Some(timeout), None)?;
        }
        self.epoll.wait(events, EpollTimeout::ZERO)
    }

    /// Does what a ready socket asks for. The epoll is level-triggered: what is left is reported again, which costs less than
    /// asking each socket for the EAGAIN behind its usually only request.
    fn attend(&mut self, event: &EpollEvent, bytes: &mut [u8]) {
        let (index, number) = (event.data() as u32 as usize, (event.data() >> 32) as u32);
        match self.stations[index].door {
            Door::Datagrams { .. } => self.receive(index, bytes),
            Door::Stream { .. } if number == DOOR => self.accept(index),
            Door::Stream { .. } => self.hear(index, number, event.events(), &mut bytes[..CHUNK]),
        }
    }

    /// Takes one datagram.
    fn receive(&mut self, index: usize, bytes: &mut [u8]) {
        let Door::Datagrams { socket, .. } = &self.stations[index].door else { return };
        if let Ok((length, SocketAddr::V4(from))) = socket.recv_from(bytes) {
            self.came(index, from, &bytes[..length]);
        }
    }

    /// Takes in the connections that wait. Those that come meanwhile make an edge of their own.
    fn accept(&mut self, index: usize) {
        for _ in 0..=BACKLOG {
            let station = &mut self.stations[index];
            let Door::Stream { listener, .. } = &station.door else { return };
            let (socket, peer) = match listener.accept() {
                Ok((socket, SocketAddr::V4(peer))) => (socket, peer),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                // It was broken off already, or there is no descriptor for it.
                _ => continue,
            };
            let welcome = station.welcome(index, &self.epoll, socket, peer);
            let connections = &mut lock(&self.stats[index]).connections;
            *(if welcome { &mut connections.accepted } else { &mut connections.refused }) += 1;
            connections.open = station.door.connections().len() as u64;
        }
    }

    /// Takes what came on a connection, once, and goes on with what its peer left unread.
    fn hear(&mut self, index: usize, number: u32, events: EpollFlags, bytes: &mut [u8]) {
        let Some(connection) = self.stations[index].door.by_number(number) else { return };
        if events.contains(EpollFlags::EPOLLOUT) && connection.go_on(&self.epoll, index).is_err() {
            return self.end(index, number, Farewell::Reset);
        }
        if !events.intersects(!EpollFlags::EPOLLOUT) {
            return;
        }
        match connection.socket.read(bytes) {
            Ok(0) => self.end(index, number, Farewell::Close),
            Ok(length) => {
                let peer = connection.peer;
                self.came(index, peer, &bytes[..length]);
            }
            Err(error) if not_now(&error) => {}
            Err(_) => self.end(index, number, Farewell::Close),
        }
    }

    fn end(&mut self, index: usize, number: u32, farewell: Farewell) {
        let station = &mut self.stations[index];
        station.end(number, farewell);
        lock(&self.stats[index]).connections.open = station.door.connections().len() as u64;
    }

    /// Sends what came on the rest of its way, through the faults.
    fn came(&mut self, index: usize, from: SocketAddrV4, bytes: &[u8]) {
        let now = MonotonicClock::read();
        let station = &mut self.stations[index];
        let request = Datagram { from, to: station.address, bytes };
        let blow = station.injector.pass(Way::Request, now, now, request, &*station.drive, &mut self.queue);
        if let Some(blow) = blow {
            station.strike(now, blow);
        }
        let mut stats = lock(&self.stats[index]);
        stats.received += 1;
        stats.connections.open = station.door.connections().len() as u64;
        stats.injected = station.injector.injected();
    }

    /// Everything that is due by now: requests to their drives, replies to the kernel.
    fn run_due(&mut self) {
        if self.queue.next_due().is_none() {
            return;
        }
        let now = MonotonicClock::read();
        while let Some((_, parcel)) = self.queue.pop(now) {
            match self.station(parcel.to) {
                Some(index) => self.serve(index, now, &parcel),
                None => self.answer(&parcel),
            }
            self.queue.recycle(parcel);
        }
    }

    fn serve(&mut self, index: usize, now: Time, parcel: &Parcel) {
        let station = &mut self.stations[index];
        if !station.hears(parcel.from) {
            return;
        }
        self.reply.clear();
        let to = station.drive.receive(now, parcel.from, &parcel.bytes, &mut self.reply);
        // No drive answers a drive: with a forged source two of them would go on for ever.
        let to = to.filter(|to| self.station(*to).is_none());
        let station = &mut self.stations[index];
        if let Some(to) = to {
            let reply = Datagram { from: station.address, to, bytes: &self.reply };
            station.injector.pass(Way::Reply, now, now, reply, &*station.drive, &mut self.queue);
            lock(&self.stats[index]).injected = station.injector.injected();
        }
        if matches!(station.door, Door::Stream { .. }) && station.drive.hangs_up(parcel.from) {
            let end = self.queue.signal(station.address, parcel.from, Signal::End);
            station.injector.signal(Way::Reply, now, end, &mut self.queue);
        }
    }

    fn answer(&mut self, parcel: &Parcel) {
        let (index, wrong) = match self.station(parcel.from) {
            Some(index) => (Some(index), false),
            None => (self.station(wrong_port(parcel.from)), true),
        };
        let Some(index) = index else { return };
        let sent = match &self.stations[index].door {
            Door::Datagrams { socket, wrong: Some(other) } => {
                (if wrong { other } else { socket }).send_to(&parcel.bytes, parcel.to).is_ok()
            }
            Door::Datagrams { socket, .. } => socket.send_to(&parcel.bytes, parcel.to).is_ok(),
            Door::Stream { .. } => match self.say(index, parcel) {
                Some(sent) => sent,
                None => return,
            },
        };
        let mut stats = lock(&self.stats[index]);
        *(if sent { &mut stats.answered } else { &mut stats.unsent }) += 1;
    }

    /// A reply to its connection: whether the kernel has it. `None`: there was nothing to be said.
    fn say(&mut self, index: usize, parcel: &Parcel) -> Option<bool> {
        let speaks = !parcel.bytes.is_empty();
        let Some(connection) = self.stations[index].door.by_peer(parcel.to) else {
            return speaks.then_some(false);
        };
        let number = connection.number;
        let sent = !speaks || connection.send(&self.epoll, index, &parcel.bytes).is_ok();
        if !sent {
            self.end(index, number, Farewell::Reset);
        } else if parcel.signal == Signal::End {
            self.end(index, number, Farewell::Close);
        }
        speaks.then_some(sent)
    }

    fn station(&self, address: SocketAddrV4) -> Option<usize> {
        self.stations.binary_search_by_key(&address, |station| station.address).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::FaultPlan;
    use crate::sim::testing::Peers;
    use crate::time::MS;
    use std::net::Ipv4Addr;
    use std::time::{Duration, Instant};

    /// The tests of this file own 127.72.x.0/24, one x each.
    fn address(x: u8, host: u8) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::new(127, 72, x, host), 49360)
    }

    /// Answers with what it got and how often it was asked since its start.
    struct Echo(SocketAddrV4, FaultPlan, u8);

    impl SimDrive for Echo {
        fn address(&self) -> SocketAddrV4 {
            self.0
        }

        fn faults(&self) -> FaultPlan {
            self.1.clone()
        }

        fn receive(
            &mut self,
            _now: Time,
            from: SocketAddrV4,
            bytes: &[u8],
            reply: &mut Vec<u8>,
        ) -> Option<SocketAddrV4> {
            self.2 = self.2.wrapping_add(1);
            reply.extend_from_slice(bytes);
            reply.push(self.2);
            Some(from)
        }

        fn inhibit(&mut self, _until: Time) {}

        fn restart(&mut self, _now: Time) {
            self.2 = 0;
        }
    }

    fn start(x: u8, hosts: std::ops::Range<u8>, faults: &FaultPlan) -> io::Result<SimServer> {
        let drives = hosts.map(|h| Box::new(Echo(address(x, h), faults.clone(), 0)) as Box<dyn SimDrive>);
        SimServer::start(drives.collect(), ServerOptions::default())
    }

    fn client(x: u8, timeout: Duration) -> UdpSocket {
        let socket = UdpSocket::bind((Ipv4Addr::new(127, 72, x, 1), 41136)).unwrap();
        socket.set_read_timeout(Some(timeout)).unwrap();
        socket
    }

    #[test]
    fn every_drive_answers_from_its_own_address() {
        let server = start(1, 10..40, &FaultPlan::default()).unwrap();
        let client = client(1, Duration::from_secs(5));
        for round in 1..=20 {
            for host in 10..40 {
                client.send_to(&[host], address(1, host)).unwrap();
            }
            let mut hosts: Vec<u8> = (10..40)
                .map(|_| {
                    let mut bytes = [0; 8];
                    let (length, from) = client.recv_from(&mut bytes).unwrap();
                    assert_eq!((length, bytes[1]), (2, round));
                    assert_eq!(from, address(1, bytes[0]).into());
                    bytes[0]
                })
                .collect();
            hosts.sort();
            assert!(hosts.into_iter().eq(10..40));
        }
        assert!(!server.realtime());
        let stats = server.stop();
        assert_eq!(stats.len(), 30);
        for (stats, host) in stats.iter().zip(10..) {
            assert_eq!((stats.address, stats.received), (address(1, host), 20));
            assert_eq!((stats.answered, stats.unsent, stats.injected), (20, 0, Injected::default()));
        }
    }

    #[test]
    fn faults_are_injected_counted_and_accounted_for() {
        let faults = FaultPlan {
            seed: 5,
            drop: 0.2,
            duplicate: 0.2,
            wrong_id: 0.2,
            restart: 0.05,
            ..FaultPlan::default()
        };
        let server = start(2, 10..11, &faults).unwrap();
        let client = client(2, Duration::from_millis(5));
        let (mut right, mut wrong) = (0, 0);
        for n in 1..=500u64 {
            client.send_to(&n.to_le_bytes(), address(2, 10)).unwrap();
            if n % 50 != 0 {
                continue;
            }
            // Now and then until all is answered, so that no socket buffer overflows.
            let begin = Instant::now();
            loop {
                if let Ok((_, from)) = client.recv_from(&mut [0; 16]) {
                    *(if from == address(2, 10).into() { &mut right } else { &mut wrong }) += 1;
                }
                let (stats, i) = (server.stats()[0], server.stats()[0].injected);
                let owed = n + i.duplicated - i.dropped - i.restarts;
                if stats.received == n && stats.answered == owed && right + wrong == owed {
                    break;
                }
                assert!(begin.elapsed() < Duration::from_secs(5), "{stats:?}: {right} right, {wrong} wrong");
            }
        }
        let i = server.stop()[0].injected;
        assert!(wrong > 0 && wrong >= i.wrong_id && i.restarts > 0 && i.dropped > 0, "{i:?}");
    }

    #[test]
    fn an_answer_takes_its_time() {
        let server = start(3, 10..12, &FaultPlan { answer_ns: 30 * MS, ..FaultPlan::default() }).unwrap();
        let client = client(3, Duration::from_secs(5));
        let begin = Instant::now();
        client.send_to(&[1], address(3, 10)).unwrap();
        client.send_to(&[2], address(3, 11)).unwrap();
        for expected in [1, 2] {
            let mut bytes = [0; 8];
            client.recv_from(&mut bytes).unwrap();
            assert_eq!(bytes[0], expected);
            assert!(begin.elapsed() >= Duration::from_millis(30));
        }
        drop(server);
    }

    #[test]
    fn an_address_in_use_is_named_and_given_back() {
        let first = start(4, 10..12, &FaultPlan::default()).unwrap();
        let error = start(4, 11..13, &FaultPlan::default()).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::AddrInUse);
        assert!(error.to_string().contains("127.72.4.11:49360"), "{error}");
        drop(first);
        drop(start(4, 10..13, &FaultPlan::default()).unwrap());
    }

    #[test]
    fn a_right_that_is_missing_is_reported_and_serves_all_the_same() {
        let options = ServerOptions { core: Some(usize::MAX), priority: Some(1) };
        let drive = Box::new(Echo(address(5, 10), FaultPlan::default(), 0));
        let server = SimServer::start(vec![drive], options).unwrap();
        assert!(!server.realtime());
        let client = client(5, Duration::from_secs(5));
        client.send_to(&[1], address(5, 10)).unwrap();
        assert_eq!(client.recv(&mut [0; 8]).unwrap(), 2);
    }

    /// Answers each request of two bytes, a number and how long the answer is in KiB, with the number, how often it was asked
    /// since its start, and so many bytes.
    struct Counter {
        address: SocketAddrV4,
        faults: FaultPlan,
        most: usize,
        asked: u8,
        peers: Peers,
    }

    /// A number at which the drive hangs up behind its answer.
    const BYE: u8 = 255;

    impl SimDrive for Counter {
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
            for [number, length] in self.peers.requests(from, bytes) {
                self.asked = self.asked.wrapping_add(1);
                reply.extend([number, self.asked]);
                reply.resize(reply.len() + usize::from(length) * 1_024, 0);
            }
            (!reply.is_empty()).then_some(from)
        }

        fn connect(&mut self, _now: Time, from: SocketAddrV4) -> bool {
            self.peers.connect(from, self.most)
        }

        fn hangs_up(&mut self, _from: SocketAddrV4) -> bool {
            self.asked == BYE
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
            self.asked = 0;
        }
    }

    fn counter(x: u8, faults: FaultPlan) -> Counter {
        Counter { address: address(x, 10), faults, most: 4, asked: 0, peers: Peers::default() }
    }

    fn serve(drive: Counter) -> SimServer {
        SimServer::start(vec![Box::new(drive)], ServerOptions::default()).unwrap()
    }

    fn connect(x: u8) -> TcpStream {
        let socket = TcpStream::connect(address(x, 10)).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        socket.set_nodelay(true).unwrap();
        socket
    }

    /// Asks with a number; the number of the answer, and how often the drive was asked.
    fn ask(socket: &mut TcpStream, number: u8) -> io::Result<[u8; 2]> {
        socket.write_all(&[number, 0])?;
        let mut answer = [0; 2];
        socket.read_exact(&mut answer).map(|()| answer)
    }

    fn until(what: &str, mut done: impl FnMut() -> bool) {
        let begin = Instant::now();
        while !done() {
            assert!(begin.elapsed() < Duration::from_secs(5), "{what}");
            thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_stream_is_answered_however_it_is_split() {
        let server = serve(counter(6, FaultPlan::default()));
        let mut sockets = [connect(6), connect(6), connect(6)];
        for round in 0..20 {
            for (n, socket) in sockets.iter_mut().enumerate() {
                assert_eq!(ask(socket, n as u8).unwrap(), [n as u8, round * 3 + n as u8 + 1]);
            }
        }
        let [first, ..] = &mut sockets;
        first.write_all(&[7]).unwrap();
        until("half a request", || server.stats()[0].received == 61);
        first.write_all(&[0, 8, 0, 9, 0]).unwrap();
        let mut answers = [0; 6];
        first.read_exact(&mut answers).unwrap();
        assert_eq!(answers, [7, 61, 8, 62, 9, 63]);
        drop(sockets);
        until("the end of all", || server.stats()[0].connections.open == 0);
        let stats = server.stop()[0];
        assert_eq!((stats.received, stats.answered, stats.unsent), (62, 61, 0));
        assert_eq!(stats.connections, ConnectionStats { accepted: 3, refused: 0, open: 0 });
    }

    #[test]
    fn who_is_refused_is_reset_and_a_place_that_is_left_is_free() {
        let server = serve(counter(7, FaultPlan::default()));
        let mut sockets: Vec<_> = (0..4).map(|_| connect(7)).collect();
        assert_eq!(ask(&mut sockets[3], 1).unwrap(), [1, 1]);
        let mut fifth = connect(7);
        assert_eq!(fifth.read(&mut [0; 8]).unwrap_err().kind(), io::ErrorKind::ConnectionReset);
        sockets.pop();
        until("the place is free", || server.stats()[0].connections.open == 3);
        assert_eq!(ask(&mut connect(7), 2).unwrap(), [2, 2]);
        assert_eq!(ask(&mut sockets[0], 3).unwrap(), [3, 3]);
        drop(sockets);
        let stats = server.stop()[0].connections;
        assert_eq!((stats.accepted, stats.refused), (5, 1));
    }

    #[test]
    fn a_drive_that_never_refuses_has_a_bound_all_the_same() {
        let server = serve(Counter { most: usize::MAX, ..counter(8, FaultPlan::default()) });
        let mut sockets: Vec<_> = (0..CONNECTIONS).map(|_| connect(8)).collect();
        let mut refused = connect(8);
        assert_eq!(refused.read(&mut [0; 8]).unwrap_err().kind(), io::ErrorKind::ConnectionReset);
        for (n, socket) in sockets.iter_mut().enumerate() {
            assert_eq!(ask(socket, n as u8).unwrap(), [n as u8, n as u8 + 1]);
        }
        let open = CONNECTIONS as u64;
        assert_eq!(server.stats()[0].connections, ConnectionStats { accepted: open, refused: 1, open });
    }

    #[test]
    fn a_drive_hangs_up_behind_its_answer() {
        let faults = FaultPlan { answer_ns: 20 * MS, split: 1.0, ..FaultPlan::default() };
        let server = serve(Counter { asked: BYE - 1, ..counter(9, faults) });
        let mut socket = connect(9);
        assert_eq!(ask(&mut socket, 5).unwrap(), [5, BYE]);
        assert_eq!(socket.read(&mut [0; 8]).unwrap(), 0);
        until("it knows", || server.stats()[0].connections.open == 0);
    }

    #[test]
    fn a_restart_resets_the_connections_and_the_drive_lets_new_ones_in() {
        let server = serve(counter(10, FaultPlan { seed: 1, restart: 0.1, ..FaultPlan::default() }));
        let mut bystander = connect(10);
        assert_eq!(ask(&mut bystander, 1).unwrap(), [1, 1]);
        let mut socket = connect(10);
        let error = (0..200).find_map(|_| ask(&mut socket, 2).err()).expect("one request in ten");
        assert_eq!(error.kind(), io::ErrorKind::ConnectionReset);
        assert_eq!(bystander.read(&mut [0; 8]).unwrap_err().kind(), io::ErrorKind::ConnectionReset);
        until("it is counted", || server.stats()[0].injected.restarts == 1);
        // By chance it restarts again at the first one.
        until("it serves anew", || ask(&mut connect(10), 3).is_ok_and(|answer| answer == [3, 1]));
    }

    #[test]
    fn faults_on_a_stream_are_injected_counted_and_accounted_for() {
        let faults = FaultPlan { seed: 2, split: 0.3, cut: 0.1, wrong_id: 0.1, ..FaultPlan::default() };
        let server = serve(counter(11, faults));
        let (mut socket, mut whole, mut cut, mut wrong) = (connect(11), 0, 0, 0);
        for _ in 0..250 {
            socket.write_all(&[1, 0]).unwrap();
            let mut answer = Vec::new();
            while answer.len() < 2 {
                let mut byte = [0];
                match socket.read(&mut byte).unwrap() {
                    0 => break,
                    _ => answer.push(byte[0]),
                }
            }
            wrong += u64::from(answer[0] == 0x81);
            match answer.len() {
                2 => whole += 1,
                _ => {
                    cut += 1;
                    socket = connect(11);
                }
            }
        }
        until("all is told", || server.stats()[0].connections.open == 1);
        let stats = server.stop()[0];
        let i = stats.injected;
        assert_eq!((i.cut, i.wrong_id, stats.unsent), (cut, wrong, 0), "{stats:?}");
        assert!(whole > 200 && cut > 5 && wrong > 5 && i.split > 100, "{stats:?}");
        // Each byte of a split one counts as a piece of its own.
        assert!(stats.received > 250 - cut && stats.answered > 250, "{stats:?}");
        assert_eq!(stats.connections.accepted, 1 + cut);
    }

    #[test]
    fn who_never_reads_loses_his_connection_and_nobody_else_does() {
        let server = serve(counter(12, FaultPlan::default()));
        let (mut idle, mut living) = (connect(12), connect(12));
        until("both are in", || server.stats()[0].connections.open == 2);
        // More than both socket buffers can ever hold; refused as soon as it is gone.
        let _ = (0..1_000).try_for_each(|_| idle.write_all(&[1, 32]));
        until("it is gone", || server.stats()[0].connections.open == 1);
        assert_eq!(ask(&mut living, 2).unwrap()[0], 2);
        assert!(server.stop()[0].unsent > 0);
    }

    #[test]
    fn what_the_kernel_does_not_take_is_kept_in_order_up_to_a_bound() {
        let listener = TcpListener::bind(address(13, 10)).unwrap();
        let mut reader = connect(13);
        let (socket, SocketAddr::V4(peer)) = listener.accept().unwrap() else { unreachable!() };
        prepare(&socket).unwrap();
        setsockopt(&socket, sockopt::SndBuf, &4_096).unwrap();
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC).unwrap();
        epoll.add(&socket, EpollEvent::new(EpollFlags::EPOLLIN, 0)).unwrap();
        let mut connection = Connection { number: 7, peer, socket, unsent: Vec::new() };
        let mut numbers = (0..10_000_000_u32).map(u32::to_be_bytes);
        let mut sent = Vec::new();
        let mut send = |connection: &mut Connection, sent: &mut Vec<u8>| {
            let piece: Vec<u8> = numbers.by_ref().take(256).flatten().collect();
            let taken = connection.send(&epoll, 0, &piece).is_ok();
            if taken {
                sent.extend(piece);
            }
            taken
        };
        while connection.unsent.is_empty() {
            assert!(send(&mut connection, &mut sent));
        }
        while send(&mut connection, &mut sent) {}
        assert!((UNREAD - 1_024..=UNREAD).contains(&connection.unsent.len()));

        let mut got = vec![0; sent.len()];
        let mut place = 0;
        while place < got.len() {
            let mut events = [EpollEvent::empty()];
            if epoll.wait(&mut events, EpollTimeout::ZERO) == Ok(1) {
                assert_eq!((events[0].events(), events[0].data()), (EpollFlags::EPOLLOUT, token(0, 7)));
                connection.go_on(&epoll, 0).unwrap();
            }
            place += reader.read(&mut got[place..]).unwrap();
        }
        assert!(got == sent && connection.unsent.is_empty());
        // It waits for nothing more.
        assert_eq!(epoll.wait(&mut [EpollEvent::empty()], EpollTimeout::ZERO), Ok(0));
    }

    #[test]
    fn an_address_that_listens_already_is_named_with_the_remedy() {
        let first = serve(counter(14, FaultPlan::default()));
        let twin = || Box::new(counter(14, FaultPlan::default())) as Box<dyn SimDrive>;
        for drives in [vec![twin()], vec![twin(), twin()]] {
            let error = SimServer::start(drives, ServerOptions::default()).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::AddrInUse);
            let text = error.to_string();
            assert!(text.contains("127.72.14.10:49360") && text.contains("ss -tlpn"), "{text}");
        }
        // Its connections linger in the kernel; the address is free all the same.
        let mut socket = connect(14);
        assert_eq!(ask(&mut socket, 1).unwrap(), [1, 1]);
        drop(first);
        drop(serve(counter(14, FaultPlan::default())));
    }

    #[test]
    fn a_port_without_rights_is_told_as_such() {
        let text = |port, carrier| {
            let address = SocketAddrV4::new(Ipv4Addr::LOCALHOST, port);
            unbound(address, carrier, io::ErrorKind::PermissionDenied.into()).to_string()
        };
        assert!(text(502, Carrier::Stream).contains("run as root or give the drive a port like 1502"));
        assert!(!text(1_502, Carrier::Stream).contains("root"));
    }
}
