//! The channel alone, against a drive of a few lines that answers as it is set up.

use std::sync::Arc;
use std::time::Duration;

use super::*;
use crate::notation::Upids;
use crate::upid::{call, commanding};
use fieldbeat_core::axis::acyclic::{Acyclic, Call, CallTicket, queue};
use fieldbeat_core::axis::cell;
use fieldbeat_core::axis::{Feedback, Observer};
use fieldbeat_core::rt::Wires;

const READ: Call = call(RtcCommand::READ_RAM, 0x20A8, 0);

struct Bench {
    channel: RtcChannel,
    acyclic: Acyclic,
    now: Time,
    link: Link,
    powered: bool,
    guarded: bool,
}

impl Bench {
    fn new() -> Bench {
        Bench::monitoring([None; 4])
    }

    fn monitoring(sources: [Option<Upid>; 4]) -> Bench {
        let (ends, port) = queue(8, commanding());
        let (_, reader) = cell::cell(Feedback::default());
        let acyclic = Acyclic::new(
            "x",
            ends,
            Arc::new(Upids),
            Observer::new(reader, Wires::default()),
            Duration::from_millis(1),
        );
        Bench {
            channel: RtcChannel::new(port, sources, 1),
            acyclic,
            now: Time(S),
            link: Link::Online,
            powered: false,
            guarded: false,
        }
    }

    fn post(&self, call: Call) -> CallTicket {
        self.acyclic.post(call, Duration::from_secs(1)).unwrap()
    }

    /// One exchange: gives the block that went out, and takes what `answer` makes of it.
    fn turn(&mut self, answer: impl FnOnce(RtcBlock) -> Option<RtcBlock>) -> Option<RtcBlock> {
        self.now = self.now + MS;
        let block = self.channel.advance(self.now, self.link, self.powered, self.guarded);
        assert_eq!(
            self.channel.advance(self.now, self.link, self.powered, self.guarded),
            block,
            "the same until it was sent"
        );
        self.channel.sent();
        if let Some(answer) = block.and_then(answer) {
            self.channel.take(answer, false);
        }
        block
    }

    /// One whose channel knows the drive's count.
    fn learned() -> Bench {
        let mut b = Bench::new();
        b.learn();
        b
    }

    /// The drive does everything at once.
    fn learn(&mut self) {
        let ticket = self.post(call(RtcCommand::NO_OPERATION, 0, 0));
        for _ in 0..2 {
            self.turn(done);
        }
        drop(ticket);
    }
}

fn done(block: RtcBlock) -> Option<RtcBlock> {
    Some(RtcBlock { code: RtcStatus::DONE, ..block })
}

fn status(code: u8) -> impl Fn(RtcBlock) -> Option<RtcBlock> {
    move |block| Some(RtcBlock { code, ..block })
}

#[test]
fn busy_is_waited_for_and_an_answer_of_another_index_is_not_ours() {
    let mut b = Bench::learned();
    let mut ticket = b.post(READ);
    let mut counts = Vec::new();
    for code in [RtcStatus::RUNNING, RtcStatus::BUSY, RtcStatus::RUNNING] {
        counts.extend(b.turn(status(code)).map(|block| block.count()));
    }
    let other =
        |block: RtcBlock| Some(RtcBlock { words: [0x20A9, 1, 1], ..RtcBlock::answer(block.count(), 0) });
    counts.extend(b.turn(other).map(|block| block.count()));
    assert_eq!(ticket.poll(), None);
    counts.extend(b.turn(done).map(|block| block.count()));
    assert!(counts.windows(2).all(|pair| pair[0] == pair[1]), "one command, one count: {counts:?}");
    assert!(ticket.poll().unwrap().is_ok());
}

#[test]
fn a_write_that_commands_the_drive_is_checked_until_its_block_has_gone_out() {
    let run_mode = call(RtcCommand::WRITE_RAM, 0x1450, 1);
    let mut b = Bench::new();
    let mut ticket = b.post(run_mode);
    // The count is learned first. Meanwhile power comes on.
    assert_eq!(b.turn(|_| None).map(|block| block.code), Some(RtcCommand::NO_OPERATION.0));
    assert!(b.channel.commands());
    b.guarded = true;
    assert_eq!(b.turn(done), None);
    assert_eq!(ticket.poll(), Some(Err(CallError::Commands)));
    assert!(!b.channel.commands(), "nothing of it was sent");
    // What has gone out goes on, and is known to be under way.
    b.guarded = false;
    b.learn();
    let mut ticket = b.post(run_mode);
    b.turn(status(RtcStatus::BUSY));
    b.guarded = true;
    assert_eq!(b.turn(status(RtcStatus::BUSY)).map(|block| block.code), Some(RtcCommand::WRITE_RAM.0));
    assert!(b.channel.commands());
    b.turn(done);
    assert!(ticket.poll().unwrap().is_ok() && !b.channel.commands());
    // The station's own calls are exempt, and so is what is harmless.
    let mut monitor = b.post(call(RtcCommand::WRITE_RAM, 0x20A8, 0x1E0F));
    b.turn(done);
    assert!(monitor.poll().unwrap().is_ok());
}

