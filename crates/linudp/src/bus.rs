//! All drives of one LinUDP bus on one socket: stations and their carrier, as a [`Bus`].

use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::RawFd;

use super::counters::OWN;
use super::diagnosis::DIAGNOSIS;
use super::fields::layout;
use super::last::last_resort;
use super::notation::Upids;
use super::plan::{LinUdpDrive, LinUdpPlan, MonitorPlan, Serial};
use super::profile;
use super::station::{SerialNote, Station};
use super::wire::{ErrorCode, REQUEST_MAX, RESPONSE_MAX, SHORTEST};
use fieldbeat_core::axis::{AxisPlan, FoundRunning, PlanFault};
use fieldbeat_core::bus::load::{Load, Medium, Way};
use fieldbeat_core::bus::native::{Inputs, NativeLayout};
use fieldbeat_core::bus::notes::NoteCells;
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::bus::{
    Bus, BusFacts, BusNumbers, BusPlan, Cycle, DriveFacts, Ends, Exchange, Grid, LastResort, Notes,
    OpenError, Opened, ReplyWithin, Slot, Unmatched, Waits, drives,
};
use fieldbeat_core::net::{self, Carriers, Datagrams, Lock, Outbox, Sent, UdpOptions};
use fieldbeat_core::rt::Regions;

/// Room for one datagram: the longest telegram is 50 bytes, padding makes it 64 at most, and anything longer is not
/// a telegram of this protocol.
const ROOM: usize = if RESPONSE_MAX > 128 { RESPONSE_MAX } else { 128 };

/// One socket and its drives.
struct LinUdpBus {
    net: Box<dyn Datagrams>,
    outbox: Outbox,
    stations: Vec<Station>,
    senders: Senders,
    unmatched: Unmatched,
    /// The orderly end has begun: no more requests.
    is_ending: bool,
    /// The requests of all due slots stand built and posted for the next send ...
    is_prepared: bool,
    /// ... and one of them does not hold any more.
    is_void: bool,
    /// The drives are this master's until the socket is closed.
    _locks: Vec<Lock>,
}

impl LinUdpBus {
    /// Opens the socket of `plan`.
    pub fn open(plan: &LinUdpPlan, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        let addresses = plan.drives.iter().map(|drive| (&drive.axis, drive.address));
        let locks = drives::lock(&plan.name, addresses, carriers)?;
        // Until its bucket is full, an absent drive gets its requests like any other.
        let waiting = plan.drives.iter().map(|drive| drive.axis.health.bucket as usize).max().unwrap_or(0);
        let options = UdpOptions { peers: plan.drives.len(), waiting, room: ROOM, dscp: 0, groups: 0 };
        let refused = |source| OpenError::bind(&plan.name, plan.bind, source);
        let net = carriers.datagrams(plan.bind, &options).map_err(refused)?;
        let twin = net.twin().map_err(refused)?;
        let peers: Vec<_> = plan.drives.iter().map(|drive| drive.address).collect();
        let (mut stations, mut ends) = (Vec::new(), Ends::default());
        for drive in &plan.drives {
            let (station, native, acyclic) = Station::new(drive, &carriers.log());
            stations.push(station);
            ends.push(native, acyclic);
        }
        let note =
            |(drive, station): (&LinUdpDrive, &Station)| (drive.address, drive.serial, station.serial_note());
        let notes = SerialNotes(plan.drives.iter().zip(&stations).map(note).collect());
        let drives = || plan.drives.iter().map(|drive| last_resort(drive, period_ns)).collect();
        let last = |twin| LastResort::new(twin, drives(), &locks);
        let last_resort = twin.filter(|_| !plan.drives.is_empty()).map(last).transpose().map_err(refused)?;
        for (index, station) in stations.iter_mut().enumerate() {
            if let Some(last) = &last_resort {
                station.note_power_in(last.power_sent(index));
            }
        }
        let bus = LinUdpBus {
            net,
            outbox: Outbox::new(&peers, REQUEST_MAX),
            stations,
            senders: Senders::new(&peers),
            unmatched: Unmatched::default(),
            is_ending: false,
            is_prepared: false,
            is_void: false,
            _locks: locks,
        };
        Ok(Opened { last_resort, ..Opened::new(bus, ends, notes) })
    }

