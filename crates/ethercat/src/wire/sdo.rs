//! SDO: reading and writing objects (ETG.1000.6, 5.6.2; CiA 301).
//!
//! A Kollmorgen drive has the expedited form only, four bytes at most. Other slaves have longer objects: their size
//! comes first, and data beyond the mailbox follow in segments.

use std::fmt;

/// An object: index and subindex.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Object {
    /// Index.
    pub index: u16,
    /// Subindex.
    pub sub: u8,
}

impl Object {
    /// From its parts.
    pub const fn new(index: u16, sub: u8) -> Object {
        Object { index, sub }
    }

    /// Index and subindex as one number.
    pub const fn key(self) -> u32 {
        (self.index as u32) << 8 | self.sub as u32
    }
}

impl fmt::Display for Object {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:#06X}:{}", self.index, self.sub)
    }
}

/// The largest value in the message itself, bytes.
pub const EXPEDITED_MAX: usize = 4;
/// Command, index, subindex, value: common to all messages.
pub const SIZE: usize = 8;
/// Bytes before the data of a segment.
pub const SEGMENT_HEADER: usize = 1;
/// The least data of a segment: shorter ones are padded.
const SEGMENT_MIN: usize = 7;

mod command {
    pub const DOWNLOAD_SEGMENT: u8 = 0x00;
    pub const DOWNLOAD: u8 = 0x20;
    pub const UPLOAD: u8 = 0x40;
    pub const UPLOAD_SEGMENT: u8 = 0x60;
    pub const ABORT: u8 = 0x80;

    pub const COMPLETE: u8 = 0x10;
    pub const TOGGLE: u8 = 0x10;
    pub const EXPEDITED: u8 = 0x02;
    pub const SIZED: u8 = 0x01;
    pub const LAST: u8 = 0x01;

    /// The kind of message: the bits that the others leave.
    pub const KIND: u8 = 0xE0;
    // Of answers.
    pub const SEGMENT: u8 = 0x00;
    pub const SEGMENT_TAKEN: u8 = 0x20;
    pub const UPLOADED: u8 = 0x40;
    pub const DOWNLOADED: u8 = 0x60;
}

/// A request of the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request<'a> {
    /// Reads an object.
    Upload {
        /// The object.
        object: Object,
        /// All its subindices together.
        complete: bool,
    },
    /// The next segment of a read.
    UploadSegment {
        /// Alternates with each.
        toggle: bool,
    },
    /// Writes one to four bytes.
    Download {
        /// The object.
        object: Object,
        /// The value, the lowest byte first.
        value: [u8; EXPEDITED_MAX],
        /// The bytes, 1 ... 4.
        length: u8,
    },
    /// Begins to write more.
    DownloadBegin {
        /// The object.
        object: Object,
        /// All its subindices together.
        complete: bool,
        /// Bytes in all.
        size: u32,
        /// The first of them.
        data: &'a [u8],
    },
    /// The next segment of a write.
    DownloadSegment {
        /// Alternates with each.
        toggle: bool,
        /// None follows.
        last: bool,
        /// The data.
        data: &'a [u8],
    },
    /// Aborts a transfer.
    Abort {
        /// The object of the transfer.
        object: Object,
        /// The reason.
        code: AbortCode,
    },
}

