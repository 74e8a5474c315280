//! Sockets and file descriptors, and nothing of any protocol.
//!
//! A bus uses a carrier through [`Datagrams`], [`Streams`], [`Frames`] or [`Serial`]; the carrier stamps what it sends
//! and takes in, so that the same bus runs over real sockets and in virtual time.
//!
//! | file | what |
//! |---|---|
//! | `outbox` | preallocated requests, patched in place |
//! | `udp` | batched UDP: `sendmmsg`, `recvmmsg` |
//! | `groups` | multicast groups of a UDP carrier, joined and left outside the loop |
//! | `stream` | connections as the loop and a protocol see them |
//! | `link` | opens, initialises and re-opens connections and ports, outside the loop |
//! | `tcp` | TCP connections and serial ports on the real-time thread |
//! | `frames` | Ethernet frames as a protocol sees them |
//! | `packet` | frames of a network interface |
//! | `local` | frames of a segment on this host, without an interface |
//! | `serial` | a serial port as a protocol sees it |
//! | `tty` | a serial port of the operating system: its settings |
//! | `clients` | clients of a small server: bounded in number, bytes and time |
//! | `stamp` | when a frame arrived at the end of a segment |
//! | `lock` | one master for each interface and each drive of this host |

use std::io;
use std::net::{SocketAddrV4, UdpSocket};
use std::os::fd::{AsRawFd, RawFd};
use std::sync::{Arc, Mutex, PoisonError, Weak};

pub mod clients;
pub mod frames;
pub mod groups;
pub mod link;
pub mod local;
pub mod lock;
mod outbox;
pub mod packet;
pub mod serial;
mod stamp;
pub mod stream;
mod tcp;
pub mod tty;
pub mod udp;

pub use frames::Frames;
pub use groups::Groups;
pub use lock::{Lock, Place};
pub use outbox::{Outbox, Sent};
pub use serial::{Parity, Rs485, Serial, SerialLine};
pub use stream::{Broken, Handshake, HandshakeState, LinkNotes, StreamPeer, Streams};

use crate::inputs::InputLog;
use crate::rt::Regions;
use crate::time::Time;
use link::LinkThread;
use local::Local;
use packet::Packet;
use tcp::Tcp;
use udp::Udp;

/// A carrier of datagrams on the real-time thread: never waits, never allocates.
pub trait Datagrams: Send {
    /// The descriptor that becomes readable when something arrives; `None` for a carrier without one.
    fn fd(&self) -> Option<RawFd>;

    /// Hands every posted message of `outbox` to the wire and notes in it the result of each: one failing message
    /// never delays another.
    fn send(&mut self, outbox: &mut Outbox);

    /// Takes in what has arrived, at most one batch, and calls `take` for each datagram. Returns how many there were;
    /// [`batch`](Self::batch) of them mean that more may be waiting.
    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize>;

    /// The most datagrams that one `receive` takes.
    fn batch(&self) -> usize;

    /// By which normal threads join and leave multicast groups; `None`: none were wanted by its
    /// [options](UdpOptions::groups).
    fn groups(&self) -> Option<Arc<dyn Groups>> {
        None
    }

    /// The same socket for another thread, which sends from the same address. `None`: the carrier has none, as in
    /// virtual time.
    fn twin(&self) -> io::Result<Option<UdpSocket>> {
        Ok(None)
    }

    /// How many datagrams arrived and were dropped because earlier ones had not been taken in. Those after the last
    /// datagram taken in may be reported with the next one. By default a carrier drops none.
    fn dropped(&self) -> u64 {
        0
    }

    /// Adds the memory that it touches, to be locked with `memory = "own"`.
    fn memory(&self, regions: &mut Regions);
}

/// The most batches taken from a carrier in one call: what does not fit waits for the next one, so that a flood of
/// datagrams never delays the cycle.
const MOST_BATCHES: usize = 4;

