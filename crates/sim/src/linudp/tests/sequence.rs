//! The command table runs, and the motion families that came with it.

use proptest::prelude::*;

use super::memory::{curve, entry};
use super::*;
use fieldbeat_linudp::motion::{
    Bits, CATALOGUE, CommandInfo, ControllerSet, Current, CurrentLimit, EntryId, Kind, Long, Mark, Offset,
    Short, SignedVelocity, Upid, WaitTime,
};
use fieldbeat_linudp::table::Entry;

fn id(id: u16) -> EntryId {
    EntryId::new(id).unwrap()
}

/// Homed at 0, with these entries from 1 on, each linked to the next one, the last one to none.
fn bench(commands: &[MotionCommand]) -> Bench {
    let mut bench = Bench::homed();
    for (n, command) in commands.iter().enumerate() {
        let at = n as u16 + 1;
        let next = (n + 1 < commands.len()).then_some(at + 1);
        assert_eq!(bench.put_entry(at, &entry(*command, next)), DONE);
    }
    bench
}

fn start(bench: &mut Bench) -> Response {
    bench.command(MotionCommand::table_start(id(1)))
}

fn variable(bench: &mut Bench, variable: u16) -> i32 {
    bench.value(C::READ_RAM, 0x1E71 + variable) as i32
}

#[test]
fn a_wait_takes_its_time_and_waits_and_branches_look_at_what_the_drive_does() {
    // 0.25 s and 0.1 s; on the way to 100 mm: past 50 mm, below 1 m/s, and with the trigger bit of no input.
    let mut bench = bench(&[
        MotionCommand::wait_time(WaitTime(2_500)),
        MotionCommand::variable_1_set(Long(1_000)),
        MotionCommand::wait_time_in_variable_1(),
        go_to(10 * CM, VAD),
        MotionCommand::wait_until_demand_position_greater(Position(5 * CM)),
        MotionCommand::upid_to_variable_1(Upid(0x1E0E)),
        MotionCommand::if_x4_inputs_equal(Bits(0b11), Bits(0), id(8), id(10)),
        MotionCommand::if_status_word_equal(Bits(StatusWord::HOMED), Bits(0xFFFF), id(9), id(10)),
        MotionCommand::variable_2_set(Long(77)),
        MotionCommand::wait_until_actual_position_greater(Position(9 * CM)),
        MotionCommand::wait_until_demand_velocity_less(SignedVelocity(100_000)),
        MotionCommand::variable_2_to_upid(Upid(0x14BE)),
        MotionCommand::upid_ram_to_rom(Upid(0x14BE)),
    ]);
    start(&mut bench);
    let waited = bench.until(|response| response.status.unwrap().motion_active());
    assert!((349..=352).contains(&waited), "{waited} ms");
    bench.until_standing();
    let passed = variable(&mut bench, 1);
    assert!((5 * CM..5 * CM + 5_000).contains(&passed), "{passed}");
    assert_eq!((variable(&mut bench, 2), bench.value(C::READ_RAM, 0x14BE)), (77, 77));
    assert_eq!(bench.value(C::READ_ROM, 0x14BE), 77);
}

#[test]
fn a_loop_without_a_wait_keeps_the_drive_busy_and_no_more() {
    let mut bench = Bench::homed();
    bench.put_entry(1, &entry(MotionCommand::variable_1_add(Long(1)), Some(1)));
    start(&mut bench);
    bench.now = bench.now + 100 * MS;
    bench.exchange(None);
    let counted = variable(&mut bench, 1);
    assert!((1_000..3_000).contains(&counted), "{counted}");
    // Nor for hours.
    bench.now = bench.now + 3_600 * S;
    assert_eq!(bench.exchange(None).error, Some(ErrorCode::NONE));
    // Variables of 32 bits go round.
    bench.write(C::WRITE_RAM, 0x1E72, i32::MAX as u32);
    bench.now = bench.now + MS;
    assert!(bench.exchange(None).error == Some(ErrorCode::NONE) && variable(&mut bench, 1) < 0);
}

