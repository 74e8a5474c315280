//! The sockets of a drive: datagram sockets, and a listening one with its connections.

use std::io::{self, Write};
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::os::fd::AsRawFd;
use std::sync::Mutex;

use nix::sys::epoll::{Epoll, EpollEvent, EpollFlags};
use nix::sys::socket::{AddressFamily, SockFlag, SockType, SockaddrIn, setsockopt, socket, sockopt};

use super::BusStats;
use crate::Carrier;
use crate::drives::Station;
use crate::fault::wrong_port;
use fieldbeat_core::errors::no_descriptor;
use fieldbeat_core::net::set_option;
use fieldbeat_core::time::Time;

/// The most that the peer of a connection leaves unread beyond what the kernel holds, bytes; then the connection ends.
pub(super) const UNREAD: usize = 65_536;
/// Connections per drive; more are refused, whatever the drive decides. Sixty drives then fit into the usual 1024
/// descriptors.
pub(super) const CONNECTIONS: usize = 16;
/// A peer that is silent for so long gets a keep-alive probe, s, ...
const KEEP_IDLE: u32 = 10;
/// ... so many of them, each after so many seconds; then its connection ends, as with real drives.
const KEEP_PROBES: u32 = 3;

/// One socket of a drive.
pub(super) enum Socket {
    Datagrams {
        socket: UdpSocket,
        /// The source of replies with a wrong identity, if there are any.
        wrong: Option<UdpSocket>,
        /// For what is sent to everybody at its port. Each drive has its own, and the kernel gives each a copy.
        everybody: Option<UdpSocket>,
    },
    Stream {
        listener: TcpListener,
        connections: Vec<Connection>,
        /// The number of the newest connection.
        newest: u32,
    },
}

/// One connection to a drive.
pub(super) struct Connection {
    pub(super) number: u32,
    pub(super) peer: SocketAddrV4,
    pub(super) socket: TcpStream,
    /// What the peer left unread.
    pub(super) unsent: Vec<u8>,
}

/// The number of no connection: the source of new ones.
pub(super) const LISTENER: u32 = 0;

/// The number of the socket for what is sent to everybody.
pub(super) const EVERYBODY: u32 = 1;

/// Several drives behind one descriptor of this thread: a segment or a serial wire.
pub(super) trait SharedBus: Send {
    /// No counts yet, with its name.
    fn stats(&self) -> BusStats;

    fn watch(&self, epoll: &Epoll, token: u64) -> nix::Result<()>;

    /// When the next thing happens.
    fn next_due(&self) -> Option<Time>;

    /// The descriptor with this number can be read: [`LISTENER`] is the one that it watches itself, and `token` is the
    /// event of one more.
    fn ready(&mut self, number: u32, room: &mut [u8], epoll: &Epoll, token: u64, stats: &Mutex<BusStats>);

    /// Everything that is due by now.
    fn run_due(&mut self, stats: &Mutex<BusStats>);
}

/// The event token of connection `number` of station `index`.
pub(super) fn token(index: usize, number: u32) -> u64 {
    u64::from(number) << 32 | index as u64
}

impl Socket {
    /// `of_all`: it also takes what is sent to everybody. Another program may have that port for itself; the drive is
    /// found by its address only then.
    pub(super) fn open(station: &Station, of_all: bool) -> io::Result<Socket> {
        let address = station.address;
        Ok(match station.carrier {
            Carrier::Datagrams => Socket::Datagrams {
                wrong: station.injector.mislabels().then(|| bind(wrong_port(address))).transpose()?,
                socket: bind(address)?,
                everybody: of_all.then(|| bind_to_all(address.port()).ok()).flatten(),
            },
            Carrier::Stream => {
                Socket::Stream { listener: listen(address)?, connections: Vec::new(), newest: LISTENER }
            }
        })
    }

