//! One connection's life: pause, connect, handshake, hand over, take back; or, for a session, stay. A machine of state
//! and time, without a socket or a clock, so that the link thread and a virtual world run the same one. A serial port
//! is such a connection, too: one that is open at once, without a handshake.
//!
//! The caller has the socket. Every event returns the [`Action`] that follows from it; with
//! [`poll`](Connection::poll) at [`next_due`](Connection::next_due) no wait is longer than the [`StreamPeer`] allows.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::words::{During, broken, no_answer, no_handshake};
use crate::net::stream::{Broken, Handshake, HandshakeState, LinkNotes, StreamPeer};
use crate::time::{MS, Time};

/// The shortest pause, ns: a setting of 0 shall not turn into a storm of connections.
const SHORTEST_PAUSE_NS: u64 = MS;

/// The shortest time between two runs of a session by its own clock, ns: a mistake of ours shall not keep the thread
/// busy.
const SHORTEST_RUN_NS: u64 = MS;

/// The fraction of a pause that is spread over the peers.
const SPREAD: u64 = 8;

/// The address of a serial port, which has none.
const NOWHERE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);

/// The next action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Nothing, until something happens or the next instant is due.
    Wait,
    /// Open a socket and begin to connect. Then [`connected`](Connection::connected), [`failed`](Connection::failed) or
    /// [`refused`](Connection::refused).
    Connect,
    /// Send as much of [`to_send`](Connection::to_send) as the wire takes, and report it with
    /// [`sent`](Connection::sent).
    Send,
    /// The connection is the loop's, until it is [`given_back`](Connection::given_back).
    HandOver,
    /// Close the socket. Unsent bytes shall never arrive: they are outdated.
    Close,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    Pausing {
        until: Time,
    },
    Connecting {
        until: Time,
    },
    /// `done`: only bytes to be sent are left of it.
    Handshake {
        until: Time,
        done: bool,
    },
    HandedOver {
        since: Time,
    },
    /// It is a session's.
    Kept {
        since: Time,
    },
}

/// One connection, open or not.
#[derive(Debug)]
pub struct Connection {
    peer: StreamPeer,
    /// The name of the request that was given up.
    name: String,
    notes: LinkNotes,
    /// The index in the notes.
    index: usize,
    phase: Phase,
    /// The pause after the next failure.
    pause_ns: u64,
    /// The bytes of the handshake or session, and how many of them are sent.
    out: Vec<u8>,
    sent: usize,
    /// The session does not run by its own clock before this.
    rests_until: Time,
}

/// No handshake.
#[derive(Debug)]
struct Nothing;

impl Handshake for Nothing {
    fn begin(&mut self, _now: Time, _out: &mut Vec<u8>) -> HandshakeState {
        HandshakeState::Done
    }

    fn take(&mut self, _now: Time, _bytes: &[u8], _out: &mut Vec<u8>) -> HandshakeState {
        HandshakeState::Done
    }
}

impl Connection {
    /// A connection that begins to open about `now`: peers created together start within an eighth of their least
    /// pause. The reason why it is not open goes to `notes` at `index`.
    pub fn new(now: Time, peer: StreamPeer, notes: LinkNotes, index: usize) -> Connection {
        let mut connection = Connection {
            name: format!("connection to {}", peer.address),
            phase: Phase::Pausing { until: now },
            pause_ns: 0,
            out: Vec::new(),
            sent: 0,
            rests_until: now,
            peer,
            notes,
            index,
        };
        connection.pause_ns = connection.least_pause();
        // As if a pause were ending: the order of the peers stays the same through all pauses.
        let left = connection.pause_ns / SPREAD - connection.spread(connection.pause_ns);
        connection.phase = Phase::Pausing { until: now + left };
        connection
    }

    /// Serial port `path`, to be opened now; the reason why it is not open goes to `notes` at index 0.
    pub fn of_port(now: Time, path: &str, notes: LinkNotes) -> Connection {
        let peer = StreamPeer::new(NOWHERE, Box::new(Nothing));
        let name = format!("serial port {path}");
        Connection { name, phase: Phase::Pausing { until: now }, ..Connection::new(now, peer, notes, 0) }
    }

    /// Where it leads.
    pub fn peer(&self) -> &StreamPeer {
        &self.peer
    }

    /// Whether it is being opened.
    pub fn is_connecting(&self) -> bool {
        matches!(self.phase, Phase::Connecting { .. })
    }

    /// The latest time for [`poll`](Self::poll); `None` while the loop has it, or a session that waits for nothing.
    pub fn next_due(&self) -> Option<Time> {
        [self.phase_due(), self.session_due()].into_iter().flatten().min()
    }

    fn phase_due(&self) -> Option<Time> {
        match self.phase {
            Phase::Pausing { until } | Phase::Connecting { until } | Phase::Handshake { until, .. } => {
                Some(until)
            }
            Phase::HandedOver { .. } | Phase::Kept { .. } => None,
        }
    }

    fn session_due(&self) -> Option<Time> {
        self.peer.handshake.next_due().map(|due| due.max(self.rests_until))
    }

    /// Time passes: a pause ends, what takes too long is given up, or a session runs. What else is due is done by the
    /// next call.
    pub fn poll(&mut self, now: Time) -> Action {
        let address = self.peer.address;
        match self.phase {
            Phase::Pausing { until } if until <= now => {
                self.phase = Phase::Connecting { until: now + self.peer.connect_ns };
                Action::Connect
            }
            Phase::Connecting { until } if until <= now => {
                self.refused(now, no_answer(address, self.peer.connect_ns))
            }
            Phase::Handshake { until, .. } if until <= now => {
                let why = self.peer.handshake.overdue().map(|why| format!("{address}: {why}"));
                self.refused(now, why.unwrap_or_else(|| no_handshake(address, self.peer.handshake_ns)))
            }
            _ if self.session_due().is_some_and(|due| due <= now) => self.run(now),
            _ => Action::Wait,
        }
    }

