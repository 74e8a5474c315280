//! The time grid, overruns, and the order of a cycle.

use std::sync::{Arc, Mutex};

use fieldbeat::axis::{Command, StopCause};
use fieldbeat::time::{MS, Time, US};
use fieldbeat::{Cycle, Guard, Overrun, Wait};

use crate::virtual_time::support::*;

/// A task that writes down the cycles it sees, and the cell to read them from.
fn watched(rig: Rig) -> (Rig, Arc<Mutex<Vec<Cycle>>>) {
    let seen = Arc::new(Mutex::new(Vec::new()));
    let task = Arc::clone(&seen);
    (rig.task(move |cycle, _| task.lock().unwrap().push(*cycle)), seen)
}

/// Every cycle stands on the grid of the first one, at its index.
fn assert_on_grid(cycles: &[Cycle]) {
    let first = cycles[0];
    for pair in cycles.windows(2) {
        assert!(pair[1].index > pair[0].index);
    }
    for cycle in cycles {
        assert_eq!(cycle.grid, first.grid + (cycle.index - first.index) * first.period_ns, "{cycle:?}");
        assert_eq!(cycle.deadline, cycle.grid + first.period_ns / 2);
    }
}

#[test]
fn a_late_wake_up_skips_slots_and_keeps_the_grid() {
    // Late by so much, and so many slots can no longer begin within half of their receive window.
    for (late_ns, skipped) in
        [(240 * US, 0), (251 * US, 1), (1_240 * US, 1), (3_600 * US, 4), (10_200 * US, 10)]
    {
        let (rig, seen) = watched(Rig::new(1));
        let mut b = rig.start();
        b.run(100);
        b.world().delay_next_wake(late_ns);
        b.run(100);
        b.assert_grid();
        let status = b.status();
        assert_eq!(status.skipped, skipped, "late by {late_ns}");
        assert_eq!(status.overruns, u64::from(skipped > 0));
        assert_eq!(status.longest_skip, skipped);
        // What the first skipped slot owed came with the next one at the earliest.
        assert_near(status.wake_max.ns as f64, late_ns.max(skipped * MS) as f64, 200.0);
        assert_eq!(status.wake_max.index, 100);
        assert_eq!(b.feedback(0).stopped, None);
        assert_on_grid(&seen.lock().unwrap());
    }
}

#[test]
fn own_work_that_takes_too_long_is_an_overrun() {
    // The task of cycle 50 takes so long; slots up to its end are gone, and none is made up for.
    for (work_ns, skipped) in [(900 * US, 0), (1_000 * US, 1), (4_200 * US, 4)] {
        let world = Arc::new(Mutex::new(None::<fieldbeat::sim::World>));
        let seen = Arc::new(Mutex::new(Vec::new()));
        let (inside, log) = (Arc::clone(&world), Arc::clone(&seen));
        let mut b = Rig::new(1)
            .task(move |cycle, _| {
                log.lock().unwrap().push(*cycle);
                if cycle.index == 50 {
                    inside.lock().unwrap().as_ref().unwrap().advance(work_ns);
                }
            })
            .start();
        *world.lock().unwrap() = Some(b.world());
        b.run(50);
        assert_eq!(b.status().skipped, 0);
        b.step();
        // At once, not only with the next executed cycle.
        b.assert_grid();
        assert_eq!(b.status().skipped, skipped, "{work_ns}");
        b.run(50);
        b.assert_grid();
        assert_eq!((b.status().skipped, b.status().overruns), (skipped, u64::from(skipped > 0)));
        // The cycle itself and its overrun are one delay.
        assert_eq!(b.status().late, 1, "{work_ns}");
        let seen = seen.lock().unwrap();
        assert_on_grid(&seen);
        assert_eq!(seen[51].index, 51 + skipped);
    }
}

#[test]
fn skipped_slots_are_late_ones_in_the_histogram() {
    let mut b = Rig::new(1).start();
    b.run(100);
    b.world().delay_next_wake(4_700 * US);
    b.run(100);
    b.assert_grid();
    let wake = &b.sim.measured().histograms.wake;
    // So much later came the next slot that was executed, and was not late itself.
    for (slot, late_ns) in [5_000, 4_000, 3_000, 2_000, 1_000].into_iter().enumerate() {
        let most = (late_ns + 5) * US;
        assert_eq!(wake.count_between((late_ns - 5) * US, most), 1, "slot {slot}");
    }
    assert_eq!(wake.count_between(0, 10 * US), b.status().planned - 5);
}

#[test]
fn more_than_max_skip_in_one_hold_up_stops_every_axis() {
    for (slots, stop) in [(10, None), (11, Some(StopCause::Overrun))] {
        let mut b = Rig::new(3).ready();
        let moves: Vec<_> = (0..3).map(|index| b.post(index, slowly_to(100.0))).collect();
        b.run(200);
        let received: Vec<usize> = (0..3).map(|index| b.tape(index).received.len()).collect();
        b.world().delay_next_wake(slots * MS + 200 * US);
        b.run(2);
        assert_eq!(b.status().skipped, slots);
        for (index, from) in received.into_iter().enumerate() {
            let motion = |received: &Delivery| received.request.motion;
            let tape = b.tape(index);
            let first = motion(&tape.received[from]) != motion(&tape.received[from - 1]);
            assert_eq!(first, stop.is_some(), "a stop leaves with the first request after the hold-up");
        }
        b.assert_grid();
        for (index, id) in moves.into_iter().enumerate() {
            assert_eq!(b.feedback(index).stopped, stop, "{slots} slots");
            if let Some(cause) = stop {
                assert_eq!(b.aborted(index, id), fieldbeat::axis::Abort::Stopped(cause));
                b.until("power off", 500, |b| !b.feedback(index).status.state.is_powered());
            } else {
                assert_eq!(b.outcome(index, id), None);
            }
        }
    }
}

