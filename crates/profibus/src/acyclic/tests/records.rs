//! Path C, and records.

use super::*;

/// A drive by MSAC1: one answer is stored; so many polls before it comes. It counts what it carries out.
struct Module {
    delay: u32,
    stored: Option<(u32, Vec<u8>)>,
    /// A parameter request is under way for so many reads.
    busy: u32,
    left: u32,
    request: Option<Vec<u8>>,
    values: Vec<(u16, i32)>,
    written: Vec<Vec<u8>>,
    requests: u32,
    record: Vec<u8>,
}

impl Module {
    fn new() -> Module {
        let values = vec![(0x5FC2, 430_000), (0x5FD8, 7), (0x5FF3, 50_000)];
        Module {
            delay: 2,
            stored: None,
            busy: 2,
            left: 0,
            request: None,
            values,
            written: Vec::new(),
            requests: 0,
            record: vec![1, 2, 3],
        }
    }

    /// How a call ends that it serves.
    fn end(&mut self, side: &mut Side, ticket: &mut CallTicket) -> Result<u64, CallError> {
        side.until(ticket, Some, |data| Some(self.exchange(data)))
    }

    fn exchange(&mut self, data: &[u8]) -> Reply {
        if !data.is_empty() {
            if self.stored.is_some() {
                return Reply::Refused(2);
            }
            self.stored = Some((self.delay, self.serve(data)));
        }
        match &mut self.stored {
            Some((0, answer)) => {
                let answer = std::mem::take(answer);
                self.stored = None;
                Reply::Data(answer)
            }
            Some((polls, _)) => {
                *polls -= 1;
                Reply::Ack
            }
            None => Reply::Ack,
        }
    }

    fn serve(&mut self, data: &[u8]) -> Vec<u8> {
        match data {
            [0x5F, 0, 47, length, request @ ..] => {
                assert_eq!(usize::from(*length), request.len());
                self.requests += 1;
                if request[1] == 2 {
                    self.written.push(request.to_vec());
                }
                (self.request, self.left) = (Some(request.to_vec()), self.busy);
                data[..4].to_vec()
            }
            [0x5E, 0, 47, 240] if self.left == 0 && self.request.is_some() => {
                let request = self.request.take().unwrap();
                let response = self.respond(&request);
                [&[0x5E, 0, 47, response.len() as u8], &response[..]].concat()
            }
            [0x5E, 0, 47, 240] => {
                self.left = self.left.saturating_sub(1);
                vec![0xDE, 0x80, 0xB5, 0]
            }
            [0x5F, 1, 3, _, bytes @ ..] => {
                self.written.push(bytes.to_vec());
                data[..4].to_vec()
            }
            [0x5E, 1, 3, 240] => [&[0x5E, 1, 3, self.record.len() as u8], &self.record[..]].concat(),
            _ => vec![data[0] | 0x80, 0x80, 0xB0, 0],
        }
    }

    fn respond(&self, request: &[u8]) -> Vec<u8> {
        let [reference, id, axis, count, rest @ ..] = request else { panic!("a request") };
        let mut out = vec![*reference, *id, *axis, *count];
        for address in rest.as_chunks::<6>().0.iter().take(usize::from(*count)) {
            let index = u16::from_be_bytes([address[2], address[3]]);
            let known = self.values.iter().find(|(known, _)| *known == index);
            match known {
                Some((_, value)) if *id == 1 => {
                    out.extend([0x43, 1]);
                    out.extend(value.to_be_bytes());
                }
                Some(_) => {}
                None => {
                    out[1] |= 0x80;
                    out.extend([0x44, 1, 0, 0]);
                }
            }
        }
        out
    }
}

fn record(slot: u8, index: u8) -> u32 {
    Target::Record(Record { slot, index }).pack()
}

