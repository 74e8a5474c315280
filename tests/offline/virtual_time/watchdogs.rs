//! When the application grows silent: velocities too old, jogs that nobody holds, and its heartbeat.

use fieldbeat::axis::{Abort, Command, Outcome, StopCause};
use fieldbeat::time::MS;

use crate::virtual_time::support::*;

const VELOCITY: Command = Command::Velocity { acceleration: 5_000.0 };

fn set(b: &mut Bench, velocity: f64) {
    b.sim.axis(0).set_velocity(velocity).unwrap();
}

#[test]
fn a_velocity_that_is_too_old_stops_the_axis_in_the_cycle_that_was_said() {
    for age in [1, 10, 50] {
        let mut b = Rig::new(1).each(|_, drive| drive.axis.setpoint_age = age).ready();
        let id = b.post(0, VELOCITY);
        for _ in 0..100 {
            set(&mut b, 50.0);
            b.step();
        }
        // The last one was taken in the last step; it counts for `age` cycles.
        b.run(u64::from(age));
        assert_eq!(b.feedback(0).stopped, None, "age {age}");
        b.run(1);
        assert_eq!(b.feedback(0).stopped, Some(StopCause::StaleSetpoint), "age {age}");
        assert_eq!(b.outcome(0, id), Some(Outcome::Aborted(Abort::Stopped(StopCause::StaleSetpoint))));
        b.run(200);
        assert!(!b.feedback(0).status.state.is_powered());
    }
}

#[test]
fn a_jog_without_renewal_stops() {
    let mut b = Rig::new(1)
        .each(|_, drive| drive.axis.jog_deadman = Some(std::time::Duration::from_millis(50)))
        .ready();
    // Held for as long as it is renewed, at whatever velocity.
    let id = b.post(0, jog(40.0));
    for turn in 0..20 {
        b.run(40);
        set(&mut b, 40.0 + f64::from(turn % 3));
    }
    assert_eq!((b.outcome(0, id), b.feedback(0).stopped), (None, None));
    b.run(1 + 50);
    assert_eq!(b.feedback(0).stopped, None);
    b.run(1);
    assert_eq!(b.feedback(0).stopped, Some(StopCause::DeadMan));
    assert_eq!(b.outcome(0, id), Some(Outcome::Aborted(Abort::Stopped(StopCause::DeadMan))));
    // A button that is released stops without a latch.
    b.run(300);
    b.recover(0);
    b.post(0, jog(-40.0));
    b.run(20);
    b.done(0, Command::Stop { deceleration: None });
    b.run(200);
    assert_eq!(b.feedback(0).stopped, None);
}

#[test]
fn a_silent_application_stops_what_is_enabled_and_nothing_else() {
    let beat = 30;
    let mut b = Rig::new(2).cycle(|cycle| cycle.heartbeat_ns = Some(beat * MS)).online();
    b.run(200);
    assert_eq!(b.feedback(0).stopped, None, "nothing is enabled, so that nothing can happen");
    // Blocking calls feed it while they wait; here somebody has to.
    let enabled = b.post(0, Command::Enable);
    b.until("enabled", 1_000, |b| {
        b.sim.alive();
        b.outcome(0, enabled).is_some()
    });
    for _ in 0..20 {
        b.run(25);
        b.sim.alive();
    }
    assert_eq!(b.feedback(0).stopped, None);
    // Any accepted command, row or velocity is a sign of life.
    for turn in 0..30 {
        b.run(25);
        match turn % 2 {
            0 => drop(b.post(0, Command::Stop { deceleration: None })),
            _ => set(&mut b, 1.0),
        }
    }
    assert_eq!(b.feedback(0).stopped, None);
    b.run(1 + beat);
    assert_eq!(b.feedback(0).stopped, None);
    b.run(1);
    assert_eq!(b.feedback(0).stopped, Some(StopCause::Heartbeat));
    assert_eq!(b.feedback(1).stopped, None, "it was not enabled");
    b.run(300);
    assert!(!b.feedback(0).status.state.is_powered());
}

#[test]
fn an_application_that_dies_while_it_enables_moves_nothing() {
    let beat = 50;
    let mut b = Rig::new(1).cycle(|cycle| cycle.heartbeat_ns = Some(beat * MS)).online();
    b.post(0, Command::Enable);
    let home = b.post(0, Command::Home);
    assert_eq!(b.stopped(0, beat + 3), StopCause::Heartbeat);
    assert_eq!(b.outcome(0, home), Some(Outcome::Aborted(Abort::Stopped(StopCause::Heartbeat))));
    b.run(1_000);
    assert!(!b.feedback(0).status.state.is_powered());
    assert!(b.tape(0).received.iter().all(|received| {
        received.reply.is_none_or(|reply| reply.status.is_none_or(|status| !status.operation_enabled()))
    }));
}
