//! Exchanges without a reply of their own, and those that wait for their turn.

use super::*;
use crate::time::US;

/// One cycle with this exchange as the bus leaves it, and with a new report or not; the record of it.
fn turn(x: &mut Alone, fresh: bool, exchange: impl Fn(Time) -> Exchange) -> DriveRecord {
    x.index += 1;
    let cycle = cycle(x.index);
    let now = cycle.grid;
    (x.slot.exchange, x.slot.notices.fresh) = (exchange(now), fresh);
    if fresh {
        x.slot.status.at = now;
    }
    if x.controller.queued {
        x.controller.sent(&cycle, &mut x.slot);
    }
    x.controller.evaluate_received(&cycle, now, &mut x.slot);
    x.controller.publish(0, &mut false)
}

#[test]
fn a_drive_with_its_own_clock_is_answered_while_its_newest_packet_counts() {
    let mut x = Alone::new(plan()).online();
    x.controller.publish(0, &mut false);
    let before = x.slot.counters;
    let newest = Time((x.index + 1) * MS);
    for (age, fresh) in [(0, true), (1, false), (2, false)] {
        let counts = |now| Exchange::OwnClock { sent_at: now, fresh_until: newest + 3 * MS };
        let record = turn(&mut x, fresh, counts);
        assert_eq!((record.reply, record.rtt_ns), (Reply::Current, None));
        assert_eq!(x.controller.feedback().age, age);
        assert_eq!(record.age_ns, measured(u64::from(age) * MS));
    }
    let record = turn(&mut x, false, |now| Exchange::OwnClock { sent_at: now, fresh_until: now });
    assert_eq!((record.reply, record.rtt_ns), (Reply::Missed, None));
    let c = x.slot.counters;
    assert_eq!((c.answered - before.answered, c.missed - before.missed, c.suspect), (3, 1, 0));
    assert_eq!(x.slot.exchange, Exchange::Missed);
}

#[test]
fn a_reply_of_a_later_cycle_is_feedback_with_its_age_and_a_miss_is_known_when_its_time_is_up() {
    let mut x = Alone::new(plan()).online();
    x.controller.publish(0, &mut false);
    let before = x.slot.counters;
    let owed = |now: Time| Exchange::Owed { sent_at: now + US, reply_by: now + MS * 3 / 2, awaited: true };
    // What the bus does before it sends: the exchange of the cycle before is one of an earlier cycle.
    let passed = |x: &mut Alone, answered: bool| {
        let (sent_at, reply_by) = (Time(x.index * MS) + US, Time(x.index * MS) + MS * 3 / 2);
        x.slot.earlier.owe(sent_at, reply_by);
        x.slot.has_earlier = true;
        assert!(!answered || x.slot.earlier.answer(sent_at, sent_at + MS));
    };
    let record = turn(&mut x, false, owed);
    assert_eq!((record.reply, record.rtt_ns, x.controller.feedback().age), (Reply::Owed, None, 1));
    let closed = |now| Exchange::Answered { sent_at: now + US, at: now + 3 * US, suspect: false };
    for (what, answered, fresh, exchange, reply, rtt_ns, age, missed) in [
        (
            "the reply to the one before",
            true,
            true,
            &owed as &dyn Fn(Time) -> Exchange,
            Reply::Answered,
            MS,
            1,
            0,
        ),
        ("both", true, true, &closed, Reply::Answered, MS, 0, 0),
        ("the one before is lost", false, true, &closed, Reply::Missed, 2 * US, 0, 1),
        ("a copy in disorder that shows nothing new", true, false, &owed, Reply::Answered, MS, 1, 0),
        ("none", false, false, &owed, Reply::Missed, 0, 2, 1),
    ] {
        let c = x.slot.counters;
        passed(&mut x, answered);
        let record = turn(&mut x, fresh, exchange);
        let rtt_ns = if rtt_ns > 0 { measured(rtt_ns) } else { None };
        assert_eq!((record.reply, record.rtt_ns), (reply, rtt_ns), "{what}");
        assert_eq!((x.controller.feedback().age, x.slot.counters.missed - c.missed), (age, missed), "{what}");
        assert!(!x.slot.has_earlier && x.controller.feedback().link == Link::Online, "{what}");
    }
    assert_eq!(x.slot.counters.missed - before.missed, 2);
    // The bucket is judged oldest first, and what was answered in the cycle of the loss does not hold up the stop.
    while x.controller.feedback().link == Link::Online {
        passed(&mut x, false);
        let exchange: &dyn Fn(Time) -> Exchange =
            if x.slot.counters.missed - before.missed > 4 { &closed } else { &owed };
        turn(&mut x, false, exchange);
        assert!(x.index < 100, "it is not lost");
    }
    assert_eq!((x.controller.feedback().link, x.stopped()), (Link::Lost, Some(StopCause::LinkLost)));
    assert!(x.controller.is_due(x.index + 1), "the stop request leaves with the next slot");
}

