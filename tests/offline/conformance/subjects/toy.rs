//! A protocol that nobody sells, and everything that LinUDP is not: revolutions, a number in each request, answers that
//! come a cycle later and make no round trip, no homing, no jogs, no rows. It keeps the contract's other branches alive
//! until a real protocol needs them, and with one [`Defect`] at a time it shows that the clauses can fail. The same toy
//! on two more wires: `own_clock` and `half_duplex`.

mod half_duplex;
mod own_clock;

use std::any::Any;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::RawFd;
use std::sync::Arc;

use fieldbeat::axis::{
    AxisPlan, Call, CallError, Lacks, Link, MonitorChannel, PlanFault, State, Unit, Units,
};
use fieldbeat::bus::{BusPlan, Grid};
use fieldbeat::sim::{FaultPlan, SimDrive, Simulated};
use fieldbeat::telemetry::Unmatched;
use fieldbeat::time::{Time, US};
use fieldbeat::{Cycle, OpenError};
use fieldbeat_core::axis::acyclic;
use fieldbeat_core::axis::acyclic::{AcyclicEnds, Commanding, Notation, Port};
use fieldbeat_core::bus::desired::{
    Accepted, Capabilities, Desired, FaultIs, Generator as SetpointsBy, Motion, Power,
};
use fieldbeat_core::bus::{Bus, Exchange, Slot};
use fieldbeat_core::net::{Carriers, Datagrams, Outbox, SendMode, Sent, UdpOptions};
use fieldbeat_core::rt::Regions;
use fieldbeat_linudp::notation::Upids;
use fieldbeat_sim::physics::Generator;

use crate::conformance::line::{PERIOD, WINDOW};
use crate::conformance::subject::{Calls, Can, Drive, SOON, Said, Subject};

use self::half_duplex::Turns;
use self::own_clock::Packets;

/// The toy on its wire, sound or with one thing wrong.
pub struct Toy(pub ToyWire, pub Option<Defect>);

/// How requests and answers go.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ToyWire {
    /// An answer comes a cycle later.
    Later,
    /// The drive sends by its own clock.
    OwnClock,
    /// One request is on the wire at a time.
    HalfDuplex,
}

/// What a bus can get wrong, one of each kind.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Defect {
    SendsWhatIsNotDue,
    ForgetsARefusedSend,
    MatchesAnyReply,
    CountsLateTwice,
    ReadsDuplicates,
    OpensTheWindowForEver,
    SharesItsMisses,
    WritesBeforeTheFirstOrder,
    IgnoresStops,
    ForgetsRestarts,
    ScalesWrongly,
    BuildsAnewEachTime,
    ForgetsItsCalls,
    // With its own clock.
    ClaimsWhatItDidNotSend,
    IsFreshWithEachExchange,
    IsNeverTooOld,
    TakesOlderPackets,
    IsProbed,
    // Half duplex.
    SendsOutOfTurn,
    GivesUpItsTurn,
    KeepsTheOldRequest,
    IsNotPolled,
    WaitsForEver,
}

const REQUEST: usize = 36;
const REPLY: usize = 22;

// What a request tells the drive to do, and its states.
const READ: u8 = 0;
const ENABLE: u8 = 1;
const DISABLE: u8 = 2;
const MOVE: u8 = 3;
const STOP: u8 = 4;
const RESET: u8 = 5;
const BREAK: u8 = 6;
const OFF: u8 = 0;
const ON: u8 = 1;
const FAULT: u8 = 2;

/// What the drive is to do, once for each new number. Its values are in counts and seconds.
#[derive(Clone, Copy, Debug, Default)]
struct Instruction {
    number: u8,
    what: u8,
    values: [f64; 4],
}

fn request(sequence: u8, instruction: Instruction) -> [u8; REQUEST] {
    let mut bytes = [0; REQUEST];
    bytes[..4].copy_from_slice(&[b'?', sequence, instruction.number, instruction.what]);
    for (at, value) in bytes[4..].chunks_exact_mut(8).zip(instruction.values) {
        at.copy_from_slice(&value.to_le_bytes());
    }
    bytes
}

