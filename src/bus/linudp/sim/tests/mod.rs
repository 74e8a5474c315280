//! The drive as a master meets it: only telegrams in, only telegrams out, in virtual time. Here the master's side and
//! the state machine; streams and the odd cases of the telegram have their own files.

mod stream;
mod telegram;

use super::*;
use crate::axis::{AxisPlan, Units};
use crate::bus::linudp::motion::{MotionCommand, Vad};
use crate::bus::linudp::plan::{DRIVE_PORT, SimPlan, StreamCommand};
use crate::bus::linudp::wire::{ControlWord, MainState, MotionBlock, ResponseDef};

const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(127, 1, 1, 1), MASTER_PORT);

/// 10 mm in wire counts.
const CM: i32 = 100_000;
/// 0.5 m/s, 10 m/s2.
const VAD: Vad = Vad { velocity: 500_000, acceleration: 1_000_000, deceleration: 1_000_000 };

fn drive() -> LinUdpDrive {
    LinUdpDrive {
        axis: AxisPlan::new("x", Units::millimetres(10_000.0)),
        address: SocketAddrV4::new(Ipv4Addr::new(127, 1, 1, 10), DRIVE_PORT),
        stream: Some(StreamCommand::P),
        monitor: false,
        reply_tag: false,
        leash: None,
        simulate: SimPlan {
            faults: FaultPlan::default(),
            padding: 14,
            filter: MasterFilter::None,
            start_position: 2 * CM,
            range: (-20 * CM, 20 * CM),
            mass_kg: 1.0,
            home_position: 0,
            stream_period_ns: 2 * MS,
            stream_patience: 2.5,
            stream_depth: 8,
            force_enable_bits: false,
            start_running: false,
        },
    }
}

/// A drive and a master's notion of time.
struct Bench {
    sim: LinMotSim,
    now: Time,
    control: ControlWord,
    count: u8,
}

impl Bench {
    fn new(change: impl FnOnce(&mut SimPlan)) -> Bench {
        let mut drive = drive();
        change(&mut drive.simulate);
        Bench { sim: LinMotSim::new(&drive), now: Time(5 * S), control: ControlWord::BASE, count: 0 }
    }

    /// Switched on and homed, at 0.
    fn homed() -> Bench {
        let mut bench = Bench::new(|_| {});
        bench.enable();
        bench.home();
        bench
    }

    fn raw(&mut self, from: SocketAddrV4, bytes: &[u8]) -> Option<Vec<u8>> {
        let mut reply = Vec::new();
        let to = self.sim.receive(self.now, from, bytes, &mut reply);
        assert_eq!(to.is_some(), !reply.is_empty());
        assert!(to.is_none_or(|to| to == from));
        to.map(|_| reply)
    }

    fn ask(&mut self, request: &Request) -> Response {
        let mut bytes = [0; 64];
        let size = request.emit(&mut bytes);
        Response::parse(&self.raw(MASTER, &bytes[..size]).expect("no answer")).unwrap()
    }

    /// 1 ms later: one exchange with the control word, and `motion` if there is one.
    fn exchange(&mut self, motion: Option<MotionBlock>) -> Response {
        self.now = self.now + MS;
        let request = Request {
            response_def: ResponseDef::CYCLIC,
            control: Some(self.control),
            motion,
            ..Request::default()
        };
        self.ask(&request)
    }

    fn state(&mut self, control: ControlWord) -> StateVar {
        self.control = control;
        self.exchange(None).state.unwrap()
    }

    fn command(&mut self, command: MotionCommand) -> Response {
        self.count = (self.count + 1) % 16;
        self.exchange(Some(command.block(self.count)))
    }

    /// Exchanges until the drive is there; how many it took.
    fn until(&mut self, what: impl Fn(&Response) -> bool) -> u32 {
        for exchanges in 1..20_000 {
            if what(&self.exchange(None)) {
                return exchanges;
            }
        }
        panic!("never got there: {:?}", self.exchange(None));
    }

    fn until_main(&mut self, main: MainState) -> u32 {
        self.until(|response| response.state.unwrap().main() == main)
    }

