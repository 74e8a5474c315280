//! The parameter channel in the first 8 bytes of the process data: jobs of the PKW form, and of DRIVECOM.
//!
//! Facts: sheet, 1, 2. What they leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | a job | is answered in a later exchange than that which brings it; until then a PKW answer has id 0 |
//! | PKW jobs 1 to 3 with a subcode, jobs 6 to 8 of a code without | errors 3, 4 |
//! | a value of 16 bits, PKW | is in the last two bytes; DRIVECOM: in the first two |
//! | a DRIVECOM service behind none | acts without a change of the handshake bit |
//! | service 000 | is answered with 000 |

use super::Misuse;
use super::codes::{Codes, Refusal, Type};
use super::drive::Drive;
use super::settings::Channel;
use fieldbeat_core::time::Time;

/// Index 24575 is code 0.
pub(super) const TOP: u16 = 24_575;
/// The service byte of DRIVECOM.
mod service {
    pub const REQUEST: u8 = 0x07;
    pub const READ: u8 = 1;
    pub const WRITE: u8 = 2;
    pub const LENGTH: u8 = 0x30;
    pub const HANDSHAKE: u8 = 0x40;
    pub const ERROR: u8 = 0x80;
}

/// The response id of an error.
const FAILED: u8 = 7;

/// One channel.
#[derive(Debug)]
pub(super) struct ParameterChannel {
    kind: Channel,
    job_ns: u64,
    /// The newest job, and the one before it that counted.
    job: [u8; 8],
    /// When the newest one is done; `None`: it is.
    ready_at: Option<Time>,
    answer: [u8; 8],
}

impl ParameterChannel {
    pub(super) fn new(kind: Channel, job_ns: u64) -> ParameterChannel {
        ParameterChannel { kind, job_ns, job: [0; 8], ready_at: None, answer: [0; 8] }
    }

    /// No job, no answer.
    pub(super) fn reset(&mut self) {
        (self.job, self.ready_at, self.answer) = ([0; 8], None, [0; 8]);
    }

    pub(super) fn answer(&self) -> [u8; 8] {
        self.answer
    }

    /// An exchange with this job in its outputs.
    pub(super) fn exchange(&mut self, now: Time, job: [u8; 8], drive: &mut Drive, misuse: &mut Misuse) {
        let done = self.ready_at.take_if(|ready| *ready <= now).is_some();
        match self.kind {
            Channel::None => {}
            Channel::Pkw => self.pkw(now, job, done, drive, misuse),
            Channel::Drivecom | Channel::DrivecomBare => self.drivecom(now, job, done, drive, misuse),
        }
    }

    fn pkw(&mut self, now: Time, job: [u8; 8], done: bool, drive: &mut Drive, misuse: &mut Misuse) {
        let (id, old) = (job[0] >> 4, self.job[0] >> 4);
        // A read is refreshed.
        if done || self.ready_at.is_none() && matches!(old, 1 | 6) {
            self.answer = pkw(self.job, drive);
        }
        // The value of a read means nothing.
        let key = |job: [u8; 8], id| {
            if matches!(id, 1 | 6) {
                (job[0], job[1], job[2], [0; 4])
            } else {
                (job[0], job[1], job[2], [job[4], job[5], job[6], job[7]])
            }
        };
        if key(job, id) == key(self.job, old) {
            return;
        }
        // Giving up is allowed: job 0.
        misuse.job += u64::from(id != 0 && self.ready_at.is_some());
        misuse.job += u64::from(id > 8 || matches!(id, 4 | 5) || job[3] != 0);
        (self.job, self.answer) = (job, [0; 8]);
        self.ready_at = (id != 0).then(|| now + self.job_ns);
    }

