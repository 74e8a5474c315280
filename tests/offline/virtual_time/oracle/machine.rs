//! Machines of each protocol with drives that show their true state, and that keep datagrams to be repeated.

use std::collections::{BTreeMap, VecDeque};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::ops::Range;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use fieldbeat::axis::{AxisPlan, HeldBy, Limits, Link, Load, Profile, StopPlan, StopThen, StopTimeout};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive};
use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, Explicit, Homing, HomingMethod, MoonsDrive};
use fieldbeat::bus::linudp::motion::{Acceleration, MotionCommand, Position, Velocity};
use fieldbeat::bus::linudp::{ControlWord, LinUdpDrive, ReplyTag};
use fieldbeat::bus::modbus::{ModbusPlan, UnidriveDrive, Via};
use fieldbeat::bus::profibus::{DriveProfile, LenzeDrive, Numbers, ParameterPath, ProfibusPlan};
use fieldbeat::sim::{SimDrive, SimSegment, Simulated, Truth, World, WorldOptions};
use fieldbeat::time::{MS, Time, US};
use fieldbeat::{CyclePlan, Master, Plan, Simulation};
use fieldbeat_core::axis::CallTicket;
use fieldbeat_ethercat::wire::registers::{AlState, AlStatus, address as register};
use fieldbeat_linudp::wire::{Request, Response, ResponseDef};
use fieldbeat_modbus::Mapping;
use fieldbeat_sim::ethercat::{EthercatSegment, EthercatSim};
use fieldbeat_sim::ethernet_ip::{ClockSettings, Edges, MoonsSettings, MoonsSim};
use fieldbeat_sim::linudp::{LinMotSettings, LinMotSim};
use fieldbeat_sim::modbus::{UnidriveSettings, UnidriveSim};
use fieldbeat_sim::profibus::{Misuse, ProfibusSegment};

use crate::between::{Between, Message, Sender, Shared};
use crate::proposing::ProposingPlan;
use crate::virtual_time::kollmorgen::{self, LINE};
use crate::virtual_time::lenze::PORT;
use crate::virtual_time::lenze::tap::TapWire;
use crate::virtual_time::other_masters::frame;
use crate::virtual_time::replay::Log;
use crate::virtual_time::support::{self, MASTER};

/// Axes of a machine.
pub const AXES: usize = 3;

/// Requests and replies that are kept to be repeated. A motion command that is repeated has another count than the
/// present one: a drive counts to sixteen.
const KEPT: usize = 64;
const KEPT_MOTIONS: usize = 8;
const KEPT_FRAMES: usize = 16;
/// Of its replies of any time before: the first one and the last one in each state, and one of so many, up to so many.
const OF_REPLIES: u64 = 97;
const KEPT_OLD: usize = 256;
/// After so many exchanges the shape of a request is the same again: of definitions, and of counts.
const SHAPES: [usize; 2] = [8, 14];

/// Of a MOONS': the number of its socket of packets, the port, where the command word is, and where its master is.
const PACKETS: usize = 1;
const PACKET_PORT: u16 = 2_222;
const COMMAND_WORD: usize = 24;
const SCANNER: Ipv4Addr = Ipv4Addr::new(10, 0, 6, 1);
/// Where a packet has the number of its connection.
const CONNECTION: usize = 6;

/// Another sender.
const ELSEWHERE: Ipv4Addr = Ipv4Addr::new(10, 0, 9, 9);
/// What a tool on a segment does: so many things. Where the data of a frame with one datagram are.
const TOOLS: usize = 7;
/// The one that takes a slave's outputs out of the frame, and the turns until the SyncManager's watchdog (100 ms) ends
/// them.
const OUTPUTS_CUT: usize = 4;
const WATCHDOG: u64 = 100;
const DATA: usize = 26;

/// The address of the first Lenze, of its master, and of another master.
const FIRST_LENZE: u8 = 3;
const OWN: u8 = 2;
const OTHER: u8 = 9;

/// What others say on a serial wire, by a number: tokens as noise makes them, another master with its outputs for the
/// drive at `address` and its Clear, or a Clear that the drives take for their master's.
fn foreign(number: usize, address: u8) -> Vec<Vec<u8>> {
    let token = vec![0xDC, OTHER, OTHER];
    let sd2 = |body: &[u8]| {
        let (length, sum) = (body.len() as u8, body.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)));
        [&[0x68, length, length, 0x68], body, &[sum, 0x16]].concat()
    };
    let clear = |master: u8| sd2(&[0xFF, 0x80 | master, 0x46, 58, 62, 2, 0]);
    // Run, at half of the full speed.
    let outputs = [&[address, OTHER, 0x5D][..], &[0; 8], &[0x04, 0x7F, 0x20, 0]].concat();
    match number {
        0 => vec![token],
        1 => vec![token.clone(), sd2(&outputs)],
        2 => vec![clear(OTHER)],
        3 => vec![clear(OWN)],
        5 => vec![token.clone(), token, clear(OTHER), sd2(&outputs)],
        _ => vec![sd2(&outputs); 2],
    }
}

/// A protocol.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kind {
    #[default]
    LinMot,
    Unidrive,
    /// A drive with its own clock, whose commands are edges.
    Moons,
    /// Positions (1701h), velocities (1702h) and torques (1703h) on one segment.
    Kollmorgen,
    /// Drives in turn on one half-duplex wire.
    Lenze,
    /// A LinMot, a Unidrive and a MOONS', each on a bus of its own.
    Mixed,
}