    fn enable(&mut self) {
        self.control = ControlWord::BASE;
        self.until_main(MainState::READY_TO_SWITCH_ON);
        self.control = ControlWord::ON;
        self.until_main(MainState::OPERATION_ENABLED);
        self.count = self.exchange(None).state.unwrap().count().unwrap();
    }

    fn home(&mut self) {
        self.control = ControlWord::HOME;
        self.until(|response| response.state.unwrap().finished());
        self.control = ControlWord::ON;
        self.until_main(MainState::OPERATION_ENABLED);
    }

    fn until_standing(&mut self) -> Response {
        self.until(|response| !response.status.unwrap().motion_active());
        self.until(|response| response.status.unwrap().in_target());
        // The last micrometres.
        self.now = self.now + 300 * MS;
        self.exchange(None)
    }

    /// Quick stop, if any, is over: the error that stands.
    fn until_error(&mut self) -> ErrorCode {
        self.until_main(MainState::ERROR);
        let response = self.exchange(None);
        assert_eq!(u16::from(response.state.unwrap().sub()), response.error.unwrap().0 & 0xFF);
        assert!(response.status.unwrap().error());
        response.error.unwrap()
    }
}

// The state machine (SG5 manual).

#[test]
fn enabling_passes_all_states_and_takes_the_hardware_tests() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(bench.state(ControlWord::BASE).main(), MainState::SWITCH_ON_DISABLED);
    assert_eq!(bench.state(ControlWord::BASE).main(), MainState::READY_TO_SWITCH_ON);
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::HW_TESTS);
    // Bit 3 held back: stays in 6.
    bench.control = ControlWord(0x0037);
    let tests = bench.until_main(MainState::READY_TO_OPERATE);
    assert!((299..=301).contains(&tests), "{tests} ms");
    assert!(!bench.exchange(None).status.unwrap().operation_enabled());
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    let response = bench.exchange(None);
    let status = response.status.unwrap();
    // On, enabled, voltage, no quick stop, warning (not homed), in target.
    assert_eq!(status, StatusWord(0x04B7));
    assert_eq!(response.warn.unwrap().names().collect::<Vec<_>>(), ["motor not homed"]);
    assert_eq!(response.state, Some(StateVar(0x0840)));
    assert_eq!(response.actual, Some(2 * CM));
}

#[test]
fn switching_on_is_locked_until_bit_0_was_low() {
    let mut bench = Bench::new(|_| {});
    for _ in 0..10 {
        assert_eq!(bench.state(ControlWord::ON).main(), MainState::NOT_READY);
    }
    assert!(bench.exchange(None).status.unwrap().switch_on_locked());
    assert_eq!(bench.state(ControlWord::BASE).main(), MainState::SWITCH_ON_DISABLED);
    assert!(!bench.exchange(None).status.unwrap().switch_on_locked());
}

#[test]
fn an_error_is_acknowledged_by_an_edge_and_ends_in_state_0() {
    let mut bench = Bench::homed();
    bench.sim.provoke(ErrorCode(0x0003));
    assert_eq!(bench.until_error(), ErrorCode(0x0003));
    // Switching off changes nothing; the edge does, and with bit 0 still set the drive stays locked in 0.
    assert_eq!(bench.state(ControlWord::BASE), StateVar(0x0403));
    assert_eq!(bench.state(ControlWord(0x00BF)).main(), MainState::NOT_READY);
    bench.now = bench.now + S;
    let response = bench.exchange(None);
    assert_eq!(response.state.unwrap().main(), MainState::NOT_READY);
    assert!(response.status.unwrap().switch_on_locked() && !response.status.unwrap().error());
    assert_eq!(response.error, Some(ErrorCode::NONE));
    bench.enable();
    // A level is no edge: bit 7 set before the error does nothing.
    bench.state(ControlWord(0x00BF));
    bench.sim.provoke(ErrorCode(0x0003));
    for _ in 0..10 {
        assert_eq!(bench.state(ControlWord(0x00BF)).main(), MainState::ERROR);
    }
    bench.state(ControlWord::BASE);
    assert_eq!(bench.state(ControlWord::ACKNOWLEDGE).main(), MainState::NOT_READY);
}

