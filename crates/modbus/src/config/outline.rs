//! What a first configuration of Unidrives has, and how one is probed.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddrV4, TcpStream};
use std::time::Duration;

use crate::parameter::{Addressing, Parameter, Width};
use crate::plan::PORT;
use crate::wire::{self, ADU_MAX, Header, Request, Response};
use fieldbeat_keys::outline::{Answer, Found, Known, Line, Outline, Search, Unit, Usual, neighbour, probed};

/// The highest version of a firmware: aa.bb.cc.dd as digits.
const VERSION_MAX: i32 = 99_999_999;

/// For a connection, and then for a reply.
const PATIENCE: Duration = Duration::from_millis(500);

pub(super) const OUTLINE: Outline = Outline {
    period: "10ms",
    bus: &[Line::ask(
        "bind",
        "Address of this computer on the network of the drives (none: any)",
        Usual::Optional,
    )],
    drive: &[Line::ask("address", "Address of the drive", Usual::From(neighbour))],
    unit: Unit::REVOLUTION,
    behind: &[Line::ask(
        "watchdog.timeout",
        "The drive trips after so long without its master",
        Usual::Is("500ms"),
    )],
    search: Search {
        question: "Probe addresses one by one? Each gets one connection and one read",
        usual: false,
        probes: true,
        run: probe,
        port: PORT,
    },
};

/// Reads the version of the firmware at each address, one after the other: the parameter that says what a drive is.
fn probe(
    _: &Known<'_>,
    addresses: &[SocketAddrV4],
    goes_on: &dyn Fn() -> bool,
) -> Result<Vec<Found>, String> {
    let mut found = Vec::new();
    for address in addresses.iter().take_while(|_| goes_on()) {
        found.extend(probed(*address, PORT, || ask(*address)));
    }
    Ok(found)
}

/// Who answers at an address.
fn ask(address: SocketAddrV4) -> Answer {
    let Some(register) = Parameter::FIRMWARE.address(Addressing::Standard, Width::Long) else {
        return Answer::None;
    };
    let mut bytes = [0; ADU_MAX];
    let size = Request::Read { address: register, count: Width::Long.registers() }.emit(HEADER, &mut bytes);
    let reply = TcpStream::connect_timeout(&address.into(), PATIENCE).and_then(|mut stream| {
        stream.set_read_timeout(Some(PATIENCE))?;
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
    });
    identify(&reply.unwrap_or_default())
}

/// Of the one request on a connection.
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
        _ => Answer::Other("a Modbus server that is no Unidrive with the standard addressing"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
