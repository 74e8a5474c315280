//! Requests: each ends, for its own serial, as done or with the reason against it.

use std::time::Duration;

use fieldbeat::axis::{Command, Failure, Jog, Move, NativeOwner, Profile, State, Target};
use fieldbeat::sim::FaultPlan;
use fieldbeat::time::{S, US};

use crate::conformance::line::{Line, Motion, PERIOD, WINDOW, commands, near_velocity};
use crate::conformance::rules::near;
use crate::conformance::subject::{Drive, Subject, not_applicable};

const STOP: Command = Command::Stop { deceleration: None };

fn comes_up_off(subject: &'static dyn Subject) -> bool {
    let off = subject.can().comes_up_off;
    if off {
        not_applicable(subject, "a drive found running", "to bring it up takes its power");
    }
    off
}

/// An untouched drive is found as `running` says, and whatever the link does, it stays so until the first order.
fn stays_as_found(subject: &'static dyn Subject, running: bool) {
    if running && comes_up_off(subject) {
        return;
    }
    let mut line = Line::with(subject, 1, |_, drive| drive.running = running);
    line.meet();
    let (found, state) = (line.said(0), line.state(0));
    assert_eq!((found.powered, found.moving), (running, running));
    assert_eq!(state == State::OperationEnabled, running, "{state:?}");
    for turn in 0..1_200 {
        match turn {
            200 => line.plug(0, false),
            400 => line.plug(0, true),
            600..620 => line.mute(0, true),
            620 => line.mute(0, false),
            700 => line.faults(0, FaultPlan { drop: 0.3, duplicate: 0.3, ..FaultPlan::default() }),
            900 => line.answer_as_usual(0),
            _ => {}
        }
        line.turn();
        let said = line.said(0);
        let reported = (said.powered, said.moving, said.homed, line.state(0));
        assert_eq!(reported, (found.powered, found.moving, found.homed, state), "in cycle {turn}");
        assert!(running || said.position == found.position, "in cycle {turn}");
    }
    let went_on = line.said(0).position != found.position || !line.can.positions;
    assert!(!running || went_on, "it went on by itself");
}

pub fn a_drive_that_got_no_order_stays_as_it_was_found(subject: &'static dyn Subject) {
    stays_as_found(subject, false);
}

pub fn a_drive_found_running_runs_on_until_the_first_order(subject: &'static dyn Subject) {
    stays_as_found(subject, true);
}

pub fn an_order_without_a_verb_keeps_the_state_of_the_drive(subject: &'static dyn Subject) {
    for running in [false, true] {
        if running && comes_up_off(subject) {
            return;
        }
        let mut line = Line::with(subject, 1, |_, drive| drive.running = running);
        line.online();
        let state = line.state(0);
        line.order(0, None);
        assert_eq!(line.ended(0), Ok(()));
        for _ in 0..200 {
            line.turn();
            assert_eq!(line.state(0).is_powered(), state.is_powered(), "{:?}", line.state(0));
        }
        assert_eq!(line.said(0).moving, running);
    }
}

pub fn a_drive_found_running_is_taken_over_and_stopped_with_its_power_on(subject: &'static dyn Subject) {
    if comes_up_off(subject) {
        return;
    }
    for stop in [STOP, Command::QuickStop] {
        let mut line = Line::with(subject, 1, |_, drive| drive.running = true);
        line.online();
        line.done(0, stop);
        assert_standing(&mut line, 0, true);
        line.done(0, Command::Disable);
        assert!(!line.said(0).powered);
    }
}

