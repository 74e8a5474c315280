//! Lists the devices of a network by ListIdentity, on a normal thread. It changes nothing in them.
//!
//! An address that does not answer by UDP, which a firewall may hold back, is asked by TCP, without a session.
//!
//! A device waits at random before it answers a broadcast, up to the time that the context of the request says
//! (EtherNet/IP, volume 2). The rest of the context is ours: an answer with another one was not requested here.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use thiserror::Error;

use crate::plan::PORT;
use crate::wire::encapsulation::{self, Frame, Identity, Listed, Status, command};

/// A device waits so long at most before it answers a broadcast, ms ...
const MOST_WAIT_MS: u16 = 2_000;
/// ... and its answer is here by then.
const PATIENCE: Duration = Duration::from_millis(MOST_WAIT_MS as u64 + 500);
/// A datagram can be lost: who has not answered is asked again after so long.
const AGAIN: Duration = Duration::from_millis(500);
/// How long one look for answers takes.
const LOOK: Duration = Duration::from_millis(50);
/// For a connection, and then for an answer on it.
const TCP_PATIENCE: Duration = Duration::from_millis(1_000);
/// The most devices that are listed: what sends more is a flood.
const MOST: usize = 4_096;
/// Longer than any answer.
const ROOM: usize = 1_024;

/// A device that has answered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Device {
    /// Where its answer came from.
    pub(super) from: SocketAddrV4,
    /// Where it says that it is.
    pub(super) claims: SocketAddrV4,
    /// Who it is.
    pub(super) identity: Identity,
    /// Its state.
    pub(super) state: u8,
}

/// Why devices could not be listed.
#[derive(Error)]
pub(super) enum ScanError {
    /// The address is not this computer's.
    #[error("cannot ask from {}: {}; ip address shows the addresses of this computer", .0.0, .0.1)]
    Bind(Box<(Ipv4Addr, io::Error)>),
    /// Nothing leaves.
    #[error("cannot ask {}: {}; look at the network, or name the address to ask from: --bind", .0.0, .0.1)]
    Send(Box<(SocketAddrV4, io::Error)>),
    /// Nothing comes.
    #[error("cannot receive answers: {0}")]
    Receive(io::Error),
    /// Nobody answers.
    #[error("no device answers; check power, cable and address, or name the address to ask from: --bind")]
    Silent,
    /// Its end was requested.
    #[error("interrupted")]
    Interrupted,
}
fieldbeat_core::debug_as_display!(ScanError);

/// The devices at these addresses that answer, without any all by a broadcast; by their addresses, each once. `goes_on`
/// can end it early.
pub(super) fn scan(
    from: Ipv4Addr,
    targets: &[SocketAddrV4],
    goes_on: &dyn Fn() -> bool,
) -> Result<Vec<Device>, ScanError> {
    let socket = open(from).map_err(|error| ScanError::Bind(Box::new((from, error))))?;
    let everybody = [SocketAddrV4::new(Ipv4Addr::BROADCAST, PORT)];
    let targets = if targets.is_empty() { &everybody } else { targets };
    // The lowest 16 bits are the time that a device may wait.
    let context = u64::from(std::process::id()) << 32 | 0x4642 << 16 | u64::from(MOST_WAIT_MS);
    let mut request = Vec::new();
    encapsulation::list_identity(&mut request, context);
    let mut devices: Vec<Device> = Vec::new();
    let (mut begun, mut asked) = (Instant::now(), 0);
    let mut buffer = [0; ROOM];
    while goes_on() {
        let answered = |target: &&SocketAddrV4| devices.iter().any(|device| device.from == **target);
        let mut silent = targets.iter().filter(|target| !answered(target)).peekable();
        if silent.peek().is_none() || asked == 2 && begun.elapsed() >= PATIENCE {
            let by_tcp =
                silent.take_while(|_| goes_on()).filter_map(|target| answered_by_tcp(*target, &request));
            let more: Vec<Device> = by_tcp.collect();
            more.into_iter().for_each(|device| devices.extend(is_new(&device, &devices).then_some(device)));
            return if goes_on() { finish(devices) } else { Err(ScanError::Interrupted) };
        }
        if asked == 0 || asked == 1 && begun.elapsed() >= AGAIN {
            for target in silent {
                let sent = socket.send_to(&request, target);
                sent.map_err(|error| ScanError::Send(Box::new((*target, error))))?;
            }
            // The patience counts from the second request.
            (begun, asked) = (Instant::now(), asked + 1);
        }
        match socket.recv_from(&mut buffer) {
            Ok((size, SocketAddr::V4(from))) => {
                let frame = buffer.get(..size).and_then(Frame::datagram);
                let device = frame.and_then(|frame| answer(&frame, from, context));
                devices.extend(device.filter(|device| devices.len() < MOST && is_new(device, &devices)));
            }
            Ok(_) => {}
            // A host without the port says so (ECONNREFUSED): the others may answer all the same.
            Err(error) if is_no_answer(&error) => {}
            Err(error) => return Err(ScanError::Receive(error)),
        }
    }
    Err(ScanError::Interrupted)
}

