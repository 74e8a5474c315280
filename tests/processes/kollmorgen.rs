//! Kollmorgens as a user meets them: `check`, `run`, `param` and `scan`, against a simulated segment in a process of
//! its own.

use std::cell::Cell;
use std::path::{Path, PathBuf};

use fieldbeat::time::MS;
use libc::SIGTERM;

use super::support::{
    LONG, Machine, Program, as_ordinary_user, assert_sums, carried, checkout, drive, period, run, until,
};
use super::{ask, await_online, await_status, master, metrics, simulation};

/// The name of a segment that no other test has.
fn line(test: u8) -> String {
    format!("local:processes-{}-{test}", std::process::id())
}

/// So many cycles, of a millisecond at least, after which a refused slave was tried again.
const TRIED_AGAIN: u64 = 2_500;

/// Until a master has executed so many cycles more.
fn await_cycles(config: &Path, more: u64) {
    let executed = |summary: &serde_json::Value| summary["cycle"]["executed"].as_u64().unwrap_or_default();
    let begun = Cell::new(None);
    await_status(config, |summary| {
        let from = begun.get().unwrap_or(executed(summary));
        begun.set(Some(from));
        executed(summary) >= from + more
    });
}

/// A segment of a drive for velocities and one for positions, patient with a busy computer.
fn text(interface: &str) -> String {
    format!(
        "[cycle]\nperiod = \"{}\"\nreceive_deadline = 0.8\n\
             max_skip = \"30s\"\nmax_skip_rate = 1.0\nrealtime = \"off\"\nreference = \
        \"ethercat\"\n\
         [[bus]]\nprotocol = \"ethercat\"\ninterface = \"{interface}\"\nsimulate = {{ drift_ppm = [30] }}\n\
         [bus.defaults]\nhealth = {{ bucket = \"5s\", leak = 1 }}\nwatchdog = \"6s\"\n\
         [[bus.drive]]\nname = \"turns\"\n\
         [[bus.drive]]\nname = \"moves\"\npdo.outputs = \"0x1701\"\n",
        period()
    )
}

fn machine(test: u8) -> (Machine, PathBuf) {
    let machine = Machine::new(test);
    let config = machine.write("line.toml", text(&line(test)));
    (machine, config)
}

#[test]
fn check_says_what_the_line_is_and_what_becomes_of_it_if_the_master_dies() {
    let ended = run(["check".into(), checkout("rt-config/kollmorgen.toml")]);
    ended.expect(0);
    assert_eq!(ended.err, "");
    for part in [
        "if the master dies: the drive stops by itself within 20 ms",
        "takes velocities, jogs and homing; no moves, no streams",
        "its clock leads: the grid follows it",
        "not a safety function",
    ] {
        assert!(ended.out.contains(part), "no {part}: {}", ended.out);
    }
}

#[test]
fn a_line_comes_up_whoever_is_there_first_and_the_run_says_how_the_grid_follows_its_clock() {
    let (_machine, config) = machine(170);
    let mut master = master(&config, &["--json"]);
    let nobody =
        format!("drive turns: not connected: nothing serves {}: start it: fieldbeat sim CONFIG", line(170));
    master.await_text(&nobody);
    let sim = simulation(&config);
    master.await_text("all drives online: 2");
    master.signal(SIGTERM);
    let ended = master.end();
    let summary = ended.expect(0).json();
    assert_sums(&summary);
    for name in ["turns", "moves"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["protocol"], &drive["losses"]), (&"ethercat".into(), &0.into()), "{drive}");
        assert_eq!(drive["protocol_counters"]["brought_up"], 1, "{drive}");
    }
    let reference = &summary["cycle"]["reference"];
    assert_eq!(reference["bus"], "ethercat");
    assert!(reference["samples"].as_u64() > Some(0), "{reference}");
    sim.signal(SIGTERM);
    sim.end().expect(0);
}

