//! Soak tests: checkpoints, what is resumed after a kill, criteria that fail by name, and what is refused.

use std::path::{Path, PathBuf};
use std::process::Command;

use libc::SIGINT;
use serde_json::{Value, json};

use super::support::{LONG, Machine, PROGRAM, Program, drive, run, until};
use super::{assert_powered_off, await_status, serve, simulation};

/// Criteria that any host keeps to.
const USUAL: [(&str, &str); 7] = [
    ("late_share", "1.0"),
    ("missed_share", "1.0"),
    ("memory_growth", "1000"),
    ("descriptor_growth", "20"),
    ("drift", "1e9"),
    ("telemetry_lost", "1_000_000"),
    ("warm_up", "\"1s\""),
];

/// A configuration of two drives that any host keeps to, with these criteria in addition.
fn config(machine: &Machine, defaults: &str, soak: &str) -> PathBuf {
    let plain = machine.config("soak.toml", 2, "", defaults);
    let text = std::fs::read_to_string(plain).unwrap();
    let missing = USUAL.iter().filter(|(key, _)| !soak.contains(key));
    let lines: String = missing.map(|(key, value)| format!("{key} = {value}\n")).collect();
    let axes = "[[soak.axis]]\ndrive = \"d0\"\ntargets = [100, 120]\npause = \"100ms\"\n";
    machine.write("soak.toml", format!("{text}{axes}[soak.criteria]\n{lines}{soak}\n"))
}

fn soak(config: &Path, arguments: &[&str]) -> Program {
    let own = ["soak", config.to_str().unwrap()];
    Program::start(own.iter().chain(arguments))
}

/// A test that ends at a signal, once its first axis has moved.
fn start(config: &Path, place: &Path, more: &[&str]) -> Program {
    let arguments =
        ["--for", "1h", "--checkpoint", "200ms", "--json", "--directory", place.to_str().unwrap()];
    soak(config, &[&arguments, more].concat())
}

fn checkpoint(place: &Path) -> Option<Value> {
    serde_json::from_str(&std::fs::read_to_string(place.join("checkpoint.json")).ok()?).ok()
}

/// Waits for a checkpoint in which this holds.
#[track_caller]
fn await_checkpoint(place: &Path, done: impl Fn(&Value) -> bool) -> Value {
    let mut last = None;
    let mut come = || {
        last = checkpoint(place);
        last.as_ref().is_some_and(&done)
    };
    assert!(until(LONG, &mut come), "{}", last.map_or(String::new(), |last| last["axes"].to_string()));
    last.unwrap()
}

fn moves(checkpoint: &Value) -> u64 {
    checkpoint["axes"][0]["cycles"].as_u64().unwrap_or(0)
}

fn failed(verdict: &Value) -> Vec<&str> {
    let criteria = verdict["criteria"].as_array().unwrap().iter();
    criteria.filter(|one| one["passed"] == false).filter_map(|one| one["criterion"].as_str()).collect()
}

#[test]
fn a_test_moves_its_axes_and_ends_with_a_verdict_and_a_page() {
    let machine = Machine::new(191);
    let config = config(&machine, "", "");
    let _sim = serve(&config);
    let place = machine.path("soak");
    let program = start(&config, &place, &[]);
    // A second master cannot start, and leaves nothing behind.
    await_checkpoint(&place, |all| moves(all) >= 1);
    let other = machine.path("other");
    let second = start(&config, &other, &[]).end();
    second.expect(2);
    assert!(second.err.contains("is in use by another master") && !other.exists(), "{second:?}");
    await_checkpoint(&place, |all| moves(all) >= 3 && all["axes"][1]["cycles"].as_u64() > Some(0));
    let ended = program.end_by(SIGINT);
    ended.expect(0);
    let verdict = ended.json();
    assert_eq!((&verdict["passed"], failed(&verdict)), (&Value::Bool(true), vec![]));
    assert!(moves(&verdict) >= 3 && verdict["ran_ns"].as_u64() < verdict["length_ns"].as_u64());
    assert!(ended.err.contains("axis d0: moves to 100, 120 mm"), "{}", ended.err);
    assert!(ended.err.contains("axis d1: moves to 160, 240 mm"), "{}", ended.err);
    assert_powered_off(&verdict["summary"]);
    let html = std::fs::read_to_string(place.join("index.html")).unwrap();
    assert!(
        html.contains("soak.toml") && html.contains(">Criteria<") && html.contains("following error (mm)")
    );

    // Its page is not replaced by that of a run.
    let report = place.to_str().unwrap();
    run(["run", config.to_str().unwrap(), "--report", report])
        .refused(&["a soak test keeps", "name another"]);
    // The same again is refused; a shorter one is compared with it.
    start(&config, &place, &[]).end().refused(&["holds a soak test already", "--resume"]);
    let base = place.join("run.json");
    let program = start(&config, &other, &["--compare", base.to_str().unwrap()]);
    await_checkpoint(&other, |all| moves(all) >= 1 && all["axes"][1]["cycles"].as_u64() > Some(0));
    let ended = program.end_by(SIGINT);
    ended.expect(0);
    let compared = &ended.json()["compared"][0];
    assert_eq!((&compared["with"], &compared["differences"]), (&"soak".into(), &json!([])));
}

