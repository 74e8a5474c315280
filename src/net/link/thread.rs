//! The link thread: opens, initialises and closes the sockets of all connections of a master, so that the loop
//! never has to.
//! A normal thread off the loop's core. It never waits for one peer: every socket is non-blocking, and one `epoll`
//! waits for all of them and for the next due instant. [`Connection`] says when to do what. A socket changes owners
//! by two wait-free rings per carrier. The loop writes an eventfd when it returns a socket, and only then: the loop
//! looks for new ones by itself.

use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{Builder, JoinHandle};

use nix::errno::Errno;
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::eventfd::{EfdFlags, EventFd};
use nix::sys::socket::{
    AddressFamily, MsgFlags, SockFlag, SockType, SockaddrIn, connect, getsockopt, recv, send, setsockopt,
    socket, sockopt,
};
use rtrb::{Consumer, Producer};

use super::connection::{Action, Connection};
use crate::net::stream::{Broken, LinkNotes, StreamPeer};
use crate::rt::{self, MonotonicClock, Regions};
use crate::time::{MS, Time};

/// The most events of one turn; the others are reported by the next one, first.
const EVENTS: usize = 64;

/// The most that is read from a connection in one turn: the answers of a handshake are short.
const ROOM: usize = 2_048;

/// The event of no socket.
const BELL: u64 = u64::MAX;

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
    /// The memory of the rings.
    pub regions: Regions,
    pub bell: Bell,
}

/// Wakes up the link thread, and keeps it alive.
#[derive(Debug)]
pub(in crate::net) struct Bell(Arc<LinkThread>);

impl Bell {
    pub fn ring(&self) {
        self.0.wake_up();
    }

    /// Whether the thread has ended although there is a carrier: it panicked.
    pub fn has_ended(&self) -> bool {
        self.0.shared.gone.load(Ordering::Relaxed)
    }
}

impl Drop for Bell {
    fn drop(&mut self) {
        self.ring();
    }
}

/// The thread, from the side of others. It ends with the last [`Bell`].
#[derive(Debug)]
pub(in crate::net) struct LinkThread {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    bell: EventFd,
    /// The thread is to end.
    ended: AtomicBool,
    /// It has ended, requested or not.
    gone: AtomicBool,
    arrivals: Mutex<Vec<Desk>>,
}

impl LinkThread {
    /// Starts the thread, on any core but the loop's.
    pub fn start(core_of_loop: Option<usize>) -> io::Result<Arc<LinkThread>> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        let bell = EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?;
        epoll.add(&bell, EpollEvent::new(EpollFlags::EPOLLIN, BELL))?;
        let shared = Arc::new(Shared {
            bell,
            ended: AtomicBool::new(false),
            gone: AtomicBool::new(false),
            arrivals: Mutex::default(),
        });
        let end = Gone(Arc::clone(&shared));
        let mut worker =
            Worker { epoll, shared: Arc::clone(&shared), desks: Vec::new(), next_id: 0, bytes: [0; ROOM] };
        let thread = Builder::new().name("fb-link".into()).spawn(move || {
            // Dropped last, also by a panic.
            let _end = end;
            rt::thread::helper_thread(core_of_loop);
            worker.run();
        })?;
        Ok(Arc::new(LinkThread { shared, thread: Some(thread) }))
    }

    /// Begins to open connections to `peers`, and keeps them open until the ends are dropped.
    pub fn carry(self: &Arc<Self>, peers: Vec<StreamPeer>) -> Ends {
        // Each connection is in one place at a time, so that neither ring is ever full.
        let (count, mut regions) = (peers.len(), Regions::new());
        let (opened, ready) = rt::memory::ring(count, &mut regions);
        let (given_back, back) = rt::memory::ring(count, &mut regions);
        // What the loop touches to wake the thread.
        regions.add(&**self);
        regions.add(&*self.shared);
        let (now, notes) = (MonotonicClock::read(), LinkNotes::new(count));
        let line = |(index, peer)| Line::new(Connection::new(now, peer, notes.clone(), index));
        let desk = Desk { id: 0, lines: peers.into_iter().enumerate().map(line).collect(), opened, back };
        self.shared.arrivals.lock().unwrap_or_else(PoisonError::into_inner).push(desk);
        self.wake_up();
        Ends { opened: ready, given_back, notes, regions, bell: Bell(Arc::clone(self)) }
    }

    fn wake_up(&self) {
        // An eventfd refuses a 1 only when it is about to overflow, and then the thread wakes up all the same.
        let _ = self.shared.bell.write(1);
    }
}

impl Drop for LinkThread {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Release);
        self.wake_up();
        if let Some(thread) = self.thread.take() {
            // Not long: the thread waits for the eventfd only. A panic of a handshake has been printed by it.
            let _ = thread.join();
        }
    }
}

/// Held by the thread: reports its end to the loop.
struct Gone(Arc<Shared>);

