//! The loop driven by hand on a real-time thread.

use std::fmt::Display;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use fieldbeat::axis::{Acyclic, Command, Jog, StopCause};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::Terminals;
use fieldbeat::sim::Simulated;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::telemetry::{Numbers, Status};
use fieldbeat::time::{MS, S, Time};
use fieldbeat::{CyclePlan, Guard, Memory, Overrun, Plan, Realtime, RealtimeError, Wait};
use fieldbeat_core::cycle::engine::Control;
use fieldbeat_core::cycle::record::{Record, Reply};
use fieldbeat_core::cycle::ring::Kept;
use fieldbeat_core::inputs::recording::LogReader;
use fieldbeat_core::inputs::{InputLog, recording};
use fieldbeat_core::logged::{LinkTap, LoggedCarriers, LoggedClock};
use fieldbeat_core::net::Carriers;
use fieldbeat_core::rt;
use fieldbeat_core::rt::Granted;
use fieldbeat_core::rt::{Clock, MonotonicClock, PollSet, RealtimePlan, Regions, Wires};
use fieldbeat_ethercat::TERMINAL_MAX;
use fieldbeat_master::{Assembly, assemble};
use nix::sys::time::TimeSpec;
use nix::time::{ClockId, clock_gettime};

use super::callgrind::counted;

/// The loop's priority; cyclictest gets the same.
pub const PRIORITY: u8 = 80;
/// That of simulated drives: below the loop.
const DRIVE_PRIORITY: u8 = 70;

/// How long simulated drives may take until they are in operation, on the grid of their loop, ns.
const BRING_UP_NS: u64 = 100 * S;

/// Ends the bench: what it needs is not to be had.
pub fn give_up(why: impl Display) -> ! {
    eprintln!("{why}");
    std::process::exit(1)
}