pub fn each_verb_ends_in_what_it_says(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 2);
    line.online();
    line.done(0, Command::Enable);
    assert_eq!((line.state(0), line.said(0).powered), (State::OperationEnabled, true));
    assert!(!line.said(1).powered, "its neighbour got no request");
    if line.can.home {
        line.done(0, Command::Home);
        assert!(line.slots[0].status.homed && line.said(0).homed != Some(false));
    }
    if !line.can.positions {
        line.move_about(0);
    }
    let (at, way) = (line.slots[0].status.demand, line.way(0, 0.1));
    let targets = [
        (Target::Relative(way), at + way),
        (Target::Absolute(at), at),
        (Target::Absolute(at + way), at + way),
        (Target::Relative(-2.0 * way), at - way),
        (Target::Relative(0.0), at - way),
    ];
    for (target, expected) in targets.into_iter().filter(|_| subject.can().positions) {
        let profile = line.profile(0);
        line.done(0, Command::Move(Move { target, profile }));
        let demand = line.slots[0].status.demand;
        assert!((demand - expected).abs() < way * 1e-3, "{target:?}: at {demand} instead of {expected}");
        assert!(!line.said(0).moving);
    }
    line.done(0, STOP);
    line.done(0, Command::QuickStop);
    assert_eq!(line.state(0), State::OperationEnabled, "it stays enabled");
    line.done(0, Command::ResetFault);
    line.order(0, Command::Enable);
    line.until("the end of a second enable", 1_000, |line| {
        assert!(line.said(0).powered, "it is on already, and stays so");
        line.end(0) == Some(Ok(()))
    });
    line.done(0, Command::Disable);
    assert!(!line.said(0).powered && !line.state(0).is_powered());
    line.done(0, Command::Disable);
}

pub fn a_command_is_carried_out_once_and_its_end_stays_reported(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 1);
    let (at, way, command) = (line.slots[0].status.demand, line.way(0, 0.05), line.by(0, 0.05));
    for n in 1..=20 {
        // The same again under a new serial is a new order.
        if !line.can.positions {
            line.move_about(0);
            continue;
        }
        line.done(0, command);
        let demand = line.slots[0].status.demand;
        assert!((demand - at - f64::from(n) * way).abs() < way * 1e-2, "after {n}: {demand}");
    }
    for _ in 0..300 {
        line.stands(0, 1);
        assert_eq!(line.end(0), Some(Ok(())));
    }
}

pub fn a_move_keeps_to_its_profile_in_user_units(subject: &'static dyn Subject) {
    // Way, velocity, acceleration, deceleration, as parts of the usual profile.
    for (way, v, a, d) in
        [(0.3, 1.0, 1.0, 1.0), (0.3, 0.5, 1.0, 1.0), (0.2, 1.0, 0.5, 1.0), (0.2, 1.0, 1.0, 0.5)]
    {
        let mut line = Line::made_ready(subject, 1);
        let usual = line.profile(0);
        let profile = Profile {
            velocity: usual.velocity * v,
            acceleration: usual.acceleration * a,
            deceleration: usual.deceleration * d,
        };
        let way = line.way(0, way);
        let command = match line.can.positions {
            true => Command::Move(Move { target: Target::Relative(way), profile }),
            false => Command::Jog(Jog { velocity: profile.velocity, acceleration: profile.acceleration }),
        };
        line.order(0, command);
        let seconds = |cycles: u64| (cycles * PERIOD) as f64 / S as f64;
        let begin = line.index;
        line.until("its velocity", 5_000, |line| line.slots[0].status.velocity > profile.velocity * 0.98);
        let speeding = seconds(line.index - begin);
        // Times of a trapezoid; the way is long enough for the velocity.
        let up = profile.velocity / profile.acceleration;
        if !line.can.positions {
            assert!(
                (speeding - up).abs() < 0.03,
                "{speeding} s to its velocity instead of {up} s: {profile:?}"
            );
            continue;
        }
        assert_eq!(line.ended(0), Ok(()));
        let whole = seconds(line.index - begin);
        let ramps = up + profile.velocity / profile.deceleration;
        let should = way / profile.velocity + ramps / 2.0;
        assert!((speeding - up).abs() < 0.03, "{speeding} s to its velocity instead of {up} s: {profile:?}");
        assert!(
            (whole - should).abs() < 0.03 + should * 0.02,
            "{whole} s instead of {should} s: {profile:?}"
        );
    }
}

pub fn a_new_order_replaces_the_one_before_it(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 1);
    if !line.can.positions {
        return a_new_jog_replaces_the_one_before_it(line);
    }
    let (at, way) = (line.slots[0].status.demand, line.way(0, 0.2));
    line.set_going(0, Motion::Move);
    let profile = line.profile(0);
    line.done(0, Command::Move(Move { target: Target::Absolute(at + way), profile }));
    // Here and not where the first one would have gone; and its end never comes up again (the referee sees to that).
    let standing = line.slots[0].status.demand;
    assert!((standing - at - way).abs() < way * 1e-3, "at {standing}");
    line.turns(500);
    assert_eq!(line.slots[0].status.demand, standing);
    // Orders in every cycle: the last one counts.
    for n in 0..30 {
        let target = Target::Absolute(at + way * f64::from(n) / 29.0);
        line.order(0, Command::Move(Move { target, profile }));
        line.turn();
    }
    assert_eq!(line.ended(0), Ok(()));
    let standing = line.slots[0].status.demand;
    assert!((standing - at - way).abs() < way * 1e-3, "at {standing}");
}

