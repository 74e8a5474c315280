//! Groups: what takes effect for all members in one cycle's send, or for none; and what takes the whole group along.

use std::sync::atomic::{AtomicBool, Ordering};

use fieldbeat::Master;
use fieldbeat::axis::{
    Abort, BegunBy, Command, CommandId, EventKind, Failure, Group, GroupError, Health, Outcome, Row,
    StopCause, Underrun,
};
use fieldbeat::bus::linudp::{ControlWord, MotionBlock};
use fieldbeat::sim::WorldOptions;
use fieldbeat::time::Time;

use crate::virtual_time::support::*;

/// Machines of so many axes that stop together; those of `members` have joined and are in operation. Two of them have
/// room for 1024 rows.
fn rig(count: usize) -> Rig {
    Rig::new(count).each(|_, drive| (drive.axis.stop.group, drive.axis.stream_queue) = (Some(1), 2 * 1_024))
}

fn joined(count: usize, members: &[usize]) -> Bench {
    let mut b = rig(count).ready();
    b.join(members);
    b
}

/// How many requests each of the first drives has received.
fn received(b: &Bench, count: usize) -> Vec<usize> {
    (0..count).map(|index| b.tape(index).received.len()).collect()
}

/// The time when the drive received each new motion command, by its header without the count.
fn motions(b: &Bench, index: usize, from: usize) -> Vec<(Time, u16)> {
    let mut last: Option<MotionBlock> = None;
    let mut motions = Vec::new();
    for received in &b.tape(index).received[from..] {
        if let Some(motion) = received.request.motion
            && last != Some(motion)
        {
            motions.push((received.at, motion.header & 0xFFF0));
            last = Some(motion);
        }
    }
    motions
}

#[test]
fn a_group_command_reaches_all_members_in_one_send_in_any_state() {
    let mut b = joined(4, &[2, 0, 3]);
    let from = received(&b, 4);
    b.group_done(&[to(10.0), to(20.0), to(30.0)]);
    let sent: Vec<Time> = [2, 0, 3].map(|index| motions(&b, index, from[index])[0].0).to_vec();
    assert!(sent.iter().all(|at| *at == sent[0]), "{sent:?}");
    assert!(motions(&b, 1, from[1]).is_empty(), "no member");
    for (index, position) in [(2, 10.0), (0, 20.0), (3, 30.0)] {
        assert_near(b.feedback(index).status.demand, position, 0.001);
    }
    // Members that are ready at different times begin together all the same: one has a longer way.
    let first = b.group().post(&[to(11.0), slowly_to(25.0), to(31.0)]).unwrap();
    let second = b.group().post_all(Command::Home).unwrap();
    assert!(b.group_ended(&first).iter().all(|outcome| *outcome == Outcome::Done));
    assert!(b.group_ended(&second).iter().all(|outcome| *outcome == Outcome::Done));
    let begun: Vec<Time> = [2, 0, 3]
        .map(|index| {
            let homes = |received: &&Delivery| received.request.control == Some(ControlWord::HOME);
            b.tape(index).received[from[index]..].iter().find(homes).unwrap().at
        })
        .to_vec();
    assert!(begun.iter().all(|at| *at == begun[0]), "{begun:?}");
}

#[test]
fn one_member_that_cannot_keeps_all_others_from_it() {
    let mut b = joined(3, &[0, 1, 2]);
    b.group_done(&[to(100.0), to(100.0), to(100.0)]);
    let from = received(&b, 3);
    // Refused in the loop: member 1 would leave its range. The reason is reported to the others.
    let command = b.group().post(&[Command::Disable, Command::Disable, Command::Disable]).unwrap();
    assert_eq!(b.group_ended(&command), [Outcome::Done; 3]);
    let command = b.group().post(&[to(10.0), to(10.0), to(10.0)]).unwrap();
    let outcomes = b.group_ended(&command);
    assert!(
        outcomes.iter().all(|outcome| matches!(outcome, Outcome::Failed(Failure::WrongState(_)))),
        "{outcomes:?}"
    );
    // Member 1 alone is not in operation.
    let on = b.group().post(&[Command::Enable, Command::Reset, Command::Enable]).unwrap();
    assert_eq!(b.group_ended(&on), [Outcome::Done; 3]);
    let command = b.group().post(&[to(10.0), to(10.0), to(10.0)]).unwrap();
    let outcomes = b.group_ended(&command);
    assert_eq!(outcomes[0], Outcome::Failed(Failure::GroupRefused));
    assert!(matches!(outcomes[1], Outcome::Failed(Failure::WrongState(_))), "{outcomes:?}");
    assert_eq!(outcomes[2], Outcome::Failed(Failure::GroupRefused));
    b.run(5);
    for (index, from) in from.into_iter().enumerate() {
        let moved = motions(&b, index, from).iter().any(|(_, header)| *header == 0x0100);
        assert!(!moved, "axis {index}");
    }
}

