//! When something is sent, what is owed for it, and how long a window stays open.

use fieldbeat::axis::Command;
use fieldbeat::sim::FaultPlan;
use fieldbeat::telemetry::Counters;
use fieldbeat::time::US;
use fieldbeat_core::bus::Exchange;
use fieldbeat_core::bus::counters::OWN_COUNTERS;
use fieldbeat_core::rt::Clock;

use crate::conformance::line::{LATENCY, Line, PERIOD, WINDOW, near_velocity};
use crate::conformance::subject::{Subject, not_applicable};

pub fn a_slot_that_is_not_due_sends_no_request(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 3);
    line.asleep[1] = true;
    line.turns(100);
    // What came before its connection was known has a name of its own.
    let counters = Counters { own: [0; OWN_COUNTERS], ..line.slots[1].counters };
    assert_eq!(counters, Counters::default(), "never due, never requested");
    assert!(line.can.shared || line.received(1) == 0, "never due, never requested");
    line.asleep[1] = false;
    line.ready();
    line.settle();
    let (received, counters) = (line.received(1), line.slots[1].counters);
    line.asleep[1] = true;
    // Not even for an order.
    line.order(1, line.go(1));
    line.turns(100);
    assert_eq!(line.slots[1].counters, counters);
    let all = line.requests(1);
    if line.can.shared {
        // The frame goes all the same, with what the drive got before.
        assert!(all[received..].iter().all(|request| *request == all[received - 1]), "it got something");
    } else {
        assert_eq!(all.len(), received);
    }
}

pub fn each_due_slot_is_one_request_and_one_exchange(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 3);
    if line.can.stream || line.can.shared || line.can.sessions || line.can.bytes {
        // Before that there is nobody to ask.
        line.online();
        line.settle();
    }
    line.world.advance(2 * LATENCY);
    let begin = [0, 1, 2].map(|index| line.slots[index].counters.sent);
    let received = [0, 1, 2].map(|index| line.received(index) as u64);
    let mut random = fastrand::Rng::with_seed(1);
    let mut due = [0; 3];
    for cycles in 1..=600 * u64::from(line.drives[0].axis.divisor) {
        line.asleep.fill_with(|| random.bool());
        line.turn_and_hear();
        for (index, due) in due.iter_mut().enumerate() {
            *due += u64::from(line.slots[index].due);
            let sent = line.slots[index].counters.sent;
            // One frame a cycle, or one request a drive.
            let requested = if line.can.shared { cycles } else { *due };
            assert_eq!(
                (line.received(index) as u64 - received[index], sent - begin[index]),
                (requested, *due),
                "drive {index}"
            );
        }
    }
    assert!(due.iter().all(|due| *due > 100), "{due:?}");
}

pub fn a_request_that_is_built_again_is_the_same_to_the_byte(subject: &'static dyn Subject) {
    // Through all commands, on a wire that loses replies, with a system that refuses some sends.
    let script = |builds| {
        let mut line = Line::new(subject, 2);
        line.builds = builds;
        line.ready();
        for (turn, command) in crate::conformance::line::commands(&line, 0).into_iter().enumerate() {
            line.faults(0, FaultPlan { seed: turn as u64, drop: 0.1, ..FaultPlan::default() });
            line.stream(0, 0.01, 40);
            line.order(0, command);
            for n in 0..150 {
                line.wire.log().drives[0].jammed = n % 40 == 20;
                line.turn();
            }
            line.order(0, Command::Enable);
            line.turns(400);
        }
        [0, 1].map(|index| line.requests(index))
    };
    let once = script(1);
    assert!(once == script(3), "prepare was called more than once for the same send");
}

pub fn only_the_command_of_the_last_build_is_carried_out(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 1);
    let (before, distance) = (line.slots[0].status.demand, line.way(0, 0.1));
    for instead in [None, Some(Command::Stop { deceleration: None })] {
        line.settle();
        line.order(0, line.go(0));
        line.prepare();
        line.order(0, instead);
        line.stands(0, 300);
    }
    // One that stands is carried out once, however often it was built and for whichever slot.
    line.builds = 3;
    let command = if line.can.positions { line.by(0, 0.1) } else { line.go(0) };
    line.order(0, command);
    for _ in 0..3 {
        line.prepare();
        line.index += u64::from(line.drives[0].axis.divisor);
    }
    if !line.can.positions {
        let velocity = line.profile(0).velocity;
        line.until("its velocity", 1_000, |line| near_velocity(line, 0, velocity));
        return line.done(0, Command::Stop { deceleration: None });
    }
    assert_eq!(line.ended(0), Ok(()));
    line.turns(100);
    let moved = line.slots[0].status.demand - before;
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
    let later = line.can.answers_after > 0 && !line.can.awaits || line.can.own_clock;
    let open = |line: &mut Line, requested: [bool; 2]| {
        line.asleep = requested.map(|requested| !requested).to_vec();
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
    if line.can.shared {
        let mute = |line: &Line, mute: [bool; 2]| (0..2).for_each(|index| line.mute(index, mute[index]));
        mute(&line, [true, true]);
        assert_eq!(open(&mut line, [true, true]), (true, false, false), "nothing comes back");
        mute(&line, [true, false]);
        assert_eq!(open(&mut line, [true, true]), (true, false, true), "it came back without one");
        assert!(line.seen[0].missed() && line.seen[1].answered());
        return;
    }
    line.mute(0, true);
    let end = later || line.can.half_duplex;
    assert_eq!(
        open(&mut line, [true, true]),
        (true, later, end),
        "one is silent, and overdue on a shared wire"
    );
    line.turns(4);
    assert_eq!(open(&mut line, [false, true]), (true, later, true), "the silent one is not due");
}

