//! How far and how fast: limits on submission and in the loop, jogs on their leash, axes that turn on and on.

use fieldbeat::axis::{Command, Failure, Jog, Move, Profile, Row, Target, Unit, Units};
use fieldbeat_sim::linudp::LinMotSettings;

use crate::virtual_time::support::*;

#[test]
fn nan_and_values_beyond_the_limits_are_refused_on_submission() {
    let mut b = Rig::new(1).ready();
    let first = b.post(0, Command::Reset).0;
    let before = b.tape(0).received.len();
    let refused =
        |b: &mut Bench, command: Command| b.sim.axis(0).post(command).expect_err("refused").to_string();
    for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for command in [
            to(value),
            by(value),
            with(Target::Absolute(10.0), value, 1_000.0),
            with(Target::Absolute(10.0), 10.0, value),
            jog(value),
            Command::Jog(Jog { velocity: 1.0, acceleration: value }),
            Command::Stop { deceleration: Some(value) },
        ] {
            let reported = refused(&mut b, command);
            assert!(reported.contains("finite"), "{command:?}: {reported}");
        }
        let rows = [
            row(value),
            fieldbeat::axis::Row { velocity: value, ..row(1.0) },
            fieldbeat::axis::Row { acceleration: value, ..row(1.0) },
        ];
        for row in rows {
            assert!(b.sim.axis(0).push_row(row).unwrap_err().to_string().contains("finite"));
        }
    }
    let slow = Profile { velocity: 10.0, acceleration: 10.0, deceleration: 10.0 };
    let in_range = Target::Absolute(10.0);
    for command in [
        to(-0.001),
        to(200.001),
        with(in_range, 1_000.1, 10.0),
        with(in_range, 10.0, 20_001.0),
        with(in_range, 0.0, 10.0),
        with(in_range, -1.0, 10.0),
        Command::Move(Move { target: in_range, profile: Profile { deceleration: 0.0, ..slow } }),
        Command::Move(Move { target: in_range, profile: Profile { deceleration: 20_001.0, ..slow } }),
        jog(1_001.0),
        jog(-1_001.0),
        Command::Jog(Jog { velocity: 1.0, acceleration: 0.0 }),
        Command::Jog(Jog { velocity: 1.0, acceleration: 20_001.0 }),
        Command::Stop { deceleration: Some(0.0) },
        Command::Stop { deceleration: Some(-5.0) },
    ] {
        let reported = refused(&mut b, command);
        let named = reported.contains("outside its limit") || reported.contains("must be above 0");
        assert!(named, "{command:?}: {reported}");
    }
    for row in [row(-0.001), row(200.1), fieldbeat::axis::Row { velocity: -1_000.1, ..row(5.0) }] {
        assert!(b.sim.axis(0).push_row(row).is_err());
    }
    assert_eq!(b.post(0, Command::Reset).0, first + 1, "what is refused has no id");
    b.run(10);
    assert!(b.tape(0).received[before..].iter().all(|received| received.request.motion.is_none()));
    b.done(0, with(Target::Absolute(200.0), 1_000.0, 20_000.0));
    b.done(0, to(0.0));
}

#[test]
fn a_jog_reaches_its_speed_and_never_runs_further_ahead_than_its_leash() {
    const LEASH: f64 = 20.0;
    for velocity in [5.0, 100.0, -100.0, 300.0] {
        let mut b = Rig::new(1)
            .each(|_, drive| {
                drive.axis.limits.position = Some((-1_000.0, 1_000.0));
                drive.simulate.range = (-10_100_000, 10_100_000);
            })
            .ready();
        b.tape(0).received.clear();
        let id = b.post(0, jog(velocity));
        b.run(100);
        for _ in 0..20 {
            b.run(100);
            assert_near(b.feedback(0).status.velocity, velocity, velocity.abs() * 0.02 + 0.2);
            assert!(b.feedback(0).status.moving);
        }
        assert_eq!(b.outcome(0, id), None);
        for received in b.tape(0).received.iter() {
            let Some(motion) = received.request.motion else { continue };
            assert_eq!(motion.header >> 4, 0x010, "go to position");
            let target = f64::from(i32::from_le_bytes(motion.parameters[..4].try_into().unwrap())) / PER_MM;
            let demand = f64::from(received.reply.unwrap().demand.unwrap()) / PER_MM;
            assert!((target - demand).abs() <= LEASH, "{target} is more than a leash from {demand}");
        }
        // The master dies: the drive receives nothing any more.
        let demand = b.feedback(0).status.demand;
        b.world().unplug(address(0));
        b.run(3_000);
        b.world().plug(address(0));
        b.until("seen", 500, |b| b.feedback(0).age == 0);
        assert!((b.feedback(0).status.demand - demand).abs() <= LEASH + velocity.abs() * 0.005);
    }
}

