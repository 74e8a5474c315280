//! What is under way on one wire, in the order of its arrival.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::net::SocketAddrV4;

use crate::Carrier;
use fieldbeat_core::time::Time;

/// Time between two bytes that come one at a time, ns: about a byte's time on 10 Mbit/s Ethernet.
const BYTE_NS: u64 = 1_000;

/// The initial capacity of every buffer, bytes: any usual telegram, so that none grows in use.
const LEAST_ROOM: usize = 512;

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
pub enum Signal {
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
    pub carrier: Carrier,
    /// Its signal.
    pub signal: Signal,
    /// It comes one byte at a time.
    pub(super) dribbles: bool,
}

impl Parcel {
    /// As a view.
    pub fn datagram(&self) -> Datagram<'_> {
        Datagram { from: self.from, to: self.to, bytes: &self.bytes }
    }

    /// It is of the connection with this end.
    pub(super) fn has_end(&self, peer: SocketAddrV4) -> bool {
        [self.from, self.to].contains(&peer)
    }

    /// From its first byte to the end of its last, ns.
    pub(super) fn span(&self) -> u64 {
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
    pub fn signal(&mut self, from: SocketAddrV4, to: SocketAddrV4, signal: Signal) -> Parcel {
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