    fn drivecom(&mut self, now: Time, job: [u8; 8], done: bool, drive: &mut Drive, misuse: &mut Misuse) {
        if done {
            self.answer = drivecom(self.job, self.kind == Channel::DrivecomBare, drive);
        }
        let (new, old) = (job[0], self.job[0]);
        if new & service::REQUEST == 0 {
            self.reset();
            self.job = job;
            self.answer[0] = new & service::HANDSHAKE;
        } else if (new ^ old) & service::HANDSHAKE != 0 || old & service::REQUEST == 0 {
            misuse.job += u64::from(self.ready_at.is_some());
            (self.job, self.ready_at) = (job, Some(now + self.job_ns));
        } else if job != self.job {
            misuse.handshake += 1;
        }
    }
}

/// The answer to a job of the PKW form.
fn pkw(job: [u8; 8], drive: &mut Drive) -> [u8; 8] {
    let code = u16::from_be_bytes([job[0] & 0x0F, job[1]]);
    let (id, subcode) = (job[0] >> 4, u16::from(job[2]));
    let value = i32::from_be_bytes([job[4], job[5], job[6], job[7]]);
    let result = (|| {
        let (of, is_array) = Codes::describe(code, subcode)?;
        match id {
            1..=3 if subcode != 0 => return Err(Refusal::NoSubcode),
            6..=8 if !is_array => return Err(Refusal::NotAnArray),
            1..=3 | 6..=8 => {}
            _ => return Err(Refusal::Format),
        }
        match (id, of) {
            (_, Type::Text(_)) => return Err(Refusal::WrongType),
            (1 | 6, _) => {}
            (2 | 7, Type::Word) => drive.write(code, subcode, value & 0xFFFF)?,
            (3 | 8, Type::Fixed) => drive.write(code, subcode, value)?,
            _ => return Err(Refusal::WrongType),
        }
        drive.read(code, subcode)
    })();
    let (id, value) = match result {
        Ok((of, value)) => (if id < 6 { 1 } else { 4 } + u8::from(of != Type::Word), value),
        Err(refusal) => (FAILED, refusal.number().into()),
    };
    let [a, b, c, d] = value.to_be_bytes();
    [id << 4 | job[0] & 0x0F, job[1], job[2], 0, a, b, c, d]
}

/// The answer to a job of DRIVECOM.
fn drivecom(job: [u8; 8], bare: bool, drive: &mut Drive) -> [u8; 8] {
    let code = TOP.wrapping_sub(u16::from_be_bytes([job[2], job[3]]));
    let (request, subcode) = (job[0] & service::REQUEST, u16::from(job[1]));
    let data = [job[4], job[5], job[6], job[7]];
    let bytes = |of| if of == Type::Word { 2 } else { 4 };
    let result = (|| {
        let (of, _) = Codes::describe(code, subcode)?;
        if matches!(of, Type::Text(_)) {
            return Err(Refusal::WrongType);
        }
        if request == service::READ {
            return drive.read(code, subcode);
        }
        if request != service::WRITE {
            return Err(Refusal::Service);
        }
        match usize::from((job[0] & service::LENGTH) >> 4) + 1 {
            length if length > bytes(of) => return Err(Refusal::TooLong),
            length if length < bytes(of) => return Err(Refusal::TooShort),
            _ => {}
        }
        let value = i32::from_be_bytes(data);
        drive.write(code, subcode, if of == Type::Word { value >> 16 & 0xFFFF } else { value })?;
        Ok((of, value))
    })();
    let handshake = job[0] & service::HANDSHAKE;
    let length = |of| ((bytes(of) - 1) << 4) as u8;
    let (first, value) = match result {
        Ok((Type::Word, value)) if request == service::READ => (request | length(Type::Word), value << 16),
        Ok((of, value)) if request == service::READ => (request | length(of), value),
        Ok((of, value)) => (length(of), value),
        Err(refusal) => {
            (service::ERROR | job[0] & service::LENGTH | request, refusal.drivecom().cast_signed())
        }
    };
    let first = if bare { first & service::ERROR } else { first };
    let [a, b, c, d] = value.to_be_bytes();
    [first | handshake, job[1], job[2], job[3], a, b, c, d]
}
