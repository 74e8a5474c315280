//! Which reply answers which request: late, doubled, foreign and broken ones are counted and never matched. What holds
//! for every bus stands in `conformance/replies`; here is what the loop makes of it, and what only LinUDP has.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat::axis::Link;
use fieldbeat::bus::Counters;
use fieldbeat::bus::linudp::wire::{Request, RequestDef, Response, ResponseDef};
use fieldbeat::bus::linudp::{MonitorPlan, ReplyTag};
use fieldbeat::cycle::status::Numbers;
use fieldbeat::sim::FaultPlan;
use fieldbeat::time::{MS, US};

use crate::virtual_time::support::*;

/// Online, and in a motion so slow that it goes on, but each cycle has another position.
fn moving(rig: Rig) -> Bench {
    let mut b = rig.start();
    b.ready();
    for index in 0..b.drives.len() {
        b.done(index, to(10.0));
        b.post(index, slowly_to(190.0));
    }
    b.run(100);
    b
}

/// From here on a reply comes so much later.
fn answer_after(b: &Bench, ns: u64) {
    b.world().set_faults(address(0), FaultPlan { answer_ns: ns, ..FaultPlan::default() });
}

/// The counters of the first drive. Everything that was sent has come to an end.
fn counters(b: Bench) -> Counters {
    b.assert_grid();
    let end: Numbers = b.finish();
    let counters = end.drives[0].counters;
    assert_eq!(counters.sent, counters.answered + counters.missed, "{counters:?}");
    let missed: u64 = end.drives.iter().map(|drive| drive.counters.missed + drive.counters.unsent).sum();
    assert_eq!(end.status.missed, missed);
    counters
}

#[test]
fn a_clean_wire_answers_everything() {
    let mut b = moving(Rig::new(1));
    for _ in 0..100 {
        b.step();
        assert_eq!((b.feedback(0).age, b.feedback(0).status.suspect), (0, false));
        b.assert_honest(0);
        // Twice the latency, and a few readings of the clock.
        assert_near(f64::from(b.feedback(0).rtt_ns.unwrap()), 40e3, 500.0);
    }
    let round_trips = b.sim.measured().histograms.drives[0].rtt.len();
    let c = counters(b);
    assert_eq!(c, Counters { sent: c.sent, answered: c.sent, ..Counters::default() });
    assert_eq!(round_trips, c.sent);
}

#[test]
fn without_a_tag_a_missed_exchange_holds_the_values_and_the_next_reply_is_suspect_once() {
    let mut b = moving(Rig::new(1).each(|_, drive| drive.reply_tag = ReplyTag::Off));
    let samples = b.sim.measured().histograms.drives[0].rtt.len();
    let held = b.feedback(0).status.demand;
    b.tape(0).mute = true;
    for age in 1..=3 {
        b.step();
        assert_eq!((b.feedback(0).age, b.feedback(0).status.demand), (age, held));
        b.assert_honest(0);
    }
    b.tape(0).mute = false;
    b.step();
    // It could be a late one: older by one, and no sample of the round trip.
    assert_eq!((b.feedback(0).age, b.feedback(0).status.suspect), (1, true));
    assert_eq!(b.sim.measured().histograms.drives[0].rtt.len(), samples);
    b.step();
    assert_eq!((b.feedback(0).age, b.feedback(0).status.suspect), (0, false));
    assert_eq!(b.sim.measured().histograms.drives[0].rtt.len(), samples + 1);
    b.run(10);
    let c = counters(b);
    assert_eq!((c.missed, c.suspect, c.late, c.duplicate), (3, 1, 0, 0));
}

#[test]
fn with_definitions_in_turn_a_reply_is_suspect_only_after_as_many_misses() {
    for (monitor, turns) in [(MonitorPlan::Off, 4), (MonitorPlan::AsSet, 2)] {
        for misses in [1, turns - 1, turns, turns + 3] {
            let mut b = moving(Rig::new(1).each(|_, drive| {
                drive.monitor = monitor;
                drive.axis.health.bucket = 10_000;
            }));
            b.tape(0).mute = true;
            b.run(misses);
            b.tape(0).mute = false;
            let suspect = misses >= turns;
            b.step();
            assert_eq!(
                (b.feedback(0).age, b.feedback(0).status.suspect),
                (u32::from(suspect), suspect),
                "{misses}"
            );
            b.assert_honest(0);
            for _ in 0..20 {
                b.step();
                assert_eq!(
                    (b.feedback(0).age, b.feedback(0).status.suspect),
                    (0, false),
                    "once, {misses} misses"
                );
                b.assert_honest(0);
            }
            let c = counters(b);
            assert_eq!((c.missed, c.suspect, c.late, c.duplicate), (misses, suspect.into(), 0, 0));
        }
    }
}

