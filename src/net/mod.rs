//! Sockets and file descriptors, and nothing of any protocol.
//!
//! A bus speaks to a carrier through [`Datagrams`]; the carrier stamps what it sends and takes in, so that the same
//! bus runs over real sockets and in virtual time.
//!
//! | file | what |
//! |---|---|
//! | `outbox` | preallocated requests, patched in place |
//! | `udp` | batched UDP: `sendmmsg`, `recvmmsg` |

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;

mod outbox;
pub mod udp;

pub use outbox::{Outbox, Sent};

use crate::rt::Regions;
use crate::time::Time;

/// A carrier of datagrams on the real-time thread: never waits, never allocates.
pub trait Datagrams: Send {
    /// The descriptor that becomes readable when something arrives; `None` for a carrier without one.
    fn fd(&self) -> Option<RawFd>;

    /// Hands every posted message of `outbox` to the wire and notes in it how each one fared: one failing message
    /// never holds up another.
    fn send(&mut self, outbox: &mut Outbox);

    /// Takes in what has arrived, at most one batch, and calls `take` for each datagram. Returns how many there were;
    /// [`batch`](Self::batch) of them mean that more may be waiting.
    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize>;

    /// The most datagrams that one `receive` takes.
    fn batch(&self) -> usize;

    /// Adds the memory that it touches, to be locked with `memory = "own"`.
    fn memory(&self, regions: &mut Regions);
}

/// Opens carriers: the operating system's ([`Os`]), or those of a virtual world.
pub trait Carriers {
    /// A carrier of datagrams bound to `bind`.
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>>;
}

/// How a UDP carrier works.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UdpOptions {
    /// How many peers it serves; sizes the batches.
    pub peers: usize,
    /// How many datagrams to one peer that is gone are sent before it is given up. They wait in the kernel, which asks
    /// for its hardware address in vain, and take their room from the send buffer of all.
    pub waiting: usize,
    /// The longest datagram that has to fit.
    pub room: usize,
    /// One system call for all requests, or one each with its own stamp.
    pub send: SendMode,
}

/// How requests are handed to the kernel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SendMode {
    /// `sendmmsg`: fewest system calls; every request is stamped with the begin of its batch, so that round trips are
    /// never shown shorter than they are.
    #[default]
    Batch,
    /// One `sendto` a request: an exact stamp for each.
    Each,
}

/// The operating system's own carriers.
#[derive(Clone, Copy, Debug, Default)]
pub struct Os;

/// One datagram that arrived.
#[derive(Clone, Copy, Debug)]
pub struct Received<'a> {
    /// Who sent it.
    pub from: SocketAddrV4,
    /// When it was taken in.
    pub at: Time,
    /// Its bytes. Longer than the carrier's room = cut off there and marked.
    pub bytes: &'a [u8],
    /// The datagram was longer than the room for it.
    pub truncated: bool,
}
