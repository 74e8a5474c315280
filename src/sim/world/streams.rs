//! Connections in a virtual world.
//!
//! The master's ends are opened, initialised (handshake) and re-opened by the machine that the link thread uses on
//! real sockets. Each connection has a new local address, so that parcels under way to an old one reach nobody. An
//! unplugged drive is silent: sent bytes wait, as a host repeats what is not acknowledged, until the cable is back
//! or the connection is given up.

use std::collections::VecDeque;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::RawFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};

use super::{Inner, World, record};
use crate::net::link::{Action, Connection};
use crate::net::{Broken, LinkNotes, StreamPeer, Streams};
use crate::rt::Regions;
use crate::sim::Carrier;
use crate::sim::fault::{DriveFault, Parcel, Signal, Way};
use crate::time::Time;

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

impl World {
    pub(super) fn open_streams(&self, peers: Vec<StreamPeer>) -> StreamCarrier {
        let notes = LinkNotes::new(peers.len());
        let ready = VecDeque::with_capacity(peers.len());
        let mut inner = self.lock();
        let posted = Arc::clone(&inner.links.posted);
        StreamCarrier { id: inner.open(peers, &notes), world: self.clone(), notes, posted, ready }
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

/// A carrier of connections in a world.
#[derive(Debug)]
pub(super) struct StreamCarrier {
    world: World,
    id: u64,
    notes: LinkNotes,
    posted: Arc<Posted>,
    /// The connections that the last look found.
    ready: VecDeque<usize>,
}

impl StreamCarrier {
    fn place(&self, inner: &Inner, index: usize) -> Option<Place> {
        let set = inner.links.sets.iter().position(|set| set.id == self.id)?;
        let link = inner.links.sets[set].links.get(index)?;
        (link.hold == Hold::Loop).then_some(Place(set, index))
    }
}

impl Streams for StreamCarrier {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn opened(&mut self) -> Option<usize> {
        let mut inner = self.world.lock();
        let set = inner.links.by_id(self.id)?;
        let index = set.opened.pop_front()?;
        set.links[index].hold = Hold::Loop;
        Some(index)
    }

    fn look(&mut self) {
        let mut inner = self.world.lock();
        inner.read();
        self.ready.clear();
        if let Some(set) = inner.links.by_id(self.id) {
            let readable = set.links.iter().enumerate().filter(|(_, link)| link.readable());
            self.ready.extend(readable.map(|(index, _)| index));
        }
    }

    fn ready(&mut self) -> Option<usize> {
        self.ready.pop_front()
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let mut inner = self.world.lock();
        let at = inner.read();
        let place = self.place(&inner, index).ok_or(Broken::Absent)?;
        let link = inner.links.at(place);
        match (link.inbox.is_empty(), link.broken) {
            (true, Some(why)) => Err(why),
            (true, None) => Ok(None),
            (false, _) => {
                // Reading from this queue of bytes cannot fail, nor wait.
                let count = io::Read::read(&mut link.inbox, room).unwrap_or(0);
                Ok(Some((at, count)))
            }
        }
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let mut inner = self.world.lock();
        let at = inner.read();
        let place = self.place(&inner, index).ok_or(Broken::Absent)?;
        let link = inner.links.at(place);
        if let Some(why) = link.broken {
            return Err(why);
        }
        if link.is_full() {
            return Ok((at, 0));
        }
        let (Some(from), Some(station)) = (link.local, link.station) else { return Err(Broken::Absent) };
        inner.depart_to(station, from, bytes);
        Ok((at, bytes.len()))
    }

    fn abandon(&mut self, index: usize, why: &'static str) {
        let mut inner = self.world.lock();
        if let Some(place) = self.place(&inner, index) {
            inner.work(place, |machine, now| machine.given_back(now, why));
        }
    }

    fn notes(&self) -> LinkNotes {
        self.notes.clone()
    }

    fn waker(&self) -> Option<Waker> {
        Some(Arc::clone(&self.posted).into())
    }

    /// Virtual time is never real time: nothing to lock.
    fn memory(&self, _regions: &mut Regions) {}
}

/// Its connections are closed, as when their sockets are.
impl Drop for StreamCarrier {
    fn drop(&mut self) {
        self.world.lock().close(self.id);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::{Carriers, Handshake, HandshakeState};
    use crate::rt::{Clock, PollSet};
    use crate::sim::fault::{Datagram, Injector, Queue, RETRANSMISSION_NS};
    use crate::sim::testing::Peers;
    use crate::sim::world::WorldOptions;
    use crate::sim::{FaultPlan, SimDrive};
    use crate::time::{MS, S, US};

    /// One direction.
    const LATENCY: u64 = 20 * US;

    fn drive(n: u8) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::new(10, 0, 2, n), 1502)
    }

    /// Answers each request of two bytes, a number and its complement, with the number and the count of requests
    /// since its start; ends the connection at anything else.
    struct Line {
        address: SocketAddrV4,
        carrier: Carrier,
        faults: FaultPlan,
        most: usize,
        answered: u8,
        lost: bool,
        peers: Peers,
    }

    impl SimDrive for Line {
        fn address(&self) -> SocketAddrV4 {
            self.address
        }

        fn faults(&self) -> FaultPlan {
            self.faults.clone()
        }

        fn carrier(&self) -> Carrier {
            self.carrier
        }

        fn receive(
            &mut self,
            _now: Time,
            from: SocketAddrV4,
            bytes: &[u8],
            reply: &mut Vec<u8>,
        ) -> Option<SocketAddrV4> {
            for [number, complement] in self.peers.requests(from, bytes) {
                self.lost |= number != !complement;
                self.answered = self.answered.wrapping_add(1);
                reply.extend([number, self.answered]);
            }
            (!reply.is_empty() && !self.lost).then_some(from)
        }

        fn connect(&mut self, _now: Time, from: SocketAddrV4) -> bool {
            self.peers.connect(from, self.most)
        }

        fn hangs_up(&mut self, _from: SocketAddrV4) -> bool {
            std::mem::take(&mut self.lost)
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
            self.answered = 0;
        }
    }

    /// Sends one request, 77.
    #[derive(Debug)]
    struct Ask(Vec<u8>);

    impl Handshake for Ask {
        fn begin(&mut self, _now: Time, out: &mut Vec<u8>) -> HandshakeState {
            self.0.clear();
            out.extend([77, !77]);
            HandshakeState::More
        }

        fn take(&mut self, _now: Time, bytes: &[u8], _out: &mut Vec<u8>) -> HandshakeState {
            self.0.extend_from_slice(bytes);
            match self.0[..] {
                [77, _] => HandshakeState::Done,
                [_, _, ..] => HandshakeState::Failed("this is no line".into()),
                _ => HandshakeState::More,
            }
        }
    }

    /// A world with a master in it: a carrier with a connection to each of its drives.
    struct Rig {
        world: World,
        carrier: Box<dyn Streams>,
        /// The peers of each drive.
        peers: Vec<Peers>,
        /// The received bytes.
        received: Vec<Vec<u8>>,
        open: Vec<bool>,
        broken: Vec<(usize, Broken)>,
    }

    fn lines(count: u8, faults: &FaultPlan) -> Vec<Line> {
        let line = |n| Line {
            address: drive(n),
            carrier: Carrier::Stream,
            faults: FaultPlan { seed: faults.seed + u64::from(n), ..faults.clone() },
            most: 2,
            answered: 0,
            lost: false,
            peers: Peers::default(),
        };
        (0..count).map(line).collect()
    }

    impl Rig {
        fn new(count: u8, faults: FaultPlan) -> Rig {
            Rig::of(lines(count, &faults), WorldOptions { read_ns: 0, ..WorldOptions::default() })
        }

        fn of(lines: Vec<Line>, options: WorldOptions) -> Rig {
            let peers: Vec<_> = lines.iter().map(|line| line.peers.clone()).collect();
            let addresses: Vec<_> = lines.iter().map(|line| line.address).collect();
            let drives =
                lines.into_iter().map(|line| Box::new(line) as Box<dyn SimDrive>).collect::<Vec<_>>();
            let world = World::new(drives, options).unwrap();
            let ask = |address: &SocketAddrV4| StreamPeer::new(*address, Box::new(Ask(Vec::new())));
            let carrier = world.streams(addresses.iter().map(ask).collect()).unwrap();
            let count = peers.len();
            let (received, open) = (vec![Vec::new(); count], vec![false; count]);
            Rig { world, carrier, peers, received, open, broken: Vec::new() }
        }

        /// Takes in what has arrived, as a bus does.
        fn take(&mut self) {
            while let Some(index) = self.carrier.opened() {
                assert!(!std::mem::replace(&mut self.open[index], true));
                self.received[index].clear();
            }
            self.carrier.look();
            while let Some(index) = self.carrier.ready() {
                let mut room = [0; 3];
                match self.carrier.receive(index, &mut room) {
                    Ok(got) => self.received[index].extend(&room[..got.map_or(0, |(_, count)| count)]),
                    Err(why) => self.lose(index, why),
                }
            }
        }

        fn lose(&mut self, index: usize, why: Broken) {
            self.broken.push((index, why));
            self.carrier.abandon(index, "it broke");
            self.open[index] = false;
        }

        fn request(&mut self, index: usize, number: u8) -> Result<(Time, usize), Broken> {
            self.carrier.send(index, &[number, !number])
        }

        /// Lets `ns` pass while reading.
        fn pass(&mut self, ns: u64) {
            let (mut clock, until) = (self.world.clock(), self.world.now() + ns);
            while clock.wait(&mut PollSet::default(), until) {
                self.take();
            }
            self.take();
        }

        /// Lets time pass until connection `index` is open; the instant.
        fn opened(&mut self, index: usize) -> Time {
            for _ in 0..50_000 {
                if self.open[index] {
                    return self.world.now();
                }
                self.pass(100 * US);
            }
            panic!("{:?}", self.carrier.notes().get(index));
        }

        fn connected(&self, index: usize) -> usize {
            self.peers[index].count()
        }
    }

    #[test]
    fn a_connection_is_opened_greeted_and_handed_over_and_takes_its_latencies() {
        let faults = FaultPlan { answer_ns: 100 * US, ..FaultPlan::default() };
        let mut rig = Rig::new(1, faults);
        assert_eq!(rig.request(0, 1), Err(Broken::Absent));
        let knock = rig.world.lock().next_due().unwrap();
        rig.world.advance(knock.since(rig.world.now()) + 4 * LATENCY + 100 * US - 1);
        rig.take();
        assert!(!rig.open[0]);
        rig.world.advance(1);
        rig.take();
        assert!(rig.open[0] && rig.carrier.notes().get(0).is_none());

        let begin = rig.world.now();
        assert_eq!(rig.request(0, 5), Ok((begin, 2)));
        let mut set = PollSet::default();
        assert!(!rig.world.clock().wait(&mut set, begin + 140 * US - 1));
        assert!(rig.world.clock().wait(&mut set, begin + MS));
        assert_eq!(rig.world.now(), begin + 140 * US);
        rig.take();
        // The first request was the handshake.
        assert_eq!(rig.received[0], [5, 2]);
        assert!(!rig.world.clock().wait(&mut set, begin + MS));
    }

    #[test]
    fn who_refuses_and_who_is_not_there_is_told_apart_and_tried_again() {
        let mut lines = lines(4, &FaultPlan::default());
        lines[0].most = 0;
        lines[1].carrier = Carrier::Datagrams;
        let mut rig = Rig::of(lines, WorldOptions::default());
        assert!(rig.world.unplug(drive(2)));
        let nobody = StreamPeer::new(drive(99), Box::new(Ask(Vec::new())));
        let other = rig.world.streams(vec![nobody]).unwrap();
        rig.pass(3 * S);
        assert_eq!(rig.open, [false, false, false, true]);
        let note = |index| rig.carrier.notes().get(index).unwrap();
        assert!(note(0).contains("refused") && note(1).contains("refused"), "{} {}", note(0), note(1));
        assert!(note(2).contains("no answer"), "{}", note(2));
        assert!(other.notes().get(0).unwrap().contains("no answer"));
        assert!(rig.world.plug(drive(2)));
        rig.opened(2);
        assert_eq!(rig.carrier.notes().get(2), None);
    }

    #[test]
    fn what_speaks_another_language_is_not_handed_over() {
        let mut rig = Rig::new(1, FaultPlan { wrong_id: 1.0, ..FaultPlan::default() });
        rig.pass(S);
        assert!(!rig.open[0]);
        let note = rig.carrier.notes().get(0).unwrap();
        assert!(note.contains("this is no line"), "{note}");
        assert_eq!(rig.connected(0), 0);
        assert!(rig.world.set_faults(drive(0), FaultPlan::default()));
        rig.opened(0);
    }

    #[test]
    fn split_bytes_come_one_by_one_and_in_order() {
        let mut rig = Rig::new(1, FaultPlan { split: 1.0, ..FaultPlan::default() });
        rig.opened(0);
        let (mut set, mut came) = (PollSet::default(), Vec::new());
        for number in 0..3 {
            rig.request(0, number).unwrap();
        }
        let end = rig.world.now() + MS;
        while rig.world.clock().wait(&mut set, end) {
            rig.take();
            came.push((rig.world.now(), rig.received[0].len()));
        }
        assert_eq!(rig.received[0], [0, 2, 1, 3, 2, 4]);
        assert!(came.iter().map(|(_, count)| *count).eq(1..=6), "{came:?}");
        assert!(came.windows(2).all(|pair| pair[0].0 < pair[1].0), "{came:?}");
        assert_eq!(rig.world.injected(drive(0)).unwrap().split, 8);
    }

    #[test]
    fn nothing_overtakes_on_a_stream() {
        let faults =
            FaultPlan { seed: 4, delay: 0.3, delay_ns: 300 * US, split: 0.3, ..FaultPlan::default() };
        let mut rig = Rig::new(1, faults);
        rig.opened(0);
        for number in 0..100 {
            rig.request(0, number).unwrap();
            rig.pass(30 * US);
        }
        rig.pass(MS);
        let expected: Vec<_> = (0..100).flat_map(|number| [number, number + 2]).collect();
        assert_eq!(rig.received[0], expected);
        assert!(rig.broken.is_empty());
        let injected = rig.world.injected(drive(0)).unwrap();
        assert!(injected.delayed > 40 && injected.split > 40, "{injected:?}");
    }

    #[test]
    fn a_stall_holds_up_and_loses_nothing() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        let plan = FaultPlan { stall: 1.0, stall_ns: 5 * MS, ..FaultPlan::default() };
        assert!(rig.world.set_faults(drive(0), plan));
        let begin = rig.world.now();
        rig.request(0, 1).unwrap();
        rig.pass(MS);
        rig.request(0, 2).unwrap();
        assert!(!rig.world.clock().wait(&mut PollSet::default(), begin + 5 * MS));
        rig.pass(MS);
        assert_eq!(rig.received[0], [1, 2, 2, 3]);
        let injected = rig.world.injected(drive(0)).unwrap();
        assert_eq!((injected.stalls, injected.stalled), (1, 2));
    }

