//! Drives, telegrams and ports that are lost; noise and other masters.

use fieldbeat::Simulation;
use fieldbeat::axis::{Command, Link, State, StopCause};
use fieldbeat::sim::FaultPlan;
use fieldbeat::sim::profibus::{ForeignMaster, ForeignSettings, NoiseSettings, ProfibusSegment};
use fieldbeat::time::{MS, S, Time, US};
use fieldbeat_profibus::counters::Own;

use super::tap::TapWire;
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
                assert!(
                    (status.velocity - velocity).abs() < 0.1,
                    "another one's value: {:?}",
                    m.feedback(index)
                );
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

/// Turns until the axis of the only drive is stopped by another master at `address`, which is named.
fn named(m: &mut Lenze, address: u8, within: u64) {
    m.until("its stop", within, |sim| sim.feedback(0).stopped.is_some());
    assert_eq!(m.feedback(0).stopped, Some(StopCause::OtherMaster));
    let note = m.note(0).expect("it is named");
    assert!(note.contains(&format!("another master, address {address},")), "{note}");
    m.sim.run(500);
    assert!(m.speed(0).abs() < 0.05, "{} {:?} {:?}", m.speed(0), m.feedback(0), m.misuse(0));
}

#[test]
fn a_master_that_claims_the_silence_between_two_cycles_is_named_by_its_first_telegrams() {
    // At this rate the wire is silent for longer than Tto of address 1 in each cycle.
    let mut m = Lenze::with(wire(12_000_000, 1), cycle(), |wire| {
        // It does not go on for so long that the drive is lost.
        let foreign = ForeignSettings { after_ns: 2 * S, count: Some(30), ..ForeignSettings::listening(1) };
        wire.foreign = Some(foreign);
    });
    m.ready();
    m.post(0, jog(8.0));
    m.turns(0, 8.0);
    let sent = |sim: &Simulation| {
        sim.world().look_on(PORT, 1, |master: &mut ForeignMaster, _| master.sent).expect("it is on the wire")
    };
    m.until("it is there", 6_000, |sim| sent(sim) > 0);
    // What it sends behind the window of a cycle is received in the next one.
    named(&mut m, 1, 2);
}

#[test]
fn a_master_that_finds_no_silence_is_found_by_a_search() {
    let mut bus = wire(1_500_000, 1);
    (bus.gap, bus.highest_address) = (Some(10), 12);
    let mut m = Lenze::with(bus, cycle(), |wire| {
        wire.foreign = Some(ForeignSettings { after_ns: 2 * S, ..ForeignSettings::listening(9) });
    });
    m.ready();
    m.post(0, jog(8.0));
    m.turns(0, 8.0);
    m.until("it is there", 5_000, |sim| sim.status().executed > 2_000);
    assert_eq!(m.feedback(0).stopped, None);
    // A search in each ten rounds, of thirteen addresses but two.
    named(&mut m, 9, 10 * 11);
}

#[test]
fn a_master_that_only_listens_stops_nobody() {
    let mut bus = wire(1_500_000, 1);
    bus.gap = None;
    let mut m = Lenze::with(bus, cycle(), |wire| {
        wire.foreign = Some(ForeignSettings { after_ns: S, ..ForeignSettings::listening(9) });
    });
    m.ready();
    m.post(0, jog(8.0));
    m.turns(0, 8.0);
    m.sim.run(5_000);
    assert_eq!((m.feedback(0).link, m.feedback(0).stopped), (Link::Online, None));
    assert_eq!(m.misuse(0).total(), 0, "{:?}", m.misuse(0));
}

