//! Our own master: a segment from power-on to turning drives and down again, each frame of it captured.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::Path;
use std::thread::sleep;
use std::time::Duration;

use fieldbeat::axis::ParameterError;
use fieldbeat::bus::ethercat::{EthercatPlan, Family};
use fieldbeat::time::MS;
use fieldbeat::{CyclePlan, Master, Memory};

use super::dissector::{
    ABORT, APRD, APWR, Address, BRD, BWR, DOWNLOAD, DOWNLOADED, Datagram, FPRD, FPWR, FRMW, Frame, LRW,
    Message, NOP, REQUEST, RESPONSE, UPLOAD, UPLOADED, dissect, exchanges,
};
use super::{cable, capture, segment, serve};
use crate::capture;
use crate::support::{LONG, Machine, skipping};

/// rev/s.
const SPEED: f64 = 5.0;
/// Stations of the coupler and of the drives: 1001h is next to the master.
const COUPLER: u64 = 0x1001;
const DRIVES: [u64; 2] = [0x1002, 0x1003];
const AL_CONTROL: u64 = 0x0120;
const AL_STATUS: u64 = 0x0130;
const STATION: u64 = 0x0010;
/// Whether a slave answers to its alias.
const ALIAS: u64 = 0x0103;
const SII_OWNER: u64 = 0x0500;
const SII: u64 = 0x0502;
const LINKS: u64 = 0x0110;
const PORT_TIMES: u64 = 0x0900;
const TIME: u64 = 0x0910;
const OFFSET: u64 = 0x0920;
/// Status, `activate` and control of the mailbox that the master reads, and the mailboxes themselves.
const MAILBOX_STATUS: u64 = 0x080D;
const MAILBOX_OUT: u64 = 0x1800;
const MAILBOX_IN: u64 = 0x1C00;
/// Where the process data begin in the logical address space: one of these, so many bytes apart.
const LOGICAL: Range<u64> = 0x1000_0000..0xD000_0000;
const LOGICAL_EACH: u64 = 0x8_0000;
/// Datagrams in front of the slot: mark, clock, time, image, states.
const FIXED: usize = 5;
/// One byte of the coupler, and setpoint and control word of each drive.
const OUTPUTS: usize = 1 + 2 * 6;
/// An object that no drive has (CiA 301).
const NO_OBJECT: u32 = 0x0602_0000;
const OP: u16 = 8;
/// The object that the master reads where the host was held up, and an answer to an earlier request may still come.
const SETTLES: (u64, u64) = (0x1000, 0);

/// A frame, and what came back.
type Exchange = (Frame, Option<Frame>);
/// Command, register, bytes, and the state that is requested.
type Requested = (u64, u64, u64, Option<u64>);
/// What one slot requested.
type Slot = Vec<Requested>;

/// Whose affair a slot is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Affair {
    /// A step of the slave with this station address.
    Of(u64),
    /// Its mailbox.
    Mailbox(u64),
    /// The latch of all clocks, and the time of the reference at that.
    Clock,
}

/// What differs from run to run.
#[derive(Clone, Copy)]
struct Run {
    family: Family,
    short_clocks: bool,
    /// The grid follows the segment, and not the segment us.
    leads: bool,
}

impl Run {
    /// Bytes of the inputs of a drive, and where its status word begins there.
    fn inputs(self) -> (usize, usize) {
        match self.family {
            // Position, torque, status word; position, status word.
            Family::S700 => (8, 6),
            Family::Akd => (6, 4),
        }
    }

    fn image(self) -> usize {
        OUTPUTS + (2 + 1) + 2 * (2 + self.inputs().0)
    }

