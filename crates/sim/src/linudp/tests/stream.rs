//! Streamed setpoints: period, delay, interpolation and the four errors (SG5 manual, streaming).

use super::*;

/// Stream commands: positions, with velocities, with accelerations; by the time of reception, or a configured period.
const P: u16 = 0x030;
const PV: u16 = 0x031;
const P_CONFIGURED: u16 = 0x032;
const PV_CONFIGURED: u16 = 0x033;
const PVA: u16 = 0x034;
const PVA_CONFIGURED: u16 = 0x035;

/// 0.5 rad/s and 100 mm: 50 mm/s and 25 mm/s2 at most.
const OMEGA: f64 = 0.5;
const AMPLITUDE: f64 = 1e6;

/// Position, velocity, acceleration in wire units, from 0 on, at standstill.
fn row(at_ns: u64) -> [i64; 3] {
    let phase = OMEGA * at_ns as f64 / S as f64;
    let values = [1.0 - phase.cos(), OMEGA * phase.sin() / 10.0, OMEGA * OMEGA * phase.cos() / 100.0];
    values.map(|value| (AMPLITUDE * value).round() as i64)
}

impl Bench {
    /// One setpoint `interval_ns` after the last exchange.
    fn stream(&mut self, id: u16, interval_ns: u64, row: [i64; 3]) -> Report {
        self.now = self.now + interval_ns - MS;
        self.command(motion(id, &row))
    }
}

/// Streams until the drive reports an error; the number of setpoints without one.
fn stream_for(bench: &mut Bench, id: u16, interval_ns: u64, most: u64) -> (u64, u16) {
    for n in 0..most {
        let error = bench.stream(id, interval_ns, row(n * interval_ns)).error;
        if error != errors::NONE {
            return (n, error);
        }
    }
    (most, errors::NONE)
}

#[test]
fn every_command_follows_its_rows_one_and_a_half_periods_late() {
    for (id, period_ns, tolerance) in [
        (P, 2 * MS, 60),
        (PV, 2 * MS, 3),
        (P_CONFIGURED, 2 * MS, 60),
        (PV_CONFIGURED, 2 * MS, 3),
        (PVA, MS, 3),
        (PVA_CONFIGURED, 2 * MS, 3),
    ] {
        let mut bench = Bench::homed();
        for n in 0..3_000 {
            let report = bench.stream(id, period_ns, row(n * period_ns));
            assert_eq!(report.error, errors::NONE, "{id:03X} at {n}");
            assert!(report.has(status::MOTION_ACTIVE));
            if n >= 2 {
                let [expected, ..] = row(n * period_ns - 3 * period_ns / 2);
                let demand = i64::from(report.demand);
                assert!((demand - expected).abs() <= tolerance, "{id:03X} at {n}: {demand}, not {expected}");
            }
        }
        // The axis is there, too.
        let report = bench.exchange(None);
        assert!((report.actual - report.demand).abs() < 5_000);
    }
}

#[test]
fn the_first_interval_has_to_fit_the_command() {
    for (id, interval_ns, code) in [
        (P, MS, errors::STREAM_TOO_FAST),
        (P, 2 * MS, errors::NONE),
        (P, 5 * MS, errors::NONE),
        (PV, 7 * MS, errors::STREAM_TOO_SLOW),
        (PVA, MS, errors::NONE),
        (PVA, 10 * MS, errors::NONE),
        (PVA, 13 * MS, errors::STREAM_TOO_SLOW),
    ] {
        let (_, error) = stream_for(&mut Bench::homed(), id, interval_ns, 100);
        assert_eq!(error, code, "{id:03X} every {interval_ns} ns");
    }
    // The configured period is checked as it is.
    let mut bench = Bench::homed_with(|plan| plan.stream_period_ns = MS);
    assert_eq!(stream_for(&mut bench, P_CONFIGURED, MS, 100), (0, errors::STREAM_TOO_FAST));
    // A single setpoint is too slow a stream; a jump at its start is more than the motor can follow.
    let mut bench = Bench::homed();
    bench.stream(P, 2 * MS, [0; 3]);
    assert_eq!(bench.until_error(), errors::STREAM_TOO_SLOW);
    let mut bench = Bench::homed();
    let mut jumps = (0..50).map(|_| bench.stream(P, 2 * MS, [(19 * CM).into(), 0, 0]).error);
    assert_eq!(jumps.find(|error| *error != errors::NONE), Some(errors::POSITION_LAG));
}

#[test]
fn a_stream_runs_dry_after_two_and_a_half_periods_and_one_faster_than_its_period_overflows() {
    for (silence_ns, runs_dry) in [(5 * MS, false), (5 * MS + 500 * US, true), (3_600 * S, true)] {
        let mut bench = Bench::homed();
        stream_for(&mut bench, PV_CONFIGURED, 2 * MS, 500);
        bench.now = bench.now + silence_ns - MS;
        assert_eq!(bench.exchange(None).has(status::ERROR), runs_dry, "{silence_ns} ns");
        assert!(!runs_dry || bench.until_error() == errors::STREAM_UNDERFLOW);
    }
    // One a millisecond, one in two used up: the buffer of 8 holds out for about 12.
    let (held, error) = stream_for(&mut Bench::homed(), PV_CONFIGURED, MS, 100);
    assert_eq!(error, errors::STREAM_OVERFLOW);
    assert!((10..16).contains(&held), "{held}");
}

#[test]
fn a_stream_survives_losses_and_jitter_and_does_not_run_ahead_of_what_was_received() {
    let period_ns = 2 * MS;
    for (id, lost_of, jitters) in [(PV, 100, true), (PV_CONFIGURED, 100, true), (PV_CONFIGURED, 10, false)] {
        let mut bench = Bench::homed();
        for n in 0..2_000_u64 {
            let at = bench.now;
            if n % lost_of != lost_of - 1 {
                let jitter_ns = if jitters { n * 7_919 % 5 * 100 * US } else { 0 };
                let row = row(n * period_ns);
                let report = bench.stream(id, period_ns + jitter_ns, row);
                assert_eq!(report.error, errors::NONE, "{id:03X} at {n}");
                let ahead = i64::from(report.demand) - row[0];
                assert!(jitters || ahead <= 0, "{id:03X} at {n}: {ahead} ahead");
            }
            bench.now = at + period_ns;
        }
    }
}
