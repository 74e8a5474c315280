//! Path B: parameters in eight bytes of the process data by DRIVECOM, with a handshake bit (sheet, 2; EMF2133IB
//! manual, pages 87 to 90).
//!
//! How many bytes a value has that was read is in the reply's service byte (E94AYCPM manual). Some modules leave
//! service and length at 0: then it is that of the job. Of the reply to a write only the handshake and the error bit
//! can be trusted (Lenze knowledge base, article 283685).

use std::fmt;

use super::job::{Channel, Job, Raw};

/// Index of the code 0.
const INDEX_OF_CODE_0: u16 = 24575;
/// Bit 6 of the service byte: toggled with each request, copied by the drive.
const HANDSHAKE: u8 = 1 << 6;
/// Bit 7 of a reply's service byte: the data are an error.
const ERROR: u8 = 1 << 7;
/// Bits 2 ... 0: the service.
const SERVICE: u8 = 7;
/// Bits 5 and 4: the bytes of the data, less 1.
const LENGTH: u8 = 3 << 4;

/// The index of a code; `None` if it has none.
pub const fn index_of(code: u16) -> Option<u16> {
    INDEX_OF_CODE_0.checked_sub(code)
}

/// No job.
pub const fn none(handshake: bool) -> Channel {
    [if handshake { HANDSHAKE } else { 0 }, 0, 0, 0, 0, 0, 0, 0]
}

/// A job as on the wire. `handshake`: with each job the other one. To the drive the size of a read means nothing.
pub const fn encode(job: &Job, handshake: bool) -> Channel {
    let (service, value) = match job.write {
        None => (1, 0),
        Some(value) => (2, value << (32 - job.bits)),
    };
    let size = (job.bits as u8 / 8 - 1) << 4;
    let [high, low] = INDEX_OF_CODE_0.wrapping_sub(job.code).to_be_bytes();
    let [a, b, c, d] = value.to_be_bytes();
    [none(handshake)[0] | size | service, job.sub, high, low, a, b, c, d]
}

/// What a reply says of a job, if the job before had the other handshake bit: its value with its size, which means
/// nothing of a write, or why it was not carried out. `None`: nothing.
pub const fn reply(job: &Job, handshake: bool, channel: &Channel) -> Option<Result<Raw, ErrorCode>> {
    let &[service, sub, high, low, ref data @ ..] = channel;
    let index = u16::from_be_bytes([high, low]);
    if shows(channel) != handshake || index != INDEX_OF_CODE_0.wrapping_sub(job.code) || sub != job.sub {
        return None;
    }
    let data = u32::from_be_bytes(*data);
    if service & ERROR != 0 {
        return Some(Err(ErrorCode(data)));
    }
    let is_bare = service & (SERVICE | LENGTH) == 0;
    let bits =
        if is_bare || job.write.is_some() { job.bits } else { 8 * ((service & LENGTH) as u32 / 16 + 1) };
    Some(Ok(Raw { bits, raw: data >> (32 - bits) }))
}

/// The handshake bit that the drive shows.
pub const fn shows(channel: &Channel) -> bool {
    channel[0] & HANDSHAKE != 0
}

/// Why a drive did not carry out a job: class, code, additional code (2130IB manual).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ErrorCode(pub u32);

