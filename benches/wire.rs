//! The nanoseconds of one exchange without a socket: drive machine, encode, station and decode, for an axis in
//! operation.
//!
//! - `exchange`: what the loop does for a drive and cycle: choose what is desired, build the request in place, note
//!   that it was sent, take the reply in (identity, states, units, feedback, native process data), follow the command.
//! - `encode`, `encode motion`, `decode`: the telegram alone.
//!
//! A Unidrive's exchange is one request with function 23: everything cyclic is in menu 0.
//!
//! A MOONS' drive answers nothing: its exchange is a packet to it and one from it, as its own clock sends them.
//!
//! A Kollmorgen drive has no telegram of its own: one frame serves the segment. Its exchange is a whole cycle of the
//! bus (build the frame, hand it over, take it in, give each drive its part), shared by the drives of the segment.
//!
//! A Lenze drive's exchange is what a LinMot's is: its telegram is written in place and its answer taken in, without
//! the wire. Its `turn` on the wire comes with the queue, the link layer, Global_Control and the token: a cycle of a
//! wire whose four drives are due in each (12 Mbit/s), shared by them.
//!
//! Positions or speeds change with every reply, and the cycle with every request, so that nothing can be computed
//! beforehand.

#[allow(dead_code, reason = "each bench uses a part of it")]
mod support;

use std::hint::black_box;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use criterion::{Criterion, Throughput};
use fieldbeat::Cycle;
use fieldbeat::axis::{Command, Jog, Link, State};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, Inputs, Outputs};
use fieldbeat::bus::linudp::motion::{Acceleration, MotionCommand, Position, Velocity};
use fieldbeat::bus::linudp::{ControlWord, ErrorCode, MainState, Native, StateVar, StatusWord, WarnWord};
use fieldbeat::bus::modbus::ControlWord as UnidriveControl;
use fieldbeat::telemetry::Counters;
use fieldbeat::time::{MS, Time, US};
use fieldbeat_core::axis::acyclic::AcyclicEnds;
use fieldbeat_core::axis::doorbell::Bells;
use fieldbeat_core::bus::{Bus, Ends, Exchange, Grid, Notes, Opened, Slot};
use fieldbeat_core::drive::machine::Machine;
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::net::Frames;
use fieldbeat_ethercat as ethercat;
use fieldbeat_ethercat::wire::frame::FRAME_MAX;
use fieldbeat_ethernet_ip as ethernet_ip;
use fieldbeat_ethernet_ip::exchange;
use fieldbeat_ethernet_ip::exchange::{Connection, News, SessionEnd};
use fieldbeat_ethernet_ip::wire::io::{OUTGOING_MAX, Outgoing, Packet};
use fieldbeat_linudp as linudp;
use fieldbeat_linudp::station::Station;
use fieldbeat_linudp::wire::{REQUEST_MAX, RESPONSE_MAX, Request, RequestDef, Response, ResponseDef};
use fieldbeat_modbus as modbus;
use fieldbeat_modbus::handshake::{Finding, Found};
use fieldbeat_modbus::wire::{
    ADU_MAX, Header, Registers, RegistersBuffer, Request as ModbusRequest, Response as ModbusResponse,
};
use fieldbeat_profibus as profibus;
use fieldbeat_profibus::DATA_MAX;
use fieldbeat_profibus::line::Answer;
use fieldbeat_profibus::wire::sap::Service;
use fieldbeat_profibus::wire::telegram;
use fieldbeat_profibus::wire::telegram::{Next, Telegram};
use serde_json::{Value, json};
use support::callgrind::{counted as collected, paused};
use support::count::{self, Ran, Scenario};
use support::counted::CountedNet;
use support::lenze::{self, NullSerial, NullWires};
use support::rig::Calls;
use support::segment::{self, NullSegment, NullSegments, Settled};
use support::stats::Interval;
use support::unidrive::{self, Canned};
use support::{Args, Report, fleet, moons, rig, shown};

/// Drives of the segment; the frame of a single one is measured too.
const SEGMENT: usize = 16;
const PERIOD_NS: u64 = MS;
/// A shared machine makes it slower, never quicker: of so many rounds the quickest counts.
const ROUNDS: usize = 12;
const QUICK_ROUNDS: usize = 5;
/// The parts that are measured.
const LINUDP: [&str; 4] = ["exchange", "encode", "encode motion", "decode"];
const MODBUS: [&str; 4] = ["exchange", "drive", "encode", "decode"];
const ETHERCAT: [&str; 4] = ["exchange", "drive", "exchange of one", "drive of one"];
const ETHERNET_IP: [&str; 4] = ["exchange", "drive", "encode", "decode"];
const PROFIBUS: [&str; 6] = ["exchange", "drive", "turn", "drive of a turn", "encode", "decode"];

/// The next cycle, and when its request goes out.
fn advance(cycle: &mut Cycle) -> Time {
    cycle.index += 1;
    cycle.grid = cycle.grid + PERIOD_NS;
    cycle.deadline = cycle.grid + PERIOD_NS / 2;
    cycle.grid + 5 * US
}

