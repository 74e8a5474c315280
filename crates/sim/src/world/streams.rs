//! Connections in a virtual world.
//!
//! The master's ends are opened, initialised (handshake) and re-opened by the machine that the link thread uses on
//! real sockets. Each connection has a new local address, so that parcels under way to an old one reach nobody. An
//! unplugged drive is silent: sent bytes wait, as a host repeats what is not acknowledged, until the cable is back
//! or the connection is given up.

mod carrier;

use std::collections::VecDeque;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Wake;

use super::{Inner, World, record};
use crate::Carrier;
use crate::fault::{DriveFault, Parcel, Signal, Way};
use fieldbeat_core::net::link::{Action, Connection};
use fieldbeat_core::net::{Broken, LinkNotes, StreamPeer};
use fieldbeat_core::time::Time;

/// Received bytes on a connection that were not taken. A drive that sends more to a master that does not read loses
/// the excess.
const INBOX: usize = 16_384;
/// Bytes that the wire accepts without an acknowledgement.
const WINDOW: usize = 2_048;
/// The master's ends of connections: RFC 2544 keeps 198.18.0.0/15 free for tests. The ports are those for such ends
/// (RFC 6335).
const FIRST_LOCAL: (Ipv4Addr, u16) = (Ipv4Addr::new(198, 18, 0, 0), 49_152);
/// The number of ports at one address.
const PORTS: u32 = 16_384;

/// All connections of a world, open or not.
#[derive(Default)]
pub(super) struct Links {
    sets: Vec<Set>,
    sets_made: u64,
    /// How many were opened so far.
    opened: u32,
    /// When time alone makes something happen next.
    alarm: Option<Time>,
    posted: Arc<Posted>,
}

/// Something was posted to a session. It locks nothing: whoever posts something may be called by the world.
#[derive(Debug, Default)]
struct Posted(AtomicBool);

impl Wake for Posted {
    fn wake(self: Arc<Self>) {
        self.0.store(true, Ordering::Release);
    }
}

/// The connections of one carrier.
struct Set {
    id: u64,
    links: Vec<Link>,
    /// Connections ready for the loop.
    opened: VecDeque<usize>,
}

/// The master's end of one connection.
struct Link {
    machine: Connection,
    /// The drive at its peer's address, if there is one.
    station: Option<usize>,
    /// Its address; `None`: closed.
    local: Option<SocketAddrV4>,
    hold: Hold,
    /// Received bytes for the loop ...
    inbox: VecDeque<u8>,
    /// ... and how the connection ended after them.
    broken: Option<Broken>,
    /// Parcels that wait for the cable of the drive, both ways.
    stalled: VecDeque<Parcel>,
    /// Since when bytes to the drive wait there.
    unacknowledged: Option<Time>,
}

/// The owner of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Hold {
    /// It is closed, being opened outside the loop, or a session's.
    Outside,
    /// It is ready for the loop.
    Offered,
    /// The loop has it.
    Loop,
}

/// Where a link is: its set, and its place there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Place(usize, usize);

impl Link {
    fn new(machine: Connection, station: Option<usize>) -> Link {
        Link {
            machine,
            station,
            local: None,
            hold: Hold::Outside,
            inbox: VecDeque::with_capacity(INBOX),
            broken: None,
            stalled: VecDeque::with_capacity(4),
            unacknowledged: None,
        }
    }

    fn readable(&self) -> bool {
        self.hold == Hold::Loop && (!self.inbox.is_empty() || self.broken.is_some())
    }

    /// When its peer's host has not acknowledged for too long.
    fn given_up_at(&self) -> Option<Time> {
        self.unacknowledged.map(|since| since + self.machine.peer().unacknowledged_ns)
    }

    /// When time alone makes something happen next.
    fn next_due(&self) -> Option<Time> {
        [self.machine.next_due(), self.given_up_at()].into_iter().flatten().min()
    }

