//! Ethernet frames of one Ethertype on a real interface: AF_PACKET behind [`Frames`] (packet(7)).
//!
//! The socket is bound to the Ethertype and the interface, so that the kernel delivers no other frame. It does not
//! receive its own frames (PACKET_IGNORE_OUTGOING), and sends directly to the driver's queue (PACKET_QDISC_BYPASS).
//! It needs CAP_NET_RAW. The kernel counts frames that it drops because they were not taken in (PACKET_STATISTICS);
//! only normal threads read that count. When the interface goes down the socket stays bound, and works again when
//! the interface is back; not so if the interface is removed.

use std::io;
use std::mem::{size_of, zeroed};
use std::os::fd::{AsRawFd, OwnedFd, RawFd};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};

use nix::errno::Errno;
use nix::net::if_::if_nametoindex;
use nix::sys::socket::{
    AddressFamily, MsgFlags, SockFlag, SockType, recv, send, setsockopt, socket, sockopt,
};

use super::frames::{self, Dropped, Frames, Unsent};
use super::{set_option, stamp};
use crate::rt::{MonotonicClock, Regions};
use crate::time::Time;

type Name = [libc::c_char; libc::IFNAMSIZ];

/// A socket for the frames of one Ethertype on one interface.
#[derive(Debug)]
pub struct Packet {
    socket: Arc<OwnedFd>,
    mac: [u8; 6],
    /// The name of the interface, in the form of the kernel's requests.
    name: Name,
    /// It is the segment's end: it reports when its frames arrived, however late it reads.
    answers: bool,
    errors: u64,
    drops: Arc<Drops>,
}

/// Frames dropped by the kernel, which resets its count on each read.
#[derive(Debug)]
struct Drops {
    /// A later reader must not keep it open.
    socket: Weak<OwnedFd>,
    reported: AtomicU64,
}

impl Drop for Packet {
    fn drop(&mut self) {
        // Frames dropped since the last read.
        self.drops.count();
    }
}

impl Dropped for Drops {
    fn count(&self) -> u64 {
        let Some(socket) = self.socket.upgrade() else { return self.reported.load(Ordering::Relaxed) };
        // SAFETY: all bytes zero are valid counts.
        let mut counts: libc::tpacket_stats = unsafe { zeroed() };
        let mut length = size_of::<libc::tpacket_stats>() as libc::socklen_t;
        // SAFETY: the kernel writes at most `length` bytes into a live value.
        let refused = unsafe {
            libc::getsockopt(
                socket.as_raw_fd(),
                libc::SOL_PACKET,
                libc::PACKET_STATISTICS,
                (&raw mut counts).cast(),
                &raw mut length,
            )
        };
        let new = if refused < 0 { 0 } else { u64::from(counts.tp_drops) };
        self.reported.fetch_add(new, Ordering::Relaxed) + new
    }
}

impl Packet {
    /// A socket on `interface`.
    ///
    /// # Errors
    ///
    /// [`NotFound`](io::ErrorKind::NotFound): there is no such interface;
    /// [`PermissionDenied`](io::ErrorKind::PermissionDenied): no CAP_NET_RAW; others of the operating system.
    pub fn open(interface: &str, ethertype: u16) -> io::Result<Packet> {
        let (index, name) = find(interface)?;
        let flags = SockFlag::SOCK_NONBLOCK | SockFlag::SOCK_CLOEXEC;
        // Protocol 0: it receives nothing until it is bound.
        let socket = socket(AddressFamily::Packet, SockType::Raw, flags, None);
        let socket = Arc::new(socket.map_err(|errno| refused(interface, errno.into()))?);
        for option in [libc::PACKET_IGNORE_OUTGOING, libc::PACKET_QDISC_BYPASS] {
            set_option(&socket, libc::SOL_PACKET, option, 1_i32)?;
        }
        // SAFETY: all bytes zero are a valid address of nobody.
        let mut address: libc::sockaddr_ll = unsafe { zeroed() };
        address.sll_family = libc::AF_PACKET as u16;
        address.sll_protocol = ethertype.to_be();
        address.sll_ifindex = index;
        let mut length = size_of::<libc::sockaddr_ll>() as libc::socklen_t;
        let fd = socket.as_raw_fd();
        // SAFETY: the kernel reads and writes at most `length` bytes of a live address; its own address is shorter.
        let refused = unsafe {
            libc::bind(fd, (&raw const address).cast(), length) < 0
                || libc::getsockname(fd, (&raw mut address).cast(), &raw mut length) < 0
        };
        if refused {
            return Err(io::Error::last_os_error());
        }
        let [a, b, c, d, e, f, ..] = address.sll_addr;
        let drops = Arc::new(Drops { socket: Arc::downgrade(&socket), reported: AtomicU64::new(0) });
        Ok(Packet { socket, mac: [a, b, c, d, e, f], name, answers: false, errors: 0, drops })
    }

