//! The stop sequence: what the loop requests of a drive after it stopped the axis, phase by phase.
//!
//! Ramp (or the drive's quick stop) -> standstill -> hold or power off. Each phase is a command to the drive machine,
//! and has an end; the sequence never goes back by itself.

use std::time::Duration;

use crate::axis::{Command, HeldBy, Load, StopHow, StopPlan, StopThen, StopTimeout};
use crate::time::{Time, nanos};

/// The time left for each phase after [`StopSequence::hurry`], and for power off where no drive has answered for long:
/// one or two probes.
const HURRIED: Duration = Duration::from_millis(250);

/// The phase of a stop sequence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Phase {
    /// Braking; `still` good exchanges in a row were below the standstill window.
    Braking {
        /// When it began.
        since: Time,
        /// Exchanges at standstill in a row.
        still: u32,
    },
    /// Powering off.
    Disabling {
        /// When it began.
        since: Time,
    },
    /// At the end, with power on: at standstill, or by the time-out's policy.
    Holding,
    /// At the end: power off was requested, and the drive reported it or its time has passed.
    Off,
}

/// The stop sequence of one axis.
#[derive(Clone, Copy, Debug)]
pub struct StopSequence {
    plan: StopPlan,
    /// Only the drive holds the load: the sequence never powers it off.
    keeps_power: bool,
    phase: Phase,
    /// The master is shutting down.
    ending: bool,
    /// Since when nothing was received from the drive.
    silent_since: Option<Time>,
    /// It was received again in the shutdown: the rest of its time runs from then on.
    returned: bool,
    /// The ramp failed, and the quick stop was commanded in its place.
    escalated: bool,
    /// The speed at which the phase began, user units/s; NaN if it is not known.
    from: f64,
    /// How often the axis has moved after the end of the sequence.
    moved: u8,
    /// A report after the request of power off has shown that it is off.
    seen_off: bool,
}

/// The loop's view of the drive in this cycle.
#[derive(Clone, Copy, Debug)]
pub struct Sight {
    /// New values came in.
    pub fresh: bool,
    /// The link carries replies, so that requests reach the drive.
    pub answers: bool,
    /// The drive could not do the last request of the sequence.
    pub failed: bool,
    /// The power stage may be on.
    pub powered: bool,
    /// The drive's setpoint generator is running.
    pub moving: bool,
    /// User units/s.
    pub velocity: f64,
}

/// A ramp ends in this share of the time-out, so that it is over before the sequence escalates.
const RAMP_SHARE: f64 = 0.8;

/// A ramp that has not slowed the axis down by a twentieth in a quarter of its time never will ...
const SLOWED: f64 = 0.95;
const SLOWED_WITHIN: u32 = 4;

/// An axis that moves for the third time after the end of its stop does not follow this master: its power goes off.
const MOST_MOVED: u8 = 3;

/// The deceleration of a stop: as requested, but enough to come to standstill from `velocity` within the stop's
/// time-out. A velocity that is not known (NaN) raises nothing.
pub fn deceleration_of(plan: &StopPlan, requested: f64, velocity: f64) -> f64 {
    requested.max(velocity.abs() / (RAMP_SHARE * plan.timeout.as_secs_f64()))
}

impl StopSequence {
    /// Starts the sequence for an axis at `velocity`; the second value is the first command to the drive.
    pub fn start(plan: StopPlan, load: Load, now: Time, velocity: f64) -> (StopSequence, Command) {
        let mut sequence = StopSequence {
            plan,
            keeps_power: load == Load::Vertical(HeldBy::Drive),
            phase: Phase::Holding,
            ending: false,
            silent_since: None,
            returned: false,
            escalated: plan.how != StopHow::Ramp,
            from: velocity,
            moved: 0,
            seen_off: false,
        };
        let command = sequence.begin(now, velocity);
        (sequence, command)
    }

