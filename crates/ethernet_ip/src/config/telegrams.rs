//! Packets and messages of EtherNet/IP in words.

use fieldbeat_core::bus::reader::Reader;
use fieldbeat_keys::telegram::{Carrier, Front, Telegrams, Way, Words};

use crate::plan::{IO_PORT, PORT};
use crate::wire::assembly::{Inputs, Layout, OUTPUT_SIZE, Version, alarms, status};
use crate::wire::cip::{Reply, service};
use crate::wire::encapsulation::{Connected, Frame, Listed, Unconnected, command};
use crate::wire::io::Packet;

/// Those of this protocol.
pub const TELEGRAMS: &[Telegrams] = &[
    Telegrams { carrier: Carrier::Datagrams(IO_PORT), front: Front::whole, words: packet },
    Telegrams { carrier: Carrier::Datagrams(PORT), front: Front::whole, words: encapsulated },
    Telegrams { carrier: Carrier::Streams(PORT), front, words: encapsulated },
];

/// No mark shows where the next message begins: bytes that are none end with what has arrived.
fn front(bytes: &[u8]) -> Front {
    match Frame::next(bytes) {
        Ok(Some((_, size))) => Front::Telegram(size),
        Ok(None) => Front::Incomplete,
        Err(_) => Front::Foreign(bytes.len()),
    }
}

/// A class 1 packet.
fn packet(bytes: &[u8], way: Way) -> Option<Words> {
    /// Run or idle, in front of the outputs.
    const HEADER: usize = 4;
    let Packet { connection, sequence, count, data } = Packet::parse(bytes).ok()?;
    let mut words = Words::new(format_args!(
        "class 1 packet, connection {connection:#010x}, sequence {sequence}, count {count}"
    ));
    let inputs = [Version::V1, Version::V2]
        .into_iter()
        .find_map(|version| Inputs::parse(data, version, Layout::default()))
        .filter(|_| way != Way::ToDrive);
    match (inputs, data.split_first_chunk::<HEADER>()) {
        (Some(inputs), _) => {
            words.field(format_args!("status {:04x}h", inputs.status));
            let names = status::NAMES.iter().enumerate();
            let set = names.filter(|(bit, _)| inputs.status >> bit & 1 != 0);
            set.for_each(|(place, name)| words.then(if place == 0 { " " } else { ", " }, name));
            words.field(format_args!("position {} steps", inputs.absolute));
            words.field(format_args!("velocity {} rev/s", f64::from(inputs.velocity) / 240.0));
            alarms(inputs.alarm).for_each(|alarm| words.field(format_args!("alarm: {}", alarm.name)));
        }
        (None, Some((run, outputs))) if outputs.len() == OUTPUT_SIZE && way != Way::FromDrive => {
            words.field(if run[0] & 1 != 0 { "run" } else { "idle" });
            let command = Reader(outputs).long_le().unwrap_or_default();
            words.field(format_args!("command {command:#x}"));
            words.bytes(&outputs[HEADER..]);
        }
        _ => {
            words.field(format_args!("{} bytes", data.len()));
            words.bytes(data);
        }
    }
    Some(words)
}

/// A message with the header of the encapsulation.
fn encapsulated(bytes: &[u8], _: Way) -> Option<Words> {
    let Frame { header, data } = Frame::datagram(bytes)?;
    let mut words = Words::new(match header.command {
        command::NOP => "NOP",
        command::LIST_SERVICES => "ListServices",
        command::LIST_IDENTITY => "ListIdentity",
        command::LIST_INTERFACES => "ListInterfaces",
        command::REGISTER_SESSION => "RegisterSession",
        command::UNREGISTER_SESSION => "UnRegisterSession",
        command::SEND_RR_DATA => "SendRRData",
        _ => "SendUnitData",
    });
    words.field(format_args!("session {:#010x}", header.session));
    if header.status.0 != 0 {
        words.field(header.status);
    }
    match header.command {
        command::SEND_RR_DATA => {
            if let Some(unconnected) = Unconnected::parse(data) {
                message(unconnected.message, &mut words);
            }
        }
        command::SEND_UNIT_DATA => {
            if let Some(Connected { connection, sequence, message: inner }) = Connected::parse(data) {
                words.field(format_args!("connection {connection:#010x}, sequence {sequence}"));
                message(inner, &mut words);
            }
        }
        command::LIST_IDENTITY => {
            if let Some(listed) = Listed::parse(data) {
                let name = listed.identity.name.escape_debug();
                words.field(format_args!(
                    "{name} at {}, serial {:08x}",
                    listed.address, listed.identity.serial
                ));
            }
        }
        _ => {}
    }
    Some(words)
}

