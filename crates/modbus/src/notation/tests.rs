//! Addresses and values in every form, and the calls they make.

use proptest::prelude::*;

use super::*;
use fieldbeat_core::axis::acyclic::Call;
use fieldbeat_core::axis::acyclic::long::{READ, WRITE};

fn target(text: &str) -> Option<(String, Width)> {
    Target::parse(text).map(|target| (target.parameter.to_string(), target.width))
}

#[test]
fn addresses_are_read_in_every_form() {
    for (text, parameter, width) in [
        ("06.042", "06.042", Width::Word),
        ("control-word", "06.042", Width::Word),
        ("01.021", "01.021", Width::Long),
        ("preset-reference-1", "01.021", Width::Long),
        ("01.021.word", "01.021", Width::Word),
        ("06.042.long", "06.042", Width::Long),
        ("control-word.long", "06.042", Width::Long),
        // Not known here: 32 bits, of which a smaller one fills the lower.
        ("07.001", "07.001", Width::Long),
        ("07.001.word", "07.001", Width::Word),
        ("4.15.009", "4.15.009", Width::Word),
        ("2.modbus-timeout", "2.15.009", Width::Word),
        ("2.modbus-timeout.long", "2.15.009", Width::Long),
        ("1.06.042", "1.06.042", Width::Long),
    ] {
        assert_eq!(target(text), Some((parameter.to_owned(), width)), "{text}");
    }
    let none = "|6.42|06.042.|06.042.byte|.word|speed|modbus-timeout|4.control-word|5.modbus-timeout|\
                0.modbus-timeout|06.042.word.long|0x20A8|control-word.";
    for text in none.split('|') {
        assert_eq!(target(text), None, "{text}");
        assert!(matches!(Parameters.read(text), Err(NotationError::Address { .. })), "{text}");
    }
}

#[test]
fn a_block_has_one_width_and_ends_with_its_menu() {
    let block = |address: &str, count| Parameters.block(address, count);
    for (address, count, addresses, call, bytes) in [
        ("20.021", 3, "20.021 20.022 20.023", 0x0100_1415, 4),
        ("06.042", 2, "06.042 06.043", 0x0000_062A, 2),
        // Of the third one nothing is known here.
        ("control-word", 3, "06.042.long 06.043.long 06.044", 0x0100_062A, 4),
        ("06.042.long", 1, "06.042.long", 0x0100_062A, 4),
        ("01.021.word", 2, "01.021.word 01.022.word", 0x0000_0115, 2),
        ("4.15.009", 1, "4.15.009", 0x0004_0F09, 2),
    ] {
        let addresses = addresses.split(' ').map(str::to_owned).collect();
        assert_eq!(block(address, count), Ok(Block { addresses, address: call, bytes }), "{address}");
    }
    for (address, count, parts) in [
        ("20.021", 0, "0 is not a value of this parameter; write 1 to 60 parameters of 32 bits at once"),
        ("20.021", 61, "write 1 to 60 parameters of 32 bits at once"),
        ("20.001.word", 121, "write 1 to 120 parameters of 16 bits at once"),
        ("20.200", 100, "write parameters of one menu"),
        ("162.098", 3, "write parameters of one menu"),
        ("20.001", usize::MAX, "write "),
        ("6.42", 2, "not an address of this drive"),
    ] {
        let why = block(address, count).unwrap_err().to_string();
        assert!(why.contains(parts), "{address}, {count}: {why}");
    }
}

#[test]
fn a_call_carries_width_slot_menu_and_number() {
    for (text, address) in [("06.042", 0x0000_062A), ("01.021", 0x0100_0115), ("4.15.009", 0x0004_0F09)] {
        assert_eq!(Parameters.read(text), Ok(Call { service: READ, address, value: 0 }), "{text}");
    }
    for (text, written, address, value) in [
        ("06.042", 0x0180, 0x0000_062A, 0x0180),
        ("01.021", 0xFFFF_FFFF, 0x0100_0115, 0xFFFF_FFFF),
        // A number of 16 bits with its sign above them.
        ("20.001", 0xFFFF_FFFE, 0x0000_1401, 0xFFFE),
    ] {
        assert_eq!(Parameters.write(text, written), Ok(Call { service: WRITE, address, value }), "{text}");
    }
    for (address, value) in [("06.042", 0x1_0000), ("06.042", 0xFFFF_0000), ("01.021", 1 << 32)] {
        let wrong = Parameters.write(address, value);
        assert!(matches!(wrong, Err(NotationError::Value { .. })), "{address} {value:#x}: {wrong:?}");
    }
    // Only a packed target is one.
    for address in [0x0200_0115, 0xFF00_0115, 0x0005_0F09, u32::MAX] {
        assert_eq!(Target::unpack(address), None, "{address:#x}");
    }
}

