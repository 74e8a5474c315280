//! Functions, exceptions and silent refusals (SI-Ethernet guide, Commander SE guide).

use super::*;
use proptest::prelude::*;

const ADDRESS: Option<ExceptionCode> = Some(ExceptionCode::ADDRESS);
const FUNCTION: Option<ExceptionCode> = Some(ExceptionCode::FUNCTION);

/// FC16 of the M701 manual, page 129: 12345 to Pr 20.021 ... 20.023.
const SEED_WRITE: &str = "002A 0000 0013 FF10 47E4 0006 0C 00003039 00003039 00003039";
const SEED_WRITTEN: &str = "002A 0000 0006 FF10 47E4 0006";
/// FC23 of the SI-Ethernet guide: the same, and reads Pr 20.024 ... 20.026.
const GUIDE_READ_WRITE: &str = "002A 0000 0017 FF17 47E7 0006 47E4 0006 0C 00003039 00003039 00003039";

fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text
        .bytes()
        .filter(|byte| *byte != b' ')
        .map(|byte| (byte as char).to_digit(16).unwrap() as u8)
        .collect();
    digits.chunks(2).map(|pair| pair[0] << 4 | pair[1]).collect()
}

/// What a well-formed message gets back, without its header.
fn answer(bench: &mut Bench, pdu: &[u8]) -> Vec<u8> {
    let mut adu = vec![0, 7, 0, 0, 0, pdu.len() as u8 + 1, DRIVE_UNIT];
    adu.extend_from_slice(pdu);
    bench.raw(&adu).get(7..).unwrap_or_default().to_vec()
}

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
fn other_functions_get_exception_01() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(answer(&mut bench, &[4, 0x00, 0x78, 0, 1]), [0x84, 1]);
    for function in (1..0x80).filter(|function| ![3, 6, 16, 23].contains(function)) {
        assert_eq!(answer(&mut bench, &[function, 0, 0, 0, 1]), [0x80 | function, 1]);
    }
    // Already an exception: it stays one, and is one all the same.
    assert_eq!(answer(&mut bench, &[0x83, 2]), [0x83, 1]);
}