/// The machine of drive `index`.
fn machine(plan: &dyn BusPlan, index: usize) -> Machine {
    let grid = Grid { period_ns: PERIOD_NS, deadline_ns: PERIOD_NS / 2 };
    Machine::new(plan.axes()[index], plan.facts(grid).drives[index].capabilities, PERIOD_NS)
}

/// A request has gone out.
fn commit(machine: &mut Machine, slot: &mut Slot) {
    if let Some(grid) = slot.gone.grid.take() {
        machine.commit(grid);
    }
}

/// The reports of a cycle, which are cleared as the loop does.
fn observe(machine: &mut Machine, grid: Time, slot: &mut Slot) {
    machine.observe(grid, false, slot);
    slot.notices.fresh = false;
}

const BEGIN: Cycle = Cycle { index: 0, grid: Time(0), period_ns: PERIOD_NS, deadline: Time(PERIOD_NS / 2) };

/// A station, and a drive that answers it from memory.
struct Exchanged {
    machine: Machine,
    station: Station,
    /// Kept, as an application would.
    _native: Native,
    slot: Slot,
    request: [u8; REQUEST_MAX],
    reply: [u8; RESPONSE_MAX],
    /// What the drive reports.
    state: MainState,
    cycle: Cycle,
}

impl Exchanged {
    /// An axis in operation and moving.
    fn operational() -> Exchanged {
        let address = Ipv4Addr::new(127, 90, 1, 10);
        let plan = linudp::LinUdpPlan::new(Ipv4Addr::LOCALHOST, vec![fleet::linmot(address)]);
        let (station, native, _acyclic) = Station::new(&plan.drives[0], &InputLog::default());
        let mut exchanged = Exchanged {
            machine: machine(&plan, 0),
            station,
            _native: native,
            slot: Slot { due: true, link: Link::Online, ..Slot::default() },
            request: [0; REQUEST_MAX],
            reply: [0; RESPONSE_MAX],
            state: MainState::READY_TO_SWITCH_ON,
            cycle: BEGIN,
        };
        exchanged.turn();
        exchanged.machine.start(exchanged.cycle.grid, Some(Command::Enable));
        (0..3).for_each(|_| exchanged.turn());
        exchanged.state = MainState::OPERATION_ENABLED;
        (0..3).for_each(|_| exchanged.turn());
        assert_eq!(exchanged.slot.status.state, State::OperationEnabled);
        assert_eq!(exchanged.machine.end(), Some(Ok(())));
        exchanged
    }

    /// One exchange.
    fn turn(&mut self) {
        let sent_at = advance(&mut self.cycle);
        self.machine.propose(self.cycle.grid, &mut self.slot);
        let length = self.station.prepare(&self.cycle, &mut self.slot, &mut self.request);
        let request = black_box(&self.request[..length]);
        self.station.sent(sent_at, &self.cycle, &mut self.slot);
        commit(&mut self.machine, &mut self.slot);
        let length = paused(|| {
            let request = Request::parse(request).expect("a request");
            let position = (self.cycle.index as i32).wrapping_mul(100);
            let reply = reply(request.definition(), request.response_def, self.state);
            Response { actual: Some(position), ..reply }.emit(&mut self.reply)
        });
        let reply = black_box(&self.reply[..length]);
        self.station.take(sent_at + 40 * US, reply, true, &mut self.slot);
        observe(&mut self.machine, self.cycle.grid, &mut self.slot);
        black_box(&self.slot);
    }
}

fn reply(request_def: RequestDef, response_def: ResponseDef, state: MainState) -> Response {
    let operating = state == MainState::OPERATION_ENABLED;
    let on = StatusWord::OPERATION_ENABLED | StatusWord::SWITCH_ON_ACTIVE | StatusWord::MOTION_ACTIVE;
    let sub = if operating { StateVar::MOTION_ACTIVE | StateVar::HOMED } else { 0 };
    Response {
        request_def,
        response_def,
        // The hardware enable is there.
        status: Some(StatusWord(
            StatusWord::HOMED | StatusWord::VOLTAGE_ENABLE | if operating { on } else { 0 },
        )),
        state: Some(StateVar::new(state, sub)),
        actual: Some(123_456),
        demand: Some(123_500),
        current: Some(250),
        warn: response_def.contains(ResponseDef::WARN).then(WarnWord::default),
        error: Some(ErrorCode(0)),
        monitor: response_def.contains(ResponseDef::MONITOR).then_some([0; 4]),
        ..Response::default()
    }
}

/// The station of a Unidrive, and a drive that answers it from memory.
struct Requested {
    machine: Machine,
    station: modbus::station::Station,
    /// Kept, as an application would.
    _native: modbus::Native,
    slot: Slot,
    drive: Canned,
    cycle: Cycle,
}

