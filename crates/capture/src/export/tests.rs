use fieldbeat_core::inputs::entry::{of_bus, peer};
use fieldbeat_core::inputs::recording::{Recording, log};
use fieldbeat_core::inputs::replaying::Entries;
use fieldbeat_core::rt::Regions;
use fieldbeat_modbus::wire::{Header, Request};

use super::*;
use crate::decode::{Decoder, Telegram};
use crate::headers::{Carried, Segment, frame};
use crate::reader::{Capture, Packet};

/// Two drives by Modbus, one of them at a port of its own, one by LinUDP and one by PROFIBUS.
const MACHINE: &str = r#"
[cycle]
period = "1ms"
[[bus]]
protocol = "modbus-tcp"
name = "m"
bind = "10.0.0.1"
[[bus.drive]]
name = "u"
address = "10.0.0.2:1502"
[[bus.drive]]
name = "v"
address = "10.0.0.3"
[[bus]]
protocol = "linudp-v2"
name = "l"
bind = "10.0.1.1"
[[bus.drive]]
name = "x"
address = "10.0.1.2"
[[bus]]
protocol = "profibus-dp"
name = "p"
device = "local:captures"
rate = 12000000
[[bus.drive]]
name = "y"
address = 3
limits.velocity = 20
"#;

const LATER_NS: i64 = 1_000_000;

/// The capture that is made of a log.
fn exported(work: impl FnOnce(&Recording)) -> (Vec<u8>, u64) {
    let (recording, mut reader) = log(1 << 12, &mut Regions::default());
    work(&recording);
    recording.end();
    let mut words = Vec::new();
    reader.take(&mut words);
    let mut pieces = vec![words];
    let plan = fieldbeat_config::parse(MACHINE, "m.toml").unwrap().plan;
    let mut bytes = Vec::new();
    let export = Export::new(&mut bytes, "test", &plan, LATER_NS, std::iter::empty()).unwrap();
    let (packets, is_broken) = export.all(Entries::new(Box::new(move || pieces.pop()))).unwrap();
    assert!(!is_broken);
    (bytes, packets)
}

fn packets(bytes: &[u8]) -> (Vec<Packet>, Vec<String>, String) {
    let (mut capture, mut decoder) = (Capture::open(bytes).unwrap(), Decoder::new(Vec::new()));
    let (mut packets, mut lines) = (Vec::new(), Vec::new());
    while let Some(packet) = capture.next_packet().unwrap() {
        let interface = &capture.interfaces()[packet.interface];
        let take = |telegram: &Telegram<'_>| {
            lines.push(telegram.to_string());
            Ok::<(), ()>(())
        };
        decoder.enter(interface, &packet, take).unwrap();
        packets.push(packet);
    }
    (packets, lines, decoder.finish())
}

fn request(transaction: u16) -> Vec<u8> {
    let mut bytes = [0; 64];
    let header = Header { transaction, unit: 255 };
    let size = Request::Read { address: 9, count: 1 }.emit(header, &mut bytes);
    bytes[..size].to_vec()
}

const RESPONSE: [u8; 11] = [0, 1, 0, 0, 0, 5, 255, 3, 2, 0x12, 0x34];

/// The ends and the numbers of each segment.
fn segments(packets: &[Packet]) -> Vec<(String, u32, usize)> {
    let found = packets.iter().filter_map(|packet| match frame(&packet.bytes)?.ipv4()? {
        Carried::Segment(from, to, Segment { sequence, bytes, .. }) => {
            Some((format!("{from} {to}"), sequence, bytes.len()))
        }
        _ => None,
    });
    found.collect()
}