impl Request<'_> {
    /// The bytes.
    pub const fn size(&self) -> usize {
        match self {
            Request::DownloadBegin { data, .. } => SIZE + data.len(),
            Request::DownloadSegment { data, .. } => {
                SEGMENT_HEADER + if data.len() < SEGMENT_MIN { SEGMENT_MIN } else { data.len() }
            }
            _ => SIZE,
        }
    }

    /// Writes it into `out`, which has exactly its size.
    pub(super) fn emit(&self, out: &mut [u8]) {
        let toggled = |toggle: bool| if toggle { command::TOGGLE } else { 0 };
        let completed = |complete: bool| if complete { command::COMPLETE } else { 0 };
        out.fill(0);
        let (object, first, value) = match *self {
            Request::Upload { object, complete } => {
                (object, command::UPLOAD | completed(complete), [0; EXPEDITED_MAX])
            }
            Request::Download { object, value, length } => {
                let unused = (EXPEDITED_MAX as u8).saturating_sub(length) & 3;
                (object, command::DOWNLOAD | command::EXPEDITED | command::SIZED | unused << 2, value)
            }
            Request::DownloadBegin { object, complete, size, data } => {
                out[SIZE..].copy_from_slice(data);
                (object, command::DOWNLOAD | command::SIZED | completed(complete), size.to_le_bytes())
            }
            Request::Abort { object, code } => (object, command::ABORT, code.0.to_le_bytes()),
            Request::UploadSegment { toggle } => {
                out[0] = command::UPLOAD_SEGMENT | toggled(toggle);
                return;
            }
            Request::DownloadSegment { toggle, last, data } => {
                let unused = SEGMENT_MIN.saturating_sub(data.len()) as u8;
                let last = if last { command::LAST } else { 0 };
                out[0] = command::DOWNLOAD_SEGMENT | toggled(toggle) | unused << 1 | last;
                out[SEGMENT_HEADER..SEGMENT_HEADER + data.len()].copy_from_slice(data);
                return;
            }
        };
        out[0] = first;
        out[1..3].copy_from_slice(&object.index.to_le_bytes());
        out[3] = object.sub;
        out[4..SIZE].copy_from_slice(&value);
    }
}

/// An answer of the slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Response<'a> {
    /// A value in the message.
    Value {
        /// The object.
        object: Object,
        /// One to four bytes.
        data: &'a [u8],
    },
    /// A longer one begins.
    Begun {
        /// The object.
        object: Object,
        /// Bytes in all, if announced.
        size: Option<u32>,
        /// The first of them.
        data: &'a [u8],
    },
    /// The next segment of a read.
    Segment {
        /// As in the request.
        toggle: bool,
        /// None follows.
        last: bool,
        /// The data.
        data: &'a [u8],
    },
    /// A write is done, or begun.
    Downloaded {
        /// The object.
        object: Object,
    },
    /// A segment of a write was accepted.
    SegmentTaken {
        /// As in the request.
        toggle: bool,
    },
    /// The slave aborts the transfer.
    Abort {
        /// The object of the transfer.
        object: Object,
        /// The reason.
        code: AbortCode,
    },
}

impl<'a> Response<'a> {
    /// Reads the bytes after the CoE header, up to the end of the mailbox message.
    pub fn parse(message: &'a [u8]) -> Option<Response<'a>> {
        let &first = message.first()?;
        let toggle = first & command::TOGGLE != 0;
        match first & command::KIND {
            command::SEGMENT => {
                let unused = usize::from(first >> 1 & 7);
                let data = &message[SEGMENT_HEADER..];
                // A padded segment gives its padding; a longer one has none.
                let used = if data.len() <= SEGMENT_MIN { SEGMENT_MIN - unused } else { data.len() };
                let data = data.get(..used)?;
                return Some(Response::Segment { toggle, last: first & command::LAST != 0, data });
            }
            command::SEGMENT_TAKEN => return Some(Response::SegmentTaken { toggle }),
            _ => {}
        }
        let &[_, low, high, sub] = message.first_chunk()?;
        let object = Object { index: u16::from_le_bytes([low, high]), sub };
        let value = || message.get(4..).and_then(<[u8]>::first_chunk::<4>);
        Some(match first & command::KIND {
            // Some slaves leave size and data of the request in the answer.
            command::DOWNLOADED => Response::Downloaded { object },
            command::UPLOADED if first & command::EXPEDITED != 0 => {
                let unused = if first & command::SIZED != 0 { usize::from(first >> 2 & 3) } else { 0 };
                Response::Value { object, data: &value()?[..EXPEDITED_MAX - unused] }
            }
            command::UPLOADED => {
                let size = Some(u32::from_le_bytes(*value()?)).filter(|_| first & command::SIZED != 0);
                Response::Begun { object, size, data: &message[SIZE..] }
            }
            command::ABORT if first == command::ABORT => {
                Response::Abort { object, code: AbortCode(u32::from_le_bytes(*value()?)) }
            }
            _ => return None,
        })
    }
}

/// Why an SDO was aborted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AbortCode(pub u32);

impl AbortCode {
    /// A segment came twice, or one is missing.
    pub const TOGGLE: AbortCode = AbortCode(0x0503_0000);
    /// It took too long.
    pub const TIMED_OUT: AbortCode = AbortCode(0x0504_0000);
    /// An unknown command.
    pub const COMMAND: AbortCode = AbortCode(0x0504_0001);
    /// This access to the object is not supported.
    pub const ACCESS: AbortCode = AbortCode(0x0601_0000);
    /// The object can only be read.
    pub const READ_ONLY: AbortCode = AbortCode(0x0601_0002);
    /// Complete access is not supported.
    pub const NOT_COMPLETE: AbortCode = AbortCode(0x0601_0004);
    /// There is no such object.
    pub const NO_OBJECT: AbortCode = AbortCode(0x0602_0000);
    /// The length differs.
    pub const LENGTH: AbortCode = AbortCode(0x0607_0010);
    /// There is no such subindex.
    pub const NO_SUB: AbortCode = AbortCode(0x0609_0011);
    /// The value is out of range.
    pub const RANGE: AbortCode = AbortCode(0x0609_0030);
    /// A reason without a code.
    pub const GENERAL: AbortCode = AbortCode(0x0800_0000);
    /// Not in this state.
    pub const STATE: AbortCode = AbortCode(0x0800_0022);