#[test]
fn numbers_are_checked_for_all_members_before_one_has_anything() {
    let mut b = joined(2, &[0, 1]);
    let refused = b.group().post(&[to(10.0), to(1_000.0)]).unwrap_err().to_string();
    assert!(refused.contains("x1") && refused.contains("outside its limit"), "{refused}");
    assert_eq!(b.group().post(&[to(10.0)]), Err(GroupError::Count { given: 1, members: 2 }));
    let refused = b.group().push_rows(&[row(10.0), row(500.0)]).unwrap_err().to_string();
    assert!(refused.contains("x1"), "{refused}");
    let mixed = [Row { last: true, ..row(1.0) }, row(1.0)];
    assert_eq!(b.group().push_rows(&mixed), Err(GroupError::MixedEnd));
    b.run(20);
    assert!(!b.feedback(0).status.moving && !b.feedback(1).status.moving);
    assert_eq!(b.group().stream_room(), 1024, "no row of a refused call stays behind");
    // A queue that is full at one member takes nothing at the other.
    b.group_done(&[to(10.0), to(10.0)]);
}

#[test]
fn axes_that_cannot_act_together_make_no_group_and_are_given_back() {
    type Change = fn(usize, &mut RigDrive);
    let cases: [(Change, &str); 4] = [
        (|_, drive| drive.axis.stop.group = None, "stop.group"),
        (|index, drive| drive.axis.stop.group = Some(index as u16), "stop.group"),
        (|index, drive| drive.axis.divisor = index as u32 + 1, "divisor"),
        (|index, drive| (drive.axis.divisor, drive.axis.phase) = (2, index as u32), "different cycles"),
    ];
    for (change, named) in cases {
        let mut b = rig(2).each(change).start();
        let refused = Group::new([b.sim.take_axis(0), b.sim.take_axis(1)]).unwrap_err();
        assert!(refused.to_string().contains(named), "{refused}");
        assert_eq!(refused.axes.len(), 2);
    }
    let mut b = rig(2).start();
    let one = Group::new([b.sim.take_axis(0)]).unwrap_err();
    assert!(matches!(*one.reason, GroupError::TooFew(1)));
    let mut other = rig(1).start();
    let two = Group::new([b.sim.take_axis(1), other.sim.take_axis(0)]).unwrap_err();
    assert!(matches!(*two.reason, GroupError::TwoMachines(..)), "{two}");
    assert!(Group::new([]).is_err());
}

#[test]
fn a_full_queue_takes_the_parts_of_all_members_or_none_and_has_room_for_their_stop() {
    let mut b = rig(2).each(|_, drive| drive.axis.command_queue = 6).ready();
    // Member 1 has commands of its own already.
    let own = [b.post(1, Command::Home), b.post(1, Command::Home)];
    b.step();
    b.join(&[0, 1]);
    for stepping in [false, true] {
        let mut posted = Vec::new();
        let full = loop {
            match b.group().post_all(Command::Home) {
                Ok(command) => posted.push(command),
                Err(full) => break full.to_string(),
            }
            assert!(posted.len() < 100);
            b.run(u64::from(stepping));
        };
        assert!(full.contains("home refused: its queue of 6 is full"), "{full}");
        assert!(posted.len() >= 3, "{}", posted.len());
        let stop = b.group().post_all(Command::QuickStop).unwrap();
        assert_eq!(b.group_ended(&stop), [Outcome::Done; 2]);
        for (index, id) in posted.iter().flat_map(|command| command.ids().iter().enumerate()) {
            let outcome = b.outcome(index, *id).unwrap();
            let replaced = Outcome::Aborted(Abort::Replaced(stop.ids()[index]));
            assert!(outcome == replaced || stepping && outcome == Outcome::Done, "{outcome}");
        }
        assert!(own.iter().all(|id| b.outcome(1, *id).is_some()));
    }
    while b.group().stream_room() > 0 {
        b.group().push_rows(&[row(1.0), row(1.0)]).unwrap();
    }
    let full = b.group().push_rows(&[row(1.0), row(1.0)]).unwrap_err().to_string();
    assert!(full.contains("row refused") && full.contains("is full"), "{full}");
}

