use super::*;
use fieldbeat_core::time::MS;

fn motor() -> PowerDrive<u16> {
    let plant = PlantPlan {
        mass_kg: 0.002,
        range: (f64::NEG_INFINITY, f64::INFINITY),
        bandwidth_hz: 60.0,
        damping: 1.0,
        feed_forward: 1.0,
        peak_force_n: 15.0,
        friction_n: 0.1,
    };
    PowerDrive::new(PowerPlan { plant, max_speed: 6_000.0 * RPM, hardware_enable: true, scan_ns: None })
}

/// Lets so many milliseconds pass.
fn run(motor: &mut PowerDrive<u16>, aim: Aim, ms: u64) {
    (0..ms).for_each(|_| motor.step(aim, MS));
}

#[test]
fn it_comes_up_to_speed_with_its_ramp_and_down_with_the_other() {
    let mut motor = motor();
    let [up, down] = [100.0, 0.0].map(|speed| Aim::Velocity { speed, up: 1_000.0, down: 500.0 });
    run(&mut motor, up, 50);
    assert!((motor.speed() - 50.0).abs() < 2.0, "{}", motor.speed());
    run(&mut motor, up, 200);
    assert!((motor.speed() - 100.0).abs() < 0.1);
    run(&mut motor, down, 100);
    assert!((motor.speed() - 50.0).abs() < 2.0, "{}", motor.speed());
    run(&mut motor, down, 300);
    assert!(motor.is_standing());
}
