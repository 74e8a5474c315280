//! Path A: parameters in eight bytes of the process data, with a job id and a code (sheet, 1; vendor's page 107).
//!
//! There is no handshake bit. A job stays until a reply carries its code and subcode and a response; before the same
//! job a second time there is none for at least one exchange (assumed).

use super::errors::ErrorNumber;

/// The channel, either way.
pub type Channel = [u8; 8];

/// The highest code number.
pub const CODE_MAX: u16 = 0x0FFF;

/// What is to be done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Job {
    /// Nothing.
    #[default]
    None,
    /// Reads a parameter.
    Read,
    /// Writes it.
    Write(Value),
    /// Reads an element of an array.
    ReadElement,
    /// Writes it.
    WriteElement(Value),
}

/// The value of a parameter. Whether it has a sign is the parameter's matter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Value {
    /// 16 bits, in bytes 7 and 8 (assumed).
    Word(u16),
    /// 32 bits.
    Double(u32),
}

impl Value {
    const fn bits(self) -> u32 {
        match self {
            Value::Word(word) => word as u32,
            Value::Double(double) => double,
        }
    }

    const fn is_double(self) -> bool {
        matches!(self, Value::Double(_))
    }
}

/// A job for a parameter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Request {
    /// What is to be done.
    pub job: Job,
    /// The code number, 0 ... [`CODE_MAX`].
    pub code: u16,
    /// The subcode; 0 if there is none.
    pub subcode: u8,
}

impl Request {
    /// As on the wire; `None` if the code is over [`CODE_MAX`].
    pub const fn encode(&self) -> Option<Channel> {
        let (id, value) = match self.job {
            Job::None => (0, 0),
            Job::Read => (1, 0),
            Job::Write(value) => (2 + value.is_double() as u16, value.bits()),
            Job::ReadElement => (6, 0),
            Job::WriteElement(value) => (7 + value.is_double() as u16, value.bits()),
        };
        if self.code > CODE_MAX {
            return None;
        }
        let [head, low] = (id << 12 | self.code).to_be_bytes();
        let [a, b, c, d] = value.to_be_bytes();
        Some([head, low, self.subcode, 0, a, b, c, d])
    }
}

/// What the drive says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Reply {
    /// What became of the job.
    pub response: Response,
    /// The code number.
    pub code: u16,
    /// The subcode.
    pub subcode: u8,
}

/// What became of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Response {
    /// Nothing yet, or there is no job.
    None,
    /// The value that was read or written.
    Value(Value),
    /// The same of an element.
    Element(Value),
    /// It was not done. Id 7, which is a write from the master.
    Error(ErrorNumber),
    /// This interface has no right to write (assumed).
    NoRight,
    /// An id that no response has.
    Unknown(u8),
}

impl Reply {
    /// Any bytes are a reply.
    #[inline]
    pub const fn parse(channel: &Channel) -> Reply {
        let &[head, low, subcode, _, a, b, c, d] = channel;
        let (word, double) = (Value::Word(u16::from_be_bytes([c, d])), u32::from_be_bytes([a, b, c, d]));
        let response = match head >> 4 {
            0 => Response::None,
            1 => Response::Value(word),
            2 => Response::Value(Value::Double(double)),
            4 => Response::Element(word),
            5 => Response::Element(Value::Double(double)),
            7 => Response::Error(ErrorNumber(u16::from_be_bytes([c, d]))),
            8 => Response::NoRight,
            id => Response::Unknown(id),
        };
        Reply { response, code: u16::from_be_bytes([head & 0x0F, low]), subcode }
    }

