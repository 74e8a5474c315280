//! What must not happen on any bytes.

use fastrand::Rng;

use super::*;
use crate::target::Target;
use crate::wire::encapsulation::{DATA_MAX, HEADER};
use fieldbeat_core::axis::acyclic::long::Target as _;

/// The messages that a drive may send at any time.
const MESSAGES: [&str; 11] = [
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
];

/// The bytes of a call of `Stop`, which commands the drive.
fn is_command(window: &[u8]) -> bool {
    window == hex("3C 03 20 64 24 01 30 01 00 02 A3")
}

/// A message on the newest connection.
fn on_newest(session: &Session, sequence: u16, message: &str) -> Vec<u8> {
    unit(&format!("{} 01 00", wire(session.serial.unwrap_or_default())), sequence, message)
}

/// The right answer of the drive now.
fn right(session: &Session) -> Vec<u8> {
    let Some(pending) = &session.pending else { return Vec::new() };
    let message = match pending.what {
        RequestKind::Register => return framed(0x65, SESSION, session.context, &hex("01 00 00 00")),
        RequestKind::Identity => IDENTITY_REPLY.to_owned(),
        RequestKind::Profile => SECOND.to_owned(),
        RequestKind::Homed(_) | RequestKind::Probe => PROBED.to_owned(),
        RequestKind::Open(Open { triad, .. }, ..) | RequestKind::OpenConnected(Open { triad, .. }) => {
            of(triad.serial, OPENED)
        }
        RequestKind::Close => of(session.to_close.front().map_or(0, |open| open.triad.serial), CLOSED),
        RequestKind::Power => "BC 00 00 00 00 02 84 80 00 00 00 00".to_owned(),
        RequestKind::Call => "BC 00 00 00 00 02 A3 00 00 09 00 00".to_owned(),
    };
    match pending.way {
        Way::Unconnected { context } => rr(context, &message),
        Way::Connected { sequence, .. } => on_newest(session, sequence, &message),
    }
}

/// The bytes that a drive, or something else, sends in answer to the last request.
fn arrives(session: &Session, random: &mut Rng) -> Vec<u8> {
    let message = MESSAGES[random.usize(..MESSAGES.len())];
    let mut answer = rr(session.context, message);
    match random.u8(..38) {
        0..2 => (0..random.usize(..80)).map(|_| random.u8(..)).collect(),
        2..8 if session.handle == 0 => framed(0x65, SESSION, session.context, &hex("01 00 00 00")),
        2..8 => answer,
        8..12 => {
            let place = random.usize(..answer.len());
            answer[place] = random.u8(..);
            answer
        }
        12..14 => on_newest(session, random.u16(..4), message),
        _ => right(session),
    }
}

/// Calls end, the loop gets connections one after the other, nothing grows, and nothing commands a drive whose loop
/// guards it.
#[test]
fn random_bytes_of_a_drive_keep_the_session_bounded_and_in_order() {
    for seed in 0..512 {
        let random = &mut Rng::with_seed(seed);
        let explicit = [Explicit::Unconnected, Explicit::Connected][seed as usize % 2];
        let mut bench = Bench::of_drive(|drive| drive.explicit = explicit);
        let (mut open, mut last, mut tickets) = (None, 0, Vec::new());
        // The loop guards; it has seen that nothing that commands the drive is under way any more.
        let (mut guarded, mut safe) = (false, false);
        bench.state = bench.session.begin(bench.now, &mut bench.out);
        for _ in 0..random.usize(..100) {
            let mut arrived = Vec::new();
            match random.u8(..50) {
                0..38 => arrived = arrives(&bench.session, random),
                38..41 => bench.pass(random.u64(..3 * S)),
                41 => _ = bench.loop_end.wish(Wish::TimedOut { generation: random.u32(..3) }),
                42 if random.u8(..10) == 0 => _ = bench.loop_end.wish(Wish::Close { generation: 1 }),
                42 => _ = bench.loop_end.wish(Wish::TimedOut { generation: 1 }),
                43 => bench.state = HandshakeState::Failed("lost".into()),
                44..48 => {
                    let call = if random.bool() { Target::Stop.write(0) } else { Target::Absolute.read() };
                    tickets.extend(bench.acyclic.post(call, LIMIT));
                    bench.look();
                }
                _ => (guarded, safe) = (random.bool(), false),
            }
            for part in arrived.chunks(random.usize(1..90)) {
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
            assert!(bench.session.inbox.len() < HEADER + DATA_MAX, "seed {seed}");
            assert!(bench.session.to_close.len() <= MOST_TO_CLOSE + 1, "seed {seed}");
            let commands = bench.taken().windows(11).filter(|window| is_command(window)).count();
            assert!(!safe || commands == 0, "seed {seed}");
            // As the loop does in each cycle.
            safe = !bench.loop_end.guard(guarded) && guarded;
            for news in bench.news() {
                match news {
                    News::Opened(connection) => {
                        assert_eq!((open, connection.generation), (None, last + 1), "seed {seed}");
                        (open, last) = (Some(connection.generation), connection.generation);
                    }
                    News::Closed { generation: 0 } => assert_eq!(open, None, "seed {seed}"),
                    News::Closed { generation } => assert_eq!(open.take(), Some(generation), "seed {seed}"),
                    News::Read(_) => {}
                }
            }
            tickets.retain_mut(|ticket| ticket.poll().is_none());
        }
        // Without a session no call waits.
        bench.lose();
        bench.look();
        assert!(tickets.iter_mut().all(|ticket| ticket.poll().is_some()), "seed {seed}");
    }
}
