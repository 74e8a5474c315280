//! An application that drops its axes: what moves then, and what does not.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use fieldbeat::axis::{Axis, Command, NativeOwner, OwnerLost, Row, StopCause, StopThen};
use fieldbeat::bus::linudp::motion::{Acceleration, MotionCommand, Position, Velocity};
use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan, Native, NativeOutput};
use fieldbeat::sim::WorldOptions;
use fieldbeat::time::MS;
use fieldbeat::{Flow, Master, Plan};

use super::replay::{Log, verdict};
use super::support::*;

/// A kind of motion, and what begins it.
type Motion = (&'static str, fn(&mut Bench));

/// Each of them, under way.
const MOTIONS: [Motion; 6] = [
    ("move", |b| {
        b.post(0, slowly_to(150.0));
    }),
    ("jog", |b| {
        b.post(0, jog(20.0));
    }),
    ("velocity", |b| {
        b.post(0, Command::Velocity { acceleration: 5_000.0 });
        b.sim.axis(0).set_velocity(20.0).unwrap();
    }),
    ("stream", |b| {
        let row = |n: u32| Row { position: 0.02 * f64::from(n), velocity: 20.0, ..Row::default() };
        (0..1_000).for_each(|n| b.sim.axis(0).push_row(row(n)).unwrap());
        b.post(0, Command::Follow);
    }),
    ("homing", |b| {
        b.done(0, to(40.0));
        b.post(0, Command::Home);
    }),
    ("native", |b| {
        let mut native = b.sim.axis(0).native::<Native>().unwrap();
        b.post(0, Command::Native(NativeOwner::Master));
        b.run(10);
        let ramp = Acceleration(100_000);
        let (to, slowly) = (Position::from_mm(150.0).unwrap(), Velocity::from_mm_per_s(20.0).unwrap());
        let motion = MotionCommand::vai_go_to(to, slowly, ramp, ramp);
        native.write(NativeOutput { motion: Some(motion), ..NativeOutput::default() }).unwrap();
    }),
];

/// One drive, ready and with setpoints that are not too old for as long as this lasts.
fn ready(lost: OwnerLost, then: StopThen) -> Bench {
    let rig = Rig::new(1).each(|_, drive| {
        drive.axis.on_owner_lost = lost;
        drive.axis.stop.then = then;
        drive.axis.setpoint_age = 100_000;
        drive.axis.jog_deadman = Some(Duration::from_secs(100));
    });
    rig.ready()
}

#[test]
fn an_axis_that_is_dropped_in_motion_is_stopped_in_the_next_cycle_and_rests_as_its_stop_says() {
    for (name, motion) in MOTIONS {
        for then in [StopThen::Disable, StopThen::Hold] {
            let mut b = ready(OwnerLost::Stop, then);
            motion(&mut b);
            b.run(7);
            b.drop_axis(0);
            assert_eq!(b.feedback(0).stopped, None, "{name}");
            b.run(1);
            assert_eq!(b.feedback(0).stopped, Some(StopCause::OwnerLost), "{name}");
            b.run(300);
            let rests = b.feedback(0).status;
            b.run(1_000);
            let later = b.feedback(0).status;
            assert!(!later.moving && later.position < 50.0, "{name}: {later:?}");
            assert_near(later.position, rests.position, 0.01);
            assert_eq!(later.state.is_powered(), then == StopThen::Hold, "{name}");
        }
    }
}

#[test]
fn an_axis_may_go_on_without_its_owner() {
    let mut b = ready(OwnerLost::Finish, StopThen::Disable);
    b.post(0, slowly_to(10.0));
    b.post(0, slowly_to(20.0));
    b.run(7);
    b.drop_axis(0);
    b.run(3_000);
    assert_eq!(b.feedback(0).stopped, None);
    assert_near(b.feedback(0).status.position, 20.0, 0.1);
    // Only the dead-man would end it.
    let mut b = ready(OwnerLost::Finish, StopThen::Disable);
    b.post(0, jog(5.0));
    b.run(7);
    b.drop_axis(0);
    b.run(60_000);
    assert!(b.feedback(0).status.position > 150.0, "{:?}", b.feedback(0));
}

#[test]
fn an_axis_that_stands_still_is_left_alone_and_so_is_one_that_stops_already() {
    let mut b = ready(OwnerLost::Stop, StopThen::Disable);
    b.done(0, slowly_to(5.0));
    b.drop_axis(0);
    b.run(1_000);
    assert_eq!(b.feedback(0).stopped, None);
    assert!(b.feedback(0).status.state.is_powered());

    for stop in [Command::Stop { deceleration: None }, Command::QuickStop, Command::Disable] {
        let mut b = ready(OwnerLost::Stop, StopThen::Disable);
        b.post(0, slowly_to(150.0));
        b.run(200);
        b.post(0, stop);
        b.drop_axis(0);
        b.run(1_000);
        assert_eq!(b.feedback(0).stopped, None, "{stop:?}");
        let rests = b.feedback(0).status;
        assert!(!rests.moving && rests.position < 10.0, "{stop:?}: {rests:?}");
    }

    // Before its drive is there, and never enabled.
    let mut b = Rig::new(1).start();
    b.drop_axis(0);
    b.online().run(100);
    assert_eq!(b.feedback(0).stopped, None);
}

/// Between the two looks of a cycle into what was posted.
#[test]
fn a_stop_that_is_posted_before_the_drop_comes_first_whenever_both_come() {
    let owner = Arc::new(Mutex::new(None::<Axis>));
    let of_task = Arc::clone(&owner);
    let mut b = Rig::new(1)
        .task(move |_, _| {
            if let Some(mut axis) = of_task.lock().unwrap().take() {
                axis.post(Command::Stop { deceleration: None }).unwrap();
            }
        })
        .ready();
    b.post(0, slowly_to(150.0));
    b.run(200);
    *owner.lock().unwrap() = Some(b.take_axis(0));
    b.run(500);
    assert!(owner.lock().unwrap().is_none());
    let rests = b.feedback(0);
    assert_eq!(rests.stopped, None);
    assert!(!rests.status.moving && rests.status.position < 10.0, "{rests:?}");
}

#[test]
fn a_command_posted_before_the_drop_does_not_begin_after_it() {
    // All of it is behind the same bell.
    let mut b = ready(OwnerLost::Stop, StopThen::Disable);
    b.done(0, slowly_to(5.0));
    b.post(0, slowly_to(150.0));
    b.drop_axis(0);
    b.run(1_000);
    assert_eq!(b.feedback(0).stopped, Some(StopCause::OwnerLost));
    assert_near(b.feedback(0).status.position, 5.0, 0.1);
    // More than the loop takes out of the queue at once: the rest is taken when there is room, and refused.
    let mut b = Rig::new(1).each(|_, drive| drive.axis.command_queue = 4).ready();
    for command in [Command::Home, slowly_to(5.0), Command::Home, slowly_to(10.0)] {
        b.post(0, command);
    }
    b.drop_axis(0);
    b.run(3_000);
    assert_eq!(b.feedback(0).stopped, Some(StopCause::OwnerLost));
    assert!(b.feedback(0).status.position < 1.0);
    // Nor does its power come on.
    let mut b = Rig::new(1).online();
    b.post(0, Command::Enable);
    b.drop_axis(0);
    b.run(1_000);
    assert_eq!(b.feedback(0).stopped, Some(StopCause::OwnerLost));
    assert!(b.tape(0).received.iter().all(|received| {
        received.reply.is_none_or(|reply| reply.status.is_none_or(|status| !status.operation_enabled()))
    }));
    // Nor that of an axis that was stopped before, by a reset that comes first.
    let mut b = ready(OwnerLost::Stop, StopThen::Disable);
    b.world().delay_next_wake(50 * MS);
    b.run(1_000);
    assert_eq!(b.feedback(0).stopped, Some(StopCause::Overrun));
    assert!(!b.feedback(0).status.state.is_powered());
    b.post(0, Command::Reset);
    b.post(0, Command::Enable);
    b.post(0, slowly_to(150.0));
    b.drop_axis(0);
    for _ in 0..1_000 {
        b.run(1);
        assert!(!b.feedback(0).status.state.is_powered());
    }
}

/// Two of one stop group, and one alone.
fn joined() -> Bench {
    let mut b = Rig::new(3).each(|index, drive| drive.axis.stop.group = (index < 2).then_some(1)).ready();
    b.join(&[0, 1]);
    b.group().post_all(slowly_to(150.0)).unwrap();
    b.run(200);
    b
}

#[test]
fn a_dropped_group_stops_its_own_members_only() {
    let mut b = joined();
    b.drop_group();
    b.run(1);
    for index in [0, 1] {
        let stopped = b.feedback(index).stopped;
        assert!(matches!(stopped, Some(StopCause::OwnerLost | StopCause::Group)), "{index}: {stopped:?}");
    }
    b.run(1_000);
    let rests = [0, 1].map(|index| b.feedback(index).status);
    assert!(rests.iter().all(|status| !status.state.is_powered() && status.position < 10.0), "{rests:?}");
    assert_near(rests[0].position, rests[1].position, 0.01);
    assert_eq!(b.feedback(2).stopped, None);
}

#[test]
fn a_member_that_is_dropped_alone_stops_those_of_its_group_that_are_kept() {
    for kept in [0, 1] {
        let mut b = joined();
        let owner = b.keep_member(kept);
        b.run(1);
        assert_eq!(b.feedback(1 - kept).stopped, Some(StopCause::OwnerLost));
        assert_eq!(b.feedback(kept).stopped, Some(StopCause::Group));
        b.run(1_000);
        assert!([0, 1].iter().all(|index| !b.feedback(*index).status.state.is_powered()));
        drop(owner);
        b.run(10);
        assert_eq!(b.feedback(kept).stopped, Some(StopCause::Group), "the first cause stays");
    }
}

#[test]
fn commands_of_the_in_loop_task_have_an_owner() {
    let begins = 2_000;
    let mut b = Rig::new(1)
        .task(move |cycle, axes| {
            if cycle.index == begins {
                axes.command(0, slowly_to(20.0)).unwrap();
            }
        })
        .ready();
    b.run(begins + 100 - b.feedback(0).cycle);
    assert!(b.feedback(0).status.moving);
    b.drop_axis(0);
    b.run(2_000);
    assert_eq!(b.feedback(0).stopped, None);
    assert_near(b.feedback(0).status.position, 20.0, 0.1);
}

#[test]
fn a_run_in_which_an_axis_is_dropped_is_repeated() {
    let plan = || {
        let drive = LinUdpDrive::new("x", [10, 0, 0, 10].into());
        let bus = LinUdpPlan::new([10, 0, 0, 1].into(), vec![drive]);
        Plan { buses: vec![Box::new(bus)], ..Plan::default() }
    };
    let log = Log::default();
    let mut machine = log.of(Master::from_plan(plan())).simulate(WorldOptions::default()).unwrap();
    let turns = |machine: &mut fieldbeat::Simulation, count| {
        for _ in 0..count {
            machine.step();
            log.drain();
        }
    };
    turns(&mut machine, 2_000);
    for command in [Command::Enable, Command::Home] {
        machine.axis(0).post(command).unwrap();
        turns(&mut machine, 3_000);
    }
    machine.axis(0).post(slowly_to(150.0)).unwrap();
    turns(&mut machine, 100);
    drop(machine.take_axis(0));
    turns(&mut machine, 500);
    assert_eq!(machine.feedback(0).stopped, Some(StopCause::OwnerLost));
    machine.stop();
    while machine.step() == Flow::Continue {
        log.drain();
    }
    for words in log.words() {
        let verdict = verdict(plan(), words);
        assert!(verdict.is_equal(), "{verdict:?}");
        assert!(verdict.telegrams > 5_000, "{verdict:?}");
    }
}
