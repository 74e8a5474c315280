//! `fieldbeat linmot`: curves, command table, error log and software of a LinMot drive, through files and on real
//! sockets.

use std::fs;
use std::path::{Path, PathBuf};

use fieldbeat::Master;
use fieldbeat::config::linmot::curve as curve_file;
use fieldbeat::config::linmot::table as table_file;
use libc::{SIGCONT, SIGINT, SIGSTOP, SIGTERM};

use super::support::onlooker::Onlooker;
use super::support::{
    Ended, LONG, Machine, Program, as_ordinary_user, assert_sums, checkout, drive, plan, until,
};
use super::{ask, asking, assert_silent, master, serve, simulation, socket};

const CURVE: &str = "rt-config/linmot-curve.csv";
const TABLE: &str = "rt-config/linmot-table.toml";

fn sample(file: &str) -> String {
    checkout(file).display().to_string()
}

/// A curve with so many setpoints, each with a value of its own.
fn curve(machine: &Machine, file: &str, id: u16, setpoints: u32) -> PathBuf {
    let mut text =
        format!("# id = {id}\n# kind = \"time\"\n# length = {}\ntime_ms,position_mm\n", setpoints - 1);
    (0..setpoints).for_each(|row| text += &format!("{row},{}\n", row % 100));
    machine.write(file, text)
}

fn put(config: &Path, file: &Path, options: &str) -> Ended {
    ask("linmot curve put", config, &format!("d0 {} {options}", file.display()))
}

fn curves(config: &Path, drive: &str) -> Ended {
    ask("linmot curve list", config, &format!("{drive} --json"))
}

/// A drive that takes 10 ms for each command, so that a curve of some hundred setpoints takes its time.
fn slow(machine: &Machine, drives: usize) -> PathBuf {
    machine.config("slow.toml", drives, "", "simulate = { config_time = \"10ms\" }")
}

/// Puts a long curve, and returns once the transfer is under way.
fn under_way(machine: &Machine, config: &Path, drive: &str) -> Program {
    let long = curve(machine, "long.csv", 9, 3_000);
    let mut putting = asking("linmot curve put", config, &format!("{drive} {}", long.display()));
    // It tells every few seconds how far it is.
    putting.await_text("fieldbeat: write ");
    putting
}

#[test]
fn what_goes_to_the_drive_comes_back_byte_for_byte() {
    let machine = Machine::new(90);
    let config = machine.plain(1);
    let _sim = simulation(&config);
    for (what, file, own, reported) in [
        ("curve", CURVE, curve_file::load(checkout(CURVE)).unwrap().id.to_string(), "curve 1, 21 setpoints"),
        ("table", TABLE, String::new(), " entries"),
    ] {
        let (first, second) = (machine.path(&format!("{what}-1")), machine.path(&format!("{what}-2")));
        let does = |command: &str, rest: &str| {
            ask(&format!("linmot {what} {command}"), &config, &format!("d0 {rest}"))
        };
        does("list", "").expect(0);
        let said = does("put", &sample(file));
        assert!(
            said.expect(0).out.contains(reported) && said.out.contains("read back and compared"),
            "{said:?}"
        );
        assert!(does("list", "").expect(0).out.starts_with(&own));
        assert!(does("get", &first.display().to_string()).expect(0).out.contains(reported));
        // As this program writes it, which is what it reads.
        let text = fs::read_to_string(&first).unwrap();
        let written = match what {
            "curve" => {
                let curve = curve_file::load(checkout(file)).unwrap();
                curve_file::to_text(&curve).unwrap()
            }
            _ => table_file::to_text(&table_file::load(checkout(file)).unwrap()),
        };
        assert_eq!(text, written);
        // There is a file now: it is kept, unless it is said otherwise.
        does("get", &first.display().to_string()).refused(&["exists", "--force"]);
        fs::write(&first, "mine").unwrap();
        does("get", &first.display().to_string()).refused(&["exists", "--force"]);
        assert_eq!(fs::read_to_string(&first).unwrap(), "mine");
        does("get", &format!("{} --force", first.display())).expect(0);
        // And around again.
        does("delete", "").expect(0);
        assert!(does("list", "").expect(0).out.starts_with("no "));
        does("put", &first.display().to_string()).expect(0);
        does("get", &second.display().to_string()).expect(0);
        assert_eq!(fs::read(&first).unwrap(), fs::read(&second).unwrap());
        let nowhere = machine.write("way", "").join("file");
        does("get", &nowhere.display().to_string()).failed(&[
            "cannot write",
            "way/file",
            "name another place",
        ]);
    }
}

