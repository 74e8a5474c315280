//! All slaves of one segment behind one interface: stations, devices and their frames, as a [`Bus`].
//!
//! | file | what |
//! |---|---|
//! | `mod` | the bus |
//! | `frames` | the frames under way |
//! | `endpoints` | the drives and devices behind the slaves of the segment |
//! | `notes` | why one is not in operation |
//! | `plan` | the plan of the segment, and its interface |

mod endpoints;
mod frames;
mod notes;
mod plan;

use std::os::fd::RawFd;
use std::sync::Arc;

use self::endpoints::{DeviceEnd, DriveEnd, Outgoing};
use self::frames::{Flight, KNOWN, SentFrame};
use self::notes::{SlaveNotes, WireNote};
use self::plan::open;
use super::image::{Image, Mark};
use super::native::terminals;
use super::other::OtherMaster;
use super::plan::{Device, EthercatPlan, Owner};
use super::segment::Segment;
use super::service::Service;
use super::start_up::{start_up, verify, verify_found};
use super::station::Station;
use super::wire::frame::{FRAME_MAX, PASSED};
use fieldbeat_core::axis::acyclic::{self, Commanding};
use fieldbeat_core::axis::cell;
use fieldbeat_core::axis::{Feedback, Observer};
use fieldbeat_core::bus::native::Inputs;
use fieldbeat_core::bus::notes::NoteCells;
use fieldbeat_core::bus::{
    Bus, BusNumbers, Cycle, DeviceEnds, Ends, Exchange, OpenError, Opened, Slot, Unmatched, Waits,
};
use fieldbeat_core::net::{Carriers, Frames, Lock};
use fieldbeat_core::rt::{Regions, Wires};
use fieldbeat_core::time::US;

/// Masters that are started one after the other use different logical addresses, so that settings that an earlier
/// one has left in a slave take no part.
const LOGICAL: u32 = 0x1000_0000;
const LOGICAL_EACH: u32 = 0x8_0000;
const LOGICAL_COUNT: u64 = 0x1800;
/// Calls for the objects of a device that may wait.
const DEVICE_CALLS: usize = 64;

/// A segment of drives and devices.
struct EthercatBus {
    net: Box<dyn Frames>,
    source: [u8; 6],
    image: Image,
    segment: Segment,
    drives: Vec<DriveEnd>,
    devices: Vec<DeviceEnd>,
    /// The outputs of each drive.
    outgoing: Box<[Outgoing]>,
    /// Identifies this master in its frames, and counts them.
    mark: Mark,
    /// The state of the last frames, each at the index of its number.
    known: Box<[SentFrame; KNOWN]>,
    /// For each frame of the image: when it was sent, and whether it is still under way.
    flights: Box<[Flight]>,
    /// How many frames of the last send are not back; one that could not be sent counts, too.
    missing: usize,
    room: Box<[u8]>,
    /// The first frame is prepared for the next send.
    prepared: bool,
    /// The segment is being shut down: it owes no exchanges any more.
    ending: bool,
    /// The state of the wire, for normal threads; and the cycles in a row from which nothing came back.
    wire: NoteCells<WireNote>,
    silent: u8,
    interface: String,
    unmatched: Unmatched,
    other: OtherMaster,
    /// The segment is this master's until its socket is closed.
    _lock: Lock,
}

impl EthercatBus {
    /// Opens the interface of `plan`, which is free of faults, for a cycle of `period_ns`.
    pub fn open(plan: &EthercatPlan, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        let (mut net, lock) = open(plan, carriers)?;
        let log = carriers.log();
        let mut plan = plan.clone();
        for drive in &mut plan.drives {
            drive.slave.start_up = start_up(drive, period_ns);
            drive.slave.verify = verify(drive);
            drive.slave.verify_found = verify_found(drive);
        }
        let mut source = net.mac();
        source[0] &= !PASSED;
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
        let (mut ends, mut outgoing) = (Ends::default(), Vec::with_capacity(plan.drives.len()));
        let drives: Vec<_> = plan
            .drives
            .iter()
            .enumerate()
            .map(|(index, drive)| {
                let interval_ns = period_ns.saturating_mul(u64::from(drive.axis.divisor));
                let (station, native, acyclic) = Station::new(drive, interval_ns, turn_ns, &log);
                let (slave, offsets) = offsets_of(Owner::Drive(index));
                ends.push(native, acyclic);
                outgoing.push(Outgoing { frame: offsets.frame as u16, range: offsets.outputs, built: false });
                DriveEnd { station, slave }
            })
            .collect();
        let devices = plan.devices.iter().enumerate().map(|(index, Device { slave, .. })| {
            let (application, port) = terminals(slave.output_bytes(), slave.input_bytes());
            let (acyclic, calls) = acyclic::queue(DEVICE_CALLS, Commanding::none());
            let (reached, reader) = cell::cell(Feedback::default());
            let observer = Observer::new(reader, Wires::default());
            ends.devices.push(DeviceEnds { native: Box::new(application), acyclic, observer });
            DeviceEnd {
                service: Service::new(slave, calls.logged(&log), turn_ns),
                reached,
                port: port.logged(&log),
                offsets: offsets_of(Owner::Device(index)).1,
                operational: false,
                counters: Arc::default(),
            }
        });
        let devices = devices.collect();
        let mut segment = Segment::new(&plan, offsets, period_ns);
        if let Some(today_ns) = net.today_ns() {
            segment.clock.begin(today_ns);
        }
        let bus = EthercatBus {
            net,
            source,
            flights: vec![Flight::default(); image.frames().len()].into(),
            missing: image.frames().len(),
            image,
            drives,
            outgoing: outgoing.into(),
            devices,
            segment,
            mark: Mark { master: (begun.0 ^ begun.0 >> 32) as u32, number: 0 },
            known: Box::new([SentFrame::default(); KNOWN]),
            room: Box::new([0; FRAME_MAX]),
            prepared: false,
            ending: false,
            wire: NoteCells::new(1),
            silent: 0,
            interface: plan.interface.clone(),
            unmatched: Unmatched::default(),
            other: OtherMaster::default(),
            _lock: lock,
        };
        let notes = bus.notes();
        Ok(Opened::new(bus, ends, notes))
    }

