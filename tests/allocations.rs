//! No allocation and no free in the loop: a counting allocator over whole runs, in virtual time and on real sockets.
//!
//! A test program of its own, since the allocator is everybody's.

mod support;

use std::net::SocketAddrV4;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fieldbeat::axis::{CommandId, EventKind, Link, Verb};
use fieldbeat::bus::{Bus, BusPlan, OpenError};
use fieldbeat::cycle::engine::Flow;
use fieldbeat::master::Master;
use fieldbeat::net::Carriers;
use fieldbeat::sim::server::ServerOptions;
use fieldbeat::sim::world::WorldOptions;
use fieldbeat::sim::{FaultPlan, SimDrive};
use fieldbeat::simulation::Simulation;
use fieldbeat::time::Time;
use support::adventures::{Adventures, Calls, DRIVES, Ends, VICTIM, drives, drives_and_errors, row, to};
use support::counting::{Counting, allocations, count, watch};
use support::{LONG, Machine, until};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The counter is one for all threads.
static ALONE: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

#[test]
fn an_allocation_would_be_noticed() {
    let _alone = alone();
    assert_eq!(allocations(|| {}), 0);
    assert_eq!(allocations(|| drop(std::hint::black_box(Box::new(1)))), 2);
}

/// A bus whose simulated drives may allocate: they run on the loop's thread in virtual time only.
#[derive(Debug)]
struct DrivesUnwatched(Box<dyn BusPlan>);

struct Unwatched(Box<dyn SimDrive>);

impl BusPlan for DrivesUnwatched {
    crate::forward_bus_plan!(0);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        self.0.open(period_ns, carriers)
    }
    fn simulate(&self) -> Vec<Box<dyn SimDrive>> {
        let drives = self.0.simulate().into_iter();
        drives.map(|drive| Box::new(Unwatched(drive)) as Box<dyn SimDrive>).collect()
    }
}

impl SimDrive for Unwatched {
    crate::forward_sim_drive!(0);

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        let watched = watch(false);
        let to = self.0.receive(now, from, bytes, reply);
        watch(watched);
        to
    }
    fn restart(&mut self, now: Time) {
        let watched = watch(false);
        self.0.restart(now);
        watch(watched);
    }
}

/// The whole machine in virtual time, the simulated network included: nothing of it allocates once it runs, nor on the
/// way down.
#[test]
fn a_million_cycles_in_virtual_time_allocate_nothing() {
    let _alone = alone();
    let machine = Machine::new(1);
    // The shorter the period, the less of the time goes to the simulated motors.
    let config = drives(&machine, "100us", 400, 200);
    let lost = Arc::new(AtomicU64::new(0));
    let seen = Arc::clone(&lost);
    let mut plan = support::plan(&config);
    plan.buses =
        plan.buses.into_iter().map(|bus| Box::new(DrivesUnwatched(bus)) as Box<dyn BusPlan>).collect();
    let setup = Master::from_plan(plan).with_task(move |_, axes| {
        let link = axes.feedback(VICTIM).map(|feedback| feedback.link);
        seen.fetch_add(u64::from(link == Some(Link::Lost)), Ordering::Relaxed);
    });
    let mut sim = setup.simulate(WorldOptions::default()).unwrap();
    let faults = FaultPlan {
        seed: 7,
        drop: 0.01,
        duplicate: 0.01,
        corrupt: 0.01,
        delay: 0.01,
        delay_ns: 100_000,
        reorder: 0.01,
        wrong_id: 0.01,
        ..FaultPlan::default()
    };
    assert!(sim.world().set_faults(machine.drive(2), faults));
    // Buffers that the simulated network keeps for reuse, more than the faults will ever need at once.
    let stranger = SocketAddrV4::new(machine.ip(200), 5);
    (0..100).for_each(|_| sim.world().inject(machine.master(), stranger, &[0; 128], sim.world().now()));
    sim.run(2_000);

    let (mut ends, mut rounds) = ([Ends::default(); DRIVES], 0);
    let mut calls: [Calls; DRIVES] = Default::default();
    let count = allocations(|| {
        while sim.status().executed < 1_000_000 {
            // The application may allocate.
            let watched = watch(false);
            for (index, calls) in calls.iter_mut().enumerate() {
                calls.keep_up(sim.axis(index).acyclic());
            }
            watch(watched);
            round(&mut sim, &machine, &mut ends, rounds);
            rounds += 1;
        }
        // On the way down from a fast one.
        let _ = sim.axis(1).post(to(100.0));
        sim.run(1_000);
        sim.stop();
        while sim.step() == Flow::Continue {}
    });
    let executed = sim.status().executed;
    let end = sim.finish();
    assert_eq!(count, 0, "in {executed} cycles");
    // All of it really happened.
    assert!(ends.iter().all(|ends| ends.done >= 2 * rounds && ends.aborted > 0), "{rounds}: {ends:?}");
    assert!(lost.load(Ordering::Relaxed) > 10_000 && end.status.skipped > 0, "{end:?}");
    assert!(calls.iter().all(|calls| calls.done >= u64::from(rounds)), "{calls:?}");
    assert_eq!(end.drives[VICTIM].losses, u64::from(rounds), "{:?}", end.drives[VICTIM]);
    let counters = end.drives[2].counters;
    assert!(
        counters.missed > 0 && counters.late > 0 && counters.malformed > 0 && counters.foreign > 0,
        "{counters:?}"
    );
}