#[test]
fn a_group_of_the_plan_has_the_full_room_of_a_stream_and_any_other_shares_it() {
    for (members, room) in [([0, 1], 1_024), ([1, 2], 512)] {
        let setup = Master::from_file("../../rt-config/gantry.toml").unwrap();
        let mut sim = setup.simulate(WorldOptions::default()).unwrap();
        let group = Group::new(members.map(|index| sim.take_axis(index))).unwrap();
        assert_eq!(group.stream_room(), room);
        let mut first = group.into_axes().swap_remove(0);
        first.push_row(Row::default()).unwrap();
        assert_eq!(first.stream_room(), 1_023, "alone");
    }
}

/// An arc around 100 mm, in both axes at once; no position of either comes twice.
fn circle(step: u32) -> [Row; 2] {
    let angle = 0.3 + f64::from(step) * 0.001;
    let row = |position: f64, velocity: f64| Row { position, velocity, ..Row::default() };
    let speed = 0.001 * 1_000.0 * 20.0;
    [
        row(100.0 + 20.0 * angle.cos(), -speed * angle.sin()),
        row(100.0 + 20.0 * angle.sin(), speed * angle.cos()),
    ]
}

/// The same as the drive has it, in counts.
fn counts(step: u32, axis: usize) -> i32 {
    (circle(step)[axis].position * PER_MM).round() as i32
}

/// The step of the first so many at which an axis has this place.
fn step_of(position: i32, axis: usize, steps: u32) -> u32 {
    (0..steps).find(|step| counts(*step, axis) == position).expect("a row of the circle")
}

fn streaming(b: &mut Bench, steps: u32) -> fieldbeat::axis::GroupCommand {
    let start = circle(0).map(|row| to(row.position));
    b.group_done(&start);
    for step in 0..steps {
        b.group().push_rows(&circle(step)).unwrap();
    }
    b.group().follow().unwrap()
}

/// The rows that the drive received, in 0.1 um, with their instants; repeated ones once.
fn rows(b: &Bench, index: usize, from: usize) -> Vec<(Time, i32)> {
    let mut rows = Vec::new();
    let mut count = None;
    for received in &b.tape(index).received[from..] {
        if let Some(motion) = received.request.motion.filter(|motion| motion.header & 0xFF00 == 0x0300)
            && count.replace(motion.header & 0xF) != Some(motion.header & 0xF)
        {
            let bytes = motion.parameters[..4].try_into().unwrap();
            rows.push((received.at, i32::from_le_bytes(bytes)));
        }
    }
    rows
}

#[test]
fn rows_are_taken_by_all_members_or_by_none() {
    let mut b = joined(2, &[0, 1]);
    let command = streaming(&mut b, 50);
    let from = received(&b, 2);
    b.run(30);
    for step in 50..200 {
        // Rows come in bursts with gaps, but never run out.
        b.group().push_rows(&circle(step)).unwrap();
        b.run(u64::from(step % 7 == 0) * 7);
    }
    let last = circle(200).map(|row| Row { last: true, velocity: 0.0, ..row });
    b.group().push_rows(&last).unwrap();
    assert_eq!(b.group_ended(&command), [Outcome::Done; 2]);
    let (x, y) = (rows(&b, 0, from[0]), rows(&b, 1, from[1]));
    for step in 0..200 {
        let at = step as usize;
        assert_eq!(x[at].0, y[at].0, "row {step} of both left in one send");
        assert_eq!([x[at].1, y[at].1], [0, 1].map(|axis| counts(step, axis)), "row {step}");
    }
}

