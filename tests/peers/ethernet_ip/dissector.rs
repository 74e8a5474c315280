//! What Wireshark's dissectors of EtherNet/IP and CIP make of the frames between our master and our simulated drives.

use std::collections::{BTreeMap, BTreeSet};
use std::net::Ipv4Addr;
use std::path::Path;

use fieldbeat::Master;
use fieldbeat::axis::{Command, Jog, ParameterError};
use fieldbeat::bus::ethernet_ip::{Delivery, Explicit, MoonsDrive};
use fieldbeat_sim::ethernet_ip::MoonsSettings;

use super::{drive, plan, serve};
use crate::capture::{dissect, on_loopback};
use crate::support::{LONG, Machine, until};

/// One message of a session, as the dissector has it.
#[derive(Clone, Debug, PartialEq)]
struct Message {
    drive: Ipv4Addr,
    /// Else it is a reply.
    is_request: bool,
    /// Of the encapsulation.
    command: u64,
    session: u64,
    context: String,
    /// The service, without the bit of a reply.
    service: Option<u64>,
    status: Option<u64>,
    /// Of a message on a connection.
    sequence: Option<u64>,
    /// Of an open: connection serial, both sizes, multiplier, both intervals in us.
    open: Vec<u64>,
    /// Connection ids, where it is about a connection.
    connections: Vec<u64>,
}

const SESSION: u64 = 0x65;
const END: u64 = 0x66;
const UNCONNECTED: u64 = 0x6F;
const CONNECTED: u64 = 0x70;

const IDENTITY: u64 = 0x01;
const GET: u64 = 0x0E;
const VENDOR: u64 = 0x3C;
const OPEN: u64 = 0x54;
const CLOSE: u64 = 0x4E;

/// Where class 1 packets go.
const IO: u16 = 2222;

const FIELDS: [&str; 17] = [
    "ip.src",
    "ip.dst",
    "tcp.dstport",
    "enip.command",
    "enip.session",
    "enip.context",
    "enip.status",
    "cip.service",
    "cip.genstat",
    "cip.seq",
    "cip.cm.conn_serial_num",
    "cip.cm.fwo.consize",
    "cip.cm.timeout_multiplier",
    "cip.cm.otrpi",
    "cip.cm.torpi",
    "cip.cm.ot_connid",
    "cip.cm.to_connid",
];

/// Decimal, or hexadecimal behind 0x.
fn decoded(text: &str) -> Option<u64> {
    match text.strip_prefix("0x") {
        Some(digits) => u64::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    }
}

fn message(line: &str) -> Message {
    let fields: Vec<&str> = line.split('|').collect();
    let number = |at: usize| decoded(fields[at]);
    let is_request = number(2) == Some(44_818);
    assert_eq!(number(6), Some(0), "{line}");
    Message {
        drive: fields[if is_request { 1 } else { 0 }].parse().unwrap(),
        is_request,
        command: number(3).unwrap(),
        session: number(4).unwrap(),
        context: fields[5].into(),
        service: number(7).map(|service| service & 0x7F),
        status: number(8),
        sequence: number(9),
        open: fields[10..15].iter().flat_map(|field| field.split(',')).filter_map(decoded).collect(),
        connections: (15..17).filter_map(number).collect(),
    }
}

/// The requests to one drive and their replies, in order. One at a time; a session ends without a reply.
fn exchanges(messages: &[Message], drive: Ipv4Addr) -> Vec<(Message, Message)> {
    let mut rest = messages.iter().filter(|message| message.drive == drive);
    let mut exchanges = Vec::new();
    while let Some(request) = rest.next() {
        assert!(request.is_request, "a reply to nothing: {request:?}");
        if request.command == END {
            assert_eq!(rest.next(), None);
            break;
        }
        let reply = rest.next().unwrap_or_else(|| panic!("no reply: {request:?}"));
        let same = |of: &Message| (of.command, of.context.clone(), of.service, of.sequence);
        assert!(!reply.is_request && same(reply) == same(request), "{request:?} {reply:?}");
        exchanges.push((request.clone(), reply.clone()));
    }
    exchanges
}

/// One class 1 packet, as the dissector has it.
#[derive(Clone, Debug)]
struct Packet {
    source: Ipv4Addr,
    destination: Ipv4Addr,
    ports: [u64; 2],
    dscp: u64,
    connection: u64,
    sequence: u64,
    count: u64,
    /// Of the connected data.
    length: u64,
    run: Option<u64>,
    data: String,
    /// Whose open it has found, by its frame.
    open: Option<u64>,
}

