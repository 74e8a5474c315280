//! Preallocated requests, one per peer, patched in place and posted when they are due. A peer may change from one
//! posting to the next.

use std::net::SocketAddrV4;

use crate::rt::Regions;
use crate::time::Time;

/// The result of the last posting of a message.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Sent {
    /// Not posted in this cycle.
    #[default]
    Idle,
    /// Posted, not yet handed over.
    Posted,
    /// The wire took it at this instant (the begin of its batch, or its own call: see the carrier).
    At(Time),
    /// The wire refused it: the operating system's error number.
    Failed(i32),
}

/// One message per index, each with its own room and its peer.
#[derive(Debug)]
pub struct Outbox {
    room: usize,
    bytes: Box<[u8]>,
    messages: Box<[Message]>,
}

#[derive(Debug)]
struct Message {
    peer: SocketAddrV4,
    length: usize,
    sent: Sent,
}

impl Outbox {
    /// One message of at most `room` bytes for each of `peers`.
    pub fn new(peers: &[SocketAddrV4], room: usize) -> Outbox {
        Outbox {
            room,
            bytes: vec![0; peers.len() * room].into(),
            messages: peers.iter().map(|peer| Message { peer: *peer, length: 0, sent: Sent::Idle }).collect(),
        }
    }

    /// Adds its memory, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.bytes);
        regions.add(&*self.messages);
    }

    /// How many messages there are room for.
    #[inline]
    pub fn len(&self) -> usize {
        self.messages.len()
    }

    /// Whether there is no peer at all.
    pub fn is_empty(&self) -> bool {
        self.messages.is_empty()
    }

    /// The whole room of message `index`, to build the message in.
    #[inline]
    pub fn room(&mut self, index: usize) -> &mut [u8] {
        &mut self.bytes[index * self.room..(index + 1) * self.room]
    }

    /// The built bytes of message `index`.
    #[inline]
    pub fn bytes(&self, index: usize) -> &[u8] {
        &self.bytes[index * self.room..][..self.messages[index].length]
    }

    /// Sets the length of the message built in [`room`](Self::room).
    #[inline]
    pub fn set_length(&mut self, index: usize, length: usize) {
        self.messages[index].length = length.min(self.room);
    }

    /// The peer of message `index`.
    pub fn peer(&self, index: usize) -> SocketAddrV4 {
        self.messages[index].peer
    }

    /// From the next `send` on, message `index` goes to `peer`.
    pub fn set_peer(&mut self, index: usize, peer: SocketAddrV4) {
        self.messages[index].peer = peer;
    }

    /// Posts message `index` for the next `send`, or removes it.
    #[inline]
    pub fn post(&mut self, index: usize, due: bool) {
        self.messages[index].sent = if due { Sent::Posted } else { Sent::Idle };
    }

    /// The result of message `index`.
    #[inline]
    pub fn sent(&self, index: usize) -> Sent {
        self.messages[index].sent
    }

    /// The same, once.
    #[inline]
    pub fn take_sent(&mut self, index: usize) -> Sent {
        std::mem::take(&mut self.messages[index].sent)
    }

    /// For the carrier: notes the result of message `index`.
    pub fn note(&mut self, index: usize, sent: Sent) {
        self.messages[index].sent = sent;
    }
}
