//! Class 1 packets: process data on UDP 2222, without a header of the encapsulation (EtherNet/IP, volume 2, 2-6).
//!
//! | bytes | field |
//! |---|---|
//! | 0-1 | 2 items |
//! | 2-5 | sequenced address, 8 bytes |
//! | 6-9 | connection id |
//! | 10-13 | sequence number of the encapsulation: +1 for each packet |
//! | 14-17 | connected data, and its size: the connection size |
//! | 18-19 | sequence count of CIP: +1 for new data |
//! | 20-23 | ours only: bit 0 is run |
//! | 20- / 24- | the assembly |

use super::assembly::{OUTPUT_SIZE, Outputs};
use super::cpf::item;

/// Offsets in a packet.
mod field {
    use std::ops::Range;

    pub const CONNECTION: Range<usize> = 6..10;
    pub const SEQUENCE: Range<usize> = 10..14;
    pub const DATA_LENGTH: Range<usize> = 16..18;
    pub const DATA: usize = 18;
    pub const COUNT: Range<usize> = 18..20;
    pub const RUN: usize = 20;
    pub const OUTPUTS: Range<usize> = 24..88;
}

/// The sequence count of CIP, bytes: a connection size has it.
pub const COUNT: usize = 2;
/// The connection size of an owner's packets: the count, run/idle and the assembly.
pub const OWNER_SIZE: u16 = (COUNT + 4 + OUTPUT_SIZE) as u16;
/// The longest packet of ours, bytes.
pub const OUTGOING_MAX: usize = field::DATA + OWNER_SIZE as usize;

/// Both items, up to the size of the second one.
const ITEMS: [u8; 6] = [2, 0, 0x02, 0x80, 8, 0];
const DATA_ITEM: [u8; 2] = item::CONNECTED_DATA.to_le_bytes();

/// A packet of ours, built once and patched for each cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outgoing {
    bytes: [u8; OUTGOING_MAX],
    size: u8,
}

impl Outgoing {
    /// With run/idle (idle) and assembly 0x70 (zeros).
    pub fn owner(connection: u32) -> Outgoing {
        Outgoing::sized(connection, OWNER_SIZE as u8)
    }

    /// Without data, for a connection of this size: 2 has the count, 6 run/idle as well, 0 neither. What is longer than
    /// an owner's packet is cut off.
    pub fn heartbeat(connection: u32, size: u8) -> Outgoing {
        Outgoing::sized(connection, size.min(OWNER_SIZE as u8))
    }

    fn sized(connection: u32, size: u8) -> Outgoing {
        let mut bytes = [0; OUTGOING_MAX];
        bytes[..6].copy_from_slice(&ITEMS);
        bytes[field::CONNECTION].copy_from_slice(&connection.to_le_bytes());
        bytes[14..16].copy_from_slice(&DATA_ITEM);
        bytes[field::DATA_LENGTH].copy_from_slice(&u16::from(size).to_le_bytes());
        Outgoing { bytes, size }
    }

    /// Both sequence numbers: of each packet, and of new data. Some adapters swallow the first data if its count is 0:
    /// begin with 1.
    #[inline]
    pub fn set_sequence(&mut self, sequence: u32, count: u16) {
        Outgoing::number(&mut self.bytes, sequence, count);
    }

    /// The same in a copy of a packet, in a room that is long enough for the longest.
    #[inline]
    pub fn number(room: &mut [u8], sequence: u32, count: u16) {
        if let Some(front) = room.first_chunk_mut::<{ field::DATA + COUNT }>() {
            front[field::SEQUENCE].copy_from_slice(&sequence.to_le_bytes());
            front[field::COUNT].copy_from_slice(&count.to_le_bytes());
        }
    }

    /// Run, or idle: the drive does not act on the outputs.
    #[inline]
    pub fn set_run(&mut self, run: bool) {
        self.bytes[field::RUN] = u8::from(run);
    }

    /// The outputs. A heartbeat does not show them.
    #[inline]
    pub fn set_outputs(&mut self, outputs: &Outputs) {
        self.bytes[field::OUTPUTS].copy_from_slice(&outputs.bytes());
    }

    /// The outputs in a copy of a packet; `None`: a heartbeat.
    #[inline]
    pub fn outputs(copy: &[u8]) -> Option<&[u8]> {
        copy.get(field::OUTPUTS)
    }

    /// The packet.
    #[inline]
    pub fn bytes(&self) -> &[u8] {
        self.bytes.get(..field::DATA + usize::from(self.size)).unwrap_or(&self.bytes)
    }
}

/// Why a datagram is no packet of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PacketError {
    /// It is no class 1 packet: too short, or with other items than a sequenced address and connected data.
    NoPacket,
    /// The data is shorter or longer than it says.
    Length,
}

/// A packet of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packet<'a> {
    /// The connection. Ids of groups are the drives' choice: only with the source's address it says which one.
    pub connection: u32,
    /// Counts packets.
    pub sequence: u32,
    /// Counts new data.
    pub count: u16,
    /// The assembly.
    pub data: &'a [u8],
}

impl<'a> Packet<'a> {
    /// The packet that is a datagram.
    #[inline]
    pub fn parse(datagram: &'a [u8]) -> Result<Packet<'a>, PacketError> {
        if let Some((header, data)) = datagram.split_first_chunk::<{ field::DATA + COUNT }>()
            && let [a, b, c, d, e, f, id0, id1, id2, id3, s0, s1, s2, s3, k0, k1, l0, l1, c0, c1] = *header
            && [a, b, c, d, e, f] == ITEMS
            && [k0, k1] == DATA_ITEM
            && usize::from(u16::from_le_bytes([l0, l1])) == data.len() + COUNT
        {
            let connection = u32::from_le_bytes([id0, id1, id2, id3]);
            let sequence = u32::from_le_bytes([s0, s1, s2, s3]);
            return Ok(Packet { connection, sequence, count: u16::from_le_bytes([c0, c1]), data });
        }
        Err(Packet::why_none(datagram))
    }

    /// The mistake in it.
    #[cold]
    fn why_none(datagram: &[u8]) -> PacketError {
        match datagram.first_chunk::<{ field::DATA }>() {
            Some(front) if front[..6] == ITEMS && front[14..16] == DATA_ITEM => PacketError::Length,
            _ => PacketError::NoPacket,
        }
    }
}