    /// What a slot may request of a mailbox: one that is no longer than a message is written and read at once; of a
    /// longer one the last byte goes with each message, and its first bytes are looked at with its status.
    fn mailbox_slots(self) -> Vec<Slot> {
        let (status, repeat) = ((FPRD, MAILBOX_STATUS, 3), slot_of([(FPWR, MAILBOX_STATUS + 1, 1)]));
        match self.family {
            Family::S700 => vec![
                slot_of([(FPWR, MAILBOX_OUT, 16)]),
                slot_of([status]),
                slot_of([(FPRD, MAILBOX_IN, 16)]),
                repeat,
            ],
            Family::Akd => vec![
                slot_of([(FPWR, MAILBOX_OUT, 16), (FPWR, MAILBOX_OUT + 0x3FF, 1)]),
                slot_of([status, (FPRD, MAILBOX_IN, 64)]),
                slot_of([(FPRD, MAILBOX_IN + 0x3FF, 1)]),
                repeat,
            ],
        }
    }
}

fn works_a_segment(test: u8, run: Run) {
    let (machine, cable) = (Machine::new(test), cable(test));
    let mut segment = segment(run.family, 2, run.short_clocks);
    for drive in &mut segment.plan.drives {
        drive.axis.profile.velocity = 2.0 * SPEED;
        drive.axis.profile.acceleration = 100.0;
        drive.axis.stop.deceleration = 100.0;
    }
    let plan = segment.plan.clone();
    let _line = serve(&cable, segment);
    let mut executed = 0;
    let file = capture(&cable, &machine, || executed = cable.at_master(|| work(plan, run.leads)));
    let exchanges = exchanges(&dissect(&file));
    assert_eq!(exchanges.len() as u64, executed, "a frame a cycle");
    let base = judge_frames(&exchanges, run);
    judge_slots(&exchanges, run);
    judge_fmmus(&file, run, base);
    judge_cycles(&exchanges, run);
    judge_mailboxes(&exchanges, run);
}

/// What the application does; how many cycles that were.
fn work(plan: EthercatPlan, leads: bool) -> u64 {
    let cycle = CyclePlan {
        period_ns: 2 * MS,
        receive_deadline: 0.8,
        reference: leads.then(|| plan.name.clone()),
        memory: Memory::Own,
        ..CyclePlan::default()
    };
    let master = Master::from_plan(skipping(plan, cycle)).start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axes = ["d1", "d2"].map(|name| master.axis(name).unwrap());
    for axis in &mut axes {
        axis.enable().unwrap_or_else(|error| panic!("{error}: {:?}", master.numbers()));
        axis.jog(SPEED).unwrap();
    }
    for axis in &axes {
        assert_eq!(axis.parameter().read::<u32>("0x1018:1"), Ok(0x6A));
        let refused = axis.parameter().read::<u32>("0x5FFF:1");
        assert!(matches!(refused, Err(ParameterError::Refused { status: NO_OBJECT, .. })), "{refused:?}");
    }
    sleep(Duration::from_secs(1));
    for axis in &mut axes {
        let turned = axis.feedback().status.position;
        assert!(turned > 1.0, "{:?}", axis.feedback());
        axis.stop().unwrap();
        axis.disable().unwrap();
    }
    master.finish().end.status.executed
}

