//! Class 1 packets.

use super::super::assembly::{self, Inputs, Outputs, command, status};
use super::super::io::{OUTGOING_MAX, OWNER_SIZE, Outgoing, Packet, PacketError};
use super::*;
use crate::Layout;

/// tshark: enabled and in position, 24.2 V, 1.501 A, 30.5 °C, -838, 404167, error 12, 2 rev/s, inputs 1 ... 8 open.
const INCOMING: &str = "02 00 02 80 08 00 01 00 01 00 01 00 00 00 B1 00 3A 00 01 00 | 09 00 00 00 00 00 00 \
     00 F2 00 00 00 DD 05 00 00 31 01 00 00 BA FC FF FF C7 2A 06 00 0C 00 00 00 E0 01 00 00 00 00 00 00 FF \
     00 00 00 00 00 00 00 00 00 00 00 00 00 00 00";

#[test]
fn tshark_first_packet_of_an_owner_enables_and_heartbeats_show_no_outputs() {
    let mut golden =
        hex("02 00 02 80 08 00 13 00 01 5A 01 00 00 00 B1 00 46 00 01 00 01 00 00 00 02 00 00 00");
    golden.resize(OUTGOING_MAX, 0);
    let mut packet = Outgoing::owner(OUTGOING_ID);
    packet.set_sequence(1, 1);
    packet.set_run(true);
    packet.set_outputs(&Outputs { command: command::ENABLE, ..Outputs::default() });
    assert_eq!(packet.bytes(), golden);
    assert_eq!((packet.bytes().len(), OWNER_SIZE), (88, 70));
    // Idle, later: nothing else changes.
    packet.set_run(false);
    packet.set_sequence(0x0807_0605, 0x0A09);
    golden[10..14].copy_from_slice(&[5, 6, 7, 8]);
    golden[18..21].copy_from_slice(&[9, 10, 0]);
    assert_eq!(packet.bytes(), golden);
    // Heartbeats show no outputs.
    for (size, expected) in [(0, 18), (2, 20), (6, 24), (255, 88)] {
        let mut packet = Outgoing::heartbeat(7, size);
        packet.set_sequence(0x0102_0304, 0x0506);
        packet.set_run(true);
        assert_eq!(packet.bytes().len(), expected);
        assert_eq!(usize::from(packet.bytes()[16]), expected - 18, "the item says its size");
        let golden = hex("02 00 02 80 08 00 07 00 00 00 04 03 02 01 B1 00");
        assert_eq!(packet.bytes()[..16], golden);
        let data = [6, 5, 1, 0, 0, 0];
        let shown = data.len().min(expected - 18);
        assert_eq!(packet.bytes()[18..18 + shown], data[..shown]);
    }
}

#[test]
fn outputs_are_where_the_manual_has_them() {
    // HCR: VE5, AC100, DE100, two turns to the left; SO2L.
    let outputs = Outputs {
        command: command::HOST,
        jog_speed: -1,
        jog_acceleration: 2,
        jog_deceleration: 3,
        velocity: 1200,
        acceleration: 600,
        deceleration: 601,
        distance: -40_000,
        current: -2000,
        letters: assembly::Letters::new("SO").unwrap(),
        register_1: 0x4CB2,
        register_2: 7,
    };
    let golden = hex(
        "00 00 04 00 FF FF FF FF 02 00 00 00 03 00 00 00 B0 04 00 00 58 02 00 00 59 02 00 00 C0 63 FF FF 30 \
         F8 FF FF 4F 53 00 00 B2 4C 00 00 07 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00",
    );
    assert_eq!(outputs.bytes()[..], golden);
    let mut packet = Outgoing::owner(1);
    packet.set_outputs(&outputs);
    assert_eq!(packet.bytes()[24..], golden);
}

