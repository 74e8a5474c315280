//! What a drive costs, 1 to 256 of them.
//!
//! - **The loop without a socket**: the real engine, bus and stations over a null carrier that answers from memory. A
//!   cycle is everything from the end of one sleep to the begin of the next: send, receive, health, exchange, prepare,
//!   records and feedback. Cycles follow each other without sleeping, and once more paced at 1 kHz with the core asleep
//!   in between, where caches are cold. The carrier's own time is measured alone, in turns with the loop, and taken
//!   off. A segment of Kollmorgen drives shares one frame: it is brought up once for each length, and answers from
//!   memory from then on. The clock jumps over what a PROFIBUS wire is waited for.
//! - **The loop with acyclic calls**: the same, with a parameter read back to back on each of 32 drives, in turns with
//!   the loop without them; and how many reads a second that comes to, there and on sockets at 1 kHz.
//! - **The loop on sockets** against a bare `sendto` / `recvfrom` loop over the same bytes, cycle by cycle in turns:
//!   time from waking up until done, and processor time.
//! - **LinMots and Unidrives together**: 32 LinMots in every cycle and 32 Unidrives in every eighth, as many in one as
//!   in the next, in one cycle at 1 kHz: nothing planned is left out, each exchange is closed; and the same against a
//!   bare loop.
//! - **All kinds together**: 32 LinMots and 8 Kollmorgens in every cycle, 32 MOONS' drives, 8 Unidrives and 4 Lenze
//!   drives in every fourth, in one cycle at 1 kHz.
//! - **MOONS' drives on sockets**: the send phase against a bare loop over the same bytes, and the age of feedback.
//! - **Segments on a socket of this host**: what one of 16 drives and one of 8 drives, couplers and terminals take at
//!   1 kHz, and one of drives against a bare loop over the same bytes.
//! - **A wire on a port of this host**: what 4 Lenze drives at 12 Mbit/s take at 1 kHz, and against a bare loop over
//!   the same bytes: the send phase, the time until done, processor time.
//! - **The whole process**: processor time a cycle of all threads of a master at 1 kHz, by thread, against the bare
//!   loop alone at 1 kHz, in turns.
//! - **System calls a cycle**, counted at full speed where the loop makes them: in its clock and its carrier. That
//!   these counters see every call is proved by running the loop once more under `strace`, whose count must be the
//!   same. Held to their budget are those that the loop makes whenever replies come.
//! - With `--count`, in place of all that: **instructions a drive and cycle** of the loop without a socket, and its
//!   system calls and allocations, each with its budget in `benches/budgets.csv`; and those a slave and cycle of a
//!   segment of 8 drives and 56 couplers and terminals, whose outputs change in each cycle. Counted once more: drives
//!   that stand, drives whose status changes in each exchange, the default mapping of a Unidrive, the threads of
//!   telemetry and of a recording; and the worst cycle of a hundred in which all drives are lost, have a fault, or get
//!   a command at once, alone and in stop groups of two.

#[allow(dead_code, reason = "each bench uses a part of it")]
mod support;

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddrV4;
use std::process::{Command, ExitCode, Stdio};
use std::sync::Arc;
use std::time::Duration;
use std::{fmt, io};

use fieldbeat::axis::{Acyclic, CallTicket};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::ControlWord;
use fieldbeat::bus::modbus::ControlWord as UnidriveControl;
use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::telemetry::recording::Recorder;
use fieldbeat::telemetry::{DriveEnd, Measured, Numbers};
use fieldbeat::time::{MS, Ns, S, US};
use fieldbeat::{Granted, Plan, Wait};
use fieldbeat_core::cycle::record::{DriveRecord, Record};
use fieldbeat_core::net::{
    Carriers, Datagrams, Frames, Os, Outbox, Serial, SerialLine, StreamPeer, Streams, UdpOptions,
};
use fieldbeat_core::rt::{MonotonicClock, Usage};
use fieldbeat_ethercat as ethercat;
use fieldbeat_ethercat::wire::frame::FRAME_MAX;
use fieldbeat_ethernet_ip as ethernet_ip;
use fieldbeat_ethernet_ip::wire::io::Outgoing;
use fieldbeat_linudp as linudp;
use fieldbeat_linudp::upid;
use fieldbeat_linudp::wire::{Request, ResponseDef, RtcCommand};
use fieldbeat_modbus as modbus;
use fieldbeat_profibus as profibus;
use fieldbeat_profibus::wire::telegram;
use serde_json::{Value, json};
use support::bare::{Duel, Outcome, Rival};
use support::budgets::{self, Budgets};
use support::count::{self, Ran, Scenario};
use support::counted::CountedNet;
use support::fleet::{self, Fleet, Side};
use support::lenze::{self, NullSerial, NullWires};
use support::null::{NullCarrier, NullNet, NullPackets, NullStreams};
use support::rig::{self, Calls, Count, Metered, Pace, Rig, Scene};
use support::segment::{self, NullSegment, NullSegments, Settled};
use support::stats::{Interval, Line, Sample, median, over_rounds};
use support::whole::Whole;
use support::{Args, Report, Steal, callgrind, in_turns, packets, shown, unidrive};

/// Drives of the segments on sockets: alone, and against the bare loop.
const SEGMENT_ALONE: usize = 16;
const SEGMENT_DUEL: usize = 4;

/// Both kinds in one cycle.
const TOGETHER: Fleet = Fleet { linmots: 32, unidrives: 32, every: 8, ..Fleet::NONE };

/// All kinds in one cycle: 32 LinMots and a segment of 8 Kollmorgens in every cycle, 32 MOONS' drives, 8 Unidrives and
/// a wire of 4 Lenze drives in every fourth.
const ALL_KINDS: Fleet =
    Fleet { linmots: 32, unidrives: 8, every: 4, segment: 8, terminals: 0, moons: 32, lenzes: 4 };

/// The drives of a machine among the couplers and terminals of one: 64 slaves, one frame.
const DRIVES_OF_64: usize = 8;
const TERMINALS_OF_64: usize = 56;

/// MOONS' drives on sockets against the bare loop.
const MOONS_DUEL: usize = 32;

/// This variable of the environment makes the program the child that strace looks at, with these drives.
const TRACED: &str = "FIELDBEAT_BENCH_TRACED_DRIVES";
/// Cycles that strace looks at.
const TRACED_CYCLES: u64 = 50;