    /// It is a response to this job. That it is not one to the same job before is the sender's matter.
    #[inline]
    pub fn answers(&self, request: &Request) -> bool {
        self.response != Response::None && (self.code, self.subcode) == (request.code, request.subcode)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn reads(request: Request, channel: Channel) {
        assert_eq!(request.encode(), Some(channel));
    }

    #[test]
    fn vendor_page_107_reads_c0061() {
        let request = Request { job: Job::Read, code: 0x03D, subcode: 0 };
        reads(request, [0x10, 0x3D, 0, 0, 0, 0, 0, 0]);
        let reply = Reply::parse(&[0x20, 0x3D, 0, 0, 0, 0x06, 0x8F, 0xB0]);
        assert_eq!(reply.response, Response::Value(Value::Double(430_000)), "43 degrees");
        assert!(reply.answers(&request));
        assert!(!reply.answers(&Request { subcode: 1, ..request }));
        assert!(!reply.answers(&Request { code: 0x03E, ..request }));
    }

    #[test]
    fn sheet_unknown_code_and_write_of_c0039() {
        let unknown = Request { job: Job::Read, code: 1999, subcode: 0 };
        reads(unknown, [0x17, 0xCF, 0, 0, 0, 0, 0, 0]);
        let reply = Reply::parse(&[0x77, 0xCF, 0, 0, 0, 0, 0, 0]);
        assert_eq!(reply.response, Response::Error(ErrorNumber::NO_PARAMETER));
        assert!(reply.answers(&unknown));
        let write = Request { job: Job::Write(Value::Double(1_504_000)), code: 39, subcode: 0 };
        reads(write, [0x30, 0x27, 0, 0, 0, 0x16, 0xF3, 0]);
        let reply = Reply::parse(&[0x20, 0x27, 0, 0, 0, 0x16, 0xF3, 0]);
        assert!(reply.answers(&write) && reply.response == Response::Value(Value::Double(1_504_000)));
    }

    #[test]
    fn fpba_manual_reads_an_element() {
        let request = Request { job: Job::ReadElement, code: 0x054, subcode: 0x0B };
        reads(request, [0x60, 0x54, 0x0B, 0, 0, 0, 0, 0]);
        let reply = Reply::parse(&[0x40, 0x54, 0x0B, 0, 0, 0, 0, 0x64]);
        assert!(reply.answers(&request) && reply.response == Response::Element(Value::Word(100)));
    }

    #[test]
    fn each_job_and_response_has_the_id_of_the_sheet() {
        let (word, double) = (Value::Word(0xFFFE), Value::Double(0xFFFF_FFFE));
        for (job, id, value) in [
            (Job::None, 0, 0),
            (Job::Read, 1, 0),
            (Job::Write(word), 2, 0xFFFE),
            (Job::Write(double), 3, 0xFFFF_FFFE),
            (Job::ReadElement, 6, 0),
            (Job::WriteElement(word), 7, 0xFFFE),
            (Job::WriteElement(double), 8, 0xFFFF_FFFE_u32),
        ] {
            let channel = Request { job, code: 0, subcode: 0 }.encode().expect("a code");
            assert_eq!(
                (channel[0], channel[4..].to_vec()),
                (id << 4, value.to_be_bytes().to_vec()),
                "{job:?}"
            );
        }
        // From a drive, 7 is an error and no element.
        let reply = |id: u8| Reply::parse(&[id << 4, 0, 0, 0, 0xAA, 0xBB, 0, 0x11]).response;
        let double = Value::Double(0xAABB_0011);
        assert_eq!(
            (0..16).map(reply).collect::<Vec<_>>()[..9],
            [
                Response::None,
                Response::Value(Value::Word(0x11)),
                Response::Value(double),
                Response::Unknown(3),
                Response::Element(Value::Word(0x11)),
                Response::Element(double),
                Response::Unknown(6),
                Response::Error(ErrorNumber::STATE),
                Response::NoRight,
            ]
        );
        assert_eq!(Request { code: CODE_MAX + 1, ..Request::default() }.encode(), None);
    }

    proptest! {
        #[test]
        fn a_reply_never_answers_another_parameter(channel: Channel, code in 0..=CODE_MAX, subcode: u8) {
            let reply = Reply::parse(&channel);
            prop_assert!(reply.code <= CODE_MAX);
            let same = Request { job: Job::Read, code: reply.code, subcode: reply.subcode };
            prop_assert_eq!(reply.answers(&same), channel[0] >> 4 != 0);
            let other = Request { code, subcode, ..same };
            prop_assert!(other == same || !reply.answers(&other));
            // Code and subcode stand at the same place both ways.
            let sent = same.encode().expect("in range");
            prop_assert_eq!((sent[0] & 0xF, sent[1], sent[2]), (channel[0] & 0xF, channel[1], channel[2]));
        }
    }
}
