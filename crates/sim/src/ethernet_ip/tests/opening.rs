//! Opening and closing: the table of errors row by row, ids, ownership, groups, intervals.

use super::*;

/// The additional words of the answer: those of a refusal, none if it is opened.
fn refusal(bench: &mut Bench, open: &Forward) -> Vec<u16> {
    let reply = bench.message(&open.bytes());
    let words = usize::from(reply[3]);
    assert_eq!(reply[..3], [open.service | 0x80, 0, u8::from(words > 0)]);
    if words > 0 {
        let rest = &reply[4 + 2 * words..];
        assert_eq!(rest[..2], open.serial.to_le_bytes());
        assert_eq!(rest.len(), 10, "triad and remaining path");
    }
    reply[4..].chunks_exact(2).take(words).map(|word| u16::from_le_bytes([word[0], word[1]])).collect()
}

/// That of an open with one change, of a new drive.
fn row(change: impl FnOnce(&mut Forward)) -> Vec<u16> {
    let mut open = Forward::default();
    change(&mut open);
    refusal(&mut Bench::new(|_| {}), &open)
}

fn path(path: &str) -> Vec<u16> {
    row(|open| open.path = hex(path))
}

const OPENS: [u16; 0] = [];

#[test]
fn a_wrong_open_is_refused_with_the_reason() {
    assert_eq!(row(|_| {}), OPENS);
    assert_eq!(row(|open| open.ncp.0 = 0x4844), [0x0127, 70]);
    assert_eq!(row(|open| open.ncp.1 = 0x4838), [0x0128, 58]);
    assert_eq!(row(|open| open.ncp.0 = 0x6846), [0x0123]);
    assert_eq!(row(|open| open.ncp.1 = 0x683A), [0x0124]);
    assert_eq!(row(|open| open.ncp.0 = 0x0846), [0x0123], "nothing to the drive");
    assert_eq!(row(|open| open.ncp.0 = 0x2846), [0x0123], "a group to the drive");
    assert_eq!(row(|open| open.ncp = (0x0846, 0x083A)), [0x0132]);
    assert_eq!(row(|open| open.ncp.0 = 0xC846), [0x0125]);
    assert_eq!(row(|open| open.transport = 0x31), [0x0103]);
    assert_eq!(row(|open| open.transport = 0x02), [0x0103]);
    assert_eq!(row(|open| open.multiplier = 8), [0x0133]);
    assert_eq!(path("20 04 24 77 2C 70 2C 65"), [0x0315]);
    assert_eq!(path("20 04 24 66 2C 71 2C 65"), [0x012F]);
    assert_eq!(path("20 04 24 66 2C 70 2C 63"), [0x012F]);
    assert_eq!(path("20 05 24 66 2C 70 2C 65"), [0x012F]);
    assert_eq!(path("20 04 24 66 2C 70"), [0x0315]);
    assert_eq!(path("01 00 20 04 24 66 2C 70 2C 65"), [0x0315], "a route");
    assert_eq!(path("20 04 24 66 2C 70 2C 65 2C 65"), [0x0315]);
    assert_eq!(path("20 04 24 66 2C 70 2C 65 80 02 00 00 00 00"), [0x0129]);
    assert_eq!(path("43 0B 20 04 24 66 2C 70 2C 65"), [0x011B]);
    assert_eq!(path("43 0A 20 04 24 66 2C 70 2C 65"), OPENS);
    assert_eq!(path("20 04 24 66 2C 70 2C 65 80 01 00 00"), OPENS);
    assert_eq!(path("21 00 04 00 25 00 66 00 2D 00 70 00 2D 00 65 00"), OPENS, "16-bit segments");
    assert_eq!(path("20 04 26 00 66 00 00 00 2C 70 2C 65"), OPENS, "32-bit ones");
}