impl Requested {
    /// An axis in operation and turning.
    fn operational() -> Requested {
        let drive = unidrive::drive(Ipv4Addr::new(127, 90, 1, 10));
        let found = Arc::new(Found::default());
        found.set(Finding {
            unit: 255,
            menu_0: true,
            obeys: true,
            watched: true,
            control: UnidriveControl(0),
            ..Finding::default()
        });
        let mappings = unidrive::mappings(&drive);
        let (station, native, _acyclic) =
            modbus::station::Station::new(&drive, mappings, found, &InputLog::default());
        let slot = Slot { due: true, link: Link::Online, ..Slot::default() };
        let machine = machine(&modbus::ModbusPlan::new(vec![drive]), 0);
        let mut requested =
            Requested { machine, station, _native: native, slot, drive: Canned::new(), cycle: BEGIN };
        requested.station.connected(&mut requested.slot);
        requested.turn();
        requested.machine.start(requested.cycle.grid, Some(Command::Enable));
        (0..5).for_each(|_| requested.turn());
        assert_eq!(requested.slot.status.state, State::OperationEnabled);
        assert_eq!(requested.machine.end(), Some(Ok(())));
        requested.machine.start(requested.cycle.grid, Some(Command::Velocity { acceleration: 1_000.0 }));
        (0..5).for_each(|_| requested.turn());
        assert_eq!(requested.machine.end(), None, "it goes on following");
        requested
    }

    /// One exchange with a drive that takes everything.
    fn turn(&mut self) {
        self.exchange(Canned::answer);
    }

    /// One exchange; `answer` is the drive's part of it. It is measured too, but not counted.
    #[inline]
    fn exchange(&mut self, answer: impl FnOnce(&mut Canned, &mut [u8]) -> usize) {
        let sent_at = advance(&mut self.cycle);
        // Another reference each time, as far as the ramp allows.
        self.machine.input.level = 10.0 + (self.cycle.index % 4) as f64 * 0.25;
        self.machine.propose(self.cycle.grid, &mut self.slot);
        self.station.prepare(&self.cycle, &mut self.slot);
        let request = black_box(self.station.to_send());
        let count = request.len();
        assert!(paused(|| self.drive.hear(request)), "it is a request to all of it");
        self.station.sent(sent_at, count, &self.cycle, &mut self.slot);
        commit(&mut self.machine, &mut self.slot);
        let count = paused(|| answer(&mut self.drive, black_box(self.station.room())));
        let taken = self.station.take(sent_at + 40 * US, count, &mut self.slot);
        assert!(taken.is_ok() && matches!(self.slot.exchange, Exchange::Answered { .. }));
        observe(&mut self.machine, self.cycle.grid, &mut self.slot);
        black_box(&self.slot);
    }
}

/// The same exchange without its station.
struct BareExchange {
    velocity: f64,
    drive: Canned,
    request: Vec<u8>,
    room: [u8; ADU_MAX],
    cycle: Cycle,
}

impl BareExchange {
    fn new(request: &[u8]) -> BareExchange {
        BareExchange {
            velocity: 0.0,
            drive: Canned::new(),
            request: request.to_vec(),
            room: [0; ADU_MAX],
            cycle: BEGIN,
        }
    }

    #[inline]
    fn exchange(&mut self) {
        let sent_at = advance(&mut self.cycle);
        self.velocity = 10.0 + (self.cycle.index % 4) as f64 * 0.25;
        let request = black_box(&self.request);
        assert!(self.drive.hear(request), "it is a request to all of it");
        black_box((sent_at, self.drive.answer_again(black_box(&mut self.room))));
        black_box(&self.velocity);
    }
}

/// The station of a MOONS' drive, and a drive that sends to it from memory.
struct Clocked {
    machine: Machine,
    station: ethernet_ip::station::Station,
    /// Kept, as an application and a session would.
    _others: (ethernet_ip::Native, SessionEnd),
    slot: Slot,
    drive: moons::Canned,
    source: Ipv4Addr,
    packet: [u8; OUTGOING_MAX],
    cycle: Cycle,
}

impl Clocked {
    /// The connection's id of the drive's packets.
    const INCOMING: u32 = 0x1234_0000;

    /// An axis in operation and jogging.
    fn operational() -> Clocked {
        let address = Ipv4Addr::new(127, 90, 1, 10);
        let plan = EthernetIpPlan::new(Ipv4Addr::LOCALHOST, vec![moons::drive(address)]);
        let drive = &plan.drives[0];
        let (loop_end, mut session_end) = exchange::both(Bells::new(1).bell(0));
        let (station, native) =
            ethernet_ip::station::Station::new(drive, PERIOD_NS, loop_end, &InputLog::default());
        let has_room = session_end.tell(News::Opened(Connection {
            generation: 1,
            outgoing: 0x42,
            incoming: Clocked::INCOMING,
            destination: SocketAddrV4::new(address, ethernet_ip::IO_PORT),
            source: address,
            outgoing_api_ns: PERIOD_NS,
            incoming_api_ns: PERIOD_NS,
            timeout_ns: drive.input_timeout_ns(PERIOD_NS),
            outputs: exchange::Outputs::Owned,
            version: ethernet_ip::Version::V2,
            layout: ethernet_ip::Layout::Manual,
        }));
        assert!(has_room, "there is room");
        let mut clocked = Clocked {
            machine: machine(&plan, 0),
            station,
            _others: (native, session_end),
            slot: Slot { due: true, link: Link::Online, ..Slot::default() },
            drive: moons::Canned::new(moons::first(Clocked::INCOMING)),
            source: address,
            packet: [0; OUTGOING_MAX],
            cycle: BEGIN,
        };
        let opened = clocked.station.hear(&clocked.cycle, &mut clocked.slot);
        assert!(opened.is_some(), "it is open");
        (0..5).for_each(|_| clocked.turn());
        clocked.machine.start(clocked.cycle.grid, Some(Command::Enable));
        (0..10).for_each(|_| clocked.turn());
        assert_eq!(clocked.slot.status.state, State::OperationEnabled);
        assert_eq!(clocked.machine.end(), Some(Ok(())));
        let jog = Command::Jog(Jog { velocity: 1.0, acceleration: 100.0 });
        clocked.machine.start(clocked.cycle.grid, Some(jog));
        (0..20).for_each(|_| clocked.turn());
        assert!(clocked.slot.status.moving && clocked.slot.evidence.refused.is_none());
        clocked.slot.counters = Counters::default();
        clocked
    }

