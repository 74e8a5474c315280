//! A serial wire, written down: drives that hear what everybody sends, each with faults of its own, and the master's
//! port.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::RawFd;

use fieldbeat::Time;
use fieldbeat::sim::{Carrier, FaultPlan, SimSerial};
use fieldbeat_core::net::{Broken, LinkNotes, Serial, Streams};
use fieldbeat_core::rt::Regions;
use fieldbeat_sim::fault::{Datagram, Injector, Queue, Way};

use super::{Delivery, Wire};
use crate::conformance::subject::{NoMessage, Said};

/// Nobody has an address here.
const NOBODY: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);

/// A drive on a wire.
pub(super) struct TappedSlave {
    drive: Box<dyn SimSerial>,
    index: usize,
    wire: Wire,
    faults: Injector,
    /// Its answers come so much later than usual.
    answer_ns: u64,
    /// What is under way to it and from it.
    requests: Queue,
    replies: Queue,
    said: Option<Said>,
    reported: Option<Said>,
    /// The request that it has, and has not answered.
    requested: bool,
}

impl TappedSlave {
    pub(super) fn new(drive: Box<dyn SimSerial>, index: usize, wire: Wire) -> TappedSlave {
        let faults = Injector::new(FaultPlan::default(), Carrier::Datagrams);
        TappedSlave {
            drive,
            index,
            wire,
            faults,
            answer_ns: 0,
            requests: Queue::new(64),
            replies: Queue::new(64),
            said: None,
            reported: None,
            requested: false,
        }
    }

    /// Brings about what shall befall it.
    fn befall(&mut self) {
        let Wire { subject, log, .. } = &self.wire;
        let tape = &mut log.lock().unwrap().drives[self.index];
        if let Some(plan) = tape.faults.take() {
            self.answer_ns = plan.answer_ns.saturating_sub(tape.usual.answer_ns);
            self.faults = Injector::new(FaultPlan { answer_ns: 0, ..plan }, Carrier::Datagrams);
        }
        if tape.meddled.take().is_some() {
            subject.provoke_slave(&mut *self.drive);
        }
    }

    /// The drive gets a request that is its own.
    fn take(&mut self, now: Time, bytes: &[u8]) {
        let Wire { subject, log, .. } = &self.wire;
        let mut log = log.lock().unwrap();
        let tape = &mut log.drives[self.index];
        self.requested = subject.is_exchange(bytes, tape.open);
        tape.open = subject.opens(bytes, tape.open);
        if self.requested {
            tape.received.push(Delivery {
                at: now,
                request: bytes.to_vec(),
                reply: Vec::new(),
                said: None,
                reported: None,
            });
        }
        drop(log);
        self.drive.receive(now, bytes);
    }

    /// The drive sends this.
    fn answer(&mut self, bytes: &[u8]) -> bool {
        let Wire { subject, log, .. } = &self.wire;
        let tape = &mut log.lock().unwrap().drives[self.index];
        if tape.unplugged {
            return false;
        }
        if std::mem::take(&mut self.requested)
            && let Some(delivery) = tape.received.last_mut()
        {
            delivery.reply = bytes.to_vec();
            let said = subject.said(self.said, &delivery.request, bytes);
            self.said = said.or(self.said);
            delivery.said = said;
            if !tape.mute {
                let reported = subject.said(self.reported, &delivery.request, bytes);
                self.reported = reported.or(self.reported);
                delivery.reported = reported;
            }
        }
        !tape.mute
    }
}

impl SimSerial for TappedSlave {
    fn receive(&mut self, now: Time, bytes: &[u8]) {
        self.befall();
        if self.wire.log().drives[self.index].unplugged {
            return;
        }
        if self.wire.subject.requested(bytes) != Some(self.index) {
            return self.drive.receive(now, bytes);
        }
        let datagram = Datagram { from: NOBODY, to: NOBODY, bytes };
        self.faults.pass(Way::Request, now, now, datagram, |_| {}, &mut self.requests);
        while let Some((_, parcel)) = self.requests.pop(now) {
            self.take(now, &parcel.bytes);
            self.requests.recycle(parcel);
        }
    }

