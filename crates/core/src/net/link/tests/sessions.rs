//! Sessions of the link thread with real peers, and what an application posts to them.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::*;
use crate::axis::acyclic::{
    Acyclic, Answer, Call, CallError, Carrier, Commanding, Numbers, Port, Posted, queue,
};
use crate::axis::{Feedback, Observer, cell};
use crate::rt::Wires;

/// Registers with one byte, and answers calls: the low byte of a value out, and the peer's one back.
#[derive(Debug)]
struct Toy {
    calls: Port,
    under_way: Option<Posted>,
    registered: bool,
    log: Arc<Log>,
}

/// The events of a session.
#[derive(Debug, Default)]
struct Log {
    opened: AtomicU64,
    closed: AtomicU64,
    dropped: AtomicU64,
}

impl Toy {
    fn serve(&mut self, out: &mut Vec<u8>) -> HandshakeState {
        while self.under_way.is_none()
            && let Some(posted) = self.calls.take()
        {
            match posted.call.value {
                _ if !self.registered => self.calls.end(&posted, Err(CallError::NotOnline)),
                value => {
                    out.extend([b'?', value as u8]);
                    self.under_way = Some(posted);
                }
            }
        }
        if self.registered { HandshakeState::Kept } else { HandshakeState::More }
    }
}

impl Handshake for Toy {
    fn begin(&mut self, _now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.log.opened.fetch_add(1, Ordering::Relaxed);
        out.push(b'R');
        HandshakeState::More
    }

    fn take(&mut self, _now: Time, bytes: &[u8], out: &mut Vec<u8>) -> HandshakeState {
        for byte in bytes {
            match (self.registered, self.under_way.take()) {
                (false, _) if *byte == b'r' => self.registered = true,
                (true, Some(posted)) => {
                    let answer = Answer { value: u64::from(*byte), ..Answer::default() };
                    self.calls.end(&posted, Ok(answer));
                }
                _ => return HandshakeState::Failed(format!("sends {byte}")),
            }
        }
        self.serve(out)
    }

    fn run(&mut self, _now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.serve(out)
    }

    fn closed(&mut self, _now: Time, _why: &str) {
        self.log.closed.fetch_add(1, Ordering::Relaxed);
        self.registered = false;
        if let Some(posted) = self.under_way.take() {
            self.calls.end(&posted, Err(CallError::Lost));
        }
    }
}

impl Drop for Toy {
    fn drop(&mut self) {
        self.log.dropped.fetch_add(1, Ordering::Relaxed);
    }
}

fn toy() -> (Toy, crate::axis::acyclic::AcyclicEnds, Arc<Log>) {
    let (ends, calls) = queue(8, Commanding::none());
    let log = Arc::new(Log::default());
    (Toy { calls, under_way: None, registered: false, log: Arc::clone(&log) }, ends, log)
}

/// A session with `address`, and the application's end of its calls.
fn session(os: &Os, address: SocketAddrV4) -> (Box<dyn Streams>, Acyclic, Arc<Log>) {
    let (toy, ends, log) = toy();
    let sessions = os.streams(vec![patient(address, toy)]).unwrap();
    let ends = ends.waking(sessions.waker().unwrap());
    let (_, reader) = cell::cell(Feedback::default());
    (
        sessions,
        Acyclic::new("x", ends, Arc::new(Numbers), Observer::new(reader, Wires::default()), Duration::ZERO),
        log,
    )
}

fn call(value: u64) -> Call {
    Call { value, ..Call::default() }
}

/// Answers each request with its value and one more, until the peer ends the connection.
fn serve(mut drive: TcpStream) {
    let mut begun = false;
    let mut room = [0; 64];
    while let Ok(count @ 1..) = drive.read(&mut room) {
        for byte in &room[..count] {
            match (begun, byte) {
                (true, value) => drive.write_all(&[value + 1]).unwrap(),
                (false, b'R') => drive.write_all(b"r").unwrap(),
                _ => {}
            }
            begun = !begun && *byte == b'?';
        }
    }
}

