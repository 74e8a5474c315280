//! Opening and closing: the table of errors row by row, ids, ownership, groups, intervals.

use super::*;

/// General status and additional words of the answer.
fn refusal(bench: &mut Bench, open: &Forward) -> (u8, Vec<u16>) {
    let reply = bench.message(&open.bytes());
    assert_eq!(reply[..2], [open.service | 0x80, 0]);
    let words = usize::from(reply[3]);
    if reply[2] != 0 {
        let rest = &reply[4 + 2 * words..];
        assert_eq!(rest[..2], open.serial.to_le_bytes());
        assert_eq!(rest.len(), 10, "triad and remaining path");
    }
    let word = |k: usize| u16::from_le_bytes([reply[4 + 2 * k], reply[5 + 2 * k]]);
    (reply[2], (0..words).map(word).collect())
}

/// With a connection of somebody else: 0x0106 and so on do not hide the row.
fn row(change: impl FnOnce(&mut Forward)) -> (u8, Vec<u16>) {
    let mut open = Forward::default();
    change(&mut open);
    refusal(&mut Bench::new(|_| {}), &open)
}

fn extended(words: &[u16]) -> (u8, Vec<u16>) {
    (1, words.to_vec())
}

fn path(path: &str) -> (u8, Vec<u16>) {
    row(|open| open.path = hex(path))
}

#[test]
fn a_wrong_open_is_refused_with_the_reason() {
    assert_eq!(row(|_| {}), (0, vec![]));
    assert_eq!(row(|open| open.ncp.0 = 0x4844), extended(&[0x0127, 70]));
    assert_eq!(row(|open| open.ncp.1 = 0x4838), extended(&[0x0128, 58]));
    assert_eq!(row(|open| open.ncp.0 = 0x6846), extended(&[0x0123]));
    assert_eq!(row(|open| open.ncp.1 = 0x683A), extended(&[0x0124]));
    assert_eq!(row(|open| open.ncp.0 = 0x0846), extended(&[0x0123]), "nothing to the drive");
    assert_eq!(row(|open| open.ncp.0 = 0x2846), extended(&[0x0123]), "a group to the drive");
    assert_eq!(row(|open| open.ncp = (0x0846, 0x083A)), extended(&[0x0132]));
    assert_eq!(row(|open| open.ncp.0 = 0xC846), extended(&[0x0125]));
    assert_eq!(row(|open| open.transport = 0x31), extended(&[0x0103]));
    assert_eq!(row(|open| open.transport = 0x02), extended(&[0x0103]));
    assert_eq!(row(|open| open.multiplier = 8), extended(&[0x0133]));
    assert_eq!(path("20 04 24 77 2C 70 2C 65"), extended(&[0x0315]));
    assert_eq!(path("20 04 24 66 2C 71 2C 65"), extended(&[0x012F]));
    assert_eq!(path("20 04 24 66 2C 70 2C 63"), extended(&[0x012F]));
    assert_eq!(path("20 05 24 66 2C 70 2C 65"), extended(&[0x012F]));
    assert_eq!(path("20 04 24 66 2C 70"), extended(&[0x0315]));
    assert_eq!(path("01 00 20 04 24 66 2C 70 2C 65"), extended(&[0x0315]), "a route");
    assert_eq!(path("20 04 24 66 2C 70 2C 65 2C 65"), extended(&[0x0315]));
    assert_eq!(path("20 04 24 66 2C 70 2C 65 80 02 00 00 00 00"), extended(&[0x0129]));
    assert_eq!(path("43 0B 20 04 24 66 2C 70 2C 65"), extended(&[0x011B]));
    assert_eq!(path("43 0A 20 04 24 66 2C 70 2C 65"), (0, vec![]));
    assert_eq!(path("20 04 24 66 2C 70 2C 65 80 01 00 00"), (0, vec![]));
    assert_eq!(path("21 00 04 00 25 00 66 00 2D 00 70 00 2D 00 65 00"), (0, vec![]), "16-bit segments");
    assert_eq!(path("20 04 26 00 66 00 00 00 2C 70 2C 65"), (0, vec![]), "32-bit ones");
}

