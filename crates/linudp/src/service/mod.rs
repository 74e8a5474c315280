//! What a LinMot drive offers besides its parameters: lists, curves, command table, error log, its software, its
//! flash.
//!
//! Everything here blocks, on normal threads, over any [`Carrier`]: the queue of a master in this process, or that
//! of another process. Each service is a series of calls on the real-time-config channel, at most one per cycle.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the services of one drive, their errors |
//! | `lists` | the parameters that exist, and those that were changed |
//! | `software` | restart, stop and start, defaults |
//! | `curves` | curves: read, written, saved |
//! | `table` | the command table: read, written, saved |
//! | `log` | the error log and the texts of errors |
//!
//! Facts: LinUDP V2 manual, chapter 7; the order in which real drives do it is known from masters in the field.

mod curves;
mod lists;
mod log;
mod software;
mod table;

use std::any::Any;
use std::ops::ControlFlow;
use std::time::Duration;

use thiserror::Error;

pub use curves::CurvePut;
pub use lists::ListItem;
pub use log::{ErrorLog, LoggedError};
pub use software::{Part, Saved};

use super::upid::{RtcCall, call};
use super::wire::{Refusal, RtcCommand, RtcStatus, Take};
use fieldbeat_core::axis::acyclic::{Acyclic, Answer, Call, CallError, Carrier, Condition};
pub use fieldbeat_core::axis::acyclic::{Progress, Watcher};

/// A command that only reads or writes to RAM. It takes milliseconds; a busy host may hold up every exchange of it.
const USUAL: Duration = Duration::from_secs(5);
/// Stopping, starting, resetting to defaults.
const SLOW: Duration = Duration::from_secs(20);
/// Saving to flash: 39 to 75 s and more were seen on a C1250, without any answer meanwhile.
const FLASH: Duration = Duration::from_secs(180);
/// The most calls that are posted at once: progress is reported, and cancelling is possible, at this interval. A
/// parameter request from elsewhere waits behind no more than these, and finds room in the queue.
const AT_ONCE: usize = 16;

/// The services of one drive. One holder at a time: a drive has one list and one block transfer.
pub struct Services<'a> {
    drive: String,
    carrier: &'a dyn Carrier,
    _claim: Box<dyn Any + Send>,
}

impl std::fmt::Debug for Services<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Services").field("drive", &self.drive).finish_non_exhaustive()
    }
}

/// Why a service failed.
#[derive(Clone, PartialEq, Error)]
pub enum ServiceError {
    /// The drive refused a command, or did not carry it out.
    #[error("drive {drive}: {what}: {why}")]
    Call {
        /// The drive.
        drive: String,
        /// The command, and its object.
        what: String,
        /// The reason.
        why: String,
        /// The same, to match on.
        error: CallError,
    },
    /// A resource that a drive has only one of is in use.
    #[error("drive {drive}: {error}")]
    Claimed {
        /// The drive.
        drive: String,
        /// The reason.
        error: CallError,
    },
    /// The drive is of another protocol.
    #[error("drive {drive} is not a LinMot drive, and only that has these services")]
    NotLinMot {
        /// The drive.
        drive: String,
    },
    /// The power stage is on.
    #[error("drive {drive}: {what} needs a drive that is switched off: disable it first")]
    Powered {
        /// The drive.
        drive: String,
        /// The service.
        what: &'static str,
    },
    /// The data read do not match the manual.
    #[error("drive {drive}: {what}: {why}")]
    Content {
        /// The drive.
        drive: String,
        /// Their object.
        what: String,
        /// The mistake.
        why: String,
    },
    /// The software was stopped for a service, and was not confirmed to run again.
    #[error(
        "{}its software may still be stopped ({start}); `fieldbeat linmot software start` starts it once the \
         drive answers",
        before(.failed)
    )]
    Stopped {
        /// Why the service failed, if it did.
        failed: Option<Box<ServiceError>>,
        /// Why its software could not be started.
        start: Box<ServiceError>,
    },
    /// Cancelled. The drive has its previous content again.
    #[error("drive {drive}: {what} was interrupted; the drive has what it had before")]
    BrokenOff {
        /// The drive.
        drive: String,
        /// The service.
        what: String,
    },
    /// It failed, and restoring the previous content failed too.
    #[error("{failed}; and its previous content could not be restored ({restore}): {remedy}")]
    Half {
        /// The first failure.
        failed: Box<ServiceError>,
        /// Why the previous content is not back.
        restore: Box<ServiceError>,
        /// The remedy.
        remedy: &'static str,
    },
}
fieldbeat_core::debug_as_display!(ServiceError);

