//! Clients of others, and our simulated drive: it is strict, and no generic server.

use std::net::SocketAddrV4;
use std::process::Command;

use fieldbeat_sim::ethernet_ip::MoonsSettings;

use super::serve;
use crate::support::{Machine, checkout};

/// Messages, and the data of their replies.
const MESSAGES: [(&str, &str); 11] = [
    // The identity: a name, all of it, and what it does not have.
    ("0e/1/1/7/", "0853544631302d4950"),
    ("01/1/1//", "3c002b00010001010000040302010853544631302d4950"),
    ("0e/1/1/63/", "failed"),
    ("0e/77/1/1/", "failed"),
    // The inputs at rest.
    ("0e/4/65/4/", "3800"),
    // The profile code of an STF.
    ("0e/64/0/1/", "00fb000041b00001034a"),
    // AC100 of the manual, read back; ME, and a register.
    ("3c/64/1/1/0001001e00000258", "0001001e00000000"),
    ("3c/64/1/1/0002841e00000000", "0002841e02580000"),
    ("3c/64/1/1/0001009f00000000", "0001009f00010000"),
    // The absolute position.
    ("3c/64/1/1/0002880100000000", "0002880100000000"),
    ("3c/64/1/1/0002ff0900000000", "failed"),
];

fn converse(test: u8, library: &str, vendor: &str) {
    let machine = Machine::new(test);
    let mut settings = MoonsSettings::new(SocketAddrV4::new(machine.ip(11), 44_818));
    settings.identity.serial = Some(0x0102_0304);
    let server = serve([settings]);
    let mut python = Command::new(checkout("target/peers/python/bin/python"));
    python.arg(checkout("tests/peers/ethernet_ip/programs/explicit.py"));
    python.arg(library).arg(machine.ip(11).to_string()).args(MESSAGES.map(|(message, _)| message));
    let output = python.output().unwrap_or_else(|error| panic!("{python:?}: {error}; .ci/run installs it"));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    let mut lines = text.lines();
    let found = format!("{vendor} STF10-IP 3 {}", machine.ip(11));
    assert_eq!(lines.next(), Some(found.as_str()), "{errors}");
    for (message, expected) in MESSAGES {
        assert_eq!(lines.next(), Some(expected), "{message}: {errors}");
    }
    assert!(server.stop().iter().any(|stats| stats.connections.accepted > 0));
}

#[test]
#[ignore = "needs python3 and pycomm3"]
fn messages_of_pycomm3_are_answered_unconnected_and_on_a_connection() {
    for (test, library) in [(41, "pycomm3"), (42, "pycomm3-connected")] {
        converse(test, library, "Applied Motion Products, Inc.");
    }
}

#[test]
#[ignore = "needs python3 and cpppo"]
fn messages_of_cpppo_are_answered() {
    converse(43, "cpppo", "60");
}
