//! A segment of Kollmorgen drives, couplers and terminals in memory: simulated until all of them are in operation, and
//! answered from memory from then on.

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use fieldbeat::axis::{Limits, State};
use fieldbeat::bus::ethercat::{
    Area, Device, EthercatPlan, Expected, Family, KollmorgenDrive, Owner, SlavePlan, Watchdog,
};
use fieldbeat::sim::SimSegment;
use fieldbeat::time::{MS, Time};
use fieldbeat_core::bus::cia402::StatusWord;
use fieldbeat_core::net::frames::{MAC, Unsent};
use fieldbeat_core::net::{Carriers, Datagrams, Frames, UdpOptions};
use fieldbeat_core::rt::{MonotonicClock, Regions};
use fieldbeat_ethercat::wire::frame::{Command, FRAME_MAX, Place, datagrams};
use fieldbeat_sim::ethercat::{EthercatSegment, EthercatSim, Identity, Model, SlaveSettings};

use super::rig::{self, Scene};

/// AL status, in front of the inputs of each slave.
const AL: usize = 2;
const OPERATIONAL: u8 = 8;
/// In both, of a drive with 1B03h: actual position and status word.
const POSITION: usize = 2;
const STATUS: usize = 8;
/// In the status word (CiA 402): target reached, in its high byte; fault, in its low byte.
const TARGET_REACHED: u8 = 0x04;
const FAULT: u8 = 0x18;
/// So many frames in a row all slaves have to be in operation: until the last one of a long segment has read its mode
/// and its reference by the mailbox.
const SETTLED: u32 = 1_000;
/// And so many more at most until one of them looks at no mailbox: on a long segment there is always one to be looked
/// at.
const QUIET: u32 = 200;

/// The couplers and terminals of a segment, again and again: a coupler, digital inputs and outputs, analogue inputs.
const STATION: [Model; 14] = [
    Model::Ek1100,
    Model::El1008,
    Model::El1008,
    Model::El1008,
    Model::El1008,
    Model::El1008,
    Model::El2008,
    Model::El2008,
    Model::El2008,
    Model::El2008,
    Model::El2008,
    Model::El3102,
    Model::El3102,
    Model::El3102,
];

/// A segment of so many drives, as a machine might have it, and so many couplers and terminals behind them.
pub fn plan(interface: &str, drives: usize, terminals: usize) -> EthercatPlan {
    let drive = |place: usize| {
        let mut drive = KollmorgenDrive::new(format!("k{place}"), place as u16, Family::S700);
        drive.slave.watchdog = Watchdog::After(100 * MS);
        drive.axis.limits = Limits { velocity: Some(50.0), ..Limits::default() };
        drive.axis.stop.deceleration = 100.0;
        drive.axis.health.bucket = rig::bucket();
        drive.axis.stop.group = rig::group();
        drive.axis.enable_timeout = Duration::from_secs(60);
        drive
    };
    let mut plan = EthercatPlan::new(interface, (0..drives).map(drive).collect());
    let models = STATION.into_iter().cycle().take(terminals);
    plan.devices = models.enumerate().map(|(index, model)| device((drives + index) as u16, model)).collect();
    plan
}

/// A coupler or a terminal, as in `rt-config/terminals.toml`.
fn device(place: u16, model: Model) -> Device {
    let area = |start, length| vec![Area { start, length }];
    let (outputs, inputs) = match model {
        Model::El1008 => (Vec::new(), area(0x1000, 1)),
        Model::El2008 => (area(0x0F00, 1), Vec::new()),
        Model::El3102 => (Vec::new(), area(0x1180, 8)),
        _ => (Vec::new(), Vec::new()),
    };
    let mailbox = [0x1000, 0x1080].map(|start| Area { start, length: 128 });
    let Identity { vendor, product, .. } = model.identity();
    let identity = Expected { vendor: Some(vendor), product: Some(product), ..Expected::default() };
    let mailbox = (model == Model::El3102).then_some(mailbox);
    let slave = SlavePlan { identity, mailbox, outputs, inputs, ..SlavePlan::new(place) };
    Device { name: format!("t{place}"), slave }
}

/// The same, simulated: couplers and terminals are those that can be bought.
pub fn simulated(plan: &EthercatPlan) -> EthercatSegment {
    let mut segment = EthercatSegment::from(plan);
    for Device { slave, .. } in &plan.devices {
        let Expected { vendor, product, .. } = slave.identity;
        let is_it = |(_, model): &&(&str, Model)| {
            let own = model.identity();
            (vendor, product) == (Some(own.vendor), Some(own.product))
        };
        let model = Model::ALL.iter().find(is_it).map(|(_, model)| *model);
        segment.settings.slaves.insert(slave.place, SlaveSettings { model, ..SlaveSettings::default() });
    }
    segment
}

