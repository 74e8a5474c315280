//! The built program as a user runs it: its own processes, real UDP sockets on loopback, signals, and all the ways to
//! hold it wrong. Nothing here needs a privilege, and nothing asserts how fast anything is.

mod support;

use std::ffi::OsStr;
use std::io::Write;
use std::net::{SocketAddrV4, UdpSocket};
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use fieldbeat::axis::{Link, Profile, StopCause, Verb};
use fieldbeat::master::Master;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use libc::{SIGCONT, SIGHUP, SIGINT, SIGSTOP, SIGTERM};
use serde_json::Value;
use support::{
    DemoLock, Ended, LONG, Machine, PROGRAM, Program, as_ordinary_user, assert_sums, checkout, drive, plan,
    run,
};

const MS: Duration = Duration::from_millis(1);

fn serve(config: &std::path::Path) -> SimServer {
    SimServer::start(plan(config).simulate(), ServerOptions::default()).unwrap()
}

fn master(config: &std::path::Path, arguments: &[&str]) -> Program {
    let own = [OsStr::new("run"), config.as_os_str()];
    Program::start(own.into_iter().chain(arguments.iter().map(OsStr::new)))
}

fn simulation(config: &std::path::Path) -> Program {
    let mut program = Program::spawn(Command::new(PROGRAM).arg("sim").arg(config));
    program.await_text("listening");
    program
}

/// What a busy computer does to a demo whose simulated drives are threads like any other: they were silent for 50 ms, or
/// waited in vain for setpoints. It says so.
fn was_disturbed(ended: &Ended) -> bool {
    let mistakes: Vec<_> = ended.err.lines().filter(|line| line.starts_with("fieldbeat: ")).collect();
    let why = ["link lost", "lost on the way", "overrun", "underrun", "not online", "drive fault"];
    let last = mistakes.last().copied().unwrap_or_default();
    ended.code == Some(1) && why.iter().any(|why| last.contains(why))
}

/// Runs a demo until one was left in peace; each of them has to keep its books.
fn demo(arguments: &[&str], meanwhile: impl Fn(&Program)) -> Ended {
    let _lock = DemoLock::take();
    let mut attempts = 0;
    loop {
        let program = Program::start(["demo", "--drives", "2", "--json"].iter().chain(arguments));
        meanwhile(&program);
        let ended = program.end();
        assert_sums(&ended.json());
        attempts += 1;
        if !was_disturbed(&ended) || attempts == 6 {
            return ended;
        }
    }
}

fn assert_powered_off(summary: &Value) {
    for drive in summary["drives"].as_array().unwrap() {
        let state = drive["state"].as_str().unwrap();
        let off = ["NotReadyToSwitchOn", "SwitchOnDisabled", "ReadyToSwitchOn"];
        // Unknown: ended before the first answer, so that nothing was ever asked of the drive.
        let never_asked = state == "Unknown" && drive["answered"] == 0;
        assert!(off.contains(&state) || never_asked, "{drive}");
    }
}

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
    let ended = demo(&["--for", "2s"], |_| {});
    ended.expect(0);
    let summary = ended.json();
    assert_powered_off(&summary);
    assert!(summary["cycle"]["executed"].as_u64().unwrap() > 2000, "{summary}");
    for drive in summary["drives"].as_array().unwrap() {
        assert_eq!((&drive["link"], &drive["losses"]), (&"online".into(), &0.into()), "{drive}");
        assert_eq!(drive["protocol"], "linudp-v2");
        assert!(drive["rtt_ns"]["p50"].as_u64().unwrap() > 0, "{drive}");
        // The last move ends at 160 mm; the simulated axis follows its setpoint within its own window.
        let position = drive["position"].as_f64().unwrap();
        assert!((159.0..161.0).contains(&position), "{drive}");
    }

    let mut have = Vec::new();
    keys(&summary, "", &mut have);
    let quantiles =
        |of: &str| ["count", "p50", "p90", "p99", "p99_9", "max"].map(|key| format!("{of}.{key}"));
    let mut want: Vec<String> = [
        "cycle cycle.period_ns cycle.planned cycle.executed cycle.skipped cycle.overruns wake_ns stages_ns \
         stages_ns.send stages_ns.receive stages_ns.work drives drives.name drives.protocol drives.link drives.state \
         drives.losses drives.sent drives.answered drives.missed drives.late drives.duplicate drives.rejected \
         drives.suspect drives.unsent drives.rtt_ns drives.age_cycles drives.position drives.stopped drives.fault buses \
         buses.name buses.strangers buses.receive_errors realtime realtime.policy realtime.priority realtime.core \
         realtime.memory_locked realtime.page_faults realtime.involuntary_switches realtime.telemetry_lost \
         realtime.events_lost realtime.missing host host.kernel host.preemption host.cpu host.steal_ms",
    ]
    .iter()
    .flat_map(|keys| keys.split_whitespace().map(str::to_owned))
    .collect();
    for of in ["wake_ns", "stages_ns.send", "stages_ns.receive", "stages_ns.work", "drives.rtt_ns"] {
        want.extend(quantiles(of));
    }
    have.sort();
    want.sort();
    assert_eq!(have, want, "keys are stable: programs read them");
}

