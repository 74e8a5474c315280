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
    bench.command(RELATIVE, &by(-100_001));
    rest(&mut bench);
    bench.command(ABSOLUTE, &by(777));
    rest(&mut bench);
    assert_eq!(bench.position(), 777);
    let truth = bench.sim.truth(bench.now);
    assert!(truth.powered && !truth.homed && (truth.position - 777.0).abs() < 1.0, "{truth:?}");
    assert_eq!(bench.sim.refused(), Refused::default());
}

#[test]
fn only_a_change_from_0_acts() {
    let mut bench = Bench::enabled(|_| {});
    for _ in 0..5 {
        bench.packet(1, &outputs(RELATIVE, &by(1_000)));
        bench.pass(10 * MS);
    }
    bench.packet(1, &outputs(ABSOLUTE, &by(0)));
    bench.word(DISABLE);
    rest(&mut bench);
    assert_eq!((bench.position(), bench.status(), bench.sim.refused().no_edge), (1_000, 1, 2));
    bench.command(RELATIVE, &by(1_000));
    rest(&mut bench);
    assert_eq!(bench.position(), 2_000);
    let mut any = Bench::enabled(|settings| settings.firmware.edges = Edges::Any);
    any.packet(1, &outputs(RELATIVE, &by(1_000)));
    any.word(DISABLE);
    assert_eq!(any.status(), 0);
}

#[test]
fn the_first_word_after_an_open_is_a_change() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward::default());
    bench.word(ENABLE);
    assert_eq!(bench.status(), 1);
    bench.message(&Forward::default().close());
    bench.open(&Forward { serial: 2, ..Forward::default() });
    bench.word(DISABLE);
    assert_eq!(bench.status(), 0);
}

#[test]
fn a_stop_acts_without_a_0_between_unless_the_drive_is_stricter() {
    for (edges, stops) in [(Edges::Stops, true), (Edges::Strict, false)] {
        for stop in [STOP, STOP_GENTLY] {
            let mut bench = Bench::enabled(|settings| settings.firmware.edges = edges);
            bench.packet(1, &outputs(JOG, &SLOWLY));
            bench.pass(100 * MS);
            bench.word(stop);
            assert_eq!(bench.status() & STOPPING != 0, stops, "{edges:?} {stop:X}");
        }
    }
}

#[test]
fn one_command_at_a_time_unless_it_is_a_stop() {
    let mut bench = Bench::enabled(|_| {});
    bench.command(RELATIVE | DISABLE, &by(1_000));
    rest(&mut bench);
    assert_eq!((bench.position(), bench.status(), bench.sim.refused().several_bits), (0, 1, 1));
    bench.command(JOG, &SLOWLY);
    bench.command(STOP | RELATIVE, &by(1_000));
    assert_ne!(bench.status() & STOPPING, 0);
    assert_eq!(bench.sim.refused().several_bits, 1);
}

#[test]
fn a_move_while_disabled_is_an_alarm() {
    let mut bench = Bench::owned(|_| {});
    for command in [RELATIVE, JOG] {
        bench.command(command, &by(1_000));
        assert_eq!((bench.alarm(), bench.status()), (0x1000, 0x0200));
        bench.command(RESET, &[]);
        assert_eq!((bench.alarm(), bench.status()), (0, 0));
    }
    assert_eq!(bench.vendor("00 01 00 66 00 00 00 00").0, 0);
    assert_eq!(bench.alarm(), 0x1000);
    bench.command(ENABLE, &[]);
    bench.command(RELATIVE, &by(1_000));
    rest(&mut bench);
    assert_eq!((bench.position(), bench.status()), (1_000, 0x0201), "an alarm of this class hinders nothing");
}

#[test]
fn a_fault_disables_and_its_reset_leaves_the_motor_off() {
    let mut bench = Bench::enabled(|_| {});
    bench.command(JOG, &SLOWLY);
    bench.idle_for(100 * MS);
    bench.sim.provoke(0x0080);
    assert_eq!(bench.status(), 0x0204);
    bench.command(ENABLE, &[]);
    assert_eq!((bench.status(), bench.sim.refused().not_enabled), (0x0204, 1));
    bench.command(RESET, &[]);
    assert_eq!(bench.status(), 0);
    bench.command(ENABLE, &[]);
    assert_eq!(bench.status(), 1);
    assert_eq!(bench.vendor("00 02 87 00 00 00 00 00").1[4..6], [0, 0x80]);
    let mut stays = Bench::owned(|settings| settings.firmware.persistent_alarm = 0x0200);
    stays.command(RESET, &[]);
    assert_eq!(stays.status(), 0x0204);
}