    fn next_due(&self) -> Option<Time> {
        let injected = self.wire.log().drives[self.index].injected.iter().map(|(at, _)| *at).min();
        let queues = [self.requests.next_due(), self.replies.next_due()].into_iter().flatten();
        self.drive.next_due().into_iter().chain(queues).chain(injected).min()
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        while let Some((_, parcel)) = self.requests.pop(now) {
            self.take(now, &parcel.bytes);
            self.requests.recycle(parcel);
        }
        if self.drive.next_due().is_some_and(|due| due <= now) {
            let mut bytes = Vec::new();
            self.drive.run(now, &mut bytes);
            if !bytes.is_empty() && self.answer(&bytes) {
                let datagram = Datagram { from: NOBODY, to: NOBODY, bytes: &bytes };
                let drive = &self.drive;
                self.faults.pass(
                    Way::Reply,
                    now,
                    now + self.answer_ns,
                    datagram,
                    |bytes| drive.mislabel(bytes),
                    &mut self.replies,
                );
            }
        }
        while let Some((_, mut parcel)) = self.replies.pop(now) {
            if parcel.from != NOBODY {
                self.drive.mislabel(&mut parcel.bytes);
            }
            out.extend(&parcel.bytes);
            self.replies.recycle(parcel);
        }
        let mut log = self.wire.log();
        let injected = &mut log.drives[self.index].injected;
        injected.retain(|(at, bytes)| {
            let waits = *at > now;
            if !waits {
                out.extend(bytes);
            }
            waits
        });
    }

    crate::forward! { this => this.drive;
        fn mislabel(&self, telegram: &mut [u8]);
        fn restart(&mut self, now: Time);
        fn open_sto(&mut self, until: Time);
    }
}

/// The master's port.
pub(super) struct TappedSerial {
    pub(super) carrier: Box<dyn Serial>,
    pub(super) wire: Wire,
    /// What the bus took in of the next telegram.
    part: Vec<u8>,
    /// The drive whose turn is, if what it is sent is an exchange.
    turn: Option<usize>,
    sends_rest: bool,
}

impl TappedSerial {
    pub(super) fn new(carrier: Box<dyn Serial>, wire: Wire) -> TappedSerial {
        TappedSerial { carrier, wire, part: Vec::new(), turn: None, sends_rest: false }
    }
}

impl Streams for TappedSerial {
    crate::forward! { this => this.carrier;
        fn fd(&self) -> Option<RawFd>;
        fn opened(&mut self) -> Option<usize>;
        fn look(&mut self);
        fn ready(&mut self) -> Option<usize>;
        fn abandon(&mut self, index: usize, why: &'static str);
        fn notes(&self) -> LinkNotes;
        fn memory(&self, regions: &mut Regions);
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let taken = self.carrier.receive(index, room)?;
        if let (Some((_, count)), Some(turn)) = (taken, self.turn) {
            self.part.extend(&room[..count]);
            while !self.part.is_empty() {
                match self.wire.subject.message(&self.part) {
                    Ok(Some(length)) => drop(self.part.drain(..length)),
                    Ok(None) => break,
                    // Nothing behind it counts.
                    Err(NoMessage) => self.part.clear(),
                }
                self.wire.log().drives[turn].taken += 1;
            }
        }
        Ok(taken)
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let mut log = self.wire.log();
        log.sends += 1;
        let subject = self.wire.subject;
        let to = subject.requested(bytes);
        if let Some(drive) = to {
            let tape = &log.drives[drive];
            if tape.jammed {
                return Ok((Time(0), 0));
            }
            self.turn = subject.is_exchange(bytes, tape.open).then_some(drive);
            self.sends_rest = tape.halved && !self.sends_rest;
        }
        self.part.clear();
        let count = if self.sends_rest { bytes.len() / 2 } else { bytes.len() };
        drop(log);
        self.carrier.send(index, &bytes[..count])
    }
}

impl Serial for TappedSerial {
    crate::forward! { this => this.carrier;
        fn unsent(&mut self) -> Result<usize, Broken>;
        fn discard(&mut self) -> Result<(), Broken>;
        fn is_timed(&self) -> bool;
    }
}
