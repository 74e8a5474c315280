//! Encapsulation: commands, statuses, splits, time-outs, discovery.

use super::*;
use crate::ethernet_ip::sessions::FRAME_MAX;

/// Status and data of the answer to a frame.
fn answer(bench: &mut Bench, command: u16, session: u32, data: &[u8]) -> (u32, u32, Vec<u8>) {
    let reply = bench.raw(MASTER, &frame(command, session, data));
    assert_eq!(reply[..2], command.to_le_bytes());
    assert_eq!(usize::from(u16::from_le_bytes([reply[2], reply[3]])), reply.len() - 24);
    assert_eq!(&reply[12..20], b"context!");
    (word_of(&reply, 8), word_of(&reply, 4), reply[24..].to_vec())
}

fn other(port: u16) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), port)
}

#[test]
fn each_command_is_answered_with_its_status() {
    let mut bench = Bench::new(|_| {});
    let session = bench.session;
    assert_eq!(answer(&mut bench, 0x99, 0, &[]), (1, 0, vec![]), "unknown");
    assert_eq!(answer(&mut bench, 0x65, 0, &[1, 0, 0, 0]), (1, session, hex("01 00 00 00")), "again");
    assert_eq!(answer(&mut bench, 0x6F, 77, &[0; 16]), (0x64, 77, vec![]), "of somebody else");
    assert_eq!(answer(&mut bench, 0x70, 77, &[0; 16]), (0x64, 77, vec![]));
    assert_eq!(answer(&mut bench, 0x66, 77, &[]), (0x64, 77, vec![]));
    let wrong_item = hex("00 00 00 00 00 00 02 00 A1 00 04 00 01 00 00 00 B2 00 02 00 0E 00");
    assert_eq!(answer(&mut bench, 0x6F, session, &wrong_item).0, 3);
    assert_eq!(bench.raw(MASTER, &frame(0x6F, session, &[0; 5])), [0; 0], "too short: silence");
    assert_eq!(bench.raw(MASTER, &frame(0, 0, b"whatever")), [0; 0], "NOP");
    assert_eq!(bench.sim.ignored(), Ignored { bad_length: 1, ..Ignored::default() });
    assert_eq!(answer(&mut bench, 0x64, 0, &[]), (0, 0, vec![0, 0]));
    let services = "01 00 00 01 14 00 01 00 20 01 43 6F 6D 6D 75 6E 69 63 61 74 69 6F 6E 73 00 00";
    assert_eq!(answer(&mut bench, 4, 0, &[]), (0, 0, hex(services)));
}

#[test]
fn frames_arrive_at_any_split_and_several_at_once() {
    let mut bench = Bench::new(|_| {});
    let session = bench.session;
    let list = frame(0x63, 0, &[]);
    let whole = bench.raw(MASTER, &list);
    for at in 0..list.len() {
        assert_eq!(bench.raw(MASTER, &list[..at]), [0; 0], "{at}");
        assert_eq!(bench.raw(MASTER, &list[at..]), whole, "{at}");
    }
    let both = [list.clone(), frame(0x66, session, &[]), list.clone()].concat();
    assert_eq!(bench.raw(MASTER, &both), whole, "nothing after the end of the session");
    assert!(bench.sim.hangs_up(MASTER));
}

#[test]
fn a_request_with_a_status_or_options_gets_no_answer() {
    let mut bench = Bench::new(|_| {});
    for at in [8, 20] {
        let mut list = frame(0x63, 0, &[]);
        list[at] = 1;
        assert_eq!(bench.raw(MASTER, &list), [0; 0]);
        assert_eq!(bench.at(DISCOVERY, MASTER, &list), [0; 0]);
    }
    assert_eq!(bench.sim.ignored().bad_header, 4);
    // One that is too long ends the connection.
    let mut long = Bench::new(|_| {});
    let bytes = frame(0x6F, long.session, &[0; FRAME_MAX - 23]);
    assert_eq!(long.raw(MASTER, &bytes[..24])[8], 0x65);
    assert!(long.sim.hangs_up(MASTER));
    assert_eq!(long.raw(MASTER, &bytes[24..]), [0; 0]);
    // But for the one that ends the session.
    let mut end = frame(0x66, bench.session, &[]);
    end[8] = 1;
    assert_eq!(bench.raw(MASTER, &end), [0; 0]);
    assert!(bench.sim.hangs_up(MASTER));
}

