//! Seeded faults between a master and one simulated drive, and the queue of what is under way.
//!
//! The n-th parcel of a direction (a datagram, or the bytes handed to a stream at once) always meets the same
//! fault: decisions depend on the seed and the count alone. This file knows no socket, no protocol and no clock:
//! instants come as arguments.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::net::SocketAddrV4;

use super::{Carrier, FaultPlan};
use crate::time::{MS, Time};

/// Time between two bytes that come one at a time, ns: about a byte's time on 10 Mbit/s Ethernet.
const BYTE_NS: u64 = 1_000;

/// The initial capacity of every buffer, bytes: any usual telegram, so that none grows in use.
const LEAST_ROOM: usize = 512;

/// The first retransmission timeout of a host for a segment that nothing follows, ns (Linux: TCP_RTO_MIN).
pub const RETRANSMISSION_NS: u64 = 200 * MS;
/// A segment that is lost so often in a row is not lost again.
const MOST_LOSSES: u32 = 10;

/// The direction of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// From the master to the drive.
    Request,
    /// From the drive to the master.
    Reply,
}

/// One datagram under way, or the bytes handed to a stream at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Datagram<'a> {
    /// Its sender.
    pub from: SocketAddrV4,
    /// Its destination.
    pub to: SocketAddrV4,
    /// Its payload.
    pub bytes: &'a [u8],
}

/// The meaning of a parcel on its connection. All datagrams are bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Signal {
    /// Its bytes only.
    #[default]
    Bytes,
    /// A connection is requested.
    Open,
    /// The connection is accepted.
    Accept,
    /// The sender has ended the connection after these bytes.
    End,
    /// The connection is refused or reset.
    Reset,
}

/// Exact counts of the faults on one drive's wire, both directions together. What is said of datagrams holds for
/// the bytes handed to a stream at once, too.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Injected {
    /// Datagrams lost.
    pub dropped: u64,
    /// Datagrams that came twice.
    pub duplicated: u64,
    /// Datagrams with one flipped bit. On a segment such a frame is lost.
    pub corrupted: u64,
    /// Datagrams that came later by `delay_ns`.
    pub delayed: u64,
    /// Datagrams held back until the next one of their direction had passed.
    pub reordered: u64,
    /// Stalls begun.
    pub stalls: u64,
    /// Requests lost in a stall; on a stream, delayed by it.
    pub stalled: u64,
    /// Restarts; the request that triggers one is lost with it.
    pub restarts: u64,
    /// Times that the hardware enable was opened.
    pub inhibits: u64,
    /// Replies from a wrong port, or, on a stream, to something else.
    pub wrong_id: u64,
    /// Parcels that came one byte at a time.
    pub split: u64,
    /// Connections that ended in the middle of a reply.
    pub cut: u64,
    /// Segments lost, repetitions included.
    pub segments: u64,
}

/// A fault of the drive itself, injected when a datagram passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DriveFault {
    /// It is switched off and on again; the request is lost.
    Restart,
    /// Its hardware enable is open until then.
    Inhibit(Time),
}

impl DriveFault {
    /// The index of the drive that it hits, of `count` at one wire whose faults so far are `injected`: each time the
    /// next one.
    pub(super) fn place(self, injected: Injected, count: usize) -> usize {
        let number = match self {
            DriveFault::Restart => injected.restarts,
            DriveFault::Inhibit(_) => injected.inhibits,
        };
        number.saturating_sub(1) as usize % count.max(1)
    }
}

/// Makes the faults of one drive's wire, both ways.
#[derive(Debug)]
pub struct Injector {
    plan: FaultPlan,
    carrier: Carrier,
    /// The receiver's check sequence rejects corrupted parcels.
    checked: bool,
    /// By [`Way`].
    lanes: [Lane; 2],
    stalled_until: Time,
    injected: Injected,
}

/// One direction: its own random numbers, so that the order in which the two directions are used does not matter.
#[derive(Debug)]
struct Lane {
    random: fastrand::Rng,
    held: Option<Parcel>,
    /// On a stream, the instant by which all earlier parcels have arrived.
    behind: Time,
    /// Which segments are lost: random numbers of their own, so that they do not shift the other faults.
    losses: fastrand::Rng,
    /// The connections with a lost segment, by the master's end: nothing arrives on them until it has.
    gaps: Vec<(SocketAddrV4, Time)>,
}

