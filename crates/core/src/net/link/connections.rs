//! The connections of one carrier on the link thread: their sockets, each opened, initialised, handed to the loop,
//! taken back and closed; or kept, for a session. So is a serial port. [`Connection`] says when to do what.

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::sync::Arc;

use nix::errno::Errno;
use nix::sys::epoll::{Epoll, EpollEvent, EpollFlags};
use nix::sys::socket::{
    AddressFamily, MsgFlags, SockFlag, SockType, SockaddrIn, bind, connect, getsockopt, recv, send,
    setsockopt, socket, sockopt,
};
use rtrb::{Consumer, Producer};

use super::connection::{Action, Connection};
use super::thread::{Bell, Duty, Hand, LinkThread};
use crate::net::serial::SerialLine;
use crate::net::stream::{Broken, LinkNotes, StreamPeer};
use crate::net::tty::Descriptor;
use crate::net::{local, set_option, tty};
use crate::rt::{self, MonotonicClock, Regions};
use crate::time::{MS, Time};

/// An idle connection gets its first keep-alive probe after so long, s, and further ones at the same interval. The
/// loop exchanges something on each connection all the while; this is for one whose drive is only probed, or not
/// due for long.
const KEEPALIVE_S: u32 = 1;

/// The number of probes without an answer that end it, if TCP_USER_TIMEOUT has not done so before.
const KEEPALIVE_COUNT: u32 = 3;

/// A lost request is repeated after so long at the earliest, µs, instead of 200 ms: with one request under way nothing
/// follows it that would show the loss sooner. A lost reply is repeated by the peer's host, as that is set.
pub(in crate::net) const REPEATED_US: libc::c_int = 20_000;

/// The option for that, from Linux 6.15 on (linux/tcp.h). Without it the host's own least time remains.
pub(in crate::net) const TCP_RTO_MIN_US: libc::c_int = 45;

/// A connection that is ready, on its way to the loop.
#[derive(Debug)]
pub(in crate::net) struct Opened {
    pub index: usize,
    pub socket: Descriptor,
}

/// A connection that the loop gave up, on its way back.
#[derive(Debug)]
pub(in crate::net) struct GivenBack {
    pub index: usize,
    pub socket: Descriptor,
    pub why: &'static str,
}

/// The loop's side of a carrier. Its fields are dropped in order: the eventfd is written after the rings are gone,
/// so that the thread finds them abandoned and closes what it still has of this carrier.
#[derive(Debug)]
pub(in crate::net) struct Ends {
    pub opened: Consumer<Opened>,
    pub given_back: Producer<GivenBack>,
    pub notes: LinkNotes,
    /// The memory of the rings.
    pub regions: Regions,
    pub bell: Bell,
}

impl LinkThread {
    /// Begins to open connections to `peers`, and keeps them open until the ends are dropped.
    pub fn carry(self: &Arc<Self>, peers: Vec<StreamPeer>) -> Ends {
        let (now, notes) = (MonotonicClock::read(), LinkNotes::new(peers.len()));
        let new = |(index, peer)| Line::new(Connection::new(now, peer, notes.clone(), index), None);
        let lines = peers.into_iter().enumerate().map(new).collect();
        self.carry_lines(lines, notes)
    }

    /// The same for serial port `path`.
    pub fn carry_port(self: &Arc<Self>, path: &str, line: SerialLine) -> Ends {
        let notes = LinkNotes::new(1);
        let connection = Connection::of_port(MonotonicClock::read(), path, notes.clone());
        self.carry_lines(vec![Line::new(connection, Some((path.to_owned(), line)))], notes)
    }

    fn carry_lines(self: &Arc<Self>, lines: Vec<Line>, notes: LinkNotes) -> Ends {
        let mut regions = Regions::new();
        // Each connection is in one place at a time, so that neither ring is ever full.
        let (opened, ready) = rt::memory::ring(lines.len(), &mut regions);
        let (given_back, back) = rt::memory::ring(lines.len(), &mut regions);
        // What the loop touches to wake the thread.
        regions.add(&**self);
        regions.add(&**self.shared());
        self.add(Box::new(Connections { lines, opened, back }));
        Ends { opened: ready, given_back, notes, regions, bell: Bell::new(self) }
    }
}

/// The thread's side of a carrier of connections.
#[derive(Debug)]
struct Connections {
    lines: Vec<Line>,
    opened: Producer<Opened>,
    back: Consumer<GivenBack>,
}

impl Duty for Connections {
    fn next_due(&self) -> Option<Time> {
        self.lines.iter().filter_map(|line| line.connection.next_due()).min()
    }

