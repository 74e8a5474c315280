//! Moves, velocities, rows, torques, homing, and commands that are refused.

use std::f64::consts::TAU;

use super::*;
use crate::axis::Lacks;
use crate::bus::desired::{ModeIs, Ranges};

/// The report, counted from that of the end of the demand, with which the motion ends; its motor stands 0.6 off its
/// target but for these reports.
fn ends_by(can: Capabilities, near: impl Fn(u32) -> bool) -> (u32, Result<(), Failure>) {
    let mut rig = Rig::enabled(can);
    rig.drive.blocked = Some(49.4);
    rig.start(to(50.0));
    rig.until("the end of its demand", |rig| !rig.drive.is_moving() && rig.drive.point.position == 50.0);
    for report in 0..5_000 {
        rig.drive.blocked = Some(if near(report) { 50.5 } else { 49.4 });
        if let Some(end) = rig.end() {
            return (report, end);
        }
        rig.turn();
    }
    panic!("it never ends");
}

#[test]
fn a_move_is_done_by_the_actual_position_in_its_window_for_its_reports() {
    let reports = u32::from(plan().in_position.reports);
    for can in movers() {
        // Its report is one exchange old.
        let at_once = ends_by(can, |_| true);
        assert!(at_once.1 == Ok(()) && (reports..reports + 6).contains(&at_once.0), "{at_once:?} {can:?}");
        // It comes by, and rests there later.
        assert_eq!(ends_by(can, |n| n % 10 != 9 || n > 200), (200 + reports + 1, Ok(())), "{can:?}");
    }
}

#[test]
fn an_axis_that_does_not_come_to_rest_has_not_arrived() {
    for (can, moves_every) in movers().flat_map(|can| [(can, 1), (can, 2), (can, 5)]) {
        let mut rig = Rig::enabled(can);
        rig.start(to(15.0));
        rig.until("its demand", |rig| rig.drive.point.position == 15.0);
        for report in 0..2_000 {
            rig.see(Fate::Good, report % moves_every == 0);
        }
        assert!(matches!(rig.end(), Some(Err(Failure::OutOfPosition { .. }))), "{:?} {can:?}", rig.end());
    }
}

#[test]
fn a_stream_is_done_where_its_last_row_is() {
    for can in followers() {
        for blocked in [None, Some(10.0)] {
            let mut rig = Rig::enabled(can);
            rig.start(Command::Follow);
            rig.drive.blocked = blocked;
            for row in 1..=20 {
                rig.row(row, 10.0 + 0.1 * row as f64, row == 20);
                rig.turn();
            }
            match (rig.finish(), blocked) {
                (Ok(()), None) => assert!((rig.drive.point.position - 12.0).abs() < 1e-9),
                (Err(Failure::OutOfPosition { distance, .. }), Some(_)) => {
                    assert!((distance + 2.0).abs() < 1e-6, "{distance}");
                }
                end => panic!("{end:?} {can:?}"),
            }
        }
    }
}

#[test]
fn a_whole_turn_that_was_not_made_is_no_arrival_and_a_wrapped_count_is() {
    for can in movers() {
        let rotary = |plan: &mut AxisPlan| plan.units.modulo = Some(10.0);
        let mut rig = Rig::enabled_with(can, rotary);
        rig.drive.blocked = Some(10.0);
        let end = rig.run(by(10.0));
        assert!(matches!(end, Err(Failure::OutOfPosition { .. })), "{end:?} {can:?}");
        // The drive makes its demand; that of the master begins where the count is.
        if quantity(&can).is_none() {
            let mut rig = Rig::with(can, rotary);
            rig.drive.wrapped = 4_294_967_296.0 / 1_000.0;
            assert_eq!(rig.run(Command::Enable), Ok(()));
            assert_eq!(rig.run(by(12.0)), Ok(()), "{can:?}");
        }
    }
}

