//! The constant parts of an exchange of one kind: the request without its id and its values, and the reply without
//! its values.
//!
//! In most cycles the request to a drive is the same. So a request is built over the last one, and a reply that
//! matches exactly is recognised at once. All others take the long way.

use super::mapping::{Block, Places};
use super::parameter::Width;
use super::profile::Outputs;
use super::wire::{ADU_MAX, Registers, function};

/// The offset of a value in a message, and its width: its first byte is at most 255, so that four always fit.
pub(super) type Place = (u8, Width);

/// A cyclic request in its room.
#[derive(Clone, Copy, Debug)]
pub(super) struct Template {
    /// The blocks that it writes and reads.
    pub blocks: (Option<u8>, Option<u8>),
    /// The drive has no other blocks.
    pub only: bool,
    /// The registers of both together.
    pub registers: u16,
    /// The length of the whole message.
    pub length: usize,
    /// The offsets of control word and reference, if it writes them.
    pub control: Option<Place>,
    pub reference: Option<Place>,
    /// The reply to it.
    pub expected: Expected,
}

impl Template {
    /// Writes another id and other values over those of the request in `out`.
    #[inline]
    pub(super) fn refill(&self, out: &mut [u8; ADU_MAX], transaction: u16, outputs: Outputs) {
        out[..2].copy_from_slice(&transaction.to_be_bytes());
        put(out, self.control, i32::from(outputs.control.0));
        put(out, self.reference, outputs.reference);
    }
}

#[inline]
fn put(out: &mut [u8; ADU_MAX], place: Option<Place>, count: i32) {
    let Some((at, width)) = place else { return };
    let at = usize::from(at);
    match width {
        Width::Long => out[at..at + 4].copy_from_slice(&count.to_be_bytes()),
        Width::Word => out[at..at + 2].copy_from_slice(&(count as u16).to_be_bytes()),
    }
}

/// The reply to a request with function 23 when nothing is wrong: all of it but its values, which are copied to an
/// image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Expected {
    /// The length of the whole message; 0: none is expected.
    size: usize,
    /// Its first eight bytes, the first one highest.
    header: u64,
    /// Its count of value bytes.
    bytes: u8,
    /// The indices of the values.
    pub places: Places,
}

impl Expected {
    /// The bytes before the values: header, function, number of bytes.
    const FRONT: usize = 9;

    /// The reply to a request that reads `block`, whatever its id. There is none for a block longer than a message,
    /// nor for one that has to be sorted.
    pub(super) fn new(block: &Block, unit: u8) -> Expected {
        let bytes = block.registers.checked_mul(2).and_then(|bytes| u8::try_from(bytes).ok());
        let Some(bytes) = bytes.filter(|_| block.in_order) else {
            return Expected::default();
        };
        // Unit, function and number of bytes are counted, too.
        let [high, low] = (u16::from(bytes) + 3).to_be_bytes();
        let header = u64::from_be_bytes([0, 0, 0, 0, high, low, unit, function::READ_WRITE]);
        Expected { size: Self::FRONT + usize::from(bytes), header, bytes, places: block.places }
    }

    /// The reply to the request with this id.
    #[inline]
    pub(super) fn to(self, transaction: u16) -> Expected {
        Expected { header: self.header | u64::from(transaction) << 48, ..self }
    }

    /// Its values, if `bytes` are all of it and nothing else.
    #[inline]
    pub(super) fn values(self, bytes: &[u8]) -> Option<Registers<'_>> {
        if bytes.len() != self.size {
            return None;
        }
        let (front, values) = bytes.split_first_chunk::<{ Self::FRONT }>()?;
        let [header @ .., count] = *front;
        if u64::from_be_bytes(header) != self.header || count != self.bytes {
            return None;
        }
        Registers::new(values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::modbus::parameter::Parameter;
    use crate::bus::modbus::wire::{Header, RegistersBuffer, Request, Response};
    use crate::bus::modbus::words::ControlWord;

    const HEADER: Header = Header { transaction: 0x1234, unit: 255 };

    fn data(values: &[i32]) -> RegistersBuffer {
        let mut data = RegistersBuffer::new();
        values.iter().for_each(|value| assert!(data.push_long(*value)));
        data
    }

    #[test]
    fn a_refilled_request_is_the_one_that_would_be_built() {
        let request = |values: &[i32], header: Header, out: &mut [u8; ADU_MAX]| {
            let data = data(values);
            let data = data.registers();
            Request::ReadWrite { read: 0x4000, count: 12, write: 0x4000, data }.emit(header, out)
        };
        let (mut refilled, mut built) = ([0; ADU_MAX], [0; ADU_MAX]);
        let length = request(&[1, -2], HEADER, &mut refilled);
        let template = Template {
            blocks: (Some(0), Some(0)),
            only: true,
            registers: 16,
            length,
            control: Some((length as u8 - 8, Width::Long)),
            reference: Some((length as u8 - 4, Width::Long)),
            expected: Expected::default(),
        };
        let outputs = Outputs { control: ControlWord(0x8183), reference: 123_456_789 };
        template.refill(&mut refilled, 0xABCD, outputs);
        request(&[0x8183, 123_456_789], Header { transaction: 0xABCD, ..HEADER }, &mut built);
        assert_eq!(refilled, built);
    }

    #[test]
    fn a_word_is_refilled_by_its_low_bits_and_its_neighbours_stay() {
        let mut out = [0xEE; ADU_MAX];
        put(&mut out, Some((10, Width::Word)), 0x0001_8183);
        assert_eq!(out[9..13], [0xEE, 0x81, 0x83, 0xEE]);
        put(&mut out, None, 0);
        put(&mut out, Some((u8::MAX, Width::Long)), 0);
        assert_eq!(out[255..], [0, 0, 0, 0, 0xEE], "the last place there is");
    }

    /// A block of so many registers whose order is that of the image.
    fn block(registers: u16) -> Block {
        Block {
            address: 0x4000,
            registers,
            width: Width::Long,
            roles: Box::default(),
            places: Places::default(),
            in_order: true,
            first: Parameter::CONTROL_WORD,
        }
    }

    #[test]
    fn only_the_whole_reply_to_this_request_is_expected() {
        let data = data(&[1, 2, 3]);
        let mut bytes = [0; ADU_MAX];
        let size = Response::ReadWritten { data: data.registers() }.emit(HEADER, &mut bytes);
        let expected = Expected::new(&block(6), 255).to(0x1234);
        assert_eq!(expected.values(&bytes[..size]), Some(data.registers()));
        assert_eq!(expected.values(&bytes[..size - 1]), None, "not all of it");
        assert_eq!(expected.values(&bytes[..size + 1]), None, "more than it");
        // Id, protocol, length, unit, function, number of bytes.
        for at in 0..Expected::FRONT {
            for bit in 0..8 {
                let mut bytes = bytes;
                bytes[at] ^= 1 << bit;
                assert_eq!(expected.values(&bytes[..size]), None, "byte {at}, bit {bit}");
            }
        }
    }

    #[test]
    fn nothing_is_expected_by_default_nor_of_what_no_message_holds() {
        assert_eq!(Expected::default().values(&[]), None);
        assert_eq!(Expected::new(&block(128), 255), Expected::default());
        assert_eq!(Expected::new(&block(u16::MAX), 255), Expected::default());
        assert_ne!(Expected::new(&block(6), 255), Expected::default());
        let mixed = Block { in_order: false, ..block(6) };
        assert_eq!(Expected::new(&mixed, 255), Expected::default(), "a block that has to be sorted");
    }
}
