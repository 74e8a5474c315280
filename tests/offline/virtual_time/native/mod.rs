//! Native process data in a recording are the bytes that passed the wire, cycle by cycle, on each protocol.
//!
//! | file | what |
//! |---|---|
//! | `mod` | a machine of two drives of each protocol, one of which is recorded natively |
//! | `wire` | what passed the wires |

mod wire;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use fieldbeat::axis::{Command, Jog, Link};
use fieldbeat::bus::ethercat::{EthercatPlan, Family};
use fieldbeat::bus::ethernet_ip::EthernetIpPlan;
use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan, MonitorPlan};
use fieldbeat::bus::modbus::{ModbusPlan, UnidriveDrive};
use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::recording::Recorder;
use fieldbeat::time::{MS, Time};
use fieldbeat::{CyclePlan, Master, Plan, Simulation};
use fieldbeat_core::cycle::record::NativeRecord;
use fieldbeat_modbus::wire::{Request, Response};
use fieldbeat_record::recording::reading::{Entry, Reading};

use self::wire::{Both, Logs, Passed};

const PERIOD_NS: u64 = 2 * MS;
/// The number of the socket of a simulated drive for the packets of EtherNet/IP.
const PACKETS: usize = 1;
/// The address of the MOONS' drive that is chosen.
const MOONS: &str = "10.0.5.2:44818";
/// The chosen drives.
const CHOSEN: [&str; 5] = ["lin0", "uni0", "koll0", "moons0", "lenze0"];

fn plan(interval_ns: u64) -> Plan {
    let [lin, uni, koll, moons, lenze] = CHOSEN.map(|name| {
        let name = name.trim_end_matches('0');
        [0, 1].map(|index| (format!("{name}{index}"), index))
    });
    let lin = lin.map(|(name, index)| {
        let mut drive = LinUdpDrive::new(name, [10, 0, 1, 10 + index].into());
        // Telegrams of more than one record.
        drive.monitor = MonitorPlan::AsSet;
        drive
    });
    let uni = uni.map(|(name, index)| {
        let mut drive = UnidriveDrive::new(name, [10, 0, 2, 10 + index].into());
        drive.axis.jog_deadman = None;
        drive
    });
    let koll = koll.map(|(name, index)| {
        let mut drive = super::kollmorgen::drive(index.into(), Family::S700);
        drive.axis.name = name;
        drive
    });
    let moons = moons.map(|(name, index)| {
        let mut drive = super::moons::drive(index.into());
        drive.axis.name = name;
        drive.input_rpi_ns = Some(interval_ns);
        drive
    });
    let lenze = lenze.map(|(name, index)| {
        let mut drive = super::lenze::drive(index.into());
        drive.axis.name = name;
        drive
    });
    let cycle = CyclePlan { period_ns: PERIOD_NS, receive_deadline: 0.8, ..CyclePlan::default() };
    let buses: Vec<Box<dyn fieldbeat::bus::BusPlan>> = vec![
        Box::new(LinUdpPlan::new([10, 0, 1, 1].into(), lin.into())),
        Box::new(ModbusPlan::new(uni.into())),
        Box::new(EthercatPlan::new(super::kollmorgen::LINE, koll.into())),
        Box::new(EthernetIpPlan::new(super::moons::BIND, moons.into())),
        Box::new(ProfibusPlan::new(super::lenze::PORT, 1_500_000, lenze.into())),
    ];
    Plan { cycle, buses, ..Plan::default() }
}

/// All drives in operation, then moving, for a while each; the MOONS' drives send packets in this interval.
fn run(path: &Path, interval_ns: u64) -> (Simulation, Logs) {
    let recorder = Recorder::create(path).unwrap().with_native(CHOSEN);
    let setup = Master::from_plan(plan(interval_ns)).with_recorder(recorder);
    let mut simulated = setup.simulation().build();
    let logs = Logs::of(&mut simulated, PACKETS);
    let mut m =
        setup.simulate_with(simulated, WorldOptions::default()).unwrap_or_else(|error| panic!("{error}"));
    let axes = 2 * CHOSEN.len();
    assert!(m.run_until(20_000, |m| (0..axes).all(|axis| m.feedback(axis).link == Link::Online)));
    for axis in 0..axes {
        m.execute(axis, Command::Enable, 10_000).unwrap();
        assert!(m.feedback(axis).status.state.is_powered(), "{axis}: {:?}", m.feedback(axis));
        let _ = m.axis(axis).post(Command::Jog(Jog { velocity: 2.0, acceleration: 20.0 }));
    }
    m.run(500);
    (m, logs)
}

