//! What must not happen on any bytes.

use proptest::prelude::*;

use super::*;
use crate::bus::ethernet_ip::wire::encapsulation::FRAME_MAX;

/// What a drive, or something else, may send in answer to the last request.
#[derive(Clone, Debug)]
enum Event {
    Bytes(Vec<u8>),
    Answer(&'static str),
    Changed { message: &'static str, place: usize, byte: u8 },
    Connected { sequence: u16, message: &'static str },
    Wait(u64),
    Wish(Wish),
    Lost,
    Call,
    Guard(bool),
}

fn event() -> impl Strategy<Value = Event> {
    let message = || {
        prop::sample::select(vec![
            IDENTITY_REPLY,
            SECOND,
            FIRST,
            OPENED,
            CLOSED,
            PROBED,
            "D4 00 01 02 27 01 06 00 01 00 34 12 EE FF C0 00 00 00",
            "D4 00 01 01 00 01 01 00 34 12 EE FF C0 00 00 00",
            "BC 00 00 00 00 02 84 1E 02 58 00 00",
            "D4 00 00 00 14 00 01 5A 02 00 01 00 02 00 34 12 EE FF C0 00 40 42 0F 00 40 42 0F 00 00 00",
        ])
    };
    prop_oneof![
        2 => prop::collection::vec(any::<u8>(), 0..80).prop_map(Event::Bytes),
        6 => message().prop_map(Event::Answer),
        4 => (message(), any::<usize>(), any::<u8>())
            .prop_map(|(message, place, byte)| Event::Changed { message, place, byte }),
        2 => (0_u16..4, message()).prop_map(|(sequence, message)| Event::Connected { sequence, message }),
        3 => (0..3 * S).prop_map(Event::Wait),
        1 => (0_u32..3).prop_map(|generation| Event::Wish(Wish::TimedOut { generation })),
        1 => Just(Event::Wish(Wish::Close { generation: 1 })),
        1 => Just(Event::Lost),
        2 => Just(Event::Call),
        1 => any::<bool>().prop_map(Event::Guard),
    ]
}

proptest! {
    /// Calls end at most once, the loop gets connections one after the other, and nothing grows.
    #[test]
    fn whatever_a_drive_sends_the_session_stays_bounded_and_in_order(
        connected: bool,
        events in prop::collection::vec((event(), 1_usize..90), 0..60),
    ) {
        let mut bench = Bench::of_drive(|drive| {
            drive.explicit = if connected { Explicit::Connected } else { Explicit::Unconnected };
        });
        let mut open = None;
        let mut last = 0;
        let mut tickets = Vec::new();
        bench.state = bench.session.begin(bench.now, &mut bench.out);
        for (event, split) in events {
            let context = bench.session.context;
            let arrived = match event {
                Event::Bytes(bytes) => bytes,
                Event::Answer(message) if bench.session.handle == 0 => {
                    let _ = message;
                    framed(0x65, SESSION, context, &hex("01 00 00 00"))
                }
                Event::Answer(message) => rr(context, message),
                Event::Changed { message, place, byte } => {
                    let mut frame = rr(context, message);
                    let place = place % frame.len();
                    frame[place] = byte;
                    frame
                }
                Event::Connected { sequence, message } => unit("02 00 01 00", sequence, message),
                Event::Wait(ns) => {
                    bench.pass(ns);
                    Vec::new()
                }
                Event::Wish(wish) => {
                    bench.loop_end.wish(wish);
                    Vec::new()
                }
                Event::Lost => {
                    bench.state = HandshakeState::Failed("lost".into());
                    Vec::new()
                }
                Event::Call => {
                    tickets.extend(bench.acyclic.post(target::Target::Absolute.read(), LIMIT));
                    bench.look();
                    Vec::new()
                }
                Event::Guard(on) => {
                    bench.loop_end.guard(on);
                    Vec::new()
                }
            };
            for part in arrived.chunks(split) {
                if let HandshakeState::Failed(_) = bench.state {
                    break;
                }
                bench.state = bench.session.take(bench.now, part, &mut bench.out);
            }
            if let HandshakeState::Failed(_) = bench.state {
                // As its carrier does.
                bench.lose();
                bench.pass(MS);
                bench.state = bench.session.begin(bench.now, &mut bench.out);
            }
            prop_assert!(bench.session.inbox.len() < FRAME_MAX);
            prop_assert!(bench.session.to_close.len() <= MOST_TO_CLOSE + 1);
            bench.out.clear();
            for news in bench.news() {
                match news {
                    News::Opened(connection) => {
                        prop_assert_eq!((open, connection.generation), (None, last + 1));
                        (open, last) = (Some(connection.generation), connection.generation);
                    }
                    News::Closed { generation: 0 } => prop_assert_eq!(open, None),
                    News::Closed { generation } => prop_assert_eq!(open.take(), Some(generation)),
                    News::Read(_) => {}
                }
            }
            tickets.retain_mut(|ticket| ticket.poll().is_none());
        }
        // Without a session no call waits.
        bench.lose();
        bench.look();
        prop_assert!(tickets.iter_mut().all(|ticket| ticket.poll().is_some()));
    }
}
