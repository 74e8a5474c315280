//! Mailbox messages and their CoE contents (ETG.1000.6, 5.6; the drive's manual, "Mail Input").
//!
//! | bytes | field | |
//! |---|---|---|
//! | 0-1 | length | of the bytes after the six of the header; 10 for an SDO of the drive |
//! | 2-3 | address | of the station |
//! | 4 | channel, priority | 0 |
//! | 5 | type, counter | bits 0-3: 3 = CoE; bits 4-6: 1 ... 7, 0 = not counted |
//! | 6-7 | CoE | bits 0-8 number, bits 12-15 service |
//! | 8- | the message | |

use std::fmt;

use super::sdo;

/// The header of a mailbox message.
pub const HEADER: usize = 6;
/// With the CoE header after it.
pub const COE_HEADER: usize = 8;
/// The size of a Kollmorgen drive's messages: one SDO.
pub const SDO_SIZE: usize = 16;
/// Data of an emergency.
const EMERGENCY: usize = 8;

/// Types.
mod kind {
    pub const ERROR: u8 = 0;
    pub const COE: u8 = 3;
}

/// Services of CoE.
mod service {
    pub const EMERGENCY: u8 = 1;
    pub const SDO_REQUEST: u8 = 2;
    pub const SDO_RESPONSE: u8 = 3;
}

/// Counts messages: 1 ... 7, cyclically. A message with the same count again is a repetition.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counter(u8);

impl Counter {
    /// The next one.
    #[must_use]
    pub const fn next(self) -> Counter {
        Counter(if self.0 >= 7 { 1 } else { self.0 + 1 })
    }

    /// As in a message; 0: not counted.
    pub const fn number(self) -> u8 {
        self.0
    }
}

/// Writes an SDO message in place and returns its size; 0, and nothing written, if `out` is too short for it. The
/// rest of `out` is zero.
pub fn emit(request: &sdo::Request<'_>, counter: Counter, out: &mut [u8]) -> usize {
    let size = COE_HEADER + request.size();
    let Some((message, rest)) = out.split_at_mut_checked(size) else { return 0 };
    let Ok(length) = u16::try_from(size - HEADER) else { return 0 };
    message[..2].copy_from_slice(&length.to_le_bytes());
    message[2..5].fill(0);
    message[5] = kind::COE | counter.0 << 4;
    message[6..8].copy_from_slice(&(u16::from(service::SDO_REQUEST) << 12).to_le_bytes());
    request.emit(&mut message[COE_HEADER..]);
    rest.fill(0);
    size
}

/// Gives a message that was written in place another count.
pub fn recount(message: &mut [u8], counter: Counter) {
    if let Some(byte) = message.get_mut(HEADER - 1) {
        *byte = *byte & 0x8F | counter.0 << 4;
    }
}

/// An unrequested report of a slave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Emergency {
    /// The error code; 0: it is over.
    pub code: u16,
    /// Error register, 1001h.
    pub register: u8,
    /// The vendor's data. In a Kollmorgen drive the first byte is how it can be cleared.
    pub vendor: [u8; 5],
}

/// The content of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Message<'a> {
    /// The answer to an SDO, whatever its service field: drives differ.
    Sdo {
        /// The count of the request, if the slave returns it.
        counter: u8,
        /// The answer.
        response: sdo::Response<'a>,
    },
    /// An emergency.
    Emergency(Emergency),
    /// The slave could not use the mailbox message.
    Refused(MailboxError),
    /// Another protocol or service: not for this master.
    Other,
}

/// Why a slave could not use a mailbox message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MailboxError(pub u16);

impl MailboxError {
    /// The meaning; `None`: an unknown one.
    pub const fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            1 => "syntax of the header",
            2 => "protocol not supported",
            3 => "invalid channel",
            4 => "service not supported",
            5 => "invalid header",
            6 => "too short",
            7 => "no memory",
            8 => "invalid size",
            _ => return None,
        })
    }
}

