//! Connections: how many, and how they end.

use super::*;

fn client(n: u16) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 9), 50_000 + n)
}

const READ_FIRMWARE: [u8; 12] = [0, 1, 0, 0, 0, 6, 255, 3, 0x44, 0x68, 0, 2];

fn read_firmware(sim: &mut UnidriveSim, now: Time, from: SocketAddrV4) -> usize {
    let mut reply = Vec::new();
    sim.receive(now, from, &READ_FIRMWARE, &mut reply);
    reply.len()
}

#[test]
fn half_a_message_is_not_completed_by_another_client_and_what_was_before_the_garbage_is_answered() {
    let mut bench = Bench::new(|_| {});
    assert!(bench.sim.connect(bench.now, client(0)));
    assert!(bench.raw(&READ_FIRMWARE[..9]).is_empty());
    assert_eq!(read_firmware(&mut bench.sim, bench.now, client(0)), 13);
    assert_eq!(bench.raw(&READ_FIRMWARE[9..]).len(), 13);
    assert_eq!(bench.raw(&[&READ_FIRMWARE[..], &[0, 2, 0, 9]].concat()).len(), 13);
    assert!(bench.sim.hangs_up(MASTER));
}

#[test]
fn a_restart_ends_all_connections_and_refuses_new_ones_until_it_is_up() {
    let mut bench = Bench::new(|settings| settings.boot_ns = 2 * S);
    bench.sim.restart(bench.now);
    assert!(bench.sim.hangs_up(MASTER));
    assert_eq!(bench.sim.connections(), 0);
    bench.wait(2 * S - 1);
    assert!(!bench.sim.connect(bench.now, MASTER));
    bench.wait(1);
    assert!(bench.sim.connect(bench.now, MASTER));
}
