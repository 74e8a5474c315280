use Weight::{Counts, Held, Jumped};

use super::*;
use crate::axis::{FollowingError, Limits, StopPlan};

fn ranged() -> AxisPlan {
    let mut plan = AxisPlan::new("x", Units::millimetres(10_000.0));
    plan.limits = Limits { position: Some((0.0, 100.0)), velocity: Some(500.0), ..Limits::default() };
    plan.stop.deceleration = 1_000.0;
    plan
}

fn unranged() -> AxisPlan {
    let mut plan = ranged();
    plan.limits.position = None;
    plan
}

const RANGE: Watched = Watched { homing: false, braking: false };
const BRAKING: Watched = Watched { homing: false, braking: true };
const HOMING: Watched = Watched { homing: true, braking: true };
const SAMPLE: Sample = Sample {
    sent_at: Time(0),
    at: Time(0),
    homed: true,
    led: true,
    shown: 0.0,
    velocity: 0.0,
    position: 0.0,
    demand: 0.0,
    demand_velocity: 0.0,
};
const UNHOMED: Sample = Sample { homed: false, ..SAMPLE };
const TORQUE: Sample = Sample { led: false, ..SAMPLE };
const NONE: f64 = f64::NAN;

/// Positions and velocities at 1 kHz, all else as in `sample`; returns the report in which the watch trips.
fn broken_by(plan: &AxisPlan, watched: Watched, sample: Sample, reported: &[(f64, f64)]) -> Option<usize> {
    let mut watch = Watch::new(plan, MS, 0, 1);
    reported.iter().enumerate().position(|(index, &(shown, velocity))| {
        let at = Time(MS * index as u64);
        watch.take(Sample { sent_at: at, at, shown, velocity, ..sample }, Counts);
        watch.is_broken(watched)
    })
}

/// The same of the demands of a drive that reports no speed.
fn strikes(plan: &AxisPlan, watched: Watched, sample: Sample, demands: &[f64]) -> Option<usize> {
    let demands: Vec<_> = demands.iter().map(|demand| (*demand, NONE)).collect();
    broken_by(plan, watched, sample, &demands)
}

#[test]
fn under_torque_the_speed_and_the_place_of_the_motor_count_and_not_how_its_positions_change() {
    let free = |reported: &[(f64, f64)]| broken_by(&unranged(), BRAKING, TORQUE, reported);
    // 500 mm/s, with the margin of a measured speed; its position need not change for that.
    assert_eq!([590.0, 610.0, -610.0].map(|v| free(&[(50.0, v); 20])), [None, Some(2), Some(2)]);
    assert_eq!(free(&[10.0, 20.0, 30.0, 40.0].map(|at| (at, 0.0))), None, "noise is no speed");
    let broken = |reported: &[(f64, f64)]| broken_by(&ranged(), BRAKING, TORQUE, reported);
    // 400 mm/s needs 80 mm at 1000 mm/s²: it trips while there is room.
    let reported: Vec<_> = (0..250).map(|index| (f64::from(index) * 0.4, 400.0)).collect();
    let (place, velocity) = reported[broken(&reported).unwrap()];
    let end = place + velocity * 0.002 + velocity * velocity / 2_000.0;
    assert!((98.0..=100.001).contains(&end), "{end}");
    // From the outside in is allowed.
    assert_eq!([-10.0, 1.0].map(|v| broken(&[(105.0, v); 9])), [None, Some(2)]);
}

