//! Parameters: menu 0, saving, restarts.

use super::*;

const SETUP: Parameter = Parameter::new(22, 1);
const MENU_ZERO: Parameter = Parameter::new(0, 1);

#[test]
fn menu_0_shows_what_menu_22_says_and_is_written_through() {
    let mut bench = Bench::new(|_| {});
    // As delivered: both clamps, both ramps, the selector, the limit.
    assert_eq!(bench.read_block(MENU_ZERO), [0, 30_000, 200, 200, 0, 2_500]);
    assert_eq!(bench.write_block(SETUP, &[6_042, 1_021]), 4);
    assert_eq!(bench.write_block(parameter("22.011"), &[10_040, 3_002, 4_020, 10_020]), 8);
    assert_eq!(bench.write_block(MENU_ZERO, &[0x0180, 15_000]), 4);
    assert_eq!(bench.read(Parameter::CONTROL_WORD), 0x0180);
    assert_eq!(bench.read(Parameter::REFERENCE), 15_000);
    let [status, speed, load, trip] = bench.read_block(Parameter::new(0, 11));
    assert_eq!((W(status as u16).healthy(), speed, load, trip), (true, 0, 0, 0));
    // What the target refuses is refused here.
    assert_eq!(bench.write_block(MENU_ZERO, &[0x0181, 9_999_999]), 2);
    assert!(!bench.try_write(Parameter::new(0, 12), 1));
}

#[test]
fn what_was_commissioned_is_in_range_and_can_be_made_what_it_was_when_the_drive_was_delivered() {
    let mut bench = Bench::new(|settings| {
        settings.commissioned = vec![(RAMP, 3_000), (SETUP, 6_042), (Parameter::REFERENCE, i32::MAX)];
        settings.commissioned.extend([(parameter("06.043"), 7), (parameter("99.001"), 1)]);
    });
    assert_eq!((bench.read(RAMP), bench.read(SETUP)), (3_000, 6_042));
    let reference = Parameter::REFERENCE.known().unwrap();
    assert_eq!(i64::from(bench.read(Parameter::REFERENCE)), reference.max);
    assert_eq!(bench.read(Parameter::CONTROL_WORD_ENABLE), 1);
    bench.write(parameter("01.000"), 1_233);
    bench.write(RESET, 1);
    assert_eq!((bench.read(RAMP), bench.read(SETUP), bench.read(MENU_ZERO)), (200, 1_007, 0));
}

#[test]
fn a_new_addressing_mode_counts_from_the_next_start_on() {
    let mut bench = Bench::new(|_| {});
    bench.write(parameter("4.15.013"), 1);
    bench.write(parameter("01.000"), 1_000);
    bench.write(RESET, 1);
    assert_eq!(bench.read(Parameter::FIRMWARE), 1_220_010);
    bench.restart();
    bench.addressing = Addressing::Modified;
    assert_eq!(bench.read(Parameter::FIRMWARE), 1_220_010);
}
