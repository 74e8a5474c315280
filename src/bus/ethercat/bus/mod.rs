//! All slaves of one segment behind one interface: stations, devices and their frames, as a [`Bus`].
//!
//! | file | what |
//! |---|---|
//! | `mod` | the frames under way, and the bus |
//! | `endpoints` | the drives and devices behind the slaves of the segment |
//! | `notes` | why one is not in operation |

mod endpoints;
mod notes;

use std::any::Any;
use std::io::ErrorKind;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

use self::endpoints::{DeviceEnd, DriveEnd, Endpoints};
use self::notes::{DOWN, NOTHING_BACK, OTHER_MASTER, SlaveNotes, WELL};
use super::counters::{OWN, Own};
use super::faults;
use super::image::{Image, Mark, Read};
use super::native::terminals;
use super::object::Objects;
use super::other::{OtherMaster, listen};
use super::plan::{Device, EthercatPlan, KollmorgenDrive, Owner};
use super::profile;
use super::scan::{Busy, Shown, require_idle};
use super::segment::{Back, Segment, Sent};
use super::service::Service;
use super::start_up::{start_up, verify, verify_found};
use super::station::Station;
use super::wire::frame::{self, ETHERTYPE, FRAME_MAX, FrameError, datagrams};
use crate::axis::acyclic::{self, AcyclicEnds, Commanding, Notation};
use crate::axis::cell;
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::axis::{AxisPlan, FaultNames, Feedback, FoundRunning, Link, MonitorChannel, Observer, PlanFault};
use crate::bus::desired::Capabilities;
use crate::bus::variant::Variant;
use crate::bus::{
    Bus, BusClock, BusPlan, Counters, Cycle, Ends, Exchange, Notes, OpenError, OwnCounter, Slot, Unmatched,
};
use crate::errors::no_descriptor;
use crate::net::frames::Unsent;
use crate::net::{Carriers, Frames, Lock, Place};
use crate::rt::Regions;
use crate::time::{Time, US};

/// Frames that are remembered: one that comes back later is unknown.
const KNOWN: usize = 256;
/// Masters that are started one after the other use different logical addresses, so that settings that an earlier
/// one has left in a slave take no part.
const LOGICAL: u32 = 0x1000_0000;
const LOGICAL_EACH: u32 = 0x8_0000;
const LOGICAL_COUNT: u64 = 0x1800;
/// Calls for the objects of a device that may wait.
const DEVICE_CALLS: usize = 64;
/// The most frames taken in at once beyond those that are due.
const MORE_AT_ONCE: usize = 4;
/// So many cycles in a row without a returned frame are reported as a fault of the wire.
const SILENT: u8 = 100;

/// A segment of drives and devices.
pub struct EthercatBus {
    name: String,
    net: Box<dyn Frames>,
    source: [u8; 6],
    image: Image,
    segment: Segment,
    drives: Vec<DriveEnd>,
    devices: Vec<DeviceEnd>,
    ends: Ends,
    /// Identifies this master in its frames, and counts them.
    mark: Mark,
    /// The state of the last frames, each at the index of its number.
    known: Box<[Known; KNOWN]>,
    /// For each frame of the image: when it was sent, and whether it is still under way.
    flights: Box<[Flight]>,
    room: Box<[u8]>,
    /// The first frame is prepared for the next send.
    prepared: bool,
    /// The segment is being shut down: it owes no exchanges any more.
    ending: bool,
    /// The state of the wire, for normal threads; and the cycles in a row from which nothing came back.
    wire: Arc<AtomicU8>,
    silent: u8,
    interface: String,
    unmatched: Unmatched,
    other: OtherMaster,
    /// The segment is this master's until its socket is closed.
    _lock: Lock,
}

/// A frame that was sent.
#[derive(Clone, Copy, Debug, Default)]
struct Known {
    number: Option<u32>,
    frame: u8,
    answered: bool,
}

/// A frame of the image: sent and not yet back, back, or not sent at all.
#[derive(Clone, Copy, Debug, Default)]
struct Flight {
    number: u32,
    sent: Option<Sent>,
    back: bool,
}

