//! What is counted in place of being measured, with `--count`.

use std::io;
use std::net::SocketAddrV4;
use std::sync::Arc;

use fieldbeat::bus::BusPlan;
use fieldbeat::telemetry::Measured;
use fieldbeat::time::MS;
use fieldbeat::{Plan, Wait};
use fieldbeat_core::axis::Link;
use fieldbeat_core::cycle::record::{DriveRecord, Record};
use fieldbeat_core::net::{Carriers, Datagrams, Frames, Serial, SerialLine, StreamPeer, Streams, UdpOptions};
use fieldbeat_ethercat as ethercat;
use fieldbeat_ethernet_ip as ethernet_ip;
use fieldbeat_linudp as linudp;
use fieldbeat_modbus as modbus;
use fieldbeat_profibus as profibus;
use fieldbeat_record::recording::Recorder;

use super::carriers;
use crate::support::count::{self, Caches, Ran, Scenario};
use crate::support::counted::CountedNet;
use crate::support::fleet::{Fleet, Side};
use crate::support::lenze::{self, NullWires};
use crate::support::null::NullNet;
use crate::support::rig::{self, Calls, Metered, Pace, Rig, Scene};
use crate::support::segment::{self, NullSegments, Settled};
use crate::support::{callgrind, unidrive};

/// The drives of a machine among the couplers and terminals of one: 64 slaves, one frame.
pub const DRIVES_OF_64: usize = 8;
pub const TERMINALS_OF_64: usize = 56;

/// Numbers of drives that have budgets; the others are measured only.
pub const COMPARED: [usize; 4] = [1, 8, 64, 256];
/// Cycles that are counted: each drive publishes its numbers in one of 64 of them.
const COUNTED_CYCLES: u64 = 128;
/// Drives that fit into the frame of one segment.
const SEGMENT_MOST: usize = 64;

/// What is counted in place of being measured. At 64 drives the first-level misses have a budget, at 256 the
/// second-level ones are of interest.
pub fn scenarios() -> Vec<Scenario> {
    let caches = |drives| match drives {
        64 => Caches::Yes,
        256 => Caches::OnRequest,
        _ => Caches::No,
    };
    let of = |protocol| {
        COMPARED.map(|drives| Scenario { caches: caches(drives), ..Scenario::of(protocol, drives) })
    };
    let with_terminals = Scenario {
        terminals: TERMINALS_OF_64,
        caches: Caches::OnRequest,
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
        .chain([Scenario { part: Some(DEFAULT), caches: Caches::Yes, ..Scenario::of(modbus::PROTOCOL, 64) }])
        .chain(
            [linudp::PROTOCOL, modbus::PROTOCOL, ethernet_ip::PROTOCOL]
                .map(|protocol| Scenario { part: Some(CARRIER), ..Scenario::of(protocol, 64) }),
        )
        .collect()
}

pub fn again(part: &'static str, worst: bool) -> [Scenario; 5] {
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
/// The carrier on sockets alone.
const CARRIER: &str = "carrier";
const AGAIN: [(&str, usize); 5] = [
    (linudp::PROTOCOL, 64),
    (modbus::PROTOCOL, 64),
    (ethercat::PROTOCOL, 64),
    (ethernet_ip::PROTOCOL, 64),
    (profibus::PROTOCOL, lenze::SEGMENT),
];

/// The child: the loop over drives in memory, all in operation.
pub fn counted(scenario: Scenario) -> Ran {
    let Scenario { protocol, part, drives, terminals, worst, .. } = scenario;
    if part == Some(CARRIER) {
        return carriers::of(protocol, drives, COUNTED_CYCLES);
    }
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
    // As in a run that lasts: a stretch of its course has many cycles.
    for axis in 0..plan.axes().len() as u16 {
        let drive = DriveRecord { index: 1 << 20, axis, link: Link::Online, ..DriveRecord::default() };
        measured.enter(&Record::Drive(drive));
    }
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