    /// One cycle of both clocks.
    #[inline]
    fn turn(&mut self) {
        let sent_at = advance(&mut self.cycle);
        self.machine.propose(self.cycle.grid, &mut self.slot);
        let length = self.station.prepare(&self.cycle, &mut self.slot, &mut self.packet);
        let length = length.expect("it is open");
        let packet = black_box(&self.packet[..length]);
        self.station.sent(sent_at, &self.cycle, &mut self.slot);
        commit(&mut self.machine, &mut self.slot);
        let bytes = paused(|| {
            self.drive.hear(packet);
            self.drive.say()
        });
        let packet = Packet::parse(black_box(bytes)).expect("a packet");
        assert!(self.station.is(self.source, packet.connection));
        self.station.take(sent_at + 40 * US, &packet, &mut self.slot);
        // It was accepted.
        self.slot.counters.answered += u64::from(self.slot.notices.fresh);
        observe(&mut self.machine, self.cycle.grid, &mut self.slot);
        black_box(&self.slot);
    }
}

/// The time of the buses in memory.
static BUS_NOW: AtomicU64 = AtomicU64::new(0);

fn bus_now() -> Time {
    Time(BUS_NOW.load(Ordering::Relaxed))
}

/// A bus whose drives all follow a velocity, answered from memory.
struct Following {
    bus: Box<dyn Bus>,
    notes: Option<Arc<dyn Notes>>,
    _ends: Ends,
    machines: Vec<Machine>,
    slots: Vec<Slot>,
    cycle: Cycle,
}

impl Following {
    /// All axes in operation and turning; `turn` is a cycle of it.
    fn operational(plan: &dyn BusPlan, opened: Opened, turn: fn(&mut Following)) -> Following {
        let Opened { bus, notes, ends: _ends, .. } = opened;
        let drives = plan.axes().len();
        let slot = Slot { due: true, link: Link::Online, ..Slot::default() };
        let machines = (0..drives).map(|index| machine(plan, index)).collect();
        let slots = vec![slot; drives];
        let mut following = Following { bus, notes, _ends, machines, slots, cycle: BEGIN };
        following.cycle.grid = Time(1_000 * PERIOD_NS);
        following.bus.prepare(&following.cycle, &mut following.slots);
        following.until("in operation", turn, |slot, _| slot.status.at > Time(0));
        following.start(Command::Enable);
        following.until("enabled", turn, |_, machine| machine.end() == Some(Ok(())));
        following.start(Command::Velocity { acceleration: 100.0 });
        (0..5_000).for_each(|_| turn(&mut following));
        for (slot, machine) in following.slots.iter().zip(&following.machines) {
            assert_eq!(slot.status.state, State::OperationEnabled);
            assert_eq!(machine.end(), None, "it goes on following");
        }
        following.slots.iter_mut().for_each(|slot| slot.counters = Counters::default());
        following
    }

    fn start(&mut self, command: Command) {
        let now = self.cycle.grid;
        self.machines.iter_mut().for_each(|machine| machine.start(now, Some(command)));
    }

    fn until(&mut self, what: &str, turn: fn(&mut Following), done: impl Fn(&Slot, &Machine) -> bool) {
        for _ in 0..100_000 {
            turn(self);
            if self.slots.iter().zip(&self.machines).all(|(slot, machine)| done(slot, machine)) {
                return;
            }
        }
        panic!("the drives are not {what}: {:?}", self.notes.as_ref().and_then(|notes| notes.get(0)));
    }

    /// What was sent and answered since the last time.
    fn take_counters(&mut self) -> Counters {
        let mut all = Counters::default();
        for slot in &mut self.slots {
            let Counters { sent, answered, .. } = std::mem::take(&mut slot.counters);
            (all.sent, all.answered) = (all.sent + sent, all.answered + answered);
        }
        all
    }

    /// One cycle of a segment, with what the loop does to its slots.
    #[inline]
    fn turn_of_segment(&mut self) {
        let sent_at = advance(&mut self.cycle);
        BUS_NOW.store(sent_at.0, Ordering::Relaxed);
        self.bus.send(&self.cycle, &mut self.slots);
        for (machine, slot) in self.machines.iter_mut().zip(&mut self.slots) {
            commit(machine, slot);
        }
        BUS_NOW.store(sent_at.0 + 40 * US, Ordering::Relaxed);
        self.bus.receive(&self.cycle, &mut self.slots);
        let velocity = 10.0 + (self.cycle.index % 4) as f64 * 0.25;
        let mut next = self.cycle;
        advance(&mut next);
        for (machine, slot) in self.machines.iter_mut().zip(&mut self.slots) {
            slot.exchange = Exchange::Idle;
            observe(machine, self.cycle.grid, slot);
            // Another velocity each time, as far as the ramp allows.
            machine.input.level = velocity;
            machine.propose(next.grid, slot);
        }
        self.bus.prepare(&next, &mut self.slots);
        black_box(&self.slots);
    }