#[test]
fn a_command_that_is_refused_brakes_what_it_replaces_and_does_nothing_else() {
    let why = "it has none";
    let lacks = Lacks { torques: Some(why), homing: Some(why), rows: Some(why), ..Lacks::default() };
    for can in kinds() {
        if quantity(&can) == Some(Quantity::Torque) {
            continue;
        }
        for command in [Command::Torque { slope: 1.0 }, Command::Home, Command::Follow] {
            for unsent in [0, 3] {
                let mut rig = Rig::enabled(Capabilities { lacks, ..can });
                rig.moving();
                let power = rig.slot.desired.power;
                rig.start(command);
                assert_eq!(rig.end(), Some(Err(Failure::Unsupported(why))), "at once");
                (0..unsent).for_each(|_| rig.exchange(Fate::Unsent));
                rig.set(-100.0);
                rig.row(1, 100.0, false);
                rig.until("standstill", |rig| !rig.drive.is_moving());
                rig.turns(50);
                assert!(!rig.drive.is_moving() && rig.slot.desired.power == power, "{command:?} {can:?}");
            }
        }
        // Of a drive that was only read it writes nothing.
        let mut rig = Rig::new(Capabilities { lacks, ..can });
        assert_eq!(rig.run(Command::Home), Err(Failure::Unsupported(why)));
        rig.turns(5);
        assert_eq!(rig.power(), Power::Untouched);
        assert_eq!(rig.run(jog(1.0)), Err(Failure::WrongState(Cia402::SwitchOnDisabled)));
    }
}

#[test]
fn a_target_or_a_profile_that_does_not_fit_is_refused() {
    let can = movers().next().unwrap();
    let ranges = Ranges { position: (-100.0, 100.0), velocity: (0.5, 500.0), acceleration: (1.0, 5_000.0) };
    let mut rig = Rig::enabled(Capabilities { ranges, ..can });
    let slow = Profile { velocity: 0.1, ..PROFILE };
    let wrong = [
        to(100.1),
        to(f64::NAN),
        Command::Move(Move { target: Target::Absolute(20.0), profile: slow }),
        by(f64::INFINITY),
    ];
    for command in wrong {
        assert!(matches!(rig.run(command), Err(Failure::Range(_) | Failure::NotFinite)), "{command:?}");
        assert!(!matches!(rig.motion(), Motion::Move { .. }));
    }
    for can in movers() {
        let mut rig = Rig::enabled_with(can, |plan| plan.limits.position = Some((0.0, 50.0)));
        for command in [to(50.1), by(-10.1)] {
            assert!(matches!(rig.run(command), Err(Failure::Limit { .. })), "{command:?} {can:?}");
        }
        assert_eq!(rig.run(to(50.0)), Ok(()));
    }
}

#[test]
fn a_jog_ends_before_the_position_limit_ahead_and_leads_back_from_there() {
    for can in kinds() {
        if quantity(&can) == Some(Quantity::Torque) {
            // The loop stops it.
            continue;
        }
        for direction in [1.0, -1.0] {
            let mut rig = Rig::enabled_with(can, |plan| plan.limits.position = Some((-40.0, 60.0)));
            rig.drive.homed = true;
            rig.turns(3);
            rig.start(jog(80.0 * direction));
            let end = rig.finish();
            assert!(matches!(end, Err(Failure::Limit { what: "position", .. })), "{end:?}");
            let position = rig.drive.point.position;
            let room = if direction > 0.0 { 60.0 - position } else { position + 40.0 };
            assert!((-1e-6..2.0).contains(&room), "{can:?}: {position}");
            // No further.
            assert!(matches!(rig.run(jog(1.0 * direction)), Err(Failure::Limit { .. })), "{can:?}");
            rig.start(jog(-10.0 * direction));
            rig.turns(200);
            assert_eq!(rig.end(), None);
            assert!((rig.drive.point.position - position) * direction < -1.0);
        }
    }
}