fn word(bytes: &[u8], index: usize) -> [u8; 8] {
    bytes[index * 8..][..8].try_into().expect("eight bytes")
}

/// What the drive answers.
#[derive(Clone, Copy, Debug, Default)]
struct Answer {
    sequence: u8,
    /// Number of what it was told last.
    number: u8,
    /// Grows by one with each start.
    boot: u8,
    state: u8,
    moving: bool,
    position: i64,
    velocity: f64,
}

impl Answer {
    fn emit(&self, out: &mut Vec<u8>) {
        out.extend([b'!', self.sequence, self.number, self.boot, self.state, self.moving.into()]);
        out.extend(self.position.to_le_bytes());
        out.extend(self.velocity.to_le_bytes());
    }

    fn parse(bytes: &[u8]) -> Option<Answer> {
        let [b'!', sequence, number, boot, state, moving, rest @ ..] = bytes else { return None };
        (bytes.len() == REPLY && *state <= FAULT && *moving <= 1).then(|| Answer {
            sequence: *sequence,
            number: *number,
            boot: *boot,
            state: *state,
            moving: *moving == 1,
            position: i64::from_le_bytes(word(rest, 0)),
            velocity: f64::from_le_bytes(word(rest, 1)),
        })
    }
}

impl Subject for Toy {
    fn name(&self) -> &'static str {
        match self.0 {
            ToyWire::Later => "the toy protocol",
            ToyWire::OwnClock => "the toy with its own clock",
            ToyWire::HalfDuplex => "the toy on a half-duplex wire",
        }
    }

    fn can(&self) -> Can {
        Can {
            positions: true,
            home: false,
            jog: false,
            follow: false,
            torque: false,
            picks: true,
            identified: true,
            round_trip: self.0 == ToyWire::HalfDuplex,
            answers_after: if self.0 == ToyWire::OwnClock { 0 } else { 1 },
            whole: true,
            awaits: self.0 == ToyWire::HalfDuplex,
            stream: false,
            own_clock: self.0 == ToyWire::OwnClock,
            sessions: false,
            steep_stops: false,
            half_duplex: self.0 == ToyWire::HalfDuplex,
            bytes: false,
            comes_up_off: false,
            shared: false,
            rearmed: false,
        }
    }

    fn axis(&self, name: &str) -> AxisPlan {
        let units = Units { unit: Unit::Revolution, ..Units::millimetres(65_536.0) };
        AxisPlan::new(name, units)
    }

    fn plan(&self, drives: &[Drive]) -> Box<dyn BusPlan> {
        Box::new(ToyPlan { drives: drives.to_vec(), wire: self.0, defect: self.1 })
    }

    fn simulated(&self, drives: &[Drive]) -> Simulated {
        let drive = |(index, drive): (usize, &Drive)| {
            let counts = drive.axis.units.counts_per_unit;
            let mut toy = ToyDrive {
                address: address(index),
                generator: Generator::at((drive.start * counts).round()),
                lived: None,
                answer: Answer::default(),
                answer_ns: match self.0 {
                    ToyWire::Later => PERIOD + 100 * US,
                    ToyWire::OwnClock => 10 * US,
                    ToyWire::HalfDuplex => half_duplex::ANSWER,
                },
                packets: (self.0 == ToyWire::OwnClock).then(Packets::default),
            };
            if drive.running {
                toy.answer.state = ON;
                toy.generator.run(0.01 * counts, counts);
            }
            Box::new(toy) as Box<dyn SimDrive>
        };
        drives.iter().enumerate().map(drive).collect::<Vec<_>>().into()
    }

    fn said(&self, _before: Option<Said>, _request: &[u8], reply: &[u8]) -> Option<Said> {
        let Answer { state, moving, position, .. } = Answer::parse(reply)?;
        let position = Some(position);
        Some(Said {
            powered: state == ON,
            moving,
            homed: Some(true),
            position,
            demand: position,
            setpoint: None,
            at: None,
            velocity: None,
        })
    }

    fn calls(&self) -> Calls {
        let call = |service, address| Call { service, address, value: 0 };
        Calls {
            read: call(GET, 3),
            write: Call { value: 77, ..call(PUT, 3) },
            refused: (call(GET, 8), NO_REGISTER),
            soon: SOON,
        }
    }

    fn asks_to_stop(&self, _before: &[Vec<u8>], request: &[u8]) -> bool {
        request.get(3) == Some(&STOP)
    }

    fn fault(&self, reply: &[u8]) -> Option<Vec<u8>> {
        let number = Answer::parse(reply)?.number.wrapping_add(1);
        Some(request(0, Instruction { number, what: BREAK, ..Instruction::default() }).into())
    }

    fn malformed(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        vec![Vec::new(), reply[1..].to_vec(), reply[..REPLY - 1].to_vec(), vec![b'!'; 600]]
    }

    fn later(&self, packet: &[u8], by: u8) -> Option<Vec<u8>> {
        let mut packet = packet.to_vec();
        let number = packet.get_mut(1).filter(|_| self.0 == ToyWire::OwnClock)?;
        *number = number.wrapping_add(by);
        Some(packet)
    }

    fn foreign(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        if self.0 == ToyWire::OwnClock {
            return Vec::new();
        }
        // The number of a request that is a hundred exchanges away.
        vec![[&[reply[0], reply[1].wrapping_add(100)], &reply[2..]].concat()]
    }
}

