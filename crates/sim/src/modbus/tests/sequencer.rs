//! Control word, status word, references (SI-PROFIBUS guide).

use super::*;

const RUNNING: u16 = W::HEALTHY | W::ACTIVE;

#[test]
fn a_new_drive_is_healthy_and_switched_off_and_obeys_the_control_word_once_06_043_is_set() {
    let mut bench = Bench::new(|_| {});
    bench.write(Parameter::REFERENCE, 10_000);
    bench.control(C::FORWARD.with(C::TRIP | C::KEYPAD_WATCHDOG));
    bench.wait(5 * S);
    assert_eq!(bench.status(), W(W::HEALTHY | W::ZERO_SPEED | W::AT_MINIMUM));
    assert_eq!((bench.read_block(parameter("10.001")), bench.trip()), ([1, 0, 1, 1], (0, false)));
    assert_eq!(bench.read(parameter("01.042")), 0);
    // It is a level: from now on it is obeyed.
    bench.write(Parameter::CONTROL_WORD_ENABLE, 1);
    bench.control(C::FORWARD);
    bench.until(|status| status.at_speed());
}

#[test]
fn without_auto_the_terminals_are_obeyed_and_the_word_is_not() {
    let mut bench = Bench::idle();
    bench.write(Parameter::REFERENCE, 10_000);
    assert!(!bench.control(C(C::FORWARD.0 & !C::AUTO)).active());
    bench.wait(S);
    assert_eq!((bench.speed(), bench.status().active()), (0.0, false));
    // 06.030, and the preset by 01.014.
    bench.write(Parameter::REFERENCE_SELECTOR, 3);
    bench.write(parameter("06.030"), 1);
    bench.wait(S);
    assert_eq!(bench.speed(), 1_000.0);
    bench.write(parameter("06.030"), 0);
    bench.wait(S);
    // Ramped down, and held.
    assert_eq!((bench.speed(), bench.status().active()), (0.0, true));
}

#[test]
fn enabled_it_stands_with_power_on_or_is_active_from_run_to_standstill_only() {
    let mut bench = Bench::enabled(1_000);
    assert_eq!(bench.status(), W(RUNNING | W::ZERO_SPEED | W::AT_MINIMUM));
    bench.wait(S);
    assert_eq!((bench.speed(), bench.read(POST_RAMP)), (0.0, 0));
    assert!(!bench.control(C::IDLE).active());
    // Without hold zero speed.
    bench.write(parameter("06.008"), 0);
    assert!(!bench.control(C::ENABLED).active());
    assert!(bench.control(C::FORWARD).active());
    bench.until(|status| status.at_speed());
    assert!(bench.control(C::ENABLED).active());
    bench.until(|status| !status.active());
    assert!(bench.status().zero_speed());
}

#[test]
fn without_the_hardware_enable_nothing_is_active_and_a_run_bit_that_stands_runs_again_with_it() {
    let mut bench = Bench::idle_with(|settings| settings.hardware_enable = false);
    bench.write(Parameter::REFERENCE, 10_000);
    bench.control(C::FORWARD);
    bench.wait(S);
    assert_eq!(bench.status(), W(W::HEALTHY | W::ZERO_SPEED | W::AT_MINIMUM));
    assert_eq!(bench.read(parameter("06.029")), 0);
    let mut bench = Bench::enabled(1_500);
    bench.settled(C::FORWARD);
    assert_eq!(bench.read(parameter("06.029")), 1);
    bench.sim.open_sto(bench.now + 200 * MS);
    bench.wait(MS);
    assert_eq!((bench.status().active(), bench.read(parameter("06.029"))), (false, 0));
    bench.wait(198 * MS);
    assert!(!bench.status().active() && bench.speed() < 1_450.0);
    bench.wait(MS);
    assert!(bench.status().active());
    bench.until(|status| status.at_speed());
}

#[test]
fn latches_need_06_004_and_not_stop() {
    let mut bench = Bench::enabled(1_000);
    bench.write(parameter("06.004"), 1);
    let held = |word: C| word.with(C::NOT_STOP);
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
fn the_reference_is_the_preset_if_remote_and_both_selectors_are_0() {
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
        let analogue = (parameter("01.036"), 500);
        let mut bench = Bench::idle_with(|settings| settings.commissioned = vec![analogue]);
        let presets: Vec<i32> = (1..=8).map(|n| n * 1_000).collect();
        bench.write_block(Parameter::REFERENCE, &presets);
        bench.write(Parameter::REFERENCE_SELECTOR, selector);
        bench.write(Parameter::PRESET_SELECTOR, preset);
        let word = if remote { C::FORWARD } else { C::FORWARD.without(C::REMOTE) };
        bench.control(word);
        bench.wait(S);
        assert_eq!(bench.speed(), speed, "remote {remote}, 01.014 = {selector}, 01.015 = {preset}");
        assert_eq!(bench.read(parameter("01.042")), i32::from(remote));
    }
}

#[test]
fn the_hard_reference_is_added_behind_the_ramp_while_it_runs() {
    let mut bench = Bench::enabled(500);
    bench.write(parameter("03.022"), 1_000);
    bench.write(parameter("03.023"), 1);
    bench.wait(S);
    assert_eq!(bench.speed(), 0.0);
    bench.control(C::FORWARD);
    bench.wait(S);
    assert_eq!(
        [Parameter::SPEED, POST_RAMP, parameter("03.001")].map(|p| bench.read(p)),
        [6_000, 5_000, 6_000]
    );
}

#[test]
fn it_can_be_found_running_at_any_speed() {
    for (rpm, word) in [(1_200.0, C::FORWARD), (-300.0, C::BACKWARD), (0.0, C::ENABLED)] {
        let mut bench = Bench::new(|settings| settings.start = Start::Running(rpm));
        let status = bench.status();
        assert_eq!((bench.speed(), status.active(), status.zero_speed()), (rpm, true, rpm == 0.0));
        assert_eq!(bench.read(Parameter::CONTROL_WORD), i32::from(word.0));
        // And goes on.
        bench.wait(10 * S);
        assert_eq!(bench.speed(), rpm);
        // What is taken over ramps down as any other.
        bench.settled(C::ENABLED);
        assert!(!bench.control(C::IDLE).active());
    }
}
