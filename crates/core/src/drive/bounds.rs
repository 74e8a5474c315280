//! Bounds of the drive's demand while the axis is enabled, whatever commands it: the drive's own programs, its
//! panel, or an application that writes the native process data.
//!
//! Moves, jogs and rows are checked before they are sent, so this watch finds nothing wrong with them. A drive that
//! reports no demand is watched by its actual speed, one under torque by its actual speed and position. How much
//! speed such a drive gains until a stop reaches it is not known; the way it makes is longer by as much.
//!
//! In a motion the axis must also follow its demand. What its actual position is compared with is the demand of that
//! time: the demand of the report, less the way at its velocity in the age of the position.

use crate::axis::units::way;
use crate::axis::{AxisPlan, Units};
use crate::time::Time;

/// One clean report of the drive.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample {
    /// When the request was sent.
    pub(super) sent_at: Time,
    /// When the report was taken in.
    pub(super) at: Time,
    /// Positions are counted from the reference.
    pub(super) homed: bool,
    /// Its demand leads the drive; under torque no position does.
    pub(super) led: bool,
    /// The demand, or the actual position of a drive that is not led by it, user units; NaN if the drive reports
    /// none.
    pub(super) position: f64,
    /// Actual velocity, user units/s.
    pub(super) velocity: f64,
    /// The demand less the actual position, neither folded into one turn, user units.
    pub(super) behind: f64,
}

/// What is watched of an axis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Watched {
    /// It homes: its positions change their origin, and it has a speed limit of its own.
    pub(super) homing: bool,
    /// It must also be able to stop inside its range.
    pub(super) braking: bool,
}

impl Sample {
    /// Whether its positions give the demand velocity.
    fn tells_demand(&self) -> bool {
        self.led && !self.position.is_nan()
    }
}

/// The watch over one axis.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct Bounds {
    last: Option<Sample>,
    /// Velocity of the demand between the last two reports, or the actual one, user units/s.
    velocity: f64,
    /// Reports in a row that were out of bounds in one direction.
    broken: u32,
    /// Their direction.
    forward: bool,
    /// The last report is new since the last evaluation.
    fresh: bool,
    /// Reports in a row that were too far from their demand.
    strayed: u8,
    rules: Rules,
}

/// What the plan allows, as it is compared in each cycle.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
struct Rules {
    /// Of positions, user units.
    rounding: f64,
    /// One turn of a rotary axis.
    modulo: Option<f64>,
    velocity: Option<f64>,
    position: Option<(f64, f64)>,
    homing: Option<f64>,
    deceleration: f64,
    /// The largest following error; infinite = not watched.
    following: f64,
    /// The age of an actual position against the demand of its report, s.
    behind_s: f64,
}

/// So many reports in a row are proof: one that a disturbance has made leads there and back again.
const REPORTS: u32 = 3;

/// A speed just at its limit is not refused for the rounding of positions and instants.
const SPEED_MARGIN: f64 = 1.05;

/// A motor overshoots its setpoint: where only its actual speed is known, the margin is larger.
const ACTUAL_SPEED_MARGIN: f64 = 1.2;

/// How many counts of the drive may be due to rounding.
const COUNTS: f64 = 2.0;

impl Bounds {
    /// The watch over the axis of `plan`, whose actual positions are so many ns behind the demand of their reports.
    pub(super) fn new(plan: &AxisPlan, behind_ns: u64) -> Bounds {
        let rules = Rules {
            rounding: (COUNTS / plan.units.counts_per_unit).abs(),
            modulo: plan.units.modulo,
            velocity: plan.limits.velocity,
            position: plan.limits.position,
            homing: plan.limits.homing_velocity(),
            deceleration: plan.stop.deceleration,
            following: plan.most_following_error(behind_ns).unwrap_or(f64::INFINITY),
            behind_s: behind_ns as f64 * 1e-9,
        };
        Bounds::of(rules)
    }

    fn of(rules: Rules) -> Bounds {
        Bounds { last: None, velocity: 0.0, broken: 0, forward: false, fresh: false, strayed: 0, rules }
    }

    /// What was reported so far says nothing any more.
    pub(super) fn forget(&mut self) {
        *self = Bounds::of(self.rules);
    }

