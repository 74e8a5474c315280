//! What a user runs, and what it prints.

use std::io::Write;
use std::process::{Command, Stdio};

use fieldbeat::time::Ns;
use libc::SIGTERM;
use serde_json::Value;

use super::support::{Ended, Machine, PROGRAM, assert_sums, checkout, drive, run};
use super::{assert_powered_off, end_once_measured, end_once_online, master, simulation};

/// All keys of an object, `a.b` for those inside, of the first element in lists.
fn keys(value: &Value, path: &str, into: &mut Vec<String>) {
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                keys(value, &path, into);
                into.push(path);
            }
        }
        Value::Array(list) => list.first().into_iter().for_each(|first| keys(first, path, into)),
        _ => {}
    }
}

#[test]
fn the_demo_runs_by_itself_and_its_json_has_every_key() {
    let demo = || run(["demo", "--drives", "2", "--json"]);
    // Where others take its core meanwhile it says so, and chooses a longer period the next time.
    let is_judged = |ended: &Ended| ended.code == Some(0) || !ended.err.contains("; this host took ");
    let ended = (0..3).map(|_| demo()).find(is_judged).unwrap_or_else(demo);
    let summary = ended.expect(0).json();
    assert_sums(&summary);
    assert_powered_off(&summary);
    // It has chosen its period, and says so first.
    let period_ns = summary["cycle"]["period_ns"].as_u64().unwrap();
    assert!([1, 2, 4, 8, 16].contains(&(period_ns / 1_000_000)), "{period_ns}");
    let chosen = format!("fieldbeat: cycle of {}: ", Ns(period_ns));
    assert!(ended.err.starts_with(&chosen), "{chosen}: {}", ended.err);
    assert!(summary["cycle"]["executed"].as_u64().unwrap() > 100, "{summary}");
    // The load of a wire is that of its own drives, and others have none.
    let drives = summary["drives"].as_array().unwrap();
    let wire_us: u64 = drives.iter().filter_map(|drive| drive["protocol_counters"]["wire_us"].as_u64()).sum();
    let slots_us = (summary["cycle"]["planned"].as_u64().unwrap() * period_ns) as f64 / 1e3;
    for bus in summary["buses"].as_array().unwrap() {
        let wanted = (bus["name"] == "profibus-dp").then_some(100.0 * wire_us as f64 / slots_us);
        assert_eq!(bus["load_percent"].as_f64(), wanted, "{bus}");
    }
    // A loop that skips more than a few slots may come to its end before the last moves do.
    let of_cycle = |key: &str| summary["cycle"][key].as_u64().unwrap();
    let skips = of_cycle("skipped") * 50 > of_cycle("planned");
    let rests = |position: f64, at: f64, within: f64| skips || (position - at).abs() < within;
    for drive in drives {
        assert_eq!((&drive["link"], &drive["losses"]), (&"online".into(), &0.into()), "{drive}");
        // The packets of EtherNet/IP answer nothing.
        let answers = drive["protocol"] != "ethernet-ip";
        assert!(drive["rtt_ns"]["p50"].as_u64().map_or(!answers, |ns| answers && ns > 0), "{drive}");
        match drive["protocol"].as_str().unwrap() {
            // The last move ends at 160 mm; the simulated axis follows its setpoint within its own window.
            "linudp-v2" => assert!(rests(drive["position"].as_f64().unwrap(), 160.0, 1.0), "{drive}"),
            // One has turned there and back; the other one's last move ends 2 turns below where it swung.
            "ethercat" if drive["name"] == "k1" => assert!(drive["position"].is_number(), "{drive}"),
            "ethercat" | "ethernet-ip" => {
                assert!(rests(drive["position"].as_f64().unwrap(), 3.0, 0.01), "{drive}");
            }
            "profibus-dp" => {
                assert!(drive["position"].is_null(), "it reports none: {drive}");
                assert!(drive["protocol_counters"]["wire_us"].as_u64() > Some(0), "{drive}");
                // It has turned, rpm.
                assert!(drive["monitor"][0]["max"].as_f64() > Some(100.0), "{drive}");
            }
            // Its load is read in turns, on a busy host perhaps only while it stands.
            other => assert!(other == "modbus-tcp" && drive["position"].is_null(), "{drive}"),
        }
    }

    // The last line judges the choice of the period.
    let mut last = ended.err.lines().rev();
    let verdict = if summary["carried"]["carried"] == true { "carried it" } else { "did not carry it" };
    let judged = last.next().unwrap();
    assert!(judged.starts_with("fieldbeat: cycle of ") && judged.contains(verdict), "{judged}");
    // The line before has what became of the light of the terminals: each pattern is seen before the next one is
    // written.
    assert_eq!(summary["devices"].as_array().unwrap().len(), 3, "{summary}");
    let light = last.next().unwrap();
    let counts: Vec<u64> = light.split(' ').filter_map(|word| word.parse().ok()).collect();
    let [written, seen] = counts[..] else { panic!("{light}") };
    let said = format!("fieldbeat: device outputs: {written} patterns written, {seen} seen at the inputs");
    assert_eq!(light, said);
    assert!(seen > 0 && (seen..=seen + 1).contains(&written), "{light}");

    // Of the buses only the line has a clock, and it leads.
    let mut clocks = summary["buses"].as_array().unwrap().iter().filter(|bus| !bus["clock"].is_null());
    let (line, none) = (clocks.next().unwrap(), clocks.next());
    assert_eq!((&line["name"], &line["clock"]["leads"], none), (&"ethercat".into(), &true.into(), None));
    let mut clock = Vec::new();
    keys(&line["clock"], "", &mut clock);
    clock.sort();
    assert_eq!(clock, ["error_max_ns", "error_ns", "leads", "locked", "window_ns"]);

    let mut have = Vec::new();
    keys(&summary, "", &mut have);
    // What depends on how the run went: checked by the tests that bring it about.
    have.retain(|key| {
        !key.starts_with("late.causes.")
            && !key.starts_with("late.newest.")
            && !key.starts_with("black_boxes.")
            && !key.contains(".protocol_counters.")
    });
    let quantiles = |of: &str| {
        ["count", "p50", "p90", "p99", "p99_9", "p99_99", "max", "max_cycle"].map(|key| format!("{of}.{key}"))
    };
    let mut want: Vec<String> =
        ["cycle cycle.period_ns cycle.planned cycle.executed cycle.skipped cycle.overruns cycle.reference \
         cycle.reference.bus cycle.reference.locked cycle.reference.losses cycle.reference.samples \
         cycle.reference.silent carried carried.carried carried.period_ns carried.shares carried.shares.what \
         carried.shares.count carried.shares.of carried.shares.tolerated carried.shares.drive \
         carried.would_be_ns carried.realtime cycle.reference.error_ns cycle.reference.step_max_ns \
         wake_ns jitter_ns \
         stages_ns stages_ns.send stages_ns.receive stages_ns.evaluate stages_ns.commands stages_ns.prepare \
         stages_ns.publish late late.threshold_ns late.count late.causes late.newest black_boxes recordings \
         failures drives drives.name drives.protocol drives.link drives.not_connected drives.diagnosis \
         drives.state drives.losses drives.sent drives.answered drives.missed drives.late drives.duplicate \
         drives.rejected drives.suspect drives.unsent drives.rtt_ns drives.send_jitter_ns drives.age_ns \
         drives.age_cycles drives.protocol_counters drives.position drives.sto_open drives.stopped \
         drives.begun_by drives.fault drives.fault_name drives.monitor drives.implausible drives.at_end \
         drives.at_end.condition drives.at_end.requested devices devices.name devices.not_operational \
         devices.protocol_counters buses buses.name buses.unmatched buses.dropped buses.receive_errors \
         buses.load_percent buses.clock realtime realtime.policy realtime.priority realtime.core \
         realtime.memory_locked realtime.page_faults realtime.involuntary_switches realtime.telemetry_lost \
         realtime.events_lost realtime.missing host host.name host.kernel host.preemption host.cpu \
         host.steal_ms host.taken_ms"]
        .iter()
        .flat_map(|keys| keys.split_whitespace().map(str::to_owned))
        .collect();
    for of in [
        "wake_ns",
        "jitter_ns",
        "stages_ns.send",
        "stages_ns.receive",
        "stages_ns.evaluate",
        "stages_ns.commands",
        "stages_ns.prepare",
        "stages_ns.publish",
        "cycle.reference.error_ns",
        "drives.rtt_ns",
        "drives.send_jitter_ns",
        "drives.age_ns",
    ] {
        want.extend(quantiles(of));
    }
    have.sort();
    want.sort();
    assert_eq!(have, want, "keys are stable: programs read them");
}

