//! Every cause of a master's stop, alone: the reports, in their order, how the latch holds, and how it opens.

use std::time::Duration;

use fieldbeat::Flow;
use fieldbeat::axis::{Abort, Command, CommandId, EventKind, Failure, Link, Outcome, StopCause};
use fieldbeat::bus::linudp::ErrorCode;
use fieldbeat::time::MS;
use fieldbeat_linudp::wire::Request;

use crate::virtual_time::faults::inject;
use crate::virtual_time::other_masters::go_to;
use crate::virtual_time::support::*;

/// How one cause comes about in a machine of three axes: 0 is the one that is looked at, 1 is of its group, 2 is alone.
struct Case {
    rig: fn(Rig) -> Rig,
    /// Up to the motion that it cuts off; the command of that.
    lead: fn(&mut Bench) -> CommandId,
    /// The cause itself.
    strike: fn(&mut Bench),
    /// Where the running command is what the stop is for, it fails by itself; or else it is aborted like all others.
    fails: fn(&Failure) -> bool,
    /// What stops the others.
    others: [Option<StopCause>; 2],
}

/// A move, and a stop that takes the group along.
const CASE: Case = Case {
    rig: |rig| rig,
    lead: |b| {
        b.ready();
        b.post(0, slowly_to(100.0))
    },
    strike: |_| {},
    fails: |_| false,
    others: [Some(StopCause::Group), None],
};

/// One line a cause, or a test of its own: an axis without a running motion has none to cut off.
macro_rules! causes {
    ($($cause:ident => $case:expr),+ ; $($own:ident),+) => {
        const CAUSES: &[(StopCause, Case)] = &[$((StopCause::$cause, $case)),+];
        const OWN: &[StopCause] = &[$(StopCause::$own),+];
    };
}

causes! {
    Shutdown => Case { strike: |b| b.sim.stop(), others: [Some(StopCause::Shutdown); 2], ..CASE },
    LinkLost => Case { strike: |b| b.tape(0).mute = true, ..CASE },
    DriveFault => Case { strike: |b| b.tape(0).provoke = Some(ErrorCode(0x0B)), ..CASE },
    DriveDropped => Case { strike: |b| assert!(b.world().restart(address(0))), ..CASE },
    Overrun => Case {
        // Ten slots in a row may be passed over.
        strike: |b| b.world().delay_next_wake(11 * MS),
        others: [Some(StopCause::Overrun); 2],
        ..CASE
    },
    Underrun => Case {
        lead: |b| follow(b, 0.01),
        fails: |failure| *failure == Failure::Underrun,
        ..CASE
    },
    Limit => Case {
        // A step that the door lets pass: how long it may take, only the loop knows.
        lead: |b| follow(b, 1.5),
        fails: |failure| matches!(failure, Failure::Limit { what: "speed between rows", .. }),
        ..CASE
    },
    Task => Case {
        rig: |rig| {
            rig.task(|cycle, _| {
                if cycle.index == 1_500 {
                    // Quietly: the message of a panic is not this test's.
                    std::panic::resume_unwind(Box::new("on purpose"));
                }
            })
        },
        others: [Some(StopCause::Task); 2],
        ..CASE
    },
    FoundRunning => Case {
        rig: |rig| rig.each(|index, drive| drive.simulate.start_running = index == 0),
        lead: |b| {
            b.until("the first answer", 20, |b| b.feedback(0).link == Link::Qualifying);
            // The next one passes the quality gate; a request now waits for the end of that cycle.
            b.run(8);
            b.post(0, Command::Enable)
        },
        ..CASE
    },
    StoOpen => Case { strike: |b| assert!(b.world().open_sto(address(0), 50 * MS)), ..CASE },
    Heartbeat => Case {
        rig: |rig| rig.cycle(|cycle| cycle.heartbeat_ns = Some(1_500 * MS)),
        // The application does nothing any more.
        others: [Some(StopCause::Heartbeat); 2],
        ..CASE
    },
    StaleSetpoint => Case {
        lead: |b| {
            b.ready();
            let id = b.post(0, Command::Velocity { acceleration: 1_000.0 });
            b.sim.axis(0).set_velocity(5.0).unwrap();
            b.run(5);
            id
        },
        ..CASE
    },
    DeadMan => Case {
        rig: |rig| rig.each(|_, drive| drive.axis.jog_deadman = Some(Duration::from_millis(50))),
        lead: |b| {
            b.ready();
            b.post(0, jog(5.0))
        },
        ..CASE
    },
    Group => Case {
        strike: |b| b.tape(1).provoke = Some(ErrorCode(0x0B)),
        others: [Some(StopCause::DriveFault), None],
        ..CASE
    },
    GroupLink => Case {
        rig: |rig| rig.each(|_, drive| (drive.axis.health.bucket, drive.axis.health.leak) = (8, 1_000)),
        lead: |b| {
            b.ready();
            b.join(&[0, 1]);
            let id = ask(b, slowly_to(100.0));
            b.run(50);
            id
        },
        strike: |b| {
            // No member alone loses its link.
            for index in [0, 1] {
                b.tape(index).mute = true;
                b.run(4);
                b.tape(index).mute = false;
            }
        },
        others: [Some(StopCause::GroupLink), None],
        ..CASE
    },
    OtherMaster => Case {
        // It sends the drive elsewhere, with a count of its own.
        strike: |b| {
            b.run(20);
            let own = b.tape(0).last().state.and_then(|state| state.count()).unwrap_or(0);
            inject(b, Request { motion: Some(go_to(10_000).block((own + 7) & 0xF)), ..Request::default() });
        },
        ..CASE
    },
    GroupFailed => Case {
        // One of them into its limit, where the protocol ends the jog.
        lead: |b| {
            b.ready();
            b.join(&[0, 1]);
            b.group_done(&[to(190.0), to(50.0)]);
            ask(b, jog(30.0))
        },
        fails: |failure| matches!(failure, Failure::Limit { what: "position", .. }),
        ..CASE
    },
    Suspended => Case {
        strike: |b| b.world().suspend(60_000 * MS),
        others: [Some(StopCause::Suspended); 2],
        ..CASE
    };
    Uncommanded, StopTimeout, Panic, LinkThread, OwnerLost, LoopStuck, FollowingError, PositionJump
}

