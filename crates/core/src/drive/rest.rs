//! Watch for motion that nobody commands, while the axis has power: idle, holding, or latched.
//!
//! A late duplicate of an old request, a parameter write, another master or the drive's own program can move a drive
//! whose commands have all ended. What is left of an ended motion only decays: a speed that rises again, or that
//! lasts, is a motion of its own.

use crate::axis::{DriveStatus, StopPlan};
use crate::time::{MS, Time, nanos};

/// So many reports in a row, in one direction, are proof: a push or a disturbance leads there and back again.
const REPORTS: u32 = 3;

/// An axis whose command is done stands still within this time, ns, or within `standstill_for` exchanges if that is
/// longer: its motor may lag its setpoint.
const SETTLED_WITHIN_NS: u64 = 50 * MS;

/// A stopped motor overshoots by no more than the speed that its stop takes away in this time, s.
const OVERSHOOT_SECONDS: f64 = 0.01;

/// What the axis may still do.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum Phase {
    /// Move: something commands it.
    #[default]
    Commanded,
    /// Brake: its command has failed. Since when, and the lowest speed since then, user units/s.
    Braking { since: Option<Time>, slowest: f64 },
    /// Brake: its stop sequence runs, and ends at standstill.
    Stopping,
    /// Come to rest, with the overshoot that belongs to it. Since when, and the highest speed of that, user units/s.
    Settling { since: Time, fastest: f64 },
    /// Nothing.
    Resting,
}

/// The watch over one axis.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Rest {
    phase: Phase,
    /// Reports in a row of a motion of its own in one direction.
    moved: u32,
    forward: bool,
}

impl Rest {
    /// Something commands the axis.
    pub(super) fn interrupt(&mut self) {
        if self.phase != Phase::Commanded {
            *self = Rest::default();
        }
    }

    /// It has no power: what comes with power that no command has switched on is a motion of its own.
    pub(super) fn power_off(&mut self) {
        *self = Rest { phase: Phase::Resting, ..Rest::default() };
    }

    /// Its stop sequence runs.
    pub(super) fn stop(&mut self) {
        *self = Rest { phase: Phase::Stopping, ..Rest::default() };
    }

    /// The command has failed.
    pub(super) fn fail(&mut self) {
        *self = Rest { phase: Phase::Braking { since: None, slowest: f64::INFINITY }, ..Rest::default() };
    }

    /// A clean report of an axis with power that nothing commands. Exchanges are `seconds` apart. True if it moves
    /// by itself.
    pub(super) fn moves(&mut self, now: Time, report: &DriveStatus, stop: &StopPlan, seconds: f64) -> bool {
        let DriveStatus { moving, velocity, .. } = *report;
        // Without a velocity only the protocol knows.
        let speed = if velocity.is_nan() { 0.0 } else { velocity.abs() };
        let stands = !moving && speed <= stop.standstill;
        let own = match &mut self.phase {
            Phase::Stopping => {
                let overshoot = stop.standstill.max(stop.deceleration * OVERSHOOT_SECONDS);
                self.phase = Phase::Settling { since: now, fastest: stop.standstill + overshoot };
                false
            }
            Phase::Commanded => {
                self.phase = Phase::Settling { since: now, fastest: f64::INFINITY };
                false
            }
            Phase::Braking { .. } if stands => {
                self.phase = Phase::Settling { since: now, fastest: f64::INFINITY };
                false
            }
            Phase::Braking { since, slowest } => {
                let faster = speed > *slowest + stop.standstill;
                *slowest = slowest.min(speed);
                if now.since(*since.get_or_insert(now)) > nanos(stop.timeout) {
                    return true;
                }
                faster
            }
            Phase::Settling { since, fastest } => {
                let faster = speed > *fastest;
                let exchanges_ns = (f64::from(stop.standstill_for) * seconds * 1e9) as u64;
                if now.since(*since) >= SETTLED_WITHIN_NS.max(exchanges_ns) {
                    self.phase = Phase::Resting;
                }
                faster
            }
            Phase::Resting => !stands,
        };
        let forward = velocity >= 0.0;
        let before = if forward == self.forward { self.moved } else { 0 };
        (self.moved, self.forward) = (if own { before + 1 } else { 0 }, forward);
        self.moved >= REPORTS
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::{AxisPlan, Units};

    /// Standstill below 5 mm/s.
    fn stop() -> StopPlan {
        AxisPlan::new("x", Units::millimetres(1_000.0)).stop
    }

    /// The report, counted from 0, at which the watch trips; so many ms apart.
    fn trips_at(
        begin: fn(&mut Rest),
        stop: &StopPlan,
        ms: u64,
        reports: impl IntoIterator<Item = (bool, f64)>,
    ) -> Option<usize> {
        let mut rest = Rest::default();
        begin(&mut rest);
        reports.into_iter().enumerate().position(|(index, (moving, velocity))| {
            let report = DriveStatus { moving, velocity, ..DriveStatus::default() };
            rest.moves(Time(ms * MS * index as u64), &report, stop, ms as f64 * 1e-3)
        })
    }

    /// After a command that is done, at 1 kHz.
    fn trips(reports: impl IntoIterator<Item = (bool, f64)>) -> Option<usize> {
        trips_at(|_| (), &stop(), 1, reports)
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
        assert_eq!(trips_at(Rest::power_off, &stop(), 1, [(true, 1.0); 9]), Some(2));
    }

    #[test]
    fn an_axis_settles_in_its_time_or_in_as_many_exchanges_as_prove_its_standstill_and_no_longer() {
        let ringing =
            (0..2_000).map(|n| (false, 300.0 * (f64::from(n) * 0.2).sin() * (-0.1 * f64::from(n)).exp()));
        assert_eq!(trips(ringing), None);
        assert_eq!(trips([(true, 40.0); 100]), Some(53), "done, and it goes on");
        for (standstill_for, tripped) in [(20, 23), (3, 8)] {
            let stop = StopPlan { standstill_for, ..stop() };
            let found = trips_at(|_| (), &stop, 10, [(false, 40.0); 99]);
            assert_eq!(found, Some(tripped), "{standstill_for} exchanges of 10 ms");
        }
    }

    #[test]
    fn after_its_stop_an_axis_overshoots_no_more_than_its_stop_brakes_in_ten_milliseconds() {
        let stop = StopPlan { deceleration: 4_000.0, standstill: 5.0, ..stop() };
        let trips = |reports: &[f64]| trips_at(Rest::stop, &stop, 1, reports.iter().map(|v| (false, *v)));
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
            assert_eq!(trips_at(Rest::fail, &stop(), 1, reports), tripped, "{what}");
        }
    }
}
