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
fn every_run_bit_runs_in_its_direction() {
    for (bits, speed) in [
        (C::RUN_FORWARD, 600.0),
        (C::RUN_REVERSE, -600.0),
        (C::RUN, 600.0),
        (C::RUN | C::REVERSE, -600.0),
        (C::REVERSE, 0.0),
        (C::RUN_FORWARD | C::RUN, 600.0),
        (C::RUN_FORWARD | C::RUN_REVERSE, 0.0),
        (C::RUN_FORWARD | C::RUN | C::REVERSE, 0.0),
        (C::JOG_FORWARD, 100.0),
        (C::JOG_REVERSE, -100.0),
        (C::JOG_FORWARD | C::JOG_REVERSE, 0.0),
        (C::JOG_REVERSE | C::RUN_FORWARD, 600.0),
        (C::JOG_FORWARD | C::RUN_FORWARD | C::RUN_REVERSE, 0.0),
    ] {
        let mut bench = Bench::enabled(600);
        bench.write(parameter("01.005"), 1_000);
        bench.control(C::ENABLED.with(bits));
        bench.wait(S);
        let status = bench.status();
        assert_eq!(bench.speed(), speed, "{bits:04X}h");
        assert_eq!(status.has(W::REVERSE_COMMANDED | W::REVERSE_RUNNING), speed < 0.0, "{status:?}");
        assert_eq!((status.zero_speed(), status.at_speed()), (speed == 0.0, speed != 0.0), "{status:?}");
    }
}

#[test]
fn run_off_ramps_down_and_enable_off_coasts_until_it_is_caught_at_its_speed() {
    let mut bench = Bench::enabled(1_500);
    bench.settled(C::FORWARD);
    let ramped = bench.settled(C::ENABLED);
    assert!(bench.status().active());
    bench.settled(C::FORWARD);
    assert!(!bench.control(C::IDLE).active());
    let coasted = bench.until(|status| status.zero_speed());
    // 0.2 s to 1000 rpm; friction and load are far less than that.
    assert!((295..=305).contains(&ramped), "{ramped} ms");
    assert!(coasted > 3 * ramped, "{coasted} ms");
    // 06.015 is an enable as well.
    bench.settled(C::FORWARD);
    bench.write(parameter("06.015"), 0);
    bench.wait(300 * MS);
    assert!(!bench.status().active() && bench.status().healthy());
    let coasting = bench.speed();
    assert!((500.0..1_400.0).contains(&coasting), "{coasting}");
    bench.write(parameter("06.015"), 1);
    bench.wait(MS);
    assert!(bench.status().active());
    let [caught] = bench.read_block(POST_RAMP);
    assert!((f64::from(caught) / 10.0 - coasting).abs() < 10.0, "{caught}");
    assert!(bench.settled(C::FORWARD) < 300);
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
    bench.sim.inhibit(bench.now + 200 * MS);
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
fn the_reference_is_clamped_and_negative_only_if_bipolar() {
    for (reference, bipolar, minimum, maximum, speed) in [
        (9_000, 0, 0, 5_000, 500.0),
        (-9_000, 0, 0, 5_000, 0.0),
        (-9_000, 1, 0, 5_000, -500.0),
        (-3_000, 1, 0, 5_000, -300.0),
        (1_000, 0, 2_000, 5_000, 200.0),
        (1_000, 0, 9_000, 5_000, 500.0),
    ] {
        let mut bench = Bench::enabled(0);
        bench.write(parameter("01.006"), maximum);
        bench.write(parameter("01.007"), minimum);
        bench.write(parameter("01.010"), bipolar);
        bench.write(Parameter::REFERENCE, reference);
        bench.control(C::FORWARD);
        bench.wait(S);
        assert_eq!(bench.speed(), speed, "{reference}, 01.010 = {bipolar}, {minimum} ... {maximum}");
        assert_eq!(f64::from(bench.read(parameter("01.001"))) / 10.0, speed);
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
fn the_speed_window_is_below_at_or_above() {
    let mut bench = Bench::enabled(1_000);
    let below = bench.control(C::FORWARD);
    bench.wait(10 * MS);
    assert!(bench.status().has(RUNNING | W::BELOW_SPEED) && below.active());
    bench.until(|status| status.at_speed());
    assert!((995.0..=1_005.0).contains(&bench.speed()));
    bench.write(Parameter::REFERENCE, 5_000);
    bench.wait(10 * MS);
    assert!(bench.status().has(RUNNING | W::ABOVE_SPEED) && !bench.status().at_speed());
    // Slowing down, the motor gives back.
    assert!(bench.status().has(W::REGENERATING) && bench.read(Parameter::LOAD) < 0);
    // A drive that does not run has no set speed.
    bench.control(C::ENABLED);
    assert_eq!(bench.status().0 & (W::BELOW_SPEED | W::AT_SPEED | W::ABOVE_SPEED), 0);
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
