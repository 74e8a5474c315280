//! The link layer: silence, damage, frame count bits, times of answers.

use super::*;

const STATUS: [u8; 6] = [0x10, SLAVE, MASTER, 0x49, 0x52, 0x16];
const ALIVE: [u8; 6] = [0x10, MASTER, SLAVE, 0, 0x09, 0x16];

#[test]
fn a_request_needs_33_bits_of_silence_before_it_whatever_came_before() {
    for rate in RATES {
        let mut bench = Bench::at(rate, LenzeSettings::new(SLAVE));
        let mut too_early = 0;
        let answer = |bench: &mut Bench, bits_ns: u64| {
            // An answer, then a token, then a request to somebody else, each followed by the request.
            let mut answered = Vec::new();
            for before in [&STATUS[..], &[0xDC, 2, 2], &[0x10, 9, 2, 0x49, 0x54, 0x16]] {
                bench.wait(bench.line.bits_ns(1_000));
                bench.put(before);
                if before == STATUS {
                    let reply = bench.take(bench.line.bits_ns(100)).unwrap();
                    assert_eq!(reply.bytes, ALIVE);
                    // `take` waits for 33 bits.
                    if bits_ns < bench.line.bits_ns(33) {
                        continue;
                    }
                }
                bench.wait(if before == STATUS { 0 } else { bits_ns });
                bench.put(&STATUS);
                answered.push(bench.take(bench.line.bits_ns(100)).is_some());
            }
            answered
        };
        let enough = bench.line.bits_ns(33);
        assert_eq!(answer(&mut bench, enough), [true; 3], "{rate}");
        assert_eq!(bench.slave().misuse().too_early, 0);
        for short in [enough - 2, bench.line.bits_ns(11), 0] {
            let answers = answer(&mut bench, short);
            assert_eq!(answers, [false; 2], "{rate}: {short} ns");
            too_early += 2;
            assert_eq!(bench.slave().misuse().too_early, too_early);
        }
    }
}

#[test]
fn a_slave_counts_what_is_too_early_for_itself_and_tokens_only() {
    let segment = ProfibusSegment::new("x", 1_500_000, [7, 9].map(LenzeSettings::new).into());
    let mut bench = Bench::of(&segment);
    bench.put(&[0xDC, 2, 2]);
    bench.put(&STATUS);
    bench.wait(MS);
    assert_eq!((bench.sim(0).misuse().too_early, bench.sim(1).misuse().too_early), (1, 0));
    bench.put(&[0xDC, 2, 2, 0xDC, 2, 2]);
    bench.wait(MS);
    assert_eq!((bench.sim(0).misuse().too_early, bench.sim(1).misuse().too_early), (2, 1));
}

#[test]
fn damaged_telegrams_are_ignored_each_with_its_count() {
    let good = [0x68, 5, 5, 0x68, 0x87, 0x82, 0x6D, 0x3C, 0x3E, 0xF0, 0x16];
    let broken = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bench = Bench::with(|_| ());
        let mut bytes = good.to_vec();
        change(&mut bytes);
        assert_eq!(bench.ask(&bytes), None, "{bytes:02X?}");
        let broken = bench.slave().broken();
        assert_eq!(bench.slave().misuse(), Misuse::default());
        // The next one is answered.
        assert!(bench.ask(&good).is_some());
        broken
    };
    let none = Broken::default();
    assert_eq!(broken(&|bytes| bytes[0] = 0x67), Broken { start: 1, ..none });
    assert_eq!(broken(&|bytes| bytes[3] = 0x69), Broken { start: 1, ..none });
    assert_eq!(broken(&|bytes| bytes[1] = 6), Broken { length: 1, ..none });
    assert_eq!(broken(&|bytes| (bytes[1], bytes[2]) = (3, 3)), Broken { length: 1, ..none });
    assert_eq!(broken(&|bytes| (bytes[1], bytes[2]) = (250, 250)), Broken { length: 1, ..none });
    assert_eq!(broken(&|bytes| bytes[9] ^= 1), Broken { sum: 1, ..none });
    assert_eq!(broken(&|bytes| bytes[7] ^= 1), Broken { sum: 1, ..none });
    assert_eq!(broken(&|bytes| bytes[10] = 0x17), Broken { end: 1, ..none });
    assert_eq!(broken(&|bytes| (bytes[7], bytes[9]) = (0x7C, 0x30)), Broken { extension: 1, ..none });
    // One that is cut is given up when something else comes.
    let mut bench = Bench::with(|_| ());
    assert_eq!(bench.ask(&good[..7]), None);
    assert!(bench.ask(&good).is_some());
    assert_eq!(bench.slave().broken(), Broken { gap: 1, ..none });
}