/// The same, of a drive that takes no moves.
fn a_new_jog_replaces_the_one_before_it(mut line: Line) {
    let turns_at = |line: &mut Line, seconds: f64| {
        let velocity = line.way(0, seconds);
        line.until("its velocity", 1_000, |line| near_velocity(line, 0, velocity));
        for _ in 0..500 {
            line.turn();
            assert!(near_velocity(line, 0, velocity), "the one before it comes up again");
        }
    };
    line.set_going(0, Motion::Turn);
    for seconds in [0.3, -0.5] {
        line.order(0, line.jog(0, seconds));
        turns_at(&mut line, seconds);
    }
    // Orders in every cycle: the last one counts.
    for n in 0..30 {
        line.order(0, line.jog(0, f64::from(n) / 29.0));
        line.turn();
    }
    turns_at(&mut line, 1.0);
}

pub fn unsupported_commands_are_refused_by_name_at_once(subject: &'static dyn Subject) {
    let mut line = Line::with(subject, 1, |_, drive| (drive.jog, drive.follow) = (false, false));
    line.ready();
    let acceleration = line.profile(0).acceleration;
    let mut requested = if line.can.positions { Vec::new() } else { vec![line.by(0, 0.1), Command::Follow] };
    if line.can.picks {
        requested.extend([line.jog(0, 0.1), Command::Velocity { acceleration }]);
        requested.extend(line.can.positions.then_some(Command::Follow));
    }
    requested.extend((!line.can.torque).then_some(Command::Torque { slope: 100.0 }));
    requested.extend((!line.can.home).then_some(Command::Home));
    for command in requested {
        line.stream(0, 0.1, 100);
        line.settle();
        line.order(0, command);
        line.prepare();
        let Some(Err(Failure::Unsupported(why))) = line.end(0) else {
            panic!("{command:?} is refused before anything is sent: {:?}", line.end(0));
        };
        assert!(why.len() > 10, "{why}");
        line.stands(0, 100);
        assert!(matches!(line.end(0), Some(Err(Failure::Unsupported(_)))));
        assert_eq!(line.state(0), State::OperationEnabled);
    }
    // Those that it names as its own are not, nor those for which nothing needs to be configured.
    let mut able = if line.can.picks { Line::made_ready(subject, 1) } else { line };
    for motion in able.motions() {
        able.set_going(0, motion);
        able.done(0, STOP);
    }
}

pub fn native_mode_is_refused_by_name_or_moves_nothing_by_itself(subject: &'static dyn Subject) {
    for owner in [NativeOwner::Master, NativeOwner::Application] {
        let mut line = Line::made_ready(subject, 1);
        line.order(0, Command::Native(owner));
        line.turns(50);
        match line.end(0) {
            Some(Err(Failure::Unsupported(why))) => assert!(why.len() > 10, "{why}"),
            end => assert_eq!(end, None, "native mode has no end of its own"),
        }
        assert_standing(&mut line, 0, true);
        line.done(0, STOP);
        line.done(0, Command::Disable);
    }
}

/// It stands, and goes on standing.
fn assert_standing(line: &mut Line, index: usize, powered: bool) {
    let standing = line.slots[index].status.demand;
    let slow = line.profile(index).velocity * 0.01;
    line.turns(60);
    for _ in 0..150 {
        line.turn();
        let (report, said) = (&line.slots[index].status, line.said(index));
        assert!(!report.moving && !said.moving && report.velocity.abs() < slow, "{report:?}");
        assert!(!powered || !line.can.positions || near(report.demand, standing), "{report:?}");
        assert_eq!(said.powered, powered, "{report:?}");
    }
}