/// The random decisions for one parcel.
struct Lot {
    drop: bool,
    duplicate: bool,
    corrupt: bool,
    bit: u64,
    delay: bool,
    reorder: bool,
    stall: bool,
    restart: bool,
    inhibit: bool,
    wrong_id: bool,
    split: bool,
    cut: bool,
}

impl Lane {
    fn new(seed: u64) -> Lane {
        Lane {
            random: fastrand::Rng::with_seed(seed),
            held: None,
            behind: Time::default(),
            losses: fastrand::Rng::with_seed(seed.rotate_left(32) ^ 0x5E67),
            gaps: Vec::new(),
        }
    }

    /// Draws whether a fault of this rate happens. Always draws, so that one rate does not shift another's
    /// decisions.
    fn happens(&mut self, rate: f64) -> bool {
        self.random.f64() < rate
    }

    /// Until when nothing arrives on the connection with this end.
    fn gap(&self, peer: SocketAddrV4) -> Time {
        self.gaps.iter().find(|(other, _)| *other == peer).map_or(Time::default(), |(_, until)| *until)
    }

    /// Puts `parcel` under way. On a stream it arrives after all earlier ones.
    fn send(&mut self, carrier: Carrier, due: Time, parcel: Parcel, queue: &mut Queue) {
        let due = match carrier {
            Carrier::Datagrams => due,
            Carrier::Stream => due.max(self.behind),
        };
        let span = parcel.span();
        let gap = self.gaps.iter_mut().find(|(peer, until)| *until > due && parcel.has_end(*peer));
        if let Some((_, until)) = gap {
            let due = *until;
            *until = due + span;
            return queue.push(due, parcel);
        }
        self.behind = due + span;
        queue.push(due, parcel);
    }

    /// The next segment of the connection with this end may be lost, and so may its repetitions: nothing arrives on it
    /// before the first one that is not. It would have arrived at `due`. Returns how many are lost.
    fn lose(&mut self, rate: f64, due: Time, peer: SocketAddrV4) -> u64 {
        let lost = (0..MOST_LOSSES).take_while(|_| self.losses.f64() < rate).count() as u32;
        if lost > 0 {
            let until = due + RETRANSMISSION_NS * ((1 << lost) - 1);
            self.gaps.retain(|(other, until)| *other != peer && *until > due);
            self.gaps.push((peer, until));
        }
        lost.into()
    }

    fn draw(&mut self, plan: &FaultPlan, way: Way, carrier: Carrier) -> Lot {
        let (request, stream) = (way == Way::Request, carrier == Carrier::Stream);
        // This order is fixed: a seed shall make the same faults in every version.
        Lot {
            drop: self.happens(plan.drop),
            duplicate: self.happens(plan.duplicate),
            corrupt: self.happens(plan.corrupt),
            bit: self.random.u64(..),
            delay: self.happens(plan.delay),
            reorder: self.happens(plan.reorder),
            stall: request && self.happens(plan.stall),
            restart: request && self.happens(plan.restart),
            inhibit: request && self.happens(plan.inhibit),
            wrong_id: !request && self.happens(plan.wrong_id),
            split: stream && self.happens(plan.split),
            cut: stream && !request && self.happens(plan.cut),
        }
    }
}

/// The state of the drive when a request arrives.
enum Met {
    /// A drive that receives.
    Receiving,
    /// A drive that receives nothing for a while.
    Deaf,
    /// A drive with this fault.
    Faulty(DriveFault),
}

impl Injector {
    /// The faults of `plan` on the wire of a drive on such a carrier.
    pub fn new(plan: FaultPlan, carrier: Carrier) -> Injector {
        Injector {
            lanes: [Lane::new(plan.seed), Lane::new(!plan.seed)],
            plan,
            carrier,
            checked: false,
            stalled_until: Time::default(),
            injected: Injected::default(),
        }
    }

