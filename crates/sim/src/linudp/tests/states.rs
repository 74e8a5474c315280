//! The state machine (SG5 manual).

use super::*;

#[test]
fn enabling_begins_with_bit_0_low_passes_all_states_and_takes_the_hardware_tests() {
    let mut bench = Bench::new(|_| {});
    for _ in 0..10 {
        assert_eq!(bench.state(ControlWord::ON).main(), MainState::NOT_READY);
    }
    assert!(bench.exchange(None).status.unwrap().has(StatusWord::SWITCH_ON_LOCKED));
    bench.control = ControlWord::BASE;
    let unlocked = bench.exchange(None);
    assert_eq!(unlocked.state.unwrap().main(), MainState::SWITCH_ON_DISABLED);
    assert!(!unlocked.status.unwrap().has(StatusWord::SWITCH_ON_LOCKED));
    assert_eq!(bench.state(ControlWord::BASE).main(), MainState::READY_TO_SWITCH_ON);
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::HW_TESTS);
    // Bit 3 held back: stays in 6.
    bench.control = ControlWord(0x0037);
    let tests = bench.until_main(MainState::READY_TO_OPERATE);
    assert!((299..=301).contains(&tests), "{tests} ms");
    assert!(!bench.exchange(None).status.unwrap().operation_enabled());
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    let response = bench.exchange(None);
    let status = response.status.unwrap();
    // On, enabled, voltage, no quick stop, warning (not homed), in target.
    assert_eq!(status, StatusWord(0x04B7));
    assert_eq!(response.warn.unwrap().names().collect::<Vec<_>>(), ["motor not homed"]);
    assert_eq!(response.state, Some(StateVar(0x0840)));
    assert_eq!(response.actual, Some(2 * CM));
}

#[test]
fn homing_takes_the_time_of_its_move_and_waits_for_its_bit() {
    let mut bench = Bench::new(|plan| plan.home_position = 7 * CM);
    bench.enable();
    bench.control = ControlWord::HOME;
    let response = bench.exchange(None);
    assert_eq!(response.state, Some(StateVar(0x0900)));
    assert!(response.status.unwrap().has(StatusWord::SPECIAL_MOTION | StatusWord::MOTION_ACTIVE));
    // 50 mm at 100 mm/s, with 1 m/s2: 0.5 s of way + 0.1 s of ramps, and some to settle.
    let took = bench.until(|response| response.state.unwrap().finished());
    assert!((590..700).contains(&took), "{took} ms");
    for _ in 0..5 {
        let response = bench.exchange(None);
        assert_eq!(response.state, Some(StateVar(0x090F)));
        assert_eq!(response.demand, Some(7 * CM));
        assert!((response.actual.unwrap() - 7 * CM).abs() < 500);
        assert!(response.status.unwrap().homed() && response.warn.unwrap().0 == 0);
    }
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    // Homed survives switching off.
    bench.enable();
    assert!(bench.exchange(None).status.unwrap().homed());
    // Released early it is no homing.
    bench.command(go_to(CM, VAD));
    bench.until_standing();
    bench.control = ControlWord::HOME;
    bench.until(|response| response.status.unwrap().motion_active());
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    assert!(!bench.until_standing().status.unwrap().homed());
}

#[test]
fn abort_stops_and_stays_freeze_stops_and_goes_on() {
    let mut bench = Bench::homed();
    bench.command(go_to(10 * CM, VAD));
    bench.now = bench.now + 100 * MS;
    assert_eq!(bench.state(ControlWord(0x001F)).main(), MainState::FREEZING);
    let frozen = bench.until_standing();
    assert!(frozen.demand.unwrap() < 9 * CM);
    bench.control = ControlWord::ON;
    assert_eq!(bench.until_standing().actual, Some(10 * CM));

    bench.command(go_to(0, VAD));
    bench.now = bench.now + 100 * MS;
    assert_eq!(bench.state(ControlWord::ABORT).main(), MainState::ABORTING);
    let aborted = bench.until_standing();
    assert!(aborted.demand.unwrap() > CM);
    bench.control = ControlWord::ON;
    assert_eq!(bench.until_standing().demand, aborted.demand);
    assert!(bench.exchange(None).status.unwrap().operation_enabled());
}

#[test]
fn quick_stop_brakes_bit_3_goes_back_to_6_and_bits_0_and_1_switch_off() {
    let mut bench = Bench::homed();
    bench.command(go_to(10 * CM, VAD));
    bench.now = bench.now + 100 * MS;
    assert_eq!(bench.state(ControlWord::QUICK_STOP).main(), MainState::QUICK_STOP);
    // 0.5 m/s with 20 m/s2.
    let took = bench.until_main(MainState::NOT_READY);
    assert!((20..30).contains(&took), "{took} ms");
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::NOT_READY);
    bench.enable();
    bench.command(go_to(0, VAD));
    let from = bench.exchange(None).demand.unwrap();
    assert_eq!(bench.state(ControlWord(0x0037)).main(), MainState::READY_TO_OPERATE);
    let response = bench.exchange(None);
    assert!(!response.status.unwrap().motion_active() && response.demand.unwrap() > from - CM);
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    assert_eq!(bench.state(ControlWord(0x003D)).main(), MainState::NOT_READY);
    bench.enable();
    assert_eq!(bench.state(ControlWord::BASE).main(), MainState::NOT_READY);
}

#[test]
fn forced_bits_let_a_sloppy_master_enable() {
    for forced in [false, true] {
        let mut bench = Bench::new(|plan| plan.force_enable_bits = forced);
        for _ in 0..3 {
            bench.state(ControlWord(0));
        }
        bench.now = bench.now + S;
        bench.state(ControlWord(1));
        bench.now = bench.now + S;
        assert_eq!(bench.state(ControlWord(1)).main() == MainState::OPERATION_ENABLED, forced);
    }
}

#[test]
fn jogging_and_going_to_the_position_end_with_their_bits() {
    let mut bench = Bench::homed();
    assert_eq!(bench.state(ControlWord(0x013F)), StateVar(0x1001));
    bench.now = bench.now + S;
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    let jogged = bench.until_standing().actual.unwrap();
    assert!((195_000..210_000).contains(&jogged), "{jogged}");
    for bit in [ControlWord::GO_TO_INITIAL, ControlWord::GO_TO_POSITION] {
        bench.command(go_to(CM, VAD));
        bench.until_standing();
        bench.control = ControlWord(ControlWord::ON.0 | bit);
        bench.until(|response| response.state.unwrap().finished());
        assert_eq!(bench.until_standing().actual, Some(0));
        assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    }
}
