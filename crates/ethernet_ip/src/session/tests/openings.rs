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

#[test]
fn an_owner_registers_identifies_the_drive_and_opens_its_connection() {
    let mut bench = Bench::of_drive(|_| ());
    bench.begin();
    assert_eq!(bench.state, HandshakeState::More);
    bench.request(IDENTIFY);
    bench.answer(IDENTITY_REPLY);
    bench.request(PROFILE);
    assert_eq!(bench.state, HandshakeState::More);
    bench.answer(SECOND);
    assert_eq!(bench.state, HandshakeState::Kept);
    // What its enable depends on is known before the connection is open.
    assert_eq!(bench.news(), [READ_NOTHING]);
    bench.request(OPEN);
    bench.answer(OPENED);
    assert_eq!(bench.news(), [News::Opened(connection())]);
    bench.silence();
    assert_eq!((bench.note(), bench.session.unmatched), (String::new(), 0));
}

#[test]
fn the_register_of_its_reference_is_read_before_the_opening() {
    for (answer, homed) in [
        ("BC 00 00 00 00 02 9F 33 00 00 00 01", Some(true)),
        ("BC 00 00 00 00 02 9F 33 00 00 00 00", Some(false)),
        // It does not know the register; it answers for another one.
        ("BC 00 20 00", None),
        ("BC 00 00 00 00 02 9F 34 00 00 00 01", None),
    ] {
        let mut bench = Bench::of_drive(|drive| drive.homed_register = Some(b'3'));
        bench.register(SECOND);
        bench.request("3C 03 20 64 24 01 30 01 00 02 9F 33 00 00 00 00");
        assert_eq!(bench.news(), []);
        bench.answer(answer);
        assert_eq!(bench.news(), [News::Read(Facts { homed })]);
        bench.request(OPEN);
    }
}

#[test]
fn a_unit_of_the_first_version_is_only_read() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(FIRST);
    let open = OPEN.replace("46 48", "02 48").replace("3A 48", "20 48").replace("2C 70 2C 65", "2C 67 2C 64");
    bench.request(&open);
    bench.answer(OPENED);
    let (outputs, version) = (Outputs::Heartbeat(2), Version::V1);
    let expected = News::Opened(Connection { outputs, version, ..connection() });
    assert_eq!(bench.news(), [READ_NOTHING, expected]);
}

#[test]
fn a_drive_without_profile_code_needs_its_version() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register("8E 00 05 00");
    let why = bench.failed();
    assert!(why.starts_with("STF05-IP of vendor 60 does not say which assemblies it has (path"), "{why}");
    assert!(why.contains("`version`"), "{why}");
    let mut bench = Bench::of_drive(|_| ());
    bench.register("8E 00 00 00 00 FB");
    assert!(bench.failed().contains("too short"));
    // With it nobody asks.
    let mut bench = Bench::of_drive(|drive| drive.version = Some(Version::V2));
    bench.begin();
    bench.request(IDENTIFY);
    bench.answer("81 00 08 00");
    bench.request(OPEN);
}

#[test]
fn listening_only_has_a_point_of_its_own() {
    let mut bench = Bench::of_drive(|drive| {
        drive.connection = Access::ListenOnly;
        drive.heartbeat = Some(0);
    });
    bench.register(SECOND);
    bench.request(&OPEN.replace("46 48", "00 48").replace("2C 70", "2C 68"));
    bench.answer(&refused(1, "01 01 19 01"));
    assert!(bench.note().contains("(0x0119)") && bench.note().contains("input-only"), "{}", bench.note());
    bench.silence();
}

#[test]
fn configuration_data_is_tried_without_and_with_two_zero_bytes() {
    for status in ["01 02 26 01 01 00", "01 01 29 01", "01 01 10 01"] {
        let mut bench = Bench::of_drive(|_| ());
        bench.register(SECOND);
        bench.request(OPEN);
        bench.answer(&refused(1, status));
        let with = |open: String| {
            open.replace("01 04 20 04 24 66 2C 70 2C 65", "01 06 20 04 24 66 2C 70 2C 65 80 01 00 00")
        };
        bench.request(&with(open(2)));
        bench.answer(&refused(2, status));
        bench.silence();
        assert!(bench.note().contains("`configuration`; tried again after 1 s"), "{}", bench.note());
        // Then from the beginning; what is taken is kept.
        bench.pass(S + LOOK_NS);
        bench.request(&open(3));
        bench.answer(&refused(3, status));
        bench.request(&with(open(4)));
        bench.answer(&opened(4));
        bench.news();
        bench.loop_end.wish(Wish::TimedOut { generation: 1 });
        bench.pass(LOOK_NS);
        bench.request(&of(4, CLOSE));
        bench.answer(&of(4, CLOSED));
        bench.pass(S + LOOK_NS);
        bench.request(&with(open(5)));
    }
    // What is configured is all there is.
    let mut bench = Bench::of_drive(|drive| drive.configuration = Some(vec![1, 2]));
    bench.register(SECOND);
    bench
        .request(&OPEN.replace("01 04 20 04 24 66 2C 70 2C 65", "01 06 20 04 24 66 2C 70 2C 65 80 01 01 02"));
    bench.answer(&refused(1, "01 01 29 01"));
    bench.silence();
}