pub fn a_stop_from_every_motion_brings_standstill_with_power_on(subject: &'static dyn Subject) {
    let stops = [
        vec![STOP],
        vec![Command::QuickStop],
        // Sooner, after all.
        vec![STOP, Command::QuickStop],
        vec![STOP, STOP],
    ];
    for motion in Line::new(subject, 1).motions() {
        for stop in &stops {
            let mut line = Line::made_ready(subject, 1);
            line.set_going(0, motion);
            for command in stop {
                line.order(0, *command);
                line.turns(3);
            }
            assert_eq!(line.ended(0), Ok(()), "{stop:?} of {motion:?}");
            assert!(!line.slots[0].status.moving, "it ends at standstill");
            assert_standing(&mut line, 0, true);
            assert_eq!(line.state(0), State::OperationEnabled);
            // The next motion goes as if nothing had been.
            if motion != Motion::Home {
                line.move_about(0);
            }
        }
    }
}

pub fn a_stop_ends_at_standstill_however_fast_the_motion_was(subject: &'static dyn Subject) {
    for stop in [STOP, Command::QuickStop] {
        let mut line = Line::made_ready(subject, 1);
        let usual = line.profile(0);
        let profile = Profile {
            velocity: usual.velocity * 5.0,
            acceleration: usual.acceleration * 10.0,
            deceleration: usual.deceleration * 10.0,
        };
        let target = Target::Relative(line.way(0, 5.0));
        let Profile { velocity, acceleration, .. } = profile;
        line.order(
            0,
            match line.can.positions {
                true => Command::Move(Move { target, profile }),
                false => Command::Jog(Jog { velocity, acceleration }),
            },
        );
        line.until("its velocity", 500, |line| line.slots[0].status.velocity > profile.velocity * 0.98);
        line.done(0, stop);
        let (report, said) = (line.slots[0].status, line.said(0));
        assert!(!report.moving && !said.moving, "{stop:?} ended too soon: {report:?}");
        assert!(report.velocity < usual.velocity * 0.2, "{stop:?} ended too soon: {report:?}");
        assert_standing(&mut line, 0, true);
    }
}

pub fn a_stop_ramps_down_with_the_given_deceleration(subject: &'static dyn Subject) {
    for part in [1.0, 0.5, 4.0] {
        let mut line = Line::made_ready(subject, 1);
        line.set_going(0, line.motion());
        line.turns(150);
        let Profile { velocity, deceleration, .. } = line.profile(0);
        line.order(0, Command::Stop { deceleration: Some(deceleration * part) });
        let braking = line.until("standstill", 5_000, |line| !line.slots[0].status.moving);
        let (took, should) = ((braking * PERIOD) as f64 * 1e-9, velocity / (deceleration * part));
        let sooner = line.can.steep_stops && took < should;
        assert!(sooner || (took - should).abs() < 0.01 + should * 0.05, "{took} s instead of {should} s");
        assert_eq!(line.ended(0), Ok(()));
    }
}

pub fn a_stop_at_standstill_or_without_power_changes_nothing(subject: &'static dyn Subject) {
    for stop in [STOP, Command::QuickStop] {
        let mut line = Line::new(subject, 1);
        line.online();
        line.run(0, stop).expect("a drive without power stands");
        assert_standing(&mut line, 0, false);
        line.ready();
        line.done(0, stop);
        assert_standing(&mut line, 0, true);
    }
}

pub fn an_enable_that_is_stopped_half_way_does_not_go_on_by_itself(subject: &'static dyn Subject) {
    for stop in [STOP, Command::QuickStop, Command::Disable] {
        for after in [0, 1, 2, 5, 20, 100] {
            let mut line = Line::new(subject, 1);
            line.online();
            line.order(0, Command::Enable);
            line.turns(after);
            if line.end(0).is_some() {
                continue;
            }
            line.done(0, stop);
            let was_on = line.state(0) == State::OperationEnabled;
            line.turns(600);
            let on = line.state(0) == State::OperationEnabled;
            assert!(was_on || !on, "{stop:?} {after} cycles after the enable: up by itself");
        }
    }
}

pub fn a_command_is_not_done_by_reports_from_before_the_one_it_replaces(subject: &'static dyn Subject) {
    // The drive did the first, but its answer was lost: what is known of it is of before.
    for (first, second, powered) in [
        (Command::Disable, Command::Enable, true),
        (Command::Enable, Command::Disable, false),
        (Command::Disable, STOP, false),
        (Command::Disable, Command::QuickStop, false),
    ] {
        let mut line = Line::made_ready(subject, 1);
        if first == Command::Enable {
            line.done(0, Command::Disable);
        }
        line.settle();
        line.mute(0, true);
        line.order(0, first);
        line.turns(u64::from(1 + line.can.answers_after));
        line.order(0, second);
        line.settle();
        line.mute(0, false);
        assert_eq!(line.ended(0), Ok(()), "{second:?} behind {first:?}");
        assert_eq!(line.said(0).powered, powered, "{second:?} behind {first:?} is done");
        if second == Command::Enable {
            line.move_about(0);
        }
        line.turns(600);
        assert_eq!(line.said(0).powered, powered, "{second:?} behind {first:?} was done");
    }
}