#[test]
fn a_velocity_is_followed_through_any_change() {
    for can in kinds() {
        let torque = quantity(&can) == Some(Quantity::Torque);
        let mut rig = Rig::enabled(can);
        rig.set(0.0);
        let follow = Command::Velocity { acceleration: 1_000.0 };
        rig.start(if torque { Command::Torque { slope: 1_000.0 } } else { follow });
        for wanted in [60.0, -30.0, 5.0, 0.0] {
            rig.set(wanted);
            let from = rig.gone.len();
            rig.turns(400);
            let reached = if torque { rig.slot.desired.setpoint.torque } else { rig.drive.point.velocity };
            assert!((reached - wanted).abs() < 1e-6, "{can:?}: {reached} instead of {wanted}");
            let steps = rig.gone[from..].windows(2).map(|pair| match torque {
                true => pair[1].setpoint.torque - pair[0].setpoint.torque,
                false => pair[1].setpoint.velocity - pair[0].setpoint.velocity,
            });
            assert!(steps.fold(0.0, |most: f64, step| most.max(step.abs())) < 1.001, "1000 a second");
        }
        rig.set(f64::NAN);
        rig.turns(100);
        assert!(!rig.drive.is_moving() && rig.slot.desired.setpoint.velocity == 0.0, "{can:?}");
    }
}

/// A host that was held up delivers many rows at once: the drive's buffer is deep from then on.
#[test]
fn a_stream_ends_only_once_a_drive_far_behind_has_arrived() {
    for buffer in [0, 1, 8, 40, 60, 300] {
        // Slower than its arrival between two exchanges, through the place of the last row, and back to it.
        for sway in [0.0, 0.1] {
            let mut rig = Rig::enabled(kinds()[0]);
            rig.drive.buffer = buffer;
            rig.start(Command::Follow);
            const ROWS: u64 = 400;
            for number in 1..=ROWS {
                let phase = number as f64 / ROWS as f64;
                let position = 10.0 + 2.0 * phase.min(0.5) + sway * (2.5 * TAU * phase).sin();
                rig.row(number, position, number == ROWS);
                rig.turn();
            }
            assert_eq!(rig.finish(), Ok(()), "{buffer} rows behind, {sway}");
            assert!((rig.drive.point.position - 11.0).abs() < 1e-9, "{:?}", rig.drive.point);
        }
    }
    // One that never goes anywhere.
    let mut rig = Rig::enabled(kinds()[0]);
    rig.drive.buffer = usize::MAX;
    rig.start(Command::Follow);
    rig.row(1, 10.1, true);
    assert_eq!(rig.finish(), Err(Failure::NotArrived));
    // One whose demand is there, and never rests.
    let mut rig = Rig::enabled(kinds()[0]);
    rig.drive.restless = 2.0 * rig.drive.can.arrival;
    rig.start(Command::Follow);
    rig.row(1, 10.1, true);
    assert_eq!(rig.finish(), Err(Failure::NotArrived));
}

/// A stream at 50 units/s, from its begin on to 20 units further.
fn streaming(rig: &mut Rig) -> u64 {
    rig.start(Command::Follow);
    for number in 1..=400 {
        rig.row(number, 10.0 + 0.05 * number as f64, false);
        rig.propose();
        rig.turn();
        assert_eq!(rig.end(), None);
    }
    400
}

#[test]
fn a_row_whose_send_was_passed_over_goes_out_no_more_once_the_drive_is_stopped() {
    for can in followers() {
        for stop in [STOP, Command::QuickStop, Command::Disable] {
            let mut rig = Rig::enabled(can);
            let number = streaming(&mut rig);
            let last = rig.gone.last().unwrap().setpoint;
            rig.row(number + 1, 31.0, false);
            rig.propose();
            assert!(rig.slot.desired.setpoint.row > last.row && rig.motion() == Motion::Follow, "{can:?}");
            // Its slot is passed over, and that is why the drive is stopped.
            rig.now = rig.now + T;
            rig.start(stop);
            let sent = rig.gone.len();
            rig.turns(300);
            let gone = &rig.gone[sent..];
            assert!(gone.iter().all(|gone| gone.motion.value != Motion::Follow), "{stop:?} {can:?}");
            let furthest = gone.iter().map(|gone| gone.setpoint.position).fold(0.0, f64::max);
            // Along its ramp.
            let most = last.position + 50.0 * 50.0 / 2_000.0 + 0.2;
            assert!(quantity(&can).is_none() || furthest < most, "{stop:?} {can:?}: {furthest}");
            assert!(!rig.drive.is_moving(), "{stop:?} {can:?}");
        }
    }
}

