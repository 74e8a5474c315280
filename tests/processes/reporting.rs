//! The reports of a master while it runs, and after something failed: its control socket, its black box, and its
//! service manager.

use std::fs::{self, DirBuilder};
use std::net::UdpSocket;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use fieldbeat::Master;
use fieldbeat::axis::{AxisError, StopCause};
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::telemetry::Summary;
use fieldbeat_control::Server;
use libc::{SIGTERM, SIGUSR1};
use serde_json::{Value, json};

use super::fuse::{Call, Fused};
use super::support::hold::{Hold, thread};
use super::support::{
    Ended, LONG, Machine, NOBODY, PROGRAM, Program, as_ordinary_user, checkout, plan, run, until,
};
use super::{ask, assert_silent, metrics, patient_cycle, simulation, socket, with_drives};

/// A command of the program whose sockets and files are the machine's own.
fn own(machine: &Machine, arguments: &[&str]) -> Command {
    let mut command = Command::new(PROGRAM);
    command
        .args(arguments)
        .env("XDG_RUNTIME_DIR", machine.path("run"))
        .env("XDG_STATE_HOME", machine.path("state"))
        // Where root looks for those of other users.
        .env("TMPDIR", machine.path("run"));
    fs::create_dir_all(machine.path("run")).unwrap();
    command
}

fn master(machine: &Machine, config: &Path, arguments: &[&str]) -> Program {
    let mut master = Program::spawn(own(machine, &["run", config.to_str().unwrap()]).args(arguments));
    master.await_text("all drives online");
    master
}

fn status(machine: &Machine, arguments: &[&str]) -> Ended {
    Program::spawn(own(machine, &["status"]).args(arguments)).end()
}

fn sockets(machine: &Machine) -> Vec<PathBuf> {
    fs::read_dir(machine.path("run/fieldbeat")).unwrap().map(|entry| entry.unwrap().path()).collect()
}

#[test]
fn a_running_master_answers_its_owner_a_dead_one_is_called_dead_and_an_open_directory_gets_no_socket() {
    let machine = Machine::new(40);
    let config = machine.plain(2);
    let text = config.to_str().unwrap();
    status(&machine, &[]).failed(&["no master runs; ", "fieldbeat run"]);
    status(&machine, &[text]).failed(&["no master of", text]);
    let _sim = simulation(&config);
    let start = |arguments: &[&str]| master(&machine, &config, arguments);
    let master = start(&[]);
    for arguments in [&["--json"][..], &[text, "--json"]] {
        let ended = status(&machine, arguments);
        let status = ended.expect(0).json();
        assert_eq!(
            (status["pid"].as_u64(), status["config"].as_str()),
            (Some(u64::from(master.pid())), Some(text))
        );
        let summary = &status["summary"];
        assert!(summary["cycle"]["executed"].as_u64().unwrap() > 0, "{summary}");
        assert_eq!(summary["drives"][1]["link"], "online");
    }
    let reported = status(&machine, &[]).expect(0).out.clone();
    assert!(
        reported.contains(&format!("pid {}", master.pid())) && reported.contains("wake-up latency"),
        "{reported}"
    );
    let [socket] = &sockets(&machine)[..] else { panic!() };
    assert_eq!(fs::metadata(socket).unwrap().permissions().mode() & 0o777, 0o600);
    assert_eq!(fs::metadata(socket.parent().unwrap()).unwrap().permissions().mode() & 0o777, 0o700);

    // A screen follows the master to its end.
    let mut watching = Program::spawn(&mut own(&machine, &["status", "--watch", "100ms", "--json"]));
    assert!(until(LONG, || watching.out().lines().count() >= 3));
    assert!(watching.is_running());
    master.end_by(SIGTERM).expect(0);
    let ended = watching.end();
    ended.expect(1);
    assert!(ended.err.contains("the master has ended"), "{ended:?}");
    let executed = |line: &str| {
        let status: Value = serde_json::from_str(line).unwrap();
        status["summary"]["cycle"]["executed"].as_u64().unwrap()
    };
    let counts: Vec<u64> = ended.out.lines().map(executed).collect();
    assert!(counts.is_sorted() && counts[0] < counts[counts.len() - 1], "{counts:?}");
    assert!(sockets(&machine).is_empty());

    // One that died is called dead, and the next one takes its place.
    start(&[]).kill();
    status(&machine, &[text]).failed(&["has died, only its socket is left", "start it again"]);
    let again = start(&[]);
    assert_eq!(status(&machine, &[text, "--json"]).expect(0).json()["pid"], again.pid());
    again.end_by(SIGTERM).expect(0);
    // A directory that others may write to gets no socket, and the run goes on.
    fs::set_permissions(machine.path("run/fieldbeat"), PermissionsExt::from_mode(0o777)).unwrap();
    let ended = start(&["--json"]).end_by(SIGTERM);
    ended.expect(0).json();
    assert!(
        ended.err.contains("no `fieldbeat status`") && ended.err.contains("run `chmod 700 /"),
        "{}",
        ended.err
    );
    assert!(sockets(&machine).is_empty());
}

