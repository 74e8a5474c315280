//! From the first byte to the connection, and what is tried when the drive refuses.

use super::*;

/// Groups that only count who is in them.
#[derive(Debug, Default)]
struct Members(Mutex<BTreeMap<SocketAddrV4, usize>>);

impl Groups for Members {
    fn join(&self, group: SocketAddrV4) -> std::io::Result<()> {
        if !group.ip().is_multicast() {
            return Err(std::io::Error::other("it is none"));
        }
        *self.0.lock().unwrap().entry(group).or_default() += 1;
        Ok(())
    }

    fn leave(&self, group: SocketAddrV4) {
        *self.0.lock().unwrap().get_mut(&group).unwrap() -= 1;
    }
}

/// The opening with this serial number, and with other bytes in it.
fn changed(serial: u16, changes: &[(&str, &str)]) -> String {
    changes.iter().fold(of(serial, OPEN), |open, (from, to)| open.replace(from, to))
}

/// The bytes of configuration that a drive may want.
const TWO_ZEROS: (&str, &str) =
    ("01 04 20 04 24 66 2C 70 2C 65", "01 06 20 04 24 66 2C 70 2C 65 80 01 00 00");

#[test]
fn the_register_of_its_reference_is_read_before_the_opening() {
    for (answer, homed) in [
        ("BC 00 00 00 00 02 9F 33 00 00 00 01", Some(true)),
        ("BC 00 00 00 00 02 9F 33 00 00 00 00", Some(false)),
        // It does not know the register; it answers for another one.
        ("BC 00 20 00", None),
        ("BC 00 00 00 00 02 9F 34 00 00 00 01", None),
    ] {
        let mut bench = Bench::registered(|drive| drive.homed_register = Some(b'3'));
        bench.request("3C 03 20 64 24 01 30 01 00 02 9F 33 00 00 00 00");
        assert_eq!(bench.news(), []);
        bench.answer(answer);
        assert_eq!(bench.news(), [News::Read(Facts { homed })]);
        bench.request(OPEN);
    }
}

#[test]
fn a_unit_of_the_first_version_is_only_read_and_one_without_profile_code_needs_its_version() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(FIRST);
    let only_read = changed(1, &[("46 48", "02 48"), ("3A 48", "20 48"), ("2C 70 2C 65", "2C 67 2C 64")]);
    bench.trade(&only_read, OPENED);
    let (outputs, version) = (Outputs::Heartbeat(2), Version::V1);
    let expected = News::Opened(Connection { outputs, version, ..connection() });
    assert_eq!(bench.news(), [READ_NOTHING, expected]);
    // It was to be commanded.
    assert!(bench.session.remarks().get(0).is_some_and(|remark| remark.contains("version v1")));
    for (profile, parts) in [
        ("8E 00 05 00", ["STF05-IP of vendor 60 does not say which assemblies it has (path", "`version`"]),
        ("8E 00 00 00 00 FB", ["too short", ""]),
    ] {
        let mut bench = Bench::of_drive(|_| ());
        bench.register(profile);
        assert!(parts.iter().all(|part| bench.failed().contains(part)), "{}", bench.failed());
    }
    // With its version the drive is not read.
    let mut bench = Bench::of_drive(|drive| drive.version = Some(Version::V2));
    bench.begin();
    bench.trade(IDENTIFY, "81 00 08 00");
    bench.trade(OPEN, OPENED);
    assert_eq!(bench.session.remarks().get(0), None);
}

