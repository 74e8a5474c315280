//! The command table runs, and the motion families that came with it.

use proptest::prelude::*;

use super::store::{curve, entry};
use super::*;
use crate::linudp::codec::stored::Entry;

/// Homed at 0, with these entries from 1 on, each linked to the next one, the last one to none.
fn bench(commands: &[Motion]) -> Bench {
    let mut bench = Bench::homed();
    for (at, command) in (1..).zip(commands) {
        let next = (usize::from(at) < commands.len()).then_some(at + 1);
        assert_eq!(bench.put_entry(at, &entry(*command, next)), DONE);
    }
    bench
}

impl Bench {
    fn start(&mut self) -> Report {
        self.command(motion(0x200, &[1]))
    }

    fn variable(&mut self, variable: u16) -> i32 {
        self.value(C::READ_RAM, 0x1E71 + variable) as i32
    }
}

#[test]
fn a_wait_takes_its_time_and_waits_and_branches_look_at_what_the_drive_does() {
    const CM: i64 = 100_000;
    let mut bench = bench(&[
        // 0.25 s, and 0.1 s by a variable.
        motion(0x210, &[2_500]),
        motion(0x240, &[1_000]),
        motion(0x218, &[]),
        // On the way to 100 mm: past 50 mm, that position into variable 1.
        go_to(10 * super::CM, VAD),
        motion(0x220, &[5 * CM]),
        motion(0x24C, &[0x1E0E]),
        // The inputs X4 are low; the status word has not only the homed bit.
        motion(0x262, &[0b11, 0, 8, 10]),
        motion(0x264, &[status::HOMED.into(), 0xFFFF, 9, 10]),
        motion(0x242, &[77]),
        // The actual position past 90 mm, the velocity below 0.1 m/s; variable 2 into a parameter, and that into ROM.
        motion(0x222, &[9 * CM]),
        motion(0x229, &[100_000]),
        motion(0x249, &[0x14BE]),
        motion(0x24E, &[0x14BE]),
    ]);
    bench.start();
    let waited = bench.until(|report| report.has(status::MOTION_ACTIVE));
    assert!((349..=352).contains(&waited), "{waited} ms");
    bench.until_standing();
    let passed = i64::from(bench.variable(1));
    assert!((5 * CM..5 * CM + 5_000).contains(&passed), "{passed}");
    assert_eq!((bench.variable(2), bench.value(C::READ_RAM, 0x14BE)), (77, 77));
    assert_eq!(bench.value(C::READ_ROM, 0x14BE), 77);
}

#[test]
fn a_loop_without_a_wait_keeps_the_drive_busy_and_no_more() {
    let mut bench = Bench::homed();
    bench.put_entry(1, &entry(motion(0x241, &[1]), Some(1)));
    bench.start();
    bench.wait(100 * MS);
    bench.exchange(None);
    let counted = bench.variable(1);
    assert!((1_000..3_000).contains(&counted), "{counted}");
    // Nor for hours.
    bench.wait(3_600 * S);
    assert_eq!(bench.exchange(None).error, errors::NONE);
    // Variables of 32 bits go round.
    bench.write(C::WRITE_RAM, 0x1E72, i32::MAX as u32);
    bench.wait(MS);
    assert!(bench.exchange(None).error == errors::NONE && bench.variable(1) < 0);
}

#[test]
fn missing_entries_are_error_008a_and_what_the_table_cannot_do_is_error_0081() {
    for id in [1, 0] {
        assert_eq!(Bench::homed().fails(motion(0x200, &[id])), errors::ENTRY_MISSING);
    }
    for (command, code) in [
        // A link to nowhere, and a branch.
        (motion(0x000, &[]), errors::ENTRY_MISSING),
        (motion(0x250, &[1, 200, 1]), errors::ENTRY_MISSING),
        // An analog input, a condition without a meaning, a restart.
        (motion(0x260, &[1, 1, 1]), errors::UNKNOWN_COMMAND),
        (motion(0x266, &[1, 1, 1]), errors::UNKNOWN_COMMAND),
        (motion(0x00F, &[]), errors::UNKNOWN_COMMAND),
    ] {
        let mut bench = Bench::homed();
        bench.put_entry(1, &entry(command, Some(200)));
        bench.start();
        assert_eq!(bench.until_error(), code, "{command:?}");
    }
}

