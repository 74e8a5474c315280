//! When something is sent, what is owed for it, and how long a window stays open.

use fieldbeat::axis::Verb;
use fieldbeat::bus::Exchange;
use fieldbeat::rt::Clock;
use fieldbeat::sim::FaultPlan;
use fieldbeat::time::US;

use crate::line::{LATENCY, Line, PERIOD, WINDOW};
use crate::subject::{Subject, not_applicable};

pub fn nothing_is_sent_for_a_slot_that_is_not_due(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 3);
    line.asleep[1] = true;
    line.turns(100);
    assert_eq!(line.heard(1), 0, "never due, never asked");
    line.asleep[1] = false;
    line.ready();
    line.settle();
    let (heard, counters) = (line.heard(1), line.slots[1].counters);
    line.asleep[1] = true;
    // Not even for an order.
    let verb = line.by(1, 0.1);
    line.order(1, verb);
    line.turns(100);
    assert_eq!((line.heard(1), line.slots[1].counters), (heard, counters));
}

pub fn each_due_slot_is_one_request_and_one_exchange(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 3);
    let mut random = fastrand::Rng::with_seed(1);
    let mut due = [0; 3];
    for _ in 0..600 {
        line.asleep.fill_with(|| random.bool());
        line.turn_and_hear();
        for (index, due) in due.iter_mut().enumerate() {
            *due += u64::from(line.slots[index].due);
            let sent = line.slots[index].counters.sent;
            assert_eq!((line.heard(index) as u64, sent), (*due, *due), "drive {index}");
        }
    }
    assert!(due.iter().all(|due| *due > 100), "{due:?}");
}

pub fn a_request_that_is_built_again_is_the_same_to_the_byte(subject: &'static dyn Subject) {
    // Through all verbs, on a wire that loses replies, with a system that refuses some sends.
    let script = |builds| {
        let mut line = Line::new(subject, 2);
        line.builds = builds;
        line.ready();
        for (turn, verb) in crate::line::verbs(&line, 0).into_iter().enumerate() {
            line.faults(0, FaultPlan { seed: turn as u64, drop: 0.1, ..FaultPlan::default() });
            line.stream(0, 0.01, 40);
            line.order(0, verb);
            for n in 0..150 {
                line.wire.log().drives[0].jammed = n % 40 == 20;
                line.turn();
            }
            line.order(0, Verb::Enable);
            line.turns(400);
        }
        [0, 1].map(|index| line.requests(index))
    };
    let once = script(1);
    assert!(once == script(3), "prepare was called more than once for the same send");
}

pub fn only_the_order_that_stands_at_the_last_build_is_carried_out(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 1);
    let (before, distance) = (line.slots[0].report.demand, line.way(0, 0.1));
    for instead in [None, Some(Verb::Stop { deceleration: None })] {
        line.settle();
        let verb = line.by(0, 0.5);
        line.order(0, verb);
        line.prepare();
        line.order(0, instead);
        line.turns(300);
        assert_eq!(line.slots[0].report.demand, before, "replaced by {instead:?} before it went out");
    }
    // One that stands is carried out once, however often it was built and for whichever slot.
    line.builds = 3;
    let verb = line.by(0, 0.1);
    line.order(0, verb);
    for _ in 0..3 {
        line.prepare();
        line.index += 2;
    }
    assert_eq!(line.ended(0), Ok(()));
    line.turns(100);
    let moved = line.slots[0].report.demand - before;
    assert!((moved - distance).abs() < distance * 1e-3, "moved by {moved} instead of {distance}");
}

pub fn receive_never_waits(subject: &'static dyn Subject) {
    // The referee looks at the clock around each call.
    let mut line = Line::new(subject, 2);
    line.online();
    line.mute(0, true);
    for _ in 0..10 {
        line.prepare();
        let grid = line.cycle().grid;
        line.world.clock().sleep_until(grid);
        line.receive();
        line.send();
        for _ in 0..20 {
            line.receive();
        }
        line.window();
        line.receive();
        line.judge();
    }
}

pub fn a_window_is_open_for_what_it_owes_and_for_nothing_else(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 2);
    line.online();
    let later = line.can.answers_after > 0;
    let open = |line: &mut Line, asked: [bool; 2]| {
        line.asleep = asked.map(|asked| !asked).to_vec();
        line.settle();
        line.prepare();
        let grid = line.cycle().grid;
        line.world.clock().sleep_until(grid);
        let before = line.receive();
        line.send();
        let after = line.receive();
        line.window();
        let end = line.receive();
        line.judge();
        (before, after, end)
    };
    // True, false while a reply is owed here, true with the last reply.
    assert_eq!(open(&mut line, [false, false]), (true, true, true));
    assert_eq!(open(&mut line, [true, true]), (true, later, true));
    line.turns(4);
    line.mute(0, true);
    assert_eq!(open(&mut line, [true, true]), (true, later, later), "one is silent");
    line.turns(4);
    assert_eq!(open(&mut line, [false, true]), (true, later, true), "the silent one is not due");
}

