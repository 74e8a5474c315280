//! Connections as the loop and a protocol see them.
//!
//! The loop owns the connections that are ready and does bounded work on them. Blocking work (opening, handshake
//! and closing) is done outside the loop by [`link`](super::link). Each connection has one owner at any time, and
//! changes owners by wait-free queues. A session is a connection that stays outside the loop: what it exchanges with
//! the loop goes through wait-free queues of its own.

use std::fmt::Debug;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::Waker;

use crate::rt::Regions;
use crate::time::{MS, S, Time};

/// A carrier of connections to fixed peers on the real-time thread: never waits, never allocates.
pub trait Streams: Send {
    /// The descriptor that is readable while something waits to be received on any of them, and while a broken one
    /// has not been given up. Queried before each wait: a single connection has its own descriptor. `None`: there
    /// is nothing to wait for at present.
    fn fd(&self) -> Option<RawFd>;

    /// Takes over a connection that became ready since the last call, if there is one: nothing of an earlier
    /// connection to that peer is left.
    fn opened(&mut self) -> Option<usize>;

    /// Looks for connections with something to receive, a bounded number; then [`ready`](Self::ready) returns them.
    fn look(&mut self);

    /// The next connection that the last look found.
    fn ready(&mut self) -> Option<usize>;

    /// Takes in what arrived on connection `index`, at most all of `room`, with the time. `None`: nothing.
    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken>;

    /// Hands the front of `bytes` to connection `index`; returns the time and how many the wire took, 0 if it takes
    /// none now.
    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken>;

    /// Gives connection `index` up for this reason. It is closed, and opened anew after a pause.
    fn abandon(&mut self, index: usize, why: &'static str);

    /// True if the opener of connections has ended unexpectedly: the open ones are the last.
    fn has_ended(&self) -> bool {
        false
    }

    /// Notes on the opening of connections, for normal threads.
    fn notes(&self) -> LinkNotes;

    /// Makes the sessions run, from any thread and after their queues were written to. Several wake-ups before they run
    /// are one. It writes an eventfd: on the loop's thread for what is rare only, since a session that looks at its
    /// queues by its own clock needs none. `None`: a carrier without sessions.
    fn waker(&self) -> Option<Waker> {
        None
    }

    /// Adds the memory that it touches, to be locked with `memory = "own"`.
    fn memory(&self, regions: &mut Regions);
}

/// A connection that can no longer be used. It has to be given up by [`Streams::abandon`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Broken {
    /// There is no connection: it is not open yet, or was given up.
    Absent,
    /// The peer has closed it.
    Closed,
    /// The operating system's error number.
    Failed(i32),
}

/// One peer to be connected to, and kept connected.
#[derive(Debug)]
pub struct StreamPeer {
    /// The address that it listens at.
    pub address: SocketAddrV4,
    /// The address of this host that the connection leaves from; `None`: whichever leads there.
    pub bind: Option<Ipv4Addr>,
    /// The longest opening of a connection, ns.
    pub connect_ns: u64,
    /// The longest handshake, ns.
    pub handshake_ns: u64,
    /// The pause after a first failure, ns; it doubles with each one in a row ... Each is shortened by up to an
    /// eighth, differently for each peer, so that many peers that failed together are not tried together.
    pub least_pause_ns: u64,
    /// ... up to this. A connection that was in use for so long begins with the least pause again.
    pub most_pause_ns: u64,
    /// Sent bytes that the peer's host does not acknowledge for so long break the connection, ns.
    pub unacknowledged_ns: u64,
    /// The handshake on a new connection before the loop gets it, or its session.
    pub handshake: Box<dyn Handshake>,
}

impl StreamPeer {
    /// A peer with usual times.
    pub fn new(address: SocketAddrV4, handshake: Box<dyn Handshake>) -> StreamPeer {
        StreamPeer {
            address,
            bind: None,
            connect_ns: S,
            handshake_ns: 2 * S,
            least_pause_ns: 100 * MS,
            most_pause_ns: 2 * S,
            unacknowledged_ns: S,
            handshake,
        }
    }
}

/// A protocol's handshake on a new connection before the loop gets it, or its session on one that stays: a machine of
/// state and time on a normal thread, without sockets or waits. It shares its findings with its station; handing the
/// connection over orders both.
pub trait Handshake: Debug + Send {
    /// A connection was opened at `now`: nothing of an earlier one is left. Appends the bytes to send to `out`.
    fn begin(&mut self, now: Time, out: &mut Vec<u8>) -> HandshakeState;

    /// Takes in what arrived, split anywhere, and appends the bytes to send to `out`.
    fn take(&mut self, now: Time, bytes: &[u8], out: &mut Vec<u8>) -> HandshakeState;

    /// When it wants to run by itself: a timeout, a request that is due. It runs once a millisecond at most.
    fn next_due(&self) -> Option<Time> {
        None
    }

    /// It is due, or was [woken](Streams::waker). Without a connection nothing that it appends to `out` is sent, and
    /// what it returns has no effect.
    fn run(&mut self, _now: Time, _out: &mut Vec<u8>) -> HandshakeState {
        HandshakeState::More
    }

    /// The connection has ended before the loop got it, for this reason: once for each that began. When the carrier is
    /// dropped, this is dropped instead.
    fn closed(&mut self, _now: Time, _why: &str) {}

    /// Why it has not ended in its time, if it was answered.
    fn overdue(&self) -> Option<String> {
        None
    }

    /// It has ended in order, and needs no connection any more: that there is none gets no note.
    fn has_ended(&self) -> bool {
        false
    }
}

/// The state of a handshake.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum HandshakeState {
    /// It waits for an answer; a session goes on.
    More,
    /// It is complete: nothing is owed on the connection.
    Done,
    /// It is complete, and the connection stays here: a session.
    Kept,
    /// The connection cannot be used, for this reason; it is reset, and unsent bytes never arrive.
    Failed(String),
}

/// The last note on each connection of a carrier: why it is not open, in words. Clones are the same notes.
#[derive(Clone, Debug, Default)]
pub struct LinkNotes(Arc<Mutex<Vec<Option<String>>>>);

impl LinkNotes {
    /// For so many connections.
    pub fn new(count: usize) -> LinkNotes {
        LinkNotes(Arc::new(Mutex::new(vec![None; count])))
    }

    /// Why connection `index` is not open; `None`: it is, or its first opening is under way.
    pub fn get(&self, index: usize) -> Option<String> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get(index).cloned().flatten()
    }

    /// For the thread that opens connections.
    pub fn set(&self, index: usize, note: Option<String>) {
        let mut notes = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(place) = notes.get_mut(index) {
            *place = note;
        }
    }
}