#[test]
fn values_are_in_the_unit_that_is_shown_or_counts_on_request() {
    for (address, text, raw) in [
        ("01.021", "15000", 15_000),
        ("01.021", "-5", 0xFFFF_FFFB),
        ("01.021", "0xFFFFFFFB", 0xFFFF_FFFB),
        ("22.001", "1021", 1_021),
        ("06.042", "0x0183", 0x0183),
        ("06.042", "65535", 0xFFFF),
        ("06.015", "true", 1),
        ("06.015", "false", 0),
        ("20.001", "-1", 0xFFFF),
        ("20.001", "0xFFFF", 0xFFFF),
        ("01.021.word", "-1", 0xFFFF),
        ("07.001", "4294967295", 0xFFFF_FFFF),
        ("07.001", "-1", 0xFFFF_FFFF),
        ("07.001.word", "-1", 0xFFFF),
        ("07.001.word", "65535", 0xFFFF),
    ] {
        assert_eq!(Parameters.value(address, text), Ok(raw), "{address} {text}");
    }
    for (address, text, raw) in [
        ("01.021", "1500", 15_000),
        ("01.021", "1500.0", 15_000),
        ("01.021", "1500.00 rpm", 15_000),
        ("01.021", "-0.5", 0xFFFF_FFFB),
        ("01.021", "0xFFFFFFFB", 0xFFFF_FFFB),
        ("02.011", "0.5", 500),
        ("22.001", "1.021", 1_021),
        ("06.042", "387", 387),
        ("06.015", "true", 1),
    ] {
        assert_eq!(Parameters.in_unit(address, text), Ok(raw), "{address} {text}");
    }
    let far = Parameters.in_unit("01.021", "214748364.8").unwrap_err();
    assert!(matches!(far, NotationError::OutOfReach { .. }) && far.to_string().contains("rpm"), "{far}");
    for text in "1500.05 1500. .5 -.5 --1.5 1.-5 1.5.0 1500mm 1e3".split(' ') {
        let wrong = Parameters.in_unit("01.021", text);
        assert!(matches!(wrong, Err(NotationError::Value { .. })), "{text}: {wrong:?}");
    }
    for (address, texts) in [
        ("06.042", "65536 -1 0x10000"),
        ("20.001", "32768 0x10000"),
        ("01.021", "2147483648 0x100000000 0xFFFFFFFFFFFFFFFF"),
        ("07.001.word", "65536"),
        ("07.001", "4294967296"),
    ] {
        for text in texts.split(' ') {
            let wrong = Parameters.value(address, text);
            assert!(matches!(wrong, Err(NotationError::Range { .. })), "{address} {text}: {wrong:?}");
        }
    }
    for (address, texts) in [
        ("01.021", "1500.0 1500. .5 99999999999999999999 1500rpm 1e3"),
        ("06.042", "1.0"),
        // The last one is no text at all.
        ("07.001", "1.5 0x 0x+5 0x-5 99999999999999999999 "),
    ] {
        for text in texts.split(' ') {
            let wrong = Parameters.value(address, text);
            assert!(matches!(wrong, Err(NotationError::Value { .. })), "{address} {text}: {wrong:?}");
        }
    }
}

#[test]
fn values_are_shown_in_their_unit_and_as_counts() {
    for (address, raw, shown) in [
        ("01.021", 15_000, "1500.0 rpm (raw 15000, 0x3A98)"),
        ("01.021", 0xFFFF_FFFB, "-0.5 rpm (raw -5, 0xFFFFFFFB)"),
        ("02.011", 500, "0.500 s/1000rpm (raw 500, 0x1F4)"),
        ("22.001", 1_021, "1.021 (raw 1021, 0x3FD)"),
        ("05.005", 560, "560 V (raw 560, 0x230)"),
        ("06.042", 0x0183, "387 (0x183)"),
        ("04.020", 0xFFFF_FF9C, "-10.0 % (raw -100, 0xFF9C)"),
        ("07.001", 0xFFFF_FFFF, "-1 (0xFFFFFFFF)"),
        ("speed", 7, "7 (0x7)"),
    ] {
        assert_eq!(Parameters.show(address, raw), shown, "{address}");
    }
    assert_eq!(Parameters.number("04.020", 0xFF9C), -100);
    assert_eq!(Parameters.number("06.042", 0xFFFF), 0xFFFF);
}

#[test]
fn a_refusal_names_its_source() {
    assert_eq!(Parameters.reason(2), "exception 02h no such parameter, or too many registers at once");
    assert!(Parameters.reason(NOT_TAKEN).contains("read-only"));
    assert!(Parameters.reason(UNREACHABLE).contains("addressing"));
    assert_eq!(Parameters.reason(0x1234), "status 0x1234");
}

proptest! {
    #[test]
    fn every_target_survives_its_call(slot in 0..=SLOT_MAX, place in any::<[u8; 2]>(), long in any::<bool>()) {
        let [menu, number] = place;
        let width = if long { Width::Long } else { Width::Word };
        let target = Target { parameter: Parameter { slot, menu, number }, width };
        prop_assert_eq!(Target::unpack(target.pack()), Some(target));
        let all = [
            Service::Read(target),
            Service::Write(target, u64::MAX),
            Service::ReadSeveral(target, 3),
            Service::Store(target, 8),
        ];
        for service in all {
            prop_assert_eq!(Service::of(&service.into()), Some(service));
        }
    }
}