/// Somebody who answers like a master of this process id and configuration.
fn answering(machine: &Machine, socket: &str, pid: u32, config: Option<&str>) -> Server {
    let directory = machine.path("run/fieldbeat");
    DirBuilder::new().mode(0o700).recursive(true).create(&directory).unwrap();
    let status = json!({ "pid": pid, "version": "0", "config": config, "text": "", "summary": {} });
    let answer = move |question: &Value| match question["ask"].as_str() {
        Some("status") => Ok(status.clone()),
        _ => Err(format!("this is {pid}")),
    };
    Server::start(&directory.join(socket), || {}, move || answer.clone()).unwrap()
}

#[test]
fn demos_are_found_by_their_configuration_and_distinguished_by_their_process() {
    let machine = Machine::new(127);
    let demo = checkout("rt-config/demo.toml").to_str().unwrap().to_owned();
    let pid = |arguments: &[&str]| {
        status(&machine, &[arguments, &["--json"]].concat()).expect(0).json()["pid"].clone()
    };
    let get = |more: &[&str]| {
        let all = [&["param", "get", &demo, "a1", "0x20A8"], more].concat();
        Program::spawn(&mut own(&machine, &all)).end()
    };
    let _one = answering(&machine, "demo.sock", 11, None);
    for arguments in [&[][..], &[&*demo], &["--pid", "11"], &[&*demo, "--pid", "11"]] {
        assert_eq!(pid(arguments), 11, "{arguments:?}");
    }
    get(&[]).failed(&["this is 11"]);

    let _other = answering(&machine, "demo-2.sock", 12, Some("rt-config/demo.toml"));
    let _machine = answering(&machine, "demo-01234567.sock", 13, Some("/etc/demo.toml"));
    let both =
        ["several masters run: ", "rt-config/demo.toml (pid 12)", "the demo (pid 11)", "choose one by --pid"];
    status(&machine, &[&demo]).refused(&both);
    get(&[]).refused(&both);
    status(&machine, &[]).refused(&["(pid 11)", "(pid 12)", "/etc/demo.toml (pid 13)"]);
    assert_eq!(pid(&["--pid", "13"]), 13);
    assert_eq!(pid(&[&demo, "--pid", "12"]), 12);
    get(&["--pid", "12"]).failed(&["this is 12"]);
    status(&machine, &[&demo, "--pid", "13"]).failed(&["with pid 13 runs", "(pid 11)"]);
    get(&["--pid", "14"]).failed(&["no master of ", "demo.toml with pid 14 runs"]);
}

#[test]
fn the_master_of_another_configuration_is_named_as_such() {
    let machine = Machine::new(126);
    let config = machine.plain(1);
    let text = config.to_str().unwrap();
    let _other = answering(&machine, "press-01234567.sock", 21, Some("/etc/press.toml"));
    let no = format!("no master of {text} runs; the master of /etc/press.toml (pid 21) runs\n");
    let ended = status(&machine, &[text]);
    ended.failed(&[]);
    assert_eq!(ended.err, format!("fieldbeat: {no}"));
    // Its sockets are the reason why this one cannot have its own: the one that stands in the way is named.
    let _taken = UdpSocket::bind(machine.master()).unwrap();
    let ended = Program::spawn(&mut own(&machine, &["param", "get", text, "d0", "0x20A8"])).end();
    ended.refused(&["cannot bind", "the master of /etc/press.toml (pid 21) runs"]);
}

