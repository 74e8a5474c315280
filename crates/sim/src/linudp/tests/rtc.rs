//! The real-time-config channel: counts, busy answers, parameters, lists, the error log, starts and stops.

use super::*;

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
fn every_command_of_the_manual_is_known_and_no_other_is() {
    use Refusal as R;
    type Answer = Result<[u16; 3], Refusal>;
    let [p, ly] = [b"pp", b"ly"].map(|two| u16::from_le_bytes(*two));
    let answers: [(Answer, &[C]); 15] = [
        (Ok([0; 3]), &[C::NO_OPERATION, C::START_LIST, C::START_MODIFIED_LIST, C::RESTART, C::STOP_SOFTWARE]),
        (Ok([0; 3]), &[C::START_SOFTWARE, C::DELETE_CURVES, C::DELETE_TABLE, C::ERROR_COUNTERS]),
        (Ok([1, 0, 0]), &[C::DELETE_ENTRY]),
        // "logic supply voltage low", characters 8 ... 11.
        (Ok([1, p, ly]), &[C::ERROR_TEXT]),
        (Err(R::NoSuchUpid), &[C::READ_ROM, C::READ_RAM, C::READ_MINIMUM, C::READ_MAXIMUM, C::READ_DEFAULT]),
        (Err(R::NoSuchUpid), &[C::WRITE_ROM, C::WRITE_RAM, C::WRITE_BOTH]),
        (Err(R::ListNotStarted), &[C::NEXT_ITEM, C::NEXT_MODIFIED_ITEM]),
        (Err(R::SoftwareRuns), &[C::DEFAULT_OS, C::DEFAULT_MC, C::DEFAULT_INTERFACE, C::DEFAULT_APPLICATION]),
        (Err(R::SoftwareRuns), &[C::SAVE_CURVES, C::SAVE_TABLE]),
        (Err(R::CurveDefinition), &[C::GET_CURVE]),
        (Err(R::OutOfRange), &[C::ERROR_CODE, C::ERROR_TIME_LOW, C::ERROR_TIME_HIGH]),
        // Two bytes of information; no block without its start.
        (Err(R::WrongSize), &[C::ADD_CURVE, C::MODIFY_CURVE, C::WRITE_ENTRY, C::GET_ENTRY]),
        (Err(R::WrongSize), &[C::ADD_CURVE_INFO, C::ADD_CURVE_DATA, C::MODIFY_CURVE_INFO]),
        (Err(R::WrongSize), &[C::MODIFY_CURVE_DATA, C::GET_CURVE_INFO, C::GET_CURVE_DATA]),
        (Err(R::WrongSize), &[C::WRITE_ENTRY_DATA, C::GET_ENTRY_DATA]),
    ];
    for code in 0..=u8::MAX {
        let answer = answers.iter().find(|(_, commands)| commands.contains(&C(code)));
        let expected = match (answer, code) {
            (Some((Ok(words), _)), _) => (DONE, *words),
            (Some((Err(refusal), _)), _) => (refused(*refusal), [1, 0, 0]),
            // Nothing is used: all bits are 1.
            (None, 0x87..=0x8E) => (DONE, [u16::from(code - 0x87) * 4, 0xFFFF, 0xFFFF]),
            // What the manual does not list.
            (None, _) => (refused(Refusal::NoSuchUpid), [1, 0, 0]),
        };
        assert_eq!(Bench::new(|_| {}).rtc(C(code), [1, 2, 0]), expected, "{}", C(code));
        assert_eq!(answer.is_some() || matches!(code, 0x87..=0x8E), C::ALL.contains(&C(code)), "{}", C(code));
    }
}

