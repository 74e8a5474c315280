//! Path A: parameters in eight bytes of the process data, with a job id and a code (sheet, 1; vendor's page 107).
//!
//! There is no handshake bit: a job stays until a reply carries its code and subcode and a response. Before the same
//! code a second time there is no job for at least one exchange.

use super::errors::ErrorNumber;
use super::job::{Channel, Job, Raw};

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

/// What a reply says of a job: its value with its size, or why it was not carried out; that is `None` if no response
/// has such an id. `None`: the reply says nothing of it. That it is not one to the same job before is the sender's
/// matter.
pub const fn reply(job: &Job, channel: &Channel) -> Option<Result<Raw, Option<ErrorNumber>>> {
    let &[head, low, sub, _, a, b, c, d] = channel;
    if is_none(channel) || u16::from_be_bytes([head & 0x0F, low]) != job.code || sub != job.sub {
        return None;
    }
    let word = u16::from_be_bytes([c, d]);
    Some(match head >> 4 {
        1 | 4 => Ok(Raw { bits: 16, raw: word as u32 }),
        2 | 5 => Ok(Raw { bits: 32, raw: u32::from_be_bytes([a, b, c, d]) }),
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