#[test]
fn a_signal_at_any_moment_ends_the_demo_in_order() {
    // Bring-up, enable, homing, the move to the start, the wave, the profile move, and the way down.
    let moments = [0, 50, 200, 500, 900, 1300, 1700, 2500, 4300, 4700, 5000];
    for (moment, signal) in moments.into_iter().zip([SIGINT, SIGTERM, SIGHUP].into_iter().cycle()) {
        let ended = demo(&["--for", "2s"], |program| {
            program.await_handler(signal);
            sleep(moment * MS);
            program.signal(signal);
        });
        assert_eq!((ended.code, ended.signal), (Some(0), None), "{moment} ms, signal {signal}: {ended:?}");
        assert_powered_off(&ended.json());
        assert_eq!(ended.err.matches("fieldbeat: ").count(), ended.err.matches("not real-time").count());
    }
}

#[test]
fn a_second_signal_shortens_the_waits_and_never_skips_the_stop() {
    for (first, between) in [(300, 0), (1500, 5), (2500, 60), (3000, 25)] {
        let ended = demo(&["--for", "3s"], |program| {
            program.await_handler(SIGINT);
            sleep(first * MS);
            program.signal(SIGINT);
            sleep(between * MS);
            program.signal(SIGINT);
        });
        ended.expect(0);
        assert_powered_off(&ended.json());
    }
}

/// A signal ends the wave, and the demo then ends the master: both ask for the same stop, which must not count as the
/// impatience of a second Ctrl-C. The ramp of 50 mm/s² from 200 mm/s takes 4 s and 400 mm; a hurried stop does not.
#[test]
fn ending_a_master_that_is_stopping_already_keeps_its_ramp() {
    let machine = Machine::new(1);
    let config = machine.config(
        "slow.toml",
        1,
        "",
        "stop = { deceleration = 50, timeout = \"30s\" }\nlimits = { position = [0, 2000] }\n\
         profile = { velocity = 200, acceleration = 2000 }",
    );
    let _sim = serve(&config);
    let master = Master::from_file(&config).unwrap().start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axis = master.axis("d0").unwrap();
    axis.enable().unwrap();
    axis.home().unwrap();
    let profile = Profile { velocity: 200.0, acceleration: 2000.0, ..axis.profile() };
    let target = fieldbeat::axis::Target::Absolute(1900.0);
    axis.post(Verb::Move(fieldbeat::axis::Move { target, profile })).unwrap();
    assert!(support::until(LONG, || axis.feedback().velocity > 150.0), "{:?}", axis.feedback());
    master.stop_handle().stop();
    assert!(support::until(LONG, || axis.feedback().stopped == Some(StopCause::Shutdown)));
    let begin = axis.feedback().position;
    let run = master.finish();
    let end = run.end.drives[0].feedback;
    assert!(end.position - begin > 150.0, "{begin} mm -> {end:?}");
    assert!(!end.state.is_powered());
}

