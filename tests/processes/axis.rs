//! Commands of single axes from the shell: scripts of them, what ends one in mid-motion, and all the reasons why one is
//! refused.

use std::path::Path;
use std::time::Duration;

use fieldbeat_control::Operator;
use libc::{SIGCONT, SIGINT, SIGTERM};
use serde_json::json;

use super::operate::{
    AXES, SPEED, assert_rest, await_axis, config, is_left, moves, online, operator, seen, socket_of,
};
use super::support::{Ended, LONG, Machine, Program, until};
use super::{assert_left, assert_silent, master, serve, simulation, socket, wires};

/// `fieldbeat axis CONFIG WORDS` under way.
fn axis(config: &Path, words: &str) -> Program {
    let words = words.split(' ').map(str::to_owned);
    let config = config.to_str().unwrap().to_owned();
    Program::start(["axis".to_owned(), config].into_iter().chain(words))
}

/// The host has held the process up for so long that its master has ended what it did.
fn is_late(ended: &Ended) -> bool {
    ["silent for too long", "jog not held"].iter().any(|late| ended.err.contains(late))
}

/// It prints that; a position in it to a twentieth of its unit.
fn shows(ended: &Ended, shown: &str) -> bool {
    let parts = |text: &str| {
        let (before, place) = text.trim_end().split_once(" at ")?;
        let (number, unit) = place.split_once(' ')?;
        Some((before.to_owned(), number.parse::<f64>().ok()?, unit.to_owned()))
    };
    match (parts(&ended.out), parts(shown)) {
        (Some(out), Some(shown)) => out.0 == shown.0 && out.2 == shown.2 && (out.1 - shown.1).abs() < 0.05,
        _ => ended.out.contains(shown),
    }
}

/// Runs these commands one after the other, each with what it prints; a late host begins again.
#[track_caller]
fn script(config: &Path, commands: &[(&str, &str)]) -> Vec<Ended> {
    let mut ends = Vec::new();
    let done = until(LONG, || {
        ends.clear();
        for (words, shown) in commands {
            let ended = axis(config, words).end();
            if is_late(&ended) {
                return false;
            }
            assert_eq!((ended.code, ended.err.as_str()), (Some(0), ""), "{words}: {ended:?}");
            assert!(shows(&ended, shown), "{words}: {ended:?}");
            ends.push(ended);
        }
        true
    });
    assert!(done, "{ends:?}");
    ends
}

/// Brings axis 0 into operation, homed.
#[track_caller]
fn ready(config: &Path) {
    script(config, &[("d0 reset", ""), ("d0 enable", "OperationEnabled"), ("d0 home", "OperationEnabled")]);
}

/// Whoever looks on. A master ends a conversation that is silent for long, so that each look has its own.
fn watch(path: &Path) -> Operator {
    Operator::remote(path).unwrap()
}

/// A move of axis 0 that takes minutes, once it moves.
#[track_caller]
fn long_move(config: &Path, path: &Path) -> Program {
    ready(config);
    let under_way = axis(config, &format!("d0 move-by 2000 --velocity {SPEED}"));
    await_axis(&mut watch(path), moves);
    under_way
}

#[test]
fn a_script_of_commands_goes_on_where_the_one_before_has_ended() {
    let machine = Machine::new(166);
    let lines = AXES.replace("limits = {", "limits = { position = [-100, 100],");
    let file = format!("script-{}.toml", std::process::id());
    let config = machine.config(&file, 2, "", &lines);
    let _drives = serve(&config);
    let master = master(&config, &["--allow-control"]);
    let path = socket_of(&config);
    let ends = script(
        &config,
        &[
            ("d0 disable", "axis d0: power off"),
            ("d0 enable", "axis d0: OperationEnabled at "),
            ("d0 home", "axis d0: OperationEnabled at "),
            ("d0 move-to -20 --velocity 100", "axis d0: OperationEnabled at -20 mm"),
            ("d0 move-by -5.5 --velocity 100 --acceleration 500", "axis d0: OperationEnabled at -25.5 mm"),
            ("d0 move-by 5e-1 --json", ""),
            ("d0 jog 20 --for 300ms", "axis d0: OperationEnabled at "),
            ("d0 stop", "axis d0: OperationEnabled at "),
            ("d0 enable", "axis d0: OperationEnabled at "),
            ("d1 move-to 3 --enable --home", "axis d1: OperationEnabled at 3 mm"),
        ],
    );
    let said = ends[5].json();
    assert_eq!(
        [&said["axis"], &said["command"], &said["end"], &said["text"], &said["powered"], &said["unit"]],
        [&json!("d0"), &json!("move-by"), &json!("done"), &json!("move done"), &json!(true), &json!("mm")]
    );
    assert!((said["position"].as_f64().unwrap() + 25.0).abs() < 0.1, "{said}");
    // Nobody operates, and nothing moves; both have power until it is taken.
    std::thread::sleep(Duration::from_millis(1_500));
    let state = seen(&mut watch(&path));
    assert_eq!(state.operator, None);
    assert!(state.axes.iter().all(|axis| axis.operational && axis.commands.is_empty()), "{state:?}");
    script(&config, &[("d0 disable", "axis d0: power off at "), ("d1 disable", "axis d1: power off at ")]);
    master.end_by(SIGTERM).expect(0);
}

