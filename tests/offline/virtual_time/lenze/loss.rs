//! Drives, telegrams and ports that are lost; noise and other masters.

use fieldbeat::Simulation;
use fieldbeat::axis::{Command, StopCause};
use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::sim::FaultPlan;
use fieldbeat::telemetry::Counters;
use fieldbeat::time::{MS, S};
use fieldbeat_profibus::counters::Own;
use fieldbeat_sim::profibus::{ForeignMaster, ForeignSettings, NoiseSettings, ProfibusSegment};

use super::tap::TapWire;
use super::turns::{STOP, jog};
use super::{Lenze, PORT, cycle, own, wire};

/// All motors turn, on a wire with such a foreign master.
fn turning(bus: ProfibusPlan, foreign: Option<ForeignSettings>) -> Lenze {
    let drives = bus.drives.len();
    let mut m = Lenze::with(bus, cycle(), |wire| wire.foreign = foreign);
    m.ready();
    (0..drives).for_each(|index| m.post(index, jog(8.0)));
    (0..drives).for_each(|index| m.turns(index, 8.0));
    m
}

#[test]
fn a_port_that_vanishes_stops_the_axes_and_comes_back() {
    let mut m = turning(wire(1_500_000, 2), None);
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
    // It does not go on for so long that the drive is lost.
    let foreign = ForeignSettings { after_ns: 2 * S, count: Some(30), ..ForeignSettings::listening(1) };
    let mut m = turning(wire(12_000_000, 1), Some(foreign));
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
    let mut m = turning(bus, Some(ForeignSettings { after_ns: 2 * S, ..ForeignSettings::listening(9) }));
    m.until("it is there", 5_000, |sim| sim.status().executed > 2_000);
    assert_eq!(m.feedback(0).stopped, None);
    // A search in each ten rounds, of thirteen addresses but two.
    named(&mut m, 9, 10 * 11);
}

#[test]
fn another_master_on_the_wire_is_left_alone_until_it_has_gone_and_stops_the_axes_when_it_comes_later() {
    let own_address = wire(1_500_000, 1).address;
    for (address, name) in [(9, "address 9"), (own_address, &*format!("address {own_address} as this one"))] {
        let foreign = ForeignSettings { every_ns: MS, count: Some(1_500), ..ForeignSettings::new(address) };
        let mut m = Lenze::with(wire(1_500_000, 1), cycle(), |wire| wire.foreign = Some(foreign));
        m.sim.run(1_000);
        assert_eq!(m.look(0, |drive, _| drive.events().diagnoses), 0, "not a word");
        let note = m.note(0).expect("it is not in Data_Exchange");
        assert!(note.contains(&format!("another master, {name}")), "{note}");
        m.online();
        m.sim.run(1_000);
        assert_eq!(m.note(0), None, "it has gone");
    }
    // With the own address: its token, and a Data_Exchange that would turn the motor.
    let go = [0x03, own_address, 0x7D, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x7F, 0x20, 0];
    let mut telegram = vec![0x68, 15, 15, 0x68];
    telegram.extend(go);
    telegram.extend([go.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)), 0x16]);
    let [other, own_one] = [9, own_address].map(ForeignSettings::new);
    let exchange = ForeignSettings { telegrams: vec![telegram], ..own_one.clone() };
    for foreign in [other, own_one, exchange] {
        // Some of its telegrams collide with others.
        let every_ns = 10_300_000;
        let foreign = ForeignSettings { after_ns: 5 * S, every_ns, count: Some(20), ..foreign };
        let mut m = turning(wire(1_500_000, 1), Some(foreign));
        m.until("its stop", 6_000, |sim| sim.feedback(0).stopped.is_some());
        assert_eq!(m.feedback(0).stopped, Some(StopCause::OtherMaster));
        m.sim.run(500);
        assert!(m.speed(0).abs() < 0.05, "{}", m.speed(0));
        let [counters] = m.finish()[..] else { panic!("one drive") };
        assert!(own(&counters, Own::SecondMaster) >= 2, "{counters:?}");
    }
}