/// Runs `body` on a thread that became the loop's, as [`Master`](fieldbeat::Master) makes it.
pub fn on_loop_thread<T: Send>(body: impl FnOnce(&Granted) -> T + Send) -> Result<T, RealtimeError> {
    rt::memory::prepare_heap();
    let plan = RealtimePlan {
        realtime: Realtime::Prefer,
        memory: Memory::Process,
        priority: PRIORITY,
        core: rt::thread::default_core(),
    };
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().name("bench-loop".into()).stack_size(1 << 20);
        let handle = thread
            .spawn_scoped(scope, || Ok(body(&rt::thread::enter(&plan, &Regions::new())?)))
            .expect("a bench can start a thread");
        handle.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// Prints what is measured and what the loop's thread gets here.
pub fn introduce(what: &str) -> Granted {
    println!("{what}");
    let granted = match on_loop_thread(Granted::clone) {
        Ok(granted) => granted,
        Err(error) => give_up(error),
    };
    let core = granted.core.map_or_else(|| "any".to_owned(), |core| core.to_string());
    let priority =
        if granted.policy == "SCHED_FIFO" { format!(" {}", granted.priority) } else { String::new() };
    println!("loop: core {core}, {}{priority}", granted.policy);
    granted.missing.iter().for_each(|line| println!("NOT REAL TIME: {line}"));
    granted
}

/// A core that is not the loop's, if there is one.
pub fn other_core(granted: &Granted) -> Option<usize> {
    rt::host::online_cores()?.into_iter().find(|core| Some(*core) != granted.core)
}

/// Serves `drives` on a core other than the loop's, below its priority.
pub fn serve(drives: impl Into<Simulated>, granted: &Granted) -> SimServer {
    let options = ServerOptions {
        core: other_core(granted),
        priority: (granted.policy == "SCHED_FIFO").then_some(DRIVE_PRIORITY),
    };
    match SimServer::start(drives, options) {
        Ok(server) => server,
        Err(error) => give_up(format!(
            "{error}; the benches need 127.90.0.0/16 for themselves: end whoever else runs one"
        )),
    }
}

/// A cycle of `period_ns` that nothing but the end of the bench stops.
pub fn cycle(period_ns: u64) -> CyclePlan {
    CyclePlan {
        period_ns,
        overrun: Overrun::Skip { max_skip: u64::MAX },
        max_skip_rate: 1.0,
        ..CyclePlan::default()
    }
}

/// A cycle with replies: taken until nine tenths of the period, so that a busy machine costs time and not exchanges.
pub fn exchange_cycle(period_ns: u64, wait: Wait) -> CyclePlan {
    CyclePlan { receive_deadline: 0.9, wait, guard: Guard::Off, ..cycle(period_ns) }
}

/// Counts system calls of the loop: those of its clock, and those that a carrier adds. Only the loop's thread does.
pub type Calls = Arc<Counters>;

/// See [`Calls`].
#[derive(Debug, Default)]
pub struct Counters {
    made: AtomicU64,
    waits: AtomicU64,
    ready: AtomicU64,
    taken: AtomicU64,
}

/// System calls, from the begin or of a turn.
#[derive(Clone, Copy, Debug, Default)]
pub struct Count {
    /// All of them.
    pub made: u64,
    /// Those that waited until something came, or until a time.
    pub waits: u64,
    /// Of these, those that ended because something had come.
    pub ready: u64,
    /// Those that took in something that had come.
    pub taken: u64,
}

impl Counters {
    /// So many calls were made.
    pub fn made(&self, count: u64) {
        add(&self.made, count);
    }

    /// Of the calls that were made, so many took in something.
    pub fn taken(&self, count: u64) {
        add(&self.taken, count);
    }

    /// A call waited, until something had come or not.
    fn waited(&self, is_ready: bool) {
        add(&self.made, 1);
        add(&self.waits, 1);
        add(&self.ready, u64::from(is_ready));
    }

    /// Until now.
    pub fn now(&self) -> Count {
        let [made, waits, ready, taken] = [&self.made, &self.waits, &self.ready, &self.taken]
            .map(|counter| counter.load(Ordering::Relaxed));
        Count { made, waits, ready, taken }
    }
}

fn add(counter: &AtomicU64, count: u64) {
    counter.store(counter.load(Ordering::Relaxed) + count, Ordering::Relaxed);
}

impl std::ops::AddAssign for Count {
    fn add_assign(&mut self, more: Count) {
        self.made += more.made;
        self.waits += more.waits;
        self.ready += more.ready;
        self.taken += more.taken;
    }
}

impl Count {
    /// Since `before`.
    pub fn since(self, before: Count) -> Count {
        Count {
            made: self.made - before.made,
            waits: self.waits - before.waits,
            ready: self.ready - before.ready,
            taken: self.taken - before.taken,
        }
    }

    /// Those that the loop makes whenever replies come. In how many pieces they come, and so how often it waits and
    /// takes some in, is the host's doing.
    pub fn own(&self) -> u64 {
        self.made - self.waits - self.taken
    }
}

static IN_PAIRS: AtomicBool = AtomicBool::new(false);
/// Drives that got a group so far.
static GROUPED: AtomicU64 = AtomicU64::new(0);

/// From now on every two drives of a plan are a stop group.
pub fn be_in_pairs() {
    IN_PAIRS.store(true, Ordering::Relaxed);
}

/// The stop group of the next drive.
pub fn group() -> Option<u16> {
    let in_pairs = IN_PAIRS.load(Ordering::Relaxed);
    in_pairs.then(|| (GROUPED.fetch_add(1, Ordering::Relaxed) / 2) as u16)
}

/// How a loop by hand goes from cycle to cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// On the grid, asleep in between.
    Grid,
    /// One cycle right after the other: the clock jumps to the next grid point.
    BackToBack,
}

/// How far the clock of the loop that runs has jumped ahead so far, ns. A bench has one loop at a time.
static AHEAD_NS: AtomicU64 = AtomicU64::new(0);

/// Where that clock begins if it is virtual, and what reading it takes then, ns.
const VIRTUAL_BEGIN_NS: u64 = 1_000 * S;
const VIRTUAL_READ_NS: u64 = 50;
/// When a drive on a serial wire in memory has answered: behind its request, as on any wire.
const ANSWERED_NS: u64 = 40_000;
/// Only leaps and readings move the clock, so that each run is the same.
static VIRTUAL: AtomicBool = AtomicBool::new(false);

/// So many serial wires are in memory: as long as there is one, a wait lasts until there is a reply, or until its end,
/// to which the clock jumps.
static SERIAL: AtomicU64 = AtomicU64::new(0);
/// So many of them have a reply that waits to be taken.
static REPLIES: AtomicU64 = AtomicU64::new(0);

/// What the drives in memory do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scene {
    /// They obey, and are elsewhere in each exchange.
    Usual,
    /// Their status is another one in each exchange, too.
    Unsteady,
    /// All of them have a fault.
    Faulted,
    /// None of them answers.
    Silent,
    /// They stand where they are.
    Standing,
}

static SCENE: AtomicU64 = AtomicU64::new(Scene::Usual as u64);

/// From now on.
pub fn set_scene(scene: Scene) {
    SCENE.store(scene as u64, Ordering::Relaxed);
}

/// Whether it is this one.
pub fn is_scene(scene: Scene) -> bool {
    SCENE.load(Ordering::Relaxed) == scene as u64
}

