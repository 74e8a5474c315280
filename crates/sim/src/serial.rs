//! Drives on one serial wire: half duplex, each receives what everybody sends, and what is sent at the same time
//! collides.
//!
//! A wire is a machine of state and time, the same behind a real port and in virtual time. Bytes take the time of their
//! bits. What the master sends meets the faults when it has arrived, what a drive sends before it begins.

use std::any::Any;
use std::collections::VecDeque;
use std::net::{Ipv4Addr, SocketAddrV4};

use super::FaultPlan;
use super::drives::SHORTEST_RUN_NS;
use super::fault::{Datagram, DriveFault, Injected, Injector, Parcel, Queue, Way};
use fieldbeat_core::net::SerialLine;
use fieldbeat_core::time::Time;

/// The most telegrams under way in one direction; more are lost.
const UNDER_WAY: usize = 64;
/// What the driver of the master's port takes of what has not left, bytes (one page, as in Linux).
const DRIVER: usize = 4_096;
/// The most bytes that wait for the master; more are lost, as in the kernel's buffer.
const INBOX: usize = 4_096;
/// The initial capacity of every buffer, bytes: any telegram, so that none grows in use.
const LEAST_ROOM: usize = 512;
/// The sender that is the master; the drives follow.
const MASTER: usize = 0;

/// One simulated drive on a serial wire.
pub trait SimSerial: Any + Send {
    /// Bytes that the master or another drive has sent in a row; the last one ended at `now`. Those that collided with
    /// others are 0.
    fn receive(&mut self, now: Time, bytes: &[u8]);

    /// When it wants to run by its own clock, to answer for example; queried after every other call. What was due
    /// before the wire's first moment runs then.
    fn next_due(&self) -> Option<Time>;

    /// Its own clock has come to that: what it appends to `out` it sends from now on.
    fn run(&mut self, now: Time, out: &mut Vec<u8>);

    /// It is behind a real port from now on: bytes come when the host delivers them, so that silence between them says
    /// little.
    fn untimed(&mut self) {}

    /// Gives a telegram of its own the identity of another one.
    fn mislabel(&self, _telegram: &mut [u8]) {}

    /// Power cycle: everything volatile is lost.
    fn restart(&mut self, now: Time);

    /// Its hardware enable (STO) is open until then.
    fn open_sto(&mut self, until: Time);
}

/// Simulated drives and the wire that they share.
pub struct SerialWire {
    /// The master's port, as its bus names it.
    pub port: String,
    /// The port at this end of the cable, where the master's is a real one.
    pub own_port: Option<String>,
    /// How bytes are sent on it. A master with other settings receives and sends nothing but zeros.
    pub line: SerialLine,
    /// The master receives what it sends itself, as with a two-wire adapter.
    pub echo: bool,
    /// The faults of its telegrams, each like a datagram. A fault of a drive itself hits the drives in turn.
    pub faults: FaultPlan,
    /// The drives.
    pub drives: Vec<Box<dyn SimSerial>>,
}

impl std::fmt::Debug for SerialWire {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SerialWire").field("port", &self.port).field("drives", &self.drives.len()).finish()
    }
}

/// Bytes in a row on the wire.
struct Sending {
    by: usize,
    from: Time,
    bytes: Vec<u8>,
    /// How many of them the master has in its inbox.
    taken: usize,
}

/// A wire with its state.
pub(super) struct Medium {
    pub(super) wire: SerialWire,
    injector: Injector,
    /// What is on the wire, or follows at once.
    sending: Vec<Sending>,
    /// By [`Way`]: requests to be received, and replies that are to begin.
    under_way: [Queue; 2],
    /// Until when each drive rests.
    rests: Vec<Time>,
    inbox: VecDeque<u8>,
    out: Vec<u8>,
    /// Buffers of what has ended, for reuse: a wire does not allocate.
    spare: Vec<Vec<u8>>,
    /// The master has other settings.
    garbled: bool,
    /// Its first moment: no drive runs before it.
    begun: Option<Time>,
}

impl Medium {
    pub(super) fn new(wire: SerialWire) -> Medium {
        Medium {
            injector: Injector::of_bytes(wire.faults.clone()),
            sending: Vec::with_capacity(UNDER_WAY),
            under_way: [Queue::new(UNDER_WAY), Queue::new(UNDER_WAY)],
            rests: vec![Time::default(); wire.drives.len()],
            inbox: VecDeque::with_capacity(INBOX),
            out: Vec::with_capacity(LEAST_ROOM),
            spare: (0..UNDER_WAY).map(|_| Vec::with_capacity(LEAST_ROOM)).collect(),
            garbled: false,
            begun: None,
            wire,
        }
    }

