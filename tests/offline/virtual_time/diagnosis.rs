//! Why a drive is not online: each row of each protocol's table, and near symptoms that are those of another row.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::{Arc, Mutex};

use fieldbeat::axis::Link;
use fieldbeat::bus::BusPlan;
use fieldbeat::sim::{FaultPlan, SerialWire, SimDrive, SimSerial, Simulated, WorldOptions};
use fieldbeat::time::{MS, S, Time};
use fieldbeat::{CyclePlan, Master, Plan, Simulation};
use fieldbeat_core::bus::diagnosis::Row;
use fieldbeat_sim::ethernet_ip::{MoonsSettings, MoonsSim};
use fieldbeat_sim::linudp::LinMotSim;
use fieldbeat_sim::modbus::{UnidriveSettings, UnidriveSim};
use fieldbeat_sim::profibus::{LenzeSettings, LenzeSim, ProfibusSegment};

use super::{kollmorgen, lenze, moons, support};
use crate::between::{Between, Message, Sender, Shared};

/// An address that no drive has.
const ELSEWHERE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 9, 9, 9), 2_222);
/// A connection's bytes, and packets: the sockets of a drive that are changed.
const PACKETS: usize = 1;

/// Where a message of the drive goes.
#[derive(Clone, Copy, PartialEq)]
enum To {
    Master,
    Nobody,
    /// To the master, from another address.
    Elsewhere,
}

/// Changes the messages of the drive; how many came before this one since it began.
type Change = fn(u64, &mut Vec<u8>) -> To;

fn nothing(_: u64, _: &mut Vec<u8>) -> To {
    To::Master
}

fn silence(_: u64, _: &mut Vec<u8>) -> To {
    To::Nobody
}

/// Each message is changed.
fn all(bytes: &mut Vec<u8>, change: fn(&mut Vec<u8>)) -> To {
    change(bytes);
    To::Master
}

/// The first message is changed, and none follows.
fn first(count: u64, bytes: &mut Vec<u8>, change: fn(&mut Vec<u8>)) -> To {
    change(bytes);
    if count == 0 { To::Master } else { To::Nobody }
}

/// What the test does to a drive.
struct Script {
    change: Change,
    count: u64,
    elsewhere: Vec<(SocketAddrV4, Vec<u8>)>,
}

type SharedScript = Arc<Mutex<Script>>;

impl Script {
    fn pass(&mut self, to: SocketAddrV4, bytes: &mut Vec<u8>) -> bool {
        self.count += 1;
        let goes = (self.change)(self.count - 1, bytes);
        if goes == To::Elsewhere {
            self.elsewhere.push((to, bytes.clone()));
        }
        goes == To::Master && !bytes.is_empty()
    }
}

/// A drive whose messages the test changes.
struct Changed<D> {
    drive: D,
    script: SharedScript,
    /// Those on this socket.
    socket: usize,
}

impl<D: SimDrive> Between for Changed<D> {
    fn drive(&mut self) -> &mut dyn SimDrive {
        &mut self.drive
    }

    fn run(&mut self, now: Time, send: &mut Sender<'_>) {
        let Changed { drive, script, socket } = self;
        drive.run(now, &mut |of, to, bytes| {
            let mut bytes = bytes.to_vec();
            if of != *socket || script.lock().unwrap().pass(to, &mut bytes) {
                send(of, to, &bytes);
            }
        });
    }

    fn receive(&mut self, message: Message<'_>, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        let to = message.reaches(&mut self.drive, reply)?;
        (message.socket != self.socket || self.script.lock().unwrap().pass(to, reply)).then_some(to)
    }
}

/// The same on a serial wire, so much later.
struct ChangedSerial {
    drive: LenzeSim,
    script: SharedScript,
    late_ns: u64,
}

impl SimSerial for ChangedSerial {
    crate::forward! { this => this.drive;
        fn receive(&mut self, now: Time, bytes: &[u8]);
        fn restart(&mut self, now: Time);
        fn open_sto(&mut self, until: Time);
    }

    fn next_due(&self) -> Option<Time> {
        self.drive.next_due().map(|due| due + self.late_ns)
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        let mut sent = Vec::new();
        self.drive.run(now, &mut sent);
        if !sent.is_empty() && self.script.lock().unwrap().pass(ELSEWHERE, &mut sent) {
            out.extend(sent);
        }
    }
}