    pub(super) fn watch(&self, epoll: &Epoll, token: u64) -> nix::Result<()> {
        match self {
            Socket::Datagrams { socket, everybody, .. } => {
                if let Some(everybody) = everybody {
                    let token = token | u64::from(EVERYBODY) << 32;
                    epoll.add(everybody, EpollEvent::new(EpollFlags::EPOLLIN, token))?;
                }
                epoll.add(socket, EpollEvent::new(EpollFlags::EPOLLIN, token))
            }
            // Edge-triggered: a connection that cannot be accepted for lack of descriptors would wake up the thread
            // for ever.
            Socket::Stream { listener, .. } => {
                epoll.add(listener, EpollEvent::new(EpollFlags::EPOLLIN | EpollFlags::EPOLLET, token))
            }
        }
    }

    /// The most descriptors that it has.
    pub(super) fn descriptors(&self) -> usize {
        match self {
            Socket::Datagrams { .. } => 2,
            Socket::Stream { .. } => 1 + CONNECTIONS,
        }
    }

    pub(super) fn connections(&mut self) -> &mut [Connection] {
        match self {
            Socket::Datagrams { .. } => &mut [],
            Socket::Stream { connections, .. } => connections,
        }
    }

    pub(super) fn by_number(&mut self, number: u32) -> Option<&mut Connection> {
        self.connections().iter_mut().find(|connection| connection.number == number)
    }

    pub(super) fn by_peer(&mut self, peer: SocketAddrV4) -> Option<&mut Connection> {
        self.connections().iter_mut().find(|connection| connection.peer == peer)
    }

    /// Accepts a connection, if there is room and it is `wanted`.
    pub(super) fn accept(
        &mut self,
        index: usize,
        epoll: &Epoll,
        socket: TcpStream,
        peer: SocketAddrV4,
        wanted: impl FnOnce() -> bool,
    ) -> bool {
        let Socket::Stream { connections, newest, .. } = self else { return false };
        let number = newest.wrapping_add(1).max(1);
        let event = EpollEvent::new(EpollFlags::EPOLLIN, token(index, number));
        let accepted = connections.len() < CONNECTIONS
            && prepare(&socket).is_ok()
            && epoll.add(&socket, event).is_ok()
            && wanted();
        if accepted {
            *newest = number;
            connections.push(Connection { number, peer, socket, unsent: Vec::new() });
        } else {
            reset(socket);
        }
        accepted
    }

    /// Ends a connection, if there is one of that number; returns its peer.
    pub(super) fn end(&mut self, number: u32, farewell: Farewell) -> Option<SocketAddrV4> {
        let Socket::Stream { connections, .. } = self else { return None };
        let place = connections.iter().position(|connection| connection.number == number)?;
        let Connection { peer, socket, .. } = connections.swap_remove(place);
        if farewell == Farewell::Reset {
            reset(socket);
        }
        Some(peer)
    }
}

/// How a connection ends.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Farewell {
    /// After everything that was sent.
    Close,
    /// At once; nothing more arrives.
    Reset,
}

impl Connection {
    /// Hands `bytes` to the kernel, and keeps what it does not take.
    pub(super) fn send(&mut self, epoll: &Epoll, index: usize, bytes: &[u8]) -> io::Result<()> {
        let taken = if self.unsent.is_empty() { taken(self.socket.write(bytes))? } else { 0 };
        let rest = &bytes[taken..];
        if rest.is_empty() {
            return Ok(());
        }
        if self.unsent.len() + rest.len() > UNREAD {
            return Err(io::ErrorKind::OutOfMemory.into());
        }
        if self.unsent.is_empty() {
            self.watch(epoll, index, EpollFlags::EPOLLIN | EpollFlags::EPOLLOUT)?;
        }
        self.unsent.extend_from_slice(rest);
        Ok(())
    }

    /// Hands over what was kept.
    pub(super) fn go_on(&mut self, epoll: &Epoll, index: usize) -> io::Result<()> {
        let taken = taken(self.socket.write(&self.unsent))?;
        self.unsent.drain(..taken);
        if self.unsent.is_empty() {
            self.watch(epoll, index, EpollFlags::EPOLLIN)?;
        }
        Ok(())
    }

