//! What the oracle has found, as sequences of their own: each broke the rule that its name says.

use fieldbeat::axis::NativeOwner;

use super::oracle::holds;
use super::oracle::machine::{Kind, Shape};
use super::oracle::steps::Choice::{
    By, Disable, Home, Jog, Native, Stop, StopAt, To, Torque, TorqueAlong, Velocity,
};
use super::oracle::steps::Op::{
    Burst, Fault, Foreign, Late, Level, OldReply, Overload, Post, RepeatReply, RepeatRequest, Together, Write,
};

const KINDS: [Kind; 3] = [Kind::LinMot, Kind::Unidrive, Kind::Kollmorgen];

/// `hold`: what follows the stops of its axes.
fn shape(kind: Kind, hold: bool) -> Shape {
    Shape { hold, ..Shape::of(kind) }
}

/// The bus' other way as well: tagged replies, menu 0, a clock that leads.
fn shapes(kind: Kind, hold: bool) -> [Shape; 2] {
    [false, true].map(|other| Shape { other, ..shape(kind, hold) })
}

#[test]
fn a_torque_that_begins_where_homing_ends_keeps_to_its_limits() {
    for shape in shapes(Kind::Kollmorgen, false) {
        let begin = (0, 2, Post(vec![Home, Torque]));
        holds(shape, &[&[begin, (0, 2, Level { percent: -60, turns: 250 })]]);
    }
}

#[test]
fn a_reply_that_comes_again_ends_no_move() {
    for shape in shapes(Kind::LinMot, true) {
        for (at, back) in [(9, 8), (5, 3), (8, 6)] {
            let again = (at, 2, RepeatReply { back, us: 970 });
            holds(shape, &[&[(0, 2, Post(vec![To(5)])), again.clone()]]);
            // And with the next command in the same cycle.
            holds(shape, &[&[(0, 2, Post(vec![To(50)])), again, (at, 2, Post(vec![To(5)]))]]);
        }
    }
}

#[test]
fn a_reply_that_comes_again_takes_no_stop_away() {
    for shape in shapes(Kind::LinMot, false) {
        for (at, back) in [(20, 19), (20, 18), (6, 5), (5, 4), (4, 3)] {
            let again = (at, 0, RepeatReply { back, us: 970 });
            holds(shape, &[&[(0, 0, Post(vec![To(100)])), again, (at, 0, Post(vec![Stop]))]]);
        }
    }
}

#[test]
fn a_request_that_comes_again_moves_nothing_that_stands() {
    for shape in shapes(Kind::LinMot, false) {
        let moves = [(0, 0, Post(vec![To(90)])), (150, 0, Post(vec![To(0)]))];
        let again = (340, 0, RepeatRequest { motion: true, back: 1, us: 500 });
        holds(shape, &[&[moves[0].clone(), moves[1].clone(), again]]);
    }
}

#[test]
fn a_request_that_comes_again_takes_no_move_and_no_stop_away() {
    for shape in shapes(Kind::LinMot, false) {
        let jog = [(0, 1, Post(vec![Jog(80)]))];
        let again = |at| (at, 1, RepeatRequest { motion: true, back: 1, us: 773 });
        holds(shape, &[&jog, &[(0, 1, Post(vec![To(0)])), again(11)]]);
        let stop = [(0, 1, Post(vec![To(80)])), (25, 1, Post(vec![Stop]))];
        holds(shape, &[&jog, &[stop[0].clone(), stop[1].clone(), again(44)]]);
    }
}

#[test]
fn a_latched_axis_that_holds_is_moved_by_no_parameter() {
    // Each is latched, since its first setpoint does not come. Mode 3, then a target velocity; mode 1, a speed, a
    // target and a control word that starts the move.
    for writes in [vec![0, 7], vec![1, 10, 8, 4, 5]] {
        for (axis, command) in [(1, Velocity), (2, Torque)] {
            let begin = (0, axis, Post(vec![command]));
            holds(shape(Kind::Kollmorgen, true), &[&[begin, (60, axis, Write(writes.clone()))]]);
        }
    }
}

#[test]
fn an_axis_in_motion_keeps_to_its_limits_under_any_parameter_write() {
    for (axis, command, percent) in [(1, Velocity, 20), (2, Torque, 5)] {
        let begin = (0, axis, Post(vec![command]));
        let level = (3, axis, Level { percent, turns: 150 });
        holds(shape(Kind::Kollmorgen, true), &[&[begin, level, (15, axis, Write(vec![0, 7]))]]);
    }
}

#[test]
fn a_loop_that_passes_over_most_of_its_slots_stops() {
    for kind in KINDS {
        for slots in [1, 3, 9] {
            holds(shape(kind, false), &[&[(5, 0, Overload { slots, turns: 120 })]]);
        }
    }
}

#[test]
fn a_stop_ends_with_any_given_deceleration() {
    for deceleration in [1e-9, 1e-3, 1.0] {
        for (kind, axis) in [(Kind::LinMot, 0), (Kind::Kollmorgen, 0), (Kind::Kollmorgen, 1)] {
            let stop = (30, axis, Post(vec![StopAt(deceleration)]));
            holds(shape(kind, false), &[&[(0, axis, Post(vec![Jog(80)])), stop]]);
        }
        let begin = [(0, 0, Post(vec![Velocity])), (0, 0, Level { percent: 80, turns: 40 })];
        let stop = (40, 0, Post(vec![StopAt(deceleration)]));
        holds(shape(Kind::Unidrive, false), &[&[begin[0].clone(), begin[1].clone(), stop]]);
    }
}