/// Enabling, homing, a stream, jogs, moves and stops; a drive whose plug is pulled on its way, and its return after a
/// restart; noise, and a wake-up that comes too late.
fn round(sim: &mut Simulation, machine: &Machine, ends: &mut [Ends; DRIVES], round: u32) {
    for verb in [Verb::Reset, Verb::ResetFault, Verb::Enable, Verb::Home, to(200.0)] {
        all(sim, ends, [Some(verb); DRIVES]);
    }
    let mut rows = (0_u64..).map(row);
    rows.by_ref().take(400).for_each(|row| drop(sim.axis(0).push_row(row)));
    let _ = sim.axis(0).follow();
    let _ = sim.axis(1).jog(50.0);
    let _ = sim.axis(2).jog(-50.0);
    let _ = sim.axis(VICTIM).post(to(f64::from(round % 10) * 40.0 + 20.0));
    for turn in 0..1_000 {
        if turn % 4 == 0 {
            rows.by_ref().take(1).for_each(|row| drop(sim.axis(0).push_row(row)));
        }
        turn_for(sim, ends, &mut [None; DRIVES]);
    }
    let stop = Some(Verb::Stop { deceleration: None });
    all(sim, ends, [stop, stop, Some(Verb::QuickStop), None]);
    assert!(sim.world().unplug(machine.drive(VICTIM)));
    sim.run(3_000);
    assert!(sim.world().plug(machine.drive(VICTIM)) && sim.world().restart(machine.drive(VICTIM)));
    sim.world().inject(machine.master(), machine.drive(1), b"noise", sim.world().now());
    sim.world().delay_next_wake(3_700_000);
    sim.run(4_000);
}

/// Posts the verbs and lets the loop turn until they have ended.
fn all(sim: &mut Simulation, ends: &mut [Ends; DRIVES], verbs: [Option<Verb>; DRIVES]) {
    let mut open = [None; DRIVES];
    for (index, verb) in verbs.into_iter().enumerate() {
        open[index] = verb.and_then(|verb| sim.axis(index).post(verb).ok());
    }
    for _ in 0..100_000 {
        turn_for(sim, ends, &mut open);
        if open.iter().all(Option::is_none) {
            return;
        }
    }
}

/// One turn of the loop; counts what has ended, and strikes it out of `open`.
fn turn_for(sim: &mut Simulation, ends: &mut [Ends; DRIVES], open: &mut [Option<CommandId>; DRIVES]) {
    sim.step();
    for (index, open) in open.iter_mut().enumerate() {
        while let Some(event) = sim.axis(index).event() {
            if let EventKind::Ended { id, outcome, .. } = event.kind {
                ends[index].count(outcome);
                *open = open.filter(|open| *open != id);
            }
        }
    }
}

/// The loop on real sockets, watched from inside: its task runs on its thread.
#[test]
fn twenty_thousand_cycles_on_real_sockets_allocate_nothing() {
    let _alone = alone();
    let machine = Machine::new(2);
    let config = drives_and_errors(&machine, "250us", 10_000, 400);
    let setup = Master::from_plan(support::plan(&config)).with_task(|_, _| {
        watch(true);
    });
    let before = count();
    let master = setup.start().unwrap();
    let axes = master.plan().axes().into_iter().map(|axis| master.axis(&axis.name).unwrap()).collect();
    let mut adventures = Adventures::begin(&machine, &config, axes, ServerOptions::default());
    let goal = master.status().executed + 20_000;
    while master.status().executed < goal {
        adventures.round();
    }
    // The way down: a ramp of seconds, left half way.
    adventures.set_out();
    master.stop_handle().stop();
    let moving = || adventures.axes()[1].feedback();
    assert!(until(LONG, || moving().stopped.is_some() && moving().velocity.abs() < 250.0));
    // The end of the thread itself may free what it likes.
    assert!(master.is_running());
    let count = count() - before;
    let run = master.finish();
    let status = run.end.status;
    assert_eq!(count, 0, "in {} cycles", status.executed);
    assert_eq!(status.planned, status.executed + status.skipped);
    let victim = &run.end.drives[VICTIM];
    assert!(victim.losses > 0, "{victim:?}");
    assert!(adventures.ends.iter().all(|ends| ends.done >= 5), "{:?}", adventures.ends);
    let calls = &adventures.calls;
    assert!(calls.iter().all(|calls| calls.done > 100 && calls.refused > 50), "{calls:?}");
    assert!(calls[VICTIM].failed > 0, "{calls:?}");
    assert!(run.end.drives.iter().any(|drive| drive.counters.unsent > 0));
    assert!(run.end.buses[0].1.datagrams > 0);
}
