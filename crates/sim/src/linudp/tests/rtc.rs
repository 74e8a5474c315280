//! The real-time-config channel: counts, busy answers, parameters, lists, the error log, starts and stops.

use super::*;

#[test]
fn a_command_that_takes_its_time_is_busy_and_no_other_is_taken() {
    let mut bench = Bench::new(|plan| plan.config_time_ns = 3 * MS);
    bench.configure(0, C::NO_OPERATION, [0; 3]);
    let (first, second) = ([0x20A8, 0x1E0F, 0], [0x20A9, 0x1E10, 0]);
    for (after_ns, count, upid, answer) in [
        (0, 1, 0x20A8, block(1, channel::RUNNING, [0; 3])),
        (0, 1, 0x20A8, block(1, channel::BUSY, [0; 3])),
        // Another command now: not taken, its count is not echoed.
        (2 * MS, 2, 0x20A9, block(1, channel::RUNNING, [0; 3])),
        (MS, 1, 0x20A8, block(1, DONE, first)),
        // Now it is taken; meanwhile the words are those of the answer before.
        (0, 2, 0x20A9, block(2, channel::RUNNING, first)),
        (3 * MS, 2, 0x20A9, block(2, DONE, second)),
        (0, 3, 0x20A8, block(3, channel::RUNNING, second)),
    ] {
        bench.wait(after_ns);
        assert_eq!(bench.configure(count, C::READ_RAM, [upid, 0, 0]), Some(answer));
    }
    // A restart forgets it.
    bench.sim.restart(bench.now);
    assert_eq!(bench.configure(0, C::READ_RAM, [0x20A8, 0, 0]), Some(ConfigBlock::default()));
}

/// The answer of a fresh drive, whose software runs, to each command of the manual for index 1 and value 2.
#[test]
fn every_command_of_the_manual_is_known_and_no_other_is() {
    use Refusal as R;
    for code in 0..=u8::MAX {
        let refusal = match code {
            0x00 | 0x20 | 0x22 | 0x30 | 0x35 | 0x36 | 0x41 | 0x70 | 0x74 | 0x81 | 0x82 | 0x87..=0x8E => None,
            0x21 | 0x23 => Some(R::ListNotStarted),
            0x31..=0x34 | 0x40 | 0x80 => Some(R::SoftwareRuns),
            0x60 => Some(R::CurveDefinition),
            0x71..=0x73 => Some(R::OutOfRange),
            // Two bytes of information; no block without its start.
            0x50..=0x55 | 0x61 | 0x62 | 0x83..=0x86 => Some(R::WrongSize),
            // No such parameter, and no such command.
            _ => Some(R::NoSuchUpid),
        };
        let words = match code {
            _ if refusal.is_some() => [1, 0, 0],
            C::DELETE_ENTRY => [1, 0, 0],
            // "logic supply voltage low", characters 8 ... 11.
            C::ERROR_TEXT => [1, u16::from_le_bytes(*b"pp"), u16::from_le_bytes(*b"ly")],
            // No entry is used: all bits are 1.
            C::PRESENCE..=C::LAST_PRESENCE => [u16::from(code - C::PRESENCE) * 4, 0xFFFF, 0xFFFF],
            _ => [0; 3],
        };
        let status = refusal.map_or(DONE, |refusal| refusal as u8);
        assert_eq!(Bench::new(|_| {}).rtc(code, [1, 2, 0]), (status, words), "{code:02X}h");
    }
}