#[test]
fn a_jog_runs_changes_its_speed_and_stops() {
    let mut bench = Bench::enabled(|_| {});
    bench.command(JOG, &[(1, -240), (2, 600), (3, 60)]);
    bench.idle_for(200 * MS);
    assert_eq!(bench.status(), 1 | JOGGING);
    assert!((bench.velocity() + 20_000.0).abs() < 10.0);
    // The acceleration of an update does not count.
    bench.command(JOG_SPEED, &[(1, 480), (2, 1)]);
    bench.idle_for(500 * MS);
    assert!((bench.velocity() - 40_000.0).abs() < 10.0);
    bench.command(STOP_GENTLY, &[]);
    assert_eq!(bench.status(), 1 | JOGGING | STOPPING);
    // 2 rev/s with 10 rev/s².
    bench.idle_for(150 * MS);
    assert_ne!(bench.status() & STOPPING, 0);
    bench.idle_for(60 * MS);
    assert_eq!(bench.status(), 1);
    bench.command(JOG_SPEED, &SLOWLY);
    bench.idle_for(100 * MS);
    assert_eq!((bench.status(), bench.velocity().round()), (1, 0.0), "nothing jogs");
    let mut both = Bench::enabled(|settings| settings.firmware.moving_while_jogging = true);
    both.command(JOG, &SLOWLY);
    both.idle_for(100 * MS);
    assert_eq!(both.status(), 1 | JOGGING | MOVING);
}

