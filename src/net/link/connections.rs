//! The connections of one carrier on the link thread: their sockets, each opened, initialised, handed to the loop,
//! taken back and closed; or kept, for a session. [`Connection`] says when to do what.

use std::mem::take;
use std::net::SocketAddrV4;
use std::os::fd::{AsRawFd, OwnedFd};
use std::sync::Arc;
use std::task::{Wake, Waker};

use nix::errno::Errno;
use nix::sys::epoll::{Epoll, EpollEvent, EpollFlags};
use nix::sys::socket::{
    AddressFamily, MsgFlags, SockFlag, SockType, SockaddrIn, bind, connect, getsockopt, recv, send,
    setsockopt, socket, sockopt,
};
use rtrb::{Consumer, Producer};

use super::connection::{Action, Connection};
use super::peer::{Peer, Target};
use super::pending::Pending;
use super::thread::{Bell, Duty, Hand, LinkThread, Shared};
use crate::net::session::Sessions;
use crate::net::stream::{Broken, LinkNotes};
use crate::rt::{self, MonotonicClock, Regions};
use crate::time::{MS, Time};

/// An idle connection gets its first keep-alive probe after so long, s, and further ones at the same interval. The
/// loop exchanges something on each connection all the while; this is for one whose drive is only probed, or not
/// due for long.
const KEEPALIVE_S: u32 = 1;

/// So many probes without an answer end it, if TCP_USER_TIMEOUT has not done so before.
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
    pub socket: OwnedFd,
}

/// A connection that the loop gave up, on its way back.
#[derive(Debug)]
pub(in crate::net) struct GivenBack {
    pub index: usize,
    pub socket: OwnedFd,
    pub why: &'static str,
}

/// The loop's side of a carrier. Its fields are dropped in order: the eventfd is written after the rings are gone,
/// so that the thread finds them abandoned and closes what it still has of this carrier.
#[derive(Debug)]
pub(in crate::net) struct Ends {
    pub opened: Consumer<Opened>,
    pub given_back: Producer<GivenBack>,
    pub notes: LinkNotes,
    /// Wake the sessions.
    pub wakers: Vec<Waker>,
    /// The memory of the rings.
    pub regions: Regions,
    pub bell: Bell,
}

impl LinkThread {
    /// Begins to open connections to `peers`, and keeps them open until the ends are dropped.
    pub fn carry(self: &Arc<Self>, peers: Vec<Peer>) -> Ends {
        // Each connection is in one place at a time, so that neither ring is ever full.
        let (count, mut regions) = (peers.len(), Regions::new());
        let (opened, ready) = rt::memory::ring(count, &mut regions);
        let (given_back, back) = rt::memory::ring(count, &mut regions);
        // What the loop touches to wake the thread.
        regions.add(&**self);
        regions.add(&**self.shared());
        let (now, notes) = (MonotonicClock::read(), LinkNotes::new(count));
        let posts: Vec<_> = peers.iter().map(|_| Arc::new(Post::new(self.shared()))).collect();
        posts.iter().for_each(|post| regions.add(&**post));
        let lines = peers.into_iter().zip(&posts).enumerate().map(|(index, (peer, post))| Line {
            connection: Connection::new(now, peer, notes.clone(), index),
            post: Arc::clone(post),
            socket: None,
            interest: EpollFlags::empty(),
        });
        self.add(Box::new(Connections { lines: lines.collect(), opened, back }));
        let wakers = posts.into_iter().map(Waker::from).collect();
        Ends { opened: ready, given_back, notes, wakers, regions, bell: Bell::new(self) }
    }
}

impl Ends {
    /// The loop's side of a carrier with sessions only.
    pub fn sessions(mut self) -> Sessions {
        let (wakers, regions) = (take(&mut self.wakers), take(&mut self.regions));
        Sessions::new(wakers, self.notes.clone(), self.bell.ended(), regions, Box::new(self))
    }
}

/// The post of one session: wakes the thread for it.
#[derive(Debug)]
struct Post {
    pending: Pending,
    /// Not the thread itself: who may post something does not keep it alive.
    shared: Arc<Shared>,
}

impl Post {
    fn new(shared: &Arc<Shared>) -> Post {
        Post { pending: Pending::new(), shared: Arc::clone(shared) }
    }
}

impl Wake for Post {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        if self.pending.set() {
            self.shared.wake_up();
        }
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

    /// Handles returned connections, sessions that were woken, and what is due. False if the carrier is gone.
    fn turn(&mut self, hand: &mut Hand<'_>) -> bool {
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
                if self.lines[index].post.pending.clear() {
                    let action = self.lines[index].connection.woken(now);
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
                // What was sent before arrives, or TCP_USER_TIMEOUT ends it.
                Action::End => return line.socket = None,
                Action::HandOver => {
                    if let Some(socket) = line.socket.take() {
                        // Only the loop watches it from now on. It was watched here, so that this cannot fail.
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
    /// Wakes its session.
    post: Arc<Post>,
    /// While it is this thread's.
    socket: Option<OwnedFd>,
    /// The events waited for on it.
    interest: EpollFlags,
}

impl Line {
    fn connect(&mut self, now: Time, epoll: &Epoll, token: u64) -> Action {
        match self.begin(epoll, token) {
            Ok(true) => self.connection.connected(now),
            Ok(false) => Action::Wait,
            Err(errno) => self.connection.failed(now, Broken::Failed(errno as i32)),
        }
    }

    /// Opens a socket that begins to connect; true if it is connected already.
    fn begin(&mut self, epoll: &Epoll, token: u64) -> nix::Result<bool> {
        let target = self.connection.target();
        let socket = self.socket.insert(open(target)?);
        let connected = match connect(socket.as_raw_fd(), &SockaddrIn::from(target.address)) {
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
        if let Some(socket) = self.socket.take() {
            // Without it the end is an orderly one, and TCP_USER_TIMEOUT bounds it.
            let _ = setsockopt(&socket, sockopt::Linger, &libc::linger { l_onoff: 1, l_linger: 0 });
        }
    }
}

/// A socket that never waits, with what a cyclic exchange needs.
fn open(target: &Target) -> nix::Result<OwnedFd> {
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
    let unacknowledged_ms = u32::try_from(target.unacknowledged_ns / MS).unwrap_or(u32::MAX).max(1);
    setsockopt(&socket, sockopt::TcpUserTimeout, &unacknowledged_ms)?;
    let repeated_us = REPEATED_US;
    // SAFETY: the kernel reads one integer, which outlives the call. An older kernel refuses the option: it is none the
    // worse for that.
    unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::IPPROTO_TCP,
            TCP_RTO_MIN_US,
            (&raw const repeated_us).cast(),
            size_of_val(&repeated_us) as libc::socklen_t,
        );
    }
    if let Some(own) = target.bind {
        // The port is chosen when the peer is known: many connections share the host's ports (ip(7)).
        setsockopt(&socket, sockopt::IpBindAddressNoPort, &true)?;
        bind(socket.as_raw_fd(), &SockaddrIn::from(SocketAddrV4::new(own, 0)))?;
    }
    Ok(socket)
}