    /// Starts the stop of an axis whose loop has died, by the drive's own means; `off`: the drive was switched off
    /// before. No master remains: a drive that does not answer ends it by its time-outs. What follows standstill is as
    /// planned.
    pub fn start_last(plan: StopPlan, load: Load, now: Time, off: bool) -> (StopSequence, Command) {
        let how = if off { StopHow::Coast } else { plan.how };
        let (sequence, command) = StopSequence::start(StopPlan { how, ..plan }, load, now, f64::NAN);
        (StopSequence { ending: true, ..sequence }, command)
    }

    /// Starts it once more for an axis that moves although the sequence was complete: by the drive's quick stop, and in
    /// the end by power off, if a stop that does not end may.
    pub fn again(&mut self, now: Time, velocity: f64) -> Command {
        self.escalated = true;
        self.seen_off = false;
        self.moved = self.moved.saturating_add(1);
        if self.moved >= MOST_MOVED && self.plan.on_timeout == StopTimeout::Disable {
            return self.disable(now);
        }
        self.begin(now, velocity)
    }

    fn begin(&mut self, now: Time, velocity: f64) -> Command {
        if self.plan.how == StopHow::Coast {
            return self.disable(now);
        }
        self.from = velocity;
        self.phase = Phase::Braking { since: now, still: 0 };
        self.brake(velocity)
    }

    fn disable(&mut self, now: Time) -> Command {
        self.phase = Phase::Disabling { since: now };
        Command::Disable
    }

    /// Brakes by the drive's quick stop, from now on.
    fn escalate(&mut self, now: Time) -> Command {
        self.escalated = true;
        self.phase = Phase::Braking { since: now, still: 0 };
        Command::QuickStop
    }

    /// The command of the first phase.
    fn brake(&self, velocity: f64) -> Command {
        if self.escalated {
            Command::QuickStop
        } else {
            Command::Stop {
                deceleration: Some(deceleration_of(&self.plan, self.plan.deceleration, velocity)),
            }
        }
    }

    /// Whether the last phase is reached.
    pub fn is_down(&self) -> bool {
        matches!(self.phase, Phase::Holding | Phase::Off)
    }

    /// Whether a report after its request of power off has shown that the drive is off.
    pub fn is_seen_off(&self) -> bool {
        self.phase == Phase::Off && self.seen_off
    }

    /// Whether it is complete, and left the drive powered because only the drive holds its load.
    pub fn holds_load(&self) -> bool {
        self.phase == Phase::Holding && self.keeps_power
    }

    /// A shutdown powers off whatever `then` says, since no master remains to hold the axis; but not before
    /// standstill, and not a drive that alone holds its load. A drive that is off already is powered off all the
    /// same: its control word would otherwise stay high.
    pub fn shut_down(&mut self, now: Time, powered: bool) {
        if self.keeps_power && powered {
            self.ending = true;
            return;
        }
        let held = std::mem::replace(&mut self.plan.then, StopThen::Disable) == StopThen::Hold;
        let began = !std::mem::replace(&mut self.ending, true);
        // Once; and once more a drive that has held its load alone until its power went.
        if self.phase == Phase::Holding && (began || held && self.keeps_power) {
            self.phase = Phase::Braking { since: now, still: 0 };
        }
    }

    /// The application requested the quick stop of an axis that is braking already; the wait for standstill goes
    /// on.
    pub fn quicken(&mut self) {
        self.escalated = true;
    }

    /// Whether it brakes, and a quick stop would be sooner.
    pub fn is_braking(&self) -> bool {
        matches!(self.phase, Phase::Braking { .. })
    }

    /// Whether it is complete, and the drive holds its position.
    pub fn holds(&self) -> bool {
        self.phase == Phase::Holding
    }

    /// Whether an axis with this sight stands.
    pub fn is_standing(&self, sight: Sight) -> bool {
        !sight.moving && sight.velocity.abs() <= self.plan.standstill
    }

    /// Whether it brakes by a ramp of this master.
    pub fn is_ramp(&self) -> bool {
        self.is_braking() && !self.escalated
    }

