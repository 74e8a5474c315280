//! The real-time-config channel: counts, busy answers, parameters, lists, the error log, starts and stops.

use super::*;
use crate::linudp::FlashMode;

const DONE: RtcStatus = RtcStatus::Done;

fn refused(refusal: Refusal) -> RtcStatus {
    RtcStatus::Refused(refusal)
}

#[test]
fn a_command_runs_if_its_count_is_new_and_else_its_answer_is_repeated() {
    let mut bench = Bench::new(|_| {});
    let nothing = RtcCommand::NO_OPERATION;
    // The stored count is 0 after a start: a first command with 0 is not run.
    assert_eq!(bench.configure(RtcBlock::call(0, RtcCommand::READ_RAM, 0x9999, 0)), RtcBlock::default());
    for count in (1..16).chain(0..3) {
        assert_eq!(
            bench.configure(RtcBlock::command(count, nothing)),
            RtcBlock::answer(count, RtcStatus::DONE)
        );
    }
    let read = RtcBlock::call(4, RtcCommand::READ_RAM, 0x20A8, 0x7_0007);
    let answer = RtcBlock { words: [0x20A8, 0x1E0F, 0], ..RtcBlock::answer(4, RtcStatus::DONE) };
    assert_eq!(bench.configure(read), answer);
    // The same count again, whatever it requests; reserved bits of the first byte are no part of it.
    assert_eq!(bench.configure(RtcBlock::command(4, nothing)), answer);
    assert_eq!(bench.configure(RtcBlock { tag: 0xF4, ..RtcBlock::command(4, nothing) }), answer);
    let reserved = RtcBlock { tag: 0xA5, ..RtcBlock::command(0, nothing) };
    assert_eq!(bench.configure(reserved), RtcBlock::answer(5, RtcStatus::DONE));
    // Toggling between two counts is enough.
    for n in 0..6 {
        let write = RtcBlock::call(6 + n % 2, RtcCommand::WRITE_RAM, 0x1E72, n.into());
        assert_eq!(bench.configure(write).status(), DONE);
        assert_eq!(
            bench.configure(RtcBlock::call(8 + n % 2, RtcCommand::READ_RAM, 0x1E72, 0)).value(),
            u32::from(n)
        );
    }
}

#[test]
fn a_command_that_takes_its_time_is_busy_and_no_other_is_taken() {
    let mut bench = Bench::new(|plan| plan.config_time_ns = 3 * MS);
    bench.configure(RtcBlock::command(0, RtcCommand::NO_OPERATION));
    let read = |count, upid| RtcBlock::call(count, RtcCommand::READ_RAM, upid, 0);
    let first = bench.configure(read(1, 0x20A8));
    assert_eq!((first.count(), first.status(), first.words), (1, RtcStatus::Running, [0; 3]));
    assert_eq!(bench.configure(read(1, 0x20A8)).status(), RtcStatus::Busy);
    bench.now = bench.now + 2 * MS;
    // Another command now: not taken, its count is not echoed.
    let second = bench.configure(read(2, 0x20A9));
    assert_eq!((second.count(), second.status()), (1, RtcStatus::Running));
    bench.now = bench.now + MS;
    let done = bench.configure(read(1, 0x20A8));
    assert_eq!((done.count(), done.status(), done.words), (1, DONE, [0x20A8, 0x1E0F, 0]));
    // Now it is taken; meanwhile the words are those of the answer before.
    let second = bench.configure(read(2, 0x20A9));
    assert_eq!((second.count(), second.status(), second.words), (2, RtcStatus::Running, [0x20A8, 0x1E0F, 0]));
    bench.now = bench.now + 3 * MS;
    assert_eq!(bench.configure(read(2, 0x20A9)).words, [0x20A9, 0x1E10, 0]);
    // A restart forgets it.
    bench.configure(read(3, 0x20A8));
    bench.sim.restart(bench.now);
    assert_eq!(bench.configure(read(0, 0x20A8)), RtcBlock::default());
}

