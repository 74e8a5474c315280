//! Path A: parameters in eight bytes of the process data, with a job id and a code (sheet, 1; vendor's page 107).
//!
//! There is no handshake bit: a job stays until a reply carries its code and subcode and a response. Before the same
//! code a second time there is no job for at least one exchange.

use super::errors::ErrorNumber;
use super::job::{Channel, Job};

/// The highest number of a code.
pub const CODE_MAX: u16 = 0x0FFF;

/// No job, and no response.
pub const NONE: Channel = [0; 8];

/// A job as on the wire. A value of up to 16 bits is in the last two bytes (assumed).
pub const fn encode(job: &Job) -> Channel {
    let is_double = job.bits > 16;
    let (id, value) = match job.write {
        None => (1, 0),
        Some(value) if is_double => (3, value),
        Some(value) => (2, value & 0xFFFF),
    };
    // An element of an array has jobs of its own: 6, 7 and 8.
    let id = if job.sub == 0 { id } else { id + 5 };
    let [head, low] = (id << 12 | job.code & CODE_MAX).to_be_bytes();
    let [a, b, c, d] = value.to_be_bytes();
    [head, low, job.sub, 0, a, b, c, d]
}

/// What a reply says of a job: its value, or why it was not carried out; that is `None` if no response has such an id.
/// `None`: the reply says nothing of it. That it is not one to the same job before is the sender's matter.
pub const fn reply(job: &Job, channel: &Channel) -> Option<Result<u32, Option<ErrorNumber>>> {
    let &[head, low, sub, _, a, b, c, d] = channel;
    if is_none(channel) || u16::from_be_bytes([head & 0x0F, low]) != job.code || sub != job.sub {
        return None;
    }
    let word = u16::from_be_bytes([c, d]);
    Some(match head >> 4 {
        1 | 4 => Ok(word as u32),
        2 | 5 => Ok(u32::from_be_bytes([a, b, c, d])),
        // From the master, a write.
        7 => Err(Some(ErrorNumber(word))),
        // Assumed.
        8 => Err(Some(ErrorNumber::NO_RIGHT)),
        _ => Err(None),
    })
}

/// The drive has no response: nothing yet, or it knows that there is no job.
pub const fn is_none(channel: &Channel) -> bool {
    channel[0] >> 4 == 0
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn job(code: u16, sub: u8, write: Option<u32>) -> Job {
        Job { code, sub, bits: 32, write }
    }

    #[test]
    fn vendor_page_107_reads_c0061() {
        let read = job(0x03D, 0, None);
        assert_eq!(encode(&read), [0x10, 0x3D, 0, 0, 0, 0, 0, 0]);
        let answer = [0x20, 0x3D, 0, 0, 0, 0x06, 0x8F, 0xB0];
        assert_eq!(reply(&read, &answer), Some(Ok(430_000)), "43 degrees");
        assert_eq!(reply(&job(0x03D, 1, None), &answer), None);
        assert_eq!(reply(&job(0x03E, 0, None), &answer), None);
    }

    #[test]
    fn sheet_unknown_code_and_write_of_c0039() {
        let unknown = job(1999, 0, None);
        assert_eq!(encode(&unknown), [0x17, 0xCF, 0, 0, 0, 0, 0, 0]);
        let answer = [0x77, 0xCF, 0, 0, 0, 0, 0, 0];
        assert_eq!(reply(&unknown, &answer), Some(Err(Some(ErrorNumber(0)))));
        let write = job(39, 0, Some(1_504_000));
        assert_eq!(encode(&write), [0x30, 0x27, 0, 0, 0, 0x16, 0xF3, 0]);
        assert_eq!(reply(&write, &[0x20, 0x27, 0, 0, 0, 0x16, 0xF3, 0]), Some(Ok(1_504_000)));
    }

    #[test]
    fn fpba_manual_reads_an_element() {
        let read = job(0x054, 0x0B, None);
        assert_eq!(encode(&read), [0x60, 0x54, 0x0B, 0, 0, 0, 0, 0]);
        assert_eq!(reply(&read, &[0x40, 0x54, 0x0B, 0, 0, 0, 0, 0x64]), Some(Ok(100)));
    }

    #[test]
    fn each_job_and_response_has_the_id_of_the_sheet() {
        let (read, value) = (None, Some(0xFFFF_FFFE_u32));
        for (sub, bits, write, id, value) in [
            (0, 32, read, 1, 0),
            (0, 16, value, 2, 0xFFFE),
            (0, 32, value, 3, 0xFFFF_FFFE),
            (1, 32, read, 6, 0),
            (1, 8, value, 7, 0xFFFE),
            (1, 32, value, 8, 0xFFFF_FFFE_u32),
        ] {
            let channel = encode(&Job { code: 0, sub, bits, write });
            assert_eq!((channel[0], channel[4..].to_vec()), (id << 4, value.to_be_bytes().to_vec()));
        }
        // From a drive, 7 is an error and no element.
        let reply = |id: u8| reply(&job(0, 0, None), &[id << 4, 0, 0, 0, 0xAA, 0xBB, 0, 0x11]);
        let failed = |error| Some(Err(Some(error)));
        assert_eq!(
            (0..16).map(reply).collect::<Vec<_>>()[..10],
            [
                None,
                Some(Ok(0x11)),
                Some(Ok(0xAABB_0011)),
                Some(Err(None)),
                Some(Ok(0x11)),
                Some(Ok(0xAABB_0011)),
                Some(Err(None)),
                failed(ErrorNumber(0x11)),
                failed(ErrorNumber::NO_RIGHT),
                Some(Err(None)),
            ]
        );
    }

    proptest! {
        #[test]
        fn a_reply_never_answers_another_parameter(channel: Channel, code in 0..=CODE_MAX, sub: u8) {
            let of = u16::from_be_bytes([channel[0] & 0x0F, channel[1]]);
            let same = job(of, channel[2], None);
            prop_assert_eq!(reply(&same, &channel).is_some(), channel[0] >> 4 != 0);
            let other = job(code, sub, None);
            prop_assert!(other == same || reply(&other, &channel).is_none());
            // Code and subcode stand at the same place both ways.
            let sent = encode(&same);
            prop_assert_eq!((sent[0] & 0xF, sent[1], sent[2]), (channel[0] & 0xF, channel[1], channel[2]));
        }
    }
}