#[test]
fn an_axis_in_motion_brakes_before_its_limit_under_any_replacement_of_its_motion() {
    // Each of these would need far more way than there is, with the requested deceleration.
    let weak = 500.0;
    let slow = Profile { velocity: 10.0, acceleration: weak, deceleration: weak };
    for replacement in [
        Command::Stop { deceleration: Some(weak) },
        Command::Move(Move { target: Target::Absolute(100.0), profile: slow }),
        Command::Move(Move { target: Target::Absolute(199.0), profile: slow }),
        Command::Jog(Jog { velocity: -20.0, acceleration: weak }),
        Command::Jog(Jog { velocity: 20.0, acceleration: weak }),
    ] {
        let mut b = Rig::new(1).ready();
        b.post(0, with(Target::Absolute(199.9), 500.0, 10_000.0));
        b.until("near the end", 1_000, |b| b.feedback(0).status.demand > 180.0);
        assert!(b.feedback(0).status.velocity > 400.0);
        b.post(0, replacement);
        b.run(1_500);
        let (_, high) = b.tape(0).demand.unwrap();
        assert!(high <= RANGE.1, "{replacement:?} went to {high}");
        assert_eq!(b.feedback(0).stopped, None);
    }
}

#[test]
fn a_rotary_axis_turns_on_over_the_end_of_its_counts() {
    let mut b = Rig::new(1)
        .each(|_, drive| {
            drive.axis.units =
                Units { unit: Unit::Millimetre, modulo: Some(20.0), ..Units::millimetres(PER_MM) };
            drive.axis.limits.position = None;
            drive.simulate.range = LinMotSettings::ENDLESS;
            // 10 mm before the end, and homed 5 mm before it.
            drive.simulate.start_position = i32::MAX - 100_000;
            drive.simulate.home_position = i32::MAX - 50_000;
        })
        .ready();
    let wire = |b: &Bench| b.tape(0).last().demand.unwrap();
    let home = b.feedback(0).status.demand;
    assert_eq!(wire(&b), i32::MAX - 50_000);
    for (distance, count) in [(8.0, i32::MIN + 29_999), (-8.0, i32::MAX - 50_000), (8.0, i32::MIN + 29_999)] {
        b.done(0, by(distance));
        assert_eq!(wire(&b), count, "over the end by {distance} mm");
    }
    assert_near(b.feedback(0).status.demand, (home + 8.0).rem_euclid(20.0), 1e-3);
    // Back by the shorter way.
    b.done(0, to(home));
    assert_eq!(wire(&b), i32::MAX - 50_000);
    let id = b.post(0, jog(100.0));
    b.run(200);
    assert_eq!(b.outcome(0, id), None);
    assert_near(b.feedback(0).status.velocity, 100.0, 3.0);
    assert!(wire(&b) < 0, "past the end");
    b.done(0, Command::Stop { deceleration: None });
    b.done(0, to(home));
    // In a stream, too; here it is a whole number of turns from the home position.
    let from = b.feedback(0).status.demand;
    let before = wire(&b);
    for n in 0..=600 {
        let position = (from + f64::from(n) * 0.08).rem_euclid(20.0);
        b.sim.axis(0).push_row(Row { velocity: 80.0, last: n == 600, ..row(position) }).unwrap();
    }
    b.done(0, Command::Follow);
    assert_eq!(wire(&b), before.wrapping_add(480_000));
    // Farther than half of all counts there is no shorter way.
    let far = b.failed(0, by(300_000.0));
    assert!(matches!(far, Failure::Range(_)), "{far}");
    // It is rounded to nothing.
    let slow = b.failed(0, with(Target::Absolute(home), 1e-9, 100.0));
    assert!(matches!(slow, Failure::Range(_)), "{slow}");
}
