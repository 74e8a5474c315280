//! SIIs that belong to the slave's processor, are busy, or return eight bytes.

use super::*;
use fieldbeat_ethercat::wire::sii::Fault;
use fieldbeat_sim::ethercat::{SiiContent, SiiSettings};

/// An SII whose commands take no time.
fn quick() -> SiiSettings {
    SiiSettings { busy_ns: 0, ..SiiSettings::default() }
}

/// Terminals whose SII is accessed like this.
fn with(access: SiiSettings) -> Rig {
    Rig::io(&terminals(), Settings { sii_access: access, ..Settings::default() })
}

#[test]
fn a_slave_that_is_refused_or_left_has_its_sii_back() {
    let mut rig = Rig::with_other(1, 0);
    rig.until("refused", 500, |rig| matches!(rig.note(0), Note::Product(_)));
    assert_eq!(rig.peek(0, address::SII_OWNER, 1), [1]);
    // The orderly end comes while it is read.
    for cycles in 3..40 {
        let mut rig = Rig::new(&drives(1));
        rig.run(cycles);
        rig.down(100);
        // Force and give are the second and the third request.
        assert_eq!(rig.peek(0, address::SII_OWNER, 1), [1], "after {cycles} cycles");
    }
}

#[test]
fn an_sii_that_its_processor_keeps_is_named_unless_nothing_of_it_is_needed() {
    for is_needed in [true, false] {
        let mut plan = terminals();
        plan.devices[0].slave.check_sii = is_needed;
        let mut rig = Rig::io(&plan, Settings::default());
        for _ in 0..1_000 {
            rig.poke(0, address::SII_OWNER, &[1]);
            rig.run(1);
            assert_ne!(rig.note(0), Note::Absent);
        }
        let note = if is_needed { Note::Sii(Fault::Owned) } else { Note::None };
        assert_eq!((rig.note(0), rig.line.is_operational(0)), (note, !is_needed));
    }
}

#[test]
fn a_command_is_written_to_an_idle_sii_and_repeated_if_it_fails() {
    let usual = quick;
    let failing = |fails_every| (SiiSettings { fails_every, ..usual() }, None);
    for (access, left) in [
        // Commands of 40 ms: one of another master is under way.
        (SiiSettings { busy_ns: 40 * MS, ..usual() }, Some([0x00, 0x01, 0x40, 0, 0, 0])),
        // One of so many reads fails: never twice in a row, and in the end each of them.
        failing(2),
        failing(3),
        failing(5),
        // Another master's has failed.
        (usual(), Some([0x00, 0x07, 0, 0, 0, 0])),
    ] {
        let what = format!("{access:?}");
        let mut rig = with(access);
        if let Some(command) = left {
            rig.poke(0, address::SII_CONTROL, &command);
            let shown = rig.peek(0, address::SII_CONTROL, 2)[1];
            assert_ne!(shown & if command[1] == 7 { 0x20 } else { 0x80 }, 0, "{what}");
        }
        rig.all_up(2_000);
        assert_eq!(rig.note(0), Note::None, "{what}");
    }
}

#[test]
fn an_sii_that_always_fails_or_is_not_loaded_or_not_written_is_named() {
    let named = |mut rig: Rig, fault| {
        rig.until("named", 1_000, |rig| rig.note(0) == Note::Sii(fault));
        rig.run(500);
        assert_eq!((rig.al(0), rig.note(0)), (AlState::Init, Note::Sii(fault)));
    };
    named(with(SiiSettings { fails_every: 1, ..quick() }), Fault::Refused);
    named(with(SiiSettings { content: SiiContent::Unloaded, ..quick() }), Fault::Unloaded);
    let mut plan = terminals();
    plan.devices[0].slave.identity.vendor = Some(2);
    let settings = Settings { sii: vec![0xFFFF; 64], features: 0x0180, ..Settings::default() };
    let blank = Esc::new(settings, Box::new(Coupler::of(&plan.devices[0])));
    named(Rig::of(&plan, vec![blank]), Fault::Checksum);
}

#[test]
fn eight_bytes_a_read_are_taken_and_save_time() {
    let cycles =
        [false, true].map(|eight| with(SiiSettings { busy_ns: 10 * MS, eight, ..quick() }).all_up(1_000));
    // Six reads of four bytes, four of eight; and the categories.
    assert!(cycles[1] + 30 < cycles[0], "{cycles:?}");
}

#[test]
fn a_slave_is_known_by_what_it_says_of_itself_before_anything_of_it_is_set() {
    // The expected numbers, those that it has, how its AL status shows an error, and what is said of it.
    let expected =
        |serial, alias, identification| Expected { serial, alias, identification, ..Expected::default() };
    for (expected, there, left, note) in [
        (expected(Some(5), None, None), (5, 0, None), false, Note::None),
        (expected(Some(5), None, None), (6, 0, None), false, Note::Serial(6)),
        (expected(None, Some(5), None), (0, 5, None), false, Note::None),
        (expected(None, Some(5), None), (0, 0, None), false, Note::Alias { found: 0, wanted: 5 }),
        (expected(None, Some(0), None), (0, 5, None), false, Note::Alias { found: 5, wanted: 0 }),
        (expected(None, None, Some(5)), (0, 0, Some(5)), false, Note::None),
        // An error that another master has left is acknowledged with the request.
        (expected(None, None, Some(5)), (0, 0, Some(5)), true, Note::None),
        (expected(None, None, Some(5)), (0, 0, Some(0)), true, Note::Identification { found: 0, wanted: 5 }),
        (expected(None, None, Some(5)), (0, 0, None), false, Note::NoIdentification),
        (expected(Some(5), Some(6), Some(7)), (5, 6, Some(7)), false, Note::None),
        (
            expected(Some(5), Some(6), Some(7)),
            (5, 6, Some(8)),
            false,
            Note::Identification { found: 8, wanted: 7 },
        ),
    ] {
        for check_sii in [true, false] {
            let mut plan = drives(1);
            let mut whole = EthercatSegment::from(&plan);
            let (serial, alias, identification) = there;
            whole.drives[0].serial = serial;
            let left = left.then(|| ethercat::Left::by_another(0, (0x14, 0x001B)));
            let own =
                ethercat::SlaveSettings { alias: Some(alias), identification, left, ..Default::default() };
            whole.settings.slaves.insert(0, own);
            plan.drives[0].slave.identity = expected;
            plan.drives[0].slave.check_sii = check_sii;
            let mut rig = Rig::on(&plan, whole);
            rig.run(4_000);
            assert_eq!(rig.note(0), note, "{expected:?} {there:?}");
            let is_up = rig.line.is_operational(0);
            assert_eq!(is_up, note == Note::None, "{expected:?} {there:?}");
            // Neither its state nor its address was set before.
            let station = rig.peek(0, address::STATION, 2);
            let own = FIRST_STATION.to_le_bytes();
            assert_eq!(station == own, is_up, "{expected:?} {there:?}: {station:?}");
        }
    }
}
