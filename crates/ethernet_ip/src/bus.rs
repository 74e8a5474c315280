//! All drives of one EtherNet/IP bus: stations on one socket, and their sessions, as a [`Bus`].

use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::RawFd;

use super::counters::Own;
use super::exchange;
use super::plan::{Delivery, EthernetIpPlan, IO_PORT};
use super::session::{HANDSHAKE_NS, Session};
use super::station::{ROOM, Station};
use super::target::commanding;
use super::wire::io::{Outgoing, Packet, PacketError};
use fieldbeat_core::axis::acyclic;
use fieldbeat_core::axis::doorbell::Bells;
use fieldbeat_core::bus::native::Inputs;
use fieldbeat_core::bus::{
    Bus, BusNumbers, Cycle, Ends, Notes, OpenError, Opened, Slot, Unmatched, Waits, drives,
};
use fieldbeat_core::net::{
    self, Carriers, Datagrams, LinkNotes, Lock, Outbox, Received, Sent, StreamPeer, Streams, UdpOptions,
};
use fieldbeat_core::rt::Regions;

/// Room for a packet of a drive: those of others are cut off, and counted.
const RECEIVED: usize = 128;

/// One socket, its drives and their sessions.
pub(crate) struct EthernetIpBus {
    net: Box<dyn Datagrams>,
    outbox: Outbox,
    stations: Vec<Station>,
    /// Of the drives, in order, each with its index.
    by_address: Box<[(Ipv4Addr, usize)]>,
    unmatched: Unmatched,
    sessions: Box<dyn Streams>,
    /// Of the sessions that have something to say.
    bells: Bells,
    /// The drives are this master's until their connections are given up.
    _locks: Vec<Lock>,
}

/// Why a drive has no connection: its session, or its TCP connection.
#[derive(Debug)]
struct SessionNotes {
    sessions: Vec<LinkNotes>,
    remarks: Vec<LinkNotes>,
    links: LinkNotes,
}

impl Notes for SessionNotes {
    fn get(&self, index: usize) -> Option<String> {
        self.sessions.get(index).and_then(|notes| notes.get(0)).or_else(|| self.links.get(index))
    }

    fn remark(&self, index: usize) -> Option<String> {
        self.remarks.get(index)?.get(0)
    }
}

impl EthernetIpBus {
    /// Opens the socket of `plan`, which is free of faults, and begins to connect to its drives.
    pub fn open(plan: &EthernetIpPlan, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        // Who only reads or sends explicit messages takes nothing from the one who owns the outputs.
        let owned = plan.drives.iter().filter(|drive| drive.is_owned());
        let locks = drives::lock(&plan.name, owned.map(|drive| (&drive.axis, drive.address)), carriers)?;
        let is_cyclic = plan.drives.iter().any(|drive| drive.cyclic);
        // No packet comes without a connection, and the port may be another master's.
        let bind = if is_cyclic { plan.bind } else { SocketAddrV4::new(*plan.bind.ip(), 0) };
        let groups = plan.drives.iter().filter(|drive| drive.delivery == Delivery::Multicast).count();
        let waiting = plan.drives.iter().map(|drive| drive.axis.health.bucket as usize).max().unwrap_or(0);
        let options =
            UdpOptions { peers: plan.drives.len(), waiting, room: RECEIVED, dscp: plan.dscp, groups };
        let refused = |source| OpenError::bind(&plan.name, plan.bind, source);
        let net = carriers.datagrams(bind, &options).map_err(refused)?;
        let (mut stations, mut peers) = (Vec::new(), Vec::new());
        let (mut notes, mut remarks) = (Vec::new(), Vec::new());
        let mut of_application = Vec::new();
        let bells = Bells::new(plan.drives.len()).logged(&carriers.log());
        for (index, drive) in plan.drives.iter().enumerate() {
            let (loop_end, session_end) = exchange::both(bells.bell(index));
            let (calls, port) = acyclic::queue(drive.axis.parameter_queue, commanding());
            let session = Session::new(plan, index, period_ns, session_end, port, net.groups());
            notes.push(session.notes());
            remarks.push(session.remarks());
            peers.push(StreamPeer {
                // Drives compare the source of packets with the peer of their session.
                bind: Some(*plan.bind.ip()),
                handshake_ns: HANDSHAKE_NS,
                ..StreamPeer::new(drive.address, Box::new(session))
            });
            let (station, native) = Station::new(drive, period_ns, loop_end, &carriers.log());
            stations.push(station);
            of_application.push((native, calls));
        }
        let sessions = carriers
            .streams(peers)
            .map_err(|source| OpenError::Streams { bus: plan.name.clone(), source })?;
        let mut ends = Ends::default();
        for (native, calls) in of_application {
            // Posted calls are carried out at once: the session sleeps otherwise.
            ends.push(
                native,
                match sessions.waker() {
                    Some(waker) => calls.waking(waker),
                    None => calls,
                },
            );
        }
        let destinations: Vec<_> =
            plan.drives.iter().map(|drive| SocketAddrV4::new(*drive.address.ip(), IO_PORT)).collect();
        let mut by_address: Box<[_]> =
            plan.drives.iter().enumerate().map(|(index, drive)| (*drive.address.ip(), index)).collect();
        by_address.sort_unstable();
        let notes = SessionNotes { sessions: notes, remarks, links: sessions.notes() };
        let bus = EthernetIpBus {
            net,
            outbox: Outbox::new(&destinations, ROOM),
            stations,
            by_address,
            unmatched: Unmatched::default(),
            sessions,
            bells,
            _locks: locks,
        };
        Ok(Opened::new(bus, ends, notes))
    }