/// So many misses a drive has for nothing; see [`be_strict`].
static BUCKET: AtomicU64 = AtomicU64::new(1_000_000);

/// From now on a drive of a plan is lost as usual. Until then a miss is counted, and does not end the measurement.
pub fn be_strict() {
    BUCKET.store(u64::from(fieldbeat::axis::Health::default().bucket), Ordering::Relaxed);
}

/// The bucket of a drive's misses.
pub fn bucket() -> u32 {
    BUCKET.load(Ordering::Relaxed) as u32
}

/// How long a reply of a connection may take, ns.
pub fn reply_within_ns() -> u64 {
    if bucket() == 1_000_000 { 500 * MS } else { 20 * MS }
}

/// A serial wire in memory was opened.
pub fn serial_opened() {
    SERIAL.fetch_add(1, Ordering::Relaxed);
}

/// A serial wire in memory was closed, on which a reply waited or not.
pub fn serial_closed(waits: bool) {
    SERIAL.fetch_sub(1, Ordering::Relaxed);
    if waits {
        reply_waits(false);
    }
}

/// A reply waits on a serial wire in memory, or was taken.
pub fn reply_waits(waits: bool) {
    let waiting = REPLIES.load(Ordering::Relaxed);
    REPLIES.store(if waits { waiting + 1 } else { waiting - 1 }, Ordering::Relaxed);
}

/// Whether a reply waits on any of them.
pub fn is_reply_waiting() -> bool {
    REPLIES.load(Ordering::Relaxed) > 0
}

/// From now on time is virtual.
pub fn be_virtual() {
    VIRTUAL.store(true, Ordering::Relaxed);
}

/// Time is virtual.
pub fn is_virtual() -> bool {
    VIRTUAL.load(Ordering::Relaxed)
}

/// Now, by the clock of the loop that runs.
pub fn now() -> Time {
    if is_virtual() {
        return Time(VIRTUAL_BEGIN_NS + AHEAD_NS.fetch_add(VIRTUAL_READ_NS, Ordering::Relaxed));
    }
    MonotonicClock::read() + AHEAD_NS.load(Ordering::Relaxed)
}

/// The clock of the loop that runs jumps ahead.
pub fn leap(ns: u64) {
    AHEAD_NS.fetch_add(ns, Ordering::Relaxed);
}

/// So much time has passed for nobody: what a simulation in memory takes is not the loop's. It must have leapt ahead
/// before. In virtual time it has taken none.
pub fn forget(ns: u64) {
    if is_virtual() {
        return;
    }
    AHEAD_NS.store(AHEAD_NS.load(Ordering::Relaxed).saturating_sub(ns), Ordering::Relaxed);
}

/// The machine's clock, with an eye on when a cycle began and on its system calls.
#[derive(Debug)]
pub struct Meter {
    pace: Pace,
    /// Where the last sleep was to end, and when the loop first looked after it.
    grid: Time,
    woke: Option<Time>,
    /// In this turn it has jumped over waits of this length, ns.
    waited_ns: u64,
    calls: Calls,
}

impl Meter {
    fn new(pace: Pace, calls: &Calls) -> Meter {
        Meter { pace, grid: Time(0), woke: None, waited_ns: 0, calls: Arc::clone(calls) }
    }
}

impl Clock for Meter {
    fn now(&mut self) -> Time {
        let now = now();
        // The first look after the sleep is the loop's own: the meter adds none.
        self.woke.get_or_insert(now);
        now
    }

    fn sleep_until(&mut self, at: Time) {
        // The first sleep of a turn; another one is a nap in the window.
        if self.woke.is_none() {
            self.grid = at;
        }
        match self.pace {
            Pace::Grid => {
                self.calls.made(1);
                MonotonicClock.sleep_until(Time(at.0 - AHEAD_NS.load(Ordering::Relaxed)));
            }
            Pace::BackToBack => {
                // What it would be on the grid.
                self.calls.made(1);
                AHEAD_NS.fetch_add(at.since(now()), Ordering::Relaxed);
            }
        }
    }

    fn wait(&mut self, set: &mut PollSet, until: Time) -> bool {
        let on_wires = SERIAL.load(Ordering::Relaxed) > 0;
        if !on_wires && !is_virtual() {
            let is_ready = MonotonicClock.wait(set, until);
            self.calls.waited(is_ready);
            return is_ready;
        }
        // What answers from memory has answered; on a serial wire a while later, and the next one is requested then.
        let is_idle = if on_wires { !is_reply_waiting() } else { is_scene(Scene::Silent) };
        if is_idle {
            let left = until.since(now());
            leap(left);
            self.waited_ns += left;
        } else if on_wires {
            leap(ANSWERED_NS);
            self.waited_ns += ANSWERED_NS;
        }
        self.calls.waited(!is_idle);
        !is_idle
    }