    fn happened(&mut self, index: usize, events: EpollFlags, hand: &mut Hand<'_>) {
        let Some(line) = self.lines.get_mut(index) else { return };
        let now = MonotonicClock::read();
        let action = line.happened(now, events, hand.bytes);
        self.follow(index, action, now, hand);
    }

    /// Handles returned connections, sessions if they were woken, and what is due. False if the carrier is gone.
    fn turn(&mut self, woken: bool, hand: &mut Hand<'_>) -> bool {
        let now = MonotonicClock::read();
        // Read first: connections returned before it disappeared are still closed in order.
        let gone = self.back.is_abandoned();
        while let Ok(GivenBack { index, socket, why }) = self.back.pop() {
            let line = &mut self.lines[index];
            line.socket = Some(socket);
            let action = line.connection.given_back(now, why);
            self.follow(index, action, now, hand);
        }
        if !gone {
            for index in 0..self.lines.len() {
                if woken {
                    let action = self.lines[index].connection.run(now);
                    self.follow(index, action, now, hand);
                }
                let action = self.lines[index].connection.poll(now);
                self.follow(index, action, now, hand);
            }
        }
        !gone
    }
}

impl Connections {
    /// Carries out the actions until there is nothing more to do now.
    fn follow(&mut self, index: usize, mut action: Action, now: Time, hand: &Hand<'_>) {
        let (epoll, token) = (hand.epoll, hand.token(index));
        let line = &mut self.lines[index];
        loop {
            action = match action {
                Action::Wait => return,
                Action::Connect => line.connect(now, epoll, token),
                Action::Send => line.send(now, epoll, token),
                Action::Close => return line.close(),
                Action::HandOver => {
                    if let Some(socket) = line.socket.take() {
                        // Only the loop watches it from now on. A port was not watched here.
                        let _ = epoll.delete(&socket);
                        // Never full: see `carry`.
                        let _ = self.opened.push(Opened { index, socket });
                    }
                    return;
                }
            }
        }
    }
}

/// One connection with its socket.
#[derive(Debug)]
struct Line {
    connection: Connection,
    /// A serial port with its settings.
    port: Option<(String, SerialLine)>,
    /// While it is this thread's.
    socket: Option<Descriptor>,
    /// The events waited for on it.
    interest: EpollFlags,
}

impl Line {
    fn new(connection: Connection, port: Option<(String, SerialLine)>) -> Line {
        Line { connection, port, socket: None, interest: EpollFlags::empty() }
    }

    fn connect(&mut self, now: Time, epoll: &Epoll, token: u64) -> Action {
        if let Some((path, line)) = &self.port {
            return match open_port(path, line) {
                Ok(port) => {
                    self.socket = Some(port);
                    self.connection.connected(now)
                }
                // By now: a driver may have taken its time.
                Err(error) => self.connection.refused(MonotonicClock::read(), error.to_string()),
            };
        }
        match self.begin(epoll, token) {
            Ok(true) => self.connection.connected(now),
            Ok(false) => Action::Wait,
            Err(errno) => self.connection.failed(now, Broken::Failed(errno as i32)),
        }
    }

    /// Opens a socket that begins to connect; true if it is connected already.
    fn begin(&mut self, epoll: &Epoll, token: u64) -> nix::Result<bool> {
        let peer = self.connection.peer();
        let socket = self.socket.insert(open(peer)?.into());
        let connected = match connect(socket.as_raw_fd(), &SockaddrIn::from(peer.address)) {
            Ok(()) => true,
            Err(Errno::EINPROGRESS) => false,
            Err(errno) => return Err(errno),
        };
        self.interest = if connected { EpollFlags::EPOLLIN } else { EpollFlags::EPOLLOUT };
        epoll.add(socket, EpollEvent::new(self.interest, token))?;
        Ok(connected)
    }

    fn happened(&mut self, now: Time, events: EpollFlags, bytes: &mut [u8]) -> Action {
        let Some(socket) = &self.socket else { return Action::Wait };
        if self.connection.is_connecting() {
            return match getsockopt(socket, sockopt::SocketError) {
                Ok(0) => self.connection.connected(now),
                Ok(errno) => self.connection.failed(now, Broken::Failed(errno)),
                Err(errno) => self.connection.failed(now, Broken::Failed(errno as i32)),
            };
        }
        if events == EpollFlags::EPOLLOUT {
            // With nothing to send, as when the peer has to send first, this ends the wait for room.
            return Action::Send;
        }
        match recv(socket.as_raw_fd(), bytes, MsgFlags::MSG_DONTWAIT) {
            Ok(0) => self.connection.failed(now, Broken::Closed),
            Ok(count) => self.connection.received(now, &bytes[..count]),
            Err(Errno::EAGAIN | Errno::EINTR) => Action::Wait,
            Err(errno) => self.connection.failed(now, Broken::Failed(errno as i32)),
        }
    }

