//! Mailbox messages: CoE with SDO requests, their answers and emergencies.

use super::objects::Object;
use super::{u16_at, u32_at};

/// Bytes before the content of a message.
pub const HEADER: usize = 6;
/// Bytes of an expedited SDO: the least message.
pub const SDO_SIZE: usize = 16;
/// Bytes of a value that is in the request or answer itself.
pub const EXPEDITED_MAX: usize = 4;

/// The content of the least message.
const LEAST: usize = SDO_SIZE - HEADER;
const ERROR: u8 = 0;
const COE: u8 = 3;
const EMERGENCY: u16 = 1;
const REQUEST: u16 = 2;
const RESPONSE: u16 = 3;
/// SDO information, and the opcode of its error.
const INFORMATION: u16 = 8;
const INFORMATION_ERROR: u8 = 7;
/// In the command of an SDO: all subindices at once.
const COMPLETE: u8 = 0x10;
/// In the command of a segment.
const TOGGLE: u8 = 0x10;
const LAST: u8 = 0x01;
/// Data of a segment that may be not full.
const SEGMENT: usize = 7;

/// Why a message cannot be used at all: the code of a mailbox error.
pub mod refusal {
    constants! { u16:
        PROTOCOL = 2; SERVICE = 4; SHORT = 6; SIZE = 8;
    }
}

/// Abort codes.
pub mod abort {
    constants! { u32:
        TOGGLE = 0x0503_0000; COMMAND = 0x0504_0001; READ_ONLY = 0x0601_0002; NOT_ZERO = 0x0601_0003;
        NOT_COMPLETE = 0x0601_0004; MAPPED = 0x0601_0006; NO_OBJECT = 0x0602_0000;
        NOT_MAPPABLE = 0x0604_0041; INCOMPATIBLE = 0x0604_0043; LENGTH = 0x0607_0010; NO_SUB = 0x0609_0011;
        RANGE = 0x0609_0030; HIGH = 0x0609_0031; LOW = 0x0609_0032; STATE = 0x0800_0022;
        NO_DICTIONARY = 0x0800_0023;
    }
}

/// The counter of a message, 1 ... 7; 0: it does not count. The message must have its header.
pub fn counter(message: &[u8]) -> u8 {
    message[5] >> 4 & 7
}

/// A message of the master.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Request<'a> {
    /// The object that it names; of a segment and the like some other bytes, which an abort returns.
    pub object: Object,
    /// All subindices at once.
    pub complete: bool,
    /// The service, with its data.
    pub kind: Kind<'a>,
}

/// The service of a request, with its data.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Kind<'a> {
    /// To read.
    Upload,
    /// To write this value.
    Download(&'a [u8]),
    /// To write so many bytes, of which these are the first.
    Begin(u32, &'a [u8]),
    /// The next bytes of that.
    Segment {
        /// Changes with each segment.
        toggle: bool,
        /// No more follow.
        last: bool,
        /// The bytes.
        data: &'a [u8],
    },
    /// To send the next bytes of what is read; the toggle.
    Next(bool),
    /// Nothing: the master has given up.
    Abort,
    /// A command that does not exist.
    Unknown,
    /// SDO information.
    Information,
}

/// Reads a written buffer; behind the message there are older bytes. `long`: messages of more than [`SDO_SIZE`] can be
/// read.
///
/// # Errors
/// The [`refusal`] of a message that is no request.
pub fn request(written: &[u8], long: bool) -> Result<Request<'_>, u16> {
    if written.len() < SDO_SIZE {
        return Err(refusal::SHORT);
    }
    if written[5] & 0x0F != COE {
        return Err(refusal::PROTOCOL);
    }
    let service = u16_at(written, 6) >> 12;
    if service == INFORMATION {
        return Ok(Request { object: Object::default(), complete: false, kind: Kind::Information });
    }
    let length = usize::from(u16_at(written, 0));
    let fits = if long { length >= LEAST } else { length == LEAST };
    let content = written.get(HEADER..HEADER + length).filter(|_| fits).ok_or(refusal::SIZE)?;
    if service != REQUEST {
        return Err(refusal::SERVICE);
    }
    let (command, toggle) = (content[2], content[2] & TOGGLE != 0);
    let kind = match command {
        0x00..=0x1F => {
            let data = &content[3..];
            let unused = if data.len() == SEGMENT { usize::from(command >> 1 & 7) } else { 0 };
            Kind::Segment { toggle, last: command & LAST != 0, data: &data[..data.len() - unused] }
        }
        0x21 | 0x31 => Kind::Begin(u32_at(content, 6), &content[LEAST..]),
        0x23 | 0x27 | 0x2B | 0x2F | 0x33 | 0x37 | 0x3B | 0x3F => {
            Kind::Download(&content[6..LEAST - usize::from(command >> 2 & 3)])
        }
        0x40 | 0x50 => Kind::Upload,
        0x60 | 0x70 => Kind::Next(toggle),
        0x80 => Kind::Abort,
        _ => Kind::Unknown,
    };
    let object = Object::new(u16_at(content, 3), content[5]);
    Ok(Request { object, complete: matches!(command >> 4, 3 | 5), kind })
}

