//! What goes over the wire, written down on its way: drives and carriers that tell what passed through them, and that
//! misbehave where the world's faults cannot (a drive that receives and acts but whose replies are lost, a refused
//! send).

mod serial;

use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard};

use fieldbeat::bus::BusPlan;
use fieldbeat::sim::{Carrier, FaultPlan, SimDrive, SimSegment, Simulated, World};
use fieldbeat::{OpenError, Time};
use fieldbeat_core::bus::Opened;
use fieldbeat_core::net::frames::Unsent;
use fieldbeat_core::net::{
    Broken, Carriers, Datagrams, Frames, Groups, LinkNotes, Outbox, Received, Sent, Serial, SerialLine,
    StreamPeer, Streams, UdpOptions,
};
use fieldbeat_core::rt::Regions;

use self::serial::{TappedSerial, TappedSlave};
use crate::between::{Between, Message, Sender, Shared};
use crate::conformance::subject::{Drive, NoMessage, Said, Subject};
use crate::proposing::Proposing;

/// ENOBUFS: what a full send buffer answers.
const NO_BUFFER: i32 = 105;

/// One request as its drive received it.
#[derive(Clone, Debug)]
pub struct Delivery {
    pub at: Time,
    pub request: Vec<u8>,
    /// Empty: no answer.
    pub reply: Vec<u8>,
    pub said: Option<Said>,
    /// The same, by the answers that were not lost.
    pub reported: Option<Said>,
}

/// One packet of a drive that sends by its own clock, as it left.
#[derive(Clone, Debug)]
pub struct Packet {
    pub at: Time,
    pub bytes: Vec<u8>,
    pub said: Option<Said>,
}

/// One drive's end of the wire.
#[derive(Debug)]
pub struct Tape {
    /// That of its process data.
    pub address: SocketAddrV4,
    /// Its wire at its best: a slow drive is no fault.
    pub usual: FaultPlan,
    pub received: Vec<Delivery>,
    /// What it sent by its own clock and was not lost.
    pub packets: Vec<Packet>,
    /// What it last sent by its own clock, lost or not.
    pub latest: Option<Said>,
    /// Receives and acts, but its answers are lost. On a line that is so if all of them are mute, and the frames do not
    /// come back; a single one receives nothing.
    pub mute: bool,
    /// Of a line: it is not there.
    pub unplugged: bool,
    /// The operating system refuses to send to it.
    pub jammed: bool,
    /// The wire takes what is sent to it in two pieces.
    pub halved: bool,
    /// Telegrams that the bus took in from its address, or its line.
    pub taken: u64,
    /// What another master is about to send to it.
    pub meddled: Option<Vec<u8>>,
    /// On a serial wire: faults that it is to have from now on, and what is put on the wire in its place, and when.
    pub faults: Option<FaultPlan>,
    pub injected: Vec<(Time, Vec<u8>)>,
    /// The master's end of its connection, if it has any.
    pub peer: Option<SocketAddrV4>,
    /// The bus has that connection: what comes on it is no handshake.
    pub open: bool,
    /// Connections that the bus has taken over.
    pub opened: u64,
}

impl Tape {
    /// What the drive last said.
    pub fn said(&self) -> Said {
        if let Some(said) = self.latest {
            return said;
        }
        self.received.iter().rev().find_map(|received| received.said).expect("the drive has answered")
    }

    /// All that it said, in order.
    pub fn all_said(&self) -> Vec<Said> {
        match self.packets.is_empty() {
            true => self.received.iter().filter_map(|received| received.said).collect(),
            false => self.packets.iter().filter_map(|packet| packet.said).collect(),
        }
    }

    /// The last answer that it gave, as it left.
    pub fn reply(&self) -> Vec<u8> {
        if let Some(packet) = self.packets.last() {
            return packet.bytes.clone();
        }
        let last = self.received.iter().rev().find(|received| !received.reply.is_empty());
        last.expect("the drive has answered").reply.clone()
    }
}

/// All of one bus's wire.
#[derive(Debug, Default)]
pub struct Log {
    /// In slot order.
    pub drives: Vec<Tape>,
    /// Datagrams that the bus took in from nobody of its own.
    pub unmatched: u64,
    /// Where the bus listens.
    pub master: Option<SocketAddrV4>,
    /// Times that the bus handed something to a carrier.
    pub sends: u64,
    /// On a line, the last frame that passed, as it left.
    pub frame: Vec<u8>,
    /// The seed of requests that are built and do not leave, before those that do.
    pub proposals: Option<u64>,
}

