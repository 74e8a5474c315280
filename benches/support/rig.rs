//! The loop driven by hand on a real-time thread, the machine it runs, and the bare loop that it is measured against.

use std::fmt::Display;
use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use fieldbeat::axis::acyclic::Acyclic;
use fieldbeat::axis::{Limits, Verb};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::wire::{ControlWord, REQUEST_MAX, Request, ResponseDef, ResponseView};
use fieldbeat::bus::linudp::{DRIVE_PORT, LinUdpDrive, LinUdpPlan, MASTER_PORT};
use fieldbeat::cycle::engine::Control;
use fieldbeat::cycle::record::{DriveRecord, Record};
use fieldbeat::cycle::status::{Numbers, Status};
use fieldbeat::cycle::{CyclePlan, Guard, Overrun, Plan, Wait};
use fieldbeat::master::{Assembly, assemble};
use fieldbeat::net::Carriers;
use fieldbeat::rt::{
    self, Clock, Granted, Memory, MonotonicClock, PollSet, Realtime, RealtimeError, RealtimePlan, Regions,
};
use fieldbeat::sim::DatagramDrive;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::time::{S, Time};
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;
use nix::time::{ClockId, clock_gettime};

/// The loop's priority; cyclictest gets the same.
const PRIORITY: u8 = 80;
/// That of simulated drives: below the loop.
const DRIVE_PRIORITY: u8 = 70;
/// Drives of one /24.
const DRIVES_A_NET: usize = 200;

/// Ends the bench: what it needs is not to be had.
pub fn give_up(why: impl Display) -> ! {
    eprintln!("{why}");
    std::process::exit(1)
}

/// Runs `body` on a thread that became the loop's, as [`Master`](fieldbeat::master::Master) makes it.
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
pub fn serve(drives: Vec<Box<dyn DatagramDrive>>, granted: &Granted) -> SimServer {
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
    CyclePlan { period_ns, overrun: Overrun::Skip { max_skip: u64::MAX }, ..CyclePlan::default() }
}

/// A cycle with replies: taken until nine tenths of the period, so that a busy machine costs time and not exchanges.
pub fn exchange_cycle(period_ns: u64, wait: Wait) -> CyclePlan {
    CyclePlan { receive_deadline: 0.9, wait, guard: Guard::Off, ..cycle(period_ns) }
}

/// Whose drives. The benches own 127.90.0.0/16, each side the half of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// Those of our loop.
    Ours = 0,
    /// Those of the bare loop.
    Bare = 100,
}

/// Where the master of `side` sends from.
fn master(side: Side) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(127, 90, side as u8, 1), MASTER_PORT)
}

/// Address of drive `index` of `side`.
pub fn address(side: Side, index: usize) -> SocketAddrV4 {
    let (net, host) = (1 + index / DRIVES_A_NET, 10 + index % DRIVES_A_NET);
    SocketAddrV4::new(Ipv4Addr::new(127, 90, side as u8 + net as u8, host as u8), DRIVE_PORT)
}

fn index_of(address: SocketAddrV4) -> Option<usize> {
    let [_, _, net, host] = address.ip().octets().map(usize::from);
    Some((net % Side::Bare as usize).checked_sub(1)? * DRIVES_A_NET + host.checked_sub(10)?)
}

/// A bus of `drives` LinMot drives of `side`.
pub fn bus(side: Side, drives: usize) -> LinUdpPlan {
    LinUdpPlan::new(*master(side).ip(), (0..drives).map(|index| drive(*address(side, index).ip())).collect())
}

/// A drive as a machine might have it. A miss is counted, it does not end the measurement.
pub fn drive(address: Ipv4Addr) -> LinUdpDrive {
    let mut drive = LinUdpDrive::new(address.to_string(), address);
    drive.axis.limits =
        Limits { position: Some((-200.0, 200.0)), velocity: Some(2_000.0), ..Limits::default() };
    drive.axis.health.bucket = 1_000_000;
    drive.axis.enable_timeout = Duration::from_secs(60);
    drive
}

/// Counts system calls of the loop: those of its clock, and those that a carrier adds.
pub type Calls = Arc<AtomicU64>;

/// Adds to `calls`; only the loop's thread does.
pub fn add(calls: &Calls, count: u64) {
    calls.store(calls.load(Ordering::Relaxed) + count, Ordering::Relaxed);
}

/// How a loop by hand goes from cycle to cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// On the grid, asleep in between.
    Grid,
    /// One cycle right after the other: the clock jumps to the next grid point.
    BackToBack,
}

/// The machine's clock, with an eye on when a cycle began and on its system calls.
#[derive(Debug)]
pub struct Meter {
    pace: Pace,
    /// How far it jumped ahead so far.
    ahead_ns: u64,
    /// Where the last sleep was to end, and when the loop first looked after it.
    grid: Time,
    woke: Option<Time>,
    calls: Calls,
}

