use super::*;
use fieldbeat_core::axis::acyclic::Call;
use fieldbeat_core::axis::acyclic::long::{LOAD, READ, STORE, WRITE};

fn target(text: &str) -> Option<Target> {
    Address::parse(text).map(|address| address.target)
}

#[test]
fn addresses_are_what_they_say_and_the_list_has_all_of_them() {
    for (text, expected) in [
        ("AC", Target::Parameter { index: 0x1E, flash: false }),
        ("AC.flash", Target::Parameter { index: 0x1E, flash: true }),
        ("IV-actual", Target::Parameter { index: 0x8B, flash: false }),
        ("R:3", Target::Register(b'3')),
        ("R:A", Target::Register(b'A')),
        ("R:e", Target::Register(b'e')),
        ("SCL:VE", Target::Command { code: 0x1D, field: 0 }),
        ("SCL:RX/3", Target::Command { code: 0xAE, field: b'3' }),
        ("SCL:MO/1", Target::Command { code: 0x49, field: 0xB1 }),
        ("SCL:MO", Target::Command { code: 0x49, field: 0 }),
        ("encoder", Target::Encoder),
        ("output:1", Target::Output(0)),
        ("output:128", Target::Output(127)),
        ("0x01/1/7", Target::Attribute { class: 1, instance: 1, attribute: 7 }),
        ("0xF5/0x1/13.u16", Target::Attribute { class: 0xF5, instance: 1, attribute: 13 }),
    ] {
        assert_eq!(target(text), Some(expected), "{text}");
    }
    let none = " ac XX IV SC.flash R: R:Z R:33 SCL: SCL:XX SCL:VE/1 SCL:RX SCL:MO/13 output:0 output:129 \
         output:+1 0x01/1 0x01/1/7/1 0x01/1/7.u17 0x800/1/1 1/0x400/1 +1/1/1 0x/1/1";
    for text in none.split(' ') {
        assert_eq!(target(text), None, "{text}");
        assert!(matches!(Addresses.read(text), Err(NotationError::Address { .. })), "{text}");
    }
    // The list has all of them, each with a meaning.
    let listed = |part, values| {
        let wanted = Wanted { drive: "x", part, values, ..Wanted::default() };
        Addresses.list(&wanted)
    };
    let Ok(Listing::Known(rows)) = listed(None, false) else { panic!("a list that is known") };
    assert_eq!(
        rows.len(),
        opcodes::PARAMETERS.len() + 10 + opcodes::REGISTERS.len() + opcodes::OPCODES.len() + 9
    );
    for row in &rows {
        assert!(row.name.is_some() && target(&row.address).is_some(), "{row:?}");
    }
    let usage =
        |address: &str| rows.iter().find(|row| row.address == address).and_then(|row| row.usage.clone());
    assert_eq!(usage("AC").as_deref(), Some("16 read write"));
    assert_eq!(usage("SC").as_deref(), Some("16 read"));
    assert_eq!(usage("R:3").as_deref(), Some("32 read write"));
    assert_eq!(usage("SCL:ME").as_deref(), Some("write"));
    assert!(matches!(listed(Some("registers"), true), Ok(Listing::Read(_))));
    assert!(
        listed(Some("06"), false).unwrap_err().to_string().contains("parameters, registers and commands")
    );
    let wanted = Wanted { drive: "x", modified: true, ..Wanted::default() };
    assert!(Addresses.list(&wanted).is_err());
}

/// AC100 is 600, VE5 is 1200 (Host Command Reference): a reading of "10 rev/s/s" would be wrong by sixty.
#[test]
fn a_value_in_its_unit_is_the_count_that_is_shown_with_it() {
    for (address, text, raw, shown) in [
        ("AC", "100.0", 600, "100 rev/s² (raw 600, 0x258)"),
        ("AC", "100 rev/s2", 600, "100 rev/s² (raw 600, 0x258)"),
        ("VE", "5.0", 1_200, "5 rev/s (raw 1200, 0x4B0)"),
        ("VE", "0x4B0", 1_200, "5 rev/s (raw 1200, 0x4B0)"),
        ("DE.flash", "0.17", 1, "0.1667 rev/s² (raw 1, 0x1)"),
        ("EG", "20000.0", 10_000, "20000 steps/rev (raw 10000, 0x2710)"),
        ("GC", "-1.5", 0xFF6A, "-1.5 A (raw -150, 0xFF6A)"),
        ("R:V", "-1.0", 0xFFFF_FF10, "-1 rev/s (raw -240, 0xFFFFFF10)"),
        ("R:3", "-1", 0xFFFF_FFFF, "-1 (0xFFFFFFFF)"),
        ("R:3", "0xFFFFFFFF", 0xFFFF_FFFF, "-1 (0xFFFFFFFF)"),
        ("SCL:AC", "100.0", 600, "100 rev/s² (raw 600, 0x258)"),
        ("SCL:DI", "-5", -5_i64 as u64, "-5 (0xFFFFFFFFFFFFFFFB)"),
        ("SCL:FS", "2R", 0x52B2, "2R (raw 21170, 0x52B2)"),
        ("SCL:FD", "2L/3R", 0x52B3_4CB2, "2L/3R (raw 1387482290, 0x52B34CB2)"),
        ("output:2", "true", 1, "1 (0x1)"),
        ("0x01/1/1.u16", "60", 60, "60 (0x3C)"),
        ("0x01/1/1.i8", "-2", 0xFE, "-2 (0xFE)"),
    ] {
        assert_eq!(Addresses.in_unit(address, text).unwrap(), raw, "{address} = {text}");
        let count = Addresses.number(address, raw).to_string();
        assert_eq!(Addresses.value(address, &count).unwrap(), raw, "{address} = {count}");
        assert_eq!(Addresses.show(address, raw), shown, "{address}");
    }
}

