//! The setpoint of an axis at an instant: piecewise constant acceleration, in closed form.
//!
//! Knows no drive, no wire and no clock. A motion begins at any point and velocity, and replaces the one before it at
//! any time: it is planned once, and evaluated at the time since its begin, so that steps of any size lie on the same
//! curve, and its end is exact.

/// Where the axis is, and how fast.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// User units, not folded into one turn.
    pub position: f64,
    /// User units/s.
    pub velocity: f64,
}

/// Brake, speed up, cruise, brake, stand still.
const SEGMENTS: usize = 5;
/// A stopping distance that differs from the remaining way by less than this part of it counts as equal: a motion
/// that is replaced by itself while it brakes goes on braking.
const SAME: f64 = 1e-9;
/// The least slope of a ramp: a deceleration of 0 would take for ever.
const LEAST: f64 = 1e-12;

/// Constant acceleration, until the next segment begins.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Segment {
    /// Seconds since the begin of the motion.
    begin_s: f64,
    from: Point,
    acceleration: f64,
}

/// A motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trajectory {
    segments: [Segment; SEGMENTS],
    /// The number of segments, at least 1; the last one has no end, and no acceleration.
    count: usize,
}

/// Stands still at 0.
impl Default for Trajectory {
    fn default() -> Trajectory {
        Trajectory::on(Point::default())
    }
}

impl Trajectory {
    /// Continues from a point at its velocity; stands still if that is 0.
    pub fn on(from: Point) -> Trajectory {
        let mut plan = Plan::from(from);
        plan.push(0.0);
        plan.motion
    }

    /// From a point to a velocity with this acceleration, up or down, then constant.
    pub fn run(from: Point, velocity: f64, acceleration: f64) -> Trajectory {
        let mut motion = Trajectory::on(from);
        motion.become_run(from, velocity, acceleration);
        motion
    }

    /// Makes it a motion from a point to a velocity with this acceleration, up or down, then constant. In place:
    /// the application may give another velocity in each exchange.
    #[inline]
    pub(crate) fn become_run(&mut self, from: Point, velocity: f64, acceleration: f64) {
        let (acceleration, change) = (acceleration.max(LEAST), velocity - from.velocity);
        let (mut begin_s, mut at) = (0.0, from);
        self.count = 1;
        if change != 0.0 {
            self.segments[0] = Segment { begin_s, from, acceleration: acceleration.copysign(change) };
            begin_s = change.abs() / acceleration;
            let position = from.position + (from.velocity + velocity) * 0.5 * begin_s;
            (at, self.count) = (Point { position, velocity }, 2);
        }
        self.segments[self.count - 1] = Segment { begin_s, from: at, acceleration: 0.0 };
    }

    /// From a point to a position, to standstill there, in the shortest time with these limits, all above 0. If it
    /// cannot brake before the target, it passes the target and comes back.
    pub fn go_to(from: Point, target: f64, velocity: f64, up: f64, down: f64) -> Trajectory {
        let (velocity, up, down) = (velocity.max(LEAST), up.max(LEAST), down.max(LEAST));
        let mut plan = Plan::from(from);
        let way = target - from.position;
        let stop = from.velocity * from.velocity / (2.0 * down);
        let brakes = from.velocity * way > 0.0 && (stop - way.abs()).abs() <= SAME * stop;
        if brakes {
            // On its braking curve, but for rounding: the curve is bent by that much.
            plan.ramp(0.0, from.velocity * from.velocity / (2.0 * way.abs()));
        } else {
            if from.velocity * way < 0.0 || stop > way.abs() {
                plan.ramp(0.0, down);
            }
            plan.ahead(target, velocity, up, down);
        }
        plan.at = Point { position: target, velocity: 0.0 };
        plan.push(0.0);
        plan.motion
    }

    /// The point so many ns after the begin.
    #[inline]
    pub fn at(&self, ns: u64) -> Point {
        let now_s = seconds(ns);
        let Segment { begin_s, from, acceleration } = *self.segment(now_s);
        let t = now_s - begin_s;
        Point {
            position: from.position + (from.velocity + acceleration * t * 0.5) * t,
            velocity: from.velocity + acceleration * t,
        }
    }

    /// The acceleration at that time; between two segments that of the later one.
    pub fn acceleration(&self, ns: u64) -> f64 {
        self.segment(seconds(ns)).acceleration
    }

    #[inline]
    fn segment(&self, now_s: f64) -> &Segment {
        // A motion is in its last segment most of the time.
        let mut place = self.count - 1;
        while place > 0 && self.segments[place].begin_s > now_s {
            place -= 1;
        }
        &self.segments[place]
    }

    /// It has reached its last velocity, so many ns after the begin: for ever.
    #[inline]
    pub fn is_over(&self, ns: u64) -> bool {
        self.segments[self.count - 1].begin_s <= seconds(ns)
    }

    /// The velocity that it ends with.
    pub fn last_velocity(&self) -> f64 {
        self.segments[self.count - 1].from.velocity
    }
}

/// Signed, since that is one instruction; no motion takes centuries.
#[inline]
fn seconds(ns: u64) -> f64 {
    ns as i64 as f64 * 1e-9
}

/// A motion while it is laid out.
#[derive(Debug)]
struct Plan {
    motion: Trajectory,
    end_s: f64,
    at: Point,
}

