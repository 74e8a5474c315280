//! A segment on this host without an interface: whole Ethernet frames as datagrams between Unix sockets (unix(7)).
//!
//! The segment of `local:NAME` listens at the abstract address `fieldbeat-local/NAME` of its network namespace; a
//! master has an address of its own, to which its frames return. This needs no rights and leaves nothing in the
//! file system. A segment that does not exist yet, or no longer, is like an interface that is down.

use std::io;
use std::os::fd::{AsRawFd, OwnedFd, RawFd};

use nix::errno::Errno;
use nix::sys::socket::{
    AddressFamily, MsgFlags, SockFlag, SockType, UnixAddr, bind, recv, sendto, setsockopt, socket, sockopt,
};

use super::frames::{self, Frames, MAC, Unsent};
use super::stamp;
use crate::rt::{MonotonicClock, Regions};
use crate::time::Time;

/// Prefix of such an interface's name.
pub const PREFIX: &str = "local:";
/// Prefix of the addresses of all segments, after the zero that makes them abstract.
const SPACE: &str = "fieldbeat-local/";
/// The longest abstract address: the path of a `sockaddr_un` without its first zero.
const LONGEST: usize = 107;

/// The name of the segment that an interface stands for; `None`: it is a real one.
pub fn name(interface: &str) -> Option<&str> {
    interface.strip_prefix(PREFIX)
}

/// One end of a segment on this host.
#[derive(Debug)]
pub struct Local {
    socket: OwnedFd,
    /// The destination of its frames; `None`: nothing was received yet.
    peer: Option<UnixAddr>,
    /// It is the segment's end: it answers the sender it received from last, and reports send times, however late
    /// it reads.
    answers: bool,
}

impl Local {
    /// The master's end of the segment `name`; the segment need not exist yet.
    ///
    /// # Errors
    ///
    /// A name that is too long; no descriptors left.
    pub fn open(name: &str) -> io::Result<Local> {
        let peer = Some(address(name)?);
        // An address of its own, for the returning frames.
        Ok(Local { socket: bound(&UnixAddr::new_unnamed())?, peer, answers: false })
    }

    /// The segment's end: its frames go to the sender that it received from last.
    ///
    /// # Errors
    ///
    /// As above, and [`AddrInUse`](io::ErrorKind::AddrInUse) if the segment is served already.
    pub fn serve(name: &str) -> io::Result<Local> {
        let socket = bound(&address(name)?)?;
        setsockopt(&socket, sockopt::ReceiveTimestampns, &true)?;
        Ok(Local { socket, peer: None, answers: true })
    }
}

fn bound(address: &UnixAddr) -> io::Result<OwnedFd> {
    let flags = SockFlag::SOCK_NONBLOCK | SockFlag::SOCK_CLOEXEC;
    let socket = socket(AddressFamily::Unix, SockType::Datagram, flags, None)?;
    bind(socket.as_raw_fd(), address)?;
    Ok(socket)
}

fn address(name: &str) -> io::Result<UnixAddr> {
    if name.is_empty() || SPACE.len() + name.len() > LONGEST {
        let message = format!("{PREFIX}{name}: a name has 1 to {} bytes", LONGEST - SPACE.len());
        return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
    }
    Ok(UnixAddr::new_abstract(format!("{SPACE}{name}").as_bytes())?)
}

impl Frames for Local {
    fn fd(&self) -> Option<RawFd> {
        Some(self.socket.as_raw_fd())
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let begin = MonotonicClock::read();
        let peer = self.peer.as_ref().ok_or(Unsent::Down)?;
        let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL;
        match sendto(self.socket.as_raw_fd(), frame, peer, flags) {
            Ok(_) => Ok(begin),
            Err(Errno::ECONNREFUSED | Errno::ENOENT) => Err(Unsent::Down),
            Err(Errno::EAGAIN | Errno::ENOBUFS) => Err(Unsent::Full),
            Err(errno) => Err(Unsent::Failed(errno as i32)),
        }
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        if self.answers {
            let (sent_at, length, from) = stamp::receive(&self.socket, room)?;
            self.peer = from;
            return Some((sent_at, length));
        }
        let count = recv(self.socket.as_raw_fd(), room, MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_TRUNC).ok()?;
        Some((MonotonicClock::read(), count))
    }

