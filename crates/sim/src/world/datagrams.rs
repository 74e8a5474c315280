//! Datagrams in a world: from carrier to drive and back.

use std::sync::{Arc, Mutex, PoisonError};

use super::*;
use fieldbeat_core::net::groups::Members;

/// One carrier's end of the wire.
pub(super) struct Port {
    pub(super) address: SocketAddrV4,
    pub(super) inbox: VecDeque<Parcel>,
    /// Datagrams for which there was no room.
    pub(super) dropped: u64,
    groups: Arc<PortGroups>,
}

/// The multicast groups of a carrier. A lock of its own: a session may join one while the world is at work.
#[derive(Debug)]
pub(super) struct PortGroups(Mutex<Members<()>>);

impl Groups for PortGroups {
    fn join(&self, group: SocketAddrV4) -> io::Result<()> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).join(group, || Ok(())).map(|_| ())
    }

    fn leave(&self, group: SocketAddrV4) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).leave(group);
    }
}

impl Port {
    pub(super) fn new(address: SocketAddrV4, groups: usize) -> Port {
        let groups = Arc::new(PortGroups(Mutex::new(Members::new(groups))));
        Port { address, inbox: VecDeque::new(), dropped: 0, groups }
    }

    /// Its groups, where there is room for any.
    pub(super) fn groups(&self) -> Arc<PortGroups> {
        Arc::clone(&self.groups)
    }

    fn is_member(&self, group: SocketAddrV4) -> bool {
        self.groups.0.lock().unwrap_or_else(PoisonError::into_inner).has(group)
    }
}

impl Inner {
    pub(super) fn port(&self, address: SocketAddrV4) -> Option<usize> {
        self.ports.iter().position(|port| port.address == address)
    }

    pub(super) fn take_in_datagram(&mut self, port: usize, parcel: Parcel) -> Option<Parcel> {
        if self.ports[port].inbox.len() >= INBOX {
            self.ports[port].dropped += 1;
            return Some(parcel);
        }
        record(&mut self.digest, self.now, &parcel);
        self.delivered += 1;
        self.ports[port].inbox.push_back(parcel);
        None
    }

    /// A datagram comes to a group: each member gets a copy.
    pub(super) fn take_in_group(&mut self, parcel: Parcel) -> Option<Parcel> {
        for port in 0..self.ports.len() {
            if self.ports[port].is_member(parcel.to) {
                let copy = self.under_way.parcel(parcel.datagram());
                if let Some(copy) = self.take_in_datagram(port, copy) {
                    self.under_way.recycle(copy);
                }
            }
        }
        Some(parcel)
    }

    /// A datagram comes to a drive, or bytes on a connection that it has.
    pub(super) fn serve(&mut self, index: usize, parcel: &Parcel) {
        let (now, due) = (self.now, self.now + self.options.latency_ns);
        self.drives.serve(index, now, due, parcel, &mut self.under_way);
    }

    /// The next drive whose own clock has come to it runs; false: there is none.
    pub(super) fn run_drive(&mut self) -> bool {
        let due = self.now + self.options.latency_ns;
        self.drives.run(self.now, due, &mut self.under_way).is_some()
    }

    /// A carrier's datagram leaves now.
    pub(super) fn depart(&mut self, datagram: Datagram<'_>) {
        if let Some(index) = self.drives.station(Carrier::Datagrams, datagram.to) {
            if self.drives.both(index).1.plugged {
                self.depart_to(index, datagram.from, datagram.bytes);
            }
        } else {
            let parcel = self.under_way.parcel(datagram);
            self.under_way.push(self.now + self.options.latency_ns, parcel);
        }
    }

    /// A request leaves for the drive's socket `index` now.
    pub(super) fn depart_to(&mut self, index: usize, from: SocketAddrV4, bytes: &[u8]) {
        let due = self.now + self.options.latency_ns;
        let fault = self.drives.request(index, self.now, due, (from, bytes), &mut self.under_way);
        self.inject(self.drives.stations[index].unit, fault);
    }
}

/// A carrier of datagrams in a world.
#[derive(Debug)]
pub(super) struct Socket {
    pub(super) world: World,
    pub(super) address: SocketAddrV4,
    pub(super) options: UdpOptions,
    pub(super) groups: Arc<PortGroups>,
    /// The datagrams of the present `receive`.
    pub(super) taken: Vec<Parcel>,
}

impl Datagrams for Socket {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let mut inner = self.world.lock();
        let stamp = inner.read();
        for index in 0..outbox.len() {
            if outbox.sent(index) == Sent::Posted {
                let (to, bytes) = (outbox.peer(index), outbox.bytes(index));
                inner.depart(Datagram { from: self.address, to, bytes });
                outbox.note(index, Sent::At(stamp));
            }
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let mut inner = self.world.lock();
        let at = inner.read();
        if let Some(port) = inner.ports.iter_mut().find(|port| port.address == self.address) {
            let count = port.inbox.len().min(BATCH);
            self.taken.extend(port.inbox.drain(..count));
        }
        // `take` may look at the world.
        drop(inner);
        for parcel in &self.taken {
            take(Received {
                from: parcel.from,
                at,
                bytes: &parcel.bytes[..parcel.bytes.len().min(self.options.room)],
                truncated: parcel.bytes.len() > self.options.room,
            });
        }
        let count = self.taken.len();
        if count > 0 {
            let mut inner = self.world.lock();
            self.taken.drain(..).for_each(|parcel| inner.under_way.recycle(parcel));
        }
        Ok(count)
    }

    fn batch(&self) -> usize {
        BATCH
    }

    fn groups(&self) -> Option<Arc<dyn Groups>> {
        (self.options.groups > 0).then(|| Arc::clone(&self.groups) as Arc<dyn Groups>)
    }

    fn dropped(&self) -> u64 {
        let inner = self.world.lock();
        inner.port(self.address).map_or(0, |port| inner.ports[port].dropped)
    }

    /// Virtual time is never real time: nothing to lock.
    fn memory(&self, _regions: &mut Regions) {}
}

/// The address is free again, as when a socket is closed.
impl Drop for Socket {
    fn drop(&mut self) {
        self.world.lock().ports.retain(|port| port.address != self.address);
    }
}
