//! No allocation and no free in the loop: a counting allocator over whole runs, in virtual time and on real sockets.
//!
//! A test program of its own, since the allocator is everybody's.

mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::net::{SocketAddrV4, UdpSocket};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fieldbeat::axis::{
    Axis, AxisError, AxisPlan, CommandId, EventKind, Link, Move, Outcome, Profile, Row, Target, Verb,
};
use fieldbeat::bus::{Bus, BusPlan, OpenError};
use fieldbeat::cycle::engine::Flow;
use fieldbeat::master::Master;
use fieldbeat::net::Carriers;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::sim::world::WorldOptions;
use fieldbeat::sim::{DatagramDrive, FaultPlan};
use fieldbeat::simulation::Simulation;
use fieldbeat::time::Time;
use support::{LONG, Machine, until};

/// The system's allocator, counting what watched threads ask of it.
struct Counting;

static COUNT: AtomicU64 = AtomicU64::new(0);

thread_local! {
    static WATCHED: Cell<bool> = const { Cell::new(false) };
}

fn count() {
    // Gone at the end of a thread, when its other thread-locals are freed.
    if WATCHED.try_with(Cell::get).unwrap_or(false) {
        COUNT.fetch_add(1, Ordering::Relaxed);
    }
}

// SAFETY: everything is left to the system's allocator; counting neither allocates nor unwinds.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are those of `System`.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        count();
        // SAFETY: as above.
        unsafe { System.dealloc(block, layout) }
    }
    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.realloc(block, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Watches the calling thread while `body` runs and returns how often it allocated or freed.
fn allocations(body: impl FnOnce()) -> u64 {
    let before = COUNT.load(Ordering::Relaxed);
    WATCHED.set(true);
    body();
    WATCHED.set(false);
    COUNT.load(Ordering::Relaxed) - before
}

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

/// Drives of every kind: one that streams, one with a slower schedule, one with all optional telegram parts, and d4 whose
/// link shall be lost, after `victim` misses. Those of the others shall not, and have `bucket`.
fn machine(test: u8, period: &str, bucket: u32, victim: u32) -> (Machine, PathBuf) {
    let machine = Machine::new(test);
    let config = machine.config(
        "m.toml",
        5,
        &format!("period = \"{period}\"\nmax_skip = 100000"),
        &format!(
            "health = {{ bucket = {bucket} }}\nstream = \"off\"\nunderrun = \"hold\"\n\
             no_drive_watchdog = \"accept\"\nleash = 20\nstop = {{ deceleration = 100, timeout = \"30s\" }}\n\
             simulate = {{ stream_patience = 1000 }}"
        ),
    );
    let mut text = std::fs::read_to_string(&config).unwrap();
    for (drive, keys) in [
        ("d0", "divisor = 4\nstream = \"pva-configured\""),
        ("d1", "divisor = 3\nphase = 2"),
        ("d2", "monitor = true\nreply_tag = true"),
        ("d4", "stop = { deceleration = 20000, timeout = \"1s\" }\nhealth.bucket = VICTIM"),
    ] {
        let name = format!("name = \"{drive}\"\n");
        text = text.replace(&name, &format!("{name}{keys}\n"));
    }
    let config = machine.write("m.toml", text.replace("VICTIM", &victim.to_string()));
    (machine, config)
}

fn to(position: f64) -> Verb {
    let profile = Profile { velocity: 400.0, acceleration: 4000.0, deceleration: 4000.0 };
    Verb::Move(Move { target: Target::Absolute(position), profile })
}

/// A slow triangle around 200 mm, row by row, 1 ms each.
fn row(number: u64) -> Row {
    let phase = number % 2000;
    let (distance, velocity) = if phase < 1000 { (phase, 10.0) } else { (2000 - phase, -10.0) };
    Row { position: 200.0 + distance as f64 * 0.01, velocity, acceleration: 0.0, last: false }
}

/// A bus whose simulated drives may allocate: they run on the loop's thread in virtual time only.
#[derive(Debug)]
struct DrivesUnwatched(Box<dyn BusPlan>);

struct Unwatched(Box<dyn DatagramDrive>);

impl BusPlan for DrivesUnwatched {
    fn name(&self) -> &str {
        self.0.name()
    }
    fn protocol(&self) -> &'static str {
        self.0.protocol()
    }
    fn axes(&self) -> Vec<&AxisPlan> {
        self.0.axes()
    }
    fn describe(&self, period_ns: u64) -> Vec<String> {
        self.0.describe(period_ns)
    }
    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        self.0.open(period_ns, carriers)
    }
    fn simulate(&self) -> Vec<Box<dyn DatagramDrive>> {
        let drives = self.0.simulate().into_iter();
        drives.map(|drive| Box::new(Unwatched(drive)) as Box<dyn DatagramDrive>).collect()
    }
}