impl fmt::Display for MailboxError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        super::write_code(f, self.0.into(), 6, self.name())
    }
}

/// How far a mailbox has to be read for the message of its first bytes: to its end if it is for us, otherwise no
/// further than its header. `None` if it does not fit `mailbox` bytes.
pub fn extent(head: &[u8], mailbox: usize) -> usize {
    let Some(&[low, high, _, _, _, kind]) = head.first_chunk::<HEADER>() else { return HEADER };
    let size = HEADER + usize::from(u16::from_le_bytes([low, high]));
    let is_ours = matches!(kind & 0x0F, kind::ERROR | kind::COE) && size <= mailbox;
    if is_ours { size } else { HEADER }
}

/// The count of a message; 0: it has none.
pub fn counter(message: &[u8]) -> u8 {
    message.get(HEADER - 1).map_or(0, |byte| byte >> 4 & 7)
}

/// The headers are those of an answer to an SDO, whatever follows them.
pub fn is_answer(message: &[u8]) -> bool {
    let is_sdo = |byte: &u8| matches!(byte >> 4, service::SDO_REQUEST | service::SDO_RESPONSE);
    message.get(HEADER - 1).is_some_and(|byte| byte & 0x0F == kind::COE)
        && message.get(HEADER + 1).is_some_and(is_sdo)
}

