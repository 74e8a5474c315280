//! Lenze drives as a user meets them: `check`, `run`, `param` and `profibus scan`, against simulated ones on a wire of
//! this host, in a process of their own.

use std::fs::File;
use std::os::fd::AsRawFd;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;

use fieldbeat::Master;
use fieldbeat::axis::{Link, StopCause};
use fieldbeat::telemetry::Summary;
use libc::{SIGINT, SIGTERM};
use serde_json::Value;

use super::support::{
    LONG, Machine, Program, again, as_ordinary_user, assert_sums, checkout, controller, drive, period, role,
    run, until,
};
use super::{MS, ask, assert_left, await_status, end_once_online, master, simulation};

/// The test that plays the controllers of all others.
const CONTROLLER: &str = "lenze::a_controller_that_is_told_to_end_while_motors_turn_ramps_them_down";
/// What it says when its motors turn.
const UNDER_WAY: &str = "under way";

/// Two drives, patient with a busy computer. `more` are further keys of the wire, `of_second` of the second drive.
struct Wire {
    machine: Machine,
    config: PathBuf,
    device: String,
}

impl Wire {
    fn with(test: u8, more: &str, of_second: &str) -> Wire {
        let machine = Machine::new(test);
        let device = format!("local:lenze-{}-{test}", std::process::id());
        let config = machine.write(
            "lenze.toml",
            format!(
                "[cycle]\nperiod = \"{}\"\nreceive_deadline = 0.8\nmax_skip = \"30s\"\nmax_skip_rate = 1.0\n\
                 realtime = \"off\"\n[[bus]]\nprotocol = \"profibus-dp\"\ndevice = \"{device}\"\n\
                 latency = \"3ms\"\n{more}\n\
                 [bus.defaults]\ndivisor = 16\nlimits = {{ velocity = 25, acceleration = 50 }}\n\
                 stop = {{ deceleration = 50, standstill_for = 5 }}\njog_deadman = \"off\"\nwatchdog = \"6s\"\n\
                 health = {{ bucket = \"5s\", leak = 1 }}\n\
                 [[bus.drive]]\nname = \"infeed\"\naddress = 3\n\
                 [[bus.drive]]\nname = \"outfeed\"\naddress = 4\nphase = 8\n{of_second}\n",
                period()
            ),
        );
        Wire { machine, config, device }
    }

    fn new(test: u8) -> Wire {
        Wire::with(test, "", "")
    }

    fn scan(&self, options: &[&str]) -> Program {
        let words = ["profibus", "scan", &self.device];
        Program::start(words.iter().chain(options))
    }
}

#[test]
fn check_says_what_becomes_of_a_lenze_if_the_master_dies() {
    let ended = run(["check".into(), checkout("rt-config/lenze.toml")]);
    ended.expect(0);
    assert_eq!(ended.err, "");
    for part in ["if the master dies: stops within 100 ms by its own watchdog", "not a safety function"] {
        assert!(ended.out.contains(part), "no {part}: {}", ended.out);
    }
}

#[test]
fn two_drives_come_online_whoever_is_there_first_and_the_run_says_what_the_wire_did() {
    let wire = Wire::new(201);
    let mut master = master(&wire.config, &["--json"]);
    master.await_text(&format!(
        "drive infeed: not connected: nobody simulates the wire {}: start `fieldbeat sim`",
        wire.device
    ));
    let _sim = simulation(&wire.config);
    let summary = end_once_online(master).expect(0).json();
    assert_sums(&summary);
    let load = summary["buses"][0]["load_percent"].as_f64().unwrap();
    assert!(load > 0.0 && load < 100.0, "{summary}");
    for name in ["infeed", "outfeed"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["protocol"], &drive["losses"]), (&"profibus-dp".into(), &0.into()), "{drive}");
        assert_eq!((&drive["not_connected"], &drive["fault"]), (&Value::Null, &Value::Null), "{drive}");
        let counters = &drive["protocol_counters"];
        for key in ["retries", "slot_times"] {
            assert!(counters[key].is_u64(), "no {key}: {drive}");
        }
        // Slave_Diag, Set_Prm, Chk_Cfg, Slave_Diag.
        assert!(counters["start_ups"].as_u64() >= Some(4), "{drive}");
        assert!(counters["wire_us"].as_u64() > Some(0), "the load of the wire: {drive}");
        for key in ["wrong_station", "second_master"] {
            assert_eq!(counters[key], 0, "{drive}");
        }
        // An answer of a drive that its host holds up collides with the retry.
        for key in ["wrong_check", "wrong_length"] {
            assert!(counters[key].as_u64() <= counters["slot_times"].as_u64(), "{drive}");
        }
    }
}