impl Clock for Meter {
    fn now(&mut self) -> Time {
        let now = MonotonicClock::read() + self.ahead_ns;
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
                add(&self.calls, 1);
                MonotonicClock.sleep_until(at);
            }
            Pace::BackToBack => self.ahead_ns += at.since(MonotonicClock::read() + self.ahead_ns),
        }
    }

    fn wait(&mut self, set: &mut PollSet, until: Time) -> bool {
        add(&self.calls, 1);
        MonotonicClock.wait(set, until)
    }

    fn spin(&mut self) {
        MonotonicClock.spin();
    }
}

/// One turn of the loop.
#[derive(Clone, Copy, Debug)]
pub struct Turn {
    /// From the end of the sleep to the next one's begin, ns.
    pub busy_ns: u64,
    /// System calls, the sleep included.
    pub calls: u64,
}

/// The loop, to be driven by hand.
#[derive(Debug)]
pub struct Rig {
    assembly: Assembly<Meter>,
    grid: Time,
    calls: Calls,
}

impl Rig {
    /// The loop over the drives of `bus`, if any.
    pub fn new(
        cycle: CyclePlan,
        bus: Option<LinUdpPlan>,
        pace: Pace,
        carriers: &dyn Carriers,
        calls: Calls,
    ) -> Rig {
        let buses = bus.into_iter().map(|bus| Box::new(bus) as Box<dyn BusPlan>).collect();
        let plan = Plan { source: None, cycle, buses, groups: Vec::new() };
        let clock = Meter { pace, ahead_ns: 0, grid: Time(0), woke: None, calls: Arc::clone(&calls) };
        let assembly = match assemble(&plan, clock, carriers, None, Control::default()) {
            Ok(assembly) => assembly,
            Err(error) => give_up(error),
        };
        let mut rig = Rig { assembly, grid: Time(0), calls };
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
        let engine = &mut self.assembly.engine;
        engine.clock().woke = None;
        let before = self.calls.load(Ordering::Relaxed);
        engine.step();
        let clock = engine.clock();
        let end = clock.now();
        let busy_ns = end.since(clock.woke.unwrap_or(end));
        self.grid = clock.grid;
        let calls = self.calls.load(Ordering::Relaxed) - before;
        while let Ok(entry) = self.assembly.records.pop() {
            record(entry);
        }
        Turn { busy_ns, calls }
    }

    /// Turns until all drives are online, enables them, and turns until all are in operation.
    pub fn enable(&mut self) {
        let drives = self.assembly.axes.len() as u32;
        self.turn_until("online", |status| status.online == drives);
        for axis in &mut self.assembly.axes {
            if let Err(error) = axis.post(Verb::Enable) {
                give_up(error)
            }
        }
        self.turn_until("in operation", |status| status.operational == drives);
    }

    fn turn_until(&mut self, what: &str, done: impl Fn(&Status) -> bool) {
        for _ in 0..20_000 {
            if done(self.status()) {
                return;
            }
            self.turn(|_| {});
        }
        give_up(format!("the simulated drives are not {what}: {:?}", self.status()))
    }
}

/// What one loop measured.
#[derive(Debug, Default)]
pub struct Measured {
    /// From before the call that sends to after the one that receives, ns.
    pub round_trips: Vec<u64>,
    /// From the end of the sleep on, ns: ours until it sleeps again, the bare loop's until the last reply.
    pub busy: Vec<u64>,
    /// Processor time from one sleep's begin to the next one's, ns.
    pub cpu: Vec<u64>,
    /// System calls, the sleep included; ours only.
    pub calls: Vec<u64>,
}

/// Our loop and the bare one, on one thread, cycle by cycle in turns.
#[derive(Debug)]
pub struct Duel {
    /// Ours.
    pub ours: Measured,
    /// The bare loop.
    pub bare: Measured,
    /// The end of our loop.
    pub end: Numbers,
}

/// Lets our loop and the bare loop run in turns: each has its own grid of `period_ns`, one half a period behind the other,
/// and its own drives, all in operation and served by one thread. Whatever the machine does in between, it does to both.
pub fn duel(
    granted: &Granted,
    drives: usize,
    wait: Wait,
    period_ns: u64,
    cycles: usize,
    carriers: &(dyn Carriers + Sync),
    calls: &Calls,
) -> Duel {
    let bus = bus(Side::Ours, drives);
    let simulated = bus.simulate().into_iter().chain(self::bus(Side::Bare, drives).simulate()).collect();
    let server = serve(simulated, granted);
    let duel = on_loop_thread(|_| -> std::io::Result<Duel> {
        let mut bare = BareLoop::open(drives, wait, period_ns)?;
        bare.enable()?;
        let mut rig =
            Rig::new(exchange_cycle(period_ns, wait), Some(bus), Pace::Grid, carriers, Arc::clone(calls));
        rig.enable();
        let (mut ours, mut theirs) = (Measured::default(), Measured::default());
        for _ in 0..cycles {
            let (before, executed) = (thread_cpu_ns(), rig.status().executed);
            let turn = rig.turn(|record| {
                if let Record::Drive(DriveRecord { rtt_ns: Some(rtt_ns), .. }) = record {
                    ours.round_trips.push(u64::from(rtt_ns.get()));
                }
            });
            let between = thread_cpu_ns();
            let grid = rig.grid() + period_ns / 2;
            let busy = bare.cycle(grid, ControlWord::ON, |rtt_ns, _| theirs.round_trips.push(rtt_ns))?;
            let after = thread_cpu_ns();
            // Only pairs that both were executed and answered.
            if let Some(busy) = busy
                && rig.status().executed > executed
            {
                ours.busy.push(turn.busy_ns);
                ours.calls.push(turn.calls);
                ours.cpu.push(between - before);
                theirs.busy.push(busy);
                theirs.cpu.push(after - between);
            }
        }
        Ok(Duel { ours, bare: theirs, end: rig.end() })
    });
    drop(server);
    match duel {
        Ok(Ok(duel)) => duel,
        Ok(Err(error)) => give_up(error),
        Err(error) => give_up(error),
    }
}

