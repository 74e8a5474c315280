//! What the command word does, packet by packet.

use fieldbeat::axis::{Command, Failure, Jog, NativeOwner, Outcome};
use fieldbeat::bus::ethernet_ip::{Letters, Native, NativeOutput, NativeProfile, Outputs, command};
use fieldbeat::sim::ethernet_ip::Edges;

use super::*;

#[test]
fn every_command_is_an_edge_behind_idle_and_none_is_sent_twice() {
    let mut m = Moons::with(vec![drive(0)], |settings| settings.firmware.edges = Edges::Strict);
    m.ready();
    let before = m.count(0);
    m.done(0, go(1.0));
    m.post(0, jog(2.0));
    m.run(300);
    m.done(0, Command::Stop { deceleration: None });
    m.done(0, Command::Disable);
    m.run(20);
    let words = edges(&m.came(0, before));
    assert_eq!(
        words,
        [0, command::MOVE_ABSOLUTE, 0, command::JOG, 0, command::STOP, 0, command::DISABLE, 0],
        "{words:x?}"
    );
}

#[test]
fn velocities_come_no_faster_than_commands_can() {
    let plan = drive(0);
    let every_ms = plan.command_every_ns(MS) / MS;
    let mut m = Moons::new(vec![plan]);
    m.ready();
    m.post(0, Command::Velocity { acceleration: 50.0 });
    let before = m.count(0);
    for n in 0..2_000 {
        let velocity = 2.0 + f64::from(n % 100) / 50.0;
        m.sim.axis(0).set_velocity(velocity).unwrap();
        m.run(1);
    }
    let came = m.came(0, before);
    let begins: Vec<u64> = came
        .windows(2)
        .filter(|pair| pair[0].word == 0 && pair[1].word != 0)
        .map(|pair| m.slot(pair[1].at))
        .collect();
    assert!(begins.len() > 200, "{} velocities", begins.len());
    assert!(begins.windows(2).all(|pair| pair[1] - pair[0] >= every_ms), "{begins:?}");
    assert!(m.feedback(0).stopped.is_none());
}

#[test]
fn a_stop_whose_idle_packet_is_lost_is_sent_anew_at_once() {
    // A drive that takes no change between two commands for an edge.
    let mut m = Moons::with(vec![drive(0)], |settings| settings.firmware.edges = Edges::Strict);
    m.ready();
    m.post(0, jog(2.0));
    m.run(300);
    m.post(0, jog(3.0));
    let held = |m: &Moons| m.came(0, 0).last().is_some_and(|came| came.word == command::JOG_SPEED);
    while !held(&m) {
        m.run(1);
    }
    // All idle packets before the stop.
    m.taps[0].lock().lose = Some((0, 1));
    m.post(0, Command::Stop { deceleration: None });
    m.run(20);
    m.until("standstill", 100, |sim| !sim.feedback(0).status.moving);
}

/// A motion behind a command of which the drive has seen no end: the one is no edge behind the other.
#[test]
fn a_motion_whose_idle_packets_are_lost_is_sent_a_second_time() {
    let stop = Command::Stop { deceleration: None };
    for (before, word, motion) in [
        (go(1.0), command::MOVE_ABSOLUTE, go(2.0)),
        (stop, command::STOP, jog(3.0)),
        (jog(3.0), command::JOG_SPEED, jog(1.0)),
    ] {
        let mut m = Moons::with(vec![drive(0)], |settings| settings.firmware.edges = Edges::Strict);
        m.ready();
        m.done(0, go(1.0));
        if word != command::MOVE_ABSOLUTE {
            m.post(0, jog(2.0));
            m.run(300);
        }
        m.post(0, before);
        while m.came(0, 0).last().is_none_or(|came| came.word != word) {
            m.run(1);
        }
        m.taps[0].lock().lose = Some((0, u32::MAX));
        m.run(20);
        m.until("its end", 200, |sim| word == command::JOG_SPEED || !sim.feedback(0).status.moving);
        let count = m.count(0);
        m.post(0, motion);
        while m.count(0) == count {
            m.run(1);
        }
        m.taps[0].lock().lose = None;
        let arrived = |m: &Moons| match (motion, m.feedback(0).status) {
            (Command::Jog(jog), status) => (status.velocity - jog.velocity).abs() < 0.05,
            (_, status) => (status.demand - 2.0).abs() < 0.001,
        };
        assert!(!arrived(&m), "{motion:?}: it was no edge");
        m.run(1_500);
        assert!(arrived(&m), "{motion:?}: {:?}", m.truth(0));
        assert!(m.feedback(0).stopped.is_none());
    }
}

/// The drive ends a jog at its limit switch while another speed is under way to it, or is sent for the second time.
#[test]
fn another_speed_never_begins_a_jog_that_the_drive_has_ended() {
    // One revolution above where its position is set to 0.
    const LIMIT: i32 = 0;
    let mut ended = 0;
    for place in 70..100 {
        let mut m = Moons::with(vec![drive(0)], |settings| {
            settings.motor.limits = Some((-100_000, LIMIT));
        });
        m.ready();
        m.post(0, jog(2.0));
        let place = f64::from(place) / 100.0;
        m.until("its place", 2_000, |sim| sim.feedback(0).status.demand >= place);
        let before = m.count(0);
        m.post(0, jog(1.5));
        m.run(400);
        let words = edges(&m.came(0, before));
        assert!(!words.contains(&command::JOG), "{place}: {words:x?}");
        assert!(!m.feedback(0).status.moving, "{place}: {:?}", m.feedback(0));
        ended += u32::from(words.contains(&command::JOG_SPEED));
    }
    assert!(ended > 20, "{ended}");
}