/// A bus plan whose wire is written down.
#[derive(Clone)]
pub struct Wire {
    subject: &'static dyn Subject,
    plan: Arc<dyn BusPlan>,
    log: Arc<Mutex<Log>>,
    /// Of its line, if it has one.
    interface: Option<Arc<str>>,
    /// Its serial port, if it has one.
    port: Option<Arc<str>>,
}

impl Wire {
    /// The wire of these drives, and all that is simulated of it.
    pub fn new(subject: &'static dyn Subject, drives: &[Drive]) -> (Wire, Simulated) {
        let plan: Arc<dyn BusPlan> = subject.plan(drives).into();
        let Simulated { drives: simulated, mut segments, mut wires, .. } = subject.simulated(drives);
        let (line, serial) = (segments.pop(), wires.pop());
        let ends: Vec<_> = match &line {
            None if serial.is_some() => {
                let usual = FaultPlan { answer_ns: subject.answer_ns(), ..FaultPlan::default() };
                vec![(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0), usual); drives.len()]
            }
            None => simulated.iter().map(|drive| (process_data(&**drive).1, drive.faults())).collect(),
            // Nobody has an address.
            Some(line) => {
                vec![(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0), line.faults()); drives.len()]
            }
        };
        let tape = |(address, usual)| Tape {
            address,
            usual,
            received: Vec::new(),
            packets: Vec::new(),
            latest: None,
            mute: false,
            unplugged: false,
            jammed: false,
            halved: false,
            taken: 0,
            meddled: None,
            faults: None,
            injected: Vec::new(),
            peer: None,
            open: false,
            opened: 0,
        };
        let log = Log { drives: ends.into_iter().map(tape).collect(), ..Log::default() };
        let interface = line.as_ref().map(|line| line.interface().into());
        let port = serial.as_ref().map(|wire| wire.port.as_str().into());
        let wire = Wire { subject, plan, log: Arc::new(Mutex::new(log)), interface, port };
        let tap = |(index, drive): (usize, Box<dyn SimDrive>)| {
            let (wire, (socket, _)) = (wire.clone(), process_data(&*drive));
            let (said, reported) = (None, None);
            let tapped = TappedDrive { drive, index, socket, wire, part: Vec::new(), said, reported };
            Box::new(Shared::new(tapped)) as Box<dyn SimDrive>
        };
        let tap_line = |line| {
            let drives = vec![TappedEnd::default(); drives.len()];
            Box::new(TappedLine { line, wire: wire.clone(), drives, cut: None }) as Box<dyn SimSegment>
        };
        let tap_slave = |(index, drive)| {
            Box::new(TappedSlave::new(drive, index, wire.clone())) as Box<dyn fieldbeat::sim::SimSerial>
        };
        let tap_wire = |mut serial: fieldbeat::sim::SerialWire| {
            serial.drives = serial.drives.into_iter().enumerate().map(tap_slave).collect();
            serial
        };
        let simulated = Simulated {
            wires: serial.into_iter().map(tap_wire).collect(),
            drives: simulated.into_iter().enumerate().map(tap).collect(),
            segments: line.into_iter().map(tap_line).collect(),
        };
        (wire, simulated)
    }

    /// Of a line, the place of drive `index`.
    fn place(&self, index: usize) -> usize {
        self.subject.place(index, self.log().drives.len())
    }

    // What befalls it in a world.

    /// Pulls the plug of drive `index`, or puts it in again.
    pub fn plug(&self, world: &World, index: usize, plugged: bool) {
        let address = self.address(index);
        match self.interface.as_ref().or(self.port.as_ref()) {
            Some(_) => self.log().drives[index].unplugged = !plugged,
            None => assert!(if plugged { world.plug(address) } else { world.unplug(address) }),
        }
    }

    /// Switches drive `index` off and on again.
    pub fn restart(&self, world: &World, index: usize) {
        if let Some(port) = &self.port {
            return assert!(world.restart_on(port, index));
        }
        assert!(match &self.interface {
            Some(line) => world.restart_slave(line, self.place(index)),
            None => world.restart(self.address(index)),
        });
    }

    /// From here on the wire of drive `index`, or its line, has these faults.
    pub fn faults(&self, world: &World, index: usize, plan: FaultPlan) {
        if self.port.is_some() {
            self.log().drives[index].faults = Some(plan);
            return;
        }
        assert!(match &self.interface {
            Some(line) => world.set_segment_faults(line, plan),
            None => world.set_faults(self.address(index), plan),
        });
    }

    /// What comes from `from` is at the master at the instant `at`.
    pub fn inject(&self, world: &World, index: usize, from: SocketAddrV4, bytes: &[u8], at: Time) {
        if self.port.is_some() {
            return self.log().drives[index].injected.push((at, bytes.to_vec()));
        }
        match &self.interface {
            Some(line) => assert!(world.inject_frame(line, bytes, at)),
            None => world.inject(self.master(index), from, bytes, at),
        }
    }

    /// Looks at its line, as it is now.
    pub fn look<R>(&self, world: &World, look: impl FnOnce(&mut dyn SimSegment, Time) -> R) -> Option<R> {
        world.look(self.interface.as_ref()?, |tapped: &mut TappedLine, now| look(&mut *tapped.line, now))
    }

    pub fn log(&self) -> MutexGuard<'_, Log> {
        self.log.lock().unwrap()
    }

    /// Where drive `index` listens.
    pub fn address(&self, index: usize) -> SocketAddrV4 {
        self.log().drives[index].address
    }

    /// Where what drive `index` sends goes to.
    pub fn master(&self, index: usize) -> SocketAddrV4 {
        let log = self.log();
        let none = self.port.as_ref().map(|_| SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0));
        log.drives[index].peer.or(log.master).or(none).expect("the bus is open")
    }
}

