//! What the loop hands out: samples, events, observers; and that nothing is lost without being counted.

use fieldbeat::axis::{Command, EventKind};

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
            seen.extend(samples.by_ref().map(|feedback| feedback.cycle));
        }
    }
    seen.extend(samples.by_ref().map(|feedback| feedback.cycle));
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
    let kept: Vec<u64> = samples.by_ref().map(|feedback| feedback.cycle).collect();
    assert_eq!(kept, (0..64).collect::<Vec<_>>(), "the oldest stay");
}

#[test]
fn events_that_find_no_room_are_counted() {
    let mut b = Rig::new(1).each(|_, drive| drive.axis.event_queue = 4).start();
    // The bench empties the queue after every step; this one does not.
    for _ in 0..50 {
        b.sim.step();
    }
    let reported = b.sim.status().lost_events;
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
    assert!(lost > reported, "{lost}");
    b.step();
    assert_eq!(b.sim.status().lost_events, lost);
}
