//! Streamed setpoints: period, delay, interpolation and the four errors (SG5 manual, streaming).

use super::*;
use fieldbeat_linudp::motion::{SignedAcceleration, SignedVelocity};

/// 0.5 rad/s and 100 mm: 50 mm/s and 25 mm/s2 at most.
const OMEGA: f64 = 0.5;
const AMPLITUDE: f64 = 1e6;

/// Position, velocity, acceleration in wire units, from 0 on, at standstill.
fn row(at_ns: u64) -> (i32, i32, i32) {
    let phase = OMEGA * at_ns as f64 / S as f64;
    (
        (AMPLITUDE * (1.0 - phase.cos())).round() as i32,
        (AMPLITUDE * OMEGA * phase.sin() / 10.0).round() as i32,
        (AMPLITUDE * OMEGA * OMEGA * phase.cos() / 100.0).round() as i32,
    )
}

impl Bench {
    /// One setpoint `interval_ns` after the last exchange.
    fn stream(&mut self, command: StreamCommand, interval_ns: u64, row: (i32, i32, i32)) -> Response {
        self.now = self.now + interval_ns - MS;
        self.command(MotionCommand::stream(
            command,
            Position(row.0),
            SignedVelocity(row.1),
            SignedAcceleration(row.2),
        ))
    }
}

/// Streams until the drive says something of it; the number of setpoints that went well.
fn stream_for(bench: &mut Bench, command: StreamCommand, interval_ns: u64, most: u64) -> (u64, ErrorCode) {
    for n in 0..most {
        let error = bench.stream(command, interval_ns, row(n * interval_ns)).error.unwrap();
        if error != ErrorCode::NONE {
            return (n, error);
        }
    }
    (most, ErrorCode::NONE)
}

#[test]
fn every_command_follows_its_rows_one_and_a_half_periods_late() {
    use StreamCommand as C;
    for (command, period_ns, tolerance) in [
        (C::P, 2 * MS, 60),
        (C::Pv, 2 * MS, 3),
        (C::PConfigured, 2 * MS, 60),
        (C::PvConfigured, 2 * MS, 3),
        (C::Pva, MS, 3),
        (C::PvaConfigured, 2 * MS, 3),
    ] {
        let mut bench = Bench::homed();
        for n in 0..3_000 {
            let response = bench.stream(command, period_ns, row(n * period_ns));
            assert_eq!(response.error, Some(ErrorCode::NONE), "{command:?} at {n}");
            assert!(response.status.unwrap().motion_active());
            if n >= 2 {
                let expected = row(n * period_ns - 3 * period_ns / 2).0;
                let demand = response.demand.unwrap();
                assert!(
                    (demand - expected).abs() <= tolerance,
                    "{command:?} at {n}: {demand}, not {expected}"
                );
            }
        }
        // The axis is there, too.
        let response = bench.exchange(None);
        assert!((response.actual.unwrap() - response.demand.unwrap()).abs() < 5_000);
    }
}

#[test]
fn the_first_interval_has_to_fit_the_command() {
    use StreamCommand as C;
    for (command, interval_ns, code) in [
        (C::P, MS, ErrorCode::STREAM_TOO_FAST),
        (C::P, 2 * MS, ErrorCode::NONE),
        (C::P, 5 * MS, ErrorCode::NONE),
        (C::Pv, 7 * MS, ErrorCode::STREAM_TOO_SLOW),
        (C::Pva, MS, ErrorCode::NONE),
        (C::Pva, 10 * MS, ErrorCode::NONE),
        (C::Pva, 13 * MS, ErrorCode::STREAM_TOO_SLOW),
    ] {
        let (_, error) = stream_for(&mut Bench::homed(), command, interval_ns, 100);
        assert_eq!(error, code, "{command:?} every {interval_ns} ns");
    }
    // The configured period is checked as it is.
    let mut bench = Bench::homed_with(|plan| plan.stream_period_ns = MS);
    assert_eq!(stream_for(&mut bench, C::PConfigured, MS, 100), (0, ErrorCode::STREAM_TOO_FAST));
    // A single setpoint is too slow a stream; a jump at its start is more than the motor can follow.
    let mut bench = Bench::homed();
    bench.stream(C::P, 2 * MS, (0, 0, 0));
    assert_eq!(bench.until_error(), ErrorCode::STREAM_TOO_SLOW);
    let mut bench = Bench::homed();
    let jump = |bench: &mut Bench| bench.stream(C::P, 2 * MS, (19 * CM, 0, 0)).error.unwrap();
    let error = (0..50).map(|_| jump(&mut bench)).find(|error| *error != ErrorCode::NONE);
    assert_eq!(error, Some(ErrorCode::POSITION_LAG));
}

#[test]
fn a_stream_runs_dry_after_two_and_a_half_periods_and_one_faster_than_its_period_overflows() {
    for (silence_ns, runs_dry) in [(5 * MS, false), (5 * MS + 500 * US, true), (3_600 * S, true)] {
        let mut bench = Bench::homed();
        stream_for(&mut bench, StreamCommand::PvConfigured, 2 * MS, 500);
        bench.now = bench.now + silence_ns - MS;
        assert_eq!(bench.exchange(None).status.unwrap().error(), runs_dry, "{silence_ns} ns");
        assert!(!runs_dry || bench.until_error() == ErrorCode::STREAM_UNDERFLOW);
    }
    // One a millisecond, one in two used up: the buffer of 8 holds out for about 12.
    let (held, error) = stream_for(&mut Bench::homed(), StreamCommand::PvConfigured, MS, 100);
    assert_eq!(error, ErrorCode::STREAM_OVERFLOW);
    assert!((10..16).contains(&held), "{held}");
}

#[test]
fn a_stream_survives_losses_and_jitter_and_does_not_run_ahead_of_what_was_received() {
    let period_ns = 2 * MS;
    for (command, lost_of, jitters) in [
        (StreamCommand::Pv, 100, true),
        (StreamCommand::PvConfigured, 100, true),
        (StreamCommand::PvConfigured, 10, false),
    ] {
        let mut bench = Bench::homed();
        for n in 0..2_000_u64 {
            let at = bench.now;
            if n % lost_of != lost_of - 1 {
                let jitter_ns = if jitters { n * 7_919 % 5 * 100 * US } else { 0 };
                let (position, velocity, _) = row(n * period_ns);
                let response = bench.stream(command, period_ns + jitter_ns, (position, velocity, 0));
                assert_eq!(response.error, Some(ErrorCode::NONE), "{command:?} at {n}");
                let ahead = response.demand.unwrap() - position;
                assert!(jitters || ahead <= 0, "{command:?} at {n}: {ahead} ahead");
            }
            bench.now = at + period_ns;
        }
    }
}