#[test]
fn tokens_of_noise_are_counted_and_stop_nobody() {
    let mut bus = wire(1_500_000, 1);
    bus.drives[0].axis.health.bucket = 200;
    let taps = TapWire::new(ProfibusSegment::of(&bus));
    let mut m = Lenze::on(bus, cycle(), taps.wire());
    m.ready();
    m.post(0, jog(8.0));
    let mut random = fastrand::Rng::with_seed(7);
    m.until("its velocity", 1_000, |sim| sim.feedback(0).status.velocity > 7.95);
    for _ in 0..5_000 {
        // Three bytes that begin like a token, in the part of a cycle in which nobody sends.
        let at = Time((m.sim.world().now().0 / MS + 1) * MS) + 600 * US;
        taps.voice.say(at, &[0xDC, random.u8(..), random.u8(..)]);
        m.sim.run(1);
        assert_eq!(m.feedback(0).stopped, None);
    }
    assert!((m.feedback(0).status.velocity - 8.0).abs() < 0.05, "{:?}", m.feedback(0));
    let [counters] = m.finish()[..] else { panic!("one drive") };
    assert!(own(&counters, Own::SecondMaster) > 500, "{counters:?}");
}

#[test]
fn another_master_with_the_own_address_is_one_too() {
    let own_address = wire(1_500_000, 1).address;
    // From the beginning: nothing is sent.
    let mut m = Lenze::with(wire(1_500_000, 1), cycle(), |wire| {
        wire.foreign = Some(ForeignSettings { every_ns: MS, ..ForeignSettings::new(own_address) });
    });
    m.sim.run(1_000);
    assert_eq!(m.look(0, |drive, _| drive.events().diagnoses), 0, "not a word");
    let note = m.note(0).expect("it is not in Data_Exchange");
    assert!(note.contains(&format!("another master, address {own_address} as this one")), "{note}");

    // Later: its token, and a Data_Exchange that would turn the motor.
    let go = [0x03, own_address, 0x7D, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x7F, 0x20, 0];
    let mut telegram = vec![0x68, 15, 15, 0x68];
    telegram.extend(go);
    telegram.extend([go.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)), 0x16]);
    for telegrams in [ForeignSettings::new(own_address).telegrams, vec![telegram]] {
        let foreign = ForeignSettings {
            after_ns: 5 * S,
            every_ns: 10_300_000,
            telegrams,
            ..ForeignSettings::new(own_address)
        };
        let mut m = Lenze::with(wire(1_500_000, 1), cycle(), |wire| {
            wire.foreign = Some(foreign);
        });
        m.ready();
        m.post(0, jog(8.0));
        m.turns(0, 8.0);
        m.until("its stop", 6_000, |sim| sim.feedback(0).stopped.is_some());
        assert!(matches!(m.feedback(0).stopped, Some(StopCause::OtherMaster)), "{:?}", m.feedback(0).stopped);
    }
}

#[test]
fn a_wire_that_is_never_silent_is_named() {
    let mut bus = wire(1_500_000, 1);
    // The claim takes ten slot times.
    bus.bits.latency_ns = 3 * MS;
    bus.drives[0].axis.divisor = 16;
    let mut m = Lenze::with(bus, cycle(), |wire| {
        wire.noise = Some(NoiseSettings { seed: 5, every_ns: 2 * MS, bytes: 8 });
    });
    m.sim.run(4_000);
    let note = m.note(0).expect("it is not in Data_Exchange");
    assert!(note.contains(PORT) && note.contains("is not silent"), "{note}");
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
            assert!((status.velocity - 8.0).abs() < 0.1, "{:?}", m.feedback(index));
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

#[test]
fn an_echo_that_nobody_has_announced_is_no_other_master() {
    let mut m = Lenze::with(wire(1_500_000, 2), cycle(), |wire| wire.echo = true);
    m.ready();
    m.post(0, jog(8.0));
    m.turns(0, 8.0);
    m.sim.run(5_000);
    assert_eq!((m.feedback(0).stopped, m.note(0)), (None, None));
    let counters = m.finish();
    assert!(own(&counters[0], Own::WrongAnswer) > 1_000, "they come back: {counters:?}");
    assert!(counters.iter().all(|c| own(c, Own::SecondMaster) == 0), "{counters:?}");
}
