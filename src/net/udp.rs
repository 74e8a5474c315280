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
use std::os::fd::{AsRawFd, RawFd};
use std::ptr;

use nix::sys::socket::{setsockopt, sockopt};

use super::{Datagrams, Outbox, Received, SendMode, Sent, UdpOptions};
use crate::rt::{MonotonicClock, Regions};

/// The most datagrams of one `sendmmsg`. The kernel takes 1024; 64 keep the arrays of a call within two pages, and the
/// one stamp of a batch close to each of its messages.
const SEND_BATCH: usize = 64;

/// The most datagrams of one `recvmmsg`. Twice as many: at 256 drives that saves two system calls a cycle (`cargo
/// bench --bench scale`).
const RECEIVE_BATCH: usize = 128;

/// What the kernel charges for one small datagram besides its bytes: the packet's head and its descriptor
/// (`truesize`, 768 on x86-64), rounded up.
const OVERHEAD: usize = 1024;

/// Datagrams of each peer that a socket buffer holds: those of a few cycles, in case the loop is delayed.
const DEPTH: usize = 8;

impl UdpOptions {
    /// The requested size of the send buffer, bytes.
    pub fn send_buffer(&self) -> usize {
        self.space(self.waiting.max(DEPTH))
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
/// Its address is its own: neither SO_REUSEADDR nor SO_REUSEPORT is set, so that a second master on the same address
/// fails with EADDRINUSE instead of taking half of the replies.
#[derive(Debug)]
pub struct Udp {
    socket: UdpSocket,
    mode: SendMode,
    batch: usize,
    room: usize,
    /// One room after the other, for the datagrams of one `recvmmsg`.
    inbox: Box<[u8]>,
    /// The kernel's count of dropped datagrams, which wraps around, as last reported ...
    told: u32,
    /// ... and the number of all dropped datagrams.
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
    /// Its buffers are sized from `options`; the kernel silently clamps them to `net.core.wmem_max` and `rmem_max`.
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
        let inbox = vec![0; batch * options.room].into();
        Ok(Udp { socket, mode: options.send, batch, room: options.room, inbox, told: 0, dropped: 0 })
    }

    /// Takes over the kernel's count of dropped datagrams, if the newest datagram carries it.
    fn count_dropped(&mut self, newest: &libc::msghdr) {
        // SAFETY: the header is one that the kernel filled in: it points to `Control`, of which so many bytes are
        // filled. CMSG_FIRSTHDR is null if there is no whole message in them.
        let message = unsafe { libc::CMSG_FIRSTHDR(newest).as_ref() };
        if let Some(message) = message
            && (message.cmsg_level, message.cmsg_type) == (libc::SOL_SOCKET, libc::SO_RXQ_OVFL)
        {
            // SAFETY: the kernel's message of this type is a u32; it lies in `Control`, maybe unaligned.
            let told = unsafe { libc::CMSG_DATA(message).cast::<u32>().read_unaligned() };
            self.dropped += u64::from(told.wrapping_sub(self.told));
            self.told = told;
        }
    }

    /// One `sendmmsg` per [`SEND_BATCH`] posted messages. The messages of a batch are sent, or charged with their
    /// own error; the call resumes after a failing one. Each turn settles at least one message.
    fn send_batches(&mut self, outbox: &mut Outbox) {
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
                    self.socket.as_raw_fd(),
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

    /// One `sendto` for each posted message.
    fn send_each(&mut self, outbox: &mut Outbox) {
        for index in 0..outbox.len() {
            if outbox.sent(index) == Sent::Posted {
                let begin = MonotonicClock::read();
                let sent = match self.socket.send_to(outbox.bytes(index), outbox.peer(index)) {
                    Ok(_) => Sent::At(begin),
                    Err(error) => Sent::Failed(error.raw_os_error().unwrap_or(libc::EIO)),
                };
                outbox.note(index, sent);
            }
        }
    }
}

impl Datagrams for Udp {
    fn fd(&self) -> Option<RawFd> {
        Some(self.socket.as_raw_fd())
    }

    fn send(&mut self, outbox: &mut Outbox) {
        match self.mode {
            SendMode::Batch => self.send_batches(outbox),
            SendMode::Each => self.send_each(outbox),
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let mut peers = [const { MaybeUninit::<libc::sockaddr_in>::uninit() }; RECEIVE_BATCH];
        let mut slices = [const { MaybeUninit::<libc::iovec>::uninit() }; RECEIVE_BATCH];
        let mut headers = [const { MaybeUninit::<libc::mmsghdr>::uninit() }; RECEIVE_BATCH];
        // One for all: the count only grows, and that of the newest datagram is written last.
        let mut control = Control([0; CONTROL]);
        let inbox = self.inbox.as_mut_ptr();
        for k in 0..self.batch {
            let peer = peers[k].write(sockaddr(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0)));
            // SAFETY: `inbox` has `batch` rooms of `room` bytes each, so room k lies within it.
            let room = unsafe { inbox.add(k * self.room) };
            let slice = slices[k].write(libc::iovec { iov_base: room.cast(), iov_len: self.room });
            let header = headers[k].write(header(peer, slice));
            header.msg_hdr.msg_control = ptr::from_mut(&mut control).cast();
            header.msg_hdr.msg_controllen = CONTROL as _;
        }
        // SAFETY: `batch` headers were written above; each points to an address, a slice and `control` on this stack
        // frame, and each slice to a room of its own in `inbox`, which nothing else touches during the call.
        let count = unsafe {
            libc::recvmmsg(
                self.socket.as_raw_fd(),
                headers.as_mut_ptr().cast(),
                self.batch as libc::c_uint,
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
        let count = self.batch.min(count as usize);
        if let Some(newest) = headers[..count].last() {
            // SAFETY: the headers of every k < batch were written above, and by the kernel since.
            self.count_dropped(unsafe { &newest.assume_init_ref().msg_hdr });
        }
        for k in 0..count {
            // SAFETY: header and address of every k < batch were written above, and by the kernel since.
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
                bytes: &self.inbox[k * self.room..][..self.room.min(header.msg_len as usize)],
                truncated: header.msg_hdr.msg_flags & libc::MSG_TRUNC != 0,
            });
        }
        Ok(count)
    }

    fn batch(&self) -> usize {
        self.batch
    }

    fn dropped(&self) -> u64 {
        self.dropped
    }

    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        regions.add(&*self.inbox);
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
mod tests {
    use super::*;
    use std::time::Duration;

    /// The tests of this file own 127.71.x.0/24, one x each.
    fn address(x: u8, host: u8) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::new(127, 71, x, host), 41136)
    }

    fn options(peers: usize, send: SendMode) -> UdpOptions {
        UdpOptions { peers, waiting: 0, room: 64, send }
    }

    fn peer(x: u8, host: u8) -> UdpSocket {
        let socket = UdpSocket::bind(address(x, host)).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        socket
    }

    /// A message of one byte, its index, posted to each peer.
    fn outbox(peers: &[SocketAddrV4]) -> Outbox {
        let mut outbox = Outbox::new(peers, 64);
        for index in 0..peers.len() {
            outbox.room(index)[0] = index as u8;
            outbox.set_length(index, 1);
            outbox.post(index, true);
        }
        outbox
    }

    /// The next `count` datagrams, or what comes of them within a minute, as (sender, bytes, truncated).
    fn receive(udp: &mut Udp, count: usize) -> Vec<(SocketAddrV4, Vec<u8>, bool)> {
        let mut got = Vec::new();
        let give_up = MonotonicClock::read() + 60 * crate::time::S;
        while got.len() < count && MonotonicClock::read() < give_up {
            let before = got.len();
            let n = udp.receive(&mut |r| got.push((r.from, r.bytes.to_vec(), r.truncated))).unwrap();
            assert!(n == got.len() - before && n <= udp.batch());
        }
        got
    }

    #[test]
    fn more_than_two_batches_go_and_come() {
        for (x, mode) in [(1, SendMode::Batch), (2, SendMode::Each)] {
            let mut udp = Udp::bind(address(x, 1), &options(150, mode)).unwrap();
            let peers: Vec<_> = (0..150).map(|host| peer(x, 100 + host)).collect();
            let mut outbox = outbox(&(0..150).map(|host| address(x, 100 + host)).collect::<Vec<_>>());
            outbox.post(77, false);
            let before = MonotonicClock::read();
            udp.send(&mut outbox);
            let after = MonotonicClock::read();
            let mut bytes = [0; 8];
            for (index, peer) in peers.iter().enumerate() {
                if index == 77 {
                    assert_eq!(outbox.sent(index), Sent::Idle);
                    continue;
                }
                assert!(matches!(outbox.sent(index), Sent::At(at) if before <= at && at <= after));
                let (length, from) = peer.recv_from(&mut bytes).unwrap();
                assert_eq!((length, bytes[0]), (1, index as u8));
                peer.send_to(&bytes[..1], from).unwrap();
            }
            let mut got = receive(&mut udp, 149);
            got.sort();
            let expected: Vec<_> =
                (0..150).filter(|k| *k != 77).map(|k| (address(x, 100 + k), vec![k], false)).collect();
            assert_eq!(got, expected);
        }
    }

    #[test]
    fn a_failing_message_hurts_no_other() {
        // Broadcast without SO_BROADCAST: EACCES. First, in the middle, twice in a row, at a batch's end, last.
        let forbidden = SocketAddrV4::new(Ipv4Addr::BROADCAST, 41136);
        let failing = [0, 5, 6, 63, 64, 99];
        for (x, mode) in [(3, SendMode::Batch), (4, SendMode::Each)] {
            let mut udp = Udp::bind(address(x, 1), &options(100, mode)).unwrap();
            let living = peer(x, 2);
            let peers: Vec<_> =
                (0..100).map(|k| if failing.contains(&k) { forbidden } else { address(x, 2) }).collect();
            let mut outbox = outbox(&peers);
            udp.send(&mut outbox);
            let mut bytes = [0; 8];
            for index in 0..100 {
                if failing.contains(&index) {
                    assert_eq!(outbox.sent(index), Sent::Failed(libc::EACCES), "{index}");
                } else {
                    assert!(matches!(outbox.sent(index), Sent::At(_)), "{index}");
                    living.recv_from(&mut bytes).unwrap();
                    assert_eq!(bytes[0], index as u8);
                }
            }
        }
    }

    #[test]
    fn a_message_too_long_for_udp_is_charged_alone() {
        let mut udp = Udp::bind(address(5, 1), &options(3, SendMode::Batch)).unwrap();
        let mut outbox = Outbox::new(&[address(5, 2), address(5, 3), address(5, 4)], 70_000);
        for (index, length) in [(0, 10), (1, 70_000), (2, 10)] {
            outbox.set_length(index, length);
            outbox.post(index, true);
        }
        udp.send(&mut outbox);
        assert!(matches!(outbox.sent(0), Sent::At(_)));
        assert_eq!(outbox.sent(1), Sent::Failed(libc::EMSGSIZE));
        assert!(matches!(outbox.sent(2), Sent::At(_)));
    }

    #[test]
    fn a_dead_peer_on_a_living_host_is_no_error() {
        // Its ICMP answer would be a pending error on a connected socket.
        let mut udp = Udp::bind(address(6, 1), &options(2, SendMode::Batch)).unwrap();
        let living = peer(6, 2);
        let mut outbox = outbox(&[address(6, 99), address(6, 2)]);
        for _ in 0..3 {
            outbox.post(0, true);
            outbox.post(1, true);
            udp.send(&mut outbox);
            assert!(matches!((outbox.sent(0), outbox.sent(1)), (Sent::At(_), Sent::At(_))));
            assert_eq!(living.recv(&mut [0; 8]).unwrap(), 1);
        }
        assert_eq!(udp.receive(&mut |_| ()).unwrap(), 0);
    }

    #[test]
    fn too_long_is_cut_and_marked_and_strangers_are_named() {
        let mut udp = Udp::bind(address(7, 1), &options(1, SendMode::Batch)).unwrap();
        let stranger = peer(7, 200);
        stranger.send_to(&[7; 64], address(7, 1)).unwrap();
        stranger.send_to(&[8; 65], address(7, 1)).unwrap();
        stranger.send_to(&[], address(7, 1)).unwrap();
        let from = address(7, 200);
        assert_eq!(
            receive(&mut udp, 3),
            [(from, vec![7; 64], false), (from, vec![8; 64], true), (from, vec![], false)]
        );
    }

    #[test]
    fn what_the_kernel_dropped_is_counted_to_the_last_datagram() {
        let mut udp = Udp::bind(address(10, 1), &options(1, SendMode::Batch)).unwrap();
        let stranger = peer(10, 200);
        let (mut sent, mut taken) = (0, 0);
        let mut burst = |udp: &mut Udp, count: usize, taken: &mut u64| {
            // On loopback each is in the buffer, or dropped, before the next one is sent.
            for _ in 0..count {
                stranger.send_to(&[9; 40], address(10, 1)).unwrap();
            }
            while let Ok(more @ 1..) = udp.receive(&mut |_| *taken += 1) {
                assert!(more <= udp.batch());
            }
            sent += count as u64;
            sent
        };
        burst(&mut udp, 5, &mut taken);
        assert_eq!((taken, udp.dropped()), (5, 0));
        for round in 1..4 {
            let before = udp.dropped();
            burst(&mut udp, 2_000, &mut taken);
            // Datagrams after the last one that had room are reported with the next one.
            let sent = burst(&mut udp, 1, &mut taken);
            assert_eq!(taken + udp.dropped(), sent, "round {round}");
            assert!(udp.dropped() > before + 500, "{}", udp.dropped());
        }
    }

    #[test]
    fn each_request_has_its_own_stamp() {
        let mut udp = Udp::bind(address(8, 1), &options(8, SendMode::Each)).unwrap();
        let mut outbox = outbox(&[address(8, 2); 8]);
        udp.send(&mut outbox);
        let stamps: Vec<_> = (0..8)
            .map(|k| match outbox.sent(k) {
                Sent::At(at) => at,
                other => panic!("{other:?}"),
            })
            .collect();
        assert!(stamps.windows(2).all(|pair| pair[0] < pair[1]), "{stamps:?}");
    }

    #[test]
    fn a_second_master_is_refused() {
        let _first = Udp::bind(address(9, 1), &options(1, SendMode::Batch)).unwrap();
        let second = Udp::bind(address(9, 1), &options(1, SendMode::Batch));
        assert_eq!(second.map(|_| ()).unwrap_err().kind(), io::ErrorKind::AddrInUse);
    }
}
