//! Datagrams in a world: from carrier to drive and back.

use super::*;

/// One carrier's end of the wire.
pub(super) struct Port {
    pub(super) address: SocketAddrV4,
    pub(super) inbox: VecDeque<Parcel>,
    /// Datagrams for which there was no room.
    pub(super) dropped: u64,
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

    /// A datagram comes to a drive.
    pub(super) fn serve(&mut self, index: usize, parcel: &Parcel) {
        let now = self.now;
        let station = &mut self.stations[index];
        if !station.plugged {
            return;
        }
        record(&mut self.digest, now, parcel);
        self.delivered += 1;
        self.reply.clear();
        let to = station.drive.receive(now, parcel.from, &parcel.bytes, &mut self.reply);
        // No drive answers a drive: with a forged source two of them would go on for ever.
        if let Some(to) = to.filter(|to| self.port(*to).is_some() || self.station(*to).is_none()) {
            let station = &mut self.stations[index];
            let reply = Datagram { from: station.address, to, bytes: &self.reply };
            let due = now + self.options.latency_ns;
            station.injector.pass(
                Way::Reply,
                now,
                due,
                reply,
                |bytes| station.drive.mislabel(bytes),
                &mut self.under_way,
            );
        }
    }

    /// A carrier's datagram leaves now.
    pub(super) fn depart(&mut self, datagram: Datagram<'_>) {
        if let Some(index) = self.station(datagram.to) {
            if self.stations[index].plugged {
                self.depart_to(index, datagram);
            }
        } else {
            let parcel = self.under_way.parcel(datagram);
            self.under_way.push(self.now + self.options.latency_ns, parcel);
        }
    }

    /// A request leaves for drive `index` now.
    pub(super) fn depart_to(&mut self, index: usize, request: Datagram<'_>) {
        let due = self.now + self.options.latency_ns;
        let blow = self.stations[index].pass_request(self.now, due, request, &mut self.under_way);
        self.strike(index, blow);
    }
}

/// A carrier of datagrams in a world.
#[derive(Debug)]
pub(super) struct Socket {
    pub(super) world: World,
    pub(super) address: SocketAddrV4,
    pub(super) options: UdpOptions,
    /// The datagrams of the present `receive`.
    pub(super) taken: Vec<Parcel>,
}

impl Datagrams for Socket {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let mut inner = self.world.lock();
        let mut stamp = inner.read();
        for index in 0..outbox.len() {
            if outbox.sent(index) == Sent::Posted {
                if self.options.send == SendMode::Each {
                    stamp = inner.read();
                }
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