#[test]
fn simulation_and_master_are_two_processes() {
    let machine = Machine::new(2);
    let config = machine.plain(3);
    let sim = simulation(&config);
    let ended = master(&config, &["--for", "2s", "--json"]).end();
    ended.expect(0);
    assert_eq!(ended.err, "all drives online: 3\n");
    let summary = ended.json();
    assert_sums(&summary);
    for name in ["d0", "d1", "d2"] {
        let drive = drive(&summary, name);
        assert!(drive["answered"].as_u64().unwrap() > 100, "{drive}");
        assert_eq!((&drive["link"], &drive["rejected"]), (&"online".into(), &0.into()));
    }
    // The text form, with a table of the same drives.
    let ended = master(&config, &["--for", "300ms"]).end();
    ended.expect(0);
    for part in ["planned", "wake-up latency", "d0 ", "d2 ", "host: "] {
        assert!(ended.out.contains(part), "no {part}: {}", ended.out);
    }
    sim.signal(SIGTERM);
    let ended = sim.end();
    ended.expect(0);
    assert!(ended.out.lines().last().unwrap().ends_with("answered"), "{ended:?}");
}

#[test]
fn drives_that_die_are_lost_and_come_back() {
    let machine = Machine::new(3);
    // Lost after 100 ms of silence.
    let config = machine.config("m.toml", 2, "", "health = { bucket = 50 }");
    let sim = simulation(&config);
    let mut master = master(&config, &["--json"]);
    master.await_text("all drives online: 2");
    sim.kill();
    master.await_text("drive d0: lost");
    master.await_text("drive d1: lost");
    let sim = simulation(&config);
    master.await_text("drive d0: back online");
    master.await_text("drive d1: back online");
    drop(sim);
    master.signal(SIGTERM);
    let ended = master.end();
    // Asked to end or not: drives were lost.
    ended.expect(1);
    let last = ended.err.lines().last().unwrap();
    assert!(last.starts_with("fieldbeat: lost on the way: d0, d1;"), "{}", ended.err);
    let summary = ended.json();
    assert_sums(&summary);
    assert!(["d0", "d1"].iter().all(|name| drive(&summary, name)["losses"].as_u64() >= Some(1)), "{summary}");
}

#[test]
fn a_run_with_a_lost_drive_has_failed_and_names_it() {
    let machine = Machine::new(4);
    // 200 ms of silence for d0, ten seconds for d1.
    let config = machine.config("m.toml", 2, "", "health = { bucket = 100 }");
    let text = std::fs::read_to_string(&config).unwrap();
    let text = text.replace("name = \"d1\"", "name = \"d1\"\nhealth.bucket = 5000");
    machine.write("m.toml", &text);
    // Only d0 is killed: each has its own simulation.
    let one = machine.config("one.toml", 1, "", "");
    let (head, first) = text.split_once("[[bus.drive]]").unwrap();
    let second = first.split_once("[[bus.drive]]").unwrap().1;
    let other = machine.write("other.toml", format!("{head}[[bus.drive]]{second}"));
    let (victim, _survivor) = (simulation(&one), simulation(&other));
    let mut master = master(&config, &["--for", "4s", "--json"]);
    master.await_text("all drives online: 2");
    victim.kill();
    master.await_text("drive d0: lost");
    let _again = simulation(&one);
    let ended = master.end();
    ended.expect(1);
    let last = ended.err.lines().last().unwrap();
    assert!(last.starts_with("fieldbeat: lost on the way: d0;"), "{}", ended.err);
    let summary = ended.json();
    assert_sums(&summary);
    assert!(drive(&summary, "d0")["losses"].as_u64() >= Some(1), "{summary}");
    assert_eq!(drive(&summary, "d0")["stopped"], "link lost");
    assert_eq!(
        (&drive(&summary, "d1")["losses"], &drive(&summary, "d1")["link"]),
        (&0.into(), &"online".into())
    );
}