#[test]
fn simulation_and_master_are_two_processes() {
    let machine = Machine::new(2);
    let config = machine.plain(3);
    let sim = simulation(&config);
    let ended = end_once_measured(master(&config, &["--json"]), &config);
    assert_eq!(ended.expect(0).err, "all drives online: 3\n");
    let summary = ended.json();
    assert_sums(&summary);
    for name in ["d0", "d1", "d2"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["link"], &drive["rejected"]), (&"online".into(), &0.into()));
    }
    // The text form, with a table of the same drives.
    let ended = end_once_online(master(&config, &[]));
    ended.expect(0);
    for part in ["planned", "wake-up latency", "d0 ", "d2 ", "host: "] {
        assert!(ended.out.contains(part), "no {part}: {}", ended.out);
    }
    let ended = sim.end_by(SIGTERM);
    ended.expect(0);
    assert!(ended.out.lines().last().unwrap().ends_with("answered"), "{ended:?}");
}

/// The plan in words is held by the tests of configurations.
#[test]
fn check_states_the_plan_the_drives_after_a_death_of_the_master_and_the_missing_safety_function() {
    let machine = Machine::new(199);
    for (name, becomes) in [
        ("demo", "if the master dies: "),
        ("linmot", "if the master dies: stops within "),
        ("unidrive", "if the master dies: the drive trips within 500 ms"),
        ("kollmorgen", "if the master dies: the drive stops by itself within 20 ms"),
        ("moons", "if the master dies: "),
        ("lenze", "if the master dies: stops within 100 ms by its own watchdog"),
    ] {
        // This host may have fewer cores.
        let text = std::fs::read_to_string(checkout(&format!("rt-config/{name}.toml"))).unwrap();
        let lines = text.lines().filter(|line| !line.starts_with("core = "));
        let config = machine.write(&format!("{name}.toml"), lines.collect::<Vec<_>>().join("\n"));
        let ended = run(["check".as_ref(), config.as_os_str()]);
        assert_eq!(ended.expect(0).err, "");
        for part in [becomes, "stop: ", "not a safety function"] {
            assert!(ended.out.contains(part), "{name}: no {part}: {}", ended.out);
        }
    }
}

