//! From silence to online: reads before it writes, asks the dead rarely, and knows a drive that is found running.

use std::time::Duration;

use fieldbeat::axis::Failure;
use fieldbeat::axis::{Command, EventKind, FoundRunning, Health, Link, Outcome, State, StopCause, StopThen};
use fieldbeat::bus::linudp::wire::{ControlWord, MotionBlock, StatusWord};
use fieldbeat::cycle::Overrun;
use fieldbeat::time::MS;

use crate::virtual_time::support::*;

/// No control word, and no motion command but the one that does nothing.
fn assert_only_read(b: &Bench, index: usize) {
    for heard in &b.tape(index).heard {
        assert_eq!(heard.request.control, None, "drive {index} at {}", heard.at);
        let motion = heard.request.motion.unwrap_or_default();
        assert_eq!(motion, MotionBlock::default(), "drive {index} at {}", heard.at);
    }
}

#[test]
fn nothing_is_written_before_the_first_order() {
    let mut b = Rig::new(3).each(|index, drive| drive.simulate.start_running = index == 2).start();
    b.world().unplug(address(1));
    b.run(1_000);
    b.world().plug(address(1));
    b.run(1_000);
    assert_only_read(&b, 0);
    assert_only_read(&b, 1);
    // Motion blocks go to the silent only: a drive that answers is not bothered with them.
    assert!(b.tape(0).heard.iter().all(|heard| heard.request.motion.is_none()));
    let id = b.post(0, Command::Enable);
    b.step();
    b.step();
    assert_eq!(b.tape(0).heard.last().unwrap().request.control, Some(ControlWord::BASE));
    assert_eq!(b.ended(0, id), Outcome::Done);
    assert_only_read(&b, 1);
}

#[test]
fn a_stop_of_all_axes_writes_nothing_to_drives_that_never_got_an_order() {
    // One is only seen, one not even that. Their latch holds, and opens again.
    let mut b = Rig::new(3).cycle(|cycle| cycle.overrun = Overrun::Stop).start();
    b.world().unplug(address(1));
    b.until("two online", 200, |b| [0, 2].iter().all(|i| b.feedback(*i).link == Link::Online));
    b.done(2, Command::Enable);
    b.world().delay_next_wake(2 * MS);
    b.run(200);
    for index in 0..3 {
        assert_eq!(b.feedback(index).stopped, Some(StopCause::Overrun));
    }
    b.world().plug(address(1));
    b.online().run(100);
    assert_only_read(&b, 0);
    assert_only_read(&b, 1);
    for index in 0..2 {
        assert_eq!(b.failed(index, Command::Enable), Failure::Latched(StopCause::Overrun));
        b.done(index, Command::Reset);
        assert_only_read(&b, index);
        b.done(index, Command::Enable);
    }
}

#[test]
fn a_drive_found_running_is_stopped_even_if_its_axis_was_latched_before() {
    let mut b = Rig::new(1)
        .cycle(|cycle| cycle.overrun = Overrun::Stop)
        .each(|_, drive| {
            drive.simulate.start_running = true;
            drive.simulate.start_position = 1_000_000;
        })
        .start();
    b.world().unplug(address(0));
    b.world().delay_next_wake(2 * MS);
    b.run(100);
    assert_eq!(b.feedback(0).stopped, Some(StopCause::Overrun));
    b.world().plug(address(0));
    b.until("power off", 1_000, |b| b.feedback(0).status.state == State::ReadyToSwitchOn);
}