    /// One cycle of a wire, with what the loop does to its slots, and its window.
    #[inline]
    fn turn_of_wire(&mut self) {
        let sent_at = advance(&mut self.cycle);
        BUS_NOW.store(sent_at.0, Ordering::Relaxed);
        self.bus.send(&self.cycle, &mut self.slots);
        loop {
            if rig::is_reply_waiting() {
                BUS_NOW.fetch_add(40 * US, Ordering::Relaxed);
                self.bus.receive(&self.cycle, &mut self.slots);
            }
            match self.bus.waits(&self.cycle, &self.slots).poll_at {
                at if at < self.cycle.deadline => {
                    if rig::is_reply_waiting() {
                        continue;
                    }
                    BUS_NOW.store(at.0, Ordering::Relaxed);
                    self.bus.poll(&self.cycle, at, &mut self.slots);
                }
                _ => break,
            }
        }
        let velocity = 10.0 + (self.cycle.index % 4) as f64 * 0.25;
        let mut next = self.cycle;
        advance(&mut next);
        for (machine, slot) in self.machines.iter_mut().zip(&mut self.slots) {
            commit(machine, slot);
            slot.exchange = Exchange::Idle;
            observe(machine, self.cycle.grid, slot);
            // Another velocity each time, as far as the ramp allows.
            machine.input.level = velocity;
            machine.propose(next.grid, slot);
        }
        self.bus.prepare(&next, &mut self.slots);
        black_box(&self.slots);
    }
}

/// A segment with so many drives, and what its frame has settled to.
fn segment_of(drives: usize) -> (Following, Settled) {
    let plan = segment::plan("local:wire", drives, 0);
    let settled = Settled::default();
    let segments = NullSegments(plan.clone(), bus_now, Settled::clone(&settled));
    let segments = CountedNet::over(segments, &Calls::default());
    let bus = BusPlan::open(&plan, PERIOD_NS, &segments).expect("a segment in memory");
    (Following::operational(&plan, bus, Following::turn_of_segment), settled)
}

/// A wire with so many drives, each due in every cycle.
fn wire_of(drives: usize) -> Following {
    let plan = lenze::plan("local:wire", 0, drives);
    let wires = CountedNet::over(NullWires(vec![plan.clone()], bus_now), &Calls::default());
    let bus = BusPlan::open(&plan, PERIOD_NS, &wires).expect("a wire in memory");
    let wire = Following::operational(&plan, bus, Following::turn_of_wire);
    wire.slots.iter().for_each(|slot| assert!(slot.status.velocity > 9.0, "{:?}", slot.status));
    wire
}

/// The same cycle without its bus: the segment that takes a frame and gives it back, and the application.
struct Unlinked {
    segment: NullSegment,
    frame: Vec<u8>,
    room: Box<[u8; FRAME_MAX]>,
    slots: Vec<Slot>,
    cycle: Cycle,
}

impl Unlinked {
    fn new((linked, settled): &(Following, Settled)) -> Unlinked {
        let (frame, _) = settled.get().expect("it is in operation");
        Unlinked {
            segment: NullSegment::settled(settled, bus_now),
            frame: frame.clone(),
            room: Box::new([0; FRAME_MAX]),
            slots: linked.slots.clone(),
            cycle: linked.cycle,
        }
    }

    #[inline]
    fn turn(&mut self) {
        let sent_at = advance(&mut self.cycle);
        BUS_NOW.store(sent_at.0, Ordering::Relaxed);
        let _ = black_box(self.segment.send(black_box(&self.frame)));
        BUS_NOW.store(sent_at.0 + 40 * US, Ordering::Relaxed);
        let _ = black_box(self.segment.receive(black_box(&mut self.room[..])));
        let velocity = 10.0 + (self.cycle.index % 4) as f64 * 0.25;
        for slot in &mut self.slots {
            slot.exchange = Exchange::Idle;
            black_box(velocity);
        }
        black_box(&self.slots);
    }
}

/// The station of a Lenze drive, and a drive that answers it from memory.
struct Addressed {
    machine: Machine,
    station: profibus::station::Station,
    /// Kept, as an application would.
    _ends: (profibus::Native, AcyclicEnds),
    slot: Slot,
    drive: NullSerial,
    request: telegram::Buffer,
    answer: telegram::Buffer,
    cycle: Cycle,
}