    /// Takes in what is in the socket and hands each datagram to the station of its sender.
    fn take_in(&mut self, in_window: bool, slots: &mut [Slot]) {
        let LinUdpBus { net, stations, senders, unmatched, is_void, .. } = self;
        let is_taken = net::take_in(&mut **net, &mut |datagram| {
            let Some((index, is_its_port)) = senders.find(&datagram.from) else {
                unmatched.datagrams += 1;
                return;
            };
            let (Some(station), Some(slot)) = (stations.get_mut(index), slots.get_mut(index)) else {
                return;
            };
            if !is_its_port {
                slot.counters.foreign += 1;
            } else if datagram.truncated {
                slot.counters.malformed += 1;
            } else {
                station.take(datagram.at, datagram.bytes, in_window, slot);
                *is_void |= station.is_void();
            }
        });
        unmatched.errors += u64::from(!is_taken);
    }

    /// Builds the requests again that do not hold any more.
    #[cold]
    fn prepare_again(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        for (index, (station, slot)) in self.stations.iter_mut().zip(slots).enumerate() {
            if slot.due && !self.is_ending && station.is_void() {
                let length = station.prepare(cycle, slot, self.outbox.room(index));
                self.outbox.set_length(index, length);
            }
        }
    }

    /// A panic kept the requests from being built: none of them leaves.
    #[cold]
    fn send_nothing(&mut self, slots: &mut [Slot]) {
        for (index, slot) in slots.iter_mut().enumerate() {
            self.outbox.post(index, false);
            if slot.due && !self.is_ending {
                slot.unsent();
            }
        }
    }
}

/// Of drives that have to be certain ones: why one is not connected although it answers.
#[derive(Debug)]
struct SerialNotes(Vec<(SocketAddrV4, Option<Serial>, NoteCells<SerialNote>)>);

impl Notes for SerialNotes {
    fn get(&self, index: usize) -> Option<String> {
        let (address, serial, note) = self.0.get(index)?;
        Some(format!("{address}: {}", note.get(0).text((*serial)?)?))
    }
}

/// The drives by their addresses.
#[derive(Debug)]
struct Senders {
    /// Those of the drives, in slot order.
    peers: Box<[SocketAddrV4]>,
    /// In order, each with its drive.
    by_address: Box<[(Ipv4Addr, usize)]>,
    /// The drive after the last one that was found: replies mostly come in the order of their requests.
    next: usize,
}

impl Senders {
    fn new(peers: &[SocketAddrV4]) -> Senders {
        let mut by_address: Box<[_]> =
            peers.iter().enumerate().map(|(index, peer)| (*peer.ip(), index)).collect();
        by_address.sort_unstable();
        Senders { peers: peers.into(), by_address, next: 0 }
    }

    /// The drive with this address, and whether it is its port.
    #[inline]
    fn find(&mut self, from: &SocketAddrV4) -> Option<(usize, bool)> {
        let found = match self.peers.get(self.next) {
            Some(peer) if peer == from => (self.next, true),
            _ => self.search(from)?,
        };
        let behind = found.0 + 1;
        self.next = if behind < self.peers.len() { behind } else { 0 };
        Some(found)
    }

    #[inline(never)]
    fn search(&self, from: &SocketAddrV4) -> Option<(usize, bool)> {
        let place = self.by_address.binary_search_by_key(from.ip(), |(ip, _)| *ip).ok()?;
        let (_, index) = *self.by_address.get(place)?;
        Some((index, self.peers.get(index)?.port() == from.port()))
    }
}

