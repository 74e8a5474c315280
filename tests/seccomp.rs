//! The system calls of the loop: a filter on its thread kills the process at any system call that is not listed
//! here, and at one that could wait where it must not. Its calls of the allocator, over the same cycles: none.
//!
//! Needs no privilege: whoever has given up the right to gain any (PR_SET_NO_NEW_PRIVS) may filter itself. Since the
//! process dies, it is a child.
#![cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]

mod support;

use std::io::{Read, Write};
use std::mem::offset_of;
use std::net::{SocketAddrV4, TcpListener};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use fieldbeat::axis::{Axis, Command, Link};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::{Area, Device, EthercatPlan, Family, KollmorgenDrive, SlavePlan, Watchdog};
use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, MoonsDrive};
use fieldbeat::bus::profibus::{LenzeDrive, ProfibusPlan};
use fieldbeat::sim::SimPlan;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::telemetry::{Measured, Numbers};
use fieldbeat::time::{MS, Time};
use fieldbeat::{Axes, Cycle, CyclePlan, Flow, Plan};
use fieldbeat_core::axis::acyclic::{Call, Notation};
use fieldbeat_core::cycle::engine::{Control, Engine};
use fieldbeat_core::cycle::ring::Kept;
use fieldbeat_core::cycle::status::Gauges;
use fieldbeat_core::cycle::task::Task;
use fieldbeat_core::inputs::{InputLog, recording};
use fieldbeat_core::logged::{LinkTap, LoggedCarriers, LoggedClock};
use fieldbeat_core::net::{Carriers, Handshake, HandshakeState, Os, StreamPeer, Streams};
use fieldbeat_core::rt::{Clock, MonotonicClock, PollSet, Regions, Wires};
use fieldbeat_ethercat::object::Objects;
use fieldbeat_master::{Assembly, assemble};
use fieldbeat_sim::ethercat::{Coupler, EthercatSegment};
use fieldbeat_sim::ethernet_ip::MoonsDrives;
use fieldbeat_sim::profibus::ProfibusSegment;
use fieldbeat_telemetry::TelemetryThread;
use fieldbeat_telemetry::tap::Taps;
use libc::{c_int, c_long, sock_filter};
use nix::sys::socket::{setsockopt, sockopt};
use support::adventures::{Adventures, VICTIM, drives_and_errors};
use support::counting::{self, Counting, count, watch};
use support::{Ended, LONG, Machine, Program, again, plan, role, skipping, until};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// A call that the loop may make.
struct Allowed {
    call: c_long,
    with: With,
}

/// What one of its arguments must be, by its place.
enum With {
    /// Anything.
    Any,
    /// It has this bit.
    Bit(usize, c_int),
    /// It is this.
    Value(usize, c_int),
}

/// `epoll_wait` as the C library calls it: younger machines have no call of that name.
#[cfg(target_arch = "x86_64")]
const EPOLL_WAIT: c_long = libc::SYS_epoll_wait;
#[cfg(target_arch = "aarch64")]
const EPOLL_WAIT: c_long = libc::SYS_epoll_pwait;