#[test]
fn no_speed_is_made_by_what_is_no_motion_or_was_held_up() {
    // Sent and taken in at these times in tenths of a ms, all at a true speed of `most`.
    let sample = |sent: u64, at: u64, shown: f64| Sample {
        sent_at: Time(sent * MS / 10),
        at: Time(at * MS / 10),
        shown,
        ..SAMPLE
    };
    // The demand that is reported under torque stays where it was, or follows something unknown.
    let torques = (0..40_u64).map(|n| match n / 4 % 2 {
        0 => sample(10 * n, 10 * n, 20.0),
        _ => Sample { led: false, ..sample(10 * n, 10 * n, 70.0) },
    });
    let again = [NONE, 90.0, 90.1, NONE, 10.0, 10.1].into_iter().zip((0..).step_by(10));
    let late = [(0, 0, 0.0), (10, 40, 0.4), (20, 40, 0.8), (90, 90, 3.6), (100, 100, 4.0)];
    for (what, most, samples) in [
        ("neither the begin nor the end of a torque", 0.0, torques.collect::<Vec<_>>()),
        (
            "a position that is reported again",
            100.0,
            again.map(|(at, ms)| Sample { homed: false, ..sample(ms, ms, at) }).collect(),
        ),
        ("held up", 400.0, late.map(|(sent, at, position)| sample(sent, at, position)).into()),
        // Requests at 1 kHz; the network holds replies up, and delivers them 0.3 ms apart.
        (
            "replies close together",
            400.0,
            (0..20).map(|n| sample(10 * n, 100 + 3 * n, 0.4 * n as f64)).collect(),
        ),
        (
            "requests close together",
            400.0,
            (0..20).map(|n| sample(3 * n, 100 + 10 * n, 0.4 * n as f64)).collect(),
        ),
    ] {
        let mut watch = Watch::new(&ranged(), MS, 0, 1);
        for (n, sample) in samples.into_iter().enumerate() {
            watch.take(sample, Counts);
            assert!(watch.speed() <= most * 1.000_001, "{what}, {n}: {}", watch.speed());
            assert!(!watch.is_broken(BRAKING), "{what}, {n}");
        }
    }
}

#[test]
fn a_drive_without_a_position_is_watched_by_its_speed_in_both_directions() {
    let at = |velocities: &[f64]| {
        let reported: Vec<_> = velocities.iter().map(|velocity| (NONE, *velocity)).collect();
        broken_by(&unranged(), BRAKING, UNHOMED, &reported)
    };
    assert_eq!(at(&[500.0, -500.0, 590.0, 590.0, -590.0, 590.0]), None);
    assert_eq!(at(&[500.0, 610.0, 610.0, 610.0]), Some(3));
    assert_eq!(at(&[500.0, -610.0, -610.0, -610.0]), Some(3));
    let disturbed = [700.0, 700.0, 500.0, 700.0, -700.0, 700.0, -700.0];
    assert_eq!(at(&disturbed), None, "a disturbance is no speed");
}

#[test]
fn a_speed_or_a_position_that_is_not_reported_is_not_inside_its_limits() {
    let mut without = unranged();
    without.limits.velocity = None;
    for (what, plan, sample, velocity, broken) in [
        ("homed, as it reports, but where?", &ranged(), SAMPLE, 100.0, Some(2)),
        ("it stands", &ranged(), SAMPLE, 0.0, None),
        ("not homed: nothing may move it", &ranged(), UNHOMED, 100.0, None),
        ("no speed", &unranged(), UNHOMED, NONE, Some(2)),
        ("without limits there is nothing to watch", &without, UNHOMED, NONE, None),
    ] {
        assert_eq!(broken_by(plan, BRAKING, sample, &[(NONE, velocity); 4]), broken, "{what}");
    }
}

#[test]
fn a_speed_over_its_limit_is_found_in_the_third_report_homed_or_not() {
    let line = |step: f64| (0..9).map(|index| f64::from(index) * step).collect::<Vec<f64>>();
    let (fast, just) = (line(0.6), line(0.5));
    assert_eq!([SAMPLE, UNHOMED].map(|sample| strikes(&ranged(), RANGE, sample, &fast)), [Some(3); 2]);
    assert_eq!(strikes(&ranged(), RANGE, SAMPLE, &just), None);
    assert_eq!(strikes(&ranged(), RANGE, SAMPLE, &[10.0, 20.0, 10.0, 20.0, 10.0]), None, "no speed: jumps");
    // A turn over the end of a rotary axis is a short way.
    let mut rotary = unranged();
    (rotary.units.modulo, rotary.units.unit) = (Some(1.0), Unit::Revolution);
    assert_eq!(strikes(&rotary, BRAKING, SAMPLE, &[0.8, 0.2, 0.6, 0.0]), None);
}