    fn spin(&mut self) {
        MonotonicClock.spin();
    }

    fn spin_until(&mut self, at: Time) -> Time {
        if SERIAL.load(Ordering::Relaxed) > 0 || is_virtual() {
            let left = at.since(now());
            leap(left);
            self.waited_ns += left;
        }
        while now() < at {
            MonotonicClock.spin();
        }
        now()
    }
}

/// One turn of the loop.
#[derive(Clone, Copy, Debug)]
pub struct Turn {
    /// From the end of the sleep to the next one's begin, without what the clock jumped over in the window, ns.
    pub busy_ns: u64,
    /// System calls, the sleep included.
    pub calls: Count,
}

/// A clock that is a [`Meter`], or has one.
pub trait Metered: Clock {
    /// The meter.
    fn meter(&mut self) -> &mut Meter;
}

impl Metered for Meter {
    fn meter(&mut self) -> &mut Meter {
        self
    }
}

impl Metered for LoggedClock<Meter> {
    fn meter(&mut self) -> &mut Meter {
        self.inner()
    }
}

/// The loop, to be driven by hand.
#[derive(Debug)]
pub struct Rig<C = Meter> {
    assembly: Assembly<C>,
    grid: Time,
    calls: Calls,
    /// Process data of the devices that are no drives.
    devices: Vec<Terminals>,
    /// Takes out the log of the inputs, if there is one.
    log: Option<LogReader>,
    words: Vec<u64>,
}

/// Room for the log of some cycles, in words.
const LOG_WORDS: usize = 1 << 20;

impl Rig<LoggedClock<Meter>> {
    /// The loop over the drives of `buses`, with a log of all that it takes from outside.
    pub fn logged(
        cycle: CyclePlan,
        buses: Vec<Box<dyn BusPlan>>,
        pace: Pace,
        carriers: &dyn Carriers,
        calls: Calls,
    ) -> Rig<LoggedClock<Meter>> {
        let (recording, reader) = recording::log(LOG_WORDS, &mut Regions::default());
        let log = InputLog::recording(recording);
        let carriers = LoggedCarriers::new(carriers, &log, LinkTap::default());
        let clock = LoggedClock::new(Meter::new(pace, &calls), &log);
        Rig { log: Some(reader), ..Rig::over(cycle, buses, clock, &carriers, calls) }
    }
}

impl Rig {
    /// The loop over the drives of `buses`.
    pub fn new(
        cycle: CyclePlan,
        buses: Vec<Box<dyn BusPlan>>,
        pace: Pace,
        carriers: &dyn Carriers,
        calls: Calls,
    ) -> Rig {
        Rig::over(cycle, buses, Meter::new(pace, &calls), carriers, calls)
    }
}

impl<C: Metered> Rig<C> {
    fn over(
        cycle: CyclePlan,
        buses: Vec<Box<dyn BusPlan>>,
        clock: C,
        carriers: &dyn Carriers,
        calls: Calls,
    ) -> Rig<C> {
        let plan = Plan { source: None, cycle, buses, groups: Vec::new() };
        AHEAD_NS.store(0, Ordering::Relaxed);
        let assembly = match assemble(
            &plan,
            clock,
            carriers,
            None,
            Control::default(),
            Wires::default(),
            Kept::default(),
        ) {
            Ok(assembly) => assembly,
            Err(error) => give_up(error),
        };
        let words = Vec::with_capacity(LOG_WORDS);
        let mut rig = Rig { assembly, grid: Time(0), calls, devices: Vec::new(), log: None, words };
        for name in plan.facts().iter().flat_map(|bus| &bus.devices) {
            match rig.assembly.devices.take(name) {
                Ok(device) => rig.devices.push(device),
                Err(error) => give_up(error),
            }
        }
        rig.assembly.engine.begin();
        rig
    }

    /// Acyclic access to its drives.
    pub fn acyclics(&self) -> &[Acyclic] {
        &self.assembly.acyclics
    }

    /// The loop's own numbers.
    pub fn status(&self) -> &Status {
        self.assembly.engine.status()
    }

    /// The grid point of the last turn.
    pub fn grid(&self) -> Time {
        self.grid
    }

    /// The exact end of the run.
    pub fn end(self) -> Numbers {
        self.assembly.engine.finish()
    }

