//! Which reply answers which request. Whatever comes besides is counted under its own name, and moves nothing.

use std::net::SocketAddrV4;

use fieldbeat::axis::Link;
use fieldbeat::sim::FaultPlan;
use fieldbeat::telemetry::Counters;
use fieldbeat::time::US;
use fieldbeat_core::bus::Exchange;
use fieldbeat_core::bus::counters::OWN_COUNTERS;

use crate::conformance::line::{LATENCY, Line, PERIOD, Seen, WINDOW};
use crate::conformance::rules;
use crate::conformance::subject::{Can, Subject, not_applicable};

/// Between two windows.
const BETWEEN: u64 = WINDOW + 140 * US;
/// In the window of the next exchange, before its own reply.
const FIRST: u64 = PERIOD + LATENCY;

/// Drives in motion, so that each reply has positions of its own.
fn moving(subject: &'static dyn Subject, count: usize) -> Line {
    let mut line = Line::made_ready(subject, count);
    for index in 0..count {
        line.order(index, line.changing(index));
    }
    line.turns(200);
    line.settle();
    assert!((0..count).all(|index| line.said(index).moving));
    line
}

/// A reply that can be no other's, as clean as the protocol knows.
fn is_clean(line: &Line, seen: &Seen) -> bool {
    // A packet is new once, however many exchanges it answers.
    let reported = seen.fresh || !line.can.whole || line.can.own_clock;
    seen.answered() && reported && !seen.suspect && seen.round_trip().is_some() == line.can.round_trip
}

fn expect_clean(line: &mut Line, index: usize) {
    let seen = line.exchange(index);
    assert!(is_clean(line, &seen), "{seen:?}");
}

/// Whether a clause about replies means nothing, since no packet answers a request.
fn nothing_replies(subject: &'static dyn Subject, clause: &str) -> bool {
    let nothing = subject.can().own_clock;
    if nothing {
        not_applicable(subject, clause, "no packet answers a request");
    }
    nothing
}

/// What changed in the counts.
fn since(before: &Counters, after: &Counters) -> Counters {
    Counters {
        sent: after.sent - before.sent,
        unsent: after.unsent - before.unsent,
        answered: after.answered - before.answered,
        missed: after.missed - before.missed,
        late: after.late - before.late,
        duplicate: after.duplicate - before.duplicate,
        suspect: after.suspect - before.suspect,
        implausible: after.implausible - before.implausible,
        malformed: after.malformed - before.malformed,
        foreign: after.foreign - before.foreign,
        own: std::array::from_fn(|count| after.own[count] - before.own[count]),
    }
}

pub fn a_clean_wire_answers_everything(subject: &'static dyn Subject) {
    let mut line = moving(subject, 2);
    let before = [0, 1].map(|index| line.slots[index].counters);
    for _ in 0..200 {
        let seen = line.exchange(0);
        assert!(is_clean(&line, &seen), "{seen:?}");
        if let Some(ns) = seen.round_trip() {
            let wire = 2 * LATENCY + line.usual_answer_ns(0);
            assert!((wire..wire + 10 * US).contains(&ns), "round trip of {ns} ns on a wire of {wire} ns");
        }
    }
    for (index, before) in before.iter().enumerate() {
        let c = since(before, &line.slots[index].counters);
        let owed = c.sent - c.answered;
        assert!(owed <= 1, "drive {index}: {c:?}");
        let own = if line.can.bytes { c.own } else { Counters::default().own };
        let only = Counters { sent: c.sent, answered: c.answered, own, ..Counters::default() };
        assert_eq!(c, only, "drive {index}");
    }
}