#[test]
fn the_gate_wants_good_exchanges_in_a_row() {
    let health = Health { gate: 10, ..Health::default() };
    let mut b = Rig::new(1).each(|_, drive| drive.axis.health = health).start();
    b.step();
    assert_eq!(b.feedback(0).link, Link::Qualifying);
    b.run(8);
    assert_eq!(b.feedback(0).link, Link::Qualifying);
    // The tenth is lost: back to the slow questions.
    b.tape(0).mute = true;
    b.step();
    assert_eq!(b.feedback(0).link, Link::Unseen);
    b.tape(0).mute = false;
    let heard = b.tape(0).heard.len();
    b.run(99);
    assert_eq!((b.feedback(0).link, b.tape(0).heard.len()), (Link::Unseen, heard));
    b.run(9);
    assert_eq!(b.feedback(0).link, Link::Qualifying);
    b.step();
    assert_eq!(b.feedback(0).link, Link::Online);
    let links: Vec<_> = b.kinds(0).into_iter().filter(|kind| matches!(kind, EventKind::Link(_))).collect();
    let expected = [Link::Qualifying, Link::Unseen, Link::Qualifying, Link::Online].map(EventKind::Link);
    assert_eq!(links, expected);
    assert_eq!(b.status().online, 1);
}

#[test]
fn orders_wait_at_the_door_until_the_link_is_up() {
    let mut b = Rig::new(1).start();
    b.run(5);
    assert_eq!(b.failed(0, Command::Enable), Failure::NotOnline);
    b.online();
    b.done(0, Command::Enable);
}

#[test]
fn sixty_four_drives_are_online_within_a_hundred_cycles_of_the_first() {
    let mut b = Rig::new(64).start();
    let first = b.until("the first", 100, |b| (0..64).any(|i| b.feedback(i).link == Link::Online));
    let rest = b.until("all", 100, |b| (0..64).all(|i| b.feedback(i).link == Link::Online));
    assert!(first + rest < 100, "{first} + {rest}");
    let end = b.finish();
    for drive in &end.drives {
        assert_eq!((drive.counters.sent, drive.counters.missed), (drive.counters.answered, 0));
    }
}

#[test]
fn a_dead_drive_is_asked_rarely_and_its_neighbours_lose_nothing() {
    let mut b = Rig::new(8).start();
    let world = b.world();
    for index in [0, 3, 7] {
        world.unplug(address(index));
    }
    b.run(10_000);
    let end = b.finish();
    for (index, drive) in end.drives.iter().enumerate() {
        let counters = drive.counters;
        assert_eq!(counters.sent, counters.answered + counters.missed, "drive {index}");
        if [0, 3, 7].contains(&index) {
            assert_eq!((counters.sent, counters.answered), (100, 0), "drive {index}");
            assert_eq!((drive.feedback.link, drive.losses), (Link::Unseen, 0));
        } else {
            assert_eq!((counters.sent, counters.answered), (10_000, 10_000), "drive {index}");
        }
    }
    assert_eq!(end.status.missed, 300);
}

#[test]
fn a_lost_drive_is_asked_rarely_too() {
    let probe_interval = Duration::from_millis(50);
    let mut b = Rig::new(2)
        .each(|_, drive| drive.axis.health = Health { probe_interval, ..Health::default() })
        .start();
    b.online();
    b.tape(0).mute = true;
    b.run(5);
    assert_eq!(b.feedback(0).link, Link::Lost);
    b.tape(0).heard.clear();
    b.run(1_000);
    let heard: Vec<_> = b.tape(0).heard.iter().map(|heard| heard.at).collect();
    assert_eq!(heard.len(), 20);
    assert!(heard.windows(2).all(|pair| pair[1].since(pair[0]).abs_diff(50 * MS) < MS / 10));
}

#[test]
fn some_probes_carry_every_block_since_some_drives_answer_no_others() {
    let mut b = Rig::new(1).start();
    b.tape(0).mute = true;
    b.run(1_000);
    let tape = b.tape(0);
    let full = tape.heard.iter().filter(|heard| heard.request.motion.is_some()).count();
    assert_eq!((tape.heard.len(), full), (10, 2));
    assert!(tape.heard.iter().all(|h| h.request.motion.is_some() == h.request.config.is_some()));
}