/// What holds for every frame; where the process data begin in the logical address space.
fn judge_frames(exchanges: &[Exchange], run: Run) -> u64 {
    let mut order = [Vec::new(), Vec::new()];
    let mut masters = BTreeSet::new();
    let mut bases = BTreeSet::new();
    for (number, (sent, back)) in exchanges.iter().enumerate() {
        let [mark, clock, time, image, states, slot @ ..] = &sent.datagrams[..] else { panic!("{sent:?}") };
        // One index for all, the next one in the next frame, and nothing of an earlier one behind the datagrams.
        assert!(sent.datagrams.iter().all(|datagram| datagram.index == number as u64 % 256), "{sent:?}");
        assert_eq!(sent.length, sent.least(), "{sent:?}");
        assert!(slot.len() <= 2, "{sent:?}");
        let (master, count) = of_mark(sent);
        assert_eq!((mark.command, mark.address, mark.length), (NOP, Address::Slave(0, 0), 8), "{sent:?}");
        assert_eq!(count, number as u32, "{sent:?}");
        masters.insert(master);
        let Address::Logical(base) = image.address else { panic!("{sent:?}") };
        assert_eq!((image.command, image.length), (LRW, run.image() as u64), "{sent:?}");
        bases.insert(base);
        assert_eq!((states.command, states.address, states.length), (BRD, Address::Slave(0, AL_STATUS), 2));
        for (order, datagram) in order.iter_mut().zip([clock, time]) {
            order.push(datagram.command);
            let address = match datagram.command {
                NOP => Address::Slave(0, 0),
                _ => Address::Slave(DRIVES[0], TIME),
            };
            assert_eq!((datagram.address, datagram.length), (address, 4), "{sent:?}");
        }
        let Some(back) = back else { continue };
        assert_eq!(back.length, sent.length);
        assert_eq!(of_mark(back), (master, count), "{back:?}");
        assert_eq!(
            (back.datagrams[0].working_counter, back.datagrams[4].working_counter),
            (0, 3),
            "{back:?}"
        );
    }
    for order in &mut order {
        order.dedup();
    }
    // The clock of the first drive, from when it is set to the end; behind it ours, once that was seen, if it follows:
    // not behind a frame that did not come back in time.
    let [clock, time] = order;
    assert_eq!(clock, [NOP, FRMW]);
    let most = if run.leads { 1 } else { time.len() };
    assert!(time.len() == most && time[0] == NOP && time.contains(&FPWR) != run.leads, "{time:?}");
    // One master, with one piece of the logical address space for itself.
    let base = bases.first().copied().unwrap_or_default();
    assert_eq!((masters.len(), bases.len()), (1, 1));
    assert!(LOGICAL.contains(&base) && base.is_multiple_of(LOGICAL_EACH), "{base:#x}");
    base
}

/// Who has sent a frame, and which one it is.
fn of_mark(frame: &Frame) -> (u32, u32) {
    let half = |at: usize| u32::from_le_bytes(*frame.plain[0][at..].first_chunk().unwrap());
    (half(0), half(4))
}

/// Each slave step by step, and nothing else in any slot.
fn judge_slots(exchanges: &[Exchange], run: Run) {
    let mut slots: Vec<(Affair, Slot)> = Vec::new();
    for (sent, back) in exchanges.iter().filter_map(|(sent, back)| Some((sent, back.as_ref()?))) {
        if sent.datagrams.len() > FIXED {
            let (affair, slot) = slot(sent);
            let last = slots.iter().rev().find(|(of, _)| *of == affair);
            judge_counters(affair, last.is_some_and(|(_, last)| *last == slot), sent, back);
            slots.push((affair, slot));
        }
    }
    // One that was sent again is listed once.
    let of = |affair| {
        let mut own: Vec<&Slot> =
            slots.iter().filter(|(of, _)| *of == affair).map(|(_, slot)| slot).collect();
        own.dedup();
        own
    };
    // One latch, and the times and links of all slaves at it.
    let latches = [slot_of([(BWR, PORT_TIMES, 4)]), times_at_latch()];
    assert_eq!(of(Affair::Clock), latches.iter().collect::<Vec<_>>());
    let times = exchanges.iter().filter(|(sent, back)| back.is_some() && is_of_times(sent));
    let mut times: Vec<Address> = times.map(|(sent, _)| sent.datagrams[FIXED].address).collect();
    times.dedup();
    assert_eq!(times, [0, 0xFFFF, 0xFFFE].map(|place| Address::Slave(place, PORT_TIMES)));
    for station in [COUPLER, DRIVES[0], DRIVES[1]] {
        let mut own = of(Affair::Of(station));
        leave_out_corrections(&mut own);
        assert_eq!(own, steps(station).iter().collect::<Vec<_>>(), "{station:#x}");
        let shapes = run.mailbox_slots();
        let mut mailbox = of(Affair::Mailbox(station));
        assert_eq!(mailbox.is_empty(), station == COUPLER);
        mailbox.retain(|slot| !shapes.contains(slot));
        assert!(mailbox.is_empty(), "{station:#x}: {mailbox:?}");
    }
}