pub fn the_reply_after_a_miss_is_suspect_unless_it_names_its_request(subject: &'static dyn Subject) {
    if nothing_replies(subject, "the reply after a miss") {
        return;
    }
    let mut line = moving(subject, 1);
    let before = line.slots[0].counters;
    let misses = if line.can.stream { 1 } else { 3 };
    line.mute(0, true);
    for _ in 0..misses {
        let seen = line.exchange(0);
        assert!(seen.missed() && !seen.fresh);
    }
    line.mute(0, false);
    let seen = line.heal(0);
    if line.can.identified {
        assert!(is_clean(&line, &seen), "{seen:?}");
    } else {
        assert!(seen.answered() && seen.fresh, "{seen:?}");
        assert!(seen.suspect && seen.round_trip().is_none(), "it may be a late one: {seen:?}");
    }
    for _ in 0..5 {
        expect_clean(&mut line, 0);
    }
    let c = since(&before, &line.slots[0].counters);
    assert_eq!((c.missed, c.late, c.duplicate, c.foreign), (misses, 0, 0, 0));
    assert_eq!(c.suspect, u64::from(!line.can.identified), "once");
}

pub fn a_reply_between_two_windows_is_late_and_its_exchange_a_miss(subject: &'static dyn Subject) {
    if nothing_replies(subject, "a reply between two windows") {
        return;
    }
    let mut line = moving(subject, 1);
    let before = line.slots[0].counters;
    line.answer_at(0, BETWEEN);
    for _ in 0..3 {
        assert!(line.exchange(0).missed());
    }
    line.answer_as_usual(0);
    line.exchange(0);
    for _ in 0..5 {
        expect_clean(&mut line, 0);
    }
    let c = since(&before, &line.slots[0].counters);
    assert_eq!((c.missed, c.late, c.duplicate, c.foreign), (3, 3, 0, 0));
}

pub fn a_late_reply_that_comes_first_in_the_next_window_is_not_taken_for_the_newest(
    subject: &'static dyn Subject,
) {
    if nothing_replies(subject, "a late reply") {
        return;
    }
    let mut line = moving(subject, 1);
    let before = line.slots[0].counters;
    line.answer_at(0, FIRST);
    let requested = line.cycle().grid;
    assert!(line.exchange(0).missed());
    line.answer_as_usual(0);
    let seen = line.exchange(0);
    if line.can.stream {
        assert_eq!(seen.exchange, Exchange::Unsent, "one at a time");
        line.exchange(0);
    } else {
        // That what is not suspect was said in answer to this very request is the referee's.
        assert_eq!(seen.suspect, !line.can.identified, "{seen:?}");
    }
    rules::honest(&line.slots[0], &line.wire.log().drives[0], &line.drives[0], &line.can, requested);
    for _ in 0..5 {
        expect_clean(&mut line, 0);
    }
    let c = since(&before, &line.slots[0].counters);
    assert_eq!((c.missed, c.late, c.duplicate, c.foreign), (1, 1, 0, 0));
    // By then nothing is under way any more, and what comes again is no late one.
    line.settle();
    let old = line.reply(0);
    line.inject(0, line.wire.address(0), &old, u64::from(line.can.answers_after) * PERIOD + BETWEEN);
    for _ in 0..3 {
        expect_clean(&mut line, 0);
    }
    let c = since(&before, &line.slots[0].counters);
    let again = u64::from(!subject.malformed(&old).is_empty());
    assert_eq!((c.missed, c.late, c.duplicate, c.foreign), (1, 1, again, 0));
}

pub fn a_late_reply_next_to_the_requested_one_keeps_the_newer_values(subject: &'static dyn Subject) {
    if nothing_replies(subject, "a late reply with the expected one") {
        return;
    }
    if subject.can().half_duplex {
        return not_applicable(subject, "a late reply with the expected one", "one is on the wire at a time");
    }
    // Another drive keeps the window open for both. Where one frame is for all, the late one comes behind the
    // requested one, whose values stand.
    let mut line = moving(subject, 2);
    line.answer_at(1, 200 * US);
    let before = line.slots[0].counters;
    line.answer_at(0, if line.can.shared { PERIOD + 3 * LATENCY } else { FIRST });
    assert!(line.exchange(0).missed());
    line.answer_as_usual(0);
    if line.can.stream {
        assert_eq!(line.exchange(0).exchange, Exchange::Unsent, "one at a time");
    }
    let seen = line.exchange(0);
    assert!(seen.answered() && (seen.fresh || !line.can.whole) && !seen.suspect, "{seen:?}");
    for _ in 0..5 {
        expect_clean(&mut line, 0);
    }
    let c = since(&before, &line.slots[0].counters);
    assert_eq!((c.missed, c.late, c.duplicate, c.foreign), (1, 1, 0, 0));
}