pub fn an_exchange_still_owed_is_not_sent_again(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 1);
    line.online();
    if line.can.answers_after == 0 || line.can.half_duplex {
        return not_applicable(
            subject,
            "a slot that is due while it is owed",
            "what has left is closed by the next send",
        );
    }
    line.settle();
    line.answer_at(0, WINDOW / 4);
    line.turn_and_hear();
    let (exchange, counters, received) = (line.slots[0].exchange, line.slots[0].counters, line.received(0));
    assert!(matches!(exchange, Exchange::Owed { .. }));
    let cycle = line.cycle();
    line.slots[0].due = true;
    line.propose(&cycle);
    line.build(&cycle);
    line.world.clock().sleep_until(cycle.grid);
    line.send();
    line.world.advance(2 * LATENCY);
    assert_eq!((line.slots[0].exchange, line.slots[0].counters), (exchange, counters));
    assert_eq!(line.received(0), received);
    line.window();
    line.judge();
    line.turns(u64::from(line.can.answers_after) - 1);
    assert!(line.seen[0].answered());
}

pub fn an_exchange_without_reply_in_its_window_is_open_until_the_loop_marks_it_missed(
    subject: &'static dyn Subject,
) {
    let mut line = Line::new(subject, 1);
    line.online();
    if line.can.own_clock {
        return not_applicable(subject, "a request that is not answered", "none is; see the age of packets");
    }
    for missed in 1..=4 {
        line.mute(0, true);
        assert!(line.exchange(0).missed());
        assert_eq!(line.slots[0].counters.missed, missed);
        if line.can.stream {
            // The next request goes out on another connection.
            line.mute(0, false);
            line.heal(0);
        }
    }
    line.mute(0, false);
    assert!(line.heal(0).answered());
}

pub fn a_flood_is_received_in_bounded_parts(subject: &'static dyn Subject) {
    if subject.can().bytes {
        return not_applicable(subject, "a flood", "a wire has no room for one");
    }
    let mut line = Line::new(subject, 2);
    line.online();
    if line.can.stream {
        return a_flood_on_a_connection(line);
    }
    // What a line cannot hold is lost on it.
    let flood: u64 = if line.can.shared { 900 } else { 3_000 };
    const BITE: u64 = 1_024;
    let stranger = "10.9.9.9:9".parse().expect("an address");
    for in_window in [false, true] {
        line.turns(2);
        let before = line.wire.log().unmatched;
        line.prepare();
        for _ in 0..flood {
            line.inject(0, stranger, &[0; 20], if in_window { US } else { 0 });
        }
        let grid = line.cycle().grid;
        line.world.clock().sleep_until(grid);
        line.send();
        line.world.advance(2 * US);
        line.receive();
        let taken = line.wire.log().unmatched - before;
        assert!(
            (1..=2 * BITE.min(flood / 4)).contains(&taken),
            "{taken} of {flood} in one send and one receive"
        );
        // The replies lie behind it, and are found all the same.
        line.window();
        line.judge();
        line.turns(u64::from(line.can.answers_after));
        line.turns(if line.can.shared || line.can.own_clock { 200 } else { 0 });
        assert_eq!(line.wire.log().unmatched - before, flood);
        // No window is open for packets that answer nothing: they lie behind it for some cycles.
        assert!(line.can.own_clock || line.slots.iter().all(|slot| slot.counters.missed == 0));
    }
}

fn assert_neighbour_untroubled(line: &Line, before: &Counters) {
    let after = line.slots[1].counters;
    assert_eq!((after.missed, after.unsent), (before.missed, before.unsent), "its neighbour");
}

/// A flood on one connection is received in bounded parts, and no other drive waits for it.
fn a_flood_on_a_connection(mut line: Line) {
    const FLOOD: u64 = 300;
    const BITE: u64 = 64;
    line.settle();
    let (old, address) = (line.reply(0), line.wire.address(0));
    let (taken, before) = (line.wire.log().drives[0].taken, line.slots[0].counters);
    let neighbour = line.slots[1].counters;
    line.prepare();
    for _ in 0..FLOOD {
        line.inject(0, address, &old, 0);
    }
    let grid = line.cycle().grid;
    line.world.clock().sleep_until(grid);
    line.send();
    line.world.advance(2 * US);
    line.receive();
    let bite = line.wire.log().drives[0].taken - taken;
    assert!((1..=2 * BITE).contains(&bite), "{bite} of {FLOOD} in one send and one receive");
    line.window();
    line.judge();
    line.until("the end of the flood", 1_000, |line| {
        line.slots[0].counters.duplicate - before.duplicate == FLOOD
    });
    line.heal(0);
    assert_neighbour_untroubled(&line, &neighbour);
}

