//! Stops and quick stops.

use super::*;
use crate::axis::command::NativeOwner;
use crate::bus::desired::{Follows, ModeIs};
use crate::drive::planner::Point;

#[test]
fn a_stop_brakes_along_its_ramp_and_ends_at_standstill_with_power_on() {
    for can in kinds() {
        for (command, takes) in [(STOP, 50), (Command::Stop { deceleration: Some(500.0) }, 100)] {
            let mut rig = Rig::in_motion(can);
            rig.start(command);
            let (since, mut before) = (rig.now, rig.drive.point.velocity);
            while rig.end().is_none() {
                rig.turn();
                let velocity = rig.drive.point.velocity;
                assert!(velocity <= before + 1e-9 && velocity >= -1e-9, "{can:?}: {before} -> {velocity}");
                before = velocity;
            }
            assert_eq!((rig.end(), rig.drive.is_moving()), (Some(Ok(())), false));
            assert_eq!((rig.state(), rig.power()), (Cia402::OperationEnabled, Power::EnableOperation));
            let took = rig.now.since(since) / MS;
            // No ramp brakes a drive that follows torques: it halts.
            let torque = quantity(&can) == Some(Quantity::Torque);
            assert!(torque || (takes..takes + 20).contains(&took), "{took} ms {can:?}");
        }
    }
}

#[test]
fn a_quick_stop_is_released_at_standstill_and_not_before() {
    for can in kinds() {
        let mut rig = Rig::enabled_with(can, |plan| plan.limits.acceleration = Some(5_000.0));
        rig.moving();
        rig.start(Command::QuickStop);
        let mut halts = 0;
        while rig.end().is_none() {
            rig.turn();
            // 5 units/s in an exchange; the others follow no setpoint while they halt.
            let [.., before, last] = rig.gone[..] else { panic!() };
            let step = (before.setpoint.velocity - last.setpoint.velocity).abs();
            assert!(step < 5.001 || quantity(&can) != Some(Quantity::Position), "{step}");
            if rig.motion() == Motion::Halt {
                halts += 1;
            } else {
                assert!(!rig.drive.is_moving(), "{can:?}: released at {:?}", rig.drive.point);
            }
        }
        // 50 units/s with 5000 units/s².
        assert_eq!((rig.end(), rig.motion()), (Some(Ok(())), Motion::Hold), "{can:?}");
        assert!((8..25).contains(&halts), "{halts} {can:?}");
        rig.set(50.0);
        rig.turns(50);
        assert_eq!((rig.drive.is_moving(), rig.power()), (false, Power::EnableOperation));
    }
}

#[test]
fn a_halt_is_neither_made_softer_nor_ended_by_what_replaces_it_or_is_refused() {
    for can in kinds() {
        let refused = refused(&can);
        for next in [Command::Stop { deceleration: Some(1.0) }, refused] {
            let mut rig = Rig::enabled_with(can, |plan| plan.limits.acceleration = Some(5_000.0));
            rig.moving();
            rig.start(Command::QuickStop);
            rig.turns(3);
            assert!(rig.drive.is_moving() && rig.motion() == Motion::Halt, "{can:?}");
            rig.start(next);
            // A command that is refused as it begins ends what runs, but not the halt.
            assert_eq!(rig.end().is_some(), next == refused);
            let from = rig.gone.len();
            for _ in 0..20 {
                let moved = rig.drive.is_moving();
                rig.turn();
                let motion = rig.gone.last().unwrap().motion.value;
                assert!(!moved || motion == Motion::Halt, "{motion:?} {next:?} {can:?}");
            }
            assert!(!rig.drive.is_moving() && rig.gone.len() > from, "{next:?} {can:?}");
            assert_eq!(rig.finish().is_ok(), next != refused);
            rig.until("its release", |rig| rig.motion() == Motion::Hold);
            rig.turns(20);
            assert!(!rig.drive.is_moving(), "{can:?}");
            assert_eq!((rig.run(Command::Enable), rig.power()), (Ok(()), Power::EnableOperation), "{can:?}");
        }
    }
}

#[test]
fn a_halt_that_is_not_obeyed_becomes_a_ramp_once_its_reports_cannot_be_older_than_it() {
    for can in kinds().into_iter().filter(|can| quantity(can).is_none()) {
        let mut rig = Rig::enabled(can);
        rig.drive.is_halted_by_halt = false;
        rig.moving();
        rig.start(Command::QuickStop);
        let from = rig.gone.len();
        assert_eq!(rig.finish(), Ok(()), "{can:?}");
        let motions: Vec<_> = rig.gone[from..].iter().map(|gone| gone.motion.value).collect();
        let halts = motions.iter().take_while(|motion| **motion == Motion::Halt).count();
        // 20 ms, at one exchange a ms.
        assert!((20..25).contains(&halts), "{halts} {can:?}");
        assert!(matches!(motions[halts], Motion::Ramp { .. }), "{:?}", motions[halts]);
        assert!(!rig.drive.is_moving(), "{can:?}");
    }
}