#[test]
fn heartbeats_have_the_size_that_the_drive_wants() {
    let input_only = |drive: &mut MoonsDrive| drive.connection = Access::InputOnly;
    let sized =
        |serial, size: &str| open(serial).replace("46 48", &format!("{size} 48")).replace("2C 70", "2C 67");
    let begun = |change: &dyn Fn(&mut MoonsDrive)| {
        let mut bench = Bench::of_drive(|drive| {
            input_only(drive);
            change(drive);
        });
        bench.register(SECOND);
        bench
    };
    // It names it.
    let mut bench = begun(&|_| ());
    bench.request(&sized(1, "02"));
    bench.answer(&refused(1, "01 02 27 01 00 00"));
    bench.request(&sized(2, "00"));
    bench.answer(&opened(2));
    let news = bench.news();
    assert!(matches!(news[1], News::Opened(Connection { outputs: Outputs::Heartbeat(0), .. })), "{news:?}");
    // It does not, or names one that no heartbeat has.
    for status in ["01 01 27 01", "01 01 09 01", "01 02 27 01 46 00"] {
        let mut bench = begun(&|_| ());
        bench.request(&sized(1, "02"));
        bench.answer(&refused(1, status));
        bench.request(&sized(2, "06"));
        bench.answer(&refused(2, status));
        bench.request(&sized(3, "00"));
        bench.answer(&refused(3, status));
        bench.silence();
        assert!(bench.note().contains("`heartbeat`"), "{}", bench.note());
    }
    assert!({
        let mut bench = begun(&|drive| drive.heartbeat = Some(6));
        bench.request(&sized(1, "06"));
        bench.answer(&refused(1, "01 02 27 01 02 00"));
        bench.silence();
        bench.note().contains("the drive wants 2 bytes")
    });
}

#[test]
fn a_size_of_process_data_that_the_drive_does_not_have_is_reported() {
    for (status, words) in [
        ("01 02 27 01 4A 00", "wrong O->T size (0x0127): the drive wants 74 bytes"),
        ("01 02 28 01 3E 00", "wrong T->O size (0x0128): the drive wants 62 bytes"),
    ] {
        let mut bench = Bench::of_drive(|_| ());
        bench.register(SECOND);
        bench.request(OPEN);
        bench.answer(&refused(1, status));
        bench.silence();
        assert!(bench.note().starts_with("10.0.0.40:44818: the drive refuses"), "{}", bench.note());
        assert!(bench.note().contains(words), "{}", bench.note());
    }
}

#[test]
fn the_large_form_is_for_drives_without_the_small_one() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    bench.answer(&refused(1, "08 00"));
    let large = "5B 02 20 06 24 01 0A 0E 00 00 00 00 02 00 01 00 02 00 34 12 EE FF C0 00 02 00 00 00 10 27 00 00 46 00 \
                 00 48 10 27 00 00 3A 00 00 48 01 04 20 04 24 66 2C 70 2C 65";
    bench.request(large);
    bench.answer(&opened(2).replace("D4 00", "DB 00"));
    assert!(matches!(bench.news()[..], [_, News::Opened(_)]));
}

#[test]
fn a_connection_in_use_gets_another_serial_number_at_once_and_then_a_pause() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    bench.answer(&refused(1, "01 01 00 01"));
    bench.request(&open(2));
    bench.answer(&refused(2, "01 01 00 01"));
    bench.silence();
    bench.pass(S - LOOK_NS);
    bench.silence();
    bench.pass(2 * LOOK_NS);
    bench.request(&open(3));
}

#[test]
fn an_owned_drive_is_left_alone_for_one_watchdog_period_at_least() {
    // 512 intervals of 10 ms.
    let mut bench = Bench::of_drive(|drive| drive.multiplier = Some(7));
    bench.register(SECOND);
    bench.request(&OPEN.replace("02 00 00 00 10 27", "07 00 00 00 10 27"));
    bench.answer(&refused(1, "01 01 06 01"));
    let note = bench.note();
    assert!(note.contains("(0x0106)") && note.contains("another controller"), "{note}");
    assert!(note.ends_with("tried again after 5.12 s"), "{note}");
    bench.pass(5 * S);
    bench.silence();
    bench.pass(S);
    bench.request(&open(2).replace("02 00 00 00 10 27", "07 00 00 00 10 27"));
}

