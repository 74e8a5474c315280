//! What the loop hands out: samples, events, observers; and that nothing is lost without being counted.

use fieldbeat::axis::{Command, EventKind, Outcome};

use crate::virtual_time::support::*;

#[test]
fn every_cycle_is_sampled_exactly_once() {
    let mut b = Rig::new(2).each(|index, drive| drive.axis.sample_queue = [0, 256][index]).start();
    assert!(b.sim.axis(0).samples().is_none());
    let mut samples = b.sim.axis(1).samples().unwrap();
    assert!(b.sim.axis(1).samples().is_none(), "taken once");
    let mut seen = Vec::new();
    for turn in 0..2_000 {
        if turn % 200 == 100 {
            b.world().delay_next_wake(3_200_000);
        }
        b.step();
        if turn % 100 == 0 {
            seen.extend(std::iter::from_fn(|| samples.pop().ok()).map(|feedback| feedback.cycle));
        }
    }
    seen.extend(std::iter::from_fn(|| samples.pop().ok()).map(|feedback| feedback.cycle));
    let status = b.status();
    assert_eq!((seen.len() as u64, status.lost_events), (status.executed, 0));
    assert!(seen.windows(2).all(|pair| pair[0] < pair[1]));
    // The gaps are the skipped slots, and nothing else.
    let gaps: u64 = seen.windows(2).map(|pair| pair[1] - pair[0] - 1).sum();
    assert_eq!(gaps, status.skipped);
    assert!(gaps > 0);
}

#[test]
fn samples_that_find_no_room_are_counted() {
    let mut b = Rig::new(1).each(|_, drive| drive.axis.sample_queue = 64).start();
    let mut samples = b.sim.axis(0).samples().unwrap();
    b.run(1_000);
    assert_eq!(b.status().lost_events, 1_000 - 64);
    let kept: Vec<u64> = std::iter::from_fn(|| samples.pop().ok()).map(|feedback| feedback.cycle).collect();
    assert_eq!(kept, (0..64).collect::<Vec<_>>(), "the oldest stay");
}

/// The newest always wins, and none is refused: neither loop nor application waits for the other.
#[test]
fn a_thousand_setpoints_between_two_cycles_come_to_the_last_one() {
    let mut b = Rig::new(1).ready();
    b.post(0, Command::Velocity { acceleration: 10_000.0 });
    for last in [10.0, 0.0, -5.0, 0.0] {
        for _ in 0..100 {
            (0..1_000).for_each(|n| b.sim.axis(0).set_velocity(f64::from(n)).unwrap());
            b.sim.axis(0).set_velocity(last).unwrap();
            b.step();
        }
        assert_near(b.feedback(0).status.velocity, last, 0.5);
    }
}

/// An application that posts and takes nothing for long, and then everything.
#[test]
fn each_accepted_command_ends_exactly_once_however_late_its_end_is_taken() {
    let mut b = Rig::new(1).each(|_, drive| drive.axis.event_queue = 8).ready();
    let mut posted = Vec::new();
    for round in 0..300 {
        let verb = if round % 3 == 2 { Command::Stop { deceleration: None } } else { by(0.01) };
        while let Ok(id) = b.sim.axis(0).post(verb) {
            posted.push(id);
            if verb.is_urgent() {
                break;
            }
        }
        for _ in 0..40 {
            b.sim.step();
        }
    }
    for _ in 0..20_000 {
        b.sim.step();
    }
    assert!(posted.len() > 10_000, "{}", posted.len());
    let mut ended = Vec::new();
    while let Some(event) = b.sim.axis(0).event() {
        if let EventKind::Ended { id, .. } = event.kind {
            ended.push(id);
        }
    }
    ended.sort_unstable();
    assert_eq!(ended, posted);
}

#[test]
fn events_that_find_no_room_are_counted() {
    let mut b = Rig::new(1).each(|_, drive| drive.axis.event_queue = 4).start();
    // The bench empties the queue after every step; this one does not.
    for _ in 0..50 {
        b.sim.step();
    }
    let told = b.sim.status().lost_events;
    for _ in 0..40 {
        b.sim.axis(0).post(Command::Enable).unwrap();
    }
    for _ in 0..5_000 {
        b.sim.step();
    }
    let lost = b.sim.status().lost_events;
    let (mut others, mut ends) = (0, 0);
    while let Some(event) = b.sim.axis(0).event() {
        match event.kind {
            EventKind::Ended { .. } => ends += 1,
            _ => others += 1,
        }
    }
    assert_eq!((others, ends), (4, 40), "the ends of commands have their own places");
    // The states on the way up; and what came before.
    assert!(lost > told, "{lost}");
    b.step();
    assert_eq!(b.sim.status().lost_events, lost);
}

#[test]
fn observers_read_what_the_axis_reads() {
    let mut b = Rig::new(1).ready();
    let observer = b.sim.axis(0).observer();
    let other = observer.clone();
    b.post(0, slowly_to(50.0));
    for _ in 0..50 {
        b.step();
        assert_eq!(observer.feedback(), b.sim.axis(0).feedback());
        assert_eq!(other.feedback(), b.feedback(0));
        assert_eq!(observer.feedback().cycle + 1, b.status().executed);
    }
}

#[test]
fn each_end_is_told_in_the_cycle_in_which_it_happened() {
    let mut b = Rig::new(1).ready();
    let id = b.post(0, to(5.0));
    assert_eq!(b.ended(0, id), Outcome::Done);
    let now = b.feedback(0);
    let (_, event) = b.events.last().unwrap();
    assert!(matches!(event.kind, EventKind::Ended { .. }));
    assert_eq!(event.cycle, now.cycle);
    assert!(event.at >= b.grid() && event.at.since(b.grid()) < b.period_ns);
}

#[test]
fn warnings_come_and_go() {
    let b = Rig::new(1).ready();
    let warnings: Vec<_> =
        b.kinds(0).into_iter().filter(|kind| matches!(kind, EventKind::Warning(_))).collect();
    assert_eq!(warnings, [EventKind::Warning(0x80), EventKind::Warning(0)], "not homed, then homed");
}