fn main() -> ExitCode {
    if let Some(fleet) = std::env::var(TRACED).ok().and_then(|fleet| fleet.parse().ok()) {
        traced(fleet);
        return ExitCode::SUCCESS;
    }
    let scenarios = scenarios();
    if count::is_child(&scenarios, counted) {
        return ExitCode::SUCCESS;
    }
    let args = Args::parse("scale");
    if args.count {
        return count::gate("scale", &args, &scenarios);
    }
    let budgets = Budgets::read().unwrap_or_else(|why| rig::give_up(why));
    let granted = rig::introduce("scale: what a drive costs");
    let mut report = Report::default();
    let drives: &[usize] = if args.quick { &COMPARED } else { &[1, 2, 4, 8, 16, 32, 64, 128, 256] };
    let of = |fleet: fn(usize) -> Fleet| move |count, what, cycles| slice_of(fleet(count), what, cycles);
    let without = without_socket("LinMots", args.quick, drives, of(Fleet::linmots));
    let unidrives = without_socket("Unidrives", args.quick, drives, of(Fleet::unidrives));
    let moons = without_socket("MOONS' drives", args.quick, drives, of(Fleet::moons));
    let segments: &[usize] = if args.quick { &[1, 8, 64] } else { &[1, 2, 4, 8, 16, 32, 64] };
    let mut standing = StandingSegments::new(segments);
    let in_segments = without_socket("drives of one segment", args.quick, segments, |count, what, cycles| {
        standing.slice(count, what, cycles)
    });
    drop(standing);
    let on_wires = without_socket("Lenze drives", args.quick, drives, slice_of_wires);
    let reads = with_reads(&granted, args.quick, &mut report);
    let on_sockets = on_sockets(&granted, args.quick, drives, &budgets, &mut report);
    let together = together(&granted, args.quick, &budgets, &mut report);
    let all_kinds = all_kinds(&granted, args.quick, &budgets, &mut report);
    let packets = packets_on_sockets(&granted, args.quick, &budgets, &mut report);
    let segments_on_sockets = segments_on_sockets(&granted, args.quick, &budgets, &mut report);
    let wire_on_port = wire_on_port(&granted, args.quick, &budgets, &mut report);
    let whole = whole_process(&granted, args.quick);
    strace(&granted, args.quick, &mut report);
    for (((drives, without), unidrives), on) in drives.iter().zip(without).zip(unidrives).zip(on_sockets) {
        report.append(json!({
            "drives": drives,
            "loop_ns": without.back_to_back.value,
            "loop_ns_interval": without.back_to_back.ends(),
            "loop_paced_ns": without.paced.value,
            "loop_paced_ns_interval": without.paced.ends(),
            "carrier_ns": without.carrier,
            "unidrive_loop_ns": unidrives.back_to_back.value,
            "unidrive_loop_ns_interval": unidrives.back_to_back.ends(),
            "unidrive_loop_paced_ns": unidrives.paced.value,
            "unidrive_loop_paced_ns_interval": unidrives.paced.ends(),
            "unidrive_carrier_ns": unidrives.carrier,
            "sockets_ns": on.ours,
            "bare_ns": on.bare,
            "sockets_ratio": on.ratio.map(|ratio| ratio.value),
            "sockets_ratio_interval": on.ratio.map(|ratio| ratio.ends()),
            "sockets_cpu_ns": on.ours_cpu,
            "bare_cpu_ns": on.bare_cpu,
            "sockets_cpu_ratio": on.cpu_ratio.map(|ratio| ratio.value),
            "syscalls_per_cycle": on.calls,
            "steal_ms": on.steal_ms,
        }));
    }
    let of_kind = |key: &str, drives: &usize, without: Without| {
        json!({
            key: drives,
            "loop_ns": without.back_to_back.value,
            "loop_ns_interval": without.back_to_back.ends(),
            "loop_paced_ns": without.paced.value,
            "loop_paced_ns_interval": without.paced.ends(),
            "carrier_ns": without.carrier,
        })
    };
    for (drives, without) in segments.iter().zip(in_segments) {
        report.append(of_kind("segment_drives", drives, without));
    }
    report.append(reads);
    for (key, costs) in [("moons_drives", moons), ("lenze_drives", on_wires)] {
        for (drives, without) in drives.iter().zip(costs) {
            report.append(of_kind(key, drives, without));
        }
    }
    report.append(together);
    report.append(all_kinds);
    report.append(packets);
    segments_on_sockets.into_iter().for_each(|segment| report.append(segment));
    wire_on_port.into_iter().for_each(|wire| report.append(wire));
    whole.into_iter().for_each(|whole| report.append(whole));
    report.finish(&args)
}

/// Numbers of drives that have budgets; the others are measured only.
const COMPARED: [usize; 4] = [1, 8, 64, 256];
/// Cycles that are counted: each drive publishes its numbers in one of 64 of them.
const COUNTED_CYCLES: u64 = 128;
/// Drives that fit into the frame of one segment.
const SEGMENT_MOST: usize = 64;

/// What is counted in place of being measured. At 64 drives the first-level misses are of interest, at 256 the
/// second-level ones.
fn scenarios() -> Vec<Scenario> {
    let of =
        |protocol| COMPARED.map(|drives| Scenario { caches: drives >= 64, ..Scenario::of(protocol, drives) });
    let with_terminals = Scenario {
        terminals: TERMINALS_OF_64,
        caches: true,
        ..Scenario::of(ethercat::PROTOCOL, DRIVES_OF_64)
    };
    [linudp::PROTOCOL, modbus::PROTOCOL, ethercat::PROTOCOL, ethernet_ip::PROTOCOL, profibus::PROTOCOL]
        .into_iter()
        .flat_map(of)
        .chain([Scenario::of(profibus::PROTOCOL, lenze::SEGMENT), with_terminals])
        .chain(STEADY.into_iter().flat_map(|part| again(part, false)))
        // A Unidrive in memory turns as soon as it may.
        .filter(|scenario| (scenario.protocol, scenario.part) != (modbus::PROTOCOL, Some(IDLE)))
        .chain(WORST.into_iter().flat_map(|part| again(part, true)))
        .chain([Scenario { part: Some(DEFAULT), ..Scenario::of(modbus::PROTOCOL, 64) }])
        .collect()
}

fn again(part: &'static str, worst: bool) -> [Scenario; 5] {
    AGAIN.map(|(protocol, drives)| Scenario { part: Some(part), worst, ..Scenario::of(protocol, drives) })
}

/// What is counted once more: with all inputs of the loop in a log; with the native process data of all drives
/// among its records; with drives that stand; with drives whose status changes in each exchange; and, of the same
/// cycles, what the telemetry's thread and that of a recording make of their records.
const WITH_LOG: &str = "recorded";
const WITH_NATIVE: &str = "native";
const IDLE: &str = "idle";
const UNSTEADY: &str = "unsteady";
const TELEMETRY: &str = "telemetry";
const RECORDING: &str = "recording";
const STEADY: [&str; 6] = [WITH_LOG, WITH_NATIVE, IDLE, UNSTEADY, TELEMETRY, RECORDING];
/// The worst cycle: all drives are lost at once, all have a fault at once, each has a command, and the first two
/// in stop groups of two.
const LOST: &str = "lost";
const FAULTS: &str = "faults";
const COMMANDS: &str = "commands";
const LOST_IN_PAIRS: &str = "lost in pairs";
const FAULTS_IN_PAIRS: &str = "faults in pairs";
const WORST: [&str; 5] = [LOST, FAULTS, COMMANDS, LOST_IN_PAIRS, FAULTS_IN_PAIRS];
/// Cycles in which all of that has happened.
const WORST_CYCLES: u64 = 100;
/// The mapping that a Unidrive has unless its plan says otherwise.
const DEFAULT: &str = "default mapping";
const AGAIN: [(&str, usize); 5] = [
    (linudp::PROTOCOL, 64),
    (modbus::PROTOCOL, 64),
    (ethercat::PROTOCOL, 64),
    (ethernet_ip::PROTOCOL, 64),
    (profibus::PROTOCOL, lenze::SEGMENT),
];

/// The child: the loop over drives in memory, all in operation.
fn counted(scenario: Scenario) -> Ran {
    let Scenario { protocol, part, drives, terminals, worst, .. } = scenario;
    rig::be_virtual();
    if worst {
        rig::be_strict();
    }
    if part.is_some_and(|part| part.ends_with("in pairs")) {
        rig::be_in_pairs();
    }
    if part == Some(DEFAULT) {
        unidrive::be_direct();
    }
    let segment = |first| segment_of(first, (drives - first).min(SEGMENT_MOST), terminals);
    let segments = if protocol == ethercat::PROTOCOL { drives } else { 0 };
    let wires = if protocol == profibus::PROTOCOL { drives } else { 0 };
    let memory = InMemory(
        (0..segments).step_by(SEGMENT_MOST).map(segment).collect(),
        NullWires(lenze::wires("local:count", wires), rig::now),
    );
    let buses = || match protocol {
        linudp::PROTOCOL => Fleet::linmots(drives).buses(Side::Ours),
        modbus::PROTOCOL => Fleet::unidrives(drives).buses(Side::Ours),
        ethernet_ip::PROTOCOL => Fleet::moons(drives).buses(Side::Ours),
        profibus::PROTOCOL => {
            memory.1.0.iter().map(|wire| Box::new(wire.clone()) as Box<dyn BusPlan>).collect()
        }
        _ => memory.0.iter().map(|segment| Box::new(segment.0.clone()) as Box<dyn BusPlan>).collect(),
    };
    let calls = Calls::default();
    let mut cycle = rig::exchange_cycle(MS, Wait::Poll);
    let carriers = CountedNet::over(&memory, &calls);
    if part == Some(WITH_NATIVE) {
        cycle.record_native.push("all".to_owned());
    }
    if part == Some(WITH_LOG) {
        let rig = Rig::logged(cycle, buses(), Pace::BackToBack, &carriers, Arc::clone(&calls));
        return counted_of(rig, part, &memory, &calls);
    }
    let plan = Plan { source: None, cycle: cycle.clone(), buses: buses(), groups: Vec::new() };
    let rig = Rig::new(cycle, buses(), Pace::BackToBack, &carriers, Arc::clone(&calls));
    match part {
        Some(TELEMETRY | RECORDING) => records_of(rig, part, &memory, &plan),
        _ if worst => worst_of(rig, part, &memory),
        _ => counted_of(rig, part, &memory, &calls),
    }
}