    /// The same for a segment's end of the cable.
    ///
    /// # Errors
    ///
    /// As above.
    pub fn serve(interface: &str, ethertype: u16) -> io::Result<Packet> {
        let mut packet = Packet::open(interface, ethertype)?;
        setsockopt(&packet.socket, sockopt::ReceiveTimestampns, &true)?;
        packet.answers = true;
        Ok(packet)
    }

    /// There is a cable, and the interface is up. Queried only when the kernel did not accept a frame.
    fn is_running(&self) -> bool {
        // SAFETY: all bytes zero are a valid request.
        let mut request = libc::ifreq { ifr_name: self.name, ..unsafe { zeroed() } };
        // SAFETY: the kernel reads the name and writes the flags of a live value.
        let result = unsafe { libc::ioctl(self.socket.as_raw_fd(), libc::SIOCGIFFLAGS, &raw mut request) };
        // SAFETY: the kernel has written the flags, or they are zero from the beginning.
        result >= 0 && i32::from(unsafe { request.ifr_ifru.ifru_flags }) & libc::IFF_RUNNING != 0
    }
}

/// The number of an interface, and its name.
fn find(interface: &str) -> io::Result<(libc::c_int, Name)> {
    let missing = || {
        let message = format!("there is no network interface {interface} (ip link shows which there are)");
        io::Error::new(io::ErrorKind::NotFound, message)
    };
    let index = if_nametoindex(interface).map_err(|_| missing())?;
    let mut name: Name = [0; libc::IFNAMSIZ];
    for (place, byte) in name.iter_mut().zip(interface.bytes()) {
        *place = byte as libc::c_char;
    }
    Ok((index as libc::c_int, name))
}

/// Why there is no socket.
fn refused(interface: &str, error: io::Error) -> io::Error {
    match error.kind() {
        io::ErrorKind::PermissionDenied => {
            let message = format!("no right for raw frames on {interface} (CAP_NET_RAW)");
            io::Error::new(error.kind(), message)
        }
        _ => error,
    }
}

impl Frames for Packet {
    fn fd(&self) -> Option<RawFd> {
        Some(self.socket.as_raw_fd())
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let begin = MonotonicClock::read();
        match send(self.socket.as_raw_fd(), frame, MsgFlags::MSG_DONTWAIT) {
            Ok(_) => Ok(begin),
            Err(Errno::ENETDOWN | Errno::ENXIO | Errno::ENODEV) => Err(Unsent::Down),
            // Without a cable the kernel says the same.
            Err(Errno::ENOBUFS) if !self.is_running() => Err(Unsent::Down),
            Err(Errno::ENOBUFS | Errno::EAGAIN) => Err(Unsent::Full),
            Err(errno) => Err(Unsent::Failed(errno as i32)),
        }
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        if self.answers {
            return stamp::receive::<()>(&self.socket, room).map(|(at, length, _)| (at, length));
        }
        match recv(self.socket.as_raw_fd(), room, MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_TRUNC) {
            Ok(count) => Some((MonotonicClock::read(), count)),
            Err(errno) => {
                // An error is that of the interface, reported once; there is no frame.
                self.errors += u64::from(errno != Errno::EAGAIN);
                None
            }
        }
    }

