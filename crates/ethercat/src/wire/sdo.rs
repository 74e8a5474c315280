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
        /// Its bytes, 1 ... 4.
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
        /// Its data.
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
    /// Its bytes.
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
        /// Its data.
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
    /// The object can only be read.
    pub const READ_ONLY: AbortCode = AbortCode(0x0601_0002);
    /// Complete access is not supported.
    pub const NOT_COMPLETE: AbortCode = AbortCode(0x0601_0004);
    /// There is no such object.
    pub const NO_OBJECT: AbortCode = AbortCode(0x0602_0000);
    /// Its length differs.
    pub const LENGTH: AbortCode = AbortCode(0x0607_0010);
    /// There is no such subindex.
    pub const NO_SUB: AbortCode = AbortCode(0x0609_0011);
    /// The value is out of range.
    pub const RANGE: AbortCode = AbortCode(0x0609_0030);
    /// A reason without a code.
    pub const GENERAL: AbortCode = AbortCode(0x0800_0000);
    /// Not in this state.
    pub const STATE: AbortCode = AbortCode(0x0800_0022);

    /// Its meaning; `None`: an unknown one.
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

    fn bytes(request: Request<'_>) -> Vec<u8> {
        let mut out = vec![0xEE; request.size()];
        request.emit(&mut out);
        out
    }

    #[test]
    fn values_of_one_to_four_bytes_are_written_as_the_drive_has_it() {
        let object = Object::new(0x1C12, 1);
        let value = 0x1704_u32.to_le_bytes();
        let first = |length| bytes(Request::Download { object, value, length });
        assert_eq!(first(2), [0x2B, 0x12, 0x1C, 1, 4, 0x17, 0, 0]);
        assert_eq!([1, 2, 3, 4].map(|length| first(length)[0]), [0x2F, 0x2B, 0x27, 0x23]);
    }

    #[test]
    fn values_of_one_to_four_bytes_are_read_without_what_lies_behind() {
        for (first, length) in [(0x4F, 1), (0x4B, 2), (0x47, 3), (0x43, 4), (0x42, 4)] {
            let message = [first, 0x00, 0x16, 1, 0x10, 0x00, 0x40, 0x60];
            let data = &message[4..4 + length];
            let object = Object::new(0x1600, 1);
            assert_eq!(Response::parse(&message), Some(Response::Value { object, data }));
        }
    }

    #[test]
    fn complete_access_is_that_of_a_real_slave() {
        let object = Object::new(0x1C00, 0);
        assert_eq!(bytes(Request::Upload { object, complete: true }), [0x50, 0, 0x1C, 0, 0, 0, 0, 0]);
        let message = [0x51, 0, 0x1C, 0, 6, 0, 0, 0, 4, 0, 1, 2, 3, 4];
        let begun = Response::Begun { object, size: Some(6), data: &[4, 0, 1, 2, 3, 4] };
        assert_eq!(Response::parse(&message), Some(begun));
    }

    #[test]
    fn complete_access_is_written_by_its_own_command_and_read_short() {
        let object = Object::new(0x1C12, 0);
        let data = [1, 0, 4, 0x17];
        let begin = Request::DownloadBegin { object, complete: true, size: 4, data: &data };
        assert_eq!(bytes(begin), [0x31, 0x12, 0x1C, 0, 4, 0, 0, 0, 1, 0, 4, 0x17]);
        let short = [0x53, 0x12, 0x1C, 0, 1, 0, 4, 0x17];
        assert_eq!(Response::parse(&short), Some(Response::Value { object, data: &data }));
    }

    #[test]
    fn a_longer_value_need_not_say_its_size() {
        let message = [0x40, 0x08, 0x10, 0, 0xEE, 0xEE, 0xEE, 0xEE, b'S'];
        let begun = Response::Begun { object: Object::new(0x1008, 0), size: None, data: b"S" };
        assert_eq!(Response::parse(&message), Some(begun));
    }

    #[test]
    fn every_size_of_a_segment_has_its_own_command() {
        for length in 0..10_usize {
            let data = &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10][..length];
            let sent = bytes(Request::DownloadSegment { toggle: false, last: false, data });
            let unused = 7_usize.saturating_sub(length);
            assert_eq!((sent.len(), usize::from(sent[0])), (1 + length.max(7), unused << 1));
            let read = Response::Segment { toggle: false, last: false, data };
            assert_eq!(Response::parse(&sent), Some(read), "an answer has the same form");
        }
    }

    #[test]
    fn all_codes_of_the_sheet_have_names() {
        let codes = [
            0x0503_0000,
            0x0504_0000,
            0x0504_0001,
            0x0504_0005,
            0x0601_0000,
            0x0601_0001,
            0x0601_0002,
            0x0601_0003,
            0x0601_0004,
            0x0601_0005,
            0x0601_0006,
            0x0602_0000,
            0x0604_0041,
            0x0604_0042,
            0x0604_0043,
            0x0604_0047,
            0x0606_0000,
            0x0607_0010,
            0x0607_0012,
            0x0607_0013,
            0x0609_0011,
            0x0609_0030,
            0x0609_0031,
            0x0609_0032,
            0x0609_0036,
            0x060A_0023,
            0x0800_0000,
            0x0800_0020,
            0x0800_0021,
            0x0800_0022,
            0x0800_0023,
            0x0800_0024,
        ];
        for code in codes {
            assert!(AbortCode(code).name().is_some(), "{code:#010x}");
        }
    }

    #[test]
    fn segments_go_both_ways() {
        let object = Object::new(0x2000, 0);
        let begin = Request::DownloadBegin { object, complete: false, size: 12, data: &[1, 2] };
        assert_eq!(bytes(begin), [0x21, 0, 0x20, 0, 12, 0, 0, 0, 1, 2]);
        let short = Request::DownloadSegment { toggle: true, last: true, data: &[3, 4, 5] };
        assert_eq!(bytes(short), [0x19, 3, 4, 5, 0, 0, 0, 0]);
        let long = [9; 10];
        let segment = Request::DownloadSegment { toggle: false, last: false, data: &long };
        assert_eq!(bytes(segment), [&[0x00][..], &long].concat());
        assert_eq!(bytes(Request::UploadSegment { toggle: true })[0], 0x70);

        let filled = [0x19, 3, 4, 5, 0, 0, 0, 0];
        let read = Response::Segment { toggle: true, last: true, data: &[3, 4, 5] };
        assert_eq!(Response::parse(&filled), Some(read));
        let full = [&[0x00][..], &long].concat();
        let read = Response::Segment { toggle: false, last: false, data: &long };
        assert_eq!(Response::parse(&full), Some(read));
        let taken = [0x30, 0, 0, 0, 0, 0, 0, 0];
        assert_eq!(Response::parse(&taken), Some(Response::SegmentTaken { toggle: true }));
    }

    #[test]
    fn what_ends_too_early_or_begins_wrong_is_told() {
        assert_eq!(Response::parse(&[]), None);
        assert_eq!(Response::parse(&[0x43, 0, 0x16]), None);
        assert_eq!(Response::parse(&[0x43, 0, 0x16, 1, 2, 3, 4]), None);
        assert_eq!(Response::parse(&[0x00, 1, 2]), None);
        assert_eq!(Response::parse(&[0xC0, 0, 0, 0, 0, 0, 0, 0]), None);
        assert_eq!(Response::parse(&[0x84, 0, 0, 0, 0, 0, 0, 0]), None);
    }

    #[test]
    fn codes_have_names() {
        assert_eq!(AbortCode::NO_OBJECT.to_string(), "0x06020000 no such object");
        assert_eq!(AbortCode(0x1234).to_string(), "0x00001234");
        assert_eq!(Object::new(0x6041, 0).to_string(), "0x6041:0");
    }

    proptest::proptest! {
        #[test]
        fn no_bytes_panic(bytes: Vec<u8>) {
            let _ = Response::parse(&bytes);
        }
    }
}
