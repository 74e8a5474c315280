//! Drives with an address of their own, their sockets, and their own clocks: the same behind real sockets and in
//! virtual time. Whoever serves them carries what is under way.

use std::io;
use std::mem::take;
use std::net::SocketAddrV4;

use super::fault::{Datagram, DriveFault, Injector, Parcel, Queue, Signal, Way};
use super::{Carrier, FaultPlan, SimDrive};
use fieldbeat_core::time::{Time, US};

/// The shortest time between two runs of a drive, ns: a mistake of a drive shall not stop the time.
pub(super) const SHORTEST_RUN_NS: u64 = US;

/// Connections of a drive without a further allocation.
const PEERS: usize = 16;

/// All drives.
#[derive(Default)]
pub(super) struct Drives {
    pub(super) units: Vec<Unit>,
    /// Their sockets, by address.
    pub(super) stations: Vec<Station>,
    /// The index after the one found last.
    next: usize,
    /// When the next of them wants to run by its own clock.
    due: Option<Time>,
    reply: Vec<u8>,
    /// Kept for its room.
    sent: Sent,
}

/// What a drive sends by its own clock, one after the other: of each its socket, where to, and its end.
#[derive(Default)]
struct Sent {
    bytes: Vec<u8>,
    messages: Vec<(usize, SocketAddrV4, usize)>,
}

/// One drive.
pub(super) struct Unit {
    pub(super) drive: Box<dyn SimDrive>,
    pub(super) plugged: bool,
    /// When it wants to run.
    due: Option<Time>,
    rests_until: Time,
    /// Its sockets, by their numbers.
    pub(super) sockets: Vec<usize>,
}

/// One socket of a drive.
pub(super) struct Station {
    pub(super) address: SocketAddrV4,
    pub(super) carrier: Carrier,
    pub(super) unit: usize,
    /// Its number at the drive.
    socket: usize,
    pub(super) injector: Injector,
    /// The peers that have a connection with it.
    pub(super) peers: Vec<SocketAddrV4>,
}

impl Station {
    /// Whether something goes between it and `peer`: a connection may have ended meanwhile.
    pub(super) fn reaches(&self, peer: SocketAddrV4) -> bool {
        self.carrier == Carrier::Datagrams || self.peers.contains(&peer)
    }
}

impl Drives {
    /// `taken` is the error of two sockets of one kind at one address.
    pub(super) fn new(
        drives: Vec<Box<dyn SimDrive>>,
        taken: impl FnOnce(SocketAddrV4, Carrier) -> io::Error,
    ) -> io::Result<Drives> {
        let (mut units, mut stations) = (Vec::new(), Vec::new());
        for (unit, drive) in drives.into_iter().enumerate() {
            let mut sockets = vec![(drive.carrier(), drive.address())];
            sockets.extend(drive.more_sockets());
            if sockets.iter().filter(|(carrier, _)| *carrier == Carrier::Stream).count() > 1 {
                let message = format!("the simulated drive at {} has more than one stream", drive.address());
                return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
            }
            for (socket, (carrier, address)) in sockets.into_iter().enumerate() {
                // The faults of each socket have a seed of their own.
                let faults = drive.faults();
                let faults = FaultPlan { seed: faults.seed.wrapping_add(socket as u64), ..faults };
                let (injector, peers) = (Injector::new(faults, carrier), Vec::with_capacity(PEERS));
                stations.push(Station { address, carrier, unit, socket, injector, peers });
            }
            let due = drive.next_due();
            units.push(Unit { drive, plugged: true, due, rests_until: Time::default(), sockets: Vec::new() });
        }
        let key = |station: &Station| (station.address, station.carrier == Carrier::Stream);
        stations.sort_by_key(key);
        if let Some(pair) = stations.windows(2).find(|pair| key(&pair[0]) == key(&pair[1])) {
            return Err(taken(pair[0].address, pair[0].carrier));
        }
        for (index, station) in stations.iter().enumerate() {
            units[station.unit].sockets.push(index);
        }
        for unit in &mut units {
            unit.sockets.sort_by_key(|index| stations[*index].socket);
        }
        let due = units.iter().filter_map(|unit| unit.due).min();
        Ok(Drives { units, stations, due, ..Drives::default() })
    }