#[test]
fn msac1_reads_c0061_with_the_telegrams_of_the_sheet() {
    for (delay, busy) in [(0, 0), (1, 1), (5, 3)] {
        let mut side = Side::new(MSAC1);
        let mut module = Module { delay, busy, ..Module::new() };
        let mut seen = Vec::new();
        let mut ticket = side.read(C0061);
        let end = side.by_msac1(&mut ticket, |data| {
            seen.push(data.to_vec());
            Some(module.exchange(data))
        });
        assert_eq!(end, Ok(430_000));
        let written = seen.iter().filter(|data| data.first() == Some(&0x5F)).collect::<Vec<_>>();
        assert_eq!(written, [&[0x5F, 0, 0x2F, 0x0A, 1, 1, 0, 1, 0x10, 0, 0x5F, 0xC2, 0, 0]]);
        assert_eq!(seen.iter().filter(|data| data.is_empty()).count() as u32, delay * (2 + busy));
        assert!(
            seen.iter().filter(|data| data.first() == Some(&0x5E)).all(|data| data[..] == [0x5E, 0, 47, 240])
        );
    }
}

#[test]
fn writes_go_together_unless_the_first_that_fails_has_to_end_the_rest() {
    let (mut side, mut module) = (Side::new(MSAC1), Module::new());
    let mut first = side.write(C0039_2, (-5_i32) as u32 as u64);
    let mut last = side.write(code(12, 0, Kind::U8), 0x1FF);
    assert_eq!(module.end(&mut side, &mut last), Ok(0x1FF));
    assert!(first.poll().unwrap().is_ok());
    let expected = [
        &[1, 2, 0, 2, 0x10, 1, 0x5F, 0xD8, 0, 2, 0x10, 0, 0x5F, 0xF3, 0, 0][..],
        &[4, 1, 0xFF, 0xFF, 0xFF, 0xFB, 5, 1, 0xFF, 0],
    ];
    assert_eq!(module.written, [expected.concat()]);
    // What is behind a write that fails, or behind a read, was never sent.
    for (service, value, sent) in [(WRITE, 1, 2), (READ, 0, 2)] {
        let mut series = side.series(&[(service, code(999, 0, Kind::Own), value), (WRITE, C0039_2, 2)]);
        assert_eq!(module.end(&mut side, &mut series[1]), Err(CallError::Skipped));
        assert_eq!(series[0].poll(), Some(Err(CallError::Refused(0))));
        assert_eq!(module.written.len(), sent, "{service}");
    }
    // One that is cancelled before the request leaves is not in it.
    let mut wanted = side.write(C0039_2, 3);
    let unwanted = side.write(C0039_2, 4);
    side.access.advance(side.now, Link::Online, true, false);
    drop(unwanted);
    assert!(module.end(&mut side, &mut wanted).is_ok());
    assert_eq!(module.written.last().map(|request| request[3]), Some(1));
}

#[test]
fn the_format_of_a_response_is_obeyed_and_one_that_contradicts_its_address_is_refused_by_name() {
    for (address, format, bytes, expected) in [
        (C0061, 0x42, &[0, 0x2B][..], Ok((43, Kind::I16))),
        (C0061, 0x43, &[0, 6, 0x8F, 0xB0], Ok((430_000, Kind::Own))),
        (C0061, 0x04, &[0, 6, 0x8F, 0xB0], Ok((430_000, Kind::Own))),
        (C0061, 0x06, &[0xFF, 0xFE], Ok((0xFFFE, Kind::U16))),
        (C0061, 0x03, &[0xFF, 0xFE], Ok((0xFFFF_FFFE, Kind::I16))),
        (C0061, 0x09, b"43", Err(0x5000_0409)),
        (code(61, 0, Kind::U16), 0x42, &[0xFF, 0xFE], Ok((0xFFFE, Kind::Own))),
        (code(61, 0, Kind::I32), 0x42, &[0, 0x2B], Err(0x5000_0442)),
        (code(61, 0, Kind::U16), 0x03, &[0, 0x2B], Err(0x5000_0603)),
        (code(61, 0, Kind::Text), 0x42, &[0, 0x2B], Err(0x5000_0942)),
    ] {
        let (mut side, mut module) = (Side::new(MSAC1), Module::new());
        let mut ticket = side.read(address);
        let end = loop {
            match side.turn() {
                Sent::Exchange(out) => side.access.channel_answered(&out),
                Sent::Msac1(data) => {
                    let reply = match module.exchange(&data) {
                        Reply::Data(data) if data[0] == 0x5E => {
                            let count = if format == 9 { bytes.len() as u8 } else { 1 };
                            let body = [&[data[4], 1, 0, 1, format, count], bytes].concat();
                            Reply::Data([&[0x5E, 0, 47, body.len() as u8], &body[..]].concat())
                        }
                        reply => reply,
                    };
                    side.access.answered(side.now, reply.answer());
                }
            }
            if let Some(end) = ticket.poll() {
                break end.map(|answer| (answer.value, answer.address));
            }
        };
        let learned = |(value, kind)| (value, super::super::super::target::learned(address, kind));
        assert_eq!(end, expected.map(learned).map_err(CallError::Refused), "{address:X} {format:X}");
    }
}