impl Addressed {
    /// An axis in operation and jogging; its actual value is another one in each answer.
    fn operational() -> Addressed {
        let plan = lenze::plan("local:station", 0, 1);
        let (station, native, acyclic) =
            profibus::station::Station::new(&plan.drives[0], plan.address, &InputLog::default())
                .expect("a plan without faults");
        let mut addressed = Addressed {
            machine: machine(&plan, 0),
            station,
            _ends: (native, acyclic),
            slot: Slot { due: true, link: Link::Online, ..Slot::default() },
            drive: NullSerial::new(&plan, bus_now),
            request: [0; telegram::MAX],
            answer: [0; telegram::MAX],
            cycle: BEGIN,
        };
        while addressed.slot.status.at == Time(0) {
            addressed.turn();
        }
        addressed.machine.start(addressed.cycle.grid, Some(Command::Enable));
        (0..20).for_each(|_| addressed.turn());
        assert_eq!(addressed.slot.status.state, State::OperationEnabled);
        assert_eq!(addressed.machine.end(), Some(Ok(())));
        let jog = Command::Jog(Jog { velocity: 1.0, acceleration: 100.0 });
        addressed.machine.start(addressed.cycle.grid, Some(jog));
        (0..20).for_each(|_| addressed.turn());
        assert!(addressed.slot.status.moving && addressed.slot.evidence.refused.is_none());
        addressed.slot.counters = Counters::default();
        addressed
    }

    /// One exchange.
    #[inline]
    fn turn(&mut self) {
        let sent_at = advance(&mut self.cycle);
        self.machine.propose(self.cycle.grid, &mut self.slot);
        self.station.prepare(&self.cycle, &mut self.slot);
        let (length, expected) = self.station.request(&self.slot, true, &mut self.request).expect("a turn");
        let request = black_box(&self.request[..length]);
        self.station.sent(sent_at, self.cycle.deadline, &mut self.slot);
        commit(&mut self.machine, &mut self.slot);
        let count = paused(|| self.drive.answer(request, &mut self.answer));
        let answer = match Next::parse(black_box(&self.answer[..count])) {
            Next::Telegram { telegram: Telegram::Data(frame), .. } if frame.head.sa == expected.da => {
                Answer::Data { high: false, data: frame.data }
            }
            Next::Telegram { telegram: Telegram::Acknowledge, .. } => Answer::Acknowledged,
            other => panic!("{other:?} answers nothing"),
        };
        self.station.answered(sent_at + 40 * US, answer, &mut self.slot);
        observe(&mut self.machine, self.cycle.grid, &mut self.slot);
        black_box(&self.slot);
    }
}

/// What is counted in place of being measured.
const SCENARIOS: [Scenario; 6] = [
    Scenario::of(linudp::PROTOCOL, 1),
    Scenario::of(modbus::PROTOCOL, 1),
    Scenario::of(ethercat::PROTOCOL, SEGMENT),
    Scenario::of(ethernet_ip::PROTOCOL, 1),
    Scenario::of(profibus::PROTOCOL, 1),
    Scenario { part: Some("turns"), ..Scenario::of(profibus::PROTOCOL, lenze::A_WIRE) },
];
/// Exchanges that are counted.
const COUNTED: u64 = 128;

/// The child: exchanges of an axis in operation.
fn counted(scenario: Scenario) -> Ran {
    let count = |turn: &mut dyn FnMut()| {
        count::instrument();
        count::run(COUNTED, || collected(&mut *turn))
    };
    match scenario.protocol {
        linudp::PROTOCOL => {
            let mut exchanged = Exchanged::operational();
            count(&mut || exchanged.turn())
        }
        modbus::PROTOCOL => {
            let mut requested = Requested::operational();
            count(&mut || requested.exchange(Canned::answer_again))
        }
        ethernet_ip::PROTOCOL => {
            let mut clocked = Clocked::operational();
            count(&mut || clocked.turn())
        }
        profibus::PROTOCOL if scenario.part.is_none() => {
            let mut addressed = Addressed::operational();
            count(&mut || addressed.turn())
        }
        profibus::PROTOCOL => {
            let mut wired = wire_of(scenario.drives);
            count(&mut || wired.turn_of_wire())
        }
        _ => {
            let (mut linked, _) = segment_of(scenario.drives);
            count(&mut || linked.turn_of_segment())
        }
    }
}