/// Commands axis 0, and its whole group where it has joined one.
fn ask(b: &mut Bench, command: Command) -> CommandId {
    match b.joined() {
        true => b.group().post_all(command).unwrap_or_else(|error| panic!("{error}")).ids()[0],
        false => b.post(0, command),
    }
}

fn failed(b: &mut Bench, command: Command) -> Failure {
    let id = ask(b, command);
    match b.ended(0, id) {
        Outcome::Failed(failure) => failure,
        other => panic!("{command:?} should have failed: {other}"),
    }
}

fn done(b: &mut Bench, command: Command) {
    let id = ask(b, command);
    assert_eq!(b.ended(0, id), Outcome::Done, "{command:?}");
}

/// Follows a few rows, the last of which is `step` further than the others are.
fn follow(b: &mut Bench, step: f64) -> CommandId {
    b.ready();
    for n in 0..50 {
        let position = 0.01 * f64::from(n) + if n == 49 { step } else { 0.0 };
        b.sim.axis(0).push_row(row(position)).unwrap();
    }
    b.post(0, Command::Follow)
}

fn try_cause(cause: StopCause, case: &Case) {
    let mut b =
        (case.rig)(Rig::new(3).each(|index, drive| drive.axis.stop.group = (index < 2).then_some(1))).start();
    let running = (case.lead)(&mut b);
    // Home waits for a motion, and a motion for Home.
    let waiting = [Command::Home, to(5.0)].map(|command| ask(&mut b, command));
    assert!((0..3).all(|index| b.feedback(index).stopped.is_none()), "{cause}: alone");
    let before = b.events.len();
    (case.strike)(&mut b);
    assert_eq!(b.stopped(0, 2_000), cause);

    // What runs may fail, then comes the stop, then the end of everything else, in order and in the same cycle.
    let reported: Vec<_> =
        (b.events[before..].iter().filter(|(axis, _)| *axis == 0).map(|(_, event)| *event))
            .filter(|event| matches!(event.kind, EventKind::Stopped(_) | EventKind::Ended { .. }))
            .collect();
    assert!(reported.iter().all(|event| event.cycle == reported[0].cycle), "{cause}: {reported:?}");
    let mut reported = reported.into_iter().map(|event| match event.kind {
        EventKind::Ended { id, outcome, .. } => (Some(id), outcome),
        _ => (None, Outcome::Aborted(Abort::Stopped(cause))),
    });
    let aborted = Outcome::Aborted(Abort::Stopped(cause));
    let mut expected = vec![(None, aborted)];
    match b.outcome(0, running) {
        Some(Outcome::Failed(failure)) if (case.fails)(&failure) => {
            assert_eq!(reported.next(), Some((Some(running), Outcome::Failed(failure))), "{cause}");
        }
        _ => expected.push((Some(running), aborted)),
    }
    expected.extend(waiting.map(|id| (Some(id), aborted)));
    assert!(reported.eq(expected), "{cause}: {:?}", &b.events[before..]);
    // A stop for a row comes after the judging; the group gets it in the next one.
    b.step();
    assert_eq!([1, 2].map(|index| b.feedback(index).stopped), case.others, "{cause}");

    if cause == StopCause::Shutdown {
        return assert_ends(b, cause);
    }
    assert_holds(&mut b, cause);
    assert_opens(&mut b, cause);
    // The others have kept their first cause, whatever came after it, and keep it to the end; but for a reset of the
    // group.
    let others = [1, 2].map(|index| b.feedback(index).stopped);
    assert_eq!(others[0], case.others[0].filter(|_| !b.joined()), "{cause}");
    b.shut_down(10_000);
    let kept = |index: usize| others[index - 1].unwrap_or(StopCause::Shutdown);
    assert_eq!(
        [1, 2].map(|index| b.feedback(index).stopped),
        [1, 2].map(|index| Some(kept(index))),
        "{cause}"
    );
}

