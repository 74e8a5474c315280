//! Enabling, disabling, faults, restarts, and outputs that stop counting.

use super::*;
use crate::bus::desired::Resettable;

/// A drive that is found in this state.
fn found(can: Capabilities, state: Cia402) -> Rig {
    let mut rig = Rig::new(can);
    rig.drive.state = state;
    rig.turns(3);
    rig
}

#[test]
fn enable_leads_into_operation_from_every_state_and_moves_nothing() {
    use Cia402::{OperationEnabled, QuickStopActive, ReadyToSwitchOn, SwitchOnDisabled, SwitchedOn};
    for can in kinds() {
        for state in [SwitchOnDisabled, ReadyToSwitchOn, SwitchedOn, OperationEnabled, QuickStopActive] {
            let mut rig = found(can, state);
            rig.set(100.0);
            // A quick stop that is not the master's ends when it ends.
            let stays = state == QuickStopActive && !can.leaves_quick_stop;
            let expected = if stays { Err(Failure::TimedOut(state)) } else { Ok(()) };
            assert_eq!(rig.run(Command::Enable), expected, "{state:?} {can:?}");
            assert_eq!(rig.state(), if stays { state } else { OperationEnabled }, "{state:?} {can:?}");
            rig.turns(50);
            assert_eq!((rig.drive.point.position, rig.drive.is_moving()), (10.0, false), "{can:?}");
            let on = matches!(state, OperationEnabled | SwitchedOn | QuickStopActive) && !stays;
            let off = on && rig.drive.powers.contains(&Power::Off);
            assert!(!off, "{state:?}: {:?}", rig.drive.powers);
        }
    }
}

#[test]
fn a_stop_behind_an_enable_in_operation_leaves_it_in_operation() {
    for can in kinds() {
        for (turns, lost) in (0..6).flat_map(|turns| [(turns, false), (turns, true)]) {
            let mut rig = Rig::enabled(can);
            let before = rig.drive.powers.len();
            rig.start(Command::Enable);
            for _ in 0..turns {
                if lost { rig.exchange(Fate::ReplyLost) } else { rig.turn() }
            }
            assert_eq!(rig.run(STOP), Ok(()), "{can:?}");
            rig.turns(20);
            let (state, sent) = (rig.state(), &rig.drive.powers[before..]);
            assert_eq!((state, rig.power()), (Cia402::OperationEnabled, Power::EnableOperation), "{can:?}");
            assert!(sent.iter().all(|power| *power == Power::EnableOperation), "{turns} {lost}: {sent:?}");
            assert_eq!((rig.drive.point.position, rig.drive.is_moving()), (10.0, false), "{can:?}");
        }
    }
}