#[test]
fn a_fatal_error_needs_a_restart() {
    let mut bench = Bench::homed();
    bench.sim.provoke(ErrorCode(0x0045));
    bench.until_error();
    bench.state(ControlWord::BASE);
    assert_eq!(bench.state(ControlWord::ACKNOWLEDGE).main(), MainState::ERROR);
    assert!(bench.exchange(None).status.unwrap().fatal());
    bench.control = ControlWord::BASE;
    // The stored count is 0 and the command has to have 0, so another count has to come between. It restarts once: the
    // count is 0 again behind it.
    bench.exchange(Some(MotionCommand::NO_OPERATION.block(1)));
    bench.exchange(Some(MotionCommand::RESET_FIRMWARE.block(0)));
    assert_eq!(bench.exchange(Some(MotionCommand::RESET_FIRMWARE.block(0))).state, Some(StateVar(0)));
    bench.now = bench.now + BOOT_NS;
    for _ in 0..10 {
        bench.exchange(Some(MotionCommand::RESET_FIRMWARE.block(0)));
    }
    bench.enable();
}

#[test]
fn homing_takes_the_time_of_its_move_and_waits_for_its_bit() {
    let mut bench = Bench::new(|plan| plan.home_position = 7 * CM);
    bench.enable();
    bench.control = ControlWord::HOME;
    let response = bench.exchange(None);
    assert_eq!(response.state, Some(StateVar(0x0900)));
    assert!(response.status.unwrap().has(StatusWord::SPECIAL_MOTION | StatusWord::MOTION_ACTIVE));
    // 50 mm at 100 mm/s, with 1 m/s2: 0.5 s of way + 0.1 s of ramps, and some to settle.
    let took = bench.until(|response| response.state.unwrap().finished());
    assert!((590..700).contains(&took), "{took} ms");
    for _ in 0..5 {
        let response = bench.exchange(None);
        assert_eq!(response.state, Some(StateVar(0x090F)));
        assert_eq!(response.demand, Some(7 * CM));
        assert!((response.actual.unwrap() - 7 * CM).abs() < 500);
        assert!(response.status.unwrap().homed() && response.warn.unwrap().0 == 0);
    }
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    // Homed survives switching off.
    bench.enable();
    assert!(bench.exchange(None).status.unwrap().homed());
}

#[test]
fn homing_that_is_released_early_is_no_homing() {
    let mut bench = Bench::homed();
    bench.command(MotionCommand::go_to(CM, VAD));
    bench.until_standing();
    bench.control = ControlWord::HOME;
    bench.until(|response| response.status.unwrap().motion_active());
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    assert!(!bench.until_standing().status.unwrap().homed());
}

#[test]
fn abort_stops_and_stays_freeze_stops_and_goes_on() {
    let mut bench = Bench::homed();
    bench.command(MotionCommand::go_to(10 * CM, VAD));
    bench.now = bench.now + 100 * MS;
    assert_eq!(bench.state(ControlWord(0x001F)).main(), MainState::FREEZING);
    let frozen = bench.until_standing();
    assert!(frozen.demand.unwrap() < 9 * CM);
    bench.control = ControlWord::ON;
    assert_eq!(bench.until_standing().actual, Some(10 * CM));

    bench.command(MotionCommand::go_to(0, VAD));
    bench.now = bench.now + 100 * MS;
    assert_eq!(bench.state(ControlWord::ABORT).main(), MainState::ABORTING);
    let aborted = bench.until_standing();
    assert!(aborted.demand.unwrap() > CM);
    bench.control = ControlWord::ON;
    assert_eq!(bench.until_standing().demand, aborted.demand);
    assert!(bench.exchange(None).status.unwrap().operation_enabled());
}

