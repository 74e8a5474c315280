//! The link layer: silence, damage, frame count bits, times of answers.

use super::*;

const STATUS: [u8; 6] = [0x10, SLAVE, MASTER, 0x49, 0x52, 0x16];
const ALIVE: [u8; 6] = [0x10, MASTER, SLAVE, 0, 0x09, 0x16];

#[test]
fn a_request_needs_33_bits_of_silence_before_it_whatever_came_before() {
    for rate in RATES {
        let mut bench = Bench::at(rate, LenzeSettings::new(SLAVE));
        let line = bench.line;
        let (enough, slot) = (line.bits_ns(33), line.bits_ns(100));
        for (silence, answered) in
            [(enough, true), (enough - 2, false), (line.bits_ns(11), false), (0, false)]
        {
            // A token, and a request to somebody else.
            for before in [&[0xDC, 2, 2][..], &[0x10, 9, 2, 0x49, 0x54, 0x16]] {
                bench.wait(line.bits_ns(1_000));
                bench.put(before);
                bench.wait(silence);
                bench.put(&STATUS);
                assert_eq!(bench.take(slot).is_some(), answered, "{rate}: {silence} ns");
            }
        }
        assert_eq!(bench.slave().misuse().too_early, 6);
        // Its own answer; `take` waits for 33 bits.
        for _ in 0..2 {
            bench.put(&STATUS);
            assert_eq!(bench.take(slot).unwrap().bytes, ALIVE, "{rate}");
        }
    }
    // What is for another slave is counted by that alone, a token by both.
    let segment = ProfibusSegment::new("x", 1_500_000, [7, 9].map(LenzeSettings::new).into());
    let mut bench = Bench::of(&segment);
    for (second, counts) in [(&STATUS[..], (1, 0)), (&[0xDC, 2, 2], (2, 1))] {
        bench.put(&[&[0xDC, 2, 2], second].concat());
        bench.wait(MS);
        assert_eq!((bench.sim(0).misuse().too_early, bench.sim(1).misuse().too_early), counts);
    }
}

#[test]
fn damaged_telegrams_are_ignored_each_with_its_count() {
    let good = [0x68, 5, 5, 0x68, 0x87, 0x82, 0x6D, 0x3C, 0x3E, 0xF0, 0x16];
    let none = Broken::default();
    for (changes, expected) in [
        (&[(0, 0x67)][..], Broken { start: 1, ..none }),
        (&[(3, 0x69)], Broken { start: 1, ..none }),
        (&[(1, 6)], Broken { length: 1, ..none }),
        (&[(1, 3), (2, 3)], Broken { length: 1, ..none }),
        (&[(1, 250), (2, 250)], Broken { length: 1, ..none }),
        (&[(9, 0xF1)], Broken { sum: 1, ..none }),
        (&[(7, 0x3D)], Broken { sum: 1, ..none }),
        (&[(10, 0x17)], Broken { end: 1, ..none }),
        (&[(7, 0x7C), (9, 0x30)], Broken { extension: 1, ..none }),
    ] {
        let mut bytes = good;
        changes.iter().for_each(|(at, value)| bytes[*at] = *value);
        let mut bench = Bench::with(|_| ());
        assert_eq!(bench.ask(&bytes), None, "{changes:?}");
        assert_eq!((bench.slave().broken(), bench.slave().misuse()), (expected, Misuse::default()));
        // The next one is answered.
        assert!(bench.ask(&good).is_some());
    }
    // One that is cut is given up when something else comes.
    let mut bench = Bench::with(|_| ());
    assert_eq!(bench.ask(&good[..7]), None);
    assert!(bench.ask(&good).is_some());
    assert_eq!(bench.slave().broken(), Broken { gap: 1, ..none });
}

#[test]
fn a_repeated_frame_count_bit_is_answered_from_memory_and_its_data_are_ignored() {
    let mut bench = Bench::online(|_| ());
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
fn what_is_not_for_it_or_not_a_request_is_not_answered() {
    let none = Misuse::default();
    let functions = [0x60, 0x61, 0x62, 0x68, 0x6A, 0x6B];
    for (master, slave, functions, misuse) in [
        (MASTER, 8, &[0x6D][..], none),
        // Answers.
        (MASTER, SLAVE, &[0x08, 0x00, 0x0A, 0x2D], none),
        (MASTER, SLAVE, &functions, Misuse { function: 6, ..none }),
        (SLAVE, SLAVE, &[0x6D], Misuse { source: 1, ..none }),
        (MASTER, 127, &[0x6D], Misuse { broadcast: 1, ..none }),
    ] {
        let mut bench = Bench::with(|_| ());
        (bench.master, bench.slave) = (master, slave);
        for function in functions {
            let frame = bench.frame(Some((60, 62)), *function, &[]);
            assert_eq!(bench.ask(&frame), None, "{master} {slave} {function:X}");
        }
        assert_eq!(bench.ask(&[0xE5]), None);
        assert_eq!(bench.sim(0).misuse(), misuse, "{master} {slave}");
    }
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
    let mut bench = Bench::online(|_| ());
    bench.medium.restart(bench.now, 0);
    bench.wait(400 * MS);
    assert_eq!(bench.ask(&STATUS), None);
    bench.wait(100 * MS);
    // The master does not know: its bit goes on, and is new to the slave.
    assert_eq!(bench.exchange(&[0; 12]), (3, vec![]));
    assert_eq!(bench.diagnose(), [2, 5, 0, 255, 0, 0x82]);
    assert_eq!((bench.slave().repeated(), bench.slave().misuse()), (0, Misuse::default()));
}
