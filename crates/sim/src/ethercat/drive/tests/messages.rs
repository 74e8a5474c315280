//! PDOs, objects, and the mailbox.

use super::*;
use crate::ethercat::settings::AKD;
use crate::testing::hex;

#[test]
fn pdos_are_selected_in_pre_op_only_and_in_the_order_of_the_manual() {
    let mut bench = Bench::pre_op(|_| {});
    assert_eq!(bench.drive.sizes(), (6, 8));
    assert_eq!(bench.write(0x1C12, 1, &[0x03, 0x17]), Err(abort::NOT_ZERO));
    bench.write(0x1C12, 0, &[0]).unwrap();
    assert_eq!(bench.drive.sizes(), (0, 8));
    assert_eq!(bench.enter(AlState::SafeOp), Err(code::SYNC_MANAGER));
    assert_eq!(bench.write(0x1C12, 1, &[0x03, 0x1B]), Err(abort::RANGE), "an input");
    assert_eq!(bench.write(0x1C12, 1, &[0x25, 0x17]), Err(abort::RANGE), "an AKD's");
    bench.write(0x1C12, 1, &[0, 0]).unwrap();
    assert_eq!(bench.write(0x1C12, 0, &[1]), Err(abort::INCOMPATIBLE));
    bench.write(0x1C12, 1, &[0x03, 0x17]).unwrap();
    bench.write(0x1C12, 0, &[1]).unwrap();
    assert_eq!(bench.drive.sizes(), (4, 8));
    assert_eq!(bench.drive.check_sizes(4, 8), Ok(()));
    assert_eq!(bench.drive.check_sizes(6, 8), Err(code::SYNC_MANAGER));
    bench.enter(AlState::SafeOp).unwrap();
    assert_eq!(bench.write(0x1C12, 0, &[0]), Err(abort::STATE));
}

#[test]
fn a_fixed_pdo_says_what_it_is_made_of_and_stays_so() {
    let mut bench = Bench::pre_op(|_| {});
    for (index, sub, expected) in [
        (0x1702, 0, Ok(vec![2])),
        (0x1702, 1, Ok(vec![32, 0, 0x6B, 0x60])),
        (0x1702, 2, Ok(vec![16, 0, 0x40, 0x60])),
        (0x1702, 3, Err(abort::NO_SUB)),
        (0x1705, 0, Err(abort::NO_OBJECT)),
    ] {
        assert_eq!(bench.bytes(index, sub), expected, "{index:#06x}:{sub}");
    }
    assert_eq!(bench.write(0x1702, 0, &[0]), Err(abort::READ_ONLY));
}

#[test]
fn an_akd_distinguishes_wrong_lengths_and_has_mode_8() {
    let mut bench = Bench::of(Family::Akd, |_| {});
    bench.enter(AlState::PreOp).unwrap();
    assert_eq!(bench.drive.check_sizes(5, 6), Err(0x001D));
    assert_eq!(bench.drive.check_sizes(6, 5), Err(0x001E));
    assert_eq!(bench.write(0x6060, 0, &[0x85]), Err(abort::RANGE));
    bench.write(0x6060, 0, &[8]).unwrap();
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
fn a_mapped_object_is_refused_from_safeop_on() {
    let mut bench = Bench::pre_op(|_| {});
    assert_eq!(bench.write(0x6040, 0, &[6, 0]), Ok(()), "it is stored, and obeyed by nobody");
    bench.go_to_op();
    assert_eq!(bench.write(0x6040, 0, &[6, 0]), Err(abort::MAPPED));
    assert_eq!(bench.drive.axis_state(), State::SwitchOnDisabled);
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
    assert_eq!(bench.read(0x1018, 1), Ok(0x6A));
}

#[test]
fn the_master_maps_its_own_pdo_and_the_drive_obeys_it() {
    let mut bench = Bench::pre_op(|_| {});
    bench.write(0x1C12, 0, &[0]).unwrap();
    assert_eq!(bench.write(0x1C12, 1, &[0x00, 0x16]), Err(abort::RANGE), "it is empty");
    assert_eq!(bench.write(0x1600, 1, &[16, 0, 0x41, 0x60]), Err(abort::NOT_MAPPABLE), "read only");
    bench.write(0x1600, 1, &[16, 0, 0x40, 0x60]).unwrap();
    bench.write(0x1600, 2, &[32, 1, 0xC1, 0x60]).unwrap();
    bench.write(0x1600, 0, &[2]).unwrap();
    // Its count is set; there is no third entry, no ninth one, and no fifth PDO.
    for (object, data, code) in [
        ((0x1600, 1), &[16, 0, 0x40, 0x60][..], abort::NOT_ZERO),
        ((0x1600, 0), &[3], abort::NOT_MAPPABLE),
        ((0x1600, 0), &[9], abort::HIGH),
        ((0x1600, 0), &[2, 0], abort::LENGTH),
        ((0x1600, 9), &[0; 4], abort::NO_SUB),
        ((0x1604, 0), &[0], abort::NO_OBJECT),
    ] {
        assert_eq!(bench.write(object.0, object.1, data), Err(code), "{object:?}");
    }
    assert_eq!([bench.bytes(0x1600, 0), bench.bytes(0x1A03, 0)], [Ok(vec![2]), Ok(vec![0])]);
    bench.select(0x1C12, 0x1600);
    assert_eq!(bench.drive.sizes(), (6, 8));
    assert_eq!(bench.write(0x1600, 0, &[0]), Err(abort::INCOMPATIBLE), "it is selected");
    assert_eq!(bench.bytes(0x1600, 2), Ok(vec![32, 1, 0xC1, 0x60]));
    bench.go_to_op();
    assert_eq!(bench.write(0x1A00, 0, &[0]), Err(abort::STATE));
    assert_eq!(bench.write(0x60C1, 1, &[0; 4]), Err(abort::MAPPED));
    for word in [6, 7] {
        bench.outputs = vec![word, 0, 0, 0, 0, 0];
        bench.cycle();
    }
    assert_eq!(bench.drive.axis_state(), State::SwitchedOn, "the control word stands first");
    bench.drive.restart(bench.now);
    bench.enter(AlState::PreOp).unwrap();
    assert_eq!((bench.drive.sizes(), bench.bytes(0x1600, 0)), ((6, 8), Ok(vec![0])));
}

#[test]
fn a_long_name_is_read_by_its_mailbox_whole() {
    let request = [10, 0, 0, 0, 0, 0x13, 0, 0x20, 0x40, 0x08, 0x10, 0, 0, 0, 0, 0];
    for (family, head, name) in [
        (Family::Akd, "3200 0000 00 13 0030 41 0810 00 28000000", AKD),
        (Family::S700, "0A00 0000 00 13 0030 43 0810 00 53373030", ""),
    ] {
        let mut bench = Bench::of(family, |_| {});
        bench.enter(AlState::PreOp).unwrap();
        let mut reply = Vec::new();
        assert!(bench.drive.mailbox(&request, &mut reply));
        assert_eq!(reply, [&hex(head)[..], name.as_bytes()].concat());
    }
}