#[test]
fn without_drives_a_run_fails_and_names_them() {
    let machine = Machine::new(5);
    let config = machine.plain(2);
    let ended = master(&config, &["--for", "500ms", "--json"]).end();
    ended.expect(1);
    assert_eq!(ended.err, "fieldbeat: never answered: d0, d1; look at their power, cables and addresses\n");
    let summary = ended.json();
    assert_sums(&summary);
    for name in ["d0", "d1"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["link"], &drive["answered"]), (&"unseen".into(), &0.into()));
        assert!(drive["rtt_ns"]["p50"].is_null() && drive["rtt_ns"]["max"].is_null(), "{drive}");
        // One probe in 100 ms, not one in each of the cycles.
        let cycles = summary["cycle"]["planned"].as_u64().unwrap();
        assert!((1..=cycles / 50 + 1).contains(&drive["sent"].as_u64().unwrap()), "{summary}");
    }
}

#[test]
fn a_run_that_waits_for_drives_can_be_ended() {
    let machine = Machine::new(6);
    let config = machine.plain(2);
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        let master = master(&config, &["--json"]);
        master.await_handler(signal);
        sleep(300 * MS);
        master.signal(signal);
        let ended = master.end();
        ended.expect(0);
        assert_eq!(ended.err, "");
        assert_sums(&ended.json());
    }
}

#[test]
fn under_nohup_the_master_outlives_its_terminal() {
    let machine = Machine::new(7);
    let config = machine.plain(1);
    let sim = serve(&config);
    let mut command = Command::new(PROGRAM);
    // SAFETY: between fork and exec, one system call.
    unsafe {
        use std::os::unix::process::CommandExt;
        command.pre_exec(|| {
            libc::signal(SIGHUP, libc::SIG_IGN);
            Ok(())
        });
    }
    let mut master = Program::spawn(command.arg("run").arg(&config).arg("--json"));
    master.await_text("all drives online");
    let before = sim.stats()[0].received;
    master.signal(SIGHUP);
    assert!(support::until(LONG, || sim.stats()[0].received > before + 500), "it ended");
    master.signal(SIGINT);
    master.end().expect(0);
}

#[test]
fn a_second_master_is_refused_and_the_first_one_does_not_notice() {
    let machine = Machine::new(8);
    let config = machine.plain(2);
    let _sim = serve(&config);
    let mut first = master(&config, &["--json"]);
    first.await_text("all drives online");
    for _ in 0..3 {
        let bind = format!("bus linudp-v2: cannot bind {}: Address already in use", machine.master());
        master(&config, &["--for", "1s"]).end().refused(&[
            &bind,
            "another master holds this port: end it",
            "ss -ulpn",
        ]);
    }
    assert!(first.is_running());
    first.signal(SIGINT);
    let ended = first.end();
    ended.expect(0);
    let summary = ended.json();
    assert_sums(&summary);
    for name in ["d0", "d1"] {
        let drive = drive(&summary, name);
        assert_eq!(
            (&drive["link"], &drive["losses"], &drive["rejected"]),
            (&"online".into(), &0.into(), &0.into())
        );
    }
}

#[test]
fn a_second_simulation_is_refused() {
    let machine = Machine::new(9);
    let config = machine.plain(2);
    let _first = simulation(&config);
    let ended = Program::spawn(Command::new(PROGRAM).arg("sim").arg(&config)).end();
    let bind = format!("cannot bind {}: Address already in use", machine.drive(0));
    ended.refused(&["cannot simulate the drives", &bind, "end it"]);
}

