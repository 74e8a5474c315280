use super::super::Settings;
use super::super::codec::frame::Command::*;
use super::super::codec::registers::AlState as S;
use super::super::tests::{Bench, Script, logical, with_mailbox};
use super::*;
use crate::testing::hex;
use fieldbeat_core::time::MS;

/// The message of the sheet: read 1C00:0.
const REQUEST: &str = "0A00 0000 00 13 0020 40 001C 00 00000000";

fn script(bench: &Bench) -> std::sync::MutexGuard<'_, Script> {
    bench.scripts[0].script()
}

/// The first drive in this state, by the transitions that lead there.
fn at(state: S) -> Bench {
    let mut bench = Bench::drives(|_| {});
    let way: &[S] = match state {
        S::Init => &[S::Init],
        S::PreOp => &[],
        S::Boot => &[S::Init, S::Boot],
        S::SafeOp => &[S::SafeOp],
        S::Op => &[S::SafeOp, S::Op],
    };
    for state in way {
        assert_eq!(bench.go(0, *state), (*state, None));
    }
    script(&bench).requested.clear();
    bench
}

#[test]
fn a_request_and_a_message_stay_until_the_firmware_reads_them_and_no_second_one_is_taken() {
    let mut bench = Bench::new(vec![Settings { reaction_ns: MS, ..with_mailbox() }]);
    bench.set_up(0, 6, 8);
    bench.control(0, S::PreOp as u16);
    assert_eq!(bench.read(0, 0x0220), Some([1, 0, 0, 0]));
    assert_eq!(bench.write(0, address::AL_CONTROL, &[1, 0]), 0);
    assert_eq!(bench.state(0), (S::Init, None));
    bench.wait(MS);
    assert_eq!(bench.state(0), (S::PreOp, None));
    assert_eq!(bench.read(0, 0x0220), Some([0; 4]));
    bench.write(0, 0x1800, &[5; 0x400]);
    assert_eq!(bench.read(0, 0x0805), Some([0x09]));
    assert_eq!(bench.write(0, 0x1800, &[5; 0x400]), 0);
    bench.wait(MS);
    assert_eq!(bench.read(0, 0x0805), Some([0x02]));
    assert_eq!(bench.read::<0x400>(0, 0x1C00).unwrap()[..16], [5; 16]);
    bench.control(0, S::Init as u16);
}

#[test]
fn preop_needs_the_mailboxes_and_safeop_and_op_process_data_of_the_right_lengths() {
    let mut bench = Bench::new(vec![with_mailbox()]);
    assert_eq!(bench.go(0, S::PreOp), (S::Init, Some(0x0016)));
    bench.control(0, 0x11);
    bench.set_up(0, 6, 8);
    assert_eq!(bench.go(0, S::PreOp), (S::PreOp, None));
    for (outputs, inputs, code) in [
        (6, 8, None),
        // As a real drive shows it.
        (5, 8, Some(0x001D)),
        (7, 8, Some(0x001D)),
        (6, 9, Some(0x001E)),
        (6, 0, Some(0x001E)),
        // Three times 22 bytes do not fit between 1100h and 1140h.
        (22, 8, Some(0x0017)),
    ] {
        let mut bench = at(S::PreOp);
        bench.set_up(0, outputs, inputs);
        let expected = code.map_or((S::SafeOp, None), |code| (S::PreOp, Some(code)));
        assert_eq!(bench.go(0, S::SafeOp), expected, "{outputs} {inputs}");
    }
    let mut bench = at(S::SafeOp);
    bench.set_up(0, 6, 7);
    assert_eq!(bench.go(0, S::Op), (S::SafeOp, Some(0x001E)));
}

#[test]
fn the_application_refuses_with_its_own_code_or_delays_a_state() {
    let mut bench = at(S::SafeOp);
    script(&bench).refuses = Some((S::Op, code::SYNCHRONISATION));
    assert_eq!(bench.go(0, S::Op), (S::SafeOp, Some(0x001A)));
    bench.control(0, 0x14);
    script(&bench).refuses = Some((S::Op, code::NONE));
    assert_eq!(bench.go(0, S::Op), (S::SafeOp, None));
    bench.idle(5);
    assert_eq!(bench.state(0), (S::SafeOp, None));
    script(&bench).refuses = None;
    bench.idle(1);
    assert_eq!(bench.state(0), (S::Op, None));
    // Another request ends the waiting.
    bench.go(0, S::SafeOp);
    script(&bench).refuses = Some((S::Op, code::NONE));
    bench.go(0, S::Op);
    assert_eq!(bench.go(0, S::PreOp), (S::PreOp, None));
    script(&bench).refuses = None;
    bench.idle(5);
    assert_eq!(bench.state(0), (S::PreOp, None));
}

