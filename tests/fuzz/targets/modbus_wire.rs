//! A stream of Modbus TCP, for every parser of what comes from it: no bytes make it panic, no split changes what is
//! found, and what it has understood it says again in the same bytes. Read as text, the same bytes are an address and a
//! value of a parameter.

use fieldbeat::bus::modbus::{Addressing, Parameter};
use fieldbeat_core::axis::acyclic::Notation;
use fieldbeat_core::axis::acyclic::long::Target as _;
use fieldbeat_modbus::notation::{Parameters, Service, Target};
use fieldbeat_modbus::wire::{
    ADU_MAX, FrameError, HEADER, Header, Registers, Request, RequestFault, Response, ResponseError, frame,
};

pub fn modbus_wire(data: &[u8]) {
    stream(data);
    message(data);
    addresses(data);
    notation(&String::from_utf8_lossy(data));
}

/// Message after message, as whoever reads a stream cuts it.
fn stream(mut rest: &[u8]) {
    while let Some(size) = split(rest) {
        let (adu, behind) = rest.split_at(size);
        message(adu);
        rest = behind;
    }
}

/// What is in front, and that it is the same however it arrives.
fn split(bytes: &[u8]) -> Option<usize> {
    let whole = frame(bytes);
    for have in 0..bytes.len().min(ADU_MAX + 1) {
        let part = frame(&bytes[..have]);
        match whole {
            Ok(Some(size)) => assert_eq!(part, Ok((have >= size).then_some(size))),
            Ok(None) => assert_eq!(part, Ok(None)),
            Err(FrameError::Protocol(_)) => assert_eq!(part, if have < 4 { Ok(None) } else { whole }),
            Err(FrameError::Length(_)) => assert_eq!(part, if have < 6 { Ok(None) } else { whole }),
        }
    }
    let size = whole.ok()??;
    assert!((HEADER + 1..=ADU_MAX).contains(&size) && size <= bytes.len());
    Some(size)
}

fn message(adu: &[u8]) {
    let is_one = frame(adu) == Ok(Some(adu.len()));
    let header = Header::parse(adu);
    match Request::parse(adu) {
        Ok((reported, request)) => {
            assert!(is_one && Some(reported) == header);
            same(adu, request.size(), |out| request.emit(reported, out));
            if let Request::Write { data, .. } | Request::ReadWrite { data, .. } = request {
                registers(data);
            }
        }
        Err(error) => {
            assert_eq!(error.header, header.unwrap_or_default());
            assert!(error.fault == RequestFault::Malformed || is_one, "what is no message has no function");
            let _ = error.to_string();
        }
    }
    match Response::parse(adu) {
        Ok((reported, response)) => {
            assert!(is_one && Some(reported) == header);
            same(adu, response.size(), |out| response.emit(reported, out));
            match response {
                Response::Read { data } | Response::ReadWritten { data } => registers(data),
                Response::Exception { function, code } => {
                    assert!(function < 0x80 && adu[HEADER] & 0x80 != 0);
                    let _ = code.to_string();
                }
                Response::WriteOne { .. } | Response::Written { .. } => {}
            }
        }
        Err(error) => {
            assert_eq!(matches!(error, ResponseError::Frame { .. }), !is_one);
            let _ = error.to_string();
        }
    }
}

/// What was read from `adu` is written as the same bytes, and not at all into less room.
fn same(adu: &[u8], size: usize, emit: impl Fn(&mut [u8]) -> usize) {
    let mut bytes = [0xEE; ADU_MAX + 1];
    assert_eq!((size, emit(&mut bytes)), (adu.len(), adu.len()));
    assert_eq!(&bytes[..size], adu);
    assert!(bytes[size..].iter().all(|byte| *byte == 0xEE), "nothing is written behind the message");
    let mut short = [0xEE; ADU_MAX];
    assert_eq!(emit(&mut short[..size - 1]), 0);
    assert_eq!(short, [0xEE; ADU_MAX]);
}

fn registers(data: Registers<'_>) {
    assert_eq!(data.bytes().len(), 2 * data.len());
    assert!(data.words().map(Some).eq((0..data.len()).map(|index| data.word(index))));
    assert_eq!((data.word(data.len()), data.long(data.len() / 2)), (None, None));
    for index in 0..data.len() / 2 {
        let [high, low] = [2 * index, 2 * index + 1].map(|index| data.word(index).unwrap());
        assert_eq!(data.long(index), Some((u32::from(high) << 16 | u32::from(low)) as i32));
    }
}

fn addresses(data: &[u8]) {
    for word in data.as_chunks().0 {
        let address = u16::from_be_bytes(*word);
        for addressing in [Addressing::Standard, Addressing::Modified] {
            let Some((parameter, width)) = Parameter::from_address(address, addressing) else { continue };
            assert_eq!(parameter.address(addressing, width), Some(address));
            assert_eq!(parameter.to_string().parse(), Ok(parameter));
        }
        if let Some(parameter) = Parameter::from_setup(address) {
            assert_eq!(parameter.to_setup(), Some(address));
        }
    }
}

/// An address, and behind a space a value.
fn notation(text: &str) {
    let (address, value) = text.split_once(' ').unwrap_or((text, ""));
    let target = Target::parse(address);
    assert_eq!(Parameters.read(address).ok(), target.map(|target| Service::Read(target).into()));
    let Ok(raw) = Parameters.value(address, value) else { return };
    let target = target.expect("a value is one of an address");
    assert_eq!(Target::unpack(target.pack()), Some(target));
    assert_eq!(Parameters.write(address, raw), Ok(Service::Write(target, raw).into()));
    let number = Parameters.number(address, raw);
    assert_eq!(Parameters.value(address, &number.to_string()), Ok(raw), "its number says the same");
    assert_eq!(Parameters.value(address, &format!("0x{raw:X}")), Ok(raw), "its bits say the same");
    let shown = Parameters.show(address, raw);
    assert!(
        shown.ends_with(&format!("{number} (0x{raw:X})"))
            || shown.ends_with(&format!("(raw {number}, 0x{raw:X})"))
    );
    if let Some((means, _)) = shown.split_once(" (raw ") {
        assert_eq!(Parameters.in_unit(address, means), Ok(raw), "what is shown says the same");
    }
    assert!(Parameters.is_same(address, raw, raw));
}