#[test]
fn addresses_of_other_computers_are_refused() {
    let machine = Machine::new(10);
    // TEST-NET-1 of RFC 5737 is nobody's. Nothing is sent: there is no address to send from.
    let text = std::fs::read_to_string(machine.plain(1)).unwrap();
    let [a, b, c] = machine.ip(0).octets().first_chunk().copied().unwrap();
    let config = machine.write("far.toml", text.replace(&format!("{a}.{b}.{c}."), "192.0.2."));
    master(&config, &["--for", "1s"]).end().refused(&[
        "bus linudp-v2: cannot bind 192.0.2.1:41136: Cannot assign requested address",
        "this host has no such address",
        "ip -4 addr",
    ]);
    let ended = Program::spawn(Command::new(PROGRAM).arg("sim").arg(&config)).end();
    ended.refused(&["cannot bind 192.0.2.11:49360", "a simulated drive lives on this computer"]);
}

#[test]
fn a_configuration_that_cannot_be_read_is_one_line() {
    let machine = Machine::new(11);
    let path = |file: &str| machine.path(file).display().to_string();
    let good = std::fs::read_to_string(machine.plain(1)).unwrap();
    machine.write("broken.toml", "[cycle\nperiod = 1");
    machine.write("latin1.toml", b"# gr\xfc\xdfe\n");
    machine.write("empty.toml", "");
    machine.write("unknown.toml", good.replace("realtime", "realtme"));
    machine.write("secret.toml", &good);
    std::fs::set_permissions(machine.path("secret.toml"), PermissionsExt::from_mode(0o000)).unwrap();
    for command in ["run", "sim", "check"] {
        let refused = |file: &str, parts: &[&str]| run([command, &path(file)]).refused(parts);
        refused(
            "missing.toml",
            &["cannot read ", "missing.toml: No such file or directory; name an existing"],
        );
        refused("", &["Is a directory; name an existing configuration, for example rt-config/demo.toml"]);
        refused("broken.toml", &["broken.toml:1: "]);
        refused("latin1.toml", &["latin1.toml:1: not UTF-8"]);
        refused("empty.toml", &["empty.toml:1: bus: missing"]);
        refused("unknown.toml", &["unknown.toml:5: cycle.realtme", "realtime"]);
        let ended = Program::spawn(as_ordinary_user(&machine).arg(command).arg(path("secret.toml"))).end();
        ended.refused(&["secret.toml: Permission denied; let this user read it"]);
    }
}

#[test]
fn all_mistakes_of_a_file_come_at_once() {
    let machine = Machine::new(12);
    let text = std::fs::read_to_string(machine.plain(1)).unwrap();
    let config = machine.write(
        "many.toml",
        text.replace("\"2ms\"", "\"2 parsecs\"")
            .replace("0.8", "8")
            .replace("name = \"d0\"", "nmae = \"d0\""),
    );
    let ended = master(&config, &[]).end();
    ended.expect(2);
    let lines: Vec<&str> = ended.err.lines().collect();
    assert!(lines.len() >= 4, "{}", ended.err);
    for (line, key) in lines.iter().zip(["period", "receive_deadline"]) {
        assert!(
            line.starts_with("fieldbeat: ") && line.contains("many.toml:") && line.contains(key),
            "{line}"
        );
    }
}

#[test]
fn a_mistake_in_the_arguments_is_one_line() {
    for (arguments, parts) in [
        ("frob", "unrecognized subcommand 'frob'; see `fieldbeat --help`"),
        ("dem", "a similar subcommand exists: 'demo'"),
        ("run", "arguments were not provided: <CONFIG>; see `fieldbeat run --help`"),
        ("run a.toml b.toml", "unexpected argument 'b.toml' found"),
        ("run a.toml --fo 1s", "unexpected argument '--fo' found; a similar argument exists: '--for'"),
        ("demo --for 3", "invalid value '3' for '--for <TIME>': write a number with its unit"),
        ("demo --for -3s", "unexpected argument '-3' found"),
        ("demo --for ''", "write a number with its unit: ns, us, ms, s, min or h, for example 10s"),
        ("demo --for", "a value is required for '--for <TIME>'"),
        ("demo --drives 0", "0 is not in 1..=128"),
        ("demo --drives 129", "129 is not in 1..=128"),
        ("demo --period 1ns", "cycle.period = \"1ns\": must be at least 50 us"),
        ("sim a.toml --core 1000000", "cannot read a.toml"),
    ] {
        run(arguments.split(' ')).refused(&[parts]);
    }
    let machine = Machine::new(13);
    let config = machine.plain(1).display().to_string();
    run(["sim", &config, "--core", "1000000"])
        .refused(&["--core 1000000: there is no such core; there are [0"]);

    // No arguments at all: the whole help, where mistakes go.
    let ended = run::<&str>([]);
    ended.expect(2);
    assert!(ended.out.is_empty() && ended.err.contains("Usage: fieldbeat"), "{ended:?}");
    let ended = run(["--help"]);
    ended.expect(0);
    assert!(ended.err.is_empty() && ended.out.contains("Not a safety function"), "{ended:?}");
}