    /// The socket at `address`: of that kind, or of the other one if there is only that. A master addresses its drives
    /// in order, so that the next one is the usual match.
    pub(super) fn station(&mut self, carrier: Carrier, address: SocketAddrV4) -> Option<usize> {
        let index = match self.stations.get(self.next) {
            Some(station) if station.address == address && station.carrier == carrier => self.next,
            _ => {
                let first = self.stations.partition_point(|station| station.address < address);
                let here = || self.stations[first..].iter().take_while(|station| station.address == address);
                let place = here().position(|station| station.carrier == carrier);
                first + place.or(here().next().map(|_| 0))?
            }
        };
        self.next = index + 1;
        Some(index)
    }

    /// The first socket at `address`.
    pub(super) fn station_at(&mut self, address: SocketAddrV4) -> Option<&mut Station> {
        let index = self.station(Carrier::Datagrams, address)?;
        self.stations.get_mut(index)
    }

    /// The drive that has a socket at `address`.
    pub(super) fn at(&mut self, address: SocketAddrV4) -> Option<usize> {
        self.station_at(address).map(|station| station.unit)
    }

    /// This socket also takes what is sent to everybody.
    pub(super) fn is_for_all(&self, station: &Station) -> bool {
        let unit = &self.units[station.unit];
        unit.drive.everybody() == Some(station.socket) && station.carrier == Carrier::Datagrams
    }

    /// A datagram to everybody came to the drive of this socket.
    pub(super) fn receive_of_all(&mut self, station: usize, now: Time, from: SocketAddrV4, bytes: &[u8]) {
        let unit = self.stations[station].unit;
        if self.units[unit].plugged {
            self.units[unit].drive.receive_of_all(now, from, bytes);
            self.called(unit);
        }
    }

    /// A socket and its drive.
    pub(super) fn both(&mut self, station: usize) -> (&mut Station, &mut Unit) {
        let station = &mut self.stations[station];
        let unit = &mut self.units[station.unit];
        (station, unit)
    }

    /// When the next drive wants to run by its own clock.
    pub(super) fn next_due(&self) -> Option<Time> {
        self.due
    }

    /// Drive `unit` was called: it may want to run at another time now.
    pub(super) fn called(&mut self, unit: usize) {
        let called = &mut self.units[unit];
        let due = called.drive.next_due().map(|due| due.max(called.rests_until));
        if called.due != due {
            called.due = due;
            self.due = self.units.iter().filter_map(|unit| unit.due).min();
        }
    }

    /// Puts a request to a socket under way, to arrive at `due` without a fault.
    pub(super) fn request(
        &mut self,
        station: usize,
        now: Time,
        due: Time,
        (from, bytes): (SocketAddrV4, &[u8]),
        queue: &mut Queue,
    ) -> Option<DriveFault> {
        let (station, unit) = self.both(station);
        let request = Datagram { from, to: station.address, bytes };
        station.injector.pass(Way::Request, now, due, request, |bytes| unit.drive.mislabel(bytes), queue)
    }

    /// Puts what a socket sends under way.
    fn send(
        &mut self,
        station: usize,
        now: Time,
        due: Time,
        (to, bytes): (SocketAddrV4, &[u8]),
        queue: &mut Queue,
    ) {
        let (station, unit) = self.both(station);
        let reply = Datagram { from: station.address, to, bytes };
        station.injector.pass(Way::Reply, now, due, reply, |bytes| unit.drive.mislabel(bytes), queue);
    }

    /// The same for a signal of a stream.
    pub(super) fn signal(
        &mut self,
        station: usize,
        due: Time,
        to: SocketAddrV4,
        signal: Signal,
        queue: &mut Queue,
    ) {
        let station = &mut self.stations[station];
        let parcel = queue.signal(station.address, to, signal);
        station.injector.signal(Way::Reply, due, parcel, queue);
    }