#[test]
fn busy_is_again_later_and_all_else_is_refused_by_name() {
    let mut side = Side::new(MSAC1);
    for (refusal, expected) in [
        ([0xDF, 0x80, 0xC2, 0], Ok(9)),
        ([0xDF, 0x80, 0xB5, 0], Ok(9)),
        ([0xDF, 0x80, 0xB6, 0], Err(CallError::Refused(0x1080_B600))),
        ([0xDF, 0x81, 0xC2, 0], Err(CallError::Refused(0x1081_C200))),
    ] {
        let mut module = Module::new();
        let mut ticket = side.write(C0039_2, 9);
        let (mut times, mut at) = (3, Vec::new());
        let exchanges = std::cell::Cell::new(0);
        let channel = |out| {
            exchanges.set(exchanges.get() + 1);
            Some(out)
        };
        let end = side.until(&mut ticket, channel, |data| {
            if data.first() == Some(&0x5F) && times > 0 {
                times -= 1;
                at.push(exchanges.get());
                return Some(Reply::Data(refusal.to_vec()));
            }
            Some(module.exchange(data))
        });
        assert_eq!(end, expected);
        assert!(at.windows(2).all(|two| two[1] - two[0] >= 4), "{at:?}");
        assert_eq!(module.written.len(), usize::from(expected.is_ok()));
    }
    for function in [1, 3] {
        let mut ticket = side.write(C0039_2, 9);
        let end = side.by_msac1(&mut ticket, |_| Some(Reply::Refused(function)));
        assert_eq!(end, Err(CallError::Refused(0x3000_0000 | u32::from(function))));
    }
}

#[test]
fn a_write_whose_outcome_is_refused_or_lost_is_uncertain() {
    // The poll for the answer, and the reading of the response.
    for (refused, reply) in [
        (&[][..], Reply::Refused(3)),
        (&[0x5E, 0, 47, 240], Reply::Refused(3)),
        (&[0x5E, 0, 47, 240], Reply::Data(vec![0xDE, 0x80, 0xB6, 0])),
    ] {
        let (mut side, mut module) = (Side::new(MSAC1), Module::new());
        let mut ticket = side.write(C0039_2, 9);
        let end = side.by_msac1(&mut ticket, |data| {
            Some(if data == refused { reply.clone() } else { module.exchange(data) })
        });
        assert_eq!((end, module.written.len()), (Err(CallError::TimedOut), 1), "{reply:?}");
    }
    // A record.
    let (mut side, mut module) = (Side::new(MSAC1), Module { delay: 0, ..Module::new() });
    let to = record(1, 3);
    let mut pieces = side.series(&[(LOAD, to, 1), (STORE, to, 8)]);
    let mut first = true;
    let end = side.by_msac1(&mut pieces[1], |data| {
        let reply = module.exchange(data);
        (!std::mem::take(&mut first)).then_some(reply)
    });
    assert_eq!((end, module.written.len()), (Err(CallError::TimedOut), 1));
}

