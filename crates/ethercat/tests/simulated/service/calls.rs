//! Calls of the application, in turns with the transfers of the master.

use super::*;

/// A series of calls, and how each of them ended.
fn series(bench: &mut Bench, calls: &[Call]) -> Vec<Result<u64, CallError>> {
    let tickets = bench.acyclic.post_series(calls, LIMIT).unwrap();
    tickets.into_iter().map(|ticket| bench.wait(ticket)).collect()
}

/// The pieces of a write of the device name.
fn naming(name: &[u8]) -> Vec<Call> {
    long::write(Target::parse("device-name").unwrap().pack(), name)
}

#[test]
fn objects_of_every_length_are_read_and_counted_whole_in_every_mailbox() {
    for length in [16, 20, 64, 65, 128, 300, 1_024] {
        for bytes in [0, 1, 3, 4, 5, 8, 9, 15, 40, 64, 65, 300, 1_000] {
            let data: Vec<u8> = (0..bytes).map(|byte| byte as u8 | 1).collect();
            let (mut bench, _server) = Bench::server(length, &[(NAME, &data)]);
            let address = Target::parse("device-name").unwrap().pack();
            let calls: Vec<Call> = [(object::READ, 0), (object::SIZE, 0)]
                .into_iter()
                .chain((1..KEPT as u64 / 8).map(|part| (object::PART, 8 * part)))
                .map(|(service, value)| Call { service, address, value })
                .collect();
            let ends = series(&mut bench, &calls);
            assert_eq!(ends[1], Ok(bytes as u64), "{length} {bytes}");
            let parts = ends.iter().enumerate().filter(|(place, _)| *place != 1);
            let read: Vec<u8> = parts.map_while(|(_, end)| end.ok()).flat_map(u64::to_le_bytes).collect();
            let end = data.len().min(KEPT);
            assert_eq!(read[..end], data[..end], "{length} {bytes}");
        }
    }
}

#[test]
fn a_whole_text_and_a_whole_object_come_through_the_carrier() {
    let name = b"S700 with a name that is longer than eight characters";
    let assignment = [1, 0, 4, 0x17];
    let (mut bench, _server) =
        Bench::server(128, &[(NAME, name), (Object::new(0x1C12, 0), &assignment), (MODE, &[7])]);
    let acyclic = bench.acyclic.clone();
    let reader = std::thread::spawn(move || {
        let read = |text: &str| long::read(&acyclic, Target::parse(text).unwrap().pack(), LIMIT);
        [read("device-name"), read("0x1C12:ca"), read("mode"), read("0x5FFF:0")]
    });
    while !reader.is_finished() {
        bench.step();
        std::thread::yield_now();
    }
    let [text, all, mode, none] = reader.join().unwrap();
    assert_eq!(text.as_deref(), Ok(&name[..]));
    assert_eq!((all.as_deref(), mode.as_deref()), (Ok(&assignment[..]), Ok(&[7][..])));
    assert_eq!(none, Err(CallError::Refused(AbortCode::NO_OBJECT.0)));
}

#[test]
fn a_longer_value_is_written_at_once_or_in_segments_as_the_mailbox_holds_it() {
    let target = Target::parse("0x1008:0.octets").unwrap();
    for length in [17, 20, 24, 32, 64, 128, 300] {
        for bytes in [1, 4, 5, 8, 9, 15, 16, 40, 100, KEPT] {
            let data: Vec<u8> = (0..bytes).map(|byte| byte as u8).collect();
            let (mut bench, server) = Bench::server(length, &[(NAME, b"")]);
            let ends = series(&mut bench, &long::write(target.pack(), &data));
            assert_eq!(ends.last(), Some(&Ok(bytes as u64)), "{length} {bytes}");
            let shared = server.shared();
            assert_eq!(shared.objects[0].1, data, "{length} {bytes}");
            let first = shared.requests[0][8];
            assert_eq!(first == 0x21, bytes > 4, "normal where it is not expedited: {first:#x}");
            let room = usize::from(length) - 16;
            let segments = data.len().saturating_sub(room).div_ceil(usize::from(length) - 9);
            assert_eq!(shared.requests.len(), 1 + if bytes > 4 { segments } else { 0 }, "{length} {bytes}");
            drop(shared);
            // The same at start-up.
            bench.service.write(NAME, &data[..bytes.min(3)]);
            bench.steps(6);
            assert!(bench.service.take_end().is_some_and(|end| end.is_ok()));
            bench.service.write(NAME, &data);
            bench.steps(400);
            assert!(bench.service.take_end().is_some_and(|end| end.is_ok()));
            assert_eq!(server.shared().objects[0].1, data);
        }
    }
}

