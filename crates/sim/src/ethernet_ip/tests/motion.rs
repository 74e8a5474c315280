//! Commands and what the motor does: edges, moves, jogs, stops, homing, alarms, the drive's own watchdog.

use super::*;

const ENABLE: u32 = 0x2;
const DISABLE: u32 = 0x4;
const RELATIVE: u32 = 0x8;
const ABSOLUTE: u32 = 0x10;
const SENSOR: u32 = 0x20;
const SEEK: u32 = 0x800;
const FIND: u32 = 0x1000;
const STOP: u32 = 0x4000;
const STOP_GENTLY: u32 = 0x8000;
const JOG: u32 = 0x1_0000;
const JOG_SPEED: u32 = 0x2_0000;
const HOST: u32 = 0x4_0000;
const SEGMENT: u32 = 0x8_0000;
const RESET: u32 = 0x10_0000;
const CURRENT: u32 = 0x20_0000;

const MOVING: u16 = 0x10;
const JOGGING: u16 = 0x20;
const STOPPING: u16 = 0x40;
const HOMING: u16 = 0x400;

/// 5 rev/s, 100 rev/s² and the distance: 0.25 s of way, half a turn, at each end.
fn by(steps: i32) -> [(usize, i32); 4] {
    [(4, 1_200), (5, 600), (6, 600), (7, steps)]
}

/// 1 rev/s.
const SLOWLY: [(usize, i32); 3] = [(1, 240), (2, 600), (3, 600)];

/// A host command with its registers.
fn host(letters: &str, first: i32, second: i32) -> [(usize, i32); 3] {
    let letters = u16::from_be_bytes(letters.as_bytes().try_into().unwrap());
    [(9, letters.into()), (10, first), (11, second)]
}

/// Until the motor is idle.
fn rest(bench: &mut Bench) {
    for _ in 0..1_000 {
        bench.idle_for(10 * MS);
        if bench.status() & (MOVING | JOGGING | STOPPING) == 0 {
            return;
        }
    }
    panic!("it never rests: {:04X} at {}", bench.status(), bench.position());
}

/// A command, carried out to its end.
fn go(bench: &mut Bench, word: u32, elements: &[(usize, i32)]) {
    bench.command(word, elements);
    rest(bench);
}

/// The status so many ms after a command.
fn after(bench: &mut Bench, word: u32, elements: &[(usize, i32)], ms: u64) -> u16 {
    bench.command(word, elements);
    bench.idle_for(ms * MS);
    bench.status()
}

#[test]
fn moves_go_as_far_as_they_are_told() {
    let mut bench = Bench::enabled(|_| {});
    bench.command(RELATIVE, &by(100_000));
    let begin = bench.now;
    bench.idle_for(500 * MS);
    assert_eq!(bench.status(), 1 | MOVING);
    assert!((bench.velocity() / 100_000.0 - 1.0).abs() < 1e-6);
    rest(&mut bench);
    assert_eq!(bench.position(), 100_000);
    // 5 turns at 5 rev/s and 0.05 s for the ramps.
    assert!((1_050 * MS..=1_080 * MS).contains(&bench.now.since(begin)), "{}", bench.now.since(begin));
    go(&mut bench, RELATIVE, &by(-100_001));
    go(&mut bench, ABSOLUTE, &by(777));
    assert_eq!(bench.position(), 777);
    let truth = bench.sim.truth(bench.now);
    assert!(truth.powered && !truth.homed && (truth.position - 777.0).abs() < 1.0, "{truth:?}");
    assert_eq!(bench.sim.refused(), Refused::default());
    // Parameters out of their range stay as they were.
    go(&mut bench, RELATIVE, &[(4, 0), (5, 32_001), (6, -5), (7, 1_000)]);
    assert_eq!((bench.position(), bench.sim.refused().out_of_range), (1_777, 3));
    assert_eq!(bench.sim.drive.parameters.get(b"AC"), 600);
    bench.command(JOG, &[(1, i32::MIN), (2, 600), (3, 600)]);
    assert_eq!(bench.sim.refused().out_of_range, 4);
    // Position and power are lost with that of the drive.
    bench.sim.disconnected(bench.now, MASTER);
    bench.sim.restart(bench.now);
    let truth = bench.sim.truth(bench.now);
    assert!(!truth.powered && truth.position.abs() < 0.01, "{truth:?}");
}