    /// One turn; its records go to `record` after the time was taken.
    pub fn turn(&mut self, mut record: impl FnMut(Record)) -> Turn {
        self.write_outputs();
        let engine = &mut self.assembly.engine;
        let meter = engine.clock().meter();
        (meter.woke, meter.waited_ns) = (None, 0);
        let before = self.calls.now();
        engine.step();
        let clock = engine.clock().meter();
        let end = clock.now();
        let busy_ns = end.since(clock.woke.unwrap_or(end)).saturating_sub(clock.waited_ns);
        self.grid = clock.grid;
        let calls = self.calls.now().since(before);
        while let Some(entry) = self.assembly.records.pop() {
            record(entry);
        }
        self.take_log();
        Turn { busy_ns, calls }
    }

    /// One turn that is counted; its records are not.
    pub fn counted_turn(&mut self) {
        self.write_outputs();
        let engine = &mut self.assembly.engine;
        engine.clock().meter().woke = None;
        counted(|| engine.step());
        self.grid = engine.clock().meter().grid;
        while self.assembly.records.pop().is_some() {}
        self.take_log();
    }

    /// Empties the log. Returns how many words there were.
    pub fn take_log(&mut self) -> usize {
        self.words.clear();
        if let Some(reader) = &mut self.log {
            reader.take(&mut self.words);
        }
        self.words.len()
    }

    /// As an application does in each cycle: the outputs of all devices are others than before.
    fn write_outputs(&mut self) {
        let newest = self.status().executed as u8;
        for device in &mut self.devices {
            let (bytes, _) = device.sizes();
            if bytes > 0 {
                // The loop may have passed over a slot: then the queue can be full.
                let _ = device.write(&[newest; TERMINAL_MAX][..bytes]);
            }
        }
    }

    /// From now on it goes from cycle to cycle like this.
    pub fn set_pace(&mut self, pace: Pace) {
        self.assembly.engine.clock().meter().pace = pace;
    }

    /// Turns until all drives are online, enables them, and turns until all are in operation.
    pub fn enable(&mut self) {
        self.enable_with(|_| {});
    }

    /// The same; `after_turn` runs after each turn, with its grid point.
    pub fn enable_with(&mut self, mut after_turn: impl FnMut(Time)) {
        let drives = self.assembly.axes.len() as u32;
        self.turn_until(
            "online",
            |rig| rig.status().online == drives && rig.are_devices_in_operation(),
            &mut after_turn,
        );
        for axis in &mut self.assembly.axes {
            if let Err(error) = axis.post(Command::Enable) {
                give_up(error)
            }
        }
        self.turn_until("in operation", |rig| rig.status().operational == drives, &mut after_turn);
    }

    /// Devices that are no drives take part.
    fn are_devices_in_operation(&self) -> bool {
        self.devices.iter().all(|device| device.inputs().operational)
    }

    /// Has all drives turn, slowly, until their setpoints change: an axis that moves by itself would be stopped.
    pub fn jog(&mut self) {
        self.command(1.0);
        for _ in 0..50 {
            self.turn(|_| {});
        }
    }

    /// A command for each drive: to turn with this velocity.
    pub fn command(&mut self, velocity: f64) {
        for axis in &mut self.assembly.axes {
            if let Err(error) = axis.post(Command::Jog(Jog { velocity, acceleration: 100.0 })) {
                give_up(error)
            }
        }
    }

    /// Why the first axis was stopped that was.
    pub fn stopped(&self) -> Option<StopCause> {
        self.assembly.axes.iter().find_map(|axis| axis.feedback().stopped)
    }

    /// Turns until nothing is owed: all that was sent is judged.
    pub fn settle(&mut self) {
        for _ in 0..1_000 {
            let (mut requested, mut owed) = (false, false);
            self.turn(|record| {
                if let Record::Drive(drive) = record {
                    requested = true;
                    owed |= drive.reply == Reply::Owed;
                }
            });
            if requested && !owed {
                return;
            }
        }
    }

    fn turn_until(&mut self, what: &str, done: impl Fn(&Rig<C>) -> bool, after_turn: &mut dyn FnMut(Time)) {
        // The grid is that of the last turn: there has to be one.
        self.turn(|_| {});
        let begin = self.grid;
        while self.grid.since(begin) < BRING_UP_NS {
            if done(self) {
                return;
            }
            self.turn(|_| {});
            after_turn(self.grid);
        }
        give_up(format!("the simulated drives are not {what}: {:?}", self.status()))
    }
}

/// Processor time of the calling thread, ns.
pub fn thread_cpu_ns() -> u64 {
    let spec = clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).unwrap_or(TimeSpec::new(0, 0));
    spec.tv_sec() as u64 * S + spec.tv_nsec() as u64
}