impl Kind {
    /// One protocol each.
    pub const ALL: [Kind; 5] = [Kind::LinMot, Kind::Unidrive, Kind::Kollmorgen, Kind::Moons, Kind::Lenze];

    /// That of an axis.
    pub fn of(self, index: usize) -> Kind {
        match self {
            Kind::Mixed => [Kind::LinMot, Kind::Unidrive, Kind::Moons][index],
            kind => kind,
        }
    }
}

/// A machine to be built.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    pub kind: Kind,
    /// After a stop the axes hold; else their power goes off.
    pub hold: bool,
    /// The protocol's other way: tagged replies, menu 0, a leading clock; a drive that takes no change between two
    /// commands for an edge, and whose clock shakes; PROFIdrive and MSAC1, and turns that take longer than a cycle.
    pub other: bool,
    /// Parameters are written as well where the master does not refuse it: with power off, and in native mode.
    pub free_writes: bool,
    /// These axes are a stop group, and the load of these is held by its drive alone: a bit for each.
    pub group: u8,
    pub held: u8,
    /// All Kollmorgens follow velocities.
    pub alike: bool,
    /// Operators have the axes, and not an application: their jogs have a dead-man time.
    pub operated: bool,
    /// So are LinMots whose track ends before their range does.
    pub short: u8,
    pub period_ns: u64,
    /// Other requests are built before each one that leaves.
    pub proposals: bool,
}

impl Shape {
    /// The plain one of a protocol.
    pub fn of(kind: Kind) -> Shape {
        Shape { kind, free_writes: true, period_ns: MS, ..Shape::default() }
    }

    /// Axes that a group has: those of the stop group, from the first one on.
    pub fn members(self) -> usize {
        self.group.trailing_ones() as usize
    }

    /// How the axis with this place in the machine is other than usual.
    fn apply(self, index: usize, axis: &mut AxisPlan) {
        let has = |bits: u8| bits >> index & 1 != 0;
        axis.stop.group = has(self.group).then_some(1);
        if has(self.held) {
            axis.load = Load::Vertical(HeldBy::Drive);
            (axis.stop.then, axis.stop.on_timeout) = (StopThen::Hold, StopTimeout::Hold);
        }
    }
}

/// How an axis is judged, in its units.
#[derive(Clone, Copy, Debug, Default)]
pub struct Scale {
    /// The largest speed that it may have, and the acceleration of its commands.
    pub velocity: f64,
    pub acceleration: f64,
    /// Slower than that it stands.
    pub still: f64,
    /// As near as a move ends to its target.
    pub near: f64,
    pub positions: bool,
    pub velocities: bool,
    pub torques: bool,
    pub homes: bool,
    /// Its replies have no number: old ones come again.
    pub replies_again: bool,
    /// So many turns lead to one report of it, while it runs and this master has not enabled it.
    pub report_turns: u32,
}

/// A LinMot, a MOONS' or a Unidrive that the world and the test share.
enum Drive {
    LinMot(Box<LinMotSim>),
    Moons(Box<MoonsSim>),
    Unidrive(Box<UnidriveSim>),
}

/// Such a drive, and what was said on its wire.
struct Tapped {
    drive: Drive,
    requests: VecDeque<Vec<u8>>,
    motions: VecDeque<Vec<u8>>,
    replies: VecDeque<Vec<u8>>,
    /// Its replies of any time before, of a LinMot: by status word and main state, and in their order.
    states: BTreeMap<(u16, u8), [Response; 2]>,
    old: VecDeque<Response>,
    replied: u64,
    /// So many requests, or replies, are still to be lost.
    pub lose: [u32; 2],
    /// The master's ends of its connections.
    connected: Vec<SocketAddrV4>,
}

impl Tapped {
    fn remember(&mut self, reply: Response) {
        let (Some(status), Some(state)) = (reply.status, reply.state) else { return };
        self.states.entry((status.0, state.main().0)).or_insert([reply; 2])[1] = reply;
        if self.replied.is_multiple_of(OF_REPLIES) {
            if self.old.len() == KEPT_OLD {
                self.old.pop_front();
            }
            self.old.push_back(reply);
        }
        self.replied += 1;
    }
}

fn keep(kept: &mut VecDeque<Vec<u8>>, most: usize, bytes: &[u8]) {
    let mut entry = if kept.len() == most { kept.pop_back().unwrap_or_default() } else { Vec::new() };
    entry.clear();
    entry.extend_from_slice(bytes);
    kept.push_front(entry);
}

type Tap = Shared<Tapped>;

fn tap(drive: Drive) -> Tap {
    Shared::new(Tapped {
        drive,
        requests: VecDeque::new(),
        motions: VecDeque::new(),
        replies: VecDeque::new(),
        states: BTreeMap::new(),
        old: VecDeque::new(),
        replied: 0,
        lose: [0; 2],
        connected: Vec::new(),
    })
}

/// Whether this one is still to be lost.
fn takes(left: &mut u32) -> bool {
    let takes = *left > 0;
    *left -= u32::from(takes);
    takes
}

impl Between for Tapped {
    fn drive(&mut self) -> &mut dyn SimDrive {
        match &mut self.drive {
            Drive::LinMot(drive) => drive.as_mut(),
            Drive::Moons(drive) => drive.as_mut(),
            Drive::Unidrive(drive) => drive.as_mut(),
        }
    }