#[test]
fn a_drive_that_runs_again_after_a_halt_fails_the_stop_and_stays_halted() {
    let can = kinds().into_iter().find(|can| can.stands_ns > 0).unwrap();
    let mut rig = Rig::in_motion(can);
    rig.start(Command::QuickStop);
    rig.until("its release", |rig| rig.motion() == Motion::Hold);
    // A reference of its own moves it.
    rig.drive.own_reference = Some(5.0);
    assert_eq!(rig.finish(), Err(Failure::StillMoves));
    assert_eq!(rig.motion(), Motion::Halt);
    rig.until("standstill", |rig| !rig.drive.is_moving());
    assert_eq!((rig.run(STOP), rig.motion()), (Ok(()), Motion::Halt), "it stands only while it is halted");
}

#[test]
fn a_torque_goes_along_its_slope_within_a_tenth_of_a_second_before_the_halt() {
    let can = kinds()[3];
    for (slope, within) in [(10.0, 100), (1_000.0, 40)] {
        let mut rig = Rig::enabled(can);
        rig.start(Command::Torque { slope });
        rig.set(30.0);
        rig.until("its torque", |rig| rig.slot.desired.setpoint.torque == 30.0);
        rig.start(STOP);
        let from = rig.gone.len();
        assert_eq!(rig.finish(), Ok(()));
        let torques: Vec<_> = rig.gone[from..].iter().map(|gone| gone.setpoint.torque).collect();
        assert!(torques.windows(2).all(|pair| pair[1] <= pair[0]), "{torques:?}");
        let free = torques.iter().position(|torque| *torque == 0.0).unwrap();
        assert!((within - 12..=within + 2).contains(&free), "{free} of {within}");
        let halt = rig.gone[from..].iter().position(|gone| gone.motion.value == Motion::Halt).unwrap();
        assert!(halt >= free && halt < free + 5, "{halt} after {free}");
        assert!(!rig.drive.is_moving() && rig.state() == Cia402::OperationEnabled);
    }
}

#[test]
fn a_stop_on_the_way_up_or_off_lets_no_power_come_on() {
    for can in kinds() {
        for command in [STOP, Command::QuickStop] {
            for after in 0..8 {
                let mut rig = Rig::new(can);
                rig.start(Command::Enable);
                rig.turns(after);
                if rig.end().is_some() {
                    break;
                }
                rig.start(command);
                let from = rig.gone.len();
                assert_eq!(rig.finish(), Ok(()), "{after} {can:?}");
                rig.turns(50);
                assert!(rig.gone[from..].iter().all(|gone| gone.power.value != Power::EnableOperation));
                assert_ne!(rig.state(), Cia402::OperationEnabled, "{after} {can:?}");

                // A power off is not taken back, whatever old reports say.
                let mut rig = Rig::in_motion(can);
                rig.start(Command::Disable);
                (0..=after).for_each(|_| rig.exchange(Fate::ReplyLost));
                rig.start(command);
                rig.exchange(Fate::Suspect(2));
                assert_eq!((rig.power(), rig.finish()), (Power::Off, Ok(())), "{after} {can:?}");
                assert!(!rig.state().is_powered());
            }
        }
    }
}

#[test]
fn a_stop_at_standstill_or_without_power_changes_nothing() {
    for can in kinds() {
        for command in [STOP, Command::QuickStop] {
            let mut rig = Rig::enabled(can);
            assert_eq!((rig.run(command), rig.state()), (Ok(()), Cia402::OperationEnabled));
            assert_eq!(rig.drive.point.position, 10.0);
            for state in [Cia402::SwitchOnDisabled, Cia402::ReadyToSwitchOn, Cia402::SwitchedOn] {
                let mut rig = Rig::new(can);
                rig.drive.state = state;
                rig.turns(3);
                assert_eq!((rig.run(command), rig.state()), (Ok(()), state), "{can:?}");
            }
        }
    }
}

#[test]
fn a_stop_out_of_native_mode_is_the_masters_again() {
    for can in kinds() {
        for owner in [NativeOwner::Master, NativeOwner::Application] {
            let mut rig = Rig::enabled(can);
            rig.start(Command::Native(owner));
            rig.turns(20);
            assert_eq!((rig.end(), rig.motion()), (None, Motion::Native(owner)));
            // It is in whatever state the application has left it in; and what is refused replaces it, too.
            for command in [refused(&can), STOP] {
                rig.start(command);
                assert!(!matches!(rig.motion(), Motion::Native(_)), "{command:?} {can:?}");
            }
            assert_eq!((rig.finish(), rig.power()), (Ok(()), Power::EnableOperation), "{can:?}");
        }
    }
}