impl Bus for LinUdpBus {
    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        self.net.memory(regions);
        self.outbox.memory(regions);
        regions.add(&*self.stations);
        regions.add(&*self.senders.peers);
        regions.add(&*self.senders.by_address);
        for station in &self.stations {
            station.memory(regions);
        }
    }

    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        // A system call in each cycle, although usually nothing waits: a copy of an old reply that has come since the
        // last window would pass for the next reply, if the definitions of both are the same.
        self.take_in(false, slots);
        if std::mem::take(&mut self.is_void) {
            self.prepare_again(cycle, slots);
        }
        if !std::mem::take(&mut self.is_prepared) {
            self.send_nothing(slots);
        }
        self.net.send(&mut self.outbox);
        for (index, (station, slot)) in self.stations.iter_mut().zip(slots).enumerate() {
            if matches!(slot.exchange, Exchange::Owed { .. }) {
                station.owe(slot);
            }
            match self.outbox.take_sent(index) {
                Sent::At(at) => station.sent(at, cycle, slot),
                Sent::Failed(_) | Sent::Posted => slot.unsent(),
                Sent::Idle => {}
            }
        }
    }

    fn receive(&mut self, _cycle: &Cycle, slots: &mut [Slot]) {
        self.take_in(true, slots);
    }

    fn waits(&self, cycle: &Cycle, slots: &[Slot]) -> Waits {
        let of = |slot: &Slot| {
            let earlier = if slot.has_earlier { slot.earlier.waited_for(cycle) } else { 0 };
            usize::from(slot.exchange.is_waited_for(cycle)) + earlier
        };
        Waits::for_replies(slots.iter().map(of).sum())
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        (self.is_prepared, self.is_void) = (false, false);
        for (index, (station, slot)) in self.stations.iter_mut().zip(slots).enumerate() {
            let goes = slot.due && !self.is_ending;
            if goes {
                let length = station.prepare(cycle, slot, self.outbox.room(index));
                self.outbox.set_length(index, length);
            }
            self.outbox.post(index, goes);
        }
        self.is_prepared = true;
    }

    fn native(&self, index: usize) -> Option<(&dyn Inputs, &[u8])> {
        let inputs = self.stations.get(index)?.native();
        Some((inputs, self.outbox.bytes(index)))
    }

    fn shut_down(&mut self, _cycle: &Cycle, slots: &mut [Slot]) -> bool {
        // The drives keep no connection: once the axes are down, nothing more has to be sent, but what is owed has its
        // time.
        self.is_ending = true;
        slots.iter_mut().for_each(|slot| slot.expected_silence = true);
        !slots.iter().any(|slot| slot.has_earlier || matches!(slot.exchange, Exchange::Owed { .. }))
    }

    fn numbers(&self) -> BusNumbers {
        Unmatched { dropped: self.net.dropped(), ..self.unmatched }.into()
    }
}

impl BusPlan for LinUdpPlan {
    fn name(&self) -> &str {
        &self.name
    }

    fn axes(&self) -> Vec<&AxisPlan> {
        self.drives.iter().map(|drive| &drive.axis).collect()
    }

    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)> {
        let same: fn(&LinUdpDrive, &LinUdpDrive) -> bool =
            |one, other| one.address.ip() == other.address.ip();
        let taken = "is taken by another drive; one drive per IP address";
        drives::faults(&self.drives, period_ns, |drive| &drive.axis, LinUdpDrive::faults, same, taken)
    }

    fn facts(&self, _grid: Grid) -> BusFacts {
        let drive = |drive: &LinUdpDrive| DriveFacts {
            reply_within: ReplyWithin::Cycles(drive.replies_within()),
            monitored: drive.monitor.channels(),
            has_last_resort: true,
            ..DriveFacts::at(drive.address, profile::capabilities(drive))
        };
        BusFacts {
            load: Some(Load::new(Medium::Datagrams, Way::Address(*self.bind.ip()), SHORTEST)),
            local: Some(self.bind),
            own_counters: &OWN,
            fault_names: |code| u16::try_from(code).ok().and_then(|code| ErrorCode(code).name()),
            diagnosis: &DIAGNOSIS,
            ..BusFacts::new(super::PROTOCOL, Upids, self.drives.iter().map(drive).collect())
        }
    }

    fn describe(&self, grid: Grid) -> Vec<String> {
        self.drives.iter().map(|drive| drive.describe(self.bind, grid.period_ns)).collect()
    }

    fn native_layout(&self, _index: usize) -> NativeLayout {
        layout()
    }

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        LinUdpBus::open(self, period_ns, carriers)
    }

    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let mut drive = self.drives.get(index)?.clone();
        drive.axis.on_found_running = FoundRunning::Refuse;
        drive.monitor = MonitorPlan::Off;
        Some(Box::new(LinUdpPlan { drives: vec![drive], ..self.clone() }))
    }

    fn variant(&self, wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        Some(Box::new(LinUdpPlan::variant(self, wanted)?))
    }
}
