//! `fieldbeat scope` and `--scope` as a user runs them.

use std::net::SocketAddr;

use libc::SIGINT;

use crate::socket::{Socket, get};
use crate::support::{Machine, Program, run, served, simulated};

/// Where the page is, by what the program says.
pub fn address(program: &mut Program) -> SocketAddr {
    program.await_text("scope at http://");
    let said = program.out() + &program.err();
    let address = said.split("scope at http://").nth(1).and_then(|rest| rest.split('/').next());
    address.and_then(|address| address.parse().ok()).unwrap_or_else(|| panic!("{said}"))
}

#[test]
fn a_scope_waits_for_its_master_attaches_and_attaches_again() {
    let machine = Machine::new(20);
    let config = machine.plain(2);
    let _drives = served(|| simulated(&config));
    let arguments = |command: &'static str| [command.into(), config.clone().into_os_string()];
    let mut scope = Program::start(arguments("scope").into_iter().chain(["--listen".into(), "0".into()]));
    let mut socket = Socket::open(address(&mut scope), "").unwrap();
    let waiting = socket.text("waiting");
    assert!(waiting.as_str().is_some_and(|why| !why.is_empty()), "{waiting}");
    let mut pids = Vec::new();
    for _ in 0..2 {
        let master = Program::start(arguments("run"));
        let introduced = socket.text("machine");
        assert_eq!(introduced["pid"], master.pid());
        pids.push(introduced["pid"].clone());
        socket.say(r#"{"show":[0]}"#).unwrap();
        assert!(!socket.cycles().is_empty());
        let axes = socket.text("axes");
        assert_eq!(axes.as_array().unwrap().len(), 2);
        assert!(axes[0]["state"].is_string(), "{axes}");
        let ended = master.end_by(SIGINT);
        assert!(ended.code.is_some(), "{ended:?}");
        let why = socket.text("waiting");
        assert!(why.as_str().unwrap().contains("master"), "{why}");
    }
    assert_ne!(pids[0], pids[1]);
    scope.end_by(SIGINT).expect(0);
}

#[test]
fn a_master_serves_its_own_page() {
    let machine = Machine::new(21);
    let config = machine.plain(1);
    let _drives = served(|| simulated(&config));
    let mut master = Program::start(["run", config.to_str().unwrap(), "--json", "--scope", "0"]);
    let address = address(&mut master);
    let mut socket = Socket::open(address, "").unwrap();
    assert_eq!(socket.text("machine")["pid"], master.pid());
    socket.say(r#"{"show":[0]}"#).unwrap();
    assert!(!socket.cycles().is_empty());
    assert_eq!(get(address, "/", ""), 200);
    master.await_text("all drives online");
    let ended = master.end_by(SIGINT);
    ended.expect(0);
    assert_eq!(ended.json()["realtime"]["telemetry_lost"], 0);
}

#[test]
fn a_demo_serves_its_page_up_to_its_end() {
    // Ten seconds from when all are online, or until this host was too busy for that.
    let mut demo = Program::start(["demo", "--drives", "2", "--scope", "0"]);
    let mut socket = Socket::open(address(&mut demo), "").unwrap();
    assert_eq!(socket.text("machine")["pid"], demo.pid());
    socket.say(r#"{"show":[0]}"#).unwrap();
    assert!(!socket.cycles().is_empty());
    // The page ends with the program.
    while socket.next().is_ok() {}
    let ended = demo.end();
    // Where the host is too busy for its drives it says so.
    assert!(matches!(ended.code, Some(0 | 1)) && ended.out.contains("cycles of"), "{ended:?}");
}

#[test]
fn a_public_address_that_allows_commands_is_warned_of() {
    let machine = Machine::new(23);
    let config = machine.plain(1);
    let config = config.to_str().unwrap();
    for (control, warning) in [
        (&[][..], "whoever has this address, with its token, can watch the machine"),
        (&["--control"], "whoever has this address, with its token, can MOVE the machine"),
    ] {
        let mut scope = Program::start(["scope", config, "--listen", "0.0.0.0:0"].iter().chain(control));
        scope.await_text(warning);
        // Said on the other stream, which is read by another thread.
        scope.await_text("/#token=");
        scope.end_by(SIGINT).expect(0);
    }
    let mut scope = Program::start(["scope", config, "--listen", "0", "--control"]);
    let _ = address(&mut scope);
    scope.signal(SIGINT);
    assert!(!scope.end().expect(0).err.contains("whoever has this address"));
}

#[test]
fn an_unusable_scope_address_is_refused_in_one_line() {
    let machine = Machine::new(22);
    let config = machine.plain(1);
    run(["scope", "/none.toml"]).refused(&["/none.toml", "no such file"]);
    let taken = std::net::TcpListener::bind((machine.ip(9), 0)).unwrap();
    let taken = taken.local_addr().unwrap().to_string();
    let config = config.to_str().unwrap();
    run(["scope", config, "--listen", &taken]).refused(&[&taken, "another port"]);
    run(["scope", config, "--listen", "nowhere"]).refused(&["nowhere", "must be a port"]);
    run(["run", config, "--scope", &taken]).refused(&[&taken, "another port"]);
}
