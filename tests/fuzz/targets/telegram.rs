//! Every parser of what comes from a wire: no bytes make it panic, and what it has understood it says again in the same
//! bytes.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat::bus::linudp::{StateVar, WarnWord};
use fieldbeat::sim::SimDrive;
use fieldbeat::time::Time;
use fieldbeat_linudp::wire::{
    REQUEST_MAX, RESPONSE_MAX, Request, RequestDef, Response, ResponseView, RtcBlock,
};
use fieldbeat_linudp::{DRIVE_PORT, MASTER_PORT};
use fieldbeat_sim::linudp::{LinMotSettings, LinMotSim};

pub fn telegram(data: &[u8]) {
    request(data);
    response(data);
    drive(data);
}

/// The first bytes of `data`, zeros behind its end.
fn padded<const N: usize>(data: &[u8]) -> [u8; N] {
    let mut bytes = [0; N];
    let length = data.len().min(N);
    bytes[..length].copy_from_slice(&data[..length]);
    bytes
}

fn request(data: &[u8]) {
    let Ok(request) = Request::parse(data) else { return };
    // Nothing is lost: what was cut short is filled up with zeros.
    let mut bytes = [0xEE; REQUEST_MAX];
    let size = request.emit(&mut bytes);
    assert_eq!(size, request.size());
    assert_eq!(bytes[..size], padded::<REQUEST_MAX>(data)[..size]);
    assert!(bytes[size..].iter().all(|byte| *byte == 0xEE), "nothing is written behind the telegram");
    assert_eq!(Request::parse(&bytes[..size]), Ok(request));
    let mut short = [0xEE; REQUEST_MAX];
    assert_eq!(request.emit(&mut short[..size - 1]), 0);
    assert_eq!(short, [0xEE; REQUEST_MAX]);
    let _ = format!("{request:?}");
}

fn response(data: &[u8]) {
    assert_eq!(Response::parse(data).is_ok(), ResponseView::new(data).is_ok());
    let Ok(response) = Response::parse(data) else { return };
    let mut bytes = [0xEE; RESPONSE_MAX];
    let size = response.emit(&mut bytes);
    assert_eq!(size, response.size());
    // A drive may leave the requested block out; here it is written as zeros.
    let requested = response.request_def.contains(RequestDef::CONFIG);
    let whole = Response { config: response.config.or(requested.then(RtcBlock::default)), ..response };
    let said = if whole == response { size } else { size - 8 };
    assert_eq!(bytes[..said], data[..said]);
    assert!(bytes[size..].iter().all(|byte| *byte == 0xEE), "nothing is written behind the telegram");
    assert_eq!(Response::parse(&bytes[..size]), Ok(whole));
    // Padding changes nothing, whatever it is.
    let mut long = [0xFF; RESPONSE_MAX + 14];
    long[..size].copy_from_slice(&bytes[..size]);
    assert_eq!(Response::parse(&long), Ok(whole));
    let _ = format!("{response:?}");

    if let Some(state) = response.state {
        let carries = [state.count().is_some(), state.motion_active().is_some(), state.homed().is_some()];
        assert_eq!(carries, [state.main().0 == 8; 3], "only state 8 has a count");
        assert!(state.count().is_none_or(|count| count < 16));
        assert!(!state.finished() || state.sub() == StateVar::FINISHED);
    }
    let names = response.warn.map_or(0, |warn| warn.names().count());
    assert!(names <= response.warn.map_or(0, |WarnWord(word)| word.count_ones() as usize));
    if let Some(error) = response.error {
        assert!(error.to_string().starts_with(&format!("{:04X}h ", error.0)));
        assert!(!error.is_fatal() || error.name().is_some());
    }
}

/// A drive answers what it can read, with the echo of both definitions, and nothing else.
fn drive(data: &[u8]) {
    let mut drive = LinMotSim::new(LinMotSettings::new(SocketAddrV4::new(Ipv4Addr::LOCALHOST, DRIVE_PORT)));
    let master = SocketAddrV4::new(Ipv4Addr::LOCALHOST, MASTER_PORT);
    let mut reply = Vec::new();
    let answered = drive.receive(Time(0), master, data, &mut reply);
    match Request::parse(data) {
        Err(_) => assert!(answered.is_none() && reply.is_empty()),
        Ok(request) => {
            assert_eq!(answered, Some(master));
            let response = Response::parse(&reply).unwrap();
            assert_eq!(response.request_def, request.definition());
            assert_eq!(response.response_def, request.response_def);
        }
    }
}