/// The content of an answer from its command on: eight bytes.
pub fn answer(command: u8, object: Object, data: [u8; EXPEDITED_MAX]) -> Vec<u8> {
    let [low, high] = object.index.to_le_bytes();
    [&[command, low, high, object.sub][..], &data].concat()
}

/// A value was written.
pub fn written(object: Object) -> Vec<u8> {
    answer(0x60, object, [0; EXPEDITED_MAX])
}

/// A value of at most four bytes; `rest` is behind a shorter one.
pub fn value(object: Object, complete: bool, used: usize, rest: [u8; EXPEDITED_MAX]) -> Vec<u8> {
    let unused = EXPEDITED_MAX.saturating_sub(used) as u8 & 3;
    answer(0x43 | unused << 2 | if complete { COMPLETE } else { 0 }, object, rest)
}

/// A longer value: its length, and its first bytes.
pub fn long_value(object: Object, complete: bool, size: u32, first: &[u8]) -> Vec<u8> {
    let head = answer(0x41 | if complete { COMPLETE } else { 0 }, object, size.to_le_bytes());
    [&head[..], first].concat()
}

/// The next bytes of a longer value.
pub fn segment(toggle: bool, last: bool, data: &[u8]) -> Vec<u8> {
    let unused = SEGMENT.saturating_sub(data.len()) as u8;
    let command = if toggle { TOGGLE } else { 0 } | unused << 1 | if last { LAST } else { 0 };
    [&[command][..], data].concat()
}

/// A segment was taken.
pub fn segment_taken(toggle: bool) -> Vec<u8> {
    vec![0x20 | if toggle { TOGGLE } else { 0 }]
}

/// A request is not carried out.
pub fn aborted(object: Object, code: u32) -> Vec<u8> {
    answer(0x80, object, code.to_le_bytes())
}

/// A message with this content; it is filled up to the least length.
fn message(kind: u8, counter: u8, content: &[u8]) -> Vec<u8> {
    let length = content.len().max(LEAST);
    let [low, high] = (length as u16).to_le_bytes();
    let mut message = [&[low, high, 0, 0, 0, kind | counter << 4][..], content].concat();
    message.resize(HEADER + length, 0);
    message
}

fn coe(service: u16, counter: u8, content: &[u8]) -> Vec<u8> {
    message(COE, counter, &[&(service << 12).to_le_bytes()[..], content].concat())
}

/// An answer as a message. An abort has the service of a request (ETG.1000.6, 5.6.2.7).
pub fn response(counter: u8, body: &[u8]) -> Vec<u8> {
    coe(if body.first() == Some(&0x80) { REQUEST } else { RESPONSE }, counter, body)
}

/// An answer as the drive's manual prints it: length 14, the service of a request, no counter.
pub fn response_of_manual(body: &[u8]) -> Vec<u8> {
    let mut message = coe(REQUEST, 0, body);
    message[0] += 4;
    message
}

/// SDO information is not available.
pub fn no_information(counter: u8) -> Vec<u8> {
    let body = [&[INFORMATION_ERROR, 0, 0, 0][..], &abort::NO_DICTIONARY.to_le_bytes()].concat();
    coe(INFORMATION, counter, &body)
}

/// A message was refused: an error of the mailbox itself.
pub fn refused(counter: u8, code: u16) -> Vec<u8> {
    let [low, high] = code.to_le_bytes();
    let mut message = message(ERROR, counter, &[1, 0, low, high]);
    message[0] = 4;
    message
}

/// An emergency.
pub fn emergency(code: u16, register: u8, vendor: [u8; 5]) -> Vec<u8> {
    let [low, high] = code.to_le_bytes();
    coe(EMERGENCY, 0, &[&[low, high, register][..], &vendor].concat())
}
