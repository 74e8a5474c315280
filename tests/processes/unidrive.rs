//! Unidrives as a user meets them: `check`, `param`, `run` and the demo, against simulated ones in a process of their
//! own.

use std::path::PathBuf;

use libc::SIGTERM;
use serde_json::Value;

use super::support::{Machine, assert_sums, checkout, drive, period, run};
use super::{ask, await_online, await_status, master, simulation};

/// Link health that no busy host comes to the end of.
const PATIENT: &str = "{ bucket = \"10s\", leak = 1 }";

/// A machine with one LinMot and two Unidrives of one address.
fn mixed(machine: &Machine) -> PathBuf {
    let (bind, linmot, unidrive) = (machine.ip(1), machine.ip(10), machine.ip(20));
    machine.write(
        "mixed.toml",
        format!(
            "[cycle]\nperiod = \"{}\"\nreceive_deadline = 0.8\n\
             max_skip = \"30s\"\nmax_skip_rate = 1.0\nrealtime = \"off\"\n\
             [[bus]]\nprotocol = \"linudp-v2\"\nbind = \"{bind}\"\n\
             [[bus.drive]]\nname = \"x\"\naddress = \"{linmot}\"\nhealth = {PATIENT}\n\
             [[bus]]\nprotocol = \"modbus-tcp\"\n\
             [bus.defaults]\ndivisor = 4\nhealth = {PATIENT}\nwatchdog.timeout = \"10s\"\n\
             [[bus.drive]]\nname = \"u\"\naddress = \"{unidrive}:1502\"\nphase = 1\n\
             [[bus.drive]]\nname = \"v\"\naddress = \"{unidrive}:1503\"\nphase = 3\n\
             via = \"menu-0\"\nsimulate = {{ split = 1 }}\n",
            period()
        ),
    )
}

#[test]
fn check_says_what_becomes_of_a_unidrive_if_the_master_dies() {
    let ended = run(["check".into(), checkout("rt-config/unidrive.toml")]);
    ended.expect(0);
    assert_eq!(ended.err, "");
    for part in ["if the master dies: the drive trips within 500 ms", "Pr 4.15.009", "not a safety function"]
    {
        assert!(ended.out.contains(part), "no {part}: {}", ended.out);
    }
}

#[test]
fn a_mapping_that_cannot_be_is_refused_by_check_with_the_reason() {
    let machine = Machine::new(110);
    let text = std::fs::read_to_string(mixed(&machine)).unwrap();
    for (fragment, reason) in [
        ("map.speed = \"18.011\"", "18.011 is not known here"),
        (
            "also_read = [{ parameter = \"18.001 ... 18.061\", bits = 32 }]",
            "122 registers from 18.001 on exceed the 120",
        ),
        (
            "addressing = \"modified\"\nmap.speed = { parameter = \"99.001\", bits = 32 }",
            "99.001 has no Modbus address",
        ),
    ] {
        let config =
            machine.write("wrong.toml", text.replace("phase = 1", &format!("phase = 1\n{fragment}")));
        ask("check", &config, "").refused(&[reason]);
    }
}

#[test]
fn parameters_are_read_written_and_listed_by_a_master_of_its_own_and_through_the_one_that_runs() {
    let machine = Machine::new(111);
    let config = mixed(&machine);
    let _sim = simulation(&config);
    let works = || {
        let does = |what: &str, rest: &str| ask(&format!("param {what}"), &config, rest);
        for name in ["u", "v"] {
            let said = does("set", &format!("{name} 01.022 100.5")).expect(0).out.clone();
            assert_eq!(said, format!("{name} 01.022: 1005 (0x3ED) = 100.5 rpm\n"));
            let said = does("get", &format!("{name} preset-reference-2 --json")).expect(0).json();
            assert_eq!((&said["raw"], &said["value"]), (&1005.into(), &1005.into()));
        }
        does("set", "u 03.002 5").failed(&["the drive did not take it and gave no error code"]);
        does("get", "u 18.011").failed(&["exception 02h no such parameter"]);
        does("get", "u 6.42").refused(&["not an address of this drive; write 06.042"]);
        let listed = does("list", "u 06").expect(0).out.clone();
        assert!(listed.contains("06.042  16 read write  ") && listed.contains("control-word\n"), "{listed}");
        assert!(!listed.contains("06.002"), "it has none: {listed}");
        let listed = does("list", "v 4.15 --json").expect(0).json();
        let addresses: Vec<&Value> = listed.as_array().unwrap().iter().map(|row| &row["address"]).collect();
        assert_eq!(addresses, ["4.15.005", "4.15.009", "4.15.013"]);
        does("list", "u 99").failed(&["menu 99 has no parameters"]);
    };
    works();
    let running = master(&config, &["--json"]);
    await_online(&config);
    works();
    running.signal(SIGTERM);
    let ended = running.end();
    assert_sums(&ended.expect(0).json());
}

#[test]
fn what_is_no_menu_is_refused_before_anything_is_sent() {
    let machine = Machine::new(112);
    let config = mixed(&machine);
    for (rest, reason) in [
        ("u", "drive u lists by menu; name one, like 06"),
        ("u 06.042", "06.042: not a menu"),
        ("u 06 --values", "leave --modified, --values and --from out"),
        ("x 06", "drive x has no menus; leave 06 out"),
    ] {
        ask("param list", &config, rest).refused(&[reason]);
    }
}

#[test]
fn unidrives_and_linmots_run_in_one_cycle_each_with_its_divisor() {
    let machine = Machine::new(113);
    let config = mixed(&machine);
    let _sim = simulation(&config);
    let running = master(&config, &["--json"]);
    let count = |summary: &Value, name: &str, key: &str| drive(summary, name)[key].as_u64().unwrap();
    await_status(&config, |summary| ["u", "v"].iter().all(|name| count(summary, name, "answered") > 50));
    running.signal(SIGTERM);
    let summary = running.end().expect(0).json();
    assert_sums(&summary);
    for name in ["u", "v"] {
        assert_eq!(drive(&summary, name)["protocol"], "modbus-tcp");
        assert!(count(&summary, name, "sent") * 2 < count(&summary, "x", "sent"), "{summary}");
    }
}
