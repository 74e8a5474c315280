//! Functions, exceptions and silent refusals (SI-Ethernet guide, Commander SE guide).

use super::*;
use crate::testing::hex;
use fieldbeat_modbus::wire::frame;
use proptest::prelude::*;

const ADDRESS: Option<ExceptionCode> = Some(ExceptionCode::ADDRESS);
const FUNCTION: Option<ExceptionCode> = Some(ExceptionCode::FUNCTION);

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
    assert_eq!(bench.write_block(parameter("20.024"), &[1, -2, i32::MAX]), 6);
    let reply = bench.raw(&hex(GUIDE_READ_WRITE));
    assert_eq!(reply, hex("002A 0000 000F FF17 0C 00000001 FFFFFFFE 7FFFFFFF"));
    assert_eq!(bench.read_block(APPLICATION), [12_345, 12_345, 12_345]);
}

#[test]
fn a_hole_in_a_block_is_exception_02_or_reads_as_0() {
    // 10.029 is the last trip; there is no 10.030.
    let block = Request::Read { address: 10 * 100 + 28, count: 2 };
    assert_eq!(Bench::new(|_| {}).exception(&block), ADDRESS);
    let mut bench = Bench::new(|settings| {
        settings.interface.holes = Holes::Zero;
        settings.start = Start::Tripped(2);
    });
    let block = Request::Read { address: 10 * 100 + 15, count: 5 };
    bench.ask(DRIVE_UNIT, &block, |response| {
        let Response::Read { data } = response else { panic!("{response:?}") };
        assert!(data.words().eq([0, 0, 0, 0, 2]));
    });
    // Written it is refused all the same, and nothing is written in front of it; nor if it is in what is read.
    let data = longs(&[5; 2]);
    let last = bench.address(parameter("20.040"), Width::Long);
    assert_eq!(bench.exception(&Request::Write { address: last, data: data.registers() }), ADDRESS);
    assert_eq!(bench.read(parameter("20.040")), 0);
    let both = Request::ReadWrite { read: 0x4405, count: 4, write: 0x47E4, data: data.registers() };
    let mut bench = Bench::new(|_| {});
    assert_eq!((bench.exception(&both), bench.read(APPLICATION)), (ADDRESS, 0));
}

#[test]
fn function_6_takes_16_bits_and_no_32_bit_address() {
    let mut bench = Bench::new(|_| {});
    let one = Request::WriteOne { address: 0x0282, value: 1 };
    bench.ask(DRIVE_UNIT, &one, |response| {
        assert_eq!(response, Response::WriteOne { address: 0x0282, value: 1 });
    });
    assert_eq!(bench.read(Parameter::CONTROL_WORD_ENABLE), 1);
    assert_eq!(bench.exception(&Request::WriteOne { address: 0x4282, value: 0 }), ADDRESS);
    assert_eq!(bench.read(Parameter::CONTROL_WORD_ENABLE), 1);
    // To a 32-bit parameter the 16 bits carry their sign.
    bench.exception(&Request::WriteOne { address: 0x07E4, value: 0xFFFE });
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
            let found = bench.ask(unit, &Request::Read { address, count: 2 }, |response| match response {
                Response::Read { .. } => true,
                Response::Exception { code, .. } => code != ExceptionCode::ADDRESS,
                other => panic!("{other:?}"),
            });
            assert_eq!(found, is_there, "unit {unit}, {address:04X}h");
        }
    }
}

#[test]
fn modified_addressing_counts_256_a_menu() {
    let mut bench = Bench::new(|settings| settings.interface.addressing = Addressing::Modified);
    bench.write(APPLICATION, 9);
    assert_eq!(bench.address(APPLICATION, Width::Long), 0x4000 + 20 * 256 + 20);
    assert_eq!(bench.read(APPLICATION), 9);
    assert_eq!(bench.exception(&Request::Read { address: 0x47E4, count: 2 }), ADDRESS);
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
    fn no_bytes_make_it_panic_and_whatever_it_says_is_whole(
        pdus in prop::collection::vec((any::<u16>(), any::<u8>(), prop::collection::vec(any::<u8>(), 1..253)), 1..20),
        garbage in prop::collection::vec(any::<u8>(), 0..300),
    ) {
        let mut bench = Bench::new(|settings| settings.interface.holes = Holes::Zero);
        let check = |reply: &[u8]| {
            let mut rest = reply;
            while !rest.is_empty() {
                let size = frame(rest).unwrap().unwrap();
                assert!(Response::parse(&rest[..size]).is_ok(), "{rest:02X?}");
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
    let data = longs(&[77]);
    let address = APPLICATION.address(Addressing::Standard, Width::Long).unwrap();
    let both = Request::ReadWrite { read: address, count: 2, write: address, data: data.registers() };
    for (read_write, hangs_up) in [(ReadWrite::Ignored, false), (ReadWrite::Closes, true)] {
        let mut bench = Bench::new(|settings| settings.interface.read_write = read_write);
        let bytes = bench.request(DRIVE_UNIT, &both);
        assert!(bench.raw(&bytes).is_empty());
        assert_eq!(bench.sim.hangs_up(MASTER), hangs_up, "{read_write:?}");
        bench.sim.disconnected(bench.now, MASTER);
        assert!(bench.sim.connect(bench.now, MASTER));
        assert_eq!(bench.read(APPLICATION), 0, "nothing was written");
    }
    for (read_write, exception, written) in
        [(ReadWrite::Refused, FUNCTION, 0), (ReadWrite::UpTo(3), ADDRESS, 0), (ReadWrite::UpTo(4), None, 77)]
    {
        let mut bench = Bench::new(|settings| settings.interface.read_write = read_write);
        assert_eq!((bench.exception(&both), bench.read(APPLICATION)), (exception, written), "{read_write:?}");
    }
}
