//! Datagrams of people who have no business here.

use std::net::{SocketAddrV4, UdpSocket};
use std::thread::sleep;

use libc::SIGINT;
use serde_json::Value;

use super::support::{self, LONG, Machine, assert_sums, drive};
use super::{MS, await_status, finish, online, serve, socket};

/// Datagrams of every kind that the master never requested, a few a cycle.
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

#[test]
fn datagrams_of_unknown_senders_are_counted_and_change_nothing() {
    let machine = Machine::new(15);
    let config = machine.plain(2);
    let sim = serve(&config);
    let master = online(&config, &["--json"]);
    let unmatched =
        [socket(SocketAddrV4::new(machine.ip(200), 49360)), socket(SocketAddrV4::new(machine.ip(1), 0))];
    let wrong_port = [socket(SocketAddrV4::new(*machine.drive(0).ip(), 49361))];
    let by_strangers = pester(&unmatched, machine.master(), 300);
    let by_port = pester(&wrong_port, machine.master(), 300);
    // A simulated drive takes what is no request as calmly.
    let somebody = [socket(SocketAddrV4::new(machine.ip(99), 41136))];
    pester(&somebody, machine.drive(1), 100);
    let before = sim.stats()[1].received;
    assert!(support::until(LONG, || sim.stats()[1].received > before + 100));
    let summary = finish(master);
    // Some may have been dropped by the kernel, and replies with them, while the loop was held up.
    let of_bus = |key: &str| summary["buses"][0][key].as_u64().unwrap();
    let (counted, dropped) = (of_bus("unmatched"), of_bus("dropped"));
    let rejected = drive(&summary, "d0")["rejected"].as_u64().unwrap();
    assert!(counted <= by_strangers && rejected <= by_port, "{by_strangers}, {by_port}: {summary}");
    assert!(counted + rejected + dropped >= by_strangers + by_port, "{by_strangers}, {by_port}: {summary}");
    for name in ["d0", "d1"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["link"], &drive["losses"]), (&"online".into(), &0.into()), "{drive}");
    }
    assert_eq!(drive(&summary, "d1")["rejected"], 0);
    assert_eq!(summary["buses"][0]["receive_errors"], 0);
}

#[test]
fn an_unknown_sender_at_the_address_of_a_dead_drive_is_not_taken_for_it() {
    let machine = Machine::new(16);
    let config = machine.config("m.toml", 2, "", Machine::LOST_SOON);
    let sim = serve(&config);
    let mut master = online(&config, &["--json"]);
    sim.stop();
    let impostor = [socket(machine.drive(0))];
    master.await_text("drive d0: lost");
    // The kernel may drop some while the loop is held up.
    let rejected = |summary: &Value| drive(summary, "d0")["rejected"].as_u64() > Some(100);
    await_status(&config, |summary| pester(&impostor, machine.master(), 100) > 0 && rejected(summary));
    let ended = master.end_by(SIGINT);
    assert!(!ended.expect(1).err.contains("back online"), "{}", ended.err);
    let summary = ended.json();
    assert_sums(&summary);
    let (first, second) = (drive(&summary, "d0"), drive(&summary, "d1"));
    assert_eq!((&first["link"], &second["link"]), (&"lost".into(), &"lost".into()));
    assert_eq!(second["rejected"], 0);
}
