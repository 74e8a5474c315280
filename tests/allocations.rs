//! No allocation and no free in the loop: a counting allocator over whole runs, in virtual time and on real sockets.
//!
//! A test program of its own, since the allocator is everybody's.

mod support;

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use fieldbeat::axis::{Command, CommandId, EventKind, Jog, Link, StopCause};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::{Entry, EthercatPlan, Family, KollmorgenDrive, Object, Type, Watchdog};
use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, MoonsDrive};
use fieldbeat::bus::profibus::{LenzeDrive, Numbers, ParameterPath, ProfibusPlan};
use fieldbeat::sim::{
    Carrier, FaultPlan, SerialWire, SimDrive, SimSegment, SimSerial, Simulated, WorldOptions,
};
use fieldbeat::time::{MS, S, Time};
use fieldbeat::{CyclePlan, Flow, Master, Overrun, Plan, Setup, Simulation};
use fieldbeat_core::axis::CallTicket;
use fieldbeat_core::axis::acyclic::{Call, Notation};
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::inputs::recording::LogReader;
use fieldbeat_ethercat::object::Objects;
use fieldbeat_ethernet_ip::IO_PORT;
use fieldbeat_sim::ethercat::EthercatSim;
use fieldbeat_sim::ethernet_ip::{ClockSettings, MoonsSettings, MoonsSim};
use fieldbeat_sim::profibus::{ForeignSettings, NoiseSettings, ProfibusSegment};
use support::adventures::{Calls, DRIVES, Ends, VICTIM, drives, row, to};
use support::counting::{Counting, allocations, watch};
use support::{LONG, Machine};

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

/// A simulated drive may allocate: it runs on the loop's thread in virtual time only.
struct Unwatched(Box<dyn SimDrive>);

impl Unwatched {
    fn around(drive: Box<dyn SimDrive>) -> Box<dyn SimDrive> {
        Box::new(Unwatched(drive))
    }
}

impl SimDrive for Unwatched {
    crate::forward_sim_drive!(0);
    crate::forward! { this => this.0;
        fn more_sockets(&self) -> Vec<(Carrier, SocketAddrV4)>;
        fn next_due(&self) -> Option<Time>;
    }

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        unwatched(|| self.0.receive(now, from, bytes, reply))
    }
    fn receive_at(
        &mut self,
        socket: usize,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        unwatched(|| self.0.receive_at(socket, now, from, bytes, reply))
    }
    fn run(&mut self, now: Time, send: &mut dyn FnMut(usize, SocketAddrV4, &[u8])) {
        unwatched(|| self.0.run(now, send));
    }
    fn restart(&mut self, now: Time) {
        unwatched(|| self.0.restart(now));
    }
}

/// A machine in virtual time whose telemetry may allocate: it has a thread of its own where time is real.
fn begun(setup: Setup, simulated: impl Into<Simulated>, options: WorldOptions) -> Simulation {
    let mut sim = setup.simulate_with(simulated, options).unwrap();
    sim.run_telemetry_by(|work| unwatched(work));
    sim
}

/// Native process data of all drives, for a recording.
fn natively() -> Vec<String> {
    vec!["all".to_owned()]
}

/// How many parts of native process data the loop reports in some cycles.
fn native_parts(sim: &mut Simulation) -> usize {
    let tap = sim.tap(64);
    sim.run(20);
    let batches = std::iter::from_fn(|| tap.next(Duration::ZERO).ok());
    batches.flat_map(|batch| batch.to_vec()).filter(|record| matches!(record, Record::Native(_))).count()
}