#[test]
fn a_running_demo_is_found_from_anywhere() {
    let machine = Machine::new(184);
    let demo = checkout("rt-config/demo.toml").to_str().unwrap().to_owned();
    let arguments = ["demo", "--drives", "1", "--period", "8ms", "--for", "60s"];
    // In a directory that has no such file.
    let mut program = Program::spawn(own(&machine, &arguments).current_dir(machine.path("run")));
    program.await_text("all drives online");
    assert_eq!(status(&machine, &[&demo, "--json"]).expect(0).json()["pid"], program.pid());
    assert_eq!(status(&machine, &["--json"]).expect(0).json()["pid"], program.pid());
    let get = ["param", "get", &demo, "a1", "0x20A8"];
    let ended = Program::spawn(&mut own(&machine, &get)).end();
    assert_eq!(ended.expect(0).out, "a1 0x20A8: 7695 (0x1E0F)\n");
}

#[test]
#[ignore = "needs root: asks the master of another user"]
fn root_finds_the_master_of_another_user() {
    let (machine, config, _sim) = with_drives(48, 1);
    let shared = machine.path("run");
    fs::create_dir(&shared).unwrap();
    fs::set_permissions(&shared, PermissionsExt::from_mode(0o1777)).unwrap();
    let mut command = as_ordinary_user(&machine);
    // Without a login: its directory is one for temporary files.
    command.arg("run").arg(&config).env("TMPDIR", &shared).env("XDG_RUNTIME_DIR", "");
    let mut master = Program::spawn(&mut command);
    master.await_text("all drives online");
    assert!(shared.join(format!("fieldbeat-{NOBODY}")).is_dir());
    for arguments in [&["--json"][..], &[config.to_str().unwrap(), "--json"]] {
        assert_eq!(status(&machine, arguments).expect(0).json()["pid"], master.pid());
    }
}

/// The files of a machine's black box, oldest first.
fn files(directory: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> =
        fs::read_dir(directory).into_iter().flatten().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "mcap"));
    files
}

fn blackbox(path: &Path, arguments: &[&str]) -> Ended {
    run([["blackbox", path.to_str().unwrap()].as_slice(), arguments].concat())
}