    /// A write is refused since the object is not there, or can only be read: whatever the value, and for good.
    pub const fn is_of_optional(self) -> bool {
        matches!(self, AbortCode::NO_OBJECT | AbortCode::NO_SUB | AbortCode::READ_ONLY | AbortCode::ACCESS)
    }

    /// The meaning; `None`: an unknown one.
    pub const fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            0x0503_0000 => "a segment came twice, or one is missing",
            0x0504_0000 => "timed out",
            0x0504_0001 => "unknown command",
            0x0504_0005 => "out of memory",
            0x0601_0000 => "access not supported",
            0x0601_0001 => "it can only be written",
            0x0601_0002 => "it can only be read",
            0x0601_0003 => "subindex 0 has to be 0 first",
            0x0601_0004 => "complete access not supported",
            0x0601_0005 => "it is longer than the mailbox",
            0x0601_0006 => "it is mapped into the outputs",
            0x0602_0000 => "no such object",
            0x0604_0041 => "it cannot be mapped",
            0x0604_0042 => "the mapping is too long",
            0x0604_0043 => "parameters do not fit each other",
            0x0604_0047 => "incompatible within the device",
            0x0606_0000 => "hardware error",
            0x0607_0010 => "wrong length",
            0x0607_0012 => "too long",
            0x0607_0013 => "too short",
            0x0609_0011 => "no such subindex",
            0x0609_0030 => "value out of range",
            0x0609_0031 => "value too high",
            0x0609_0032 => "value too low",
            0x0609_0036 => "maximum below minimum",
            0x060A_0023 => "resource not available",
            0x0800_0000 => "general error",
            0x0800_0020 => "it cannot be transferred or stored",
            0x0800_0021 => "locally controlled",
            0x0800_0022 => "not in this state of the device",
            0x0800_0023 => "no object dictionary",
            0x0800_0024 => "no data",
            _ => return None,
        })
    }
}