#[test]
fn check_as_json_is_one_object_with_the_plan_or_the_mistakes_and_may_read_a_pipe() {
    let file = checkout("rt-config/demo.toml");
    let said = run(["check".into(), file.clone(), "--json".into()]).expect(0).json();
    assert_eq!((&said["drives"][0]["name"], &said["errors"]), (&"a1".into(), &serde_json::json!([])));
    assert_eq!(said["source"], file.to_str().unwrap());

    let machine = Machine::new(128);
    let text = std::fs::read_to_string(machine.plain(1)).unwrap();
    let config = machine.write("m.toml", text.replace("d0", "d 0") + "divisor = 0\n");
    let ended = run(["check".as_ref(), config.as_os_str(), "--json".as_ref()]);
    let said = ended.expect(2).json();
    assert_eq!(said.as_object().unwrap().keys().collect::<Vec<_>>(), ["errors"]);
    let errors = said["errors"].as_array().unwrap();
    let of = |key: &str| {
        errors.iter().find(|error| error["key"] == key).unwrap_or_else(|| panic!("{key}: {said}"))
    };
    assert_eq!(of("bus.drive.divisor")["value"], "0");
    assert_eq!(of("bus.drive.name")["file"], config.to_str().unwrap());
    assert!(errors.iter().all(|error| error["line"].is_u64() && error["message"].is_string()), "{said}");
    // People read the same on standard error.
    assert_eq!(ended.err.lines().count(), errors.len(), "{}", ended.err);

    // What goes in by a pipe is a configuration like any other.
    let piped = |words: &[&str], text: &str| {
        let mut piped = Command::new(PROGRAM);
        piped.args(words).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut piped = piped.spawn().unwrap();
        // One that refuses its arguments may have ended by then.
        let _ = piped.stdin.take().unwrap().write_all(text.as_bytes());
        let output = piped.wait_with_output().unwrap();
        let [out, err] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        (output.status.code().unwrap(), out, err)
    };
    assert_eq!(piped(&["check", "/dev/stdin"], &text).0, 0);
    let (code, out, err) = piped(&["check", "-"], &text);
    assert_eq!((code, out.starts_with("<stdin>: 1 drive"), err.as_str()), (0, true, ""), "{out}");
    let (code, _, err) = piped(&["run", "-", "--for", "1s"], &text.replace("d0", "d 0"));
    assert!(
        code == 2 && err.starts_with("fieldbeat: <stdin>:") && err.contains(": bus.drive.name = "),
        "{err}"
    );
    let (code, _, err) = piped(&["pin", "-", "--write"], &text);
    assert_eq!(
        (code, err.contains("--write changes the file of the configuration: name it")),
        (2, true),
        "{err}"
    );
}

