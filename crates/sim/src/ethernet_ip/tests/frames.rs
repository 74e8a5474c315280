//! The frames of the sheet's section 6 and of its examples: bytes in, bytes out.

use super::*;
use crate::ethernet_ip::assembly::{INPUT_V1, INPUT_V2, Report};
use crate::ethernet_ip::produce;

/// The sheet's drive reports "in position", as step-servos do, and has a finished move behind it.
fn servo(settings: &mut MoonsSettings) {
    settings.identity.kind = Kind::StepServo;
}

const OPEN: &str = "6F 00 42 00 01 01 00 00 00 00 00 00 01 00 00 00 00 00 00 00 00 00 00 00 \
                    00 00 00 00 00 00 02 00 00 00 00 00 B2 00 32 00 \
                    54 02 20 06 24 01 0A 0E 00 00 00 00 01 00 01 00 01 00 34 12 EE FF C0 00 02 00 00 00 \
                    10 27 00 00 46 48 10 27 00 00 3A 48 01 04 20 04 24 66 2C 70 2C 65";
const OPENED: &str =
    "D4 00 00 00 13 00 01 5A 01 00 01 00 01 00 34 12 EE FF C0 00 10 27 00 00 10 27 00 00 00 00";
const ENABLE: &str = "02 00 02 80 08 00 13 00 01 5A 01 00 00 00 B1 00 46 00 01 00 01 00 00 00 02 00 00 00";

#[test]
fn the_sheets_owner_opens_enables_and_closes() {
    let mut bench = Bench::new(servo);
    assert_eq!(bench.session, 0x101);
    let reply = bench.raw(MASTER, &hex(OPEN));
    let header = "6F 00 42 00 01 01 00 00 00 00 00 00 01 00 00 00 00 00 00 00 00 00 00 00 \
                  00 00 00 00 00 00 03 00 00 00 00 00 B2 00 1E 00";
    // Where packets are taken.
    let item = "00 80 10 00 00 02 08 AE 00 00 00 00 00 00 00 00 00 00 00 00";
    let mut expected = hex(&[header, OPENED, item].concat());
    expected[2] = (expected.len() - 24) as u8;
    assert_eq!(reply, expected);
    let mut enable = hex(ENABLE);
    enable.resize(enable.len() + 60, 0);
    bench.at(PACKETS, MASTER_IO, &enable);
    assert_eq!((bench.status(), bench.sim.ignored()), (0x0009, Ignored::default()));
    let close = "4E 02 20 06 24 01 0A 0E 01 00 34 12 EE FF C0 00 04 00 20 04 24 66 2C 70 2C 65";
    assert_eq!(bench.message(&hex(close)), hex("CE 00 00 00 01 00 34 12 EE FF C0 00 00 00"));
    assert_eq!(bench.sim.connections(), (1, 0));
    // The large form.
    let open = "5B 02 20 06 24 01 0A 0E 00 00 00 00 03 00 01 00 09 00 34 12 EE FF C0 00 02 00 00 00 10 27 00 \
         00 46 00 00 48 10 27 00 00 3A 00 00 48 01 04 20 04 24 66 2C 70 2C 65";
    let opened = "DB 00 00 00 13 00 01 5A 03 00 01 00 09 00 34 12 EE FF C0 00 10 27 00 00 10 27 00 00 00 00";
    assert_eq!(Bench::new(|_| {}).message(&hex(open)), hex(opened));
}

#[test]
fn the_inputs_are_those_of_the_sheet_and_of_the_manuals_example() {
    let report = Report {
        status: 0x0009,
        voltage: 242,
        current: 1501,
        temperature: 305,
        encoder: -838,
        absolute: 404_167,
        error: 12,
        velocity: 480,
        main: 0xFF,
        ..Report::default()
    };
    let mut packet = Vec::new();
    produce::header(0x0001_0001, 1, 1, 58, &mut packet);
    report.append(INPUT_V2, *DRIVE.ip(), &FirmwareSettings::default(), &mut packet);
    let mut expected = hex(
        "02 00 02 80 08 00 01 00 01 00 01 00 00 00 B1 00 3A 00 01 00 | 09 00 00 00 00 00 00 00 F2 00 00 00 \
         DD 05 00 00 31 01 00 00 BA FC FF FF C7 2A 06 00 0C 00 00 00 E0 01 00 00 00 00 00 00 FF 00 00 00",
    );
    expected.resize(expected.len() + 12, 0);
    assert_eq!(packet, expected);
    let first = Report {
        status: 0x19,
        voltage: 489,
        current: 0,
        temperature: 568,
        velocity: -61,
        extended: 0x40FF,
        main: 0x0F00,
        outputs: 0x000F,
        ..report
    };
    let mut packet = Vec::new();
    first.append(INPUT_V1, Ipv4Addr::new(192, 168, 0, 40), &FirmwareSettings::default(), &mut packet);
    let example = "2800A8C0 1900 0000 E901 0000 3802 BAFCFFFF C72A0600 C3FF FF40 000F 0F00";
    assert_eq!(packet, hex(example));
}

