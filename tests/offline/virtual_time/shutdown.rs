//! The end of the master: from every state each axis ends powered off, at standstill before that, and in bounded time.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use fieldbeat::axis::{Abort, Command, Link, StopCause, StopHow, StopThen, Target};
use fieldbeat::bus::linudp::{ControlWord, ErrorCode, MainState, StatusWord};
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::{Condition, StopRequest};
use fieldbeat::{Flow, Master, Plan};

use super::fuse::Fused;
use crate::virtual_time::support::*;

/// No motion was cut short: when the control word went low for good, the drive did not move.
fn assert_braked_before_power_off(b: &Bench, index: usize) {
    let tape = b.tape(index);
    let last_on = tape
        .received
        .iter()
        .rposition(|h| h.request.control.is_some_and(|word| word.has(ControlWord::SWITCH_ON)));
    let Some(last_on) = last_on else { return };
    let status = tape.received[last_on].reply.unwrap().status.unwrap();
    assert!(!status.has(StatusWord::MOTION_ACTIVE), "axis {index} lost its power in motion");
}

/// Every command that was accepted has ended.
fn assert_all_ended(b: &Bench, index: usize, last: u64) {
    for id in 1..=last {
        assert!(b.ends.contains_key(&(index, id)), "command {id} of axis {index} has no end");
    }
}

fn is_off(b: &Bench, index: usize) -> bool {
    let main = b.tape(index).last().state.unwrap().main();
    matches!(
        main,
        MainState::NOT_READY
            | MainState::SWITCH_ON_DISABLED
            | MainState::READY_TO_SWITCH_ON
            | MainState::ERROR
    )
}

#[test]
fn from_every_state_each_axis_ends_powered_off() {
    type Prepare = fn(&mut Bench);
    // What goes before, and the most cycles that the end may take: a ramp from 200 mm/s takes 40 ms, then standstill is
    // looked at 20 times, and powering off takes an exchange or two.
    let cases: [(&str, u64, Prepare); 12] = [
        ("never enabled", 2, |_| {}),
        ("enabling", 400, |b| {
            b.post(0, Command::Enable);
            b.run(100);
        }),
        ("enabled", 30, |b| b.done(0, Command::Enable)),
        ("disabled again", 30, |b| {
            b.done(0, Command::Enable);
            b.done(0, Command::Disable);
        }),
        ("homing", 150, |b| {
            b.done(0, Command::Enable);
            b.post(0, Command::Home);
            b.run(50);
        }),
        ("moving, with more in the queue", 80, |b| {
            b.ready();
            b.post(0, with(Target::Absolute(190.0), 200.0, 5_000.0));
            b.post(0, Command::Home);
            b.post(0, to(20.0));
            b.run(100);
        }),
        ("jogging", 80, |b| {
            b.ready();
            b.post(0, jog(200.0));
            b.run(200);
        }),
        ("streaming", 50, |b| {
            b.ready();
            (0..500).for_each(|n| b.sim.axis(0).push_row(row(f64::from(n) * 0.02)).unwrap());
            b.post(0, Command::Follow);
            b.run(200);
        }),
        ("in fault", 10, |b| {
            b.ready();
            b.post(0, slowly_to(100.0));
            b.run(100);
            b.tape(0).provoke = Some(ErrorCode(0x0B));
            b.run(100);
        }),
        ("braking for a fault of its own", 60, |b| {
            b.ready();
            b.post(0, with(Target::Absolute(190.0), 500.0, 5_000.0));
            b.run(200);
            b.tape(0).provoke = Some(ErrorCode(0x0B));
            b.run(2);
        }),
        ("stopping already", 80, |b| {
            b.ready();
            b.post(0, with(Target::Absolute(190.0), 200.0, 5_000.0));
            b.run(100);
            b.tape(0).mute = true;
            b.run(6);
            b.tape(0).mute = false;
            b.until("seen again", 200, |b| b.feedback(0).link == Link::Online);
        }),
        ("booting", 60, |b| {
            b.ready();
            b.world().restart(address(0));
            b.run(3);
        }),
    ];
    for how in [StopHow::Ramp, StopHow::Quick] {
        for then in [StopThen::Disable, StopThen::Hold] {
            for (name, most, prepare) in &cases {
                let mut b = Rig::new(1)
                    .each(|_, drive| (drive.axis.stop.how, drive.axis.stop.then) = (how, then))
                    .online();
                prepare(&mut b);
                let last = b.post(0, Command::Home).0;
                let took = b.shut_down(5_000);
                assert!(took <= *most, "{name}, {how:?}, {then:?}: {took} cycles");
                assert!(
                    is_off(&b, 0) || b.tape(0).last().status == Some(StatusWord(0)),
                    "{name}, {how:?}, {then:?}"
                );
                assert_braked_before_power_off(&b, 0);
                assert_all_ended(&b, 0, last);
                assert!(b.feedback(0).stopped.is_some());
                b.assert_grid();
                let left = b.finish().drives[0].at_end.clone();
                let condition = left.as_ref().map(|left| left.condition);
                assert_eq!(condition, Some(Condition::Off), "{name}, {how:?}, {then:?}: {left:?}");
            }
        }
    }
}

