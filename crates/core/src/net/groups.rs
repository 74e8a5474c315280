//! Multicast groups of a carrier of datagrams: a socket of its own for each group, opened and joined by a normal thread
//! and read by the loop.
//!
//! A socket that is bound to a group's address receives nothing else, and the carrier's own socket receives nothing of
//! the group. It stays open until the carrier is dropped, also when the group is left.

use std::fmt::Debug;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::{AsFd, AsRawFd, RawFd};
use std::sync::{Arc, Mutex, PoisonError};

use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::socket::{AddressFamily, SockFlag, SockType, SockaddrIn, bind, setsockopt, socket, sockopt};
use rtrb::{Consumer, Producer};

use super::set_option;
use crate::rt::{self, Regions};

/// Joins and leaves multicast groups for a carrier: for normal threads, a session's for example.
pub trait Groups: Debug + Send + Sync {
    /// From now on the carrier receives what is sent to `group`. Each join needs a leave of its own.
    ///
    /// # Errors
    ///
    /// [`InvalidInput`](io::ErrorKind::InvalidInput): it is no group, or one too many of all that were ever joined.
    /// Others of the operating system.
    fn join(&self, group: SocketAddrV4) -> io::Result<()>;

    /// One of those who joined `group` needs it no longer. Whoever never joined it leaves nothing.
    fn leave(&self, group: SocketAddrV4);
}

/// All groups that were ever joined: how often each is now, and what belongs to it.
#[derive(Debug)]
pub struct Members<T> {
    most: usize,
    groups: Vec<(SocketAddrV4, usize, T)>,
}

impl<T> Members<T> {
    /// With at most so many groups.
    pub fn new(most: usize) -> Members<T> {
        Members { most, groups: Vec::new() }
    }

    /// One more. The first one ever makes what belongs to the group; the first one at present gets it.
    pub fn join(
        &mut self,
        group: SocketAddrV4,
        make: impl FnOnce() -> io::Result<T>,
    ) -> io::Result<Option<&T>> {
        let known = self.groups.iter().position(|(other, ..)| *other == group);
        let place = known.unwrap_or(self.groups.len());
        if known.is_none() {
            let most = self.most;
            let refused = if !group.ip().is_multicast() {
                Some(format!("{group} is no multicast group (224.0.0.0 ... 239.255.255.255)"))
            } else if place >= most {
                Some(format!("{group} is one group more than the {most} that this bus has room for"))
            } else {
                None
            };
            if let Some(message) = refused {
                return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
            }
            self.groups.push((group, 0, make()?));
        }
        let (_, count, what) = &mut self.groups[place];
        *count += 1;
        Ok((*count == 1).then_some(what))
    }

    /// One fewer; the last one gets what belongs to the group.
    pub fn leave(&mut self, group: SocketAddrV4) -> Option<&T> {
        let joined = |(other, count, _): &&mut (_, usize, _)| *other == group && *count > 0;
        let (_, count, what) = self.groups.iter_mut().find(joined)?;
        *count -= 1;
        (*count == 0).then_some(what)
    }

    /// Somebody has joined it.
    pub fn has(&self, group: SocketAddrV4) -> bool {
        self.groups.iter().any(|(other, count, _)| *other == group && *count > 0)
    }
}

/// A socket on the loop's side.
#[derive(Debug)]
pub(super) struct Source {
    pub socket: Arc<UdpSocket>,
    /// The kernel's count of dropped datagrams, which wraps around, as last reported.
    pub reported: u32,
}

/// The loop's side: which of the carrier's sockets have something to receive.
#[derive(Debug)]
pub(super) struct GroupSockets {
    epoll: Epoll,
    events: Box<[EpollEvent]>,
    found: usize,
    /// Where the next look begins, so that a busy socket holds up no other.
    turn: usize,
    opened: Consumer<Arc<UdpSocket>>,
    joiner: Arc<Joiner>,
    regions: Regions,
}

