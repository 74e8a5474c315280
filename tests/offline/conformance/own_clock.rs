//! Drives that send by their own clocks: no packet answers a request, and requests go whatever comes.

use fieldbeat::axis::Link;
use fieldbeat::telemetry::Counters;
use fieldbeat_core::bus::Exchange;

use crate::conformance::line::{LATENCY, Line, PERIOD};
use crate::conformance::machine::Machine;
use crate::conformance::rules;
use crate::conformance::subject::{Subject, not_applicable};

fn answers_requests(subject: &'static dyn Subject, clause: &str) -> bool {
    let answers = !subject.can().own_clock;
    if answers {
        not_applicable(subject, clause, "its drives answer requests");
    }
    answers
}

pub fn exchanges_are_missed_once_the_newest_packet_is_too_old(subject: &'static dyn Subject) {
    if answers_requests(subject, "the age of packets") {
        return;
    }
    let mut line = Line::made_ready(subject, 2);
    let fresh_within = line.fresh_within_ns().expect("the plan says how long a packet counts");
    for _ in 0..5 {
        line.mute(0, true);
        line.turn();
        let newest = line.slots[0].status.at;
        let (mut answered, mut missed) = (0, 0);
        for _ in 0..10 {
            let grid = line.cycle().grid;
            line.turn();
            let seen = line.seen[0];
            assert!(!seen.fresh && !seen.suspect && seen.round_trip().is_none(), "{seen:?}");
            let counts = grid < newest + fresh_within;
            assert_eq!((seen.answered(), seen.missed()), (counts, !counts), "{seen:?}");
            answered += u32::from(counts);
            missed += u32::from(!counts);
            assert!(line.seen[1].answered(), "its neighbour");
        }
        assert!(answered >= 1 && missed >= 5, "{answered} answered, {missed} missed");
        line.mute(0, false);
        line.heal(0);
    }
    let c = line.slots[0].counters;
    assert_eq!((c.sent, c.suspect), (c.answered + c.missed, 0), "{c:?}");
}

pub fn only_the_newest_of_several_packets_counts(subject: &'static dyn Subject) {
    if answers_requests(subject, "several packets between two requests") {
        return;
    }
    let mut line = Line::made_ready(subject, 1);
    line.order(0, line.changing(0));
    line.turns(100);
    line.turns(5);
    line.mute(0, true);
    // What it reports is of packets that the drive never sent.
    line.honest = false;
    let later = |packet: &[u8], by| subject.later(packet, by).expect("its packets have an order");
    // Not farther ahead than some packets that were lost.
    let (newest, older) = (later(&line.reply(0), 3), later(&line.reply(0), 1));
    let (before, address) = (line.slots[0].counters, line.wire.address(0));
    for packet in [&newest, &older, &newest] {
        line.inject(0, address, packet, LATENCY);
    }
    let mut fresh = 0;
    for _ in 0..2 {
        line.turn();
        fresh += u32::from(line.seen[0].fresh);
        assert!(line.seen[0].answered(), "{:?}", line.seen[0]);
    }
    assert_eq!(fresh, 1, "once, whatever came");
    let said = subject.said(None, &[], &newest).expect("a packet says where the drive is");
    let (report, units) = (&line.slots[0].status, line.drives[0].axis.units);
    assert!(rules::matches_report(report, said, &units), "{report:?}, {said:?}");
    let c = line.slots[0].counters;
    let expected = Counters { late: before.late + 1, duplicate: before.duplicate + 1, ..before };
    assert_eq!(Counters { sent: before.sent, answered: before.answered, ..c }, expected);
    line.mute(0, false);
    line.turns(20);
    line.honest = true;
    line.heal(0);
}

pub fn a_packet_between_two_exchanges_is_reported_at_once(subject: &'static dyn Subject) {
    if answers_requests(subject, "a packet between two exchanges") {
        return;
    }
    let mut line = Line::with(subject, 1, |_, drive| drive.axis.divisor = 3);
    if line.fresh_within_ns().is_some_and(|ns| ns >= 6 * PERIOD) {
        return not_applicable(
            subject,
            "a packet between two exchanges",
            "they come no faster than requests",
        );
    }
    line.ready();
    line.order(0, line.changing(0));
    let (mut between, mut answered) = (0, 0);
    for _ in 0..300 {
        line.turn();
        let seen = line.seen[0];
        between += u32::from(seen.fresh && seen.exchange == Exchange::Idle);
        answered += u32::from(seen.answered());
        assert!(!seen.missed());
    }
    assert!(between >= 50 && answered == 100, "{between} packets between two exchanges, {answered} answered");
    // The loop sees each of them in the cycle in which it was taken in.
    let mut m = Machine::new(subject, 1, |_, drive| drive.axis.divisor = 3);
    m.moving();
    let mut ages = [0; 3];
    for _ in 0..300 {
        m.step();
        ages[m.feedback(0).age as usize] += 1;
    }
    // Where they come in each cycle, all are of the same.
    let all = if m.can.sessions { ages[0] > 150 } else { ages.iter().all(|count| *count > 50) };
    assert!(all, "{ages:?}");
}

pub fn requests_go_at_the_agreed_rate_whatever_the_link(subject: &'static dyn Subject) {
    if answers_requests(subject, "requests at an agreed rate") {
        return;
    }
    let schedule = [(1, 0), (2, 1), (3, 2)];
    let mut m = Machine::new(subject, 3, |index, drive| {
        (drive.axis.divisor, drive.axis.phase) = schedule[index];
    });
    // A connection ends by its time-out.
    let silence: u32 = if m.can.sessions { 90 } else { 290 };
    let at_its_rate = |m: &Machine, index: usize, before: usize| {
        let (divisor, phase) = schedule[index];
        let slots = m.asked_in(index, before);
        let every = slots.windows(2).all(|pair| pair[1] - pair[0] == u64::from(divisor));
        assert!(every && slots[0] % u64::from(divisor) == u64::from(phase), "drive {index}: {slots:?}");
        assert!(slots.len() as u32 >= silence / divisor, "drive {index}: {slots:?}");
    };
    // Never seen.
    m.mute(1, true);
    m.mute(2, true);
    m.run(300);
    for index in [1, 2] {
        assert_eq!(m.feedback(index).link, Link::Unseen);
        // Behind the first one of all, which is not in its own slot.
        at_its_rate(&m, index, 1);
        m.mute(index, false);
    }
    m.ready();
    // Lost: the stop goes on it as well.
    let before = [0, 1, 2].map(|index| m.received(index));
    m.mute(1, true);
    m.mute(2, true);
    m.run(u64::from(silence) + 10);
    (0..3).for_each(|index| at_its_rate(&m, index, before[index]));
    for index in [1, 2] {
        assert_eq!(m.feedback(index).link, Link::Lost);
        m.mute(index, false);
    }
    m.online();
    // Where nothing leaves, there is nothing to feed: it is tried once a probe interval.
    m.tape(1, |tape| tape.jammed = true);
    m.until("it lost", 100, |m| m.feedback(1).link == Link::Lost);
    m.run(1_000);
    let c = m.sim.finish().drives[1].counters;
    assert!((10..30).contains(&c.unsent), "{c:?}");
    assert_eq!(c.sent, c.answered + c.missed, "{c:?}");
}