/// What each command of the manual answers on a fresh drive, whose software runs, for index 1 and value 2.
#[test]
fn every_command_of_the_manual_is_known() {
    use RtcCommand as C;
    for command in C::ALL {
        let mut bench = Bench::new(|_| {});
        let (status, words) = bench.rtc(*command, [1, 2, 0]);
        let expected = match *command {
            C::NO_OPERATION | C::START_LIST | C::START_MODIFIED_LIST | C::RESTART => (DONE, [0; 3]),
            C::STOP_SOFTWARE | C::START_SOFTWARE | C::DELETE_CURVES | C::DELETE_TABLE => (DONE, [0; 3]),
            C::READ_ROM | C::READ_RAM | C::READ_MINIMUM | C::READ_MAXIMUM | C::READ_DEFAULT => {
                (refused(Refusal::NoSuchUpid), [1, 0, 0])
            }
            C::WRITE_ROM | C::WRITE_RAM | C::WRITE_BOTH => (refused(Refusal::NoSuchUpid), [1, 0, 0]),
            C::NEXT_ITEM | C::NEXT_MODIFIED_ITEM => (refused(Refusal::ListNotStarted), [1, 0, 0]),
            C::DEFAULT_OS | C::DEFAULT_MC | C::DEFAULT_INTERFACE | C::DEFAULT_APPLICATION => {
                (refused(Refusal::SoftwareRuns), [1, 0, 0])
            }
            C::SAVE_CURVES | C::SAVE_TABLE => (refused(Refusal::SoftwareRuns), [1, 0, 0]),
            // Two bytes of information; no block without its start.
            C::ADD_CURVE | C::MODIFY_CURVE => (refused(Refusal::WrongSize), [1, 0, 0]),
            C::ADD_CURVE_INFO | C::ADD_CURVE_DATA | C::MODIFY_CURVE_INFO | C::MODIFY_CURVE_DATA => {
                (refused(Refusal::WrongSize), [1, 0, 0])
            }
            C::GET_CURVE => (refused(Refusal::CurveDefinition), [1, 0, 0]),
            C::GET_CURVE_INFO | C::GET_CURVE_DATA => (refused(Refusal::WrongSize), [1, 0, 0]),
            C::ERROR_COUNTERS => (DONE, [0; 3]),
            C::ERROR_CODE | C::ERROR_TIME_LOW | C::ERROR_TIME_HIGH => {
                (refused(Refusal::OutOfRange), [1, 0, 0])
            }
            // "logic supply voltage low", characters 8 ... 11.
            C::ERROR_TEXT => (DONE, [1, u16::from_le_bytes(*b"pp"), u16::from_le_bytes(*b"ly")]),
            C::DELETE_ENTRY => (DONE, [1, 0, 0]),
            C::WRITE_ENTRY | C::WRITE_ENTRY_DATA | C::GET_ENTRY | C::GET_ENTRY_DATA => {
                (refused(Refusal::WrongSize), [1, 0, 0])
            }
            // Nothing is used: all bits are 1.
            C(code) => {
                assert!((0x87..=0x8E).contains(&code), "{command} is not in this test");
                (DONE, [u16::from(code - 0x87) * 4, 0xFFFF, 0xFFFF])
            }
        };
        assert_eq!((status, words), expected, "{command}");
    }
    // What the manual does not list.
    for code in (0..=u8::MAX).filter(|code| !C::ALL.contains(&C(*code))) {
        let answer = Bench::new(|_| {}).rtc(C(code), [1, 2, 3]);
        assert_eq!(answer, (refused(Refusal::NoSuchUpid), [1, 0, 0]), "{code:02X}h");
    }
}

