//! Acyclic access by MSAC1, and the record of parameters.

use super::super::Writer;
use super::super::base_mode::{Address, Format, Head as BaseHead, Outcome, RECORD, Response, Values};
use super::super::errors::ErrorNumber;
use super::super::job::Kind;
use super::super::msac1::{Answer, Function, RECORD_MAX, Record, Refusal};
use super::super::sap::Service;
use super::*;

/// Slot 0, the record of parameters.
const PARAMETERS: Record = Record { slot: 0, index: RECORD };

fn value(index: u16) -> Address {
    Address { count: 0, index, subindex: 0 }
}

/// The request to read parameters.
fn put_read(reference: u8, axis: u8, addresses: &[Address], out: &mut Writer<'_>) {
    BaseHead { reference, write: false, axis, count: addresses.len() as u8 }.put(out);
    addresses.iter().for_each(|address| address.put(out));
}

/// The request to write parameters.
fn put_write(reference: u8, axis: u8, parameters: &[(Address, Values<'_>)], out: &mut Writer<'_>) {
    BaseHead { reference, write: true, axis, count: parameters.len() as u8 }.put(out);
    parameters.iter().for_each(|(address, _)| address.put(out));
    parameters.iter().for_each(|(_, values)| values.put(out));
}

/// Formats of the sheet that are no kinds of values of their own.
const BYTE: Format = Format(0x41);
const WORD: Format = Format(0x42);
const DOUBLE: Format = Format(0x43);

fn written(put: impl FnOnce(&mut Writer<'_>)) -> Option<Vec<u8>> {
    let mut out = [0xEE; RECORD_MAX];
    let mut writer = Writer::new(&mut out);
    put(&mut writer);
    writer.finish().map(|size| out[..size].to_vec())
}

#[test]
fn sheet_reads_c0061_by_the_record_47() {
    let request = |fcb| Service::Msac1.head(SLAVE, MASTER, fcb, true);
    let write = emitted(|out| {
        let fill = |out: &mut Writer<'_>| put_read(1, 0, &[value(0x5FC2)], out);
        request(false).emit_with(out, |du| PARAMETERS.put_write(du, fill))
    });
    assert_eq!(write, hex("68 13 13 68 87 82 5C 33 33 5F 00 2F 0A 01 01 00 01 10 00 5F C2 00 00 97 16"));
    golden("68 05 05 68 87 82 7C 33 33 EB 16", request(true), &[]);
    let read = emitted(|out| request(false).emit_with(out, |du| PARAMETERS.put_read(240, du)));
    assert_eq!(read, hex("68 09 09 68 87 82 5C 33 33 5E 00 2F F0 48 16"));

    let answer = |text: &str| {
        let bytes = hex(text);
        let frame = frame(&bytes);
        let Head { da, sa, dsap, ssap, .. } = request(false);
        let reversed = Head { da: sa, sa: da, dsap: ssap, ssap: dsap, ..frame.head };
        assert_eq!(frame.head, reversed);
        // Leaked, so that one line tests one telegram.
        Answer::parse(frame.data.to_vec().leak())
    };
    let done = Answer { function: Function::Write, result: Ok((PARAMETERS, &[][..])) };
    assert_eq!(answer("68 09 09 68 82 87 08 33 33 5F 00 2F 0A 0F 16"), Some(done));
    let why = Refusal { decode: 0x80, code_1: 0xB5, code_2: 0 };
    let busy = Answer { function: Function::Read, result: Err(why) };
    assert_eq!(answer("68 09 09 68 82 87 08 33 33 DE 80 B5 00 8A 16"), Some(busy));
    assert!(why.is_temporary() && why.to_string() == "state conflict (80 B5 00)");
    let Some(Answer { function: Function::Read, result: Ok((record, data)) }) =
        answer("68 13 13 68 82 87 08 33 33 5E 00 2F 0A 01 01 00 01 43 01 00 06 8F B0 9A 16")
    else {
        panic!("a record")
    };
    let response = Response::parse(data).expect("complete");
    let head = BaseHead { reference: 1, write: false, axis: 0, count: 1 };
    assert_eq!((record, response.head, response.failed), (PARAMETERS, head, false));
    let values = Values { format: DOUBLE, bytes: &hex("00 06 8F B0") };
    assert!(response.outcomes().eq([Outcome::Read(values)]));
    assert_eq!(values.first(), Some(430_000));
}

#[test]
fn an_answer_whose_length_is_another_is_none() {
    let parse = |text: &str| Answer::parse(hex(text).leak());
    let why = Refusal { decode: 0x80, code_1: 0xB1, code_2: 0 };
    assert_eq!(parse("DF 80 B1 00"), Some(Answer { function: Function::Write, result: Err(why) }));
    // The last two are an alarm, and what looks like a request of MSAC2.
    let none =
        "|5E|5E 00 2F|5E 00 2F 02 AA|5E 00 2F 01 AA BB|5F 00 2F 01 AA|DE 80 B5 00 00|5C 00 00 00|D1 80 00 00";
    for text in none.split('|') {
        assert_eq!(parse(text), None, "{text}");
    }
    let other = Refusal { decode: 0x81, code_1: 0xB5, code_2: 7 };
    assert!(!other.is_temporary() && other.to_string() == "unknown error (81 B5 07)");
    // What is cut off or goes on is no response.
    let none = "01 01 00|01 03 00 01|01 01 00 02 42 01 00 07|01 01 00 01 42 02 00 07|01 01 00 01 99 01 00 07|\
                01 81 00 01 44 00|01 82 00 01|01 01 00 01 42 01 00 07 00";
    for text in none.split('|') {
        assert_eq!(Response::parse(&hex(text)), None, "{text}");
    }
}

#[test]
fn several_parameters_are_written_in_one_request() {
    let byte = Values { format: BYTE, bytes: &[0x7F] };
    let long = Values { format: Kind::I32.into(), bytes: &[0, 0x16, 0xF3, 0] };
    let parameters = [(value(0x5FD8), long), (Address { count: 1, subindex: 2, ..value(0x5FFC) }, byte)];
    let bytes = written(|out| put_write(0x23, 1, &parameters, out)).expect("fits");
    let expected = "23 02 01 02  10 00 5F D8 00 00  10 01 5F FC 00 02  04 01 00 16 F3 00  41 01 7F 00";
    assert_eq!(bytes, hex(expected));
    // All well: four bytes. One failed: the others are 40 00.
    let outcomes = |text: &str| {
        let response = Response::parse(hex(text).leak()).expect(text);
        (response.failed, response.outcomes().collect::<Vec<_>>())
    };
    assert_eq!(outcomes("23 02 01 02"), (false, vec![Outcome::Written; 2]));
    let failed = Outcome::Failed(ErrorNumber(2));
    assert_eq!(outcomes("23 82 01 02 40 00 44 01 00 02"), (true, vec![Outcome::Written, failed]));
    let with_info = Outcome::Failed(ErrorNumber(0x11));
    assert_eq!(outcomes("23 82 01 01 44 02 00 11 01 02"), (true, vec![with_info]));
    assert_eq!(ErrorNumber(2).to_string(), "error 02h: a limit is exceeded");
}

#[test]
fn a_read_of_which_one_part_failed_has_the_rest() {
    // A text of odd length between others, with the byte that completes its word and without it.
    for pad in ["00", ""] {
        let text = format!("05 81 00 04 09 03 41 42 43 {pad} 44 01 00 00 03 01 FF FE 41 01 FF {pad}");
        let record = hex(&text);
        let response = Response::parse(&record).expect("complete");
        let read = |format, bytes| Outcome::Read(Values { format, bytes });
        let expected = [
            read(Kind::Text.into(), b"ABC".as_slice()),
            Outcome::Failed(ErrorNumber(0)),
            read(Kind::I16.into(), &[0xFF, 0xFE]),
            read(BYTE, &[0xFF]),
        ];
        assert!(response.failed && response.outcomes().eq(expected), "{pad}");
        let first = |bytes, format| Values { format, bytes }.first();
        assert_eq!(first([0xFF, 0xFE].as_slice(), Kind::I16.into()), Some(-2));
        assert_eq!(first([0xFF].as_slice(), BYTE), Some(255));
    }
}

#[test]
fn a_request_too_long_for_a_record_is_refused() {
    let reads =
        |count: usize| written(|out| put_read(1, 0, &vec![value(1); count], out)).map(|all| all.len());
    assert_eq!((reads(39), reads(40)), (Some(4 + 39 * 6), None));
    let writes = |format: Format, bytes: &[u8]| {
        written(|out| put_write(1, 0, &[(value(1), Values { format, bytes })], out)).map(|all| all.len())
    };
    assert_eq!((writes(WORD, &[0, 1]), writes(WORD, &[0, 1, 2])), (Some(14), None));
    assert_eq!((writes(Format(0x99), &[0]), writes(Format::ZERO, &[0])), (None, None));
    // A telegram has room for more than a record.
    let write = |size: usize| {
        let mut out = [0; MAX];
        let head = Service::Msac1.head(SLAVE, MASTER, true, true);
        head.emit_with(&mut out, |du| PARAMETERS.put_write(du, |out| out.bytes(&vec![0; size])))
    };
    assert_eq!(write(RECORD_MAX), Some(RECORD_MAX + 15));
    assert!((RECORD_MAX + 1..=300).all(|size| write(size).is_none()));
}