impl std::fmt::Debug for EthercatBus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("EthercatBus")
            .field("name", &self.name)
            .field("segment", &self.segment)
            .finish_non_exhaustive()
    }
}

impl EthercatBus {
    /// Opens the interface of `plan`, which is free of faults, for a cycle of `period_ns`.
    pub fn open(
        plan: &EthercatPlan,
        period_ns: u64,
        carriers: &dyn Carriers,
    ) -> Result<EthercatBus, OpenError> {
        let (mut net, lock) = open(plan, carriers)?;
        let mut plan = plan.clone();
        for drive in &mut plan.drives {
            drive.slave.start_up = start_up(drive, period_ns);
            drive.slave.verify = verify(drive);
            drive.slave.verify_found = verify_found(drive);
        }
        let mut source = net.mac();
        source[0] &= !frame::PASSED;
        let slaves = plan.slaves();
        let clock = slaves.iter().any(|(_, slave)| slave.sync);
        let broken = || OpenError::Plan { bus: plan.name.clone(), drive: plan.name.clone() };
        let begun = net.now();
        let base = LOGICAL + (begun.0 / US % LOGICAL_COUNT) as u32 * LOGICAL_EACH;
        let (image, offsets) = Image::new(&slaves, base, source, clock, plan.lrw).ok_or_else(broken)?;
        let offsets_of = |owner: Owner| {
            let slave = slaves.iter().position(|(other, _)| *other == owner).unwrap_or_default();
            (slave, offsets.get(slave).cloned().unwrap_or_default())
        };
        let turn_ns = period_ns.saturating_mul(slaves.len() as u64);
        let mut ends = Ends::default();
        let drives: Vec<_> = plan
            .drives
            .iter()
            .enumerate()
            .map(|(index, drive)| {
                let interval_ns = period_ns.saturating_mul(u64::from(drive.axis.divisor));
                let (station, native, acyclic) = Station::new(drive, interval_ns, turn_ns);
                let (slave, offsets) = offsets_of(Owner::Drive(index));
                ends.push(native, acyclic);
                DriveEnd { station, built: false, offsets, slave }
            })
            .collect();
        let devices = plan.devices.iter().enumerate().map(|(index, Device { slave, .. })| {
            let (application, port) = terminals(slave.outputs.length.into(), slave.inputs.length.into());
            let (ends, calls) = acyclic::queue(DEVICE_CALLS, Commanding::none());
            let (reached, reader) = cell::cell(Feedback::default());
            DeviceEnd {
                service: Service::new(slave, Some(calls), turn_ns),
                reached,
                port,
                offsets: offsets_of(Owner::Device(index)).1,
                operational: false,
                terminals: Some(application),
                acyclic: Some((ends, Observer(reader))),
            }
        });
        Ok(EthercatBus {
            name: plan.name.clone(),
            net,
            source,
            flights: vec![Flight::default(); image.frames().len()].into(),
            image,
            drives,
            devices: devices.collect(),
            ends,
            segment: Segment::new(&plan, offsets, period_ns),
            mark: Mark { master: (begun.0 ^ begun.0 >> 32) as u32, number: 0 },
            known: Box::new([Known::default(); KNOWN]),
            room: Box::new([0; FRAME_MAX]),
            prepared: false,
            ending: false,
            wire: Arc::default(),
            silent: 0,
            interface: plan.interface.clone(),
            unmatched: Unmatched::default(),
            other: OtherMaster::default(),
            _lock: lock,
        })
    }

    /// Takes in what has come, up to a bounded amount. Once all sent frames are back, nothing more is waited for,
    /// and the socket is not read again: that would be a system call in each cycle. Further frames are taken in
    /// with the next ones.
    fn take_in(&mut self, in_window: bool, slots: &mut [Slot]) {
        for _ in 0..self.flights.len() + MORE_AT_ONCE {
            let Some((at, length)) = self.net.receive(&mut self.room) else { return };
            self.take(at, length, in_window, slots);
            if self.is_back() {
                return;
            }
        }
    }

