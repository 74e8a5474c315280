//! Our master, and a class 1 adapter of others that knows nothing of drives. The test is the drive behind its
//! assemblies.
//!
//! The adapter answers the vendor's messages with status 0x05 and has no profile code, so that the plan names the
//! version. It paces its packets by pauses: they come at more than the interval.

use std::process::Command;

use fieldbeat::Master;
use fieldbeat::axis::{Axis, Command as Post, Move, ParameterError, Profile, State, Target};
use fieldbeat::bus::ethernet_ip::{Expected, Explicit, Version};
use fieldbeat::telemetry::Counters;
use serde_json::Value;

use super::{ABSOLUTE, ENABLE, ENABLED, MOVING, drive, plan};
use crate::peer::Peer;
use crate::support::{LONG, Machine, PROGRAM, Program, UNJUDGED, checkout, run, until};

/// So many packets at least.
const PACKETS: u64 = 500;

fn adapter(machine: &Machine) -> Peer {
    let mut python = Command::new(checkout("target/peers/python/bin/python"));
    python.arg(checkout("tests/peers/ethernet_ip/programs/adapter.py")).arg(machine.ip(11).to_string());
    Peer::start(python, machine.path("adapter.err"))
}

/// The 32-bit numbers of an input assembly 0x65: status, volts, temperature, position, position error, inputs.
fn inputs(adapter: &mut Peer, status: i64, position: i64) {
    let inputs = format!("inputs {status} 0 241 1500 305 0 {position} -12 480 0 254 0 1000 2000");
    assert_eq!(adapter.ask(&inputs), "ok");
}

#[track_caller]
fn await_command(adapter: &mut Peer, command: i64) -> Vec<i64> {
    let mut last = Vec::new();
    let came = until(LONG, || {
        last = adapter.integers("outputs 9");
        last[0] == command
    });
    assert!(came, "{command:#x}: {last:?}");
    last
}

fn await_feedback(axis: &Axis, what: &str, is_there: impl Fn(&fieldbeat::Feedback) -> bool) {
    assert!(until(LONG, || is_there(&axis.feedback())), "{what}: {:?}", axis.feedback());
}

fn counters(master: &Master) -> Counters {
    master.numbers().drives[0].counters
}

/// Each packet as agreed: of 70 bytes, running, and with the next sequence count.
#[track_caller]
fn received(adapter: &mut Peer) -> u64 {
    let counts = adapter.numbers("packets");
    assert_eq!(counts[1..], [0, 0, 0], "{counts:?}");
    counts[0]
}

/// Enables and moves, by words that the adapter sees and by statuses that it shows.
fn operate(adapter: &mut Peer, axis: &mut Axis) {
    await_feedback(axis, "values", |feedback| {
        let monitor = feedback.status.monitor;
        monitor[0] == Some(24.1) && monitor[1] == Some(30.5) && feedback.status.position == 0.5
    });
    let enable = axis.post(Post::Enable).unwrap();
    await_command(adapter, ENABLE);
    inputs(adapter, ENABLED, 10_000);
    axis.wait(enable, "Enable", LONG).unwrap();
    await_command(adapter, 0);
    let profile = Profile { velocity: 5.0, acceleration: 100.0, deceleration: 50.0 };
    let begun = axis.post(Post::Move(Move { target: Target::Relative(-1.5), profile })).unwrap();
    // In units of 0.25 rpm, 10 rpm/s, and steps. It moves to where that is: a repetition would be no further move.
    let word = await_command(adapter, ABSOLUTE);
    assert_eq!(word[4..8], [1200, 600, 300, -20_000], "{word:?}");
    inputs(adapter, ENABLED | MOVING, 0);
    await_command(adapter, 0);
    await_feedback(axis, "moving", |feedback| feedback.status.position == 0.0);
    inputs(adapter, ENABLED, -20_000);
    axis.wait(begun, "Move", LONG).unwrap();
    await_feedback(axis, "there", |feedback| feedback.status.position == -1.0);
}

