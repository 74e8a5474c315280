//! The life of a session, in plain time: connections come and go, the session stays. And whatever a handshake or a
//! session does.

use std::sync::{Arc, Mutex};

use proptest::prelude::*;

use super::*;
use crate::time::Ns;

/// The events of a session.
#[derive(Debug, Default)]
struct Log {
    opened: usize,
    closed: Vec<String>,
    got: Vec<u8>,
    runs: Vec<Time>,
    /// The time of its next action.
    due: Option<Time>,
    next: Option<HandshakeState>,
    say: Vec<u8>,
    ended: bool,
}

#[derive(Clone, Debug, Default)]
struct Toy(Arc<Mutex<Log>>);

impl Toy {
    fn with<R>(&self, f: impl FnOnce(&mut Log) -> R) -> R {
        f(&mut self.0.lock().unwrap())
    }

    /// A session from the beginning, where nothing else is to come.
    fn next(&self, out: &mut Vec<u8>) -> HandshakeState {
        self.with(|log| {
            out.append(&mut log.say);
            log.next.take().unwrap_or(HandshakeState::Kept)
        })
    }
}

impl Handshake for Toy {
    fn begin(&mut self, _now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.with(|log| log.opened += 1);
        self.next(out)
    }

    fn take(&mut self, _now: Time, bytes: &[u8], out: &mut Vec<u8>) -> HandshakeState {
        self.with(|log| log.got.extend_from_slice(bytes));
        self.next(out)
    }

    fn next_due(&self) -> Option<Time> {
        self.with(|log| log.due)
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.with(|log| log.runs.push(now));
        self.next(out)
    }

    fn closed(&mut self, _now: Time, why: &str) {
        self.with(|log| log.closed.push(why.to_owned()));
    }

    fn has_ended(&self) -> bool {
        self.with(|log| log.ended)
    }
}

fn session() -> (Connection, Toy, LinkNotes) {
    let (toy, notes) = (Toy::default(), LinkNotes::new(1));
    let peer = StreamPeer::new(address(20), Box::new(toy.clone()));
    (Connection::new(START, peer, notes.clone(), 0), toy, notes)
}

/// All the way to an open connection.
fn open(connection: &mut Connection) -> Time {
    let now = connect(connection);
    connection.connected(now);
    now
}

#[test]
fn a_session_runs_when_it_is_due_or_woken_with_a_connection_or_without() {
    let (mut connection, toy, _) = session();
    toy.with(|log| log.due = Some(START + MS));
    assert_eq!(connection.next_due(), Some(START + MS));
    toy.with(|log| log.say = b"nobody gets this".to_vec());
    assert_eq!(connection.poll(START + MS), Action::Wait);
    assert_eq!(toy.with(|log| log.runs.clone()), [START + MS]);
    // A clock that stands still keeps nobody busy.
    assert_eq!(connection.next_due(), Some(START + 2 * MS));
    assert_eq!(connection.run(START + MS), Action::Wait);
    toy.with(|log| log.due = None);
    let now = open(&mut connection);
    assert!(connection.to_send().is_empty());
    toy.with(|log| log.say = b"call".to_vec());
    assert_eq!(connection.run(now), Action::Send);
    assert_eq!(connection.to_send(), b"call");
    assert_eq!(toy.with(|log| log.runs.len()), 3);
}

#[test]
fn each_end_is_reported_once_with_its_reason_and_opened_again_after_a_pause() {
    let (mut connection, toy, notes) = session();
    type End<'a> = (&'a dyn Fn(&mut Connection, Time) -> Action, &'a str);
    let ends: [End; 5] = [
        (&|one, now| one.failed(now, Broken::Closed), "192.168.1.20:502 has ended the connection"),
        (
            &|one, now| one.failed(now, Broken::Failed(libc::ETIMEDOUT)),
            "192.168.1.20:502 was lost: look at the cable and the drive's power",
        ),
        (&|one, now| one.received(now, b"bad"), "192.168.1.20:502: session refused"),
        (&|one, now| one.run(now), "192.168.1.20:502: session refused"),
        (
            &|one, now| {
                one.run(now);
                one.failed(now, Broken::Failed(libc::EPIPE))
            },
            "192.168.1.20:502 has ended the connection",
        ),
    ];
    for (round, (end, why)) in ends.into_iter().enumerate() {
        let now = open(&mut connection);
        if (2..4).contains(&round) {
            toy.with(|log| log.next = Some(HandshakeState::Failed("session refused".into())));
        }
        assert_eq!(end(&mut connection, now), Action::Close);
        assert_about(pause(&connection, now), [100, 200, 400, 800, 1_600][round] * MS);
        assert_eq!((notes.get(0).as_deref(), toy.with(|log| log.closed.len())), (Some(why), round + 1));
        assert_eq!(toy.with(|log| log.closed[round].clone()), why);
    }
    // What could not be opened was no connection.
    let now = connect(&mut connection);
    assert_eq!(connection.failed(now, Broken::Failed(libc::ECONNREFUSED)), Action::Close);
    assert_eq!(toy.with(|log| (log.opened, log.closed.len())), (5, 5));
    // One that was open for long begins with the least pause again.
    let now = open(&mut connection) + 2 * S;
    assert_eq!(connection.failed(now, Broken::Closed), Action::Close);
    assert_about(pause(&connection, now), 100 * MS);
}

proptest! {
    #[test]
    fn random_events_keep_one_socket_one_owner_and_bounded_waits(
        // Times in all orders of magnitude.
        steps in prop::collection::vec(
            (0..10_u8, 0..4_usize, (0..35_u32).prop_flat_map(|bits| 0..1_u64 << bits)),
            0..200,
        )
    ) {
        let (mut connection, toy, _) = session();
        // Whether there is a socket, whether the loop has it, and how often it got it.
        let (mut now, mut socket, mut out, mut handed_over) = (START, false, false, 0);
        for (step, will, pass) in steps {
            now = now + pass;
            let next = match will {
                0 => HandshakeState::Kept,
                1 => HandshakeState::More,
                2 => HandshakeState::Failed("no".into()),
                _ => HandshakeState::Done,
            };
            toy.with(|log| {
                log.due = (will == 2).then_some(now);
                log.say = vec![7; usize::from(step)];
                log.next = Some(next);
            });
            let action = match step {
                0 | 1 => connection.poll(now),
                2 | 3 => connection.connected(now),
                4 => connection.failed(now, Broken::Closed),
                5 => connection.received(now, b"reply"),
                6 | 7 => connection.sent(now, will * 9),
                8 => connection.given_back(now, "it is tried"),
                _ => connection.run(now),
            };
            match action {
                Action::Wait => {}
                Action::Connect => {
                    prop_assert!(!socket);
                    socket = true;
                }
                Action::Send => prop_assert!(socket && !out && !connection.to_send().is_empty()),
                Action::HandOver => {
                    prop_assert!(socket && !out && connection.to_send().is_empty());
                    (out, handed_over) = (true, handed_over + 1);
                }
                Action::Close => {
                    prop_assert!(socket);
                    (socket, out) = (false, false);
                }
            }
            let (opened, closed) = toy.with(|log| (log.opened, log.closed.len() + handed_over));
            prop_assert!(opened == closed || opened == closed + 1 && socket && !out, "{opened} {closed}");
            match connection.next_due() {
                None => prop_assert!(socket),
                Some(due) => prop_assert!(due <= now + 2 * S, "due in {}", Ns(due.since(now))),
            }
        }
    }
}