#[test]
fn a_drive_that_is_not_there_and_a_wrong_ident_number_are_named_and_the_other_drive_runs() {
    let wire = Wire::with(202, "", "simulate.ident = 0x1234");
    let sim = simulation(&wire.config);
    let mut master = super::master(&wire.config, &[]);
    master.await_text("drive outfeed: not connected: ");
    assert!(until(LONG, || master.err().contains("0x1234")), "{}", master.err());
    await_status(&wire.config, |summary| drive(summary, "infeed")["link"] == "online");
    master.signal(SIGINT);
    master.end();
    sim.signal(SIGTERM);
    sim.end().expect(0);

    let text = std::fs::read_to_string(&wire.config).unwrap();
    let alone =
        wire.machine.write("alone.toml", text.split("[[bus.drive]]\nname = \"outfeed\"").next().unwrap());
    let _sim = simulation(&alone);
    let mut master = super::master(&wire.config, &["--json"]);
    master.await_text("drive outfeed: not connected: ");
    await_status(&wire.config, |summary| drive(summary, "infeed")["link"] == "online");
    master.signal(SIGINT);
    let summary = master.end().json();
    assert_eq!(drive(&summary, "infeed")["losses"], 0, "{summary}");
    let silent = drive(&summary, "outfeed");
    assert!(silent["protocol_counters"]["slot_times"].as_u64() > Some(0), "{silent}");
    assert_ne!(silent["link"], "online", "{silent}");
}

#[test]
fn codes_are_read_and_written_by_a_master_of_its_own_and_through_the_one_that_runs() {
    let wire = Wire::new(203);
    let _sim = simulation(&wire.config);
    let works = |raw: u32| {
        for name in ["infeed", "outfeed"] {
            let does = |what: &str, rest: &str| ask(&format!("param {what}"), &wire.config, rest);
            does("set", &format!("{name} C0039/2 {raw}")).expect(0);
            let read = does("get", &format!("{name} C0039/2 --json"));
            assert_eq!(read.expect(0).json()["raw"], raw, "{read:?}");
            // As warm as the simulated drive is unless its configuration says otherwise.
            let read = does("get", &format!("{name} C0061"));
            assert!(read.expect(0).out.contains("430000 (0x68FB0) = 43.0000 °C"), "{read:?}");
            assert!(does("list", name).expect(0).out.contains("C0039/2"));
            does("set", &format!("{name} C0061 1")).refused(&[name, "the drive only reports this"]);
            does("get", &format!("{name} 12.5")).refused(&[name, "not an address of this drive"]);
        }
    };
    works(150_000);
    let mut master = master(&wire.config, &[]);
    master.await_text("all drives online: 2");
    works(200_000);
    master.signal(SIGTERM);
    master.end().expect(0);
}

#[test]
fn stations_are_listed_by_a_scan_that_leaves_them_as_they_are() {
    let wire = Wire::new(204);
    let sim = simulation(&wire.config);
    // Nobody has parametrised them, and the scan has not either.
    for _ in 0..2 {
        let found = wire.scan(&["--json"]).end().expect(0).json();
        assert_eq!((&found["device"], &found["rate"]), (&wire.device.as_str().into(), &1_500_000.into()));
        let stations = found["stations"].as_array().unwrap();
        let addresses: Vec<&Value> = stations.iter().map(|station| &station["address"]).collect();
        assert_eq!(addresses, [3, 4], "{found}");
        for station in stations {
            let read = (&station["ident"], &station["master"], &station["watchdog"]);
            assert_eq!(read, (&0x82.into(), &Value::Null, &false.into()), "{station}");
            let status = station["status"].as_array().unwrap();
            assert!(status.contains(&"parametrisation requested".into()), "{station}");
        }
    }
    let table = wire.scan(&[]).end();
    let rows: Vec<Vec<&str>> =
        table.expect(0).out.lines().map(|row| row.split_whitespace().collect()).collect();
    assert_eq!(rows[0], ["address", "ident", "master", "watchdog", "state"]);
    assert_eq!((rows.len(), &rows[1][..4]), (3, &["3", "0x0082", "-", "off"][..]));

    let scan = wire.scan(&[]);
    scan.await_handler(SIGINT);
    scan.signal(SIGINT);
    scan.end().failed(&["interrupted"]);

    // Next to a master of this host.
    let mut master = master(&wire.config, &[]);
    master.await_text("all drives online: 2");
    wire.scan(&[]).end().refused(&[&wire.device, "is in use by another master"]);
    master.signal(SIGTERM);
    master.end().expect(0);
    sim.signal(SIGTERM);
    sim.end().expect(0);
    wire.scan(&[]).end().refused(&["nobody simulates the wire", "start `fieldbeat sim`"]);
}

#[test]
fn a_scan_sends_nothing_while_another_master_uses_the_wire() {
    let wire = Wire::with(205, "simulate = { second_master = 1, second_master_every = \"100ms\" }", "");
    let _sim = simulation(&wire.config);
    wire.scan(&[]).end().failed(&[&wire.device, "another master, address 1,", "end that one first"]);
}

