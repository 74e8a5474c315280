//! A serial port on the real-time thread: bytes on a wire that others may share.
//!
//! The port is opened, set and re-opened by the link thread, like a connection. A telegram that the driver takes in
//! parts only is continued by the bus. The driver's queue says how much is still to be sent; what its hardware holds
//! beyond that is a matter of time ([`SerialLine::span_ns`]).

use super::stream::{Broken, Streams};
use crate::time::S;

/// A carrier of bytes on a serial port, which is its connection 0: never waits, never allocates.
pub trait Serial: Streams {
    /// How many sent bytes the driver still holds. At 0 its hardware may hold a few more: the first byte of the next
    /// telegram leaves no sooner than the last one's [span](SerialLine::span_ns) after that began.
    fn unsent(&mut self) -> Result<usize, Broken>;

    /// Drops what was received and not taken in, and what was sent and has not left.
    fn discard(&mut self) -> Result<(), Broken>;

    /// Bytes take the time of their bits; false for a pseudo-terminal, whose other end has them at once.
    fn is_timed(&self) -> bool {
        true
    }
}

/// How bytes are sent on a wire: 8 data bits, 1 stop bit, no flow control.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialLine {
    /// Bits a second; any rate that the driver offers.
    pub rate: u32,
    /// The parity bit.
    pub parity: Parity,
    /// Who switches the direction of the wire.
    pub rs485: Rs485,
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

/// Who switches a transceiver of RS-485 from receiving to sending and back.
///
/// Some adapters, and some drivers, also receive what they send themselves. No request of the operating system says
/// which adapter does: only what comes back does, and whoever uses the port compares it with what it sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Rs485 {
    /// The adapter, by the bytes that it is given: nothing is set.
    #[default]
    Adapter,
    /// The driver of the port, by RTS; it receives nothing meanwhile, where it can. A driver without this is refused.
    Driver,
}

impl SerialLine {
    /// Whether both have the same bits on the wire.
    pub fn agrees_with(&self, other: &SerialLine) -> bool {
        (self.rate, self.parity) == (other.rate, other.parity)
    }

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

#[cfg(test)]
mod tests;
