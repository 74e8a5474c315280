//! The codes and messages of these drives.

use std::collections::HashSet;

use super::super::assembly::{self, Condition, IoCode, Letters, alarms, command, status};
use super::super::cip;
use super::super::message::{self, PROFILE_PATH, Payload, answer, immediate, version};
use super::super::opcodes::{OPCODES, PARAMETERS, opcode, parameter};
use super::*;

fn buffered(name: &str, value: i64) -> Option<Payload> {
    message::buffered(opcode(name).expect(name), 0, value)
}

#[test]
fn buffered_commands_are_those_of_the_host_command_reference_with_their_operands_only() {
    let io = |text: &str| text.parse::<IoCode>().unwrap().code().into();
    for (name, value, golden) in [
        ("AC", 600, "00 01 00 1E 00 00 02 58"),
        ("DE", 600, "00 01 00 1F 00 00 02 58"),
        ("VE", 1200, "00 01 00 1D 00 00 04 B0"),
        ("DI", 100_000, "00 01 00 B6 00 01 86 A0"),
        ("DI", -1, "00 01 00 B6 FF FF FF FF"),
        ("FL", 0, "00 01 00 66 00 00 00 00"),
        ("ME", 0, "00 01 00 9F 00 00 00 00"),
        ("SO", io("2L"), "00 01 00 8B 00 00 4C B2"),
        ("FS", io("2R"), "00 01 00 6B 00 00 52 B2"),
        ("QX", 12, "00 01 00 78 00 00 00 0C"),
        // A negative operand of 16 bits is not extended.
        ("JS", -2, "00 01 00 1A 00 00 FF FE"),
        ("FD", io("3R") << 16 | io("2L"), "00 01 00 69 52 B3 4C B2"),
    ] {
        assert_eq!(buffered(name, value).expect(name)[..], hex(golden), "{name}");
    }
    let with_field = |name, field, value| message::buffered(opcode(name).unwrap(), field, value);
    assert_eq!(with_field("RX", b'3', -5).unwrap()[..], hex("00 01 33 AE FF FF FF FB"));
    // Operands that a command does not have.
    for (name, low, high) in [
        ("FL", 0, 0),
        ("QX", 0, 255),
        ("AC", -32768, 65535),
        ("SO", 0, 65535),
        ("DI", -2_147_483_648, 2_147_483_647),
    ] {
        for value in [low, high] {
            assert!(buffered(name, value).is_some(), "{name} {value}");
        }
        for value in [low - 1, high + 1, i64::MIN, i64::MAX] {
            assert_eq!(buffered(name, value), None, "{name} {value}");
        }
        assert_eq!(with_field(name, 1, 0), None, "{name}");
    }
    assert_eq!(with_field("WD", b'5', 0).unwrap()[..], hex("00 01 35 BF 00 00 00 00"));
    assert_eq!(opcode("SJ"), None);
}

#[test]
fn an_answer_to_a_command_is_its_own_or_named() {
    let ac = message::immediate(immediate::READ_PARAMETER, parameter("AC").unwrap().index, 0);
    let absolute = message::immediate(immediate::READ_POSITION, 1, 0);
    let reset = message::immediate(immediate::RESET_ALARM, 0, 0);
    for (message, text, expected) in [
        (ac, "00 02 84 1E 02 58 00 00", Some(600)),
        (absolute, "00 02 88 01 87 65 43 21", Some(0x8765_4321)),
        (reset, "00 02 8E 00 02 00 00 00", Some(status::ALARM.into())),
        // Of the encoder, of a buffered command, too short, too long.
        (absolute, "00 02 88 00 87 65 43 21", None),
        (absolute, "00 01 88 01 87 65 43 21", None),
        (absolute, "00 02 88 01 87 65 43", None),
        (absolute, "00 02 88 01 87 65 43 21 00", None),
    ] {
        assert_eq!(answer(&message, &hex(text)), expected, "{text}");
    }
    let bytes = hex("00 01 00 1E 00 09 00 00");
    let ac = buffered("AC", 600).unwrap();
    assert_eq!(answer(&ac, &bytes), Some((status::ENABLED | status::IN_POSITION).into()));
    assert_eq!(answer(&buffered("DE", 600).unwrap(), &bytes), None);
    assert_eq!(answer(&ac, &bytes[1..]), None);
}