#[test]
fn a_simulation_that_is_killed_is_a_line_that_is_lost_and_it_comes_back() {
    let (machine, _) = machine(171);
    let config = machine.write("line.toml", text(&line(171)).replace("bucket = \"5s\"", "bucket = \"1s\""));
    let sim = simulation(&config);
    let mut master = master(&config, &["--json"]);
    master.await_text("all drives online: 2");
    sim.kill();
    for name in ["turns", "moves"] {
        master.await_text(&format!("drive {name}: lost"));
    }
    let _sim = simulation(&config);
    for name in ["turns", "moves"] {
        master.await_text(&format!("drive {name}: back online"));
    }
    master.signal(SIGTERM);
    let ended = master.end();
    let summary = ended.expect(1).json();
    assert_sums(&summary);
    for name in ["turns", "moves"] {
        let drive = drive(&summary, name);
        assert_eq!(drive["stopped"], "link lost", "{drive}");
        assert!(drive["protocol_counters"]["brought_up"].as_u64() >= Some(2), "{drive}");
    }
}

#[test]
fn objects_are_read_written_and_refused_alone_and_next_to_a_master() {
    let (_machine, config) = machine(172);
    let _sim = simulation(&config);
    let works = || {
        let does = |what: &str, rest: &str| ask(&format!("param {what}"), &config, rest);
        // One after the other, each by a master of its own: none of them leaves the segment spoiled for the next.
        let word = does("get", "turns 0x6041:0").expect(0).out.clone();
        assert!(word.starts_with("turns 0x6041:0: "), "{word}");
        let word = does("get", "moves status-word --json").expect(0).json();
        assert!(word["raw"].as_u64().is_some_and(|raw| raw > 0), "{word}");
        assert_eq!(does("get", "turns device-name").expect(0).out, "turns device-name: S700\n");
        does("set", "moves 0x6081:0 1000").expect(0);
        let said = does("get", "moves profile-velocity --json").expect(0).json();
        assert_eq!(said["raw"], 1000, "{said}");
        does("get", "turns 0x7777:0.u16")
            .failed(&["drive turns: read 0x7777:0", "0x06020000 no such object"]);
    };
    works();
    let running = master(&config, &["--json"]);
    await_online(&config);
    works();
    running.signal(SIGTERM);
    assert_sums(&running.end().expect(0).json());
}

#[test]
fn what_is_no_object_is_refused_before_anything_is_sent() {
    let (_machine, config) = machine(173);
    let says = |what: &str, rest: &str| ask(&format!("param {what}"), &config, rest);
    says("get", "turns banana").refused(&["read banana: not an address of this drive; write 0x6041:0"]);
    says("set", "turns 0x6041:0 3").refused(&["cannot be written"]);
    says("get", "nobody 0x6041:0").refused(&["has no drive nobody; it has turns, moves"]);
    let listed = says("list", "turns").expect(0).out.clone();
    assert!(listed.contains("0x6041:0") && listed.contains("status-word"), "{listed}");
}

#[test]
fn another_slave_than_configured_is_named_with_its_place() {
    let (machine, config) = machine(174);
    let _sim = simulation(&config);
    let other = text(&line(174)).replace("name = \"moves\"", "name = \"moves\"\nproduct = 0x3000700");
    let other = machine.write("other.toml", other);
    let mut refused = master(&other, &["--json"]);
    let why = "place 1: its product is 0x03000600: correct product, or the order of the segment";
    refused.await_text(&format!("drive moves: not connected: {why}"));
    await_status(&other, |summary| drive(summary, "turns")["not_connected"].is_null());
    await_cycles(&other, TRIED_AGAIN);
    refused.signal(SIGTERM);
    let ended = refused.end();
    assert_eq!(
        ended.err.matches("drive moves: not connected: place 1: its product").count(),
        1,
        "{}",
        ended.err
    );
    let summary = ended.json();
    // It is tried again and again, and that it was refused once stays its reason.
    assert_eq!(drive(&summary, "moves")["not_connected"], why);
    assert_eq!(drive(&summary, "turns")["not_connected"], serde_json::Value::Null, "its neighbour is there");
    ask("param get", &other, "moves 0x6041:0").failed(&["drive moves cannot be reached: place 1: "]);
    let beyond = text(&line(174)).replace("name = \"moves\"", "name = \"moves\"\nposition = 4");
    let beyond = machine.write("beyond.toml", beyond);
    // So many cycles that the bring-up comes to the missing slave.
    let length = format!("{}ms", 2_500 * carried() / MS);
    let ended = master(&beyond, &["--for", &length]).end();
    ended.expect(1);
    let last = ended.err.lines().last().unwrap();
    assert!(last.starts_with("fieldbeat: never answered: moves (place 4: nothing answers there"), "{last}");
}

