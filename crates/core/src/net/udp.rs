//! Batched UDP on real sockets: `sendmmsg` and `recvmmsg` behind [`Datagrams`].
//!
//! Nothing here knows what the bytes mean. Nothing waits or allocates after the socket is open.
//!
//! The kernel counts what it drops because the socket's buffer is full, and reports the count with each datagram
//! that it accepted since (SO_RXQ_OVFL, socket(7)). That costs two words per header, and nothing in the kernel
//! until the first loss. Reading the count directly (SO_MEMINFO) would be one more system call, and one more that
//! the real-time thread may make, to learn of losses before the next datagram comes.

use std::io;
use std::mem::{MaybeUninit, size_of};
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::{AsFd, AsRawFd, RawFd};
use std::ptr;
use std::sync::Arc;

use nix::sys::socket::{setsockopt, sockopt};

use super::groups::{GroupSockets, Source};
use super::{Datagrams, Groups, Outbox, Received, Sent, UdpOptions};
use crate::rt::{MonotonicClock, Regions};

/// The most datagrams of one `sendmmsg`. The kernel takes 1024; 64 keep the arrays of a call within two pages, and the
/// one stamp of a batch close to each of its messages.
const SEND_BATCH: usize = 64;

/// The most datagrams of one `recvmmsg`. Twice as many: at 256 drives that saves two system calls a cycle (`cargo
/// bench --bench scale`).
const RECEIVE_BATCH: usize = 128;

/// The kernel's charge for one small datagram besides its bytes: the packet's head and its descriptor
/// (`truesize`, 768 on x86-64), rounded up.
const OVERHEAD: usize = 1024;

/// The largest send buffer, bytes: room for what waits for the addresses of some thirty absent peers, whose queues in
/// the kernel hold 101 packets each (`unres_qlen` of ip-neighbour). With more absent peers than that some of the
/// requests to others are unsent, too, until the absent ones count as lost.
const MOST_SENDING: usize = 4 << 20;

/// Datagrams of each peer that a socket buffer holds: those of a few cycles, in case the loop is delayed.
const DEPTH: usize = 8;

impl UdpOptions {
    /// The requested size of the send buffer, bytes.
    pub fn send_buffer(&self) -> usize {
        self.space(self.waiting.max(DEPTH)).min(MOST_SENDING)
    }

    /// The requested size of the receive buffer, bytes.
    pub fn receive_buffer(&self) -> usize {
        self.space(DEPTH)
    }

    fn space(&self, depth: usize) -> usize {
        // The kernel takes an int, and clamps it.
        let each = depth.saturating_mul(self.room + OVERHEAD);
        self.peers.max(1).saturating_mul(each).min(i32::MAX as usize)
    }
}

/// A non-blocking UDP socket over IPv4.
///
/// The address is exclusive: neither SO_REUSEADDR nor SO_REUSEPORT is set, so that a second master on the same address
/// fails with EADDRINUSE instead of taking half of the replies.
#[derive(Debug)]
pub struct Udp {
    /// The own socket, then those of its groups.
    sources: Vec<Source>,
    inbox: Inbox,
    groups: Option<GroupSockets>,
}

/// The datagram that has arrived, at whichever socket.
#[derive(Debug)]
struct Inbox {
    batch: usize,
    room: usize,
    /// One room after the other, for the datagrams of one `recvmmsg`.
    bytes: Box<[u8]>,
    /// The number of all dropped datagrams.
    dropped: u64,
}

/// Room for the one ancillary message that a datagram may carry, a count.
#[repr(C, align(8))]
struct Control([u8; CONTROL]);

// SAFETY: CMSG_SPACE only computes a size.
const CONTROL: usize = unsafe { libc::CMSG_SPACE(size_of::<u32>() as libc::c_uint) } as usize;