pub fn replies_that_are_always_one_exchange_behind_are_never_taken_for_fresh_ones(
    subject: &'static dyn Subject,
) {
    if nothing_replies(subject, "replies that are one exchange behind") {
        return;
    }
    if subject.can().bytes {
        return not_applicable(subject, "replies that are one exchange behind", "they meet the next request");
    }
    for ns in [FIRST, PERIOD + 5 * LATENCY, PERIOD + WINDOW - LATENCY] {
        let mut line = moving(subject, 1);
        let before = line.slots[0].counters;
        line.answer_at(0, ns);
        // The rest of what a part tells is of before all this.
        line.honest = line.can.whole;
        let mut missed = 0;
        for _ in 0..30 {
            let seen = line.exchange(0);
            assert!(!seen.fresh || seen.suspect, "{ns} ns: {seen:?}");
            assert_eq!(seen.round_trip(), None, "{ns} ns: {seen:?}");
            missed += u64::from(seen.missed());
        }
        let least = match line.can.stream {
            // Each costs the next one its turn.
            true => 15,
            false if line.can.identified => 30,
            false => 10,
        };
        assert!(missed >= least, "{ns} ns: only {missed} of 30 missed");
        line.answer_as_usual(0);
        line.exchange(0);
        line.exchange(0);
        for _ in 0..5 {
            expect_clean(&mut line, 0);
        }
        // Each request was answered once, sooner or later.
        let c = since(&before, &line.slots[0].counters);
        assert_eq!((c.late, c.duplicate, c.foreign), (c.missed, 0, 0), "{ns} ns");
    }
}

pub fn a_duplicate_is_counted_and_answers_nothing(subject: &'static dyn Subject) {
    if nothing_replies(subject, "a duplicate of each reply") {
        return;
    }
    let mut line = moving(subject, 1);
    let before = line.slots[0].counters;
    line.faults(0, FaultPlan { duplicate: 1.0, ..FaultPlan::default() });
    for _ in 0..50 {
        expect_clean(&mut line, 0);
    }
    line.answer_as_usual(0);
    for _ in 0..5 {
        expect_clean(&mut line, 0);
    }
    // Each request came twice, and each of its two replies.
    let c = since(&before, &line.slots[0].counters);
    assert_eq!((c.missed, c.late, c.foreign, c.malformed), (0, 0, 0, 0));
    // On a wire that all share the second request has no silence before it.
    let duplicates = if line.can.bytes { 49..=50 } else { 147..=150 };
    assert!(duplicates.contains(&c.duplicate), "{c:?}");
}

pub fn a_reply_of_before_that_comes_again_moves_nothing(subject: &'static dyn Subject) {
    if nothing_replies(subject, "a reply that comes again") {
        return;
    }
    let mut line = moving(subject, 2);
    if subject.malformed(&line.reply(0)).is_empty() {
        return not_applicable(subject, "a reply that comes again", "it names none");
    }
    // Another drive keeps the window open. Before the true reply, only a reply that names its request can be
    // distinguished.
    if !line.can.shared && !line.can.half_duplex {
        line.answer_at(1, 200 * US);
    }
    let window = u64::from(line.can.answers_after) * PERIOD;
    // Where it would meet the request on the wire, it comes behind it only.
    let first = (line.can.identified && !line.can.bytes).then_some(LATENCY / 2);
    for ns in first.into_iter().chain([window + 150 * US, window + BETWEEN]) {
        line.settle();
        let old = line.reply(0);
        expect_clean(&mut line, 0);
        line.settle();
        let before = line.slots[0].counters;
        line.inject(0, line.wire.address(0), &old, ns);
        for _ in 0..3 {
            // That the values are those of the request's own reply is the referee's.
            expect_clean(&mut line, 0);
        }
        line.settle();
        let c = since(&before, &line.slots[0].counters);
        let own = if line.can.bytes { c.own } else { Counters::default().own };
        let only = Counters { sent: c.sent, answered: c.answered, duplicate: 1, own, ..Counters::default() };
        assert_eq!(c, only, "at {ns} ns");
    }
}

