//! The wires are taken from the loop, as by a watch on another thread: it sends nothing more, receives nothing, latches
//! every axis and ends. That it found them taken is in the log of its inputs.

use std::sync::{Arc, OnceLock};

use fieldbeat::axis::{Abort, CommandId, Outcome, StopCause};
use fieldbeat::sim::WorldOptions;
use fieldbeat::{Flow, Master, Plan};
use fieldbeat_core::rt::{Taker, Wires};
use fieldbeat_replay::machine::TaskOf;

use super::replay::{Log, replay};
use super::support::{Bench, Rig, bus, drive, slowly_to};

/// The step in which the loop finds them taken, after so many sends of its own. A command was posted before that.
#[track_caller]
fn ends(b: &mut Bench, posted: CommandId, sends: u64) {
    let before = b.sends() + sends;
    assert_eq!(b.step(), Flow::End);
    assert_eq!(b.sends(), before);
    assert!(b.sim.wires().gave_way());
    let latched = Outcome::Aborted(Abort::Stopped(StopCause::LoopStuck));
    assert_eq!(b.outcome(0, posted), Some(latched), "what was posted ends with it");
    for index in [0, 1] {
        assert_eq!(b.feedback(index).stopped, Some(StopCause::LoopStuck));
    }
    let status = b.status();
    assert_eq!(status.planned, status.executed + status.skipped, "{status:?}");
}

#[test]
fn a_loop_that_finds_its_wires_taken_sends_nothing_more_and_latches_every_axis() {
    let mut b = Rig::new(2).ready();
    b.run(10);
    let posted = b.post(0, slowly_to(150.0));
    assert!(b.sim.wires().take(Taker::Watch));
    let looks = b.looks();
    ends(&mut b, posted, 0);
    assert_eq!(b.looks(), looks, "it reads no replies either");
}

#[test]
fn a_task_that_returns_after_the_wires_were_taken_commands_nothing_more() {
    let wires = Arc::new(OnceLock::<Wires>::new());
    let of_task = Arc::clone(&wires);
    let mut b = Rig::new(2)
        .task(move |_, _| {
            // As if it had not returned for so long.
            if let Some(wires) = of_task.get() {
                wires.take(Taker::Watch);
            }
        })
        .ready();
    b.run(10);
    let posted = b.post(0, slowly_to(150.0));
    wires.set(b.sim.wires().clone()).unwrap();
    ends(&mut b, posted, 1);
}

#[test]
fn an_end_by_itself_is_none_that_can_be_taken() {
    let mut b = Rig::new(2).ready();
    b.shut_down(5_000);
    assert!(b.sim.wires().have_ended() && !b.sim.wires().take(Taker::Watch));
    assert_eq!(b.feedback(0).stopped, Some(StopCause::Shutdown));
    // One that is taken during the orderly end keeps the first cause.
    let mut b = Rig::new(2).ready();
    b.sim.stop();
    b.run(3);
    assert!(b.sim.wires().take(Taker::Watch));
    assert_eq!(b.step(), Flow::End);
    assert!(b.sim.wires().gave_way());
    assert_eq!(b.feedback(0).stopped, Some(StopCause::Shutdown));
}

#[test]
fn a_recorded_loop_from_which_the_wires_were_taken_ends_in_the_same_cycle_when_it_is_repeated() {
    let plan = || {
        let bus = bus(vec![drive(0), drive(1)]);
        Plan { buses: vec![Box::new(bus)], ..Plan::default() }
    };
    let log = Log::default();
    let mut sim = log.of(Master::from_plan(plan())).simulate(WorldOptions::default()).unwrap();
    sim.run(300);
    assert!(sim.wires().take(Taker::Watch));
    assert_eq!(sim.step(), Flow::End);
    assert_eq!(sim.feedback(0).stopped, Some(StopCause::LoopStuck));
    let end = sim.finish().status;
    let mut repeated = replay(plan(), log.words().remove(0), TaskOf::Nobody);
    let verdict = repeated.run();
    assert!(verdict.is_equal() && verdict.telegrams > 0, "{verdict:?}");
    assert_eq!(repeated.feedback(0).stopped, Some(StopCause::LoopStuck));
    assert_eq!((repeated.status().executed, repeated.status().planned), (end.executed, end.planned));
}