#[test]
fn a_failed_power_up_goes_back_and_says_why() {
    let named = Failure::DriveFault(5);
    for can in kinds() {
        let mut rig = found(can, Cia402::SwitchedOn);
        rig.drive.state = Cia402::SwitchedOn;
        rig.drive.sto_open = true;
        // It has power, and is found so; then it loses that, and none comes back.
        rig.start(Command::Enable);
        rig.drive.state = Cia402::ReadyToSwitchOn;
        assert_eq!(rig.finish(), Err(Failure::StoOpen), "{can:?}");
        assert_eq!(rig.power(), Power::SwitchOn, "{can:?}: where it was found");

        // In operation it would come back by itself.
        let mut rig = Rig::enabled(can);
        rig.start(Command::Enable);
        rig.drive.sto_open = true;
        rig.drive.state = Cia402::SwitchOnDisabled;
        assert_eq!(rig.finish(), Err(Failure::StoOpen), "{can:?}");
        assert_eq!(rig.power(), Power::Off, "{can:?}");

        let mut rig = Rig::new(can);
        rig.drive.sto_open = true;
        assert_eq!(rig.run(Command::Enable), Err(Failure::StoOpen), "{can:?}");
        assert_eq!(rig.power(), Power::Off);

        // What is known, before it and on the way.
        let mut rig = Rig::new(can);
        rig.drive.trip(5);
        rig.turns(3);
        assert_eq!((rig.run(Command::Enable), rig.power()), (Err(named), Power::Untouched));
        let mut rig = Rig::new(can);
        rig.start(Command::Enable);
        rig.turn();
        rig.drive.shows.fault.named = false;
        rig.drive.trip(5);
        rig.turns(10);
        assert_eq!(rig.end(), None, "its code will be known");
        rig.drive.shows.fault.named = true;
        assert_eq!(rig.finish(), Err(named));
        assert!(rig.power().is_off(), "{:?}", rig.power());

        let mut rig = Rig::new(can);
        rig.drive.shows.obstacle = Some("a setting");
        rig.turns(3);
        assert_eq!(rig.run(Command::Enable), Err(Failure::Unsupported("a setting")));
        let is_off = |power: Power| power == Power::Untouched || power.is_off();
        assert!(rig.gone.iter().all(|gone| is_off(gone.power.value)));

        // It never answers.
        let mut rig = Rig::new(can);
        rig.start(Command::Enable);
        let since = rig.now;
        while rig.end().is_none() {
            rig.exchange(Fate::RequestLost);
        }
        assert_eq!(rig.end(), Some(Err(Failure::TimedOut(Cia402::SwitchOnDisabled))));
        assert!((300..310).contains(&(rig.now.since(since) / MS)));
        rig.turns(20);
        assert!((rig.power(), rig.state()) == (Power::Off, Cia402::SwitchOnDisabled), "{:?}", rig.state());
    }
}

#[test]
fn a_command_that_never_leaves_fails_in_time_and_never_leaves_after_that() {
    for can in kinds() {
        let mut rig = Rig::enabled(can);
        rig.start(Command::Disable);
        while rig.end().is_none() {
            rig.exchange(Fate::Unsent);
        }
        assert!(matches!(rig.end(), Some(Err(Failure::TimedOut(_)))), "{:?}", rig.end());
        rig.turns(50);
        assert_eq!(rig.state(), Cia402::OperationEnabled);
        // A stop waits.
        rig.start(STOP);
        (0..1_000).for_each(|_| rig.exchange(Fate::Unsent));
        assert_eq!((rig.end(), rig.finish()), (None, Ok(())));
    }
}

#[test]
fn a_fault_is_reset_by_an_edge_when_the_drive_takes_one() {
    for can in kinds() {
        let mut rig = Rig::in_motion(can);
        rig.drive.trip(5);
        rig.until("its fault", |rig| rig.end().is_some());
        assert_eq!(rig.end(), Some(Err(Failure::DriveFault(5))), "{can:?}");
        // None was ever requested with its reaction still running.
        rig.drive.shows.fault.resettable = Resettable::At(Time(u64::MAX));
        rig.start(Command::ResetFault);
        rig.turns(50);
        assert!(!rig.drive.powers.contains(&Power::FaultReset));
        // However long that is.
        let at = rig.now + 5_000 * MS;
        rig.drive.shows.fault.resettable = Resettable::At(at);
        assert_eq!(rig.finish(), Ok(()), "{can:?}");
        assert!(rig.now > at && rig.drive.powers.ends_with(&[Power::Off, Power::FaultReset, Power::Off]));
        assert_eq!(rig.state(), Cia402::SwitchOnDisabled);
        assert_eq!(rig.run(Command::ResetFault), Ok(()), "there is none");
        assert_eq!(rig.run(Command::Enable), Ok(()));
        rig.drive.trip(5);
        rig.drive.shows.fault.resettable = Resettable::Never(Some("switch it off"));
        rig.turns(3);
        let resets = rig.drive.powers.len();
        assert_eq!(rig.run(Command::ResetFault), Err(Failure::Unsupported("switch it off")), "{can:?}");
        assert!(!rig.drive.powers[resets..].contains(&Power::FaultReset));
    }
}