#[test]
fn a_stream_that_runs_empty_at_one_member_is_empty_for_all() {
    for (underrun, held) in [(Underrun::Hold, true), (Underrun::Stop, false)] {
        let mut b = rig(2).each(|_, drive| drive.axis.underrun = underrun).ready();
        let start = circle(0);
        for (index, row) in start.iter().enumerate() {
            b.done(index, to(row.position));
        }
        // Rows from before it joined belong to no path of the group.
        for _ in 0..3 {
            b.sim.axis(0).push_row(start[0]).unwrap();
        }
        let from = received(&b, 2);
        b.join(&[0, 1]);
        for step in 0..40 {
            b.group().push_rows(&circle(step)).unwrap();
        }
        let command = b.group().follow().unwrap();
        b.run(60);
        let reported =
            |b: &Bench, index| b.kinds(index).iter().filter(|kind| **kind == EventKind::Underrun).count();
        assert_eq!((reported(&b, 0), reported(&b, 1)), (1, 1));
        let received = |b: &Bench, index: usize| {
            let mut rows: Vec<i32> = rows(b, index, from[index]).into_iter().map(|(_, row)| row).collect();
            rows.dedup();
            rows
        };
        for index in 0..2 {
            let path: Vec<i32> = (0..40).map(|step| counts(step, index)).collect();
            assert_eq!(received(&b, index), path, "axis {index}");
        }
        if held {
            for step in 40..80 {
                b.group().push_rows(&circle(step)).unwrap();
            }
            b.run(30);
            assert!(b.feedback(0).stopped.is_none() && b.outcome(0, command.ids()[0]).is_none());
            assert!(received(&b, 1).len() > 40, "it goes on when both have rows again");
        } else {
            assert!((0..2).all(|index| b.feedback(index).stopped.is_some()));
        }
    }
}

#[test]
fn a_row_that_one_member_may_not_take_is_sent_to_none() {
    // The first row is far from the demand of member 1: only the loop can know.
    let mut b = joined(2, &[0, 1]);
    b.group_done(&[to(120.0), to(50.0)]);
    let from = received(&b, 2);
    for step in 0..10 {
        b.group().push_rows(&circle(step)).unwrap();
    }
    let command = b.group().follow().unwrap();
    let outcomes = b.group_ended(&command);
    assert!(matches!(outcomes[1], Outcome::Failed(Failure::Limit { .. })), "{outcomes:?}");
    assert_eq!(outcomes[0], Outcome::Aborted(Abort::Stopped(StopCause::Group)));
    // The stop and the end of the command name who began it, and nothing else does.
    let by = Some(BegunBy { axis: 1, cause: StopCause::Limit });
    let named: Vec<_> = b.events.iter().filter(|(_, event)| event.begun_by == by).collect();
    let named: Vec<_> = named.into_iter().map(|(axis, event)| (*axis, event.kind)).collect();
    let ended = EventKind::Ended { id: command.ids()[0], command: "follow", outcome: outcomes[0] };
    assert_eq!(named, [(0, EventKind::Stopped(StopCause::Group)), (0, ended)]);
    assert_eq!(b.events.iter().filter(|(_, event)| event.begun_by.is_some()).count(), 2);
    assert_eq!([0, 1].map(|index| b.feedback(index).begun_by), [by, None]);
    b.run(20);
    assert!(rows(&b, 0, from[0]).is_empty() && rows(&b, 1, from[1]).is_empty());
    assert_eq!(b.feedback(1).stopped, Some(StopCause::Limit));
}

#[test]
fn misses_of_all_members_together_stop_the_group() {
    // No member alone loses its link: a bucket holds 8, and three lose 3 each.
    let health = Health { bucket: 8, leak: 1_000, ..Health::default() };
    let mut b = rig(3).each(|_, drive| drive.axis.health = health).ready();
    b.join(&[0, 1, 2]);
    let command = b.group().post(&[slowly_to(150.0); 3]).unwrap();
    b.run(50);
    for index in 0..3 {
        b.tape(index).mute = true;
        b.run(3);
        b.tape(index).mute = false;
        b.run(2);
        let stopped = b.feedback(0).stopped;
        assert_eq!(stopped.is_some(), index == 2, "after {} misses", 3 * (index + 1));
    }
    for index in 0..3 {
        assert_eq!(b.feedback(index).stopped, Some(StopCause::GroupLink));
        let missed = b.kinds(index).iter().filter(|kind| **kind == EventKind::MissedInGroup).count();
        assert!((2..=3).contains(&missed), "axis {index} reported {missed}");
        let outcome = b.outcome(index, command.ids()[index]);
        assert_eq!(outcome, Some(Outcome::Aborted(Abort::Stopped(StopCause::GroupLink))));
    }
    // Standing, or each for itself, nothing is counted together.
    let mut b = rig(3).each(|_, drive| drive.axis.health = health).ready();
    b.join(&[0, 1, 2]);
    for index in 0..3 {
        b.tape(index).mute = true;
        b.run(4);
        b.tape(index).mute = false;
        b.run(2);
    }
    assert!((0..3).all(|index| b.feedback(index).stopped.is_none()));
}