    fn now(&mut self) -> Time {
        MonotonicClock::read()
    }

    fn today_ns(&self) -> Option<u64> {
        frames::today_ns()
    }

    fn mac(&self) -> [u8; 6] {
        self.mac
    }

    fn errors(&self) -> u64 {
        self.errors
    }

    fn dropped(&self) -> Option<Arc<dyn Dropped>> {
        Some(Arc::clone(&self.drops) as Arc<dyn Dropped>)
    }

    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        regions.add(&*self.socket);
    }
}

#[cfg(test)]
mod tests {
    use std::process::Command;
    use std::time::Duration;

    use fieldbeat_testing::until;
    use nix::sched::{CloneFlags, unshare};

    use super::*;

    const TYPE: u16 = 0x88A4;
    const NEAR: &str = "near0";
    const FAR: &str = "far0";

    fn ip(arguments: &str) {
        let done =
            Command::new("ip").args(arguments.split_whitespace()).status().expect("iproute2 is installed");
        assert!(done.success(), "ip {arguments}");
    }

    /// Both ends of a cable, in a network namespace of this thread's own that disappears with it.
    fn cable() {
        unshare(CloneFlags::CLONE_NEWNET).expect("it runs as root");
        ip(&format!("link add {NEAR} address 02:00:00:00:00:01 type veth peer name {FAR}"));
        for end in [NEAR, FAR] {
            ip(&format!("link set {end} up"));
        }
    }

    /// A frame of so many bytes.
    fn frame(ethertype: u16, length: usize) -> Vec<u8> {
        let mut frame = vec![0xFF; 12];
        frame.extend(ethertype.to_be_bytes());
        frame.resize(length, 0x5A);
        frame
    }

    /// The next frame.
    fn receive(socket: &mut Packet, room: &mut [u8]) -> Option<usize> {
        next(socket, room).map(|(_, length)| length)
    }

    /// The same, with its time.
    fn next(socket: &mut Packet, room: &mut [u8]) -> Option<(Time, usize)> {
        let mut next = None;
        until("received", || {
            next = socket.receive(room);
            next.is_some()
        });
        next
    }

    /// Waits until the interface has followed its other end.
    fn until_sent(socket: &mut Packet, sent: impl Fn(Result<Time, Unsent>) -> bool) {
        until("followed", || sent(socket.send(&frame(TYPE, 60))));
    }

    #[test]
    #[ignore = "makes a network of its own: needs root"]
    fn frames_of_one_kind_pass_a_cable_and_no_others_do() {
        cable();
        let mut near = Packet::open(NEAR, TYPE).unwrap();
        let mut far = Packet::open(FAR, TYPE).unwrap();
        let mut other = Packet::open(FAR, 0x88B5).unwrap();
        assert_eq!(near.mac(), [2, 0, 0, 0, 0, 1]);
        let mut room = [0; 1600];
        for length in [29, 60, 1514] {
            let before = near.now();
            assert!(near.send(&frame(TYPE, length)).unwrap() >= before);
            assert_eq!(receive(&mut far, &mut room), Some(length));
            assert_eq!(room[..length], frame(TYPE, length));
        }
        // A foreign frame in between reaches its own socket alone.
        near.send(&frame(0x88B5, 61)).unwrap();
        near.send(&frame(TYPE, 62)).unwrap();
        assert_eq!(receive(&mut other, &mut room), Some(61));
        assert_eq!(receive(&mut far, &mut room), Some(62));
        assert!(near.receive(&mut room).is_none(), "what it sent itself");
        near.send(&frame(TYPE, 100)).unwrap();
        let mut short = [0; 40];
        assert_eq!(receive(&mut far, &mut short), Some(100), "cut off and reported");
        assert!(far.receive(&mut room).is_none() && other.receive(&mut room).is_none());
    }

