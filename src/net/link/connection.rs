//! One connection's life: pause, connect, handshake, hand over, take back. A machine of state and time, without a
//! socket or a clock, so that the link thread and a virtual world run the same one.
//!
//! Its caller has the socket. Every event returns the [`Action`] that follows from it; with
//! [`poll`](Connection::poll) at [`next_due`](Connection::next_due) no wait is longer than the peer's
//! [`StreamPeer`] allows.

use std::net::SocketAddrV4;

use crate::net::stream::{Broken, Greeted, LinkNotes, StreamPeer};
use crate::time::{MS, Ns, Time};

/// The shortest pause, ns: a setting of 0 shall not turn into a storm of connections.
const SHORTEST_PAUSE_NS: u64 = MS;

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
}

/// One connection, open or not.
#[derive(Debug)]
pub struct Connection {
    peer: StreamPeer,
    notes: LinkNotes,
    /// Its index in the notes.
    index: usize,
    phase: Phase,
    /// The pause after the next failure.
    pause_ns: u64,
    /// The bytes of the handshake, and how many of them are sent.
    out: Vec<u8>,
    sent: usize,
}

impl Connection {
    /// A connection that begins to open about `now`: peers created together start within an eighth of their least
    /// pause. The reason why it is not open goes to `notes` at `index`.
    pub fn new(now: Time, peer: StreamPeer, notes: LinkNotes, index: usize) -> Connection {
        let mut connection = Connection {
            phase: Phase::Pausing { until: now },
            pause_ns: 0,
            out: Vec::new(),
            sent: 0,
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

    /// Its peer.
    pub fn peer(&self) -> &StreamPeer {
        &self.peer
    }

    /// Whether it is being opened.
    pub fn is_connecting(&self) -> bool {
        matches!(self.phase, Phase::Connecting { .. })
    }

    /// The latest time for [`poll`](Self::poll); `None` while the loop has it.
    pub fn next_due(&self) -> Option<Time> {
        match self.phase {
            Phase::Pausing { until } | Phase::Connecting { until } | Phase::Greeting { until, .. } => {
                Some(until)
            }
            Phase::HandedOver { .. } => None,
        }
    }

    /// Time passes: a pause ends, or what takes too long is given up.
    pub fn poll(&mut self, now: Time) -> Action {
        if self.next_due().is_none_or(|due| now < due) {
            return Action::Wait;
        }
        match self.phase {
            Phase::Pausing { .. } => {
                self.phase = Phase::Connecting { until: now + self.peer.connect_ns };
                Action::Connect
            }
            Phase::Connecting { .. } => self.fail(now, no_answer(self.peer.address, self.peer.connect_ns)),
            Phase::Greeting { .. } => self.fail(now, no_greeting(self.peer.address, self.peer.greeting_ns)),
            Phase::HandedOver { .. } => Action::Wait,
        }
    }

    /// It is open: the handshake begins.
    pub fn connected(&mut self, now: Time) -> Action {
        let Phase::Connecting { .. } = self.phase else { return Action::Wait };
        self.phase = Phase::Greeting { until: now + self.peer.greeting_ns, done: false };
        self.out.clear();
        self.sent = 0;
        let greeted = self.peer.greeting.begin(now, &mut self.out);
        self.greeted(now, greeted)
    }

    /// It could not be opened, or broke during the handshake.
    pub fn failed(&mut self, now: Time, why: Broken) -> Action {
        let greeting = match self.phase {
            Phase::Connecting { .. } => false,
            Phase::Greeting { .. } => true,
            Phase::Pausing { .. } | Phase::HandedOver { .. } => return Action::Wait,
        };
        self.fail(now, broken(self.peer.address, why, greeting, self.peer.connect_ns))
    }

    /// Bytes arrived, split anywhere.
    pub fn received(&mut self, now: Time, bytes: &[u8]) -> Action {
        match self.phase {
            Phase::Greeting { done: false, .. } => {
                let greeted = self.peer.greeting.take(now, bytes, &mut self.out);
                self.greeted(now, greeted)
            }
            Phase::Greeting { done: true, .. } if !bytes.is_empty() => {
                self.fail(now, format!("{} sends something that nobody requested", self.peer.address))
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
        if now.since(since) >= self.peer.most_pause_ns {
            self.pause_ns = self.least_pause();
        }
        self.fail(now, format!("connection to {} given up: {why}", self.peer.address))
    }

    fn greeted(&mut self, now: Time, greeted: Greeted) -> Action {
        match greeted {
            Greeted::More => {}
            Greeted::Done => {
                if let Phase::Greeting { done, .. } = &mut self.phase {
                    *done = true;
                }
            }
            Greeted::Failed(why) => return self.fail(now, format!("{}: {why}", self.peer.address)),
        }
        self.go_on(now)
    }

    fn go_on(&mut self, now: Time) -> Action {
        match self.phase {
            Phase::Greeting { .. } if !self.to_send().is_empty() => Action::Send,
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
        self.notes.set(self.index, Some(note));
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
        let key = self.peer.address.ip().to_bits().wrapping_add(u32::from(self.peer.address.port()));
        let part = u64::from(key.wrapping_mul(0x9E37_79B9));
        let most = pause_ns / SPREAD;
        ((u128::from(most) * u128::from(part)) >> 32) as u64
    }
}

fn no_answer(peer: SocketAddrV4, waited_ns: u64) -> String {
    format!(
        "no answer from {peer} within {}: look at the address, the cable and the drive's power",
        Ns(waited_ns)
    )
}

fn no_greeting(peer: SocketAddrV4, waited_ns: u64) -> String {
    format!(
        "{peer} accepts connections, but does not answer within {}: is it the right port of the right device?",
        Ns(waited_ns)
    )
}

fn broken(peer: SocketAddrV4, why: Broken, greeting: bool, connect_ns: u64) -> String {
    match why {
        Broken::Closed | Broken::Failed(libc::ECONNRESET | libc::EPIPE) | Broken::Absent => format!(
            "{peer} ends the connection at once: its connections may all be in use, or it may not accept this computer"
        ),
        Broken::Failed(libc::ECONNREFUSED) => {
            format!(
                "refused: nobody listens at {peer}; look at the address, the port, and whether the service is enabled"
            )
        }
        Broken::Failed(libc::ETIMEDOUT) if greeting => {
            format!("{peer} was lost during the handshake: look at the cable and the drive's power")
        }
        Broken::Failed(libc::ETIMEDOUT) => no_answer(peer, connect_ns),
        Broken::Failed(libc::EHOSTUNREACH) => {
            format!(
                "no device has the address of {peer}: look at the address, the cable and the drive's power"
            )
        }
        Broken::Failed(libc::ENETUNREACH) => {
            format!(
                "no network leads to {peer}: look at the address and at this computer's interfaces (ip address)"
            )
        }
        Broken::Failed(errno) => {
            format!("no connection to {peer}: {}", std::io::Error::from_raw_os_error(errno))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::stream::Greeting;
    use crate::time::S;
    use proptest::prelude::*;

    /// Sends `hello` and expects `welcome`; with nothing to send it is complete at once.
    #[derive(Debug)]
    struct Hello {
        say: &'static [u8],
        expect: &'static [u8],
        got: Vec<u8>,
    }

    impl Greeting for Hello {
        fn begin(&mut self, _now: Time, out: &mut Vec<u8>) -> Greeted {
            self.got.clear();
            out.extend_from_slice(self.say);
            if self.expect.is_empty() { Greeted::Done } else { Greeted::More }
        }

        fn take(&mut self, _now: Time, bytes: &[u8], out: &mut Vec<u8>) -> Greeted {
            self.got.extend_from_slice(bytes);
            if !self.expect.starts_with(&self.got) {
                return Greeted::Failed("speaks another language".into());
            }
            if self.got.len() < self.expect.len() {
                return Greeted::More;
            }
            out.extend_from_slice(b"bye");
            Greeted::Done
        }
    }

    const START: Time = Time(1_000 * S);

    fn address(host: u8) -> SocketAddrV4 {
        SocketAddrV4::new([192, 168, 1, host].into(), 502)
    }

    fn connection(say: &'static [u8], expect: &'static [u8]) -> (Connection, LinkNotes) {
        let notes = LinkNotes::new(1);
        let peer = StreamPeer::new(address(20), Box::new(Hello { say, expect, got: Vec::new() }));
        (Connection::new(START, peer, notes.clone(), 0), notes)
    }

    /// Goes on to the end of the pause, and begins to connect.
    fn connect(connection: &mut Connection) -> Time {
        let now = connection.next_due().unwrap();
        assert_eq!(connection.poll(now), Action::Connect);
        now
    }

    /// Sends everything in pieces of `piece` bytes; returns the action that followed.
    fn send(connection: &mut Connection, now: Time, piece: usize) -> (Vec<u8>, Action) {
        let mut said = Vec::new();
        loop {
            let count = connection.to_send().len().min(piece);
            said.extend_from_slice(&connection.to_send()[..count]);
            match connection.sent(now, count) {
                Action::Send => {}
                action => return (said, action),
            }
        }
    }

    /// All the way to the loop.
    fn hand_over(connection: &mut Connection) -> Time {
        let now = connect(connection);
        assert_eq!(connection.connected(now), Action::HandOver);
        now
    }

    /// The pause that a failure at `now` has led to.
    fn pause(connection: &Connection, now: Time) -> u64 {
        connection.next_due().unwrap().since(now)
    }

    /// Shortened by an eighth at most.
    fn assert_about(ns: u64, nominal: u64) {
        assert!(ns <= nominal && ns >= nominal - nominal / 8, "{ns} of {nominal}");
    }

    #[test]
    fn a_greeting_passes_in_any_split_and_hands_over_when_all_is_sent() {
        for piece in 1..=7 {
            let (mut connection, notes) = connection(b"hello", b"welcome");
            let now = connect(&mut connection);
            assert_eq!(connection.connected(now), Action::Send);
            assert_eq!(send(&mut connection, now, piece), (b"hello".to_vec(), Action::Wait));
            let mut last = Action::Wait;
            for bytes in b"welcome".chunks(piece) {
                assert_eq!(last, Action::Wait);
                last = connection.received(now, bytes);
            }
            assert_eq!(last, Action::Send);
            assert_eq!(send(&mut connection, now, piece), (b"bye".to_vec(), Action::HandOver));
            assert_eq!((connection.next_due(), notes.get(0)), (None, None));
        }
    }

    #[test]
    fn a_greeting_of_nothing_hands_over_at_once() {
        let (mut connection, _) = connection(b"", b"");
        hand_over(&mut connection);
    }

    #[test]
    fn each_phase_ends_at_its_own_time_and_says_why() {
        let (mut connection, notes) = connection(b"hello", b"welcome");
        let now = connect(&mut connection);
        assert_eq!(connection.next_due(), Some(now + S));
        assert_eq!(connection.poll(now + (S - 1)), Action::Wait);
        assert_eq!(connection.poll(now + S), Action::Close);
        assert_eq!(
            notes.get(0).as_deref(),
            Some(
                "no answer from 192.168.1.20:502 within 1 s: look at the address, the cable and the drive's power"
            )
        );

        let now = connect(&mut connection);
        assert_eq!(connection.connected(now), Action::Send);
        assert_eq!(connection.next_due(), Some(now + 2 * S));
        // One that sends byte by byte gains no time.
        for (k, byte) in b"welcom".iter().enumerate() {
            assert_eq!(connection.received(now + k as u64 * S / 4, &[*byte]), Action::Send);
        }
        assert_eq!(connection.poll(now + 2 * S), Action::Close);
        let note = notes.get(0).unwrap();
        assert!(
            note.starts_with("192.168.1.20:502 accepts connections, but does not answer within 2 s"),
            "{note}"
        );
    }

    #[test]
    fn each_failure_has_its_words() {
        let cases = [
            (libc::ECONNREFUSED, "refused: nobody listens at 192.168.1.20:502"),
            (libc::ETIMEDOUT, "no answer from 192.168.1.20:502 within 1 s"),
            (libc::EHOSTUNREACH, "no device has the address"),
            (libc::ENETUNREACH, "no network leads to"),
            (libc::ECONNRESET, "ends the connection at once"),
            (libc::EMFILE, "Too many open files"),
        ];
        let (mut connection, notes) = connection(b"hello", b"welcome");
        for (errno, words) in cases {
            let now = connect(&mut connection);
            assert_eq!(connection.failed(now, Broken::Failed(errno)), Action::Close);
            let note = notes.get(0).unwrap();
            assert!(note.contains(words) && note.contains("192.168.1.20:502"), "{note}");
        }
        for (broken, words) in [
            (Broken::Closed, "ends the connection at once"),
            (Broken::Failed(libc::ETIMEDOUT), "was lost during the handshake"),
        ] {
            let now = connect(&mut connection);
            connection.connected(now);
            assert_eq!(connection.failed(now, broken), Action::Close);
            assert!(notes.get(0).unwrap().contains(words), "{:?}", notes.get(0));
        }
    }

    #[test]
    fn what_the_protocol_finds_is_told_with_the_address() {
        let (mut connection, notes) = connection(b"hello", b"welcome");
        let now = connect(&mut connection);
        connection.connected(now);
        assert_eq!(connection.received(now, b"weird"), Action::Close);
        assert_eq!(notes.get(0).as_deref(), Some("192.168.1.20:502: speaks another language"));
    }

    #[test]
    fn a_peer_that_goes_on_talking_after_the_greeting_is_not_handed_over() {
        let (mut connection, notes) = connection(b"hello", b"welcome");
        let now = connect(&mut connection);
        connection.connected(now);
        send(&mut connection, now, 99);
        assert_eq!(connection.received(now, b"welcome"), Action::Send);
        assert_eq!(connection.received(now, b"again"), Action::Close);
        assert!(notes.get(0).unwrap().contains("nobody requested"));
        // And the next one begins from the start.
        let now = connect(&mut connection);
        assert_eq!(connection.connected(now), Action::Send);
        assert_eq!(connection.to_send(), b"hello");
    }

    #[test]
    fn pauses_double_up_to_the_most_and_no_further() {
        let (mut connection, _) = connection(b"hello", b"welcome");
        for nominal in [100, 200, 400, 800, 1_600, 2_000, 2_000, 2_000] {
            let now = connect(&mut connection);
            connection.failed(now, Broken::Failed(libc::ECONNREFUSED));
            assert_about(pause(&connection, now), nominal * MS);
        }
    }

    #[test]
    fn only_a_connection_that_was_in_use_long_enough_begins_with_the_least_pause_again() {
        let (mut connection, notes) = connection(b"", b"");
        for nominal in [100, 200, 400] {
            let now = hand_over(&mut connection) + (2 * S - 1);
            assert_eq!(connection.given_back(now, "it was silent"), Action::Close);
            assert_about(pause(&connection, now), nominal * MS);
            assert_eq!(
                notes.get(0).as_deref(),
                Some("connection to 192.168.1.20:502 given up: it was silent")
            );
        }
        let now = hand_over(&mut connection) + 2 * S;
        assert_eq!(notes.get(0), None);
        assert_eq!(connection.given_back(now, "it was silent"), Action::Close);
        assert_about(pause(&connection, now), 100 * MS);
    }

    #[test]
    fn a_greeted_peer_that_never_gets_into_use_is_asked_more_and_more_seldom() {
        let (mut connection, _) = connection(b"hello", b"welcome");
        for nominal in [100, 200, 400] {
            let now = connect(&mut connection);
            connection.connected(now);
            assert_eq!(connection.failed(now, Broken::Closed), Action::Close);
            assert_about(pause(&connection, now), nominal * MS);
        }
    }

    #[test]
    fn thirty_two_peers_in_a_row_never_knock_at_the_same_instant() {
        let mut connections: Vec<_> = (0..32)
            .map(|host| {
                let peer = StreamPeer::new(
                    address(20 + host),
                    Box::new(Hello { say: b"", expect: b"", got: Vec::new() }),
                );
                Connection::new(START, peer, LinkNotes::new(1), 0)
            })
            .collect();
        for round in 0..8 {
            let mut dues: Vec<_> = connections.iter().map(|one| one.next_due().unwrap()).collect();
            dues.sort();
            // 32 golden steps leave no gap below 1/89 of the whole, here 12.5 ms, and none outside of it.
            let gaps: Vec<_> = dues.windows(2).map(|pair| pair[1].since(pair[0])).collect();
            assert!(gaps.iter().all(|gap| *gap >= 100 * MS / SPREAD / 89), "round {round}: {gaps:?}");
            if round == 0 {
                assert!(dues[0] >= START && dues[31] <= START + 100 * MS / SPREAD);
            }
            for connection in &mut connections {
                let now = connect(connection);
                connection.failed(now, Broken::Failed(libc::ECONNREFUSED));
            }
        }
    }

    #[test]
    fn pauses_of_nothing_are_still_pauses() {
        let peer = StreamPeer {
            least_pause_ns: 0,
            most_pause_ns: 0,
            ..StreamPeer::new(address(20), Box::new(Hello { say: b"", expect: b"", got: Vec::new() }))
        };
        let mut connection = Connection::new(START, peer, LinkNotes::new(1), 0);
        for _ in 0..3 {
            let now = connect(&mut connection);
            connection.failed(now, Broken::Failed(libc::ECONNREFUSED));
            assert_about(pause(&connection, now), SHORTEST_PAUSE_NS);
        }
    }

    #[test]
    fn events_that_come_too_late_change_nothing() {
        let (mut connection, notes) = connection(b"hello", b"welcome");
        let due = connection.next_due();
        for now in [START, START + S] {
            assert_eq!(connection.connected(now), Action::Wait);
            assert_eq!(connection.failed(now, Broken::Closed), Action::Wait);
            assert_eq!(connection.received(now, b"welcome"), Action::Wait);
            assert_eq!(connection.sent(now, 5), Action::Wait);
            assert_eq!(connection.given_back(now, "late"), Action::Wait);
        }
        assert_eq!((connection.next_due(), notes.get(0)), (due, None));
    }

    /// Something that happens to a connection, likely or not.
    #[derive(Clone, Debug)]
    enum Event {
        Poll,
        Connected,
        Failed,
        Received(Vec<u8>),
        Sent(usize),
        GivenBack,
    }

    fn events() -> impl Strategy<Value = Vec<(Event, u64)>> {
        let event = prop_oneof![
            4 => Just(Event::Poll),
            4 => Just(Event::Connected),
            1 => Just(Event::Failed),
            4 => (0..8_usize).prop_map(|count| Event::Received(b"welcome"[..count.min(7)].to_vec())),
            4 => (0..6_usize).prop_map(Event::Sent),
            2 => Just(Event::GivenBack),
        ];
        // In all orders of magnitude.
        let pass = (0..35_u32).prop_flat_map(|bits| 0..1_u64 << bits);
        prop::collection::vec((event, pass), 0..200)
    }

    proptest! {
        #[test]
        fn whatever_happens_there_is_one_socket_one_owner_and_an_end_to_every_wait(events in events()) {
            let (mut connection, _) = connection(b"hello", b"welcome");
            let mut now = START;
            // Whether there is a socket, and whether the loop has it.
            let (mut socket, mut out) = (false, false);
            for (event, pass) in events {
                now = now + pass;
                let action = match event {
                    Event::Poll => connection.poll(now),
                    Event::Connected => connection.connected(now),
                    Event::Failed => connection.failed(now, Broken::Closed),
                    Event::Received(bytes) => connection.received(now, &bytes),
                    Event::Sent(count) => connection.sent(now, count),
                    Event::GivenBack => connection.given_back(now, "it is tried"),
                };
                match action {
                    Action::Wait => {}
                    Action::Connect => {
                        prop_assert!(!socket);
                        socket = true;
                    }
                    Action::Send => prop_assert!(socket && !out && !connection.to_send().is_empty()),
                    Action::HandOver => {
                        prop_assert!(socket && !out && connection.to_send().is_empty());
                        out = true;
                    }
                    Action::Close => {
                        prop_assert!(socket);
                        (socket, out) = (false, false);
                    }
                }
                match connection.next_due() {
                    None => prop_assert!(out),
                    Some(due) => {
                        prop_assert!(!out);
                        prop_assert!(due <= now + 2 * S, "due in {}", Ns(due.since(now)));
                    }
                }
            }
        }
    }
}