#[test]
fn connections_are_numbered_without_a_gap_and_one_that_is_opened_again_is_another_one() {
    /// The source of the connections, and what it gives.
    const SOURCE: u64 = 7;
    let place = of_bus(0, 0);
    let (bytes, count) = exported(|log| {
        let ready = || log.entry(Kind::Value, &[SOURCE, 0], &[]);
        log.cycle(1);
        log.entry_at(Kind::BytesOut, Time(10), &[place, 12], &request(1));
        ready();
        log.entry_at(Kind::BytesIn, Time(20), &[place], &RESPONSE[..4]);
        log.nothing();
        ready();
        log.entry_at(Kind::BytesIn, Time(30), &[place], &RESPONSE[4..]);
        log.cycle(2);
        // Half of it is taken, then the rest.
        log.entry_at(Kind::BytesOut, Time(40), &[place, 5], &request(2));
        log.entry_at(Kind::BytesOut, Time(50), &[place, 7], &request(2)[5..]);
        log.cycle(3);
        // It was given up here, and opened again.
        ready();
        log.nothing();
        log.entry_at(Kind::BytesOut, Time(60), &[place, 12], &request(3));
        log.cycle(4);
        ready();
        log.entry(Kind::Broken, &[place, 1], &[]);
        log.entry_at(Kind::BytesOut, Time(70), &[place, 12], &request(4));
        log.entry_at(Kind::BytesUnsent, Time(80), &[place, 1], &request(5));
        log.entry_at(Kind::BytesOut, Time(90), &[of_bus(0, 1), 12], &request(1));
    });
    let (packets, lines, last) = packets(&bytes);
    assert_eq!((count, packets.len()), (8, 8));
    let out = |port: u16| format!("10.0.0.1:{port} 10.0.0.2:1502");
    let inward = "10.0.0.2:1502 10.0.0.1:49152".to_owned();
    let expected = [
        (out(49152), 1, 12),
        (inward.clone(), 1, 4),
        (inward, 5, 7),
        (out(49152), 13, 5),
        (out(49152), 18, 7),
        (out(49153), 1, 12),
        (out(49154), 1, 12),
        ("10.0.0.1:49155 10.0.0.3:502".to_owned(), 1, 12),
    ];
    assert_eq!(segments(&packets), expected);
    assert_eq!(last, "6 telegrams: 6 modbus-tcp");
    assert_eq!(
        lines[1],
        "1970-01-01T00:00:00.001000030Z m in 10.0.0.2:1502 > 10.0.0.1:49152 modbus-tcp: response of function 3, \
         transaction 1, unit 255, 1 registers: 1234"
    );
}

#[test]
fn packets_of_a_cycle_are_in_the_order_of_their_times() {
    let drive = of_bus(1, 0) | peer("10.0.1.2:49360".parse().unwrap());
    let (bytes, _) = exported(|log| {
        log.cycle(1);
        log.entry_at(Kind::DatagramOut, Time(50), &[drive], &[0; 8]);
        // It came before, and was taken in behind.
        log.entry_at(Kind::DatagramIn, Time(40), &[drive], &[0; 8]);
        log.entry(Kind::DatagramUnsent, &[drive, 0], &[0; 8]);
    });
    let (_, lines, _) = packets(&bytes);
    assert_eq!(
        lines,
        [
            "1970-01-01T00:00:00.001000040Z l in 10.0.1.2:49360 > 10.0.1.1:41136 linudp-v2: reply with blocks 000h",
            "1970-01-01T00:00:00.001000050Z l out 10.0.1.1:41136 > 10.0.1.2:49360 linudp-v2: request of blocks 000h",
        ]
    );
}

#[test]
fn telegrams_of_a_serial_wire_are_put_together_and_what_is_none_is_there_too() {
    let place = of_bus(2, 0);
    let status = [0x10, 3, 2, 0x49, 0x4E, 0x16];
    let (bytes, count) = exported(|log| {
        log.cycle(1);
        log.entry_at(Kind::BytesOut, Time(10), &[place, 6], &status);
        log.entry_at(Kind::BytesIn, Time(20), &[place], &[0x10, 2, 3]);
        log.entry_at(Kind::BytesIn, Time(30), &[place], &[0, 5, 0x16, 0xE5, 0]);
        log.entry_at(Kind::BytesIn, Time(40), &[place], &[0x68, 9]);
        log.entry_at(Kind::BytesOut, Time(50), &[place, 6], &status);
        log.entry_at(Kind::BytesIn, Time(60), &[place], &[0x10]);
    });
    let (packets, lines, last) = packets(&bytes);
    let expected: [(u64, &[u8]); 7] = [
        (10, &status),
        (30, &[0x10, 2, 3, 0, 5, 0x16]),
        (30, &[0xE5]),
        (30, &[0]),
        (40, &[0x68, 9]),
        (50, &status),
        (60, &[0x10]),
    ];
    let found: Vec<_> =
        packets.iter().map(|packet| (packet.utc_ns.unwrap() - 1_000_000, &packet.bytes[..])).collect();
    assert_eq!((count, &found[..]), (7, &expected[..]));
    assert_eq!(last, "4 telegrams: 4 profibus-dp; not known: 3 no telegrams of profibus-dp");
    assert!(lines[1].ends_with(" p in 3 > 2 profibus-dp: done"), "{lines:?}");
}

#[test]
fn entries_of_buses_and_drives_that_are_not_there_are_passed_over() {
    let (bytes, count) = exported(|log| {
        log.cycle(1);
        log.entry_at(Kind::BytesOut, Time(10), &[of_bus(0, 9), 99], &[1]);
        log.entry_at(Kind::FrameIn, Time(10), &[of_bus(9, 0)], &[1]);
        log.entry(Kind::Broken, &[of_bus(9, 9), 1], &[]);
    });
    assert_eq!((count, packets(&bytes).2), (0, "0 telegrams".to_owned()));
}