#[test]
fn an_interface_that_is_none_is_reported_in_one_line() {
    let machine = Machine::new(175);
    let config = machine.write("none.toml", text("eth-none-77"));
    master(&config, &[]).end().refused(&["there is no network interface eth-none-77"]);
    ask("param get", &config, "turns 0x6041:0").refused(&["there is no network interface eth-none-77"]);
    ask("sim", &config, "").refused(&["name the interface at the other end of its cable"]);
    let wrong = machine.write("wrong.toml", text("local:no name"));
    ask("check", &wrong, "").refused(&["wrong.toml:10: bus.interface = \"local:no name\""]);
    let two = text(&line(175)).replace("reference = \"ethercat\"", "reference = \"line\"");
    let two = machine.write("two.toml", two);
    ask("check", &two, "").refused(&["cycle.reference", "ethercat"]);
}

#[test]
fn an_ordinary_user_learns_which_right_a_segment_needs() {
    let machine = Machine::new(176);
    let config = machine.write("lo.toml", text("lo"));
    let ended = Program::spawn(as_ordinary_user(&machine).arg("run").arg(&config)).end();
    ended.refused(&["cannot use interface lo", "CAP_NET_RAW", "cap_net_raw+ep on the program"]);
}

#[test]
fn a_device_that_is_refused_is_named_on_the_terminal_and_accessed_through_its_master_only() {
    let (machine, _) = machine(179);
    let io = "[[bus.device]]\nname = \"io\"\noutputs = { start = 0x1000, length = 1 }\n";
    let good = text(&line(179)) + io;
    let _sim = simulation(&machine.write("good.toml", &good));
    let config = machine.write("line.toml", good + "product = 0x99\n");
    let requested = || ask("param get", &config, "io 0x1018:1");
    let alone = requested();
    alone.expect(1);
    assert!(alone.err.contains("io is not a drive: only a running master can access it"), "{}", alone.err);

    let mut master = master(&config, &["--json"]);
    let refused = "place 2: its product is 0x";
    master.await_text(&format!("device io: not in operation: {refused}"));
    let beside = requested();
    beside.expect(1);
    assert!(beside.err.contains("read 0x1018:1: the slave has no mailbox"), "{}", beside.err);
    await_cycles(&config, TRIED_AGAIN);
    master.signal(SIGTERM);
    let ended = master.end();
    assert_eq!(
        ended.err.matches(&format!("device io: not in operation: {refused}")).count(),
        1,
        "{}",
        ended.err
    );
    let device = &ended.expect(0).json()["devices"][0];
    assert_eq!(device["name"], "io");
    assert!(device["not_operational"].as_str().is_some_and(|why| why.starts_with(refused)), "{device}");
}

#[test]
fn outputs_without_a_watchdog_are_named_once_by_their_name() {
    let (machine, _) = machine(185);
    let io = "[[bus.device]]\nname = \"io\"\noutputs = { start = 0x1000, length = 1 }\n\
              simulate.output_control = 0x24\n";
    let config = machine.write("line.toml", text(&line(185)) + io);
    let _sim = simulation(&config);
    let mut master = master(&config, &["--json", "--metrics", &format!("{}:0", machine.ip(1))]);
    let address = metrics::endpoint(&mut master);
    let what = "device io: place 2: its SII arms no watchdog";
    master.await_text(what);
    master.await_text("all drives online: 2");
    // The counters of a device are those of a drive.
    let of = |what: &str| {
        let sample = format!("fieldbeat_device_protocol_events_total{{device=\"io\",what=\"{what}\"}}");
        metrics::Page::parse(&metrics::scrape(address)).value(&sample)
    };
    assert!(until(LONG, || of("brought_up") >= 1.0));
    assert_eq!(of("mailbox_silent"), 0.0);
    master.signal(SIGTERM);
    let ended = master.end();
    let counted = &ended.expect(0).json()["devices"][0]["protocol_counters"];
    assert!(counted["brought_up"].as_u64() >= Some(1), "{counted}");
    assert_eq!(ended.err.matches(what).count(), 1, "{}", ended.err);
}
