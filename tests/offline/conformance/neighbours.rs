//! One drive never hurts another: whatever befalls the first of three, the others do not notice.

use fieldbeat::axis::Command;
use fieldbeat::sim::FaultPlan;
use fieldbeat::telemetry::Counters;
use fieldbeat::time::US;
use fieldbeat_core::bus::{Exchange, Slot};

use crate::conformance::line::{Line, PERIOD};
use crate::conformance::subject::{Said, Subject};

fn is_open(slot: &Slot) -> bool {
    matches!(slot.exchange, Exchange::Owed { .. } | Exchange::Queued)
}

/// Two drives move while `befall` happens to the first in each cycle: they end as they would have, and no count of
/// theirs differs.
fn unnoticed(subject: &'static dyn Subject, befall: impl Fn(&mut Line, u64)) {
    let run = |befall: &dyn Fn(&mut Line, u64)| {
        let mut line = Line::made_ready(subject, 3);
        line.set_going(0, line.motion());
        line.honest = false;
        for index in [1, 2] {
            let command = if line.can.positions { line.by(index, 0.2) } else { line.go(index) };
            line.order(index, command);
        }
        let before = [1, 2].map(|index| line.slots[index].counters.unsent);
        for turn in 0..600 {
            if turn == 300 && !line.can.positions {
                for index in [1, 2] {
                    line.order(index, Command::Stop { deceleration: None });
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
        if line.can.half_duplex {
            // Where they take turns, another one may be the last.
            line.until("the end of all turns", 2, |line| !line.slots.iter().any(is_open));
        }
        [1, 2].map(|index| {
            assert_eq!(line.end(index), Some(Ok(())), "drive {index}");
            let Counters { sent, answered, .. } = line.slots[index].counters;
            // To the nanosecond its request may have left at another time.
            let said = Said { at: None, ..line.said(index) };
            let mut counters = line.slots[index].counters;
            if line.can.bytes {
                // The load of the wire is one of them.
                counters.own = Counters::default().own;
            }
            (counters, sent - answered, said)
        })
    };
    let alone = run(&|_, _| {});
    assert_eq!(run(&befall), alone);
}

/// The same where one frame is for all: what befalls it befalls each of them alike, exchange by exchange and count by
/// count.
fn alike(subject: &'static dyn Subject, befall: impl Fn(&mut Line, u64)) {
    let mut line = Line::made_ready(subject, 3);
    line.set_going(0, line.motion());
    line.settle();
    let before = [0, 1, 2].map(|index| line.slots[index].counters);
    let mut odd = 0;
    for turn in 0..600 {
        befall(&mut line, turn);
        line.turn();
        let kinds: Vec<_> = line.seen.iter().map(|seen| (seen.exchange, seen.fresh, seen.suspect)).collect();
        assert!(kinds.iter().all(|kind| *kind == kinds[0]), "in cycle {turn}: {kinds:?}");
        odd += u64::from(!line.seen[0].answered());
    }
    assert!(odd > 100, "only {odd} exchanges were befallen");
    let counts = [0, 1, 2].map(|index| {
        let c = &line.slots[index].counters;
        let (all, was) = ([c, &before[index]]).map(reported).into();
        all.iter().zip(was).map(|(now, was)| now - was).collect::<Vec<_>>()
    });
    assert!(counts.iter().all(|count| *count == counts[0]), "{counts:?}");
}

/// What was counted of a drive's exchanges and replies.
fn reported(c: &Counters) -> [u64; 9] {
    [c.sent, c.unsent, c.answered, c.missed, c.late, c.duplicate, c.suspect, c.malformed, c.foreign]
}

pub fn the_silence_of_one_troubles_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| line.mute(0, turn > 10));
}

pub fn the_absence_of_one_troubles_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| match turn {
        10 => line.plug(0, false),
        400 => line.plug(0, true),
        _ => {}
    });
}

pub fn the_garbage_of_one_troubles_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| {
        // What is broken on a shared frame is broken for all.
        if turn == 0 && !line.can.shared {
            line.faults(0, FaultPlan { corrupt: 1.0, ..FaultPlan::default() });
        }
        if line.can.bytes {
            // It would meet what others send.
            return;
        }
        let bytes = vec![turn as u8; turn as usize % 90];
        for ns in [5 * US, 100 * US, PERIOD - 100 * US] {
            line.inject(0, line.wire.address(0), &bytes, ns);
        }
    });
}

pub fn replies_of_one_that_come_twice_or_late_trouble_no_other(subject: &'static dyn Subject) {
    if subject.can().shared {
        return alike(subject, |line, turn| {
            if turn == 0 {
                let plan = FaultPlan {
                    seed: 5,
                    duplicate: 0.3,
                    delay: 0.3,
                    delay_ns: 800 * US,
                    ..FaultPlan::default()
                };
                line.faults(0, plan);
            }
        });
    }
    unnoticed(subject, |line, turn| {
        if turn == 0 {
            let plan =
                FaultPlan { seed: 5, duplicate: 0.5, delay: 0.5, delay_ns: 800 * US, ..FaultPlan::default() };
            line.faults(0, plan);
        }
    });
}

pub fn refused_sends_to_one_trouble_no_other(subject: &'static dyn Subject) {
    if subject.can().shared {
        return alike(subject, |line, turn| line.wire.log().drives[0].jammed = turn % 3 != 0);
    }
    unnoticed(subject, |line, turn| line.wire.log().drives[0].jammed = turn % 3 != 0);
}

pub fn restarts_of_one_trouble_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| {
        if turn % 150 == 10 {
            line.restart(0);
        }
    });
}

pub fn orders_to_one_trouble_no_other(subject: &'static dyn Subject) {
    unnoticed(subject, |line, turn| {
        if turn % 7 == 0 {
            let commands = crate::conformance::line::commands(line, 0);
            line.order(0, commands[turn as usize / 7 % commands.len()]);
        }
        if turn == 590 {
            line.order(0, Command::Disable);
        }
    });
}