#[test]
fn the_newest_of_many_setpoints_wins() {
    for (kind, axis) in [(Kind::LinMot, 0), (Kind::Unidrive, 0), (Kind::Kollmorgen, 1)] {
        let begin = (0, axis, Post(vec![Velocity]));
        let most = (1, axis, Level { percent: 50, turns: 30 });
        holds(shape(kind, false), &[&[begin, most, (31, axis, Burst { count: 100, percent: 0 })]]);
    }
}

#[test]
fn a_limit_is_kept_however_flat_the_slope_of_a_torque_is() {
    for slope in [2_000.0, 1e-9] {
        let begin = (0, 2, Post(vec![TorqueAlong(2_000.0)]));
        let level = (1, 2, Level { percent: -60, turns: 60 });
        let flat = (30, 2, Post(vec![TorqueAlong(slope)]));
        holds(shape(Kind::Kollmorgen, false), &[&[begin, level, flat]]);
    }
}

#[test]
fn a_mode_that_was_written_without_power_is_set_right_before_anything_moves() {
    // Profile velocity with a target; torque with a target; profile position.
    for writes in [vec![6, 0], vec![2, 9], vec![1, 10, 8]] {
        for (axis, command) in [(0, Home), (0, To(50)), (1, Jog(20))] {
            let off = [(0, axis, Post(vec![Disable])), (30, axis, Write(writes.clone()))];
            let shape = shape(Kind::Kollmorgen, true);
            holds(shape, &[&off, &[(12, axis, Post(vec![command]))]]);
        }
    }
}

#[test]
fn a_mode_that_native_mode_has_left_is_set_right_before_a_move() {
    for mode in [0, 1, 2, 3] {
        let native = [(0, 0, Post(vec![Native(NativeOwner::Application)])), (3, 0, Write(vec![mode]))];
        holds(shape(Kind::Kollmorgen, true), &[&native, &[(7, 0, Post(vec![To(100)]))]]);
    }
}

#[test]
fn a_reference_that_was_added_without_power_turns_no_unidrive() {
    let off = [(0, 0, Post(vec![Disable])), (60, 0, Write(vec![4, 5]))];
    for shape in shapes(Kind::Unidrive, false) {
        holds(shape, &[&off, &[]]);
    }
}

#[test]
fn a_request_of_the_homing_that_comes_again_ends_no_move() {
    for shape in shapes(Kind::LinMot, true) {
        for back in [10, 30, 60] {
            let again = (2, 2, RepeatRequest { motion: false, back, us: 1_285 });
            holds(shape, &[&[(0, 2, Post(vec![To(50)])), again]]);
        }
    }
}

#[test]
fn a_move_is_not_done_where_its_motor_turns_round() {
    let coasts = [
        (0, 0, Post(vec![To(50)])),
        (49, 0, Post(vec![Disable])),
        (62, 0, Late(9)),
        (133, 1, Write(vec![10, 6, 6])),
    ];
    // It is enabled while it still turns.
    holds(shape(Kind::Kollmorgen, true), &[&coasts, &[(0, 0, Post(vec![By(-5)]))]]);
}

#[test]
fn a_record_is_not_requested_by_a_telegram_whose_repetition_would_be_a_second_request() {
    let shape = Shape { other: true, ..shape(Kind::Lenze, false) };
    let write = (3, 2, Write(vec![2, 1, 0]));
    for back in [1, 5] {
        holds(shape, &[&[write.clone(), (33, 2, RepeatReply { back, us: 640 })]]);
    }
}

#[test]
fn a_reply_from_before_takes_no_power_and_shows_no_other_place() {
    for shape in shapes(Kind::LinMot, true) {
        let begin = (0, 2, Post(vec![To(100)]));
        let again = |which| (20 + which % 3 * 30, 2, OldReply { which, us: 10 });
        let rounds: Vec<_> = (0..60).map(|which| [begin.clone(), again(which)]).collect();
        holds(shape, &rounds.iter().map(|round| &round[..]).collect::<Vec<_>>());
    }
}

#[test]
fn a_stop_of_a_stopped_axis_that_does_not_stop_it_has_a_time_limit() {
    let shape = Shape { group: 0b111, ..shape(Kind::LinMot, true) };
    let stopped = (0, 1, Fault);
    for which in (2..18).step_by(4) {
        // A motion of another sender that has the count of the stop itself.
        let round = |at| [stopped.clone(), (at, 2, Foreign { which, us: 1_065 }), (at, 2, Post(vec![Stop]))];
        let rounds: Vec<_> = (60..76).map(round).collect();
        holds(shape, &rounds.iter().map(|round| &round[..]).collect::<Vec<_>>());
    }
}

#[test]
fn a_member_that_has_no_power_is_not_left_to_the_application_while_another_one_moves() {
    let shape = Shape { other: true, free_writes: true, group: 0b11, ..shape(Kind::Kollmorgen, false) };
    let native = Together(vec![Native(NativeOwner::Application), Jog(100), Torque]);
    holds(shape, &[&[(2, 0, Post(vec![Disable])), (3, 2, native), (229, 1, Write(vec![11, 5, 1]))]]);
}
