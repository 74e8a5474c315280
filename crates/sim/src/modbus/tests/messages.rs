//! Functions, exceptions and silent refusals (SI-Ethernet guide, Commander SE guide).

use super::*;
use crate::modbus::codec::message;
use crate::testing::hex;
use proptest::prelude::*;

const ADDRESS: u8 = Exception::Address as u8;
const FUNCTION: u8 = Exception::Function as u8;

/// FC16 of the M701 manual, page 129: 12345 to Pr 20.021 ... 20.023.
const SEED_WRITE: &str = "002A 0000 0013 FF10 47E4 0006 0C 00003039 00003039 00003039";
const SEED_WRITTEN: &str = "002A 0000 0006 FF10 47E4 0006";
/// FC23 of the SI-Ethernet guide: the same, and reads Pr 20.024 ... 20.026.
const GUIDE_READ_WRITE: &str = "002A 0000 0017 FF17 47E7 0006 47E4 0006 0C 00003039 00003039 00003039";

#[test]
fn the_block_of_the_m701_manual_is_written_and_read_back() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(bench.raw(&hex(SEED_WRITE)), hex(SEED_WRITTEN));
    let read = hex("002B 0000 0006 FF03 47E4 0006");
    assert_eq!(bench.raw(&read), hex("002B 0000 000F FF03 0C 00003039 00003039 00003039"));
}

#[test]
fn function_23_of_the_si_ethernet_guide_reads_three_other_parameters() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(bench.write_block([20, 24], &[1, -2, i32::MAX]), Ok(6));
    let reply = bench.raw(&hex(GUIDE_READ_WRITE));
    assert_eq!(reply, hex("002A 0000 000F FF17 0C 00000001 FFFFFFFE 7FFFFFFF"));
    assert_eq!(bench.read_block(APPLICATION), [12_345, 12_345, 12_345]);
}

#[test]
fn requests_that_the_drive_does_not_take_are_exceptions_and_write_nothing() {
    let mut bench = Bench::new(|_| {});
    let one = longs(&[5]);
    for (function, words, data, exception) in [
        (4, &[0x47E4, 2][..], &[][..], FUNCTION),
        (1, &[0, 1], &[], FUNCTION),
        // No register, too many, half a parameter, bit 15.
        (function::READ, &[0x47E4, 0], &[], ADDRESS),
        (function::READ, &[0x07D0, 121], &[], ADDRESS),
        (function::READ, &[0x47E4, 3], &[], ADDRESS),
        (function::READ, &[0x87E4, 2], &[], ADDRESS),
        // A hole: 10.029 is the last trip; there is no 10.030, nor 20.041.
        (function::READ, &[10 * 100 + 28, 2], &[], ADDRESS),
        (function::WRITE, &[0x4000 + 2039, 4], &longs(&[5, 5]), ADDRESS),
        (function::READ_WRITE, &[0x4405, 4, 0x47E4, 2], &one, ADDRESS),
        (function::WRITE_ONE, &[0x4282, 1], &[], ADDRESS),
    ] {
        assert_eq!(bench.ask(DRIVE_UNIT, function, words, data), Err(exception), "{function} {words:04X?}");
    }
    assert_eq!((bench.read([20, 40]), bench.read(APPLICATION), bench.read(CONTROL_WORD_ENABLE)), (0, 0, 0));
}

#[test]
fn function_6_takes_16_bits() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(bench.ask(DRIVE_UNIT, function::WRITE_ONE, &[0x0282, 1], &[]), Ok(vec![0x02, 0x82, 0, 1]));
    assert_eq!(bench.read(CONTROL_WORD_ENABLE), 1);
    // To a 32-bit parameter the 16 bits carry their sign.
    bench.ask(DRIVE_UNIT, function::WRITE_ONE, &[0x07E4, 0xFFFE], &[]).unwrap();
    assert_eq!(bench.read(APPLICATION), -2);
}

#[test]
fn units_are_the_drive_its_interface_or_nobody() {
    let mut bench = Bench::new(|_| {});
    let (version, timeout) = (0x4468, 0x4000 + 15 * 100 + 8);
    for (unit, drive, interface) in [
        (0, true, false),
        (255, true, false),
        (4, false, true),
        (254, false, true),
        (1, false, false),
        (3, false, false),
        (7, false, false),
    ] {
        for (address, is_there) in [(version, drive), (timeout, interface)] {
            let answer = bench.ask(unit, function::READ, &[address, 2], &[]);
            assert_eq!(answer.err(), (!is_there).then_some(ADDRESS), "unit {unit}, {address:04X}h");
        }
    }
}

