//! Connections of this host.

use super::*;
use std::io::{Read, Write};
use std::net::{SocketAddrV4, TcpListener, TcpStream};

use nix::sys::socket::{getsockopt, sockopt};

use crate::net::link::tests::{
    accept, breaks, expect, listener, opened, patient, receive, reset, silent, wakes,
};
use crate::net::link::{REPEATED_US, TCP_RTO_MIN_US};
use crate::time::{MS, S};
use fieldbeat_testing::until;

/// The tests of this file own 127.75.x.0/24, one x each.
fn address(x: u8, host: u8) -> SocketAddrV4 {
    SocketAddrV4::new([127, 75, x, host].into(), 1502)
}

/// A carrier with so many peers, all open, and the peers.
fn open(x: u8, count: u8) -> (Tcp, Vec<TcpStream>, Vec<TcpListener>) {
    let addresses = (0..count).map(|host| address(x, 10 + host));
    let listeners: Vec<_> = addresses.clone().map(listener).collect();
    let thread = LinkThread::start(None).unwrap();
    let mut tcp = Tcp::open(&thread, addresses.map(|peer| patient(peer, silent())).collect()).unwrap();
    let drives = listeners.iter().map(accept).collect();
    let mut indices: Vec<_> = (0..count).map(|_| opened(&mut tcp)).collect();
    indices.sort();
    assert!(indices.into_iter().eq(0..usize::from(count)));
    (tcp, drives, listeners)
}

#[test]
fn a_socket_has_what_a_cyclic_exchange_needs() {
    let (tcp, _drives, _listeners) = open(1, 1);
    let socket = tcp.sockets[0].as_ref().unwrap();
    assert!(getsockopt(socket, sockopt::TcpNoDelay).unwrap());
    assert!(getsockopt(socket, sockopt::KeepAlive).unwrap());
    assert_eq!(getsockopt(socket, sockopt::TcpKeepIdle).unwrap(), 1);
    assert_eq!(getsockopt(socket, sockopt::TcpKeepInterval).unwrap(), 1);
    assert_eq!(getsockopt(socket, sockopt::TcpKeepCount).unwrap(), 3);
    assert_eq!(getsockopt(socket, sockopt::TcpUserTimeout).unwrap(), 1_000);
    // Where the kernel has it; in whole ticks of its clock.
    if let Some(repeated) = integer(socket, TCP_RTO_MIN_US) {
        assert!((REPEATED_US..REPEATED_US + 10_000).contains(&repeated), "{repeated}");
    }
    let wanted = libc::O_NONBLOCK | libc::O_CLOEXEC;
    assert_eq!(flags(socket.as_raw_fd()) & wanted, wanted);
    let (tcp, _drives, _listeners) = open(14, 2);
    assert_eq!(flags(tcp.epoll.as_ref().unwrap().0.as_raw_fd()) & libc::O_CLOEXEC, libc::O_CLOEXEC);
    // Its memory is named.
    let mut regions = Regions::new();
    tcp.memory(&mut regions);
    assert!(regions.covers(&tcp.sockets) && regions.covers(&tcp.events));
    assert!(regions.covers(std::slice::from_ref(&tcp)));
}

/// An option of TCP that is a number; `None`: the kernel does not know it.
fn integer(socket: &Descriptor, option: libc::c_int) -> Option<libc::c_int> {
    let (mut value, mut length) = (0, size_of::<libc::c_int>() as libc::socklen_t);
    let (at, fd) = ((&raw mut value).cast(), socket.as_raw_fd());
    // SAFETY: the kernel writes one integer and its length, which outlive the call.
    let result = unsafe { libc::getsockopt(fd, libc::IPPROTO_TCP, option, at, &raw mut length) };
    (result == 0).then_some(value)
}

/// The flags of a descriptor, FD_CLOEXEC as O_CLOEXEC (proc(5)).
fn flags(fd: RawFd) -> i32 {
    let info = std::fs::read_to_string(format!("/proc/self/fdinfo/{fd}")).unwrap();
    let octal = info.lines().find_map(|line| line.strip_prefix("flags:")).unwrap();
    i32::from_str_radix(octal.trim(), 8).unwrap()
}

#[test]
fn a_look_names_those_that_have_something_and_each_is_itself() {
    let (mut tcp, mut drives, _listeners) = open(2, 40);
    for round in 0..20 {
        let speaking: Vec<_> = (0..40).filter(|index| index % 3 == round % 3).collect();
        for &index in &speaking {
            assert_eq!(tcp.send(index, &[index as u8, round as u8]).unwrap().1, 2);
            expect(&mut drives[index], &[index as u8, round as u8]);
            drives[index].write_all(&[index as u8, round as u8]).unwrap();
        }
        let mut received = Vec::new();
        until("all received", || {
            tcp.look();
            while let Some(index) = tcp.ready() {
                let mut room = [0; 8];
                let (_, length) = tcp.receive(index, &mut room).unwrap().unwrap();
                assert_eq!(room[..length], [index as u8, round as u8]);
                received.push(index);
            }
            received.len() >= speaking.len()
        });
        received.sort();
        assert_eq!(received, speaking);
        tcp.look();
        assert_eq!(tcp.ready(), None);
    }
    // One look names all of them.
    drives.iter_mut().for_each(|drive| drive.write_all(b"all").unwrap());
    until("40 at once", || {
        tcp.look();
        let mut indices: Vec<_> = std::iter::from_fn(|| tcp.ready()).collect();
        indices.sort();
        indices.into_iter().eq(0..40)
    });
}