#[test]
fn a_mailbox_of_one_sdo_takes_no_longer_value() {
    let (mut bench, server) = Bench::server(16, &[(NAME, b"")]);
    let refused = CallError::Refused(object::EXPEDITED);
    let ends = series(&mut bench, &naming(b"abcdefghi"));
    assert_eq!(ends, [Ok(long::raw(b"abcdefgh")), Ok(u64::from(b'i')), Err(refused)]);
    bench.service.write(NAME, b"abcde");
    assert_eq!(bench.service.take_end(), Some(Err(Failure::Unusable(object::EXPEDITED))));
    bench.steps(20);
    assert!(server.shared().requests.is_empty(), "nothing of it was sent");
    let ends = series(&mut bench, &naming(b"abcd"));
    assert_eq!((ends.last(), &server.shared().objects[0].1[..]), (Some(&Ok(4)), &b"abcd"[..]));
}

#[test]
fn a_value_that_was_not_handed_over_whole_is_not_written() {
    let (mut bench, server) = Bench::server(64, &[(NAME, b"")]);
    let calls = naming(b"abcdefghijkl");
    let not_loaded = Err(CallError::Refused(object::NOT_LOADED));
    // The pieces of another series, of another object, too few of them, too many.
    series(&mut bench, &calls[..2]);
    assert_eq!(series(&mut bench, &calls[2..]), [not_loaded]);
    let other = Call { address: Target::parse("0x1009:0.text").unwrap().pack(), ..calls[0] };
    assert_eq!(series(&mut bench, &[calls[0], other, calls[2]])[2], not_loaded);
    assert_eq!(series(&mut bench, &[calls[0], calls[2]])[1], not_loaded);
    assert_eq!(series(&mut bench, &[calls[0], calls[0], calls[0], calls[2]])[3], not_loaded);
    assert_eq!(bench.wait(bench.acyclic.post(calls[2], LIMIT).unwrap()), not_loaded);
    // Nor is one that commands, with power, like any other.
    bench.guarded = true;
    assert_eq!(series(&mut bench, &calls)[2], Err(CallError::Commands));
    assert!(server.shared().requests.is_empty());
}

#[test]
fn the_master_goes_before_the_application() {
    let (mut bench, server) = Bench::server(16, &[(MODE, &[7]), (STATUS_WORD, &[1, 2])]);
    let tickets: Vec<CallTicket> = (0..3).map(|_| bench.post(READ, "mode", 0)).collect();
    bench.step();
    assert_eq!(bench.read(STATUS_WORD), Ok(0x201));
    let indices: Vec<u8> = server.shared().requests.iter().map(|request| request[9]).collect();
    assert_eq!(indices, [0x60, 0x41], "the one that was under way came first");
    for ticket in tickets {
        assert_eq!(bench.wait(ticket), Ok(7));
    }
}

#[test]
fn a_call_cancelled_late_or_offline_ends_so_and_disturbs_no_later_one() {
    let (mut bench, server) = Bench::server(16, &[(MODE, &[7]), (STATUS_WORD, &[1, 2])]);
    let held = super::late::hold(&server, usize::MAX);
    let mut ticket = bench.post(READ, "mode", 0);
    bench.steps(5);
    ticket.cancel();
    bench.steps(2);
    assert_eq!(ticket.poll(), Some(Err(CallError::Cancelled)));
    // Its answer comes late; the next call has the same object.
    server.shared().twist = None;
    let mut late = held.lock().unwrap().remove(0);
    (late[5], late[12]) = (3, 0x55);
    server.shared().messages.push_back(late);
    bench.line.advance(bench.now);
    assert_eq!(bench.call(READ, "mode", 0), Ok(7));

    let ticket = bench.post(READ, "mode", 0);
    bench.link = Link::Lost;
    assert_eq!(bench.wait(ticket), Err(CallError::NotOnline));
    assert_eq!(bench.read(MODE), Ok(7), "the master's own transfers bring the link up");
}

