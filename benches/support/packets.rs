//! Class 1 packets on sockets: our loop over MOONS' drives, in turns with the least that any scanner has to do.

use std::cell::RefCell;
use std::io::{self, ErrorKind};
use std::net::{SocketAddrV4, UdpSocket};
use std::os::fd::{BorrowedFd, RawFd};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fieldbeat::Wait;
use fieldbeat::time::Time;
use fieldbeat_core::cycle::record::{DriveRecord, Record, Stage};
use fieldbeat_core::net::{Carriers, Datagrams, Os, Outbox, Received, Sent, StreamPeer, Streams, UdpOptions};
use fieldbeat_core::rt::{Clock, MonotonicClock, Regions};
use fieldbeat_ethernet_ip::wire::io::Outgoing;

use super::fleet::{Fleet, Side};
use super::rig::{self, Calls, Count, Pace, Rig};

/// What both measured, a cycle each.
#[derive(Debug, Default)]
pub struct Packets {
    /// Our send phase, and the whole of the bare loop's cycle, ns.
    pub ours: Vec<u64>,
    /// See `ours`.
    pub bare: Vec<u64>,
    /// Our system calls.
    pub calls: Vec<Count>,
    /// How old the status of each drive is when a cycle publishes it, ns.
    pub ages: Vec<u64>,
}

/// Lets both run in turns for so many cycles, each half a period behind the other, with drives of its own. Ours makes
/// its system calls on `carriers`, where they are counted in `calls`.
///
/// # Errors
///
/// What kept the bare loop from measuring.
pub fn duel(
    fleet: Fleet,
    period_ns: u64,
    cycles: usize,
    carriers: &dyn Carriers,
    calls: &Calls,
) -> io::Result<Packets> {
    let mut bare = BarePackets::open(fleet, period_ns)?;
    let cycle = rig::exchange_cycle(period_ns, Wait::Poll);
    let mut rig = Rig::new(cycle, fleet.buses(Side::Ours), Pace::Grid, carriers, Arc::clone(calls));
    // A drive that gets no packets for two seconds closes its connection.
    let mut bare_sent = Ok(0);
    rig.enable_with(|grid| {
        if bare_sent.is_ok() {
            bare_sent = bare.cycle(grid + period_ns / 2);
        }
    });
    bare_sent?;
    let mut packets = Packets::default();
    for _ in 0..cycles {
        let executed = rig.status().executed;
        let (mut sending, ages) = (None, &mut packets.ages);
        let turn = rig.turn(|record| match record {
            Record::Cycle(cycle) => sending = Some(cycle.stages_ns[Stage::Send as usize]),
            Record::Drive(DriveRecord { age_ns: Some(age_ns), .. }) => ages.push(age_ns.get().into()),
            _ => {}
        });
        let bare = bare.cycle(rig.grid() + period_ns / 2)?;
        if let Some(sending) = sending
            && rig.status().executed > executed
        {
            packets.ours.push(sending.into());
            packets.bare.push(bare);
            packets.calls.push(turn.calls);
        }
    }
    Ok(packets)
}

/// Our loop has opened the connections and enabled the drives, and is left standing. What it sent last is sent again
/// with the next numbers.
struct BarePackets {
    socket: UdpSocket,
    packets: Vec<(SocketAddrV4, Vec<u8>)>,
    sequence: u32,
    _rig: Rig,
}

impl BarePackets {
    fn open(fleet: Fleet, period_ns: u64) -> io::Result<BarePackets> {
        let taps = Taps::default();
        let cycle = rig::exchange_cycle(period_ns, Wait::Poll);
        let mut rig = Rig::new(cycle, fleet.buses(Side::Bare), Pace::Grid, &taps, Calls::default());
        rig.enable();
        // Until all of them are idle, as in almost all cycles.
        for _ in 0..50 {
            rig.turn(|_| {});
        }
        let tap = taps.tap.into_inner().ok_or(ErrorKind::NotFound)?;
        let tap = tap.lock().unwrap_or_else(PoisonError::into_inner);
        let fd = tap.net.fd().ok_or(ErrorKind::NotFound)?;
        // SAFETY: the carrier keeps its descriptor open while it is locked.
        let socket: UdpSocket = unsafe { BorrowedFd::borrow_raw(fd) }.try_clone_to_owned()?.into();
        socket.set_nonblocking(true)?;
        // No number of before comes again.
        Ok(BarePackets { socket, packets: tap.packets.clone(), sequence: 1 << 20, _rig: rig })
    }

    /// From the end of the sleep on: a packet to each drive, then all that has come, ns.
    fn cycle(&mut self, grid: Time) -> io::Result<u64> {
        MonotonicClock.sleep_until(grid);
        let woke = MonotonicClock::read();
        self.sequence += 1;
        for (peer, packet) in &mut self.packets {
            Outgoing::number(packet, self.sequence, self.sequence as u16);
            self.socket.send_to(packet, *peer)?;
        }
        let mut room = [0; 128];
        while self.socket.recv_from(&mut room).is_ok() {}
        Ok(MonotonicClock::read().since(woke))
    }
}

/// A carrier, and what was sent last to each peer.
struct Tap {
    net: Box<dyn Datagrams>,
    packets: Vec<(SocketAddrV4, Vec<u8>)>,
}

struct Tapped(Arc<Mutex<Tap>>);

/// The carriers of the operating system; keeps hold of the one that is opened.
#[derive(Default)]
struct Taps {
    os: Os,
    tap: RefCell<Option<Arc<Mutex<Tap>>>>,
}

impl Carriers for Taps {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        let net = self.os.datagrams(bind, options)?;
        let tap = Arc::new(Mutex::new(Tap { net, packets: Vec::new() }));
        self.tap.replace(Some(Arc::clone(&tap)));
        Ok(Box::new(Tapped(tap)))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        self.os.streams(peers)
    }
}

impl Tapped {
    fn lock(&self) -> MutexGuard<'_, Tap> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Datagrams for Tapped {
    fn fd(&self) -> Option<RawFd> {
        self.lock().net.fd()
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let mut tap = self.lock();
        let posted = (0..outbox.len()).all(|index| outbox.sent(index) == Sent::Posted);
        if posted {
            tap.packets =
                (0..outbox.len()).map(|index| (outbox.peer(index), outbox.bytes(index).to_vec())).collect();
        }
        tap.net.send(outbox);
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        self.lock().net.receive(take)
    }

    fn batch(&self) -> usize {
        self.lock().net.batch()
    }

    fn memory(&self, regions: &mut Regions) {
        self.lock().net.memory(regions);
    }
}
