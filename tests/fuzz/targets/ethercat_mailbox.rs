//! The mailbox of a slave against one that loses, delays, repeats and garbles its answers, counts as it likes, and says
//! what nobody requested.
//!
//! Each value that the slave returns names its object and the transfer whose request it answers. So what has to hold
//! is seen from outside: a transfer ends in time, a value that is read is one of its own object, requested by this
//! transfer and by none before; and what is reported as written arrived at the slave.

use std::collections::VecDeque;

use fieldbeat::axis::Link;
use fieldbeat::bus::ethercat::{Area, Object, SlavePlan};
use fieldbeat::time::{MS, Time};
use fieldbeat_core::axis::acyclic::{self, Commanding};
use fieldbeat_core::bus::Counters;
use fieldbeat_ethercat::service::Service;
use fieldbeat_ethercat::slot::{Answer, Ask};
use fieldbeat_ethercat::wire::frame::Command;

use super::input::Input;

const OUT: u16 = 0x1800;
const IN: u16 = 0x1C00;
/// Status, `activate` and the slave's control of the mailbox that the master reads.
const STATUS: u16 = 0x080D;
const ACTIVATE: u16 = 0x080E;
const TOGGLE: u8 = 2;
const ANSWER_NS: u64 = 50 * MS;
/// Three attempts, and one of no effect before them.
const MOST_STEPS: u32 = 5 * 50 + 20;
const OBJECTS: [u16; 2] = [0x2001, 0x2002];
/// What a slave has not answered yet.
const QUEUE: usize = 3;

/// The counts of a slave's messages.
#[derive(Clone, Copy, Debug)]
enum Counting {
    Returned,
    Own,
    None,
}

struct Slave {
    length: usize,
    counting: Counting,
    own: u8,
    last: Option<u8>,
    /// A request whose last byte has not come, one that waits, and the transfer that it belongs to.
    begun: Option<Vec<u8>>,
    out: Option<(u8, Vec<u8>)>,
    /// The message that can be read; the last one that was.
    offered: Option<Vec<u8>>,
    read: Option<Vec<u8>>,
    activate: u8,
    control: u8,
    answers: VecDeque<Vec<u8>>,
    /// What was written, by which transfer.
    written: Vec<(u8, Vec<u8>)>,
    /// The transfer of the master, that of the request at work, and what a long write has brought so far.
    transfer: u8,
    at_work: u8,
    parts: Vec<u8>,
}

impl Slave {
    /// Takes a request out of its mailbox, and answers it.
    fn work(&mut self) {
        if self.answers.len() >= QUEUE {
            return;
        }
        let Some((transfer, request)) = self.out.take() else { return };
        self.at_work = transfer;
        let count = request[5] >> 4;
        if self.last.replace(count) == Some(count) {
            return;
        }
        let end = 6 + usize::from(u16::from_le_bytes([request[0], request[1]]));
        let Some(body) = self.answer(&request[8..end.min(request.len())]) else { return };
        self.send(count, 3, &[&[0, 0x30][..], &body].concat());
    }

    fn send(&mut self, count: u8, kind: u8, content: &[u8]) {
        let count = match self.counting {
            Counting::Returned => count,
            Counting::Own => {
                self.own = self.own % 7 + 1;
                self.own
            }
            Counting::None => 0,
        };
        let [low, high] = (content.len() as u16).to_le_bytes();
        let mut message = [&[low, high, 0, 0, 0, count << 4 | kind][..], content].concat();
        message.resize(self.length, 0xEE);
        self.answers.push_back(message);
    }

