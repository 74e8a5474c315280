//! What readers of others make of a recording: Foxglove's own library, as its viewer uses it, and the Python library of
//! MCAP with the decoder of Protocol Buffers that comes with it. `.ci/run` installs them below `target/peers`.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use fieldbeat::axis::{Command as Order, Feedback, Move, Profile, Target};
use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan, Native, NativeInputs};
use fieldbeat::config::{Configuration, parse};
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::recording::Recorder;
use fieldbeat::time::{MS, Time};
use fieldbeat::{CyclePlan, Master, Plan};
use fieldbeat_record::recording::reading::{Reading, Wrong};
use serde_json::{Value, json};

use crate::support::checkout;

const AXES: usize = 8;

/// An hour, of 50 cycles a second: at 1 kHz the file would have more than 3 GB.
const PERIOD_NS: u64 = 20 * MS;
const CYCLES: u64 = 180_000;

/// Every so many cycles the values of all axes are compared one by one.
const EVERY: u64 = 10_007;

/// The messages of a recording in its order.
const READ: &str = r#"
const { McapIndexedReader } = require("@mcap/core");
const { FileHandleReadable } = require("@mcap/nodejs");
const { protobufFromBinaryDescriptor } = require("@mcap/support");
const { open } = require("node:fs/promises");
async function* read(path) {
  const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(await open(path, "r")) });
  const types = new Map();
  for (const channel of reader.channelsById.values()) {
    const schema = reader.schemasById.get(channel.schemaId);
    types.set(channel.id, protobufFromBinaryDescriptor(schema.data).lookupType(schema.name));
  }
  for await (const message of reader.readMessages()) {
    const topic = reader.channelsById.get(message.channelId).topic;
    yield { topic, type: types.get(message.channelId), message };
  }
}
"#;

/// For each axis the number of its messages, the sum of its positions, the first and the last time, and what it was
/// every so many cycles; of native process data the same, where there are inputs; and how many bytes the log of the
/// loop has.
const FOXGLOVE: &str = r#"
(async () => {
  const [path, every] = process.argv.slice(1);
  const axes = {};
  for await (const { topic, type, message } of read(path)) {
    if (topic === "/wire") axes[topic] = (axes[topic] ?? 0) + type.decode(message.data).words.length;
    if (!topic.startsWith("/axes/")) continue;
    const decoded = type.toObject(type.decode(message.data), { defaults: true, longs: Number, enums: String });
    const native = topic.endsWith("/native");
    if (native && decoded.inputs.length === 0) continue;
    const axis = (axes[topic] ??= { count: 0, sum: 0, first: message.logTime.toString(), some: [] });
    axis.count += 1;
    axis.sum += native ? decoded.in_actual_position : decoded.position;
    axis.last = message.logTime.toString();
    if (decoded.cycle % every === 0) {
      const bytes = native && Buffer.from(decoded.inputs).toString("hex");
      axis.some.push(
        native
          ? [decoded.cycle, decoded.in_actual_position, decoded.in_status_word, bytes]
          : [decoded.cycle, decoded.position, decoded.demand, decoded.state_name],
      );
    }
  }
  console.log(JSON.stringify(axes));
})();
"#;

const PYTHON: &str = r#"
import json, sys
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
path, every = sys.argv[1], int(sys.argv[2])
axes = {}
with open(path, "rb") as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    for schema, channel, message, decoded in reader.iter_decoded_messages():
        if channel.topic == "/wire":
            axes["/wire"] = axes.get("/wire", 0) + len(decoded.words)
        if not channel.topic.startswith("/axes/"):
            continue
        native = channel.topic.endswith("/native")
        if native and not decoded.inputs:
            continue
        axis = axes.setdefault(channel.topic, {"count": 0, "sum": 0.0, "first": str(message.log_time), "some": []})
        axis["count"] += 1
        axis["sum"] += decoded.in_actual_position if native else decoded.position
        axis["last"] = str(message.log_time)
        if decoded.cycle % every == 0 and native:
            values = [decoded.in_actual_position, decoded.in_status_word, decoded.inputs.hex()]
            axis["some"].append([decoded.cycle, *values])
        elif decoded.cycle % every == 0:
            name = decoded.DESCRIPTOR.fields_by_name["state_name"].enum_type.values_by_number[decoded.state_name].name
            axis["some"].append([decoded.cycle, decoded.position, decoded.demand, name])
print(json.dumps(axes))
"#;