impl std::fmt::Debug for Wire {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.plan.fmt(f)
    }
}

impl BusPlan for Wire {
    crate::forward_bus_plan!(plan);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        let opened = self.plan.open(period_ns, &Tapped { carriers, wire: self })?;
        let proposals = self.log().proposals;
        Ok(match proposals {
            Some(seed) => Proposing::of(opened, seed),
            None => opened,
        })
    }
}

/// What is known of a drive on a line.
#[derive(Clone, Default)]
struct TappedEnd {
    said: Option<Said>,
    reported: Option<Said>,
    deaf: bool,
}

struct TappedLine {
    line: Box<dyn SimSegment>,
    wire: Wire,
    drives: Vec<TappedEnd>,
    cut: Option<usize>,
}

impl TappedLine {
    /// Brings about what shall befall the drives.
    fn befall(&mut self) {
        let Wire { subject, log, .. } = &self.wire;
        let mut log = log.lock().unwrap();
        let count = self.drives.len();
        let all_mute = log.drives.iter().all(|tape| tape.mute);
        let gone =
            |place: usize| (0..count).any(|n| subject.place(n, count) == place && log.drives[n].unplugged);
        let end = (0..count).map(|n| subject.place(n, count) + 1).max().unwrap_or(0);
        let cut = (0..end).find(|place| (*place..end).all(gone));
        if std::mem::replace(&mut self.cut, cut) != cut {
            self.line.cut(cut);
        }
        for (index, (tape, end)) in log.drives.iter_mut().zip(&mut self.drives).enumerate() {
            let place = subject.place(index, count);
            let deaf = tape.unplugged || tape.mute && !all_mute;
            if std::mem::replace(&mut end.deaf, deaf) != deaf {
                self.line.deafen(place, deaf);
            }
            if tape.meddled.take().is_some() {
                subject.provoke(&mut *self.line, place);
            }
        }
    }

    /// What the frame has brought to each drive, and what it said; `comes_back`: the frame comes back.
    fn write_down(&mut self, now: Time, frame: &[u8], comes_back: bool) {
        let Wire { subject, log, .. } = &self.wire;
        let mut log = log.lock().unwrap();
        let count = self.drives.len();
        for (index, (tape, end)) in log.drives.iter_mut().zip(&mut self.drives).enumerate() {
            let Some((request, reply)) = subject.piece(now, frame, index, count) else { continue };
            if reply.is_empty() {
                continue;
            }
            let said = subject.said(end.said, &request, &reply);
            end.said = said.or(end.said);
            let reported =
                said.filter(|_| comes_back).and_then(|_| subject.said(end.reported, &request, &reply));
            end.reported = reported.or(end.reported);
            tape.received.push(Delivery { at: now, request, reply, said, reported });
        }
        log.frame.clear();
        log.frame.extend(frame);
    }
}

impl SimSegment for TappedLine {
    crate::forward_sim_line!(this => this.line);

    crate::forward! { this => this.line;
        fn interface(&self) -> &str;
        fn own_interface(&self) -> Option<&str>;
        fn slaves(&self) -> usize;
        fn advance(&mut self, now: Time);
        fn restart(&mut self, now: Time, place: usize);
    }