#[test]
fn one_character_of_silence_inside_is_allowed_and_more_is_not() {
    for rate in RATES {
        let mut bench = Bench::at(rate, LenzeSettings::new(SLAVE));
        let mut halves = |gap_ns| {
            bench.wait(bench.line.bits_ns(1_000));
            bench.put(&STATUS[..4]);
            bench.wait(gap_ns);
            bench.put(&STATUS[4..]);
            bench.take(bench.line.bits_ns(100)).map(|reply| reply.bytes)
        };
        let character = SerialLine {
            rate,
            parity: fieldbeat_core::net::Parity::Even,
            rs485: fieldbeat_core::net::Rs485::Adapter,
        }
        .span_ns(1);
        assert_eq!(halves(character), Some(ALIVE.to_vec()), "{rate}");
        assert_eq!(halves(character + 1), None, "{rate}");
        assert_eq!(bench.slave().broken().gap, 1);
    }
}

#[test]
fn an_answer_waits_for_the_time_that_is_parametrised_or_set_up() {
    for rate in RATES {
        let most = LinkSettings::default().max_tsdr(rate);
        let bits = |bits: Option<u16>, min: u8| {
            let link = LinkSettings { answer_bits: bits, ..LinkSettings::default() };
            let mut bench = Bench::at(rate, LenzeSettings { link, ..LenzeSettings::new(SLAVE) });
            let mut prm = PRM;
            prm[3] = min;
            bench.set_prm(&prm);
            bench.wait(bench.line.bits_ns(33));
            bench.put(&STATUS);
            let after = bench.take(bench.line.bits_ns(1_000)).unwrap().after;
            let line = bench.line;
            (0..2_000).find(|bits| line.bits_ns(*bits).abs_diff(after) <= 1)
        };
        assert_eq!(bits(None, 11), Some(11), "{rate}");
        assert_eq!(bits(None, 0), Some(11), "{rate}");
        assert_eq!(bits(None, 60), Some(60), "{rate}");
        assert_eq!(bits(Some(40), 11), Some(40), "{rate}");
        assert_eq!(bits(Some(20), 40), Some(40), "{rate}");
        assert_eq!(bits(Some(5_000), 11), Some(most.into()), "{rate}");
    }
}

#[test]
fn a_repeated_frame_count_bit_is_answered_from_memory_and_its_data_are_ignored() {
    let mut bench = Bench::with(|_| ());
    bench.up();
    bench.enable();
    // The first try reaches the slave, its answer is lost; the second one wants another speed.
    let data = |set_point: [u8; 2]| [&[0; 8][..], &[0, 0x7F], &set_point].concat();
    let function = if bench.fcb == Some(true) { 0x7D } else { 0x5D };
    let first = bench.frame(None, function, &data([0x10, 0]));
    let answer = bench.ask(&first).unwrap();
    assert_eq!(bench.ask(&first), Some(answer.clone()));
    assert_eq!((bench.slave().repeated(), bench.slave().misuse()), (1, Misuse::default()));
    let second = bench.frame(None, function, &data([0x40, 0]));
    for _ in 0..200 {
        assert_eq!(bench.ask(&second), Some(answer.clone()));
    }
    let misuse = bench.slave().misuse();
    assert_eq!((misuse.changed_retry, misuse.total()), (200, 200));
    // 0x1000 is a quarter of 1500 rpm; the watchdog was fed.
    bench.wait(90 * MS);
    assert!((bench.rpm() - 375.0).abs() < 1.0, "{}", bench.rpm());
    // Over all services: a diagnosis with the same bit gets the old answer, too.
    let diagnosis = bench.frame(Some((60, 62)), function, &[]);
    assert_eq!(bench.ask(&diagnosis), Some(answer));
    // The next new one counts.
    bench.fcb = Some(function == 0x5D);
    bench.words(0x7F, 0x2000);
    bench.hold(300 * MS, 0x7F, 0x2000);
    assert!((bench.rpm() - 750.0).abs() < 1.0);
}

#[test]
fn a_first_request_starts_over_and_each_master_has_its_own_memory() {
    let mut bench = Bench::with(|_| ());
    let diagnosis = |bench: &Bench, function| bench.frame(Some((60, 62)), function, &[]);
    let first = diagnosis(&bench, 0x6D);
    for _ in 0..3 {
        assert!(bench.ask(&first).is_some());
    }
    // Behind a first one, with the bit set, the next has it clear.
    let same = diagnosis(&bench, 0x7D);
    assert!(bench.ask(&same).is_some());
    assert_eq!((bench.slave().repeated(), bench.slave().misuse().changed_retry), (1, 1));
    let next = diagnosis(&bench, 0x5D);
    bench.ask(&next);
    assert_eq!(bench.slave().repeated(), 1);
    bench.master = 3;
    let other = diagnosis(&bench, 0x5D);
    bench.ask(&other);
    assert_eq!(bench.slave().repeated(), 1, "another pair of stations");
    bench.ask(&other);
    assert_eq!(bench.slave().repeated(), 2);
    // No bit at all.
    let none = diagnosis(&bench, 0x4D);
    assert_eq!((bench.ask(&none), bench.slave().misuse().frame_count), (None, 1));
}

