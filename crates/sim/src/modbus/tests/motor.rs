//! Ramps and physics: a speed takes the time that it takes.

use super::*;

fn within(value: f64, expected: f64, tolerance: f64) -> bool {
    (value - expected).abs() <= tolerance
}

#[test]
fn current_and_load_are_those_of_the_torque() {
    let mut bench = Bench::enabled(1_500);
    bench.control(C::FORWARD);
    bench.wait(100 * MS);
    // 5000 rpm/s of 0.005 kg m2 are 2.618 N m, plus 0.1 of friction and a third of half of 1.5 N m of load; 5 N m are
    // 100 % and 3 A.
    let torque = 2.618 + 0.1 + 0.25;
    let (load, current) = (bench.read(LOAD), bench.read(CURRENT));
    assert!(within(f64::from(load) / 10.0, torque * 20.0, 0.5), "{load}");
    assert!(within(f64::from(current) / 1e3, torque * 0.6, 0.02), "{current}");
    bench.wait(S);
    let load = bench.read(LOAD);
    assert!(within(f64::from(load) / 10.0, (0.75 + 0.1) * 20.0, 0.2), "{load}");
    // Three pole pairs at 25 turns a second.
    assert_eq!(bench.read([5, 1]), 750);
    assert_eq!(bench.read([5, 5]), 565);
    bench.control(C::IDLE);
    assert_eq!((bench.read(LOAD), bench.read(CURRENT)), (0, 0));
}

#[test]
fn a_load_over_the_limit_is_never_moved_to_its_speed() {
    let mut bench = Bench::idle_with(|settings| settings.motor.load_nm = 20.0);
    bench.write(REFERENCE, 30_000);
    bench.control(C::FORWARD);
    bench.wait(20 * S);
    assert!(bench.is(W::CURRENT_LIMIT | W::LOAD_REACHED | W::BELOW_SPEED));
    // 12.5 N m less 0.1 of friction, of 20 N m at 3000 rpm.
    assert!(within(bench.speed(), 3_000.0 * 12.4 / 20.0, 1.0), "{}", bench.speed());
}
