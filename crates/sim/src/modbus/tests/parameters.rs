//! Parameters: menu 0, saving, restarts.

use super::*;

const SETUP: Parameter = [22, 1];
const MENU_ZERO: Parameter = [0, 1];

#[test]
fn menu_0_shows_the_parameters_that_menu_22_names_and_is_written_through() {
    let mut bench = Bench::new(|_| {});
    // As delivered: both clamps, both ramps, the selector, the limit.
    assert_eq!(bench.read_block(MENU_ZERO), [0, 30_000, 200, 200, 0, 2_500]);
    assert_eq!(bench.write_block(SETUP, &[6_042, 1_021]), Ok(4));
    assert_eq!(bench.write_block([22, 11], &[10_040, 3_002, 4_020, 10_020]), Ok(8));
    assert_eq!(bench.write_block(MENU_ZERO, &[0x0180, 15_000]), Ok(4));
    assert_eq!(bench.read(CONTROL_WORD), 0x0180);
    assert_eq!(bench.read(REFERENCE), 15_000);
    let [status, speed, load, trip] = bench.read_block([0, 11]);
    assert_eq!((status as u16 & W::HEALTHY, speed, load, trip), (W::HEALTHY, 0, 0, 0));
    // A value that the target refuses is refused here.
    assert_eq!(bench.write_block(MENU_ZERO, &[0x0181, 9_999_999]), Ok(2));
    assert!(!bench.try_write([0, 12], 1));
}

#[test]
fn commissioned_values_are_clamped_and_the_values_as_delivered_can_be_restored() {
    let mut bench = Bench::new(|settings| {
        let [high, flag, unknown] = [([1, 21], i32::MAX), ([6, 43], 7), ([99, 1], 1)];
        settings.commissioned = vec![([2, 11], 3_000), ([22, 1], 6_042), high, flag, unknown];
    });
    assert_eq!((bench.read(RAMP), bench.read(SETUP)), (3_000, 6_042));
    assert_eq!(bench.read(REFERENCE), 500_000);
    assert_eq!(bench.read(CONTROL_WORD_ENABLE), 1);
    bench.write([1, 0], 1_233);
    bench.write(RESET, 1);
    assert_eq!((bench.read(RAMP), bench.read(SETUP), bench.read(MENU_ZERO)), (200, 1_007, 0));
}

#[test]
fn a_new_addressing_mode_counts_from_the_next_start_on() {
    let mut bench = Bench::new(|_| {});
    bench.write(ADDRESSING, 1);
    bench.write([1, 0], 1_000);
    bench.write(RESET, 1);
    assert_eq!(bench.read(FIRMWARE), 1_220_010);
    bench.restart();
    bench.each = 256;
    assert_eq!(bench.read(FIRMWARE), 1_220_010);
}
