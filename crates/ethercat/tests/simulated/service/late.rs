//! Answers that are lost, late, or never come: an SDO is repeated, and nothing of before is taken for its answer.

use std::sync::Mutex;

use super::*;

const SERIAL: Object = Object::new(0x1018, 1);

/// Holds back `count` answers.
pub(super) fn hold(server: &Server, count: usize) -> Arc<Mutex<Vec<Vec<u8>>>> {
    let held = Arc::new(Mutex::new(Vec::new()));
    let (kept, mut left) = (Arc::clone(&held), count);
    server.shared().twist = Some(Box::new(move |answer| {
        if left == 0 {
            return vec![answer];
        }
        left -= 1;
        kept.lock().unwrap().push(answer);
        Vec::new()
    }));
    held
}

#[test]
fn an_answer_that_a_slave_does_not_send_again_costs_one_repetition() {
    for repeat in [Repeat::Ignored, Repeat::Acknowledged] {
        for length in [16, 128] {
            let (mut bench, server) = Bench::server(length, &[(SERIAL, &[0x6A]), (MODE, &[7])]);
            bench.repeat = repeat;
            bench.read(MODE).unwrap();
            let begun = bench.now;
            bench.fates = vec![Fate::Returns, Fate::Returns, Fate::NeverReturns];
            assert_eq!(bench.read(SERIAL), Ok(0x6A), "{repeat:?} {length}");
            let took = bench.now.since(begun);
            assert!(took < 120 * MS, "it waits no longer than for the repetition: {took}");
            // The same of a write: it is carried out twice, and leaves the same.
            bench.fates = vec![Fate::Returns, Fate::Returns, Fate::NeverReturns];
            assert_eq!(bench.set(MODE, 5), Ok(5));
            // What the application writes is not written twice: it is informed that it may have been.
            let requests = server.shared().requests.len();
            bench.fates = vec![Fate::Returns, Fate::Returns, Fate::NeverReturns];
            let lost = Err(CallError::Refused(object::UNCERTAIN));
            assert_eq!(bench.call(WRITE, "0x6060:0", 6), lost, "{repeat:?} {length}");
            bench.steps(20);
            assert_eq!(server.shared().objects[1].1, [6]);
            let writes =
                server.shared().requests[requests..].iter().filter(|request| request[8] == 0x2F).count();
            assert_eq!(writes, 1, "{repeat:?} {length}");
            assert_eq!(bench.call(WRITE, "0x6060:0", 7), Ok(7));
            // Of a frame that never arrived nothing is lost.
            bench.fates = vec![Fate::Returns, Fate::Returns, Fate::NeverArrives];
            assert_eq!(bench.read(SERIAL), Ok(0x6A));
            assert_eq!((bench.own(Own::MailboxSilent), bench.own(Own::MailboxStrays)), (0, 0));
        }
    }
}

#[test]
fn a_late_answer_is_that_of_its_sdo_and_what_comes_after_it_is_no_value() {
    let (mut bench, server) = Bench::server(16, &[(SERIAL, &[0x6A]), (MODE, &[7]), (STATUS_WORD, &[1, 2])]);
    assert_eq!((bench.read(MODE), bench.read(MODE)), (Ok(7), Ok(7)));
    let held = hold(&server, 2);
    bench.service.read(SERIAL);
    // Two of them are under way.
    bench.steps(800);
    assert_eq!((held.lock().unwrap().len(), bench.own(Own::MailboxRepeats)), (2, 1));
    server.shared().messages.extend(held.lock().unwrap().drain(..1));
    bench.steps(5);
    assert_eq!(bench.service.take_end(), Some(Ok(0x6A)), "that of the first one");
    let mut stale = held.lock().unwrap().remove(0);
    stale[12] = 0x55;
    server.shared().twist = Some(Box::new(move |answer| vec![stale.clone(), answer]));
    assert_eq!(bench.read(SERIAL), Ok(0x6A), "the count is not that of this one");
    assert_eq!(bench.own(Own::MailboxStrays), 2, "it comes twice");
}

