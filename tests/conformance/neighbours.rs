//! One drive never hurts another: whatever befalls the first of three, the others do not notice.

use fieldbeat::axis::Verb;
use fieldbeat::bus::Counters;
use fieldbeat::sim::FaultPlan;
use fieldbeat::time::US;

use crate::line::{Line, PERIOD};
use crate::subject::Subject;

/// Two drives move while `befall` happens to the first in each cycle: they end as they would have, and no count of
/// theirs differs.
fn unnoticed(subject: &'static dyn Subject, befall: impl Fn(&mut Line, u64)) {
    let run = |befall: &dyn Fn(&mut Line, u64)| {
        let mut line = Line::made_ready(subject, 3);
        line.set_going(0, line.motion());
        line.honest = false;
        for index in [1, 2] {
            let verb = if line.can.positions { line.by(index, 0.2) } else { line.go(index) };
            line.order(index, verb);
        }
        let before = [1, 2].map(|index| line.slots[index].counters.unsent);
        for turn in 0..600 {
            if turn == 300 && !line.can.positions {
                for index in [1, 2] {
                    line.order(index, Verb::Stop { deceleration: None });
                }
            }
            befall(&mut line, turn);
            line.turn();
            for index in [1, 2] {
                let seen = &line.seen[index];
                assert!(!seen.missed() && !seen.suspect, "drive {index}: {seen:?}");
            }
        }
        assert_eq!(before, [1, 2].map(|index| line.slots[index].counters.unsent));
        [1, 2].map(|index| {
            assert_eq!(line.end(index), Some(Ok(())), "drive {index}");
            let Counters { sent, answered, .. } = line.slots[index].counters;
            (line.slots[index].counters, sent - answered, line.said(index))
        })
    };
    let alone = run(&|_, _| {});
    assert_eq!(run(&befall), alone);
}

pub fn the_silence_of_one_troubles_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| line.mute(0, turn > 10));
}

pub fn the_absence_of_one_troubles_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| {
        let address = line.wire.address(0);
        match turn {
            10 => assert!(line.world.unplug(address)),
            400 => assert!(line.world.plug(address)),
            _ => {}
        }
    });
}

pub fn the_garbage_of_one_troubles_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| {
        if turn == 0 {
            line.faults(0, FaultPlan { corrupt: 1.0, ..FaultPlan::default() });
        }
        let bytes = vec![turn as u8; turn as usize % 90];
        for ns in [5 * US, 100 * US, PERIOD - 100 * US] {
            line.inject(0, line.wire.address(0), &bytes, ns);
        }
    });
}

pub fn replies_of_one_that_come_twice_or_late_trouble_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| {
        if turn == 0 {
            let plan =
                FaultPlan { seed: 5, duplicate: 0.5, delay: 0.5, delay_ns: 800 * US, ..FaultPlan::default() };
            line.faults(0, plan);
        }
    });
}

pub fn refused_sends_to_one_trouble_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| line.wire.log().drives[0].jammed = turn % 3 != 0);
}

pub fn restarts_of_one_trouble_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| {
        if turn % 150 == 10 {
            assert!(line.world.restart(line.wire.address(0)));
        }
    });
}

pub fn orders_to_one_trouble_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| {
        if turn % 7 == 0 {
            let verbs = crate::line::verbs(line, 0);
            line.order(0, verbs[turn as usize / 7 % verbs.len()]);
        }
        if turn == 590 {
            line.order(0, Verb::Disable);
        }
    });
}