/// A message with native process data.
struct Native {
    entry: Entry,
    grid: Time,
    received_at: Time,
    inputs: Vec<u8>,
    outputs: Vec<u8>,
}

impl Native {
    fn new(entry: Entry) -> Native {
        let bytes = |field: &str| {
            let text = entry.text(field);
            (0..text.len()).step_by(2).map(|at| u8::from_str_radix(&text[at..at + 2], 16).unwrap()).collect()
        };
        let time = |field: &str| Time(entry.number(field));
        Native {
            grid: time("monotonic_ns"),
            received_at: time("received_at_ns"),
            inputs: bytes("inputs"),
            outputs: bytes("outputs"),
            entry,
        }
    }

    /// A value; not a number if the message does not have it.
    fn value(&self, field: &str) -> f64 {
        self.entry.text(field).parse().unwrap_or(f64::NAN)
    }
}

/// What `part` takes out of what passed; `None` for what is of no interest.
fn parts(passed: &Passed, part: impl Fn(&[u8]) -> Option<Vec<u8>>) -> Passed {
    passed.iter().filter_map(|(at, bytes)| Some((*at, part(bytes)?))).collect()
}

/// The messages have the outputs that came to the drive, each in the cycle in which it came. What passed before the
/// drive was in operation comes first.
fn compare_outputs(what: &str, messages: &[Native], to: &Passed) {
    let outputs: Vec<&Native> = messages.iter().filter(|message| !message.outputs.is_empty()).collect();
    assert!(outputs.len() > 500 && outputs.len() <= to.len(), "{what}: {} of {}", outputs.len(), to.len());
    for (message, (at, bytes)) in outputs.iter().zip(&to[to.len() - outputs.len()..]) {
        assert_eq!(message.outputs, *bytes, "{what} at {at:?}");
        assert!((message.grid..message.grid + PERIOD_NS).contains(at), "{what}: {at:?} {:?}", message.grid);
    }
}

/// The messages with inputs, each with what the drive sent for it; that was before it was received.
fn inputs<'a, T>(what: &str, messages: &'a [Native], from: &'a [(Time, T)]) -> Vec<(&'a Native, &'a T)> {
    let inputs: Vec<&Native> = messages.iter().filter(|message| !message.inputs.is_empty()).collect();
    let last = inputs.last().expect("there are some").received_at;
    // Later ones were under way at the end.
    let from: Vec<_> = from.iter().filter(|(at, _)| *at <= last).collect();
    assert!(inputs.len() > 500 && inputs.len() <= from.len(), "{what}: {} of {}", inputs.len(), from.len());
    let before = from.len() - inputs.len();
    let pairs = inputs.into_iter().zip(&from[before..]).map(|(message, (at, sent))| {
        let window = message.grid..message.grid + PERIOD_NS;
        assert!(*at <= message.received_at && window.contains(&message.received_at), "{what} at {at:?}");
        (message, sent)
    });
    pairs.collect()
}

/// The messages have the inputs that the drive sent.
fn compare_inputs(what: &str, messages: &[Native], from: &Passed) {
    for (message, bytes) in inputs(what, messages, from) {
        assert_eq!(message.inputs, *bytes, "{what} at {:?}", message.grid);
    }
}

/// What a master of Modbus knows after each reply: the newest count at each address, and the addresses of the reply.
type KnownCounts = (BTreeMap<u16, i64>, Vec<u16>);

fn known(requests: &Passed, replies: &Passed) -> Vec<(Time, KnownCounts)> {
    let mut counts = BTreeMap::new();
    let mut known = Vec::new();
    for (at, reply) in replies {
        let (header, response) = Response::parse(reply).unwrap();
        let same = |(_, request): &&(Time, Vec<u8>)| request[..2] == header.transaction.to_be_bytes();
        let (_, request) = requests.iter().rev().find(same).unwrap();
        let first = match Request::parse(request).unwrap().1 {
            Request::Read { address, .. } | Request::ReadWrite { read: address, .. } => address,
            Request::Write { .. } | Request::WriteOne { .. } => continue,
        };
        let (Response::Read { data } | Response::ReadWritten { data }) = response else { continue };
        // 32-bit access: the address counts parameters.
        let values: Vec<i64> = match first & 0x4000 {
            0 => data.words().map(|word| (word as i16).into()).collect(),
            _ => data.longs().map(i64::from).collect(),
        };
        let read: Vec<u16> = (first & !0xC000..).take(values.len()).collect();
        counts.extend(read.iter().copied().zip(values));
        known.push((*at, (counts.clone(), read)));
    }
    known
}