    fn receive(&mut self, message: Message<'_>, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        // A connection carries its bytes in their order: none of them is repeated late.
        let commands = match &self.drive {
            Drive::LinMot(_) => Request::parse(message.bytes).is_ok_and(|request| request.motion.is_some()),
            Drive::Moons(_) if message.socket == PACKETS => {
                let word = message.bytes.get(COMMAND_WORD..COMMAND_WORD + 4);
                word.is_some_and(|word| word != [0; 4])
            }
            Drive::Moons(_) | Drive::Unidrive(_) => return message.reaches(self.drive(), reply),
        };
        if takes(&mut self.lose[0]) {
            return None;
        }
        keep(&mut self.requests, KEPT, message.bytes);
        if commands && self.motions.front().is_none_or(|last| last != message.bytes) {
            keep(&mut self.motions, KEPT_MOTIONS, message.bytes);
        }
        let to = message.reaches(self.drive(), reply)?;
        keep(&mut self.replies, KEPT, reply);
        if let Ok(reply) = Response::parse(reply) {
            self.remember(reply);
        }
        (!takes(&mut self.lose[1])).then_some(to)
    }

    fn connect(&mut self, now: Time, from: SocketAddrV4) -> bool {
        let accepts = self.drive().connect(now, from);
        if accepts {
            self.connected.push(from);
        }
        accepts
    }

    fn run(&mut self, now: Time, send: &mut Sender<'_>) {
        let Tapped { drive, replies, lose, .. } = self;
        // The others have no clock of their own.
        let Drive::Moons(drive) = drive else { return };
        drive.run(now, &mut |socket, to, bytes| {
            if socket == PACKETS {
                keep(replies, KEPT, bytes);
                if takes(&mut lose[1]) {
                    return;
                }
            }
            send(socket, to, bytes);
        });
    }

    fn disconnected(&mut self, now: Time, from: SocketAddrV4) {
        self.connected.retain(|one| *one != from);
        self.drive().disconnected(now, from);
    }
}

/// A segment that the world and the test share, and the frames that came back from it of late.
#[derive(Clone)]
struct TapLine(Arc<Mutex<(EthercatSim, VecDeque<Vec<u8>>)>>);

impl TapLine {
    fn with<R>(&self, f: impl FnOnce(&mut EthercatSim) -> R) -> R {
        f(&mut self.0.lock().unwrap().0)
    }
}

impl SimSegment for TapLine {
    crate::forward_sim_line!(line => line.0.lock().unwrap().0);

    fn interface(&self) -> &str {
        LINE
    }

    fn own_interface(&self) -> Option<&str> {
        None
    }

    fn slaves(&self) -> usize {
        AXES
    }

    fn pass(&mut self, now: Time, frame: &mut [u8]) -> bool {
        let (line, frames) = &mut *self.0.lock().unwrap();
        let returns = line.pass(now, frame);
        keep(frames, KEPT_FRAMES, frame);
        returns
    }

    fn advance(&mut self, now: Time) {
        self.with(|line| line.advance(now));
    }

    fn restart(&mut self, now: Time, place: usize) {
        self.with(|line| line.restart(now, place));
    }
}

/// A machine that runs.
pub struct Machine {
    pub sim: Simulation,
    pub shape: Shape,
    pub plans: Vec<AxisPlan>,
    pub scales: Vec<Scale>,
    held: Held,
    addresses: Vec<SocketAddrV4>,
    /// Calls under way: a ticket that is dropped would cancel its call.
    pub calls: Vec<CallTicket>,
    log: Option<Log>,
}

/// A stop that ends soon, so that a sequence sees its end; jogs without a button to hold; a small event queue.
fn shorten(axis: &mut AxisPlan, index: usize, shape: Shape, velocity: f64, deceleration: f64) {
    axis.limits.velocity = Some(velocity);
    axis.profile = Profile { velocity, acceleration: deceleration, deceleration };
    axis.stop = StopPlan {
        deceleration,
        then: if shape.hold { StopThen::Hold } else { StopThen::Disable },
        timeout: STOP_TIMEOUT,
        on_timeout: StopTimeout::Disable,
        standstill_for: 5,
        ..axis.stop
    };
    axis.jog_deadman = shape.operated.then_some(DEADMAN);
    axis.health.probe_interval = Duration::from_millis(10);
    axis.enable_timeout = Duration::from_millis(1_500);
    axis.home_timeout = Duration::from_millis(1_500);
    axis.event_queue = EVENTS;
    shape.apply(index, axis);
}

/// Of jogs, where there are operators.
pub const DEADMAN: Duration = Duration::from_millis(100);
/// Of every axis.
pub const STOP_TIMEOUT: Duration = Duration::from_millis(50);
/// Room for events, so little that an application that does not read them for a moment fills it.
const EVENTS: usize = 48;

fn linmot(index: usize, shape: Shape) -> LinUdpDrive {
    let mut drive = support::drive(index);
    shorten(&mut drive.axis, index, shape, 200.0, 4_000.0);
    drive.axis.limits.acceleration = None;
    drive.reply_tag = if shape.other { ReplyTag::Count } else { ReplyTag::default() };
    drive
}

fn unidrive(index: usize, shape: Shape) -> UnidriveDrive {
    let address = Ipv4Addr::new(10, 0, 3, 1 + index as u8);
    let mut drive = UnidriveDrive::new(format!("u{index}"), address);
    shorten(&mut drive.axis, index, shape, 8.0, 160.0);
    drive.via = if shape.other { Via::Menu0 { first: 11 } } else { Via::Direct };
    drive.reply_within_ns = 5 * MS;
    drive
}