pub fn a_stop_behind_a_disable_that_never_arrived_ends_at_standstill(subject: &'static dyn Subject) {
    for stop in [STOP, Command::QuickStop] {
        let mut line = Line::made_ready(subject, 1);
        line.set_going(0, line.motion());
        line.plug(0, false);
        line.order(0, Command::Disable);
        line.turns(4);
        line.order(0, stop);
        line.turns(4);
        assert!(line.said(0).moving && line.end(0) != Some(Ok(())), "no reply was received");
        line.plug(0, true);
        assert_eq!(line.ended(0), Ok(()), "{stop:?}");
        assert!(!line.said(0).moving, "{stop:?} is done");
    }
}

pub fn disable_powers_off_from_every_motion(subject: &'static dyn Subject) {
    for motion in Line::new(subject, 1).motions() {
        let mut line = Line::made_ready(subject, 1);
        line.set_going(0, motion);
        line.done(0, Command::Disable);
        assert!(!line.said(0).powered && !line.state(0).is_powered());
        line.turns(300);
        assert!(!line.said(0).powered, "and it stays off");
    }
}

/// The second of two drives counts backwards.
fn backwards(index: usize, drive: &mut Drive) {
    drive.axis.units.counts_per_unit *= [1.0, -1.0][index];
}

pub fn rows_are_followed_in_order_to_the_last(subject: &'static dyn Subject) {
    let mut line = Line::with(subject, 2, backwards);
    line.ready();
    if !line.can.follow {
        return not_applicable(subject, "rows", "it follows none; see what is refused by name");
    }
    for (index, jammed, straight) in
        [(0, false, false), (0, true, false), (1, false, false), (0, false, true)]
    {
        let rows = match straight {
            false => line.stream(index, 0.1, 300),
            true => line.straight(index, 0.1, 300),
        };
        let steepest = rows.windows(2).map(|pair| pair[1].position - pair[0].position).fold(0.0, f64::max);
        line.order(index, Command::Follow);
        let mut before = line.slots[index].status.demand;
        for turn in 0..2_000 {
            // A row that was refused is sent with the next request, and none is jumped over.
            line.wire.log().drives[index].jammed = jammed && turn % 50 == 25;
            line.turn();
            let demand = line.slots[index].status.demand;
            let step = demand - before;
            // A drive that interpolates may overshoot where a straight stream stops dead.
            let back = if straight { steepest } else { 1e-9 };
            assert!(step > -back && step < steepest * 2.5, "a step of {step}, rows make {steepest}");
            before = demand;
            if line.end(index).is_some() {
                break;
            }
        }
        line.wire.log().drives[index].jammed = false;
        assert_eq!(line.ended(index), Ok(()));
        let (demand, last) = (line.slots[index].status.demand, rows[rows.len() - 1].position);
        assert!((demand - last).abs() < steepest * 1e-2, "at {demand}, the last row is {last}");
        assert!(line.rows[index].is_empty());
        assert_standing(&mut line, index, true);
    }
}

pub fn a_jog_goes_on_until_it_is_replaced(subject: &'static dyn Subject) {
    let mut line = Line::with(subject, 2, backwards);
    line.ready();
    if !line.can.jog {
        return not_applicable(subject, "jogs", "it takes none; see what is refused by name");
    }
    for direction in [1.0, -1.0] {
        let at = [0, 1].map(|index| line.slots[index].status.demand);
        for index in 0..2 {
            let command = line.jog(index, 0.5 * direction);
            line.order(index, command);
        }
        line.turns(2_000);
        for (index, at) in at.into_iter().enumerate() {
            assert_eq!(line.end(index), None, "a jog has no end of its own");
            if !line.can.positions {
                let velocity = line.way(index, 0.5 * direction);
                assert!(near_velocity(&line, index, velocity), "{:?}", line.slots[index].status);
                line.done(index, STOP);
                continue;
            }
            let (moved, should) = (line.slots[index].status.demand - at, line.way(index, direction));
            assert!(
                (moved - should).abs() < should.abs() * 0.1,
                "{moved} in two seconds instead of {should}"
            );
            line.done(index, STOP);
        }
    }
}

