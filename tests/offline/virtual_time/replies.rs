//! Which reply answers which request: late, doubled, foreign and broken ones are counted and never matched. What holds
//! for every bus stands in `conformance/replies`; here is what the loop makes of it, and what only LinUDP has.

use fieldbeat::axis::{Command, Link, Row, StopCause};
use fieldbeat::bus::linudp::{MonitorPlan, ReplyTag, StatusWord};
use fieldbeat::sim::{FaultPlan, WorldOptions};
use fieldbeat::telemetry::{Counters, Numbers, Unmatched};
use fieldbeat::time::US;
use fieldbeat_linudp::wire::{Response, ResponseDef};

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
fn replies_that_are_always_as_late_as_their_echoes_repeat_are_no_link() {
    // A round trip of so many cycles and 200 us: each reply echoes the request that has just left.
    for (cycles, monitor) in [(8, MonitorPlan::Off), (16, MonitorPlan::Off), (4, MonitorPlan::AsSet)] {
        for within in [1, 2, 3] {
            let mut rig = Rig::new(1).each(|_, drive| {
                (drive.reply_within, drive.monitor) = (Some(within), monitor);
            });
            rig.options = WorldOptions { latency_ns: (cycles * 1_000 + 200) * US / 2, ..rig.options };
            let mut b = rig.start();
            for _ in 0..3_000 {
                b.step();
                assert_ne!(b.feedback(0).link, Link::Online, "{cycles} cycles, {within}, {monitor:?}");
            }
            let c = counters(b);
            assert!(c.answered < c.missed, "{cycles} cycles, {within}, {monitor:?}: {c:?}");
        }
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

/// As many exchanges are lost in a row as there are definitions, or more: a late reply could be taken for a newer one.
/// One that differs from all of them ends that.
#[test]
fn a_run_of_lost_exchanges_makes_a_few_replies_suspect_wherever_they_come() {
    for (latency_us, within, monitor) in [
        (40, 1, MonitorPlan::Off),
        (260, 2, MonitorPlan::AsSet),
        (600, 2, MonitorPlan::Off),
        (1_100, 3, MonitorPlan::AsSet),
        (3_200, 7, MonitorPlan::Off),
    ] {
        let online = || {
            let mut rig = Rig::new(1).each(|_, drive| {
                (drive.reply_within, drive.monitor) = (Some(within), monitor);
                drive.axis.health.bucket = 50;
            });
            rig.options = WorldOptions { latency_ns: latency_us * US, ..rig.options };
            rig.online()
        };
        for lost in 1..=20 {
            let mut b = online();
            b.ready();
            b.world().set_faults(address(0), FaultPlan { drop: 1.0, ..FaultPlan::default() });
            b.run(lost);
            b.world().set_faults(address(0), FaultPlan::default());
            b.done(0, to(10.0));
            b.run(50);
            let c = b.finish().drives[0].counters;
            assert!(c.suspect <= 12, "{latency_us} us, {monitor:?}, {lost} lost: {c:?}");
        }
        let mut b = online();
        b.world().set_faults(address(0), FaultPlan { seed: 11, drop: 0.05, ..FaultPlan::default() });
        b.run(5_000);
        let c = b.finish().drives[0].counters;
        assert!(10 * c.suspect < c.answered, "{latency_us} us, {monitor:?}: {c:?}");
    }
}

/// Late is what comes once to an exchange that was missed: neither a copy of what was answered in time, however much of
/// that is under way, nor one of what was late.
#[test]
fn no_copy_of_a_reply_is_late() {
    let copied = FaultPlan { seed: 11, duplicate: 0.7, ..FaultPlan::default() };
    let lost = FaultPlan { drop: 0.05, ..copied.clone() };
    let delayed = FaultPlan { delay: 0.02, delay_ns: 5_000 * US, ..copied.clone() };
    for (tag, monitor) in [
        (ReplyTag::Definition, MonitorPlan::Off),
        (ReplyTag::Definition, MonitorPlan::AsSet),
        (ReplyTag::Count, MonitorPlan::Off),
    ] {
        for (latency_us, within) in [(40, 1), (260, 2), (600, 2), (1_100, 3)] {
            let counted = |faults: &FaultPlan| {
                let mut rig = Rig::new(1).each(|_, drive| {
                    (drive.reply_within, drive.monitor, drive.reply_tag) = (Some(within), monitor, tag);
                    drive.axis.health.bucket = 50;
                });
                rig.options = WorldOptions { latency_ns: latency_us * US, ..rig.options };
                let mut b = rig.online();
                b.world().set_faults(address(0), faults.clone());
                b.run(5_000);
                let c = b.finish().drives[0].counters;
                (c, format!("{tag:?}, {monitor:?}, {latency_us} us: {c:?}"))
            };
            let (c, what) = counted(&copied);
            assert_eq!((c.missed, c.late), (0, 0), "{what}");
            assert!(c.duplicate > 5_000, "{what}");
            let (c, what) = counted(&lost);
            // Behind a run of lost ones an older reply may still come.
            assert!(c.missed > 300 && 10 * c.late < c.missed, "{what}");
            let (c, what) = counted(&delayed);
            // One that is overtaken by a whole round of definitions has the echo of another one.
            let least = if monitor == MonitorPlan::Off { 20 } else { 1 };
            assert!((least..=c.missed).contains(&c.late), "{what}");
        }
    }
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
fn datagrams_from_before_the_first_request_are_no_reply() {
    let mut b = Rig::new(1).start();
    // The reply to a request of the master before.
    let response_def = ResponseDef::CYCLIC;
    let old =
        Response { response_def, status: Some(StatusWord(0x0037)), actual: Some(77), ..Response::default() };
    b.inject_reply(0, old, b.world().now());
    for _ in 0..20 {
        b.step();
        assert_ne!(b.feedback(0).status.position, 77.0 / PER_MM);
    }
    assert_eq!(counters(b).foreign, 1);
}

#[test]
fn datagrams_dropped_or_refused_by_the_system_are_counted_and_stop_no_drive() {
    let mut b = moving(Rig::new(2));
    b.tape(0).dropped = 3;
    b.tape(0).deaf_once = true;
    b.run(3);
    assert_eq!([0, 1].map(|index| b.feedback(index).stopped), [None; 2]);
    let end = b.finish();
    let Unmatched { datagrams, dropped, errors } = end.buses[0].1;
    assert_eq!((datagrams, dropped, errors), (0, 3, 1));
}