#[test]
fn any_end_of_axis_in_mid_motion_stops_the_axis_and_removes_power() {
    let machine = Machine::new(167);
    let config = config(&machine, "away");
    let _drives = serve(&config);
    let _master = master(&config, &["--allow-control"]);
    let path = socket_of(&config);
    await_axis(&mut watch(&path), online);
    let is_left_at_rest = || {
        await_axis(&mut watch(&path), is_left);
        assert_rest(&mut watch(&path));
        assert!(is_left(&seen(&mut watch(&path))));
    };
    long_move(&config, &path).kill();
    is_left_at_rest();
    let interrupted = long_move(&config, &path).end_by(SIGINT);
    if !is_late(&interrupted) {
        interrupted.failed(&["interrupted; axis d0: power off at "]);
    }
    is_left_at_rest();
    let held = long_move(&config, &path);
    held.hold();
    is_left_at_rest();
    held.end_by(SIGCONT).failed(&["this command was silent for too long"]);
    is_left_at_rest();
    // A jog is held by its process alone.
    ready(&config);
    let jog = axis(&config, &format!("d0 jog {SPEED} --for 10min"));
    await_axis(&mut watch(&path), moves);
    jog.kill();
    is_left_at_rest();
    // A stop from elsewhere: the axis stays enabled, and its command is not done.
    let under_way = long_move(&config, &path);
    let stop = axis(&config, "d0 stop").end();
    let ended = under_way.end();
    assert_eq!((stop.code, stop.err.as_str()), (Some(0), ""), "{stop:?}");
    if !is_late(&ended) {
        ended.failed(&["axis d0: move ended by a stop"]);
        assert!(seen(&mut watch(&path)).axes[0].operational);
    }
    assert_rest(&mut watch(&path));
}

#[test]
fn a_command_that_is_refused_says_in_a_line_what_to_do() {
    let machine = Machine::new(168);
    let file = format!("refused-{}.toml", std::process::id());
    // Its LinMots have no watchdog, and do not jog.
    let config = machine.config(&file, 2, "", "stop.timeout = \"20s\"");
    let typed = format!("`fieldbeat axis {} d0 ", config.display());
    let refused = |words: &str, parts: &[&str]| axis(&config, words).end().failed(parts);
    let wrong = |words: &str, parts: &[&str]| axis(&config, words).end().refused(parts);

    // Before anything is sent.
    wrong("d7 enable", &["has no axis d7; it has d0, d1"]);
    wrong("d0 move-to ten", &["must be a number"]);
    wrong("d0 move-to inf", &["must be a number"]);
    wrong("d0 move-to 1 --velocity -5", &["must be a number above 0"]);
    wrong("d0 move-by 1 --acceleration 0", &["must be a number above 0"]);
    wrong("d0 jog 5", &["--for"]);
    wrong("d0 jog 5 --for soon", &["--for"]);
    axis(Path::new("/nowhere.toml"), "d0 enable").end().refused(&["/nowhere.toml"]);

    // No master runs.
    let drive = socket(machine.drive(0));
    let run = format!("`fieldbeat run {} --allow-control` takes this command", config.display());
    let missing = ["no master of", &run];
    refused("d0 enable", &missing);
    for words in ["d0 home", "d0 move-to 10", "d0 move-by 1 --home", "d0 jog 5 --for 1s"] {
        refused(words, &[&missing[..], &["add --enable: then this command is the master"]].concat());
    }
    refused("d0 stop --pid 1", &["no master of", "with pid 1 runs"]);
    assert_silent(&drive);
    drop(drive);

    // One that lets nobody operate.
    let _drives = serve(&config);
    let closed = master(&config, &[]);
    socket_of(&config);
    for words in ["d0 enable", "d0 stop"] {
        refused(words, &["start it with `fieldbeat run CONFIG --allow-control`"]);
    }
    closed.end_by(SIGTERM);

    // The state of the axis.
    let open = master(&config, &["--allow-control"]);
    let path = socket_of(&config);
    await_axis(&mut watch(&path), online);
    refused(
        "d0 move-to 10",
        &["axis d0 is not enabled: ", &format!("{typed}enable` first, or add --enable")],
    );
    refused("d0 home", &["axis d0 is not enabled: "]);
    refused("d0 jog 5 --for 1s --enable", &["axis d0 does not jog: ", "no_drive_watchdog"]);
    for words in ["d0 move-to 500 --enable --home", "d0 move-to -1 --json"] {
        let ended = axis(&config, words).end();
        ended.expect(1);
        assert!(ended.err.contains("is outside its limit (0 ... 400)"), "{ended:?}");
    }
    refused("d0 move-by 1 --velocity 1e6 --enable", &["velocity 1000000 is outside its limit"]);
    assert!(!seen(&mut watch(&path)).axes[0].powered, "no power came on for what cannot be");
    script(&config, &[("d0 enable", "OperationEnabled")]);
    if seen(&mut watch(&path)).axes[0].operational {
        refused("d0 move-to 10", &["is not homed: ", &format!("{typed}home` first, or add --home")]);
    }

    // Somebody else.
    let mut other = operator(&path, "a panel");
    let number = other.command(0, fieldbeat_control::Order::step(300.0, 1.0)).unwrap();
    let named = ["a panel operates this master: end that first"];
    let mut ended = None;
    let alive = until(LONG, || {
        let under_way = ended.get_or_insert_with(|| axis(&config, "d0 enable"));
        let _ = other.state(u64::MAX);
        !under_way.is_running()
    });
    assert!(alive && number > 0);
    let ended = ended.unwrap().end();
    if seen(&mut watch(&path)).operator.is_some() {
        ended.failed(&named);
    }
    drop(other);
    await_axis(&mut watch(&path), is_left);

    // A latched axis, and a master that has died.
    script(&config, &[("d0 enable", "OperationEnabled")]);
    open.kill();
    refused("d0 enable", &["has died, only its socket is left; start it again with `fieldbeat run`"]);
    refused("d0 move-to 10", &["has died, only its socket is left", "add --enable"]);
}