/// Of each topic the time of each message and all of its values, in the order of their fields: whole numbers and names
/// as text, bytes in hexadecimal, nothing for what is not a number.
const FOXGLOVE_ALL: &str = r#"
const text = (field, value) => {
  if (field.type === "double" || field.type === "float") return Number.isFinite(value) ? value : "";
  if (field.type === "bytes") return Buffer.from(value).toString("hex");
  return field.type === "bool" ? String(Number(value)) : String(value);
};
(async () => {
  const all = {};
  for await (const { topic, type, message } of read(process.argv[1])) {
    const decoded = type.toObject(type.decode(message.data), { defaults: true, longs: String, enums: String });
    const fields = [...type.fieldsArray].sort((one, other) => one.id - other.id);
    const values = fields.map((field) => text(field, decoded[field.name]));
    (all[topic] ??= []).push([message.logTime.toString(), ...values]);
  }
  console.log(JSON.stringify(all));
})();
"#;

/// The same; with the word `cut` of a file without its end, up to where that reader fails.
const PYTHON_ALL: &str = r#"
import json, math, sys
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory
path, is_cut = sys.argv[1], sys.argv[2:] == ["cut"]
def text(field, value):
    if field.enum_type is not None:
        return field.enum_type.values_by_number[value].name
    if isinstance(value, float):
        return value if math.isfinite(value) else ""
    if isinstance(value, bytes):
        return value.hex()
    return str(int(value)) if isinstance(value, bool) else str(value)
topics = {}
with open(path, "rb") as file:
    make = NonSeekingReader if is_cut else make_reader
    reader = make(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
    try:
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=not is_cut):
            values = [text(field, getattr(decoded, field.name)) for field in decoded.DESCRIPTOR.fields]
            topics.setdefault(channel.topic, []).append([str(message.log_time), *values])
    except EndOfFile:
        if not is_cut:
            raise
print(json.dumps(topics))
"#;

fn python(script: &str) -> Command {
    let mut python = Command::new(checkout("target/peers/python/bin/python"));
    python.args(["-c", script]);
    python
}

fn node(script: &str) -> Command {
    let mut node = Command::new("node");
    node.env("NODE_PATH", checkout("target/peers/node_modules")).args(["-e", &(READ.to_owned() + script)]);
    node
}

/// What `command` prints, as JSON.
fn tell(command: &mut Command) -> Value {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}; .ci/run installs it"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// A recorded hour in virtual time with its wire, each axis on its way to and fro, the first one with its native
/// process data; and what its readers have to find, from the feedback and the inputs that the application sees.
fn record(path: &Path) -> Value {
    let drives = (0..AXES).map(|index| {
        let mut drive = LinUdpDrive::new(format!("a{index}"), [10, 0, 0, 10 + index as u8].into());
        // They take a row at least every 10 ms.
        drive.stream = None;
        drive
    });
    let bus = LinUdpPlan::new([10, 0, 0, 1].into(), drives.collect());
    let cycle = CyclePlan { period_ns: PERIOD_NS, ..CyclePlan::default() };
    let plan = Plan { cycle, buses: vec![Box::new(bus)], ..Plan::default() };
    let recorder = Recorder::create(path).and_then(Recorder::with_wire).unwrap().with_native(["a0"]);
    let setup = Master::from_plan(plan).with_recorder(recorder);
    let mut machine = setup.simulate(WorldOptions::default()).unwrap();
    let mut sums = [0.0; AXES];
    let mut some = vec![Vec::new(); AXES];
    let native = machine.axis(0).native::<Native>().unwrap();
    let (mut received_at, mut count, mut sum, mut some_native) = (Time(0), 0, 0.0, Vec::new());
    while machine.status().planned < CYCLES {
        let cycle = machine.status().planned;
        for index in 0..AXES {
            let order = match cycle {
                200 => Order::Enable,
                400 => Order::Home,
                // Long after the home position was found.
                4_000.. if cycle % 400 == 10 * index as u64 => {
                    let side = if (cycle / 400).is_multiple_of(2) { 1.0 } else { -1.0 };
                    let profile = Profile { velocity: 20.0, acceleration: 200.0, deceleration: 200.0 };
                    Order::Move(Move { target: Target::Relative(side * (index + 1) as f64), profile })
                }
                _ => continue,
            };
            machine.axis(index).post(order).unwrap();
        }
        machine.step();
        let NativeInputs { at, response, .. } = native.inputs();
        if at > std::mem::replace(&mut received_at, at) {
            let actual = response.actual.unwrap();
            (count, sum) = (count + 1, sum + f64::from(actual));
            if cycle.is_multiple_of(EVERY) {
                let mut bytes = vec![0; response.size()];
                response.emit(&mut bytes);
                let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
                some_native.push(json!([cycle, actual, response.status.unwrap().0, hex]));
            }
        }
        for index in 0..AXES {
            while machine.axis(index).event().is_some() {}
            let feedback = machine.feedback(index);
            let status = feedback.status;
            sums[index] += status.position;
            if feedback.cycle.is_multiple_of(EVERY) {
                some[index].push(json!([
                    feedback.cycle,
                    status.position,
                    status.demand,
                    status.state.name()
                ]));
            }
        }
    }
    let moved = (0..AXES).map(|index| machine.feedback(index).status);
    assert!(moved.into_iter().all(|status| status.homed), "the axes have moved");
    let [recorded] = &machine.finish_recording()[..] else { panic!("one file") };
    assert!(recorded.error.is_none() && recorded.lost == 0, "{recorded}");
    let axis = |index: usize| {
        (format!("/axes/a{index}"), json!({ "count": CYCLES, "sum": sums[index], "some": some[index] }))
    };
    let native = ("/axes/a0/native".to_owned(), json!({ "count": count, "sum": sum, "some": some_native }));
    let wire = ("/wire".to_owned(), json!(recorded.wire.unwrap().bytes));
    Value::Object((0..AXES).map(axis).chain([native, wire]).collect())
}