#[test]
fn entries_are_modified_in_ram_by_motion_commands() {
    let moves = [go_to(CM, VAD), go_to(0, VAD)];
    let mut bench = self::bench(&moves);
    // The target, which is the first parameter; the link away.
    bench.command(motion(0x209, &[1, 6, (3 * CM).into()]));
    bench.command(motion(0x208, &[1, 2, -1]));
    bench.start();
    assert_eq!(bench.until_standing().actual, 3 * CM);
    for (command, code) in [
        (motion(0x209, &[3, 6, 0]), errors::ENTRY_MISSING),
        (motion(0x209, &[1, 62, 0]), errors::UNKNOWN_COMMAND),
        (motion(0x208, &[1, 0, 0]), errors::UNKNOWN_COMMAND),
    ] {
        assert_eq!(self::bench(&moves).fails(command), code);
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
    bench.wait(S);
    assert!(!bench.exchange(None).has(status::MOTION_ACTIVE));
    bench.home();
    assert_eq!(bench.until_standing().actual, CM);
    // Motion commands are taken, too; switched off and on it begins again.
    assert_eq!(bench.ends_at(go_to(0, VAD)), 0);
    bench.enable();
    assert_eq!(bench.until_standing().actual, CM);
    // Without its first entry it is an error.
    bench.rtc(C::DELETE_TABLE, [0; 3]);
    bench.control = control::ENABLES;
    bench.until_main(state::READY_TO_SWITCH_ON);
    bench.control = control::ON;
    assert_eq!(bench.until_error(), errors::ENTRY_MISSING);
}

/// Analog positions; commands of the command table.
fn is_refused(id: u16) -> bool {
    layout(id).is_none() || matches!(id, 0x019 | 0x0E9 | 0x0F9) || matches!(id >> 4, 0x21..=0x26)
}

#[test]
fn every_command_runs_or_is_refused_or_ignored() {
    // All that the drive knows, and: encoder cams, indexing, winding, force control, a stream with time stamps, the
    // address of a curve, numbers without a command.
    let others =
        [0x050, 0x069, 0x070, 0x100, 0x110, 0x304, 0x310, 0x380, 0x03A, 0x006, 0x036, 0x048, 0x0DA, 0x203];
    let known = (0..=0xFFF).filter(|id| layout(*id).is_some());
    for id in known.chain(others).chain([0x256, 0x999, 0xFFF]) {
        for unknown in [UnknownCommands::Refuse, UnknownCommands::Ignore] {
            let mut bench = Bench::homed_with(|plan| plan.unknown_commands = unknown);
            bench.add_curve(&curve(1, &[0; 16]));
            bench.put_entry(1, &entry(motion(0x000, &[]), None));
            bench.command(go_to(CM, VAD));
            // Writes go where they break nothing.
            let is_write = matches!(id, 0x050..=0x05F | 0x208 | 0x209);
            let report = bench.command(motion(id, if is_write { &[1, 32, 1, 1, 1] } else { &[1; 5] }));
            let refused = report.error == errors::UNKNOWN_COMMAND;
            assert_eq!(refused, unknown == UnknownCommands::Refuse && is_refused(id), "{id:03X} {unknown:?}");
            if is_refused(id) && !refused {
                assert_eq!(bench.until_standing().actual, CM, "{id:03X}");
            }
        }
    }
}

#[test]
fn moves_to_variables_and_those_of_the_trigger_have_their_parameters() {
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x1E73, 3 * CM as u32);
    assert_eq!(bench.ends_at(motion(0x0D5, &[500_000, 1_000_000, 1_000_000])), 3 * CM);
    bench.write(C::WRITE_RAM, 0x145F, (-CM) as u32);
    bench.write(C::WRITE_RAM, 0x1460, 123_456);
    bench.command(motion(0x0DF, &[]));
    assert_eq!(bench.value(C::READ_RAM, 0x1E0B), 123_456);
    assert_eq!(bench.until_standing().actual, -CM);
    assert_eq!(bench.ends_at(motion(0x0DE, &[])), 0);
    // The other controller set is a parameter; a third there is not.
    bench.command(motion(0x005, &[1]));
    bench.command(motion(0x005, &[7]));
    assert_eq!(bench.value(C::READ_RAM, 0x1393), 1);
}