/// All that the loop may ask of the kernel.
const ALLOWED: [Allowed; 13] = [
    // The sleep until the next grid point, and the nap for the rest of the replies: absolute, so that nothing drifts.
    Allowed { call: libc::SYS_clock_nanosleep, with: With::Bit(1, libc::TIMER_ABSTIME) },
    // The wait for the first reply, until the deadline at the latest: in nanoseconds, unlike the time-out of a socket.
    Allowed { call: libc::SYS_ppoll, with: With::Any },
    // All requests of a bus; one that does not fit fails at once.
    Allowed { call: libc::SYS_sendmmsg, with: With::Bit(3, libc::MSG_DONTWAIT) },
    // One request on a connection, on a socket that never waits (O_NONBLOCK); a frame of a line.
    Allowed { call: libc::SYS_sendto, with: With::Any },
    // All replies that are there; none is no reason to wait.
    Allowed { call: libc::SYS_recvmmsg, with: With::Bit(3, libc::MSG_DONTWAIT) },
    // What has come on one connection, or from a line.
    Allowed { call: libc::SYS_recvfrom, with: With::Bit(3, libc::MSG_DONTWAIT) },
    // On which connections something has come: a look with a time-out of 0.
    Allowed { call: EPOLL_WAIT, with: With::Value(3, 0) },
    // Once when one of several connections is taken over, and once when it is given back.
    Allowed { call: libc::SYS_epoll_ctl, with: With::Any },
    // The number of an eventfd, always 8 bytes: wakes up the link thread when a connection is given back.
    Allowed { call: libc::SYS_write, with: With::Value(2, 8) },
    // On a serial wire, when an answer is overdue: how much of the request the driver still holds.
    Allowed { call: libc::SYS_ioctl, with: With::Value(1, libc::TIOCOUTQ as c_int) },
    // After a late cycle, once: what the kernel has counted against this thread.
    Allowed { call: libc::SYS_getrusage, with: With::Any },
    // The clock is read in user space (vdso(7)), but for a machine whose clock source the vDSO cannot read (Xen, some
    // virtual machines without a stable TSC).
    Allowed { call: libc::SYS_clock_gettime, with: With::Any },
    // Not the loop's: how a thread leaves that must not do anything else.
    Allowed { call: libc::SYS_exit, with: With::Any },
];

#[cfg(target_arch = "x86_64")]
const MACHINE: u32 = libc::EM_X86_64 as u32;
#[cfg(target_arch = "aarch64")]
const MACHINE: u32 = libc::EM_AARCH64 as u32;

/// AUDIT_ARCH_*: the machine, 64 bits, little-endian (linux/audit.h). Numbers of calls mean nothing without it; those
/// of the x32 ABI, which has the same, have a bit more and match none.
const ARCH: u32 = MACHINE | 1 << 31 | 1 << 30;

/// The filter as the kernel runs it at every call (seccomp(2)): it loads words of `seccomp_data` and compares.
fn filter() -> Vec<sock_filter> {
    let kill = || instruction(libc::BPF_RET | libc::BPF_K, libc::SECCOMP_RET_KILL_PROCESS, 0, 0);
    let allow = || instruction(libc::BPF_RET | libc::BPF_K, libc::SECCOMP_RET_ALLOW, 0, 0);
    let load = |at: usize| instruction(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, at as u32, 0, 0);
    let jump = |test, value, yes, no| instruction(libc::BPF_JMP | test | libc::BPF_K, value, yes, no);

    let mut program =
        vec![load(offset_of!(libc::seccomp_data, arch)), jump(libc::BPF_JEQ, ARCH, 1, 0), kill()];
    program.push(load(offset_of!(libc::seccomp_data, nr)));
    for Allowed { call, with } in ALLOWED {
        let (place, test, value) = match with {
            With::Any => {
                program.extend([jump(libc::BPF_JEQ, call as u32, 0, 1), allow()]);
                continue;
            }
            With::Bit(place, bit) => (place, libc::BPF_JSET, bit as u32),
            With::Value(place, value) => (place, libc::BPF_JEQ, value as u32),
        };
        // The half of the argument that comes first is the low one on both machines.
        program.extend([
            jump(libc::BPF_JEQ, call as u32, 0, 4),
            load(offset_of!(libc::seccomp_data, args) + 8 * place),
            jump(test, value, 0, 1),
            allow(),
            kill(),
        ]);
    }
    program.push(kill());
    program
}

/// `yes` and `no`: so many instructions are skipped.
fn instruction(code: u32, k: u32, yes: u8, no: u8) -> sock_filter {
    sock_filter { code: code as u16, jt: yes, jf: no, k }
}

/// Puts the calling thread under the filter, for good.
fn confine() {
    let mut program = filter();
    let program = libc::sock_fprog { len: program.len() as u16, filter: program.as_mut_ptr() };
    // SAFETY: prctl takes numbers; seccomp reads `len` instructions behind the pointer, which outlive the call. Without
    // a flag it is about this thread only.
    let refused = unsafe {
        libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0
            || libc::syscall(libc::SYS_seccomp, libc::SECCOMP_SET_MODE_FILTER, 0, &raw const program) != 0
    };
    assert!(!refused, "no seccomp: {}", std::io::Error::last_os_error());
}

