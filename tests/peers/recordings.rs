//! What readers of others make of a recording: Foxglove's own library, as its viewer uses it, and the Python library of
//! MCAP with the decoder of Protocol Buffers that comes with it. `.ci/run` installs them below `target/peers`.

use std::path::Path;
use std::process::Command;

use fieldbeat::axis::{Command as Order, Move, Profile, Target};
use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan, Native, NativeInputs};
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::recording::Recorder;
use fieldbeat::time::{MS, Time};
use fieldbeat::{CyclePlan, Master, Plan};
use serde_json::{Value, json};

use crate::support::checkout;

const AXES: usize = 8;

/// An hour, of 50 cycles a second: at 1 kHz the file would have more than 3 GB.
const PERIOD_NS: u64 = 20 * MS;
const CYCLES: u64 = 180_000;

/// Every so many cycles the values of all axes are compared one by one.
const EVERY: u64 = 10_007;

/// Reads a recording in its order; for each axis the number of its messages, the sum of its positions, the first and
/// the last time, and what it was every so many cycles; of native process data the same, where there are inputs; and
/// how many bytes the log of the loop has.
const FOXGLOVE: &str = r#"
const { McapIndexedReader } = require("@mcap/core");
const { FileHandleReadable } = require("@mcap/nodejs");
const { protobufFromBinaryDescriptor } = require("@mcap/support");
const { open } = require("node:fs/promises");
(async () => {
  const [path, every] = process.argv.slice(1);
  const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(await open(path, "r")) });
  const types = new Map();
  for (const channel of reader.channelsById.values()) {
    const schema = reader.schemasById.get(channel.schemaId);
    types.set(channel.id, protobufFromBinaryDescriptor(schema.data).lookupType(schema.name));
  }
  const axes = {};
  for await (const message of reader.readMessages()) {
    const topic = reader.channelsById.get(message.channelId).topic;
    const type = types.get(message.channelId);
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
#[ignore = "needs node with @mcap/core, @mcap/nodejs and @mcap/support, and python3 with mcap-protobuf-support"]
fn the_readers_of_others_find_every_value_of_an_hour() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hour.mcap");
    let expected = record(&path);
    let every = EVERY.to_string();
    let mut python = Command::new(checkout("target/peers/python/bin/python"));
    compare(&tell(python.args(["-c", PYTHON]).arg(&path).arg(&every)), &expected);
    let mut node = Command::new("node");
    node.env("NODE_PATH", checkout("target/peers/node_modules"));
    compare(&tell(node.args(["-e", FOXGLOVE]).arg(&path).arg(&every)), &expected);
}