/// 127.x.y.13 is nobody's: its requests vanish, or come back as an ICMP error that belongs to no other drive.
#[test]
fn a_dead_address_costs_the_living_nothing() {
    let machine = Machine::new(14);
    let config = machine.plain(3);
    let _sim = serve(&machine.config("living.toml", 2, "", ""));
    let ended = master(&config, &["--for", "2s", "--json"]).end();
    ended.expect(1);
    assert_eq!(ended.err, "fieldbeat: never answered: d2; look at their power, cables and addresses\n");
    let summary = ended.json();
    assert_sums(&summary);
    for name in ["d0", "d1"] {
        let drive = drive(&summary, name);
        assert_eq!(
            (&drive["link"], &drive["losses"], &drive["unsent"]),
            (&"online".into(), &0.into(), &0.into())
        );
        assert!(drive["answered"].as_u64().unwrap() > 100, "{drive}");
    }
    let (dead, cycles) = (drive(&summary, "d2"), summary["cycle"]["planned"].as_u64().unwrap());
    assert_eq!(dead["unsent"], 0);
    // A probe every 100 ms, of cycles of 2 ms.
    assert!(dead["sent"].as_u64().unwrap() <= cycles / 50 + 1, "{summary}");
}

/// Datagrams of every kind that the master never asked for, a few a cycle.
fn pester(from: &[UdpSocket], to: SocketAddrV4, rounds: usize) -> u64 {
    let longest = [0x5a; 65_507];
    // A request as a master sends it, a reply as a drive sends it, their beginnings, and noise.
    let mut reply = [0_u8; 26];
    (reply[0], reply[4]) = (0, 0xff);
    let mut sent = 0;
    for round in 0..rounds {
        for socket in from {
            let length = [0, 1, 8, 10, 26, 42, 50, 64, 128, 129, 1472, 9000, 65_507][round % 13];
            let bytes = if round % 2 == 0 { &longest[..length] } else { &reply[..length.min(26)] };
            // Only a full buffer of our own socket can refuse it.
            sent += u64::from(socket.send_to(bytes, to).is_ok());
        }
        sleep(MS);
    }
    sent
}

fn socket(address: SocketAddrV4) -> UdpSocket {
    UdpSocket::bind(address).unwrap_or_else(|error| panic!("{address}: {error}"))
}

#[test]
fn strangers_are_counted_and_change_nothing() {
    let machine = Machine::new(15);
    let config = machine.plain(2);
    let sim = serve(&config);
    let mut master = master(&config, &["--json"]);
    master.await_text("all drives online");
    let strangers =
        [socket(SocketAddrV4::new(machine.ip(200), 49360)), socket(SocketAddrV4::new(machine.ip(1), 0))];
    let wrong_port = [socket(SocketAddrV4::new(*machine.drive(0).ip(), 49361))];
    let by_strangers = pester(&strangers, machine.master(), 300);
    let by_port = pester(&wrong_port, machine.master(), 300);
    let before = sim.stats()[1].received;
    assert!(support::until(LONG, || sim.stats()[1].received > before + 100));
    master.signal(SIGINT);
    let ended = master.end();
    ended.expect(0);
    let summary = ended.json();
    assert_sums(&summary);
    // Some may have been dropped by the kernel, while the loop was held up.
    let counted = summary["buses"][0]["strangers"].as_u64().unwrap();
    assert!((by_strangers / 2..=by_strangers).contains(&counted), "{by_strangers}: {summary}");
    let rejected = drive(&summary, "d0")["rejected"].as_u64().unwrap();
    assert!((by_port / 2..=by_port).contains(&rejected), "{by_port}: {summary}");
    for name in ["d0", "d1"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["link"], &drive["losses"]), (&"online".into(), &0.into()), "{drive}");
    }
    assert_eq!(drive(&summary, "d1")["rejected"], 0);
    assert_eq!(summary["buses"][0]["receive_errors"], 0);
}

