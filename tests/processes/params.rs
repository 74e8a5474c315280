//! `fieldbeat param`: parameters of the drives, read, written and listed, by a master of its own or through the one
//! that runs.

use std::fs;
use std::os::unix::fs::PermissionsExt;

use libc::{SIGINT, SIGTERM};
use serde_json::{Value, json};

use super::support::{
    Ended, Machine, NOBODY, Program, as_ordinary_user, assert_sums, checkout, is_root, run,
};
use super::{ask, asking, assert_silent, online, serve, simulation, socket, with_drives};

/// A value of what the program says of drive `d0` with `--json`.
fn value(ended: &Ended, key: &str) -> Value {
    ended.expect(0).json()[key].clone()
}

#[test]
fn every_value_of_a_parameter_is_read_under_every_name_and_a_refusal_comes_with_its_reason() {
    let (_machine, config, _sim) = with_drives(80, 1);
    for (address, text) in [
        ("0x20A8", "7695 (0x1E0F)"),
        ("0x20a8.ram", "7695 (0x1E0F)"),
        ("monitor-source-1", "7695 (0x1E0F)"),
        ("monitor-source-1.min", "0 (0x0)"),
        ("20A8h.max", "65535 (0xFFFF)"),
        ("0x20A8.default", "7695 (0x1E0F)"),
        ("predefined-velocity", "1000 mm/s (raw 1000000, 0xF4240)"),
        ("core-temperature", "40 C (raw 400, 0x190)"),
    ] {
        let ended = ask("param get", &config, &format!("d0 {address}"));
        assert_eq!(
            (ended.expect(0).out.as_str(), ended.err.as_str()),
            (&*format!("d0 {address}: {text}\n"), "")
        );
    }
    let said = ask("param get", &config, "d0 minimum-position --json").json();
    let raw = -50_000_i32 as u32;
    let text = "-5 mm (raw -50000, 0xFFFF3CB0)";
    assert_eq!(
        said,
        json!({ "drive": "d0", "address": "minimum-position", "raw": raw, "value": -50_000, "text": text })
    );
    // What the drive refuses; its own limits are narrower than those of the type.
    for (what, rest, parts) in [
        ("get", "0x9999", ["drive d0: read 0x9999: ", "no such UPID"]),
        ("get", "demand-velocity.default", ["drive d0: read demand-velocity.default: ", ""]),
        ("set", "run-mode 17", ["drive d0: write run-mode = 17: ", ""]),
        ("set", "demand-velocity 1", ["drive d0: write demand-velocity = 1: ", ""]),
    ] {
        ask(&format!("param {what}"), &config, &format!("d0 {rest}")).failed(&parts);
    }
    ask("param set", &config, "d0 run-mode 16").expect(0);
}

