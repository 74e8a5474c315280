//! Telegrams as bytes: start, length, check sum, end; addresses and service access points.
//!
//! Knows no time and no service. Facts: sheet, 5. A code of its own: it shares nothing with the master's wire.

/// Start and end bytes.
mod mark {
    pub const SD1: u8 = 0x10;
    pub const SD2: u8 = 0x68;
    pub const SD3: u8 = 0xA2;
    pub const SD4: u8 = 0xDC;
    pub const SC: u8 = 0xE5;
    pub const END: u8 = 0x16;
}

/// The bit of an address with which a service access point follows.
const EXTENSION: u8 = 0x80;
/// The address of all.
pub(super) const BROADCAST: u8 = 127;
/// The bit of a function code that is a request.
const REQUEST: u8 = 0x40;

/// The least and the largest length in an SD2.
const LENGTHS: (u8, u8) = (4, 249);
/// The bytes of a telegram of 8 data bytes of the form SD3.
const SD3_DATA: usize = 8;

/// What a telegram is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Telegram<'a> {
    /// SC: a positive acknowledgement.
    Ack,
    /// SD4: who gets the token, from whom.
    Token { to: u8, from: u8 },
    /// A request or a response.
    Frame(Frame<'a>),
}

/// SD1, SD2 or SD3.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Frame<'a> {
    pub to: u8,
    pub from: u8,
    /// Service access points of the destination and of the source.
    pub saps: (Option<u8>, Option<u8>),
    pub function: u8,
    /// Behind the access points.
    pub data: &'a [u8],
}

/// Why bytes are no telegram, in the order of the checks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Damage {
    Start,
    Length,
    Sum,
    End,
    /// An access point is announced and not there, or is none.
    Extension,
}

impl Frame<'_> {
    pub(super) fn is_request(&self) -> bool {
        self.function & REQUEST != 0
    }
}

/// How many bytes the telegram that begins with these has; `None`: more of them are needed to say.
pub(super) fn length(bytes: &[u8]) -> Result<Option<usize>, Damage> {
    match *bytes {
        [] => Ok(None),
        [mark::SC, ..] => Ok(Some(1)),
        [mark::SD4, ..] => Ok(Some(3)),
        [mark::SD1, ..] => Ok(Some(6)),
        [mark::SD3, ..] => Ok(Some(SD3_DATA + 6)),
        [mark::SD2, length, again, second, ..] => {
            match (LENGTHS.0..=LENGTHS.1).contains(&length) && again == length {
                true if second == mark::SD2 => Ok(Some(usize::from(length) + 6)),
                true => Err(Damage::Start),
                false => Err(Damage::Length),
            }
        }
        [mark::SD2, ..] => Ok(None),
        _ => Err(Damage::Start),
    }
}

/// Reads a telegram of exactly these bytes.
pub(super) fn parse(bytes: &[u8]) -> Result<Telegram<'_>, Damage> {
    if length(bytes)? != Some(bytes.len()) {
        return Err(Damage::Length);
    }
    let head = match *bytes {
        [mark::SC] => return Ok(Telegram::Ack),
        [mark::SD4, to, from] => return Ok(Telegram::Token { to, from }),
        [mark::SD2, ..] => 4,
        _ => 1,
    };
    let [body @ .., sum, end] = &bytes[head..] else { return Err(Damage::Length) };
    if check_sum(body) != *sum {
        return Err(Damage::Sum);
    }
    if *end != mark::END {
        return Err(Damage::End);
    }
    let [to, from, function, data @ ..] = body else { return Err(Damage::Length) };
    let mut data = data;
    let mut access = |address: u8| {
        if address & EXTENSION == 0 {
            return Ok(None);
        }
        let Some((sap, rest)) = data.split_first().filter(|(sap, _)| **sap < 64) else {
            return Err(Damage::Extension);
        };
        data = rest;
        Ok(Some(*sap))
    };
    let saps = (access(*to)?, access(*from)?);
    let (to, from) = (to & !EXTENSION, from & !EXTENSION);
    Ok(Telegram::Frame(Frame { to, from, saps, function: *function, data }))
}

/// Appends a frame: without access points and data as SD1, with 8 bytes behind the head as SD3 where that is wanted,
/// else as SD2.
pub(super) fn append(frame: &Frame<'_>, short: bool, out: &mut Vec<u8>) {
    let (to, from) = frame.saps;
    let mark = |address: u8, sap: Option<u8>| address | if sap.is_some() { EXTENSION } else { 0 };
    let data = usize::from(to.is_some()) + usize::from(from.is_some()) + frame.data.len();
    match data {
        0 => out.push(mark::SD1),
        SD3_DATA if short => out.push(mark::SD3),
        _ => {
            let length = (data + 3).min(LENGTHS.1.into()) as u8;
            out.extend([mark::SD2, length, length, mark::SD2]);
        }
    }
    let body = out.len();
    out.extend([mark(frame.to, to), mark(frame.from, from), frame.function]);
    out.extend(to);
    out.extend(from);
    out.extend_from_slice(frame.data);
    out.extend([check_sum(&out[body..]), mark::END]);
}

/// Appends a positive acknowledgement.
pub(super) fn append_ack(out: &mut Vec<u8>) {
    out.push(mark::SC);
}

/// Appends a token.
pub(super) fn append_token(to: u8, from: u8, out: &mut Vec<u8>) {
    out.extend([mark::SD4, to, from]);
}

/// Makes another station the source of a frame.
pub(super) fn change_source(bytes: &mut [u8]) {
    let head = if bytes.first() == Some(&mark::SD2) { 4 } else { 1 };
    let head = head.min(bytes.len());
    if let [body @ .., sum, _] = &mut bytes[head..]
        && let Some(source) = body.get_mut(1)
    {
        *source ^= 0x40;
        *sum = check_sum(body);
    }
}

fn check_sum(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |sum, byte| sum.wrapping_add(*byte))
}