impl Udp {
    /// A socket bound to `bind`.
    ///
    /// The buffers are sized from `options`; the kernel silently clamps them to `net.core.wmem_max` and `rmem_max`.
    /// With the usual 208 KiB, some 500 datagrams may wait.
    ///
    /// # Errors
    ///
    /// The errors of `socket` and `bind`: EADDRINUSE if another process has the address, EADDRNOTAVAIL if no
    /// interface has it.
    pub fn bind(bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Udp> {
        let socket = UdpSocket::bind(bind)?;
        socket.set_nonblocking(true)?;
        setsockopt(&socket, sockopt::SndBuf, &options.send_buffer())?;
        setsockopt(&socket, sockopt::RcvBuf, &options.receive_buffer())?;
        setsockopt(&socket, sockopt::RxqOvfl, &1)?;
        // Twice the peers: the reply of each, and one that is late, without a second call. Few peers need few
        // headers; datagrams of an unknown sender are still taken in several at a time.
        let batch = (options.peers * 2).clamp(8, RECEIVE_BATCH);
        let bytes = vec![0; batch * options.room].into();
        if options.dscp > 0 {
            // The upper six bits of the TOS byte (RFC 2474).
            setsockopt(&socket, sockopt::Ipv4Tos, &(i32::from(options.dscp & 0x3F) << 2))?;
        }
        let groups = (options.groups > 0)
            .then(|| GroupSockets::new(socket.as_fd(), *bind.ip(), options.groups, options.receive_buffer()));
        let inbox = Inbox { batch, room: options.room, bytes, dropped: 0 };
        let groups = groups.transpose()?;
        let mut sources = Vec::with_capacity(1 + options.groups);
        sources.push(Source { socket: Arc::new(socket), reported: 0 });
        Ok(Udp { sources, inbox, groups })
    }

    fn socket(&self) -> &UdpSocket {
        &self.sources[0].socket
    }

    /// One `sendmmsg`. Its messages are sent, or charged with their own error; the call resumes after a failing one,
    /// and each turn settles at least one. All that are sent are stamped with the time at which the batch begins, so
    /// that round trips are never shown shorter than they are.
    fn send_batch(&self, outbox: &mut Outbox, indices: &[usize]) {
        let mut peers = [const { MaybeUninit::<libc::sockaddr_in>::uninit() }; SEND_BATCH];
        let mut slices = [const { MaybeUninit::<libc::iovec>::uninit() }; SEND_BATCH];
        let mut headers = [const { MaybeUninit::<libc::mmsghdr>::uninit() }; SEND_BATCH];
        for (k, &index) in indices.iter().enumerate() {
            let bytes = outbox.bytes(index);
            let peer = peers[k].write(sockaddr(outbox.peer(index)));
            // The kernel only reads through this pointer; `iovec` has no const twin.
            let slice = slices[k]
                .write(libc::iovec { iov_base: bytes.as_ptr().cast_mut().cast(), iov_len: bytes.len() });
            headers[k].write(header(peer, slice));
        }
        let begin = MonotonicClock::read();
        let mut done = 0;
        while done < indices.len() {
            // SAFETY: the headers from `done` up to `indices.len()` were written above. They point to addresses and
            // slices on this stack frame and to bytes of `outbox`, none of which moves or ends before the call
            // returns; `note` below writes other memory than those bytes.
            let sent = unsafe {
                libc::sendmmsg(
                    self.socket().as_raw_fd(),
                    headers[done..].as_mut_ptr().cast(),
                    (indices.len() - done) as libc::c_uint,
                    libc::MSG_DONTWAIT | libc::MSG_NOSIGNAL,
                )
            };
            // Negative: the first message failed. An error further behind ends the call early and is met again when the
            // call resumes there, this time as the first.
            if sent > 0 {
                let end = indices.len().min(done + sent as usize);
                for &index in &indices[done..end] {
                    outbox.note(index, Sent::At(begin));
                }
                done = end;
            } else {
                outbox.note(indices[done], Sent::Failed(last_errno()));
                done += 1;
            }
        }
    }
}

impl Inbox {
    /// Takes in what has arrived at `source`, at most `most` datagrams.
    fn receive(
        &mut self,
        source: &mut Source,
        most: usize,
        take: &mut dyn FnMut(Received<'_>),
    ) -> io::Result<usize> {
        let mut peers = [const { MaybeUninit::<libc::sockaddr_in>::uninit() }; RECEIVE_BATCH];
        let mut slices = [const { MaybeUninit::<libc::iovec>::uninit() }; RECEIVE_BATCH];
        let mut headers = [const { MaybeUninit::<libc::mmsghdr>::uninit() }; RECEIVE_BATCH];
        // One for all: the count only grows, and that of the newest datagram is written last.
        let mut control = Control([0; CONTROL]);
        let most = most.min(self.batch);
        let inbox = self.bytes.as_mut_ptr();
        for k in 0..most {
            let peer = peers[k].write(sockaddr(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0)));
            // SAFETY: `bytes` has `batch` rooms of `room` bytes each, and `most` is no more: room k lies within it.
            let room = unsafe { inbox.add(k * self.room) };
            let slice = slices[k].write(libc::iovec { iov_base: room.cast(), iov_len: self.room });
            let header = headers[k].write(header(peer, slice));
            header.msg_hdr.msg_control = ptr::from_mut(&mut control).cast();
            header.msg_hdr.msg_controllen = CONTROL as _;
        }
        // SAFETY: `most` headers were written above; each points to an address, a slice and `control` on this stack
        // frame, and each slice to a room of its own in `bytes`, which nothing else touches during the call.
        let count = unsafe {
            libc::recvmmsg(
                source.socket.as_raw_fd(),
                headers.as_mut_ptr().cast(),
                most as libc::c_uint,
                libc::MSG_DONTWAIT,
                ptr::null_mut(),
            )
        };
        if count < 0 {
            let error = io::Error::last_os_error();
            return match error.kind() {
                io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted => Ok(0),
                _ => Err(error),
            };
        }
        let at = MonotonicClock::read();
        let count = most.min(count as usize);
        if let Some(newest) = headers[..count].last() {
            // SAFETY: the headers of every k < most were written above, and by the kernel since.
            self.count_dropped(unsafe { &newest.assume_init_ref().msg_hdr }, &mut source.reported);
        }
        for k in 0..count {
            // SAFETY: header and address of every k < most were written above, and by the kernel since.
            let (header, peer) = unsafe { (headers[k].assume_init_ref(), peers[k].assume_init_ref()) };
            if peer.sin_family != libc::AF_INET as libc::sa_family_t {
                continue;
            }
            take(Received {
                from: SocketAddrV4::new(
                    Ipv4Addr::from_bits(u32::from_be(peer.sin_addr.s_addr)),
                    u16::from_be(peer.sin_port),
                ),
                at,
                bytes: &self.bytes[k * self.room..][..self.room.min(header.msg_len as usize)],
                truncated: header.msg_hdr.msg_flags & libc::MSG_TRUNC != 0,
            });
        }
        Ok(count)
    }

