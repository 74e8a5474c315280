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
fn the_fifth_connection_is_refused_until_one_of_the_four_ends() {
    let mut sim = UnidriveSim::new(settings());
    let now = Time(S);
    assert!((0..4).all(|n| sim.connect(now, client(n))));
    assert!(!sim.connect(now, client(4)));
    assert_eq!((sim.connections(), read_firmware(&mut sim, now, client(3))), (4, 13));
    // One that was refused is nobody.
    assert_eq!((read_firmware(&mut sim, now, client(4)), sim.hangs_up(client(4))), (0, true));
    sim.disconnected(now, client(1));
    assert!(sim.connect(now, client(4)));
    assert_eq!((sim.connections(), read_firmware(&mut sim, now, client(4))), (4, 13));
}

#[test]
fn what_is_no_modbus_ends_its_connection_and_no_other() {
    for (bytes, what) in [
        (&[0, 1, 0, 1][..], "protocol"),
        (&[0, 1, 0, 0, 0, 1], "too short for a function"),
        (&[0, 1, 0, 0, 0, 255], "longer than any message"),
        (&[0, 1, 0, 0, 0, 5, 255, 3, 0, 0, 0], "a read with half a count"),
        (&[0, 1, 0, 0, 0, 9, 255, 16, 0, 0, 0, 1, 4, 0, 0], "more bytes announced than there are"),
    ] {
        let mut bench = Bench::new(|_| {});
        assert!(bench.sim.connect(bench.now, client(0)));
        assert!(bench.raw(bytes).is_empty(), "{what}");
        assert!(bench.sim.hangs_up(MASTER), "{what}");
        // Whatever comes behind it is not looked at.
        assert!(bench.raw(&READ_FIRMWARE).is_empty(), "{what}");
        assert!(!bench.sim.hangs_up(client(0)));
        assert_eq!(read_firmware(&mut bench.sim, bench.now, client(0)), 13);
        // A new connection of the same client begins anew.
        bench.sim.disconnected(bench.now, MASTER);
        assert!(bench.sim.connect(bench.now, MASTER) && !bench.sim.hangs_up(MASTER));
        assert_eq!(bench.read(Parameter::FIRMWARE), 1_220_010);
    }
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