#[test]
fn the_descriptor_wakes_for_what_arrives_over_connections_that_come_and_go() {
    for count in [1, 2] {
        let (mut tcp, mut drives, listeners) = open(3 + count, count);
        let fd = tcp.fd();
        let only = (count == 1).then(|| tcp.sockets[0].as_ref().unwrap().as_raw_fd());
        assert_eq!(fd == only, count == 1, "an only connection is waited for itself");
        for _ in 0..3 {
            assert!(!wakes(tcp.fd(), MS));
            drives[0].write_all(b"reply").unwrap();
            assert!(wakes(tcp.fd(), 20 * S));
            assert_eq!(receive(&mut tcp, 0, 5), b"reply");
            assert!(!wakes(tcp.fd(), MS));
            // The end of a connection wakes too, until it is given up.
            reset(drives.remove(0));
            assert!(wakes(tcp.fd(), 20 * S));
            assert_eq!(breaks(&mut tcp, 0), Broken::Failed(libc::ECONNRESET));
            tcp.abandon(0, "it broke");
            assert!(!wakes(tcp.fd(), MS));
            tcp.look();
            assert_eq!(tcp.ready(), None);
            let there = if count == 1 { None } else { fd };
            assert_eq!(tcp.fd(), there, "an only connection that is gone has none");
            drives.insert(0, accept(&listeners[0]));
            assert_eq!(opened(&mut tcp), 0);
            assert_eq!(tcp.fd().is_some(), fd.is_some());
            assert!(count == 1 || tcp.fd() == fd, "that of several stays the same");
        }
    }
}

#[test]
fn a_wire_that_takes_no_more_says_how_much_it_took() {
    let (mut tcp, mut drives, _listeners) = open(6, 1);
    let pattern: Vec<u8> = (0..65_521).map(|k| (k % 251) as u8).collect();
    let mut taken = Vec::new();
    let mut short = 0;
    // The peer's buffer and ours, some MiB; the kernel moves bytes from one to the other meanwhile.
    let mut full = 0;
    while full < 100 {
        let begin = taken.len() % pattern.len();
        let (_, count) = tcp.send(0, &pattern[begin..]).unwrap();
        taken.extend_from_slice(&pattern[begin..begin + count]);
        short += usize::from(count > 0 && count < pattern.len() - begin);
        full += usize::from(count == 0);
    }
    assert!(short > 0, "never a short write in {} bytes", taken.len());
    let mut got = vec![0; taken.len()];
    drives[0].read_exact(&mut got).unwrap();
    assert!(got == taken);
}

#[test]
fn requests_and_replies_are_stamped_in_order_and_cut_where_the_room_ends() {
    let (mut tcp, mut drives, _listeners) = open(7, 1);
    // A request is stamped before it leaves, and a reply when it was taken in.
    let before = MonotonicClock::read();
    let (sent, _) = tcp.send(0, b"request").unwrap();
    let between = MonotonicClock::read();
    expect(&mut drives[0], b"request");
    drives[0].write_all(b"reply").unwrap();
    assert!(wakes(tcp.fd(), 20 * S));
    let (came, _) = tcp.receive(0, &mut [0; 8]).unwrap().unwrap();
    assert!(before <= sent && sent <= between && between < came && came <= MonotonicClock::read());
    // What does not fit the room comes next, and a room of nothing is no end.
    assert_eq!(tcp.receive(0, &mut [0; 8]), Ok(None));
    drives[0].write_all(b"abcdefgh").unwrap();
    assert!(wakes(tcp.fd(), 20 * S));
    assert_eq!(tcp.receive(0, &mut []), Ok(None));
    let mut room = [0; 5];
    assert!(matches!(tcp.receive(0, &mut room), Ok(Some((_, 5)))));
    assert_eq!(&room, b"abcde");
    assert!(matches!(tcp.receive(0, &mut room), Ok(Some((_, 3)))));
    assert_eq!(&room[..3], b"fgh");
    // Sending to a peer that is gone is an error and no signal.
    reset(drives.remove(0));
    assert!(wakes(tcp.fd(), 20 * S));
    assert_eq!(tcp.send(0, b"request"), Err(Broken::Failed(libc::ECONNRESET)));
    assert_eq!(tcp.send(0, b"request"), Err(Broken::Failed(libc::EPIPE)));
}

#[test]
fn what_is_not_open_is_absent() {
    let thread = LinkThread::start(None).unwrap();
    let mut tcp = Tcp::open(&thread, vec![patient(address(10, 10), silent())]).unwrap();
    for index in [0, 1, usize::MAX] {
        assert_eq!(tcp.send(index, b"request"), Err(Broken::Absent));
        assert_eq!(tcp.receive(index, &mut [0; 8]), Err(Broken::Absent));
        tcp.abandon(index, "it was never there");
    }
    tcp.look();
    assert_eq!((tcp.ready(), tcp.opened()), (None, None));
    // A carrier of nobody.
    let mut none = Tcp::open(&thread, Vec::new()).unwrap();
    none.look();
    assert_eq!((none.ready(), none.opened()), (None, None));
}

#[test]
fn a_peer_given_up_between_the_look_and_its_turn_is_absent_and_hurts_no_other() {
    let (mut tcp, mut drives, _listeners) = open(11, 2);
    drives.iter_mut().for_each(|drive| drive.write_all(b"x").unwrap());
    until("both", || {
        tcp.look();
        tcp.found == 2
    });
    tcp.abandon(0, "its bus says so");
    let mut results: Vec<_> =
        std::iter::from_fn(|| tcp.ready().map(|index| (index, tcp.receive(index, &mut [0; 8])))).collect();
    results.sort_by_key(|(index, _)| *index);
    assert_eq!(results[0], (0, Err(Broken::Absent)));
    assert!(matches!(results[1], (1, Ok(Some((_, 1))))), "{results:?}");
}
