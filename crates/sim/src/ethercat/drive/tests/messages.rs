//! PDOs, objects, and the mailbox.

use super::*;

#[test]
fn pdos_are_selected_in_pre_op_only_and_in_the_order_of_the_manual() {
    let mut bench = Bench::pre_op(|_| {});
    assert_eq!(bench.drive.sizes(), (6, 8));
    assert_eq!(bench.write("0x1C12:1", &[0x03, 0x17]), Err(abort::NOT_ZERO));
    bench.write("0x1C12:0", &[0]).unwrap();
    assert_eq!(bench.drive.sizes(), (0, 8));
    assert_eq!(bench.enter(AlState::SafeOp), Err(AlCode::SYNC_MANAGER));
    assert_eq!(bench.write("0x1C12:1", &[0x03, 0x1B]), Err(AbortCode::RANGE), "an input");
    assert_eq!(bench.write("0x1C12:1", &[0x25, 0x17]), Err(AbortCode::RANGE), "an AKD's");
    bench.write("0x1C12:1", &[0, 0]).unwrap();
    assert_eq!(bench.write("0x1C12:0", &[1]), Err(abort::INCOMPATIBLE));
    bench.write("0x1C12:1", &[0x03, 0x17]).unwrap();
    bench.write("0x1C12:0", &[1]).unwrap();
    assert_eq!(bench.drive.sizes(), (4, 8));
    assert_eq!(bench.drive.check_sizes(4, 8), Ok(()));
    assert_eq!(bench.drive.check_sizes(6, 8), Err(AlCode::SYNC_MANAGER));
    bench.enter(AlState::SafeOp).unwrap();
    assert_eq!(bench.write("0x1C12:0", &[0]), Err(AbortCode::STATE));
}

#[test]
fn an_akd_distinguishes_wrong_lengths_and_has_mode_8() {
    let mut bench = Bench::of(Family::Akd, |_| {});
    bench.enter(AlState::PreOp).unwrap();
    assert_eq!(bench.drive.check_sizes(5, 6), Err(AlCode(0x001D)));
    assert_eq!(bench.drive.check_sizes(6, 5), Err(AlCode(0x001E)));
    assert_eq!(bench.write("0x6060:0", &[0x85]), Err(AbortCode::RANGE));
    bench.write("0x6060:0", &[8]).unwrap();
    bench.select(0x1C12, 0x1724);
    bench.select(0x1C13, 0x1B20);
    bench.go_to_op();
    assert_eq!(bench.inputs.len(), 32);
    bench.enable();
    for cycle in 1..=500 {
        bench.put(TARGET_POSITION, cycle * 1_000);
        bench.cycle();
    }
    bench.cycles(50);
    assert!((bench.got(INCREMENTS) - 500_000).abs() < 2_000, "{}", bench.got(INCREMENTS));
    assert_eq!(bench.got(POSITION_2), bench.got(INCREMENTS));
}

#[test]
fn modes_are_those_of_the_can_manual() {
    let mut bench = Bench::pre_op(|_| {});
    for mode in 0..=u8::MAX {
        let written = bench.write("0x6060:0", &[mode]);
        let expected = matches!(mode, 1 | 3 | 4 | 6 | 7 | 0x80..=0x88);
        assert_eq!(written, if expected { Ok(()) } else { Err(AbortCode::RANGE) }, "{mode:#04x}");
        if expected {
            assert_eq!(bench.read("0x6061:0"), Ok((mode as i8).into()));
        }
    }
}

#[test]
fn objects_are_refused_by_the_codes_of_the_manual() {
    let mut bench = Bench::pre_op(|_| {});
    assert_eq!(bench.read("0x5FFF:1"), Err(AbortCode::NO_OBJECT));
    assert_eq!(bench.read("0x6041:7"), Err(AbortCode::NO_SUB));
    assert_eq!(bench.write("0x6041:0", &[0, 0]), Err(AbortCode::READ_ONLY));
    assert_eq!(bench.write("0x6040:0", &[0]), Err(AbortCode::LENGTH));
    assert_eq!(bench.write("0x6040:0", &[6, 0]), Ok(()), "it is stored, and obeyed by nobody");
    bench.go_to_op();
    assert_eq!(bench.write("0x6040:0", &[6, 0]), Err(abort::MAPPED));
    assert_eq!(bench.drive.axis_state(), State::SwitchOnDisabled);
    let complete = Request::Upload { object: Object::new(0x1C00, 0), complete: true };
    assert_eq!(bench.ask(&complete), Err(AbortCode::NOT_COMPLETE));
}

#[test]
fn the_mailbox_is_off_in_init_and_speaks_both_dialects() {
    let mut bench = Bench::new(|settings| settings.dialect = Dialect::Manual);
    let select = [0x0A, 0, 0, 0, 0, 0x03, 0, 0x20, 0x2F, 0x12, 0x1C, 0, 0, 0, 0, 0];
    let mut reply = Vec::new();
    assert!(!bench.drive.mailbox(&select, &mut reply));
    bench.enter(AlState::PreOp).unwrap();
    assert!(bench.drive.mailbox(&select, &mut reply));
    assert_eq!(reply, [0x0E, 0, 0, 0, 0, 0x03, 0, 0x20, 0x60, 0x12, 0x1C, 0, 0, 0, 0, 0]);
    assert_eq!(bench.read("0x1018:1"), Ok(0x6A));
}

#[test]
fn an_emergency_comes_in_place_of_the_answer_and_the_answer_behind_it() {
    let mut bench = Bench::pre_op(|_| {});
    bench.drive.provoke(Fault::MOTOR_TEMPERATURE);
    let mut request = [0; SDO_SIZE];
    let object = Object::new(0x1001, 0);
    emit(&Request::Upload { object, complete: false }, bench.counter.next(), &mut request);
    let mut reply = Vec::new();
    assert!(bench.drive.mailbox(&request, &mut reply));
    assert!(matches!(parse(&reply), Some(Message::Emergency(Emergency { code: 0x4310, register: 8, .. }))));
    assert!(bench.drive.message(&mut reply));
    let response = Response::Value { object, data: &[9] };
    assert_eq!(parse(&reply), Some(Message::Sdo { counter: 1, response }));
    assert!(!bench.drive.message(&mut reply));
}