impl ErrorCode {
    /// The meaning, if known.
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

impl fmt::Display for ErrorCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [class, code, high, low] = self.0.to_be_bytes();
        write!(f, "error {class}/{code}/{high:02X}{low:02X}: {}", self.name().unwrap_or("unknown"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bits: u32, code: u16) -> Job {
        Job { code, sub: 0, bits, write: None }
    }

    #[test]
    fn jobs_and_replies_are_those_of_the_manuals_and_of_one_handshake_bit() {
        let write = |bits, code, value| Job { write: Some(value), ..read(bits, code) };
        for (source, job, bit, bytes, answer, value) in [
            // The length of the job is don't-care, that of the reply the drive's own: 2 bytes.
            ("E94AYCPM", read(32, 61), false, 0x3100_5FC2_0000_0000, 0x1100_5FC2_002B_0000, 43),
            ("E94AYCPM", read(16, 61), false, 0x1100_5FC2_0000_0000_u64, 0x1100_5FC2_002B_0000_u64, 43),
            ("E94AYCPM", read(16, 61), true, 0x5100_5FC2_0000_0000, 0x5100_5FC2_002B_0000, 43),
            ("EMF", read(32, 61), false, 0x3100_5FC2_0000_0000, 0x3100_5FC2_0006_8FB0, 430_000),
            // Replies to a write as three modules give them: the lower bits differ.
            ("EMF", write(32, 39, 1_504_000), true, 0x7200_5FD8_0016_F300, 0x7200_5FD8_0016_F300, 1_504_000),
            ("EMF", write(32, 39, 1_504_000), true, 0x7200_5FD8_0016_F300, 0x7000_5FD8_0016_F300, 1_504_000),
            ("EMF", write(32, 39, 1_504_000), true, 0x7200_5FD8_0016_F300, 0x4000_5FD8_0016_F300, 1_504_000),
            // Data stand on the left.
            ("sheet", write(8, 0, 0x12), false, 0x0200_5FFF_1200_0000, 0x0200_5FFF_1200_0000, 0x12),
            ("sheet", write(16, 0, 0x1234), false, 0x1200_5FFF_1234_0000, 0x1200_5FFF_1234_0000, 0x1234),
            (
                "sheet",
                write(32, 0, 0x1234_5678),
                false,
                0x3200_5FFF_1234_5678,
                0x3200_5FFF_1234_5678,
                0x1234_5678,
            ),
        ] {
            let [bytes, answer] = [bytes, answer].map(u64::to_be_bytes);
            assert_eq!(encode(&job, bit), bytes, "{source}");
            let (read, bits) = (job.write.is_none(), 8 * (u32::from(answer[0] >> 4 & 3) + 1));
            let raw = Raw { bits: if read { bits } else { job.bits }, raw: value };
            assert_eq!(reply(&job, bit, &answer), Some(Ok(raw)), "{source} {answer:02X?}");
            assert_eq!(reply(&job, !bit, &answer), None, "{source}: the bit of another job");
            assert_eq!(reply(&Job { sub: 1, ..job }, bit, &answer), None, "{source}");
            assert_eq!(reply(&Job { code: job.code ^ 1, ..job }, bit, &answer), None, "{source}");
        }
        // Neither service nor length: that of the job; three bytes are what they are.
        let bare = reply(&read(16, 61), true, &[0x40, 0, 0x5F, 0xC2, 0, 0x2B, 0, 0]);
        assert_eq!(bare, Some(Ok(Raw { bits: 16, raw: 43 })));
        let three = reply(&read(16, 61), false, &[0x21, 0, 0x5F, 0xC2, 0, 0, 0x2B, 0]);
        assert_eq!(three, Some(Ok(Raw { bits: 24, raw: 43 })));
        assert_eq!(encode(&read(8, 61), false)[0], 0x01);
        assert_eq!(encode(&write(8, 0, 0xFFFF_FF12), false)[4..], [0x12, 0, 0, 0]);
        assert_eq!((none(true), none(false)), ([0x40, 0, 0, 0, 0, 0, 0, 0], [0; 8]));
        assert_eq!((index_of(24575), index_of(24576)), (Some(0), None));
    }

    #[test]
    fn manual_2130_errors_by_name() {
        let answer = reply(&read(32, 61), false, &[0xB1, 0, 0x5F, 0xC2, 0x06, 0x07, 0, 0]);
        let error = answer.expect("its handshake bit").expect_err("bit 7");
        assert_eq!(error.to_string(), "error 6/7/0000: the object does not exist");
        assert_eq!(ErrorCode(0x0800_0034).to_string(), "error 8/0/0034: a part of the parameter is wrong");
        assert_eq!(ErrorCode(0x0800_0040).to_string(), "error 8/0/0040: unknown");
    }
}