/// A clock that was set by a frame that left late is set again by the difference that is left, five times at most.
fn leave_out_corrections(own: &mut Vec<&Slot>) {
    let (set, difference) = (set(), difference());
    let is_correction = |four: &[&Slot]| four[..2] == four[2..] && *four[0] == set && *four[1] == difference;
    for corrections in 0.. {
        let Some(at) = own.windows(4).position(is_correction) else { return };
        assert!(corrections < 5, "{own:?}");
        own.drain(at..at + 2);
    }
}

/// What the slot of a frame requests, and whose affair that is: both datagrams are of one.
fn slot(sent: &Frame) -> (Affair, Slot) {
    let affair = |datagram: &Datagram| match datagram.address {
        Address::Slave(0, PORT_TIMES) if datagram.command == BWR => Affair::Clock,
        Address::Slave(place, _) if matches!(datagram.command, APRD | APWR) => {
            Affair::Of(COUPLER + (place.wrapping_neg() & 0xFFFF))
        }
        Address::Slave(station, MAILBOX_STATUS..=0x080F | MAILBOX_OUT..) => Affair::Mailbox(station),
        Address::Slave(station, _) if matches!(datagram.command, FPRD | FPWR) => Affair::Of(station),
        _ => panic!("{datagram:?}"),
    };
    let requested = |datagram: &Datagram| {
        let Address::Slave(_, register) = datagram.address else { panic!("{sent:?}") };
        (datagram.command, register, datagram.length, sent.state.filter(|_| register == AL_CONTROL))
    };
    let datagrams = &sent.datagrams[FIXED..];
    let slot: Slot = datagrams.iter().map(requested).collect();
    let affairs: Vec<Affair> = datagrams.iter().map(affair).collect();
    assert!(affairs.iter().all(|affair| *affair == affairs[0]), "{sent:?}");
    (if slot == times_at_latch() { Affair::Clock } else { affairs[0] }, slot)
}

/// Each is carried out by the slave it is for; the latch by all, for receive times a slave has without a clock too.
/// What is sent again, because its frame was late, may find AL control not read yet, or the EEPROM busy; and a mailbox
/// is not written while it is full, nor read while it is empty.
fn judge_counters(affair: Affair, is_repeated: bool, sent: &Frame, back: &Frame) {
    for datagram in &back.datagrams[FIXED..] {
        match datagram.working_counter {
            // Nobody had its address.
            0 if datagram.command == FPWR
                && matches!(datagram.address, Address::Slave(_, STATION | ALIAS)) => {}
            0 if is_repeated || matches!(affair, Affair::Mailbox(_)) => {}
            count => assert_eq!(count, if datagram.command == BWR { 3 } else { 1 }, "{sent:?} {back:?}"),
        }
    }
}

/// A slot in which no state is requested.
fn slot_of<const N: usize>(requested: [(u64, u64, u64); N]) -> Slot {
    requested.map(|(command, register, bytes)| (command, register, bytes, None)).to_vec()
}

/// The times of the ports of a slave at the latch, and which of them are open.
fn times_at_latch() -> Slot {
    slot_of([(APRD, PORT_TIMES, 16), (APRD, LINKS, 2)])
}

fn is_of_times(sent: &Frame) -> bool {
    sent.datagrams.len() > FIXED && slot(sent).1 == times_at_latch()
}

/// A change of state, and the look at what came of it.
fn change([read, write]: [u64; 2], state: u64) -> [Slot; 2] {
    [vec![(write, AL_CONTROL, 2, Some(state))], slot_of([(read, AL_STATUS, 6)])]
}