#[test]
fn the_range_holds_outward_only_and_only_when_homed() {
    let mut below = ranged();
    below.limits.position = Some((-50.0, 100.0));
    let out = [99.9, 100.1, 100.2, 100.3];
    for (plan, sample, demands, broken) in [
        (&ranged(), SAMPLE, &out[..], Some(3)),
        (&ranged(), UNHOMED, &out, None),
        (&ranged(), SAMPLE, &[103.0, 102.8, 102.6, 102.4], None),
        (&ranged(), SAMPLE, &[0.0, -0.2, -0.4, -0.6], Some(3)),
        (&below, SAMPLE, &[-0.2, -0.4, -0.6, -0.8, -1.0], None),
        (&below, SAMPLE, &[-49.9, -50.1, -50.3, -50.5], Some(3)),
    ] {
        assert_eq!(strikes(plan, RANGE, sample, demands), broken, "{demands:?}");
    }
    // Two counts may be due to rounding.
    for (end, broken) in [(100.0002, None), (100.0003, Some(2)), (-50.0002, None), (-50.0003, Some(2))] {
        assert_eq!(broken_by(&below, RANGE, TORQUE, &[(end, f64::signum(end)); 9]), broken, "{end}");
    }
}

#[test]
fn braking_begins_while_there_is_still_room() {
    // 400 mm/s needs 80 mm at 1000 mm/s².
    let demands: Vec<f64> = (0..250).map(|index| f64::from(index) * 0.4).collect();
    let broken = strikes(&ranged(), BRAKING, SAMPLE, &demands).unwrap();
    // Of the reports from 18.4 mm on the third one; 80 mm to brake, and 5 reports until a stop reaches it.
    assert_eq!(broken, 48);
    let end = demands[broken] + 400.0 * 0.002 + 400.0 * 400.0 / 2_000.0;
    assert!((98.0..=100.0).contains(&end), "{end}");
    assert_eq!(strikes(&ranged(), RANGE, SAMPLE, &demands), None);
}

/// Reports at 1 kHz of an axis at a constant velocity, by what its actual position is behind; whether the report
/// was clean. Returns the one in which it strays.
fn strays_at(plan: &AxisPlan, velocity: f64, reports: &[(f64, bool)]) -> Option<usize> {
    let mut watch = Watch::new(plan, MS, 2 * MS, 1);
    reports.iter().enumerate().position(|(index, &(behind, clean))| {
        let (at, shown) = (Time(MS * index as u64), velocity * 1e-3 * index as f64);
        if clean {
            watch.take(Sample { sent_at: at, at, shown, velocity, demand: behind, ..SAMPLE }, Counts);
        }
        let strays = watch.strays();
        watch.is_broken(RANGE);
        strays
    })
}

#[test]
fn an_axis_that_does_not_follow_its_demand_is_found_in_the_third_report() {
    let mut plan = ranged();
    plan.limits.following_error = FollowingError::Most(1.0);
    // 200 mm/s for 2 ms are no error.
    for (velocity, behind, found) in [
        (0.0, 0.999, None),
        (0.0, 1.001, Some(2)),
        (0.0, -1.001, Some(2)),
        // The velocity is that between two reports: it is known from the second one on.
        (200.0, 0.9, None),
        (200.0, 1.4 - 0.005, None),
        (200.0, 1.4 + 0.005, Some(2)),
        (-200.0, -1.4 + 0.005, None),
        (-200.0, -1.41, Some(2)),
        (200.0, -0.62, Some(3)),
        // No position is known.
        (0.0, NONE, None),
    ] {
        assert_eq!(strays_at(&plan, velocity, &[(behind, true); 9]), found, "{velocity} {behind}");
    }
    let (far, near, unclean) = ((5.0, true), (0.0, true), (0.0, false));
    assert_eq!(strays_at(&plan, 0.0, &[far, far, near, far, far, near, far, far]), None, "it comes back");
    assert_eq!(strays_at(&plan, 0.0, &[far, unclean, unclean, unclean]), None);
    assert_eq!(strays_at(&plan, 0.0, &[far, unclean, far, far]), Some(3));
    plan.units.modulo = Some(10.0);
    // A count that was unwrapped elsewhere is no error, and a whole turn is one.
    let around = 4_294_967_296.0 / 10_000.0;
    for (behind, found) in [(around, None), (around + 1.1, Some(2)), (10.0, Some(2))] {
        assert_eq!(strays_at(&plan, 0.0, &[(behind, true); 9]), found, "{behind}");
    }
}