#[test]
fn a_refused_opening_is_tried_in_its_other_forms_and_then_reported() {
    type Change = fn(&mut MoonsDrive);
    let none: Change = |_| ();
    let listens: Change = |drive| (drive.connection, drive.heartbeat) = (Access::ListenOnly, Some(0));
    let reads: Change = |drive| drive.connection = Access::InputOnly;
    let six: Change = |drive| (drive.connection, drive.heartbeat) = (Access::InputOnly, Some(6));
    let data: Change = |drive| drive.configuration = Some(vec![1, 2]);
    let heartbeat = |size| vec![("46 48", size), ("2C 70", "2C 67")];
    let [of_none, of_2, of_6] = ["00 48", "02 48", "06 48"].map(heartbeat);
    let sizes = vec![of_2, of_6.clone(), of_none];
    let zeros = vec![vec![], vec![TWO_ZEROS]];
    let with_data = vec![(TWO_ZEROS.0, "01 06 20 04 24 66 2C 70 2C 65 80 01 01 02")];
    let configuration = "`configuration`; tried again after 1 s";
    let wants_74 =
        "10.0.0.40:44818: the drive refuses the connection: wrong O->T size (0x0127): the drive wants 74";
    for (change, forms, status, says) in [
        (listens, vec![vec![("46 48", "00 48"), ("2C 70", "2C 68")]], "01 01 19 01", "(0x0119)"),
        (listens, vec![vec![("46 48", "00 48"), ("2C 70", "2C 68")]], "01 01 19 01", "input-only"),
        // A size that is none of a heartbeat, or none at all.
        (reads, sizes.clone(), "01 01 27 01", "`heartbeat`"),
        (reads, sizes.clone(), "01 01 09 01", "`heartbeat`"),
        (reads, sizes, "01 02 27 01 46 00", "`heartbeat`"),
        (six, vec![of_6], "01 02 27 01 02 00", "the drive wants 2 bytes"),
        (none, zeros.clone(), "01 02 26 01 01 00", configuration),
        (none, zeros.clone(), "01 01 29 01", configuration),
        (none, zeros, "01 01 10 01", configuration),
        // What is configured is all there is.
        (data, vec![with_data], "01 01 29 01", ""),
        (none, vec![vec![]], "01 02 27 01 4A 00", wants_74),
        (none, vec![vec![]], "01 02 28 01 3E 00", "wrong T->O size (0x0128): the drive wants 62 bytes"),
    ] {
        let mut bench = Bench::registered(change);
        for (serial, form) in (1..).zip(forms) {
            bench.trade(&changed(serial, &form), &refused(serial, status));
        }
        bench.silence();
        bench.says(says);
    }
}

#[test]
fn the_form_that_a_drive_takes_is_kept() {
    let mut bench = Bench::opening();
    bench.answer(&refused(1, "01 01 29 01"));
    bench.trade(&changed(2, &[TWO_ZEROS]), &refused(2, "01 01 29 01"));
    // Then from the beginning.
    bench.pass(S + LOOK_NS);
    bench.trade(&of(3, OPEN), &refused(3, "01 01 29 01"));
    bench.trade(&changed(4, &[TWO_ZEROS]), &of(4, OPENED));
    bench.news();
    bench.wish(Wish::TimedOut { generation: 1 });
    bench.trade(&of(4, CLOSE), &of(4, CLOSED));
    bench.pass(S + LOOK_NS);
    bench.request(&changed(5, &[TWO_ZEROS]));
    // A size of heartbeats that it names.
    let mut bench = Bench::registered(|drive| drive.connection = Access::InputOnly);
    let sized = |serial, size| changed(serial, &[("46 48", size), ("2C 70", "2C 67")]);
    bench.trade(&sized(1, "02 48"), &refused(1, "01 02 27 01 00 00"));
    bench.trade(&sized(2, "00 48"), &of(2, OPENED));
    let news = bench.news();
    assert!(matches!(news[1], News::Opened(Connection { outputs: Outputs::Heartbeat(0), .. })), "{news:?}");
    // The large form, where there is no small one.
    let mut bench = Bench::opening();
    bench.answer(&refused(1, "08 00"));
    let large = "5B 02 20 06 24 01 0A 0E 00 00 00 00 02 00 01 00 02 00 34 12 EE FF C0 00 02 00 00 00 10 27 \
         00 00 46 00 00 48 10 27 00 00 3A 00 00 48 01 04 20 04 24 66 2C 70 2C 65";
    bench.trade(large, &of(2, OPENED).replace("D4 00", "DB 00"));
    assert!(matches!(bench.news()[..], [_, News::Opened(_)]));
}