pub fn a_velocity_is_followed_wherever_it_goes(subject: &'static dyn Subject) {
    let mut line = Line::with(subject, 1, backwards);
    line.ready();
    if !line.can.jog {
        return not_applicable(subject, "cyclic velocities", "it takes none; see what is refused by name");
    }
    let acceleration = line.profile(0).acceleration;
    line.order(0, Command::Velocity { acceleration });
    for seconds in [0.4, 0.2, -0.3, 0.0, 0.3] {
        let velocity = line.way(0, seconds);
        line.machines[0].input.level = velocity;
        line.turns(400);
        let at = line.slots[0].status.demand;
        line.turns(1_000);
        if !line.can.positions {
            let report = line.slots[0].status;
            assert!(near_velocity(&line, 0, velocity) || velocity == report.velocity, "{report:?}");
            continue;
        }
        let (moved, should) = (line.slots[0].status.demand - at, velocity * 1_000.0 * PERIOD as f64 * 1e-9);
        assert!((moved - should).abs() <= should.abs() * 0.1 + 1e-9, "{moved} instead of {should}");
    }
    assert_eq!(line.end(0), None, "it has no end of its own");
    line.done(0, STOP);
}

pub fn commands_not_checked_on_submission_keep_to_the_position_limits(subject: &'static dyn Subject) {
    // Where a relative move or a jog leads, only the bus knows.
    let mut line = Line::with(subject, 2, |index, drive| {
        backwards(index, drive);
        drive.axis.limits.position = Some((-2.0 * drive.start, 2.0 * drive.start));
    });
    line.ready();
    if line.said(0).position.is_none() {
        return not_applicable(subject, "position limits", "its drives tell no position");
    }
    for index in 0..2 {
        let reach = line.way(index, 0.2);
        let at = line.slots[index].status.demand;
        for seconds in [0.5, -0.5].into_iter().filter(|_| subject.can().positions) {
            let end = line.run(index, line.by(index, seconds));
            assert!(matches!(end, Err(Failure::Limit { .. })), "{end:?}");
            line.turns(100);
            assert_eq!(line.slots[index].status.demand, at, "a move that is refused moves nothing");
        }
        for direction in [0.5, -0.5].into_iter().filter(|_| subject.can().jog) {
            let end = line.run(index, line.jog(index, direction));
            assert!(matches!(end, Err(Failure::Limit { .. })), "{end:?}");
            let demand = line.slots[index].status.demand;
            let over = demand.abs() - reach;
            assert!(over < reach * 1e-6 && over > -reach * 0.1, "it ends at {demand}, the limit is {reach}");
            assert_standing(&mut line, index, true);
        }
    }
}

pub fn orders_survive_exchanges_that_are_missed(subject: &'static dyn Subject) {
    for seed in 0..3 {
        let mut line = Line::new(subject, 1);
        line.online();
        // Lost, doubled, or late by an exchange.
        let (drop, duplicate, delay) = match line.can.stream {
            // An answer is in its slot time, or none.
            false if line.can.bytes => (0.3, 0.1, 0.0),
            false => (0.3, 0.1, 0.1),
            // Each of them may cost a connection, and a handshake has to pass to open the next one.
            true => (0.005, 0.002, 0.01),
        };
        let delay_ns = PERIOD * u64::from(line.drives[0].axis.divisor);
        line.faults(0, FaultPlan { seed, drop, duplicate, delay, delay_ns, ..FaultPlan::default() });
        line.honest = line.can.identified;
        line.done(0, Command::Enable);
        if line.can.home {
            line.done(0, Command::Home);
        }
        let (at, way, command) = (line.said(0).demand, line.way(0, 0.02), line.by(0, 0.02));
        let counts = way * line.drives[0].axis.units.counts_per_unit;
        for n in 1..=20 {
            let Some(at) = at.filter(|_| line.can.positions) else {
                line.move_about(0);
                continue;
            };
            line.done(0, command);
            let moved = line.said(0).demand.map_or(f64::NAN, |demand| (demand - at) as f64);
            let should = counts * f64::from(n);
            assert!(
                (moved - should).abs() < counts * 0.01,
                "seed {seed}: after {n} moves {moved} of {should}"
            );
        }
        line.set_going(0, line.motion());
        line.done(0, STOP);
        assert!(!line.said(0).moving);
        line.done(0, Command::Disable);
        assert!(!line.said(0).powered);
        let counters = line.slots[0].counters;
        assert!(counters.missed > 10, "nothing was missed: {counters:?}");
    }
}

