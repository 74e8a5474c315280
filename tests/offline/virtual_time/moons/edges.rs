//! What the command word does, packet by packet.

use fieldbeat::axis::{Command, Jog};
use fieldbeat::bus::ethernet_ip::command;
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

/// With one idle packet before each command. A drive that acts on any change would not show it.
#[test]
fn no_absolute_move_fails_although_a_third_of_all_packets_is_lost() {
    for seed in 1..=4 {
        let mut plan = drive(0);
        (plan.hold, plan.fresh_within_ns) = (1, Some(50 * MS));
        let mut m = Moons::with(vec![plan], |settings| settings.firmware.edges = Edges::Strict);
        m.ready();
        m.sim.world().set_faults(m.io(0), FaultPlan { drop: 0.3, seed, ..FaultPlan::default() });
        let ends = (0..50).map(|n| m.end(0, go(f64::from(n % 7) / 10.0)));
        let failed = ends.filter(|end| *end != Some(Outcome::Done)).count();
        assert_eq!((failed, m.feedback(0).stopped), (0, None), "seed {seed}");
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