    fn answer(&mut self, sdo: &[u8]) -> Option<Vec<u8>> {
        let head = |command: u8, value: [u8; 4]| [&[command, sdo[1], sdo[2], sdo[3]][..], &value].concat();
        let index = u16::from_le_bytes([sdo[1], sdo[2]]);
        match sdo[0] {
            // Its object, and the transfer that has requested it.
            0x40 if OBJECTS.contains(&index) => Some(head(0x43, [sdo[1], sdo[2], 0, self.at_work])),
            0x40 => Some(head(0x80, [0, 0, 2, 6])),
            0x23 | 0x27 | 0x2B | 0x2F => {
                let bytes = 4 - usize::from(sdo[0] >> 2 & 3);
                self.written.push((self.at_work, sdo[4..4 + bytes].to_vec()));
                Some(head(0x60, [0; 4]))
            }
            0x21 => {
                self.parts = sdo[8..].to_vec();
                if self.parts.len() == usize::from(sdo[4]) {
                    self.written.push((self.at_work, self.parts.clone()));
                }
                Some(head(0x60, [0; 4]))
            }
            command if command < 0x20 => {
                let used = if sdo.len() == 8 { 7 - usize::from(command >> 1 & 7) } else { sdo.len() - 1 };
                self.parts.extend_from_slice(&sdo[1..1 + used]);
                if command & 1 != 0 {
                    self.written.push((self.at_work, std::mem::take(&mut self.parts)));
                }
                Some(vec![0x20 | command & 0x10, 0, 0, 0, 0, 0, 0, 0])
            }
            _ => None,
        }
    }

    /// A datagram of the master, as the chip carries it out.
    fn pass(&mut self, command: Command, data: &mut [u8]) -> u16 {
        let end = |start: u16| usize::from(start) + self.length;
        match command {
            Command::Fpwr(_, ACTIVATE) => {
                self.activate = data[0];
                1
            }
            Command::Fpwr(_, start) if (OUT..IN).contains(&start) => {
                // The last byte by itself closes what is there.
                let is_close = start != OUT;
                let is_whole = start == OUT && data.len() == self.length;
                assert!(usize::from(start) + data.len() <= end(OUT), "beyond its mailbox");
                if self.out.is_some() || is_close && self.begun.is_none() {
                    return 0;
                }
                if start == OUT {
                    let mut message = data.to_vec();
                    message.resize(self.length, 0);
                    self.begun = Some(message);
                }
                if is_whole || is_close {
                    self.out = self.begun.take().map(|message| (self.transfer, message));
                }
                1
            }
            Command::Fprd(_, STATUS) => {
                let full = if self.offered.is_some() { 0x08 } else { 0 };
                data.copy_from_slice(&[full, self.activate, self.control]);
                1
            }
            Command::Fprd(_, start) => {
                assert!(start >= IN && usize::from(start) + data.len() <= end(IN), "beyond its mailbox");
                let at = usize::from(start - IN);
                let Some(message) = &self.offered else { return 0 };
                data.copy_from_slice(&message[at..at + data.len()]);
                if at + data.len() == self.length {
                    self.read = self.offered.take();
                }
                1
            }
            other => panic!("{other:?}"),
        }
    }
}

/// What was begun, and has to hold in the end.
enum Begun {
    Read(u16),
    Write(Vec<u8>),
}

/// What becomes of a frame.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Fate {
    Returns,
    NeverArrives,
    NeverReturns,
}

