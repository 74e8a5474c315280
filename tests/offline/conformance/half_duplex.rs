//! A wire for one request at a time: what is due waits for its turn.

use fieldbeat::axis::Command;
use fieldbeat::time::US;
use fieldbeat_core::bus::Exchange;

use crate::conformance::line::{LATENCY, Line, PERIOD};
use crate::conformance::machine::Machine;
use crate::conformance::subject::{Subject, not_applicable};

/// More than the wire takes in one window.
const MANY: usize = 4;

fn all_go_at_once(subject: &'static dyn Subject, clause: &str) -> bool {
    let at_once = !subject.can().half_duplex;
    if at_once {
        not_applicable(subject, clause, "what is due leaves at once");
    }
    at_once
}

/// From a request to its answer.
fn exchange_ns(line: &Line, index: usize) -> u64 {
    2 * LATENCY + line.usual_answer_ns(index)
}

pub fn one_request_is_on_the_wire_at_a_time(subject: &'static dyn Subject) {
    if all_go_at_once(subject, "one request at a time") {
        return;
    }
    let mut line = Line::new(subject, MANY);
    for mute in [false, true] {
        line.online();
        line.settle();
        let before: Vec<_> = (0..MANY).map(|index| line.received(index)).collect();
        line.mute(0, mute);
        line.turns(20);
        let mut all: Vec<_> = (0..MANY)
            .flat_map(|index| line.wire.log().drives[index].received.split_off(before[index]))
            .map(|request| request.at)
            .collect();
        all.sort_unstable();
        assert!(all.len() >= 9 * MANY, "{} requests", all.len());
        let least = exchange_ns(&line, 0);
        assert!(all.windows(2).all(|pair| pair[1].since(pair[0]) >= least), "{all:?}");
        line.mute(0, false);
    }
}

/// A cycle in which all are due, and one of them has no turn: which.
fn one_waits(line: &mut Line) -> usize {
    line.settle();
    line.turn();
    let waits = (0..MANY).find(|index| line.slots[*index].exchange == Exchange::Queued);
    waits.expect("more are due than one window takes")
}

pub fn a_queued_exchange_is_neither_unsent_nor_missed(subject: &'static dyn Subject) {
    if all_go_at_once(subject, "what waits for its turn") {
        return;
    }
    let mut line = Line::new(subject, MANY);
    line.online();
    for _ in 0..20 {
        line.settle();
        let before: Vec<_> = line.slots.iter().map(|slot| slot.counters).collect();
        let waits = one_waits(&mut line);
        assert_eq!(line.slots[waits].counters, before[waits], "nothing has happened to it");
        let mut answered: Vec<_> = line.seen.iter().map(|seen| u32::from(seen.answered())).collect();
        line.turn();
        for index in 0..MANY {
            answered[index] += u32::from(line.seen[index].answered());
            let (c, before) = (line.slots[index].counters, before[index]);
            assert_eq!((c.sent - before.sent, c.missed, c.unsent), (1, before.missed, before.unsent));
        }
        assert!(answered.iter().all(|count| *count == 1), "each once: {answered:?}");
    }
    // The loop says the same.
    let mut m = Machine::new(subject, MANY, |_, _| {});
    m.ready();
    // To bring it up is no exchange.
    let before = m.sim.status().missed;
    m.run(400);
    assert_eq!(m.sim.status().missed, before);
    let end = m.sim.finish();
    for drive in &end.drives {
        assert!(drive.losses == 0 && drive.counters.answered >= 200, "{drive:?}");
    }
}

pub fn a_request_that_waits_is_built_anew_until_it_leaves(subject: &'static dyn Subject) {
    if all_go_at_once(subject, "a request that waits") {
        return;
    }
    for stop in [Command::Stop { deceleration: None }, Command::QuickStop] {
        let mut line = Line::made_ready(subject, MANY);
        for index in 0..MANY {
            line.order(index, line.changing(index));
        }
        line.turns(200);
        let waits = one_waits(&mut line);
        let before = line.received(waits);
        line.order(waits, stop);
        line.turn_and_hear();
        let requests = line.requests(waits);
        let stops =
            requests.len() == before + 1 && subject.requests_stop(&requests[..before], &requests[before]);
        assert!(stops, "{stop:?}: {:02x?}", &requests[before..]);
        assert_eq!(line.ended(waits), Ok(()));
    }
}

pub fn a_reply_that_is_overdue_lets_the_next_request_go_in_the_same_window(subject: &'static dyn Subject) {
    if all_go_at_once(subject, "a reply that is overdue") {
        return;
    }
    let mut line = Line::new(subject, 2);
    line.online();
    line.mute(0, true);
    for _ in 0..20 {
        line.settle();
        line.turn();
        assert!(line.seen[0].missed() && line.seen[1].answered(), "{:?}", line.seen);
    }
    // The window of the loop does the same: the second drive has its turn in its own slots.
    let mut m = Machine::new(subject, 2, |_, drive| drive.axis.health.bucket = 1_000);
    m.online();
    m.mute(0, true);
    let before = m.received(1);
    m.run(200);
    let every = u64::from(m.drives[1].axis.divisor);
    let slots = m.asked_in(1, before);
    assert!(slots.len() as u64 >= 190 / every && slots.iter().all(|slot| slot % every == 0), "{slots:?}");
}

pub fn a_request_has_its_own_stamp_whenever_it_leaves(subject: &'static dyn Subject) {
    if all_go_at_once(subject, "a stamp of its own") {
        return;
    }
    let mut line = Line::new(subject, 2);
    line.online();
    for _ in 0..20 {
        line.settle();
        line.turn();
        for (index, seen) in line.seen.iter().enumerate() {
            let least = exchange_ns(&line, index);
            assert!(seen.round_trip().is_some_and(|ns| (least..least + 10 * US).contains(&ns)), "{seen:?}");
        }
    }
    // The loop takes it over when the request has left: in the window, or in the next one.
    let mut m = Machine::new(subject, MANY, |_, _| {});
    m.online();
    let sent = |m: &Machine, index: usize| m.sim.measured().histograms.drives[index].send_jitter.len();
    let before: Vec<_> = (0..MANY).map(|index| (m.received(index) as u64, sent(&m, index))).collect();
    m.run(200);
    for (index, (requests, stamps)) in before.into_iter().enumerate() {
        let (requests, stamps) = (m.received(index) as u64 - requests, sent(&m, index) - stamps);
        assert!(
            requests >= 99 && requests.abs_diff(stamps) <= 1,
            "drive {index}: {stamps} stamps of {requests} requests"
        );
    }
    assert!(m.sim.finish().drives.iter().all(|drive| drive.peaks.send_jitter.ns < PERIOD));
}