#[test]
fn written_parameters_last_as_long_as_their_memory_or_until_defaults_are_set() {
    let (_machine, config, _sim) = with_drives(81, 1);
    let get = |address: &str| value(&ask("param get", &config, &format!("d0 {address} --json")), "value");
    let set = |words: &str| value(&ask("param set", &config, &format!("d0 {words} --json")), "value");

    let was = get("predefined-deceleration");
    let ended = ask("param set", &config, "d0 predefined-velocity 123.456");
    assert_eq!(ended.expect(0).out, "d0 predefined-velocity: 123.456 mm/s (raw 123456, 0x1E240)\n");
    // What it has said is what it takes, with the unit and without; counts are taken on request.
    for text in ["123.456", "123456 --raw", "0x1E240", "123.456mm/s"] {
        assert_eq!(set(&format!("predefined-velocity {text}")), 123_456, "{text}");
    }
    assert_eq!(set("minimum-position -7"), -70_000);
    assert_eq!(set("maximum-position 0x000F4240"), 1_000_000);
    assert_eq!(set("predefined-acceleration.rom 7.77"), 777);
    assert_eq!(set("predefined-deceleration.both 888 --raw"), 888);
    // What is in flash is in use after the next start.
    assert_eq!(get("predefined-velocity"), 123_456);
    assert_eq!(get("predefined-velocity.rom"), 1_000_000);
    assert_eq!(get("predefined-acceleration"), 1_000_000);

    assert_eq!(ask("linmot restart", &config, "d0").expect(0).out, "drive d0: restarts\n");
    for (address, now) in [
        ("predefined-velocity", 1_000_000),
        ("minimum-position", -50_000),
        ("maximum-position", 4_050_000),
        ("predefined-acceleration", 777),
        ("predefined-deceleration", 888),
    ] {
        assert_eq!(get(address), now, "{address}");
    }

    // Its software is stopped and runs again, and the defaults of its motion control are set.
    let does = |what: &str, rest: &str| ask(&format!("linmot {what}"), &config, &format!("d0{rest}"));
    assert_eq!(does("software stop", "").expect(0).out, "drive d0: its software is stopped\n");
    assert_eq!(does("software start", "").expect(0).out, "drive d0: its software runs; home it\n");
    assert_eq!(set("0x3100.both 8"), 8);
    let said = "drive d0: the defaults take effect after a restart; home it\n";
    assert_eq!(does("defaults", " mc").expect(0).out, said);
    assert_eq!(
        (get("predefined-deceleration"), get("predefined-deceleration.rom")),
        (888.into(), was.clone())
    );
    assert_eq!(get("0x3100.rom"), 8);
    does("restart", "").expect(0);
    assert_eq!((get("predefined-deceleration"), get("0x3100")), (was, 8.into()));
}

#[test]
fn the_lists_say_what_there_is_how_it_is_used_and_what_was_changed() {
    let (_machine, config, _sim) = with_drives(82, 1);
    let list = |options: &str| ask("param list", &config, &format!("d0 {options}"));
    let rows =
        |options: &str| list(&format!("{options} --json")).expect(0).json().as_array().unwrap().clone();

    let all = list("").expect(0).out.clone();
    let lines: Vec<&str> = all.lines().collect();
    assert!(lines.len() > 60 && lines.is_sorted(), "{all}");
    for line in ["0x000C  r- r-        article-number", "0x14BE  rw rw live   predefined-velocity"] {
        assert!(lines.contains(&line), "no \"{line}\": {all}");
    }
    assert_eq!(rows("").len(), lines.len());
    // From one on that there is, and from one that there is not.
    let monitor = rows("--from monitor-source-1");
    assert_eq!(monitor[0]["address"], "0x20A8");
    assert_eq!(rows("--from 0x2000"), monitor);
    assert_eq!(rows("--from 0xFFFF"), [] as [Value; 0]);

    let with_values = rows("--from 20A8h --values");
    assert_eq!(with_values.len(), monitor.len());
    assert_eq!(
        with_values[0],
        json!({ "address": "0x20A8", "name": "monitor-source-1", "usage": "rw rw live", "raw": 7695, "value": 7695 })
    );
    let printed = list("--from 20A8h --values").expect(0).out.clone();
    assert!(printed.contains("0x20AB  rw rw live   7505 (0x1D51)  monitor-source-4"), "{printed}");

    ask("param set", &config, "d0 predefined-velocity.rom 0.006").expect(0);
    let changed = list("--modified").expect(0).out.clone();
    assert!(changed.contains("0x14BE  0.006 mm/s (raw 6, 0x6)  predefined-velocity"), "{changed}");
    let modified = rows("--modified --from 0x14BE");
    assert_eq!((&modified[0]["value"], &modified[0]["usage"]), (&json!(6), &Value::Null));
    list("--modified --values").refused(&["--modified", "--values", "--help"]);
}

/// Half of a list looks like a whole one.
#[test]
fn an_interrupted_list_is_none() {
    let machine = Machine::new(106);
    let config = machine.config("slow.toml", 1, "", "simulate = { config_time = \"100ms\" }");
    let _sim = simulation(&config);
    let mut listing = asking("param list", &config, "d0 --json --values");
    // It reports its progress every few seconds.
    listing.await_text("fieldbeat: list ");
    let ended = listing.end_by(SIGINT);
    assert_eq!(ended.expect(1).out, "");
    let last = ended.err.lines().last().unwrap();
    assert!(last.contains("drive d0: ") && last.contains("its parameters was interrupted"), "{last}");
}

