//! What the command word does, packet by packet.

use fieldbeat::axis::{Command, Jog};
use fieldbeat::bus::ethernet_ip::command;
use fieldbeat_sim::ethernet_ip::Edges;

use super::*;

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

/// All idle packets before it are lost: it is no edge behind the command before.
#[test]
fn a_motion_without_an_edge_is_sent_again() {
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
        m.taps[0].lock().lose = Some((command::IDLE, u32::MAX));
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
    for place in (940..994).step_by(2) {
        let mut m = Moons::with(vec![drive(0)], |settings| {
            settings.motor.limits = Some((-100_000, LIMIT));
        });
        m.ready();
        m.post(0, jog(2.0));
        let place = f64::from(place) / 1_000.0;
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