pub fn a_reply_that_was_overtaken_is_late(subject: &'static dyn Subject) {
    if nothing_replies(subject, "a reply that was overtaken") {
        return;
    }
    if subject.can().stream || subject.can().bytes {
        return not_applicable(subject, "a reply that was overtaken", "nothing overtakes on its wire");
    }
    let mut line = moving(subject, 1);
    let before = line.slots[0].counters;
    // Every second reply is held back until the next one has passed it.
    line.faults(0, FaultPlan { reorder: 0.5, seed: 3, ..FaultPlan::default() });
    // Where replies do not name their requests, they are taken to come in order: nothing shows that they do not.
    line.honest = line.can.identified;
    for _ in 0..200 {
        line.exchange(0);
    }
    line.answer_as_usual(0);
    line.exchange(0);
    line.exchange(0);
    line.honest = true;
    for _ in 0..5 {
        expect_clean(&mut line, 0);
    }
    let c = since(&before, &line.slots[0].counters);
    assert!(c.late > 20 && c.missed > 20, "{c:?}");
    assert_eq!((c.foreign, c.malformed), (0, 0));
}

/// Injects each of `telegrams` from `from` before the true reply, and between two windows: it is counted, and no more.
fn only_counted(
    subject: &'static dyn Subject,
    telegrams: impl Fn(&Line) -> Vec<Vec<u8>>,
    from: impl Fn(SocketAddrV4) -> SocketAddrV4,
    as_what: Counters,
    unmatched: u64,
) -> bool {
    let mut line = moving(subject, 2);
    if line.can.bytes {
        not_applicable(
            subject,
            "telegrams in the place of others",
            "they are noise, or meet others on the wire",
        );
        return true;
    }
    let telegrams = telegrams(&line);
    for telegram in &telegrams {
        for ns in [LATENCY / 2, BETWEEN] {
            let before = [0, 1].map(|index| line.slots[index].counters);
            let of_nobody = line.bus.numbers().unmatched.datagrams;
            line.inject(0, from(line.wire.address(0)), telegram, ns);
            for _ in 0..2 {
                for index in 0..2 {
                    expect_clean(&mut line, index);
                }
            }
            let got = [0, 1].map(|index| {
                let c = since(&before[index], &line.slots[index].counters);
                Counters {
                    sent: 0,
                    answered: 0,
                    suspect: if line.can.round_trip { c.suspect } else { 0 },
                    // What the protocol calls it besides.
                    own: if c.malformed + c.foreign + unmatched > 0 { [0; OWN_COUNTERS] } else { c.own },
                    ..c
                }
            });
            let what = format!("{} bytes at {ns}: {telegram:02x?}", telegram.len());
            // A frame is everybody's.
            let other = if line.can.shared { as_what } else { Counters::default() };
            assert_eq!(got, [as_what, other], "{what}");
            assert_eq!(line.bus.numbers().unmatched.datagrams - of_nobody, unmatched, "{what}");
        }
    }
    !telegrams.is_empty()
}

pub fn a_reply_of_no_known_form_is_malformed(subject: &'static dyn Subject) {
    let telegrams = |line: &Line| subject.malformed(&line.reply(0));
    let malformed = Counters { malformed: 1, ..Counters::default() };
    if !only_counted(subject, telegrams, |drive| drive, malformed, 0) {
        not_applicable(subject, "malformed telegrams", "it names none");
    }
}