/// JavaScript writes whole numbers without a point.
fn numbers(value: &Value) -> Value {
    match value {
        Value::Array(all) => all.iter().map(numbers).collect(),
        Value::Number(number) => json!(number.as_f64()),
        other => other.clone(),
    }
}

/// What a reader found is what the application saw.
fn compare(found: &Value, expected: &Value) {
    for (topic, expected) in expected.as_object().unwrap() {
        let found = &found[topic];
        if topic == "/wire" {
            assert_eq!(found, expected, "bytes of the log");
            continue;
        }
        assert_eq!(found["count"], expected["count"], "{topic}");
        assert_eq!(numbers(&found["some"]), numbers(&expected["some"]), "{topic}");
        // The same additions in the same order.
        assert_eq!(found["sum"].as_f64(), expected["sum"].as_f64(), "{topic}");
        let time = |key: &str| found[key].as_str().unwrap().parse::<u64>().unwrap();
        if expected["count"] == CYCLES {
            assert_eq!(time("last") - time("first"), (CYCLES - 1) * PERIOD_NS, "{topic}");
        }
    }
    assert!(expected["/axes/a0/native"]["some"].as_array().unwrap().len() > 10);
}

#[test]
#[ignore = "needs node with @mcap/core, @mcap/nodejs and @mcap/support, and python3 with \
     mcap-protobuf-support"]
fn the_readers_of_others_find_every_value_of_an_hour() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hour.mcap");
    let expected = record(&path);
    let every = EVERY.to_string();
    compare(&tell(python(PYTHON).arg(&path).arg(&every)), &expected);
    compare(&tell(node(FOXGLOVE).arg(&path).arg(&every)), &expected);
}

/// Of each topic the time of each message and its values, as texts.
type Topics = BTreeMap<String, Vec<Vec<String>>>;

/// What our own reader finds, and what is wrong with the rest.
fn own(bytes: Vec<u8>) -> (Topics, Option<Wrong>) {
    let (mut topics, mut wrong) = (Topics::new(), None);
    for entry in Reading::of(bytes).map_while(|entry| entry.map_err(|why| wrong = Some(why)).ok()) {
        let values = std::iter::once(entry.utc_ns.to_string()).chain(entry.texts()).collect();
        topics.entry(entry.topic.name.clone()).or_default().push(values);
    }
    (topics, wrong)
}

/// Another reader has found the same: numbers of 64 or 32 bits, or the same text.
fn compare_all(found: &Value, own: &Topics) {
    let same = |found: &Value, own: &String| match found {
        Value::String(text) => text == own,
        Value::Number(number) => {
            let number = number.as_f64().unwrap();
            own.parse() == Ok(number) || own.parse::<f32>().is_ok_and(|own| f64::from(own) == number)
        }
        _ => false,
    };
    let found = found.as_object().unwrap();
    assert!(found.keys().eq(own.keys()), "{:?} {:?}", found.keys(), own.keys());
    for (topic, own) in own {
        let found = found[topic].as_array().unwrap();
        assert_eq!(found.len(), own.len(), "{topic}");
        for (found, own) in found.iter().zip(own) {
            let found = found.as_array().unwrap();
            let is_same =
                found.len() == own.len() && found.iter().zip(own).all(|(one, other)| same(one, other));
            assert!(is_same, "{topic}: {found:?} {own:?}");
        }
    }
}

const EVERYTHING: &str = r#"
[cycle]
period = "1ms"
reference = "ethercat"
[[bus]]
protocol = "linudp-v2"
bind = "10.0.0.1"
[[bus.drive]]
name = "x"
address = "10.0.0.2"
monitor = ["demand-current", "motor-temperature"]
[[bus]]
protocol = "ethercat"
interface = "local:recordings"
[[bus.drive]]
name = "y"
"#;