#[test]
fn only_a_change_from_0_acts_but_for_a_stop_and_one_command_at_a_time() {
    let mut bench = Bench::enabled(|_| {});
    for _ in 0..5 {
        bench.packet(1, &outputs(RELATIVE, &by(1_000)));
        bench.pass(10 * MS);
    }
    bench.packet(1, &outputs(ABSOLUTE, &by(0)));
    bench.word(DISABLE);
    rest(&mut bench);
    assert_eq!((bench.position(), bench.status(), bench.sim.refused().no_edge), (1_000, 1, 2));
    go(&mut bench, RELATIVE, &by(1_000));
    assert_eq!(bench.position(), 2_000);
    // The first word after an open is a change.
    bench.word(ENABLE);
    bench.message(&Forward::default().close());
    bench.open(&Forward { serial: 2, ..Forward::default() });
    bench.word(DISABLE);
    assert_eq!(bench.status(), 0);
    let mut any = Bench::enabled(|settings| settings.firmware.edges = Edges::Any);
    any.packet(1, &outputs(RELATIVE, &by(1_000)));
    any.word(DISABLE);
    assert_eq!(any.status(), 0);
    // A stop, unless the drive is stricter.
    for (edges, stops) in [(Edges::Stops, true), (Edges::Strict, false)] {
        for stop in [STOP, STOP_GENTLY] {
            let mut bench = Bench::enabled(|settings| settings.firmware.edges = edges);
            bench.packet(1, &outputs(JOG, &SLOWLY));
            bench.pass(100 * MS);
            bench.word(stop);
            assert_eq!(bench.status() & STOPPING != 0, stops, "{edges:?} {stop:X}");
        }
    }
    // Several bits are one command only if a stop is among them.
    let mut bench = Bench::enabled(|_| {});
    go(&mut bench, RELATIVE | DISABLE, &by(1_000));
    assert_eq!((bench.position(), bench.status(), bench.sim.refused().several_bits), (0, 1, 1));
    bench.command(JOG, &SLOWLY);
    bench.command(STOP | RELATIVE, &by(1_000));
    assert_ne!(bench.status() & STOPPING, 0);
    assert_eq!(bench.sim.refused().several_bits, 1);
}

#[test]
fn a_move_while_disabled_is_an_alarm_and_a_fault_disables() {
    let mut bench = Bench::owned(|_| {});
    for command in [RELATIVE, JOG] {
        assert_eq!((after(&mut bench, command, &by(1_000), 0), bench.alarm()), (0x0200, 0x1000));
        assert_eq!((after(&mut bench, RESET, &[], 0), bench.alarm()), (0, 0));
    }
    assert_eq!((bench.vendor("00 01 00 66 00 00 00 00").0, bench.alarm()), (0, 0x1000));
    bench.command(ENABLE, &[]);
    go(&mut bench, RELATIVE, &by(1_000));
    assert_eq!((bench.position(), bench.status()), (1_000, 0x0201), "an alarm of this class hinders nothing");
    bench.command(RESET, &[]);
    after(&mut bench, JOG, &SLOWLY, 100);
    bench.sim.provoke(0x0080);
    assert_eq!(bench.status(), 0x0204);
    assert_eq!((after(&mut bench, ENABLE, &[], 0), bench.sim.refused().not_enabled), (0x0204, 1));
    assert_eq!(after(&mut bench, RESET, &[], 0), 0, "the motor stays off");
    assert_eq!(after(&mut bench, ENABLE, &[], 0), 1);
    assert_eq!(bench.vendor("00 02 87 00 00 00 00 00").1[4..6], [0, 0x80]);
    let mut stays = Bench::owned(|settings| settings.firmware.persistent_alarm = 0x0200);
    assert_eq!(after(&mut stays, RESET, &[], 0), 0x0204);
}

#[test]
fn a_jog_runs_changes_its_speed_and_stops() {
    let mut bench = Bench::enabled(|_| {});
    assert_eq!(after(&mut bench, JOG, &[(1, -240), (2, 600), (3, 60)], 200), 1 | JOGGING);
    assert!((bench.velocity() + 20_000.0).abs() < 10.0);
    // The acceleration of an update does not count.
    bench.command(JOG_SPEED, &[(1, 480), (2, 1)]);
    bench.idle_for(500 * MS);
    assert!((bench.velocity() - 40_000.0).abs() < 10.0);
    assert_eq!(after(&mut bench, STOP_GENTLY, &[], 0), 1 | JOGGING | STOPPING);
    // 2 rev/s with 10 rev/s².
    bench.idle_for(150 * MS);
    assert_ne!(bench.status() & STOPPING, 0);
    bench.idle_for(60 * MS);
    assert_eq!(bench.status(), 1);
    bench.command(JOG_SPEED, &SLOWLY);
    bench.idle_for(100 * MS);
    assert_eq!((bench.status(), bench.velocity().round()), (1, 0.0), "nothing jogs");
    let mut both = Bench::enabled(|settings| settings.firmware.moving_while_jogging = true);
    assert_eq!(after(&mut both, JOG, &SLOWLY, 100), 1 | JOGGING | MOVING);
}

