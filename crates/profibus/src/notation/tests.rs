//! Addresses and values as people write them.

use std::ops::ControlFlow;
use std::time::Duration;

use super::*;
use fieldbeat_core::axis::acyclic::long::{LOAD, STORE, WRITE};
use fieldbeat_core::axis::acyclic::{Access, Call, CallError, Carrier, Condition, Series};

#[test]
fn addresses_are_codes_and_records_and_the_known_ones_are_listed() {
    let parameter = |code, sub, kind| Some(Target::Parameter(Parameter { code, sub, kind }));
    for (text, expected) in [
        ("C0061", parameter(61, 0, Kind::Own)),
        ("c61", parameter(61, 0, Kind::Own)),
        ("C0039/2", parameter(39, 2, Kind::Own)),
        ("C0168/8.u16", parameter(168, 8, Kind::U16)),
        ("C0200.text", parameter(200, 0, Kind::Text)),
        ("1/3", Some(Target::Record(Record { slot: 1, index: 3 }))),
        ("0/47", Some(Target::Record(Record { slot: 0, index: 47 }))),
    ] {
        assert_eq!(Target::parse(text), expected, "{text}");
    }
    for text in "|C|61|C+61|C0061/|C0061/256|C65536|C1.|C1.f32|1/256|/3|1/3/4|C1 ".split('|') {
        assert_eq!(Target::parse(text), None, "{text}");
        let error = Codes.read(text).unwrap_err().to_string();
        assert!(error.contains("C0061") && error.contains("1/3"), "{error}");
    }
    // The known codes are listed.
    let wanted = Wanted { drive: "x", ..Wanted::default() };
    let Ok(Listing::Known(rows)) = Codes.list(&wanted) else { panic!("they are known") };
    let row = |address: &str| rows.iter().find(|row| row.address == address).cloned();
    assert_eq!(row("C0061").and_then(|row| row.usage).as_deref(), Some("i32 read"));
    assert!(row("C0039/3").is_some() && row("C0039").is_none() && row("C0039/4").is_none());
    assert!(rows.iter().all(|row| Codes.read(&row.address).is_ok() && row.name.is_some()));
    assert!(matches!(Codes.list(&Wanted { values: true, ..wanted }), Ok(Listing::Read(_))));
    for wanted in [
        Wanted { part: Some("1"), ..wanted },
        Wanted { modified: true, ..wanted },
        Wanted { from: Some("C1"), ..wanted },
    ] {
        assert!(matches!(Codes.list(&wanted), Err(ListError::Wanted(_))));
    }
}

/// A drive that answers each call with this kind and value.
struct Answers(Kind, u32);

impl Carrier for Answers {
    fn run(&self, calls: &[Call], _: Duration) -> Series {
        let answer = |call: &Call| Answer {
            status: 0,
            address: super::super::target::learned(call.address, self.0),
            value: self.1.into(),
        };
        Series { answers: calls.iter().map(answer).collect(), failed: None }
    }

    fn condition(&self) -> Result<Condition, CallError> {
        Err(CallError::Gone)
    }

    fn claim(&self) -> Result<Box<dyn std::any::Any + Send>, CallError> {
        Err(CallError::Gone)
    }

    fn capacity(&self) -> usize {
        1
    }

    fn pause(&self, _: Duration) {}
}

#[test]
fn values_and_lists_are_what_the_drive_says_that_they_are() {
    for (kind, raw, shown, listed) in [
        (Kind::I32, 430_000, "43.0000 °C (raw 430000, 0x68FB0)", ("C0061", "i32 read")),
        (Kind::I16, 43, "43 °C (raw 43, 0x2B)", ("C0061.i16", "i16 read")),
        (Kind::I16, 0xFFFF_FFFB, "-5 °C (raw -5, 0xFFFB)", ("C0061.i16", "i16 read")),
        (Kind::U32, 430_000, "43.0000 °C (raw 430000, 0x68FB0)", ("C0061.u32", "u32 read")),
    ] {
        let carrier = Answers(kind, raw);
        let access = Access { drive: "x", notation: &Codes, carrier: &carrier };
        assert_eq!(access.read_shown("C0061"), Ok((raw.into(), shown.to_owned())));
        let wanted = Wanted { drive: "x", values: true, ..Wanted::default() };
        let Ok(Listing::Read(read)) = Codes.list(&wanted) else { panic!("it is read") };
        let rows = read(access, &mut |_| ControlFlow::Continue(())).unwrap();
        let row = rows.iter().find(|row| row.address.starts_with("C0061")).unwrap();
        assert_eq!(
            (&*row.address, row.usage.as_deref(), row.raw),
            (listed.0, Some(listed.1), Some(raw.into()))
        );
        assert_eq!(Codes.number("C0061", raw.into()), i64::from(raw.cast_signed()));
    }
}

