//! SOEM, a master that others wrote, by the Python package pysoem, on our simulated segment.

use std::collections::BTreeMap;
use std::process::Command;

use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive};
use fieldbeat::sim::ethercat::{EthercatSegment, Model, SegmentSettings, SlaveSettings};

use super::dissector::{ABORT, LRW, dissect, exchanges};
use super::{WIRE, cable, capture, said, serve};
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

/// A coupler, digital outputs that are wired to digital inputs, outputs behind two SyncManagers, analogue inputs, and
/// two drives.
fn with_terminals() -> EthercatSegment {
    let drives = [5, 6].map(|place| KollmorgenDrive::new(format!("d{place}"), place, Family::S700));
    let plan = EthercatPlan::new(WIRE, drives.into());
    let models = [Model::Ek1100, Model::El2008, Model::El1008, Model::El2809, Model::El3102].map(Some);
    let slave = |model| SlaveSettings { model, ..SlaveSettings::default() };
    let mut slaves: BTreeMap<u16, SlaveSettings> = (0..).zip(models.map(slave)).collect();
    slaves.entry(1).or_default().wired_to = Some(2);
    let settings = SegmentSettings { interface: Some(WIRE.into()), slaves, ..SegmentSettings::default() };
    EthercatSegment { settings, ..plan.into() }
}

#[test]
#[ignore = "needs root, iproute2, tshark, python3 and pysoem"]
fn soem_brings_drives_coupler_and_terminals_to_op_and_turns_a_drive() {
    let (machine, cable) = (Machine::new(39), cable(39));
    let _segment = serve(&cable, with_terminals());
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
    let drives = said["mapped"].iter().filter(|mapped| !mapped.starts_with("4 0x1a0"));
    assert_eq!(drives.copied().collect::<Vec<_>>(), [mapped(5), mapped(6)].concat());
    assert_eq!(said["abort"], [4, 5, 6].map(|place| format!("{place} {NO_OBJECT}")));
    // Its mailbox is too small for a dictionary, which it says.
    assert!(said.contains_key("no-objects") && !said.contains_key("objects"));
    assert_eq!(said["state"], ["SAFEOP", "OP", "INIT"]);
    let states = said["status"].iter().map(|word| u16::from_str_radix(&word[2..], 16).unwrap() & 0x6F);
    assert_eq!(states.collect::<Vec<_>>(), [0x21, 0x23, 0x27]);
    let moved: Vec<i32> = said["moved"][0].split(' ').map(|counts| counts.parse().unwrap()).collect();
    // 5000 counts per 250 us for 400 ms, less the ramp: about 7 million. The other one stays where it is.
    assert!((4_000_000..11_000_000).contains(&moved[0]) && moved[1].abs() < 100, "{moved:?}");
    // What the first one writes is read by the one that it is wired to; nobody reads the 16 outputs of the other one.
    let wired: Vec<Vec<&str>> = said["wired"].iter().map(|wired| wired.split(' ').collect()).collect();
    let written: Vec<[&str; 3]> = wired.iter().map(|wired| [wired[0], wired[1], wired[2]]).collect();
    assert_eq!(written, [["1", "55", "55"], ["1", "aa", "aa"], ["3", "5555", "aa"], ["3", "aaaa", "aa"]]);
    judge(&dissect(&file));
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