#[test]
fn the_two_stops_stop_with_their_own_decelerations() {
    let stop = |command| {
        let mut bench = Bench::enabled(|_| {});
        bench.command(RELATIVE, &by(1_000_000));
        bench.command(RELATIVE, &by(1_000_000));
        bench.idle_for(500 * MS);
        let begin = (bench.now, bench.position());
        assert_eq!(after(&mut bench, command, &[], 0), 1 | MOVING | STOPPING);
        let mut ns = 0;
        while bench.status() & STOPPING != 0 {
            bench.pass(MS);
            ns = bench.now.since(begin.0);
        }
        let way = bench.position() - begin.1;
        bench.idle_for(S);
        assert_eq!(bench.status(), 1, "what waited is gone");
        (ns / MS, way)
    };
    // 5 rev/s with 3000 rev/s², and with 100 rev/s²: 83 and 2500 steps; a step of time is 50 of them.
    let (ms, way) = stop(STOP);
    assert!(ms <= 4 && (40..200).contains(&way), "{ms} {way}");
    let (ms, way) = stop(STOP_GENTLY);
    assert!((50..=53).contains(&ms) && (2_440..2_650).contains(&way), "{ms} {way}");
}

#[test]
fn a_move_behind_a_move_waits_in_the_buffer_which_is_bounded() {
    let mut bench = Bench::enabled(|settings| settings.firmware.buffer = 2);
    for distance in [10_000, -4_000, 1_000, 500_000] {
        bench.command(RELATIVE, &by(distance));
    }
    assert_eq!(bench.sim.refused().buffer_full, 1);
    assert_eq!(bench.vendor("00 02 84 94 00 00 00 00").1[4..6], [0, 0], "no room left");
    assert_eq!(bench.vendor("00 01 00 66 00 00 00 00").0, 0x02);
    rest(&mut bench);
    assert_eq!(bench.position(), 7_000);
    assert_eq!(bench.vendor("00 02 84 94 00 00 00 00").1[4..6], [0, 2]);
    // Parameters of type 1 wait for their turn.
    bench.command(RELATIVE, &by(20_000));
    bench.vendor("00 01 00 B6 FF FF EC 78");
    bench.vendor("00 01 00 66 00 00 00 00");
    assert_eq!(bench.sim.drive.parameters.get(b"DI"), 20_000);
    rest(&mut bench);
    assert_eq!((bench.position(), bench.sim.drive.parameters.get(b"DI")), (22_000, -5_000));
    // Stops of type 2 do not: ST ends the move and leaves the buffer, SK empties it.
    for (stop, waits) in [("00 02 A3 00 00 00 00 00", true), ("00 02 98 00 00 00 00 00", false)] {
        bench.command(RELATIVE, &by(200_000));
        bench.command(RELATIVE, &by(200_000));
        bench.idle_for(100 * MS);
        bench.vendor(stop);
        bench.idle_for(100 * MS);
        assert_eq!(bench.status() & MOVING != 0, waits, "{stop}");
    }
}

#[test]
fn host_commands_act_and_follow_each_other_without_a_0() {
    let mut bench = Bench::owned(|_| {});
    let send = |bench: &mut Bench, letters, first, second| {
        bench.packet(1, &outputs(HOST, &host(letters, first, second)));
    };
    send(&mut bench, "SP", 5_000, 0);
    assert_eq!(bench.position(), 5_000);
    for (letters, first, second) in [
        ("SP", 5_000, 0),
        ("SP", -5_000, 0),
        ("SO", 0x4CB1, 0),
        ("RL", 0x34, 99),
        ("HV", 0x32, 77),
        ("VC", 33, 0),
    ] {
        send(&mut bench, letters, first, second);
    }
    assert_eq!((bench.position(), bench.sim.drive.report().outputs), (-5_000, 1));
    assert_eq!(bench.sim.drive.report().main, 0x1FF);
    assert_eq!(bench.sim.drive.registers[4], 99);
    assert_eq!(bench.sim.drive.parameters.indexed(b"HV", 2), 77);
    assert_eq!(bench.sim.drive.parameters.get(b"VC"), 33);
    assert_eq!(bench.sim.refused(), Refused::default());
    send(&mut bench, "XX", 0, 0);
    send(&mut bench, "GC", 100, 0);
    assert_eq!((bench.sim.refused().unknown_command, bench.alarm()), (2, 0));
    bench.word(0);
    bench.command(CURRENT, &[(8, 100)]);
    assert_eq!(bench.sim.refused().unsupported, 1, "an STF has no current command");
    let mut servo = Bench::owned(|settings| settings.identity.kind = Kind::StepServo);
    servo.command(CURRENT, &[(8, 100)]);
    assert_eq!((servo.sim.refused(), servo.sim.drive.parameters.get(b"GC")), (Refused::default(), 100));
}