#[test]
fn a_stop_is_never_flatter_than_it_shall_be() {
    // The moves of this axis end gently, and its stop does not.
    let gentle = Profile { deceleration: 5.0, ..PROFILE };
    for motion in [
        Command::Move(Move { target: Target::Absolute(30.0), profile: gentle }),
        Command::Jog(Jog { velocity: 5.0, acceleration: 5.0 }),
    ] {
        let mut m = Moons::new(vec![drive(0)]);
        m.ready();
        m.post(0, motion);
        m.until("its velocity", 3_000, |sim| sim.feedback(0).status.velocity > 4.9);
        m.post(0, Command::Stop { deceleration: Some(50.0) });
        m.run(130);
        assert!(m.truth(0).velocity.abs() < 100.0, "{motion:?}: {:?}", m.truth(0));
    }
}

#[test]
fn a_jog_that_follows_a_stop_at_once_is_not_lost() {
    let mut m = Moons::new(vec![drive(0)]);
    m.ready();
    for after in 0..30 {
        m.post(0, jog(4.0));
        m.until("its velocity", 1_000, |sim| sim.feedback(0).status.velocity > 3.9);
        m.post(0, Command::Stop { deceleration: None });
        m.run(after);
        m.post(0, jog(1.0));
        m.until("the other velocity", 2_000, |sim| (sim.feedback(0).status.velocity - 1.0).abs() < 0.05);
    }
}

#[test]
fn a_homing_whose_time_is_over_is_stopped() {
    let mut plan = drive(0);
    plan.axis.home_timeout = std::time::Duration::from_millis(300);
    plan.homing = plan.homing.map(|homing| Homing { distance: -200.0, ..homing });
    let mut m = Moons::new(vec![plan]);
    m.online();
    m.done(0, Command::Enable);
    assert!(matches!(m.end(0, Command::Home), Some(Outcome::Failed(Failure::TimedOut(_)))));
    m.run(100);
    assert!(m.truth(0).velocity.abs() < 1.0, "{:?}", m.truth(0));
    assert!(m.feedback(0).stopped.is_none() && !m.feedback(0).status.homed, "{:?}", m.feedback(0));
}

#[test]
fn native_commands_leave_once_each() {
    let mut m = Moons::new(vec![drive(0)]);
    m.ready();
    let mut native = m.sim.axis(0).native::<Native>().expect("it has native process data");
    m.post(0, Command::Native(NativeOwner::Master));
    m.run(50);
    let before = m.count(0);
    let segment = Outputs { command: command::EXECUTE_SEGMENT, register_1: 1, ..Outputs::default() };
    let host = Outputs {
        command: command::HOST,
        letters: Letters::new("SO").unwrap(),
        register_1: 0x4CB1,
        ..Outputs::default()
    };
    native.write(NativeOutput { outputs: host }).unwrap();
    native.write(NativeOutput { outputs: host }).unwrap();
    m.run(200);
    native.write(NativeOutput { outputs: segment }).unwrap();
    m.run(1_500);
    let words = edges(&m.came(0, before));
    assert_eq!(words, [0, command::HOST, 0, command::HOST, 0, command::EXECUTE_SEGMENT, 0], "{words:x?}");
    m.done(0, Command::Stop { deceleration: None });
    m.done(0, go(0.3));
}

#[test]
fn the_end_of_native_mode_begins_with_idle_and_the_stop_behind_it_is_an_edge() {
    let mut m = Moons::with(vec![drive(0)], |settings| settings.firmware.edges = Edges::Strict);
    m.ready();
    let mut native = m.sim.axis(0).native::<Native>().expect("it has native process data");
    m.post(0, Command::Native(NativeOwner::Application));
    m.run(50);
    assert!(native.inputs().running, "{:?}", m.sim.axis(0).event());
    let profile = NativeProfile { velocity: 480, acceleration: 300, deceleration: 300, distance: 2_000_000 };
    let outputs = Outputs {
        command: command::MOVE_RELATIVE,
        velocity: profile.velocity,
        acceleration: profile.acceleration,
        deceleration: profile.deceleration,
        distance: profile.distance,
        ..Outputs::default()
    };
    native.write(NativeOutput { outputs }).unwrap();
    m.run(300);
    assert!(
        m.truth(0).velocity > 10_000.0,
        "{:?}, {:x?}, {:?}",
        m.truth(0),
        edges(&m.came(0, 0)),
        m.feedback(0)
    );
    let before = m.count(0);
    let id = m.sim.axis(0).post(Command::Stop { deceleration: None }).unwrap();
    let end = m.sim.run_command(0, id, 2_000);
    assert_eq!(end, Some(Outcome::Done), "{:?}", m.feedback(0));
    let words = edges(&m.came(0, before));
    let stop = words.iter().position(|word| word & (command::STOP | command::STOP_FAST) != 0);
    assert!(stop.is_some_and(|at| words[at - 1] == 0), "{words:x?}");
    assert!(m.truth(0).velocity.abs() < 1.0);
}
