//! Follow: rows of a stream, one an exchange, to the last one; and what happens when there are none.

use fieldbeat::axis::{Abort, Command, EventKind, Failure, Outcome, Row, StopCause, Underrun};
use fieldbeat::bus::linudp::StreamCommand;
use fieldbeat::time::{MS, US};

use crate::virtual_time::support::*;

/// A smooth way from `begin` by `way` in `rows` rows of `period_s`: position, velocity and acceleration of half a
/// cosine.
fn smooth(begin: f64, way: f64, rows: u32, period_s: f64) -> impl Iterator<Item = Row> {
    let span = f64::from(rows) * period_s;
    (1..=rows).map(move |n| {
        let phase = std::f64::consts::PI * f64::from(n) / f64::from(rows);
        let omega = std::f64::consts::PI / span;
        Row {
            position: begin + way * (1.0 - phase.cos()) / 2.0,
            velocity: way * omega * phase.sin() / 2.0,
            acceleration: way * omega * omega * phase.cos() / 2.0,
            last: n == rows,
        }
    })
}

#[test]
fn every_streaming_command_carries_its_axis_to_the_last_row() {
    for (command, period_ns, divisor) in [
        (StreamCommand::P, 2 * MS, 1),
        (StreamCommand::P, MS, 4),
        (StreamCommand::Pv, 2 * MS, 1),
        (StreamCommand::PConfigured, 5 * MS, 1),
        (StreamCommand::PvConfigured, MS, 1),
        (StreamCommand::PvConfigured, 500 * US, 1),
        (StreamCommand::Pva, MS, 1),
        (StreamCommand::Pva, 2 * MS, 5),
        (StreamCommand::PvaConfigured, MS, 2),
    ] {
        let mut b = Rig::new(1)
            .cycle(|cycle| cycle.period_ns = period_ns)
            .each(|_, drive| {
                drive.axis.divisor = divisor;
                drive.axis.stream_queue = 4_096;
                drive.stream = Some(command);
                drive.simulate.stream_period_ns = period_ns * u64::from(divisor);
            })
            .ready();
        b.done(0, to(20.0));
        let period_s = (period_ns * u64::from(divisor)) as f64 * 1e-9;
        let rows = (1.0 / period_s) as u32;
        for row in smooth(20.0, 100.0, rows, period_s) {
            b.sim.axis(0).push_row(row).unwrap();
        }
        b.tape(0).demand = None;
        b.done(0, Command::Follow);
        let what = format!("{command:?} every {period_ns} ns x {divisor}");
        assert_eq!(b.tape(0).last().demand, Some(1_200_000), "{what}");
        assert!(!b.feedback(0).status.moving && b.feedback(0).is_operational());
        // No overshoot on the way, whatever the command leaves out.
        let (low, high) = b.tape(0).demand.unwrap();
        assert!(low >= 19.999 && high <= 120.001, "{what}: {low} ... {high}");
        b.done(0, to(10.0));
    }
}

#[test]
fn the_first_row_is_near_the_axis_and_the_next_ones_near_each_other() {
    // (first, second, accepted) with a largest step of 0.5 mm, from 100 mm.
    for (first, second, accepted) in
        [(100.5, 101.0, true), (99.5, 99.0, true), (100.51, 100.6, false), (99.49, 99.5, false)]
    {
        let mut b = Rig::new(1).each(|_, drive| drive.axis.limits.step = Some(0.5)).ready();
        b.done(0, to(100.0));
        b.sim.axis(0).push_row(row(first)).unwrap();
        b.sim.axis(0).push_row(Row { last: true, ..row(second) }).unwrap();
        // Row to row it is refused at the door.
        let mut door = b.sim.axis(0).push_row(row(second));
        assert!(door.is_ok());
        door = b.sim.axis(0).push_row(row(second + 0.51));
        assert!(door.unwrap_err().to_string().contains("limit"));
        let id = b.post(0, Command::Follow);
        if accepted {
            assert_eq!(b.ended(0, id), Outcome::Done, "{first}");
        } else {
            assert!(matches!(b.ended(0, id), Outcome::Failed(Failure::Limit { .. })), "{first}");
            assert_eq!(b.feedback(0).stopped, Some(StopCause::Limit));
            assert_eq!(b.tape(0).last().demand, Some(1_000_000), "it has not moved");
        }
    }
}

#[test]
fn without_a_step_the_limit_of_velocity_holds_between_rows() {
    // 1000 mm/s are 1 mm a row. The row's own velocity says nothing of it.
    for (step, accepted) in [(0.99, true), (1.01, false), (50.0, false)] {
        let mut b = Rig::new(1).each(|_, drive| drive.axis.underrun = Underrun::Hold).ready();
        b.done(0, to(20.0));
        b.sim.axis(0).push_row(row(20.0)).unwrap();
        b.sim.axis(0).push_row(row(20.0 + step)).unwrap();
        let id = b.post(0, Command::Follow);
        b.run(20);
        assert_eq!(b.outcome(0, id).is_none(), accepted, "{step}");
        if !accepted {
            assert_eq!(b.feedback(0).stopped, Some(StopCause::Limit));
            let (_, high) = b.tape(0).demand.unwrap();
            assert!(high < 20.01, "{high}");
        }
    }
    // Nor may the first row be where the axis cannot be by then.
    let mut b = Rig::new(1).ready();
    b.done(0, to(20.0));
    b.sim.axis(0).push_row(row(100.0)).unwrap();
    let id = b.post(0, Command::Follow);
    assert!(matches!(b.ended(0, id), Outcome::Failed(Failure::Limit { .. })));
}

