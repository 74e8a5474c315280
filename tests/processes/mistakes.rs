//! Wrong input: addresses that are taken or foreign, configurations and arguments that are none.

use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::process::Command;

use libc::SIGINT;

use super::support::{Machine, PROGRAM, Program, as_ordinary_user, assert_sums, drive, period, run};
use super::{master, serve, simulation};

#[test]
fn a_second_master_is_refused_and_the_first_one_does_not_notice() {
    let machine = Machine::new(8);
    let config = machine.plain(2);
    let _sim = serve(&config);
    let mut first = master(&config, &["--json"]);
    first.await_text("all drives online");
    // With a drive of its own, but the same port.
    let text = std::fs::read_to_string(&config).unwrap();
    let other = [0, 1].map(|index| machine.drive(index).ip().to_string());
    let text = text.replace(&other[0], &machine.ip(200).to_string());
    let config = machine.write("other.toml", text.replace(&other[1], &machine.ip(201).to_string()));
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
    ended.refused(&["cannot bind 192.0.2.11:49360", "a simulated drive runs on this computer"]);
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
        refused("unknown.toml", &["unknown.toml:6: cycle.realtme", "realtime"]);
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
        text.replace(&format!("\"{}\"", period()), "\"2 parsecs\"")
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
        ("quux", "unrecognized subcommand 'quux'; see `fieldbeat --help`"),
        ("dem", "a similar subcommand exists: 'demo'"),
        ("run", "arguments were not provided: <CONFIG>; see `fieldbeat run --help`"),
        ("run a.toml b.toml", "unexpected argument 'b.toml' found"),
        ("run a.toml --fo 1s", "unexpected argument '--fo' found; a similar argument exists: '--for'"),
        ("demo --for 3", "invalid value '3' for '--for <TIME>': write a number with its unit"),
        ("demo --for -3s", "unexpected argument '-3' found"),
        ("demo --for ''", "write a number with its unit: ns, us, ms, s, min or h, for example 10s"),
        (
            "demo --for",
            "a value is required for '--for <TIME>' but none was supplied; see `fieldbeat demo --help`",
        ),
        ("demo --drives 0", "0 is not in 1..=128"),
        ("demo --drives 129", "129 is not in 1..=128"),
        ("demo --period 1ns", "cycle.period = \"1ns\": must be at least 50 us"),
        ("sim a.toml --core 1000000", "cannot read a.toml"),
    ] {
        run(arguments.split(' ')).refused(&[parts]);
    }
    if !cfg!(feature = "scope") {
        run(["scope", "a.toml"])
            .refused(&["built without `scope`: `cargo build --release --features scope`"]);
        run(["demo", "--scope"])
            .refused(&["built without `--scope`: `cargo build --release --features scope`"]);
    }
    if !cfg!(feature = "jog") {
        run(["jog", "a.toml"]).refused(&["built without `jog`: `cargo build --release --features jog`"]);
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

/// A limit of open files that leaves too few for the drives and sockets of two buses.
#[test]
fn a_process_without_descriptors_learns_which_limit_to_raise() {
    let machine = Machine::new(133);
    let first = std::fs::read_to_string(machine.plain(1)).unwrap();
    let second = format!(
        "[[bus]]\nname = \"second\"\nprotocol = \"linudp-v2\"\nbind = \"{}\"\n[[bus.drive]]\nname = \"e0\"\n\
         address = \"{}\"\nlimits = {{ position = [0, 400] }}\n",
        machine.ip(2),
        machine.ip(41)
    );
    let config = machine.write("two.toml", first + &second);
    // Standard input and output, then the place of a drive, the socket of each bus and its twin for the watch.
    for (most, which) in [
        (4, "linudp-v2: cannot bind"),
        (5, "linudp-v2: cannot bind"),
        (6, "second: drive"),
        (7, "second: cannot bind"),
    ] {
        let mut command = Command::new(PROGRAM);
        command.arg("run").arg(&config).args(["--for", "1s"]);
        // SAFETY: between fork and exec, system calls only.
        unsafe {
            command.pre_exec(move || {
                let few = libc::rlimit { rlim_cur: most, rlim_max: most };
                match libc::setrlimit(libc::RLIMIT_NOFILE, &few) {
                    0 => Ok(()),
                    _ => Err(std::io::Error::last_os_error()),
                }
            });
        }
        let ended = Program::spawn(&mut command).end();
        ended.refused(&[which, "Too many open files", "ulimit -n", "LimitNOFILE="]);
    }
}
