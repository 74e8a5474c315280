//! Path B: parameters in eight bytes of the process data by DRIVECOM, with a handshake bit (sheet, 2; EMF2133IB
//! manual, pages 87 to 90).

use std::fmt;

/// The channel, either way.
pub type Channel = [u8; 8];

/// Index of the code 0.
const INDEX_OF_CODE_0: u16 = 24575;
/// Bit 6 of the service byte: toggled with each request, copied by the drive.
const HANDSHAKE: u8 = 1 << 6;
/// Bit 7 of a reply's service byte: the data are an error.
const ERROR: u8 = 1 << 7;

/// The index of a code; `None` if it has none.
pub const fn index_of(code: u16) -> Option<u16> {
    INDEX_OF_CODE_0.checked_sub(code)
}

/// How many bytes a value has. It comes from a table of codes, never from a reply: of a reply's service byte only the
/// handshake and the error bit can be trusted (Lenze knowledge base, article 283685).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Size {
    /// 1 byte.
    One = 1,
    /// 2 bytes.
    Two = 2,
    /// 3 bytes.
    Three = 3,
    /// 4 bytes.
    Four = 4,
}

impl Size {
    /// The bits of a value that are not in the data.
    const fn unused(self) -> u32 {
        32 - 8 * self as u32
    }

    /// Bits 5 and 4 of the service byte.
    const fn bits(self) -> u8 {
        (self as u8 - 1) << 4
    }
}

/// What is to be done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Job {
    /// Nothing.
    #[default]
    None,
    /// Reads. The size means nothing to the drive.
    Read(Size),
    /// Writes the lower bytes of the value.
    Write(Size, u32),
}

/// A job for an object of the drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Request {
    /// What is to be done.
    pub job: Job,
    /// The handshake bit: with each job the other one.
    pub handshake: bool,
    /// The index, see [`index_of`].
    pub index: u16,
    /// The subindex.
    pub subindex: u8,
}

impl Request {
    /// As on the wire.
    pub const fn encode(&self) -> Channel {
        let (service, value) = match self.job {
            Job::None => (0, 0),
            Job::Read(size) => (1 | size.bits(), 0),
            Job::Write(size, value) => (2 | size.bits(), value << size.unused()),
        };
        let handshake = if self.handshake { HANDSHAKE } else { 0 };
        let [high, low] = self.index.to_be_bytes();
        let [a, b, c, d] = value.to_be_bytes();
        [service | handshake, self.subindex, high, low, a, b, c, d]
    }
}

/// What the drive says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Reply {
    /// The handshake bit of the job.
    pub handshake: bool,
    /// The index.
    pub index: u16,
    /// The subindex.
    pub subindex: u8,
    /// What became of the job.
    pub result: Result<Data, ErrorCode>,
}

/// The data of a reply. To a write they mean nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Data(pub [u8; 4]);

impl Data {
    /// The value, without a sign.
    pub const fn value(self, size: Size) -> u32 {
        u32::from_be_bytes(self.0) >> size.unused()
    }
}

impl Reply {
    /// Any bytes are a reply.
    #[inline]
    pub const fn parse(channel: &Channel) -> Reply {
        let &[service, subindex, high, low, ref data @ ..] = channel;
        let result =
            if service & ERROR == 0 { Ok(Data(*data)) } else { Err(ErrorCode(u32::from_be_bytes(*data))) };
        let handshake = service & HANDSHAKE != 0;
        Reply { handshake, index: u16::from_be_bytes([high, low]), subindex, result }
    }

    /// It is the reply to this job, if the job before had the other handshake bit.
    #[inline]
    pub const fn answers(&self, request: &Request) -> bool {
        self.handshake == request.handshake
            && self.index == request.index
            && self.subindex == request.subindex
    }
}

/// Why a drive did not carry out a job: class, code, additional code (2130IB manual).
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct ErrorCode(pub u32);

impl ErrorCode {
    /// Its meaning, if known.
    pub const fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            0x0603_0000 => "no access",
            0x0605_0010 => "wrong parameter of the service",
            0x0605_0011 => "no such subindex",
            0x0605_0012 => "the data are too long",
            0x0605_0013 => "the data are too short",
            0x0606_0000 => "the object is no parameter",
            0x0607_0000 => "the object does not exist",
            0x0608_0000 => "wrong data type",
            0x0800_0000 => "not possible",
            0x0800_0020 => "not possible at the moment",
            0x0800_0021 => "not possible under local control",
            0x0800_0022 => "not possible in this state of the drive",
            0x0800_0030 => "out of range, or only while the controller is inhibited",
            0x0800_0031 => "the value is too high",
            0x0800_0032 => "the value is too low",
            0x0800_0033..=0x0800_0035 => "a part of the parameter is wrong",
            0x0800_0036 => "the maximum is lower than the minimum",
            0x0800_0041 => "the object cannot be mapped to process data",
            0x0800_0042 => "the process data get too long",
            0x0800_0043 => "collision with other values",
            _ => return None,
        })
    }
}