#[test]
fn a_write_that_commands_the_drive_is_checked_until_a_frame_carries_it() {
    let (mut bench, server) = Bench::server(16, &[(MODE, &[7]), (DEVICE_TYPE, &[1, 0, 0, 0])]);
    // The first frame looks whether something is left of another master; meanwhile power comes on.
    let ticket = bench.post(WRITE, "mode", 8);
    bench.step();
    assert!(bench.service.commands());
    bench.guarded = true;
    assert_eq!(bench.wait(ticket), Err(CallError::Commands));
    assert!(!bench.service.commands() && server.shared().requests.is_empty(), "nothing of it was sent");
    assert_eq!(bench.read(MODE), Ok(7), "the master's own are exempt");
    assert_eq!(bench.set(MODE, 6), Ok(6));
    // What a frame has carried goes on, and is known to be under way.
    bench.guarded = false;
    bench.step();
    let ticket = bench.post(WRITE, "mode", 8);
    bench.step();
    bench.guarded = true;
    assert!(bench.service.commands());
    assert_eq!(bench.wait(ticket), Ok(8));
    assert!(!bench.service.commands());
}

#[test]
fn a_write_without_waiter_is_under_way_until_a_later_request_is_answered() {
    let (mut bench, server) = Bench::server(16, &[(MODE, &[7]), (DEVICE_TYPE, &[1, 0, 0, 0])]);
    assert_eq!(bench.read(MODE), Ok(7));
    let ticket = bench.post(WRITE, "mode", 8);
    bench.fates = vec![Fate::Returns, Fate::NeverReturns, Fate::NeverReturns];
    bench.step();
    drop(ticket);
    bench.step();
    assert!(bench.service.commands(), "the drive may have it");
    bench.steps(50);
    assert!(!bench.service.commands());
    let objects = server.shared().objects.clone();
    assert!(objects.contains(&(MODE, vec![8])), "{objects:?}");
    assert!(bench.service.is_free());
}

#[test]
fn without_a_mailbox_or_with_a_closed_one_all_is_refused_at_once() {
    let (acyclic, port) = Acyclic::alone(4, Commanding::none(), Arc::new(object::Objects));
    let mut none = Service::new(&SlavePlan::new(0), port, 0);
    none.open(true);
    none.read(MODE);
    assert_eq!(none.take_end(), Some(Err(Failure::GivenUp(CallError::NotOnline))));
    assert!(none.is_free());
    let call = Target::parse("mode").unwrap().read();
    let mut ticket = acyclic.post(call, LIMIT).unwrap();
    none.advance(Time(S), Link::Online, false);
    assert_eq!(ticket.poll(), Some(Err(CallError::Refused(object::NO_MAILBOX))));
    let mut ask = Ask::default();
    none.request(Time(S), &mut ask);
    assert!(ask.is_empty());

    let (mut bench, _server) = Bench::server(16, &[(MODE, &[7])]);
    bench.service.read(MODE);
    bench.steps(2);
    bench.service.open(false);
    assert_eq!(bench.service.take_end(), Some(Err(Failure::GivenUp(CallError::Restarted))));
    let mut ticket = bench.post(READ, "mode", 0);
    bench.steps(1);
    assert_eq!(ticket.poll(), Some(Err(CallError::NotOnline)));
    bench.service.open(true);
    assert_eq!(bench.read(MODE), Ok(7));
}

#[test]
fn an_unknown_call_is_refused_and_sign_extension_keeps_a_short_value() {
    let (mut bench, _server) = Bench::server(16, &[(MODE, &[0xFB, 0xFF])]);
    assert_eq!(bench.call(READ, "0x6060:0.i32", 0), Ok(0xFFFF_FFFB));
    assert_eq!(bench.call(READ, "0x6060:0.u32", 0), Ok(0xFFFB));
    let no_call = Err(CallError::Refused(object::NO_CALL));
    assert_eq!(bench.call(99, "mode", 0), no_call);
    assert_eq!(bench.call(WRITE, "0x2F00:3", 0), no_call);
    assert_eq!(bench.call(WRITE, "0x1C12:ca", 0), no_call);
    assert_eq!(bench.call(object::PART, "device-name", 0), Err(CallError::Refused(object::NOT_READ)));
}