    /// Sends what the wire takes, and waits for answers, and for room as long as something is left.
    fn send(&mut self, now: Time, epoll: &Epoll, token: u64) -> Action {
        let Some(socket) = &self.socket else { return Action::Wait };
        let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL;
        let (action, interest) = match send(socket.as_raw_fd(), self.connection.to_send(), flags) {
            Ok(count) => (self.connection.sent(now, count), EpollFlags::EPOLLIN),
            Err(Errno::EAGAIN | Errno::EINTR) => (Action::Wait, EpollFlags::EPOLLIN | EpollFlags::EPOLLOUT),
            Err(errno) => return self.connection.failed(now, Broken::Failed(errno as i32)),
        };
        if interest != self.interest {
            self.interest = interest;
            if let Err(errno) = epoll.modify(socket, &mut EpollEvent::new(interest, token)) {
                return self.connection.failed(now, Broken::Failed(errno as i32));
            }
        }
        action
    }

    /// Closes the socket with a reset. An orderly end would go on delivering earlier bytes: an outdated setpoint,
    /// once the cable is back.
    fn close(&mut self) {
        let Some(socket) = self.socket.take() else { return };
        if let Some((path, _)) = &self.port {
            if local::name(path).is_none() {
                // Otherwise the driver's close waits for what is not sent, up to 30 s.
                tty::flush(&socket);
            }
        } else {
            // Without it the end is an orderly one, and TCP_USER_TIMEOUT bounds it.
            let _ = setsockopt(&socket, sockopt::Linger, &libc::linger { l_onoff: 1, l_linger: 0 });
        }
    }
}

/// A socket that never waits, with what a cyclic exchange needs.
fn open(peer: &StreamPeer) -> nix::Result<OwnedFd> {
    let flags = SockFlag::SOCK_NONBLOCK | SockFlag::SOCK_CLOEXEC;
    let socket = socket(AddressFamily::Inet, SockType::Stream, flags, None)?;
    // A request leaves at once, not when the one before it is acknowledged (Nagle).
    setsockopt(&socket, sockopt::TcpNoDelay, &true)?;
    setsockopt(&socket, sockopt::KeepAlive, &true)?;
    setsockopt(&socket, sockopt::TcpKeepIdle, &KEEPALIVE_S)?;
    setsockopt(&socket, sockopt::TcpKeepInterval, &KEEPALIVE_S)?;
    setsockopt(&socket, sockopt::TcpKeepCount, &KEEPALIVE_COUNT)?;
    // A cable that is out for longer breaks the connection, instead of a quarter of an hour later (tcp(7)). 0 would
    // mean exactly that.
    let unacknowledged_ms = u32::try_from(peer.unacknowledged_ns / MS).unwrap_or(u32::MAX).max(1);
    setsockopt(&socket, sockopt::TcpUserTimeout, &unacknowledged_ms)?;
    // An older kernel refuses the option: it is none the worse for that.
    let _ = set_option(&socket, libc::IPPROTO_TCP, TCP_RTO_MIN_US, REPEATED_US);
    if let Some(own) = peer.bind {
        // The port is chosen when the peer is known: many connections share the host's ports (ip(7)).
        setsockopt(&socket, sockopt::IpBindAddressNoPort, &true)?;
        bind(socket.as_raw_fd(), &SockaddrIn::from(SocketAddrV4::new(own, 0)))?;
    }
    Ok(socket)
}

fn open_port(path: &str, line: &SerialLine) -> io::Result<Descriptor> {
    match local::name(path) {
        Some(name) => local_wire(name).map(Descriptor::from),
        None => tty::open(path, line).map(Descriptor::of_port),
    }
}

/// The address of a simulated wire of this host: no rights, nothing in the file system.
pub fn local_address(name: &str) -> io::Result<SocketAddr> {
    SocketAddr::from_abstract_name(format!("fieldbeat-serial/{name}"))
}

/// A connection to a simulated wire.
fn local_wire(name: &str) -> io::Result<OwnedFd> {
    let connected = local_address(name).and_then(|address| UnixStream::connect_addr(&address));
    let stream = connected.map_err(|error| match error.raw_os_error() {
        Some(libc::ECONNREFUSED) => {
            let message = format!("nobody simulates the wire {}{name}: start `fieldbeat sim`", local::PREFIX);
            io::Error::new(error.kind(), message)
        }
        _ => error,
    })?;
    stream.set_nonblocking(true)?;
    Ok(stream.into())
}