#[test]
fn parameters_are_read_and_written_in_ram_and_rom() {
    let mut bench = Bench::new(|_| {});
    let velocity = 0x14BE;
    let bounds = [C::READ_DEFAULT, C::READ_MINIMUM, C::READ_MAXIMUM];
    assert_eq!(bounds.map(|bound| bench.value(bound, velocity)), [1_000_000, 1, 1 << 30]);
    assert_eq!(bench.write(C::WRITE_RAM, velocity, 70_000), DONE);
    assert_eq!((bench.value(C::READ_RAM, velocity), bench.value(C::READ_ROM, velocity)), (70_000, 1_000_000));
    assert_eq!(bench.write(C::WRITE_ROM, velocity, 80_000), DONE);
    assert_eq!((bench.value(C::READ_RAM, velocity), bench.value(C::READ_ROM, velocity)), (70_000, 80_000));
    assert_eq!(bench.write(C::WRITE_BOTH, velocity, 90_000), DONE);
    assert_eq!((bench.value(C::READ_RAM, velocity), bench.value(C::READ_ROM, velocity)), (90_000, 90_000));
    bench.write(C::WRITE_RAM, velocity, 70_000);
    bench.restart();
    assert_eq!(bench.value(C::READ_RAM, velocity), 90_000);
    use Refusal::{AddressUsage, NoSuchUpid, OutOfRange, WrongType};
    // Existence, usage, type and range are looked at in this order.
    for (upid, value, ram, rom) in [
        (0x9999, 0, Some(NoSuchUpid), Some(NoSuchUpid)),
        (0x1D51, 0x1_0000, Some(AddressUsage), Some(AddressUsage)),
        (0x000C, 0, Some(AddressUsage), Some(AddressUsage)),
        (0x1E72, 1, None, Some(AddressUsage)),
        (0x13A2, 0x1_0000, Some(WrongType), Some(WrongType)),
        (0x1450, 0, Some(OutOfRange), Some(OutOfRange)),
        (velocity, 0, Some(OutOfRange), Some(OutOfRange)),
        (0x20A8, 0x1E11, Some(OutOfRange), Some(OutOfRange)),
        (0x20A8, 0x1E10, None, None),
        (0x20A8, 0, None, None),
    ] {
        for (command, refusal) in [(C::WRITE_RAM, ram), (C::WRITE_ROM, rom), (C::WRITE_BOTH, ram.or(rom))] {
            let expected = refusal.map_or(DONE, refused);
            assert_eq!(bench.write(command, upid, value), expected, "{command} {upid:04X}h = {value:X}h");
        }
    }
    for command in [C::READ_ROM, C::READ_DEFAULT] {
        assert_eq!(bench.rtc(command, [0x1D51, 0, 0]).0, refused(AddressUsage), "{command}");
    }
    assert_eq!(bench.value(C::READ_MAXIMUM, 0x1D51), 0xFFFF);
    assert_eq!(bench.value(C::READ_MINIMUM, 0x146E), i32::MIN as u32);
    // Nothing of that was written.
    assert_eq!((bench.value(C::READ_RAM, 0x13A2), bench.value(C::READ_ROM, velocity)), (150, 90_000));
}

#[test]
fn the_drive_works_with_its_parameters() {
    // The range, live, and the lag limits: 10 um are less than what the motor needs to follow; standing has a code of
    // its own.
    for (upid, value, code) in [
        (0x146F, CM as u32, ErrorCode::MAX_POSITION),
        (0x1473, 100, ErrorCode::POSITION_LAG),
        (0x1475, 10, ErrorCode(0x000C)),
    ] {
        let mut bench = Bench::homed();
        bench.write(C::WRITE_RAM, upid, value);
        assert_eq!(bench.fails(go_to(2 * CM, VAD)), code, "{upid:04X}h");
    }
    // The profile, which is a live parameter, too.
    for live in [false, true] {
        let mut bench = Bench::homed();
        for (upid, value) in [(0x14BE, 100_000), (0x14BF, 2_000_000), (0x14C0, 1_000_000), (0x9999, 1)] {
            if live {
                bench.command(MotionCommand::live_parameter(Upid(upid), Raw(value)));
            } else {
                bench.write(C::WRITE_RAM, upid, value);
            }
        }
        bench.command(MotionCommand::vai_predefined_go_to(Position(CM)));
        // 10 mm with 0.1 m/s: 100 ms, + 0.1 / 20 / 2 + 0.1 / 10 / 2 s of ramps.
        let took = bench.until_stopped();
        assert!((107..=109).contains(&took), "{took} ms");
        assert_eq!(bench.value(C::READ_RAM, 0x1E0B), 100_000);
        assert_eq!(bench.value(C::READ_RAM, 0x1E0A), CM as u32);
    }
    // The streaming period.
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x14E6, 1_000);
    assert_eq!(bench.fails(MotionCommand::stream_p_configured(Position(0))), ErrorCode::STREAM_TOO_FAST);
    // Run modes without their inputs take no motion commands.
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x1450, 4);
    bench.command(MotionCommand::no_operation());
    assert_eq!(bench.exchange(None).error, Some(ErrorCode::NONE));
    assert_eq!(bench.fails(MotionCommand::vai_stop(Acceleration(1))), ErrorCode::WRONG_STATE);
}