pub fn what_is_still_owed_is_not_asked_again(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 1);
    line.online();
    if line.can.answers_after == 0 {
        return not_applicable(
            subject,
            "a slot that is due while it is owed",
            "all is closed by the next send",
        );
    }
    line.settle();
    line.turn_and_hear();
    let (exchange, counters, heard) = (line.slots[0].exchange, line.slots[0].counters, line.heard(0));
    assert!(matches!(exchange, Exchange::Owed { .. }));
    let cycle = line.cycle();
    line.slots[0].due = true;
    line.build(&cycle);
    line.world.clock().sleep_until(cycle.grid);
    line.send();
    line.world.advance(2 * LATENCY);
    assert_eq!((line.slots[0].exchange, line.slots[0].counters), (exchange, counters));
    assert_eq!(line.heard(0), heard);
    line.window();
    line.judge();
    assert!(line.seen[0].answered());
}

pub fn what_is_not_answered_in_its_window_is_open_until_the_loop_calls_it_missed(
    subject: &'static dyn Subject,
) {
    let mut line = Line::new(subject, 1);
    line.online();
    line.mute(0, true);
    for missed in 1..=4 {
        assert!(line.exchange(0).missed());
        assert_eq!(line.slots[0].counters.missed, missed);
    }
    line.mute(0, false);
    assert!(line.exchange(0).answered());
}

pub fn a_flood_is_taken_in_by_bounded_bites(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 2);
    line.online();
    if subject.malformed(&line.reply(0)).is_empty() {
        return not_applicable(subject, "a flood", "no datagrams on its carrier");
    }
    const FLOOD: u64 = 3_000;
    const BITE: u64 = 1_024;
    let stranger = "10.9.9.9:9".parse().expect("an address");
    for in_window in [false, true] {
        line.turns(2);
        let before = line.wire.log().strangers;
        line.prepare();
        for _ in 0..FLOOD {
            line.inject(stranger, &[0; 20], if in_window { US } else { 0 });
        }
        let grid = line.cycle().grid;
        line.world.clock().sleep_until(grid);
        line.send();
        line.world.advance(2 * US);
        line.receive();
        let taken = line.wire.log().strangers - before;
        assert!((1..=2 * BITE).contains(&taken), "{taken} of {FLOOD} in one send and one receive");
        // The replies lie behind it, and are found all the same.
        line.window();
        line.judge();
        line.turns(u64::from(line.can.answers_after));
        assert_eq!(line.wire.log().strangers - before, FLOOD);
        assert!(line.slots.iter().all(|slot| slot.counters.missed == 0));
    }
}

pub fn a_cycle_that_begins_late_ends_when_it_always_does(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 1);
    line.online();
    for late in [0, WINDOW / 4, WINDOW / 2] {
        line.settle();
        line.prepare();
        let cycle = line.cycle();
        line.world.clock().sleep_until(cycle.grid + late);
        line.send();
        let Exchange::Owed { reply_by, .. } = line.slots[0].exchange else { panic!("not owed") };
        let last = cycle.deadline + u64::from(line.can.answers_after) * PERIOD;
        assert_eq!(reply_by, last, "late by {late}: the window is that of the grid");
        line.window();
        line.judge();
        line.turns(u64::from(line.can.answers_after));
        assert_eq!(line.slots[0].counters.missed, 0);
    }
}

pub fn a_refused_send_opens_nothing_and_is_made_up_for(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 2);
    line.settle();
    let (before, heard) = (line.slots[0].counters, line.heard(0));
    line.wire.log().drives[0].jammed = true;
    // The order is given while nothing goes out.
    let (at, verb) = (line.slots[0].report.demand, line.by(0, 0.1));
    line.order(0, verb);
    for unsent in 1..=4 {
        assert_eq!(line.exchange(0).exchange, Exchange::Unsent);
        let c = line.slots[0].counters;
        assert_eq!((c.unsent, c.sent, c.missed), (before.unsent + unsent, before.sent, before.missed));
    }
    assert_eq!(line.heard(0), heard);
    line.wire.log().drives[0].jammed = false;
    let seen = line.exchange(0);
    assert!(seen.answered() && !seen.suspect, "nothing was under way that it could be mistaken for");
    assert_eq!(line.ended(0), Ok(()));
    let (moved, asked) = (line.slots[0].report.demand - at, line.way(0, 0.1));
    assert!((moved - asked).abs() < asked * 1e-3, "moved by {moved}");
    assert_eq!(line.slots[1].counters.missed + line.slots[1].counters.unsent, 0, "its neighbour");
}

pub fn the_end_comes_and_leaves_nothing_owed(subject: &'static dyn Subject) {
    for silent in [false, true] {
        let mut line = Line::made_ready(subject, 2);
        for index in 0..2 {
            line.done(index, Verb::Disable);
        }
        line.mute(0, silent);
        line.turns(3);
        let mut turns = 0;
        loop {
            // Called where the loop does: behind the judgement of a cycle.
            let cycle = line.cycle();
            if line.bus.shut_down(&cycle, &mut line.slots) {
                break;
            }
            turns += 1;
            assert!(turns < 1_000, "no end within 1000 cycles");
            line.turn();
        }
        let owed = |slot: &fieldbeat::bus::Slot| matches!(slot.exchange, Exchange::Owed { .. });
        assert!(!line.slots.iter().any(owed), "{:?}", line.slots);
        let sends = line.wire.log().sends;
        line.world.advance(100 * PERIOD);
        let cycle = line.cycle();
        assert!(line.bus.shut_down(&cycle, &mut line.slots), "the end is the end");
        assert_eq!(line.wire.log().sends, sends, "nothing more is sent");
    }
}