    /// A request arrives at a socket: its answer is to arrive at `due`.
    pub(super) fn serve(&mut self, index: usize, now: Time, due: Time, request: &Parcel, queue: &mut Queue) {
        let mut reply = take(&mut self.reply);
        reply.clear();
        let (station, unit) = self.both(index);
        let to = unit.drive.receive_at(station.socket, now, request.from, &request.bytes, &mut reply);
        let (unit, carrier) = (station.unit, station.carrier);
        self.called(unit);
        // No drive answers a drive: with a forged source two of them would go on for ever.
        if let Some(to) = to.filter(|to| self.at(*to).is_none()) {
            self.send(index, now, due, (to, &reply), queue);
        }
        self.reply = reply;
        if carrier == Carrier::Stream {
            self.hang_up(index, due, request.from, queue);
        }
    }

    /// Ends the connection with `peer` if the drive wants that.
    fn hang_up(&mut self, index: usize, due: Time, peer: SocketAddrV4, queue: &mut Queue) {
        if self.both(index).1.drive.hangs_up(peer) {
            self.signal(index, due, peer, Signal::End, queue);
        }
    }

    /// The next drive whose own clock has come to it runs: which. What it sends is to arrive at `due`.
    pub(super) fn run(&mut self, now: Time, due: Time, queue: &mut Queue) -> Option<usize> {
        let index = self.units.iter().position(|unit| unit.due.is_some_and(|due| due <= now))?;
        let (unit, mut sent) = (&mut self.units[index], std::mem::take(&mut self.sent));
        let Sent { bytes: all, messages } = &mut sent;
        all.clear();
        messages.clear();
        unit.drive.run(now, &mut |socket, to, bytes| {
            all.extend_from_slice(bytes);
            messages.push((socket, to, all.len()));
        });
        unit.rests_until = now + SHORTEST_RUN_NS;
        let mut begin = 0;
        for &(socket, to, end) in &*messages {
            let bytes = &all[std::mem::replace(&mut begin, end)..end];
            let unit = &self.units[index];
            let station = unit.sockets.get(socket).copied().filter(|_| unit.plugged);
            if let Some(station) = station.filter(|station| self.stations[*station].reaches(to)) {
                self.send(station, now, due, (to, bytes), queue);
            }
        }
        self.sent = sent;
        for k in 0..self.units[index].sockets.len() {
            let station = self.units[index].sockets[k];
            for place in 0..self.stations[station].peers.len() {
                self.hang_up(station, due, self.stations[station].peers[place], queue);
            }
        }
        self.called(index);
        Some(index)
    }

    /// A connection from `peer` is requested; false: the drive refuses it.
    pub(super) fn connect(&mut self, index: usize, now: Time, peer: SocketAddrV4) -> bool {
        let (station, unit) = self.both(index);
        let accepts = station.carrier == Carrier::Stream && unit.drive.connect(now, peer);
        if accepts {
            station.peers.push(peer);
        }
        let unit = station.unit;
        self.called(unit);
        accepts
    }

    /// The drive learns that its connection with `peer` has ended, if it had one.
    pub(super) fn disconnected(&mut self, index: usize, now: Time, peer: SocketAddrV4) {
        let (station, unit) = self.both(index);
        if let Some(place) = station.peers.iter().position(|other| *other == peer) {
            station.peers.remove(place);
            unit.drive.disconnected(now, peer);
            let unit = station.unit;
            self.called(unit);
        }
    }

    /// Injects a fault into drive `index`. Returns the connections that a restart has ended, each with its socket.
    pub(super) fn inject(
        &mut self,
        index: usize,
        now: Time,
        fault: DriveFault,
    ) -> Vec<(usize, SocketAddrV4)> {
        let (unit, mut ended) = (&mut self.units[index], Vec::new());
        for station in unit.sockets.iter().filter(|_| fault == DriveFault::Restart) {
            for peer in self.stations[*station].peers.drain(..) {
                unit.drive.disconnected(now, peer);
                ended.push((*station, peer));
            }
        }
        match fault {
            DriveFault::Restart => unit.drive.restart(now),
            DriveFault::OpenSto(until) => unit.drive.open_sto(until),
        }
        self.called(index);
        ended
    }
}