pub fn an_answer_without_request_is_foreign(subject: &'static dyn Subject) {
    let telegrams = |line: &Line| subject.foreign(&line.reply(0));
    let foreign = Counters { foreign: 1, ..Counters::default() };
    if !only_counted(subject, telegrams, |drive| drive, foreign, 0) {
        not_applicable(subject, "foreign telegrams", "it names none");
    }
}

pub fn a_frame_that_circulated_is_no_answer(subject: &'static dyn Subject) {
    let mut line = moving(subject, 2);
    line.settle();
    if subject.circulated(&line.reply(0)).is_none() {
        return not_applicable(subject, "what has circulated", "nothing goes round");
    }
    for _ in 0..5 {
        let before = [0, 1].map(|index| line.slots[index].counters);
        let round = subject.circulated(&line.reply(0)).expect("as before");
        // Just before the true one, which answers all the same.
        line.inject(0, line.wire.address(0), &round, LATENCY / 2);
        line.turn();
        for (index, before) in before.iter().enumerate() {
            assert!(is_clean(&line, &line.seen[index]), "{:?}", line.seen[index]);
            let c = since(before, &line.slots[index].counters);
            let only = Counters { sent: 1, answered: 1, own: c.own, ..Counters::default() };
            assert_eq!((c, c.own.iter().sum::<u64>()), (only, 1), "counted under its own name, once");
        }
        line.turns(3);
    }
}

pub fn a_true_answer_from_a_wrong_port_is_foreign(subject: &'static dyn Subject) {
    if nothing_replies(subject, "a true answer from a wrong port") {
        return;
    }
    let mut line = moving(subject, 1);
    let before = line.slots[0].counters;
    line.faults(0, FaultPlan { wrong_id: 1.0, ..FaultPlan::default() });
    for _ in 0..5 {
        let seen = line.exchange(0);
        assert!(seen.missed() && !seen.fresh, "{seen:?}");
        if line.can.stream {
            // On a connection it is the true answer to something else.
            line.answer_as_usual(0);
            line.heal(0);
            line.faults(0, FaultPlan { wrong_id: 1.0, ..FaultPlan::default() });
        }
    }
    line.answer_as_usual(0);
    line.exchange(0);
    expect_clean(&mut line, 0);
    let c = since(&before, &line.slots[0].counters);
    assert_eq!((c.missed, c.foreign, c.duplicate, c.late, c.malformed), (5, 5, 0, 0, 0));
}

pub fn a_telegram_of_an_unknown_sender_is_foreign(subject: &'static dyn Subject) {
    // Even if it is the very reply that is waited for.
    let telegrams = |line: &Line| match line.can.stream {
        true => Vec::new(),
        false if line.can.shared => vec![subject.of_another(&line.reply(0)), Vec::new()],
        false => vec![line.reply(0), Vec::new()],
    };
    let stranger = |drive: SocketAddrV4| SocketAddrV4::new([10, 9, 9, 9].into(), drive.port());
    if !only_counted(subject, telegrams, stranger, Counters::default(), 1) {
        not_applicable(subject, "unmatched", "it listens nowhere");
    }
}

