//! The work of a server's thread: it waits for all sockets, and serves what is due.

use std::io::{self, Read};
use std::net::{SocketAddr, SocketAddrV4};
use std::os::fd::AsFd;
use std::sync::{Arc, Mutex};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::eventfd::EventFd;
use nix::sys::time::TimeSpec;

use super::segments::Segment;
use super::sockets::{EVERYBODY, Farewell, LISTENER, SharedBus, Socket, not_now, token, unbound};
use super::wires::Wire;
use super::{BusStats, ConnectionStats, DriveStats, lock};
use crate::drives::Drives;
use crate::fault::{DriveFault, Injected, Parcel, Queue, Signal, wrong_port};
use crate::{Carrier, Simulated};
use fieldbeat_core::rt::MonotonicClock;
use fieldbeat_core::time::{S, Time};

/// Datagrams under way per drive; more are lost and counted.
const UNDER_WAY: usize = 64;
/// Longer than any UDP datagram.
const ROOM: usize = 65_536;
/// The most that is taken from a connection at once, bytes: many requests. The rest waits in its socket.
const CHUNK: usize = 4_096;
/// Connections that may wait at a socket that listens: those of [`TcpListener`](std::net::TcpListener).
const BACKLOG: usize = 128;
/// The event of no socket.
const STOP: u64 = u64::MAX;

/// What the thread owns.
pub(super) struct Service {
    epoll: Epoll,
    drives: Drives,
    /// Each at the index of its station.
    sockets: Vec<Socket>,
    /// Their events follow those of the sockets.
    buses: Vec<Box<dyn SharedBus>>,
    queue: Queue,
    stats: Stats,
}

/// The counts, each at the index of its socket or bus.
#[derive(Clone)]
pub(super) struct Stats {
    pub(super) drives: Arc<[Mutex<DriveStats>]>,
    pub(super) buses: Arc<[Mutex<BusStats>]>,
}

