//! The wire itself, in plain time: 22 us a byte at 500 kbit/s with a parity bit.

use super::*;
use crate::testing::Slave;
use fieldbeat_core::time::US;

const START: Time = Time(1_000_000_000);
const BYTE: u64 = 22 * US;
/// The time of the slaves before they answer.
const TURN: u64 = 22 * US;

/// A wire without faults at this port, with these slaves.
pub(crate) fn wire_at(port: &str, numbers: &[u8]) -> SerialWire {
    let slave = |number: &u8| Box::new(Slave::new(*number)) as Box<dyn SimSerial>;
    SerialWire {
        port: port.into(),
        own_port: None,
        line: Slave::LINE,
        echo: false,
        faults: FaultPlan::default(),
        drives: numbers.iter().map(slave).collect(),
    }
}

fn wire(numbers: &[u8]) -> SerialWire {
    wire_at("/dev/ttyUSB0", numbers)
}

/// Everything that is due by `now`.
fn run(medium: &mut Medium, now: Time) -> usize {
    let mut passed = 0;
    while medium.step(now, &mut |_, _, _| passed += 1) {}
    passed
}

fn read(medium: &mut Medium, now: Time) -> Vec<u8> {
    run(medium, now);
    let mut room = [0; 64];
    let count = medium.read(now, &mut room);
    room[..count].to_vec()
}

fn slave(medium: &mut Medium, k: usize) -> &mut Slave {
    let drive: &mut dyn Any = &mut *medium.wire.drives[k];
    drive.downcast_mut().unwrap()
}

#[test]
fn bytes_take_their_time_and_everybody_receives_everything() {
    let mut medium = Medium::new(wire(&[7, 9]));
    assert_eq!((medium.next_due(), medium.is_readable(START)), (None, false));
    assert_eq!(medium.write(START, &Slave::request(7, 5)), 3);
    // The first one is on the wire.
    assert_eq!(medium.unsent(START), 2);
    assert_eq!(medium.unsent(START + BYTE), 1);
    assert_eq!(medium.unsent(START + 2 * BYTE), 0);
    run(&mut medium, START + (3 * BYTE - 1));
    assert!(slave(&mut medium, 0).received.is_empty());
    run(&mut medium, START + 3 * BYTE);
    let begin = START + (3 * BYTE + TURN);
    assert_eq!(medium.next_due(), Some(begin));
    run(&mut medium, begin);
    // Byte by byte, and not before it has ended.
    assert!(!medium.is_readable(begin + (BYTE - 1)) && medium.is_readable(begin + BYTE));
    assert_eq!(read(&mut medium, begin + BYTE), [135]);
    assert_eq!(read(&mut medium, begin + (3 * BYTE - 1)), [5]);
    assert_eq!(read(&mut medium, begin + 3 * BYTE), [1]);
    let request = Slave::request(7, 5);
    assert_eq!(slave(&mut medium, 0).received, request, "not itself");
    assert_eq!(slave(&mut medium, 1).received, [&request[..], &[135, 5, 1]].concat());
    assert_eq!(medium.next_due(), None);
}

#[test]
fn what_overlaps_is_lost_at_both_and_nothing_else_is() {
    // Two slaves of one number.
    let mut medium = Medium::new(wire(&[7, 7, 8]));
    medium.write(START, &Slave::request(7, 5));
    let end = START + (6 * BYTE + TURN);
    let mut got = read(&mut medium, end);
    assert_eq!((got.len(), got.iter().all(|byte| *byte == 0)), (6, true), "{got:?}");
    // The master speaks into the last byte of an answer.
    medium.write(end, &Slave::request(8, 6));
    let begin = end + (3 * BYTE + TURN);
    run(&mut medium, begin + (2 * BYTE + 1));
    medium.write(begin + (2 * BYTE + 1), &Slave::request(8, 7));
    got = read(&mut medium, begin + 3 * BYTE);
    assert_eq!(got, [136, 6, 0]);
    run(&mut medium, begin + 9 * BYTE);
    // The first byte of it overlapped: no slave knows it.
    let received = &slave(&mut medium, 2).received;
    assert_eq!(received[received.len() - 3..], [0, 7, !7]);
    assert_eq!(read(&mut medium, begin + 99 * BYTE), [0; 0]);
}

#[test]
fn at_12_mbit_s_no_byte_is_early_and_rounding_costs_less_than_a_ns_a_telegram() {
    const LONG: u64 = 7;
    let line = SerialLine { rate: 12_000_000, ..Slave::LINE };
    let mut medium = Medium::new(SerialWire { line, echo: true, ..wire(&[]) });
    for _ in 0..500 {
        medium.write(START, &[1; LONG as usize]);
    }
    for telegram in 0..500 {
        for byte in 1..=LONG {
            // 11 bits of 1000 / 12 ns, of all bytes so far.
            let exact = (telegram * LONG + byte) * 11_000;
            assert!(!medium.is_readable(START + (exact.div_ceil(12) - 1)), "{telegram}: {byte}");
            assert_eq!(read(&mut medium, START + (exact / 12 + telegram + 1)), [1], "{telegram}: {byte}");
        }
    }
    assert_eq!(medium.next_due(), None);
}

/// What the master receives for so many requests, one a millisecond, with these faults.
fn exchange(faults: FaultPlan, count: u8) -> (Vec<Vec<u8>>, Medium) {
    let mut medium = Medium::new(SerialWire { faults, ..wire(&[7, 9]) });
    let received = (0..count).map(|number| {
        let now = START + u64::from(number) * 1_000 * US;
        run(&mut medium, now);
        medium.write(now, &Slave::request(7, number));
        read(&mut medium, now + 999 * US)
    });
    (received.collect(), medium)
}

#[test]
fn each_fault_does_to_telegrams_what_its_name_says() {
    let only = |change: fn(&mut FaultPlan)| {
        let mut plan = FaultPlan { seed: 1, delay_ns: 300 * US, ..FaultPlan::default() };
        change(&mut plan);
        exchange(plan, 4)
    };
    let (received, medium) = only(|_| ());
    assert_eq!((&received[1][..], medium.injected()), (&[135, 1, 2][..], Injected::default()));
    let (received, medium) = only(|plan| plan.drop = 1.0);
    assert_eq!((received.concat().len(), medium.injected().dropped), (0, 4));
    let (received, medium) = only(|plan| plan.wrong_id = 1.0);
    assert_eq!((&received[1][..], medium.injected().wrong_id), (&[135 ^ 0x40, 1, 2][..], 4));
    let (received, medium) = only(|plan| plan.corrupt = 1.0);
    assert_eq!((received.concat().len(), medium.injected().corrupted), (0, 4), "no slave knows its request");
    let (received, medium) = only(|plan| plan.lost_byte = 1.0);
    assert_eq!((received.concat().len(), medium.injected().shortened), (0, 4), "each is too short");
    let (received, medium) = only(|plan| plan.delay = 1.0);
    assert_eq!((&received[1][..], medium.injected().delayed), (&[135, 1, 2][..], 8));
    let (received, medium) = only(|plan| plan.duplicate = 1.0);
    assert_eq!((received[1].len(), medium.injected().duplicated), (6, 8));
    let (received, mut medium) = only(|plan| plan.restart = 1.0);
    assert_eq!((received.concat().len(), medium.injected().restarts), (0, 4));
    assert_eq!((slave(&mut medium, 0).restarts, slave(&mut medium, 1).restarts), (2, 2), "in turn");
    let (_, mut medium) = only(|plan| (plan.sto, plan.sto_ns) = (1.0, 7));
    assert!(slave(&mut medium, 1).sto_open > START);
}