#[test]
fn missing_entries_are_error_008a_and_what_the_table_cannot_do_is_error_0081() {
    assert_eq!(Bench::homed().fails(MotionCommand::table_start(id(1))), ErrorCode::ENTRY_MISSING);
    assert_eq!(Bench::homed().fails(MotionCommand::new(0x200)), ErrorCode::ENTRY_MISSING);
    // A link to nowhere, and a branch; an analog input, a condition without a meaning, a restart.
    for (command, code) in [
        (MotionCommand::no_operation(), ErrorCode::ENTRY_MISSING),
        (MotionCommand::if_variable_1_less(Long(1), id(200), id(1)), ErrorCode::ENTRY_MISSING),
        (MotionCommand::if_analog_input_less(Long(1), id(1), id(1)), ErrorCode::UNKNOWN_COMMAND),
        (MotionCommand::if_266(Long(1), id(1), id(1)), ErrorCode::UNKNOWN_COMMAND),
        (MotionCommand::reset_firmware(), ErrorCode::UNKNOWN_COMMAND),
    ] {
        let mut bench = Bench::homed();
        bench.put_entry(1, &entry(command, Some(200)));
        start(&mut bench);
        assert_eq!(bench.until_error(), code, "{command:?}");
    }
}

#[test]
fn entries_are_modified_in_ram_by_motion_commands() {
    let mut bench = bench(&[go_to(CM, VAD), go_to(0, VAD)]);
    // The target, which is the first parameter; the link away.
    bench.command(MotionCommand::table_modify_long(id(1), Offset(6), Long(3 * CM)));
    bench.command(MotionCommand::table_modify_short(id(1), Offset(2), Short(-1)));
    start(&mut bench);
    assert_eq!(bench.until_standing().actual, Some(3 * CM));
    for (command, code) in [
        (MotionCommand::table_modify_long(id(3), Offset(6), Long(0)), ErrorCode::ENTRY_MISSING),
        (MotionCommand::table_modify_long(id(1), Offset(62), Long(0)), ErrorCode::UNKNOWN_COMMAND),
        (MotionCommand::table_modify_short(id(1), Offset(0), Short(0)), ErrorCode::UNKNOWN_COMMAND),
    ] {
        assert_eq!(self::bench(&[go_to(CM, VAD), go_to(0, VAD)]).fails(command), code);
    }
}

#[test]
fn in_run_mode_3_the_table_begins_by_itself_once_homed() {
    let mut bench = bench(&[go_to(CM, VAD)]);
    bench.write(C::WRITE_BOTH, 0x1450, 3);
    bench.rtc(C::STOP_SOFTWARE, [0; 3]);
    assert_eq!(bench.write(C::SAVE_TABLE, 0, 0), DONE);
    bench.restart();
    bench.enable();
    bench.now = bench.now + S;
    assert!(!bench.exchange(None).status.unwrap().motion_active());
    bench.home();
    assert_eq!(bench.until_standing().actual, Some(CM));
    // Motion commands are taken, too; switched off and on it begins again.
    bench.command(go_to(0, VAD));
    assert_eq!(bench.until_standing().actual, Some(0));
    bench.enable();
    assert_eq!(bench.until_standing().actual, Some(CM));
    // Without its first entry it is an error.
    bench.rtc(C::DELETE_TABLE, [0; 3]);
    bench.control = ControlWord::BASE;
    bench.until_main(MainState::READY_TO_SWITCH_ON);
    bench.control = ControlWord::ON;
    assert_eq!(bench.until_error(), ErrorCode::ENTRY_MISSING);
}

/// Encoder cams, indexing, winding, force control; analog positions, a stream with time stamps, the address of a curve.
fn is_of_no_use(info: &CommandInfo) -> bool {
    info.is(Mark::TableOnly)
        || info.is(Mark::SoftwareKey)
        || matches!(info.id >> 4, 0x06 | 0x07 | 0x10..=0x12 | 0x30 | 0x31)
        || matches!(info.id, 0x019 | 0x0E9 | 0x0F9 | 0x03A | 0x050)
}

