//! What this host takes to hand over a request and to take in its reply: over its loopback, by the system calls of the
//! loop, and for the driver of an interface by frames to itself.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use super::setting::Setting;
use super::slice::within;
use fieldbeat_core::bus::load::Medium;
use fieldbeat_core::cycle::cost::{Costs, Exchange};
use fieldbeat_core::net::frames::Frames;
use fieldbeat_core::net::packet::Packet;
use fieldbeat_core::net::udp::Udp;
use fieldbeat_core::net::{Datagrams, Outbox, UdpOptions};
use fieldbeat_core::rt::thread::helper_thread;
use fieldbeat_core::rt::{Clock, MonotonicClock, RealtimeError};
use fieldbeat_core::time::Time;

/// Exchanges of a round: one batch of the carrier, and as many as fit into the usual buffers.
const BATCH: usize = 64;
/// Rounds of which the median counts; the first ones warm the caches.
const ROUNDS: usize = 61;
/// Bytes of a request and of a reply.
const BYTES: usize = 40;
/// Local Experimental Ethertype 1 (IEEE 802): no device acts by it.
const EXPERIMENTAL: u16 = 0x88B5;
/// The shortest frame.
const FRAME: usize = 60;
/// Until then a batch was answered, on a host that is not busy; on any other one it is waited for so long.
const SETTLED: Duration = Duration::from_micros(500);
const PATIENCE: Duration = Duration::from_secs(1);

/// The costs of the exchanges of each medium, and of the drivers of these interfaces. One that cannot be measured here
/// stays as stated; why, a line each.
///
/// # Errors
///
/// The core cannot be had.
pub(super) fn costs(setting: &Setting, interfaces: &[String]) -> Result<(Costs, Vec<String>), RealtimeError> {
    within(setting, || {
        let (mut costs, mut left_out) = (Costs { measured: true, ..Costs::default() }, Vec::new());
        let measured = [
            (Medium::Datagrams, "datagrams", datagrams(setting.core)),
            (Medium::Streams, "connections", messages()),
            (Medium::Frames, "frames", frames()),
        ];
        for (medium, what, measured) in measured {
            match measured {
                Ok(cost) => costs.exchanges[medium as usize] = cost,
                Err(error) => left_out.push(format!("{what}: {error}")),
            }
        }
        for interface in interfaces {
            match driver(interface) {
                Ok(ns) => costs.drivers.push((interface.clone(), ns)),
                Err(error) => left_out.push(format!("the driver of {interface}: {error}")),
            }
        }
        (costs, left_out)
    })
}

/// The median of the rounds, for each exchange of one.
fn median(mut round: impl FnMut() -> io::Result<[u64; 2]>) -> io::Result<Exchange> {
    let (mut sent, mut received) = (Vec::with_capacity(ROUNDS), Vec::with_capacity(ROUNDS));
    for _ in 0..ROUNDS {
        let [send_ns, receive_ns] = round()?;
        sent.push(send_ns / BATCH as u64);
        received.push(receive_ns / BATCH as u64);
    }
    let of = |values: &mut Vec<u64>| {
        values.sort_unstable();
        values[ROUNDS / 2]
    };
    Ok(Exchange { send_ns: of(&mut sent), receive_ns: of(&mut received) })
}

fn now() -> Time {
    MonotonicClock.now()
}

/// A thread on another core answers, as drives would that are simulated there: each datagram may have to wake it.
fn datagrams(core: usize) -> io::Result<Exchange> {
    let options = UdpOptions { peers: BATCH, waiting: 0, room: 128, dscp: 0, groups: 0 };
    let mut ours = Udp::bind(SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0), &options)?;
    let theirs = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
    let SocketAddr::V4(peer) = theirs.local_addr()? else { return Err(ErrorKind::Unsupported.into()) };
    let mut requests = Outbox::new(&[peer; BATCH], 128);
    let ended = AtomicBool::new(false);
    thread::scope(|scope| {
        theirs.set_read_timeout(Some(PATIENCE))?;
        scope.spawn(|| {
            helper_thread(Some(core));
            let mut room = [0; 128];
            while !ended.load(Ordering::Relaxed) {
                if let Ok((length, from)) = theirs.recv_from(&mut room) {
                    let _ = theirs.send_to(&room[..length], from);
                }
            }
        });
        let cost = median(|| {
            for index in 0..BATCH {
                requests.set_length(index, BYTES);
                requests.post(index, true);
            }
            let begun = now();
            ours.send(&mut requests);
            let send_ns = now().since(begun);
            thread::sleep(SETTLED);
            Ok([send_ns, take_in(&mut ours)?])
        });
        ended.store(true, Ordering::Relaxed);
        cost
    })
}