#[test]
fn a_command_that_is_refused_brakes_a_stream_from_its_last_row() {
    for can in followers() {
        let mut rig = Rig::within(can, 0.0, 60.0);
        streaming(&mut rig);
        rig.start(by(100.0));
        assert!(matches!(rig.end(), Some(Err(Failure::Limit { .. }))), "{can:?}");
        let mut before = rig.gone.last().unwrap().setpoint;
        for _ in 0..200 {
            rig.turn();
            let setpoint = rig.gone.last().unwrap().setpoint;
            let fits = (-1e-9..0.06).contains(&(setpoint.position - before.position));
            assert!(quantity(&can).is_none() || fits, "{can:?}: {before:?} {setpoint:?}");
            before = setpoint;
        }
        assert!(!rig.drive.is_moving(), "{can:?}");
    }
}

#[test]
fn a_row_that_is_no_number_or_does_not_fit_ends_the_stream_at_standstill() {
    let ranges = Ranges { position: (-100.0, 100.0), ..Ranges::UNLIMITED };
    for can in followers() {
        let profiles = quantity(&can).is_none();
        for bad in [f64::NAN, f64::INFINITY, 200.0] {
            if bad == 200.0 && !profiles {
                continue;
            }
            let mut rig = Rig::enabled(Capabilities { ranges, ..can });
            rig.start(Command::Follow);
            rig.row(1, 10.01, false);
            rig.turns(3);
            rig.row(2, bad, false);
            rig.turns(100);
            let end = rig.end();
            assert!(matches!(end, Some(Err(Failure::Range(_) | Failure::NotFinite))), "{end:?}");
            assert!(!rig.drive.is_moving() && rig.drive.point.position.is_finite(), "{can:?} {bad}");
        }
    }
}

/// All but those that only know velocities.
fn homers() -> impl Iterator<Item = Capabilities> {
    kinds().into_iter().filter(|can| quantity(can) != Some(Quantity::Velocity))
}

#[test]
fn homing_is_done_in_its_mode_and_ends_in_the_own_one_with_the_reference_read() {
    for can in homers() {
        for moves in [false, true] {
            let mut rig = Rig::enabled(can);
            if moves {
                rig.moving();
            }
            assert_eq!(rig.run(Command::Home), Ok(()), "{can:?}");
            assert!(
                rig.drive.homed && rig.drive.point.position == 0.0 && rig.drive.shows.mode == ModeIs::Own
            );
            rig.turns(100);
            assert_eq!((rig.drive.point.position, rig.drive.is_moving()), (0.0, false), "{can:?}");
            assert_eq!(rig.state(), Cia402::OperationEnabled);
        }
    }
}

#[test]
fn a_homing_that_fails_or_lasts_too_long_ends_in_the_own_mode_at_standstill() {
    for can in homers() {
        // Only a drive with modes reports an error.
        if quantity(&can).is_some() {
            let mut rig = Rig::enabled(can);
            rig.drive.home_fails = true;
            assert!(matches!(rig.run(Command::Home), Err(Failure::Unsupported(_))), "{can:?}");
            assert!((rig.drive.shows.mode, rig.drive.is_moving()) == (ModeIs::Own, false), "{:?}", rig.drive);
        }
        let mut rig = Rig::enabled_with(can, |plan| plan.home_timeout = Duration::from_millis(100));
        assert_eq!(rig.run(Command::Home), Err(Failure::TimedOut(Cia402::OperationEnabled)), "{can:?}");
        rig.turns(1_000);
        assert_eq!(rig.drive.shows.mode, ModeIs::Own, "{can:?}");
        assert!(!matches!(rig.motion(), Motion::Home));
    }
}