/// A loop that runs under the filter, on a thread of its own.
struct Confined<C> {
    /// Locked by that thread until the loop has ended.
    engine: Arc<Mutex<Option<Engine<C>>>>,
    control: Control,
    gauges: Gauges,
    _recorder: TelemetryThread,
}

/// The task of a loop, and its begin under the filter.
type Start<C> = fn(Plan, Task) -> (Confined<C>, Vec<Axis>);

/// As an application starts it.
fn plain(plan: Plan, task: Task) -> (Confined<MonotonicClock>, Vec<Axis>) {
    Confined::start(&plan, MonotonicClock, &Os::default(), task)
}

/// Room for the log of seconds, in words.
const LOG_WORDS: usize = 1 << 22;

/// With all that can be recorded in addition: the log of its inputs, and native process data.
fn recorded(mut plan: Plan, task: Task) -> (Confined<LoggedClock<MonotonicClock>>, Vec<Axis>) {
    plan.cycle.record_native = vec!["all".to_owned()];
    let (recording, mut reader) = recording::log(LOG_WORDS, &mut Regions::default());
    let log = InputLog::recording(recording);
    let os = Os::default();
    let clock = LoggedClock::new(MonotonicClock, &log);
    let started = Confined::start(&plan, clock, &LoggedCarriers::new(&os, &log, LinkTap::default()), task);
    std::thread::spawn(move || {
        let mut words = Vec::new();
        while reader.take(&mut words) {
            if reader.ended_at().is_some() {
                eprintln!("the log has ended: it was taken out too slowly");
                std::process::exit(1);
            }
            LOGGED.fetch_add(words.len() as u64, Ordering::Relaxed);
            words.clear();
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
    });
    started
}

/// Words of the log that were taken out.
static LOGGED: AtomicU64 = AtomicU64::new(0);

impl<C: Clock + Send + 'static> Confined<C> {
    fn start(plan: &Plan, clock: C, carriers: &dyn Carriers, task: Task) -> (Confined<C>, Vec<Axis>) {
        let control = Control::default();
        let Assembly { engine, axes, gauges, records, .. } =
            assemble(plan, clock, carriers, Some(task), control.clone(), Wires::default(), Kept::default())
                .unwrap();
        let measured = Measured::new(&plan.units(), &plan.cycle, true);
        let recorder = TelemetryThread::start(records, measured, Taps::default(), None, None, || {}).unwrap();
        let engine = Arc::new(Mutex::new(Some(engine)));
        let of_thread = Arc::clone(&engine);
        // Not to be waited for: it leaves without notifying its handle.
        drop(std::thread::spawn(move || {
            let mut engine = of_thread.lock().unwrap();
            let of_loop = engine.as_mut().unwrap();
            confine();
            watch(true);
            of_loop.begin();
            while of_loop.step() == Flow::Continue {}
            watch(false);
            // Nobody sleeps at this lock, so that giving it back takes no call.
            drop(engine);
            // SAFETY: ends this thread only, and what stands on its stack is needed by nobody and never freed.
            unsafe { libc::syscall(libc::SYS_exit, 0) };
        }));
        (Confined { engine, control, gauges, _recorder: recorder }, axes)
    }

    fn executed(&self) -> u64 {
        self.gauges.status.read().executed
    }

    /// Waits for the end of the loop.
    fn end(self) -> Numbers {
        let mut end = None;
        assert!(until(LONG, || {
            end = self.engine.try_lock().ok().and_then(|mut engine| engine.take());
            end.is_some()
        }));
        end.map(Engine::finish).unwrap()
    }
}

/// The cycles that the loop has to execute.
const CYCLES: u64 = 40_000;

/// What the child says in the end, before the number of executed cycles.
const LIVED: &str = "lived under the filter: ";

/// A process that is to be killed shall not leave its memory behind as a file.
fn leave_no_core() {
    // SAFETY: takes numbers.
    unsafe { libc::prctl(libc::PR_SET_DUMPABLE, 0, 0, 0, 0) };
}

