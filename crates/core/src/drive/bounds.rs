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
        Bounds { last: None, velocity: 0.0, broken: 0, forward: false, fresh: false, strayed: 0, rules }
    }

    /// What was reported so far says nothing any more.
    pub(super) fn forget(&mut self) {
        let rules = self.rules;
        *self =
            Bounds { last: None, velocity: 0.0, broken: 0, forward: false, fresh: false, strayed: 0, rules };
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

    /// Demands at 1 kHz of a drive that reports no speed; returns the report in which the watch trips.
    fn strikes(plan: &AxisPlan, braking: bool, homed: bool, demands: &[f64]) -> Option<usize> {
        let demands: Vec<_> = demands.iter().map(|demand| (*demand, f64::NAN)).collect();
        broken_by(plan, braking, homed, &demands)
    }

    /// Demands and velocities at 1 kHz.
    fn broken_by(plan: &AxisPlan, braking: bool, homed: bool, reported: &[(f64, f64)]) -> Option<usize> {
        broken_at_report(plan, true, braking, homed, reported)
    }

    /// Positions, of the demand if it is `led`, and velocities at 1 kHz.
    fn broken_at_report(
        plan: &AxisPlan,
        led: bool,
        braking: bool,
        homed: bool,
        reported: &[(f64, f64)],
    ) -> Option<usize> {
        let mut bounds = Bounds::new(plan, 0);
        reported.iter().enumerate().position(|(index, (demand, velocity))| {
            let at = Time(MS * index as u64);
            let (position, velocity) = (*demand, *velocity);
            bounds.take(Sample { sent_at: at, at, homed, led, position, velocity, behind: 0.0 });
            bounds.are_broken(Watched { homing: false, braking }, 0.001)
        })
    }

    #[test]
    fn under_torque_the_speed_and_the_place_of_the_motor_count_and_not_how_its_positions_change() {
        let mut free = plan();
        free.limits.position = None;
        // 500 mm/s, with the margin of a measured speed; its position need not change for that.
        let at = |velocity: f64| broken_at_report(&free, false, true, true, &[(50.0, velocity); 20]);
        assert_eq!((at(590.0), at(610.0), at(-610.0)), (None, Some(2), Some(2)));
        let noise = [(10.0, 0.0), (20.0, 0.0), (30.0, 0.0), (40.0, 0.0)];
        assert_eq!(broken_at_report(&free, false, true, true, &noise), None, "noise is no speed");
        let broken = |reported: &[(f64, f64)]| broken_at_report(&plan(), false, true, true, reported);
        // 400 mm/s needs 80 mm at 1000 mm/s²: it trips while there is room.
        let reported: Vec<_> = (0..250).map(|index| (f64::from(index) * 0.4, 400.0)).collect();
        let (place, velocity) = reported[broken(&reported).unwrap()];
        let end = place + velocity * 0.002 + velocity * velocity / 2_000.0;
        assert!((98.0..=100.001).contains(&end), "{end}");
        // From the outside in is allowed.
        assert_eq!(broken(&[(105.0, -10.0); 9]), None);
        assert_eq!(broken(&[(105.0, 1.0); 9]), Some(2));
    }

    #[test]
    fn neither_the_begin_nor_the_end_of_a_torque_makes_a_speed() {
        let mut bounds = Bounds::new(&plan(), 0);
        // The demand that is reported meanwhile stays where it was, or follows something unknown.
        for index in 0..40_u32 {
            let (led, position) = if index / 4 % 2 == 0 { (true, 20.0) } else { (false, 70.0) };
            let at = Time(MS * u64::from(index));
            bounds.take(Sample { sent_at: at, at, homed: true, led, position, velocity: 0.0, behind: 0.0 });
            assert!(!bounds.are_broken(Watched { homing: false, braking: true }, 0.001), "{index}");
            assert_eq!(bounds.velocity, 0.0, "{index}");
        }
    }

    #[test]
    fn a_drive_without_a_position_is_watched_by_its_speed_in_both_directions() {
        let mut plan = plan();
        plan.limits.position = None;
        let at = |velocities: &[f64]| {
            let reported: Vec<_> = velocities.iter().map(|velocity| (f64::NAN, *velocity)).collect();
            broken_by(&plan, true, false, &reported)
        };
        assert_eq!(at(&[500.0, -500.0, 590.0, 590.0, -590.0, 590.0]), None);
        assert_eq!(at(&[500.0, 610.0, 610.0, 610.0]), Some(3));
        assert_eq!(at(&[500.0, -610.0, -610.0, -610.0]), Some(3));
        assert_eq!(
            at(&[700.0, 700.0, 500.0, 700.0, -700.0, 700.0, -700.0]),
            None,
            "a disturbance is no speed"
        );
    }

    #[test]
    fn a_speed_or_a_position_that_is_not_told_is_not_inside_its_limits() {
        let (mut plan, none) = (plan(), f64::NAN);
        // Homed, as it reports, but where?
        assert_eq!(broken_by(&plan, true, true, &[(none, 100.0); 4]), Some(2));
        assert_eq!(broken_by(&plan, true, true, &[(none, 0.0); 4]), None, "it stands");
        assert_eq!(
            broken_by(&plan, true, false, &[(none, 100.0); 4]),
            None,
            "not homed: nothing may move it"
        );
        plan.limits.position = None;
        assert_eq!(broken_by(&plan, true, false, &[(none, none); 4]), Some(2));
        plan.limits.velocity = None;
        assert_eq!(
            broken_by(&plan, true, false, &[(none, none); 4]),
            None,
            "without limits there is nothing to watch"
        );
    }

    #[test]
    fn a_position_that_is_told_again_makes_no_speed_at_first() {
        let reported = [(f64::NAN, 0.0), (90.0, 0.0), (90.1, 0.0), (f64::NAN, 0.0), (10.0, 0.0), (10.1, 0.0)];
        assert_eq!(broken_by(&plan(), false, false, &reported), None);
    }

    #[test]
    fn a_speed_over_its_limit_is_found_in_the_third_report_homed_or_not() {
        let fast: Vec<f64> = (0..9).map(|index| f64::from(index) * 0.6).collect();
        assert_eq!(strikes(&plan(), false, true, &fast), Some(3));
        assert_eq!(strikes(&plan(), false, false, &fast), Some(3));
        let just: Vec<f64> = (0..9).map(|index| f64::from(index) * 0.5).collect();
        assert_eq!(strikes(&plan(), false, true, &just), None);
        assert_eq!(
            strikes(&plan(), false, true, &[10.0, 20.0, 10.0, 20.0, 10.0]),
            None,
            "jumps are no speed"
        );
    }

    #[test]
    fn the_range_holds_outward_only_and_only_when_homed() {
        let out = [99.9, 100.1, 100.2, 100.3];
        assert_eq!(strikes(&plan(), false, true, &out), Some(3));
        assert_eq!(strikes(&plan(), false, false, &out), None);
        assert_eq!(strikes(&plan(), false, true, &[103.0, 102.8, 102.6, 102.4]), None);
        assert_eq!(strikes(&plan(), false, true, &[0.0, -0.2, -0.4, -0.6]), Some(3));
        let mut below = plan();
        below.limits.position = Some((-50.0, 100.0));
        assert_eq!(strikes(&below, false, true, &[-0.2, -0.4, -0.6, -0.8, -1.0]), None);
        assert_eq!(strikes(&below, false, true, &[-49.9, -50.1, -50.3, -50.5]), Some(3));
        // Two counts may be due to rounding.
        for (end, broken) in [(100.0002, None), (100.0003, Some(2)), (-50.0002, None), (-50.0003, Some(2))] {
            let slowly = [(end, f64::signum(end)); 9];
            assert_eq!(broken_at_report(&below, false, false, true, &slowly), broken, "{end}");
        }
    }

    #[test]
    fn with_braking_it_strikes_while_there_is_still_room() {
        // 400 mm/s needs 80 mm at 1000 mm/s².
        let demands: Vec<f64> = (0..250).map(|index| f64::from(index) * 0.4).collect();
        let broken = strikes(&plan(), true, true, &demands).unwrap();
        // Of the reports from 18.4 mm on the third one; 80 mm to brake, and 5 reports until a stop reaches it.
        assert_eq!(broken, 48);
        let end = demands[broken] + 400.0 * 0.002 + 400.0 * 400.0 / 2_000.0;
        assert!((98.0..=100.0).contains(&end), "{end}");
        assert_eq!(strikes(&plan(), false, true, &demands), None);
    }

    /// Reports at 1 kHz of an axis at a constant velocity, by what its actual position is behind; whether the report
    /// was clean. Returns the one in which it strays.
    fn strays_at(plan: &AxisPlan, velocity: f64, reports: &[(f64, bool)]) -> Option<usize> {
        let mut bounds = Bounds::new(plan, 2 * MS);
        reports.iter().enumerate().position(|(index, (behind, clean))| {
            let (at, position) = (Time(MS * index as u64), velocity * 1e-3 * index as f64);
            let sample =
                Sample { sent_at: at, at, homed: true, led: true, position, velocity, behind: *behind };
            if *clean {
                bounds.take(sample);
            }
            let strays = bounds.strays(&plan.units);
            bounds.are_broken(Watched { homing: false, braking: false }, 0.001);
            strays
        })
    }

    #[test]
    fn an_axis_that_does_not_follow_its_demand_is_found_in_the_third_report() {
        let mut plan = plan();
        plan.limits.following_error = FollowingError::Most(1.0);
        // 200 mm/s for 2 ms are no error.
        let follows = |velocity: f64, behind: f64| strays_at(&plan, velocity, &[(behind, true); 9]);
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
        ] {
            assert_eq!(follows(velocity, behind), found, "{velocity} {behind}");
        }
        let (far, near) = ((5.0, true), (0.0, true));
        assert_eq!(strays_at(&plan, 0.0, &[far, far, near, far, far, near, far, far]), None, "it comes back");
        assert_eq!(
            strays_at(&plan, 0.0, &[far, (0.0, false), (0.0, false), (0.0, false)]),
            None,
            "not clean"
        );
        assert_eq!(strays_at(&plan, 0.0, &[far, (0.0, false), far, far]), Some(3));
        assert_eq!(strays_at(&plan, 0.0, &[(f64::NAN, true); 9]), None, "no position is known");
        plan.units.modulo = Some(10.0);
        let around = 4_294_967_296.0 / 10_000.0;
        assert_eq!(strays_at(&plan, 0.0, &[(around, true); 9]), None, "a count that was unwrapped elsewhere");
        assert_eq!(strays_at(&plan, 0.0, &[(around + 1.1, true); 9]), Some(2));
        assert_eq!(strays_at(&plan, 0.0, &[(10.0, true); 9]), Some(2), "a whole turn");
    }

    #[test]
    fn the_largest_following_error_follows_from_the_velocity_limit_and_the_age_of_the_position() {
        let mut plan = plan();
        plan.in_position.window = Some(0.5);
        let is_about = |plan: &AxisPlan, behind_ns, wanted: f64| {
            let most = plan.most_following_error(behind_ns).unwrap();
            assert!((most - wanted).abs() < 1e-9, "{most}");
        };
        // 500 mm/s for 2 and 50 ms.
        is_about(&plan, 2 * MS, 26.5);
        plan.in_position.window = None;
        is_about(&plan, 0, 25.0 + 4e-4);
        plan.limits.velocity = None;
        assert_eq!(plan.most_following_error(0), None);
        assert_eq!(strays_at(&plan, 0.0, &[(1e9, true); 9]), None, "without a limit there is none");
        plan.limits.following_error = FollowingError::Most(3.0);
        assert_eq!(plan.most_following_error(2 * MS), Some(3.0));
        (plan.limits.velocity, plan.limits.following_error) = (Some(500.0), FollowingError::Off);
        assert_eq!(plan.most_following_error(0), None);
    }

    #[test]
    fn homing_has_a_speed_limit_of_its_own_and_no_range() {
        let (mut plan, homing) = (plan(), Watched { homing: true, braking: true });
        let mut trips = |limit: Option<f64>, speed: f64| {
            (plan.limits.homing, plan.limits.position) = (limit, Some((0.0, 1.0)));
            let mut bounds = Bounds::new(&plan, 0);
            (0..20_u32).position(|index| {
                let (at, position) = (Time(MS * u64::from(index)), f64::from(index) * speed * 1e-3);
                let sample = Sample {
                    sent_at: at,
                    at,
                    homed: true,
                    led: true,
                    position,
                    velocity: speed,
                    behind: 0.0,
                };
                bounds.take(sample);
                bounds.are_broken(homing, 0.001)
            })
        };
        assert_eq!(
            [(None, 490.0), (None, 600.0), (Some(50.0), 49.0), (Some(50.0), 60.0)]
                .map(|(limit, speed)| trips(limit, speed)),
            [None, Some(3), None, Some(3)]
        );
    }

    #[test]
    fn a_report_that_was_held_up_makes_no_speed() {
        let mut bounds = Bounds::new(&plan(), 0);
        for (sent_ms, at_ms, demand) in [(0, 0, 0.0), (1, 4, 0.4), (2, 4, 0.8), (9, 9, 3.6), (10, 10, 4.0)] {
            let (sent_at, at) = (Time(sent_ms * MS), Time(at_ms * MS));
            let sample =
                Sample { sent_at, at, homed: true, led: true, position: demand, velocity: 0.0, behind: 0.0 };
            bounds.take(sample);
            assert!(
                !bounds.are_broken(Watched { homing: false, braking: false }, 0.001),
                "sent after {sent_ms} ms"
            );
        }
    }

    #[test]
    fn reports_that_come_closer_together_than_their_requests_make_no_speed() {
        // 400 mm/s, requests at 1 kHz; the network holds replies up, and delivers them 0.3 ms apart.
        let mut bounds = Bounds::new(&plan(), 0);
        for n in 0..20_u64 {
            let (sent_at, at) = (Time(n * MS), Time(10 * MS + n * 3 * MS / 10));
            let position = 0.4 * n as f64;
            bounds.take(Sample { sent_at, at, homed: true, led: true, position, velocity: 0.0, behind: 0.0 });
            assert!(bounds.speed() <= 400.001, "{n}: {}", bounds.speed());
            assert!(!bounds.are_broken(Watched { homing: false, braking: false }, 0.001), "{n}");
        }
        // Nor do requests that left closer together than their replies came in.
        let mut bounds = Bounds::new(&plan(), 0);
        for n in 0..20_u64 {
            let (sent_at, at) = (Time(n * 3 * MS / 10), Time(10 * MS + n * MS));
            let position = 0.4 * n as f64;
            bounds.take(Sample { sent_at, at, homed: true, led: true, position, velocity: 0.0, behind: 0.0 });
            assert!(!bounds.are_broken(Watched { homing: false, braking: false }, 0.001), "{n}");
        }
    }

    #[test]
    fn a_turn_over_the_end_of_a_rotary_axis_is_a_short_way() {
        let mut rotary = plan();
        rotary.units.modulo = Some(1.0);
        rotary.units.unit = Unit::Revolution;
        rotary.limits = Limits { velocity: Some(500.0), ..Limits::default() };
        assert_eq!(strikes(&rotary, true, true, &[0.8, 0.2, 0.6, 0.0]), None);
    }
}