    /// One cycle of the sequence; returns the command to give when a new phase is reached.
    ///
    /// While nothing is received from the drive, its time does not run: the probes carry the stop, and power off in
    /// mid-motion must not be the first request that reaches it. Only a shutdown does not wait for ever.
    pub fn step(&mut self, now: Time, sight: Sight) -> Option<Command> {
        let back = self.silent_since.is_some() && sight.answers;
        self.silent_since = if sight.answers { None } else { self.silent_since.or(Some(now)) };
        let late = |since: Time| now.since(since) >= nanos(self.plan.timeout);
        // Both phases had their time while the drive was absent.
        let gone = self.ending
            && self.silent_since.is_some_and(|since| now.since(since) >= 2 * nanos(self.plan.timeout));
        match self.phase {
            Phase::Holding | Phase::Off => None,
            Phase::Braking { since, still } => {
                let standing = self.is_standing(sight);
                let still = match (sight.fresh, standing) {
                    (false, _) => still,
                    (true, true) => still + 1,
                    (true, false) => 0,
                };
                // An intermittent link may extend the braking, but the master's end only once.
                let again = back && !(self.ending && std::mem::replace(&mut self.returned, true));
                let since = if again { now } else { since };
                self.phase = Phase::Braking { since, still };
                let no_slower = sight.fresh
                    && !standing
                    && sight.velocity.abs() > SLOWED * self.from
                    && now.since(since) > nanos(self.plan.timeout / SLOWED_WITHIN);
                if (sight.failed || no_slower) && !self.escalated {
                    return Some(self.escalate(now));
                }
                if back {
                    // Requests sent while nothing was received are repeated.
                    return Some(self.brake(sight.velocity));
                }
                let power_off = if sight.fresh && !sight.powered {
                    // Nothing to brake any more; the control word still has to say so.
                    true
                } else if still >= self.plan.standstill_for {
                    self.plan.then == StopThen::Disable
                } else if late(since) && (sight.answers || self.ending) {
                    if !std::mem::replace(&mut self.escalated, true) && sight.answers {
                        // The ramp had its time; the quick stop has as much.
                        return Some(self.escalate(now));
                    }
                    self.plan.on_timeout == StopTimeout::Disable
                } else {
                    return None;
                };
                if power_off {
                    return Some(self.disable(now));
                }
                self.phase = Phase::Holding;
                None
            }
            Phase::Disabling { since } => {
                // A report from before the request is no answer.
                let off = sight.fresh && !sight.powered && now > since;
                self.seen_off |= off;
                // The master's end waits for an axis that coasts, too; a velocity that is not known is none.
                let coasts = self.ending && sight.velocity.abs() > self.plan.standstill;
                if (off && !coasts) || late(since) || (gone && now.since(since) >= nanos(HURRIED)) {
                    self.phase = Phase::Off;
                }
                None
            }
        }
    }

    /// Shortens the waits (a second Ctrl-C): the fastest controlled stop, and little time left for it. Never skips
    /// it.
    pub fn hurry(&mut self, now: Time) -> Option<Command> {
        if !self.is_down() {
            self.plan.timeout = self.plan.timeout.min(HURRIED);
        }
        self.is_braking().then(|| self.escalate(now))
    }
}

#[cfg(test)]
mod tests {
    use StopHow::{Coast, Quick, Ramp};
    use StopThen::{Disable, Hold};

    use super::*;

    fn plan(how: StopHow, then: StopThen) -> StopPlan {
        StopPlan {
            how,
            deceleration: 100.0,
            then,
            timeout: Duration::from_nanos(1_000),
            on_timeout: StopTimeout::Disable,
            standstill: 1.0,
            standstill_for: 3,
            group: None,
        }
    }

    const MOVING: Sight =
        Sight { fresh: true, answers: true, failed: false, powered: true, moving: true, velocity: 50.0 };
    const STANDING: Sight = Sight { moving: false, velocity: 0.5, ..MOVING };
    const OFF: Sight = Sight { powered: false, moving: false, velocity: 0.0, ..MOVING };
    const LOST: Sight = Sight { fresh: false, answers: false, ..MOVING };
    const POWER_OFF: Option<Command> = Some(Command::Disable);
    const QUICK: Option<Command> = Some(Command::QuickStop);