/// What the child does: `crime` is committed on the loop's thread, should there be one.
fn live<C: Clock + Send + 'static>(start: Start<C>, crime: Option<fn()>) {
    leave_no_core();
    let machine = Machine::new(1);
    let config = drives_and_errors(&machine, "250us", 10_000, 700);
    let lost = Arc::new(AtomicU64::new(0));
    let seen = Arc::clone(&lost);
    let task = move |cycle: &Cycle, axes: &mut Axes<'_>| {
        let link = axes.feedback(VICTIM).map(|feedback| feedback.link);
        seen.fetch_add(u64::from(link == Some(Link::Lost)), Ordering::Relaxed);
        if cycle.index > 1_000
            && let Some(crime) = crime
        {
            crime();
        }
    };
    let (confined, axes) = start(plan(&config), Box::new(task));
    let mut adventures = Adventures::begin(&machine, &config, axes, ServerOptions::default());
    let goal = confined.executed() + CYCLES;
    while confined.executed() < goal || !adventures.have_done(10) {
        adventures.round();
    }
    // All the way down: a ramp, cut short half way by somebody who is in a hurry.
    adventures.set_out();
    confined.control.stop();
    let moving = || adventures.axes()[1].feedback();
    assert!(until(LONG, || moving().stopped.is_some() && moving().status.velocity.abs() < 250.0));
    confined.control.stop();
    let end = confined.end();

    let status = end.status;
    assert_eq!(count(), 0, "allocations in {} cycles", status.executed);
    assert_eq!(status.planned, status.executed + status.skipped);
    assert!(lost.load(Ordering::Relaxed) > 0);
    let drive = |name: &str| end.drives.iter().find(|drive| drive.name == name).unwrap();
    for (axis, ends) in adventures.axes().iter().zip(&adventures.ends) {
        let drive = drive(axis.name());
        // In a hurry it is waited for only 250 ms: a drive that reported nothing for most of them may have power yet.
        let feedback = &drive.feedback;
        assert!(!feedback.status.state.is_powered() || feedback.age >= 800, "{ends:?} {drive:?}");
    }
    let losses = end.drives[VICTIM].losses;
    assert!(losses > 0, "{:?}", end.drives[VICTIM]);
    let (dead, refused) = (drive("dead").counters, drive("refused").counters);
    assert!(dead.sent > 0 && dead.answered + dead.unsent == 0, "{dead:?}");
    assert!(refused.unsent > 0 && refused.sent == 0, "{refused:?}");
    assert!(end.buses.iter().any(|(_, unmatched)| unmatched.datagrams > 0), "{:?}", end.buses);
    println!("{LIVED}{} cycles, {losses} losses", status.executed);
}

/// The test `name` once more in a process of its own, to play `role`. Whoever is killed leaves its files behind: they
/// go with `shelter`.
fn child(name: &str, role: &str, shelter: &Machine) -> Ended {
    Program::spawn(again(name, role).env("TMPDIR", shelter.path(""))).end_within(10 * LONG)
}

/// A child that has to live to its end.
fn innocent_child(name: &str, role: &str, shelter: u8) -> Ended {
    let ended = child(name, role, &Machine::new(shelter));
    assert_ne!(
        ended.signal,
        Some(libc::SIGSYS),
        "a call that is not listed; strace -f shows which: {ended:?}"
    );
    ended.expect(0);
    assert!(ended.out.contains(LIVED), "{ended:?}");
    ended
}

#[test]
fn forty_thousand_cycles_need_no_other_system_call_than_those_listed() {
    match role().as_deref() {
        None => {}
        Some("recorded") => {
            live(recorded, None);
            return assert!(LOGGED.load(Ordering::Relaxed) > CYCLES);
        }
        Some(_) => return live(plain, None),
    }
    let name = "forty_thousand_cycles_need_no_other_system_call_than_those_listed";
    for role in ["innocent", "recorded"] {
        let ended = innocent_child(name, role, 2);
        let lived = ended.out.lines().find_map(|line| line.strip_prefix(LIVED)).unwrap();
        assert!(lived.split(' ').next().unwrap().parse::<u64>().unwrap() >= CYCLES, "{ended:?}");
        println!("{role}: {LIVED}{lived}");
    }
}