#[test]
fn hold_ups_in_a_row_add_up_until_a_cycle_is_executed() {
    let hold_ups = |between: &[u64], executed_between: u64| {
        let mut b = Rig::new(1).cycle(|cycle| cycle.max_skip_rate = 1.0).ready();
        for slots in between {
            // It ends before the next slot, so that hold-ups do not run into each other.
            b.world().delay_next_wake(slots * MS - 400 * US);
            b.step();
            b.run(executed_between);
        }
        b.run(2);
        b.assert_grid();
        assert_eq!(b.status().skipped, between.iter().sum::<u64>());
        b.feedback(0).stopped
    };
    assert_eq!(hold_ups(&[6, 4], 0), None);
    assert_eq!(hold_ups(&[6, 5], 0), Some(StopCause::Overrun));
    assert_eq!(hold_ups(&[4, 4, 3], 0), Some(StopCause::Overrun));
    assert_eq!(hold_ups(&[10, 10, 10], 1), None);
}

#[test]
fn there_are_no_bursts_to_catch_up() {
    for seed in 0..4 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut b = Rig::new(2)
            .cycle(|cycle| (cycle.overrun, cycle.max_skip_rate) = (Overrun::Skip { max_skip: 1_000 }, 1.0))
            .online();
        for _ in 0..600 {
            if random.u8(..4) == 0 {
                b.world().delay_next_wake(random.u64(0..6 * MS));
            }
            b.step();
        }
        b.assert_grid();
        assert!(b.status().skipped > 100);
        let tape = b.tape(0);
        let least = tape.received.windows(2).map(|pair| pair[1].at.since(pair[0].at)).min().unwrap();
        // A period less the latest begin of the first and the readings of the clock.
        assert!(least >= MS / 2 - US, "seed {seed}: {least} ns between two requests");
        // The loop was held up: some came late in their slots, or the bound above proves nothing.
        assert!(least < MS * 9 / 10, "seed {seed}");
    }
}

#[test]
fn the_task_sees_this_cycle_and_its_commands_leave_with_the_next() {
    const K: u64 = 700;
    let grids = Arc::new(Mutex::new(Vec::new()));
    let log = Arc::clone(&grids);
    let mut b = Rig::new(2)
        .each(|index, drive| {
            drive.simulate.start_running = true;
            drive.axis.on_found_running = fieldbeat::axis::FoundRunning::Stop;
            drive.axis.stop.then = fieldbeat::axis::StopThen::Hold;
            drive.axis.name = format!("a{index}");
        })
        .task(move |cycle, axes| {
            log.lock().unwrap().push(cycle.grid);
            let feedback = axes.feedback(0).unwrap();
            assert_eq!(feedback.cycle, cycle.index);
            if cycle.index > 100 {
                assert_eq!(feedback.age, 0, "the reply of this cycle");
                assert!(feedback.status.at >= cycle.grid && feedback.status.at <= cycle.deadline);
            }
            if cycle.index == K {
                axes.command(0, to(20.0)).unwrap();
            }
        })
        .start();
    b.until("standstill", 400, |b| {
        (0..2).all(|i| b.feedback(i).stopped.is_some() && !b.feedback(i).status.moving)
    });
    for index in 0..2 {
        b.done(index, Command::Reset);
        b.done(index, Command::Enable);
        b.tape(index).received.clear();
    }
    b.run(K - b.feedback(0).cycle - 1);
    // Posted before cycle K begins: taken in its exchange, as the task's is.
    b.post(1, to(20.0));
    b.run(10);
    let next: Time = grids.lock().unwrap()[K as usize + 1];
    for index in 0..2 {
        let tape = b.tape(index);
        let first = tape.received.iter().find(|received| received.request.motion.is_some()).unwrap();
        let late_ns = first.at.since(next);
        assert!(
            first.at > next && late_ns < 30 * US,
            "axis {index}: {late_ns} ns, {} before",
            next.since(first.at)
        );
    }
}

#[test]
fn a_guard_spins_up_to_the_grid_and_a_spinning_window_receives_as_much() {
    for (guard, wait, most_ns) in [
        (Guard::Off, Wait::Poll, 30_100),
        (Guard::Fixed(40_000), Wait::Poll, 150),
        (Guard::Auto, Wait::Poll, 5_000),
        (Guard::Fixed(40_000), Wait::Spin, 150),
    ] {
        let mut rig = Rig::new(3).cycle(|cycle| (cycle.guard, cycle.wait) = (guard, wait));
        rig.options.wake_ns = 30_000;
        let mut b = rig.ready();
        b.run(500);
        b.assert_grid();
        let status = b.status();
        assert!(status.wake_max.ns <= most_ns, "{guard:?}: {}", status.wake_max.ns);
        assert!(guard != Guard::Off || status.wake_max.ns > 20_000);
        assert_eq!((status.skipped, status.missed), (0, 0));
    }
}