    /// Takes in what the sessions have to say.
    fn hear(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        if !self.bells.take() {
            return;
        }
        for index in self.bells.rung() {
            if let (Some(station), Some(slot)) = (self.stations.get_mut(index), slots.get_mut(index))
                && let Some(destination) = station.hear(cycle, slot)
            {
                self.outbox.set_peer(index, destination);
            }
        }
        // Whoever says more rings again.
        self.bells.silence(|_| false);
    }

    /// Takes in what is in the socket and hands each packet to the station of its connection.
    fn take_in(&mut self, slots: &mut [Slot]) {
        let EthernetIpBus { net, stations, by_address, unmatched, .. } = self;
        let is_taken = net::take_in(&mut **net, &mut |datagram| {
            // The ids of packets to this master only are its own choice: the index is the upper half of them.
            if let (Ok(packet), false) = (Packet::parse(datagram.bytes), datagram.truncated)
                && let index = (packet.connection >> 16) as usize
                && let (Some(station), Some(slot)) = (stations.get_mut(index), slots.get_mut(index))
                && station.is(*datagram.from.ip(), packet.connection)
            {
                return station.take(datagram.at, &packet, slot);
            }
            unmatched.datagrams += u64::from(!take_other(&datagram, by_address, stations, slots));
        });
        unmatched.errors += u64::from(!is_taken);
    }
}

/// Any other datagram; false: no drive has its address.
#[inline(never)]
fn take_other(
    datagram: &Received<'_>,
    by_address: &[(Ipv4Addr, usize)],
    stations: &mut [Station],
    slots: &mut [Slot],
) -> bool {
    let source = *datagram.from.ip();
    let packet = Packet::parse(datagram.bytes);
    let Ok(place) = by_address.binary_search_by_key(&source, |(ip, _)| *ip) else {
        from_elsewhere(&packet, stations, slots);
        return false;
    };
    let index = by_address.get(place).map_or(usize::MAX, |(_, index)| *index);
    let (Some(station), Some(slot)) = (stations.get_mut(index), slots.get_mut(index)) else { return true };
    match packet {
        Ok(packet) if !datagram.truncated && station.is(source, packet.connection) => {
            station.take_any(datagram.at, packet, slot);
        }
        Ok(packet) if !datagram.truncated => station.foreign(packet.connection, slot),
        Ok(_) => Station::refuse(None, slot),
        Err(why) => Station::refuse(Some(why), slot),
    }
    true
}

/// A packet from an address that no drive has: with the id of a drive's connection, it counts there.
#[cold]
fn from_elsewhere(packet: &Result<Packet<'_>, PacketError>, stations: &[Station], slots: &mut [Slot]) {
    let Ok(Packet { connection, .. }) = *packet else { return };
    let index = (connection >> 16) as usize;
    if let (Some(station), Some(slot)) = (stations.get(index), slots.get_mut(index))
        && station.has(connection)
    {
        Own::WrongSource.count(&mut slot.counters);
    }
}

impl Bus for EthernetIpBus {
    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        self.net.memory(regions);
        self.outbox.memory(regions);
        self.sessions.memory(regions);
        self.bells.memory(regions);
        regions.add(&*self.stations);
        regions.add(&*self.by_address);
        for station in &self.stations {
            station.memory(regions);
        }
    }

    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.net.send(&mut self.outbox);
        for (index, (station, slot)) in self.stations.iter_mut().zip(slots.iter_mut()).enumerate() {
            match self.outbox.take_sent(index) {
                Sent::At(at) => station.sent(at, cycle, slot),
                Sent::Failed(_) | Sent::Posted => slot.unsent(),
                // There is no connection, or a panic kept its packet from being built.
                Sent::Idle if slot.due => slot.unsent(),
                Sent::Idle => {}
            }
        }
        // Before the packets of a connection that has just been opened.
        self.hear(cycle, slots);
        // Packets answer nothing: the window stays open for none of them.
        self.take_in(slots);
        for (station, slot) in self.stations.iter_mut().zip(slots) {
            station.watch(cycle, slot);
        }
    }

    fn receive(&mut self, _cycle: &Cycle, slots: &mut [Slot]) {
        self.take_in(slots);
    }

    /// For no reply.
    fn waits(&self, _cycle: &Cycle, _slots: &[Slot]) -> Waits {
        Waits::for_replies(0)
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        for (index, (station, slot)) in self.stations.iter_mut().zip(slots).enumerate() {
            let built = if slot.due { station.prepare(cycle, slot, self.outbox.room(index)) } else { None };
            if let Some(length) = built {
                self.outbox.set_length(index, length);
            }
            self.outbox.post(index, built.is_some());
        }
    }

    fn native(&self, index: usize) -> Option<(&dyn Inputs, &[u8])> {
        let inputs = self.stations.get(index)?.native();
        Some((inputs, Outgoing::outputs(self.outbox.bytes(index)).unwrap_or_default()))
    }

    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        let mut done = true;
        for (station, slot) in self.stations.iter_mut().zip(slots.iter_mut()) {
            done &= station.shut_down(cycle);
            station.watch(cycle, slot);
        }
        self.hear(cycle, slots);
        done
    }

    fn numbers(&self) -> BusNumbers {
        Unmatched { dropped: self.net.dropped(), ..self.unmatched }.into()
    }

    fn helper_ended(&self) -> bool {
        self.sessions.has_ended()
    }
}