impl Plan {
    fn from(at: Point) -> Plan {
        let motion = Trajectory { segments: [Segment::default(); SEGMENTS], count: 0 };
        Plan { motion, end_s: 0.0, at }
    }

    /// Speeds up towards the target, cruises, and brakes there.
    fn ahead(&mut self, target: f64, velocity: f64, up: f64, down: f64) {
        let way = target - self.at.position;
        let (side, way) = (1.0_f64.copysign(way), way.abs());
        if way == 0.0 {
            return;
        }
        let speed = self.at.velocity * side;
        // The peak of a motion that only speeds up and brakes.
        let peak = ((2.0 * way * up + speed * speed) * down / (up + down)).sqrt().max(speed);
        let top = peak.min(velocity);
        self.ramp(side * top, if speed > top { down } else { up });
        let left = (target - self.at.position) * side - top * top / (2.0 * down);
        self.cruise(left.max(0.0) / top);
        self.ramp(0.0, down);
    }

    fn ramp(&mut self, velocity: f64, acceleration: f64) {
        let change = velocity - self.at.velocity;
        if change == 0.0 {
            return;
        }
        self.push(acceleration.copysign(change));
        let takes_s = change.abs() / acceleration;
        self.end_s += takes_s;
        self.at.position += (self.at.velocity + velocity) * 0.5 * takes_s;
        self.at.velocity = velocity;
    }

    fn cruise(&mut self, takes_s: f64) {
        if takes_s > 0.0 {
            self.push(0.0);
            self.end_s += takes_s;
            self.at.position += self.at.velocity * takes_s;
        }
    }

    fn push(&mut self, acceleration: f64) {
        let Trajectory { segments, count } = &mut self.motion;
        if let Some(segment) = segments.get_mut(*count) {
            *segment = Segment { begin_s: self.end_s, from: self.at, acceleration };
            *count += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::time::{MS, S};

    const REST: Point = Point { position: 0.0, velocity: 0.0 };

    #[test]
    fn a_way_back_and_a_target_that_is_too_near_brake_first_and_a_faster_motion_slows_down() {
        let from = Point { position: 0.0, velocity: 10.0 };
        let back = Trajectory::go_to(from, -5.0, 10.0, 10.0, 10.0);
        assert_eq!(back.at(S), Point { position: 5.0, velocity: 0.0 });
        assert_eq!(back.at(60 * S), Point { position: -5.0, velocity: 0.0 });
        // It stands after 5 at the earliest.
        let passed = Trajectory::go_to(from, 1.0, 10.0, 10.0, 10.0);
        assert_eq!(passed.at(S), Point { position: 5.0, velocity: 0.0 });
        assert_eq!(passed.at(60 * S), Point { position: 1.0, velocity: 0.0 });
        let slower = Trajectory::go_to(from, 100.0, 2.0, 10.0, 10.0);
        assert!((slower.at(800 * MS).velocity - 2.0).abs() < 1e-9);
        assert_eq!(slower.at(100 * S).position, 100.0);
    }

    fn point() -> impl Strategy<Value = Point> {
        (-1e3..1e3, -1e2..1e2).prop_map(|(position, velocity)| Point { position, velocity })
    }

    proptest! {
        #[test]
        fn no_step_is_larger_than_its_limits_allow_and_the_end_is_exact(
            from in point(), target in -1e3..1e3_f64, velocity in 0.1..1e2_f64,
            up in 1.0..1e3_f64, down in 1.0..1e3_f64,
        ) {
            let motion = Trajectory::go_to(from, target, velocity, up, down);
            let (most, steepest) = (velocity.max(from.velocity.abs()), up.max(down));
            let mut before = from;
            for ms in 1..50_000 {
                let now = motion.at(ms * MS);
                prop_assert!(now.velocity.abs() <= most * (1.0 + 1e-6), "{now:?}");
                prop_assert!((now.velocity - before.velocity).abs() <= steepest * 1e-3 * (1.0 + 1e-6) + 1e-6);
                prop_assert!((now.position - before.position).abs() <= most * 1e-3 * (1.0 + 1e-6) + 1e-6);
                before = now;
                if motion.is_over(ms * MS) {
                    break;
                }
            }
            prop_assert_eq!(motion.at(100_000 * S), Point { position: target, velocity: 0.0 });
        }

        #[test]
        fn replaced_by_itself_in_every_step_it_goes_the_same_way(
            target in -1e2..1e2_f64, velocity in 0.1..1e2_f64, up in 1.0..1e3_f64, down in 1.0..1e3_f64,
        ) {
            let whole = Trajectory::go_to(REST, target, velocity, up, down);
            let mut at = REST;
            for ms in 1..2_000 {
                at = Trajectory::go_to(at, target, velocity, up, down).at(MS);
                let should = whole.at(ms * MS);
                prop_assert!((at.position - should.position).abs() < 1e-3, "{at:?} instead of {should:?} \
                     after {ms} ms");
            }
        }

        #[test]
        fn no_numbers_panic(position: f64, speed: f64, target: f64, velocity: f64, up: f64, down: f64, ns: u64) {
            let from = Point { position, velocity: speed };
            for motion in [
                Trajectory::go_to(from, target, velocity, up, down),
                Trajectory::run(from, velocity, up),
                Trajectory::on(from),
            ] {
                let _ = (motion.at(ns), motion.is_over(ns), motion.last_velocity());
            }
        }
    }
}