fn exchange(test: u8, explicit: Explicit) {
    let machine = Machine::new(test);
    let mut adapter = adapter(&machine);
    inputs(&mut adapter, 0, 10_000);
    let mut drive = drive("m", machine.ip(11));
    (drive.version, drive.explicit, drive.expected) = (Some(Version::V2), explicit, Expected::ANY);
    let master = Master::from_plan(plan(machine.ip(1), vec![drive])).start().unwrap();
    let mut axis = master.axis("m").unwrap();
    axis.wait_online(LONG).unwrap();
    operate(&mut adapter, &mut axis);
    // What it does not know is refused by its status, and the session goes on.
    let parameter = axis.parameter();
    assert_eq!(parameter.read::<u16>("0x01/1/1.u16").unwrap(), 60);
    let refused = parameter.read::<i32>("absolute").unwrap_err();
    assert!(matches!(refused, ParameterError::Refused { status: 5, .. }), "{refused}");
    assert_eq!(parameter.read::<u16>("0x01/1/3.u16").unwrap(), 176);
    let begun = counters(&master);
    let done = until(LONG, || {
        let counters = counters(&master);
        counters.sent >= begun.sent + PACKETS && counters.answered >= begun.answered + PACKETS
    });
    assert!(done && axis.feedback().status.state == State::OperationEnabled, "{:?}", counters(&master));
    // What was sent arrives, each packet once and as agreed.
    let sent = counters(&master).sent;
    assert!(until(LONG, || received(&mut adapter) >= sent), "{sent}");
    let before = received(&mut adapter);
    let end = master.finish().end.drives[0].counters;
    // Those of the end may be idle, and find the connection closed.
    let counts = adapter.numbers("packets");
    assert!((before..=end.sent).contains(&counts[0]), "{counts:?}: {end:?}");
    assert!(counts[1] == 0 && counts[2] <= counts[0] - before && counts[3] == 0, "{counts:?}");
    assert_eq!((end.malformed, end.duplicate, end.late), (0, 0, 0), "{end:?}");
    // One open, closed at the end; and one of class 3.
    let opened = adapter.numbers("opened");
    let connections = 1 + usize::from(explicit == Explicit::Connected);
    assert_eq!((opened.len(), opened.last()), (connections + 1, Some(&0)), "{opened:?}");
}

#[test]
#[ignore = "needs python3 and cm-ethernetip"]
fn our_master_operates_an_adapter_of_cm_ethernetip() {
    exchange(63, Explicit::Unconnected);
}

#[test]
#[ignore = "needs python3 and cm-ethernetip"]
fn our_master_sends_messages_on_a_connection_to_an_adapter_of_cm_ethernetip() {
    exchange(64, Explicit::Connected);
}

/// The drive of the running master.
fn status(config: &std::path::Path) -> Option<Value> {
    let ended = run([std::ffi::OsStr::new("status"), config.as_os_str(), "--json".as_ref()]);
    (ended.code == Some(0)).then(|| ended.json()["summary"]["drives"][0].clone())
}

#[track_caller]
fn await_drive(config: &std::path::Path, what: &str, is_so: impl Fn(&Value) -> bool) -> Value {
    let mut last = None;
    let came = until(LONG, || {
        last = status(config);
        last.as_ref().is_some_and(&is_so)
    });
    assert!(came, "{what}: {last:?}");
    last.unwrap()
}

#[test]
#[ignore = "needs python3 and cm-ethernetip"]
fn a_running_master_names_an_adapter_that_dies_and_opens_it_again_by_another_serial() {
    let machine = Machine::new(65);
    let config = format!(
        "[cycle]\nperiod = \"2ms\"\nreceive_deadline = 0.8\nmax_skip = \"30s\"\nmax_skip_rate = 1.0\n\
         {UNJUDGED}realtime = \"off\"\n[[bus]]\nprotocol = \"ethernet-ip\"\nbind = \"{}\"\n\
         [[bus.drive]]\nname = \"m\"\naddress = \"{}\"\nversion = \"v2\"\nvendor = \"any\"\ndivisor = 5\n\
         fresh_within = \"500ms\"\nfirst_within = \"20s\"\nhealth = {{ bucket = \"1s\", leak = 1 }}\n\
         limits = {{ position = [-2, 60], velocity = 20, acceleration = 200 }}\n",
        machine.ip(1),
        machine.ip(11)
    );
    let config = machine.write("adapter.toml", config);
    let first = adapter(&machine);
    let mut master = Program::spawn(Command::new(PROGRAM).arg("run").arg(&config).arg("--json"));
    master.await_text("all drives online: 1");
    let mut first = first;
    assert!(until(LONG, || received(&mut first) >= PACKETS));
    let opened = first.numbers("opened");
    assert_eq!(opened.len(), 2, "{opened:?}");
    // kill -9: neither UDP nor TCP says anything before the connection is refused.
    drop(first);
    await_drive(&config, "lost", |drive| drive["link"] == "lost" && drive["losses"] == 1);
    await_drive(&config, "a reason", |drive| {
        drive["not_connected"].as_str().is_some_and(|why| why.contains(&format!("{}:44818", machine.ip(11))))
    });
    master.await_text("drive m: not connected: ");
    let mut second = adapter(&machine);
    master.await_text("drive m: back online");
    assert!(until(LONG, || received(&mut second) >= PACKETS));
    let again = second.numbers("opened");
    assert_eq!(again.len(), 2, "{again:?}");
    assert_ne!(again[0], opened[0]);
    let back = await_drive(&config, "back", |drive| drive["link"] == "online");
    assert_eq!(back["not_connected"], Value::Null, "{back}");
    let own = &back["protocol_counters"];
    assert_eq!((&own["reopened"], &own["timed_out"]), (&1.into(), &1.into()), "{back}");
    let ended = master.end_by(libc::SIGINT);
    assert_eq!(second.numbers("opened").last(), Some(&0), "{}", ended.err);
}
