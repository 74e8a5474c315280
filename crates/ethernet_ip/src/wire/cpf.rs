//! The common packet format: a number of items, each with its type and its length (EtherNet/IP, volume 2, 2-6).

use std::net::{Ipv4Addr, SocketAddrV4};

use super::Reader;

/// The types of items.
pub mod item {
    /// The address of an unconnected message: none.
    pub const NULL: u16 = 0x0000;
    /// Who a device is.
    pub const IDENTITY: u16 = 0x000C;
    /// The address of a message on a connection: its id.
    pub const CONNECTED_ADDRESS: u16 = 0x00A1;
    /// The data of a message on a connection.
    pub const CONNECTED_DATA: u16 = 0x00B1;
    /// The data of an unconnected message.
    pub const UNCONNECTED_DATA: u16 = 0x00B2;
    /// Where the packets of the originator (O->T) go.
    pub const OUTGOING_ADDRESS: u16 = 0x8000;
    /// Where the packets of the target (T->O) go.
    pub const INCOMING_ADDRESS: u16 = 0x8001;
    /// The address of a class 1 packet: connection id and sequence number.
    pub const SEQUENCED_ADDRESS: u16 = 0x8002;
}

/// AF_INET, as it is in every socket address on the wire.
const FAMILY: [u8; 2] = [0, 2];

/// One item.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Item<'a> {
    /// See [`item`].
    pub kind: u16,
    /// The data.
    pub data: &'a [u8],
}

impl Item<'_> {
    /// The socket address that it is; `None` if it is none.
    pub fn socket_address(&self) -> Option<SocketAddrV4> {
        parse_socket_address(self.data.first_chunk()?)
    }
}

/// The items of a message, in any order and of any type. All lengths were checked.
#[derive(Clone, Debug)]
pub struct Items<'a> {
    left: u16,
    rest: Reader<'a>,
}

impl<'a> Items<'a> {
    /// The items at the front of `data`; `None` if an item passes its end. What follows them does not count.
    pub fn parse(data: &'a [u8]) -> Option<Items<'a>> {
        let mut rest = Reader(data);
        let left = rest.word_le()?;
        let items = Items { left, rest };
        // Each item has four bytes at least, so that a lying count ends with the data.
        (items.clone().count() == usize::from(left)).then_some(items)
    }
}

impl<'a> Iterator for Items<'a> {
    type Item = Item<'a>;

    fn next(&mut self) -> Option<Item<'a>> {
        self.left = self.left.checked_sub(1)?;
        let kind = self.rest.word_le()?;
        let length = self.rest.word_le()?;
        Some(Item { kind, data: self.rest.bytes(length.into())? })
    }
}

/// Appends an item.
pub fn put(out: &mut Vec<u8>, kind: u16, data: &[u8]) {
    out.extend(kind.to_le_bytes());
    let length = out.len();
    out.extend([0; 2]);
    sized(out, length, |out| out.extend(data));
}

/// Appends what `fill` does, and writes its length into the two bytes at `length`.
pub(super) fn sized(out: &mut Vec<u8>, length: usize, fill: impl FnOnce(&mut Vec<u8>)) {
    let start = out.len();
    fill(out);
    let size = u16::try_from(out.len() - start).unwrap_or(u16::MAX);
    if let Some(field) = out.get_mut(length..length + 2) {
        field.copy_from_slice(&size.to_le_bytes());
    }
}

/// A socket address as it is in items: big-endian, unlike everything around it.
pub fn socket_address(address: SocketAddrV4) -> [u8; 16] {
    let [high, low] = address.port().to_be_bytes();
    let [a, b, c, d] = address.ip().octets();
    [FAMILY[0], FAMILY[1], high, low, a, b, c, d, 0, 0, 0, 0, 0, 0, 0, 0]
}

/// The reverse; `None` if it is of another family.
pub fn parse_socket_address(bytes: &[u8; 16]) -> Option<SocketAddrV4> {
    let &[family_high, family_low, high, low, a, b, c, d, ..] = bytes;
    ([family_high, family_low] == FAMILY)
        .then(|| SocketAddrV4::new(Ipv4Addr::new(a, b, c, d), u16::from_be_bytes([high, low])))
}
