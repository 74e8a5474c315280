//! What comes in place of an answer, or without a request: emergencies, strays, and what cannot be used.

use super::*;

#[test]
fn an_emergency_in_place_of_an_answer_is_kept_and_the_answer_waited_for() {
    let (mut bench, server) = Bench::server(128, &[(MODE, &[7])]);
    let emergency = [0x10, 0x43, 8, 1, 0, 0, 0, 0];
    let ethernet = message(0, 2, &[0; 90]);
    let first = coe(0, 1, &emergency);
    server.shared().twist = Some(Box::new(move |answer| vec![first.clone(), ethernet.clone(), answer]));
    assert_eq!(bench.read(MODE), Ok(7));
    let reported = Emergency { code: 0x4310, register: 8, vendor: [1, 0, 0, 0, 0] };
    assert_eq!((bench.service.take_emergency(), bench.service.take_emergency()), (Some(reported), None));
    assert_eq!((bench.own(Own::Emergencies), bench.own(Own::MailboxStrays)), (1, 1));
}

#[test]
fn an_unsolicited_emergency_is_reported_and_too_many_are_counted() {
    let (mut bench, server) = Bench::server(16, &[]);
    bench.steps(60);
    for code in 1..=12 {
        server.shared().messages.push_back(coe(0, 1, &[code, 0x10, 0, 0, 0, 0, 0, 0]));
    }
    bench.steps(100);
    assert_eq!((bench.own(Own::Emergencies), bench.own(Own::EmergenciesLost)), (12, 4));
    let kept: Vec<u16> = std::iter::from_fn(|| bench.service.take_emergency()).map(|e| e.code).collect();
    assert_eq!(kept, (0x1001..=0x1008).collect::<Vec<u16>>(), "the first ones, in their order");
    bench.frames.clear();
    bench.steps(1_000);
    assert!((19..=21).contains(&bench.frames.len()), "a look every 50 ms: {}", bench.frames.len());
}

#[test]
fn an_answer_to_another_request_is_a_stray() {
    let (mut bench, server) = Bench::server(16, &[(MODE, &[7])]);
    // It returns counts.
    assert_eq!((bench.read(MODE), bench.read(MODE)), (Ok(7), Ok(7)));
    server.shared().twist = Some(Box::new(|answer| {
        let other = |place: usize, byte: u8| {
            let mut other = answer.clone();
            (other[5], other[12]) = (other[5] & 0x0F, 0x55);
            other[place] = byte;
            other
        };
        let mut counted = answer.clone();
        counted[5] = (((answer[5] >> 4) % 7 + 1) << 4) | 3;
        counted[12] = 0x55;
        // Another index, subindex, command, count; and the answer twice.
        let others = [(9, 0x61), (10, 0x5F), (11, 1), (8, 0x60), (8, 0x20)];
        let others = others.map(|(place, byte)| other(place, byte));
        others.into_iter().chain([counted, answer.clone(), answer]).collect()
    }));
    assert_eq!(bench.read(MODE), Ok(7));
    assert_eq!(bench.own(Own::MailboxStrays), 6);
    bench.steps(60);
    assert_eq!(bench.own(Own::MailboxStrays), 7, "the duplicate");
}

#[test]
fn an_unusable_mailbox_ends_a_call_with_its_reason() {
    let text: Vec<u8> = (b'a'..=b'z').collect();
    let of_segments = |change: fn(&mut u8)| {
        move |answer: &mut Vec<u8>| {
            if answer[8] < 0x20 {
                change(&mut answer[8]);
            }
        }
    };
    type Change = Box<dyn Fn(&mut Vec<u8>) + Send>;
    let cases: [(Change, u32); 7] = [
        (Box::new(|answer| *answer = message(0, 0, &[1, 0, 2, 0, answer[0]])), object::MAILBOX + 2),
        (Box::new(|answer| answer[0] = 4), object::BROKEN),
        (Box::new(|answer| answer[8] = 0xA0), object::BROKEN),
        (Box::new(|answer| answer[0] = 200), object::BROKEN),
        // Segments: the wrong toggle, an early end, and none.
        (Box::new(of_segments(|command| *command ^= 0x10)), object::TOGGLE),
        (Box::new(of_segments(|command| *command |= 1)), object::TRUNCATED),
        (Box::new(of_segments(|command| *command = *command & 0x10 | 0x0E)), object::ENDLESS),
    ];
    for (number, (change, status)) in cases.into_iter().enumerate() {
        let (mut bench, server) = Bench::server(20, &[(NAME, &text)]);
        server.shared().twist = Some(Box::new(move |mut answer| {
            change(&mut answer);
            vec![answer]
        }));
        assert_eq!(bench.call(READ, "device-name", 0), Err(CallError::Refused(status)), "{number}");
        bench.steps(5);
        let is_aborted = server.shared().requests.iter().any(|request| request[8] == 0x80);
        assert_eq!(is_aborted, matches!(status, object::TOGGLE | object::ENDLESS), "{number}");
        server.shared().twist = None;
        assert_eq!(bench.call(READ, "device-name", 0), Ok(long::raw(b"abcdefgh")), "{number}");
    }
}

#[test]
fn an_object_without_end_is_given_up() {
    let (mut bench, server) = Bench::server(1_024, &[(NAME, &[b'x'; 100_000])]);
    assert_eq!(bench.call(READ, "device-name", 0), Err(CallError::Refused(object::ENDLESS)));
    // One that does not report its size, either.
    server.shared().twist = Some(Box::new(|mut answer| {
        if answer[8] == 0x41 {
            answer[8] = 0x40;
        }
        vec![answer]
    }));
    assert_eq!(bench.call(READ, "device-name", 0), Err(CallError::Refused(object::ENDLESS)));
}