#[test]
fn a_test_that_is_killed_goes_on_from_its_checkpoint_to_one_verdict() {
    let machine = Machine::new(192);
    let config = config(&machine, "", "");
    let sim = simulation(&config);
    let place = machine.path("soak");
    let directory = place.to_str().unwrap();
    let killed = start(&config, &place, &[]);
    let before = await_checkpoint(&place, |all| moves(all) >= 3);
    killed.kill();
    let last = checkpoint(&place).expect("a checkpoint is whole, whenever its writer is killed");
    let planned = |all: &Value| all["run"]["counts"]["planned"].as_u64().unwrap();
    assert!(planned(&last) >= planned(&before));

    let program = soak(&config, &["--resume", directory, "--checkpoint", "200ms", "--json"]);
    await_checkpoint(&place, |all| moves(all) >= moves(&last) + 3);
    let ended = program.end_by(SIGINT);
    ended.expect(0);
    let verdict = ended.json();
    assert!(verdict["passed"] == true && verdict["processes"].as_array().unwrap().len() == 2, "{verdict}");
    assert_eq!(verdict["length_ns"], 3_600_000_000_000_u64);
    let all = checkpoint(&place).unwrap();
    let here = verdict["summary"]["cycle"]["planned"].as_u64().unwrap();
    assert_eq!(planned(&all), planned(&last) + here, "counts add up");
    assert_eq!(verdict["processes"][1]["from_ns"], last["processes"][0]["ran_ns"]);
    let html = std::fs::read_to_string(place.join("index.html")).unwrap();
    assert!(html.contains("in 2 processes, with ") && html.contains("that nothing was measured in"));

    // It has run for so long already.
    let ended = soak(&config, &["--resume", directory, "--for", "1ms"]).end();
    ended.refused(&["have passed", "a longer --for goes on"]);
    // Another configuration.
    let text = std::fs::read_to_string(&config).unwrap();
    let other = machine.write("soak.toml", text.replacen("pause = \"100ms\"", "pause = \"200ms\"", 1));
    let line = text.lines().position(|line| line.starts_with("pause")).unwrap() + 1;
    let ended = soak(&other, &["--resume", directory]).end();
    ended.refused(&["was begun with another configuration", &format!("line {line} differs")]);
    // A broken one, and none.
    machine.write("soak.toml", &text);
    let file = place.join("checkpoint.json");
    let whole = std::fs::read_to_string(&file).unwrap();
    for (broken, why) in [
        (&whole[..whole.len() / 2], "is damaged: "),
        ("{}", "is damaged: missing field"),
        (&whole.replacen("\"format\":1", "\"format\":9", 1), "of another version of this program"),
    ] {
        std::fs::write(&file, broken).unwrap();
        soak(&config, &["--resume", directory]).end().refused(&["checkpoint.json", why, "begin a new test"]);
    }
    let none = machine.path("none");
    soak(&config, &["--resume", none.to_str().unwrap()]).end().refused(&["cannot read", "--resume names"]);
    drop(sim);
}

#[test]
fn a_lost_drive_fails_by_name_at_once_if_that_is_wanted() {
    let machine = Machine::new(193);
    let config = config(&machine, Machine::LOST_SOON, "");
    let sim = simulation(&config);
    let place = machine.path("soak");
    let program = start(&config, &place, &["--fail-fast"]);
    await_checkpoint(&place, |all| moves(all) >= 1);
    drop(sim);
    let ended = program.end();
    ended.expect(1);
    let verdict = ended.json();
    assert!(failed(&verdict).contains(&"lost_links"), "{verdict}");
    // That the axes move no longer may be seen only after the test has ended by that.
    for line in ["ends at once: ", "fieldbeat: lost_links: 2, at most 0; d0, d1"] {
        assert!(ended.err.contains(line), "{line}: {}", ended.err);
    }
}