    fn watch(&self, epoll: &Epoll, index: usize, flags: EpollFlags) -> nix::Result<()> {
        epoll.modify(&self.socket, &mut EpollEvent::new(flags, token(index, self.number)))
    }
}

/// How much of it the kernel took.
fn taken(result: io::Result<usize>) -> io::Result<usize> {
    match result {
        Err(error) if not_now(&error) => Ok(0),
        other => other,
    }
}

pub(super) fn not_now(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted)
}

/// Closes `socket` so that its peer knows at once.
fn reset(socket: TcpStream) {
    // If this fails, the peer gets an ordinary end.
    let _ = setsockopt(&socket, sockopt::Linger, &libc::linger { l_onoff: 1, l_linger: 0 });
}

/// Prepares an accepted socket.
pub(super) fn prepare(socket: &TcpStream) -> io::Result<()> {
    socket.set_nonblocking(true)?;
    socket.set_nodelay(true)?;
    setsockopt(socket, sockopt::KeepAlive, &true)?;
    setsockopt(socket, sockopt::TcpKeepIdle, &KEEP_IDLE)?;
    setsockopt(socket, sockopt::TcpKeepInterval, &KEEP_IDLE)?;
    setsockopt(socket, sockopt::TcpKeepCount, &KEEP_PROBES)?;
    Ok(())
}

fn bind(address: SocketAddrV4) -> io::Result<UdpSocket> {
    UdpSocket::bind(address)
        .and_then(|socket| socket.set_nonblocking(true).map(|()| socket))
        .and_then(|socket| leaves_from(&socket, address).map(|()| socket))
        .map_err(|error| unbound(address, Carrier::Datagrams, error))
}

/// A socket that has what is sent to 255.255.255.255 at this port, next to others that have it, too.
fn bind_to_all(port: u16) -> io::Result<UdpSocket> {
    let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
    let socket = socket(AddressFamily::Inet, SockType::Datagram, flags, None)?;
    setsockopt(&socket, sockopt::ReuseAddr, &true)?;
    nix::sys::socket::bind(
        socket.as_raw_fd(),
        &SockaddrIn::from(SocketAddrV4::new(Ipv4Addr::BROADCAST, port)),
    )?;
    Ok(socket.into())
}

/// What it sends to a multicast group leaves by the interface of its own address (ip(7)).
fn leaves_from(socket: &UdpSocket, address: SocketAddrV4) -> io::Result<()> {
    let interface = libc::in_addr { s_addr: address.ip().to_bits().to_be() };
    set_option(socket, libc::IPPROTO_IP, libc::IP_MULTICAST_IF, interface)
}

fn listen(address: SocketAddrV4) -> io::Result<TcpListener> {
    TcpListener::bind(address)
        .and_then(|socket| socket.set_nonblocking(true).map(|()| socket))
        .map_err(|error| unbound(address, Carrier::Stream, error))
}

/// Why a drive has no socket, and the remedy.
pub(super) fn unbound(address: SocketAddrV4, carrier: Carrier, error: io::Error) -> io::Error {
    let remedy = match (error.kind(), carrier) {
        (io::ErrorKind::AddrInUse, Carrier::Datagrams) => {
            "another simulation serves this drive: end it (ss -ulpn shows which), or give the drive another \
             address"
        }
        (io::ErrorKind::AddrInUse, Carrier::Stream) => {
            "another simulation serves this drive: end it (ss -tlpn shows which), or give the drive another \
             address"
        }
        (io::ErrorKind::AddrNotAvailable, _) => {
            "a simulated drive runs on this computer: give it an address like 127.0.0.11, and its bus one to \
             bind to"
        }
        (io::ErrorKind::PermissionDenied, _) if address.port() < 1024 => {
            "ports below 1024 need rights: run as root or give the drive a port like 1502"
        }
        _ => no_descriptor(&error).unwrap_or("look at its address"),
    };
    io::Error::new(error.kind(), format!("cannot bind {address}: {error}; {remedy}"))
}