#[test]
fn a_position_is_read_on_a_class_3_connection() {
    let mut bench = Bench::new(|_| {});
    bench.raw(MASTER, &hex(OPEN));
    let open = "54 02 20 06 24 01 0A 0E 00 00 00 00 02 00 01 00 02 00 34 12 EE FF C0 00 03 00 00 00 40 42 0F \
         00 F4 43 40 42 0F 00 F4 43 A3 02 20 02 24 01";
    let reply = bench.message(&hex(open));
    let opened = "D4 00 00 00 14 00 01 5A 02 00 01 00 02 00 34 12 EE FF C0 00 40 42 0F 00 40 42 0F 00 00 00";
    assert_eq!(reply, hex(opened));
    bench.sim.drive.set_position(0x0765_4321);
    let read = "70 00 26 00 01 01 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 \
                00 00 00 00 00 00 02 00 A1 00 04 00 14 00 01 5A B1 00 12 00 01 00 \
                3C 03 20 64 24 01 30 01 00 02 88 01 00 00 00 00";
    let reply = bench.raw(MASTER, &hex(read));
    let expected = "70 00 22 00 01 01 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 \
                    00 00 00 00 00 00 02 00 A1 00 04 00 02 00 01 00 B1 00 0E 00 01 00 \
                    BC 00 00 00 00 02 88 01 07 65 43 21";
    assert_eq!(reply, hex(expected));
}

#[test]
fn an_unconnected_type_1_message_is_answered_with_the_status() {
    let mut bench = Bench::enabled(servo);
    let mut request = hex("6F 00 20 00 01 01 00 00");
    request.resize(24, 0);
    request.extend(hex("00 00 00 00 00 00 02 00 00 00 00 00 B2 00 10 00 3C 03 20 64 24 01 30 01 \
                        00 01 00 1E 00 00 02 58"));
    let reply = bench.raw(MASTER, &request);
    assert_eq!(reply[40..], hex("BC 00 00 00 00 01 00 1E 00 09 00 00"));
    assert_eq!(bench.vendor("00 02 84 1E 00 00 00 00"), (0, hex("00 02 84 1E 02 58 00 00")));
}

#[test]
fn the_commands_of_the_manual_are_taken_and_do_what_they_say() {
    let mut bench = Bench::new(|settings| {
        (settings.identity.board, settings.identity.model) = ((117, 7), (0x5F, 0));
    });
    // The example of the profile code.
    let reply = bench.message(&hex("0E 03 20 64 24 00 30 01"));
    assert_eq!(reply, hex("8E 00 00 00 00 75 00 07 41 5F 00 01 03 4A"));
    let examples = "00 01 00 1E 00 00 02 58|00 01 00 1F 00 00 02 58|00 01 00 1D 00 00 04 B0|00 01 00 B6 00 \
         01 86 A0|00 01 00 9F 00 00 00 00|00 01 00 66 00 00 00 00";
    for example in examples.split('|') {
        let (status, data) = bench.vendor(example);
        assert_eq!((status, &data[..4]), (0, &hex(example)[..4]), "{example}");
    }
    // 5 turns at 5 rev/s, with 100 rev/s².
    let mut fastest = 0.0_f64;
    for _ in 0..110 {
        bench.pass(10 * MS);
        fastest = fastest.max(bench.velocity());
        bench.vendor("00 02 88 01 00 00 00 00");
    }
    assert_eq!(bench.position(), 100_000);
    assert!((fastest / 20_000.0 - 5.0).abs() < 0.01, "{fastest}");
    bench.vendor("00 01 00 8B 00 00 4C B2");
    assert_eq!(bench.sim.drive.report().outputs, 0b10);
}