    /// The master sends and receives with these settings.
    pub(super) fn set_master(&mut self, line: &SerialLine) {
        self.garbled = !line.agrees_with(&self.wire.line);
    }

    /// Uses the faults of `plan` from now on; the counts restart.
    pub(super) fn change(&mut self, plan: FaultPlan) {
        self.injector.change(plan);
    }

    /// The faults of its telegrams so far.
    pub(super) fn injected(&self) -> Injected {
        self.injector.injected()
    }

    fn end(&self, sending: &Sending) -> Time {
        sending.from + self.wire.line.span_ns(sending.bytes.len())
    }

    /// When the next thing happens.
    pub(super) fn next_due(&self) -> Option<Time> {
        let ends = self.sending.iter().map(|sending| self.end(sending));
        let queues = self.under_way.iter().filter_map(Queue::next_due);
        ends.chain(queues).chain(self.drive_due().map(|(due, _)| due)).min()
    }

    fn drive_due(&self) -> Option<(Time, usize)> {
        let drives = self.wire.drives.iter().zip(&self.rests).enumerate();
        drives.filter_map(|(k, (drive, rests))| Some((drive.next_due()?.max(*rests), k))).min()
    }

    /// The master hands bytes to its driver; how many it takes.
    pub(super) fn write(&mut self, now: Time, bytes: &[u8]) -> usize {
        self.begun.get_or_insert(now);
        let count = bytes.len().min(DRIVER - self.unsent(now).min(DRIVER));
        if count > 0 {
            let mut telegram = self.buffer(&bytes[..count]);
            if self.garbled {
                telegram.fill(0);
            }
            self.begin(now, MASTER, telegram);
        }
        count
    }

    /// A copy of `bytes` in a reused buffer, if there is one.
    fn buffer(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut buffer = self.spare.pop().unwrap_or_else(|| Vec::with_capacity(LEAST_ROOM));
        buffer.clear();
        buffer.extend_from_slice(bytes);
        buffer
    }

    /// Nothing of it is on the wire any more.
    fn recycle(&mut self, sending: Sending) {
        if self.spare.len() < UNDER_WAY {
            self.spare.push(sending.bytes);
        }
    }

    /// How many bytes of the master have not begun.
    pub(super) fn unsent(&self, now: Time) -> usize {
        let own = self.sending.iter().filter(|sending| sending.by == MASTER);
        own.map(|sending| sending.bytes.len() - self.begun(sending, now)).sum()
    }

    /// How many bytes of `sending` have begun by now.
    fn begun(&self, sending: &Sending, now: Time) -> usize {
        let count = |k: &usize| sending.from + self.wire.line.span_ns(*k) <= now;
        (0..sending.bytes.len()).take_while(count).count()
    }

    /// Drops what the master has not taken in, and what it has not begun to send.
    pub(super) fn discard(&mut self, now: Time) {
        self.deliver(now);
        self.inbox.clear();
        for k in 0..self.sending.len() {
            if self.sending[k].by == MASTER {
                let begun = self.begun(&self.sending[k], now);
                self.sending[k].bytes.truncate(begun);
            }
        }
        while let Some(k) = self.sending.iter().position(|sending| sending.bytes.is_empty()) {
            let sending = self.sending.swap_remove(k);
            self.recycle(sending);
        }
    }

    /// `by` sends `bytes` from now on, or behind what it still sends. What overlaps with others is lost at both.
    fn begin(&mut self, now: Time, by: usize, bytes: Vec<u8>) {
        let own = self.sending.iter().filter(|sending| sending.by == by);
        let from = own.map(|sending| self.end(sending)).max().map_or(now, |end| end.max(now));
        let mut new = Sending { by, from, bytes, taken: 0 };
        let line = self.wire.line;
        for other in self.sending.iter_mut().filter(|other| other.by != by) {
            let end = |sending: &Sending| sending.from + line.span_ns(sending.bytes.len());
            let (begin, end) = (other.from.max(new.from), end(other).min(end(&new)));
            for sending in [&mut *other, &mut new] {
                let from = sending.from;
                for (k, byte) in sending.bytes.iter_mut().enumerate() {
                    if from + line.span_ns(k) < end && begin < from + line.span_ns(k + 1) {
                        *byte = 0;
                    }
                }
            }
        }
        self.sending.push(new);
    }

    /// Whether something waits for the master.
    pub(super) fn is_readable(&self, now: Time) -> bool {
        let line = self.wire.line;
        let arrived = |sending: &Sending| {
            sending.taken < sending.bytes.len() && sending.from + line.span_ns(sending.taken + 1) <= now
        };
        let received = |sending: &&Sending| sending.by != MASTER || self.wire.echo;
        !self.inbox.is_empty() || self.sending.iter().filter(received).any(arrived)
    }