    fn pass(&mut self, now: Time, frame: &mut [u8]) -> bool {
        self.befall();
        let mute = self.wire.log().drives.iter().all(|tape| tape.mute);
        let comes_back = self.line.pass(now, frame) && !mute;
        self.write_down(now, frame, comes_back);
        comes_back
    }
}

/// The number and the address of the socket of a drive's process data: the last one of those with datagrams, if it has
/// several, but for one at the address of its sessions.
fn process_data(drive: &dyn SimDrive) -> (usize, SocketAddrV4) {
    let more = drive.more_sockets();
    let is_data = |carrier: Carrier, address| carrier == Carrier::Datagrams && address != drive.address();
    let datagrams = more.iter().zip(1..).filter(|((carrier, address), _)| is_data(*carrier, *address));
    datagrams.last().map_or((0, drive.address()), |((_, address), number)| (number, *address))
}

struct TappedDrive {
    drive: Box<dyn SimDrive>,
    index: usize,
    /// The number of the socket of its process data.
    socket: usize,
    wire: Wire,
    /// On a stream, the begin of a request.
    part: Vec<u8>,
    said: Option<Said>,
    reported: Option<Said>,
}

/// Where another master connects from.
const MEDDLER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 8, 8, 8), 8_888);

impl TappedDrive {
    /// Another master sends something, if it needs one on a connection of its own.
    fn meddle(&mut self, now: Time) {
        let mut log = self.wire.log();
        let from = log.master.unwrap_or(MEDDLER);
        let Some(bytes) = log.drives[self.index].meddled.take() else { return };
        drop(log);
        if !self.wire.subject.can().stream {
            self.drive.receive_at(self.socket, now, from, &bytes, &mut Vec::new());
            return;
        }
        assert!(self.drive.connect(now, from), "there is room for another master");
        self.drive.receive(now, from, &bytes, &mut Vec::new());
        self.drive.disconnected(now, from);
    }

    /// The request that is whole with these bytes: datagrams are, always.
    fn request(&mut self, from: SocketAddrV4, bytes: &[u8]) -> Vec<u8> {
        let Wire { subject, log, .. } = &self.wire;
        if !subject.can().stream {
            return bytes.to_vec();
        }
        if log.lock().unwrap().drives[self.index].peer.replace(from) != Some(from) {
            self.part.clear();
        }
        self.part.extend(bytes);
        match subject.message(&self.part) {
            Ok(Some(length)) => self.part.drain(..length).collect(),
            Ok(None) => Vec::new(),
            Err(NoMessage) => std::mem::take(&mut self.part),
        }
    }
}

impl Between for TappedDrive {
    fn drive(&mut self) -> &mut dyn SimDrive {
        &mut *self.drive
    }

    fn run(&mut self, now: Time, send: &mut Sender<'_>) {
        let Wire { subject, log, .. } = &self.wire;
        let tape = &mut log.lock().unwrap().drives[self.index];
        self.drive.run(now, &mut |socket, to, bytes| {
            if socket == self.socket {
                let said = subject.said(None, &[], bytes);
                tape.latest = said.or(tape.latest);
                if tape.mute {
                    return;
                }
                tape.packets.push(Packet { at: now, bytes: bytes.to_vec(), said });
            }
            send(socket, to, bytes);
        });
    }

    fn receive(&mut self, message: Message<'_>, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        if message.socket != self.socket {
            return message.reaches(&mut *self.drive, reply);
        }
        let Message { now, from, bytes, .. } = message;
        self.meddle(now);
        let request = self.request(from, bytes);
        let to = message.reaches(&mut *self.drive, reply);
        let reply = if to.is_some() { reply.clone() } else { Vec::new() };
        let subject = self.wire.subject;
        let mut log = self.wire.log.lock().unwrap();
        let tape = &mut log.drives[self.index];
        let said = to.and_then(|_| subject.said(self.said, &request, &reply));
        self.said = said.or(self.said);
        let reported = to.filter(|_| !tape.mute).and_then(|_| subject.said(self.reported, &request, &reply));
        self.reported = reported.or(self.reported);
        // On a stream, a handshake, or a part of a request only.
        let none = subject.can().stream && (!tape.open || request.is_empty());
        if !none {
            tape.received.push(Delivery { at: now, request, reply, said, reported });
        }
        to.filter(|_| !tape.mute)
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

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        if !self.wire.subject.can().stream {
            // Sessions, with nothing cyclic in them.
            return self.carriers.streams(peers);
        }
        let addresses: Vec<_> = peers.iter().map(|peer| peer.address).collect();
        let expected: Vec<_> = self.wire.log().drives.iter().map(|tape| tape.address).collect();
        assert_eq!(addresses, expected, "connections are in slot order");
        let carrier = self.carriers.streams(peers)?;
        let parts = vec![Part::default(); addresses.len()];
        Ok(Box::new(TappedStreams { carrier, wire: self.wire.clone(), parts }))
    }

    fn serial(&self, port: &str, line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        let carrier = self.carriers.serial(port, line)?;
        Ok(Box::new(TappedSerial::new(carrier, self.wire.clone())))
    }

    fn frames(&self, interface: &str, ethertype: u16) -> io::Result<Box<dyn Frames>> {
        let carrier = self.carriers.frames(interface, ethertype)?;
        Ok(Box::new(TappedFrames { carrier, wire: self.wire.clone() }))
    }
}

