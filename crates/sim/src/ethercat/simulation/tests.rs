mod slaves;

use super::super::codec::registers::address;
use super::super::codec::sii::word;
use super::super::tests::Bench;
use super::*;
use crate::ethercat::{SiiContent, SiiSettings};
use fieldbeat_core::time::S;
use fieldbeat_ethercat::{Entry, Type};

/// A drive, nothing, an AKD, and terminals with a mailbox.
fn segment() -> EthercatSegment {
    let mut drives =
        vec![KollmorgenDrive::new("x", 0, Family::S700), KollmorgenDrive::new("y", 2, Family::Akd)];
    drives[0].slave.identity.product = Some(0x0300_0700);
    let area = |start, length| Area { start, length };
    let slave = SlavePlan {
        identity: Expected { product: Some(5), ..Expected::default() },
        mailbox: Some([area(0x1000, 128), area(0x1080, 128)]),
        outputs: vec![area(0x1100, 2)],
        inputs: vec![area(0x1200, 3)],
        ..SlavePlan::new(3)
    };
    let device = Device { name: "io".into(), slave };
    let plan = EthercatPlan { devices: vec![device], ..EthercatPlan::new("local:test", drives) };
    let mut segment = EthercatSegment::from(plan);
    segment.drives[1].identity.product = 77;
    segment
}

fn bench(segment: &EthercatSegment) -> Bench {
    Bench::of(EthercatSim::new(segment).segment)
}

/// The command to read the SII.
fn read_of(word: usize) -> [u8; 6] {
    [0, 1, word as u8, 0, 0, 0]
}

/// Two words of an EEPROM, as far as it answers.
fn sii(bench: &mut Bench, n: u16, at: usize) -> Option<u32> {
    (bench.write(n, address::SII_CONTROL, &read_of(at)) == 1).then_some(())?;
    bench.wait(MS);
    bench.read(n, address::SII_DATA).map(u32::from_le_bytes)
}

#[test]
fn slaves_are_at_their_positions_with_their_identities() {
    let mut bench = bench(&segment());
    assert_eq!(bench.segment.slaves(), 4);
    let identity = |bench: &mut Bench, n| [word::VENDOR, word::PRODUCT].map(|word| sii(bench, n, word));
    assert_eq!(identity(&mut bench, 0), [0x6A, 0x0300_0700].map(Some), "as the plan expects it");
    assert_eq!(identity(&mut bench, 1), [2, 0x044C_2C52].map(Some));
    assert_eq!(identity(&mut bench, 2), [0x6A, 77].map(Some), "made another one than the plan expects");
    assert_eq!(identity(&mut bench, 3), [2, 5].map(Some));
    let mailbox = [0, 1, 2, 3].map(|n| sii(&mut bench, n, word::MAILBOXES));
    assert_eq!(mailbox, [0x0010_1800, 0, 0x0400_1800, 0x0080_1000].map(Some));
    let features = [0, 1, 2, 3].map(|n| bench.read(n, address::FEATURES).map(u16::from_le_bytes));
    assert_eq!(features, [0x018C, 0x0180, 0x018C, 0x0180].map(Some));
    let drives = [0, 1, 2, 3].map(|n| bench.segment.slave(n).unwrap().drive().is_some());
    assert_eq!(drives, [true, false, true, false]);
}

#[test]
fn clocks_delays_and_widths_are_those_of_the_settings() {
    let mut segment = segment();
    segment.settings = SegmentSettings {
        drift_ppm: vec![0.0, 0.0, 100.0],
        delay_ns: 250,
        short_clocks: true,
        ..segment.settings
    };
    segment.plan.devices[0].slave.sync = true;
    let mut sim = EthercatSim::new(&segment);
    assert_eq!((SimSegment::slaves(&sim), SimSegment::delay_ns(&sim)), (4, 2 * 4 * 250));
    let mut at = |place, now| sim.slave(place).unwrap().system_time(Time(now));
    let begin = [0, 2, 3].map(|place| at(place, S));
    assert!(begin[0] != begin[1] && begin[1] != begin[2]);
    let gone = [(0, 0), (2, 1), (3, 2)].map(|(place, n)| at(place, 2 * S) - begin[n]);
    assert_eq!(gone, [S, S + 100_000, S + 100_000], "the last one counts for all behind it");
    sim.cut(Some(2));
    assert_eq!(SimSegment::delay_ns(&sim), 2 * 2 * 250);
}

#[test]
fn a_drive_has_the_pdos_of_its_plan_and_delivers_what_is_left_as_it_is() {
    let mut plan = KollmorgenDrive::new("x", 0, Family::S700);
    let entry = |index, kind| Entry { object: fieldbeat_ethercat::Object::new(index, 0), kind };
    plan.outputs = Layout { pdo: 0x1704, entries: vec![entry(0x6040, Type::U16), entry(0x606B, Type::I32)] };
    plan.fit();
    let usual = DriveSettings::new(plan.family);
    let settings = drive_settings(&plan, usual.clone());
    let of = |settings: &DriveSettings, index| {
        settings.layouts.iter().filter(|pdo| pdo.index == index).cloned().collect::<Vec<_>>()
    };
    assert_eq!(of(&settings, 0x1704), [pdo(&plan.outputs)]);
    assert_eq!(settings.selected, (0x1702, 0x1B03));
    plan.mapping = Mapping::AsIs;
    assert_eq!(drive_settings(&plan, usual.clone()).selected, (0x1704, 0x1B03));
    plan.mapping = Mapping::Free;
    assert_ne!(of(&drive_settings(&plan, usual.clone()), 0x1704), [pdo(&plan.outputs)], "the master maps it");
    // A longer mailbox takes normal and segmented downloads.
    assert_eq!(drive_settings(&plan, usual.clone()).long_sdos, None);
    plan.slave.mailbox = Some([0x1800, 0x1C00].map(|start| Area { start, length: 64 }));
    assert_eq!(drive_settings(&plan, usual).long_sdos, Some(64));
    assert_eq!(terminals(70).bytes(), 70);
    assert_eq!(terminals(33).bytes(), 33);
}

#[test]
fn another_ethertype_and_a_line_that_is_cut_off_do_not_come_back() {
    let mut sim = EthercatSim::new(&segment());
    let frame = |ethertype: u16| {
        let mut frame = [0; 60];
        frame[12..14].copy_from_slice(&ethertype.to_be_bytes());
        frame
    };
    assert!(SimSegment::pass(&mut sim, Time(S), &mut frame(ETHERTYPE)));
    assert!(!SimSegment::pass(&mut sim, Time(S), &mut frame(0x0800)));
    assert!(!SimSegment::pass(&mut sim, Time(S), &mut [1, 2, 3]));
    sim.cut(Some(0));
    assert!(!SimSegment::pass(&mut sim, Time(S), &mut frame(ETHERTYPE)));
    let mut wrong = frame(ETHERTYPE);
    sim.mislabel(&mut wrong);
    assert_eq!(wrong[INDEX], 0x80);
    sim.mislabel(&mut []);
}
