//! The drives of a world, their sockets, and their own clocks.

use std::io;
use std::net::SocketAddrV4;

use super::{Inner, taken};
use crate::sim::fault::{Blow, Datagram, Injector, Queue, Signal, Way};
use crate::sim::said::{SHORTEST_RUN_NS, Said};
use crate::sim::{Carrier, SimDrive, faults, sockets};
use crate::time::Time;

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
    said: Said,
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
    pub(super) socket: usize,
    pub(super) injector: Injector,
    /// The peers that have a connection with it.
    pub(super) peers: Vec<SocketAddrV4>,
}

impl Drives {
    pub(super) fn new(drives: Vec<Box<dyn SimDrive>>) -> io::Result<Drives> {
        let (mut units, mut stations) = (Vec::new(), Vec::new());
        for (unit, drive) in drives.into_iter().enumerate() {
            for (socket, (carrier, address)) in sockets(&*drive)?.into_iter().enumerate() {
                let injector = Injector::new(faults(&*drive, socket), carrier);
                let peers = Vec::with_capacity(PEERS);
                stations.push(Station { address, carrier, unit, socket, injector, peers });
            }
            let due = drive.next_due();
            units.push(Unit { drive, plugged: true, due, rests_until: Time::default(), sockets: Vec::new() });
        }
        let key = |station: &Station| (station.address, station.carrier == Carrier::Stream);
        stations.sort_by_key(key);
        if let Some(pair) = stations.windows(2).find(|pair| key(&pair[0]) == key(&pair[1])) {
            return Err(taken(pair[0].address));
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

    pub(super) fn count(&self) -> usize {
        self.units.len()
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

    pub(super) fn unplug(&mut self, address: SocketAddrV4) -> bool {
        let unit = self.at(address);
        unit.map(|unit| self.units[unit].plugged = false).is_some()
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
    pub(super) fn pass_request(
        &mut self,
        station: usize,
        now: Time,
        due: Time,
        request: Datagram<'_>,
        queue: &mut Queue,
    ) -> Option<Blow> {
        let (station, unit) = self.both(station);
        station.injector.pass(Way::Request, now, due, request, |bytes| unit.drive.mislabel(bytes), queue)
    }

    /// Puts an answer from a socket under way.
    pub(super) fn pass_reply(
        &mut self,
        station: usize,
        now: Time,
        due: Time,
        to: SocketAddrV4,
        bytes: &[u8],
        queue: &mut Queue,
    ) {
        let (station, unit) = self.both(station);
        let reply = Datagram { from: station.address, to, bytes };
        station.injector.pass(Way::Reply, now, due, reply, |bytes| unit.drive.mislabel(bytes), queue);
    }
}

impl Inner {
    /// The drives whose own clock has come to it run; false: there is none.
    pub(super) fn run_drives(&mut self) -> bool {
        let (now, back) = (self.now, self.now + self.options.latency_ns);
        let is_due = |unit: &Unit| unit.due.is_some_and(|due| due <= now);
        let Some(index) = self.drives.units.iter().position(is_due) else { return false };
        let mut said = std::mem::take(&mut self.drives.said);
        let unit = &mut self.drives.units[index];
        said.run(now, &mut *unit.drive);
        unit.rests_until = now + SHORTEST_RUN_NS;
        for (socket, to, bytes) in said.messages() {
            let unit = &self.drives.units[index];
            let Some(station) = unit.sockets.get(socket).copied().filter(|_| unit.plugged) else { continue };
            let Station { carrier, peers, .. } = &self.drives.stations[station];
            if *carrier == Carrier::Datagrams || peers.contains(&to) {
                self.drives.pass_reply(station, now, back, to, bytes, &mut self.under_way);
            }
        }
        self.drives.said = said;
        self.hang_ups(index);
        self.drives.called(index);
        true
    }

    /// The connections that a drive ends by itself.
    fn hang_ups(&mut self, unit: usize) {
        for k in 0..self.drives.units[unit].sockets.len() {
            let station = self.drives.units[unit].sockets[k];
            for place in 0..self.drives.stations[station].peers.len() {
                let (socket, unit) = self.drives.both(station);
                let peer = socket.peers[place];
                if unit.drive.hangs_up(peer) {
                    self.signal_master(station, peer, Signal::End);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