#[test]
fn a_lost_drive_leaves_a_black_box_with_its_history() {
    let machine = Machine::new(44);
    let config = machine.config("m.toml", 2, "", "health = { bucket = \"400ms\", leak = 1 }");
    let sim = simulation(&config);
    let directory = machine.path("state/fieldbeat");
    let mut master = master(&machine, &config, &["--json"]);
    // While it has no more to tell than that all is well.
    master.signal(SIGUSR1);
    master.await_text("(requested, cycle ");
    sim.kill();
    // The first one that is lost: on a busy computer either of them may have missed a reply before.
    master.await_text(": link lost, cycle ");
    let said = |drive: &str| {
        format!("{}{}", master.out(), master.err()).contains(&format!("(drive {drive}: link lost"))
    };
    let first = if said("d0") { "d0" } else { "d1" };
    let ended = master.end_by(SIGTERM);
    let summary = ended.expect(1).json();
    let reported = summary["black_boxes"].as_array().unwrap();
    let files = files(&directory);
    assert!(files.len() >= 2 && reported.len() == files.len(), "{summary}");
    assert!(reported.iter().all(|one| one["error"].is_null() && one["path"].as_str().is_some()), "{summary}");

    let lost = reported.iter().find(|one| one["why"] == format!("drive {first}: link lost")).unwrap();
    let path = Path::new(lost["path"].as_str().unwrap());
    let story = blackbox(path, &["--json"]).expect(0).json();
    assert_eq!((&story["header"]["cycle"], &story["header"]["why"]), (&lost["cycle"], &lost["why"]));
    let happened = story["happened"].as_array().unwrap();
    let place = |drive: &str, what: &str, times: u64| {
        let found = happened.iter().position(|one| {
            one["drive"] == drive && one["what"] == what && one["times"].as_u64() >= Some(times)
        });
        found.unwrap_or_else(|| panic!("{drive}: {what}: {happened:#?}"))
    };
    for drive in ["d0", "d1"] {
        // The bucket holds 50. What a busy computer costs before that is in it, too.
        let (silent, lost) = (place(drive, "no reply", 20), place(drive, "link online -> lost", 1));
        assert!(silent < lost, "{happened:#?}");
    }
    assert_eq!(happened[place(first, "link online -> lost", 1)]["cycle"], lost["cycle"]);
    let text = blackbox(path, &["--cycles", &u64::MAX.to_string()]).expect(0).out.clone();
    let why = format!("drive {first}: link lost, in cycle");
    assert!(text.contains(&why) && text.contains("drive d1, mm"), "{text}");

    // Those that are damaged or none, and the list, which reads the begin of each, and looks for its end.
    let bytes = fs::read(path).unwrap();
    fs::write(directory.join("cut.mcap"), &bytes[..bytes.len() / 2]).unwrap();
    for (file, what) in [
        ("cut.mcap", "its end is missing"),
        ("none.mcap", "No such file"),
        ("", "not a recording of fieldbeat"),
    ] {
        blackbox(&directory.join(file), &[]).refused(&[file, what]);
    }
    let list = |rest: &[&str]| Program::spawn(own(&machine, &["blackbox", "--list"]).args(rest)).end();
    let text = list(&[]).expect(0).out.clone();
    let name = path.file_name().unwrap().to_str().unwrap();
    let row = text.lines().find(|line| line.contains(name)).unwrap();
    assert!(row.contains(config.to_str().unwrap()) && row.contains("link lost (cycle "), "{text}");
    assert!(text.contains(&format!(": {} black-box files\n", files.len() + 1)), "{text}");
    assert!(!text.contains('\x1b'), "{text}");
    let listing = list(&["--json"]).expect(0).json();
    let files = listing["files"].as_array().unwrap();
    let cut = files.iter().find(|file| file["file"] == "cut.mcap").unwrap();
    assert!(cut["bytes"].is_u64() && cut["error"].is_string(), "{listing}");
}

#[test]
fn monitored_values_are_in_status_and_gauges_while_reported() {
    let machine = Machine::new(49);
    let config = machine.showing();
    let sim = simulation(&config);
    let mut master = master(&machine, &config, &["--json", "--metrics", &format!("{}:0", machine.ip(1))]);
    let address = metrics::endpoint(&mut master);
    // Nothing but its timer says that a drive was set up to show it.
    let summary = || status(&machine, &["--json"]).expect(0).json()["summary"].clone();
    let goes_on =
        |timer: &Value| timer["min"].as_f64() > Some(0.0) && timer["min"].as_f64() < timer["max"].as_f64();
    assert!(until(LONG, || goes_on(&summary()["drives"][1]["monitor"][1])));
    let text = status(&machine, &[]).expect(0).out.clone();
    for part in [
        "\nd1    core-temperature   40 C, from 40 to 40\n",
        " us, from ",
        "0x9999             not received yet",
    ] {
        assert!(text.contains(part), "no {part}: {text}");
    }
    let summary = summary();
    assert_eq!(summary["drives"][0]["monitor"], json!([]));
    let [temperature, timer, unknown] = &summary["drives"][1]["monitor"].as_array().unwrap()[..] else {
        panic!("{summary}")
    };
    let reported =
        json!({ "name": "core-temperature", "unit": "C", "value": 40.0, "min": 40.0, "max": 40.0 });
    assert_eq!(*temperature, reported);
    let reported = json!({ "name": "0x9999", "unit": "", "value": null, "min": null, "max": null });
    assert_eq!(*unknown, reported);
    assert_eq!((&timer["name"], &timer["unit"]), (&json!("drive-timer"), &json!("us")));
    assert!(timer["value"] == timer["max"] && timer["min"].as_f64() < timer["max"].as_f64(), "{timer}");

    let page = metrics::Page::parse(&metrics::scrape(address));
    let gauges = |variable: &str, unit: &str| {
        let labels = format!("{{drive=\"d1\",variable=\"{variable}\",unit=\"{unit}\"}}");
        ["_min", "", "_max"].map(|family| page.value(&format!("fieldbeat_drive_monitor{family}{labels}")))
    };
    assert!(gauges("drive-timer", "us").is_sorted(), "{page:?}");
    assert_eq!(gauges("core-temperature", "C"), [40.0; 3]);
    assert_eq!(page.count("_monitor"), 6, "neither the other drive nor a variable that there is not");
    // A drive that was lost shows nothing, and what it has shown stays true.
    sim.kill();
    let mut page = page;
    assert!(until(LONG, || {
        page = metrics::Page::parse(&metrics::scrape(address));
        page.value("fieldbeat_axes_online") == 0.0
    }));
    assert_eq!(page.count("_monitor"), 4, "{page:?}");
    master.end_by(SIGTERM).expect(1);
}