    /// All frames that were sent last were sent, and are back.
    fn is_back(&self) -> bool {
        self.flights.iter().all(|flight| flight.back)
    }

    /// One frame.
    fn take(&mut self, at: Time, length: usize, in_window: bool, slots: &mut [Slot]) {
        // Taken out of the bus while it is read.
        let room = std::mem::take(&mut self.room);
        match room.get(..length) {
            Some(received) => self.sort(at, received, in_window, slots),
            // Longer than any frame.
            None => self.unmatched.datagrams += 1,
        }
        self.room = room;
    }

    /// The sender of a frame, and its number.
    fn sort(&mut self, at: Time, received: &[u8], in_window: bool, slots: &mut [Slot]) {
        let number = match own_number(received, &self.source, self.mark.master) {
            Ok(number) => number,
            Err(sender) => {
                match sender {
                    UnknownSender::Foreign => self.unmatched.datagrams += 1,
                    UnknownSender::Unknown => self.count(None, slots, |counters| counters.foreign += 1),
                    // Its frame cannot be identified.
                    UnknownSender::Broken => self.count(None, slots, |counters| counters.malformed += 1),
                }
                if self.other.see(at, received) {
                    other_master(slots);
                }
                return;
            }
        };
        let place = number as usize % KNOWN;
        let known = self.known[place];
        if known.number != Some(number) {
            return self.count(None, slots, |counters| counters.foreign += 1);
        }
        let frame = usize::from(known.frame);
        if known.answered {
            return self.count(Some(frame), slots, |counters| counters.duplicate += 1);
        }
        let flight = self.flights[frame];
        let Some(sent) = flight.sent.filter(|_| flight.number == number) else {
            self.known[place].answered = true;
            return self.count(Some(frame), slots, |counters| counters.late += 1);
        };
        match self.image.frames()[frame].read(received) {
            Read::Good(counter) => {
                self.known[place].answered = true;
                (self.flights[frame].sent, self.flights[frame].back) = (None, true);
                self.silent = 0;
                let wire = if self.other.is_there(at) { OTHER_MASTER } else { WELL };
                self.wire.store(wire, Ordering::Relaxed);
                if !in_window {
                    // Too late for the exchanges of the drives, but not for what proceeds step by step.
                    self.count_late(frame, &sent, slots);
                }
                let back =
                    Back { sent, frame: &self.image.frames()[frame], at, received, counter, in_window };
                let (drives, devices) = (&mut self.drives[..], &mut self.devices[..]);
                self.segment.receive(&back, frame, &mut Endpoints { drives, devices, slots });
                if std::mem::take(&mut self.segment.lowered) {
                    other_master(slots);
                }
            }
            Read::Circulated => self.count(Some(frame), slots, |counters| Own::Circulated.count(counters)),
            Read::Other => self.count(Some(frame), slots, |counters| counters.malformed += 1),
        }
    }

    /// Counts something of each drive in a frame; of all drives, if the frame is unknown.
    fn count(&self, frame: Option<usize>, slots: &mut [Slot], count: impl Fn(&mut Counters)) {
        for (slot, drive) in slots.iter_mut().zip(&self.drives) {
            if frame.is_none_or(|frame| frame == drive.offsets.frame)
                && self.segment.is_operational(drive.slave)
            {
                count(&mut slot.counters);
            }
        }
    }

    /// Counts frame `number`, which came after its window, as late for the drives of its exchanges.
    fn count_late(&self, number: usize, sent: &Sent, slots: &mut [Slot]) {
        for (slot, drive) in slots.iter_mut().zip(&self.drives) {
            let was_sent = drive.offsets.frame == number && drive.station.sent_grid == sent.cycle.grid;
            if was_sent && self.segment.is_operational(drive.slave) {
                slot.counters.late += 1;
            }
        }
    }

