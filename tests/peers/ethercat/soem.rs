//! SOEM, a master that others wrote, by the Python package pysoem, on our simulated segment.

use std::process::Command;

use fieldbeat::bus::ethercat::{Area, SlavePlan};

use super::dissector::{ABORT, LRW, dissect, exchanges};
use super::{WIRE, cable, capture, said, serve, with_terminals};
use crate::support::{Cable, Machine, Program, checkout};

/// The working counter of all process data: two of each output terminal, one of each input terminal, three a drive.
const COUNTER: u64 = 2 + 1 + 2 + 1 + 3 + 3;
/// The abort of an object that does not exist.
const NO_OBJECT: &str = "0x6020000";

/// Its program: `turn`, `hold` or `hold-unwatched`.
pub fn program(namespace: &str, what: &str) -> Command {
    let python = checkout("target/peers/python/bin/python");
    let mut command = Cable::command(namespace, python.to_str().unwrap());
    command.arg(checkout("tests/peers/ethercat/soem.py")).args([WIRE, what]);
    command
}

#[test]
#[ignore = "needs root, iproute2, tshark, python3 and pysoem"]
fn soem_brings_drives_coupler_and_terminals_to_op_and_turns_a_drive() {
    let (machine, cable) = (Machine::new(39), cable(39));
    let segment = with_terminals();
    let drive = segment.plan.drives[0].slave.clone();
    let _segment = serve(&cable, segment);
    let mut ended = None;
    let file = capture(&cable, &machine, || {
        ended = Some(Program::spawn(&mut program(&cable.master, "turn")).end());
    });
    let ended = ended.unwrap();
    ended.expect(0);
    let said = said(&ended);
    assert_eq!(said["slaves"], ["7"]);
    let identities = [
        "0 0x2 0x44c2c52",
        "1 0x2 0x7d83052",
        "2 0x2 0x3f03052",
        "3 0x2 0xaf93052",
        "4 0x2 0xc1e3052",
        "5 0x6a 0x3000600",
        "6 0x6a 0x3000600",
    ];
    assert_eq!((&said["identity"][..], &said["sii"][..]), (&identities[..], &identities[..]));
    assert_eq!(said["clock"], ["0 0", "1 0", "2 0", "3 0", "4 0", "5 64", "6 64"]);
    assert_eq!(said["delay"], ["5 0", "6 500"]);
    assert_eq!(said["product"], ["4 0xc1e3052", "5 0x3000600", "6 0x3000600"]);
    let mapped = |place| {
        ["0x1702 0x606b0020 0x60400010", "0x1b03 0x60640020 0x60770010 0x60410010"]
            .map(|pdo| format!("{place} {pdo}"))
    };
    // Two channels: the bits of its status, the state and toggle of its PDO, its value.
    let channel = |n: u32| {
        let (data, pdo) = (0x6000 + 0x10 * n, 0x1800 + 2 * n);
        let status = [(data, 1, 1), (data, 2, 1), (data, 3, 2), (data, 5, 2), (data, 7, 1)];
        let rest = [(0, 0, 7), (pdo, 7, 1), (pdo, 9, 1), (data, 0x11, 16)];
        let entries = status.into_iter().chain(rest);
        let entries = entries.map(|(index, sub, bits)| format!("{:#x}", index << 16 | sub << 8 | bits));
        format!("4 {:#x} {}", 0x1A00 + 2 * n, entries.collect::<Vec<_>>().join(" "))
    };
    let analogue = [channel(0), channel(1)];
    assert_eq!(said["mapped"], [&analogue[..], &mapped(5), &mapped(6)].concat());
    // Outputs of 8 and 16 bits, of the drives 6 bytes each; inputs of 8 bits, two analogue ones, 8 bytes a drive.
    assert_eq!(said["image"], [(1 + 2 + 2 * 6 + 1 + 8 + 2 * 8).to_string()]);
    assert_eq!(said["category"], categories(&drive));
    assert_eq!(said["abort"], [4, 5, 6].map(|place| format!("{place} {NO_OBJECT}")));
    // Its mailbox is too small for a dictionary, which it says.
    assert!(said.contains_key("no-objects") && !said.contains_key("objects"));
    assert_eq!(said["state"], ["SAFEOP", "OP", "INIT"]);
    let states = said["status"].iter().map(|word| u16::from_str_radix(&word[2..], 16).unwrap() & 0x6F);
    assert_eq!(states.collect::<Vec<_>>(), [0x21, 0x23, 0x27]);
    let moved: Vec<i32> = said["moved"][0].split(' ').map(|counts| counts.parse().unwrap()).collect();
    // 5000 counts per 250 us for 400 ms, less the ramp: about 7 million, and more where cycles are late. The other one
    // stays where it is.
    assert!(moved[0] > 4_000_000 && moved[1].abs() < 100, "{moved:?}");
    // What the first one writes is read by the one that it is wired to; nobody reads the 16 outputs of the other one.
    let wired: Vec<Vec<&str>> = said["wired"].iter().map(|wired| wired.split(' ').collect()).collect();
    let written: Vec<[&str; 3]> = wired.iter().map(|wired| [wired[0], wired[1], wired[2]]).collect();
    assert_eq!(written, [["1", "55", "55"], ["1", "aa", "aa"], ["3", "5555", "aa"], ["3", "aaaa", "aa"]]);
    judge(&dissect(&file));
}