    /// The report of before: held values prove nothing.
    fn held(sight: Sight) -> Sight {
        Sight { fresh: false, ..sight }
    }

    fn start(plan: StopPlan, velocity: f64) -> StopSequence {
        StopSequence::start(plan, Load::Level, Time(0), velocity).0
    }

    impl StopSequence {
        /// Steps at these times: what is seen, what is requested then, and whether it is down.
        #[track_caller]
        fn steps(&mut self, steps: &[(u64, Sight, Option<Command>, bool)]) {
            for (at, sight, command, down) in steps {
                let step = (self.step(Time(*at), *sight), self.is_down());
                assert_eq!(step, (*command, *down), "at {at}: {sight:?}");
            }
        }

        /// It stands for long enough, and is held.
        #[track_caller]
        fn stands(mut self) -> StopSequence {
            self.steps(&[(1, STANDING, None, false), (1, STANDING, None, false), (1, STANDING, None, true)]);
            self
        }
    }

    #[test]
    fn power_goes_off_only_after_so_many_reports_of_standstill_in_a_row() {
        let [moves, still] = [MOVING, STANDING].map(|sight| (1, sight, None, false));
        let (none, off) = ((1, held(STANDING), None, false), (1, STANDING, POWER_OFF, false));
        for (how, seen) in [
            (Ramp, &[moves, still, still, none, off][..]),
            (Quick, &[still, still, moves, still, still, off]),
        ] {
            let mut sequence = start(plan(how, Disable), 0.0);
            sequence.steps(seen);
            sequence.steps(&[(2, OFF, None, true)]);
        }
    }

    #[test]
    fn the_end_of_the_master_waits_for_an_axis_that_coasts_but_no_longer_than_its_time_out() {
        let coasting = Sight { velocity: 50.0, ..OFF };
        for ending in [false, true] {
            let mut sequence = start(plan(Coast, Disable), 50.0);
            if ending {
                sequence.shut_down(Time(0), true);
            }
            sequence.steps(&[(1, MOVING, None, false), (2, coasting, None, !ending)]);
            assert_eq!(sequence.is_seen_off(), !ending);
            sequence.steps(&[(3, OFF, None, true)]);
            assert!(sequence.is_seen_off());
        }
        let mut sequence = start(plan(Coast, Disable), 50.0);
        sequence.shut_down(Time(0), true);
        sequence.steps(&[(999, coasting, None, false), (1_000, coasting, None, true)]);
        assert!(sequence.is_seen_off());
        // It moves again: what was seen before is no proof.
        for moved in 1..4 {
            sequence.again(Time(1_000 + moved), 50.0);
        }
        sequence.steps(&[(3_000, held(OFF), None, true)]);
        assert!(!sequence.is_seen_off());
    }

    #[test]
    fn hold_stays_powered_but_a_shutdown_does_not() {
        let mut sequence = start(plan(Ramp, Hold), 0.0).stands();
        sequence.shut_down(Time(2), true);
        // Power goes off only after standstill here, too.
        let still = (3, STANDING, None, false);
        sequence.steps(&[still, still, (3, STANDING, POWER_OFF, false)]);
    }

    #[test]
    fn a_hurry_brakes_faster_and_still_waits_for_standstill() {
        // Its own time-out may be shorter still.
        for (timeout, left) in [(Duration::from_secs(20), 250_000_000), (Duration::from_nanos(1_000), 1_000)]
        {
            let plan = StopPlan { timeout, ..plan(Ramp, Disable) };
            let mut sequence = start(plan, 0.0);
            assert_eq!(sequence.hurry(Time(500)), QUICK);
            sequence.steps(&[(499 + left, MOVING, None, false), (500 + left, MOVING, POWER_OFF, false)]);
            // The same while the power goes off.
            let mut sequence = start(StopPlan { how: Coast, ..plan }, 0.0);
            assert_eq!(sequence.hurry(Time(0)), None);
            sequence.steps(&[(left - 1, MOVING, None, false), (left, MOVING, None, true)]);
        }
    }