#[test]
fn whoever_sits_at_the_address_of_a_dead_drive_does_not_become_it() {
    let machine = Machine::new(16);
    let config = machine.config("m.toml", 2, "", "health = { bucket = 300 }");
    let sim = serve(&config);
    let mut master = master(&config, &["--for", "5s", "--json"]);
    master.await_text("all drives online");
    sim.stop();
    let impostor = [socket(machine.drive(0))];
    master.await_text("drive d0: lost");
    pester(&impostor, machine.master(), 300);
    let ended = master.end();
    ended.expect(1);
    assert!(!ended.err.contains("back online"), "{}", ended.err);
    let summary = ended.json();
    assert_sums(&summary);
    let (first, second) = (drive(&summary, "d0"), drive(&summary, "d1"));
    assert!(first["rejected"].as_u64().unwrap() > 100, "{first}");
    assert_eq!((&first["link"], &second["link"]), (&"lost".into(), &"lost".into()));
    assert_eq!(second["rejected"], 0);
}

#[test]
fn a_request_to_a_simulated_drive_that_is_none_stops_nothing() {
    let machine = Machine::new(17);
    let config = machine.plain(2);
    let sim = simulation(&config);
    let somebody =
        [socket(SocketAddrV4::new(machine.ip(99), 41136)), socket(SocketAddrV4::new(machine.ip(99), 0))];
    for index in 0..2 {
        pester(&somebody, machine.drive(index), 100);
    }
    let ended = master(&config, &["--for", "1s"]).end();
    ended.expect(0);
    sim.signal(SIGINT);
    sim.end().expect(0);
}

/// Ctrl-Z, or a debugger: the grid goes on without the process, and every slot is accounted for.
#[test]
fn a_master_that_was_stopped_counts_what_it_missed() {
    let machine = Machine::new(18);
    for (file, max_skip, code) in [("patient.toml", 100_000, 0), ("strict.toml", 100, 1)] {
        let config = machine.config(file, 1, &format!("max_skip = {max_skip}"), "");
        let _sim = serve(&config);
        let mut master = master(&config, &["--for", "3s", "--json"]);
        master.await_text("all drives online");
        master.signal(SIGSTOP);
        sleep(800 * MS);
        master.signal(SIGCONT);
        let ended = master.end();
        ended.expect(code);
        let summary = ended.json();
        assert_sums(&summary);
        assert!(summary["cycle"]["skipped"].as_u64().unwrap() > 300, "{summary}");
        assert!(summary["cycle"]["overruns"].as_u64().unwrap() > 0);
        // The drive was not asked meanwhile, so it cannot have missed anything.
        assert_eq!(
            (&drive(&summary, "d0")["link"], &drive(&summary, "d0")["losses"]),
            (&"online".into(), &0.into())
        );
        let last = ended.err.lines().last().unwrap();
        assert_eq!(last.starts_with("fieldbeat: stopped by an overrun: d0; "), code == 1, "{last}");
        // Skipped slots are late wake-ups, not omitted ones.
        assert!(summary["wake_ns"]["max"].as_u64().unwrap() > 500_000_000, "{summary}");
    }
}

