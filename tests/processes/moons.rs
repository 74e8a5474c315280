//! MOONS' drives as a user meets them: `run`, `param` and `scan`, against simulated ones in a process of their own.

use std::path::{Path, PathBuf};
use std::process::Command;

use fieldbeat::Master;
use fieldbeat::axis::{Link, StopCause};
use libc::{SIGINT, SIGTERM};
use serde_json::Value;

use super::support::controller::{self, TARGET, VELOCITY, Way};
use super::support::{LONG, Machine, PROGRAM, Program, assert_sums, drive, period, role, run, until};
use super::{ask, assert_left, await_status, end_once_online, master, simulation, socket};

/// The test that plays the controllers of all others.
const CONTROLLER: &str = "moons::a_controller_that_is_told_to_end_in_a_move_stops_and_switches_off";

/// Two drives, patient with a busy computer: a revolution is 100 mm.
fn config(machine: &Machine) -> PathBuf {
    let [bind, feeder, turret] = [1, 40, 41].map(|host| machine.ip(host));
    machine.write(
        "moons.toml",
        format!(
            "[cycle]\nperiod = \"{}\"\nreceive_deadline = 0.8\nmax_skip = \"30s\"\nmax_skip_rate = 1.0\n\
             realtime = \"off\"\n[[bus]]\nprotocol = \"ethernet-ip\"\nbind = \"{bind}\"\n\
             [bus.defaults]\nunits = \"mm\"\nscale = 0.01\ndivisor = 4\n\
             fresh_within = \"400ms\"\nfirst_within = \"20s\"\nhealth = {{ bucket = \"1s\", leak = 1 }}\n\
             effect_within = \"5s\"\nlimits = {{ position = [-100, 2000], velocity = 500, acceleration = 5000 }}\n\
             stop.deceleration = 500\njog_deadman = \"off\"\nsetpoint_age = 4000\n\
             homing = {{ method = \"seek\", input = \"2L\", velocity = 100, acceleration = 1000, distance = -50 }}\n\
             [[bus.drive]]\nname = \"feeder\"\naddress = \"{feeder}\"\nsimulate = {{ zs = \"5s\" }}\n\
             [[bus.drive]]\nname = \"turret\"\naddress = \"{turret}\"\nencoder = true\nphase = 2\n\
             explicit = \"connected\"\nsimulate = {{ model = \"SSDC\", zs = \"5s\" }}\n",
            period()
        ),
    )
}

/// The same two; the first turns when the master comes, and takes no stop.
pub fn faulty(machine: &Machine, file: &str) -> PathBuf {
    let config = config(machine);
    let text = std::fs::read_to_string(&config).unwrap();
    let text = text.replace("stop.deceleration = 500", "stop = { deceleration = 5000, timeout = \"500ms\" }");
    let faulty = "simulate = { zs = \"5s\", running = 20.0, ignores_stops = true }";
    machine.write(file, text.replacen("simulate = { zs = \"5s\" }", faulty, 1))
}

/// What a drive holds, by a master of its own that moves nothing.
fn register(config: &Path, name: &str, address: &str) -> i64 {
    let read = ask("param get", config, &format!("{name} {address} --json"));
    read.expect(0).json()["value"].as_i64().unwrap_or_else(|| panic!("{read:?}"))
}

#[test]
fn two_drives_come_online_and_a_run_that_is_ended_names_no_fault() {
    let machine = Machine::new(164);
    let config = config(&machine);
    let _sim = simulation(&config);
    let ended = end_once_online(master(&config, &["--json"]));
    let summary = ended.expect(0).json();
    assert_sums(&summary);
    for name in ["feeder", "turret"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["protocol"], &drive["losses"]), (&"ethernet-ip".into(), &0.into()), "{drive}");
        // The sessions were ended by this master.
        assert_eq!((&drive["not_connected"], &drive["fault"]), (&Value::Null, &Value::Null), "{drive}");
        for key in ["reopened", "timed_out", "wrong_length", "no_packet"] {
            assert_eq!(drive["protocol_counters"][key], 0, "{drive}");
        }
    }
}