#[test]
fn hcr_profile_code() {
    let request = cip::request(cip::service::GET_ATTRIBUTE_SINGLE, &PROFILE_PATH, &[]);
    assert_eq!(request, hex("0E 03 20 64 24 00 30 01"));
    let mut data = hex("00 75 00 07 41 5F 00 01 03 4A");
    for (board, expected) in [(0x75, Version::V1), (251, Version::V2), (250, Version::V1)] {
        data[1] = board;
        assert_eq!(version(&data), Some(expected), "{board}");
    }
    assert_eq!(version(&data[..9]), None);
}

#[test]
fn tables_name_everything_once_and_bits_as_the_manual() {
    assert!(OPCODES.is_sorted_by(|a, b| a.name < b.name));
    assert_eq!(OPCODES.iter().map(|opcode| opcode.code).collect::<HashSet<_>>().len(), OPCODES.len());
    assert_eq!(PARAMETERS.iter().map(|one| one.name).collect::<HashSet<_>>().len(), PARAMETERS.len());
    // CP is printed with the index of CI; where a command and a parameter share a name they share the number, too.
    assert_eq!(PARAMETERS.iter().map(|one| one.index).collect::<HashSet<_>>().len(), PARAMETERS.len() - 1);
    for parameter in PARAMETERS {
        assert_eq!(parameter.read_only, parameter.index >= 0x80, "{}", parameter.name);
        if let Some(opcode) = opcode(parameter.name) {
            assert_eq!(opcode.code, parameter.index, "{}", parameter.name);
        }
    }
    // Bits are those of the manual.
    assert_eq!(status::NAMES[status::HOMING.trailing_zeros() as usize], "homing");
    assert_eq!(status::NAMES[status::INITIALIZING.trailing_zeros() as usize], "initialising");
    assert_eq!((command::STOP_FAST, command::STOP, command::HOST), (0x4000, 0x8000, 0x4_0000));
    assert_eq!((command::RESET_ALARM, command::CURRENT), (0x10_0000, 0x20_0000));
    let faults: u32 = (0..16).filter(|bit| assembly::ALARMS[*bit].fault).map(|bit| 1 << bit).sum();
    assert_eq!(faults, 0x0001 | 0x0008 | 0x0010 | 0x0020 | 0x0080 | 0x0100 | 0x0200);
    let names = |word| alarms(word).map(|alarm| alarm.name).collect::<Vec<_>>();
    assert_eq!(names(0x1000 | 0x0008), ["over temperature", "no move: the motor is disabled"]);
    assert!(names(0xFFFF_0000).is_empty() && names(u32::MAX).len() == 16);
}

#[test]
fn io_codes_and_letters_of_host_commands_are_those_of_the_manual_and_no_others() {
    for (text, code) in [("2L", 0x4CB2), ("3R", 0x52B3), ("12F", 0x46BC)] {
        assert_eq!(text.parse::<IoCode>().unwrap().code(), code, "{text}");
    }
    for condition in [Condition::High, Condition::Low, Condition::Rising, Condition::Falling] {
        for number in 0..=IoCode::MAX {
            let code = IoCode::new(number, condition).unwrap();
            assert_eq!(code.to_string().parse(), Ok(code));
            assert_eq!(IoCode::from_code(code.code()), Some(code));
        }
        assert_eq!(IoCode::new(13, condition), None);
    }
    for text in ["", "L", "2", "2X", "13L", "-1L", "+1L", "123L", "2l", " 2L", "ÄL", "99H"] {
        assert!(text.parse::<IoCode>().is_err(), "{text}");
    }
    assert_eq!((0..=u16::MAX).filter(|code| IoCode::from_code(*code).is_some()).count(), 4 * 13);
    assert_eq!(Letters::new("SO"), Some(Letters(0x534F)));
    assert!(["", "S", "SOS", "so", "S1", "Ä"].iter().all(|text| Letters::new(text).is_none()));
}
