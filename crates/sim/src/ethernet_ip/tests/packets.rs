//! Class 1: what is accepted, what feeds, and when the drive sends.

use super::*;

/// A packet with these numbers.
fn send(bench: &mut Bench, sequence: u32, count: u16, word: u32) {
    let bytes = packet(bench.id, sequence, count, 1, &outputs(word, &[]));
    bench.at(PACKETS, MASTER_IO, &bytes);
}

#[test]
fn the_drive_sends_at_once_and_then_by_its_clock() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward { us: (10_000, 4_000), ..Forward::default() });
    let begin = bench.now;
    bench.pass(40 * MS);
    let at: Vec<u64> = bench.sent.iter().map(|(at, ..)| at.since(begin)).collect();
    assert_eq!(at, (0..=10).map(|k| k * 4 * MS).collect::<Vec<_>>());
    for (k, (_, to, packet)) in (1..).zip(&bench.sent) {
        assert_eq!((*to, packet.len()), (MASTER_IO, 76));
        assert_eq!(packet[..6], hex("02 00 02 80 08 00"));
        assert_eq!((word_of(packet, 6), word_of(packet, 10)), (0x0001_0001, k));
        assert_eq!(packet[14..20], [0xB1, 0, 58, 0, k as u8, 0]);
    }
    // Late, it sends one packet and no burst.
    let begin = bench.now;
    bench.now = begin + 95 * MS;
    bench.pass(0);
    assert_eq!(bench.sent.len(), 12);
    bench.pass(MS);
    assert_eq!((bench.sent.len(), bench.sent.last().unwrap().0), (13, begin + 96 * MS));
}

#[test]
fn its_clock_drifts_and_its_packets_jitter_but_their_schedule_does_not() {
    let mut bench = Bench::new(|settings| settings.clock.drift_ppm = 200);
    bench.open(&Forward { multiplier: 7, ..Forward::default() });
    let begin = bench.now;
    bench.pass(10 * S);
    let last = bench.sent.last().unwrap();
    assert_eq!(last.0.since(begin), 999 * 10_002_000);
    let mut bench = Bench::new(|settings| {
        settings.clock = ClockSettings { drift_ppm: 0, jitter_ns: MS, seed: 7 };
    });
    bench.open(&Forward { multiplier: 7, ..Forward::default() });
    let begin = bench.now;
    bench.pass(9_995 * MS);
    assert_eq!(bench.sent.len(), 1_000);
    let late: Vec<u64> =
        bench.sent.iter().zip(0..).map(|((at, ..), k)| at.since(begin) - k * 10 * MS).collect();
    assert!(late.iter().all(|late| *late <= MS), "never early, at most so much late");
    assert!(late.iter().filter(|late| **late > MS / 2).count() > 300, "it does jitter");
}

#[test]
fn packets_that_are_not_the_connections_own_feed_nobody() {
    let mut bench = Bench::owned(|_| {});
    let good = packet(bench.id, 50, 50, 1, &outputs(0x2, &[]));
    let stranger = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 7), 2_222);
    let change = |at: usize, value: u8| {
        let mut bytes = good.clone();
        bytes[at] = value;
        (MASTER_IO, bytes)
    };
    let wrong = [
        (stranger, good.clone()),
        change(6, 0x55),
        // The connected address of class 3, and unconnected data.
        change(2, 0xA1),
        change(14, 0xB2),
        (MASTER_IO, good[..good.len() - 1].to_vec()),
        // Without the run/idle header, and with a byte more.
        (MASTER_IO, [&good[..16], &[66], &good[17..20], &good[24..]].concat()),
        (MASTER_IO, [&good[..16], &[71], &good[17..], &[0]].concat()),
        // A byte behind the last item.
        (MASTER_IO, [&good[..], &[0]].concat()),
    ];
    for (from, bytes) in &wrong {
        assert_eq!(bench.at(PACKETS, *from, bytes), [0; 0]);
    }
    let expected = Ignored {
        wrong_source: 1,
        unknown_connection: 1,
        wrong_items: 3,
        wrong_length: 3,
        ..Ignored::default()
    };
    assert_eq!((bench.sim.ignored(), bench.status()), (expected, 0));
    // Any port of the right host will do.
    bench.at(PACKETS, SocketAddrV4::new(*MASTER.ip(), 9), &good);
    assert_eq!(bench.status(), 1);
    for _ in 0..20 {
        bench.pass(10 * MS);
        wrong.iter().for_each(|(from, bytes)| drop(bench.at(PACKETS, *from, bytes)));
    }
    assert_eq!(bench.sim.connections().1, 0);
}

