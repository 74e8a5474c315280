//! Setpoints of each mode, and homing.

use super::*;

#[test]
fn velocity_setpoints_are_increments_per_250_us_and_ramped() {
    let mut bench = Bench::turning(4_096, 50);
    // 10 000 rpm/s.
    let rpm = bench.drive.rpm();
    assert!((450.0..520.0).contains(&rpm), "{rpm}");
    assert!(!bench.shows(status::TARGET_REACHED));
    bench.cycles(200);
    // 4096 * 4000 / 2^20 turns a second.
    assert!((bench.drive.rpm() - 937.5).abs() < 1.0, "{}", bench.drive.rpm());
    assert_eq!(bench.status(), 0x0637);
    let before = bench.got(POSITION);
    bench.cycles(4);
    let way = bench.got(POSITION) - before;
    assert!((way - 16 * 4_096).abs() < 100, "{way}");
    bench.control(0x0F | control::HALT);
    bench.cycles(300);
    assert!(bench.drive.rpm().abs() < 1.0);
}

#[test]
fn profile_velocity_uses_60ff_by_sdo() {
    let mut bench = Bench::enabled(mode::PROFILE_VELOCITY, 0x1702, 0x1B03);
    bench.write(0x60FF, 0, &(-4_096_i32).to_le_bytes()).unwrap();
    bench.cycles(300);
    assert!((bench.drive.rpm() + 937.5).abs() < 1.0, "{}", bench.drive.rpm());
    let shown = bench.read(0x606C, 0).unwrap();
    assert!((shown + 4_096).abs() <= 4, "{shown}");
}

#[test]
fn current_setpoints_accelerate_by_torque_over_inertia_up_to_the_limit() {
    let mut bench = Bench::enabled(mode::DIGITAL_CURRENT, 0x1703, 0x1B03);
    // 0.5 N m less 0.1 of friction on 0.002 kg m^2: 200 rad/s^2.
    bench.put(CURRENT_SETPOINT, 100);
    bench.cycles(101);
    let speed = bench.drive.rpm() * RPM;
    assert!((speed - 20.0).abs() < 0.5, "{speed}");
    assert_eq!(bench.got(TORQUE), 100);
    bench.write(0x6072, 0, &50_u16.to_le_bytes()).unwrap();
    bench.cycles(2);
    assert_eq!(bench.got(TORQUE), 50);
}

#[test]
fn positions_wrap_at_32_bits() {
    let mut bench = Bench::pre_op(|settings| settings.position = i32::MAX - 50_000);
    bench.select(0x1C12, 0x1701);
    bench.write(0x6060, 0, &[0x85]).unwrap();
    bench.go_to_op();
    let start = i64::from(i32::MAX - 50_000);
    assert_eq!(bench.got(POSITION), start);
    bench.put(INTERPOLATION, start);
    bench.enable();
    for cycle in 1..=100 {
        bench.put(INTERPOLATION, start + cycle * 1_000);
        bench.cycle();
    }
    bench.cycles(100);
    let wrapped = i64::from((start + 100_000) as i32);
    assert!(wrapped < 0 && (bench.got(POSITION) - wrapped).abs() < 20, "{}", bench.got(POSITION));
    assert_eq!(bench.drive.fault(), None);
}

#[test]
fn interpolated_position_follows_only_with_bit_4() {
    let mut bench = Bench::enabled(mode::INTERPOLATED, 0x1701, 0x1B03);
    bench.put(INTERPOLATION, 10_000);
    bench.cycles(100);
    assert_eq!(bench.got(POSITION), 0);
    bench.control(0x1F);
    bench.cycles(100);
    assert!((bench.got(POSITION) - 10_000).abs() < 20, "{}", bench.got(POSITION));
    assert!(bench.shows(status::MODE_12));
}

#[test]
fn profile_position_goes_on_an_edge_and_acknowledges_it() {
    let mut bench = Bench::enabled(mode::PROFILE_POSITION, 0x1704, 0x1B03);
    bench.put(TARGET_POSITION, (3 * TURN).into());
    bench.cycles(100);
    assert_eq!(bench.got(POSITION), 0, "without an edge it stands");
    bench.control(0x1F);
    assert!(bench.shows(status::MODE_12) && !bench.shows(status::TARGET_REACHED));
    bench.control(0x0F);
    assert!(!bench.shows(status::MODE_12));
    bench.cycles(1_000);
    assert!((bench.got(POSITION) - i64::from(3 * TURN)).abs() < 200, "{}", bench.got(POSITION));
    assert!(bench.shows(status::TARGET_REACHED));
    // Relative, and back.
    bench.put(TARGET_POSITION, (-TURN).into());
    bench.control(0x5F);
    bench.cycles(1_000);
    assert!((bench.got(POSITION) - i64::from(2 * TURN)).abs() < 200, "{}", bench.got(POSITION));
}

#[test]
fn homing_goes_to_the_switch_and_sets_the_offset_there() {
    let mut bench = Bench::enabled(mode::HOMING, 0x1702, 0x1B03);
    bench.write(0x607C, 0, &5_000_i32.to_le_bytes()).unwrap();
    assert!(!bench.drive.is_homed());
    bench.control(0x1F);
    bench.cycles(50);
    assert!(!bench.shows(status::MODE_12) && bench.drive.rpm() > 10.0);
    // Half a turn at 60 rpm.
    bench.cycles(900);
    assert!(bench.shows(status::MODE_12 | status::TARGET_REACHED));
    assert!(bench.drive.is_homed());
    assert!((bench.got(POSITION) - 5_000).abs() < 500, "{}", bench.got(POSITION));
    assert_eq!(bench.read(0x1002, 0).unwrap() as u32 & 2, 2);
}