    #[test]
    fn a_stop_switches_nothing_off_blindly_and_repeats_its_last_request_after_a_reconnect() {
        for quickened in [false, true] {
            let plan = plan(Ramp, Disable);
            let mut sequence = start(plan, 100.0);
            if quickened {
                sequence.quicken();
            }
            let ramp = Command::Stop { deceleration: Some(deceleration_of(&plan, 100.0, 50.0)) };
            let (again, then) = if quickened { (QUICK, POWER_OFF) } else { (Some(ramp), QUICK) };
            // While it is silent its time does not run; from its return on it does.
            sequence.steps(&[
                (5_000, LOST, None, false),
                (5_001, Sight { powered: false, ..LOST }, None, false),
                (6_000, MOVING, again, false),
                (6_500, MOVING, None, false),
                (7_000, MOVING, then, false),
            ]);
        }
        // A shutdown does not wait for ever.
        let mut sequence = start(plan(Ramp, Disable), 0.0);
        sequence.step(Time(500), LOST);
        sequence.shut_down(Time(500), true);
        sequence.steps(&[(1_600, LOST, POWER_OFF, false)]);
    }

    #[test]
    fn a_link_that_comes_and_goes_holds_no_shutdown_up() {
        let mut sequence = start(plan(Ramp, Disable), 100.0);
        sequence.shut_down(Time(0), true);
        let off = (1..).find(|n| {
            let sight = if n % 2 == 0 { MOVING } else { LOST };
            sequence.step(Time(300 * n), sight) == POWER_OFF
        });
        assert_eq!(off, Some(7), "its time runs once more from its first return");
        let mut sequence = start(plan(Ramp, Disable), 100.0);
        let off = (1..99).find(|n| {
            let sight = if n % 3 == 0 { LOST } else { MOVING };
            sequence.step(Time(200 * n), Sight { velocity: 90.0, ..sight }) == POWER_OFF
        });
        assert_eq!(off, None, "without a shutdown it waits for the drive");
    }

    #[test]
    fn a_drive_that_is_off_already_gets_the_power_off_request() {
        let (mut sequence, command) = StopSequence::start(plan(Coast, Disable), Load::Level, Time(5), 0.0);
        assert_eq!(command, Command::Disable);
        // A reply that is older than the command says nothing, nor does a held one.
        sequence.steps(&[(5, OFF, None, false), (6, held(OFF), None, false), (6, OFF, None, true)]);
        // Held until now, then it dropped out by itself.
        let mut sequence = start(plan(Quick, Hold), 0.0).stands();
        sequence.shut_down(Time(2), true);
        sequence.steps(&[(3, OFF, POWER_OFF, false)]);
    }

    #[test]
    fn a_time_out_ends_by_its_policy() {
        // The ramp has its time, and the quick stop.
        let ramp = [(999, MOVING, None, false), (1_000, MOVING, QUICK, false), (1_999, MOVING, None, false)];
        let mut sequence = start(plan(Ramp, Hold), 100.0);
        sequence.steps(&ramp);
        sequence.steps(&[(2_000, MOVING, POWER_OFF, false)]);
        let hold = StopPlan { on_timeout: StopTimeout::Hold, ..plan(Ramp, Disable) };
        let mut sequence = start(hold, 100.0);
        sequence.steps(&ramp);
        sequence.steps(&[(2_000, MOVING, None, true)]);
        // A shutdown gives it the time once more, and only once.
        sequence.shut_down(Time(2_100), true);
        assert!(!sequence.is_down());
        assert_eq!(sequence.step(Time(3_100), MOVING), None);
        sequence.shut_down(Time(3_100), true);
        assert!(sequence.is_down());
    }

    #[test]
    fn a_stop_is_as_steep_as_its_time_requires() {
        let plan = StopPlan { timeout: Duration::from_secs(2), ..plan(Ramp, Hold) };
        // 100 from the plan; 1000 in 80 % of 2 s.
        for (velocity, deceleration) in [(0.0, 100.0), (160.0, 100.0), (1_000.0, 625.0), (f64::NAN, 100.0)] {
            let (_, command) = StopSequence::start(plan, Load::Level, Time(0), velocity);
            assert_eq!(command, Command::Stop { deceleration: Some(deceleration) }, "{velocity}");
            let weak = deceleration_of(&plan, 1e-9, velocity);
            assert_eq!(weak, if velocity.is_nan() { 1e-9 } else { velocity / 1.6 }.max(1e-9));
        }
    }