#[test]
fn a_write_without_waiter_is_under_way_until_the_drive_has_stored_a_later_command() {
    let mut b = Bench::learned();
    let ticket = b.post(call(RtcCommand::WRITE_RAM, 0x1450, 1));
    let sent = b.turn(status(RtcStatus::BUSY)).unwrap();
    drop(ticket);
    for _ in 0..10 {
        let block = b.turn(|_| Some(RtcBlock::answer(sent.count(), RtcStatus::BUSY))).unwrap();
        assert_eq!(block.code, RtcCommand::NO_OPERATION.0);
        assert!(b.channel.commands());
    }
    b.turn(|_| None);
    assert_eq!(b.turn(|_| None), None, "nothing is said into a silence");
    b.channel.take_none(false);
    b.turn(done);
    assert_eq!(b.turn(done), None, "nothing more is to be found out");
    assert!(!b.channel.commands());
}

#[test]
fn a_save_is_sent_once_before_a_silence_and_its_result_read_by_its_count_after_it() {
    let saving = || {
        let b = Bench::learned();
        let save = call(RtcCommand::SAVE_CURVES, 0, 0);
        let ticket = b.acyclic.post(save, Duration::from_secs(180)).unwrap();
        (b, ticket)
    };
    // A drive that stores the count says busy, then done.
    let (mut b, mut ticket) = saving();
    let sent = b.turn(|_| None).unwrap();
    assert_eq!(sent.code, RtcCommand::SAVE_CURVES.0);
    for _ in 0..4 {
        assert_eq!(b.turn(|_| None), None, "nothing is said into a silence");
    }
    b.link = Link::Lost;
    let requested = RtcBlock::call(sent.count(), RtcCommand::READ_RAM, 0x20A8, 0);
    for _ in 0..100 {
        assert_eq!(b.turn(|_| None), Some(requested));
    }
    b.link = Link::Qualifying;
    b.turn(|block| Some(RtcBlock::answer(block.count(), RtcStatus::BUSY)));
    assert_eq!(ticket.poll(), None);
    b.turn(|block| Some(RtcBlock::answer(block.count(), RtcStatus::DONE)));
    assert_eq!(ticket.poll().unwrap().unwrap().status, 0);
    assert!(!b.channel.expects_silence());

    // One that does not store it, does what is requested now.
    let (mut b, mut ticket) = saving();
    b.turn(|_| None);
    b.link = Link::Lost;
    b.turn(|_| None);
    b.turn(done);
    assert_eq!(ticket.poll().unwrap().unwrap().status, UNACKNOWLEDGED);

    // A request that was lost goes out again, under the same count, however long the drive says that it has another
    // one.
    let (mut b, mut ticket) = saving();
    let sent = b.turn(|_| None);
    assert_eq!(b.turn(|_| None), None);
    b.channel.take_none(false);
    for _ in 0..1_000 {
        assert_eq!(b.turn(|_| Some(RtcBlock::answer(2, RtcStatus::DONE))), sent);
    }
    b.turn(done);
    assert_eq!(ticket.poll().unwrap().unwrap().status, 0);
}

#[test]
fn calls_that_stop_or_delay_a_drive_are_refused_while_its_power_is_on() {
    let mut b = Bench::learned();
    b.powered = true;
    for command in [
        RtcCommand::RESTART,
        RtcCommand::STOP_SOFTWARE,
        RtcCommand::DEFAULT_MC,
        RtcCommand::SAVE_CURVES,
        RtcCommand::SAVE_TABLE,
        RtcCommand::WRITE_ROM,
        RtcCommand::WRITE_BOTH,
    ] {
        let mut ticket = b.post(call(command, 0, 0));
        assert_eq!(b.turn(done), None, "{command}");
        assert_eq!(ticket.poll(), Some(Err(CallError::Powered)), "{command}");
    }
    let mut ticket = b.post(READ);
    b.turn(done);
    assert!(ticket.poll().unwrap().is_ok());
}