#[test]
fn calls_are_served_on_the_thread_and_a_post_wakes_it() {
    let listener = listener(address(20, 10));
    let (sessions, acyclic, log) = session(&Os::default(), address(20, 10));
    assert_eq!(acyclic.run(&[call(1)], LONG).failed, Some(CallError::NotOnline));
    let drive = accept(&listener);
    let served = std::thread::spawn(|| serve(drive));
    until("registered", || acyclic.run(&[call(1)], LONG).failed.is_none());
    assert_eq!(sessions.notes().get(0), None);
    // The session has no clock of its own: without a wake-up none of them would end.
    let begun = Instant::now();
    for value in 0..500 {
        let series = acyclic.run(&[call(value % 200), call(7)], LONG);
        let answers: Vec<_> = series.answers.iter().map(|answer| answer.value).collect();
        assert_eq!((answers, series.failed), (vec![value % 200 + 1, 8], None));
    }
    assert!(begun.elapsed() < LONG);
    // Nor is a post of one of many threads lost.
    std::thread::scope(|scope| {
        for thread in 0..4_u64 {
            let acyclic = &acyclic;
            scope.spawn(move || {
                for value in 0..400 {
                    let value = (thread * 50 + value) % 250;
                    assert_eq!(acyclic.run(&[call(value)], LONG).answers[0].value, value + 1);
                }
            });
        }
    });
    assert_eq!((log.opened.load(Ordering::Relaxed), log.closed.load(Ordering::Relaxed)), (1, 0));
    drop(sessions);
    served.join().unwrap();
    assert_eq!(acyclic.run(&[call(1)], LONG).failed, Some(CallError::Gone));
}

/// The last carrier wakes the thread when it goes, and so does the end. Both may come in one look of the thread: it
/// must not clear the second one together with the first and wait for ever.
#[test]
fn thousands_of_sessions_end_at_any_moment_and_leave_nothing() {
    in_own_process(
        "net::link::tests::sessions::thousands_of_sessions_end_at_any_moment_and_leave_nothing",
        || {
            let before = descriptors();
            let listener = listener(address(22, 10));
            for round in 0..3_000 {
                let (sessions, acyclic, log) = session(&Os::default(), address(22, 10));
                let waker = sessions.waker().unwrap();
                match round % 5 {
                    0 => drop(acyclic.post(call(1), LONG)),
                    1 => waker.wake_by_ref(),
                    2 => drop(listener.accept()),
                    3 => drop(std::thread::spawn(move || waker.wake()).join()),
                    _ => {}
                }
                drop(sessions);
                // The thread has ended with its last carrier, and the session with it.
                assert_eq!(log.dropped.load(Ordering::Relaxed), 1);
                assert_eq!(acyclic.run(&[call(1)], LONG).failed, Some(CallError::Gone));
                while listener.accept().is_ok() {}
            }
            drop(listener);
            until("all closed", || descriptors() == before);
        },
    );
}

/// A session with an error of ours.
#[derive(Debug)]
struct Panicking;

impl Handshake for Panicking {
    fn begin(&mut self, _now: Time, _out: &mut Vec<u8>) -> HandshakeState {
        HandshakeState::Kept
    }

    fn take(&mut self, now: Time, _bytes: &[u8], out: &mut Vec<u8>) -> HandshakeState {
        self.begin(now, out)
    }

    fn run(&mut self, _now: Time, _out: &mut Vec<u8>) -> HandshakeState {
        panic!("a session that panics, on purpose");
    }
}

#[test]
fn the_loop_sees_that_the_link_thread_has_ended_and_keeps_what_is_open() {
    let listener = listener(address(23, 12));
    let os = Os::default();
    let (healthy, acyclic, _) = session(&os, address(23, 10));
    let mut open = os.streams(vec![patient(address(23, 12), silent())]).unwrap();
    let mut drive = accept(&listener);
    opened(&mut *open);
    let sick = os.streams(vec![patient(address(23, 11), Panicking)]).unwrap();
    assert!(!healthy.has_ended() && !sick.has_ended() && !open.has_ended());
    sick.waker().unwrap().wake();
    until("the end of the thread", || healthy.has_ended() && sick.has_ended() && open.has_ended());
    until("its calls end", || acyclic.run(&[call(1)], LONG).failed == Some(CallError::Gone));
    // A connection that the loop has is its own.
    assert_eq!(open.send(0, b"stop").unwrap().1, 4);
    expect(&mut drive, b"stop");
}

#[test]
fn a_connection_leaves_from_the_address_that_it_is_bound_to() {
    let listener = listener(address(25, 10));
    let own = |host| *address(25, host).ip();
    let bound = |host| StreamPeer { bind: Some(own(host)), ..patient(address(25, 10), silent()) };
    let mut streams = Os::default().streams(vec![bound(1), bound(2)]).unwrap();
    let mut from: Vec<_> = (0..2).map(|_| accept(&listener).peer_addr().unwrap().ip()).collect();
    from.sort();
    assert_eq!(from, [own(1), own(2)]);
    // TEST-NET-1 (RFC 5737): no host has it.
    let nowhere = StreamPeer { bind: Some([192, 0, 2, 1].into()), ..patient(address(25, 10), silent()) };
    let streams_of_none = Os::default().streams(vec![nowhere]).unwrap();
    let notes = streams_of_none.notes();
    until("noted", || notes.get(0).is_some());
    let note = notes.get(0).unwrap();
    let why = "from 192.0.2.1: this host has no such address";
    assert!(note.contains(why) && note.contains("bind"), "{note}");
    opened(&mut *streams);
}