#[test]
fn what_is_not_for_it_or_not_a_request_is_not_answered() {
    let mut bench = Bench::with(|_| ());
    bench.slave = 8;
    let other = bench.frame(Some((60, 62)), 0x6D, &[]);
    assert_eq!(bench.ask(&other), None);
    bench.slave = SLAVE;
    for function in [0x08, 0x00, 0x0A, 0x2D] {
        let reply = bench.frame(Some((60, 62)), function, &[]);
        assert_eq!(bench.ask(&reply), None, "{function:X}");
    }
    assert_eq!(bench.ask(&[0xE5]), None);
    assert_eq!(bench.slave().misuse(), Misuse::default());
    for function in [0x60, 0x61, 0x62, 0x68, 0x6A, 0x6B] {
        let unknown = bench.frame(Some((60, 62)), function, &[]);
        assert_eq!(bench.ask(&unknown), None, "{function:X}");
    }
    assert_eq!(bench.slave().misuse(), Misuse { function: 6, ..Misuse::default() });
    bench.master = SLAVE;
    let own = bench.frame(Some((60, 62)), 0x6D, &[]);
    assert_eq!((bench.ask(&own), bench.slave().misuse().source), (None, 1));
    (bench.master, bench.slave) = (MASTER, 127);
    let all = bench.frame(Some((60, 62)), 0x6D, &[]);
    assert_eq!(bench.ask(&all), None);
    bench.slave = SLAVE;
    assert_eq!(bench.slave().misuse().broadcast, 1);
}

#[test]
fn access_points_that_there_are_not_and_refusals_have_their_function_code() {
    let mut bench = Bench::with(|_| ());
    for saps in [(55, 62), (60, 61), (51, 50), (50, 51), (0, 62)] {
        assert_eq!(bench.srd(Some(saps), &[]), Some((3, vec![])), "{saps:?}");
    }
    assert_eq!(bench.slave().misuse(), Misuse { access_point: 5, ..Misuse::default() });
    assert_eq!(bench.srd(Some((60, 62)), &[1]), Some((1, vec![])));
    assert_eq!(bench.slave().misuse().length, 1);
    bench.slave().refuse(2, 2);
    assert_eq!(bench.srd(Some((60, 62)), &[]), Some((2, vec![])));
    assert_eq!(bench.srd(Some((60, 62)), &[]), Some((2, vec![])));
    assert_eq!(bench.srd(Some((60, 62)), &[]).unwrap().0, 8);
    // SDA, ident and LSAP status are not served.
    for function in [0x63, 0x7E, 0x7F] {
        let frame = bench.frame(None, function, &[]);
        let answer = bench.ask(&frame).unwrap();
        assert_eq!(bench.open(&answer, None), (3, vec![]), "{function:X}");
    }
}

#[test]
fn who_speaks_into_an_answer_is_counted_and_both_are_lost() {
    let mut bench = Bench::with(|_| ());
    bench.put(&STATUS);
    // Before the answer begins: 11 bits.
    bench.wait(bench.line.bits_ns(9));
    bench.put(&STATUS);
    let reply = bench.take(bench.line.bits_ns(500)).unwrap();
    assert!(reply.bytes.iter().take(5).all(|byte| *byte == 0), "{reply:?}");
    assert_eq!(bench.slave().misuse(), Misuse { interrupted: 1, ..Misuse::default() });
    assert_eq!(bench.ask(&STATUS), Some(ALIVE.to_vec()));
}

#[test]
fn it_is_silent_without_power_and_knows_nothing_afterwards() {
    let mut bench = Bench::with(|_| ());
    bench.up();
    bench.medium.restart(bench.now, 0);
    bench.wait(400 * MS);
    assert_eq!(bench.ask(&STATUS), None);
    bench.wait(100 * MS);
    // The master does not know: its bit goes on, and is new to the slave.
    assert_eq!(bench.exchange(&[0; 12]), (3, vec![]));
    assert_eq!(bench.diagnose(), [2, 5, 0, 255, 0, 0x82]);
    assert_eq!((bench.slave().repeated(), bench.slave().misuse()), (0, Misuse::default()));
}