#[derive(Debug)]
struct ToyPlan {
    drives: Vec<Drive>,
    wire: ToyWire,
    defect: Option<Defect>,
}

fn address(index: usize) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 7, 0, 2 + index as u8), 7)
}

impl BusPlan for ToyPlan {
    fn name(&self) -> &str {
        "toys"
    }

    fn protocol(&self) -> &'static str {
        "toy"
    }

    fn axes(&self) -> Vec<&AxisPlan> {
        self.drives.iter().map(|drive| &drive.axis).collect()
    }

    fn faults(&self, _period_ns: u64) -> Vec<(usize, PlanFault)> {
        let of = |(index, drive): (usize, &Drive)| {
            drive.axis.faults().into_iter().map(move |fault| (index, fault))
        };
        self.drives.iter().enumerate().flat_map(of).collect()
    }

    fn reply_within_ns(&self, _index: usize) -> Option<u64> {
        (self.wire == ToyWire::Later).then_some(WINDOW + PERIOD)
    }

    fn turn_within_ns(&self, _index: usize, _grid: Grid) -> Option<u64> {
        (self.wire == ToyWire::HalfDuplex).then(|| half_duplex::turn_within_ns(self.drives.len()))
    }

    fn fresh_within_ns(&self, _index: usize, _period_ns: u64) -> Option<u64> {
        let known = self.wire == ToyWire::OwnClock && self.defect != Some(Defect::IsProbed);
        known.then_some(own_clock::FRESH_WITHIN)
    }

    fn addresses(&self) -> Vec<SocketAddrV4> {
        (0..self.drives.len()).map(address).collect()
    }

    fn describe(&self, _period_ns: u64) -> Vec<String> {
        (0..self.drives.len()).map(|index| address(index).to_string()).collect()
    }

    fn open(&self, _period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        let bind = SocketAddrV4::new(Ipv4Addr::new(10, 7, 0, 1), 7);
        let options = UdpOptions {
            peers: self.drives.len(),
            waiting: 0,
            room: 64,
            send: SendMode::Batch,
            dscp: 0,
            groups: 0,
        };
        let net = carriers.datagrams(bind, &options).map_err(|source| OpenError::Bind {
            bus: self.name().into(),
            address: bind,
            source,
            remedy: "put the other toy away",
        })?;
        let peers: Vec<_> = (0..self.drives.len()).map(address).collect();
        let station = |drive: &Drive| Station::new(drive.axis.clone(), self.wire, self.defect);
        Ok(Box::new(ToyBus {
            net,
            outbox: Outbox::new(&peers, REQUEST),
            stations: self.drives.iter().map(station).collect(),
            unmatched: Unmatched::default(),
            wire: self.wire,
            turns: Turns::default(),
            defect: self.defect,
        }))
    }

    fn capabilities(&self, index: usize, _period_ns: u64) -> Capabilities {
        let no_more = Some("a toy can move and stop, no more");
        let none = Lacks::default();
        Capabilities {
            lacks: Lacks { rows: no_more, velocities: no_more, torques: no_more, homing: no_more, ..none },
            leaves_quick_stop: false,
            // Its answers are whole counts.
            arrival: 1.0 / self.drives[index].axis.units.counts_per_unit.abs(),
            ..Capabilities::of(SetpointsBy::Drive { velocities: None })
        }
    }

    fn monitored(&self, _index: usize) -> [Option<MonitorChannel>; 4] {
        [const { None }; 4]
    }

    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let drives = vec![self.drives.get(index)?.clone()];
        Some(Box::new(ToyPlan { drives, ..*self }))
    }

    fn notation(&self) -> Arc<dyn Notation> {
        // Its registers have no names: any notation of numbers does.
        Arc::new(Upids)
    }
}