impl DatagramDrive for Unwatched {
    fn address(&self) -> SocketAddrV4 {
        self.0.address()
    }
    fn faults(&self) -> FaultPlan {
        self.0.faults()
    }
    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        let watched = WATCHED.replace(false);
        let to = self.0.receive(now, from, bytes, reply);
        WATCHED.set(watched);
        to
    }
    fn restart(&mut self, now: Time) {
        let watched = WATCHED.replace(false);
        self.0.restart(now);
        WATCHED.set(watched);
    }
}

/// The whole machine in virtual time, the simulated network included: nothing of it allocates once it runs, nor on the way
/// down.
#[test]
fn two_hundred_thousand_cycles_in_virtual_time_allocate_nothing() {
    let _alone = alone();
    let (machine, config) = machine(1, "250us", 400, 400);
    let lost = Arc::new(AtomicU64::new(0));
    let seen = Arc::clone(&lost);
    let mut plan = support::plan(&config);
    plan.buses =
        plan.buses.into_iter().map(|bus| Box::new(DrivesUnwatched(bus)) as Box<dyn BusPlan>).collect();
    let setup = Master::from_plan(plan).with_task(move |_, axes| {
        let link = axes.feedback(4).map(|feedback| feedback.link);
        seen.fetch_add(u64::from(link == Some(Link::Lost)), Ordering::Relaxed);
    });
    let mut sim = setup.simulate(WorldOptions::default()).unwrap();
    let faults = FaultPlan {
        seed: 7,
        drop: 0.01,
        duplicate: 0.01,
        corrupt: 0.01,
        delay: 0.01,
        delay_ns: 250_000,
        reorder: 0.01,
        wrong_id: 0.01,
        ..FaultPlan::default()
    };
    assert!(sim.world().set_faults(machine.drive(3), faults));
    // Buffers that the simulated network keeps for reuse, more than the faults will ever need at once.
    let stranger = SocketAddrV4::new(machine.ip(200), 5);
    (0..100).for_each(|_| sim.world().inject(machine.master(), stranger, &[0; 128], sim.world().now()));
    sim.run(2_000);

    let mut ends = Ends::default();
    let count = allocations(|| {
        for round in 0..10_u32 {
            for verb in [Verb::Reset, Verb::ResetFault, Verb::Enable, Verb::Home, to(200.0)] {
                ends.all(&mut sim, [Some(verb); 5]);
            }
            // One streams, two jog, and the last one is on its way when its plug is pulled.
            let mut rows = (0_u64..).map(row);
            rows.by_ref().take(200).for_each(|row| {
                let _ = sim.axis(0).push_row(row);
            });
            let _ = sim.axis(0).follow();
            let _ = sim.axis(2).jog(50.0);
            let _ = sim.axis(3).jog(-50.0);
            let _ = sim.axis(4).post(to(f64::from(round) * 40.0 + 20.0));
            for turn in 0..1_000 {
                if turn % 4 == 0 {
                    rows.by_ref().take(1).for_each(|row| drop(sim.axis(0).push_row(row)));
                }
                ends.turn(&mut sim);
            }
            let stop = Some(Verb::Stop { deceleration: None });
            ends.all(&mut sim, [stop, None, stop, Some(Verb::QuickStop), None]);
            assert!(sim.world().unplug(machine.drive(4)));
            sim.run(3_000);
            assert!(sim.world().plug(machine.drive(4)) && sim.world().restart(machine.drive(4)));
            sim.world().inject(machine.master(), machine.drive(1), b"noise", sim.world().now());
            sim.world().delay_next_wake(3_700_000);
            sim.run(4_000);
            // On the way down for the end.
            let _ = sim.axis(1).post(to(100.0));
            sim.run(20);
        }
        sim.stop();
        while sim.step() == Flow::Continue {}
    });
    let executed = sim.status().executed;
    let end = sim.finish();
    assert_eq!(count, 0, "in {executed} cycles");
    assert!(executed > 200_000, "{executed} cycles");
    // All of it really happened.
    assert!(ends.done.iter().all(|done| *done >= 16) && ends.aborted > 0, "{ends:?}");
    assert!(lost.load(Ordering::Relaxed) > 10_000 && end.status.skipped > 0, "{end:?}");
    assert_eq!(end.drives[4].losses, 10, "{:?}", end.drives[4]);
    let counters = end.drives[3].counters;
    assert!(
        counters.missed > 0 && counters.late > 0 && counters.malformed > 0 && counters.foreign > 0,
        "{counters:?}"
    );
}

/// How the commands ended.
#[derive(Debug, Default)]
struct Ends {
    done: [u32; 5],
    aborted: u32,
}

impl Ends {
    /// Posts the verbs and lets the loop turn until they have ended.
    fn all(&mut self, sim: &mut Simulation, verbs: [Option<Verb>; 5]) {
        let mut open = [None; 5];
        for (index, verb) in verbs.into_iter().enumerate() {
            open[index] = verb.and_then(|verb| sim.axis(index).post(verb).ok());
        }
        for _ in 0..40_000 {
            self.turn_for(sim, &mut open);
            if open.iter().all(Option::is_none) {
                return;
            }
        }
    }