    /// The same for whole Ethernet frames: one with a flipped bit has a wrong check sequence, and no network card
    /// accepts it.
    pub(super) fn of_frames(plan: FaultPlan) -> Injector {
        Injector { checked: true, ..Injector::new(plan, Carrier::Datagrams) }
    }

    /// Uses the faults of `plan` from now on; the counts restart. Parcels under way on a stream are not overtaken.
    pub(super) fn change(&mut self, plan: FaultPlan) {
        let before =
            std::mem::replace(self, Injector { checked: self.checked, ..Injector::new(plan, self.carrier) });
        for (lane, before) in self.lanes.iter_mut().zip(before.lanes) {
            (lane.behind, lane.gaps) = (before.behind, before.gaps);
        }
    }

    /// Replies may have a wrong identity.
    pub(super) fn mislabels(&self) -> bool {
        self.plan.wrong_id > 0.0
    }

    /// The counts so far.
    pub fn injected(&self) -> Injected {
        self.injected
    }

    /// Sends `datagram` at `now`, to arrive at `due` without a fault: puts the resulting parcels into `queue`.
    /// Returns the fault that the drive at this wire meets meanwhile. `mislabel` gives an answer on a stream the
    /// identity of another one.
    ///
    /// On a stream only `reorder` lets parcels overtake, and a stall delays instead of losing: the sender's host
    /// repeats until it is acknowledged.
    pub fn pass(
        &mut self,
        way: Way,
        now: Time,
        mut due: Time,
        mut datagram: Datagram<'_>,
        mislabel: impl FnOnce(&mut [u8]),
        queue: &mut Queue,
    ) -> Option<DriveFault> {
        let stream = self.carrier == Carrier::Stream;
        let lot = self.lanes[way as usize].draw(&self.plan, way, self.carrier);
        let met = if way == Way::Request { self.meets(now, &lot) } else { Met::Receiving };
        let fault = match met {
            Met::Receiving => None,
            Met::Deaf if stream => {
                due = due.max(self.stalled_until);
                None
            }
            Met::Deaf => return None,
            Met::Faulty(DriveFault::Restart) => return Some(DriveFault::Restart),
            Met::Faulty(fault) => Some(fault),
        };
        if lot.drop {
            self.injected.dropped += 1;
            return fault;
        }
        if lot.wrong_id && !stream {
            datagram.from = wrong_port(datagram.from);
        }
        if way == Way::Reply {
            due = due + self.plan.answer_ns;
        }
        if lot.delay {
            self.injected.delayed += 1;
            due = due + self.plan.delay_ns;
        }
        if stream {
            let peer = if way == Way::Request { datagram.from } else { datagram.to };
            let lane = &mut self.lanes[way as usize];
            let due = lane.gap(peer).max(due);
            self.injected.segments += lane.lose(self.plan.segment_loss, due, peer);
        }
        let mut parcel = Parcel { carrier: self.carrier, ..queue.parcel(datagram) };
        if lot.wrong_id {
            self.injected.wrong_id += 1;
            if stream {
                mislabel(&mut parcel.bytes);
            }
        }
        self.enqueue(way, due, parcel, &lot, queue);
        fault
    }

    /// Sends a signal of a stream, to arrive at `due`, or after the parcels under way in its direction.
    pub(super) fn signal(&mut self, way: Way, due: Time, parcel: Parcel, queue: &mut Queue) {
        self.lanes[way as usize].send(Carrier::Stream, due, parcel, queue);
    }

    /// The master has closed its end of a connection: what was lost on it is not repeated any more.
    pub(super) fn closed(&mut self, end: SocketAddrV4) {
        self.lanes.iter_mut().for_each(|lane| lane.gaps.retain(|(peer, _)| *peer != end));
    }

    fn meets(&mut self, now: Time, lot: &Lot) -> Met {
        let injected = &mut self.injected;
        if now < self.stalled_until {
            injected.stalled += 1;
            return Met::Deaf;
        }
        if lot.restart {
            injected.restarts += 1;
            return Met::Faulty(DriveFault::Restart);
        }
        if lot.stall {
            injected.stalls += 1;
            injected.stalled += 1;
            self.stalled_until = now + self.plan.stall_ns;
            return Met::Deaf;
        }
        if lot.inhibit {
            injected.inhibits += 1;
            return Met::Faulty(DriveFault::Inhibit(now + self.plan.inhibit_ns));
        }
        Met::Receiving
    }

