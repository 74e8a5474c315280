//! Ramps and physics: a speed takes the time that it takes.

use super::*;

fn within(value: f64, expected: f64, tolerance: f64) -> bool {
    (value - expected).abs() <= tolerance
}

#[test]
fn ramps_take_their_seconds_to_1000_rpm() {
    for (up, down, rpm) in [(0.2, 0.2, 1_500), (2.0, 0.5, 1_000), (0.1, 3.0, 500)] {
        let mut bench = Bench::idle_with(|settings| settings.ramps_s = (up, down));
        bench.write(Parameter::REFERENCE, rpm * 10);
        // The windows at both ends, 5 rpm each, are left out.
        let ms = |seconds: f64| seconds * f64::from(rpm - 5);
        let rising = bench.settled(C::FORWARD) as f64;
        assert!(within(rising, ms(up), 3.0), "{rising} ms up at {up} s");
        bench.wait(S);
        let falling = bench.settled(C::ENABLED) as f64;
        assert!(within(falling, ms(down), 3.0), "{falling} ms down at {down} s");
    }
}

#[test]
fn a_reversal_brakes_to_zero_and_speeds_up_on_the_other_side() {
    let mut bench = Bench::idle_with(|settings| settings.ramps_s = (0.4, 0.2));
    bench.write(Parameter::REFERENCE, 10_000);
    bench.settled(C::FORWARD);
    bench.wait(S);
    bench.control(C::BACKWARD);
    bench.wait(199 * MS);
    assert!(within(bench.speed(), 0.0, 1e-9), "{}", bench.speed());
    bench.wait(200 * MS);
    assert!(within(bench.speed(), -500.0, 1e-9), "{}", bench.speed());
    bench.wait(S);
    assert_eq!(bench.speed(), -1_000.0);
}

#[test]
fn ramps_that_are_written_or_switched_off_count_at_once() {
    let mut bench = Bench::enabled(1_000);
    bench.write(RAMP, 1_000);
    bench.control(C::FORWARD);
    bench.wait(99 * MS);
    assert!(within(bench.speed(), 100.0, 1e-9));
    bench.write(RAMP, 100);
    bench.wait(10 * MS);
    assert!(within(bench.speed(), 200.0, 1e-9));
    bench.write(parameter("02.002"), 0);
    bench.wait(MS);
    assert_eq!(bench.read(POST_RAMP), 10_000);
}

#[test]
fn the_ramp_does_not_depend_on_how_often_it_is_looked_at() {
    let arrive = |look_ns: u64| {
        let mut bench = Bench::enabled(1_000);
        bench.control(C::FORWARD);
        for _ in 0..150 * MS / look_ns {
            bench.wait(look_ns);
            bench.status();
        }
        bench.read_block::<1>(Parameter::SPEED)
    };
    assert_eq!(arrive(150 * MS), arrive(MS));
    assert_eq!(arrive(150 * MS), arrive(MS / 50));
}

#[test]
fn current_and_load_are_those_of_the_torque() {
    let mut bench = Bench::enabled(1_500);
    bench.control(C::FORWARD);
    bench.wait(100 * MS);
    // 5000 rpm/s of 0.005 kg m2 are 2.618 N m, plus 0.1 of friction and a third of half of 1.5 N m of load; 5 N m are
    // 100 % and 3 A.
    let torque = 2.618 + 0.1 + 0.25;
    let (load, current) = (bench.read(Parameter::LOAD), bench.read(CURRENT));
    assert!(within(f64::from(load) / 10.0, torque * 20.0, 0.5), "{load}");
    assert!(within(f64::from(current) / 1e3, torque * 0.6, 0.02), "{current}");
    bench.wait(S);
    let load = bench.read(Parameter::LOAD);
    assert!(within(f64::from(load) / 10.0, (0.75 + 0.1) * 20.0, 0.2), "{load}");
    // Three pole pairs at 25 turns a second.
    assert_eq!(bench.read(parameter("05.001")), 750);
    assert_eq!(bench.read(parameter("05.005")), 565);
    bench.control(C::IDLE);
    assert_eq!((bench.read(Parameter::LOAD), bench.read(CURRENT)), (0, 0));
}

#[test]
fn the_current_limit_makes_it_late_and_says_so() {
    let mut bench = Bench::enabled(1_500);
    bench.write(parameter("04.007"), 300);
    bench.control(C::FORWARD);
    bench.wait(50 * MS);
    assert!(bench.status().has(W::CURRENT_LIMIT | W::BELOW_SPEED));
    assert_eq!(bench.read(Parameter::LOAD), 300);
    assert!(bench.read(parameter("03.003")) > 0);
    // 1.5 N m less friction and load, for 0.785 N m s: more than twice the time of the ramp.
    let took = 51 + bench.until(|status| status.at_speed());
    assert!((600..1_200).contains(&took), "{took} ms");
    bench.wait(S);
    assert!(!bench.status().has(W::CURRENT_LIMIT));
}

#[test]
fn a_load_over_the_limit_is_never_moved_to_its_speed() {
    let mut bench = Bench::idle_with(|settings| settings.motor.load_nm = 20.0);
    bench.write(Parameter::REFERENCE, 30_000);
    bench.control(C::FORWARD);
    bench.wait(20 * S);
    let status = bench.status();
    assert!(status.has(W::CURRENT_LIMIT | W::LOAD_REACHED | W::BELOW_SPEED), "{status:?}");
    // 12.5 N m less 0.1 of friction, of 20 N m at 3000 rpm.
    assert!(within(bench.speed(), 3_000.0 * 12.4 / 20.0, 1.0), "{}", bench.speed());
}

#[test]
fn a_long_silence_ends_where_many_short_ones_do() {
    let mut bench = Bench::enabled(1_500);
    bench.control(C::FORWARD);
    bench.wait(3_600 * S);
    assert_eq!(bench.speed(), 1_500.0);
    bench.control(C::IDLE);
    bench.wait(3_600 * S);
    assert_eq!(bench.speed(), 0.0);
}