/// Takes in what has arrived, up to a bounded amount, and calls `take` for each datagram. False: the carrier had an
/// error.
pub fn take_in(carrier: &mut dyn Datagrams, take: &mut dyn FnMut(Received<'_>)) -> bool {
    for _ in 0..MOST_BATCHES {
        match carrier.receive(take) {
            Ok(count) if count < carrier.batch() => break,
            Ok(_) => {}
            Err(_) => return false,
        }
    }
    true
}

/// Opens carriers: the operating system's ([`Os`]), or those of a virtual world.
#[doc(hidden)]
pub trait Carriers {
    /// A carrier of datagrams bound to `bind`.
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>>;

    /// A carrier of connections to `peers`, in this order. Their opening begins at once and goes on outside the
    /// loop, where sessions stay. The default implementation has none.
    fn streams(&self, _peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        Err(io::ErrorKind::Unsupported.into())
    }

    /// A carrier of the bytes of serial port `port`, set to `line`. Its opening begins at once and goes on outside the
    /// loop. The default implementation has none.
    fn serial(&self, _port: &str, _line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        Err(io::ErrorKind::Unsupported.into())
    }

    /// A carrier of the Ethernet frames of one Ethertype on `interface`. The default implementation has none.
    /// # Errors
    ///
    /// [`NotFound`](io::ErrorKind::NotFound): there is no such interface.
    /// [`PermissionDenied`](io::ErrorKind::PermissionDenied): the right for raw frames is missing. An interface
    /// that is down is no error here: sending on it gives [`Down`](frames::Unsent::Down).
    fn frames(&self, _interface: &str, _ethertype: u16) -> io::Result<Box<dyn Frames>> {
        Err(io::ErrorKind::Unsupported.into())
    }

    /// The log of all that the loop takes from outside, for the queues of a bus. By default there is none.
    fn log(&self) -> InputLog {
        InputLog::default()
    }

    /// Locks `place` for one master, for as long as the lock lives; before anything is opened there. By default,
    /// as in virtual time, there is no other master.
    fn lock(&self, _place: Place<'_>) -> Result<Lock, lock::Refused> {
        Ok(Lock::default())
    }
}

/// Options of a UDP carrier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UdpOptions {
    /// How many peers it serves; sizes the batches.
    pub peers: usize,
    /// How many datagrams are sent to one absent peer before it is given up. They wait in the kernel, whose address
    /// resolution times out, and take their room from the send buffer of all peers.
    pub waiting: usize,
    /// The longest datagram that has to fit.
    pub room: usize,
    /// The requests are marked with this for switches and routers (DSCP, RFC 2474: 0 ... 63). 0: no mark.
    pub dscp: u8,
    /// The most multicast groups that it ever receives from: a group that was left keeps its socket.
    pub groups: usize,
}

/// The operating system's own carriers.
///
/// The first carrier with connections starts the link thread; all from one `Os` share it, and it ends with the last
/// of them.
#[derive(Debug, Default)]
pub struct Os {
    core_of_loop: Option<usize>,
    thread: Mutex<Weak<LinkThread>>,
}

impl Os {
    /// The link thread keeps off this core, which is that of the loop.
    pub fn off_core(core_of_loop: Option<usize>) -> Os {
        Os { core_of_loop, ..Os::default() }
    }

    fn link_thread(&self) -> io::Result<Arc<LinkThread>> {
        let mut thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(running) = thread.upgrade() {
            return Ok(running);
        }
        let started = LinkThread::start(self.core_of_loop)?;
        *thread = Arc::downgrade(&started);
        Ok(started)
    }
}

impl Carriers for Os {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Ok(Box::new(Udp::bind(bind, options)?))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        Ok(Box::new(Tcp::open(&self.link_thread()?, peers)?))
    }

    fn serial(&self, port: &str, line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        Ok(Box::new(Tcp::of_port(&self.link_thread()?, port, line)?))
    }

    fn frames(&self, interface: &str, ethertype: u16) -> io::Result<Box<dyn Frames>> {
        Ok(match local::name(interface) {
            Some(name) => Box::new(Local::open(name)?),
            None => Box::new(Packet::open(interface, ethertype)?),
        })
    }

    fn lock(&self, place: Place<'_>) -> Result<Lock, lock::Refused> {
        place.lock()
    }
}

/// One datagram that arrived.
#[derive(Clone, Copy, Debug)]
pub struct Received<'a> {
    /// The sender.
    pub from: SocketAddrV4,
    /// When it was taken in.
    pub at: Time,
    /// The bytes, cut off at the carrier's room and then marked.
    pub bytes: &'a [u8],
    /// The datagram was longer than the room for it.
    pub truncated: bool,
}

/// Sets an option of a socket that `nix` does not have.
pub fn set_option<T: Copy>(
    socket: &impl AsRawFd,
    level: libc::c_int,
    name: libc::c_int,
    value: T,
) -> io::Result<()> {
    let (fd, length) = (socket.as_raw_fd(), size_of::<T>() as libc::socklen_t);
    // SAFETY: the kernel reads at most the bytes of a live value.
    let refused = unsafe { libc::setsockopt(fd, level, name, (&raw const value).cast(), length) };
    if refused < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}