fn moons(index: usize, shape: Shape) -> MoonsDrive {
    let mut drive = MoonsDrive::new(format!("m{index}"), Ipv4Addr::new(10, 0, 6, 2 + index as u8));
    shorten(&mut drive.axis, index, shape, 8.0, 160.0);
    drive.axis.limits.position = Some((-5.0, 5.0));
    if shape.other {
        drive.explicit = Explicit::Connected;
    }
    drive.homing = Some(Homing {
        method: HomingMethod::Seek,
        input: 0x4CB2,
        velocity: 4.0,
        acceleration: 160.0,
        distance: -0.6,
    });
    drive
}

fn kollmorgen(place: u16, shape: Shape) -> KollmorgenDrive {
    let mode = if shape.alike { 1 } else { place.into() };
    let (outputs, velocity) = [(0x1701, 20.0), (0x1702, 20.0), (0x1703, 5.0)][mode];
    let mut drive = kollmorgen::with(place, Family::S700, outputs, 0x1B03);
    shorten(&mut drive.axis, place.into(), shape, velocity, 400.0);
    let limits = &mut drive.axis.limits;
    limits.torque = Some(150.0);
    if outputs == 0x1701 {
        limits.position = Some((-5.0, 5.0));
    }
    drive
}

fn lenze(index: usize, shape: Shape) -> LenzeDrive {
    let mut drive = LenzeDrive::new(format!("l{index}"), FIRST_LENZE + index as u8);
    shorten(&mut drive.axis, index, shape, 8.0, 160.0);
    if shape.other {
        (drive.profile, drive.enable_bit) = (DriveProfile::Profidrive, None);
        drive.parameters = ParameterPath::Msac1 { slot: 0, index: 47, axis: 0, numbers: Numbers::FromTop };
    }
    drive
}

/// At 12 Mbit/s all have their turn in each cycle; at 1.5 Mbit/s in some of them.
fn profibus(shape: Shape) -> ProfibusPlan {
    let drives = (0..AXES).map(|index| lenze(index, shape)).collect();
    if !shape.other {
        return ProfibusPlan::new(PORT, 12_000_000, drives);
    }
    let plan = ProfibusPlan::new(PORT, 1_500_000, drives);
    plan.in_turn(plan.least_divisor(CyclePlan::default().grid()).expect("there is one"))
}

/// The drives of a machine, or their segment or wire, as the test holds them.
#[derive(Default)]
struct Held {
    taps: Vec<Tap>,
    line: Option<TapLine>,
    wire: Option<TapWire>,
}

impl Held {
    /// The buses of a machine, on drives that are there already or on new ones.
    fn buses(&mut self, shape: Shape) -> Vec<Box<dyn BusPlan>> {
        match shape.kind {
            Kind::Mixed => (0..AXES)
                .map(|index| {
                    let shape = Shape { kind: shape.kind.of(index), ..shape };
                    self.bus(shape, index..index + 1)
                })
                .collect(),
            _ => vec![self.bus(shape, 0..AXES)],
        }
    }

    /// A bus with the axes of these places.
    fn bus(&mut self, shape: Shape, places: Range<usize>) -> Box<dyn BusPlan> {
        let fresh = self.taps.len() <= places.start;
        match shape.kind {
            Kind::Mixed => unreachable!("each of its axes has a bus of its own"),
            Kind::LinMot => {
                let drives: Vec<_> = places.clone().map(|index| linmot(index, shape)).collect();
                if fresh {
                    // Short homing.
                    let drive = |(drive, index): (&LinUdpDrive, usize)| {
                        let mut settings = LinMotSettings {
                            start_position: 10_000,
                            stream_period_ns: shape.period_ns,
                            ..support::simulated(drive)
                        };
                        if shape.short >> index & 1 != 0 {
                            settings.range.1 = 700_000;
                        }
                        tap(Drive::LinMot(LinMotSim::new(settings).into()))
                    };
                    self.taps.extend(drives.iter().zip(places).map(drive));
                }
                Box::new(support::bus(drives))
            }
            Kind::Unidrive => {
                let drives: Vec<_> = places.map(|index| unidrive(index, shape)).collect();
                if fresh {
                    // Half of them were commissioned to follow the control word, which they keep when they restart.
                    let kept = shape.hold.then_some(([6, 43], 1));
                    let settings = |drive| UnidriveSettings {
                        ramps_s: (0.005, 0.005),
                        commissioned: kept.into_iter().collect(),
                        ..UnidriveSettings::new(drive)
                    };
                    let drive = |plan: &UnidriveDrive| {
                        tap(Drive::Unidrive(UnidriveSim::new(settings(plan.address)).into()))
                    };
                    self.taps.extend(drives.iter().map(drive));
                }
                Box::new(ModbusPlan::new(drives))
            }
            Kind::Moons => {
                let drives: Vec<_> = places.map(|index| moons(index, shape)).collect();
                if fresh {
                    let drive = |plan: &MoonsDrive| {
                        let mut settings = MoonsSettings::of(plan);
                        settings.motor.start = 4_000;
                        if shape.other {
                            settings.firmware.edges = Edges::Strict;
                            settings.clock = ClockSettings { drift_ppm: 200, jitter_ns: 300 * US, seed: 1 };
                        }
                        tap(Drive::Moons(MoonsSim::new(settings).into()))
                    };
                    self.taps.extend(drives.iter().map(drive));
                }
                Box::new(EthernetIpPlan::new(SCANNER, drives))
            }
            Kind::Lenze => {
                let plan = profibus(shape);
                self.wire.get_or_insert_with(|| {
                    let mut segment = ProfibusSegment::of(&plan);
                    segment.drives.iter_mut().for_each(|drive| drive.motor.ramps_s = (0.01, 0.01, 0.01));
                    TapWire::new(segment)
                });
                Box::new(plan)
            }
            Kind::Kollmorgen => {
                let drives = places.map(|place| kollmorgen(place as u16, shape)).collect();
                let plan = EthercatPlan::new(LINE, drives);
                self.line.get_or_insert_with(|| {
                    let mut segment = EthercatSegment::from(plan.clone());
                    for drive in &mut segment.drives {
                        (drive.home_turns, drive.ramps_rpm_s) = (Some(0.03), (60_000, 60_000));
                    }
                    TapLine(Arc::new(Mutex::new((EthercatSim::new(&segment), VecDeque::new()))))
                });
                Box::new(plan)
            }
        }
    }

