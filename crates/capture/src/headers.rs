//! The headers around a telegram: Ethernet, IPv4, UDP and TCP. They are read from any capture, and made for telegrams
//! of which the recording has none.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat_core::bus::reader::Reader;

/// Bytes of an IPv4 header without options.
const IPV4: usize = 20;
const UDP: usize = 8;
const TCP: usize = 20;
/// Ethertypes.
const ETHERTYPE_IPV4: u16 = 0x0800;
const VLAN: [u16; 3] = [0x8100, 0x88A8, 0x9100];
/// Protocols of IPv4.
const PROTOCOL_TCP: u8 = 6;
const PROTOCOL_UDP: u8 = 17;
/// The most bytes that one packet of ours carries: that of the usual Ethernet.
pub const MOST_BYTES: usize = 1_460;

/// Flags of TCP.
mod flag {
    pub const SYN: u8 = 1 << 1;
    pub const PUSH: u8 = 1 << 3;
    pub const ACKNOWLEDGE: u8 = 1 << 4;
}

/// An Ethernet frame, behind its VLAN tags.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// Destination and source.
    pub addresses: &'a [u8],
    /// The Ethertype of its payload.
    pub ethertype: u16,
    /// That.
    pub payload: &'a [u8],
}

/// The payload of an IPv4 packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Carried<'a> {
    /// A datagram of UDP.
    Datagram(SocketAddrV4, SocketAddrV4, &'a [u8]),
    /// A segment of TCP.
    Segment(SocketAddrV4, SocketAddrV4, Segment<'a>),
    /// A fragment of something.
    Fragment,
    /// Another protocol.
    Other(u8),
}

/// A segment of TCP.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment<'a> {
    /// The number of its first byte.
    pub sequence: u32,
    /// It opens a connection, which takes one number.
    pub is_first: bool,
    /// The bytes.
    pub bytes: &'a [u8],
}

/// The frame in a packet; `None`: it is too short.
pub fn frame(packet: &[u8]) -> Option<Frame<'_>> {
    let mut reader = Reader(packet);
    let addresses = reader.bytes(12)?;
    let mut ethertype = reader.word_be()?;
    while VLAN.contains(&ethertype) {
        reader.word_be()?;
        ethertype = reader.word_be()?;
    }
    Some(Frame { addresses, ethertype, payload: reader.0 })
}

impl<'a> Frame<'a> {
    /// The payload by IPv4; `None`: none, or its headers contradict themselves.
    pub fn ipv4(&self) -> Option<Carried<'a>> {
        if self.ethertype != ETHERTYPE_IPV4 {
            return None;
        }
        let header: &[u8; IPV4] = self.payload.first_chunk()?;
        let size = 4 * usize::from(header[0] & 0x0F);
        let length = usize::from(u16::from_be_bytes([header[2], header[3]]));
        if header[0] >> 4 != 4 || size < IPV4 {
            return None;
        }
        // A length of 0 is that of a packet which the adapter cuts; what is missing was not captured.
        let end = if length == 0 { self.payload.len() } else { length.min(self.payload.len()) };
        let payload = self.payload.get(size..end)?;
        // More fragments, or not the first one.
        if u16::from_be_bytes([header[6], header[7]]) & 0x3FFF != 0 {
            return Some(Carried::Fragment);
        }
        let address = |at: usize| Ipv4Addr::new(header[at], header[at + 1], header[at + 2], header[at + 3]);
        let (source, destination) = (address(12), address(16));
        let mut reader = Reader(payload);
        let mut ends = || {
            let (from, to) = (reader.word_be()?, reader.word_be()?);
            Some((SocketAddrV4::new(source, from), SocketAddrV4::new(destination, to)))
        };
        match header[9] {
            PROTOCOL_UDP => {
                let (from, to) = ends()?;
                let length = usize::from(u16::from_be_bytes(*payload.get(4..)?.first_chunk()?));
                let end = if length == 0 { payload.len() } else { length.min(payload.len()) };
                Some(Carried::Datagram(from, to, payload.get(UDP..end)?))
            }
            PROTOCOL_TCP => {
                let (from, to) = ends()?;
                let header: &[u8; TCP] = payload.first_chunk()?;
                let sequence = u32::from_be_bytes([header[4], header[5], header[6], header[7]]);
                let bytes = payload.get(4 * usize::from(header[12] >> 4).max(TCP / 4)..)?;
                let is_first = header[13] & flag::SYN != 0;
                Some(Carried::Segment(from, to, Segment { sequence, is_first, bytes }))
            }
            other => Some(Carried::Other(other)),
        }
    }
}

/// A datagram with headers. Longer ones than IPv4 has room for are cut off.
pub fn datagram(from: SocketAddrV4, to: SocketAddrV4, bytes: &[u8]) -> Vec<u8> {
    let bytes = bytes.get(..usize::from(u16::MAX) - IPV4 - UDP).unwrap_or(bytes);
    let length = (UDP + bytes.len()) as u16;
    let header = [from.port(), to.port(), length, 0].map(u16::to_be_bytes).concat();
    packet(from, to, PROTOCOL_UDP, &header, 6, bytes)
}