#[test]
fn a_drive_that_falls_out_of_operation_or_heeds_no_output_ends_its_command_and_does_not_come_back() {
    for can in kinds() {
        for (moves, counts) in [(false, true), (true, true), (true, false)] {
            let mut rig = Rig::enabled(can);
            if moves {
                rig.moving();
            }
            let state = if counts { Cia402::SwitchOnDisabled } else { Cia402::OperationEnabled };
            (rig.drive.state, rig.drive.shows.outputs_count) = (state, counts);
            let powers = rig.drive.powers.len();
            rig.turns(20);
            let end = if moves { Err(Failure::Dropped(state)) } else { Ok(()) };
            assert_eq!(rig.end(), Some(end), "{can:?}");
            // Somebody switches it on again.
            rig.drive.shows.outputs_count = true;
            if counts {
                rig.drive.state = Cia402::SwitchedOn;
            }
            rig.turns(300);
            assert!(!rig.drive.powers[powers..].contains(&Power::EnableOperation), "{:?}", rig.drive.powers);
            assert_ne!(rig.state(), Cia402::OperationEnabled, "{can:?}");
            assert!(counts || !rig.drive.is_moving(), "{can:?}");
        }
    }
}

#[test]
fn a_restart_ends_what_runs_and_nothing_of_it_is_written_again() {
    for can in kinds() {
        for enabling in [false, true] {
            let mut rig = if enabling { Rig::new(can) } else { Rig::enabled(can) };
            if enabling {
                rig.start(Command::Enable);
                rig.turns(3);
            } else {
                rig.moving();
            }
            rig.drive.restart();
            rig.turns(2);
            assert!(matches!(rig.end(), Some(Err(Failure::Dropped(_)))), "{:?}", rig.end());
            let gone = rig.gone.len();
            rig.turns(300);
            assert!(rig.gone[gone..].iter().all(|gone| gone.power.value == Power::Off));
            assert_eq!(rig.state(), Cia402::SwitchOnDisabled);
            assert_eq!(rig.run(Command::Enable), Ok(()));
            rig.turns(50);
            assert!(!rig.drive.is_moving());
        }
        // What waits for power to be off gets it.
        let mut rig = Rig::enabled(can);
        rig.start(Command::Disable);
        rig.drive.restart();
        assert_eq!(rig.finish(), Ok(()), "{can:?}");
        // While nothing runs, no request of before goes out again: not even with the next send.
        let mut rig = Rig::enabled(can);
        rig.turns(20);
        assert_eq!((rig.end(), rig.power()), (Some(Ok(())), Power::EnableOperation), "{can:?}");
        rig.drive.restart();
        let known = rig.restarts;
        rig.until("its report", |rig| rig.restarts > known);
        assert_eq!(rig.power(), Power::Off, "{can:?}");
    }
}

/// A drive that has failed and is being reset; its reports come at once.
fn resetting(can: Capabilities, resettable: Resettable) -> Rig {
    let can = Capabilities { power_reports: 3, ..can };
    let mut rig = Rig::with(can, |plan| plan.enable_timeout = Duration::from_secs(2));
    rig.drive.trip(5);
    (rig.drive.delay, rig.drive.shows.fault.resettable) = (0, resettable);
    rig.turn();
    rig.start(Command::ResetFault);
    rig
}

#[test]
fn a_quick_stop_of_the_drives_own_is_left_where_it_can_be_at_standstill_only_and_refused_at_once_elsewhere() {
    for can in kinds() {
        let mut rig = Rig::enabled(can);
        rig.drive.state = Cia402::QuickStopActive;
        rig.turns(3);
        rig.start(Command::Enable);
        rig.turns(10);
        let refused = Err(Failure::WrongState(Cia402::QuickStopActive));
        assert_eq!(rig.end(), Some(if can.leaves_quick_stop { Ok(()) } else { refused }), "{can:?}");
        if !can.leaves_quick_stop {
            continue;
        }
        let mut rig = found(can, Cia402::QuickStopActive);
        rig.drive.point.velocity = -5.0;
        rig.turns(3);
        rig.start(Command::Enable);
        rig.turns(20);
        assert_eq!((rig.power(), rig.end()), (Power::QuickStop, None), "{can:?}");
        // The threshold of standstill.
        rig.drive.point.velocity = -0.1;
        assert_eq!(rig.finish(), Ok(()), "{can:?}");
    }
}