/// With all inputs of the loop in a log, and the native process data of all drives among its records. What takes the
/// log out may allocate: that is another thread's work.
#[test]
fn a_recorded_run_allocates_nothing() {
    static LOG: Mutex<Option<LogReader>> = Mutex::new(None);
    static LOGGED: AtomicU64 = AtomicU64::new(0);
    let _alone = alone();
    let machine = Machine::new(247);
    let config = drives(&machine, "1ms", 400, 200);
    let mut plan = support::plan(&config);
    plan.cycle.record_native = natively();
    let setup = Master::from_plan(plan).with_log(|log| {
        *LOG.lock().unwrap() = Some(log.reader);
    });
    let drives = support::simulated(&config).drives.into_iter();
    let drives: Vec<_> = drives.map(Unwatched::around).collect();
    let mut sim = setup.simulate_with(drives, WorldOptions::default()).unwrap();
    sim.run_telemetry_by(|work| {
        unwatched(|| {
            work();
            let mut words = Vec::new();
            LOG.lock().unwrap().as_mut().unwrap().take(&mut words);
            LOGGED.fetch_add(words.len() as u64, Ordering::Relaxed);
        });
    });
    sim.run(2_000);
    let (mut ends, mut rounds) = ([Ends::default(); DRIVES], 0);
    let count = allocations(|| {
        while sim.status().executed < 30_000 {
            round(&mut sim, &machine, &mut ends, rounds);
            rounds += 1;
        }
    });
    assert_eq!(count, 0);
    let (ended, logged) = (LOG.lock().unwrap().as_ref().unwrap().ended_at(), LOGGED.load(Ordering::Relaxed));
    assert!(ended.is_none() && logged > 500_000, "{logged} words, {ended:?}");
    assert!(ends.iter().all(|ends| ends.done > 0), "{ends:?}");
    assert!(native_parts(&mut sim) >= 20 * DRIVES / 2, "each drive that is due");
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
    let setup = Master::from_plan(support::plan(&config)).with_task(move |_, axes| {
        let link = axes.feedback(VICTIM).map(|feedback| feedback.link);
        seen.fetch_add(u64::from(link == Some(Link::Lost)), Ordering::Relaxed);
    });
    let drives = support::simulated(&config).drives.into_iter();
    let drives: Vec<_> = drives.map(Unwatched::around).collect();
    let mut sim = begun(setup, drives, WorldOptions::default());
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
            unwatched(|| {
                for (index, calls) in calls.iter_mut().enumerate() {
                    calls.keep_up(sim.axis(index).acyclic());
                }
            });
            round(&mut sim, &machine, &mut ends, rounds);
            rounds += 1;
        }
        // On the way down from a fast one.
        let _ = sim.axis(1).post(to(100.0));
        sim.run(1_000);
        go_down(&mut sim);
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
    for command in [Command::Reset, Command::ResetFault, Command::Enable, Command::Home, to(200.0)] {
        all(sim, ends, [Some(command); DRIVES]);
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
    let stop = Some(Command::Stop { deceleration: None });
    all(sim, ends, [stop, stop, Some(Command::QuickStop), None]);
    assert!(sim.world().unplug(machine.drive(VICTIM)));
    sim.run(3_000);
    assert!(sim.world().plug(machine.drive(VICTIM)) && sim.world().restart(machine.drive(VICTIM)));
    sim.world().inject(machine.master(), machine.drive(1), b"noise", sim.world().now());
    sim.world().delay_next_wake(3_700_000);
    sim.run(4_000);
}