#[test]
fn values_are_in_the_unit_of_their_code_or_counts_on_request() {
    for (address, text, raw) in [
        ("C0039", "1504000", 1_504_000),
        ("C0039", "0x16F300", 1_504_000),
        ("C0003", "true", 1),
        ("C0999", "25000", 25_000),
        ("C0150.u16", "65535", 0xFFFF),
        ("C0150.i16", "-2", 0xFFFE),
        ("C0150.u8", "0xFF", 0xFF),
        ("1/3", "01 A0", 0xA001),
        ("C0200.text", "S7 x", 0x7820_3753),
    ] {
        assert_eq!(Codes.value(address, text), Ok(raw), "{address} {text}");
    }
    for (address, text, raw) in [
        ("C0039", "150.4", 1_504_000),
        ("C0039", "150.4 Hz", 1_504_000),
        ("C0039/2", "-0.0001", 0xFFFF_FFFF),
        ("C0012", "5", 50_000),
        ("C0039", "0x16F300", 1_504_000),
        ("C0003", "true", 1),
        ("C0999", "2.5", 25_000),
        ("C0999.u16", "25000", 25_000),
        ("C0200.text", "S7 x", 0x7820_3753),
    ] {
        assert_eq!(Codes.in_unit(address, text), Ok(raw), "{address} {text}");
    }
    for (address, text, part) in [
        ("C0039", "150 rpm", "write a value in Hz"),
        ("C0039", "0.00001", "up to 4 decimals"),
        ("C0039", "300000.0", "214748.3647 Hz"),
        // It may be one of 16 bits, without decimals.
        ("C0999", "2", "C0999.u16"),
    ] {
        let wrong = Codes.in_unit(address, text).unwrap_err().to_string();
        assert!(wrong.contains(part), "{wrong}");
    }
    for (address, texts) in [
        ("C0039", &["1.5", "2147483648", "fast"][..]),
        ("C0150.u16", &["-1", "1.0"]),
        ("C0150.i8", &["128"]),
        ("1/3", &["", "0"]),
        ("C0200.text", &["", "\u{b5}"]),
    ] {
        assert!(texts.iter().all(|text| Codes.value(address, text).is_err()), "{address}");
    }
    assert!(matches!(Codes.value("C0061", "1"), Err(NotationError::ReadOnly { .. })));
    assert!(Codes.write("C0061", 1).is_err() && Codes.write_long("C0061.text", "a").is_none());
    for (address, raw, shown) in [
        ("C0061", 430_000, "43.0000 °C (raw 430000, 0x68FB0)"),
        ("C0039/2", 0xFFFF_FFFF, "-0.0001 Hz (raw -1, 0xFFFFFFFF)"),
        ("C0999", 25_000, "2.5000 (raw 25000, 0x61A8)"),
        ("C0150.u16", 0x237, "567 (0x237)"),
        ("1/3", 0xA001, "01 A0 00 00 00 00 00 00"),
    ] {
        assert_eq!(Codes.show(address, raw), shown);
    }
    // In 16 bits a code has other decimals, if they are known.
    assert_eq!(Codes.show("C0061.i16", 43), "43 °C (raw 43, 0x2B)");
    assert_eq!(Codes.show("C0039.i16", 43), "43 (0x2B)");
    let number = |address| Codes.number(address, 0xFFFF_FFFE);
    assert_eq!((number("C0039"), number("C0039.u32")), (-2, 0xFFFF_FFFE));
}

#[test]
fn a_call_has_the_bits_of_its_kind() {
    let write =
        |address: &str, value: u64| Codes.write(address, value).map(|call| (call.service, call.value));
    assert_eq!(write("C0039", 1_504_000), Ok((WRITE, 1_504_000)));
    // As an i32 that is negative, of 32 bits and of 64.
    assert_eq!(write("C0039", 0xFFFF_FFFE), Ok((WRITE, 0xFFFF_FFFE)));
    assert_eq!(write("C0150.i16", -2_i64 as u64), Ok((WRITE, 0xFFFE)));
    assert_eq!(write("C0150.i16", 0xFFFF_FFFE), Ok((WRITE, 0xFFFE)));
    assert!(write("C0150.u16", 0x1_0000).is_err() && write("C0039", 1 << 40).is_err());
    assert_eq!(write("1/3", 7), Ok((STORE, 0)), "and that is refused without its bytes");
    let long = Codes.write_long("1/3", "01 02 03 04 05 06 07 08 09").unwrap();
    let calls: Vec<_> = long.iter().map(|call| (call.service, call.value)).collect();
    assert_eq!(calls, [(LOAD, 0x0807_0605_0403_0201), (LOAD, 9), (STORE, 9)]);
    let text = Codes.write_long("C0200.text", "left axis").unwrap();
    let calls: Vec<_> = text.iter().map(|call| (call.service, call.value)).collect();
    assert_eq!(calls, [(LOAD, u64::from_le_bytes(*b"left axi")), (LOAD, u64::from(b's')), (STORE, 9)]);
    assert!(Codes.write_long("C0039", "1").is_none() && Codes.write_long("C0200.text", "\n").is_none());
}
