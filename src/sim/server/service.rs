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
use super::wires::Wire;
use super::{DriveStats, LineStats, WireStats, lock};
use crate::rt::MonotonicClock;
use crate::sim::fault::{Blow, Datagram, Parcel, Queue, Signal, Way, wrong_port};
use crate::sim::said::{SHORTEST_RUN_NS, Said};
use crate::sim::{Carrier, SimDrive, Simulated};
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
    drives: Vec<Unit>,
    /// Their sockets, by address.
    stations: Vec<Station>,
    /// Their events follow those of the stations.
    rails: Vec<Rail>,
    /// Theirs follow those of the rails.
    wires: Vec<Wire>,
    queue: Queue,
    reply: Vec<u8>,
    said: Said,
    stats: Stats,
}

/// One drive.
struct Unit {
    drive: Box<dyn SimDrive>,
    rests_until: Time,
    /// Its sockets, by their numbers.
    sockets: Vec<usize>,
}

impl Unit {
    /// When it wants to run by its own clock.
    fn next_due(&self) -> Option<Time> {
        self.drive.next_due().map(|due| due.max(self.rests_until))
    }
}

/// The counts, each at the index of its socket, segment or wire.
#[derive(Clone)]
pub(super) struct Stats {
    pub(super) drives: Arc<[Mutex<DriveStats>]>,
    pub(super) lines: Arc<[Mutex<LineStats>]>,
    pub(super) wires: Arc<[Mutex<WireStats>]>,
}