/// The manual's dialect has no counts.
#[test]
fn without_counts_nothing_of_a_given_up_sdo_is_taken_for_the_next_one() {
    let objects: [(Object, &[u8]); 2] = [(SERIAL, &[0x6A]), (DEVICE_TYPE, &[1, 0, 0, 0])];
    let (mut bench, server) = Bench::server(16, &objects);
    // The first request goes out with a second count, too.
    let held = hold(&server, usize::from(ATTEMPTS) + 1);
    let begun = bench.now;
    assert_eq!(bench.read(SERIAL), Err(Failure::GivenUp(CallError::TimedOut)));
    let took = bench.now.since(begun);
    assert!((3 * ANSWER_NS..3 * ANSWER_NS + 5 * MS).contains(&took), "{took}");
    // All answers come late, just before that of the next request.
    let uncounted = |mut answer: Vec<u8>, value| {
        answer[5] &= 0x0F;
        answer[12] = value;
        answer
    };
    let mut stale: Vec<_> = held.lock().unwrap().drain(..).map(|answer| uncounted(answer, 0x55)).collect();
    server.shared().twist = Some(Box::new(move |answer| {
        let value = answer[12];
        let mut all = std::mem::take(&mut stale);
        all.push(uncounted(answer, value));
        all
    }));
    assert_eq!(bench.read(SERIAL), Ok(0x6A));
    assert_eq!(bench.own(Own::MailboxStrays), 4);
    assert_eq!((bench.own(Own::MailboxSilent), bench.own(Own::MailboxRepeats)), (1, 2));
    let before = server.shared().requests.len();
    assert_eq!(bench.read(SERIAL), Ok(0x6A));
    assert_eq!(server.shared().requests.len(), before + 1, "then there is nothing in between");
}

/// By the standard a slave counts its own messages.
#[test]
fn a_slave_that_counts_its_own_messages_is_understood() {
    for emergencies in 0..3 {
        let (mut bench, server) = Bench::server(16, &[(SERIAL, &[0x6A]), (MODE, &[7])]);
        let mut own = 0_u8;
        server.shared().twist = Some(Box::new(move |mut answer| {
            let mut count = |message: &mut Vec<u8>| {
                own = own % 7 + 1;
                message[5] = message[5] & 0x0F | own << 4;
            };
            let mut all: Vec<Vec<u8>> =
                (0..emergencies).map(|_| coe(0, 1, &[1, 0x10, 0, 0, 0, 0, 0, 0])).collect();
            all.iter_mut().for_each(&mut count);
            count(&mut answer);
            // It comes twice.
            all.extend([answer.clone(), answer]);
            all
        }));
        for round in 0..20_u8 {
            assert_eq!(bench.set(MODE, round), Ok(round.into()));
            assert_eq!((bench.read(SERIAL), bench.read(MODE)), (Ok(0x6A), Ok(round.into())), "{emergencies}");
        }
        assert_eq!(bench.own(Own::MailboxSilent), 0);
    }
}

#[test]
fn a_slave_that_leaves_the_counts_of_requests_is_understood_after_one_repetition() {
    let (mut bench, server) = Bench::server(16, &[(SERIAL, &[0x6A])]);
    assert_eq!((bench.read(SERIAL), bench.read(SERIAL)), (Ok(0x6A), Ok(0x6A)));
    server.shared().twist = Some(Box::new(|mut answer| {
        answer[5] = answer[5] & 0x0F | ((answer[5] >> 4) % 7 + 1) << 4;
        vec![answer]
    }));
    for _ in 0..3 {
        assert_eq!(bench.read(SERIAL), Ok(0x6A));
    }
    assert_eq!((bench.own(Own::MailboxRepeats), bench.own(Own::MailboxStrays)), (1, 1));
}