#[test]
fn an_unfetched_response_is_fetched_before_the_next_request() {
    let stale = vec![0x5E, 0, 47, 4, 1, 1, 0, 1];
    let (mut side, mut module) = (Side::new(MSAC1), Module { stored: Some((1, stale)), ..Module::new() });
    let mut ticket = side.write(C0039_2, 9);
    assert_eq!((module.end(&mut side, &mut ticket), module.written.len()), (Ok(9), 1));

    // The answer to a request that was given up comes at last.
    let (mut side, mut module) = (Side::new(MSAC1), Module { delay: u32::MAX, ..Module::new() });
    let mut first = side.read(C0061);
    assert_eq!(module.end(&mut side, &mut first), Err(CallError::TimedOut));
    while !side.access.is_idle() {
        match side.turn() {
            Sent::Exchange(inputs) => side.access.channel_answered(&inputs),
            Sent::Msac1(data) => side.access.answered(side.now, module.exchange(&data).answer()),
        }
    }
    module.delay = 0;
    module.stored.iter_mut().for_each(|(polls, _)| *polls = 1);
    let mut second = side.read(C0061);
    let end = side.by_msac1(&mut second, |data| {
        let reply = module.exchange(data);
        assert_ne!(reply, Reply::Refused(2), "it was in the way");
        Some(reply)
    });
    assert_eq!(end, Ok(430_000));

    // A response that nobody has read, of a master that is gone: the drive takes no other request before.
    let stale = vec![0x77, 1, 0, 1, 0x43, 1, 0, 0, 0, 9];
    for busy in [0, 3] {
        let (mut side, mut module) = (Side::new(MSAC1), Module { busy, ..Module::new() });
        let mut unread = Some(stale.clone());
        let mut ticket = side.write(C0039_2, 9);
        let end = side.by_msac1(&mut ticket, |data| {
            Some(match (data, &mut unread) {
                ([0x5F, ..], Some(_)) => Reply::Data(vec![0xDF, 0x80, 0xB5, 0]),
                ([0x5E, ..], unread @ Some(_)) => {
                    let response = unread.take().unwrap();
                    Reply::Data([&[0x5E, 0, 47, response.len() as u8], &response[..]].concat())
                }
                _ => module.exchange(data),
            })
        });
        assert_eq!((end, module.written.len()), (Ok(9), 1));
    }

    // A write that has timed out ends with the drive.
    let (mut side, mut module) = (Side::new(MSAC1), Module { busy: u32::MAX, ..Module::new() });
    let [mut first, mut second] = [side.write(C0039_2, 9), side.read(C0061)];
    assert_eq!(module.end(&mut side, &mut first), Err(CallError::TimedOut));
    assert!(side.access.commands());
    (module.left, module.busy) = (3, 0);
    assert_eq!(module.end(&mut side, &mut second), Ok(430_000));
    assert!(!side.access.commands() && module.written.len() == 1 && module.requests == 2);
}

/// A module with a text of 51 characters, of which a response has at most so many.
fn text(most: usize) -> (Result<u64, CallError>, Vec<u8>, u32) {
    let whole: Vec<u8> = (0..51).map(|n| b'0' + n % 10).collect();
    let mut side = Side::new(MSAC1);
    let address = code(200, 0, Kind::Text);
    let calls: Vec<_> =
        [(READ, 0), (SIZE, 0)].into_iter().chain((1..7).map(|part| (PART, 8 * part))).collect();
    let calls: Vec<_> = calls.into_iter().map(|(service, value)| (service, address, value)).collect();
    let mut tickets = side.series(&calls);
    let (mut request, mut requests) = (Vec::new(), 0);
    let mut last = tickets.pop().unwrap();
    let end = side.by_msac1(&mut last, |data| {
        Some(Reply::Data(match data {
            [0x5F, 0, 47, _, bytes @ ..] => {
                request = bytes.to_vec();
                requests += 1;
                data[..4].to_vec()
            }
            _ => {
                let (count, from) = (usize::from(request[5]), usize::from(request[9]));
                let count = if count < 2 { whole.len() } else { count };
                let part = &whole[from.min(whole.len())..whole.len().min(from + count)];
                let mut out = match part.len() {
                    0 => vec![request[0], 0x81, 0, 1, 0x44, 1, 0, 3],
                    size if size > most => vec![request[0], 0x81, 0, 1, 0x44, 1, 0, 0x15],
                    size => [&[request[0], 1, 0, 1, 9, size as u8], part].concat(),
                };
                if out.len() % 2 == 1 {
                    out.push(0);
                }
                [&[0x5E, 0, 47, out.len() as u8], &out[..]].concat()
            }
        }))
    });
    let answers = tickets.iter_mut().map(|ticket| ticket.poll().unwrap().map(|answer| answer.value));
    let mut bytes = Vec::new();
    for (place, answer) in answers.enumerate().filter(|(place, _)| *place != 1) {
        bytes.extend(answer.unwrap_or_else(|error| panic!("{place}: {error}")).to_le_bytes());
    }
    (end, bytes, requests)
}

