//! A station, and a drive of a few lines that says what it is made to say.

use std::net::Ipv4Addr;

use super::*;
use crate::StreamCommand;
use crate::plan::Serial;
use crate::profile::capabilities;
use crate::upid::Upid;
use crate::wire::RtcCommand;
use crate::wire::{MainState, Response, StateVar, StatusWord};
use fieldbeat_core::axis::{Command, Row};
use fieldbeat_core::drive::machine::{Machine, NumberedRow};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::time::MS;

/// A station, and a drive of a few lines that says what it is made to say.
struct Bench {
    station: Station,
    machine: Machine,
    slot: Slot,
    cycle: Cycle,
    request: Request,
}

impl Bench {
    fn new(drive: &LinUdpDrive) -> Bench {
        let (station, ..) = Station::new(drive, &InputLog::default());
        let cycle = Cycle { index: 0, grid: Time(MS), period_ns: MS, deadline: Time(MS + MS / 2) };
        let machine = Machine::new(&drive.axis, capabilities(drive), MS);
        let slot = Slot { due: true, link: Link::Online, ..Slot::default() };
        Bench { station, machine, slot, cycle, request: Request::default() }
    }

    /// A drive that is in operation, and is to follow a row with this position next.
    fn following(position: f64) -> Bench {
        let mut b = Bench::new(&LinUdpDrive::new("x", Ipv4Addr::LOCALHOST));
        for _ in 0..4 {
            let request = b.send();
            b.reply(&request, StateVar::MOTION_ACTIVE | 5);
            // It is left as it is.
            b.start(Command::Reset);
        }
        b.start(Command::Follow);
        b.machine.input.row = Some(NumberedRow { number: 1, row: Row { position, ..Row::default() } });
        b
    }

    /// The next request is built.
    fn build(&mut self) -> Request {
        let mut out = [0; 64];
        self.cycle = Cycle { grid: self.cycle.grid + MS, deadline: self.cycle.deadline + MS, ..self.cycle };
        self.machine.observe(self.cycle.grid, false, &self.slot);
        self.slot.notices.fresh = false;
        self.machine.propose(self.cycle.grid, &mut self.slot);
        let length = self.station.prepare(&self.cycle, &mut self.slot, &mut out);
        Request::parse(&out[..length]).unwrap()
    }

    /// The next request goes out.
    fn send(&mut self) -> Request {
        self.request = self.build();
        self.station.owe(&mut self.slot);
        self.station.sent(self.cycle.grid, &self.cycle, &mut self.slot);
        self.machine.commit(self.cycle.grid);
        self.request
    }

    /// A reply to `request` comes in the window, from a drive in operation with this sub state.
    fn reply(&mut self, request: &Request, sub: u8) {
        let (mut bytes, fields) = ([0; 64], StateVar::new(MainState::OPERATION_ENABLED, sub));
        let response = Response {
            request_def: request.definition(),
            response_def: request.response_def,
            status: Some(StatusWord(0x0037)),
            state: Some(fields),
            config: request.config.map(|block| RtcBlock::answer(block.count(), 0)),
            ..Response::default()
        };
        let size = response.emit(&mut bytes);
        self.station.take(self.cycle.grid + MS / 10, &bytes[..size], true, &mut self.slot);
    }

    fn start(&mut self, command: Command) {
        self.machine.start(self.cycle.grid, Some(command));
    }
}

#[test]
fn a_reply_that_is_up_to_seven_exchanges_late_is_never_the_newest() {
    for (monitor, turns) in [(MonitorPlan::Off, 8), (MonitorPlan::AsSet, 4)] {
        let mut b = Bench::new(&LinUdpDrive { monitor, ..LinUdpDrive::new("x", Ipv4Addr::LOCALHOST) });
        let mut before = Vec::new();
        for exchange in 0..100 {
            let request = b.send();
            for late in before.iter().rev().take(turns - 1) {
                b.reply(late, 9);
                assert!(matches!(b.slot.exchange, Exchange::Owed { .. }), "exchange {exchange}");
            }
            b.reply(&request, 1);
            assert!(matches!(b.slot.exchange, Exchange::Answered { suspect: false, .. }));
            before.push(request);
        }
        assert_eq!((b.slot.counters.late, b.slot.counters.foreign, b.slot.counters.suspect), (0, 0, 0));
    }
}

/// The drive, or this computer, stands still for so many exchanges, and all of their replies come at once.
#[test]
fn each_reply_that_was_held_up_is_late_once_and_its_copy_a_duplicate() {
    for (monitor, tag) in [
        (MonitorPlan::Off, ReplyTag::Definition),
        (MonitorPlan::AsSet, ReplyTag::Definition),
        (MonitorPlan::Off, ReplyTag::Count),
    ] {
        for held in 1..=12 {
            let (reply_within, reply_tag) = (Some(1), tag);
            let drive = LinUdpDrive::new("x", Ipv4Addr::LOCALHOST);
            let mut b = Bench::new(&LinUdpDrive { monitor, reply_within, reply_tag, ..drive });
            for _ in 0..20 {
                let request = b.send();
                b.reply(&request, 1);
            }
            let held_up = |b: &mut Bench| {
                let request = b.send();
                // As the loop judges it.
                b.slot.exchange = Exchange::Missed;
                request
            };
            let requests: Vec<Request> = (0..held).map(|_| held_up(&mut b)).collect();
            let last = b.send();
            b.reply(&last, 1);
            let what = format!("{held} of {monitor:?}, {tag:?}");
            let counted = |b: &Bench| (b.slot.counters.late, b.slot.counters.duplicate);
            for (n, request) in requests.iter().enumerate() {
                b.reply(request, 1);
                assert_eq!(counted(&b), (n as u64 + 1, 0), "{what}");
            }
            requests.iter().rev().take(3).for_each(|request| b.reply(request, 1));
            assert_eq!(counted(&b), (held, held.min(3)), "{what}");
        }
    }
}

