//! Moves over the end of the 32-bit counts: a drive is sent there by the distance (FL), once, since no position behind
//! the end has a count.

use fieldbeat::bus::ethernet_ip::command;
use fieldbeat_sim::ethernet_ip::Edges;

use super::*;

/// Steps of a revolution.
const REV: f64 = 20_000.0;

/// An axis that turns without end, whose drive counts so many steps when the master comes.
fn turns(start: i32, more: impl Fn(&mut MoonsDrive)) -> Moons {
    let mut plan = drive(0);
    plan.axis.units.modulo = Some(1.0);
    more(&mut plan);
    let mut m = Moons::with(vec![plan], |settings| {
        settings.motor.start = start;
        settings.firmware.edges = Edges::Strict;
    });
    m.online();
    m.done(0, Command::Enable);
    m
}

fn by(distance: f64) -> Command {
    Command::Move(Move { target: Target::Relative(distance), profile: PROFILE })
}

/// The words of moves that have come, and how far the motor has turned meanwhile, revolutions.
fn moved(m: &mut Moons, does: impl FnOnce(&mut Moons)) -> (Vec<u32>, f64) {
    let (before, from) = (m.count(0), m.truth(0).position);
    does(m);
    let words = edges(&m.came(0, before));
    let moves = [command::MOVE_RELATIVE, command::MOVE_ABSOLUTE];
    (words.into_iter().filter(|word| moves.contains(word)).collect(), (m.truth(0).position - from) / REV)
}

#[track_caller]
fn near(turned: f64, distance: f64) {
    assert!((turned - distance).abs() < 1e-3, "{turned} instead of {distance}");
}

#[test]
fn a_move_over_the_end_of_the_counts_goes_by_its_distance_and_all_others_to_their_place() {
    // Half a revolution in front of the end.
    let mut m = turns(i32::MAX - 10_000, |_| {});
    let (relative, absolute) = (command::MOVE_RELATIVE, command::MOVE_ABSOLUTE);
    for (distance, word) in [
        (0.25, absolute),
        (1.5, relative),
        (-0.75, absolute),
        (-3.0, relative),
        (4.2, relative),
        (1.0, absolute),
    ] {
        let (words, turned) = moved(&mut m, |m| m.done(0, by(distance)));
        assert_eq!(words, [word], "{distance}");
        near(turned, distance);
    }
    // To a place, the shorter way over the end.
    let mut m = turns(i32::MIN + 100, |_| {});
    let place = m.feedback(0).status.position;
    let (words, turned) = moved(&mut m, |m| m.done(0, go((place - 0.4).rem_euclid(1.0))));
    assert_eq!(words, [relative]);
    near(turned, -0.4);
}

#[test]
fn an_axis_that_moves_already_stops_first_and_goes_by_what_is_left() {
    let mut m = turns(i32::MAX - 60_000, |_| {});
    m.post(0, jog(4.0));
    m.until("its velocity", 2_000, |sim| sim.feedback(0).status.velocity > 3.9);
    let demand = m.feedback(0).status.demand;
    let end = (demand + 0.5).rem_euclid(1.0);
    let (words, _) = moved(&mut m, |m| m.done(0, by(5.5)));
    assert_eq!(words, [command::MOVE_RELATIVE]);
    m.run(100);
    // It has begun some packets after this demand.
    let off = (m.feedback(0).status.demand - end).rem_euclid(1.0);
    assert!(off < 0.2, "{off}");
}

