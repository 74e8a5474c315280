//! Requests written over others, and replies recognised at once.

use super::receive::Expected;
use super::request::put;
use crate::mapping::{Block, Places};
use crate::parameter::{Parameter, Width};
use crate::wire::{ADU_MAX, Header, RegistersBuffer, Response, function};

const HEADER: Header = Header { transaction: 0x1234, unit: 255 };

fn data(values: &[i32]) -> RegistersBuffer {
    let mut data = RegistersBuffer::new();
    values.iter().for_each(|value| assert!(data.push_long(*value)));
    data
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
    let expected = Expected::new(&block(6), 255, function::READ_WRITE).to(0x1234);
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
    assert_eq!(Expected::new(&block(128), 255, function::READ_WRITE), Expected::default());
    assert_eq!(Expected::new(&block(u16::MAX), 255, function::READ_WRITE), Expected::default());
    assert_ne!(Expected::new(&block(6), 255, function::READ_WRITE), Expected::default());
    let mixed = Block { in_order: false, ..block(6) };
    assert_eq!(
        Expected::new(&mixed, 255, function::READ_WRITE),
        Expected::default(),
        "a block that has to be sorted"
    );
}