    #[test]
    fn a_ramp_that_is_not_taken_or_does_not_slow_the_axis_down_becomes_its_quick_stop_once() {
        let sight = |velocity| Sight { velocity, ..MOVING };
        let failed = Sight { failed: true, ..MOVING };
        for (what, from, at, seen, command) in [
            ("not taken", 0.0, 1, failed, QUICK),
            ("a quarter of its time is left to it", 100.0, 250, sight(96.0), None),
            ("no slower", 100.0, 251, sight(96.0), QUICK),
            ("no slower, the other way", 100.0, 251, sight(-96.0), QUICK),
            ("just slower", 100.0, 251, sight(95.0), None),
            ("slower", 100.0, 251, sight(94.0), None),
            ("slower, late", 100.0, 999, sight(94.0), None),
            ("held values prove nothing", 100.0, 999, held(sight(100.0)), None),
            ("nor does a speed that was not known", f64::NAN, 999, sight(100.0), None),
            ("at standstill nothing is slower", 0.4, 251, STANDING, None),
        ] {
            assert_eq!(start(plan(Ramp, Disable), from).step(Time(at), seen), command, "{what}");
        }
        let mut sequence = start(plan(Ramp, Disable), 100.0);
        sequence.steps(&[
            (300, failed, QUICK, false),
            // Once, and it has as much time.
            (1_299, Sight { velocity: 100.0, ..failed }, None, false),
            (1_300, sight(100.0), POWER_OFF, false),
        ]);
    }

    #[test]
    fn an_axis_that_moves_again_is_stopped_by_the_quick_stop_and_the_third_time_loses_its_power_if_it_may() {
        for (how, on_timeout, first, third) in [
            (Ramp, StopTimeout::Disable, Command::QuickStop, Command::Disable),
            (Ramp, StopTimeout::Hold, Command::QuickStop, Command::QuickStop),
            // This axis is never braked.
            (Coast, StopTimeout::Hold, Command::Disable, Command::Disable),
        ] {
            let mut sequence = start(StopPlan { on_timeout, ..plan(how, Hold) }, 0.0);
            for command in [first, first, third, third] {
                (0..3).for_each(|_| assert_eq!(sequence.step(Time(1), STANDING), None));
                sequence.step(Time(2), OFF);
                assert!(sequence.is_down(), "{how:?} {on_timeout:?}");
                assert_eq!(sequence.again(Time(1), 50.0), command, "{how:?} {on_timeout:?}");
                assert!(!sequence.is_down(), "{how:?} {on_timeout:?}");
            }
        }
    }

    #[test]
    fn a_load_that_only_the_drive_holds_keeps_its_power_to_the_very_end() {
        let hold = StopPlan { on_timeout: StopTimeout::Hold, ..plan(Ramp, Hold) };
        let start = || StopSequence::start(hold, Load::Vertical(HeldBy::Drive), Time(0), 0.0).0;
        let mut sequence = start();
        sequence.shut_down(Time(1), true);
        assert_eq!(sequence.hurry(Time(1)), QUICK);
        // Not by its time-out, however short.
        sequence.steps(&[(400_000_000, MOVING, None, true)]);
        let mut sequence = start().stands();
        sequence.shut_down(Time(2), true);
        assert!(sequence.is_down());
        // Its power goes while the shutdown waits for others.
        sequence.shut_down(Time(3), false);
        sequence.steps(&[(4, OFF, POWER_OFF, false), (5, OFF, None, true)]);
        sequence.shut_down(Time(6), false);
        assert!(sequence.is_down());
        // Off already when the shutdown comes: its control word has to say so.
        let mut sequence = start().stands();
        sequence.shut_down(Time(3), false);
        sequence.steps(&[(4, OFF, POWER_OFF, false)]);
    }
}