/// What is to be said: a row of the table, or a reason that the wire knows by name.
enum Says {
    Row(&'static str),
    Named(&'static str),
}
use Says::{Named, Row as The};

/// One case.
struct Case {
    /// The drive was online before.
    later: bool,
    change: Change,
    /// Of its wire, from the start.
    faults: FaultPlan,
    /// Its cable is out for so many ms, 0: for good.
    unplugged: Option<u64>,
    says: Says,
}

fn case(later: bool, change: Change, says: Says) -> Case {
    Case { later, change, faults: FaultPlan::default(), unplugged: None, says }
}

fn with(faults: FaultPlan, says: Says) -> Case {
    Case { faults, ..case(false, nothing, says) }
}

fn delayed(share: f64, ms: u64) -> FaultPlan {
    FaultPlan { delay: share, delay_ns: ms * MS, ..FaultPlan::default() }
}

/// The line of each case is the expected one, and each row of `rows` was expected once.
fn check(
    rows: &[Row],
    cases: Vec<Case>,
    machine: impl Fn(&Case, &SharedScript) -> (Simulation, SocketAddrV4),
) {
    let mut said = Vec::new();
    for (number, case) in cases.into_iter().enumerate() {
        let change = if case.later { nothing } else { case.change };
        let script = Arc::new(Mutex::new(Script { change, count: 0, elsewhere: Vec::new() }));
        let (mut sim, address) = machine(&case, &script);
        let online = |sim: &Simulation| sim.feedback(0).link == Link::Online;
        if case.later {
            assert!(sim.run_until(20_000, online), "{number}: not online: {:?}", sim.feedback(0));
            sim.run(1_000);
            assert_eq!(sim.numbers().drives[0].not_connected, None, "{number}");
            let mut script = script.lock().unwrap();
            (script.change, script.count) = (case.change, 0);
        }
        match case.unplugged {
            None => {}
            Some(ms) => {
                assert!(sim.world().unplug(address), "{number}");
                if ms > 0 {
                    sim.run(ms);
                    sim.numbers();
                    assert!(sim.world().plug(address), "{number}");
                }
            }
        }
        for _ in 0..4_000 {
            sim.step();
            for (to, bytes) in script.lock().unwrap().elsewhere.drain(..) {
                let now = sim.world().now();
                sim.world().inject(to, ELSEWHERE, &bytes, now + MS / 10);
            }
        }
        let drive = sim.numbers().drives[0].clone();
        let line = drive.diagnosis.clone().unwrap_or_default();
        assert_eq!(drive.not_connected.is_none(), online(&sim), "{number}: {drive:?}");
        match case.says {
            The(says) => {
                let row = rows.iter().find(|row| row.says == says).unwrap_or_else(|| panic!("no row {says}"));
                // The wire may name the peer before it, and what it has seen between them.
                let is_said = line.contains(row.says) && line.ends_with(row.remedy);
                assert!(is_said, "{number}: {line} {:?}", drive.counters);
                said.push(says);
            }
            Named(part) => assert!(line.contains(part), "{number}: {line:?} {:?}", drive.counters),
        }
        assert_eq!(sim.finish().drives[0].diagnosis.as_deref(), Some(&*line), "{number}: at the end");
    }
    let without: Vec<_> = rows.iter().map(|row| row.says).filter(|says| !said.contains(says)).collect();
    assert_eq!(without, Vec::<&str>::new(), "no case");
}

fn simulated(bus: impl BusPlan, cycle: CyclePlan, drives: impl Into<Simulated>) -> Simulation {
    let plan = Plan { cycle, buses: vec![Box::new(bus)], ..Plan::default() };
    let sim = Master::from_plan(plan).simulate_with(drives, WorldOptions::default());
    sim.unwrap_or_else(|error| panic!("{error}"))
}

fn changed<D: SimDrive + 'static>(drive: D, script: &SharedScript, socket: usize) -> Vec<Box<dyn SimDrive>> {
    vec![Box::new(Shared::new(Changed { drive, script: Arc::clone(script), socket }))]
}

#[test]
fn of_a_linmot() {
    const ENDED: Says = The("its replies have ended, or were lost");
    let short: Change = |_, bytes| {
        bytes.truncate(10);
        To::Master
    };
    let foreign = || FaultPlan { wrong_id: 1.0, ..FaultPlan::default() };
    let cases = vec![
        with(delayed(1.0, 20), The("its replies come too late")),
        // It was late now and then, and its cable is out.
        Case { faults: delayed(0.02, 20), unplugged: Some(0), ..case(true, nothing, ENDED) },
        case(false, short, The("what it answers is no telegram of LinUDP V2")),
        case(true, |count, bytes| first(count, bytes, |bytes| bytes.truncate(bytes.len() - 1)), ENDED),
        with(foreign(), The("it answers from another port, or something that was not requested")),
        Case { faults: FaultPlan { wrong_id: 0.02, ..foreign() }, ..case(true, silence, ENDED) },
        case(
            false,
            |_, _| To::Elsewhere,
            The("nothing comes from its address, and datagrams come from one that no drive has"),
        ),
        case(true, |count, _| if count < 3 { To::Elsewhere } else { To::Nobody }, ENDED),
        case(false, silence, The("nothing has ever come from it")),
        case(true, silence, ENDED),
        Case { unplugged: Some(50), ..case(true, nothing, ENDED) },
    ];
    check(&fieldbeat_linudp::diagnosis::DIAGNOSIS, cases, |case, script| {
        let drive = support::drive(0);
        let mut settings = support::simulated(&drive);
        settings.faults = case.faults.clone();
        let (address, bus) =
            (drive.address, fieldbeat::bus::linudp::LinUdpPlan::new(*support::MASTER.ip(), vec![drive]));
        (simulated(bus, CyclePlan::default(), changed(LinMotSim::new(settings), script, 0)), address)
    });
}

#[test]
fn of_a_unidrive() {
    const ENDED: Says = The("its replies have ended");
    const SILENT: Says = Named("accepts connections, but does not answer");
    fn refuse(reply: &mut Vec<u8>, code: u8) -> To {
        reply.truncate(7);
        reply.extend([0x83, code]);
        reply[5] = 3;
        To::Master
    }
    let no_function: Change = |_, reply| refuse(reply, 1);
    let exception: Change = |_, reply| refuse(reply, 2);
    let bad_value: Change = |_, reply| refuse(reply, 3);
    let failed: Change = |_, reply| refuse(reply, 4);
    let unreached: Change = |_, reply| refuse(reply, 0x0B);
    let wrong_id: Change = |_, reply| {
        reply[1] ^= 0x80;
        To::Master
    };
    let cases = vec![
        case(true, |_, reply| all(reply, |reply| reply[6] ^= 1), The("it answers with another unit id")),
        case(
            true,
            |_, reply| all(reply, |reply| reply[7] = 0x2B),
            The("its replies do not fit the requests"),
        ),
        case(false, wrong_id, The("it answers with another transaction id than the request has")),
        case(true, wrong_id, The("it answers with another transaction id than the request has")),
        // One of these, and then nothing more.
        case(true, |count, reply| first(count, reply, |reply| reply[6] ^= 1), SILENT),
        case(true, |count, reply| first(count, reply, |reply| reply[7] = 0x2B), SILENT),
        case(true, |count, reply| first(count, reply, |reply| reply[1] ^= 0x80), SILENT),
        case(false, no_function, The("it does not have the function by which its status word is read")),
        case(false, exception, The("it refuses to report its status word")),
        case(false, bad_value, The("it does not give its status word in so many bits")),
        case(false, failed, The("it has failed to read its status word")),
        case(false, unreached, The("the gateway in front of it does not reach it")),
        // Each way.
        with(delayed(1.0, 14), The("its replies come later than reply_within")),
        // The cable was out, and what was under way came late: that is one reply.
        Case { unplugged: Some(30), ..case(true, nothing, ENDED) },
        Case { faults: delayed(0.02, 14), unplugged: Some(300), ..case(true, nothing, ENDED) },
        // The handshake has its time, an exchange has not; and neither has.
        with(delayed(1.0, 70), The("it answers, and too late")),
        with(delayed(1.0, 300), The("it answers, and too late")),
        Case { unplugged: Some(0), ..case(false, nothing, Named("no answer from")) },
        Case { unplugged: Some(0), ..case(true, nothing, Named("no answer from")) },
    ];
    check(&fieldbeat_modbus::diagnosis::DIAGNOSIS, cases, |case, script| {
        let mut drive = fieldbeat::bus::modbus::UnidriveDrive::new("u0", [10, 0, 3, 1].into());
        drive.reply_within_ns = 20 * MS;
        let settings = UnidriveSettings { faults: case.faults.clone(), ..UnidriveSettings::of(&drive) };
        let (address, bus) = (drive.address, fieldbeat::bus::modbus::ModbusPlan::new(vec![drive]));
        (simulated(bus, CyclePlan::default(), changed(UnidriveSim::new(settings), script, 0)), address)
    });
}

#[test]
fn of_a_moons() {
    const ENDED: Says = The("its packets have ended");
    let length: Change = |_, packet| {
        packet.pop();
        To::Master
    };
    let cases = vec![
        case(false, length, The("its packets have another length than was agreed")),
        case(true, length, The("its packets have another length than was agreed")),
        case(true, |count, packet| first(count, packet, |packet| packet.truncate(packet.len() - 1)), ENDED),
        case(true, |count, packet| first(count, packet, |packet| packet[0] ^= 0xFF), ENDED),
        case(true, |count, packet| first(count, packet, |packet| packet[7] ^= 0x80), ENDED),
        case(false, |_, _| To::Elsewhere, The("its packets come from another address than its own")),
        case(true, |_, _| To::Elsewhere, The("its packets come from another address than its own")),
        case(true, |count, _| if count < 2 { To::Elsewhere } else { To::Nobody }, ENDED),
        case(
            false,
            |_, packet| {
                packet[0] ^= 0xFF;
                To::Master
            },
            The("what it sends are no class 1 packets, or their numbers leap"),
        ),
        case(
            true,
            |_, packet| {
                packet[7] ^= 0x80;
                To::Master
            },
            The("its packets are those of another connection"),
        ),
        case(
            true,
            |_, packet| {
                packet[10..14].copy_from_slice(&[1, 0, 0, 0]);
                To::Master
            },
            The("its packets have numbers that were there before"),
        ),
        case(
            true,
            |count, packet| {
                packet[10..14].copy_from_slice(&[1, 0, 0, 0]);
                if count < 2 { To::Master } else { To::Nobody }
            },
            ENDED,
        ),
        case(false, silence, The("it opens the connection, and no packet of it has ever come")),
        case(true, silence, ENDED),
        Case { unplugged: Some(0), ..case(false, nothing, Named("no answer from")) },
    ];
    check(&fieldbeat_ethernet_ip::diagnosis::DIAGNOSIS, cases, |case, script| {
        let drive = moons::drive(0);
        let settings = MoonsSettings { faults: case.faults.clone(), ..MoonsSettings::of(&drive) };
        let address = drive.address;
        let bus = fieldbeat::bus::ethernet_ip::EthernetIpPlan::new(moons::BIND, vec![drive]);
        (simulated(bus, CyclePlan::default(), changed(MoonsSim::new(settings), script, PACKETS)), address)
    });
}

/// An answer as SD2 with these addresses, function and data.
fn telegram(head: &[u8], data: &[u8]) -> Vec<u8> {
    let unit = [head, data].concat();
    let length = unit.len() as u8;
    let check = unit.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte));
    [&[0x68, length, length, 0x68][..], &unit, &[check, 0x16]].concat()
}