#[test]
fn a_packet_counts_for_the_limits_whether_an_exchange_was_due_or_not() {
    for due in [false, true] {
        let mut x = ranged();
        x.begin(Command::Follow);
        let mut cycles = 0;
        while x.stopped().is_none() {
            let status = &mut x.slot.status;
            (status.moving, status.velocity) = (true, 600.0);
            status.demand += 0.6;
            status.position = status.demand;
            turn(&mut x, true, |now| match due {
                true => Exchange::OwnClock { sent_at: now, fresh_until: now + MS },
                false => Exchange::Idle,
            });
            cycles += 1;
            assert!(cycles < 20, "faster than its limit");
        }
        assert_eq!(x.stopped(), Some(StopCause::Limit));
    }
}

#[test]
fn a_request_that_waits_for_its_turn_keeps_its_row_and_is_stamped_when_it_leaves() {
    let mut x = following(plan(), &[(0, 0.01, 0.0), (0, 0.02, 0.0), (0, 0.03, 0.0)]);
    let position = |row: Option<Row>| row.map(|row| row.position);
    assert_eq!(position(x.fed_unsent()), Some(0.01));
    let queued = |x: &mut Alone| {
        x.slot.exchange = Exchange::Queued;
        x.controller.sent(&cycle(x.index + 1), &mut x.slot);
        let record = turn(x, false, |_| Exchange::Queued);
        assert_eq!((record.reply, record.phase_ns), (Reply::Queued, None));
        assert_eq!(x.slot.exchange, Exchange::Queued, "neither unsent nor missed");
    };
    let unsent = x.slot.counters;
    for _ in 0..3 {
        queued(&mut x);
        assert_eq!(position(x.fed_unsent()), None, "the row has not left");
    }
    // In the send stage of a cycle in which it is not due, or in a window.
    let record = turn(&mut x, false, |now| Exchange::Owed {
        sent_at: now + 300 * US,
        reply_by: now + 2 * MS,
        awaited: false,
    });
    assert_eq!((record.reply, record.phase_ns), (Reply::Owed, measured(300 * US)));
    assert_eq!(position(x.fed_unsent()), Some(0.02));
    // Passed over, since the one before it is owed.
    let sent_at = Time(x.index * MS) + 300 * US;
    x.slot.exchange = Exchange::Owed { sent_at, reply_by: sent_at + 2 * MS, awaited: false };
    x.controller.sent(&cycle(x.index + 1), &mut x.slot);
    assert_eq!(position(x.fed_unsent()), None, "nor has this one");
    // Sent and overdue in one window.
    x.slot.exchange = Exchange::Idle;
    queued(&mut x);
    let record = turn(&mut x, false, |now| Exchange::Absent { sent_at: now + 100 * US });
    assert_eq!((record.reply, record.phase_ns), (Reply::Missed, measured(100 * US)));
    assert_eq!(record.jitter_ns, measured(200 * US));
    assert_eq!(position(x.fed_unsent()), Some(0.03));
    assert_eq!(x.slot.counters.unsent, unsent.unsent);
}