fn open(from: Ipv4Addr) -> io::Result<UdpSocket> {
    let socket = UdpSocket::bind((from, 0))?;
    socket.set_broadcast(true)?;
    socket.set_read_timeout(Some(LOOK))?;
    Ok(socket)
}

fn is_no_answer(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::WouldBlock
            | ErrorKind::TimedOut
            | ErrorKind::Interrupted
            | ErrorKind::ConnectionRefused
            | ErrorKind::HostUnreachable
    )
}

/// The device at this address, by a connection. The routes of this computer decide where that leaves.
fn answered_by_tcp(target: SocketAddrV4, request: &[u8]) -> Option<Device> {
    let mut stream = TcpStream::connect_timeout(&target.into(), TCP_PATIENCE).ok()?;
    stream.set_read_timeout(Some(TCP_PATIENCE)).ok()?;
    stream.write_all(request).ok()?;
    let context = Frame::datagram(request)?.header.context;
    let (mut buffer, mut filled) = ([0; ROOM], 0);
    loop {
        match stream.read(buffer.get_mut(filled..)?).ok()? {
            0 => return None,
            count => filled += count,
        }
        if let Some((frame, _)) = Frame::next(buffer.get(..filled)?).ok()? {
            return answer(&frame, target, context);
        }
    }
}

/// The device that an answer names; `None` if it is none to our request.
fn answer(frame: &Frame<'_>, from: SocketAddrV4, context: u64) -> Option<Device> {
    let header = frame.header;
    if (header.command, header.status, header.context) != (command::LIST_IDENTITY, Status::OK, context) {
        return None;
    }
    let Listed { address: claims, identity, state } = Listed::parse(frame.data)?;
    Some(Device { from, claims, identity, state })
}

/// A vendor gives each number once; a device without one is known by its address.
fn is_new(device: &Device, known: &[Device]) -> bool {
    let same = |other: &Device| match device.identity.serial {
        0 => other.identity.serial == 0 && other.from == device.from,
        serial => (other.identity.vendor, other.identity.serial) == (device.identity.vendor, serial),
    };
    !known.iter().any(same)
}

fn finish(mut devices: Vec<Device>) -> Result<Vec<Device>, ScanError> {
    if devices.is_empty() {
        return Err(ScanError::Silent);
    }
    devices.sort_by_key(|device| device.from);
    Ok(devices)
}