#[test]
fn a_stream_must_be_able_to_brake_within_the_range() {
    // At 500 mm/s the stop plan's 5000 mm/s² take 25 mm; the stream is cut 10 mm before the end.
    for underrun in [Underrun::Stop, Underrun::Extrapolate(3), Underrun::Hold] {
        let mut b = Rig::new(1).each(|_, drive| drive.axis.underrun = underrun).ready();
        b.done(0, to(100.0));
        // 2 mm/s faster each row, then constant.
        let (mut position, mut velocity) = (100.0, 0.0_f64);
        while position < 190.0 {
            velocity = (velocity + 2.0).min(500.0);
            position += velocity * 0.001;
            b.sim.axis(0).push_row(Row { velocity, ..row(position) }).unwrap();
        }
        let id = b.post(0, Command::Follow);
        assert!(matches!(b.ended(0, id), Outcome::Failed(Failure::Limit { .. })), "{underrun:?}");
        assert_eq!(b.feedback(0).stopped, Some(StopCause::Limit));
        b.run(300);
        let (_, high) = b.tape(0).demand.unwrap();
        assert!((190.0..=RANGE.1).contains(&high), "{underrun:?} went to {high}");
    }
}

#[test]
fn a_stream_may_brake_right_at_the_limit() {
    // With exactly the deceleration of the stop plan, down to 200 mm.
    let mut b = Rig::new(1).ready();
    b.done(0, to(100.0));
    let (a, t) = (4_999.0_f64, 0.1_f64);
    let way = a * t * t;
    let begin = 200.0 - way;
    b.done(0, to(begin));
    for n in 1..=200 {
        let s = f64::from(n) * 0.001;
        let (position, velocity) = match s < t {
            true => (begin + a * s * s / 2.0, a * s),
            false => (200.0 - a * (2.0 * t - s).powi(2) / 2.0, a * (2.0 * t - s)),
        };
        let position = position.min(200.0);
        b.sim.axis(0).push_row(Row { velocity, last: n == 200, ..row(position) }).unwrap();
    }
    b.done(0, Command::Follow);
    assert_eq!(b.tape(0).last().demand, Some(2_000_000));
}

#[test]
fn streams_run_one_after_the_other() {
    let mut b = Rig::new(1).ready();
    b.done(0, to(20.0));
    let at = |n: i32| row(20.0 + f64::from(n) * 0.02);
    (0..100).for_each(|n| b.sim.axis(0).push_row(Row { last: n == 99, ..at(n) }).unwrap());
    let first = b.post(0, Command::Follow);
    b.run(50);
    // The rows of the next one are queued first, as always; they are its own.
    (100..200).for_each(|n| b.sim.axis(0).push_row(Row { last: n == 199, ..at(n) }).unwrap());
    let second = b.post(0, Command::Follow);
    assert_eq!(b.ended(0, first), Outcome::Done);
    assert_near(b.feedback(0).status.demand, at(99).position, 1e-4);
    assert_eq!(b.ended(0, second), Outcome::Done);
    assert_near(b.feedback(0).status.demand, at(199).position, 1e-4);
    assert!(!b.kinds(0).contains(&EventKind::Underrun));
}

#[test]
fn rows_of_a_stream_that_was_stopped_are_never_run_whether_they_waited_or_came_later() {
    let mut b = Rig::new(1).ready();
    b.done(0, to(20.0));
    let at = |n: i32| row(20.0 + f64::from(n) * 0.02);
    (0..500).for_each(|n| b.sim.axis(0).push_row(at(n)).unwrap());
    let id = b.post(0, Command::Follow);
    b.run(100);
    b.world().unplug(address(0));
    // The producer looks at no event, and has not noticed yet.
    b.sim.run(20);
    assert_eq!(b.sim.feedback(0).stopped, Some(StopCause::LinkLost));
    assert_eq!(b.sim.axis(0).stream_room(), 1024);
    (500..530).for_each(|n| drop(b.sim.axis(0).push_row(at(n))));
    b.world().plug(address(0));
    b.run(300);
    assert_eq!(b.aborted(0, id), Abort::Stopped(StopCause::LinkLost));
    b.recover(0);
    b.done(0, to(20.0));
    let id = b.post(0, Command::Follow);
    b.run(50);
    assert_eq!((b.outcome(0, id), b.feedback(0).status.moving), (None, false));
    (0..10).for_each(|n| b.sim.axis(0).push_row(Row { last: n == 9, ..row(20.0) }).unwrap());
    assert_eq!(b.ended(0, id), Outcome::Done);
    assert_near(b.feedback(0).status.demand, 20.0, 1e-4);
}
