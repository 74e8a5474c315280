//! All drives of one Modbus TCP bus, one connection each: stations and their carrier, as a [`Bus`].

use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::RawFd;
use std::sync::Arc;

use super::counters::OWN;
use super::diagnosis::DIAGNOSIS;
use super::fields::layout;
use super::handshake::{Found, UnidriveHandshake};
use super::mapping::Mapping;
use super::notation::Parameters;
use super::plan::{ModbusPlan, UnidriveDrive, Via};
use super::profile;
use super::station::{BROKE, SILENT, Station};
use super::trips::Trip;
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::axis::{AxisPlan, FoundRunning, PlanFault};
use fieldbeat_core::bus::load::{Load, Medium, Way};
use fieldbeat_core::bus::native::{Inputs, NativeLayout};
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::bus::{
    Bus, BusFacts, BusNumbers, BusPlan, Cycle, DriveFacts, Ends, Exchange, Grid, Notes, OpenError, Opened,
    ReplyWithin, Slot, drives,
};
use fieldbeat_core::net::{Broken, Carriers, LinkNotes, Lock, StreamPeer, Streams};
use fieldbeat_core::rt::Regions;

/// Connections and their drives.
struct ModbusBus {
    net: Box<dyn Streams>,
    stations: Vec<Station>,
    /// A request is due at the next send, or a reply is owed.
    reads: bool,
    /// The drives are this master's until their connections are given up.
    _locks: Vec<Lock>,
}

/// The blocks of a drive at its parameters' own addresses, and those of menu 0 if they are to be used.
fn mappings(drive: &UnidriveDrive) -> Option<(Mapping, Option<Mapping>)> {
    let own = Mapping::new(drive).ok()?;
    match drive.via {
        Via::Direct => Some((own, None)),
        Via::Menu0 { .. } => {
            let direct = UnidriveDrive { via: Via::Direct, ..drive.clone() };
            Some((Mapping::new(&direct).ok()?, Some(own)))
        }
    }
}

impl ModbusBus {
    /// Begins to connect to the drives of `plan`, which is free of faults.
    pub fn open(plan: &ModbusPlan, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        let addresses = plan.drives.iter().map(|drive| (&drive.axis, drive.address));
        let locks = drives::lock(&plan.name, addresses, carriers)?;
        let (mut peers, mut stations, mut ends) = (Vec::new(), Vec::new(), Ends::default());
        for drive in &plan.drives {
            let broken = || OpenError::Plan { bus: plan.name.clone(), drive: drive.axis.name.clone() };
            let mappings = mappings(drive).ok_or_else(broken)?;
            let found = Arc::new(Found::default());
            let (direct, menu_0) = mappings.clone();
            let handshake = UnidriveHandshake::new(drive, direct, menu_0, Arc::clone(&found));
            peers.push(StreamPeer {
                bind: plan.bind,
                handshake_ns: handshake.longest_ns(),
                unacknowledged_ns: 2 * drive.reply_within_ns,
                ..StreamPeer::new(drive.address, Box::new(handshake))
            });
            let (station, native, acyclic) = Station::new(drive, mappings, found, &carriers.log());
            stations.push(station);
            ends.push(native, acyclic);
        }
        let net = carriers
            .streams(peers)
            .map_err(|source| OpenError::Streams { bus: plan.name.clone(), source })?;
        let notes = ConnectionNotes(net.notes());
        Ok(Opened::new(ModbusBus { net, stations, reads: false, _locks: locks }, ends, notes))
    }

    /// Takes in what has arrived on the connections, one piece each.
    fn take_in(&mut self, slots: &mut [Slot]) {
        let net = &mut *self.net;
        net.look();
        while let Some(index) = net.ready() {
            let (Some(station), Some(slot)) = (self.stations.get_mut(index), slots.get_mut(index)) else {
                continue;
            };
            match net.receive(index, station.room()) {
                Ok(None) => {}
                Ok(Some((at, count))) => {
                    if let Err(why) = station.take(at, count, slot) {
                        net.abandon(index, why);
                    }
                }
                Err(broken) => give_up_broken(net, index, broken, station, slot),
            }
        }
    }

    /// Continues a request that the wire took in pieces, and hands the next one to the connection if it is due.
    #[inline]
    fn request(
        net: &mut dyn Streams,
        index: usize,
        cycle: &Cycle,
        station: &mut Station,
        slot: &mut Slot,
    ) -> Result<(), Broken> {
        let mut result = Ok(());
        if !station.rest().is_empty() {
            result = net.send(index, station.rest()).map(|(_, count)| station.rest_sent(count));
        }
        if !slot.due || station.passed || station.has_ended() {
            return result;
        }
        // On a connection that has just been opened nothing is built before the loop has seen what was found.
        if station.is_void() && !station.to_send().is_empty() {
            station.prepare(cycle, slot);
        }
        let bytes = station.to_send();
        if result.is_err() || bytes.is_empty() {
            slot.unsent();
            return result;
        }
        match net.send(index, bytes) {
            Ok((_, 0)) => slot.unsent(),
            Ok((at, count)) => station.sent(at, count, cycle, slot),
            Err(broken) => {
                slot.unsent();
                return Err(broken);
            }
        }
        Ok(())
    }
}

/// The connection has ended at the other end, or broken.
#[cold]
fn give_up_broken(
    net: &mut dyn Streams,
    index: usize,
    broken: Broken,
    station: &mut Station,
    slot: &mut Slot,
) {
    if broken != Broken::Absent {
        net.abandon(index, station.ended(broken, slot));
    }
}

