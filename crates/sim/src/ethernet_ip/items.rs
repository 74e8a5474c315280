//! The common packet format: items behind an encapsulation header, or alone in a datagram.
//!
//! Facts: sheet, 1.3.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::cip::Reader;

/// Item types.
pub(super) mod item {
    pub const NULL: u16 = 0x0000;
    pub const IDENTITY: u16 = 0x000C;
    pub const CONNECTED_ADDRESS: u16 = 0x00A1;
    pub const CONNECTED_DATA: u16 = 0x00B1;
    pub const UNCONNECTED_DATA: u16 = 0x00B2;
    pub const SERVICES: u16 = 0x0100;
    pub const SOCKADDR_OUT: u16 = 0x8000;
    pub const SOCKADDR_IN: u16 = 0x8001;
    pub const SEQUENCED_ADDRESS: u16 = 0x8002;
}

/// The length of a socket address.
const SOCKADDR: usize = 16;

/// The items of a message: an address, data, and what may come behind them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Items<'a> {
    pub address: (u16, &'a [u8]),
    pub data: (u16, &'a [u8]),
    /// The port that the originator wants packets at.
    pub port: Option<u16>,
    /// Nothing is behind them.
    pub whole: bool,
}

impl<'a> Items<'a> {
    /// The first two items and the socket addresses, wherever they are; `None`: there is less than the count says.
    pub(super) fn parse(bytes: &'a [u8]) -> Option<Items<'a>> {
        let mut from = Reader(bytes);
        let count = from.u16().filter(|count| (2..=8).contains(count))?;
        let mut next = || {
            let kind = from.u16()?;
            let length = from.u16()?;
            Some((kind, from.take(length.into())?))
        };
        let (address, data) = (next()?, next()?);
        let mut port = None;
        for _ in 2..count {
            let (kind, data) = next()?;
            if kind == item::SOCKADDR_IN && data.len() == SOCKADDR {
                port = Some(u16::from_be_bytes([data[2], data[3]]));
            }
        }
        Some(Items { address, data, port, whole: from.0.is_empty() })
    }
}

/// Appends an item.
pub(super) fn append(kind: u16, data: &[u8], out: &mut Vec<u8>) {
    out.extend(kind.to_le_bytes());
    out.extend((data.len() as u16).to_le_bytes());
    out.extend(data);
}

/// A socket address, big-endian.
pub(super) fn sockaddr(address: SocketAddrV4) -> [u8; SOCKADDR] {
    let mut bytes = [0; SOCKADDR];
    bytes[1] = 2;
    bytes[2..4].copy_from_slice(&address.port().to_be_bytes());
    bytes[4..8].copy_from_slice(&address.ip().octets());
    bytes
}

/// The address of "wherever this comes from".
pub(super) fn any(port: u16) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port)
}