    /// Why its drives and devices are not in operation.
    fn notes(&self) -> SlaveNotes {
        let slave_of = |owner| self.segment.slave_of(owner);
        SlaveNotes {
            notes: self.segment.notes.clone(),
            remarks: [&self.segment.remarks, &self.segment.further].map(Clone::clone),
            drives: (0..self.drives.len()).map(Owner::Drive).filter_map(slave_of).collect(),
            devices: (0..self.devices.len()).map(Owner::Device).filter_map(slave_of).collect(),
            counters: self.devices.iter().map(|device| device.counters.clone()).collect(),
            dropped: self.net.dropped(),
            wire: self.wire.clone(),
            interface: self.interface.clone(),
        }
    }
}

impl Bus for EthercatBus {
    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        self.net.memory(regions);
        self.image.memory(regions);
        self.segment.memory(regions);
        self.wire.memory(regions);
        regions.add(&*self.known);
        regions.add(&*self.flights);
        regions.add(&*self.room);
        regions.add(&*self.drives);
        regions.add(&*self.devices);
        regions.add(&*self.outgoing);
        for drive in &self.drives {
            drive.station.memory(regions);
        }
        for device in &self.devices {
            device.port.memory(regions);
            device.reached.memory(regions);
            device.service.memory(regions);
            regions.add(&*device.counters);
        }
    }

    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.segment.clock.pass();
        if !self.is_back() {
            self.take_in(false, slots);
            self.lose(cycle, slots);
        }
        if !self.prepared {
            self.finish(cycle, slots);
        }
        self.missing = self.flights.len();
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
        let drives = self.drives.iter_mut().zip(&mut self.outgoing);
        for ((DriveEnd { station, .. }, Outgoing { frame, range, built }), slot) in drives.zip(&mut *slots) {
            let frame = &mut frames[usize::from(*frame)];
            if slot.due {
                if let Some(outputs) = frame.outputs(range) {
                    station.encode(cycle.grid, slot, outputs);
                }
            } else if *built {
                // Its send was passed over.
                frame.keep_outputs(range);
                station.profile.outputs_replaced();
            }
            *built = slot.due;
        }
        for device in &mut self.devices {
            let place = frames[device.offsets.frame].outputs(&device.offsets.outputs).into_iter().flatten();
            place.zip(device.port.outputs()).for_each(|(place, output)| *place = *output);
        }
        if !self.prepared && self.is_back() {
            self.finish(cycle, slots);
        }
    }

    fn waits(&self, cycle: &Cycle, slots: &[Slot]) -> Waits {
        let is_out = !self.is_back() && slots.iter().any(|slot| slot.exchange.is_waited_for(cycle));
        Waits::for_replies(is_out.into())
    }

    fn native(&self, index: usize) -> Option<(&dyn Inputs, &[u8])> {
        let (drive, Outgoing { frame, range, .. }) = self.drives.get(index).zip(self.outgoing.get(index))?;
        let frame = self.image.frames().get(usize::from(*frame))?;
        Some((&drive.station.native, frame.sent_outputs(range)))
    }

    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        // The loop has stopped the drives by then.
        self.ending = true;
        let owed = slots.iter().any(|slot| matches!(slot.exchange, Exchange::Owed { .. }));
        self.segment.shut_down(cycle.grid) && !owed
    }

    fn numbers(&self) -> BusNumbers {
        let unmatched = Unmatched { errors: self.net.errors(), ..self.unmatched };
        BusNumbers { unmatched, clock: self.segment.clock_status() }
    }

    fn lead(&mut self) {
        self.segment.leads = true;
    }

    fn phase_error(&mut self) -> Option<i64> {
        self.segment.clock.take_error()
    }
}
