//! What a drive is and has: versions, encoders, inputs.

use fieldbeat::axis::{Command, Outcome, StopCause};
use fieldbeat::bus::ethernet_ip::{Access, EnableInput, Version, command};
use fieldbeat::time::MS;
use fieldbeat_sim::ethernet_ip::Kind;

use super::*;

/// It shows its values, and refuses motion with this reason.
fn only_shows(plan: MoonsDrive, reason: &str) {
    let mut m = Moons::new(vec![MoonsDrive { homing: None, ..plan }]);
    m.online();
    m.run(300);
    let feedback = m.feedback(0);
    assert!(feedback.age <= 1 && feedback.status.monitor[0] == Some(48.0), "{feedback:?}");
    for command in [Command::Enable, go(1.0), jog(1.0)] {
        let refused = m.sim.axis(0).post(command).map(|_| ()).unwrap_err().to_string();
        assert!(refused.contains(reason), "{command:?}: {refused}");
    }
    assert!(!m.truth(0).powered);
}

#[test]
fn connections_without_outputs_and_first_versions_show_values_and_refuse_motion_by_name() {
    only_shows(MoonsDrive { connection: Access::InputOnly, ..drive(0) }, "connection = \"owner\"");
    let first = MoonsDrive { version: Some(Version::V1), connection: Access::InputOnly, ..drive(0) };
    only_shows(first, "\"v1\"");
}

#[test]
fn a_hardware_enable_that_opens_stops_the_axis_and_switches_nothing_on_when_it_closes() {
    let input = EnableInput { number: 3, closed: true };
    let mut m = Moons::new(vec![MoonsDrive { enable_input: Some(input), ..drive(0) }]);
    m.ready();
    m.post(0, jog(1.0));
    m.run(300);
    let before = m.count(0);
    assert!(m.sim.world().open_sto(m.io(0), 100 * MS));
    m.until("a stop", 50, |sim| sim.feedback(0).stopped.is_some());
    assert!(m.feedback(0).status.sto_open && !m.truth(0).powered);
    assert_eq!(m.feedback(0).stopped, Some(StopCause::StoOpen));
    m.run(2_000);
    assert!(!m.feedback(0).status.sto_open && !m.truth(0).powered);
    let came = m.came(0, before);
    assert!(came.iter().all(|came| came.word & command::ENABLE == 0), "{:x?}", edges(&came));
    // While it is open an enable fails, and does not come up later.
    m.done(0, Command::Reset);
    assert!(m.sim.world().open_sto(m.io(0), 300 * MS));
    m.run(20);
    assert!(matches!(m.end(0, Command::Enable), Some(Outcome::Failed(_))));
    m.run(2_000);
    assert!(!m.truth(0).powered);
    m.done(0, Command::Enable);
}

#[test]
fn a_position_of_an_encoder_is_the_encoders() {
    let plan = MoonsDrive { encoder: true, encoder_counts_per_step: 0.2, ..drive(0) };
    let mut m = Moons::with(vec![plan], |settings| settings.identity.kind = Kind::StepServo);
    m.ready();
    for position in [1.0, -0.75, 3.0] {
        m.done(0, go(position));
        m.run(100);
        let status = m.feedback(0).status;
        assert!((status.position - position).abs() < 1e-3 && status.in_target, "{status:?}");
        assert!((m.truth(0).position / 20_000.0 - position).abs() < 1e-3);
    }
}
