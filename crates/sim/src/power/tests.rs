use super::*;
use fieldbeat_core::time::MS;

fn motor() -> PowerDrive<u16> {
    of(None)
}

fn of(scan_ns: Option<u64>) -> PowerDrive<u16> {
    let plant = PlantPlan {
        mass_kg: 0.002,
        range: (f64::NEG_INFINITY, f64::INFINITY),
        bandwidth_hz: 60.0,
        damping: 1.0,
        feed_forward: 1.0,
        peak_force_n: 15.0,
        friction_n: 0.1,
    };
    PowerDrive::new(PowerPlan { plant, max_speed: 6_000.0 * RPM, hardware_enable: true, scan_ns })
}

/// Lets so many milliseconds pass.
fn run(motor: &mut PowerDrive<u16>, aim: Aim, ms: u64) {
    (0..ms).for_each(|_| motor.step(aim, MS));
}

#[test]
fn it_comes_up_to_speed_with_its_ramp_and_down_with_the_other() {
    let mut motor = motor();
    let up = Aim::Velocity { speed: 100.0, up: 1_000.0, down: 500.0 };
    run(&mut motor, up, 50);
    assert!((motor.speed() - 50.0).abs() < 2.0, "{}", motor.speed());
    run(&mut motor, up, 200);
    assert!((motor.speed() - 100.0).abs() < 0.1);
    run(&mut motor, Aim::Velocity { speed: 0.0, up: 1_000.0, down: 500.0 }, 100);
    assert!((motor.speed() - 50.0).abs() < 2.0, "{}", motor.speed());
    run(&mut motor, Aim::Velocity { speed: 0.0, up: 1_000.0, down: 500.0 }, 300);
    assert!(motor.is_standing());
}

#[test]
fn torque_divided_by_inertia_is_its_acceleration() {
    let mut motor = motor();
    run(&mut motor, Aim::Torque(1.1), 100);
    // 1.1 N m less 0.1 of friction, on 0.002 kg m^2, for 0.1 s.
    assert!((motor.speed() - 50.0).abs() < 0.5, "{}", motor.speed());
    run(&mut motor, Aim::Torque(1e9), 10_000);
    assert!(motor.speed() < 6_200.0 * RPM, "{}", motor.speed() / RPM);
}

#[test]
fn without_power_it_runs_out_and_is_caught_at_its_speed() {
    let mut motor = motor();
    run(&mut motor, Aim::Velocity { speed: 100.0, up: 1e4, down: 1e4 }, 200);
    run(&mut motor, Aim::Off, 500);
    let coasting = motor.speed();
    assert!((70.0..80.0).contains(&coasting), "{coasting}");
    motor.step(Aim::Velocity { speed: coasting, up: 1.0, down: 1.0 }, MS);
    assert!(motor.torque().abs() < 0.5, "{}", motor.torque());
}

#[test]
fn it_follows_places_and_goes_to_one() {
    let mut motor = motor();
    run(&mut motor, Aim::GoTo { place: 10.0, speed: 100.0, up: 1_000.0, down: 1_000.0 }, 1_000);
    assert!((motor.place() - 10.0).abs() < 1e-3 && !motor.is_moving());
    let place = |ms: u64| 10.0 + ms as f64 * 0.01;
    for ms in 0..1_000 {
        motor.step(Aim::Follow { place: place(ms), speed: 10.0, acceleration: 0.0 }, MS);
    }
    assert!((motor.place() - place(999)).abs() < 0.01, "{}", motor.place());
}

/// The steps to `now`.
fn steps(motor: &mut PowerDrive<u16>, now: u64) -> Vec<u64> {
    std::iter::from_fn(|| motor.advance(Time(now))).collect()
}

#[test]
fn it_advances_in_fine_steps_then_in_long_ones_and_arrives() {
    let mut motor = motor();
    assert_eq!((steps(&mut motor, S), motor.now()), (vec![], Time(S)));
    assert_eq!(steps(&mut motor, S + 1_200 * US), [STEP_NS, STEP_NS, 200 * US]);
    let long = steps(&mut motor, 3_600 * S);
    assert_eq!((motor.now(), motor.age_ns()), (Time(3_600 * S), 3_599 * S));
    assert!(long[..2_000].iter().all(|dt| *dt == STEP_NS) && long.len() <= 3_001, "{}", long.len());
    // In whole scans it stays behind by less than one.
    let mut motor = of(Some(MS));
    steps(&mut motor, S);
    assert_eq!(steps(&mut motor, S + 2_900 * US), [MS, MS]);
    assert_eq!((steps(&mut motor, S + 3 * MS), motor.now()), (vec![MS], Time(S + 3 * MS)));
}

#[test]
fn the_first_fault_stays_until_it_can_be_reset() {
    let mut motor = motor();
    steps(&mut motor, S);
    assert!(!motor.reset() && motor.fail(1, Reset::After(10 * MS)) && !motor.fail(2, Reset::Always));
    steps(&mut motor, S + 9 * MS);
    assert!(!motor.reset());
    steps(&mut motor, S + 10 * MS);
    assert_eq!((motor.fault(), motor.reset(), motor.fault()), (Some(1), true, None));
    assert!(motor.fail(3, Reset::Never) && !motor.reset());
    motor.restart();
    assert_eq!((motor.fault(), motor.on_ns()), (None, 0));
}

#[test]
fn the_hardware_enable_opens_for_a_time() {
    let mut motor = motor();
    steps(&mut motor, S);
    motor.inhibit(Time(S + 5 * MS));
    motor.restart();
    assert!(!motor.is_enabled());
    steps(&mut motor, S + 5 * MS);
    assert!(motor.is_enabled());
}