#[test]
fn the_largest_following_error_follows_from_the_velocity_limit_and_the_age_of_the_position() {
    let (derived, most) = (FollowingError::Derived, FollowingError::Most(3.0));
    // 500 mm/s for 2 and 50 ms.
    for (window, velocity, following_error, behind_ns, wanted) in [
        (Some(0.5), Some(500.0), derived, 2 * MS, Some(26.5)),
        (None, Some(500.0), derived, 0, Some(25.0 + 4e-4)),
        (None, None, derived, 0, None),
        (None, None, most, 2 * MS, Some(3.0)),
        (None, Some(500.0), FollowingError::Off, 0, None),
    ] {
        let mut plan = ranged();
        plan.in_position.window = window;
        (plan.limits.velocity, plan.limits.following_error) = (velocity, following_error);
        let found = plan.most_following_error(behind_ns);
        let is_near = found.zip(wanted).is_none_or(|(found, wanted)| (found - wanted).abs() < 1e-9);
        assert!(found.is_some() == wanted.is_some() && is_near, "{found:?} instead of {wanted:?}");
        let strays = strays_at(&plan, 0.0, &[(1e9, true); 9]).is_some();
        assert_eq!(strays, wanted.is_some(), "without a limit there is none");
    }
}

#[test]
fn homing_has_a_speed_limit_of_its_own_and_no_range() {
    for (limit, speed, trips) in
        [(None, 490.0, None), (None, 600.0, Some(3)), (Some(50.0), 49.0, None), (Some(50.0), 60.0, Some(3))]
    {
        let mut plan = ranged();
        (plan.limits.homing, plan.limits.position) = (limit, Some((0.0, 1.0)));
        let reported: Vec<_> = (0..20).map(|n| (f64::from(n) * speed * 1e-3, speed)).collect();
        assert_eq!(broken_by(&plan, HOMING, SAMPLE, &reported), trips, "{limit:?} {speed}");
    }
}

/// 100 mm/s: it is allowed 1 m/s, over the time between its reports and 2 ms.
fn plan() -> AxisPlan {
    let mut plan = AxisPlan::new("x", Units::millimetres(10_000.0));
    plan.limits.velocity = Some(100.0);
    plan
}

/// Reports at 1 kHz, each taken in as it was sent: what becomes of each.
struct Line {
    watch: Watch,
    ms: u64,
    bound: Bound,
}

impl Line {
    /// It was there in the ms before.
    fn new(plan: &AxisPlan, position: f64) -> Line {
        let mut watch = Watch::new(plan, MS, 0, 1);
        watch.take(Sample { sent_at: Time(1_000 * MS), position, ..SAMPLE }, Counts);
        Line { watch, ms: 1_000, bound: Bound::Plan }
    }

    fn at(&mut self, position: f64) -> Weight {
        self.ms += 1;
        let at = Time(self.ms * MS);
        let mut sample = Sample { sent_at: at, at, position, demand: position, ..SAMPLE };
        if !self.watch.doubts() && self.watch.takes(sample) {
            return Counts;
        }
        let weight = self.watch.weigh(&mut sample, self.bound);
        self.watch.take(sample, weight);
        weight
    }
}

