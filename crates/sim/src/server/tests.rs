//! Drives on real sockets; lines are tested with their own.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};

use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::socket::{setsockopt, sockopt};

use super::sockets::{CONNECTIONS, Connection, UNREAD, prepare, token, unbound};
use super::*;
use crate::FaultPlan;
use crate::world::tests::{Echo, Line};
use crate::{Carrier, SimDrive};
use fieldbeat_core::time::MS;
use fieldbeat_testing::until;
use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

/// Nothing takes this long, however busy the host.
const LONG: Duration = Duration::from_secs(60);

/// The tests of this file own 127.72.x.0/24, one x each.
fn address(x: u8, host: u8) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(127, 72, x, host), 49360)
}

fn echo(address: SocketAddrV4, faults: FaultPlan) -> Box<dyn SimDrive> {
    Box::new(Echo { address, faults, answered: 0 })
}

fn start(x: u8, hosts: std::ops::Range<u8>, faults: &FaultPlan) -> io::Result<SimServer> {
    let drives = hosts.map(|host| echo(address(x, host), faults.clone()));
    SimServer::start(drives.collect::<Vec<_>>(), ServerOptions::default())
}

fn client(x: u8, timeout: Duration) -> UdpSocket {
    let socket = UdpSocket::bind((Ipv4Addr::new(127, 72, x, 1), 41136)).unwrap();
    socket.set_read_timeout(Some(timeout)).unwrap();
    socket
}

#[test]
fn an_answer_takes_its_time() {
    let server = start(3, 10..12, &FaultPlan { answer_ns: 30 * MS, ..FaultPlan::default() }).unwrap();
    let client = client(3, LONG);
    let begin = Instant::now();
    client.send_to(&[1], address(3, 10)).unwrap();
    client.send_to(&[2], address(3, 11)).unwrap();
    for expected in [1, 2] {
        let mut bytes = [0; 8];
        client.recv_from(&mut bytes).unwrap();
        assert_eq!(bytes[0], expected);
        // Later on a busy host, never sooner.
        assert!(begin.elapsed() >= Duration::from_millis(30));
    }
    drop(server);
}

#[test]
fn a_right_that_is_missing_is_reported_and_serves_all_the_same() {
    let options = ServerOptions { core: Some(usize::MAX), priority: Some(1) };
    let server = SimServer::start(vec![echo(address(5, 10), FaultPlan::default())], options).unwrap();
    assert!(!server.realtime());
    let client = client(5, LONG);
    client.send_to(&[1], address(5, 10)).unwrap();
    assert_eq!(client.recv(&mut [0; 8]).unwrap(), 2);
}

fn line(x: u8, faults: FaultPlan) -> Line {
    Line { most: 4, ..Line::new(address(x, 10), faults) }
}

fn serve(drive: impl SimDrive + 'static) -> SimServer {
    SimServer::start(vec![Box::new(drive) as Box<dyn SimDrive>], ServerOptions::default()).unwrap()
}

fn connect(x: u8) -> TcpStream {
    let socket = TcpStream::connect(address(x, 10)).unwrap();
    socket.set_read_timeout(Some(LONG)).unwrap();
    socket.set_nodelay(true).unwrap();
    socket
}

/// Asks with a number; the number of the answer, and how many requests the drive received.
fn ask(socket: &mut TcpStream, number: u8) -> io::Result<[u8; 2]> {
    socket.write_all(&[number, !number])?;
    let mut answer = [0; 2];
    socket.read_exact(&mut answer).map(|()| answer)
}

