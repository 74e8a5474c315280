//! What a first configuration of Unidrives has, and how one is probed.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddrV4, TcpStream};
use std::thread::sleep;
use std::time::Duration;

use crate::parameter::{Addressing, Parameter, Width};
use crate::plan::{PORT, UnidriveDrive};
use crate::wire::{self, ADU_MAX, Header, Request, Response};
use fieldbeat_keys::outline::{ADDRESS, Answer, Found, Known, Line, Outline, Search, Unit, Usual, probed};
use fieldbeat_keys::value::duration;

/// The highest version of a firmware: aa.bb.cc.dd as digits.
const VERSION_MAX: i32 = 99_999_999;

/// For a connection.
const PATIENCE: Duration = Duration::from_millis(500);
/// For a reply: a drive answers from a background task. A longer `reply_within` counts in its place.
const REPLY: Duration = Duration::from_secs(2);
/// A drive that is busy gets its request again after so long, so many times.
const AGAIN: Duration = Duration::from_millis(100);
const MOST_BUSY: usize = 10;

pub(super) const OUTLINE: Outline = Outline {
    period: "10ms",
    bus: &[Line::ask(
        "bind",
        "Address of this computer on the network of the drives (none: any)",
        Usual::Optional,
    )],
    drive: &[ADDRESS],
    unit: Unit::REVOLUTION,
    behind: &[Line::ask(
        "watchdog.timeout",
        "The drive trips after so long without its master",
        Usual::Is("500ms"),
    )],
    search: Search {
        question: "Probe addresses one by one? Each gets one connection, and a read or three",
        usual: false,
        probes: true,
        run: probe,
        port: PORT,
    },
};

/// Reads the version of the firmware at each address, one after the other: the parameter that says what a drive is;
/// and of a drive its serial number.
fn probe(
    known: &Known<'_>,
    addresses: &[SocketAddrV4],
    goes_on: &dyn Fn() -> bool,
) -> Result<Vec<Found>, String> {
    let configured = (known.answer)("reply_within").and_then(|time| duration(&time));
    let reply = configured.map_or(REPLY, |ns| REPLY.max(Duration::from_nanos(ns)));
    Ok(probed(addresses, PORT, goes_on, |address| ask(address, reply)))
}

/// Who answers at an address, each time within `patience`, and the serial number of a drive.
fn ask(address: SocketAddrV4, patience: Duration) -> (Answer, Option<u64>) {
    let connected = TcpStream::connect_timeout(&address.into(), PATIENCE);
    let Ok(mut stream) =
        connected.and_then(|stream| stream.set_read_timeout(Some(patience)).map(|()| stream))
    else {
        return (Answer::None, None);
    };
    let answer = identify(&read(&mut stream, Parameter::FIRMWARE).unwrap_or_default());
    if !matches!(answer, Answer::Drive(_)) {
        return (answer, None);
    }
    let mut part = |parameter| {
        let reply = read(&mut stream, parameter).ok()?;
        match Response::parse(&reply) {
            Ok((HEADER, Response::Read { data })) => data.long(0).and_then(|part| u64::try_from(part).ok()),
            _ => None,
        }
    };
    let [low, high] = Parameter::SERIAL.map(&mut part);
    let serial = low.zip(high).map(|(low, high)| low + high * UnidriveDrive::SERIAL_PART);
    // 0 is no number.
    (answer, serial.filter(|serial| *serial > 0))
}

/// The reply to a read of a parameter of 32 bits: the last one of a drive that is busy all the time.
fn read(stream: &mut TcpStream, parameter: Parameter) -> std::io::Result<Vec<u8>> {
    let mut reply = read_once(stream, parameter)?;
    for _ in 0..MOST_BUSY {
        let is_busy = |response| matches!(response, Response::Exception { code, .. } if code.is_busy());
        if !Response::parse(&reply).is_ok_and(|(_, response)| is_busy(response)) {
            break;
        }
        sleep(AGAIN);
        reply = read_once(stream, parameter)?;
    }
    Ok(reply)
}

