//! What Wireshark's dissectors of EtherCAT and its mailbox make of a capture.

use std::collections::VecDeque;
use std::path::Path;

use crate::capture;

/// A frame, as the dissector has it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Frame {
    /// Its number in the capture, and when it was captured, ns.
    pub number: u64,
    pub at_ns: u64,
    /// It comes from the master; else the first slave has marked its source.
    pub is_sent: bool,
    /// Bytes.
    pub length: u64,
    /// Its datagrams in order.
    pub datagrams: Vec<Datagram>,
    /// Data that the dissector knows no register or mailbox for, of one datagram after the other.
    pub plain: Vec<Vec<u8>>,
    /// The state that is requested in AL control.
    pub state: Option<u64>,
    /// Messages in mailboxes.
    pub messages: Vec<Message>,
}

impl Frame {
    /// How long it is when nothing stands behind its datagrams.
    pub fn least(&self) -> u64 {
        HEADER + self.datagrams.iter().map(|datagram| datagram.length + AROUND).sum::<u64>()
    }
}

/// A datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Datagram {
    pub command: u64,
    pub index: u64,
    pub address: Address,
    pub length: u64,
    pub working_counter: u64,
}

/// Where a datagram goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Address {
    /// Position or station, and register.
    Slave(u64, u64),
    Logical(u64),
}

/// A CoE message in a mailbox.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Message {
    pub counter: u64,
    /// 1 emergency, 2 SDO request, 3 SDO response.
    pub service: u64,
    /// What the request wants, or the response is: 4 is an abort.
    pub command: u64,
    /// Index and subindex; the dissector does not show those of an abort.
    pub object: Option<(u64, u64)>,
    pub data: Option<u64>,
}

/// Commands by their numbers.
pub(super) const NOP: u64 = 0;
pub(super) const APRD: u64 = 1;
pub(super) const APWR: u64 = 2;
pub(super) const FPRD: u64 = 4;
pub(super) const FPWR: u64 = 5;
pub(super) const BRD: u64 = 7;
pub(super) const BWR: u64 = 8;
pub(super) const LRW: u64 = 12;
pub(super) const FRMW: u64 = 14;
/// Services of CoE, and what their requests want and their responses are.
pub(super) const REQUEST: u64 = 2;
pub(super) const RESPONSE: u64 = 3;
pub(super) const DOWNLOAD: u64 = 1;
pub(super) const UPLOAD: u64 = 2;
pub(super) const UPLOADED: u64 = 2;
pub(super) const DOWNLOADED: u64 = 3;
pub(super) const ABORT: u64 = 4;

const LOGICAL: std::ops::RangeInclusive<u64> = 10..=LRW;
/// In front of a datagram's data, and behind it.
const AROUND: u64 = 12;
/// In front of all datagrams.
const HEADER: u64 = 16;
const COE: u64 = 3;
/// The bit of the source that the first slave sets.
const PASSED: u8 = 1 << 1;

const FIELDS: [&str; 27] = [
    "frame.number",
    "frame.len",
    "eth.src",
    "ecatf.length",
    "ecatf.reserved",
    "ecatf.type",
    "ecat.cmd",
    "ecat.idx",
    "ecat.adp",
    "ecat.ado",
    "ecat.lad",
    "ecat.subframe.length",
    "ecat.subframe.reserved",
    "ecat.subframe.circulating",
    "ecat.subframe.more",
    "ecat.cnt",
    "ecat_mailbox.type",
    "ecat_mailbox.counter",
    "ecat_mailbox.coe.type",
    "ecat_mailbox.coe.sdoreq",
    "ecat_mailbox.coe.sdores",
    "ecat_mailbox.coe.sdoidx",
    "ecat_mailbox.coe.sdosub",
    "ecat_mailbox.coe.sdodata",
    "ecat.data",
    "ecat.reg.alctrl.ctrl",
    "frame.time_epoch",
];

/// What tshark says of what it cannot read.
const TROUBLE: &str = "_ws.malformed || _ws.expert || ecat_mailbox.invalid || ecat_mailbox.coe.invalid || \
                       (eth.type == 0x88a4 && !ecat)";
/// What it says of the address that SOEM sends from.
const GROUP_SOURCE: &str = "|Source MAC must not be a group address: IEEE 802.3-2002, Section 3.2.3(b)";

/// The EtherCAT frames of `file`, each whole and well formed.
pub(super) fn dissect(file: &Path) -> Vec<Frame> {
    let mut trouble = capture::dissect(file, TROUBLE, &[], &["frame.number", "_ws.expert.message"]);
    trouble.retain(|line| !line.ends_with(GROUP_SOURCE));
    assert!(trouble.is_empty(), "{trouble:?}");
    let lines = capture::dissect(file, "ecatf", &[], &FIELDS);
    lines.iter().map(|line| frame(line)).collect()
}