#[test]
fn who_is_refused_is_reset_and_a_place_that_is_left_is_free() {
    // A drive that never refuses has a bound all the same.
    for (x, most, places) in [(7, 4, 4), (8, usize::MAX, CONNECTIONS)] {
        let server = serve(Line { most, ..line(x, FaultPlan::default()) });
        let mut sockets: Vec<_> = (0..places).map(|_| connect(x)).collect();
        for (n, socket) in (0..).zip(&mut sockets) {
            assert_eq!(ask(socket, n).unwrap(), [n, n + 1]);
        }
        let mut refused = connect(x);
        assert_eq!(refused.read(&mut [0; 8]).unwrap_err().kind(), io::ErrorKind::ConnectionReset);
        let open = places as u64;
        let counted = ConnectionStats { accepted: open, refused: 1, open };
        until("it is counted", || server.stats()[0].connections == counted);
        sockets.pop();
        until("the place is free", || server.stats()[0].connections.open == open - 1);
        assert_eq!(ask(&mut connect(x), 2).unwrap(), [2, places as u8 + 1]);
        assert_eq!(ask(&mut sockets[0], 3).unwrap(), [3, places as u8 + 2]);
    }
}

#[test]
fn a_drive_hangs_up_behind_its_answer() {
    let faults = FaultPlan { answer_ns: 20 * MS, split: 1.0, ..FaultPlan::default() };
    let server = serve(line(9, faults));
    let mut socket = connect(9);
    socket.write_all(&[5, 5]).unwrap();
    let mut answer = [0; 2];
    socket.read_exact(&mut answer).unwrap();
    assert_eq!(answer, [5, 1]);
    assert_eq!(socket.read(&mut [0; 8]).unwrap(), 0);
    until("it knows", || server.stats()[0].connections.open == 0);
}

#[test]
fn a_restart_resets_the_connections_and_the_drive_lets_new_ones_in() {
    let server = serve(line(10, FaultPlan { seed: 1, restart: 0.1, ..FaultPlan::default() }));
    let mut bystander = connect(10);
    assert_eq!(ask(&mut bystander, 1).unwrap(), [1, 1]);
    let mut socket = connect(10);
    let error = (0..200).find_map(|_| ask(&mut socket, 2).err()).expect("one request in ten");
    assert_eq!(error.kind(), io::ErrorKind::ConnectionReset);
    assert_eq!(bystander.read(&mut [0; 8]).unwrap_err().kind(), io::ErrorKind::ConnectionReset);
    until("it is counted", || server.stats()[0].injected.restarts == 1);
    // By chance it restarts again at the first one.
    until("it serves anew", || ask(&mut connect(10), 3).is_ok_and(|answer| answer == [3, 1]));
}

#[test]
fn faults_on_a_stream_are_injected_counted_and_accounted_for() {
    let faults = FaultPlan { seed: 2, split: 0.3, cut: 0.1, wrong_id: 0.1, ..FaultPlan::default() };
    let server = serve(line(11, faults));
    let (mut socket, mut whole, mut cut, mut wrong) = (connect(11), 0, 0, 0);
    for _ in 0..250 {
        socket.write_all(&[1, !1]).unwrap();
        let mut answer = Vec::new();
        while answer.len() < 2 {
            let mut byte = [0];
            match socket.read(&mut byte).unwrap() {
                0 => break,
                _ => answer.push(byte[0]),
            }
        }
        wrong += u64::from(answer[0] == 0x81);
        match answer.len() {
            2 => whole += 1,
            _ => {
                cut += 1;
                socket = connect(11);
            }
        }
    }
    until("all is reported", || server.stats()[0].connections.open == 1);
    let stats = server.stop()[0];
    let i = stats.injected;
    assert_eq!((i.cut, i.wrong_id, stats.unsent), (cut, wrong, 0), "{stats:?}");
    assert!(whole > 200 && cut > 5 && wrong > 5 && i.split > 100, "{stats:?}");
    // Each byte of a split one counts as a piece of its own.
    assert!(stats.received > 250 - cut && stats.answered > 250, "{stats:?}");
    assert_eq!(stats.connections.accepted, 1 + cut);
}

#[test]
fn who_never_reads_loses_his_connection_and_nobody_else_does() {
    let server = serve(Line { padding: 32 * 1_024, ..line(12, FaultPlan::default()) });
    let (mut idle, mut living) = (connect(12), connect(12));
    until("both are in", || server.stats()[0].connections.open == 2);
    // More than both socket buffers can ever hold; refused as soon as it is gone.
    let _ = (0..1_000).try_for_each(|_| idle.write_all(&[1, !1]));
    until("it is gone", || server.stats()[0].connections.open == 1);
    assert_eq!(ask(&mut living, 2).unwrap()[0], 2);
    assert!(server.stop()[0].unsent > 0);
}