#[test]
fn parameters_are_read_and_written_in_ram_and_rom() {
    use RtcCommand as C;
    let mut bench = Bench::new(|_| {});
    let velocity = 0x14BE;
    assert_eq!(bench.value(C::READ_DEFAULT, velocity), 1_000_000);
    assert_eq!(
        (bench.value(C::READ_MINIMUM, velocity), bench.value(C::READ_MAXIMUM, velocity)),
        (1, 1 << 30)
    );
    assert_eq!(bench.write(C::WRITE_RAM, velocity, 70_000), DONE);
    assert_eq!((bench.value(C::READ_RAM, velocity), bench.value(C::READ_ROM, velocity)), (70_000, 1_000_000));
    assert_eq!(bench.write(C::WRITE_ROM, velocity, 80_000), DONE);
    assert_eq!((bench.value(C::READ_RAM, velocity), bench.value(C::READ_ROM, velocity)), (70_000, 80_000));
    assert_eq!(bench.write(C::WRITE_BOTH, velocity, 90_000), DONE);
    assert_eq!((bench.value(C::READ_RAM, velocity), bench.value(C::READ_ROM, velocity)), (90_000, 90_000));
    bench.write(C::WRITE_RAM, velocity, 70_000);
    bench.restart();
    assert_eq!(bench.value(C::READ_RAM, velocity), 90_000);
    for (command, upid, value, refusal) in [
        (C::WRITE_RAM, 0x1D51, 0, Refusal::AddressUsage),
        (C::WRITE_ROM, 0x1E72, 0, Refusal::AddressUsage),
        (C::WRITE_BOTH, 0x1E72, 0, Refusal::AddressUsage),
        (C::WRITE_BOTH, 0x13A2, 0x1_0000, Refusal::WrongType),
        (C::WRITE_ROM, 0x14BE, 0, Refusal::OutOfRange),
        (C::WRITE_BOTH, 0x20A8, 0x1E11, Refusal::OutOfRange),
    ] {
        assert_eq!(bench.write(command, upid, value), refused(refusal), "{command} {upid:04X}h");
    }
    assert_eq!(bench.rtc(C::READ_ROM, [0x1D51, 0, 0]).0, refused(Refusal::AddressUsage));
    // Nothing of that was written.
    assert_eq!((bench.value(C::READ_RAM, 0x13A2), bench.value(C::READ_ROM, velocity)), (150, 90_000));
}

#[test]
fn the_drive_works_with_its_parameters() {
    use RtcCommand as C;
    // The range, live.
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x146F, CM as u32);
    bench.command(go_to(2 * CM, VAD));
    assert_eq!(bench.until_error(), ErrorCode::MAX_POSITION);
    // The lag limits: 10 um are less than what the motor needs to follow; standing has its own code.
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x1473, 100);
    bench.command(go_to(2 * CM, VAD));
    assert_eq!(bench.until_error(), ErrorCode::POSITION_LAG);
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x1475, 10);
    bench.command(go_to(2 * CM, VAD));
    assert_eq!(bench.until_error(), ErrorCode(0x000C));
    // The profile.
    let mut bench = Bench::homed();
    for (upid, value) in [(0x14BE, 100_000), (0x14BF, 2_000_000), (0x14C0, 1_000_000)] {
        bench.write(C::WRITE_RAM, upid, value);
    }
    bench.command(MotionCommand::vai_predefined_go_to(Position(CM)));
    let took = bench.until(|response| !response.status.unwrap().motion_active());
    assert!((107..=109).contains(&took), "{took} ms");
    assert_eq!(bench.value(C::READ_RAM, 0x1E0B), 100_000);
    assert_eq!(bench.value(C::READ_RAM, 0x1E0A), CM as u32);
    // The streaming period.
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x14E6, 1_000);
    bench.command(MotionCommand::stream_p_configured(Position(0)));
    assert_eq!(bench.until_error(), ErrorCode::STREAM_TOO_FAST);
    // Run modes without their inputs take no motion commands.
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x1450, 4);
    bench.command(MotionCommand::no_operation());
    assert_eq!(bench.exchange(None).error, Some(ErrorCode::NONE));
    bench.command(MotionCommand::vai_stop(Acceleration(1)));
    assert_eq!(bench.until_error(), ErrorCode::WRONG_STATE);
}

#[test]
fn the_home_position_takes_effect_when_the_software_starts() {
    use RtcCommand as C;
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x13C7, 3 * CM as u32);
    bench.home();
    assert_eq!(bench.until_standing().actual, Some(0));
    bench.control = ControlWord::BASE;
    bench.exchange(None);
    assert_eq!(bench.rtc(C::STOP_SOFTWARE, [0; 3]).0, DONE);
    assert_eq!(bench.rtc(C::START_SOFTWARE, [0; 3]).0, DONE);
    bench.enable();
    bench.home();
    assert_eq!(bench.until_standing().actual, Some(3 * CM));
    // It stands where it stood: only the number is another one.
    bench.restart();
    bench.enable();
    bench.home();
    assert_eq!(bench.until_standing().actual, Some(0));
}