#[test]
fn a_burst_of_all_late_replies_at_once_is_never_taken_for_the_newest() {
    // A drive that did not come to answer for so many cycles, and then answers everything that waited: in the window of
    // the newest request, in order.
    for late in 1..20 {
        let mut b = moving(Rig::new(1).each(|_, drive| drive.axis.health.bucket = 10_000));
        b.tape(0).mute = true;
        b.tape(0).heard.clear();
        b.run(late);
        b.tape(0).mute = false;
        let waiting: Vec<Response> = b.tape(0).heard.iter().filter_map(|heard| heard.reply).collect();
        for (n, reply) in (0_u64..).zip(&waiting) {
            let mut bytes = [0; 64];
            let size = reply.emit(&mut bytes);
            // Before the true reply, 40 us after the request.
            b.world().inject(MASTER, address(0), &bytes[..size], b.grid() + MS + 10 * US + n);
        }
        for _ in 0..20 {
            b.step();
            if !b.feedback(0).status.suspect {
                b.assert_honest(0);
            }
        }
        let c = counters(b);
        assert_eq!((c.missed, c.late, c.duplicate), (late, late, 0), "{late}: {c:?}");
    }
}

#[test]
fn a_reply_behind_its_deadline_is_late_and_a_miss() {
    let mut b = moving(Rig::new(1));
    let samples = b.sim.measured().histograms.drives[0].rtt.len();
    answer_after(&b, 600 * US);
    for _ in 0..3 {
        b.step();
        b.assert_honest(0);
    }
    answer_after(&b, 0);
    b.step();
    // All the late ones came before this send, so this reply is its own.
    assert_eq!((b.feedback(0).age, b.feedback(0).status.suspect), (0, false));
    assert_eq!(b.sim.measured().histograms.drives[0].rtt.len(), samples + 1);
    b.run(10);
    let c = counters(b);
    assert_eq!((c.missed, c.late, c.suspect, c.duplicate), (3, 3, 0, 0));
}

#[test]
fn replies_that_are_always_one_cycle_behind_are_never_taken_for_fresh_ones() {
    let tags = ReplyTag::WORDS.map(|(_, tag)| tag);
    for (answer_us, reply_tag) in [980, 1_100, 1_400].into_iter().flat_map(|us| tags.map(|tag| (us, tag))) {
        let mut b = moving(Rig::new(1).each(|_, drive| drive.reply_tag = reply_tag));
        let samples = b.sim.measured().histograms.drives[0].rtt.len();
        answer_after(&b, answer_us * US);
        for _ in 0..30 {
            b.step();
            b.assert_honest(0);
        }
        // No exchange is answered in its own window: that is a lost link, not a short round trip.
        assert_eq!(b.feedback(0).link, Link::Lost, "{answer_us} us, {reply_tag:?}");
        assert_eq!(b.sim.measured().histograms.drives[0].rtt.len(), samples);
    }
}

#[test]
fn late_replies_are_counted_as_late_each_and_nothing_as_a_duplicate() {
    let tags = ReplyTag::WORDS.map(|(_, tag)| tag);
    for (answer_us, reply_tag) in (600..=2_600).step_by(100).flat_map(|us| tags.map(|tag| (us, tag))) {
        let mut b = moving(Rig::new(1).each(|_, drive| drive.reply_tag = reply_tag));
        answer_after(&b, answer_us * US);
        b.run(500);
        answer_after(&b, 0);
        b.run(500);
        let c = counters(b);
        let what = format!("{answer_us} us, {reply_tag:?}: {c:?}");
        assert!(c.missed > 0, "{what}");
        // Each request was answered once, sooner or later.
        assert_eq!((c.late, c.duplicate, c.foreign), (c.missed, 0, 0), "{what}");
    }
}

#[test]
fn a_loss_of_long_ago_makes_no_duplicate_late() {
    let mut b = moving(Rig::new(1));
    b.tape(0).mute = true;
    b.run(2);
    b.tape(0).mute = false;
    b.run(30);
    b.world().set_faults(address(0), FaultPlan { duplicate: 1.0, ..FaultPlan::default() });
    b.run(10);
    b.world().set_faults(address(0), FaultPlan::default());
    b.run(10);
    let c = counters(b);
    assert_eq!((c.missed, c.late, c.duplicate), (2, 0, 30));
}