#[test]
fn the_fault_of_a_drive_is_shown_with_the_move_that_led_to_it_and_in_its_error_log() {
    let machine = Machine::new(124);
    // It meets its mechanical end far inside of its limits.
    let config = machine.config("m.toml", 2, "", "simulate = { range = [0, 60], home = 0, start = 10 }");
    let _sim = simulation(&config);
    let directory = machine.path("boxes");
    let master = Master::from_plan(plan(&config)).with_black_box(&directory).start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axis = master.axis("d1").unwrap();
    axis.enable().unwrap();
    axis.home().unwrap();
    axis.move_to(300.0, axis.profile()).unwrap_err();
    let fault = axis.feedback().status.fault;
    assert!(fault != 0, "{:?}", axis.feedback());
    let run = master.finish();
    let [written] = &run.measured.black_boxes[..] else { panic!("{:?}", run.measured.black_boxes) };
    assert!(written.why.starts_with("drive d1: fault 0x") && written.error.is_none(), "{written:?}");
    let story = blackbox(&written.path, &["--json"]).expect(0).json();
    let happened = story["happened"].as_array().unwrap();
    let of = |what: &str| {
        let found = happened.iter().position(|one| {
            one["drive"] == "d1" && one["what"].as_str().is_some_and(|reported| reported.starts_with(what))
        });
        found.unwrap_or_else(|| panic!("{what}: {happened:#?}"))
    };
    assert!(of("move begins") < of("fault none -> ") && of("fault none -> ") <= of("stopped: drive fault"));
    assert!(!happened.iter().any(|one| one["drive"] == "d0" && one["what"] == "stopped: drive fault"));

    // And by its own error log.
    let log = ask("linmot errors", &config, "d1 --json").json();
    assert_eq!((&log["occurred"], &log["logged"]), (&1.into(), &1.into()), "{log}");
    let [entry] = &log["entries"].as_array().unwrap()[..] else { panic!("{log}") };
    assert_eq!((entry["code"].as_u64(), &entry["hours"]), (Some(fault.into()), &0.into()));
    assert!(entry["ms"].as_u64() > Some(0) && !entry["text"].as_str().unwrap().is_empty(), "{log}");
    let text = ask("linmot errors", &config, "d1").expect(0).out.clone();
    let line = format!("{fault:04X}h  {}", entry["text"].as_str().unwrap());
    assert!(text.starts_with("1 errors occurred, 1 are logged\n") && text.contains(&line), "{text}");
    assert_eq!(ask("linmot errors", &config, "d0").expect(0).out, "0 errors occurred, 0 are logged\n");
}