#[test]
fn of_a_lenze() {
    const ENDED: Says = The("its answers have ended");
    const LATE: Says = The("its answers come after the slot time");
    const SC: &str = "it answers with SC, or with another length, in place of its inputs";
    type Change_ = fn(&mut LenzeSettings);
    /// Of Data_Exchange, that has no access points.
    fn of_exchange(bytes: &[u8]) -> bool {
        matches!(bytes, [0x68, _, _, _, da, sa, ..] if (da | sa) & 0x80 == 0)
    }
    fn sc(bytes: &mut Vec<u8>) {
        if of_exchange(bytes) {
            *bytes = vec![0xE5];
        }
    }
    fn damage(bytes: &mut [u8]) {
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x10;
    }
    fn other(bytes: &mut Vec<u8>) {
        if of_exchange(bytes) {
            bytes[5] ^= 0x20;
            *bytes = telegram(&bytes[4..7], &bytes[7..bytes.len() - 2]);
        }
    }
    fn refuse(bytes: &mut Vec<u8>, function: u8) {
        if of_exchange(bytes) {
            let check = bytes[4].wrapping_add(bytes[5]).wrapping_add(function);
            *bytes = vec![0x10, bytes[4], bytes[5], function, check, 0x16];
        }
    }
    const RR: u8 = 2;
    const RS: u8 = 3;
    const LEFT: Says = The("it does not stay in Data_Exchange");
    const OVERLOADED: Says = The("it cannot take its exchanges (UE, RR)");
    let left: Change = |_, bytes| all(bytes, |bytes| refuse(bytes, RS));
    let overloaded: Change = |_, bytes| all(bytes, |bytes| refuse(bytes, RR));
    // It is lost by that and comes back before anybody looks.
    let left_once: Change = |count, bytes| {
        if count < 200 {
            refuse(bytes, RS);
        }
        To::Master
    };
    let damaged: Change = |_, bytes| all(bytes, |bytes| damage(bytes));
    let unreadable: Change = |_, bytes| {
        if !of_exchange(bytes) && bytes.len() > 11 {
            *bytes = telegram(&bytes[4..9], &bytes[9..12]);
        }
        To::Master
    };
    let (usual, unready): (Change_, Change_) = (|_| (), |drive| drive.dp.ready_ns = 1_000 * S);
    let cases: Vec<(Case, u64, Change_)> = vec![
        (case(false, nothing, LATE), 3 * MS, usual),
        (case(false, damaged, The("its answers arrive damaged")), 0, usual),
        (case(true, damaged, The("its answers arrive damaged")), 0, usual),
        (case(false, |_, bytes| all(bytes, sc), The(SC)), 0, usual),
        (case(false, |_, bytes| all(bytes, other), The("another station answers in its place")), 0, usual),
        (case(false, unreadable, Named("what it answers as its diagnosis is none")), 0, usual),
        (
            case(false, nothing, Named("it is parametrised and configured, and does not become ready")),
            0,
            unready,
        ),
        (case(false, silence, Named("nobody answers at address 3 on /dev/ttyS1")), 0, usual),
        (case(false, left, LEFT), 0, usual),
        (case(true, left, LEFT), 0, usual),
        (case(true, left_once, LEFT), 0, usual),
        (case(false, overloaded, OVERLOADED), 0, usual),
        (case(true, overloaded, OVERLOADED), 0, usual),
        (case(true, silence, ENDED), 0, usual),
        (case(true, |count, bytes| first(count, bytes, |bytes| damage(bytes)), ENDED), 0, usual),
        (case(true, |count, bytes| first(count, bytes, sc), ENDED), 0, usual),
        (case(true, |count, bytes| first(count, bytes, other), ENDED), 0, usual),
    ];
    for (case, late_ns, change) in cases {
        // Each by itself: they differ in more than their messages.
        let rows: Vec<Row> = fieldbeat_profibus::diagnosis::DIAGNOSIS
            .into_iter()
            .filter(|row| matches!(case.says, The(says) if says == row.says))
            .collect();
        check(&rows, vec![case], |_, script| {
            let bus = lenze::wire(1_500_000, 1);
            let mut segment = ProfibusSegment::of(&bus);
            change(&mut segment.drives[0]);
            let SerialWire { line, .. } = segment.wire();
            let drive = LenzeSim::new(&segment.drives[0], line);
            let drive = Box::new(ChangedSerial { drive, script: Arc::clone(script), late_ns });
            let wire = SerialWire { drives: vec![drive as Box<dyn SimSerial>], ..segment.wire() };
            let simulation = Simulated { wires: vec![wire], ..Simulated::default() };
            (simulated(bus, lenze::cycle(), simulation), ELSEWHERE)
        });
    }
}