#[test]
fn a_place_out_of_reach_counts_for_nothing_until_the_next_report_agrees_with_it() {
    let end = 4_294_967_296.0 / 20_000.0;
    // The first is where it was; each comes so many ms later than usual.
    for (what, reports) in [
        ("3 mm in 3 ms", &[(0, 50.0, Counts), (0, 50.1, Counts), (0, 47.2, Counts)][..]),
        ("an old one", &[(0, 47.2, Counts), (0, 50.3, Held), (0, 47.3, Counts)]),
        (
            "two that agree",
            &[(0, 47.3, Counts), (0, 60.0, Held), (0, 60.1, Jumped(60.1 - 47.3)), (0, 60.2, Counts)],
        ),
        ("13 ms at 1 m/s", &[(0, 0.0, Counts), (10, 12.9, Counts)]),
        // 13.1, then 13.6 mm in 14 ms.
        ("after a held one as well", &[(0, 12.9, Counts), (10, 26.0, Held), (0, 26.5, Counts)]),
        (
            "those that agree with nothing make no axis blind",
            &[
                (0, 0.0, Counts),
                (0, 100.0, Held),
                (0, 200.0, Held),
                (0, 300.0, Held),
                (0, 400.0, Jumped(400.0)),
                (0, 400.1, Counts),
            ],
        ),
        ("a count wraps around", &[(0, end, Counts), (0, -end, Counts), (0, 0.1 - end, Counts)]),
    ] {
        let mut line = Line::new(&plan(), reports[0].1);
        for (late_ms, position, weight) in reports {
            line.ms += late_ms;
            let before = line.watch.last().position;
            assert_eq!(line.at(*position), *weight, "{what}: {position}");
            assert!(*weight != Held || line.watch.last().position == before, "what counted last: {what}");
        }
    }
}

#[test]
fn only_what_no_axis_reaches_is_out_of_reach_without_a_limit_or_without_power() {
    for (unit, limit, bound, places) in [
        (Unit::Millimetre, None, Bound::Plan, [0.0, 59.9, 120.0]),
        (Unit::Millimetre, Some(100.0), Bound::Fastest, [0.0, 59.9, 120.0]),
        (Unit::Revolution, None, Bound::Plan, [0.0, 1.49, 3.1]),
    ] {
        let mut plan = plan();
        (plan.units.unit, plan.limits.velocity) = (unit, limit);
        let mut line = Line { bound, ..Line::new(&plan, 0.0) };
        assert_eq!(places.map(|at| line.at(at)), [Counts, Counts, Held], "{unit:?} {bound:?}");
    }
    // Its origin changes.
    let mut line = Line { bound: Bound::None, ..Line::new(&plan(), 0.0) };
    assert_eq!(line.at(90.0), Counts);
    line.bound = Bound::Plan;
    assert_eq!(line.at(90.1), Counts);
}

/// Standstill below 5 mm/s.
fn stop() -> StopPlan {
    AxisPlan::new("x", Units::millimetres(1_000.0)).stop
}

/// The report, counted from 0, at which the watch trips; so many ms apart.
fn trips_at(
    phase: Phase,
    stop: &StopPlan,
    ms: u64,
    reports: impl IntoIterator<Item = (bool, f64)>,
) -> Option<usize> {
    let mut plan = plan();
    plan.stop = *stop;
    let mut watch = Watch::new(&plan, ms * MS, 0, 1);
    watch.expect(phase);
    reports.into_iter().enumerate().position(|(index, (moving, velocity))| {
        let report = DriveStatus { moving, velocity, ..DriveStatus::default() };
        watch.moves(Time(ms * MS * index as u64), &report)
    })
}

/// After a command that is done, at 1 kHz.
fn trips(reports: impl IntoIterator<Item = (bool, f64)>) -> Option<usize> {
    trips_at(Phase::Commanded, &stop(), 1, reports)
}

#[test]
fn three_reports_of_a_motion_in_one_direction_trip_it() {
    for (what, moving, velocity, tripped) in [
        ("forward", false, 6.0, Some(62)),
        ("backward", false, -6.0, Some(62)),
        ("the generator runs, however slowly", true, 1.0, Some(62)),
        ("the generator runs", true, f64::NAN, Some(62)),
        ("noise below the window", false, 4.9, None),
        ("no speed is known, and the generator stands", false, f64::NAN, None),
    ] {
        let reports = [[(false, 0.0); 60].as_slice(), &[(moving, velocity); 500]].concat();
        assert_eq!(trips(reports), tripped, "{what}");
    }
    let shaken = (0..560).map(|n| {
        (
            false,
            if n < 60 {
                0.0
            } else if n % 4 < 2 {
                50.0
            } else {
                -50.0
            },
        )
    });
    assert_eq!(trips(shaken), None, "a disturbance leads there and back again");
    // What comes with power that nobody switched on: at once.
    assert_eq!(trips_at(Phase::Resting, &stop(), 1, [(true, 1.0); 9]), Some(2));
}