impl GroupSockets {
    /// Room for `most` groups of a carrier whose own socket is `own`, bound to `ip`.
    pub fn new(own: impl AsFd, ip: Ipv4Addr, most: usize, buffer: usize) -> io::Result<GroupSockets> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        epoll.add(own, EpollEvent::new(EpollFlags::EPOLLIN, 0))?;
        let mut regions = Regions::new();
        // Each group has one socket: there is always room.
        let (producer, opened) = rt::memory::ring(most, &mut regions);
        let (members, producer) = (Mutex::new(Members::new(most)), Mutex::new(producer));
        let joiner = Arc::new(Joiner { ip, buffer, members, opened: producer });
        let events = vec![EpollEvent::empty(); most + 1].into();
        Ok(GroupSockets { epoll, events, found: 0, turn: 0, opened, joiner, regions })
    }

    /// The normal threads' side.
    pub fn joiner(&self) -> Arc<dyn Groups> {
        Arc::clone(&self.joiner) as Arc<dyn Groups>
    }

    /// Readable while something waits at any of the sockets.
    pub fn fd(&self) -> RawFd {
        self.epoll.0.as_raw_fd()
    }

    /// Takes new sockets over to `sources`, which has room for all, and looks which have something to receive.
    pub fn look(&mut self, sources: &mut Vec<Source>) -> usize {
        while let Ok(socket) = self.opened.pop() {
            // If the kernel cannot watch one more, what comes there is missing, and its drives are lost.
            let _ = self.epoll.add(&*socket, EpollEvent::new(EpollFlags::EPOLLIN, sources.len() as u64));
            sources.push(Source { socket, reported: 0 });
        }
        // The only possible error is EINTR: next time.
        self.found = self.epoll.wait(&mut self.events, EpollTimeout::ZERO).unwrap_or(0);
        self.turn = self.turn.wrapping_add(1);
        self.found
    }

    /// The `k`th source that the last look found.
    pub fn ready(&self, k: usize) -> usize {
        self.events.get((k + self.turn) % self.found.max(1)).map_or(0, |event| event.data() as usize)
    }

    /// Adds the memory that it touches.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.events);
        regions.extend(&self.regions);
    }
}

/// The normal threads' side.
#[derive(Debug)]
struct Joiner {
    /// The interface is the one with this address.
    ip: Ipv4Addr,
    /// The requested size of a receive buffer, bytes.
    buffer: usize,
    members: Mutex<Members<Arc<UdpSocket>>>,
    /// By which new sockets go to the loop.
    opened: Mutex<Producer<Arc<UdpSocket>>>,
}

impl Joiner {
    fn open(&self, group: SocketAddrV4) -> io::Result<UdpSocket> {
        let flags = SockFlag::SOCK_NONBLOCK | SockFlag::SOCK_CLOEXEC;
        let socket = socket(AddressFamily::Inet, SockType::Datagram, flags, None)?;
        // Every member of a group on this host gets a copy, whoever else has joined it.
        setsockopt(&socket, sockopt::ReuseAddr, &true)?;
        setsockopt(&socket, sockopt::RcvBuf, &self.buffer)?;
        setsockopt(&socket, sockopt::RxqOvfl, &1)?;
        // Only of our own interface, not what others of this host have joined elsewhere (ip(7)).
        set_option(&socket, libc::IPPROTO_IP, libc::IP_MULTICAST_ALL, 0_i32)?;
        bind(socket.as_raw_fd(), &SockaddrIn::from(group))?;
        Ok(socket.into())
    }
}

impl Groups for Joiner {
    fn join(&self, group: SocketAddrV4) -> io::Result<()> {
        let mut members = self.members.lock().unwrap_or_else(PoisonError::into_inner);
        let first = members.join(group, || {
            let socket = Arc::new(self.open(group)?);
            // There is room, unless the carrier is gone.
            let mut opened = self.opened.lock().unwrap_or_else(PoisonError::into_inner);
            let _ = opened.push(Arc::clone(&socket));
            Ok(socket)
        })?;
        let joined = first.map_or(Ok(()), |socket| socket.join_multicast_v4(group.ip(), &self.ip));
        if joined.is_err() {
            members.leave(group);
        }
        joined
    }

    fn leave(&self, group: SocketAddrV4) {
        let mut members = self.members.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(socket) = members.leave(group) {
            // It was joined: this cannot fail.
            let _ = socket.leave_multicast_v4(group.ip(), &self.ip);
        }
    }
}
