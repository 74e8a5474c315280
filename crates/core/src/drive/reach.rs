//! Which reports an axis can have reached: a place that lies farther from the last one than any motion of the axis
//! leads proves nothing by itself.
//!
//! On a wire without sequence numbers such a report is an old one that came once more; on any other a damaged one, or
//! that of an encoder which has started again. Two reports in a row that agree with each other are no damage: then the
//! axis is there, whatever has put it there, and everything that was counted from its reference is void.
//!
//! The speed that is allowed is far above what the limits allow: an axis that is too fast is stopped by its limits
//! ([`bounds`](super::bounds)), and its reports must not be missing there.

use crate::axis::{AxisPlan, Unit};
use crate::bus::desired::Evidence;
use crate::time::{MS, Time};

/// An axis with a velocity limit is at most so many times as fast: it overshoots, or something pushes it ...
const OVER_LIMIT: f64 = 2.0;
/// ... and a slow one may be pushed as fast as this, user units/s: what a hand or a collision makes of a motor.
const PUSHED_MM: f64 = 1_000.0;
const PUSHED_REV: f64 = 10.0;
/// Nothing is faster, user units/s: the fastest linear motors reach 15 m/s, the fastest spindles 30 000 rpm. This is
/// the only bound of an axis without a velocity limit, and of one without power or that this master has not enabled.
const FASTEST_MM: f64 = 20_000.0;
const FASTEST_REV: f64 = 500.0;
/// A drive may have taken one of two positions by so much earlier than the other, ns, or by an exchange if that is
/// longer: its status may be some ms old (LinUDP sheet, 3.5).
const SHIFT_NS: u64 = 2 * MS;
/// How many counts of the drive may be due to rounding.
const COUNTS: f64 = 2.0;
/// So many reports in a row that agree neither with the last one that counted nor with each other are no damage either.
const MOST_HELD: u8 = 4;
/// Positions of drives are counted in 32 bits: on an axis that is not rotary they wrap around.
const WRAPS: f64 = 4_294_967_296.0;

/// The places of a report, user units, not folded into one turn.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Places {
    /// When its request left.
    sent_at: Time,
    position: f64,
    demand: f64,
    demand_velocity: f64,
}

impl Places {
    /// Those of a report to a request that left at `sent_at`.
    #[inline]
    fn of(sent_at: Time, evidence: &Evidence) -> Places {
        let Evidence { position, demand, demand_velocity, .. } = *evidence;
        Places { sent_at, position, demand, demand_velocity }
    }
}

/// What becomes of a report that is not a usual one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Weight {
    /// It counts.
    Counts,
    /// It does not count.
    Held,
    /// It counts, and the axis has jumped by so much, user units.
    Jumped(f64),
}

/// How far the axis may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Bound {
    /// Its origin may change: anywhere.
    None,
    /// As far as the fastest axis.
    Fastest,
    /// As far as its plan lets it.
    Plan,
}

/// The watch over the places of one axis.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct Reach {
    /// Those of the last report that counted.
    last: Places,
    /// The speed that is allowed, user units per ns.
    speed: f64,
    rounding: f64,
    shift_ns: u64,
    /// The largest speed of all, user units per ns.
    fastest: f64,
    /// Length of the range of the drive's counts, user units.
    range: f64,
    /// The last report did not count, and how many in a row.
    held: Places,
    held_for: u8,
}

impl Reach {
    /// The watch over the axis of `plan`, whose exchanges are `interval_ns` apart.
    pub(super) fn new(plan: &AxisPlan, interval_ns: u64) -> Reach {
        let (pushed, fastest) = match plan.units.unit {
            Unit::Millimetre => (PUSHED_MM, FASTEST_MM),
            Unit::Revolution => (PUSHED_REV, FASTEST_REV),
        };
        let fastest = plan.limits.velocity.map_or(fastest, |limit| fastest.max(OVER_LIMIT * limit));
        let speed = plan.limits.velocity.map_or(fastest, |limit| (OVER_LIMIT * limit).max(pushed));
        let counts = plan.units.counts_per_unit.abs();
        Reach {
            last: Places::default(),
            speed: speed * 1e-9,
            rounding: COUNTS / counts,
            shift_ns: SHIFT_NS.max(interval_ns),
            fastest: fastest * 1e-9,
            range: WRAPS / counts,
            held: Places::default(),
            held_for: 0,
        }
    }

    /// A report to a request that left at `sent_at`, taken in at `at`. True if the axis can be where it says; then it
    /// counts from now on. An axis of which nothing is known can be anywhere.
    #[inline]
    pub(super) fn takes(&mut self, sent_at: Time, at: Time, evidence: &Evidence) -> bool {
        let way = evidence.position - self.last.position;
        // An unknown position is not far away.
        let is_far = way.abs() > self.way(self.speed, &self.last, at);
        if !is_far {
            self.last = Places::of(sent_at, evidence);
        }
        !is_far
    }