#[test]
fn a_slave_that_leaves_op_by_itself_ignores_its_outputs() {
    let mut bench = at(S::Op);
    let image = logical(Lrw, 0x1_0000);
    bench.send(image, &[7; 28]);
    assert_eq!(script(&bench).cycles.last().unwrap().1, [7; 6]);
    script(&bench).drops = Some(code::SYNCHRONISATION);
    bench.idle(1);
    assert_eq!(bench.read(0, address::AL_STATUS), Some([0x14, 0, 0, 0, 0x1A, 0]));
    // They are still counted.
    assert_eq!(bench.send(logical(Lwr, 0x1_0000), &[7; 6]).1, 1);
    assert!(script(&bench).cycles.last().unwrap().1.is_empty());
    bench.control(0, 0x14);
    assert_eq!(bench.go(0, S::Op), (S::Op, None));
}

#[test]
fn a_message_is_answered_once_and_both_mailboxes_show_when_they_are_full() {
    let mut bench = at(S::PreOp);
    let request = hex(REQUEST);
    assert_eq!(bench.read::<16>(0, 0x1C00), None, "empty");
    assert_eq!(bench.write(0, 0x1800, &request), 1);
    assert_eq!(bench.read(0, 0x0805), Some([0]), "its last byte is missing");
    assert_eq!(bench.read(0, 0x080D), Some([0]));
    assert_eq!(bench.write(0, 0x1BFF, &[0]), 1);
    assert_eq!(bench.read(0, 0x0805), Some([0x02]));
    assert_eq!(bench.read(0, 0x080D), Some([0x09]));
    assert_eq!(script(&bench).requests[0].len(), 0x400);
    assert_eq!(script(&bench).requests[0][..16], request);
    let reversed: Vec<u8> = request.iter().rev().copied().collect();
    assert_eq!(bench.read::<16>(0, 0x1C00).unwrap().as_slice(), reversed);
    assert!(bench.read::<16>(0, 0x1C00).is_some(), "not read to its end");
    assert_eq!(bench.read::<1>(0, 0x1FFF), Some([0]));
    assert_eq!(bench.read(0, 0x080D), Some([0x02]));
    assert_eq!(bench.send((Fprd, 0x1001, 0x1FFF), &[9]), (vec![9], 0), "the last byte alone too");
}

#[test]
fn a_lost_answer_is_offered_again() {
    let mut bench = at(S::PreOp);
    let message: Vec<u8> = (0..16).chain(std::iter::repeat_n(0, 0x3F0)).collect();
    bench.write(0, 0x1800, &message);
    let first = bench.read::<0x400>(0, 0x1C00).unwrap();
    assert_eq!(bench.read::<0x400>(0, 0x1C00), None);
    bench.write(0, 0x080E, &[3]);
    assert_eq!(bench.read(0, 0x080F), Some([2]));
    assert_eq!(bench.read::<0x400>(0, 0x1C00), Some(first));
    bench.write(0, 0x080E, &[1]);
    assert_eq!(bench.read(0, 0x080F), Some([0]));
    assert_eq!(bench.read::<0x400>(0, 0x1C00), Some(first));
    // An emergency comes first, and the answer behind it.
    let emergency = hex("0A00 0000 00 03 0010 1043 08 01 00000000");
    script(&bench).messages.push(emergency.clone());
    bench.idle(1);
    bench.write(0, 0x1800, &[5; 0x400]);
    assert_eq!(bench.read::<0x400>(0, 0x1C00).unwrap()[..16], emergency);
    assert_eq!(bench.read::<0x400>(0, 0x1C00).unwrap()[..16], [5; 16]);
}

#[test]
fn in_init_the_mailbox_is_locked_and_forgets() {
    let mut bench = at(S::PreOp);
    bench.write(0, 0x1800, &[5; 0x400]);
    bench.go(0, S::Init);
    assert_eq!(bench.write(0, 0x1800, &[5; 0x400]), 0);
    assert_eq!(bench.read::<0x400>(0, 0x1C00), None);
    bench.go(0, S::PreOp);
    assert_eq!(bench.read::<0x400>(0, 0x1C00), None);
    assert_eq!(bench.read(0, 0x0805), Some([0]));
}
