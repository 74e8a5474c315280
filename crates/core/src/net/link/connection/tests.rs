//! The life of a connection, in plain time.

use super::*;
use crate::net::link::tests::Hello;
use crate::time::S;

const START: Time = Time(1_000 * S);

fn address(host: u8) -> SocketAddrV4 {
    SocketAddrV4::new([192, 168, 1, host].into(), 502)
}

fn connection(say: &'static [u8], expect: &'static [u8]) -> (Connection, LinkNotes) {
    let notes = LinkNotes::new(1);
    let peer = StreamPeer::new(address(20), Box::new(Hello::new(say, expect)));
    (Connection::new(START, peer, notes.clone(), 0), notes)
}

/// A peer with nothing to say.
fn silent(host: u8) -> StreamPeer {
    StreamPeer::new(address(host), Box::new(Hello::new(b"", b"")))
}

fn of(peer: StreamPeer) -> Connection {
    Connection::new(START, peer, LinkNotes::new(1), 0)
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

/// The pause that a failure at `now` has led to.
fn pause(connection: &Connection, now: Time) -> u64 {
    connection.next_due().unwrap().since(now)
}

/// Shortened by an eighth at most.
fn assert_about(ns: u64, nominal: u64) {
    assert!(ns <= nominal && ns >= nominal - nominal / 8, "{ns} of {nominal}");
}

#[test]
fn a_handshake_passes_in_any_split_and_hands_over_when_all_is_sent() {
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
fn each_phase_ends_at_its_own_time_and_says_why() {
    let (mut connection, notes) = connection(b"hello", b"welcome");
    let now = connect(&mut connection);
    assert_eq!(connection.next_due(), Some(now + S));
    assert_eq!(connection.poll(now + (S - 1)), Action::Wait);
    assert_eq!(connection.poll(now + S), Action::Close);
    let none =
        "no answer from 192.168.1.20:502 within 1 s: look at the address, the cable and the drive's power";
    assert_eq!(notes.get(0).as_deref(), Some(none));
    let now = connect(&mut connection);
    assert_eq!(connection.connected(now), Action::Send);
    assert_eq!(connection.next_due(), Some(now + 2 * S));
    // One that sends byte by byte gains no time.
    for (k, byte) in b"welcom".iter().enumerate() {
        assert_eq!(connection.received(now + k as u64 * S / 4, &[*byte]), Action::Send);
    }
    assert_eq!(connection.poll(now + 2 * S), Action::Close);
    let silent = "192.168.1.20:502 accepts connections, but does not answer within 2 s";
    assert!(notes.get(0).unwrap().starts_with(silent), "{:?}", notes.get(0));
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
fn what_the_protocol_finds_or_what_nobody_requested_is_told_with_the_address_and_the_next_one_begins_anew() {
    let (mut connection, notes) = connection(b"hello", b"welcome");
    for (replies, note) in [
        (&[&b"weird"[..]][..], "192.168.1.20:502: speaks another language"),
        (&[&b"welcome"[..], b"again"], "192.168.1.20:502 sends something that nobody requested"),
    ] {
        let now = connect(&mut connection);
        assert_eq!(connection.connected(now), Action::Send);
        assert_eq!(send(&mut connection, now, 99), (b"hello".to_vec(), Action::Wait));
        let (last, before) = replies.split_last().unwrap();
        before.iter().for_each(|reply| assert_eq!(connection.received(now, reply), Action::Send));
        assert_eq!(connection.received(now, last), Action::Close);
        assert!(notes.get(0).unwrap().contains(note), "{:?}", notes.get(0));
    }
}

#[test]
fn pauses_double_up_to_the_most_and_only_a_connection_in_use_long_enough_begins_with_the_least_one_again() {
    let (mut connection, _) = connection(b"hello", b"welcome");
    for nominal in [100, 200, 400, 800, 1_600, 2_000, 2_000, 2_000] {
        let now = connect(&mut connection);
        // Whether its handshake had begun or not.
        if nominal % 400 == 0 {
            connection.connected(now);
        }
        connection.failed(now, Broken::Failed(libc::ECONNREFUSED));
        assert_about(pause(&connection, now), nominal * MS);
    }
    let (mut connection, notes) = self::connection(b"", b"");
    for (used_ns, nominal) in [(2 * S - 1, 100), (2 * S - 1, 200), (2 * S - 1, 400), (2 * S, 100)] {
        let now = connect(&mut connection);
        assert_eq!((connection.connected(now), notes.get(0)), (Action::HandOver, None));
        assert_eq!(connection.given_back(now + used_ns, "it was silent"), Action::Close);
        assert_about(pause(&connection, now + used_ns), nominal * MS);
        assert_eq!(notes.get(0).as_deref(), Some("connection to 192.168.1.20:502 given up: it was silent"));
    }
    // A pause of nothing is still one.
    let mut connection = of(StreamPeer { least_pause_ns: 0, most_pause_ns: 0, ..silent(20) });
    for _ in 0..3 {
        let now = connect(&mut connection);
        connection.failed(now, Broken::Failed(libc::ECONNREFUSED));
        assert_about(pause(&connection, now), SHORTEST_PAUSE_NS);
    }
}

#[test]
fn thirty_two_peers_in_a_row_never_knock_at_the_same_instant() {
    let mut connections: Vec<_> = (0..32).map(|host| of(silent(20 + host))).collect();
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

mod sessions;
