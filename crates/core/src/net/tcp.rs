//! TCP connections on the real-time thread, behind [`Streams`].
//!
//! Two system calls per request and reply, `sendto` and `recvfrom`, and one `epoll_wait` for all connections
//! together; a single connection has no epoll and is waited for itself, which wakes the loop sooner. Sockets come
//! from the link thread when they are ready and return to it to be closed: nothing here opens, waits, closes or
//! allocates.
//!
//! The epoll belongs to this side alone. The kernel guards it with a lock that may sleep: if the link thread added
//! a socket to it, a normal thread that is preempted just then would delay the loop. So the loop adds a socket when
//! it takes it over and removes it before it returns it, one `epoll_ctl` per connection each.
//!
//! A serial port is a single connection, with `write` and `read` on its descriptor.

use std::io;
use std::os::fd::{AsRawFd, RawFd};
use std::sync::Arc;
use std::task::Waker;

use nix::errno::Errno;
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::socket::{MsgFlags, recv, send};

use super::link::{Ends, GivenBack, LinkThread, Opened};
use super::serial::{Serial, SerialLine};
use super::stream::{Broken, LinkNotes, StreamPeer, Streams};
use super::tty::Descriptor;
use super::{local, tty};
use crate::rt::{MonotonicClock, Regions};
use crate::time::Time;

/// The most reads of a discard: each takes one room.
const DISCARDS: usize = 64;

/// Connections to fixed peers, or a serial port. When dropped at the loop's end it closes its open connections in
/// order, so that the last outputs arrive.
#[derive(Debug)]
pub struct Tcp {
    /// `None`: a single connection is read itself.
    epoll: Option<Epoll>,
    /// The open sockets.
    sockets: Box<[Option<Descriptor>]>,
    /// The result of the last look, and how much of it was read. Room for all, so that none waits behind busier
    /// ones.
    events: Box<[EpollEvent]>,
    found: usize,
    next: usize,
    /// The only descriptor is a terminal device's.
    is_tty: bool,
    link: Ends,
}

impl Tcp {
    /// Connections to `peers`, opened by `thread`.
    pub(super) fn open(thread: &Arc<LinkThread>, peers: Vec<StreamPeer>) -> io::Result<Tcp> {
        Tcp::over(peers.len(), false, thread.carry(peers))
    }

    /// Port `path` of the operating system, or a simulated wire of this host (`local:NAME`), opened by `thread`.
    pub(super) fn of_port(thread: &Arc<LinkThread>, path: &str, line: &SerialLine) -> io::Result<Tcp> {
        Tcp::over(1, local::name(path).is_none(), thread.carry_port(path, *line))
    }

    fn over(count: usize, is_tty: bool, link: Ends) -> io::Result<Tcp> {
        let several = (count > 1).then(|| Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC));
        Ok(Tcp {
            epoll: several.transpose()?,
            sockets: (0..count).map(|_| None).collect(),
            events: vec![EpollEvent::empty(); count].into(),
            found: 0,
            next: 0,
            is_tty,
            link,
        })
    }

    fn socket(&self, index: usize) -> Result<&Descriptor, Broken> {
        self.sockets.get(index).and_then(Option::as_ref).ok_or(Broken::Absent)
    }

    /// Adds it to the epoll, if there is one.
    fn watch(&self, index: usize, socket: &Descriptor) -> nix::Result<()> {
        let event = EpollEvent::new(EpollFlags::EPOLLIN, index as u64);
        self.epoll.as_ref().map_or(Ok(()), |epoll| epoll.add(socket, event))
    }

    /// Writes to an eventfd that is never full: it wakes up the link thread and does not wait for it.
    fn give_back(&mut self, index: usize, socket: Descriptor, why: &'static str) {
        // Never full: it has room for every connection.
        let _ = self.link.given_back.push(GivenBack { index, socket, why });
        self.link.bell.ring();
    }
}

impl Streams for Tcp {
    fn fd(&self) -> Option<RawFd> {
        match &self.epoll {
            Some(epoll) => Some(epoll.0.as_raw_fd()),
            None => self.socket(0).ok().map(AsRawFd::as_raw_fd),
        }
    }