/// All that is requested of a slave but by its mailbox, from the first look at it to the end.
fn steps(station: u64) -> Vec<Slot> {
    let is_drive = station != COUPLER;
    let (place, own) = ([APRD, APWR], [FPRD, FPWR]);
    // Who it is: six entries; its categories up to the SyncManagers, and those.
    let sii = if is_drive { 6 + 4 + 2 * 4 } else { 6 + 4 + 2 * 2 };
    let mut steps = vec![
        // From the state that was requested of it on: another master may have.
        slot_of([(APRD, AL_CONTROL, 34), (APRD, 0x0000, 18)]),
        slot_of([(APWR, 0x0600, 128)]),
        // By force; to the master, and whether the slave has let it go; it is idle.
        slot_of([(APWR, SII_OWNER, 1)]),
        slot_of([(APWR, SII_OWNER, 1), (APRD, SII_OWNER, 2)]),
        slot_of([(APRD, SII, 14)]),
    ];
    for _ in 0..sii {
        steps.extend([slot_of([(APWR, SII, 6)]), slot_of([(APRD, SII, 14)])]);
    }
    // Given back, and the event mask.
    steps.push(slot_of([(APWR, SII_OWNER, 1), (APWR, 0x0200, 2)]));
    steps.extend(change(place, 1));
    // Ports and alias, a byte each; FMMUs and SyncManagers; SYNC0 and error counters; its address, taken from
    // whoever has it, and read back.
    let errors: Slot = match is_drive {
        true => slot_of([(APWR, 0x0981, 1), (APWR, 0x0300, 8)]),
        false => slot_of([(APWR, 0x0300, 8)]),
    };
    steps.extend([
        slot_of([(APWR, 0x0101, 1), (APWR, ALIAS, 1)]),
        slot_of([(APWR, 0x0600, 128), (APWR, 0x0800, 64)]),
        errors,
        slot_of([(FPWR, ALIAS, 1), (FPWR, STATION, 2)]),
        slot_of([(APWR, STATION, 2), (FPRD, STATION, 2)]),
    ]);
    if is_drive {
        steps.extend(clock(station));
    }
    let managers = if is_drive { [0x0810, 0x0818] } else { [0x0800, 0x0808] };
    if is_drive {
        steps.push(slot_of([(FPWR, 0x0800, 8), (FPWR, 0x0808, 8)]));
    }
    steps.extend(change(own, 2));
    // Watchdog, as configured, or as the SII of the coupler arms it, and SyncManagers: written, and read back; FMMUs.
    for command in [FPWR, FPRD] {
        steps.push(slot_of([(command, 0x0400, 2), (command, 0x0420, 2)]));
    }
    for command in [FPWR, FPRD] {
        steps.push(slot_of(managers.map(|manager| (command, manager, 8))));
    }
    steps.push(slot_of([(FPWR, 0x0600, 48)]));
    if is_drive {
        // Off before its start is set.
        steps.push(slot_of([(FPWR, 0x0981, 1), (FPRD, TIME, 8)]));
        steps.push(slot_of([(FPWR, 0x0990, 8), (FPWR, 0x09A0, 8)]));
        steps.push(slot_of([(FPWR, 0x0980, 2)]));
    }
    steps.extend(change(own, 4));
    if is_drive {
        steps.push(difference());
    }
    for state in [8, 1] {
        steps.extend(change(own, state));
    }
    steps
}

/// How far its clock is from the reference's.
fn difference() -> Slot {
    slot_of([(FPRD, 0x092C, 4)])
}

/// Offset and delay of its clock.
fn set() -> Slot {
    slot_of([(FPWR, OFFSET, 12), (FPWR, 0x0930, 2)])
}

/// The clock of a drive: its time and offset are read, and set; what is left is read of one that follows another.
fn clock(station: u64) -> Vec<Slot> {
    let read = slot_of([(FPRD, TIME, 24), (FPWR, 0x0934, 2)]);
    let mut steps = vec![read, set(), difference()];
    if station == DRIVES[0] {
        steps.pop();
    }
    steps
}

