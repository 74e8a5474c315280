//! Multicast groups of a carrier of datagrams: a socket of its own for each group, opened and joined by a normal thread
//! and read by the loop.
//!
//! A socket that is bound to a group's address receives nothing else, and the carrier's own socket receives nothing of
//! the group. Sockets change owners by two wait-free rings, and the loop closes none.

use std::fmt::Debug;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::sync::{Arc, Mutex, PoisonError};

use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::socket::{
    AddressFamily, IpMembershipRequest, SockFlag, SockType, SockaddrIn, bind, setsockopt, socket, sockopt,
};
use rtrb::{Consumer, Producer};

use crate::rt::{self, Regions};

/// Changes that may wait for the loop, for each group. Room for its leave is reserved with each join.
const CHANGES: usize = 4;

/// Joins and leaves multicast groups for a carrier: for normal threads, a session's for example.
pub trait Groups: Debug + Send + Sync {
    /// From now on the carrier receives what is sent to `group`. Each join needs a leave of its own.
    ///
    /// # Errors
    ///
    /// [`InvalidInput`](io::ErrorKind::InvalidInput): it is no group, or one too many.
    /// [`WouldBlock`](io::ErrorKind::WouldBlock): the loop has not taken earlier changes yet. Others of the operating
    /// system.
    fn join(&self, group: SocketAddrV4) -> io::Result<()>;

    /// One of those who joined `group` needs it no longer. Whoever never joined it leaves nothing.
    fn leave(&self, group: SocketAddrV4);
}

/// Who has joined which group, how often.
#[derive(Debug)]
pub(crate) struct Members<T> {
    most: usize,
    groups: Vec<(SocketAddrV4, usize, T)>,
}

impl<T> Members<T> {
    pub(crate) fn new(most: usize) -> Members<T> {
        Members { most, groups: Vec::with_capacity(most) }
    }

    /// One more; the first of a group makes what belongs to it.
    pub(crate) fn join(
        &mut self,
        group: SocketAddrV4,
        make: impl FnOnce() -> io::Result<T>,
    ) -> io::Result<()> {
        if let Some((_, count, _)) = self.groups.iter_mut().find(|(other, ..)| *other == group) {
            *count += 1;
            return Ok(());
        }
        if !group.ip().is_multicast() {
            let message = format!("{group} is no multicast group (224.0.0.0 ... 239.255.255.255)");
            return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
        }
        if self.groups.len() >= self.most {
            let message =
                format!("{group} is one group more than the {} that this bus has room for", self.most);
            return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
        }
        self.groups.push((group, 1, make()?));
        Ok(())
    }

    /// One fewer; returns what belonged to the group with the last.
    pub(crate) fn leave(&mut self, group: SocketAddrV4) -> Option<T> {
        let place = self.groups.iter().position(|(other, ..)| *other == group)?;
        let (_, count, _) = &mut self.groups[place];
        *count -= 1;
        if *count > 0 {
            return None;
        }
        Some(self.groups.swap_remove(place).2)
    }

    pub(crate) fn has(&self, group: SocketAddrV4) -> bool {
        self.groups.iter().any(|(other, ..)| *other == group)
    }
}

/// What the loop has to do with a socket.
#[derive(Debug)]
enum Change {
    Take(Arc<OwnedFd>),
    Drop(RawFd),
}

/// One socket on the loop's side.
#[derive(Debug)]
pub(super) struct GroupSocket {
    socket: Arc<OwnedFd>,
    /// The kernel's count of dropped datagrams, as last reported.
    pub reported: u32,
}

impl AsFd for GroupSocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// The loop's side: the carrier's own socket and those of its groups.
#[derive(Debug)]
pub(super) struct GroupSockets {
    epoll: Epoll,
    sockets: Box<[Option<GroupSocket>]>,
    events: Box<[EpollEvent]>,
    found: usize,
    /// Where the next look begins, so that a busy socket holds up no other.
    turn: usize,
    changes: Consumer<Change>,
    left: Producer<Arc<OwnedFd>>,
    joiner: Arc<Joiner>,
    regions: Regions,
}

/// The token of the carrier's own socket; those of the groups follow.
const OWN: u64 = 0;