    #[test]
    #[ignore = "makes a network of its own: needs root"]
    fn a_line_has_the_time_of_the_wire_however_late_it_looks() {
        cable();
        let mut near = Packet::open(NEAR, TYPE).unwrap();
        let mut far = Packet::serve(FAR, TYPE).unwrap();
        // The kernel begins to stamp a while after the request.
        let has_its_time = (0..50).any(|_| {
            near.send(&frame(TYPE, 60)).unwrap();
            let sent_by = near.now();
            std::thread::sleep(Duration::from_millis(20));
            let (at, length) = next(&mut far, &mut [0; 60]).unwrap();
            assert_eq!(length, 60);
            at.since(sent_by) < far.now().since(at)
        });
        assert!(has_its_time);
        near.send(&frame(TYPE, 100)).unwrap();
        assert_eq!(receive(&mut far, &mut [0; 40]), Some(100), "cut off and reported");
        assert!(far.receive(&mut [0; 40]).is_none());
    }

    #[test]
    #[ignore = "makes a network of its own: needs root"]
    fn frames_dropped_by_the_kernel_and_interface_errors_are_counted() {
        cable();
        let mut near = Packet::open(NEAR, TYPE).unwrap();
        let mut far = Packet::open(FAR, TYPE).unwrap();
        until_sent(&mut near, |sent| sent.is_ok());
        let dropped = far.dropped().expect("the kernel counts");
        let mut room = [0; 1600];
        while receive(&mut far, &mut room).is_some() && far.receive(&mut room).is_some() {}
        assert_eq!((dropped.count(), far.errors()), (0, 0));
        let mut before = 0;
        for _ in 0..2 {
            // More than any receive buffer holds; nothing is taken in meanwhile.
            let sent = (0..20_000).filter(|_| near.send(&frame(TYPE, 1_000)).is_ok()).count() as u64;
            let lost = dropped.count() - before;
            let mut taken = 0;
            while far.receive(&mut room).is_some() {
                taken += 1;
            }
            assert!(lost > 0 && taken > 0 && taken + lost <= sent, "{taken} + {lost} of {sent}");
            before += lost;
            assert_eq!(dropped.count(), before, "reported once, and kept");
        }
        ip(&format!("link set {FAR} down"));
        assert!(far.receive(&mut room).is_none() && far.receive(&mut room).is_none());
        assert_eq!(far.errors(), 1);
        assert_eq!(near.errors(), 0);
    }

    #[test]
    #[ignore = "makes a network of its own: needs root"]
    fn an_interface_that_is_down_or_has_no_cable_is_reported_and_comes_back() {
        cable();
        let mut near = Packet::open(NEAR, TYPE).unwrap();
        let is_down = |sent| sent == Err(Unsent::Down);
        until_sent(&mut near, |sent| sent.is_ok());
        ip(&format!("link set {FAR} down"));
        until_sent(&mut near, is_down);
        ip(&format!("link set {FAR} up"));
        until_sent(&mut near, |sent| sent.is_ok());
        ip(&format!("link set {NEAR} down"));
        assert!(is_down(near.send(&frame(TYPE, 60))));
        let down = Packet::open(NEAR, TYPE);
        assert!(is_down(down.unwrap().send(&frame(TYPE, 60))), "it may be opened");
        ip(&format!("link set {NEAR} up"));
        until_sent(&mut near, |sent| sent.is_ok());
        let mut far = Packet::open(FAR, TYPE).unwrap();
        near.send(&frame(TYPE, 77)).unwrap();
        assert_eq!(receive(&mut far, &mut [0; 80]), Some(77));
        ip(&format!("link del {NEAR}"));
        assert!(is_down(near.send(&frame(TYPE, 60))));
    }

    #[test]
    fn a_missing_interface_is_reported_by_name() {
        for name in ["nosuch0", "a-name-that-no-kernel-takes", "a\0b", ""] {
            let error = Packet::open(name, TYPE).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::NotFound);
            assert!(error.to_string().contains("there is no network interface"), "{error}");
        }
        let error = refused("eth1", io::ErrorKind::PermissionDenied.into());
        assert!(error.to_string().contains("eth1 (CAP_NET_RAW)"), "{error}");
        assert_eq!(error.kind(), io::ErrorKind::PermissionDenied);
    }
}