#[test]
fn what_the_kernel_does_not_take_is_kept_in_order_up_to_a_bound() {
    let listener = TcpListener::bind(address(13, 10)).unwrap();
    let mut reader = connect(13);
    let (socket, SocketAddr::V4(peer)) = listener.accept().unwrap() else { unreachable!() };
    prepare(&socket).unwrap();
    setsockopt(&socket, sockopt::SndBuf, &4_096).unwrap();
    let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC).unwrap();
    epoll.add(&socket, EpollEvent::new(EpollFlags::EPOLLIN, 0)).unwrap();
    let mut connection = Connection { number: 7, peer, socket, unsent: Vec::new() };
    let mut numbers = (0..10_000_000_u32).map(u32::to_be_bytes);
    let mut sent = Vec::new();
    let mut send = |connection: &mut Connection, sent: &mut Vec<u8>| {
        let piece: Vec<u8> = numbers.by_ref().take(256).flatten().collect();
        let taken = connection.send(&epoll, 0, &piece).is_ok();
        if taken {
            sent.extend(piece);
        }
        taken
    };
    while connection.unsent.is_empty() {
        assert!(send(&mut connection, &mut sent));
    }
    while send(&mut connection, &mut sent) {}
    assert!((UNREAD - 1_024..=UNREAD).contains(&connection.unsent.len()));

    let mut got = vec![0; sent.len()];
    let mut place = 0;
    while place < got.len() {
        let mut events = [EpollEvent::empty()];
        if epoll.wait(&mut events, EpollTimeout::ZERO) == Ok(1) {
            assert_eq!((events[0].events(), events[0].data()), (EpollFlags::EPOLLOUT, token(0, 7)));
            connection.go_on(&epoll, 0).unwrap();
        }
        place += reader.read(&mut got[place..]).unwrap();
    }
    assert!(got == sent && connection.unsent.is_empty());
    // It waits for nothing more.
    assert_eq!(epoll.wait(&mut [EpollEvent::empty()], EpollTimeout::ZERO), Ok(0));
}

#[test]
fn an_address_in_use_is_named_with_the_remedy_and_given_back() {
    let named = |error: io::Error, address: &str, remedy: &str| {
        assert_eq!(error.kind(), io::ErrorKind::AddrInUse);
        assert!(error.to_string().contains(address) && error.to_string().contains(remedy), "{error}");
    };
    let first = start(4, 10..12, &FaultPlan::default()).unwrap();
    named(start(4, 11..13, &FaultPlan::default()).unwrap_err(), "127.72.4.11:49360", "");
    drop(first);
    drop(start(4, 10..13, &FaultPlan::default()).unwrap());
    // One that listens.
    let first = serve(line(14, FaultPlan::default()));
    let twin = || Box::new(line(14, FaultPlan::default())) as Box<dyn SimDrive>;
    for drives in [vec![twin()], vec![twin(), twin()]] {
        let error = SimServer::start(drives, ServerOptions::default()).unwrap_err();
        named(error, "127.72.14.10:49360", "ss -tlpn");
    }
    // Its connections linger in the kernel; the address is free all the same.
    let mut socket = connect(14);
    assert_eq!(ask(&mut socket, 1).unwrap(), [1, 1]);
    drop(first);
    drop(serve(line(14, FaultPlan::default())));
}

#[test]
fn a_port_without_rights_is_reported_as_such() {
    let text = |port, carrier| {
        let address = SocketAddrV4::new(Ipv4Addr::LOCALHOST, port);
        unbound(address, carrier, io::ErrorKind::PermissionDenied.into()).to_string()
    };
    assert!(text(502, Carrier::Stream).contains("run as root or give the drive a port like 1502"));
    assert!(!text(1_502, Carrier::Stream).contains("root"));
}

mod producers;