/// The least that any master has to do: sleep until the grid point, drop what came too late, `sendto` to each drive, then
/// `ppoll` and `recvfrom` until all have answered or nine tenths of the period are over. It sends the bytes that the loop
/// sends to a drive in operation, looks at none of the replies', and judges nothing.
struct BareLoop {
    socket: UdpSocket,
    wait: Wait,
    period_ns: u64,
    peers: Vec<(SocketAddrV4, Time)>,
}

impl BareLoop {
    fn open(drives: usize, wait: Wait, period_ns: u64) -> std::io::Result<BareLoop> {
        let socket = UdpSocket::bind(master(Side::Bare))?;
        socket.set_nonblocking(true)?;
        let peers = (0..drives).map(|index| (address(Side::Bare, index), Time(0))).collect();
        Ok(BareLoop { socket, wait, period_ns, peers })
    }

    /// One cycle; `take` gets each reply's round trip and bytes. Returns the time from the end of the sleep to the last
    /// reply, if all came.
    fn cycle(
        &mut self,
        grid: Time,
        control: ControlWord,
        mut take: impl FnMut(u64, &[u8]),
    ) -> std::io::Result<Option<u64>> {
        let mut request = [0; REQUEST_MAX];
        let blocks =
            Request { response_def: ResponseDef::CYCLIC, control: Some(control), ..Request::default() };
        let length = blocks.emit(&mut request);
        MonotonicClock.sleep_until(grid);
        let woke = MonotonicClock::read();
        let deadline = grid + self.period_ns / 10 * 9;
        let mut reply = [0; 128];
        // One late reply would otherwise be taken for the next one, that for the one after it, and so on for ever.
        while self.socket.recv_from(&mut reply).is_ok() {}
        for (peer, sent) in &mut self.peers {
            *sent = MonotonicClock::read();
            self.socket.send_to(&request[..length], *peer)?;
        }
        let (mut left, mut last) = (self.peers.len(), woke);
        while left > 0 && last < deadline {
            if self.wait == Wait::Poll {
                let rest = deadline.since(MonotonicClock::read());
                let timeout = TimeSpec::new((rest / S) as _, (rest % S) as _);
                ppoll(&mut [PollFd::new(self.socket.as_fd(), PollFlags::POLLIN)], Some(timeout), None)?;
            }
            while left > 0 {
                match self.socket.recv_from(&mut reply) {
                    Ok((length, from)) => {
                        last = MonotonicClock::read();
                        left -= 1;
                        if let SocketAddr::V4(from) = from
                            && let Some((_, sent)) = index_of(from).and_then(|index| self.peers.get(index))
                        {
                            take(last.since(*sent), &reply[..length]);
                        }
                    }
                    Err(error) if error.kind() == ErrorKind::WouldBlock => {
                        last = MonotonicClock::read();
                        break;
                    }
                    Err(error) => return Err(error),
                }
            }
        }
        Ok((left == 0).then(|| last.since(woke)))
    }

    /// Cycles until all drives are in operation: a drive switches on from a low control word only.
    fn enable(&mut self) -> std::io::Result<()> {
        let mut grid = MonotonicClock::read();
        for cycle in 0..20_000 {
            let control = if cycle < 20 { ControlWord::BASE } else { ControlWord::ON };
            grid = (grid + self.period_ns).max(MonotonicClock::read());
            let mut operational = 0;
            self.cycle(grid, control, |_, reply| operational += usize::from(is_operational(reply)))?;
            if operational == self.peers.len() {
                return Ok(());
            }
        }
        Err(std::io::Error::other("the simulated drives do not come into operation"))
    }
}

fn is_operational(reply: &[u8]) -> bool {
    ResponseView::new(reply).is_ok_and(|view| view.status().is_some_and(|status| status.operation_enabled()))
}

/// Processor time of the calling thread, ns.
pub fn thread_cpu_ns() -> u64 {
    let spec = clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).unwrap_or(TimeSpec::new(0, 0));
    spec.tv_sec() as u64 * S + spec.tv_nsec() as u64
}