#[test]
fn a_homing_is_stopped_in_each_of_its_steps() {
    for can in homers() {
        for command in [STOP, Command::QuickStop] {
            let mut steps = 0;
            for after in 0..700 {
                let mut rig = Rig::enabled(can);
                rig.start(Command::Home);
                rig.turns(after);
                if rig.end().is_some() {
                    break;
                }
                steps += 1;
                assert_eq!(rig.run(command), Ok(()), "{after} {can:?}");
                assert_eq!(
                    (rig.drive.shows.mode, rig.drive.is_moving()),
                    (ModeIs::Own, false),
                    "{after} {can:?}"
                );
                let position = rig.drive.point.position;
                rig.turns(30);
                assert!((rig.drive.point.position - position).abs() < 1e-6, "{after} {can:?}");
            }
            assert!(steps > 100, "{steps}");
        }
    }
}

#[test]
fn a_drive_in_another_mode_takes_no_motion() {
    for can in homers() {
        let mut rig = Rig::enabled(can);
        rig.drive.shows.mode = ModeIs::Other;
        for report in &mut rig.drive.reports {
            report.evidence.mode = ModeIs::Other;
        }
        rig.exchange(Fate::RequestLost);
        rig.exchange(Fate::RequestLost);
        rig.slot.evidence.mode = ModeIs::Other;
        rig.start(Command::Follow);
        assert!(matches!(rig.end(), Some(Err(Failure::Unsupported(_)))), "{can:?}: {:?}", rig.end());
    }
}

#[test]
fn the_rows_at_standstill_end_once_the_drive_has_taken_enough_of_them() {
    let can = Capabilities { arrival: 0.5, ..kinds()[0] };
    for (lost, off, count) in [(0, 0.0, 5), (60, 0.0, 5), (60, 0.5, 5), (60, -0.75, 53)] {
        let mut rig = Rig::enabled(can);
        rig.start(Command::Follow);
        rig.row(1, 10.0, false);
        rig.turns(3);
        let row = Row { position: 10.0, velocity: 5.0, acceleration: 7.0, last: true };
        rig.machine.input.row = Some(NumberedRow { number: 2, row });
        rig.propose();
        (0..lost).for_each(|_| rig.see(Fate::RequestLost, false));
        let from = rig.gone.len();
        while rig.motion() == Motion::Follow && rig.gone.len() < from + 99 {
            rig.turn();
            rig.drive.reports[0].evidence.demand += off;
        }
        let rows: Vec<_> = rig.gone[from..].iter().map(|gone| gone.setpoint).collect();
        let still = |row: &Setpoint| (row.position, row.velocity, row.acceleration) == (10.0, 0.0, 0.0);
        assert!(rows.len() == count && rows[1..].iter().all(still), "{lost} {off}: {rows:?}");
        assert_eq!(rig.finish(), Ok(()));
    }
}

#[test]
fn a_jog_towards_a_limit_that_is_reached_or_passed_is_refused_at_once_and_back_from_there_it_runs() {
    for can in kinds().into_iter().take(3) {
        let ahead = if quantity(&can).is_none() { 20.0 } else { 0.0 };
        for side in [1.0, -1.0] {
            for (beyond, way, runs) in [(0.0, 1.0, false), (10.0, 1.0, false), (0.0, -1.0, true)] {
                let mut rig = Rig::within(can, -60.0, 60.0);
                assert_eq!(rig.run(Command::Disable), Ok(()));
                rig.drive.stay();
                rig.drive.point.position = (60.0 + beyond) * side;
                assert_eq!(rig.run(Command::Enable), Ok(()));
                rig.start(jog(way * side));
                let value = (60.0 + beyond + ahead) * side;
                let refused = Failure::Limit { what: "position", value, low: -60.0, high: 60.0 };
                assert_eq!(rig.end(), (!runs).then_some(Err(refused)), "{beyond} {way} {side} {can:?}");
            }
        }
    }
    // Faster than it can brake within its leash of 20 units.
    let most = 20_000_f64.sqrt();
    let limit = Failure::Limit { what: "velocity within the leash", value: -200.0, low: -most, high: most };
    assert_eq!(Rig::enabled(kinds()[0]).run(jog(-200.0)), Err(limit));
}