/// Until all drives are in operation, and move.
fn bring_up<C: Metered>(rig: &mut Rig<C>, part: Option<&str>, memory: &InMemory) {
    if part == Some(IDLE) {
        rig::set_scene(Scene::Standing);
    }
    rig.enable();
    while !memory.0.iter().all(|segment| segment.2.get().is_some()) {
        rig.turn(|_| {});
    }
    if part != Some(IDLE) {
        rig.jog();
    }
    if part == Some(UNSTEADY) {
        rig::set_scene(Scene::Unsteady);
    }
    count::instrument();
}

/// Each of the cycles from what happens on.
fn worst_of<C: Metered>(mut rig: Rig<C>, part: Option<&str>, memory: &InMemory) -> Ran {
    bring_up(&mut rig, part, memory);
    match part {
        Some(LOST | LOST_IN_PAIRS) => rig::set_scene(Scene::Silent),
        Some(FAULTS | FAULTS_IN_PAIRS) => rig::set_scene(Scene::Faulted),
        _ => rig.command(2.0),
    }
    let mut turn = || {
        rig.counted_turn();
        count::part();
    };
    let ran = count::run(WORST_CYCLES, &mut turn);
    assert_eq!(rig.stopped().is_some(), part != Some(COMMANDS), "what was to happen has happened");
    Ran { cycles: 1, ..ran }
}

/// What a thread behind the loop makes of the records of the counted cycles.
fn records_of<C: Metered>(mut rig: Rig<C>, part: Option<&str>, memory: &InMemory, plan: &Plan) -> Ran {
    bring_up(&mut rig, part, memory);
    let units: Vec<_> = plan.buses.iter().flat_map(|bus| bus.axes()).map(|axis| axis.units).collect();
    let mut measured = Measured::new(&units, &plan.cycle, false);
    let directory = tempfile::tempdir().unwrap_or_else(|error| rig::give_up(error));
    let recorder = Recorder::create(directory.path().join("counted.mcap"));
    let mut sink = recorder.unwrap_or_else(|error| rig::give_up(error)).sink(plan, None);
    sink.begin(0);
    let mut enter = |records: &[Record]| match part {
        Some(TELEMETRY) => records.iter().for_each(|record| measured.enter(record)),
        _ => {
            records.iter().for_each(|record| sink.enter(record));
            sink.look(0);
        }
    };
    let mut records = Vec::new();
    for cycle in 0..2 * COUNTED_CYCLES {
        records.clear();
        rig.turn(|record| records.push(record));
        match cycle < COUNTED_CYCLES {
            true => enter(&records),
            false => callgrind::counted(|| enter(&records)),
        }
    }
    Ran { cycles: COUNTED_CYCLES, allocations: 0, calls: None }
}

/// The loop of `rig`.
fn counted_of<C: Metered>(mut rig: Rig<C>, part: Option<&str>, memory: &InMemory, calls: &Calls) -> Ran {
    bring_up(&mut rig, part, memory);
    // The simulated caches are warmed up.
    for _ in 0..COUNTED_CYCLES {
        rig.turn(|_| {});
    }
    let (before, executed) = (calls.now(), rig.status().executed);
    let ran = count::run(COUNTED_CYCLES, || rig.counted_turn());
    assert_eq!(rig.status().executed, executed + COUNTED_CYCLES, "no slot is passed over in virtual time");
    assert_eq!(rig.stopped(), None, "all of them do as commanded");
    Ran { calls: Some(calls.now().since(before).made), ..ran }
}

/// So many drives, from `first` on, and terminals on a segment of their own.
fn segment_of(first: usize, drives: usize, terminals: usize) -> NullSegments {
    let name = format!("local:count-{first}");
    let mut plan = segment::plan(&name, drives, terminals);
    plan.name = name;
    for (place, drive) in plan.drives.iter_mut().enumerate() {
        drive.axis.name = format!("k{}", first + place);
    }
    NullSegments(plan, rig::now, Settled::default())
}

/// Every drive in memory, segments by their interfaces, and wires by their ports.
struct InMemory(Vec<NullSegments>, NullWires);

impl Carriers for &InMemory {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        NullNet.datagrams(bind, options)
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        NullNet.streams(peers)
    }

    fn frames(&self, interface: &str, ethertype: u16) -> io::Result<Box<dyn Frames>> {
        let segment = self.0.iter().find(|segment| segment.0.interface == interface);
        segment.ok_or(io::ErrorKind::NotFound)?.frames(interface, ethertype)
    }

    fn serial(&self, port: &str, line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        self.1.serial(port, line)
    }
}

/// Of the loop without a socket, ns a drive and cycle.
struct Without {
    back_to_back: Interval,
    paced: Interval,
    carrier: f64,
}

/// One slice of `cycles` back to back, or fewer paced, or of the carrier alone: each cycle, ns.
fn slice_of(fleet: Fleet, what: usize, cycles: usize) -> Vec<f64> {
    let slice = rig::on_loop_thread(|_| match what {
        0 => turns(fleet, Pace::BackToBack, cycles),
        1 => turns(fleet, Pace::Grid, PACED),
        _ => carrier_alone(fleet, cycles),
    });
    slice.unwrap_or_else(|error| rig::give_up(error))
}

/// The same of Lenze drives on wires. The loop waits by poll: spinning would be counted as its time.
fn slice_of_wires(count: usize, what: usize, cycles: usize) -> Vec<f64> {
    let wires = NullWires(lenze::wires("local:slice", count), rig::now);
    let run = |pace, cycles| {
        let buses = wires.0.iter().map(|wire| Box::new(wire.clone()) as Box<dyn BusPlan>);
        let cycle = rig::exchange_cycle(MS, Wait::Poll);
        let mut rig = Rig::new(cycle, buses.collect(), Pace::BackToBack, &wires, Calls::default());
        rig.enable();
        rig.set_pace(pace);
        (0..cycles).map(|_| rig.turn(|_| {}).busy_ns as f64).collect()
    };
    let slice = rig::on_loop_thread(|_| match what {
        0 => run(Pace::BackToBack, cycles),
        1 => run(Pace::Grid, PACED),
        _ => wires_alone(&wires.0, cycles),
    });
    slice.unwrap_or_else(|error| rig::give_up(error))
}

/// What the wires in memory take by themselves, ns a cycle: what is on each before it is used, an exchange of each
/// drive, and a token.
fn wires_alone(plans: &[ProfibusPlan], cycles: usize) -> Vec<f64> {
    let wire = |plan: &ProfibusPlan| (NullSerial::new(plan, rig::now), lenze::requests(plan));
    let mut wires: Vec<_> = plans.iter().map(wire).collect();
    let token = telegram::token(2, 2);
    let mut room = [0; 64];
    let mut cycle = || {
        let begin = MonotonicClock::read();
        for (wire, requests) in &mut wires {
            let _ = std::hint::black_box(wire.receive(0, &mut room));
            for request in requests {
                let _ = std::hint::black_box(wire.send(0, std::hint::black_box(request)));
                let _ = std::hint::black_box(wire.receive(0, &mut room));
            }
            let _ = std::hint::black_box(wire.send(0, &token));
        }
        MonotonicClock::read().since(begin) as f64
    };
    (0..cycles).map(|_| cycle()).collect()
}

/// Cycles of a slice at 1 kHz.
const PACED: usize = 100;

/// A segment of each length in memory, in operation.
struct StandingSegments(Vec<(usize, Rig, Settled)>);

impl StandingSegments {
    fn new(lengths: &[usize]) -> StandingSegments {
        let segment = |count: usize| {
            let settled = Settled::default();
            let plan = Fleet::segment(count).ethercat(Side::Ours);
            let carriers = NullSegments(plan.clone(), rig::now, Settled::clone(&settled));
            let up = rig::on_loop_thread(|_| {
                let cycle = rig::exchange_cycle(MS, Wait::Spin);
                let buses: Vec<Box<dyn BusPlan>> = vec![Box::new(plan)];
                let mut rig = Rig::new(cycle, buses, Pace::BackToBack, &carriers, Calls::default());
                rig::leap(S);
                rig.enable();
                while settled.get().is_none() {
                    rig.turn(|_| {});
                }
                rig
            });
            (count, up.unwrap_or_else(|error| rig::give_up(error)), settled)
        };
        StandingSegments(lengths.iter().copied().map(segment).collect())
    }