#[test]
fn a_drive_that_does_not_follow_yet_is_stopped_when_it_does_or_not_at_all() {
    for can in kinds() {
        let mut rig = Rig::new(can);
        (rig.drive.state, rig.drive.point.velocity) = (Cia402::OperationEnabled, 30.0);
        rig.drive.shows.follows = Follows::NotYet;
        rig.turns(3);
        rig.start(STOP);
        rig.turns(200);
        assert_eq!((rig.end(), rig.drive.point.velocity), (None, 30.0), "{can:?}");
        rig.drive.shows.follows = Follows::Yes;
        assert_eq!((rig.finish(), rig.drive.is_moving()), (Ok(()), false), "{can:?}");

        let why = Failure::Unsupported("a key switch");
        for command in [STOP, Command::QuickStop, Command::Disable] {
            let mut rig = Rig::new(can);
            (rig.drive.state, rig.drive.point.velocity) = (Cia402::OperationEnabled, 30.0);
            rig.drive.shows.follows = Follows::Never("a key switch");
            rig.turns(3);
            assert_eq!(rig.run(command), Err(why), "{can:?}");
        }
    }
}

#[test]
fn a_drive_found_in_another_mode_is_halted_in_it_before_it_changes() {
    for can in kinds().into_iter().filter(|can| quantity(can).is_some()) {
        let mut rig = Rig::new(can);
        rig.drive.state = Cia402::OperationEnabled;
        (rig.drive.shows.mode, rig.drive.point.velocity) = (ModeIs::Other, 30.0);
        rig.turns(3);
        rig.start(STOP);
        for _ in 0..500 {
            rig.turn();
            assert!(
                rig.drive.shows.mode != ModeIs::Own || !rig.drive.is_moving(),
                "{can:?}: {:?}",
                rig.drive
            );
            if rig.end().is_some() {
                break;
            }
        }
        assert_eq!((rig.end(), rig.drive.shows.mode), (Some(Ok(())), ModeIs::Own), "{can:?}");
    }
}

#[test]
fn a_stop_that_waits_for_its_drive_ends_with_what_a_new_report_says() {
    let (on, why) = (Cia402::OperationEnabled, "a key switch");
    for can in kinds() {
        for (state, fault, follows, power, end) in [
            (on, true, Follows::NotYet, Power::Off, Ok(())),
            (Cia402::SwitchedOn, false, Follows::NotYet, Power::Off, Ok(())),
            (on, false, Follows::Never(why), Power::EnableOperation, Err(Failure::Unsupported(why))),
        ] {
            let mut rig = Rig::new(can);
            (rig.drive.state, rig.drive.shows.follows) = (on, Follows::NotYet);
            rig.turns(3);
            rig.start(STOP);
            (rig.drive.state, rig.drive.shows.fault.active, rig.drive.shows.follows) =
                (state, fault, follows);
            // What is no report ends nothing.
            (rig.slot.status.state, rig.slot.evidence.fault.active) = (state, fault);
            rig.slot.evidence.follows = follows;
            rig.exchange(Fate::ReplyLost);
            assert_eq!((rig.power(), rig.end()), (Power::EnableOperation, None), "{state:?} {can:?}");
            rig.turns(3);
            assert_eq!(rig.power(), power, "{state:?} {follows:?} {can:?}");
            rig.drive.shows.follows = Follows::Yes;
            assert_eq!(rig.finish(), end, "{state:?} {follows:?} {can:?}");
        }
    }
}

#[test]
fn a_stop_waits_for_no_drive_that_is_out_of_operation_or_was_switched_off() {
    for can in kinds() {
        let mut rig = Rig::enabled(can);
        (rig.slot.status.state, rig.slot.evidence.follows) = (Cia402::SwitchedOn, Follows::NotYet);
        rig.start(STOP);
        assert_eq!(rig.power(), Power::SwitchOn, "{can:?}");
        let mut rig = Rig::enabled(can);
        rig.drive.shows.follows = Follows::NotYet;
        rig.turns(2);
        rig.start(Command::Disable);
        rig.turn();
        assert_eq!(rig.run(STOP), Err(Failure::TimedOut(Cia402::OperationEnabled)), "{can:?}");
    }
}

#[test]
fn the_needed_deceleration_counts_the_way_that_is_lost_until_it_begins() {
    let rig = Rig::with(kinds()[0], |plan| plan.limits.position = Some((0.0, 60.0)));
    for (position, velocity, expected) in [(40.0, 1e2, 500.0), (20.0, -1e2, 500.0), (50.0, 9.0, 1e3)] {
        let from = Point { position, velocity };
        assert_eq!(rig.machine.rules.braking(100.0, from, 10.0), expected, "{from:?}");
    }
}