#[test]
fn every_command_of_the_catalogue_runs_or_is_refused_or_ignored() {
    for info in CATALOGUE {
        for unknown in [UnknownCommands::Refuse, UnknownCommands::Ignore] {
            let mut bench = Bench::homed_with(|plan| plan.unknown_commands = unknown);
            bench.add_curve(&curve(1, &[0; 16]));
            bench.put_entry(1, &entry(MotionCommand::no_operation(), None));
            bench.command(go_to(CM, VAD));
            // What is written is written where it breaks nothing.
            let is_written = info.fields.iter().any(|field| field.kind == Kind::Offset);
            let values = if is_written { [1, 32, 1, 1, 1] } else { [1; 5] };
            let response = bench.command(info.command(&values).unwrap());
            let refused = response.error == Some(ErrorCode::UNKNOWN_COMMAND);
            let expected = unknown == UnknownCommands::Refuse && is_of_no_use(info);
            assert_eq!(refused, expected, "{} {unknown:?}", info.name);
            if is_of_no_use(info) && !refused {
                assert_eq!(bench.until_standing().actual, Some(CM), "{}", info.name);
            }
        }
    }
    // What is in no catalogue.
    for id in [0x006, 0x036, 0x048, 0x0DA, 0x203, 0x256, 0x999, 0xFFF] {
        assert_eq!(Bench::homed().fails(MotionCommand::new(id)), ErrorCode::UNKNOWN_COMMAND, "{id:03X}");
    }
}

#[test]
fn moves_to_variables_and_those_of_the_trigger_have_their_parameters() {
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x1E73, 3 * CM as u32);
    let [v, a] = [500_000, 1_000_000];
    let to_variable = MotionCommand::vai_go_to_variable_2(Velocity(v), Acceleration(a), Acceleration(a));
    bench.command(to_variable);
    assert_eq!(bench.until_standing().actual, Some(3 * CM));
    bench.write(C::WRITE_RAM, 0x145F, (-CM) as u32);
    bench.write(C::WRITE_RAM, 0x1460, 123_456);
    bench.command(MotionCommand::vai_start_trigger_fall());
    assert_eq!(bench.value(C::READ_RAM, 0x1E0B), 123_456);
    assert_eq!(bench.until_standing().actual, Some(-CM));
    bench.command(MotionCommand::vai_start_trigger_rise());
    assert_eq!(bench.until_standing().actual, Some(0));
    // The other controller set is a parameter; a third there is not.
    bench.command(MotionCommand::controller_set(ControllerSet::new(1).unwrap()));
    bench.command(MotionCommand { id: 0x005, ..go_to(7, VAD) });
    assert_eq!(bench.value(C::READ_RAM, 0x1393), 1);
}

#[test]
fn a_current_moves_the_motor_until_it_is_held_again() {
    let mut bench = Bench::homed();
    // 0.5 A are 10 N, 5 N more than the friction: 5 m/s2.
    bench.command(MotionCommand::current_mode(Current(500)));
    bench.now = bench.now + 100 * MS;
    let response = bench.exchange(None);
    assert_eq!((response.current, response.error), (Some(500), Some(ErrorCode::NONE)));
    let actual = response.actual.unwrap();
    assert!((200_000..300_000).contains(&actual), "{actual}");
    assert_eq!(response.demand, Some(actual));
    bench.command(MotionCommand::position_mode());
    let held = bench.until_standing();
    assert!(held.error == Some(ErrorCode::NONE) && held.demand.unwrap() > actual);
    bench.now = bench.now + S;
    assert_eq!(bench.exchange(None).actual, held.demand);
    // Against the end of the range it pushes; a move leads away from there.
    bench.command(MotionCommand::current_mode(Current(500)));
    bench.now = bench.now + 10 * S;
    let pushed = bench.exchange(None);
    assert_eq!((pushed.actual, pushed.current), (Some(20 * CM), Some(500)));
    bench.command(go_to(0, VAD));
    assert_eq!(bench.until_standing().actual, Some(0));
    // An error stops it, and so does leaving state 8.
    bench.command(MotionCommand::current_mode(Current(-500)));
    bench.now = bench.now + 100 * MS;
    assert_eq!(bench.fails(MotionCommand::new(0x999)), ErrorCode::UNKNOWN_COMMAND);
    bench.acknowledge();
    bench.now = bench.now + S;
    bench.enable();
    bench.command(MotionCommand::current_mode(Current(500)));
    bench.now = bench.now + 100 * MS;
    bench.state(ControlWord::ABORT);
    assert_eq!(bench.until_standing().error, Some(ErrorCode::NONE));
}