    fn slice(&mut self, count: usize, what: usize, cycles: usize) -> Vec<f64> {
        let segment = self.0.iter_mut().find(|(length, ..)| *length == count);
        let (_, rig, settled) = segment.expect("it stands");
        let slice = rig::on_loop_thread(|_| {
            if what > 1 {
                return segment_alone(settled, cycles);
            }
            // To its time again, which the other ones have left.
            rig.set_pace(Pace::BackToBack);
            rig.turn(|_| {});
            let (pace, cycles) = if what == 0 { (Pace::BackToBack, cycles) } else { (Pace::Grid, PACED) };
            rig.set_pace(pace);
            (0..cycles).map(|_| rig.turn(|_| {}).busy_ns as f64).collect()
        });
        slice.unwrap_or_else(|error| rig::give_up(error))
    }
}

/// What the segment in memory takes by itself, ns a cycle.
fn segment_alone(settled: &Settled, cycles: usize) -> Vec<f64> {
    let mut segment = NullSegment::settled(settled, rig::now);
    let mut room = [0; FRAME_MAX];
    let frame = settled.get().map_or(&[][..], |(frame, _)| frame);
    let mut cycle = || {
        let begin = MonotonicClock::read();
        let _ = std::hint::black_box(segment.send(std::hint::black_box(frame)));
        let _ = std::hint::black_box(segment.receive(&mut room));
        MonotonicClock::read().since(begin) as f64
    };
    (0..cycles).map(|_| cycle()).collect()
}

fn without_socket(
    kind: &str,
    quick: bool,
    drives: &[usize],
    mut slice: impl FnMut(usize, usize, usize) -> Vec<f64>,
) -> Vec<Without> {
    let rounds = if quick { 5 } else { 21 };
    let steal = Steal::begin();
    // Medians of a cycle, ns: by number of drives, then by round.
    let mut medians: Vec<[Vec<f64>; 3]> = drives.iter().map(|_| Default::default()).collect();
    in_turns(rounds, 3 * drives.len(), |who| {
        let (place, what) = (who / 3, who % 3);
        let count = drives[place];
        // About a millisecond or two of work; at 1 kHz a tenth of a second.
        let cycles = (10_000 / count).clamp(200, 2_000);
        medians[place][what].push(median(&slice(count, what, cycles)));
    });

    println!(
        "\nthe loop without a socket, {kind}, ns a drive and cycle; {rounds} rounds, steal {} ms",
        shown(steal.ms())
    );
    println!("  drives           back to back            paced 1 kHz   the null carrier, taken off both");
    let mut table = Vec::new();
    for (count, [loops, paced, carrier]) in drives.iter().zip(&medians) {
        let each = *count as f64;
        let without_carrier = |all: &[f64]| {
            over_rounds(rounds, |rounds| {
                let chosen =
                    |all: &[f64]| median(&rounds.iter().map(|round| all[*round]).collect::<Vec<_>>());
                (chosen(all) - chosen(carrier)) / each
            })
        };
        let row = Without {
            back_to_back: without_carrier(loops),
            paced: without_carrier(paced),
            carrier: median(carrier) / each,
        };
        println!(
            "  {count:6} {:>22} {:>22} {:12.1}",
            row.back_to_back.to_string(),
            row.paced.to_string(),
            row.carrier
        );
        table.push(row);
    }

    for (what, name) in [(0, "back to back"), (1, "paced")] {
        let line = |rounds: &[usize]| {
            let points: Vec<_> = (drives.iter().zip(&medians))
                .map(|(count, by_what)| {
                    let chosen =
                        |what: usize| median(&rounds.iter().map(|r| by_what[what][*r]).collect::<Vec<_>>());
                    (*count as f64, chosen(what) - chosen(2))
                })
                .collect();
            (Line::through(&points), points)
        };
        let slope = over_rounds(rounds, |rounds| line(rounds).0.slope);
        let (fit, points) = line(&(0..rounds).collect::<Vec<_>>());
        // Round by round: a computer that is slower for a while is slower for all points of a round.
        let bend_of = |round: usize| {
            let (fit, points) = line(&[round]);
            points.iter().map(|(x, y)| (y / fit.at(*x) - 1.0).abs()).fold(0.0, f64::max)
        };
        let bend = over_rounds(rounds, |rounds| {
            median(&rounds.iter().map(|round| bend_of(*round)).collect::<Vec<_>>())
        });
        println!(
            "  {name}: {slope} ns a drive + {:.0} ns a cycle; farthest point {bend} off the line, R2 {:.4}",
            fit.intercept,
            fit.r_squared(&points)
        );
    }
    table
}

/// So many drives read a parameter back to back.
const READING: usize = 32;
/// Reads that are under way on each of them.
const UNDER_WAY: usize = 4;

/// Keeps every drive at reading, from outside of the loop and of what is measured.
struct Readers {
    under_way: Vec<VecDeque<CallTicket>>,
    done: u64,
}

impl Readers {
    fn new(drives: usize) -> Readers {
        Readers { under_way: (0..drives).map(|_| VecDeque::new()).collect(), done: 0 }
    }

    fn feed(&mut self, acyclics: &[Acyclic]) {
        let call = upid::call(RtcCommand::READ_RAM, 0x1E0F, 0);
        for (acyclic, under_way) in acyclics.iter().zip(&mut self.under_way) {
            while let Some(end) = under_way.front_mut().and_then(CallTicket::poll) {
                self.done += u64::from(end.is_ok());
                under_way.pop_front();
            }
            while under_way.len() < UNDER_WAY {
                match acyclic.post(call, Duration::from_secs(1)) {
                    Ok(ticket) => under_way.push_back(ticket),
                    Err(error) => rig::give_up(error),
                }
            }
        }
    }
}

/// What a parameter read back to back on each drive costs the loop, and how many come of it.
fn with_reads(granted: &Granted, quick: bool, report: &mut Report) -> serde_json::Value {
    let (rounds, cycles) = if quick { (7, 400) } else { (21, 1_000) };
    let steal = Steal::begin();
    let mut medians: [Vec<f64>; 3] = Default::default();
    let (mut reads, mut executed) = (0, 0);
    in_turns(rounds, 3, |what| {
        let slice = rig::on_loop_thread(|_| match what {
            0 => (turns(Fleet::linmots(READING), Pace::BackToBack, cycles), 0, 0),
            1 => reading_turns(READING, cycles),
            _ => (carrier_alone(Fleet::linmots(READING), cycles), 0, 0),
        });
        let (slice, done, in_cycles) = slice.unwrap_or_else(|error| rig::give_up(error));
        (reads, executed) = (reads + done, executed + in_cycles);
        medians[what].push(median(&slice));
    });
    let [idle, reading, carrier] = &medians;
    let of =
        |rounds: &[usize], all: &[f64]| median(&rounds.iter().map(|round| all[*round]).collect::<Vec<_>>());
    let each =
        |all: &[f64]| over_rounds(rounds, |rounds| (of(rounds, all) - of(rounds, carrier)) / READING as f64);
    let (idle, reading) = (each(idle), each(reading));
    let a_cycle = reads as f64 / (executed * READING as u64) as f64;
    let on_sockets = reads_on_sockets(granted, if quick { 300 } else { 3_000 });
    println!(
        "\n{READING} drives, each reading a parameter back to back, ns a drive and cycle without a socket; \
         steal {} ms",
        shown(steal.ms())
    );
    println!("  without reads {idle}, with them {reading}; {a_cycle:.3} reads a cycle and drive");
    println!("  on sockets at 1 kHz: {} reads a second and drive", shown(on_sockets.map(f64::round)));
    report.check(format!("a read a cycle and drive: {a_cycle:.3} >= 0.95"), a_cycle >= 0.95);
    json!({
        "reading_drives": READING,
        "loop_ns": idle.value,
        "loop_reading_ns": reading.value,
        "loop_reading_ns_interval": reading.ends(),
        "reads_a_cycle": a_cycle,
        "reads_a_second_on_sockets": on_sockets,
        "steal_ms": steal.ms(),
    })
}

/// Busy time of each cycle, ns, with reads; how many were done, in how many cycles that were executed.
fn reading_turns(drives: usize, cycles: usize) -> (Vec<f64>, u64, u64) {
    let cycle = rig::exchange_cycle(MS, Wait::Spin);
    let buses = Fleet::linmots(drives).buses(Side::Ours);
    let mut rig = Rig::new(cycle, buses, Pace::BackToBack, &NullNet, Calls::default());
    rig.enable();
    let mut readers = Readers::new(drives);
    // The channel is learned first.
    for _ in 0..8 {
        readers.feed(rig.acyclics());
        rig.turn(|_| {});
    }
    readers.done = 0;
    let executed = rig.status().executed;
    let mut one = |_| {
        readers.feed(rig.acyclics());
        rig.turn(|_| {}).busy_ns as f64
    };
    let slice = (0..cycles).map(&mut one).collect();
    (slice, readers.done, rig.status().executed - executed)
}