#[test]
fn an_echo_is_skipped_where_it_is_announced_and_is_else_no_other_master() {
    for announced in [true, false] {
        let mut bus = wire(1_500_000, 2);
        bus.echo = announced;
        let mut m = Lenze::with(bus, cycle(), |wire| wire.echo = true);
        m.ready();
        m.post(0, jog(8.0));
        m.turns(0, 8.0);
        m.sim.run(5_000);
        assert_eq!((m.feedback(0).stopped, m.note(0)), (None, None));
        let remarks = m.sim.remarks();
        let hint = "drive l0: the adapter of its wire, /dev/ttyS1, returns what is sent: set echo = true";
        assert_eq!(remarks, if announced { vec![] } else { vec![hint] });
        for c in m.finish() {
            assert_eq!(own(&c, Own::SecondMaster), 0, "{c:?}");
            let unnoticed = c.missed == 0 && c.malformed == 0 && own(&c, Own::Noise) == 0;
            assert_eq!(own(&c, Own::WrongAnswer), 0, "{c:?}");
            assert!(unnoticed || !announced, "{c:?}");
        }
    }
}

#[test]
fn an_adapter_that_returns_what_is_sent_is_named_with_a_drive_that_is_silent() {
    for announced in [true, false] {
        let mut bus = wire(1_500_000, 1);
        bus.echo = announced;
        let taps = TapWire::new(ProfibusSegment { echo: true, ..ProfibusSegment::of(&bus) });
        taps.drives[0].lock().unplugged = true;
        let mut m = Lenze::on(bus, cycle(), taps.wire());
        m.sim.run(3_000);
        let why = m.sim.numbers().drives[0].not_connected.clone().expect("it is silent");
        assert!(why.contains("look at its power"), "{why}");
        assert_eq!(why.ends_with("the adapter returns what is sent: set echo = true"), !announced, "{why}");
    }
}

#[test]
fn an_answer_in_the_turn_of_another_drive_is_late_and_from_no_wrong_station() {
    let mut bus = wire(1_500_000, 2);
    bus.retries = 0;
    let taps = TapWire::new(ProfibusSegment::of(&bus));
    // Behind the request of the next turn, whose own answer is lost.
    let late_ns = bus.slot_ns() + 300_000_000 / 1_500;
    let mut m = Lenze::on(bus, cycle(), taps.wire());
    m.online();
    taps.drives[0].lock().answer_late(late_ns);
    taps.drives[1].lock().unplugged = true;
    m.sim.run(5);
    let counters = &m.finish()[0];
    assert!((4..=5).contains(&counters.late), "{counters:?}");
    assert_eq!((own(counters, Own::OtherJob), own(counters, Own::WrongStation)), (counters.late, 0));
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
fn noise_and_telegrams_that_are_lost_or_broken_cost_exchanges_and_no_more() {
    let noise = Some(NoiseSettings { seed: 5, every_ns: 5 * MS, bytes: 8 });
    for (seed, noise, drop, corrupt) in [(0, noise, 0.0, 0.0), (1, None, 0.05, 0.0), (2, None, 0.0, 0.05)] {
        let mut bus = wire(1_500_000, 2);
        bus.drives.iter_mut().for_each(|drive| drive.axis.health.bucket = 20);
        let mut m = Lenze::with(bus, cycle(), |wire| wire.noise = noise);
        m.ready();
        for (index, velocity) in [(0, 8.0), (1, -4.0)] {
            m.post(index, jog(velocity));
            m.turns(index, velocity);
        }
        m.sim.world().set_wire_faults(PORT, FaultPlan { seed, drop, corrupt, ..FaultPlan::default() });
        for _ in 0..5_000 {
            m.sim.run(1);
            for (index, velocity) in [(0, 8.0), (1, -4.0)] {
                let feedback = m.feedback(index);
                assert!((feedback.status.velocity - velocity).abs() < 0.1, "another's value: {feedback:?}");
            }
        }
        m.done(0, STOP);
        for index in [0, 1] {
            let misuse = m.misuse(index);
            // A repeated telegram has the same bytes.
            assert_eq!((misuse.changed_retry, m.feedback(index).stopped), (0, None), "{misuse:?}");
        }
        let counters = m.finish();
        let sum = |of: fn(&Counters) -> u64| counters.iter().map(of).sum::<u64>();
        let noise_or_broken = sum(|c| own(c, Own::Noise) + c.malformed);
        let (retries, slot_times) = (sum(|c| own(c, Own::Retries)), sum(|c| own(c, Own::SlotTimes)));
        assert!(noise_or_broken > 40 || drop > 0.0, "{counters:?}");
        assert!(noise_or_broken > 200 || seed > 0, "{counters:?}");
        assert!(retries > 100 || seed == 0, "{counters:?}");
        assert!(slot_times > 100 || drop == 0.0, "{counters:?}");
    }
}