    fn is_full(&self) -> bool {
        self.stalled.iter().map(|parcel| parcel.bytes.len()).sum::<usize>() >= WINDOW
    }
}

impl Links {
    /// When time alone makes something happen next.
    pub(super) fn alarm(&self) -> Option<Time> {
        if self.posted.0.load(Ordering::Relaxed) { Some(Time::default()) } else { self.alarm }
    }

    /// Whether something waits that the loop can take.
    pub(super) fn readable(&self) -> bool {
        self.places().any(|(_, link)| link.readable())
    }

    fn set_alarm(&mut self) {
        self.alarm = self.places().filter_map(|(_, link)| link.next_due()).min();
    }

    fn at(&mut self, Place(set, link): Place) -> &mut Link {
        &mut self.sets[set].links[link]
    }

    fn by_id(&mut self, id: u64) -> Option<&mut Set> {
        self.sets.iter_mut().find(|set| set.id == id)
    }

    fn places(&self) -> impl Iterator<Item = (Place, &Link)> {
        self.sets.iter().enumerate().flat_map(|(number, set)| {
            set.links.iter().enumerate().map(move |(index, link)| (Place(number, index), link))
        })
    }

    /// The one that has this local address now.
    fn by_local(&self, local: SocketAddrV4) -> Option<Place> {
        self.places().find(|(_, link)| link.local == Some(local)).map(|(place, _)| place)
    }

    fn next_local(&mut self, bind: Option<Ipv4Addr>) -> SocketAddrV4 {
        let (first, port) = FIRST_LOCAL;
        let number = self.opened;
        self.opened = self.opened.wrapping_add(1);
        let ip = bind.unwrap_or_else(|| (first.to_bits() + (number / PORTS) % (1 << 17)).into());
        SocketAddrV4::new(ip, port + (number % PORTS) as u16)
    }
}

/// The master's ends.
impl Inner {
    /// Begins to open connections to `peers`; the id of the set.
    fn open(&mut self, peers: Vec<StreamPeer>, notes: &LinkNotes) -> u64 {
        let (now, id, opened) = (self.now, self.links.sets_made, VecDeque::with_capacity(peers.len()));
        let links = peers.into_iter().enumerate().map(|(index, peer)| {
            let station = self.drives.station(Carrier::Stream, peer.address);
            Link::new(Connection::new(now, peer, notes.clone(), index), station)
        });
        let set = Set { id, links: links.collect(), opened };
        self.links.sets_made += 1;
        self.links.sets.push(set);
        self.links.set_alarm();
        id
    }

    /// Closes the connections of a set, as when their sockets are.
    fn close(&mut self, id: u64) {
        let Some(set) = self.links.sets.iter().position(|set| set.id == id) else { return };
        for link in 0..self.links.sets[set].links.len() {
            self.hang_up(Place(set, link));
        }
        self.links.sets.remove(set);
        self.links.set_alarm();
    }

    /// Everything that time alone makes happen now, and what was posted to sessions.
    pub(super) fn ring(&mut self) {
        let posted = self.links.posted.0.swap(false, Ordering::AcqRel);
        for set in 0..self.links.sets.len() {
            for link in 0..self.links.sets[set].links.len() {
                let place = Place(set, link);
                if self.links.at(place).given_up_at().is_some_and(|due| due <= self.now) {
                    self.links.at(place).unacknowledged = None;
                    self.break_off(place, Broken::Failed(libc::ETIMEDOUT));
                }
                if posted {
                    self.work(place, Connection::run);
                }
                if self.links.at(place).machine.next_due().is_some_and(|due| due <= self.now) {
                    self.work(place, Connection::poll);
                }
            }
        }
        self.links.set_alarm();
    }