#[test]
fn of_several_curves_one_is_named() {
    let machine = Machine::new(91);
    let config = machine.plain(1);
    let _sim = serve(&config);
    let get = |options: &str| {
        ask("linmot curve get", &config, &format!("d0 {} {options}", machine.path("out.csv").display()))
    };
    get("").failed(&["drive d0 has no curve"]);
    let files =
        [(3, 10), (7, 20), (7, 30)].map(|(id, size)| curve(&machine, &format!("{id}-{size}.csv"), id, size));
    put(&config, &files[0], "").expect(0);
    put(&config, &files[1], "").expect(0);
    assert_eq!(curves(&config, "d0").json(), serde_json::json!([3, 7]));
    get("").refused(&["drive d0 has curves 3, 7", "--id"]);
    get("--id 8").failed(&["drive d0 has no curve 8"]);
    assert!(!machine.path("out.csv").exists());
    // Another size: it says what that means, and the other curve is still there.
    let said = put(&config, &files[2], "");
    assert!(said.expect(0).err.contains("can only delete all curves at once"), "{said:?}");
    assert_eq!(curves(&config, "d0").json(), serde_json::json!([3, 7]));
    for (id, file) in [(3, &files[0]), (7, &files[2])] {
        get(&format!("--id {id} --force")).expect(0);
        assert_eq!(fs::read_to_string(machine.path("out.csv")).unwrap(), fs::read_to_string(file).unwrap());
    }
}

#[test]
fn a_wrong_file_is_told_before_anything_is_sent() {
    let machine = Machine::new(92);
    let config = machine.plain(1);
    let drive = socket(machine.drive(0));
    let curve = fs::read_to_string(checkout(CURVE)).unwrap();
    let table = fs::read_to_string(checkout(TABLE)).unwrap();
    for (what, name, text, parts) in [
        ("curve", "hole.csv", curve.replace("\n100,20\n", "\n"), ["hole.csv:14", "a row is missing"]),
        ("curve", "unit.csv", curve.replace("position_mm", "position_um"), ["unit.csv:8", "position_mm"]),
        ("curve", "text.csv", curve.replace("20,0.9789", "20,much"), ["text.csv:10", "much"]),
        ("curve", "empty.csv", String::new(), ["empty.csv", "has no rows"]),
        ("curve", "kind.csv", curve.replace("\"time\"", "\"tiem\""), ["kind.csv:5", "\"cam\""]),
        (
            "table",
            "link.toml",
            table.replace("next = 3", "next = 99"),
            ["link.toml", "leads to entry 99, which does not exist"],
        ),
        (
            "table",
            "word.toml",
            table.replace("vai-go-to", "vai-goto"),
            ["word.toml", "did you mean \"vai-go-to\"?"],
        ),
        ("table", "key.toml", table.replace("velocity = 800", "speed = 800"), ["key.toml", "speed"]),
        (
            "table",
            "range.toml",
            table.replace("position = 120", "position = 1e9"),
            ["range.toml", "position"],
        ),
        ("table", "toml.toml", "[[entry]\n".to_owned(), ["toml.toml:1", ""]),
    ] {
        let file = machine.write(name, &text);
        let ended = ask(&format!("linmot {what} put"), &config, &format!("d0 {}", file.display()));
        ended.expect(1);
        assert_eq!(ended.out, "");
        for part in parts {
            assert!(ended.err.contains(part), "{name}: no \"{part}\": {}", ended.err);
        }
        assert!(ended.err.lines().all(|line| line.starts_with("fieldbeat: ")), "{}", ended.err);
    }
    let none = machine.path("none.csv").display().to_string();
    for what in ["curve", "table"] {
        ask(&format!("linmot {what} put"), &config, &format!("d0 {none}"))
            .refused(&[&none, "for example rt-config/linmot-"]);
        ask(&format!("linmot {what} get"), &config, &format!("d0 {}", config.display()))
            .refused(&["exists", "--force"]);
    }
    ask("linmot defaults", &config, "d0 everything").refused(&["os, mc, interface or application"]);
    ask("linmot restart", &config, "d7").refused(&["has no drive d7"]);
    assert_silent(&drive);
}

