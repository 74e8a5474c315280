//! An order ends as done only when the drive did it, whatever comes late: LinUDP has no sequence number, and a reply
//! that comes once more, many cycles late and without a missed exchange, may look like the newest one in every way.

use fieldbeat::axis::{Command, EventKind, Failure, Outcome, StopCause};
use fieldbeat::bus::linudp::{ControlWord, ErrorCode, MonitorPlan, ReplyTag};
use fieldbeat::time::{MS, US};
use fieldbeat_linudp::wire::Response;

use crate::virtual_time::support::*;

/// The reply to the request of so many cycles before the next one comes once more, in the window of the next one and
/// before its own reply.
fn repeat(b: &Bench, cycles: usize) {
    let reply: Response = {
        let tape = b.tape(0);
        tape.received[tape.received.len() - cycles].reply.expect("the drive answers everything")
    };
    b.inject_reply(0, reply, b.grid() + MS + 10 * US);
}

fn demand(b: &Bench) -> f64 {
    f64::from(b.tape(0).last().demand.unwrap()) / PER_MM
}

fn moves(b: &Bench) -> bool {
    let last = b.tape(0).last();
    last.state.unwrap().motion_active().unwrap_or(last.status.unwrap().motion_active())
}

/// Every kind of tag, with the monitoring channels shown or not: what the tags leave to the counts.
fn rigs() -> Vec<Rig> {
    let tags = ReplyTag::WORDS.map(|(_, tag)| tag);
    let plans = tags.into_iter().flat_map(|tag| [(tag, MonitorPlan::Off), (tag, MonitorPlan::AsSet)]);
    let rig =
        |(tag, monitor)| Rig::new(1).each(move |_, drive| (drive.reply_tag, drive.monitor) = (tag, monitor));
    [Rig::new(1)].into_iter().chain(plans.map(rig)).collect()
}

#[test]
fn no_command_ends_early_or_is_lost_when_any_reply_is_repeated() {
    let mut random = fastrand::Rng::with_seed(17);
    for (n, rig) in rigs().into_iter().enumerate() {
        let mut b = rig.ready();
        for trial in 0..150 {
            let what = format!("rig {n}, trial {trial}");
            let (near, far) = (random.f64() * 50.0, 100.0 + random.f64() * 90.0);
            // As late as comes, at any time around the command; twice in one of three.
            let mut doubles: Vec<(u64, usize)> =
                (0..1 + random.u8(..3) / 2).map(|_| (random.u64(..6), random.usize(1..=40))).collect();
            let mut step = |b: &mut Bench, now: u64| {
                if let Some(place) = doubles.iter().position(|(at, _)| *at == now) {
                    let (_, cycles) = doubles.swap_remove(place);
                    repeat(b, cycles);
                }
                b.step();
            };
            let posted = random.u64(..6);
            match random.u8(..4) {
                0 => {
                    b.run(random.u64(..4));
                    let from = demand(&b);
                    let mut id = None;
                    for now in 0..6 {
                        if now == posted {
                            id = Some(b.post(0, to(near)));
                        }
                        step(&mut b, now);
                    }
                    match b.ended(0, id.unwrap()) {
                        Outcome::Done => assert_near(demand(&b), near, 1e-4),
                        // The old reply may show the quick stop of before: then nothing begins.
                        Outcome::Failed(Failure::WrongState(_)) => assert_eq!(demand(&b), from, "{what}"),
                        other => panic!("{what}: {other}"),
                    }
                    assert!(!moves(&b), "{what}: done in mid-motion");
                }
                kind => {
                    let command =
                        if kind == 3 { Command::QuickStop } else { Command::Stop { deceleration: None } };
                    b.post(0, slowly_to(far));
                    b.run(1 + random.u64(..50));
                    let (mut id, mut begun) = (None, 0.0);
                    for now in 0..6 {
                        if now == posted {
                            (id, begun) = (Some(b.post(0, command)), demand(&b));
                        }
                        step(&mut b, now);
                    }
                    assert_eq!(b.ended(0, id.unwrap()), Outcome::Done, "{what}");
                    assert!(
                        (demand(&b) - begun).abs() < 1.0,
                        "{what}: stopped after {begun} at {}",
                        demand(&b)
                    );
                    assert!(!moves(&b), "{what}: done in mid-motion");
                }
            }
            b.run(2);
            assert!(!moves(&b), "{what}: it moves on after its end");
            assert_eq!(b.feedback(0).stopped, None, "{what}");
        }
    }
}