#[test]
fn an_open_of_a_wrong_length_has_no_extended_status() {
    let mut bench = Bench::new(|_| {});
    let bytes = Forward::default().bytes();
    let short = bench.message(&bytes[..bytes.len() - 1]);
    assert_eq!((&short[..4], short.len()), (&hex("D4 00 13 00")[..], 14));
    let long = bench.message(&[&bytes[..], &[0]].concat());
    assert_eq!(long[..4], hex("D4 00 15 00"));
    assert_eq!(bench.message(&bytes[..20])[..4], hex("D4 00 13 00"));
    assert_eq!(bench.message(&bytes[..6]), hex("D4 00 13 00"), "no triad to repeat");
    assert_eq!(bench.sim.connections(), (1, 0));
}

#[test]
fn an_electronic_key_is_checked_in_its_order() {
    let key = |key: &str| path(&format!("34 04 {key} {OWNER}"));
    assert_eq!(key("00 00 00 00 00 00 00 00"), (0, vec![]));
    assert_eq!(key("3C 00 2B 00 01 00 01 01"), (0, vec![]));
    assert_eq!(key("3D 00 2C 00 01 00 02 01"), extended(&[0x0114]), "vendor");
    assert_eq!(key("3C 00 2C 00 02 00 01 01"), extended(&[0x0114]), "product before the type");
    assert_eq!(key("3C 00 2C 00 01 00 02 01"), extended(&[0x0115]));
    assert_eq!(key("3C 00 2B 00 01 00 02 01"), extended(&[0x0116]));
    assert_eq!(key("3C 00 2B 00 01 00 01 02"), extended(&[0x0116]));
    assert_eq!(key("3C 00 2B 00 01 00 81 01"), (0, vec![]), "compatible");
    assert_eq!(key("3C 00 2B 00 01 00 81 00"), extended(&[0x0116]));
    assert_eq!(key("3C 00 2B 00 01 00 81 02"), extended(&[0x0116]));
    assert_eq!(path(&format!("34 05 00 00 00 00 00 00 00 00 {OWNER}")), extended(&[0x0315]), "its format");
}

#[test]
fn one_owner_at_a_time_and_one_connection_a_triad() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward::default());
    assert_eq!(refusal(&mut bench, &Forward::default()), extended(&[0x0100]));
    let second = Forward { serial: 9, ..Forward::default() };
    assert_eq!(refusal(&mut bench, &second), extended(&[0x0106]));
    assert_eq!(bench.message(&Forward::default().close())[2], 0);
    assert_eq!(refusal(&mut bench, &second), (0, vec![]));
}

#[test]
fn connections_of_each_kind_are_bounded() {
    let mut bench = Bench::new(|_| {});
    for serial in 0..6 {
        bench.open(&Forward { serial, ..Forward::messages() });
    }
    assert_eq!(refusal(&mut bench, &Forward::messages()).1, [0x0100]);
    assert_eq!(refusal(&mut bench, &Forward { serial: 9, ..Forward::messages() }), extended(&[0x0113]));
    for serial in 20..23 {
        bench.open(&Forward { serial, ..Forward::input_only() });
    }
    assert_eq!(refusal(&mut bench, &Forward { serial: 29, ..Forward::input_only() }), extended(&[0x0113]));
}

#[test]
fn a_class_3_open_is_refused_with_the_reason() {
    let mut bench = Bench::new(|_| {});
    let path = Forward { path: hex("20 02 24 01 2C 65"), ..Forward::messages() };
    assert_eq!(refusal(&mut bench, &path), extended(&[0x0315]));
    let large = Forward { service: 0x5B, ncp: (0x4200_0FA0, 0x4200_0FA0), ..Forward::messages() };
    assert_eq!(refusal(&mut bench, &large), extended(&[0x0127, 504]));
    let group = Forward { ncp: (0x43F4, 0x23F4), ..Forward::messages() };
    assert_eq!(refusal(&mut bench, &group), extended(&[0x0124]));
    assert_eq!(refusal(&mut bench, &Forward { transport: 0x23, ..Forward::messages() }), (0, vec![]));
}

#[test]
fn configuration_data_is_needed_or_refused_as_set() {
    let with = Forward { path: hex(&format!("{OWNER} 80 01 00 00")), ..Forward::default() };
    let mut strict = Bench::new(|settings| settings.network.configuration = Configuration::Required);
    assert_eq!(refusal(&mut strict, &Forward::default()), extended(&[0x0129]));
    assert_eq!(refusal(&mut strict, &with), (0, vec![]));
    let mut modern = Bench::new(|settings| {
        settings.network.configuration = Configuration::Required;
        settings.network.configuration_error = ConfigurationError::Size;
    });
    assert_eq!(refusal(&mut modern, &Forward::default()), extended(&[0x0126, 1]));
    let mut none = Bench::new(|settings| {
        settings.network.configuration = Configuration::Refused;
        settings.network.configuration_error = ConfigurationError::NotConfigured;
    });
    assert_eq!(refusal(&mut none, &with), extended(&[0x0110]));
}

