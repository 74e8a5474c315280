//! Trips, their reset, and the watchdogs.

use super::*;

/// A pulse on the reset bit.
fn reset(bench: &mut Bench) {
    bench.control(C::IDLE);
    bench.control(RESETTING);
    bench.control(C::IDLE);
}

#[test]
fn a_trip_whose_cause_stays_comes_back_at_once() {
    let mut bench = Bench::idle_with(|settings| settings.persistent_trip = Some(20));
    assert_eq!(bench.trip(), (20, true));
    reset(&mut bench);
    assert_eq!(bench.trip(), (20, true));
    // Each time it is a new one in the log.
    let log: [i32; 3] = bench.read_block(TRIP);
    assert_eq!(log, [20, 20, 0]);
    bench.restart();
    assert_eq!(bench.trip(), (20, true));
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
fn a_word_without_the_bit_disarms_the_watchdog_unless_it_is_held_and_one_of_edges_needs_edges() {
    let armed = C::IDLE | C::KEYPAD_WATCHDOG;
    for held in [false, true] {
        let mut bench = Bench::idle_with(|settings| settings.watchdog.held = held);
        bench.control(armed);
        bench.control(C::IDLE);
        bench.wait(2 * S);
        assert_eq!(bench.trip().1, held);
    }
    let mut bench = Bench::idle_with(|settings| settings.watchdog.edges_only = true);
    for _ in 0..4 {
        bench.control(armed);
        bench.control(C::IDLE);
        bench.wait(900 * MS);
        assert!(bench.is(W::HEALTHY));
    }
    for _ in 0..3 {
        bench.control(armed);
        bench.wait(400 * MS);
    }
    assert_eq!(bench.trip(), (30, true));
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