impl Service {
    /// Binds all sockets; an event of `stop` ends it.
    pub(super) fn open(simulated: Simulated, stop: &EventFd) -> io::Result<Service> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        epoll.add(stop, EpollEvent::new(EpollFlags::EPOLLIN, STOP))?;
        let mut stations = Vec::new();
        for (index, drive) in simulated.drives.iter().enumerate() {
            stations.extend(Station::open(index, &**drive)?);
        }
        let key = |station: &Station| (station.address, station.carrier() == Carrier::Stream);
        stations.sort_by_key(key);
        if let Some(pair) = stations.windows(2).find(|pair| key(&pair[0]) == key(&pair[1])) {
            let error = io::ErrorKind::AddrInUse.into();
            return Err(unbound(pair[0].address, pair[0].carrier(), error));
        }
        let unit = |drive| Unit { drive, rests_until: Time::default(), sockets: Vec::new() };
        let mut drives: Vec<_> = simulated.drives.into_iter().map(unit).collect();
        for (index, station) in stations.iter().enumerate() {
            station.door.watch(&epoll, token(index, DOOR))?;
            drives[station.drive].sockets.push(index);
        }
        drives.iter_mut().for_each(|unit| unit.sockets.sort_by_key(|index| stations[*index].socket));
        let rails = simulated.lines.into_iter().map(Rail::open).collect::<io::Result<Vec<_>>>()?;
        for (index, rail) in rails.iter().enumerate() {
            rail.watch(&epoll, token(stations.len() + index, DOOR))?;
        }
        let wires = simulated.wires.into_iter().map(Wire::open).collect::<io::Result<Vec<_>>>()?;
        for (index, wire) in wires.iter().enumerate() {
            wire.watch(&epoll, token(stations.len() + rails.len() + index, DOOR))?;
        }
        Ok(Service {
            epoll,
            queue: Queue::new(UNDER_WAY * stations.len()),
            reply: Vec::with_capacity(ROOM),
            said: Said::default(),
            stats: Stats {
                drives: stations.iter().map(|station| Mutex::new(station.stats())).collect(),
                lines: rails.iter().map(|rail| Mutex::new(rail.stats())).collect(),
                wires: wires.iter().map(|wire| Mutex::new(wire.stats())).collect(),
            },
            drives,
            stations,
            rails,
            wires,
        })
    }

    /// The counts.
    pub(super) fn stats(&self) -> Stats {
        self.stats.clone()
    }

    /// Serves until it is stopped.
    pub(super) fn run(&mut self) {
        // Room for every descriptor at once, so that none, the stop's included, waits behind busier ones.
        let room: usize = self.stations.iter().map(|station| station.door.descriptors()).sum();
        // A wire has its listener and its master.
        let mut events = vec![EpollEvent::empty(); room + self.rails.len() + 2 * self.wires.len() + 1];
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
        let bytes = self.wires.iter().filter_map(Wire::next_due);
        let clocks = self.drives.iter().filter_map(Unit::next_due);
        let Some(due) = self.queue.next_due().into_iter().chain(frames).chain(bytes).chain(clocks).min()
        else {
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
            return self.take(index - self.stations.len(), number, bytes);
        };
        match station.door {
            Door::Datagrams { .. } => self.receive(index, bytes),
            Door::Stream { .. } if number == DOOR => self.accept(index),
            Door::Stream { .. } => self.hear(index, number, event.events(), &mut bytes[..CHUNK]),
        }
    }

    /// Takes one frame, or what has come on a serial wire.
    fn take(&mut self, index: usize, number: u32, bytes: &mut [u8]) {
        if let Some(rail) = self.rails.get_mut(index) {
            rail.receive(bytes, &self.stats.lines[index]);
        } else if let Some(index) = index.checked_sub(self.rails.len())
            && let Some(wire) = self.wires.get_mut(index)
        {
            let token = token(self.stations.len() + self.rails.len() + index, DOOR + 1);
            wire.ready(number == DOOR, bytes, &self.epoll, token, &self.stats.wires[index]);
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
            let drive = &mut *self.drives[station.drive].drive;
            let welcome = station.welcome(drive, index, &self.epoll, socket, peer);
            let connections = &mut lock(&self.stats.drives[index]).connections;
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
        station.end(&mut *self.drives[station.drive].drive, number, farewell);
        lock(&self.stats.drives[index]).connections.open = station.door.connections().len() as u64;
    }

    /// Injects a fault of a drive itself; a restart ends its connections.
    fn strike(&mut self, now: Time, drive: usize, blow: Blow) {
        let Unit { drive, sockets, .. } = &mut self.drives[drive];
        if blow == Blow::Restart {
            sockets.iter().for_each(|index| self.stations[*index].end_all(&mut **drive));
        }
        blow.strike(now, &mut **drive);
    }

    /// Puts received bytes under way, through the faults.
    fn came(&mut self, index: usize, from: SocketAddrV4, bytes: &[u8]) {
        let now = MonotonicClock::read();
        let station = &mut self.stations[index];
        let (request, drive) = (Datagram { from, to: station.address, bytes }, station.drive);
        let mislabel = |bytes: &mut [u8]| self.drives[drive].drive.mislabel(bytes);
        let blow = station.injector.pass(Way::Request, now, now, request, mislabel, &mut self.queue);
        if let Some(blow) = blow {
            self.strike(now, drive, blow);
        }
        let station = &mut self.stations[index];
        let mut stats = lock(&self.stats.drives[index]);
        stats.received += 1;
        stats.connections.open = station.door.connections().len() as u64;
        stats.injected = station.injector.injected();
    }

    /// Everything that is due by now: requests to their drives, replies to the kernel.
    fn run_due(&mut self) {
        self.rails.iter_mut().zip(&*self.stats.lines).for_each(|(rail, stats)| rail.run_due(stats));
        self.wires.iter_mut().zip(&*self.stats.wires).for_each(|(wire, stats)| wire.run_due(stats));
        let clock = self.drives.iter().filter_map(Unit::next_due).min();
        if self.queue.next_due().is_none() && clock.is_none() {
            return;
        }
        let now = MonotonicClock::read();
        if clock.is_some_and(|due| due <= now) {
            self.run_drives(now);
        }
        while let Some((_, parcel)) = self.queue.pop(now) {
            match self.station(parcel.carrier, parcel.to) {
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
        let mut reply = std::mem::take(&mut self.reply);
        reply.clear();
        let (drive, socket) = (&mut self.drives[station.drive].drive, station.socket);
        let to = drive.receive_at(socket, now, parcel.from, &parcel.bytes, &mut reply);
        // No drive answers a drive: with a forged source two of them would go on for ever.
        if let Some(to) = to.filter(|to| self.at(*to).is_none()) {
            self.send(index, now, to, &reply);
        }
        self.reply = reply;
        if self.stations[index].carrier() == Carrier::Stream {
            self.hang_up(index, now, parcel.from);
        }
    }

    /// Puts what a drive sends under way, through the faults.
    fn send(&mut self, index: usize, now: Time, to: SocketAddrV4, bytes: &[u8]) {
        let station = &mut self.stations[index];
        let reply = Datagram { from: station.address, to, bytes };
        let mislabel = |bytes: &mut [u8]| self.drives[station.drive].drive.mislabel(bytes);
        station.injector.pass(Way::Reply, now, now, reply, mislabel, &mut self.queue);
        lock(&self.stats.drives[index]).injected = station.injector.injected();
    }

    /// Ends a connection if the drive wants that.
    fn hang_up(&mut self, index: usize, now: Time, peer: SocketAddrV4) {
        let station = &mut self.stations[index];
        if self.drives[station.drive].drive.hangs_up(peer) {
            let end = self.queue.signal(station.address, peer, Signal::End);
            station.injector.signal(Way::Reply, now, end, &mut self.queue);
        }
    }

    /// The drives whose own clock has come to it run.
    fn run_drives(&mut self, now: Time) {
        let mut said = std::mem::take(&mut self.said);
        for k in 0..self.drives.len() {
            let unit = &mut self.drives[k];
            if unit.next_due().is_none_or(|due| due > now) {
                continue;
            }
            said.run(now, &mut *unit.drive);
            unit.rests_until = now + SHORTEST_RUN_NS;
            for (socket, to, bytes) in said.messages() {
                if let Some(index) = self.drives[k].sockets.get(socket).copied()
                    && self.stations[index].hears(to)
                {
                    self.send(index, now, to, bytes);
                }
            }
            for place in 0..self.drives[k].sockets.len() {
                let index = self.drives[k].sockets[place];
                let peers = self.stations[index].door.connections().iter().map(|one| one.peer);
                for peer in peers.collect::<Vec<_>>() {
                    self.hang_up(index, now, peer);
                }
            }
        }
        self.said = said;
    }

    fn answer(&mut self, parcel: &Parcel) {
        let (index, wrong) = match self.station(parcel.carrier, parcel.from) {
            Some(index) => (Some(index), false),
            None => (self.station(parcel.carrier, wrong_port(parcel.from)), true),
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
        let mut stats = lock(&self.stats.drives[index]);
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

    /// The socket of this kind at `address`.
    fn station(&self, carrier: Carrier, address: SocketAddrV4) -> Option<usize> {
        let first = self.stations.partition_point(|station| station.address < address);
        let mut here = self.stations[first..].iter().take_while(|station| station.address == address);
        here.position(|station| station.carrier() == carrier).map(|place| first + place)
    }

    /// Any socket at `address`.
    fn at(&self, address: SocketAddrV4) -> Option<usize> {
        self.stations.binary_search_by_key(&address, |station| station.address).ok()
    }
}