    /// The same for a world.
    fn simulated(&self) -> Simulated {
        Simulated {
            drives: self.taps.iter().map(|tap| Box::new(tap.clone()) as Box<dyn SimDrive>).collect(),
            segments: self.line.iter().map(|line| Box::new(line.clone()) as Box<dyn SimSegment>).collect(),
            wires: self.wire.iter().map(TapWire::wire).collect(),
        }
    }
}

/// A master of such a machine, from `start` on.
fn master(shape: Shape, held: &mut Held, start: Option<Time>, log: Option<&Log>) -> Simulation {
    let buses = held.buses(shape);
    let options = WorldOptions::default();
    let options = WorldOptions { start: start.unwrap_or(options.start), ..options };
    let proposing = |plan| Box::new(ProposingPlan { plan, seed: 1 }) as Box<dyn BusPlan>;
    let buses = if shape.proposals { buses.into_iter().map(proposing).collect() } else { buses };
    let mut setup = Master::from_plan(plan_of(shape, buses));
    if let Some(log) = log {
        setup = log.of(setup);
    }
    setup.simulate_with(held.simulated(), options).unwrap_or_else(|error| panic!("{error}"))
}

fn plan_of(shape: Shape, buses: Vec<Box<dyn BusPlan>>) -> Plan {
    let reference = (shape.kind == Kind::Kollmorgen && shape.other).then(|| buses[0].name().to_owned());
    let cycle = CyclePlan { reference, period_ns: shape.period_ns, ..CyclePlan::default() };
    Plan { cycle, buses, ..Plan::default() }
}

/// The plan of such a machine.
pub fn plan(shape: Shape) -> Plan {
    plan_of(shape, Held::default().buses(shape))
}

impl Machine {
    /// How the axes of such a machine are judged.
    pub fn scales(shape: Shape) -> Vec<Scale> {
        let plan = plan(shape);
        plan.axes().into_iter().enumerate().map(|(index, plan)| scale(shape, index, plan)).collect()
    }

    /// A machine, whose inputs are in `log`.
    pub fn new(shape: Shape, log: Option<Log>) -> Machine {
        let mut held = Held::default();
        let sim = master(shape, &mut held, None, log.as_ref());
        let plans: Vec<AxisPlan> = sim.plan().axes().into_iter().cloned().collect();
        Machine {
            sim,
            log,
            shape,
            scales: plans.iter().enumerate().map(|(index, plan)| scale(shape, index, plan)).collect(),
            plans,
            addresses: held.taps.iter().map(SimDrive::address).collect(),
            held,
            calls: Vec::new(),
        }
    }

    /// The master's process dies without an end, and another one starts so many milliseconds later.
    pub fn replace_master(&mut self, ms: u64) {
        let now = self.world().now();
        self.calls.clear();
        for tap in &mut self.held.taps {
            let connected = std::mem::take(&mut tap.lock().connected);
            connected.into_iter().for_each(|from| tap.disconnected(now, from));
        }
        self.held.wire.iter().flat_map(|wire| &wire.drives).for_each(|drive| drive.lock().died += 1);
        self.sim = master(self.shape, &mut self.held, Some(now + ms * MS), self.log.as_ref());
    }

    /// One turn of the loop.
    pub fn step(&mut self) {
        self.sim.step();
        self.log.iter().for_each(Log::drain);
    }

    /// The master's computer sleeps, and the drives with it.
    pub fn suspend(&self, ms: u64) {
        self.world().suspend(ms * MS);
    }

    fn world(&self) -> &World {
        self.sim.world()
    }

    fn at_line<R>(&self, f: impl FnOnce(&mut EthercatSim) -> R) -> R {
        self.held.line.as_ref().expect("there is a segment").with(f)
    }

    /// The true state of a drive, in units of its axis.
    pub fn truth(&self, index: usize) -> Truth {
        let now = self.world().now();
        let truth = match self.held.taps.get(index) {
            None if let Some(wire) = &self.held.wire => wire.drives[index].lock().drive.truth(now),
            Some(tap) => match &mut tap.lock().drive {
                Drive::LinMot(drive) => drive.truth(now),
                Drive::Moons(drive) => drive.truth(now),
                Drive::Unidrive(drive) => drive.truth(now),
            },
            None => self.at_line(|line| {
                line.advance(now);
                line.drive(index).expect("there is a drive").truth()
            }),
        };
        let counts = self.plans[index].units.counts_per_unit;
        Truth { position: truth.position / counts, velocity: truth.velocity / counts, ..truth }
    }