const PACKET_FIELDS: [&str; 12] = [
    "ip.src",
    "ip.dst",
    "udp.srcport",
    "udp.dstport",
    "ip.dsfield.dscp",
    "enip.cpf.sai.connid",
    "enip.cpf.sai.seq",
    "cip.seq",
    "enip.cpf.length",
    "cip.32bitheader.run_idle",
    "cipio.data",
    "enip.fwd_open_in",
];

fn packets(file: &Path) -> Vec<Packet> {
    let lines = dissect(file, &format!("udp.port == {IO}"), &[], &PACKET_FIELDS);
    let packet = |line: &String| {
        let fields: Vec<&str> = line.split('|').collect();
        let expected = |at: usize| decoded(fields[at]).unwrap_or_else(|| panic!("{at}: {line}"));
        Packet {
            source: fields[0].parse().unwrap(),
            destination: fields[1].parse().unwrap(),
            ports: [expected(2), expected(3)],
            dscp: expected(4),
            connection: expected(5),
            sequence: expected(6),
            count: expected(7),
            // That of the address item comes first.
            length: decoded(fields[8].strip_prefix("8,").unwrap_or_default()).unwrap(),
            run: decoded(fields[9]),
            data: fields[10].replace(':', ""),
            open: decoded(fields[11]),
        }
    };
    lines.iter().map(packet).collect()
}

/// A stream of packets: agreed sizes, the next numbers.
#[track_caller]
fn judge(stream: &[&Packet], length: u64, connection: u64) {
    for (index, packet) in stream.iter().enumerate() {
        let number = index as u64 + 1;
        assert_eq!((packet.sequence, packet.count), (number, number & 0xFFFF), "{packet:?}");
        assert_eq!((packet.length, packet.connection), (length, connection), "{packet:?}");
        // What the size is made of: sequence count, run/idle, assembly.
        let assembly = length - 2 - if packet.run.is_some() { 4 } else { 0 };
        assert_eq!(packet.data.len() as u64, 2 * assembly, "{packet:?}");
        assert!(packet.open.is_some() && packet.ports == [u64::from(IO); 2], "{packet:?}");
    }
}

