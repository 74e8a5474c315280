//! A serial port on the real-time thread: bytes on a wire that others may share.
//!
//! The port is opened, set and re-opened by the link thread; nothing here opens, waits, closes or allocates. A telegram
//! that the driver takes in parts only is continued by the bus. The driver's queue says how much is still to be sent;
//! what its hardware holds beyond that is a matter of time ([`SerialLine::span_ns`]).

use std::io;
use std::os::fd::{AsRawFd, OwnedFd, RawFd};
use std::sync::Arc;

use nix::errno::Errno;
use nix::sys::socket::{MsgFlags, send};
use nix::unistd::{read, write};

use super::link::{LinkThread, PortEnds};
use super::stream::{Broken, LinkNotes};
use super::tty;
use crate::rt::{MonotonicClock, Regions};
use crate::time::{S, Time};

/// The most reads of a discard: each takes one room.
const DISCARDS: usize = 64;

/// A carrier of bytes on a serial port: never waits, never allocates.
pub trait Serial: Send {
    /// The descriptor that is readable while something waits to be received, and while a broken port has not been
    /// given up. Queried before each wait. `None`: the port is not open, or the carrier has no descriptor.
    fn fd(&self) -> Option<RawFd>;

    /// Takes over the port if it was opened since the last call: nothing of an earlier opening is left.
    fn opened(&mut self) -> bool;

    /// Hands the front of `bytes` to the driver; returns the time before that and how many it took, 0 if it takes none
    /// now.
    fn send(&mut self, bytes: &[u8]) -> Result<(Time, usize), Broken>;

    /// Takes in what has arrived, at most all of `room`, with the time of the read. `None`: nothing.
    fn receive(&mut self, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken>;

    /// How many sent bytes the driver still holds. At 0 its hardware may hold a few more: the first byte of the next
    /// telegram leaves no sooner than the last one's [span](SerialLine::span_ns) after that began.
    fn unsent(&mut self) -> Result<usize, Broken>;

    /// Drops what was received and not taken in, and what was sent and has not left.
    fn discard(&mut self) -> Result<(), Broken>;

    /// Gives the port up for this reason. It is closed, and opened anew after a pause.
    fn abandon(&mut self, why: &'static str);

    /// What opens the port has ended unexpectedly: an open one is the last.
    fn has_ended(&self) -> bool {
        false
    }

    /// Why the port is not open, under index 0, for normal threads.
    fn notes(&self) -> LinkNotes;

    /// Adds the memory that it touches, to be locked with `memory = "own"`.
    fn memory(&self, regions: &mut Regions);
}

/// How bytes are sent on a wire: 8 data bits, 1 stop bit, no flow control.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialLine {
    /// Bits a second; any rate that the driver offers.
    pub rate: u32,
    /// The parity bit.
    pub parity: Parity,
}

/// The parity bit of each byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Parity {
    /// There is none.
    #[default]
    None,
    /// Even, as PROFIBUS has it (IEC 61158-2). A byte with a wrong one is received as 0.
    Even,
}

impl SerialLine {
    /// The time of so many bits on the wire, ns, rounded up.
    pub fn bits_ns(&self, bits: u64) -> u64 {
        bits.saturating_mul(S).div_ceil(u64::from(self.rate.max(1)))
    }

    /// The time of so many bytes in a row on the wire, ns, rounded up: each has a start bit, 8 data bits, maybe a
    /// parity bit, and a stop bit.
    pub fn span_ns(&self, bytes: usize) -> u64 {
        let bits = 10 + u64::from(self.parity == Parity::Even);
        self.bits_ns(bits.saturating_mul(bytes as u64))
    }
}

/// A serial port of the operating system, or a simulated wire of this host (`local:NAME`). When dropped at the loop's
/// end it closes an open port in order, so that what was sent last leaves.
#[derive(Debug)]
pub struct Port {
    open: Option<OpenPort>,
    link: PortEnds,
}

/// An open port.
#[derive(Debug)]
pub(in crate::net) struct OpenPort {
    pub fd: OwnedFd,
    /// It is a terminal device, not a socket.
    pub is_tty: bool,
}

impl OpenPort {
    /// Drops what is not sent: a driver's close waits for that, up to 30 s.
    pub fn reset(self) {
        if self.is_tty {
            tty::flush(&self.fd);
        }
    }
}

/// Others may use it again.
impl Drop for OpenPort {
    fn drop(&mut self) {
        if self.is_tty {
            tty::release(&self.fd);
        }
    }
}

impl Port {
    /// Port `path`, opened by `thread`.
    pub(super) fn open(thread: &Arc<LinkThread>, path: &str, line: &SerialLine) -> Port {
        Port { open: None, link: thread.carry_port(path, *line) }
    }

    fn port(&self) -> Result<&OpenPort, Broken> {
        self.open.as_ref().ok_or(Broken::Absent)
    }
}

impl Serial for Port {
    fn fd(&self) -> Option<RawFd> {
        self.open.as_ref().map(|port| port.fd.as_raw_fd())
    }

    fn opened(&mut self) -> bool {
        let Ok(port) = self.link.opened.pop() else { return false };
        self.open = Some(port);
        true
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let port = self.port()?;
        let begin = MonotonicClock::read();
        let taken = match port.is_tty {
            true => write(&port.fd, bytes),
            false => send(port.fd.as_raw_fd(), bytes, MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL),
        };
        match taken {
            Ok(count) => Ok((begin, count)),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok((begin, 0)),
            Err(errno) => Err(Broken::Failed(errno as i32)),
        }
    }

    fn receive(&mut self, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let port = self.port()?;
        // A read of nothing returns 0, as of a port that is gone.
        if room.is_empty() {
            return Ok(None);
        }
        match read(&port.fd, room) {
            Ok(0) => Err(Broken::Closed),
            Ok(count) => Ok(Some((MonotonicClock::read(), count))),
            Err(Errno::EAGAIN | Errno::EINTR) => Ok(None),
            Err(errno) => Err(Broken::Failed(errno as i32)),
        }
    }

    fn unsent(&mut self) -> Result<usize, Broken> {
        let mut count: libc::c_int = 0;
        // SAFETY: the kernel writes one int. Sockets have the same request by the name SIOCOUTQ.
        let refused = unsafe { libc::ioctl(self.port()?.fd.as_raw_fd(), libc::TIOCOUTQ, &raw mut count) } < 0;
        if refused { Err(Broken::Failed(last_errno())) } else { Ok(usize::try_from(count).unwrap_or(0)) }
    }

    fn discard(&mut self) -> Result<(), Broken> {
        let port = self.port()?;
        if port.is_tty && !tty::flush(&port.fd) {
            return Err(Broken::Failed(last_errno()));
        }
        // A socket has no such request; a terminal has nothing left.
        for _ in 0..DISCARDS {
            if self.receive(&mut [0; 256])?.is_none() {
                break;
            }
        }
        Ok(())
    }

    fn abandon(&mut self, why: &'static str) {
        if let Some(port) = self.open.take() {
            // Never full: there is one port.
            let _ = self.link.given_back.push((port, why));
            self.link.bell.ring();
        }
    }

    fn has_ended(&self) -> bool {
        self.link.bell.has_ended()
    }

    fn notes(&self) -> LinkNotes {
        self.link.notes.clone()
    }

    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        regions.extend(&self.link.regions);
    }
}

fn last_errno() -> i32 {
    io::Error::last_os_error().raw_os_error().unwrap_or(libc::EIO)
}

#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
