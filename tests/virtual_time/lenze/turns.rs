//! From the first telegram to a motor that turns.

use fieldbeat::CyclePlan;
use fieldbeat::axis::{Command, Jog, State};

use super::{Lenze, PROFILE, wire};

const STOP: Command = Command::Stop { deceleration: None };

fn jog(velocity: f64) -> Command {
    Command::Jog(Jog { velocity, acceleration: PROFILE.acceleration })
}

#[test]
fn two_drives_come_into_data_exchange_turn_and_stop() {
    let mut m = Lenze::new(wire(1_500_000, 2), CyclePlan::default());
    m.online();
    assert_eq!(m.feedback(0).status.state, State::SwitchOnDisabled);
    m.ready();
    for (index, velocity) in [(0, 8.0), (1, -4.0)] {
        m.post(index, jog(velocity));
    }
    m.until("both turn", 5_000, |sim| {
        let near =
            |index: usize, velocity: f64| (sim.feedback(index).status.velocity - velocity).abs() < 0.05;
        near(0, 8.0) && near(1, -4.0)
    });
    assert!((m.speed(0) - 8.0).abs() < 0.1 && (m.speed(1) + 4.0).abs() < 0.1);
    for index in [0, 1] {
        m.done(index, STOP);
        assert!(m.speed(index).abs() < 0.05, "{}", m.speed(index));
        m.done(index, Command::Disable);
        assert_eq!(m.misuse(index).total(), 0, "{:?}", m.misuse(index));
    }
    for counters in m.finish() {
        assert!(counters.missed == 0 && counters.malformed == 0 && counters.late == 0, "{counters:?}");
    }
}