/// A frame to such a segment once all its drives are in operation, and what it answers.
pub type Settled = Arc<OnceLock<(Vec<u8>, Canned)>>;

/// Opens the segment of a plan in memory, by this clock.
pub struct NullSegments(pub EthercatPlan, pub fn() -> Time, pub Settled);

impl Carriers for NullSegments {
    fn datagrams(&self, _: SocketAddrV4, _: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Err(io::ErrorKind::Unsupported.into())
    }

    fn frames(&self, _: &str, _: u16) -> io::Result<Box<dyn Frames>> {
        Ok(Box::new(NullSegment::new(&self.0, self.1, Settled::clone(&self.2))))
    }
}

/// The master's end of such a segment.
pub struct NullSegment {
    now: fn() -> Time,
    sim: Option<EthercatSim>,
    layout: Layout,
    exchange: Settled,
    settled: u32,
    canned: Option<Canned>,
    frame: Box<[u8; FRAME_MAX]>,
    /// Bytes of the frame that comes back; 0: there is none.
    length: usize,
}

impl NullSegment {
    /// The segment of `plan`, by this clock. It reports when it is settled.
    pub fn new(plan: &EthercatPlan, now: fn() -> Time, exchange: Settled) -> NullSegment {
        NullSegment {
            now,
            sim: Some(EthercatSim::new(&simulated(plan))),
            layout: Layout::of(plan),
            exchange,
            settled: 0,
            canned: None,
            frame: Box::new([0; FRAME_MAX]),
            length: 0,
        }
    }

    /// A segment that answers like a settled one.
    pub fn settled(settled: &Settled, now: fn() -> Time) -> NullSegment {
        let canned = settled.get().map(|(_, canned)| canned.clone());
        NullSegment {
            now,
            sim: None,
            layout: Layout::default(),
            exchange: Settled::default(),
            settled: SETTLED,
            canned,
            frame: Box::new([0; FRAME_MAX]),
            length: 0,
        }
    }

    fn simulate(&mut self, sent: &[u8], at: Time) {
        let Some(sim) = &mut self.sim else { return };
        let frame = &mut self.frame[..self.length];
        let begin = MonotonicClock::read();
        let comes_back = sim.pass(at, frame);
        rig::forget(MonotonicClock::read().since(begin));
        if !comes_back {
            self.length = 0;
            return;
        }
        let Some(canned) = Canned::new(frame, &self.layout, at) else {
            self.settled = 0;
            return;
        };
        self.settled += 1;
        let is_typical = !canned.requests || self.settled >= SETTLED + QUIET;
        if self.settled >= SETTLED && is_typical {
            let _ = self.exchange.set((sent.to_vec(), canned.clone()));
            (self.canned, self.sim) = (Some(canned), None);
        }
    }
}

impl Frames for NullSegment {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let at = (self.now)();
        if rig::is_scene(Scene::Silent) {
            return Ok(at);
        }
        self.length = frame.len();
        self.frame[..frame.len()].copy_from_slice(frame);
        match &mut self.canned {
            Some(canned) => canned.answer(&mut self.frame[..frame.len()], at),
            None => self.simulate(frame, at),
        }
        Ok(at)
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        let length = std::mem::take(&mut self.length);
        if length == 0 {
            return None;
        }
        room[..length].copy_from_slice(&self.frame[..length]);
        Some(((self.now)(), length))
    }

    fn now(&mut self) -> Time {
        (self.now)()
    }

    fn mac(&self) -> [u8; 6] {
        MAC
    }

    fn memory(&self, _: &mut Regions) {}
}

/// How the process data of a segment come back, in one datagram, when all of it is in operation.
#[derive(Debug, Default)]
struct Layout {
    counter: u16,
    /// Where each slave's part of the inputs begins, and whose it is.
    parts: Vec<(usize, Owner)>,
    bytes: usize,
}

impl Layout {
    fn of(plan: &EthercatPlan) -> Layout {
        let mut layout = Layout::default();
        for (owner, slave) in plan.slaves() {
            // ETG.1000.4: 1 for a read, and 2 for a write by LRW.
            layout.counter += 1 + 2 * u16::from(!slave.outputs.is_empty());
            layout.parts.push((layout.bytes, owner));
            layout.bytes += AL + slave.input_bytes();
        }
        layout
    }

