//! One connection's life: pause, connect, handshake, hand over, take back; or, for a session, stay. A machine of state
//! and time, without a socket or a clock, so that the link thread and a virtual world run the same one.
//!
//! Its caller has the socket. Every event returns the [`Action`] that follows from it; with
//! [`poll`](Connection::poll) at [`next_due`](Connection::next_due) no wait is longer than the peer's [`Target`]
//! allows.

use super::peer::{Handler, Peer, Target};
use super::words::{During, broken, no_answer, no_end, no_greeting};
use crate::net::session::Next;
use crate::net::stream::{Broken, Greeted, LinkNotes};
use crate::time::{MS, Time};

/// The shortest pause, ns: a setting of 0 shall not turn into a storm of connections.
const SHORTEST_PAUSE_NS: u64 = MS;

/// The shortest time between two runs of a session by its own clock, ns: a mistake of ours shall not keep the thread
/// busy.
const SHORTEST_RUN_NS: u64 = MS;

/// The most bytes of a session that wait for the wire; then its peer reads nothing any more.
const MOST_UNSENT: usize = 65_536;

/// The fraction of a pause that is spread over the peers.
const SPREAD: u64 = 8;

/// The next action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Nothing, until something happens or the next instant is due.
    Wait,
    /// Open a socket and begin to connect. Then [`connected`](Connection::connected) or [`failed`](Connection::failed).
    Connect,
    /// Send as much of [`to_send`](Connection::to_send) as the wire takes, and report it with
    /// [`sent`](Connection::sent).
    Send,
    /// The connection is the loop's, until it is [`given_back`](Connection::given_back).
    HandOver,
    /// Close the socket. Unsent bytes shall never arrive: they are outdated.
    Close,
    /// Close the socket in order: everything that was sent shall arrive.
    End,
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
    Greeting {
        until: Time,
        done: bool,
    },
    HandedOver {
        since: Time,
    },
    /// The session wants no connection.
    Idle,
    /// The session has it.
    InSession {
        since: Time,
    },
    /// Only bytes to be sent are left of it.
    Ending {
        until: Time,
    },
}

/// One connection, open or not.
#[derive(Debug)]
pub struct Connection {
    target: Target,
    handler: Handler,
    notes: LinkNotes,
    /// Its index in the notes.
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

impl Connection {
    /// A connection that begins to open about `now`: peers created together start within an eighth of their least
    /// pause. The reason why it is not open goes to `notes` at `index`.
    pub fn new(now: Time, peer: impl Into<Peer>, notes: LinkNotes, index: usize) -> Connection {
        let Peer { target, handler } = peer.into();
        let mut connection = Connection {
            phase: Phase::Pausing { until: now },
            pause_ns: 0,
            out: Vec::new(),
            sent: 0,
            rests_until: now,
            target,
            handler,
            notes,
            index,
        };
        connection.pause_ns = connection.least_pause();
        // As if a pause were ending: the order of the peers stays the same through all pauses.
        let left = connection.pause_ns / SPREAD - connection.spread(connection.pause_ns);
        connection.phase = Phase::Pausing { until: now + left };
        connection
    }

    /// Where it leads.
    pub fn target(&self) -> &Target {
        &self.target
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
            Phase::Pausing { until }
            | Phase::Connecting { until }
            | Phase::Greeting { until, .. }
            | Phase::Ending { until } => Some(until),
            Phase::HandedOver { .. } | Phase::Idle | Phase::InSession { .. } => None,
        }
    }

    fn session_due(&self) -> Option<Time> {
        match (&self.handler, self.phase) {
            (Handler::Handshake(_), _) | (_, Phase::Ending { .. }) => None,
            (Handler::Session(session), _) => session.next_due().map(|due| due.max(self.rests_until)),
        }
    }

    /// Time passes: a pause ends, what takes too long is given up, or a session runs. What else is due is done by the
    /// next call.
    pub fn poll(&mut self, now: Time) -> Action {
        if self.phase_due().is_none_or(|due| now < due) {
            let is_due = self.session_due().is_some_and(|due| due <= now);
            return if is_due { self.run(now) } else { Action::Wait };
        }
        match self.phase {
            Phase::Pausing { .. } => self.connect(now),
            Phase::Connecting { .. } => {
                self.fail(now, no_answer(self.target.address, self.target.connect_ns))
            }
            Phase::Greeting { .. } => {
                self.fail(now, no_greeting(self.target.address, self.target.greeting_ns))
            }
            Phase::Ending { .. } => self.fail(now, no_end(self.target.address, self.target.connect_ns)),
            Phase::HandedOver { .. } | Phase::Idle | Phase::InSession { .. } => Action::Wait,
        }
    }

    /// Somebody has posted something to its session.
    pub fn woken(&mut self, now: Time) -> Action {
        if matches!(self.phase, Phase::Ending { .. }) { Action::Wait } else { self.run(now) }
    }

    /// Opens a connection, unless a session wants none.
    fn connect(&mut self, now: Time) -> Action {
        if let Handler::Session(session) = &self.handler
            && !session.wants()
        {
            self.phase = Phase::Idle;
            return Action::Wait;
        }
        self.phase = Phase::Connecting { until: now + self.target.connect_ns };
        Action::Connect
    }

    fn run(&mut self, now: Time) -> Action {
        let Handler::Session(session) = &mut self.handler else { return Action::Wait };
        self.rests_until = now + SHORTEST_RUN_NS;
        let next = session.run(now, &mut self.out);
        if let Phase::InSession { .. } = self.phase {
            return self.proceed(now, next);
        }
        self.out.clear();
        if let Phase::Idle = self.phase { self.connect(now) } else { Action::Wait }
    }