pub fn a_stop_reaches_a_drive_whose_replies_are_lost(subject: &'static dyn Subject) {
    // Only its replies are lost. The link is lost by then, and requests carry the command all the same.
    for stop in [STOP, Command::QuickStop] {
        let mut line = Line::made_ready(subject, 1);
        line.set_going(0, line.motion());
        // Where one is sent at a time, they come, but too late to count.
        let stream = line.can.stream;
        match stream {
            true => line.answer_at(0, WINDOW + 140 * US),
            false => line.mute(0, true),
        }
        line.until("a lost link", 100, |line| line.slots[0].link == fieldbeat::axis::Link::Lost);
        line.order(0, stop);
        let received = line.received(0);
        line.turns(4 * u64::from(line.drives[0].axis.divisor));
        let requests = line.requests(0);
        let requested =
            (received..requests.len()).find(|n| subject.requests_stop(&requests[..*n], &requests[*n]));
        assert!(requested.is_some(), "{stop:?} is not on the wire");
        line.turns(400);
        assert!(stream || !line.said(0).moving, "{stop:?}");
        line.answer_as_usual(0);
        line.mute(0, false);
        assert_eq!(line.ended(0), Ok(()), "{stop:?}");
    }
}

pub fn the_request_after_an_order_carries_it(subject: &'static dyn Subject) {
    // The bound of the stop counts on this: no cycle passes between the order and its request.
    for stop in [STOP, Command::QuickStop] {
        let mut line = Line::made_ready(subject, 1);
        line.set_going(0, line.motion());
        // At its velocity, at whatever turn of its requests.
        line.turns(150);
        for _ in 0..40 {
            line.order(0, line.go(0));
            line.turns(7);
            line.until("its velocity", 1_000, |line| line.slots[0].status.velocity > line.way(0, 0.95));
            line.settle();
            let received = line.received(0);
            line.order(0, stop);
            line.turn_and_hear();
            let (before, requests) = (line.requests(0), line.requests(0).split_off(received));
            let is_stop = requests.len() == 1 && subject.requests_stop(&before[..received], &requests[0]);
            assert!(is_stop, "{stop:?}: {requests:02x?}");
            line.done(0, STOP);
        }
    }
}

pub fn orders_with_a_time_limit_end_even_if_nobody_answers(subject: &'static dyn Subject) {
    for command in [Command::Enable, Command::Disable, Command::Home, Command::ResetFault] {
        if command == Command::Home && !subject.can().home {
            continue;
        }
        let mut line = Line::with(subject, 1, |_, drive| {
            drive.axis.enable_timeout = Duration::from_millis(200);
            drive.axis.home_timeout = Duration::from_millis(200);
        });
        line.online();
        line.mute(0, true);
        line.order(0, command);
        line.until("an end", 300, |line| line.end(0).is_some());
        let end = line.end(0);
        let known = command == Command::ResetFault && end == Some(Ok(()));
        assert!(known || matches!(end, Some(Err(Failure::TimedOut(_)))), "{command:?}: {end:?}");
    }
}

pub fn an_enable_that_timed_out_does_not_come_up_later(subject: &'static dyn Subject) {
    let mut line = Line::with(subject, 1, |_, drive| drive.axis.enable_timeout = Duration::from_millis(2));
    line.online();
    match line.run(0, Command::Enable) {
        Ok(()) => not_applicable(subject, "an enable that times out", "it comes up within 2 ms"),
        Err(failure) => {
            assert!(matches!(failure, Failure::TimedOut(_)), "{failure:?}");
            // One that came up as its time ended is switched off by the next request.
            line.exchange(0);
            line.exchange(0);
            for _ in 0..1_000 {
                line.turn();
                assert_ne!(line.state(0), State::OperationEnabled);
            }
        }
    }
}