/// A field, whether it is in the outputs, and its number in the bytes.
type Number = (&'static str, bool, fn(&[u8]) -> i64);

/// The numbers of a message are those in its bytes.
fn numbers(messages: &[Native], fields: &[Number]) {
    for (field, is_output, number) in fields {
        let of = |message: &Native| if *is_output { message.outputs.clone() } else { message.inputs.clone() };
        let mut seen = BTreeSet::new();
        for message in messages {
            let bytes = of(message);
            if bytes.is_empty() {
                assert!(message.value(field).is_nan(), "{field}: nothing was received, or sent");
            } else {
                assert_eq!(message.value(field), number(&bytes) as f64, "{field} of {bytes:02x?}");
                seen.insert(number(&bytes));
            }
        }
        assert!(seen.len() > 1, "{field} has changed: {seen:?}");
    }
}

fn word_le(bytes: &[u8], at: usize) -> i64 {
    u16::from_le_bytes(*bytes[at..].first_chunk().unwrap()).into()
}

fn word_be(bytes: &[u8], at: usize) -> i64 {
    u16::from_be_bytes(*bytes[at..].first_chunk().unwrap()).into()
}

fn long_le(bytes: &[u8], at: usize) -> i64 {
    i32::from_le_bytes(*bytes[at..].first_chunk().unwrap()).into()
}

/// The process data of a frame with one LRW: all of it, from the outputs of the first drive on.
fn process_data(frame: &[u8]) -> Option<&[u8]> {
    let mut rest = frame.get(16..)?;
    loop {
        let length = usize::from(u16::from_le_bytes(*rest.get(6..)?.first_chunk()?) & 0x7FF);
        if *rest.first()? == 12 {
            return rest.get(10..10 + length);
        }
        rest = rest.get(12 + length..)?;
    }
}

/// The process data of a telegram of Data_Exchange of the drive at address 3: its first 8 bytes are the parameter
/// channel.
fn data_exchange(telegram: &[u8], is_request: bool) -> Option<Vec<u8>> {
    let [0x68, _, _, _, to, from, code, data @ .., _, _] = telegram else { return None };
    let (address, function) = if is_request { (to, code & 0x4F == 0x4D) } else { (from, code & 0x40 == 0) };
    (*address == 3 && function && data.len() == 12).then(|| data[8..].to_vec())
}

/// All messages of the recording.
fn entries(mut m: Simulation, path: &Path) -> Vec<Entry> {
    let [recorded] = &m.finish_recording()[..] else { panic!("one file") };
    assert!(recorded.error.is_none() && recorded.lost == 0, "{recorded}");
    Reading::open(path).unwrap().map(Result::unwrap).collect()
}

/// The messages of a Unidrive are what passed the wire.
fn compare_unidrive(uni: &[Native], wire: &Both) {
    let requests = parts(&wire.to, |message| Some(message[7..].to_vec()));
    compare_outputs("uni", uni, &requests);
    let known = known(&wire.to, &wire.from);
    // Pr 10.040 is the status word, Pr 03.002 the speed.
    let fields = [("in_register_10_40", 1039), ("in_register_3_2", 301)];
    let mut compared = 0;
    for (message, (counts, read)) in inputs("uni", uni, &known) {
        for (field, address) in fields {
            let value = message.value(field);
            assert!(!(read.contains(&address) && value.is_nan()), "{field} was read in {:?}", message.grid);
            if !value.is_nan() {
                assert_eq!(value, counts[&address] as f64, "{field} in {:?}", message.grid);
                compared += 1;
            }
        }
    }
    assert!(compared > 500, "{compared}");
}

#[test]
fn a_packet_before_the_window_and_one_in_it_are_a_message_each() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("run.mcap");
    let (m, logs) = run(&path, PERIOD_NS / 2);
    let entries = entries(m, &path).into_iter();
    let moons = entries.filter(|entry| entry.topic.name == "/axes/moons0/native").map(Native::new);
    let received: Vec<Native> = moons.filter(|message| !message.inputs.is_empty()).collect();
    // In their order; where two came at once, the newer one.
    let mut packets = logs.drive(MOONS.parse().unwrap()).from.into_iter();
    for message in &received {
        assert!(packets.any(|(_, packet)| packet[20..] == message.inputs), "in {:?}", message.grid);
    }
    let twice = received.windows(2).filter(|pair| pair[0].grid == pair[1].grid).count();
    assert!(twice > 100, "{twice} of {}", received.len());
}