    /// Takes over the kernel's count of dropped datagrams, if the newest datagram carries it; `reported` is that of the
    /// socket as last reported.
    fn count_dropped(&mut self, newest: &libc::msghdr, reported: &mut u32) {
        // SAFETY: the header is one that the kernel filled in: it points to `Control`, of which so many bytes are
        // filled. CMSG_FIRSTHDR is null if there is no whole message in them.
        let message = unsafe { libc::CMSG_FIRSTHDR(newest).as_ref() };
        if let Some(message) = message
            && (message.cmsg_level, message.cmsg_type) == (libc::SOL_SOCKET, libc::SO_RXQ_OVFL)
        {
            // SAFETY: the kernel's message of this type is a u32; it lies in `Control`, maybe unaligned.
            let count = unsafe { libc::CMSG_DATA(message).cast::<u32>().read_unaligned() };
            self.dropped += u64::from(count.wrapping_sub(*reported));
            *reported = count;
        }
    }
}

impl Datagrams for Udp {
    fn fd(&self) -> Option<RawFd> {
        Some(self.groups.as_ref().map_or(self.socket().as_raw_fd(), GroupSockets::fd))
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let mut next = 0;
        loop {
            let mut indices = [0; SEND_BATCH];
            let mut count = 0;
            while next < outbox.len() && count < SEND_BATCH {
                if outbox.sent(next) == Sent::Posted {
                    indices[count] = next;
                    count += 1;
                }
                next += 1;
            }
            if count == 0 {
                return;
            }
            self.send_batch(outbox, &indices[..count]);
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let Udp { sources, inbox, groups, .. } = self;
        let Some(groups) = groups else { return inbox.receive(&mut sources[0], inbox.batch, take) };
        let mut count = 0;
        for k in 0..groups.look(sources) {
            let most = inbox.batch - count;
            if most == 0 {
                break;
            }
            count += inbox.receive(&mut sources[groups.ready(k)], most, take)?;
        }
        Ok(count)
    }

    fn groups(&self) -> Option<Arc<dyn Groups>> {
        self.groups.as_ref().map(GroupSockets::joiner)
    }

    fn batch(&self) -> usize {
        self.inbox.batch
    }

    fn twin(&self) -> io::Result<Option<UdpSocket>> {
        self.socket().try_clone().map(Some)
    }

    fn dropped(&self) -> u64 {
        self.inbox.dropped
    }

    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        regions.add(&*self.sources);
        regions.add(&*self.inbox.bytes);
        if let Some(groups) = &self.groups {
            groups.memory(regions);
        }
    }
}

fn sockaddr(address: SocketAddrV4) -> libc::sockaddr_in {
    libc::sockaddr_in {
        sin_family: libc::AF_INET as libc::sa_family_t,
        sin_port: address.port().to_be(),
        sin_addr: libc::in_addr { s_addr: address.ip().to_bits().to_be() },
        sin_zero: [0; 8],
    }
}

/// One message of a batch: its address and its one slice.
fn header(peer: &mut libc::sockaddr_in, slice: &mut libc::iovec) -> libc::mmsghdr {
    // SAFETY: all-zero is a valid mmsghdr: integers and null pointers. (It has private padding on some targets.)
    let mut header: libc::mmsghdr = unsafe { std::mem::zeroed() };
    header.msg_hdr.msg_name = ptr::from_mut(peer).cast();
    header.msg_hdr.msg_namelen = size_of::<libc::sockaddr_in>() as libc::socklen_t;
    header.msg_hdr.msg_iov = slice;
    header.msg_hdr.msg_iovlen = 1;
    header
}

fn last_errno() -> i32 {
    io::Error::last_os_error().raw_os_error().unwrap_or(libc::EIO)
}

#[cfg(test)]
mod tests;