    /// Passes an event to the machine of a link, and carries out the resulting actions.
    fn work(&mut self, place: Place, happens: impl FnOnce(&mut Connection, Time) -> Action) {
        let now = self.now;
        let mut action = happens(&mut self.links.at(place).machine, now);
        loop {
            match action {
                Action::Wait => break,
                Action::Connect => {
                    let bind = self.links.at(place).machine.peer().bind;
                    let local = self.links.next_local(bind);
                    self.links.at(place).local = Some(local);
                    self.signal_drive(place, local, Signal::Open);
                    break;
                }
                Action::Send => {
                    let count = self.send_handshake(place);
                    action = self.links.at(place).machine.sent(now, count);
                }
                Action::HandOver => {
                    self.links.at(place).hold = Hold::Offered;
                    self.links.sets[place.0].opened.push_back(place.1);
                    break;
                }
                Action::Close => {
                    self.hang_up(place);
                    break;
                }
            }
        }
        self.links.set_alarm();
    }

    /// Sends the bytes of the handshake or session.
    fn send_handshake(&mut self, place: Place) -> usize {
        let link = &self.links.sets[place.0].links[place.1];
        let (Some(station), Some(from)) = (link.station, link.local) else { return 0 };
        let (bytes, due) = (link.machine.to_send(), self.now + self.options.latency_ns);
        let fault = self.drives.request(station, self.now, due, (from, bytes), &mut self.under_way);
        let count = bytes.len();
        self.inject(self.drives.stations[station].unit, fault);
        count
    }

    /// Closes the master's end. Parcels under way to it reach nobody.
    fn hang_up(&mut self, place: Place) {
        let link = self.links.at(place);
        let Some(local) = link.local.take() else { return };
        (link.hold, link.broken, link.unacknowledged) = (Hold::Outside, None, None);
        link.inbox.clear();
        while let Some(parcel) = self.links.at(place).stalled.pop_front() {
            self.under_way.recycle(parcel);
        }
        if let Some(station) = self.links.at(place).station {
            self.drives.stations[station].injector.closed(local);
        }
        self.signal_drive(place, local, Signal::End);
    }

    /// A connection no longer works.
    fn break_off(&mut self, place: Place, why: Broken) {
        let link = self.links.at(place);
        match link.hold {
            Hold::Outside => self.work(place, |machine, now| machine.failed(now, why)),
            Hold::Offered | Hold::Loop => link.broken = link.broken.or(Some(why)),
        }
    }

    /// A parcel comes to an address that may be the master's end of a connection. Returns a used buffer.
    pub(super) fn arrive(&mut self, parcel: Parcel) -> Option<Parcel> {
        let Some(place) = self.links.by_local(parcel.to) else { return Some(parcel) };
        if self.links.at(place).station.is_some_and(|station| !self.drives.both(station).1.plugged) {
            return self.stall(place, parcel);
        }
        record(&mut self.digest, self.now, &parcel);
        self.delivered += 1;
        match parcel.signal {
            Signal::Accept => self.work(place, Connection::connected),
            Signal::Reset => {
                let opening = self.links.at(place).hold == Hold::Outside;
                let errno = if opening { libc::ECONNREFUSED } else { libc::ECONNRESET };
                self.break_off(place, Broken::Failed(errno));
            }
            Signal::Bytes => self.take_in(place, &parcel.bytes),
            Signal::End => {
                self.take_in(place, &parcel.bytes);
                self.break_off(place, Broken::Closed);
                if let Some(index) = self.drives.station(Carrier::Stream, parcel.from) {
                    self.drives.disconnected(index, self.now, parcel.to);
                }
            }
            Signal::Open => {}
        }
        Some(parcel)
    }

    fn take_in(&mut self, place: Place, bytes: &[u8]) {
        let link = self.links.at(place);
        match link.hold {
            Hold::Outside => self.work(place, |machine, now| machine.received(now, bytes)),
            _ if link.broken.is_some() => {}
            _ if link.inbox.len() + bytes.len() > INBOX => {
                self.break_off(place, Broken::Failed(libc::ECONNRESET));
            }
            _ => link.inbox.extend(bytes),
        }
    }