    /// Puts `parcel` into `queue`, with the faults drawn for it, or holds it back.
    fn enqueue(&mut self, way: Way, due: Time, mut parcel: Parcel, lot: &Lot, queue: &mut Queue) {
        let Injector { lanes, carrier, checked, injected, .. } = self;
        let lane = &mut lanes[way as usize];
        if lot.corrupt && !parcel.bytes.is_empty() {
            injected.corrupted += 1;
            if *checked {
                return queue.recycle(parcel);
            }
            let bit = lot.bit % (parcel.bytes.len() as u64 * 8);
            parcel.bytes[(bit / 8) as usize] ^= 1 << (bit % 8);
        }
        if lot.reorder && lane.held.is_none() {
            injected.reordered += 1;
            lane.held = Some(parcel);
            return;
        }
        if lot.duplicate {
            injected.duplicated += 1;
            let twin = Parcel { carrier: parcel.carrier, ..queue.parcel(parcel.datagram()) };
            lane.send(*carrier, due, twin, queue);
        }
        if lot.cut {
            injected.cut += 1;
            parcel.bytes.truncate(parcel.bytes.len() / 2);
            parcel.signal = Signal::End;
        }
        if lot.split {
            injected.split += 1;
            parcel.dribbles = true;
        }
        lane.send(*carrier, due, parcel, queue);
        if let Some(held) = lane.held.take() {
            lane.send(*carrier, due, held, queue);
        }
    }
}

/// The source of replies with a wrong identity of the drive at `address`.
pub(super) fn wrong_port(address: SocketAddrV4) -> SocketAddrV4 {
    SocketAddrV4::new(*address.ip(), address.port() ^ 1)
}

/// One datagram with its own bytes, or a part of a stream.
#[derive(Debug)]
pub struct Parcel {
    /// Its sender.
    pub from: SocketAddrV4,
    /// Its destination.
    pub to: SocketAddrV4,
    /// Its payload.
    pub bytes: Vec<u8>,
    /// Its kind of transport: a drive may have sockets of both kinds at one address.
    pub(super) carrier: Carrier,
    /// Its signal.
    pub(super) signal: Signal,
    /// It comes one byte at a time.
    dribbles: bool,
}

impl Parcel {
    /// As a view.
    pub fn datagram(&self) -> Datagram<'_> {
        Datagram { from: self.from, to: self.to, bytes: &self.bytes }
    }

    /// It is of the connection with this end.
    fn has_end(&self, peer: SocketAddrV4) -> bool {
        [self.from, self.to].contains(&peer)
    }

    /// From its first byte to the end of its last, ns.
    fn span(&self) -> u64 {
        if self.dribbles { self.bytes.len() as u64 * BYTE_NS } else { 0 }
    }
}

/// The parcels under way, in the order of arrival; of two that arrive at the same instant, the one that left first.
///
/// Bounded: what finds no room is lost and counted, as in a switch. Buffers are reused, so that a queue in steady
/// state does not allocate.
#[derive(Debug)]
pub struct Queue {
    room: usize,
    /// Parcels that arrive in the order in which they left, as most do ...
    queue: VecDeque<Ticket>,
    /// ... and those that overtake or are overtaken.
    overtaken: BinaryHeap<Reverse<Ticket>>,
    slots: Vec<Option<Parcel>>,
    free: Vec<usize>,
    spare: Vec<Vec<u8>>,
    pushed: u64,
    overflowed: u64,
}

#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Ticket {
    due: Time,
    number: u64,
    slot: usize,
}

impl Queue {
    /// Room for `room` datagrams.
    pub fn new(room: usize) -> Queue {
        Queue {
            room,
            queue: VecDeque::with_capacity(room),
            overtaken: BinaryHeap::with_capacity(room),
            slots: (0..room).map(|_| None).collect(),
            free: (0..room).rev().collect(),
            spare: Vec::with_capacity(room),
            pushed: 0,
            overflowed: 0,
        }
    }