#[test]
fn a_drive_without_monitor_answer_delays_no_other_drive() {
    let mut b = Bench::monitoring([Some(Upid(0x1E0F)), None, None, None]);
    let mut tickets: Vec<_> = (0..6).map(|_| b.post(READ)).collect();
    // It never answers for the monitoring channels.
    let deaf = |block: RtcBlock| match (RtcCommand(block.code), block.index()) {
        (RtcCommand::READ_RAM, 0x20A8) if block.value() == 0 && block.count().is_multiple_of(2) => None,
        _ => Some(RtcBlock { code: RtcStatus::BUSY, ..block }),
    };
    let mut ended = 0;
    for _ in 0..20_000 {
        b.turn(deaf);
        ended += tickets.iter_mut().filter_map(CallTicket::poll).count();
    }
    assert_eq!(ended, 6, "each in its own time");
    assert_eq!(b.channel.take_monitor_refusal(), Some((0, 0)), "given up, and reported");
}

#[test]
fn stopped_software_is_no_restart_but_running_again_by_itself_is() {
    let mut b = Bench::learned();
    let mut stop = b.post(call(RtcCommand::STOP_SOFTWARE, 0, 0));
    b.turn(done);
    b.channel.drive_restarted();
    assert!(stop.poll().unwrap().is_ok());
    let mut read = b.post(READ);
    assert_eq!(b.turn(status(RtcStatus::BUSY)).map(|block| block.count()), Some(4), "still in step");
    // Somebody has switched it off and on.
    b.channel.software_runs();
    assert_eq!(read.poll(), Some(Err(CallError::Restarted)));

    b.learn();
    let stop = b.post(call(RtcCommand::STOP_SOFTWARE, 0, 0));
    let mut start = b.post(call(RtcCommand::START_SOFTWARE, 0, 0));
    b.turn(done);
    b.channel.drive_restarted();
    b.turn(status(RtcStatus::BUSY));
    b.channel.software_runs();
    b.turn(done);
    assert!(start.poll().unwrap().is_ok());
    drop(stop);
}

#[test]
fn a_block_that_the_drive_has_forgotten_does_not_go_on() {
    let mut b = Bench::learned();
    let mut start = b.post(call(RtcCommand::ADD_CURVE, 5, 70));
    b.turn(done);
    assert!(start.poll().unwrap().is_ok());
    b.channel.drive_restarted();
    let mut data = b.post(call(RtcCommand::ADD_CURVE_DATA, 5, 1));
    assert_eq!(b.turn(done), None);
    assert_eq!(data.poll(), Some(Err(CallError::Restarted)));
    // Begun anew, it does.
    let mut again =
        [b.post(call(RtcCommand::ADD_CURVE, 5, 70)), b.post(call(RtcCommand::ADD_CURVE_DATA, 5, 1))];
    for _ in 0..3 {
        b.turn(done);
    }
    assert!(again.iter_mut().all(|ticket| ticket.poll().unwrap().is_ok()));
}

#[test]
fn monitor_sources_are_looked_at_written_where_they_differ_and_set_again_after_a_restart() {
    let mut b = Bench::monitoring([Some(Upid(0x1E0F)), None, Some(Upid(0x1BCD)), Some(Upid(0x9999))]);
    let mut set = [0x1E0F_u16, 1, 2, 3];
    let mut drive = |block: RtcBlock| {
        let place = usize::from(block.index().wrapping_sub(0x20A8));
        match RtcCommand(block.code) {
            RtcCommand::WRITE_RAM if block.value() == 0x9999 => {
                return Some(RtcBlock::answer(block.count(), 0xC2));
            }
            RtcCommand::WRITE_RAM => set[place] = block.value() as u16,
            _ => {}
        }
        let value = set.get(place).copied().unwrap_or_default();
        Some(RtcBlock { words: [block.index(), value, 0], ..RtcBlock::answer(block.count(), 0) })
    };
    let mut commands = Vec::new();
    for _ in 0..8 {
        commands.extend(b.turn(&mut drive).map(|block| (block.code, block.index())));
    }
    assert_eq!(
        commands,
        [(0, 0), (0x11, 0x20A8), (0x11, 0x20AA), (0x13, 0x20AA), (0x11, 0x20AB), (0x13, 0x20AB)]
    );
    assert_eq!([0, 1, 2, 3].map(|channel| b.channel.monitors(channel)), [true, false, true, false]);
    assert_eq!(b.channel.take_monitor_refusal(), Some((3, 0xC2)));
    assert_eq!(b.channel.take_monitor_refusal(), None);
    b.channel.drive_restarted();
    assert!(!b.channel.monitors(0));
    for _ in 0..8 {
        b.turn(&mut drive);
    }
    assert!(b.channel.monitors(0) && b.channel.monitors(2));
}