#[test]
fn a_current_moves_the_motor_until_it_is_held_again() {
    let mut bench = Bench::homed();
    // 0.5 A are 10 N, 5 N more than the friction: 5 m/s2.
    bench.command_for(motion(0x390, &[500]), 100 * MS);
    let report = bench.exchange(None);
    assert_eq!((report.current, report.error, report.demand), (500, errors::NONE, report.actual));
    assert!((200_000..300_000).contains(&report.actual), "{report:?}");
    bench.command(motion(0x39F, &[]));
    let held = bench.until_standing();
    assert!(held.error == errors::NONE && held.demand > report.actual);
    bench.wait(S);
    assert_eq!(bench.exchange(None).actual, held.demand);
    // Against the end of the range it pushes; a move leads away from there.
    bench.command_for(motion(0x390, &[500]), 10 * S);
    let pushed = bench.exchange(None);
    assert_eq!((pushed.actual, pushed.current), (20 * CM, 500));
    assert_eq!(bench.ends_at(go_to(0, VAD)), 0);
    // An error stops it, and so does leaving state 8.
    bench.command_for(motion(0x390, &[-500]), 100 * MS);
    assert_eq!(bench.fails(motion(0x999, &[])), errors::UNKNOWN_COMMAND);
    bench.acknowledge();
    bench.wait(S);
    bench.enable();
    bench.command_for(motion(0x390, &[500]), 100 * MS);
    bench.state(control::ON & !control::NO_ABORT);
    assert_eq!(bench.until_standing().error, errors::NONE);
}

#[test]
fn a_move_that_presses_stays_behind_without_an_error() {
    let mut bench = Bench::homed();
    // Beyond the range of the motor, which has to be a range of the parameters for that.
    bench.write(C::WRITE_RAM, 0x146F, 100 * CM as u32);
    bench.command_for(motion(0x0C5, &[(21 * CM).into(), 100_000, 100_000, 300]), 10 * S);
    let pressed = bench.exchange(None);
    assert_eq!((pressed.demand, pressed.actual), (21 * CM, 20 * CM));
    assert_eq!((pressed.current, pressed.error), (300, errors::NONE));
    // Without the limit it is a lag.
    assert_eq!(bench.fails(go_to(21 * CM, VAD)), errors::POSITION_LAG);
}

/// Entries as nobody would write them: any command, parameters that are small now and then, links that lead somewhere
/// mostly.
fn entries() -> impl Strategy<Value = Vec<[u8; 64]>> {
    let known: Vec<u16> = (0..=0xFFF).filter(|id| layout(*id).is_some()).collect();
    let id = prop_oneof![8 => prop::sample::select(known), 1 => 0..=0xFFF_u16];
    let byte = prop_oneof![4 => Just(0_u8), 3 => 1..7_u8, 1 => any::<u8>()];
    let next = prop_oneof![8 => (1..7_u16).prop_map(Some), 1 => Just(None), 1 => any::<u16>().prop_map(Some)];
    let entry = (id, prop::array::uniform30(byte), next)
        .prop_map(|(id, parameters, next)| entry(Motion { header: id << 4, parameters }, next));
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
        for (id, entry) in (1..).zip(&entries) {
            prop_assert_eq!(bench.put_entry(id, entry), DONE);
        }
        bench.start();
        for (which, wait_ns) in commands {
            bench.wait(wait_ns);
            // The same commands from the bus; an error is acknowledged, and the table starts again.
            let report = bench.command(Entry::parse(entries[which]).unwrap().command());
            let main = report.main();
            prop_assert_eq!(report.has(status::ERROR), report.error != errors::NONE);
            prop_assert_eq!(report.has(status::OPERATION_ENABLED), main >= state::OPERATION_ENABLED);
            prop_assert!(!report.has(status::IN_TARGET | status::MOTION_ACTIVE));
            if main == state::OPERATION_ENABLED {
                prop_assert!(!report.has(status::ERROR));
                prop_assert_eq!(report.count(), bench.count);
            } else if main == state::ERROR {
                // On again, wherever that leads.
                bench.acknowledge();
                for word in [control::ENABLES, control::ON] {
                    bench.state(word);
                    bench.wait(400 * MS);
                }
                bench.start();
            } else {
                bench.control = control::ON;
            }
        }
    }
}
