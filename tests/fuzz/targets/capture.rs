//! A capture: no bytes of a file, and no packet of any link type, make its reader or the decoders panic or go on
//! without end; and what our own writer makes of packets is read as they were.

use fieldbeat_capture::decode::{Decoder, Telegram};
use fieldbeat_capture::reader::{Capture, Packet};
use fieldbeat_capture::writer::Writer;
use fieldbeat_capture::{Direction, ETHERNET, PROFIBUS, USER0};

use super::input::Input;

const LINK_TYPES: [u16; 4] = [ETHERNET, USER0, PROFIBUS, 113];
/// Those of the five protocols, and one of nobody.
const PORTS: [u16; 5] = [49_360, 502, 2_222, 44_818, 99];

pub fn capture(data: &[u8]) {
    read(data);
    let mut writer = Writer::new(Vec::new(), "fuzz", "").unwrap();
    for link_type in LINK_TYPES {
        writer.interface(link_type, "", "", "").unwrap();
    }
    let (mut input, mut written, mut sequence) = (Input(data), Vec::new(), 0);
    while !input.is_over() {
        let (kind, length) = (input.byte(), input.byte());
        let (ports, step) = ([input.of(&PORTS), input.of(&PORTS)], input.byte());
        let payload = input.bytes(length.into());
        let (interface, bytes) = match kind % 8 {
            0 => (0, payload.to_vec()),
            1 => (0, [&[2; 12], &[0x88, 0xA4][..], payload].concat()),
            2 => (1, payload.to_vec()),
            3 => (2, payload.to_vec()),
            4 => (3, payload.to_vec()),
            5 => (0, packet(17, ports, &[0, 0, 0, 0], payload)),
            _ => {
                sequence += u32::from(step);
                let [a, b, c, d] = sequence.to_be_bytes();
                let rest = [a, b, c, d, 0, 0, 0, 0, 0x50, kind & 2, 0, 0, 0, 0, 0, 0];
                (0, packet(6, ports, &rest, payload))
            }
        };
        let direction = if kind & 0x80 == 0 { Direction::Inbound } else { Direction::Outbound };
        writer.packet(interface, sequence.into(), direction, &bytes).unwrap();
        let (interface, utc_ns) = (interface as usize, Some(sequence.into()));
        written.push(Packet { interface, utc_ns, direction: Some(direction), bytes });
    }
    let (count, file) = writer.finish().unwrap();
    assert_eq!(count, written.len() as u64);
    assert_eq!(read(&file), written);
}

/// By IPv4 between these ports, with the rest of a header of UDP or TCP.
fn packet(protocol: u8, [from, to]: [u16; 2], rest: &[u8], payload: &[u8]) -> Vec<u8> {
    let mut bytes = [&[2; 12], &[8, 0, 0x45, 0, 0, 0, 0, 0, 0, 0, 64, protocol][..], &[0; 10]].concat();
    bytes.extend(from.to_be_bytes());
    bytes.extend(to.to_be_bytes());
    bytes.extend(rest);
    bytes.extend(payload);
    bytes
}

/// What is read, all of it in words.
fn read(bytes: &[u8]) -> Vec<Packet> {
    let (mut packets, mut decoder) = (Vec::new(), Decoder::new(vec![("modbus-tcp", 99)]));
    let Ok(mut capture) = Capture::open(bytes) else { return packets };
    while let Ok(Some(packet)) = capture.next_packet() {
        let take = |telegram: &Telegram<'_>| {
            assert!(!telegram.to_string().contains('\n'));
            Ok::<(), ()>(())
        };
        decoder.enter(&capture.interfaces()[packet.interface], &packet, take).unwrap();
        packets.push(packet);
        assert!(packets.len() <= bytes.len(), "it goes on without end");
    }
    assert!(!decoder.finish().is_empty());
    packets
}