impl Service {
    /// Binds all sockets; an event of `stop` ends it.
    pub(super) fn open(simulated: Simulated, stop: &EventFd) -> io::Result<Service> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        epoll.add(stop, EpollEvent::new(EpollFlags::EPOLLIN, STOP))?;
        let taken = |address, carrier| unbound(address, carrier, io::ErrorKind::AddrInUse.into());
        let drives = Drives::new(simulated.drives, taken)?;
        let open = |station| Socket::open(station, drives.is_for_all(station));
        let sockets = drives.stations.iter().map(open).collect::<io::Result<Vec<_>>>()?;
        for (index, socket) in sockets.iter().enumerate() {
            socket.watch(&epoll, token(index, LISTENER))?;
        }
        let mut buses: Vec<Box<dyn SharedBus>> = Vec::new();
        for segment in simulated.segments {
            buses.push(Box::new(Segment::open(segment)?));
        }
        for wire in simulated.wires {
            buses.push(Box::new(Wire::open(wire)?));
        }
        for (index, bus) in buses.iter().enumerate() {
            bus.watch(&epoll, token(sockets.len() + index, LISTENER))?;
        }
        let stats = |address| DriveStats {
            address,
            received: 0,
            answered: 0,
            unsent: 0,
            connections: ConnectionStats::default(),
            injected: Injected::default(),
        };
        let stats = Stats {
            drives: drives.stations.iter().map(|station| Mutex::new(stats(station.address))).collect(),
            buses: buses.iter().map(|bus| Mutex::new(bus.stats())).collect(),
        };
        let queue = Queue::new(UNDER_WAY * sockets.len());
        Ok(Service { epoll, queue, stats, drives, sockets, buses })
    }

    /// The counts.
    pub(super) fn stats(&self) -> Stats {
        self.stats.clone()
    }

    /// Serves until it is stopped.
    pub(super) fn run(&mut self) {
        // Room for every descriptor at once, so that none, the stop's included, waits behind busier ones. A serial wire
        // has two.
        let room: usize = self.sockets.iter().map(Socket::descriptors).sum();
        let mut events = vec![EpollEvent::empty(); room + 2 * self.buses.len() + 1];
        let mut bytes = vec![0; ROOM];
        loop {
            let count = match self.wait(&mut events) {
                Ok(count) => count,
                Err(Errno::EINTR) => 0,
                // The descriptor and the buffer are our own, so that no other error is possible.
                Err(_) => return,
            };
            for event in &events[..count] {
                if event.data() == STOP {
                    return;
                }
                self.ready(event, &mut bytes);
                // At once and not after the last socket: the first drive's answer does not wait for the others.
                self.run_due();
            }
            self.run_due();
        }
    }

    /// Waits for sockets, but not beyond the next due instant.
    fn wait(&self, events: &mut [EpollEvent]) -> nix::Result<usize> {
        let buses = self.buses.iter().filter_map(|bus| bus.next_due());
        let Some(due) = buses.chain(self.queue.next_due()).chain(self.drives.next_due()).min() else {
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

    /// Serves a ready socket. The epoll is level-triggered: what is left is reported again, which costs less than
    /// reading each socket until EAGAIN after its usually only request.
    fn ready(&mut self, event: &EpollEvent, bytes: &mut [u8]) {
        let (index, number) = (event.data() as u32 as usize, (event.data() >> 32) as u32);
        match self.sockets.get(index) {
            Some(Socket::Datagrams { .. }) if number == EVERYBODY => self.receive_of_all(index, bytes),
            Some(Socket::Datagrams { .. }) => self.receive(index, bytes),
            Some(Socket::Stream { .. }) if number == LISTENER => self.accept(index),
            Some(Socket::Stream { .. }) => self.read(index, number, event.events(), &mut bytes[..CHUNK]),
            None => {
                let (place, token) = (index - self.sockets.len(), token(index, LISTENER + 1));
                if let Some(bus) = self.buses.get_mut(place) {
                    bus.ready(number, bytes, &self.epoll, token, &self.stats.buses[place]);
                }
            }
        }
    }

    /// Takes one datagram.
    fn receive(&mut self, index: usize, bytes: &mut [u8]) {
        let Socket::Datagrams { socket, .. } = &self.sockets[index] else { return };
        if let Ok((length, SocketAddr::V4(from))) = socket.recv_from(bytes) {
            self.came(index, from, &bytes[..length]);
        }
    }

    /// Takes one datagram to everybody: to the drive itself, without the faults of its socket.
    fn receive_of_all(&mut self, index: usize, bytes: &mut [u8]) {
        let Socket::Datagrams { everybody: Some(socket), .. } = &self.sockets[index] else { return };
        if let Ok((length, SocketAddr::V4(from))) = socket.recv_from(bytes) {
            self.drives.receive_of_all(index, MonotonicClock::read(), from, &bytes[..length]);
        }
    }

    /// Accepts the waiting connections. Connections that come meanwhile make an edge of their own.
    fn accept(&mut self, index: usize) {
        for _ in 0..=BACKLOG {
            let Socket::Stream { listener, .. } = &self.sockets[index] else { return };
            let (stream, peer) = match listener.accept() {
                Ok((stream, SocketAddr::V4(peer))) => (stream, peer),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                // It was reset already, or there is no descriptor for it.
                _ => continue,
            };
            // The kernel has dropped it, and its event has not come yet.
            while let Some(number) = self.sockets[index].by_peer(peer).map(|old| old.number) {
                self.end(index, number, Farewell::Close);
            }
            let drives = &mut self.drives;
            let wanted = || drives.connect(index, MonotonicClock::read(), peer);
            let accepted = self.sockets[index].accept(index, &self.epoll, stream, peer, wanted);
            self.count(index, |stats| {
                let connections = &mut stats.connections;
                *(if accepted { &mut connections.accepted } else { &mut connections.refused }) += 1;
            });
        }
    }

    /// Reads from a connection, once, and continues with what its peer left unread.
    fn read(&mut self, index: usize, number: u32, events: EpollFlags, bytes: &mut [u8]) {
        let Some(connection) = self.sockets[index].by_number(number) else { return };
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
        if let Some(peer) = self.sockets[index].end(number, farewell) {
            self.drives.disconnected(index, MonotonicClock::read(), peer);
        }
        self.count(index, |_| ());
    }

    /// Counts what happened at a socket.
    fn count(&mut self, index: usize, what: impl FnOnce(&mut DriveStats)) {
        let mut stats = lock(&self.stats.drives[index]);
        what(&mut stats);
        stats.connections.open = self.sockets[index].connections().len() as u64;
        stats.injected = self.drives.stations[index].injector.injected();
    }

    /// Injects a fault into a drive itself; a restart ends its connections.
    fn inject(&mut self, now: Time, unit: usize, fault: DriveFault) {
        for (index, peer) in self.drives.inject(unit, now, fault) {
            if let Some(number) = self.sockets[index].by_peer(peer).map(|one| one.number) {
                self.end(index, number, Farewell::Reset);
            }
        }
    }

    /// Puts received bytes under way, through the faults.
    fn came(&mut self, index: usize, from: SocketAddrV4, bytes: &[u8]) {
        let now = MonotonicClock::read();
        if let Some(fault) = self.drives.request(index, now, now, (from, bytes), &mut self.queue) {
            self.inject(now, self.drives.stations[index].unit, fault);
        }
        self.count(index, |stats| stats.received += 1);
    }

    /// Everything that is due by now: requests to their drives, replies to the kernel.
    fn run_due(&mut self) {
        self.buses.iter_mut().zip(&*self.stats.buses).for_each(|(bus, stats)| bus.run_due(stats));
        if self.queue.next_due().is_none() && self.drives.next_due().is_none() {
            return;
        }
        let now = MonotonicClock::read();
        while let Some(unit) = self.drives.run(now, now, &mut self.queue) {
            for k in 0..self.drives.units[unit].sockets.len() {
                self.count(self.drives.units[unit].sockets[k], |_| ());
            }
        }
        while let Some((_, parcel)) = self.queue.pop(now) {
            match self.station(parcel.carrier, parcel.to) {
                Some(index) if self.drives.stations[index].reaches(parcel.from) => {
                    self.drives.serve(index, now, now, &parcel, &mut self.queue);
                    self.count(index, |_| ());
                }
                Some(_) => {}
                None => self.answer(&parcel),
            }
            self.queue.recycle(parcel);
        }
    }

    fn answer(&mut self, parcel: &Parcel) {
        let (index, wrong) = match self.station(parcel.carrier, parcel.from) {
            Some(index) => (Some(index), false),
            None => (self.station(parcel.carrier, wrong_port(parcel.from)), true),
        };
        let Some(index) = index else { return };
        let sent = match &self.sockets[index] {
            Socket::Datagrams { socket, wrong: other, .. } => {
                let source = other.as_ref().filter(|_| wrong).unwrap_or(socket);
                source.send_to(&parcel.bytes, parcel.to).is_ok()
            }
            Socket::Stream { .. } => match self.write(index, parcel) {
                Some(sent) => sent,
                None => return,
            },
        };
        self.count(index, |stats| *(if sent { &mut stats.answered } else { &mut stats.unsent }) += 1);
    }

    /// Sends a reply on its connection: whether the kernel has it. `None`: there was nothing to send.
    fn write(&mut self, index: usize, parcel: &Parcel) -> Option<bool> {
        let has_bytes = !parcel.bytes.is_empty();
        let Some(connection) = self.sockets[index].by_peer(parcel.to) else {
            return has_bytes.then_some(false);
        };
        let number = connection.number;
        let sent = !has_bytes || connection.send(&self.epoll, index, &parcel.bytes).is_ok();
        if !sent {
            self.end(index, number, Farewell::Reset);
        } else if parcel.signal == Signal::End {
            self.end(index, number, Farewell::Close);
        }
        has_bytes.then_some(sent)
    }

    /// The socket of this kind at `address`.
    fn station(&mut self, carrier: Carrier, address: SocketAddrV4) -> Option<usize> {
        let index = self.drives.station(carrier, address)?;
        (self.drives.stations[index].carrier == carrier).then_some(index)
    }
}
