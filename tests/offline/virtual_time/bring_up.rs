//! From silence to online: reads before it writes, whatever is found.

use fieldbeat::Overrun;
use fieldbeat::axis::{Command, Failure, Link, Outcome, State, StopCause};
use fieldbeat::bus::linudp::{ControlWord, MotionBlock};
use fieldbeat::time::MS;

use crate::virtual_time::support::*;

/// No control word, and no motion command but the one that does nothing.
fn assert_only_read(b: &Bench, index: usize) {
    for received in &b.tape(index).received {
        assert_eq!(received.request.control, None, "drive {index} at {}", received.at);
        let motion = received.request.motion.unwrap_or_default();
        assert_eq!(motion, MotionBlock::default(), "drive {index} at {}", received.at);
    }
}

#[test]
fn no_drive_is_written_before_the_first_command() {
    let mut b = Rig::new(3).each(|index, drive| drive.simulate.start_running = index == 2).start();
    b.world().unplug(address(1));
    b.run(1_000);
    b.world().plug(address(1));
    b.run(1_000);
    assert_only_read(&b, 0);
    assert_only_read(&b, 1);
    // Motion blocks go to the silent only: a drive that answers is not bothered with them.
    assert!(b.tape(0).received.iter().all(|received| received.request.motion.is_none()));
    let id = b.post(0, Command::Enable);
    b.step();
    b.step();
    assert_eq!(b.tape(0).received.last().unwrap().request.control, Some(ControlWord::BASE));
    assert_eq!(b.ended(0, id), Outcome::Done);
    assert_only_read(&b, 1);
}

#[test]
fn a_stop_of_all_axes_writes_nothing_to_drives_that_never_got_a_command() {
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
fn requests_wait_until_the_link_is_up() {
    let mut b = Rig::new(1).start();
    b.step();
    assert_eq!(b.feedback(0).link, Link::Qualifying, "the first cycle has an exchange");
    b.run(4);
    assert_eq!(b.failed(0, Command::Enable), Failure::NotOnline);
    b.online();
    b.done(0, Command::Enable);
}
