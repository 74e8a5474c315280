//! Motion commands: counts, states that take them, moves, armed commands, errors (SG5 manual, motion command
//! interface).

use super::*;

#[test]
fn a_command_out_of_place_is_an_error_that_stops_the_motor_before_it_switches_off() {
    // State 6.
    let mut bench = Bench::homed();
    bench.state(0x0037);
    bench.command(motion(0x000, &[]));
    bench.command(motion(0x001, &[0x0037]));
    assert_eq!(bench.exchange(None).error, errors::NONE);
    assert_eq!(bench.fails(go_to(CM, VAD)), errors::WRONG_STATE);
    // State 9, finished: still not 8.
    let mut bench = Bench::homed();
    bench.control = control::ON | control::HOME;
    bench.until(Report::is_finished);
    assert_eq!(bench.fails(motion(0x017, &[1])), errors::WRONG_STATE);
    // A move before homing.
    let mut bench = Bench::new(|_| {});
    bench.enable();
    bench.command(motion(0x017, &[1]));
    assert_eq!(bench.fails(go_to(CM, VAD)), errors::NOT_HOMED);
    // A demand that the motor cannot follow.
    let jump = Vad { velocity: 20_000_000, acceleration: 100_000_000, deceleration: 100_000_000 };
    assert_eq!(Bench::homed().fails(go_to(10 * CM, jump)), errors::POSITION_LAG);
    // On the way.
    let mut bench = Bench::homed();
    bench.command_for(go_to(10 * CM, VAD), 100 * MS);
    let report = bench.command(motion(0x999, &[]));
    assert!(report.main() == state::QUICK_STOP && report.has(status::ERROR));
    assert_eq!(bench.until_error(), errors::UNKNOWN_COMMAND);
}

#[test]
fn the_master_can_home() {
    let mut bench = Bench::new(|_| {});
    bench.enable();
    let report = bench.command(motion(0x009, &[(-3 * CM).into()]));
    assert!(report.has(status::HOMED));
    assert_eq!((report.actual, report.demand), (-3 * CM, -3 * CM));
    assert_eq!(bench.ends_at(move_by(0x015, CM, VAD)), -2 * CM);
}

#[test]
fn a_move_takes_the_time_of_a_move() {
    let mut bench = Bench::homed();
    // 100 mm with 0.5 m/s and 10 m/s2: 0.2 s of way + 0.05 s of ramps.
    let report = bench.command(go_to(10 * CM, VAD));
    assert!(report.has(status::MOTION_ACTIVE) && !report.has(status::IN_TARGET));
    assert_eq!(report.state as u8 & !0xF, sub_state::MOTION_ACTIVE | sub_state::HOMED);
    let took = bench.until_stopped();
    assert!((249..=251).contains(&took), "{took} ms");
    assert_eq!(bench.until_standing().actual, 10 * CM);
    // Stop on the way: 0.5 m/s with 5 m/s2 is 25 mm.
    bench.command_for(go_to(0, VAD), 100 * MS);
    let from = bench.command(motion(0x017, &[500_000])).demand;
    let to = bench.until_standing().demand;
    assert!((from - to - 250_000).abs() < 1_000, "{from} to {to}");
}

#[test]
fn armed_commands_wait_for_their_event() {
    let mut bench = Bench::homed();
    bench.command(go_to(CM, VAD));
    // 018x: after the running one.
    assert!(bench.command(move_by(0x018, 3 * CM, VAD)).has(status::EVENT_HANDLER));
    bench.until(|report| !report.has(status::EVENT_HANDLER));
    assert_eq!(bench.until_standing().actual, 3 * CM);
    // 01Ex: another profile from 50 mm on.
    bench.command(go_to(10 * CM, VAD));
    bench.command(move_by(0x01E, 5 * CM, Vad { velocity: 100_000, ..VAD }));
    assert!(bench.until_stopped() > 450);
    assert_eq!(bench.until_standing().actual, 10 * CM);
    // 01Ax: a trigger that never comes, whatever else moves, until it is cleared.
    bench.command_for(move_by(0x01A, 0, VAD), S);
    bench.ends_at(go_to(9 * CM, VAD));
    bench.command(go_to(10 * CM, VAD));
    assert!(bench.until_standing().has(status::EVENT_HANDLER));
    let report = bench.command(motion(0x008, &[]));
    assert!(!report.has(status::EVENT_HANDLER));
    assert_eq!(report.actual, 10 * CM);
    // 0E0x starts from standstill only.
    bench.command(go_to(0, VAD));
    assert_eq!((bench.ends_at(move_by(0x0E0, 5 * CM, VAD)), bench.sim.refused_moves()), (0, 1));
}

#[test]
fn running_into_the_end_of_the_range_is_an_error() {
    for (id, code) in [(0x02F, errors::MIN_POSITION), (0x02E, errors::MAX_POSITION)] {
        assert_eq!(Bench::homed().fails(motion(id, &[])), code);
        // Also without a telegram for an hour.
        let mut bench = Bench::homed();
        bench.command_for(motion(id, &[]), 3_600 * S);
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
        bench.wait(S);
        bench.enable();
        assert_eq!(bench.exchange(None).actual, start);
        bench.state(jog);
        bench.wait(S);
        let report = bench.exchange(None);
        assert_eq!(report.error, errors::NONE);
        assert!((report.actual - start) / way >= 1, "{report:?}");
    }
}