#[test]
fn an_electronic_key_is_checked_in_its_order_and_a_length_before_it() {
    let key = |key: &str| path(&format!("34 04 {key} {OWNER}"));
    for (bytes, expected) in [
        ("00 00 00 00 00 00 00 00", &OPENS[..]),
        ("3C 00 2B 00 01 00 01 01", &OPENS),
        // The vendor, and the product before the type.
        ("3D 00 2C 00 01 00 02 01", &[0x0114]),
        ("3C 00 2C 00 02 00 01 01", &[0x0114]),
        ("3C 00 2C 00 01 00 02 01", &[0x0115]),
        ("3C 00 2B 00 01 00 02 01", &[0x0116]),
        ("3C 00 2B 00 01 00 01 02", &[0x0116]),
        // Compatible.
        ("3C 00 2B 00 01 00 81 01", &OPENS),
        ("3C 00 2B 00 01 00 81 00", &[0x0116]),
        ("3C 00 2B 00 01 00 81 02", &[0x0116]),
    ] {
        assert_eq!(key(bytes), expected, "{bytes}");
    }
    assert_eq!(path(&format!("34 05 00 00 00 00 00 00 00 00 {OWNER}")), [0x0315], "its format");
    // A wrong length has no extended status; without a triad there is none to repeat.
    let mut bench = Bench::new(|_| {});
    let bytes = Forward::default().bytes();
    for (part, status, length) in [
        (&bytes[..bytes.len() - 1], 0x13, 14),
        (&[&bytes[..], &[0]].concat(), 0x15, 14),
        (&bytes[..20], 0x13, 4),
        (&bytes[..6], 0x13, 4),
    ] {
        let reply = bench.message(part);
        assert_eq!((&reply[..4], reply.len()), (&[0xD4, 0, status, 0][..], length));
    }
    assert_eq!(bench.sim.connections(), (1, 0));
}

#[test]
fn one_owner_at_a_time_one_connection_a_triad_and_a_bound_of_each_kind() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward::default());
    assert_eq!(refusal(&mut bench, &Forward::default()), [0x0100]);
    let second = Forward { serial: 9, ..Forward::default() };
    assert_eq!(refusal(&mut bench, &second), [0x0106]);
    assert_eq!(bench.message(&Forward::default().close())[2], 0);
    assert_eq!(refusal(&mut bench, &second), OPENS);
    for (kind, first, most) in [(Forward::messages(), 10, 6), (Forward::input_only(), 20, 3)] {
        let open = |serial| Forward { serial, ..kind.clone() };
        for serial in first..first + most {
            bench.open(&open(serial));
        }
        assert_eq!(refusal(&mut bench, &open(first)), [0x0100]);
        assert_eq!(refusal(&mut bench, &open(29)), [0x0113]);
    }
}

#[test]
fn what_is_refused_depends_on_the_kind_and_on_the_settings() {
    type Change = fn(&mut MoonsSettings);
    let usual: Change = |_| {};
    let needs: Change = |settings| settings.network.configuration = Configuration::Required;
    let needs_size: Change = |settings| {
        settings.network.configuration = Configuration::Required;
        settings.network.configuration_error = ConfigurationError::Size;
    };
    let refuses: Change = |settings| {
        settings.network.configuration = Configuration::Refused;
        settings.network.configuration_error = ConfigurationError::NotConfigured;
    };
    let small: Change = |settings| settings.network.mask = Ipv4Addr::new(255, 255, 255, 254);
    let plain = Forward::default();
    let data = Forward { path: hex(&format!("{OWNER} 80 01 00 00")), ..Forward::default() };
    let six = Forward { ncp: (0x4806, 0x483A), ..Forward::input_only() };
    let none = Forward { ncp: (0x4800, 0x483A), ..Forward::input_only() };
    let sizes = (0x4200_0FA0, 0x4200_0FA0);
    for (row, (settings, open, expected)) in [
        // Class 3.
        (usual, Forward { path: hex("20 02 24 01 2C 65"), ..Forward::messages() }, &[0x0315][..]),
        (usual, Forward { service: 0x5B, ncp: sizes, ..Forward::messages() }, &[0x0127, 504]),
        (usual, Forward { ncp: (0x43F4, 0x23F4), ..Forward::messages() }, &[0x0124]),
        (usual, Forward { transport: 0x23, ..Forward::messages() }, &OPENS),
        (needs, plain.clone(), &[0x0129]),
        (needs, data.clone(), &OPENS),
        (needs_size, plain, &[0x0126, 1]),
        (refuses, data, &[0x0110]),
        // Heartbeats have their size.
        (usual, six.clone(), &[0x0127, 2]),
        (|settings| settings.network.heartbeat = 6, six, &OPENS),
        (|settings| settings.network.heartbeat = 0, none, &OPENS),
        // A group is for the drive's own network.
        (small, Forward { ncp: (0x4846, 0x283A), ..Forward::default() }, &[0x0813]),
    ]
    .into_iter()
    .enumerate()
    {
        assert_eq!(refusal(&mut Bench::new(settings), &open), expected, "row {row}");
    }
}

