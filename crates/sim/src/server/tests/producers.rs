//! Drives with several sockets and a clock of their own.

use super::*;
use crate::testing::Producer;

/// As `address`, of these tests only.
fn ip(x: u8, host: u8) -> Ipv4Addr {
    Ipv4Addr::new(127, 72, x, host)
}

/// The master's socket, and its connection from the same address.
fn master(x: u8) -> (UdpSocket, TcpStream) {
    let packets = UdpSocket::bind(Producer::packets(ip(x, 1))).unwrap();
    packets.set_read_timeout(Some(LONG)).unwrap();
    // Of 127.0.0.0/8 the kernel takes 127.0.0.1 to reach another one.
    use nix::sys::socket::{AddressFamily, SockFlag, SockType, SockaddrIn, bind, connect, socket};
    use std::os::fd::AsRawFd;
    let stream = socket(AddressFamily::Inet, SockType::Stream, SockFlag::SOCK_CLOEXEC, None).unwrap();
    bind(stream.as_raw_fd(), &SockaddrIn::from(SocketAddrV4::new(ip(x, 1), 0))).unwrap();
    connect(stream.as_raw_fd(), &SockaddrIn::from(Producer::stream(ip(x, 10)))).unwrap();
    let stream = TcpStream::from(stream);
    stream.set_read_timeout(Some(LONG)).unwrap();
    (packets, stream)
}

/// Has the connection opened, and the drive speak.
fn open(stream: &mut TcpStream) {
    stream.write_all(b"O").unwrap();
    let mut byte = [0];
    stream.read_exact(&mut byte).unwrap();
    assert_eq!(byte, *b"o");
}

#[test]
fn a_drive_speaks_by_itself_and_takes_what_it_is_fed() {
    let server = serve(Producer::new(ip(20, 10)).patient());
    let (packets, mut stream) = master(20);
    open(&mut stream);
    let mut byte = [0];
    for count in 1..=200_u8 {
        let (length, from) = packets.recv_from(&mut byte).unwrap();
        assert_eq!((length, from, byte[0]), (1, Producer::packets(ip(20, 10)).into(), count));
        packets.send_to(&[1], Producer::packets(ip(20, 10))).unwrap();
    }
    // Another socket of it, at the address of the stream: what it sent by itself meanwhile comes first.
    packets.send_to(&[77], Producer::stream(ip(20, 10))).unwrap();
    until("the answer", || {
        let (_, from) = packets.recv_from(&mut byte).unwrap();
        (byte[0], from) == (77, Producer::stream(ip(20, 10)).into())
    });
    until("all that it was fed", || {
        server
            .stats()
            .iter()
            .any(|stats| (stats.address, stats.received) == (Producer::packets(ip(20, 10)), 200))
    });
    let stats = server.stop();
    let of = |address| stats.iter().filter(move |stats| stats.address == address);
    let packets: Vec<_> = of(Producer::packets(ip(20, 10))).collect();
    assert_eq!((packets.len(), packets[0].received, packets[0].unsent), (1, 200, 0));
    assert!(packets[0].answered >= 200, "{packets:?}");
    assert_eq!(of(Producer::stream(ip(20, 10))).map(|stats| stats.answered).collect::<Vec<_>>(), [1, 1]);
}

#[test]
fn one_that_is_not_fed_is_silent_and_ends_its_connection_by_itself() {
    let server = serve(Producer::new(ip(24, 10)));
    let (packets, mut stream) = master(24);
    open(&mut stream);
    assert_eq!(stream.read(&mut [0]).unwrap(), 0);
    packets.set_nonblocking(true).unwrap();
    while packets.recv(&mut [0]).is_ok() {}
    thread::sleep(Duration::from_millis(20));
    assert_eq!(packets.recv(&mut [0]).unwrap_err().kind(), io::ErrorKind::WouldBlock);
    let stats = server.stop();
    let sent = stats.iter().find(|stats| stats.address == Producer::packets(ip(24, 10))).unwrap();
    assert!((1..=Producer::WATCHDOG_NS / Producer::EVERY_NS + 1).contains(&sent.answered), "{sent:?}");
}

#[test]
fn hundreds_of_starts_and_ends_of_a_speaking_drive_do_not_hang() {
    for round in 0..300 {
        let server = serve(Producer::new(ip(23, 10)));
        let (_packets, mut stream) = master(23);
        stream.write_all(b"O").unwrap();
        if round % 2 == 0 {
            stream.read_exact(&mut [0]).unwrap();
        }
        drop(server);
    }
}
