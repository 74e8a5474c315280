//! What the exchanges of a bus put on its wire, for whoever estimates what a cycle costs.

use std::net::Ipv4Addr;

/// As what the exchanges of a bus are handed to the kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Medium {
    /// A datagram each way.
    Datagrams,
    /// A message each way on a connection.
    Streams,
    /// Ethernet frames that serve all drives of a cycle.
    Frames,
    /// A telegram each way on a serial port. What its wire takes is laid on the grid by the bus.
    Serial,
}

/// Where the exchanges of a bus leave this computer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Way {
    /// By the interface that has this address, or the one to this address where a bus is bound to none.
    Address(Ipv4Addr),
    /// By this interface.
    Interface(String),
    /// By this serial port.
    Port(String),
}

/// The load of a bus's exchanges on its wire.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Load {
    /// As what.
    pub medium: Medium,
    /// By which way.
    pub way: Way,
    /// The shortest request and reply of a drive, bytes of a datagram or message.
    pub bytes: [usize; 2],
    /// Of [`Medium::Frames`]: the frames of a cycle, bytes from the address to the last one before the checksum.
    pub frames: Vec<usize>,
}

impl Load {
    /// Exchanges by `way` with at least so many bytes each way, and no frames for several drives.
    pub fn new(medium: Medium, way: Way, bytes: [usize; 2]) -> Load {
        Load { medium, way, bytes, frames: Vec::new() }
    }
}