/// Reads a second and drive, on sockets at 1 kHz, with the simulated drives on the other core.
fn reads_on_sockets(granted: &Granted, cycles: usize) -> Option<f64> {
    let fleet = Fleet::linmots(READING);
    let _server = rig::serve(fleet.simulate(Side::Ours), granted);
    let done = rig::on_loop_thread(|_| {
        let cycle = rig::exchange_cycle(MS, Wait::Poll);
        let buses = fleet.buses(Side::Ours);
        let mut rig = Rig::new(cycle, buses, Pace::Grid, &Os::default(), Calls::default());
        rig.enable();
        let mut readers = Readers::new(READING);
        for _ in 0..cycles {
            readers.feed(rig.acyclics());
            rig.turn(|_| {});
        }
        readers.done
    });
    let done = done.ok()?;
    Some(done as f64 / READING as f64 / (cycles as f64 / 1_000.0))
}

/// Busy time of each cycle, ns.
fn turns(fleet: Fleet, pace: Pace, cycles: usize) -> Vec<f64> {
    let cycle = rig::exchange_cycle(MS, Wait::Spin);
    let mut rig = Rig::new(cycle, fleet.buses(Side::Ours), pace, &NullNet, Calls::default());
    rig.enable();
    (0..cycles).map(|_| rig.turn(|_| {}).busy_ns as f64).collect()
}

/// What the null carrier takes for a cycle by itself, ns.
fn carrier_alone(fleet: Fleet, cycles: usize) -> Vec<f64> {
    match fleet {
        Fleet { moons: 1.., .. } => packets_alone(fleet.moons, cycles),
        Fleet { unidrives: 1.., .. } => streams_alone(fleet.unidrives, cycles),
        _ => datagrams_alone(fleet.linmots, cycles),
    }
}

fn packets_alone(drives: usize, cycles: usize) -> Vec<f64> {
    let at = |index| SocketAddrV4::new(*fleet::address(Side::Ours, index).ip(), ethernet_ip::IO_PORT);
    let peers: Vec<_> = (0..drives).map(at).collect();
    let (carrier, packet) = (NullPackets::of(&peers), Outgoing::owner(1));
    let mut outbox = Outbox::new(&peers, packet.bytes().len());
    for index in 0..drives {
        outbox.room(index).copy_from_slice(packet.bytes());
        outbox.set_length(index, packet.bytes().len());
    }
    exchanges_alone(carrier, outbox, cycles)
}

fn streams_alone(drives: usize, cycles: usize) -> Vec<f64> {
    let mut carrier = NullStreams::new(drives);
    let drive = unidrive::drive(*fleet::address(Side::Ours, 0).ip());
    let (request, length) = unidrive::request(&drive, UnidriveControl::FORWARD);
    // Each drive has its own, as in the loop.
    let requests = vec![request; drives];
    let mut rooms = vec![[0; 2 * unidrive::ADU_MAX]; drives];
    let mut cycle = || {
        let begin = MonotonicClock::read();
        while carrier.opened().is_some() {}
        carrier.look();
        for (index, request) in requests.iter().enumerate() {
            let _ = std::hint::black_box(carrier.send(index, &request[..length]));
        }
        carrier.look();
        while let Some(index) = carrier.ready() {
            let _ = std::hint::black_box(carrier.receive(index, &mut rooms[index]));
        }
        MonotonicClock::read().since(begin) as f64
    };
    (0..cycles).map(|_| cycle()).collect()
}

fn datagrams_alone(drives: usize, cycles: usize) -> Vec<f64> {
    let carrier = NullCarrier::new(drives);
    let peers: Vec<_> = (0..drives).map(|index| fleet::address(Side::Ours, index)).collect();
    let request =
        Request { response_def: ResponseDef::CYCLIC, control: Some(ControlWord::ON), ..Request::default() };
    let mut outbox = Outbox::new(&peers, request.size());
    for index in 0..drives {
        let length = request.emit(outbox.room(index));
        outbox.set_length(index, length);
    }
    exchanges_alone(carrier, outbox, cycles)
}

/// Sends all of the outbox, and takes in what comes.
fn exchanges_alone(mut carrier: impl Datagrams, mut outbox: Outbox, cycles: usize) -> Vec<f64> {
    let drives = outbox.len();
    let mut cycle = || {
        (0..drives).for_each(|index| outbox.post(index, true));
        let begin = MonotonicClock::read();
        carrier.send(&mut outbox);
        while let Ok(count) = carrier.receive(&mut |datagram| {
            std::hint::black_box(datagram);
        }) && count == carrier.batch()
        {}
        MonotonicClock::read().since(begin) as f64
    };
    (0..cycles).map(|_| cycle()).collect()
}

/// Of the loop on sockets; times are ns a drive and cycle.
struct OnSockets {
    ours: Option<f64>,
    bare: Option<f64>,
    ratio: Option<Interval>,
    ours_cpu: Option<f64>,
    bare_cpu: Option<f64>,
    cpu_ratio: Option<Interval>,
    calls: Option<f64>,
    steal_ms: Option<u64>,
}

fn on_sockets(
    granted: &Granted,
    quick: bool,
    drives: &[usize],
    budgets: &Budgets,
    report: &mut Report,
) -> Vec<OnSockets> {
    let (rounds, cycles) = if quick { (3, 40) } else { (15, 100) };
    println!("\nthe loop on sockets against the bare loop, ns a drive and cycle, medians of {rounds} rounds");
    println!(
        "  drives   period   ours done  last bare reply   ratio                 \
         ours CPU   bare CPU   ratio                 calls a cycle"
    );
    let mut table = Vec::new();
    for &count in drives {
        let steal = Steal::begin();
        let [mut ours, mut bare, mut ours_cpu, mut bare_cpu] = [const { Sample::new() }; 4];
        let mut calls = CallsOnSockets::default();
        for _ in 0..rounds {
            let Some(duel) = duel(granted, Fleet::linmots(count), period(count), cycles) else { continue };
            ours.push(duel.ours.busy);
            bare.push(duel.theirs.busy);
            ours_cpu.push(duel.ours.cpu);
            bare_cpu.push(duel.theirs.cpu);
            calls.push(duel.ours.calls);
        }
        let each = |sample: &Sample| sample.quantile(0.5).map(|p50| p50.value / count as f64);
        let row = OnSockets {
            ours: each(&ours),
            bare: each(&bare),
            ratio: ours.ratio(&bare, 0.5),
            ours_cpu: each(&ours_cpu),
            bare_cpu: each(&bare_cpu),
            cpu_ratio: ours_cpu.ratio(&bare_cpu, 0.5),
            calls: calls.p50(),
            steal_ms: steal.ms(),
        };
        let whole = |value: Option<f64>| shown(value.map(|value| value.round()));
        println!(
            "  {count:6} {:>8} {:>11} {:>16}   {:20} {:>9} {:>10}   {:20} {:>8}; steal {} ms",
            Ns(period(count)).to_string(),
            whole(row.ours),
            whole(row.bare),
            shown(row.ratio),
            whole(row.ours_cpu),
            whole(row.bare_cpu),
            shown(row.cpu_ratio),
            shown(row.calls),
            shown(row.steal_ms)
        );
        if COMPARED.contains(&count) {
            calls.check(&format!("{count} {}", linudp::PROTOCOL), budgets, report);
        }
        table.push(row);
    }
    table
}

/// System calls on sockets, cycle by cycle.
#[derive(Default)]
struct CallsOnSockets {
    made: Sample,
    own: Sample,
    all: Count,
}

impl CallsOnSockets {
    /// Adds those of more cycles.
    fn push(&mut self, calls: Vec<Count>) {
        self.made.push(calls.iter().map(|calls| calls.made).collect());
        self.own.push(calls.iter().map(Count::own).collect());
        calls.into_iter().for_each(|calls| self.all += calls);
    }

    /// All calls of the median cycle.
    fn p50(&self) -> Option<f64> {
        self.made.quantile(0.5).map(|p50| p50.value)
    }