#[test]
fn a_text_is_read_whole_or_in_parts() {
    let expected: Vec<u8> = (0..48).map(|n| b'0' + n % 10).collect();
    for (most, requests) in [(60, 1), (32, 5), (16, 5)] {
        let (end, bytes, count) = text(most);
        assert_eq!((bytes, count), (expected.clone(), requests));
        assert_eq!(end, Ok(0x30_3938), "the last three characters");
    }
}

#[test]
fn any_record_is_read_and_written_with_any_path() {
    for path in [ParameterPath::None, PKW, ParameterPath::Drivecom, MSAC1] {
        let (mut side, mut module) = (Side::new(path), Module::new());
        let to = record(1, 3);
        let mut read = side.series(&[(READ, to, 0), (SIZE, to, 0)]);
        assert_eq!(module.end(&mut side, &mut read[1]), Ok(3));
        assert_eq!(read[0].poll().unwrap().unwrap().value, 0x03_0201);
        let pieces = [(LOAD, to, 0x0807_0605_0403_0201), (LOAD, to, 0x0A09), (STORE, to, 10)];
        let mut pieces = side.series(&pieces);
        assert_eq!(module.end(&mut side, &mut pieces[2]), Ok(10));
        assert_eq!(module.written, [(1..=10).collect::<Vec<u8>>()]);
        // Others that there are not; what was not handed over is not written.
        for (service, address, value, why) in [
            (READ, record(2, 3), 0, 0x1080_B000),
            (READ, record(1, 4), 0, 0x1080_B000),
            (STORE, to, 10, NOT_LOADED),
        ] {
            let mut ticket = side.post(service, address, value);
            assert_eq!(module.end(&mut side, &mut ticket), Err(CallError::Refused(why)));
        }
        assert_eq!(module.written.len(), 1);
    }
}

#[test]
fn while_power_is_on_fewer_turns_are_taken_from_the_exchange() {
    for (guarded, every) in [(false, 2), (true, 4)] {
        let mut side = Side::new(MSAC1);
        side.guarded = guarded;
        let _ticket = side.read(C0061);
        let mut turns = Vec::new();
        for turn in 0..40 {
            match side.turn() {
                Sent::Exchange(_) => side.access.channel_answered(&[0; 8]),
                Sent::Msac1(_) => {
                    turns.push(turn);
                    side.access.answered(side.now, Answer::Acknowledged);
                }
            }
        }
        assert!(turns.len() > 8 && turns.windows(2).all(|two| two[1] - two[0] == every), "{turns:?}");
    }
    // What the drive forgets ends with it.
    for (service, why) in [(READ, CallError::Restarted), (WRITE, CallError::TimedOut)] {
        let mut side = Side::new(MSAC1);
        let mut ticket = side.post(service, C0039_2, 0);
        while !matches!(side.turn(), Sent::Msac1(_)) {
            side.access.channel_answered(&[0; 8]);
        }
        side.access.ended();
        assert_eq!(ticket.poll(), Some(Err(why)));
        side.rest(2, [0; 8]);
        assert!(side.access.is_idle());
    }
}