    fn now(&mut self) -> Time {
        MonotonicClock::read()
    }

    fn today_ns(&self) -> Option<u64> {
        frames::today_ns()
    }

    fn mac(&self) -> [u8; 6] {
        MAC
    }

    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A name that no other test has.
    fn own(what: &str) -> String {
        format!("{what}-{}", std::process::id())
    }

    #[test]
    fn local_date_is_that_of_the_computer() {
        let carrier = Local::open(&own("date")).unwrap();
        let unix_ns = std::time::UNIX_EPOCH.elapsed().unwrap().as_nanos() as u64;
        let since_2000 = unix_ns - (30 * 365 + 7) * 24 * 3_600 * crate::time::S;
        assert!(since_2000.abs_diff(carrier.today_ns().unwrap()) < 10 * crate::time::S);
    }

    /// A line, and a master that is open on it.
    fn both(what: &str) -> (Local, Local) {
        let name = own(what);
        (Local::serve(&name).unwrap(), Local::open(&name).unwrap())
    }

    fn receive(end: &mut Local) -> Option<Vec<u8>> {
        let mut room = [0; 32];
        end.receive(&mut room).map(|(_, length)| room[..length.min(32)].to_vec())
    }

    #[test]
    fn frames_go_to_the_segment_and_come_back_to_their_sender() {
        let name = own("there-and-back");
        let mut line = Local::serve(&name).unwrap();
        let mut masters = [Local::open(&name).unwrap(), Local::open(&name).unwrap()];
        assert_eq!(line.send(&[0]), Err(Unsent::Down), "nothing was received yet");
        for (end, byte) in [(0, 1), (1, 2), (0, 3)] {
            let end = &mut masters[end];
            assert_eq!(receive(end), None);
            let before = end.now();
            assert!(end.send(&[byte; 29]).unwrap() >= before);
            assert_eq!(receive(&mut line), Some(vec![byte; 29]), "unpadded");
            line.send(&[byte, 7]).unwrap();
            assert_eq!(receive(end), Some(vec![byte, 7]));
        }
        assert!(masters.iter_mut().all(|end| receive(end).is_none()));
        assert_eq!(masters[0].mac()[0] & 3, 0, "of one card, and without the bit that a slave sets");
    }

    #[test]
    fn a_late_receive_has_the_time_of_the_wire_and_a_frame_longer_than_its_room_is_reported() {
        let (mut line, mut master) = both("stamps");
        master.send(&[1]).unwrap();
        let sent_by = master.now();
        std::thread::sleep(std::time::Duration::from_millis(100));
        // The stamp is made before the send returns, so that a host that takes the processor changes nothing.
        let (at, _) = line.receive(&mut [0; 8]).unwrap();
        let looked_at = line.now();
        assert!(at.since(sent_by) < looked_at.since(at), "{sent_by:?} {at:?} {looked_at:?}");
        master.send(&[9; 1514]).unwrap();
        let mut room = [0; 32];
        assert_eq!(line.receive(&mut room).map(|(_, length)| length), Some(1514));
        assert_eq!(room, [9; 32]);
        assert!(line.receive(&mut room).is_none());
    }

    #[test]
    fn a_name_is_served_once_and_has_a_length() {
        let name = own("twice");
        let first = Local::serve(&name).unwrap();
        assert_eq!(Local::serve(&name).unwrap_err().kind(), io::ErrorKind::AddrInUse);
        drop(first);
        assert!(Local::serve(&name).is_ok());
        for wrong in ["", &"x".repeat(200)] {
            assert_eq!(Local::open(wrong).unwrap_err().kind(), io::ErrorKind::InvalidInput);
        }
        let most = "y".repeat(LONGEST - SPACE.len());
        assert!(Local::open(&most).is_ok() && Local::open(&format!("{most}y")).is_err());
        assert_eq!((super::name("local:x"), super::name("eth0")), (Some("x"), None));
    }
}