/// Seven of ten replies come once more, in the window of one of the next eight requests. Without a tag each of them
/// passes for the newest.
#[test]
fn each_move_is_sent_once_and_done_however_many_replies_are_repeated() {
    let mut random = fastrand::Rng::with_seed(23);
    let tagged = 1 + 2 * (ReplyTag::WORDS.len() - 1);
    for (n, rig) in rigs().into_iter().enumerate().take(tagged) {
        let mut b = rig.ready();
        b.run(40);
        for trial in 0..100 {
            let target = random.f64() * 150.0;
            let id = b.post(0, to(target));
            let from = b.tape(0).received.len();
            let outcome = loop {
                if random.u8(..10) < 7 {
                    repeat(&b, random.usize(1..=8));
                }
                b.step();
                if let Some(outcome) = b.outcome(0, id) {
                    break outcome;
                }
            };
            assert_eq!(outcome, Outcome::Done, "rig {n}, trial {trial}");
            assert_near(demand(&b), target, 1e-4);
            let tape = b.tape(0);
            let motions = tape.received[from..].iter().filter_map(|one| one.request.motion);
            let mut counts: Vec<u16> = motions.map(|block| block.header & 0xF).collect();
            counts.dedup();
            assert_eq!(counts.len(), 1, "rig {n}, trial {trial}: {counts:?}");
        }
    }
}

#[test]
fn an_error_is_reported_with_its_code_in_whichever_cycle_it_comes() {
    for turn in 0..4 {
        let mut b = Rig::new(1).ready();
        b.run(turn);
        b.tape(0).provoke = Some(ErrorCode(0x0B));
        b.run(3);
        assert_eq!(b.feedback(0).status.fault, 0x0B, "{turn}");
        let reported = b.kinds(0).into_iter().filter(|kind| matches!(kind, EventKind::Fault(_)));
        assert_eq!(reported.collect::<Vec<_>>(), [EventKind::Fault(0x0B)], "{turn}");
    }
}

#[test]
fn a_quick_stop_of_a_drive_whose_parameters_force_that_bit_stops_it_by_a_ramp() {
    let mut b = Rig::new(1).each(|_, drive| drive.simulate.force_enable_bits = true).ready();
    b.post(0, slowly_to(190.0));
    b.run(300);
    let begun = demand(&b);
    b.done(0, Command::QuickStop);
    assert!(!moves(&b) && demand(&b) < begun + 2.0, "from {begun} to {}", demand(&b));
    let held = ControlWord::ON;
    assert_eq!(b.tape(0).received.last().unwrap().request.control, Some(held));
    b.done(0, to(10.0));
}

/// Each way in which replies are tagged, and after how many exchanges the tag is the same again.
const TAGS: [(ReplyTag, MonitorPlan, usize); 5] = [
    (ReplyTag::Definition, MonitorPlan::Off, 8),
    (ReplyTag::Definition, MonitorPlan::AsSet, 4),
    (ReplyTag::Count, MonitorPlan::Off, 14),
    (ReplyTag::Off, MonitorPlan::Off, 1),
    (ReplyTag::Off, MonitorPlan::AsSet, 1),
];

/// A reply of some time ago, of a request that looked like the next one, comes in the window of that, and before its
/// own reply.
fn old_reply(b: &Bench, tags: usize, old: Response) {
    let alike = {
        let tape = b.tape(0);
        // A cycle ends with the reply: where that was an old one, the drive does not have the request yet.
        let under_way = usize::from(tape.received.last().is_some_and(|last| last.at < b.grid()));
        let last = tape.received.len() - 1;
        let index = (last + 1 + under_way).saturating_sub(tags).min(last);
        tape.received[index].reply.expect("the drive answers everything")
    };
    let Response { request_def, response_def, config, .. } = alike;
    let reply = Response { request_def, response_def, config, ..old };
    b.inject_reply(0, reply, b.grid() + MS + 10 * US);
}

#[test]
fn two_replies_in_a_row_from_another_place_are_one_and_the_axis_has_lost_its_reference() {
    for tags in TAGS {
        let (tag, monitor, turns) = tags;
        let rig = Rig::new(1).each(move |_, drive| (drive.reply_tag, drive.monitor) = (tag, monitor));
        let mut b = rig.ready();
        b.done(0, to(150.0));
        b.post(0, slowly_to(190.0));
        b.run(60);
        let from = b.feedback(0).status.position;
        for _ in 0..2 {
            assert_eq!(b.feedback(0).stopped, None);
            let old = Response { actual: Some(0), demand: Some(0), ..b.tape(0).last() };
            old_reply(&b, turns, old);
            b.step();
        }
        let feedback = b.feedback(0);
        assert_eq!(feedback.stopped, Some(StopCause::PositionJump), "{tags:?}");
        assert_eq!((feedback.status.position, feedback.status.homed), (0.0, false), "{tags:?}");
        let jumps = b.kinds(0).into_iter().filter_map(|kind| match kind {
            EventKind::PositionJump(by) => Some(by),
            _ => None,
        });
        let jumps: Vec<f64> = jumps.collect();
        assert!(jumps.len() == 1 && (jumps[0] + from).abs() < 1.0, "{tags:?}: {jumps:?} from {from}");
        // It is stopped, and its range holds again once it is homed: the drive alone says so all the time.
        b.run(400);
        assert!(!moves(&b) && !b.feedback(0).status.homed, "{tags:?}");
        assert!(b.tape(0).last().status.unwrap().homed());
        b.done(0, Command::Reset);
        b.done(0, Command::Enable);
        assert_eq!(b.failed(0, to(10.0)), Failure::NotHomed);
        b.done(0, Command::Home);
        assert!(b.feedback(0).status.homed, "{tags:?}");
        b.done(0, to(10.0));
    }
}