pub fn a_motion_whose_drive_restarts_fails_and_is_not_taken_up_again(subject: &'static dyn Subject) {
    for motion in Line::new(subject, 1).motions() {
        let mut line = Line::made_ready(subject, 1);
        line.set_going(0, motion);
        line.restart(0);
        line.turns(if line.can.stream || line.can.sessions { 4_000 } else { 1_000 });
        assert!(matches!(line.end(0), Some(Err(_))), "{motion:?}: {:?}", line.end(0));
        for _ in 0..300 {
            line.turn();
            let said = line.said(0);
            assert!(!said.powered && !said.moving, "{motion:?}: by itself {said:?}");
        }
    }
}

pub fn a_fault_of_the_drive_ends_its_orders_and_is_reset_to_power_off(subject: &'static dyn Subject) {
    for moves in [false, true] {
        let mut line = Line::made_ready(subject, 2);
        let motion = Some(line.motion()).filter(|_| moves);
        let Some(telegram) = subject.fault(&line.reply(0)) else {
            return not_applicable(subject, "a fault of the drive", "nothing on its wire brings it about");
        };
        if let Some(motion) = motion {
            line.set_going(0, motion);
        }
        let telegram = subject.fault(&line.reply(0)).unwrap_or(telegram);
        line.meddle(0, telegram);
        line.until("the fault", 200, |line| line.slots[0].status.fault != 0);
        if motion.is_some() {
            let fault = line.slots[0].status.fault;
            assert_eq!(line.ended(0), Err(Failure::DriveFault(fault)));
        }
        line.until("its end", 500, |line| line.state(0) == State::Fault);
        assert_eq!(
            (line.state(1), line.slots[1].status.fault),
            (State::OperationEnabled, 0),
            "its neighbour"
        );
        let fault = line.slots[0].status.fault;
        assert_eq!(line.run(0, Command::Enable), Err(Failure::DriveFault(fault)), "not before it is reset");
        line.done(0, Command::ResetFault);
        let (report, said) = (line.slots[0].status, line.said(0));
        assert_eq!((report.fault, said.powered, said.moving), (0, false, false), "{report:?}");
        line.turns(300);
        assert!(!line.said(0).powered, "a reset never switches on");
        line.done(0, Command::Enable);
        line.move_about(0);
    }
}

pub fn slots_that_are_passed_over_lose_no_order_and_no_row(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 1);
    let every = u64::from(line.drives[0].axis.divisor);
    let mut random = fastrand::Rng::with_seed(2);
    // The requests are built for one slot, and then for the next one in its schedule.
    let mut to_the_end = |line: &mut Line| {
        for _ in 0..5_000 {
            if line.end(0).is_some() {
                break;
            }
            if random.u8(..4) == 0 {
                line.prepare();
                line.index += every;
            }
            line.turn();
        }
        assert_eq!(line.end(0), Some(Ok(())));
    };
    let (at, way, command) = (line.slots[0].status.demand, line.way(0, 0.02), line.by(0, 0.02));
    for _ in 0..10 {
        if line.can.positions {
            line.order(0, command);
        } else {
            line.set_going(0, Motion::Turn);
            line.order(0, STOP);
        }
        to_the_end(&mut line);
    }
    let moved = line.slots[0].status.demand - at;
    assert!(
        !line.can.positions || (moved - 10.0 * way).abs() < way * 0.01,
        "moved by {moved} instead of {}",
        10.0 * way
    );
    if line.can.follow {
        let rows = line.stream(0, 0.1, 200);
        line.order(0, Command::Follow);
        to_the_end(&mut line);
        assert!(line.rows[0].is_empty(), "a row an exchange");
        let (demand, last) = (line.slots[0].status.demand, rows[rows.len() - 1].position);
        assert!((demand - last).abs() < way * 0.01, "at {demand}, the last row is {last}");
    }
}

pub fn every_command_in_every_state_ends_or_goes_on(subject: &'static dyn Subject) {
    // From each state and motion, each command: an end, or a motion that a stop ends.
    for seed in 0..2 {
        let mut line = Line::new(subject, 2);
        line.online();
        let mut random = fastrand::Rng::with_seed(seed);
        for _ in 0..50 {
            let all = commands(&line, 0);
            let command = all[random.usize(..all.len())];
            line.stream(0, 0.01, 30);
            line.order(0, command);
            line.turns(random.u64(..200));
        }
        line.run(0, STOP).ok();
        line.done(0, Command::Disable);
        if line.state(0) == State::Fault || line.slots[0].status.fault != 0 {
            line.done(0, Command::ResetFault);
        }
        line.ready();
        line.move_about(0);
    }
}
