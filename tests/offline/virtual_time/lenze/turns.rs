//! From the first telegram to a motor that turns.

use fieldbeat::axis::{Command, Jog, State};
use fieldbeat::bus::profibus::RATES;
use fieldbeat::time::MS;
use fieldbeat_profibus::counters::Own;
use fieldbeat_sim::profibus::{DpState, ProfibusSegment};

use super::tap::TapWire;
use super::{Lenze, PROFILE, cycle, own, wire};

/// A count of the actual value, revolutions/s: 1500 rpm are 16384.
const COUNT: f64 = 25.0 / 16_384.0;
/// Below 1/256 of its full speed a motor does not turn, for its master.
const TURNS_FROM: f64 = 64.0 * COUNT;

pub const STOP: Command = Command::Stop { deceleration: None };

pub fn jog(velocity: f64) -> Command {
    Command::Jog(Jog { velocity, acceleration: PROFILE.acceleration })
}

#[test]
fn two_drives_come_into_data_exchange_turn_stop_and_are_left_cleared_unlocked_and_off() {
    let mut m = Lenze::new(wire(1_500_000, 2), cycle());
    m.online();
    assert_eq!(m.feedback(0).status.state, State::SwitchOnDisabled);
    assert_eq!((m.note(0), m.note(1)), (None, None));
    m.ready();
    for (index, velocity) in [(0, 8.0), (1, -4.0)] {
        m.post(index, jog(velocity));
    }
    m.turns(0, 8.0);
    m.turns(1, -4.0);
    for index in [0, 1] {
        m.done(index, STOP);
        assert!(m.speed(index).abs() < TURNS_FROM, "{}", m.speed(index));
        // What is left of the speed behind the ramp goes down to a 14th in 10 ms: the motor's controller has 30 Hz.
        m.sim.run(20);
        assert!(m.speed(index).abs() < COUNT, "{}", m.speed(index));
        m.post(index, jog(8.0));
        m.turns(index, 8.0);
    }
    for c in m.sim.numbers().drives.iter().map(|drive| drive.counters) {
        assert!(c.missed == 0 && c.malformed == 0 && c.late == 0, "{c:?}");
        assert!(own(&c, Own::SlotTimes) == 0 && own(&c, Own::WireUs) > 0, "{c:?}");
    }
    // The end of the master while they turn.
    m.sim.stop();
    for _ in 0..5_000 {
        m.sim.step();
    }
    for index in [0, 1] {
        assert_eq!(m.speed(index), 0.0);
        assert_eq!(m.look(index, |drive, _| drive.dp_state()), (DpState::WaitPrm, None));
        assert_eq!(m.look(index, |drive, _| drive.axis_state()), State::SwitchOnDisabled);
        assert_eq!(m.misuse(index).total(), 0, "{:?}", m.misuse(index));
    }
}

#[test]
fn a_drive_is_not_addressed_more_often_than_its_gsd_allows() {
    // Now and then an answer of the one before it is lost, and its turn is late.
    for interval_ns in [0, 4 * MS] {
        let mut bus = wire(1_500_000, 2);
        bus.drives.iter_mut().for_each(|drive| drive.axis.divisor = 4);
        bus.drives[1].min_slave_interval_ns = interval_ns;
        let tap = TapWire::new(ProfibusSegment::of(&bus));
        let mut m = Lenze::on(bus, cycle(), tap.wire());
        m.online();
        tap.drives[1].lock().requests = Some(Vec::new());
        for _ in 0..40 {
            tap.drives[0].lock().lose[1] = 1;
            m.sim.run(23);
        }
        let mut requests = tap.drives[1].lock().requests.take().unwrap();
        assert!(requests.len() > 200, "{}", requests.len());
        requests.dedup_by(|one, other| one.1 == other.1);
        let least = requests.windows(2).map(|two| two[1].0.since(two[0].0)).min().unwrap();
        let is_kept = least >= 4 * MS;
        assert_eq!(is_kept, interval_ns > 0, "{interval_ns}: {least}");
        let missed: Vec<u64> = m.finish().iter().map(|counters| counters.missed).collect();
        assert_eq!(missed, [0, 0]);
    }
}

#[test]
fn each_rate_carries_a_drive_that_turns() {
    for rate in RATES {
        let mut bus = wire(rate, 1);
        let every = (2 * bus.usual_turn_ns(0)).div_ceil(MS);
        bus.drives[0].axis.divisor = every as u32;
        bus.drives[0].watchdog.timeout_ns = Some(5 * every.max(20) * MS);
        // A conformant drive may take MaxTsdr for each answer: 250 bits at 45.45 kbit/s (GSD files).
        let slow = if rate == 45_450 { Some(250) } else { None };
        let mut m = Lenze::with(bus, cycle(), |wire| wire.drives[0].link.answer_bits = slow);
        m.ready();
        m.post(0, jog(8.0));
        m.turns(0, 8.0);
        m.done(0, STOP);
        assert_eq!(m.misuse(0).total(), 0, "{rate}: {:?}", m.misuse(0));
        let [counters] = m.finish()[..] else { panic!("one drive") };
        assert!(counters.missed == 0 && counters.answered > 20, "{rate}: {counters:?}");
    }
}