#[test]
fn the_lists_go_through_all_upids_and_through_the_modified_ones() {
    use RtcCommand as C;
    let mut bench = Bench::new(|_| {});
    bench.rtc(C::START_LIST, [0; 3]);
    let mut all = Vec::new();
    let end = loop {
        match bench.rtc(C::NEXT_ITEM, [0; 3]) {
            (DONE, [upid, usage, 0]) => all.push((upid, usage)),
            (end, _) => break end,
        }
    };
    assert_eq!(end, refused(Refusal::EndOfList));
    assert_eq!(bench.rtc(C::NEXT_ITEM, [0; 3]).0, refused(Refusal::EndOfList));
    assert!(all.windows(2).all(|pair| pair[0].0 < pair[1].0) && all.len() > 80);
    for (upid, usage) in
        [(0x20A8, 0x010F), (0x13C7, 0x000F), (0x1D51, 0x1001), (0x1E72, 0x1103), (0x000C, 0x1005)]
    {
        assert!(all.contains(&(upid, usage)), "{upid:04X}h");
    }
    // Every one of them can be read.
    for (upid, _) in &all {
        bench.value(C::READ_RAM, *upid);
    }
    // From the middle, and from behind the end.
    bench.rtc(C::START_LIST, [0x20A9, 0, 0]);
    assert_eq!(bench.rtc(C::NEXT_ITEM, [0; 3]), (DONE, [0x20A9, 0x010F, 0]));
    assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, refused(Refusal::ListNotStarted));
    bench.rtc(C::START_LIST, [0xFFFF, 0, 0]);
    assert_eq!(bench.rtc(C::NEXT_ITEM, [0; 3]).0, refused(Refusal::EndOfList));
    // Modified is what ROM holds, not RAM.
    bench.write(C::WRITE_RAM, 0x14BE, 5);
    bench.write(C::WRITE_ROM, 0x14C0, 0x12_3456);
    bench.rtc(C::START_MODIFIED_LIST, [0x14BE, 0, 0]);
    assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]), (DONE, [0x14C0, 0x3456, 0x12]));
    assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]), (DONE, [0x14E6, 2_000, 0]));
    for _ in 0..2 {
        assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, refused(Refusal::EndOfList));
    }
    assert_eq!(bench.rtc(C::NEXT_ITEM, [0; 3]).0, refused(Refusal::ListNotStarted));
    bench.restart();
    assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, refused(Refusal::ListNotStarted));
}

#[test]
fn the_monitoring_channels_show_what_their_parameters_name() {
    use RtcCommand as C;
    for extend_sign in [false, true] {
        let mut bench = Bench::new(|plan| plan.extend_sign = extend_sign);
        bench.enable();
        bench.home();
        bench.write(C::WRITE_RAM, 0x1E72, -5_i32 as u32);
        for (channel, upid) in [0x1E72, 0x1E0E, 0, 0x1B93].into_iter().enumerate() {
            assert_eq!(bench.write(C::WRITE_RAM, 0x20A8 + channel as u16, upid), DONE);
        }
        bench.command(go_to(-CM, VAD));
        bench.now = bench.now + 20 * MS;
        let response = bench.ask(&Request { response_def: ResponseDef(0xFF), ..Request::default() });
        let monitor = response.monitor.unwrap();
        // 16 bits with a sign: how they fill 32 is not documented.
        let current = response.current.unwrap();
        assert!(current < 0);
        let current = if extend_sign { i32::from(current) as u32 } else { u32::from(current as u16) };
        assert_eq!(monitor, [-5_i32 as u32, response.demand.unwrap() as u32, 0, current]);
        assert_eq!(bench.value(C::READ_RAM, 0x1B93), current);
        // In flash it outlives a restart; in RAM it does not.
        bench.write(C::WRITE_BOTH, 0x20A8, 0x1CAF);
        bench.restart();
        bench.now = bench.now + 7 * MS;
        let response = bench.ask(&Request { response_def: ResponseDef(0xFF), ..Request::default() });
        let monitor = response.monitor.unwrap();
        assert_eq!(
            monitor,
            [(BOOT_NS + 7 * MS) as u32 / 1_000, 0, 400, u32::from(response.status.unwrap().0)]
        );
    }
}