    /// Holds to their budget those that are made whenever replies come. A reply that is missing at the deadline costs
    /// one more, so the quietest tenth of the cycles is compared. And no wait ends without a reason.
    fn check(&self, drives: &str, budgets: &Budgets, report: &mut Report) {
        within(report, budgets, drives, budgets::OWN_CALLS, &self.own);
        let Count { ready, taken, .. } = self.all;
        report.check(
            format!("{drives}: ended waits {ready} <= {taken} that took something in"),
            ready <= taken,
        );
    }
}

/// What the quietest tenth of the cycles makes, and its budget.
fn within(report: &mut Report, budgets: &Budgets, drives: &str, what: &str, calls: &Sample) {
    let row = format!("scale/sockets/{drives}/{what}");
    match calls.quantile(0.1) {
        Some(calls) => report.within(budgets, &row, calls.value),
        None => report.not_compared(row, "this host let too few cycles be answered"),
    }
}

/// Our loop and the bare one over `fleet`, waiting by poll. The host may not let the bare one measure.
fn duel(granted: &Granted, fleet: Fleet, period_ns: u64, cycles: usize) -> Option<Outcome> {
    let calls = &Calls::default();
    let carriers = &CountedNet::new(calls);
    let duel =
        Duel { granted, fleet, wait: Wait::Poll, period_ns, cycles, carriers, calls, rival: Rival::Bare };
    let outcome = duel.fight();
    outcome.inspect_err(|why| println!("a slice without the bare loop: {why}")).ok()
}

/// Ours against the bare loop: ratios of the medians.
struct Against {
    /// From the end of the sleep until done.
    busy: Option<Interval>,
    /// Processor time of a cycle.
    cpu: Option<Interval>,
    /// The send phase, on a wire.
    sending: Option<Interval>,
    period_ns: u64,
    steal_ms: Option<u64>,
}

impl Against {
    fn bare(granted: &Granted, fleet: Fleet, period_ns: u64, rounds: usize, cycles: usize) -> Against {
        let steal = Steal::begin();
        let [mut ours, mut bare] = [const { [const { Sample::new() }; 3] }; 2];
        for _ in 0..rounds {
            let Some(Outcome { ours: of_ours, theirs, .. }) = duel(granted, fleet, period_ns, cycles) else {
                continue;
            };
            for (samples, measured) in [(&mut ours, of_ours), (&mut bare, theirs)] {
                let [busy, cpu, sending] = samples;
                busy.push(measured.busy);
                cpu.push(measured.cpu);
                sending.push(measured.sending);
            }
        }
        let [busy, cpu, sending] = std::array::from_fn(|what| ours[what].ratio(&bare[what], 0.5));
        Against { busy, cpu, sending, period_ns, steal_ms: steal.ms() }
    }

    /// Prints it; its numbers.
    fn report(&self, what: &str, drives: usize) -> Value {
        let Against { busy, cpu, sending, period_ns, steal_ms } = self;
        print!("  {drives} drives against the bare loop, every {} each: ours / bare ", Ns(*period_ns));
        println!(
            "{}, CPU {}, send phase {}; steal {} ms",
            shown(*busy),
            shown(*cpu),
            shown(*sending),
            shown(*steal_ms)
        );
        json!({
            "duel": what,
            "duel_drives": drives,
            "sockets_ratio": busy.map(|ratio| ratio.value),
            "sockets_ratio_interval": busy.map(|ratio| ratio.ends()),
            "sockets_cpu_ratio": cpu.map(|ratio| ratio.value),
            "sockets_cpu_ratio_interval": cpu.map(|ratio| ratio.ends()),
            "send_ratio": sending.map(|ratio| ratio.value),
            "send_ratio_interval": sending.map(|ratio| ratio.ends()),
            "steal_ms": steal_ms,
        })
    }
}

/// Each side has half of it, so both fit in twice: a drive takes some 15 us of the two cores together.
fn period(drives: usize) -> u64 {
    (drives as u64 * 80 * US).next_multiple_of(MS).max(2 * MS)
}

/// Both kinds in one cycle at 1 kHz, alone; then against the bare loop.
fn together(granted: &Granted, quick: bool, budgets: &Budgets, report: &mut Report) -> Value {
    let (alone, rounds, cycles) = if quick { (2_000, 3, 80) } else { (20_000, 15, 240) };
    let steal = Steal::begin();
    let Alone { end, calls, on_connections, page_faults, .. } = alone_at_1_khz(granted, TOGETHER, alone);
    let period_ns = period(TOGETHER.linmots + TOGETHER.due_unidrives());
    let against = Against::bare(granted, TOGETHER, period_ns, rounds, cycles);
    let (linmots, unidrives) = end.drives.split_at(TOGETHER.linmots);
    let [linmots, unidrives] = [linmots, unidrives].map(Kind::sum);
    let status = end.status;
    let p50 = |sample: &Sample| sample.quantile(0.5).map(|p50| p50.value);
    let Fleet { linmots: of_linmots, unidrives: of_unidrives, every, .. } = TOGETHER;
    println!(
        "\n{of_linmots} LinMots in every cycle and {of_unidrives} Unidrives in every {every}th, together at \
         1 kHz; steal {} ms",
        shown(steal.ms())
    );
    println!("  planned {} = executed {} + skipped {}", status.planned, status.executed, status.skipped);
    println!("  LinMots:   {linmots}");
    println!("  Unidrives: {unidrives}");
    println!(
        "  system calls a cycle, p50: {}, of which on connections {}",
        shown(calls.p50()),
        shown(p50(&on_connections))
    );
    println!(
        "  against the bare loop, every {} each: ours / bare {}, CPU {}",
        Ns(period_ns),
        shown(against.busy),
        shown(against.cpu)
    );
    report.check(
        format!("together: planned {} = executed + skipped", status.planned),
        status.planned == status.executed + status.skipped,
    );
    linmots.check("together, LinMots", report);
    unidrives.check("together, Unidrives", report);
    calls.check("together", budgets, report);
    within(report, budgets, "together on connections", budgets::CALLS, &on_connections);
    check_page_faults("together", page_faults, budgets, report);
    json!({
        "together": { "linmots": of_linmots, "unidrives": of_unidrives, "every": every },
        "planned": status.planned,
        "executed": status.executed,
        "skipped": status.skipped,
        "linmots_sent": linmots.sent,
        "linmots_answered": linmots.answered,
        "linmots_late": linmots.late,
        "unidrives_sent": unidrives.sent,
        "unidrives_answered": unidrives.answered,
        "syscalls_per_cycle": calls.p50(),
        "syscalls_on_connections": p50(&on_connections),
        "sockets_ratio": against.busy.map(|ratio| ratio.value),
        "sockets_ratio_interval": against.busy.map(|ratio| ratio.ends()),
        "sockets_cpu_ratio": against.cpu.map(|ratio| ratio.value),
        "steal_ms": steal.ms(),
    })
}

/// All kinds in one cycle at 1 kHz: nothing is left out, and each exchange is closed.
fn all_kinds(granted: &Granted, quick: bool, budgets: &Budgets, report: &mut Report) -> Value {
    let steal = Steal::begin();
    let Alone { end, calls, on_connections, ages, page_faults } =
        alone_at_1_khz(granted, ALL_KINDS, if quick { 2_000 } else { 20_000 });
    let (linmots, rest) = end.drives.split_at(ALL_KINDS.linmots);
    let (unidrives, rest) = rest.split_at(ALL_KINDS.unidrives);
    let (segment, rest) = rest.split_at(ALL_KINDS.segment);
    let (moons, lenzes) = rest.split_at(ALL_KINDS.moons);
    let kinds = [
        ("LinMots", linmots),
        ("Unidrives", unidrives),
        ("Kollmorgens", segment),
        ("MOONS", moons),
        ("Lenze drives", lenzes),
    ]
    .map(|(name, drives)| (name, Kind::sum(drives)));
    let (status, p50) = (end.status, |sample: &Sample| sample.quantile(0.5).map(|p50| p50.value));
    println!("\nall kinds in one cycle at 1 kHz ({ALL_KINDS}); steal {} ms", shown(steal.ms()));
    println!("  planned {} = executed {} + skipped {}", status.planned, status.executed, status.skipped);
    kinds.iter().for_each(|(name, kind)| println!("  {name}: {kind}"));
    println!(
        "  system calls a cycle, p50: {}, of which on connections {}; age of MOONS' feedback, p50: {} ns",
        shown(calls.p50()),
        shown(p50(&on_connections)),
        shown(p50(&ages))
    );
    report.check(
        format!("all kinds: planned {} = executed + skipped", status.planned),
        status.planned == status.executed + status.skipped,
    );
    kinds.iter().for_each(|(name, kind)| kind.check(&format!("all kinds, {name}"), report));
    calls.check("all kinds", budgets, report);
    within(report, budgets, "all kinds on connections", budgets::CALLS, &on_connections);
    check_page_faults("all kinds", page_faults, budgets, report);
    let counted = kinds.iter().map(|(name, kind)| (*name, json!([kind.sent, kind.answered, kind.missed])));
    json!({
        "all_kinds": ALL_KINDS.to_string(),
        "planned": status.planned,
        "executed": status.executed,
        "skipped": status.skipped,
        "sent_answered_missed": counted.collect::<BTreeMap<_, _>>(),
        "syscalls_per_cycle": calls.p50(),
        "syscalls_on_connections": p50(&on_connections),
        "moons_age_ns": p50(&ages),
        "steal_ms": steal.ms(),
    })
}