#[test]
fn inputs_are_those_of_tshark_and_of_the_host_command_reference() {
    let golden = hex(INCOMING);
    let packet = Packet::parse(&golden).unwrap();
    assert_eq!((packet.connection, packet.sequence, packet.count), (INCOMING_ID, 1, 1));
    let data = packet.data;
    let expected = Inputs {
        status: status::ENABLED | status::IN_POSITION,
        alarm: 0,
        voltage: 242,
        current: 1501,
        temperature: 305,
        encoder: -838,
        absolute: 404_167,
        position_error: Some(12),
        velocity: 480,
        extended_inputs: 0,
        main_inputs: 0xFF,
        outputs: None,
        analog: Some([0, 0]),
    };
    assert_eq!(Inputs::parse(data, Version::V2, Layout::Manual), Some(expected));
    assert_eq!(Inputs::parse(data, Version::V1, Layout::Manual), None);
    // The first two bytes are the count.
    let example = hex(
        "E0 03 28 00 A8 C0 19 00 00 00 E9 01 00 00 38 02 BA FC FF FF C7 2A 06 00 C3 FF FF 40 00 0F 0F 00",
    );
    let expected = Inputs {
        status: status::ENABLED | status::IN_POSITION | status::MOVING,
        alarm: 0,
        voltage: 489,
        current: 0,
        temperature: 568,
        encoder: -838,
        absolute: 404_167,
        position_error: None,
        velocity: -61,
        extended_inputs: 0x40FF,
        main_inputs: 0x0F00,
        outputs: Some(0x000F),
        analog: None,
    };
    assert_eq!(Inputs::parse(&example[2..], Version::V1, Layout::Manual), Some(expected));
    assert_eq!(Inputs::parse(&example, Version::V1, Layout::Manual), None);
}

#[test]
fn both_orders_of_the_inputs() {
    let data: Vec<u8> =
        (1..=14_u32).flat_map(|element| ((element << 16) | (100 + element)).to_le_bytes()).collect();
    let value = |element: u32| (element << 16) | (100 + element);
    let manual = Inputs::parse(&data, Version::V2, Layout::Manual).unwrap();
    assert_eq!((manual.status, manual.alarm, manual.voltage), (101, value(2), value(3)));
    assert_eq!((manual.position_error, manual.velocity), (Some(value(8) as i32), value(9) as i32));
    assert_eq!((manual.extended_inputs, manual.main_inputs, manual.outputs), (value(10), value(11), None));
    assert_eq!(manual.analog, Some([value(13), value(14)]));
    let page = Inputs::parse(&data, Version::V2, Layout::Page).unwrap();
    assert_eq!((page.position_error, page.velocity), (None, value(8) as i32));
    assert_eq!((page.extended_inputs, page.main_inputs), (value(9), value(10)));
    assert_eq!(page.outputs, Some(value(11)));
    let rest = |inputs: Inputs| Inputs {
        position_error: None,
        velocity: 0,
        extended_inputs: 0,
        main_inputs: 0,
        outputs: None,
        ..inputs
    };
    assert_eq!(rest(page), rest(manual));
}

#[test]
fn a_malformed_packet_says_why() {
    let golden = hex(INCOMING);
    for (at, byte, why) in [
        (0, 1, PacketError::NoPacket),
        (0, 3, PacketError::NoPacket),
        (3, 0, PacketError::NoPacket),
        // Its length is wrong.
        (4, 4, PacketError::NoPacket),
        (14, 0xB2, PacketError::NoPacket),
        (16, 0x3B, PacketError::Length),
        (16, 0x20, PacketError::Length),
    ] {
        let mut packet = golden.clone();
        packet[at] = byte;
        assert_eq!(Packet::parse(&packet), Err(why), "{at}");
    }
    // A class 0 packet, and one without the count that class 1 has.
    let class_0 = hex("02 00 A1 00 04 00 01 00 01 00 B1 00 02 00 01 00");
    assert_eq!(Packet::parse(&class_0), Err(PacketError::NoPacket));
    let bare = hex("02 00 02 80 08 00 01 00 01 00 01 00 00 00 B1 00 01 00 01");
    assert_eq!(Packet::parse(&bare), Err(PacketError::Length));
    for size in 0..golden.len() {
        let expected = if size < 18 { PacketError::NoPacket } else { PacketError::Length };
        assert_eq!(Packet::parse(&golden[..size]), Err(expected));
    }
}
