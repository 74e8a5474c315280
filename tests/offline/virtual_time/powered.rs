//! What an axis with power must not do, in whatever state it is, and what stops it then.

use std::time::Duration;

use fieldbeat::axis::{Command, EventKind, StopCause, StopThen, StopTimeout};
use fieldbeat::bus::linudp::{ControlWord, StateVar};
use fieldbeat::time::MS;
use fieldbeat_linudp::wire::Request;

use super::support::*;

/// The last request with a motion command that the drive has received.
fn last_motion(b: &Bench) -> Request {
    let tape = b.tape(0);
    let mut newest = tape.received.iter().rev().map(|received| received.request);
    newest.find(|request| request.motion.is_some()).expect("a motion was commanded")
}

fn stops(b: &Bench) -> Vec<StopCause> {
    let stop = |kind: EventKind| if let EventKind::Stopped(cause) = kind { Some(cause) } else { None };
    b.kinds(0).into_iter().filter_map(stop).collect()
}

/// From the request that starts it: three reports of the motion, and what the generator takes to begin.
const NOTICED_WITHIN: u64 = 8;

#[test]
fn an_axis_that_holds_after_a_stop_is_watched_and_stopped_again_as_often_as_it_moves() {
    let mut b = Rig::new(1).each(|_, drive| drive.axis.stop.then = StopThen::Hold).ready();
    // A drive executes no count twice in a row.
    let old = [100.0, 110.0].map(|target| {
        b.post(0, slowly_to(target));
        b.run(100);
        last_motion(&b)
    });
    b.world().suspend(2 * MS);
    assert_eq!(b.stopped(0, 2), StopCause::Suspended);
    b.run(500);
    let stood = b.feedback(0).status.demand;
    for again in 1..4 {
        assert!(b.feedback(0).status.state.is_powered() && !b.feedback(0).status.moving);
        // A network delivers an old request once more.
        b.inject_request(0, old[again % 2], b.world().now());
        b.until("a further stop", NOTICED_WITHIN, |b| stops(b).len() == 1 + again);
        b.run(300);
        assert_eq!(b.feedback(0).stopped, Some(StopCause::Suspended), "the first cause stays");
        assert_near(b.feedback(0).status.demand, stood, f64::from(again as u32));
    }
    assert_eq!(stops(&b)[1..], [StopCause::Uncommanded; 3]);
}

/// The drive answers, and goes on as if it had not received the stop.
#[test]
fn a_stop_that_the_drive_does_not_follow_escalates_to_quick_stop_and_power_off() {
    for (on_timeout, powered) in [(StopTimeout::Disable, false), (StopTimeout::Hold, true)] {
        let mut b = Rig::new(1)
            .each(|_, drive| {
                drive.axis.limits.velocity = Some(200.0);
                (drive.axis.stop.timeout, drive.axis.stop.on_timeout) =
                    (Duration::from_millis(300), on_timeout);
            })
            .ready();
        b.post(0, jog(80.0));
        b.run(100);
        let id = b.post(0, Command::Stop { deceleration: None });
        b.tape(0).tamper = Some(Box::new(|reply| {
            // Motion active, in the state var behind the definitions and the status word.
            let at = 8 + 2;
            let state = u16::from_le_bytes([reply[at], reply[at + 1]]);
            if StateVar(state).count().is_some() {
                reply[at] |= 1 << 5;
            }
        }));
        b.run(295);
        assert_eq!((b.outcome(0, id), stops(&b)), (None, vec![]));
        b.run(20);
        assert_eq!(stops(&b), [StopCause::StopTimeout]);
        let quick = |request: &Request| request.control.is_some_and(|word| !word.has(ControlWord::NO_ABORT));
        assert!(b.tape(0).received.iter().any(|received| quick(&received.request)));
        b.run(400);
        assert_eq!(b.feedback(0).status.state.is_powered(), powered);
    }
}

#[test]
fn a_computer_that_was_suspended_stops_its_axes_with_the_first_send() {
    let mut b = Rig::new(2).ready();
    let _ = [0, 1].map(|index| b.post(index, slowly_to(100.0)));
    b.run(100);
    b.tape(0).wire = Some(Vec::new());
    b.world().suspend(MS);
    b.step();
    assert_eq!(b.feedback(0).stopped, None, "a millisecond is none");
    b.world().suspend(60_000 * MS);
    let before = b.tape(0).wire.as_ref().map_or(0, Vec::len);
    b.step();
    assert_eq!([0, 1].map(|index| b.feedback(index).stopped), [Some(StopCause::Suspended); 2]);
    let first = b.tape(0).wire.as_ref().unwrap()[before];
    assert!(first.request.motion.is_some_and(|block| block.header & 0xFFF0 != 0), "{first:?}");
    b.until("power off", 500, |b| !b.feedback(0).status.state.is_powered());
}
