//! What goes over the wire, written down on its way: drives and carriers that tell what passed through them, and that
//! misbehave where the world's faults cannot (a drive that hears and acts but is not heard, a refused send).

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard};

use fieldbeat::Time;
use fieldbeat::bus::{Bus, BusPlan, OpenError};
use fieldbeat::net::{Carriers, Datagrams, Outbox, Received, Sent, UdpOptions};
use fieldbeat::rt::Regions;
use fieldbeat::sim::{DatagramDrive, FaultPlan};

use crate::subject::{Drive, Said, Subject};

/// ENOBUFS: what a full send buffer answers.
const NO_BUFFER: i32 = 105;

/// One request as its drive heard it.
#[derive(Clone, Debug)]
pub struct Heard {
    pub at: Time,
    pub request: Vec<u8>,
    /// Empty: no answer.
    pub reply: Vec<u8>,
    pub said: Option<Said>,
}

/// One drive's end of the wire.
#[derive(Debug)]
pub struct Tape {
    pub address: SocketAddrV4,
    /// Its wire at its best: a slow drive is no fault.
    pub usual: FaultPlan,
    pub heard: Vec<Heard>,
    /// Hears and acts, but its answers are lost.
    pub mute: bool,
    /// The operating system refuses to send to it.
    pub jammed: bool,
    /// Datagrams that the bus took in from its address.
    pub taken: u64,
}

impl Tape {
    /// What the drive last said.
    pub fn said(&self) -> Said {
        self.heard.iter().rev().find_map(|heard| heard.said).expect("the drive has answered")
    }

    /// The last answer that it gave, as it left.
    pub fn reply(&self) -> Vec<u8> {
        let last = self.heard.iter().rev().find(|heard| !heard.reply.is_empty());
        last.expect("the drive has answered").reply.clone()
    }
}

/// All of one bus's wire.
#[derive(Debug, Default)]
pub struct Log {
    /// In slot order.
    pub drives: Vec<Tape>,
    /// Datagrams that the bus took in from nobody of its own.
    pub strangers: u64,
    /// Where the bus listens.
    pub master: Option<SocketAddrV4>,
    /// Times that the bus handed something to a carrier.
    pub sends: u64,
}

/// A bus plan whose wire is written down.
#[derive(Clone)]
pub struct Wire {
    subject: &'static dyn Subject,
    plan: Arc<dyn BusPlan>,
    log: Arc<Mutex<Log>>,
}

impl Wire {
    pub fn new(subject: &'static dyn Subject, drives: &[Drive]) -> Wire {
        let plan: Arc<dyn BusPlan> = subject.plan(drives).into();
        let tape = |drive: Box<dyn DatagramDrive>| Tape {
            address: drive.address(),
            usual: drive.faults(),
            heard: Vec::new(),
            mute: false,
            jammed: false,
            taken: 0,
        };
        let log = Log { drives: plan.simulate().into_iter().map(tape).collect(), ..Log::default() };
        Wire { subject, plan, log: Arc::new(Mutex::new(log)) }
    }

    pub fn log(&self) -> MutexGuard<'_, Log> {
        self.log.lock().unwrap()
    }

    /// Where drive `index` listens.
    pub fn address(&self, index: usize) -> SocketAddrV4 {
        self.log().drives[index].address
    }

    /// Where the bus listens.
    pub fn master(&self) -> SocketAddrV4 {
        self.log().master.expect("the bus is open")
    }
}

impl std::fmt::Debug for Wire {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.plan.fmt(f)
    }
}

impl BusPlan for Wire {
    crate::forward_bus_plan!(plan);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        self.plan.open(period_ns, &Tapped { carriers, wire: self })
    }

    fn simulate(&self) -> Vec<Box<dyn DatagramDrive>> {
        let tap = |(index, drive)| Box::new(TappedDrive { drive, index, wire: self.clone() }) as Box<_>;
        self.plan.simulate().into_iter().enumerate().map(tap).collect()
    }
}

struct TappedDrive {
    drive: Box<dyn DatagramDrive>,
    index: usize,
    wire: Wire,
}

impl DatagramDrive for TappedDrive {
    fn address(&self) -> SocketAddrV4 {
        self.drive.address()
    }

    fn faults(&self) -> FaultPlan {
        self.drive.faults()
    }

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        let to = self.drive.receive(now, from, bytes, reply);
        let reply = if to.is_some() { reply.clone() } else { Vec::new() };
        let said = to.and_then(|_| self.wire.subject.said(&reply));
        let tape = &mut self.wire.log().drives[self.index];
        tape.heard.push(Heard { at: now, request: bytes.to_vec(), reply, said });
        to.filter(|_| !tape.mute)
    }

    fn restart(&mut self, now: Time) {
        self.drive.restart(now);
    }

    fn inhibit(&mut self, until: Time) {
        self.drive.inhibit(until);
    }
}

struct Tapped<'a> {
    carriers: &'a dyn Carriers,
    wire: &'a Wire,
}

impl Carriers for Tapped<'_> {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        let carrier = self.carriers.datagrams(bind, options)?;
        self.wire.log().master = Some(bind);
        Ok(Box::new(TappedCarrier { carrier, wire: self.wire.clone() }))
    }
}

struct TappedCarrier {
    carrier: Box<dyn Datagrams>,
    wire: Wire,
}

impl Datagrams for TappedCarrier {
    fn fd(&self) -> Option<RawFd> {
        self.carrier.fd()
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let mut log = self.wire.log();
        for index in 0..outbox.len() {
            if outbox.sent(index) == Sent::Posted {
                log.sends += 1;
                let peer = outbox.peer(index);
                if log.drives.iter().any(|tape| tape.jammed && tape.address == peer) {
                    outbox.note(index, Sent::Failed(NO_BUFFER));
                }
            }
        }
        drop(log);
        self.carrier.send(outbox);
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let wire = self.wire.clone();
        self.carrier.receive(&mut |datagram| {
            let mut log = wire.log();
            match log.drives.iter_mut().find(|tape| tape.address.ip() == datagram.from.ip()) {
                Some(tape) => tape.taken += 1,
                None => log.strangers += 1,
            }
            drop(log);
            take(datagram);
        })
    }

    fn batch(&self) -> usize {
        self.carrier.batch()
    }

    fn memory(&self, regions: &mut Regions) {
        self.carrier.memory(regions);
    }
}
