//! Drives, telegrams and ports that are lost; noise and other masters.

use fieldbeat::axis::{Command, Link, State, StopCause};
use fieldbeat::internals::bus::profibus::counters::Own;
use fieldbeat::sim::FaultPlan;
use fieldbeat::sim::profibus::{ForeignSettings, NoiseSettings};
use fieldbeat::time::{MS, S};

use super::turns::{STOP, jog};
use super::{Lenze, PORT, cycle, own, wire};

fn turning(drives: usize, bucket: u32) -> Lenze {
    let mut bus = wire(1_500_000, drives);
    bus.drives.iter_mut().for_each(|drive| drive.axis.health.bucket = bucket);
    let mut m = Lenze::new(bus, cycle());
    m.ready();
    for index in 0..drives {
        m.post(index, jog(8.0));
        m.turns(index, 8.0);
    }
    m
}

#[test]
fn lost_and_broken_telegrams_are_repeated_with_the_same_bytes() {
    for (seed, faults) in [
        (1, FaultPlan { drop: 0.05, ..FaultPlan::default() }),
        (2, FaultPlan { corrupt: 0.05, ..FaultPlan::default() }),
    ] {
        let mut m = turning(2, 20);
        m.post(1, jog(-4.0));
        m.turns(1, -4.0);
        m.sim.world().set_wire_faults(PORT, FaultPlan { seed, ..faults.clone() });
        for _ in 0..3_000 {
            m.sim.run(1);
            for (index, velocity) in [(0, 8.0), (1, -4.0)] {
                let status = m.feedback(index).status;
                assert!((status.velocity - velocity).abs() < 1.0, "another one's value: {status:?}");
            }
        }
        for index in [0, 1] {
            assert_eq!(
                (m.feedback(index).link, m.feedback(index).stopped),
                (Link::Online, None),
                "{faults:?}"
            );
            let misuse = m.misuse(index);
            assert_eq!((misuse.changed_retry, misuse.too_early, misuse.interrupted), (0, 0, 0), "{misuse:?}");
            assert!(m.look(index, |drive, _| drive.repeated()) > 10);
        }
        for counters in m.finish() {
            assert!(own(&counters, Own::Retries) > 50, "{counters:?}");
            assert!(faults.drop == 0.0 || own(&counters, Own::SlotTimes) > 50, "{counters:?}");
            assert!(faults.corrupt == 0.0 || counters.malformed > 20, "{counters:?}");
        }
    }
}

#[test]
fn a_drive_that_was_switched_off_stops_its_axis_and_comes_back_by_the_application_only() {
    let mut m = turning(2, 5);
    assert!(m.sim.world().restart_on(PORT, 0));
    m.until("its loss", 100, |sim| sim.feedback(0).stopped.is_some());
    m.until("it is back", 5_000, |sim| sim.feedback(0).link == Link::Online);
    assert_eq!(m.feedback(0).status.state, State::SwitchOnDisabled);
    assert_eq!((m.feedback(1).link, m.feedback(1).stopped), (Link::Online, None));
    m.sim.run(500);
    assert!(m.speed(0).abs() < 0.05);
    m.turns(1, 8.0);
    m.done(0, Command::Reset);
    m.done(0, Command::Enable);
    m.post(0, jog(4.0));
    m.turns(0, 4.0);
    let counters = m.finish();
    assert!(counters[1].missed == 0, "{counters:?}");
}

#[test]
fn a_port_that_vanishes_stops_the_axes_and_comes_back() {
    let mut m = turning(2, 5);
    assert!(m.sim.world().unplug_port(PORT));
    m.until("its loss", 200, |sim| (0..2).all(|index| sim.feedback(index).stopped.is_some()));
    m.sim.run(500);
    assert!(m.note(0).is_some_and(|note| note.contains(PORT)), "{:?}", m.note(0));
    assert!(m.sim.world().plug_port(PORT));
    m.online();
    for index in [0, 1] {
        assert!(m.speed(index).abs() < 0.05);
        m.done(index, Command::Reset);
        m.done(index, Command::Enable);
        assert_eq!(m.misuse(index).total(), 0, "{:?}", m.misuse(index));
    }
}

#[test]
fn nothing_is_sent_while_another_master_has_the_wire_and_it_is_named() {
    let foreign = ForeignSettings { every_ns: MS, count: Some(1_500), ..ForeignSettings::new(9) };
    let mut m = Lenze::with(wire(1_500_000, 1), cycle(), |wire| {
        wire.foreign = Some(foreign);
    });
    m.sim.run(1_000);
    assert_eq!(m.look(0, |drive, _| drive.events().diagnoses), 0, "not a word");
    let note = m.note(0).expect("it is not in Data_Exchange");
    assert!(note.contains("another master, address 9"), "{note}");
    m.online();
    m.sim.run(1_000);
    assert_eq!(m.note(0), None, "it has gone");
}

#[test]
fn another_master_that_comes_later_stops_the_axes() {
    let after_ns = 5 * S;
    // Some of its telegrams collide with others.
    let every_ns = 10_300_000;
    let foreign = ForeignSettings { after_ns, every_ns, count: Some(20), ..ForeignSettings::new(9) };
    let mut m = Lenze::with(wire(1_500_000, 1), cycle(), |wire| {
        wire.foreign = Some(foreign);
    });
    m.ready();
    m.post(0, jog(8.0));
    m.turns(0, 8.0);
    m.until("its stop", 6_000, |sim| sim.feedback(0).stopped.is_some());
    assert!(matches!(m.feedback(0).stopped, Some(StopCause::OtherMaster)), "{:?}", m.feedback(0).stopped);
    m.sim.run(500);
    assert!(m.speed(0).abs() < 0.05);
    let [counters] = m.finish()[..] else { panic!("one drive") };
    assert!(own(&counters, Own::SecondMaster) >= 2, "{counters:?}");
}

#[test]
fn noise_costs_exchanges_and_no_more() {
    let mut bus = wire(1_500_000, 2);
    bus.drives.iter_mut().for_each(|drive| drive.axis.health.bucket = 20);
    let mut m = Lenze::with(bus, cycle(), |wire| {
        wire.noise = Some(NoiseSettings { seed: 5, every_ns: 5 * MS, bytes: 8 });
    });
    m.ready();
    for index in [0, 1] {
        m.post(index, jog(8.0));
        m.turns(index, 8.0);
    }
    for _ in 0..5_000 {
        m.sim.run(1);
        for index in [0, 1] {
            let status = m.feedback(index).status;
            assert!((status.velocity - 8.0).abs() < 1.0, "{status:?}");
        }
    }
    m.done(0, STOP);
    let counters = m.finish();
    let noise: u64 = counters.iter().map(|c| own(c, Own::Noise) + c.malformed).sum();
    assert!(noise > 200, "{counters:?}");
}

#[test]
fn the_own_echo_is_skipped() {
    let mut bus = wire(1_500_000, 2);
    bus.echo = true;
    let mut m = Lenze::new(bus, cycle());
    m.ready();
    m.post(0, jog(8.0));
    m.turns(0, 8.0);
    let counters = m.finish();
    for c in counters {
        assert!(c.missed == 0 && c.malformed == 0 && own(&c, Own::Noise) == 0, "{c:?}");
    }
}
