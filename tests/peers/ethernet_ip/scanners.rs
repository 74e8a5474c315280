//! Class 1 scanners of others, and our simulated drive. Both put an electronic key of zeros in front of the path.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::process::Command;

use fieldbeat_sim::ethernet_ip::MoonsSettings;

use super::{ENABLE, ENABLED, MOVING, POSITION, RELATIVE, STATUS, serve};
use crate::peer::Peer;
use crate::support::{CABLE_NET, Cable, LONG, Machine, checkout, until};

/// The interval of packets, ms.
const RPI: &str = "20";
/// How far it moves, steps.
const DISTANCE: i64 = -20_000;

fn drive(address: Ipv4Addr) -> MoonsSettings {
    MoonsSettings::new(SocketAddrV4::new(address, 44_818))
}

/// VE, AC, DE, DI of the move behind what jogs: 5 rev/s, 100 rev/s².
fn outputs(scanner: &mut Peer, command: i64) {
    assert_eq!(scanner.ask(&format!("outputs {command} 0 0 0 1200 600 600 {DISTANCE}")), "ok");
}

#[track_caller]
fn await_inputs(scanner: &mut Peer, what: &str, is_there: impl Fn(&[i64]) -> bool) {
    let arrived = until(LONG, || is_there(&scanner.integers("inputs 14")));
    assert!(arrived, "{what}: {:?}", scanner.integers("inputs 14"));
}

/// All packets so far, each of the agreed size and with the next number.
#[track_caller]
fn packets(scanner: &mut Peer) -> u64 {
    let counts = scanner.numbers("packets");
    assert_eq!(counts[1..], [0, 0], "{counts:?}");
    counts[0]
}

/// Enables the drive, moves it, and closes the connection.
fn operate(scanner: &mut Peer) {
    // At rest: 48.0 V, 30.0 °C, all inputs open.
    await_inputs(scanner, "at rest", |inputs| {
        inputs == [0, 0, 480, 0, 300, 0, 0, 0, 0, 0, 255, 0, 8192, 8192]
    });
    outputs(scanner, ENABLE);
    await_inputs(scanner, "enabled", |inputs| inputs[STATUS] & 0x3FF == ENABLED);
    // Idle in between, and held until it is seen: the position does not say when a packet with the 0 arrived.
    let before = packets(scanner);
    outputs(scanner, 0);
    assert!(until(LONG, || packets(scanner) > before + 5));
    outputs(scanner, RELATIVE);
    await_inputs(scanner, "moving", |inputs| inputs[STATUS] & MOVING != 0);
    await_inputs(scanner, "there", |inputs| (inputs[STATUS] & MOVING, inputs[POSITION]) == (0, DISTANCE));
    // The word is held, and is no edge any more.
    let before = packets(scanner);
    assert!(until(LONG, || packets(scanner) > before + 20));
    assert_eq!(scanner.integers("inputs 7")[POSITION], DISTANCE);
    assert_eq!(scanner.ask("close"), "ok");
    // What was on its way has arrived; then nothing comes.
    std::thread::sleep(std::time::Duration::from_millis(200));
    let closed = packets(scanner);
    std::thread::sleep(std::time::Duration::from_millis(400));
    assert_eq!(packets(scanner), closed);
}

/// st-ethernet-ip leaves its session open where it has closed its connection.
#[test]
#[ignore = "needs node and st-ethernet-ip"]
fn a_scanner_of_st_ethernet_ip_enables_and_moves_the_simulated_drive() {
    let machine = Machine::new(61);
    let server = serve([drive(machine.ip(11))]);
    let scanner = || {
        let mut node = Command::new("node");
        node.arg(checkout("tests/peers/ethernet_ip/programs/scanner.js"));
        node.args([machine.ip(11).to_string(), machine.ip(1).to_string(), RPI.into()]);
        Peer::start(node, machine.path("scanner.err"))
    };
    operate(&mut scanner());
    // The owner is gone: another one may open, before any time-out.
    let mut next = scanner();
    await_inputs(&mut next, "where the first one left it", |inputs| inputs[POSITION] == DISTANCE);
    assert_eq!(server.stop().iter().map(|stats| stats.connections.accepted).sum::<u64>(), 2);
}

/// ethernetip listens at 0.0.0.0, and sends from another port than 2222: it has a host of its own.
#[test]
#[ignore = "needs root, iproute2, python3 and ethernetip"]
fn a_scanner_of_ethernetip_enables_and_moves_the_simulated_drive() {
    let machine = Machine::new(62).on(CABLE_NET);
    let cable = Cable::new(62, &[11]);
    let server = cable.among_drives(|| serve([drive(machine.ip(11))]));
    let scanner = || {
        let python = checkout("target/peers/scanner/bin/python");
        let mut python = Cable::command(&cable.master, python.to_str().unwrap());
        python.arg(checkout("tests/peers/ethernet_ip/programs/scanner.py"));
        python.args([machine.ip(11).to_string(), RPI.into()]);
        Peer::start(python, machine.path("scanner.err"))
    };
    operate(&mut scanner());
    let mut next = scanner();
    await_inputs(&mut next, "where the first one left it", |inputs| inputs[POSITION] == DISTANCE);
    assert_eq!(server.stop().iter().map(|stats| stats.connections.accepted).sum::<u64>(), 2);
}