#[test]
fn values_that_do_not_exist_are_refused_with_the_right_form() {
    let message = |address: &str, text: &str| Addresses.value(address, text).unwrap_err().to_string();
    for (address, text, range) in [
        ("AC", "0", "1 ... 32000"),
        ("GC", "2001", "-2000 ... 2000"),
        ("R:3", "0x100000000", "-2147483648 ... 2147483647"),
    ] {
        assert_eq!(message(address, text), format!("{text} is out of the range of its type, {range}"));
    }
    let ac = "a whole number, 1 ... 32000, or its bits as 0x...";
    let far = Addresses.in_unit("AC", "5334.0").unwrap_err().to_string();
    assert_eq!(far, "5334.0 is out of the range of its type, 0.1667 rev/s² ... 5333.3333 rev/s²");
    let foreign = Addresses.in_unit("AC", "100 mm/s²").unwrap_err().to_string();
    assert!(foreign.contains("write a value in rev/s²"), "{foreign}");
    let bad =
        ["", "1.", ".5", "1e3", "1.0e3", "- 1", "fast", "0x", "0x+1", "nan"].map(|text| ("AC", text, ac));
    let pd = ("PD", "1.5", "a whole number, 0 ... 65535, or its bits as 0x...");
    for (address, text, form) in bad.into_iter().chain([pd]) {
        assert_eq!(message(address, text), format!("{text} is not a value of this parameter; write {form}"));
    }
    for (address, text, part) in [
        ("SCL:FS", "13L", "like 2L"),
        ("SCL:ME", "1", "0 ... 0"),
        ("save-segment", "13", "1 ... 12"),
        ("SC", "1", "cannot be written; write to "),
        ("absolute", "1", READ_ONLY),
        ("0x01/1/7.octets", "1", "two digits each"),
        ("0x01/1/7.text", "ü", "ASCII"),
    ] {
        assert!(message(address, text).contains(part), "{}", message(address, text));
    }
}

#[test]
fn reads_and_writes_are_the_calls_of_their_targets() {
    let ac = Target::Parameter { index: 0x1E, flash: false };
    assert_eq!(Addresses.read("AC"), Ok(Call { service: READ, address: ac.pack(), value: 0 }));
    assert_eq!(Addresses.write("AC", 600), Ok(Call { service: WRITE, address: ac.pack(), value: 600 }));
    for text in ["SCL:VE", "output:1", "stop", "AC.flash"] {
        assert_eq!(Addresses.read(text), Err(NotationError::Address { form: ONLY_WRITTEN }), "{text}");
    }
    // As a program of the application gives them: an i16, an i32 and an i64.
    for (address, value, written) in [
        ("GC", 0xFF6A, Some(0xFF6A)),
        ("R:3", u64::from(u32::MAX), Some(0xFFFF_FFFF)),
        ("R:3", u64::MAX, Some(0xFFFF_FFFF)),
        ("SCL:DI", u64::from(-5_i32 as u32), Some(-5)),
        ("SCL:DI", -5_i64 as u64, Some(-5)),
        ("SCL:DI", 1 << 40, None),
        ("AC", 0x1_0258, None),
        ("AC", 0, None),
    ] {
        let found = Addresses.write(address, value).map(|call| call.value as i64);
        assert_eq!(found.ok(), written, "{address} {value:#x}");
    }
    let read_back = |address| Addresses.read_back(address);
    assert_eq!((read_back("AC.flash"), read_back("R:3")), (vec!["AC".into()], vec!["R:3".into()]));
    assert!(read_back("SCL:VE").is_empty() && read_back("output:1").is_empty());
}

/// An attribute has its own size: eight bytes at once would be another value.
#[test]
fn attributes_are_written_with_the_bytes_of_their_type() {
    for (address, text, expected) in [
        ("0xF5/1/13.u16", "120", Some(vec![(LOAD, 120), (STORE, 2)])),
        ("0xF5/1/13.i8", "-1", Some(vec![(LOAD, 0xFF), (STORE, 1)])),
        ("0x01/1/7.text", "abc", Some(vec![(LOAD, 0x6362_6103), (STORE, 4)])),
        ("0x01/1/7", "01 02", Some(vec![(LOAD, 0x0201), (STORE, 2)])),
        (
            "0x01/1/7.octets",
            "01 02 03 04 05 06 07 08 09",
            Some(vec![(LOAD, 0x0807_0605_0403_0201), (LOAD, 9), (STORE, 9)]),
        ),
        ("AC", "600", None),
        ("0xF5/1/13.u16", "65536", None),
        ("0x01/1/7", "", None),
        ("0x01/1/7", "0", None),
    ] {
        let calls = Addresses.write_long(address, text);
        let found: Option<Vec<_>> =
            calls.map(|calls| calls.into_iter().map(|call| (call.service, call.value)).collect());
        assert_eq!(found, expected, "{address} = {text}");
    }
    // The single call of a shorter one stores nothing.
    let written = |address| Addresses.write(address, 120).map(|call| (call.service, call.value));
    assert_eq!((written("0xF5/1/13.u16"), written("0xF5/1/13.u64")), (Ok((STORE, 0)), Ok((WRITE, 120))));
    assert_eq!(Addresses.show("0x01/1/7.text", 0x6362_6103), "abc");
    assert_eq!(Addresses.show("0x01/1/7", 0x0201), "01 02 00 00 00 00 00 00");
    assert_eq!(Addresses.reason(0x14), "attribute not supported (0x14)");
}