/// The begin of a loop that records, and its bus: it comes up, is commanded and read past the loop, lost, and found
/// again. On a busy computer without real time the drives may be late, or not synchronous for long: that they were
/// online at all is enough.
struct Lives<F> {
    begun: (Confined<LoggedClock<MonotonicClock>>, Vec<Axis>),
    /// Of the first life, if it is there before the loop.
    server: Option<SimServer>,
    serve: F,
    read: Call,
    /// That the loop has to execute.
    cycles: u64,
}

impl<F: Fn() -> SimServer> Lives<F> {
    /// The cycles of the silence between two lives.
    const SILENCE: u64 = 1_000;

    fn live(self, what: &str) {
        let Lives { begun: (confined, mut axes), mut server, serve, read, cycles } = self;
        let (mut lives, mut answered) = (0, 0_u32);
        while confined.executed() < cycles || lives < 2 {
            server.get_or_insert_with(&serve);
            assert!(until(LONG, || axes.iter().all(|axis| axis.feedback().link == Link::Online)));
            lives += 1;
            for axis in &mut axes {
                for command in [Command::Reset, Command::ResetFault, Command::Enable] {
                    let _ = axis.post(command);
                }
                let _ = axis.jog(1.0);
                while axis.event().is_some() {}
            }
            let goal = confined.executed() + cycles / 4;
            assert!(until(LONG, || {
                answered +=
                    u32::from(axes[0].acyclic().post(read, LONG).is_ok_and(|mut call| {
                        until(LONG / 60, || call.poll().is_some_and(|end| end.is_ok()))
                    }));
                confined.executed() > goal
            }));
            // Nobody takes what the loop sends, and nothing comes.
            drop(server.take());
            let goal = confined.executed() + Self::SILENCE;
            assert!(until(LONG, || confined.executed() > goal));
        }
        confined.control.stop();
        confined.control.stop();
        let end = confined.end();
        let status = end.status;
        assert_eq!(count(), 0, "allocations in {} cycles", status.executed);
        assert_eq!(status.planned, status.executed + status.skipped);
        assert!(answered > 0, "{:?}", end.drives);
        for drive in &end.drives {
            assert!(drive.counters.answered > 0 && drive.counters.unsent > 0, "{drive:?}");
        }
        println!("{LIVED}{} cycles {what}, {lives} lives, {answered} calls", status.executed);
    }
}

/// The simulated side of a bus, on this host.
fn server(simulated: impl Into<SimPlan>) -> SimServer {
    SimServer::start(simulated.into().build(), ServerOptions::default()).unwrap()
}

/// What the child does with a line, and SDOs by mailbox.
fn live_on_a_line() {
    let drive = |place: u16| {
        let mut drive = KollmorgenDrive::new(format!("d{place}"), place, Family::S700);
        drive.slave.watchdog = Watchdog::After(100 * MS);
        drive.axis.health.bucket = 1_000_000;
        drive
    };
    let slave = SlavePlan {
        inputs: vec![Area { start: 0x1000, length: 2 }],
        outputs: vec![Area { start: 0x1100, length: 2 }],
        ..SlavePlan::new(2)
    };
    let mut line =
        EthercatPlan::new(format!("local:seccomp-{}", std::process::id()), vec![drive(0), drive(1)]);
    line.devices.push(Device { name: "io".into(), slave });
    // Without terminals.
    let segment = EthercatSegment { devices: vec![Coupler::default()], ..line.clone().into() };
    let cycle =
        CyclePlan { reference: Some(line.name.clone()), receive_deadline: 0.8, ..CyclePlan::default() };
    let begun = recorded(skipping(line, cycle), Box::new(|_, _| {}));
    let read = Objects.read("0x6041:0").unwrap();
    Lives { begun, server: None, serve: || server(segment.clone()), read, cycles: 20_000 }.live("on a line");
}

/// What the child does with a bus whose drives are there before the loop; this is read of the first of them.
fn live_on<B: BusPlan + Clone + 'static>(bus: &B, serve: impl Fn() -> SimServer, address: &str, what: &str) {
    let server = Some(serve());
    let plan = skipping(bus.clone(), CyclePlan { period_ns: 2 * MS, ..CyclePlan::default() });
    let begun = recorded(plan, Box::new(|_, _| {}));
    let read = bus.facts(CyclePlan::default().grid()).notation.read(address).unwrap();
    Lives { begun, server, serve, read, cycles: 10_000 }.live(what);
}