/// The strike, counted from 0, that stops the group: so many missed exchanges of a member, and so many rounds after it.
fn struck(divisor: u32, leaks: [u32; 3], buckets: [u32; 3], strikes: &[(usize, u64, u64)]) -> Option<usize> {
    let mut b = rig(3)
        .each(|index, drive| {
            drive.axis.divisor = divisor;
            drive.axis.health = Health { bucket: buckets[index], leak: leaks[index], ..Health::default() };
        })
        .ready();
    b.join(&[0, 1, 2]);
    b.group().post(&[slowly_to(150.0); 3]).unwrap();
    b.run(100);
    strikes.iter().position(|&(member, missed, rounds)| {
        b.tape(member).mute = true;
        b.run(missed * u64::from(divisor));
        b.tape(member).mute = false;
        b.run(rounds * u64::from(divisor));
        let stopped = b.feedback(0).stopped;
        assert!(stopped.is_none_or(|cause| cause == StopCause::GroupLink), "{stopped:?}");
        stopped.is_some()
    })
}

#[test]
fn the_bucket_of_a_group_is_that_of_its_most_sensitive_member() {
    for sensitive in 0..3 {
        let mut buckets = [8; 3];
        buckets[sensitive] = 4;
        let strikes = [((sensitive + 1) % 3, 3, 5), ((sensitive + 2) % 3, 3, 5)];
        assert_eq!(struck(1, [1_000; 3], buckets, &strikes), Some(1), "{sensitive}");
    }
}

#[test]
fn a_group_forgets_a_miss_after_so_many_rounds_without_one() {
    let strikes = [(0, 4, 100), (1, 4, 100), (2, 4, 100)];
    assert_eq!(struck(1, [10; 3], [8; 3], &strikes), None);
    for slow in 0..3 {
        let mut leaks = [10; 3];
        leaks[slow] = 1_000;
        assert_eq!(struck(1, leaks, [8; 3], &strikes), Some(1), "as slowly as member {slow}");
    }
    // Cycles between two exchanges are no rounds.
    let strikes = [(0, 1, 8), (1, 1, 8), (2, 1, 8), (0, 1, 8)];
    assert_eq!(struck(4, [10; 3], [4; 3], &strikes), Some(3));
    assert_eq!(struck(4, [5; 3], [4; 3], &strikes), None);
}

#[test]
fn homing_is_a_motion_of_the_group_and_an_enable_is_none() {
    for (command, counts) in [(Command::Home, true), (Command::Enable, false)] {
        let mut b = joined(2, &[0, 1]);
        b.group().post_all(command).unwrap();
        b.run(2);
        b.tape(1).mute = true;
        b.run(1);
        b.tape(1).mute = false;
        b.run(1);
        assert_eq!(b.kinds(1).contains(&EventKind::MissedInGroup), counts, "{command:?}");
    }
}

#[test]
fn a_row_that_could_not_be_sent_to_one_member_leaves_the_others_in_step() {
    let mut b = joined(2, &[0, 1]);
    let command = streaming(&mut b, 400);
    b.run(20);
    let from = received(&b, 2);
    b.tape(1).jammed = true;
    b.run(1);
    b.tape(1).jammed = false;
    b.run(50);
    assert_eq!(b.outcome(1, command.ids()[1]), None);
    assert!(b.kinds(1).contains(&EventKind::MissedInGroup));
    let (x, y) = (rows(&b, 0, from[0]), rows(&b, 1, from[1]));
    // What was sent in one instant belongs to one step of the circle.
    let mut together = 0;
    for (at, position) in &x {
        if let Some((_, other)) = y.iter().find(|(time, _)| time == at) {
            assert_eq!(*other, counts(step_of(*position, 0, 400), 1), "at {at:?}");
            together += 1;
        }
    }
    assert!(together >= 45, "{together}");
}

