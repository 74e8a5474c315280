//! Scripted servers at the other end of a handshake.

use super::super::plan::Via;
use super::*;
use crate::wire::{Registers, function};

/// Gets the number of a request, the reply to the one before, and its own; makes what is sent.
type Change<'a> = &'a dyn Fn(usize, &[u8], Vec<u8>) -> Vec<u8>;

/// A server that keeps what is written, and how it answers.
struct Server<'a> {
    registers: [u16; 0x8000],
    before: Vec<u8>,
    requests: usize,
    change: Change<'a>,
}

impl Server<'_> {
    fn answer(&mut self, request: &[u8]) -> Vec<u8> {
        let (header, request) = Request::parse(request).expect("a request");
        let bytes =
            |registers: &[u16]| registers.iter().flat_map(|word| word.to_be_bytes()).collect::<Vec<_>>();
        let mut reply = vec![0; ADU_MAX];
        let size = match request {
            Request::Read { address, count } => {
                let data = bytes(&self.registers[usize::from(address)..][..usize::from(count)]);
                let data = Registers::new(&data).unwrap();
                Response::Read { data }.emit(header, &mut reply)
            }
            Request::Write { address, data } => {
                let place = &mut self.registers[usize::from(address)..];
                place.iter_mut().zip(data.words()).for_each(|(place, word)| *place = word);
                Response::Written { address, count: data.len() as u16 }.emit(header, &mut reply)
            }
            other => panic!("{other:?}"),
        };
        reply.truncate(size);
        self.requests += 1;
        let sent = (self.change)(self.requests, &self.before, reply.clone());
        self.before = reply;
        sent
    }
}

/// How a handshake with this server ends, what it hands over, and how many requests it took; its replies come in pieces
/// of so many bytes.
fn shake(via: Via, piece: usize, change: Change<'_>) -> (HandshakeState, Finding, usize) {
    let mut drive = UnidriveDrive::new("u", [192, 168, 1, 21].into());
    let direct = Mapping::new(&UnidriveDrive { via: Via::Direct, ..drive.clone() }).unwrap();
    drive.via = via;
    let menu_0 = (via != Via::Direct).then(|| Mapping::new(&drive).unwrap());
    let found = Arc::new(Found::default());
    let mut handshake = UnidriveHandshake::new(&drive, direct, menu_0, Arc::clone(&found));
    let mut server = Server { registers: [0; 0x8000], before: Vec::new(), requests: 0, change };
    let (mut now, mut out) = (Time(S), Vec::new());
    let mut state = handshake.begin(now, &mut out);
    let until = now + handshake.longest_ns();
    while state == HandshakeState::More && now < until {
        now = now + MS;
        if !out.is_empty() {
            let reply = server.answer(&std::mem::take(&mut out));
            for bytes in reply.chunks(piece) {
                if state == HandshakeState::More {
                    state = handshake.take(now, bytes, &mut out);
                }
            }
        } else if handshake.next_due().is_some_and(|due| due <= now) {
            state = handshake.run(now, &mut out);
        }
    }
    if state == HandshakeState::More {
        state = HandshakeState::Failed(handshake.overdue().unwrap_or_default());
    }
    (state, found.get(&InputLog::default()), server.requests)
}

fn exception(code: u8, reply: &[u8]) -> Vec<u8> {
    [&reply[..4], &[0, 3, reply[6], reply[7] | function::EXCEPTION, code]].concat()
}

#[test]
fn a_busy_drive_gets_its_request_again_and_second_replies_are_dropped() {
    for (via, piece) in [(Via::Direct, 1), (Via::Direct, 300), (Via::Menu0 { first: 1 }, 300)] {
        let (state, plain, requests) = shake(via, piece, &|_, _, reply| reply);
        assert_eq!((state, plain.duplicates, plain.busy), (HandshakeState::Done, 0, 0));
        let all = requests as u16;
        let busy = |code: u8| {
            move |n: usize, _: &[u8], reply: Vec<u8>| if n % 2 == 1 { exception(code, &reply) } else { reply }
        };
        let (busy_5, busy_6) = (busy(5), busy(6));
        let cases: [(&str, Change<'_>, [u16; 2]); 4] = [
            ("each request is accepted first", &busy_5, [0, all]),
            ("each request finds it busy first", &busy_6, [0, all]),
            ("the reply before comes again", &|_, before, reply| [before, &reply].concat(), [all - 1, 0]),
            ("each reply comes twice", &|_, _, reply| [&reply[..], &reply].concat(), [all, 0]),
        ];
        for (what, change, counts) in cases {
            let (state, found, _) = shake(via, piece, change);
            // In pieces the second reply to the last request comes behind the handshake.
            let last = u16::from(piece == 1 && what.ends_with("twice"));
            assert_eq!(state, HandshakeState::Done, "{what}");
            assert_eq!([found.duplicates + last, found.busy], counts, "{what}");
            assert_eq!(Finding { duplicates: 0, busy: 0, ..found }, plain, "{what}");
        }
    }
}

#[test]
fn a_drive_that_stays_busy_and_a_peer_that_answers_something_else_are_named() {
    let refused = |code: u8| {
        move |n: usize, _: &[u8], reply: Vec<u8>| if n > 1 { exception(code, &reply) } else { reply }
    };
    let (address, value, failure) = (refused(2), refused(3), refused(4));
    let cases: [(Change<'_>, &str); 9] = [
        (&|_, _, reply| exception(6, &reply), "the drive is busy all the time: exception 06h"),
        (
            &address,
            "or too many registers at once; look at map, monitor and also_read, and at the addressing",
        ),
        (&value, "an invalid value in the request; look at the bits in map, monitor and also_read"),
        (&failure, "the drive failed to do it; restart the drive and its option modules"),
        (
            &|_, _, reply| [&[0x12, 0x34], &reply[2..]].concat(),
            "with another transaction id than the request has",
        ),
        (
            &|_, _, mut reply| {
                reply[1] += 1;
                reply
            },
            "with another transaction id than the request has",
        ),
        // That of the request before, and nothing else; and nothing at all.
        (
            &|n, before, reply| if n == 3 { [&before[..2], &reply[2..]].concat() } else { reply },
            "it answers with another transaction id than the request has: look",
        ),
        (&|n, _, reply| if n == 3 { Vec::new() } else { reply }, "it answers, and too late: "),
        // The reply to a request that has not left.
        (
            &|_, _, reply| {
                let mut next = reply.clone();
                next[1] += 1;
                [reply, next].concat()
            },
            "with another transaction id than the request has",
        ),
    ];
    for (change, expected) in cases {
        let (state, ..) = shake(Via::Direct, 300, change);
        let HandshakeState::Failed(why) = state else { panic!("{expected}: {state:?}") };
        assert!(why.contains(expected), "{why}");
    }
}