    /// The session runs, if it has one: it is due, or somebody has posted something.
    pub fn run(&mut self, now: Time) -> Action {
        self.rests_until = now + SHORTEST_RUN_NS;
        let state = self.peer.handshake.run(now, &mut self.out);
        if let Phase::Handshake { .. } | Phase::Kept { .. } = self.phase {
            return self.handshake(now, state);
        }
        self.out.clear();
        Action::Wait
    }

    /// It is open: the handshake begins.
    pub fn connected(&mut self, now: Time) -> Action {
        let Phase::Connecting { .. } = self.phase else { return Action::Wait };
        self.out.clear();
        self.sent = 0;
        self.phase = Phase::Handshake { until: now + self.peer.handshake_ns, done: false };
        let state = self.peer.handshake.begin(now, &mut self.out);
        self.handshake(now, state)
    }

    /// It could not be opened, or broke during the handshake or session.
    pub fn failed(&mut self, now: Time, why: Broken) -> Action {
        let when = match self.phase {
            Phase::Connecting { .. } => During::Opening,
            Phase::Handshake { .. } => During::Handshake,
            Phase::Kept { .. } => During::Session,
            Phase::Pausing { .. } | Phase::HandedOver { .. } => return Action::Wait,
        };
        self.refused(now, broken(&self.peer, why, when))
    }

    /// Bytes arrived, split anywhere.
    pub fn received(&mut self, now: Time, bytes: &[u8]) -> Action {
        match self.phase {
            Phase::Handshake { done: true, .. } if !bytes.is_empty() => {
                self.refused(now, format!("{} sends something that nobody requested", self.peer.address))
            }
            Phase::Handshake { done: false, .. } | Phase::Kept { .. } => {
                let state = self.peer.handshake.take(now, bytes, &mut self.out);
                self.handshake(now, state)
            }
            _ => Action::Wait,
        }
    }

    /// The bytes to send now.
    pub fn to_send(&self) -> &[u8] {
        self.out.get(self.sent..).unwrap_or_default()
    }

    /// The wire took so many bytes of [`to_send`](Self::to_send).
    pub fn sent(&mut self, now: Time, count: usize) -> Action {
        self.sent = self.out.len().min(self.sent.saturating_add(count));
        self.go_on(now)
    }

    /// The loop gave it up, for this reason.
    pub fn given_back(&mut self, now: Time, why: &str) -> Action {
        let Phase::HandedOver { .. } = self.phase else { return Action::Wait };
        self.refused(now, format!("{} given up: {why}", self.name))
    }

    fn handshake(&mut self, now: Time, state: HandshakeState) -> Action {
        match (state, &mut self.phase) {
            (HandshakeState::Failed(why), _) => {
                return self.refused(now, format!("{}: {why}", self.peer.address));
            }
            (HandshakeState::Done, Phase::Handshake { done, .. }) => *done = true,
            (HandshakeState::Kept, Phase::Handshake { .. }) => {
                self.phase = Phase::Kept { since: now };
                self.notes.set(self.index, None);
            }
            _ => {}
        }
        self.go_on(now)
    }

    fn go_on(&mut self, now: Time) -> Action {
        let all_sent = self.to_send().is_empty();
        match self.phase {
            Phase::Handshake { .. } | Phase::Kept { .. } if !all_sent => Action::Send,
            Phase::Handshake { done: true, .. } => {
                self.phase = Phase::HandedOver { since: now };
                self.notes.set(self.index, None);
                Action::HandOver
            }
            Phase::Kept { .. } => {
                self.out.clear();
                self.sent = 0;
                Action::Wait
            }
            _ => Action::Wait,
        }
    }

    /// It ends, or could not be opened, for this reason. Pauses, the next time twice as long; a pause is shortened by
    /// the peer's share of the spread. Whoever was in use for long begins with the least pause again.
    pub fn refused(&mut self, now: Time, why: String) -> Action {
        match self.phase {
            Phase::HandedOver { since } | Phase::Kept { since }
                if now.since(since) >= self.peer.most_pause_ns =>
            {
                self.pause_ns = self.least_pause();
            }
            _ => {}
        }
        if let Phase::Handshake { .. } | Phase::Kept { .. } = self.phase {
            self.peer.handshake.closed(now, &why);
        }
        self.notes.set(self.index, (!self.peer.handshake.has_ended()).then_some(why));
        self.phase = Phase::Pausing { until: now + (self.pause_ns - self.spread(self.pause_ns)) };
        self.pause_ns = self.pause_ns.saturating_mul(2).min(self.peer.most_pause_ns).max(self.least_pause());
        Action::Close
    }

    fn least_pause(&self) -> u64 {
        self.peer.least_pause_ns.max(SHORTEST_PAUSE_NS)
    }

    /// The share of this peer in the spread of a pause. Multiples of the golden ratio divide an interval evenly, and
    /// addresses of one machine mostly follow each other.
    fn spread(&self, pause_ns: u64) -> u64 {
        let address = self.peer.address;
        let key = address.ip().to_bits().wrapping_add(u32::from(address.port()));
        let part = u64::from(key.wrapping_mul(0x9E37_79B9));
        let most = pause_ns / SPREAD;
        ((u128::from(most) * u128::from(part)) >> 32) as u64
    }
}

#[cfg(test)]
mod tests;