    /// All slaves are in OP, and all drives in operation.
    fn is_on(&self, inputs: &[u8]) -> bool {
        self.parts.iter().all(|(at, owner)| {
            let status = || StatusWord(u16::from_le_bytes([inputs[at + STATUS], inputs[at + STATUS + 1]]));
            let is_drive = matches!(owner, Owner::Drive(_));
            inputs[*at] == OPERATIONAL && (!is_drive || status().state() == State::OperationEnabled)
        })
    }
}

/// What a segment answers whose drives are all in operation and turning.
#[derive(Clone, Debug)]
pub struct Canned {
    /// Working counters of the datagrams of every frame, and where the time of the segment stands.
    counters: Vec<(usize, [u8; 2])>,
    clock: Option<(usize, u32, Time)>,
    /// Where the inputs begin, and what they are but for the positions; where these are.
    inputs_at: usize,
    inputs: Vec<u8>,
    positions: Vec<usize>,
    /// Where the slot begins.
    slot: usize,
    position: u32,
    /// That frame has a slot.
    requests: bool,
}

impl Canned {
    /// As this frame has come back; `None`: not all slaves are in operation.
    fn new(frame: &[u8], layout: &Layout, at: Time) -> Option<Canned> {
        let (mut counters, mut clock, mut inputs_at, mut slot) = (Vec::new(), None, None, 0);
        let (mut states, mut requests) = (false, false);
        for datagram in datagrams(frame).ok()?.map_while(Result::ok) {
            if states {
                // Behind the states stands the slot.
                requests = true;
                break;
            }
            let Place { at: _, length } = datagram.place;
            let end = datagram.place.data().end;
            counters.push((end, datagram.working_counter.to_le_bytes()));
            slot = datagram.place.end();
            match datagram.command()? {
                Command::Frmw(..) if datagram.working_counter > 0 => {
                    let time = u32::from_le_bytes(datagram.data.try_into().ok()?);
                    clock = Some((datagram.place.data().start, time, at));
                }
                Command::Lrw(_) if datagram.working_counter == layout.counter => {
                    inputs_at = Some(datagram.place.data().start + length - layout.bytes);
                }
                Command::Brd(_) => states = true,
                _ => {}
            }
        }
        let inputs_at = inputs_at?;
        let inputs = frame.get(inputs_at..inputs_at + layout.bytes)?.to_vec();
        let drives = layout.parts.iter().filter(|(_, owner)| matches!(owner, Owner::Drive(_)));
        layout.is_on(&inputs).then(|| Canned {
            positions: drives.map(|(at, _)| at + POSITION).collect(),
            counters,
            clock,
            inputs_at,
            inputs,
            slot,
            position: 0,
            requests,
        })
    }

    /// Makes of a frame what comes back: every drive says that it is elsewhere than before; a mailbox that is looked at
    /// is empty.
    #[inline]
    fn answer(&mut self, frame: &mut [u8], at: Time) {
        frame[6] |= 2;
        for (place, counter) in &self.counters {
            frame[*place..place + 2].copy_from_slice(counter);
        }
        if let Some((place, time, then)) = self.clock {
            let time = time.wrapping_add(at.since(then) as u32);
            frame[place..place + 4].copy_from_slice(&time.to_le_bytes());
        }
        let step = if rig::is_scene(Scene::Standing) { 0 } else { 100 };
        self.position = self.position.wrapping_add(step);
        let inputs = &mut frame[self.inputs_at..self.inputs_at + self.inputs.len()];
        inputs.copy_from_slice(&self.inputs);
        let (unsteady, faulted) = (rig::is_scene(Scene::Unsteady), rig::is_scene(Scene::Faulted));
        for at in &self.positions {
            inputs[*at..at + 4].copy_from_slice(&self.position.to_le_bytes());
            let status = &mut inputs[at - POSITION + STATUS..][..2];
            if unsteady && self.position / 100 % 2 == 1 {
                status[1] ^= TARGET_REACHED;
            }
            if faulted {
                status[0] = FAULT;
            }
        }
        if frame.len() > self.slot.max(60) {
            self.answer_slot(frame);
        }
    }

    fn answer_slot(&self, frame: &mut [u8]) {
        let behind = |place: &Place| place.at >= self.slot;
        let ends: [Option<usize>; 2] = {
            let Ok(all) = datagrams(frame) else { return };
            let mut requested = all.map_while(Result::ok).map(|datagram| datagram.place).filter(behind);
            std::array::from_fn(|_| requested.next().map(|place| place.data().end))
        };
        for end in ends.into_iter().flatten() {
            frame[end] = 1;
        }
    }
}