#[test]
fn a_v1_drive_has_no_outputs_and_only_its_own_inputs() {
    let v1 = |settings: &mut MoonsSettings| settings.identity.board = (250, 9);
    let mut bench = Bench::new(v1);
    assert_eq!(refusal(&mut bench, &Forward::default()), extended(&[0x012F]));
    assert_eq!(refusal(&mut bench, &Forward::input_only()), extended(&[0x012F]));
    let short = Forward { path: hex("20 04 24 66 2C 67 2C 64"), ..Forward::input_only() };
    assert_eq!(refusal(&mut bench, &short), extended(&[0x0128, 32]));
    bench.open(&Forward { ncp: (0x4802, 0x4820), ..short.clone() });
    bench.pass(0);
    assert_eq!(bench.sent[0].2.len(), 18 + 32);
    // A V2 drive has them, too.
    Bench::new(|_| {}).open(&Forward { ncp: (0x4802, 0x4820), ..short });
}

#[test]
fn heartbeats_have_their_size() {
    let six = Forward { ncp: (0x4806, 0x483A), ..Forward::input_only() };
    assert_eq!(refusal(&mut Bench::new(|_| {}), &six), extended(&[0x0127, 2]));
    Bench::new(|settings| settings.network.heartbeat = 6).open(&six);
    let none = Forward { ncp: (0x4800, 0x483A), ..Forward::input_only() };
    Bench::new(|settings| settings.network.heartbeat = 0).open(&none);
}

#[test]
fn listening_needs_somebody_who_requests_and_ends_with_the_last_of_them() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(refusal(&mut bench, &Forward::listen_only()), extended(&[0x0119]));
    bench.open(&Forward::default());
    bench.open(&Forward::input_only());
    bench.open(&Forward::listen_only());
    bench.message(&Forward::default().close());
    assert_eq!(bench.sim.connections().1, 2);
    bench.message(&Forward::input_only().close());
    assert_eq!(bench.sim.connections().1, 0);
}

#[test]
fn the_intervals_are_rounded_up_to_the_drives_tick() {
    let apis = |reply: &[u8]| {
        let word = |at: usize| u32::from_le_bytes(reply[at..at + 4].try_into().unwrap());
        (word(20), word(24))
    };
    let open = Forward { us: (2_500, 11_000), ..Forward::default() };
    assert_eq!(apis(&Bench::new(|_| {}).open(&open)), (2_500, 11_000));
    let mut coarse = Bench::new(|settings| settings.network.tick_ns = 2 * MS);
    assert_eq!(apis(&coarse.open(&open)), (4_000, 12_000));
    let mut slow = Bench::new(|settings| settings.network.least_rpi_ns = 4 * MS);
    assert_eq!(apis(&slow.open(&open)), (4_000, 11_000));
    let mut strict = Bench::new(|settings| {
        (settings.network.least_rpi_ns, settings.network.short_rpi) = (4 * MS, ShortRpi::Refused);
    });
    assert_eq!(refusal(&mut strict, &open), extended(&[0x0111]));
    assert_eq!(apis(&Bench::new(|_| {}).open(&Forward { us: (0, 0), ..Forward::default() })), (1_000, 1_000));
    assert_eq!(row(|open| open.us.0 = u32::MAX), (0, vec![]));
}

