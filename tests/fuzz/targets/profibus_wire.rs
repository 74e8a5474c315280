//! What arrives on a PROFIBUS, for every parser of it: no bytes make it panic, nothing reaches beyond what it was
//! given, telegrams are the same wherever they are cut, and a telegram that is read is written the same.

use fieldbeat::axis::State;
use fieldbeat_profibus::wire::base_mode::{Outcome, Response};
use fieldbeat_profibus::wire::dp::{Configuration, Diagnosis};
use fieldbeat_profibus::wire::fc::FunctionCode;
use fieldbeat_profibus::wire::job::{Job, Raw};
use fieldbeat_profibus::wire::msac1::Answer;
use fieldbeat_profibus::wire::telegram::{Frame, Head, MAX, Malformed, Next, Telegram, token};
use fieldbeat_profibus::wire::words::{DrivecomStatus, ProfidriveStatus};
use fieldbeat_profibus::wire::{drivecom, pkw};

/// The first byte is where the others are cut.
pub fn profibus_wire(data: &[u8]) {
    let Some((cut, bytes)) = data.split_first() else { return };
    stream(bytes, usize::from(*cut).min(bytes.len()));
    service(bytes);
    own(bytes);
}

/// What is found, with its size; noise in a row is one.
type Found = Vec<(Option<Malformed>, usize)>;

/// All that is in bytes of which those up to `cut` arrive first, and how many are left.
fn found(bytes: &[u8], cut: usize) -> (Found, usize) {
    let (mut all, mut start) = (Found::new(), 0);
    for known in [cut, bytes.len()] {
        loop {
            let rest = &bytes[start..known];
            let (why, size) = match Next::parse(rest) {
                Next::Incomplete { at_least } => {
                    assert!(at_least > 0 && rest.len() + at_least <= MAX);
                    break;
                }
                Next::Telegram { telegram, size } => {
                    same(telegram, &rest[..size]);
                    (None, size)
                }
                Next::Malformed { why, drop } => (Some(why), drop),
            };
            assert!((1..=rest.len()).contains(&size));
            start += size;
            match all.last_mut() {
                Some((Some(Malformed::Start), sum)) if why == Some(Malformed::Start) => *sum += size,
                _ => all.push((why, size)),
            }
        }
    }
    (all, bytes.len() - start)
}

fn stream(bytes: &[u8], cut: usize) {
    assert_eq!(found(bytes, cut), found(bytes, 0));
}

/// A telegram that was read from these bytes, written again.
fn same(telegram: Telegram<'_>, bytes: &[u8]) {
    match telegram {
        Telegram::Acknowledge => assert_eq!(bytes.len(), 1),
        Telegram::Token { da, sa } => assert_eq!(token(da, sa), bytes),
        Telegram::Data(Frame { head, data }) => {
            let mut out = [0; MAX];
            let size = head.emit(data, &mut out).expect("it was one");
            // One with a fixed length is written as one with any.
            match bytes {
                [0xA2, content @ ..] => assert_eq!(&out[..size], [&[0x68, 11, 11, 0x68], content].concat()),
                _ => assert_eq!(&out[..size], bytes),
            }
            service(data);
        }
    }
}

/// The data of a telegram, as every service's.
fn service(data: &[u8]) {
    if let Some(diagnosis) = Diagnosis::parse(data) {
        assert!(diagnosis.status.names().count() <= 24);
        assert!(diagnosis.fault().is_none() || diagnosis.extended.len() >= 3);
    }
    if let Some((inputs, outputs)) = Configuration(data).sizes() {
        assert!(inputs.max(outputs) <= 128 * data.len());
    }
    match Answer::parse(data) {
        Some(Answer { result: Ok((_, record)), .. }) => {
            assert_eq!(record.len() + 4, data.len());
            parameters(record);
        }
        Some(Answer { result: Err(why), .. }) => assert!(!why.to_string().is_empty()),
        None => (),
    }
    parameters(data);
    if let Some(channel) = data.first_chunk() {
        let code = u16::from_be_bytes([channel[0] & 0x0F, channel[1]]);
        let job = Job { code, sub: channel[2], bits: 16, write: None };
        assert_eq!(pkw::reply(&job, channel).is_some(), !pkw::is_none(channel));
        let index = u16::from_be_bytes([channel[2], channel[3]]);
        let job = Job { code: 24_575_u16.wrapping_sub(index), sub: channel[1], bits: 32, write: None };
        let handshake = drivecom::shows(channel);
        assert_eq!(drivecom::reply(&job, !handshake, channel), None);
        let reply = drivecom::reply(&job, handshake, channel).expect("its own");
        let data = u32::from_be_bytes(channel[4..].try_into().expect("four bytes"));
        match reply {
            Err(error) => assert!(channel[0] & 0x80 != 0 && error.0 == data),
            Ok(Raw { bits, raw }) => assert_eq!((channel[0] & 0x80, data >> (32 - bits)), (0, raw)),
        }
    }
    if let Some(word) = data.first_chunk().map(|bytes| u16::from_be_bytes(*bytes)) {
        for state in [DrivecomStatus(word).state(), ProfidriveStatus(word).state()] {
            assert!(word & 7 == 7 || state != State::OperationEnabled);
        }
    }
}

/// A record of parameters.
fn parameters(record: &[u8]) {
    let Some(response) = Response::parse(record) else { return };
    assert_eq!(response.outcomes().count(), usize::from(response.head.count));
    for outcome in response.outcomes() {
        match outcome {
            Outcome::Read(values) => assert!(values.first().is_none_or(|_| !values.bytes.is_empty())),
            Outcome::Failed(error) => assert!(!error.to_string().is_empty()),
            Outcome::Written => assert!(response.head.write),
        }
    }
}

/// The bytes as a telegram of the master's own.
fn own(bytes: &[u8]) {
    let Some((&[da, sa, dsap, ssap, fc], data)) = bytes.split_first_chunk() else { return };
    let sap = |sap: u8| (sap < 64).then_some(sap);
    let fc = FunctionCode(fc);
    let head = Head { da: da & 0x7F, sa: sa & 0x7F, dsap: sap(dsap), ssap: sap(ssap), fc };
    let mut out = [0; MAX];
    let size = head.emit(data, &mut out);
    let saps = usize::from(dsap < 64) + usize::from(ssap < 64);
    assert_eq!(size.is_some(), saps + data.len() + 9 <= MAX);
    if let Some(size) = size {
        let telegram = Telegram::Data(Frame { head, data });
        assert_eq!(Next::parse(&out[..size]), Next::Telegram { telegram, size });
    }
}
