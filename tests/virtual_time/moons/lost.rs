//! Connections that are lost, and opened anew; masters that die; sessions that end.

use std::time::Duration;

use fieldbeat::axis::{Command, Failure, FoundRunning, Link, Outcome, StopCause, StopTimeout};
use fieldbeat::bus::ethernet_ip::{Originator, command};
use fieldbeat::sim::ethernet_ip::Ownership;
use fieldbeat::telemetry::{Condition, StopRequest};
use fieldbeat::time::MS;

use super::*;

#[test]
fn a_connection_that_was_lost_is_opened_anew_with_its_reference_open_and_its_power_off() {
    let mut m = Moons::new(vec![drive(0)]);
    m.ready();
    m.post(0, jog(2.0));
    m.run(300);
    let before = m.count(0);
    assert!(m.sim.world().unplug(m.io(0)));
    m.until("a stop", 100, |sim| sim.feedback(0).stopped == Some(StopCause::LinkLost));
    m.run(400);
    assert!(m.sim.world().plug(m.io(0)));
    m.until("it is back", 20_000, |sim| sim.feedback(0).link == Link::Online);
    m.run(2_000);
    let feedback = m.feedback(0);
    assert_eq!(feedback.stopped, Some(StopCause::LinkLost), "it stays latched");
    assert!(!feedback.status.homed, "what moved it meanwhile is not known");
    assert!(!feedback.status.state.is_powered() && !m.truth(0).powered, "{feedback:?}");
    let came = m.came(0, before);
    let moves = command::ENABLE | command::JOG | command::JOG_SPEED | command::MOVE_ABSOLUTE;
    assert!(came.iter().all(|came| came.word & moves == 0), "{:x?}", edges(&came));
    assert_eq!(m.counter(0, "reopened"), 1);
}

#[test]
fn a_drive_whose_first_packet_is_too_late_is_given_up_and_tried_again() {
    let mut m = Moons::new(vec![drive(0)]);
    m.mute(0, true);
    m.run(1_500);
    assert_eq!(m.feedback(0).link, Link::Unseen);
    m.mute(0, false);
    m.online();
    assert_eq!(m.counter(0, "timed_out"), 1);
}

#[test]
fn a_session_that_ends_leaves_the_packets_alone() {
    // A session of these drives ends without traffic for a second, long before the next request of its own.
    let mut m = Moons::with(vec![drive(0)], |settings| settings.network.inactivity_s = 1);
    m.ready();
    m.post(0, jog(1.0));
    for _ in 0..8_000 {
        m.run(1);
        let feedback = m.feedback(0);
        assert!(feedback.age <= 1 && feedback.stopped.is_none(), "{feedback:?}");
    }
    assert!((m.feedback(0).status.velocity - 1.0).abs() < 0.1);
    assert_eq!(m.counter(0, "reopened"), 0);
}

#[test]
fn a_drive_of_another_owner_is_left_to_it() {
    let mut m = Moons::with(vec![drive(0)], |settings| settings.network.ownership = Ownership::Kept);
    m.ready();
    m.post(0, jog(1.0));
    m.run(200);
    // Another originator, whose drive is still owned by the one before.
    let other = Originator { vendor: 0x1234, serial: 7 };
    let before = m.count(0);
    let mut m = m.replaced(vec![drive(0)], other, 100);
    m.run(10_000);
    assert_eq!(m.feedback(0).link, Link::Unseen);
    assert!(m.came(0, before).is_empty(), "it was sent nothing");
    // The one before may open again at once.
    let mut m = m.replaced(vec![drive(0)], Originator::at(BIND), 100);
    m.online();
}

