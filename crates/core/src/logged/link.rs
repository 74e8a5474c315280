//! What passes connections before the loop gets them, and in sessions: the link thread's part of a recorded wire. The
//! loop does not repeat it; a capture shows it.

use std::collections::VecDeque;
use std::mem;
use std::net::SocketAddrV4;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::named;
use crate::net::{Handshake, HandshakeState, StreamPeer};
use crate::time::Time;

/// The number of bytes that wait for their reader; later ones are lost, and counted.
const MOST_WAITING: usize = 16 << 20;

named! {
    /// The events of a connection.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
    #[repr(u8)]
    pub enum LinkEvent {
        /// It was opened.
        #[default]
        Opened = 0: "opened",
        /// Bytes were handed to it.
        Sent = 1: "sent",
        /// Bytes came.
        Received = 2: "received",
        /// It was closed.
        Closed = 3: "closed",
    }
}

/// One event of a connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkPassed {
    /// When.
    pub at: Time,
    /// The bus, by its place in the plan.
    pub bus: u8,
    /// Which of its connections.
    pub index: u16,
    /// Where it leads.
    pub peer: SocketAddrV4,
    /// The event.
    pub event: LinkEvent,
    /// The bytes of what passed.
    pub bytes: Vec<u8>,
}

/// The passed bytes that were not taken yet. Clones are the same.
#[derive(Clone, Debug, Default)]
pub struct LinkTap(Arc<Mutex<Waiting>>);

#[derive(Debug, Default)]
struct Waiting {
    passed: VecDeque<LinkPassed>,
    bytes: usize,
    lost: u64,
}

impl LinkTap {
    /// All that waits, and how many events were lost so far.
    pub fn take(&self) -> (VecDeque<LinkPassed>, u64) {
        let mut waiting = self.waiting();
        waiting.bytes = 0;
        (mem::take(&mut waiting.passed), waiting.lost)
    }

    /// Peers whose connections pass it, of this bus.
    pub(super) fn around(&self, bus: u8, peers: Vec<StreamPeer>) -> Vec<StreamPeer> {
        let around = |(index, peer): (usize, StreamPeer)| {
            let (tap, index, address) = (self.clone(), index as u16, peer.address);
            let inner = peer.handshake;
            let tapped = Tapped { inner, tap, bus, index, peer: address, is_open: false };
            StreamPeer { handshake: Box::new(tapped), ..peer }
        };
        peers.into_iter().enumerate().map(around).collect()
    }

    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        // A poisoned lock only means that somebody panicked between two whole steps.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn put(&self, passed: LinkPassed) {
        let mut waiting = self.waiting();
        if waiting.bytes + passed.bytes.len() > MOST_WAITING {
            waiting.lost += 1;
            return;
        }
        waiting.bytes += passed.bytes.len() + mem::size_of::<LinkPassed>();
        waiting.passed.push_back(passed);
    }
}

/// A handshake or session, and what passes its connection.
#[derive(Debug)]
struct Tapped {
    inner: Box<dyn Handshake>,
    tap: LinkTap,
    bus: u8,
    index: u16,
    peer: SocketAddrV4,
    is_open: bool,
}

impl Tapped {
    fn passed(&self, at: Time, event: LinkEvent, bytes: &[u8]) {
        let &Tapped { bus, index, peer, .. } = self;
        self.tap.put(LinkPassed { at, bus, index, peer, event, bytes: bytes.to_vec() });
    }

    /// Runs a step of it, and notes what is to be sent then.
    fn step(
        &mut self,
        now: Time,
        out: &mut Vec<u8>,
        step: impl FnOnce(&mut dyn Handshake, &mut Vec<u8>) -> HandshakeState,
    ) -> HandshakeState {
        let before = out.len();
        let state = step(&mut *self.inner, out);
        // What a step leaves that failed is not sent.
        let is_sent = self.is_open && !matches!(state, HandshakeState::Failed(_));
        if let (true, Some(sent @ [_, ..])) = (is_sent, out.get(before..)) {
            self.passed(now, LinkEvent::Sent, sent);
        }
        state
    }
}

impl Handshake for Tapped {
    fn begin(&mut self, now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.is_open = true;
        self.passed(now, LinkEvent::Opened, &[]);
        self.step(now, out, |inner, out| inner.begin(now, out))
    }

    fn take(&mut self, now: Time, bytes: &[u8], out: &mut Vec<u8>) -> HandshakeState {
        self.passed(now, LinkEvent::Received, bytes);
        self.step(now, out, |inner, out| inner.take(now, bytes, out))
    }

    fn next_due(&self) -> Option<Time> {
        self.inner.next_due()
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.step(now, out, |inner, out| inner.run(now, out))
    }

    fn closed(&mut self, now: Time, why: &str) {
        self.is_open = false;
        self.passed(now, LinkEvent::Closed, &[]);
        self.inner.closed(now, why);
    }

    fn overdue(&self) -> Option<String> {
        self.inner.overdue()
    }

    fn has_ended(&self) -> bool {
        self.inner.has_ended()
    }
}
