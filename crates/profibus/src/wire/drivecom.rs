//! Path B: parameters in eight bytes of the process data by DRIVECOM, with a handshake bit (sheet, 2; EMF2133IB
//! manual, pages 87 to 90).
//!
//! How many bytes a value has comes from a table of codes, never from a reply: of a reply's service byte only the
//! handshake and the error bit can be trusted (Lenze knowledge base, article 283685).

use std::fmt;

use super::job::{Channel, Job};

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

/// What a reply says of a job, if the job before had the other handshake bit: its value, which means nothing of a
/// write, or why it was not carried out. `None`: nothing.
pub const fn reply(job: &Job, handshake: bool, channel: &Channel) -> Option<Result<u32, ErrorCode>> {
    let &[service, sub, high, low, ref data @ ..] = channel;
    let index = u16::from_be_bytes([high, low]);
    if shows(channel) != handshake || index != INDEX_OF_CODE_0.wrapping_sub(job.code) || sub != job.sub {
        return None;
    }
    let data = u32::from_be_bytes(*data);
    Some(if service & ERROR == 0 { Ok(data >> (32 - job.bits)) } else { Err(ErrorCode(data)) })
}

/// The handshake bit that the drive shows.
pub const fn shows(channel: &Channel) -> bool {
    channel[0] & HANDSHAKE != 0
}

/// Why a drive did not carry out a job: class, code, additional code (2130IB manual).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
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

    fn read(bits: u32, code: u16) -> Job {
        Job { code, sub: 0, bits, write: None }
    }

    #[test]
    fn manual_e94aycpm_reads_c0061() {
        // The length of the job is don't-care, that of the reply the drive's own: 2 bytes.
        assert_eq!(encode(&read(8, 61), false), [0x01, 0, 0x5F, 0xC2, 0, 0, 0, 0]);
        let answer = [0x11, 0, 0x5F, 0xC2, 0, 0x2B, 0, 0];
        assert_eq!(reply(&read(16, 61), false, &answer), Some(Ok(43)));
        // With the other handshake bit neither is the other's.
        assert_eq!(encode(&read(8, 61), true), [0x41, 0, 0x5F, 0xC2, 0, 0, 0, 0]);
        let toggled = [0x51, 0, 0x5F, 0xC2, 0, 0x2B, 0, 0];
        assert_eq!(reply(&read(16, 61), true, &toggled), Some(Ok(43)));
        assert_eq!(reply(&read(16, 61), false, &toggled), None);
        assert_eq!(reply(&read(16, 61), true, &answer), None);
    }

    #[test]
    fn manual_emf_reads_c0061_and_writes_c0039() {
        assert_eq!(encode(&read(32, 61), false), [0x31, 0, 0x5F, 0xC2, 0, 0, 0, 0]);
        let answer = [0x31, 0, 0x5F, 0xC2, 0, 0x06, 0x8F, 0xB0];
        assert_eq!(reply(&read(32, 61), false, &answer), Some(Ok(430_000)));
        let write = Job { write: Some(1_504_000), ..read(32, 39) };
        assert_eq!(encode(&write, true), [0x72, 0, 0x5F, 0xD8, 0, 0x16, 0xF3, 0]);
        // Replies to a write as three modules give them: the lower bits differ.
        let of_service = |service| reply(&write, true, &[service, 0, 0x5F, 0xD8, 1, 2, 3, 4]);
        assert!(
            [0x72, 0x70, 0x40].into_iter().all(|service| of_service(service).is_some_and(|end| end.is_ok()))
        );
        assert!([0x32, 0x30, 0x00].into_iter().all(|service| of_service(service).is_none()));
    }

    #[test]
    fn manual_2130_errors_by_name() {
        let answer = reply(&read(32, 61), false, &[0xB1, 0, 0x5F, 0xC2, 0x06, 0x07, 0, 0]);
        let error = answer.expect("its handshake bit").expect_err("bit 7");
        assert_eq!(error.to_string(), "error 6/7/0000: the object does not exist");
        assert_eq!(ErrorCode(0x0800_0034).to_string(), "error 8/0/0034: a part of the parameter is wrong");
        assert_eq!(ErrorCode(0x0800_0040).to_string(), "error 8/0/0040: unknown");
    }

    #[test]
    fn data_stand_on_the_left() {
        let write = |bits, value| encode(&Job { write: Some(value), ..read(bits, 0) }, false);
        assert_eq!(write(8, 0xFFFF_FF12), [0x02, 0, 0x5F, 0xFF, 0x12, 0, 0, 0]);
        assert_eq!(write(16, 0x1234), [0x12, 0, 0x5F, 0xFF, 0x12, 0x34, 0, 0]);
        assert_eq!(write(32, 0x1234_5678), [0x32, 0, 0x5F, 0xFF, 0x12, 0x34, 0x56, 0x78]);
        assert_eq!((none(true), none(false)), ([0x40, 0, 0, 0, 0, 0, 0, 0], [0; 8]));
        assert_eq!((index_of(24575), index_of(24576)), (Some(0), None));
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_back(value: u32, code: u16, sub: u8, handshake: bool, error: bool) {
            for bits in [8, 16, 32] {
                let value = value >> (32 - bits);
                let job = Job { code, sub, bits, write: Some(value) };
                // A drive that mirrors the job, and sets its bit 7 or not.
                let mut channel = encode(&job, handshake);
                channel[0] |= if error { ERROR } else { 0 };
                let answer = reply(&job, handshake, &channel).expect("its own");
                prop_assert_eq!(answer.ok(), (!error).then_some(value));
                prop_assert_eq!(reply(&job, !handshake, &channel), None);
                prop_assert_eq!(reply(&Job { sub: !sub, ..job }, handshake, &channel), None);
                prop_assert_eq!(reply(&Job { code: !code, ..job }, handshake, &channel), None);
            }
        }
    }
}