/// The message part about what preceded the start of its software.
fn before(failed: &Option<Box<ServiceError>>) -> String {
    match failed {
        Some(failed) => format!("{failed}; and "),
        None => "it is done, but ".to_owned(),
    }
}

impl ServiceError {
    /// The drive's own refusal, if it is one.
    pub fn refusal(&self) -> Option<Refusal> {
        match self {
            ServiceError::Call { error: CallError::Refused(status), .. } => Some(Refusal::of(*status as u8)),
            _ => None,
        }
    }
}

impl<'a> Services<'a> {
    /// The services of a drive of a master in this process.
    pub fn of(acyclic: &'a Acyclic) -> Result<Services<'a>, ServiceError> {
        if acyclic.notation().protocol() != super::PROTOCOL {
            return Err(ServiceError::NotLinMot { drive: acyclic.axis().to_owned() });
        }
        Services::over(acyclic.axis(), acyclic)
    }

    /// The services of LinMot drive `drive` over `carrier`.
    pub fn over(drive: &str, carrier: &'a dyn Carrier) -> Result<Services<'a>, ServiceError> {
        let claimed = carrier.claim();
        let claim = claimed.map_err(|error| ServiceError::Claimed { drive: drive.to_owned(), error })?;
        Ok(Services { drive: drive.to_owned(), carrier, _claim: claim })
    }

    /// The name.
    pub fn drive(&self) -> &str {
        &self.drive
    }

    /// Refuses `what` for a drive that may hold or move its motor.
    pub fn require_off(&self, what: &'static str) -> Result<(), ServiceError> {
        self.off(what).map(drop)
    }

    /// The condition of a drive that is off.
    fn off(&self, what: &'static str) -> Result<Condition, ServiceError> {
        let condition = self.carrier.condition().map_err(|error| self.failed(what.to_owned(), error))?;
        match condition.powered {
            true => Err(ServiceError::Powered { drive: self.drive.clone(), what }),
            false => Ok(condition),
        }
    }

    /// One command.
    fn command(&self, call: Call, limit: Duration) -> Result<Answer, ServiceError> {
        let answers = self.series(&[call], limit)?;
        // A series without a failure has one answer per call.
        Ok(answers.first().copied().unwrap_or_default())
    }

    /// Commands, one after the other; all of them, or the first that failed.
    fn series(&self, calls: &[Call], limit: Duration) -> Result<Vec<Answer>, ServiceError> {
        let series = self.carrier.run(calls, limit);
        match series.failed {
            None => Ok(series.answers),
            Some(error) => Err(self.failed(describe(calls.get(series.answers.len())), error)),
        }
    }

    /// A block, in pieces of 4 bytes, to the drive.
    fn send_block(
        &self,
        command: RtcCommand,
        index: u16,
        block: &[u8],
        report: impl FnMut(usize) -> Result<(), ServiceError>,
    ) -> Result<(), ServiceError> {
        let calls: Vec<Call> =
            block.chunks(4).map(|piece| call(command, index, Take(piece).long())).collect();
        self.transfer(&calls, report).map(drop)
    }

    /// A block of so many bytes, in pieces of 4, from the drive.
    fn take_block(
        &self,
        command: RtcCommand,
        index: u16,
        size: usize,
        report: impl FnMut(usize) -> Result<(), ServiceError>,
    ) -> Result<Vec<u8>, ServiceError> {
        let mut block = self.transfer(&vec![call(command, index, 0); size.div_ceil(4)], report)?;
        block.truncate(size);
        Ok(block)
    }

    /// The pieces of a block, each of which but the last leaves the block unfinished: what was answered.
    fn transfer(
        &self,
        calls: &[Call],
        mut report: impl FnMut(usize) -> Result<(), ServiceError>,
    ) -> Result<Vec<u8>, ServiceError> {
        let size = 4 * calls.len();
        let mut block = Vec::with_capacity(size);
        for calls in calls.chunks(self.at_once()) {
            for (call, answer) in calls.iter().zip(self.series(calls, USUAL)?) {
                block.extend((answer.value as u32).to_le_bytes());
                self.check_step(call, answer, block.len() == size)?;
            }
            report(block.len() / 4)?;
        }
        Ok(block)
    }

    /// Reports that so much of `activity` is done; an error if that cancels it.
    fn go_on(
        &self,
        watch: Watcher<'_>,
        progress: Progress,
        activity: impl FnOnce() -> String,
    ) -> Result<(), ServiceError> {
        match watch(progress) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => {
                Err(ServiceError::BrokenOff { drive: self.drive.clone(), what: activity() })
            }
        }
    }

    /// A drive that takes the end of a block for its middle, or the other way round, counts differently from this
    /// master. Within an entry of the command table a status of done is accepted: some drives report it.
    fn check_step(&self, call: &Call, answer: Answer, last: bool) -> Result<(), ServiceError> {
        let RtcCall { command, .. } = RtcCall::of(call);
        let in_table = matches!(command, RtcCommand::WRITE_ENTRY_DATA | RtcCommand::GET_ENTRY_DATA);
        let why = match RtcStatus::of(answer.status as u8) {
            RtcStatus::BlockNotFinished if last => "the drive expects more data: it counts another size",
            RtcStatus::Done if !last && !in_table => "the drive ends too early: it counts another size",
            _ => return Ok(()),
        };
        Err(self.content(describe(Some(call)), why.to_owned()))
    }

    fn at_once(&self) -> usize {
        (self.carrier.capacity() / 2).clamp(1, AT_ONCE)
    }

    fn failed(&self, what: String, error: CallError) -> ServiceError {
        let why = match error {
            CallError::Refused(status) => Refusal::of(status as u8).to_string(),
            other => other.to_string(),
        };
        ServiceError::Call { drive: self.drive.clone(), what, why, error }
    }

    fn content(&self, what: String, why: String) -> ServiceError {
        ServiceError::Content { drive: self.drive.clone(), what, why }
    }

    fn not_as_written(&self, what: String) -> ServiceError {
        let why =
            "what was read back is not what was written: look for another tool that writes to this drive";
        self.content(what, why.to_owned())
    }
}

/// The message after a failure: whether the previous content was restored.
fn after(failed: ServiceError, restored: Result<(), ServiceError>, remedy: &'static str) -> ServiceError {
    match restored {
        Ok(()) => failed,
        Err(restore) => ServiceError::Half { failed: Box::new(failed), restore: Box::new(restore), remedy },
    }
}

/// For callers without interest in progress; always continues.
fn quiet(_: Progress) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// A call in words.
fn describe(call: Option<&Call>) -> String {
    let Some(call) = call else { return "a command".to_owned() };
    let RtcCall { command, index, value } = RtcCall::of(call);
    match command.0 {
        0x10..=0x23 => format!("{command} 0x{index:04X}"),
        0x50..=0x55 | 0x60..=0x62 => format!("{command} of curve {index}"),
        0x71..=0x73 => format!("{command} of entry {index}"),
        0x74 => format!("{command} {index:04X}h, part {value}"),
        0x82..=0x86 => format!("{command} of entry {index}"),
        _ => command.to_string(),
    }
}