#[test]
fn a_connection_in_use_gets_another_serial_number_at_once_and_then_pauses_that_grow() {
    let mut bench = Bench::opening();
    bench.answer(&refused(1, "01 01 00 01"));
    bench.trade(&of(2, OPEN), &refused(2, "01 01 00 01"));
    bench.silence();
    bench.pass(S - LOOK_NS);
    bench.silence();
    bench.pass(2 * LOOK_NS);
    bench.request(&of(3, OPEN));
    // With each refusal, until there is a connection.
    let mut bench = Bench::registered(|_| ());
    for (serial, pause_s) in (1..).zip([1, 2, 4, 8, 16, 16]) {
        bench.trade(&of(serial, OPEN), &refused(serial, "01 01 03 01"));
        assert!(bench.note().ends_with(&format!("tried again after {pause_s} s")), "{}", bench.note());
        bench.pass(pause_s * S - LOOK_NS);
        bench.silence();
        bench.pass(2 * LOOK_NS);
    }
    bench.trade(&of(7, OPEN), &of(7, OPENED));
    assert_eq!((bench.note(), bench.session.pause_ns), (String::new(), S));
}

#[test]
fn an_owned_drive_is_left_alone_for_one_watchdog_period_at_least() {
    // 512 intervals of 10 ms.
    let mut bench = Bench::registered(|drive| drive.multiplier = Some(7));
    let open = |serial| changed(serial, &[("02 00 00 00 10 27", "07 00 00 00 10 27")]);
    bench.trade(&open(1), &refused(1, "01 01 06 01"));
    let note = bench.note();
    assert!(note.contains("(0x0106)") && note.contains("another controller"), "{note}");
    assert!(note.ends_with("tried again after 5.12 s"), "{note}");
    bench.pass(5 * S);
    bench.silence();
    bench.pass(S);
    bench.request(&open(2));
}

#[test]
fn an_opening_that_is_not_answered_is_closed_and_made_anew() {
    let mut bench = Bench::opening();
    let late = rr(bench.context, OPENED);
    bench.pass(S + LOOK_NS);
    bench.request(CLOSE);
    bench.says("does not answer the opening");
    // What comes late is not taken for open: it is being closed.
    bench.receive(&late);
    bench.silence();
    assert_eq!((bench.news(), bench.session.unmatched), (vec![READ_NOTHING], 1));
    bench.answer(CLOSED);
    bench.silence();
    bench.pass(S);
    // The drive may still have the first one.
    bench.trade(&of(2, OPEN), &refused(2, "01 01 06 01"));
    bench.pass(2 * S + LOOK_NS);
    bench.trade(&of(3, OPEN), &of(3, OPENED));
    assert!(matches!(bench.news()[..], [News::Opened(Connection { generation: 1, .. })]));
}

#[test]
fn an_answer_of_no_use_is_closed_and_the_note_says_why() {
    let with_api = |api: &str| OPENED.replace("10 27 00 00 10 27 00 00", &format!("10 27 00 00 {api}"));
    let never = "answered an interval of 0: set `divisor` and `input_rpi` to intervals that it has";
    let short = "the answer is incomplete: look whether another device or a gateway has its address";
    // 10 ms were requested, and a packet counts for 20: 20 ms are taken, 20.001 are not.
    let rare = "every 20.001 ms only, and a packet counts for 20 ms: raise `fresh_within`";
    for (answer, says) in
        [(with_api("00 00 00 00"), never), (OPENED[..60].to_owned(), short), (with_api("21 4E 00 00"), rare)]
    {
        let mut bench = Bench::opening();
        bench.answer(&answer);
        bench.request(CLOSE);
        bench.says(says);
        assert_eq!(bench.news(), [READ_NOTHING]);
    }
    let mut bench = Bench::opening();
    bench.answer(&with_api("20 4E 00 00"));
    assert!(matches!(bench.news()[..], [_, News::Opened(Connection { incoming_api_ns: 20_000_000, .. })]));
}