    /// The cable is out: parcels under way wait, in order.
    fn stall(&mut self, place: Place, parcel: Parcel) -> Option<Parcel> {
        let now = self.now;
        let link = self.links.at(place);
        if parcel.signal == Signal::Bytes && Some(parcel.from) == link.local {
            link.unacknowledged = link.unacknowledged.or(Some(now));
            self.links.set_alarm();
        }
        let link = self.links.at(place);
        match link.stalled.back_mut() {
            Some(last)
                if (last.from, last.signal, parcel.signal) == (parcel.from, Signal::Bytes, Signal::Bytes) =>
            {
                last.bytes.extend_from_slice(&parcel.bytes);
                Some(parcel)
            }
            _ => {
                link.stalled.push_back(parcel);
                None
            }
        }
    }

    fn signal_drive(&mut self, place: Place, from: SocketAddrV4, signal: Signal) {
        let (due, link) = (self.now + self.options.latency_ns, self.links.at(place));
        let Some(station) = link.station else { return };
        let station = &mut self.drives.stations[station];
        let parcel = self.under_way.signal(from, station.address, signal);
        station.injector.signal(Way::Request, due, parcel, &mut self.under_way);
    }
}

/// The drives' ends.
impl Inner {
    /// A parcel comes to a drive's socket. Returns a used buffer.
    pub(super) fn receive(&mut self, index: usize, parcel: Parcel) -> Option<Parcel> {
        let is_stream = parcel.carrier == Carrier::Stream;
        let of = if is_stream { self.links.by_local(parcel.from) } else { None };
        let (station, unit) = self.drives.both(index);
        if !unit.plugged {
            return match of {
                Some(place) => self.stall(place, parcel),
                None => Some(parcel),
            };
        }
        record(&mut self.digest, self.now, &parcel);
        self.delivered += 1;
        match parcel.signal {
            // Given up while it was under way: as if it had been closed at once.
            Signal::Open if of.is_some() => {
                let accepts = self.drives.connect(index, self.now, parcel.from);
                self.signal_master(index, parcel.from, if accepts { Signal::Accept } else { Signal::Reset });
            }
            Signal::Bytes if station.reaches(parcel.from) => self.serve(index, &parcel),
            Signal::Bytes => self.signal_master(index, parcel.from, Signal::Reset),
            Signal::End | Signal::Reset => self.drives.disconnected(index, self.now, parcel.from),
            Signal::Open | Signal::Accept => {}
        }
        Some(parcel)
    }

    fn signal_master(&mut self, index: usize, to: SocketAddrV4, signal: Signal) {
        let due = self.now + self.options.latency_ns;
        self.drives.signal(index, due, to, signal, &mut self.under_way);
    }

    /// Injects a fault into drive `index`. A restart resets its connections.
    pub(super) fn inject(&mut self, index: usize, fault: Option<DriveFault>) {
        let Some(fault) = fault else { return };
        for (station, peer) in self.drives.inject(index, self.now, fault) {
            self.signal_master(station, peer, Signal::Reset);
        }
    }

    /// Plugs the cable of drive `index` in again: waiting parcels arrive, and the drive learns which connections
    /// have ended.
    pub(super) fn plug(&mut self, index: usize) {
        let now = self.now;
        let Inner { links, drives, .. } = self;
        let unit = &mut drives.units[index];
        unit.plugged = true;
        for station in &unit.sockets {
            drives.stations[*station].peers.retain(|peer| {
                let lives = links.by_local(*peer).is_some();
                if !lives {
                    unit.drive.disconnected(now, *peer);
                }
                lives
            });
        }
        for link in links.sets.iter_mut().flat_map(|set| &mut set.links) {
            if link.station.is_some_and(|station| drives.stations[station].unit == index) {
                link.unacknowledged = None;
                link.stalled.drain(..).for_each(|parcel| self.under_way.push(now, parcel));
            }
        }
        self.links.set_alarm();
        self.drives.called(index);
    }
}

#[cfg(test)]
pub(crate) mod tests;