#[test]
fn an_interrupted_transfer_leaves_what_was_there() {
    let machine = Machine::new(93);
    let config = slow(&machine, 1);
    let _sim = simulation(&config);
    put(&config, &curve(&machine, "before.csv", 4, 5), "").expect(0);
    let putting = under_way(&machine, &config, "d0");
    putting.signal(SIGINT);
    let ended = putting.end();
    assert_eq!(
        (ended.expect(1).out.as_str(), ended.err.matches("was interrupted").count()),
        ("", 1),
        "{ended:?}"
    );
    let last = ended.err.lines().last().unwrap();
    assert!(last.ends_with("writing curve 9 was interrupted; the drive has what it had before"), "{last}");
    assert_eq!(curves(&config, "d0").json(), serde_json::json!([4]));
}

#[test]
fn of_two_transfers_on_one_drive_one_is_refused_and_a_dead_client_holds_nothing() {
    let machine = Machine::new(94);
    let config = slow(&machine, 2);
    let _sim = simulation(&config);
    let mut master = master(&config, &["--json"]);
    master.await_text("all drives online");
    let first = under_way(&machine, &config, "d0");
    let claimed = ["drive d0: another list or transfer is under way on this drive: wait for its end"];
    put(&config, &curve(&machine, "second.csv", 4, 5), "").failed(&claimed);
    ask("param list", &config, "d0").failed(&claimed);
    ask("linmot errors", &config, "d0").failed(&claimed);
    // The other drive has its own, and a parameter finds its way in between.
    let second = asking("linmot curve put", &config, &format!("d1 {}", machine.path("second.csv").display()));
    ask("param get", &config, "d0 0x20A8").expect(0);
    second.end().expect(0);
    // It can tell nobody that it has gone.
    first.kill();
    assert!(until(LONG, || put(&config, &machine.path("second.csv"), "").code == Some(0)));
    assert_eq!(curves(&config, "d0").json(), serde_json::json!([4]));
    master.signal(SIGTERM);
    let ended = master.end();
    let summary = ended.expect(0).json();
    assert_sums(&summary);
    assert!(["d0", "d1"].iter().all(|name| drive(&summary, name)["losses"] == 0), "{summary}");
}

#[test]
fn a_master_that_ends_in_the_middle_of_a_transfer_waits_for_nobody() {
    let machine = Machine::new(95);
    let config = slow(&machine, 1);
    let _sim = simulation(&config);
    let mut master = master(&config, &["--json"]);
    master.await_text("all drives online");
    let putting = under_way(&machine, &config, "d0");
    // It does not even listen any more.
    putting.signal(SIGSTOP);
    master.signal(SIGTERM);
    let ended = master.end();
    assert_sums(&ended.expect(0).json());
    putting.signal(SIGCONT);
    let ended = putting.end();
    let last = ended.expect(1).err.lines().last().unwrap();
    assert!(last.contains("drive d0: ") && last.contains("the master has ended"), "{last}");
    // What stands in the drive's RAM is half of it, and it says how to be rid of that.
    assert!(last.contains("could not be restored") && last.contains("restart the drive"), "{last}");
    assert_eq!(ended.out, "");
}