#[test]
fn a_jog_whose_master_dies_ends_by_the_watchdog_of_the_drive() {
    for (zs_ms, za, powered) in [(500, 13, true), (200, 15, false)] {
        let mut m = Moons::with(vec![drive(0)], |settings| {
            (settings.firmware.zs_ms, settings.firmware.za) = (zs_ms, za);
        });
        m.ready();
        m.post(0, jog(3.0));
        m.run(500);
        let now = m.sim.world().now();
        let Moons { taps, sim, .. } = m;
        drop(sim);
        let truth = |ms: u64| taps[0].lock().drive.truth(now + ms * MS);
        assert!(truth(u64::from(zs_ms) - 10).velocity > 50_000.0, "it goes on until then");
        let end = truth(u64::from(zs_ms) + 100);
        assert_eq!((end.velocity.abs() < 1.0, end.powered), (true, powered), "{end:?}");
    }
}

#[test]
fn a_master_that_comes_back_finds_the_drive_running_and_does_as_its_plan_says() {
    for found in [FoundRunning::Stop, FoundRunning::Refuse] {
        let mut plan = drive(0);
        plan.axis.on_found_running = found;
        let mut m = Moons::with(vec![plan.clone()], |settings| settings.firmware.zs_ms = 5_000);
        m.ready();
        m.post(0, jog(1.0));
        m.run(300);
        let before = m.count(0);
        let mut m = m.replaced(vec![plan], Originator::at(BIND), 200);
        m.online();
        m.run(2_000);
        let truth = m.truth(0);
        assert_eq!(m.feedback(0).stopped, Some(StopCause::FoundRunning));
        assert!(!m.feedback(0).status.homed, "another master may have moved it");
        match found {
            FoundRunning::Stop => assert!(truth.velocity.abs() < 1.0, "{truth:?}"),
            FoundRunning::Refuse => {
                assert!(truth.velocity > 10_000.0, "{truth:?}");
                assert_eq!(edges(&m.came(0, before)), [0], "it is told nothing");
            }
        }
    }
}

#[test]
fn a_drive_that_was_switched_off_and_on_does_nothing_by_itself() {
    let mut m = Moons::new(vec![drive(0)]);
    m.ready();
    m.post(0, jog(1.0));
    m.run(300);
    let before = m.count(0);
    assert!(m.sim.world().restart(m.io(0)));
    m.until("a stop", 1_000, |sim| sim.feedback(0).stopped.is_some());
    m.until("it is back", 20_000, |sim| sim.feedback(0).link == Link::Online);
    m.run(1_000);
    assert!(!m.truth(0).powered && !m.feedback(0).status.homed);
    let came = m.came(0, before);
    assert!(came.iter().all(|came| came.word & command::ENABLE == 0), "{:x?}", edges(&came));
    // The application brings it up again.
    m.done(0, Command::Reset);
    m.ready();
    m.done(0, go(0.5));
}

#[test]
fn a_drive_that_sends_too_rarely_is_refused() {
    // Whole ticks of 10 ms, whatever was requested.
    let mut m = Moons::with(vec![drive(0)], |settings| settings.network.tick_ns = 10 * MS);
    m.run(3_000);
    assert_eq!(m.feedback(0).link, Link::Unseen);
    // With an interval that it can do it is taken.
    let mut plan = drive(0);
    plan.input_rpi_ns = Some(10 * MS);
    let mut m = Moons::with(vec![plan], |settings| settings.network.tick_ns = 10 * MS);
    m.online();
}

#[test]
fn a_move_that_ends_with_its_connection_is_reported_and_not_made_again() {
    let mut m = Moons::with(vec![drive(0)], |settings| settings.firmware.zs_ms = 0);
    m.ready();
    let id = m.sim.axis(0).post(go(20.0)).unwrap();
    m.run(300);
    assert!(m.sim.world().unplug(m.io(0)));
    let end = m.sim.run_command(0, id, 1_000);
    assert!(matches!(end, Some(Outcome::Aborted(_) | Outcome::Failed(_))), "{end:?}");
    m.run(500);
    let before = m.count(0);
    m.sim.world().plug(m.io(0));
    m.until("it is back", 20_000, |sim| sim.feedback(0).link == Link::Online);
    m.run(1_000);
    assert!(m.came(0, before).iter().all(|came| came.word & command::MOVE_ABSOLUTE == 0));
    assert_eq!(m.end(0, go(1.0)), Some(Outcome::Failed(Failure::Latched(StopCause::LinkLost))));
}