#[test]
fn with_a_tag_feedback_is_exact_in_any_weather() {
    for (seed, tag) in (0..4).flat_map(|seed| [(seed, ReplyTag::Count), (seed, ReplyTag::Definition)]) {
        let weather = FaultPlan {
            seed,
            drop: 0.05,
            duplicate: 0.1,
            delay: 0.2,
            delay_ns: 900 * US,
            // A reply that is held back may come four exchanges late, and only a count tells that one apart.
            reorder: if tag == ReplyTag::Count { 0.05 } else { 0.0 },
            ..FaultPlan::default()
        };
        let rig = Rig::new(1).each(|_, drive| {
            drive.reply_tag = tag;
            drive.axis.health.bucket = 10_000;
        });
        let mut b = moving(rig);
        b.world().set_faults(address(0), weather);
        for _ in 0..2_000 {
            b.step();
            b.assert_honest(0);
        }
        b.world().set_faults(address(0), FaultPlan::default());
        b.run(20);
        let c = counters(b);
        assert!(c.missed > 100 && c.late > 50 && c.duplicate > 50, "seed {seed}: {c:?}");
        // In such weather four exchanges in a row are missed now and then.
        assert!(c.suspect <= if tag == ReplyTag::Count { 0 } else { 200 }, "seed {seed}: {c:?}");
    }
}

#[test]
fn doubled_replies_are_duplicates_and_answer_once() {
    let mut b = moving(Rig::new(1));
    b.world().set_faults(address(0), FaultPlan { duplicate: 1.0, ..FaultPlan::default() });
    for _ in 0..100 {
        b.step();
        assert_eq!((b.feedback(0).age, b.feedback(0).status.suspect), (0, false));
    }
    b.world().set_faults(address(0), FaultPlan::default());
    b.run(10);
    let c = counters(b);
    // Each request came twice, and both its replies.
    assert_eq!((c.missed, c.late, c.suspect, c.duplicate), (0, 0, 0, 300));
}

/// A reply as the drive would give it to another question.
fn reply_to(request_def: u32, response_def: u32) -> Vec<u8> {
    let response = Response {
        request_def: RequestDef(request_def),
        response_def: ResponseDef(response_def),
        status: Some(Default::default()),
        state: Some(Default::default()),
        actual: Some(123_456),
        demand: Some(123_456),
        current: Some(0),
        warn: Some(Default::default()),
        error: Some(Default::default()),
        monitor: Some([0; 4]),
        config: Some(Default::default()),
    };
    let mut bytes = vec![0; 64];
    let size = response.emit(&mut bytes);
    bytes.truncate(size);
    bytes
}

#[test]
fn what_is_not_the_answer_is_counted_by_its_kind_and_never_matched() {
    let mut b = moving(Rig::new(1));
    let world = b.world();
    let (drive, other_port) = (address(0), SocketAddrV4::new(*address(0).ip(), 5));
    let unknown = SocketAddrV4::new(Ipv4Addr::new(10, 9, 9, 9), drive.port());
    let asked = b.tape(0).heard.last().unwrap().reply.unwrap();
    let (request_def, response_def) = (asked.request_def.0, ResponseDef::CYCLIC.0);
    let mut inject = |from, bytes: &[u8]| {
        // Early in the window of the next cycle, before the true reply.
        let at = b.grid() + MS + 10 * US;
        world.inject(MASTER, from, bytes, at);
        b.step();
        assert_ne!(b.feedback(0).status.demand, 12.3456);
        assert_eq!((b.feedback(0).age, b.feedback(0).status.suspect), (0, false));
        b.assert_honest(0);
    };
    // Foreign: the echo of something that was not asked, or a wrong port.
    inject(drive, &reply_to(0, 0x1FF));
    inject(drive, &reply_to(request_def ^ 1, response_def));
    inject(drive, &reply_to(request_def, response_def ^ 1));
    inject(other_port, &reply_to(request_def, response_def));
    // The echo of the move that was answered long ago.
    inject(drive, &reply_to(request_def ^ 2, response_def));
    // Malformed: shorter than its definitions, or than any telegram, or longer than any.
    for length in [0, 1, 7, 8, 25] {
        inject(drive, &reply_to(request_def, response_def)[..length]);
    }
    inject(drive, &[0; 129]);
    inject(drive, &[0; 1_400]);
    // A stranger.
    inject(unknown, &reply_to(request_def, response_def));
    let end = b.finish();
    let c = end.drives[0].counters;
    assert_eq!((c.foreign, c.malformed), (4, 7), "{c:?}");
    assert_eq!((c.answered, c.missed, c.late, c.duplicate, c.suspect), (c.sent, 0, 0, 1, 0));
    assert_eq!((end.buses[0].1.datagrams, end.buses[0].1.errors), (1, 0));
}

