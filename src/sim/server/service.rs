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

use super::lines::Rail;
use super::sockets::{DOOR, Door, Farewell, Station, not_now, token, unbound};
use super::{DriveStats, LineStats, lock};
use crate::rt::MonotonicClock;
use crate::sim::Simulated;
use crate::sim::fault::{Datagram, Parcel, Queue, Signal, Way, wrong_port};
use crate::time::{S, Time};

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
    /// By address.
    stations: Vec<Station>,
    /// Their events follow those of the stations.
    rails: Vec<Rail>,
    queue: Queue,
    reply: Vec<u8>,
    stats: Arc<[Mutex<DriveStats>]>,
    line_stats: Arc<[Mutex<LineStats>]>,
}

impl Service {
    /// Binds all sockets; an event of `stop` ends it.
    pub(super) fn open(simulated: Simulated, stop: &EventFd) -> io::Result<Service> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        epoll.add(stop, EpollEvent::new(EpollFlags::EPOLLIN, STOP))?;
        let mut stations = simulated.drives.into_iter().map(Station::open).collect::<io::Result<Vec<_>>>()?;
        stations.sort_by_key(|station| station.address);
        if let Some(pair) = stations.windows(2).find(|pair| pair[0].address == pair[1].address) {
            let (error, carrier) = (io::ErrorKind::AddrInUse.into(), pair[0].drive.carrier());
            return Err(unbound(pair[0].address, carrier, error));
        }
        for (index, station) in stations.iter().enumerate() {
            station.door.watch(&epoll, token(index, DOOR))?;
        }
        let rails = simulated.lines.into_iter().map(Rail::open).collect::<io::Result<Vec<_>>>()?;
        for (index, rail) in rails.iter().enumerate() {
            rail.watch(&epoll, token(stations.len() + index, DOOR))?;
        }
        Ok(Service {
            epoll,
            queue: Queue::new(UNDER_WAY * stations.len()),
            reply: Vec::with_capacity(ROOM),
            stats: stations.iter().map(|station| Mutex::new(station.stats())).collect(),
            line_stats: rails.iter().map(|rail| Mutex::new(rail.stats())).collect(),
            stations,
            rails,
        })
    }

    /// The counts of the drives and of the segments.
    #[expect(clippy::type_complexity, reason = "each has its place in the server")]
    pub(super) fn stats(&self) -> (Arc<[Mutex<DriveStats>]>, Arc<[Mutex<LineStats>]>) {
        (Arc::clone(&self.stats), Arc::clone(&self.line_stats))
    }

    /// Serves until it is stopped.
    pub(super) fn run(&mut self) {
        // Room for every descriptor at once, so that none, the stop's included, waits behind busier ones.
        let room: usize = self.stations.iter().map(|station| station.door.descriptors()).sum();
        let mut events = vec![EpollEvent::empty(); room + self.rails.len() + 1];
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
                self.attend(event, &mut bytes);
                // At once and not after the last socket: the first drive's answer does not wait for the others.
                self.run_due();
            }
            self.run_due();
        }
    }

    /// Waits for sockets, but not beyond the next due instant.
    fn wait(&self, events: &mut [EpollEvent]) -> nix::Result<usize> {
        let frames = self.rails.iter().filter_map(Rail::next_due);
        let Some(due) = self.queue.next_due().into_iter().chain(frames).min() else {
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
    fn attend(&mut self, event: &EpollEvent, bytes: &mut [u8]) {
        let (index, number) = (event.data() as u32 as usize, (event.data() >> 32) as u32);
        let Some(station) = self.stations.get(index) else {
            return self.take_frame(index - self.stations.len(), bytes);
        };
        match station.door {
            Door::Datagrams { .. } => self.receive(index, bytes),
            Door::Stream { .. } if number == DOOR => self.accept(index),
            Door::Stream { .. } => self.hear(index, number, event.events(), &mut bytes[..CHUNK]),
        }
    }

    /// Takes one frame.
    fn take_frame(&mut self, index: usize, bytes: &mut [u8]) {
        if let Some(rail) = self.rails.get_mut(index) {
            rail.receive(bytes, &self.line_stats[index]);
        }
    }

    /// Takes one datagram.
    fn receive(&mut self, index: usize, bytes: &mut [u8]) {
        let Door::Datagrams { socket, .. } = &self.stations[index].door else { return };
        if let Ok((length, SocketAddr::V4(from))) = socket.recv_from(bytes) {
            self.came(index, from, &bytes[..length]);
        }
    }

    /// Accepts the waiting connections. Connections that come meanwhile make an edge of their own.
    fn accept(&mut self, index: usize) {
        for _ in 0..=BACKLOG {
            let station = &mut self.stations[index];
            let Door::Stream { listener, .. } = &station.door else { return };
            let (socket, peer) = match listener.accept() {
                Ok((socket, SocketAddr::V4(peer))) => (socket, peer),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                // It was reset already, or there is no descriptor for it.
                _ => continue,
            };
            let welcome = station.welcome(index, &self.epoll, socket, peer);
            let connections = &mut lock(&self.stats[index]).connections;
            *(if welcome { &mut connections.accepted } else { &mut connections.refused }) += 1;
            connections.open = station.door.connections().len() as u64;
        }
    }

    /// Reads from a connection, once, and continues with what its peer left unread.
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

    /// Puts received bytes under way, through the faults.
    fn came(&mut self, index: usize, from: SocketAddrV4, bytes: &[u8]) {
        let now = MonotonicClock::read();
        let station = &mut self.stations[index];
        let request = Datagram { from, to: station.address, bytes };
        let blow = station.injector.pass(
            Way::Request,
            now,
            now,
            request,
            |bytes| station.drive.mislabel(bytes),
            &mut self.queue,
        );
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
        self.rails.iter_mut().zip(&*self.line_stats).for_each(|(rail, stats)| rail.run_due(stats));
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
            station.injector.pass(
                Way::Reply,
                now,
                now,
                reply,
                |bytes| station.drive.mislabel(bytes),
                &mut self.queue,
            );
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

    /// Sends a reply on its connection: whether the kernel has it. `None`: there was nothing to send.
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