#[test]
fn an_axis_that_was_given_up_is_known_after_a_kill_however_rare_checkpoints_are() {
    let machine = Machine::new(225);
    let config = config(&machine, Machine::LOST_SOON, "");
    let sim = simulation(&config);
    let place = machine.path("soak");
    let directory = place.to_str().unwrap();
    let killed = soak(&config, &["--for", "2h", "--checkpoint", "1h", "--directory", directory]);
    await_status(&config, |summary| {
        ["d0", "d1"].iter().all(|name| drive(summary, name)["state"] == "OperationEnabled")
    });
    drop(sim);
    let given_up = |all: &Value, index: usize| all["axes"][index]["given_up"] == "stopped: link lost";
    await_checkpoint(&place, |all| given_up(all, 0) && given_up(all, 1));
    killed.kill();

    let _sim = simulation(&config);
    let mut program = soak(&config, &["--resume", directory, "--json"]);
    program.await_text("axis d0: moves no longer, as before the pause: stopped: link lost");
    await_status(&config, |summary| drive(summary, "d0")["link"] == "online");
    let ended = program.end_by(SIGINT);
    ended.expect(1);
    assert!(failed(&ended.json()).contains(&"stops"), "{}", ended.out);
}

/// As on a full disk: the first checkpoint is small enough, and no later one is.
#[test]
fn a_disk_that_takes_no_checkpoint_ends_no_test_and_fails_it_by_name() {
    let machine = Machine::new(196);
    let config = config(&machine, "", "");
    let _sim = serve(&config);
    let place = machine.path("soak");
    let mut limited = Command::new("sh");
    limited.args(["-c", "ulimit -f 12 && exec \"$0\" \"$@\"", PROGRAM, "soak"]).arg(&config);
    limited.args(["--for", "1h", "--checkpoint", "200ms", "--json", "--directory"]).arg(&place);
    let mut program = Program::spawn(&mut limited);
    program.await_text("checkpoint not written: File too large");
    let moved = |summary: &Value| drive(summary, "d0")["answered"].as_u64() > Some(100);
    await_status(&config, moved);
    let ended = program.end_by(SIGINT);
    ended.expect(1);
    assert!(failed(&ended.json()).contains(&"files_lost"), "{}", ended.out);
    for line in ["files_lost: ", "the report is not written: File too large", "look at that disk"] {
        assert!(ended.err.contains(line), "{line}: {}", ended.err);
    }
    // The first checkpoint is whole still.
    assert_eq!(checkpoint(&place).unwrap()["length_ns"], 3_600_000_000_000_u64);
}

#[test]
fn missing_or_wrong_soak_options_are_refused_in_one_line_before_the_start() {
    let machine = Machine::new(195);
    let config = config(&machine, "", "");
    let far = std::fs::read_to_string(&config).unwrap().replacen("[100, 120]", "[100, 401]", 1);
    let far = machine.write("far.toml", far);
    let place = machine.path("soak");
    let (base, inside) = (machine.path("base.json"), machine.write("file", "mine").join("soak"));
    let [directory, none, inside] = [&place, &base, &inside].map(|path| path.to_str().unwrap());
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = port.local_addr().unwrap().to_string();
    let for_1s = "--for=1s";
    for (config, arguments, parts) in [
        (&config, &["--directory", directory][..], &["--for"][..]),
        (&config, &["--directory", directory, "--for", "0s"], &["--for 0s leaves no time"]),
        (&config, &[for_1s, "--directory", directory, "--compare", none], &["cannot read", "base.json"]),
        // A port that is not to be had.
        (&config, &[for_1s, "--directory", directory, "--metrics", &address], &[&*address]),
        (&config, &[for_1s, "--directory", inside], &["cannot write there"]),
        (&far, &[for_1s], &["soak.axis.targets", "position 401 is outside its limit (0 ... 400)"]),
    ] {
        soak(config, arguments).end().refused(parts);
        assert!(!place.exists(), "nothing was begun");
    }
    // A report that it would replace.
    std::fs::create_dir(&place).unwrap();
    for held in ["index.html", "run.json"] {
        let file = machine.write(&format!("soak/{held}"), "mine");
        soak(&config, &[for_1s, "--directory", directory])
            .end()
            .refused(&["holds a report already", "name another directory"]);
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "mine");
        std::fs::remove_file(file).unwrap();
    }
}