#[test]
fn native_process_data_are_what_passed_the_wire_on_each_protocol() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("run.mcap");
    let (m, logs) = run(&path, PERIOD_NS);
    let entries = entries(m, &path);
    let topics = entries.iter().map(|entry| &*entry.topic.name).filter(|topic| topic.ends_with("/native"));
    let topics: BTreeSet<&str> = topics.collect();
    let expected = CHOSEN.map(|name| format!("/axes/{name}/native"));
    assert_eq!(topics, expected.iter().map(String::as_str).collect(), "those that are chosen, and no other");
    let mut of: [Vec<Native>; 5] = Default::default();
    for entry in entries {
        if let Some(place) = expected.iter().position(|topic| *topic == entry.topic.name) {
            of[place].push(Native::new(entry));
        }
    }
    let [lin, uni, koll, moons, lenze] = &of;

    let wire = logs.drive("10.0.1.10:49360".parse().unwrap());
    compare_outputs("lin", lin, &wire.to);
    compare_inputs("lin", lin, &wire.from);
    numbers(lin, &[("in_status_word", false, |bytes| word_le(bytes, 8))]);
    let [before, end] = [&lin[0], lin.last().unwrap()];
    assert_eq!([before, end].map(|message| message.value("out_control_word").is_nan()), [true, false]);
    let monitored = lin.iter().filter(|message| message.value("in_monitoring_channel_4").is_finite());
    assert!(monitored.count() > 100, "they come with some replies");
    let length = |message: &Native| message.inputs.len() + message.outputs.len();
    assert!(lin.iter().any(|message| length(message) > NativeRecord::PART), "some come in parts");

    compare_unidrive(uni, &logs.drive("10.0.2.10:502".parse().unwrap()));
    let speeds = uni.iter().map(|message| message.value("in_register_3_2"));
    assert!(speeds.into_iter().any(|speed| speed > 1_000.0), "0.1 rpm, of 2 rev/s");
    let controls: Vec<f64> = uni.iter().map(|message| message.value("out_register_6_42")).collect();
    assert!(controls.iter().any(|control| control.is_nan()) && controls.iter().any(|control| *control > 0.0));

    let wire = logs.segment();
    let outputs = parts(&wire.to, |frame| Some(process_data(frame)?[..6].to_vec()));
    let inputs = parts(&wire.from, |frame| Some(process_data(frame)?[14..22].to_vec()));
    compare_outputs("koll", koll, &outputs);
    compare_inputs("koll", koll, &inputs);
    numbers(
        koll,
        &[
            ("in_6064_0_position", false, |bytes| long_le(bytes, 0)),
            ("in_6041_0_status_word", false, |bytes| word_le(bytes, 6)),
            ("out_6040_0_control_word", true, |bytes| word_le(bytes, 4)),
        ],
    );

    let wire = logs.drive(MOONS.parse().unwrap());
    let outputs = parts(&wire.to, |packet| Some(packet[24..88].to_vec()));
    let inputs = parts(&wire.from, |packet| Some(packet[20..].to_vec()));
    compare_outputs("moons", moons, &outputs);
    compare_inputs("moons", moons, &inputs);
    numbers(
        moons,
        &[
            ("in_status", false, |bytes| word_le(bytes, 0)),
            ("in_absolute_position", false, |bytes| long_le(bytes, 24)),
            ("out_command", true, |bytes| long_le(bytes, 0)),
        ],
    );

    let wire = logs.serial();
    let outputs = parts(&wire.to, |telegram| data_exchange(telegram, true));
    let inputs = parts(&wire.from, |telegram| data_exchange(telegram, false));
    compare_outputs("lenze", lenze, &outputs);
    compare_inputs("lenze", lenze, &inputs);
    numbers(
        lenze,
        &[
            ("in_word_0", false, |bytes| word_be(bytes, 0)),
            ("in_word_1", false, |bytes| (word_be(bytes, 2) as i16).into()),
            ("out_word_0", true, |bytes| word_be(bytes, 0)),
        ],
    );
}