/// What the child does with MOONS' drives: their connections are opened, too.
fn live_on_packets() {
    let machine = Machine::new(7);
    let drive = |index: u8| {
        let mut drive = MoonsDrive::new(format!("m{index}"), machine.ip(10 + index));
        drive.axis.divisor = 1 + u32::from(index);
        drive.axis.health.bucket = 1_000_000;
        drive.fresh_within_ns = Some(100 * MS);
        // As the loop has it, so that a drive that is gone is noticed.
        drive.multiplier = Some(5);
        drive
    };
    let bus = EthernetIpPlan::new(machine.ip(1), vec![drive(0), drive(1)]);
    live_on(&bus, || server(MoonsDrives::of(&bus)), "AC", "of packets");
}

/// What the child does with a wire of Lenze drives: codes are read in their turns.
fn live_on_a_wire() {
    let drive = |index: u8| {
        let mut drive = LenzeDrive::new(format!("l{index}"), 3 + index);
        drive.axis.divisor = 2;
        drive.axis.phase = u32::from(index);
        drive.axis.health.bucket = 1_000_000;
        drive.axis.limits.velocity = Some(20.0);
        drive.watchdog.timeout_ns = Some(2_000 * MS);
        drive
    };
    let port = format!("local:seccomp-wire-{}", std::process::id());
    let mut bus = ProfibusPlan::new(port, 1_500_000, vec![drive(0), drive(1)]);
    // The simulated drives are threads of this host.
    bus.bits.latency_ns = 20 * MS;
    live_on(&bus, || server(ProfibusSegment::of(&bus)), "C0061", "of a wire");
}

/// Nothing is said on a new connection.
#[derive(Debug)]
struct Silent;

impl Handshake for Silent {
    fn begin(&mut self, _now: Time, _out: &mut Vec<u8>) -> HandshakeState {
        HandshakeState::Done
    }

    fn take(&mut self, _now: Time, _bytes: &[u8], _out: &mut Vec<u8>) -> HandshakeState {
        HandshakeState::Done
    }
}

/// Gives back what it gets, and after so many times ends the connection, in order or by a reset in turn.
fn echo(listener: TcpListener, times: usize) {
    for round in 0.. {
        let (mut stream, _) = listener.accept().unwrap();
        stream.set_nodelay(true).unwrap();
        let mut bytes = [0; 64];
        for _ in 0..times {
            match stream.read(&mut bytes) {
                Ok(count @ 1..) if stream.write_all(&bytes[..count]).is_ok() => {}
                _ => break,
            }
        }
        if round % 2 == 0 {
            let at_once = libc::linger { l_onoff: 1, l_linger: 0 };
            setsockopt(&stream, sockopt::Linger, &at_once).unwrap();
        }
    }
}

/// What a loop came to on connections.
#[derive(Clone, Copy, Debug, Default)]
struct Talks {
    replies: u64,
    /// Connections that ended.
    ends: u64,
}

/// Talks on connections until it has had enough of everything: replies, and connections that ended.
fn talk(streams: &mut dyn Streams, enough: Talks) -> Talks {
    let (mut clock, mut set, mut talks) = (MonotonicClock, PollSet::with_room(1), Talks::default());
    confine();
    watch(true);
    while talks.replies < enough.replies || talks.ends < enough.ends {
        while let Some(index) = streams.opened() {
            let _ = streams.send(index, b"request");
        }
        let until = clock.now() + MS;
        set.fill([streams.fd()]);
        clock.wait(&mut set, until);
        streams.look();
        while let Some(index) = streams.ready() {
            let end = match streams.receive(index, &mut [0; 64]) {
                Ok(None) => None,
                Ok(Some(_)) => {
                    talks.replies += 1;
                    streams.send(index, b"request").err()
                }
                Err(broken) => Some(broken),
            };
            if end.is_some() {
                talks.ends += 1;
                streams.abandon(index, "it ended");
            }
        }
    }
    watch(false);
    talks
}