/// A drive that has answered.
#[cfg(test)]
pub(super) fn specimen() -> Device {
    tests::device(0xC0FFEE, tests::FROM)
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;
    use crate::wire::cpf::{self, item};
    use crate::wire::encapsulation::Header;

    pub(super) const FROM: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(192, 168, 1, 40), PORT);

    /// The answer of a device with this serial number.
    fn answered(context: u64, serial: u32) -> Vec<u8> {
        let mut identity = vec![1, 0];
        identity.extend(cpf::socket_address(FROM));
        identity.extend([60, 0, 43, 0, 176, 0, 251, 3, 0x60, 0]);
        identity.extend(serial.to_le_bytes());
        identity.extend(b"\x08STF05-IP\x03");
        let mut out = Vec::new();
        let header = Header { command: command::LIST_IDENTITY, context, ..Header::default() };
        encapsulation::frame(&mut out, header, |out| {
            out.extend([1, 0]);
            cpf::put(out, item::IDENTITY, &identity);
        });
        out
    }

    /// One with this serial number that has answered from there.
    pub(super) fn device(serial: u32, from: SocketAddrV4) -> Device {
        answer(&Frame::datagram(&answered(7, serial)).unwrap(), from, 7).unwrap()
    }

    #[test]
    fn a_device_is_listed_once_by_its_vendor_and_serial_number() {
        let elsewhere = SocketAddrV4::new([192, 168, 2, 40].into(), PORT);
        let known = [device(5, FROM), device(0, FROM)];
        assert!(!is_new(&device(5, elsewhere), &known));
        assert!(is_new(&device(6, FROM), &known));
        assert!(!is_new(&device(0, FROM), &known));
        assert!(is_new(&device(0, elsewhere), &known));
        let both = finish(vec![device(6, elsewhere), device(5, FROM)]).unwrap();
        assert_eq!(both[0].from, FROM);
    }

    /// A firewall holds its datagrams back. The answer comes in pieces.
    #[test]
    fn a_device_without_udp_answer_is_requested_by_tcp() {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let SocketAddr::V4(target) = listener.local_addr().unwrap() else { unreachable!("bound to IPv4") };
        let _mute = UdpSocket::bind(target).unwrap();
        let devices = std::thread::scope(|scope| {
            scope.spawn(|| {
                let (mut stream, _) = listener.accept().unwrap();
                let mut buffer = [0; 24];
                stream.read_exact(&mut buffer).unwrap();
                let request = Frame::datagram(&buffer).unwrap().header;
                assert_eq!((request.command, request.session), (command::LIST_IDENTITY, 0));
                for part in answered(request.context, 7).chunks(40) {
                    stream.write_all(part).unwrap();
                }
            });
            scan(Ipv4Addr::LOCALHOST, &[target], &|| true)
        });
        let found: Vec<_> =
            devices.unwrap().iter().map(|device| (device.from, device.identity.serial)).collect();
        assert_eq!(found, [(target, 7)]);
    }

    /// Each is asked by its own address; the second one answers twice, and somebody else unasked.
    #[test]
    fn devices_on_this_host_answer_with_the_context_of_the_request() {
        let sockets = [1, 2].map(|_| UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap());
        let targets = [0, 1].map(|index: usize| match sockets[index].local_addr().unwrap() {
            SocketAddr::V4(address) => address,
            SocketAddr::V6(_) => unreachable!("bound to IPv4"),
        });
        let devices = std::thread::scope(|scope| {
            for (index, socket) in sockets.iter().enumerate() {
                scope.spawn(move || {
                    let mut buffer = [0; ROOM];
                    let (size, asker) = socket.recv_from(&mut buffer).unwrap();
                    let request = Frame::datagram(&buffer[..size]).unwrap().header;
                    assert_eq!(request.context & 0xFFFF, u64::from(MOST_WAIT_MS));
                    socket.send_to(&answered(!request.context, 99), asker).unwrap();
                    for _ in 0..=index {
                        socket.send_to(&answered(request.context, 10 + index as u32), asker).unwrap();
                    }
                });
            }
            scan(Ipv4Addr::LOCALHOST, &targets, &|| true)
        });
        let mut serials: Vec<u32> = devices.unwrap().iter().map(|device| device.identity.serial).collect();
        serials.sort_unstable();
        assert_eq!(serials, [10, 11]);
    }
}