#[test]
fn what_is_saved_is_there_after_a_restart_though_the_drive_was_silent_meanwhile() {
    // Alone, with a link that is lost on the way; and beside a master that is patient.
    for (number, bucket, beside) in [(96, "700ms", false), (97, "10s", true)] {
        let machine = Machine::new(number);
        let defaults = format!(
            "health = {{ bucket = \"{bucket}\", leak = 1 }}\nsimulate = {{ flash = \"silent\", flash_time = \"2s\" }}"
        );
        let config = machine.config("m.toml", 1, "", &defaults);
        let _sim = simulation(&config);
        let mut master = beside.then(|| master(&config, &["--json"]));
        if let Some(master) = &mut master {
            master.await_text("all drives online");
        }
        let said = put(&config, &checkout(CURVE), "--save");
        assert!(said.expect(0).out.ends_with("drive d0: its curves are in flash; home it\n"), "{said:?}");
        assert!(said.err.contains("leave its power on"), "{said:?}");
        // This one is in RAM only.
        put(&config, &curve(&machine, "ram.csv", 4, 5), "").expect(0);
        ask("linmot table put", &config, &format!("d0 {} --save", sample(TABLE))).expect(0);
        assert_eq!(curves(&config, "d0").json(), serde_json::json!([1, 4]));
        ask("linmot restart", &config, "d0").expect(0);
        let back = || curves(&config, "d0").out == "[1]\n";
        assert!(until(LONG, back), "{:?}", curves(&config, "d0"));
        assert_ne!(ask("linmot table list", &config, "d0 --json").json(), serde_json::json!([]));
        if let Some(master) = master {
            master.signal(SIGTERM);
            let summary = master.end().expect(0).json();
            assert_sums(&summary);
            assert_eq!(drive(&summary, "d0")["losses"], 0);
        }
    }
}

#[test]
fn whoever_dies_while_the_software_is_stopped_leaves_it_running() {
    let machine = Machine::new(118);
    let config = machine.config("m.toml", 1, "", "simulate = { flash = \"busy\", flash_time = \"2s\" }");
    let _sim = simulation(&config);
    let mut master = master(&config, &["--json"]);
    master.await_text("all drives online");
    let state = || {
        let status = ask("status", &config, "--json").json();
        drive(&status["summary"], "d0")["state"].as_str().unwrap().to_owned()
    };
    let saving = asking("linmot curve save", &config, "d0");
    assert!(until(LONG, || state() == "NotReadyToSwitchOn"));
    // It can tell nobody.
    saving.kill();
    assert!(until(LONG, || state() == "SwitchOnDisabled"), "{}", state());
    master.signal(SIGTERM);
    assert_sums(&master.end().expect(0).json());
}

#[test]
fn what_a_drive_that_is_switched_on_may_be_using_is_not_changed() {
    let machine = Machine::new(98);
    let config = machine.config("m.toml", 1, "", "simulate = { running = true }");
    let _sim = serve(&config);
    let off = |what: &str| format!("drive d0: {what} needs a drive that is switched off: disable it first");
    for (what, file, doing) in
        [("curve", sample(CURVE), "writing a curve"), ("table", sample(TABLE), "writing its command table")]
    {
        let does =
            |options: &str| ask(&format!("linmot {what} put"), &config, &format!("d0 {file} {options}"));
        does("").failed(&[&off(doing)]);
        does("--save").failed(&[&off(doing)]);
        let delete = |options: &str| ask(&format!("linmot {what} delete"), &config, &format!("d0 {options}"));
        let doing = if what == "curve" { "deleting its curves" } else { "deleting its command table" };
        delete("").failed(&[&off(doing)]);
    }
    ask("linmot restart", &config, "d0").failed(&[&off("a restart")]);
    ask("linmot software stop", &config, "d0").failed(&[&off("stopping its software")]);
    ask("linmot curve save", &config, "d0").failed(&[&off("saving to flash")]);
    // Looking is free.
    ask("param get", &config, "d0 status-word").expect(0);
}

