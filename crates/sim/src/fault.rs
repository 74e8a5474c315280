//! Seeded faults between a master and one simulated drive; `queue`: what is under way.
//!
//! The n-th parcel of a direction (a datagram, or the bytes handed to a stream at once) always meets the same
//! fault: decisions depend on the seed and the count alone. This file knows no socket, no protocol and no clock:
//! instants come as arguments.

mod queue;

use std::net::SocketAddrV4;

pub(super) use self::queue::Signal;
pub use self::queue::{Datagram, Parcel, Queue};

use super::{Carrier, FaultPlan};
use fieldbeat_core::time::{MS, Time};

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
    pub sto_opened: u64,
    /// Replies from a wrong port, or, on a stream, to something else.
    pub wrong_id: u64,
    /// Parcels that came one byte at a time.
    pub split: u64,
    /// Connections that ended in the middle of a reply.
    pub cut: u64,
    /// Segments lost, repetitions included.
    pub segments: u64,
    /// Telegrams on a serial wire that lost a byte.
    pub shortened: u64,
}

/// A fault of the drive itself, injected when a datagram passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DriveFault {
    /// It is switched off and on again; the request is lost.
    Restart,
    /// Its hardware enable is open until then.
    OpenSto(Time),
}

impl DriveFault {
    /// The index of the drive that it hits, of `count` at one wire whose faults so far are `injected`: each time the
    /// next one.
    pub(super) fn place(self, injected: Injected, count: usize) -> usize {
        let number = match self {
            DriveFault::Restart => injected.restarts,
            DriveFault::OpenSto(_) => injected.sto_opened,
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
    /// Telegrams are bytes in a row, of which one may be lost.
    serial: bool,
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
    sto: bool,
    wrong_id: bool,
    split: bool,
    cut: bool,
    shorten: bool,
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

    fn draw(&mut self, plan: &FaultPlan, way: Way, carrier: Carrier, serial: bool) -> Lot {
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
            sto: request && self.happens(plan.sto),
            wrong_id: !request && self.happens(plan.wrong_id),
            split: stream && self.happens(plan.split),
            cut: stream && !request && self.happens(plan.cut),
            shorten: serial && self.happens(plan.lost_byte),
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
            serial: false,
            stalled_until: Time::default(),
            injected: Injected::default(),
        }
    }

    /// The same for whole Ethernet frames: one with a flipped bit has a wrong check sequence, and no network card
    /// accepts it.
    pub(super) fn of_frames(plan: FaultPlan) -> Injector {
        Injector { checked: true, ..Injector::new(plan, Carrier::Datagrams) }
    }

    /// The same for telegrams on a serial wire.
    pub(super) fn of_bytes(plan: FaultPlan) -> Injector {
        Injector { serial: true, ..Injector::new(plan, Carrier::Datagrams) }
    }

    /// Uses the faults of `plan` from now on; the counts restart. Parcels under way on a stream are not overtaken.
    pub(super) fn change(&mut self, plan: FaultPlan) {
        let Injector { checked, serial, carrier, .. } = *self;
        let before = std::mem::replace(self, Injector { checked, serial, ..Injector::new(plan, carrier) });
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
        let lot = self.lanes[way as usize].draw(&self.plan, way, self.carrier, self.serial);
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
        if lot.sto {
            injected.sto_opened += 1;
            return Met::Faulty(DriveFault::OpenSto(now + self.plan.sto_ns));
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
        if lot.shorten && parcel.bytes.len() > 1 {
            injected.shortened += 1;
            let place = lot.bit as usize % parcel.bytes.len();
            parcel.bytes.remove(place);
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

#[cfg(test)]
mod tests;