#[test]
fn an_older_packet_is_dropped_and_does_not_feed() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward::default());
    // The first one is accepted whatever it is, and the numbers go round.
    send(&mut bench, u32::MAX, 1, 0);
    send(&mut bench, 1, 2, 0x2);
    assert_eq!(bench.status(), 1);
    for old in [1, 0, u32::MAX, 0x8000_0001] {
        send(&mut bench, old, 3, 0);
    }
    assert_eq!(bench.sim.ignored().old_sequence, 4);
    bench.pass(159 * MS);
    send(&mut bench, 1, 3, 0);
    bench.pass(MS);
    assert_eq!(bench.sim.connections().1, 0);
}

#[test]
fn data_that_is_not_new_feeds_and_does_not_act() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward::default());
    send(&mut bench, 1, 0, 0x2);
    assert_eq!((bench.sim.ignored().duplicate, bench.status()), (1, 0), "0 is not ahead of 0");
    send(&mut bench, 2, 1, 0x2);
    assert_eq!(bench.status(), 1);
    for sequence in 3..20 {
        bench.pass(100 * MS);
        send(&mut bench, sequence, if sequence % 2 == 0 { 1 } else { 0xFFF0 }, 0x4);
    }
    assert_eq!((bench.sim.ignored().duplicate, bench.status(), bench.sim.connections().1), (18, 1, 1));
    let mut bench = Bench::new(|settings| settings.network.counts_forward = false);
    bench.open(&Forward::default());
    send(&mut bench, 1, 0, 0x2);
    assert_eq!(
        (bench.sim.ignored().duplicate, bench.status()),
        (0, 1),
        "the other rule: only another one counts"
    );
    send(&mut bench, 2, 0, 0x4);
    assert_eq!((bench.sim.ignored().duplicate, bench.status()), (1, 1));
}

#[test]
fn an_idle_owner_feeds_and_does_not_act() {
    let mut bench = Bench::enabled(|_| {});
    bench.packet(0, &outputs(0x4, &[]));
    assert_eq!((bench.status(), bench.sim.ignored().idle), (1, 1));
    for _ in 0..100 {
        bench.pass(50 * MS);
        bench.packet(0, &outputs(0, &[]));
    }
    assert_eq!((bench.status(), bench.sim.connections().1), (1, 1));
    // 0 in idle is no 0 between.
    bench.word(0x4);
    bench.word(0);
    bench.word(0x2);
    bench.packet(0, &outputs(0, &[]));
    bench.word(0x2);
    assert_eq!(bench.status(), 1);
    // Nor is a word that comes in idle a change once it runs.
    bench.word(0);
    bench.packet(0, &outputs(0x4, &[]));
    bench.word(0x4);
    assert_eq!(bench.status(), 1);
    bench.word(0);
    bench.command(0x10000, &[(1, 240), (2, 600), (3, 600)]);
    bench.idle_for(100 * MS);
    bench.packet(0, &outputs(0, &[]));
    assert_eq!(bench.status() & 0x60, 0x20, "it jogs on");
    let mut stops = Bench::enabled(|settings| settings.firmware.idle = Idle::Stops);
    stops.command(0x10000, &[(1, 240), (2, 600), (3, 600)]);
    stops.idle_for(100 * MS);
    stops.packet(0, &outputs(0, &[]));
    assert_eq!(stops.status() & 0x60, 0x60);
}

#[test]
fn the_inputs_are_alive_in_both_layouts() {
    let look = |layout| {
        let mut bench = Bench::enabled(|settings| {
            settings.firmware.layout = layout;
            settings.motor.encoder = Some(0.2);
        });
        bench.command(0x8, &[(4, 1_200), (5, 600), (6, 600), (7, -100_000)]);
        bench.idle_for(500 * MS);
        let packet = bench.sent.last().unwrap().2.clone();
        (0..14).map(|element| word_of(&packet, 20 + 4 * element) as i32).collect::<Vec<_>>()
    };
    use fieldbeat_ethernet_ip::plan::Layout;
    let manual = look(Layout::Manual);
    assert_eq!(manual[..4], [0x0011, 0, 478, 1_500]);
    assert!((-60_000..-30_000).contains(&manual[6]), "{manual:?}");
    assert!((manual[5] - manual[6] / 5).abs() < 100, "{manual:?}");
    assert!((-1_210..-1_190).contains(&manual[8]), "5 rev/s: {manual:?}");
    assert_eq!(manual[9..], [0, 0xFF, 0, 8_192, 8_192]);
    let page = look(Layout::Page);
    assert_eq!((page[7], page[8..11].to_vec()), (manual[8], vec![0, 0xFF, 0]));
}