// Its acyclic services.
const GET: u32 = 1;
const PUT: u32 = 2;
const NO_REGISTER: u32 = 9;

/// The drive: it does what it is told, at once.
struct ToyDrive {
    address: SocketAddrV4,
    generator: Generator,
    lived: Option<Time>,
    answer: Answer,
    /// From its arrival to the answer of a request, ns.
    answer_ns: u64,
    /// With its own clock.
    packets: Option<Packets>,
}

impl SimDrive for ToyDrive {
    fn address(&self) -> SocketAddrV4 {
        self.address
    }

    fn faults(&self) -> FaultPlan {
        FaultPlan { answer_ns: self.answer_ns, ..FaultPlan::default() }
    }

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.generator.advance(now.since(self.lived.replace(now).unwrap_or(now)));
        let [b'?', sequence, number, what, values @ ..] = bytes else { return None };
        if bytes.len() != REQUEST {
            return None;
        }
        if std::mem::replace(&mut self.answer.number, *number) != *number {
            let [a, b, c, d] = [0, 1, 2, 3].map(|index| f64::from_le_bytes(word(values, index)));
            let generator = &mut self.generator;
            match (*what, self.answer.state) {
                (ENABLE, OFF) => self.answer.state = ON,
                (DISABLE, ON) | (RESET, FAULT) => self.answer.state = OFF,
                (BREAK, ON) => self.answer.state = FAULT,
                (MOVE, ON) => generator.go_to(a, b, c, d),
                (STOP, ON) => generator.brake(a),
                _ => {}
            }
        }
        if self.answer.state != ON {
            self.generator.halt();
        }
        self.answer.sequence = *sequence;
        self.answer.moving = self.generator.is_moving();
        self.answer.position = self.generator.position().round() as i64;
        self.answer.velocity = self.generator.velocity();
        if let Some(packets) = &mut self.packets {
            self.answer.sequence = packets.due(now)?;
        }
        self.answer.emit(reply);
        Some(from)
    }

    fn restart(&mut self, now: Time) {
        self.generator.advance(now.since(self.lived.replace(now).unwrap_or(now)));
        self.generator.halt();
        self.answer = Answer { boot: self.answer.boot.wrapping_add(1), ..Answer::default() };
    }

    /// A toy has no hardware enable.
    fn inhibit(&mut self, _until: Time) {}
}

struct ToyBus {
    net: Box<dyn Datagrams>,
    outbox: Outbox,
    stations: Vec<Station>,
    unmatched: Unmatched,
    wire: ToyWire,
    turns: Turns,
    defect: Option<Defect>,
}