/// Two drives, and a master, that bear a long row of misses in a stream.
fn patient() -> Rig {
    rig(2).each(|_, drive| {
        drive.axis.health = Health { bucket: 200, ..Health::default() };
        drive.simulate.stream_patience = 1_000.0;
        drive.simulate.stream_depth = 1_000;
    })
}

#[test]
fn slots_that_are_passed_over_keep_the_members_in_step() {
    let mut b = patient().ready();
    b.join(&[0, 1]);
    streaming(&mut b, 600);
    let from = received(&b, 2);
    for turn in 0..200 {
        if turn % 20 == 5 {
            b.world().delay_next_wake(1_000_000 + turn * 10_000);
        }
        b.step();
    }
    let (x, y) = (rows(&b, 0, from[0]), rows(&b, 1, from[1]));
    assert!(x.len() > 150 && b.status().skipped > 5);
    for ((at, position), (time, other)) in x.iter().zip(&y) {
        assert_eq!(at, time);
        assert_eq!(*other, counts(step_of(*position, 0, 600), 1));
    }
}

#[test]
fn the_task_reaches_a_member_in_motion_with_a_stop_only() {
    let mut b = rig(2)
        .task(|cycle, axes| match cycle.index {
            6_000..6_100 => assert!(axes.command(0, to(1.0)).is_err()),
            6_100 => drop(axes.command(0, Command::Stop { deceleration: None }).unwrap()),
            _ => {}
        })
        .ready();
    b.join(&[0, 1]);
    b.until("cycle 5900", 5_900, |b| b.status().planned >= 5_900);
    let command = b.group().post(&[slowly_to(150.0), slowly_to(150.0)]).unwrap();
    b.until("the stop of the task", 300, |b| b.outcome(0, command.ids()[0]).is_some());
    // Taken out of the motion of its group, it takes the others along.
    assert_eq!(
        b.outcome(0, command.ids()[0]),
        Some(Outcome::Aborted(Abort::Stopped(StopCause::GroupFailed)))
    );
    b.run(1);
    assert_eq!(b.outcome(1, command.ids()[1]), Some(Outcome::Aborted(Abort::Stopped(StopCause::Group))));
}

#[test]
fn velocities_of_all_members_are_set_together_and_refused_together() {
    let mut b = joined(2, &[0, 1]);
    b.group_done(&[to(50.0), to(50.0)]);
    let command = b.group().post_all(Command::Velocity { acceleration: 2_000.0 }).unwrap();
    for _ in 0..300 {
        b.group().set_velocities(&[20.0, 40.0]).unwrap();
        b.step();
    }
    assert_near(b.feedback(0).status.velocity, 20.0, 1.0);
    assert_near(b.feedback(1).status.velocity, 40.0, 1.0);
    assert!(b.group().set_velocities(&[1.0, 5_000.0]).is_err());
    let mixed = b.group().post(&[Command::Follow, Command::Home]);
    assert_eq!(mixed, Err(GroupError::MixedFollow));
    assert!((0..2).all(|index| b.feedback(index).stopped.is_none()));
    b.run(12);
    assert!((0..2).all(|index| b.feedback(index).stopped.is_some()), "nobody sets them any more");
    assert!(matches!(b.outcome(0, command.ids()[0]), Some(Outcome::Aborted(_))));
}

/// The motion commands that the drive was given, each request's one, without the count.
fn motion_of(b: &Bench, index: usize, from: usize) -> Vec<(u16, Vec<u8>)> {
    (b.tape(index).received[from..].iter())
        .map(|received| received.request.motion.unwrap_or_default())
        .map(|motion| (motion.header & 0xFFF0, motion.parameters.to_vec()))
        .collect()
}

#[test]
fn members_never_have_velocities_of_two_sets_however_the_application_and_the_loop_meet() {
    let mut b = rig(2).ready();
    (0..2).for_each(|index| b.done(index, to(100.0)));
    let mut group = Group::new([0, 1].map(|index| b.sim.take_axis(index))).unwrap();
    group.post_all(jog(1.0)).unwrap();
    b.sim.run(10);
    let from = received(&b, 2);
    let (ends, mut changes) = (AtomicBool::new(false), 0);
    std::thread::scope(|scope| {
        let ends = &ends;
        scope.spawn(move || {
            let velocities = (0..40).map(|step| f64::from(step - 20) * 0.1).cycle();
            for velocity in velocities.take_while(|_| !ends.load(Ordering::Relaxed)) {
                let _ = group.set_velocities(&[velocity, velocity]);
            }
        });
        for _ in 0..100 {
            b.sim.run(100);
            let given = motion_of(&b, 0, from[0]);
            changes = given.windows(2).filter(|two| two[0] != two[1]).count();
            if changes > 500 {
                break;
            }
            std::thread::yield_now();
        }
        ends.store(true, Ordering::Relaxed);
    });
    assert!(changes > 50, "{changes}");
    let [x, y] = [0, 1].map(|index| motion_of(&b, index, from[index]));
    let differ = x.iter().zip(&y).filter(|(x, y)| x != y).count();
    assert_eq!((x.len(), differ), (y.len(), 0), "of {changes} changes");
}