    /// A report came in.
    #[inline]
    pub(super) fn take(&mut self, sample: Sample) {
        self.velocity = match self.last {
            _ if !sample.tells_demand() => sample.velocity,
            Some(last) if last.homed == sample.homed && last.tells_demand() => {
                // Which of the two telegrams was delayed is not known: the longer time is the safe one.
                let ns = sample.at.since(last.at).max(sample.sent_at.since(last.sent_at)).max(1);
                let way = way(self.rules.modulo, last.position, sample.position);
                (way.abs() - self.rules.rounding).max(0.0).copysign(way) * 1e9 / ns as f64
            }
            // Homing gave the positions another origin, or there was none before: that was no motion.
            _ => 0.0,
        };
        (self.last, self.fresh) = (Some(sample), true);
    }

    /// The speed in the last report, user units/s; NaN if it is not known.
    pub(super) fn speed(&self) -> f64 {
        self.velocity.abs()
    }

    /// Whether the axis does not follow its demand, by a report that was not evaluated yet.
    #[inline]
    pub(super) fn strays(&mut self, units: &Units) -> bool {
        let Some(Sample { behind, .. }) = &self.last else { return false };
        // An unknown position is not a distance.
        if (behind - self.velocity * self.rules.behind_s).abs() > self.rules.following {
            return self.strays_on(units);
        }
        self.strayed = 0;
        false
    }

    /// The same where it is too far away, if not by whole wrap-arounds.
    #[cold]
    fn strays_on(&mut self, units: &Units) -> bool {
        let (Some(Sample { behind, .. }), true) = (&self.last, self.fresh) else { return false };
        let error = units.unwrapped(behind - self.velocity * self.rules.behind_s);
        self.strayed = if error.abs() > self.rules.following { self.strayed.saturating_add(1) } else { 0 };
        u32::from(self.strayed) >= REPORTS
    }