/// Exit code 2 says that nothing was sent.
#[test]
fn mistakes_of_the_asker_are_one_line_and_no_telegram() {
    let machine = Machine::new(83);
    let config = machine.plain(2);
    let drives = [0, 1].map(|index| socket(machine.drive(index)));
    let get = |words: &str| ask("param get", &config, words);
    let set = |words: &str| ask("param set", &config, words);
    let none = machine.path("none.toml");
    ask("param get", &none, "d0 0x20A8").refused(&[
        "cannot read",
        "none.toml",
        "for example rt-config/demo.toml",
    ]);
    let broken = machine.write("broken.toml", "[cycle]\nperiod = 1\n");
    let ended = ask("param get", &broken, "d0 0x20A8");
    assert!(ended.expect(2).err.contains("broken.toml:2") && ended.out.is_empty(), "{ended:?}");
    get("d7 0x20A8").refused(&["has no drive d7", "it has d0, d1"]);
    get("d0").refused(&["ADDRESS", "--help"]);
    set("d0 0x20A8").refused(&["VALUE", "--help"]);
    for address in ["0x", "20A8", "0x120A8", "speed", "0x20A8.eeprom"] {
        get(&format!("d0 {address}"))
            .refused(&[&format!("drive d0: read {address}: not an address"), "write 0x20A8"]);
    }
    for (rest, parts) in [
        ("speed 1", ["drive d0: write speed", "not an address"]),
        (
            "0x20A8.min 1",
            ["write 0x20A8.min: ", "cannot be written; write to the UPID itself, .rom or .both"],
        ),
        ("home-position 1.5 --raw", ["drive d0: write home-position", "-2147483648 ... 2147483647"]),
        ("home-position 12rev", ["12rev is not a value of this parameter", "a value in mm"]),
        ("home-position 0.00001", ["0.00001", "up to 4 decimals"]),
        ("0x3100 5mm", ["5mm", "a whole number"]),
        ("0x3100 99999999999999999999", ["99999999999999999999", "or its bits as 0x..."]),
    ] {
        set(&format!("d0 {rest}")).refused(&parts);
    }
    for (rest, range) in [
        ("monitor-source-1 65536", "0 ... 65535"),
        ("monitor-source-1 -1", "0 ... 65535"),
        ("home-position 300000", "-214748.3648 mm ... 214748.3647 mm"),
        ("0x3100 0x1FFFFFFFF", "-2147483648 ... 4294967295"),
    ] {
        let (address, value) = rest.split_once(' ').unwrap();
        set(&format!("d0 {rest}")).failed(&[&format!("drive d0: write {address}"), value, range]);
    }
    ask("param list", &config, "d0 --from speed").refused(&["--from speed: not a UPID"]);
    ask("param", &config, "").refused(&["--help"]);
    drives.iter().for_each(assert_silent);
}

/// Whoever has switched it on: what commands it, or what it may be using, is not changed, by a master of the program's
/// own or through one that runs.
#[test]
fn parameters_in_use_by_a_switched_on_drive_are_not_changed() {
    let machine = Machine::new(226);
    let config =
        machine.config("on.toml", 1, "", "on_found_running = \"refuse\"\nsimulate = { running = true }");
    let _sim = simulation(&config);
    let set = |words: &str| ask("param set", &config, &format!("d0 {words}"));
    set("run-mode 16").failed(&[
        "drive d0: write run-mode = 16: it may command the drive, which another master, ",
        "disable it",
    ]);
    // What moves nothing is written all the same.
    assert_eq!(value(&set("p-gain-a 30 --json"), "value"), 30);

    let master = online(&config, &["--json"]);
    for words in ["run-mode 16", "0x1E72 5", "0x3100 1"] {
        let (address, number) = words.split_once(' ').unwrap();
        set(words).failed(&[
            &format!("drive d0: write {address} = {number}: it may command the drive, whose power is on"),
            "disable the axis first, or use native mode",
        ]);
    }
    set("run-mode.rom 16")
        .failed(&["drive d0: write run-mode.rom = 16: the drive is switched on: disable it first"]);
    assert_eq!(value(&set("p-gain-a 31 --json"), "value"), 31);
    assert_eq!(value(&ask("param get", &config, "d0 run-mode --json"), "value"), 1);
    master.signal(SIGTERM);
    // It was only read, and still moves.
    assert_sums(&master.end().expect(1).json());

    let [curve, table] =
        ["curve.csv", "table.toml"].map(|file| checkout(&format!("rt-config/linmot-{file}")));
    for (what, rest, doing) in [
        ("curve put", curve.to_str().unwrap(), "writing a curve"),
        ("curve delete", "", "deleting its curves"),
        ("curve save", "", "saving to flash"),
        ("table put", table.to_str().unwrap(), "writing its command table"),
        ("table delete", "", "deleting its command table"),
        ("restart", "", "a restart"),
        ("software stop", "", "stopping its software"),
    ] {
        let why = format!("drive d0: {doing} needs a drive that is switched off: disable it first");
        ask(&format!("linmot {what}"), &config, &format!("d0 {rest}")).failed(&[&why]);
    }
}

