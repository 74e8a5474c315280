//! Sessions: a protocol's dialogue with one peer that stays on the link thread.
//!
//! The loop never has the connection. A session keeps its state over all connections to its peer, which the thread
//! opens, watches and re-opens. What it exchanges with the loop goes through wait-free queues of its own; what an
//! application posts wakes the thread by a [`Waker`].

use std::any::Any;
use std::fmt::Debug;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Waker;

use super::stream::LinkNotes;
use crate::rt::Regions;
use crate::time::{MS, S, Time};

/// A dialogue with one peer: a machine of state and time, without a socket, a clock or a wait. On a normal thread.
pub trait Session: Debug + Send {
    /// Whether a connection is wanted. Queried while there is none, after each pause and after each `run`.
    fn wants(&self) -> bool {
        true
    }

    /// A connection was opened at `now`: nothing of an earlier one is left. Appends the bytes to send to `out`.
    fn opened(&mut self, now: Time, out: &mut Vec<u8>) -> Next;

    /// Takes in what arrived, split anywhere, and appends the bytes to send to `out`.
    fn received(&mut self, now: Time, bytes: &[u8], out: &mut Vec<u8>) -> Next;

    /// When it wants to run by itself: a timeout, a request that is due. It runs once a millisecond at most.
    fn next_due(&self) -> Option<Time>;

    /// It is due, or somebody has woken it. Without a connection nothing that it appends to `out` is sent, and what it
    /// returns has no effect.
    fn run(&mut self, now: Time, out: &mut Vec<u8>) -> Next;

    /// The connection has ended, for this reason: once for each that was opened. When the carrier is dropped, the
    /// session is dropped instead.
    fn closed(&mut self, now: Time, why: &str);
}

/// What becomes of the connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Next {
    /// The connection stays open.
    On,
    /// It ends in order after everything that was to be sent.
    Over,
    /// It cannot be used any more, for this reason, and is reset; unsent bytes never arrive.
    Failed(String),
}

/// One peer with its session.
#[derive(Debug)]
pub struct SessionPeer {
    /// The address that it listens at.
    pub address: SocketAddrV4,
    /// The address of this host that connections leave from; `None`: whichever leads there.
    pub bind: Option<Ipv4Addr>,
    /// The longest opening of a connection, and its longest orderly end, ns.
    pub connect_ns: u64,
    /// The pause after a first failure, ns, as in [`StreamPeer`](super::StreamPeer) ...
    pub least_pause_ns: u64,
    /// ... and the longest one. A connection that was open for so long begins with the least pause again.
    pub most_pause_ns: u64,
    /// Sent bytes that the peer's host does not acknowledge for so long break the connection, ns.
    pub unacknowledged_ns: u64,
    /// The dialogue.
    pub session: Box<dyn Session>,
}

impl SessionPeer {
    /// A peer with usual times.
    pub fn new(address: SocketAddrV4, session: Box<dyn Session>) -> SessionPeer {
        SessionPeer {
            address,
            bind: None,
            connect_ns: S,
            least_pause_ns: 100 * MS,
            most_pause_ns: 2 * S,
            unacknowledged_ns: S,
            session,
        }
    }
}

/// The loop's side of the sessions of one bus. When dropped, they end: their open connections are closed.
#[derive(Debug)]
pub struct Sessions {
    wakers: Vec<Waker>,
    notes: LinkNotes,
    ended: Arc<AtomicBool>,
    /// What the wakers touch.
    regions: Regions,
    _hold: Hold,
}

/// What keeps the sessions alive.
struct Hold(#[expect(dead_code, reason = "it is dropped")] Box<dyn Any + Send>);

impl Debug for Hold {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Hold")
    }
}

impl Sessions {
    pub(crate) fn new(
        wakers: Vec<Waker>,
        notes: LinkNotes,
        ended: Arc<AtomicBool>,
        regions: Regions,
        hold: Box<dyn Any + Send>,
    ) -> Sessions {
        Sessions { wakers, notes, ended, regions, _hold: Hold(hold) }
    }

    /// Wakes the session of peer `index`, from any thread and after its own queue was written to. Several wake-ups
    /// before it runs are one. The first writes an eventfd: on the loop's thread for what is rare only, since a
    /// session that looks at its queues by its own clock needs none.
    pub fn waker(&self, index: usize) -> Option<&Waker> {
        self.wakers.get(index)
    }

    /// The thread that runs the sessions has ended unexpectedly.
    pub fn has_ended(&self) -> bool {
        self.ended.load(Ordering::Relaxed)
    }

    /// Why a peer has no connection, for normal threads.
    pub fn notes(&self) -> LinkNotes {
        self.notes.clone()
    }

    /// Adds the memory that it touches, to be locked with `memory = "own"`.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        regions.add(&*self.wakers);
        regions.add(&*self.ended);
        regions.extend(&self.regions);
    }
}