/// A number as tshark writes it.
fn number(text: &str) -> u64 {
    let parsed = text.strip_prefix("0x").map_or_else(|| text.parse(), |hex| u64::from_str_radix(hex, 16));
    parsed.unwrap_or_else(|error| panic!("{text}: {error}"))
}

/// Seconds as tshark writes them, with nine places.
fn nanoseconds(text: &str) -> u64 {
    let (seconds, places) = text.split_once('.').unwrap_or_else(|| panic!("{text}"));
    assert_eq!(places.len(), 9, "{text}");
    let [seconds, places] = [seconds, places].map(|part| part.parse::<u64>().unwrap());
    seconds * 1_000_000_000 + places
}

fn frame(line: &str) -> Frame {
    let fields: Vec<&str> = line.split('|').collect();
    let all = |at: usize| -> Vec<u64> {
        fields[at].split(',').filter(|text| !text.is_empty()).map(number).collect()
    };
    let one = |at: usize| number(fields[at]);
    let datagrams = datagrams([6, 7, 8, 9, 10, 11, 15].map(all));
    let sum: u64 = datagrams.iter().map(|datagram| datagram.length + AROUND).sum();
    assert_eq!((one(3), one(4), one(5)), (sum, 0, 1), "length, reserved, type: {line}");
    assert!(one(1) >= HEADER + sum, "{line}");
    let mut more = vec![1; datagrams.len()];
    more.last_mut().into_iter().for_each(|last| *last = 0);
    let none = vec![0; datagrams.len()];
    assert_eq!((all(12), all(13), all(14)), (none.clone(), none, more), "{line}");
    let source = u8::from_str_radix(&fields[2][..2], 16).unwrap();
    let messages = messages([16, 17, 18, 19, 20, 21, 22, 23].map(all), line);
    Frame {
        number: one(0),
        at_ns: nanoseconds(fields[26]),
        is_sent: source & PASSED == 0,
        length: one(1),
        datagrams,
        plain: fields[24].split(',').map(bytes).collect(),
        state: all(25).first().copied(),
        messages,
    }
}

/// Hexadecimal digits, without anything between them.
fn bytes(text: &str) -> Vec<u8> {
    let pair = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
    text.as_bytes().chunks(2).map(pair).collect()
}

fn datagrams([command, index, first, register, logical, length, counter]: [Vec<u64>; 7]) -> Vec<Datagram> {
    let count = command.len();
    assert_eq!([index.len(), length.len(), counter.len()], [count; 3]);
    let mut slaves = first.into_iter().zip(register);
    let mut logical = logical.into_iter();
    let address = |command| match LOGICAL.contains(&command) {
        true => Address::Logical(logical.next().unwrap()),
        false => slaves.next().map(|(first, register)| Address::Slave(first, register)).unwrap(),
    };
    let addresses: Vec<Address> = command.iter().copied().map(address).collect();
    let datagram = |n: usize| Datagram {
        command: command[n],
        index: index[n],
        address: addresses[n],
        length: length[n],
        working_counter: counter[n],
    };
    (0..count).map(datagram).collect()
}

/// At most one in a frame is taken apart; that is how masters send them.
fn messages(fields: [Vec<u64>; 8], line: &str) -> Vec<Message> {
    let [kind, counter, service, request, response, index, sub, data] = fields;
    assert!(kind.len() <= 1 && kind.iter().all(|kind| *kind == COE), "{line}");
    let message = |service: &u64| Message {
        counter: counter[0],
        service: *service,
        command: *request.first().or(response.first()).unwrap_or(&0),
        object: index.first().copied().zip(sub.first().copied()),
        data: data.first().copied(),
    };
    service.first().map(message).into_iter().collect()
}

/// Each frame that was sent, with the one that came back: the same datagrams, in the same order. `None`: it never came
/// back.
pub(super) fn exchanges(frames: &[Frame]) -> Vec<(Frame, Option<Frame>)> {
    let shape = |frame: &Frame| -> Vec<_> {
        frame.datagrams.iter().map(|datagram| (datagram.command, datagram.index, datagram.length)).collect()
    };
    let mut exchanges: Vec<(Frame, Option<Frame>)> = Vec::new();
    let mut under_way = VecDeque::new();
    for frame in frames {
        if frame.is_sent {
            assert!(frame.datagrams.iter().all(|datagram| datagram.working_counter == 0), "{frame:?}");
            under_way.push_back(exchanges.len());
            exchanges.push((frame.clone(), None));
            continue;
        }
        let sent = under_way.iter().position(|n| shape(&exchanges[*n].0) == shape(frame));
        let sent = sent.and_then(|place| under_way.remove(place));
        let sent = sent.unwrap_or_else(|| panic!("nobody has sent it: {frame:?}"));
        exchanges[sent].1 = Some(frame.clone());
    }
    exchanges
}