pub fn a_cycle_that_begins_late_ends_when_it_always_does(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 1);
    line.online();
    if line.can.own_clock {
        return not_applicable(subject, "a window that begins late", "it has none");
    }
    for late in [0, WINDOW / 4, WINDOW / 2] {
        line.settle();
        line.prepare();
        let cycle = line.cycle();
        line.world.clock().sleep_until(cycle.grid + late);
        line.send();
        let Exchange::Owed { reply_by, .. } = line.slots[0].exchange else { panic!("not owed") };
        let last = cycle.deadline + u64::from(line.can.answers_after) * PERIOD;
        let first = if line.can.half_duplex { cycle.deadline } else { last };
        assert!([first, last].contains(&reply_by), "late by {late}: the window is that of the grid");
        line.window();
        line.judge();
        line.turns(u64::from(line.can.answers_after));
        assert_eq!(line.slots[0].counters.missed, 0);
    }
}

pub fn a_refused_send_opens_nothing_and_is_made_up_for(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 2);
    line.settle();
    let (before, received) = (line.slots[0].counters, line.received(0));
    let neighbour = line.slots[1].counters;
    line.wire.log().drives[0].jammed = true;
    // The order is given while nothing goes out.
    let at = line.slots[0].status.demand;
    let command = if line.can.positions { line.by(0, 0.1) } else { line.go(0) };
    line.order(0, command);
    for unsent in 1..=4 {
        assert_eq!(line.exchange(0).exchange, Exchange::Unsent);
        let c = line.slots[0].counters;
        assert_eq!((c.unsent, c.sent, c.missed), (before.unsent + unsent, before.sent, before.missed));
    }
    assert_eq!(line.received(0), received);
    line.wire.log().drives[0].jammed = false;
    let seen = if line.can.own_clock { line.heal(0) } else { line.exchange(0) };
    assert!(seen.answered() && !seen.suspect, "nothing was under way that it could be mistaken for");
    if line.can.positions {
        assert_eq!(line.ended(0), Ok(()));
        let (moved, requested) = (line.slots[0].status.demand - at, line.way(0, 0.1));
        assert!((moved - requested).abs() < requested * 1e-3, "moved by {moved}");
    } else {
        let velocity = line.profile(0).velocity;
        line.until("its velocity", 1_000, |line| near_velocity(line, 0, velocity));
    }
    let refused = if line.can.shared { 4 } else { 0 };
    assert_neighbour_untroubled(&line, &Counters { unsent: neighbour.unsent + refused, ..neighbour });
}

pub fn a_request_sent_in_pieces_is_received_once_and_whole(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 2);
    if !line.can.stream {
        return not_applicable(subject, "pieces of a request", "a datagram goes whole or not at all");
    }
    line.settle();
    let (before, neighbour, received) = (line.slots[0].counters, line.slots[1].counters, line.received(0));
    line.wire.log().drives[0].halved = true;
    // The rest goes with the next cycle: what then comes in time is answered, and all else late.
    line.turns(60);
    line.wire.log().drives[0].halved = false;
    line.turns(6);
    let after = line.slots[0].counters;
    let sent = after.sent - before.sent;
    assert!(sent > 15, "{after:?}");
    assert_eq!((line.received(0) - received) as u64, sent, "each once");
    let requests = line.requests(0).split_off(received);
    assert!(requests.iter().all(|request| matches!(subject.message(request), Ok(Some(_)))));
    assert_eq!(after.missed - before.missed, after.late - before.late, "each answered, sooner or later");
    assert_eq!((after.malformed, after.foreign, after.duplicate), (0, 0, 0));
    assert_neighbour_untroubled(&line, &neighbour);
    line.move_about(0);
}

pub fn the_end_comes_and_leaves_nothing_owed(subject: &'static dyn Subject) {
    for silent in [false, true] {
        let mut line = Line::made_ready(subject, 2);
        for index in 0..2 {
            line.done(index, Command::Disable);
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
        let owed = |slot: &fieldbeat_core::bus::Slot| matches!(slot.exchange, Exchange::Owed { .. });
        assert!(!line.slots.iter().any(owed), "{:?}", line.slots);
        let sends = line.wire.log().sends;
        line.world.advance(100 * PERIOD);
        let cycle = line.cycle();
        assert!(line.bus.shut_down(&cycle, &mut line.slots), "the end is the end");
        assert_eq!(line.wire.log().sends, sends, "nothing more is sent");
    }
}