/// Why a connection is not open.
#[derive(Debug)]
struct ConnectionNotes(LinkNotes);

impl Notes for ConnectionNotes {
    fn get(&self, index: usize) -> Option<String> {
        self.0.get(index)
    }

    fn is_vague(&self, index: usize) -> bool {
        self.0.get(index).is_some_and(|why| [SILENT, BROKE].iter().any(|vague| why.ends_with(vague)))
    }
}

impl Bus for ModbusBus {
    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        self.net.memory(regions);
        regions.add(&*self.stations);
        for station in &self.stations {
            station.memory(regions);
        }
    }

    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        // There is one connection per drive: each turn takes over another one.
        for _ in 0..self.stations.len() {
            let Some(index) = self.net.opened() else { break };
            if let (Some(station), Some(slot)) = (self.stations.get_mut(index), slots.get_mut(index)) {
                station.connected(slot);
            }
        }
        // The end of a connection on which nothing is sent or owed can wait: that is not worth a system call in each
        // cycle.
        if self.reads {
            self.take_in(slots);
        }
        let net = &mut *self.net;
        for (index, (station, slot)) in self.stations.iter_mut().zip(slots).enumerate() {
            if let Err(broken) = ModbusBus::request(net, index, cycle, station, slot) {
                give_up_broken(net, index, broken, station, slot);
            }
            if let Some(why) = station.gives_up(cycle.grid, slot) {
                net.abandon(index, why);
            }
        }
    }

    fn receive(&mut self, _cycle: &Cycle, slots: &mut [Slot]) {
        // One piece of each: a drive that sends byte by byte is read again with the next look, and never delays the
        // cycle.
        self.take_in(slots);
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.reads = false;
        for (station, slot) in self.stations.iter_mut().zip(slots) {
            // An owed exchange is passed over in the next send: it is not requested again, although it may be answered
            // there.
            station.passed = matches!(slot.exchange, Exchange::Owed { .. });
            self.reads |= slot.due || station.owes();
            if slot.due {
                station.prepare(cycle, slot);
            }
        }
    }

    fn native(&self, index: usize) -> Option<(&dyn Inputs, &[u8])> {
        let station = self.stations.get(index)?;
        Some((station, station.sent_request()))
    }

    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        let mut done = true;
        for (station, slot) in self.stations.iter_mut().zip(slots.iter()) {
            done &= station.shut_down(cycle) && !matches!(slot.exchange, Exchange::Owed { .. });
        }
        done
    }

    fn numbers(&self) -> BusNumbers {
        BusNumbers::default()
    }

    fn helper_ended(&self) -> bool {
        self.net.has_ended()
    }
}

impl BusPlan for ModbusPlan {
    fn name(&self) -> &str {
        &self.name
    }

    fn axes(&self) -> Vec<&AxisPlan> {
        self.drives.iter().map(|drive| &drive.axis).collect()
    }

    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)> {
        let same: fn(&UnidriveDrive, &UnidriveDrive) -> bool = |one, other| one.address == other.address;
        let taken = "is taken by another drive; one drive per address and port";
        drives::faults(&self.drives, period_ns, |drive| &drive.axis, UnidriveDrive::faults, same, taken)
    }

    fn facts(&self, _grid: Grid) -> BusFacts {
        let drive = |drive: &UnidriveDrive| DriveFacts {
            reply_within: ReplyWithin::Connection(drive.reply_within_ns),
            watchdog_ns: drive.watchdog.within_ns(),
            monitored: drive.shown(),
            ..DriveFacts::at(drive.address, profile::capabilities(drive))
        };
        let way = Way::Address(self.bind.unwrap_or(Ipv4Addr::UNSPECIFIED));
        BusFacts {
            // The shortest of FC23 (Modbus Application Protocol V1.1b3, 6.17): a register each way.
            load: Some(Load::new(Medium::Streams, way, [7 + 12, 7 + 4])),
            local: self.bind.map(|bind| SocketAddrV4::new(bind, 0)),
            own_counters: &OWN,
            fault_names: |code| u16::try_from(code).ok().and_then(|code| Trip(code).name()),
            silence_faults: |code| u16::try_from(code).is_ok_and(|code| Trip(code).is_of_silence()),
            diagnosis: &DIAGNOSIS,
            ..BusFacts::new(super::PROTOCOL, Parameters, self.drives.iter().map(drive).collect())
        }
    }

    fn describe(&self, grid: Grid) -> Vec<String> {
        self.drives.iter().map(|drive| drive.describe(self.bind, grid.period_ns)).collect()
    }

    fn native_layout(&self, index: usize) -> NativeLayout {
        let drive = self.drives.get(index).and_then(|drive| Some((drive, mappings(drive)?)));
        drive.map_or_else(NativeLayout::default, |(drive, mappings)| layout(drive, mappings))
    }

    fn open(&self, _period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        ModbusBus::open(self, carriers)
    }

    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let mut drive = self.drives.get(index)?.clone();
        drive.axis.on_found_running = FoundRunning::Refuse;
        drive.set_up = false;
        drive.map.show = [None; MONITOR_CHANNELS];
        drive.map.also.clear();
        Some(Box::new(ModbusPlan { name: self.name.clone(), bind: self.bind, drives: vec![drive] }))
    }

    fn variant(&self, wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        Some(Box::new(ModbusPlan::variant(self, wanted)?))
    }
}