/// Which memory of each slave stands where in the logical address space, as the dissector reads its FMMUs: outputs,
/// inputs, AL status.
fn judge_fmmus(file: &Path, run: Run, base: u64) {
    let reported = capture::dissect(
        file,
        "ecat.fmmu.activate == 1 && ecat.cnt == 1",
        &[],
        &["ecat.adp", "ecat.fmmu.lstart", "ecat.fmmu.llen", "ecat.fmmu.pstart", "ecat.fmmu.type"],
    );
    let reported: BTreeSet<&str> = reported
        .iter()
        .map(|line| {
            let station = line.find('|').unwrap() - "0x1001".len();
            &line[station..]
        })
        .collect();
    let (inputs, _) = run.inputs();
    let line = |place: usize, outputs: [usize; 3], inputs: [usize; 3]| {
        let (station, logical) = (COUPLER as usize + place, base as usize);
        let [out, out_length, out_start] = outputs;
        let [al, in_length, in_start] = inputs;
        let (out, al, input) = (logical + out, logical + OUTPUTS + al, logical + OUTPUTS + al + 2);
        format!(
            "{station:#06x}|{out:#010x},{input:#010x},{al:#010x}|{out_length:#06x},{in_length:#06x},0x0002|\
             {out_start:#06x},{in_start:#06x},0x0130|0x02,0x01,0x01"
        )
    };
    let lines = [
        line(0, [0, 1, 0x1000], [0, 1, 0x1100]),
        line(1, [1, 6, 0x1100], [3, inputs, 0x1140]),
        line(2, [1 + 6, 6, 0x1100], [3 + 2 + inputs, inputs, 0x1140]),
    ];
    assert_eq!(reported, lines.iter().map(String::as_str).collect());
}

/// From the last slave in OP to the first one that is taken down.
fn judge_cycles(exchanges: &[Exchange], run: Run) {
    let requests = |(sent, _): &Exchange, state| sent.state == Some(state);
    let begin = exchanges.iter().rposition(|exchange| requests(exchange, OP.into())).unwrap();
    let end = begin + exchanges[begin..].iter().position(|exchange| requests(exchange, 1)).unwrap();
    let (inputs, status) = run.inputs();
    let mut words = [Vec::new(), Vec::new()];
    for (sent, back) in &exchanges[begin + 1..end] {
        let back = back.as_ref().unwrap_or_else(|| panic!("it did not come back: {sent:?}"));
        let counters = [1, 3].map(|n: usize| back.datagrams[n].working_counter);
        // Both clocks; three of each slave.
        assert_eq!(counters, [2, 9], "{back:?}");
        let [out, image] = [sent, back].map(|frame| {
            let of_image = |data: &&Vec<u8>| data.len() == run.image();
            frame.plain.iter().find(of_image).unwrap_or_else(|| panic!("{frame:?}"))
        });
        assert_eq!(image[..OUTPUTS], out[..OUTPUTS]);
        assert!(out[OUTPUTS..].iter().all(|byte| *byte == 0), "inputs leave as zeros: {sent:?}");
        let word = |at: usize| u16::from_le_bytes([image[at], image[at + 1]]);
        for (n, words) in words.iter_mut().enumerate() {
            let al = OUTPUTS + 3 + n * (2 + inputs);
            if word(al) == OP {
                words.push(word(al + 2 + status) & 0x6F);
            }
        }
    }
    assert!(end - begin > 200, "{}", end - begin);
    for words in &mut words {
        words.dedup();
        assert_eq!(words[..], [0x40, 0x21, 0x23, 0x27, 0x40]);
    }
}