#[test]
fn padding_and_what_stands_in_it_mean_nothing() {
    for padding in [0, 14, 64] {
        let mut b = moving(Rig::new(1).each(|_, drive| drive.simulate.padding = padding));
        b.tape(0).tamper = Some(Box::new(|reply| reply.extend([0xFF; 30])));
        for _ in 0..50 {
            b.step();
            b.assert_honest(0);
        }
        let c = counters(b);
        assert_eq!(c, Counters { sent: c.sent, answered: c.sent, ..Counters::default() });
    }
}

#[test]
fn what_the_system_refuses_to_send_is_charged_to_its_drive_alone() {
    let mut b = moving(Rig::new(3));
    b.tape(1).jammed = true;
    b.run(4);
    let ages: Vec<_> = (0..3).map(|index| b.feedback(index).age).collect();
    assert_eq!(ages, [0, 4, 0]);
    b.tape(1).jammed = false;
    b.step();
    // Nothing was under way: this reply is its own.
    assert_eq!((b.feedback(1).age, b.feedback(1).status.suspect), (0, false));
    b.assert_honest(1);
    b.tape(1).jammed = true;
    b.step();
    assert_eq!(b.feedback(1).link, Link::Lost, "the fifth miss");
    let status = b.status();
    let end = b.finish();
    let counters: Vec<_> = end.drives.iter().map(|drive| drive.counters).collect();
    assert_eq!(counters.iter().map(|c| c.unsent).collect::<Vec<_>>(), [0, 5, 0]);
    assert!(counters.iter().all(|c| c.sent == c.answered && c.missed == 0));
    assert_eq!(status.missed, 5);
}

#[test]
fn any_bytes_from_a_drive_do_no_harm() {
    for seed in 0..3 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut b = moving(Rig::new(2).each(|index, drive| drive.reply_tag = ReplyTag::WORDS[index].1));
        for index in 0..2 {
            let mut dice = random.fork();
            b.tape(index).tamper = Some(Box::new(move |reply| match dice.u8(..6) {
                0 => reply.truncate(dice.usize(0..=reply.len())),
                1 => {
                    let at = dice.usize(8..reply.len());
                    reply[at] = dice.u8(..);
                }
                2 => reply.iter_mut().for_each(|byte| *byte = dice.u8(..)),
                3 => reply.extend((0..dice.usize(..200)).map(|_| dice.u8(..))),
                _ => {}
            }));
        }
        b.run(5_000);
        b.shut_down(10_000);
        let end = b.finish();
        for drive in &end.drives {
            let c = drive.counters;
            assert_eq!(c.sent, c.answered + c.missed, "seed {seed}: {c:?}");
            assert!(c.malformed > 0 && c.foreign > 0);
        }
    }
}

#[test]
fn a_request_carries_exactly_what_is_needed() {
    let needed = ResponseDef(0x5F);
    let turns = ResponseDef::WARN.with(ResponseDef::MONITOR);
    for tag in [ReplyTag::Definition, ReplyTag::Off] {
        let mut b = moving(Rig::new(1).each(|_, drive| drive.reply_tag = tag));
        b.run(8);
        let heard: Vec<Request> = b.tape(0).heard.iter().rev().take(8).map(|heard| heard.request).collect();
        assert!(heard.iter().all(|r| r.control.is_some() && r.motion.is_none() && r.config.is_none()));
        let asked: Vec<ResponseDef> = heard.iter().map(|request| request.response_def).collect();
        if tag == ReplyTag::Off {
            assert_eq!(asked, [ResponseDef::CYCLIC; 8]);
            continue;
        }
        // Any four in a row have four definitions, without a block that nothing needs but those in turn.
        assert_eq!(asked[..4], asked[4..]);
        for (n, definition) in asked[..4].iter().enumerate() {
            assert_eq!(definition.0 & !turns.0, needed.0);
            assert!(!asked[..n].contains(definition), "{asked:?}");
        }
    }
}
