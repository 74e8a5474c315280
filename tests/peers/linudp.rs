//! What others say about our bytes on the wire: Wireshark's dissectors on frames between the built master and the
//! simulated drives.
//!
//! Wireshark has no dissector for LinUDP, and no other implementation of it was run against these: that the datagrams
//! are well formed, carry right checksums and go where they should is its word. Their lengths are checked against the
//! blocks that the definitions in them announce (LinUDP V2 manual, 4.4), counted here anew.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

use crate::capture::{Capture, dissect, on_loopback};
use crate::support::{self, CABLE_NET, Cable, LONG, Machine, PROGRAM, Program, assert_sums, drive, until};

/// One datagram, as the dissector has it.
#[derive(Debug)]
struct Frame {
    from: SocketAddrV4,
    to: SocketAddrV4,
    bytes: Vec<u8>,
}

/// Ends the capture and lets the dissector judge every frame of it.
fn frames(capture: Capture<impl Fn(&str)>, check_udp: bool) -> Vec<Frame> {
    let fields = [
        "ip.src",
        "udp.srcport",
        "ip.dst",
        "udp.dstport",
        "udp.length",
        "udp.payload",
        "ip.checksum.status",
        "udp.checksum.status",
        "ip.flags.mf",
        "ip.frag_offset",
        "ip.ttl",
        "_ws.expert.message",
        "_ws.malformed",
    ];
    let sums = format!("udp.check_checksum:{check_udp}");
    // Its guesses at the payload are not part of the test.
    let options = ["-o", "ip.check_checksum:TRUE", "-o", &sums, "-d", "udp.port==41136,data"];
    let lines = dissect(&capture.end(), "udp && udp.dstport != 9 && !icmp", &options, &fields);
    lines.iter().map(|line| frame(line, check_udp)).collect()
}

fn frame(line: &str, check_udp: bool) -> Frame {
    let fields: Vec<&str> = line.split('|').collect();
    let [
        source,
        source_port,
        target,
        target_port,
        length,
        payload,
        ip,
        udp,
        more,
        offset,
        ttl,
        expert,
        malformed,
    ] = fields[..]
    else {
        panic!("{line}")
    };
    assert_eq!((expert, malformed), ("", ""), "{line}");
    // Status 1 is "good". Loopback leaves the sum of UDP to a network card that is not there.
    assert_eq!(ip, "1", "{line}");
    assert!(!check_udp || udp == "1", "{line}");
    assert!(["0", "False"].contains(&more) && offset == "0", "in one piece: {line}");
    assert!(ttl.parse::<u8>().unwrap() >= 1);
    let address =
        |ip: &str, port: &str| SocketAddrV4::new(ip.parse::<Ipv4Addr>().unwrap(), port.parse().unwrap());
    let bytes: Vec<u8> = (0..payload.len() / 2)
        .map(|at| u8::from_str_radix(&payload[2 * at..2 * at + 2], 16).unwrap())
        .collect();
    assert_eq!(length.parse::<usize>().unwrap(), bytes.len() + 8, "{line}");
    Frame { from: address(source, source_port), to: address(target, target_port), bytes }
}

/// The lengths that were seen of requests and of replies, each checked against its own definitions, and how many there
/// were of each drive.
struct Seen {
    requests: BTreeSet<usize>,
    replies: BTreeSet<usize>,
    by_drive: BTreeMap<Ipv4Addr, (u64, u64)>,
}

fn judge(frames: &[Frame], master: SocketAddrV4) -> Seen {
    let mut seen = Seen { requests: BTreeSet::new(), replies: BTreeSet::new(), by_drive: BTreeMap::new() };
    for frame in frames {
        let word = |at: usize| u32::from_le_bytes(frame.bytes[at..at + 4].try_into().unwrap());
        let (request, response) = (word(0), word(4));
        let sum = |definition: u32, blocks: &[usize]| -> usize {
            blocks.iter().enumerate().map(|(bit, size)| size * (definition >> bit & 1) as usize).sum()
        };
        assert_eq!((request >> 3, response >> 9), (0, 0), "reserved bits: {frame:?}");
        if frame.to.port() == 49360 {
            assert_eq!(frame.from, master, "{frame:?}");
            assert_eq!(frame.bytes.len(), 8 + sum(request, &[2, 32, 8]), "{frame:?}");
            seen.requests.insert(frame.bytes.len());
            seen.by_drive.entry(*frame.to.ip()).or_default().0 += 1;
        } else {
            assert_eq!((frame.from.port(), frame.to), (49360, master), "{frame:?}");
            assert_eq!(frame.bytes.len(), 8 + sum(response, &[2, 2, 4, 4, 2, 2, 2, 16, 8]), "{frame:?}");
            seen.replies.insert(frame.bytes.len());
            seen.by_drive.entry(*frame.from.ip()).or_default().1 += 1;
        }
    }
    seen
}

/// Three drives: plain, with a tag in each request, with monitoring channels.
fn machine(machine: &Machine) -> PathBuf {
    let text = std::fs::read_to_string(machine.plain(3)).unwrap();
    machine.write(
        "m.toml",
        text.replace("name = \"d1\"", "name = \"d1\"\nreply_tag = \"count\"")
            .replace("name = \"d2\"", "name = \"d2\"\nmonitor = true"),
    )
}