#[test]
fn an_unreachable_drive_is_reported_once_with_the_reason_in_status_and_metrics() {
    let machine = Machine::new(79);
    let address = format!("{}:1502", machine.ip(11));
    let config = machine.write(
        "m.toml",
        format!(
            "{}[[bus]]\nprotocol = \"modbus-tcp\"\n[[bus.drive]]\nname = \"u1\"\naddress = \
             \"{address}\"\nhealth = {{ bucket = \"10s\", leak = 1 }}\nwatchdog.timeout = \
             \"10s\"\nreply_within = \"5s\"\n",
            patient_cycle()
        ),
    );
    let arguments = ["run", config.to_str().unwrap(), "--json", "--metrics", &format!("{}:0", machine.ip(1))];
    let mut master = Program::spawn(&mut own(&machine, &arguments));
    let page = metrics::endpoint(&mut master);
    let sample = |metric: &str, more: &str| {
        let text = metrics::scrape(page);
        assert!(!text.contains("NaN"), "{text}");
        metrics::Page::parse(&text).value(&format!("fieldbeat_drive_{metric}{{drive=\"u1\"{more}}}"))
    };
    let reported = format!("drive u1: not connected: refused: nobody listens at {address}");
    master.await_text(&reported);
    let summary = || status(&machine, &["--json"]).expect(0).json()["summary"].clone();
    let why = summary()["drives"][0]["not_connected"].as_str().unwrap().to_owned();
    assert!(reported.ends_with(why.split(';').next().unwrap()), "{why}");
    assert_eq!(sample("not_connected", ""), 1.0);
    let _sim = simulation(&config);
    master.await_text("all drives online");
    let drive = &summary()["drives"][0];
    assert!(drive["not_connected"].is_null() && drive["position"].is_null(), "{drive}");
    assert!(until(LONG, || sample("not_connected", "") == 0.0));
    assert_eq!(sample("protocol_events_total", ",what=\"reopened\""), 0.0);
    let text = status(&machine, &[]).expect(0).out.clone();
    assert!(text.contains("u1") && !text.contains("NaN"), "{text}");
    let ended = master.end_by(SIGTERM);
    // However often it was tried.
    assert_eq!(ended.expect(0).err.matches("not connected").count(), 1, "{}", ended.err);
}

#[test]
fn an_unwritable_black_box_is_reported_and_the_run_goes_on() {
    let (machine, config, _sim) = with_drives(46, 1);
    let boxes = machine.path("boxes");
    let mut command = own(&machine, &["run"]);
    command.arg(&config).args(["--json", "--black-box"]).arg(&boxes);
    let mut master = Program::spawn(&mut command);
    master.await_text("all drives online");
    // It could be written to at the start.
    fs::remove_dir(&boxes).unwrap();
    machine.write("boxes", "");
    master.signal(SIGUSR1);
    master.await_text("black box not written: ");
    let ended = master.end_by(SIGTERM);
    let summary = ended.expect(0).json();
    assert!(summary["black_boxes"][0]["error"].as_str().is_some(), "{summary}");
}

#[test]
fn a_black_box_without_a_place_is_known_before_anything_is_sent() {
    let machine = Machine::new(136);
    let config = machine.plain(1);
    let drive = socket(machine.drive(0));
    let locked = machine.path("locked");
    fs::create_dir(&locked).unwrap();
    fs::set_permissions(&locked, PermissionsExt::from_mode(0o555)).unwrap();
    let run = |arguments: &[&str]| {
        let mut command = as_ordinary_user(&machine);
        command.env("XDG_STATE_HOME", &locked).arg("run").arg(&config).args(["--for", "300ms"]);
        Program::spawn(command.args(arguments)).end()
    };
    for place in [locked.join("boxes"), config.join("boxes")] {
        let parts = ["fieldbeat: black box ", "/boxes: cannot write there: ", "that this user may write to"];
        run(&["--black-box", place.to_str().unwrap()]).refused(&parts);
    }
    assert_silent(&drive);
    drop(drive);

    // Nobody has named the usual one.
    let _sim = simulation(&config);
    let known = format!("black box {}/fieldbeat: cannot write there: Permission denied", locked.display());
    let ended = run(&[]);
    assert_eq!(ended.err.matches(&known).count(), 1, "{}", ended.err);
    // Of a run that leaves no file there is nothing.
    let place = machine.path("a/b");
    master(&machine, &config, &["--for", "300ms", "--black-box", place.to_str().unwrap()]).end();
    assert!(!machine.path("a").exists());
    // So that it can be removed.
    fs::set_permissions(&locked, PermissionsExt::from_mode(0o755)).unwrap();
}