#[test]
fn a_long_read_whose_segment_is_lost_begins_anew() {
    let text: Vec<u8> = (b'a'..=b'z').collect();
    for repeat in [Repeat::Ignored, Repeat::Acknowledged] {
        let (mut bench, _server) = Bench::server(20, &[(NAME, &text)]);
        bench.repeat = repeat;
        assert_eq!(bench.call(READ, "device-name", 0), Ok(long::raw(b"abcdefgh")));
        for lost in 0..12 {
            bench.fates = vec![Fate::Returns; lost];
            bench.fates.push(Fate::NeverReturns);
            assert_eq!(bench.call(READ, "device-name", 0), Ok(long::raw(b"abcdefgh")), "{repeat:?} {lost}");
        }
        assert_eq!(bench.own(Own::MailboxSilent), 0);
    }
}

#[test]
fn no_answer_ends_a_transfer_after_its_attempts() {
    let (mut bench, server) = Bench::server(16, &[]);
    server.shared().twist = Some(Box::new(|_| Vec::new()));
    let begun = bench.now;
    assert_eq!(bench.read(MODE), Err(Failure::GivenUp(CallError::TimedOut)));
    let took = bench.now.since(begun);
    assert!((3 * ANSWER_NS..3 * ANSWER_NS + 5 * MS).contains(&took), "{took}");
    // The time of a call is the application's.
    assert_eq!(bench.call(WRITE, "0x6060:0", 1), Err(CallError::TimedOut));
    bench.steps(60);
    // The call was not sent: what went before it was not answered, either.
    assert_eq!((bench.own(Own::MailboxSilent), bench.own(Own::MailboxRepeats)), (2, 3));
}

#[test]
fn the_answer_to_what_goes_before_an_sdo_may_be_lost_as_well() {
    let objects: [(Object, &[u8]); 2] = [(SERIAL, &[0x6A]), (DEVICE_TYPE, &[1, 0, 0, 0])];
    let (mut bench, server) = Bench::server(16, &objects);
    assert_eq!(bench.read(SERIAL), Ok(0x6A));
    let mut answers = 0;
    // Of the next SDO the first one; of what goes before the one behind it, too.
    server.shared().twist = Some(Box::new(move |answer| {
        answers += 1;
        if answers % 2 == 1 { Vec::new() } else { vec![answer] }
    }));
    assert_eq!(bench.read(SERIAL), Ok(0x6A));
    assert_eq!(bench.call(READ, "0x1000:0.u32", 0), Ok(1));
    assert_eq!(bench.own(Own::MailboxSilent), 0);
}

/// A firmware takes a request when it has time, and some only once their own message was read.
#[test]
fn a_mailbox_that_is_full_is_waited_for_as_long_as_the_slave_may_take() {
    for (frees, expected) in [
        (Some(600 * MS), Err(Failure::GivenUp(CallError::TimedOut))),
        (None, Err(Failure::Unusable(object::FULL))),
    ] {
        let (mut full, mut counters) = (Service::new(&plan(16), no_calls(), 0), Counters::default());
        full.open(true);
        full.read(MODE);
        let answer = |working_counter, data| Some(slot::Answer { working_counter, data });
        let (begun, mut now) = (Time(S), Time(S));
        let (mut end, mut writes) = (None, 0);
        while end.is_none() && now.since(begun) < 10 * S {
            now = now + MS;
            full.advance(now, Link::Online, false);
            let mut ask = Ask::default();
            full.request(now, &mut ask);
            let is_look = ask.datagrams().any(|(command, _)| command == Command::Fprd(STATION, 0x080D));
            let is_free = frees.is_some_and(|after| now.since(begun) > after);
            let first = match is_look {
                true => answer(1, &[0x02, 0x01, 0x00][..]),
                false => answer(u16::from(is_free), &[0; 16][..]),
            };
            writes += u32::from(!is_look && is_free);
            full.receive(now, &[first, None], &mut counters);
            end = full.take_end();
        }
        assert_eq!(end, Some(expected));
        assert_eq!(writes > 0, frees.is_some());
        assert!(now.since(begun) >= ANSWER_NS);
    }
}