impl fmt::Debug for ErrorCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "ErrorCode({:#010x})", self.0)
    }
}

impl fmt::Display for ErrorCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [class, code, high, low] = self.0.to_be_bytes();
        write!(f, "error {class}/{code}/{high:02X}{low:02X}: {}", self.name().unwrap_or("unknown"))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn job(job: Job, handshake: bool, code: u16) -> Request {
        Request { job, handshake, index: index_of(code).expect("a code"), subindex: 0 }
    }

    #[test]
    fn manual_e94aycpm_reads_c0061() {
        // The length of the job is don't-care, that of the reply the drive's own: 2 bytes.
        let request = job(Job::Read(Size::One), false, 61);
        assert_eq!(request.encode(), [0x01, 0, 0x5F, 0xC2, 0, 0, 0, 0]);
        let reply = Reply::parse(&[0x11, 0, 0x5F, 0xC2, 0, 0x2B, 0, 0]);
        assert!(reply.answers(&request));
        assert_eq!(reply.result.map(|data| data.value(Size::Two)), Ok(43));
        // With the other handshake bit neither is the other's.
        let toggled = Request { handshake: true, ..request };
        assert_eq!(toggled.encode(), [0x41, 0, 0x5F, 0xC2, 0, 0, 0, 0]);
        let reply_toggled = Reply::parse(&[0x51, 0, 0x5F, 0xC2, 0, 0x2B, 0, 0]);
        assert!(
            reply_toggled.answers(&toggled) && !reply_toggled.answers(&request) && !reply.answers(&toggled)
        );
    }

    #[test]
    fn manual_emf_reads_c0061_and_writes_c0039() {
        let read = job(Job::Read(Size::Four), false, 61);
        assert_eq!(read.encode(), [0x31, 0, 0x5F, 0xC2, 0, 0, 0, 0]);
        let reply = Reply::parse(&[0x31, 0, 0x5F, 0xC2, 0, 0x06, 0x8F, 0xB0]);
        assert!(reply.answers(&read) && reply.result.map(|data| data.value(Size::Four)) == Ok(430_000));
        let write = job(Job::Write(Size::Four, 1_504_000), true, 39);
        assert_eq!(write.encode(), [0x72, 0, 0x5F, 0xD8, 0, 0x16, 0xF3, 0]);
        // Replies to a write as three modules give them: the lower bits differ.
        for service in [0x72, 0x70, 0x40] {
            assert!(Reply::parse(&[service, 0, 0x5F, 0xD8, 1, 2, 3, 4]).answers(&write), "{service:#04x}");
        }
        for service in [0x32, 0x30, 0x00] {
            assert!(!Reply::parse(&[service, 0, 0x5F, 0xD8, 1, 2, 3, 4]).answers(&write), "{service:#04x}");
        }
    }

    #[test]
    fn manual_2130_errors_by_name() {
        let reply = Reply::parse(&[0xB1, 0, 0x5F, 0xC2, 0x06, 0x07, 0, 0]);
        let error = reply.result.expect_err("bit 7");
        assert_eq!(error.to_string(), "error 6/7/0000: the object does not exist");
        assert_eq!(ErrorCode(0x0800_0034).to_string(), "error 8/0/0034: a part of the parameter is wrong");
        assert_eq!(ErrorCode(0x0800_0040).to_string(), "error 8/0/0040: unknown");
    }

    #[test]
    fn data_stand_on_the_left() {
        let write = |size, value| job(Job::Write(size, value), false, 0).encode();
        assert_eq!(write(Size::One, 0xFFFF_FF12), [0x02, 0, 0x5F, 0xFF, 0x12, 0, 0, 0]);
        assert_eq!(write(Size::Two, 0x1234), [0x12, 0, 0x5F, 0xFF, 0x12, 0x34, 0, 0]);
        assert_eq!(write(Size::Three, 0x0012_3456), [0x22, 0, 0x5F, 0xFF, 0x12, 0x34, 0x56, 0]);
        assert_eq!(job(Job::None, true, 0).encode(), [0x40, 0, 0x5F, 0xFF, 0, 0, 0, 0]);
        assert_eq!((index_of(24575), index_of(24576)), (Some(0), None));
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_back(value: u32, index: u16, subindex: u8, handshake: bool, error: bool) {
            for size in [Size::One, Size::Two, Size::Three, Size::Four] {
                let value = value >> size.unused();
                let request = Request { job: Job::Write(size, value), handshake, index, subindex };
                // A drive that mirrors the job, and sets its bit 7 or not.
                let mut channel = request.encode();
                channel[0] |= if error { ERROR } else { 0 };
                let reply = Reply::parse(&channel);
                prop_assert!(reply.answers(&request));
                prop_assert_eq!(reply.result.ok().map(|data| data.value(size)), (!error).then_some(value));
                for other in [
                    Request { handshake: !handshake, ..request },
                    Request { subindex: !subindex, ..request },
                    Request { index: !index, ..request },
                ] {
                    prop_assert!(!reply.answers(&other));
                }
            }
        }
    }
}
