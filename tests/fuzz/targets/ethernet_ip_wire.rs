//! A datagram or a stream of EtherNet/IP, for every parser of it: no bytes make it panic, nothing reaches beyond what
//! it was given, a stream gives the same messages wherever it is cut, and an assembly is one of exactly its size.

use fieldbeat::bus::ethernet_ip::{IoCode, Layout, Version};
use fieldbeat_ethernet_ip::wire::assembly::{Inputs, input_size};
use fieldbeat_ethernet_ip::wire::cip::Reply;
use fieldbeat_ethernet_ip::wire::connection::{Opened, Triad, closed};
use fieldbeat_ethernet_ip::wire::cpf::Items;
use fieldbeat_ethernet_ip::wire::encapsulation::{
    Connected, DATA_MAX, Frame, HEADER, Identity, Listed, Malformed, Unconnected,
};
use fieldbeat_ethernet_ip::wire::io::Packet;
use fieldbeat_ethernet_ip::wire::message::{self, immediate};

pub fn ethernet_ip_wire(data: &[u8]) {
    packet(data);
    stream(data);
    message(data);
    if let Some(code) = data.first_chunk::<2>().map(|bytes| u16::from_le_bytes(*bytes))
        && let Some(io) = IoCode::from_code(code)
    {
        assert_eq!((io.code(), io.to_string().parse()), (code, Ok(io)));
    }
}

/// A class 1 packet, and an assembly.
fn packet(bytes: &[u8]) {
    if let Ok(packet) = Packet::parse(bytes) {
        // Two items, a sequenced address, and the count: nothing is left out, nothing is behind it.
        assert_eq!(packet.data.len() + 20, bytes.len());
        assert_eq!(packet.connection.to_le_bytes(), bytes[6..10]);
    }
    for version in [Version::V1, Version::V2] {
        for layout in [Layout::Manual, Layout::Page] {
            let size = input_size(version);
            assert_eq!(Inputs::parse(bytes, version, layout).is_some(), bytes.len() == size);
            if let Some(inputs) = bytes.get(..size).and_then(|bytes| Inputs::parse(bytes, version, layout)) {
                assert_eq!(inputs.analog.is_some(), version == Version::V2);
            }
        }
    }
}

/// All messages at the front of a stream.
fn messages(mut rest: &[u8]) -> (Vec<(u16, usize)>, Result<usize, Malformed>) {
    let mut all = Vec::new();
    loop {
        match Frame::next(rest) {
            Ok(Some((frame, size))) => {
                assert!((HEADER..=HEADER + DATA_MAX).contains(&size) && frame.data.len() + HEADER == size);
                all.push((frame.header.command, size));
                rest = &rest[size..];
            }
            Ok(None) => return (all, Ok(rest.len())),
            Err(why) => return (all, Err(why)),
        }
    }
}

fn stream(bytes: &[u8]) {
    let (whole, end) = messages(bytes);
    // Cut anywhere, the messages before the cut are the same, and a fault is no other one.
    let cut = bytes.first().map_or(0, |first| usize::from(*first)).min(bytes.len());
    let (front, front_end) = messages(&bytes[..cut]);
    assert_eq!(front[..], whole[..front.len()]);
    if let Err(why) = front_end {
        assert_eq!((Err(why), front.len()), (end, whole.len()));
    }
}

/// The data of messages, and what is in them.
fn message(bytes: &[u8]) {
    let _ = (Listed::parse(bytes), Identity::parse(bytes), message::version(bytes));
    let position = message::immediate(immediate::READ_POSITION, 0, 0);
    let _ = (Unconnected::parse(bytes), Connected::parse(bytes), message::answer(&position, bytes));
    if let Some(items) = Items::parse(bytes) {
        let inside: usize = items.map(|item| 4 + item.data.len()).sum();
        assert!(inside + 2 <= bytes.len());
    }
    let triad = Triad { serial: 1, vendor: 0x1234, originator: 0x00C0_FFEE };
    if let Some(reply) = Reply::parse(bytes) {
        if let Ok(opened) = Opened::parse(&reply, triad) {
            assert!(opened.outgoing_api_us > 0 && opened.incoming_api_us > 0 && reply.status.is_ok());
        }
        let _ = (closed(&reply, triad), reply.status.to_string());
    }
}