#[test]
fn of_a_kollmorgen() {
    type Do = fn(&kollmorgen::Machine);
    let faults = |machine: &kollmorgen::Machine, plan: FaultPlan| {
        assert!(machine.sim.world().set_segment_faults(kollmorgen::LINE, plan));
    };
    let late = |share: f64| FaultPlan { delay: share, delay_ns: 700_000, ..FaultPlan::default() };
    let other = FaultPlan { wrong_id: 1.0, ..FaultPlan::default() };
    let cut: Do = |machine| assert!(machine.sim.world().cut(kollmorgen::LINE, Some(0)));
    let deaf: Do = |machine| assert!(machine.sim.world().deafen(kollmorgen::LINE, 0, true));
    let nothing: Do = |_| ();
    for (before, then, what, says) in [
        (0.0, late(1.0), nothing, "its frame comes back after the receive deadline: raise receive_deadline"),
        (0.02, late(0.0), cut, "no frame comes back on local:line: look at its cable"),
        (0.0, other, nothing, "the frames that come back are not those that were sent: end another master"),
        (0.0, late(0.0), cut, "no frame comes back on local:line: look at its cable"),
        (0.0, late(0.0), deaf, "place 0: the slave there is the one of place 1"),
    ] {
        let mut machine = kollmorgen::Machine::new(kollmorgen::plan(2));
        machine.online();
        faults(&machine, late(before));
        machine.run(1_000);
        assert_eq!(machine.sim.numbers().drives[0].diagnosis, None, "{says}");
        faults(&machine, then);
        what(&machine);
        machine.run(500);
        let drive = machine.sim.numbers().drives[0].clone();
        let line = drive.diagnosis.unwrap_or_default();
        assert!(line.starts_with(says), "{line}, not {says}: {:?}", drive.counters);
    }
}