#[test]
fn the_two_stops_stop_with_their_own_decelerations() {
    let stop = |command| {
        let mut bench = Bench::enabled(|_| {});
        bench.command(RELATIVE, &by(1_000_000));
        bench.command(RELATIVE, &by(1_000_000));
        bench.idle_for(500 * MS);
        let begin = (bench.now, bench.position());
        bench.command(command, &[]);
        assert_eq!(bench.status(), 1 | MOVING | STOPPING);
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
}

#[test]
fn type_1_parameters_wait_for_their_turn_and_type_2_stops_do_not() {
    let mut bench = Bench::enabled(|_| {});
    bench.command(RELATIVE, &by(20_000));
    bench.vendor("00 01 00 B6 FF FF EC 78");
    bench.vendor("00 01 00 66 00 00 00 00");
    assert_eq!(bench.sim.drive.parameters.get(b"DI"), 20_000);
    rest(&mut bench);
    assert_eq!((bench.position(), bench.sim.drive.parameters.get(b"DI")), (15_000, -5_000));
    // ST ends the move and leaves the buffer, SK empties it.
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
fn parameters_out_of_their_range_stay_as_they_were() {
    let mut bench = Bench::enabled(|_| {});
    bench.command(RELATIVE, &by(1_000));
    rest(&mut bench);
    bench.command(RELATIVE, &[(4, 0), (5, 32_001), (6, -5), (7, 1_000)]);
    rest(&mut bench);
    assert_eq!((bench.position(), bench.sim.refused().out_of_range), (2_000, 3));
    assert_eq!(bench.sim.drive.parameters.get(b"AC"), 600);
    bench.command(JOG, &[(1, i32::MIN), (2, 600), (3, 600)]);
    assert_eq!(bench.sim.refused().out_of_range, 4);
}

#[test]
fn host_commands_act_and_follow_each_other_without_a_0() {
    let mut bench = Bench::owned(|_| {});
    bench.packet(1, &outputs(HOST, &host("SP", 5_000, 0)));
    assert_eq!(bench.position(), 5_000);
    bench.packet(1, &outputs(HOST, &host("SP", 5_000, 0)));
    bench.packet(1, &outputs(HOST, &host("SP", -5_000, 0)));
    bench.packet(1, &outputs(HOST, &host("SO", 0x4CB1, 0)));
    bench.packet(1, &outputs(HOST, &host("RL", 0x34, 99)));
    bench.packet(1, &outputs(HOST, &host("HV", 0x32, 77)));
    bench.packet(1, &outputs(HOST, &host("VC", 33, 0)));
    assert_eq!((bench.position(), bench.sim.drive.report().outputs), (-5_000, 1));
    assert_eq!(bench.sim.drive.report().main, 0x1FF);
    assert_eq!(bench.sim.drive.registers[4], 99);
    assert_eq!(bench.sim.drive.parameters.indexed(b"HV", 2), 77);
    assert_eq!(bench.sim.drive.parameters.get(b"VC"), 33);
    assert_eq!(bench.sim.refused(), Refused::default());
    bench.packet(1, &outputs(HOST, &host("XX", 0, 0)));
    bench.packet(1, &outputs(HOST, &host("GC", 100, 0)));
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
    bench.command(SEGMENT, &[(10, 1)]);
    assert_eq!(bench.status(), 0x4001);
    assert_eq!(bench.vendor("00 01 00 66 00 00 00 00").0, 0x10);
    assert_eq!(bench.vendor("00 02 88 01 00 00 00 00").0, 0);
    bench.command(RELATIVE, &by(100));
    bench.idle_for(990 * MS);
    assert_eq!((bench.status(), bench.position()), (0x4001, 0));
    bench.idle_for(20 * MS);
    rest(&mut bench);
    assert_eq!((bench.status(), bench.position()), (1, 100));
    bench.command(SEGMENT, &[(10, 1)]);
    bench.command(STOP, &[]);
    assert_eq!(bench.status(), 1);
    bench.command(SEGMENT, &[(10, 7)]);
    assert_eq!(bench.alarm(), 0x4000);
}

fn with_switch(settings: &mut MoonsSettings) {
    settings.motor.home =
        Some(HomeSwitch { at: Wired { input: 2, closed: true }, range: (-30_000, -28_000) });
}

#[test]
fn homing_finds_its_switch_and_comes_back_to_it() {
    for command in [SEEK, FIND] {
        let mut bench = Bench::enabled(with_switch);
        let low = [(10, 0x4CB2)];
        let elements: Vec<_> = by(-1).into_iter().chain(low).collect();
        bench.command(command, &elements);
        bench.idle_for(50 * MS);
        assert_eq!(bench.status(), 1 | MOVING | HOMING);
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
    zero.command(FIND, &by(-1));
    rest(&mut zero);
    assert_eq!(zero.position(), 0);
}

#[test]
fn homing_turns_round_at_one_limit_and_ends_at_the_second() {
    let limited = |settings: &mut MoonsSettings| settings.motor.limits = Some((-40_000, 40_000));
    let mut bench = Bench::enabled(|settings| {
        with_switch(settings);
        limited(settings);
    });
    bench.command(FIND, &by(1));
    rest(&mut bench);
    assert_eq!((bench.alarm(), bench.sim.truth(bench.now).homed), (0, true));
    // Nothing is wired to input 3.
    let mut bench = Bench::enabled(limited);
    let elements: Vec<_> = by(1).into_iter().chain([(10, 0x4CB3)]).collect();
    bench.command(SEEK, &elements);
    rest(&mut bench);
    assert_eq!((bench.alarm(), bench.sim.truth(bench.now).homed), (0x0002, false));
    // Without a home switch there is nothing to find.
    bench.command(FIND, &by(1));
    assert_eq!(bench.sim.refused().unsupported, 1);
}

#[test]
fn a_limit_stops_and_lets_the_motor_away_from_it() {
    let mut bench = Bench::enabled(|settings| settings.motor.limits = Some((-40_000, 40_000)));
    bench.command(RELATIVE, &by(1_000_000));
    rest(&mut bench);
    assert_eq!(bench.alarm(), 0x0004);
    assert!((40_000..42_000).contains(&bench.position()));
    bench.command(RESET, &[]);
    let at = bench.position();
    bench.command(RELATIVE, &by(1_000));
    assert_eq!((bench.alarm(), bench.status() & MOVING), (0x0004, 0));
    bench.command(RELATIVE, &by(-10_000));
    rest(&mut bench);
    assert_eq!(bench.position(), at - 10_000);
}

#[test]
fn a_sensor_ends_a_move() {
    let mut bench = Bench::enabled(with_switch);
    let to = |code: i32| by(-1).into_iter().chain([(10, code)]).collect::<Vec<_>>();
    bench.command(SENSOR, &to(0x4CB2));
    rest(&mut bench);
    // Down from 5 rev/s with 100 rev/s²: 2500 steps.
    assert!((-30_700..-30_400).contains(&bench.position()), "{}", bench.position());
    // No such condition.
    bench.command(SENSOR, &to(0x58B2));
    assert_eq!((bench.status(), bench.sim.refused().unsupported), (1, 1));
    // The safety distance.
    bench.command(0x80, &by(20_000).into_iter().chain([(10, 0x4CB5)]).collect::<Vec<_>>());
    let begin = bench.position();
    rest(&mut bench);
    assert!((20_000..23_000).contains(&(bench.position() - begin)));
}

#[test]
fn without_traffic_the_motor_stops_after_zs_as_za_says() {
    let run = |za: u8, zs: u16| {
        let mut bench = Bench::enabled(|settings| {
            (settings.firmware.zs_ms, settings.firmware.za) = (zs, za);
            settings.network.first_packet_ns = 60 * S;
        });
        bench.command(JOG, &[(1, 2_400), (2, 600), (3, 600)]);
        bench.idle_for(500 * MS);
        bench.pass(u64::from(zs) * MS - 2 * MS);
        assert_eq!(bench.status(), 1 | JOGGING, "{za}");
        bench.pass(12 * MS);
        bench
    };
    for (za, stopping, end) in [(13, false, 1), (14, true, 1), (15, false, 0), (16, true, 0)] {
        let mut bench = run(za, 500);
        assert_eq!(bench.status() & STOPPING != 0, stopping, "{za}");
        bench.pass(S);
        assert_eq!(bench.status(), end, "{za}");
        assert!(bench.velocity().abs() < 1.0);
    }
    let mut segment = run(1, 300);
    segment.pass(100 * MS);
    assert_eq!(segment.status(), 0x4001);
    let mut off = Bench::enabled(|settings| settings.firmware.zs_ms = 0);
    off.command(JOG, &SLOWLY);
    off.pass(100 * S);
    assert_eq!(off.status(), 1 | JOGGING);
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
    let restarted = |save: bool| {
        let mut bench = Bench::owned(|_| {});
        bench.packet(1, &outputs(HOST, &host("ZS", 200, 0)));
        bench.packet(1, &outputs(HOST, &host("ZA", 15, 0)));
        if save {
            bench.packet(1, &outputs(HOST, &host("SA", 0, 0)));
            assert_eq!(bench.status(), 0x0100, "saving");
        }
        bench.command(ENABLE, &[]);
        bench.command(ENABLE, &[]);
        bench.command(JOG, &SLOWLY);
        bench.pass(300 * MS);
        assert_eq!(bench.status() & 0x21, 0x21, "not yet");
        bench.sim.disconnected(bench.now, MASTER);
        bench.sim.restart(bench.now);
        bench.pass(S);
        bench.session = bench.connect(MASTER);
        bench.open(&Forward::default());
        bench.command(ENABLE, &[]);
        bench.command(JOG, &SLOWLY);
        bench.pass(300 * MS);
        bench.status()
    };
    assert_eq!(restarted(true), 0);
    assert_eq!(restarted(false), 1 | JOGGING);
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
    closed.pass(400 * MS);
    assert_eq!(closed.status(), 1 | JOGGING);
    closed.pass(200 * MS);
    assert_eq!(closed.status(), 1);
}

#[test]
fn the_hardware_enable_takes_the_power_and_does_not_give_it_back() {
    let mut bench = Bench::enabled(|settings| settings.motor.enable = Some(Wired { input: 4, closed: true }));
    assert_eq!(bench.sim.drive.report().main, 0xF7);
    bench.command(JOG, &SLOWLY);
    bench.idle_for(100 * MS);
    bench.sim.inhibit(bench.now + 100 * MS);
    bench.idle_for(50 * MS);
    assert_eq!((bench.status(), bench.sim.drive.report().main), (0, 0xFF));
    bench.command(ENABLE, &[]);
    assert_eq!((bench.status(), bench.sim.refused().not_enabled), (0, 1));
    bench.idle_for(100 * MS);
    assert_eq!((bench.status(), bench.sim.drive.report().main), (0, 0xF7));
    bench.command(ENABLE, &[]);
    assert_eq!(bench.status(), 1);
}

#[test]
fn a_drive_may_be_found_running() {
    let mut bench = Bench::owned(|settings| settings.running = Some(-30_000.0));
    assert_eq!(bench.status(), 1 | JOGGING);
    assert!((bench.velocity() + 30_000.0).abs() < 10.0);
    bench.command(DISABLE, &[]);
    assert_eq!(bench.status(), 0);
    bench.pass(5 * S);
    assert_eq!(bench.velocity(), 0.0, "it runs out");
    assert!(bench.position() < 0);
}

#[test]
fn a_power_cycle_loses_position_and_power() {
    let mut bench = Bench::enabled(|_| {});
    bench.command(RELATIVE, &by(20_000));
    rest(&mut bench);
    bench.sim.disconnected(bench.now, MASTER);
    bench.sim.restart(bench.now);
    let truth = bench.sim.truth(bench.now);
    assert!(!truth.powered && truth.position.abs() < 0.01, "{truth:?}");
}