#[test]
fn wrong_counts_and_reserved_addresses_are_exception_02_in_every_direction() {
    let mut bench = Bench::new(|settings| settings.interface.holes = Holes::Zero);
    for (address, counts, exception) in [
        (0x47E4, &[REGISTERS_MAX][..], None),
        // None, half a parameter, too many.
        (0x47E4, &[0, 1, 3, 5, 121, 122, 125, u16::MAX], ADDRESS),
        (0x8000, &[2], ADDRESS),
        (0xC078, &[2], ADDRESS),
        (0xFFFF, &[2], ADDRESS),
        (0x3FFF, &[2], ADDRESS),
        // The last menu, and what would run out of the addresses.
        (0x7FAA, &[2], None),
        (0x7FAA, &[4], ADDRESS),
        (0x3FAA, &[2], ADDRESS),
    ] {
        for count in counts {
            let read = Request::Read { address, count: *count };
            assert_eq!(bench.exception(&read), exception, "{address:04X}h, {count}");
        }
    }
    assert_eq!(answer(&mut bench, &[3, 0x47, 0xE4, 0, 121]), [0x83, 2]);
    let bytes = [1; 242];
    let data = |length| Registers::new(&bytes[..length]).unwrap();
    let write = 0x47E4;
    for request in [
        Request::Write { address: write, data: data(242) },
        Request::Write { address: write, data: data(6) },
        Request::Write { address: write, data: data(0) },
        Request::ReadWrite { read: write, count: 2, write, data: data(242) },
        // Nothing is written even if only the reading is wrong.
        Request::ReadWrite { read: write, count: 0, write, data: data(4) },
        Request::ReadWrite { read: write, count: 3, write, data: data(4) },
        Request::ReadWrite { read: write, count: 121, write, data: data(4) },
        Request::ReadWrite { read: 0x8000, count: 2, write, data: data(4) },
    ] {
        assert_eq!(bench.exception(&request), ADDRESS, "{request:?}");
    }
    assert_eq!(bench.read(APPLICATION), 0);
    // A server may take fewer than the drive.
    let mut bench = Bench::new(|settings| settings.interface.registers = 6);
    for (count, exception) in [(6, None), (8, ADDRESS)] {
        assert_eq!(bench.exception(&Request::Read { address: 0x47E4, count }), exception, "{count}");
    }
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
fn function_16_stops_at_a_value_out_of_range_and_counts_what_it_has_written() {
    let mut bench = Bench::new(|_| {});
    let preset = Parameter::REFERENCE;
    assert_eq!(bench.write_block(preset, &[100, 200, 9_999_999, 400]), 4);
    assert_eq!(bench.read_block(preset), [100, 200, 0, 0]);
    assert_eq!(bench.write_block(preset, &[9_999_999]), 0);
}

#[test]
fn a_read_only_parameter_is_refused_as_a_value_out_of_range_is() {
    let mut bench = Bench::new(|_| {});
    assert!(!bench.try_write(Parameter::SPEED, 100));
    assert!(!bench.try_write(Parameter::STATUS_WORD, 0));
    assert!(!bench.try_write(Parameter::FIRMWARE, 1));
    // 16 bits count registers, one each: 06.041 does not exist, 06.042 and 06.043 do.
    let data = Registers::new(&[0x01, 0x80, 0, 2]).unwrap();
    let block = Request::Write { address: 0x0281, data };
    bench.ask(DRIVE_UNIT, &block, |response| {
        assert_eq!(response, Response::Written { address: 0x0281, count: 1 })
    });
}

#[test]
fn functions_6_and_23_say_nothing_of_what_they_did_not_write() {
    let mut bench = Bench::new(|_| {});
    bench.write(Parameter::REFERENCE, 700);
    let data = longs(&[100, 9_999_999, 300]);
    let address = bench.address(Parameter::REFERENCE, Width::Long);
    let both = Request::ReadWrite { read: address, count: 6, write: address, data: data.registers() };
    bench.ask(DRIVE_UNIT, &both, |response| {
        let Response::ReadWritten { data } = response else { panic!("{response:?}") };
        assert_eq!([0, 1, 2].map(|index| data.long(index)), [Some(100), Some(0), Some(0)]);
    });
    let one = Request::WriteOne { address: 0x0282, value: 2 };
    bench.ask(DRIVE_UNIT, &one, |response| {
        assert_eq!(response, Response::WriteOne { address: 0x0282, value: 2 })
    });
    assert_eq!(bench.read(Parameter::CONTROL_WORD_ENABLE), 0);
}

#[test]
fn a_16_bit_read_shows_the_low_bits_and_a_32_bit_read_the_sign() {
    let mut bench = Bench::new(|_| {});
    bench.write(APPLICATION, 0x1234_5678);
    bench.write(parameter("20.001"), -5);
    bench.ask(DRIVE_UNIT, &Request::Read { address: 0x07E4, count: 1 }, |response| {
        let Response::Read { data } = response else { panic!("{response:?}") };
        assert_eq!(data.word(0), Some(0x5678));
    });
    assert_eq!(bench.read(parameter("20.001")), -5);
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
fn a_foreign_unit_may_be_met_with_silence_and_unit_0_be_answered_by_255() {
    let mut bench = Bench::new(|settings| {
        settings.interface.refuses_units = false;
        settings.interface.answers_as_255 = true;
    });
    let read = Request::Read { address: 0x4468, count: 2 };
    let foreign = bench.request(7, &read);
    assert!(bench.raw(&foreign).is_empty());
    assert!(!bench.sim.hangs_up(MASTER));
    for unit in [0, 255] {
        let request = bench.request(unit, &read);
        let reply = bench.raw(&request);
        assert_eq!(Header::parse(&reply), Some(Header { transaction: bench.transaction, unit: 255 }));
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
                let size = wire_size(rest);
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

fn wire_size(bytes: &[u8]) -> usize {
    fieldbeat_modbus::wire::frame(bytes).unwrap().unwrap()
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
