//! Datagrams on loopback.

use super::*;
use std::time::Duration;

/// The tests of this file own 127.71.x.0/24, one x each.
fn address(x: u8, host: u8) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(127, 71, x, host), 41136)
}

fn options(peers: usize) -> UdpOptions {
    UdpOptions { peers, waiting: 0, room: 64, dscp: 0, groups: 0 }
}

fn peer(x: u8, host: u8) -> UdpSocket {
    let socket = UdpSocket::bind(address(x, host)).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    socket
}

/// A message of one byte, its index, posted to each peer.
fn outbox(peers: &[SocketAddrV4]) -> Outbox {
    let mut outbox = Outbox::new(peers, 64);
    for index in 0..peers.len() {
        outbox.room(index)[0] = index as u8;
        outbox.set_length(index, 1);
        outbox.post(index, true);
    }
    outbox
}

/// The next `count` datagrams, or what comes of them within a minute, as (sender, bytes, truncated).
fn receive(udp: &mut Udp, count: usize) -> Vec<(SocketAddrV4, Vec<u8>, bool)> {
    let mut got = Vec::new();
    let give_up = MonotonicClock::read() + 60 * crate::time::S;
    while got.len() < count && MonotonicClock::read() < give_up {
        let before = got.len();
        let n = udp.receive(&mut |r| got.push((r.from, r.bytes.to_vec(), r.truncated))).unwrap();
        assert!(n == got.len() - before && n <= udp.batch());
    }
    got
}

#[test]
fn a_failing_message_disturbs_no_other() {
    // Broadcast without SO_BROADCAST, first, in the middle, twice in a row, at a batch's end, last; and a message that
    // is too long for UDP.
    let forbidden = SocketAddrV4::new(Ipv4Addr::BROADCAST, 41136);
    let fails = |index| match index {
        0 | 5 | 6 | 63 | 64 | 99 => Some(libc::EACCES),
        50 => Some(libc::EMSGSIZE),
        _ => None,
    };
    let mut udp = Udp::bind(address(3, 1), &options(100)).unwrap();
    let living = peer(3, 2);
    let peer_of = |k| if fails(k) == Some(libc::EACCES) { forbidden } else { address(3, 2) };
    let mut outbox = Outbox::new(&(0..100).map(peer_of).collect::<Vec<_>>(), 70_000);
    for index in 0..100 {
        outbox.room(index)[0] = index as u8;
        outbox.set_length(index, if index == 50 { 70_000 } else { 1 });
        outbox.post(index, true);
    }
    udp.send(&mut outbox);
    let mut bytes = [0; 8];
    for index in 0..100 {
        match fails(index) {
            Some(errno) => assert_eq!(outbox.sent(index), Sent::Failed(errno), "{index}"),
            None => {
                assert!(matches!(outbox.sent(index), Sent::At(_)), "{index}");
                living.recv_from(&mut bytes).unwrap();
                assert_eq!(bytes[0], index as u8);
            }
        }
    }
}

#[test]
fn a_dead_peer_on_a_living_host_is_no_error() {
    // Its ICMP answer would be a pending error on a connected socket.
    let mut udp = Udp::bind(address(6, 1), &options(2)).unwrap();
    let living = peer(6, 2);
    let mut outbox = outbox(&[address(6, 99), address(6, 2)]);
    for _ in 0..3 {
        outbox.post(0, true);
        outbox.post(1, true);
        udp.send(&mut outbox);
        assert!(matches!((outbox.sent(0), outbox.sent(1)), (Sent::At(_), Sent::At(_))));
        assert_eq!(living.recv(&mut [0; 8]).unwrap(), 1);
    }
    assert_eq!(udp.receive(&mut |_| ()).unwrap(), 0);
}

#[test]
fn datagrams_dropped_by_the_kernel_are_counted_to_the_last_one() {
    let mut udp = Udp::bind(address(10, 1), &options(1)).unwrap();
    let unknown = peer(10, 200);
    let (mut sent, mut taken) = (0, 0);
    let mut burst = |udp: &mut Udp, count: usize, taken: &mut u64| {
        // On loopback each is in the buffer, or dropped, before the next one is sent.
        for _ in 0..count {
            unknown.send_to(&[9; 40], address(10, 1)).unwrap();
        }
        while let Ok(more @ 1..) = udp.receive(&mut |_| *taken += 1) {
            assert!(more <= udp.batch());
        }
        sent += count as u64;
        sent
    };
    burst(&mut udp, 5, &mut taken);
    assert_eq!((taken, udp.dropped()), (5, 0));
    for round in 1..4 {
        let before = udp.dropped();
        burst(&mut udp, 2_000, &mut taken);
        // Datagrams after the last one that had room are reported with the next one.
        let sent = burst(&mut udp, 1, &mut taken);
        assert_eq!(taken + udp.dropped(), sent, "round {round}");
        assert!(udp.dropped() > before + 500, "{}", udp.dropped());
    }
}

#[test]
fn a_peer_may_change_from_one_send_to_the_next() {
    let mut udp = Udp::bind(address(11, 1), &options(2)).unwrap();
    let peers = [2, 3].map(|host| peer(11, host));
    let mut outbox = outbox(&[address(11, 2), address(11, 2)]);
    let mut bytes = [0; 8];
    udp.send(&mut outbox);
    assert_eq!((peers[0].recv(&mut bytes).unwrap(), peers[0].recv(&mut bytes).unwrap()), (1, 1));
    outbox.set_peer(1, address(11, 3));
    assert_eq!((outbox.peer(0), outbox.peer(1)), (address(11, 2), address(11, 3)));
    (0..2).for_each(|index| outbox.post(index, true));
    udp.send(&mut outbox);
    for (index, peer) in peers.iter().enumerate() {
        peer.recv(&mut bytes).unwrap();
        assert_eq!(bytes[0], index as u8);
    }
}

#[test]
fn requests_carry_their_mark_and_a_second_master_is_refused() {
    for (x, dscp, tos) in [(13, 0, 0), (14, 47, 0xBC), (15, 63, 0xFC)] {
        let udp = Udp::bind(address(x, 1), &UdpOptions { dscp, ..options(1) }).unwrap();
        assert_eq!(nix::sys::socket::getsockopt(udp.socket(), sockopt::Ipv4Tos).unwrap(), tos);
        let second = Udp::bind(address(x, 1), &options(1));
        assert_eq!(second.map(|_| ()).unwrap_err().kind(), io::ErrorKind::AddrInUse);
    }
}

mod groups;