impl ToyBus {
    fn take_in(&mut self, slots: &mut [Slot]) {
        let ToyBus { net, outbox, stations, unmatched, .. } = self;
        for _ in 0..4 {
            let taken = net.receive(&mut |datagram| {
                let index = (0..outbox.len()).find(|index| outbox.peer(*index).ip() == datagram.from.ip());
                let Some(index) = index else {
                    unmatched.datagrams += 1;
                    return;
                };
                let slot = &mut slots[index];
                match Answer::parse(datagram.bytes) {
                    _ if datagram.from != outbox.peer(index) => slot.counters.foreign += 1,
                    Some(answer) if !datagram.truncated => stations[index].take(datagram.at, &answer, slot),
                    _ => slot.counters.malformed += 1,
                }
            });
            if !taken.is_ok_and(|count| count == net.batch()) {
                break;
            }
        }
    }
}

impl Bus for ToyBus {
    fn name(&self) -> &str {
        "toys"
    }

    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        regions.add(&*self.stations);
        self.outbox.memory(regions);
        self.net.memory(regions);
    }

    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        // The answers of the cycle before may come between two windows, and count.
        self.take_in(slots);
        if self.wire == ToyWire::HalfDuplex {
            return self.send_in_turn(cycle, slots);
        }
        for (index, slot) in slots.iter().enumerate() {
            let open = matches!(slot.exchange, Exchange::Owed { .. });
            let always = self.defect == Some(Defect::SendsWhatIsNotDue);
            self.outbox.post(index, (slot.due || always) && !open);
        }
        self.net.send(&mut self.outbox);
        for (index, (station, slot)) in self.stations.iter_mut().zip(slots).enumerate() {
            match self.outbox.sent(index) {
                Sent::At(sent_at) => {
                    station.sent(slot);
                    slot.counters.sent += 1;
                    slot.exchange = match self.wire {
                        ToyWire::OwnClock => station.exchange(sent_at, &mut slot.notices),
                        _ => Exchange::Owed {
                            sent_at,
                            reply_by: cycle.deadline + cycle.period_ns,
                            awaited: self.defect == Some(Defect::OpensTheWindowForEver),
                        },
                    };
                }
                Sent::Idle => {}
                Sent::Failed(_) | Sent::Posted => {
                    slot.counters.unsent += 1;
                    slot.exchange = Exchange::Unsent;
                    if self.defect == Some(Defect::ForgetsARefusedSend) {
                        station.instruction.what = READ;
                        slot.gone.grid = Some(station.built_for);
                    }
                }
            }
        }
    }

    fn receive(&mut self, _cycle: &Cycle, slots: &mut [Slot]) {
        self.take_in(slots);
        self.turns.look(slots);
    }

    fn poll_at(&self) -> Option<Time> {
        self.turns.poll_at().filter(|_| self.defect != Some(Defect::IsNotPolled))
    }

    fn poll(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) {
        self.go_on(cycle, now, slots);
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        let missed = slots.iter().any(|slot| slot.exchange == Exchange::Missed);
        for (index, (station, slot)) in self.stations.iter_mut().zip(slots).enumerate() {
            let queued = slot.exchange == Exchange::Queued && !station.is(Defect::KeepsTheOldRequest);
            if (slot.due || queued) && !(missed && station.is(Defect::SharesItsMisses)) {
                station.instruction.number += u8::from(station.is(Defect::BuildsAnewEachTime));
                station.advance(cycle.grid, slot);
                self.outbox
                    .room(index)
                    .copy_from_slice(&request(station.sequence.wrapping_add(1), station.instruction));
                self.outbox.set_length(index, REQUEST);
            }
        }
    }

    fn shut_down(&mut self, _cycle: &Cycle, slots: &mut [Slot]) -> bool {
        !slots.iter().any(|slot| matches!(slot.exchange, Exchange::Owed { .. } | Exchange::Queued))
    }

    fn unmatched(&self) -> Unmatched {
        self.unmatched
    }

    fn acyclic(&mut self, index: usize) -> Option<AcyclicEnds> {
        self.stations.get_mut(index)?.ends.take()
    }

    fn native(&mut self, index: usize) -> Option<Box<dyn Any + Send>> {
        let station = self.stations.get_mut(index)?;
        std::mem::take(&mut station.native).then(|| Box::new(()) as Box<dyn Any + Send>)
    }
}