struct TappedFrames {
    carrier: Box<dyn Frames>,
    wire: Wire,
}

impl Frames for TappedFrames {
    crate::forward! { this => this.carrier;
        fn fd(&self) -> Option<RawFd>;
        fn now(&mut self) -> Time;
        fn mac(&self) -> [u8; 6];
        fn memory(&self, regions: &mut Regions);
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let mut log = self.wire.log();
        log.sends += 1;
        if log.drives.iter().any(|tape| tape.jammed) {
            return Err(Unsent::Full);
        }
        drop(log);
        self.carrier.send(frame)
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        let (at, length) = self.carrier.receive(room)?;
        let mut log = self.wire.log();
        if room.get(..length).is_none_or(|frame| self.wire.subject.is_strange(frame)) {
            log.unmatched += 1;
        } else {
            log.drives.iter_mut().for_each(|tape| tape.taken += 1);
        }
        Some((at, length))
    }
}

struct TappedStreams {
    carrier: Box<dyn Streams>,
    wire: Wire,
    /// What the bus took in of each connection's next message.
    parts: Vec<Part>,
}

#[derive(Clone, Default)]
struct Part {
    bytes: Vec<u8>,
    /// Behind what is no message there is none.
    over: bool,
    /// The wire has taken the first piece of a request only.
    sends_rest: bool,
}

impl Streams for TappedStreams {
    crate::forward! { this => this.carrier;
        fn fd(&self) -> Option<RawFd>;
        fn look(&mut self);
        fn ready(&mut self) -> Option<usize>;
        fn notes(&self) -> LinkNotes;
        fn memory(&self, regions: &mut Regions);
    }

    fn opened(&mut self) -> Option<usize> {
        let index = self.carrier.opened()?;
        self.parts[index] = Part::default();
        let tape = &mut self.wire.log().drives[index];
        tape.open = true;
        tape.opened += 1;
        Some(index)
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let taken = self.carrier.receive(index, room)?;
        if let Some((_, count)) = taken {
            let part = &mut self.parts[index];
            part.bytes.extend(&room[..count]);
            while !part.over && !part.bytes.is_empty() {
                match self.wire.subject.message(&part.bytes) {
                    Ok(Some(length)) => drop(part.bytes.drain(..length)),
                    Ok(None) => break,
                    Err(NoMessage) => part.over = true,
                }
                self.wire.log().drives[index].taken += 1;
            }
        }
        Ok(taken)
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let mut log = self.wire.log();
        log.sends += 1;
        if log.drives[index].jammed {
            return Ok((Time(0), 0));
        }
        let part = &mut self.parts[index];
        part.sends_rest = log.drives[index].halved && !part.sends_rest;
        let count = if part.sends_rest { bytes.len() / 2 } else { bytes.len() };
        drop(log);
        self.carrier.send(index, &bytes[..count])
    }

    fn abandon(&mut self, index: usize, why: &'static str) {
        self.wire.log().drives[index].open = false;
        self.carrier.abandon(index, why);
    }
}

struct TappedCarrier {
    carrier: Box<dyn Datagrams>,
    wire: Wire,
}

impl Datagrams for TappedCarrier {
    crate::forward! { this => this.carrier;
        fn fd(&self) -> Option<RawFd>;
        fn groups(&self) -> Option<Arc<dyn Groups>>;
        fn batch(&self) -> usize;
        fn dropped(&self) -> u64;
        fn memory(&self, regions: &mut Regions);
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let mut log = self.wire.log();
        for index in 0..outbox.len() {
            if outbox.sent(index) == Sent::Posted {
                log.sends += 1;
                let peer = outbox.peer(index);
                if log.drives.iter().any(|tape| tape.jammed && tape.address.ip() == peer.ip()) {
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
                None => log.unmatched += 1,
            }
            drop(log);
            take(datagram);
        })
    }
}