/// MOONS' drives with an interval of 4 ms, each in every cycle of as much: the send phase against the bare loop over
/// the same bytes, and how old feedback is.
fn packets_on_sockets(granted: &Granted, quick: bool, budgets: &Budgets, report: &mut Report) -> Value {
    let (rounds, cycles, period_ns) = if quick { (3, 200, 4 * MS) } else { (15, 400, 4 * MS) };
    let fleet = Fleet::moons(MOONS_DUEL);
    let steal = Steal::begin();
    let [mut ours, mut bare, mut ages] = [const { Sample::new() }; 3];
    let mut calls = CallsOnSockets::default();
    for _ in 0..rounds {
        let (mut simulated, theirs) = (fleet.simulate(Side::Ours), fleet.simulate(Side::Bare));
        simulated.drives.extend(theirs.drives);
        let _server = rig::serve(simulated, granted);
        let counted = &Calls::default();
        let carriers = &CountedNet::new(counted);
        let duel = rig::on_loop_thread(|_| packets::duel(fleet, period_ns, cycles, carriers, counted));
        match duel.unwrap_or_else(|error| rig::give_up(error)) {
            Ok(duel) => {
                ours.push(duel.ours);
                bare.push(duel.bare);
                calls.push(duel.calls);
                ages.push(duel.ages);
            }
            Err(why) => println!("a slice without the bare loop: {why}"),
        }
    }
    let p50 = |sample: &Sample| sample.quantile(0.5).map(|p50| p50.value);
    let (ratio, bound_ns) = (ours.ratio(&bare, 0.5), period_ns / 2 + period_ns);
    println!(
        "\n{MOONS_DUEL} MOONS' drives on sockets, every {} each; {rounds} rounds, steal {} ms",
        Ns(period_ns),
        shown(steal.ms())
    );
    println!(
        "  send phase, p50: {} ns; bare loop {} ns; ratio {}; system calls a cycle {}",
        shown(p50(&ours)),
        shown(p50(&bare)),
        shown(ratio),
        shown(calls.p50())
    );
    println!(
        "  age of feedback, p50: {} ns; half an interval and a period: {bound_ns} ns",
        shown(p50(&ages))
    );
    calls.check(&format!("{MOONS_DUEL} {}", ethernet_ip::PROTOCOL), budgets, report);
    json!({
        "moons_on_sockets": MOONS_DUEL,
        "send_ns": p50(&ours),
        "bare_ns": p50(&bare),
        "send_ratio": ratio.map(|ratio| ratio.value),
        "send_ratio_interval": ratio.map(|ratio| ratio.ends()),
        "syscalls_per_cycle": calls.p50(),
        "age_ns": p50(&ages),
        "steal_ms": steal.ms(),
    })
}

/// A segment alone at 1 kHz, and the same with couplers and terminals; then a segment against the bare loop.
fn segments_on_sockets(granted: &Granted, quick: bool, budgets: &Budgets, report: &mut Report) -> [Value; 3] {
    let (alone, rounds, cycles) = if quick { (2_000, 3, 80) } else { (20_000, 15, 240) };
    let fleets = [
        ("a segment", Fleet::segment(SEGMENT_ALONE)),
        ("terminals", Fleet::with_terminals(DRIVES_OF_64, TERMINALS_OF_64)),
    ];
    let [segment, terminals] = fleets.map(|(what, fleet)| {
        println!(
            "\n{} drives and {} couplers and terminals on one segment of this host at 1 kHz",
            fleet.segment, fleet.terminals
        );
        alone_on_sockets(granted, what, fleet, alone, budgets, report)
    });
    let duel = Against::bare(granted, Fleet::segment(SEGMENT_DUEL), 2 * MS, rounds, cycles);
    [segment, terminals, duel.report("a segment", SEGMENT_DUEL)]
}

/// A wire of Lenze drives alone at 1 kHz, all of them in every cycle; then against the bare loop.
fn wire_on_port(granted: &Granted, quick: bool, budgets: &Budgets, report: &mut Report) -> [Value; 2] {
    let (alone, rounds, cycles) = if quick { (2_000, 3, 80) } else { (20_000, 15, 240) };
    let fleet = Fleet::lenzes(lenze::A_WIRE);
    println!("\n{} drives on one PROFIBUS wire of this host at 1 kHz", fleet.lenzes);
    let mut wire = alone_on_sockets(granted, "a wire", fleet, alone, budgets, report);
    let calls = wire["syscalls_per_cycle"].as_f64();
    let each = calls.map(|calls| (calls - 1.0) / fleet.lenzes as f64);
    println!("  system calls an exchange in addition to the sleep: {}", shown(each));
    wire["syscalls_per_exchange"] = json!(each);
    let duel = Against::bare(granted, fleet, 2 * MS, rounds, cycles);
    [wire, duel.report("a wire", fleet.lenzes)]
}

/// Drives of one kind at 1 kHz: nothing is left out or lost, and their system calls.
fn alone_on_sockets(
    granted: &Granted,
    what: &str,
    fleet: Fleet,
    cycles: usize,
    budgets: &Budgets,
    report: &mut Report,
) -> Value {
    let steal = Steal::begin();
    let Alone { end, calls, page_faults, .. } = alone_at_1_khz(granted, fleet, cycles);
    let (status, drives) = (end.status, Kind::sum(&end.drives));
    println!("  planned {} = executed {} + skipped {}", status.planned, status.executed, status.skipped);
    println!("  {drives}");
    println!("  system calls a cycle, p50: {}; steal {} ms", shown(calls.p50()), shown(steal.ms()));
    report.check(
        format!("{what}: planned {} = executed + skipped", status.planned),
        status.planned == status.executed + status.skipped,
    );
    drives.check(what, report);
    calls.check(what, budgets, report);
    check_page_faults(what, page_faults, budgets, report);
    json!({
        "alone": what,
        "drives": fleet.drives(),
        "terminals": fleet.terminals,
        "planned": status.planned,
        "executed": status.executed,
        "skipped": status.skipped,
        "sent": drives.sent,
        "answered": drives.answered,
        "missed": drives.missed,
        "syscalls_per_cycle": calls.p50(),
        "steal_ms": steal.ms(),
    })
}

/// A master with all of its threads against the bare loop.
fn whole_process(granted: &Granted, quick: bool) -> Vec<Value> {
    let (rounds, cycles) = if quick { (3, 1_000) } else { (11, 2_000) };
    println!(
        "\nall threads of a master at 1 kHz against the bare loop, processor time in ns a cycle, {rounds} \
         rounds"
    );
    let fleets = [
        ("3 drives on one segment", Fleet::segment(3)),
        ("4 drives on one wire, each in every fourth cycle", Fleet { every: 4, ..Fleet::lenzes(4) }),
        ("8 LinMots", Fleet::linmots(8)),
        ("16 LinMots", Fleet::linmots(16)),
    ];
    let measured = fleets.map(|(what, fleet)| {
        let steal = Steal::begin();
        let whole = Whole::measure(granted, fleet, rounds, cycles);
        let p50 = |rounds: &[f64]| (!rounds.is_empty()).then(|| median(rounds).round());
        let threads: Vec<(&str, Option<f64>)> =
            whole.threads.iter().map(|(name, sample)| (name.as_str(), p50(sample))).collect();
        let by_thread: Vec<String> =
            threads.iter().map(|(name, ns)| format!("{name} {}", shown(*ns))).collect();
        println!(
            "  {what}: ours {}, bare {}, ratio {}; {}; steal {} ms",
            shown(p50(&whole.ours)),
            shown(p50(&whole.bare)),
            shown(whole.ratio()),
            by_thread.join(", "),
            shown(steal.ms())
        );
        json!({
            "whole_process": what,
            "ours_cpu_ns": p50(&whole.ours),
            "threads_cpu_ns": threads.into_iter().collect::<BTreeMap<_, _>>(),
            "bare_cpu_ns": p50(&whole.bare),
            "whole_cpu_ratio": whole.ratio().map(|ratio| ratio.value),
            "whole_cpu_ratio_interval": whole.ratio().map(|ratio| ratio.ends()),
            "steal_ms": steal.ms(),
        })
    });
    measured.into()
}