#[test]
fn a_group_is_shared_by_those_who_ask_alike() {
    let mut bench = Bench::new(|_| {});
    let open = Forward { ncp: (0x4846, 0x283A), ..Forward::default() };
    let (reply, items) = bench.message_of(MASTER, bench.session, &open.bytes(), &[]);
    // host = 2 - 1: 239.192.1.32
    let expected = "00 80 10 00 00 02 08 AE 00 00 00 00 00 00 00 00 00 00 00 00 \
                    01 80 10 00 00 02 08 AE EF C0 01 20 00 00 00 00 00 00 00 00";
    assert_eq!(items, hex(expected));
    let id = reply[8..12].to_vec();
    assert_eq!(id, hex("14 00 01 5A"), "the producer's choice");
    let like = Forward { ncp: (0x4802, 0x283A), ..Forward::input_only() };
    assert_eq!(bench.open(&like)[8..12], id);
    let refused = |bench: &mut Bench, change: fn(&mut Forward)| {
        let mut other = Forward { serial: 21, ..like.clone() };
        change(&mut other);
        refusal(bench, &other).1
    };
    assert_eq!(refused(&mut bench, |open| open.us.1 = 20_000), [0x0112]);
    assert_eq!(refused(&mut bench, |open| open.ncp.1 = 0x2A3A), [0x0135]);
    assert_eq!(refused(&mut bench, |open| open.ncp.1 = 0x243A), [0x0136]);
    assert_eq!(refused(&mut bench, |open| open.transport = 0x11), [0x0138]);
    bench.pass(15 * MS);
    let group = SocketAddrV4::new(Ipv4Addr::new(239, 192, 1, 32), 2_222);
    let to: Vec<_> = bench.sent.iter().map(|(_, to, _)| *to).collect();
    assert_eq!(to, [group; 2], "one packet for both");
    // The owner closes: the packets go on for the other one.
    bench.message(&open.close());
    bench.pass(10 * MS);
    assert_eq!(bench.sent.len(), 3);
    bench.message(&like.close());
    bench.pass(S);
    assert_eq!(bench.sent.len(), 3);
}

#[test]
fn a_group_is_for_the_drives_own_network() {
    let mut bench = Bench::new(|settings| settings.network.mask = Ipv4Addr::new(255, 255, 255, 254));
    let open = Forward { ncp: (0x4846, 0x283A), ..Forward::default() };
    assert_eq!(refusal(&mut bench, &open), extended(&[0x0813]));
}

#[test]
fn the_originator_chooses_its_port() {
    let mut bench = Bench::new(|settings| settings.network.announces_port = false);
    let port = hex("01 80 10 00 00 02 13 88 00 00 00 00 00 00 00 00 00 00 00 00");
    let (_, items) = bench.message_of(MASTER, bench.session, &Forward::default().bytes(), &port);
    assert_eq!(items, port, "repeated");
    bench.pass(0);
    assert_eq!(bench.sent[0].1, SocketAddrV4::new(*MASTER.ip(), 5_000));
    // A group has its own port.
    let group = Forward { serial: 3, ncp: (0x4802, 0x283A), path: hex(INPUT_ONLY), ..Forward::default() };
    let (reply, _) = bench.message_of(MASTER, bench.session, &group.bytes(), &port);
    assert_eq!(reply[2..6], [1, 1, 0x08, 0x01]);
}

#[test]
fn only_the_host_that_opened_closes() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward::default());
    let foreign = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 9), 1);
    let session = bench.connect(foreign);
    let (reply, _) = bench.message_of(foreign, session, &Forward::default().close(), &[]);
    assert_eq!(reply[..4], [0xCE, 0, 0x0F, 0]);
    let unknown = Forward { serial: 99, ..Forward::default() };
    let reply = bench.message(&unknown.close());
    assert_eq!(reply, hex("CE 00 01 01 07 01 63 00 34 12 EE FF C0 00 04 00"));
    // The path is not looked at.
    let other = Forward { path: hex(INPUT_ONLY), ..Forward::default() };
    assert_eq!(bench.message(&other.close())[2], 0);
}

#[test]
fn an_owner_that_timed_out_leaves_the_drive_to_everybody_or_to_itself() {
    let timed_out = |ownership| {
        let mut bench = Bench::owned(|settings| settings.network.ownership = ownership);
        bench.pass(160 * MS);
        assert_eq!(bench.sim.connections().1, 0);
        bench.sim.disconnected(bench.now, MASTER);
        bench.session = bench.connect(MASTER);
        bench
    };
    let stranger = Forward { originator: 1, serial: 5, ..Forward::default() };
    assert_eq!(refusal(&mut timed_out(Ownership::Released), &stranger), (0, vec![]));
    let mut kept = timed_out(Ownership::Kept);
    assert_eq!(refusal(&mut kept, &stranger), extended(&[0x0106]));
    assert_eq!(refusal(&mut kept, &Forward::default()), (0, vec![]), "the same serial again");
    kept.message(&Forward::default().close());
    assert_eq!(refusal(&mut kept, &stranger), (0, vec![]), "closed, not timed out");
    let mut kept = timed_out(Ownership::Kept);
    kept.sim.disconnected(kept.now, MASTER);
    kept.sim.restart(kept.now);
    kept.pass(S);
    kept.session = kept.connect(MASTER);
    assert_eq!(refusal(&mut kept, &stranger), (0, vec![]));
}