    /// Whether the drive does what the plan forbids. With `braking` it must also be able to stop inside its range,
    /// from where it will be when a stop reaches it: after [`REPORTS`], and two exchanges `seconds` apart.
    #[inline]
    pub(super) fn are_broken(&mut self, watched: Watched, seconds: f64) -> bool {
        let Watched { homing, braking } = watched;
        let (Some(sample), true) = (&self.last, std::mem::take(&mut self.fresh)) else { return false };
        let rules = &self.rules;
        let velocity = self.velocity;
        // Written so that an unknown value is not inside.
        let margin = if sample.tells_demand() { SPEED_MARGIN } else { ACTUAL_SPEED_MARGIN };
        let most = if homing { rules.homing } else { rules.velocity };
        let slow = most.is_none_or(|most| velocity.abs() <= most * margin);
        let inside = rules.position.filter(|_| sample.homed && !homing).is_none_or(|(low, high)| {
            let reaction = f64::from(REPORTS + 2) * seconds;
            let time = if braking { velocity.abs() / (2.0 * rules.deceleration) + reaction } else { 0.0 };
            let end = sample.position + velocity * time;
            let rounding = rules.rounding;
            // From outside, a motion may lead back in.
            velocity == 0.0
                || velocity > 0.0 && end <= high + rounding
                || velocity < 0.0 && end >= low - rounding
        });
        let forward = velocity > 0.0;
        let before = if forward == self.forward { self.broken } else { 0 };
        self.broken = if slow && inside { 0 } else { before + 1 };
        self.forward = forward;
        self.broken >= REPORTS
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::{FollowingError, Limits, Unit, Units};
    use crate::time::MS;

    fn plan() -> AxisPlan {
        let mut plan = AxisPlan::new("x", Units::millimetres(10_000.0));
        plan.limits = Limits { position: Some((0.0, 100.0)), velocity: Some(500.0), ..Limits::default() };
        plan.stop.deceleration = 1_000.0;
        plan
    }

    fn unranged() -> AxisPlan {
        let mut plan = plan();
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
        position: 0.0,
        velocity: 0.0,
        behind: 0.0,
    };
    const UNHOMED: Sample = Sample { homed: false, ..SAMPLE };
    const TORQUE: Sample = Sample { led: false, ..SAMPLE };
    const NONE: f64 = f64::NAN;

    /// Positions and velocities at 1 kHz, all else as in `sample`; returns the report in which the watch trips.
    fn broken_by(
        plan: &AxisPlan,
        watched: Watched,
        sample: Sample,
        reported: &[(f64, f64)],
    ) -> Option<usize> {
        let mut bounds = Bounds::new(plan, 0);
        reported.iter().enumerate().position(|(index, &(position, velocity))| {
            let at = Time(MS * index as u64);
            bounds.take(Sample { sent_at: at, at, position, velocity, ..sample });
            bounds.are_broken(watched, 0.001)
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
        let broken = |reported: &[(f64, f64)]| broken_by(&plan(), BRAKING, TORQUE, reported);
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
        let sample = |sent: u64, at: u64, position: f64| Sample {
            sent_at: Time(sent * MS / 10),
            at: Time(at * MS / 10),
            position,
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
                "a position that is told again",
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
            let mut bounds = Bounds::new(&plan(), 0);
            for (n, sample) in samples.into_iter().enumerate() {
                bounds.take(sample);
                assert!(bounds.speed() <= most * 1.000_001, "{what}, {n}: {}", bounds.speed());
                assert!(!bounds.are_broken(BRAKING, 0.001), "{what}, {n}");
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
    fn a_speed_or_a_position_that_is_not_told_is_not_inside_its_limits() {
        let mut without = unranged();
        without.limits.velocity = None;
        for (what, plan, sample, velocity, broken) in [
            ("homed, as it reports, but where?", &plan(), SAMPLE, 100.0, Some(2)),
            ("it stands", &plan(), SAMPLE, 0.0, None),
            ("not homed: nothing may move it", &plan(), UNHOMED, 100.0, None),
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
        assert_eq!([SAMPLE, UNHOMED].map(|sample| strikes(&plan(), RANGE, sample, &fast)), [Some(3); 2]);
        assert_eq!(strikes(&plan(), RANGE, SAMPLE, &just), None);
        assert_eq!(strikes(&plan(), RANGE, SAMPLE, &[10.0, 20.0, 10.0, 20.0, 10.0]), None, "no speed: jumps");
        // A turn over the end of a rotary axis is a short way.
        let mut rotary = unranged();
        (rotary.units.modulo, rotary.units.unit) = (Some(1.0), Unit::Revolution);
        assert_eq!(strikes(&rotary, BRAKING, SAMPLE, &[0.8, 0.2, 0.6, 0.0]), None);
    }

    #[test]
    fn the_range_holds_outward_only_and_only_when_homed() {
        let mut below = plan();
        below.limits.position = Some((-50.0, 100.0));
        let out = [99.9, 100.1, 100.2, 100.3];
        for (plan, sample, demands, broken) in [
            (&plan(), SAMPLE, &out[..], Some(3)),
            (&plan(), UNHOMED, &out, None),
            (&plan(), SAMPLE, &[103.0, 102.8, 102.6, 102.4], None),
            (&plan(), SAMPLE, &[0.0, -0.2, -0.4, -0.6], Some(3)),
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
    fn with_braking_it_strikes_while_there_is_still_room() {
        // 400 mm/s needs 80 mm at 1000 mm/s².
        let demands: Vec<f64> = (0..250).map(|index| f64::from(index) * 0.4).collect();
        let broken = strikes(&plan(), BRAKING, SAMPLE, &demands).unwrap();
        // Of the reports from 18.4 mm on the third one; 80 mm to brake, and 5 reports until a stop reaches it.
        assert_eq!(broken, 48);
        let end = demands[broken] + 400.0 * 0.002 + 400.0 * 400.0 / 2_000.0;
        assert!((98.0..=100.0).contains(&end), "{end}");
        assert_eq!(strikes(&plan(), RANGE, SAMPLE, &demands), None);
    }

    /// Reports at 1 kHz of an axis at a constant velocity, by what its actual position is behind; whether the report
    /// was clean. Returns the one in which it strays.
    fn strays_at(plan: &AxisPlan, velocity: f64, reports: &[(f64, bool)]) -> Option<usize> {
        let mut bounds = Bounds::new(plan, 2 * MS);
        reports.iter().enumerate().position(|(index, &(behind, clean))| {
            let (at, position) = (Time(MS * index as u64), velocity * 1e-3 * index as f64);
            if clean {
                bounds.take(Sample { sent_at: at, at, position, velocity, behind, ..SAMPLE });
            }
            let strays = bounds.strays(&plan.units);
            bounds.are_broken(RANGE, 0.001);
            strays
        })
    }

    #[test]
    fn an_axis_that_does_not_follow_its_demand_is_found_in_the_third_report() {
        let mut plan = plan();
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
            let mut plan = plan();
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
        for (limit, speed, trips) in [
            (None, 490.0, None),
            (None, 600.0, Some(3)),
            (Some(50.0), 49.0, None),
            (Some(50.0), 60.0, Some(3)),
        ] {
            let mut plan = plan();
            (plan.limits.homing, plan.limits.position) = (limit, Some((0.0, 1.0)));
            let reported: Vec<_> = (0..20).map(|n| (f64::from(n) * speed * 1e-3, speed)).collect();
            assert_eq!(broken_by(&plan, HOMING, SAMPLE, &reported), trips, "{limit:?} {speed}");
        }
    }
}
