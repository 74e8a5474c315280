//! The link thread against real peers that are well, slow, mute, hostile or dead.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddrV4, TcpListener, TcpStream};
use std::os::fd::{AsRawFd, OwnedFd, RawFd};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use fieldbeat_testing::until;
use nix::sched::{CpuSet, sched_getaffinity};
use nix::sys::socket::{
    AddressFamily, Backlog, SockFlag, SockType, SockaddrIn, bind, listen, setsockopt, socket, sockopt,
};
use nix::unistd::Pid;

use crate::net::{Broken, Carriers, Handshake, HandshakeState, Os, StreamPeer, Streams};
use crate::rt::testing::in_own_process;
use crate::rt::thread::default_core;
use crate::rt::{Clock, MonotonicClock, PollSet};
use crate::time::{MS, S, Time};

/// Longer than anything takes; only a test that fails waits for so long.
const LONG: Duration = Duration::from_secs(60);

/// The tests of this file own 127.74.x.0/24, one x each.
fn address(x: u8, host: u8) -> SocketAddrV4 {
    SocketAddrV4::new([127, 74, x, host].into(), 1502)
}

/// Says something, wants to hear something, and then says `bye`; with nothing to hear it is complete at once.
#[derive(Debug)]
pub(in crate::net) struct Hello {
    say: &'static [u8],
    hear: &'static [u8],
    got: Vec<u8>,
}

impl Hello {
    pub(in crate::net) fn new(say: &'static [u8], hear: &'static [u8]) -> Hello {
        Hello { say, hear, got: Vec::new() }
    }

    fn welcome() -> Hello {
        Hello::new(b"hello", b"welcome")
    }
}

impl Handshake for Hello {
    fn begin(&mut self, _now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.got.clear();
        out.extend_from_slice(self.say);
        if self.hear.is_empty() { HandshakeState::Done } else { HandshakeState::More }
    }

    fn take(&mut self, _now: Time, bytes: &[u8], out: &mut Vec<u8>) -> HandshakeState {
        self.got.extend_from_slice(bytes);
        if !self.hear.starts_with(&self.got) {
            return HandshakeState::Failed("speaks another language".into());
        }
        if self.got.len() < self.hear.len() {
            return HandshakeState::More;
        }
        out.extend_from_slice(b"bye");
        HandshakeState::Done
    }
}

/// Says nothing.
pub(in crate::net) fn silent() -> Hello {
    Hello::new(b"", b"")
}

/// A peer with long limits and short pauses.
pub(in crate::net) fn patient(address: SocketAddrV4, handshake: impl Handshake + 'static) -> StreamPeer {
    StreamPeer {
        connect_ns: 600 * S,
        handshake_ns: 600 * S,
        least_pause_ns: MS,
        most_pause_ns: 5 * MS,
        ..StreamPeer::new(address, Box::new(handshake))
    }
}

/// The next connection that is handed over.
pub(in crate::net) fn opened(streams: &mut dyn Streams) -> usize {
    let mut index = None;
    until("handed over", || {
        index = streams.opened();
        index.is_some()
    });
    index.unwrap()
}

pub(in crate::net) fn listener(address: SocketAddrV4) -> TcpListener {
    let listener = TcpListener::bind(address).unwrap();
    listener.set_nonblocking(true).unwrap();
    listener
}

pub(in crate::net) fn accept(listener: &TcpListener) -> TcpStream {
    let mut accepted = None;
    until("accepted", || {
        accepted = listener.accept().ok();
        accepted.is_some()
    });
    let (stream, _) = accepted.unwrap();
    stream.set_nonblocking(false).unwrap();
    stream.set_read_timeout(Some(LONG)).unwrap();
    stream.set_nodelay(true).unwrap();
    stream
}

/// Reads just these bytes.
pub(in crate::net) fn expect(stream: &mut TcpStream, bytes: &[u8]) {
    let mut got = vec![0; bytes.len()];
    stream.read_exact(&mut got).unwrap();
    assert_eq!(got, bytes);
}