    /// It is open: the handshake begins.
    pub fn connected(&mut self, now: Time) -> Action {
        let Phase::Connecting { .. } = self.phase else { return Action::Wait };
        self.out.clear();
        self.sent = 0;
        match &mut self.handler {
            Handler::Handshake(greeting) => {
                self.phase = Phase::Greeting { until: now + self.target.greeting_ns, done: false };
                let greeted = greeting.begin(now, &mut self.out);
                self.greeted(now, greeted)
            }
            Handler::Session(session) => {
                self.phase = Phase::InSession { since: now };
                self.notes.set(self.index, None);
                let next = session.opened(now, &mut self.out);
                self.proceed(now, next)
            }
        }
    }

    /// It could not be opened, or broke during the handshake or session.
    pub fn failed(&mut self, now: Time, why: Broken) -> Action {
        let when = match self.phase {
            Phase::Connecting { .. } => During::Opening,
            Phase::Greeting { .. } => During::Handshake,
            Phase::InSession { .. } | Phase::Ending { .. } => During::Session,
            Phase::Pausing { .. } | Phase::HandedOver { .. } | Phase::Idle => return Action::Wait,
        };
        self.fail(now, broken(&self.target, why, when))
    }

    /// Bytes arrived, split anywhere.
    pub fn received(&mut self, now: Time, bytes: &[u8]) -> Action {
        match (&mut self.handler, self.phase) {
            (Handler::Handshake(greeting), Phase::Greeting { done: false, .. }) => {
                let greeted = greeting.take(now, bytes, &mut self.out);
                self.greeted(now, greeted)
            }
            (_, Phase::Greeting { done: true, .. }) if !bytes.is_empty() => {
                self.fail(now, format!("{} sends something that nobody requested", self.target.address))
            }
            (Handler::Session(session), Phase::InSession { .. }) => {
                let next = session.received(now, bytes, &mut self.out);
                self.proceed(now, next)
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
        let Phase::HandedOver { since } = self.phase else { return Action::Wait };
        self.was_in_use(now, since);
        self.fail(now, format!("connection to {} given up: {why}", self.target.address))
    }

    /// Whoever was in use for long begins with the least pause again.
    fn was_in_use(&mut self, now: Time, since: Time) {
        if now.since(since) >= self.target.most_pause_ns {
            self.pause_ns = self.least_pause();
        }
    }

    fn proceed(&mut self, now: Time, next: Next) -> Action {
        match next {
            Next::On => {}
            Next::Over => self.phase = Phase::Ending { until: now + self.target.connect_ns },
            Next::Failed(why) => return self.fail(now, format!("{}: {why}", self.target.address)),
        }
        self.go_on(now)
    }

    fn greeted(&mut self, now: Time, greeted: Greeted) -> Action {
        match greeted {
            Greeted::More => {}
            Greeted::Done => {
                if let Phase::Greeting { done, .. } = &mut self.phase {
                    *done = true;
                }
            }
            Greeted::Failed(why) => return self.fail(now, format!("{}: {why}", self.target.address)),
        }
        self.go_on(now)
    }

    fn go_on(&mut self, now: Time) -> Action {
        let left = self.to_send().len();
        match self.phase {
            Phase::InSession { .. } | Phase::Ending { .. } if left > MOST_UNSENT => {
                self.fail(now, format!("{} takes nothing of what it is sent", self.target.address))
            }
            Phase::InSession { .. } if left == 0 => {
                self.out.clear();
                self.sent = 0;
                Action::Wait
            }
            Phase::Ending { .. } if left == 0 => {
                self.end(now, &format!("ended with {}", self.target.address));
                self.pause_ns = self.least_pause();
                self.pause(now);
                Action::End
            }
            Phase::Greeting { .. } | Phase::InSession { .. } | Phase::Ending { .. } if left > 0 => {
                Action::Send
            }
            Phase::Greeting { done: true, .. } => {
                self.phase = Phase::HandedOver { since: now };
                self.notes.set(self.index, None);
                Action::HandOver
            }
            _ => Action::Wait,
        }
    }

    /// Pauses, the next time twice as long; a pause is shortened by the peer's share of the spread.
    fn fail(&mut self, now: Time, note: String) -> Action {
        self.end(now, &note);
        self.notes.set(self.index, Some(note));
        self.pause(now);
        self.pause_ns =
            self.pause_ns.saturating_mul(2).min(self.target.most_pause_ns).max(self.least_pause());
        Action::Close
    }

    fn pause(&mut self, now: Time) {
        self.phase = Phase::Pausing { until: now + (self.pause_ns - self.spread(self.pause_ns)) };
    }

    /// Reports the end of its connection to a session, if it had one.
    fn end(&mut self, now: Time, why: &str) {
        if let Phase::InSession { since } = self.phase {
            self.was_in_use(now, since);
        }
        if let (Phase::InSession { .. } | Phase::Ending { .. }, Handler::Session(session)) =
            (self.phase, &mut self.handler)
        {
            session.closed(now, why);
        }
    }

    fn least_pause(&self) -> u64 {
        self.target.least_pause_ns.max(SHORTEST_PAUSE_NS)
    }

    /// The share of this peer in the spread of a pause. Multiples of the golden ratio divide an interval evenly, and
    /// addresses of one machine mostly follow each other.
    fn spread(&self, pause_ns: u64) -> u64 {
        let address = self.target.address;
        let key = address.ip().to_bits().wrapping_add(u32::from(address.port()));
        let part = u64::from(key.wrapping_mul(0x9E37_79B9));
        let most = pause_ns / SPREAD;
        ((u128::from(most) * u128::from(part)) >> 32) as u64
    }
}

#[cfg(test)]
mod tests;