    /// Completes the first frame, once nothing of the one before is under way.
    fn finish(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        if !self.prepared {
            self.segment.left = !self.ending && self.other.is_there(cycle.grid);
            if let Some(first) = self.image.frames_mut().first_mut() {
                let (drives, devices) = (&mut self.drives[..], &mut self.devices[..]);
                self.segment.prepare(cycle, first, &mut Endpoints { drives, devices, slots });
            }
            self.prepared = true;
        }
    }

    /// Opens the exchanges of the drives that are due with frame `number`.
    fn requested(&mut self, number: usize, sent_at: Option<Time>, cycle: &Cycle, slots: &mut [Slot]) {
        let settled = self.segment.is_settled();
        for (DriveEnd { station, built, offsets, slave, .. }, slot) in self.drives.iter_mut().zip(slots) {
            if !slot.due || offsets.frame != number {
                continue;
            }
            *built = sent_at.is_none();
            let is_requested = settled || self.segment.is_operational(*slave);
            // The frame is sent in each cycle with the last outputs: so the counting of sent outputs advances in
            // each.
            slot.reachable |= is_requested && slot.link == Link::Lost;
            match sent_at.filter(|_| is_requested) {
                Some(sent_at) if settled || self.segment.outputs_count(*slave) => {
                    station.sent(sent_at, cycle.deadline, slot);
                }
                Some(sent_at) => station.open(sent_at, cycle.deadline, slot),
                None => {
                    // The silence of a slave that is being shut down is expected.
                    slot.expected_silence |= self.ending;
                    station.unsent(slot);
                }
            }
        }
    }

    /// Sends frame `number`.
    fn send_frame(&mut self, number: usize, cycle: &Cycle) -> Option<Time> {
        let frame = &mut self.image.frames_mut()[number];
        frame.load_outputs();
        let mark = self.mark;
        self.mark.number = mark.number.wrapping_add(1);
        frame.number(mark);
        if number == 0 {
            let now = self.net.now();
            let clock = &mut self.segment.clock;
            frame.set_time(clock.sent_time(cycle, now));
            clock.lead_on();
        }
        let sent = self.net.send(frame.bytes());
        if sent.is_err() {
            frame.unload_outputs();
        }
        if sent == Err(Unsent::Down) {
            self.wire.store(DOWN, Ordering::Relaxed);
        }
        let sent_at = sent.ok();
        let sent = sent_at.map(|at| Sent { cycle: *cycle, at });
        self.flights[number] = Flight { number: mark.number, sent, back: false };
        let known = Known { number: sent_at.map(|_| mark.number), frame: number as u8, answered: false };
        self.known[mark.number as usize % KNOWN] = known;
        sent_at
    }
}

/// A frame that is not one of this master's last frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum UnknownSender {
    /// Of an unknown sender.
    Foreign,
    /// From here, but not of this master.
    Unknown,
    /// Of this master, but broken.
    Broken,
}

/// The number of a frame that this master has sent.
fn own_number(received: &[u8], source: &[u8; 6], master: u32) -> Result<u32, UnknownSender> {
    if frame::source(received) != Some(*source) {
        return Err(UnknownSender::Foreign);
    }
    match Mark::of(received) {
        Some(mark) if mark.master == master => Ok(mark.number),
        Some(_) => Err(UnknownSender::Unknown),
        None => match datagrams(received) {
            Err(FrameError::Foreign) => Err(UnknownSender::Foreign),
            _ => Err(UnknownSender::Broken),
        },
    }
}

/// Another master has frames on the segment of these drives.
#[cold]
fn other_master(slots: &mut [Slot]) {
    slots.iter_mut().for_each(|slot| slot.notices.other_master = true);
}

/// The interface of `plan`, with its lock; no other master has frames there.
fn open(plan: &EthercatPlan, carriers: &dyn Carriers) -> Result<(Box<dyn Frames>, Lock), OpenError> {
    let (bus, interface) = (plan.name.clone(), plan.interface.clone());
    let lock = carriers.lock(Place::Interface(&interface)).map_err(|why| {
        let what = format!("interface {interface}");
        OpenError::InUse { bus: bus.clone(), what, why }
    })?;
    let mut net = carriers.frames(&interface, ETHERTYPE).map_err(|source| {
        let (bus, interface, remedy) = (bus.clone(), interface.clone(), remedy(&source));
        OpenError::Interface { bus, interface, source, remedy }
    })?;
    match listen(&interface, &mut *net) {
        Some(mac) => Err(OpenError::OtherMaster { bus, interface, mac: Shown(&mac).to_string() }),
        None => Ok((net, lock)),
    }
}

