//! A port against a pseudo-terminal: every byte as it comes, nothing waits, and what goes away comes back.

use std::io::{Read, Write};

use super::*;
use crate::net::link::tests::{breaks, opened, receive, wakes};
use crate::net::{Carriers, Os};
use crate::rt::MonotonicClock;
use fieldbeat_testing::{Pty, until};

const LINE: SerialLine = SerialLine { rate: 1_500_000, parity: Parity::Even, rs485: Rs485::Adapter };

fn open(path: &str) -> Box<dyn Serial> {
    let mut port = Os::default().serial(path, &LINE).unwrap();
    opened(&mut *port);
    port
}

#[test]
fn a_byte_takes_its_bits() {
    let line = |rate, parity| SerialLine { rate, parity, ..LINE };
    assert_eq!(line(9_600, Parity::None).span_ns(1), 1_041_667);
    // The sheet of PROFIBUS: 11 bits of 2 µs, and of 2/3 µs.
    assert_eq!(line(500_000, Parity::Even).span_ns(1), 22_000);
    assert_eq!(line(1_500_000, Parity::Even).span_ns(1), 7_334);
    assert_eq!(line(1_500_000, Parity::Even).span_ns(3), 22_000);
    assert_eq!(line(500_000, Parity::Even).bits_ns(33), 66_000);
    // 83.3 ns a bit: rounded once, for all of them together.
    let fastest = line(12_000_000, Parity::Even);
    assert_eq!((fastest.bits_ns(1), fastest.bits_ns(33), fastest.span_ns(1)), (84, 2_750, 917));
    assert_eq!((fastest.span_ns(12), fastest.span_ns(249 + 6)), (11_000, 233_750));
    assert_eq!((line(0, Parity::Even).span_ns(0), line(1, Parity::None).span_ns(usize::MAX)), (0, u64::MAX));
}

#[test]
fn every_byte_passes_as_it_is_and_wakes_the_waiting() {
    let mut pty = Pty::new();
    let mut port = open(&pty.path);
    let all: Vec<u8> = (0..=255).collect();
    let before = MonotonicClock::read();
    let (at, count) = port.send(0, &all).unwrap();
    assert!(before <= at && at <= MonotonicClock::read() && count == 256);
    pty.expect(&all);
    assert_eq!(port.receive(0, &mut [0; 8]), Ok(None));
    pty.end.write_all(&all).unwrap();
    assert!(wakes(port.fd(), 60 * S));
    assert_eq!(receive(&mut *port, 0, 256), all);
    assert_eq!(port.receive(0, &mut []), Ok(None));
    until("all sent", || port.unsent() == Ok(0));
    // What is discarded is never received.
    pty.end.write_all(b"old").unwrap();
    assert!(wakes(port.fd(), 60 * S));
    port.discard().unwrap();
    pty.end.write_all(b"new").unwrap();
    assert_eq!(receive(&mut *port, 0, 3), b"new");
}

#[test]
fn a_port_has_the_settings_of_its_wire() {
    let pty = Pty::new();
    let port = open(&pty.path);
    let settings = pty.settings();
    assert_eq!((settings.c_ispeed, settings.c_ospeed), (1_500_000, 1_500_000));
    assert_eq!((settings.c_lflag, settings.c_oflag), (0, 0));
    assert_eq!(settings.c_iflag, libc::IGNBRK | libc::INPCK);
    assert_eq!((settings.c_cc[libc::VMIN], settings.c_cc[libc::VTIME]), (1, 0));
    assert_eq!(settings.c_cflag & (libc::CSIZE | libc::CSTOPB | libc::CRTSCTS), libc::CS8);
    let fd = port.fd().unwrap();
    // SAFETY: plain numbers.
    let flags = unsafe { (libc::fcntl(fd, libc::F_GETFL), libc::fcntl(fd, libc::F_GETFD)) };
    assert!(flags.0 & libc::O_NONBLOCK != 0 && flags.1 & libc::FD_CLOEXEC != 0);
    drop(port);
    // One that no standard has.
    let mut odd =
        Os::default().serial(&pty.path, &SerialLine { rate: 123_457, parity: Parity::None, ..LINE }).unwrap();
    opened(&mut *odd);
    assert_eq!((pty.settings().c_ospeed, pty.settings().c_iflag), (123_457, libc::IGNBRK));
}

#[test]
fn bytes_refused_by_the_driver_are_counted_and_sent_later_in_order() {
    let mut pty = Pty::new();
    let mut port = open(&pty.path);
    let bytes: Vec<u8> = (0..200_000_u32).map(|n| (n % 251) as u8).collect();
    let (mut sent, mut refused) = (0, 0);
    let mut got = vec![0; bytes.len()];
    let mut place = 0;
    while sent < bytes.len() {
        match port.send(0, &bytes[sent..]).unwrap() {
            (_, 0) => {
                refused += 1;
                place += pty.end.read(&mut got[place..]).unwrap();
            }
            (_, count) => sent += count,
        }
    }
    pty.end.read_exact(&mut got[place..]).unwrap();
    assert!(got == bytes && refused > 0, "{refused}");
}

#[test]
fn a_port_in_use_is_said_to_be_and_is_opened_once_it_is_free() {
    let pty = Pty::new();
    let first = open(&pty.path);
    let mut second = Os::default().serial(&pty.path, &LINE).unwrap();
    let notes = second.notes();
    until("noted", || notes.get(0).is_some());
    let note = format!("{0} is in use by another program: end it (fuser -v {0} shows which)", pty.path);
    assert_eq!(notes.get(0), Some(note));
    let absent = Broken::Absent;
    assert_eq!((second.opened(), second.receive(0, &mut [0; 4])), (None, Err(absent)));
    assert_eq!((second.send(0, b"x"), second.unsent()), (Err(absent), Err(absent)));
    assert_eq!(second.discard(), Err(absent));
    second.abandon(0, "it was never there");
    drop(first);
    opened(&mut *second);
    assert_eq!(notes.get(0), None);
}

#[test]
fn an_adapter_that_is_unplugged_breaks_its_port_and_is_opened_again_when_it_is_back() {
    let directory = tempfile::tempdir().unwrap();
    let link = directory.path().join("tty");
    let mut port = Os::default().serial(link.to_str().unwrap(), &LINE).unwrap();
    let notes = port.notes();
    until("noted", || notes.get(0).is_some());
    assert!(notes.get(0).unwrap().contains("there is no serial port"), "{:?}", notes.get(0));
    for round in 0..5 {
        let mut pty = Pty::new().at(&link);
        opened(&mut *port);
        assert_eq!(port.receive(0, &mut [0; 8]), Ok(None), "round {round}: nothing of the old one is left");
        port.send(0, b"request").unwrap();
        pty.expect(b"request");
        pty.end.write_all(b"old").unwrap();
        // Unplugged before the answer is taken in, or after.
        if round % 2 == 0 {
            assert_eq!(receive(&mut *port, 0, 3), b"old");
        }
        drop(pty);
        assert!(wakes(port.fd(), 60 * S), "a hang-up wakes");
        let why = breaks(&mut *port, 0);
        assert!(matches!(why, Broken::Closed | Broken::Failed(libc::EIO)), "{why:?}");
        assert!(matches!(port.send(0, b"x"), Err(Broken::Failed(libc::EIO))));
        port.abandon(0, "it is unplugged");
        assert_eq!((port.fd(), port.receive(0, &mut [0; 8])), (None, Err(Broken::Absent)));
    }
}