/// What a shell with this script makes of half a line.
#[test]
fn the_completions_of_bash_are_a_script_that_knows_all_commands() {
    let script = run(["completions", "bash"]).expect(0).out.clone();
    let complete = |before: &str, current: &str| {
        let last = before.split_whitespace().count();
        let words = format!("COMP_WORDS=({before} '{current}') COMP_CWORD={last}");
        let call = format!("_fieldbeat fieldbeat '{current}' x || true; echo \"${{COMPREPLY[@]}}\"");
        let script = format!("{script}\n{words}\n{call}");
        let output = Command::new("bash").args(["--norc", "-c", &script]).output().unwrap();
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    let known = complete("fieldbeat", "");
    for command in commands() {
        assert!(known.split_whitespace().any(|word| word == command), "no {command}: {known}");
    }
    assert_eq!(complete("fieldbeat", "che").trim(), "check");
    assert!(complete("fieldbeat check", "--j").contains("--json"));
    for shell in ["zsh", "fish", "elvish", "powershell"] {
        assert!(run(["completions", shell]).expect(0).out.contains("blackbox"), "{shell}");
    }
    run(["completions", "tcsh"]).refused(&["tcsh", "bash", "zsh"]);
}

#[test]
fn the_manual_names_every_command_and_has_a_page_for_each() {
    let page = run(["man"]).expect(0).out.clone();
    let machine = Machine::new(131);
    let directory = machine.path("man1");
    run(["man".as_ref(), "--dir".as_ref(), directory.as_os_str()]).expect(0);
    for command in commands() {
        assert!(page.contains(&format!(".SH FIELDBEAT {}", command.to_uppercase())), "no {command}: {page}");
        let own = std::fs::read_to_string(directory.join(format!("fieldbeat-{command}.1"))).unwrap();
        assert!(own.contains(".SH SYNOPSIS"), "{own}");
    }
    let whole = std::fs::read_to_string(directory.join("fieldbeat.1")).unwrap();
    assert!(whole.contains("safety function") && page.contains("safety function"), "{whole}");
    assert!(directory.join("fieldbeat-param-get.1").is_file());
    // Not every computer has man.
    let file = std::fs::File::open(machine.write("page.1", &page)).unwrap();
    if let Ok(rendered) = Command::new("man").args(["--warnings", "-l", "-"]).stdin(file).output() {
        assert!(rendered.status.success() && rendered.stderr.is_empty(), "{rendered:?}");
        assert!(String::from_utf8_lossy(&rendered.stdout).contains("FIELDBEAT CHECK"), "{rendered:?}");
    }
    let way = machine.write("way", "");
    run(["man".as_ref(), "--dir".as_ref(), way.as_os_str()]).failed(&[
        "cannot write to ",
        "way",
        "name another",
    ]);
}

/// The commands as the help lists them.
fn commands() -> Vec<String> {
    let help = run(["--help"]).expect(0).out.clone();
    let list = help.split("Commands:").nth(1).unwrap().split("Options:").next().unwrap();
    let names = list.lines().filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    let names = names.filter_map(|line| line.split_whitespace().next()).filter(|name| *name != "help");
    let names: Vec<String> = names.map(str::to_owned).collect();
    assert!(names.len() >= 12, "{help}");
    names
}

/// `| head -1`, a full disk, and nobody at all.
#[test]
fn a_closed_output_is_no_panic() {
    let machine = Machine::new(19);
    let config = machine.plain(1);
    let full = || Stdio::from(std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap());
    let gone = || Stdio::from(std::io::pipe().unwrap().1);
    let run = |command: &str, out: Stdio, err: Stdio| {
        let mut child = Command::new(PROGRAM);
        child.arg(command).arg(&config).stdin(Stdio::null()).stdout(out).stderr(err);
        if command != "check" {
            child.args(["--for", "200ms"]);
        }
        child.spawn().unwrap().wait().unwrap().code()
    };
    // Nobody reads on: what the reader wanted, it got.
    assert_eq!(run("check", gone(), Stdio::null()), Some(0));
    assert_eq!(run("sim", gone(), gone()), Some(0));
    // Lost to a full disk: an error.
    assert_eq!(run("check", full(), Stdio::null()), Some(1));
    assert_eq!(run("check", full(), full()), Some(1));
    // The code of the run itself, with nobody to tell: no drive answers.
    assert_eq!(run("run", gone(), gone()), Some(1));
    assert_eq!(run("run", Stdio::null(), full()), Some(1));
    // And of a refusal.
    machine.write("plain.toml", "");
    assert_eq!(run("run", Stdio::null(), gone()), Some(2));
    assert_eq!(run("check", Stdio::null(), full()), Some(2));
}