/// What the child does with connections: some that end all the time, and one that is refused.
fn live_on_connections() {
    let machine = Machine::new(4);
    for count in [1_u8, 4] {
        let address = |index| SocketAddrV4::new(machine.ip(count * 10 + index), 1502);
        for index in 0..count {
            let listener = TcpListener::bind(address(index)).unwrap();
            std::thread::spawn(move || echo(listener, 50));
        }
        let refused = (count > 1).then(|| address(9));
        let peer = |address| StreamPeer {
            least_pause_ns: MS,
            most_pause_ns: 5 * MS,
            ..StreamPeer::new(address, Box::new(Silent))
        };
        let peers = (0..count).map(address).chain(refused).map(peer).collect();
        let mut streams = Os::default().streams(peers).unwrap();
        let reported = Arc::new(OnceLock::new());
        let tell = Arc::clone(&reported);
        drop(std::thread::spawn(move || {
            let talks = talk(&mut *streams, Talks { replies: 10_000, ends: 100 });
            // No thread sleeps until it is notified, so that a notification takes no call.
            let _ = tell.set(talks);
            // The connections are closed with the process.
            std::mem::forget((streams, tell));
            // SAFETY: as in `Confined`.
            unsafe { libc::syscall(libc::SYS_exit, 0) };
        }));
        assert!(until(LONG, || reported.get().is_some()));
        let talks = reported.get();
        assert_eq!(counting::count(), 0, "{talks:?}");
        println!("{count} connections: {talks:?}");
    }
    println!("{LIVED}connections");
}

/// What a loop lives on besides LinUDP, each in a child of its own.
const LIVES: [(&str, fn()); 4] = [
    ("a line", live_on_a_line),
    ("packets", live_on_packets),
    ("a wire", live_on_a_wire),
    ("connections", live_on_connections),
];

#[test]
fn no_carrier_needs_another_system_call_than_those_listed_or_an_allocation() {
    if let Some(role) = role() {
        leave_no_core();
        return LIVES.iter().find(|(carrier, _)| *carrier == role).unwrap().1();
    }
    let name = "no_carrier_needs_another_system_call_than_those_listed_or_an_allocation";
    // Most of their time is waiting.
    std::thread::scope(|scope| {
        for (shelter, (carrier, _)) in (5..).zip(LIVES) {
            scope.spawn(move || innocent_child(name, carrier, shelter));
        }
    });
}

/// What the loop's thread must not do, each called often if it were let.
const CRIMES: [(&str, fn()); 4] = [
    ("a call that is not listed", || {
        // SAFETY: takes nothing and cannot fail.
        unsafe { libc::syscall(libc::SYS_getppid) };
    }),
    ("a receive that waits", || {
        // SAFETY: there is no descriptor -1, and nothing is written.
        unsafe { libc::recvmmsg(-1, std::ptr::null_mut(), 0, 0, std::ptr::null_mut()) };
    }),
    ("a look that waits", || {
        // SAFETY: there is no descriptor -1, and nothing is written.
        unsafe { libc::epoll_wait(-1, std::ptr::null_mut(), 1, 1) };
    }),
    ("a sleep that is not absolute", || {
        let nanosecond = libc::timespec { tv_sec: 0, tv_nsec: 1 };
        // SAFETY: a valid timespec, and the remainder is not requested.
        unsafe { libc::clock_nanosleep(libc::CLOCK_MONOTONIC, 0, &nanosecond, std::ptr::null_mut()) };
    }),
];

#[test]
fn any_other_system_call_of_the_loop_would_be_its_end() {
    if let Some(role) = role() {
        return live(plain, CRIMES.iter().find(|(name, _)| *name == role).map(|(_, crime)| *crime));
    }
    for (crime, _) in CRIMES {
        let name = "any_other_system_call_of_the_loop_would_be_its_end";
        let ended = child(name, crime, &Machine::new(3));
        assert_eq!((ended.signal, ended.code), (Some(libc::SIGSYS), None), "{crime}: {ended:?}");
        assert!(!ended.out.contains(LIVED), "{crime}: {ended:?}");
    }
}