#[test]
fn a_drive_that_takes_no_stop_is_named_at_the_end_as_it_was_left_with_what_was_tried() {
    let all = vec![StopRequest::Ramp, StopRequest::QuickStop, StopRequest::PowerOff];
    let without_quick_stop = vec![StopRequest::Ramp, StopRequest::PowerOff];
    for (running, ignores_stops, found, condition, requested) in [
        (Some(20_000.0), true, FoundRunning::Stop, Condition::Moving, all),
        // It stands when the ramp has had its time.
        (None, true, FoundRunning::Stop, Condition::Powered, without_quick_stop.clone()),
        (Some(20_000.0), false, FoundRunning::Stop, Condition::Off, without_quick_stop),
        (Some(20_000.0), false, FoundRunning::Refuse, Condition::Moving, vec![]),
    ] {
        let mut plan = drive(0);
        plan.axis.on_found_running = found;
        let mut m = Moons::with(vec![plan, drive(1)], |settings| {
            if settings.address.ip() == &address(0) {
                (settings.running, settings.firmware.ignores_stops) = (running, ignores_stops);
            }
        });
        m.online();
        if running.is_none() {
            m.done(0, Command::Enable);
        }
        let ends = m.ended();
        let left = ends.drives[0].at_end.as_ref().unwrap();
        assert_eq!((left.condition, &left.requested), (condition, &requested), "{running:?} {found:?}");
        assert_eq!(left.is_safe(), condition == Condition::Off);
        assert_eq!(ends.drives[1].at_end.as_ref().unwrap().condition, Condition::Off);
    }
}

#[test]
fn a_drive_that_is_silent_at_the_end_is_unknown_if_it_may_have_power_and_off_if_not() {
    for (command, condition) in [
        (None, Condition::Off),
        (Some(Command::Enable), Condition::Unknown),
        (Some(jog(1.0)), Condition::Unknown),
    ] {
        let mut m = Moons::new(vec![drive(0)]);
        m.online();
        if command.is_some_and(|command| command != Command::Enable) {
            m.done(0, Command::Enable);
            m.done(0, Command::Home);
        }
        // Whether its power came on is never seen.
        m.mute(0, true);
        command.into_iter().for_each(|command| m.post(0, command));
        m.until("silence", 2_000, |sim| sim.feedback(0).link == Link::Lost);
        let ends = m.ended();
        let left = ends.drives[0].at_end.as_ref().unwrap();
        assert_eq!(left.condition, condition, "{command:?} {left:?}");
    }
}

#[test]
fn the_end_of_the_master_is_bounded_although_some_axis_always_moves_again() {
    // Each is given up after its time-out and stopped anew once it moves all the same: never both at once.
    let timeouts = [400, 1_000].map(Duration::from_millis);
    let drives = timeouts.into_iter().enumerate().map(|(index, timeout)| {
        let mut plan = drive(index);
        (plan.axis.stop.timeout, plan.axis.stop.on_timeout) = (timeout, StopTimeout::Hold);
        plan
    });
    let mut m = Moons::with(drives.collect(), |settings| {
        (settings.running, settings.firmware.ignores_stops) = (Some(20_000.0), true);
    });
    m.online();
    let begun = m.sim.world().now();
    let (over, ends) = m.ended_at();
    let took_ms = over.since(begun) / MS;
    // Four times the longest time-out and a second; then the sessions end.
    assert!((5_000..5_200).contains(&took_ms), "{took_ms} ms");
    for left in ends.drives.iter().map(|drive| drive.at_end.as_ref().unwrap()) {
        assert_eq!((left.condition, left.requested.len()), (Condition::Moving, 2), "{left:?}");
    }
}