#[test]
fn a_silent_connection_ends_after_a_time_that_can_be_set_and_the_packets_go_on() {
    let mut bench = Bench::owned(|_| {});
    for _ in 0..2_399 {
        bench.pass(50 * MS);
        bench.word(0);
    }
    assert!(!bench.sim.hangs_up(MASTER));
    bench.pass(50 * MS);
    assert!(bench.sim.hangs_up(MASTER));
    bench.sim.disconnected(bench.now, MASTER);
    let before = bench.sent.len();
    bench.idle_for(S);
    assert_eq!(bench.sent.len() - before, 100);
    assert_eq!(bench.sim.connections(), (0, 1));
    // It closes from another connection of the same host.
    let session = bench.connect(other(9));
    let (reply, _) = bench.message_of(other(9), session, &Forward::default().close(), &[]);
    assert_eq!(reply[..4], [0xCE, 0, 0, 0]);
    let mut bench = Bench::new(|_| {});
    assert_eq!(bench.message(&hex("0E 03 20 F5 24 01 30 0D")), hex("8E 00 00 00 78 00"));
    assert_eq!(bench.message(&hex("10 03 20 F5 24 01 30 0D 02 00")), hex("90 00 00 00"));
    bench.pass(2 * S - 1);
    assert!(!bench.sim.hangs_up(MASTER));
    bench.pass(1);
    assert!(bench.sim.hangs_up(MASTER));
    let mut bench = Bench::new(|settings| settings.network.inactivity_s = 0);
    assert_eq!(bench.message(&hex("10 03 20 F5 24 01 30 0D FF FF")), hex("90 00 09 00"));
    assert_eq!(bench.sim.next_due(), None, "never");
}

#[test]
fn the_drive_is_found_by_datagrams() {
    let mut bench = Bench::new(|settings| settings.identity.serial = Some(0x0102_0304));
    let expected = "01 00 0C 00 2A 00 01 00 00 02 AF 12 0A 00 00 02 00 00 00 00 00 00 00 00 3C 00 2B 00 01 \
         00 01 01 00 00 04 03 02 01 08 53 54 46 31 30 2D 49 50 03";
    let list = frame(0x63, 0, &[]);
    assert_eq!(bench.at(DISCOVERY, MASTER, &list)[24..], hex(expected));
    assert_eq!(bench.raw(MASTER, &list)[24..], hex(expected), "the same by TCP");
    assert_eq!(bench.at(DISCOVERY, MASTER, &frame(4, 0, &[])).len(), 24 + 26);
    assert_eq!(bench.at(DISCOVERY, MASTER, &frame(0x64, 0, &[])).len(), 24 + 2);
    assert_eq!(bench.at(DISCOVERY, MASTER, &frame(0x65, 0, &[1, 0, 0, 0]))[8], 1);
    let two = [list.clone(), list.clone()].concat();
    assert_eq!(bench.at(DISCOVERY, MASTER, &two), [0; 0], "one message a datagram");
    assert_eq!(bench.at(DISCOVERY, MASTER, &list[..23]), [0; 0]);
    assert_eq!(bench.sim.ignored().no_frame, 2);
}

#[test]
fn a_power_cycle_takes_its_time_and_everything_volatile() {
    let mut bench = Bench::owned(|_| {});
    let old = bench.id;
    bench.sim.disconnected(bench.now, MASTER);
    bench.sim.restart(bench.now);
    assert_eq!((bench.sim.connections(), bench.sim.next_due()), ((0, 0), None));
    assert!(!bench.sim.connect(bench.now, MASTER));
    assert_eq!(bench.at(DISCOVERY, MASTER, &frame(0x63, 0, &[])), [0; 0]);
    bench.pass(500 * MS);
    bench.session = bench.connect(MASTER);
    bench.open(&Forward::default());
    assert_ne!(bench.id, old, "what is under way to the old connection is not for the new one");
}

#[test]
fn a_search_of_all_devices_is_answered_within_the_time_that_it_names() {
    let search = |context: [u8; 8], command| {
        let mut bytes = frame(command, 0, &[]);
        bytes[12..20].copy_from_slice(&context);
        bytes
    };
    for (context, within_ms) in
        [([0; 8], 2_000), ([1, 0, 7, 7, 7, 7, 7, 7], 500), ([0xE8, 3, 0, 0, 0, 0, 0, 0], 1_000)]
    {
        let mut bench = Bench::new(|_| {});
        let now = bench.now;
        bench.sim.receive_of_all(now, other(9), &search(context, 0x63));
        // From another network, what asks for no list, and what is no frame.
        let far = SocketAddrV4::new(Ipv4Addr::new(10, 0, 1, 1), 9);
        bench.sim.receive_of_all(now, far, &search(context, 0x63));
        bench.sim.receive_of_all(now, other(9), &search(context, 0x65));
        bench.sim.receive_of_all(now, other(9), b"hello");
        let mut found = Vec::new();
        for ms in 0..=within_ms {
            bench.sim.run(now + ms * MS, &mut |socket, to, bytes| found.push((socket, to, bytes.to_vec())));
        }
        let [(socket, to, bytes)] = &found[..] else { panic!("{found:?}") };
        assert_eq!((*socket, *to, &bytes[12..20]), (DISCOVERY, other(9), &context[..]));
        assert_eq!(
            bytes[24..],
            bench.at(DISCOVERY, other(9), &search(context, 0x63))[24..],
            "as one by itself"
        );
    }
}