#[test]
fn a_stop_is_done_by_two_replies_with_its_own_count_and_by_no_others() {
    let mut b = Bench::new(&LinUdpDrive::new("x", Ipv4Addr::LOCALHOST));
    // In motion, by a command whose count is 5.
    for _ in 0..4 {
        let request = b.send();
        b.reply(&request, StateVar::MOTION_ACTIVE | 5);
    }
    b.start(Command::Stop { deceleration: None });
    let mut request = b.send();
    let stop = request.motion.unwrap().header as u8 & 0xF;
    assert_eq!(stop, 6);
    let standing = |count: u8| (count, None);
    let moving = |count: u8| (StateVar::MOTION_ACTIVE | count, None);
    // What the drive says, and the count of the next request. Replies of before the motion, in all respects like
    // the newest; then its own echo; then somebody else's command has run.
    for ((sub, end), count) in [
        (standing(4), Some(6)),
        (moving(5), Some(6)),
        (standing(4), Some(6)),
        (standing(6), None),
        (moving(5), Some(6)),
        (moving(6), None),
        (moving(6), None),
        (standing(6), None),
        ((6, Some(Ok(()))), None),
    ] {
        b.reply(&request, sub);
        request = b.send();
        assert_eq!(request.motion.map(|motion| motion.header as u8 & 0xF), count, "after {sub:02X}h");
        assert_eq!(b.machine.end(), end, "after {sub:02X}h");
    }
}

/// Other masters truncate: 0.57 mm became 5699 (LinUDP sheet, 7.2).
#[test]
fn a_position_is_rounded_to_the_nearest_count() {
    let mut b = Bench::following(0.57);
    assert_eq!(b.send().motion.unwrap().parameters[..4], 5_700_i32.to_le_bytes());
}

#[test]
fn a_stop_in_place_of_a_stream_that_never_left_is_a_stop() {
    let mut b = Bench::following(1.0);
    let sent = |request: Request| request.motion.map(|motion| motion.header >> 4);
    assert_eq!(sent(b.build()), Some(StreamCommand::Pva.id()));
    b.start(Command::Stop { deceleration: None });
    for _ in 0..3 {
        let request = b.send();
        assert_eq!(sent(request), Some(0x017), "{request:?}");
        b.reply(&request, StateVar::MOTION_ACTIVE | 5);
    }
}

#[test]
fn every_fourth_probe_that_goes_out_has_all_blocks() {
    let (mut station, ..) = Station::new(&LinUdpDrive::new("x", Ipv4Addr::LOCALHOST), &InputLog::default());
    let (mut slot, mut out) = (Slot::default(), [0; 64]);
    let cycle = Cycle { index: 0, grid: Time(0), period_ns: 1_000_000, deadline: Time(500_000) };
    for probe in 1..=12 {
        // Slots that are passed over do not count.
        for _ in 0..probe {
            let length = station.prepare(&cycle, &mut slot, &mut out);
            let request = Request::parse(&out[..length]).unwrap();
            assert_eq!(request.motion.is_some() && request.config.is_some(), probe % 4 == 0, "{probe}");
        }
        station.sent(Time(0), &cycle, &mut slot);
    }
}

/// A drive may have been exchanged whenever its link was down.
#[test]
fn a_reply_counts_once_the_drive_has_said_its_serial_number_and_after_each_loss_anew() {
    let serial = Serial { from: Upid(0x66), number: Some(7) };
    let mut b =
        Bench::new(&LinUdpDrive { serial: Some(serial), ..LinUdpDrive::new("x", Ipv4Addr::LOCALHOST) });
    // The link, the number of the drive, whether it is read, and whether the next reply counts.
    for (link, number, is_read, counts) in [
        (Link::Unseen, 8, true, false),
        (Link::Unseen, 7, true, true),
        (Link::Unseen, 7, false, true),
        (Link::Online, 8, false, true),
        (Link::Lost, 8, true, false),
        (Link::Lost, 8, true, false),
        (Link::Lost, 7, true, true),
        (Link::Qualifying, 7, false, true),
        (Link::Online, 7, false, true),
    ] {
        b.slot.link = link;
        let request = b.send();
        let reads = |block: &RtcBlock| block.code == RtcCommand::READ_RAM.0 && block.index() == 0x66;
        assert_eq!(request.config.as_ref().is_some_and(reads), is_read, "{link:?} {number}");
        let mut bytes = [0; 64];
        let answer = |block: RtcBlock| RtcBlock { code: 0, words: [0x66, number, 0], ..block };
        let response = Response {
            request_def: request.definition(),
            response_def: request.response_def,
            status: Some(StatusWord(0x0037)),
            state: Some(StateVar::new(MainState::OPERATION_ENABLED, 0)),
            config: request.config.map(answer),
            ..Response::default()
        };
        let size = response.emit(&mut bytes);
        b.station.take(b.cycle.grid + MS / 10, &bytes[..size], true, &mut b.slot);
        let is_answered = matches!(b.slot.exchange, Exchange::Answered { .. });
        assert_eq!((is_answered, b.station.who.is_known()), (!is_read, counts), "{link:?} {number}");
    }
    let note = b.station.serial_note();
    assert_eq!(note.get(0).text(serial), None);
    // A link that stays down, and a probe that was not answered.
    b.slot.link = Link::Lost;
    for is_known in [false, false] {
        b.send();
        assert_eq!(b.station.who.is_known(), is_known);
    }
}