#[test]
fn a_take_over_runs_from_where_the_axis_is_by_now_unless_it_stands() {
    for can in &kinds()[1..3] {
        for (velocity, expected) in [(0.1, 0.0), (-0.1, 0.0), (0.2, 0.2), (-30.0, -30.0)] {
            let mut rig = found(*can, Cia402::OperationEnabled);
            rig.drive.point.velocity = velocity;
            rig.turns(3);
            rig.start(None);
            let Setpoint { position, velocity, .. } = rig.slot.desired.setpoint;
            // The age of the report, and the interval until the next send.
            let way = position - rig.slot.evidence.position;
            assert!((way - 2e-3 * expected).abs() < 1e-9 && velocity == expected, "{way} {velocity} {can:?}");
        }
    }
}

#[test]
fn the_time_of_a_reset_begins_when_the_drive_has_it() {
    for can in kinds() {
        let mut rig = resetting(can, Resettable::Now);
        rig.drive.persists = true;
        rig.until("the edge", |rig| rig.power() == Power::FaultReset);
        (0..1_000).for_each(|_| rig.exchange(Fate::RequestLost));
        rig.turn();
        assert_eq!(rig.end(), None, "its first report shows the fault that it is about to clear: {can:?}");
        let since = rig.now;
        assert_eq!((rig.finish(), rig.now.since(since) / MS), (Err(Failure::DriveFault(7)), 501), "{can:?}");
    }
}

#[test]
fn a_state_is_proved_by_so_many_reports_in_a_row() {
    for can in kinds() {
        let mut rig = Rig::new(Capabilities { power_reports: 3, ..can });
        rig.drive.delay = 0;
        for (command, on) in [(Command::Enable, true), (Command::Disable, false)] {
            rig.start(command);
            rig.until("its state", |rig| (rig.state() == Cia402::OperationEnabled) == on);
            rig.turn();
            assert_eq!(rig.end(), None, "{command:?} {can:?}");
            rig.turn();
            assert_eq!(rig.end(), Some(Ok(())), "{command:?} {can:?}");
        }
        let mut rig = resetting(can, Resettable::Now);
        rig.drive.shows.fault.named = false;
        for active in [true, true, false, false, true, false, false] {
            rig.drive.shows.fault.active = active;
            rig.turn();
            assert_eq!(rig.end(), None, "{can:?}");
        }
        assert!(!rig.drive.powers.contains(&Power::FaultReset));
        rig.turn();
        assert_eq!(rig.end(), Some(Ok(())), "{can:?}");
    }
}

#[test]
fn an_enable_goes_on_from_the_state_that_was_found_unless_it_was_switched_off() {
    for can in kinds() {
        let next = if can.switches_on_at_once { Power::EnableOperation } else { Power::SwitchOn };
        for (state, found_on, rest) in [
            (Cia402::SwitchedOn, next, Power::SwitchOn),
            (Cia402::QuickStopActive, Power::QuickStop, Power::Off),
            (Cia402::OperationEnabled, Power::EnableOperation, Power::Off),
        ] {
            for (off, first, rest) in [(false, found_on, rest), (true, Power::Shutdown, Power::Off)] {
                let mut rig = found(can, state);
                if off {
                    rig.start(Command::Disable);
                    rig.exchange(Fate::ReplyLost);
                }
                rig.start(Command::Enable);
                assert_eq!(rig.power(), first, "{state:?} {off} {can:?}");
                (0..310).for_each(|_| rig.exchange(Fate::RequestLost));
                assert_eq!(rig.power(), rest, "{state:?} {off} {can:?}");
            }
        }
    }
}