#[test]
fn parameters_are_read_and_written_in_ram_and_rom() {
    use Refusal::{AddressUsage, NoSuchUpid, OutOfRange, WrongType};
    let mut bench = Bench::new(|_| {});
    let velocity = 0x14BE;
    let bounds = [C::READ_DEFAULT, C::READ_MINIMUM, C::READ_MAXIMUM];
    assert_eq!(bounds.map(|bound| bench.value(bound, velocity)), [1_000_000, 1, 1 << 30]);
    for (write, value, ram, rom) in [
        (C::WRITE_RAM, 70_000, 70_000, 1_000_000),
        (C::WRITE_ROM, 80_000, 70_000, 80_000),
        (C::WRITE_BOTH, 90_000, 90_000, 90_000),
        (C::WRITE_RAM, 70_000, 70_000, 90_000),
    ] {
        assert_eq!(bench.write(write, velocity, value), DONE);
        assert_eq!([C::READ_RAM, C::READ_ROM].map(|read| bench.value(read, velocity)), [ram, rom]);
    }
    bench.restart();
    assert_eq!(bench.value(C::READ_RAM, velocity), 90_000);
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
        for (code, refusal) in [(C::WRITE_RAM, ram), (C::WRITE_ROM, rom), (C::WRITE_BOTH, ram.or(rom))] {
            let status = refusal.map_or(DONE, |refusal| refusal as u8);
            assert_eq!(bench.write(code, upid, value), status, "{code:02X}h {upid:04X}h = {value:X}h");
        }
    }
    for code in [C::READ_ROM, C::READ_DEFAULT] {
        assert_eq!(bench.rtc(code, [0x1D51, 0, 0]).0, AddressUsage as u8);
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
        (0x146F, CM as u32, errors::MAX_POSITION),
        (0x1473, 100, errors::POSITION_LAG),
        (0x1475, 10, errors::POSITION_LAG_STANDING),
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
                bench.command(motion(0x002, &[upid.into(), value.into()]));
            } else {
                bench.write(C::WRITE_RAM, upid, value);
            }
        }
        bench.command(motion(0x020, &[CM.into()]));
        // 10 mm with 0.1 m/s: 100 ms, + 0.1 / 20 / 2 + 0.1 / 10 / 2 s of ramps.
        let took = bench.until_stopped();
        assert!((107..=109).contains(&took), "{took} ms");
        assert_eq!(bench.value(C::READ_RAM, 0x1E0B), 100_000);
        assert_eq!(bench.value(C::READ_RAM, 0x1E0A), CM as u32);
    }
    // The streaming period.
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x14E6, 1_000);
    assert_eq!(bench.fails(motion(0x032, &[0])), errors::STREAM_TOO_FAST);
    // Run modes without their inputs take no motion commands.
    let mut bench = Bench::homed();
    bench.write(C::WRITE_RAM, 0x1450, 4);
    assert_eq!(bench.command(motion(0x000, &[])).error, errors::NONE);
    assert_eq!(bench.fails(motion(0x017, &[1])), errors::WRONG_STATE);
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
    assert_eq!(end, Refusal::EndOfList as u8);
    assert_eq!(bench.rtc(C::NEXT_ITEM, [0; 3]).0, Refusal::EndOfList as u8);
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
    assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, Refusal::ListNotStarted as u8);
    bench.rtc(C::START_LIST, [0xFFFF, 0, 0]);
    assert_eq!(bench.rtc(C::NEXT_ITEM, [0; 3]).0, Refusal::EndOfList as u8);
    // Modified is what ROM holds, not RAM.
    bench.write(C::WRITE_RAM, 0x14BE, 5);
    bench.write(C::WRITE_ROM, 0x14C0, 0x12_3456);
    bench.rtc(C::START_MODIFIED_LIST, [0x14BE, 0, 0]);
    assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]), (DONE, [0x14C0, 0x3456, 0x12]));
    // Commissioned values are in it, too.
    bench.rtc(C::START_MODIFIED_LIST, [0; 3]);
    let home = [(0x13C7, 3), (0x13CA, 3)];
    let rest = [(0x146E, -20 * CM), (0x146F, 20 * CM), (0x14C0, 0x12_3456), (0x14E6, 2_500)];
    for (upid, value) in home.into_iter().chain(rest) {
        let words = [upid, value as u16, (value >> 16) as u16];
        assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]), (DONE, words));
    }
    for _ in 0..2 {
        assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, Refusal::EndOfList as u8);
    }
    assert_eq!(bench.rtc(C::NEXT_ITEM, [0; 3]).0, Refusal::ListNotStarted as u8);
    bench.restart();
    assert_eq!(bench.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, Refusal::ListNotStarted as u8);
    let mut delivered = Bench::new(|plan| *plan = LinMotSettings::new(plan.address));
    delivered.rtc(C::START_MODIFIED_LIST, [0; 3]);
    assert_eq!(delivered.rtc(C::NEXT_MODIFIED_ITEM, [0; 3]).0, Refusal::EndOfList as u8);
}