#[test]
fn modified_addressing_counts_256_a_menu() {
    let mut bench = Bench::new(|settings| settings.interface.modified = true);
    bench.write(APPLICATION, 9);
    let read = bench.ask(DRIVE_UNIT, function::READ, &[0x4000 + 20 * 256 + 20, 2], &[]);
    assert_eq!(read, Ok(vec![4, 0, 0, 0, 9]));
    assert_eq!(bench.ask(DRIVE_UNIT, function::READ, &[0x47E4, 2], &[]), Err(ADDRESS));
}

proptest! {
    #[test]
    fn any_split_of_a_stream_gets_the_same_answers(cuts in prop::collection::vec(1..40usize, 1..60)) {
        let mut stream = hex(SEED_WRITE);
        stream.extend(hex(GUIDE_READ_WRITE));
        stream.extend(hex("002C 0000 0006 FF04 0000 0001"));
        stream.extend(hex("002D 0000 0006 FF03 47E4 0006"));
        let whole = Bench::new(|_| {}).raw(&stream);
        let mut bench = Bench::new(|_| {});
        let (mut rest, mut replies) = (&stream[..], Vec::new());
        for cut in cuts.into_iter().cycle() {
            let (front, back) = rest.split_at(cut.min(rest.len()));
            replies.extend(bench.raw(front));
            rest = back;
            if rest.is_empty() {
                break;
            }
        }
        prop_assert_eq!(replies, whole);
    }

    #[test]
    fn no_bytes_make_it_panic_and_every_answer_is_a_whole_message(
        pdus in prop::collection::vec((any::<u16>(), any::<u8>(), prop::collection::vec(any::<u8>(), 1..253)), 1..20),
        garbage in prop::collection::vec(any::<u8>(), 0..300),
    ) {
        let mut bench = Bench::new(|_| {});
        let check = |reply: &[u8]| {
            let mut rest = reply;
            while !rest.is_empty() {
                let size = message(rest).unwrap().unwrap();
                assert!(size > 8, "{rest:02X?}");
                rest = &rest[size..];
            }
        };
        for (transaction, unit, pdu) in pdus {
            let [high, low] = transaction.to_be_bytes();
            let mut adu = vec![high, low, 0, 0, 0, pdu.len() as u8 + 1, unit];
            adu.extend_from_slice(&pdu);
            bench.wait(10 * MS);
            check(&bench.raw(&adu));
            if bench.sim.hangs_up(MASTER) {
                assert!(bench.sim.connect(bench.now, MASTER));
            }
        }
        check(&bench.raw(&garbage));
    }
}

#[test]
fn two_requests_at_once_are_answered_in_order_or_the_second_one_never() {
    for pipelining in [true, false] {
        let mut bench = Bench::new(|settings| settings.interface.pipelining = pipelining);
        let mut both = hex("0001 0000 0006 FF03 47E4 0002");
        both.extend(hex("0002 0000 0006 FF03 47E5 0002"));
        let mut expected = hex("0001 0000 0007 FF03 04 00000000");
        if pipelining {
            expected.extend(hex("0002 0000 0007 FF03 04 00000000"));
        }
        assert_eq!(bench.raw(&both), expected);
        // The next one is answered in both cases, with its own id.
        assert_eq!(bench.raw(&hex("0003 0000 0006 FF03 47E4 0002")), hex("0003 0000 0007 FF03 04 00000000"));
    }
}

#[test]
fn a_wrong_identity_is_another_transaction_and_nothing_else() {
    let mut reply = hex(SEED_WRITTEN);
    let bench = Bench::new(|_| {});
    bench.sim.mislabel(&mut reply);
    assert_eq!((&reply[..2], &reply[2..]), (&[0x80, 0x2A][..], &hex(SEED_WRITTEN)[2..]));
    bench.sim.mislabel(&mut []);
}

#[test]
fn function_23_may_be_refused_or_ignored_or_end_the_connection_or_take_a_few_registers_only() {
    for (read_write, answer, written, hangs_up) in [
        (ReadWrite::Served, Ok(vec![4, 0, 0, 0, 77]), 77, false),
        (ReadWrite::Ignored, Ok(vec![]), 0, false),
        (ReadWrite::Closes, Ok(vec![]), 0, true),
        (ReadWrite::Refused, Err(FUNCTION), 0, false),
        (ReadWrite::UpTo(3), Err(ADDRESS), 0, false),
        (ReadWrite::UpTo(4), Ok(vec![4, 0, 0, 0, 77]), 77, false),
    ] {
        let mut bench = Bench::new(|settings| settings.interface.read_write = read_write);
        let reply = bench.ask(DRIVE_UNIT, function::READ_WRITE, &[0x47E4, 2, 0x47E4, 2], &longs(&[77]));
        assert_eq!((reply, bench.sim.hangs_up(MASTER)), (answer, hangs_up), "{read_write:?}");
        bench.sim.disconnected(bench.now, MASTER);
        assert!(bench.sim.connect(bench.now, MASTER));
        assert_eq!(bench.read(APPLICATION), written, "{read_write:?}");
    }
}