#[test]
fn an_absent_drive_is_reported_after_a_while() {
    let machine = Machine::new(85);
    let config = machine.plain(2);
    let silent = socket(machine.drive(1));
    ask("param get", &config, "d0 0x20A8").failed(&[
        "drive d0 cannot be reached: nothing has ever come from it: look at its power, cable and ",
    ]);
    // An interrupted wait reports that nothing has happened.
    let waiting = asking("param set", &config, "d0 monitor-source-1 1");
    waiting.await_handler(SIGINT);
    waiting.end_by(SIGINT).failed(&["interrupted; nothing was written"]);
    // Only the named drive got a request.
    assert_silent(&silent);
}

/// Its socket is there, and closed to this user. No other way is taken: the drive has an owner.
#[test]
fn a_master_of_another_user_is_named() {
    let machine = Machine::new(87);
    std::fs::copy(machine.plain(1), machine.path("closed87.toml")).unwrap();
    let config = machine.path("closed87.toml");
    let _sim = serve(&config);
    let ordinary = |words: &[&str]| {
        let mut command = as_ordinary_user(&machine);
        command.args(words);
        Program::spawn(&mut command)
    };
    let path = config.to_str().unwrap();
    let mut master = ordinary(&["run", path]);
    master.await_text("all drives online");
    let user = if is_root() { NOBODY } else { nix::unistd::geteuid().as_raw() };
    let directory = std::env::temp_dir().join(format!("fieldbeat-tests-{user}/fieldbeat"));
    let sockets = fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path());
    let own = sockets.filter(|path| path.to_str().unwrap().contains("closed87-"));
    // Those of runs that were killed lie there, too.
    own.for_each(|socket| fs::set_permissions(socket, PermissionsExt::from_mode(0o000)).unwrap());
    ordinary(&["param", "get", path, "d0", "0x20A8"]).end().failed(&["belongs to another user", "use sudo"]);
    master.end_by(SIGTERM).expect(0);
}

#[test]
fn the_help_says_how_to_write_everything() {
    for (words, parts) in [
        ("param", &["get", "set", "list", "Reads a parameter"][..]),
        ("param get", &["0x20A8.rom", ".default", "--json", "<CONFIG> <DRIVE> <ADDRESS>"]),
        ("param set", &["0x20A8.both", "<CONFIG> <DRIVE> <ADDRESS> <VALUE>", "0x....", "--raw"]),
        ("param list", &["--modified", "--values", "--from <ADDRESS>"]),
        ("linmot", &["curve", "table", "errors", "restart", "software", "defaults"]),
        ("linmot curve get", &["--id <N>", "--force"]),
        ("linmot curve put", &["--save", "silent"]),
    ] {
        let ended = run(words.split(' ').chain(["--help"]));
        assert_eq!(ended.expect(0).err, "");
        for part in parts {
            assert!(ended.out.contains(part), "{words}: no \"{part}\":\n{}", ended.out);
        }
        let long = ended.out.lines().find(|line| line.chars().count() > 100);
        assert_eq!(long, None, "{words}");
    }
}