#[test]
fn the_lists_go_through_all_upids_and_through_the_modified_ones() {
    let mut bench = Bench::new(|plan| (plan.home_position, plan.stream_period_ns) = (3, 2_500_999));
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
    // What was commissioned is in it, too.
    bench.rtc(C::START_MODIFIED_LIST, [0; 3]);
    let home = [(0x13C7, 3), (0x13CA, 3)];
    let rest = [(0x146E, -20 * CM), (0x146F, 20 * CM), (0x14C0, 0x12_3456), (0x14E6, 2_500)];
    for (upid, value) in home.into_iter().chain(rest) {
        let words = [upid, value as u16, (value >> 16) as u16];
        assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]), (DONE, words));
    }
    for _ in 0..2 {
        assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, refused(Refusal::EndOfList));
    }
    assert_eq!(bench.rtc(C::NEXT_ITEM, [0; 3]).0, refused(Refusal::ListNotStarted));
    bench.restart();
    assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, refused(Refusal::ListNotStarted));
    let mut delivered = Bench::new(|plan| *plan = LinMotSettings::new(plan.address));
    delivered.rtc(C::START_MODIFIED_LIST, [0; 3]);
    assert_eq!(delivered.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, refused(Refusal::EndOfList));
}

#[test]
fn the_monitoring_channels_show_what_their_parameters_name() {
    for extend_sign in [false, true] {
        let mut bench = Bench::homed_with(|plan| plan.extend_sign = extend_sign);
        bench.write(C::WRITE_RAM, 0x1E72, -5_i32 as u32);
        bench.command(go_to(-10 * CM, VAD));
        bench.now = bench.now + 20 * MS;
        // As delivered: velocity, acceleration, temperature, status.
        let response = bench.look();
        let status = u32::from(response.status.unwrap().0);
        assert_eq!(response.monitor, Some([-200_000_i32 as u32, -1_000_000_i32 as u32, 400, status]));
        for (channel, upid) in [0x1E72, 0x1E0E, 0, 0x1B93].into_iter().enumerate() {
            assert_eq!(bench.write(C::WRITE_RAM, 0x20A8 + channel as u16, upid), DONE);
        }
        let response = bench.look();
        // 16 bits with a sign: how they fill 32 is not documented.
        let current = response.current.unwrap();
        assert!(current < 0);
        let current = if extend_sign { i32::from(current) as u32 } else { u32::from(current as u16) };
        assert_eq!(response.monitor, Some([-5_i32 as u32, response.demand.unwrap() as u32, 0, current]));
        assert_eq!(bench.value(C::READ_RAM, 0x1B93), current);
        // In flash it outlives a restart; in RAM it does not.
        bench.write(C::WRITE_BOTH, 0x20A8, 0x1CAF);
        bench.restart();
        bench.now = bench.now + 7 * MS;
        let response = bench.look();
        let status = u32::from(response.status.unwrap().0);
        assert_eq!(response.monitor, Some([(BOOT_NS + 7 * MS) as u32 / 1_000, 0, 400, status]));
    }
}

#[test]
fn the_error_log_outlives_a_restart() {
    let mut bench = Bench::homed();
    let born = Time(5 * S) + MS;
    for code in [0x0003, 0x0005] {
        bench.now = bench.now + 5_400 * S;
        bench.exchange(None);
        bench.sim.provoke(ErrorCode(code));
        bench.until_error();
        bench.acknowledge();
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
    // Four of 32 characters at a time.
    for (code, text) in
        [(0x0003, b"motor supply voltage low\0\0\0\0\0\0\0\0"), (0x0005, b"regeneration resistor not connec")]
    {
        for (part, four) in (0..).zip(text.as_chunks::<4>().0) {
            let [a, b, c, d] = *four;
            let words = [code, u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d])];
            assert_eq!(bench.rtc(C::ERROR_TEXT, [code, part, 0]), (DONE, words));
        }
    }
    for (code, part) in [(0x0003, 8), (0x0003, u16::MAX), (0x00FF, 0)] {
        assert_eq!(bench.rtc(C::ERROR_TEXT, [code, part, 0]).0, refused(Refusal::OutOfRange));
    }
}

#[test]
fn stopped_software_shows_zeros_takes_nothing_and_forgets_home() {
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
fn a_restart_is_answered_and_then_the_drive_is_silent_until_it_is_back() {
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
