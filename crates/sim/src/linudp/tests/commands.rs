//! Motion commands: counts, states that take them, moves, armed commands, errors (SG5 manual, motion command
//! interface).

use super::*;

#[test]
fn a_command_out_of_place_is_an_error_that_stops_the_motor_before_it_switches_off() {
    // State 6.
    let mut bench = Bench::homed();
    bench.state(ControlWord(0x0037));
    bench.command(MotionCommand::no_operation());
    bench.command(MotionCommand::control_word(Bits(0x0037)));
    assert_eq!(bench.exchange(None).error, Some(ErrorCode::NONE));
    assert_eq!(bench.fails(go_to(CM, VAD)), ErrorCode::WRONG_STATE);
    // State 9, finished: still not 8.
    let mut bench = Bench::homed();
    bench.control = ControlWord::HOME;
    bench.until(|response| response.state.unwrap().finished());
    assert_eq!(bench.fails(MotionCommand::vai_stop(Acceleration(1))), ErrorCode::WRONG_STATE);
    // A move before homing.
    let mut bench = Bench::new(|_| {});
    bench.enable();
    bench.command(MotionCommand::vai_stop(Acceleration(1)));
    assert_eq!(bench.fails(go_to(CM, VAD)), ErrorCode::NOT_HOMED);
    // A demand that the motor cannot follow.
    let jump = Vad { velocity: 20_000_000, acceleration: 100_000_000, deceleration: 100_000_000 };
    assert_eq!(Bench::homed().fails(go_to(10 * CM, jump)), ErrorCode::POSITION_LAG);
    // On the way.
    let mut bench = Bench::homed();
    bench.command(go_to(10 * CM, VAD));
    bench.now = bench.now + 100 * MS;
    let response = bench.command(MotionCommand::new(0x999));
    assert_eq!(response.state.unwrap().main(), MainState::QUICK_STOP);
    assert!(response.status.unwrap().error());
    assert_eq!(bench.until_error(), ErrorCode::UNKNOWN_COMMAND);
}

#[test]
fn the_master_can_home() {
    let mut bench = Bench::new(|_| {});
    bench.enable();
    let response = bench.command(MotionCommand::master_homing(Position(-3 * CM)));
    assert!(response.status.unwrap().homed());
    assert_eq!((response.actual, response.demand), (Some(-3 * CM), Some(-3 * CM)));
    bench.command(MotionCommand { id: 0x015, ..go_to(CM, VAD) });
    assert_eq!(bench.until_standing().actual, Some(-2 * CM));
}

#[test]
fn a_move_takes_the_time_of_a_move() {
    let mut bench = Bench::homed();
    // 100 mm with 0.5 m/s and 10 m/s2: 0.2 s of way + 0.05 s of ramps.
    let response = bench.command(go_to(10 * CM, VAD));
    assert!(response.status.unwrap().motion_active() && !response.status.unwrap().in_target());
    assert_eq!(response.state.unwrap().motion_active(), Some(true));
    let took = bench.until_stopped();
    assert!((249..=251).contains(&took), "{took} ms");
    assert_eq!(bench.until_standing().actual, Some(10 * CM));
    // Stop on the way: 0.5 m/s with 5 m/s2 is 25 mm.
    bench.command(go_to(0, VAD));
    bench.now = bench.now + 100 * MS;
    let from = bench.command(MotionCommand::vai_stop(Acceleration(500_000))).demand.unwrap();
    let to = bench.until_standing().demand.unwrap();
    assert!((from - to - 250_000).abs() < 1_000, "{from} to {to}");
}

#[test]
fn armed_commands_wait_for_their_event() {
    let mut bench = Bench::homed();
    bench.command(go_to(CM, VAD));
    // 018x: after the running one.
    let after = MotionCommand { id: 0x018, ..go_to(3 * CM, VAD) };
    let response = bench.command(after);
    assert!(response.status.unwrap().has(StatusWord::EVENT_HANDLER));
    bench.until(|response| !response.status.unwrap().has(StatusWord::EVENT_HANDLER));
    assert_eq!(bench.until_standing().actual, Some(3 * CM));
    // 01Ex: another profile from 50 mm on.
    let slow = Vad { velocity: 100_000, ..VAD };
    bench.command(go_to(10 * CM, VAD));
    bench.command(MotionCommand { id: 0x01E, ..go_to(5 * CM, slow) });
    assert!(bench.until_stopped() > 450);
    assert_eq!(bench.until_standing().actual, Some(10 * CM));
    // 01Ax: a trigger that never comes, whatever else moves, until it is cleared.
    bench.command(MotionCommand { id: 0x01A, ..go_to(0, VAD) });
    bench.now = bench.now + S;
    bench.command(go_to(9 * CM, VAD));
    bench.until_standing();
    bench.command(go_to(10 * CM, VAD));
    assert!(bench.until_standing().status.unwrap().has(StatusWord::EVENT_HANDLER));
    let response = bench.command(MotionCommand::clear_events());
    assert!(!response.status.unwrap().has(StatusWord::EVENT_HANDLER));
    assert_eq!(response.actual, Some(10 * CM));
    // 0E0x starts from standstill only.
    bench.command(go_to(0, VAD));
    bench.command(MotionCommand { id: 0x0E0, ..go_to(5 * CM, VAD) });
    assert_eq!((bench.until_standing().actual, bench.sim.refused_moves()), (Some(0), 1));
}

#[test]
fn running_into_the_end_of_the_range_is_an_error() {
    for (command, code) in [
        (MotionCommand::vai_predefined_run_negative(), ErrorCode::MIN_POSITION),
        (MotionCommand::vai_predefined_run_positive(), ErrorCode::MAX_POSITION),
    ] {
        assert_eq!(Bench::homed().fails(command), code);
        // Also when nobody looks for an hour.
        let mut bench = Bench::homed();
        bench.command(command);
        bench.now = bench.now + 3_600 * S;
        assert_eq!(bench.until_error(), code);
    }
}

#[test]
fn the_range_counts_only_once_the_drive_is_homed() {
    for (start, jog, way) in [(20 * CM - 1, 0x013F, CM), (1 - 20 * CM, 0x023F, -CM)] {
        let mut bench = Bench::new(|plan| plan.start_position = start);
        bench.enable();
        bench.home();
        // In the middle now, but the sensor begins at the end of the range again.
        bench.sim.restart(bench.now);
        bench.now = bench.now + S;
        bench.enable();
        assert_eq!(bench.exchange(None).actual, Some(start));
        bench.state(ControlWord(jog));
        bench.now = bench.now + S;
        let response = bench.exchange(None);
        assert_eq!(response.error, Some(ErrorCode::NONE));
        assert!((response.actual.unwrap() - start) / way >= 1, "{response:?}");
    }
}