#[test]
fn pauses_grow_with_each_refusal_and_begin_anew_after_a_connection() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    let mut serial = 1;
    for pause_s in [1, 2, 4, 8, 16, 16] {
        bench.request(&open(serial));
        bench.answer(&refused(serial, "01 01 03 01"));
        assert!(bench.note().ends_with(&format!("tried again after {pause_s} s")), "{}", bench.note());
        bench.pass(pause_s * S - LOOK_NS);
        bench.silence();
        bench.pass(2 * LOOK_NS);
        serial += 1;
    }
    bench.request(&open(serial));
    bench.answer(&opened(serial));
    assert_eq!((bench.note(), bench.session.pause_ns), (String::new(), S));
}

#[test]
fn an_opening_that_is_not_answered_is_closed_and_made_anew() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    let late = rr(bench.context, OPENED);
    bench.pass(S + LOOK_NS);
    bench.request(CLOSE);
    assert!(bench.note().contains("does not answer the opening"), "{}", bench.note());
    // What comes late is not taken for open: it is being closed.
    bench.receive(&late);
    bench.silence();
    assert_eq!((bench.news(), bench.session.unmatched), (vec![READ_NOTHING], 1));
    bench.answer(CLOSED);
    bench.silence();
    bench.pass(S);
    bench.request(&open(2));
    // The drive may still have the first one.
    bench.answer(&refused(2, "01 01 06 01"));
    bench.pass(2 * S + LOOK_NS);
    bench.request(&open(3));
    bench.answer(&opened(3));
    assert!(matches!(bench.news()[..], [News::Opened(Connection { generation: 1, .. })]));
}

#[test]
fn an_answer_of_no_use_is_closed() {
    // An interval of 0; a reply that ends too early.
    for answer in [OPENED.replace("C0 00 10 27", "C0 00 00 00"), OPENED[..60].to_owned()] {
        let mut bench = Bench::of_drive(|_| ());
        bench.register(SECOND);
        bench.request(OPEN);
        bench.answer(&answer);
        bench.request(CLOSE);
        assert!(bench.note().contains("the drive opens the connection, but"), "{}", bench.note());
        assert_eq!(bench.news(), [READ_NOTHING]);
    }
}

#[test]
fn a_drive_that_sends_too_rarely_is_closed_and_the_note_says_what_it_can_do() {
    // 10 ms were requested, and a packet counts for 20: 20 ms are taken, 20.001 are not.
    let with_api = |api: &str| OPENED.replace("10 27 00 00 10 27 00 00", &format!("10 27 00 00 {api}"));
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    bench.answer(&with_api("20 4E 00 00"));
    assert!(matches!(bench.news()[..], [_, News::Opened(Connection { incoming_api_ns: 20_000_000, .. })]));
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    bench.answer(&with_api("21 4E 00 00"));
    assert_eq!(bench.news(), [READ_NOTHING]);
    bench.request(CLOSE);
    let note = bench.note();
    let says = "every 20.001 ms only, and a packet counts for 20 ms: raise `fresh_within`";
    assert!(note.contains(says), "{note}");
}

#[test]
fn packets_go_where_the_drive_says_and_come_where_the_bus_listens() {
    let mut bench = Bench::new(|plan| plan.bind.set_port(5000));
    bench.register(SECOND);
    bench.context += 1;
    let item = "01 80 10 00 00 02 13 88 00 00 00 00 00 00 00 00 00 00 00 00";
    assert_eq!(bench.taken(), rr_with(bench.context, OPEN, "03 00", item));
    // Port 2223 at its own address.
    let item = "00 80 10 00 00 02 08 AF 00 00 00 00 00 00 00 00 00 00 00 00";
    bench.receive(&rr_with(bench.context, OPENED, "03 00", item));
    let destination = SocketAddrV4::new(DRIVE, 2223);
    assert_eq!(bench.news()[1], News::Opened(Connection { destination, ..connection() }));

    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    let item = "00 80 10 00 00 02 08 AE 0A 00 00 63 00 00 00 00 00 00 00 00";
    bench.receive(&rr_with(bench.context, OPENED, "03 00", item));
    let destination = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 99), 2222);
    assert_eq!(bench.news()[1], News::Opened(Connection { destination, ..connection() }));
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
        open(serial)
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
    bench.loop_end.wish(Wish::TimedOut { generation: 1 });
    bench.pass(LOOK_NS);
    assert_eq!(count(), Some(0));
    bench.request(CLOSE);
    bench.answer(CLOSED);
    bench.pass(S + LOOK_NS);
    // Without a group there is nothing to receive; the same if it cannot be joined.
    bench.request(&open(2));
    bench.answer(&opened(2));
    bench.request(&of(2, CLOSE));
    assert!(bench.note().contains("does not say which one"), "{}", bench.note());
    bench.answer(&of(2, CLOSED));
    bench.pass(S + LOOK_NS);
    bench.request(&open(3));
    let item = "01 80 10 00 00 02 08 AE 0A 00 00 01 00 00 00 00 00 00 00 00";
    bench.receive(&rr_with(bench.context, &opened(3), "03 00", item));
    bench.request(&of(3, CLOSE));
    assert!(bench.note().contains("it is none"), "{}", bench.note());
}