    /// What its master did that it must not: a drive ignores what a repetition says otherwise. Others on
    /// its wire speak into its telegrams, whoever their master is. An answer in its name, in the place of one to a
    /// request that it did not receive, ends that request: the drive takes the next one for its repetition, twice if
    /// that is repeated itself. An acyclic request of a master that died is met by the first one of the next master.
    pub fn misuse(&self, index: usize) -> Option<String> {
        let shared = self.held.wire.as_ref()?.drives.get(index)?.lock();
        let misuse = shared.drive.misuse();
        let Misuse { too_early, interrupted, state, changed_retry, acyclic, .. } = misuse;
        let (repeated, met) = (changed_retry.min(2 * shared.forged), acyclic.min(shared.died));
        let excused = too_early + interrupted + state + repeated + met;
        (misuse.total() > excused).then(|| format!("{misuse:?}"))
    }

    pub fn online(&self) -> bool {
        (0..AXES).all(|index| self.sim.feedback(index).link == Link::Online)
    }

    /// Disconnects a drive, or connects it again.
    pub fn plug(&self, index: usize, plugged: bool) {
        match self.addresses.get(index) {
            Some(address) if plugged => drop(self.world().plug(*address)),
            Some(address) => drop(self.world().unplug(*address)),
            None if let Some(wire) = &self.held.wire => wire.drives[index].lock().unplugged = !plugged,
            None => drop(self.world().deafen(LINE, index, !plugged)),
        }
    }

    /// Takes the master's adapter of a serial wire away, or plugs it in again.
    pub fn cut(&self, cut: bool) {
        match cut {
            true => self.world().unplug_port(PORT),
            false => self.world().plug_port(PORT),
        };
    }

    pub fn restart(&self, index: usize) {
        match self.addresses.get(index) {
            Some(address) => drop(self.world().restart(*address)),
            None if self.held.wire.is_some() => drop(self.world().restart_on(PORT, index)),
            None => drop(self.world().restart_slave(LINE, index)),
        }
    }

    /// Opens the hardware enable.
    pub fn open_sto(&self, index: usize, ns: u64) {
        match self.addresses.get(index) {
            Some(address) => drop(self.world().open_sto(*address, ns)),
            None if self.held.wire.is_some() => drop(self.world().open_sto_on(PORT, index, ns)),
            None => drop(self.world().open_sto_of_slave(LINE, index, ns)),
        }
    }

    /// A fault of the drive that can be reset.
    pub fn provoke(&self, index: usize) {
        match self.held.taps.get(index) {
            Some(tap) => match &mut tap.lock().drive {
                Drive::LinMot(drive) => drive.provoke(0x0B),
                // Open motor winding.
                Drive::Moons(drive) => drive.provoke(0x0100),
                Drive::Unidrive(drive) => drive.provoke(40),
            },
            // Its phase current is too large.
            None if let Some(wire) = &self.held.wire => wire.drives[index].lock().drive.provoke(0x2310),
            None => {
                let fault = fieldbeat_ethercat::faults::Fault::FOLLOWING.code;
                self.at_line(|line| line.drive(index).expect("there is a drive").provoke(fault));
            }
        }
    }

    /// A fault by which the drive reacts to the silence of its master, where it has one.
    pub fn silence(&self, index: usize) {
        match self.held.taps.get(index) {
            Some(tap) if let Drive::Unidrive(drive) = &mut tap.lock().drive => drive.provoke(252),
            None if self.held.wire.is_none() => {
                let fault = fieldbeat_ethercat::faults::Fault::SYNCHRONISATION.code;
                self.at_line(|line| line.drive(index).expect("there is a drive").provoke(fault));
            }
            _ => self.provoke(index),
        }
    }

    /// Loses the next datagrams: requests, replies. Frames of a segment are all drives'.
    pub fn lose(&self, index: usize, requests: u32, replies: u32) {
        match self.held.taps.get(index) {
            Some(tap) => tap.lock().lose = [requests, replies],
            None if let Some(wire) = &self.held.wire => wire.drives[index].lock().lose = [requests, replies],
            None => self.plug(index, requests + replies == 0),
        }
    }

    /// Repeats a request of long ago at the drive, so many microseconds from now.
    pub fn repeat_request(&self, index: usize, motion: bool, back: usize, us: u64) {
        if let Some(wire) = &self.held.wire {
            // On a serial wire nothing comes late: another master, or requests that arrive broken.
            let at = self.world().now() + us * 1_000;
            match motion {
                true => foreign(back, FIRST_LENZE + index as u8)
                    .iter()
                    .zip(0..)
                    .for_each(|(telegram, n)| wire.voice.say(at + n * 400 * US, telegram)),
                false => wire.drives[index].lock().spoil[0] = back as u32 % 3 + 1,
            }
            return;
        }
        let Some(tap) = self.held.taps.get(index) else {
            // It passes the slaves once more, and returns.
            if let Some(mut frame) = self.frame(back) {
                let now = self.world().now();
                self.at_line(|line| line.pass(now, &mut frame));
                self.world().inject_frame(LINE, &frame, now + us * 1_000);
            }
            return;
        };
        let shared = tap.lock();
        let kept = if motion { &shared.motions } else { &shared.requests };
        let Some(bytes) = kept.get(back).cloned() else { return };
        drop(shared);
        let at = self.world().now() + us * 1_000;
        match self.shape.kind.of(index) {
            Kind::LinMot => self.world().inject(self.addresses[index], MASTER, &bytes, at),
            Kind::Moons => {
                let [scanner, drive] = self.packets_of(index);
                self.world().inject(drive, scanner, &bytes, at);
            }
            Kind::Unidrive | Kind::Kollmorgen | Kind::Lenze | Kind::Mixed => {}
        }
    }