/// The remedy for an interface that cannot be used.
fn remedy(source: &std::io::Error) -> &'static str {
    match source.kind() {
        ErrorKind::PermissionDenied => {
            "sudo setcap cap_sys_nice,cap_ipc_lock,cap_net_raw+ep on the program, or run it as root"
        }
        ErrorKind::NotFound => "correct interface",
        _ => no_descriptor(source).unwrap_or(
            "look at interface: a network interface like \"eth1\", or \"local:NAME\" for simulated drives",
        ),
    }
}

impl Bus for EthercatBus {
    fn name(&self) -> &str {
        &self.name
    }

    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        self.net.memory(regions);
        self.image.memory(regions);
        self.segment.memory(regions);
        regions.add(&*self.wire);
        regions.add(&*self.known);
        regions.add(&*self.flights);
        regions.add(&*self.room);
        regions.add(&*self.drives);
        regions.add(&*self.devices);
        for drive in &self.drives {
            drive.station.memory(regions);
        }
        for device in &self.devices {
            device.port.memory(regions);
            device.reached.memory(regions);
            device.service.memory(regions);
        }
    }

    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.segment.clock.pass();
        if !self.is_back() {
            self.take_in(false, slots);
        }
        for number in 0..self.flights.len() {
            if !self.flights[number].back {
                let (drives, devices) = (&mut self.drives[..], &mut self.devices[..]);
                self.segment.lost(cycle.grid, number == 0, &mut Endpoints { drives, devices, slots });
                self.prepared &= number != 0;
            }
        }
        if !self.flights.iter().any(|flight| flight.back) {
            self.silent = self.silent.saturating_add(1);
            if self.silent >= SILENT {
                let wire = if self.other.is_there(cycle.grid) { OTHER_MASTER } else { NOTHING_BACK };
                self.wire.store(wire, Ordering::Relaxed);
            }
        }
        self.finish(cycle, slots);
        for number in 0..self.flights.len() {
            let sent_at = self.send_frame(number, cycle);
            self.requested(number, sent_at, cycle, slots);
        }
        self.prepared = false;
        self.devices.iter_mut().for_each(|device| device.port.sent());
    }

    fn receive(&mut self, _cycle: &Cycle, slots: &mut [Slot]) {
        self.take_in(true, slots);
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        let frames = self.image.frames_mut();
        for (DriveEnd { station, built, offsets, .. }, slot) in self.drives.iter_mut().zip(&mut *slots) {
            if slot.due {
                station.encode(cycle.grid, slot, frames[offsets.frame].outputs(offsets));
            } else if *built {
                // Its send was passed over.
                frames[offsets.frame].keep_outputs(offsets);
                station.profile.outputs_replaced();
            }
            *built = slot.due;
        }
        for device in &mut self.devices {
            let place = frames[device.offsets.frame].outputs(&device.offsets);
            place.iter_mut().zip(device.port.outputs()).for_each(|(place, output)| *place = *output);
        }
        if self.is_back() {
            self.finish(cycle, slots);
        }
    }

    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        // The loop has stopped the drives by then.
        self.ending = true;
        let owed = slots.iter().any(|slot| matches!(slot.exchange, Exchange::Owed { .. }));
        self.segment.shut_down(cycle.grid) && !owed
    }

    fn unmatched(&self) -> Unmatched {
        Unmatched { errors: self.net.errors(), ..self.unmatched }
    }

    fn notes(&self) -> Option<Arc<dyn Notes>> {
        let slave_of = |owner| self.segment.slave_of(owner);
        Some(Arc::new(SlaveNotes {
            notes: self.segment.notes.clone(),
            drives: (0..self.drives.len()).map(Owner::Drive).filter_map(slave_of).collect(),
            devices: (0..self.devices.len()).map(Owner::Device).filter_map(slave_of).collect(),
            dropped: self.net.dropped(),
            wire: self.wire.clone(),
            interface: self.interface.clone(),
        }))
    }

    fn ends(&mut self) -> Option<&mut Ends> {
        Some(&mut self.ends)
    }

    fn is_one_frame(&self) -> bool {
        true
    }

    fn lead(&mut self) {
        self.segment.leads = true;
    }

    fn phase_error(&mut self) -> Option<i64> {
        self.segment.clock.take_error()
    }

    fn clock(&self) -> Option<BusClock> {
        self.segment.clock_status()
    }

    fn device_acyclic(&mut self, index: usize) -> Option<(AcyclicEnds, Observer)> {
        self.devices.get_mut(index)?.acyclic.take()
    }

    fn device(&mut self, index: usize) -> Option<Box<dyn Any + Send>> {
        let terminals = self.devices.get_mut(index)?.terminals.take()?;
        Some(Box::new(terminals))
    }
}