#[test]
fn the_monitoring_channels_show_what_their_parameters_name() {
    for extend_sign in [false, true] {
        let mut bench = Bench::homed_with(|plan| plan.extend_sign = extend_sign);
        bench.write(C::WRITE_RAM, 0x1E72, -5_i32 as u32);
        bench.command(go_to(-10 * CM, VAD));
        bench.wait(20 * MS);
        // As delivered: velocity, acceleration, temperature, status.
        let report = bench.look();
        let status = u32::from(report.status);
        assert_eq!(report.monitor, [-200_000_i32 as u32, -1_000_000_i32 as u32, 400, status]);
        for (channel, upid) in [0x1E72, 0x1E0E, 0, 0x1B93].into_iter().enumerate() {
            assert_eq!(bench.write(C::WRITE_RAM, 0x20A8 + channel as u16, upid), DONE);
        }
        let report = bench.look();
        // 16 bits with a sign: how they fill 32 is not documented.
        let current = report.current;
        assert!(current < 0);
        let current = if extend_sign { i32::from(current) as u32 } else { u32::from(current as u16) };
        assert_eq!(report.monitor, [-5_i32 as u32, report.demand as u32, 0, current]);
        assert_eq!(bench.value(C::READ_RAM, 0x1B93), current);
        // In flash it outlives a restart; in RAM it does not.
        bench.write(C::WRITE_BOTH, 0x20A8, 0x1CAF);
        bench.restart();
        bench.wait(7 * MS);
        let report = bench.look();
        let status = u32::from(report.status);
        assert_eq!(report.monitor, [(BOOT_NS + 7 * MS) as u32 / 1_000, 0, 400, status]);
    }
}

#[test]
fn the_error_log_outlives_a_restart() {
    let mut bench = Bench::homed();
    for code in [0x0003, 0x0005] {
        bench.wait(5_400 * S);
        bench.exchange(None);
        bench.sim.provoke(code);
        bench.until_error();
        bench.acknowledge();
        bench.enable();
    }
    bench.restart();
    assert_eq!(bench.rtc(C::ERROR_COUNTERS, [0; 3]), (DONE, [0, 2, 2]));
    // The newest first. Three hours, and what enabling and homing took.
    for (entry, code, hours, ms) in [(0, 5, 3, 0), (1, 3, 1, 1_800_000)] {
        assert_eq!(
            (bench.value(C::ERROR_CODE, entry), bench.value(C::ERROR_TIME_HIGH, entry)),
            (code, hours)
        );
        let above = bench.value(C::ERROR_TIME_LOW, entry);
        assert!((ms + 1..ms + 5_000).contains(&above), "{above}");
    }
    let ms = bench.value(C::READ_RAM, 0x0082);
    assert!((bench.value(C::ERROR_TIME_LOW, 0)..10_000).contains(&ms), "{ms}");
    for entry in [2, 20, 21, u16::MAX] {
        assert_eq!(bench.rtc(C::ERROR_CODE, [entry, 0, 0]).0, Refusal::OutOfRange as u8);
    }
    // Four of 32 characters at a time.
    for (code, text) in
        [(0x0003, b"motor supply voltage low\0\0\0\0\0\0\0\0"), (0x0005, b"regeneration resistor not connec")]
    {
        for (part, [a, b, c, d]) in (0..).zip(text.as_chunks::<4>().0) {
            let words = [code, u16::from_le_bytes([*a, *b]), u16::from_le_bytes([*c, *d])];
            assert_eq!(bench.rtc(C::ERROR_TEXT, [code, part, 0]), (DONE, words));
        }
    }
    for (code, part) in [(0x0003, 8), (0x0003, u16::MAX), (0x00FF, 0)] {
        assert_eq!(bench.rtc(C::ERROR_TEXT, [code, part, 0]).0, Refusal::OutOfRange as u8);
    }
}

#[test]
fn stopped_software_shows_zeros_takes_nothing_and_forgets_home() {
    let mut bench = Bench::homed();
    bench.command_for(go_to(CM, VAD), 50 * MS);
    assert_eq!(bench.rtc(C::STOP_SOFTWARE, [0; 3]).0, DONE);
    for _ in 0..5 {
        let report = bench.command(go_to(5 * CM, VAD));
        assert_eq!((report.status, report.state, report.error), (0, 0, errors::NONE));
    }
    assert_eq!(bench.value(C::READ_RAM, 0x1D51), 0);
    assert_eq!(bench.rtc(C::STOP_SOFTWARE, [0; 3]).0, DONE);
    // The motor has no power: it runs out and stays.
    bench.wait(S);
    let stood = bench.exchange(None).actual;
    assert!(stood > 0 && stood < 5 * CM);
    assert_eq!(bench.rtc(C::START_SOFTWARE, [0; 3]).0, DONE);
    // Bit 0 is still set from the master's side: locked until it was low.
    let report = bench.exchange(None);
    assert_eq!(report.main(), state::NOT_READY);
    assert!(report.has(status::SWITCH_ON_LOCKED) && !report.has(status::HOMED));
    bench.enable();
    assert_eq!((bench.count, bench.exchange(None).actual), (0, stood));
    // Again changes nothing.
    assert_eq!(bench.rtc(C::START_SOFTWARE, [0; 3]).0, DONE);
    assert!(bench.exchange(None).has(status::OPERATION_ENABLED));
}