/// Reads a mailbox. After the message there may be anything: old memory.
pub fn parse(mailbox: &[u8]) -> Option<Message<'_>> {
    let header = mailbox.first_chunk::<HEADER>()?;
    let (says, has) = (usize::from(u16::from_le_bytes([header[0], header[1]])), mailbox.len() - HEADER);
    let (kind, counter) = (header[5] & 0x0F, header[5] >> 4 & 7);
    // A drive's manual shows a length of 14 for an answer of 10: the present bytes count, if only the length is
    // wrong.
    let lies = says == SDO_SIZE - 2 && has == SDO_SIZE - HEADER;
    let length = if lies { has } else { says };
    let body = mailbox.get(HEADER..HEADER + length)?;
    match kind {
        kind::ERROR => {
            let &[_, _, low, high, ..] = body else { return None };
            Some(Message::Refused(MailboxError(u16::from_le_bytes([low, high]))))
        }
        kind::COE => {
            let ([_, high], data) = body.split_first_chunk()?;
            match high >> 4 {
                service::EMERGENCY => {
                    let &[a, b, register, c, d, e, f, g] = data.first_chunk::<EMERGENCY>()?;
                    let code = u16::from_le_bytes([a, b]);
                    Some(Message::Emergency(Emergency { code, register, vendor: [c, d, e, f, g] }))
                }
                // In the drive's manual answers have the service of a request.
                service::SDO_REQUEST | service::SDO_RESPONSE => {
                    let response = sdo::Response::parse(data)?;
                    Some(Message::Sdo { counter, response })
                }
                _ => Some(Message::Other),
            }
        }
        _ => Some(Message::Other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::frame::tests::bytes;
    use crate::wire::sdo::{AbortCode, Object, Request, Response};

    #[test]
    fn requests_are_those_of_a_real_drive_and_of_the_manual() {
        let value = 0x1704_u32.to_le_bytes();
        let read = Request::Upload { object: Object::new(0x1C00, 0), complete: false };
        let select = Request::Download { object: Object::new(0x1C12, 1), value, length: 2 };
        for (counter, request, expected) in [
            (Counter(1), read, "0A00 0000 00 13 0020 40 001C 00 00000000"),
            (Counter(0), select, "0A00 0000 00 03 0020 2B 121C 01 04170000"),
        ] {
            let mut out = [0xEE; SDO_SIZE];
            assert_eq!(emit(&request, counter, &mut out), SDO_SIZE);
            assert_eq!(out[..], bytes(expected));
            let mut short = [0xEE; SDO_SIZE - 1];
            assert_eq!((emit(&request, counter, &mut short), short), (0, [0xEE; SDO_SIZE - 1]));
        }
    }

    #[test]
    fn messages_are_those_of_a_real_drive_and_of_the_sheet() {
        let value = |index, sub, data| Response::Value { object: Object::new(index, sub), data };
        let sdo = |counter, response| Some(Message::Sdo { counter, response });
        let written = sdo(0, Response::Downloaded { object: Object::new(0x1C12, 1) });
        let abort = Response::Abort { object: Object::new(0x5FFF, 1), code: AbortCode(0x0602_0000) };
        let all =
            Response::Begun { object: Object::new(0x1C00, 0), size: Some(6), data: &[4, 0, 1, 2, 3, 4] };
        let hot = Emergency { code: 0x4310, register: 8, vendor: [1, 0, 0, 0, 0] };
        for (message, expected) in [
            ("0A00 0000 00 13 0030 4F 001C 00 04 000000", sdo(1, value(0x1C00, 0, &[4][..]))),
            ("0A00 0000 00 63 0030 43 0016 01 10004060", sdo(6, value(0x1600, 1, &[0x10, 0, 0x40, 0x60]))),
            // Garbage behind a short value, and old memory behind complete access.
            ("0A00 0000 00 13 0030 4B 4160 00 3706 EEEE", sdo(1, value(0x6041, 0, &[0x37, 6]))),
            ("1000 0000 00 13 0030 51 001C 00 06000000 04 00 01 02 03 04 EEEE", sdo(1, all)),
            // The manual's dialect: length 14, service of a request, not counted; one that leaves the data behind.
            ("0E00 0000 00 03 0020 60 121C 01 00000000", written),
            ("0A00 0000 00 03 0030 6B 121C 01 04170000", written),
            // In a larger mailbox a length of 14 is one.
            ("0E00 0000 00 03 0020 60 121C 01 00000000 0000000000", written),
            // In place of an answer.
            ("0A00 0000 00 03 0010 1043 08 01 00000000", Some(Message::Emergency(hot))),
            ("0A00 0000 00 33 0020 80 FF5F 01 00000206", sdo(3, abort)),
            ("0400 0000 00 02 00000000", Some(Message::Other)),
            // No message.
            ("0000 0000 00", None),
            ("0900 0000 00 03 0030", None),
            ("0100 0000 00 03 00", None),
            ("0A00 0000 00 03 0030 A0 000000 00000000", None),
        ] {
            assert_eq!(parse(&bytes(message)), expected, "{message}");
        }
        for code in 1..=8 {
            let refused = [4, 0, 0, 0, 0, 0, 1, 0, code, 0];
            let Some(Message::Refused(error)) = parse(&refused) else { panic!() };
            assert!(error.0 == u16::from(code) && error.name().is_some());
        }
        assert_eq!(MailboxError(9).name(), None);
    }

    #[test]
    fn only_what_is_for_us_is_read_to_its_end() {
        assert_eq!(extent(&[0x0A, 0, 0, 0, 0, 0x13, 0, 0x30], 128), 16);
        assert_eq!(extent(&[4, 0, 0, 0, 0, 0], 128), 10);
        assert_eq!(extent(&[0xDC, 5, 0, 0, 0, 0x02], 1_600), HEADER, "Ethernet over EtherCAT");
        assert_eq!(extent(&[0xFF, 0xFF, 0, 0, 0, 3], 128), HEADER, "it is longer than the mailbox");
        assert_eq!(extent(&[1, 2, 3], 128), HEADER);
    }

    #[test]
    fn counts_go_from_one_to_seven() {
        let mut counter = Counter::default();
        let counts: Vec<u8> = std::iter::repeat_with(|| {
            counter = counter.next();
            counter.number()
        })
        .take(9)
        .collect();
        assert_eq!(counts, [1, 2, 3, 4, 5, 6, 7, 1, 2]);
    }
}
