//! No unrequested motion and no other stop than the requested one, in whatever state a drive is found or left.

use fieldbeat::Flow;
use fieldbeat::axis::State;

use super::*;

/// A control word with RUN and a speed are left in a drive that does not follow them, and stands.
fn left_to_run(shared: &mut Tapped, now: Time) {
    shared.write(now, Parameter::CONTROL_WORD, ControlWord::FORWARD.0);
    shared.refer(now, 15_000);
    assert!(!shared.status(now + S).active());
    shared.received.clear();
}

#[test]
fn neither_a_connection_nor_an_enable_runs_what_was_left_in_the_control_word() {
    for via in VIAS {
        let mut b = Bench::beside(1, via, |_, _| {}, left_to_run, Vec::new());
        b.online();
        b.run(1_000);
        assert!(!b.tap(0).status(b.now()).active(), "{via:?}");
        if via == Via::Direct {
            let reads = b
                .tap(0)
                .received
                .iter()
                .all(|request| matches!(request[7], function::READ | function::READ_WRITE));
            assert!(reads, "nothing is written before the first order");
        }
        b.sim.axis(0).post(Command::Enable).unwrap();
        for _ in 0..1_000 {
            b.run(1);
            assert_eq!(b.feedback(0).status.velocity, 0.0, "{via:?}");
        }
        assert_eq!(b.feedback(0).status.state, State::OperationEnabled);
    }
}

#[test]
fn a_drive_running_by_its_terminals_is_taken_over_at_its_speed_and_ramps_down() {
    for via in VIAS {
        let change = |_, drive: &mut Unidrive| drive.axis.stop.deceleration = 4.0;
        let mut b = Bench::beside(1, via, change, by_terminals, Vec::new());
        b.online();
        let mut before = 5.0;
        for _ in 0..5_000 {
            b.run(1);
            let velocity = b.feedback(0).status.velocity;
            assert!(
                velocity < before + 0.1 && velocity > before - 0.5,
                "{via:?}: {before} -> {velocity} rev/s"
            );
            before = velocity;
        }
        assert!(before.abs() < 0.05 && !b.feedback(0).status.state.is_powered(), "{via:?}: {before}");
    }
}

/// Ends the master; the status of its drive two seconds later.
fn two_seconds_after_the_end(mut b: Bench) -> StatusWord {
    b.sim.stop();
    for _ in 0..60_000 {
        if b.sim.step() == Flow::End {
            let now = b.now();
            return b.tap(0).status(now + 2 * S);
        }
    }
    panic!("no end");
}

#[test]
fn the_orderly_end_takes_the_time_out_from_a_drive_that_is_off_and_leaves_it_to_one_that_is_not() {
    for via in VIAS {
        let change = |_, drive: &mut Unidrive| {
            drive.axis.stop.timeout = Duration::from_millis(300);
            drive.axis.enable_timeout = Duration::from_millis(300);
        };
        let b = Bench::enabled(1, via, change);
        let status = two_seconds_after_the_end(b);
        assert!(status.healthy() && !status.active(), "{via:?}: {status:?}");

        let mut b = Bench::enabled(1, via, change);
        b.turning(0, 4.0);
        // What would take RUN or ENABLE away arrives as what is there.
        let idle = ControlWord::IDLE.0.to_be_bytes();
        let enabled = ControlWord::ENABLED.0.to_be_bytes();
        let forward = ControlWord::FORWARD.0.to_be_bytes();
        b.tap(0).request = Some(Box::new(move |request| {
            for at in 0..request.len().saturating_sub(1) {
                if [idle, enabled].iter().any(|word| request[at..at + 2] == *word) {
                    request[at..at + 2].copy_from_slice(&forward);
                }
            }
        }));
        let status = two_seconds_after_the_end(b);
        assert!(!status.healthy(), "{via:?}: its own time-out has tripped it: {status:?}");
    }
}

#[test]
fn a_second_trip_is_never_called_by_the_name_of_the_first() {
    for via in VIAS {
        let mut b = Bench::enabled(1, via, |_, _| {});
        for trip in [Trip::OVER_VOLTS, Trip::MOTOR_TOO_HOT, Trip::OVER_VOLTS] {
            b.turning(0, 4.0);
            b.tap(0).drive.provoke(trip.0);
            let mut named = 0;
            while named == 0 {
                b.run(1);
                named = b.feedback(0).status.fault;
            }
            assert_eq!(named, u32::from(trip.0), "{via:?}");
            b.run(20);
            b.recover(0);
        }
    }
}
