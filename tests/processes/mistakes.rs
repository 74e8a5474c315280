//! Wrong input: addresses that are taken or foreign, configurations and arguments that are none.

use std::os::unix::fs::PermissionsExt;
use std::process::Command;

use super::support::{Machine, PROGRAM, Program, as_ordinary_user, run};
use super::{ask, assert_silent, limit, master, socket, wires};

#[test]
fn an_address_that_is_taken_or_foreign_is_refused_with_the_remedy() {
    let machine = Machine::new(8);
    let moons = [1, 40].map(|host| format!("{}:2222", machine.ip(host)).parse().unwrap());
    for (config, bus, [bind, drive], holder, address) in [
        (
            machine.plain(2),
            "linudp-v2",
            [machine.master(), machine.drive(0)],
            "another master holds this port: end it",
            "d0 0x20A8",
        ),
        (wires::moons(&machine), "ethernet-ip", moons, "another master holds this port", "feeder AC"),
    ] {
        let [other, of_drive] = [bind, drive].map(socket);
        let taken = format!("cannot bind {bind}: Address already in use");
        let run = || master(&config, &["--for", "1s"]).end();
        run().refused(&[&format!("bus {bus}: {taken}"), holder, "ss -ulpn"]);
        let read = ask("param get", &config, address);
        match bus {
            // By its session alone, which needs no such port.
            "ethernet-ip" => read.failed(&["drive feeder cannot be reached", "nobody listens at"]),
            _ => read.refused(&[&taken, "ss -ulpn"]),
        }
        assert_silent(&of_drive);
        drop(other);
        let taken = format!("cannot bind {drive}: Address already in use");
        ask("sim", &config, "").refused(&["cannot simulate the drives", &taken, "end it"]);

        // TEST-NET-1 of RFC 5737 is nobody's. Nothing is sent: there is no address to send from.
        let [a, b, c] = machine.ip(0).octets().first_chunk().copied().unwrap();
        let text = std::fs::read_to_string(&config).unwrap();
        let far = machine.write("far.toml", text.replace(&format!("{a}.{b}.{c}."), "192.0.2."));
        let none =
            format!("bus {bus}: cannot bind 192.0.2.1:{}: Cannot assign requested address", bind.port());
        master(&far, &["--for", "1s"]).end().refused(&[&none, "this host has no such address"]);
        ask("sim", &far, "").refused(&["cannot bind 192.0.2.", "a simulated drive runs on this computer"]);
    }
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
fn a_mistake_in_the_arguments_is_one_line() {
    for (arguments, parts) in [
        ("quux", "unrecognized subcommand 'quux'; see `fieldbeat --help`"),
        ("dem", "a similar subcommand exists: 'demo'"),
        ("run", "arguments were not provided: <CONFIG>; see `fieldbeat run --help`"),
        ("run a.toml --fo 1s", "unexpected argument '--fo' found; a similar argument exists: '--for'"),
        ("demo --for 3", "invalid value '3' for '--for <TIME>': write a number with its unit"),
        ("demo --for -1s", "-1s is no time: a time is not below 0; write 1s"),
        ("soak x.toml --for -1h30m", "-1h30m is no time: a time is not below 0; write 1h30m"),
        ("demo --for 1h30", "write a number with its unit"),
        (
            "demo --for ''",
            "write a number with its unit: ns, us, ms, s, min or h, for example 10s or 1h30min",
        ),
        (
            "demo --for",
            "a value is required for '--for <TIME>' but none was supplied; see `fieldbeat demo --help`",
        ),
        ("demo --drives 0", "0 is not in 1..=128"),
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
    assert!(ended.expect(2).out.is_empty() && ended.err.contains("Usage: fieldbeat"), "{ended:?}");
    let ended = run(["--help"]);
    assert!(ended.expect(0).err.is_empty() && ended.out.contains("Not a safety function"), "{ended:?}");
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
    // Standard input and output, the word that owns the wires; then of each bus the lock of its drive, its socket and
    // the twin of that for the watch, what the watch sends, and the lock once more.
    for (most, which) in [
        (4, "linudp-v2: drive"),
        (5, "linudp-v2: cannot bind"),
        (8, "linudp-v2: cannot bind"),
        (9, "second: drive"),
        (10, "second: cannot bind"),
    ] {
        let mut command = Command::new(PROGRAM);
        command.arg("run").arg(&config).args(["--for", "1s"]);
        let ended = Program::spawn(limit(&mut command, libc::RLIMIT_NOFILE, most)).end();
        ended.refused(&[which, "Too many open files", "ulimit -n", "LimitNOFILE="]);
    }
}
