//! The state machine (SG5 manual).

use super::*;

/// Bit 3 is 0.
const NOT_ENABLED: u16 = control::ON & !control::ENABLE_OPERATION;

#[test]
fn enabling_begins_with_bit_0_low_passes_all_states_and_takes_the_hardware_tests() {
    let mut bench = Bench::new(|_| {});
    for _ in 0..10 {
        let locked = bench.state(control::ON);
        assert!(locked.main() == state::NOT_READY && locked.has(status::SWITCH_ON_LOCKED));
    }
    let unlocked = bench.state(control::ENABLES);
    assert!(unlocked.main() == state::SWITCH_ON_DISABLED && !unlocked.has(status::SWITCH_ON_LOCKED));
    assert_eq!(bench.state(control::ENABLES).main(), state::READY_TO_SWITCH_ON);
    assert_eq!(bench.state(control::ON).main(), state::HW_TESTS);
    // Bit 3 held back: stays in 6.
    bench.control = NOT_ENABLED;
    let tests = bench.until_main(state::READY_TO_OPERATE);
    assert!((299..=301).contains(&tests), "{tests} ms");
    assert!(!bench.exchange(None).has(status::OPERATION_ENABLED));
    assert_eq!(bench.state(control::ON).main(), state::OPERATION_ENABLED);
    let report = bench.exchange(None);
    // On, enabled, voltage, no quick stop, warning (not homed), in target.
    assert_eq!((report.status, report.warn, report.state, report.actual), (0x04B7, 1 << 7, 0x0840, 2 * CM));
}

#[test]
fn homing_takes_the_time_of_its_move_and_waits_for_its_bit() {
    let mut bench = Bench::new(|plan| plan.home_position = 7 * CM);
    bench.enable();
    let report = bench.state(control::ON | control::HOME);
    assert_eq!(report.state, 0x0900);
    assert!(report.has(status::SPECIAL_MOTION | status::MOTION_ACTIVE));
    // 50 mm at 100 mm/s, with 1 m/s2: 0.5 s of way + 0.1 s of ramps, and some to settle.
    let took = bench.until(Report::is_finished);
    assert!((590..700).contains(&took), "{took} ms");
    for _ in 0..5 {
        let report = bench.exchange(None);
        assert_eq!((report.state, report.demand, report.warn), (0x090F, 7 * CM, 0));
        assert!((report.actual - 7 * CM).abs() < 500 && report.has(status::HOMED));
    }
    assert_eq!(bench.state(control::ON).main(), state::OPERATION_ENABLED);
    // Homed survives switching off.
    bench.enable();
    assert!(bench.exchange(None).has(status::HOMED));
    // Released early it is no homing.
    bench.ends_at(go_to(CM, VAD));
    bench.control = control::ON | control::HOME;
    bench.until(|report| report.has(status::MOTION_ACTIVE));
    assert_eq!(bench.state(control::ON).main(), state::OPERATION_ENABLED);
    assert!(!bench.until_standing().has(status::HOMED));
}

#[test]
fn abort_stops_and_stays_freeze_stops_and_goes_on() {
    // The bit, the state, and whether the motion goes on.
    for (bit, state, goes_on) in
        [(control::NO_FREEZE, state::FREEZING, true), (control::NO_ABORT, state::ABORTING, false)]
    {
        let mut bench = Bench::homed();
        bench.command_for(go_to(10 * CM, VAD), 100 * MS);
        assert_eq!(bench.state(control::ON & !bit).main(), state);
        let stopped = bench.until_standing();
        assert!(stopped.demand < 9 * CM);
        bench.control = control::ON;
        let demand = if goes_on { 10 * CM } else { stopped.demand };
        assert_eq!(bench.until_standing().demand, demand);
        assert!(bench.exchange(None).has(status::OPERATION_ENABLED));
    }
}

#[test]
fn quick_stop_brakes_bit_3_goes_back_to_6_and_bits_0_and_1_switch_off() {
    let mut bench = Bench::homed();
    bench.command_for(go_to(10 * CM, VAD), 100 * MS);
    assert_eq!(bench.state(control::ON & !control::NO_QUICK_STOP).main(), state::QUICK_STOP);
    // 0.5 m/s with 20 m/s2.
    let took = bench.until_main(state::NOT_READY);
    assert!((20..30).contains(&took), "{took} ms");
    assert_eq!(bench.state(control::ON).main(), state::NOT_READY);
    bench.enable();
    bench.command(go_to(0, VAD));
    let from = bench.exchange(None).demand;
    assert_eq!(bench.state(NOT_ENABLED).main(), state::READY_TO_OPERATE);
    let report = bench.exchange(None);
    assert!(!report.has(status::MOTION_ACTIVE) && report.demand > from - CM);
    assert_eq!(bench.state(control::ON).main(), state::OPERATION_ENABLED);
    assert_eq!(bench.state(control::ON & !control::VOLTAGE_ENABLE).main(), state::NOT_READY);
    bench.enable();
    assert_eq!(bench.state(control::ENABLES).main(), state::NOT_READY);
}

#[test]
fn forced_bits_let_a_sloppy_master_enable() {
    for forced in [false, true] {
        let mut bench = Bench::new(|plan| plan.force_enable_bits = forced);
        for word in [0, 0, 0, 1, 1] {
            bench.state(word);
            bench.wait(S);
        }
        assert_eq!(bench.exchange(None).main() == state::OPERATION_ENABLED, forced);
    }
}

#[test]
fn jogging_and_going_to_the_position_end_with_their_bits() {
    let mut bench = Bench::homed();
    assert_eq!(bench.state(0x013F).state, 0x1001);
    bench.wait(S);
    assert_eq!(bench.state(control::ON).main(), state::OPERATION_ENABLED);
    let jogged = bench.until_standing().actual;
    assert!((195_000..210_000).contains(&jogged), "{jogged}");
    for bit in [control::GO_TO_INITIAL, control::GO_TO_POSITION] {
        bench.ends_at(go_to(CM, VAD));
        bench.control = control::ON | bit;
        bench.until(Report::is_finished);
        assert_eq!(bench.until_standing().actual, 0);
        assert_eq!(bench.state(control::ON).main(), state::OPERATION_ENABLED);
    }
}
