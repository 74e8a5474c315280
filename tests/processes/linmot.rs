//! `fieldbeat linmot`: curves, command table and motion commands of a LinMot drive, through files and on real sockets.

use std::fs;
use std::path::{Path, PathBuf};

use fieldbeat::config::linmot::curve as curve_file;
use fieldbeat::config::linmot::table as table_file;
use libc::{SIGCONT, SIGINT, SIGSTOP};

use super::support::onlooker::Onlooker;
use super::support::{Ended, LONG, Machine, Program, checkout, drive, until};
use super::{ask, asking, assert_silent, finish, online, serve, simulation, socket, with_drives};

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

/// Puts a long curve, and returns once the transfer is under way.
fn under_way(machine: &Machine, config: &Path, drive: &str) -> Program {
    let long = curve(machine, "long.csv", 9, 3_000);
    let mut putting = asking("linmot curve put", config, &format!("{drive} {}", long.display()));
    // It reports its progress every few seconds.
    putting.await_text("fieldbeat: write ");
    putting
}

#[test]
fn curves_and_tables_are_read_back_byte_for_byte() {
    let (machine, config, _sim) = with_drives(90, 1);
    let (of_curve, of_table) =
        (curve_file::load(checkout(CURVE)).unwrap(), table_file::load(checkout(TABLE)).unwrap());
    // As this program writes it, which is what it reads.
    for (what, file, written, reported) in [
        ("curve", CURVE, curve_file::to_text(&of_curve).unwrap(), "curve 1, 21 setpoints"),
        ("table", TABLE, table_file::to_text(&of_table), " entries"),
    ] {
        let path = machine.path(what);
        let name = path.display().to_string();
        let does = |command: &str, rest: &str| {
            ask(&format!("linmot {what} {command}"), &config, &format!("d0 {rest}"))
        };
        does("list", "").expect(0);
        let said = does("put", &sample(file));
        assert!(
            said.expect(0).out.contains(reported) && said.out.contains("read back and compared"),
            "{said:?}"
        );
        assert!(!does("list", "").expect(0).out.starts_with("no "));
        assert!(does("get", &name).expect(0).out.contains(reported));
        assert_eq!(fs::read_to_string(&path).unwrap(), written);
        // There is a file now: it is kept, unless it is said otherwise.
        fs::write(&path, "mine").unwrap();
        does("get", &name).refused(&["exists", "--force"]);
        assert_eq!(fs::read_to_string(&path).unwrap(), "mine");
        does("get", &format!("{name} --force")).expect(0);
        assert_eq!(fs::read_to_string(&path).unwrap(), written);
        let nowhere = machine.write("way", "").join("file");
        let ended = does("get", &nowhere.display().to_string());
        // Before the drive is read, which takes long.
        ended.refused(&["cannot write", "way/file", "name another place"]);
        does("delete", "").expect(0);
        assert!(does("list", "").expect(0).out.starts_with("no "));
    }

    // Of several curves one is named.
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

/// Each kind of mistake in a file has its text in the tests of its reader.
#[test]
fn a_wrong_file_is_reported_before_anything_is_sent() {
    let machine = Machine::new(92);
    let config = machine.plain(1);
    let drive = socket(machine.drive(0));
    let curve = fs::read_to_string(checkout(CURVE)).unwrap();
    let table = fs::read_to_string(checkout(TABLE)).unwrap();
    for (what, name, text, parts) in [
        ("curve", "hole.csv", curve.replace("\n100,20\n", "\n"), ["hole.csv:14", "a row is missing"]),
        ("curve", "empty.csv", String::new(), ["empty.csv", "has no rows"]),
        ("table", "link.toml", table.replace("next = 3", "next = 99"), ["link.toml", "leads to entry 99"]),
        ("table", "toml.toml", "[[entry]\n".to_owned(), ["toml.toml:1", ""]),
    ] {
        let file = machine.write(name, &text);
        let ended = ask(&format!("linmot {what} put"), &config, &format!("d0 {}", file.display()));
        assert_eq!(ended.expect(1).out, "");
        assert!(parts.iter().all(|part| ended.err.contains(part)), "{name}: no {parts:?}: {}", ended.err);
        assert!(ended.err.lines().all(|line| line.starts_with("fieldbeat: ")), "{}", ended.err);
    }
    let none = machine.path("none.csv").display().to_string();
    for what in ["curve", "table"] {
        ask(&format!("linmot {what} put"), &config, &format!("d0 {none}"))
            .refused(&[&none, "for example rt-config/linmot-"]);
    }
    ask("linmot defaults", &config, "d0 everything").refused(&["os, mc, interface or application"]);
    ask("linmot restart", &config, "d7").refused(&["has no drive d7"]);
    assert_silent(&drive);
}

/// Interrupted, beside another one, from a client that is killed, and with a master that ends.
#[test]
fn a_transfer_that_is_broken_off_leaves_what_was_there_or_says_what_is_left() {
    let machine = Machine::new(93);
    // Each command takes 10 ms, so that a curve of some thousand setpoints takes its time.
    let config = machine.config("slow.toml", 2, "", "simulate = { config_time = \"10ms\" }");
    let _sim = simulation(&config);
    put(&config, &curve(&machine, "small.csv", 4, 5), "").expect(0);
    let small = machine.path("small.csv");
    let putting = under_way(&machine, &config, "d0");
    let ended = putting.end_by(SIGINT);
    assert_eq!(
        (ended.expect(1).out.as_str(), ended.err.matches("was interrupted").count()),
        ("", 1),
        "{ended:?}"
    );
    let last = ended.err.lines().last().unwrap();
    assert!(last.ends_with("writing curve 9 was interrupted; the drive has what it had before"), "{last}");
    assert_eq!(curves(&config, "d0").json(), serde_json::json!([4]));

    // Of two transfers on one drive one is refused.
    let master = online(&config, &["--json"]);
    let first = under_way(&machine, &config, "d0");
    let claimed = ["drive d0: another list or transfer is under way on this drive: wait for its end"];
    put(&config, &small, "").failed(&claimed);
    ask("param list", &config, "d0").failed(&claimed);
    ask("linmot errors", &config, "d0").failed(&claimed);
    // The other drive has its own, and a parameter finds its way in between.
    let second = asking("linmot curve put", &config, &format!("d1 {}", small.display()));
    ask("param get", &config, "d0 0x20A8").expect(0);
    second.end().expect(0);
    // It can tell nobody that it has gone.
    first.kill();
    assert!(until(LONG, || put(&config, &small, "").code == Some(0)));
    assert_eq!(curves(&config, "d0").json(), serde_json::json!([4]));

    // A client that does not even listen any more holds up no end of the master.
    let putting = under_way(&machine, &config, "d0");
    putting.signal(SIGSTOP);
    let summary = finish(master);
    assert!(["d0", "d1"].iter().all(|name| drive(&summary, name)["losses"] == 0), "{summary}");
    let ended = putting.end_by(SIGCONT);
    let last = ended.expect(1).err.lines().last().unwrap();
    assert!(last.contains("drive d0: ") && last.contains("the master has ended"), "{last}");
    // What stands in the drive's RAM is half of it, and it says how to be rid of that.
    assert!(last.contains("could not be restored") && last.contains("restart the drive"), "{last}");
    assert_eq!(ended.out, "");
}

#[test]
fn saved_curves_survive_a_restart_though_the_drive_was_silent_meanwhile() {
    let machine = Machine::new(96);
    // Its link is lost on the way.
    let defaults = "health = { bucket = \"700ms\", leak = 1 }\nsimulate = { flash = \"silent\", flash_time = \
                    \"2s\" }";
    let config = machine.config("m.toml", 1, "", defaults);
    let _sim = simulation(&config);
    let said = put(&config, &checkout(CURVE), "--save");
    assert!(said.expect(0).out.ends_with("drive d0: its curves are in flash; home it\n"), "{said:?}");
    assert!(said.err.contains("leave its power on"), "{said:?}");
    // This one is in RAM only.
    put(&config, &curve(&machine, "ram.csv", 4, 5), "").expect(0);
    assert_eq!(curves(&config, "d0").json(), serde_json::json!([1, 4]));
    ask("linmot restart", &config, "d0").expect(0);
    let back = || curves(&config, "d0").out == "[1]\n";
    assert!(until(LONG, back), "{:?}", curves(&config, "d0"));
}

#[test]
fn a_client_killed_while_the_software_is_stopped_leaves_it_running() {
    let machine = Machine::new(118);
    let config = machine.config("m.toml", 1, "", "simulate = { flash = \"busy\", flash_time = \"2s\" }");
    let _sim = simulation(&config);
    let master = online(&config, &["--json"]);
    let state = || {
        let status = ask("status", &config, "--json").json();
        drive(&status["summary"], "d0")["state"].as_str().unwrap().to_owned()
    };
    let saving = asking("linmot curve save", &config, "d0");
    assert!(until(LONG, || state() == "NotReadyToSwitchOn"));
    // It can tell nobody.
    saving.kill();
    assert!(until(LONG, || state() == "SwitchOnDisabled"), "{}", state());
    finish(master);
}

/// However slow the cycle is.
#[test]
fn a_motion_command_has_run_when_it_says_so_and_is_no_success_if_it_was_interrupted() {
    let machine = Machine::new(104);
    let config = machine.config("wide.toml", 1, "period = \"50ms\"", "simulate = { start = 10 }");
    let _sim = serve(&config);
    let command = |what: &str| asking("linmot command", &config, &format!("d0 {what}"));
    let go = |to: &str| format!("vai-go-to {to} acceleration=1000 deceleration=1000");
    let there = command(&format!("{} --home", go("position=20 velocity=200"))).end();
    assert_eq!(there.expect(0).out, "drive d0: 20.0000 mm\n");
    // One that moves nothing ends, too.
    command("no-operation").end().expect(0);

    let moving = command(&go("position=399 velocity=5"));
    let onlooker = Onlooker::new(&machine);
    onlooker.await_sight(machine.drive(0), |sight| sight.operating && sight.moving);
    let ended = moving.end_by(SIGINT);
    assert_eq!(ended.expect(1).out, "", "{ended:?}");
    let last = ended.err.lines().last().unwrap();
    assert_eq!(last, "fieldbeat: drive d0: interrupted; ramped down and switched off");
    assert!(!onlooker.look(machine.drive(0)).powered);
}

#[test]
fn a_motion_that_leads_out_of_the_limits_is_refused_before_the_drive_has_power() {
    let machine = Machine::new(137);
    let config = machine.plain(1);
    let drive = socket(machine.drive(0));
    let rest = "velocity=10 acceleration=100 deceleration=100 --home";
    let command = |what: &str| ask("linmot command", &config, &format!("d0 {what} {rest}"));
    command("vai-go-to position=5000").refused(&["drive d0: position 5000 is outside its limit (0 ... 400)"]);
    command("vai-increment-demand distance=401").refused(&["drive d0: distance 401 ", "(-400 ... 400)"]);
    assert_silent(&drive);
    drop(drive);

    // Where the drive is homed its place counts, too.
    let _sim = serve(&config);
    command("vai-go-to position=20").expect(0);
    let ended = command("vai-increment-demand distance=390");
    ended.refused(&["drive d0: distance 390 is outside its limit (-20", "... 380"]);
    command("vai-increment-demand distance=-10").expect(0);
}
