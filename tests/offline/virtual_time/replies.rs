//! Which reply answers which request: late, doubled, foreign and broken ones are counted and never matched. What holds
//! for every bus stands in `conformance/replies`; here is what the loop makes of it, and what only LinUDP has.

use fieldbeat::axis::{Command, Row, StopCause, Target};
use fieldbeat::bus::linudp::{MonitorPlan, ReplyTag, StatusWord};
use fieldbeat::sim::{FaultPlan, WorldOptions};
use fieldbeat::telemetry::{Counters, Numbers, Unmatched};
use fieldbeat::time::{MS, US};
use fieldbeat_linudp::wire::{Request, Response, ResponseDef};

use crate::virtual_time::support::*;

/// Online, and in a motion so slow that it goes on, but each cycle has another position.
fn moving(rig: Rig) -> Bench {
    let mut b = rig.ready();
    for index in 0..b.drives.len() {
        b.done(index, to(10.0));
        b.post(index, slowly_to(190.0));
    }
    b.run(100);
    b
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
fn with_definitions_in_turn_a_reply_is_suspect_only_after_as_many_misses() {
    for (monitor, turns) in [(MonitorPlan::Off, 8), (MonitorPlan::AsSet, 4)] {
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
    for (late, within) in (1..20).flat_map(|late| [(late, 1), (late, 2)]) {
        let mut b = moving(Rig::new(1).each(|_, drive| {
            (drive.axis.health.bucket, drive.reply_within) = (10_000, Some(within));
        }));
        b.tape(0).mute = true;
        b.tape(0).received.clear();
        b.run(late);
        b.tape(0).mute = false;
        let waiting: Vec<Response> =
            b.tape(0).received.iter().filter_map(|received| received.reply).collect();
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
        // The reply of the cycle before answers its request, if it counts so long.
        let behind = u64::from(within) - 1;
        assert_eq!(c.own[0], behind, "{late}: {c:?}");
        assert_eq!((c.missed, c.late, c.duplicate), (late - behind, late - behind, 0), "{late}: {c:?}");
    }
}

#[test]
fn replies_that_always_come_behind_their_window_are_feedback_with_their_age() {
    // A round trip of 520 us, and windows of 500 us; and one into the window of the next cycle, or of the one after it.
    for (latency_us, within, monitor, tag) in [
        (260, None, MonitorPlan::Off, ReplyTag::Definition),
        (260, None, MonitorPlan::AsSet, ReplyTag::Definition),
        (260, None, MonitorPlan::Off, ReplyTag::Count),
        (600, Some(2), MonitorPlan::Off, ReplyTag::Definition),
        (600, Some(2), MonitorPlan::Off, ReplyTag::Count),
        (1_100, Some(3), MonitorPlan::AsSet, ReplyTag::Definition),
        (3_200, Some(7), MonitorPlan::Off, ReplyTag::Definition),
    ] {
        let what = format!("{latency_us} us, {monitor:?}, {tag:?}");
        let mut rig = Rig::new(2).each(|_, drive| {
            (drive.reply_within, drive.monitor, drive.reply_tag) = (within, monitor, tag);
        });
        rig.options = WorldOptions { latency_ns: latency_us * US, ..rig.options };
        let mut b = moving(rig);
        // A round trip and the time until the next grid point.
        let age = (2 * latency_us).div_ceil(1_000) as u32 - u32::from(2 * latency_us % 1_000 < 500);
        for _ in 0..200 {
            b.step();
            assert_eq!((b.feedback(0).age, b.feedback(0).status.suspect), (age.max(1), false), "{what}");
            b.assert_honest(0);
            assert_near(f64::from(b.feedback(0).rtt_ns.unwrap()), (2_000 * latency_us) as f64, 1_000_000.0);
        }
        // Commands are proved by the reply to their own request, rows too.
        b.done(0, Command::Stop { deceleration: None });
        b.done(0, to(20.0));
        assert_near(b.feedback(0).status.position, 20.0, 0.5);
        let rows = (1..=100).map(|n| Row { last: n == 100, ..row(20.0 + 0.01 * f64::from(n)) });
        rows.for_each(|row| b.sim.axis(0).push_row(row).unwrap());
        b.done(0, Command::Follow);
        assert_near(b.feedback(0).status.position, 21.0, 0.1);
        b.done(0, Command::Disable);
        b.shut_down(5_000);
        let c = counters(b);
        assert_eq!((c.missed, c.late, c.duplicate, c.foreign, c.suspect), (0, 0, 0, 0, 0), "{what}: {c:?}");
        assert_eq!(c.own[0], c.answered, "{what}: {c:?}");
    }
    // As it was before: none of them counts.
    let mut rig = Rig::new(1).each(|_, drive| drive.reply_within = Some(1));
    rig.options = WorldOptions { latency_ns: 260 * US, ..rig.options };
    let mut b = rig.start();
    b.run(2_000);
    let c = counters(b);
    assert_eq!((c.sent, c.late, c.answered), (20, 20, 0));
}

#[test]
fn replies_and_requests_in_disorder_are_no_lost_link() {
    let disorder = FaultPlan { seed: 7, reorder: 0.25, ..FaultPlan::default() };
    let run = |change: fn(&mut RigDrive)| {
        let mut b = moving(Rig::new(1).each(|_, drive| change(drive)));
        b.world().set_faults(address(0), disorder.clone());
        for turn in 0..20_000 {
            b.step();
            if turn % 500 == 499 && b.feedback(0).stopped.is_none() {
                b.post(0, if turn % 1_000 == 499 { slowly_to(10.0) } else { slowly_to(190.0) });
            }
        }
        let stopped = b.feedback(0).stopped;
        b.world().set_faults(address(0), FaultPlan::default());
        b.shut_down(5_000);
        (stopped, counters(b))
    };
    let (stopped, c) = run(|_| {});
    assert_eq!(stopped, None, "{c:?}");
    assert!(c.own[0] > 4_000 && c.missed < 2_000, "{c:?}");
    let (stopped, c) = run(|drive| (drive.reply_within, drive.axis.health.leak) = (Some(1), 20));
    assert_eq!(stopped, Some(StopCause::LinkLost), "as it was before: {c:?}");
}

#[test]
fn what_waits_in_the_socket_before_the_first_request_is_no_reply() {
    let mut b = Rig::new(1).start();
    // The reply to a request of the master before.
    let response_def = ResponseDef::CYCLIC;
    let old =
        Response { response_def, status: Some(StatusWord(0x0037)), actual: Some(77), ..Response::default() };
    let mut bytes = [0; 64];
    let size = old.emit(&mut bytes);
    b.world().inject(MASTER, address(0), &bytes[..size], b.world().now());
    for _ in 0..20 {
        b.step();
        assert_ne!(b.feedback(0).status.position, 77.0 / PER_MM);
    }
    assert_eq!(counters(b).foreign, 1);
}

#[test]
fn padding_and_what_stands_in_it_mean_nothing() {
    for padding in [0, 14, 64] {
        let mut b = moving(Rig::new(1).each(|_, drive| drive.simulate.padding = padding));
        b.tape(0).tamper = Some(Box::new(|reply| reply.extend([0xFF; 30])));
        for _ in 0..50 {
            b.step();
            b.assert_honest(0);
            // Twice the latency, and a few readings of the clock.
            assert_near(f64::from(b.feedback(0).rtt_ns.unwrap()), 40e3, 500.0);
        }
        let c = counters(b);
        assert_eq!(c, Counters { sent: c.sent, answered: c.sent, ..Counters::default() });
    }
}

#[test]
fn a_request_carries_exactly_what_is_needed() {
    let needed = ResponseDef(0x1F);
    let turns = ResponseDef::ERROR.with(ResponseDef::WARN).with(ResponseDef::MONITOR);
    for tag in [ReplyTag::Definition, ReplyTag::Off] {
        let mut b = moving(Rig::new(1).each(|_, drive| drive.reply_tag = tag));
        b.run(16);
        let received: Vec<Request> =
            b.tape(0).received.iter().rev().take(16).map(|received| received.request).collect();
        assert!(received.iter().all(|r| r.control.is_some() && r.motion.is_none() && r.config.is_none()));
        let requested: Vec<ResponseDef> = received.iter().map(|request| request.response_def).collect();
        if tag == ReplyTag::Off {
            assert_eq!(requested, [ResponseDef::CYCLIC; 16]);
            continue;
        }
        // Any eight in a row have eight definitions, without a block that nothing needs but those in turn.
        assert_eq!(requested[..8], requested[8..]);
        for (n, definition) in requested[..8].iter().enumerate() {
            assert_eq!(definition.0 & !turns.0, needed.0);
            assert!(!requested[..n].contains(definition), "{requested:?}");
        }
    }
}

#[test]
fn what_the_system_drops_and_refuses_to_give_is_counted_and_stops_nobody() {
    let mut b = moving(Rig::new(2));
    b.tape(0).dropped = 3;
    b.tape(0).deaf_once = true;
    b.run(3);
    assert_eq!([0, 1].map(|index| b.feedback(index).stopped), [None; 2]);
    let end = b.finish();
    let Unmatched { datagrams, dropped, errors } = end.buses[0].1;
    assert_eq!((datagrams, dropped, errors), (0, 3, 1));
}

#[test]
fn a_velocity_is_the_way_between_two_requests_whenever_their_replies_are_received() {
    // The master wakes up late, for its sends as for its replies, by up to a third of a period; what the drive reports
    // is where it was when it had the request.
    let mut rig = Rig::new(1);
    rig.options = WorldOptions { wake_ns: 300 * US, seed: 7, ..rig.options };
    let mut b = rig.cycle(|cycle| cycle.receive_deadline = 0.8).ready();
    b.done(0, to(10.0));
    b.post(0, with(Target::Absolute(190.0), 100.0, 5_000.0));
    b.run(100);
    let mut seen = Vec::new();
    for _ in 0..1_000 {
        b.step();
        if b.feedback(0).age == 0 {
            seen.push(b.feedback(0).status.velocity);
        }
    }
    let late = b.status().wake_max.ns;
    assert!(seen.len() > 900 && late > 200 * US, "{} of 1000, {late} ns", seen.len());
    let (least, most) =
        seen.iter().fold((f64::MAX, f64::MIN), |(least, most), v| (least.min(*v), most.max(*v)));
    assert!(least > 99.0 && most < 101.0, "{least} ... {most} mm/s");
}
