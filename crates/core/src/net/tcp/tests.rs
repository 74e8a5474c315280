//! Connections of this host.

use super::*;
use std::io::Write;
use std::net::{SocketAddrV4, TcpListener, TcpStream};

use nix::sys::socket::{getsockopt, sockopt};

use crate::net::link::tests::{accept, breaks, listener, opened, patient, receive, reset, silent, wakes};
use crate::net::link::{REPEATED_US, TCP_RTO_MIN_US};
use crate::time::{MS, S};

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