#[test]
fn parameters_are_read_written_and_listed_by_a_master_of_its_own_and_through_the_one_that_runs() {
    let machine = Machine::new(165);
    let config = config(&machine);
    let _sim = simulation(&config);
    let works = |value: i64| {
        for name in ["feeder", "turret"] {
            let does = |what: &str, rest: &str| ask(&format!("param {what}"), &config, rest);
            does("set", &format!("{name} AC {value}")).expect(0);
            assert_eq!(register(&config, name, "AC"), value);
            does("set", &format!("{name} R:3 -{value}")).expect(0);
            assert_eq!(register(&config, name, "R:3"), -value);
            assert!(does("get", &format!("{name} 0x01/1/7.text")).expect(0).out.contains("10-IP"));
            assert!(does("list", name).expect(0).out.lines().any(|line| line.starts_with("AC ")));
            does("set", &format!("{name} SC 5")).refused(&[name, "the drive only reports this"]);
            does("get", &format!("{name} 0x77/1/1.u16")).failed(&[name, "0x77/1/1"]);
            does("get", &format!("{name} XY")).refused(&[name, "not an address of this drive"]);
        }
    };
    works(600);
    let mut master = master(&config, &[]);
    master.await_text("all drives online: 2");
    works(1200);
    master.signal(SIGTERM);
    master.end().expect(0);
}

#[test]
fn simulated_drives_are_found_by_a_scan() {
    let machine = Machine::new(166);
    let config = config(&machine);
    let _sim = simulation(&config);
    let [feeder, turret] = [40, 41].map(|host| machine.ip(host).to_string());
    let found = run(["ethernet-ip", "scan", &feeder, &turret, "--json"]).json();
    let names: Vec<_> = found["devices"].as_array().unwrap().iter().map(|device| &device["name"]).collect();
    assert_eq!(names, ["STF10-IP", "SSDC10-IP"]);
}

#[test]
fn a_drive_that_is_not_there_is_named_with_its_reason_and_the_run_has_failed() {
    let machine = Machine::new(167);
    let config = config(&machine);
    let text = std::fs::read_to_string(&config).unwrap();
    let alone = machine.write("alone.toml", text.split("[[bus.drive]]\nname = \"turret\"").next().unwrap());
    let _sim = simulation(&alone);
    let mut master = master(&config, &["--json"]);
    master.await_text(&format!(
        "drive turret: not connected: refused: nobody listens at {}:44818",
        machine.ip(41)
    ));
    await_status(&config, |summary| drive(summary, "feeder")["link"] == "online");
    ask("param get", &config, "feeder AC").expect(0);
    ask("param get", &config, "turret AC").failed(&["turret"]);
    master.signal(SIGINT);
    let summary = master.end().json();
    let count = |name, key| drive(&summary, name)[key].as_u64().unwrap();
    assert_eq!((count("feeder", "losses"), count("turret", "sent")), (0, 0));
    // By itself it waits for no drive, and says so at its end.
    let ended = super::master(&config, &["--for", "1s", "--json"]).end();
    assert!(ended.expect(1).err.contains("turret"), "{}", ended.err);
}

#[test]
fn an_address_that_is_taken_or_foreign_is_refused_in_one_line() {
    let machine = Machine::new(168);
    let config = config(&machine);
    let bind = format!("{}:2222", machine.ip(1));
    let other = socket(bind.parse().unwrap());
    let taken = format!("bus ethernet-ip: cannot bind {bind}: Address already in use");
    master(&config, &["--for", "1s"]).end().refused(&[&taken, "another scanner holds this port", "ss -ulpn"]);
    drop(other);
    let other = socket(format!("{}:2222", machine.ip(40)).parse().unwrap());
    let sim = Program::spawn(Command::new(PROGRAM).arg("sim").arg(&config)).end();
    sim.refused(&["cannot simulate the drives", "Address already in use", "end it"]);
    drop(other);
    let text = std::fs::read_to_string(&config).unwrap();
    // TEST-NET-1 of RFC 5737 is nobody's.
    let net = machine.ip(0).to_string();
    let text = text.replace(net.strip_suffix('0').unwrap(), "192.0.2.");
    let foreign = machine.write("foreign.toml", text);
    let none = "bus ethernet-ip: cannot bind 192.0.2.1:2222: Cannot assign requested address";
    master(&foreign, &["--for", "1s"]).end().refused(&[none, "this host has no such address"]);
}