    /// How far it can go from the `place` to where it is reported at `at`: the drive took the first position after its
    /// request had left, and the second one before its reply came in.
    #[inline]
    fn way(&self, speed: f64, place: &Places, at: Time) -> f64 {
        speed * (at.since(place.sent_at) + self.shift_ns) as f64 + self.rounding
    }

    /// The last report did not count.
    pub(super) fn holds(&self) -> bool {
        self.held_for > 0
    }

    /// This report counts, wherever the axis is.
    pub(super) fn rebase(&mut self, sent_at: Time, evidence: &Evidence) {
        (self.last, self.held_for) = (Places::of(sent_at, evidence), 0);
    }

    /// Whether a report counts that [`takes`](Self::takes) has not taken, or that follows one that did not count.
    /// `velocity` is that of the report, user units/s: if it was made from a report that did not count, it is replaced.
    #[cold]
    pub(super) fn weigh(
        &mut self,
        sent_at: Time,
        at: Time,
        bound: Bound,
        evidence: &mut Evidence,
        velocity: &mut f64,
    ) -> Weight {
        let speed = match bound {
            Bound::None => {
                self.rebase(sent_at, evidence);
                return Weight::Counts;
            }
            Bound::Fastest => self.fastest,
            Bound::Plan => self.speed,
        };
        let new = Places::of(sent_at, evidence);
        let near = |place: &Places| {
            let way = new.position - place.position;
            // Whole ranges are no way.
            let way = way - (way / self.range).round() * self.range;
            let is_far = way.abs() > self.way(speed, place, at);
            !is_far
        };
        let (from, weight) = if near(&self.last) {
            (self.last, Weight::Counts)
        } else if self.held_for > 0 && near(&self.held) || self.held_for >= MOST_HELD - 1 {
            (self.held, Weight::Jumped(new.position - self.last.position))
        } else {
            (self.held, self.held_for) = (new, self.held_for + 1);
            return Weight::Held;
        };
        let passed_ns = new.sent_at.since(from.sent_at) as f64;
        let rate = |from: f64, to: f64| if passed_ns > 0.0 { (to - from) / passed_ns } else { 0.0 };
        if velocity.abs() > speed * 1e9 {
            let own = rate(from.position, new.position);
            *velocity = if own.abs() <= speed { own * 1e9 } else { 0.0 };
        }
        if evidence.demand_velocity.abs() > speed * 1e9 {
            let own = rate(from.demand, new.demand);
            evidence.demand_velocity = if own.abs() <= speed { own * 1e9 } else { 0.0 };
        }
        self.rebase(sent_at, evidence);
        weight
    }

    /// The places in `evidence` are those of the last report that counted again.
    pub(super) fn restore(&self, evidence: &mut Evidence) {
        let Places { position, demand, demand_velocity, .. } = self.last;
        (evidence.position, evidence.demand) = (position, demand);
        evidence.demand_velocity = demand_velocity;
    }
}

#[cfg(test)]
mod tests {
    use Weight::{Counts, Held, Jumped};

    use super::*;
    use crate::axis::Units;

    /// 100 mm/s: it is allowed 1 m/s, over the time between its reports and 2 ms.
    fn plan() -> AxisPlan {
        let mut plan = AxisPlan::new("x", Units::millimetres(10_000.0));
        plan.limits.velocity = Some(100.0);
        plan
    }

    /// Reports at 1 kHz, each taken in as it was sent: what becomes of each, and the velocity that is shown of it.
    struct Line {
        reach: Reach,
        ms: u64,
        evidence: Evidence,
        velocity: f64,
        bound: Bound,
    }

    impl Line {
        /// It was there in the ms before.
        fn new(plan: &AxisPlan, position: f64) -> Line {
            let mut reach = Reach::new(plan, MS);
            reach.rebase(Time(1_000 * MS), &Evidence { position, ..Evidence::default() });
            Line { reach, ms: 1_000, evidence: Evidence::default(), velocity: 0.0, bound: Bound::Plan }
        }

        fn at(&mut self, position: f64) -> Weight {
            self.ms += 1;
            let at = Time(self.ms * MS);
            (self.evidence.position, self.evidence.demand) = (position, position);
            if !self.reach.holds() && self.reach.takes(at, at, &self.evidence) {
                return Counts;
            }
            let (evidence, velocity) = (&mut self.evidence, &mut self.velocity);
            let weight = self.reach.weigh(at, at, self.bound, evidence, velocity);
            if weight == Held {
                self.reach.restore(evidence);
            }
            weight
        }
    }

    #[test]
    fn a_place_out_of_reach_counts_for_nothing_until_the_next_report_agrees_with_it() {
        let end = WRAPS / 20_000.0;
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
                let before = line.evidence.position;
                assert_eq!(line.at(*position), *weight, "{what}: {position}");
                assert!(*weight != Held || line.evidence.position == before, "what counted last: {what}");
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
}