#[test]
fn packets_go_where_the_drive_says_and_come_where_the_bus_listens() {
    let mut bench = Bench::new(|plan| plan.bind.set_port(5000));
    bench.register(SECOND);
    bench.context += 1;
    let item = "01 80 10 00 00 02 13 88 00 00 00 00 00 00 00 00 00 00 00 00";
    assert_eq!(bench.taken(), rr_with(bench.context, OPEN, "03 00", item));
    // Port 2223 at its own address; another address.
    for (mut bench, item, destination) in [
        (bench, "08 AF 00 00 00 00", SocketAddrV4::new(DRIVE, 2223)),
        (Bench::opening(), "08 AE 0A 00 00 63", SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 99), 2222)),
    ] {
        let item = format!("00 80 10 00 00 02 {item} 00 00 00 00 00 00 00 00");
        bench.receive(&rr_with(bench.context, OPENED, "03 00", &item));
        assert_eq!(bench.news()[1], News::Opened(Connection { destination, ..connection() }));
    }
}

#[test]
fn a_group_is_joined_before_the_loop_gets_the_connection_and_left_with_it() {
    let members = Arc::new(Members::default());
    let groups = Arc::clone(&members) as Arc<dyn Groups>;
    let multicast = |plan: &mut EthernetIpPlan| plan.drives[1].delivery = Delivery::Multicast;
    let mut bench = Bench::with_groups(multicast, Some(groups));
    bench.register(SECOND);
    // The drive chooses the id.
    let open = |serial| {
        of(serial, OPEN)
            .replace(&format!("{serial:02X} 00 01 00 {serial:02X}"), &format!("00 00 00 00 {serial:02X}"))
            .replace("3A 48", "3A 28")
    };
    bench.request(&open(1));
    // 239.192.1.64:2222
    let item = "01 80 10 00 00 02 08 AE EF C0 01 40 00 00 00 00 00 00 00 00";
    bench.receive(&rr_with(bench.context, OPENED, "03 00", item));
    let group = SocketAddrV4::new(Ipv4Addr::new(239, 192, 1, 64), 2222);
    let count = || members.0.lock().unwrap().get(&group).copied();
    assert_eq!((bench.news().len(), count()), (2, Some(1)));
    bench.wish(Wish::TimedOut { generation: 1 });
    assert_eq!(count(), Some(0));
    bench.trade(CLOSE, CLOSED);
    bench.pass(S + LOOK_NS);
    // Without a group there is nothing to receive; the same if it cannot be joined.
    bench.trade(&open(2), &of(2, OPENED));
    bench.request(&of(2, CLOSE));
    bench.says("does not say which one");
    bench.answer(&of(2, CLOSED));
    bench.pass(S + LOOK_NS);
    bench.request(&open(3));
    let item = "01 80 10 00 00 02 08 AE 0A 00 00 01 00 00 00 00 00 00 00 00";
    bench.receive(&rr_with(bench.context, &of(3, OPENED), "03 00", item));
    bench.request(&of(3, CLOSE));
    bench.says("it is none");
}

#[test]
fn a_message_that_answers_another_request_is_counted_and_dropped() {
    let mut bench = Bench::opening();
    let context = bench.context;
    let mut other_session = rr(context, OPENED);
    other_session[4] ^= 1;
    let strangers = [
        rr(context - 1, OPENED),
        rr(context + 1, OPENED),
        other_session,
        // Of another service, triad, not a reply, no message at all.
        rr(context, PROBED),
        rr(context, &of(2, OPENED)),
        rr(context, OPEN),
        framed(0x6F, SESSION, context, &hex("00 00 00 00 00 00 01 00 00 00 00 00")),
        framed(0x65, 0x102, context, &hex("01 00 00 00")),
        framed(0x63, SESSION, context, &hex("00 00")),
        unit("01 00 01 00", 1, OPENED),
    ];
    for (count, stranger) in (1..).zip(&strangers) {
        bench.receive(stranger);
        assert_eq!(bench.session.unmatched, count);
        bench.silence();
    }
    // The right one, together with others before and behind it.
    let nothing = framed(0, 0, 0, &[7; 4]);
    let right = rr(context, OPENED);
    let together = [&nothing[..], &strangers[0], &right, &right, &nothing].concat();
    assert_eq!(bench.news(), [READ_NOTHING]);
    bench.state = bench.session.take(bench.now, &together, &mut bench.out);
    assert_eq!((bench.news(), bench.session.unmatched), (vec![News::Opened(connection())], 12));
    assert_eq!(bench.state, HandshakeState::Kept);
    assert!(bench.session.inbox.is_empty());
}

