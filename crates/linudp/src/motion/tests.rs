//! The catalogue and streams.

mod golden;

use super::*;

#[test]
fn a_header_is_id_and_count() {
    let stop = MotionCommand::vai_stop(Acceleration(1));
    assert_eq!((stop.header(0), stop.header(5), stop.header(0x1F)), (0x0170, 0x0175, 0x017F));
    assert_eq!(MotionCommand::new(0x210).header(3), 0x2103);
}

#[test]
fn names_say_one_command_and_keys_one_field() {
    let plain = |name: &str, other: u8| {
        name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == other)
    };
    for (index, info) in CATALOGUE.iter().enumerate() {
        assert!(plain(info.name, b'-'), "{}", info.name);
        assert_eq!(CommandInfo::of(info.id).map(|found| found.name), Some(info.name));
        assert_eq!(CommandInfo::named(info.name).map(|found| found.id), Some(info.id));
        assert!(CATALOGUE[..index].iter().all(|other| other.name != info.name), "{} twice", info.name);
        for (index, field) in info.fields.iter().enumerate() {
            assert!(plain(field.name, b'_'), "{}", field.name);
            assert!(info.fields[..index].iter().all(|other| other.name != field.name), "{}", info.name);
        }
        assert!(info.id <= 0xFFF && info.size() <= 30);
    }
    assert!(CommandInfo::of(0x006).is_none() && CommandInfo::named("vai_go_to").is_none());
}

#[test]
fn streams_carry_what_their_command_has_and_signs() {
    use StreamCommand as S;
    for (command, velocity, acceleration) in [
        (S::P, 0, 0),
        (S::Pv, -2, 0),
        (S::PConfigured, 0, 0),
        (S::PvConfigured, -2, 0),
        (S::Pva, -2, -3),
        (S::PvaConfigured, -2, -3),
    ] {
        let row = (Position(-1), SignedVelocity(-2), SignedAcceleration(-3));
        let block = MotionCommand::stream(command, row.0, row.1, row.2).block(1);
        assert_eq!(block.header >> 4, command.id());
        let info = CommandInfo::of(command.id()).unwrap();
        assert_eq!(info.values(&block.parameters), [-1, velocity, acceleration, 0, 0]);
        assert!(block.parameters[info.size()..].iter().all(|byte| *byte == 0));
        assert_eq!(S::from_id(command.id()), Some(command));
    }
    assert_eq!(S::from_id(0x036), None);
}
