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
    Other {
        /// The type.
        kind: u8,
        /// The service, if it is CoE.
        service: u8,
    },
}

/// Why a slave could not use a mailbox message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MailboxError(pub u16);

impl MailboxError {
    /// Its meaning; `None`: an unknown one.
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
                service => Some(Message::Other { kind, service }),
            }
        }
        kind => Some(Message::Other { kind, service: 0 }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::sdo::{AbortCode, Object, Request, Response};

    const COUNTER: Counter = Counter(1);

    fn sent(request: Request<'_>) -> [u8; SDO_SIZE] {
        let mut out = [0xEE; SDO_SIZE];
        assert_eq!(emit(&request, COUNTER, &mut out), SDO_SIZE);
        out
    }

    #[test]
    fn a_read_is_that_of_a_real_drive_and_so_is_its_answer() {
        let object = Object::new(0x1C00, 0);
        let request = sent(Request::Upload { object, complete: false });
        assert_eq!(request, [0x0A, 0, 0, 0, 0, 0x13, 0, 0x20, 0x40, 0, 0x1C, 0, 0, 0, 0, 0]);
        let answer = [0x0A, 0, 0, 0, 0, 0x13, 0, 0x30, 0x4F, 0, 0x1C, 0, 4, 0, 0, 0];
        let response = Response::Value { object, data: &[4] };
        assert_eq!(parse(&answer), Some(Message::Sdo { counter: 1, response }));
    }

    #[test]
    fn a_mapping_is_read_and_a_pdo_selected_as_the_manuals_have_it() {
        let object = Object::new(0x1600, 1);
        let answer = [0x0A, 0, 0, 0, 0, 0x63, 0, 0x30, 0x43, 0, 0x16, 1, 0x10, 0, 0x40, 0x60];
        let response = Response::Value { object, data: &[0x10, 0, 0x40, 0x60] };
        assert_eq!(parse(&answer), Some(Message::Sdo { counter: 6, response }));
        let value = 0x1704_u32.to_le_bytes();
        let mut out = [0xEE; SDO_SIZE];
        let select = Request::Download { object: Object::new(0x1C12, 1), value, length: 2 };
        emit(&select, Counter::default(), &mut out);
        assert_eq!(out, [0x0A, 0, 0, 0, 0, 3, 0, 0x20, 0x2B, 0x12, 0x1C, 1, 4, 0x17, 0, 0]);
    }

    #[test]
    fn complete_access_is_that_of_a_real_slave_in_a_message_too() {
        let mut answer =
            vec![0x10, 0, 0, 0, 0, 0x13, 0, 0x30, 0x51, 0, 0x1C, 0, 6, 0, 0, 0, 4, 0, 1, 2, 3, 4];
        // Behind it is old memory.
        answer.extend([0xEE; 100]);
        let response =
            Response::Begun { object: Object::new(0x1C00, 0), size: Some(6), data: &[4, 0, 1, 2, 3, 4] };
        assert_eq!(parse(&answer), Some(Message::Sdo { counter: 1, response }));
    }

    #[test]
    fn a_short_value_is_read_without_the_garbage_behind_it() {
        let answer = [0x0A, 0, 0, 0, 0, 0x13, 0, 0x30, 0x4B, 0x41, 0x60, 0, 0x37, 6, 0xEE, 0xEE];
        let response = Response::Value { object: Object::new(0x6041, 0), data: &[0x37, 6] };
        assert_eq!(parse(&answer), Some(Message::Sdo { counter: 1, response }));
    }

    #[test]
    fn all_mailbox_errors_have_names() {
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
    fn both_dialects_of_an_answer_are_read() {
        let object = Object::new(0x1C12, 1);
        let written = Some(Message::Sdo { counter: 0, response: Response::Downloaded { object } });
        // The manual's: length 14, service of a request, not counted.
        let manual = [0x0E, 0, 0, 0, 0, 0x03, 0, 0x20, 0x60, 0x12, 0x1C, 1, 0, 0, 0, 0];
        assert_eq!(parse(&manual), written);
        // The data of the request is left behind.
        let echoed = [0x0A, 0, 0, 0, 0, 0x03, 0, 0x30, 0x6B, 0x12, 0x1C, 1, 4, 0x17, 0, 0];
        assert_eq!(parse(&echoed), written);
        // In a larger mailbox a length of 14 is one.
        let mut large = [0; 128];
        large[..SDO_SIZE].copy_from_slice(&manual);
        assert_eq!(parse(&large), written);
    }

    #[test]
    fn what_comes_in_place_of_an_answer_is_told_apart() {
        let emergency = [0x0A, 0, 0, 0, 0, 0x03, 0, 0x10, 0x10, 0x43, 8, 1, 0, 0, 0, 0];
        let read = Emergency { code: 0x4310, register: 8, vendor: [1, 0, 0, 0, 0] };
        assert_eq!(parse(&emergency), Some(Message::Emergency(read)));
        let abort = [0x0A, 0, 0, 0, 0, 0x33, 0, 0x20, 0x80, 0xFF, 0x5F, 1, 0, 0, 2, 6];
        let response = Response::Abort { object: Object::new(0x5FFF, 1), code: AbortCode(0x0602_0000) };
        assert_eq!(parse(&abort), Some(Message::Sdo { counter: 3, response }));
        let refused = [4, 0, 0, 0, 0, 0x00, 1, 0, 2, 0];
        assert_eq!(parse(&refused), Some(Message::Refused(MailboxError(2))));
        let ethernet = [4, 0, 0, 0, 0, 0x02, 0, 0, 0, 0];
        assert_eq!(parse(&ethernet), Some(Message::Other { kind: 2, service: 0 }));
    }

    #[test]
    fn what_is_no_message_is_told() {
        assert_eq!(parse(&[0; 5]), None);
        assert_eq!(parse(&[9, 0, 0, 0, 0, 3, 0, 0x30]), None);
        assert_eq!(parse(&[1, 0, 0, 0, 0, 3, 0]), None);
        let none = [0x0A, 0, 0, 0, 0, 3, 0, 0x30, 0xA0, 0, 0, 0, 0, 0, 0, 0];
        assert_eq!(parse(&none), None);
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

    #[test]
    fn a_request_that_does_not_fit_is_not_begun() {
        let mut out = [0xEE; SDO_SIZE - 1];
        let request = Request::Upload { object: Object::new(0x6041, 0), complete: false };
        assert_eq!(emit(&request, COUNTER, &mut out), 0);
        assert_eq!(out, [0xEE; SDO_SIZE - 1]);
    }

    proptest::proptest! {
        #[test]
        fn no_bytes_panic(bytes: Vec<u8>) {
            let _ = parse(&bytes);
        }
    }
}