/// What SOEM reads in the SIIs, category by category as ETG.2010 has them: 10 strings, 40 FMMUs, 41 SyncManagers, 50
/// and 51 PDOs. Those of terminals are of the published descriptions.
fn categories(drive: &SlavePlan) -> Vec<String> {
    let strings = |name: &str| {
        let bytes: String = name.bytes().map(|byte| format!("{byte:02x}")).collect();
        let text = format!("01{:02x}{bytes}", name.len());
        (10, if text.len().is_multiple_of(4) { text } else { text + "00" })
    };
    // Index, one entry, SyncManager; the entry of one bit.
    let bits = |pdo: u16, object: u16, count: u16, manager: fn(u16) -> u16| -> String {
        let hex = |word: u16| format!("{:04x}", word.swap_bytes());
        let one = |n| {
            let (pdo, object) = (hex(pdo + n), hex(object + 0x10 * n));
            format!("{pdo}01{:02x}00000000{object}010000010000", manager(n))
        };
        (0..count).map(one).collect()
    };
    let manager = |Area { start, length }: Area, control: u8, usage: u8| {
        let [a, b] = start.to_le_bytes();
        let [c, d] = length.to_le_bytes();
        format!("{a:02x}{b:02x}{c:02x}{d:02x}{control:02x}0001{usage:02x}")
    };
    let [out, input] = drive.mailbox.expect("it has mailboxes");
    let of_drive =
        [(out, 0x26, 1), (input, 0x22, 2), (drive.outputs[0], 0x64, 3), (drive.inputs[0], 0x20, 4)];
    let of_drive = || of_drive.map(|(area, control, usage)| manager(area, control, usage)).concat();
    let own: [Vec<(u16, String)>; 7] = [
        vec![strings("EK1100")],
        vec![
            strings("EL2008"),
            (40, "0100".into()),
            (41, "000f010044000103".into()),
            (51, bits(0x1600, 0x7000, 8, |_| 0)),
        ],
        vec![
            strings("EL1008"),
            (40, "0200".into()),
            (41, "0010010000000104".into()),
            (50, bits(0x1A00, 0x6000, 8, |_| 0)),
        ],
        vec![
            strings("EL2809"),
            (40, "0101".into()),
            (41, "000f010044000103010f010044000103".into()),
            (51, bits(0x1600, 0x7000, 16, |n| n / 8)),
        ],
        vec![
            strings("EL3102"),
            (40, "01020300".into()),
            (41, "0010800026000101801080002200010200110000240000038011080020000104".into()),
        ],
        vec![strings("S700"), (40, "01020300".into()), (41, of_drive())],
        vec![strings("S700"), (40, "01020300".into()), (41, of_drive())],
    ];
    let lines = own.iter().enumerate();
    lines
        .flat_map(|(place, own)| own.iter().map(move |(kind, hex)| format!("{place} {kind} {hex}")))
        .collect()
}

/// All of its frames are well formed, and the process data of all slaves come back in OP.
fn judge(frames: &[super::dissector::Frame]) {
    let exchanges = exchanges(frames);
    let back: Vec<_> = exchanges.iter().filter_map(|(_, back)| back.as_ref()).collect();
    assert!(back.len() + 5 > exchanges.len(), "{} of {}", back.len(), exchanges.len());
    let cycles = back.iter().flat_map(|frame| &frame.datagrams).filter(|datagram| datagram.command == LRW);
    assert!(cycles.filter(|datagram| datagram.working_counter == COUNTER).count() > 200);
    let messages = back.iter().flat_map(|frame| &frame.messages);
    assert_eq!(messages.filter(|message| (message.service, message.command) == (2, ABORT)).count(), 3);
}