/// A segment with headers, of [`MOST_BYTES`] at most.
pub fn segment(
    from: SocketAddrV4,
    to: SocketAddrV4,
    [sequence, acknowledged]: [u32; 2],
    bytes: &[u8],
) -> Vec<u8> {
    let mut header = [from.port(), to.port()].map(u16::to_be_bytes).concat();
    header.extend(sequence.to_be_bytes());
    header.extend(acknowledged.to_be_bytes());
    header.extend([(TCP as u8 / 4) << 4, flag::PUSH | flag::ACKNOWLEDGE]);
    // A wide window, no urgent bytes.
    header.extend([0xFF, 0xFF, 0, 0, 0, 0]);
    packet(from, to, PROTOCOL_TCP, &header, 16, bytes)
}

/// Around a header whose checksum is at `check`, with addresses that are made of those of IPv4.
fn packet(
    from: SocketAddrV4,
    to: SocketAddrV4,
    protocol: u8,
    header: &[u8],
    check: usize,
    bytes: &[u8],
) -> Vec<u8> {
    let mut packet = Vec::with_capacity(14 + IPV4 + header.len() + bytes.len());
    for ip in [to.ip(), from.ip()] {
        // Administered locally.
        packet.extend([2, 0]);
        packet.extend(ip.octets());
    }
    packet.extend(ETHERTYPE_IPV4.to_be_bytes());
    let length = (header.len() + bytes.len()) as u16;
    let [high, low] = (IPV4 as u16 + length).to_be_bytes();
    // Not to be fragmented; 64 hops.
    let mut ip = [0x45, 0, high, low, 0, 0, 0x40, 0, 64, protocol, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    ip[12..16].copy_from_slice(&from.ip().octets());
    ip[16..].copy_from_slice(&to.ip().octets());
    let sum = checksum(&[&ip]);
    ip[10..12].copy_from_slice(&sum.to_be_bytes());
    packet.extend(ip);
    let at = packet.len() + check;
    packet.extend(header);
    packet.extend(bytes);
    let [high, low] = length.to_be_bytes();
    let sum = checksum(&[&ip[12..], &[0, protocol, high, low], header, bytes]);
    // A checksum of UDP that is 0 says that there is none.
    let sum = if sum == 0 && protocol == PROTOCOL_UDP { u16::MAX } else { sum };
    packet[at..at + 2].copy_from_slice(&sum.to_be_bytes());
    packet
}

/// That of the internet (RFC 1071) over these parts, of which all but the last one have whole words.
fn checksum(parts: &[&[u8]]) -> u16 {
    let words = parts.iter().flat_map(|part| {
        part.chunks(2).map(|word| u32::from(word[0]) << 8 | word.get(1).copied().map_or(0, u32::from))
    });
    let sum: u32 = words.sum();
    let sum = (sum & 0xFFFF) + (sum >> 16);
    !((sum & 0xFFFF) + (sum >> 16)) as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    const FROM: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 41136);
    const TO: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), 49360);

    /// A packet whose sums are right gives 0.
    fn sums(packet: &[u8], protocol: u8) -> [u16; 2] {
        let (ip, inner) = packet[14..].split_at(IPV4);
        let [high, low] = (inner.len() as u16).to_be_bytes();
        [checksum(&[ip]), checksum(&[&ip[12..], &[0, protocol, high, low], inner])]
    }

    #[test]
    fn built_headers_parse_back_with_right_checksums() {
        for bytes in [&[][..], &[1], &[1, 2, 3], &[0xFF; 400]] {
            let packet = datagram(FROM, TO, bytes);
            assert_eq!(frame(&packet).unwrap().ipv4(), Some(Carried::Datagram(FROM, TO, bytes)));
            assert_eq!(sums(&packet, PROTOCOL_UDP), [0, 0], "{}", bytes.len());
            let packet = segment(FROM, TO, [7, 9], bytes);
            let expected = Segment { sequence: 7, is_first: false, bytes };
            assert_eq!(frame(&packet).unwrap().ipv4(), Some(Carried::Segment(FROM, TO, expected)));
            assert_eq!(sums(&packet, PROTOCOL_TCP), [0, 0], "{}", bytes.len());
        }
    }

    #[test]
    fn tags_padding_and_fragments_are_distinguished_and_no_bytes_panic() {
        let plain = datagram(FROM, TO, &[5, 6]);
        let mut tagged = [&plain[..12], &[0x81, 0, 0, 7, 0x88, 0xA8, 0, 8], &plain[12..], &[0; 9]].concat();
        let found = frame(&tagged).unwrap();
        assert_eq!((found.ethertype, found.ipv4()), (0x0800, Some(Carried::Datagram(FROM, TO, &[5, 6]))));
        tagged[22 + 6] = 0x20;
        assert_eq!(frame(&tagged).unwrap().ipv4(), Some(Carried::Fragment));
        let mut random = fastrand::Rng::with_seed(3);
        for _ in 0..20_000 {
            let mut bytes = segment(FROM, TO, [1, 2], &[3; 9]);
            bytes.truncate(random.usize(..=bytes.len()));
            if !bytes.is_empty() {
                let at = random.usize(..bytes.len());
                bytes[at] = random.u8(..);
            }
            if let Some(frame) = frame(&bytes) {
                let _ = frame.ipv4();
            }
        }
    }
}