#[test]
fn a_move_that_presses_stays_behind_without_an_error() {
    let mut bench = Bench::homed();
    // Beyond the range of the motor, which has to be a range of the parameters for that.
    bench.write(C::WRITE_RAM, 0x146F, 100 * CM as u32);
    let (velocity, acceleration) = (Velocity(100_000), Acceleration(100_000));
    let target = Position(21 * CM);
    bench.command(MotionCommand::vai_dec_acc_press(target, velocity, acceleration, CurrentLimit(300)));
    bench.now = bench.now + 10 * S;
    let pressed = bench.exchange(None);
    assert_eq!((pressed.demand, pressed.actual), (Some(21 * CM), Some(20 * CM)));
    assert_eq!((pressed.current, pressed.error), (Some(300), Some(ErrorCode::NONE)));
    // Without the limit it is a lag.
    assert_eq!(bench.fails(go_to(21 * CM, VAD)), ErrorCode::POSITION_LAG);
}

/// Entries as nobody would write them: any command, parameters that are small now and then, links that lead somewhere
/// mostly.
fn entries() -> impl Strategy<Value = Vec<Entry>> {
    let id = (0..CATALOGUE.len()).prop_map(|index| CATALOGUE[index].id);
    let byte = prop_oneof![4 => Just(0_u8), 3 => 1..7_u8, 1 => any::<u8>()];
    let next = prop_oneof![8 => (1..7_u16).prop_map(Some), 1 => Just(None), 1 => any::<u16>().prop_map(Some)];
    let entry = (id, prop::collection::vec(byte, 32), next).prop_map(|(id, bytes, next)| {
        let mut raw = Entry { header: id << 4, next, ..entry(MotionCommand::no_operation(), None) };
        raw.parameters.copy_from_slice(&bytes);
        raw
    });
    prop::collection::vec(entry, 6)
}

proptest! {
    #[test]
    fn no_table_and_no_command_upsets_the_drive(
        entries in entries(),
        commands in prop::collection::vec((0..6_usize, 0..300 * MS), 1..20),
        ignore in any::<bool>(),
    ) {
        let unknown = if ignore { UnknownCommands::Ignore } else { UnknownCommands::Refuse };
        let mut bench = Bench::homed_with(|plan| plan.unknown_commands = unknown);
        for id in 1..4 {
            bench.add_curve(&curve(id, &[0, CM, -CM, 0]));
        }
        for (n, entry) in entries.iter().enumerate() {
            prop_assert_eq!(bench.put_entry(n as u16 + 1, entry), DONE);
        }
        start(&mut bench);
        for (which, wait_ns) in commands {
            bench.now = bench.now + wait_ns;
            // The same commands from the bus; an error is acknowledged, and the table starts again.
            let response = bench.command(entries[which].command());
            let state = response.state.unwrap();
            let status = response.status.unwrap();
            prop_assert_eq!(status.error(), response.error != Some(ErrorCode::NONE));
            prop_assert_eq!(status.operation_enabled(), state.main() >= MainState::OPERATION_ENABLED);
            prop_assert!(!(status.in_target() && status.motion_active()));
            if state.main() == MainState::OPERATION_ENABLED {
                prop_assert!(!status.error());
                prop_assert_eq!(state.count(), Some(bench.count));
            } else if state.main() == MainState::ERROR {
                // On again, wherever that leads.
                for word in [ControlWord::BASE, ControlWord::ACKNOWLEDGE, ControlWord::BASE, ControlWord::ON] {
                    bench.state(word);
                    bench.now = bench.now + 400 * MS;
                }
                start(&mut bench);
            } else {
                bench.control = ControlWord::ON;
            }
        }
    }
}