#[test]
fn a_segment_runs_for_a_while_and_keeps_type_1_out() {
    let mut bench = Bench::enabled(|_| {});
    assert_eq!(after(&mut bench, SEGMENT, &[(10, 1)], 0), 0x4001);
    assert_eq!(bench.vendor("00 01 00 66 00 00 00 00").0, 0x10);
    assert_eq!(bench.vendor("00 02 88 01 00 00 00 00").0, 0);
    bench.command(RELATIVE, &by(100));
    bench.idle_for(990 * MS);
    assert_eq!((bench.status(), bench.position()), (0x4001, 0));
    bench.idle_for(20 * MS);
    rest(&mut bench);
    assert_eq!((bench.status(), bench.position()), (1, 100));
    bench.command(SEGMENT, &[(10, 1)]);
    assert_eq!(after(&mut bench, STOP, &[], 0), 1);
    bench.command(SEGMENT, &[(10, 7)]);
    assert_eq!(bench.alarm(), 0x4000);
}

fn with_switch(settings: &mut MoonsSettings) {
    settings.motor.home =
        Some(HomeSwitch { at: Wired { input: 2, closed: true }, range: (-30_000, -28_000) });
}

/// A move with the code of an input.
fn with_code(steps: i32, code: i32) -> Vec<(usize, i32)> {
    by(steps).into_iter().chain([(10, code)]).collect()
}

#[test]
fn homing_finds_its_switch_and_comes_back_to_it() {
    for command in [SEEK, FIND] {
        let mut bench = Bench::enabled(with_switch);
        assert_eq!(after(&mut bench, command, &with_code(-1, 0x4CB2), 50), 1 | MOVING | HOMING);
        assert_eq!(bench.sim.drive.report().main, 0xFF);
        rest(&mut bench);
        assert!((-28_100..=-27_990).contains(&bench.position()), "{}", bench.position());
        assert_eq!(bench.sim.drive.report().main, 0xFD, "the switch is closed");
        assert!(bench.sim.truth(bench.now).homed);
        assert_eq!(bench.status(), 1);
        bench.sim.restart(bench.now);
        assert!(!bench.sim.truth(bench.now).homed);
    }
    let mut zero = Bench::enabled(|settings| {
        with_switch(settings);
        settings.firmware.homing_zeroes = true;
    });
    go(&mut zero, FIND, &by(-1));
    assert_eq!(zero.position(), 0);
}

#[test]
fn a_limit_stops_and_lets_the_motor_away_and_homing_turns_round_at_one() {
    let limited = |settings: &mut MoonsSettings| settings.motor.limits = Some((-40_000, 40_000));
    let mut bench = Bench::enabled(limited);
    go(&mut bench, RELATIVE, &by(1_000_000));
    assert_eq!(bench.alarm(), 0x0004);
    assert!((40_000..42_000).contains(&bench.position()));
    bench.command(RESET, &[]);
    let at = bench.position();
    bench.command(RELATIVE, &by(1_000));
    assert_eq!((bench.alarm(), bench.status() & MOVING), (0x0004, 0));
    go(&mut bench, RELATIVE, &by(-10_000));
    assert_eq!(bench.position(), at - 10_000);
    // Nothing is wired to input 3: homing ends at the second. Without a home switch there is nothing to find.
    let mut bench = Bench::enabled(limited);
    go(&mut bench, SEEK, &with_code(1, 0x4CB3));
    assert_eq!((bench.alarm(), bench.sim.truth(bench.now).homed), (0x0002, false));
    bench.command(FIND, &by(1));
    assert_eq!(bench.sim.refused().unsupported, 1);
    let mut bench = Bench::enabled(|settings| {
        with_switch(settings);
        limited(settings);
    });
    go(&mut bench, FIND, &by(1));
    assert_eq!((bench.alarm(), bench.sim.truth(bench.now).homed), (0, true));
}

