//! Trips, their reset, and the watchdogs.

use super::*;

/// A pulse on the reset bit.
fn reset(bench: &mut Bench) {
    bench.control(C::IDLE);
    bench.control(RESETTING);
    bench.control(C::IDLE);
}

#[test]
fn the_control_word_trips_by_an_edge() {
    let mut bench = Bench::idle();
    bench.control(C::IDLE | C::TRIP);
    assert_eq!(bench.trip(), (35, true));
    bench.control(RESETTING | C::TRIP);
    assert_eq!(bench.trip(), (35, false));
    bench.control(RESETTING);
    bench.control(C::IDLE | C::TRIP);
    assert_eq!(bench.trip(), (35, true));
}

#[test]
fn the_log_keeps_the_last_ten_and_outlives_a_restart() {
    let mut bench = Bench::new(|_| {});
    for number in 40..55 {
        bench.write(USER_TRIP, number);
        assert_eq!((bench.trip(), bench.read(USER_TRIP)), ((number, true), 0));
        bench.write(USER_TRIP, 100);
    }
    let log: [i32; 10] = bench.read_block(TRIP);
    assert!(log.into_iter().eq((45..55).rev()), "{log:?}");
    bench.restart();
    assert_eq!(bench.trip(), (54, false));
    bench.write(USER_TRIP, 255);
    assert_eq!(bench.read_block(TRIP), [0; 10]);
}

#[test]
fn the_watchdog_trips_a_second_after_its_last_bit_and_a_word_without_it_disarms_it() {
    let armed = C::IDLE | C::KEYPAD_WATCHDOG;
    for (words, trips) in [(&[armed, armed, armed][..], true), (&[armed, armed, C::IDLE], false)] {
        let mut bench = Bench::idle();
        for word in words {
            bench.control(*word);
            bench.wait(998 * MS);
            assert!(bench.is(W::HEALTHY));
        }
        bench.wait(MS);
        assert_eq!(bench.trip(), if trips { (30, true) } else { (0, false) });
    }
}

#[test]
fn the_modbus_timeout_trips_when_nothing_is_received() {
    let mut bench = Bench::enabled(1_000);
    bench.settled(C::FORWARD);
    bench.wait(60 * S);
    assert!(bench.is(W::HEALTHY));
    bench.write(TIMEOUT, 100);
    for _ in 0..20 {
        bench.wait(99 * MS);
        assert!(bench.is(W::AT_SPEED));
    }
    bench.wait(100 * MS);
    assert_eq!(bench.trip(), (252, true));
    // The request that showed it armed it again.
    bench.write(TIMEOUT, 0);
    reset(&mut bench);
    bench.wait(60 * S);
    assert!(bench.is(W::HEALTHY));
}

#[test]
fn a_restart_clears_a_trip_and_everything_that_ran() {
    let mut bench = Bench::enabled(1_000);
    bench.settled(C::FORWARD | C::KEYPAD_WATCHDOG);
    bench.sim.provoke(3);
    bench.sim.restart(bench.now);
    bench.wait(S);
    assert!(bench.sim.connect(bench.now, MASTER));
    bench.wait(5 * S);
    assert_eq!((bench.trip(), bench.is(W::ACTIVE)), ((3, false), false));
}
