//! What is wrong with a drive is reported by name, and disturbs nobody else.

use std::collections::BTreeSet;

use fieldbeat::axis::{Command, Link, Outcome, State};
use fieldbeat::sim::profibus::{LenzeSettings, UserPrm};
use fieldbeat::time::{MS, S};

use super::turns::jog;
use super::{Lenze, cycle, wire};

#[test]
fn a_drive_that_does_not_come_into_data_exchange_is_named_with_the_reason_and_the_other_one_turns() {
    type Change = fn(&mut LenzeSettings);
    let cases: [(Change, &[&str]); 4] = [
        (|drive| drive.ident = 0x1234, &["has ident number 0x1234, not 0x0082"]),
        (|drive| drive.dp.user_prm = UserPrm::Exactly(vec![0, 1, 2]), &["Prm_Fault"]),
        (|drive| drive.configuration = vec![0xF3, 0xF2], &["Cfg_Fault", "[F3, F1]"]),
        (|drive| drive.address = 77, &["nobody answers at address 3"]),
    ];
    for (change, parts) in cases {
        let mut m = Lenze::with(wire(1_500_000, 2), cycle(), |wire| change(&mut wire.drives[0]));
        m.until("the other one", 5_000, |sim| sim.feedback(1).link == Link::Online);
        m.done(1, Command::Enable);
        m.post(1, jog(8.0));
        m.turns(1, 8.0);
        let mut notes = BTreeSet::new();
        for _ in 0..2_000 {
            m.sim.run(1);
            notes.extend(m.note(0));
        }
        assert_ne!(m.feedback(0).link, Link::Online);
        let note = m.note(0).expect("it is not in Data_Exchange");
        assert!(parts.iter().all(|part| note.contains(part)), "{note}");
        assert_eq!(Vec::from_iter(notes), [note], "the same each time");
        assert_eq!(m.note(1), None);
        let counters = m.finish();
        assert_eq!((counters[0].answered, counters[1].missed), (0, 0), "{counters:?}");
    }
}

#[test]
fn a_missing_hardware_enable_shows_and_an_enable_fails_by_name() {
    let mut m = Lenze::new(wire(1_500_000, 1), cycle());
    m.online();
    assert!(!m.feedback(0).status.inhibited);
    m.sim.world().inhibit_on(super::PORT, 0, 10 * S);
    m.until("it shows", 100, |sim| sim.feedback(0).status.inhibited);
    let end = m.end(0, Command::Enable);
    assert!(matches!(end, Some(Outcome::Failed(_))), "{end:?}");
}

#[test]
fn a_drive_whose_master_is_gone_coasts_within_its_watchdog() {
    let mut bus = wire(1_500_000, 1);
    bus.drives[0].watchdog.timeout_ns = Some(50 * MS);
    let mut m = Lenze::new(bus, cycle());
    m.ready();
    m.post(0, jog(8.0));
    m.turns(0, 8.0);
    assert!(m.sim.world().unplug_port(super::PORT));
    m.sim.run(52);
    assert!(!m.look(0, |drive, now| drive.truth(now)).powered);
    assert_eq!(m.look(0, |drive, _| drive.axis_state()), State::SwitchOnDisabled);
    assert_eq!(m.look(0, |drive, _| drive.events().watchdogs), 1);
}