#[test]
fn a_sensor_ends_a_move() {
    let mut bench = Bench::enabled(with_switch);
    go(&mut bench, SENSOR, &with_code(-1, 0x4CB2));
    // Down from 5 rev/s with 100 rev/s²: 2500 steps.
    assert!((-30_700..-30_400).contains(&bench.position()), "{}", bench.position());
    // No such condition.
    bench.command(SENSOR, &with_code(-1, 0x58B2));
    assert_eq!((bench.status(), bench.sim.refused().unsupported), (1, 1));
    // The safety distance.
    let begin = bench.position();
    go(&mut bench, 0x80, &with_code(20_000, 0x4CB5));
    assert!((20_000..23_000).contains(&(bench.position() - begin)));
}

#[test]
fn messages_feed_zs_and_heartbeats_only_if_set() {
    for (feeds, status) in [(true, 1 | JOGGING), (false, 1)] {
        let mut bench = Bench::new(|settings| settings.firmware.heartbeats_feed = feeds);
        bench.open(&Forward::input_only());
        let id = bench.id;
        bench.vendor("00 01 00 9F 00 00 00 00");
        bench.vendor("00 01 00 96 00 00 00 00");
        for _ in 0..10 {
            bench.pass(400 * MS);
            bench.vendor("00 02 88 00 00 00 00 00");
        }
        assert_eq!(bench.status(), 1 | JOGGING);
        for sequence in 1..20 {
            bench.pass(100 * MS);
            bench.at(PACKETS, MASTER_IO, &heartbeat(id, sequence));
        }
        assert_eq!(bench.status(), status, "{feeds}");
    }
}

#[test]
fn zs_and_za_count_from_the_next_power_up_on_and_only_if_saved() {
    for (save, end) in [(true, 0), (false, 1 | JOGGING)] {
        let mut bench = Bench::owned(|_| {});
        bench.packet(1, &outputs(HOST, &host("ZS", 200, 0)));
        bench.packet(1, &outputs(HOST, &host("ZA", 15, 0)));
        if save {
            bench.packet(1, &outputs(HOST, &host("SA", 0, 0)));
            assert_eq!(bench.status(), 0x0100, "saving");
        }
        bench.command(ENABLE, &[]);
        for status in [1 | JOGGING, end] {
            bench.command(ENABLE, &[]);
            bench.command(JOG, &SLOWLY);
            bench.pass(300 * MS);
            assert_eq!(bench.status() & !0x0100, status, "saved: {save}");
            bench.power_cycle();
            bench.open(&Forward::default());
        }
    }
}

#[test]
fn a_lost_owner_leaves_the_motor_to_zs_unless_set_otherwise() {
    for (stops, status) in [(false, 1 | JOGGING), (true, 1)] {
        let mut bench = Bench::enabled(|settings| settings.firmware.lost_owner_stops = stops);
        bench.command(JOG, &SLOWLY);
        bench.idle_for(100 * MS);
        bench.pass(200 * MS);
        assert_eq!((bench.sim.connections().1, bench.status()), (0, status));
        bench.pass(400 * MS);
        assert_eq!(bench.status(), 1);
    }
    let mut closed = Bench::enabled(|_| {});
    closed.command(JOG, &SLOWLY);
    closed.message(&Forward::default().close());
    for (ms, status) in [(400, 1 | JOGGING), (200, 1)] {
        closed.pass(ms * MS);
        assert_eq!(closed.status(), status);
    }
}

#[test]
fn the_hardware_enable_takes_the_power_and_does_not_give_it_back() {
    let mut bench = Bench::enabled(|settings| settings.motor.enable = Some(Wired { input: 4, closed: true }));
    assert_eq!(bench.sim.drive.report().main, 0xF7);
    assert_eq!(after(&mut bench, JOG, &SLOWLY, 100), 1 | JOGGING);
    bench.sim.open_sto(bench.now + 100 * MS);
    bench.idle_for(50 * MS);
    assert_eq!((bench.status(), bench.sim.drive.report().main), (0, 0xFF));
    assert_eq!(after(&mut bench, ENABLE, &[], 100), 0);
    assert_eq!((bench.sim.refused().not_enabled, bench.sim.drive.report().main), (1, 0xF7));
    assert_eq!(after(&mut bench, ENABLE, &[], 0), 1);
    // A drive may be found running.
    let mut bench = Bench::owned(|settings| settings.running = Some(-30_000.0));
    assert_eq!(bench.status(), 1 | JOGGING);
    assert!((bench.velocity() + 30_000.0).abs() < 10.0);
    assert_eq!(after(&mut bench, DISABLE, &[], 0), 0);
    bench.pass(5 * S);
    assert_eq!(bench.velocity(), 0.0, "it runs out");
    assert!(bench.position() < 0);
}