    /// Repeats a reply of long ago at the master, so many microseconds from now.
    pub fn repeat_reply(&self, index: usize, back: usize, us: u64) {
        if let Some(wire) = &self.held.wire {
            // The last answer once more, or answers that arrive broken.
            let mut drive = wire.drives[index].lock();
            match back % 2 {
                0 => {
                    drive.forged += 1;
                    wire.voice.say(self.world().now() + us * 1_000, &drive.answer);
                }
                _ => drive.spoil[1] = back as u32 % 3 + 1,
            }
            return;
        }
        let Some(tap) = self.held.taps.get(index) else {
            if let Some(frame) = self.frame(back) {
                self.world().inject_frame(LINE, &frame, self.world().now() + us * 1_000);
            }
            return;
        };
        let Some(bytes) = tap.lock().replies.get(back).cloned() else { return };
        let at = self.world().now() + us * 1_000;
        match self.shape.kind.of(index) {
            Kind::Moons => {
                let [scanner, drive] = self.packets_of(index);
                self.world().inject(scanner, drive, &bytes, at);
            }
            _ => self.world().inject(MASTER, self.addresses[index], &bytes, at),
        }
    }

    /// A reply of any time before comes to the master, before the next one, which it looks like. Only LinUDP has no
    /// number by which it would be known.
    pub fn old_reply(&self, index: usize, which: usize, us: u64) {
        if self.shape.kind.of(index) != Kind::LinMot {
            return;
        }
        let Some(tap) = self.held.taps.get(index) else { return };
        let shared = tap.lock();
        let all = shared.states.values().flatten().chain(&shared.old);
        let shape = SHAPES[usize::from(self.shape.other)] - 1;
        let alike = shared.replies.get(shape).and_then(|reply| Response::parse(reply).ok());
        let Some((old, alike)) = all.clone().nth(which % all.count().max(1)).copied().zip(alike) else {
            return;
        };
        drop(shared);
        let Response { request_def, response_def, config, .. } = alike;
        let mut bytes = [0; 64];
        let size = Response { request_def, response_def, config, ..old }.emit(&mut bytes);
        // It is sent at the grid point, and answered 40 us later.
        let at = self.world().now() + self.shape.period_ns + us % 40 * US;
        self.world().inject(MASTER, self.addresses[index], &bytes[..size], at);
    }

    /// Frames of a tool on a segment, and datagrams of another sender: if they may move or stop a drive until this
    /// master has seen that it is not alone, or keep its setpoints from it, for how many turns it cannot be reached.
    /// What another sender says to a MOONS' is of another connection, and does nothing, and nor does a reply of another
    /// sender.
    pub fn foreign(&self, index: usize, which: usize, us: u64) -> Option<u64> {
        let at = self.world().now() + us * 1_000;
        match self.shape.kind.of(index) {
            Kind::Kollmorgen => {
                self.tool(index, which, at);
                // Its outputs are where the tool left them, until its watchdog ends them.
                Some(if which % TOOLS == OUTPUTS_CUT { WATCHDOG } else { 0 })
            }
            Kind::LinMot => self.other_sender(index, which, at),
            Kind::Moons => {
                let [scanner, drive] = self.packets_of(index);
                let shared = self.held.taps[index].lock();
                let kept = if which.is_multiple_of(2) { &shared.motions } else { &shared.replies };
                let mut bytes = kept.get(which / 4).cloned()?;
                drop(shared);
                let elsewhere = SocketAddrV4::new(ELSEWHERE, PACKET_PORT);
                let other = (which / 2).is_multiple_of(2);
                if other {
                    bytes[CONNECTION] ^= 0x55;
                }
                let [to, from] = if which.is_multiple_of(2) { [drive, scanner] } else { [scanner, drive] };
                self.world().inject(to, if other { from } else { elsewhere }, &bytes, at);
                None
            }
            Kind::Unidrive | Kind::Lenze | Kind::Mixed => None,
        }
    }

    /// A request of another master to a LinMot, or a reply of another drive to this master.
    fn other_sender(&self, index: usize, which: usize, at: Time) -> Option<u64> {
        let elsewhere = SocketAddrV4::new(ELSEWHERE, MASTER.port());
        let shared = self.held.taps[index].lock();
        let [reply, motion] = [&shared.replies, &shared.motions].map(|kept| kept.get(which / 4).cloned());
        drop(shared);
        let (velocity, ramp) = (Velocity(10_000), Acceleration(100_000));
        let target = Position(100_000 * (which as i32 % 19));
        let go = MotionCommand::vai_go_to(target, velocity, ramp, ramp).block((which % 16) as u8);
        let words = [ControlWord::BASE, ControlWord::QUICK_STOP, ControlWord::ABORT, ControlWord::ON];
        let request = match which % 4 {
            0 => {
                if let Some(reply) = reply {
                    self.world().inject(MASTER, elsewhere, &reply, at);
                }
                return None;
            }
            1 => {
                if let Some(motion) = motion {
                    self.world().inject(self.addresses[index], elsewhere, &motion, at);
                }
                return Some(0);
            }
            2 => Request { motion: Some(go), ..Request::default() },
            _ => Request { control: Some(words[which / 4 % 4]), ..Request::default() },
        };
        let request = Request { response_def: ResponseDef::CYCLIC, ..request };
        let mut bytes = [0; 64];
        let size = request.emit(&mut bytes);
        self.world().inject(self.addresses[index], elsewhere, &bytes[..size], at);
        Some(0)
    }