    fn opened(&mut self) -> Option<usize> {
        // As many turns as there are connections at most.
        while let Ok(Opened { index, socket }) = self.link.opened.pop() {
            match self.watch(index, &socket) {
                Ok(()) => {
                    self.sockets[index] = Some(socket);
                    return Some(index);
                }
                Err(_) => self.give_back(
                    index,
                    socket,
                    "the kernel cannot watch one more socket: raise fs.epoll.max_user_watches (sysctl)",
                ),
            }
        }
        None
    }

    fn look(&mut self) {
        self.next = 0;
        self.found = match &self.epoll {
            // The only possible error is EINTR: next time.
            Some(epoll) => epoll.wait(&mut self.events, EpollTimeout::ZERO).unwrap_or(0),
            // Nothing to receive costs the same call. The event's index is 0 already.
            None => usize::from(self.socket(0).is_ok()),
        };
    }

    fn ready(&mut self) -> Option<usize> {
        let event = self.events[..self.found].get(self.next)?;
        self.next += 1;
        Some(event.data() as usize)
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let socket = self.socket(index)?;
        // A recv of nothing returns 0, as at the end of a connection.
        if room.is_empty() {
            return Ok(None);
        }
        let count = match self.is_tty {
            true => tty::read(socket, room),
            false => recv(socket.as_raw_fd(), room, MsgFlags::MSG_DONTWAIT),
        };
        match count {
            Ok(0) => Err(Broken::Closed),
            Ok(count) => Ok(Some((MonotonicClock::read(), count))),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok(None),
            Err(errno) => Err(Broken::Failed(errno as i32)),
        }
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let socket = self.socket(index)?;
        let begin = MonotonicClock::read();
        let taken = match self.is_tty {
            true => tty::write(socket, bytes),
            false => send(socket.as_raw_fd(), bytes, MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL),
        };
        match taken {
            Ok(count) => Ok((begin, count)),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok((begin, 0)),
            Err(errno) => Err(Broken::Failed(errno as i32)),
        }
    }

    fn abandon(&mut self, index: usize, why: &'static str) {
        if let Some(socket) = self.sockets.get_mut(index).and_then(Option::take) {
            if let Some(epoll) = &self.epoll {
                // Removed here, so that the end of the connection no longer wakes up the loop. It was added: this
                // cannot fail.
                let _ = epoll.delete(&socket);
            }
            self.give_back(index, socket, why);
        }
    }

    fn has_ended(&self) -> bool {
        self.link.bell.has_ended()
    }

    fn notes(&self) -> LinkNotes {
        self.link.notes.clone()
    }

    fn waker(&self) -> Option<Waker> {
        Some(self.link.bell.waker())
    }

    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        regions.add(&*self.sockets);
        regions.add(&*self.events);
        regions.extend(&self.link.regions);
    }
}

impl Serial for Tcp {
    fn unsent(&mut self) -> Result<usize, Broken> {
        let mut count: libc::c_int = 0;
        // SAFETY: the kernel writes one int. Sockets have the same request by the name SIOCOUTQ.
        let refused = unsafe { libc::ioctl(self.socket(0)?.as_raw_fd(), libc::TIOCOUTQ, &raw mut count) } < 0;
        if refused { Err(last_error()) } else { Ok(usize::try_from(count).unwrap_or(0)) }
    }

    fn discard(&mut self) -> Result<(), Broken> {
        if self.is_tty && !tty::flush(self.socket(0)?) {
            return Err(last_error());
        }
        // A socket has no such request; a terminal has nothing left.
        for _ in 0..DISCARDS {
            if self.receive(0, &mut [0; 256])?.is_none() {
                break;
            }
        }
        Ok(())
    }

    fn is_timed(&self) -> bool {
        self.socket(0).is_ok_and(|port| port.is_timed)
    }
}

fn last_error() -> Broken {
    Broken::Failed(Errno::last_raw())
}

#[cfg(test)]
mod tests;