#[test]
fn found_running_is_stopped_along_its_ramp_and_powered_off() {
    let mut b = Rig::new(1)
        .each(|_, drive| {
            drive.simulate.start_running = true;
            drive.simulate.start_position = 1_000_000;
        })
        .start();
    b.online();
    assert_eq!(b.feedback(0).stopped, Some(StopCause::FoundRunning));
    b.run(1);
    // The bits as found, and a ramp: neither power off nor a quick stop.
    let first = b.tape(0).heard.last().unwrap().request;
    assert_eq!(first.control, Some(ControlWord::ON));
    assert_eq!(first.motion.unwrap().header >> 4, 0x017);
    assert_eq!(first.motion.unwrap().header & 0xF, 6, "the other master left count 5");
    b.until("power off", 200, |b| b.feedback(0).status.state == State::ReadyToSwitchOn);
    let standing = |heard: &&Heard| !heard.reply.unwrap().status.unwrap().has(StatusWord::MOTION_ACTIVE);
    let still = b.tape(0).heard.iter().rev().take_while(standing).count();
    assert!(still >= 20, "power went off only after standstill");
    b.done(0, Command::Reset);
    b.done(0, Command::Enable);
    b.done(0, to(50.0));
}

#[test]
fn found_running_can_be_refused_and_then_nothing_is_written() {
    let mut b = Rig::new(1)
        .each(|_, drive| {
            drive.simulate.start_running = true;
            drive.simulate.start_position = 1_000_000;
            drive.axis.on_found_running = FoundRunning::Refuse;
        })
        .start();
    b.online();
    b.run(500);
    assert_eq!(b.feedback(0).stopped, Some(StopCause::FoundRunning));
    assert!(b.feedback(0).status.moving);
    for verb in [Command::Enable, Command::Home, to(10.0)] {
        assert_eq!(b.failed(0, verb), Failure::Latched(StopCause::FoundRunning));
    }
    assert_only_read(&b, 0);
    // The application decides: a gentle stop is open to it, and then the drive is the master's, as it is.
    b.done(0, Command::Stop { deceleration: None });
    assert!(!b.feedback(0).status.moving && b.feedback(0).stopped.is_some());
    assert_eq!(b.tape(0).heard.last().unwrap().request.control, Some(ControlWord::ON));
    b.done(0, Command::Reset);
    assert_eq!(b.failed(0, to(50.0)), Failure::NotEnabled);
    b.done(0, Command::Enable);
    b.done(0, to(50.0));
}

#[test]
fn found_running_and_refused_survives_the_end_of_the_master_untouched() {
    let mut b = Rig::new(1)
        .each(|_, drive| {
            drive.simulate.start_running = true;
            drive.axis.on_found_running = FoundRunning::Refuse;
        })
        .start();
    b.online();
    b.shut_down(10);
    assert_only_read(&b, 0);
}

#[test]
fn a_restarted_master_goes_on_with_the_count_of_the_drive() {
    // The drive has stored count 5. All sixteen counts are used, so one of them would meet it if the master did not
    // ask.
    let mut b = Rig::new(1)
        .each(|_, drive| {
            drive.simulate.start_running = true;
            drive.axis.stop.then = StopThen::Hold;
        })
        .start();
    b.online();
    b.until("standstill", 400, |b| !b.feedback(0).status.moving);
    b.done(0, Command::Reset);
    b.done(0, Command::Enable);
    b.tape(0).heard.clear();
    for n in 0..40 {
        b.done(0, to(10.0 + f64::from(n)));
        assert_near(b.feedback(0).status.demand, 10.0 + f64::from(n), 1e-6);
    }
    // One telegram each: none had to be repeated, so each was taken with its first count.
    let counts: Vec<u16> = b
        .tape(0)
        .heard
        .iter()
        .filter_map(|heard| heard.request.motion)
        .map(|motion| motion.header & 0xF)
        .collect();
    let expected: Vec<u16> = (0..40).map(|n| (7 + n) % 16).collect();
    assert_eq!(counts, expected);
}