#[test]
fn the_error_log_outlives_a_restart() {
    use RtcCommand as C;
    let mut bench = Bench::homed();
    let born = Time(5 * S) + MS;
    for code in [0x0003, 0x0005] {
        bench.now = bench.now + 5_400 * S;
        bench.exchange(None);
        bench.sim.provoke(ErrorCode(code));
        bench.until_error();
        bench.control = ControlWord::BASE;
        bench.exchange(None);
        bench.control = ControlWord::ACKNOWLEDGE;
        bench.exchange(None);
        bench.enable();
    }
    bench.restart();
    assert_eq!(bench.rtc(C::ERROR_COUNTERS, [0; 3]), (DONE, [0, 2, 2]));
    // The newest first. Three hours, and what enabling and homing took.
    assert_eq!((bench.value(C::ERROR_CODE, 0), bench.value(C::ERROR_CODE, 1)), (5, 3));
    assert_eq!((bench.value(C::ERROR_TIME_HIGH, 0), bench.value(C::ERROR_TIME_HIGH, 1)), (3, 1));
    let (newest, oldest) = (bench.value(C::ERROR_TIME_LOW, 0), bench.value(C::ERROR_TIME_LOW, 1));
    assert!((1..5_000).contains(&newest) && (1_800_000..1_805_000).contains(&oldest), "{newest}, {oldest}");
    let hours = bench.now.since(born) / 3_600 / S;
    let ms = bench.value(C::READ_RAM, 0x0082);
    assert!(hours == 3 && (newest..10_000).contains(&ms), "{ms}");
    for entry in [2, 20, 21, u16::MAX] {
        assert_eq!(bench.rtc(C::ERROR_CODE, [entry, 0, 0]).0, refused(Refusal::OutOfRange));
    }
    let text: Vec<u8> = (0..8)
        .flat_map(|part| {
            let (status, [code, low, high]) = bench.rtc(C::ERROR_TEXT, [0x0003, part, 0]);
            assert_eq!((status, code), (DONE, 3));
            [low.to_le_bytes(), high.to_le_bytes()].concat()
        })
        .collect();
    assert_eq!(text, *b"motor supply voltage low\0\0\0\0\0\0\0\0");
    for (code, part) in [(0x0003, 8), (0x00FF, 0)] {
        assert_eq!(bench.rtc(C::ERROR_TEXT, [code, part, 0]).0, refused(Refusal::OutOfRange));
    }
}

#[test]
fn stopped_software_shows_zeros_takes_nothing_and_forgets_home() {
    use RtcCommand as C;
    let mut bench = Bench::homed();
    bench.command(go_to(CM, VAD));
    bench.now = bench.now + 50 * MS;
    assert_eq!(bench.rtc(C::STOP_SOFTWARE, [0; 3]).0, DONE);
    for _ in 0..5 {
        let response = bench.command(go_to(5 * CM, VAD));
        assert_eq!((response.status, response.state), (Some(StatusWord(0)), Some(StateVar(0))));
        assert_eq!(response.error, Some(ErrorCode::NONE));
    }
    assert_eq!(bench.value(C::READ_RAM, 0x1D51), 0);
    assert_eq!(bench.rtc(C::STOP_SOFTWARE, [0; 3]).0, DONE);
    // The motor has no power: it runs out and stays.
    bench.now = bench.now + S;
    let stood = bench.exchange(None).actual.unwrap();
    assert!(stood > 0 && stood < 5 * CM);
    assert_eq!(bench.rtc(C::START_SOFTWARE, [0; 3]).0, DONE);
    // Bit 0 is still set from the master's side: locked until it was low.
    let response = bench.exchange(None);
    assert_eq!(response.state, Some(StateVar(0)));
    assert!(response.status.unwrap().has(StatusWord::SWITCH_ON_LOCKED) && !response.status.unwrap().homed());
    bench.enable();
    assert_eq!(bench.count, 0);
    assert_eq!(bench.exchange(None).actual, Some(stood));
    // Again changes nothing.
    assert_eq!(bench.rtc(C::START_SOFTWARE, [0; 3]).0, DONE);
    assert!(bench.exchange(None).status.unwrap().operation_enabled());
}

#[test]
fn a_fatal_error_outlives_the_software_and_not_the_drive() {
    use RtcCommand as C;
    let mut bench = Bench::homed();
    bench.sim.provoke(ErrorCode(0x0045));
    bench.until_error();
    bench.rtc(C::STOP_SOFTWARE, [0; 3]);
    bench.rtc(C::START_SOFTWARE, [0; 3]);
    assert_eq!(bench.exchange(None).state, Some(StateVar(0x0445)));
    bench.restart();
    bench.enable();
}