#[test]
fn a_v1_drive_has_no_outputs_and_only_its_own_inputs() {
    let mut bench = Bench::new(|settings| settings.identity.board = (250, 9));
    assert_eq!(refusal(&mut bench, &Forward::default()), [0x012F]);
    assert_eq!(refusal(&mut bench, &Forward::input_only()), [0x012F]);
    let short = Forward { path: hex("20 04 24 66 2C 67 2C 64"), ..Forward::input_only() };
    assert_eq!(refusal(&mut bench, &short), [0x0128, 32]);
    let short = Forward { ncp: (0x4802, 0x4820), ..short };
    bench.open(&short);
    bench.pass(0);
    assert_eq!(bench.sent[0].2.len(), 18 + 32);
    // A V2 drive has them, too.
    Bench::new(|_| {}).open(&short);
}

#[test]
fn listening_needs_somebody_who_requests_and_ends_with_the_last_of_them() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(refusal(&mut bench, &Forward::listen_only()), [0x0119]);
    bench.open(&Forward::default());
    bench.open(&Forward::input_only());
    // It gets what another one has requested, as often as that.
    let slower = Forward { us: (10_000, 20_000), ..Forward::listen_only() };
    assert_eq!(refusal(&mut bench, &slower), [0x0112]);
    bench.open(&Forward::listen_only());
    bench.message(&Forward::default().close());
    assert_eq!(bench.sim.connections().1, 2);
    bench.message(&Forward::input_only().close());
    assert_eq!(bench.sim.connections().1, 0);
}

#[test]
fn the_intervals_are_rounded_up_to_the_drives_tick() {
    type Change = fn(&mut MoonsSettings);
    let rows: [(Change, _, _); 4] = [
        (|_| {}, (2_500, 11_000), (2_500_u32, 11_000_u32)),
        (|settings| settings.network.tick_ns = 2 * MS, (2_500, 11_000), (4_000, 12_000)),
        (|settings| settings.network.least_rpi_ns = 4 * MS, (2_500, 11_000), (4_000, 11_000)),
        (|_| {}, (0, 0), (1_000, 1_000)),
    ];
    for (settings, us, apis) in rows {
        let reply = Bench::new(settings).open(&Forward { us, ..Forward::default() });
        assert_eq!((word_of(&reply, 20), word_of(&reply, 24)), apis, "{us:?}");
    }
    let mut strict = Bench::new(|settings| {
        (settings.network.least_rpi_ns, settings.network.short_rpi) = (4 * MS, ShortRpi::Refused);
    });
    assert_eq!(refusal(&mut strict, &Forward { us: (2_500, 11_000), ..Forward::default() }), [0x0111]);
    assert_eq!(row(|open| open.us.0 = u32::MAX), OPENS);
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
        refusal(bench, &other)
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
    assert_eq!(refusal(&mut timed_out(Ownership::Released), &stranger), OPENS);
    let mut kept = timed_out(Ownership::Kept);
    assert_eq!(refusal(&mut kept, &stranger), [0x0106]);
    assert_eq!(refusal(&mut kept, &Forward::default()), OPENS, "the same serial again");
    kept.message(&Forward::default().close());
    assert_eq!(refusal(&mut kept, &stranger), OPENS, "closed, not timed out");
    let mut kept = timed_out(Ownership::Kept);
    kept.power_cycle();
    assert_eq!(refusal(&mut kept, &stranger), OPENS);
}