#[test]
fn quick_stop_brakes_and_then_switches_off() {
    let mut bench = Bench::homed();
    bench.command(MotionCommand::go_to(10 * CM, VAD));
    bench.now = bench.now + 100 * MS;
    assert_eq!(bench.state(ControlWord::QUICK_STOP).main(), MainState::QUICK_STOP);
    // 0.5 m/s with 20 m/s2.
    let took = bench.until_main(MainState::NOT_READY);
    assert!((20..30).contains(&took), "{took} ms");
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::NOT_READY);
    bench.enable();
}

#[test]
fn bit_3_goes_back_to_6_and_bits_0_and_1_switch_off() {
    let mut bench = Bench::homed();
    bench.command(MotionCommand::go_to(10 * CM, VAD));
    assert_eq!(bench.state(ControlWord(0x0037)).main(), MainState::READY_TO_OPERATE);
    let response = bench.exchange(None);
    assert!(!response.status.unwrap().motion_active() && response.demand.unwrap() < CM);
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    assert_eq!(bench.state(ControlWord(0x003D)).main(), MainState::NOT_READY);
    bench.enable();
    assert_eq!(bench.state(ControlWord::BASE).main(), MainState::NOT_READY);
}

#[test]
fn forced_bits_let_a_sloppy_master_enable() {
    for forced in [false, true] {
        let mut bench = Bench::new(|plan| plan.force_enable_bits = forced);
        for _ in 0..3 {
            bench.state(ControlWord(0));
        }
        bench.now = bench.now + S;
        bench.state(ControlWord(1));
        bench.now = bench.now + S;
        assert_eq!(bench.state(ControlWord(1)).main() == MainState::OPERATION_ENABLED, forced);
    }
}

#[test]
fn jogging_and_going_to_the_position_end_with_their_bits() {
    let mut bench = Bench::homed();
    assert_eq!(bench.state(ControlWord(0x013F)), StateVar(0x1001));
    bench.now = bench.now + S;
    assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    let jogged = bench.until_standing().actual.unwrap();
    assert!((195_000..210_000).contains(&jogged), "{jogged}");
    for bit in [ControlWord::GO_TO_INITIAL, ControlWord::GO_TO_POSITION] {
        bench.command(MotionCommand::go_to(CM, VAD));
        bench.until_standing();
        bench.control = ControlWord(ControlWord::ON.0 | bit);
        bench.until(|response| response.state.unwrap().finished());
        assert_eq!(bench.until_standing().actual, Some(0));
        assert_eq!(bench.state(ControlWord::ON).main(), MainState::OPERATION_ENABLED);
    }
}

// Counts and commands (SG5 manual, motion command interface).

#[test]
fn a_command_runs_once_for_each_new_count() {
    let mut bench = Bench::homed();
    let step = MotionCommand::increment_target(CM, VAD);
    for count in [3, 3, 3, 7, 7, 0, 0] {
        assert_eq!(bench.exchange(Some(step.block(count))).state.unwrap().count(), Some(count));
    }
    assert_eq!(bench.until_standing().actual, Some(3 * CM));
}

#[test]
fn a_count_is_stored_with_every_command_and_shown_in_state_8_only() {
    let mut bench = Bench::new(|_| {});
    bench.control = ControlWord::BASE;
    // Below state 5 commands are ignored, but counted.
    let response = bench.exchange(Some(MotionCommand::go_to(CM, VAD).block(9)));
    assert_eq!((response.state.unwrap().sub(), response.error), (0, Some(ErrorCode::NONE)));
    bench.enable();
    assert_eq!(bench.count, 9);
    bench.home();
    let response = bench.exchange(Some(MotionCommand::go_to(CM, VAD).block(9)));
    assert!(!response.status.unwrap().motion_active());
}

#[test]
fn commands_in_other_states_are_errors() {
    // State 6.
    let mut bench = Bench::homed();
    bench.state(ControlWord(0x0037));
    bench.command(MotionCommand::NO_OPERATION);
    bench.command(MotionCommand::control_word(0x0037));
    assert_eq!(bench.exchange(None).error, Some(ErrorCode::NONE));
    bench.command(MotionCommand::go_to(CM, VAD));
    assert_eq!(bench.until_error(), ErrorCode::WRONG_STATE);
    // State 9, finished: still not 8.
    let mut bench = Bench::homed();
    bench.control = ControlWord::HOME;
    bench.until(|response| response.state.unwrap().finished());
    bench.command(MotionCommand::stop(1));
    assert_eq!(bench.until_error(), ErrorCode::WRONG_STATE);
}

