//! What a drive is and has: versions, encoders, inputs, counts that go round.

use fieldbeat::axis::{Command, Link, Outcome, State, StopCause};
use fieldbeat::bus::ethernet_ip::{Access, Delivery, EnableInput, Explicit, Version, command};
use fieldbeat::sim::ethernet_ip::{ClockSettings, Kind};
use fieldbeat::time::{MS, US};

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
fn packets_to_a_group_move_a_drive_as_those_to_the_master_only() {
    let mut m =
        Moons::new((0..3).map(|n| MoonsDrive { delivery: Delivery::Multicast, ..drive(n) }).collect());
    m.ready();
    for index in 0..3 {
        m.done(index, go(0.5 + index as f64));
        assert!((m.feedback(index).status.position - 0.5 - index as f64).abs() < 1e-3);
    }
}

#[test]
fn calls_go_while_packets_do_and_while_they_are_lost() {
    for explicit in [Explicit::Unconnected, Explicit::Connected] {
        let mut m =
            Moons::with(vec![MoonsDrive { explicit, ..drive(0) }], |settings| settings.firmware.zs_ms = 0);
        m.ready();
        m.post(0, jog(1.0));
        let read = |m: &mut Moons| {
            let acyclic = m.sim.axis(0).acyclic().clone();
            let call = acyclic.notation().read("0x01/1/1.u16").unwrap();
            let mut ticket = acyclic.post(call, std::time::Duration::from_secs(1)).unwrap();
            for _ in 0..1_500 {
                if let Some(end) = ticket.poll() {
                    return end;
                }
                m.run(1);
            }
            panic!("a call has no end");
        };
        for _ in 0..20 {
            let answer = read(&mut m).unwrap();
            assert_eq!(answer.value, 60, "{explicit:?}");
        }
        assert!(m.feedback(0).stopped.is_none());
        m.mute(0, true);
        m.until("it lost", 100, |sim| sim.feedback(0).link == Link::Lost);
        m.run(500);
        assert_eq!(read(&mut m).map(|answer| answer.value), Ok(60), "{explicit:?}: while it is lost");
    }
}

#[test]
fn a_hardware_enable_that_opens_stops_the_axis_and_switches_nothing_on_when_it_closes() {
    let input = EnableInput { number: 3, closed: true };
    let mut m = Moons::new(vec![MoonsDrive { enable_input: Some(input), ..drive(0) }]);
    m.ready();
    m.post(0, jog(1.0));
    m.run(300);
    let before = m.count(0);
    assert!(m.sim.world().inhibit(m.io(0), 100 * MS));
    m.until("a stop", 50, |sim| sim.feedback(0).stopped.is_some());
    assert!(m.feedback(0).status.inhibited && !m.truth(0).powered);
    assert_eq!(m.feedback(0).stopped, Some(StopCause::HardwareEnable));
    m.run(2_000);
    assert!(!m.feedback(0).status.inhibited && !m.truth(0).powered);
    let came = m.came(0, before);
    assert!(came.iter().all(|came| came.word & command::ENABLE == 0), "{:x?}", edges(&came));
    // While it is open an enable fails, and does not come up later.
    m.done(0, Command::Reset);
    assert!(m.sim.world().inhibit(m.io(0), 300 * MS));
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

#[test]
fn a_rotary_axis_goes_on_over_the_end_of_its_counts() {
    let mut plan = drive(0);
    plan.homing = None;
    plan.axis.units.modulo = Some(1.0);
    plan.axis.profile.velocity = 50.0;
    // Half a turn before the end.
    let mut m = Moons::with(vec![plan], |settings| settings.motor.start = i32::MAX - 10_000);
    m.online();
    m.done(0, Command::Enable);
    let at = m.truth(0).position;
    for (way, times) in [(0.25, 8), (-0.25, 8)] {
        for _ in 0..times {
            let profile = PROFILE;
            m.done(0, Command::Move(Move { target: Target::Relative(way), profile }));
            assert!(m.feedback(0).stopped.is_none());
        }
        let moved = m.truth(0).position - at;
        let should = if way > 0.0 { 40_000.0 } else { 0.0 };
        assert!((moved - should).abs() < 50.0, "{moved} instead of {should}");
        assert!((0.0..1.0).contains(&m.feedback(0).status.position));
    }
    m.post(0, jog(3.0));
    m.run(1_000);
    assert!((m.feedback(0).status.velocity - 3.0).abs() < 0.1, "{:?}", m.feedback(0));
}

#[test]
fn clocks_that_drift_and_shake_lose_no_link() {
    for drift_ppm in [-500, 500] {
        let clock = ClockSettings { drift_ppm, jitter_ns: 400 * US, seed: 3 };
        let mut m = Moons::with(vec![drive(0)], |settings| settings.clock = clock);
        m.ready();
        m.post(0, jog(1.0));
        for _ in 0..10_000 {
            m.run(1);
            assert!(m.feedback(0).stopped.is_none() && m.feedback(0).age <= 2, "{:?}", m.feedback(0));
        }
        assert_eq!(m.feedback(0).status.state, State::OperationEnabled);
    }
}