    fn turn(&mut self, sim: &mut Simulation) {
        self.turn_for(sim, &mut [None; 5]);
    }

    fn turn_for(&mut self, sim: &mut Simulation, open: &mut [Option<CommandId>; 5]) {
        sim.step();
        for (index, open) in open.iter_mut().enumerate() {
            while let Some(event) = sim.axis(index).event() {
                if let EventKind::Ended { id, outcome, .. } = event.kind {
                    self.done[index] += u32::from(outcome == Outcome::Done);
                    self.aborted += u32::from(matches!(outcome, Outcome::Aborted(_)));
                    *open = open.filter(|open| *open != id);
                }
            }
        }
    }
}

/// The loop on real sockets, watched from inside: its task runs on its thread. A computer that is too busy loses a drive
/// that nobody killed; then it is tried again, but allocate the loop must not even so.
#[test]
fn twenty_thousand_cycles_on_real_sockets_allocate_nothing() {
    let _alone = alone();
    let mut disturbed = Vec::new();
    while let Err(why) = on_real_sockets() {
        disturbed.push(why);
        assert!(disturbed.len() < 4, "{disturbed:#?}");
    }
}

fn on_real_sockets() -> Result<(), String> {
    let (machine, config) = machine(2, "500us", 10_000, 1_500);
    let setup = Master::from_plan(support::plan(&config)).with_task(|_, _| WATCHED.set(true));
    let before = COUNT.load(Ordering::Relaxed);
    let master = setup.start().unwrap();
    let came_through = adventures(&master, &machine, &config);
    // The end of the thread itself may free what it likes.
    assert!(master.is_running());
    let count = COUNT.load(Ordering::Relaxed) - before;
    let run = master.finish();
    let status = run.end.status;
    assert_eq!(count, 0, "in {} cycles", status.executed);
    came_through?;
    assert!(status.executed > 20_000);
    assert_eq!(status.planned, status.executed + status.skipped);
    assert!(run.end.drives[4].losses >= 1);
    assert!(run.end.buses[0].1.datagrams > 0);
    Ok(())
}

fn adventures(master: &Master, machine: &Machine, config: &Path) -> Result<(), String> {
    let said = |error: AxisError| error.to_string();
    let serve = |drives| SimServer::start(drives, ServerOptions::default()).unwrap();
    let drives = || support::plan(config).simulate();
    let mut living = drives();
    let victim = serve(living.split_off(4));
    let _living = serve(living);
    master.wait_online(LONG).map_err(|error| error.to_string())?;
    let mut axes: Vec<Axis> = (0..5).map(|index| master.axis(&format!("d{index}")).unwrap()).collect();
    for verb in [Verb::Enable, Verb::Home, to(200.0)] {
        let ids: Vec<_> = axes.iter_mut().map(|axis| axis.post(verb).unwrap()).collect();
        for (axis, id) in axes.iter_mut().zip(ids) {
            axis.wait(id, verb.name(), LONG).map_err(said)?;
        }
    }

    // A stream, jogs, moves, and a drive that dies on its way, while somebody sends noise.
    let noise = UdpSocket::bind(SocketAddrV4::new(machine.ip(200), 0)).unwrap();
    let mut rows = (0..).map(row);
    rows.by_ref().take(500).for_each(|row| axes[0].push_row(row).unwrap());
    let followed = axes[0].follow().unwrap();
    axes[2].jog(20.0).unwrap();
    axes[3].jog(-20.0).unwrap();
    axes[4].post(to(20.0)).unwrap();
    victim.stop();
    let link = |link: Link| master.observers()[4].1.feedback().link == link;
    assert!(until(LONG, || {
        rows.by_ref().take(axes[0].stream_room().min(20)).for_each(|row| axes[0].push_row(row).unwrap());
        noise.send_to(b"noise", machine.master()).unwrap();
        link(Link::Lost)
    }));
    axes[2].run(Verb::Stop { deceleration: None }, LONG).map_err(said)?;
    axes[3].run(Verb::QuickStop, LONG).map_err(said)?;
    axes[0].run(Verb::Stop { deceleration: None }, LONG).map_err(said)?;
    // Its end came in while the stop was waited for.
    let followed = axes[0].wait(followed, "follow", LONG);
    assert!(matches!(followed, Err(AxisError::Ended { .. })), "{followed:?}");
    let _victim = serve(drives().split_off(4));
    assert!(until(LONG, || link(Link::Online)));
    axes[4].reset().and_then(|()| axes[4].enable()).and_then(|()| axes[4].home()).map_err(said)?;
    assert!(until(LONG, || master.status().executed > 20_000));

    // The way down: a ramp of seconds, left half way.
    axes[1].post(to(380.0)).unwrap();
    if !until(LONG / 10, || axes[1].feedback().velocity > 300.0) {
        return Err(format!("it does not move: {:?}", axes[1].feedback()));
    }
    master.stop_handle().stop();
    assert!(until(LONG, || axes[1].feedback().stopped.is_some() && axes[1].feedback().velocity < 250.0));
    Ok(())
}