    /// A tool writes over the segment once; its frames come to this master, too, or not.
    fn tool(&self, place: usize, which: usize, at: Time) {
        use fieldbeat_ethercat::wire::frame::Command::Aprd;
        use fieldbeat_ethercat::wire::frame::Command::Apwr;
        use fieldbeat_ethercat::wire::frame::Command::Brd;
        use fieldbeat_ethercat::wire::frame::Command::Bwr;
        use fieldbeat_ethercat::wire::frame::position;
        let place = position(place as u16);
        let pass = |command, data: &[u8]| {
            let mut frame = frame([0x30; 6], command, data);
            let now = self.world().now();
            self.at_line(|line| line.pass(now, &mut frame));
            if which >= TOOLS {
                self.world().inject_frame(LINE, &frame, at);
            }
            frame
        };
        let state = |state: AlState| AlStatus::request(state).0.to_le_bytes();
        drop(match which % TOOLS {
            0 => pass(Brd(register::AL_STATUS), &[0; 2]),
            1 => pass(Apwr(place, register::AL_CONTROL), &state(AlState::SafeOp)),
            2 => pass(Apwr(place, register::AL_CONTROL), &state(AlState::Init)),
            3 => pass(Bwr(register::AL_CONTROL), &state(AlState::PreOp)),
            OUTPUTS_CUT => pass(Apwr(place, register::fmmu(0)), &[0; 16]),
            // Without the other state the drive would go on with its last outputs, and no frame would show it: the
            // memory behind the SyncManager is written all the same.
            5 => {
                pass(Apwr(place, register::sync_manager(2)), &[0; 8]);
                pass(Apwr(place, register::AL_CONTROL), &state(AlState::SafeOp))
            }
            _ => {
                // It drives the outputs of the slave itself: enabled, and setpoints of any size.
                let manager = pass(Aprd(place, register::sync_manager(2)), &[0; 8]);
                let word = |at: usize| u16::from_le_bytes([manager[DATA + at], manager[DATA + at + 1]]);
                let (start, length) = (word(0), usize::from(word(2)).clamp(2, 64));
                let mut outputs = vec![which as u8; length];
                outputs[..2].copy_from_slice(&[0x0F, 0]);
                pass(Apwr(place, start), &outputs)
            }
        });
    }

    /// Where the packets of the master and of its drive come from.
    fn packets_of(&self, index: usize) -> [SocketAddrV4; 2] {
        [SCANNER, *self.addresses[index].ip()].map(|ip| SocketAddrV4::new(ip, PACKET_PORT))
    }

    fn frame(&self, back: usize) -> Option<Vec<u8>> {
        self.held.line.as_ref()?.0.lock().unwrap().1.get(back).cloned()
    }

    /// Posts a write, and does not wait for it. What the notation refuses was refused.
    pub fn write(&mut self, index: usize, address: &str, value: &str) {
        let acyclic = self.sim.acyclics()[index].clone();
        let notation = acyclic.notation();
        // A count, or a value with a point.
        let raw = notation.value(address, value).or_else(|_| notation.in_unit(address, value));
        let raw = raw.unwrap_or_else(|error| panic!("{address}: {error}"));
        if let Ok(call) = notation.write(address, raw)
            && let Ok(ticket) = acyclic.post(call, Duration::from_millis(300))
        {
            self.calls.push(ticket);
        }
    }

    /// Lets so many slots pass before the next cycle.
    pub fn skip(&self, slots: u32) {
        let period_ns = self.shape.period_ns;
        self.world().delay_next_wake(u64::from(slots) * period_ns + period_ns / 2);
    }
}

fn scale(shape: Shape, index: usize, plan: &AxisPlan) -> Scale {
    let index = if shape.alike { 1 } else { index };
    let velocity = plan.limits.velocity.expect("every axis here has a limit");
    let scale = Scale {
        velocity,
        acceleration: plan.profile.acceleration,
        still: 2.0 * plan.stop.standstill,
        near: 0.3,
        positions: true,
        velocities: true,
        torques: false,
        homes: true,
        replies_again: shape.kind.of(index) == Kind::LinMot,
        report_turns: report_turns(shape, index),
    };
    match (shape.kind.of(index), index) {
        (Kind::LinMot | Kind::Mixed, _) => scale,
        (Kind::Moons, _) => Scale { near: 0.02, still: 0.3, ..scale },
        (Kind::Unidrive | Kind::Lenze, _) => Scale { positions: false, homes: false, ..scale },
        // A position controller of 60 Hz comes to rest for a while.
        (Kind::Kollmorgen, 0) => Scale { near: 0.02, still: 0.6, ..scale },
        (Kind::Kollmorgen, 1) => Scale { positions: false, still: 0.3, ..scale },
        (Kind::Kollmorgen, _) => {
            Scale { positions: false, velocities: false, torques: true, still: 0.3, ..scale }
        }
    }
}

/// A round of requests to a Unidrive reads status and speed, which make a report, and something else; each second
/// request looks for another master meanwhile. One block has all of that, and so has any other drive's exchange.
fn report_turns(shape: Shape, index: usize) -> u32 {
    if shape.kind.of(index) != Kind::Unidrive {
        return 1;
    }
    let mapping = Mapping::new(&unidrive(index, shape)).expect("it has a mapping");
    if mapping.reads().len() == 1 { 1 } else { 2 * (mapping.hot() as u32 + 1) }
}

/// Whether limits of the position hold it in.
pub fn range(limits: &Limits) -> Option<(f64, f64)> {
    limits.position
}
