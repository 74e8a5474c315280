//! Time curves run: positions at several instants, scales, and what they are refused for.

use super::memory::curve;
use super::*;
use fieldbeat_linudp::motion::{AmplitudeScale, CurveId, CurveTime, Long, Offset, TimeScale};

fn id(id: u16) -> CurveId {
    CurveId::new(id).unwrap()
}

/// Homed at 0, with curve 5: to 10 mm and on to 40 mm in one second.
fn bench() -> Bench {
    let mut bench = Bench::homed();
    assert_eq!(bench.add_curve(&curve(5, &[0, CM, 4 * CM])), DONE);
    bench
}

fn scaled(offset: i32, time: u16, amplitude: i16) -> MotionCommand {
    let (time, amplitude) = (TimeScale::new(time).unwrap(), AmplitudeScale::new(amplitude).unwrap());
    MotionCommand::curve_start_scaled(id(5), Position(offset), time, amplitude)
}

/// Demand positions so many ms behind the command.
fn demands(bench: &mut Bench, command: MotionCommand, at_ms: &[u64]) -> Vec<i32> {
    bench.command(command);
    let from = bench.now;
    let demand = |ms: &u64| {
        bench.now = from + (ms - 1) * MS;
        let response = bench.exchange(None);
        assert_eq!(response.error, Some(ErrorCode::NONE));
        response.demand.unwrap()
    };
    at_ms.iter().map(demand).collect()
}

#[test]
fn a_curve_is_stretched_as_the_command_says() {
    // Offset, twice the time, half the amplitude backwards; it begins where it says, not where the motor is.
    let mut bench = bench();
    assert_eq!(
        demands(&mut bench, scaled(0, 20_000, -500), &[500, 1_000, 2_000]),
        [-CM / 4, -CM / 2, -2 * CM]
    );
    let mut bench = bench_at(CM);
    assert_eq!(demands(&mut bench, scaled(CM, 5_000, 1_000), &[250, 500]), [2 * CM, 5 * CM]);
    // In a time of its own.
    let mut bench = bench_at(CM);
    let amplitude = AmplitudeScale::new(1_000).unwrap();
    let in_time = MotionCommand::curve_start_in_time(id(5), Position(CM), CurveTime(200_000), amplitude);
    assert_eq!(demands(&mut bench, in_time, &[1_000, 2_000]), [2 * CM, 5 * CM]);
    // From where the motor is; to a target from there; and that in a time.
    let mut bench = bench_at(3 * CM);
    let from_actual = MotionCommand::curve_start_from_actual(id(5));
    assert_eq!(demands(&mut bench, from_actual, &[500, 1_000]), [4 * CM, 7 * CM]);
    let mut bench = bench_at(3 * CM);
    let to_target = MotionCommand::curve_start_to_target(id(5), Position(-5 * CM));
    assert_eq!(demands(&mut bench, to_target, &[500, 1_000]), [CM, -5 * CM]);
    let mut bench = bench_at(3 * CM);
    let in_time = MotionCommand::curve_start_to_target_in_time(id(5), Position(-5 * CM), CurveTime(200_000));
    assert_eq!(demands(&mut bench, in_time, &[1_000, 2_000, 3_000]), [CM, -5 * CM, -5 * CM]);
}

fn bench_at(position: i32) -> Bench {
    let mut bench = bench();
    bench.command(go_to(position, VAD));
    bench.until_standing();
    bench
}

#[test]
fn a_stopped_curve_does_not_go_on_and_an_armed_one_does_not_begin() {
    let mut bench = bench();
    for control in [ControlWord(0x001F), ControlWord::ABORT] {
        bench.command(MotionCommand::curve_start_from_actual(id(5)));
        bench.now = bench.now + 300 * MS;
        bench.state(control);
        let stood = bench.until_standing();
        bench.control = ControlWord::ON;
        bench.now = bench.now + S;
        let response = bench.exchange(None);
        assert_eq!((response.demand, response.error), (stood.demand, Some(ErrorCode::NONE)));
    }
    // Nor one that another motion takes over from; and a move after it waits for its end.
    bench.command(MotionCommand::curve_start_from_actual(id(5)));
    bench.now = bench.now + 300 * MS;
    bench.command(go_to(0, VAD));
    assert_eq!(bench.until_standing().demand, Some(0));
    bench.command(MotionCommand::curve_start(id(5)));
    let after = MotionCommand { id: 0x018, ..go_to(0, VAD) };
    assert!(bench.command(after).status.unwrap().has(StatusWord::EVENT_HANDLER));
    bench.now = bench.now + 998 * MS;
    assert_eq!(bench.exchange(None).demand, Some(4 * CM));
    assert_eq!(bench.until_standing().demand, Some(0));
    // One for the trigger stays armed.
    let armed = bench.command(MotionCommand::curve_start_to_target_on_rising_trigger(id(5), Position(CM)));
    assert!(armed.status.unwrap().has(StatusWord::EVENT_HANDLER) && !armed.status.unwrap().motion_active());
    bench.now = bench.now + 10 * S;
    let cleared = bench.command(MotionCommand::clear_events());
    assert_eq!((cleared.demand, cleared.status.unwrap().has(StatusWord::EVENT_HANDLER)), (Some(0), false));
}

#[test]
fn a_curve_is_modified_in_ram_by_motion_commands() {
    let mut bench = bench();
    // The last setpoint, then the length: 20 mm in half a second. While it runs, as it was.
    bench.command(MotionCommand::curve_start(id(5)));
    bench.command(MotionCommand::curve_modify_one(id(5), Offset(8), Long(2 * CM)));
    bench.command(MotionCommand::curve_modify_info_long(id(5), Offset(32), Long(50_000)));
    assert_eq!(bench.until_standing().demand, Some(4 * CM));
    bench.command(go_to(0, VAD));
    bench.until_standing();
    assert_eq!(demands(&mut bench, MotionCommand::curve_start(id(5)), &[250, 500]), [CM, 2 * CM]);
}