#[test]
fn a_message_that_answers_another_request_is_counted_and_dropped() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    let context = bench.context;
    let other_session = |mut frame: Vec<u8>| {
        frame[4] ^= 1;
        frame
    };
    let strangers = [
        rr(context - 1, OPENED),
        rr(context + 1, OPENED),
        other_session(rr(context, OPENED)),
        // Of another service, triad, not a reply, no message at all.
        rr(context, PROBED),
        rr(context, &opened(2)),
        rr(context, OPEN),
        framed(0x6F, SESSION, context, &hex("00 00 00 00 00 00 01 00 00 00 00 00")),
        framed(0x65, 0x102, context, &hex("01 00 00 00")),
        framed(0x63, SESSION, context, &hex("00 00")),
        unit("01 00 01 00", 1, OPENED),
    ];
    for (count, stranger) in strangers.iter().enumerate() {
        bench.receive(stranger);
        assert_eq!(bench.session.unmatched, count as u64 + 1);
        bench.silence();
    }
    bench.receive(&framed(0, 0, 0, &[7; 4]));
    assert_eq!((bench.news(), bench.session.unmatched), (vec![READ_NOTHING], strangers.len() as u64));
    bench.answer(OPENED);
    assert_eq!(bench.news(), [News::Opened(connection())]);
}

#[test]
fn messages_that_arrive_together_are_taken_one_after_the_other() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    let context = bench.context;
    let nothing = framed(0, 0, 0, &[]);
    let together =
        [nothing.clone(), rr(context - 1, SECOND), rr(context, OPENED), rr(context, OPENED), nothing]
            .concat();
    bench.state = bench.session.take(bench.now, &together, &mut bench.out);
    assert_eq!(bench.news(), [READ_NOTHING, News::Opened(connection())]);
    assert_eq!((bench.state.clone(), bench.session.unmatched), (HandshakeState::Kept, 2));
    assert!(bench.session.inbox.is_empty());
}

#[test]
fn a_refused_session_and_bytes_of_something_else_end_the_connection() {
    let mut bench = Bench::of_drive(|_| ());
    bench.state = bench.session.begin(bench.now, &mut bench.out);
    let mut refusal = framed(0x65, 0, 1, &hex("01 00 00 00"));
    refusal[8] = 2;
    bench.receive(&refusal);
    assert_eq!(
        bench.failed(),
        "the drive refuses to register a session: no memory for another session (0x0002)"
    );

    let mut bench = Bench::of_drive(|_| ());
    bench.state = bench.session.begin(bench.now, &mut bench.out);
    bench.state = bench.session.take(bench.now, b"HTTP/1.1 400", &mut bench.out);
    assert!(bench.failed().contains("not an EtherNet/IP peer"), "{}", bench.failed());
}

#[test]
fn a_drive_that_does_not_answer_is_given_up() {
    for (requests, words) in [(0, "the registration"), (1, "its identity"), (2, "its profile code")] {
        let mut bench = Bench::of_drive(|_| ());
        if requests == 0 {
            bench.state = bench.session.begin(bench.now, &mut bench.out);
        } else {
            bench.begin();
        }
        if requests == 2 {
            bench.request(IDENTIFY);
            bench.answer(IDENTITY_REPLY);
        }
        bench.receive(&rr(99, PROBED));
        bench.pass(S - LOOK_NS);
        assert_eq!(bench.state, HandshakeState::More);
        bench.pass(2 * LOOK_NS);
        assert!(bench.failed().contains(words), "{}", bench.failed());
        assert!(bench.failed().ends_with("within 1 s; 1 messages that answer no request were dropped"));
    }
}