/// Whatever is lost, the motor has turned by the distance if the command is done, and by no more if it is not.
#[test]
fn lost_packets_never_repeat_a_relative_move() {
    let (mut ends, mut relative) = ([0; 2], 0);
    for seed in 0..24 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut m = turns(i32::MAX - 10_000, |plan| {
            (plan.hold, plan.fresh_within_ns, plan.effect_within_ns) = (1, Some(200 * MS), 60 * MS);
        });
        let drop = [0.1, 0.3, 0.5][random.usize(..3)];
        m.sim.world().set_faults(m.io(0), FaultPlan { drop, duplicate: 0.2, seed, ..FaultPlan::default() });
        for _ in 0..12 {
            let is_over = m.truth(0).position > f64::from(i32::MAX);
            let distance = (0.6 + random.f64()) * if is_over { -1.0 } else { 1.0 };
            // All packets to the drive with its command, or with idle, are lost for a while; or those from it.
            m.taps[0].lock().lose = match random.u8(..4) {
                0 => Some((command::MOVE_RELATIVE, random.u32(..20))),
                1 => Some((command::IDLE, random.u32(..20))),
                _ => None,
            };
            m.mute(0, random.u8(..4) == 0);
            let mut end = None;
            let (words, turned) = moved(&mut m, |m| {
                let id = m.sim.axis(0).post(by(distance)).unwrap();
                m.run(random.u64(1..120));
                m.mute(0, false);
                end = m.sim.run_command(0, id, 20_000);
                m.taps[0].lock().lose = None;
                m.run(2_000);
            });
            let done = end == Some(Outcome::Done);
            ends[usize::from(done)] += 1;
            relative += u32::from(words == [command::MOVE_RELATIVE]);
            let share = turned / distance;
            let least = if done { 1.0 } else { 0.0 };
            assert!(
                (least - 1e-3..1.0 + 1e-3).contains(&share),
                "seed {seed}: {turned} of {distance}: {end:?}, {words:x?}"
            );
            if m.feedback(0).stopped.is_some() || !m.feedback(0).is_operational() {
                m.sim.world().set_faults(m.io(0), FaultPlan::default());
                m.until("online", 20_000, |sim| sim.feedback(0).link == Link::Online);
                m.run(500);
                m.done(0, Command::Reset);
                m.done(0, Command::Enable);
            }
        }
    }
    assert!(ends.iter().all(|count| *count > 20) && relative > 100, "{ends:?}, {relative} by their distance");
}

#[test]
fn a_connection_that_ends_takes_a_distance_with_it() {
    for at in [1, 5, 20, 60, 200] {
        let mut m = turns(i32::MAX - 10_000, |_| {});
        let (_, turned) = moved(&mut m, |m| {
            m.post(0, by(2.0));
            m.run(at);
            m.mute(0, true);
            m.until("its loss", 20_000, |sim| sim.feedback(0).link == Link::Lost);
            m.mute(0, false);
            m.until("back", 60_000, |sim| sim.feedback(0).link == Link::Online);
            m.done(0, Command::Reset);
            m.done(0, Command::Enable);
            m.run(2_000);
        });
        assert!((-1e-3..2.001).contains(&turned), "{at}: {turned}");
        // It is where it says, and goes on from there.
        let (_, turned) = moved(&mut m, |m| m.done(0, by(-1.0)));
        near(turned, -1.0);
    }
}

/// A linear axis has no way over the end of its counts: both ends of it are far apart, and it goes back all the way.
#[test]
fn a_linear_axis_goes_back_from_one_end_of_its_counts_to_the_other() {
    let far = 1_500_000_000;
    for start in [far, -far] {
        let mut m = Moons::with(vec![drive(0)], |settings| settings.motor.start = start);
        m.online();
        m.done(0, Command::Enable);
        let (words, turned) = moved(&mut m, |m| {
            m.post(0, go(f64::from(-start) / REV));
            m.run(2_000);
        });
        assert_eq!(words, [command::MOVE_ABSOLUTE], "{start}");
        assert!(turned * f64::from(start) < -1.0, "{start}: turned {turned}");
    }
    // Behind the end there is no position.
    let mut m = Moons::with(vec![drive(0)], |settings| settings.motor.start = i32::MAX - 10_000);
    m.online();
    m.done(0, Command::Enable);
    let (words, turned) = moved(&mut m, |m| {
        let end = m.end(0, by(1.0));
        assert!(matches!(end, Some(Outcome::Failed(_))), "{end:?}");
    });
    assert!(words.is_empty());
    near(turned, 0.0);
}