/// An error of this software in the loop of a program that embeds it: the axes stop, the loop ends by itself, and the
/// run says why.
#[test]
fn a_panic_of_the_loop_is_a_failed_run_with_a_black_box() {
    let (machine, config, _sim) = with_drives(238, 2);
    let mut plan = plan(&config);
    let bus = plan.buses.remove(0);
    let fused = Fused::new((&*bus as &dyn std::any::Any).downcast_ref::<LinUdpPlan>().unwrap().clone());
    plan.buses.push(Box::new(fused.clone()));
    let master = Master::from_plan(plan).with_black_box(machine.path("boxes")).start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axis = master.axis("d0").unwrap();
    axis.enable().unwrap();
    fused.light(Call::Receive, 1);
    assert!(until(LONG, || !master.is_running()), "the loop goes on");
    assert!(matches!(axis.home(), Err(AxisError::Gone { .. } | AxisError::Refused { .. })));
    let feedback = axis.feedback();
    assert_eq!(feedback.stopped, Some(StopCause::Panic));
    assert!(!feedback.status.state.is_powered(), "{feedback:?}");
    let run = master.finish();
    let panic = run.end.panic.as_ref().unwrap();
    assert!(panic.left_out.is_empty(), "{panic}");
    let summary = Summary::from(&run);
    assert!(summary.has_failed() && !summary.is_whole());
    assert_eq!(summary.failures[0].what, panic.to_string());
    let text = summary.to_string();
    let panicked = text.split("\ninternal error: the loop panicked ").nth(1).expect("it says so");
    assert!(panicked.starts_with("in stage ") || panicked.starts_with("between two cycles, bus "), "{text}");
    let [written] = &run.measured.black_boxes[..] else { panic!("{:?}", run.measured.black_boxes) };
    assert_eq!(written.why, "drive d0: stopped: internal error (panic)");
    let story = blackbox(&written.path, &[]);
    assert!(story.expect(0).out.contains("stopped: internal error (panic)"), "{story:?}");
}

#[test]
fn the_service_manager_is_fed_only_while_cycles_advance() {
    let machine = Machine::new(47);
    // It is held for longer than a loop that is watched may stand.
    let config = machine.config("m.toml", 1, "watch_after = \"off\"", "");
    let _sim = simulation(&config);
    let path = machine.path("notify");
    let manager = UnixDatagram::bind(&path).unwrap();
    fs::set_permissions(&path, PermissionsExt::from_mode(0o666)).unwrap();
    manager.set_read_timeout(Some(LONG)).unwrap();
    let next = || {
        let mut bytes = [0; 256];
        let length = manager.recv(&mut bytes).unwrap();
        String::from_utf8_lossy(&bytes[..length]).into_owned()
    };
    let mut command = own(&machine, &["run", config.to_str().unwrap()]);
    command.env("NOTIFY_SOCKET", &path).env("WATCHDOG_USEC", "200000");
    let master = Program::spawn(&mut command);
    assert!(next().contains("READY=1"));
    assert!(next().contains("WATCHDOG=1"));

    // The loop alone stands; the thread that feeds goes on.
    let hold = Hold::seize(thread(master.pid(), "fb-loop"));
    hold.stop();
    manager.set_nonblocking(true).unwrap();
    while manager.recv(&mut [0; 256]).is_ok() {}
    // One may be under way, and the cycles since then are worth one more; in this time a watchdog is fed ten times.
    std::thread::sleep(Duration::from_secs(1));
    let mut fed = 0;
    while manager.recv(&mut [0; 256]).is_ok() {
        fed += 1;
    }
    assert!(fed <= 2, "fed {fed} times although no cycle passed");
    // Under control, it would stop at the signal below and ask what to do about it.
    hold.release();
    manager.set_nonblocking(false).unwrap();
    assert!(next().contains("WATCHDOG=1"));
    master.signal(SIGTERM);
    while !next().contains("STOPPING=1") {}
    master.end().expect(0);
}