#[test]
fn a_lost_drive_receives_its_stop_and_its_power_off_before_the_end() {
    // Only its replies are lost, and they are lost just when the end is requested.
    let mut b = Rig::new(1).each(|_, drive| drive.axis.stop.timeout = Duration::from_millis(500)).ready();
    let id = b.post(0, with(Target::Absolute(190.0), 100.0, 1_000.0));
    b.run(100);
    b.tape(0).mute = true;
    b.run(6);
    assert_eq!(b.feedback(0).link, Link::Lost);
    assert_eq!(b.aborted(0, id), Abort::Stopped(StopCause::LinkLost));
    // Braking and powering off have half a second each.
    let took = b.shut_down(2_000);
    assert!((900..=1_100).contains(&took), "{took}");
    assert!(is_off(&b, 0));
    assert_braked_before_power_off(&b, 0);
    // This master has not seen it.
    let left = b.finish().drives[0].at_end.clone().unwrap();
    let requested = [StopRequest::Ramp, StopRequest::PowerOff];
    assert_eq!((left.condition, &*left.requested), (Condition::Unknown, &requested[..]));
}

#[test]
fn a_second_stop_shortens_the_way_and_still_goes_it() {
    // A weak ramp: 100 mm/s at 50 mm/s² take two seconds.
    let weak = |b: &mut Bench| {
        b.ready();
        b.post(0, with(Target::Absolute(190.0), 100.0, 1_000.0));
        b.run(200);
    };
    let rig = || Rig::new(1).each(|_, drive| weak_ramp(drive, 50.0));
    let mut slow = rig().start();
    weak(&mut slow);
    assert!(slow.shut_down(5_000) > 1_000);
    // At once, a little later, and long into the ramp.
    for wait in [0, 1, 500] {
        let mut b = rig().start();
        weak(&mut b);
        b.sim.stop();
        b.run(wait);
        // The drive's own quick stop takes 5 ms.
        let took = b.shut_down(5_000);
        assert!(took <= 40, "{took} cycles after {wait}");
        assert!(is_off(&b, 0));
        assert_braked_before_power_off(&b, 0);
    }
}

#[test]
fn the_task_is_not_called_once_the_end_was_requested() {
    let calls = Arc::new(AtomicU64::new(0));
    let count = Arc::clone(&calls);
    let mut b = Rig::new(1)
        .task(move |cycle, axes| {
            count.fetch_add(1, Ordering::Relaxed);
            let command = if cycle.index % 2 == 0 { Command::Reset } else { Command::Enable };
            let _ = axes.command(0, command);
        })
        .online();
    b.until("operation", 1_000, |b| b.feedback(0).is_operational());
    let before = calls.load(Ordering::Relaxed);
    assert!(b.shut_down(1_000) <= 30);
    assert_eq!(calls.load(Ordering::Relaxed), before);
    assert!(is_off(&b, 0));
}

#[test]
fn the_status_counts_the_axes_in_operation() {
    let mut b = Rig::new(3).online();
    let counts = |b: &Bench| (b.status().online, b.status().operational);
    assert_eq!(counts(&b), (3, 0));
    for index in 0..2 {
        b.done(index, Command::Enable);
    }
    assert_eq!(counts(&b), (3, 2));
    b.shut_down(1_000);
    assert_eq!(counts(&b), (3, 0));
}

#[test]
fn a_bus_that_does_not_end_is_left_after_ten_seconds() {
    for (waits, cut_off) in [(None, true), (Some(9_000), false)] {
        let bus = Fused::new(bus(vec![drive(0)]));
        let never_ends = Arc::clone(&bus.never_ends);
        *never_ends.lock().unwrap() = true;
        let plan = Plan { buses: vec![Box::new(bus)], ..Plan::default() };
        let mut sim = Master::from_plan(plan).simulate(WorldOptions::default()).unwrap();
        for _ in 0..100 {
            sim.step();
        }
        sim.stop();
        let took = (1..20_000_u64).find(|turn| {
            if waits == Some(*turn) {
                *never_ends.lock().unwrap() = false;
            }
            sim.step() == Flow::End
        });
        let expected = waits.unwrap_or(10_002);
        assert_eq!(took, Some(expected));
        assert_eq!(sim.status().cut_off, cut_off);
    }
}