    #[test]
    fn a_lost_segment_comes_after_the_hosts_timeout_and_what_follows_waits_behind_it() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        let lossy = |segment_loss| FaultPlan { segment_loss, ..FaultPlan::default() };
        // The request is lost once, the seed says.
        let seed = (0..).find(|seed| {
            let mut losses = Injector::new(FaultPlan { seed: *seed, ..lossy(0.5) }, Carrier::Stream);
            let mut queue = Queue::new(4);
            let request = Datagram { from: drive(9), to: drive(0), bytes: &[1] };
            losses.pass(Way::Request, Time(0), Time(0), request, |_| {}, &mut queue);
            queue.next_due() == Some(Time(RETRANSMISSION_NS))
        });
        let plan = FaultPlan { seed: seed.unwrap(), ..lossy(0.5) };
        assert!(rig.world.set_faults(drive(0), plan));
        let begin = rig.world.now();
        rig.request(0, 1).unwrap();
        rig.world.set_faults(drive(0), FaultPlan::default());
        rig.pass(MS);
        rig.request(0, 2).unwrap();
        let mut set = PollSet::default();
        assert!(!rig.world.clock().wait(&mut set, begin + RETRANSMISSION_NS + 2 * LATENCY - 1));
        assert!(rig.world.clock().wait(&mut set, begin + S));
        assert_eq!(rig.world.now(), begin + RETRANSMISSION_NS + 2 * LATENCY);
        rig.pass(0);
        assert_eq!(rig.received[0], [1, 2, 2, 3]);
        // From now on nothing waits.
        let begin = rig.world.now();
        rig.request(0, 3).unwrap();
        assert!(rig.world.clock().wait(&mut set, begin + S));
        assert_eq!(rig.world.now(), begin + 2 * LATENCY);
    }

    #[test]
    fn a_segment_lost_again_and_again_comes_after_doubled_timeouts_unless_its_connection_is_closed() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        let all = FaultPlan { segment_loss: 1.0, ..FaultPlan::default() };
        assert!(rig.world.set_faults(drive(0), all));
        rig.request(0, 1).unwrap();
        assert_eq!(rig.world.injected(drive(0)).unwrap().segments, 10);
        rig.world.set_faults(drive(0), FaultPlan::default());
        let begin = rig.world.now();
        let timeouts = (1 << 10) - 1;
        assert!(!rig.world.clock().wait(&mut PollSet::default(), begin + timeouts * RETRANSMISSION_NS - MS));
        rig.carrier.abandon(0, "it takes too long");
        rig.open[0] = false;
        rig.opened(0);
        rig.request(0, 2).unwrap();
        rig.pass(S);
        // The handshake is the second request that the drive gets.
        assert_eq!((&rig.received[0][..], rig.connected(0)), (&[2, 3][..], 1));
    }

    #[test]
    fn a_cut_ends_the_connection_in_the_middle_of_a_reply() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        assert!(rig.world.set_faults(drive(0), FaultPlan { cut: 1.0, ..FaultPlan::default() }));
        rig.request(0, 9).unwrap();
        rig.pass(MS);
        assert_eq!((&rig.received[0][..], &rig.broken[..]), (&[9][..], &[(0, Broken::Closed)][..]));
        assert_eq!((rig.connected(0), rig.world.injected(drive(0)).unwrap().cut), (0, 1));
        let note = rig.carrier.notes().get(0).unwrap();
        assert!(note.contains("it broke"), "{note}");
        assert!(rig.world.set_faults(drive(0), FaultPlan::default()));
        rig.opened(0);
        rig.request(0, 3).unwrap();
        rig.pass(MS);
        assert_eq!(rig.received[0], [3, 4]);
    }

    #[test]
    fn a_drive_that_hangs_up_is_heard() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        rig.carrier.send(0, &[1, 1]).unwrap();
        rig.pass(MS);
        assert_eq!((&rig.broken[..], rig.connected(0)), (&[(0, Broken::Closed)][..], 0));
    }

    #[test]
    fn a_restart_breaks_connections_off_and_they_come_back() {
        let mut rig = Rig::new(2, FaultPlan::default());
        rig.opened(0);
        rig.opened(1);
        rig.request(0, 1).unwrap();
        assert!(rig.world.restart(drive(0)));
        rig.pass(MS);
        assert_eq!(rig.broken, [(0, Broken::Failed(libc::ECONNRESET))]);
        // The requests to the old one reached nobody.
        assert_eq!((&rig.received[0][..], rig.open[1]), (&[][..], true));
        rig.opened(0);
        rig.request(0, 2).unwrap();
        rig.request(1, 3).unwrap();
        rig.pass(MS);
        assert_eq!((&rig.received[0][..], &rig.received[1][..]), (&[2, 2][..], &[3, 2][..]));
        let restarts = FaultPlan { restart: 1.0, ..FaultPlan::default() };
        assert!(rig.world.set_faults(drive(1), restarts));
        rig.request(1, 4).unwrap();
        rig.pass(MS);
        assert_eq!(rig.broken[1..], [(1, Broken::Failed(libc::ECONNRESET))]);
    }

    #[test]
    fn a_short_loss_of_the_plug_loses_nothing() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        rig.request(0, 1).unwrap();
        assert!(rig.world.unplug(drive(0)));
        rig.pass(100 * MS);
        rig.request(0, 2).unwrap();
        rig.pass(100 * MS);
        assert!(rig.received[0].is_empty() && rig.broken.is_empty());
        assert!(rig.world.plug(drive(0)));
        rig.request(0, 3).unwrap();
        rig.pass(MS);
        assert_eq!(rig.received[0], [1, 2, 2, 3, 3, 4]);
        // It is no longer counted as silent.
        rig.pass(2 * S);
        assert!(rig.broken.is_empty());
    }

    #[test]
    fn a_reply_waits_for_the_plug_too() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        rig.request(0, 1).unwrap();
        rig.world.advance(LATENCY);
        assert!(rig.world.unplug(drive(0)));
        rig.pass(3 * S);
        // Its host has acknowledged all that was sent.
        assert!(rig.received[0].is_empty() && rig.broken.is_empty());
        assert!(rig.world.plug(drive(0)));
        rig.pass(MS);
        assert_eq!(rig.received[0], [1, 2]);
    }

    #[test]
    fn a_long_loss_of_the_plug_breaks_the_connection_and_it_comes_back_with_the_plug() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        assert!(rig.world.unplug(drive(0)));
        rig.request(0, 1).unwrap();
        let begin = rig.world.now();
        // As long as the peer's host may not acknowledge, from when it should have.
        assert!(!rig.world.clock().wait(&mut PollSet::default(), begin + S + LATENCY - 1));
        rig.pass(MS);
        assert_eq!(rig.broken, [(0, Broken::Failed(libc::ETIMEDOUT))]);
        rig.pass(10 * S);
        let note = rig.carrier.notes().get(0).unwrap();
        assert!(note.contains("no answer"), "{note}");
        // The drive knows nothing of it yet ...
        assert_eq!(rig.connected(0), 1);
        assert!(rig.world.plug(drive(0)));
        assert_eq!(rig.connected(0), 0);
        let back = rig.world.now();
        assert!(rig.opened(0).since(back) < 4 * S);
        rig.request(0, 2).unwrap();
        rig.pass(MS);
        // ... and never gets what was sent on the old one.
        assert_eq!(rig.received[0], [2, 3]);
    }

    #[test]
    fn without_the_plug_the_wire_takes_a_window_and_no_more() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        assert!(rig.world.unplug(drive(0)));
        let taken = (0..2 * WINDOW).filter(|_| {
            let taken = rig.request(0, 1).unwrap().1;
            rig.world.advance(LATENCY);
            taken > 0
        });
        assert_eq!(taken.count(), WINDOW / 2);
        assert!(rig.world.plug(drive(0)));
        rig.pass(MS);
        assert_eq!(rig.received[0].len(), WINDOW);
        assert_eq!(rig.request(0, 1).unwrap().1, 2);
    }

    #[test]
    fn what_is_under_way_to_an_old_connection_is_nobodys() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        let plan = FaultPlan { answer_ns: 150 * MS, ..FaultPlan::default() };
        assert!(rig.world.set_faults(drive(0), plan));
        let mine = |rig: &Rig| rig.peers[0].first();
        let first = mine(&rig);
        rig.request(0, 1).unwrap();
        rig.pass(MS);
        rig.carrier.abandon(0, "too slow");
        rig.open[0] = false;
        assert_eq!(
            (rig.request(0, 1), rig.carrier.receive(0, &mut [0; 8])),
            (Err(Broken::Absent), Err(Broken::Absent))
        );
        // The pause ends before the late answer comes, and the handshake follows it.
        rig.opened(0);
        assert_ne!(mine(&rig), first);
        rig.pass(S);
        assert!(rig.received[0].is_empty() && rig.broken.is_empty(), "{:?}", rig.received);
    }

    #[test]
    fn a_carrier_that_is_dropped_leaves_no_connection_and_no_alarm() {
        let mut rig = Rig::new(2, FaultPlan::default());
        rig.opened(0);
        rig.opened(1);
        let ask = StreamPeer::new(drive(0), Box::new(Ask(Vec::new())));
        let second = rig.world.streams(vec![ask]).unwrap();
        rig.pass(S);
        assert_eq!((rig.connected(0), rig.connected(1)), (2, 1));
        rig.carrier = second;
        rig.open.fill(false);
        rig.pass(MS);
        assert_eq!((rig.connected(0), rig.connected(1)), (1, 0));
        rig.request(0, 8).unwrap();
        rig.pass(MS);
        assert_eq!(rig.received[0][0], 8);
        assert_eq!(rig.world.lock().next_due(), None);
    }

    #[test]
    fn unknown_senders_reach_no_connection() {
        let mut rig = Rig::new(1, FaultPlan::default());
        rig.opened(0);
        let (unknown, peer) =
            (SocketAddrV4::new(Ipv4Addr::new(10, 9, 9, 9), 5), rig.peers[0].first().unwrap());
        rig.world.inject(drive(0), unknown, &[1, !1], rig.world.now());
        rig.world.inject(SocketAddrV4::new(*peer.ip(), 1), drive(0), &[1], rig.world.now());
        rig.request(0, 4).unwrap();
        rig.pass(MS);
        assert_eq!((&rig.received[0][..], rig.connected(0)), (&[4, 2][..], 1));
    }

    #[test]
    fn the_same_seed_makes_the_same_connections() {
        let stormy = FaultPlan {
            seed: 3,
            drop: 0.01,
            duplicate: 0.01,
            corrupt: 0.01,
            delay: 0.05,
            delay_ns: MS,
            reorder: 0.01,
            stall: 0.01,
            stall_ns: 3 * MS,
            restart: 0.01,
            wrong_id: 0.01,
            split: 0.1,
            cut: 0.01,
            segment_loss: 0.002,
            answer_ns: 30 * US,
            ..FaultPlan::default()
        };
        let run = |faults: &FaultPlan, seed| {
            let options = WorldOptions { seed, wake_ns: 20 * US, ..WorldOptions::default() };
            let mut rig = Rig::of(lines(5, faults), options);
            for round in 0..3_000_u32 {
                for index in 0..5 {
                    if rig.open[index]
                        && let Err(why) = rig.request(index, round as u8)
                    {
                        rig.lose(index, why);
                    }
                }
                rig.pass(MS);
                // Now and then the cable is unplugged.
                match round % 1_000 {
                    400 => drop(rig.world.unplug(drive((round / 1_000) as u8))),
                    900 => drop(rig.world.plug(drive((round / 1_000) as u8))),
                    _ => {}
                }
            }
            let injected: Vec<_> = (0..5).map(|n| rig.world.injected(drive(n))).collect();
            (rig.world.digest(), rig.world.delivered(), rig.broken, injected)
        };
        let first = run(&stormy, 1);
        assert_eq!(first, run(&stormy, 1));
        let count =
            |of: fn(&crate::sim::fault::Injected) -> u64| first.3.iter().flatten().map(of).sum::<u64>();
        assert!(count(|i| i.cut) > 5 && count(|i| i.restarts) > 5 && count(|i| i.split) > 50, "{first:?}");
        assert!(first.2.len() > 15, "{first:?}");
        assert_ne!(first.0, run(&stormy, 2).0);
        assert_ne!(first.0, run(&FaultPlan { seed: 4, ..stormy }, 1).0);
    }
}