#[test]
fn a_jog_takes_other_velocities_and_stands_just_before_the_limit_by_the_reported_position() {
    for (can, side) in kinds()[1..3].iter().flat_map(|can| [(*can, 1.0), (*can, -1.0)]) {
        let mut rig = Rig::within(can, -60.0, 60.0);
        rig.start(jog(50.0 * side));
        for velocity in [50.0 * side, -30.0 * side, 80.0 * side] {
            rig.set(velocity);
            rig.turns(150);
            assert_eq!((rig.end(), rig.slot.desired.setpoint.velocity), (None, velocity), "{can:?}");
        }
        // A drive that follows velocities slips.
        rig.drive.point.position += 20.0 * side;
        let limit = Failure::Limit { what: "position", value: 60.0 * side, low: -60.0, high: 60.0 };
        assert_eq!((rig.finish(), rig.slot.status.moving), (Err(limit), false), "{can:?}");
        let room = 60.0 - rig.drive.point.position * side;
        let way = rig.slot.desired.setpoint.position - rig.drive.point.position;
        assert!((-1e-6..0.3).contains(&room) && way.abs() < 0.5, "{room} {way} {can:?}");
    } // What counts is its present direction, whatever is wanted.
    let mut rig = Rig::within(kinds()[2], -60.0, 60.0);
    rig.start(jog(80.0));
    rig.turns(100);
    rig.drive.point.position = 58.0;
    rig.turn();
    rig.set(-80.0);
    assert!(matches!(rig.finish(), Err(Failure::Limit { value: 60.0, .. })));
}

#[test]
fn a_drive_that_leaves_the_mode_of_its_setpoint_in_motion_ends_that_motion_and_stops() {
    for can in kinds().into_iter().filter(|can| quantity(can).is_some()) {
        let mut rig = Rig::in_motion(can);
        rig.drive.shows.mode = ModeIs::Other;
        let from = rig.gone.len();
        let end = rig.finish();
        assert!(matches!(end, Err(Failure::Unsupported(why)) if why.contains("mode")), "{end:?}");
        // The report is one exchange old.
        assert!(rig.gone.len() - from <= 3, "{} exchanges", rig.gone.len() - from);
        rig.turns(200);
        assert!(!rig.drive.is_moving(), "{can:?}: {:?}", rig.drive.point);
    }
}

#[test]
fn a_drive_that_comes_back_from_another_mode_holds_where_it_is_then_and_moves_from_there() {
    // A move comes so many exchanges later. The drive is back in its mode after three.
    let ends: Vec<bool> = (0..12)
        .map(|exchanges| {
            let mut rig = Rig::enabled(kinds()[1]);
            rig.turns(20);
            rig.drive.shows.mode = ModeIs::Other;
            for _ in 0..exchanges {
                // Somebody turns it by hand, as long as it does not hold.
                let holds = rig.drive.shows.mode == ModeIs::Own;
                rig.drive.point.position += if holds { 0.0 } else { 0.1 };
                rig.turn();
            }
            let at = rig.drive.point.position;
            rig.machine.start(rig.now, Some(by(5.0)));
            rig.turn();
            let end = rig.finish();
            let refused = matches!(end, Err(Failure::Unsupported(why)) if why.contains("mode"));
            let way = rig.drive.point.position - at;
            assert!(refused || end == Ok(()) && (way - 5.0).abs() < 0.2, "{exchanges}: {end:?}, {way}");
            !refused
        })
        .collect();
    assert!(ends.is_sorted() && ends.contains(&false) && ends.contains(&true), "{ends:?}");
}
