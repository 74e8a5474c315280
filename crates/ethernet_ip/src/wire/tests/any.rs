//! Any bytes, any split of a stream, any lie.

use proptest::collection::vec;
use proptest::prelude::*;

use super::super::assembly::{self, Inputs, IoCode};
use super::super::connection::{Opened, closed};
use super::super::cpf::{self, Items};
use super::super::encapsulation::{self, Connected, Header, Identity, Listed, Unconnected};
use super::super::io::{Outgoing, Packet};
use super::super::message::{Buffered, Immediate, ProfileCode};
use super::super::opcodes::OPCODES;
use super::*;
use crate::Layout;

/// Everything that reads, on these bytes.
fn read_all(bytes: &[u8]) {
    let _ = Frame::next(bytes);
    let _ = Frame::datagram(bytes);
    let _ = Unconnected::parse(bytes);
    let _ = Connected::parse(bytes);
    let _ = Listed::parse(bytes);
    let _ = Identity::parse(bytes);
    let _ = ProfileCode::parse(bytes);
    if let Some(items) = Items::parse(bytes) {
        let inside: usize = items.map(|item| 4 + item.data.len()).sum();
        assert!(inside + 2 <= bytes.len());
    }
    if let Some(reply) = Reply::parse(bytes) {
        let _ = (Opened::parse(&reply, TRIAD), closed(&reply, TRIAD), reply.status.to_string());
    }
    if let Ok(packet) = Packet::parse(bytes) {
        assert_eq!(packet.data.len() + 20, bytes.len());
    }
    for layout in [Layout::Manual, Layout::Page] {
        for version in [Version::V1, Version::V2] {
            let inputs = Inputs::parse(bytes, version, layout);
            assert_eq!(inputs.is_some(), bytes.len() == assembly::input_size(version));
        }
    }
    let _ = Immediate::ReadEncoder.answer(bytes);
    let _ = Buffered { opcode: OPCODES[0], field: 0, value: 0 }.answer(bytes);
}

/// Messages that are read, to be cut and damaged.
fn messages() -> Vec<Vec<u8>> {
    let open = with(|out| owner().emit(out));
    let address = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 2222);
    let frames = [
        with(|out| encapsulation::send_rr_data(out, SESSION, 1, &open, Some(address))),
        with(|out| encapsulation::send_unit_data(out, SESSION, 1, 2, &open)),
    ];
    let items = frames.each_ref().map(|frame| frame[30..].to_vec());
    let data = frames.each_ref().map(|frame| frame[24..].to_vec());
    let mut all =
        vec![Outgoing::owner(OUTGOING_ID).bytes().to_vec(), hex("D4 00 01 02 27 01 46 00 01 00 34 12")];
    all.extend(frames);
    all.extend(items);
    all.extend(data);
    all
}

proptest! {
    #[test]
    fn nothing_panics_on_any_bytes(bytes in vec(any::<u8>(), 0..120)) {
        read_all(&bytes);
    }

    #[test]
    fn nothing_panics_on_a_damaged_message(
        which in any::<prop::sample::Index>(),
        cut in 0_usize..120,
        changes in vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
    ) {
        let all = messages();
        let mut bytes = which.get(&all).clone();
        for (at, byte) in changes {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        bytes.truncate(cut);
        read_all(&bytes);
    }

    #[test]
    fn a_stream_is_the_same_however_it_is_split(
        messages in vec((any::<u32>(), any::<u64>(), vec(any::<u8>(), 0..80)), 1..6),
        pieces in vec(1_usize..50, 1..20),
    ) {
        let mut stream = Vec::new();
        for (session, context, data) in &messages {
            encapsulation::send_unit_data(&mut stream, *session, context.to_le_bytes()[0].into(), 7, data);
        }
        let (mut received, mut buffer, mut sent) = (Vec::new(), Vec::new(), 0);
        for piece in pieces.iter().cycle() {
            let end = (sent + piece).min(stream.len());
            buffer.extend(&stream[sent..end]);
            sent = end;
            while let Some((frame, used)) = Frame::next(&buffer).unwrap() {
                let message = Connected::parse(frame.data).unwrap();
                received.push((frame.header.session, message.connection, message.message.to_vec()));
                buffer.drain(..used);
            }
            if sent == stream.len() {
                break;
            }
        }
        let expected: Vec<_> = messages
            .into_iter()
            .map(|(session, context, data)| (session, u32::from(context.to_le_bytes()[0]), data))
            .collect();
        prop_assert_eq!(received, expected);
        prop_assert!(buffer.is_empty());
    }

    #[test]
    fn headers_come_back(session: u32, status: u32, context: u64, data in vec(any::<u8>(), 0..99)) {
        let status = encapsulation::Status(status);
        let header = Header { command: encapsulation::command::SEND_RR_DATA, session, status, context };
        let bytes = with(|out| encapsulation::frame(out, header, |out| out.extend(&data)));
        prop_assert_eq!(whole(&bytes), Frame { header, data: &data });
    }

    #[test]
    fn items_come_back(items in vec((any::<u16>(), vec(any::<u8>(), 0..30)), 0..9)) {
        let bytes = with(|out| {
            out.extend((items.len() as u16).to_le_bytes());
            for (kind, data) in &items {
                cpf::put(out, *kind, data);
            }
        });
        let read: Vec<_> = Items::parse(&bytes).unwrap().map(|item| (item.kind, item.data.to_vec())).collect();
        prop_assert_eq!(read, items);
    }

    #[test]
    fn our_packets_are_read_as_packets(connection: u32, sequence: u32, count: u16, size in 2_u8..71) {
        let mut packet = Outgoing::heartbeat(connection, size);
        packet.set_sequence(sequence, count);
        let data = vec![0; usize::from(size) - 2];
        let expected = Packet { connection, sequence, count, data: &data };
        prop_assert_eq!(Packet::parse(packet.bytes()), Ok(expected));
    }

    #[test]
    fn no_text_panics_as_an_io_code(text in "\\PC{0,4}") {
        if let Ok(code) = text.parse::<IoCode>() {
            prop_assert_eq!(IoCode::from_code(code.code()), Some(code));
        }
    }
}