impl Drop for Gone {
    fn drop(&mut self) {
        self.0.gone.store(true, Ordering::Relaxed);
    }
}

/// What the thread owns.
struct Worker {
    epoll: Epoll,
    shared: Arc<Shared>,
    desks: Vec<Desk>,
    next_id: u32,
    bytes: [u8; ROOM],
}

impl Worker {
    fn run(&mut self) {
        let mut events = [EpollEvent::empty(); EVENTS];
        loop {
            let count = match self.epoll.wait(&mut events, self.timeout()) {
                Ok(count) => count,
                Err(Errno::EINTR) => 0,
                // The descriptor and the buffer are our own, so that no other error is possible.
                Err(_) => return,
            };
            for event in &events[..count] {
                match event.data() {
                    // Read to clear it; every turn looks at all carriers.
                    BELL => drop(self.shared.bell.read()),
                    token => self.happened(token, event.events()),
                }
            }
            // Behind the read: it may have cleared the wake-up of the end along with an earlier one.
            if self.shared.ended.load(Ordering::Acquire) {
                return;
            }
            self.take_in();
            self.desks.retain_mut(|desk| desk.turn(&self.epoll));
        }
    }

    /// Until the next due instant, in the milliseconds of `epoll_wait`, rounded up. A minute more often does not
    /// matter.
    fn timeout(&self) -> EpollTimeout {
        let lines = self.desks.iter().flat_map(|desk| &desk.lines);
        match lines.filter_map(|line| line.connection.next_due()).min() {
            None => EpollTimeout::NONE,
            Some(due) => {
                let ms = due.since(MonotonicClock::read()).div_ceil(MS);
                EpollTimeout::from(u16::try_from(ms).unwrap_or(u16::MAX))
            }
        }
    }

    fn happened(&mut self, token: u64, events: EpollFlags) {
        let (id, index) = ((token >> 32) as u32, token as u32 as usize);
        let Some(desk) = self.desks.iter_mut().find(|desk| desk.id == id) else { return };
        let Some(line) = desk.lines.get_mut(index) else { return };
        let now = MonotonicClock::read();
        let action = line.happened(now, events, &mut self.bytes);
        desk.follow(index, action, now, &self.epoll);
    }

    /// Takes over new carriers.
    fn take_in(&mut self) {
        for desk in self.shared.arrivals.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
            self.desks.push(Desk { id: self.next_id, ..desk });
            self.next_id = self.next_id.wrapping_add(1);
        }
    }
}

/// The thread's side of a carrier.
#[derive(Debug)]
struct Desk {
    /// Of the carriers of this thread.
    id: u32,
    lines: Vec<Line>,
    opened: Producer<Opened>,
    back: Consumer<GivenBack>,
}

impl Desk {
    /// Handles returned connections and due ones. False if the carrier is gone.
    fn turn(&mut self, epoll: &Epoll) -> bool {
        let now = MonotonicClock::read();
        // Read first: connections returned before it disappeared are still closed in order.
        let gone = self.back.is_abandoned();
        while let Ok(GivenBack { index, socket, why }) = self.back.pop() {
            let line = &mut self.lines[index];
            line.socket = Some(socket);
            let action = line.connection.given_back(now, why);
            self.follow(index, action, now, epoll);
        }
        if !gone {
            for index in 0..self.lines.len() {
                let action = self.lines[index].connection.poll(now);
                self.follow(index, action, now, epoll);
            }
        }
        !gone
    }

    /// Carries out the actions until there is nothing more to do now.
    fn follow(&mut self, index: usize, mut action: Action, now: Time, epoll: &Epoll) {
        let token = u64::from(self.id) << 32 | index as u64;
        let line = &mut self.lines[index];
        loop {
            action = match action {
                Action::Wait => return,
                Action::Connect => line.connect(now, epoll, token),
                Action::Send => line.send(now, epoll, token),
                Action::Close => return line.close(),
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
    /// While it is this thread's.
    socket: Option<OwnedFd>,
    /// The events waited for on it.
    interest: EpollFlags,
}

impl Line {
    fn new(connection: Connection) -> Line {
        Line { connection, socket: None, interest: EpollFlags::empty() }
    }

    fn connect(&mut self, now: Time, epoll: &Epoll, token: u64) -> Action {
        match self.begin(epoll, token) {
            Ok(true) => self.connection.connected(now),
            Ok(false) => Action::Wait,
            Err(errno) => self.connection.failed(now, Broken::Failed(errno as i32)),
        }
    }

    /// Opens a socket that begins to connect; true if it is connected already.
    fn begin(&mut self, epoll: &Epoll, token: u64) -> nix::Result<bool> {
        let peer = self.connection.peer();
        let socket = self.socket.insert(open(peer)?);
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
        if let Some(socket) = self.socket.take() {
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
    Ok(socket)
}