fn main() -> ExitCode {
    if count::is_child(&SCENARIOS, counted) {
        return ExitCode::SUCCESS;
    }
    let args = Args::parse("wire");
    if args.count {
        return count::gate("wire", &args, &SCENARIOS);
    }
    println!("wire: one exchange without a socket");
    // The resamples are criterion's own arithmetic: with its 100 000 they take longer than what they judge.
    let (warm_up, measurement, resamples) = if args.quick { (50, 250, 5_000) } else { (250, 1_250, 100_000) };
    let protocols = [
        (linudp::PROTOCOL, &LINUDP[..]),
        (modbus::PROTOCOL, &MODBUS[..]),
        (ethercat::PROTOCOL, &ETHERCAT[..]),
        (ethernet_ip::PROTOCOL, &ETHERNET_IP[..]),
        (profibus::PROTOCOL, &PROFIBUS[..]),
    ];
    let mut wired = wire_of(lenze::A_WIRE);
    let mut segments = [SEGMENT, 1].map(segment_of);
    let rounds = if args.quick { QUICK_ROUNDS } else { ROUNDS };
    let mut quickest = [const { Vec::new() }; 5];
    let mut counted = [(0, 0); 5];
    for round in 0..rounds {
        let output = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("criterion/{round}"));
        // A new one each time: one that measures a part again gives it another name, and the first would be read for
        // ever.
        let mut criterion = Criterion::default()
            .output_directory(&output)
            .without_plots()
            .nresamples(resamples)
            .warm_up_time(Duration::from_millis(warm_up))
            .measurement_time(Duration::from_millis(measurement));
        let counters = [
            linudp(&mut criterion),
            modbus(&mut criterion),
            ethercat(&mut criterion, &mut segments),
            ethernet_ip(&mut criterion),
            profibus(&mut criterion, &mut wired),
        ];
        for (place, (protocol, names)) in protocols.iter().enumerate() {
            let found: Vec<_> = names.iter().map(|name| estimate_of(&output, protocol, name)).collect();
            // The whole exchange is the first of them.
            let whole =
                |of: &[Option<Interval>]| of.first().copied().flatten().map_or(f64::MAX, |ns| ns.value);
            if quickest[place].is_empty() || whole(&found) < whole(&quickest[place]) {
                quickest[place] = found;
            }
            counted[place].0 += counters[place].sent;
            counted[place].1 += counters[place].answered;
        }
    }
    let mut report = Report::default();
    println!("\nencode + station + decode, ns, the quickest of {rounds} rounds");
    for (place, (protocol, names)) in protocols.into_iter().enumerate() {
        let of = |wanted: &str| {
            let found = names.iter().position(|name| *name == wanted)?;
            quickest[place].get(found).copied().flatten()
        };
        for name in names {
            let estimate = of(name);
            report.enter(
                format!("{protocol}/{name}"),
                json!({ "ns": estimate.map(|ns| ns.value), "interval": estimate.map(|ns| ns.ends()) }),
            );
        }
        let own = of("exchange").map(|whole| without(whole, of("drive")));
        // All drives of the segment share it.
        let own = if protocol == ethercat::PROTOCOL { own.map(|all| share(all, SEGMENT)) } else { own };
        println!("  {protocol:12} {}", shown(own));
        if let Some(turns) = of("turn") {
            let turn = share(without(turns, of("drive of a turn")), lenze::A_WIRE);
            println!("  {protocol:12} {turn} for a turn with its wire");
        }
        let (sent, answered) = counted[place];
        report.check(format!("{protocol}: sent {sent} = answered {answered}"), sent == answered);
    }
    report.finish(&args)
}

fn linudp(criterion: &mut Criterion) -> Counters {
    let mut group = criterion.benchmark_group("linudp-v2");
    group.throughput(Throughput::Elements(1));
    let mut exchanged = Exchanged::operational();
    group.bench_function("exchange", |bencher| bencher.iter(|| exchanged.turn()));
    let standing =
        Request { response_def: ResponseDef::CYCLIC, control: Some(ControlWord::ON), ..Request::default() };
    let ramp = Acceleration(1_000_000);
    let go_to = MotionCommand::vai_go_to(Position(123_456), Velocity(500_000), ramp, ramp);
    let moving = Request { motion: Some(go_to.block(5)), ..standing };
    let mut bytes = [0; REQUEST_MAX];
    for (name, request) in [("encode", standing), ("encode motion", moving)] {
        group.bench_function(name, |bencher| {
            bencher.iter(|| black_box(&request).emit(black_box(&mut bytes)));
        });
    }
    let mut bytes = [0; RESPONSE_MAX];
    let length =
        reply(RequestDef::CONTROL, ResponseDef::CYCLIC, MainState::OPERATION_ENABLED).emit(&mut bytes);
    group.bench_function("decode", |bencher| bencher.iter(|| Response::parse(black_box(&bytes[..length]))));
    group.finish();
    exchanged.slot.counters
}

fn modbus(criterion: &mut Criterion) -> Counters {
    let mut group = criterion.benchmark_group(modbus::PROTOCOL);
    group.throughput(Throughput::Elements(1));
    let mut requested = Requested::operational();
    group.bench_function("exchange", |bencher| bencher.iter(|| requested.exchange(Canned::answer_again)));
    // What of it is no master's: the drive that receives and answers, the clock, the application.
    let mut around = BareExchange::new(requested.station.to_send());
    group.bench_function("drive", |bencher| bencher.iter(|| around.exchange()));
    let mut data = RegistersBuffer::new();
    for value in [i32::from(UnidriveControl::FORWARD.0), 12_345] {
        data.push_long(value);
    }
    let data: Registers<'_> = data.registers();
    let request = ModbusRequest::ReadWrite { read: 0x4000, count: 12, write: 0x4000, data };
    let header = Header { transaction: 42, unit: 255 };
    let mut bytes = [0; ADU_MAX];
    group.bench_function("encode", |bencher| {
        bencher.iter(|| black_box(&request).emit(black_box(header), black_box(&mut bytes)));
    });
    let length = request.emit(header, &mut bytes);
    let mut drive = Canned::new();
    assert!(drive.hear(&bytes[..length]), "it is a request to all of it");
    let length = drive.answer(&mut bytes);
    let reply = &bytes[..length];
    group.bench_function("decode", |bencher| bencher.iter(|| ModbusResponse::parse(black_box(reply))));
    group.finish();
    requested.slot.counters
}