/// Takes a batch in, which is there; what comes later costs nothing until then.
fn take_in(socket: &mut Udp) -> io::Result<u64> {
    let (mut taken, mut ns) = (0, 0);
    let begun = now();
    while taken < BATCH {
        let before = now();
        match socket.receive(&mut |_| ())? {
            0 if before.since(begun) > PATIENCE.as_nanos() as u64 => return Err(ErrorKind::TimedOut.into()),
            0 => thread::sleep(SETTLED),
            count => {
                taken += count;
                ns += now().since(before);
            }
        }
    }
    Ok(ns)
}

/// Each is a write and a read.
fn messages() -> io::Result<Exchange> {
    let listener = TcpListener::bind(SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0))?;
    let mut ours = TcpStream::connect(listener.local_addr()?)?;
    let (mut theirs, _) = listener.accept()?;
    ours.set_nodelay(true)?;
    theirs.set_nodelay(true)?;
    let mut bytes = [0; BYTES];
    median(|| {
        let [mut send_ns, mut receive_ns] = [0; 2];
        for _ in 0..BATCH {
            let begun = now();
            ours.write_all(&bytes)?;
            send_ns += now().since(begun);
            theirs.read_exact(&mut bytes)?;
            theirs.write_all(&bytes)?;
            let begun = now();
            ours.read_exact(&mut bytes)?;
            receive_ns += now().since(begun);
        }
        Ok([send_ns, receive_ns])
    })
}

fn frames() -> io::Result<Exchange> {
    let mut socket = Packet::open("lo", EXPERIMENTAL)?;
    median(|| {
        let [mut send_ns, mut receive_ns] = [0; 2];
        for _ in 0..BATCH {
            send_ns += put(&mut socket)?;
            let begun = now();
            socket.receive(&mut [0; 128]).ok_or(ErrorKind::UnexpectedEof)?;
            receive_ns += now().since(begun);
        }
        Ok([send_ns, receive_ns])
    })
}

/// Sends a frame to the interface itself.
fn put(socket: &mut Packet) -> io::Result<u64> {
    let mut frame = [0; FRAME];
    let mac = socket.mac();
    frame[..6].copy_from_slice(&mac);
    frame[6..12].copy_from_slice(&mac);
    frame[12..14].copy_from_slice(&EXPERIMENTAL.to_be_bytes());
    let begun = now();
    socket.send(&frame).map_err(|_| ErrorKind::NetworkDown)?;
    Ok(now().since(begun))
}

/// The driver's part of a frame: a switch does not send it back to where it came from.
fn driver(interface: &str) -> io::Result<u64> {
    let mut socket = Packet::open(interface, EXPERIMENTAL)?;
    let cost = median(|| {
        let mut send_ns = 0;
        for _ in 0..BATCH {
            send_ns += put(&mut socket)?;
        }
        while socket.receive(&mut [0; 128]).is_some() {}
        Ok([send_ns, 0])
    })?;
    Ok(cost.send_ns)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_medium_that_needs_no_right_is_measured_on_the_loopback() {
        let setting = Setting {
            core: *fieldbeat_core::rt::thread::permitted_cores().first().unwrap(),
            fifo: None,
            guarded: false,
            locked: false,
            awake: false,
        };
        let (costs, left_out) = costs(&setting, &["no-such-one".to_owned()]).unwrap();
        for medium in [Medium::Datagrams, Medium::Streams] {
            let Exchange { send_ns, receive_ns } = costs.exchanges[medium as usize];
            assert!(send_ns > 0 && receive_ns > 0, "{medium:?}: {costs:?}, {left_out:?}");
        }
        // An interface that is not there has no driver, and says so.
        assert!(
            costs.drivers.is_empty() && left_out.last().unwrap().starts_with("the driver of no-such-one: ")
        );
    }
}