/// A fleet without a rival.
struct Alone {
    end: Numbers,
    /// System calls of each executed cycle: all of them, and those on connections.
    calls: CallsOnSockets,
    on_connections: Sample,
    /// How old the status of each MOONS' drive is when a cycle publishes it, ns.
    ages: Sample,
    /// Of the loop's thread meanwhile; `None`: its memory is not locked.
    page_faults: Option<u64>,
}

/// So many cycles of a fleet.
fn alone_at_1_khz(granted: &Granted, fleet: Fleet, cycles: usize) -> Alone {
    let _server = rig::serve(fleet.simulate(Side::Ours), granted);
    let counted = Calls::default();
    let carriers = CountedNet::new(&counted);
    let run = rig::on_loop_thread(|granted| {
        let cycle = rig::exchange_cycle(MS, Wait::Poll);
        let mut rig = Rig::new(cycle, fleet.buses(Side::Ours), Pace::Grid, &carriers, Arc::clone(&counted));
        rig.enable();
        let (mut calls, mut on_them) = (Vec::with_capacity(cycles), Vec::with_capacity(cycles));
        let mut of_moons = Vec::with_capacity(cycles * fleet.moons);
        let first = fleet.drives() - fleet.lenzes - fleet.moons;
        let usage = Usage::of_thread();
        for _ in 0..cycles {
            let (executed, before) = (rig.status().executed, carriers.on_connections());
            let turn = rig.turn(|record| match record {
                Record::Drive(DriveRecord { axis, age_ns: Some(age_ns), .. })
                    if (first..first + fleet.moons).contains(&axis.into()) =>
                {
                    of_moons.push(u64::from(age_ns.get()));
                }
                _ => {}
            });
            if rig.status().executed > executed {
                calls.push(turn.calls);
                on_them.push(carriers.on_connections() - before);
            }
        }
        let page_faults = Usage::of_thread().since(usage).page_faults();
        rig.settle();
        let [mut on_connections, mut ages] = [const { Sample::new() }; 2];
        let mut all = CallsOnSockets::default();
        all.push(calls);
        ages.push(of_moons);
        on_connections.push(on_them);
        let page_faults = granted.memory_locked.then_some(page_faults);
        Alone { end: rig.end(), calls: all, on_connections, ages, page_faults }
    });
    run.unwrap_or_else(|error| rig::give_up(error))
}

fn check_page_faults(what: &str, page_faults: Option<u64>, budgets: &Budgets, report: &mut Report) {
    match page_faults {
        Some(page_faults) => report.within(budgets, budgets::PAGE_FAULTS, page_faults as f64),
        None => report.not_compared(format!("{what}: page faults"), "the memory is not locked here"),
    }
}

/// The exchanges of all drives of one kind.
struct Kind {
    sent: u64,
    answered: u64,
    missed: u64,
    late: u64,
}

impl Kind {
    fn sum(drives: &[DriveEnd]) -> Kind {
        let all = drives.iter().map(|drive| drive.counters);
        all.fold(Kind { sent: 0, answered: 0, missed: 0, late: 0 }, |sum, drive| Kind {
            sent: sum.sent + drive.sent,
            answered: sum.answered + drive.answered,
            missed: sum.missed + drive.missed,
            late: sum.late + drive.late,
        })
    }

    /// Every exchange was closed, and only once. What is missed is the host's doing.
    fn check(&self, what: &str, report: &mut Report) {
        let Kind { sent, answered, missed, .. } = self;
        report.check(
            format!("{what}: sent {sent} = answered {answered} + missed {missed}"),
            *sent == answered + missed && *answered > 0,
        );
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Kind { sent, answered, missed, late } = self;
        write!(f, "sent {sent}, answered {answered}, missed {missed}, of which came late {late}")
    }
}

/// Runs the loop in a child under strace and compares the counts of system calls.
fn strace(granted: &Granted, quick: bool, report: &mut Report) {
    println!("\nthe count of system calls, proved by strace over {TRACED_CYCLES} cycles");
    let drives: &[usize] = if quick { &[8] } else { &[1, 8, 64, 256] };
    let fleets = drives.iter().map(|count| (format!("{count} drives"), Fleet::linmots(*count)));
    let others = [
        ("one Unidrive", Fleet::unidrives(1)),
        ("LinMots and Unidrives together", TOGETHER),
        ("a segment of one", Fleet::segment(1)),
        ("a segment with terminals", Fleet::with_terminals(DRIVES_OF_64, TERMINALS_OF_64)),
        ("32 MOONS' drives", Fleet::moons(MOONS_DUEL)),
        ("a wire", Fleet::lenzes(lenze::A_WIRE)),
    ];
    for (what, fleet) in fleets.chain(others.map(|(what, fleet)| (what.to_owned(), fleet))) {
        match strace_of(granted, fleet) {
            Ok((counted, seen)) => {
                println!("  {what}: counted {counted}, strace saw {seen}");
                report.check(format!("{what}: strace sees as many calls as were counted"), counted == seen);
            }
            Err(why) => println!("  {what}: not proved: {why}"),
        }
    }
}

fn strace_of(granted: &Granted, fleet: Fleet) -> Result<(u64, u64), String> {
    // The drives live in this process: only the loop is traced.
    let _server = rig::serve(fleet.simulate(Side::Ours), granted);
    let directory = std::env::temp_dir().join(format!("fieldbeat-scale-{}", std::process::id()));
    std::fs::create_dir_all(&directory).map_err(|error| error.to_string())?;
    let result = strace_into(&directory, fleet);
    // Nothing depends on its removal.
    let _ = std::fs::remove_dir_all(&directory);
    result
}

fn strace_into(directory: &std::path::Path, fleet: Fleet) -> Result<(u64, u64), String> {
    let own = std::env::current_exe().map_err(|error| error.to_string())?;
    let output = Command::new("strace")
        .args(["-ff", "-e", "signal=none", "-o"])
        .arg(directory.join("calls"))
        .arg(own)
        .env(TRACED, fleet.to_string())
        .stdin(Stdio::null())
        .output()
        .map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => "strace is not installed (Debian: strace)".to_owned(),
            _ => format!("cannot run strace: {error}"),
        })?;
    let said = String::from_utf8_lossy(&output.stdout);
    let counted: u64 = said.trim().parse().map_err(|_| {
        format!("the child said {said:?}: {}", String::from_utf8_lossy(&output.stderr).trim())
    })?;
    // One file a thread. The loop marks the begin and the end of what counts by asking for its parent.
    for entry in std::fs::read_dir(directory).map_err(|error| error.to_string())? {
        let path = entry.map_err(|error| error.to_string())?.path();
        let text = std::fs::read_to_string(path).map_err(|error| error.to_string())?;
        let marks: Vec<_> =
            (text.lines().enumerate()).filter(|(_, line)| line.starts_with("getppid()")).collect();
        if let [(begin, _), (end, _)] = marks[..] {
            return Ok((counted, (end - begin - 1) as u64));
        }
    }
    Err("no thread with both marks".to_owned())
}

/// The child: counts what it calls between the marks.
fn traced(fleet: Fleet) {
    let counted = Calls::default();
    let carriers = CountedNet::new(&counted);
    let calls = rig::on_loop_thread(|_| {
        // Under strace a call takes some 50 us. A segment and a wire have to be brought up.
        let period_ns = if fleet.segment + fleet.lenzes > 0 { 4 * MS } else { 20 * MS };
        let cycle = rig::exchange_cycle(period_ns, Wait::Poll);
        let mut rig = Rig::new(cycle, fleet.buses(Side::Ours), Pace::Grid, &carriers, Arc::clone(&counted));
        rig.enable();
        let _ = std::os::unix::process::parent_id();
        let calls: u64 = (0..TRACED_CYCLES).map(|_| rig.turn(|_| {}).calls.made).sum();
        let _ = std::os::unix::process::parent_id();
        calls
    });
    println!("{}", calls.unwrap_or_else(|error| rig::give_up(error)));
}