#[test]
fn a_port_that_is_missing_or_none_is_named_with_the_remedy() {
    run(["profibus", "scan", "/dev/no-such-port"])
        .refused(&["there is no serial port /dev/no-such-port", "ls -l /dev/serial/by-id"]);
    run(["profibus", "scan", "/dev/null"]).refused(&["/dev/null is no serial port"]);
    run(["profibus", "scan", "/dev/ttyS1", "--rate", "115200"]).refused(&["9600", "12000000 bit/s"]);
    let wire = Wire::new(206);
    let text = std::fs::read_to_string(&wire.config).unwrap().replace(&wire.device, "/dev/no-such-port");
    let missing = wire.machine.write("missing.toml", text);
    let mut master = master(&missing, &["--for", "2s"]);
    let why = "there is no serial port /dev/no-such-port: plug in its adapter, or look at the path (ls -l \
               /dev/serial/by-id)";
    master.await_text(&format!("drive infeed: not connected: {why}"));
    let ended = master.end();
    ended.expect(1);
    // Once for both, and with no other advice.
    let last = ended.err_but_host().lines().last().unwrap();
    assert_eq!(last, format!("fieldbeat: never answered: infeed, outfeed ({why})"));
}

#[test]
fn an_ordinary_user_is_told_which_right_is_missing() {
    let machine = Machine::new(207);
    // A port that nobody but root may open.
    let master = File::options().read(true).write(true).open("/dev/ptmx").unwrap();
    let mut number: libc::c_uint = 0;
    // SAFETY: the kernel writes one number.
    assert_eq!(unsafe { libc::ioctl(master.as_raw_fd(), libc::TIOCGPTN, &raw mut number) }, 0);
    let port = format!("/dev/pts/{number}");
    std::fs::set_permissions(&port, PermissionsExt::from_mode(0o000)).unwrap();
    let ended = Program::spawn(as_ordinary_user(&machine).args(["profibus", "scan", &port])).end();
    ended.refused(&[&format!("no right to use {port}"), "dialout"]);
}

#[test]
fn a_controller_that_is_told_to_end_while_motors_turn_ramps_them_down() {
    if let Some(config) = role() {
        return play(&config);
    }
    let wire = Wire::new(208);
    let _sim = simulation(&wire.config);
    let mut child = again(CONTROLLER, &wire.config.display().to_string());
    let mut controller = Program::spawn(&mut child);
    controller.await_text(UNDER_WAY);
    controller.signal(SIGINT);
    let summary = controller::summary(&controller.end());
    for name in ["infeed", "outfeed"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["stopped"], &drive["link"]), (&"shutdown".into(), &"online".into()), "{drive}");
        assert_ne!(drive["state"], "OperationEnabled", "{drive}");
    }
}

/// The controller itself, in its own process.
fn play(config: &str) {
    let ended = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGINT, Arc::clone(&ended)).unwrap();
    let master = Master::from_file(config).unwrap().start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axes = ["infeed", "outfeed"].map(|name| master.axis(name).unwrap());
    for axis in &mut axes {
        axis.enable().unwrap();
        axis.jog(8.0).unwrap();
    }
    assert!(until(LONG, || axes.iter().all(|axis| axis.feedback().status.velocity > 6.0)));
    println!("{UNDER_WAY}");
    while !ended.load(Ordering::Relaxed) {
        sleep(5 * MS);
    }
    println!("{}", serde_json::to_string(&Summary::from(&master.finish())).unwrap());
}

#[test]
fn drives_that_are_killed_while_they_turn_are_lost_and_come_back_off() {
    let wire = Wire::new(209);
    let sim = simulation(&wire.config);
    let master = Master::from_file(&wire.config).unwrap().start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axes = ["infeed", "outfeed"].map(|name| master.axis(name).unwrap());
    for axis in &mut axes {
        axis.enable().unwrap();
        axis.jog(8.0).unwrap();
    }
    assert!(until(LONG, || axes.iter().all(|axis| axis.feedback().status.velocity > 6.0)));
    sim.kill();
    let stopped = |link| {
        move |axis: &fieldbeat::axis::Axis| {
            let feedback = axis.feedback();
            (feedback.link, feedback.stopped) == (link, Some(StopCause::LinkLost))
        }
    };
    assert!(until(LONG, || axes.iter().all(stopped(Link::Lost))));
    let _sim = simulation(&wire.config);
    assert!(until(LONG, || axes.iter().all(stopped(Link::Online))));
    for axis in &mut axes {
        assert!(!axis.feedback().status.state.is_powered());
        axis.enable().unwrap_err();
        axis.reset().unwrap();
        axis.enable().unwrap();
    }
    drop(master);
}

#[test]
fn a_lenze_that_stays_enabled_whatever_is_requested_is_named_at_the_end() {
    let wire = Wire::with(
        227,
        "",
        "stop = { deceleration = 50, standstill_for = 5, timeout = \"2s\" }\n\
                                    simulate = { running = 2.0, ignores_stops = true }",
    );
    let _sim = simulation(&wire.config);
    let ended = end_once_online(master(&wire.config, &["--json"]));
    assert_left(
        &ended,
        &["drive outfeed is still powered at the end (OperationEnabled)", "power off were requested"],
    );
    let summary = ended.json();
    let left = |name| drive(&summary, name)["at_end"].clone();
    assert_eq!(left("outfeed")["condition"], "powered", "{summary}");
    assert_eq!(left("infeed"), serde_json::json!({ "condition": "off", "requested": [] }));
}