/// The master's view of one toy.
struct Station {
    axis: AxisPlan,
    wire: ToyWire,
    defect: Option<Defect>,
    native: bool,
    ends: Option<AcyclicEnds>,
    port: Port,
    registers: [u64; 8],
    /// The answer that the last call came with.
    called_at: Time,
    /// Of the last request.
    sequence: u8,
    /// Bit n: the n-th request before the last one is not answered.
    unanswered: u64,
    sent: u64,
    /// With its own clock: until when its newest packet counts.
    fresh_until: Time,
    seen: bool,
    answer: Answer,
    instruction: Instruction,
    /// The drive has what it was told.
    taken: bool,
    /// What it is told stands for these serials, of its power and of its motion.
    carried: (u64, u64),
    /// The slot for which the request was built.
    built_for: Time,
}

impl Station {
    fn new(axis: AxisPlan, wire: ToyWire, defect: Option<Defect>) -> Station {
        let (ends, port) = acyclic::queue(axis.parameter_queue, Commanding::none());
        Station {
            axis,
            wire,
            defect,
            native: true,
            ends: Some(ends),
            port,
            registers: [0; 8],
            called_at: Time(0),
            sequence: 0,
            unanswered: 0,
            sent: 0,
            fresh_until: Time(0),
            seen: false,
            answer: Answer::default(),
            instruction: Instruction::default(),
            taken: true,
            carried: (0, 0),
            built_for: Time(0),
        }
    }

    fn is(&self, defect: Defect) -> bool {
        self.defect == Some(defect)
    }

    fn sent(&mut self, slot: &mut Slot) {
        slot.gone.grid = Some(self.built_for);
        self.sequence = self.sequence.wrapping_add(1);
        self.unanswered = self.unanswered << 1 | 1;
        self.sent += 1;
    }

    fn take(&mut self, at: Time, answer: &Answer, slot: &mut Slot) {
        if self.wire == ToyWire::OwnClock {
            return self.accept(at, answer, slot);
        }
        let ago = u64::from(self.sequence.wrapping_sub(answer.sequence));
        if ago >= self.sent.min(64) {
            slot.counters.foreign += 1;
            return;
        }
        let first = self.unanswered & 1 << ago != 0;
        self.unanswered &= !(1 << ago);
        match slot.exchange {
            Exchange::Owed { sent_at, .. } if ago == 0 || self.is(Defect::MatchesAnyReply) => {
                // Where it takes a cycle whatever the drive does, no round trip is to be made of it.
                slot.exchange = Exchange::Answered { sent_at, at, suspect: self.wire == ToyWire::Later };
                slot.counters.answered += 1;
                self.read(at, answer, slot);
            }
            _ if first => slot.counters.late += 1 + u64::from(self.is(Defect::CountsLateTwice)),
            _ => {
                slot.counters.duplicate += 1;
                if self.is(Defect::ReadsDuplicates) {
                    self.read(at, answer, slot);
                }
            }
        }
    }

    /// One call an answer, if the drive is there.
    fn call(&mut self, link: Link, answered_at: Time) {
        match link {
            Link::Online if answered_at > self.called_at => self.called_at = answered_at,
            Link::Unseen | Link::Lost if !self.is(Defect::ForgetsItsCalls) => {
                return self.port.refuse_all(CallError::NotOnline);
            }
            _ => return,
        }
        let Some(posted) = self.port.take() else { return };
        let Call { service, address, value } = posted.call;
        let result = match (self.registers.get_mut(address as usize), service) {
            (Some(register), GET) => Ok(acyclic::Answer { status: 0, address, value: *register }),
            (Some(register), PUT) => {
                *register = value;
                Ok(acyclic::Answer { status: 0, address, value })
            }
            _ => Err(CallError::Refused(NO_REGISTER)),
        };
        self.port.end(&posted, result);
    }