fn ethercat(criterion: &mut Criterion, segments: &mut [(Following, Settled); 2]) -> Counters {
    let mut group = criterion.benchmark_group(ethercat::PROTOCOL);
    let names = [["exchange", "drive"], ["exchange of one", "drive of one"]];
    let mut counters = Counters::default();
    for (segment, [exchange, drive]) in segments.iter_mut().zip(names) {
        group.throughput(Throughput::Elements(segment.0.slots.len() as u64));
        group.bench_function(exchange, |bencher| bencher.iter(|| segment.0.turn_of_segment()));
        // What of it is no master's.
        let mut unlinked = Unlinked::new(segment);
        group.bench_function(drive, |bencher| bencher.iter(|| unlinked.turn()));
        let Counters { sent, answered, .. } = segment.0.take_counters();
        (counters.sent, counters.answered) = (counters.sent + sent, counters.answered + answered);
    }
    group.finish();
    counters
}

fn ethernet_ip(criterion: &mut Criterion) -> Counters {
    let mut group = criterion.benchmark_group(ethernet_ip::PROTOCOL);
    group.throughput(Throughput::Elements(1));
    let mut clocked = Clocked::operational();
    group.bench_function("exchange", |bencher| bencher.iter(|| clocked.turn()));
    // What of it is no master's: the drive that takes a packet and sends one.
    let (mut drive, packet) = (clocked.drive.clone(), clocked.packet);
    group.bench_function("drive", |bencher| {
        bencher.iter(|| {
            drive.hear(black_box(&packet));
            black_box(drive.say());
        });
    });
    let mut packet = Outgoing::owner(0x42);
    let outputs = Outputs { jog_speed: 240, jog_acceleration: 600, ..Outputs::default() };
    group.bench_function("encode", |bencher| {
        bencher.iter(|| {
            packet.set_outputs(black_box(&outputs));
            packet.set_sequence(black_box(7), 7);
            black_box(packet.bytes());
        });
    });
    let bytes = drive.say();
    group.bench_function("decode", |bencher| {
        bencher.iter(|| {
            let packet = Packet::parse(black_box(bytes)).expect("a packet");
            black_box(Inputs::parse(packet.data, ethernet_ip::Version::V2, ethernet_ip::Layout::Manual))
        });
    });
    group.finish();
    clocked.slot.counters
}

fn profibus(criterion: &mut Criterion, wired: &mut Following) -> Counters {
    let mut group = criterion.benchmark_group(profibus::PROTOCOL);
    group.throughput(Throughput::Elements(1));
    let mut addressed = Addressed::operational();
    group.bench_function("exchange", |bencher| bencher.iter(|| addressed.turn()));
    let plan = lenze::plan("local:alone", 0, lenze::A_WIRE);
    let (mut drives, requests) = (NullSerial::new(&plan, bus_now), lenze::requests(&plan));
    let mut room = [0; telegram::MAX];
    // What of it is no master's: the drive that answers.
    group.bench_function("drive", |bencher| {
        bencher.iter(|| drives.answer(black_box(&requests[0]), black_box(&mut room)))
    });
    let length = drives.answer(&requests[0], &mut room);
    let head = Service::DataExchange.head(plan.drives[0].address, plan.address, true, true);
    let outputs = plan.drives[0].lengths().map_or(0, |(outputs, _)| outputs);
    let mut request = [0; telegram::MAX];
    group.bench_function("encode", |bencher| {
        bencher.iter(|| head.emit(black_box(&[0x7F; DATA_MAX][..outputs]), black_box(&mut request)))
    });
    group.bench_function("decode", |bencher| bencher.iter(|| Next::parse(black_box(&room[..length]))));
    group.throughput(Throughput::Elements(wired.slots.len() as u64));
    group.bench_function("turn", |bencher| bencher.iter(|| wired.turn_of_wire()));
    group.bench_function("drive of a turn", |bencher| {
        bencher.iter(|| {
            for request in &requests {
                black_box(drives.answer(black_box(request), black_box(&mut room)));
            }
        })
    });
    group.finish();
    let mut counters = addressed.slot.counters;
    let Counters { sent, answered, .. } = wired.take_counters();
    (counters.sent, counters.answered) = (counters.sent + sent, counters.answered + answered);
    counters
}

/// The share of one of so many drives.
fn share(all: Interval, drives: usize) -> Interval {
    let of = |ns: f64| ns / drives as f64;
    Interval { value: of(all.value), low: of(all.low), high: of(all.high) }
}

/// What criterion found of this part of a protocol, if it is measured.
fn estimate_of(output: &Path, protocol: &str, name: &str) -> Option<Interval> {
    estimate(&output.join(protocol).join(name).join("new/estimates.json"))
}

/// The whole without the part that is measured for itself.
fn without(whole: Interval, part: Option<Interval>) -> Interval {
    let Some(part) = part else { return whole };
    Interval { value: whole.value - part.value, low: whole.low - part.high, high: whole.high - part.low }
}

/// What criterion found: the median, since a mean on a shared machine is that of its worst moments.
fn estimate(path: &Path) -> Option<Interval> {
    let text = std::fs::read_to_string(path).ok()?;
    let median = &serde_json::from_str::<Value>(&text).ok()?["median"];
    let bound = |name: &str| median["confidence_interval"][name].as_f64();
    Some(Interval {
        value: median["point_estimate"].as_f64()?,
        low: bound("lower_bound")?,
        high: bound("upper_bound")?,
    })
}