    /// The master takes in what has arrived; how much of `room` is filled.
    pub(super) fn read(&mut self, now: Time, room: &mut [u8]) -> usize {
        self.deliver(now);
        self.read_ended(room)
    }

    /// The same of what had arrived when a telegram ended last.
    pub(super) fn read_ended(&mut self, room: &mut [u8]) -> usize {
        // Reading from this queue of bytes cannot fail, nor wait.
        std::io::Read::read(&mut self.inbox, room).unwrap_or(0)
    }

    /// Whole bytes come to the master, as they end.
    fn deliver(&mut self, now: Time) {
        let Medium { sending, inbox, wire, garbled, .. } = self;
        for sending in sending.iter_mut().filter(|sending| sending.by != MASTER || wire.echo) {
            while sending.taken < sending.bytes.len()
                && sending.from + wire.line.span_ns(sending.taken + 1) <= now
            {
                let byte = if *garbled { 0 } else { sending.bytes[sending.taken] };
                if inbox.len() < INBOX {
                    inbox.push_back(byte);
                }
                sending.taken += 1;
            }
        }
    }

    /// The next thing that is due by `now` happens: the telegram that was received or has begun, and when. False: there
    /// is nothing.
    pub(super) fn step(&mut self, now: Time, passed: &mut dyn FnMut(Time, Way, &Parcel)) -> bool {
        let begun = *self.begun.get_or_insert(now);
        let Some(due) = self.next_due().filter(|due| *due <= now) else { return false };
        if let Some(k) = self.sending.iter().position(|sending| self.end(sending) <= due) {
            self.deliver(due);
            let sending = self.sending.swap_remove(k);
            self.ended(due, &sending);
            self.recycle(sending);
        } else if let Some((_, parcel)) = self.under_way[Way::Request as usize].pop(due) {
            passed(due, Way::Request, &parcel);
            self.wire.drives.iter_mut().for_each(|drive| drive.receive(due, &parcel.bytes));
            self.under_way[Way::Request as usize].recycle(parcel);
        } else if let Some((_, mut parcel)) = self.under_way[Way::Reply as usize].pop(due) {
            let by = usize::from(parcel.from.port() / 2);
            if let Some(drive) = by.checked_sub(1).and_then(|k| self.wire.drives.get(k))
                && parcel.from != address(by)
            {
                drive.mislabel(&mut parcel.bytes);
            }
            passed(due, Way::Reply, &parcel);
            let telegram = self.buffer(&parcel.bytes);
            self.begin(due, by, telegram);
            self.under_way[Way::Reply as usize].recycle(parcel);
        } else if let Some((_, k)) = self.drive_due() {
            self.run_drive(due.max(begun), k);
        }
        true
    }

    /// The last byte of `sending` has ended: everybody else has received it.
    fn ended(&mut self, now: Time, sending: &Sending) {
        if sending.by == MASTER {
            self.pass(Way::Request, now, MASTER, &sending.bytes);
        } else {
            for (k, drive) in self.wire.drives.iter_mut().enumerate() {
                if k + 1 != sending.by {
                    drive.receive(now, &sending.bytes);
                }
            }
        }
    }

    fn run_drive(&mut self, now: Time, k: usize) {
        let mut out = std::mem::take(&mut self.out);
        out.clear();
        self.rests[k] = now + SHORTEST_RUN_NS;
        self.wire.drives[k].run(now, &mut out);
        if !out.is_empty() {
            self.pass(Way::Reply, now, k + 1, &out);
        }
        self.out = out;
    }

    fn pass(&mut self, way: Way, now: Time, by: usize, bytes: &[u8]) {
        let telegram = Datagram { from: address(by), to: address(MASTER), bytes };
        let queue = &mut self.under_way[way as usize];
        let fault = self.injector.pass(way, now, now, telegram, |_| {}, queue);
        let Some(fault) = fault else { return };
        let place = fault.place(self.injector.injected(), self.wire.drives.len());
        match fault {
            DriveFault::Restart => self.restart(now, place),
            DriveFault::OpenSto(until) => self.open_sto(place, until),
        }
    }

    /// Power cycle of the drive at `place`.
    pub(super) fn restart(&mut self, now: Time, place: usize) {
        if let Some(drive) = self.wire.drives.get_mut(place) {
            drive.restart(now);
        }
    }

    /// The hardware enable of the drive at `place` is open until then.
    pub(super) fn open_sto(&mut self, place: usize, until: Time) {
        if let Some(drive) = self.wire.drives.get_mut(place) {
            drive.open_sto(until);
        }
    }
}

/// A placeholder address of a sender, where faults need one: an even port, so that that of a wrong identity is odd.
fn address(by: usize) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, u16::try_from(2 * by).unwrap_or(u16::MAX))
}

#[cfg(test)]
pub(crate) mod tests;