impl GroupSockets {
    /// Room for `most` groups of a carrier whose own socket is `own`, bound to `ip`.
    pub fn new(own: impl AsFd, ip: Ipv4Addr, most: usize, buffer: usize) -> io::Result<GroupSockets> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        epoll.add(own, EpollEvent::new(EpollFlags::EPOLLIN, OWN))?;
        let mut regions = Regions::new();
        let (changes_in, changes) = rt::memory::ring(CHANGES * most, &mut regions);
        // A socket that leaves comes with a change: there is always room.
        let (left, left_out) = rt::memory::ring(CHANGES * most, &mut regions);
        let state = State { members: Members::new(most), changes: changes_in, left: left_out };
        Ok(GroupSockets {
            epoll,
            sockets: (0..most).map(|_| None).collect(),
            events: vec![EpollEvent::empty(); most + 1].into(),
            found: 0,
            turn: 0,
            changes,
            left,
            joiner: Arc::new(Joiner { ip, buffer, state: Mutex::new(state) }),
            regions,
        })
    }

    /// The normal threads' side.
    pub fn joiner(&self) -> Arc<dyn Groups> {
        Arc::clone(&self.joiner) as Arc<dyn Groups>
    }

    /// Readable while something waits at any of the sockets.
    pub fn fd(&self) -> RawFd {
        self.epoll.0.as_raw_fd()
    }

    /// Takes over new sockets, returns those of groups that were left, and looks which have something to receive.
    pub fn look(&mut self) -> usize {
        // No more turns than the ring has places: a normal thread may go on meanwhile.
        for _ in 0..self.changes.slots() {
            let Ok(change) = self.changes.pop() else { break };
            match change {
                Change::Take(socket) => self.take(socket),
                Change::Drop(fd) => self.drop(fd),
            }
        }
        // The only possible error is EINTR: next time.
        self.found = self.epoll.wait(&mut self.events, EpollTimeout::ZERO).unwrap_or(0);
        self.turn = self.turn.wrapping_add(1);
        self.found
    }

    /// The `k`th socket that the last look found; `None`: the carrier's own one.
    pub fn ready(&mut self, k: usize) -> Option<&mut GroupSocket> {
        let event = self.events.get((k + self.turn) % self.found.max(1))?;
        let place = usize::try_from(event.data().checked_sub(OWN + 1)?).ok()?;
        self.sockets.get_mut(place)?.as_mut()
    }

    fn take(&mut self, socket: Arc<OwnedFd>) {
        let Some(place) = self.sockets.iter().position(Option::is_none) else {
            // Never: the normal threads' side counts them.
            let _ = self.left.push(socket);
            return;
        };
        let event = EpollEvent::new(EpollFlags::EPOLLIN, OWN + 1 + place as u64);
        match self.epoll.add(&*socket, event) {
            Ok(()) => self.sockets[place] = Some(GroupSocket { socket, reported: 0 }),
            // The kernel cannot watch one more: what comes there is missing, and its drives are lost.
            Err(_) => drop(self.left.push(socket)),
        }
    }

    fn drop(&mut self, fd: RawFd) {
        let is_it = |place: &&mut Option<GroupSocket>| {
            place.as_ref().is_some_and(|socket| socket.socket.as_raw_fd() == fd)
        };
        let Some(socket) = self.sockets.iter_mut().find(is_it).and_then(Option::take) else { return };
        // It was added: this cannot fail.
        let _ = self.epoll.delete(&*socket.socket);
        // There is room: see `new`.
        let _ = self.left.push(socket.socket);
    }

    /// Adds the memory that it touches.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.sockets);
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
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    members: Members<Arc<OwnedFd>>,
    changes: Producer<Change>,
    left: Consumer<Arc<OwnedFd>>,
}

impl State {
    /// Closes what the loop returned.
    fn close_left(&mut self) {
        while self.left.pop().is_ok() {}
    }

    /// Whether one more group can be joined now, and left later, like all others.
    fn room(&self) -> io::Result<()> {
        if self.changes.is_abandoned() {
            return Err(io::Error::new(io::ErrorKind::BrokenPipe, "its bus is closed"));
        }
        if self.changes.slots() < self.members.groups.len() + 2 {
            let message = "the loop has not taken earlier changes of groups yet: try again";
            return Err(io::Error::new(io::ErrorKind::WouldBlock, message));
        }
        Ok(())
    }
}

impl Joiner {
    fn open(&self, group: SocketAddrV4) -> io::Result<OwnedFd> {
        let flags = SockFlag::SOCK_NONBLOCK | SockFlag::SOCK_CLOEXEC;
        let socket = socket(AddressFamily::Inet, SockType::Datagram, flags, None)?;
        // Every member of a group on this host gets a copy, whoever else has joined it.
        setsockopt(&socket, sockopt::ReuseAddr, &true)?;
        setsockopt(&socket, sockopt::RcvBuf, &self.buffer)?;
        setsockopt(&socket, sockopt::RxqOvfl, &1)?;
        let (off, fd) = (0 as libc::c_int, socket.as_raw_fd());
        // Only of our own interface, not what others of this host have joined elsewhere (ip(7)).
        // SAFETY: the kernel reads one int.
        let refused = unsafe {
            let length = size_of_val(&off) as libc::socklen_t;
            libc::setsockopt(fd, libc::IPPROTO_IP, libc::IP_MULTICAST_ALL, (&raw const off).cast(), length)
        };
        if refused < 0 {
            return Err(io::Error::last_os_error());
        }
        bind(fd, &SockaddrIn::from(group))?;
        let membership = IpMembershipRequest::new(*group.ip(), Some(self.ip));
        setsockopt(&socket, sockopt::IpAddMembership, &membership)?;
        Ok(socket)
    }
}

impl Groups for Joiner {
    fn join(&self, group: SocketAddrV4) -> io::Result<()> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.close_left();
        let room = state.room();
        let mut opened = None;
        state.members.join(group, || {
            room?;
            let socket = Arc::new(self.open(group)?);
            opened = Some(Arc::clone(&socket));
            Ok(socket)
        })?;
        if let Some(socket) = opened {
            // There is room.
            let _ = state.changes.push(Change::Take(socket));
        }
        Ok(())
    }

    fn leave(&self, group: SocketAddrV4) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(socket) = state.members.leave(group) else { return };
        // The network learns it now, whenever the loop returns the socket.
        let _ = setsockopt(
            &*socket,
            sockopt::IpDropMembership,
            &IpMembershipRequest::new(*group.ip(), Some(self.ip)),
        );
        // Room for it was reserved with the join.
        let _ = state.changes.push(Change::Drop(socket.as_raw_fd()));
        state.close_left();
    }
}
