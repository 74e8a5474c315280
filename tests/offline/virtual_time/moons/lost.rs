//! Masters that die, and come back; drives that take no stop at the end.

use std::time::Duration;

use fieldbeat::axis::{Command, FoundRunning, StopCause, StopTimeout};
use fieldbeat::bus::ethernet_ip::Originator;
use fieldbeat::telemetry::{Condition, StopRequest};
use fieldbeat::time::MS;

use super::*;

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
                assert_eq!(edges(&m.came(0, before)), [0], "it gets no command");
            }
        }
    }
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