#[test]
fn a_restart_is_answered_and_then_the_drive_is_silent_until_it_is_back() {
    let restarts = Some(block(9, DONE, [0; 3]));
    let mut slow = Bench::new(|plan| plan.config_time_ns = MS);
    assert_eq!(slow.configure(9, C::RESTART, [0; 3]), restarts);
    let mut bench = Bench::homed();
    bench.rtc(C::WRITE_RAM, [0x1E72, 5, 0]);
    // The stored count is 0 then: a master that goes on sending it restarts the drive again.
    for _ in 0..2 {
        let deaf = bench.sim.ignored().deaf;
        assert_eq!(bench.configure(9, C::RESTART, [0; 3]), restarts);
        for _ in 0..99 {
            bench.wait(MS);
            assert_eq!(bench.configure(9, C::RESTART, [0; 3]), None);
        }
        assert_eq!(bench.sim.ignored().deaf, deaf + 99);
        bench.wait(MS);
    }
    assert_eq!(bench.configure(0, C::NO_OPERATION, [0; 3]), Some(ConfigBlock::default()));
    bench.config_count = 0;
    assert_eq!(bench.value(C::READ_RAM, 0x1E72), 0);
    assert!(!bench.exchange(None).has(status::HOMED));
}

#[test]
fn defaults_need_stopped_software_and_a_restart() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(bench.value(C::READ_RAM, 0x14E6), 2_000);
    assert_eq!(bench.rtc(C::DEFAULT_MC, [0; 3]).0, Refusal::SoftwareRuns as u8);
    bench.rtc(C::STOP_SOFTWARE, [0; 3]);
    assert_eq!(bench.write(C::DEFAULT_MC, 0, 0), DONE);
    assert_eq!((bench.value(C::READ_ROM, 0x14E6), bench.value(C::READ_RAM, 0x14E6)), (1_000, 2_000));
    bench.write(C::WRITE_ROM, 0x20A8, 0);
    bench.restart();
    assert_eq!((bench.value(C::READ_RAM, 0x14E6), bench.value(C::READ_RAM, 0x20A8)), (1_000, 0));
    bench.rtc(C::STOP_SOFTWARE, [0; 3]);
    for code in [C::DEFAULT_OS, C::DEFAULT_APPLICATION] {
        assert_eq!(bench.write(code, 0, 0), DONE);
        assert_eq!(bench.value(C::READ_ROM, 0x20A8), 0);
    }
    assert_eq!(bench.write(C::DEFAULT_INTERFACE, 0, 0), DONE);
    assert_eq!(bench.value(C::READ_ROM, 0x20A8), 0x1E0F);
}

#[test]
fn a_write_into_rom_stalls_the_interface_shortly() {
    for (flash, answered) in [(FlashMode::Silent, 1), (FlashMode::Busy, 4)] {
        let mut bench = Bench::new(|plan| (plan.flash, plan.flash_time_ns) = (flash, S));
        let write =
            |bench: &mut Bench| bench.configure(1, C::WRITE_ROM, [0x14BE, 7, 0]).map(|answer| answer.code);
        assert_eq!(write(&mut bench), Some(channel::RUNNING));
        let mut answers = Vec::new();
        for _ in 0..4 {
            bench.wait(500 * US);
            answers.extend(write(&mut bench));
        }
        assert_eq!((answers.last(), answers.len()), (Some(&DONE), answered));
        assert_eq!(bench.sim.ignored().deaf, 4 - answered as u64);
        assert_eq!(bench.value(C::READ_ROM, 0x14BE), 7);
        // Cut off by a restart the old value stays.
        bench.config_count = 3;
        bench.rtc(C::WRITE_ROM, [0x14BE, 9, 0]);
        bench.restart();
        assert_eq!(bench.value(C::READ_ROM, 0x14BE), 7);
    }
}
