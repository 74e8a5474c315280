//! MSAC1: reads and writes of data blocks, answered at once or later; the parameter access is one block.
//!
//! Facts: sheet, 3. What they leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | a request while the last one has no answer yet | RR; a poll gets the answer |
//! | a poll without a request | acknowledged |
//! | a write while a parameter request is under way | busy (C2) |
//! | a write while the response to the request before was not read | state conflict (B5) |
//! | a read without a parameter request, or before it is done | state conflict (B5) |
//! | a response that was read | is gone |
//! | a read for less than the response | length error (B1) |

use super::Misuse;
use super::drive::Drive;
use super::link::{Answer, response};
use super::request;
use super::settings::AcyclicSettings;
use fieldbeat_core::time::Time;

/// Functions.
mod function {
    pub const READ: u8 = 0x5E;
    pub const WRITE: u8 = 0x5F;
    pub const ERROR: u8 = 0x80;
}

/// Error_Decode of DP-V1, and its Error_Code_1.
mod error {
    pub const DPV1: u8 = 0x80;
    pub const NOT_SUPPORTED: u8 = 0xA9;
    pub const INDEX: u8 = 0xB0;
    pub const LENGTH: u8 = 0xB1;
    pub const SLOT: u8 = 0xB2;
    pub const STATE: u8 = 0xB5;
    pub const BUSY: u8 = 0xC2;
}

/// The most bytes of a data block.
pub(super) const BLOCK: usize = 240;

/// The acyclic side of one slave.
#[derive(Debug)]
pub(super) struct Acyclic {
    settings: AcyclicSettings,
    /// An answer, and how many polls it still waits.
    answer: Option<(u16, Vec<u8>)>,
    /// A parameter request whose response was not read yet, and when it is done.
    job: Option<(Time, Vec<u8>)>,
}

impl Acyclic {
    pub(super) fn new(settings: AcyclicSettings) -> Acyclic {
        Acyclic { settings, answer: None, job: None }
    }

    /// The master is gone.
    pub(super) fn reset(&mut self) {
        (self.answer, self.job) = (None, None);
    }

    /// A request, or a poll without data.
    pub(super) fn request(
        &mut self,
        now: Time,
        data: &[u8],
        drive: &mut Drive,
        misuse: &mut Misuse,
        out: &mut Vec<u8>,
    ) -> Answer {
        if !data.is_empty() {
            if self.answer.is_some() {
                misuse.acyclic += 1;
                return Answer::Status(response::NO_RESOURCE);
            }
            let answer = self.serve(now, data, drive).unwrap_or_else(|code| {
                misuse.acyclic += u64::from(matches!(code, error::LENGTH | error::NOT_SUPPORTED));
                let function = data.first().map_or(0, |function| function | function::ERROR);
                vec![function, error::DPV1, code, 0]
            });
            self.answer = Some((self.settings.delay, answer));
        }
        match &mut self.answer {
            Some((0, answer)) => {
                out.extend_from_slice(answer);
                self.answer = None;
                Answer::Data(response::DATA)
            }
            Some((polls, _)) => {
                *polls -= 1;
                Answer::Ack
            }
            None => Answer::Ack,
        }
    }

    fn serve(&mut self, now: Time, data: &[u8], drive: &mut Drive) -> Result<Vec<u8>, u8> {
        let [function, slot, index, length, block @ ..] = data else { return Err(error::LENGTH) };
        let is_write = match *function {
            function::READ => false,
            function::WRITE => true,
            _ => return Err(error::NOT_SUPPORTED),
        };
        if *slot != self.settings.slot {
            return Err(error::SLOT);
        }
        if *index != self.settings.index {
            return Err(error::INDEX);
        }
        let length = usize::from(*length);
        if length > BLOCK || block.len() != if is_write { length } else { 0 } {
            return Err(error::LENGTH);
        }
        let is_busy = self.job.as_ref().is_some_and(|(done, _)| now < *done);
        if is_write {
            match self.job {
                Some(_) if is_busy => return Err(error::BUSY),
                Some(_) => return Err(error::STATE),
                None => {}
            }
            self.job = Some((now + self.settings.busy_ns, block.to_vec()));
            return Ok(data[..4].to_vec());
        }
        let Some((_, job)) = self.job.as_ref().filter(|_| !is_busy) else { return Err(error::STATE) };
        // Executed when it is read: nobody can see the difference but its own writes, which end as soon.
        let block = request::execute(job, &self.settings, drive);
        if block.len() > length {
            return Err(error::LENGTH);
        }
        self.job = None;
        let mut answer = vec![*function, *slot, *index, block.len() as u8];
        answer.extend(block);
        Ok(answer)
    }
}