    /// A parcel with the datagram's content, in a reused buffer if there is one.
    pub fn parcel(&mut self, datagram: Datagram<'_>) -> Parcel {
        let mut bytes = self.spare.pop().unwrap_or_else(|| Vec::with_capacity(LEAST_ROOM));
        bytes.clear();
        bytes.extend_from_slice(datagram.bytes);
        Parcel {
            from: datagram.from,
            to: datagram.to,
            bytes,
            carrier: Carrier::Datagrams,
            signal: Signal::Bytes,
            dribbles: false,
        }
    }

    /// A parcel that is a signal of a stream, without bytes.
    pub(super) fn signal(&mut self, from: SocketAddrV4, to: SocketAddrV4, signal: Signal) -> Parcel {
        Parcel { carrier: Carrier::Stream, signal, ..self.parcel(Datagram { from, to, bytes: &[] }) }
    }

    /// Returns a parcel's buffer for reuse.
    pub fn recycle(&mut self, parcel: Parcel) {
        if self.spare.len() < self.room {
            self.spare.push(parcel.bytes);
        }
    }

    /// Puts `parcel` under way, to arrive at `due`.
    pub fn push(&mut self, due: Time, parcel: Parcel) {
        let Some(slot) = self.free.pop() else {
            self.overflowed += 1;
            return self.recycle(parcel);
        };
        self.slots[slot] = Some(parcel);
        let ticket = Ticket { due, number: self.pushed, slot };
        while self.queue.back().is_some_and(|last| last.due > due) {
            self.overtaken.extend(self.queue.pop_back().map(Reverse));
        }
        self.queue.push_back(ticket);
        self.pushed += 1;
    }

    /// When the next parcel arrives.
    pub fn next_due(&self) -> Option<Time> {
        self.next().map(|ticket| ticket.due)
    }

    fn next(&self) -> Option<&Ticket> {
        match (self.queue.front(), self.overtaken.peek()) {
            (Some(ticket), Some(Reverse(other))) => Some(ticket.min(other)),
            (ticket, other) => ticket.or(other.map(|Reverse(other)| other)),
        }
    }

    /// Takes out the next parcel that has arrived by `now`, with the instant of its arrival.
    pub fn pop(&mut self, now: Time) -> Option<(Time, Parcel)> {
        let next = self.next().filter(|ticket| ticket.due <= now)?;
        let ticket = match self.queue.front() {
            Some(front) if front == next => self.queue.pop_front()?,
            _ => self.overtaken.pop()?.0,
        };
        self.free.push(ticket.slot);
        let parcel = self.slots[ticket.slot].take()?;
        let dribbles = parcel.dribbles && parcel.bytes.len() > 1;
        Some((ticket.due, if dribbles { self.first_byte(ticket.due, parcel) } else { parcel }))
    }

    /// The first byte of a parcel that arrives from `due` on one byte at a time. The others follow.
    fn first_byte(&mut self, due: Time, mut parcel: Parcel) -> Parcel {
        let first = self.parcel(Datagram { bytes: &parcel.bytes[..1], ..parcel.datagram() });
        let first = Parcel { carrier: parcel.carrier, ..first };
        parcel.bytes.remove(0);
        self.push(due + BYTE_NS, parcel);
        first
    }

