//! Loads that drop when nothing holds them, and the hardware enable (STO) that takes the power away.

use fieldbeat::axis::{
    Abort, Command, EventKind, Failure, HeldBy, Load, Outcome, State, StopCause, StopThen, StopTimeout,
};
use fieldbeat::bus::linudp::ControlWord;
use fieldbeat::telemetry::Condition;
use fieldbeat::time::MS;

use crate::virtual_time::support::*;

fn vertical(held_by: HeldBy) -> Rig {
    Rig::new(1).each(move |_, drive| {
        drive.axis.load = Load::Vertical(held_by);
        if held_by == HeldBy::Drive {
            (drive.axis.stop.then, drive.axis.stop.on_timeout) = (StopThen::Hold, StopTimeout::Hold);
        }
    })
}

#[test]
fn a_load_that_only_the_drive_holds_is_never_powered_off_by_the_master() {
    // By the loss of its link, by the end of the master, and by an impatient end.
    for (lose, requested) in [(false, 1), (true, 1), (false, 2), (true, 2)] {
        let mut b = vertical(HeldBy::Drive).ready();
        let from = b.tape(0).received.len();
        b.post(0, slowly_to(150.0));
        b.run(200);
        if lose {
            b.world().unplug(address(0));
            assert_eq!(b.stopped(0, 20), StopCause::LinkLost);
            b.run(300);
            b.world().plug(address(0));
            b.online();
            b.until("standstill", 1_000, |b| !b.feedback(0).status.moving);
        }
        (1..requested).for_each(|_| b.sim.stop());
        b.shut_down(10_000);
        let off = |received: &Delivery| {
            received.request.control.is_some_and(|control| !control.has(ControlWord::SWITCH_ON))
        };
        assert!(!b.tape(0).received[from..].iter().any(off), "lost {lose}, requested {requested} times");
        assert_eq!(b.feedback(0).status.state, State::OperationEnabled);
        assert!(b.feedback(0).status.velocity.abs() < 1.0);
        let left = b.finish().drives[0].at_end.clone().unwrap();
        assert!(left.condition == Condition::Held && left.is_safe(), "{left:?}");
    }
}

#[test]
fn the_hardware_enable_is_seen_as_a_state_and_a_stop_of_its_own_name() {
    let mut b = Rig::new(2).each(|_, drive| drive.axis.stop.group = Some(1)).ready();
    let id = b.post(0, slowly_to(150.0));
    b.run(200);
    assert!(!b.feedback(0).status.sto_open);
    b.world().open_sto(address(0), 300 * MS);
    assert_eq!(b.stopped(0, 10), StopCause::StoOpen);
    assert_eq!(b.feedback(1).stopped, Some(StopCause::Group));
    assert!(b.feedback(0).status.sto_open && !b.feedback(0).status.state.is_powered());
    assert_eq!(b.outcome(0, id), Some(Outcome::Aborted(Abort::Stopped(StopCause::StoOpen))));
    b.run(50);
    b.done(0, Command::Reset);
    assert_eq!(b.failed(0, Command::Enable), Failure::StoOpen, "named before anything is tried");
    b.until("the hardware enable is back", 400, |b| !b.feedback(0).status.sto_open);
    b.run(100);
    assert!(!b.feedback(0).status.state.is_powered(), "and nothing comes on by itself");
    let reported: Vec<EventKind> =
        b.kinds(0).into_iter().filter(|kind| matches!(kind, EventKind::StoClosed(_))).collect();
    assert_eq!(reported, [EventKind::StoClosed(false), EventKind::StoClosed(true)]);
    b.done(0, Command::Enable);
    b.done(0, to(20.0));
}