/// Posts the commands and lets the loop turn until they have ended.
fn all(sim: &mut Simulation, ends: &mut [Ends; DRIVES], commands: [Option<Command>; DRIVES]) {
    let mut open = [None; DRIVES];
    for (index, command) in commands.into_iter().enumerate() {
        open[index] = command.and_then(|command| sim.axis(index).post(command).ok());
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

/// A line whose simulated drives may allocate: they run on the loop's thread in virtual time only.
struct UnwatchedLine(EthercatSim);

/// Does it as nobody who is watched.
fn unwatched<T>(body: impl FnOnce() -> T) -> T {
    let watched = watch(false);
    let done = body();
    watch(watched);
    done
}

impl SimSegment for UnwatchedLine {
    crate::forward_sim_line!(line => line.0);

    fn interface(&self) -> &str {
        self.0.interface()
    }
    fn own_interface(&self) -> Option<&str> {
        self.0.own_interface()
    }
    fn slaves(&self) -> usize {
        self.0.slaves()
    }
    fn pass(&mut self, now: Time, frame: &mut [u8]) -> bool {
        unwatched(|| self.0.pass(now, frame))
    }
    fn advance(&mut self, now: Time) {
        unwatched(|| self.0.advance(now));
    }
    fn restart(&mut self, now: Time, place: usize) {
        unwatched(|| self.0.restart(now, place));
    }
}

const LINE: &str = "local:line";
/// The drive of the line that is switched off and on again, and the one behind the cable that is cut.
const RESTARTED: usize = 1;
const CUT_OFF: usize = 2;

/// Posts a command and turns the loop until it has ended. [`Simulation::execute`] keeps events, and allocates for them.
fn end_of(sim: &mut Simulation, index: usize, command: Command) {
    let Ok(posted) = sim.axis(index).post(command) else { return };
    for _ in 0..8_000 {
        sim.step();
        while let Some(event) = sim.axis(index).event() {
            if matches!(event.kind, EventKind::Ended { id, .. } if id == posted) {
                return;
            }
        }
    }
}

/// A machine of this bus, whose loop skips what it has to and records the native process data of all drives; of the
/// cycle it takes what is not said here.
fn machine_of(bus: impl BusPlan + 'static, cycle: CyclePlan) -> Plan {
    let overrun = Overrun::Skip { max_skip: 1_000 };
    let cycle = CyclePlan { overrun, max_skip_rate: 1.0, record_native: natively(), ..cycle };
    Plan { source: None, cycle, buses: vec![Box::new(bus)], groups: Vec::new() }
}

/// Enables an axis, whatever has befallen it, and lets it jog.
fn enable_and_jog(sim: &mut Simulation, index: usize, velocity: f64) {
    for command in [Command::Reset, Command::ResetFault, Command::Enable] {
        end_of(sim, index, command);
    }
    let _ = sim.axis(index).post(Command::Jog(Jog { velocity, acceleration: 100.0 }));
}

/// Calls that go past the loop: how many were answered, and how many refused.
#[derive(Default)]
struct AcyclicCalls {
    open: Vec<CallTicket>,
    answered: u32,
    refused: u32,
}

impl AcyclicCalls {
    /// Turns the loop, and posts these calls to three axes in turn, axis by axis. The application may allocate.
    fn turns(&mut self, sim: &mut Simulation, calls: &[[Call; 2]; 3]) {
        for turn in 0..1_000 {
            sim.step();
            unwatched(|| {
                for call in calls[turn % 3] {
                    self.open.extend(sim.axis(turn % 3).acyclic().post(call, LONG).ok());
                }
                self.open.retain_mut(|ticket| match ticket.poll() {
                    None => true,
                    Some(end) => {
                        *(if end.is_ok() { &mut self.answered } else { &mut self.refused }) += 1;
                        false
                    }
                });
            });
        }
    }

    /// Nobody waits for what is still open.
    fn forget(&mut self) {
        unwatched(|| self.open = Vec::new());
    }
}

/// Every fiftieth is lost, doubled, late, out of turn, or of somebody else.
fn bad_weather(seed: u64, delay_ns: u64) -> FaultPlan {
    FaultPlan {
        seed,
        drop: 0.02,
        duplicate: 0.02,
        delay: 0.02,
        delay_ns,
        reorder: 0.02,
        wrong_id: 0.02,
        ..FaultPlan::default()
    }
}

/// All three axes are online.
fn is_up(sim: &Simulation) -> bool {
    (0..3).all(|index| sim.feedback(index).link == Link::Online)
}

/// The end of a run, from a motion.
fn go_down(sim: &mut Simulation) {
    sim.stop();
    while sim.step() == Flow::Continue {}
}

/// A line from INIT to OP, its SDOs, lost and broken frames, a drive that is switched off and on, a cable that is cut.
#[test]
fn a_line_allocates_nothing_from_its_bring_up_to_its_end() {
    let _alone = alone();
    let drive = |place: u16| {
        let mut drive = KollmorgenDrive::new(format!("d{place}"), place, Family::S700);
        drive.slave.watchdog = Watchdog::After(100 * MS);
        drive.axis.profile.velocity = 10.0;
        drive.axis.stop.deceleration = 200.0;
        drive.axis.enable_timeout = Duration::from_secs(3);
        drive.show[0] = Some(Entry { object: Object::new(0x6077, 0), kind: Type::I16 });
        drive
    };
    let line = EthercatPlan::new(LINE, (0..3).map(drive).collect());
    let cycle = CyclePlan { reference: Some(line.name.clone()), ..CyclePlan::default() };
    let drives = UnwatchedLine(EthercatSim::of(&line));
    let drives = Simulated { segments: vec![Box::new(drives)], ..Simulated::default() };
    let options = WorldOptions { wake_ns: 20_000, ..WorldOptions::default() };
    let mut sim = begun(Master::from_plan(machine_of(line, cycle)), drives, options);
    // Buffers that the simulated network keeps for reuse, both ways: frames that come this late bring nobody up.
    let late = FaultPlan { delay: 1.0, delay_ns: 20_000_000, duplicate: 1.0, ..FaultPlan::default() };
    assert!(sim.world().set_segment_faults(LINE, late));
    for _ in 0..100 {
        sim.world().inject_frame(LINE, &[0xFF; 1_514], sim.world().now());
    }
    sim.run(100);
    assert!(sim.world().set_segment_faults(LINE, FaultPlan::default()));
    sim.run(100);

    let [read, refused] = ["0x6041:0", "0x5FFF:7"].map(|object| Objects.read(object));
    let calls = [[read.unwrap(), refused.unwrap()]; 3];
    let mut acyclic = AcyclicCalls::default();
    // Of this master and of this protocol, and else all ones.
    let mut broken = [0xFF; 1_514];
    broken[6..14].copy_from_slice(&[0x12, 0x10, 0x10, 0x10, 0x10, 0x10, 0x88, 0xA4]);
    let (mut rounds, mut up) = (0_u32, false);
    let count = allocations(|| {
        up = sim.run_until(20_000, is_up);
        while up && sim.status().executed < 100_000 {
            (0..3).for_each(|index| enable_and_jog(&mut sim, index, 5.0));
            acyclic.turns(&mut sim, &calls);
            unwatched(|| assert!(sim.world().set_segment_faults(LINE, bad_weather(rounds.into(), MS))));
            // A slave takes no frame with a wrong check sequence: what is broken comes to the master only.
            for length in [20, 64, 600] {
                sim.world().inject_frame(LINE, &broken[..length], sim.world().now());
            }
            sim.run(2_000);
            unwatched(|| assert!(sim.world().set_segment_faults(LINE, FaultPlan::default())));
            sim.world().delay_next_wake(3_700_000);
            assert!(sim.world().restart_slave(LINE, RESTARTED));
            sim.run(100);
            unwatched(|| assert!(sim.world().cut(LINE, Some(CUT_OFF))));
            sim.run(500);
            unwatched(|| assert!(sim.world().cut(LINE, None)));
            up = sim.run_until(20_000, is_up);
            acyclic.forget();
            rounds += 1;
        }
        enable_and_jog(&mut sim, 0, 5.0);
        sim.run(1_000);
        go_down(&mut sim);
    });
    let executed = sim.status().executed;
    let end = sim.finish();
    assert!(up, "round {rounds}: {:?}", end.drives);
    assert_eq!(count, 0, "in {executed} cycles, {rounds} rounds");
    // All of it really happened.
    let AcyclicCalls { answered, refused, .. } = acyclic;
    assert!(rounds >= 3 && answered > rounds && refused > rounds, "{rounds}: {answered}, {refused}");
    for index in [RESTARTED, CUT_OFF] {
        assert!(end.drives[index].losses >= u64::from(rounds), "{:?}", end.drives[index]);
    }
    let counters = end.drives[0].counters;
    assert!(counters.missed > 0 && counters.late > 0 && counters.duplicate > 0, "{counters:?}");
    assert!(end.drives.iter().all(|drive| !drive.feedback.status.state.is_powered()), "{:?}", end.drives);
}

/// MOONS' drives by their own clocks, on a network that loses packets and brings them late or twice. Their sessions are
/// on the loop's thread in virtual time only, and allocate when they open a connection, or ask something: not here.
#[test]
fn packets_allocate_nothing_while_their_connections_are_open() {
    let _alone = alone();
    let drive = |index: u8| {
        let mut drive = MoonsDrive::new(format!("m{index}"), Ipv4Addr::new(10, 0, 6, 2 + index));
        drive.axis.divisor = u32::from(index) + 1;
        drive.axis.health.bucket = 400;
        drive.axis.stop.deceleration = 100.0;
        drive.multiplier = Some(7);
        drive
    };
    let bus = EthernetIpPlan::new(Ipv4Addr::new(10, 0, 6, 1), (0..3).map(drive).collect());
    let drives = bus.drives.iter().enumerate().map(|(index, drive)| {
        let mut settings = MoonsSettings::of(drive);
        settings.clock = ClockSettings { drift_ppm: 300, jitter_ns: 200_000, seed: index as u64 };
        Unwatched::around(Box::new(MoonsSim::new(settings)))
    });
    let drives: Vec<_> = drives.collect();
    let setup = Master::from_plan(machine_of(bus, CyclePlan::default()));
    let mut sim = begun(setup, drives, WorldOptions::default());
    assert!(sim.run_until(60_000, is_up), "they are online");
    for index in 0..3 {
        let packets = SocketAddrV4::new(Ipv4Addr::new(10, 0, 6, 2 + index), IO_PORT);
        assert!(
            sim.world().set_faults(packets, FaultPlan { wrong_id: 0.0, ..bad_weather(index.into(), 3 * MS) })
        );
    }
    // Buffers that the simulated network keeps for reuse, more than the faults will ever need at once.
    let (master, stranger) = (Ipv4Addr::new(10, 0, 6, 1), Ipv4Addr::new(10, 0, 6, 200));
    let [master, stranger] = [master, stranger].map(|ip| SocketAddrV4::new(ip, IO_PORT));
    (0..100).for_each(|_| sim.world().inject(master, stranger, &[0; 128], sim.world().now()));
    sim.run(2_000);
    let (mut rounds, before) = (0, sim.status().executed);
    let count = allocations(|| {
        // A silent session sends a probe after 30 s.
        while sim.status().executed < before + 10_000 {
            for index in 0..3 {
                enable_and_jog(&mut sim, index, 1.0 + f64::from(rounds % 3));
            }
            sim.run(500);
            sim.world().delay_next_wake(3_700_000);
            end_of(&mut sim, 0, Command::Stop { deceleration: None });
            end_of(&mut sim, 1, Command::QuickStop);
            end_of(&mut sim, 2, Command::Disable);
            rounds += 1;
        }
    });
    go_down(&mut sim);
    let end = sim.finish();
    assert_eq!(count, 0, "in {} cycles, {rounds} rounds", end.status.executed);
    // All of it really happened.
    assert!(rounds >= 3 && end.status.skipped > 0, "{rounds}: {:?}", end.status);
    for drive in &end.drives {
        let c = drive.counters;
        assert!(c.late > 0 && c.duplicate > 0 && c.missed > 0 && c.answered > 1_000, "{drive:?}");
    }
}

/// A device on a wire that may allocate: it runs on the loop's thread in virtual time only.
struct UnwatchedDevice(Box<dyn SimSerial>);

impl SimSerial for UnwatchedDevice {
    fn receive(&mut self, now: Time, bytes: &[u8]) {
        unwatched(|| self.0.receive(now, bytes));
    }
    fn next_due(&self) -> Option<Time> {
        self.0.next_due()
    }
    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        unwatched(|| self.0.run(now, out));
    }
    fn mislabel(&self, telegram: &mut [u8]) {
        self.0.mislabel(telegram);
    }
    fn restart(&mut self, now: Time) {
        unwatched(|| self.0.restart(now));
    }
    fn open_sto(&mut self, until: Time) {
        self.0.open_sto(until);
    }
}

const PORT: &str = "/dev/ttyS1";
const MSAC1: ParameterPath = ParameterPath::Msac1 { slot: 0, index: 47, axis: 0, numbers: Numbers::FromTop };

/// A wire of Lenze drives from its claim to its end: parameters by each path, lost, broken and repeated telegrams,
/// noise, a drive that is switched off and on, a port that vanishes, another master.
#[test]
fn a_serial_wire_allocates_nothing_from_its_claim_to_its_end() {
    let _alone = alone();
    let drive = |(index, parameters): (usize, ParameterPath)| {
        let mut drive = LenzeDrive::new(format!("l{index}"), 3 + index as u8);
        drive.parameters = parameters;
        drive.axis.jog_deadman = None;
        drive.axis.stop.deceleration = 100.0;
        drive.axis.limits.velocity = Some(20.0);
        drive.axis.enable_timeout = Duration::from_secs(3);
        drive
    };
    let paths = [ParameterPath::Drivecom, ParameterPath::Pkw { pause: true }, MSAC1];
    let bus = ProfibusPlan::new(PORT, 12_000_000, paths.into_iter().enumerate().map(drive).collect());
    let mut segment = ProfibusSegment::of(&bus);
    segment.drives.iter_mut().for_each(|drive| drive.motor.ramps_s = (0.01, 0.01, 0.01));
    segment.noise = Some(NoiseSettings { every_ns: 200 * MS, ..NoiseSettings::default() });
    let foreign = ForeignSettings { after_ns: 10 * S, count: Some(50), ..ForeignSettings::listening(1) };
    segment.foreign = Some(foreign);
    let wire = segment.wire();
    let devices = wire.drives.into_iter().map(|drive| Box::new(UnwatchedDevice(drive)) as Box<dyn SimSerial>);
    let wire = SerialWire { drives: devices.collect(), ..wire };
    let plan = machine_of(bus, CyclePlan { receive_deadline: 0.8, ..CyclePlan::default() });
    let simulated = Simulated { wires: vec![wire], ..Simulated::default() };
    let others = Arc::new(AtomicU64::new(0));
    let seen = Arc::clone(&others);
    let setup = Master::from_plan(plan).with_task(move |_, axes| {
        let stopped = axes.feedback(0).and_then(|feedback| feedback.stopped);
        seen.fetch_add(u64::from(stopped == Some(StopCause::OtherMaster)), Ordering::Relaxed);
    });
    let mut sim = begun(setup, simulated, WorldOptions::default());
    // Buffers that the simulated wire keeps for reuse, more than the faults will ever need at once.
    let late = FaultPlan { delay: 1.0, delay_ns: 20 * MS, duplicate: 1.0, ..FaultPlan::default() };
    assert!(sim.world().set_wire_faults(PORT, late));
    sim.run(1_000);
    assert!(sim.world().set_wire_faults(PORT, FaultPlan::default()));
    sim.run(100);

    let calls = [0, 1, 2].map(|index| {
        let notation = sim.axis(index).acyclic().notation().clone();
        ["C0061", "C1999"].map(|code| notation.read(code).unwrap())
    });
    let mut acyclic = AcyclicCalls::default();
    let (mut rounds, mut up) = (0_u32, false);
    let count = allocations(|| {
        up = sim.run_until(20_000, is_up);
        while up && sim.status().executed < 30_000 {
            (0..3).for_each(|index| enable_and_jog(&mut sim, index, 5.0));
            acyclic.turns(&mut sim, &calls);
            let faults = FaultPlan { corrupt: 0.02, lost_byte: 0.02, ..bad_weather(rounds.into(), MS) };
            unwatched(|| assert!(sim.world().set_wire_faults(PORT, faults)));
            sim.run(2_000);
            unwatched(|| assert!(sim.world().set_wire_faults(PORT, FaultPlan::default())));
            sim.world().delay_next_wake(3_700_000);
            assert!(sim.world().restart_on(PORT, RESTARTED));
            sim.run(1_000);
            // The link thread opens a port, and notes why it was lost: in virtual time on the loop's thread.
            unwatched(|| {
                assert!(sim.world().unplug_port(PORT));
                sim.run(100);
                assert!(sim.world().plug_port(PORT));
                up = sim.run_until(20_000, is_up);
            });
            acyclic.forget();
            rounds += 1;
        }
        enable_and_jog(&mut sim, 0, 5.0);
        sim.run(1_000);
        go_down(&mut sim);
    });
    let executed = sim.status().executed;
    let end = sim.finish();
    assert!(up, "round {rounds}: {:?}", end.drives);
    assert_eq!(count, 0, "in {executed} cycles, {rounds} rounds");
    // All of it really happened.
    assert!(rounds >= 3 && others.load(Ordering::Relaxed) > 0, "{rounds}: {others:?}");
    let AcyclicCalls { answered, refused, .. } = acyclic;
    assert!(answered > 10 * rounds && refused > 10 * rounds, "{rounds}: {answered}, {refused}");
    for drive in &end.drives {
        assert!(drive.losses >= u64::from(rounds), "{drive:?}");
        let c = drive.counters;
        assert!(c.missed > 0 && c.late > 0 && c.malformed > 0 && c.foreign > 0, "{c:?}");
        assert!(!drive.feedback.status.state.is_powered(), "{drive:?}");
    }
}