/// Takes in so many bytes from the connection `index`, by looks.
pub fn receive(streams: &mut dyn Streams, index: usize, count: usize) -> Vec<u8> {
    let mut got = Vec::new();
    until("received", || {
        streams.look();
        while let Some(ready) = streams.ready() {
            assert_eq!(ready, index);
            let mut room = [0; 64];
            if let Some((_, length)) = streams.receive(index, &mut room).unwrap() {
                got.extend_from_slice(&room[..length]);
            }
        }
        got.len() >= count
    });
    got
}

/// Whether the descriptor becomes readable within `ns`.
pub(in crate::net) fn wakes(fd: Option<RawFd>, ns: u64) -> bool {
    let mut set = PollSet::default();
    set.fill([fd]);
    MonotonicClock.wait(&mut set, MonotonicClock::read() + ns)
}

/// Looks until the connection `index` has something to tell, and it is that it broke.
pub fn breaks(streams: &mut dyn Streams, index: usize) -> Broken {
    let mut broken = None;
    until("broken", || {
        streams.look();
        while let Some(ready) = streams.ready() {
            assert_eq!(ready, index);
            broken = broken.or(streams.receive(index, &mut [0; 64]).err());
        }
        broken.is_some()
    });
    broken.unwrap()
}

/// Ends a connection with a reset.
pub(in crate::net) fn reset(stream: TcpStream) {
    setsockopt(&stream, sockopt::Linger, &libc::linger { l_onoff: 1, l_linger: 0 }).unwrap();
}

/// Listens, and has no room for any connection: the kernel drops requests for one.
struct BlackHole {
    _listener: OwnedFd,
    _only: TcpStream,
}

impl BlackHole {
    fn new(address: SocketAddrV4) -> BlackHole {
        let listener = socket(AddressFamily::Inet, SockType::Stream, SockFlag::SOCK_CLOEXEC, None).unwrap();
        bind(listener.as_raw_fd(), &SockaddrIn::from(address)).unwrap();
        listen(&listener, Backlog::new(0).unwrap()).unwrap();
        BlackHole { _listener: listener, _only: TcpStream::connect(address).unwrap() }
    }
}

#[test]
fn thirty_two_dead_peers_do_not_hold_up_the_next_one() {
    // 16 do not answer at all, 16 take the connection and never answer the handshake. Each has 600 s, so that the last
    // peer is only served within the time of this test if nobody waits for them.
    let holes: Vec<_> = (0..16).map(|host| BlackHole::new(address(2, 10 + host))).collect();
    let mutes: Vec<_> = (16..32).map(|host| listener(address(2, 10 + host))).collect();
    let well = listener(address(2, 99));
    let hosts = (0..32).map(|host| 10 + host).chain([99]);
    let peers = hosts.map(|host| patient(address(2, host), Hello::welcome())).collect();
    let mut streams = Os::default().streams(peers).unwrap();
    let mute: Vec<_> = mutes.iter().map(accept).collect();
    for round in 0..3 {
        let mut drive = accept(&well);
        expect(&mut drive, b"hello");
        drive.write_all(b"welcome").unwrap();
        expect(&mut drive, b"bye");
        assert_eq!(opened(&mut *streams), 32, "round {round}");
        streams.abandon(32, "again");
    }
    // None of the others has come to an end, nor come again.
    assert!((0..32).all(|index| streams.notes().get(index).is_none()));
    assert!(mutes.iter().all(|mute| mute.accept().unwrap_err().kind() == ErrorKind::WouldBlock));
    assert_eq!(streams.opened(), None);
    drop((streams, holes, mute));
}

#[test]
fn a_silent_peer_is_given_up_and_tried_again() {
    let mute = listener(address(3, 10));
    let _hole = BlackHole::new(address(3, 11));
    let short = |host| StreamPeer {
        connect_ns: 30 * MS,
        handshake_ns: 30 * MS,
        ..patient(address(3, host), Hello::welcome())
    };
    let streams = Os::default().streams(vec![short(10), short(11)]).unwrap();
    for _ in 0..3 {
        let mut taken = accept(&mute);
        expect(&mut taken, b"hello");
        // Given up by a reset: nothing of it is delivered any more.
        assert_eq!(taken.read(&mut [0; 8]).unwrap_err().kind(), ErrorKind::ConnectionReset);
    }
    let notes = streams.notes();
    let reported = |index, words: &str| notes.get(index).is_some_and(|note| note.starts_with(words));
    until("silence is noted", || {
        reported(0, "127.74.3.10:1502 accepts connections, but does not answer within 30 ms")
    });
    until("nobody is noted", || reported(1, "no answer from 127.74.3.11:1502 within 30 ms"));
}