#[test]
fn commands_that_this_drive_does_not_know_are_errors() {
    for (id, code) in [
        (0x0A0, ErrorCode::UNKNOWN_COMMAND),
        (0x040, ErrorCode::CURVE_NOT_DEFINED),
        (0x200, ErrorCode::ENTRY_MISSING),
    ] {
        let mut bench = Bench::homed();
        bench.command(MotionCommand::new(id));
        assert_eq!(bench.until_error(), code);
    }
}

#[test]
fn an_error_stops_the_motor_before_it_switches_off() {
    let mut bench = Bench::homed();
    bench.command(MotionCommand::go_to(10 * CM, VAD));
    bench.now = bench.now + 100 * MS;
    let response = bench.command(MotionCommand::new(0x999));
    assert_eq!(response.state.unwrap().main(), MainState::QUICK_STOP);
    assert!(response.status.unwrap().error());
    assert_eq!(bench.until_error(), ErrorCode::UNKNOWN_COMMAND);
}

#[test]
fn moves_before_homing_are_errors() {
    let mut bench = Bench::new(|_| {});
    bench.enable();
    bench.command(MotionCommand::stop(1));
    bench.command(MotionCommand::go_to(CM, VAD));
    assert_eq!(bench.until_error(), ErrorCode::NOT_HOMED);
}

#[test]
fn the_master_can_home() {
    let mut bench = Bench::new(|_| {});
    bench.enable();
    let response = bench.command(MotionCommand::master_homing(-3 * CM));
    assert!(response.status.unwrap().homed());
    assert_eq!((response.actual, response.demand), (Some(-3 * CM), Some(-3 * CM)));
    bench.command(MotionCommand::increment_actual(CM, VAD));
    assert_eq!(bench.until_standing().actual, Some(-2 * CM));
}

#[test]
fn a_move_takes_the_time_of_a_move() {
    let mut bench = Bench::homed();
    // 100 mm with 0.5 m/s and 10 m/s2: 0.2 s of way + 0.05 s of ramps.
    let response = bench.command(MotionCommand::go_to(10 * CM, VAD));
    assert!(response.status.unwrap().motion_active() && !response.status.unwrap().in_target());
    assert_eq!(response.state.unwrap().motion_active(), Some(true));
    let took = bench.until(|response| !response.status.unwrap().motion_active());
    assert!((249..=251).contains(&took), "{took} ms");
    assert_eq!(bench.until_standing().actual, Some(10 * CM));
    // Stop on the way: 0.5 m/s with 5 m/s2 is 25 mm.
    bench.command(MotionCommand::go_to(0, VAD));
    bench.now = bench.now + 100 * MS;
    let from = bench.command(MotionCommand::stop(500_000)).demand.unwrap();
    let to = bench.until_standing().demand.unwrap();
    assert!((from - to - 250_000).abs() < 1_000, "{from} to {to}");
}

#[test]
fn moves_start_from_demand_or_from_where_the_motor_is() {
    let hard = Vad { velocity: 2_000_000, acceleration: 8_000_000, deceleration: 8_000_000 };
    for (command, from_actual, moving) in [
        (MotionCommand::go_to(0, VAD), false, true),
        (MotionCommand::go_to_from_actual(0, VAD), true, true),
        (MotionCommand::go_to_from_standstill(0, VAD), true, false),
        (MotionCommand::increment_actual(0, VAD), true, true),
        (MotionCommand { id: 0x016, ..MotionCommand::increment_actual(0, VAD) }, true, false),
    ] {
        let mut bench = Bench::homed();
        bench.command(MotionCommand::go_to(10 * CM, hard));
        bench.now = bench.now + 10 * MS;
        let before = bench.exchange(None);
        assert!((before.demand.unwrap() - before.actual.unwrap()).abs() > 100, "no lag to see: {before:?}");
        // At the same instant.
        bench.count = (bench.count + 1) % 16;
        let after = bench.ask(&Request {
            response_def: ResponseDef(0xFF),
            motion: Some(command.block(bench.count)),
            ..Request::default()
        });
        assert_eq!(after.demand, if from_actual { before.actual } else { before.demand }, "{command:?}");
        assert_eq!(after.monitor.unwrap()[0] != 0, moving, "{command:?}");
        let increment = matches!(command.id, 0x015 | 0x016);
        let target = if increment { before.actual } else { Some(0) };
        assert_eq!(bench.until_standing().demand, target, "{command:?}");
    }
}

