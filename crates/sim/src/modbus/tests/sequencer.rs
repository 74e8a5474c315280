//! Control word, status word, references (SI-PROFIBUS guide).

use super::*;

const RUNNING: u16 = W::HEALTHY | W::ACTIVE;

#[test]
fn a_new_drive_is_healthy_and_switched_off_and_obeys_the_control_word_once_06_043_is_set() {
    let mut bench = Bench::new(|_| {});
    bench.write(REFERENCE, 10_000);
    bench.control(C::FORWARD | C::TRIP | C::KEYPAD_WATCHDOG);
    bench.wait(5 * S);
    assert_eq!(bench.status(), W::HEALTHY | W::ZERO_SPEED | W::AT_MINIMUM);
    assert_eq!((bench.read_block([10, 1]), bench.trip()), ([1, 0, 1, 1], (0, false)));
    assert_eq!(bench.read([1, 42]), 0);
    // It is a level: from now on it is obeyed.
    bench.write(CONTROL_WORD_ENABLE, 1);
    bench.control(C::FORWARD);
    bench.until(W::AT_SPEED);
}

#[test]
fn without_auto_the_terminals_are_obeyed_and_the_word_is_not() {
    let mut bench = Bench::idle();
    bench.write(REFERENCE, 10_000);
    assert_eq!(bench.control(C::FORWARD & !C::AUTO) & W::ACTIVE, 0);
    bench.wait(S);
    assert_eq!((bench.speed(), bench.is(W::ACTIVE)), (0.0, false));
    // 06.030, and the preset by 01.014.
    bench.write(REFERENCE_SELECTOR, 3);
    bench.write([6, 30], 1);
    bench.wait(S);
    assert_eq!(bench.speed(), 1_000.0);
    bench.write([6, 30], 0);
    bench.wait(S);
    // Ramped down, and held.
    assert_eq!((bench.speed(), bench.is(W::ACTIVE)), (0.0, true));
}

#[test]
fn enabled_it_stands_with_power_on_or_is_active_from_run_to_standstill_only() {
    let mut bench = Bench::enabled(1_000);
    assert_eq!(bench.status(), RUNNING | W::ZERO_SPEED | W::AT_MINIMUM);
    bench.wait(S);
    assert_eq!((bench.speed(), bench.read(POST_RAMP)), (0.0, 0));
    assert!(bench.control(C::IDLE) & W::ACTIVE == 0);
    // Without hold zero speed.
    bench.write([6, 8], 0);
    assert!(bench.control(C::ENABLED) & W::ACTIVE == 0);
    assert!(bench.control(C::FORWARD) & W::ACTIVE != 0);
    bench.until(W::AT_SPEED);
    assert!(bench.control(C::ENABLED) & W::ACTIVE != 0);
    while bench.is(W::ACTIVE) {
        bench.wait(MS);
    }
    assert!(bench.is(W::ZERO_SPEED));
}

#[test]
fn without_the_hardware_enable_nothing_is_active_and_a_run_bit_that_stands_runs_again_with_it() {
    let mut bench = Bench::idle_with(|settings| settings.hardware_enable = false);
    bench.write(REFERENCE, 10_000);
    bench.control(C::FORWARD);
    bench.wait(S);
    assert_eq!(bench.status(), W::HEALTHY | W::ZERO_SPEED | W::AT_MINIMUM);
    assert_eq!(bench.read([6, 29]), 0);
    let mut bench = Bench::enabled(1_500);
    bench.settled(C::FORWARD);
    assert_eq!(bench.read([6, 29]), 1);
    bench.sim.open_sto(bench.now + 200 * MS);
    bench.wait(MS);
    assert_eq!((bench.is(W::ACTIVE), bench.read([6, 29])), (false, 0));
    bench.wait(198 * MS);
    assert!(!bench.is(W::ACTIVE) && bench.speed() < 1_450.0);
    bench.wait(MS);
    assert!(bench.is(W::ACTIVE));
    bench.until(W::AT_SPEED);
}

#[test]
fn latches_need_06_004_and_not_stop() {
    let mut bench = Bench::enabled(1_000);
    bench.write([6, 4], 1);
    let held = |word| word | C::NOT_STOP;
    for (what, words, speed) in [
        ("no latch without NOT STOP, and nothing runs", &[C::FORWARD][..], 0.0),
        ("it is kept", &[held(C::FORWARD), held(C::ENABLED)], 1_000.0),
        ("the other direction takes over", &[held(C::BACKWARD), held(C::ENABLED)], -1_000.0),
        ("NOT STOP off ends it", &[C::ENABLED], 0.0),
        ("and so does disabling", &[held(C::FORWARD), held(C::IDLE), held(C::ENABLED)], 0.0),
    ] {
        for word in words {
            bench.control(*word);
        }
        bench.wait(S);
        assert_eq!(bench.speed(), speed, "{what}");
    }
}

#[test]
fn the_reference_is_a_preset_or_the_analogue_one_by_remote_and_both_selectors() {
    for (remote, selector, preset, speed) in [
        (true, 0, 0, 100.0),
        (false, 0, 0, 50.0),
        (true, 1, 0, 50.0),
        (true, 4, 0, 50.0),
        (false, 3, 0, 100.0),
        (true, 0, 2, 200.0),
        (true, 0, 8, 800.0),
        (false, 3, 5, 500.0),
        (true, 0, 9, 100.0),
    ] {
        let mut bench = Bench::idle_with(|settings| settings.commissioned = vec![([1, 36], 500)]);
        let presets: Vec<i32> = (1..=8).map(|n| n * 1_000).collect();
        assert_eq!(bench.write_block(REFERENCE, &presets), Ok(16));
        bench.write(REFERENCE_SELECTOR, selector);
        bench.write([1, 15], preset);
        let word = if remote { C::FORWARD } else { C::FORWARD & !C::REMOTE };
        bench.control(word);
        bench.wait(S);
        assert_eq!(bench.speed(), speed, "remote {remote}, 01.014 = {selector}, 01.015 = {preset}");
        assert_eq!(bench.read([1, 42]), i32::from(remote));
    }
}

#[test]
fn the_hard_reference_is_added_behind_the_ramp_while_it_runs() {
    let mut bench = Bench::enabled(500);
    bench.write([3, 22], 1_000);
    bench.write([3, 23], 1);
    bench.wait(S);
    assert_eq!(bench.speed(), 0.0);
    bench.control(C::FORWARD);
    bench.wait(S);
    assert_eq!([SPEED, POST_RAMP, [3, 1]].map(|p| bench.read(p)), [6_000, 5_000, 6_000]);
}

#[test]
fn it_can_be_found_running_at_any_speed() {
    for (rpm, word) in [(1_200.0, C::FORWARD), (-300.0, C::BACKWARD), (0.0, C::ENABLED)] {
        let mut bench = Bench::new(|settings| settings.start = Start::Running(rpm));
        assert_eq!((bench.speed(), bench.is(W::ACTIVE), bench.is(W::ZERO_SPEED)), (rpm, true, rpm == 0.0));
        assert_eq!(bench.read(CONTROL_WORD), i32::from(word));
        // And goes on.
        bench.wait(10 * S);
        assert_eq!(bench.speed(), rpm);
        // A motion that is taken over ramps down as any other.
        bench.settled(C::ENABLED);
        assert!(bench.control(C::IDLE) & W::ACTIVE == 0);
    }
}