#[test]
fn a_peer_that_refuses_or_resets_connections_is_tried_until_one_holds() {
    let mut streams = Os::default().streams(vec![patient(address(4, 10), Hello::welcome())]).unwrap();
    let notes = streams.notes();
    until("noted", || notes.get(0).is_some());
    assert!(notes.get(0).unwrap().starts_with("refused: nobody listens at 127.74.4.10:1502"));
    assert_eq!(streams.send(0, b"request"), Err(Broken::Absent));
    let listener = listener(address(4, 10));
    for _ in 0..4 {
        reset(accept(&listener));
        until("noted", || notes.get(0).is_some_and(|note| note.contains("ends the connection at once")));
    }
    // In the middle of a handshake, orderly.
    let mut drive = accept(&listener);
    drive.write_all(b"welc").unwrap();
    drop(drive);
    let mut drive = accept(&listener);
    drive.write_all(b"welcome").unwrap();
    assert_eq!((opened(&mut *streams), notes.get(0)), (0, None));
}

#[test]
fn a_peer_may_send_first_and_the_link_thread_does_not_spin() {
    in_own_process("net::link::tests::a_peer_may_send_first_and_the_link_thread_does_not_spin", || {
        let listener = listener(address(11, 10));
        let mut streams =
            Os::default().streams(vec![patient(address(11, 10), Hello::new(b"", b"ready to go\n"))]).unwrap();
        let mut drive = accept(&listener);
        let thread = &thread_directories()[0];
        // What it has run in user and kernel mode, in ticks of 10 ms (proc_pid_stat(5), fields 14 and 15).
        let ran = || {
            let stat = std::fs::read_to_string(thread.join("stat")).unwrap();
            let fields = stat.rsplit(')').next().unwrap().split_whitespace();
            fields.skip(11).take(2).map(|ticks| ticks.parse::<u64>().unwrap()).sum::<u64>()
        };
        let before = ran();
        std::thread::sleep(Duration::from_millis(400));
        assert!(ran() - before < 5, "{} ticks of 40", ran() - before);
        drive.write_all(b"ready").unwrap();
        drive.write_all(b" to go\n").unwrap();
        assert_eq!(opened(&mut *streams), 0);
    });
}

#[test]
fn a_connection_that_ends_comes_back_without_anything_of_the_old_one_and_is_dropped_in_order() {
    let listener = listener(address(7, 10));
    let mut streams = Os::default().streams(vec![patient(address(7, 10), silent())]).unwrap();
    for round in 0..3 {
        let mut drive = accept(&listener);
        assert_eq!(opened(&mut *streams), 0);
        assert_eq!(streams.receive(0, &mut [0; 8]), Ok(None), "round {round}");
        // Not taken in, and lost with its connection.
        drive.write_all(b"old").unwrap();
        let orderly = round % 2 == 0;
        if orderly {
            drop(drive);
            assert_eq!(breaks(&mut *streams, 0), Broken::Closed);
        } else {
            reset(drive);
            assert_eq!(breaks(&mut *streams, 0), Broken::Failed(libc::ECONNRESET));
        }
        streams.abandon(0, "it ended");
        assert_eq!(streams.receive(0, &mut [0; 8]), Err(Broken::Absent));
        // A second time is nothing.
        streams.abandon(0, "it ended");
    }
    // What is given up ends in a reset, and what is dropped in order.
    let mut drive = accept(&listener);
    opened(&mut *streams);
    streams.abandon(0, "it is silent");
    assert_eq!(drive.read(&mut [0; 8]).unwrap_err().kind(), ErrorKind::ConnectionReset);
    let mut drive = accept(&listener);
    opened(&mut *streams);
    streams.send(0, b"last words").unwrap();
    drop(streams);
    let mut said = Vec::new();
    drive.read_to_end(&mut said).unwrap();
    assert_eq!(said, b"last words");
}

