//! The sockets of a drive: datagram sockets, and a listening one with its connections.

use std::io::{self, Write};
use std::net::{SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::os::fd::AsRawFd;

use nix::sys::epoll::{Epoll, EpollEvent, EpollFlags};
use nix::sys::socket::{setsockopt, sockopt};

use super::{ConnectionStats, DriveStats};
use crate::errors::no_descriptor;
use crate::rt::MonotonicClock;
use crate::sim::fault::{Injector, wrong_port};
use crate::sim::{Carrier, SimDrive, faults, sockets};

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
pub(super) struct Station {
    pub(super) address: SocketAddrV4,
    /// The index of the drive.
    pub(super) drive: usize,
    /// The number of this socket at its drive.
    pub(super) socket: usize,
    pub(super) injector: Injector,
    pub(super) door: Door,
}

/// The socket of a drive.
pub(super) enum Door {
    Datagrams {
        socket: UdpSocket,
        /// The source of replies with a wrong identity, if there are any.
        wrong: Option<UdpSocket>,
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
pub(super) const DOOR: u32 = 0;

/// The event token of connection `number` of station `index`.
pub(super) fn token(index: usize, number: u32) -> u64 {
    u64::from(number) << 32 | index as u64
}

impl Door {
    pub(super) fn open(address: SocketAddrV4, carrier: Carrier, wrong: bool) -> io::Result<Door> {
        match carrier {
            Carrier::Datagrams => Ok(Door::Datagrams {
                wrong: if wrong { Some(bind(wrong_port(address))?) } else { None },
                socket: bind(address)?,
            }),
            Carrier::Stream => {
                Ok(Door::Stream { listener: listen(address)?, connections: Vec::new(), newest: DOOR })
            }
        }
    }

    pub(super) fn watch(&self, epoll: &Epoll, token: u64) -> nix::Result<()> {
        match self {
            Door::Datagrams { socket, .. } => epoll.add(socket, EpollEvent::new(EpollFlags::EPOLLIN, token)),
            // Edge-triggered: a connection that cannot be accepted for lack of descriptors would wake up the thread
            // for ever.
            Door::Stream { listener, .. } => {
                epoll.add(listener, EpollEvent::new(EpollFlags::EPOLLIN | EpollFlags::EPOLLET, token))
            }
        }
    }

    /// The most descriptors that it has.
    pub(super) fn descriptors(&self) -> usize {
        match self {
            Door::Datagrams { .. } => 1,
            Door::Stream { .. } => 1 + CONNECTIONS,
        }
    }

    pub(super) fn connections(&mut self) -> &mut [Connection] {
        match self {
            Door::Datagrams { .. } => &mut [],
            Door::Stream { connections, .. } => connections,
        }
    }

    pub(super) fn by_number(&mut self, number: u32) -> Option<&mut Connection> {
        self.connections().iter_mut().find(|connection| connection.number == number)
    }

    pub(super) fn by_peer(&mut self, peer: SocketAddrV4) -> Option<&mut Connection> {
        self.connections().iter_mut().find(|connection| connection.peer == peer)
    }

    fn take(&mut self, number: u32) -> Option<Connection> {
        let Door::Stream { connections, .. } = self else { return None };
        let place = connections.iter().position(|connection| connection.number == number)?;
        Some(connections.swap_remove(place))
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

    fn end(self, farewell: Farewell) {
        if farewell == Farewell::Reset {
            reset(self.socket);
        }
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

impl Station {
    /// All sockets of a drive, by their numbers.
    pub(super) fn open(index: usize, drive: &dyn SimDrive) -> io::Result<Vec<Station>> {
        let open = |(socket, (carrier, address)): (usize, (Carrier, SocketAddrV4))| {
            let faults = faults(drive, socket);
            let door = Door::open(address, carrier, faults.wrong_id > 0.0)?;
            Ok(Station { address, drive: index, socket, injector: Injector::new(faults, carrier), door })
        };
        sockets(drive)?.into_iter().enumerate().map(open).collect()
    }

    pub(super) fn carrier(&self) -> Carrier {
        match self.door {
            Door::Datagrams { .. } => Carrier::Datagrams,
            Door::Stream { .. } => Carrier::Stream,
        }
    }

    pub(super) fn stats(&self) -> DriveStats {
        DriveStats {
            address: self.address,
            received: 0,
            answered: 0,
            unsent: 0,
            connections: ConnectionStats::default(),
            injected: self.injector.injected(),
        }
    }

    /// Whether data from `peer` reaches the drive: a connection may have ended meanwhile.
    pub(super) fn hears(&mut self, peer: SocketAddrV4) -> bool {
        matches!(self.door, Door::Datagrams { .. }) || self.door.by_peer(peer).is_some()
    }

    pub(super) fn end(&mut self, drive: &mut dyn SimDrive, number: u32, farewell: Farewell) {
        if let Some(connection) = self.door.take(number) {
            let peer = connection.peer;
            connection.end(farewell);
            drive.disconnected(MonotonicClock::read(), peer);
        }
    }

    /// Its drive restarts: its connections end.
    pub(super) fn end_all(&mut self, drive: &mut dyn SimDrive) {
        while let Some(number) = self.door.connections().first().map(|connection| connection.number) {
            self.end(drive, number, Farewell::Reset);
        }
    }

    /// Accepts one connection, if the drive accepts it.
    pub(super) fn welcome(
        &mut self,
        drive: &mut dyn SimDrive,
        index: usize,
        epoll: &Epoll,
        socket: TcpStream,
        peer: SocketAddrV4,
    ) -> bool {
        // The kernel has dropped it, and its event has not come yet.
        while let Some(number) = self.door.by_peer(peer).map(|old| old.number) {
            self.end(drive, number, Farewell::Close);
        }
        let Door::Stream { connections, newest, .. } = &mut self.door else { return false };
        let number = newest.wrapping_add(1).max(1);
        let event = EpollEvent::new(EpollFlags::EPOLLIN, token(index, number));
        let welcome = connections.len() < CONNECTIONS
            && prepare(&socket).is_ok()
            && epoll.add(&socket, event).is_ok()
            && drive.connect(MonotonicClock::read(), peer);
        if welcome {
            *newest = number;
            connections.push(Connection { number, peer, socket, unsent: Vec::new() });
        } else {
            reset(socket);
        }
        welcome
    }
}

fn bind(address: SocketAddrV4) -> io::Result<UdpSocket> {
    UdpSocket::bind(address)
        .and_then(|socket| socket.set_nonblocking(true).map(|()| socket))
        .and_then(|socket| leaves_from(&socket, address).map(|()| socket))
        .map_err(|error| unbound(address, Carrier::Datagrams, error))
}

/// What it sends to a multicast group leaves by the interface of its own address (ip(7)).
fn leaves_from(socket: &UdpSocket, address: SocketAddrV4) -> io::Result<()> {
    let interface = libc::in_addr { s_addr: address.ip().to_bits().to_be() };
    // SAFETY: the kernel reads one address.
    let refused = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::IPPROTO_IP,
            libc::IP_MULTICAST_IF,
            (&raw const interface).cast(),
            size_of_val(&interface) as libc::socklen_t,
        )
    };
    if refused < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
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
            "another simulation serves this drive: end it (ss -ulpn shows which), or give the drive another address"
        }
        (io::ErrorKind::AddrInUse, Carrier::Stream) => {
            "another simulation serves this drive: end it (ss -tlpn shows which), or give the drive another address"
        }
        (io::ErrorKind::AddrNotAvailable, _) => {
            "a simulated drive runs on this computer: give it an address like 127.0.0.11, and its bus one to bind to"
        }
        (io::ErrorKind::PermissionDenied, _) if address.port() < 1024 => {
            "ports below 1024 need rights: run as root or give the drive a port like 1502"
        }
        _ => no_descriptor(&error).unwrap_or("look at its address"),
    };
    io::Error::new(error.kind(), format!("cannot bind {address}: {error}; {remedy}"))
}