pub fn no_bytes_cause_a_panic(subject: &'static dyn Subject) {
    let mut line = moving(subject, 2);
    if subject.malformed(&line.reply(0)).is_empty() {
        return not_applicable(subject, "arbitrary bytes", "it names none");
    }
    // A reply that is wrong in its values only cannot be distinguished from a true one.
    line.honest = false;
    let mut random = fastrand::Rng::with_seed(11);
    let from = line.wire.address(0);
    let neighbour = line.slots[1].counters;
    for n in 0..2_000 {
        let reply = line.reply(0);
        let mut bytes = match n % 3 {
            0 => (0..random.usize(..200)).map(|_| random.u8(..)).collect(),
            1 => reply[..random.usize(..=reply.len())].to_vec(),
            _ => reply,
        };
        if n % 3 == 2 {
            let bit = random.usize(..bytes.len() * 8);
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
        line.inject(0, from, &bytes, random.u64(..PERIOD));
        line.turn();
        // On a stream they may end the connection, and that of nobody else.
        assert!(line.can.stream || line.can.bytes || !line.seen[0].missed(), "{n}: {bytes:02x?}");
        if line.can.stream {
            line.heal(0);
        }
        let c = since(&neighbour, &line.slots[1].counters);
        // On a wire that all share they meet its telegrams, too.
        assert!(line.can.bytes || (c.missed, c.unsent) == (0, 0), "the neighbour, {n}: {bytes:02x?}");
    }
    let c = line.slots[0].counters;
    // On a wire that all share most of them come while nobody is to send.
    let noise: u64 = if line.can.bytes { c.own.iter().sum() } else { 0 };
    assert!(c.malformed + noise > 300, "{c:?}");
    line.turns(4);
    line.heal(0);
    line.honest = true;
    expect_clean(&mut line, 0);
}

pub fn the_counters_add_up_under_random_faults(subject: &'static dyn Subject) {
    // The referee counts after every call: telegrams, exchanges, unmatched.
    let mut odd = 0;
    for seed in 0..4 {
        let mut line = Line::made_ready(subject, 3);
        line.honest = false;
        let mut random = fastrand::Rng::with_seed(seed);
        for index in 0..3 {
            // A connection that is lost is opened by a handshake, which has to pass as well.
            let rate = if line.can.stream { 0.05 } else { 1.0 };
            let plan = FaultPlan {
                seed: seed * 3 + index as u64,
                drop: 0.05 * rate,
                duplicate: 0.05 * rate,
                corrupt: 0.02 * rate,
                delay: 0.1,
                delay_ns: 900 * US,
                reorder: 0.05 * rate,
                stall: 0.001,
                stall_ns: 20 * PERIOD,
                restart: 0.001 * rate,
                sto: 0.001,
                sto_ns: 20 * PERIOD,
                wrong_id: 0.02 * rate,
                split: 0.05,
                cut: 0.002,
                segment_loss: 0.0,
                lost_byte: 0.02 * rate,
                answer_ns: 10 * US,
            };
            line.faults(index, plan);
        }
        let turns = match line.can {
            Can { stream: true, .. } => 20_000,
            // Most of the time there is no connection.
            Can { sessions: true, .. } => 12_000,
            _ => 800,
        };
        for _ in 0..turns {
            let index = random.usize(..3);
            if random.u8(..20) == 0 {
                let commands = crate::conformance::line::commands(&line, index);
                line.order(index, commands[random.usize(..commands.len())]);
            }
            line.wire.log().drives[index].jammed = random.u8(..20) == 0;
            line.turn();
        }
        for index in 0..3 {
            line.answer_as_usual(index);
            line.wire.log().drives[index].jammed = false;
        }
        line.until("all up again", if turns > 800 { 40_000 } else { 2_000 }, |line| {
            // Where they take turns, not all of them have one in the same cycle.
            let up = |index: usize| line.can.half_duplex && line.slots[index].link == Link::Online;
            (0..3).all(|index| up(index) || is_clean(line, &line.seen[index]))
        });
        let c = line.slots[0].counters;
        assert!(!line.can.identified || subject.names_repeat() || c.suspect == 0, "{c:?}");
        if line.can.stream {
            // Most of the time there is no connection.
            assert!(c.missed > 0 && c.unsent > 0, "{c:?}");
            odd += line.slots.iter().map(|slot| slot.counters.late + slot.counters.duplicate).sum::<u64>();
        } else {
            // Several packets in a row are lost now and then only.
            let misses = match line.can {
                Can { sessions: true, .. } => 0,
                Can { own_clock: true, .. } => 4,
                _ => 50,
            };
            let others = if line.can.own_clock { 20 } else { 50 };
            assert!(c.missed > misses && c.late + c.duplicate > others && c.unsent > 0, "{c:?}");
            assert!(c.foreign > 0, "{c:?}");
        }
    }
    assert!(!subject.can().stream || odd > 20, "only {odd} late ones and duplicates");
}