impl BusPlan for EthercatPlan {
    fn name(&self) -> &str {
        &self.name
    }

    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn axes(&self) -> Vec<&AxisPlan> {
        self.drives.iter().map(|drive| &drive.axis).collect()
    }

    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)> {
        EthercatPlan::faults(self, period_ns)
    }

    fn drive_watchdog_ns(&self, index: usize) -> Option<u64> {
        self.drives.get(index)?.slave.watchdog_ns
    }

    fn describe(&self, period_ns: u64) -> Vec<String> {
        EthercatPlan::describe(self, period_ns)
    }

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        Ok(Box::new(EthercatBus::open(self, period_ns, carriers)?))
    }

    fn require_idle(&self, carriers: &dyn Carriers) -> Result<(), OpenError> {
        let (mut net, _lock) = open(self, carriers)?;
        let (bus, interface) = (self.name.clone(), self.interface.clone());
        match require_idle(&mut *net) {
            // Whatever else is wrong there the start reports, with its remedy.
            Ok(()) => Ok(()),
            Err(Busy::Other(mac)) => {
                Err(OpenError::OtherMaster { bus, interface, mac: Shown(&mac).to_string() })
            }
            Err(Busy::Running { place, state }) => {
                let what = format!("the slave at place {place} of its segment is in {state}");
                Err(OpenError::Running { bus, what })
            }
        }
    }

    fn monitored(&self, index: usize) -> [Option<MonitorChannel>; MONITOR_CHANNELS] {
        self.drives.get(index).map_or([const { None }; MONITOR_CHANNELS], KollmorgenDrive::shown)
    }

    fn own_counters(&self) -> &'static [OwnCounter] {
        &OWN
    }

    fn capabilities(&self, index: usize) -> Capabilities {
        profile::capabilities(&self.drives[index])
    }

    fn fault_names(&self) -> FaultNames {
        |code| u16::try_from(code).ok().and_then(faults::name)
    }

    fn notation(&self) -> Arc<dyn Notation> {
        Arc::new(Objects)
    }

    /// The whole segment has to come up for one drive: the plan is reduced to this drive, the others stay in INIT.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let mut drive = self.drives.get(index)?.clone();
        drive.axis.on_found_running = FoundRunning::Refuse;
        drive.show = [None; MONITOR_CHANNELS];
        Some(Box::new(EthercatPlan { drives: vec![drive], devices: Vec::new(), ..self.clone() }))
    }

    fn variant(&self, wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        Some(Box::new(EthercatPlan::variant(self, wanted)?))
    }

    fn addresses(&self) -> Vec<SocketAddrV4> {
        Vec::new()
    }

    fn has_clock(&self) -> bool {
        self.slaves().iter().any(|(_, slave)| slave.sync)
    }

    fn devices(&self) -> Vec<&str> {
        self.devices.iter().map(|device| device.name.as_str()).collect()
    }
}