/// Some seconds of an axis in motion and of one whose clock leads, with late cycles and slots that are skipped: the
/// file has messages of every topic but the log of the loop, as many as the loop counts, and with the values that the
/// application saw.
fn record_everything(path: &Path) {
    let Configuration { plan, simulation, .. } = parse(EVERYTHING, "m.toml").unwrap();
    let recorder = Recorder::create(path).unwrap().with_native(["all"]);
    let setup = Master::from_plan(plan).with_simulation(simulation).with_recorder(recorder);
    let mut machine = setup.simulate(WorldOptions::default()).unwrap();
    let (mut seen, mut events) = (BTreeMap::new(), 0);
    for turn in 0..7_500 {
        let order = match turn {
            500 => Some(Order::Enable),
            900 => Some(Order::Home),
            6_000 => {
                let profile = Profile { velocity: 50.0, acceleration: 500.0, deceleration: 500.0 };
                Some(Order::Move(Move { target: Target::Relative(4.0), profile }))
            }
            _ => None,
        };
        if let Some(order) = order {
            machine.axis(0).post(order).unwrap();
        }
        match turn {
            7_000 => machine.world().delay_next_wake(200_000),
            7_100 => machine.world().delay_next_wake(3 * MS),
            _ => {}
        }
        machine.step();
        for axis in 0..2 {
            events += std::iter::from_fn(|| machine.axis(axis).event()).count() as u64;
        }
        let Feedback { cycle, status, .. } = machine.feedback(0);
        let error = status.demand - status.position;
        let values =
            [error.to_string(), (status.velocity as f32).to_string(), (status.current as f32).to_string()];
        seen.insert(cycle, values);
    }
    let status = *machine.status();
    let [recorded] = &machine.finish_recording()[..] else { panic!("one file") };
    assert!(recorded.failure().is_none(), "{recorded}");
    let (own, wrong) = own(std::fs::read(path).unwrap());
    assert!(wrong.is_none(), "{wrong:?}");
    let count = |topic: &str| own.get(topic).map_or(0, Vec::len) as u64;
    assert_eq!(recorded.messages, own.keys().map(|topic| count(topic)).sum::<u64>());
    for topic in ["/axes/x", "/axes/y", "/cycle", "/reference"] {
        assert_eq!(count(topic), status.executed, "{topic}");
    }
    let of = |topic: &str, column: usize| own[topic].iter().map(move |values| &*values[column]);
    // Behind the time of the file, the cycle and the time of the loop.
    let sum: u64 = of("/skipped", 3).map(|count| count.parse::<u64>().unwrap()).sum();
    assert_eq!((sum, count("/late")), (status.skipped, status.late));
    assert!(status.skipped > 0 && status.late > 1, "{status:?}");
    let reported = of("/reference", 3).filter(|reported| *reported == "1").count() as u64;
    assert_eq!(reported, status.reference.unwrap().samples);
    assert!(reported > 0 && count("/axes/x/monitors") > 0 && count("/axes/x/native") > 0);
    assert_eq!(count("/events"), events);
    let begun: Vec<&str> = of("/commands", 9).collect();
    assert_eq!(begun, ["enable", "enable", "home", "home", "move", "move"]);
    for values in &own["/axes/x"] {
        assert_eq!(values[5..8], seen[&values[1].parse().unwrap()], "{values:?}");
    }
}

#[test]
#[ignore = "needs node with @mcap/core, @mcap/nodejs and @mcap/support, and python3 with \
     mcap-protobuf-support"]
fn the_readers_of_others_find_every_value_of_every_topic() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("all.mcap");
    record_everything(&path);
    let bytes = std::fs::read(&path).unwrap();
    let (whole, _) = own(bytes.clone());
    compare_all(&tell(python(PYTHON_ALL).arg(&path)), &whole);
    compare_all(&tell(node(FOXGLOVE_ALL).arg(&path)), &whole);

    // In the middle of the last chunk.
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let last = summary.chunk_indexes.iter().max_by_key(|index| index.chunk_start_offset).unwrap();
    let cut = &bytes[..(last.chunk_start_offset + last.chunk_length / 2) as usize];
    let (read, wrong) = own(cut.to_vec());
    assert!(matches!(wrong, Some(Wrong::Cut)), "{wrong:?}");
    let counts = ["/cycle", "/axes/x"].map(|topic| (read[topic].len(), whole[topic].len()));
    assert!(counts.iter().all(|(read, whole)| *read > 1_000 && read < whole), "{counts:?}");
    std::fs::write(&path, cut).unwrap();
    compare_all(&tell(python(PYTHON_ALL).arg(&path).arg("cut")), &read);
}