/// Everything that the master says it sent was seen, and everything that it says was answered.
fn compare(seen: &Seen, summary: &Value, machine: &Machine) {
    assert_sums(summary);
    for index in 0..3 {
        let drive = drive(summary, &format!("d{index}"));
        let (requests, replies) = seen.by_drive[machine.drive(index).ip()];
        assert_eq!(requests, drive["sent"].as_u64().unwrap(), "{drive}");
        // A simulated drive answers each request; the last ones may lie with it when it is ended.
        assert!(replies <= requests && replies + 2 >= requests, "{replies} replies: {drive}");
    }
}

/// A probe with every block, so that it is read only all the same: each fourth one while the drive is silent.
const WHOLE_PROBE: usize = 48;

/// These lengths, and no other but
///
/// - of requests: a whole probe, after three that were missed
/// - of replies: to the request after a miss. It asks for no current, so that its reply differs from a late one, or
///   next to a count for the monitoring channels, or not for them; and the error code comes with every second one
/// - of replies: to a whole probe, with its configuration block
fn assert_lengths(seen: &Seen, summary: &Value, requests: &[usize], replies: &[usize]) {
    let set = |lengths: &[usize]| lengths.iter().copied().collect::<BTreeSet<_>>();
    let mut requested = seen.requests.clone();
    let mut allowed = set(replies);
    allowed.extend(replies.iter().flat_map(|length| [length - 4, length - 2, length + 16, length - 16]));
    if requested.remove(&WHOLE_PROBE) {
        let missed = |drive: &Value| drive["missed"].as_u64().unwrap();
        let drives = summary["drives"].as_array().unwrap();
        assert!(drives.iter().any(|drive| missed(drive) >= 3), "{summary}");
        allowed.extend(allowed.clone().into_iter().map(|length| length + 8));
    }
    assert_eq!(requested, set(requests));
    assert!(seen.replies.is_superset(&set(replies)), "{:?}", seen.replies);
    assert!(seen.replies.is_subset(&allowed), "{:?}", seen.replies);
}

/// Of replies: status, state, positions, current and fault, in turn with the warn word, four channels, and both; with
/// the warn word and the echo of a count.
const LENGTHS: [usize; 5] = [24, 26, 34, 40, 42];

fn master_and_drives(config: &Path, start: impl Fn(&str) -> Command) -> Value {
    let mut sim = Program::spawn(start("sim").arg(config));
    sim.await_text("listening");
    let ended = Program::spawn(start("run").arg(config).args(["--for", "2s", "--json"])).end();
    ended.expect(0);
    sim.end_by(libc::SIGINT).expect(0);
    ended.json()
}

#[test]
#[ignore = "needs root and tshark: captures on loopback"]
fn tshark_finds_nothing_wrong_on_loopback() {
    let machine = Machine::new(1);
    let config = self::machine(&machine);
    let capture = on_loopback(&machine);
    let summary = master_and_drives(&config, |command| {
        let mut program = Command::new(PROGRAM);
        program.arg(command);
        program
    });
    let seen = judge(&frames(capture, false), machine.master());
    compare(&seen, &summary, &machine);
    // The definitions alone, and with a tag: these drives got no command, so they are only read.
    assert_lengths(&seen, &summary, &[8, 16], &LENGTHS);
}

/// Where a network card has to compute them, the sums of UDP are right too.
#[test]
#[ignore = "needs root, tshark, ethtool and network namespaces (iproute2)"]
fn tshark_finds_nothing_wrong_on_a_cable() {
    let machine = Machine::new(2).on(CABLE_NET);
    let cable = Cable::new(2, &[11, 12, 13]);
    for end in [&cable.master, &cable.drives] {
        support::command(&["ip", "netns", "exec", end, "ethtool", "-K", "wire", "tx", "off"]);
    }
    let config = self::machine(&machine);
    let capture = Capture::start(Some(&cable.master), "wire", "udp", machine.path("wire.pcapng"), |text| {
        let marker = format!("echo '{text}' > /dev/udp/{}/9", machine.ip(11));
        support::command(&["ip", "netns", "exec", &cable.master, "bash", "-c", &marker]);
    });
    let summary = master_and_drives(&config, |command| {
        let namespace = if command == "sim" { &cable.drives } else { &cable.master };
        let mut program = Cable::command(namespace, PROGRAM);
        program.arg(command);
        program
    });
    let seen = judge(&frames(capture, true), machine.master());
    compare(&seen, &summary, &machine);
    assert_lengths(&seen, &summary, &[8, 16], &LENGTHS);
}

#[test]
#[ignore = "needs root and tshark: captures on loopback"]
fn tshark_finds_nothing_wrong_with_drives_in_motion() {
    // The addresses of the first demo of this computer.
    let free = || UdpSocket::bind("127.77.0.1:41136").is_ok();
    assert!(until(LONG, free), "a demo runs on this computer: end it (ss -ulpn shows which)");
    let machine = Machine::new(3).on([127, 77, 0]);
    let capture = on_loopback(&machine);
    let ended = Program::start(["demo", "--for", "15s", "--drives", "2", "--json"]).end();
    let summary = ended.json();
    let seen = judge(&frames(capture, false), "127.77.0.1:41136".parse().unwrap());
    // Read only at first; then the control word, alone and with a motion command.
    assert_lengths(&seen, &summary, &[8, 10, 42], &[24, 26, 40, 42]);
    for (host, name) in [(11, "a1"), (12, "a2")] {
        let (requests, replies) = seen.by_drive[&Ipv4Addr::new(127, 77, 0, host)];
        let drive = drive(&summary, name);
        assert_eq!(requests, drive["sent"].as_u64().unwrap(), "{drive}");
        // The last ones may still be on their way when the demo ends its drives.
        assert!(replies <= requests && replies + 5 >= requests, "{replies} of {requests}");
    }
}
