//! What is wrong with a drive is reported by name, and disturbs nobody else.

use std::collections::BTreeSet;

use fieldbeat::axis::{Command, Link, Outcome, State};
use fieldbeat::sim::profibus::{LenzeSettings, UserPrm};
use fieldbeat::time::{MS, S};

use super::turns::jog;
use super::{Lenze, cycle, wire};

/// Drive 0 is changed, and does not come; drive 1 turns. The note on drive 0.
fn refused(change: impl FnOnce(&mut LenzeSettings)) -> String {
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
    assert_eq!(Vec::from_iter(notes), [note.as_str()], "the same each time");
    assert_eq!(m.note(1), None);
    let counters = m.finish();
    assert_eq!((counters[0].answered, counters[1].missed), (0, 0), "{counters:?}");
    note
}

#[test]
fn a_wrong_ident_number_is_named() {
    let note = refused(|drive| drive.ident = 0x1234);
    assert!(note.contains("has ident number 0x1234, not 0x0082"), "{note}");
}

#[test]
fn a_refused_parametrisation_is_named() {
    let note = refused(|drive| drive.dp.user_prm = UserPrm::Exactly(vec![0, 1, 2]));
    assert!(note.contains("Prm_Fault"), "{note}");
}

#[test]
fn a_refused_configuration_is_named() {
    let note = refused(|drive| drive.configuration = vec![0xF3, 0xF2]);
    assert!(note.contains("Cfg_Fault") && note.contains("[F3, F1]"), "{note}");
}

#[test]
fn nobody_at_an_address_is_named() {
    let note = refused(|drive| drive.address = 77);
    assert!(note.contains("nobody answers at address 3"), "{note}");
}

#[test]
fn a_fault_is_named_by_the_diagnosis_and_reset_by_an_edge() {
    let mut m = Lenze::new(wire(1_500_000, 1), cycle());
    m.ready();
    m.post(0, jog(8.0));
    m.turns(0, 8.0);
    m.look(0, |drive, _| drive.provoke(0x2310));
    m.until("its fault", 200, |sim| sim.feedback(0).status.state == State::Fault);
    m.until("its name", 20, |sim| sim.feedback(0).status.fault == 0x2310);
    m.done(0, Command::ResetFault);
    assert_eq!((m.feedback(0).status.state, m.feedback(0).status.fault), (State::SwitchOnDisabled, 0));
    m.done(0, Command::Reset);
    m.done(0, Command::Enable);
    assert_eq!(m.misuse(0).total(), 0, "{:?}", m.misuse(0));
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