/// A request to an object, or the reply.
fn message(message: &[u8], words: &mut Words) {
    if let Some(Reply { service, status, data }) = Reply::parse(message) {
        words.field(format_args!("reply to {}: {status}", service_name(service)));
        return words.bytes(data);
    }
    let mut reader = Reader(message);
    let Some([service, length]) = reader.array() else { return };
    words.field(service_name(service));
    if let Some(path) = reader.bytes(2 * usize::from(length)) {
        path_words(path, words);
        words.bytes(reader.0);
    }
}

fn service_name(number: u8) -> String {
    match number {
        service::GET_ATTRIBUTES_ALL => "Get_Attributes_All".to_owned(),
        service::GET_ATTRIBUTE_SINGLE => "Get_Attribute_Single".to_owned(),
        service::SET_ATTRIBUTE_SINGLE => "Set_Attribute_Single".to_owned(),
        service::FORWARD_CLOSE => "Forward_Close".to_owned(),
        service::FORWARD_OPEN => "Forward_Open".to_owned(),
        service::LARGE_FORWARD_OPEN => "Large_Forward_Open".to_owned(),
        _ => format!("service {number:#04x}"),
    }
}

/// The logical segments at the front of a path, of 8 and 16 bits.
fn path_words(path: &[u8], words: &mut Words) {
    let mut reader = Reader(path);
    while let Some(kind) = reader.byte() {
        let name = match kind & 0xFC {
            0x20 => "class",
            0x24 => "instance",
            0x2C => "connection point",
            0x30 => "attribute",
            _ => return,
        };
        let value = match kind & 0x03 {
            0 => reader.byte().map(u16::from),
            1 => reader.byte().and_then(|_| reader.word_le()),
            _ => None,
        };
        let Some(value) = value else { return };
        words.then(" ", format_args!("{name} {value:#x}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::assembly::{Outputs, input_size};
    use crate::wire::cip::{Segment, class, request};
    use crate::wire::encapsulation::send_rr_data;
    use crate::wire::io::Outgoing;

    #[test]
    fn messages_name_their_service_and_object() {
        let path = [Segment::Class(class::IDENTITY), Segment::Instance(1), Segment::Attribute(0x101)];
        let mut bytes = Vec::new();
        send_rr_data(&mut bytes, 9, 0, &request(service::GET_ATTRIBUTE_SINGLE, &path, &[]), None);
        let expected =
            "SendRRData, session 0x00000009, Get_Attribute_Single class 0x1 instance 0x1 attribute 0x101";
        assert_eq!(encapsulated(&bytes, Way::Unknown).unwrap().text, expected);
        assert_eq!((front(&bytes), front(&bytes[..9])), (Front::Telegram(bytes.len()), Front::Incomplete));
        assert_eq!(front(&[0xFF; 5]), Front::Foreign(5));
        bytes.clear();
        send_rr_data(&mut bytes, 9, 0, &[0x8E, 0, 8, 0], None);
        let expected =
            "SendRRData, session 0x00000009, reply to Get_Attribute_Single: service not supported (0x08)";
        assert_eq!(encapsulated(&bytes, Way::Unknown).unwrap().text, expected);
    }

    #[test]
    fn packets_show_what_their_assemblies_say() {
        let mut outgoing = Outgoing::owner(5);
        outgoing.set_sequence(7, 8);
        outgoing.set_run(true);
        outgoing.set_outputs(&Outputs { command: 2, ..Outputs::default() });
        let text = packet(outgoing.bytes(), Way::ToDrive).unwrap().text;
        let expected = "class 1 packet, connection 0x00000005, sequence 7, count 8, run, command 0x2: 00 00";
        assert!(text.starts_with(expected), "{text}");
        let mut bytes = outgoing.bytes()[..20].to_vec();
        bytes.extend(vec![0; input_size(Version::V2)]);
        bytes[16] = (2 + input_size(Version::V2)) as u8;
        (bytes[20], bytes[44]) = (9, 100);
        let text = packet(&bytes, Way::Unknown).unwrap().text;
        assert!(text.contains("status 0009h") && text.contains("position 100 steps"), "{text}");
        assert_eq!(packet(&bytes[..30], Way::Unknown), None);
    }
}