pub fn ethercat_mailbox(data: &[u8]) {
    let mut input = Input(data);
    let length = input.of(&[16_u16, 64, 100, 300]);
    let counting = input.of(&[Counting::Returned, Counting::Own, Counting::None]);
    // It sends a message again, only acknowledges that, or neither.
    let (resends, acknowledges) = input.of(&[(true, true), (false, true), (false, false)]);
    let areas = [Area { start: OUT, length }, Area { start: IN, length }];
    let plan = SlavePlan { mailbox: Some(areas), sdo_timeout_ns: ANSWER_NS, ..SlavePlan::new(0) };
    let (_, port) = acyclic::queue(1, Commanding::none());
    let mut service = Service::new(&plan, port, 0);
    service.open(true);
    let mut slave = Slave {
        length: length.into(),
        counting,
        own: 0,
        last: None,
        begun: None,
        out: None,
        offered: None,
        read: None,
        activate: 1,
        control: 0,
        answers: VecDeque::new(),
        written: Vec::new(),
        transfer: 0,
        at_work: 0,
        parts: Vec::new(),
    };
    let (mut now, mut counters) = (Time(1_000 * MS), Counters::default());
    while !input.is_over() {
        slave.transfer = slave.transfer.wrapping_add(1);
        slave.written.clear();
        let begun = begin(&mut service, &slave, &mut input);
        let mut steps = 0;
        let end = loop {
            if let Some(end) = service.take_end() {
                break end;
            }
            assert!(steps < MOST_STEPS, "it never ends: {service:?}");
            steps += 1;
            now = now + MS;
            disturb(&mut slave, &mut input);
            if acknowledges && (slave.activate ^ slave.control) & TOGGLE != 0 {
                slave.control = slave.activate & TOGGLE;
                if resends && slave.offered.is_none() {
                    slave.offered = slave.read.clone();
                }
            }
            step(&mut service, &mut slave, now, input.of(&FATES), &mut counters);
            while service.take_emergency().is_some() {}
        };
        match (begun, end) {
            (Begun::Read(index), Ok(value)) => {
                let expected = u32::from(index) | u32::from(slave.transfer) << 24;
                assert_eq!(value, expected, "{value:#x}, not {expected:#x}");
            }
            (Begun::Write(bytes), Ok(_)) => {
                let written = (slave.transfer, bytes);
                assert!(slave.written.contains(&written), "{written:?}: {:?}", slave.written);
            }
            (_, Err(_)) => {}
        }
    }
}

/// Most frames return.
const FATES: [Fate; 8] = {
    let mut fates = [Fate::Returns; 8];
    (fates[1], fates[2]) = (Fate::NeverArrives, Fate::NeverReturns);
    fates
};

fn begin(service: &mut Service, slave: &Slave, input: &mut Input<'_>) -> Begun {
    let index = input.of(&OBJECTS);
    let object = Object::new(index, 0);
    match input.below(3) {
        0 => {
            service.read(object);
            Begun::Read(index)
        }
        1 => {
            service.write(object, &[slave.transfer, 0]);
            Begun::Write(vec![slave.transfer, 0])
        }
        _ => {
            let bytes = vec![slave.transfer; 5 + input.below(100)];
            service.write(object, &bytes);
            Begun::Write(bytes)
        }
    }
}

/// What the slave does in a millisecond: its work, or something else.
fn disturb(slave: &mut Slave, input: &mut Input<'_>) {
    match input.below(8) {
        1 => return,
        2 => slave.send(0, 3, &[0, 0x10, 1, 0x10, 8, 0, 0, 0, 0, 0]),
        3 => slave.send(0, 2, &[0x5A; 20][..(slave.length - 6).min(20)]),
        _ => slave.work(),
    }
    let late = input.below(8) == 1;
    if slave.offered.is_some() || late {
        return;
    }
    let Some(mut message) = slave.answers.pop_front() else { return };
    match input.below(12) {
        1 => message[0] = input.byte(),
        2 => message[1] = input.byte(),
        3 => message[5] = message[5] & 0xF0 | input.byte() & 0x0F,
        4 => message[7] = input.byte(),
        5 => message[8] = 0xA0,
        6 => message[10] ^= 0x40,
        7 => message[11] ^= 1,
        8 => {
            message[8] = 0x80;
            message[12..16].copy_from_slice(&[0, 0, 0, 8]);
        }
        9 if !matches!(slave.counting, Counting::None) => slave.answers.push_front(message.clone()),
        _ => {}
    }
    slave.offered = Some(message);
}

fn step(service: &mut Service, slave: &mut Slave, now: Time, fate: Fate, counters: &mut Counters) {
    service.advance(now, Link::Online, false);
    let mut ask = Ask::default();
    service.request(now, &mut ask);
    let mut replies: Vec<(u16, Vec<u8>)> = Vec::new();
    for (command, data) in ask.datagrams() {
        let mut data = data.to_vec();
        let count = if fate == Fate::NeverArrives { 0 } else { slave.pass(command, &mut data) };
        replies.push((count, data));
    }
    let mut answers = [None; 2];
    if fate == Fate::Returns {
        for (answer, (working_counter, data)) in answers.iter_mut().zip(&replies) {
            *answer = Some(Answer { working_counter: *working_counter, data });
        }
    }
    service.receive(now, &answers, counters);
}