    fn read(&mut self, at: Time, answer: &Answer, slot: &mut Slot) {
        let Slot { status: report, notices, evidence, .. } = slot;
        if self.seen && answer.boot != self.answer.boot {
            notices.restarted = !self.is(Defect::ForgetsRestarts);
            // What it was told before is over.
            self.taken = true;
        }
        (self.seen, self.answer) = (true, *answer);
        self.taken |= answer.number == self.instruction.number;
        if self.taken {
            self.instruction = Instruction { number: answer.number, ..Instruction::default() };
        }
        notices.fresh = true;
        report.at = at;
        report.state = match answer.state {
            ON => State::OperationEnabled,
            FAULT => State::Fault,
            _ => State::ReadyToSwitchOn,
        };
        report.fault = u32::from(answer.state == FAULT);
        (report.homed, report.moving, report.in_target) = (true, answer.moving, !answer.moving);
        let units = &self.axis.units;
        report.position = units.position(answer.position);
        report.demand = report.position;
        report.velocity = match self.is(Defect::ScalesWrongly) {
            false => units.distance(answer.velocity),
            true => units.distance(answer.velocity).abs(),
        };
        (evidence.position, evidence.demand) = (report.position, report.position);
        evidence.demand_velocity = report.velocity;
        evidence.fault = FaultIs { active: answer.state == FAULT, named: true, ..FaultIs::default() };
        if self.taken || self.is(Defect::ClaimsWhatItDidNotSend) {
            let (power, motion) = self.carried;
            evidence.accepted = Accepted { power, motion, row: 0 };
        }
    }

    /// From here on the drive is told this.
    fn tell(&mut self, what: u8, values: [f64; 4]) {
        let last = if self.taken { self.answer.number } else { self.instruction.number };
        self.instruction = Instruction { number: last.wrapping_add(1), what, values };
        self.taken = false;
    }

    /// What is desired, as what the drive is told.
    fn advance(&mut self, grid: Time, slot: &Slot) {
        self.call(slot.link, slot.status.at);
        self.built_for = grid;
        let Desired { power, motion, .. } = &slot.desired;
        if power.serial == 0 {
            if self.is(Defect::WritesBeforeTheFirstOrder) && self.seen && self.taken {
                self.tell(DISABLE, [0.0; 4]);
            }
            return;
        }
        let before = std::mem::replace(&mut self.carried, (power.serial, motion.serial));
        if before == self.carried {
            return;
        }
        let counts = self.axis.units.counts_per_unit;
        let scale = |value: f64| (value * counts).abs();
        let usual = self.axis.profile.deceleration;
        let stop = |deceleration: f64| (STOP, [scale(deceleration), 0.0, 0.0, 0.0]);
        let is_on = self.answer.state == ON;
        let (what, values) = match (power.value, motion.value) {
            (Power::EnableOperation, _) if before.0 != power.serial && !is_on => (ENABLE, [0.0; 4]),
            (Power::EnableOperation, Motion::Move { position, profile: p }) => {
                let [v, a, d] = [p.velocity, p.acceleration, p.deceleration].map(scale);
                (MOVE, [((position - self.axis.units.offset) * counts).round(), v, a, d])
            }
            (Power::EnableOperation, Motion::Ramp { deceleration }) => stop(deceleration),
            (Power::QuickStop, _) | (Power::EnableOperation, Motion::Halt) => stop(4.0 * usual),
            (Power::FaultReset, _) => (RESET, [0.0; 4]),
            (Power::Off | Power::Shutdown | Power::SwitchOn, _) => (DISABLE, [0.0; 4]),
            (Power::Untouched | Power::EnableOperation, _) => (READ, [0.0; 4]),
        };
        let ignored = what == STOP && self.is(Defect::IgnoresStops);
        self.tell(if ignored { READ } else { what }, values);
    }
}