#[test]
fn drives_that_are_killed_in_mid_motion_are_lost_and_come_back_off() {
    let machine = Machine::new(169);
    let config = config(&machine);
    let sim = simulation(&config);
    let master = Master::from_file(&config).unwrap().start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axes = ["feeder", "turret"].map(|name| master.axis(name).unwrap());
    for axis in &mut axes {
        axis.enable().unwrap();
        axis.home().unwrap();
    }
    for axis in &mut axes {
        axis.jog(VELOCITY).unwrap();
    }
    assert!(until(LONG, || axes.iter().all(|axis| axis.feedback().status.position > 5.0)));
    sim.kill();
    let stopped = |link| {
        move |axis: &fieldbeat::axis::Axis| {
            let feedback = axis.feedback();
            (feedback.link, feedback.stopped) == (link, Some(StopCause::LinkLost))
        }
    };
    assert!(until(LONG, || axes.iter().all(stopped(Link::Lost))));
    let _sim = simulation(&config);
    assert!(until(LONG, || axes.iter().all(stopped(Link::Online))));
    for axis in &mut axes {
        let status = axis.feedback().status;
        assert!(!status.state.is_powered() && !status.homed && status.position == 0.0, "{status:?}");
        axis.enable().unwrap_err();
        axis.reset().unwrap();
        axis.enable().unwrap();
    }
    drop(master);
}

#[test]
fn a_controller_that_is_told_to_end_in_a_move_stops_and_switches_off() {
    if let Some(role) = role() {
        return controller::play(&role);
    }
    let machine = Machine::new(241);
    let config = config(&machine);
    let _sim = simulation(&config);
    let controller = controller::start(&mut controller::child(CONTROLLER, Way::Move, &config));
    controller.signal(SIGINT);
    let summary = controller::summary(&controller.end());
    for name in ["feeder", "turret"] {
        assert_eq!(drive(&summary, name)["stopped"], "shutdown");
        // SC: not enabled, not moving.
        assert_eq!(register(&config, name, "SC") & 0x0031, 0);
        let absolute = register(&config, name, "absolute");
        // 200 steps a mm.
        assert!((2_000..(TARGET * 200.0) as i64).contains(&absolute), "{absolute}");
        assert_eq!(register(&config, name, "absolute"), absolute);
    }
}

#[test]
fn a_drive_that_ignores_its_stops_is_named_with_what_was_tried_and_the_run_has_failed_although_it_was_ended()
{
    let machine = Machine::new(160);
    let config = faulty(&machine, "faulty.toml");
    let _sim = simulation(&config);
    let ended = end_once_online(master(&config, &["--json"]));
    assert_left(
        &ended,
        &[
            "drive feeder still moves at the end (OperationEnabled at ",
            "ramp, quick stop and power off were requested and had no effect",
            "hardware enable (STO)",
        ],
    );
    let summary = ended.json();
    let left = |name| drive(&summary, name)["at_end"].clone();
    let all = serde_json::json!(["ramp", "quick stop", "power off"]);
    assert_eq!(left("feeder"), serde_json::json!({ "condition": "moving", "requested": all }));
    assert_eq!(left("turret")["condition"], "off");
    let failures = summary["failures"].as_array().unwrap();
    let named =
        failures.iter().filter(|failure| failure["what"].as_str().unwrap().starts_with("drive feeder "));
    assert_eq!(named.count(), 1, "{failures:?}");
    // As text, and in the report.
    let report = machine.path("report");
    let ended = end_once_online(master(&config, &["--report", report.to_str().unwrap()]));
    assert!(ended.expect(1).out.contains("drive feeder still moves at the end"), "{}", ended.out);
    let page = std::fs::read_to_string(report.join("index.html")).unwrap();
    assert!(page.contains("drive feeder still moves at the end"));
    assert!(!ended.out.contains("drive turret"), "{}", ended.out);
}