#[test]
fn check_says_the_plan_and_what_it_is_not() {
    for file in ["rt-config/demo.toml", "rt-config/linmot.toml"] {
        let ended = run(["check".into(), checkout(file)]);
        ended.expect(0);
        assert_eq!(ended.err, "");
        for part in ["if the master dies", "stop: ", "not a safety function"] {
            assert!(ended.out.contains(part), "{file}: no {part}: {}", ended.out);
        }
    }
}

/// `| head -1`, a full disk, and nobody at all.
#[test]
fn an_output_that_nobody_takes_is_no_panic() {
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

#[test]
fn required_rights_that_are_missing_are_named_and_nothing_is_sent() {
    let machine = Machine::new(20);
    let config = machine.config("strict.toml", 2, "realtime = \"require\"", "");
    let drives = [socket(machine.drive(0)), socket(machine.drive(1))];
    let mut command = as_ordinary_user(&machine);
    let program = command.get_program().to_string_lossy().into_owned();
    let ended = Program::spawn(command.arg("run").arg(&config).args(["--for", "1s"])).end();
    ended.refused(&[
        "no right for SCHED_FIFO 80 (RLIMIT_RTPRIO is 0)",
        "sudo setcap cap_sys_nice,cap_ipc_lock+ep ",
        &program,
        "or set realtime = \"prefer\"",
    ]);
    for drive in drives {
        drive.set_nonblocking(true).unwrap();
        let got = drive.recv_from(&mut [0; 64]);
        assert!(got.as_ref().is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock), "{got:?}");
    }
}

#[test]
fn an_ordinary_user_is_told_once_that_the_numbers_are_not_real_time() {
    let machine = Machine::new(21);
    let config = machine.config("m.toml", 1, "realtime = \"prefer\"", "");
    let _sim = serve(&config);
    let user = |arguments: &[&str]| {
        let mut command = as_ordinary_user(&machine);
        Program::spawn(command.arg("run").arg(&config).args(["--for", "500ms"]).args(arguments)).end()
    };
    let ended = user(&["--json"]);
    ended.expect(0);
    let summary = ended.json();
    assert_eq!(
        (&summary["realtime"]["policy"], &summary["realtime"]["memory_locked"]),
        (&"SCHED_OTHER".into(), &false.into())
    );
    let told: Vec<&str> = ended.err.lines().filter(|line| line.contains("not real-time")).collect();
    assert_eq!(told.len(), 2, "one a right: {}", ended.err);
    assert_eq!(summary["realtime"]["missing"].as_array().unwrap().len(), 2);
    for (line, right) in told.iter().zip(["SCHED_FIFO 80", "memory"]) {
        assert!(line.starts_with("fieldbeat: not real-time: no right ") && line.contains(right), "{line}");
    }
    let ended = user(&[]);
    ended.expect(0);
    assert!(ended.out.contains("These numbers are not real-time:"), "{}", ended.out);
}

/// What goes in by a pipe is a configuration like any other.
#[test]
fn a_configuration_may_come_through_a_pipe() {
    let machine = Machine::new(22);
    let text = std::fs::read_to_string(machine.plain(1)).unwrap();
    let mut child = Command::new(PROGRAM)
        .args(["check", "/dev/stdin"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
}

/// The links as an application sees them, to compare with what the program says.
#[test]
fn the_library_sees_the_same_as_the_program() {
    let machine = Machine::new(23);
    let config = machine.plain(2);
    let sim = serve(&config);
    let master = Master::from_file(&config).unwrap().start().unwrap();
    master.wait_online(LONG).unwrap();
    sim.stop();
    let lost = || master.observers().iter().all(|(_, observer)| observer.feedback().link == Link::Lost);
    assert!(support::until(LONG, lost));
    let run = master.finish();
    let status = run.end.status;
    assert_eq!(status.planned, status.executed + status.skipped);
    for drive in &run.end.drives {
        assert_eq!((drive.losses, drive.counters.unsent), (1, 0));
        assert_eq!(drive.counters.sent, drive.counters.answered + drive.counters.missed);
    }
}