/// The link threads of this process, as the kernel has them.
fn thread_directories() -> Vec<PathBuf> {
    let tasks = std::fs::read_dir("/proc/self/task").unwrap().map(|task| task.unwrap().path());
    let name = |task: &PathBuf| std::fs::read_to_string(task.join("comm")).unwrap_or_default();
    tasks.filter(|task| name(task).trim_end() == "fb-link").collect()
}

fn threads() -> usize {
    thread_directories().len()
}

#[test]
fn the_thread_keeps_off_the_core_of_the_loop() {
    in_own_process("net::link::tests::the_thread_keeps_off_the_core_of_the_loop", || {
        let allowed = |thread: i32| -> Vec<usize> {
            let set = sched_getaffinity(Pid::from_raw(thread)).unwrap();
            (0..CpuSet::count()).filter(|core| set.is_set(*core).unwrap()).collect()
        };
        let ours = allowed(0);
        let Some(core) = default_core().filter(|_| ours.len() > 1) else {
            return println!("skipped: there is one core only");
        };
        let streams = Os::off_core(Some(core)).streams(Vec::new()).unwrap();
        let others: Vec<_> = ours.into_iter().filter(|other| *other != core).collect();
        until("moved", || {
            let threads = thread_directories();
            threads.len() == 1
                && allowed(threads[0].file_name().unwrap().to_str().unwrap().parse().unwrap()) == others
        });
        drop(streams);
    });
}

pub(in crate::net) fn descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

#[test]
fn one_thread_serves_all_carriers_and_ends_with_the_last() {
    in_own_process("net::link::tests::one_thread_serves_all_carriers_and_ends_with_the_last", || {
        let os = Os::default();
        // Its carrier waits for its end; the kernel counts it for a moment more.
        let all_ended = || until("ended", || threads() == 0);
        for _ in 0..3 {
            all_ended();
            let mut both: Vec<_> = (10..12)
                .map(|host| {
                    let listener = listener(address(9, host));
                    (os.streams(vec![patient(address(9, host), silent())]).unwrap(), listener)
                })
                .collect();
            // A thread names itself when it runs.
            until("started", || threads() == 1);
            for (streams, listener) in &mut both {
                let _drive = accept(listener);
                opened(&mut **streams);
            }
            assert_eq!(threads(), 1);
            drop(both.remove(0));
            let (streams, listener) = &mut both[0];
            streams.abandon(0, "again");
            accept(listener);
            opened(&mut **streams);
            assert_eq!(threads(), 1);
            drop(both);
        }
        all_ended();
        // Nor does it need anybody to talk to.
        drop(os.streams(Vec::new()).unwrap());
        all_ended();
    });
}

#[test]
fn no_descriptor_is_left_behind() {
    in_own_process("net::link::tests::no_descriptor_is_left_behind", || {
        let before = descriptors();
        for round in 0..10 {
            // One is well, one refuses, one says the wrong thing, one is mute, one is a black hole.
            let (well, wrong, mute) =
                (listener(address(10, 10)), listener(address(10, 11)), listener(address(10, 12)));
            let hole = BlackHole::new(address(10, 13));
            let peers = vec![
                patient(address(10, 10), silent()),
                patient(address(10, 11), Hello::welcome()),
                patient(address(10, 12), Hello::welcome()),
                patient(address(10, 13), silent()),
                patient(address(10, 14), silent()),
            ];
            let mut streams = Os::default().streams(peers).unwrap();
            for _ in 0..10 {
                let _drive = accept(&well);
                assert_eq!(opened(&mut *streams), 0);
                streams.abandon(0, "again");
                accept(&wrong).write_all(b"what?").unwrap();
            }
            let _mute = accept(&mute);
            let notes = streams.notes();
            until("refused", || notes.get(4).is_some());
            // Dropped with one in the loop's hands, one on its way, or none.
            match round % 3 {
                0 => assert_eq!(opened(&mut *streams), 0),
                1 => drop(accept(&well)),
                _ => {}
            }
            drop((streams, hole));
        }
        assert_eq!(descriptors(), before);
    });
}

mod sessions;
