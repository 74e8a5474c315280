//! What a stop requests of the drive: in place of what, and how steep.

use super::*;
use crate::axis::{HeldBy, Load, StopHow, StopThen, Unit};
use crate::drive::at_end::Condition;

#[test]
fn no_ramp_of_velocities_stops_an_axis_that_follows_torques() {
    for (command, quick) in [(Command::Torque { slope: 100.0 }, true), (Command::Follow, false)] {
        for cause in [StopCause::Overrun, StopCause::Task, StopCause::GroupLink] {
            let mut x = Alone::new(plan()).enabled();
            x.begin(command);
            x.slot.status.velocity = 50.0;
            x.turn();
            x.controller.stop(&cycle(50), Time(50 * MS), cause);
            let newest = x.controller.newest();
            assert_eq!(newest == Some(Command::QuickStop), quick, "{cause}: {newest:?}");
            assert_eq!(matches!(newest, Some(Command::Stop { .. })), !quick, "{cause}: {newest:?}");
        }
    }
}

#[test]
fn a_stop_of_the_application_is_as_steep_as_its_time_out_requires_and_never_weaker_than_requested() {
    // 80 mm/s in 80 % of 100 ms.
    for (requested, expected) in [(1.0, 1_000.0), (999.0, 1_000.0), (2_500.0, 2_500.0)] {
        let mut plan = plan();
        plan.stop.timeout = Duration::from_millis(100);
        let mut x = Alone::new(plan).enabled();
        x.slot.status.velocity = -80.0;
        x.turn();
        x.begin(Command::Stop { deceleration: Some(requested) });
        let Some(Command::Stop { deceleration: Some(ordered) }) = x.controller.newest() else { panic!() };
        assert!((ordered / expected - 1.0).abs() < 1e-9, "{requested}: {ordered}");
    }
}

#[test]
fn a_refused_ramp_of_the_application_becomes_a_quick_stop_and_a_fault_of_the_drive_stops_the_axis() {
    let (ramp, fault) = (Command::Stop { deceleration: None }, Failure::DriveFault(7));
    for (command, failure, newest, stopped) in [
        (ramp, Failure::NotTaken, Some(Command::QuickStop), None),
        (Command::Home, Failure::NotTaken, Some(Command::Home), None),
        (Command::Home, Failure::NotArrived, Some(Command::Home), None),
        (Command::Home, fault, None, Some(StopCause::DriveFault)),
    ] {
        let mut x = Alone::new(plan()).enabled();
        let id = x.begin(command);
        x.slot.status.velocity = 50.0;
        x.ends(Err(failure));
        assert_eq!(x.ended(), [(id, Outcome::Failed(failure))]);
        assert_eq!(x.stopped(), stopped, "{command:?} {failure}");
        assert!(newest.is_none() || x.controller.newest() == newest, "{command:?} {failure}");
    }
}

#[test]
fn a_drive_that_answers_again_in_its_stop_gets_the_quick_stop_that_the_application_had_requested() {
    for quick in [true, false] {
        let mut x = Alone::new(plan()).enabled();
        x.slot.status.velocity = 50.0;
        x.turn();
        x.controller.stop(&cycle(x.index), Time(x.index * MS), StopCause::Overrun);
        if quick {
            x.post(Command::QuickStop);
        }
        x.turn();
        let before = x.controller.machine.newest().1;
        x.misses(5);
        assert_eq!(x.link(), Link::Lost);
        x.turn();
        let (newest, serial) = x.controller.machine.newest();
        assert_ne!(serial, before, "what was sent meanwhile is requested again");
        assert_eq!(newest == Some(Command::QuickStop), quick, "{newest:?}");
        assert_eq!(matches!(newest, Some(Command::Stop { .. })), !quick, "{newest:?}");
    }
}

/// An axis that runs, and is stopped by the loop in the cycle in which `command` was posted, or some cycles later.
fn stopped_after(load: Load, command: Command, cycles: u32) -> Alone {
    let mut plan = plan();
    plan.load = load;
    (plan.stop.how, plan.stop.then) = (StopHow::Ramp, StopThen::Hold);
    (plan.stop.deceleration, plan.profile.deceleration) = (1_000.0, 5_000.0);
    let mut x = Alone::new(plan).enabled();
    x.begin(Command::Velocity { acceleration: 100.0 });
    x.slot.status.velocity = 50.0;
    x.turn();
    x.post(command);
    take_commands(from_mut(&mut x.controller), &mut x.bells);
    x.turns(cycles);
    x.controller.stop(&cycle(x.index), Time(x.index * MS), StopCause::Group);
    x
}

#[test]
fn a_stop_of_the_loop_makes_nothing_softer_that_was_accepted_and_has_not_begun_or_brakes_by_the_profile() {
    for cycles in [0, 1, 20] {
        let newest = |command| stopped_after(Load::Level, command, cycles).controller.newest();
        assert_eq!(newest(Command::QuickStop), Some(Command::QuickStop), "after {cycles} cycles");
        for (own, steepest) in
            [(None, 5_000.0), (Some(7_000.0), 7_000.0), (Some(300.0), 1_000.0), (Some(9e9), 9e9)]
        {
            let stop = Command::Stop { deceleration: own };
            assert_eq!(newest(stop), Some(Command::Stop { deceleration: Some(steepest) }), "{own:?}");
        }
        // Power is not to go from a load in motion that a brake has to hold: that is refused, and requests nothing.
        for (load, off) in [(Load::Level, true), (Load::Vertical(HeldBy::Brake), false)] {
            let mut x = stopped_after(load, Command::Disable, cycles);
            let newest = x.controller.newest();
            assert!(matches!(newest, Some(Command::Stop { .. })), "{newest:?}");
            x.slot.status.velocity = 0.0;
            x.turns(200);
            let is_off = x.controller.newest() == Some(Command::Disable);
            assert_eq!(is_off, off, "after {cycles} cycles, {load:?}");
        }
    }
}

#[test]
fn how_a_drive_was_left_is_not_known_to_a_loop_whose_wires_were_taken() {
    let mut x = Alone::new(plan()).enabled();
    x.turn();
    x.controller.stop(&cycle(x.index), Time(x.index * MS), StopCause::LoopStuck);
    x.controller.note_stuck();
    let end = x.controller.at_end().unwrap();
    assert_eq!((end.condition, &*end.requested), (Condition::Unknown, &[][..]));
    let line = end.line(x.controller.feedback(), Unit::Millimetre).unwrap();
    assert!(line.contains("the loop did not come to its end"), "{line}");
}