/// No motion is taken, and no other cause takes the place of the first one.
fn assert_holds(b: &mut Bench, cause: StopCause) {
    for command in [Command::Enable, Command::Home, to(5.0), jog(5.0), Command::Follow] {
        assert_eq!(failed(b, command), Failure::Latched(cause), "{cause}: {command:?}");
    }
    b.tape(0).mute = true;
    b.until("a lost link", 100, |b| b.feedback(0).link == Link::Lost);
    b.world().delay_next_wake(12 * MS);
    b.run(20);
    b.world().restart(address(0));
    b.tape(0).mute = false;
    b.online().run(200);
    let stops = b.kinds(0).into_iter().filter(|kind| matches!(kind, EventKind::Stopped(_)));
    assert_eq!(stops.collect::<Vec<_>>(), [EventKind::Stopped(cause)]);
    assert_eq!(b.feedback(0).stopped, Some(cause));
}

/// Only reset opens it, and only enable after that lets it move.
fn assert_opens(b: &mut Bench, cause: StopCause) {
    done(b, Command::ResetFault);
    assert_eq!(failed(b, to(5.0)), Failure::Latched(cause));
    done(b, Command::Reset);
    assert_eq!(b.feedback(0).stopped, None, "{cause}");
    let failure = failed(b, Command::Home);
    assert!(matches!(failure, Failure::WrongState(_) | Failure::NotEnabled), "{cause}: {failure}");
    done(b, Command::Enable);
    done(b, Command::Home);
    done(b, to(5.0));
    assert_eq!(b.feedback(0).stopped, None, "{cause}");
}

/// The end of the master: nothing is taken any more.
fn assert_ends(mut b: Bench, cause: StopCause) {
    let requested = [Command::Reset, Command::Enable, to(5.0)].map(|command| b.post(0, command));
    let ended = (0..1_000).any(|_| b.step() == Flow::End);
    assert!(ended, "{cause}");
    for id in requested {
        assert_eq!(b.outcome(0, id), Some(Outcome::Aborted(Abort::Stopped(cause))));
    }
    assert!((0..3).all(|index| b.feedback(index).stopped == Some(cause)));
}

#[test]
fn every_cause_latches_reports_in_order_and_opens_by_reset_and_enable() {
    let listed = |cause| CAUSES.iter().any(|(known, _)| *known == cause) || OWN.contains(&cause);
    assert!(StopCause::ALL.into_iter().all(listed), "each cause has its case");
    for (cause, case) in CAUSES {
        try_cause(*cause, case);
    }
}
