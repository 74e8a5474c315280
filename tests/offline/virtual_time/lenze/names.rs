//! What is wrong with a drive is reported by name, and disturbs nobody else.

use std::collections::BTreeSet;

use fieldbeat::axis::{Command, Link, Outcome, State};
use fieldbeat::time::{MS, S};
use fieldbeat_sim::profibus::{LenzeSettings, UserPrm};

use super::turns::jog;
use super::{Lenze, cycle, own, wire};
use fieldbeat_profibus::counters::Own;

#[test]
fn a_drive_that_does_not_come_into_data_exchange_is_named_with_the_reason_and_the_other_one_turns() {
    type Change = fn(&mut LenzeSettings);
    let cases: [(Change, &[&str]); 4] = [
        (|drive| drive.ident = 0x1234, &["has ident number 0x1234, not 0x0082"]),
        (|drive| drive.dp.user_prm = UserPrm::Exactly(vec![0, 1, 2]), &["Prm_Fault"]),
        (
            |drive| drive.configuration = vec![0xF3, 0xF2],
            &["Cfg_Fault", "[F3, F1]", "wants [0xF3, 0xF2]: set configuration"],
        ),
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
fn a_drive_that_refuses_is_parametrised_again_after_longer_and_longer_pauses() {
    let mut m = Lenze::with(wire(1_500_000, 1), cycle(), |wire| {
        wire.drives[0].configuration = vec![0xF3, 0xF2];
    });
    m.sim.run(40_000);
    let events = m.look(0, |drive, _| drive.events());
    // At once, as soon as one that does not answer, and then 1, 2, 4, 8 and 16 s later.
    assert!((6..=8).contains(&events.parametrised), "{events:?}");
    assert!(events.diagnoses > 4 * events.parametrised, "it is diagnosed meanwhile: {events:?}");
    // One that was away is a new one.
    m.sim.world().restart_on(super::PORT, 0);
    m.sim.run(3_000);
    let again = m.look(0, |drive, _| drive.events()).parametrised - events.parametrised;
    assert!((2..=4).contains(&again), "{again}");
    assert_eq!(m.misuse(0).total(), 0, "{:?}", m.misuse(0));
}

#[test]
fn an_exchange_that_a_drive_cannot_take_now_is_missed_and_costs_no_start_up() {
    // User error and no resource; service not active; and more of the first ones than are a moment.
    for (count, function, start_ups) in [(1, 1, 0), (1, 2, 0), (3, 2, 0), (1, 3, 1), (21, 2, 1)] {
        let mut m = Lenze::new(wire(1_500_000, 1), cycle());
        m.ready();
        m.post(0, jog(8.0));
        m.turns(0, 8.0);
        let before = m.look(0, |drive, _| drive.events());
        m.look(0, |drive, _| drive.refuse(count, function));
        m.sim.run(60);
        assert!(start_ups > 0 || m.speed(0) > 7.5, "{count} of {function}: {}", m.speed(0));
        m.sim.run(2_000);
        let after = m.look(0, |drive, _| drive.events());
        assert_eq!(after.parametrised - before.parametrised, start_ups, "{count} of {function}");
        assert_eq!(m.feedback(0).link, Link::Online);
        assert_eq!(m.misuse(0).total(), 0, "{:?}", m.misuse(0));
        let [counters] = m.finish()[..] else { panic!("one drive") };
        assert_eq!(own(&counters, Own::Refused), u64::from(count), "{count} of {function}: {counters:?}");
        assert!(counters.missed >= 1, "{counters:?}");
    }
}

#[test]
fn a_missing_hardware_enable_shows_and_an_enable_fails_by_name() {
    let mut m = Lenze::new(wire(1_500_000, 1), cycle());
    m.online();
    assert!(!m.feedback(0).status.sto_open);
    m.sim.world().open_sto_on(super::PORT, 0, 10 * S);
    m.until("it shows", 100, |sim| sim.feedback(0).status.sto_open);
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