#[test]
#[ignore = "needs root and tshark: captures on loopback"]
fn tshark_finds_nothing_wrong_with_ethernet_ip() {
    let machine = Machine::new(66);
    let mut drives: Vec<MoonsDrive> =
        (0..2).map(|index| drive(&format!("d{index}"), machine.ip(11 + index))).collect();
    (drives[1].explicit, drives[1].delivery) = (Explicit::Connected, Delivery::Multicast);
    let _server = serve(drives.iter().map(MoonsSettings::of));
    let capture = on_loopback(&machine);
    let master = Master::from_plan(plan(machine.ip(1), drives.clone())).start().unwrap();
    master.wait_online(LONG).unwrap();
    for name in ["d0", "d1"] {
        let mut axis = master.axis(name).unwrap();
        let parameter = axis.parameter();
        parameter.write("R:3", 12_345).unwrap();
        assert_eq!(parameter.read::<i32>("R:3").unwrap(), 12_345);
        let refused = parameter.read::<u16>("0x77/1/1.u16").unwrap_err();
        assert!(matches!(refused, ParameterError::Refused { .. }), "{refused}");
        axis.enable().unwrap();
        axis.post(Command::Jog(Jog { velocity: -2.5, acceleration: 100.0 })).unwrap();
        let begin = axis.feedback().status.position;
        assert!(until(LONG, || axis.feedback().status.position < begin - 0.5), "{:?}", axis.feedback());
        axis.stop().unwrap();
    }
    let end = master.finish().end;
    let file = capture.end();
    let others = dissect(
        &file,
        &format!(
            // What a busy host answers late is sent again.
            "(tcp.len > 0 && !enip && !tcp.analysis.retransmission) || (udp.port == {IO} && !cipio) || \
             _ws.malformed || (enip && _ws.expert.severity >= \"Warning\")"
        ),
        &[],
        &["frame.number", "_ws.col.Protocol", "_ws.col.Info", "_ws.expert.message"],
    );
    assert!(others.is_empty(), "{others:?}");

    let lines = dissect(&file, "enip && tcp", &[], &FIELDS);
    let messages: Vec<Message> = lines.iter().map(|line| message(line)).collect();
    let packets = packets(&file);
    for (index, (drive, end)) in drives.iter().zip(&end.drives).enumerate() {
        let ip = *drive.address.ip();
        let exchanges = exchanges(&messages, ip);
        let session = exchanges[0].1.session;
        assert!(session != 0 && exchanges[0].0.session == 0 && exchanges[0].0.command == SESSION);
        assert!(
            exchanges[1..].iter().all(|(request, reply)| [request.session, reply.session] == [session; 2])
        );
        // What a session begins with: identity, profile code, the connection.
        let services: Vec<_> = exchanges.iter().map(|(request, _)| request.service).collect();
        assert_eq!(services[..4], [None, Some(IDENTITY), Some(GET), Some(OPEN)]);
        // Opens and closes are unconnected.
        let is_call = |request: &Message| ![Some(OPEN), Some(CLOSE)].contains(&request.service);
        let calls: Vec<_> = exchanges[4..].iter().filter(|(request, _)| is_call(request)).collect();
        let result = |(request, reply): &&(Message, Message)| (request.service, reply.status);
        // A session that waits for long asks for the vendor now and then.
        let keeps_alive = (Some(GET), Some(0));
        let results: Vec<_> = calls.iter().map(result).filter(|result| *result != keeps_alive).collect();
        // Written, read back, read; what does not exist.
        let expected =
            [(VENDOR, 0), (VENDOR, 0), (GET, 0x05)].map(|(service, status)| (Some(service), Some(status)));
        assert_eq!(results, expected);
        let statuses = exchanges.iter().filter_map(|(_, reply)| reply.status);
        assert_eq!(statuses.filter(|status| *status != 0).collect::<Vec<_>>(), [0x05]);
        let connected = drive.explicit == Explicit::Connected;
        let way = if connected { CONNECTED } else { UNCONNECTED };
        assert!(calls.iter().all(|(request, _)| request.command == way), "{calls:?}");
        let sequences: Vec<_> = calls.iter().filter_map(|(request, _)| request.sequence).collect();
        let counted = if connected { calls.len() as u64 } else { 0 };
        assert_eq!(sequences, (1..=counted).collect::<Vec<_>>());
        // Each open has another serial, and its close.
        let serials = |service| {
            let of = exchanges.iter().filter(move |(request, _)| request.service == Some(service));
            of.map(|(request, _)| request.open[0]).collect::<BTreeSet<_>>()
        };
        assert_eq!(serials(OPEN).len(), 1 + usize::from(connected));
        assert_eq!(serials(OPEN), serials(CLOSE));

        let (request, reply) = &exchanges[3];
        let multiplier = drive.multiplier(2_000_000).into();
        assert_eq!(request.open[1..], [70, 58, multiplier, 10_000, 10_000]);
        let sent: Vec<_> = packets.iter().filter(|packet| packet.destination == ip).collect();
        let came: Vec<_> = packets.iter().filter(|packet| packet.source == ip).collect();
        judge(&sent, 70, reply.connections[0]);
        judge(&came, 58, reply.connections[1]);
        // Idle at the orderly end only.
        let mut runs: Vec<_> = sent.iter().map(|packet| packet.run).collect();
        runs.dedup();
        assert!([Some(1), Some(0)].starts_with(&runs), "{runs:?}");
        assert!(came.iter().all(|packet| packet.run.is_none()));
        assert!(sent.iter().all(|packet| packet.dscp == 47));
        assert_eq!(sent.len() as u64, end.counters.sent, "{:?}", end.counters);
        let to: BTreeSet<_> = came.iter().map(|packet| packet.destination).collect();
        assert!(to.len() == 1 && to.first().unwrap().is_multicast() == (index == 1), "{to:?}");
        // Command words as edges: enable, jog, and a stop, with idle in front of each of them.
        let mut words: Vec<&str> = sent.iter().map(|packet| &packet.data[..8]).collect();
        words.dedup();
        let idle = "00000000";
        let mut seen = BTreeMap::new();
        for (at, word) in words.iter().enumerate() {
            assert_eq!(*word == idle, at % 2 == 0, "{words:?}");
            *seen.entry(*word).or_insert(0) += 1;
        }
        let times = |word| seen.get(word).copied().unwrap_or(0);
        assert_eq!([times("02000000"), times("00000100")], [1, 1], "{words:?}");
        assert!(times("00800000") >= 1, "{words:?}");
    }
}
