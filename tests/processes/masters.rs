//! Two masters: of one process, of two, of the shell; on one segment, on one Unidrive, on one LinMot.

use std::path::{Path, PathBuf};

use fieldbeat::Master;

use super::support::{LONG, Machine, drive, run, until};
use super::{ask, await_online, finish, master, online, patient_cycle, simulation, wires};

/// Link health that no busy host comes to the end of.
const PATIENT: &str = "{ bucket = \"10s\", leak = 1 }";

/// A machine of one drive of each protocol, and what of it is in use by its master, as a refusal names it.
fn machines(machine: &Machine) -> Vec<(PathBuf, &'static str, String)> {
    let cycle = patient_cycle() + "[[bus]]\n";
    let (bind, linmot, unidrive) = (machine.ip(1), machine.ip(10), machine.ip(20));
    let segment = format!("local:two-masters-{}-{}", std::process::id(), machine.ip(0).octets()[2]);
    let drive = |rest: String| format!("[[bus.drive]]\nname = \"x\"\nhealth = {PATIENT}\n{rest}");
    let buses = [
        (
            "linmot.toml",
            format!("protocol = \"linudp-v2\"\nbind = \"{bind}\"\n"),
            format!("address = \"{linmot}\"\n"),
            format!("drive x at {linmot}:49360 is in use by another master"),
            "0x20A8",
        ),
        (
            "unidrive.toml",
            "protocol = \"modbus-tcp\"\n".to_owned(),
            format!("address = \"{unidrive}:1502\"\nwatchdog.timeout = \"10s\"\n"),
            format!("drive x at {unidrive}:1502 is in use by another master"),
            "01.022",
        ),
        (
            "kollmorgen.toml",
            format!("protocol = \"ethercat\"\ninterface = \"{segment}\"\n"),
            "watchdog = \"off\"\n".to_owned(),
            format!("interface {segment} is in use by another master"),
            "0x6041:0",
        ),
    ];
    let written = |(file, bus, rest, refusal, address): (&str, String, String, String, _)| {
        (machine.write(file, format!("{cycle}{bus}{}", drive(rest))), address, refusal)
    };
    buses.into_iter().map(written).collect()
}

/// The one line of a start that is refused.
#[track_caller]
fn refused(config: &Path) -> String {
    Master::from_file(config).unwrap().start().map(drop).unwrap_err().to_string()
}

/// A master of this process. What another one has just closed stays in use for a moment: a program that another test
/// starts meanwhile has it until it is loaded.
#[track_caller]
fn started(config: &Path) -> Master {
    let mut started = None;
    until(LONG, || {
        started = Some(Master::from_file(config).unwrap().start());
        !matches!(&started, Some(Err(error)) if error.to_string().contains("Address already in use"))
    });
    let master = started.unwrap().unwrap();
    master.wait_online(LONG).unwrap();
    master
}

#[test]
fn a_second_master_is_refused_by_name_and_the_first_one_does_not_notice() {
    let machine = Machine::new(180);
    for (config, address, in_use) in machines(&machine) {
        let _sim = simulation(&config);
        let first = online(&config, &["--json"]);
        let name = format!("{in_use}, process {} (fieldbeat): end that one first", first.pid());
        master(&config, &["--for", "1s"]).end().refused(&[&name]);
        assert!(refused(&config).contains(&name));
        // The shell goes through the master that runs.
        ask("param get", &config, &format!("x {address}")).expect(0);
        let summary = finish(first);
        let drive = drive(&summary, "x");
        assert_eq!(
            (&drive["link"], &drive["losses"], &drive["rejected"]),
            (&"online".into(), &0.into(), &0.into())
        );
        assert_eq!(drive["stopped"], "shutdown", "{drive}");
    }
}

/// Values, and parameters by explicit messages, take the outputs from nobody.
#[test]
fn a_moons_drive_is_read_next_to_its_owner() {
    let machine = Machine::new(183);
    let owned = wires::moons(&machine);
    let [own, other] = [1, 2].map(|host| format!("bind = \"{}\"", machine.ip(host)));
    let text = std::fs::read_to_string(&owned).unwrap().replace(&own, &other);
    let values = text.replace("[bus.defaults]\n", "[bus.defaults]\nconnection = \"input-only\"\n");
    // Nobody homes by it.
    let values: String = values
        .lines()
        .filter(|line| !line.starts_with("homing = "))
        .map(|line| format!("{line}\n"))
        .collect();
    let [second, reader] =
        [("second.toml", text), ("reader.toml", values)].map(|(file, text)| machine.write(file, text));
    let _sim = simulation(&owned);
    let first = online(&owned, &["--json"]);
    for (address, code) in [("feeder AC", 0), ("turret 0x01/1/7.text", 0), ("feeder 0x77/1/1.u16", 1)] {
        ask("param get", &second, address).expect(code);
    }
    master(&second, &["--for", "1s"]).end().refused(&["drive feeder at ", "is in use by another master"]);
    let read = finish(online(&reader, &["--json"]));
    let owner = finish(first);
    for name in ["feeder", "turret"] {
        assert_eq!((&drive(&read, name)["losses"], &drive(&owner, name)["losses"]), (&0.into(), &0.into()));
        assert_eq!(drive(&owner, name)["stopped"], "shutdown");
    }
}

#[test]
fn an_embedded_master_is_left_alone_by_a_second_one_by_the_shell_and_by_a_scan_until_it_ends() {
    let machine = Machine::new(181);
    for (config, address, in_use) in machines(&machine) {
        let _sim = simulation(&config);
        let first = started(&config);
        let own = format!("{in_use} or bus of this process: end that one first");
        assert!(refused(&config).ends_with(&own), "{}", refused(&config));
        // It has no control socket.
        let name = format!("{in_use}, process {} (", std::process::id());
        let get = || ask("param get", &config, &format!("x {address}"));
        get().refused(&[&name, "end that one first"]);
        // The same of the segment, if it is one.
        let interface = in_use.split(' ').nth(1).filter(|name| name.starts_with("local:"));
        let scan = || interface.map(|interface| run(["ethercat", "scan", interface]));
        scan().iter().for_each(|ended| ended.refused(&[name.trim_start_matches("interface ")]));
        assert!(first.observers()[0].1.feedback().stopped.is_none());
        drop(first);
        // Its lock goes with it.
        let second = started(&config);
        drop(second.finish());
        get().expect(0);
        assert!(scan().is_none_or(|ended| ended.code == Some(0)));
    }
}

#[test]
fn resources_of_a_killed_master_are_free_and_commands_touch_no_slave_in_op() {
    let machine = Machine::new(182);
    for (config, address, _) in machines(&machine) {
        let _sim = simulation(&config);
        let first = master(&config, &[]);
        await_online(&config);
        first.kill();
        if config.ends_with("kollmorgen.toml") {
            // It has no watchdog that would take it out of OP.
            let get = ask("param get", &config, &format!("x {address}"));
            get.refused(&[
                "the slave at place 0 of its segment is in OP, and nothing may disturb it",
                "fieldbeat run",
            ]);
        }
        drop(started(&config));
        ask("param get", &config, &format!("x {address}")).expect(0);
    }
}
