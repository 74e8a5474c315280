//! What must not move, or stop otherwise than it was told, whatever state a drive is found or left in.

use fieldbeat::Flow;
use fieldbeat::axis::{NativeOwner, State};
use fieldbeat::bus::modbus::{Native, NativeOutput};

use super::*;

/// A control word with RUN and a speed are left in a drive that does not follow them, and stands.
fn left_to_run(shared: &mut Shared, now: Time) {
    shared.write(now, Parameter::CONTROL_WORD, ControlWord::FORWARD.0);
    let mut data = RegistersBuffer::new();
    data.push_long(15_000);
    let address = Parameter::REFERENCE.address(Addressing::Standard, Width::Long).unwrap();
    shared.ask(now, Request::Write { address, data: data.registers() });
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
fn what_runs_by_its_terminals_is_taken_over_at_its_speed_and_ramps_down() {
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

#[test]
fn a_stop_out_of_native_mode_goes_along_its_ramp_with_power_on() {
    for (owner, via) in [
        (NativeOwner::Application, VIAS[0]),
        (NativeOwner::Application, VIAS[1]),
        (NativeOwner::Master, VIAS[1]),
    ] {
        let mut b = Bench::enabled(1, via, |_, _| {});
        let mut native = b.sim.axis(0).native::<Native>().unwrap();
        b.sim.axis(0).post(Command::Native(owner)).unwrap();
        b.until("native mode", 100, |_| native.inputs().running);
        native.write(NativeOutput { control: ControlWord::FORWARD, reference: 3_000 }).unwrap();
        b.until("its speed", 2_000, |b| (b.feedback(0).status.velocity - 5.0).abs() < 0.1);
        assert!(native.inputs().control().is_some_and(|word| word.has(ControlWord::RUN_FORWARD)));
        b.sim.axis(0).post(Command::Stop { deceleration: Some(5.0) }).unwrap();
        b.run(500);
        let feedback = b.feedback(0);
        assert!(
            (2.0..3.0).contains(&feedback.status.velocity),
            "{owner:?} {via:?}: halfway down: {feedback:?}"
        );
        b.run(1_000);
        let feedback = b.feedback(0);
        assert!(
            !feedback.status.moving && feedback.status.state == State::OperationEnabled,
            "{owner:?} {via:?}: {feedback:?}"
        );
    }
}

#[test]
fn each_native_output_goes_out_however_often_the_wire_takes_none() {
    let mut b = Bench::enabled(1, Via::Direct, |_, _| {});
    let mut native = b.sim.axis(0).native::<Native>().unwrap();
    b.sim.axis(0).post(Command::Native(NativeOwner::Application)).unwrap();
    b.until("native mode", 100, |_| native.inputs().running);
    b.tap(0).received.clear();
    for reference in 1..=10 {
        native.write(NativeOutput { control: ControlWord::FORWARD, reference }).unwrap();
    }
    b.run(100);
    let address = Parameter::REFERENCE.address(Addressing::Standard, Width::Long).unwrap();
    let mut written: Vec<i32> = (b.tap(0).received.iter())
        .filter_map(|request| match Request::parse(request).unwrap().1 {
            Request::ReadWrite { write, data, .. } if write == address => data.long(0),
            _ => None,
        })
        .collect();
    written.dedup();
    assert_eq!(
        written.iter().filter(|count| **count > 0).copied().collect::<Vec<_>>(),
        (1..=10).collect::<Vec<_>>()
    );
}

#[test]
fn a_drive_without_function_23_is_read_as_ever_after_it_was_watched_for_long() {
    let mut b = Bench::new(1, Via::Direct, |_, drive| drive.functions = Functions::Apart);
    b.online();
    b.run(30_000);
    b.sim.axis(0).post(Command::Enable).unwrap();
    for _ in 0..200 {
        b.run(1);
        assert!(b.feedback(0).age < 20, "{:?}", b.feedback(0));
    }
    assert_eq!(b.feedback(0).status.state, State::OperationEnabled);
}

#[test]
fn nothing_that_was_told_before_a_restart_is_told_after_it() {
    for via in VIAS {
        let mut b = Bench::enabled(1, via, |_, _| {});
        let mut native = b.sim.axis(0).native::<Native>().unwrap();
        b.sim.axis(0).post(Command::Native(NativeOwner::Application)).unwrap();
        b.until("native mode", 100, |_| native.inputs().running);
        native.write(NativeOutput { control: ControlWord::FORWARD, reference: 3_000 }).unwrap();
        b.until("its speed", 2_000, |b| (b.feedback(0).status.velocity - 5.0).abs() < 0.1);
        assert!(b.sim.world().restart(address(0)));
        // It boots for half a second, and hears nobody.
        b.run(501);
        for _ in 0..5_000 {
            b.run(1);
            assert!(!b.tap(0).status(b.now()).active(), "{via:?}: {:?}", b.feedback(0));
        }
        assert_eq!(b.feedback(0).link, Link::Online);
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
fn a_drive_that_refuses_function_23_from_now_on_is_asked_in_turns_and_goes_on_turning() {
    for via in VIAS {
        let mut b = Bench::enabled(1, via, |_, _| {});
        b.turning(0, 4.0);
        b.tap(0).request = Some(Box::new(|request| without_function_23(request)));
        b.tap(0).reply = Some(Box::new(|reply| as_function_23(reply)));
        b.tap(0).received.clear();
        b.run(500);
        let received = std::mem::take(&mut b.tap(0).received);
        let refused = received.iter().filter(|request| request[7] == NO_FUNCTION).count();
        assert!((1..=2).contains(&refused), "{via:?}: {refused}, one may be on its way");
        let with = |function| received.iter().any(|request| request[7] == function);
        assert!(with(function::READ) && with(function::WRITE), "{via:?}");
        assert!((b.feedback(0).status.velocity - 4.0).abs() < 0.1, "{via:?}: {:?}", b.feedback(0));
        b.turning(0, -3.0);
        b.done(0, STOP);
        b.done(0, Command::Disable);
        let counters = b.finish().drives[0].counters;
        let counted = [(key(Own::Exceptions), refused as u64), (key(Own::NoReadWrite), 1)];
        assert_eq!(own(&counters), counted, "{via:?}");
    }
}

#[test]
fn a_second_trip_is_never_called_by_the_name_of_the_first() {
    for via in VIAS {
        let mut b = Bench::enabled(1, via, |_, _| {});
        for trip in [Trip::OVER_VOLTS, Trip::MOTOR_TOO_HOT, Trip::OVER_VOLTS] {
            b.turning(0, 4.0);
            b.tap(0).drive.provoke(trip);
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