#[test]
fn a_restart_is_answered_and_then_the_drive_is_silent_until_it_is_back() {
    use RtcCommand as C;
    let mut bench = Bench::homed();
    bench.rtc(C::WRITE_RAM, [0x1E72, 5, 0]);
    let restart = RtcBlock::command(9, C::RESTART);
    let mut slow = Bench::new(|plan| plan.config_time_ns = MS);
    assert_eq!(slow.configure(restart).status(), DONE);
    assert_eq!(bench.configure(restart), RtcBlock::answer(9, RtcStatus::DONE));
    for _ in 0..99 {
        bench.now = bench.now + MS;
        assert_eq!(bench.try_configure(restart), None);
    }
    assert_eq!(bench.sim.ignored().deaf, 99);
    // The stored count is 0 again: who goes on sending it restarts the drive again.
    bench.now = bench.now + MS;
    assert_eq!(bench.configure(restart), RtcBlock::answer(9, RtcStatus::DONE));
    bench.now = bench.now + BOOT_NS;
    assert_eq!(bench.configure(RtcBlock::command(0, C::NO_OPERATION)), RtcBlock::default());
    bench.config_count = 0;
    assert_eq!(bench.value(C::READ_RAM, 0x1E72), 0);
    assert!(!bench.exchange(None).status.unwrap().homed());
}

#[test]
fn defaults_need_stopped_software_and_a_restart() {
    use RtcCommand as C;
    let mut bench = Bench::new(|_| {});
    assert_eq!(bench.value(C::READ_RAM, 0x14E6), 2_000);
    assert_eq!(bench.rtc(C::DEFAULT_MC, [0; 3]).0, refused(Refusal::SoftwareRuns));
    bench.rtc(C::STOP_SOFTWARE, [0; 3]);
    assert_eq!(bench.write(C::DEFAULT_MC, 0, 0), DONE);
    assert_eq!((bench.value(C::READ_ROM, 0x14E6), bench.value(C::READ_RAM, 0x14E6)), (1_000, 2_000));
    bench.write(C::WRITE_ROM, 0x20A8, 0);
    bench.restart();
    assert_eq!((bench.value(C::READ_RAM, 0x14E6), bench.value(C::READ_RAM, 0x20A8)), (1_000, 0));
    bench.rtc(C::STOP_SOFTWARE, [0; 3]);
    for command in [C::DEFAULT_OS, C::DEFAULT_INTERFACE, C::DEFAULT_APPLICATION] {
        assert_eq!(bench.write(command, 0, 0), DONE);
    }
    assert_eq!(bench.value(C::READ_ROM, 0x20A8), 0x1E0F);
}

#[test]
fn a_write_into_rom_stalls_the_interface_shortly() {
    use RtcCommand as C;
    for (flash, deaf) in [(FlashMode::Silent, 2), (FlashMode::Busy, 0)] {
        let mut bench = Bench::new(|plan| (plan.flash, plan.flash_time_ns) = (flash, S));
        let write = RtcBlock::call(1, C::WRITE_ROM, 0x14BE, 7);
        assert_eq!(bench.configure(write).status(), RtcStatus::Running);
        let mut answers = Vec::new();
        for _ in 0..4 {
            bench.now = bench.now + 500 * US;
            answers.extend(bench.try_configure(write).map(|answer| answer.status()));
        }
        assert_eq!(answers.last(), Some(&DONE));
        assert_eq!(answers.len(), if deaf > 0 { 1 } else { 4 });
        assert_eq!(bench.sim.ignored().deaf > 0, deaf > 0);
        assert_eq!(bench.value(C::READ_ROM, 0x14BE), 7);
        // Cut off by a restart the old value stays.
        bench.config_count = 3;
        bench.rtc(C::WRITE_ROM, [0x14BE, 9, 0]);
        bench.restart();
        assert_eq!(bench.value(C::READ_ROM, 0x14BE), 7);
    }
}

impl Bench {
    /// Power off and on; until it is back.
    pub(super) fn restart(&mut self) {
        self.sim.restart(self.now);
        self.now = self.now + BOOT_NS;
        (self.count, self.config_count) = (0, 0);
    }
}