#[test]
fn an_axis_settles_in_its_time_or_in_as_many_exchanges_as_prove_its_standstill_and_no_longer() {
    let ringing =
        (0..2_000).map(|n| (false, 300.0 * (f64::from(n) * 0.2).sin() * (-0.1 * f64::from(n)).exp()));
    assert_eq!(trips(ringing), None);
    assert_eq!(trips([(true, 40.0); 100]), Some(53), "done, and it goes on");
    for (standstill_for, tripped) in [(20, 23), (3, 8)] {
        let stop = StopPlan { standstill_for, ..stop() };
        let found = trips_at(Phase::Commanded, &stop, 10, [(false, 40.0); 99]);
        assert_eq!(found, Some(tripped), "{standstill_for} exchanges of 10 ms");
    }
}

#[test]
fn after_its_stop_an_axis_overshoots_no_more_than_its_stop_brakes_in_ten_milliseconds() {
    let stop = StopPlan { deceleration: 4_000.0, standstill: 5.0, ..stop() };
    let trips = |reports: &[f64]| trips_at(Phase::Stopping, &stop, 1, reports.iter().map(|v| (false, *v)));
    assert_eq!(trips(&[[0.0, 44.0].as_slice(), &[45.0; 30], &[0.0; 50]].concat()), None);
    assert_eq!(trips(&[[0.0].as_slice(), &[46.0; 30]].concat()), Some(3));
    // An old request starts it again, 4 m/s².
    let away: Vec<f64> = (0..30).map(|n| f64::from(n) * 4.0).collect();
    assert_eq!(trips(&away), Some(14));
    assert_eq!(trips(&[6.0; 60]), Some(53), "slowly: once it had time to settle");
}

#[test]
fn an_axis_whose_command_failed_brakes_and_does_not_speed_up() {
    let braking = |slope: f64| {
        let velocity = move |n: i32| (400.0 - slope * f64::from(n)).max(0.0);
        (0..4_000).map(move |n| (velocity(n) > 0.0, velocity(n)))
    };
    let away = braking(2.0).take(300).chain([(true, 20.0); 100]);
    for (what, reports, tripped) in [
        ("2 s", braking(0.2).collect::<Vec<_>>(), None),
        ("longer than the stop's time-out", braking(0.1).collect(), Some(3_001)),
        ("faster three times", (0..100).map(|n| (true, 100.0 + f64::from(n))).collect(), Some(8)),
        ("it stood, settled, and goes on", away.collect(), Some(302)),
    ] {
        assert_eq!(trips_at(Phase::Failed, &stop(), 1, reports), tripped, "{what}");
    }
}

#[test]
fn the_quick_limit_check_allows_only_permitted_values() {
    let random = &mut fastrand::Rng::with_seed(1);
    let value = |random: &mut fastrand::Rng| match random.u8(..12) {
        0 => f64::NAN,
        1 => f64::INFINITY,
        2 => f64::NEG_INFINITY,
        3 => f64::MAX,
        4 => f64::MIN,
        5 | 6 => 0.0,
        _ => (random.f64() - 0.5) * 400.0,
    };
    let (mut allowed, mut forbidden) = (0, 0);
    for _ in 0..100_000 {
        let mut plan = unranged();
        plan.limits.velocity = random.bool().then(|| random.f64() * 200.0);
        plan.limits.position = match random.u8(..5) {
            0 => None,
            1 => Some((0.0, f64::MAX)),
            2 => Some((f64::MIN, 100.0)),
            _ => Some((0.0, 100.0)),
        };
        let mut watch = Watch::new(&plan, MS, 0, 1);
        watch.velocity = value(random);
        let (homed, led) = (random.bool(), random.bool());
        watch.last = Sample { shown: value(random), homed, led, ..SAMPLE };
        let watched = Watched { homing: random.u8(..8) == 0, braking: random.bool() };
        let quick = watch.is_allowed(watched);
        assert!(!quick || !watch.is_forbidden(watched), "{watched:?} {watch:?}");
        (allowed, forbidden) =
            (allowed + u32::from(quick), forbidden + u32::from(watch.is_forbidden(watched)));
    }
    assert!(allowed > 10_000 && forbidden > 10_000, "{allowed} {forbidden}");
}