fn read_once(stream: &mut TcpStream, parameter: Parameter) -> std::io::Result<Vec<u8>> {
    let address = parameter.address(Addressing::Standard, Width::Long).ok_or(ErrorKind::InvalidInput)?;
    let mut bytes = [0; ADU_MAX];
    let size = Request::Read { address, count: Width::Long.registers() }.emit(HEADER, &mut bytes);
    stream.write_all(&bytes[..size])?;
    let mut reply = Vec::new();
    while wire::frame(&reply).is_ok_and(|frame| frame.is_none()) {
        let count = stream.read(&mut bytes)?;
        if count == 0 {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        reply.extend_from_slice(&bytes[..count]);
    }
    Ok(reply)
}

/// Of the requests on a connection, one after the other.
const HEADER: Header = Header { transaction: 1, unit: 255 };

/// Who answers a read of the firmware's version so. Any server has registers there; of a Unidrive they are a version,
/// eight digits, and not 0.
fn identify(reply: &[u8]) -> Answer {
    let frame = wire::frame(reply).ok().flatten().and_then(|size| reply.get(..size));
    let Some(Ok((header, response))) = frame.map(Response::parse) else { return Answer::None };
    match response {
        _ if header != HEADER => Answer::None,
        Response::Read { data } if matches!(data.long(0), Some(1..=VERSION_MAX)) => {
            Answer::Drive("a Unidrive")
        }
        Response::Exception { code, .. } if code.is_busy() => {
            Answer::Other("a Modbus server that is busy all the time")
        }
        _ => Answer::Other("a Modbus server that is no Unidrive with the standard addressing"),
    }
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, SocketAddr, TcpListener};

    use super::*;

    /// Each first request finds it busy, and each second one is accepted first.
    #[test]
    fn a_busy_unidrive_is_requested_again() {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let SocketAddr::V4(address) = listener.local_addr().unwrap() else { unreachable!("bound to IPv4") };
        let found = std::thread::scope(|scope| {
            scope.spawn(|| {
                let (mut stream, _) = listener.accept().unwrap();
                for value in [1_220_010_u32, 5, 2] {
                    let value = value.to_be_bytes();
                    for pdu in [&[0x83, 6][..], &[0x83, 5], &[&[3, 4][..], &value].concat()] {
                        stream.read_exact(&mut [0; 12]).unwrap();
                        let length = (pdu.len() + 1) as u8;
                        stream.write_all(&[&[0, 1, 0, 0, 0, length, 255], pdu].concat()).unwrap();
                    }
                }
            });
            ask(address, REPLY)
        });
        assert_eq!(found, (Answer::Drive("a Unidrive"), Some(5 + 2 * UnidriveDrive::SERIAL_PART)));
    }

    #[test]
    fn a_unidrive_is_known_by_the_version_of_its_firmware() {
        let other = Answer::Other("a Modbus server that is no Unidrive with the standard addressing");
        // Transaction, protocol, length, unit, then the PDU.
        let reply = |pdu: &[u8]| {
            let length = (pdu.len() + 1) as u8;
            identify(&[&[0, 1, 0, 0, 0, length, 255], pdu].concat())
        };
        let version = |value: u32| reply(&[&[3, 4][..], &value.to_be_bytes()].concat());
        for (value, expected) in [
            (1_220_010, Answer::Drive("a Unidrive")),
            (99_999_999, Answer::Drive("a Unidrive")),
            (0, other),
            (100_000_000, other),
            (u32::MAX, other),
        ] {
            assert_eq!(version(value), expected, "{value}");
        }
        // No such parameter, no such function, another count of registers.
        for pdu in [&[0x83, 2][..], &[0x83, 1], &[3, 2, 0, 1]] {
            assert_eq!(reply(pdu), other, "{pdu:?}");
        }
        for code in [5, 6] {
            let busy = Answer::Other("a Modbus server that is busy all the time");
            assert_eq!(reply(&[0x83, code]), busy, "{code}");
        }
        // Nothing, what is no Modbus, half a reply, another transaction.
        for bytes in [
            &b""[..],
            b"SSH-2.0-x\r\n",
            &[0, 1, 0, 0, 0, 7, 255, 3, 4, 0, 18],
            &[0, 2, 0, 0, 0, 3, 255, 0x83, 2],
        ] {
            assert_eq!(identify(bytes), Answer::None, "{bytes:?}");
        }
    }
}
