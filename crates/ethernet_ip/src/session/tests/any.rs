//! What must not happen on any bytes.

use proptest::prelude::*;

use super::*;
use crate::target::Target;
use crate::wire::encapsulation::{DATA_MAX, HEADER};
use fieldbeat_core::axis::acyclic::long::Target as _;

/// What a drive, or something else, may send in answer to the last request.
#[derive(Clone, Debug)]
enum Event {
    Bytes(Vec<u8>),
    Answer(&'static str),
    Changed {
        message: &'static str,
        place: usize,
        byte: u8,
    },
    /// The answer to the request under way.
    Right,
    Connected {
        sequence: u16,
        message: &'static str,
    },
    Wait(u64),
    Wish(Wish),
    Lost,
    /// `Stop` is written: it commands the drive.
    Call(Target),
    Guard(bool),
}

/// What such a call sends.
fn is_command(window: &[u8]) -> bool {
    window == hex("3C 03 20 64 24 01 30 01 00 02 A3")
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
            "BC 00 00 00 00 02 88 01 00 00 00 07",
            "BC 00 00 00 00 02 A3 00 00 09 00 00",
        ])
    };
    prop_oneof![
        2 => prop::collection::vec(any::<u8>(), 0..80).prop_map(Event::Bytes),
        6 => message().prop_map(Event::Answer),
        4 => (message(), any::<usize>(), any::<u8>())
            .prop_map(|(message, place, byte)| Event::Changed { message, place, byte }),
        24 => Just(Event::Right),
        2 => (0_u16..4, message()).prop_map(|(sequence, message)| Event::Connected { sequence, message }),
        3 => (0..3 * S).prop_map(Event::Wait),
        1 => (0_u32..3).prop_map(|generation| Event::Wish(Wish::TimedOut { generation })),
        1 => prop::bool::weighted(0.1).prop_map(|close| match close {
            true => Event::Wish(Wish::Close { generation: 1 }),
            false => Event::Wish(Wish::TimedOut { generation: 1 }),
        }),
        1 => Just(Event::Lost),
        4 => prop::sample::select(vec![Target::Stop, Target::Absolute]).prop_map(Event::Call),
        2 => any::<bool>().prop_map(Event::Guard),
    ]
}

/// A message on the newest connection.
fn on_newest(session: &Session, sequence: u16, message: &str) -> Vec<u8> {
    unit(&format!("{} 01 00", wire(session.serial.unwrap_or_default())), sequence, message)
}

/// What the drive should answer now.
fn right(session: &Session) -> Vec<u8> {
    let Some(pending) = &session.pending else { return Vec::new() };
    let message = match pending.what {
        What::Register => return framed(0x65, SESSION, session.context, &hex("01 00 00 00")),
        What::Identity => IDENTITY_REPLY.to_owned(),
        What::Profile => SECOND.to_owned(),
        What::Homed(_) | What::Probe => PROBED.to_owned(),
        What::Open(Open { triad, .. }, ..) | What::OpenConnected(Open { triad, .. }) => opened(triad.serial),
        What::Close => of(session.to_close.front().map_or(0, |open| open.triad.serial), CLOSED),
        What::Power => "BC 00 00 00 00 02 84 80 00 00 00 00".to_owned(),
        What::Call => "BC 00 00 00 00 02 A3 00 00 09 00 00".to_owned(),
    };
    match pending.way {
        Way::Unconnected { context } => rr(context, &message),
        Way::Connected { sequence, .. } => on_newest(session, sequence, &message),
    }
}

proptest! {
    /// Calls end, the loop gets connections one after the other, nothing grows, and nothing commands a drive whose loop
    /// guards it.
    #[test]
    fn whatever_a_drive_sends_the_session_stays_bounded_and_in_order(
        connected: bool,
        events in prop::collection::vec((event(), 1_usize..90), 0..100),
    ) {
        let mut bench = Bench::of_drive(|drive| {
            drive.explicit = if connected { Explicit::Connected } else { Explicit::Unconnected };
        });
        let mut open = None;
        let mut last = 0;
        let mut tickets = Vec::new();
        // The loop guards; it has seen that nothing that commands the drive is under way any more.
        let (mut guarded, mut safe) = (false, false);
        bench.state = bench.session.begin(bench.now, &mut bench.out);
        for (event, split) in events {
            let context = bench.session.context;
            let mut arrived = Vec::new();
            match event {
                Event::Bytes(bytes) => arrived = bytes,
                Event::Answer(_) if bench.session.handle == 0 => {
                    arrived = framed(0x65, SESSION, context, &hex("01 00 00 00"));
                }
                Event::Answer(message) => arrived = rr(context, message),
                Event::Changed { message, place, byte } => {
                    arrived = rr(context, message);
                    let place = place % arrived.len();
                    arrived[place] = byte;
                }
                Event::Right => arrived = right(&bench.session),
                Event::Connected { sequence, message } => {
                    arrived = on_newest(&bench.session, sequence, message);
                }
                Event::Wait(ns) => bench.pass(ns),
                Event::Wish(wish) => _ = bench.loop_end.wish(wish),
                Event::Lost => bench.state = HandshakeState::Failed("lost".into()),
                Event::Call(target) => {
                    let call = if target == Target::Stop { target.write(0) } else { target.read() };
                    tickets.extend(bench.acyclic.post(call, LIMIT));
                    bench.look();
                }
                Event::Guard(on) => (guarded, safe) = (on, false),
            }
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
            prop_assert!(bench.session.inbox.len() < HEADER + DATA_MAX);
            prop_assert!(bench.session.to_close.len() <= MOST_TO_CLOSE + 1);
            let commands = bench.taken().windows(11).filter(|window| is_command(window)).count();
            prop_assert!(!safe || commands == 0);
            // As the loop does in each cycle.
            safe = !bench.loop_end.guard(guarded) && guarded;
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