    /// How many parcels found no room.
    pub fn overflowed(&self) -> u64 {
        self.overflowed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::Ipv4Addr;

    const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 41136);
    const DRIVE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), 49360);

    fn stormy() -> FaultPlan {
        FaultPlan {
            seed: 7,
            drop: 0.1,
            duplicate: 0.1,
            corrupt: 0.1,
            delay: 0.1,
            delay_ns: 900,
            reorder: 0.1,
            stall: 0.01,
            stall_ns: 5_000,
            restart: 0.01,
            inhibit: 0.01,
            inhibit_ns: 3,
            wrong_id: 0.1,
            split: 0.0,
            cut: 0.0,
            segment_loss: 0.0,
            answer_ns: 100,
        }
    }

    type Arrived = Vec<(u64, SocketAddrV4, Vec<u8>)>;

    /// Which of `count` numbered datagrams arrive, one sent each microsecond.
    fn run(plan: FaultPlan, way: Way, count: u32) -> (Arrived, Injected, u64) {
        let mut injector = Injector::new(plan, Carrier::Datagrams);
        let mut queue = Queue::new(64);
        let (mut arrived, mut restarts) = (Vec::new(), 0);
        for n in 0..u64::from(count) + 100 {
            let now = Time(n * 1_000);
            if n < u64::from(count) {
                let (from, to) = if way == Way::Request { (MASTER, DRIVE) } else { (DRIVE, MASTER) };
                let bytes = &n.to_le_bytes();
                let fault =
                    injector.pass(way, now, now, Datagram { from, to, bytes }, <[u8]>::reverse, &mut queue);
                restarts += u64::from(fault == Some(DriveFault::Restart));
            }
            while let Some((due, parcel)) = queue.pop(now) {
                arrived.push((due.0, parcel.from, parcel.bytes.clone()));
                queue.recycle(parcel);
            }
        }
        assert_eq!((queue.next_due(), queue.overflowed()), (None, 0));
        (arrived, injector.injected(), restarts)
    }

    #[test]
    fn no_fault_is_no_fault() {
        let (arrived, injected, restarts) = run(FaultPlan::default(), Way::Request, 1_000);
        assert_eq!((injected, restarts), (Injected::default(), 0));
        let numbers: Vec<_> = (0..1_000u64).map(|n| (n * 1_000, MASTER, n.to_le_bytes().to_vec())).collect();
        assert_eq!(arrived, numbers);
    }

    #[test]
    fn the_same_seed_makes_the_same_faults_and_another_seed_others() {
        let (first, counts, _) = run(stormy(), Way::Reply, 5_000);
        assert_eq!((&first, counts), (&run(stormy(), Way::Reply, 5_000).0, counts));
        assert_ne!(first, run(FaultPlan { seed: 8, ..stormy() }, Way::Reply, 5_000).0);
    }

    #[test]
    fn the_faults_of_streams_change_nothing_for_datagrams() {
        for way in [Way::Request, Way::Reply] {
            let plan = FaultPlan { split: 1.0, cut: 1.0, segment_loss: 1.0, ..stormy() };
            assert_eq!(run(plan, way, 2_000), run(stormy(), way, 2_000));
        }
    }

    #[test]
    fn the_two_directions_do_not_disturb_each_other() {
        let reply = Datagram { from: DRIVE, to: MASTER, bytes: &[1, 2, 3] };
        let drain = |queue: &mut Queue| {
            std::iter::from_fn(|| queue.pop(Time(u64::MAX))).map(|(due, p)| (due, p.from, p.bytes)).collect()
        };
        let (mut alone, mut mixed) =
            (Injector::new(stormy(), Carrier::Datagrams), Injector::new(stormy(), Carrier::Datagrams));
        let mut queue = Queue::new(8);
        for n in 0..1_000 {
            alone.pass(Way::Reply, Time(n), Time(n), reply, <[u8]>::reverse, &mut queue);
            let expected: Vec<_> = drain(&mut queue);
            for _ in 0..n % 3 {
                let request = Datagram { from: MASTER, to: DRIVE, bytes: &[4] };
                mixed.pass(Way::Request, Time(n), Time(n), request, <[u8]>::reverse, &mut queue);
                let _: Vec<_> = drain(&mut queue);
            }
            mixed.pass(Way::Reply, Time(n), Time(n), reply, <[u8]>::reverse, &mut queue);
            let got: Vec<_> = drain(&mut queue);
            assert_eq!(got, expected);
        }
    }

    #[test]
    fn the_counters_account_for_every_request() {
        let (arrived, i, restarts) = run(stormy(), Way::Request, 20_000);
        assert_eq!(restarts, i.restarts);
        let lost = i.dropped + i.stalled + i.restarts;
        // One may still be held back at the end.
        let missing = 20_000 + i.duplicated - lost - arrived.len() as u64;
        assert!(missing <= 1, "{missing}");
        for (name, count) in [
            ("drop", i.dropped),
            ("duplicate", i.duplicated),
            ("corrupt", i.corrupted),
            ("delay", i.delayed),
            ("reorder", i.reordered),
        ] {
            assert!((1_000..2_500).contains(&count), "{name}: {count}");
        }
        assert!(i.stalls > 50 && i.stalled >= 4 * i.stalls && i.restarts > 50, "{i:?}");
        assert_eq!(i.wrong_id, 0);
    }

    #[test]
    fn each_fault_does_what_its_name_says() {
        let number = |bytes: &[u8]| u64::from_le_bytes(bytes.try_into().unwrap());
        let only = |f: fn(&mut FaultPlan)| {
            let mut plan = FaultPlan { seed: 1, delay_ns: 1_500, answer_ns: 100, ..FaultPlan::default() };
            f(&mut plan);
            run(plan, Way::Reply, 1_000)
        };
        let sent = |n: usize| n as u64;

        let (arrived, i, _) = only(|plan| plan.drop = 0.5);
        assert_eq!(arrived.len() as u64, 1_000 - i.dropped);

        let (arrived, i, _) = only(|plan| plan.corrupt = 1.0);
        assert_eq!(i.corrupted, 1_000);
        assert!(arrived.iter().enumerate().all(|(n, a)| (number(&a.2) ^ sent(n)).count_ones() == 1));

        let (arrived, i, _) = only(|plan| plan.delay = 1.0);
        assert_eq!(i.delayed, 1_000);
        assert!(arrived.iter().enumerate().all(|(n, a)| a.0 == sent(n) * 1_000 + 1_600));

        let (arrived, i, _) = only(|plan| plan.duplicate = 1.0);
        assert_eq!((i.duplicated, arrived.len()), (1_000, 2_000));

        let (arrived, i, _) = only(|plan| plan.reorder = 1.0);
        assert_eq!(i.reordered, 500);
        assert!(arrived.iter().enumerate().all(|(n, a)| number(&a.2) == sent(n) ^ 1));

        let (arrived, i, _) = only(|plan| plan.wrong_id = 0.5);
        let wrong = arrived.iter().filter(|a| a.1 == wrong_port(DRIVE)).count() as u64;
        assert!(wrong == i.wrong_id && (400..600).contains(&wrong));
    }

    #[test]
    fn the_queue_is_ordered_bounded_and_uses_its_buffers_again() {
        let mut queue = Queue::new(3);
        for (due, byte) in [(30, 1), (10, 2), (30, 3), (20, 4)] {
            let parcel = queue.parcel(Datagram { from: MASTER, to: DRIVE, bytes: &[byte] });
            queue.push(Time(due), parcel);
        }
        assert_eq!((queue.overflowed(), queue.next_due()), (1, Some(Time(10))));
        assert!(queue.pop(Time(9)).is_none());
        let order: Vec<_> = std::iter::from_fn(|| queue.pop(Time(99))).map(|(_, p)| p.bytes[0]).collect();
        assert_eq!(order, [2, 1, 3]);
    }

    #[test]
    fn whatever_overtakes_whatever_arrives_in_its_order() {
        let mut random = fastrand::Rng::with_seed(3);
        let (mut queue, mut model) = (Queue::new(1_000), Vec::new());
        for n in 0..5_000_u64 {
            let due = n + if random.u8(..4) == 0 { random.u64(..50) } else { 10 };
            let bytes = n.to_le_bytes();
            let parcel = queue.parcel(Datagram { from: MASTER, to: DRIVE, bytes: &bytes });
            queue.push(Time(due), parcel);
            model.push((due, n));
            if random.u8(..8) == 0 {
                model.sort_unstable();
                let (come, left) = model.split_at(model.partition_point(|(due, _)| *due <= n));
                for (due, number) in come {
                    let (at, parcel) = queue.pop(Time(n)).unwrap();
                    assert_eq!((at, &parcel.bytes[..]), (Time(*due), &number.to_le_bytes()[..]));
                    queue.recycle(parcel);
                }
                assert_eq!(queue.next_due(), left.first().map(|(due, _)| Time(*due)));
                model = left.to_vec();
            }
        }
    }
}