#[test]
fn a_fault_is_named_and_reset_from_the_shell() {
    let machine = Machine::new(169);
    // It meets its mechanical end far inside of its limits.
    let lines = format!("{AXES}\nsimulate = {{ range = [0, 60], home = 0, start = 10 }}");
    let file = format!("fault-axis-{}.toml", std::process::id());
    let config = machine.config(&file, 2, "", &lines);
    let _drives = serve(&config);
    let _master = master(&config, &["--allow-control"]);
    let path = socket_of(&config);
    await_axis(&mut watch(&path), online);
    let mut ended = None;
    let faulty = until(LONG, || {
        ready(&config);
        let end = axis(&config, "d0 move-by 300 --velocity 40 --json").end();
        let is_late = is_late(&end);
        ended = Some(end);
        !is_late
    });
    let ended = ended.filter(|_| faulty).unwrap();
    ended.expect(1);
    let said = ended.json();
    assert_eq!((&said["end"], &said["stopped"]), (&json!("aborted"), &json!("drive fault")), "{said}");
    assert!(ended.err.starts_with("fieldbeat: axis d0: move aborted: "), "{}", ended.err);
    let refused = axis(&config, "d0 enable").end();
    refused.failed(&["axis d0 has fault ", "remove its cause, then `fieldbeat axis ", " d0 reset`"]);
    // Where the drive is exchanged with too seldom the reset may fail, and says so.
    assert!(until(LONG, || axis(&config, "d0 reset").end().code == Some(0)));
    script(&config, &[("d0 enable", "OperationEnabled"), ("d0 disable", "power off")]);
}

#[test]
fn alone_a_command_is_the_master_and_ends_with_power_off() {
    let machine = Machine::new(171);
    let config = config(&machine, "own");
    let _drives = serve(&config);
    let done = |words: &str, shown: &str| {
        let mut last = None;
        let done = until(LONG, || {
            let ended = axis(&config, words).end();
            let late = is_late(&ended);
            last = Some(ended);
            !late
        });
        let ended = last.filter(|_| done).unwrap();
        assert_eq!(ended.code, Some(0), "{words}: {ended:?}");
        assert!(shows(&ended, shown), "{words}: {ended:?}");
        ended
    };
    done("d0 move-to 30 --velocity 200 --enable --home", "axis d0: power off at 30 mm");
    let said = done("d0 move-by -10 --velocity 200 --enable --json", "").json();
    assert_eq!([&said["end"], &said["powered"]], [&json!("done"), &json!(false)], "{said}");
    assert!((said["position"].as_f64().unwrap() - 20.0).abs() < 0.1, "{said}");
    done(&format!("d0 jog {SPEED} --for 300ms --enable"), "axis d0: power off at ");
    for words in ["d0 stop", "d0 disable", "d0 reset"] {
        done(words, "axis d0: power off at ");
    }
    // Ctrl-C in mid-motion.
    let under_way = axis(&config, &format!("d0 move-by 2000 --velocity {SPEED} --enable"));
    let path = socket_of(&config);
    await_axis(&mut watch(&path), moves);
    // Another command finds this one.
    axis(&config, "d0 disable").end().failed(&["fieldbeat axis (pid ", "operates this master"]);
    let ended = under_way.end_by(SIGINT);
    if !is_late(&ended) {
        ended.expect(1);
        assert!(ended.err.contains("interrupted; axis d0: power off at "), "{ended:?}");
    }
}

#[test]
fn a_drive_that_cannot_be_stopped_is_named_by_the_command_that_was_its_master() {
    let machine = Machine::new(176);
    let config = wires::faulty(&machine, "turns-on.toml");
    let _sim = simulation(&config);
    // It turns when the master comes, which stops it, and takes no stop.
    let ended = axis(&config, "feeder stop").end();
    assert_left(&ended, &["feeder"]);
}