#[test]
fn a_session_that_is_refused_not_answered_or_no_session_ends_the_connection() {
    let begun = || {
        let mut bench = Bench::of_drive(|_| ());
        bench.state = bench.session.begin(bench.now, &mut bench.out);
        bench
    };
    let mut bench = begun();
    let mut refusal = framed(0x65, 0, 1, &hex("01 00 00 00"));
    refusal[8] = 2;
    bench.receive(&refusal);
    let why = "the drive refuses to register a session: no memory for another session (0x0002)";
    assert_eq!(bench.failed(), why);
    let mut bench = begun();
    bench.state = bench.session.take(bench.now, b"HTTP/1.1 400", &mut bench.out);
    assert!(bench.failed().contains("not an EtherNet/IP peer"), "{}", bench.failed());
    for (requests, words) in [(0, "the registration"), (1, "its identity"), (2, "its profile code")] {
        let mut bench = if requests == 0 { begun() } else { Bench::of_drive(|_| ()) };
        if requests > 0 {
            bench.begin();
        }
        if requests == 2 {
            bench.trade(IDENTIFY, IDENTITY_REPLY);
        }
        bench.receive(&rr(99, PROBED));
        bench.pass(S - LOOK_NS);
        assert_eq!(bench.state, HandshakeState::More);
        bench.pass(2 * LOOK_NS);
        assert!(bench.failed().contains(words), "{}", bench.failed());
        let dropped = "within 1 s; 1 messages with the session, sender context or sequence of no request \
                       were dropped: look whether another device or a gateway has its address, and at its \
                       firmware";
        assert!(bench.failed().ends_with(dropped), "{}", bench.failed());
    }
}

#[test]
fn the_expected_identity_is_the_electronic_key_of_an_opening() {
    let (of_type, any) = (Expected::default(), Expected::ANY);
    let (product, serial) = (Some(0xB0), Some(7));
    for (expected, key) in [
        (any, ""),
        (of_type, "34 04 3C 00 00 00 00 00 00 00"),
        (Expected { product, serial, ..of_type }, "34 04 3C 00 00 00 B0 00 00 00"),
        (Expected { product, ..any }, "34 04 00 00 00 00 B0 00 00 00"),
        // Its number is in no key.
        (Expected { serial, ..any }, ""),
    ] {
        let version = Some(Version::V2);
        let mut bench = Bench::of_drive(|drive| (drive.expected, drive.version) = (expected, version));
        bench.begin();
        bench.trade(IDENTIFY, IDENTITY_REPLY);
        let words = if key.is_empty() { "01 04" } else { "01 09" };
        bench.request(&of(1, OPEN).replace("01 04 20 04 24 66", &format!("{words} {key} 20 04 24 66")));
    }
    let mut bench = Bench::of_drive(|drive| drive.expected.serial = serial);
    bench.begin();
    bench.trade(IDENTIFY, "81 00 08 00");
    assert!(bench.failed().contains("does not report its serial number"), "{}", bench.failed());
    bench.silence();
    let mut bench = Bench::registered(|drive| drive.expected = of_type);
    let keyed = of(1, OPEN).replace("01 04 20 04", "01 09 34 04 3C 00 00 00 00 00 00 00 20 04");
    bench.trade(&keyed, &refused(1, "01 01 14 01"));
    bench.says("(0x0114); drives or cables are exchanged");
}