impl fmt::Display for AbortCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        super::write_code(f, self.0, 10, self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::frame::tests::bytes;

    fn sent(request: Request<'_>) -> Vec<u8> {
        let mut out = vec![0xEE; request.size()];
        request.emit(&mut out);
        out
    }

    #[test]
    fn requests_are_those_of_the_sheet_to_the_byte() {
        let value = 0x1704_u32.to_le_bytes();
        let select = |length| Request::Download { object: Object::new(0x1C12, 1), value, length };
        let [object, own, types] = [0x1C12, 0x2000, 0x1C00].map(|index| Object::new(index, 0));
        let begin = |object, complete, size, data| Request::DownloadBegin { object, complete, size, data };
        for (request, expected) in [
            (select(2), "2B 121C 01 04170000"),
            // Complete access to a real slave.
            (Request::Upload { object: types, complete: true }, "50 001C 00 00000000"),
            (begin(object, true, 4, &[1, 0, 4, 0x17]), "31 121C 00 04000000 01000417"),
            (begin(own, false, 12, &[1, 2]), "21 0020 00 0C000000 0102"),
            (Request::DownloadSegment { toggle: true, last: true, data: &[3, 4, 5] }, "19 03040500000000"),
            (Request::UploadSegment { toggle: true }, "70 00000000000000"),
        ] {
            assert_eq!(sent(request), bytes(expected));
        }
        assert_eq!([1, 2, 3, 4].map(|length| sent(select(length))[0]), [0x2F, 0x2B, 0x27, 0x23]);
    }

    #[test]
    fn answers_are_read_as_far_as_they_go_and_nothing_else_is_one() {
        let [name, types, assigned] = [0x1008, 0x1C00, 0x1C12].map(|index| Object::new(index, 0));
        let value = |object, data| Some(Response::Value { object, data });
        let begun = |object, size, data| Some(Response::Begun { object, size, data });
        for (message, expected) in [
            // Complete access: of a real slave, and a short one.
            ("51 001C 00 06000000 04 00 01020304", begun(types, Some(6), &[4, 0, 1, 2, 3, 4][..])),
            ("53 121C 00 01000417", value(assigned, &[1, 0, 4, 0x17])),
            // The size may be missing.
            ("40 0810 00 EEEEEEEE 53", begun(name, None, b"S")),
            ("30 00000000000000", Some(Response::SegmentTaken { toggle: true })),
            ("19 03040500000000", Some(Response::Segment { toggle: true, last: true, data: &[3, 4, 5] })),
            ("", None),
            ("43 0016", None),
            ("43 0016 01 020304", None),
            ("00 0102", None),
            ("C0 0000 00 00000000", None),
            ("84 0000 00 00000000", None),
        ] {
            assert_eq!(Response::parse(&bytes(message)), expected, "{message}");
        }
        // What lies behind a value is left out.
        for (first, length) in [(0x4F, 1), (0x4B, 2), (0x47, 3), (0x43, 4), (0x42, 4)] {
            let message = [first, 0x00, 0x16, 1, 0x10, 0x00, 0x40, 0x60];
            let expected = Response::Value { object: Object::new(0x1600, 1), data: &message[4..4 + length] };
            assert_eq!(Response::parse(&message), Some(expected));
        }
    }

    #[test]
    fn every_size_of_a_segment_has_its_own_command() {
        for length in 0..=10_usize {
            let data = &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10][..length];
            let sent = sent(Request::DownloadSegment { toggle: false, last: false, data });
            let unused = 7_usize.saturating_sub(length);
            let expected = [&[(unused << 1) as u8], data, &[0; 7][..unused]].concat();
            assert_eq!(sent, expected);
            let read = Response::Segment { toggle: false, last: false, data };
            assert_eq!(Response::parse(&sent), Some(read), "an answer has the same form");
        }
    }

    #[test]
    fn all_codes_of_the_sheet_have_names() {
        let codes = "05030000 05040000 05040001 05040005 06010000 06010001 06010002 06010003 06010004 \
             06010005 06010006 06020000 06040041 06040042 06040043 06040047 06060000 06070010 06070012 \
             06070013 06090011 06090030 06090031 06090032 06090036 060A0023 08000000 08000020 08000021 \
             08000022 08000023 08000024";
        for code in codes.split_whitespace() {
            let code = u32::from_str_radix(code, 16).unwrap();
            assert!(AbortCode(code).name().is_some(), "{code:#010x}");
        }
        assert_eq!(AbortCode::NO_OBJECT.to_string(), "0x06020000 no such object");
        assert_eq!(AbortCode(0x1234).to_string(), "0x00001234");
        assert_eq!(Object::new(0x6041, 0).to_string(), "0x6041:0");
    }
}
