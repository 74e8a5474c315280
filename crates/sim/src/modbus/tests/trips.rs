//! Trips, their reset, and the watchdogs.

use super::*;

/// A pulse on the reset bit.
fn reset(bench: &mut Bench) {
    bench.control(C::IDLE);
    bench.control(C::RESETTING);
    bench.control(C::IDLE);
}

#[test]
fn a_trip_coasts_and_stays_until_it_is_reset_by_an_edge() {
    let mut bench = Bench::enabled(1_500);
    bench.settled(C::FORWARD);
    bench.sim.provoke(Trip::OVER_VOLTS);
    // The first one stays.
    bench.sim.provoke(Trip::EXTERNAL);
    bench.wait(MS);
    assert_eq!((bench.trip(), bench.status().active()), ((2, true), false));
    assert!(bench.speed() > 1_400.0);
    bench.wait(5 * S);
    assert_eq!((bench.trip(), bench.speed()), ((2, true), 0.0));
    // A level is no edge: the bit was set before the trip.
    bench.control(C::RESETTING);
    assert!(bench.status().healthy());
    bench.sim.provoke(Trip::EXTERNAL);
    for _ in 0..10 {
        assert!(!bench.control(C::RESETTING).healthy());
    }
    reset(&mut bench);
    // The log keeps it.
    assert_eq!(bench.trip(), (6, false));
    // A run bit that stands at a reset runs again.
    bench.sim.provoke(Trip::OVER_VOLTS);
    bench.control(C::FORWARD.with(C::RESET));
    bench.until(|status| status.at_speed());
}

#[test]
fn every_way_of_reset_resets() {
    // AUTO is not needed; 10.033 counts its edge only.
    let by_word =
        [(Parameter::CONTROL_WORD_ENABLE, 1, true), (Parameter::CONTROL_WORD, C::RESET.into(), false)];
    let by_10_033 = [(RESET, 1, false)];
    for way in [&by_word[..], &by_10_033, &[(USER_TRIP, 100, false)]] {
        let mut bench = Bench::new(|settings| settings.start = Start::Tripped(20));
        assert_eq!(bench.trip(), (20, true));
        for (parameter, value, trips) in way {
            bench.write(*parameter, *value);
            assert_eq!(bench.trip(), (20, *trips), "{parameter} = {value}");
        }
    }
    let mut bench = Bench::new(|_| {});
    bench.write(RESET, 1);
    bench.sim.provoke(Trip::OVER_VOLTS);
    for (value, trips) in [(1, true), (0, true), (1, false)] {
        bench.write(RESET, value);
        assert_eq!(bench.trip().1, trips);
    }
}

#[test]
fn trip_3_is_not_reset_for_10_s() {
    let mut bench = Bench::idle();
    bench.sim.provoke(Trip::OVER_CURRENT);
    for _ in 0..9 {
        bench.wait(S);
        reset(&mut bench);
        assert_eq!(bench.trip(), (3, true));
    }
    bench.wait(S);
    reset(&mut bench);
    assert_eq!(bench.trip(), (3, false));
}

#[test]
fn a_trip_whose_cause_stays_comes_back_at_once() {
    let mut bench = Bench::idle_with(|settings| settings.persistent_trip = Some(20));
    assert_eq!(bench.trip(), (20, true));
    reset(&mut bench);
    assert_eq!(bench.trip(), (20, true));
    // Each time it is a new one in the log.
    let log: [i32; 3] = bench.read_block(Parameter::TRIP);
    assert_eq!(log, [20, 20, 0]);
    bench.restart();
    assert_eq!(bench.trip(), (20, true));
}

#[test]
fn the_control_word_trips_by_an_edge() {
    let mut bench = Bench::idle();
    bench.control(C::IDLE.with(C::TRIP));
    assert_eq!(bench.trip(), (35, true));
    bench.control(C::RESETTING.with(C::TRIP));
    assert_eq!(bench.trip(), (35, false));
    bench.control(C::RESETTING);
    bench.control(C::IDLE.with(C::TRIP));
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
    let log: [i32; 10] = bench.read_block(Parameter::TRIP);
    assert!(log.into_iter().eq((45..55).rev()), "{log:?}");
    bench.restart();
    assert_eq!(bench.trip(), (54, false));
    bench.write(USER_TRIP, 255);
    assert_eq!(bench.read_block(Parameter::TRIP), [0; 10]);
}

#[test]
fn the_watchdog_of_the_control_word_trips_a_second_after_the_last_write() {
    let mut bench = Bench::enabled(1_000);
    let word = C::FORWARD.with(C::KEYPAD_WATCHDOG);
    for _ in 0..10 {
        assert!(bench.control(word).healthy());
        bench.wait(990 * MS);
    }
    assert!(bench.status().at_speed());
    bench.control(word);
    // One of the thousand has passed; reading is no service.
    bench.wait(998 * MS);
    assert!(bench.status().healthy());
    bench.wait(MS);
    assert_eq!(bench.trip(), (30, true));
    bench.wait(5 * S);
    assert_eq!(bench.speed(), 0.0);
    // It was disarmed by its trip.
    reset(&mut bench);
    bench.wait(5 * S);
    assert_eq!(bench.trip(), (30, false));
}

#[test]
fn a_word_without_the_bit_disarms_the_watchdog_unless_it_is_held_and_one_of_edges_needs_edges() {
    let armed = C::IDLE.with(C::KEYPAD_WATCHDOG);
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
        assert!(bench.status().healthy());
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
    assert!(bench.status().healthy());
    bench.write(TIMEOUT, 100);
    for _ in 0..20 {
        bench.wait(99 * MS);
        assert!(bench.status().at_speed());
    }
    bench.wait(100 * MS);
    assert_eq!(bench.trip(), (252, true));
    // The request that showed it armed it again.
    bench.write(TIMEOUT, 0);
    reset(&mut bench);
    bench.wait(60 * S);
    assert!(bench.status().healthy());
}

#[test]
fn the_trip_of_the_timeout_names_the_slot_and_bytes_that_make_no_message_do_not_serve_it() {
    for (slot, trip) in [(1, 202), (2, 207), (3, 212), (4, 252)] {
        let mut bench = Bench::new(|settings| settings.interface.slot = slot);
        bench.write(TIMEOUT.in_slot(slot), 100);
        assert_eq!(bench.read(TIMEOUT.in_slot(slot)), 100);
        for _ in 0..20 {
            bench.wait(10 * MS);
            assert!(bench.raw(&[]).is_empty());
        }
        assert_eq!(bench.trip(), (trip, true));
        let here = Request::Read { address: 0x4000 + 15 * 100 + 8, count: 2 };
        let missing = |response: Response<'_>| matches!(response, Response::Exception { .. });
        assert_eq!(bench.ask(4, &here, missing), slot != 4, "unit 4 is slot 4");
    }
}

#[test]
fn a_restart_clears_a_trip_and_everything_that_ran() {
    let mut bench = Bench::enabled(1_000);
    bench.settled(C::FORWARD.with(C::KEYPAD_WATCHDOG));
    bench.sim.provoke(Trip::OVER_CURRENT);
    bench.sim.restart(bench.now);
    bench.wait(S);
    assert!(bench.sim.connect(bench.now, MASTER));
    bench.wait(5 * S);
    assert_eq!((bench.trip(), bench.status().active()), ((3, false), false));
}