#[test]
fn the_error_log_tells_what_has_happened_to_the_drive() {
    let machine = Machine::new(99);
    // It meets its mechanical end far inside of its limits.
    let config = machine.config("m.toml", 1, "", "simulate = { range = [0, 60], home = 0, start = 10 }");
    let _sim = serve(&config);
    assert_eq!(ask("linmot errors", &config, "d0").expect(0).out, "0 errors occurred, 0 are logged\n");
    let master = Master::from_plan(plan(&config)).start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axis = master.axis("d0").unwrap();
    axis.enable().unwrap();
    axis.home().unwrap();
    axis.move_to(300.0, axis.profile()).unwrap_err();
    let fault = axis.feedback().status.fault;
    drop((axis, master));
    let log = ask("linmot errors", &config, "d0 --json").json();
    assert_eq!((&log["occurred"], &log["logged"]), (&1.into(), &1.into()), "{log}");
    let [entry] = &log["entries"].as_array().unwrap()[..] else { panic!("{log}") };
    assert_eq!((entry["code"].as_u64(), &entry["hours"]), (Some(fault.into()), &0.into()));
    assert!(entry["ms"].as_u64() > Some(0) && !entry["text"].as_str().unwrap().is_empty(), "{log}");
    let text = ask("linmot errors", &config, "d0").expect(0).out.clone();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!((lines.len(), lines[0]), (2, "1 errors occurred, 1 are logged"));
    assert!(lines[1].contains(&format!("{fault:04X}h  {}", entry["text"].as_str().unwrap())), "{text}");
}

#[test]
fn its_software_stops_and_starts_and_parameters_go_back_to_their_defaults() {
    let machine = Machine::new(100);
    let config = machine.plain(1);
    let _sim = simulation(&config);
    let does = |what: &str, rest: &str| {
        ask(&format!("linmot {what}"), &config, &format!("d0{rest}")).expect(0).out.clone()
    };
    let get =
        |address: &str| ask("param get", &config, &format!("d0 {address} --json")).json()["value"].clone();
    assert_eq!(does("software stop", ""), "drive d0: its software is stopped\n");
    assert_eq!(does("software start", ""), "drive d0: its software runs; home it\n");
    let before = get("predefined-velocity");
    ask("param set", &config, "d0 predefined-velocity.both 7").expect(0);
    ask("param set", &config, "d0 0x3100.both 8").expect(0);
    assert_eq!(does("defaults", " mc"), "drive d0: the defaults take effect after a restart; home it\n");
    assert_eq!((get("predefined-velocity.rom"), get("0x3100.rom")), (before.clone(), 8.into()));
    assert_eq!(get("predefined-velocity"), 7);
    does("restart", "");
    assert_eq!((get("predefined-velocity"), get("0x3100")), (before, 8.into()));
}

const GO: &str = "acceleration=1000 deceleration=1000";

#[test]
fn a_motion_command_has_run_when_it_says_so_however_slow_the_cycle() {
    let machine = Machine::new(104);
    let config = machine.config("wide.toml", 1, "period = \"100ms\"", "");
    let _sim = serve(&config);
    let command = |what: &str| ask("linmot command", &config, &format!("d0 {what}"));
    let there = command(&format!("vai-go-to position=20 velocity=200 {GO} --home"));
    assert_eq!(there.expect(0).out, "drive d0: 20.0000 mm\n");
    // One that moves nothing ends, too.
    command("no-operation").expect(0);
}

#[test]
fn an_interrupted_motion_is_no_success() {
    let machine = Machine::new(105);
    let config = machine.plain(1);
    let _sim = serve(&config);
    ask("linmot command", &config, "d0 no-operation --home").expect(0);
    let moving = asking("linmot command", &config, &format!("d0 vai-go-to position=399 velocity=5 {GO}"));
    let onlooker = Onlooker::new(&machine);
    onlooker.await_sight(machine.drive(0), |sight| sight.operating && sight.moving);
    moving.signal(SIGINT);
    let ended = moving.end();
    assert_eq!(ended.expect(1).out, "", "{ended:?}");
    let last = ended.err.lines().last().unwrap();
    assert_eq!(last, "fieldbeat: drive d0: interrupted; ramped down and switched off");
    assert!(!onlooker.look(machine.drive(0)).powered);
}

#[test]
fn a_motor_is_moved_with_the_rights_that_its_file_requires_or_not_at_all() {
    let machine = Machine::new(107);
    let config = machine.config("strict.toml", 1, "realtime = \"require\"", "");
    let drive = socket(machine.drive(0));
    let mut command = as_ordinary_user(&machine);
    let ended = Program::spawn(command.args(["linmot", "command"]).arg(&config).args(["d0", "no-operation"]));
    ended.end().refused(&["no right for SCHED_FIFO 80", "or set realtime = \"prefer\""]);
    assert_silent(&drive);
}