#[test]
fn a_stop_is_given_although_the_other_parts_of_its_call_are_refused() {
    let stop = Command::Stop { deceleration: None };
    // Refused by its numbers, and as no command for one member alone.
    for (other, named) in [(jog(5_000.0), "velocity"), (Command::Follow, "some members follow")] {
        let mut b = joined(3, &[0, 1, 2]);
        b.group_done(&[to(50.0); 3]);
        b.group().post_all(jog(5.0)).unwrap();
        b.run(50);
        let refused = b.group().post(&[other, stop, Command::QuickStop]).unwrap_err();
        assert!(refused.to_string().contains(named), "{refused}");
        assert!(refused.to_string().ends_with("the stops of the same call were given all the same"));
        let GroupError::Partly { posted, .. } = refused else { panic!("{refused}") };
        assert_eq!(posted.ids()[0], CommandId(0));
        assert!(posted.ids()[1..].iter().all(|id| *id != CommandId(0)));
        // The member that would go on alone stops, too: the stop of the application is one of the group.
        b.run(1);
        let stopped = [0, 1, 2].map(|index| b.feedback(index).stopped);
        assert_eq!(stopped, [Some(StopCause::Group), Some(StopCause::GroupFailed), Some(StopCause::Group)]);
        b.run(300);
        assert!((0..3).all(|index| !b.feedback(index).status.moving));
    }
    // A stop that is refused itself keeps no other from it, and nothing else begins.
    let mut b = joined(3, &[0, 1, 2]);
    let invalid = Command::Stop { deceleration: Some(-1.0) };
    let refused = b.group().post(&[invalid, stop, to(100.0)]).unwrap_err();
    let GroupError::Partly { posted, .. } = refused else { panic!("{refused}") };
    assert_eq!(posted.ids().iter().map(|id| *id != CommandId(0)).collect::<Vec<_>>(), [false, true, false]);
    assert_eq!(b.ended(1, posted.ids()[1]), Outcome::Done);
    b.run(50);
    assert!(!b.feedback(2).status.moving);
}

#[test]
fn a_stop_in_a_call_that_finds_the_queue_full_is_given() {
    let mut b = rig(2).each(|_, drive| drive.axis.command_queue = 6).ready();
    b.join(&[0, 1]);
    while b.group().post_all(Command::Home).is_ok() {}
    let stop = Command::Stop { deceleration: None };
    let mixed = [Command::Home, stop];
    let mut given = Vec::new();
    // The places of the queue that are reserved for stops, and then those of the member's own one.
    loop {
        match b.group().post(&mixed).unwrap_err() {
            GroupError::Partly { posted, refused } => {
                assert!(refused.to_string().contains("is full"), "{refused}");
                given.push(posted.ids()[1]);
            }
            GroupError::Axis(full) => {
                assert!(full.to_string().contains("is full"), "{full}");
                break;
            }
            other => panic!("{other}"),
        }
        assert!(given.len() < 100);
    }
    assert!(given.len() >= 4, "{}", given.len());
    let outcomes: Vec<Outcome> = given.iter().map(|id| b.ended(1, *id)).collect();
    assert_eq!(outcomes.last(), Some(&Outcome::Done), "{outcomes:?}");
}

#[test]
fn groups_are_refused_after_the_end_of_the_master() {
    let mut b = rig(2).online();
    let mut group = Group::new([0, 1].map(|index| b.sim.take_axis(index))).unwrap();
    drop(b.finish());
    let gone = group.post(&[Command::QuickStop, Command::Home]).unwrap_err();
    assert!(matches!(gone, GroupError::Axis(fieldbeat::axis::AxisError::Gone { .. })), "{gone}");
}