#[test]
fn the_predefined_profile_is_a_live_parameter() {
    let mut bench = Bench::homed();
    for (upid, value) in [(0x14BE, 100_000), (0x14BF, 2_000_000), (0x14C0, 1_000_000), (0x9999, 1)] {
        bench.command(MotionCommand::live_parameter(upid, value));
    }
    bench.command(MotionCommand::go_to_predefined(CM));
    // 10 mm with 0.1 m/s: 100 ms, + 0.1 / 20 / 2 + 0.1 / 10 / 2 s of ramps.
    let took = bench.until(|response| !response.status.unwrap().motion_active());
    assert!((107..=109).contains(&took), "{took} ms");
}

#[test]
fn armed_commands_wait_for_their_event() {
    let mut bench = Bench::homed();
    bench.command(MotionCommand::go_to(CM, VAD));
    // 018x: after the running one.
    let after = MotionCommand { id: 0x018, ..MotionCommand::go_to(3 * CM, VAD) };
    let response = bench.command(after);
    assert!(response.status.unwrap().has(StatusWord::EVENT_HANDLER));
    bench.until(|response| !response.status.unwrap().has(StatusWord::EVENT_HANDLER));
    assert_eq!(bench.until_standing().actual, Some(3 * CM));
    // 01Ex: another profile from 50 mm on.
    let slow = Vad { velocity: 100_000, ..VAD };
    bench.command(MotionCommand::go_to(10 * CM, VAD));
    bench.command(MotionCommand { id: 0x01E, ..MotionCommand::go_to(5 * CM, slow) });
    assert!(bench.until(|response| !response.status.unwrap().motion_active()) > 450);
    assert_eq!(bench.until_standing().actual, Some(10 * CM));
    // 01Ax: a trigger that never comes, until it is cleared.
    bench.command(MotionCommand { id: 0x01A, ..MotionCommand::go_to(0, VAD) });
    bench.now = bench.now + S;
    let response = bench.command(MotionCommand::CLEAR_EVENTS);
    assert!(!response.status.unwrap().has(StatusWord::EVENT_HANDLER));
    assert_eq!(response.actual, Some(10 * CM));
    // 0E0x starts from standstill only.
    bench.command(MotionCommand::go_to(0, VAD));
    bench.command(MotionCommand { id: 0x0E0, ..MotionCommand::go_to(5 * CM, VAD) });
    assert_eq!((bench.until_standing().actual, bench.sim.refused_moves()), (Some(0), 1));
}

#[test]
fn running_into_the_end_of_the_range_is_an_error() {
    for (positive, code) in [(false, ErrorCode::MIN_POSITION), (true, ErrorCode::MAX_POSITION)] {
        let mut bench = Bench::homed();
        bench.command(MotionCommand::run_predefined(positive));
        assert_eq!(bench.until_error(), code);
        // Also when nobody looks for an hour.
        let mut bench = Bench::homed();
        bench.command(MotionCommand::run_predefined(positive));
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

#[test]
fn a_demand_that_the_motor_cannot_follow_is_a_position_lag() {
    let mut bench = Bench::homed();
    let jump = Vad { velocity: 20_000_000, acceleration: 100_000_000, deceleration: 100_000_000 };
    bench.command(MotionCommand::go_to(10 * CM, jump));
    assert_eq!(bench.until_error(), ErrorCode::POSITION_LAG);
}