/// A cycle of `x` with this exchange and report, by the way of each usual cycle or by that of all others; everything
/// that it has led to.
fn evaluated(x: &mut Alone, usually: bool, exchange: Exchange, change: &dyn Fn(&mut Slot)) -> String {
    x.index += 1;
    let cycle = cycle(x.index);
    let now = cycle.grid + 300 * US;
    x.slot.exchange = exchange;
    change(&mut x.slot);
    let reply = match usually {
        true => x.controller.evaluate_received(&cycle, now, &mut x.slot),
        false => x.controller.evaluate_otherwise(&cycle, now, &mut x.slot),
    };
    let reported = x.reported();
    let DriveController { measured, largest, largest_in, health, rising, watch, feedback, machine, .. } =
        &x.controller;
    let parts = (measured, largest, largest_in, health, rising, watch, feedback, machine);
    let led_to = format!("{reply:?} {parts:?} {:?} {reported:?}", x.slot);
    x.controller.publish(0, &mut false);
    led_to
}

#[test]
fn the_way_of_a_usual_cycle_leads_to_the_same_as_that_of_all_others() {
    for seed in 0..200 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut limited = plan();
        limited.limits.velocity = Some(500.0);
        let mut rotary = limited.clone();
        rotary.units.modulo = Some(360.0);
        let mut both = [0, 1].map(|_| match seed % 5 {
            0 => Alone::new(plan()).online(),
            1 => Alone::new(limited.clone()).enabled(),
            2 => Alone::new(rotary.clone()).enabled(),
            3 => {
                let mut x = Alone::new(limited.clone()).enabled();
                x.controller.duty.set_ordered(Some(Command::Torque { slope: 1.0 }));
                x
            }
            _ => {
                let mut x = Alone::of(limited.clone(), Capabilities { power_reports: 2, ..can() }).enabled();
                x.post(Command::Follow);
                x.turns(3);
                x.reported();
                x
            }
        });
        // An enable that has failed may still bring power on.
        let rising = random.u8(..3);
        both.iter_mut().for_each(|x| x.controller.rising = rising);
        let mut position = 0.0;
        for turn in 0..200 {
            let now = Time((both[0].index + 1) * MS);
            let at = now + random.u64(..200) * US;
            let exchange = match random.u8(..30) {
                0 => Exchange::Absent { sent_at: now },
                29 => Exchange::Queued,
                1 => Exchange::Answered { sent_at: now, at, suspect: true },
                2..6 => Exchange::OwnClock { sent_at: now, fresh_until: now + random.u64(..2) },
                _ => Exchange::Answered { sent_at: now + random.u64(..2) * US, at, suspect: false },
            };
            let fresh =
                !matches!(exchange, Exchange::Absent { .. } | Exchange::Queued) && random.u8(..20) > 0;
            position += random.f64() * if random.u8(..40) == 0 { 50.0 } else { 0.3 };
            let rare = random.u8(..60);
            let change = |slot: &mut Slot| {
                (slot.notices.fresh, slot.status.at) = (fresh, at);
                (slot.status.position, slot.status.demand) = (position, position);
                (slot.evidence.position, slot.evidence.demand) = (position, position);
                slot.status.suspect = matches!(exchange, Exchange::Answered { suspect: true, .. });
                slot.status.warning = (rare == 1).into();
                match rare {
                    2 => slot.notices.restarted = true,
                    3 => slot.notices.other_master = seed % 2 == 0,
                    4 => (slot.status.monitor[1], slot.notices.monitor_fresh) = (Some(position), true),
                    5 => slot.notices.report(Emergency { code: 1, register: 2 }),
                    6 => slot.notices.refuse_monitor(1, 2),
                    7 => slot.reachable = true,
                    8 => slot.status.homed ^= true,
                    9 => slot.status.sto_open ^= true,
                    10 => slot.status.velocity = f64::NAN,
                    11 => slot.status.velocity = 1e6,
                    12 => slot.status.state = State::SwitchedOn,
                    13 => slot.status.state = State::OperationEnabled,
                    14 => slot.status.fault = 7,
                    15 => {
                        slot.earlier.owe(Time(now.0 - MS), now + MS);
                        slot.has_earlier = true;
                        assert!(slot.earlier.answer(Time(now.0 - MS), at));
                    }
                    _ => {}
                }
            };
            let [one, other] = &mut both;
            let usual = evaluated(one, true, exchange, &change);
            assert_eq!(usual, evaluated(other, false, exchange, &change), "seed {seed}, turn {turn}");
        }
    }
}