/// What the mailboxes of the drives were sent, and what they held.
fn judge_mailboxes(exchanges: &[Exchange], run: Run) {
    let (inputs, mode) = match run.family {
        Family::S700 => (0x1B03, 0x80),
        Family::Akd => (0x1B24, 3),
    };
    let start_up = [
        // 2 ms.
        ((0x60C2, 1), 2),
        ((0x60C2, 2), 0xFD),
        ((0x1C12, 0), 0),
        ((0x1C12, 1), 0x1702),
        ((0x1C12, 0), 1),
        ((0x1C13, 0), 0),
        ((0x1C13, 1), inputs),
        ((0x1C13, 0), 1),
        ((0x6060, 0), mode),
    ];
    for station in DRIVES {
        let requests = messages(exchanges, FPWR, station, REQUEST);
        let responses = messages(exchanges, FPRD, station, RESPONSE);
        let mut requested: Vec<_> = requests
            .iter()
            .map(|request| (request.command, request.object.unwrap(), request.data))
            .filter(|(_, object, _)| *object != SETTLES)
            .collect();
        // A request whose answer was late is sent again.
        requested.dedup();
        let written = requested.iter().filter(|(command, ..)| *command == DOWNLOAD);
        let written: Vec<_> = written.map(|(_, object, data)| (*object, data.unwrap())).collect();
        assert_eq!(written, start_up, "{station:#x}");
        // The last one may be under way as the drive is taken down.
        assert!((responses.len()..=responses.len() + 1).contains(&requests.len()));
        for (request, response) in requests.iter().zip(&responses) {
            assert_eq!(request.counter, response.counter, "{request:?} {response:?}");
            let reported = (response.command, response.object, response.data);
            match (request.command, request.object) {
                (DOWNLOAD, object) => assert_eq!(reported, (DOWNLOADED, object, None)),
                (UPLOAD, Some((0x5FFF, 1))) => assert_eq!(reported, (ABORT, None, None)),
                (UPLOAD, object @ Some((0x1018, 1))) => assert_eq!(reported, (UPLOADED, object, Some(0x6A))),
                (UPLOAD, object) => assert_eq!((reported.0, reported.1), (UPLOADED, object)),
                _ => panic!("{request:?}"),
            }
        }
        // How it counts a turn, as it starts; its mode and whether it has its reference, as it is up; and what the
        // application requests.
        let uploads = requested.iter().filter(|(command, ..)| *command == UPLOAD);
        let requested: BTreeSet<_> = uploads.clone().map(|(_, object, _)| *object).collect();
        let once = [(0x608F, 1), (0x608F, 2), (0x6061, 0), (0x1002, 0), (0x1018, 1), (0x5FFF, 1)];
        assert_eq!((requested, uploads.count()), (once.into(), once.len()), "{station:#x}");
    }
}

/// The messages that went into a mailbox of a drive or out of it; one that was sent again is listed once.
fn messages(exchanges: &[Exchange], command: u64, station: u64, service: u64) -> Vec<Message> {
    let carries = |frame: &&Frame| {
        frame.datagrams[FIXED..].iter().any(|datagram| {
            let is_mailbox = matches!(datagram.address, Address::Slave(to, MAILBOX_OUT..) if to == station);
            is_mailbox && datagram.command == command && datagram.working_counter == 1
        })
    };
    let frames = exchanges.iter().filter_map(|(_, back)| back.as_ref()).filter(carries);
    let mut messages: Vec<_> = frames.flat_map(|frame| frame.messages.clone()).collect();
    let is_right =
        |message: &Message| message.service == if message.command == ABORT { REQUEST } else { service };
    assert!(messages.iter().all(is_right), "{messages:?}");
    messages.dedup();
    messages
}

#[test]
#[ignore = "needs root, iproute2 and tshark"]
fn tshark_finds_nothing_wrong_with_our_master_at_work() {
    let s700 = Run { family: Family::S700, short_clocks: false, leads: true };
    works_a_segment(36, s700);
    works_a_segment(37, Run { short_clocks: true, ..s700 });
    // Their clocks follow ours.
    works_a_segment(38, Run { family: Family::Akd, leads: false, ..s700 });
}
