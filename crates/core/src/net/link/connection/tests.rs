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
fn protocol_errors_and_unrequested_bytes_are_reported_with_the_address_and_a_reconnect_follows() {
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

mod sessions;
